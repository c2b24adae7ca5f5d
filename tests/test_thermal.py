"""Thermal spectra and stiffness: the likelihood, the real spectrum, Sader's method, slopes, and what intervals hold."""

import re
from pathlib import Path

import mpmath
import numpy as np
import pytest
from click.testing import CliRunner
from scipy.stats import gamma

from afm_jax.cli.main import main
from fitting import calibrate, sader
from fitting.calibration.model import deviance_root
from fitting.calibration.stiffness import BOLTZMANN, air_at, hydrodynamic_function
from fitting.calibration.sweep import DENSITY, Resonance
from tests.strict_reading import strictly

REAL = Path(__file__).parent.parent / "fitting" / "examples" / "real"
THERMAL = REAL / "thermal_nanosurf.nid"
FREQUENCY_KHZ, QUALITY_FACTOR, STIFFNESS_N_PER_M, WARM_K = 90.0, 150.0, 5.4, 300.0


def written(path: Path, khz: np.ndarray, power: np.ndarray, *comments: str) -> Path:
    head = "\n".join([*(f"# {comment}" for comment in comments), "frequency_khz\tpsd_nm2_per_hz"])
    np.savetxt(path, np.stack([khz, power], 1), "%.17g", "\t", header=head, comments="")
    return path


def density(khz: np.ndarray, floor: float = 2e-8, quality: float = QUALITY_FACTOR) -> np.ndarray:
    """Return the one-sided density (nm^2/Hz) of an oscillator in thermal motion, from Langevin's equation."""
    variance = 1e18 * BOLTZMANN * WARM_K / STIFFNESS_N_PER_M
    hz, natural = 1e3 * khz, 1e3 * FREQUENCY_KHZ
    shape = natural**4 / ((natural**2 - hz**2) ** 2 + (hz * natural / quality) ** 2)
    return 2.0 * variance / (np.pi * quality * natural) * shape + floor


def thermal_spectrum(averages: float, random: np.random.Generator) -> Resonance:
    khz = np.linspace(86.0, 94.0, 128)
    drawn = density(khz) * random.gamma(averages, 1.0 / averages, 128)
    return Resonance(frequency_khz=khz, amplitude=np.sqrt(drawn), amplitude_unit=DENSITY, averages=averages)


def run(*arguments: object):
    return CliRunner().invoke(main, ["calibrate", *(str(argument) for argument in arguments)])


def test_the_residuals_squared_are_the_gamma_likelihood():
    # apart from what does not depend on the model
    ratio = np.array([0.02, 0.3, 0.9995, 1.0, 1.0 + 1e-7, 1.2, 7.0])
    averages, measured = 30.0, 2.0
    likelihood = gamma.logpdf(measured, averages, scale=measured / ratio / averages)
    best = gamma.logpdf(measured, averages, scale=measured / averages)
    root = np.asarray(deviance_root(ratio))
    np.testing.assert_allclose(averages * root**2, 2.0 * (best - likelihood), rtol=1e-9, atol=2e-13)
    assert np.all(np.sign(root) == np.sign(ratio - 1.0))
    exact = [float(mpmath.sqrt(2 * (mpmath.mpf(u) - 1 - mpmath.log(u)))) for u in (1.00099, 1.00101)]
    np.testing.assert_allclose(np.asarray(deviance_root(np.array([1.00099, 1.00101]))), exact, rtol=1e-9)


def test_the_hydrodynamic_function_is_that_of_a_cylinder_times_saders_correction():
    for reynolds in (0.01, 1.0, 28.0, 1000.0):
        root = mpmath.sqrt(1j * mpmath.mpf(reynolds))
        turned = mpmath.mpc(0, -1) * root
        cylinder = 1 + 4j * mpmath.besselk(1, turned) / (root * mpmath.besselk(0, turned))
        correction = hydrodynamic_function(np.array(reynolds)) / complex(cylinder)
        # between a flat plate and a cylinder there is at most a tenth
        assert abs(complex(correction) - 1.0) < 0.12
    # Maali et al. 2005: Im Gamma = 3.8018 d/b + 2.7364 (d/b)^2 with d = sqrt(2 eta/rho omega)
    # (a fit of theirs, good to some per cent here)
    for reynolds in (5.0, 28.0):
        share = np.sqrt(1.0 / (2.0 * reynolds))
        wanted = 3.8018 * share + 2.7364 * share**2
        assert np.imag(hydrodynamic_function(np.array(reynolds))) == pytest.approx(wanted, rel=0.03)


def test_air_has_the_tabulated_density_and_viscosity():
    # CRC handbook, dry air at 1013 hPa: 300 K
    assert air_at(300.0) == (pytest.approx(1.177, rel=2e-3), pytest.approx(1.846e-5, rel=5e-3))


def test_saders_stiffness_is_what_nanosurf_states_in_the_file():
    # the vendor's frequency and Q, the lever's nominal size (ACL-A, 225 x 40 um): their 27.13 N/m
    stated = sader(179.8, 442.0, 225.0, 40.0)
    assert stated == pytest.approx(27.13, rel=0.1)
    # in air at such speeds as b^1.5 or so: 2.5 % of the width
    assert sader(179.8, 442.0, 225.0, 41.0) / stated - 1.0 == pytest.approx(0.0375, rel=0.4)


