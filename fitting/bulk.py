"""Many fits at once: every table by itself, as it is, or with other instruments, or with its noise drawn again.

Tables are an axis of a sweep (`afm_jax.sweeps`), which keeps what is done and computes the rest with many processes.
"""

import dataclasses
import math
import os
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from afm_jax.checks import checked, require_float64
from afm_jax.strict_json import plain
from afm_jax.sweeps.axes import Axis
from afm_jax.sweeps.plan import MESSAGE, Columns, Recorder, Variable, plan_of
from afm_jax.sweeps.sweep import Progress, dataset_of
from fitting.fits.fit import fit
from fitting.fits.result import FitResult
from fitting.models import problem_of
from fitting.parameters import PARAMETERS
from fitting.sampling.refit import require_valid
from fitting.tables.table import AMPLITUDES, MEASURED, AmplitudeTable, check_quality_factor, read_table

if TYPE_CHECKING:
    import xarray

TABLE, RESAMPLE = "table", "resample"
_INSTRUMENT = ("free_frequency_khz", "quality_factor", "mass_ng")
_CALIBRATIONS = ("tip_calibration", "drive_calibration")
_USUAL = {"model": "law", "noise": None, "resamples": None, "seed": 0}
_OF_A_FIT = ("scale_errors", "free", "fixed", "constraints", "effects", "robust", "speeds")
_MOST_KEPT = 64
"""Fits from which tables are drawn."""
_FITTED, _NOT_VALID, _REFUSED = 0, 1, -1
_FLAGS = {_REFUSED: "not_possible", _FITTED: "valid", _NOT_VALID: "not_valid"}


@checked
def fit_each(  # noqa: PLR0913
    tables: Sequence[AmplitudeTable | str | os.PathLike[str]],
    model: str = "law",
    *,
    axes: Sequence[Mapping[str, Any]] = (),
    resamples: int | None = None,
    seed: int = 0,
    noise: float | None = None,
    out: str | os.PathLike[str] | None = None,
    workers: int = 1,
    scheduler: str | None = None,
    report: Progress | None = None,
    **settings: Any,
) -> "xarray.Dataset":
    """Return the fits of many tables, each by itself.

    Args:
        tables: from `read_table`, or files.
        model: as of `fit`.
        axes: of further values of each table's instrument, as of `afm_jax.sweep`; their parameters are
            `table.free_frequency_khz`, `table.quality_factor`, `table.mass_ng`, and `table.tip_calibration` and
            `table.drive_calibration`, true amplitudes over those written down.
        resamples: how often every table is fitted with what was measured drawn anew, within its errors, about what its
            own fit, which must be valid, predicts; None: as it is.
        seed: of the draws.
        noise: relative error of amplitudes without one, of files.
        out: folder of the results: fits that are done there are kept; None: nothing is kept on the disk.
        workers: processes, as of `afm_jax.sweep`.
        scheduler: address of a Dask scheduler.
        report: told how far it is.
        settings: of `fit`.

    Returns:
        For every table (and draw, and instrument) each parameter with its error and 95 % interval, chi2 and the
        verdict.

    Raises:
        TableError: if a file is no table.
        ValueError: as `afm_jax.sweep`, or if a setting is none of `fit`'s.
    """
    require_float64()
    record = {"model": model, "resamples": resamples, "seed": seed, "noise": noise, **settings}
    plan = plan_of(table_input(tables, record, axes=axes))
    return dataset_of(plan, out, workers=workers, scheduler=scheduler, report=report)


