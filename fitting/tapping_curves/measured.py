"""Tapping curves straight out of an instrument's file, each as a table."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from afm_jax.whole_files import first_bytes
from fitting.instruments.curve import MeasuredCurve, read_curve, read_curves, table_text
from fitting.instruments.formats import MARKS
from fitting.tables.table import AmplitudeTable, parse_table

_IS_TABLE = (b"lockin_amplitude_nm", b"peak_amplitude_nm", b"free_frequency_khz")


@dataclass(frozen=True)
class MeasuredFile:
    """The curves of an instrument's file.

    Attributes:
        tables: of the curves that may be used, by their number in the file.
        refused: why the others may not, by number.
        notes: what was assumed and found in reading them.
    """

    tables: dict[int, AmplitudeTable]
    refused: dict[int, str]
    notes: tuple[str, ...] = ()


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
    curves = read_curves(path, **options) if curve is None else [read_curve(path, curve=curve, **options)]
    names = {one.curve: f"{path}, curve {one.curve}" if one.curves > 1 else str(path) for one in curves}
    tables = {one.curve: parse_table(table_text(one), names[one.curve]) for one in curves if one.valid}
    refused = {one.curve: one.reasons[0] for one in curves if not one.valid}
    return MeasuredFile(tables, refused, tuple(dict.fromkeys(note for one in curves for note in _notes(one))))


def _notes(curve: MeasuredCurve) -> list[str]:
    """Return what was assumed and found in reading a curve."""
    shown = {"drive": "Drive", "drive_frequency_khz": "Drive frequency", "nm_per_volt": "Sensitivity"}
    found = [
        f"{name}: {one.value if isinstance(one.value, str) else f'{one.value:.5g} {one.unit}'}, {one.origin}"
        for key, name in shown.items()
        if (one := curve.known.get(key)) is not None and one.origin.startswith(("assumed", "measured"))
    ]
    return [*found, *curve.notes]
