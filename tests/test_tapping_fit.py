"""Fits of driven tips: the law of a full contact from amplitude and phase, and what is said where there is none."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from fitting.infer.fit import fit
from fitting.infer.result import FitResult
from fitting.models import reach_of, readings_of, tip_work
from fitting.tables.csv_text import TableError
from fitting.tables.table import AmplitudeTable
from tests.tapping_accuracy import (
    FEW_SHARES,
    KNOWN,
    RATIO,
    WORST_OF_CONTACT,
    against_truth,
    contact_of,
    fitted,
    forward,
    judge_fits,
    judge_forward,
    noisy,
    speeds_covered,
)
from tests.tapping_truths import TappingTruth, as_measured, exact_table, tapping_truth

TABLES = Path(__file__).parent / "tapping_tables"
"""Truths of some of the random contacts of `tests.tapping_accuracy`."""


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
    found = tip_work(table, 200.0)[0]
    time = np.linspace(0.0, 2.0 * np.pi, 1000, endpoint=False)
    z, f = (np.real(part * np.exp(1j * time)) for part in (height, force))
    v = np.real(1j * height * np.exp(1j * time))
    np.testing.assert_allclose([found.real, found.imag], [2.0 * np.mean(f * z), -2.0 * -np.mean(f * v)], rtol=1e-9)
    assert reach_of(table, 200.0).tolist() == [0, 1, 2]
    without = dataclasses.replace(table, phase_lag_deg=None, phase_lag_error_deg=None)
    assert np.isfinite(readings_of(table)[0]).any(axis=0).tolist() == [False, True, True]
    assert np.isfinite(readings_of(without)[0]).any(axis=0).tolist() == [False, True, False]
    assert np.isnan(tip_work(without, 200.0)).all()


def judge_fits_of(truth: TappingTruth, table: AmplitudeTable) -> None:
    """Fit the law of a table without noise and of one with it, and say whether both are as wanted."""
    for name, made in (("exact", table), ("noisy", noisy(table, truth, 0))):
        found = fitted(truth, made)
        assert found is not None
        assert judge_fits(name, [found], exact=name == "exact") == 0


@pytest.mark.slow
def test_an_unseen_contact_is_predicted_and_fitted_as_wanted():
    """One of those of `make tapping`."""
    truth = tapping_truth(0)
    exact = exact_table(truth, RATIO, TABLES)
    found = forward(truth, exact).fast()
    assert len(found.nm) >= 8
    assert judge_forward("unseen", found) == 0
    judge_fits_of(truth, as_measured(exact))


@pytest.mark.slow
def test_a_sticky_contact_on_which_the_lever_pulls_hard_is_fitted_as_wanted():
    """Most rows are under 0.8 to 1.2 times the pull that turns the tip round, and are predicted as well as others."""
    truth = tapping_truth(4)
    exact = exact_table(truth, RATIO, TABLES)
    found = forward(truth, exact).fast(pull_from=0.8, pull_to=1.2)
    assert len(found.nm) >= 5
    assert found.nm.max() < 0.07
    assert found.degrees.max() < 0.01
    # of the noisy one the viscous loss ends next to 0, where its coordinate has no curvature
    judge_fits_of(truth, as_measured(exact))


def law_at(result: FitResult, speeds: np.ndarray) -> list[np.ndarray]:
    """Return rebound speeds of a fitted law and the ends of its band."""
    law = result.law
    columns = law.rebound_speed_nm_per_us, law.rebound_low_nm_per_us, law.rebound_high_nm_per_us
    return [np.interp(speeds, law.approach_speed_nm_per_us, column) for column in columns]


@pytest.mark.slow
@pytest.mark.long
def test_a_contact_comes_out_of_a_noisy_curve():
    """What its taps hold, and to one side what they hold no better; the tip's radius and the humidity are known."""
    truth = tapping_truth(0)
    table = noisy(as_measured(exact_table(truth, RATIO, TABLES)), truth, 0)
    result = contact_of(truth, table)
    # a tip held at a radius that is 30 % too large
    known = {name: truth.parameters[name] for name in KNOWN}
    held = fit(table, "contact", fixed=known | {"tip_radius_nm": 1.3 * known["tip_radius_nm"]})
    for one in (result, held):
        assert one.valid, one.reasons
        for name in ("adhesion_energy_j_per_m2", "viscosity_pa_s", "modulus_gpa"):
            low, high = one.parameters[name].interval95
            assert (low or 0.0) < truth.parameters[name] < (high or np.inf)
    found = against_truth(truth, result)
    # those next to the sample too
    assert result.rows.used.all()
    assert found is not None
    assert np.max(np.abs(found.law)) < WORST_OF_CONTACT
    assert result.parameters["viscosity_pa_s"].at_bound
    assert None not in result.parameters["modulus_gpa"].interval95
    speeds = speeds_covered(truth, held)
    _, low, high = law_at(held, speeds)
    assert np.mean((low <= truth.rebound(speeds)) & (truth.rebound(speeds) <= high)) >= 0.9
    assert any(one.startswith("Assumed, because nothing states it: ") for one in held.warnings)


@pytest.mark.parametrize("ratio", [0.99, 1.0])
def test_a_contact_is_not_fitted_on_resonance(ratio: float):
    table = exact_table(tapping_truth(1), 1.0, TABLES, FEW_SHARES)
    there = dataclasses.replace(table, drive_frequency_khz=ratio * np.asarray(table.drive_frequency_khz))
    with pytest.raises(TableError, match=rf"driven at {ratio:.3f} of the free frequency.*`afm-jax tapping CURVE`"):
        fit(there, "contact")
