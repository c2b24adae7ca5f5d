"""Fits of driven tips: the law of a full contact from amplitude and phase, and what is said where there is none."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.contact.contact import Contact
from afm_jax.contact.law_of_contact import tabulated
from afm_jax.least_squares import Box, distance
from fitting.examples import make_tapping_curve
from fitting.fits.fit import fit
from fitting.fits.intervals import Places
from fitting.fits.minimum import Minimum, settle
from fitting.fits.objective import Objective
from fitting.models import measurement_of, problem_of, reach_of, rows_of, tip_work
from fitting.tables.table import AmplitudeTable, read_table
from tests.tapping_accuracy import (
    FEW_SHARES,
    RATIO,
    WORST_OF_CONTACT,
    against_truth,
    contact_of,
    fitted,
    forward,
    judge_fits,
    noisy,
)
from tests.tapping_truths import as_measured, exact_table, tapping_truth

EXAMPLE = "fitting/examples/tapping_contact.csv"
TABLES = Path(__file__).parent / "tapping_tables"
"""Truths of some of the random contacts of `tests.tapping_accuracy`."""
TIP = Cantilever(90.0, 200.0, 16.81)


def test_work_of_a_free_and_of_a_drawn_tip():
    """The force of a known height: F/k = gamma Z - F_drive/k, written out for one period."""
    ratio, free, height = 1.1, 80.0, 40.0 * np.exp(-0.3j)
    gamma = 1.0 - ratio**2 + 1j * ratio / 200.0
    force = gamma * (height + free)
    lag = np.rad2deg(np.angle(gamma) - np.angle(-height))
    table = AmplitudeTable(
        drive="force",
        drive_frequency_khz=np.array([99.0, 99.0, 99.0]),
        free_amplitude_nm=np.array([free, free, free]),
        offset_nm=np.array([-40.0, -90.0, -81.0]),
        free_frequency_khz=90.0,
        lockin_amplitude_nm=np.array([40.0, 80.0, 79.0]),
        lockin_amplitude_error_nm=np.ones(3),
        phase_lag_deg=np.array([lag, 178.5, 178.5]),
        phase_lag_error_deg=np.ones(3),
    )
    rows = rows_of(table)
    found = tip_work(rows, TIP, "force")[0]
    time = np.linspace(0.0, 2.0 * np.pi, 1000, endpoint=False)
    z, f = (np.real(part * np.exp(1j * time)) for part in (height, force))
    v = np.real(1j * height * np.exp(1j * time))
    np.testing.assert_allclose([found.real, found.imag], [2.0 * np.mean(f * z), -2.0 * -np.mean(f * v)], rtol=1e-9)
    assert reach_of(rows, TIP, "force")[:3].tolist() == [0, 1, 2]


@pytest.mark.slow
def test_two_tapping_curves_give_the_law_of_their_contact():
    table = read_table(EXAMPLE)
    result = fit(table, "viscous+delay")
    contact = tabulated(Contact.paper(**make_tapping_curve.CONTACT), 16.81)
    speeds = result.rows.approach_speed_nm_per_us[result.rows.used]
    grid = np.linspace(speeds.min(), speeds.max(), 50)
    exact = np.asarray(jax.vmap(contact.speeds)(jnp.asarray(grid)).rebound)
    found = np.interp(grid, result.law.approach_speed_nm_per_us, result.law.rebound_speed_nm_per_us)
    # 0.3 % and 0.2 degrees of noise: one draw; the median of several is 0.3 %
    np.testing.assert_allclose(found, exact, rtol=0.012)
    assert result.rows.residual.shape == (table.rows, 3)
    assert abs(result.parameters["tip_calibration"].value - 1.0) < 0.015
    without = dataclasses.replace(table, phase_lag_deg=None, phase_lag_error_deg=None)
    assert rows_of(without).amplitude_nm.shape[1] == 2


@pytest.mark.slow
def test_an_unseen_contact_is_predicted_and_fitted_as_wanted():
    """One of those of `make tapping`."""
    truth = tapping_truth(0)
    exact = exact_table(truth, RATIO, TABLES)
    nm, degrees, amplitude, speed, pull = (np.asarray(part) for part in forward(truth, exact))
    used = (speed > 4.0) & (pull < 0.8) & np.isfinite(nm)
    assert np.count_nonzero(used) >= 8
    assert np.max(np.abs(nm[used])) < 0.07
    assert np.max(np.abs(degrees[used])) < 0.1
    assert np.median(np.abs(nm / amplitude)[used]) < 1e-3
    table = as_measured(exact)
    for name, made in (("exact", table), ("noisy", noisy(table, truth, 0))):
        found = fitted(truth, made)
        assert found is not None
        assert judge_fits(name, [found], exact=name == "exact") == 0


@pytest.mark.slow
def test_a_sticky_contact_on_which_the_lever_pulls_hard_is_fitted_as_wanted():
    """Most of its rows are pulled by 0.8 to 1.2 times what turns the tip round, and are predicted as well as others."""
    truth = tapping_truth(4)
    exact = exact_table(truth, RATIO, TABLES)
    found = forward(truth, exact)
    used = (found.speed > 4.0) & (found.pull > 0.8) & (found.pull < 1.2)
    assert np.count_nonzero(used) >= 5
    assert np.max(np.abs(found.nm[used])) < 0.07
    assert np.max(np.abs(found.degrees[used])) < 0.01
    # of the second one the viscous loss ends next to 0, where its coordinate has no curvature
    for name, made in (("exact", as_measured(exact)), ("noisy", noisy(as_measured(exact), truth, 0))):
        result = fitted(truth, made)
        assert result is not None
        assert judge_fits(name, [result], exact=name == "exact") == 0


@pytest.mark.slow
def test_a_soft_contact_is_predicted_as_wanted_above_resonance():
    """The softest of those of `make tapping`: its surface is 0.6 nm above gap 0, as its delays say."""
    truth = tapping_truth(2)
    found = forward(truth, exact_table(truth, 1.1, TABLES, FEW_SHARES))
    nm, degrees, share = np.abs(found.nm), np.abs(found.degrees), np.abs(found.nm / found.amplitude_nm)
    assert nm.shape == (16,)
    assert np.min(found.speed) > 4.0
    assert nm.max() < 0.02
    assert degrees.max() < 0.02
    assert np.median(share) < 1e-3
    assert np.median(degrees) < 0.01


@pytest.mark.slow
def test_a_contact_comes_out_of_a_noisy_curve():
    """What its taps hold, and to one side what they hold no better; nothing but the tip's radius is known."""
    truth = tapping_truth(0)
    table = noisy(as_measured(exact_table(truth, RATIO, TABLES)), truth, 0)
    result = contact_of(truth, table)
    assert result.valid, result.reasons
    found = against_truth(truth, result)
    # those next to the sample too
    assert result.rows.used.all()
    assert found is not None
    assert np.max(np.abs(found.law)) < WORST_OF_CONTACT
    for name in ("relative_humidity", "adhesion_energy_j_per_m2", "viscosity_pa_s", "modulus_gpa"):
        low, high = result.parameters[name].interval95
        assert (low or 0.0) < truth.parameters[name] < (high or np.inf)
    assert result.parameters["viscosity_pa_s"].at_bound
    assert None not in result.parameters["modulus_gpa"].interval95
    # a tip held at a radius that is 30 % too large
    held = fit(table, "contact", fixed={"tip_radius_nm": 1.3 * truth.parameters["tip_radius_nm"]})
    assert held.valid, held.reasons
    for name in ("relative_humidity", "adhesion_energy_j_per_m2", "viscosity_pa_s", "modulus_gpa"):
        low, high = held.parameters[name].interval95
        assert (low or 0.0) < truth.parameters[name] < (high or np.inf)
    band = held.law
    there = held.rows.approach_speed_nm_per_us[held.rows.used]
    speeds = np.linspace(max(np.nanmin(there), 1.05 * float(truth.impact.lowest)), np.nanmax(there), 60)
    low, high = (
        np.interp(speeds, band.approach_speed_nm_per_us, end)
        for end in (band.rebound_low_nm_per_us, band.rebound_high_nm_per_us)
    )
    assert np.mean((low <= truth.rebound(speeds)) & (truth.rebound(speeds) <= high)) >= 0.9
    assert any(one.startswith("Held, with errors that are assumed: ") for one in held.warnings)
    assert any(one.startswith("modulus_gpa depends on what is held: tip_radius_nm") for one in held.warnings)


