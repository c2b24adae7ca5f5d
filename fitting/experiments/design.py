"""The design of an experiment: which drives to measure next, so that the law is known best.

What a set of measurements says of the parameters is its Fisher information; its inverse says how good the set is.
Points are chosen greedily, then exchanged one by one until no exchange helps (Fedorov), then put into the best order.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from afm_jax.checks import checked, require_float64
from afm_jax.version import version_of
from fitting.experiments.candidates import AMPLITUDES, PHASE_NOISE_DEG, Candidates, candidates_of, forecast
from fitting.experiments.prior import Prior, prior_of_fit, size_of
from fitting.experiments.result import Design
from fitting.experiments.verdict import DesignEvidence, judge_design
from fitting.fits.result import FitResult
from fitting.parameters import DELAY_NAMES
from fitting.simulated.experiment import Drives

CRITERIA = ("D", "A")
_RIDGE = 1e-9
"""Information added to every parameter, relative to that of all candidates together, while points are chosen: with it
the first points, which alone determine nothing, can be compared."""


_PACKAGES = ("afm-jax", "jax", "numpy")


@checked
def design(  # noqa: PLR0913
    prior: Prior | FitResult,
    drives: Drives,
    *,
    points: int = 8,
    noise: float = 0.01,
    interest: Sequence[str] | None = None,
    criterion: str = "D",
    amplitudes: str = "both",
    largest_nm: float | None = None,
    phase_noise_deg: float = PHASE_NOISE_DEG,
) -> Design:
    """Choose the drives to measure next, and forecast how well the parameters will then be known.

    The forecast is the Fisher information: derivatives of the predicted amplitudes by every parameter at the prior
    values, by automatic differentiation through the orbits; of laws with a delay the errors contain what the model
    leaves out, as those of a fit. Every drive is chosen once. A drive is left out where the
    prior has no steady single-impact orbit, or several, or is not sure of it, and where a fit would exclude its row.

    Args:
        prior: from `prior_of_values`, or a fit whose measurements are to be added to.
        drives: what can be driven, from `drive_grid`.
        points: how many to choose.
        noise: standard error of an amplitude relative to it (0.01 stands for 1 %).
        interest: the parameters to be known well, all others being unknown too; None: those of the law.
        criterion: "D": the smallest volume of their joint confidence region; "A": the smallest sum of their variances,
            each relative to the parameter (to the loss 1 - r for r).
        amplitudes: what is read of each point: "peak", "lockin" or "both"; of a cantilever that is driven itself always
            the lock-in amplitude and the lag.
        largest_nm: peak amplitude that the instrument takes (of a cantilever that is driven itself the free one); None:
            any.
        phase_noise_deg: standard error of a lag in degrees.

    Returns:
        The points in the order of their use, with expected readings and errors; see `Design`.

    Raises:
        ValueError: if an option is impossible.
        RuntimeError: if JAX is not set to 64-bit floats.
    """
    require_float64()
    prior = prior_of_fit(prior) if isinstance(prior, FitResult) else prior
    wanted = _interest(prior, interest)
    _check_options(points, noise, criterion, amplitudes, largest_nm, phase_noise_deg)
    largest = np.inf if largest_nm is None else float(largest_nm)
    candidates = candidates_of(
        prior, drives, noise=noise, amplitudes=amplitudes, largest_nm=largest, phase_noise_deg=phase_noise_deg
    )
    measure = _criterion(prior, candidates, wanted, criterion)
    usable, each = np.flatnonzero(candidates.usable), candidates.information
    chosen = usable[choose_points(prior.information, each[usable], points, measure)]
    reached = prior.information + each[chosen].sum(axis=0)
    errors = forecast(prior, candidates, chosen, float(noise), phase_noise_deg)
    reasons, warnings = judge_design(
        DesignEvidence(prior, candidates, chosen, points, wanted, reached, forecasts=errors[-1])
    )
    return Design(
        prior=prior,
        interest=wanted,
        criterion=criterion,
        noise=float(noise),
        candidates=candidates,
        chosen=chosen,
        errors=errors,
        gain=_gain(measure, reached, candidates),
        valid=not reasons,
        reasons=reasons,
        warnings=warnings,
        settings={
            "points": points,
            "noise": noise,
            "interest": list(wanted),
            "criterion": criterion,
            "amplitudes": amplitudes,
            "largest_nm": largest_nm,
            "phase_noise_deg": phase_noise_deg if prior.problem.tapping else None,
            "drive": prior.problem.drive,
            "uncertainty": prior.uncertainty,
            "drives": len(drives.order),
        },
        versions={name: version_of(name) for name in _PACKAGES},
    )


class Criterion(NamedTuple):
    """How good an information matrix is for the parameters that matter; more is better.

    D: log det of the information about them, the others marginalised, log det F - log det F_nuisances. A: minus the sum
    of their variances, each in units of the parameter's size squared.
    """

    kind: str
    matters: Bool[np.ndarray, " p"]
    size: Float[np.ndarray, " p"]
    ridge: Float[np.ndarray, " p"]

    def __call__(self, information: Float[np.ndarray, "n p p"]) -> Float[np.ndarray, " n"]:
        """Return the score of every information matrix."""
        unit = 1.0 / np.sqrt(self.ridge / _RIDGE)
        scaled = unit[:, None] * information * unit + _RIDGE * np.eye(len(unit))
        if self.kind == "A":
            variance = np.diagonal(np.linalg.inv(scaled), axis1=1, axis2=2) * unit**2
            return -np.sum((variance / self.size**2)[:, self.matters], axis=1)
        nuisances = np.flatnonzero(~self.matters)
        whole = np.linalg.slogdet(scaled)[1]
        if nuisances.size == 0:
            return whole
        return whole - np.linalg.slogdet(scaled[:, nuisances[:, None], nuisances])[1]


def criterion_of(
    kind: str,
    matters: Bool[np.ndarray, " p"],
    size: Float[np.ndarray, " p"],
    largest: Float[np.ndarray, "p p"],
) -> Criterion:
    """Return the criterion for choosing among candidates.

    Args:
        kind: "D" or "A".
        matters: which parameters are to be known well.
        size: of every parameter, what a relative error refers to.
        largest: information of all candidates and all that is known, together: it sets the scale of the ridge.
    """
    strength = np.diag(largest)
    return Criterion(kind, matters, size, _RIDGE * np.where(strength > 0.0, strength, size**-2.0))


_ROUNDS = 50
_BETTER = 1e-9
"""Gain below which an exchange is rounding."""


def choose_points(
    prior: Float[np.ndarray, "p p"], each: Float[np.ndarray, "n p p"], points: int, criterion: Criterion
) -> Int[np.ndarray, " points"]:
    """Return the numbers of the chosen candidates, each once, in the order in which they help most.

    Args:
        prior: information of what is known already.
        each: information of a measurement at every candidate.
        points: how many to choose; at most n are.
        criterion: what makes an information matrix good.
    """
    points = min(points, len(each))
    if points == 0:
        return np.zeros(0, dtype=np.int64)
    chosen = _greedy(prior, each, np.arange(len(each)), points, criterion)
    chosen = _exchanged(prior, each, chosen, criterion)
    return np.array(_greedy(prior, each, np.sort(chosen), points, criterion), dtype=np.int64)


def _greedy(
    prior: Float[np.ndarray, "p p"],
    each: Float[np.ndarray, "n p p"],
    among: Int[np.ndarray, " k"],
    points: int,
    criterion: Criterion,
) -> list[int]:
    """Return candidates taken one after another, each the best addition to those before."""
    left, chosen, information = among.tolist(), [], prior
    for _ in range(points):
        best = left.pop(int(np.argmax(criterion(information + each[left]))))
        chosen.append(best)
        information = information + each[best]
    return chosen


def _exchanged(
    prior: Float[np.ndarray, "p p"], each: Float[np.ndarray, "n p p"], chosen: list[int], criterion: Criterion
) -> list[int]:
    """Return a choice that no exchange of one of its points makes better."""
    chosen = list(chosen)
    for _ in range(_ROUNDS):
        before = chosen.copy()
        for place in range(len(chosen)):
            others = [point for point in chosen if point != chosen[place]]
            score = criterion(prior + each[others].sum(axis=0) + each)
            current = score[chosen[place]]
            score[others] = -np.inf
            best = int(np.argmax(score))
            if score[best] > current + _BETTER * abs(current):
                chosen[place] = best
        if chosen == before:
            break
    return chosen


def _interest(prior: Prior, interest: Sequence[str] | None) -> tuple[str, ...]:
    """Return the parameters that matter: those asked for, or the law's without its delay."""
    problem = prior.problem
    if interest is None:
        return tuple(name for name in problem.own if name not in DELAY_NAMES)
    for name in interest:
        if name not in problem.names:
            raise ValueError(f"`interest` names {name!r}, but the design has {', '.join(problem.names)}")
    if not interest or len(set(interest)) < len(interest):
        raise ValueError("`interest` must name at least one parameter, and none twice")
    return tuple(interest)


