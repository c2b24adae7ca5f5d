"""Several tables fitted together: one law, nuisances of each, pulls and scatter, against direct calculations."""

import dataclasses
import json
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

import fitting
from afm_jax.columns import csv_columns, rows_of
from afm_jax.impact.law import ImpactLaw
from afm_jax.impact.orbits import single_impact_orbits
from afm_jax.saved import save
from fitting.experiments.prior import prior_of_fit
from fitting.infer.fit import fit
from fitting.infer.result import FitResult, FittedTable
from fitting.infer.several import Parts, pulls_of
from fitting.tables.several import SeveralTables
from fitting.tables.table import AmplitudeTable, read_table
from tests.fit_tables import example_amplitudes, rows, simulated, standard_errors_of, values_of
from tests.made_fits import made_fit, made_parameter, made_rows, made_table
from tests.test_driven_orbits import driven

TABLES, READINGS = 5, 24


class Linear(NamedTuple):
    """Residuals that are linear in two parameters of a law (both 0) and a nuisance of each table, priors last.

    ``table``: which one each residual is of.
    """

    residual: np.ndarray
    jacobian: np.ndarray
    table: np.ndarray

    def parts(self) -> Parts:
        """Return the normal equations of every table, and of what is no table's own: nothing."""
        blocks = [self.table == t for t in range(TABLES + 1)]
        slopes, left = ([whole[block] for block in blocks] for whole in (self.jacobian, self.residual))
        return Parts(
            matrix=np.array([slope.T @ slope for slope in slopes]),
            vector=np.array([slope.T @ one for slope, one in zip(slopes, left, strict=True)]),
            square=np.array([one @ one for one in left]),
            own=np.eye(2 + TABLES, dtype=bool)[2:],
            law=np.arange(2),
        )


def linear_tables(seed: int, scatter: np.ndarray, own: float = 0.3) -> Linear:
    """Return tables with unit noise whose laws scatter, and whose nuisances are known to within an error."""
    random, design = np.random.default_rng(seed), np.random.default_rng(1)
    table = np.repeat(np.arange(TABLES), READINGS)
    slope = np.zeros((table.size, 2 + TABLES))
    slope[:, 0], slope[:, 1] = 1.0, np.repeat(design.uniform(-1.0, 1.0, table.size // 2), 2)
    slope[np.arange(table.size), 2 + table] = np.tile([0.5, -0.3], table.size // 2)
    truth = random.normal(size=(TABLES, 2)) * scatter
    read = np.sum(slope[:, :2] * truth[table], axis=1) + slope[:, 2:] @ (own * random.normal(size=TABLES))
    known = np.eye(2 + TABLES)[2:] / own
    residual = np.append(-read - random.normal(size=table.size), np.zeros(TABLES))
    return Linear(residual, np.concatenate([slope, known]), np.append(table, np.arange(TABLES)))


def test_pulls_are_those_of_fits_without_the_table():
    tables = linear_tables(3, np.array([0.6, 0.3]))

    def solved(kept: np.ndarray, columns: np.ndarray):
        slope = tables.jacobian[kept][:, columns]
        inverse = np.linalg.inv(slope.T @ slope)
        return -inverse @ slope.T @ tables.residual[kept], inverse

    whole, variance = solved(np.ones(tables.table.size, bool), np.arange(2 + TABLES))
    for t, one in enumerate(pulls_of(tables.parts())):
        mine = tables.table == t
        others, wider = solved(~mine, np.delete(np.arange(2 + TABLES), 2 + t))
        moved, spread = whole[:2] - others[:2], wider[:2, :2] - variance[:2, :2]
        square = moved @ np.linalg.solve(spread, moved)
        # two degrees of freedom: the probability is an exponential
        assert one.p_value == pytest.approx(np.exp(-0.5 * square), rel=1e-6)
        left = (tables.residual + tables.jacobian @ whole)[mine]
        assert one.chi2 == pytest.approx(left @ left, rel=1e-9)


def test_tables_of_one_law_are_seldom_far_from_the_others():
    pulls = [one for seed in range(60) for one in pulls_of(linear_tables(seed, np.zeros(2)).parts())]
    assert np.mean([one.p_value < 0.05 for one in pulls]) == pytest.approx(0.05, abs=0.03)


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
    one = FittedTable("a.csv", 4, 4, 3.0, 7, 1.25, 0.2, own)
    other = dataclasses.replace(one, name="b.csv", pull=np.nan, p_value=np.nan)
    all_rows = dataclasses.replace(made_rows(made_table(8)), reasons=("",) * 8)
    found = made_fit("law", rows=all_rows)
    return dataclasses.replace(found, table=both, tables=(one, other))


def test_reports_say_each_tables_pull(tmp_path: Path):
    result = made_joint()
    said = " ".join(str(result).split())
    assert "a.csv 4/4 3.0/7 1.25 b.csv 4/4 3.0/7 -" in said
    rows = rows_of(csv_columns(result)["fit_rows.csv"])
    assert rows[5] | {"table": "b.csv", "line": 2} == rows[5]
    # saved and read again, and as a prior
    save(result, tmp_path / "fit.json")
    again = fitting.load(tmp_path / "fit.json")
    assert (again.tables[0].pull, np.isnan(again.tables[1].pull)) == (1.25, True)
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
    assert "part2.csv differs from the others" in " ".join(alike.reasons)
    pulls = [table.pull for table in alike.tables]
    assert min(pulls[2:]) > 4.0 > max(pulls[:2])


@pytest.mark.slow
def test_a_driven_sample_and_a_driven_tip_have_one_law():
    sample, tapping = cut(example_amplitudes(), 2)[0], read_table("fitting/examples/tapping_contact.csv")
    tapping = dataclasses.replace(tapping, mass_ng=1.0)
    # what the same law does to a tip that a force drives, without noise
    ratio, free, offset = tapping.drive_frequency_khz / 90.0, tapping.excitation_nm, tapping.offset_nm
    drives = zip(ratio, free, offset, strict=True)
    found = [single_impact_orbits(driven("force", ImpactLaw(0.95, 60.0), *drive, 200.0), 1) for drive in drives]
    steady = np.array([orbits.exists & orbits.admissible & orbits.stable for orbits in found])
    assert steady.sum(axis=1).max() == 1
    kinds = ("drive_lockin_amplitude_nm", "phase_lag_deg")
    amplitude, lag = (np.array([getattr(orbits, kind) for orbits in found])[steady] for kind in kinds)
    there = np.flatnonzero(steady.any(axis=1))
    tip = rows(tapping, there, lockin_amplitude_nm=amplitude, phase_lag_deg=lag, source="tip.csv")
    one, other = fit([sample, tip]), fit([tip, sample])
    assert one.valid
    assert [table.used for table in one.tables] == [sample.rows, tip.rows]
    for name, truth in (("r", 0.95), ("epsilon", 60.0)):
        parameter = one.parameters[name]
        assert abs(parameter.value - truth) < 3.0 * (parameter.standard_error or 0.0)
        assert other.parameters[name].value == pytest.approx(parameter.value, rel=1e-6)
    assert one.tables[1].nuisances.keys() > {"tip_calibration", "phase_zero_deg"}
    assert one.tables[0].nuisances.keys() == {"quality_factor"}
