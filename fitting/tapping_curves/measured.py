"""Tapping curves straight out of an instrument's file: each as a table, and the hysteresis of all of them."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from afm_jax.whole_files import first_bytes
from fitting.instruments.curve import MeasuredCurve, read_curves, table_text
from fitting.instruments.formats import MARKS
from fitting.tables.csv_text import TableError
from fitting.tables.table import AmplitudeTable, parse_table
from fitting.tapping_curves.branches import last_above

_IS_TABLE = (b"lockin_amplitude_nm", b"peak_amplitude_nm", b"free_frequency_khz")


@dataclass(frozen=True)
class MeasuredFile:
    """The curves of an instrument's file.

    Attributes:
        tables: of the curves that may be used, by their number in the file.
        refused: why the others may not, by number.
        half_widths_nm: of every curve, refused ones too: by how many nm nearer the amplitude falls to half on approach
            than it comes back on retract; by number, as far as both show it.
        notes: what was assumed and found in reading them.
    """

    tables: dict[int, AmplitudeTable]
    refused: dict[int, str]
    half_widths_nm: dict[int, float]
    notes: tuple[str, ...] = ()

    @property
    def half_width_nm(self) -> tuple[float, float] | None:
        """Mean of the half widths and their scatter (standard deviation), None with fewer than two."""
        widths = list(self.half_widths_nm.values())
        return (float(np.mean(widths)), float(np.std(widths, ddof=1))) if len(widths) > 1 else None


def is_table(path: str | Path) -> bool:
    """Say whether a file is (meant to be) an amplitude table, not an instrument's; one that is not there is one."""
    try:
        head = first_bytes(path, 1 << 16)
    except OSError:
        return True
    return not head.startswith(tuple(MARKS)) and any(word in head for word in _IS_TABLE)


def read_measured(path: str | Path, *, curve: int | None = None, **options: Any) -> MeasuredFile:
    """Return the curves of an instrument's file as tables.

    Args:
        path: the file.
        curve: only this one.
        options: as of `read_curves`.

    Raises:
        TableError: if the file cannot be read, says too little (with the options that give it), or has no such curve.
    """
    curves = read_curves(path, **options)
    chosen = [one for one in curves if curve in {None, one.curve}]
    if not chosen:
        raise TableError(f"{path}: there is no curve {curve}; the file holds {', '.join(str(c.curve) for c in curves)}")
    names = {one.curve: f"{path}, curve {one.curve}" if len(curves) > 1 else str(path) for one in chosen}
    tables = {one.curve: parse_table(table_text(one), names[one.curve]) for one in chosen if one.valid}
    widths = {one.curve: width for one in chosen if (width := half_width(one)) is not None}
    refused = {one.curve: one.reasons[0] for one in chosen if not one.valid}
    return MeasuredFile(tables, refused, widths, tuple(dict.fromkeys(note for one in chosen for note in _notes(one))))


def _notes(curve: MeasuredCurve) -> list[str]:
    """Return what was assumed and found in reading a curve; its number in front where others need not share it."""
    told = ("assumed", "measured")
    shown = {"drive": "Drive", "drive_frequency_khz": "Drive frequency", "nm_per_volt": "Sensitivity"}
    found = [
        f"{name}: {one.value if isinstance(one.value, str) else f'{one.value:.5g} {one.unit}'}, {one.origin}"
        for key, name in shown.items()
        if (one := curve.known.get(key)) is not None and one.origin.startswith(told)
    ]
    of = f"curve {curve.curve}: " if curve.curves > 1 else ""
    return [
        *(of + text for text in found if not text.startswith("Drive")),
        *(t for t in found if t.startswith("Drive")),
        *curve.notes,
    ]


def half_width(curve: MeasuredCurve) -> float | None:
    """Return by how many nm later the amplitude comes back to half of the free one, None where that does not show.

    It is half from where on the amplitude stays below, between two rows by the straight line.
    """
    heights = []
    for branch in ("approach", "retract"):
        rows = np.flatnonzero(curve.branch == branch)
        rows = rows[np.argsort(curve.offset_nm[rows], kind="stable")]
        if curve.amplitude is None or not curve.free[rows].any():
            return None
        level = 0.5 * float(np.median(curve.amplitude[rows[curve.free[rows]]]))
        last = last_above(curve.amplitude[rows], level)
        if last is None:
            return None
        pair = rows[last : last + 2]
        heights.append(float(np.interp(-level, -curve.amplitude[pair], curve.offset_nm[pair])))
    return heights[0] - heights[1]
