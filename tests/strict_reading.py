"""JSON read as strictly as the strictest reader of it, phases of a motion in their one convention."""

import json
import math
from collections.abc import Iterator
from typing import Any

MOTIONS = {f"afm-jax {name}" for name in ("orbits", "simulate", "continue", "bifurcation", "basins")}
"""Answers whose phases and lags all lie within one turn."""


def strictly(text: str) -> Any:
    """Return the one JSON object of a text; NaN and Infinity are refused, and phases of a motion beyond one turn."""

    def refuse(constant: str):
        raise AssertionError(constant)

    answer = json.loads(text, parse_constant=refuse)
    if isinstance(answer, dict) and answer.get("format") in MOTIONS:
        assert answer["format_version"] == 1
        for name, angle in angles(answer):
            assert 0.0 <= angle < (2.0 * math.pi if name.endswith("rad") else 360.0), (name, angle)
    return answer


def angles(value: object, name: str = "") -> Iterator[tuple[str, float]]:
    """Return all numbers of an answer that stand under the name of a phase or a lag."""
    if isinstance(value, dict):
        for key, item in value.items():
            yield from angles(item, key)
    elif isinstance(value, list):
        for item in value:
            yield from angles(item, name)
    elif isinstance(value, float) and name.endswith(("phase_rad", "phase_deg", "lag_deg")):
        yield name, value
