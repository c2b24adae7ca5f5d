"""Free resonance sweeps: read them from plain CSV or Nanonis text, check them.

The plain form is a CSV file in UTF-8 with comment lines and a row of column names::

    # driven by the dither piezo, 20 mV
    frequency_khz,amplitude_nm,phase_deg
    89.0,0.512,12.4

The frequency stands in ``frequency_khz`` or ``frequency_hz``, the amplitude in ``amplitude_nm`` or ``amplitude`` (any
unit); ``phase_deg``, ``amplitude_error_nm`` (or ``amplitude_error``) and ``phase_error_deg`` may join them. The Nanonis
form is recognised by its line ``[DATA]``.

A thermal spectrum is a sweep whose amplitude is the root of a spectral density: NanoSurf's .nid, or a CSV file with
``asd_nm_per_sqrt_hz`` or ``psd_nm2_per_hz`` and a comment ``# averages = 1000``, the number of spectra averaged.

Nanonis writes a header of tab-separated lines, then a block of data. The columns read are ``Frequency Shift (Hz)`` with
``Center Frequency (Hz)`` (or ``Frequency (Hz)``), ``Amplitude (m)`` and, where it is there, ``Phase (deg)``; others are
passed over.
"""

import contextlib
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from afm_jax.checks import checked
from afm_jax.results import Result, public_result
from afm_jax.whole_files import first_bytes
from fitting.instruments.formats import holds_curves, read_recording
from fitting.instruments.recording import UNITS, Recording
from fitting.tables.csv_text import (
    NUMBER,
    Column,
    Faults,
    FileSetting,
    Form,
    TableError,
    beyond,
    check_not_empty,
    column_of,
    named_rows,
    parse_cells,
    parse_rows,
    read_text,
    said_beyond,
    settings_in,
    split_lines,
)

HZ_PER_KHZ = 1e3

SWEEP = Form(
    (
        Column("frequency_khz", needed="frequency"),
        Column("frequency_hz", meaning="frequency_khz", needed="frequency"),
        Column("amplitude_nm", meaning="amplitude", needed="amplitude"),
        Column("amplitude", meaning="amplitude", needed="amplitude"),
        Column("asd_nm_per_sqrt_hz", meaning="amplitude", needed="amplitude"),
        Column("psd_nm2_per_hz", meaning="amplitude", needed="amplitude"),
        Column("phase_deg"),
        Column("amplitude_error_nm", meaning="amplitude_error"),
        Column("amplitude_error"),
        Column("phase_error_deg"),
    ),
    "point",
    separators=" (Nanonis text needs its line [DATA])",
)
"""The columns a file may have, and the attribute of `ResonanceSweep` that each becomes."""


DENSITY = "nm/sqrt(Hz)"
"""The unit that makes a sweep a thermal spectrum."""
SPECTRUM_SETTINGS = {"averages": FileSetting("averages", "1000", lowest=0.5)}


@dataclass(frozen=True)
class ParsedSweep:
    """What a file says, in the names and units of `ResonanceSweep`."""

    columns: dict[str, Float[np.ndarray, " points"]]
    lines: Int[np.ndarray, " points"]
    amplitude_unit: str
    instrument: dict[str, float] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()
    averages: float | None = None


def parse_csv(text: str, faults: Faults) -> ParsedSweep:
    """Read the text of a CSV file.

    Args:
        text: all of it.
        faults: where faults are noted; with any, the result is not to be used.

    Raises:
        TableError: at once where the column names are wrong: the cells below them cannot be judged.
    """
    comments, rows = split_lines(text)
    settings, _ = settings_in(comments, SPECTRUM_SETTINGS, faults)
    check_not_empty(comments, rows, faults)
    head, rows = named_rows(rows, SWEEP, faults)
    faults.raise_any()
    columns, _, lines = parse_rows(rows, head.names, SWEEP, faults)
    if "frequency_hz" in columns:
        columns["frequency_hz"] = columns["frequency_hz"] / HZ_PER_KHZ
    unit = "nm" if "amplitude_nm" in columns else ""
    if "psd_nm2_per_hz" in columns:
        columns["psd_nm2_per_hz"] = np.sqrt(np.maximum(columns["psd_nm2_per_hz"], 0.0))
    if {"psd_nm2_per_hz", "asd_nm_per_sqrt_hz"} & set(columns):
        unit = DENSITY
    attributes = {column.says: columns[column.name] for column in SWEEP.columns if column.name in columns}
    remarks = tuple(remark for _, remark in comments)
    return ParsedSweep(attributes, lines, unit, remarks=remarks, averages=settings.get("averages", (None,))[0])


