"""Time traces of the deflection: read them from CSV or HDF5, check them.

The CSV form is a file in UTF-8 with comment lines and a row of column names::

    # drive_frequency_khz = 181.8
    # drive_amplitude_nm = 4
    # offset_nm = 0
    # free_frequency_khz = 90
    time_us,deflection_nm,platform_nm
    0.00,12.31,3.98

The deflection is the tip's height; ``position_nm`` is another name of it. ``time_us`` may be replaced by a comment
``# sampling_rate_mhz = 50``. ``platform_nm`` (the platform's height) or ``drive`` (any signal in phase with it) gives
the reference of the phase. HDF5 files hold data sets and attributes of the same names.
"""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float

from fitting.tables.csv_text import Faults, TableError, read_text
from fitting.traces.lockin_csv import ParsedTrace, parse_csv
from fitting.traces.lockin_hdf5 import SIGNATURE, parse_hdf5
from fitting.traces.lockin_settings import TraceSettings, joined_settings

__all__ = ["TableError", "Trace", "read_trace"]

_UNEVEN = 0.1
"""Share of a sampling step by which a time may miss its place: rounding of the printed times, not a lost sample."""
_LEAST_RATE = 4.0
"""Samples per drive period."""
_KHZ_PER_MHZ = 1e3


@dataclass(frozen=True, eq=False, kw_only=True)
class Trace:
    """Equally spaced samples of the deflection and what is known of the measurement.

    Attributes:
        deflection_nm: the tip's height, shape (samples,), a read-only copy.
        start_us: time of the first sample.
        step_us: time between two samples.
        platform: the platform's height or a signal in phase with it, shape (samples,), or None.
        platform_in_nm: whether `platform` is its height in nm.
        settings: what file and caller say; `drive_frequency_khz` is always known.
        source: path of the file as it was given.
        remarks: free comments of the file.

    Raises:
        TableError: if a sample is not finite, the drive frequency is not known, there are fewer than four samples per
            drive period, or the trace is shorter than two of them.
    """

    deflection_nm: Float[np.ndarray, " samples"]
    start_us: float
    step_us: float
    settings: TraceSettings
    platform: Float[np.ndarray, " samples"] | None = None
    platform_in_nm: bool = False
    source: str = "trace in memory"
    remarks: tuple[str, ...] = ()
    first_line: int = field(default=0, repr=False)

    def __post_init__(self):
        faults = Faults(self.source, place="line" if self.first_line else "sample")
        for name in ("deflection_nm", "platform"):
            values = getattr(self, name)
            if values is not None:
                _check_samples(name, values, self, faults)
                own = np.array(values, dtype=np.float64)
                own.setflags(write=False)
                object.__setattr__(self, name, own)
        faults.raise_any()
        if not 0.0 < self.step_us < np.inf or not np.isfinite(self.start_us):
            faults.add(f"`step_us` must be finite and above 0, but is {self.step_us!r}")
        if self.settings.drive_frequency_khz is None:
            advice = "give --drive-frequency-khz or a comment '# drive_frequency_khz = 180'"
            faults.add(f"the drive frequency is missing; {advice}")
        faults.raise_any()
        _check_length(self, faults)
        faults.raise_any()

    @property
    def samples(self) -> int:
        """Number of samples."""
        return len(self.deflection_nm)

    @property
    def drive_frequency_khz(self) -> float:
        """Frequency of the platform."""
        return float(self.settings.drive_frequency_khz or np.nan)

    @property
    def drive_period_us(self) -> float:
        """Period of the platform."""
        return _KHZ_PER_MHZ / self.drive_frequency_khz

    @property
    def drive_periods(self) -> float:
        """How many drive periods the samples span, each sample counted with its step."""
        return self.samples * self.step_us / self.drive_period_us

    @property
    def time_us(self) -> Float[np.ndarray, " samples"]:
        """Times of the samples."""
        return self.start_us + self.step_us * np.arange(self.samples)

    @property
    def height_nm(self) -> Float[np.ndarray, " samples"]:
        """Height above the rest position."""
        return self.deflection_nm - (self.settings.rest_nm or 0.0)


def _check_samples(name: str, values: np.ndarray, trace: Trace, faults: Faults) -> None:
    if np.shape(values) != np.shape(trace.deflection_nm) or np.ndim(values) != 1:
        faults.add(f"has the shape {np.shape(values)}; it must have the deflection's, one number a sample", column=name)
        return
    # blank lines and comments between the samples are rare: the line is right without them
    for index in np.flatnonzero(~np.isfinite(values)):
        line = int(index) + (trace.first_line or 1)
        faults.add(f"must be finite, but is {values[index]}; cut the trace there or repair it", line=line, column=name)


