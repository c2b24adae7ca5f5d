"""`afm-jax calibrate SWEEP`: frequency and quality factor of the free cantilever from a resonance sweep."""

from functools import partial
from pathlib import Path

import click

from afm_jax.cli.main import NotValid
from afm_jax.cli.session import Session, with_session
from afm_jax.cli.values import Share

BACKGROUNDS = ("none", "floor", "constant", "linear")


@click.command()
@click.argument("sweep", metavar="SWEEP", type=click.Path(path_type=Path))
@click.option(
    "--background",
    type=click.Choice(BACKGROUNDS),
    help="What is added to the response: with phase none, constant or linear; without none, floor or constant. "
    "Without this option constant, or what Akaike's criterion prefers clearly.",
)
@click.option("--amplitude-only", is_flag=True, help="Leave the phase of the sweep aside.")
@click.option(
    "--noise",
    type=Share("a relative error"),
    metavar="SHARE",
    help="Error of every point as a share of the largest amplitude.",
)
@click.option("--scale-errors", is_flag=True, help="Take given errors as relative: scale them until chi2/dof is 1.")
@with_session
def command(
    session: Session,
    sweep: Path,
    background: str | None,
    noise: float | None,
    *,
    amplitude_only: bool,
    scale_errors: bool,
) -> None:
    """Fit frequency and quality factor to a free resonance sweep.

    SWEEP is Nanonis text, or CSV with the columns frequency_khz (or frequency_hz), amplitude_nm (or amplitude, any
    unit) and, where known, phase_deg, amplitude_error_nm (or amplitude_error), phase_error_deg. Without errors and
    --noise the errors are estimated from the misfit. frequency_khz is the undamped natural frequency, not that of the
    maximum. With --out the report: calibration.txt, .json, .png and calibration_points.csv. Exit code 3 if the result
    is not valid: no resonance, at the edge, not converged, or not explained by the model.
    """
    session.start_computing()
    from fitting.calibration.calibrate import calibrate  # noqa: PLC0415
    from fitting.calibration.report import calibration_summary  # noqa: PLC0415
    from fitting.calibration.sweep import read_sweep, without_phase  # noqa: PLC0415

    measured = read_sweep(sweep)
    if amplitude_only:
        measured = without_phase(measured)
    with session.working(f"fitting {measured.points} points (the first run compiles for some seconds)"):
        result = calibrate(measured, background=background, noise=noise, scale_errors=scale_errors)
    session.emit(result.to_dict(), partial(calibration_summary, result))
    if session.out is not None:
        from fitting.calibration.report import write_calibration  # noqa: PLC0415

        for path in write_calibration(result, session.out, session.write_table):
            session.note(f"wrote {path}")
    if not result.valid:
        raise NotValid(result.reasons[0])
