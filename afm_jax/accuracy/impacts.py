"""Error of impact times against the time they take: root tolerances, float32 and float64, next to SciPy.

Runs in a process of its own on one core (`run_in_own_process`). Errors are achieved ones, against 50 digits, impact by
impact from the computed state before each, near-grazing ones apart: there a time has fewer digits whatever computes it.
"""

from collections.abc import Callable, Sequence
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
from jaxtyping import Array
from numpy.typing import NDArray

from afm_jax.apparatus.scene import Scene
from afm_jax.bench.impacts import ImpactErrors, lane_states, sequence_errors, single_errors
from afm_jax.bench.integrators import EVENT, title
from afm_jax.bench.problems import (
    BenchmarkScene,
    Starts,
    cast,
    grazing_scene,
    high_order_scene,
    regular_scene,
    settled_starts,
)
from afm_jax.bench.scipy_impacts import scipy_impacts
from afm_jax.bench.study import Contestant, Row, measured, named, timed
from afm_jax.checks import float32_allowed
from afm_jax.impact.first_impact import DEFAULT_ROOT_TOLERANCE_US
from afm_jax.impact.law import impact_law_of
from afm_jax.impact.map import iterate_batch
from afm_jax.outcomes import Outcome
from afm_jax.studies.timing import compiled_for
from afm_jax.verify.fifty_digits import reference_error

COST = ("microseconds_per_impact", "error_us")
PRECISIONS = ("float64", "float32")
_LONGEST_PERIODS = 10.0
"""Drive periods that Diffrax follows a tip to its next impact."""
_MISSED_BY_US = 1e-2
"""An impact found later than this was not the first; no contestant's error is as large."""


def map_accuracy(
    *,
    root_tolerances_us: list[float],
    scipy_tolerances: list[float],
    batch: int,
    impacts: int,
    lanes: int,
    repetitions: int,
) -> dict[str, Any]:
    """Measure error and time of the impact map on three scenes.

    Args:
        root_tolerances_us: tolerances of the search for the impact.
        scipy_tolerances: of `solve_ivp`, relative and absolute.
        batch: how many tips the time is measured with.
        impacts: length of a sequence.
        lanes: how many tips the error is measured with.
        repetitions: of each time measurement.

    Returns:
        `rows`, each with scene, method, tolerance, microseconds_per_impact, compile_s, error_us (largest of single
        impacts), median_error_us, sequence_error_us (after `impacts`; None where chaotic), impacts_checked,
        near_grazing (count), near_grazing_error_us, lost_impacts (after a start that rounding ended); of SciPy
        evaluations_per_impact, missed_impacts and, where it failed, reason. And `reference_error_us`, the error of the
        50-digit sequences; `default_root_tolerance_us`.
    """
    rows: list[Row] = []
    doubts = []
    for case in (regular_scene(), grazing_scene(), high_order_scene()):
        starts = slow_ones_first(case, settled_starts(case.scene, batch), impacts, lanes)
        sizes = (impacts, lanes, repetitions)
        contestants = (
            *(map_contestant(case, starts, precision, root_tolerances_us, sizes) for precision in PRECISIONS),
            integrator_contestant(case, starts, "DOP853", scipy_tolerances, impacts),
        )
        for row in measured(f"accuracy: {case.name} scene", contestants, unknown=COST):
            del row["setting"]
            rows.append({"scene": case.name, **row})
        if not case.chaotic:
            doubts.append(doubt_of_reference(case, starts, impacts))
    return {
        "rows": rows,
        "reference_error_us": max(doubts),
        "default_root_tolerance_us": DEFAULT_ROOT_TOLERANCE_US,
    }


