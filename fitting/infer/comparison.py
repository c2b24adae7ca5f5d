"""Models compared on the same table, and in plain words what the measurement can tell.

Instantaneous laws are compared by their information criterion (AIC). Where impacts last one fit finds the law, whatever
the formula: how far each formula stays from that law, in terms of its band, says which formula suffices.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float

from afm_jax.checks import checked, require_float64
from afm_jax.results import Result, public_result
from fitting.infer.fit import fit, tables_of
from fitting.infer.law import closest_loss, rebound_by_formula
from fitting.infer.result import FitResult, FittedLaw
from fitting.parameters import CONTACT_NAMES, LAW, LAWS, MODELS, model_parameters
from fitting.tables.several import SeveralTables
from fitting.tables.table import AmplitudeTable, TableLike

_EVEN, _PLAIN = 2.0, 10.0
"""Differences of AIC up to which models are even, and beyond which one is clearly favoured."""
_ROUNDS = 8


@public_result(picture="fitting.report.plots:models_figure", rows="rows")
@dataclass(frozen=True)
class Comparison(Result):
    """Models of one table, the best one first.

    Attributes:
        rows: for each model its name, chi2, degrees_of_freedom and valid of its fit; of instantaneous laws aic and
            delta_aic (to the best); of models whose impacts last largest_distance, how far at most the closest formula
            is from the law over the measured speeds, in half-widths of its 95 % band, and the same relative to the
            rebound speed.
        verdict: what the measurement tells, a sentence or two.
        results: the fits, by model; formulas whose impacts last have one in common.
        failed: of every model that could not be fitted, why.
        rebounds: rebound speeds in nm/us of every model at the points of the first result's law.
    """

    rows: list[dict[str, Any]]
    verdict: str
    results: dict[str, FitResult]
    failed: dict[str, str] = field(default_factory=dict)
    rebounds: dict[str, Float[np.ndarray, " points"]] = field(default_factory=dict)

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
    known: Mapping[str, FitResult] | None = None,
    **options: Any,
) -> Comparison:
    """Compare several models on one table.

    A model that cannot be fitted is left out, and the comparison says so.

    Args:
        table: the amplitudes, of one table or of several.
        models: names of models.
        known: fits of models to the table with the same options.
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
    # formulas whose impacts last have one law: that of the first with adhesion, which finds any
    formulas = sorted((m for m in models if m.endswith("+delay")), key=lambda model: "epsilon" not in MODELS[model])
    formula = formulas[0] if formulas else None
    results: dict[str, FitResult] = {}
    failures: dict[str, Exception] = {}
    for model in dict.fromkeys(models):
        if model.endswith("+delay") and model != formula and model not in (known or {}):
            continue
        try:
            results[model] = _fitted(whole, model, known or {}, options)
        except (ValueError, ArithmeticError, RuntimeError) as error:
            failures[model] = error
    if not results:
        raise next(iter(failures.values()))
    failed = {model: str(error) or type(error).__name__ for model, error in failures.items()}
    lasting = [model for model in dict.fromkeys(models) if model.endswith("+delay") or model == "contact"]
    rows, rebounds = _by_information({m: r for m, r in results.items() if m not in lasting})
    if lasting and (formula or "contact") in results:
        of_law = results[formula if formula in results else "contact"]
        reached = [model for model in lasting if model not in failed]
        more, others = _by_distance(of_law, reached, results, options)
        rows, rebounds = [*more, *rows], others | rebounds
    return Comparison(rows, _verdict(rows, failed), results, failed, rebounds)


def _fitted(
    table: AmplitudeTable | SeveralTables, model: str, known: Mapping[str, FitResult], options: dict[str, Any]
) -> FitResult:
    """Return the fit of a model.

    Raises:
        FloatingPointError: if its chi2 is not a finite number.
    """
    result = known[model] if model in known else fit(table, model, **_options_of(model, options))
    if not np.isfinite(result.chi2):
        raise FloatingPointError("chi2 is not finite")
    return result


def _by_information(results: Mapping[str, FitResult]) -> tuple[list[dict[str, Any]], dict[str, np.ndarray]]:
    """Return instantaneous models by their AIC, and their rebound speeds at the points of the best one's law."""
    rows: list[dict[str, Any]] = [_row(model, result) | {"aic": result.aic} for model, result in results.items()]
    rows = sorted(rows, key=lambda row: row["aic"])
    for row in rows:
        row["delta_aic"] = row["aic"] - rows[0]["aic"]
    if not rows:
        return [], {}
    speeds = results[rows[0]["model"]].law.approach_speed_nm_per_us
    return rows, {row["model"]: _at(results[row["model"]].law, speeds) for row in rows}