@pytest.mark.slow
def test_light_taps_that_leave_adhesion_and_modulus_open_are_fitted_to_their_minimum():
    truth = tapping_truth(1)
    table = noisy(as_measured(exact_table(truth, 1.0, TABLES, FEW_SHARES)), truth, 0)
    fixed = {"tip_radius_nm": truth.parameters["tip_radius_nm"]}
    problem = problem_of(table, "contact", fixed=fixed)
    objective = Objective(measurement_of(table, problem, None, fixed), problem)
    near = np.array([0.2416, 0.163, 1e-5, 28.0, 393.5, -0.004, 0.9994, 90.002, 0.074])
    found = settle(objective, Minimum(problem.coordinates(near), near, near[None], np.zeros(1)))
    end = problem.values(found.coordinates)
    places = Places(objective.following(end))
    here = places.look(places.of_values(end)[None], np.arange(1))
    known = places.known_by_range(found.coordinates)
    box = Box(places.lowest, places.highest, np.zeros(here.place.shape, dtype=bool), known=known)
    assert distance(here, box)[0] < 1e-6


def with_free_ends(table: AmplitudeTable) -> AmplitudeTable:
    """Return a table with three rows of the free tip before the others, three after, in order of time."""
    names = (
        "drive_frequency_khz",
        "free_amplitude_nm",
        "offset_nm",
        "lockin_amplitude_nm",
        "lockin_amplitude_error_nm",
    )
    names += ("phase_lag_deg", "phase_lag_error_deg")
    lag = np.rad2deg(np.angle(1.0 - RATIO**2 + 1j * RATIO / (table.quality_factor or np.inf)))
    ends = [np.array([90.0 * RATIO, one, -one - 30.0, one, 0.003 * one, lag, 0.2]) for one in (80.0, 40.0)]
    columns = {
        name: np.concatenate([np.full(3, ends[0][i]), np.asarray(getattr(table, name)), np.full(3, ends[1][i])])
        for i, name in enumerate(names)
    }
    return dataclasses.replace(table, **columns, order=np.zeros(0, dtype=int), rows_in_order_of_time=True)


