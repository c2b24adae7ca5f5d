"""What an instrument's file holds before it is interpreted: channels with their units, and what the header says.

Every format becomes the same `Recording`; what its channels mean for a tapping curve or a thermal spectrum is decided
by those who read it further.
"""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from importlib import import_module
from typing import Any

import numpy as np
from jaxtyping import Float

from afm_jax.words import printable
from fitting.tables.csv_text import NUMBER, TableError, given_value

_SIZES = {
    "length": {"m": 1e9, "mm": 1e6, "um": 1e3, "nm": 1.0, "pm": 1e-3},
    "voltage": {"V": 1.0, "mV": 1e-3},
    "angle": {"deg": 1.0, "rad": 180.0 / np.pi},
    "frequency": {"Hz": 1e-3, "kHz": 1.0, "MHz": 1e3},
    "stiffness": {"N/m": 1.0},
    "sensitivity": {"m/V": 1e9, "nm/V": 1.0},
    "spectrum": {"m/sqrt(Hz)": 1e9, "nm/sqrt(Hz)": 1.0, "pm/sqrt(Hz)": 1e-3, "fm/sqrt(Hz)": 1e-6},
    "voltage spectrum": {"V/sqrt(Hz)": 1.0},
}
UNITS = {unit: (quantity, size) for quantity, sizes in _SIZES.items() for unit, size in sizes.items()}
"""What a unit measures, and its size in this package's unit: nm, V, degrees, kHz, nN, N/m, nm/V, nm per root Hz."""
_SPELLINGS = {"v": "V", "µm": "um", "μm": "um", "°": "deg", "Deg": "deg", "degrees": "deg", "m/√Hz": "m/sqrt(Hz)"}


def unit_named(text: str) -> str:
    """Return the key of `UNITS` for a unit as a file spells it, or the text itself where there is none."""
    plain = re.sub(r"^[\[(](.*)[\])]$", r"\1", text.strip()).strip()
    # NanoSurf writes UTF-8 degree signs that Latin-1 readers take as two letters
    plain = plain.removeprefix("Â")
    return _SPELLINGS.get(plain, plain)


def quantity_of(unit: str) -> str:
    """Return what a unit measures; empty of one that is not in `UNITS`."""
    return UNITS.get(unit, ("", 1.0))[0]


@dataclass(frozen=True)
class Known:
    """Something known about a measurement, and where it comes from.

    Attributes:
        value: in the unit of its key; a word where it is none.
        unit: of a number; empty for a plain one.
        origin: "header: ...", "option ...", "measured: ..." or "assumed: ...".
        error: its standard error, None where not known.
    """

    value: float | str
    unit: str
    origin: str
    error: float | None = None


@dataclass(frozen=True)
class Segment:
    """Channels of equal length that were recorded together.

    Attributes:
        curve: which curve of the file, from 1.
        branch: "approach", "retract", or empty: determined from the height's direction.
        channels: numbers by channel name, in the units of `Recording.units`; of images arrays of rows and columns.
    """

    curve: int
    branch: str
    channels: dict[str, Float[np.ndarray, "..."]]


WAY = re.compile(r"_(Ex|Rt)(?=_|$)")
"""The way, extend or retract, in the name of a channel of Bruker's exports."""


def two_ways(segments: Iterable[Segment], pairs: Mapping[str, Sequence[str]]) -> tuple[Segment, ...]:
    """Return an approach and a retract out of every segment, whose channels are each a pair of its channels."""
    return tuple(
        Segment(segment.curve, branch, {name: segment.channels[pair[way]] for name, pair in pairs.items()})
        for segment in segments
        for way, branch in enumerate(("approach", "retract"))
    )


