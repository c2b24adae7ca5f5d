"""Fits of impacts that last: tables of the full contact, made by this program and by another one."""

import numpy as np
import pytest

from fitting import fit, read_table
from fitting.examples.make_contact_amplitudes import EXAMPLE
from fitting.infer.fit import model_of
from fitting.infer.result import FitResult
from fitting.infer.rows import plain_weights, weights_of
from fitting.infer.search import Followed, orbits_at
from fitting.infer.unknowns import Model
from fitting.models import task_of
from fitting.tables.table import AmplitudeTable
from tests.contact_experiment import paper_collisions, paper_experiment
from tests.fit_tables import holds

pytestmark = pytest.mark.slow
PAPER = {"adhesion_energy_j_per_m2": 0.3, "relative_humidity": 0.5, "viscosity_pa_s": 1.005e-3, "modulus_gpa": 100.0}
SLOWEST, FASTEST = 30.0, 200.0


def law_error(result: FitResult, **changes: float) -> float:
    """Return the worst relative error of the fitted rebound speed against free tips at the paper's contact."""
    speeds = result.law.approach_speed_nm_per_us
    wanted = (speeds >= SLOWEST) & (speeds <= FASTEST)
    assert wanted.sum() > 30
    # of all speeds, whatever is wanted of them: one shape is one program
    exact, _ = paper_collisions(np.clip(speeds, SLOWEST, FASTEST), **changes)
    return float(np.abs(result.law.rebound_speed_nm_per_us / exact - 1.0)[wanted].max())


def per_degree(result: FitResult) -> float:
    return result.chi2 / result.degrees_of_freedom


@pytest.fixture(scope="module")
def shared(contact_table_path) -> AmplitudeTable:
    return read_table(contact_table_path)


@pytest.fixture(scope="module")
def viscous(shared) -> FitResult:
    return fit(shared, model="viscous+delay")


def model_for(table: AmplitudeTable, name: str) -> Model:
    """Return what is unknown of a table by a model."""
    return model_of(table, task_of(table, name), {"fixed": {}, "held": ()})


def at(model: Model, values: dict[str, float]) -> np.ndarray:
    """Return the unknowns at a law's parameters, the instrument as the table says."""
    theta = np.zeros(len(model.names))
    theta[: len(model.law.own)] = [model.law.unknown_of(name, values[name]) for name in model.law.own]
    return theta


@pytest.mark.long
def test_the_papers_contact_predicts_the_tables_of_two_programs(shared):
    for table in (shared, read_table(EXAMPLE)):
        model = model_for(table, "contact")
        theta = at(model, PAPER)
        found = orbits_at(model, theta)
        weights = weights_of(model, theta, found.orbits, np.zeros(table.rows, bool))
        used = weights.used[:, :2].all(axis=1)
        assert np.sum(~used) <= 3
        off = np.where(weights.used, found.orbits.readings - model.data.read, 0.0)
        square = np.sum(np.einsum("nij,nj->ni", weights.whitening, off) ** 2)
        count = float(weights.used.sum())
        # chi2 of as many readings has this width; 1 % of noise, nothing fitted
        assert abs(square - count) < 4.0 * np.sqrt(2.0 * count)


def test_viscous_law_and_delay_read_the_contact_off_the_shared_table(viscous):
    assert viscous.valid
    assert law_error(viscous) < 0.0035
    assert 0.75 < per_degree(viscous) < 1.3
    # twice the hysteresis over the mass
    assert holds(viscous.parameters["epsilon"], 2.0 * 55.75)
    speeds = viscous.law.approach_speed_nm_per_us
    inside = (speeds > SLOWEST) & (speeds < FASTEST)
    delay = paper_collisions(speeds[inside])[1]
    # the law of the delay fits to 1 ns
    np.testing.assert_allclose(viscous.law.collision_delay_us[inside], delay, rtol=0, atol=2e-3)


def test_orbits_that_would_grow_cost_and_chi2_has_the_slope_of_its_gradient():
    """A drag that gives: determinants are those of the map's own Jacobian, and chi2's slopes those of differences."""
    table = read_table(EXAMPLE)
    model = model_for(table, "viscous+delay")
    delay = {"delay_hertz": 0.2, "delay_lead_nm": 5.0, "delay_offset_nm": 0.0}
    theta = at(model, delay | {"epsilon": 100.0, "viscous_loss": -10.0})
    found = orbits_at(model, theta)
    growing = found.exists & (found.number == 0)
    assert 5 < growing.sum() < found.exists.sum() - 5
    np.testing.assert_array_equal(found.orbits.determinant[found.exists] > 1.0, growing[found.exists])
    weights = plain_weights(model.data, 0.3, np.zeros(table.rows, bool))
    rows = Followed(model, theta, found.orbits, weights, np.inf)
    here = rows.sum(theta)
    cost = here.residual[3 * table.rows : 4 * table.rows]
    assert cost[growing].min() > 3.0
    assert cost[found.orbits.determinant < 0.98].max() < 1e-6
    for i in range(theta.size):
        step = 1e-5 * np.eye(theta.size)[i]
        slope = (rows.sum(theta + step).value - rows.sum(theta - step).value) / 2e-5
        assert 2.0 * here.jacobian[:, i] @ here.residual == pytest.approx(slope, rel=1e-4, abs=1e-3)


def test_the_contact_is_read_off_the_shared_table(shared):
    result = fit(shared, model="contact")
    assert law_error(result) < 0.0035
    assert 0.75 < per_degree(result) < 1.3
    for name, truth in PAPER.items():
        parameter = result.parameters[name]
        assert abs(parameter.value - truth) < 4.0 * (parameter.standard_error or 0.0)


@pytest.mark.long
def test_without_noise_the_law_is_sharp():
    result = fit(paper_experiment().exact, model="contact")
    assert law_error(result) < 0.0012
