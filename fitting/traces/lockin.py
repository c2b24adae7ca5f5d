"""From a time trace to response order, peak and lock-in amplitude and phase, with errors and a verdict.

Readings of several traces make an amplitude table that the fitter reads.
"""

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from afm_jax.checks import checked
from afm_jax.results import Result, public_result
from afm_jax.units import within_turn
from fitting.tables.csv_text import TableError
from fitting.tables.table import AmplitudeTable
from fitting.traces.fold import Fold, OrderSearch, Reference, find_order, find_reference, fold, sampling_error_nm
from fitting.traces.impacts import (
    ImpactCount,
    Peak,
    Steadiness,
    count_impacts,
    find_peak,
    find_ringing,
    look_at_periods,
)
from fitting.traces.trace import Trace, read_trace
from fitting.traces.verdict import Lines, TraceEvidence, TraceKind, judge_trace

FORMAT_VERSION = 1
"""Version of the JSON layout; raised when a key changes its meaning or goes."""


@public_result(picture="fitting.traces.report:lockin_figure")
@dataclass(frozen=True, eq=False, kw_only=True)
class LockinResult(Result):
    """Order, amplitudes and phase that `lockin` reads of one trace; attributes are named like the keys of its JSON.

    All errors are standard errors.

    Attributes:
        steady: whether it is a steady orbit with one impact in a response period.
        kind: what kind of motion the trace shows, a `TraceKind`.
        verdict: the kind of motion in a sentence.
        order: N, drive periods in a response period; None where nothing repeats.
        impacts_per_period: m; None where it is not known.
        peak_amplitude_nm: largest height above the rest position; None where nothing repeats.
        peak_amplitude_error_nm: from noise and sampling.
        lockin_amplitude_nm: 2/T |integral of z exp(-i omega t/N)| over whole response periods.
        lockin_amplitude_error_nm: from noise and sampling.
        phase_deg: phi in z ~ a cos(omega t/N + phi), modulo 360/N, t = 0 when the platform is highest.
        phase_error_deg: from the noise of deflection and reference.
        drive_lockin_amplitude_nm: 2/T |integral of z exp(-i omega t)|, what every lock-in reads at the drive's
            frequency, of a motion that does not repeat too; None where too few phases are sampled.
        drive_lockin_amplitude_error_nm: from noise and sampling.
        drive_lockin_phase_deg: phi in z ~ a cos(omega t + phi), t = 0 when the platform is highest.
        drive_lockin_phase_error_deg: from the noise of deflection and reference.
        phase_reference: "column", "drive_phase_deg" or "time zero" (taken as when the platform is highest).
        noise_nm: standard deviation of one sample.
        sampling_error_nm: part of the lock-in amplitude's error that more samples per period would remove.
        scatter: how much response periods differ beyond noise, of the deflection's standard deviation.
        response_periods: how many response periods were evaluated.
        free_frequency_khz: given, or read off the bending at the top.
        free_frequency_origin: "given" or "trace".
        drive_amplitude_nm: given, or the platform column's; None where not known.
        offset_nm: given, or the platform column's; None where not known.
        warnings: what a reader should know besides.
        trace: what was read.
        folded: the last whole response periods, folded onto one.
        search: what the search for the order found.
    """

    steady: bool
    kind: TraceKind
    verdict: str
    order: int | None
    impacts_per_period: int | None
    peak_amplitude_nm: float | None
    peak_amplitude_error_nm: float | None
    lockin_amplitude_nm: float | None
    lockin_amplitude_error_nm: float | None
    phase_deg: float | None
    phase_error_deg: float | None
    drive_lockin_amplitude_nm: float | None
    drive_lockin_amplitude_error_nm: float | None
    drive_lockin_phase_deg: float | None
    drive_lockin_phase_error_deg: float | None
    phase_reference: str
    noise_nm: float
    sampling_error_nm: float
    scatter: float
    response_periods: int
    free_frequency_khz: float | None
    free_frequency_origin: str | None
    drive_amplitude_nm: float | None
    offset_nm: float | None
    warnings: list[str]
    trace: Trace
    folded: Fold
    search: OrderSearch

    def to_dict(self) -> dict[str, Any]:
        """Return everything but the samples as plain lists, numbers and strings; what is not known is None."""
        trace, settings = self.trace, self.trace.settings
        own = {name: value for name, value in vars(self).items() if name not in {"trace", "folded", "search"}}
        own |= {
            "kind": str(self.kind),
            "drive_frequency_khz": trace.drive_frequency_khz,
            "quality_factor": settings.quality_factor,
            "samples": trace.samples,
            "sampling_rate_mhz": 1.0 / trace.step_us,
            "drive_periods": trace.drive_periods,
            "prediction_misfit_nm": self.search.misfit_nm.tolist(),
            "remarks": list(trace.remarks),
        }
        plain = {name: None if isinstance(v, float) and not math.isfinite(v) else v for name, v in own.items()}
        return {"source": trace.source} | plain


