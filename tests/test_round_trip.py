"""From amplitudes to a law and back: the law of a fit in a scene gives the amplitudes that the fit predicts.

The bundled table is of the full contact, which no formula of the fitted family is.
"""

import json
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import afm_jax as afm
from afm_jax.motion.observe import observe
from fitting import fit, read_table
from fitting.examples.make_contact_amplitudes import EXAMPLE
from tests.contact_experiment import paper_collisions

pytestmark = pytest.mark.slow
KEY = jax.random.key(4)


@pytest.fixture(scope="module")
def result():
    return fit(read_table(EXAMPLE), "law+delay")


@pytest.fixture(scope="module")
def rows(result):
    return np.flatnonzero(result.rows.used)


@pytest.fixture(scope="module")
def orbits(result, rows):
    """All orbits of the used rows with the fitted instrument: of the law, and of five samples of it."""
    table = result.table
    known = {name: one.value for name, one in result.parameters.items()}
    assert set(known) <= {"r", "epsilon", "delay_hertz", "delay_lead_nm", "delay_offset_nm", "quality_factor"}
    cantilever = afm.Cantilever(table.free_frequency_khz, known["quality_factor"], table.mass_ng)
    law = result.law.moved(np.zeros(result.law.unknowns))
    laws = jax.tree.map(lambda one, more: jnp.append(one[None], more, axis=0), law, result.law.sample(KEY, 5))

    def one(law, frequency, amplitude, offset, order):
        platform = afm.Platform(amplitude, frequency, offset)
        return afm.single_impact_orbits(afm.Scene(cantilever, platform, law), order)

    of_rows = jax.vmap(one, in_axes=(None, 0, 0, 0, 0))
    columns = (table.drive_frequency_khz, table.drive_amplitude_nm, table.offset_nm, table.order.astype(float))
    return jax.jit(jax.vmap(of_rows, in_axes=(0, None, None, None, None)))(
        laws, *(jnp.asarray(column[rows]) for column in columns)
    )


def test_orbits_of_a_scene_with_the_law_are_the_rows_predictions(result, rows, orbits):
    assert result.valid
    readings = np.stack([orbits.peak_amplitude_nm[0], orbits.lockin_amplitude_nm[0]], axis=2)
    apart = np.abs(readings / result.rows.predicted_nm[rows][:, None] - 1.0).max(axis=2)
    steady = np.asarray(orbits.exists & orbits.stable & orbits.admissible)[0]
    same = steady & (apart < 1e-6)
    assert same.any(axis=1).all()
    speeds = np.where(same, np.asarray(orbits.approach_speed_nm_per_us[0]), 0.0).max(axis=1)
    np.testing.assert_allclose(speeds, result.rows.approach_speed_nm_per_us[rows], rtol=1e-6)


def test_residuals_and_chi2_are_those_of_the_predictions(result):
    rows = result.rows
    residual = (rows.predicted_nm - rows.measured_nm) / rows.error_nm
    np.testing.assert_allclose(rows.residual[:, :2], residual, rtol=1e-9, atol=1e-9)
    # what rows have in common is no residual of theirs: it makes the sum of squares larger than chi2, never smaller
    table = result.table
    errors = np.stack([table.peak_amplitude_error_nm, table.lockin_amplitude_error_nm], axis=1)
    assert result.chi2 < 1.5 * np.nansum(((rows.predicted_nm - rows.measured_nm) / errors)[rows.used] ** 2)
    assert 0.8 < result.chi2 / result.degrees_of_freedom < 1.2


def test_a_simulation_with_the_law_reads_the_predicted_amplitudes(result):
    table, rows = result.table, result.rows
    row = int(np.flatnonzero(rows.used & (table.order == 1))[0])
    scene = afm.Scene(
        afm.Cantilever(table.free_frequency_khz, result.parameters["quality_factor"].value, table.mass_ng),
        afm.Platform(table.drive_amplitude_nm[row], table.drive_frequency_khz[row], table.offset_nm[row]),
        result.law,
    )
    orbits = afm.single_impact_orbits(scene, 1)
    near = int(np.nanargmin(np.abs(np.asarray(orbits.peak_amplitude_nm) - rows.predicted_nm[row, 0])))
    omega = 2e-3 * np.pi * table.drive_frequency_khz[row]
    phase = float(orbits.phase_rad[near])
    height = table.offset_nm[row] + table.drive_amplitude_nm[row] * np.cos(phase)
    start = afm.State(phase / omega, height, float(orbits.velocity_after_nm_per_us[near]))
    found = observe(scene, afm.simulate(scene, start, duration_us=2000.0))
    assert found.lockin_amplitude_nm == pytest.approx(rows.predicted_nm[row, 1], rel=1e-4)


