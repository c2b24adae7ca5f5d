"""Results as JSON that every reader accepts: arrays as lists, NaN and infinity as null."""

import dataclasses
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any


def strict_json(value: Any) -> str:
    """Return a value as one line of JSON.

    >>> strict_json({"speeds": (1.0, float("nan")), "settled": True})
    '{"speeds": [1.0, null], "settled": true}'

    Raises:
        TypeError: if something in it has no place in JSON.
    """
    return json.dumps(plain(value), allow_nan=False)


def plain(value: Any) -> Any:
    """Return a value as dicts, lists, strings, numbers, booleans and None; whatever is not finite becomes None.

    A dataclass becomes a dict of its fields.
    """
    # NumPy's and JAX's arrays and numbers, without importing either
    if hasattr(value, "tolist"):
        value = value.tolist()
    if dataclasses.is_dataclass(value):
        value = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    return str(value) if isinstance(value, Path) else value