_UNREPEATED = (TraceKind.NOT_PERIODIC, TraceKind.NO_RESPONSE, TraceKind.RINGING)
_UNCOUNTED = (*_UNREPEATED, TraceKind.DRIFTING)
_OTHER_FREQUENCY = 0.1
"""Share by which the bending at the top may contradict the given free frequency."""
_ENOUGH_PERIODS = 4
_ROUNDING = 1e-9
"""Of an amplitude: smallest error, as a fit divides by it."""


@checked
def lockin(trace: Trace | str | os.PathLike[str], *, order: int | None = None) -> LockinResult:
    """Read response order, amplitudes and phase of a trace, and say whether it is a steady single-impact orbit.

    The order is the smallest N at which one half of the response periods predicts the other. Folded onto one response
    period, the samples give the lock-in value by least squares with all harmonics that they determine, the peak by a
    polynomial around the top, and the impacts as jumps of the velocity between free flights. Errors are those of the
    scatter between response periods (white noise where there are fewer than twelve).

    Args:
        trace: the samples; they should begin after the transient.
        order: the order that is expected; another one is flagged. None takes whichever is found.

    Raises:
        TableError: if the trace is shorter than two response periods of the expected order, or the reference column
            does not hold the drive frequency.
    """
    if not isinstance(trace, Trace):
        trace = read_trace(Path(os.fspath(trace)))
    if order is not None:
        _check_order(trace, order)
    reference = find_reference(trace)
    search = find_order(trace)
    folded = fold(trace, search.order)
    peak = find_peak(folded)
    frequency, origin = _free_frequency(trace, peak)
    lines = Lines(folded, trace.settings.drive_amplitude_nm)
    impacts = ImpactCount(0, None) if lines.flightless else _impacts(trace, folded, peak, frequency)
    periods = look_at_periods(folded, peak)
    count = 0 if impacts is None else impacts.impacts or 0
    ringing = find_ringing(trace) if periods.excess > 0.0 or periods.lockin_drift > 0.0 else None
    verdict = judge_trace(TraceEvidence(lines, search, periods, impacts, order, ringing))
    readings = _Readings(folded, peak, reference)
    repeats = verdict.kind not in _UNREPEATED
    phase, phase_error = readings.phase()
    # what does not repeat is read over whole periods of the drive
    whole = (folded if repeats else fold(trace, 1)).at_drive()
    at_drive = None if whole is None else _Readings(whole, peak, reference)
    drive_phase = (None, None) if at_drive is None else at_drive.phase()
    return LockinResult(
        steady=verdict.kind is TraceKind.STEADY,
        kind=verdict.kind,
        verdict=verdict.sentence,
        order=search.order if repeats else None,
        impacts_per_period=impacts.impacts if impacts is not None and verdict.kind not in _UNCOUNTED else None,
        peak_amplitude_nm=peak.height_nm if repeats else None,
        peak_amplitude_error_nm=readings.peak_error() if repeats else None,
        lockin_amplitude_nm=abs(folded.lockin) if repeats else None,
        lockin_amplitude_error_nm=readings.lockin_error() if repeats else None,
        phase_deg=phase if repeats else None,
        phase_error_deg=phase_error if repeats else None,
        drive_lockin_amplitude_nm=None if whole is None else abs(whole.lockin),
        drive_lockin_amplitude_error_nm=None if at_drive is None else at_drive.lockin_error(),
        drive_lockin_phase_deg=drive_phase[0],
        drive_lockin_phase_error_deg=drive_phase[1],
        phase_reference=reference.origin,
        noise_nm=folded.noise_nm,
        sampling_error_nm=sampling_error_nm(folded),
        scatter=periods.excess,
        response_periods=folded.cycles,
        free_frequency_khz=frequency,
        free_frequency_origin=origin,
        drive_amplitude_nm=reference.amplitude_nm,
        offset_nm=reference.offset_nm,
        warnings=_warnings(trace, folded, peak, reference, search, periods, count) if repeats else [],
        trace=trace,
        folded=folded,
        search=search,
    )


def _check_order(trace: Trace, order: int) -> None:
    if order < 1:
        raise TableError(f"{trace.source}: the order must be 1, 2, 3, ..., but is {order}")
    if trace.drive_periods < 2.0 * order - 1e-9:
        least = 2.0 * order * trace.drive_period_us
        raise TableError(
            f"{trace.source}: the trace spans {trace.drive_periods:.3g} drive periods, too short for two response "
            f"periods of order {order}; record at least {least:.4g} us"
        )


