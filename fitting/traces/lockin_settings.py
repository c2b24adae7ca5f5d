"""What a trace says about its measurement besides the samples: `# key = value` comments, HDF5 attributes, options."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from fitting.tables.csv_text import DECIMAL_COMMA, NUMBER, Faults, nearest_name, quoted
from fitting.tables.table_comments import KEY_AND_VALUE, LOWEST_QUALITY_FACTOR, PLUS_MINUS, SHORT_NAMES

LOWEST: dict[str, float] = {
    "sampling_rate_mhz": 0.0,
    "drive_frequency_khz": 0.0,
    "drive_amplitude_nm": 0.0,
    "offset_nm": float("-inf"),
    "drive_phase_deg": float("-inf"),
    "free_frequency_khz": 0.0,
    "quality_factor": LOWEST_QUALITY_FACTOR,
    "quality_factor_error": 0.0,
    "mass_ng": 0.0,
    "rest_nm": float("-inf"),
}
"""The settings, and what each must lie above."""

_EXAMPLES = {"sampling_rate_mhz": "50", "drive_frequency_khz": "180", "quality_factor": "40 (or 40 +- 2)"}


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
        quality_factor: of the cantilever.
        quality_factor_error: its standard error.
        mass_ng: effective mass.
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
    rest_nm: float | None = None


def settings_of_comments(comments: list[tuple[int, str]], faults: Faults) -> tuple[dict[str, float], tuple[str, ...]]:
    """Return the settings that comment lines make, and the other comments.

    Args:
        comments: line number and text (without the number sign, stripped) of each.
        faults: where a misspelt key, a value that is no number and a repeated key are noted.
    """
    found: dict[str, float] = {}
    remarks = []
    for line, text in comments:
        key = _meant(text)
        if key is None:
            remarks.append(text)
        elif key in found:
            faults.add(f"{key} is given a second time; remove one of the two", line=line)
        else:
            found |= _setting(key, text, line=line, faults=faults)
    return found, tuple(remarks)


def _meant(text: str) -> str | None:
    match = KEY_AND_VALUE.fullmatch(text)
    if match is None or len(match["key"].split()) > 4:
        return None
    return SHORT_NAMES.get(match["key"].lower()) or nearest_name(match["key"], LOWEST)


def _setting(key: str, text: str, *, line: int, faults: Faults) -> dict[str, float]:
    match = KEY_AND_VALUE.fullmatch(text)
    example = f"# {key} = {_EXAMPLES.get(key, '1')}"
    if match is None or match["key"] != key or match["sign"] is None:
        faults.add(f"{quoted(text)} is no known setting; the key is {key}, as in '{example}'", line=line)
        return {}
    cells = [cell.strip() for cell in PLUS_MINUS.split(match["value"].rstrip(",; \t"))]
    for cell in cells:
        if not NUMBER.fullmatch(cell):
            advice = "write the decimal comma as a point" if DECIMAL_COMMA.fullmatch(cell) else f"write '{example}'"
            faults.add(f"{key} has {quoted(cell)} where a number must stand; {advice}, without the unit", line=line)
            return {}
    if len(cells) > (2 if key == "quality_factor" else 1):
        faults.add(f"{key} takes no such error; write '{example}'", line=line)
        return {}
    names = (key, f"{key}_error")
    return {name: _checked(name, float(cell), faults, line=line) for name, cell in zip(names, cells, strict=False)}


def settings_of_attributes(attributes: Mapping[str, Any], faults: Faults) -> dict[str, float]:
    """Return the settings among the attributes of an HDF5 file; attributes of other names are left alone.

    Args:
        attributes: by name.
        faults: where a value that is no number is noted.
    """
    found = {}
    for name in LOWEST:
        if name in attributes:
            try:
                found[name] = _checked(name, float(attributes[name]), faults)
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
        if name not in LOWEST:
            raise TypeError(f"there is no setting `{name}`; the settings are {', '.join(LOWEST)}")
        _checked(name, value, faults)
    # the error of a quality factor belongs to the value that it was stated with
    if "quality_factor" in stated:
        found = {name: value for name, value in found.items() if name != "quality_factor_error"}
    return TraceSettings(**(dict(found) | stated))


def _checked(name: str, value: float, faults: Faults, *, line: int = 0) -> float:
    lowest = LOWEST[name]
    if not lowest < value < float("inf"):
        above = "" if lowest == float("-inf") else f" and above {lowest:g}"
        faults.add(f"{name} must be finite{above}, but is {value!r}; correct it", line=line)
    return value
