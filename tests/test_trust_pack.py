"""What a trust pack says of a posterior, against ArviZ, real deletion of rows, closed forms, and wrong posteriors."""

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.stats import genpareto, kstest, norm

from afm_jax.impact.law import ImpactLaw
from fitting import fit, posterior, trust, write_inference_data
from fitting.fits.objective import Objective
from fitting.report.report import write_report
from fitting.sampling import rank_calibration
from fitting.sampling.bootstrap import BatchFit, Refit
from fitting.sampling.draws import densities, noise_of, posterior_draws, refit_of_rows
from fitting.sampling.influence import _moves
from fitting.sampling.leave_one_out import leave_one_out, pareto_smoothed
from fitting.sampling.posterior_result import PosteriorChains, posterior_of_chains
from fitting.sampling.rank_calibration import _deviation, _ranks, calibrate_ranks
from tests.fit_tables import example_amplitudes, rows, simulated, steady_amplitudes, values_of
from tests.made_fits import made_fit

EVERY_FOURTH = slice(0, None, 4)
FEWER = 16
"""Draws of a set, where many sets are looked at."""
SETS = 50
"""Of wrong posteriors: as improbable as is asked for all the same."""


@pytest.mark.parametrize("shape", [-0.2, 0.3, 0.8])
def test_the_tail_of_the_weights_is_found(shape):
    weights = 1.0 + genpareto(shape).rvs(size=20_000, random_state=5)
    smoothed, found = pareto_smoothed(np.log(weights))
    # the fit takes the largest 424: 424^-1/2 (1 + k) is its error, and a weak prior at 1/2
    assert found == pytest.approx(shape, abs=3.0 * (1.0 + shape) / np.sqrt(424))
    assert np.exp(smoothed).sum() == pytest.approx(1.0, rel=1e-12)
    assert np.argsort(smoothed[weights > 2.0]).tolist() == np.argsort(weights[weights > 2.0]).tolist()


def test_leave_one_out_of_a_mean_is_its_closed_form():
    random = np.random.default_rng(2)
    y = random.normal(size=30)
    draws = y.mean() + random.normal(size=(20_000, 1)) / np.sqrt(30)
    found = leave_one_out(norm.logpdf(y, draws, 1.0))
    others = (y.sum() - y) / 29
    exact = norm.logpdf(y, others, np.sqrt(1.0 + 1.0 / 29))
    # the importance weights of 20,000 draws: 1 % each at most
    assert found.elpd_by_row == pytest.approx(exact, abs=0.01)
    assert found.elpd == pytest.approx(exact.sum(), abs=0.05)
    assert np.all(found.pareto_k < found.highest_k)


def test_a_row_that_says_nothing_has_equal_weights():
    found = leave_one_out(np.repeat([[-4.5, 0.0]], 200, axis=0))
    assert found.elpd_by_row == pytest.approx([-4.5, 0.0], abs=1e-12)
    assert not np.any(found.pareto_k > found.highest_k)


def test_moves_are_those_of_least_squares_without_the_row():
    random = np.random.default_rng(6)
    jacobian, target = random.normal(size=(12, 3)), random.normal(size=12)
    # two readings a row, of which the last alone knows the third parameter
    jacobian[:10, 2] = 0.0
    best = np.linalg.lstsq(jacobian, target)[0]
    linear: Any = object.__new__(Objective)
    linear.at_values = lambda _: SimpleNamespace(residual=(jacobian @ best - target)[None], jacobian=jacobian[None])
    linear.measurement = SimpleNamespace(rows=SimpleNamespace(amplitude_nm=np.zeros((6, 2))))
    normal, moves = _moves(linear, best, np.ones(3, dtype=bool))
    assert normal == pytest.approx(jacobian.T @ jacobian, rel=1e-12)
    for row in range(5):
        kept = np.arange(12) // 2 != row
        without = np.linalg.lstsq(jacobian[kept], target[kept])[0]
        assert moves[row] == pytest.approx(without - best, rel=1e-9, abs=1e-12)
    assert np.isinf(moves[5]).all()