def test_the_law_and_its_samples_hold_the_contacts_law(result):
    law = result.law
    u = np.geomspace(30.0, 200.0, 30)
    truth = paper_collisions(u)[0]
    found = np.asarray(law.rebound_speed(u))
    drawn = np.asarray(jax.vmap(lambda one: one.rebound_speed(u))(law.sample(jax.random.key(3), 200)))
    low, high = np.quantile(drawn, [0.025, 0.975], axis=0)
    assert np.mean((low < truth) & (truth < high)) > 0.9
    assert np.abs(found / truth - 1.0).max() < 5e-3
    # the samples are as wide as the band that is printed
    half = np.interp(u, law.approach_speed_nm_per_us, law.rebound_high_nm_per_us - law.rebound_speed_nm_per_us)
    np.testing.assert_allclose(1.96 * drawn.std(axis=0), half, rtol=0.15)


def test_samples_of_the_law_are_a_band_of_amplitudes_that_holds_what_was_measured(result, rows, orbits):
    steady = np.asarray(orbits.exists & orbits.stable & orbits.admissible)[1:]
    peak = np.where(steady, np.asarray(orbits.peak_amplitude_nm)[1:], np.inf)
    predicted, measured, error = (
        column[rows, 0] for column in (result.rows.predicted_nm, result.rows.measured_nm, result.rows.error_nm)
    )
    near = np.argmin(np.abs(peak - predicted[:, None]), axis=2)
    nearest = np.take_along_axis(peak, near[..., None], axis=2)[..., 0]
    seen = np.isfinite(nearest).all(axis=0) & np.isfinite(measured)
    assert seen.mean() > 0.9
    spread = np.hypot(nearest.std(axis=0), error)
    assert np.mean((np.abs(measured - nearest.mean(axis=0)) < 2.5 * spread)[seen]) > 0.9


def test_the_law_comes_back_from_the_fits_file(result, tmp_path):
    path = tmp_path / "fit.json"
    path.write_text(json.dumps(result.to_dict(), allow_nan=False), encoding="utf-8")
    law = afm.load_law(path)
    u = np.geomspace(15.0, 400.0, 50)
    np.testing.assert_allclose(law.rebound_speed(u), result.law.rebound_speed(u), rtol=1e-9)
    np.testing.assert_allclose(law.collision_delay(u), result.law.collision_delay(u), rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose(law.capture_speed_nm_per_us, result.law.capture_speed_nm_per_us, rtol=1e-12)
    key = jax.random.key(5)
    one, other = (each.sample(key, 3) for each in (law, result.law))
    drawn = [np.asarray(jax.vmap(lambda law: law.rebound_speed(u))(each)) for each in (one, other)]
    np.testing.assert_allclose(*drawn, rtol=1e-7)
    assert bool(law.extrapolated(5.0))
    assert not bool(law.extrapolated(50.0))


def test_an_instantaneous_law_is_the_formula():
    result = fit(read_table(EXAMPLE.with_name("amplitudes_law.csv")), "law")
    r, epsilon = (result.parameters[name].value for name in ("r", "epsilon"))
    u = np.geomspace(1.05 * float(result.law.capture_speed_nm_per_us), 1e3, 50)
    np.testing.assert_allclose(result.law.rebound_speed(u), np.sqrt((r * u) ** 2 - epsilon), rtol=1e-9)
    assert result.law.delay is None
    table: Any = result.table
    row = int(np.flatnonzero(result.rows.used)[0])
    scene = afm.Scene(
        afm.Cantilever(table.free_frequency_khz, result.parameters["quality_factor"].value, table.mass_ng),
        afm.Platform(table.drive_amplitude_nm[row], table.drive_frequency_khz[row], table.offset_nm[row]),
        result.law,
    )
    orbits = afm.single_impact_orbits(scene, int(table.order[row]))
    apart = np.abs(np.asarray(orbits.peak_amplitude_nm) / result.rows.predicted_nm[row, 0] - 1.0)
    assert np.nanmin(apart) < 1e-6
