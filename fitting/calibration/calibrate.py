"""Calibrate a free cantilever: frequency, quality factor and spring constant from a scan or a thermal spectrum."""

import os
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import median_filter, uniform_filter1d
from scipy.special import digamma

from afm_jax.checks import check_parameter, checked
from afm_jax.columns import CsvColumns, csv_columns
from afm_jax.report import Cell, Section, sections, table_of
from afm_jax.results import JudgedResult, public_result
from afm_jax.saved import as_json
from afm_jax.solve.least_squares import IMPROBABLE, chi2_tail, covariance_of
from afm_jax.strict_json import plain
from afm_jax.units import TWO_SIDED_95
from afm_jax.words import counted, with_error
from fitting.calibration.model import chi2_without_resonance, minimum
from fitting.calibration.stiffness import equipartition, sader
from fitting.calibration.sweep import Resonance, read_resonance
from fitting.tables.csv_text import TableError, given_value

_Given = tuple[float, float | None] | float | str | None
"""A number, a pair with its standard error, or a text such as '225 +- 2'."""
_LEAST_FREQUENCIES = 6
"""One more than the amplitude has parameters."""


@dataclass(frozen=True)
class CalibratedValue:
    """A quantity with its standard error and 95 % interval, None where `reason` says why there are none."""

    value: float
    standard_error: float | None
    interval95: tuple[float | None, float | None] = (None, None)
    reason: str | None = None

    @property
    def in_words(self) -> str:
        """The value with two digits of its error."""
        if self.standard_error is None:
            return f"{self.value:.4g}, no calibration"
        return with_error(self.value, self.standard_error)


@public_result(picture="fitting.calibration.picture:calibration_figure")
@dataclass(frozen=True, eq=False, kw_only=True)
class Calibration(JudgedResult):
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
        fitted: the response at every point, complex as the phase was measured, or the amplitude, in the sweep's unit.
        sweep: what was fitted; of a spectrum the part around the resonance.
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
    fitted: np.ndarray
    sweep: Resonance
    reasons: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()

    @property
    def table_comments(self) -> list[str]:
        """The comment lines that carry the calibration into an amplitude table; none if it is not valid."""
        if not self.valid:
            return []
        sure = [one for one in self.spring_constant_n_per_m.values() if one.standard_error is not None]
        return [
            # more digits than its error has: it enters every amplitude of a table
            f"# free_frequency_khz = {self.frequency_khz.value:.9g}",
            f"# quality_factor = {self.quality_factor.in_words}",
            *(f"# spring_constant_n_per_m = {one.in_words}" for one in sure[:1]),
        ]


@as_json.register
def _(lever: Calibration) -> dict[str, Any]:
    own = {name: value for name, value in vars(lever).items() if name not in {"sweep", "fitted"}}
    more = {"valid": lever.valid, "instrument": lever.sweep.instrument, "table_comments": lever.table_comments}
    return plain({"format": "afm-jax calibrate", "format_version": 2} | own | more)


@csv_columns.register
def _(lever: Calibration) -> CsvColumns:
    # the scan and the fit
    sweep = lever.sweep
    columns = {"frequency_khz": sweep.frequency_khz, "measured_amplitude": sweep.amplitude}
    columns["fitted_amplitude"] = np.abs(lever.fitted)
    if sweep.phase_deg is not None:
        # the turns of the measured phase are kept
        apart = np.angle(lever.fitted * np.exp(-1j * np.deg2rad(sweep.phase_deg)), deg=True)
        columns |= {"measured_phase_deg": sweep.phase_deg, "fitted_phase_deg": sweep.phase_deg + apart}
    return {"calibration_points.csv": columns}


