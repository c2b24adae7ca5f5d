"""Models compared on the same table, and in plain words what the measurement can tell.

Instantaneous laws are compared by their information criterion (AIC). Where impacts last one fit finds the law, whatever
the formula: how far each formula stays from that law, in terms of its band, says which formula suffices.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from afm_jax.checks import checked, in_float64
from afm_jax.results import Result, public_result
from afm_jax.saved import as_json
from fitting.infer.fit import fit, tables_of
from fitting.infer.law import closest_loss, rebound_by_formula
from fitting.infer.result import FitResult
from fitting.parameters import CONTACT_NAMES, LAW, LAWS, MODELS, NUISANCE_NAMES, PARAMETERS, model_parameters
from fitting.tables.several import SeveralTables
from fitting.tables.table import TableLike

_EVEN, _PLAIN = 2.0, 10.0
"""Differences of AIC up to which models are even, and beyond which one is clearly favoured."""


@public_result(picture="fitting.report.plots:models_figure", home="fitting.report.report")
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
    """

    rows: list[dict[str, Any]]
    verdict: str
    results: dict[str, FitResult]


@as_json.register
def _(result: Comparison) -> dict[str, Any]:
    return {"rows": result.rows, "verdict": result.verdict}


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
@in_float64
def compare(
    table: TableLike | SeveralTables | Sequence[TableLike],
    models: Sequence[str] = ("law+delay", "viscous+delay"),
    *,
    known: Mapping[str, FitResult] | None = None,
    **options: Any,
) -> Comparison:
    """Compare several models on one table.

    Args:
        table: the amplitudes, of one table or of several.
        models: names of models.
        known: fits of models to the table with the same options.
        options: as of `fit`; `free`, `fixed` and constraints go to models that have such parameters, `effects` to
            "contact".

    Raises:
        ValueError: if fewer than two different models are named, or one of them there is not; as `fit`, if a model
            cannot be fitted.
    """
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
    for model in dict.fromkeys(models):
        if known and model in known:
            results[model] = known[model]
        elif model == formula or not model.endswith("+delay"):
            results[model] = fit(whole, model, **_options_of(model, options))
    lasting = [model for model in dict.fromkeys(models) if model.endswith("+delay") or model == "contact"]
    rows = _by_information({m: r for m, r in results.items() if m not in lasting})
    if lasting:
        rows = [*_by_distance(results[formula or "contact"], lasting, results, options), *rows]
    return Comparison(rows, _verdict(rows), results)


def _by_information(results: Mapping[str, FitResult]) -> list[dict[str, Any]]:
    """Return instantaneous models by their AIC."""
    least = min((result.aic for result in results.values()), default=0.0)
    rows = [_row(m, result) | {"aic": result.aic, "delta_aic": result.aic - least} for m, result in results.items()]
    return sorted(rows, key=lambda row: row["aic"])


def _by_distance(
    of_law: FitResult, models: Sequence[str], results: Mapping[str, FitResult], options: dict[str, Any]
) -> list[dict[str, Any]]:
    """Return models whose impacts last by their distance from the law."""
    law, reached = of_law.law, of_law.rows.reached_nm_per_us
    half = law.rebound_high_nm_per_us - law.rebound_speed_nm_per_us
    inside = (law.rebound_speed_nm_per_us > 0.0) & (half > 0.0) & np.isfinite(half)
    inside &= law.approach_speed_nm_per_us >= reached.min(initial=np.inf)
    inside &= law.approach_speed_nm_per_us <= reached.max(initial=0.0)
    speeds, rebound, half = (x[inside] for x in (law.approach_speed_nm_per_us, law.rebound_speed_nm_per_us, half))
    rows = []
    for model in models:
        row = _row(model, results.get(model, of_law)) | {"largest_distance": None, "largest_relative_distance": None}
        rows.append(row)
        if not speeds.size:
            continue
        if model == "contact":
            other = results[model].law
            by_model = np.interp(speeds, other.approach_speed_nm_per_us, other.rebound_speed_nm_per_us)
        else:
            fixed = _options_of(model, options).get("fixed") or {}
            names = [known.name for known in LAW if known.name in MODELS[model] and known.name not in fixed]
            found = closest_loss(names, speeds, rebound, 1.0 / half, fixed)
            by_model = rebound_by_formula(fixed | found, speeds)
        row["largest_distance"] = float(np.max(np.abs(by_model - rebound) / half))
        row["largest_relative_distance"] = float(np.max(np.abs(by_model - rebound) / rebound))
    return sorted(rows, key=lambda row: row["largest_distance"] or 0.0)


def _row(model: str, result: FitResult) -> dict[str, Any]:
    names = ("chi2", "degrees_of_freedom", "valid")
    return {"model": model} | {name: getattr(result, name) for name in names}


def _options_of(model: str, options: dict[str, Any]) -> dict[str, Any]:
    """Return what of the options is about a model: another one has other parameters."""
    names = CONTACT_NAMES if model == "contact" else MODELS.get(model, ())
    chosen = {name: value for name, value in options.items() if name != "effects" or model == "contact"}
    others = PARAMETERS.keys() - {*names, *NUISANCE_NAMES}
    for option in ("fixed", "constraints"):
        if chosen.get(option):
            chosen[option] = {name: value for name, value in chosen[option].items() if name not in others}
    if any(name not in names for name in chosen.get("free") or ()):
        del chosen["free"]
    return chosen


def _verdict(rows: list[dict[str, Any]]) -> str:
    """Return by what the models differ, and whether the best one explains the data."""
    first, *others = (f"{row['model']}: {_meaning(row['model'])}" for row in rows)
    said = _sufficient(rows)
    if "delta_aic" in rows[1] and "delta_aic" in rows[0]:
        gap = rows[1]["delta_aic"]
        said = f"The measurement decides for {first} against {others[0]} (AIC lower by {gap:.0f})."
        if gap < _PLAIN:
            said = f"The measurement favours {first} over {others[0]} (AIC lower by {gap:.1f}), not conclusively."
        if gap < _EVEN:
            said = f"The measurement does not distinguish {first} from {others[0]} (AIC differs by {gap:.1f})."
    if not rows[0]["valid"]:
        said += f" But the fit of {rows[0]['model']} is not valid itself."
    return said


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
