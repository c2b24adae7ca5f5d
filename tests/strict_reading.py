"""JSON read as strictly as the strictest reader of it."""

import json
from typing import Any


def strictly(text: str) -> Any:
    """Return the one JSON object of a text; NaN and Infinity, which JSON does not have, are refused."""

    def refuse(constant: str):
        raise AssertionError(constant)

    return json.loads(text, parse_constant=refuse)
