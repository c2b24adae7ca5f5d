"""Thermal spectra and stiffness: the likelihood, the real spectrum, Sader's method, slopes, and what intervals hold."""

from pathlib import Path
from typing import Any

import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from click.testing import CliRunner
from scipy.stats import gamma

from afm_jax.cli.main import main
from fitting import TableError, calibrate, equipartition, read_curves, read_sweep, sader, sensitivity
from fitting.calibration.calibrate import _windows
from fitting.calibration.model import deviance_root
from fitting.calibration.result import CalibratedValue, Calibration
from fitting.calibration.stiffness import BOLTZMANN, Stiffness, air_at, disagreement, hydrodynamic_function
from fitting.calibration.sweep import DENSITY, ResonanceSweep
from tests.strict_reading import strictly

REAL = Path(__file__).parent.parent / "fitting" / "examples" / "real"
THERMAL, FORCES = REAL / "thermal_nanosurf.nid", REAL / "tapping_normal_force_wsxm.f.curves"
FREQUENCY_KHZ, QUALITY_FACTOR, STIFFNESS_N_PER_M, WARM_K = 90.0, 150.0, 5.4, 300.0


def density(khz: np.ndarray, floor: float = 2e-8, quality: float = QUALITY_FACTOR) -> np.ndarray:
    """Return the one-sided density (nm^2/Hz) of an oscillator in thermal motion, from Langevin's equation."""
    variance = 1e18 * BOLTZMANN * WARM_K / STIFFNESS_N_PER_M
    hz, natural = 1e3 * khz, 1e3 * FREQUENCY_KHZ
    shape = natural**4 / ((natural**2 - hz**2) ** 2 + (hz * natural / quality) ** 2)
    return 2.0 * variance / (np.pi * quality * natural) * shape + floor


def thermal_spectrum(averages: float, random: np.random.Generator, *, points: int = 128, known: bool = True):
    khz = np.linspace(86.0, 94.0, points)
    drawn = density(khz) * random.gamma(averages, 1.0 / averages, points)
    count = averages if known else None
    return ResonanceSweep(frequency_khz=khz, amplitude=np.sqrt(drawn), amplitude_unit=DENSITY, averages=count)


def run(*arguments: object):
    return CliRunner().invoke(main, ["calibrate", *(str(argument) for argument in arguments)])


def test_the_residuals_squared_are_the_gamma_likelihood():
    # apart from what does not depend on the model
    ratio = np.array([0.02, 0.3, 0.9995, 1.0, 1.0 + 1e-7, 1.2, 7.0])
    averages, measured = 30.0, 2.0
    likelihood = gamma.logpdf(measured, averages, scale=measured / ratio / averages)
    best = gamma.logpdf(measured, averages, scale=measured / averages)
    root = np.asarray(deviance_root(jnp.asarray(ratio)))
    np.testing.assert_allclose(averages * root**2, 2.0 * (best - likelihood), rtol=1e-9, atol=2e-13)
    assert np.all(np.sign(root) == np.sign(ratio - 1.0))
    exact = [float(mpmath.sqrt(2 * (mpmath.mpf(u) - 1 - mpmath.log(u)))) for u in (1.00099, 1.00101)]
    np.testing.assert_allclose(np.asarray(deviance_root(jnp.array([1.00099, 1.00101]))), exact, rtol=1e-9)


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


def calibrated(frequency: float, quality: float) -> Calibration:
    """Return what `sader` asks of a calibration, without a fit."""
    found = object.__new__(Calibration)
    for name, value in (("frequency_khz", frequency), ("quality_factor", quality)):
        object.__setattr__(found, name, CalibratedValue(value, 1e-3 * value, (None, None), None))
    return found


def test_saders_stiffness_is_what_nanosurf_states_in_the_file():
    # the vendor's frequency and Q, the lever's nominal size (ACL-A, 225 x 40 um): their 27.13 N/m
    stated = sader(calibrated(179.8, 442.0), length_um=(225.0, 0.0), width_um=(40.0, 0.0))
    assert stated.value.value == pytest.approx(27.13, rel=0.1)
    width = sader(calibrated(179.8, 442.0), length_um=(225.0, 0.0), width_um=(40.0, 1.0)).value
    assert width.standard_error is not None
    # in air at such speeds as b^1.5 or so: 2.5 % of the width
    assert width.standard_error / width.value == pytest.approx(0.025, rel=0.4)


def test_spring_constants_that_differ_are_pointed_out():
    def told(stated: float | None = None, **values: float) -> str | None:
        found = {method: CalibratedValue(value, 0.01 * value, (None, None), None) for method, value in values.items()}
        return disagreement([Stiffness(method, value, ()) for method, value in found.items()], stated)

    assert told() is None
    assert told(equipartition=9.7) is None
    assert told(27.13, equipartition=26.0) is None
    # k goes with 1/<x^2>: sqrt(27.13/9.7) = 1.67
    assert "1.67 times the true ones" in (told(27.13, equipartition=9.7) or "")
    # where Sader's method was used, it is the one to compare with
    assert told(9.7, equipartition=26.0, Sader=27.0) is None


