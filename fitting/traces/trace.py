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

import io
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from afm_jax.checks import checked
from afm_jax.results import Result, public_result
from afm_jax.scenefile.tables import cut_short, printable
from afm_jax.units import contradicting_mass
from afm_jax.whole_files import MOST_PACKED, MOST_VALUES
from fitting.tables.csv_text import (
    Column,
    Faults,
    FileSetting,
    Form,
    TableError,
    check_names,
    fault_in_number,
    quoted,
    read_bytes,
    read_columns,
    text_of,
)
from fitting.tables.table import LOWEST_QUALITY_FACTOR

_ANY = float("-inf")
SETTINGS = {
    setting.key: setting
    for setting in (
        FileSetting("sampling_rate_mhz", "50"),
        FileSetting("drive_frequency_khz", "180"),
        FileSetting("drive_amplitude_nm"),
        FileSetting("offset_nm", lowest=_ANY),
        FileSetting("drive_phase_deg", lowest=_ANY),
        FileSetting("free_frequency_khz"),
        FileSetting("quality_factor", "40 (or 40 +- 2)", lowest=LOWEST_QUALITY_FACTOR, error="maybe", none=True),
        FileSetting("quality_factor_error"),
        FileSetting("mass_ng"),
        FileSetting("spring_constant_n_per_m", "5.4 (or 5.4 +- 0.5)", error="maybe"),
        FileSetting("spring_constant_error_n_per_m"),
        FileSetting("rest_nm", lowest=_ANY),
    )
}
_ERRORS = {
    "quality_factor": "quality_factor_error",
    "spring_constant_n_per_m": "spring_constant_error_n_per_m",
}
"""Settings that may come with an error, and its name."""


@dataclass(frozen=True, kw_only=True)
class TraceSettings:
    """The settings of a trace; None where nothing is known.

    Attributes:
        sampling_rate_mhz: samples per us.
        drive_frequency_khz: of the platform.
        drive_amplitude_nm: of the platform.
        offset_nm: mean height of the platform above the tip's rest position.
        drive_phase_deg: psi in z_p = offset + beta cos(omega t + psi), t the trace's own time.
        free_frequency_khz: undamped natural frequency of the cantilever.
        quality_factor: of the cantilever; infinite: no air damping.
        quality_factor_error: its standard error.
        mass_ng: effective mass.
        spring_constant_n_per_m: which says the mass, too.
        spring_constant_error_n_per_m: its standard error.
        rest_nm: what the deflection reads at the tip's rest position.
    """

    sampling_rate_mhz: float | None = None
    drive_frequency_khz: float | None = None
    drive_amplitude_nm: float | None = None
    offset_nm: float | None = None
    drive_phase_deg: float | None = None
    free_frequency_khz: float | None = None
    quality_factor: float | None = None
    quality_factor_error: float | None = None
    mass_ng: float | None = None
    spring_constant_n_per_m: float | None = None
    spring_constant_error_n_per_m: float | None = None
    rest_nm: float | None = None


def settings_of_attributes(attributes: Mapping[str, Any], faults: Faults) -> dict[str, float]:
    """Return the settings among the attributes of an HDF5 file; attributes of other names are left alone.

    Args:
        attributes: by name.
        faults: where a value that is no number is noted.
    """
    found = {}
    for name, setting in SETTINGS.items():
        if name in attributes:
            try:
                none = setting.none and str(attributes[name]) == "none"
                found[name] = float("inf") if none else _checked(name, float(attributes[name]), faults)
            except (TypeError, ValueError):
                faults.add(f"the attribute {name} is {quoted(str(attributes[name]))}; it must be a number")
    return found


def joined_settings(found: Mapping[str, float], given: Mapping[str, float | None], faults: Faults) -> TraceSettings:
    """Return the settings of a trace: those given by the caller in front of those of the file.

    Args:
        found: what the file says.
        given: what the caller says; None leaves the file's.
        faults: where impossible values are noted.

    Raises:
        TypeError: if the caller names a setting that does not exist.
    """
    stated = {name: float(value) for name, value in given.items() if value is not None}
    for name, value in stated.items():
        if name not in SETTINGS:
            raise TypeError(f"there is no setting `{name}`; the settings are {', '.join(SETTINGS)}")
        if not (SETTINGS[name].none and value == float("inf")):
            _checked(name, value, faults)
    # an error belongs to the value that it was stated with; of mass and spring constant the one that is stated holds
    gone = {_ERRORS[name] for name in stated if name in _ERRORS}
    if "mass_ng" in stated:
        gone |= {"spring_constant_n_per_m", "spring_constant_error_n_per_m"}
    if "spring_constant_n_per_m" in stated:
        gone |= {"mass_ng"}
    joined = TraceSettings(**({name: value for name, value in found.items() if name not in gone} | stated))
    mass, spring, frequency = joined.mass_ng, joined.spring_constant_n_per_m, joined.free_frequency_khz
    if mass is not None and spring is not None and frequency is not None and faults.count == 0:
        wrong = contradicting_mass(mass, spring, frequency)
        if wrong is not None:
            faults.add(wrong)
    return joined


