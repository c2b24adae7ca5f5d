"""Simulated experiments: tables of the full contact, and of a law whose orbits are known in closed form."""

import numpy as np
import pytest

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.contact.contact import Contact
from afm_jax.impact.law import CollisionDelay, ImpactLaw
from fitting.examples.make_contact_amplitudes import EXAMPLE
from fitting.simulated.experiment import Drives, drives_of, simulate_experiment, with_noise
from fitting.tables.table import read_table
from tests.contact_experiment import paper_experiment
from tests.fit_tables import steady_readings

pytestmark = pytest.mark.slow
"""Each compiles programs of its own for a minute or more."""

MEASURED = ("peak_amplitude_nm", "lockin_amplitude_nm", "phase_deg")
ROWS = ((1, 177.3, 4.0, 1.0), (1, 180.0, 4.0, 0.0), (2, 349.2, 4.0, -1.0), (3, 545.4, 4.0, 0.0))
LAW = ImpactLaw(0.97, 60.0, 0.3, CollisionDelay(0.2, 5.6, 0.6))


@pytest.fixture(scope="module")
def of_a_law():
    return simulate_experiment(LAW, Cantilever(90.0, 40.0), drives_of(ROWS), phase_noise_deg=0.1)


def test_bundled_table_is_what_its_script_makes():
    bundled, made = read_table(EXAMPLE), paper_experiment().table
    assert bundled.rows == made.rows == 57
    assert bundled.quality_factor_error == 0.5
    for name in (*MEASURED, "order", "drive_frequency_khz", "drive_amplitude_nm", "offset_nm"):
        # six digits are written, and another machine may round the last of them the other way
        np.testing.assert_allclose(getattr(bundled, name), getattr(made, name), rtol=2e-5)
    # drives without an orbit are named
    assert len(paper_experiment().left_out) == 3
    assert any(said.startswith("order 2, 349.2 kHz, 2 nm, offset 1 nm: ") for said in paper_experiment().left_out)


def test_contact_amplitudes_agree_with_an_independent_program(contact_table_path):
    other = read_table(contact_table_path)
    # as many rows as are simulated side by side, of every order
    chosen = np.arange(2, other.rows, 6)[:16]
    columns = (other.order, other.drive_frequency_khz, np.asarray(other.drive_amplitude_nm), other.offset_nm)
    drives = Drives(*(column[chosen] for column in columns))
    found = simulate_experiment(Contact.paper(), Cantilever(90.0, 40.0), drives)
    assert found.left_out == ()
    for name in ("peak_amplitude", "lockin_amplitude"):
        error = getattr(other, f"{name}_error_nm")[chosen]
        apart = (getattr(other, f"{name}_nm")[chosen] - getattr(found.exact, f"{name}_nm")) / error
        # chi2 of 16 numbers with 1 % noise: 99.9 % lie below 39; a bias of 1 % would add 16
        assert 4.0 < np.sum(apart**2) < 39.0
        # a mean of 16 normal numbers has the standard deviation 1/4
        assert abs(np.mean(apart)) < 0.9


def test_amplitudes_of_a_law_are_those_of_its_orbits_in_closed_form(of_a_law):
    exact = of_a_law.exact
    assert of_a_law.left_out == ()
    expected = steady_readings(zip(*ROWS, strict=True), LAW)
    for name, column in zip(MEASURED, expected.T, strict=False):
        # motions are followed to 1e-9 and settle to 1e-6
        np.testing.assert_allclose(getattr(exact, name), column, rtol=1e-6)


def test_noise_has_the_size_that_the_table_states(of_a_law):
    exact = of_a_law.exact
    draws = np.random.default_rng(3).normal(size=(500, 3, exact.rows))
    noisy = [with_noise(exact, draw) for draw in draws]
    for name in MEASURED:
        kind, unit = name.rsplit("_", 1)
        apart = np.array([getattr(table, name) for table in noisy]) - getattr(exact, name)
        # of 500 draws the standard deviation is known to 3 %; rounding to six digits adds nothing
        np.testing.assert_allclose(apart.std(axis=0), getattr(exact, f"{kind}_error_{unit}"), rtol=0.15)