def cheapest_settings(rows: Sequence[Row], wanted_error_us: float) -> list[Row]:
    """Return per scene the fastest setting of the map whose error of a single impact is small enough.

    Args:
        rows: of `map_accuracy`.
        wanted_error_us: the largest error allowed, of an impact that is not near grazing.

    Returns:
        Rows with scene, method, tolerance, microseconds_per_impact and error_us, None where no setting is good
        enough. The last one, scene "all", is good enough everywhere and fastest in the slowest scene.
    """
    own = [row for row in rows if row["method"].startswith("next_impact")]
    scenes = list(dict.fromkeys(row["scene"] for row in own))
    choices = [_fastest(scene, [row for row in own if row["scene"] == scene], wanted_error_us) for scene in scenes]
    worst = []
    for setting in dict.fromkeys((row["method"], row["tolerance"]) for row in own):
        same = [row for row in own if (row["method"], row["tolerance"]) == setting]
        known = [row["error_us"] for row in same if row["error_us"] is not None]
        slowest = max(row["microseconds_per_impact"] for row in same)
        error = max(known) if len(known) == len(scenes) else None
        worst.append(same[0] | {"error_us": error, "microseconds_per_impact": slowest})
    return [*choices, _fastest("all", worst, wanted_error_us)]


def _fastest(scene: str, rows: Sequence[Row], wanted_error_us: float) -> Row:
    good = [row for row in rows if row["error_us"] is not None and row["error_us"] <= wanted_error_us]
    best = min(good, key=lambda row: row["microseconds_per_impact"], default=None)
    names = ("method", "tolerance", "microseconds_per_impact", "error_us")
    return {"scene": scene, **{name: None if best is None else best[name] for name in names}}


def map_contestant(
    case: BenchmarkScene, starts: Starts, precision: str, tolerances: Sequence[float], sizes: tuple[int, int, int]
) -> Contestant:
    """Return the impact map with root tolerances as settings; sizes: impacts, lanes and repetitions."""
    impacts, lanes, repetitions = sizes
    scene = cast(case.scene, precision)
    starts = jax.tree.map(lambda part: part.astype(precision), starts)
    dtype = np.dtype(precision).type

    def run(scene, starts, tolerance):
        return iterate_batch(scene, starts.time_us, starts.velocity_nm_per_us, impacts, root_tolerance_us=tolerance)

    with float32_allowed():
        compiled = compiled_for(run, scene, starts, dtype(tolerances[0]))
    tips = starts.time_us.shape[0]

    def measure(tolerance: float) -> Row:
        row, result = timed(compiled, scene, starts, dtype(tolerance), repetitions=repetitions, events=impacts * tips)
        del row["median_microseconds_per_impact"]
        errors = single_errors(case, starts, result, lanes=lanes)
        states = [lane_states(starts, result, lane) for lane in range(min(lanes, tips))]
        return row | {
            **_error_columns(errors),
            "lost_impacts": impacts * len(states) - len(errors.ordinary) - len(errors.near_grazing),
            "sequence_error_us": None
            if case.chaotic
            else float(np.max([sequence_errors(case, lane) for lane in states])),
        }

    return Contestant(f"next_impact {precision}", named("root tolerance", tolerances, " us"), measure, "tolerance")


def _error_columns(errors: ImpactErrors) -> Row:
    ordinary, grazing = (part[np.isfinite(part)] for part in errors)
    return {
        "error_us": float(ordinary.max()) if ordinary.size else None,
        "median_error_us": float(np.median(ordinary)) if ordinary.size else None,
        "impacts_checked": ordinary.size,
        "near_grazing": len(errors.near_grazing),
        "near_grazing_error_us": float(grazing.max()) if grazing.size else None,
    }


def integrator_contestant(
    case: BenchmarkScene, starts: Starts, method: str, tolerances: Sequence[float], impacts: int
) -> Contestant:
    """Return a general-purpose integrator that follows the first tip, with its tolerances as settings."""
    start = (float(starts.time_us[0]), float(starts.velocity_nm_per_us[0]))

    def measure(tolerance: float) -> Row:
        run = scipy_impacts(case.scene, start, impacts, tolerance=tolerance, method=method)
        errors = sequence_errors(case._replace(chaotic=True), run.states)
        return {
            "microseconds_per_impact": 1e6 * run.seconds / impacts,
            **_error_columns(ImpactErrors(errors, errors[:0])),
            "sequence_error_us": None if case.chaotic else float(sequence_errors(case, run.states)[0]),
            "evaluations_per_impact": run.evaluations / impacts,
            "missed_impacts": _missed(case, run.states),
        }

    return Contestant(title(method), named("tolerance", tolerances), measure, "tolerance")