def table_input(
    tables: Sequence[AmplitudeTable | str | os.PathLike[str]],
    record: Mapping[str, Any],
    *,
    axes: Sequence[Mapping[str, Any]] = (),
    chunk: int | None = None,
) -> dict[str, Any]:
    """Return the input of a sweep over tables, everything in it, so that workers need no files.

    Args:
        tables: from `read_table`, or files.
        record: `what` = "fit" or nothing, `model`, `resamples`, `seed`, `noise` and the settings of `fit`.
        axes: as of `fit_each`.
        chunk: fits that are handed out together.

    Raises:
        TableError: if a file is no table.
        ValueError: if there are other settings.
    """
    given = {name: value for name, value in record.items() if name != "what"}
    if record.get("what", "fit") != "fit":
        raise ValueError(f'[record]: of tables only `what` = "fit" can be recorded, not {record["what"]!r}')
    unknown = sorted(set(given) - {*_USUAL, *_OF_A_FIT})
    if unknown:
        raise ValueError(f"[record]: unknown key {unknown[0]} of 'fit'; it has {', '.join([*_USUAL, *_OF_A_FIT])}")
    given = _USUAL | given
    whole = [
        table if isinstance(table, AmplitudeTable) else read_table(Path(table), noise=given["noise"])
        for table in tables
    ]
    if not any(f"{TABLE}.quality_factor" in str(axis.get("parameter")) for axis in axes):
        for table in whole:
            check_quality_factor(table)
    if not whole:
        raise ValueError("there is no table to fit: give one at least")
    return {
        "builder": "fitting.bulk:table_recorder",
        "tables": [plain(vars(table)) for table in whole],
        "record": {name: value for name, value in given.items() if name != "noise" and value is not None},
        "axes": [_counted(TABLE, len(whole)), *_draws(given["resamples"]), *map(dict, axes)],
        "chunk": chunk,
    }


def _counted(name: str, count: int) -> dict[str, Any]:
    return {"parameter": name, "linear": [0, count - 1, count]}


def _draws(resamples: int | None) -> list[dict[str, Any]]:
    if resamples is not None and (isinstance(resamples, bool) or not isinstance(resamples, int) or resamples < 1):
        raise ValueError(f"`resamples` must be a positive whole number, but is {resamples!r}")
    return [] if resamples is None else [_counted(RESAMPLE, resamples)]


def table_recorder(given: Mapping[str, Any], axes: Sequence[Axis]) -> Recorder:
    """Return what a sweep over tables does: `given` as of `table_input`.

    Raises:
        ValueError: if an axis is none of a table's, or the model has no such parameters.
    """
    tables = [_table_of(table) for table in given["tables"]]
    record = dict(given["record"])
    record.pop("resamples", None)
    model, seed = record.pop("model"), record.pop("seed")
    known = [f"{TABLE}.{name}" for name in (*_INSTRUMENT, *_CALIBRATIONS)]
    for axis in axes:
        for name, (low, _) in axis.ends.items():
            if name not in (TABLE, RESAMPLE, *known):
                raise ValueError(f"{name} cannot be an axis of tables; choose from {', '.join(known)}")
            if name in known and low <= 0.0:
                raise ValueError(f"{name} must be positive, but starts at {low:g}")
    chosen = {name: record[name] for name in ("free", "fixed", "constraints", "effects") if name in record}
    own = problem_of(tables[0], model, **chosen).own

    @lru_cache(maxsize=_MOST_KEPT)
    def fit_of(row: tuple[tuple[str, float], ...]) -> tuple[AmplitudeTable, FitResult]:
        """Return a table with its instrument, and its fit."""
        measured = _with_instrument(tables[int(dict(row)[TABLE])], dict(row))
        return measured, fit(measured, model, **record)

    def fitted(row: dict[str, float]) -> dict[str, Any]:
        number = row.pop(RESAMPLE, None)
        try:
            measured, found = fit_of(tuple(row.items()))
            if number is not None:
                require_valid(found)
                found = fit(_drawn(measured, found, (seed, int(row[TABLE]), int(number))), model, **record)
        except ValueError as error:
            nothing: dict[str, Any] = dict.fromkeys((variable.name for variable in _variables(own)), math.nan)
            return nothing | {"degrees_of_freedom": 0, "outcome": _REFUSED, MESSAGE.name: str(error)}
        return _columns_of(found, own)

    def work(columns: Columns) -> Columns:
        fits = [fitted(dict(zip(columns, row, strict=True))) for row in zip(*columns.values(), strict=True)]
        return {name: [found[name] for found in fits] for name in fits[0]}

    sources = [table.source for table in tables]
    return Recorder(_variables(own), work, points=1, labels={TABLE: {"sources": sources}}, alone=True)


