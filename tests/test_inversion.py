"""Direct inversion of amplitudes and phases, against collisions of free tips and orbits in closed form."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from afm_jax.impact.law import ImpactLaw, TabulatedLaw
from fitting.inversion.flight import _best_ends, _look
from fitting.inversion.invert import invert
from fitting.simulated.experiment import with_noise
from fitting.tables.table import AmplitudeTable
from tests.contact_experiment import paper_collisions, paper_experiment
from tests.fit_tables import steady_readings, table_of

pytestmark = pytest.mark.slow
"""Each compiles programs of its own for a minute or more."""

SPEEDS = np.geomspace(30.0, 200.0, 60)


@pytest.fixture(scope="module")
def exact():
    return invert(paper_experiment().exact)


def noisy(seed: int, phase_deg: float) -> AmplitudeTable:
    """Return the bundled drives with 1 % noise, a phase error, and Q exactly known."""
    table = paper_experiment().exact
    errors = {"phase_error_deg": np.full(table.rows, phase_deg), "quality_factor_error": None}
    table = dataclasses.replace(table, **errors, remarks=())
    return with_noise(table, np.random.default_rng(seed).normal(size=(3, table.rows)))


def worst_law_error(result) -> float:
    # the curve, between and beyond the rows' speeds
    found = {name: one.value for name, one in result.laws[result.preferred or "viscous"].parameters.items()}
    r, viscous_loss = found.get("r", 1.0), found.get("viscous_loss", 0.0)
    rebound = np.sqrt((r * SPEEDS) ** 2 - viscous_loss * SPEEDS - found["epsilon"])
    return float(np.max(np.abs(rebound / paper_collisions(SPEEDS)[0] - 1.0)))


def law_table(law: ImpactLaw, quality_factor: float | None, rows) -> tuple[AmplitudeTable, np.ndarray]:
    """Return the amplitudes of a law's orbits, with 1 % and 0.1 degree as errors, and their speeds, shape (rows, 2)."""
    drives = np.array(rows).T
    readings = steady_readings(drives, law, quality_factor)
    phase = {"phase_deg": readings[:, 2], "phase_error_deg": np.full(len(rows), 0.1)}
    amplitude = readings[:, :2]
    return table_of(drives, amplitude, 0.01 * amplitude, quality_factor=quality_factor, **phase), readings[:, 3:]


LAW_ROWS = [
    (1, 177.3, 4.0, 1.0),
    (1, 180.0, 4.0, 0.0),
    (1, 183.6, 4.0, 0.0),
    (2, 349.2, 4.0, -1.0),
    (3, 545.4, 4.0, 0.0),
]


@pytest.mark.parametrize(("quality_factor", "count"), [(500.0, 5), (None, 4)])
def test_orbits_without_delay_are_inverted_exactly(quality_factor, count):
    table, speeds = law_table(ImpactLaw(0.95, 60.0), quality_factor, LAW_ROWS[:count])
    found = invert(table)
    # closed forms on both sides, nothing to correct for an impact that takes no time
    np.testing.assert_allclose(found.rows.impact[:, :2], speeds, rtol=1e-7)
    np.testing.assert_allclose(found.rows.impact[:, 2], 0.0, atol=1e-8)
    assert np.all(found.rows.chi2 < 1e-9)


def test_one_amplitude_and_the_phase_suffice():
    table, speeds = law_table(ImpactLaw(0.95, 60.0), 40.0, LAW_ROWS)
    peak = dataclasses.replace(table, lockin_amplitude_nm=None, lockin_amplitude_error_nm=None)
    lockin = dataclasses.replace(table, peak_amplitude_nm=None, peak_amplitude_error_nm=None)
    for some in (peak, lockin):
        found = invert(some)
        np.testing.assert_allclose(found.rows.impact[:, :2], speeds, rtol=1e-7)  # closed forms on both sides
        assert np.all(np.isnan(found.rows.chi2))


def test_noise_free_contact_gives_the_free_collision(exact):
    """Compare with free tips on a sample at rest: another program than the driven scene behind the amplitudes."""
    assert exact.rows.inverted.all()
    impact = exact.rows.impact[exact.rows.impact[:, 0] > 30.0]
    rebound, delay = paper_collisions(impact[:, 0])
    # what the corrections for a moving sample leave: most where the drive is weak and the tip slow
    for apart, most in ((np.abs(impact[:, 1] / rebound - 1.0), 5e-4), (np.abs(impact[:, 2] - delay), 1e-3)):
        assert np.median(apart) < 2e-5
        assert np.max(apart) < most
    # and so do the laws
    assert exact.preferred == "viscous"
    assert worst_law_error(exact) < 1e-3
    # as fitted to free collisions, physics.md: 113.6 and 0.50; their values depend on the weights
    parameters = exact.laws["viscous"].parameters
    assert parameters["epsilon"].value == pytest.approx(113.6, rel=0.02)
    assert parameters["viscous_loss"].value == pytest.approx(0.50, rel=0.1)
    slow = exact.rows.inverted & ~exact.rows.regressed
    assert slow.any()
    assert np.all(exact.rows.impact[slow, 0] < 27.0)


