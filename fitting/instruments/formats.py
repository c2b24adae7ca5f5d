"""One parser for each format of file that instruments write; which one a file is its content says, not its name.

Text (neaSNOM, Nanonis, separated), WSxM curves and NanoSurf .nid are read here; Asylum's .ibw by the package igor2
(`pip install afm-jax[instruments]`), imported only for such a file.
"""

import io
import logging
import re
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from afm_jax.whole_files import MOST_VALUES
from afm_jax.words import printable
from fitting.instruments.recording import (
    UNITS,
    WAY,
    Recording,
    Segment,
    cut_off,
    damaged_as_one_line,
    number_in,
    package_for,
    two_ways,
    unit_named,
)
from fitting.tables.csv_text import (
    NUMBER,
    NumberedLines,
    Source,
    TableError,
    numbers_of,
    read_bytes,
    read_cells,
    split_lines,
    text_of,
)


def read_recording(path: str | Path) -> Recording:
    """Read a file of any known format.

    Args:
        path: the file.

    Raises:
        TableError: one line, if there is no such file, it is damaged or cut off, its format is not known, or the
            package that reads it is not installed (the line names the extra).
    """
    name = printable(str(path))
    data = read_bytes(path, "one file")
    for marks, what in _NOT_READ.items():
        if any(mark in data[:16] for mark in marks):
            raise TableError(f"{name}: {what}; energies of images: afm-jax tapping-map")
    parse = next((parser for mark, parser in MARKS.items() if data.startswith(mark)), parse_text)
    with damaged_as_one_line(name):
        recording = parse(data, name)
    if any(np.ndim(v) != 1 for s in recording.segments for v in s.channels.values()):
        raise TableError(f"{name}: holds images; their energies: afm-jax tapping-map")
    if not recording.segments or any(not np.size(v) for s in recording.segments for v in s.channels.values()):
        raise cut_off(name, "holds no rows of numbers")
    return recording


_NOT_READ = {
    (b"\x93NUMPY", b"GWYP", b"PK\x03\x04"): "holds arrays of NumPy, or data of Gwyddion or JPK; export a curve as text",
    (b"\x89HDF",): "is HDF5, as Nanosurf's .nhf; export the curve as .nid or CSV",
    (b"ARDF",): "is Asylum's .ARDF; export the curve as .ibw, or as text",
    (b"\\*File list", b"\\*Force file", b"\\*EC File"): "is Bruker's; export the curve as text (NanoScope Analysis)",
}
"""What files that are not read begin with, and what to do instead."""


# ---- text


def parse_text(data: bytes, name: str) -> Recording:
    """Read text: comments or a head above `[DATA]`, a row of names (units in them), and rows of numbers.

    Nanonis writes `[DATA]`, and names with "[bwd]" for the way back; Bruker's exports have _Ex and _Rt in the names of
    both ways. neaSNOM's comments are `key: [unit] values`; its columns carry no units.
    """
    wrong = "neither text nor a known format (neaSNOM, WSxM, Igor .ibw, NanoSurf .nid, Nanonis .dat, "
    comments, rows = split_lines(text_of(data, name, f"{wrong}CSV); export it as text with columns", latin=True))
    start = next((number for number, line in rows if line.strip() == "[DATA]"), 0)
    head = [line for number, line in rows if number < start] or [comment for _, comment in comments]
    pairs = [re.split(r"\s*[=:\t]\s*", line, maxsplit=1) for line in head]
    header = {pair[0]: re.sub(r"^(\[.*?\])\s*(.*?)\s*$", r"\2 \1", pair[1]) for pair in pairs if len(pair) == 2}
    columns, units = _columns([row for row in rows if row[0] > start], name)
    kind, away, remarks = ("Nanonis text", {"Z rel", "Z"}, []) if start else ("separated text", set(), [])
    runs = np.zeros(len(next(iter(columns.values()), ())))
    if any("neaspec" in comment.lower() for _, comment in comments):
        kind, away, runs = "neaSNOM text", {"Z"}, columns.get("Run", runs)
        remarks.append("The columns carry no units: heights are assumed in m, amplitudes in nm, phases in rad.")
        columns = {title: numbers for title, numbers in columns.items() if re.fullmatch(r"Z|[MO]\d[AP]", title)}
        units = {title: {"Z": "m", "A": "nm", "P": "rad"}[title[-1]] for title in columns}
    for title in [title for title in columns if title.removeprefix(BACK) in away]:
        columns[title] = -columns[title]
        remarks.append(f"Sign: {title} grows away from the sample in this format; the offset is its negative.")
    segments = tuple(
        Segment(number, "", {title: numbers[runs == run] for title, numbers in columns.items()})
        for number, run in enumerate(dict.fromkeys(runs.tolist()), start=1)
    )
    back = {title.removeprefix(BACK): title for title in columns if title.startswith(BACK)}
    if back:
        # the height is written once where forward and backward stood at the same heights
        pairs = {title: (title, back.get(title, title)) for title in columns if title in back or title.startswith("Z")}
        segments = two_ways(segments, pairs)
    return Recording(kind, name, segments, units, tuple(remarks), header)


