"""From a time trace to response order, peak and lock-in amplitude and phase, with errors and a verdict."""

from typing import NamedTuple

import numpy as np

from fitting.traces.lockin_fold import Fold, fold, sampling_error_nm
from fitting.traces.lockin_impacts import ImpactCount, count_impacts
from fitting.traces.lockin_order import OrderSearch, find_order
from fitting.traces.lockin_peak import Peak, find_peak
from fitting.traces.lockin_reference import Reference, find_reference
from fitting.traces.lockin_result import LockinResult
from fitting.traces.lockin_steadiness import Steadiness, look_at_periods
from fitting.traces.lockin_trace import TableError, Trace
from fitting.traces.lockin_verdict import TraceEvidence, TraceKind, is_flightless, judge

_UNREPEATED = (TraceKind.NOT_PERIODIC, TraceKind.NO_RESPONSE)
_UNCOUNTED = (*_UNREPEATED, TraceKind.DRIFTING)
_OTHER_FREQUENCY = 0.1
"""Share by which the bending at the top may contradict the given free frequency."""
_ENOUGH_PERIODS = 4
_ROUNDING = 1e-9
"""Of an amplitude: smallest error, as a fit divides by it."""


def lockin(trace: Trace, *, order: int | None = None) -> LockinResult:
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
    if order is not None:
        _check_order(trace, order)
    reference = find_reference(trace)
    search = find_order(trace)
    folded = fold(trace, search.order)
    peak = find_peak(folded)
    frequency, origin = _free_frequency(trace, peak)
    impacts = _impacts(trace, folded, peak, frequency)
    periods = look_at_periods(folded, peak)
    count = 0 if impacts is None else impacts.impacts or 0
    verdict = judge(TraceEvidence(trace.settings, search, folded, peak, periods, impacts, order))
    readings = _Readings(folded, peak, reference)
    repeats = verdict.kind not in _UNREPEATED
    phase, phase_error = readings.phase()
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
    """Return the impacts; 0 in a motion without flights, None where the free frequency is not known."""
    if is_flightless(folded, trace.settings) is not None:
        return ImpactCount(0, (), None)
    if frequency is None or peak.height_nm <= 0.0:
        return None
    quality = trace.settings.quality_factor
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
        """Return the phase in [0, 360/N) relative to the platform, and its error, in degrees."""
        order, value = self.folded.order, self.folded.lockin
        phase = np.degrees(np.angle(value)) - self.reference.phase_deg / order
        across = float(np.hypot(self._error_along(1j), sampling_error_nm(self.folded))) / max(abs(value), 1e-300)
        error = float(np.hypot(np.degrees(across), self.reference.phase_error_deg / order))
        return float(np.mod(phase, 360.0 / order)), max(min(error, 180.0), _ROUNDING)

    def _error_along(self, turned: complex) -> float:
        """Return the error of the lock-in value along its own direction, turned by a unit complex number."""
        value = self.folded.lockin
        direction = np.conj(turned * value / max(abs(value), 1e-300))
        weights = 2.0 * self.folded.waveform.first_weights(self.folded.angle)
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