MARK = "[DATA]"
"""The line above the block of data."""

SHIFT, CENTRE, FREQUENCY = "Frequency Shift (Hz)", "Center Frequency (Hz)", "Frequency (Hz)"
AMPLITUDE, PHASE = "Amplitude (m)", "Phase (deg)"
NM_PER_M = 1e9
_FOUND = {"f_res (Hz)": ("frequency_khz", 1.0 / HZ_PER_KHZ), "Q": ("quality_factor", 1.0)}
_REMARKS = ("Experiment", "Date", "User", "Comment01")


def parse_nanonis(text: str, faults: Faults) -> ParsedSweep:
    """Read the text of a Nanonis file.

    Args:
        text: all of it; one of its lines is `MARK`.
        faults: where faults are noted; with any, the result is not to be used.

    Raises:
        TableError: at once where a column is missing: the cells cannot be judged then.
    """
    lines = list(enumerate(text.split("\n"), start=1))
    start = next(position for position, (_, line) in enumerate(lines) if line.strip() == MARK)
    header = [_cells(line) for _, line in lines[:start]]
    settings = {cells[0]: cells[1] for cells in header if len(cells) > 1 and cells[1]}
    rows = [(number, _cells(line)) for number, line in lines[start + 1 :] if line.strip()]
    if not rows:
        faults.add(f"there is nothing below {MARK}; export the sweep again", line=lines[start][0])
        faults.raise_any()
    names_line, names = rows.pop(0)
    by_shift = FREQUENCY not in names
    wanted = ([SHIFT, CENTRE] if by_shift else [FREQUENCY]) + [AMPLITUDE]
    missing = [name for name in wanted if name not in names]
    if missing:
        what = "column is" if len(missing) == 1 else "columns are"
        faults.add(f"the {what} missing: {', '.join(missing)}; export the sweep with it", line=names_line)
    elif not rows:
        faults.add("there are column names but no rows below them; export the sweep again", line=names_line)
    faults.raise_any()
    wanted += [PHASE] if PHASE in names else []
    columns, _, numbers = parse_cells(rows, names, wanted, SWEEP, faults)
    frequency_hz = columns[SHIFT] + columns[CENTRE] if by_shift else columns[FREQUENCY]
    attributes = {"frequency_khz": frequency_hz / HZ_PER_KHZ, "amplitude": columns[AMPLITUDE] * NM_PER_M}
    if PHASE in columns:
        attributes["phase_deg"] = columns[PHASE]
    found = {
        key: float(settings[name]) * factor
        for name, (key, factor) in _FOUND.items()
        if NUMBER.fullmatch(settings.get(name, ""))
    }
    remarks = tuple(f"{name}: {settings[name]}" for name in _REMARKS if name in settings)
    return ParsedSweep(attributes, numbers, "nm", instrument=found, remarks=remarks)


def _cells(text: str) -> list[str]:
    cells = [cell.strip() for cell in text.split("\t")]
    # The header's lines end with a tab, those of the data may.
    return cells[:-1] if len(cells) > 1 and not cells[-1] else cells


_COLUMNS = ("frequency_khz", "amplitude", "phase_deg", "amplitude_error", "phase_error_deg")
_POSITIVE = ("frequency_khz", "amplitude_error", "phase_error_deg")


