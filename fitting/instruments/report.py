"""What was read of an instrument's file, as a person reads it and as JSON, and the tables written from it."""

from pathlib import Path
from typing import Any

import numpy as np

from afm_jax.whole_files import write_whole
from afm_jax.words import bullets, text_table
from fitting.instruments.curve import FORMAT_VERSION, MeasuredCurve, table_text


def curves_payload(curves: list[MeasuredCurve]) -> dict[str, Any]:
    """Return everything that was read as plain lists, numbers and strings."""
    own = {"source": curves[0].source, "instrument_format": curves[0].format}
    listed = [curve.to_dict() for curve in curves]
    return {"format": "afm-jax read", "format_version": FORMAT_VERSION, **own, "curves": listed}


def curves_summary(curves: list[MeasuredCurve]) -> str:
    """Return what was read as text: the curves, what is known and from where, what is missing, what was assumed."""
    first = curves[0]
    known = {key: one for key, one in first.known.items() if key not in _OWN}
    values = [one.value if isinstance(one.value, str) else f"{one.value:.7g}" for one in known.values()]
    rows = [[key, value, one.unit, one.origin] for (key, one), value in zip(known.items(), values, strict=True)]
    heads = ["curve", "rows", "heights (nm)", "free amplitude", "in contact", ""]
    lines = [
        f"{first.source} ({first.format}):",
        "",
        *text_table(heads, map(_row, curves), words=(5,)),
        "",
        *text_table(["known", "value", "unit", "from"], rows, words=(0, 2, 3)),
    ]
    asked = [f"{key}: `{key}=...`" for key in dict.fromkeys(k for c in curves if c.valid for k in c.missing)]
    lines += bullets("The file does not say:", asked)
    common = set.intersection(*(set(curve.notes) for curve in curves))
    notes = ((note if note in common else f"curve {each.curve}: {note}") for each in curves for note in each.notes)
    lines += bullets("Notes:", list(dict.fromkeys(notes)))
    lines += bullets("Refused:", [f"curve {curve.curve}: {reason}" for curve in curves for reason in curve.reasons])
    return "\n".join(lines)


_OWN = ("free_amplitude_nm", "offset_origin_nm", "phase_zero_deg", "amplitude_error_nm", "phase_error_deg")
"""What differs from curve to curve; the JSON has it."""


def _row(curve: MeasuredCurve) -> list[str]:
    unit, free = curve.amplitude_unit, curve.number("free_amplitude_nm")
    if free is None and curve.amplitude is not None and curve.free.any():
        free = float(np.median(curve.amplitude[curve.free]))
    branches = [f"{np.sum(curve.branch == name)} {name}" for name in dict.fromkeys(curve.branch.tolist())]
    heights = f"{curve.offset_nm.min():.1f} to {curve.offset_nm.max():.1f}"
    level = "-" if free is None or curve.amplitude is None else f"{free:.5g} {unit}"
    slope = "-" if curve.slope is None else f"{curve.slope[0]:.3g} {unit}/nm"
    return [str(curve.curve), " + ".join(branches), heights, level, slope, "" if curve.valid else "refused"]


def write_tables(curves: list[MeasuredCurve], path: Path) -> list[Path]:
    """Write the curves that may be used as tables: one into the file itself, several into NAME_1.csv, NAME_2.csv, ...

    Args:
        curves: of one file.
        path: the table; without a suffix a folder, for curve.csv.

    Raises:
        TableError: if something is missing that every table needs, or no curve may be used.
    """
    named = path
    path = path if path.suffix else path / "curve.csv"
    usable = [curve for curve in curves if curve.valid] or curves[:1]
    texts = {curve.curve: table_text(curve) for curve in usable}
    written = []
    for number, text in texts.items():
        place = path if len(curves) == 1 else path.with_stem(f"{path.stem}_{number}")
        # numbered ones, and that of a folder, are not what the user named
        write_whole(place, text, named_by_user=place == named)
        written.append(place)
    return written
