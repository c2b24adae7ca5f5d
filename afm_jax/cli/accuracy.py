"""`afm-jax accuracy`: error against time, and the cheapest setting for a wanted error."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from afm_jax.cli.accuracy_scene import scene_study, write_study
from afm_jax.cli.session import Session
from afm_jax.cli.values import PRESET_NAMES
from afm_jax.words import known

if TYPE_CHECKING:
    from rich.table import Table

COLUMNS = (
    "scene",
    "method",
    "tolerance",
    "microseconds_per_impact",
    "error_us",
    "median_error_us",
    "sequence_error_us",
    "impacts_checked",
    "near_grazing",
    "near_grazing_error_us",
    "lost_impacts",
    "evaluations_per_impact",
    "missed_impacts",
    "compile_s",
    "reason",
)
"""What `accuracy.csv` tells of a setting."""
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

COLLIDE_COLUMNS = (
    "method",
    "variable",
    "setting",
    "precision",
    "tolerance",
    "microseconds_per_impact",
    "rebound_error",
    "delay_error_us",
    "slope_error",
    "near_capture_error",
    "evaluations_per_impact",
    "compile_s",
    "reason",
)
"""What `accuracy.csv` tells of a contestant of `collide`."""
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
"""What `accuracy.csv` tells of a method."""
WANTED = [1e-3, 1e-6, 1e-9, 1e-11]


def accuracy(
    session: Session, study: str | None, wanted_error_us: float, accuracy: float, *, contacts: int, quick: bool
) -> None:
    """Measure errors against time, of everything or of one study."""
    if study is None:
        overview_study(session, quick=quick)
        return
    if study not in {"map", "collide"}:
        if not is_scene(study):
            raise click.UsageError(f"there is no accuracy study of `{study}`; choose: map, collide, or a scene file")
        scene_study(session, study, contacts, quick=quick)
        return
    if study == "collide":
        collide_study(session, accuracy, quick=quick)
        return
    from afm_jax.accuracy.impacts import cheapest_settings  # noqa: PLC0415
    from afm_jax.bench.timing import run_in_own_process  # noqa: PLC0415

    with session.working("measuring"):
        result = run_in_own_process("afm_jax.accuracy.impacts:map_accuracy", QUICK if quick else FULL, cores=1)
    cheapest = cheapest_settings(result["rows"], wanted_error_us)
    payload = {**result, "wanted_error_us": wanted_error_us, "cheapest": cheapest}
    session.write_table("accuracy.csv", result["rows"], COLUMNS)
    write_study(session, payload, lambda plots: plots.accuracy_figure(result["rows"], wanted_error_us))
    session.emit(
        payload,
        accuracy_table(result["rows"]),
        f"Reference: 50 digits, its own error {result['reference_error_us']:.0e} us. Default of next_impact: float64, "
        f"root tolerance {result['default_root_tolerance_us']:g} us.",
        *(cheapest_sentence(choice, wanted_error_us) for choice in cheapest),
    )


def overview_study(session: Session, *, quick: bool) -> None:
    """Run and show what each digit costs in everything."""
    from afm_jax.accuracy.overview import cheapest  # noqa: PLC0415
    from afm_jax.bench.timing import run_in_own_process  # noqa: PLC0415

    rows: list[dict[str, Any]] = []
    references: dict[str, dict[str, Any]] = {}
    with session.working("measuring (some minutes)"):
        for task, settings in (OVERVIEW_QUICK if quick else OVERVIEW_FULL).items():
            found = run_in_own_process(task, settings, cores=1)
            rows, references = rows + found["rows"], references | found["references"]
    choices = cheapest(rows, WANTED)
    payload = {"rows": rows, "references": references, "cheapest": choices}
    session.write_table("accuracy.csv", rows, OVERVIEW_COLUMNS)
    write_study(session, payload, lambda plots: plots.overview_figure(rows, references))
    told = [
        f"{problem}: error of the {known['error_of']}, against {known['reference']}, itself known to "
        f"{known['reference_error']:.0e}"
        for problem, known in references.items()
    ]
    session.emit(payload, overview_table(choices), *told)


def overview_table(choices: Sequence[dict[str, Any]]) -> "Table":
    """Return what each wanted error costs, here and elsewhere."""
    from rich.table import Table  # noqa: PLC0415

    table = Table(title="The fastest way to a wanted error (one core)", title_justify="left")
    for heading in ("problem", "error", "here", "us", "others", "us"):
        table.add_column(heading, justify="right" if heading in {"error", "us"} else "left")
    for row in choices:
        cells = [row["problem"], f"{row['wanted_error']:g}"]
        for who in ("own", "other"):
            cells += [row[who] or "none", known(row[f"{who}_microseconds"])]
        table.add_row(*cells)
    return table


def is_scene(name: str) -> bool:
    """Return whether a name can only be a scene's: a file, a path, or a preset."""
    return name.endswith(".toml") or Path(name).exists() or name in PRESET_NAMES