@sections.register
def _(lever: Calibration) -> list[Section]:
    values = {"frequency_khz (kHz)": lever.frequency_khz, "quality_factor": lever.quality_factor}
    values |= {f"spring constant, {name} (N/m)": one for name, one in lever.spring_constant_n_per_m.items()}
    cells: dict[str, Cell] = {
        "of the free cantilever": lambda row: row[0],
        "value +- standard error": lambda row: row[1].in_words,
    }
    comments = lever.table_comments
    chi2 = f"chi2/dof {lever.chi2:.1f}/{lever.degrees_of_freedom}, errors: {lever.error_origin}"
    return [
        Section(f"{lever.sweep.source}, {counted(lever.sweep.points, 'point')}", []),
        Section("Values", [table_of(cells, [*values.items()]), chi2]),
        Section("Comments", ["\n".join(["For the top of an amplitude table:", *comments]) if comments else None]),
    ]


@checked
def calibrate(
    sweep: Resonance | str | os.PathLike[str],
    *,
    averages: float | None = None,
    temperature_k: _Given = None,
    length_um: _Given = None,
    width_um: _Given = None,
    scale_error: float = 0.05,
    static: bool = True,
) -> Calibration:
    """Fit frequency and quality factor of the free cantilever to a scan or a thermal spectrum, and its stiffness.

    The frequency is the undamped natural one; the amplitude is largest a little lower, at f0 sqrt(1 - 1/2Q^2).

    Args:
        sweep: from `read_resonance`, or a file; its phase is used if there is one. Without errors of the amplitudes
            these are estimated from the misfit, and goodness of fit cannot be judged.
        averages: how many spectra a thermal spectrum is the mean of; None: the file's.
        temperature_k: of lever and air, a number, a pair with its error or '296 +- 3', which is assumed of a file
            that says none.
        length_um: of a rectangular lever, likewise; with the width it gives k by Sader's method.
        width_um: of a rectangular lever, likewise.
        scale_error: relative error of the deflection's scale; that of k by equipartition is twice as large; force
            curves repeat a scale to some per cent.
        static: the deflection was calibrated by the slope of a force curve (static InvOLS), not by the mode itself.

    Returns:
        Values, errors, intervals, goodness of fit and a verdict; see `Calibration`.

    Raises:
        ValueError: if an option is impossible, or a lever has one side only.
        TableError: if the scan has too few points, or its amplitude is the same everywhere.
    """
    if not isinstance(sweep, Resonance):
        sweep = read_resonance(Path(os.fspath(sweep)))
    check_parameter("averages", averages, "above 0.5", optional=True)
    check_parameter("scale_error", scale_error, "positive")
    warm = temperature_k or (sweep.instrument.get("temperature_k", 296.0), 3.0)
    given = {"length_um": length_um, "width_um": width_um, "temperature_k": warm}
    read = {name: given_value(name, one) for name, one in given.items() if one is not None}
    known = {name: (value, error or 0.0) for name, (value, error) in read.items()}
    if ("length_um" in known) != ("width_um" in known):
        raise ValueError("Sader's method needs both `length_um=...` and `width_um=...`")
    sweep = replace(sweep, averages=averages or sweep.averages)
    _check_sweep(sweep)
    found = _of_spectrum(sweep) if sweep.spectrum else _fitted(sweep)
    springs = _springs(found, known, scale_error, static=static)
    doubts = [one.reason for one in springs.values() if one.reason is not None]
    mend = "`length_um=...` and `width_um=...` give k by Sader's method. Frequency and Q do not depend on it."
    reasons = [f"The spring constant is not calibrated: {doubt}; {mend}" for doubt in doubts if "sader" not in springs]
    warnings = [f"The spring constants contradict each other: {doubt}." for doubt in doubts]
    said = {"reasons": (*found.reasons, *reasons), "warnings": (*found.warnings, *warnings)}
    return replace(found, spring_constant_n_per_m=springs, **said)


def _check_sweep(sweep: Resonance) -> None:
    """Refuse scans with fewer frequencies than the model has parameters, or with nothing that changes."""
    count = len(np.unique(sweep.frequency_khz))
    if count < _LEAST_FREQUENCIES:
        raise TableError(f"{sweep.source}: measure at {_LEAST_FREQUENCIES} or more frequencies, not at {count}")
    if np.ptp(sweep.amplitude) == 0.0:
        raise TableError(f"{sweep.source}: the amplitude is the same at every frequency; sweep across a resonance")