def test_the_sensitivity_is_the_slope_of_the_rows_in_contact(tmp_path):
    curves = read_curves(FORCES)
    found = sensitivity(curves)
    slopes = []
    for curve in curves:
        for branch in ("approach", "retract"):
            rows = (curve.branch == branch) & (curve.offset_nm > 13.0)
            slopes.append(np.polyfit(curve.offset_nm[rows], np.asarray(curve.deflection)[rows], 1)[0])
    # the last 2 of some 5 nm in contact, fitted apart
    assert found.value.value == pytest.approx(1.0 / np.mean(slopes), rel=0.08)
    low, high = found.value.interval95
    assert (low or np.inf) < found.value.value < (high or 0.0)
    told = run(FORCES, "--slope", "--json", "--out", tmp_path)
    assert told.exit_code == 0, told.stderr
    assert strictly(told.stdout)["deflection_nm_per_volt"]["value"] == found.value.value
    assert strictly((tmp_path / "calibration.json").read_text()) == strictly(told.stdout)
    assert (tmp_path / "calibration.png").exists()
    assert run(THERMAL, "--slope").exit_code == 2
    assert "`afm-jax calibrate --slope` reads the sensitivity" in run(FORCES).stderr
    with pytest.raises(TableError, match="no deflection in V"):
        sensitivity(read_curves(REAL / "tapping_amplitude_wsxm.f.curves"))


def test_spectra_are_read_from_csv(tmp_path):
    khz = np.linspace(80.0, 100.0, 30)
    path, head = tmp_path / "spectrum.csv", "# averages = 200\nfrequency_hz,psd_nm2_per_hz"
    np.savetxt(path, np.stack([1e3 * khz, density(khz)], 1), "%.17g", ",", header=head, comments="")
    sweep = read_sweep(path)
    assert (sweep.averages, sweep.spectrum) == (200.0, True)
    np.testing.assert_allclose(sweep.amplitude**2, density(khz), rtol=1e-14)
    cut = tmp_path / "cut.nid"
    cut.write_bytes(THERMAL.read_bytes()[:-8])
    with pytest.raises(TableError, match="announces 66952 bytes"):
        read_sweep(cut)


@pytest.mark.parametrize(("quality", "points"), [(60, 128), (150, 400), (1000, 400)])
def test_a_line_of_three_points_hides_no_resonance(quality: float, points: int):
    khz = np.linspace(86.0, 94.0, points)
    power = density(khz, quality=quality) * np.random.default_rng(points).gamma(100.0, 0.01, points)
    line = points // 10
    power[line : line + 3] += 0.1 * power.max()
    sweep = ResonanceSweep(frequency_khz=khz, amplitude=np.sqrt(power), amplitude_unit=DENSITY, averages=100.0)
    parts = _windows(sweep)
    assert all(part.frequency_khz[0] < FREQUENCY_KHZ < part.frequency_khz[-1] for part in parts)
    assert khz[line + 2] < parts[-1].frequency_khz[0]


@pytest.mark.slow
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
    assert "are 1.65 times the true ones" in told["note"]
    assert any("Fitted from 178.5" in warning for warning in told["warnings"])
    assert {row["quantity"] for row in told["budget"]} >= {"quality_factor", "spring_constant_n_per_m (Sader)"}
    # without the lever's size the instrument's own k tells as much, and no spring constant is left
    alone = run(THERMAL, "--json", "--out", tmp_path)
    assert alone.exit_code == 3
    assert "The spring constant is not calibrated." in alone.stderr
    assert "#spring_constant" not in (tmp_path / "calibration.txt").read_text("utf-8").replace(" ", "")
    told = strictly(alone.stdout)
    lone = told["spring_constant_n_per_m"]["equipartition"]
    assert (told["valid"], lone["standard_error"], lone["interval95"]) == (False, None, [None, None])
    assert told["quality_factor"]["standard_error"] > 0.0
    half = run(THERMAL, "--length-um", "225")
    assert half.exit_code == 2
    assert "needs both --length-um and --width-um" in half.stderr


@pytest.mark.slow
@pytest.mark.parametrize("known", [True, False])
def test_intervals_hold_the_truth_as_often_as_they_say(known):
    random, draws = np.random.default_rng(11), 200 if known else 80
    # the whole of kT here: the oscillator is a point, not a lever's first mode
    wanted = np.array([FREQUENCY_KHZ, QUALITY_FACTOR, 0.971 * STIFFNESS_N_PER_M])
    held, apart = np.zeros(3), []
    result: Any = None
    for _ in range(draws):
        result = calibrate(thermal_spectrum(100.0, random, known=known), background="floor", compare=False, whole=True)
        assert result.explained
        stiffness = equipartition(result, temperature_k=(WARM_K, 0.0), static=False, scale_error=0.0).value
        found = (result.frequency_khz, result.quality_factor, stiffness)
        low, high = np.array([one.interval95 for one in found], dtype=float).T
        held += (low < wanted) & (wanted < high)
        apart.append(np.array([one.value for one in found]) / wanted - 1.0)
    # 95 % of 200 is known to 1.5 %
    low, high = (0.92, 0.985) if known else (0.88, 1.0)
    assert np.all((held / draws >= low) & (held / draws <= high)), held / draws
    # of the deflection's scale 5 % are assumed, which k has twice
    assumed = equipartition(result, temperature_k=(WARM_K, 0.0)).value
    assert (assumed.standard_error or 0.0) / assumed.value == pytest.approx(0.1, rel=0.1)
    assert np.all(np.abs(np.mean(apart, axis=0)) < 4.0 * np.std(apart, axis=0) / np.sqrt(draws))
