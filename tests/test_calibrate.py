"""Calibration: known resonances come back, with honest errors, and what is no resonance is refused."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.signal import lfilter
from scipy.stats import chi2 as chi2_distribution

from afm_jax.columns import csv_columns
from fitting import calibrate, read_resonance
from fitting.calibration.calibrate import CalibratedValue
from fitting.calibration.sweep import Resonance
from tests.resonance_sweeps import FREQUENCY_KHZ, QUALITY_FACTOR, synthetic_sweep

REAL = Path(__file__).parent.parent.parent / "shared" / "data" / "free_resonance_nanonis.dat"


def off(found: CalibratedValue, truth: float) -> float:
    """Return how far a value is from the truth, in its standard errors."""
    assert found.standard_error is not None
    return abs(found.value - truth) / found.standard_error


@pytest.mark.parametrize(("quality_factor", "phase"), [(3.0, True), (3.0, False), (400.0, True), (20000.0, False)])
def test_a_sweep_without_noise_gives_its_parameters_back(quality_factor, phase):
    # A broad peak cannot be swept six half-widths to both sides: that would be below 0.
    half_widths = min(6.0, quality_factor)
    result = calibrate(synthetic_sweep(phase=phase, quality_factor=quality_factor, half_widths=half_widths))
    assert result.valid, result.reasons
    # The grid and the fit know nothing of the truth; what is left is rounding, magnified by Q.
    assert result.frequency_khz.value == pytest.approx(FREQUENCY_KHZ, rel=1e-11)
    assert result.quality_factor.value == pytest.approx(quality_factor, rel=1e-8)
    np.testing.assert_allclose(np.abs(result.fitted), result.sweep.amplitude, rtol=1e-8)


@pytest.mark.parametrize("slope", [0.0, 0.05 + 0.03j])
def test_a_complex_line_behind_the_resonance_is_taken_off(slope):
    sweep = synthetic_sweep(noise=1e-3, background=0.15 - 0.1j, slope=slope)
    result = calibrate(sweep)
    assert result.valid, result.reasons
    assert off(result.quality_factor, QUALITY_FACTOR) < 4.0
    assert off(result.frequency_khz, FREQUENCY_KHZ) < 4.0
    # by the amplitude alone, whose background is a constant, a slope makes Q wrong by more than 10 standard errors
    alone = calibrate(replace(sweep, phase_deg=None))
    assert alone.valid == (slope == 0.0)


def scipy_residual(sweep: Resonance):
    """Return the residual function of (f0 - 90)/half-width, log Q and the linear parameters, and where to start.

    Written out again for a straight line behind the response.
    """
    f, y, s = sweep.frequency_khz, sweep.amplitude, sweep.amplitude_error
    assert s is not None
    position = np.linspace(-1.0, 1.0, sweep.points)

    def line(p):
        return p[4] + 1j * p[5] + position * (p[6] + 1j * p[7])

    def residual(p):
        f0, q = FREQUENCY_KHZ + p[0] * FREQUENCY_KHZ / QUALITY_FACTOR / 2.0, np.exp(p[1])
        shape = (f0**2 / q) / (f0**2 - f**2 + 1j * f * f0 / q)
        if sweep.phase_deg is None:
            return (np.sqrt(p[2] * np.abs(shape) ** 2 + p[3] + p[4] * shape.real) - y) / s
        turned = np.exp(-1j * np.deg2rad(sweep.phase_deg)) * ((p[2] + 1j * p[3]) * shape + line(p))
        return np.concatenate([(turned.real - y) / s, turned.imag / s])

    start = (
        [0.1, 5.9, 25.0, 0.1, 0.1] if sweep.phase_deg is None else [0.1, np.log(380.0), 5.0, 3.0, 0.0, 0.0, 0.0, 0.0]
    )
    return residual, np.array(start)


@pytest.mark.parametrize("phase", [True, False])
def test_scipy_finds_the_same_minimum_and_errors(phase):
    sweep = synthetic_sweep(noise=0.02, background=0.1 + 0.05j, phase=phase, points=80, half_widths=3.0)
    result = calibrate(sweep)
    residual, start = scipy_residual(sweep)
    best = least_squares(residual, start, method="lm", xtol=1e-14, ftol=1e-14)
    half = FREQUENCY_KHZ / QUALITY_FACTOR / 2.0
    covariance = np.linalg.inv(best.jac.T @ best.jac)
    # chi2 to its own digits; values to a thousandth of an error, which is what finite differences leave
    assert result.chi2 == pytest.approx(2.0 * best.cost, rel=1e-8)
    assert result.degrees_of_freedom == len(best.fun) - len(start)
    assert result.p_value == pytest.approx(chi2_distribution.sf(2.0 * best.cost, len(best.fun) - len(start)), rel=1e-6)
    backs = (lambda p: FREQUENCY_KHZ + half * p, np.exp)
    for index, (value, back) in enumerate(zip((result.frequency_khz, result.quality_factor), backs, strict=True)):
        error = np.sqrt(covariance[index, index])
        unit = abs(back(best.x[index] + 1e-6) - back(best.x[index] - 1e-6)) / 2e-6
        assert value.value == pytest.approx(back(best.x[index]), abs=1e-3 * error * unit)
        assert value.standard_error == pytest.approx(error * unit, rel=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize(("phase", "given"), [(True, True), (False, False)])
def test_intervals_cover_the_truth(phase, given):
    count, pulls, inside = 60 if phase else 40, [], 0
    noisy: dict[str, Any] = {"noise": 0.02, "background": 0.05 + 0.02j, "phase": phase, "given": given, "points": 60}
    for seed in range(count):
        result = calibrate(synthetic_sweep(**noisy, seed=seed, half_widths=4.0))
        for value, truth in ((result.frequency_khz, FREQUENCY_KHZ), (result.quality_factor, QUALITY_FACTOR)):
            low, high = value.interval95
            inside += (low or np.inf) < truth < (high or -np.inf)
            if value.standard_error is not None:
                pulls.append((value.value - truth) / value.standard_error)
    # a draw in a thousand is as improbable as what the model does not explain
    assert len(pulls) >= 2 * count - 2
    # 4 binomial standard deviations; frequency and Q are nearly uncorrelated
    assert inside / (2 * count) == pytest.approx(0.95, abs=4.0 * np.sqrt(0.95 * 0.05 / (2 * count)))
    # the same for a standard deviation of pulls, sqrt(1/2n) each
    assert np.std(pulls) == pytest.approx(1.0, abs=4.0 / np.sqrt(4 * count))
    assert np.mean(pulls) == pytest.approx(0.0, abs=4.0 / np.sqrt(2 * count))


@pytest.mark.parametrize("reverse", [1.0, -1.0])
def test_order_of_the_points_and_sign_and_turns_of_the_phase_do_not_matter(reverse):
    sweep = synthetic_sweep(noise=1e-3)
    assert sweep.phase_deg is not None
    phase = reverse * sweep.phase_deg + 360.0 * (np.arange(120) % 3) + 77.0
    order = np.random.default_rng(5).permutation(120)
    columns = {name: getattr(sweep, name)[order] for name in ("frequency_khz", "amplitude", "amplitude_error")}
    result = calibrate(Resonance(**columns, phase_deg=phase[order]))
    plain = calibrate(sweep)
    assert result.phase_reversed == (reverse < 0.0)
    assert result.quality_factor.value == pytest.approx(plain.quality_factor.value, rel=1e-9)
    columns = csv_columns(result)["calibration_points.csv"]
    assert np.abs(columns["fitted_phase_deg"] - phase).max() < 10.0
    for found, reversed_phase in ((result, reverse < 0.0), (plain, False)):
        assert any("sign was reversed" in warning for warning in found.warnings) == reversed_phase


@pytest.mark.parametrize(
    ("sweep", "said"),
    [
        (synthetic_sweep(noise=0.01, centre=40.0, phase=False), "No resonance stands out"),
        (synthetic_sweep(noise=1e-3, centre=-5.8), "at the edge of the sweep"),
        (synthetic_sweep(noise=1e-3, centre=7.0), "lies outside the sweep"),
        (synthetic_sweep(noise=1e-3, half_widths=200.0), "sweep in finer steps"),
        (synthetic_sweep(noise=1e-3, slope=0.3, phase=False), "does not explain the sweep"),
        (synthetic_sweep(noise=1e-3, slope=0.3, phase=False, given=False), "residuals are strongly correlated"),
    ],
)
def test_what_is_no_calibration_is_not_valid(sweep, said):
    result = calibrate(sweep)
    assert not result.valid
    assert any(said in reason for reason in result.reasons), result.reasons
    assert result.table_comments == []


def test_the_measured_sweep():
    if not REAL.exists():
        pytest.skip("the measured sweep lies outside this checkout")
    real_sweep = read_resonance(REAL)
    result = calibrate(real_sweep)
    assert result.valid, result.reasons
    # SciPy, unweighted, the linear parameters eliminated; the whole curve gives some 5 % more than the instrument's Q
    assert result.quality_factor.value == pytest.approx(1219.2, abs=1.0)
    assert 0.8 < (result.quality_factor.standard_error or 0.0) < 1.5
    assert result.quality_factor.value / real_sweep.instrument["quality_factor"] == pytest.approx(1.05, abs=0.01)
    assert result.frequency_khz.value == pytest.approx(30.28122, abs=6e-5)
    assert result.frequency_khz.value == pytest.approx(real_sweep.instrument["frequency_khz"], rel=2e-5)
    alone = calibrate(replace(real_sweep, phase_deg=None)).quality_factor
    # the amplitude alone: 1218.84 +- 1.21 by SciPy
    assert (alone.value, alone.standard_error) == (pytest.approx(1218.84, abs=0.1), pytest.approx(1.21, abs=0.1))


@pytest.mark.slow
def test_errors_are_those_of_correlated_noise():
    clean, values, errors = synthetic_sweep(noise=0.0, points=200), [], []
    response = clean.amplitude * np.exp(1j * np.deg2rad(np.asarray(clean.phase_deg)))
    for seed in range(40):
        white = np.random.default_rng(seed).standard_normal((200, 2)).T
        # what a point keeps of the one before
        noise = lfilter([0.6], [1.0, -0.8], white)
        noisy = response + 3e-3 * clean.amplitude.max() * (noise[0] + 1j * noise[1])
        phase = np.rad2deg(np.unwrap(np.angle(noisy)))
        sweep = Resonance(frequency_khz=clean.frequency_khz, amplitude=np.abs(noisy), phase_deg=phase)
        found = calibrate(sweep).quality_factor
        if found.standard_error is not None:
            values.append(found.value)
            errors.append(found.standard_error)
    assert len(values) > 30
    # forty seeds give the scatter to 11 %; weights towards far neighbours cost another tenth. Independent points: 2.6
    assert 0.75 < np.std(values) / np.mean(errors) < 1.5
