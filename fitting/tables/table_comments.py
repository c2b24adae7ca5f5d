"""The comment lines of an amplitude table: what `# key = value` says about the cantilever, and free remarks."""

import re
from dataclasses import dataclass

from fitting.tables.csv_text import DECIMAL_COMMA, NUMBER, Faults, nearest_name, quoted

EXAMPLES = {
    "free_frequency_khz": "# free_frequency_khz = 90",
    "quality_factor": "# quality_factor = 40 (or 40 +- 2)",
    "mass_ng": "# mass_ng = 1",
    "tip_calibration": "# tip_calibration = 1 +- 0.02",
    "drive_calibration": "# drive_calibration = 1 +- 0.02",
    "offset_origin_nm": "# offset_origin_nm = 0 +- 0.3",
}
"""The known keys, each as a line that a message can show."""

CALIBRATION = ("tip_calibration", "drive_calibration", "offset_origin_nm")
"""Keys that must have an error: without one there is nothing uncertain about them."""

SHORT_NAMES = {
    "q": "quality_factor",
    "q_factor": "quality_factor",
    "f0": "free_frequency_khz",
    "f_0": "free_frequency_khz",
}
"""What people call a key, too far from its name for a comparison of letters."""

# A colon makes a key only in front of a number: "Measured: Tuesday" is a remark.
KEY_AND_VALUE = re.compile(r"\s*(?P<key>[^=:]+?)\s*(?:(?P<sign>=)|:(?=\s*[-+.\d]))(?P<value>.*)", re.DOTALL)
PLUS_MINUS = re.compile(r"\+-|\+/-|±")
# An overdamped cantilever does not vibrate.
LOWEST_QUALITY_FACTOR = 0.5


@dataclass(frozen=True)
class Header:
    """What the comment lines say; the names and units are those of ``AmplitudeTable``."""

    free_frequency_khz: float
    quality_factor: float | None
    quality_factor_error: float | None
    mass_ng: float
    calibration: dict[str, tuple[float, float]]
    remarks: tuple[str, ...]


def known_key(text: str) -> str | None:
    """Return the known key that a comment sets or was meant to set, or None for a free remark.

    Args:
        text: the comment without its number sign.
    """
    match = KEY_AND_VALUE.fullmatch(text)
    if match is None or len(match["key"].split()) > 4:
        return None
    short = SHORT_NAMES.get(match["key"].lower())
    return short or nearest_name(match["key"], EXAMPLES)


def parse_comments(comments: list[tuple[int, str]], faults: Faults) -> Header:
    """Read the comment lines of a table.

    Args:
        comments: line number and text (without the number sign, stripped) of each.
        faults: where the faults are noted; with any, the result is not to be used.
    """
    numbers: dict[str, tuple[float, float | None]] = {}
    seen: dict[str, int] = {}
    remarks: list[str] = []
    for line, text in comments:
        key = known_key(text)
        if key is None:
            remarks.append(text)
            continue
        if key in seen:
            faults.add(f"{key} was given in line {seen[key]} already; remove one of the two", line=line)
            continue
        seen[key] = line
        numbers[key] = _parse_setting(key, text, line=line, faults=faults)
    if "free_frequency_khz" not in seen:
        example = EXAMPLES["free_frequency_khz"]
        faults.add(f"the free frequency is missing; add a line such as '{example}' above the column names")
    quality_factor, quality_factor_error = numbers.get("quality_factor", (None, None))
    return Header(
        free_frequency_khz=numbers.get("free_frequency_khz", (float("nan"), None))[0],
        quality_factor=quality_factor,
        quality_factor_error=quality_factor_error,
        mass_ng=numbers.get("mass_ng", (1.0, None))[0],
        calibration={key: (numbers[key][0], numbers[key][1] or 0.0) for key in CALIBRATION if key in numbers},
        remarks=tuple(remarks),
    )


def _parse_setting(key: str, text: str, *, line: int, faults: Faults) -> tuple[float, float | None]:
    """Return the value and its error of a comment that sets a key, or NaN and None after noting a fault."""
    match = KEY_AND_VALUE.fullmatch(text)
    if match is None or match["key"] != key or match["sign"] is None:
        unit = {"free_frequency_khz": " (in kHz)", "mass_ng": " (in ng)"}.get(key, "")
        faults.add(f"{quoted(text)} is no known setting; the key is {key}{unit}, as in '{EXAMPLES[key]}'", line=line)
        return float("nan"), None
    # Spreadsheets fill every line up with commas.
    cells = [cell.strip() for cell in PLUS_MINUS.split(match["value"].rstrip(",; \t"))]
    fault = _fault_in_value(key, cells)
    if fault is not None:
        faults.add(f"{key} {fault}", line=line)
        return float("nan"), None
    return float(cells[0]), float(cells[1]) if len(cells) > 1 else None


def _fault_in_value(key: str, cells: list[str]) -> str | None:
    """Return what is wrong with the value (and its error) of a key, or None."""
    for cell in cells:
        if DECIMAL_COMMA.fullmatch(cell):
            return f"is {quoted(cell)}; write the decimal comma as a point"
        if not NUMBER.fullmatch(cell):
            return f"has {quoted(cell)} where a number must stand; write '{EXAMPLES[key]}', without the unit"
    if len(cells) > 2 or (len(cells) == 2 and key not in {"quality_factor", *CALIBRATION}):
        return f"takes no such error; write '{EXAMPLES[key]}'"
    if len(cells) == 1 and key in CALIBRATION:
        return f"needs its standard error; write '{EXAMPLES[key]}', or correct the columns and remove this line"
    return fault_in_number(key, *map(float, cells))


def fault_in_number(key: str, value: float, error: float | None = None) -> str | None:
    """Return what is wrong with a key's number or its standard error, or None.

    Args:
        key: one of ``EXAMPLES``.
        value: its value, in the unit of its name.
        error: its standard error in the same unit, or None.
    """
    lowest = {"quality_factor": LOWEST_QUALITY_FACTOR, "offset_origin_nm": -float("inf")}.get(key, 0.0)
    if not lowest < value < float("inf"):
        return f"must be finite and above {lowest:g}, but is {value!r}; correct it"
    if error is not None and not 0.0 < error < float("inf"):
        return f"has the error {error!r}; it must be finite and above 0, or left out"
    return None
