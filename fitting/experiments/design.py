"""The design of an experiment: which drives to measure next, so that the law is known best.

What a set of measurements says of the parameters is its Fisher information. Points are chosen one after another, each
such that the joint confidence region of the parameters that matter becomes smallest (D-optimal).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from afm_jax.checks import check_count, check_parameter, checked, in_float64
from afm_jax.columns import CsvColumns, csv_columns, rows_of
from afm_jax.impact.law import extrapolation_of
from afm_jax.report import Bullets, Cell, Section, sections, table_of
from afm_jax.results import JudgedResult, public_result
from afm_jax.saved import as_json
from afm_jax.strict_json import plain
from afm_jax.words import with_error
from fitting.experiments.candidates import (
    LEFT_OUT,
    PHASE_NOISE_DEG,
    Candidates,
    candidates_of,
    drive_grid,
    explained,
    standard_errors,
    stated_errors,
)
from fitting.experiments.prior import Prior, prior_of_fit
from fitting.infer.result import FitResult
from fitting.parameters import DELAY_NAMES
from fitting.simulated.experiment import Drives

_EXACT = "The quality factor is taken as exact, which makes forecasts too good: give its error, as '40 +- 2'."


_SHOWN: dict[str, Cell] = {
    "N": "order:d",
    "kHz": "drive_frequency_khz:.8g",
    "nm": "drive_amplitude_nm:.5g",
    "free nm": "free_amplitude_nm:.5g",
    "offset": "offset_nm:.4g",
    "peak nm": "expected_peak_amplitude_nm:.2f",
    "lock-in nm": "expected_lockin_amplitude_nm:.2f",
    "lag deg": "expected_phase_lag_deg:.2f",
    "u_in": "expected_approach_speed_nm_per_us:.1f",
}
"""Columns that are printed, with their formats, as far as there are such readings."""


@public_result(picture="fitting.experiments.picture:design_figure")
@dataclass(frozen=True, eq=False, kw_only=True)
class Design(JudgedResult):
    """The drives to measure next and the errors to expect: what `design` returns, named like the keys of its JSON.

    Attributes:
        prior: what the design rests on.
        interest: names of the parameters that are to be known well.
        noise: standard error of an amplitude relative to it.
        candidates: every drive that was looked at.
        chosen: numbers of the points among the candidates, the most useful first.
        errors: standard error of every parameter so far and after each point, as a fit will state it, shape
            (points + 1, p); infinite where not determined.
        reasons: what makes the design invalid.
        warnings: what a reader should know besides.
    """

    prior: Prior
    interest: tuple[str, ...]
    noise: float
    candidates: Candidates
    chosen: Int[np.ndarray, " points"]
    errors: Float[np.ndarray, "steps p"]
    reasons: list[str]
    warnings: list[str]

    @property
    def drives(self) -> Drives:
        """What to drive, the most useful first; `fitting.simulate_experiment` takes them."""
        return Drives(*(column[self.chosen] for column in self.candidates.drives))

    @property
    def columns(self) -> dict[str, list[Any]]:
        """The drives under the names of a table's columns, and the readings to expect."""
        found, amplitude = self.candidates, "free" if self.prior.problem.tapping else "drive"
        names = "order", "drive_frequency_khz", f"{amplitude}_amplitude_nm", "offset_nm"
        readings = "peak_amplitude_nm", "lockin_amplitude_nm", "phase_lag_deg", "approach_speed_nm_per_us"
        expected = [*found.readings[self.chosen].T, found.approach_speed_nm_per_us[self.chosen]]
        columns = dict(
            zip((*names, *(f"expected_{name}" for name in readings)), [*self.drives, *expected], strict=True)
        )
        return {name: column.tolist() for name, column in columns.items() if np.isfinite(column).all()}

    def points(self) -> list[dict[str, Any]]:
        """Return the points as mappings: the drive, what is expected to be read, and the errors once it is."""
        names, errors = self.prior.problem.names, plain(self.errors[1:])
        return rows_of({**self.columns, "standard_errors": [dict(zip(names, row, strict=True)) for row in errors]})

    @property
    def expected(self) -> dict[str, dict[str, Any]]:
        """Value and unit of every parameter, and its standard error once the points are measured."""
        entries = zip(self.prior.problem.parameters, self.prior.values, plain(self.errors[-1]), strict=True)
        return {
            one.name: {"value": float(value), "unit": one.unit, "standard_error": error}
            for one, value, error in entries
        }


def _error_after(name: str, point: dict[str, Any]) -> float | None:
    return point["standard_errors"][name]


@as_json.register
def _(plan: Design) -> dict[str, Any]:
    names = ("valid", "reasons", "warnings", "noise", "interest", "expected")
    return {
        "format": "afm-jax design",
        "format_version": 2,
        "drive": plan.prior.problem.drive,
        "model": plan.prior.problem.model,
        **{name: getattr(plan, name) for name in names},
        "points": plan.points(),
        "candidates": int(plan.candidates.usable.sum()),
        "left_out": plan.candidates.left_out,
        "prior": {"source": plan.prior.source, "rows_measured": len(plan.prior.measured)},
    }


@csv_columns.register
def _(plan: Design) -> CsvColumns:
    return {"design.csv": plan.columns}


