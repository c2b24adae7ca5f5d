"""Free resonance calibration: natural frequency and quality factor of a cantilever from a sweep."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.ndimage import median_filter, uniform_filter1d
from scipy.special import digamma

from afm_jax.checks import checked, require_float64
from afm_jax.least_squares import IMPROBABLE, chi2_tail
from afm_jax.version import version_of
from fitting.calibration.model import TERMS, SweepFit, fit_sweep, kind_of, model_at, refit, sum_without_resonance
from fitting.calibration.result import Alternative, CalibratedValue, Calibration, Curves
from fitting.calibration.sweep import ResonanceSweep, read_sweep
from fitting.calibration.verdict import (
    SweepEvidence,
    autocorrelation,
    inflation_of,
    judge_calibration,
    preferred,
    repeat_of,
    runs_excess,
)
from fitting.fits.intervals import Interval, profile_intervals
from fitting.tables.csv_text import TableError

_PACKAGES = ("afm-jax", "jax", "optax", "numpy")


@checked
def calibrate(
    sweep: ResonanceSweep | str | os.PathLike[str],
    *,
    background: str | None = None,
    noise: float | None = None,
    scale_errors: bool = False,
    compare: bool = True,
    whole: bool = False,
) -> Calibration:
    """Fit frequency and quality factor of the free cantilever to a resonance sweep.

    The frequency is the undamped natural one, Omega/2 pi of m z'' + (m Omega/Q) z' + k z = F cos(omega t); a base
    that moves by d cos(omega t) is the force F = k d. The amplitude is largest a little lower, at
    f0 sqrt(1 - 1/2Q^2), and a background moves the measured maximum further.

    Args:
        sweep: from `read_sweep`; its phase is used where it is there.
        background: what is added to the response. With phase: "none", "constant" or "linear" (both complex). Amplitude
            only: "none", "floor" (in quadrature) or "constant" (in quadrature and interfering). None: constant, or the
            one that Akaike's criterion prefers clearly (if the others are compared).
        noise: standard error of every point as a share of the largest amplitude, for a sweep without errors of its own.
            Without either the errors are estimated from the misfit, and goodness of fit cannot be judged.
        scale_errors: scale given errors such that chi2 equals its degrees of freedom.
        compare: fit the other backgrounds too, for comparison.
        whole: fit all of a thermal spectrum, not the part around its resonance that the model explains.

    Returns:
        Values, errors, intervals, goodness of fit and a verdict; see `Calibration`.

    Raises:
        ValueError: if an option is impossible.
        TableError: if the sweep has too few points for the model, or its amplitude is the same everywhere.
        RuntimeError: if JAX is not set to 64-bit floats.
    """
    if not isinstance(sweep, ResonanceSweep):
        sweep = read_sweep(Path(os.fspath(sweep)))
    require_float64()
    kind = kind_of(sweep)
    first = ("floor" if sweep.spectrum else "constant") if background is None else background
    _check_options(kind, first, noise)
    _check_sweep(sweep, kind, first)
    settings = {"scale_errors": scale_errors, "compare": compare}
    windows = _windows(sweep) if sweep.spectrum and not whole else [sweep]
    result = _calibrated_sweep(windows[0], first, background, noise, **settings)
    for window in windows[1:]:
        if result.explained:
            break
        ends = f"{window.frequency_khz[0]:.6g} to {window.frequency_khz[-1]:.6g} kHz"
        note = f"Fitted from {ends}: further out the spectrum is not that of one resonance and white noise."
        result = _calibrated_sweep(window, first, background, noise, **settings)
        result = replace(result, warnings=[*result.warnings, note])
    return result


_HALF_WIDTHS = (20.0, 10.0, 5.0)
"""Of a thermal spectrum so much is fitted on both sides of the resonance: as much as the model explains."""
_WIDEST_LINE = 7
"""Points over which the median is taken: what stands out over three of them at most, it does not see."""
_SURROUNDINGS = (10, 4, 1)
"""Parts of a spectrum that show how far a peak stands out."""


def _windows(sweep: ResonanceSweep) -> list[ResonanceSweep]:
    """Return parts of a spectrum around the peak that stands out most of its surroundings, the widest first.

    Lines of a few points (mains, a clock) are no resonance, whose half-width holds at least three.
    """
    power = sweep.amplitude**2
    smooth = uniform_filter1d(median_filter(power, _WIDEST_LINE, mode="nearest"), 5, mode="nearest")
    top, floor = _standing_out(smooth)
    # few averages scatter: a wide peak is measured on a curve that is smoothed more
    widths = [(size, _points_above_half(uniform_filter1d(power, size), top, float(floor[top]))) for size in (5, 21, 85)]
    wide = max(width for size, width in widths if size == 5 or width > 2 * size)
    step = np.ptp(sweep.frequency_khz) / (sweep.points - 1)
    half, centre = max(0.5 * wide, 3.0) * step, float(sweep.frequency_khz[top])
    return [sweep.within(centre - times * half, centre + times * half) for times in _HALF_WIDTHS]


def _standing_out(smooth: Float[np.ndarray, " n"]) -> tuple[int, Float[np.ndarray, " n"]]:
    """Return where a curve stands out most of its surroundings, and these."""
    top, floor = 0, smooth
    for part in _SURROUNDINGS:
        reach = max(smooth.size // part, _WIDEST_LINE)
        floor = median_filter(smooth, reach, mode="nearest")
        top = int(np.argmax(smooth / floor))
        # surroundings that the peak itself fills do not show it
        if 2 * _points_above_half(smooth, top, float(floor[top])) < reach:
            break
    return top, floor


def _points_above_half(smooth: Float[np.ndarray, " n"], top: int, floor: float) -> int:
    """Return how many points around the top of a curve lie above half of it."""
    low = smooth < 0.5 * (smooth[top] + floor)
    left, right = np.flatnonzero(low[:top]), np.flatnonzero(low[top:])
    return (int(right[0]) if right.size else 1) + (top - int(left[-1]) if left.size else 1)


def _calibrated_sweep(
    sweep: ResonanceSweep,
    first: str,
    background: str | None,
    noise: float | None,
    *,
    scale_errors: bool,
    compare: bool,
) -> Calibration:
    fit = fit_sweep(sweep, first, noise, scale_errors=scale_errors)
    alternatives = _alternatives(sweep, fit, first) if compare else []
    chosen = first if background is not None else preferred(fit, first, alternatives)
    if chosen != first:
        fit = fit_sweep(sweep, chosen, noise, scale_errors=scale_errors)
        alternatives = _alternatives(sweep, fit, chosen)
    return _summary(sweep, fit, chosen, alternatives)


def _alternatives(sweep: ResonanceSweep, fit: SweepFit, background: str) -> list[Alternative]:
    """Return fits of a frequency scan, errors unchanged, in front of all other backgrounds that it has points for."""
    kind = fit.objective.kind
    others = [name for name in TERMS[kind] if name != background and _enough_points(sweep, kind, name)]
    return [_alternative(refit(fit, sweep, name), name) for name in others]


def _check_options(kind: str, background: str, noise: float | None) -> None:
    if background not in TERMS[kind]:
        what = "with" if kind == "phase" else "without"
        raise ValueError(f"the background of a sweep {what} phase is {', '.join(TERMS[kind])}, but not {background!r}")
    if noise is not None and not 0.0 < noise < 1.0:
        raise ValueError(f"the relative noise must be between 0 and 1, but is {noise!r}; write 0.01 for 1 %")


def _enough_points(sweep: ResonanceSweep, kind: str, background: str) -> bool:
    """Say whether a sweep has more numbers than the model has parameters, at enough frequencies."""
    parameters = TERMS[kind][background] + 2
    # A frequency gives one number or, with phase, two; one frequency more than needed leaves something to judge by.
    needed = parameters // 2 + 1 if kind == "phase" else parameters + 1
    return len(np.unique(sweep.frequency_khz)) >= needed


def _check_sweep(sweep: ResonanceSweep, kind: str, background: str) -> None:
    if not _enough_points(sweep, kind, background):
        raise TableError(
            f"{sweep.source}: {len(np.unique(sweep.frequency_khz))} frequencies are too few for the "
            f"{TERMS[kind][background] + 2} parameters of the background '{background}'; measure at more"
        )
    turning = sweep.phase_deg is not None and np.ptp(sweep.phase_deg) > 0.0 and sweep.amplitude[0] > 0.0
    if np.ptp(sweep.amplitude) == 0.0 and not turning:
        value = f"{sweep.amplitude[0]:g} {sweep.amplitude_unit}".strip()
        raise TableError(f"{sweep.source}: the amplitude is {value} at every frequency; sweep across a resonance")


def _alternative(fit: SweepFit, background: str) -> Alternative:
    variance = float(fit.covariance[1, 1])
    return Alternative(
        background=background,
        frequency_khz=float(fit.values[0]),
        quality_factor=float(fit.values[1]),
        quality_factor_error=float(np.sqrt(variance)) if np.isfinite(variance) else None,
        chi2=fit.chi2,
        degrees_of_freedom=fit.freedom,
        aic=fit.aic,
        residual_autocorrelation=autocorrelation(fit, 1),
    )


def _evidence(sweep: ResonanceSweep, fit: SweepFit, curves: Curves, alternatives: list[Alternative]) -> SweepEvidence:
    """Return all that the verdict looks at."""
    judged = fit.errors.origin != "estimated" and fit.errors.scale is None
    # the mean of a term of the gamma deviance is a little above 1
    size = 2.0 * sweep.averages * (np.log(sweep.averages) - digamma(sweep.averages)) if sweep.averages else 1.0
    p_value = chi2_tail(fit.chi2 / size, fit.freedom) if judged else float("nan")
    frequency, quality_factor = _calibrated(fit, explained=not p_value < IMPROBABLE)
    return SweepEvidence(
        sweep=sweep,
        fit=fit,
        frequency=frequency,
        quality_factor=quality_factor,
        p_value=p_value,
        autocorrelation=autocorrelation(fit, 1),
        repeat=repeat_of(fit),
        runs_excess=runs_excess(fit, curves.amplitude_misfit),
        chi2_without=sum_without_resonance(fit.objective.points, sweep.points, fit.objective.kind),
        alternatives=alternatives,
    )


def _summary(sweep: ResonanceSweep, fit: SweepFit, background: str, alternatives: list[Alternative]) -> Calibration:
    kind, curves = fit.objective.kind, _curves(sweep, fit)
    evidence = _evidence(sweep, fit, curves, alternatives)
    reasons, warnings = judge_calibration(evidence)
    errors = np.sqrt(np.diag(fit.covariance)[:2])
    known = evidence.frequency.standard_error is not None
    linear = fit.values[2:]
    height = np.hypot(linear[0], linear[1]) if kind == "phase" else np.sqrt(max(linear[0], 0.0))
    below_peak = 1.0 - 0.5 / evidence.quality_factor.value**2
    return Calibration(
        frequency_khz=evidence.frequency,
        quality_factor=evidence.quality_factor,
        peak_frequency_khz=evidence.frequency.value * float(np.sqrt(below_peak)) if below_peak > 0.0 else None,
        peak_amplitude=float(height * sweep.amplitude.max()),
        mean_square=_mean_square(fit, float(sweep.amplitude.max())) if kind == "power" and known else None,
        correlation=float(fit.covariance[0, 1] / errors[0] / errors[1]) if known else None,
        model=kind,
        background=background,
        background_values=dict(zip(fit.objective.problem.names[2:], linear.tolist(), strict=True)),
        phase_reversed=fit.reverse,
        chi2=fit.chi2,
        degrees_of_freedom=fit.freedom,
        p_value=evidence.p_value,
        errors=fit.errors,
        residual_autocorrelation=evidence.autocorrelation,
        residual_repeat=evidence.repeat,
        runs_excess=evidence.runs_excess,
        convergence=fit.convergence,
        alternatives=alternatives,
        curves=curves,
        valid=not reasons,
        reasons=reasons,
        warnings=warnings,
        sweep=sweep,
        versions={name: version_of(name) for name in _PACKAGES},
    )


def _calibrated(fit: SweepFit, *, explained: bool) -> list[CalibratedValue]:
    """Return frequency and quality factor with errors, or without where there is nothing to base them on."""
    wider = inflation_of(fit)
    errors = np.sqrt(np.diag(fit.covariance)[:2]) * wider
    if not explained or not np.all(np.isfinite(errors)):
        reason = "the sweep does not determine the parameters" if explained else "the model does not explain the sweep"
        return [CalibratedValue(float(value), None, (None, None), reason) for value in fit.values[:2]]
    # The linear parameters need no interval of their own: an infinite variance leaves them out.
    profiled = fit.covariance.copy()
    nuisances = np.arange(2, len(profiled))
    profiled[nuisances, nuisances] = np.inf
    intervals: list[Interval] = profile_intervals(fit.objective, fit.values, profiled, fit.chi2)
    found = zip(fit.values[:2].tolist(), errors.tolist(), intervals[:2], wider.tolist(), strict=True)
    stated = [(value, error, interval.moved(value, value, factor)) for value, error, interval, factor in found]
    return [CalibratedValue(value, error, (ends.low, ends.high), ends.reason) for value, error, ends in stated]


def _mean_square(fit: SweepFit, largest: float) -> CalibratedValue:
    """Return the thermal <x^2> of the resonance: the integral of a |L|^2 over all frequencies, pi/2 f0/Q a.

    Args:
        fit: of a spectrum.
        largest: unit of the fit's amplitudes, nm per root Hz.
    """
    frequency, quality_factor, power = fit.values[:3]
    slopes = np.array([1.0 / frequency, -1.0 / quality_factor, 1.0 / power])
    share = float(np.sqrt(slopes @ fit.covariance[:3, :3] @ slopes) * inflation_of(fit).max())
    value = float(0.5 * np.pi * 1e3 * frequency / quality_factor * power * largest**2)
    ends = (value * float(np.exp(-1.96 * share)), value * float(np.exp(1.96 * share)))
    return CalibratedValue(value, value * share, ends, None)


def _curves(sweep: ResonanceSweep, fit: SweepFit) -> Curves:
    used = sweep.points
    model = np.asarray(model_at(fit.values, fit.objective.points, fit.objective.kind))[:used]
    amplitude = np.abs(model) * sweep.amplitude.max()
    if sweep.phase_deg is None:
        return Curves(amplitude, amplitude - sweep.amplitude, None, None)
    between = np.rad2deg(np.angle(model * np.conj(np.asarray(fit.objective.points.measured)[:used])))
    misfit = -between if fit.reverse else between
    # Adding the misfit keeps the turns of the measured phase.
    return Curves(amplitude, amplitude - sweep.amplitude, sweep.phase_deg + misfit, misfit)