def _checked(name: str, value: float, faults: Faults) -> float:
    fault = fault_in_number(SETTINGS[name], value)
    if fault is not None:
        faults.add(f"{name} {fault}")
    return value


TRACE = Form(
    (
        Column("time_us", kind="number"),
        Column("deflection_nm", kind="number", needed="deflection"),
        Column("position_nm", kind="number", meaning="deflection_nm"),
        Column("platform_nm", kind="number", meaning="platform"),
        Column("drive", kind="number", meaning="platform"),
    ),
    "sample",
    open=True,
    example="time_us,deflection_nm",
    mend="cut the trace there or repair it",
)
"""The columns that are read, and what each becomes; `drive` is the drive's signal in any unit."""
ATTRIBUTES = {column.name: column.becomes for column in TRACE.columns}


@dataclass(frozen=True)
class ParsedTrace:
    """What a file says; `columns` holds time_us, deflection_nm, platform as far as they are there."""

    columns: dict[str, Float[np.ndarray, " samples"]]
    settings: dict[str, float]
    platform_in_nm: bool
    first_line: int = 0
    """Line of the first sample; 0 where the file has no lines."""
    remarks: tuple[str, ...] = field(default=())


def parse_csv(text: str, faults: Faults) -> ParsedTrace:
    """Read the text of a CSV file; columns of other names are left alone.

    Args:
        text: all of it.
        faults: where faults are noted; with any, the result is not to be used.

    Raises:
        TableError: at once where the column names are wrong: the cells below them cannot be judged.
    """
    table = read_columns(text, TRACE, SETTINGS, faults)
    faults.raise_any()
    settings = {key: value for key, (value, _) in table.settings.items()}
    settings |= {_ERRORS[key]: error for key, (_, error) in table.settings.items() if error is not None}
    return ParsedTrace(table.columns, settings, "platform_nm" in table.names, int(table.lines[0]), table.remarks)


SIGNATURE = b"\x89HDF\r\n\x1a\n"
"""The first bytes of every HDF5 file without a user block."""


def parse_hdf5(data: bytes, group: str | None, faults: Faults) -> ParsedTrace:
    """Read the data sets deflection_nm, time_us, platform_nm or drive of a file or of one of its groups.

    Attributes of the file, the group and the deflection give the settings, the last of them first. Only what lies in
    the file itself is read: no link, no data set whose numbers are in other files.

    Args:
        data: all of the file.
        group: which of the file's groups; None is the file itself.
        faults: where faults are noted; with any, the result is not to be used.

    Raises:
        TableError: if the package h5py is missing, the file is damaged, or a data set is missing or no column.
    """
    h5py = _h5py(faults)
    try:
        with h5py.File(io.BytesIO(data), "r") as file:
            return _read(h5py, file, group, faults, len(data))
    except TableError:
        raise
    # whatever a damaged file makes of the package
    except (OSError, RuntimeError, ValueError, TypeError, LookupError, ArithmeticError, MemoryError) as error:
        what = cut_short(" ".join(str(error).split()) or type(error).__name__, 200)
        faults.fail(f"cannot be read as HDF5 ({printable(what)}); save it again")


def _h5py(faults: Faults) -> Any:
    """Return the optional package, which has no annotations that could be checked where it is not installed."""
    try:
        return import_module("h5py")
    except ModuleNotFoundError:
        faults.fail("is an HDF5 file, which needs the package h5py; install it with: pip install h5py, or save as CSV")


def _read(h5py: Any, file: Any, group: str | None, faults: Faults, size: int) -> ParsedTrace:
    place = _group(h5py, file, group, faults)
    if not isinstance(place, h5py.Group):
        groups = _groups_with_deflection(h5py, file)
        held = ", ".join(groups) or "none"
        faults.fail(f"there is no group {quoted(str(group))}; those with deflection_nm are {held}")
    found = {name: _own(h5py, place, name, faults) for name in place if name in ATTRIBUTES}
    faults.raise_any()
    others = [name for name in place if name not in ATTRIBUTES and _is_own_data(h5py, place, name)]
    names = [name for name, item in found.items() if isinstance(item, h5py.Dataset)] + others
    has_deflection = any(ATTRIBUTES.get(name) == "deflection_nm" for name in names)
    inner = [] if has_deflection else _groups_with_deflection(h5py, place)
    if inner:
        choice = f" (there are {', '.join(inner)})" if inner[1:] else ""
        faults.fail(f'there is no data set deflection_nm here; name its group: `group="{inner[0]}"`{choice}')
    check_names(names, TRACE, faults=faults)
    wanted = [name for name in names if name in ATTRIBUTES]
    faults.raise_any()
    _check_sizes({name: found[name] for name in wanted}, size, faults)
    faults.raise_any()
    columns = {ATTRIBUTES[name]: np.asarray(found[name][...], dtype=np.float64) for name in wanted}
    holders = [file, place, *(found[name] for name in wanted if ATTRIBUTES[name] == "deflection_nm")]
    attributes = {name: holder.attrs[name] for holder in holders for name in SETTINGS if name in holder.attrs}
    return ParsedTrace(columns, settings_of_attributes(attributes, faults), "platform_nm" in wanted)


