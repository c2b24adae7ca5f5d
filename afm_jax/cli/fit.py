"""`afm-jax fit TABLE.csv`: the impact law from measured vibration amplitudes."""

from functools import partial
from pathlib import Path
from typing import Any

from afm_jax.cli.command import Output
from afm_jax.cli.session import Session
from afm_jax.cli.values import example_path, tables_with
from fitting.infer.comparison import compare, rivals
from fitting.infer.fit import fit as fit_tables
from fitting.infer.result import FitResult
from fitting.report.report import summary, write_report
from fitting.sampling.posterior import posterior, require_blackjax, sampled_by_gaussian
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
    if options["posterior"] and not sampled_by_gaussian(model):
        require_blackjax()
    read = tables_with(tables or (example_path(),), noise, options["quality_factor"])
    measured = read[0] if len(read) == 1 else SeveralTables(tuple(read))
    first = "the first run compiles for ten seconds" if "delay" in model or model == "contact" else "some seconds"
    rows = f"{measured.rows} rows" + (f" of {len(read)} tables" if len(read) > 1 else "")
    with session.working(f"fitting {rows}, model {model} ({first})"):
        result = fit_tables(measured, model, **settings)
    extras, failure = _extras(session, result, settings, options)
    return Output(
        payload=result.to_dict() | {name: extra.to_dict() for name, extra in extras.items()},
        text=[partial(summary, result, **extras)],
        report=partial(write_report, result, **extras),
        not_valid=None if result.valid else result.reasons[0],
        failure=failure,
    )


def _extras(
    session: Session, result: FitResult, settings: dict[str, Any], options: dict[str, Any]
) -> tuple[dict[str, Any], Exception | None]:
    """Return what was asked for besides the fit, as far as it came, and what ended it: the fit itself stands."""
    extras: dict[str, Any] = {}
    if options["posterior"] and not result.valid:
        session.note("no posterior: the fit is not valid")
    try:
        if options["comparing"]:
            models = rivals(result.model, settings["fixed"])
            with session.working(f"comparing {', '.join(models)}"):
                known = {result.model: result}
                extras["comparison"] = compare(result.table, models, known=known, **settings)
        if options["posterior"] and result.valid:
            with session.working("sampling the posterior"):
                extras["posterior"] = posterior(result, seed=options["seed"])
    except Exception as error:  # noqa: BLE001
        return extras, error
    return extras, None
