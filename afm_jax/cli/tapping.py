"""`afm-jax tapping CURVE`: the energy of a tap, thresholds and hysteresis, and where the drive allows it the law."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from afm_jax.cli.main import NotValid
from afm_jax.cli.session import Session, with_session
from afm_jax.cli.values import Share, ValueAndError

if TYPE_CHECKING:
    from fitting.tables.table import AmplitudeTable


@click.command()
@click.argument("curve", metavar="CURVE", type=click.Path(path_type=Path))
@click.option(
    "--noise",
    type=Share("a relative error"),
    metavar="SHARE",
    help="Relative error of amplitudes without one, such as 1%.",
)
@click.option("--free-frequency-khz", type=ValueAndError(), metavar="KHZ[+-KHZ]", help="Instead of the file's.")
@click.option("--quality-factor", type=ValueAndError(), metavar="Q[+-Q]", help="Instead of the file's.")
@click.option("--spring-constant", type=ValueAndError(), metavar="K[+-K]", help="In N/m, instead of the file's.")
@click.option("--tip-calibration", type=ValueAndError(), metavar="C[+-C]", help="True over stated amplitude.")
@click.option("--model", default="viscous+delay", show_default=True, help="Of the law, as for `afm-jax fit`.")
@click.option("--no-law", is_flag=True, help="Leave the impact law out: energy, thresholds and speeds only, at once.")
@with_session
def command(session: Session, curve: Path, noise: float | None, **options: Any) -> None:
    """Read the energy of a tap off a tapping curve, and where the drive allows it the impact law.

    CURVE is a table of amplitude and phase against height (`# drive = force` or base, columns drive_frequency_khz,
    free_amplitude_nm, offset_nm, lockin_amplitude_nm, phase_lag_deg with their errors, retract). Energy, thresholds and
    hysteresis, attractive or repulsive branch, impact speeds where they can be known; then the law from the rows with
    fast impacts, or why not and what to record instead. With --out the report: tapping.html, .txt, .json, .png and
    tapping_rows.csv, and that of the law. Exit code 3 if the energy of a tap is not determined.
    """
    from fitting.tables.table import read_table  # noqa: PLC0415
    from fitting.tapping_curves.report import tapping_summary, write_tapping  # noqa: PLC0415
    from fitting.tapping_curves.tapping import tapping, with_law  # noqa: PLC0415

    result = tapping(_given(read_table(curve, noise=noise), options), law=False)
    if result.law_allowed and not options["no_law"]:
        session.start_computing(*(f"fitting.forward:{name}" for name in ("impacts_of", "located", "linearise_pairs")))
        with session.working("fitting the impact law (the first run compiles for half a minute)"):
            result = with_law(result, options["model"])
    session.emit(result.to_dict(), tapping_summary(result))
    if session.out is not None:
        for path in write_tapping(result, session.out, session.write_table):
            session.note(f"wrote {path}")
    if not result.valid:
        raise NotValid(result.reasons[0])


def _given(table: "AmplitudeTable", options: dict[str, Any]) -> "AmplitudeTable":
    """Return a table with what the call says of the instrument in place of its own."""
    names = {
        "free_frequency_khz": ("free_frequency_khz", "free_frequency_error_khz"),
        "quality_factor": ("quality_factor", "quality_factor_error"),
        "spring_constant": ("spring_constant_n_per_m", "spring_constant_error_n_per_m"),
    }
    own = {
        name: number
        for option, pair in names.items()
        if options[option] is not None
        for name, number in zip(pair, options[option], strict=True)
    }
    if options["tip_calibration"] is not None:
        value, error = options["tip_calibration"]
        own["calibration"] = table.calibration | {"tip_calibration": (value, error or 0.0)}
    return replace(table, **own) if own else table
