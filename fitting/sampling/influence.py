"""How far single rows move the fit: to first order from its own slopes, and by fitting without them.

For residuals r with slopes J, the fit without row i lies by d = (J^T J - J_i^T J_i)^-1 J_i^T r_i from the fit with it;
d^T J^T J d/p is Cook's distance (Technometrics 19, 15 (1977)).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from afm_jax.least_squares import whole_covariance_of
from fitting.fits.discrepancy import LawBefore
from fitting.fits.estimate import law_before, speed_range
from fitting.fits.intervals import at_bound
from fitting.fits.objective import Objective
from fitting.sampling.bootstrap import BatchFit, DataSets, Refit, fit_data_sets

CHECKED = 7
"""Rows that are left out for good: with the fit of all of them a batch."""
_SPEEDS = 121
"""As many as a fit's law has: the same program."""


@dataclass(frozen=True)
class Influence:
    """How far single rows move law and parameters; the law's errors are those of the posterior.

    Attributes:
        law_moves: largest change of the rebound speed, over the measured speeds, in its standard errors, when the row
            is left out, to first order; infinite: without the row a parameter is not determined.
        cooks_distance: squared move of all parameters, per parameter, in their joint errors, to first order.
        checked: places of the rows that move the law most.
        law_moves_refitted: what fits without these give; NaN where one failed.
    """

    law_moves: Float[np.ndarray, " rows"]
    cooks_distance: Float[np.ndarray, " rows"]
    checked: Int[np.ndarray, " checked"]
    law_moves_refitted: Float[np.ndarray, " checked"]


def influence_of_rows(refit: Refit, approach_speeds: Float[np.ndarray, " measured"]) -> Influence:
    """Return how far each row moves the fit.

    Args:
        refit: the fit, its rows alone.
        approach_speeds: of the measured rows in nm/us, NaN where there is none: among them the law counts.
    """
    best = _fits_without(refit, np.array([], dtype=int)).values[0]
    speeds = np.geomspace(*speed_range(approach_speeds), _SPEEDS)
    fitted = _law(refit, best, speeds)
    rebound, slope = fitted.law[0], fitted.slope[0]
    free = ~at_bound(refit.objective, best)
    normal, moves = _moves(refit.objective, best, free)
    error = np.sqrt(np.einsum("np,pq,nq->n", slope[:, free], np.linalg.inv(normal), slope[:, free]))
    known: Bool[np.ndarray, " rows"] = np.asarray(np.isfinite(moves).all(axis=1))
    moves = np.where(known[:, None], moves, 0.0)
    law_moves = np.where(known, np.max(np.abs(moves @ slope[:, free].T) / error, axis=1), np.inf)
    chosen = np.argsort(-law_moves)[:CHECKED]
    fits = _fits_without(refit, chosen)
    refitted = [
        float(np.max(np.abs(_law(refit, values, speeds).law[0] - rebound) / error)) if converged else np.nan
        for values, converged in zip(fits.values[1:], fits.converged[1:], strict=True)
    ]
    return Influence(
        law_moves=law_moves,
        cooks_distance=np.where(known, np.einsum("rp,pq,rq->r", moves, normal, moves) / free.sum(), np.inf),
        checked=chosen,
        law_moves_refitted=np.array(refitted),
    )


def _fits_without(refit: Refit, rows: Int[np.ndarray, " some"]) -> BatchFit:
    """Return the fit of all rows, and those without one of some rows."""
    measured = refit.objective.measurement
    kept = np.ones((1 + rows.size, len(np.asarray(measured.rows.order))), dtype=bool)
    kept[1 + np.arange(rows.size), rows] = False
    sets = len(kept)
    readings = np.repeat(np.asarray(measured.rows.amplitude_nm)[None], sets, axis=0)
    known = np.repeat(np.asarray(measured.constraint_value)[None], sets, axis=0)
    return fit_data_sets(refit, DataSets(readings, known), kept)


def _moves(
    objective: Objective, values: Float[np.ndarray, " p"], free: Bool[np.ndarray, " p"]
) -> tuple[Float[np.ndarray, "q q"], Float[np.ndarray, "rows q"]]:
    """Return the normal matrix of the free parameters, and their change when a row is left out; infinite: undetermined.

    A residual of an orbit that was not seen has no slope: such a row moves nothing.
    """
    found = objective.at_values(values[None])
    shape = np.asarray(objective.measurement.rows.amplitude_nm).shape
    residual, jacobian = np.asarray(found.residual)[0], np.asarray(found.jacobian)[0][:, free]
    normal = jacobian.T @ jacobian
    moves = np.empty((shape[0], int(free.sum())))
    for i, (own, slope) in enumerate(
        zip(
            residual[: shape[0] * shape[1]].reshape(shape),
            jacobian[: shape[0] * shape[1]].reshape(*shape, -1),
            strict=True,
        )
    ):
        spread = whole_covariance_of(normal - slope.T @ slope)
        moves[i] = spread @ (slope.T @ own) if np.isfinite(spread).all() else np.inf
    return normal, moves


def _law(refit: Refit, values: Float[np.ndarray, " p"], speeds: Float[np.ndarray, " n"]) -> LawBefore:
    return law_before(refit.objective.problem, refit.objective.measurement, values, speeds)