def _fitted(sweep: Resonance) -> Calibration:
    """Return the fit of a scan or of a part of a spectrum, with what makes it invalid and its warnings."""
    largest = float(sweep.amplitude.max())
    # without errors they are what makes chi2/dof 1
    error, size, origin = np.full(sweep.points, 1.0 if sweep.spectrum else 0.01), 1.0, "estimated"
    if sweep.spectrum and sweep.averages is not None:
        # the mean of a term of the gamma deviance is a little above 1
        size = 2.0 * sweep.averages * (np.log(sweep.averages) - digamma(sweep.averages))
        error, origin = error * sweep.averages**-0.5, "averages"
    elif sweep.amplitude_error is not None:
        error, origin = sweep.amplitude_error / largest, "file"
    (place, best, _, distance), model, reverse = minimum(sweep, error)
    freedom = len(best.residual) - len(place)
    # a scan without noise keeps rounding for an error
    scale = max(best.value / freedom, 1e-12) if origin == "estimated" else 1.0
    chi2 = best.value / scale
    p_value = np.nan if origin == "estimated" else chi2_tail(best.value / size, freedom)
    neighbours = best.residual.reshape(-1, sweep.points)
    together = float(np.sum(neighbours[:, 1:] * neighbours[:, :-1])) / max(best.value, 1e-12 * neighbours.size)
    # neighbours that go together by rho are worth (1 - rho)/(1 + rho) points each
    fewer = (1.0 + together) / (1.0 - together) if together > 3.0 / np.sqrt(neighbours.size) else 1.0
    covariance = scale * fewer * covariance_of(best.jacobian.T @ best.jacobian)
    natural, quality_factor = np.exp(place[:2]).tolist()

    def known(value: float, *slopes: float) -> CalibratedValue:
        """Return a value whose logarithm has these derivatives by the first of the place."""
        used = np.flatnonzero(slopes)
        by = np.array(slopes)[used]
        variance = float(by @ covariance[np.ix_(used, used)] @ by)
        # the variance of a logarithm
        if not variance < 20.0:
            return CalibratedValue(value, None, reason="the scan does not determine it")
        return _known_to(value, float(np.sqrt(variance)))

    # the integral of a |L|^2 over all frequencies
    area = float(0.5 * np.pi * 1e3 * natural / quality_factor * place[2] * largest**2)
    frequency, quality = known(natural, 1.0), known(quality_factor, 0.0, 1.0)
    unknown = frequency.reason or quality.reason
    half, apart = 0.5 * natural / quality_factor, sweep.frequency_khz - natural
    near, count = min(-apart[0], apart[-1]) / half, int(np.sum(np.abs(apart) < half))
    khz, inside = f"{natural:.6g} kHz", f"{counted(count, 'point')} within the half-width"
    faults = {
        f"The resonance ({khz}) lies outside the sweep: sweep around it.": near < 0.0,
        f"The resonance ({khz}) lies at the edge of the sweep: sweep at least one half-width (f0/2Q) to both sides.": (
            near < 1.0
        ),
        f"Only {inside}: sweep in finer steps.": not sweep.spectrum and count < 3,
        f"The model does not explain the sweep: chi2 {chi2:.0f} for {freedom} degrees of freedom. "
        "Another background, a drift, or too small errors?": p_value < IMPROBABLE,
        f"Not converged: chi2 lies an estimated {distance / scale:.2g} above its minimum.": not distance < 1e-3 * scale,
        f"Not identified: {unknown}.": unknown is not None,
    }
    # of these faults the first
    reasons = [said for said, holds in faults.items() if holds][:1]
    # four more parameters practically never bring such a fall of chi2 about by chance
    if chi2_without_resonance(sweep, error) / scale - chi2 < 30.0 * max(chi2 / freedom, 1e-300):
        reasons.insert(0, "No resonance stands out of the sweep: a parabola explains it about as well.")
    if together > 0.5:
        reasons.append(
            f"Neighbouring residuals are strongly correlated ({together:+.2f}): the model misses something (another "
            "background, drift, a second resonance, too fast a sweep), and the errors mean nothing."
        )
    notes = {
        "The phase rises through the resonance: its sign was reversed.": reverse,
        f"{inside}: Q is hardly resolved; the area under the line, and k, hold.": sweep.spectrum and count < 3,
    }
    return Calibration(
        frequency_khz=frequency,
        quality_factor=quality,
        mean_square_nm2=known(area, 1.0, -1.0, 1.0 / place[2]) if sweep.spectrum else None,
        model=sweep.model,
        error_origin=origin,
        phase_reversed=reverse,
        chi2=chi2,
        degrees_of_freedom=freedom,
        p_value=p_value,
        fitted=largest * (np.conj(model) if reverse else model),
        sweep=sweep,
        reasons=tuple(reasons),
        warnings=tuple(said for said, holds in notes.items() if holds),
    )