@public_result()
@dataclass(frozen=True, eq=False, kw_only=True)
class ResonanceSweep(Result):
    """A free resonance sweep, sorted by frequency; the arrays are read-only NumPy copies.

    Attributes:
        frequency_khz: of the drive, shape (points,); repeated measurements at one frequency are allowed.
        amplitude: of the response, shape (points,), in ``amplitude_unit``.
        phase_deg: of the response, z = amplitude cos(omega t + phase), shape (points,), or None.
        amplitude_error: standard error of the amplitude, shape (points,), or None: not known.
        phase_error_deg: standard error of the phase; None takes the noise as equal in all directions.
        amplitude_unit: "nm", empty where the file does not say, "nm/sqrt(Hz)" of a thermal spectrum.
        instrument: what the instrument itself found, for comparison: ``frequency_khz``, ``quality_factor``; of a
            thermal spectrum also ``spring_constant_n_per_m`` and ``temperature_k``.
        averages: how many periodograms a thermal spectrum is the mean of, or None: not known.
        source: path of the file as it was given.
        lines: the line of the file that each point stands in, shape (points,).
        remarks: free comments of the file.
        reordered: the frequencies did not rise from point to point, so the points were sorted.

    Raises:
        TableError: if a value is impossible, the lengths differ, or there are errors without what they belong to.
    """

    frequency_khz: Float[np.ndarray, " points"]
    amplitude: Float[np.ndarray, " points"]
    phase_deg: Float[np.ndarray, " points"] | None = None
    amplitude_error: Float[np.ndarray, " points"] | None = None
    phase_error_deg: Float[np.ndarray, " points"] | None = None
    amplitude_unit: str = "nm"
    instrument: dict[str, float] = field(default_factory=dict)
    averages: float | None = None
    source: str = "sweep in memory"
    lines: Int[np.ndarray, " points"] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    remarks: tuple[str, ...] = ()
    reordered: bool = field(default=False, init=False)

    def __post_init__(self):
        faults = Faults(self.source, place="line" if len(self.lines) else "row")
        columns = {name: getattr(self, name) for name in _COLUMNS if getattr(self, name) is not None}
        points = np.size(self.frequency_khz)
        lines = np.array(self.lines if len(self.lines) else np.arange(1, points + 1), dtype=np.int64)
        arrays = {name: column_of(name, values, len(lines), faults) for name, values in columns.items()}
        _check_pairs(arrays, faults)
        faults.raise_any()
        for name, values in arrays.items():
            _check_numbers(name, values, lines, faults)
        faults.raise_any()
        # The sort is stable: repeated measurements at one frequency keep their order.
        order = np.argsort(arrays["frequency_khz"], kind="stable")
        falling = np.array_equal(order, np.arange(points)[::-1])
        rising = np.array_equal(order, np.arange(points))
        object.__setattr__(self, "reordered", not (rising or falling))
        for name, values in (arrays | {"lines": lines}).items():
            ordered = values[order]
            ordered.setflags(write=False)
            object.__setattr__(self, name, ordered)

    @property
    def points(self) -> int:
        """The number of points of the frequency scan."""
        return len(self.frequency_khz)

    @property
    def spectrum(self) -> bool:
        """Whether it is a thermal spectrum."""
        return self.amplitude_unit == DENSITY

    def within(self, low_khz: float, high_khz: float) -> "ResonanceSweep":
        """Return the points between two frequencies; of a spectrum those that are above zero.

        Raises:
            TableError: if there are none.
        """
        kept = (self.frequency_khz >= low_khz) & (self.frequency_khz <= high_khz) & (self.amplitude > 0.0)
        if not kept.any():
            raise TableError(f"{self.source}: there is no point between {low_khz:g} and {high_khz:g} kHz")
        columns = {name: getattr(self, name) for name in (*_COLUMNS, "lines")}
        return replace(self, **{name: None if column is None else column[kept] for name, column in columns.items()})


def _check_pairs(columns: dict[str, Float[np.ndarray, "..."]], faults: Faults) -> None:
    if "phase_error_deg" in columns and "phase_deg" not in columns:
        faults.add("stands without phase_deg; add that column or remove this one", column="phase_error_deg")
    if "phase_error_deg" in columns and "amplitude_error" not in columns:
        faults.add("the phase has errors but the amplitude has none; add amplitude_error or remove phase_error_deg")


