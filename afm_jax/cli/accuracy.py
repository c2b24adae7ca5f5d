"""`afm-jax accuracy`: error against time, of a value and of its gradient."""

from collections.abc import Mapping
from typing import Any

from afm_jax.cli.command import Output, picture_of
from afm_jax.cli.session import Session
from afm_jax.cli.values import scene_and_start
from afm_jax.columns import columns_of, printed_table
from afm_jax.studies import timing
from afm_jax.studies.accuracy import measured

_COLUMNS = ("of", "method", "setting", "microseconds", "error", "compile_s", "reason")
_CELLS = {name: name for name in ("of", "method", "setting", "microseconds", "error", "compile_s")}


def accuracy(session: Session, study: str, *, contacts: int, quick: bool) -> Output:
    """Measure errors and times of the impact map, of collisions, or of a scene."""
    if study not in ("map", "collide"):
        # what is wrong with a file is said at once, and what it leaves to be assumed
        _ = scene_and_start(study)
    with session.working("measuring"):
        result = timing.run_in_own_process(measured, problem=study, contacts=contacts, quick=quick)
    rows = result["rows"]
    return Output(
        payload={"problem": study, **result},
        text=[
            printed_table(
                f"Error of the {result['value_of']} and of its gradient against time", _CELLS, rows, form=".3g"
            ),
            *dict.fromkeys(f"{row['method']}, {row['setting']}: {row['reason']}" for row in rows if "reason" in row),
            reference_sentence(result),
        ],
        tables={"accuracy.csv": columns_of(rows, _COLUMNS)},
        files={"accuracy.png": picture_of("accuracy:accuracy_figure", result)},
        json_file="accuracy.json",
    )


def reference_sentence(result: Mapping[str, Any]) -> str:
    """Say what the errors are measured against, how good that is, and what the times are of."""
    return (
        f"Reference: {result['reference']}, itself known to {result['reference_error']:.0e} (gradient: "
        f"{result['reference_gradient_error']:.0e}). Times are those of one impact or contact on one core, programs "
        "compiled. A gradient is that by all parameters of the problem, relative to its largest value among the tips."
    )
