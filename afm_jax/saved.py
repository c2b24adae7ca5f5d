"""Results as JSON files that give back the same object: every float exact, nothing that a program is needed to read.

```json
{"format": "afm-jax result", "format_version": 1, "afm_jax": "0.1.0", "type": "State",
 "fields": {"time_us": {"array": "float64", "shape": [2], "values": [0.0, 1.5]}, ...}}
```
An array has its `shape` and its `values` in nested lists: NaN is null, infinity "inf" or "-inf", a complex number a
pair. A number that is not finite stands as `{"number": null}` or `{"number": "inf"}`; inner objects have `type` and
`fields`, enumerations `type` and `name`; tuples are `{"tuple": [...]}`, mappings `{"map": [[key, value], ...]}`.
Functions are left out: null. `meanings` says what the numbers of an outcome stand for. A result that a command writes
too begins with that command's keys. No pickle: reading a file builds records of this project and runs nothing.
"""

import dataclasses
import enum
import importlib
import json
import math
import re
from collections.abc import Iterator, Mapping
from functools import cache, singledispatch
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from afm_jax.checks import checked, is_array, is_traced
from afm_jax.strict_json import strict_json
from afm_jax.version import __version__
from afm_jax.whole_files import read_whole, write_whole

FORMAT = "afm-jax result"
FORMAT_VERSION = 1
"""Version of the layout above; a reader refuses a newer one."""
_PACKAGES = ("afm_jax", "fitting")
FIT_FORMAT, FIT_FORMAT_VERSION = "afm-jax fit", 2
"""Of a fit's fit.json; the version is raised when a key changes its meaning or goes."""


def why_no_fit(contents: Any) -> str | None:
    """Return what is wrong with JSON that should be a fit's, of the version that is known here; None: nothing."""
    if not isinstance(contents, dict) or contents.get("format") != FIT_FORMAT:
        return "is no fit; give the fit.json of `afm-jax fit --out`"
    version = contents.get("format_version")
    if version == FIT_FORMAT_VERSION:
        return None
    return (
        f"has format_version {version}, but {FIT_FORMAT_VERSION} is known here; write it anew: "
        "afm-jax fit TABLE.csv --model MODEL --out FOLDER"
    )


def fields_of(record: Any) -> Iterator[tuple[str, Any]]:
    """Give names and values of a record: a named tuple, a dataclass or a module of equinox."""
    names = getattr(record, "_fields", ()) or [field.name for field in dataclasses.fields(record)]
    return ((name, getattr(record, name)) for name in names)


def is_record(value: Any) -> bool:
    """Say whether a value has named fields."""
    named_tuple = isinstance(value, tuple) and hasattr(value, "_fields")
    return named_tuple or (dataclasses.is_dataclass(value) and not isinstance(value, type))


def is_abstract(value: Any) -> bool:
    """Say whether a value is an array without numbers: traced by JAX, or a shape."""
    return is_array(value) and (is_traced(value) or not hasattr(value, "__array__"))


@singledispatch
def as_json(result: Any) -> dict[str, Any]:
    """Return a result as its command writes it: fields and verdict, if its kind does not register other keys."""
    return dict(fields_of(result)) | ({"valid": result.valid} if hasattr(result, "valid") else {})


def saved(result: Any) -> dict[str, Any]:
    """Return a result as the object of its JSON file.

    Raises:
        ValueError: if a number in it is traced.
    """
    has_own = as_json.dispatch(type(result)) is not as_json.dispatch(object)
    head = {"format": FORMAT, "format_version": FORMAT_VERSION} | (as_json(result) if has_own else {})
    meanings = {
        name: {str(int(each)): getattr(each, "sentence", each.name.lower().replace("_", " ")) for each in kind}
        for name, kind in getattr(type(result), "_words", {}).items()
    }
    return head | {"afm_jax": __version__, "meanings": meanings, **_record(result, type(result).__name__)}


def save(result: Any, path: str | Path) -> None:
    """Write a result as a JSON file, whole or not at all; `load` gives it back.

    Args:
        result: a public result, or any record of numbers, arrays, texts and records.
        path: of the file.

    Raises:
        ValueError: if a number in it is traced: save outside `jit`, `vmap` and `grad`.
    """
    write_whole(Path(path), strict_json(saved(result)) + "\n", named_by_user=True)


@checked
def load(path: str | Path) -> Any:
    """Return a result from the JSON file into which its method `save` wrote it.

    Arrays that were JAX's are JAX's again where it computes in 64 bits, else NumPy's, so that no digit is lost.

    Args:
        path: of the file.

    Raises:
        ValueError: if the file holds no saved result, or one of a newer version.
    """

    def refuse(what: str) -> NoReturn:
        raise ValueError(f"{path}: {what}")

    try:
        payload = json.loads(read_whole(path).decode("utf-8"))
    except (ValueError, RecursionError) as error:
        refuse(f"is no JSON ({error})")
    if not isinstance(payload, dict) or not {"format", "type", "fields"} <= set(payload):
        refuse("is no saved result; `.save(path)` or `.report(folder)` of a result writes one")
    if payload["format"] == FORMAT and payload.get("format_version") != FORMAT_VERSION:
        refuse(
            f"has format_version {payload.get('format_version')}, but {FORMAT_VERSION} is known here: update afm-jax"
        )
    try:
        return _value({"type": payload["type"], "fields": payload["fields"]})
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        refuse(f"is no saved result that can be read here ({type(error).__name__}: {error})")