def test_ranks_are_uniform_only_in_the_right_posterior():
    random = np.random.default_rng(4)
    uniform = _deviation(np.random.default_rng(0).random((2000, 200)).T)

    def probability(widened: float, shifted: float) -> float:
        # of the mean of a reading y ~ N(mu, 1) with mu ~ N(0, 1) beforehand: N(y/2, 1/2)
        found = []
        for _ in range(200):
            true = random.normal(size=1)
            middle = 0.5 * (true + random.normal(size=1)) + shifted
            drawn = middle + widened * np.sqrt(0.5) * random.normal(size=(64, 1))
            found.append(_ranks(drawn, np.full(64, 1.0 / 64), true, random))
        return float(np.mean(uniform >= _deviation(np.array(found))))

    assert probability(1.0, 0.0) > 0.05
    assert probability(0.7, 0.0) < rank_calibration.IMPROBABLE
    assert probability(1.6, 0.0) < rank_calibration.IMPROBABLE
    assert probability(1.0, 0.3) < rank_calibration.IMPROBABLE


@pytest.fixture(scope="module")
def believed():
    table = rows(example_amplitudes(), EVERY_FOURTH)
    result = fit(simulated(table, ImpactLaw(0.95, 60.0), seed=8), "law")
    return result, posterior(result)


@pytest.fixture(scope="module")
def pack(believed):
    told = []
    found = trust(*believed, sets=100, report=lambda *progress: told.append(progress))
    assert told[-1] == (100, 100)
    return found


def values_believed(believed) -> np.ndarray:
    return posterior_draws(*believed).values.reshape(-1, 3)


@pytest.mark.slow
def test_draws_from_a_grid_are_the_posteriors(believed):
    result, found = believed
    drawn = posterior_draws(result, found)
    flat = drawn.values.reshape(-1, 3)
    for k, name in enumerate(drawn.names):
        # 1000 draws: a mean to 0.03 deviations, a width to 2.2 %; four times that, and 0.5 % of the triangles
        deviation = found.standard_deviation[name]
        assert flat[:, k].mean() == pytest.approx(found.mean[name], abs=0.13 * deviation)
        assert flat[:, k].std() == pytest.approx(deviation, rel=0.1)
    # 1000 draws of a correlation: 0.03 each
    assert np.corrcoef(flat.T) == pytest.approx(result.correlations, abs=0.13)


@pytest.mark.slow
def test_likelihoods_are_those_of_another_programs_amplitudes(believed):
    result, found = believed
    drawn = posterior_draws(result, found)
    r, epsilon, quality = drawn.values[2, 7]
    table = result.table
    predicted = steady_amplitudes(table, ImpactLaw(float(r), float(epsilon)), quality_factor=float(quality))
    expected = norm.logpdf(drawn.measured, predicted, drawn.error).sum(axis=1)
    assert drawn.predicted[2, 7] == pytest.approx(predicted, rel=1e-9)
    assert drawn.log_likelihood[2, 7] == pytest.approx(expected, abs=1e-7)
    known = norm.logpdf(drawn.values[2, :, 2], table.quality_factor, table.quality_factor_error)
    here = drawn.log_likelihood.sum(axis=2)[2] + known - drawn.statistics["lp"][2]
    # up to a constant it is the posterior's
    assert here == pytest.approx(np.full(250, here[0]), abs=1e-8)
    z = (drawn.replicated - drawn.predicted) / drawn.error
    assert kstest(z.ravel(), "norm").pvalue > 0.01


