"""A resonance sweep as plain CSV."""

import numpy as np

from fitting.resonance.sweep_rows import NumberedLines, ParsedSweep, parse_cells
from fitting.tables.table_columns import NUMBER, nearest_name
from fitting.tables.table_faults import Faults, quoted
from fitting.tables.table_rows import split_cells

HZ_PER_KHZ = 1e3

ATTRIBUTES = {
    "frequency_khz": "frequency_khz",
    "frequency_hz": "frequency_khz",
    "amplitude_nm": "amplitude",
    "amplitude": "amplitude",
    "phase_deg": "phase_deg",
    "amplitude_error_nm": "amplitude_error",
    "amplitude_error": "amplitude_error",
    "phase_error_deg": "phase_error_deg",
}
"""The columns a file may have, and the attribute of `ResonanceSweep` that each becomes."""


def parse_csv(lines: NumberedLines, faults: Faults) -> ParsedSweep:
    """Read the lines of a CSV file.

    Args:
        lines: all of them, numbered.
        faults: where faults are noted; with any, the result is not to be used.

    Raises:
        TableError: at once where the column names are wrong: the cells below them cannot be judged.
    """
    remarks = tuple(text.strip()[1:].strip() for _, text in lines if text.strip().startswith("#"))
    rows = [(line, text) for line, text in lines if text.strip(",; \t") and not text.strip().startswith("#")]
    if not rows:
        faults.add("the file holds only comments; add a row of column names and rows of numbers")
        faults.raise_any()
    line, text = rows.pop(0)
    _check_delimiter(text, line=line, faults=faults)
    names = split_cells(text)
    _check_names(names, line=line, faults=faults)
    if not rows and not faults.count:
        faults.add("there are column names but no rows below them; add a row for each point", line=line)
    faults.raise_any()
    columns, numbers = parse_cells([(number, split_cells(row)) for number, row in rows], names, names, faults)
    if "frequency_hz" in columns:
        columns["frequency_hz"] = columns["frequency_hz"] / HZ_PER_KHZ
    unit = "nm" if "amplitude_nm" in names else ""
    attributes = {ATTRIBUTES[name]: np.asarray(column) for name, column in columns.items()}
    return ParsedSweep(attributes, numbers, unit, remarks=tuple(remark for remark in remarks if remark))


def _check_delimiter(names: str, *, line: int, faults: Faults) -> None:
    if "," in names:
        return
    for sign, word in ((";", "semicolons"), ("\t", "tabs"), (" ", "spaces")):
        if sign in names.strip():
            advice = "separate them by commas, decimals by points (Nanonis text needs its line [DATA])"
            faults.add(f"the columns are separated by {word}; {advice}", line=line)
            faults.raise_any()


def _check_names(names: list[str], *, line: int, faults: Faults) -> None:
    """Note unknown and doubled names and missing columns; names that were meant for others say so."""
    if any(NUMBER.fullmatch(name) for name in names):
        faults.add("the first row holds numbers; put the row of column names above it", line=line)
        return
    meant = set()
    for position, name in enumerate(names, start=1):
        if not name:
            faults.add(f"column {position} has no name; name it or remove its comma", line=line)
        elif name not in ATTRIBUTES:
            suggestion = nearest_name(name, ATTRIBUTES)
            advice = f"did you mean {suggestion}?" if suggestion else f"the columns are {', '.join(ATTRIBUTES)}"
            faults.add(f"unknown column {quoted(name)}; {advice}", line=line)
            meant.add(ATTRIBUTES.get(suggestion or ""))
        elif ATTRIBUTES[name] in meant:
            faults.add("says again what another column says; remove one", line=line, column=name)
        meant.add(ATTRIBUTES.get(name))
    for attribute, advice in (("frequency_khz", "frequency_khz or frequency_hz"), ("amplitude", "amplitude_nm")):
        if attribute not in meant:
            faults.add(f"there is no {attribute.split('_')[0]} column; add {advice}", line=line)
