"""Calibrate a free cantilever: frequency, quality factor and spring constant from a scan or a thermal spectrum."""

import os
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.ndimage import median_filter, uniform_filter1d
from scipy.special import digamma

from afm_jax.checks import checked
from afm_jax.columns import printed_table
from afm_jax.least_squares import IMPROBABLE, chi2_tail, covariance_of
from afm_jax.results import Result, public_result
from afm_jax.units import TWO_SIDED_95
from afm_jax.words import bullets, counted, decimals, with_error
from fitting.calibration.model import ScanFit, chi2_without_resonance, minimum
from fitting.calibration.stiffness import equipartition, sader
from fitting.calibration.sweep import ResonanceSweep, read_sweep, stated_settings
from fitting.tables.csv_text import TableError

FORMAT_VERSION = 2
AIR_K = (296.0, 3.0)
"""Temperature of lever and air where none is given."""
SCALE_ERROR = (0.05, None)
"""Relative standard error of the deflection's scale where none is given: force curves repeat it to some per cent."""
_PEAK = 30.0
"""Fall of chi2 per unit of chi2/dof that four more parameters practically never bring about by chance."""
_SYSTEMATIC = 0.5
"""Correlation of neighbouring residuals beyond which the standard errors mean nothing."""
_OPEN = 20.0
"""Variance of a logarithm from which on nothing is determined."""
_FAST_KHZ = 2e4
"""The fastest cantilevers resonate at a few MHz."""
_HALF_WIDTHS = (20.0, 10.0, 5.0, 3.0)
"""Of a thermal spectrum so much is fitted on both sides of the resonance: as much as the model explains."""
_LEAST_FREQUENCIES = 6
"""One more than the amplitude has parameters."""
_LEAST_POINTS = 3
"""Within the half-width of a scan's resonance."""


@dataclass(frozen=True)
class CalibratedValue:
    """A quantity with its standard error and 95 % interval, None where `reason` says why there are none."""

    value: float
    standard_error: float | None
    interval95: tuple[float | None, float | None]
    reason: str | None = None


