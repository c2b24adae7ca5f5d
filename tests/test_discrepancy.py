"""What a law leaves out: the covariance of rows, printed parameters, runs of residuals, and the minimum of all."""

import dataclasses
from typing import Any

import numpy as np
import pytest
from scipy.optimize import least_squares

from fitting import fit
from fitting.infer.closest import closest_parameters
from fitting.infer.explain import Explained, run_of_residuals
from fitting.infer.fit import explained_of, model_of
from fitting.infer.rows import weights_of
from fitting.infer.search import Descent, Found, orbits_at
from fitting.infer.unknowns import no_orbits
from fitting.models import task_of
from fitting.parameters import DELAY_NAMES
from fitting.predict.law import SMOOTH, FormulaLaw
from tests.impact_tables import drives
from tests.made_fits import made_table

OWN = ("r", "epsilon", *DELAY_NAMES)
VALUES = dict(zip((*OWN, "viscous_loss"), (0.999, 113.6, 0.206, 5.64, 0.726, 0.4), strict=True))
ROWS = 30
SPEEDS = np.geomspace(20.0, 200.0, ROWS)


@pytest.fixture(scope="module")
def explained() -> Explained:
    """Rows whose readings change at random with the squared rebound speed and the delay, errors and residuals of 1."""
    random = np.random.default_rng(5)
    table = made_table(ROWS)
    model = model_of(table, task_of(table, "law+delay"), {"fixed": {}, "held": ()})
    assert isinstance(model.law, FormulaLaw)
    law = model.law.beside((20.0, 200.0), SMOOTH)
    model = dataclasses.replace(model, law=law, remainders=np.zeros((2, ROWS, 7)))
    mean, strength = model.prior
    theta = mean + 0.3 * random.normal(size=mean.size)
    theta[: len(law.own)] = [law.unknown_of(name, VALUES[name]) for name in law.own]
    # u^2 - w^2 as of drag alone
    rebound = np.sqrt(SPEEDS**2 - 0.5 * SPEEDS - 113.6)
    pull, change = 10.0 * random.normal(size=(2, ROWS))
    orbits = no_orbits(ROWS)._replace(x=np.ones((ROWS, 3)), approach=SPEEDS, rebound=rebound, pull=pull, change=change)
    orbits.slopes[:, :, :2] = random.normal(size=(ROWS, 3, 2)) * [0.3, 3e3]
    # the lead and its square change the delay alone
    leads = np.stack([1.0 / SPEEDS - 1.0 / rebound, 1.0 / rebound**2 - 1.0 / SPEEDS**2], axis=1)
    orbits.slopes[:, :, [3, 5]] = orbits.slopes[:, :, 1, None] * leads[:, None]
    weights = weights_of(model, theta, orbits, np.zeros(ROWS, bool))
    weights = weights._replace(whitening=np.eye(3) * weights.used[:, :, None])
    slopes = np.einsum("nij,njk->nik", weights.whitening, model.slopes(theta, orbits)).reshape(-1, mean.size)
    residual = np.append(np.where(weights.used, random.normal(size=(ROWS, 3)), 0.0), strength * (theta - mean))
    end = Descent(theta, orbits, 0.0, residual, np.append(slopes, np.diag(strength), axis=0))
    return Explained(model, end, weights, Found(orbits, np.ones(ROWS, int)), 0.0, settled=True)


def test_peak_and_lockin_of_a_slow_row_share_the_error_of_the_picture(explained):
    data, orbits = explained.model.data, explained.end.orbits
    orbits = orbits._replace(approach=0.6 * SPEEDS, rebound=0.5 * SPEEDS)
    weights = weights_of(explained.model, explained.end.theta, orbits, np.zeros(ROWS, bool))
    capture = explained.model.law.capture(explained.model.of_law(explained.end.theta))
    np.testing.assert_array_equal(weights.reasons != "", orbits.approach < 1.35 * capture)
    both = weights.used[:, 0] & weights.used[:, 1]
    assert both.sum() > 20
    # 0.05 %, what a tip that leaves is held back over 4.7 nm, what is near capture: of full contacts
    late = 2e-3 * np.pi * data.row.drive_frequency_khz * 4.7 / orbits.rebound
    share = 0.0005 + 0.012 * late**3 + 0.016 * (1.5 * capture / orbits.approach) ** 6
    turn = np.array([[1.0, 1.0], [1.0, -1.0]]) / np.sqrt(2.0)
    for row in np.flatnonzero(both):
        # both are read to 1 %: the mean lacks twice the variance, the difference a sixteenth
        relative = np.linalg.inv(weights.whitening[row, :2, :2]) / data.read[row, :2, None]
        wanted = 1e-4 + share[row] ** 2 * np.array([2.0, 1.0 / 16.0])
        np.testing.assert_allclose(turn @ relative @ relative.T @ turn, np.diag(wanted), rtol=1e-9, atol=1e-15)


