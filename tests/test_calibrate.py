"""Calibration: known resonances come back, with honest errors, and what is no resonance is refused."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.signal import lfilter
from scipy.stats import chi2 as chi2_distribution

from fitting import calibrate, read_sweep
from fitting.calibration.result import CalibratedValue
from fitting.calibration.sweep import ResonanceSweep, without_phase
from fitting.tables.csv_text import TableError
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
    assert result.peak_amplitude == pytest.approx(5.0, rel=1e-8)
    # the maximum lies below the natural frequency
    peak = FREQUENCY_KHZ * np.sqrt(1.0 - 0.5 / quality_factor**2)
    assert result.peak_frequency_khz == pytest.approx(peak, rel=1e-8)


@pytest.mark.parametrize(
    ("background", "truth"),
    [("constant", {"background": 0.15 - 0.1j}), ("linear", {"background": 0.15 - 0.1j, "slope": 0.05 + 0.03j})],
)
def test_complex_backgrounds_are_taken_off(background, truth):
    sweep = synthetic_sweep(noise=1e-3, **truth)
    result = calibrate(sweep, background=background)
    assert result.valid, result.reasons
    assert off(result.quality_factor, QUALITY_FACTOR) < 4.0
    assert off(result.frequency_khz, FREQUENCY_KHZ) < 4.0
    # without the background Q is wrong by more than 10 standard errors
    bare = next(other for other in result.alternatives if other.background == "none")
    assert off(replace(result.quality_factor, value=bare.quality_factor), QUALITY_FACTOR) > 10.0
    assert bare.aic > result.chi2 + 1000.0
    found = complex(result.background_values["background_cos"], result.background_values["background_sin"])
    assert found * sweep.amplitude.max() / 5.0 == pytest.approx(truth["background"], abs=5e-3)


def test_interference_with_the_background_is_taken_off_an_amplitude():
    sweep = synthetic_sweep(noise=1e-3, background=0.1 + 0.05j, phase=False)
    result = calibrate(sweep)
    assert result.valid, result.reasons
    # |A L + B|^2 is taken up to terms of the order 1/Q^2; 4 standard errors are 0.3 % of Q
    assert abs(result.quality_factor.value / QUALITY_FACTOR - 1.0) < 3e-3
    assert not calibrate(sweep, background="floor").valid


def test_noise_in_quadrature_is_a_floor():
    clean, floor = synthetic_sweep(phase=False, half_widths=20.0), 0.2
    noisy = replace(clean, amplitude=np.hypot(clean.amplitude, floor))
    result = calibrate(noisy, background="floor")
    assert result.quality_factor.value == pytest.approx(QUALITY_FACTOR, rel=1e-8)
    assert result.background_values["floor_squared"] == pytest.approx((floor / noisy.amplitude.max()) ** 2, rel=1e-6)


def scipy_residual(sweep: ResonanceSweep):
    """Return the residual function of (f0 - 90)/half-width, log Q and the linear parameters, and where to start.

    Written out again for a constant background.
    """
    f, y, s = sweep.frequency_khz, sweep.amplitude, sweep.amplitude_error
    assert s is not None

    def residual(p):
        f0, q = FREQUENCY_KHZ + p[0] * FREQUENCY_KHZ / QUALITY_FACTOR / 2.0, np.exp(p[1])
        shape = (f0**2 / q) / (f0**2 - f**2 + 1j * f * f0 / q)
        if sweep.phase_deg is None:
            return (np.sqrt(p[2] * np.abs(shape) ** 2 + p[3] + p[4] * shape.real) - y) / s
        turned = np.exp(-1j * np.deg2rad(sweep.phase_deg)) * ((p[2] + 1j * p[3]) * shape + p[4] + 1j * p[5])
        return np.concatenate([(turned.real - y) / s, turned.imag / s])

    start = [0.1, 5.9, 25.0, 0.1, 0.1] if sweep.phase_deg is None else [0.1, np.log(380.0), 5.0, 3.0, 0.0, 0.0]
    return residual, np.array(start)


@pytest.mark.parametrize("phase", [True, False])
def test_scipy_finds_the_same_minimum_errors_and_intervals(phase):
    sweep = synthetic_sweep(noise=0.02, background=0.1 + 0.05j, phase=phase, points=80, half_widths=3.0)
    result = calibrate(sweep, compare=False)
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
        for end, side in zip(value.interval95, (-1.0, 1.0), strict=True):
            wanted = back(profile_end(residual, best, index, side * error))
            assert end == pytest.approx(wanted, abs=2e-3 * error * unit)


def profile_end(residual, best, index: int, step: float) -> float:
    """Return where chi2, minimised over the others by SciPy, has risen by 3.84: a secant in its root."""
    others = np.delete(np.arange(len(best.x)), index)

    def rise(shift: float) -> float:
        def held(rest):
            full = best.x.copy()
            full[index], full[others] = best.x[index] + shift, rest
            return residual(full)

        return 2.0 * (least_squares(held, best.x[others], method="lm", xtol=1e-13, ftol=1e-13).cost - best.cost)

    wanted = chi2_distribution.ppf(0.95, 1)
    shift = step * np.sqrt(wanted)
    for _ in range(8):
        shift *= np.sqrt(wanted / rise(shift))
    return best.x[index] + shift


@pytest.mark.slow
@pytest.mark.parametrize(("phase", "given"), [(True, True), (False, False)])
def test_intervals_cover_the_truth(phase, given):
    count, pulls, inside = 60 if phase else 40, [], 0
    noisy: dict[str, Any] = {"noise": 0.02, "background": 0.05 + 0.02j, "phase": phase, "given": given, "points": 60}
    for seed in range(count):
        result = calibrate(synthetic_sweep(**noisy, seed=seed, half_widths=4.0), compare=False)
        for value, truth in ((result.frequency_khz, FREQUENCY_KHZ), (result.quality_factor, QUALITY_FACTOR)):
            low, high = value.interval95
            inside += (low or np.inf) < truth < (high or -np.inf)
            pulls.append((value.value - truth) / (value.standard_error or np.nan))
    # 4 binomial standard deviations; frequency and Q are nearly uncorrelated
    assert inside / (2 * count) == pytest.approx(0.95, abs=4.0 * np.sqrt(0.95 * 0.05 / (2 * count)))
    # the same for a standard deviation of pulls, sqrt(1/2n) each
    assert np.std(pulls) == pytest.approx(1.0, abs=4.0 / np.sqrt(4 * count))
    assert np.mean(pulls) == pytest.approx(0.0, abs=4.0 / np.sqrt(2 * count))


def test_errors_follow_the_noise_they_are_told():
    sweep = synthetic_sweep(noise=0.01, given=False)
    scaled = calibrate(sweep, compare=False)
    told, doubled = (calibrate(sweep, noise=noise, compare=False) for noise in (0.01, 0.02))
    rescaled = calibrate(sweep, noise=0.02, scale_errors=True, compare=False)
    # 240 residuals: the noise is found to 1/sqrt(480), here 3 of those
    assert (scaled.errors.origin, scaled.errors.amplitude) == ("estimated", pytest.approx(0.05, rel=0.15))
    assert scaled.chi2 == pytest.approx(scaled.degrees_of_freedom, rel=1e-9)
    assert np.isnan(scaled.p_value)
    assert doubled.chi2 == pytest.approx(told.chi2 / 4.0, rel=1e-9)
    assert doubled.quality_factor.standard_error == pytest.approx(2.0 * (told.quality_factor.standard_error or 0.0))
    assert rescaled.chi2 == pytest.approx(rescaled.degrees_of_freedom, rel=1e-9)
    # the noise of 0.02 is that of the largest amplitude measured, not of 5 nm
    assert rescaled.errors.scale == pytest.approx(0.5, rel=0.2)


def test_a_wandering_drive_frequency_is_told_from_noise():
    sweep = synthetic_sweep(noise=1e-3, given=False, points=400)
    jitter_khz, random = 0.001, np.random.default_rng(7)
    moved = sweep.frequency_khz + jitter_khz * random.standard_normal(400)
    result = calibrate(replace(sweep, frequency_khz=moved), compare=False)
    # 400 points: 1/sqrt(800) of it, 4 of those
    assert result.errors.frequency_jitter_hz == pytest.approx(1.0, rel=0.15)
    assert result.errors.amplitude == pytest.approx(5e-3, rel=0.15)
    assert off(result.quality_factor, QUALITY_FACTOR) < 4.0


def test_a_rounded_drive_frequency_shows_as_a_repetition():
    sweep = synthetic_sweep(noise=2e-4, given=False, points=200, half_widths=3.0)
    # The generator's steps are 4/3 of the sweep's: the pattern comes back every 4 points.
    grid = float(np.diff(sweep.frequency_khz)[0]) * 4.0 / 3.0
    driven = grid * np.round(sweep.frequency_khz / grid)
    result = calibrate(replace(sweep, frequency_khz=2.0 * sweep.frequency_khz - driven), compare=False)
    assert (result.residual_repeat or (0,))[0] in {4, 8, 12}
    assert any("repeat every" in warning for warning in result.warnings)


@pytest.mark.parametrize("reverse", [1.0, -1.0])
def test_order_of_the_points_and_sign_and_turns_of_the_phase_do_not_matter(reverse):
    sweep = synthetic_sweep(noise=1e-3)
    assert sweep.phase_deg is not None
    phase = reverse * sweep.phase_deg + 360.0 * (np.arange(120) % 3) + 77.0
    order = np.random.default_rng(5).permutation(120)
    columns = {name: getattr(sweep, name)[order] for name in ("frequency_khz", "amplitude", "amplitude_error")}
    result = calibrate(ResonanceSweep(**columns, phase_deg=phase[order]), compare=False)
    plain = calibrate(sweep, compare=False)
    assert result.phase_reversed == (reverse < 0.0)
    assert result.quality_factor.value == pytest.approx(plain.quality_factor.value, rel=1e-9)
    assert np.abs(np.asarray(result.curves.phase_deg) - phase).max() < 10.0
    for said, in_result, in_plain in (("opposite sign", reverse < 0.0, False), ("were sorted", True, False)):
        assert any(said in warning for warning in result.warnings) == in_result
        assert any(said in warning for warning in plain.warnings) == in_plain


@pytest.mark.parametrize(
    ("sweep", "said"),
    [
        (synthetic_sweep(noise=0.01, centre=40.0, phase=False), "No resonance stands out"),
        (synthetic_sweep(noise=1e-3, centre=-5.8), "upper edge of the sweep"),
        (synthetic_sweep(noise=1e-3, centre=7.0), "lies outside the sweep"),
        (synthetic_sweep(noise=1e-3, half_widths=200.0), "sweep in finer steps"),
        (synthetic_sweep(noise=1e-3, slope=0.1), "does not explain the sweep"),
        (synthetic_sweep(noise=1e-3, slope=0.1, given=False), "Neighbouring residuals are strongly correlated"),
    ],
)
def test_what_is_no_calibration_is_not_valid(sweep, said):
    result = calibrate(sweep, background="constant", compare=False)
    assert not result.valid
    assert any(said in reason for reason in result.reasons), result.reasons
    with pytest.raises(ValueError, match="must not enter a table"):
        _ = result.table_comments


def test_noise_or_nothing_is_no_resonance():
    random, khz = np.random.default_rng(3), np.linspace(89.0, 91.0, 80)
    noise: dict[str, Any] = {
        "amplitude": 1.0 + 0.02 * random.standard_normal(80),
        "phase_deg": random.uniform(-2.0, 2.0, 80),
    }
    result = calibrate(ResonanceSweep(frequency_khz=khz, **noise), compare=False)
    assert not result.valid
    assert any("No resonance stands out" in reason for reason in result.reasons)
    flat = ResonanceSweep(frequency_khz=khz, amplitude=np.zeros(80), phase_deg=np.linspace(0.0, 90.0, 80))
    with pytest.raises(TableError, match="is 0 nm at every frequency; sweep across a resonance"):
        calibrate(flat)


def test_the_measured_sweep():
    if not REAL.exists():
        pytest.skip("the measured sweep lies outside this checkout")
    real_sweep = read_sweep(REAL)
    chosen = calibrate(real_sweep)
    # the linear background is better by 130 in Akaike's criterion
    assert (chosen.background, chosen.valid) == ("linear", True)
    assert chosen.quality_factor.value == pytest.approx(1219.6, abs=0.2)
    assert 0.8 < (chosen.quality_factor.standard_error or 0.0) < 1.5
    result = calibrate(real_sweep, background="constant")
    assert result.valid, result.reasons
    # The whole curve gives some 5 % more than the instrument's 1161 from 15 points.
    assert result.quality_factor.value / real_sweep.instrument["quality_factor"] == pytest.approx(1.05, abs=0.01)
    # SciPy, unweighted, the linear parameters eliminated: 30.28122 kHz and 1220.37 +- 0.87
    assert result.quality_factor.value == pytest.approx(1220.37, abs=1.5)
    assert result.frequency_khz.value == pytest.approx(30.28122, abs=3e-5)
    assert result.frequency_khz.value == pytest.approx(real_sweep.instrument["frequency_khz"], rel=2e-5)
    assert (result.residual_repeat or (1,))[0] % 4 == 0
    alone = calibrate(without_phase(real_sweep)).quality_factor
    # the amplitude alone: 1218.84 +- 1.21 by SciPy
    assert (alone.value, alone.standard_error) == (pytest.approx(1218.84, abs=0.1), pytest.approx(1.21, abs=0.02))


def test_a_frequency_in_hz_under_the_name_of_khz_is_pointed_out():
    sweep = synthetic_sweep(noise=1e-3, phase=False)
    assert not any("are in Hz" in warning for warning in calibrate(sweep).warnings)
    wrong = replace(sweep, frequency_khz=1e3 * sweep.frequency_khz)
    assert any("name their column frequency_hz" in warning for warning in calibrate(wrong).warnings)


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
        sweep = ResonanceSweep(frequency_khz=clean.frequency_khz, amplitude=np.abs(noisy), phase_deg=phase)
        found = calibrate(sweep, compare=False).quality_factor
        if found.standard_error is not None:
            values.append(found.value)
            errors.append(found.standard_error)
    assert len(values) > 30
    # forty seeds give the scatter to 11 %; weights towards far neighbours cost another tenth. Independent points: 2.6
    assert 0.75 < np.std(values) / np.mean(errors) < 1.5