def _of_spectrum(sweep: Resonance) -> Calibration:
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
    centre, half = sweep.frequency_khz[top], max(0.5 * float(wide), 3.0) * step
    # a first fit finds the resonance; then as much on both sides of it as the model explains
    fits: list[Calibration] = []
    for times in (20.0, 20.0, 10.0, 5.0, 3.0):
        part = sweep.within(centre - times * half, centre + times * half)
        _check_sweep(part)
        fits.append(_fitted(part))
        if len(fits) > 1 and not fits[-1].p_value < IMPROBABLE:
            break
        centre = np.clip(fits[-1].frequency_khz.value, *sweep.frequency_khz[[0, -1]])
        half = max(0.5 * centre / fits[-1].quality_factor.value, 3.0 * step)
    found = fits[-1]
    low, high = found.sweep.frequency_khz[[0, -1]]
    note = f"Fitted from {low:.6g} to {high:.6g} kHz: what one resonance and white noise explain."
    return found if found.sweep.points == sweep.points else replace(found, warnings=(note, *found.warnings))


def _springs(
    found: Calibration, known: dict[str, tuple[float, float]], scale_error: float, *, static: bool
) -> dict[str, CalibratedValue]:
    """Return the spring constants that a calibration supports; that by equipartition without error if contradicted.

    Args:
        found: the calibration.
        known: of lever and air, in the order of `sader`, each with its error; temperature alone where there is no size.
        scale_error: as of `calibrate`.
        static: as of `calibrate`.
    """
    read = [(one.value, one.standard_error) for one in (found.frequency_khz, found.quality_factor)]
    if None in (error for _, error in read):
        return {}
    springs, mean = {}, found.mean_square_nm2
    who, wanted, share = "the instrument", found.sweep.instrument.get("spring_constant_n_per_m"), 0.1
    if "length_um" in known:
        centre, errors = np.array([*read, *known.values()]).T
        who, wanted = "Sader's method", sader(*centre)
        share = float(np.linalg.norm([sader(*place) / wanted - 1.0 for place in centre + np.diag(errors)]))
        springs["sader"] = _known_to(wanted, share)
    if mean is None or mean.standard_error is None:
        return springs
    warm, warm_error = known["temperature_k"]
    value = equipartition(mean.value, warm, static=static)
    own = float(np.linalg.norm((mean.standard_error / mean.value, warm_error / warm, 2.0 * scale_error)))
    springs["equipartition"] = _known_to(value, own)
    apart = 0.0 if wanted is None else float(np.log(value / wanted))
    # neither is better than 5 %
    if abs(apart) >= TWO_SIDED_95 * np.linalg.norm((own, share, 0.05)):
        doubt = (
            f"equipartition gives {value:.3g} N/m, {who} {wanted:.3g}: if that is right, the deflection's nm "
            f"are {np.exp(-0.5 * apart):.3g} times the true ones"
        )
        springs["equipartition"] = CalibratedValue(value, None, reason=doubt)
    return springs


def _known_to(value: float, share: float) -> CalibratedValue:
    """Return a value whose logarithm has a standard error."""
    ends = (value * float(np.exp(-TWO_SIDED_95 * share)), value * float(np.exp(TWO_SIDED_95 * share)))
    return CalibratedValue(value, value * share, ends)
