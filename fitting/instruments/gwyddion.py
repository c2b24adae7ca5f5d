"""Gwyddion's files: objects of named components, read within the bounds that the file states, and written.

After "GWYP" stands one object: its name, NUL, the length of the rest in 4 bytes, then components: name, NUL, a letter
for the type, the value. Small letters are single values, capitals arrays with a count of 4 bytes in front; o is an
object (Gwyddion's user guide, "Gwyddion native format"). All numbers are little-endian.
"""

import struct
from collections.abc import Mapping
from typing import Any

import numpy as np

from fitting.instruments.recording import cut_off

MAGIC = b"GWYP"
_NUMBERS = {"b": "u1", "c": "S1", "i": "<i4", "q": "<i8", "d": "<f8"}
_DEEPEST = 20


def read_objects(data: bytes, name: str) -> dict[str, Any]:
    """Return the components of the file's object, those of inner objects as mappings.

    Raises:
        TableError: if a length points beyond the object that it stands in, or a type is unknown.
    """
    content, end = _object(data, len(MAGIC), len(data), name, 0)
    if end != len(data):
        raise cut_off(name, "the length in the header is not that of the file")
    return content


def _object(data: bytes, place: int, end: int, name: str, depth: int) -> tuple[dict[str, Any], int]:
    """Return an object's components and where it ends."""
    _, place = _text(data, place, end, name)
    if place + 4 > end or depth > _DEEPEST:
        raise cut_off(name, f"an object at byte {place} has no length, or lies too deep")
    size = int.from_bytes(data[place : place + 4], "little")
    place += 4
    if size > end - place:
        raise cut_off(name, f"an object at byte {place} announces {size} bytes, {end - place} are there")
    last = place + size
    content: dict[str, Any] = {}
    while place < last:
        key, place = _text(data, place, last, name)
        kind = data[place : place + 1].decode("latin-1")
        content[key], place = _value(data, place + 1, last, kind, name, depth)
    return content, last


def _value(data: bytes, place: int, end: int, kind: str, name: str, depth: int) -> tuple[Any, int]:
    count, single = 1, kind.islower()
    if not single:
        if place + 4 > end:
            raise cut_off(name, f"an array at byte {place} has no length")
        count, place = int.from_bytes(data[place : place + 4], "little"), place + 4
    kind = kind.lower()
    if kind in _NUMBERS:
        size = count * np.dtype(_NUMBERS[kind]).itemsize
        if size > end - place:
            raise cut_off(name, f"{count} numbers at byte {place} are announced, {end - place} bytes are there")
        numbers = np.frombuffer(data, _NUMBERS[kind], count, place)
        return (numbers[0].item() if single else numbers), place + size
    if kind not in {"s", "o"} or count > end - place:
        raise cut_off(name, f"there is no type {kind!r} at byte {place}")
    values = []
    for _ in range(count):
        value, place = _text(data, place, end, name) if kind == "s" else _object(data, place, end, name, depth + 1)
        values.append(value)
    return (values[0] if single else values), place


def _text(data: bytes, place: int, end: int, name: str) -> tuple[str, int]:
    stop = data.find(b"\0", place, end)
    if stop < 0:
        raise cut_off(name, f"a text at byte {place} does not end")
    return data[place:stop].decode("utf-8", "replace"), stop + 1


def images_as_bytes(images: Mapping[str, tuple[np.ndarray, str]], size_m: tuple[float, float], unit_xy: str) -> bytes:
    """Return a Gwyddion file of images, NaN masked by a mask of Gwyddion's and filled with the smallest number.

    Args:
        images: by title, each an array (rows, columns) and the unit of its numbers.
        size_m: height and width in `unit_xy`.
        unit_xy: "m", or empty where the size is not known.
    """
    parts = []
    for number, (title, (image, unit)) in enumerate(images.items()):
        known = np.isfinite(image)
        filled = np.where(known, image, image[known].min() if known.any() else 0.0)
        parts.append(_component(f"/{number}/data", "o", _field(filled, size_m, unit_xy, unit)))
        parts.append(_component(f"/{number}/data/title", "s", title.encode() + b"\0"))
        if not known.all():
            parts.append(_component(f"/{number}/mask", "o", _field((~known).astype(float), size_m, unit_xy, "")))
    return MAGIC + _packed("GwyContainer", b"".join(parts))


def _field(image: np.ndarray, size: tuple[float, float], unit_xy: str, unit: str) -> bytes:
    rows, columns = image.shape
    numbers = np.ascontiguousarray(image, dtype="<f8")
    units = {"si_unit_xy": unit_xy, "si_unit_z": unit}
    parts = [
        _component("xres", "i", struct.pack("<i", columns)),
        _component("yres", "i", struct.pack("<i", rows)),
        _component("xreal", "d", struct.pack("<d", size[1])),
        _component("yreal", "d", struct.pack("<d", size[0])),
        *(
            _component(key, "o", _packed("GwySIUnit", _component("unitstr", "s", text.encode() + b"\0")))
            for key, text in units.items()
        ),
        _component("data", "D", struct.pack("<I", numbers.size) + numbers.tobytes()),
    ]
    return _packed("GwyDataField", b"".join(parts))


def _component(name: str, kind: str, value: bytes) -> bytes:
    return name.encode() + b"\0" + kind.encode() + value


def _packed(name: str, content: bytes) -> bytes:
    return name.encode() + b"\0" + struct.pack("<I", len(content)) + content
