"""The accuracy study: achieved errors are right, and the cheapest setting is the cheapest. No times are judged."""

from pathlib import Path

import pytest

from afm_jax.accuracy.impacts import cheapest_settings, map_accuracy
from afm_jax.accuracy.overview import cheapest, impacts, orbits, overview_row
from afm_jax.cli.accuracy import MAP, OVERVIEW_FULL
from afm_jax.studies import timing as own_process
from tests.answers import answer


@pytest.mark.slow
def test_achieved_errors_are_what_tolerances_and_rounding_allow():
    few = {"batch": 20, "impacts": 5, "lanes": 2, "repetitions": 1}
    study = map_accuracy(root_tolerances_us=[1e-2, 1e-13], scipy_tolerances=[1e-9], **few)
    assert {row["scene"] for row in study["rows"]} == {"regular", "grazing", "order 5"}
    assert len(study["rows"]) == 3 * (2 * 2 + 1)
    assert study["reference_error_us"] < 1e-40  # fifty digits
    for row in study["rows"]:
        assert set(row) <= set(MAP.columns)
        error, tolerance = row["error_us"], row["tolerance"]
        if row["method"] == "next_impact float64":
            # the tolerance bounds the error; rounding of times up to 30 us and of the gap adds 1e-14 or so
            assert error <= tolerance + 1e-13, row
            assert row["impacts_checked"] + row["near_grazing"] == 10
            # a coarse tolerance is made use of, in the first scene at least
            assert error > 1e-4 or tolerance < 1e-2 or row["scene"] != "regular", row
        elif row["method"] == "SciPy DOP853":
            # 1e-9 relative of 10 nm/us, divided by slow approaches
            assert (row["missed_impacts"], error < 1e-6) == (0, True)
        elif tolerance == 1e-13:
            # float32: times of 1 to 30 us have a rounding of 1e-7 to 4e-6; slow impacts multiply it
            assert 1e-8 < error < 1e-3, row


def test_cheapest_is_the_fastest_that_is_good_enough():
    def row(scene: str, tolerance: float, time: float, error: float | None, method="next_impact float64") -> dict:
        own = {"scene": scene, "method": method, "tolerance": tolerance}
        return own | {"microseconds_per_impact": time, "error_us": error}

    rows = [row("a", 1e-2, 1.0, 1e-3), row("a", 1e-8, 2.0, 1e-9), row("b", 1e-2, 1.0, 1e-9), row("b", 1e-8, 3.0, 1e-10)]
    chosen = cheapest_settings([*rows, row("a", 1e-2, 0.1, 1e-12, "SciPy DOP853")], 1e-8)
    found = [(one["scene"], one["tolerance"], one["microseconds_per_impact"]) for one in chosen]
    assert found == [("a", 1e-8, 2.0), ("b", 1e-2, 1.0), ("all", 1e-8, 3.0)]
    assert [one["method"] for one in cheapest_settings(rows, 1e-12)] == [None, None, None]
    # an error that could not be measured is not a good one
    assert cheapest_settings([row("a", 1e-2, 1.0, None)], 1.0)[0]["method"] is None


@pytest.mark.slow
def test_every_integrator_comes_to_the_same_impacts_and_orbit():
    """All solve one problem: at a tight tolerance each is right, by 50 digits, which are none of them."""
    rivals = {"SciPy DOP853", "SUNDIALS CVODE Adams", "Diffrax Dopri8 with Event"}
    few = {"tolerances": [1e-9], "integrators": ["DOP853", "CVODE Adams"], "batch": 4, "repetitions": 1}
    found = impacts(root_tolerances_us=[1e-13], impacts=3, **few)
    closed = orbits(**few)
    assert {row["method"] for row in found["rows"] if not row["own"]} == rivals
    assert {row["method"] for row in closed["rows"] if not row["own"]} == {f"{one}, shooting" for one in rivals}
    for row in (*found["rows"], *closed["rows"]):
        limit = 1e-3 if "float32" in row["method"] else 1e-13 if row["own"] else 1e-6
        assert row["error"] < limit, row


def test_the_cheapest_way_to_an_error_here_and_elsewhere():
    rows = [
        overview_row("orbits", "single_impact_orbits", "one", 5.0, 1e-14),
        overview_row("orbits", "SciPy DOP853, shooting", "loose", 1.0, 1e-4),
        overview_row("orbits", "SciPy DOP853, shooting", "tight", 9.0, 1e-10),
        overview_row("orbits", "SciPy Radau, shooting", "gave up", 0.1, float("nan")),
    ]
    keys = ("wanted_error", "own", "other", "other_microseconds")
    found = [tuple(row[key] for key in keys) for row in cheapest(rows, [1e-3, 1e-9])]
    assert found == [
        (1e-3, "single_impact_orbits, one", "SciPy DOP853, shooting, loose", 1.0),
        (1e-9, "single_impact_orbits, one", "SciPy DOP853, shooting, tight", 9.0),
    ]
    assert cheapest(rows, [1e-15])[0]["own"] is None


def test_overview_draws_a_panel_a_problem(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def measured(task: str, settings: dict, *, cores: int) -> dict:
        del settings, cores
        problem = task.split(":")[1]
        told = {"error_of": "time (us)", "reference": "50 digits", "reference_error": 1e-9}
        rows = [overview_row(problem, "ours", "a", 1.0, 1e-8), overview_row(problem, "SciPy LSODA", "b", 9.0, 0.0)]
        return {"rows": rows, "references": {problem: told}}

    monkeypatch.setattr(own_process, "run_in_own_process", measured)
    payload = answer(tmp_path, "accuracy")
    assert set(payload["references"]) == {task.split(":")[1] for task in OVERVIEW_FULL}
    assert {row["own"] for row in payload["cheapest"]} == {None, "ours, a"}  # an error of 1e-8 is not one of 1e-9
    assert {path.name for path in tmp_path.iterdir()} >= {"accuracy.json", "accuracy.png"}
