"""The design of an experiment: which drives to measure next, so that the law is known best."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from afm_jax.parameters import require_float64
from afm_jax.version import version_of
from fitting.models import DELAY_NAMES
from fitting.planning.experiment_after_fit import belief_of_fit
from fitting.planning.experiment_belief import Belief, size_of
from fitting.planning.experiment_candidates import AMPLITUDES, Candidates, candidates_of
from fitting.planning.experiment_information import CRITERIA, Criterion, criterion_of, standard_errors
from fitting.planning.experiment_result import Design
from fitting.planning.experiment_selection import choose_points
from fitting.planning.experiment_verdict import judge_design
from fitting.result import FitResult
from fitting.simulated.simulated_motion import Drives

_PACKAGES = ("afm-jax", "jax", "numpy")


def design(  # noqa: PLR0913
    belief: Belief | FitResult,
    drives: Drives,
    *,
    points: int = 8,
    noise: float = 0.01,
    interest: Sequence[str] | None = None,
    criterion: str = "D",
    amplitudes: str = "both",
    largest_nm: float | None = None,
) -> Design:
    """Choose the drives to measure next, and forecast how well the parameters will then be known.

    The forecast is the Fisher information: derivatives of the predicted amplitudes by every parameter at the believed
    values, by automatic differentiation through the orbits. Every drive is chosen once. A drive is left out where the
    belief has no steady single-impact orbit, or several, or is not sure of it, and where a fit would set its row aside.

    Args:
        belief: from `believe`, or a fit whose measurements are to be added to.
        drives: what can be driven, from `drive_grid`.
        points: how many to choose.
        noise: standard error of an amplitude relative to it (0.01 stands for 1 %).
        interest: the parameters to be known well, all others being unknown too; None: those of the law.
        criterion: "D": the smallest volume of their joint confidence region; "A": the smallest sum of their variances,
            each relative to the parameter (to the loss 1 - r for r).
        amplitudes: what is read of each point: "peak", "lockin" or "both".
        largest_nm: peak amplitude that the instrument takes; None: any.

    Returns:
        The points in the order of their use, with expected readings and errors; see `Design`.

    Raises:
        ValueError: if an option is impossible.
        RuntimeError: if JAX is not set to 64-bit floats.
    """
    require_float64()
    believed = belief_of_fit(belief) if isinstance(belief, FitResult) else belief
    wanted = _interest(believed, interest)
    _check_options(points, noise, criterion, amplitudes, largest_nm)
    largest = np.inf if largest_nm is None else float(largest_nm)
    candidates = candidates_of(believed, drives, noise=noise, amplitudes=amplitudes, largest_nm=largest)
    measure = _criterion(believed, candidates, wanted, criterion)
    usable, each = np.flatnonzero(candidates.usable), candidates.information
    chosen = usable[choose_points(believed.information, each[usable], points, measure)]
    steps = believed.information + np.concatenate([np.zeros((1, *each.shape[1:])), np.cumsum(each[chosen], axis=0)])
    reasons, warnings = judge_design(believed, candidates, chosen, steps, wanted, points)
    return Design(
        belief=believed,
        interest=wanted,
        criterion=criterion,
        noise=float(noise),
        candidates=candidates,
        chosen=chosen,
        errors=np.array([standard_errors(information) for information in steps]),
        gain=_gain(measure, steps[-1], candidates),
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
            "uncertainty": believed.uncertainty,
            "drives": len(drives.order),
        },
        versions={name: version_of(name) for name in _PACKAGES},
    )


def _interest(belief: Belief, interest: Sequence[str] | None) -> tuple[str, ...]:
    """Return the parameters that matter: those asked for, or the law's without its delay."""
    problem = belief.problem
    if interest is None:
        return tuple(name for name in problem.own if name not in DELAY_NAMES)
    for name in interest:
        if name not in problem.names:
            raise ValueError(f"`interest` names {name!r}, but the design has {', '.join(problem.names)}")
    if not interest or len(set(interest)) < len(interest):
        raise ValueError("`interest` must name at least one parameter, and none twice")
    return tuple(interest)


def _check_options(points: int, noise: float, criterion: str, amplitudes: str, largest_nm: float | None) -> None:
    if points < 1:
        raise ValueError(f"`points` must be at least 1, but is {points}")
    if not 0.0 < noise < 1.0:
        raise ValueError(f"`noise` must be between 0 and 1, but is {noise!r}; write 0.01 for 1 %")
    if criterion not in CRITERIA:
        raise ValueError(f"`criterion` must be one of {', '.join(CRITERIA)}, but is {criterion!r}")
    if amplitudes not in AMPLITUDES:
        raise ValueError(f"`amplitudes` must be one of {', '.join(AMPLITUDES)}, but is {amplitudes!r}")
    if largest_nm is not None and not largest_nm > 0.0:
        raise ValueError(f"`largest_nm` must be positive, but is {largest_nm!r}")


def _criterion(belief: Belief, candidates: Candidates, wanted: tuple[str, ...], kind: str) -> Criterion:
    problem = belief.problem
    return criterion_of(
        kind,
        matters=np.array([name in wanted for name in problem.names]),
        size=np.array([size_of(p, v) for p, v in zip(problem.parameters, belief.values.tolist(), strict=True)]),
        largest=belief.information + candidates.information.sum(axis=0),
    )


def _gain(criterion: Criterion, reached: Float[np.ndarray, "p p"], candidates: Candidates) -> Float[np.ndarray, " n"]:
    """Return what one more measurement at each candidate would add to what was reached."""
    before, after = criterion(reached[None]), criterion(reached + candidates.information)
    gain = after - before if criterion.kind == "D" else 1.0 - after / before
    return np.where(candidates.usable, gain, np.nan)