def test_laws_of_noisy_tables_are_close_and_error_bars_mean_what_they_say():
    pulls, errors = [], []
    for seed in range(12):
        result = invert(noisy(100 + seed, 0.1))
        assert result.valid
        errors.append(worst_law_error(result))
        rows, used = result.rows, result.rows.regressed
        u, step = rows.impact[used, 0], 0.01
        truth, lower, upper = (np.stack(paper_collisions(at)) for at in (u, u - step, u + step))
        # an error of u moves the truth along its curve
        along = np.zeros((2, u.size, 3))
        along[..., 0] = -(upper - lower) / (2.0 * step)
        along[0, :, 1] = along[1, :, 2] = 1.0
        variance = np.einsum("kni,nij,knj->kn", along, rows.covariance[used], along)
        pulls.append((rows.impact[used, 1:].T - truth) / np.sqrt(variance))
    assert np.median(errors) < 1e-3
    assert max(errors) < 1.5e-3
    found = np.concatenate(pulls, axis=1)
    # 650 pulls: the standard deviation is known to 3 %, the mean to 0.04
    np.testing.assert_allclose(found.std(axis=1), 1.0, atol=0.12)
    np.testing.assert_allclose(found.mean(axis=1), 0.0, atol=0.2)


def test_a_wrong_quality_factor_is_covered_by_its_error():
    table = dataclasses.replace(paper_experiment().exact, quality_factor=40.8, quality_factor_error=0.8)
    found = invert(table)
    # off by one standard error: the regression finds it, and the rows move by the systematic error they state
    assert found.laws["viscous"].pulls["quality_factor"] == pytest.approx(-1.0, abs=0.25)
    true = invert(dataclasses.replace(table, quality_factor=40.0)).rows
    shift = np.abs(found.rows.impact - true.impact)
    # to first order in 2 % of Q
    np.testing.assert_allclose(found.rows.systematic_errors[:, 1], shift[:, 1], rtol=0.1, atol=1e-4)
    epsilon = found.laws["viscous"].parameters["epsilon"]
    assert 0.0 < (epsilon.systematic_error or 0.0) < (epsilon.standard_error or 0.0)


def test_calibration_of_the_instrument_is_taken_back(exact):
    table = paper_experiment().exact
    names = [f"{kind}_amplitude{error}_nm" for kind in ("peak", "lockin") for error in ("", "_error")]
    read = {name: 1.02 * np.asarray(getattr(table, name)) for name in names}
    known = {"tip_calibration": (1.02, 0.01), "drive_calibration": (0.5, 0.005), "offset_origin_nm": (0.3, 0.1)}
    known["phase_zero_deg"] = (4.0, 0.2)
    other = dataclasses.replace(
        table,
        **read,
        drive_amplitude_nm=2.0 * np.asarray(table.drive_amplitude_nm, float),
        offset_nm=table.offset_nm - 0.3,
        phase_deg=np.asarray(table.phase_deg) + 4.0,
        calibration=known,
    )
    found = invert(other)
    # the same numbers but for rounding
    np.testing.assert_allclose(found.rows.impact, exact.rows.impact, rtol=1e-7)
    assert found.rows.shared_names == ("quality_factor", *known)


def test_a_contradictory_row_is_named_and_an_error_of_the_frequency_is_systematic():
    table = noisy(2, 0.1)
    peak = np.array(table.peak_amplitude_nm)
    peak[5] *= 1.1
    found = invert(dataclasses.replace(table, peak_amplitude_nm=peak), frequency_error_khz=0.02)
    assert found.rows.shared_names == ("free_frequency_khz",)
    assert np.all(found.rows.systematic_errors[:, 2] > 0.0)
    assert "contradict each other" in found.rows.note[5]
    assert any("contradict themselves" in warning for warning in found.warnings)


def test_reading_on_resonance_is_exact_where_its_assumptions_hold():
    """Compare with the closed form V' = W (1 + r)/(1 - r), W = beta omega: no damping, no adhesion, no delay."""
    r, drive, frequency = 0.9, 2.0, 180.0
    top = 2.0 * np.pi * 1e-3 * frequency * drive
    after = top * (1.0 + r) / (1.0 - r)
    peak = after / (2.0 * np.pi * 1e-3 * 90.0)
    amplitude = np.array([[peak, np.nan]])
    table = table_of(([1], [frequency], [drive], [0.0]), amplitude, 0.01 * amplitude, quality_factor=None)
    reading = invert(table, truth=ImpactLaw(r)).resonance
    # closed forms
    np.testing.assert_allclose(reading.approach_speed_nm_per_us, after + top, rtol=1e-12)
    np.testing.assert_allclose(reading.rebound_speed_nm_per_us, r * (after + top), rtol=1e-12)


def test_bias_of_the_reading_on_resonance_is_shown_against_the_truth(exact):
    truth = np.geomspace(12.0, 700.0, 128)
    table = dataclasses.replace(paper_experiment().exact, phase_deg=None, phase_error_deg=None)
    found = invert(table, truth=TabulatedLaw(truth, paper_collisions(truth)[0]))
    assert found.valid
    assert any("no phase" in warning for warning in found.warnings)
    reading = found.resonance
    np.testing.assert_array_equal(reading.row, exact.resonance.row)
    # of the regressed law and of the truth alike, the reading being off by 5 to 40 %
    np.testing.assert_allclose(reading.bias, exact.resonance.bias, atol=2e-3)
    assert np.all(reading.bias < -0.03)


def test_one_program_serves_tables_of_any_length():
    programs: tuple[Any, ...] = (_look.outside, _best_ends.outside)
    table, _ = law_table(ImpactLaw(0.95, 60.0), 40.0, LAW_ROWS)
    assert invert(table).valid
    before = [program._cache_size() for program in programs]
    assert invert(noisy(3, 0.1)).valid
    assert [program._cache_size() for program in programs] == before
