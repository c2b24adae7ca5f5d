"""Models compared on the same table: information criteria, and in plain words what the measurement can tell."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from afm_jax.checks import checked, require_float64
from afm_jax.results import Result, public_result
from fitting.fits.estimate import Found
from fitting.fits.fit import find_fit, summarise, tables_of
from fitting.fits.minimum import ModelErrors, settle, with_inflated_errors
from fitting.fits.result import FitResult
from fitting.parameters import CONTACT_NAMES, LAWS, MODELS, model_parameters
from fitting.tables.several import SeveralTables
from fitting.tables.table import AmplitudeTable, TableLike

_EVEN, _PLAIN = 2.0, 10.0
"""Differences of AIC up to which models are even, and beyond which one is clearly favoured."""


@public_result(picture="fitting.report.plots:models_figure", rows="rows")
@dataclass(frozen=True)
class Comparison(Result):
    """Models of one table, the best one first.

    Attributes:
        rows: for each model its name, chi2, degrees_of_freedom and valid, those of its fit in `results`; aic, of the
            formula alone: without the model discrepancy, which would make up for what it lacks, on the rows that all
            models use and with the largest of their own errors; delta_aic (to the best).
        verdict: what the measurement tells, a sentence or two.
        results: the fit of every model, by name.
        failed: of every model that could not be fitted, why.
    """

    rows: list[dict[str, Any]]
    verdict: str
    results: dict[str, FitResult]
    failed: dict[str, str] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """Return rows, verdict and failures, without the fits."""
        return {"rows": self.rows, "verdict": self.verdict, "failed": self.failed}


def rivals(model: str, fixed: Mapping[str, float] | None = None) -> tuple[str, ...]:
    """Return the models that a model is usually compared with, itself first: the laws with one loss beside adhesion.

    Args:
        model: a model of `fit`.
        fixed: what is held fixed; models that would have nothing left to fit are left out.
    """
    if model == "contact":
        return ("contact", "viscous+delay", "law+delay")
    ending = "+delay" if model.endswith("+delay") else ""
    others = (f"{law}{ending}" for law in LAWS if law != "full" and f"{law}{ending}" != model)
    return (model, *(other for other in others if set(MODELS[other]) - set(fixed or {})))


@checked
def compare(
    table: TableLike | SeveralTables | Sequence[TableLike],
    models: Sequence[str] = ("law+delay", "viscous+delay"),
    *,
    known: Mapping[str, tuple[Found, FitResult]] | None = None,
    **options: Any,
) -> Comparison:
    """Fit several models to one table and compare them on the same rows with the same errors.

    For the comparison a row that one model sets aside is set aside for all, and every row has the largest of the
    models' own errors. A model that cannot be fitted is left out, and the comparison says so.

    Args:
        table: the amplitudes, of one table or of several.
        models: names of models.
        known: minimum and summary of models that were fitted to the table with the same options already.
        options: as of `fit`; `free` and `fixed` go to models that have such parameters, `effects` to "contact".

    Raises:
        ValueError: if fewer than two different models are named, or one of them there is not; as `fit`, if no model can
            be fitted.
    """
    require_float64()
    if len(set(models)) < 2:
        raise ValueError("comparing needs at least two different models")
    for model in models:
        of_model = _options_of(model, options)
        free = of_model.get("free")
        model_parameters(model, None if free is None else tuple(free), of_model.get("fixed"))

    whole = tables_of(table)

    fits: dict[str, tuple[Found, FitResult]] = {}
    failures: dict[str, Exception] = {}
    for model in dict.fromkeys(models):
        try:
            fits[model] = _fitted(whole, model, known or {}, options)
        except (ValueError, ArithmeticError, RuntimeError) as error:
            failures[model] = error
    if not fits:
        raise next(iter(failures.values()))
    failed = {model: str(error) or type(error).__name__ for model, error in failures.items()}
    errors = np.max([one.model_errors.model_error for one, _ in fits.values()], axis=0)
    # the strings' maximum: any reason rather than none
    reasons = np.max([one.model_errors.reasons for one, _ in fits.values()], axis=0)
    common = ModelErrors(errors, errors, reasons)
    rows = sorted((_row(model, *fit, common) for model, fit in fits.items()), key=lambda row: row["aic"])
    for row in rows:
        row["delta_aic"] = row["aic"] - rows[0]["aic"]
    return Comparison(rows, _verdict(rows, failed), {model: result for model, (_, result) in fits.items()}, failed)


def _fitted(
    table: AmplitudeTable | SeveralTables,
    model: str,
    known: Mapping[str, tuple[Found, FitResult]],
    options: dict[str, Any],
) -> tuple[Found, FitResult]:
    """Return minimum and summary of a model.

    Raises:
        FloatingPointError: if its chi2 is not a finite number.
    """
    if model in known:
        found, result = known[model]
    else:
        found = find_fit(table, model, **_options_of(model, options))
        result = summarise(table, found)
    if not np.isfinite(result.chi2):
        raise FloatingPointError("chi2 is not finite")
    return found, result


def _options_of(model: str, options: dict[str, Any]) -> dict[str, Any]:
    """Return what of the options is about a model: another one has other parameters."""
    names = CONTACT_NAMES if model == "contact" else MODELS.get(model, ())
    chosen = dict(options)
    if model != "contact":
        chosen.pop("effects", None)
        known = chosen.get("constraints") or {}
        # what is known of a contact's parameter is nothing that a law has
        chosen["constraints"] = {name: pair for name, pair in known.items() if name not in CONTACT_NAMES} or None
    if any(name not in names for name in chosen.get("free") or ()):
        del chosen["free"]
    if chosen.get("fixed"):
        chosen["fixed"] = {name: value for name, value in chosen["fixed"].items() if name in names}
    return chosen


def _row(model: str, found: Found, result: FitResult, common: ModelErrors) -> dict[str, Any]:
    stated, minimum = found.stated, found.minimum
    objective = with_inflated_errors(stated, common)
    if stated.problem.lasting or common.model_error.any():
        minimum = settle(objective, minimum)
    values = stated.problem.values(minimum.coordinates)
    chi2 = float(np.sum(objective.residual(values[None]) ** 2))
    return {
        "model": model,
        "chi2": result.chi2,
        "degrees_of_freedom": result.degrees_of_freedom,
        "aic": chi2 + 2.0 * len(values),
        "valid": result.valid,
    }


def _verdict(rows: list[dict[str, Any]], failed: dict[str, str]) -> str:
    """Return what the difference of AIC says of the two best models, and whether the best one is any good."""
    first, *others = (f"{row['model']}: {_meaning(row['model'])}" for row in rows)
    said = f"There is nothing to compare {first} with."
    if others:
        gap = rows[1]["delta_aic"]
        said = f"The measurement tells plainly: {first}, not {others[0]} (AIC lower by {gap:.0f})."
        if gap < _PLAIN:
            said = f"The measurement favours {first} over {others[0]} (AIC lower by {gap:.1f}), not conclusively."
        if gap < _EVEN:
            said = f"The measurement does not tell {first} from {others[0]} (AIC differs by {gap:.1f})."
    if not rows[0]["valid"]:
        said += f" But the fit of {rows[0]['model']} is not valid itself."
    return said + "".join(f" The fit of {model} failed: {reason.rstrip('.')}." for model, reason in failed.items())


def _meaning(model: str) -> str:
    law = LAWS.get(model.removesuffix("+delay"))
    return law.meaning if law else "the resolved contact"
