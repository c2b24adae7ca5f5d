"""`afm-jax accuracy`: error against time, and the cheapest setting for a wanted error."""

from pathlib import Path
from typing import Any

import click

from afm_jax.accuracy.collisions import cheapest_collision
from afm_jax.accuracy.impacts import cheapest_settings
from afm_jax.accuracy.overview import cheapest
from afm_jax.bench.study import StudyTable
from afm_jax.cli.accuracy_scene import scene_study
from afm_jax.cli.command import Output, picture_of
from afm_jax.cli.session import Session
from afm_jax.cli.values import PRESET_NAMES
from afm_jax.columns import Cell, columns_of, printed_table
from afm_jax.studies import timing

Row = dict[str, Any]

MAP = StudyTable(
    "accuracy.csv",
    (
        *("scene", "method", "tolerance", "microseconds_per_impact", "error_us", "median_error_us"),
        *("sequence_error_us", "impacts_checked", "near_grazing", "near_grazing_error_us", "lost_impacts"),
        *("evaluations_per_impact", "missed_impacts", "compile_s", "reason"),
    ),
    "Error of an impact time against the time it takes (one core)",
    # SciPy's tolerance is relative and in nm; the map's is in us
    {
        "scene": "scene",
        "method": "method",
        "tolerance": "tolerance",
        "us/impact": "microseconds_per_impact",
        "largest error us": "error_us",
        "median us": "median_error_us",
        "after sequence us": "sequence_error_us",
        "near grazing us": "near_grazing_error_us",
    },
)
FULL = {
    "root_tolerances_us": [1e-1, 1e-2, 1e-4, 1e-6, 1e-8, 1e-10, 1e-12, 1e-13, 1e-14],
    "scipy_tolerances": [1e-4, 1e-6, 1e-8, 1e-10, 1e-12],
    "batch": 2000,
    "impacts": 20,
    "lanes": 3,
    "repetitions": 5,
}
QUICK = {
    "root_tolerances_us": [1e-1, 1e-6, 1e-13],
    "scipy_tolerances": [1e-8],
    "batch": 20,
    "impacts": 5,
    "lanes": 1,
    "repetitions": 1,
}

COLLIDE = StudyTable(
    "accuracy.csv",
    (
        *("method", "variable", "setting", "precision", "tolerance", "microseconds_per_impact", "rebound_error"),
        *("delay_error_us", "slope_error", "near_capture_error", "evaluations_per_impact", "compile_s", "reason"),
    ),
    "Error of a collision against the time it takes, 12 to 200 nm/us (one core)",
    {
        "method": "method",
        "in": "variable",
        "setting": "setting",
        "precision": "precision",
        "us/impact": "microseconds_per_impact",
        "u_out error": "rebound_error",
        "delay error us": "delay_error_us",
        "slopes' error": "slope_error",
        "near capture": "near_capture_error",
        "compile s": "compile_s",
    },
)
COLLIDE_FULL = {
    "tolerances": [1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10, 1e-11],
    "solvers": {"gap": ["Tsit5", "Dopri5", "Dopri8", "Kvaerno5"], "time": ["Tsit5", "Dopri8"]},
    "accuracies": [1e-5, 1e-6, 1e-9, 1e-11],
    "steps": [2, 8],
    "batch": 500,
    "repetitions": 3,
    "integrators": [["DOP853", "LSODA"], [12.0, 30.0, 100.0]],
}
COLLIDE_QUICK = {
    "tolerances": [1e-6],
    "solvers": {"gap": ["Dopri8"]},
    "accuracies": [1e-9],
    "steps": [],
    "batch": 8,
    "repetitions": 1,
    "integrators": [["DOP853", "LSODA"], [30.0]],
}

_INTEGRATORS = ["DOP853", "LSODA", "Radau", "CVODE Adams"]
_LEVELS = {"accuracies": [1e-3, 1e-5, 1e-6, 1e-9, 1e-11], "integrators": _INTEGRATORS, "repetitions": 3}
_STEPS_DOWN = [1e-4, 1e-6, 1e-8, 1e-10, 1e-12]
OVERVIEW_FULL = {
    "afm_jax.accuracy.overview:impacts": {
        "root_tolerances_us": [1e-1, 1e-2, 1e-4, 1e-8, 1e-13],
        "tolerances": _STEPS_DOWN,
        "integrators": _INTEGRATORS,
        "batch": 2000,
        "impacts": 10,
        "repetitions": 3,
    },
    "afm_jax.accuracy.overview:collisions": _LEVELS
    | {"tolerances": _STEPS_DOWN, "speeds": [12.0, 30.0, 100.0], "batch": 200},
    "afm_jax.accuracy.overview:driven_contacts": _LEVELS | {"tolerances": _STEPS_DOWN, "contacts": 6, "batch": 200},
    "afm_jax.accuracy.overview:orbits": {
        "tolerances": _STEPS_DOWN,
        "integrators": _INTEGRATORS,
        "batch": 1000,
        "repetitions": 3,
    },
    "fitting.benchmark:minimum_accuracy": {
        "rows": 60,
        "settled": [1e0, 1e-3, 1e-6, 1e-10, 1e-16, 1e-22],
        "tolerances": [1e-2, 1e-4, 1e-8, 1e-12, 1e-15],
        "repetitions": 3,
    },
}
"""The studies of the overview, each run in a process of its own, and their settings."""
_FEW = {"tolerances": [1e-8], "integrators": ["DOP853"], "repetitions": 1}
OVERVIEW_QUICK = {
    "afm_jax.accuracy.overview:impacts": _FEW | {"root_tolerances_us": [1e-1, 1e-13], "batch": 20, "impacts": 3},
    "afm_jax.accuracy.overview:collisions": _FEW | {"accuracies": [1e-9], "speeds": [30.0], "batch": 8},
    "afm_jax.accuracy.overview:driven_contacts": _FEW | {"accuracies": [1e-6], "contacts": 1, "batch": 4},
    "afm_jax.accuracy.overview:orbits": _FEW | {"batch": 10},
    "fitting.benchmark:minimum_accuracy": {"rows": 20, "settled": [1e-10], "tolerances": [1e-8], "repetitions": 1},
}
OVERVIEW_COLUMNS = ("problem", "method", "setting", "microseconds", "error", "reason")
"""What `accuracy.csv` tells of a method in the overview."""
_CHEAPEST: dict[str, Cell] = {
    "problem": "problem",
    "error": "wanted_error:g",
    "here": lambda row: row["own"] or "none",
    "us here": "own_microseconds",
    "others": lambda row: row["other"] or "none",
    "us there": "other_microseconds",
}
WANTED = [1e-3, 1e-6, 1e-9, 1e-11]