def _free_frequency(trace: Trace, peak: Peak) -> tuple[float | None, str | None]:
    given = trace.settings.free_frequency_khz
    if given is not None:
        return given, "given"
    return peak.frequency_khz, None if peak.frequency_khz is None else "trace"


def _impacts(trace: Trace, folded: Fold, peak: Peak, frequency: float | None) -> ImpactCount | None:
    """Return the impacts of a motion with flights, None where the free frequency is not known."""
    if frequency is None or peak.height_nm <= 0.0:
        return None
    quality = trace.settings.quality_factor
    quality = None if quality is None or math.isinf(quality) else quality
    return count_impacts(folded, free_frequency_khz=frequency, quality_factor=quality, peak_nm=peak.height_nm)


class _Readings(NamedTuple):
    """Phase and errors of a folded trace."""

    folded: Fold
    peak: Peak
    reference: Reference

    def lockin_error(self) -> float:
        """Return the error of the lock-in amplitude: along its direction in the complex plane, and of the sampling."""
        noise = self._error_along(1.0 + 0.0j)
        return max(float(np.hypot(noise, sampling_error_nm(self.folded))), _ROUNDING * abs(self.folded.lockin))

    def peak_error(self) -> float:
        """Return the error of the peak."""
        error = float(np.hypot(self.peak.error_nm, self.peak.sampling_error_nm))
        return max(error, _ROUNDING * abs(self.peak.height_nm))

    def phase(self) -> tuple[float, float]:
        """Return the phase in [0, 360/N), [0, 360) at the drive's frequency, after the platform's, and its error."""
        value = self.folded.lockin
        order = self.folded.order / self.folded.waveform.line
        phase = np.degrees(np.angle(value)) - self.reference.phase_deg / order
        across = float(np.hypot(self._error_along(1j), sampling_error_nm(self.folded))) / max(abs(value), 1e-300)
        error = float(np.hypot(np.degrees(across), self.reference.phase_error_deg / order))
        return float(within_turn(phase, 360.0 / order)), max(min(error, 180.0), _ROUNDING)

    def _error_along(self, turned: complex) -> float:
        """Return the error of the lock-in value along its own direction, turned by a unit complex number."""
        value = self.folded.lockin
        direction = np.conj(turned * value / max(abs(value), 1e-300))
        weights = 2.0 * self.folded.waveform.weights(self.folded.angle)
        return self.folded.error_of((weights * direction).real)


def _warnings(
    trace: Trace,
    folded: Fold,
    peak: Peak,
    reference: Reference,
    search: OrderSearch,
    periods: Steadiness,
    impacts: int,
) -> list[str]:
    found = []
    if reference.origin == "time zero":
        found.append("The phase takes time 0 as when the platform is highest: give --drive-phase-deg or a column.")
    share = sampling_error_nm(folded) / max(abs(folded.lockin), 1e-300)
    if share > 1e-3:
        advice = "sample faster, or not in step with the drive"
        found.append(f"Few distinct phases are sampled: the lock-in amplitude may be off by {share:.1%}; {advice}.")
    given, seen = trace.settings.free_frequency_khz, peak.frequency_khz
    if (
        given is not None
        and seen is not None
        and abs(seen / given - 1.0) > _OTHER_FREQUENCY
        and share < 1e-2
        and impacts
    ):
        what = f"The flight bends at its top like one of {seen:.4g} kHz, not {given:g} kHz"
        found.append(f"{what}: wrong rest position (--rest-nm), other free frequency, or a filtered trace.")
    if 2 * search.order > len(search.misfit_nm):
        what = f"The trace spans {trace.drive_periods:.3g} drive periods"
        found.append(f"{what}: too few to see a doubled period of order {2 * search.order}.")
    if folded.cycles < _ENOUGH_PERIODS:
        found.append(f"Only {folded.cycles} response periods: a slow drift would not be seen.")
    if periods.excess > 1e-3:
        found.append(f"Response periods differ by {periods.excess:.2%} of the motion beyond the noise.")
    return found


_SHARED = (
    "free_frequency_khz",
    "quality_factor",
    "quality_factor_error",
    "mass_ng",
    "spring_constant_n_per_m",
    "spring_constant_error_n_per_m",
)


class _Row(NamedTuple):
    """A row of the amplitude table; NaN where something is not known."""

    order: int
    drive_frequency_khz: float
    drive_amplitude_nm: float
    offset_nm: float
    peak_amplitude_nm: float
    peak_amplitude_error_nm: float
    lockin_amplitude_nm: float
    lockin_amplitude_error_nm: float
    phase_deg: float
    phase_error_deg: float


