"""Newton's method for n equations f(x) = 0 in n unknowns, of many rows in NumPy: x <- x - (df/dx)^-1 f, steps limited.

Takes f with its derivatives, guesses and a `Newton` with tolerances in the units of f and x; gives the roots.

For where f is itself a program, such as a simulation, or needs none: each round evaluates the rows that are still open,
and no others. `Newton` holds the settings of `newton`, too; a step that must not leave the domain of f is limited by
`Newton.damping`.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int


class Newton(NamedTuple):
    """Settings of Newton's method.

    A root counts as found in the round in which residual and step are both within their tolerances. This step is still
    taken, so that the error left is of the order of the step's square.
    """

    rounds: int
    """Evaluations of residual and Jacobian at most."""
    step_tolerance: float = math.inf
    """Largest component of the last step, in units of `unit`."""
    residual_tolerance: float = math.inf
    """Largest component of the residual."""
    unit: Callable[[Any], Any] | None = None
    """Natural size of the unknowns at x, to which `step_tolerance` refers; None: 1."""
    damping: Callable[[Any, Any], Any] | None = None
    """Returns the step to be taken from x in place of the full one; None: the full step."""

    def limited(self, x: Any, step: Any) -> tuple[Any, Any]:
        """Return the step to be taken from x, and the sizes of its components."""
        step = step if self.damping is None else self.damping(x, step)
        return step, abs(step if self.unit is None else step / self.unit(x))


class LinearisedRows(NamedTuple):
    """Equations at the points of some rows; NaN in a row where they have no value."""

    residual: Float[np.ndarray, "rows n"]
    slopes: Float[np.ndarray, "rows n n"]
    """Derivatives of the residuals by the unknowns."""
    details: Sequence[Any] | None = None
    """What else the evaluation has found, one a row."""


class Roots(NamedTuple):
    """Where the searches of all rows ended."""

    x: Float[np.ndarray, "rows n"]
    converged: Bool[np.ndarray, " rows"]
    """Which rows have a root: the last step and the residual before it are within their tolerances."""
    details: list[Any]
    """What the last evaluation of each row has found besides; None where there is nothing."""


def newton_rows(
    linearised: Callable[[Float[np.ndarray, "open n"], Int[np.ndarray, " open"]], LinearisedRows],
    guesses: Float[np.ndarray, "rows n"],
    settings: Newton,
) -> Roots:
    """Return the roots that Newton's method finds from many guesses, each row on its own.

    Args:
        linearised: equations and derivatives at points, given with the numbers of their rows.
        guesses: first points.
        settings: rounds, tolerances and limits.
    """
    count = len(guesses)
    roots = Roots(np.array(guesses, float), np.zeros(count, bool), [None] * count)
    rows = np.arange(count)
    for _ in range(settings.rounds):
        if not rows.size:
            break
        here = linearised(roots.x[rows], rows)
        step, sizes = settings.limited(roots.x[rows], -_solved(here.slopes, here.residual))
        finite = np.isfinite(step).all(axis=1)
        small = np.all(np.abs(here.residual) <= settings.residual_tolerance, axis=1)
        found = finite & small & np.all(sizes <= settings.step_tolerance, axis=1)
        for row, detail in zip(rows, here.details or (), strict=bool(here.details)):
            roots.details[row] = detail
        roots.converged[rows] = found
        roots.x[rows[finite]] += step[finite]
        rows = rows[finite & ~found]
    return roots


def _solved(slopes: Float[np.ndarray, "rows n n"], right: Float[np.ndarray, "rows n"]) -> Float[np.ndarray, "rows n"]:
    """Return the solutions of linear equations, row by row; NaN where a matrix is singular."""
    with np.errstate(invalid="ignore"):
        singular = np.linalg.slogdet(slopes)[0] == 0.0
    regular = np.where(singular[:, None, None], np.eye(right.shape[1]), slopes)
    return np.where(singular[:, None], np.nan, np.linalg.solve(regular, right[:, :, None])[:, :, 0])
