"""The prior of a design: what is known of cantilever and law before the experiment, and how well.

A fit leaves one: its values, its covariance, and the drives that were measured.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float

from afm_jax.checks import check_parameter, checked
from afm_jax.contact.parameters import EFFECTS
from afm_jax.impact.law import TabulatedLaw
from afm_jax.results import Result, public_result
from afm_jax.saved import load
from afm_jax.words import printable
from fitting.infer.result import FitResult, FittedParameter
from fitting.models import Problem, check_constraints
from fitting.parameters import NUISANCE_NAMES, model_parameters, paper_values
from fitting.simulated.experiment import check_drive
from fitting.tables.csv_text import TableError

UNCERTAINTY = 0.1
"""How far a prior is off, relative, where no measurement says."""
MARGIN = 0.05
"""Uncertainty of every parameter, relative to its size (the loss, for r), that an orbit must bear however well the law
seems to be known: a law is none of a real contact to better than that where its orbits end."""


@public_result()
@dataclass(frozen=True, eq=False, kw_only=True)
class Prior(Result):
    """What is known of cantilever and law before an experiment, with its covariance.

    Attributes:
        problem: the model, its parameters and the uncertain quantities of the instrument.
        values: the expected values in the problem's order.
        information: Fisher information of everything known so far, shape (p, p): measurements and constraints; 0 in an
            unknown direction.
        free_frequency_khz: of the cantilever.
        quality_factor: of the cantilever; None: no air damping.
        mass_ng: of the cantilever; None: not known.
        fixed: values of the model's parameters that a fit held; of a contact those not the paper's.
        uncertainty: how far values may be off, relative, where `information` does not say: an orbit that is not there
            for some of these values is not planned with.
        measured: drives that were measured already, rows of order, frequency, amplitude, offset.
        source: where the prior comes from, in words.
        notes: what a reader of the design should know of it; a sentence each.
        law: of the fit, whose closest formula has these values; None: they were given.
    """

    problem: Problem
    values: Float[np.ndarray, " p"]
    information: Float[np.ndarray, "p p"]
    free_frequency_khz: float
    quality_factor: float | None
    mass_ng: float | None = None
    fixed: dict[str, float] = field(default_factory=dict)
    uncertainty: float = UNCERTAINTY
    measured: Float[np.ndarray, "rows 4"] = field(default_factory=lambda: np.zeros((0, 4)))
    source: str = "values given"
    notes: tuple[str, ...] = ()
    law: TabulatedLaw | None = None

    @property
    def sizes(self) -> Float[np.ndarray, " p"]:
        """What a relative error of each parameter refers to: the loss (1 - r for r), else the value; never 0."""
        pairs = zip(self.problem.parameters, self.values.tolist(), strict=True)
        return np.array([abs(value - known.reference) or known.width or 1.0 for known, value in pairs])

    def draws(self, count: int) -> Float[np.ndarray, "count p"]:
        """Return values that are as likely as the prior is uncertain, by `MARGIN` at least; the prior ones first."""
        own, spread = len(self.problem.own), self.uncertainty * self.sizes
        # what is known of the instrument says how far that may be off
        spread[own:] = 1.0 / np.sqrt(np.maximum(np.diag(self.information)[own:], spread[own:] ** -2.0))
        # in units of the spread the information has eigenvalues of at least 1
        curvature, axes = np.linalg.eigh(spread[:, None] * self.information * spread + np.eye(spread.size))
        normal = np.random.default_rng(1997).normal(size=(count, spread.size))
        normal[0] = 0.0
        width = np.maximum(1.0 / np.sqrt(curvature), MARGIN / self.uncertainty)
        ends = np.array([(known.lowest, known.highest) for known in self.problem.parameters]).T
        return np.clip(self.values + spread * ((normal * width) @ axes.T), *ends)


@checked
def prior_of_values(  # noqa: PLR0913
    model: str = "law+delay",
    *,
    free_frequency_khz: float,
    quality_factor: float | None = None,
    mass_ng: float | None = None,
    values: Mapping[str, float] | None = None,
    constraints: Mapping[str, tuple[float, float]] | None = None,
    uncertainty: float = UNCERTAINTY,
    drive: str = "sample",
) -> Prior:
    """Return a prior made of values, before anything was measured.

    Args:
        model: a model of `fitting.fit`.
        free_frequency_khz: of the cantilever.
        quality_factor: of the cantilever; None: no air damping.
        mass_ng: of the cantilever.
        values: of the model's parameters; those not given are the paper's contact's.
        constraints: value and standard error of what the instrument leaves uncertain: `quality_factor`,
            `tip_calibration`, `drive_calibration`, `offset_origin_nm`; or of a parameter of the model.
        uncertainty: how far the values may be off, relative (0.1 stands for 10 %).
        drive: what is driven: "sample", "force" (on the tip) or "base".

    Raises:
        ValueError: if a name or value is impossible.
    """
    check_drive(drive)
    check_parameter("free_frequency_khz", free_frequency_khz, "positive")
    check_parameter("quality_factor", quality_factor, "above 0.5", optional=True)
    check_parameter("mass_ng", mass_ng, "positive", optional=True)
    check_parameter("uncertainty", uncertainty, "between 0 and 1")
    own = model_parameters(model)
    for name in values or {}:
        if name not in own:
            raise ValueError(f"the model {model!r} has no parameter {name!r}; it has {', '.join(own)}")
    known = {name: (float(value), float(error)) for name, (value, error) in (constraints or {}).items()}
    check_constraints(known, model, own, drive)
    given = {name: value for name, (value, _) in known.items()} | dict(values or {})
    problem = Problem(model, own + tuple(name for name in NUISANCE_NAMES if name in known), drive=drive)
    assumed = ", ".join(name for name in own if name not in given)
    note = f"Not given, and taken from the paper's contact: {assumed}. Design again from a first fit."
    return Prior(
        problem=problem,
        values=_checked_values(problem, paper_values(model, mass_ng or 1.0) | given),
        information=np.diag([known[name][1] ** -2.0 if name in known else 0.0 for name in problem.names]),
        free_frequency_khz=float(free_frequency_khz),
        quality_factor=quality_factor,
        mass_ng=mass_ng,
        uncertainty=uncertainty,
        source="values assumed" if assumed else "values given",
        notes=(note,) if assumed else (),
    )


def _checked_values(problem: Problem, values: Mapping[str, float]) -> Float[np.ndarray, " p"]:
    """Return values in the problem's order.

    Raises:
        TableError: if one is outside of what its parameter can be.
    """
    for known in problem.parameters:
        value = values[known.name]
        # NaN is in no range
        if not known.lowest <= value <= known.highest:
            raise TableError(f"{known.name} must be between {known.lowest:g} and {known.highest:g}, but is {value!r}")
    return np.array([float(values[name]) for name in problem.names])


def read_prior(path: str | Path, uncertainty: float = UNCERTAINTY) -> Prior:
    """Return the prior that a saved fit leaves.

    Args:
        path: the fit.json of `afm-jax fit --out`, or what a fit's method `save` wrote.
        uncertainty: how far values may be off, relative, where the fit does not say.

    Raises:
        ValueError: if the file cannot be read, or is no fit.
    """
    fit = load(path)
    if not isinstance(fit, FitResult):
        raise TableError(f"{printable(str(path))}: is no fit; give the fit.json of `afm-jax fit --out`")
    return prior_of_fit(fit, uncertainty)


def prior_of_fit(fit: FitResult, uncertainty: float = UNCERTAINTY) -> Prior:
    """Return the prior that a fit leaves: its values, its covariance, and the drives that it used.

    Of several tables the first one's cantilever is designed with.

    Args:
        fit: from `fitting.fit`.
        uncertainty: how far values may be off, relative, where the fit does not say.
    """
    table, label = fit.table.tables[0], fit.table.labels[0]
    names = [*fit.parameters]
    places = [i for i, name in enumerate(names) if name.partition(" of ")[2] in ("", label)]
    found = {names[i].partition(" of ")[0]: fit.parameters[names[i]] for i in places}
    values = {name: one.value for name, one in found.items()}
    effects = tuple(fit.settings["effects"] or EFFECTS)
    driven = [one for one in fit.table.tables if one.drive == table.drive]
    drives = [(one.order, one.drive_frequency_khz, one.excitation_nm, one.offset_nm) for one in driven]
    reasons = " ".join(fit.reasons)
    return Prior(
        problem=Problem(fit.model, tuple(found), effects, table.drive),
        values=np.array([*values.values()]),
        information=_information([*found.values()], fit.correlations[np.ix_(places, places)]),
        free_frequency_khz=table.free_frequency_khz,
        quality_factor=values.get("quality_factor", table.quality_factor),
        mass_ng=table.mass_ng,
        fixed=dict(fit.settings["fixed"]),
        uncertainty=uncertainty,
        measured=np.concatenate([np.stack(columns, axis=1) for columns in drives]).astype(float),
        source=f"fit of {table.source}",
        notes=() if fit.valid else (f"The fit that the design rests on is not valid: {reasons}",),
        law=fit.law if fit.valid else None,
    )


def _information(found: Sequence[FittedParameter], correlations: Float[np.ndarray, "p p"]) -> Float[np.ndarray, "p p"]:
    """Return the Fisher information of a fit: of what it determined, and the constraints on what it did not."""
    information = np.diag([one.constraint[1] ** -2.0 if one.constraint else 0.0 for one in found])
    error = np.array([one.standard_error or np.nan for one in found])
    known = np.isfinite(error * np.diag(correlations))
    inner = np.ix_(known, known)
    # errors may be far apart in size: the correlations are inverted, which have none
    information[inner] = np.linalg.inv(correlations[inner]) / np.outer(error[known], error[known])
    return information
