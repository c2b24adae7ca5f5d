"""Impacts per second: the map in batches, on one core and on all, its derivatives, and SciPy on the same problem.

Each function here runs in a process of its own (`run_in_own_process`) and returns rows as plain dicts:

what, scene, batch, cores, block, impacts, microseconds_per_impact (best), median_microseconds_per_impact,
impacts_per_second, compile_s, error_us (of impact times, against 50 digits), error_kind ("after N impacts", or "impact
by impact" where a scene loses digits), near_grazing, ratio_to_plain, derivative_relative_error.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from numpy.typing import NDArray

from afm_jax.bench.problems import (
    BenchmarkScene,
    Starts,
    chaotic_scene,
    regular_scene,
    scattered_starts,
    settled_starts,
    tabulated_scene,
)
from afm_jax.bench.scipy_impacts import scipy_impacts
from afm_jax.bench.study import Row, timed
from afm_jax.impact.map import DEFAULT_BLOCK, NEAR_GRAZING, NextImpact, iterate_batch
from afm_jax.outcomes import Outcome
from afm_jax.studies.timing import compiled_for, progress
from afm_jax.verify.fifty_digits import ExactMap, derivatives_by_r

IMPACT_BY_IMPACT = "impact by impact"
CHECKED_LANES = 5


class ImpactErrors(NamedTuple):
    """Absolute errors of single impact times in us, near-grazing impacts apart; arrays of shape (count,)."""

    ordinary: NDArray[np.float64]
    near_grazing: NDArray[np.float64]


def sequence_errors(case: BenchmarkScene, states: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return errors of a sequence of states (time, velocity after), shape (impacts + 1, 2), the start first.

    Of a chaotic scene one by one, shape (impacts,), else the largest of the whole sequence, shape (1,); in us.
    """
    exact = ExactMap(case.scene)
    if case.chaotic:
        return exact.errors_one_by_one(states[:-1], states[1:, 0])
    return np.array([exact.error_of_sequence(tuple(states[0]), states[1:, 0])])


def single_errors(case: BenchmarkScene, starts: Starts, rows: NextImpact, *, lanes: int) -> ImpactErrors:
    """Return the errors of all impacts of the first lanes, each restarted from the computed state before it."""
    exact = ExactMap(case.scene)
    ordinary, grazing = [], []
    for lane in range(min(lanes, rows.time_us.shape[0])):
        states = lane_states(starts, rows, lane)
        errors = exact.errors_one_by_one(states[:-1], states[1:, 0])
        slow = np.asarray(rows.near_grazing[lane])[: len(errors)] | _slow_departure(case, states[:-1])
        ordinary.append(errors[~slow])
        grazing.append(errors[slow])
    return ImpactErrors(np.concatenate(ordinary), np.concatenate(grazing))


def batch_errors(case: BenchmarkScene, starts: Starts, rows: NextImpact) -> dict[str, Any]:
    """Return a benchmark row's error columns: the largest error over the first lanes."""
    if case.chaotic:
        errors = single_errors(case, starts, rows, lanes=CHECKED_LANES)
        return {
            "error_us": float(np.nanmax(errors.ordinary)),
            "error_kind": IMPACT_BY_IMPACT,
            "near_grazing": len(errors.near_grazing),
        }
    lanes = range(min(CHECKED_LANES, rows.time_us.shape[0]))
    errors = [sequence_errors(case, lane_states(starts, rows, lane)) for lane in lanes]
    return {"error_us": float(np.max(errors)), "error_kind": f"after {rows.time_us.shape[1]} impacts"}


def lane_states(starts: Starts, rows: NextImpact, lane: int) -> NDArray[np.float64]:
    """Return a tip's states (time, velocity after), the start first, up to its last impact: (impacts + 1, 2)."""
    flew = int(np.sum(np.asarray(rows.outcome[lane]) == Outcome.IMPACT))
    time = np.asarray(rows.time_us[lane], np.float64)[:flew]
    velocity = np.asarray(rows.velocity_after_nm_per_us[lane], np.float64)[:flew]
    first = [float(starts.time_us[lane]), float(starts.velocity_nm_per_us[lane])]
    return np.vstack([first, np.stack([time, velocity], axis=1)])


