"""What several tables fitted together say of one another: each one's pull on the law.

The fit is linearised at its minimum. What all tables have in common is the law, shared nuisances and what the model
leaves out; what a table has to itself are its own nuisances. Each part of the normal equations is then of one table,
which can be left out.
"""

from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from afm_jax.least_squares import chi2_tail, covariance_of
from fitting.fits.step import StepSystem

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
        matrix, vector = self.matrix[kept].sum(axis=0)[some], self.vector[kept].sum(axis=0)[there]
        change = np.zeros(there.size)
        change[there] = -np.linalg.lstsq(matrix, vector, rcond=None)[0]
        return covariance_of(matrix)[np.ix_(self.law, self.law)], change


def parts_of(
    system: StepSystem, table: Int[np.ndarray, " rows"], place: Int[np.ndarray, "tables p"], own: int
) -> Parts:
    """Return the normal equations of a fit to several tables, part by part.

    Args:
        system: the fit.
        table: which each row is of.
        place: of each table's parameters, as of `Joint`.
        own: how many parameters the law has; they come first.
    """
    size, count, tables, free = system.unknown.shape[0], system.jacobian.shape[1], len(place), system.parameters.free
    of = np.repeat(table, size // len(table))
    holders = np.array([np.isin(np.arange(count), row) for row in place])
    owner = np.where(holders.sum(axis=0) == 1, np.argmax(holders, axis=0), tables)
    whole = np.zeros((len(system.residual), count + system.unknown.shape[1]))
    whole[:, :count] = system.jacobian * free
    whole[:size, count:] = system.unknown
    white = _whitened(system, np.column_stack([system.residual, whole]), len(table))
    # after the readings: rows without orbit, and what is known of each parameter and shape
    part = np.concatenate([of, table, owner])
    blocks = [white[part == t] for t in range(tables + 1)]
    matrix = np.array([block[:, 1:].T @ block[:, 1:] for block in blocks])
    owned = np.append(owner, np.full(system.unknown.shape[1], tables))
    prior = np.append(np.flatnonzero(~free), np.arange(count, owned.size))
    matrix[owned[prior], prior, prior] += 1.0
    return Parts(
        matrix=matrix,
        vector=np.array([block[:, 1:].T @ block[:, 0] for block in blocks]),
        square=np.array([block[:, 0] @ block[:, 0] for block in blocks]),
        own=owned == np.arange(tables)[:, None],
        law=np.flatnonzero(free[:own]),
    )


def _whitened(system: StepSystem, columns: Float[np.ndarray, "n m"], rows: int) -> Float[np.ndarray, "n m"]:
    """Return columns in units of the readings' noise, which is that of each row by itself."""
    size = system.noise.shape[0]
    kinds = size // rows
    one = np.arange(rows)
    blocks = system.noise.reshape(rows, kinds, rows, kinds)[one, :, one, :]
    white = np.linalg.solve(np.linalg.cholesky(blocks), columns[:size].reshape(rows, kinds, -1))
    return np.concatenate([white.reshape(size, -1), columns[size:]])


class Pull(NamedTuple):
    """How far a table is from the others.

    Attributes:
        pull: of its law, as standard deviations of a single Gaussian number; NaN where the others do not determine it.
        p_value: probability of a larger one by chance.
        pulls: by how much it moves each free parameter of the law, in standard deviations of that; NaN likewise.
        chi2: its part of the sum of squares.
    """

    pull: float
    p_value: float
    pulls: Float[np.ndarray, " l"]
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
        pulls = np.full(parts.law.size, np.nan)
        if not known.any():
            found.append(Pull(np.nan, np.nan, pulls, chi2))
            continue
        some = np.ix_(known, known)
        # in units of what the others leave open
        unit = np.sqrt(np.diag(others)[known])
        variance, axes = np.linalg.eigh((others[some] - everything[some]) / np.outer(unit, unit))
        said = variance > _LEAST_SHARE
        square = float(np.sum((axes.T @ (moved[known] / unit))[said] ** 2 / variance[said]))
        spread = np.diag(others - everything)[known] / unit**2
        pulls[known] = np.where(
            spread > _LEAST_SHARE, moved[known] / unit / np.sqrt(np.maximum(spread, _LEAST_SHARE)), 0.0
        )
        p_value = chi2_tail(square, int(said.sum())) if said.any() else 1.0
        # beyond what a probability can hold, all but the largest direction count nothing
        pull = -NormalDist().inv_cdf(0.5 * p_value) if p_value > 0.0 else float(np.sqrt(square))
        found.append(Pull(pull, p_value, pulls, chi2))
    return found
