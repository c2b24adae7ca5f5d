"""`afm-jax fit TABLE.csv`: the impact law from measured vibration amplitudes."""

from functools import partial
from pathlib import Path
from typing import Any

from afm_jax.cli.command import Output
from afm_jax.cli.session import Session
from afm_jax.cli.values import example_path, tables_with
from afm_jax.words import text_table
from fitting.fits.comparison import compare, rivals
from fitting.fits.estimate import Found
from fitting.fits.fit import find_fit, summarise_in_units
from fitting.fits.result import FitResult
from fitting.report.report import summary, write_report
from fitting.sampling.posterior import posterior, require_blackjax
from fitting.tables.several import SeveralTables


def fit(
    session: Session,
    *,
    tables: tuple[Path, ...],
    model: str,
    noise: float | None,
    settings: dict[str, Any],
    **options: Any,
) -> Output:
    """Return the fit of one law to tables, with what was asked for besides."""
    if options["posterior"]:
        require_blackjax()
    read = tables_with(tables or (example_path(),), noise, options["quality_factor"])
    measured = read[0] if len(read) == 1 else SeveralTables(tuple(read))
    first = "the first run compiles for half a minute" if "delay" in model or model == "contact" else "some seconds"
    rows = f"{measured.rows} rows" + (f" of {len(read)} tables" if len(read) > 1 else "")
    with session.working(f"fitting {rows}, model {model} ({first})"):
        found = find_fit(measured, model, **settings)
        result = summarise_in_units(measured, found)
    extras, failure = _extras(session, found, result, settings, options)
    return Output(
        payload=result.to_dict() | {name: extra.to_dict() for name, extra in extras.items()},
        text=[partial(summary, result), *(partial(_words, name, extra) for name, extra in extras.items())],
        report=partial(write_report, result, **extras),
        not_valid=None if result.valid else result.reasons[0],
        failure=failure,
    )


def _extras(
    session: Session, found: Found, result: FitResult, settings: dict[str, Any], options: dict[str, Any]
) -> tuple[dict[str, Any], Exception | None]:
    """Return what was asked for besides the fit, as far as it came, and what ended it: the fit itself stands."""
    extras: dict[str, Any] = {}
    if options["posterior"] and not result.valid:
        session.note("no posterior: the fit is not valid")
    try:
        if options["comparing"]:
            extras["comparison"] = _comparison(session, found, result, settings)
        if options["posterior"] and result.valid:
            with session.working("sampling the posterior"):
                extras["posterior"] = posterior(result, seed=options["seed"])
    except Exception as error:  # noqa: BLE001
        return extras, error
    return extras, None


def _comparison(session: Session, found: Found, result: FitResult, settings: dict[str, Any]) -> Any:
    models = rivals(result.model, settings["fixed"])
    with session.working(f"comparing {', '.join(models)}", "models") as tell:
        return compare(
            result.table,
            models,
            report=lambda model: tell(models.index(model), len(models)),
            known={result.model: (found, result)},
            **settings,
        )


def _words(name: str, extra: Any) -> str:
    """Return a comparison or a posterior as text."""
    if name == "comparison":
        cells = [
            [
                row["model"],
                f"{row['chi2']:.1f}/{row['degrees_of_freedom']}",
                f"{row['aic']:.1f}",
                f"{row['bic']:.1f}",
                f"{100.0 * row['law_change']:.2f} %",
            ]
            for row in extra.rows
        ]
        lines = text_table(["model", "chi2/dof", "AIC", "BIC", "law differs"], cells)
        lines += [f"  {model:<18} failed: {reason}" for model, reason in extra.failed.items()]
        head = "Models, best first (AIC and BIC: of the formula alone, on the rows that all models use):"
        return "\n".join(["", head, *lines, f"  {extra.verdict}"])
    intervals = {key: found["interval95"] for key, found in extra.to_dict()["parameters"].items()}
    head = "95 % credible intervals (posterior, flat priors):"
    lines = text_table(
        ["parameter", "from", "to"], [[key, *(f"{e:.6g}" for e in ends)] for key, ends in intervals.items()]
    )
    return "\n".join(["", head, *lines])
