"""`afm-jax fit --each TABLE...`: every table a fit of its own, on all cores; fits that are done are kept."""

import math
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from afm_jax.cli.command import Output
from afm_jax.cli.session import Session
from afm_jax.cli.sweep import run_sweep
from afm_jax.columns import columns_of
from afm_jax.sweeps.plan import plan_of
from afm_jax.sweeps.store import STORE
from afm_jax.words import text_table, with_error
from fitting.bulk import table_input
from fitting.tables.table import AmplitudeTable


def fit_each(
    session: Session, tables: Sequence[AmplitudeTable], record: Mapping[str, Any], workers: int | None
) -> Output:
    """Fit every table by itself and return what was found.

    Args:
        session: the call.
        tables: with their errors.
        record: model and settings of the fits.
        workers: processes; None: one a core.
    """
    plan = plan_of(table_input(tables, record))
    with tempfile.TemporaryDirectory() as scratch:
        where = session if session.out is not None else replace(session, out=Path(scratch))
        done = run_sweep(where, plan, workers=workers, scheduler=None)
        rows = _rows(tables, [variable.name for variable in plan.recorder.variables], where.out)
    told = ("table", "outcome", "valid", "message", "chi2", "degrees_of_freedom", "parameters")
    fits = [{name: row[name] for name in told} for row in rows]
    payload = {"model": record["model"], "fits": fits, "seconds": done.seconds, "fits_kept": len(done.kept.done)}
    why = [f"{row['table']}: {row['message']}" for row in rows if row["message"]]
    bad = sum(not row["valid"] for row in rows)
    columns = [name for name in rows[0] if name not in ("parameters", "valid")]
    return Output(
        payload=payload,
        text=["\n".join(_table(rows)), *why],
        tables={"fits.csv": columns_of(rows, columns)},
        not_valid=f"{bad} of {len(rows)} fits are not valid" if bad else None,
    )


def _rows(tables: Sequence[AmplitudeTable], variables: Sequence[str], folder: Path | None) -> list[dict[str, Any]]:
    """Return a row a table: each number by its column, and the parameters as `afm-jax fit` has them."""
    import xarray  # noqa: PLC0415 (an extra package, which --each alone needs)

    with xarray.open_zarr(f"{folder}/{STORE}") as store:
        results = store.load()
    codes = results["outcome"].attrs
    words = dict(zip(codes["flag_values"], codes["flag_meanings"].split(), strict=True))
    names = [name.removesuffix("_error") for name in variables if name.endswith("_error")]
    rows = []
    for number, table in enumerate(tables):
        numbers = {name: results[name].values[number].item() for name in variables if name != "message"}
        outcome = words[numbers.pop("outcome")]
        parameters = {name: _parameter(name, numbers) for name in names}
        told = {"table": table.source, "outcome": outcome, "valid": outcome == "valid"}
        why = str(results["message"].values[number])
        rows.append(told | numbers | {"message": why, "parameters": parameters})
    return rows


def _parameter(name: str, numbers: Mapping[str, float]) -> dict[str, Any]:
    return {
        "value": numbers[name],
        "standard_error": numbers[f"{name}_error"],
        "interval95": [numbers[f"{name}_low"], numbers[f"{name}_high"]],
    }


def _table(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    names = list(rows[0]["parameters"])
    cells = []
    for row in rows:
        pairs = ((each["value"], each["standard_error"]) for each in (row["parameters"][name] for name in names))
        values = [with_error(*(None if math.isnan(number) else number for number in pair)) for pair in pairs]
        chi2 = "-" if math.isnan(row["chi2"]) else f"{row['chi2']:.1f}/{row['degrees_of_freedom']}"
        cells.append([row["table"], *values, chi2, row["outcome"].replace("_", " ")])
    return text_table(["table", *names, "chi2/dof", ""], cells, words=(0, len(names) + 2))
