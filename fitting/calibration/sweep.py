"""Free resonance sweeps: read them from plain CSV or Nanonis text, check them.

The plain form is a CSV file in UTF-8 with comment lines and a row of column names::

    # driven by the dither piezo, 20 mV
    frequency_khz,amplitude_nm,phase_deg
    89.0,0.512,12.4

The frequency stands in ``frequency_khz`` or ``frequency_hz``, the amplitude in ``amplitude_nm`` or ``amplitude`` (any
unit); ``phase_deg`` and ``amplitude_error_nm`` (or ``amplitude_error``) may join them. The Nanonis form is recognised
by its line ``[DATA]``.

A thermal spectrum is a sweep whose amplitude is the root of a spectral density: NanoSurf's .nid, or a CSV file with
``asd_nm_per_sqrt_hz`` or ``psd_nm2_per_hz``.

Nanonis writes a header of tab-separated lines, then a block of data. The columns read are ``Frequency Shift (Hz)`` with
``Center Frequency (Hz)`` (or ``Frequency (Hz)``), ``Amplitude (m)`` and, where it is there, ``Phase (deg)``; others are
passed over.
"""

import contextlib
import re
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from afm_jax.checks import checked
from afm_jax.results import Result, public_result
from afm_jax.whole_files import first_bytes
from fitting.instruments.formats import read_recording
from fitting.instruments.recording import UNITS, Recording
from fitting.tables.csv_text import Column, Form, Source, TableError, column_of, read_columns

DENSITY = "nm/sqrt(Hz)"
"""The unit that makes a sweep a thermal spectrum."""


_SIZE: dict[str, Any] = {"kind": "not negative", "meaning": "amplitude", "needed": "amplitude"}
SWEEP = Form(
    (
        Column("frequency_khz", needed="frequency"),
        Column("frequency_hz", meaning="frequency_khz", needed="frequency", convert=lambda hertz: 1e-3 * hertz),
        Column("amplitude_nm", **_SIZE),
        Column("amplitude", **_SIZE),
        Column("asd_nm_per_sqrt_hz", **_SIZE),
        Column("psd_nm2_per_hz", convert=lambda power: np.sqrt(np.maximum(power, 0.0)), **_SIZE),
        Column("phase_deg", kind="number"),
        Column("amplitude_error_nm", meaning="amplitude_error"),
        Column("amplitude_error"),
    ),
)
"""The columns that a CSV file may have, and the attribute of `Resonance` that each becomes."""
_UNITS = {"amplitude_nm": "nm", "asd_nm_per_sqrt_hz": DENSITY, "psd_nm2_per_hz": DENSITY}
_COLUMNS = ("frequency_khz", "amplitude", "phase_deg", "amplitude_error")


