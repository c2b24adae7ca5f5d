"""`afm-jax accuracy`: error against time, of a value and of its gradient."""

from typing import Annotated

from click import IntRange

from afm_jax.cli.command import Output, picture_of
from afm_jax.cli.scenes import load_named
from afm_jax.cli.session import Session
from afm_jax.columns import columns_of
from afm_jax.report import table_of
from afm_jax.studies import timing
from afm_jax.studies.accuracy import measured

_COLUMNS = ("of", "method", "setting", "microseconds", "error", "compile_s", "reason")
_CELLS = {name: name for name in ("of", "method", "setting", "microseconds", "error", "compile_s")}


def accuracy(
    session: Session,
    study: Annotated[str, "[map|collide|SCENE.toml|PRESET]"] = "map",
    *,
    contacts: Annotated[int, IntRange(1, 10_000)] = 10,
    quick: bool = False,
) -> Output:
    """Show errors of a value and of its gradient against the time they take, beside SciPy and Diffrax.

    map: the time of the next impact, by start and velocity; errors are against the finest root tolerance. collide: the
    rebound speed of the paper's contact, by speed and viscosity; errors are against a quadrature converged to rounding.
    SCENE.toml (or a preset's name): the arrival of one of the first contacts, however the scene is driven, by the
    start's velocity; errors are against the finest setting. SciPy's DOP853 and Diffrax's Dopri8 follow the same
    equations phase by phase, each ended by an event. Some minutes. With --out accuracy.csv, accuracy.json and
    accuracy.png.

    Args:
        session: for progress.
        study: what is measured.
        contacts: for a scene: number of the contact whose arrival is compared.
        quick: few and small measurements, to check that it works.
    """
    if study not in ("map", "collide"):
        # what is wrong with a file is said at once, and what it leaves to be assumed
        load_named(study)
    with session.working("measuring"):
        result = timing.run_in_own_process(measured, problem=study, contacts=contacts, quick=quick)
    rows = result["rows"]
    title = f"Error of the {result['value_of']} and of its gradient against time"
    reference = (
        f"Reference: {result['reference']}, itself known to {result['reference_error']:.0e} (gradient: "
        f"{result['reference_gradient_error']:.0e}). Times are those of one impact or contact on one core, programs "
        "compiled. A gradient is that by all parameters of the problem, relative to its largest value among the tips."
    )
    return Output(
        payload={"problem": study, **result},
        text=[
            title,
            table_of(_CELLS, rows, form=".3g"),
            *dict.fromkeys(f"{row['method']}, {row['setting']}: {row['reason']}" for row in rows if "reason" in row),
            reference,
        ],
        tables={"accuracy.csv": columns_of(rows, _COLUMNS)},
        files={"accuracy.png": picture_of("accuracy:accuracy_figure", result)},
        json_file="accuracy.json",
    )
