"""What a law leaves out: the step against one least-squares problem, and bands on contacts that are not the law."""

import dataclasses
from typing import Any

import numpy as np
import pytest
from fitting.fits.discrepancy import ModelDiscrepancy, with_runs
from fitting.fits.law_after import (
    LawAfter,
    LawBefore,
    closest_member,
    containing,
    law_after,
    root_of,
)
from fitting.fits.objective import Objective
from fitting.fits.step import LinearStep, StepRows, StepSystem, descending_part, longest_run, settled_step, system_of
from fitting.forward import ImpactSlopes, Predicted, Prediction, impact_slopes
from scipy.optimize import approx_fprime, least_squares

from afm_jax.units import EV_PER_AJ
from fitting import fit
from fitting.infer.result import Loss, WithInterval, energy_lost, interval_of, scaled
from fitting.models import Problem, measurement_of
from fitting.parameters import DELAY_NAMES, DELAY_SHAPE, LOSS_SHAPE
from fitting.report.words import losses_in_words, parting_in_words
from fitting.tables.table import AmplitudeTable
from tests.contact_experiment import paper_collisions, paper_experiment
from tests.coverage_of_bands import law_at, noisy
from tests.fit_tables import holds
from tests.made_fits import made_fit

VALUES = {
    "epsilon": 113.6,
    "viscous_loss": 0.5,
    "delay_hertz": 0.206,
    "delay_lead_nm": 5.64,
    "delay_offset_nm": 0.726,
    "quality_factor": 40.0,
}
PROBLEM = Problem("viscous+delay", tuple(VALUES))
LEFT_OUT = ModelDiscrepancy(PROBLEM, VALUES, (20.0, 200.0))
ROWS, FREE = 12, np.ones(6, dtype=bool)


@pytest.fixture(scope="module")
def rows() -> StepRows:
    """Rows of random slopes, the constraint on Q last."""
    random = np.random.default_rng(5)
    u = np.geomspace(20.0, 200.0, ROWS)
    jacobian = random.normal(size=(2 * ROWS + 1, 6))
    jacobian[-1] = np.eye(6)[-1] / 0.8
    return StepRows(
        residual=0.1 * random.normal(size=2 * ROWS + 1),
        jacobian=jacobian,
        slopes=ImpactSlopes(random.normal(size=(ROWS, 2)), 1e3 * random.normal(size=(ROWS, 2))),
        measurement_error=random.uniform(0.3, 1.0, size=(ROWS, 2)),
        slow_error=random.uniform(0.0, 1.0, size=(ROWS, 2)),
        approach=u,
        rebound=np.sqrt(u**2 - 0.5 * u - 113.6),
        pull=10.0 * random.normal(size=ROWS),
        change=10.0 * random.normal(size=ROWS),
        hertz_time=0.206 * u**-0.2,
    )


@pytest.fixture(scope="module")
def system(rows) -> StepSystem:
    return system_of(rows, LEFT_OUT, FREE)


@pytest.fixture(scope="module")
def step(system) -> LinearStep:
    return system.step()


def stacked(rows: StepRows):
    """Return matrix, right-hand side and number of parameters of one least-squares problem with everything in it."""
    columns = LEFT_OUT.columns(rows.approach, rows.rebound)
    found = []
    for row in range(ROWS):
        n, p = rows.measurement_error[row], rows.slow_error[row]
        # the mean of both lacks twice the variance, their difference a sixteenth
        turn = np.array([[1.0, 1.0], [1.0, -1.0]]) / np.sqrt(2.0)
        scaled = np.diag(p) @ turn @ np.diag([2.0, 1.0 / 16.0]) @ turn @ np.diag(p)
        white = np.linalg.inv(np.linalg.cholesky(np.diag(n**2) + scaled))
        both = np.stack([rows.slopes.by_square[row], rows.slopes.by_delay[row]], axis=1)
        own = rows.jacobian[2 * row : 2 * row + 2].copy()
        own[:, 1] += both @ columns.drag[:, row]
        u, w, g, j, t = (x[row] for x in (rows.approach, rows.rebound, rows.pull, rows.change, rows.hertz_time))
        late = [0.5 * g / w**3, 0.008 * g * t**2 / u, 8.0 * j / w**4]
        # the loss of these rows grows by half a nm/us for every one of approach
        gained = [15.0 * 0.5 * j / w**2, 2.0 * 0.5 * g / u, 0.06 * j * t**2 * u, 5.0 * g**2 / w**2]
        changes = np.array([[0.0, x] for x in late] + [[x, 0.0] for x in gained]).T
        block = np.concatenate(
            [own, both @ columns.shape[:, row], both @ columns.unknown[:, row], both @ (1.5 * changes)], 1
        )
        value = rows.residual[2 * row : 2 * row + 2] + both @ columns.known[:, row]
        found.append((white @ block, white @ value))
    matrix, right = (np.concatenate([one[k] for one in found]) for k in range(2))
    size = matrix.shape[1]
    constraint = np.concatenate([rows.jacobian[-1], np.zeros(size - 6)])[None]
    shapes = np.eye(size)[6:8] / np.array([error for _, error in LEFT_OUT.priors.values()])[:, None]
    matrix = np.concatenate([matrix, constraint, shapes, np.eye(size)[8:]])
    return matrix, np.concatenate([right, rows.residual[-1:], np.zeros(size - 6)])


