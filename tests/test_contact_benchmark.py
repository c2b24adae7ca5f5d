"""The contact's benchmark and accuracy study: their reference, their baseline, their choices."""

import numpy as np
import pytest

from afm_jax.accuracy.collisions import cheapest_collision
from afm_jax.bench import collisions
from afm_jax.bench.collisions import REFERENCE, errors_against, speeds_of
from afm_jax.bench.scipy_contacts import scipy_collision
from afm_jax.contact.collide import batch_of
from afm_jax.contact.contact import Contact
from afm_jax.contact.settings import SETTINGS
from afm_jax.plots.accuracy import collide_accuracy_figure
from afm_jax.studies import timing as own_process
from tests import reference_contact as exact
from tests.answers import answer, table
from tests.run_here import run_here


@pytest.fixture(scope="module")
def reference():
    return batch_of(Contact.paper(), 1.0, speeds_of(9), REFERENCE)


def test_the_reference_is_that_of_mpmath(reference):
    for place in (0, 4, 8):
        expected = exact.collision(exact.ContactParameters(), float(speeds_of(9)[place]), digits=20)
        rebound, delay = reference.rebound_speed_nm_per_us[place], reference.collision_delay_us[place]
        # converged to rounding: energies of 100 aJ, of which the slowest tip keeps 12
        assert float(rebound) == pytest.approx(float(expected.rebound_speed_nm_per_us), rel=1e-12)
        assert float(delay) == pytest.approx(float(expected.delay_us), abs=1e-12)


def test_scipys_baseline_follows_the_same_tip():
    found = scipy_collision(Contact.paper(), 30.0, method="DOP853", rtol=1e-9)
    expected = exact.collision(exact.ContactParameters(), 30, digits=20)
    assert found.rebound_speed_nm_per_us == pytest.approx(float(expected.rebound_speed_nm_per_us), rel=1e-7)
    assert found.collision_delay_us == pytest.approx(float(expected.delay_us), abs=1e-7)
    assert found.evaluations > 100
    with pytest.raises(ValueError, match="without an event"):
        scipy_collision(Contact.paper(), 5.0, method="DOP853", rtol=1e-6)


def test_errors_are_the_largest_of_each_kind(reference):
    wrong = reference._replace(
        rebound_speed_nm_per_us=reference.rebound_speed_nm_per_us * np.linspace(1.0, 1.001, 9),
        collision_delay_us=reference.collision_delay_us - 2e-5,
    )
    rebound, delay = errors_against(wrong, reference)
    assert rebound == pytest.approx(1e-3, rel=1e-9)
    assert delay == pytest.approx(2e-5, rel=1e-9)


def row(method, time, rebound, delay, precision="float64"):
    cost = {"method": method, "variable": "gap", "setting": "", "precision": precision, "microseconds_per_impact": time}
    return cost | {"rebound_error": rebound, "delay_error_us": delay, "slope_error": rebound}


def test_the_cheapest_contestant_meets_both_errors():
    rows = [
        row("Tsit5, adaptive", 1.0, 1e-5, 1e-9),
        row("Dopri5, adaptive", 2.0, 1e-7, 2e-5),
        row("Dopri8, adaptive", 3.0, 1e-7, 9e-6),
        row("collide, diffrax", 0.5, 1e-7, 1e-7, "float32"),
        row("SciPy LSODA", None, None, None),
    ]
    assert (cheapest_collision(rows, 1e-6) or {})["method"] == "Dopri8, adaptive"
    assert cheapest_collision(rows, 1e-12) is None
    assert [len(axes.lines) for axes in collide_accuracy_figure(rows).axes] == [4, 4, 4]


def run_quickly(monkeypatch, folder, *arguments):
    """Return what a command prints as JSON, its measurement made in this process."""
    monkeypatch.setattr(own_process, "run_in_own_process", run_here)
    return answer(folder, *arguments, "--quick")


@pytest.mark.slow
def test_accuracy_command_shows_errors_and_the_cheapest(monkeypatch, tmp_path):
    payload = run_quickly(monkeypatch, tmp_path, "accuracy", "collide")
    # energies of 100 aJ, of which the slowest tip keeps 12: some roundings
    assert payload["reference_error"] < 1e-13
    for row in payload["rows"]:
        accuracy = row.get("accuracy", 1e-4)
        assert row["rebound_error"] <= accuracy
        assert max(row["delay_error_us"], row["slope_error"] or 0.0) <= 10.0 * accuracy
    assert payload["cheapest"]["method"].startswith("collide")
    assert len(table(tmp_path / "accuracy.csv")) == len(payload["rows"])


@pytest.mark.slow
@pytest.mark.long
def test_bench_command_measures_the_contact_alone(monkeypatch, tmp_path):
    # every level compiles for seconds: three of them show what all would
    fewer = {"diffrax": [1e-6, 1e-9], "collocation": [1e-6]}
    levels = {method: {level: SETTINGS[method][level] for level in chosen} for method, chosen in fewer.items()}
    monkeypatch.setattr(collisions, "SETTINGS", levels)
    payload = run_quickly(monkeypatch, tmp_path, "bench", "--only", "contact")
    assert payload["rows"] == []
    assert not (tmp_path / "bench.csv").exists()
    assert all(aim["reached"] is not None for aim in payload["aims"])
    assert [aim["met"] for aim in payload["aims"] if "error" in aim["aim"]] == [True, True]
    assert len(table(tmp_path / "bench_contact.csv")) == len(payload["contact_rows"])
