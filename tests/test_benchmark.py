"""The benchmark: its rows, its errors, its processes. Nothing here looks at how long something took."""

import os
from pathlib import Path

import jax
import numpy as np
import pytest

from afm_jax import NextImpact, iterate_map
from afm_jax.bench.impacts import lane_states, one_core, sequence_errors, single_errors
from afm_jax.bench.problems import chaotic_scene, regular_scene, settled_starts
from afm_jax.cli.bench import AIMED_BATCH, FITS, PARTS, aim_of, aim_sentence, map_aims
from afm_jax.studies import timing as own_process
from afm_jax.studies.timing import run_in_own_process
from afm_jax.verify.fifty_digits import ExactMap, reference_error
from fitting.benchmark import time_fits
from tests.answers import answer, table
from tests.run_here import answered_with


@pytest.fixture(scope="module")
def measured() -> dict:
    """The impact map on one core, few and small measurements."""
    return one_core(batches=[1, 6], blocks=[4], impacts=4, repetitions=1, derivative_batch=6)


@pytest.mark.slow
def test_one_core_measures_what_it_says(measured: dict):
    rows = measured["rows"]
    for row in rows:
        assert set(row) <= set(PARTS[0].table.columns)
        assert row["impacts_per_second"] == pytest.approx(1e6 / row["microseconds_per_impact"], rel=1e-12)
    maps = [row for row in rows if row["what"].startswith("next_impact")]
    # the last but one with the law as a table, and starts over the whole period
    shapes = [(row["batch"], row["block"]) for row in maps if row["scene"] == "regular"]
    assert shapes == [(1, 1), (6, 6), (6, 4), (6, 6), (6, 6)]
    # the stated aim; rounding of times around 30 us is 4e-15
    assert all(row["error_us"] < 1e-11 for row in maps)
    assert (maps[-1]["scene"], maps[-1]["error_kind"]) == ("chaotic", "impact by impact")
    slopes = [row["derivative_relative_error"] for row in rows if "derivative_relative_error" in row]
    # near the attractor, whose phase does not depend on r, a derivative is a small difference: it loses five digits
    assert (len(slopes), max(slopes) < 1e-10) == (2, True)
    # its tolerance is 1e-10: an honest error is neither ours nor useless
    assert all(1e-14 < row["error_us"] < 1e-7 for row in rows if row["what"].startswith("SciPy"))


@pytest.mark.slow
def test_all_cores_really_are_several_where_their_number_divides_the_batch():
    settings = {"batches": [3, 4], "impacts": 2, "repetitions": 1}
    rows = run_in_own_process("afm_jax.bench.impacts:all_cores", settings, cores=2)["rows"]
    assert [(row["batch"], row["cores"]) for row in rows] == [(3, 1), (4, 2)]
    assert all(row["error_us"] < 1e-11 for row in rows)


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="this system cannot pin a process")
def test_one_core_really_is_one():
    assert run_in_own_process("afm_jax.compilation_cache:available_cores", {}, cores=1) == 1


def test_a_process_that_fails_is_an_error():
    with pytest.raises(ValueError, match="ended with exit code 1"):
        run_in_own_process("afm_jax.studies.timing:no_such_function", {}, cores=1)


def test_the_error_is_that_of_the_times():
    case = regular_scene()
    starts = settled_starts(case.scene, 1)
    rows = iterate_map(case.scene, starts.time_us[0], starts.velocity_nm_per_us[0], 5)
    states = lane_states(starts, batch_of_one(rows), 0)
    assert sequence_errors(case, states)[0] < 1e-13  # rounding of times around 30 us: 4e-15 each
    # fifty digits; five impacts lose a few
    assert reference_error(case.scene, tuple(states[0]), states[1:, 0]) < 1e-40
    wrong = states.copy()
    wrong[3, 0] += 1e-6
    # a wrong time in the middle is the largest error of the sequence, and nothing else changes
    assert sequence_errors(case, wrong)[0] == pytest.approx(1e-6, rel=1e-6)


def test_single_errors_restart_from_each_state():
    case = chaotic_scene()
    starts = settled_starts(case.scene, 2)
    rows = batch_of_one(iterate_map(case.scene, starts.time_us[0], starts.velocity_nm_per_us[0], 30))
    errors = single_errors(case, starts, rows, lanes=1)
    assert len(errors.ordinary) + len(errors.near_grazing) == 30
    assert np.nanmax(errors.ordinary) < 1e-11
    # as a whole sequence it has lost its digits: 30 impacts in a chaotic scene
    states = lane_states(starts, rows, 0)
    whole = ExactMap(case.scene).error_of_sequence(tuple(states[0]), states[1:, 0])
    assert not whole < 1e-12


def test_starts_are_the_same_for_every_batch():
    scene = regular_scene().scene
    few, many = settled_starts(scene, 3), settled_starts(scene, 70)
    for one, other in zip(few, many, strict=True):
        np.testing.assert_array_equal(np.asarray(one), np.asarray(other)[:3])


def test_aims_are_judged_and_not_invented():
    plain = {"what": "next_impact iterated", "batch": AIMED_BATCH, "impacts_per_second": 2e6, "error_us": 1e-14}
    rows = [plain, {"what": "reverse gradient", "ratio_to_plain": 3.0}]
    judged = {aim["aim"].split(",")[0]: aim for aim in (aim_of(*each) for each in map_aims(rows))}
    assert [aim["met"] for aim in judged.values()] == [False, True, None, True]
    assert aim_sentence(judged["impacts per second"]).endswith("2e+06 reached, not met")
    assert aim_sentence(judged["one forward derivative"]).endswith("not measured in this run")


@pytest.mark.slow
def test_command_writes_tables_and_one_json_object(measured: dict, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    measurements = {"one_core": measured, "all_cores": {"rows": []}}
    monkeypatch.setattr(own_process, "run_in_own_process", answered_with(measurements))
    payload = answer(tmp_path, "bench", "--only", "map", "--quick", "--batch", 2)
    assert {"rows", "contact_rows", "scene_rows", "aims", "machine"} <= set(payload)
    assert payload["contact_rows"] == []
    assert not (tmp_path / "bench_contact.csv").exists()
    assert len(table(tmp_path / "bench.csv")) == len(payload["rows"])


@pytest.mark.slow
def test_fits_of_another_checkout_are_timed_in_turn():
    rows = time_fits(["law"], rows=20, beside=Path(__file__).parents[1])
    assert [row["model"] for row in rows] == ["law", "law (beside)"]
    assert rows[0]["chi2"] == rows[1]["chi2"]
    for row in rows:
        assert set(row) == set(FITS.table.columns)
        assert 0.0 < row["warm_s"] < row["first_s"]


def batch_of_one(rows: NextImpact) -> NextImpact:
    """Return a tip's impacts with a leading axis of one."""
    return jax.tree.map(lambda part: part[None], rows)
