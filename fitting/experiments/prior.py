"""The prior of a design: what is known of cantilever and law before the experiment, and how well.

A fit leaves one: its values, its covariance, and the drives that were measured.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from afm_jax.apparatus.cantilever import mass_of
from afm_jax.checks import check_parameter, checked
from afm_jax.contact.parameters import EFFECTS
from afm_jax.impact.law import TabulatedLaw, law_of_dict
from afm_jax.results import Result, public_result
from afm_jax.scenefile.tables import printable
from fitting.fits.result import FitResult
from fitting.models import Problem, check_constraints
from fitting.parameters import (
    MODELS,
    NUISANCE_NAMES,
    PARAMETERS,
    Parameter,
    model_parameters,
    paper_values,
)
from fitting.simulated.experiment import check_drive
from fitting.tables.csv_text import TableError, beyond, read_fit_json

UNCERTAINTY = 0.1
"""How far a prior is off, relative, where no measurement says."""
DRAW_SEED = 1997
EXACT_QUALITY_FACTOR = (
    "The quality factor is taken as exactly known, which makes every forecast too good: give it with its error, such "
    "as '40 +- 2'."
)


@public_result()
@dataclass(frozen=True, eq=False, kw_only=True)
class Prior(Result):
    """What is known of cantilever and law before an experiment, with its covariance.

    Attributes:
        problem: the model, its parameters and the uncertain quantities of the instrument.
        values: the expected values in the problem's order.
        information: Fisher information of everything known so far, shape (p, p): measurements and constraints; 0 in a
            direction of which nothing is known.
        free_frequency_khz: of the cantilever.
        quality_factor: of the cantilever; None: no air damping.
        mass_ng: of the cantilever; None: not known.
        fixed: values of the model's parameters that are not fitted; of a contact those not the paper's.
        uncertainty: how far values may be off, relative, where `information` does not say: an orbit that is not there
            for some of these values is not planned with.
        constraints: value and standard error of what is known apart from the measured drives; part of `information`.
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
    constraints: dict[str, tuple[float, float]] = field(default_factory=dict)
    measured: Float[np.ndarray, "rows 4"] = field(default_factory=lambda: np.zeros((0, 4)))
    source: str = "values given"
    notes: tuple[str, ...] = ()
    law: TabulatedLaw | None = None

    def draws(self, count: int, *, least: float = 0.0) -> Float[np.ndarray, "count p"]:
        """Return values that are as likely as the prior is uncertain, the prior ones first; seeded.

        Args:
            count: how many.
            least: the uncertainty, relative to the parameters' sizes, that is left to any combination of them.
        """
        sizes = np.array([size_of(p, v) for p, v in zip(self.problem.parameters, self.values, strict=True)])
        spread = self.uncertainty * sizes
        # a share of the frequency would be many widths of the resonance
        if "free_frequency_khz" in self.constraints:
            spread[self.problem.names.index("free_frequency_khz")] = self.constraints["free_frequency_khz"][1]
        # In units of the spread: the information then has eigenvalues of at least 1.
        scaled = spread[:, None] * self.information * spread + np.eye(len(spread))
        curvature, axes = np.linalg.eigh(scaled)
        normal = np.random.default_rng(DRAW_SEED).normal(size=(count, len(spread)))
        normal[0] = 0.0
        width = np.maximum(1.0 / np.sqrt(curvature), least / self.uncertainty)
        values = self.values + spread * ((normal * width) @ axes.T)
        return np.clip(values, *self.problem.ends)


def size_of(parameter: Parameter, value: float) -> float:
    """Return what a relative error of a parameter refers to: the loss (1 - r for r), else the value; never 0."""
    size = abs(value - parameter.reference) if parameter.sign else abs(value)
    return size or parameter.width or 1.0