def test_the_step_is_that_of_one_least_squares_problem(rows, system, step):
    matrix, right = stacked(rows)
    best = np.linalg.lstsq(matrix, -right, rcond=None)[0]
    assert step.names == (*VALUES, LOSS_SHAPE, DELAY_SHAPE)
    np.testing.assert_allclose(step.change, best[:8], rtol=1e-6)
    np.testing.assert_allclose(step.unknown, best[8:], rtol=1e-5, atol=1e-7)
    covariance = np.linalg.inv(matrix.T @ matrix)
    np.testing.assert_allclose(step.covariance, covariance[:8, :8], rtol=1e-5)
    assert step.chi2 == pytest.approx(np.sum((right + matrix @ best) ** 2), rel=1e-8)
    assert system.chi2(step, system.misfit(step)) == pytest.approx(step.chi2, rel=1e-9)


def test_chi2_leaves_what_belongs_to_the_rows_at_its_most_likely(rows, system, step):
    """The sum of squares with the remainders as unknowns of their own, minimised over these."""
    misfit = np.random.default_rng(8).normal(size=2 * ROWS)
    half = step.partly(0.5)
    of_rows = system.unknown[:, system.of_law :]
    assert of_rows.shape[1] == 7
    white = np.linalg.inv(np.linalg.cholesky(system.noise))
    matrix = np.concatenate([white @ of_rows, np.eye(7)])
    right = np.concatenate([white @ misfit, np.zeros(7)])
    likely, square, *_ = np.linalg.lstsq(matrix, -right, rcond=None)
    known = (half.values[5] - 40.0) / 0.8 + rows.residual[-1]
    shapes = [(half.values[6 + i] - mean) / error for i, (mean, error) in enumerate(LEFT_OUT.priors.values())]
    rest = np.concatenate([[known], shapes, half.unknown[: system.of_law]])
    assert system.chi2(half, misfit) == pytest.approx(float(square[0]) + float(rest @ rest), rel=1e-9)
    np.testing.assert_allclose(system.alone(misfit), misfit + of_rows @ likely, atol=1e-9)


def computed(misfits: list[np.ndarray]) -> Predicted:
    nothing: Any = np.zeros((2, 1))
    return Predicted(np.array(misfits).reshape(len(misfits), ROWS, 2), Prediction(*(nothing,) * 7))


@pytest.mark.parametrize("share", [0.25, 0.0])
def test_a_step_is_damped_until_chi2_falls(share, system, step):

    def predicted(parts):
        taken = [float(part.change @ step.change / (step.change @ step.change)) for part in parts]
        # beyond that amplitudes do something else
        return computed([system.misfit(part) + 10.0 * (one > share) for part, one in zip(parts, taken, strict=True)])

    found = descending_part(system, predicted)
    np.testing.assert_allclose(found.step.change, share * step.change)
    np.testing.assert_allclose(found.step.unknown, share * step.unknown)
    assert (found.stuck is None) == (share > 0.0)
    begin, expected = found.stuck or (1.0, 0.0)
    assert begin > expected