def _by_distance(
    of_law: FitResult, models: Sequence[str], results: Mapping[str, FitResult], options: dict[str, Any]
) -> tuple[list[dict[str, Any]], dict[str, np.ndarray]]:
    """Return models whose impacts last by their distance from the law, and their rebound speeds at its points."""
    law, reached = of_law.law, of_law.rows.reached_nm_per_us
    speeds, rebound = law.approach_speed_nm_per_us, law.rebound_speed_nm_per_us
    half = law.rebound_high_nm_per_us - rebound
    inside = (rebound > 0.0) & (half > 0.0) & np.isfinite(half)
    if reached.size:
        inside &= (speeds >= reached.min()) & (speeds <= reached.max())
    rows, rebounds = [], {}
    for model in models:
        result = results.get(model, of_law)
        if model == "contact":
            rebounds[model] = _at(result.law, speeds)
        else:
            fixed = (_options_of(model, options).get("fixed") or {}) if options else {}
            names = [
                parameter.name for parameter in LAW if parameter.name in MODELS[model] and parameter.name not in fixed
            ]
            weight = 1.0 / half[inside] if inside.any() else np.ones(0)
            found = closest_loss(names, speeds[inside], rebound[inside], weight, fixed, _ROUNDS) if inside.any() else {}
            rebounds[model] = rebound_by_formula(dict(fixed) | found, speeds)
        off = np.abs(rebounds[model] - rebound)[inside]
        distance = float(np.max(off / half[inside], initial=0.0)) if inside.any() else None
        relative = float(np.max(off / rebound[inside], initial=0.0)) if inside.any() else None
        rows.append(_row(model, result) | {"largest_distance": distance, "largest_relative_distance": relative})
    return sorted(
        rows, key=lambda row: np.inf if row["largest_distance"] is None else row["largest_distance"]
    ), rebounds


def _at(law: FittedLaw, speeds: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    return np.interp(speeds, law.approach_speed_nm_per_us, law.rebound_speed_nm_per_us, left=np.nan, right=np.nan)


def _row(model: str, result: FitResult) -> dict[str, Any]:
    return {
        "model": model,
        "chi2": result.chi2,
        "degrees_of_freedom": result.degrees_of_freedom,
        "valid": result.valid,
    }


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


def _verdict(rows: list[dict[str, Any]], failed: dict[str, str]) -> str:
    """Return what tells the models apart, and whether the best one is any good."""
    first, *others = (f"{row['model']}: {_meaning(row['model'])}" for row in rows)
    said = f"There is nothing to compare {first} with."
    if others and "delta_aic" in rows[1] and "delta_aic" in rows[0]:
        gap = rows[1]["delta_aic"]
        said = f"The measurement tells plainly: {first}, not {others[0]} (AIC lower by {gap:.0f})."
        if gap < _PLAIN:
            said = f"The measurement favours {first} over {others[0]} (AIC lower by {gap:.1f}), not conclusively."
        if gap < _EVEN:
            said = f"The measurement does not tell {first} from {others[0]} (AIC differs by {gap:.1f})."
    elif others:
        said = _sufficient(rows)
    if not rows[0]["valid"]:
        said += f" But the fit of {rows[0]['model']} is not valid itself."
    return said + "".join(f" The fit of {model} failed: {reason.rstrip('.')}." for model, reason in failed.items())


def _sufficient(rows: list[dict[str, Any]]) -> str:
    """Return which formulas stay within the band of the law that was found without them."""
    known = [(row["model"], row["largest_distance"]) for row in rows if row.get("largest_distance") is not None]
    if not known:
        return "No band of the law is known that formulas could be compared with."
    parts = [f"{model} by {distance:.2g} half-widths of its band" for model, distance in known]
    enough = [model for model, distance in known if distance <= 1.0]
    said = f"{' and '.join(enough)} suffice{'s' if len(enough) == 1 else ''}" if enough else "None suffices"
    return f"{said}: at most, formulas part from the law {', '.join(parts)}."


def _meaning(model: str) -> str:
    law = LAWS.get(model.removesuffix("+delay"))
    return law.meaning if law else "the resolved contact"