def _slow_departure(case: BenchmarkScene, states: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Say which flights leave the platform so slowly that their end is as good as grazing, too (chatter)."""
    rebound = states[:, 1] - np.asarray(case.scene.platform.velocity(states[:, 0]))
    return rebound < NEAR_GRAZING * float(case.scene.platform.top_speed_nm_per_us)


SCIPY_TOLERANCE = 1e-10


def one_core(*, batches: list[int], blocks: list[int], impacts: int, repetitions: int, derivative_batch: int) -> dict:
    """Measure on one core: batches, block sizes, a chaotic scene, scattered starts, derivatives, SciPy.

    Args:
        batches: batch sizes of the regular scene.
        blocks: further block sizes to try at the largest batch up to `derivative_batch`.
        impacts: length of a sequence.
        repetitions: of each measurement.
        derivative_batch: batch size of the derivatives, the chaotic scene and the scattered starts.
    """
    regular, chaotic = regular_scene(), chaotic_scene()
    settled = settled_starts(regular.scene, max([*batches, derivative_batch]))
    measuring: dict[str, Any] = {"impacts": impacts, "repetitions": repetitions}
    rows = [map_row(regular, _first(settled, batch), **measuring) for batch in batches]
    some = _first(settled, derivative_batch)
    rows += [
        map_row(regular, some, **measuring, block=block, what=f"next_impact iterated, blocks of {block}")
        for block in blocks
    ]
    table = "next_impact iterated, the law as a table"
    rows.append(map_row(tabulated_scene(), some, **measuring, what=table, formula=regular))
    spread = scattered_starts(regular.scene, derivative_batch)
    rows.append(map_row(regular, spread, **measuring, what="next_impact iterated, starts over the whole period"))
    rows.append(map_row(chaotic, settled_starts(chaotic.scene, derivative_batch), **measuring))
    rows += derivative_rows(regular, some, **measuring)
    rows.append(scipy_row(regular, settled, impacts=impacts, tips=min(5, derivative_batch)))
    rows.append(scipy_row(chaotic, settled_starts(chaotic.scene, 5), impacts=impacts, tips=min(5, derivative_batch)))
    return {"rows": rows}


def all_cores(*, batches: list[int], impacts: int, repetitions: int) -> dict:
    """Measure the regular scene on all of JAX's CPU devices, a part of the batch on each."""
    regular = regular_scene()
    settled = settled_starts(regular.scene, max(batches))
    return {
        "rows": [
            map_row(
                regular,
                _first(settled, batch),
                impacts=impacts,
                repetitions=repetitions,
                devices=max(n for n in range(1, jax.device_count() + 1) if batch % n == 0),
            )
            for batch in batches
        ]
    }


def map_row(  # noqa: PLR0913
    case: BenchmarkScene,
    starts: Starts,
    *,
    impacts: int,
    repetitions: int,
    block: int = DEFAULT_BLOCK,
    devices: int = 1,
    what: str = "next_impact iterated",
    formula: BenchmarkScene | None = None,
) -> Row:
    """Measure time and error of the map for one batch; of a law in a table beside the formula that it is of."""
    batch = starts.time_us.shape[0]
    progress(f"bench: {what}, {case.name} scene, batch {batch}, {devices} core{'s' if devices > 1 else ''}")

    def run(scene, starts):
        return iterate_batch(scene, starts.time_us, starts.velocity_nm_per_us, impacts, block=block)

    if devices > 1:
        mesh, split = Mesh(np.array(jax.devices()[:devices]), ("tips",)), PartitionSpec("tips")
        # the loops inside run as long as their own lanes need, which the check of replication cannot follow
        run = jax.shard_map(run, mesh=mesh, in_specs=(PartitionSpec(), split), out_specs=split, check_vma=False)
    compiled = compiled_for(run, case.scene, starts)
    row, result = timed(compiled, case.scene, starts, repetitions=repetitions, events=batch * impacts)
    row |= batch_errors(formula or case, starts, result)
    return _row(what, case, row, batch=batch, impacts=impacts, cores=devices, block=min(block, batch))


def derivative_rows(case: BenchmarkScene, starts: Starts, *, impacts: int, repetitions: int) -> list[Row]:
    """Measure the last impacts' times and velocities, one forward derivative of them, and a full reverse gradient."""
    batch = starts.time_us.shape[0]

    def last(scene, starts):
        rows = iterate_batch(scene, starts.time_us, starts.velocity_nm_per_us, impacts)
        return rows.time_us[:, -1], rows.velocity_after_nm_per_us[:, -1]

    def forward(scene, starts):
        def by_r(r):
            return last(eqx.tree_at(lambda varied: varied.interaction.r, scene, r), starts)

        return jax.jvp(by_r, (scene.interaction.r,), (jnp.ones(()),))[1]

    def reverse(scene, starts):
        return jax.grad(lambda *varied: sum(jnp.sum(part) for part in last(*varied)), argnums=(0, 1))(scene, starts)

    labels = {
        "last impact only": last,
        "forward derivative by r": forward,
        "reverse gradient by all parameters and starts": reverse,
    }
    rows, results = [], []
    for what, function in labels.items():
        progress(f"bench: {what}, {case.name} scene, batch {batch}, 1 core")
        compiled = compiled_for(function, case.scene, starts)
        row, result = timed(compiled, case.scene, starts, repetitions=repetitions, events=batch * impacts)
        rows.append(_row(what, case, row, batch=batch, impacts=impacts, cores=1, block=min(DEFAULT_BLOCK, batch)))
        results.append(result)
    for row in rows[1:]:
        row["ratio_to_plain"] = row["microseconds_per_impact"] / rows[0]["microseconds_per_impact"]
    rows[1]["derivative_relative_error"] = _derivative_error(case, _first(starts, 3), impacts)
    total = float(jnp.sum(results[1][0]) + jnp.sum(results[1][1]))
    # reverse mode against forward mode, which is itself compared with 50 digits
    rows[2]["derivative_relative_error"] = abs(float(results[2][0].interaction.r) - total) / abs(total)
    return rows


def _derivative_error(case: BenchmarkScene, starts: Starts, impacts: int) -> float:
    """Return the error of d(times)/dr against 50 digits, relative to a tip's largest: at the attractor it fades."""

    def times(r):
        scene = eqx.tree_at(lambda varied: varied.interaction.r, case.scene, r)
        return iterate_batch(scene, starts.time_us, starts.velocity_nm_per_us, impacts).time_us

    r = case.scene.interaction.r
    found, slopes = np.asarray(times(r)), np.asarray(jax.jacfwd(times)(r))
    states = np.stack([np.asarray(part) for part in starts], axis=1).tolist()
    exact = np.array([derivatives_by_r(case.scene, state, lane) for state, lane in zip(states, found, strict=True)])
    return float(np.max(np.abs(slopes - exact) / np.max(np.abs(exact), axis=1, keepdims=True)))


def scipy_row(case: BenchmarkScene, starts: Starts, *, impacts: int, tips: int) -> Row:
    """Measure SciPy on the first tips, one after the other, and the error of its impact times."""
    progress(f"bench: SciPy, {case.name} scene, {tips} tips")
    first = np.stack([np.asarray(part)[:tips] for part in starts], axis=1).tolist()
    runs = [scipy_impacts(case.scene, (time, speed), impacts, tolerance=SCIPY_TOLERANCE) for time, speed in first]
    microseconds = [1e6 * run.seconds / impacts for run in runs]
    errors = np.concatenate([sequence_errors(case, run.states) for run in runs])
    row = {
        "microseconds_per_impact": min(microseconds),
        "median_microseconds_per_impact": float(np.median(microseconds)),
        "compile_s": None,
        "error_us": float(np.nanmax(errors)),
        "error_kind": IMPACT_BY_IMPACT if case.chaotic else f"after {impacts} impacts",
    }
    what = f"SciPy DOP853 with events, tolerance {SCIPY_TOLERANCE:g}"
    return _row(what, case, row, batch=1, impacts=impacts, cores=1, block=1)


def _first(starts: Starts, batch: int) -> Starts:
    return Starts(starts.time_us[:batch], starts.velocity_nm_per_us[:batch])


def _row(what: str, case: BenchmarkScene, row: Row, *, batch: int, impacts: int, cores: int, block: int) -> Row:
    return {
        "what": what,
        "scene": case.name,
        "batch": batch,
        "cores": cores,
        "block": block,
        "impacts": impacts,
        "impacts_per_second": 1e6 / row["microseconds_per_impact"],
        **row,
    }