def _check_numbers(
    name: str, values: Float[np.ndarray, " points"], lines: Int[np.ndarray, " points"], faults: Faults
) -> None:
    bad, what = ~np.isfinite(values), "must be finite"
    if name in _POSITIVE:
        bad, what = bad | (values <= 0.0), "must be finite and above 0"
    elif name == "amplitude":
        bad, what = bad | (values < 0.0), "must be finite and not negative"
    far = beyond(values, positive=name in _POSITIVE or name == "amplitude")
    for row in np.flatnonzero(bad | far):
        number, must = repr(float(values[row])).removesuffix(".0"), said_beyond(values[row]) if far[row] else what
        faults.add(f"{must}, but is {number}; correct it or remove the row", line=int(lines[row]), column=name)


@checked
def read_sweep(path: str | Path) -> ResonanceSweep:
    """Read a free resonance sweep from plain CSV or Nanonis text, or a thermal spectrum, and check all of it.

    Args:
        path: the file; its form is recognised by its content, not by its name.

    Raises:
        TableError: one line that names the first fault, its place and how to mend it, and the number of other faults.
    """
    faults = Faults(str(path))
    with contextlib.suppress(OSError):
        head = first_bytes(path, 4096)
        if head.startswith(b"[DataSet]"):
            return _spectrum_of(read_recording(path))
        if holds_curves(head, str(path)):
            raise TableError(
                f"{path}: holds curves against height, no resonance sweep; --slope reads the sensitivity off force "
                "curves, `afm-jax tapping` the energy of a tap off amplitude and phase"
            )
    text = read_text(path)
    parse = parse_nanonis if any(line.strip() == MARK for line in text.split("\n")) else parse_csv
    parsed = parse(text, faults)
    faults.raise_any()
    arrays = {name: parsed.columns.get(name) for name in _COLUMNS}
    frequency, amplitude = arrays.pop("frequency_khz"), arrays.pop("amplitude")
    if frequency is None or amplitude is None:
        raise TableError(f"{path}: the frequency or the amplitude is missing; add its column")
    return ResonanceSweep(
        frequency_khz=frequency,
        amplitude=amplitude,
        **arrays,
        amplitude_unit=parsed.amplitude_unit,
        instrument=parsed.instrument,
        source=str(path),
        averages=parsed.averages,
        lines=parsed.lines,
        remarks=parsed.remarks,
    )


def _spectrum_of(recording: Recording) -> ResonanceSweep:
    """Return the thermal spectrum that a file of an instrument holds.

    Raises:
        TableError: if it holds none.
    """
    units, channels = recording.units, recording.segments[0].channels
    density = next((name for name in channels if UNITS.get(units[name], ("",))[0] == "spectrum"), None)
    frequency = next((name for name in channels if UNITS.get(units[name], ("",))[0] == "frequency"), None)
    if density is None or frequency is None:
        raise TableError(f"{recording.source}: holds no thermal spectrum, but {', '.join(channels)}")
    khz, amplitude = (channels[name] * UNITS[units[name]][1] for name in (frequency, density))
    used = (khz > 0.0) & (amplitude > 0.0)
    known = {key.removeprefix("free_"): one.value for key, one in recording.known.items()}
    found = {key: float(known[key]) for key in _FOUND_IN_SPECTRA if key in known}
    return ResonanceSweep(
        frequency_khz=khz[used],
        amplitude=amplitude[used],
        amplitude_unit=DENSITY,
        instrument=found,
        averages=float(known["averages"]) if "averages" in known else None,
        source=recording.source,
    )


_FOUND_IN_SPECTRA = ("frequency_khz", "quality_factor", "spring_constant_n_per_m", "temperature_k")


def without_phase(sweep: ResonanceSweep) -> ResonanceSweep:
    """Return a sweep without its phase, to be fitted by the amplitude alone."""
    return replace(sweep, phase_deg=None, phase_error_deg=None)
