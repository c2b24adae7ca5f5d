"""Errors of impact times against 50 digits: after a sequence, or impact by impact where a scene loses digits."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from afm_jax.impact.poincare import NEAR_GRAZING, NextImpact
from afm_jax.outcome import Outcome
from afm_jax.study.benchmark_scenes import BenchmarkScene, Starts
from afm_jax.study.exact_impacts import ExactMap

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
