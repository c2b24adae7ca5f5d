"""`afm-jax invert TABLE.csv`: speeds and delay of every impact from amplitude and phase, without any law."""

from functools import partial
from pathlib import Path

import click

from afm_jax.cli.main import NotValid
from afm_jax.cli.options import NOISE, QUALITY_FACTOR
from afm_jax.cli.session import Session, with_session
from afm_jax.cli.values import Finite, example_path, tables_with


@click.command()
@click.argument("table", metavar="[TABLE.csv]", required=False, type=click.Path(path_type=Path))
@NOISE
@QUALITY_FACTOR
@click.option(
    "--frequency-error",
    "frequency_error_khz",
    type=Finite(positive=True),
    metavar="KHZ",
    help="Standard error of the free frequency; without it, exactly known.",
)
@click.option(
    "--truth",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="The law if it is known, from a file as of --law or the collide.csv of `afm-jax collide --out`: compared with "
    "the reading on resonance.",
)
@click.option(
    "--law",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="A fit's fit.json or law.csv, a law.json of `collide --make-law`, or a CSV of measured speeds: its law with "
    "its band beside the rows; one of other speeds is refused.",
)
@click.option("--example", is_flag=True, help="Invert the bundled table instead of a file.")
@with_session
def command(  # noqa: PLR0913
    session: Session,
    table: Path | None,
    noise: float | None,
    quality_factor: tuple[float, float | None] | None,
    frequency_error_khz: float | None,
    truth: Path | None,
    law: Path | None,
    *,
    example: bool,
) -> None:
    """Read approach speed, rebound speed and collision delay off amplitude and phase, row by row, without any law.

    The table is that of `afm-jax fit` with phase_deg and phase_error_deg. The losses are then regressed on both laws
    (restitution, viscous loss), the delays on the delay law. Rows on resonance are also read as the paper proposes,
    without their phase. With --out the report: invert.txt, .json, .png, .csv and law.csv. Exit code 3 if the rows
    determine no law, or none explains them.
    """
    if example == (table is not None):
        raise click.UsageError("give a table to invert, `afm-jax invert TABLE.csv`, or --example for the bundled one")
    session.start_computing()
    from afm_jax.scenefile.law_files import load_law  # noqa: PLC0415
    from fitting.inversion.invert import invert  # noqa: PLC0415
    from fitting.inversion.report import inversion_summary  # noqa: PLC0415

    (measured,) = tables_with([example_path() if table is None else table], noise, quality_factor)
    known = None if truth is None else load_law(truth)
    beside = None if law is None else load_law(law)
    with session.working(f"inverting {measured.rows} rows (the first run compiles for some seconds)"):
        result = invert(measured, frequency_error_khz=frequency_error_khz, truth=known, law=beside)
    session.emit(result.to_dict(), partial(inversion_summary, result))
    if session.out is not None:
        from fitting.inversion.report import write_inversion  # noqa: PLC0415

        for path in write_inversion(result, session.out, session.write_table):
            session.note(f"wrote {path}")
    if not result.valid:
        raise NotValid(result.reasons[0])
