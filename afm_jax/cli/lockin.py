"""`afm-jax lockin TRACE`: amplitudes and phase of a deflection in time at the drive's frequency over each order."""

from pathlib import Path
from typing import Annotated

from click import IntRange

from afm_jax.cli.command import Output
from afm_jax.cli.session import Session
from afm_jax.cli.values import Positive
from fitting.traces.lockin import lockin


def lockin_of_trace(
    _: Session,
    trace: Annotated[Path, "TRACE"],
    *,
    drive_frequency_khz: Positive | None = None,
    order: Annotated[int, IntRange(1, 8)] = 1,
) -> Output:
    """Read amplitude and phase of a deflection in time at the drive's frequency over N, and over 1 to 8.

    TRACE is text with the columns time_us (or time_ms, time_s) and deflection_nm (the tip's height), separated by
    commas, tabs, semicolons or spaces. The phase assumes that the platform is highest at time 0. Amplitudes are
    integrals over whole periods, errors the scatter of up to twelve parts of the trace. Exit code 3 if the trace is not
    periodic at order N: the scatter, or the amplitude at another order, is above 2 % of that at N. With --out
    lockin.csv, .json and .png.

    Args:
        trace: the file.
        drive_frequency_khz: of the platform; else the file's.
        order: drive periods in a period of the response.
    """
    return Output.of(lockin(trace, drive_frequency_khz=drive_frequency_khz, order=order), "lockin")
