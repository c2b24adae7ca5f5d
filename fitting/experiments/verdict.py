"""The rules by which a design is judged: what makes it pointless, and what would help more than its points."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from afm_jax.impact.law import extrapolation_of
from afm_jax.outcomes import Rule, Rules, judge
from fitting.experiments.candidates import LEFT_OUT, Candidates, standard_errors
from fitting.experiments.prior import Prior, size_of
from fitting.parameters import NUISANCE_NAMES

_MOSTLY = 0.7
"""Share of a standard error that is left if a quantity of the instrument were exactly known, below which that quantity
is most of the variance."""
_ROUGH = 0.5
"""Standard error relative to a loss beyond which a linear forecast of it is rough."""


@dataclass(frozen=True)
class DesignEvidence:
    """What a design is judged by.

    Attributes:
        prior: what it rests on.
        candidates: among which was chosen.
        chosen: their numbers.
        points: how many were asked for.
        wanted: the parameters that matter.
        reached: information after all points, by noise alone.
        forecasts: standard errors then.
    """

    prior: Prior
    candidates: Candidates
    chosen: Int[np.ndarray, " points"]
    points: int
    wanted: tuple[str, ...]
    reached: Float[np.ndarray, "p p"]
    forecasts: Float[np.ndarray, " p"]

    @property
    def left_out(self) -> str:
        """How many candidates were left out, for which reasons."""
        return "; ".join(f"{LEFT_OUT[name]}: {count}" for name, count in self.candidates.left_out.items())

    @property
    def errors(self) -> dict[str, float]:
        """The forecast standard error of each parameter that matters."""
        every = dict(zip(self.prior.problem.names, self.forecasts.tolist(), strict=True))
        return {name: every[name] for name in self.wanted}

    @property
    def undetermined(self) -> str:
        """The parameters that matter and that the points do not determine."""
        return " and ".join(name for name, error in self.errors.items() if not np.isfinite(error))

    @property
    def beyond(self) -> str | None:
        """Where the prior's law is extrapolated at the chosen points."""
        return extrapolation_of(self.prior.law, self.candidates.approach_speed_nm_per_us[self.chosen])


def judge_design(evidence: DesignEvidence) -> tuple[list[str], list[str]]:
    """Return what makes a design invalid, and its warnings; each a sentence."""
    notes = list(evidence.prior.notes)
    nothing = judge([NOTHING_TO_CHOOSE], evidence)
    return (nothing, notes) if nothing else (judge(REASONS, evidence), notes + judge(WARNINGS, evidence))


def _dominated(evidence: DesignEvidence) -> list[str]:
    """Name the quantities of the instrument whose uncertainty is most of the error of a parameter that matters."""
    names, information = evidence.prior.problem.names, evidence.reached
    errors = dict(zip(names, standard_errors(information).tolist(), strict=True))
    sentences = []
    for nuisance in (name for name in names if name in NUISANCE_NAMES and name not in evidence.wanted):
        rest = [i for i, name in enumerate(names) if name != nuisance]
        without = dict(
            zip((names[i] for i in rest), standard_errors(information[np.ix_(rest, rest)]).tolist(), strict=True)
        )
        led = [n for n in evidence.wanted if np.isfinite(errors[n]) and without[n] < _MOSTLY * errors[n]]
        if led:
            gains = " and ".join(f"{name} to {without[name]:.2g} instead of {errors[name]:.2g}" for name in led)
            sentences.append(
                f"Most of the error comes from {nuisance}: if that were exactly known, these points would determine "
                f"{gains} (by noise alone). Measure it better before adding points."
            )
    return sentences


def _rough(evidence: DesignEvidence) -> list[str]:
    """Name the parameters whose forecast is about as large as the loss itself, with the error relative to it."""
    problem, values = evidence.prior.problem, evidence.prior.values
    sizes = dict(zip(problem.names, map(size_of, problem.parameters, values.tolist()), strict=True))
    return [
        f"The forecast for {name} is rough: its error is {error / sizes[name]:.0%} of "
        f"{'1 - r' if name == 'r' else name} itself. Expect a one-sided limit rather than a value."
        for name, error in evidence.errors.items()
        if np.isfinite(error) and error > _ROUGH * sizes[name]
    ]


def _at_the_edge(evidence: DesignEvidence) -> list[str]:
    """Say where most points lie at the end of what can be driven: a wider range may then be better."""
    drives, usable, chosen = evidence.candidates.drives, evidence.candidates.usable, evidence.chosen
    tapping = evidence.prior.problem.tapping
    what = "free amplitude" if tapping else "drive amplitude"
    columns = [(drives.amplitude_nm, what), (drives.offset_nm, "offset")]
    sentences = []
    for column, what in columns[:1] if tapping else columns:
        for end, word in ((column.min(), "smallest"), (column.max(), "largest")):
            share = float(np.mean(column[chosen] == end))
            if len(np.unique(column[usable])) > 1 and share > 0.5 and len(chosen) > 1:
                sentences.append(
                    f"{share:.0%} of the points are at the {word} {what}, {end:g} nm: values beyond it may be better."
                )
    return sentences


NOTHING_TO_CHOOSE: Rule[DesignEvidence] = Rule(
    lambda e: not len(e.chosen), "No drive can be planned with ({e.left_out}); try others."
)
REASONS: Rules[DesignEvidence] = [
    Rule(
        lambda e: bool(e.undetermined),
        "The chosen points do not determine {e.undetermined}: choose more points, or drives at more frequencies, "
        "amplitudes, orders or offsets.",
    )
]
WARNINGS: Rules[DesignEvidence] = [
    Rule(
        lambda e: len(e.chosen) < e.points,
        lambda e, _: f"Only {len(e.chosen)} of the {e.points} points asked for can be planned with: all are chosen.",
    ),
    Rule(_dominated, "{case}"),
    Rule(_rough, "{case}"),
    Rule(_at_the_edge, "{case}"),
    Rule(lambda e: e.beyond is not None, "{e.beyond}"),
]