@public_result(picture="fitting.calibration.picture:calibration_figure")
@dataclass(frozen=True, eq=False, kw_only=True)
class Calibration(Result):
    """What `calibrate` returns, named like the keys of its JSON.

    Attributes:
        frequency_khz: undamped natural frequency Omega/2 pi.
        quality_factor: Q in m z'' + (m Omega/Q) z' + k z = F cos(omega t).
        spring_constant_n_per_m: by "equipartition" (of a spectrum) and by "sader" (with the size of the lever).
        mean_square_nm2: of a spectrum, <x^2> of the resonance; else None.
        model: "phase", "amplitude" or "power", what was fitted.
        error_origin: of the points' errors: "file", "averages", or "estimated" such that chi2/dof = 1.
        phase_reversed: the phase rises through the resonance and was taken with the opposite sign.
        chi2: sum of squared residuals over their errors.
        degrees_of_freedom: numbers measured less parameters.
        p_value: probability of a larger chi2 if the model is right; NaN where the errors come from the fit itself.
        residual_autocorrelation: of neighbouring points.
        chi2_without_resonance: of a parabola.
        left: estimated distance of chi2 to its minimum.
        fitted: the complex response at every point, or the amplitude, in the sweep's unit.
        sweep: what was fitted; of a spectrum the part around the resonance.
        valid: whether to trust it; `reasons` say why not.
        reasons: what makes the result invalid.
        warnings: what a reader should know besides.
    """

    frequency_khz: CalibratedValue
    quality_factor: CalibratedValue
    spring_constant_n_per_m: dict[str, CalibratedValue] = field(default_factory=dict)
    mean_square_nm2: CalibratedValue | None
    model: str
    error_origin: str
    phase_reversed: bool
    chi2: float
    degrees_of_freedom: int
    p_value: float
    residual_autocorrelation: float
    chi2_without_resonance: float
    left: float
    fitted: np.ndarray
    sweep: ResonanceSweep
    valid: bool = False
    reasons: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()

    @property
    def reason(self) -> str | None:
        """Why the calibration is not valid; None if it is."""
        return next(iter(self.reasons), None)

    @property
    def half_widths(self) -> tuple[float, float]:
        """How many half-widths f0/2Q the scan reaches below and above the resonance."""
        half = 0.5 * self.frequency_khz.value / self.quality_factor.value
        below, above = (self.frequency_khz.value - self.sweep.frequency_khz[[0, -1]]) / half
        return float(below), -float(above)

    @property
    def inside(self) -> int:
        """Points within the half-width."""
        half = 0.5 * self.frequency_khz.value / self.quality_factor.value
        return int(np.sum(np.abs(self.sweep.frequency_khz - self.frequency_khz.value) < half))

    @property
    def table_comments(self) -> list[str]:
        """The comment lines that carry the calibration into an amplitude table; none if it is not valid."""
        if not self.valid:
            return []
        # three digits of the error: it enters every amplitude of a table
        places = max(decimals(0.1 * (self.frequency_khz.standard_error or 0.0), unknown=12), 3)
        lines = [f"# free_frequency_khz = {self.frequency_khz.value:.{places}f}"]
        sure = [one for one in self.spring_constant_n_per_m.values() if one.standard_error is not None]
        values = {"quality_factor": self.quality_factor, **({"spring_constant_n_per_m": sure[0]} if sure else {})}
        return lines + [f"# {name} = {with_error(one.value, one.standard_error)}" for name, one in values.items()]

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON object of `afm-jax calibrate`."""
        own = {name: value for name, value in vars(self).items() if name not in {"sweep", "fitted"}}
        values = {name: vars(value) for name, value in own.items() if isinstance(value, CalibratedValue)}
        springs = {name: vars(value) for name, value in self.spring_constant_n_per_m.items()}
        more = {"spring_constant_n_per_m": springs, "instrument": self.sweep.instrument}
        head = {"format": "afm-jax calibrate", "format_version": FORMAT_VERSION}
        return head | own | values | more | {"table_comments": self.table_comments}

    def tables(self) -> dict[str, dict[str, Any]]:
        """Return the columns of calibration_points.csv: the scan and the fit."""
        sweep = self.sweep
        columns = {"frequency_khz": sweep.frequency_khz, "measured_amplitude": sweep.amplitude}
        columns["fitted_amplitude"] = np.abs(self.fitted)
        if sweep.phase_deg is not None:
            sign = -1.0 if self.phase_reversed else 1.0
            fitted = sign * np.angle(self.fitted, deg=True)
            # the turns of the measured phase are kept
            apart = (fitted - sweep.phase_deg + 180.0) % 360.0 - 180.0
            columns |= {"measured_phase_deg": sweep.phase_deg, "fitted_phase_deg": sweep.phase_deg + apart}
        return {"calibration_points.csv": columns}

    def printed(self) -> list[Any]:
        """Return verdict, values, and the lines for an amplitude table."""
        values = {"frequency_khz (kHz)": self.frequency_khz, "quality_factor": self.quality_factor}
        values |= {f"spring constant, {name} (N/m)": one for name, one in self.spring_constant_n_per_m.items()}
        rows = [{"name": name} | vars(one) for name, one in values.items()]
        cells: dict[str, Any] = {"of the free cantilever": "name", "value +- standard error": _in_words}
        fit = f"chi2/dof {self.chi2:.1f}/{self.degrees_of_freedom}, errors: {self.error_origin}"
        return [
            f"{'VALID' if self.valid else 'NOT VALID'}: {self.sweep.source}, {counted(self.sweep.points, 'point')}",
            printed_table("", cells, rows),
            fit,
            *bullets("Reasons:", self.reasons),
            *bullets("Notes:", self.warnings),
            *(["", "For the top of an amplitude table:", *self.table_comments] if self.valid else []),
        ]


def _in_words(row: dict[str, Any]) -> str:
    error = row["standard_error"]
    return f"{row['value']:.4g}, no calibration" if error is None else with_error(row["value"], error)


@checked
def calibrate(
    sweep: ResonanceSweep | str | os.PathLike[str],
    *,
    static: bool = True,
    **settings: tuple[float, float | None] | float | None,
) -> Calibration:
    """Fit frequency and quality factor of the free cantilever to a scan or a thermal spectrum, and its stiffness.

    The frequency is the undamped natural one; the amplitude is largest a little lower, at f0 sqrt(1 - 1/2Q^2).

    Args:
        sweep: from `read_sweep`, or a file; its phase is used where it is there. Without errors of the amplitudes these
            are estimated from the misfit, and goodness of fit cannot be judged.
        static: the deflection was calibrated by the slope of a force curve (static InvOLS), not by the mode itself.
        **settings: what the file's comments say where it is left out, each a number or a pair with its error:
            `averages`, how many spectra a thermal spectrum is the mean of; `temperature_k` of lever and air (else 296
            +- 3); `length_um` and `width_um` of a rectangular lever, for k by Sader's method; `scale_error`, the
            relative error of the deflection's scale (else 0.05), of which k by equipartition has twice as much.

    Returns:
        Values, errors, intervals, goodness of fit and a verdict; see `Calibration`.

    Raises:
        ValueError: if an option is impossible.
        TableError: if the scan has too few points, or its amplitude is the same everywhere.
    """
    if not isinstance(sweep, ResonanceSweep):
        sweep = read_sweep(Path(os.fspath(sweep)))
    sweep = replace(sweep, settings=stated_settings(sweep, settings))
    _check_sweep(sweep)
    found = _of_spectrum(sweep) if sweep.spectrum else _fitted(sweep)
    found = replace(found, spring_constant_n_per_m=_springs(found, static=static))
    reasons, warnings = _why_not_valid(found), (*found.warnings, *_warnings(found))
    return replace(found, reasons=reasons, warnings=warnings, valid=not reasons)


def _check_sweep(sweep: ResonanceSweep) -> None:
    """Refuse scans with fewer frequencies than the model has parameters, or with nothing that changes."""
    count = len(np.unique(sweep.frequency_khz))
    if count < _LEAST_FREQUENCIES:
        raise TableError(f"{sweep.source}: measure at {_LEAST_FREQUENCIES} or more frequencies, not at {count}")
    turning = sweep.phase_deg is not None and np.ptp(sweep.phase_deg) > 0.0 and sweep.amplitude[0] > 0.0
    if np.ptp(sweep.amplitude) == 0.0 and not turning:
        value = f"{sweep.amplitude[0]:g} {sweep.amplitude_unit}".strip()
        raise TableError(f"{sweep.source}: the amplitude is {value} at every frequency; sweep across a resonance")


def _fitted(sweep: ResonanceSweep) -> Calibration:
    """Return the fit of a scan or of a part of a spectrum, not yet judged."""
    largest = float(sweep.amplitude.max())
    known = sweep.averages is not None if sweep.spectrum else sweep.amplitude_error is not None
    if sweep.spectrum:
        error = np.full(sweep.points, 1.0 / np.sqrt(sweep.averages or 1.0))
    elif sweep.amplitude_error is not None:
        error = np.array(sweep.amplitude_error)
    else:
        error = np.full(sweep.points, 0.01 * largest)
    fit = minimum(sweep, error)
    freedom = len(fit.residual) - fit.jacobian.shape[1]
    chi2 = float(np.sum(fit.residual**2))
    # without errors they are what makes chi2/dof 1; a scan without noise keeps rounding for an error
    scale = 1.0 if known else max(chi2 / freedom, 1e-12)
    # the mean of a term of the gamma deviance is a little above 1
    size = 2.0 * sweep.averages * (np.log(sweep.averages) - digamma(sweep.averages)) if sweep.averages else 1.0
    together = _autocorrelation(fit, sweep.points)
    # neighbours that go together by rho are worth (1 - rho)/(1 + rho) points each
    fewer = (1.0 + together) / (1.0 - together) if 3.0 / np.sqrt(len(fit.residual)) < together < 1.0 else 1.0
    covariance = covariance_of(fit.jacobian.T @ fit.jacobian) * scale * fewer
    p_value = chi2_tail(chi2 / size, freedom) if known else np.nan
    origin = "averages" if sweep.spectrum else "file"
    why = "the model does not explain the scan" if p_value < IMPROBABLE else None

    def stated(value: float, slopes: Float[np.ndarray, " p"]) -> CalibratedValue:
        """Return a value whose logarithm has these derivatives by the parameters."""
        used = np.flatnonzero(slopes)
        variance = float(slopes[used] @ covariance[np.ix_(used, used)] @ slopes[used])
        reason = why if variance < _OPEN else "the scan does not determine it"
        if reason is not None:
            return CalibratedValue(value, None, (None, None), reason)
        return _known_to(value, float(np.sqrt(variance)))

    places = np.eye(fit.jacobian.shape[1])
    area, slopes = 0.0, places[0] - places[1]
    if sweep.spectrum:
        # the integral of a |L|^2 over all frequencies
        area = 0.5 * np.pi * 1e3 * fit.frequency_khz / fit.quality_factor * fit.linear[0] * largest**2
        slopes = slopes + places[2] / fit.linear[0]
    return Calibration(
        frequency_khz=stated(fit.frequency_khz, places[0]),
        quality_factor=stated(fit.quality_factor, places[1]),
        mean_square_nm2=stated(float(area), slopes) if sweep.spectrum else None,
        model="power" if sweep.spectrum else "amplitude" if sweep.phase_deg is None else "phase",
        error_origin=origin if known else "estimated",
        phase_reversed=fit.reverse,
        chi2=chi2 / scale,
        degrees_of_freedom=freedom,
        p_value=p_value,
        residual_autocorrelation=together,
        chi2_without_resonance=chi2_without_resonance(sweep, error) / scale,
        left=fit.left / scale,
        fitted=fit.model * largest,
        sweep=sweep,
    )


def _autocorrelation(fit: ScanFit, points: int) -> float:
    """Return the correlation of residuals of neighbouring points; 0 where there is no misfit but rounding."""
    blocks = fit.residual.reshape(-1, points)
    total = float(np.sum(blocks**2))
    return float(np.sum(blocks[:, 1:] * blocks[:, :-1])) / total if total > 1e-12 * blocks.size else 0.0


def _of_spectrum(sweep: ResonanceSweep) -> Calibration:
    """Return the fit of as much of a spectrum around its resonance as one oscillator and white noise explain.

    The resonance is the peak that stands out most of its surroundings. Lines of up to three points (mains, a clock)
    are none: a median does not see them, and sees the flanks of a resonance, however narrow.
    """
    power = sweep.amplitude**2
    smooth = uniform_filter1d(median_filter(power, 7, mode="nearest"), 5, mode="nearest")
    floor = median_filter(smooth, max(smooth.size // 4, 7), mode="nearest")
    top = int(np.argmax(smooth / np.where(floor > 0.0, floor, np.inf)))
    step = float(np.ptp(sweep.frequency_khz)) / (sweep.points - 1)
    low = np.flatnonzero(smooth < 0.5 * (smooth[top] + floor[top]))
    wide = np.min(low[low > top], initial=sweep.points) - np.max(low[low < top], initial=-1)
    first = (float(sweep.frequency_khz[top]), max(0.5 * float(wide), 3.0) * step)
    found = _around(sweep, *first, _HALF_WIDTHS[0])
    for times in _HALF_WIDTHS:
        centre = min(max(found.frequency_khz.value, sweep.frequency_khz[0]), sweep.frequency_khz[-1])
        # once more, around the resonance that was found
        half = max(0.5 * centre / found.quality_factor.value, 3.0 * step)
        found = _around(sweep, centre, half, times)
        if not found.p_value < IMPROBABLE:
            break
    ends = found.sweep.frequency_khz[[0, -1]]
    note = f"Fitted from {ends[0]:.6g} to {ends[1]:.6g} kHz: what one resonance and white noise explain."
    return found if found.sweep.points == sweep.points else replace(found, warnings=(note,))


def _around(sweep: ResonanceSweep, centre_khz: float, half_khz: float, times: float) -> Calibration:
    """Return the fit of a spectrum within so many half-widths of a frequency."""
    part = sweep.within(centre_khz - times * half_khz, centre_khz + times * half_khz)
    _check_sweep(part)
    return _fitted(part)


def _springs(found: Calibration, *, static: bool) -> dict[str, CalibratedValue]:
    """Return the spring constants that a calibration supports; that by equipartition without error if contradicted."""
    frequency, quality = found.frequency_khz, found.quality_factor
    springs, mean = {}, found.mean_square_nm2
    if quality.standard_error is None or frequency.standard_error is None:
        return {}
    stated = found.sweep.settings
    warm = stated.get("temperature_k", AIR_K)
    if "length_um" in stated:
        inputs = [(frequency.value, frequency.standard_error), (quality.value, quality.standard_error)]
        inputs += [stated["length_um"], stated["width_um"], warm]
        centre = [value for value, _ in inputs]
        value = sader(*centre)
        moved = [[*centre[:k], one + (error or 0.0), *centre[k + 1 :]] for k, (one, error) in enumerate(inputs)]
        springs["sader"] = _known_to(value, float(np.sqrt(sum((sader(*one) / value - 1.0) ** 2 for one in moved))))
    if mean is not None and mean.standard_error is not None:
        value = equipartition(mean.value, warm[0], static=static)
        shares = (
            mean.standard_error / mean.value,
            (warm[1] or 0.0) / warm[0],
            2.0 * stated.get("scale_error", SCALE_ERROR)[0],
        )
        one, other = _known_to(value, float(np.linalg.norm(shares))), springs.get("sader")
        said = found.sweep.instrument.get("spring_constant_n_per_m")
        if other is not None:
            doubt = _doubt(one, other.value, other.standard_error or 0.0, "Sader's method")
        else:
            doubt = None if said is None else _doubt(one, said, 0.1 * said, "the instrument")
        springs["equipartition"] = one if doubt is None else CalibratedValue(value, None, (None, None), doubt)
    return springs


def _known_to(value: float, share: float) -> CalibratedValue:
    """Return a value whose logarithm has a standard error."""
    ends = (value * float(np.exp(-TWO_SIDED_95 * share)), value * float(np.exp(TWO_SIDED_95 * share)))
    return CalibratedValue(value, value * share, ends)


def _doubt(thermal: CalibratedValue, wanted: float, error: float, who: str) -> str | None:
    """Return what another spring constant says about the scale of the deflection; None if they agree."""
    apart = float(np.log(thermal.value / wanted))
    shares = ((thermal.standard_error or 0.0) / thermal.value, error / wanted, 0.05)
    if abs(apart) < TWO_SIDED_95 * np.linalg.norm(shares):
        return None
    return (
        f"equipartition gives {thermal.value:.3g} N/m, {who} {wanted:.3g}: if that is right, the deflection's nm are "
        f"{np.exp(-0.5 * apart):.3g} times the true ones"
    )


def _why_not_valid(e: Calibration) -> tuple[str, ...]:
    """Return what makes a calibration invalid: of the faults of its fit the first."""
    at, near = f"The resonance ({e.frequency_khz.value:.6g} kHz) lies", min(e.half_widths)
    unknown = e.frequency_khz.reason or e.quality_factor.reason
    springs = e.spring_constant_n_per_m.values()
    doubts = [] if any(one.standard_error for one in springs) else [one.reason for one in springs]
    many = f"chi2 {e.chi2:.0f} for {e.degrees_of_freedom} degrees of freedom"
    of_fit = (
        (not e.left < 1e-3, f"Not converged: chi2 lies an estimated {e.left:.2g} above its minimum."),
        (near < 0.0, f"{at} outside the sweep: sweep around it."),
        (near < 1.0, f"{at} at the edge of the sweep: sweep at least one half-width (f0/2Q) to both sides."),
        (
            e.model != "power" and e.inside < _LEAST_POINTS,
            f"Only {counted(e.inside, 'point')} within the half-width: sweep in finer steps.",
        ),
        (
            e.p_value < IMPROBABLE,
            f"The model does not explain the sweep: {many}. Another background, a drift, or too small errors?",
        ),
        (unknown, f"Not identified: {unknown}."),
    )
    reasons = [said for holds, said in of_fit if holds][:1]
    if e.chi2_without_resonance - e.chi2 < _PEAK * max(e.chi2 / e.degrees_of_freedom, 1e-300):
        reasons.insert(0, "No resonance stands out of the sweep: a parabola explains it about as well.")
    if e.residual_autocorrelation > _SYSTEMATIC:
        reasons.append(
            f"Neighbouring residuals are strongly correlated ({e.residual_autocorrelation:+.2f}): the model misses "
            "something (another background, drift, a second resonance, too fast a sweep), and the errors mean nothing."
        )
    how = "`length_um=...` and `width_um=...` give k by Sader's method"
    return (*reasons, *(f"The spring constant is not calibrated: {doubt}; {how}." for doubt in doubts))


def _warnings(e: Calibration) -> tuple[str, ...]:
    """Return what a reader should know besides."""
    doubts = [one.reason for one in e.spring_constant_n_per_m.values() if one.reason is not None]
    khz, inside = f"{e.frequency_khz.value:.6g} kHz", counted(e.inside, "point")
    notes = (
        (
            e.frequency_khz.value > _FAST_KHZ,
            f"{khz} is beyond any cantilever: if these are in Hz, name their column frequency_hz.",
        ),
        (e.phase_reversed, "The phase rises through the resonance: it was taken with the opposite sign."),
        (
            e.model == "power" and e.inside < _LEAST_POINTS,
            f"{inside} within the half-width: Q is hardly resolved; the area under the line, and k, hold.",
        ),
        (doubts, f"The spring constants contradict each other: {'; '.join(doubts)}."),
    )
    return tuple(said for holds, said in notes if holds)