def event_contestant(
    case: BenchmarkScene, starts: Starts, tolerances: Sequence[float], impacts: int, repetitions: int
) -> Contestant:
    """Return Diffrax's own events, begun again after each impact: what a user of Diffrax would write."""
    next_one = diffrax_impact(case.scene)

    def run(time: Array, velocity: Array, tolerance: Array) -> Array:
        def step(state: Array, _: None) -> tuple[Array, Array]:
            after = next_one(state, tolerance)
            return after, after

        return jax.lax.scan(step, jnp.stack([time, velocity]), None, length=impacts)[1]

    first = (starts.time_us[0], starts.velocity_nm_per_us[0])
    compiled = compiled_for(run, *first, jnp.asarray(tolerances[0]))

    def measure(tolerance: float) -> Row:
        row, after = timed(compiled, *first, jnp.asarray(tolerance), repetitions=repetitions, events=impacts)
        states = np.vstack([[float(part) for part in first], np.asarray(after)])
        errors = sequence_errors(case._replace(chaotic=True), states)
        return row | {"error_us": float(np.max(errors))}

    return Contestant(EVENT, named("tolerance", tolerances), measure, "tolerance")


def diffrax_impact(scene: Scene) -> Callable[[Array, Array], Array]:
    """Return the function from time and velocity after an impact, and a tolerance, to those after the next."""
    law, cantilever, platform = impact_law_of(scene), scene.cantilever, scene.platform
    period = platform.period_us

    def motion(time: Any, state: Any, args: Any) -> Any:
        del time, args
        return state[1], cantilever.acceleration(*state)

    def gap(t: Any, y: Any, args: Any, **extra: Any) -> Any:
        del args, extra
        return y[0] - platform.position(t)

    def next_impact(start: Array, tolerance: Array) -> Array:
        time, velocity = start
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(motion),
            diffrax.Dopri8(),
            time,
            time + _LONGEST_PERIODS * period,
            None,
            (platform.position(time), velocity),
            stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance, dtmax=period / 3.0),
            # downwards alone: it leaves with a gap of 0
            event=diffrax.Event(gap, optimistix.Newton(1e-14, 1e-14), direction=False),
            adjoint=diffrax.ForwardMode(),
            throw=False,
        )
        assert solution.ts is not None  # noqa: S101 (for the type checker: the end is saved)
        assert solution.ys is not None  # noqa: S101
        arrival, before = solution.ts[-1], solution.ys[1][-1]
        speed = platform.velocity(arrival)
        return jnp.stack([arrival, speed + law.rebound_speed(speed - before)])

    return next_impact


def _missed(case: BenchmarkScene, states: NDArray[np.float64]) -> int:
    """Return in how many flights there is an earlier impact than the one that was found."""
    before = iterate_batch(case.scene, states[:-1, 0], states[:-1, 1], 1)
    return int(np.sum(np.asarray(before.time_us[:, 0]) < states[1:, 0] - _MISSED_BY_US))


def slow_ones_first(case: BenchmarkScene, starts: Starts, impacts: int, lanes: int) -> Starts:
    """Return the starts with those first whose error is measured: from a median tip to the slowest of 200."""
    rows = iterate_batch(case.scene, starts.time_us, starts.velocity_nm_per_us, impacts)
    approach = case.scene.platform.velocity(rows.time_us) - rows.velocity_before_nm_per_us
    slowest = jnp.min(jnp.where(rows.outcome == Outcome.IMPACT, approach, jnp.inf), axis=1)
    ranking = np.argsort(np.asarray(slowest))
    chosen = ranking[(np.geomspace(0.5, 0.005, lanes) * len(ranking)).astype(int)]
    order = np.concatenate([chosen, np.setdiff1d(ranking, chosen)])
    return Starts(starts.time_us[order], starts.velocity_nm_per_us[order])


def doubt_of_reference(case: BenchmarkScene, starts: Starts, impacts: int) -> float:
    """Return the error of the 50-digit sequence of the first tip, in us."""
    first = Starts(starts.time_us[:1], starts.velocity_nm_per_us[:1])
    states = lane_states(first, iterate_batch(case.scene, first.time_us, first.velocity_nm_per_us, impacts), 0)
    return reference_error(case.scene, tuple(states[0]), states[1:, 0])
