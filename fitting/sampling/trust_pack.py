"""How far to trust a posterior: does it predict the table, are its ranks uniform, and what hangs on single rows?"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from afm_jax.checks import checked
from afm_jax.results import Result, public_result
from fitting.fits.result import FitResult
from fitting.sampling.bootstrap import require_valid
from fitting.sampling.draws import PosteriorDraws, posterior_draws, refit_of_rows
from fitting.sampling.influence import Influence, influence_of_rows
from fitting.sampling.leave_one_out import LeaveOneOut, leave_one_out
from fitting.sampling.posterior_result import Posterior
from fitting.sampling.rank_calibration import IMPROBABLE, RankCalibration, calibrate_ranks

FEWEST_SETS = 20
SHARES = (0.025, 0.25, 0.5, 0.75, 0.975)
READINGS = ("peak_amplitude_nm", "lockin_amplitude_nm", "phase_deg")
_TOO_FEW = 1e-3
"""Probability of as few readings inside the 95 % band as there are, below which that is said."""
MOVES_MUCH = 1.0
"""Move of the law by a single row, in its standard errors, that is worth saying."""


@dataclass(frozen=True, eq=False)
class PredictiveBands:
    """Readings beside replicated ones.

    Attributes:
        measured: peak, lock-in amplitude and, if the table has one, the phase; NaN: not used.
        quantiles: of the replicated readings, at `SHARES`.
    """

    measured: Float[np.ndarray, "rows k"]
    quantiles: Float[np.ndarray, "five rows k"]

    def inside(self, low: int, high: int) -> tuple[int, int]:
        """Return how many readings lie between two of the quantiles, and how many there are."""
        there = (self.measured >= self.quantiles[low]) & (self.measured <= self.quantiles[high])
        return int(there.sum()), int(np.isfinite(self.measured).sum())


@public_result(picture="fitting.report.trust_plots:trust_figure", rows="row_records")
@dataclass(frozen=True, eq=False)
class TrustPack(Result):
    """What speaks for a posterior and what against it.

    Attributes:
        names: of the parameters.
        lines: of the rows that say something, in the table's file.
        draws: of the posterior.
        predictive: readings beside replicated ones.
        calibration: ranks of true values in posteriors of simulated tables.
        loo: what each row is predicted by the others.
        influence: how far single rows move the fit.
        complaints: what speaks against it or must be looked at, a sentence each.
    """

    names: tuple[str, ...]
    lines: Int[np.ndarray, " rows"]
    draws: Float[np.ndarray, "chains draws p"]
    predictive: PredictiveBands
    calibration: RankCalibration
    loo: LeaveOneOut
    influence: Influence
    complaints: list[str]

    def row_records(self) -> list[dict[str, Any]]:
        """Return a mapping for each row: what it is predicted by the others, and how far it moves the fit."""
        refitted = dict(zip(self.influence.checked.tolist(), self.influence.law_moves_refitted.tolist(), strict=True))
        records = []
        for i, line in enumerate(self.lines.tolist()):
            record = {
                "line": line,
                "elpd": float(self.loo.elpd_by_row[i]),
                "pareto_k": float(self.loo.pareto_k[i]),
                "law_moves": float(self.influence.law_moves[i]),
                "law_moves_refitted": refitted.get(i),
                "cooks_distance": float(self.influence.cooks_distance[i]),
            }
            for kind, name in enumerate(READINGS[: self.predictive.measured.shape[1]]):
                record[f"measured_{name}"] = float(self.predictive.measured[i, kind])
                for share, value in zip(SHARES, self.predictive.quantiles[:, i, kind].tolist(), strict=True):
                    record[f"replicated_{name}_{100.0 * share:g}_percent"] = value
            records.append(record)
        return records

    def to_dict(self) -> dict[str, Any]:
        """Return everything but draws and single ranks as plain lists, numbers and strings."""
        (inside50, readings), (inside95, _) = self.predictive.inside(1, 3), self.predictive.inside(0, 4)
        ranks = self.calibration
        by_quantity = zip(ranks.quantities, ranks.p_values.tolist(), ranks.gaussian_p_values.tolist(), strict=True)
        return {
            "complaints": self.complaints,
            "draws": int(self.draws[..., 0].size),
            "predictive": {"readings": readings, "inside50": inside50, "inside95": inside95},
            "calibration": {
                "sets": len(ranks.ranks),
                "failed": ranks.failed,
                "seed": ranks.seed,
                "p_value": ranks.p_value,
                "gaussian_p_value": ranks.gaussian_p_value,
                "by_quantity": {name: {"p_value": p, "gaussian_p_value": q} for name, p, q in by_quantity},
            },
            "leave_one_out": {
                "elpd": self.loo.elpd,
                "elpd_error": self.loo.elpd_error,
                "p_loo": self.loo.p_loo,
                "highest_pareto_k": self.loo.highest_k,
            },
            "rows": self.row_records(),
        }


@checked
def trust(
    result: FitResult,
    found: Posterior,
    *,
    sets: int = 100,
    seed: int = 0,
    report: Callable[[int, int], None] | None = None,
) -> TrustPack:
    """Return what speaks for a fit's posterior and what against it.

    Args:
        result: from `fitting.fit`; it must be valid.
        found: its posterior, from `fitting.posterior`.
        sets: tables that are simulated for the ranks.
        seed: of everything random.
        report: told how many of these tables are done, and of how many.

    Raises:
        ValueError: if the fit is not valid, there are too few sets, or the simulated tables cannot be fitted.
    """
    require_valid(result)
    if sets < FEWEST_SETS:
        raise ValueError(f"`sets` must be at least {FEWEST_SETS}, but is {sets}")
    believed = posterior_draws(result, found, seed=seed)
    refit, told = refit_of_rows(result)
    flat = believed.values.reshape(-1, believed.values.shape[2])
    ranks = calibrate_ranks(refit, flat, sets=sets, seed=seed, log_uniform=found.log_uniform, report=report)
    loo = leave_one_out(believed.log_likelihood.reshape(len(flat), -1), believed.efficiency)
    influence = influence_of_rows(refit, np.where(result.rows.used, result.rows.approach_speed_nm_per_us, np.nan))
    bands = _bands(believed)
    lines = result.table.lines[told]
    return TrustPack(
        names=believed.names,
        lines=lines,
        draws=believed.values,
        predictive=bands,
        calibration=ranks,
        loo=loo,
        influence=influence,
        complaints=_complaints(bands, ranks, loo, influence, lines),
    )


def _bands(believed: PosteriorDraws) -> PredictiveBands:
    replicated = believed.replicated.reshape(-1, *believed.measured.shape)
    quantiles = np.quantile(replicated, SHARES, axis=0)
    return PredictiveBands(believed.measured, np.where(np.isfinite(believed.measured), quantiles, np.nan))


def _complaints(
    bands: PredictiveBands,
    ranks: RankCalibration,
    loo: LeaveOneOut,
    influence: Influence,
    lines: Int[np.ndarray, " rows"],
) -> list[str]:
    from scipy.stats import binom  # noqa: PLC0415 (most fits need no SciPy)

    said = []
    inside, readings = bands.inside(0, 4)
    if binom.cdf(inside, readings, 0.95) < _TOO_FEW:
        said.append(f"only {inside} of {readings} readings lie in the 95 % band of what the posterior predicts")
    if ranks.p_value < IMPROBABLE:
        said.append(
            f"ranks of true values in the posteriors of simulated tables are not uniform (probability "
            f"{ranks.p_value:.1g}): the posterior is not what it should be"
        )
    if ranks.gaussian_p_value < IMPROBABLE:
        said.append(
            f"ranks in Gaussian posteriors are not uniform (probability {ranks.gaussian_p_value:.1g}): use the "
            "posterior's intervals or profiles, not standard errors"
        )
    heavy = ~(loo.pareto_k <= loo.highest_k)
    if heavy.any():
        said.append(
            f"the posterior without line {_named(lines[heavy])} is too far from the whole one for importance sampling "
            f"(Pareto k above {loo.highest_k:.2g}): its leave-one-out density is not reliable"
        )
    lost = np.isinf(influence.law_moves)
    if lost.any():
        said.append(f"without line {_named(lines[lost])} the data do not determine every parameter")
    much = ~lost & (influence.law_moves > MOVES_MUCH)
    if much.any():
        said.append(
            f"the law moves by more than {MOVES_MUCH:g} standard error without line {_named(lines[much])}: look at it"
        )
    return said


def _named(lines: Int[np.ndarray, " some"]) -> str:
    shown = [str(line) for line in lines[:5].tolist()]
    return " or ".join(shown) + (f" (or {len(lines) - 5} others)" if len(lines) > 5 else "")