def formula(values: np.ndarray) -> np.ndarray:
    """Rebound speeds and delays of r, epsilon and a delay law."""
    r, epsilon, hertz, lead, offset = values
    w = np.sqrt((r * SPEEDS) ** 2 - epsilon)
    return np.stack([w, hertz * SPEEDS**-0.2 - lead * (1.0 / w - 1.0 / SPEEDS) - offset / SPEEDS])


def test_the_parameters_are_those_of_the_closest_formula_and_as_unsure(explained):
    found, law = closest_parameters(explained, OWN, {}), explained.law_at(SPEEDS)
    assert found.names == (*OWN, "quality_factor")
    width, error = np.linalg.norm(law.factor, axis=2), found.errors

    def closest(law: np.ndarray) -> np.ndarray:
        """Return the closest formula in errors from the one found: first of the rebound speed, then of the delay."""

        def off(z: np.ndarray) -> np.ndarray:
            return (formula(found.values[:5] + error[:5] * z) - law) / width

        options: dict[str, Any] = {"xtol": 1e-14, "ftol": 1e-14, "gtol": 1e-14, "jac": "3-point"}
        loss = least_squares(lambda z: off(np.append(z, np.zeros(3)))[0], np.zeros(2), **options).x
        late = least_squares(lambda z: off(np.append(loss, z))[1], np.zeros(3), **options).x
        return np.append(loss, late)

    best = closest(law.law)
    np.testing.assert_allclose(best, 0.0, atol=1e-3)
    tiny = 1e-4
    moved = np.array([(closest(law.law + tiny * one) - best) / tiny for one in np.moveaxis(law.factor, 2, 0)])
    unit = (found.factor / error[:, None])[:5]
    # errors are to first order in the distance of formula and law
    np.testing.assert_allclose(unit @ unit.T, moved.T @ moved, atol=1e-2)


def test_residuals_that_run_together_over_the_speed_are_seen(explained):
    """By the largest fall of chi2 that one bump of the loss, or of the path of the delay, brings beside all else."""
    end, local = explained.end, explained.end.orbits.slopes * explained.weights.used[:, :, None]
    middles = np.arange(np.log(20.0), np.log(200.0) + 0.1, 0.1)
    shapes = np.exp(-0.5 * ((np.log(SPEEDS)[:, None] - middles) / 0.2) ** 2)
    lost = local[:, :, 0, None] * (shapes * (SPEEDS**2 - end.orbits.rebound**2)[:, None])[:, None]
    late = local[:, :, 1, None] * (shapes / SPEEDS[:, None])[:, None]
    bumps = np.concatenate([lost, late], axis=2).reshape(3 * ROWS, -1)
    bumps = np.append(bumps, np.zeros((end.theta.size, bumps.shape[1])), axis=0)

    def chi2(residual: np.ndarray, *columns: np.ndarray) -> float:
        matrix = np.column_stack([end.jacobian, *columns])
        return float(np.sum((residual - matrix @ np.linalg.lstsq(matrix, residual, rcond=None)[0]) ** 2))

    runs = []
    for height in (0.0, 0.05, 0.4):
        residual = end.residual + height * bumps[:, len(middles) // 2]
        run = run_of_residuals(dataclasses.replace(explained, end=end._replace(residual=residual)))
        fall = max(chi2(residual) - chi2(residual, bump) for bump in bumps.T)
        assert run == pytest.approx(np.sqrt(fall), rel=1e-6)
        runs.append(run)
    assert runs[0] < 3.5
    assert runs[2] > 10.0


@pytest.mark.slow
@pytest.mark.long
def test_scipy_finds_the_same_minimum_with_everything_free():
    """From half an error away, by differences, every row's orbits searched for anew each time."""
    result = fit(drives(), "law+delay")
    found = explained_of(result)
    model, (mean, strength) = found.model, found.model.prior
    assert {"r", "viscous_loss", "loss_0", "path_0", "remainder_0", "quality_factor"} <= set(model.names)
    error = np.sqrt(np.diag(found.covariance))

    def residual(z: np.ndarray) -> np.ndarray:
        theta = found.end.theta + error * (z - 3.0)
        off = np.where(found.weights.used, orbits_at(model, theta).orbits.readings - model.data.read, 0.0)
        return np.append(np.einsum("nij,nj->ni", found.weights.whitening, off), strength * (theta - mean))

    begin = 3.0 + 0.5 * np.random.default_rng(2).choice([-1.0, 1.0], error.size)
    best = least_squares(residual, begin, diff_step=1e-5, ftol=1e-8)
    assert 2.0 * best.cost == pytest.approx(result.chi2, abs=1e-3)
    np.testing.assert_allclose(best.x - 3.0, 0.0, atol=0.02)