def _record(record: Any, place: str) -> dict[str, Any]:
    return {
        "type": type(record).__name__,
        "fields": {name: _plain(value, f"{place}.{name}") for name, value in fields_of(record)},
    }


def _plain(value: Any, place: str) -> Any:
    if is_abstract(value):
        raise ValueError(f"{place} is traced: save a result outside `jit`, `vmap` and `grad`")
    if isinstance(value, enum.Enum):
        return {"type": type(value).__name__, "name": value.name}
    if isinstance(value, np.generic):
        value = value.item()
    if is_array(value):
        return _array(value)
    if isinstance(value, float):
        return value if math.isfinite(value) else {"number": _number(value)}
    if isinstance(value, bool | int | str | None):
        return value
    return str(value) if isinstance(value, Path) else _of_parts(value, place)


def _of_parts(value: Any, place: str) -> Any:
    if is_record(value):
        return _record(value, place)
    if isinstance(value, Mapping):
        return {"map": [[_plain(key, place), _plain(item, f"{place}[{key!r}]")] for key, item in value.items()]}
    if isinstance(value, list | tuple):
        items = [_plain(item, f"{place}[{number}]") for number, item in enumerate(value)]
        return items if isinstance(value, list) else {"tuple": items}
    if callable(value):
        return None
    raise ValueError(f"{place} is a {type(value).__name__}, which has no place in a file")


def _array(value: Any) -> dict[str, Any]:
    array: Any = np.asarray(value)
    numbers = np.stack([array.real, array.imag], axis=-1) if array.dtype.kind == "c" else array
    listed = _numbers(numbers.tolist()) if numbers.dtype.kind == "f" else numbers.tolist()
    kind = {} if isinstance(value, np.ndarray) else {"jax": True}
    return {"array": str(array.dtype), **kind, "shape": list(array.shape), "values": listed}


def _numbers(values: Any) -> Any:
    return [_numbers(value) for value in values] if isinstance(values, list) else _number(values)


def _number(value: float) -> float | str | None:
    return value if math.isfinite(value) else None if math.isnan(value) else "inf" if value > 0.0 else "-inf"


def _value(plain: Any) -> Any:  # noqa: PLR0911 (one return a kind of value)
    if isinstance(plain, list):
        return [_value(item) for item in plain]
    if not isinstance(plain, dict):
        return plain
    if "array" in plain:
        return _as_array(plain)
    if "number" in plain:
        return _as_number(plain["number"])
    if "tuple" in plain:
        return tuple(_value(item) for item in plain["tuple"])
    if "map" in plain:
        return {_value(key): _value(item) for key, item in plain["map"]}
    kind: Any = _class_named(plain["type"])
    if "name" in plain:
        return kind[plain["name"]]
    return _built(kind, {name: _value(item) for name, item in plain["fields"].items()})


def _built(kind: type[Any], values: dict[str, Any]) -> Any:
    """Return a record of these values; the checks of what is new are not run again.

    A class with `_by_init` computes what else it has from its fields.
    """
    if issubclass(kind, tuple) or hasattr(kind, "_by_init"):
        return kind(**values)
    record = object.__new__(kind)
    for field in dataclasses.fields(kind):
        object.__setattr__(record, field.name, values[field.name])
    return record


def _as_array(plain: Mapping[str, Any]) -> Any:
    dtype = np.dtype(plain["array"])
    part = np.dtype(f"f{dtype.itemsize // 2}") if dtype.kind == "c" else dtype
    shape = tuple(plain["shape"])
    # null becomes NaN, "inf" infinite
    array = np.array(plain["values"], part).reshape((*shape, 2) if dtype.kind == "c" else shape)
    if dtype.kind == "c":
        array = (array[..., 0] + 1j * array[..., 1]).astype(dtype)
    if not plain.get("jax"):
        return array
    import jax  # noqa: PLC0415 (reading a table needs no JAX)

    return jax.numpy.asarray(array) if jax.config.read("jax_enable_x64") else array


def _as_number(value: float | str | None) -> float:
    return math.nan if value is None else float(value)


@cache
def _class_named(name: str) -> Any:
    """Return the record or enumeration of a name, wherever in the packages it lies: names of classes are unique."""
    for package in _PACKAGES:
        spec = find_spec(package)
        for root in () if spec is None else spec.submodule_search_locations or ():
            for path in sorted(Path(root).rglob("*.py")):
                if re.search(rf"^class {re.escape(name)}\b", path.read_text(encoding="utf-8"), re.MULTILINE):
                    parts = path.relative_to(root).with_suffix("").parts
                    kind = getattr(importlib.import_module(".".join((package, *parts))), name)
                    if dataclasses.is_dataclass(kind) or issubclass(kind, tuple | enum.Enum):
                        return kind
    raise KeyError(f"there is no record called {name}")