def _check_options(
    points: int, noise: float, criterion: str, amplitudes: str, largest_nm: float | None, phase_noise_deg: float
) -> None:
    if points < 1:
        raise ValueError(f"`points` must be at least 1, but is {points}")
    if not 0.0 < noise < 1.0:
        raise ValueError(f"`noise` must be between 0 and 1, but is {noise!r}; write 0.01 for 1 %")
    if criterion not in CRITERIA:
        raise ValueError(f"`criterion` must be one of {', '.join(CRITERIA)}, but is {criterion!r}")
    if amplitudes not in AMPLITUDES:
        raise ValueError(f"`amplitudes` must be one of {', '.join(AMPLITUDES)}, but is {amplitudes!r}")
    if not 0.0 < phase_noise_deg < 90.0:
        raise ValueError(f"`phase_noise_deg` must be between 0 and 90, but is {phase_noise_deg!r}")
    if largest_nm is not None and not largest_nm > 0.0:
        raise ValueError(f"`largest_nm` must be positive, but is {largest_nm!r}")


def _criterion(prior: Prior, candidates: Candidates, wanted: tuple[str, ...], kind: str) -> Criterion:
    problem = prior.problem
    return criterion_of(
        kind,
        matters=np.array([name in wanted for name in problem.names]),
        size=np.array([size_of(p, v) for p, v in zip(problem.parameters, prior.values.tolist(), strict=True)]),
        largest=prior.information + candidates.information.sum(axis=0),
    )


def _gain(criterion: Criterion, reached: Float[np.ndarray, "p p"], candidates: Candidates) -> Float[np.ndarray, " n"]:
    """Return what one more measurement at each candidate would add to what was reached."""
    before, after = criterion(reached[None]), criterion(reached + candidates.information)
    gain = after - before if criterion.kind == "D" else 1.0 - after / before
    return np.where(candidates.usable, gain, np.nan)
