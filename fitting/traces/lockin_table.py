"""From readings of traces to an amplitude table that the fitter reads."""

from collections.abc import Sequence

import numpy as np

from fitting.table import AmplitudeTable
from fitting.tables.csv_text import TableError
from fitting.traces.lockin_result import LockinResult

_SHARED = ("free_frequency_khz", "quality_factor", "quality_factor_error", "mass_ng")


def table_of(results: Sequence[LockinResult]) -> AmplitudeTable:
    """Return the table of the steady readings, a row each, in the order of drive frequency within each order.

    The phase is left out where its reference was taken for granted.

    Args:
        results: of traces of one cantilever; those that are not steady are left out.

    Raises:
        TableError: if none is steady, drive amplitude, offset or free frequency of one is not known, the cantilevers
            differ, or two traces have the same order, drive and offset.
    """
    steady = [result for result in results if result.steady]
    if not steady:
        raise TableError("amplitudes.csv: no trace is a steady single-impact orbit, so there is no row")
    for result in steady:
        _check_known(result)
    shared = _cantilever(steady)
    steady.sort(key=lambda result: (result.order or 0, result.trace.drive_frequency_khz))
    _check_no_repetition(steady)
    phases = np.array([_or_nan(r.phase_deg if r.phase_reference != "time zero" else None) for r in steady])
    known = np.isfinite(phases)
    errors = np.where(known, [_or_nan(r.phase_error_deg) for r in steady], np.nan)
    return AmplitudeTable(
        order=np.array([r.order or 0 for r in steady], dtype=np.int64),
        drive_frequency_khz=np.array([r.trace.drive_frequency_khz for r in steady]),
        drive_amplitude_nm=np.array([_or_nan(r.drive_amplitude_nm) for r in steady]),
        offset_nm=np.array([_or_nan(r.offset_nm) for r in steady]),
        peak_amplitude_nm=np.array([_or_nan(r.peak_amplitude_nm) for r in steady]),
        peak_amplitude_error_nm=np.array([_or_nan(r.peak_amplitude_error_nm) for r in steady]),
        lockin_amplitude_nm=np.array([_or_nan(r.lockin_amplitude_nm) for r in steady]),
        lockin_amplitude_error_nm=np.array([_or_nan(r.lockin_amplitude_error_nm) for r in steady]),
        phase_deg=phases if known.any() else None,
        phase_error_deg=errors if known.any() else None,
        free_frequency_khz=_or_nan(shared["free_frequency_khz"]),
        quality_factor=shared["quality_factor"],
        quality_factor_error=shared["quality_factor_error"],
        mass_ng=1.0 if shared["mass_ng"] is None else shared["mass_ng"],
        source="amplitudes.csv",
        remarks=("read from time traces by afm-jax lockin",),
    )


def _or_nan(value: float | None) -> float:
    return float("nan") if value is None else float(value)


def _check_known(result: LockinResult) -> None:
    values = {"drive_amplitude_nm": result.drive_amplitude_nm, "offset_nm": result.offset_nm}
    for name, value in values.items():
        if value is None:
            mend = f"give --{name.replace('_', '-')} or a comment '# {name} = 1'"
            raise TableError(
                f"{result.trace.source}: {name} is not known, so that it cannot enter the amplitude table; {mend}"
            )


def _check_no_repetition(steady: Sequence[LockinResult]) -> None:
    first: dict[tuple[float | None, ...], str] = {}
    for result in steady:
        frequency = round(result.trace.drive_frequency_khz, 9)
        drive = (result.order, frequency, result.drive_amplitude_nm, result.offset_nm)
        other = first.setdefault(drive, result.trace.source)
        if other != result.trace.source:
            raise TableError(
                f"{result.trace.source}: repeats the drive of {other} (same order, frequency, amplitude and offset), "
                "and a table has one row for each; leave one of the two out"
            )


def _cantilever(steady: Sequence[LockinResult]) -> dict[str, float | None]:
    """Return what all traces say of the cantilever."""
    first, shared = steady[0].trace, {}
    for name in _SHARED:
        shared[name] = getattr(first.settings, name)
        for result in steady[1:]:
            other = getattr(result.trace.settings, name)
            if other != shared[name]:
                raise TableError(
                    f"{result.trace.source}: {name} is {other}, but {shared[name]} in {first.source}; one table holds "
                    "one cantilever: give the option for all, or run them apart"
                )
    if shared["free_frequency_khz"] is None:
        raise TableError(
            f"{first.source}: free_frequency_khz is not known, so that there is no amplitude table; give "
            "--free-frequency-khz or a comment '# free_frequency_khz = 90' (afm-jax calibrate measures it)"
        )
    return shared