@dataclass(frozen=True)
class Recording:
    """All that a file holds.

    Attributes:
        format: its name: "neaSNOM text", "WSxM curves", ...
        source: path as it was given.
        segments: in the order of the file; heights grow towards the tip.
        units: unit of every channel, a key of `UNITS` or as the file spells it; empty: the file does not say.
        remarks: what a reader should know of the format.
        settings: what the header says, as the file spells it.
        size_m: height and width of images, or None.
    """

    format: str
    source: str
    segments: tuple[Segment, ...]
    units: Mapping[str, str]
    remarks: tuple[str, ...] = ()
    settings: Mapping[str, str] = field(default_factory=dict)
    size_m: tuple[float, float] | None = None

    @cached_property
    def known(self) -> dict[str, Known]:
        """What the header says, by this package's keys."""
        return known_from(self.settings)

    @property
    def channels(self) -> list[str]:
        """The names of the channels that all segments have, in order."""
        names = list(self.segments[0].channels)
        return [name for name in names if all(name in segment.channels for segment in self.segments)]


def number_in(text: str) -> tuple[float, str] | None:
    """Return the number at the start of a text and the unit behind it; None without one.

    >>> number_in("264,132.610 Hz"), number_in("5.33904 N/m"), number_in("yes")
    ((264132.61, 'Hz'), (5.33904, 'N/m'), None)
    """
    match = NUMBER.match(re.sub(r"(?<=\d),(?=\d{3}(?:\D|$))", "", text.strip()))
    if match is None or abs(float(match[0])) > 1e300:
        return None
    return float(match[0]), unit_named(match.string[match.end() :])


_DRIVE = "Oscillation Control>Center Frequency (Hz)|Conversion Offset 00|Tip Frequency|Vibration freq."
_HEADER = {
    "free_frequency_khz": ("kHz", "Hz", "f_res (Hz)|f0 (Hz)|Resonance frequency|Frequency:|ThermalFrequency"),
    "drive_frequency_khz": ("kHz", "Hz", f"{_DRIVE}|Excitation frequency|DriveFrequency"),
    "quality_factor": ("", "", "Q|Quality factor (Q)|Q Factor:|ThermalQ"),
    "spring_constant_n_per_m": ("N/m", "N/m", "Force constant|Spring Constant:|SpringConstant"),
    "free_amplitude_nm": ("nm", "", ""),
    "nm_per_volt": ("nm/V", "m/V", "AmpInvOLS"),
    "averages": ("", "", "Averages"),
}
"""What headers say that matters here: its unit, the one where a text holds none, and its names in all formats; by its
own name it stands in its own unit."""


def known_from(header: Mapping[str, str]) -> dict[str, Known]:
    """Return what the lines of a header say of the measurement, in this package's units.

    Args:
        header: texts by the names that the file gives them.
    """
    found = {}
    for key, (own_unit, usual, names) in _HEADER.items():
        for name in (key, *names.split("|")):
            said = number_in(header.get(name, ""))
            if said is not None and said[0] > 0.0:
                quantity, factor = UNITS.get(said[1] or (own_unit if name == key else usual), ("", 1.0))
                if quantity == quantity_of(own_unit):
                    # twelve digits: a change of unit must not add others
                    found[key] = Known(float(f"{said[0] * factor:.12g}"), own_unit, f"header: {name}")
    warm = number_in(header.get("Cantilever temperature", ""))
    if warm is not None and -100.0 < warm[0] < 500.0:
        origin = "header: Cantilever temperature, assumed in degrees Celsius"
        found["temperature_k"] = Known(warm[0] + 273.15, "K", origin)
    return found


UNIT_OF = {key: unit for key, (unit, _, _) in _HEADER.items() if key != "averages"}
UNIT_OF |= {"free_phase_deg": "deg", "tip_calibration": "", "offset_origin_nm": "nm"}
"""Numbers of lever, drive and instrument that a caller may give, with their units."""


