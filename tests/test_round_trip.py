"""From amplitudes to a law and back: the law of a fit in a scene gives the amplitudes that the fit predicts.

The bundled table is of the full contact, which no formula of the fitted family is.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import afm_jax as afm
from fitting import fit, read_table
from fitting.examples.make_contact_amplitudes import EXAMPLE
from tests.contact_experiment import paper_collisions

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def result():
    return fit(read_table(EXAMPLE), "law+delay")


def scene_of(result, row: int) -> afm.Scene:
    """Return the scene of a row with the fitted law and instrument."""
    table: Any = result.table
    return afm.Scene(
        afm.Cantilever(table.free_frequency_khz, result.parameters["quality_factor"].value, table.mass_ng),
        afm.Platform(table.drive_amplitude_nm[row], table.drive_frequency_khz[row], table.offset_nm[row]),
        result.law,
    )


def test_orbits_of_a_scene_with_the_law_are_the_rows_predictions(result):
    assert result.valid
    table, rows = result.table, np.flatnonzero(result.rows.used)

    def one(frequency, amplitude, offset, order):
        scene = dataclasses.replace(scene_of(result, 0), platform=afm.Platform(amplitude, frequency, offset))
        return afm.single_impact_orbits(scene, order)

    columns = (table.drive_frequency_khz, table.drive_amplitude_nm, table.offset_nm, table.order.astype(float))
    orbits = jax.jit(jax.vmap(one))(*(jnp.asarray(column[rows]) for column in columns))
    readings = np.stack([orbits.peak_amplitude_nm, orbits.lockin_amplitude_nm], axis=2)
    apart = np.abs(readings / result.rows.predicted_nm[rows][:, None] - 1.0).max(axis=2)
    steady = np.asarray(orbits.exists & orbits.stable & orbits.admissible)
    same = steady & (apart < 1e-6)
    assert same.any(axis=1).all()
    speeds = np.where(same, np.asarray(orbits.approach_speed_nm_per_us), 0.0).max(axis=1)
    np.testing.assert_allclose(speeds, result.rows.approach_speed_nm_per_us[rows], rtol=1e-6)


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