def _group(h5py: Any, file: Any, group: str | None, faults: Faults) -> Any:
    """Return a group of a file, something else or None where there is none of this name; links are not followed."""
    place = file
    for part in () if group is None else filter(None, group.split("/")):
        place = _own(h5py, place, part, faults) if isinstance(place, h5py.Group) else None
        faults.raise_any()
    return place


def _groups_with_deflection(h5py: Any, place: Any) -> list[str]:
    """Return the names, from the file on, of all groups below a place that hold a deflection."""
    found: list[str] = []

    def visit(_: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset) and ATTRIBUTES.get(item.name.rsplit("/", 1)[1]) == "deflection_nm":
            found.append(item.parent.name.strip("/"))

    place.visititems(visit)
    return [name for name in dict.fromkeys(found) if name]


def _own(h5py: Any, place: Any, name: str, faults: Faults) -> Any:
    """Return a member of a group, None where there is none; links are not followed, but noted."""
    link = place.get(name, getlink=True)
    if isinstance(link, h5py.SoftLink | h5py.ExternalLink):
        what = "a link to another file" if isinstance(link, h5py.ExternalLink) else "a link to another place"
        faults.add(f"is {what}, which is not followed; save the data set itself under this name", column=quoted(name))
        return None
    return None if link is None else place.get(name)


def _is_own_data(h5py: Any, place: Any, name: str) -> bool:
    return isinstance(place.get(name, getlink=True), h5py.HardLink) and place.get(name, getclass=True) is h5py.Dataset


def _check_sizes(datasets: Mapping[str, Any], size: int, faults: Faults) -> None:
    """Note data sets that are no row of numbers, whose numbers are elsewhere, or that a file of a size cannot hold."""
    for name, dataset in datasets.items():
        if dataset.ndim != 1 or dataset.dtype.kind not in "fiu":
            faults.add(
                f"the data set has shape {dataset.shape} and type {dataset.dtype}; give one row of numbers", column=name
            )
        elif dataset.external or dataset.is_virtual:
            faults.add("its numbers are in other files, which are not read; save them in this one", column=name)
        else:
            # a block that is read may be larger than what it holds of the row
            count = max(dataset.size, *(dataset.chunks or (0,)))
            if count > MOST_VALUES or count * dataset.dtype.itemsize > MOST_PACKED * size:
                faults.add(f"{count:,} numbers are announced in a file of {size:,} bytes; save it again", column=name)
    if sum(dataset.size for dataset in datasets.values()) > MOST_VALUES and not faults.count:
        faults.add(f"holds more than {MOST_VALUES:,} numbers; cut the trace into parts")


_UNEVEN = 0.1
"""Share of a sampling step by which a time may miss its place: rounding of the printed times, not a lost sample."""
_LEAST_RATE = 4.0
"""Samples per drive period."""
_KHZ_PER_MHZ = 1e3


@public_result()
@dataclass(frozen=True, eq=False, kw_only=True)
class Trace(Result):
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
            advice = "give `drive_frequency_khz=...` or a comment '# drive_frequency_khz = 180'"
            faults.add(f"the drive frequency is missing; {advice}")
        faults.raise_any()
        _check_length(self, faults)
        faults.raise_any()

    @property
    def samples(self) -> int:
        """The number of samples of the trace."""
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
    lines = np.arange(len(values)) + (trace.first_line or 1)
    TRACE.check_numbers(name, np.asarray(values, np.float64), lines, faults)


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


@checked
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
    data = read_bytes(path, "a time trace")
    if data.startswith(SIGNATURE):
        parsed = parse_hdf5(data, group, faults)
    else:
        if group is not None:
            faults.add("is no HDF5 file and has no groups; leave the group out")
        parsed = parse_csv(text_of(data, path), faults)
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


def _clock(parsed: ParsedTrace, settings: TraceSettings, faults: Faults) -> tuple[float, float]:
    """Return the time of the first sample and the step, both in us."""
    times, rate = parsed.columns.get("time_us"), settings.sampling_rate_mhz
    if times is None:
        if rate is None:
            faults.add(
                "the sampling rate is missing; give a column time_us, `sampling_rate_mhz=...` or "
                "'# sampling_rate_mhz = 50'"
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