@sections.register
def _(plan: Design) -> list[Section]:
    points, problem = plan.points(), plan.prior.problem
    cells = {head: cell for head, cell in _SHOWN.items() if str(cell).partition(":")[0] in plan.columns}
    for name in plan.interest[:4]:
        cells[f"+- {name}"] = partial(_error_after, name)
    after = [
        f"{name} {with_error(entry['value'], entry['standard_error'])} {entry['unit']}".rstrip()
        for name, entry in plan.expected.items()
    ]
    usable, left_out = plan.candidates.usable, plan.candidates.left_out
    title = f"{len(plan.chosen)} points to measure next for {', '.join(plan.interest)}"
    said = "  u_in in nm/us; +- columns: standard errors expected once this point and those above are measured"
    why = [f"{count} left out: {LEFT_OUT[name]}" for name, count in left_out.items()]
    return [
        Section(f"{title} ({problem.model}, {plan.prior.source})", []),
        Section("Points", [table_of(cells, points, form=".2g"), said]),
        Section("Forecast", [f"After all: {', '.join(after)}"]),
        Section("Drives", [Bullets(why, f"{usable.sum()} of {usable.size} drives can be planned with.")]),
    ]


@checked
@in_float64
def design(  # noqa: PLR0913
    prior: Prior | FitResult,
    drives: Drives | None = None,
    *,
    points: int = 8,
    noise: float = 0.01,
    interest: Sequence[str] | None = None,
    amplitudes: Literal["both", "peak", "lockin"] = "both",
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
        drives: what can be driven, from `drive_grid`; None: what that looks at if nothing is said.
        points: how many to choose.
        noise: standard error of an amplitude relative to it (0.01 stands for 1 %).
        interest: the parameters to be known well, all others being unknown too; none: those of the law.
        amplitudes: what is read of each point: "peak", "lockin" or "both"; of a cantilever that is driven itself always
            the lock-in amplitude and the lag.
        largest_nm: peak amplitude that the instrument takes (of a cantilever that is driven itself the free one); None:
            any.
        phase_noise_deg: standard error of a lag in degrees.

    Returns:
        The points in the order of their use, with expected readings and errors; see `Design`.

    Raises:
        ValueError: if an option is impossible.
    """
    prior = prior_of_fit(prior) if isinstance(prior, FitResult) else prior
    names = prior.problem.names
    interest = interest or [name for name in prior.problem.own if name not in DELAY_NAMES]
    for name in interest:
        if name not in names:
            raise ValueError(f"`interest` names {name!r}, but the design has {', '.join(names)}")
    check_count("points", points, 1)
    check_parameter("noise", noise, "between 0 and 1")
    check_parameter("largest_nm", largest_nm, "positive", optional=True)
    check_parameter("phase_noise_deg", phase_noise_deg, "positive")
    if drives is None:
        drives = drive_grid(free_frequency_khz=prior.free_frequency_khz, drive=prior.problem.drive)
    rows = explained(prior, drives, noise=noise, amplitudes=amplitudes, phase_noise_deg=phase_noise_deg)
    candidates = candidates_of(prior, drives, rows, largest_nm or np.inf)
    usable, information = np.flatnonzero(candidates.usable), candidates.information
    matters = np.isin(names, interest)
    chosen = usable[choose_points(prior.information, information[usable], points, matters)]
    errors = standard_errors(np.cumsum([prior.information, *information[chosen]], axis=0))
    if prior.problem.lasting and chosen.size:
        errors[1:] = [stated_errors(prior, rows, chosen[: 1 + last]) for last in range(len(chosen))]
    undetermined = [name for name in interest if not np.isfinite(errors[-1, names.index(name)])]
    reasons = []
    if not chosen.size:
        reasons = ["No drive can be planned with; try others."]
    elif undetermined:
        more = "choose more points, or drives at more frequencies, amplitudes, orders or offsets"
        reasons = [f"The chosen points do not determine {' and '.join(undetermined)}: {more}."]
    beyond = extrapolation_of(prior.law, candidates.approach_speed_nm_per_us[chosen])
    exact = prior.quality_factor is not None and "quality_factor" not in names
    return Design(
        prior=prior,
        interest=tuple(interest),
        noise=float(noise),
        candidates=candidates,
        chosen=chosen,
        errors=errors,
        reasons=reasons,
        warnings=[*prior.notes, *filter(None, [_EXACT if exact else None, beyond])],
    )


def choose_points(
    prior: Float[np.ndarray, "p p"], each: Float[np.ndarray, "n p p"], points: int, matters: Bool[np.ndarray, " p"]
) -> Int[np.ndarray, " points"]:
    """Return the numbers of the chosen candidates, each once, in the order in which they help most.

    Args:
        prior: information of what is known already.
        each: information of a measurement at every candidate.
        points: how many to choose; at most n are.
        matters: which parameters are to be known well.
    """
    strength = np.diag(prior + each.sum(axis=0))
    unit = 1.0 / np.sqrt(np.where(strength > 0.0, strength, 1.0))
    # a little information on every parameter: the first points, which alone determine nothing, can then be compared
    so_far = unit[:, None] * prior * unit + 1e-9 * np.eye(len(unit))
    gains = unit[:, None] * each * unit

    def score(information: Float[np.ndarray, "n p p"]) -> Float[np.ndarray, " n"]:
        """Return log det of the information about what matters: log det F - log det F_nuisances."""
        whole = np.linalg.slogdet(information)[1]
        nuisances = information[:, ~matters][:, :, ~matters]
        return whole - np.linalg.slogdet(nuisances)[1]

    chosen: list[int] = []
    for _ in range(min(points, len(each))):
        worth = score(so_far + gains)
        worth[chosen] = -np.inf
        chosen.append(int(np.argmax(worth)))
        so_far = so_far + gains[chosen[-1]]
    return np.array(chosen, dtype=np.int64)