def collide_study(session: Session, accuracy: float, *, quick: bool) -> None:
    """Run and show the accuracy study of `collide`."""
    from afm_jax.accuracy.collisions import cheapest_collision  # noqa: PLC0415
    from afm_jax.bench.timing import run_in_own_process  # noqa: PLC0415

    with session.working("measuring"):
        task = "afm_jax.accuracy.collisions:collide_accuracy"
        result = run_in_own_process(task, COLLIDE_QUICK if quick else COLLIDE_FULL, cores=1)
    best = cheapest_collision(result["rows"], accuracy)
    payload = {**result, "accuracy": accuracy, "cheapest": best}
    session.write_table("accuracy.csv", result["rows"], COLLIDE_COLUMNS)
    write_study(session, payload, lambda plots: plots.collide_accuracy_figure(result["rows"]))
    sentence = (
        f"No contestant reaches {accuracy:g}."
        if best is None
        else f"Cheapest for {accuracy:g}: {best['method']}, {best['setting']}, in the {best['variable']}: "
        f"{best['microseconds_per_impact']:.3g} us an impact, errors {best['rebound_error']:.1e} and "
        f"{best['delay_error_us']:.1e} us."
    )
    reference = f"Reference: quadrature converged to {result['reference_error']:.0e}."
    session.emit(payload, collide_table(result["rows"]), reference, sentence)


def collide_table(rows: Sequence[dict[str, Any]]) -> "Table":
    """Return the contestants of `collide` as a table."""
    from rich.table import Table  # noqa: PLC0415

    table = Table(title="Error of a collision against the time it takes, 12 to 200 nm/us (one core)")
    for heading in ("method", "in", "setting", "precision"):
        table.add_column(heading)
    for heading in ("us/impact", "u_out error", "delay error us", "slopes' error", "near capture", "compile s"):
        table.add_column(heading, justify="right")
    names = ("microseconds_per_impact", "rebound_error", "delay_error_us", "slope_error", "near_capture_error")
    for row in rows:
        cells = [known(row.get(name)) for name in (*names, "compile_s")]
        table.add_row(row["method"], row["variable"], row["setting"], row["precision"], *cells)
    return table


def accuracy_table(rows: Sequence[dict[str, Any]]) -> "Table":
    """Return the settings as a table."""
    from rich.table import Table  # noqa: PLC0415

    table = Table(title="Error of an impact time against the time it takes (one core)")
    for heading in ("scene", "method"):
        table.add_column(heading)
    # SciPy's tolerance is relative and in nm; the map's is in us
    for heading in ("tolerance", "us/impact", "largest error us", "median us", "after sequence us", "near grazing us"):
        table.add_column(heading, justify="right")
    names = ("tolerance", "microseconds_per_impact", "error_us", "median_error_us", "sequence_error_us")
    for row in rows:
        cells = [known(row.get(name)) for name in (*names, "near_grazing_error_us")]
        table.add_row(row["scene"], row["method"], *cells)
    return table


def cheapest_sentence(choice: dict[str, Any], wanted_error_us: float) -> str:
    """Say which setting is the cheapest for a scene, or that none is good enough."""
    where = "in all scenes" if choice["scene"] == "all" else f"in the scene `{choice['scene']}`"
    if choice["method"] is None:
        return f"No setting reaches {wanted_error_us:g} us {where}."
    return (
        f"Cheapest for {wanted_error_us:g} us {where}: {choice['method']}, root tolerance {choice['tolerance']:g} us "
        f"({choice['microseconds_per_impact']:.3g} us an impact, error {choice['error_us']:.1e} us)."
    )