def _check_length(trace: Trace, faults: Faults) -> None:
    per_period = trace.drive_period_us / trace.step_us
    if per_period < _LEAST_RATE * (1.0 - 1e-9):
        least = _LEAST_RATE * trace.drive_frequency_khz / _KHZ_PER_MHZ
        faults.add(
            f"there are {per_period:.3g} samples per drive period, but {_LEAST_RATE:g} are needed; "
            f"sample with at least {least:.4g} MHz (or correct drive_frequency_khz, {trace.drive_frequency_khz:g})"
        )
    # one sample less than two periods still repeats
    elif trace.drive_periods < 2.0 - 1e-9:
        faults.add(
            f"the trace spans {trace.drive_periods:.3g} drive periods, too short for two response periods; "
            f"record at least {2.0 * trace.drive_period_us:.4g} us, better 50 drive periods"
        )


def read_trace(path: str | Path, *, group: str | None = None, **settings: float | None) -> Trace:
    """Read a time trace from a CSV or HDF5 file and check all of it.

    Args:
        path: the file; its form is recognised by its content, not by its name.
        group: the group of an HDF5 file that holds the data sets; None is the file itself.
        **settings: attributes of `TraceSettings` by name, in front of what the file says.

    Raises:
        TableError: one line that names the first fault, its place and how to mend it, and the number of other faults.
    """
    faults = Faults(str(path))
    if _starts_as_hdf5(path):
        parsed = parse_hdf5(Path(path), group, faults)
    else:
        if group is not None:
            faults.add("is no HDF5 file and has no groups; leave the group out")
        parsed = parse_csv(read_text(path), faults)
    joined = joined_settings(parsed.settings, settings, faults)
    faults.raise_any()
    start, step = _clock(parsed, joined, faults)
    faults.raise_any()
    return Trace(
        deflection_nm=parsed.columns["deflection_nm"],
        start_us=start,
        step_us=step,
        settings=joined,
        platform=parsed.columns.get("platform"),
        platform_in_nm=parsed.platform_in_nm,
        source=str(path),
        remarks=parsed.remarks,
        first_line=parsed.first_line,
    )


def _starts_as_hdf5(path: str | Path) -> bool:
    try:
        with Path(path).open("rb") as file:
            return file.read(len(SIGNATURE)) == SIGNATURE
    except (OSError, ValueError):
        # `read_text` says what is wrong with the path
        return False


def _clock(parsed: ParsedTrace, settings: TraceSettings, faults: Faults) -> tuple[float, float]:
    """Return the time of the first sample and the step, both in us."""
    times, rate = parsed.columns.get("time_us"), settings.sampling_rate_mhz
    if times is None:
        if rate is None:
            faults.add(
                "the sampling rate is missing; give a column time_us, --sampling-rate-mhz or '# sampling_rate_mhz = 50'"
            )
            return 0.0, 1.0
        return 0.0, 1.0 / rate
    if len(times) < 2 or not np.all(np.isfinite(times)):
        bad = int(np.argmin(np.isfinite(times))) if len(times) > 1 else 0
        line = bad + parsed.first_line
        faults.add("there must be at least two finite times; correct or cut", line=line, column="time_us")
        return 0.0, 1.0
    step = float(times[-1] - times[0]) / (len(times) - 1)
    uneven = np.abs(np.diff(times) - step) > _UNEVEN * abs(step)
    lost = np.abs(times - times[0] - step * np.arange(len(times))) > 2.0 * _UNEVEN * abs(step)
    if step <= 0.0 or np.any(uneven) or np.any(lost):
        steps = np.diff(times)
        typical = float(np.median(steps))
        worst = int(np.argmax(np.abs(steps - typical))) + 1
        faults.add(
            f"the time steps are not equal: {float(steps[worst - 1]):.6g} us here, {typical:.6g} us elsewhere; record "
            "with a constant sampling rate, print more digits, or cut the trace where samples are missing",
            line=worst + parsed.first_line,
            column="time_us",
        )
    elif rate is not None and abs(rate * step - 1.0) > 1e-3:
        faults.add(
            f"the column time_us has {1.0 / step:.6g} samples per us, but sampling_rate_mhz is {rate:g}; remove one"
        )
    return float(times[0]), step
