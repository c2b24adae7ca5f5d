"""A sweep whose points are plain sums, for tests of what happens around them; and a program that runs one."""

import json
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from afm_jax.studies.sweep import MESSAGE, Axis, Columns, Recorder, SweepPlan, plan_of, run_plan

SIZES = (7, 12)
"""Of the axes; the chunks of ten points do not fill them evenly."""


def recorder(given: Mapping[str, Any], axes: Sequence[Axis]) -> Recorder:  # noqa: ARG001
    """Return what adds a tenth of y to x; slowly if asked for."""
    record = given["record"]

    def work(columns: Columns) -> Columns:
        time.sleep(record.get("seconds", 0.0))
        found = columns["x"] + 0.1 * columns["y"]
        sums = np.where(found < 2.0, np.nan, found)
        why = np.where(found < 2.0, "the sum is below 2 \u00e4", "")
        results = {"sum_nm": sums, "large": found > 4.0, "parts": np.stack([found] * 2, 1)}
        return results | ({MESSAGE: why} if record.get("explained") else {})

    return Recorder(work, 10, ("sum_nm", "large"), {"part": (1, 2)})


def plan(*, chunk: int | None = None, last: float = 11.0, **record: Any) -> SweepPlan:
    """Return a plan of sums."""
    axes = [{"parameter": "x", "linear": [0.0, 6.0, SIZES[0]]}, {"parameter": "y", "linear": [0.0, last, SIZES[1]]}]
    return plan_of({"axes": axes, "record": record, "chunk": chunk}, recorder)


def contents(folder: Path) -> dict[str, bytes]:
    """Return everything in a sweep's folder."""
    files = [path for path in folder.rglob("*") if path.is_file()]
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


if __name__ == "__main__":
    # python -m tests.sweep_numbers FOLDER '{"seconds": 0.1}'
    jax.config.update("jax_enable_x64", True)  # noqa: FBT003
    done = run_plan(plan(**json.loads(sys.argv[2])), Path(sys.argv[1]))
    sys.stdout.write(json.dumps({"kept": done.kept, "computed": done.computed}) + "\n")