_READ = (("peak_amplitude_nm", "peak_amplitude_error_nm"), ("lockin_amplitude_nm", "lockin_amplitude_error_nm"))
_AGREE = 4.0
"""Standard errors by which readings of one drive may differ from their mean."""


def table_of(results: Sequence[LockinResult]) -> AmplitudeTable:
    """Return the table of the steady readings, a row for each drive, in the order of drive frequency and order.

    The phase is left out where its reference was taken for granted. Several readings of one drive are averaged, with
    the error of the best one, as errors of sampling do not average; where they contradict each other, as on two orbits
    of one drive, all of them are left out. Both is said in the table's remarks.

    Args:
        results: of traces of one cantilever; those that are not steady are left out.

    Raises:
        TableError: if there is no row, drive amplitude, offset or free frequency of one is not known, or the
            cantilevers differ.
    """
    steady = [result for result in results if result.steady]
    if not steady:
        raise TableError("amplitudes.csv: no trace is a steady single-impact orbit, so there is no row")
    for result in steady:
        _check_known(result)
    shared = _cantilever(steady)
    drives: dict[tuple[float, ...], dict[_Row, str]] = {}
    for result in steady:
        row = _row_of(result)
        same = drives.setdefault((row.order, round(row.drive_frequency_khz, 9), *row[2:4]), {})
        # a trace that is given twice is one measurement
        same.setdefault(row, result.trace.source)
    remarks: list[str] = []
    joined = [_joined(same, remarks) for _, same in sorted(drives.items(), key=lambda item: item[0])]
    rows = [row for row in joined if row is not None]
    if not rows:
        raise TableError(f"amplitudes.csv: there is no row: {'; '.join(remarks)}")
    columns: dict[str, Any] = {
        name: np.array(list(column)) for name, column in zip(_Row._fields, np.array(rows, dtype=object).T, strict=True)
    }
    if not np.isfinite(columns["phase_deg"]).any():
        columns |= {"phase_deg": None, "phase_error_deg": None}
    return AmplitudeTable(
        **columns,
        free_frequency_khz=_or_nan(shared["free_frequency_khz"]),
        quality_factor=None if shared["quality_factor"] == math.inf else _or_nan(shared["quality_factor"]),
        quality_factor_error=shared["quality_factor_error"],
        mass_ng=shared["mass_ng"],
        spring_constant_n_per_m=shared["spring_constant_n_per_m"],
        spring_constant_error_n_per_m=shared["spring_constant_error_n_per_m"],
        source="amplitudes.csv",
        remarks=("read from time traces by afm-jax lockin", *remarks),
    )


def _row_of(result: LockinResult) -> _Row:
    read = {name: _or_nan(getattr(result, name)) for names in _READ for name in names}
    phase = result.phase_deg if result.phase_reference != "time zero" else None
    return _Row(
        order=result.order or 0,
        drive_frequency_khz=result.trace.drive_frequency_khz,
        drive_amplitude_nm=_or_nan(result.drive_amplitude_nm),
        offset_nm=_or_nan(result.offset_nm),
        phase_deg=_or_nan(phase),
        phase_error_deg=_or_nan(None if phase is None else result.phase_error_deg),
        **read,
    )


def _joined(same: dict[_Row, str], remarks: list[str]) -> _Row | None:
    """Return the mean of readings of one drive; None where they contradict each other.

    Args:
        same: the rows, and the file of each.
        remarks: takes what is to be said of it.
    """
    first, *others = rows = list(same)
    if not others:
        return first
    means: dict[str, float] = {}
    pulls = [0.0]
    for name, error_name in (*_READ, ("phase_deg", "phase_error_deg")):
        turn = 360.0 / first.order if name == "phase_deg" else np.inf
        known = [row for row in rows if np.isfinite(getattr(row, name))]
        if not known:
            continue
        base = getattr(known[0], name)
        apart = np.array([_wrapped(getattr(row, name) - base, turn) for row in known])
        error = np.array([getattr(row, error_name) for row in known])
        mean = float(np.average(apart, weights=error**-2.0))
        pulls.extend(np.abs(apart - mean) / error)
        means |= {name: float(np.mod(base + mean, turn)), error_name: float(error.min())}
    names = ", ".join(same.values())
    if max(pulls) > _AGREE:
        remarks.append(
            f"{names} are of one drive and contradict each other by {max(pulls):.2g} standard errors: left out"
        )
        return None
    remarks.append(f"{names} are of one drive: one row, their mean")
    return first._replace(**means)


def _wrapped(value: float, turn: float) -> float:
    return value - turn * round(value / turn) if np.isfinite(turn) else value


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