@checked
def prior_of_values(  # noqa: PLR0913
    model: str = "law+delay",
    *,
    free_frequency_khz: float,
    quality_factor: float | None = None,
    mass_ng: float | None = None,
    spring_constant_n_per_m: float | None = None,
    values: Mapping[str, float] | None = None,
    constraints: Mapping[str, tuple[float, float]] | None = None,
    free: Sequence[str] | None = None,
    fixed: Mapping[str, float] | None = None,
    effects: Sequence[str] = EFFECTS,
    uncertainty: float = UNCERTAINTY,
    drive: str = "sample",
) -> Prior:
    """Return a prior made of values, before anything was measured.

    Args:
        model: a model of `fitting.fit`.
        free_frequency_khz: of the cantilever.
        quality_factor: of the cantilever; None: no air damping.
        mass_ng: of the cantilever.
        spring_constant_n_per_m: or its spring constant, whose mass is k/Omega^2.
        values: of the model's parameters; those not given are the paper's contact's.
        constraints: value and standard error of what the instrument leaves uncertain: `quality_factor`,
            `tip_calibration`, `drive_calibration`, `offset_origin_nm`; or of a parameter of the model.
        free: the parameters that are fitted, as of `fit`.
        fixed: values of others of the model's parameters.
        effects: for "contact": the effects there are.
        uncertainty: how far the values may be off, relative (0.1 stands for 10 %).
        drive: what is driven: "sample", "force" (on the tip) or "base".

    Raises:
        ValueError: if a name or value is impossible.
    """
    check_drive(drive)
    for name, value, allowed in (
        ("free_frequency_khz", free_frequency_khz, "positive"),
        ("quality_factor", quality_factor, "above 0.5"),
        ("mass_ng", mass_ng, "positive"),
    ):
        check_parameter(name, value, allowed, optional=True)
    own = model_parameters(model, None if free is None else tuple(free), fixed)
    known = {name: (float(value), float(error)) for name, (value, error) in (constraints or {}).items()}
    check_constraints(known, model, own, drive)
    given = dict(values or {})
    for name in given:
        if name not in own:
            raise ValueError(f"the model {model!r} has no parameter {name!r}; it has {', '.join(own)}")
    if not 0.0 < uncertainty < 1.0:
        raise ValueError(f"`uncertainty` must be between 0 and 1, but is {uncertainty!r}; write 0.1 for 10 %")
    problem = Problem(model, own + tuple(name for name in NUISANCE_NAMES if name in known), tuple(effects), drive)
    if spring_constant_n_per_m is not None:
        mass_ng = float(mass_of(free_frequency_khz, mass_ng, spring_constant_n_per_m))
    assumed = [name for name in own if name not in given and name not in known]
    start = (
        paper_values(model, 1.0 if mass_ng is None else mass_ng)
        | {name: value for name, (value, _) in known.items()}
        | given
    )
    information = np.diag([known[name][1] ** -2.0 if name in known else 0.0 for name in problem.names])
    return Prior(
        problem=problem,
        values=checked_values(problem, start),
        information=information,
        free_frequency_khz=float(free_frequency_khz),
        quality_factor=None if quality_factor is None else float(quality_factor),
        mass_ng=None if mass_ng is None else float(mass_ng),
        fixed=dict(fixed or {}),
        uncertainty=uncertainty,
        constraints=known,
        source="values assumed" if assumed else "values given",
        notes=_assumptions(assumed, quality_factor, known),
    )


def checked_values(problem: Problem, values: Mapping[str, float]) -> Float[np.ndarray, " p"]:
    """Return values in the problem's order.

    Raises:
        ValueError: if one is outside of what its parameter can be.
    """
    for parameter in problem.parameters:
        value = values[parameter.name]
        if not np.isfinite(value) or not parameter.lowest <= value <= parameter.highest:
            raise ValueError(
                f"{parameter.name} must be between {parameter.lowest:g} and {parameter.highest:g}, but is {value!r}"
            )
    return np.array([float(values[name]) for name in problem.names])


def _assumptions(
    assumed: list[str], quality_factor: float | None, known: Mapping[str, tuple[float, float]]
) -> tuple[str, ...]:
    notes = []
    if assumed:
        notes.append(
            f"Not given, and taken from the paper's contact: {', '.join(assumed)}. The forecast is as good as these "
            "values; design again from a first fit."
        )
    if quality_factor is not None and "quality_factor" not in known:
        notes.append(EXACT_QUALITY_FACTOR)
    return tuple(notes)


def read_prior(path: str | Path, uncertainty: float = UNCERTAINTY) -> tuple[Prior, dict[str, Any]]:
    """Return the prior that a saved fit leaves, and the fit's own object.

    Args:
        path: what `afm-jax fit --json` prints, or the fit.json of its report.
        uncertainty: how far values may be off, relative, where the fit does not say.

    Raises:
        TableError: if the file cannot be read, or is no fit.
    """
    payload = read_fit_json(path)
    try:
        return prior_of_fit(payload, uncertainty), payload
    except ValueError as error:
        raise TableError(f"{printable(str(path))}: {error}") from error
    except (ArithmeticError, AttributeError, LookupError, TypeError) as error:
        # an entry of another kind than `afm-jax fit` writes there
        raise TableError(f"{printable(str(path))}: the saved fit is damaged; fit the table again") from error


def _columns_of(drive: str | None) -> tuple[str, str, str, str]:
    """Return the columns that say how a table's rows were driven."""
    amplitude = "drive_amplitude_nm" if drive in (None, "sample") else "free_amplitude_nm"
    return "order", "drive_frequency_khz", amplitude, "offset_nm"


