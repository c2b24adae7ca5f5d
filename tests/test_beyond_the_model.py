"""Tables that no fitted model made: losses outside the families, rows that are wrong, two laws for one table."""

import numpy as np
import pytest

from afm_jax.contact.parameters import PAPER
from fitting import fit
from fitting.infer.result import FitResult
from fitting.parameters import CONTACT_DEFAULT
from tests.fit_tables import amplitudes_and_errors, with_amplitudes
from tests.impact_tables import bump, contact_impact, deviation, drives, measured, steady_amplitudes, with_loss

pytestmark = pytest.mark.slow


def farthest(result: FitResult, impact) -> float:
    """Return by how many standard errors the law is off at worst; 0 if it is not claimed."""
    return 1.959964 * float(np.max(deviation(result, impact)[1])) if result.valid else 0.0


@pytest.fixture(scope="module")
def contact():
    return contact_impact()


def test_a_loss_outside_the_family_in_a_narrow_range_is_in_the_band(contact):
    """40 % more, a fifth of a decade wide: 5 to 25 standard errors without what runs of residuals add."""
    impact = with_loss(contact, bump(120.0))
    result = fit(measured(drives(), steady_amplitudes(drives(), impact), 0.003, 1), "viscous+delay")
    assert farthest(result, impact) <= 2.5


def test_a_contact_is_valid_and_within_its_band_and_six_rows_off_to_one_side_are_not_passed_over(contact):
    table = measured(drives(), steady_amplitudes(drives(), contact), 0.003, 1)
    result = fit(table, "viscous+delay")
    assert result.valid, result.reasons
    assert farthest(result, contact) <= 2.0
    amplitude, error = amplitudes_and_errors(table)
    amplitude[::10] += 3.0 * error[::10]
    result = fit(with_amplitudes(table, amplitude, error), "viscous+delay")
    assert not result.valid or farthest(result, contact) <= 2.0


def test_five_outliers_leave_a_robust_fit_its_law():
    impact = contact_impact(relative_humidity=0.3, adhesion_energy_j_per_m2=0.2)
    table = measured(drives(), steady_amplitudes(drives(), impact), 0.003, 2)
    amplitude, error = amplitudes_and_errors(table)
    random = np.random.default_rng([2, 7])
    wrong = random.choice(table.rows, 5, replace=False)
    amplitude[wrong] *= 1.0 + random.choice([-1.0, 1.0], 5)[:, None] * random.uniform(0.05, 0.4, 5)[:, None]
    result = fit(with_amplitudes(table, amplitude, error), "viscous+delay", robust=True)
    assert not any(" inf " in reason for reason in result.reasons)
    assert farthest(result, impact) <= 2.5


@pytest.mark.parametrize("truth", [{"structural_amplitude_n_per_m": 60.0}, {"structural_decay_nm": 0.5}])
@pytest.mark.long
def test_what_a_fit_of_the_contact_holds_is_not_exact(truth):
    """The structural force is another one than the fit holds it at: its error is in law, band and intervals."""
    impact = contact_impact(**truth)
    result = fit(measured(drives(), steady_amplitudes(drives(), impact), 0.01, 1), "contact")
    assert result.valid, result.reasons
    assert np.mean(deviation(result, impact)[1] <= 1.0) >= 0.9
    assert farthest(result, impact) <= 2.5
    for name in CONTACT_DEFAULT:
        low, high = result.parameters[name].interval95
        assert low is None or low < PAPER[name]
        assert high is None or PAPER[name] < high
    (said,) = [warning for warning in result.warnings if warning.startswith("Assumed, because nothing states it: ")]
    assert "structural_amplitude_n_per_m = 40 +- 12" in said
