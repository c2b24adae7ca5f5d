"""Whether to follow a design, in words: what makes it pointless, and what would help more than its points."""

import numpy as np
from jaxtyping import Float, Int

from fitting.models import NUISANCE_NAMES
from fitting.planning.experiment_belief import Belief, size_of
from fitting.planning.experiment_candidates import LEFT_OUT, Candidates
from fitting.planning.experiment_information import standard_errors

_MOSTLY = 0.7
"""Share of a standard error that is left if a quantity of the instrument were exactly known, below which that quantity
is most of the variance."""
_ROUGH = 0.5
"""Standard error relative to a loss beyond which a linear forecast of it is rough."""


def judge_design(
    belief: Belief,
    candidates: Candidates,
    chosen: Int[np.ndarray, " points"],
    steps: Float[np.ndarray, "steps p p"],
    wanted: tuple[str, ...],
    points: int,
) -> tuple[list[str], list[str]]:
    """Return what makes a design invalid, and its warnings; each a sentence.

    Args:
        belief: what it rests on.
        candidates: among which was chosen.
        chosen: their numbers.
        steps: information so far and after each point.
        wanted: the parameters that matter.
        points: how many were asked for.
    """
    names = belief.problem.names
    errors = dict(zip(names, standard_errors(steps[-1]).tolist(), strict=True))
    unknown = [name for name in wanted if not np.isfinite(errors[name])]
    if not len(chosen):
        counts = [f"{LEFT_OUT[name]}: {count}" for name, count in candidates.left_out.items()]
        return [f"No drive can be planned with ({'; '.join(counts)}); try others."], list(belief.notes)
    reasons = []
    if unknown:
        reasons.append(
            f"The chosen points do not determine {' and '.join(unknown)}: choose more points, or drives at more "
            "frequencies, amplitudes, orders or offsets."
        )
    warnings = list(belief.notes)
    if len(chosen) < points:
        warnings.append(f"Only {len(chosen)} of the {points} points asked for can be planned with: all are chosen.")
    warnings += _dominated(belief, steps[-1], errors, wanted)
    for name in wanted:
        index = names.index(name)
        size = size_of(belief.problem.parameters[index], float(belief.values[index]))
        if np.isfinite(errors[name]) and errors[name] > _ROUGH * size:
            what = "1 - r" if name == "r" else name
            warnings.append(
                f"The forecast for {name} is rough: its error is {errors[name] / size:.0%} of {what} itself. Expect a "
                "one-sided limit rather than a value."
            )
    warnings += _edges(candidates, chosen)
    return reasons, warnings


def _dominated(
    belief: Belief, information: Float[np.ndarray, "p p"], errors: dict[str, float], wanted: tuple[str, ...]
) -> list[str]:
    """Name the quantities of the instrument whose uncertainty is most of the error of a parameter that matters."""
    names = belief.problem.names
    warnings = []
    for nuisance in (name for name in names if name in NUISANCE_NAMES and name not in wanted):
        rest = [i for i, name in enumerate(names) if name != nuisance]
        without = dict(
            zip((names[i] for i in rest), standard_errors(information[np.ix_(rest, rest)]).tolist(), strict=True)
        )
        led = [n for n in wanted if np.isfinite(errors[n]) and without[n] < _MOSTLY * errors[n]]
        if led:
            gains = " and ".join(f"{name} to {without[name]:.2g} instead of {errors[name]:.2g}" for name in led)
            warnings.append(
                f"Most of the error comes from {nuisance}: if that were exactly known, these points would determine "
                f"{gains}. Measure it better before adding points."
            )
    return warnings


def _edges(candidates: Candidates, chosen: Int[np.ndarray, " points"]) -> list[str]:
    """Say where most points lie at the end of what can be driven: a wider range may then be better."""
    drives, usable = candidates.drives, candidates.usable
    warnings = []
    for column, what in ((drives.amplitude_nm, "drive amplitude"), (drives.offset_nm, "offset")):
        for end, word in ((column.min(), "smallest"), (column.max(), "largest")):
            share = float(np.mean(column[chosen] == end))
            if len(np.unique(column[usable])) > 1 and share > 0.5 and len(chosen) > 1:
                warnings.append(
                    f"{share:.0%} of the points are at the {word} {what}, {end:g} nm: a wider range may be better."
                )
    return warnings
