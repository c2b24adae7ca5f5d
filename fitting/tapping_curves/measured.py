"""Tapping curves from tables, curves that were read, and files of either kind, each as a table."""

import os
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from afm_jax.whole_files import first_bytes
from afm_jax.words import printable
from fitting.instruments.curve import OPTIONS, MeasuredCurve, read_curve, read_curves, table_text
from fitting.instruments.formats import MARKS
from fitting.instruments.recording import given_numbers
from fitting.tables.csv_text import TableError
from fitting.tables.table import ERROR_OF, AmplitudeTable, parse_table, read_table

_IS_TABLE = (b"lockin_amplitude_nm", b"peak_amplitude_nm", b"free_frequency_khz")
_OF_TABLES = ("free_frequency_khz", "quality_factor", "spring_constant_n_per_m")
"""What a call may state in place of a table."""
CurveLike = AmplitudeTable | MeasuredCurve | str | os.PathLike[str]
"""An amplitude table, a curve of an instrument's file, or the path of a file of either kind."""


@dataclass
class MeasuredCurves:
    """Curves as tables.

    Attributes:
        tables: of the curves that may be used, by their number in their file, or in the call if that has several.
        refused: file, number and reason of the others.
        notes: what was assumed and found in reading them.
    """

    tables: dict[int, AmplitudeTable] = field(default_factory=dict)
    refused: list[dict[str, Any]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def is_table(path: str | os.PathLike[str]) -> bool:
    """Say whether a file is (meant to be) an amplitude table, not an instrument's; one that is not there is one."""
    try:
        head = first_bytes(path, 1 << 16)
    except OSError:
        return True
    return not head.startswith(tuple(MARKS)) and any(word in head for word in _IS_TABLE)


def measured(
    sources: Sequence[CurveLike], *, curve: int | None = None, noise: float | None = None, **reading: Any
) -> MeasuredCurves:
    """Return curves as tables.

    Args:
        sources: tables, curves that were read, and files.
        curve: only this curve of an instrument's file.
        noise: relative error of amplitudes without one in a table's file.
        reading: how an instrument's file is read, as `read_curves` takes it; of a table what is stated of lever and
            phase in place of its own.

    Raises:
        TableError: if a file cannot be read, says too little (with the options that give it) or has no such curve, or
            an option is for an instrument's file.
    """
    found = MeasuredCurves()
    for source in sources:
        if isinstance(source, AmplitudeTable | MeasuredCurve) or is_table(source):
            if isinstance(source, MeasuredCurve):
                table = parse_table(table_text(source), source.source)
            else:
                table = source if isinstance(source, AmplitudeTable) else read_table(Path(source), noise)
            found.tables[len(found.tables) + 1] = _as_stated(table, {"curve": curve, **reading})
            continue
        path = Path(source)
        read = read_curves(path, **reading) if curve is None else [read_curve(path, curve=curve, **reading)]
        for one in read:
            if one.reasons:
                found.refused.append({"file": str(source), "curve": one.curve, "reason": one.reasons[0]})
            else:
                number = one.curve if len(sources) == 1 else len(found.tables) + 1
                name = f"{source}, curve {one.curve}" if one.curves > 1 else str(source)
                found.tables[number] = parse_table(table_text(one), name)
            found.notes += [note for note in _notes(one) if note not in found.notes]
    return found


def _as_stated(table: AmplitudeTable, options: dict[str, Any]) -> AmplitudeTable:
    """Return a table with what the call states of lever and phase in place of its own.

    Raises:
        TableError: if an option is for an instrument's file.
    """
    said = {name: value for name, value in options.items() if value not in {None, ""}}
    for name in said:
        if name not in {*_OF_TABLES, "phase_sense"}:
            raise TableError(
                f"`{name}=...` is for an instrument's file; {printable(table.source)} is a table, which says that "
                "itself"
            )
    changed: dict[str, Any] = {"phase_sense": said.pop("phase_sense", table.phase_sense)}
    for name, number in given_numbers(said, OPTIONS).items():
        changed |= {name: number.value, ERROR_OF[name]: number.error}
    if said and changed.get("spring_constant_n_per_m", table.spring_constant_n_per_m) is not None:
        # what spring constant and frequency make it
        changed["mass_ng"] = None
    return replace(table, **changed)


def _notes(curve: MeasuredCurve) -> list[str]:
    """Return what was assumed and found in reading a curve."""
    shown = {"drive": "Drive", "drive_frequency_khz": "Drive frequency", "nm_per_volt": "Sensitivity"}
    found = [
        f"{name}: {one.value if isinstance(one.value, str) else f'{one.value:.5g} {one.unit}'}, {one.origin}"
        for key, name in shown.items()
        if (one := curve.known.get(key)) is not None and one.origin.startswith(("assumed", "measured"))
    ]
    return [*found, *curve.notes]