def given_numbers(numbers: Mapping[str, Any], units: Mapping[str, str]) -> dict[str, Known]:
    """Return what a caller gives of the instrument, by name.

    Args:
        numbers: each a number, a pair with its standard error or a text such as '44 +- 4'; None: not given.
        units: of those that may be given.

    Raises:
        TypeError: if there is none of a name.
        ValueError: if a value is impossible.
    """
    found = {}
    for key, given in numbers.items():
        if key not in units:
            raise TypeError(f"there is no option `{key}`; it is one of {', '.join(units)}")
        if given is not None:
            number, error = given_value(key, given, any_sign=key in {"free_phase_deg", "offset_origin_nm"})
            found[key] = Known(number, units[key], f"option `{key}=...`", error)
    return found


ASSUMED_RESONANCE = "assumed: on resonance, at the free frequency; else `drive_frequency_khz=...`"
"""Origin of a drive's frequency that nobody gave."""


def package_for(module: str, extra: str, what: str) -> Any:
    """Return the module of a package that reads some files and comes with one of this package's extras.

    Raises:
        TableError: if it is not installed; the line begins with `what` and says how to install it.
    """
    try:
        return import_module(module)
    except ModuleNotFoundError:
        package = module.partition(".")[0]
        raise TableError(
            f"{what} are read by the package {package}; install it with: pip install 'afm-jax[{extra}]'"
        ) from None


_AMPLITUDE_MODES = re.compile(
    r"\b(ac|am|tapping|dynamic|phase[ -]contrast|(intermittent|semi|non)[ -]?contact)\b", re.IGNORECASE
)
"""What instruments call amplitude modulation."""
_OTHER_MODES = re.compile(
    r"\b(pfm|dart|piezo\w*|contact|static|lateral|friction|force[ -](modulation|mapping|volume)|fm"
    r"|frequency[ -]modulation|pll|stm|kpfm|skpm|efm|mfm|bimodal|dual|peak ?force|scanasyst|hopping|qi|qnm)\b",
    re.IGNORECASE,
)
_MODE_KEYS = re.compile(r"((imaging|operating|operation|op\.|afm|feedback|scan)[ _-]?)?mode", re.IGNORECASE)
_OTHER_CHANNELS = re.compile(
    r"(amp(litude)?|pha?(se?)?)[ _-]*2\b.*|.*\b(lateral|torsion\w*|friction|pfm|piezo\w*|second (eigen)?mode)\b.*",
    re.IGNORECASE,
)
"""Channels of modes in which amplitude and phase are not those of one flexural mode that taps."""


def refuse_other_modes(settings: Mapping[str, str], source: str, channels: Iterable[str] = ()) -> None:
    """Check that a file, where it says in which mode it was recorded, says amplitude modulation (tapping).

    Raises:
        TableError: with the name of the mode, or of the channel that tells it.
    """
    found = [f"holds a channel {name!r}, which is none of" for name in channels if _OTHER_CHANNELS.fullmatch(name)]
    for key, value in settings.items():
        name = re.split(r"::|[/:]", key)[-1].strip()
        other = _MODE_KEYS.fullmatch(name) and _OTHER_MODES.search(_AMPLITUDE_MODES.sub("", value))
        if other or (name == "DualACMode" and value.strip() not in {"", "0"}):
            found.insert(0, f"was recorded in the mode {printable(value)!r} ({printable(key)}), not in")
    if found:
        why = "amplitude modulation (tapping) of one mode; its amplitude and phase do not give the energy of a tap"
        raise TableError(f"{source}: {found[0]} {why}")


@contextmanager
def damaged_as_one_line(source: str) -> Iterator[None]:
    """Turn what a parser raises at a damaged file, in many ways and by others' code, into one line.

    Raises:
        TableError: that line, or the parser's own.
    """
    try:
        yield
    except TableError:
        raise
    except Exception as error:
        what = " ".join(f"{type(error).__name__}: {error}".split())[:120]
        raise cut_off(source, f"cannot be read ({printable(what)})") from error


def cut_off(source: str, what: str) -> TableError:
    """Return the error of a file that ends before it should."""
    return TableError(f"{source}: {what}; the file is damaged or cut off: copy it again from the instrument")
