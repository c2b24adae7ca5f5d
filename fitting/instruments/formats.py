"""One parser for each format of file that instruments write; which one a file is its content says, not its name.

neaSNOM text, WSxM curves, Nanonis text, NanoSurf .nid and separated text are read here; Asylum's .ibw by the package
igor2 and Gwyddion's .gwy by gwyfile (`pip install afm-jax[instruments]`), imported only for such a file.
"""

import io
import logging
import re
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from afm_jax.scenefile.tables import printable
from afm_jax.whole_files import MOST_VALUES
from fitting.instruments.recording import (
    HEADER_KEYS,
    UNITS,
    Known,
    Recording,
    Segment,
    cut_off,
    damaged_as_one_line,
    known_from,
    number_in,
    package_for,
    unit_named,
)
from fitting.tables.csv_text import DECIMAL_COMMA, NUMBER, TableError, cells_of, read_bytes, split_lines, text_of

_CURVE = {"approach": "approach", "extend": "approach", "fwd": "approach", "forward": "approach"}
_CURVE |= {"retract": "retract", "bwd": "retract", "backward": "retract"}


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
    if not data.strip():
        raise TableError(f"{name}: the file is empty; copy it again from the instrument")
    parse = _parser_of(data, str(path))
    with damaged_as_one_line(name):
        recording = parse(data, name)
    if not recording.segments or any(not np.size(v) for s in recording.segments for v in s.channels.values()):
        raise cut_off(name, "holds no rows of numbers")
    # names that cannot be printed could not be given in options
    return replace(
        recording,
        segments=tuple(replace(segment, channels=_spelled(segment.channels)) for segment in recording.segments),
        units=_spelled(recording.units),
        away=tuple(map(printable, recording.away)),
    )


def _spelled(named: Mapping[str, Any]) -> dict[str, Any]:
    return {printable(name): value for name, value in named.items()}


def _parser_of(data: bytes, path: str) -> Callable[[bytes, str], Recording]:
    head = data[:4096]
    if is_igor(head) or path.lower().endswith(".ibw"):
        return parse_igor
    found = next((parse for mark, parse in MARKS.items() if head.startswith(mark)), None)
    if found is not None:
        return found
    if head.startswith(b"\x93NUMPY") or (head.startswith(b"PK") and b".npy" in head):
        return _refuse_arrays
    if b"neaspec" in head.lower():
        return parse_neasnom
    return parse_nanonis_text if re.search(rb"^\[DATA\]\s*$", data, re.MULTILINE) else parse_separated


def is_igor(head: bytes) -> bool:
    """Say whether a file that begins so is an Igor binary wave: version 5 or 2, in either order of bytes."""
    return head[:2] in {b"\x05\x00", b"\x00\x05", b"\x02\x00", b"\x00\x02"}


def _refuse_arrays(_: bytes, name: str) -> Recording:
    raise TableError(f"{name}: holds NumPy's arrays, no curve; energies of images: afm-jax tapping-map")


def holds_curves(head: bytes, path: str) -> bool:
    """Say whether a file that begins so is of a format that holds nothing but curves against height."""
    return _parser_of(head, path) not in {parse_nanosurf, parse_nanonis_text, parse_separated, _refuse_arrays}


_NO_TEXT = (
    "is neither text nor a known format (neaSNOM, WSxM, Igor .ibw, NanoSurf .nid, Nanonis .dat, Gwyddion .gwy, CSV); "
    "export it as CSV"
)


def _columns(
    rows: Sequence[tuple[int, list[str]]], names: list[str], name: str
) -> dict[str, Float[np.ndarray, " rows"]]:
    """Return the columns of rows of cells; NaN where a cell holds no number.

    Raises:
        TableError: if a row has another number of cells than there are names, or there is no row.
    """
    if not rows:
        raise TableError(f"{name}: there are column names but no rows of numbers below them")
    for line, cells in rows:
        if len(cells) != len(names):
            raise cut_off(f"{name}, line {line}", f"there are {len(cells)} cells for {len(names)} columns")
    table = [[float(cell) if NUMBER.fullmatch(cell) else np.nan for cell in cells] for _, cells in rows]
    return dict(zip(names, np.array(table).T.copy(), strict=True))