def test_a_settled_step_explains_the_readings_as_computed(rows, system, step):
    """Readings bend with the law: the first step's do not fit, the settled one's misfit is that of a fit to them."""
    looks = []

    def bent(part):
        linear = system.misfit(part)
        return linear + 0.01 * (linear - system.misfit(step.partly(0.0))) ** 2

    def predicted(parts):
        looks.append(len(parts))
        return computed([bent(part) for part in parts])

    first = descending_part(system, predicted)
    found = settled_step(first, system, predicted)
    chi2 = [system.chi2(one.step, bent(one.step)) for one in (first, found)]
    assert chi2[1] < chi2[0]
    # its root: the step from there leads back to it
    residual = rows.residual.copy()
    residual[: 2 * ROWS] += bent(found.step) - system.misfit(found.step)
    last = system_of(rows._replace(residual=residual), LEFT_OUT, FREE).step()
    error = np.sqrt(np.diag(step.covariance))
    np.testing.assert_allclose(last.change / error, found.step.change / error, atol=0.1)
    assert len(looks) <= 8
    np.testing.assert_array_equal(found.predicted.misfit.ravel(), bent(found.step))


def test_the_law_after_the_step_is_the_formula_with_its_discrepancy(step):
    """By hand, of a step large enough that first order is visibly not it."""
    u, values = np.geomspace(25.0, 180.0, 7), np.array(list(VALUES.values()))
    before, moved = (
        LawBefore(loss_and_delay(at, u), np.zeros((2, 7, 6)), 10.9, np.zeros(6)) for at in (values, step.values[:6])
    )
    found = law_after(step, LEFT_OUT, u, before, moved)
    columns = LEFT_OUT.columns(u, before.law[0])
    square, late = columns.unknown @ step.unknown[: columns.unknown.shape[2]]
    epsilon, loss, hertz, lead, offset, _, q, f = step.values
    w = np.sqrt(u**2 - loss * np.sqrt(u**2 + q) - epsilon + square)
    np.testing.assert_allclose(found.law[0], w, rtol=1e-12)
    delay = hertz * u**-0.2 - lead * (1.0 / w - 1.0 / u) - offset / u + f * (1.0 / w**2 - 1.0 / u**2) + late
    np.testing.assert_allclose(found.law[1], delay, rtol=1e-10)


def test_the_band_is_that_of_the_whole_covariance(rows, step):
    matrix, _ = stacked(rows)
    covariance = np.linalg.inv(matrix.T @ matrix)
    u = np.array([30.0, 80.0, 150.0])
    w = np.sqrt(u**2 - 0.5 * u - 113.6)
    slope = np.zeros((2, 3, 6))
    slope[0, :, 0], slope[0, :, 1] = -0.5 / w, -0.5 * u / w
    found = law_after(step, LEFT_OUT, u, LawBefore(np.stack([w, 0.0 * w]), slope, 10.9, np.zeros(6)))
    columns = LEFT_OUT.columns(u, w)
    square = np.concatenate([2.0 * w[:, None] * slope[0], columns.shape[0], columns.unknown[0]], axis=1)
    square[:, 1] += columns.drag[0]
    size = square.shape[1]
    error = np.sqrt(np.einsum("nk,kj,nj->n", square, covariance[:size, :size], square)) / (2.0 * w)
    np.testing.assert_allclose(np.linalg.norm(found.factor[0], axis=1), error, rtol=1e-5)


def test_residuals_that_run_together_over_the_speed_are_seen_and_only_widen(rows):
    """A bump of the loss that no column of the model has, beside independent residuals of half an error."""
    random = np.random.default_rng(8)
    calm = rows._replace(residual=np.append(0.5 * random.normal(size=2 * ROWS), 0.0))
    steps = [longest_run(calm, system_of(calm, LEFT_OUT, FREE))]
    bump = np.exp(-0.5 * (np.log(rows.approach / 60.0) / 0.2) ** 2) * (rows.approach**2 - rows.rebound**2)
    for height in (0.1, 1.0):
        bent = calm.residual.copy()
        bent[: 2 * ROWS] += height * (rows.slopes.by_square * bump[:, None]).ravel()
        other = calm._replace(residual=bent)
        steps.append(longest_run(other, system_of(other, LEFT_OUT, FREE)))
    assert steps[0] < 3.0
    assert steps[2] > 10.0
    assert with_runs(LEFT_OUT, 2.0) == LEFT_OUT
    shares = [with_runs(LEFT_OUT, run).short for run in (2.2, 3.0, 5.0, 50.0)]
    np.testing.assert_allclose(shares, [0.0, 0.2, 0.7, 1.0])
    narrow, wide = (system_of(rows, one, FREE).step() for one in (LEFT_OUT, with_runs(LEFT_OUT, 5.0)))
    assert np.all(np.diag(wide.covariance) >= np.diag(narrow.covariance))
    assert wide.chi2 < narrow.chi2


