"""`afm-jax lockin TRACE`: amplitudes and phase of a deflection in time at the drive's frequency over each order."""

from pathlib import Path

from afm_jax.cli.command import Output
from afm_jax.cli.session import Session
from fitting.tables.csv_text import TableError
from fitting.traces.lockin import lockin, read_trace


def lockin_of_trace(_: Session, *, trace: Path, drive_frequency_khz: float | None, order: int) -> Output:
    """Return what a lock-in reads of a trace."""
    read = read_trace(trace)
    frequency = read.drive_frequency_khz if drive_frequency_khz is None else drive_frequency_khz
    if frequency is None:
        raise TableError(
            f"{trace}: the drive frequency is missing; give `drive_frequency_khz=...` or '# drive_frequency_khz = 180'"
        )
    try:
        result = lockin(read.time_us, read.deflection_nm, frequency, order)
    except TableError as error:
        raise TableError(f"{trace}: {error}") from error
    return Output.of(result, "lockin")