@pytest.mark.parametrize(("quality", "points"), [(60, 128), (150, 400), (1000, 400)])
def test_a_line_of_three_points_hides_no_resonance(quality: float, points: int):
    khz = np.linspace(86.0, 94.0, points)
    power = density(khz, quality=quality) * np.random.default_rng(points).gamma(100.0, 0.01, points)
    line = points // 10
    power[line : line + 3] += 0.1 * power.max()
    sweep = Resonance(frequency_khz=khz, amplitude=np.sqrt(power), amplitude_unit=DENSITY, averages=100.0)
    result = calibrate(sweep)
    assert result.valid, result.reasons
    # 90 kHz to a tenth of the half-width
    assert abs(result.frequency_khz.value - FREQUENCY_KHZ) < 0.1 * 0.5 * FREQUENCY_KHZ / quality
    assert khz[line + 2] < result.sweep.frequency_khz[0]


@pytest.mark.parametrize("step_hz", [1.0, 0.5])
def test_the_area_gives_k_where_the_quality_factor_is_hardly_resolved(tmp_path: Path, step_hz: float):
    """A lever of 4.34 mN/m in vacuum, Q 9995 at 7972.49 Hz: 2,000 points, 32 averages; published 9995 +- 791."""
    hz, quality, natural, k = 7972.9 + step_hz * (np.arange(2000) - 1000.0), 9995.0, 7972.49, 4.34e-3
    # d = 1.09 x by the slope of a force curve, 0.971 of kT in the first mode
    variance = 1e18 * 0.971 / 1.09**2 * BOLTZMANN * 310.0 / k
    shape = natural**4 / ((natural**2 - hz**2) ** 2 + (hz * natural / quality) ** 2)
    power = 2.0 * variance / (np.pi * quality * natural) * shape + 1e-5
    drawn = power * np.random.default_rng(3).gamma(32.0, 1.0 / 32.0, hz.size)
    path = written(tmp_path / "spectrum.txt", 1e-3 * hz, drawn)
    result = run(path, "--json", "--averages", 32, "--temperature-k", 310)
    assert result.exit_code == 0, result.stderr
    told = strictly(result.stdout)
    found = told["spring_constant_n_per_m"]["equipartition"]
    assert abs(told["frequency_khz"]["value"] - 1e-3 * natural) < 4.0 * told["frequency_khz"]["standard_error"] < 1e-3
    assert abs(told["quality_factor"]["value"] - quality) < 3.0 * told["quality_factor"]["standard_error"] < 6000.0
    assert abs(found["value"] - k) < 3.0 * found["standard_error"] < k
    assert any("Q is hardly resolved" in warning for warning in told["warnings"])


def test_the_real_spectrum_meets_the_vendors_numbers(tmp_path):
    result = run(THERMAL, "--json", "--length-um", "225 +- 2", "--width-um", "40 +- 1")
    assert result.exit_code == 0, result.stderr
    told = strictly(result.stdout)
    assert told["valid"] is True
    assert told["frequency_khz"]["value"] == pytest.approx(179.8, rel=1e-3)
    assert told["quality_factor"]["value"] == pytest.approx(442.0, rel=0.05)
    stiffness = told["spring_constant_n_per_m"]
    assert stiffness["sader"]["value"] == pytest.approx(27.13, rel=0.1)
    # the deflection's own scale says less than half: it was not calibrated, and that is said
    assert stiffness["equipartition"]["value"] == pytest.approx(9.7, rel=0.05)
    assert stiffness["equipartition"]["standard_error"] is None
    # k goes with 1/<x^2>, and 27.13 is the vendor's
    times = re.search(r"are ([\d.]+) times the true ones", stiffness["equipartition"]["reason"])
    assert times is not None
    assert float(times[1]) == pytest.approx(np.sqrt(27.13 / 9.7), rel=0.03)
    assert any("Fitted from 178." in warning for warning in told["warnings"])
    # without the lever's size the instrument's own k tells as much, and no spring constant is left
    alone = run(THERMAL, "--json", "--out", tmp_path)
    assert alone.exit_code == 3
    assert "The spring constant is not calibrated" in alone.stderr
    told = strictly(alone.stdout)
    lone = told["spring_constant_n_per_m"]["equipartition"]
    assert (told["valid"], lone["standard_error"], lone["interval95"]) == (False, None, [None, None])
    assert told["quality_factor"]["standard_error"] > 0.0
    assert told["table_comments"] == []
    half = run(THERMAL, "--length-um", "225")
    assert half.exit_code == 2
    assert "needs both --length-um and --width-um" in half.stderr


@pytest.mark.slow
def test_intervals_hold_the_truth_as_often_as_they_say():
    random, draws = np.random.default_rng(11), 200
    # the whole of kT here: the oscillator is a point, not a lever's first mode
    wanted = np.array([FREQUENCY_KHZ, QUALITY_FACTOR, 0.971 * STIFFNESS_N_PER_M])
    held, apart = np.zeros(3), []
    for _ in range(draws):
        result = calibrate(
            thermal_spectrum(100.0, random), temperature_k=(WARM_K, None), static=False, scale_error=1e-9
        )
        found = (result.frequency_khz, result.quality_factor, result.spring_constant_n_per_m["equipartition"])
        low, high = np.array([one.interval95 for one in found], dtype=float).T
        held += (low < wanted) & (wanted < high)
        apart.append(np.array([one.value for one in found]) / wanted - 1.0)
    # 95 % of 200 is known to 1.5 %
    assert np.all((held / draws >= 0.92) & (held / draws <= 0.985)), held / draws
    # of the deflection's scale 5 % are assumed, which k has twice
    assumed = calibrate(thermal_spectrum(100.0, random), temperature_k=(WARM_K, None))
    assumed = assumed.spring_constant_n_per_m["equipartition"]
    assert (assumed.standard_error or 0.0) / assumed.value == pytest.approx(0.1, rel=0.1)
    assert np.all(np.abs(np.mean(apart, axis=0)) < 4.0 * np.std(apart, axis=0) / np.sqrt(draws))