def accuracy(
    session: Session, study: str | None, wanted_error_us: float, accuracy: float, *, contacts: int, quick: bool
) -> Output:
    """Measure errors against time, of everything or of one study."""
    if study is None:
        return overview_study(session, quick=quick)
    if study == "map":
        return map_study(session, wanted_error_us, quick=quick)
    if study == "collide":
        return collide_study(session, accuracy, quick=quick)
    if is_scene(study):
        return scene_study(session, study, contacts, quick=quick)
    raise click.UsageError(f"there is no accuracy study of `{study}`; choose: map, collide, or a scene file")


def is_scene(name: str) -> bool:
    """Return whether a name can only be a scene's: a file, a path, or a preset."""
    return name.endswith(".toml") or Path(name).exists() or name in PRESET_NAMES


def overview_study(session: Session, *, quick: bool) -> Output:
    """Return what each digit costs in everything."""
    rows: list[Row] = []
    references: dict[str, Row] = {}
    with session.working("measuring (some minutes)"):
        for task, settings in (OVERVIEW_QUICK if quick else OVERVIEW_FULL).items():
            found = timing.run_in_own_process(task, settings, cores=1)
            rows, references = rows + found["rows"], references | found["references"]
    choices = cheapest(rows, WANTED)
    told = [
        f"{problem}: error of the {known['error_of']}, against {known['reference']}, itself known to "
        f"{known['reference_error']:.0e}"
        for problem, known in references.items()
    ]
    return Output(
        payload={"rows": rows, "references": references, "cheapest": choices},
        text=[printed_table("The fastest way to a wanted error (one core)", _CHEAPEST, choices, form=".3g"), *told],
        tables={"accuracy.csv": columns_of(rows, OVERVIEW_COLUMNS)},
        files={"accuracy.png": picture_of("accuracy:overview_figure", rows, references)},
        json_file="accuracy.json",
    )


def map_study(session: Session, wanted_error_us: float, *, quick: bool) -> Output:
    """Return error against time of impact times."""
    with session.working("measuring"):
        result = timing.run_in_own_process("afm_jax.accuracy.impacts:map_accuracy", QUICK if quick else FULL, cores=1)
    rows, choices = result["rows"], cheapest_settings(result["rows"], wanted_error_us)
    reference = (
        f"Reference: 50 digits, its own error {result['reference_error_us']:.0e} us. Default of next_impact: float64, "
        f"root tolerance {result['default_root_tolerance_us']:g} us."
    )
    return Output(
        payload={**result, "wanted_error_us": wanted_error_us, "cheapest": choices},
        text=[
            MAP.printed(rows),
            reference,
            *(cheapest_sentence(choice, wanted_error_us) for choice in choices),
        ],
        tables=MAP.written(rows),
        files={"accuracy.png": picture_of("accuracy:accuracy_figure", rows, wanted_error_us)},
        json_file="accuracy.json",
    )


def collide_study(session: Session, accuracy: float, *, quick: bool) -> Output:
    """Return error against time of `collide`."""
    with session.working("measuring"):
        task = "afm_jax.accuracy.collisions:collide_accuracy"
        result = timing.run_in_own_process(task, COLLIDE_QUICK if quick else COLLIDE_FULL, cores=1)
    rows, best = result["rows"], cheapest_collision(result["rows"], accuracy)
    sentence = (
        f"No contestant reaches {accuracy:g}."
        if best is None
        else f"Cheapest for {accuracy:g}: {best['method']}, {best['setting']}, in the {best['variable']}: "
        f"{best['microseconds_per_impact']:.3g} us an impact, errors {best['rebound_error']:.1e} and "
        f"{best['delay_error_us']:.1e} us."
    )
    reference = f"Reference: quadrature converged to {result['reference_error']:.0e}."
    return Output(
        payload={**result, "accuracy": accuracy, "cheapest": best},
        text=[COLLIDE.printed(rows), reference, sentence],
        tables=COLLIDE.written(rows),
        files={"accuracy.png": picture_of("accuracy:collide_accuracy_figure", rows)},
        json_file="accuracy.json",
    )


def cheapest_sentence(choice: Row, wanted_error_us: float) -> str:
    """Say which setting is the cheapest for a scene, or that none is good enough."""
    where = "in all scenes" if choice["scene"] == "all" else f"in the scene `{choice['scene']}`"
    if choice["method"] is None:
        return f"No setting reaches {wanted_error_us:g} us {where}."
    return (
        f"Cheapest for {wanted_error_us:g} us {where}: {choice['method']}, root tolerance {choice['tolerance']:g} us "
        f"({choice['microseconds_per_impact']:.3g} us an impact, error {choice['error_us']:.1e} us)."
    )