def prior_of_fit(result: FitResult | Mapping[str, Any], uncertainty: float = UNCERTAINTY) -> Prior:
    """Return the prior that a fit leaves: its values, its covariance, and the drives that it used.

    Args:
        result: from `fitting.fit`, or its JSON (`afm-jax fit --json`) as a mapping.
        uncertainty: how far values may be off, relative, where the fit does not say.

    Raises:
        ValueError: if the mapping is no fit, or its correlations are impossible.
    """
    payload = result.to_dict() if isinstance(result, FitResult) else result
    _check_payload(payload)
    settings, tables = payload.get("settings") or {}, payload["input"].get("tables") or [payload["input"]]
    # of several tables the first one's cantilever is designed with
    table, drive = tables[0], tables[0].get("drive") or "sample"
    driven = [one for one in tables if (one.get("drive") or "sample") == drive]
    found, matrix = payload["parameters"], payload["correlations"]["matrix"]
    prior = {name: entry["value"] for name, entry in found.items()}
    problem = Problem(payload["model"], tuple(found), tuple(settings.get("effects") or EFFECTS), drive)
    notes = []
    if not payload["valid"]:
        reason = " ".join(payload.get("reasons") or ["no reason given."])
        notes.append(f"The fit that the design rests on is not valid: {reason}")
    if table.get("quality_factor") is not None and "quality_factor" not in found:
        notes.append(EXACT_QUALITY_FACTOR)
    return Prior(
        problem=problem,
        values=checked_values(problem, prior),
        information=_information(found, matrix),
        free_frequency_khz=float(table["free_frequency_khz"]),
        quality_factor=table.get("quality_factor"),
        mass_ng=table.get("mass_ng"),
        fixed=dict(settings.get("fixed") or {}),
        uncertainty=uncertainty,
        constraints={
            name: (float(entry["constraint"][0]), float(entry["constraint"][1]))
            for name, entry in found.items()
            if entry.get("constraint")
        },
        measured=np.array([[place for one in driven for place in one[name]] for name in _columns_of(drive)], float).T,
        source=f"fit of {table.get('source', 'a table')}",
        notes=tuple(notes),
        law=_law_of(result, payload),
    )


def _law_of(result: FitResult | Mapping[str, Any], payload: Mapping[str, Any]) -> TabulatedLaw | None:
    if isinstance(result, FitResult):
        return result.law
    told = payload.get("law")
    return law_of_dict(told) if isinstance(told, dict) and told.get("numbers") and payload["valid"] else None


def _information(found: Mapping[str, Any], correlations: Sequence[Sequence[float | None]]) -> Float[np.ndarray, "p p"]:
    """Return the Fisher information of a fit: of what it determined, and the constraints on what it did not."""
    matrix = np.array([[np.nan if c is None else c for c in row] for row in correlations], float)
    error = np.array([np.nan if e["standard_error"] is None else e["standard_error"] for e in found.values()], float)
    known = np.isfinite(error) & np.isfinite(np.diag(matrix)) & (error > 0.0)
    information = np.zeros((len(error), len(error)))
    places = np.ix_(known, known)
    weight = np.where(known, 1.0 / np.where(known, error, 1.0), 0.0)
    if known.any() and (not np.all(np.isfinite(matrix[places])) or np.linalg.eigvalsh(matrix[places])[0] < 1e-14):
        raise ValueError("the saved fit's correlations contradict each other; fit the table again")
    # Errors far apart in size: invert the correlations, which have none.
    information[places] = np.linalg.inv(matrix[places]) * np.outer(weight, weight)[places] if known.any() else 0.0
    for i, entry in enumerate(found.values()):
        if not known[i] and entry.get("constraint"):
            information[i, i] = float(entry["constraint"][1]) ** -2.0
    return information


def _check_payload(payload: Mapping[str, Any]) -> None:
    if payload.get("format") != "afm-jax fit":
        raise ValueError("this is no saved fit; give the JSON of `afm-jax fit TABLE.csv --json`")
    for key in ("model", "parameters", "correlations", "input", "valid"):
        if key not in payload:
            raise ValueError(f"the saved fit lacks {key!r}; write it again with `afm-jax fit TABLE.csv --json`")
    if payload["model"] not in MODELS:
        raise ValueError(f"the saved fit has the unknown model {payload['model']!r}; fit the table again")
    for name in payload["parameters"]:
        if name not in PARAMETERS:
            raise ValueError(f"the saved fit has the unknown parameter {name!r}; fit the table again")
    if not _is_whole(payload):
        raise ValueError("the saved fit's parameters, correlations or drives are damaged; fit the table again")


def _is_whole(payload: Mapping[str, Any]) -> bool:
    """Say whether a saved fit has the numbers that prior rests on, as many as it should."""
    try:
        entries = [(entry["value"], entry["standard_error"] or 0.0) for entry in payload["parameters"].values()]
        matrix = [[np.nan if c is None else c for c in row] for row in payload["correlations"]["matrix"]]
        tables = payload["input"].get("tables") or [payload["input"]]
        columns = [
            [column for name in _columns_of(table.get("drive")) if (column := table[name]) is not None]
            for table in tables
        ]
        drives = all(np.array(of_one, float).ndim == 2 for of_one in columns)
        whole = np.isfinite([number for entry in entries for number in entry]).all()
        whole &= not np.any(beyond(np.array([error for _, error in entries], float), positive=True))
        known = all(math.isfinite(table["free_frequency_khz"]) for table in tables)
        return bool(whole) and known and drives and np.array(matrix, float).shape == (len(entries), len(entries))
    except (AttributeError, KeyError, TypeError, ValueError):
        return False
