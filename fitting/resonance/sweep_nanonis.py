"""A resonance sweep as Nanonis writes it: a header of tab-separated lines, then a block of data.

The columns read are ``Frequency Shift (Hz)`` with ``Center Frequency (Hz)`` (or ``Frequency (Hz)``), ``Amplitude (m)``
and, where it is there, ``Phase (deg)``; others are passed over.
"""

from fitting.resonance.sweep_csv import HZ_PER_KHZ, SWEEP, ParsedSweep
from fitting.tables.csv_text import NUMBER, Faults, parse_cells

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
