"""`afm-jax tapping-map IMAGE`: energy of a tap and virial in every pixel."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

from afm_jax.cli.command import Output
from afm_jax.cli.session import Session
from afm_jax.cli.values import Positive, Quantity
from fitting.instruments.images import read_images
from fitting.tapping_curves.map_report import write_map
from fitting.tapping_curves.maps import tapping_map


class ImagingOptions:
    """What is said of the instrument, as `fitting.tapping_map` takes it.

    Attributes:
        drive: what is driven.
        free_phase_deg: phase of the free tip, as the instrument reads it, '90 +- 0.05' [its error: 0.2].
        nm_per_volt: sensitivity of an amplitude in volts.
        tip_calibration: true over stated amplitude; '1 +- 0.02'.
        amplitude_error_nm: standard error of a pixel's amplitude.
        phase_error_deg: standard error of a pixel's phase.
    """

    drive: Literal["base", "force"] = "base"
    free_phase_deg: Quantity | None = None
    nm_per_volt: Quantity | None = None
    tip_calibration: Quantity | None = None
    amplitude_error_nm: Positive | None = None
    phase_error_deg: Positive | None = None


def map_of_an_image(
    session: Session,  # noqa: ARG001
    image: Annotated[Path, "IMAGE"],
    *,
    columns: Annotated[str, "COLUMN=CHANNEL[:UNIT][:FACTOR],..."] = "",
    formats: Annotated[Sequence[Literal["npz", "gsf", "zarr"]], "--format"] = ("npz",),
    **imaging: Any,
) -> Output:
    """Determine the energy of a tap and the virial at every pixel of an image of amplitude and phase.

    IMAGE is a NumPy file (.npz with the arrays amplitude and phase, or .npy of the two), or an instrument's file with
    channels of both: Asylum .ibw (`pip install 'afm-jax[instruments]'`), and all that Gwyddion reads (`pip install
    'afm-jax[gwyddion]'`, which runs its program on the file). Amplitude and phase of the free tip at the same drive are
    required. Each pixel has its own error; the common error (spring constant, frequency, Q, calibration, free amplitude
    and phase) is given once. Pixels out of range (amplitude above the free one, energy below zero beyond its error) are
    masked and counted. With --out map.png, .json, .txt and the arrays. Exit code 3 if most pixels are out of range, the
    median energy is below zero or only bracketed, or the unknown sense of the phase decides.

    Args:
        session: of the call.
        image: the file.
        columns: the image of each quantity, as lockin_amplitude_nm=Amplitude:V,phase_lag_deg=Phase.
        formats: of the arrays written into --out (gsf: for Gwyddion), else npz; may be given several times.
        **imaging: as `ImagingOptions` and `LeverOptions`.
    """
    result = tapping_map(read_images(image, columns=columns), **imaging)
    return Output.of(result, report=partial(write_map, result, formats=formats))