def _variables(own: Sequence[str]) -> tuple[Variable, ...]:
    found = []
    for name in own:
        parameter = PARAMETERS[name]
        parts = {
            name: parameter.meaning,
            f"{name}_error": "standard error (Wald)",
            f"{name}_low": "lower end of the 95 % interval; NaN where it is open",
            f"{name}_high": "upper end of the 95 % interval; NaN where it is open",
        }
        found += [Variable(part, meaning, unit=parameter.unit or "1") for part, meaning in parts.items()]
    return (
        *found,
        Variable("chi2", "sum of squared normalised residuals"),
        Variable("degrees_of_freedom", "amplitudes and constraints minus parameters", "int32"),
        Variable("outcome", "what the fit says of itself", "int8", flags=_FLAGS),
        MESSAGE,
    )


def _table_of(given: Mapping[str, Any]) -> AmplitudeTable:
    """Return a table from what JSON has of it."""

    def array(value: Any) -> Any:
        if not isinstance(value, list) or any(isinstance(each, str) for each in value):
            return value
        return np.array([math.nan if each is None else each for each in value])

    parts: dict[str, Any] = {name: array(value) for name, value in given.items()}
    parts["lines"] = parts["lines"].astype(int)
    parts["calibration"] = {name: tuple(pair) for name, pair in given["calibration"].items()}
    parts["remarks"] = tuple(given["remarks"])
    return AmplitudeTable(**parts)


def _columns_of(found: FitResult, own: Sequence[str]) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for name in own:
        parameter = found.parameters[name]
        numbers = (parameter.value, parameter.standard_error, *parameter.interval95)
        for ending, number in zip(("", "_error", "_low", "_high"), numbers, strict=True):
            values[name + ending] = math.nan if number is None else number
    told = {"chi2": found.chi2, "degrees_of_freedom": found.degrees_of_freedom}
    return values | told | {"outcome": _FITTED if found.valid else _NOT_VALID, MESSAGE.name: " ".join(found.reasons)}


def _with_instrument(table: AmplitudeTable, row: Mapping[str, float]) -> AmplitudeTable:
    """Return a table with other values of its instrument."""
    changed: dict[str, Any] = {name: float(row[f"{TABLE}.{name}"]) for name in _INSTRUMENT if f"{TABLE}.{name}" in row}
    if table.spring_constant_n_per_m is not None and not changed.keys().isdisjoint({"mass_ng", "free_frequency_khz"}):
        # of mass and spring constant the one that is not said anew follows
        other = {"spring_constant_n_per_m": None, "spring_constant_error_n_per_m": None}
        changed = (other if "mass_ng" in changed else {"mass_ng": None}) | changed
    tip, drive = (row.get(f"{TABLE}.{name}", 1.0) for name in _CALIBRATIONS)
    by_tip = [name for column in AMPLITUDES for name in (column.name, str(column.error))]
    scaled = dict.fromkeys((*by_tip, "free_amplitude_nm"), tip)
    for name, factor in (scaled | {"drive_amplitude_nm": drive}).items():
        column = getattr(table, name)
        if column is not None and factor != 1.0:
            changed[name] = factor * column
    return dataclasses.replace(table, **changed)


def _drawn(table: AmplitudeTable, found: FitResult, seed: tuple[int, ...]) -> AmplitudeTable:
    """Return a table as it would have been measured if its fit were the truth, within its errors.

    Drawn about what was measured, which scatters itself, it would scatter twice as much (variances) as its errors say.
    """
    generator = np.random.default_rng(seed)
    rows = found.rows
    predicted: dict[str, Any] = dict(
        zip(("peak_amplitude_nm", "lockin_amplitude_nm"), rows.predicted_nm.T, strict=True)
    )
    changed = {}
    for column in MEASURED:
        values = getattr(table, column.name)
        if values is not None:
            truth = predicted[column.name] if column.amplitude else rows.predicted_phase_deg
            drawn = truth + getattr(table, str(column.error)) * generator.standard_normal(values.shape)
            # an amplitude is positive, and what has no prediction stays as it was measured
            changed[column.name] = np.where(np.isnan(drawn), values, np.abs(drawn) if column.amplitude else drawn)
    return dataclasses.replace(table, **changed)
