"""What several tables fitted together say of one another: each one's pull on the law.

The fit is linearised at its minimum. What all tables have in common is the law, shared nuisances and what the model
leaves out; what a table has to itself are its own nuisances. Each part of the normal equations is then of one table,
which can be left out.
"""

from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from afm_jax.solve.least_squares import chi2_tail, covariance_of

_LEAST_SHARE = 1e-9
"""Variance that a table takes from a direction of the law, over the variance there, below which it says nothing."""


class Parts(NamedTuple):
    """The normal equations of a fit, part by part: of each table, and last of what is no table's own.

    Attributes:
        matrix: shape (tables + 1, q, q).
        vector: the right-hand sides.
        square: sums of squared residuals.
        own: which unknowns are each table's own.
        law: places of the law's free parameters among the unknowns, which come first.
    """

    matrix: Float[np.ndarray, "parts q q"]
    vector: Float[np.ndarray, "parts q"]
    square: Float[np.ndarray, " parts"]
    own: Bool[np.ndarray, "tables q"]
    law: Int[np.ndarray, " l"]

    def solved(self, table: int | None = None) -> tuple[Float[np.ndarray, "l l"], Float[np.ndarray, " q"]]:
        """Return the covariance of the law's parameters and the change of all unknowns, one table left out or none.

        What is the table's own does not change then.
        """
        kept = np.ones(len(self.square), dtype=bool)
        there = np.ones(self.matrix.shape[1], dtype=bool)
        if table is not None:
            kept[table], there = False, ~self.own[table]
        some = np.ix_(there, there)
        matrix = self.matrix[kept].sum(axis=0)[some]
        vector = self.vector[kept].sum(axis=0)[there]
        change = np.zeros(there.size)
        change[there] = -np.linalg.lstsq(matrix, vector, rcond=None)[0]
        return covariance_of(matrix)[np.ix_(self.law, self.law)], change


class Pull(NamedTuple):
    """How far a table is from the others.

    Attributes:
        pull: of its law, as standard deviations of a single Gaussian number; NaN where the others do not determine it.
        p_value: probability of a larger one by chance.
        chi2: its part of the sum of squares.
    """

    pull: float
    p_value: float
    chi2: float


def pulls_of(parts: Parts) -> list[Pull]:
    """Return every table's pull: the law of all tables against that of the others.

    Leaving a table out moves the law's parameters by an amount whose covariance is the difference of both fits'.
    """
    everything, change = parts.solved()
    found = []
    for table in range(len(parts.own)):
        others, without = parts.solved(table)
        moved = (change - without)[parts.law]
        matrix, vector = parts.matrix[table], parts.vector[table]
        chi2 = float(parts.square[table] + 2.0 * change @ vector + change @ matrix @ change)
        known = np.isfinite(np.diag(others)) & np.isfinite(np.diag(everything))
        some = np.ix_(known, known)
        # in units of what the others leave open
        unit = np.sqrt(np.diag(others)[known])
        variance, axes = np.linalg.eigh((others[some] - everything[some]) / np.outer(unit, unit))
        said = variance > _LEAST_SHARE
        square = float(np.sum((axes.T @ (moved[known] / unit))[said] ** 2 / variance[said]))
        p_value = chi2_tail(square, int(said.sum())) if said.any() else 1.0 if known.any() else np.nan
        # beyond what a probability can hold, all but the largest direction count nothing
        pull = float(np.sqrt(square)) if p_value == 0.0 else -NormalDist().inv_cdf(0.5 * p_value)
        found.append(Pull(pull, p_value, chi2))
    return found
