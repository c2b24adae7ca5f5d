"""Several tables fitted together: one law, nuisances of each, pulls and scatter, against direct calculations."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from fitting.fits.objective import Objective
from fitting.fits.several import parts_of, pulls_of
from fitting.fits.step import StepParameters, StepSystem

import fitting
from afm_jax.impact.law import ImpactLaw
from afm_jax.saved import save
from fitting.experiments.prior import prior_of_fit
from fitting.infer.fit import fit
from fitting.infer.result import FitResult, FittedTable
from fitting.models import Problem, measurement_of
from fitting.report.report import row_records, summary
from fitting.tables.several import SeveralTables
from fitting.tables.table import AmplitudeTable, read_table
from tests.fit_tables import example_amplitudes, rows, simulated, standard_errors_of, values_of
from tests.made_fits import made_fit, made_parameter, made_rows, made_table

TABLES, READINGS = 5, 24
SCATTER = np.array([0.6, 0.3])


def linear_sets(seed: int, scatter: np.ndarray, own: float = 0.3) -> tuple[StepSystem, np.ndarray, np.ndarray]:
    """Return tables whose readings are linear in two parameters (both 0) and a nuisance each, with unit noise.

    Also which table each row is of, and the places of its parameters.
    """
    random, design = np.random.default_rng(seed), np.random.default_rng(1)
    table = np.repeat(np.arange(TABLES), READINGS // 2)
    of = np.repeat(table, 2)
    slope = np.zeros((of.size, 2 + TABLES))
    slope[:, 0], slope[:, 1] = 1.0, np.repeat(design.uniform(-1.0, 1.0, table.size), 2)
    slope[np.arange(of.size), 2 + of] = np.tile([0.5, -0.3], table.size)
    departures = random.normal(size=(TABLES, 2)) * scatter
    nuisance = own * random.normal(size=TABLES)
    read = random.normal(size=of.size) + np.sum(slope[:, :2] * departures[of], axis=1) + slope[:, 2:] @ nuisance
    residual = np.concatenate([-read, np.zeros(table.size + 2 + TABLES)])
    jacobian = np.concatenate([slope, np.zeros((table.size + 2 + TABLES, 2 + TABLES))])
    jacobian[-TABLES:, 2:] = np.eye(TABLES) / own
    place = np.column_stack([np.zeros(TABLES, int), np.ones(TABLES, int), 2 + np.arange(TABLES)])
    names, values = ("a", "b", *map(str, range(TABLES))), np.zeros(2 + TABLES)
    ends = np.full((values.size, 2), [-np.inf, np.inf])
    parameters = StepParameters(names, values, ends, np.ones(values.size, dtype=bool))
    return StepSystem(residual, jacobian, np.zeros((of.size, 0)), np.eye(of.size), parameters), table, place


def test_pulls_are_those_of_fits_without_the_table():
    system, table, place = linear_sets(3, SCATTER)
    found = pulls_of(parts_of(system, table, place, 2))

    def solved(rows_kept: np.ndarray, columns: np.ndarray):
        slope = system.jacobian[rows_kept][:, columns]
        inverse = np.linalg.inv(slope.T @ slope)
        return -inverse @ slope.T @ system.residual[rows_kept], inverse

    every = np.arange(len(system.residual))
    whole, variance = solved(every, np.arange(2 + TABLES))
    for t, one in enumerate(found):
        mine = np.concatenate([np.repeat(table, 2) == t, np.zeros(len(table) + 2, bool), np.arange(TABLES) == t])
        others, wider = solved(every[~mine], np.delete(np.arange(2 + TABLES), 2 + t))
        moved, spread = (whole[:2] - others[:2]), (wider - np.delete(np.delete(variance, 2 + t, 0), 2 + t, 1))[:2, :2]
        np.testing.assert_allclose(one.pulls, moved / np.sqrt(np.diag(spread)), rtol=1e-7)
        square = moved @ np.linalg.solve(spread, moved)
        # two degrees of freedom: the probability is an exponential
        assert one.p_value == pytest.approx(np.exp(-0.5 * square), rel=1e-6)
        left = (system.residual + system.jacobian @ whole)[mine]
        assert one.chi2 == pytest.approx(left @ left, rel=1e-9)


def test_tables_of_one_law_are_seldom_far_from_the_others():
    improbable = []
    for seed in range(60):
        system, table, place = linear_sets(seed, np.zeros(2))
        improbable += [one.p_value < 0.05 for one in pulls_of(parts_of(system, table, place, 2))]
    assert np.mean(improbable) == pytest.approx(0.05, abs=0.03)


def cut(table: AmplitudeTable, count: int) -> list[AmplitudeTable]:
    """Return every so-many-th row of a table as a table of its own."""
    return [rows(table, np.arange(table.rows)[i::count], source=f"part{i}.csv") for i in range(count)]


def test_names_tell_tables_apart():
    for sources, names in (
        (("x/a.csv", "x/b.csv"), ("a.csv", "b.csv")),
        (("x/a.csv", "y/a.csv"), ("x/a.csv", "y/a.csv")),
        (("a.csv", "a.csv"), ("a.csv (1)", "a.csv (2)")),
    ):
        assert SeveralTables(tuple(made_table(source=source) for source in sources)).labels == names


@pytest.mark.parametrize(
    ("changes", "options", "message"),
    [
        ({"mass_ng": 2.0}, {}, "mass_ng is 1 in a.csv and 2 in b.csv: tips of different mass share no law"),
        ({"quality_factor": 41.0}, {"share": ["quality_factor"]}, "a.csv says 40 \\+- 0.4, and b.csv says 41 \\+- 0.4"),
        ({}, {"share": ["all"], "constraints": {"quality": (1.0, 0.1)}}, "the constraint on 'quality' is on no"),
        ({}, {}, "b.csv holds the same readings as a.csv; give each table once"),
    ],
)
def test_what_tables_cannot_share_is_said(changes: dict, options: dict, message: str):
    with pytest.raises(ValueError, match=message):
        fit([made_table(source="a.csv"), made_table(source="b.csv", **changes)], **options)


def made_joint() -> FitResult:
    """Return a fit of two tables."""
    both = SeveralTables((made_table(source="a.csv"), made_table(source="b.csv", mass_ng=1.001)))
    own = {"quality_factor": made_parameter("quality_factor", 40.0)}
    one = FittedTable("a.csv", "a.csv", 4, 4, 3.0, 7, 1.25, 0.2, {"r": -0.5, "epsilon": None}, own)
    other = dataclasses.replace(one, source="b.csv", name="b.csv", pull=None, p_value=None)
    all_rows = dataclasses.replace(made_rows(made_table(8)), reasons=("",) * 8)
    found = made_fit("law", rows=all_rows)
    return dataclasses.replace(found, table=both, tables=(one, other))


def test_reports_say_each_tables_pull(tmp_path: Path):
    result = made_joint()
    said = " ".join(summary(result).split())
    assert "a.csv 4/4 3.0/7 1.25 -0.50 -" in said
    assert row_records(result)[5] | {"table": "b.csv", "line": 2} == row_records(result)[5]
    # saved and read again, and as a prior
    save(result, tmp_path / "fit.json")
    again = fitting.load(tmp_path / "fit.json")
    assert again.tables[0].pulls == {"r": -0.5, "epsilon": None}
    assert again.table.labels == ("a.csv", "b.csv")
    assert prior_of_fit(json.loads((tmp_path / "fit.json").read_text())).measured.shape == (8, 4)


@pytest.mark.slow
def test_ten_tables_are_the_table_that_they_are_parts_of():
    whole = example_amplitudes()
    parts = cut(whole, 10)
    together = rows(whole, np.concatenate([np.arange(whole.rows)[i::10] for i in range(10)]))
    one, many = fit(together), fit(parts, share=["all"])
    for name, parameter in one.parameters.items():
        assert many.parameters[name].value == pytest.approx(parameter.value, rel=1e-6)
        assert many.parameters[name].interval95 == pytest.approx(parameter.interval95, rel=1e-6)
    assert many.chi2 == pytest.approx(one.chi2, rel=1e-6)
    assert many.law.rebound_high_nm_per_us == pytest.approx(one.law.rebound_high_nm_per_us, rel=1e-6)


@pytest.mark.slow
def test_tables_with_their_own_nuisances_are_their_fits_put_together():
    parts = cut(example_amplitudes(), 3)
    result = fit(parts)
    # each table's law by itself, weighted by its covariance: to first order the same
    information, pushed = np.zeros((2, 2)), np.zeros(2)
    for part in parts:
        alone = fit(part)
        error = standard_errors_of(alone)[:2]
        inverse = np.linalg.inv(alone.correlations[:2, :2] * np.outer(error, error))
        information += inverse
        pushed += inverse @ values_of(alone)[:2]
    error = np.sqrt(np.diag(np.linalg.inv(information)))
    best = np.linalg.solve(information, pushed)
    np.testing.assert_allclose(values_of(result), best, atol=0.1 * error.min(), rtol=2e-3)
    np.testing.assert_allclose(standard_errors_of(result), error, rtol=0.05)
    assert sum(table.chi2 for table in result.tables) == pytest.approx(result.chi2, rel=1e-6)
    assert list(result.parameters) == ["r", "epsilon"]


@pytest.mark.slow
def test_a_table_of_another_law_is_named():
    parts = cut(example_amplitudes(), 4)
    truth = [0.95, 0.951, 0.947, 0.953]
    tables = [
        dataclasses.replace(simulated(part, ImpactLaw(r, 60.0), seed=seed), source=f"part{seed}.csv")
        for seed, (part, r) in enumerate(zip(parts, truth, strict=True))
    ]
    alike = fit(tables)
    assert not alike.valid
    assert "part2.csv is off the others" in " ".join(alike.reasons)


@pytest.mark.slow
def test_a_driven_sample_and_a_driven_tip_have_one_law():
    sample, tapping = cut(example_amplitudes(), 2)[0], read_table("fitting/examples/tapping_contact.csv")
    tapping = dataclasses.replace(tapping, mass_ng=1.0)
    # what the same law predicts for the driven tip, and no noise
    problem = Problem("law", ("r", "epsilon"), drive="force")
    found = Objective(measurement_of(tapping, problem), problem).at_values(np.array([[0.95, 60.0]])).prediction
    steady = np.asarray(found.orbits)[0, : tapping.rows] > 0
    read = np.asarray(found.amplitude_nm)[0, : tapping.rows][steady]
    driven = rows(tapping, steady, lockin_amplitude_nm=read[:, 1], phase_lag_deg=read[:, 2], source="tip.csv")
    one, other = fit([sample, driven]), fit([driven, sample])
    assert one.valid
    assert [table.used for table in one.tables] == [sample.rows, steady.sum()]
    for name, truth in (("r", 0.95), ("epsilon", 60.0)):
        parameter = one.parameters[name]
        assert abs(parameter.value - truth) < 3.0 * (parameter.standard_error or 0.0)
        assert other.parameters[name].value == pytest.approx(parameter.value, rel=1e-6)
    assert one.tables[1].nuisances.keys() > {"tip_calibration", "phase_zero_deg"}
    assert one.tables[0].nuisances.keys() == {"quality_factor"}