def _columns(rows: NumberedLines, name: str) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Return the columns below a row of names (NaN where a cell holds no number), and their units.

    Raises:
        TableError: if a row has another number of cells than the first.
    """
    if not rows:
        return {}, {}
    titles, *body = read_cells(rows, Source(name))
    if any(map(NUMBER.fullmatch, titles)):
        titles, body = [str(number) for number, _ in enumerate(titles, start=1)], [titles, *body]
    named = [name_and_unit(printable(title) or f"column {number}") for number, title in enumerate(titles, start=1)]
    columns = {title: numbers_of(cells) for (title, _), cells in zip(named, zip(*body, strict=True), strict=False)}
    return columns, {title.removeprefix(BACK): unit for title, unit in named}


def name_and_unit(title: str) -> tuple[str, str]:
    """Return the name of a column, behind `BACK` of the way back, and its unit.

    >>> name_and_unit("Amp (V)"), name_and_unit("Z/µm"), name_and_unit("height_Rt_nm"), name_and_unit("Z")
    (('Amp', 'V'), ('Z', 'um'), ('[bwd] height_nm', 'nm'), ('Z', ''))
    """
    text = re.sub(rf"\s*\[bwd\]|{WAY.pattern}", "", title).strip()
    mark = BACK if re.search(r"\[bwd\]|_Rt(?=_|$)", title) else ""
    in_brackets = re.fullmatch(r"(.*?)\s*[\[(]([^\[\]]*)[\])]", text)
    if in_brackets:
        return mark + in_brackets[1], unit_named(in_brackets[2])
    ending = re.fullmatch(r"(.*)([/_])([^/_]*)", text)
    if ending and unit_named(ending[3]) in UNITS:
        return mark + (ending[1] if ending[2] == "/" else text), unit_named(ending[3])
    return mark + text, ""


BACK = "[bwd] "
"""What the name of a channel of the way back begins with."""


# ---- WSxM and NanoSurf


_WSXM_END = b"[Header end]\r\n"


def parse_wsxm(data: bytes, name: str) -> Recording:
    """Read WSxM: a header and an image (left aside), then curves, each a text header and pairs of doubles (x, y)."""
    header, _ = _wsxm_header(data, 0, name)
    segments: list[Segment] = []
    units: dict[str, str] = {}
    announced = 1
    for start in [match.start() for match in re.finditer(b"FZ curve file", data)]:
        own, place = _wsxm_header(data, start, name)
        points = [int(v) for k, v in sorted(own.items()) if re.fullmatch(r"Number of Points \d+", k)]
        if min(points, default=0) < 1 or sum(points) > (len(data) - place) // 16:
            raise cut_off(name, f"curve {len(segments) // 2 + 1} announces {sum(points)} points that are not there")
        pairs = np.frombuffer(data, "<f8", 2 * sum(points), place).reshape(-1, 2).astype(float)
        axes = [printable(own.get(f"{axis} axis text", axis).split("[")[0].strip()) for axis in "XY"]
        units |= {axes[0]: unit_named(own.get("X axis unit", "nm")), axes[1]: unit_named(own.get("Y axis unit", "V"))}
        announced = int(own.get("Number of Curves in this serie", "1"))
        curve = int(own.get("Index of this Curve", str(len(segments) // 2 + 1)))
        branches = ["approach", "retract"][:: 1 if own.get("First Forward", "Yes") == "Yes" else -1]
        for way, part in zip(branches, np.split(pairs, np.cumsum(points)[:-1]), strict=False):
            segments.append(Segment(curve, way, dict(zip(axes, part.T, strict=True))))
    if not segments or segments[-1].curve < announced:
        raise cut_off(name, f"{announced} curves are announced, {segments[-1].curve if segments else 0} there")
    # without an image of the excitation frequency its offset is no frequency
    return Recording("WSxM curves", name, tuple(segments), units, settings=header)


def _wsxm_header(data: bytes, start: int, name: str) -> tuple[dict[str, str], int]:
    end = data.find(_WSXM_END, start)
    if end < 0:
        raise cut_off(name, f"no '[Header end]' behind byte {start}")
    return _settings(data[start:end], ":"), end + len(_WSXM_END)


def _settings(head: bytes, sign: str) -> dict[str, str]:
    """Return what lines of keys and values say, which a sign parts."""
    lines = re.split("[\r\n]+", head.decode("latin-1"))
    pairs = [line.partition(sign) for line in lines if sign in line]
    return {key.strip(): value.strip() for key, _, value in pairs}


def parse_nanosurf(data: bytes, name: str) -> Recording:
    """Read NanoSurf .nid: sections of `key=value`, the mark `#!`, then the data sets as integers, one after another."""
    mark = data.find(b"#!")
    if mark < 0:
        raise cut_off(name, "the mark '#!' in front of the data is missing")
    found = re.split(rb"(?m)^\[(.*)\]\r?$", data[:mark])
    sections = [(title, _settings(head, "=")) for title, head in zip(found[1::2], found[2::2], strict=True)]
    # of a name the first
    header = {key: value for _, keys in reversed(sections) for key, value in keys.items()}
    sets = [keys for title, keys in sections if re.fullmatch(rb"DataSet-\d+:\d+", title)]
    sizes = [int(keys["Points"]) * int(keys["Lines"]) * (int(keys["SaveBits"]) // 8) for keys in sets]
    if min(sizes, default=0) < 0 or sum(sizes) != len(data) - mark - 2:
        raise cut_off(name, f"the header announces {sum(sizes)} bytes of data, {len(data) - mark - 2} are there")
    # the vendor's fit of a spectrum is left aside
    branches = {"Spec forward": "approach", "Spec backward": "retract", "Spectrum FFT": ""}
    parts: dict[tuple[int, str], dict[str, Any]] = {}
    units: dict[str, str] = {}
    ends = mark + 2 + np.cumsum(sizes)
    for keys, size, end in zip(sets, sizes, ends.tolist(), strict=True):
        frame = keys.get("Frame", "")
        if frame in branches:
            axis, channel = printable(keys["Dim0Name"]), printable(keys["Dim2Name"])
            units |= {axis: unit_named(keys["Dim0Unit"]), channel: unit_named(keys["Dim2Unit"])}
            points, bits = int(keys["Points"]), int(keys["SaveBits"])
            whole = np.frombuffer(data[end - size : end], {16: "<i2", 32: "<i4"}[bits]).reshape(-1, points)
            scaled = (whole / 2.0**bits + 0.5) * float(keys["Dim2Range"]) + float(keys["Dim2Min"])
            for line, numbers in enumerate(scaled):
                own = [keys.get(f"LineDim{line}{what}", keys.get(f"Dim0{what}")) for what in ("Min", "Range")]
                used = min(int(keys.get(f"LineDim{line}Points", points)), points)
                low, width = (float(value or "nan") for value in own)
                at = low + width * np.arange(used) / max(used - 1, 1)
                parts.setdefault((line + 1, branches[frame]), {axis: at})[channel] = numbers[:used].copy()
    if not parts:
        mend = "export the spectroscopy data; energies of images: afm-jax tapping-map"
        raise TableError(f"{name}: holds no curve and no spectrum; {mend}")
    segments = tuple(Segment(curve, branch, parts[curve, branch]) for curve, branch in sorted(parts))
    return Recording("NanoSurf .nid", name, segments, units, settings=header)


# ---- Igor


def parse_igor(data: bytes, name: str) -> Recording:
    """Read Asylum's binary waves: a column, or an image, for each channel, notes of `key: value`, SI units.

    Raises:
        TableError: if it is damaged, or the package that reads it is missing; the line names the extra.
    """
    if len(data) < 64 or _igor_points(data) > min(len(data), MOST_VALUES):
        raise cut_off(name, "the header announces more numbers than the file holds")
    package = package_for("igor2.binarywave", "instruments", f"{name}: .ibw files")
    # of a damaged file it would log every number
    logging.getLogger("igor2").setLevel(logging.CRITICAL)
    with warnings.catch_warnings():
        # numbers of a damaged file overflow
        warnings.simplefilter("ignore", RuntimeWarning)
        wave = package.load(io.BytesIO(data))["wave"]
        numbers = np.asarray(wave["wData"], dtype=float)
    side = min(max(numbers.ndim - 1, 1), 2)
    labels = _igor_labels(data, wave["bin_header"], side)
    if numbers.ndim != side + 1 or len(labels) != numbers.shape[side]:
        raise TableError(
            f"{name}: holds an array of {numbers.ndim} dimensions, no labelled channels of a ramp or an image"
        )
    header = _settings(bytes(wave["note"]), ":")
    units = {label: "deg" if re.match("pha", label, re.IGNORECASE) else "m" for label in labels}
    # of an image Igor counts columns first, and rows from below
    channels = numbers if side == 1 else numbers[:, ::-1].swapaxes(0, 1)
    columns = {label: channels[..., number].copy() for number, label in enumerate(labels)}
    sides = [number_in(header.get(key, "")) for key in ("SlowScanSize", "FastScanSize")]
    size = None if sides[0] is None or sides[1] is None else (sides[0][0], sides[1][0])
    kind = "Igor .ibw images" if side == 2 else "Igor .ibw ramp"
    return Recording(kind, name, (Segment(1, "", columns),), units, settings=header, size_m=size)


def _igor_labels(data: bytes, header: Mapping[str, Any], side: int) -> list[str]:
    """Return the labels along a side of a wave: texts in fields of 32 bytes, that of the side itself first.

    What stands behind a text's NUL in its field is left over from earlier texts (igor2 keeps it).
    """
    sizes = [int(size) for size in header.get("dimLabelsSize", [0, 0, 0])]
    # the labels of all sides stand in front of the file's end; version 5 is the only one with labels
    start = len(data) - int(header.get("sIndicesSize", 0)) - sum(sizes[side:])
    fields = [data[place : place + 32] for place in range(start + 32, start + sum(sizes[side : side + 1]), 32)]
    # UTF-8 since version 7 of Igor
    texts = [text_of(field.partition(b"\0")[0], "label", "", latin=True) for field in fields]
    return [printable(text) or f"channel {number}" for number, text in enumerate(texts, start=1)]


def _igor_points(data: bytes) -> int:
    """Return how many numbers the header of a wave of version 5 announces, 0 for older ones."""
    if 5 not in data[:2]:
        return 0
    # sizes of the parts, points, points along each side
    announced = np.frombuffer(data, "<i4" if data[0] else ">i4", 37)[[*range(1, 14), 19, *range(33, 37)]]
    return int(announced.max()) if announced.min() >= 0 else len(data) + 1


IGOR = (b"\x05\x00", b"\x00\x05", b"\x02\x00", b"\x00\x02")
"""What Igor's binary waves begin with: version 5 or 2, in either order of bytes."""
MARKS = {b"WSxM file": parse_wsxm, b"[DataSet]": parse_nanosurf, **dict.fromkeys(IGOR, parse_igor)}
"""Formats by what their files begin with."""