@pytest.mark.slow
def test_a_robust_loss_is_a_distribution_of_errors(believed):
    refit, _ = refit_of_rows(believed[0])
    plain, robust = refit.objective, refit.objective.with_rows()
    robust.robust = True
    z = np.linspace(-60.0, 60.0, 200_001)
    density = np.exp(-4.0 * (np.sqrt(1.0 + z**2 / 4.0) - 1.0))
    norms = float(np.trapezoid(density, z))
    misfit = plain.amplitude_residuals(refit.values)
    error = np.asarray(plain.measurement.rows.error_nm)
    expected = -4.0 * (np.sqrt(1.0 + misfit**2 / 4.0) - 1.0) - np.log(norms * error)
    found = densities(robust, refit.values[None])
    assert found.log_likelihood[0] == pytest.approx(expected.sum(axis=1), abs=1e-8)
    noise = noise_of(robust, 400, np.random.default_rng(1))[:, 0, 0] / error[0, 0]
    assert kstest(noise, lambda x: np.interp(x, z, np.cumsum(density) / density.sum())).pvalue > 0.01
    assert calibrate_ranks(refit._replace(objective=robust), values_believed(believed), sets=20).failed < 5


@pytest.mark.slow
def test_a_right_posterior_is_not_complained_of(pack):
    assert pack.calibration.p_value > 0.05
    assert pack.calibration.gaussian_p_value > 0.05
    assert pack.calibration.failed == 0
    inside50, readings = pack.predictive.inside(1, 3)
    inside95, _ = pack.predictive.inside(0, 4)
    # four binomial deviations
    assert abs(inside50 - 0.5 * readings) < 4.0 * np.sqrt(0.25 * readings)
    assert inside95 > 0.95 * readings - 4.0 * np.sqrt(0.0475 * readings)
    assert not [line for line in pack.complaints if "uniform" in line or "readings" in line]
    assert len(pack.to_pandas()) == len(pack.lines)
    assert pack.plot().axes


@pytest.mark.slow
@pytest.mark.parametrize(("widened", "shifted"), [(0.3, 0.0), (2.5, 0.0), (1.0, 1.0)])
def test_a_wrong_posterior_is_flagged(believed, monkeypatch, widened, shifted):
    result, _ = believed
    monkeypatch.setattr(rank_calibration, "DRAWS", FEWER)
    drawn = values_believed(believed)
    middle, error = drawn.mean(axis=0), drawn.std(axis=0)
    wrong = middle + widened * (drawn - middle) + shifted * error
    ranks = calibrate_ranks(refit_of_rows(result)[0], np.clip(wrong, None, [1.0, np.inf, np.inf]), sets=SETS)
    assert ranks.p_value < rank_calibration.IMPROBABLE


@pytest.mark.slow
def test_wrong_standard_errors_are_flagged(believed, monkeypatch):
    result, _ = believed
    drawn = values_believed(believed)
    whole = rank_calibration.fit_data_sets

    def too_sure(refit: Refit, data) -> BatchFit:
        fits = whole(refit, data)
        return fits._replace(covariance=0.5 * fits.covariance)

    monkeypatch.setattr(rank_calibration, "fit_data_sets", too_sure)
    monkeypatch.setattr(rank_calibration, "DRAWS", FEWER)
    ranks = calibrate_ranks(refit_of_rows(result)[0], drawn, sets=SETS)
    assert ranks.gaussian_p_value < rank_calibration.IMPROBABLE


