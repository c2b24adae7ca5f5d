"""What was read of an instrument's file, as a person reads it and as JSON, and the tables written from it."""

from pathlib import Path
from typing import Any

import numpy as np

from afm_jax.report import Bullets, Section, Table, sections
from afm_jax.results import ResultTuple, public_result
from afm_jax.saved import as_json
from afm_jax.strict_json import plain
from afm_jax.whole_files import write_whole
from fitting.instruments.curve import FORMAT_VERSION, MeasuredCurve, table_text


@public_result()
class CurvesOfFile(ResultTuple):
    """What `afm-jax read` tells: the curves of one file."""

    curves: list[MeasuredCurve]

    @property
    def reason(self) -> str | None:
        """Which curves must not be used; None where all may."""
        refused = [curve for curve in self.curves if not curve.valid]
        numbers = ", ".join(str(curve.curve) for curve in refused)
        return f"{refused[0].source}: refused curve {numbers}; {refused[0].reasons[0]}" if refused else None


@as_json.register
def _(read: CurvesOfFile) -> dict[str, Any]:
    first, curves = read.curves[0], [plain(as_json(curve)) for curve in read.curves]
    own = {"source": first.source, "instrument_format": first.format}
    return {"format": "afm-jax read", "format_version": FORMAT_VERSION, **own, "curves": curves}


@sections.register
def _(result: MeasuredCurve) -> list[Section]:
    return sections(CurvesOfFile([result]))


@sections.register
def _(read: CurvesOfFile) -> list[Section]:
    # the curves, what is known and from where, what is missing, what was assumed
    curves = read.curves
    first = curves[0]
    known = {key: one for key, one in first.known.items() if key not in _OWN}
    values = [one.value if isinstance(one.value, str) else f"{one.value:.7g}" for one in known.values()]
    rows = [[key, value, one.unit, one.origin] for (key, one), value in zip(known.items(), values, strict=True)]
    heads = ["curve", "rows", "heights (nm)", "free amplitude", "in contact", ""]
    asked = [f"{key}: `{key}=...`" for key in dict.fromkeys(k for c in curves if c.valid for k in c.missing)]
    common = set.intersection(*(set(curve.notes) for curve in curves))
    notes = ((note if note in common else f"curve {each.curve}: {note}") for each in curves for note in each.notes)
    refused = [f"curve {curve.curve}: {reason}" for curve in curves for reason in curve.reasons]
    return [
        Section(f"{first.source} ({first.format}):", []),
        Section("Curves", [Table("", heads, [*map(_row, curves)])]),
        Section("Known", [Table("", ["known", "value", "unit", "from"], rows)]),
        Section("Missing", [Bullets(asked, "The file does not say:")]),
        Section("Notes", [Bullets(list(dict.fromkeys(notes)), "Notes:")]),
        Section("Refused", [Bullets(refused, "Refused:")]),
    ]


_OWN = ("free_amplitude_nm", "offset_origin_nm", "phase_zero_deg", "amplitude_error_nm", "phase_error_deg")
"""What differs from curve to curve; the JSON has it."""


def _row(curve: MeasuredCurve) -> list[str]:
    unit, free = curve.amplitude_unit, curve.number("free_amplitude_nm")
    if free is None and curve.free.any():
        free = float(np.median(curve.amplitude[curve.free]))
    branches = [f"{np.sum(curve.branch == name)} {name}" for name in dict.fromkeys(curve.branch.tolist())]
    heights = f"{curve.offset_nm.min():.1f} to {curve.offset_nm.max():.1f}"
    level = "-" if free is None else f"{free:.5g} {unit}"
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