_NEASNOM_KEYS = {"Tip Frequency:": ("drive_frequency_khz", "Hz")}


def parse_neasnom(data: bytes, name: str) -> Recording:
    """Read neaSNOM's text: `# key: [unit] values`, a row of names, rows of numbers; amplitudes in nm, phases in rad."""
    header: dict[str, str] = {}
    comments, lines = split_lines(text_of(data, name, _NO_TEXT, latin=True))
    for _, comment in comments:
        key, *cells = [cell.strip() for cell in comment.split("\t") if cell.strip()]
        unit = f" {unit_named(cells.pop(0))}" if cells and cells[0].startswith("[") else ""
        header[key] = " ".join(cells) + unit
    rows = [(number, cells_of(line, "\t")) for number, line in lines]
    if len(rows) < 2:
        raise cut_off(name, "there is a header but no rows below it")
    names = rows[0][1]
    columns = _columns(rows[1:], names, name)
    pixels = re.findall(r"\d+", header.get("Pixel Area (X, Y, Z):", ""))
    declared = int(np.prod([int(pixel) for pixel in pixels[:3]])) if pixels else len(rows) - 1
    runs = columns.get("Run", np.zeros(len(rows) - 1))
    numbers = list(dict.fromkeys(runs.tolist()))
    if (len(rows) - 1) % max(declared, 1) or len(rows) - 1 < declared:
        raise cut_off(name, f"the header announces {declared} rows, but {len(rows) - 1} are there")
    units = {"Z": "m"} | {
        one: "nm" if one.endswith("A") else "rad" for one in names if re.fullmatch(r"[MO]\d[AP]", one)
    }
    return Recording(
        "neaSNOM text",
        name,
        tuple(
            Segment(k + 1, "", {one: columns[one][runs == run] for one in units if one in columns})
            for k, run in enumerate(numbers)
        ),
        units,
        known_from(header, _NEASNOM_KEYS),
        away=("Z",),
        remarks=("The columns carry no units: heights are taken in m, amplitudes in nm, phases in rad.",),
        settings=header,
    )


_WSXM_END = b"[Header end]\r\n"
_WSXM_KEYS = {
    "Resonance frequency": ("free_frequency_khz", "Hz"),
    "Conversion Offset 00": ("drive_frequency_khz", "Hz"),
    "Quality factor (Q)": ("quality_factor", ""),
    "Force constant": ("spring_constant_n_per_m", "N/m"),
}


