"""A sweep whose points are plain sums, for tests of what happens around them."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from afm_jax.studies.sweep import Axis, Columns, Recorder, SweepPlan, plan_of

SIZES = (7, 12)
"""Of the axes; the chunks of ten points do not fill them evenly."""


def recorder(given: Mapping[str, Any], axes: Sequence[Axis]) -> Recorder:  # noqa: ARG001
    """Return what adds a tenth of y to x."""

    def work(columns: Columns) -> Columns:
        found = columns["x"] + 0.1 * columns["y"]
        sums = np.where(found < 2.0, np.nan, found)
        return {"sum_nm": sums, "large": found > 4.0, "parts": np.stack([found] * 2, 1)}

    return Recorder(work, 10, ("sum_nm", "large"), {"part": (1, 2)})


def plan(*, chunk: int | None = None, last: float = 11.0, **record: Any) -> SweepPlan:
    """Return a plan of sums."""
    axes = [{"parameter": "x", "linear": [0.0, 6.0, SIZES[0]]}, {"parameter": "y", "linear": [0.0, last, SIZES[1]]}]
    return plan_of({"axes": axes, "record": record, "chunk": chunk}, recorder)


def contents(folder: Path) -> dict[str, bytes]:
    """Return everything in a sweep's folder."""
    files = [path for path in folder.rglob("*") if path.is_file()]
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}
