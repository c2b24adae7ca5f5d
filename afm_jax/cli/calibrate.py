"""`afm-jax calibrate SWEEP`: frequency, quality factor and stiffness of the free cantilever."""

from pathlib import Path
from typing import Annotated, Any, Literal

from afm_jax.cli.command import Output
from afm_jax.cli.session import Session
from afm_jax.cli.values import Positive, Quantity, Share
from fitting.calibration.calibrate import calibrate
from fitting.calibration.sweep import read_resonance


class CalibrationOptions:
    """What is said of a lever and of the scale of its deflection, as `fitting.calibrate` takes it.

    Attributes:
        averages: spectra that a thermal spectrum is the mean of.
        length_um: length of a rectangular cantilever, '225 +- 2' with its error: Sader's method.
        width_um: its width.
        temperature_k: of cantilever and air [default: the file's, 296 +- 3].
        scale_error: relative error of the deflection's scale (its sensitivity); that of k is twice as large.
    """

    averages: Positive | None = None
    length_um: Quantity | None = None
    width_um: Quantity | None = None
    temperature_k: Quantity | None = None
    scale_error: Annotated[float, Share("a relative error")] = 0.05


def calibration(
    session: Session,
    sweep: Annotated[Path, "SWEEP"],
    *,
    deflection: Literal["static", "mode"] = "static",
    **lever: Any,
) -> Output:
    """Fit frequency and quality factor to a frequency scan of the free resonance, or to a thermal spectrum.

    SWEEP is Nanonis text, or columns frequency_khz (or frequency_hz), amplitude_nm (or amplitude, any unit) and, where
    known, phase_deg, amplitude_error_nm (or amplitude_error). A thermal spectrum (NanoSurf .nid, or
    asd_nm_per_sqrt_hz or psd_nm2_per_hz) gives the spring constant, too, by equipartition; with the cantilever's size
    also by Sader's method. frequency_khz is the undamped natural frequency, not that of the maximum. With --out
    calibration.json, .png and calibration_points.csv. Exit code 3 if the result is not valid: no resonance, at the
    edge, not explained by the model, or a scale of the deflection that another spring constant contradicts.

    Args:
        session: for progress.
        sweep: the file.
        deflection: how a thermal spectrum got its nm: by the slope of a force curve (static InvOLS), or for the mode
            itself.
        **lever: as `CalibrationOptions`.
    """
    measured = read_resonance(sweep)
    with session.working(f"fitting {measured.points} points"):
        result = calibrate(measured, static=deflection == "static", **lever)
    return Output.of(result, "calibration")