def parse_wsxm(data: bytes, name: str) -> Recording:
    """Read WSxM: an image with its header (left aside), then curves, each a text header and pairs of doubles (x, y)."""
    header, place = _wsxm_header(data, 0, name)
    if b"FZ curve file" not in data[:place]:
        kind, *sides = (header.get(key, "0") for key in ("Image Data Type", "Number of columns", "Number of rows"))
        sizes = {"0": 8, "double": 8, "float": 4, "integer": 4, "short": 2}
        if kind not in sizes or not all(side.isdecimal() for side in sides):
            raise cut_off(name, f"the image has the data type {kind!r} and {' x '.join(sides)} points")
        place += int(sides[0]) * int(sides[1]) * sizes[kind]
    segments: list[Segment] = []
    units: dict[str, str] = {}
    announced, own = 0, header
    while place < len(data):
        own, place = _wsxm_header(data, place, name)
        points = [int(v) for k, v in sorted(own.items()) if re.fullmatch(r"Number of Points \d+", k) and v.isdigit()]
        points = points or [int(own["Number of points"])] * int(own.get("Number of lines", "1"))
        if not 0 < sum(points) <= (len(data) - place) // 16:
            raise cut_off(name, f"curve {len(segments) // 2 + 1} announces {sum(points)} points that are not there")
        pairs = np.frombuffer(data, "<f8", 2 * sum(points), place).reshape(-1, 2)
        place += 16 * sum(points)
        axes = [own.get(f"{axis} axis text", axis).split("[")[0].strip() for axis in "XY"]
        units |= {axes[0]: unit_named(own.get("X axis unit", "nm")), axes[1]: unit_named(own.get("Y axis unit", "V"))}
        announced = int(own.get("Number of Curves in this serie", "1"))
        curve = int(own.get("Index of this Curve", str(len(segments) // 2 + 1)))
        branches = ["approach", "retract"]
        if own.get("First Forward", "Yes") != "Yes":
            branches.reverse()
        first = 0
        for branch, count in zip(branches, points, strict=False):
            part = pairs[first : first + count].astype(float)
            segments.append(Segment(curve, branch, {axes[0]: part[:, 0], axes[1]: part[:, 1]}))
            first += count
    if not segments or segments[-1].curve < announced:
        raise cut_off(
            name, f"{announced or 'some'} curves are announced, {segments[-1].curve if segments else 0} there"
        )
    # without an image of the excitation frequency its offset is no frequency
    found = known_from(header, _WSXM_KEYS)
    return Recording("WSxM curves", name, tuple(segments), units, found, settings=header)


def _wsxm_header(data: bytes, start: int, name: str) -> tuple[dict[str, str], int]:
    end = data.find(_WSXM_END, start)
    if end < 0:
        raise cut_off(name, f"no '[Header end]' behind byte {start}")
    lines = data[start:end].decode("latin-1").split("\r\n")
    pairs = [line.partition(":") for line in lines if ":" in line]
    return {key.strip(): value.strip() for key, _, value in pairs}, end + len(_WSXM_END)


NANOSURF_KEYS = {
    "Frequency:": ("free_frequency_khz", "Hz"),
    "Q Factor:": ("quality_factor", ""),
    "Spring Constant:": ("spring_constant_n_per_m", "N/m"),
    "Averages": ("averages", ""),
    "Vibration freq.": ("drive_frequency_khz", "Hz"),
    "Excitation frequency": ("drive_frequency_khz", "Hz"),
}


def parse_nanosurf(data: bytes, name: str) -> Recording:
    """Read NanoSurf .nid: sections of `key=value`, the mark `#!`, then the data sets as integers, one after another."""
    mark = data.find(b"#!")
    if mark < 0:
        raise cut_off(name, "the mark '#!' in front of the data is missing")
    sections = _nid_sections(data[:mark].decode("latin-1"))
    # of a name the first
    header = {key: value for _, keys in reversed(sections) for key, value in keys.items()}
    sets = [keys for title, keys in sections if re.fullmatch(r"DataSet-\d+:\d+", title)]
    sizes = [int(keys["Points"]) * int(keys["Lines"]) * (int(keys["SaveBits"]) // 8) for keys in sets]
    if min(sizes, default=0) < 0 or sum(sizes) != len(data) - mark - 2:
        raise cut_off(name, f"the header announces {sum(sizes)} bytes of data, {len(data) - mark - 2} are there")
    starts = mark + 2 + np.cumsum([0, *sizes])
    branches = {"Spec forward": "approach", "Spec backward": "retract", "Spectrum FFT": "", "Spectrum Fit": ""}
    parts: dict[tuple[int, str], dict[str, Any]] = {}
    units: dict[str, str] = {}
    for keys, (start, end) in zip(sets, pairwise(starts.tolist()), strict=True):
        frame = keys.get("Frame", "")
        if frame in branches:
            ending = " (vendor's fit)" if frame == "Spectrum Fit" else ""
            axis, channel = keys["Dim0Name"], keys["Dim2Name"] + ending
            units |= {axis: unit_named(keys["Dim0Unit"]), channel: unit_named(keys["Dim2Unit"])}
            for line, (at, numbers) in enumerate(_nid_lines(keys, data[start:end])):
                channels = parts.setdefault((line + 1, branches[frame]), {})
                channels.setdefault(axis, at)
                channels[channel] = numbers
    if not parts:
        frames = ", ".join(dict.fromkeys(keys.get("Frame", "?") for keys in sets)) or "none"
        raise TableError(
            f"{name}: holds no curve and no spectrum, but {frames}; export the spectroscopy data; energies of images: "
            "afm-jax tapping-map"
        )
    known = known_from(header, NANOSURF_KEYS)
    warm = number_in(header.get("Cantilever temperature", ""))
    if warm is not None and -100.0 < warm[0] < 500.0:
        known["temperature_k"] = Known(
            warm[0] + 273.15, "K", "header: Cantilever temperature, taken in degrees Celsius"
        )
    segments = tuple(Segment(curve, branch, parts[curve, branch]) for curve, branch in sorted(parts))
    return Recording("NanoSurf .nid", name, segments, units, known, settings=header)


def _nid_sections(text: str) -> list[tuple[str, dict[str, str]]]:
    """Return the sections in order, each with its keys."""
    sections: list[tuple[str, dict[str, str]]] = []
    for line in text.split("\r\n"):
        if line.startswith("[") and line.endswith("]"):
            sections.append((line[1:-1], {}))
        elif sections and "=" in line:
            key, _, value = line.partition("=")
            sections[-1][1].setdefault(key, value)
    return sections


def _nid_lines(keys: dict[str, str], data: bytes) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Give the axis and the numbers of every line of a data set."""
    points, bits = int(keys["Points"]), int(keys["SaveBits"])
    whole = np.frombuffer(data, {16: "<i2", 32: "<i4"}[bits]).reshape(-1, points)
    scaled = (whole / 2.0**bits + 0.5) * float(keys["Dim2Range"]) + float(keys["Dim2Min"])
    for line, numbers in enumerate(scaled):
        own = [keys.get(f"LineDim{line}{what}", keys.get(f"Dim0{what}")) for what in ("Min", "Range")]
        used = min(int(keys.get(f"LineDim{line}Points", points)), points)
        low, width = (float(value or "nan") for value in own)
        yield low + width * np.arange(used) / max(used - 1, 1), numbers[:used].copy()


def parse_nanonis_text(data: bytes, name: str) -> Recording:
    """Read Nanonis text: a header of tab-separated lines, `[DATA]`, names with units in brackets, rows of numbers."""
    lines = text_of(data, name, _NO_TEXT, latin=True).split("\n")
    start = next(place for place, line in enumerate(lines) if line.strip() == "[DATA]")
    header = {key: value for key, value, *_ in (line.split("\t") for line in lines[:start] if "\t" in line)}
    rows = [
        (number, cells_of(line, "\t")) for number, line in enumerate(lines, 1) if number > start + 1 and line.strip()
    ]
    if len(rows) < 2:
        raise cut_off(name, "there is nothing below [DATA]")
    names = rows[0][1]
    columns = _columns(rows[1:], names, name)
    found = {"approach": {}, "retract": {}}
    units = {}
    for full, numbers in columns.items():
        plain, unit = _name_and_unit(full)
        back = "[bwd]" in plain
        plain = plain.replace("[bwd]", "").strip()
        units[plain] = unit
        found["retract" if back else "approach"][plain] = numbers
    # the height is written once where forward and backward stood at the same heights
    for plain, numbers in found["approach"].items() if found["retract"] else ():
        if plain.startswith("Z"):
            found["retract"].setdefault(plain, numbers)
    segments = [Segment(1, branch if found["retract"] else "", part) for branch, part in found.items() if part]
    keys = {
        "f_res (Hz)": ("free_frequency_khz", "Hz"),
        "Q": ("quality_factor", ""),
        "Oscillation Control>Center Frequency (Hz)": ("drive_frequency_khz", "Hz"),
        "f0 (Hz)": ("free_frequency_khz", "Hz"),
    }
    known = known_from(header, keys)
    return Recording("Nanonis text", name, tuple(segments), units, known, away=("Z rel", "Z"), settings=header)


def _name_and_unit(text: str) -> tuple[str, str]:
    """Return the name and the unit of a column such as 'Amp (V)', 'Z [nm]', 'Z/nm' or 'phase_deg'.

    >>> _name_and_unit("Amp (V)"), _name_and_unit("Z/µm"), _name_and_unit("height_nm"), _name_and_unit("Z")
    (('Amp', 'V'), ('Z', 'um'), ('height_nm', 'nm'), ('Z', ''))
    """
    match = re.fullmatch(r"(.*?)\s*[\[(]([^\[\]]*)[\])]", text.strip())
    if match:
        return match[1], unit_named(match[2])
    for sign in "/_":
        name, found, unit = text.strip().rpartition(sign)
        if found and unit_named(unit) in UNITS:
            return (name if sign == "/" else text.strip()), unit_named(unit)
    return text.strip(), ""


def parse_separated(data: bytes, name: str) -> Recording:
    """Read text separated by tabs, semicolons, commas or blanks, with decimal commas where these do not separate."""
    comments, rows = split_lines(text_of(data, name, _NO_TEXT, latin=True))
    if not rows:
        raise TableError(f"{name}: the file holds only comments; add rows of numbers")
    # the last row may be cut off
    separator = _separator_of(rows[len(rows) // 2][1])
    # a tab that ends a row is a blank cell where the first row ends without
    ending = "\t" if separator == "\t" and not rows[0][1].endswith("\t") else ""
    cells = [(number, cells_of(line + ending, separator)) for number, line in rows]
    if separator != ",":
        cells = [(line, [_with_point(cell) for cell in row]) for line, row in cells]
    names = cells[0][1]
    if len(names) < 2 or (separator == " " and not all(map(NUMBER.fullmatch, names))):
        raise TableError(
            f"{name}, line {rows[0][0]}: columns separated by tabs, semicolons or commas are expected here"
        )
    units_row = [""] * len(names)
    if any(map(NUMBER.fullmatch, names)):
        titles = [str(k + 1) for k in range(len(names))]
    else:
        titles = [title or f"column {k + 1}" for k, title in enumerate(names)]
        cells = cells[1:]
        if cells and len(cells[0][1]) == len(titles) and not any(map(NUMBER.fullmatch, cells[0][1])):
            units_row, cells = cells[0][1], cells[1:]
    columns = _columns(cells, titles, name)
    named = [(title, *_name_and_unit(title)) for title in titles]
    units = {plain: unit or unit_named(units_row[k]) for k, (_, plain, unit) in enumerate(named)}
    pairs = [re.split(r"\s*[=:]\s*", comment, maxsplit=1) for _, comment in comments]
    settings = {pair[0]: pair[1] for pair in pairs if len(pair) == 2}
    # this package's own table says in which unit a key is by its name
    keys = {key: (key, unit) for key, unit in HEADER_KEYS.items()}
    segments = _by_branch(cells, titles, {plain: columns[title] for title, plain, _ in named})
    return Recording("separated text", name, segments, units, known_from(settings, keys), settings=settings)


def _separator_of(row: str) -> str:
    """Return what separates numbers: commas only where they are no decimal commas."""
    for sign in "\t; ":
        cells = [_with_point(cell) for cell in cells_of(row, sign) if cell]
        if len(cells) > 1 and all(map(NUMBER.fullmatch, cells)):
            return sign
    return next((sign for sign in "\t;," if sign in row), " ")


def _with_point(cell: str) -> str:
    return cell.replace(",", ".") if DECIMAL_COMMA.fullmatch(cell) else cell


def _by_branch(
    body: list[tuple[int, list[str]]], titles: list[str], columns: dict[str, Float[np.ndarray, " rows"]]
) -> tuple[Segment, ...]:
    """Return one segment, or one for each branch where a column `branch` or `direction` says approach or retract."""
    place = next((k for k, title in enumerate(titles) if title.lower() in {"branch", "direction", "segment"}), None)
    words = [] if place is None else [_CURVE.get(cells[place].lower(), "") for _, cells in body]
    if not words or "" in words:
        return (Segment(1, "", columns),)
    masks = {branch: np.array(words) == branch for branch in dict.fromkeys(words)}
    return tuple(Segment(1, b, {name: values[mask] for name, values in columns.items()}) for b, mask in masks.items())


_IGOR_KEYS = {
    "SpringConstant": ("spring_constant_n_per_m", "N/m"),
    "DriveFrequency": ("drive_frequency_khz", "Hz"),
    "ThermalFrequency": ("free_frequency_khz", "Hz"),
    "ThermalQ": ("quality_factor", ""),
    "InvOLS": ("deflection_nm_per_volt", "m/V"),
    "AmpInvOLS": ("nm_per_volt", "m/V"),
}
_IGOR_UNITS = {"amp": "m", "defl": "m", "zsnsr": "m", "raw": "m", "lvdt": "m", "phase": "deg", "phas": "deg"}


def igor_wave(data: bytes, name: str) -> tuple[np.ndarray, list[str], dict[str, str], dict[str, Known]]:
    """Return the numbers of an Igor binary wave, the names of its channels, its note and what that says.

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
    labels = _igor_labels(data, wave["bin_header"], min(numbers.ndim - 1, 2))
    note = bytes(wave["note"]).decode("latin-1").replace("\r", "\n")
    header = {k.strip(): v.strip() for k, _, v in (line.partition(":") for line in note.split("\n") if ":" in line)}
    known = known_from(header, _IGOR_KEYS, "note")
    return numbers, labels, header, known | _igor_free(header, known)


def _igor_labels(data: bytes, header: Mapping[str, Any], side: int) -> list[str]:
    """Return the labels along a side of a wave: texts in fields of 32 bytes, that of the side itself first.

    What stands behind a text's NUL in its field is left over from earlier texts (igor2 keeps it); a field without NUL
    goes on in the next one.
    """
    sizes = [int(size) for size in header.get("dimLabelsSize", ())]
    parts = [header.get(f"{part}Size", 0) for part in ("wfm", "formula", "note", "dataEUnits", "dimEUnits")]
    # behind a header of 64 bytes; version 5 is the only one with labels
    start = 64 + sum(int(np.sum(part)) for part in parts) + sum(sizes[:side])
    labels = [b""]
    for place in range(start, start + sum(sizes[side : side + 1]), 32):
        text, end, _ = data[place : place + 32].partition(b"\0")
        labels[-1] += text
        labels += [b""] if end else []
    return [_decoded(label) or f"channel {number}" for number, label in enumerate(labels[1:-1], start=1)]


def _decoded(text: bytes) -> str:
    """Return a text of Igor, UTF-8 since version 7, as it can be printed."""
    try:
        return printable(text.decode())
    except UnicodeDecodeError:
        return printable(text.decode("latin-1"))


def parse_igor(data: bytes, name: str) -> Recording:
    """Read Asylum's ramps in Igor's binary waves: a column for each channel, notes of `key: value`, SI units."""
    numbers, labels, header, known = igor_wave(data, name)
    if numbers.ndim != 2:
        what = "images; their energies: afm-jax tapping-map" if numbers.ndim == 3 else "no ramp of channels"
        raise TableError(f"{name}: holds an array of {numbers.ndim} dimensions, {what}")
    if len(labels) != numbers.shape[1]:
        raise cut_off(name, f"{numbers.shape[1]} channels, but {len(labels)} names")
    units = {label: _IGOR_UNITS.get(label.lower(), "") for label in labels}
    columns = dict(zip(labels, numbers.T.copy(), strict=True))
    return Recording("Igor .ibw ramp", name, tuple(_igor_segments(header, columns)), units, known, settings=header)


def _igor_points(data: bytes) -> int:
    """Return how many numbers the header of a wave of version 5 announces, 0 for older ones."""
    order = "little" if data[:2] == b"\x05\x00" else "big"
    if data[:2] not in {b"\x05\x00", b"\x00\x05"}:
        return 0
    # sizes of the parts, points, points along each side
    places = (*range(4, 56, 4), 76, *range(132, 148, 4))
    announced = [int.from_bytes(data[k : k + 4], order, signed=True) for k in places]
    return max(announced) if min(announced) >= 0 else len(data) + 1


def _igor_free(header: dict[str, str], known: dict[str, Known]) -> dict[str, Known]:
    """Return amplitude and phase of the free tip: the note has the amplitude in volts, or in metres where tiny."""
    found = {}
    said, scale = number_in(header.get("FreeAirAmplitude", "")), known.get("nm_per_volt")
    if said is not None and 0.0 < said[0] < 1e-5:
        found["free_amplitude_nm"] = Known(said[0] * 1e9, "nm", "note: FreeAirAmplitude, taken in m")
    elif said is not None and said[0] > 0.0 and scale is not None:
        nm = said[0] * float(scale.value)
        found["free_amplitude_nm"] = Known(nm, "nm", "note: FreeAirAmplitude, taken in V, times AmpInvOLS")
    phase = number_in(header.get("FreeAirPhase", ""))
    if phase is not None:
        found["free_phase_deg"] = Known(phase[0], "deg", "note: FreeAirPhase")
    return found


def _igor_segments(header: dict[str, str], columns: dict[str, Any]) -> list[Segment]:
    """Return the segments that the note's `Indexes` and `Direction` name, else the whole."""
    ends = [int(v) for v in header.get("Indexes", "").split(",") if v.strip().isdigit()]
    ways = [v.strip() for v in header.get("Direction", "").split(",")]
    rows = len(next(iter(columns.values())))
    segments = []
    if len(ends) == len(ways) and len(ends) > 1 and ends == sorted(ends) and ends[-1] <= rows:
        for first, last, way in zip(ends, ends[1:], ways[1:], strict=False):
            branch = {"1": "approach", "-1": "retract"}.get(way)
            if branch is not None and last - first > 1:
                # the row of an index is the last of its segment
                own = slice(first + 1 if segments else first, last + 1)
                segments.append(Segment(1, branch, {k: v[own] for k, v in columns.items()}))
    return segments or [Segment(1, "", columns)]


def gwyddion_objects(data: bytes, name: str) -> Mapping[str, Any]:
    """Return the components of a Gwyddion file.

    Raises:
        TableError: if the package that reads it is missing; the line names the extra.
    """
    package = package_for("gwyfile.objects", "instruments", f"{name}: .gwy files")
    return package.GwyObject.frombuffer(data[len(b"GWYP") :])


def parse_gwyddion(data: bytes, name: str) -> Recording:
    """Read the graphs of a Gwyddion file: every curve is a channel over the height, which is the channel Z."""
    content = gwyddion_objects(data, name)
    graphs = [value for key, value in sorted(content.items()) if "/graph/graph/" in key and "curves" in value]
    if not graphs:
        if any(key.endswith("/data") for key in content):
            raise TableError(f"{name}: holds images; their energies: afm-jax tapping-map")
        raise TableError(f"{name}: holds no graph; copy the curve into a graph in Gwyddion and save again")
    units: dict[str, str] = {}
    parts: list[dict[str, Any]] = []
    for graph in graphs:
        sides = {side: unit_named(str(graph.get(f"{side}_unit", {}).get("unitstr", ""))) for side in "xy"}
        for curve in graph["curves"]:
            label = str(curve.get("description") or graph.get("title") or "curve")
            at, numbers = (np.array(curve[side], dtype=float) for side in ("xdata", "ydata"))
            if at.shape != numbers.shape:
                raise cut_off(name, f"the curve {label!r} has {at.size} heights for {numbers.size} numbers")
            units |= {"Z": sides["x"], label: sides["y"]}
            same = (part for part in parts if np.array_equal(part["Z"], at) and label not in part)
            part = next(same, None)
            if part is None:
                part = {"Z": at}
                parts.append(part)
            part[label] = numbers
    segments = tuple(Segment(k + 1, "", part) for k, part in enumerate(parts))
    return Recording("Gwyddion graphs", name, segments, units)


MARKS = {b"WSxM file": parse_wsxm, b"GWYP": parse_gwyddion, b"[DataSet]": parse_nanosurf}
"""Formats by what their files begin with."""