@pytest.mark.slow
@pytest.mark.parametrize(("degrees", "share", "begin"), [(0.3, 0.01, 0.0), (1.0, 0.03, -0.5), (5.0, 0.03, 0.0)])
def test_drifts_along_the_rows_are_told_by_free_rows(degrees: float, share: float, begin: float):
    truth = tapping_truth(0)
    steady = with_free_ends(as_measured(exact_table(truth, RATIO, TABLES)))
    # the phase drifts, and the free amplitude away from what the table says of it
    course = np.linspace(begin, begin + 1.0, steady.rows)
    noise = np.random.default_rng(1).normal(size=(3, steady.rows))
    read = {name: np.asarray(getattr(steady, name)) for name in steady.form.names if getattr(steady, name) is not None}
    drifted = dataclasses.replace(
        steady,
        phase_lag_deg=read["phase_lag_deg"] + degrees * course + read["phase_lag_error_deg"] * noise[0],
        lockin_amplitude_nm=read["lockin_amplitude_nm"] + read["lockin_amplitude_error_nm"] * noise[1],
        free_amplitude_nm=read["free_amplitude_nm"] / (1.0 + share * course),
    )
    result = fit(drifted, "viscous+delay")
    assert result.valid, result.reasons
    for name, drift, error in (("phase_drift_deg", degrees, 0.3), ("free_amplitude_drift", share, 0.005)):
        found = result.parameters[name]
        assert found.standard_error is not None
        assert abs(found.value - drift) < 2.5 * found.standard_error < 2.5 * error
    speeds = result.rows.approach_speed_nm_per_us[result.rows.used]
    grid = np.linspace(max(np.nanmin(speeds), 1.05 * float(truth.impact.lowest)), np.nanmax(speeds), 60)
    law, low, high = (
        np.interp(grid, result.law.approach_speed_nm_per_us, column)
        for column in (
            result.law.rebound_speed_nm_per_us,
            result.law.rebound_low_nm_per_us,
            result.law.rebound_high_nm_per_us,
        )
    )
    assert np.all(np.abs(law - truth.rebound(grid)) < 2.5 / 1.96 * 0.5 * (high - low))
    np.testing.assert_allclose(law, truth.rebound(grid), rtol=0.02)
