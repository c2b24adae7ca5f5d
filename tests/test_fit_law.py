"""The impact law and the delay law of a contact: the published table, closed forms, SciPy, and the command."""

import numpy as np
import pytest
from scipy.optimize import minimize

from afm_jax import Contact, ImpactLaw, find_junction
from fitting import delay_of_contact, law_of_contact
from tests.reference_contact import ContactParameters, collision

PAPER = Contact.paper()


# Rows of the table of laws fitted to this contact by independent code, as printed there: r, epsilon, c in nm/us, worst
# error in percent of the rebound speed. The last digit printed is what they are good for.
@pytest.mark.parametrize(
    ("model", "r", "epsilon", "viscous_loss", "worst_percent"),
    [
        ("law", 0.9981, 122.0, 0.0, 0.48),
        ("viscous", 1.0, 113.6, 0.50, 0.05),
        ("full", 0.9999, 114.0, 0.48, 0.03),
    ],
)
def test_published_table_of_laws(model, r, epsilon, viscous_loss, worst_percent):
    law = law_of_contact(PAPER, model=model)
    assert law.converged
    np.testing.assert_allclose(law.r, r, rtol=0.0, atol=0.6e-4)
    np.testing.assert_allclose(law.epsilon, epsilon, rtol=0.0, atol=0.5 if epsilon != 113.6 else 0.05)
    np.testing.assert_allclose(law.viscous_loss, viscous_loss, rtol=0.0, atol=0.006)
    np.testing.assert_allclose(100.0 * law.worst_relative_error, worst_percent, rtol=0.12, atol=0.0)
    np.testing.assert_allclose(law.speed_range, (1.5 * 10.93845, 250.0), rtol=1e-6, atol=0.0)


def test_without_viscosity_the_law_is_the_hysteresis():
    contact = Contact.paper(effects=("capillary", "structural", "core", "jkr"))
    for model in ("law", "viscous", "full"):
        law = law_of_contact(contact, model=model, mass_ng=2.0)
        # u_out^2 = u_in^2 - 2 hysteresis/m exactly: only rounding and the fit's tolerance are left
        np.testing.assert_allclose(law.epsilon, float(find_junction(contact).hysteresis_aj), rtol=1e-9, atol=0.0)
        np.testing.assert_allclose(law.r, 1.0, rtol=0.0, atol=1e-11)
        np.testing.assert_allclose(law.viscous_loss, 0.0, rtol=0.0, atol=1e-9)
        assert law.worst_relative_error < 1e-10
        np.testing.assert_allclose(
            law.capture_speed_nm_per_us, law.contact_capture_speed_nm_per_us, rtol=1e-8, atol=0.0
        )


@pytest.mark.parametrize("model", ["law", "full"])
def test_no_other_law_is_closer(model: str):
    fitted = law_of_contact(PAPER, model=model, points=60)
    speeds, rebound = fitted.approach_speed_nm_per_us, fitted.rebound_speed_nm_per_us

    def misfit(values):
        loss, epsilon, viscous_loss = values if model == "full" else (*values, 0.0)
        predicted = np.sqrt((1.0 - 1e-2 * loss) * speeds**2 - viscous_loss * speeds - 100.0 * epsilon)
        return np.sum((predicted / rebound - 1.0) ** 2)

    start = {"law": [0.3, 1.2], "full": [0.1, 1.1, 0.4]}[model]
    # another method, without gradients
    other = minimize(misfit, start, method="Nelder-Mead", options={"xatol": 1e-10, "fatol": 0.0, "maxiter": 4000})
    # the sum is flat at its minimum
    np.testing.assert_allclose(np.sum(fitted.relative_error**2), other.fun, rtol=1e-6, atol=0.0)
    own = np.asarray(ImpactLaw(fitted.r, fitted.epsilon, fitted.viscous_loss).rebound_speed(speeds)) / rebound - 1.0
    told = fitted.worst_relative_error, fitted.rms_relative_error
    np.testing.assert_allclose(told, (np.abs(own).max(), np.sqrt(np.mean(own**2))), rtol=1e-10, atol=0.0)


@pytest.fixture(scope="module")
def delay():
    return delay_of_contact(PAPER, speed_range=(15.0, 700.0))


def test_lag_and_lead_are_the_definitions(delay):
    np.testing.assert_allclose(delay.lag_us - delay.lead_us, delay.delay_us, rtol=0.0, atol=1e-16)
    parameters = ContactParameters()
    for index in (0, 200, 511):
        speed = float(delay.approach_speed_nm_per_us[index])
        exact = collision(parameters, speed, digits=15)
        # ten times the relative accuracy of the rebound speed
        np.testing.assert_allclose(delay.delay_us[index], float(exact.delay_us), rtol=0.0, atol=1e-8)
        np.testing.assert_allclose(delay.lag_us[index], float(exact.time_in_junction_us), rtol=0.0, atol=1e-8)
        lead = exact.time_in_junction_us - exact.delay_us
        np.testing.assert_allclose(delay.lead_us[index], float(lead), rtol=0.0, atol=2e-8)


def test_lag_and_lead_are_the_papers(delay):
    # the paper at 15 nm/us: lag 0.11 us, lead 0.2 us, read off a picture
    np.testing.assert_allclose(delay.lag_us[0], 0.11, rtol=0.0, atol=0.01)
    np.testing.assert_allclose(delay.lead_us[0], 0.2, rtol=0.0, atol=0.02)
    # "we find it to scale as 1/V": of fast tips, for which the ways outside the junction are straight
    junction = find_junction(PAPER)
    straight = float(junction.forms_gap_nm + junction.breaks_gap_nm)
    fast = delay.approach_speed_nm_per_us > 300.0
    np.testing.assert_allclose((delay.lead_us * delay.approach_speed_nm_per_us)[fast], straight, rtol=0.01, atol=0.0)
    # and a lag that falls with the speed more slowly than 1/V
    assert np.all(np.diff(delay.lag_us) < 0.0)
    assert np.all(np.diff(delay.lag_us * delay.approach_speed_nm_per_us) > 0.0)


def test_delay_law_is_the_published_one(delay):
    law = delay.delay
    # published: 0.206, 5.64 nm, 0.726 nm with rms 0.001 us, for speeds between the same ends spaced otherwise; the
    # three are correlated, so that they move by some percent with the spacing
    np.testing.assert_allclose(float(law.hertz), 0.206, rtol=0.01, atol=0.0)
    np.testing.assert_allclose(float(law.lead_nm), 5.64, rtol=0.03, atol=0.0)
    np.testing.assert_allclose(float(law.offset_nm), 0.726, rtol=0.06, atol=0.0)
    np.testing.assert_allclose(delay.rms_us, 0.001, rtol=0.0, atol=1e-4)
    u, w = delay.approach_speed_nm_per_us, delay.rebound_speed_nm_per_us
    np.testing.assert_allclose(np.asarray(law(u, w)), delay.fitted_us, rtol=0.0, atol=1e-15)
    published = 0.206 * u**-0.2 - 5.64 * (1.0 / w - 1.0 / u) - 0.726 / u
    assert delay.rms_us < np.sqrt(np.mean((published - delay.delay_us) ** 2)) < 1.1 * delay.rms_us
