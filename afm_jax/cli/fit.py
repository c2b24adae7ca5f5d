"""`afm-jax fit TABLE.csv`: the impact law from measured vibration amplitudes."""

from pathlib import Path
from typing import Any

import click

from afm_jax.cli.failures import NotValid
from afm_jax.cli.session import Session, with_session

MODELS = ("restitution", "law", "viscous")


class Noise(click.ParamType):
    """A relative error: 1% or 0.01."""

    name = "share"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Return the share that a text says.

        Raises:
            click.BadParameter: if it is no number between 0 and 1.
        """
        text = str(value).strip()
        try:
            share = float(text.removesuffix("%")) / (100.0 if text.endswith("%") else 1.0)
        except ValueError:
            share = float("nan")
        if not 0.0 < share < 1.0:
            self.fail(f"must be a relative error such as 1% or 0.01, but is {value}", param, ctx)
        return share


@click.command()
@click.argument("table", metavar="[TABLE.csv]", required=False, type=click.Path(path_type=Path))
@click.option(
    "--model",
    default="law",
    show_default=True,
    type=click.Choice(MODELS),
    help="restitution: r alone; law: r and epsilon; viscous: epsilon and viscous_loss.",
)
@click.option("--noise", type=Noise(), metavar="SHARE", help="Relative error of amplitudes without one, such as 1%.")
@click.option("--scale-errors", is_flag=True, help="Take the errors as relative: scale them until chi2/dof is 1.")
@click.option("--example", is_flag=True, help="Fit the bundled table instead of a file.")
@with_session
def command(
    session: Session, table: Path | None, model: str, noise: float | None, *, scale_errors: bool, example: bool
) -> None:
    """Fit the impact law to a table of vibration amplitudes.

    The table is a CSV file: comment lines `# free_frequency_khz = 90`, `# quality_factor = 40 +- 1`, and columns
    order, drive_frequency_khz, drive_amplitude_nm, offset_nm, peak_amplitude_nm and/or lockin_amplitude_nm, each
    with its ..._error_nm. With --out the report: fit.txt, fit.json, fit.png, fit_rows.csv, law.csv. Exit code 3 if
    the result is not valid: not converged, not explained by the model, or a parameter not identified.
    """
    if example == (table is not None):
        raise click.UsageError("give a table to fit, `afm-jax fit TABLE.csv`, or --example for the bundled one")
    session.start_computing()
    from fitting.law_fit import fit  # noqa: PLC0415
    from fitting.report import summary  # noqa: PLC0415
    from fitting.table import read_table  # noqa: PLC0415

    measured = read_table(_example_path() if table is None else table, noise=noise)
    with session.working(f"fitting {measured.rows} rows (the first run compiles for some seconds)"):
        result = fit(measured, model, scale_errors=scale_errors)
    session.emit(result.to_dict(), summary(result))
    if session.out is not None:
        from fitting.report import write_report  # noqa: PLC0415

        for path in write_report(result, session.out, session.write_table):
            session.note(f"wrote {path}")
    if not result.valid:
        raise NotValid(result.reasons[0])


def _example_path() -> Path:
    """Return where the bundled table lies, the short way if that is below the working folder."""
    import fitting.examples  # noqa: PLC0415

    path = Path(fitting.examples.__path__[0]) / "amplitudes_law.csv"
    return path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path