@public_result()
@dataclass(frozen=True, eq=False, kw_only=True)
class Resonance(Result):
    """A free resonance sweep, sorted by frequency; the arrays are read-only NumPy copies.

    Attributes:
        frequency_khz: of the drive, shape (points,); repeated measurements at one frequency are allowed.
        amplitude: of the response, shape (points,), in ``amplitude_unit``.
        phase_deg: of the response, z = amplitude cos(omega t + phase), shape (points,), or None.
        amplitude_error: standard error of the amplitude, shape (points,), or None: not known. With a phase it is that
            of the response in all directions.
        amplitude_unit: "nm", empty where the file does not say, "nm/sqrt(Hz)" of a thermal spectrum.
        instrument: what the instrument itself found, for comparison: ``frequency_khz``, ``quality_factor``; of a
            thermal spectrum also ``spring_constant_n_per_m``, and ``temperature_k`` if it says that.
        averages: how many periodograms a thermal spectrum is the mean of; None: not known.
        source: path of the file as it was given.

    Raises:
        TableError: if a value is impossible, or the lengths differ.
    """

    frequency_khz: Float[np.ndarray, " points"]
    amplitude: Float[np.ndarray, " points"]
    phase_deg: Float[np.ndarray, " points"] | None = None
    amplitude_error: Float[np.ndarray, " points"] | None = None
    amplitude_unit: str = "nm"
    instrument: dict[str, float] = field(default_factory=dict)
    averages: float | None = None
    source: str = "sweep in memory"

    def __post_init__(self):
        source = Source(self.source, "row")
        points = np.size(self.frequency_khz)
        columns = {name: getattr(self, name) for name in _COLUMNS if getattr(self, name) is not None}
        arrays = {name: column_of(name, values, points, source) for name, values in columns.items()}
        for name, values in arrays.items():
            SWEEP.check_numbers(name, values, np.arange(1, points + 1), source)
        # The sort is stable: repeated measurements at one frequency keep their order.
        order = np.argsort(arrays["frequency_khz"], kind="stable")
        for name, values in arrays.items():
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

    @property
    def model(self) -> str:
        """What is fitted: a "power" spectrum, the "amplitude", or amplitude and "phase"."""
        return "power" if self.spectrum else "amplitude" if self.phase_deg is None else "phase"

    @property
    def position(self) -> Float[np.ndarray, " points"]:
        """Where the points lie: from -1 to 1 over the scan."""
        start, end = self.frequency_khz[[0, -1]]
        return (2.0 * self.frequency_khz - start - end) / max(end - start, 1e-300)

    def within(self, low_khz: float, high_khz: float) -> "Resonance":
        """Return the points between two frequencies; of a spectrum those that are above zero."""
        kept = (self.frequency_khz >= low_khz) & (self.frequency_khz <= high_khz) & (self.amplitude > 0.0)
        columns = {name: column[kept] for name in _COLUMNS if (column := getattr(self, name)) is not None}
        return replace(self, **columns)


@checked
def read_resonance(path: str | Path) -> Resonance:
    """Read a free resonance sweep from plain CSV or Nanonis text, or a thermal spectrum, and check all of it.

    Args:
        path: the file; its form is recognised by its content, not by its name.

    Raises:
        TableError: one line that names the first fault, its place, and how to mend it.
    """
    text = b""
    with contextlib.suppress(OSError):
        text = first_bytes(path, 1 << 16)
    if text.startswith(b"[DataSet]") or _NANONIS.search(text):
        return _sweep_of(read_recording(path))
    used, columns, _ = read_columns(path, SWEEP, {})
    named: dict[str, Any] = {**columns, "amplitude_unit": _UNITS.get(used["amplitude"].name, "")}
    return Resonance(**named, source=str(path))


_NANONIS = re.compile(rb"^\[DATA\]\s*$", re.MULTILINE)
_FOUND = ("frequency_khz", "quality_factor", "spring_constant_n_per_m", "temperature_k")


def _sweep_of(recording: Recording) -> Resonance:
    """Return the thermal spectrum, or the scan in Nanonis text, that a file of an instrument holds.

    Raises:
        TableError: if it holds neither.
    """
    found: dict[str, Float[np.ndarray, " points"]] = {}
    for name, numbers in recording.segments[0].channels.items():
        kind, size = UNITS.get(recording.units[name], ("", 1.0))
        # in this package's unit, by what it measures, and by its name, too
        for key in (kind, f"{kind}: {name}"):
            found.setdefault(key, numbers * size)
    khz, amplitude = found.get("frequency"), found.get("spectrum", found.get("length: Amplitude"))
    if "frequency: Frequency Shift" in found and khz is not None:
        khz = found["frequency: Frequency Shift"] + found.get("frequency: Center Frequency", np.nan)
    if khz is None or amplitude is None:
        raise TableError(
            f"{recording.source}: holds neither a thermal spectrum nor an amplitude in m over the frequency (or its "
            f"shift and the center frequency), but {', '.join(recording.channels)}"
        )
    spectrum = "spectrum" in found
    known = {key.removeprefix("free_"): one.value for key, one in recording.known.items()}
    used = (khz > 0.0) & (amplitude > 0.0) if spectrum else np.ones(len(khz), dtype=bool)
    phase = None if spectrum else found.get("angle: Phase")
    return Resonance(
        frequency_khz=khz[used],
        amplitude=amplitude[used],
        phase_deg=None if phase is None else phase[used],
        amplitude_unit=DENSITY if spectrum else "nm",
        instrument={key: float(known[key]) for key in _FOUND if key in known},
        averages=float(known["averages"]) if "averages" in known else None,
        source=recording.source,
    )