def test_a_band_holds_that_of_another_law_too():
    factor = np.array([[[0.3, 0.4], [0.0, 1.0]], [[0.1, 0.0], [0.2, 0.0]]])
    one = LawAfter(np.array([[10.0, 20.0], [0.1, 0.2]]), factor, 5.0, np.array([0.1, 0.0]))
    other = LawAfter(one.law + np.array([[0.5, -3.0], [0.0, 0.01]]), 2.0 * factor, 5.5, np.array([0.0, 0.2]))
    both = containing(one, other)
    for law in (one, other):
        own, mine = (np.linalg.norm(x.factor, axis=2) * 1.959964 for x in (law, both))
        assert np.all(both.law - mine <= law.law - own + 1e-9)
        assert np.all(both.law + mine >= law.law + own - 1e-9)
        reach = 1.959964 * np.linalg.norm(law.capture_factor)
        assert both.capture + 1.959964 * np.linalg.norm(both.capture_factor) >= law.capture + reach - 1e-9
    same = containing(one, one._replace(factor=0.5 * factor))
    np.testing.assert_allclose(same.factor, one.factor)


def loss_and_delay(values: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Rebound speeds and delays of epsilon, viscous loss and a delay law."""
    epsilon, loss, hertz, lead, offset = values[:5]
    w = np.sqrt(u**2 - loss * u - epsilon)
    return np.stack([w, hertz * u**-0.2 - lead * (1.0 / w - 1.0 / u) - offset / u])


def test_the_parameters_are_those_of_the_closest_formula_and_as_unsure(step):
    u, values = np.geomspace(25.0, 180.0, 30), np.array(list(VALUES.values()))
    slope = np.asarray(approx_fprime(values, lambda at: loss_and_delay(at, u).ravel(), 1e-6)).reshape(2, 30, 6)
    before = LawBefore(loss_and_delay(values, u), slope, 10.9, np.zeros(6))
    after = law_after(step, LEFT_OUT, u, before)
    found = closest_member(step, LEFT_OUT, u, before, FREE)
    assert found is not None
    width = np.linalg.norm(after.factor, axis=2)
    error = np.sqrt(np.diag(found.covariance))

    def closest(law):
        """Return the closest formula in steps of the errors: first of the rebound speed, then of the delay."""
        unit = error[:5]

        def formula(loss, late):
            return loss_and_delay(values[:5] + unit * np.append(loss, late), u)

        options: dict[str, Any] = dict.fromkeys(("xtol", "ftol", "gtol"), 1e-14)
        options["bounds"] = (-values[:2] / unit[:2], np.inf)
        loss = least_squares(lambda at: (formula(at, np.zeros(3))[0] - law[0]) / width[0], np.zeros(2), **options).x
        late = least_squares(lambda at: (formula(loss, at)[1] - law[1]) / width[1], np.zeros(3), xtol=1e-14).x
        return np.append(loss, late)

    best = closest(after.law)
    np.testing.assert_allclose((found.values[:5] - values[:5]) / error[:5], best, atol=1e-4)
    tiny = 1e-4
    moved = np.stack([(closest(after.law + tiny * one) - best) / tiny for one in np.moveaxis(after.factor, 2, 0)])
    correlations = found.covariance / np.outer(error, error)
    # errors are to first order in the distance of formula and law
    np.testing.assert_allclose(moved.T @ moved, correlations[:5, :5], atol=1e-2)
    # and what a quantity of the instrument has to do with it
    assert found.values[5] == step.values[5]
    assert found.covariance[5, 5] == pytest.approx(step.covariance[5, 5], rel=1e-8)
    with_q = (after.factor[:, :, :8] @ np.linalg.pinv(root_of(step.covariance))) @ step.covariance[:, 5] / error[5]
    turned = (closest(after.law + tiny * with_q) - best) / tiny
    np.testing.assert_allclose(correlations[:5, 5], turned, atol=1e-2)


@pytest.mark.slow
def test_residuals_change_with_impacts_as_with_the_parameters_that_change_them():
    table = paper_experiment().exact
    values = np.array(list(VALUES.values()))
    objective = Objective(measurement_of(table, PROBLEM), PROBLEM).following(values)
    found = impact_slopes(values, objective.measurement, PROBLEM, objective.near)
    moved = values + np.array([[2e-3, 0, 0, 0, 0, 0], [0, 0, 0, 0, 1e-5, 0]])
    above, below = objective.residual(moved), objective.residual(2.0 * values - moved)
    change = (above - below)[:, : found.by_square.size].reshape(2, *found.by_square.shape)
    speed = np.asarray(objective.at_values(values[None]).prediction.approach_speed_nm_per_us)[0]
    np.testing.assert_allclose(found.by_square, -change[0] / 4e-3, rtol=1e-4, atol=1e-6)
    # the offset d shortens the delay by d/u
    np.testing.assert_allclose(found.by_delay, -change[1] / 2e-5 * speed[:, None], rtol=1e-4, atol=1e-2)


@pytest.mark.slow
def test_bands_hold_the_law_of_a_contact_that_is_not_the_models():
    """Precise amplitudes of the full scene: without what the law leaves out, the bands miss half of the speeds."""
    speeds = np.geomspace(30.0, 200.0, 40)
    truth = paper_collisions(speeds)[0]
    shares, worst, degrees = [], [], []
    for seed in range(3):
        result = fit(precise(seed), "viscous+delay")
        assert result.valid
        rebound, half = law_at(result.law, speeds)
        z = np.abs(rebound - truth) / half
        shares.append(np.mean(z < 1.0))
        worst.append(z.max())
        degrees.append(result.chi2 / result.degrees_of_freedom)
        assert result.loss is not None
        assert holds(result.loss.capture_speed_nm_per_us, 10.93845)
    assert np.mean(shares) >= 0.9
    assert max(worst) < 2.0
    assert 0.75 < np.mean(degrees) < 1.2


def test_the_loss_is_said_in_energies_and_delta():
    # 2 ng (20^2 - 19.9^2)/2 -+ 39: no sample at rest gives energy
    least = energy_lost(20.0, 19.9, 0.5, 2.0).energy_aj
    assert least is not None
    assert least.interval95 == pytest.approx((0.0, 3.99 + 39.004), abs=1e-3)
    epsilon = WithInterval(80.0, (76.08, 83.92))
    delta, capture = scaled(epsilon, 0.5 * 2.0), interval_of(9.04, float("nan"))
    energies = (energy_lost(20.0, 10.0, 0.1, 2.0),)
    loss = Loss(energies, None, delta, scaled(delta, EV_PER_AJ), 4e-3, 24.0, capture)
    said = dict(losses_in_words(made_fit("law", loss=loss)))
    # 2 ng (20^2 - 10^2)/2, and 2 ng times 10 times 1.96 times 0.1 to either side
    assert said["energy lost at 20 nm/us"] == "300.0 aJ (296.1 to 303.9), 1872 eV (1848 to 1897)"
    assert said["delta = m epsilon/2"] == "80.0 aJ (76.1 to 83.9), 499 eV (475 to 524)"
    assert pytest.approx(6.241509, abs=1e-6) == EV_PER_AJ
    assert "off by at most 0.4 % of u_out, at 24 nm/us" in parting_in_words(made_fit("law", loss=loss))


def precise(seed: int) -> AmplitudeTable:
    """Return the amplitudes of the full scene at the paper's contact with 0.3 % of noise."""
    exact = dataclasses.replace(paper_experiment().exact, phase_deg=None, phase_error_deg=None)
    return noisy(exact, 0.003, np.random.default_rng([3, seed]))


@pytest.mark.slow
def test_r_and_epsilon_are_said_once_and_are_those_of_the_closest_formula():
    result = fit(precise(0), "law+delay")
    assert set(result.parameters) <= {"r", "epsilon", *DELAY_NAMES, "quality_factor"}
    r, epsilon = (result.parameters[name] for name in ("r", "epsilon"))
    assert result.loss is not None
    u = result.rows.approach_speed_nm_per_us[result.rows.used]
    rebound, half = law_at(result.law, u)

    def off(at):
        return (np.sqrt((at[0] * u) ** 2 - 100.0 * at[1]) - rebound) / half

    best = least_squares(off, [0.99, 1.0], bounds=([0.0, 0.0], [1.0, 10.0]), xtol=1e-14, ftol=1e-14)
    assert r.value == pytest.approx(best.x[0], abs=0.05 * (r.standard_error or 0.0))
    assert epsilon.value == pytest.approx(100.0 * best.x[1], abs=0.05 * (epsilon.standard_error or 0.0))
    speeds = np.geomspace(u.min(), u.max(), 500)
    there, _ = law_at(result.law, speeds)
    apart = np.abs(np.sqrt((r.value * speeds) ** 2 - epsilon.value) / there - 1.0)
    assert result.loss.formula_off == pytest.approx(apart.max(), rel=0.05)
