"""SciPy's adaptive steps of an autonomous system, ended exactly where a component of the state reaches a mark.

The steps' interpolants are of lower order than the steps and are not used: a mark is met by taking the last step again,
its length found by a bracketed Newton iteration, so that the state at the mark is as good as every other.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.integrate import DOP853, OdeSolver

Rates = Callable[[float, np.ndarray], list[float]]

MOST_NEWTON_STEPS = 60
SHORTEST = 4 * np.finfo(float).eps  # relative to a step: shorter corrections of it are rounding


@dataclass(frozen=True, kw_only=True)
class Steps:
    """How to take steps: relative tolerance, absolute tolerances by component, SciPy's method."""

    rtol: float
    atol: np.ndarray
    method: Callable[..., OdeSolver] = DOP853

    def solver(self, rates: Rates, state: np.ndarray, end: float, first: float | None = None) -> OdeSolver:
        """Return a solver that starts at a state and will end after `end`, its first step given or its own choice."""
        return self.method(rates, 0.0, state, end, rtol=self.rtol, atol=self.atol, first_step=first)


class Mark(NamedTuple):
    """A value that a component of the state passes rising (sign 1) or falling (-1)."""

    name: str
    component: int
    value: float
    sign: int

    def miss(self, state: np.ndarray) -> float:
        """Return how far the component is beyond the mark; negative before it."""
        return self.sign * (state[self.component] - self.value)


class Way(NamedTuple):
    """The starts of the steps taken and their lengths, the end's state and the mark met there."""

    starts: list[np.ndarray]
    lengths: list[float]
    end: np.ndarray
    met: Mark


def follow_to_mark(rates: Rates, state: np.ndarray, marks: Sequence[Mark], turning: int, steps: Steps) -> Way:
    """Follow the state until the first mark.

    A component may reach a mark and come back within one step; so each change of sign of the component `turning` ends a
    step as well, and between turns the components with marks move one way.

    Args:
        rates: right-hand side; its first argument is not used.
        state: initial state; a mark that lies exactly there is met only after the state has been before it.
        marks: where to end; one of them must be reached.
        turning: which component changes sign where those with marks turn.
        steps: how to take steps.
    """
    starts, lengths = [], []
    solver = steps.solver(rates, state, np.inf)
    while True:
        _ = solver.step()
        assert solver.status != "failed", f"no step from {state.tolist()} is accurate to {steps.rtol:g}"
        length, end = float(solver.t - (solver.t_old or 0.0)), solver.y
        turned = state[turning] * end[turning] < 0.0
        if turned:
            length, end = land(rates, state, length, Mark("turn", turning, 0.0, -int(np.sign(state[turning]))), steps)
            end[turning] = 0.0
            solver = steps.solver(rates, end, np.inf)
        found = [
            (*land(rates, state, length, mark, steps), mark)
            for mark in marks
            if mark.miss(state) < 0.0 <= mark.miss(end)
        ]
        starts.append(state)
        if found:
            length, end, met = min(found, key=lambda each: each[0])
            return Way(starts, [*lengths, length], end, met)
        lengths.append(length)
        state = end


def land(rates: Rates, state: np.ndarray, length: float, mark: Mark, steps: Steps) -> tuple[float, np.ndarray]:
    """Return the length of the step from a state that ends on a mark, and the state there.

    Args:
        rates: right-hand side.
        state: the step's start, before the mark.
        length: of a step that ends beyond the mark.
        mark: where to end.
        steps: how to take steps.
    """
    low, high, trial, end = 0.0, length, length, state
    for _ in range(MOST_NEWTON_STEPS):
        end = step_by(rates, state, trial, steps)
        miss = mark.miss(end)
        low, high = (low, trial) if miss >= 0.0 else (trial, high)
        slope = mark.sign * rates(0.0, end)[mark.component]
        new = trial - miss / slope if slope > 0.0 else low
        if abs(new - trial) <= SHORTEST * length:
            break
        trial = new if low < new < high else (low + high) / 2
        if high - low <= SHORTEST * length:
            break
    return trial, end


def step_by(rates: Rates, state: np.ndarray, length: float, steps: Steps) -> np.ndarray:
    """Return the state after a length that one step, or a few, can take."""
    solver = steps.solver(rates, state, length, first=length)
    while solver.status == "running":
        _ = solver.step()
    return solver.y