@pytest.mark.slow
def test_rows_move_the_fit_as_fits_without_them_say(believed, pack):
    result, _ = believed
    influence = pack.influence
    assert influence.law_moves[influence.checked] == pytest.approx(influence.law_moves_refitted, rel=0.05, abs=0.01)
    row = int(influence.checked[0])
    without = fit(rows(result.table, np.arange(result.table.rows) != row), "law")
    speeds = result.rows.approach_speed_nm_per_us
    u = np.geomspace(speeds.min(), speeds.max(), 121)
    before, after = (
        np.sqrt((one.parameters["r"].value * u) ** 2 - one.parameters["epsilon"].value) for one in (result, without)
    )
    half = np.interp(u, result.law.approach_speed_nm_per_us, result.law.rebound_high_nm_per_us) - np.interp(
        u, result.law.approach_speed_nm_per_us, result.law.rebound_speed_nm_per_us
    )
    move = np.max(np.abs(after - before) / (half / 1.959964))
    # the band is interpolated between 121 other speeds
    assert influence.law_moves_refitted[0] == pytest.approx(move, rel=0.01)
    step = values_of(without) - values_of(result)
    errors = np.array([parameter.standard_error for parameter in result.parameters.values()])
    covariance = result.correlations * np.outer(errors, errors)
    cook = step @ np.linalg.solve(covariance, step) / 3.0
    assert influence.cooks_distance[row] == pytest.approx(cook, rel=0.05)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:Estimated shape parameter of Pareto")
def test_arviz_reads_the_file_and_agrees(believed, pack, tmp_path: Path):
    arviz = pytest.importorskip("arviz", reason="ArviZ is an extra")
    result, found = believed
    path = tmp_path / "posterior.nc"
    write_inference_data(result, found, path)
    data = arviz.from_netcdf(path)
    groups = {"posterior", "sample_stats", "log_likelihood", "posterior_predictive", "observed_data"}
    # a DataTree since ArviZ 1
    assert groups <= set(data.children if hasattr(data, "children") else data.groups())
    assert data.posterior["r"].shape == (4, 250)
    assert np.asarray(data.observed_data["peak_amplitude_nm"]) == pytest.approx(result.table.peak_amplitude_nm)
    loo = arviz.loo(data, pointwise=True, reff=1.0)
    # ArviZ 1 smooths tails a little differently, and divides by one reading less
    later = hasattr(loo, "elpd")
    elpd, p, near = (loo.elpd, loo.p, 0.05) if later else (loo.elpd_loo, loo.p_loo, 1e-9)
    assert pack.loo.elpd == pytest.approx(elpd, abs=near)
    fewer = np.sqrt(1.0 - 1.0 / len(pack.lines)) if later else 1.0
    assert pack.loo.elpd_error == pytest.approx(fewer * loo.se, abs=near)
    assert pack.loo.p_loo == pytest.approx(p, abs=near)
    assert pack.loo.pareto_k == pytest.approx(np.asarray(loo.pareto_k), abs=near)


@pytest.mark.slow
def test_the_report_has_it_all(believed, pack, tmp_path: Path):
    result, found = believed
    tables = []
    write_report(result, tmp_path, lambda *table: tables.append(table), posterior=found, trust=pack)
    name, records, columns = next(table for table in tables if table[0] == "trust_rows.csv")
    assert len(records) == len(pack.lines)
    assert {"line", "pareto_k", "law_moves", "replicated_peak_amplitude_nm_97.5_percent"} <= set(columns)
    page = (tmp_path / "fit.html").read_text(encoding="utf-8")
    assert "Trust in the posterior" in page
    assert (tmp_path / "trust.png").stat().st_size > 50_000, name
    plain = pack.to_dict()
    assert plain["calibration"]["sets"] == 100
    assert len(plain["rows"]) == len(pack.lines)
    pack.plot(tmp_path / "figure.png")
    pack.save(tmp_path / "pack.json")
    assert len(pack.to_pandas()) == len(pack.lines)


def test_wrong_calls_are_refused_in_one_line():
    chains = PosteriorChains(np.zeros((4, 100, 2)), np.ones(2), np.full(2, 400.0), 0, 0)
    found = posterior_of_chains(chains, ("r", "epsilon"), ())
    with pytest.raises(ValueError, match="`sets` must be at least 20"):
        trust(made_fit("law"), found, sets=5)
    with pytest.raises(ValueError, match="is not valid"):
        trust(dataclasses.replace(made_fit("law"), valid=False, reasons=["no"]), found)
