"""What a fit of the contact holds: at which value, how well known, and what that does to the fitted ones."""

import numpy as np
import pytest

from afm_jax.contact.parameters import CONTACT_PARAMETERS, EFFECTS, PAPER
from fitting import fit
from fitting.models import Held, held_of, split_held
from tests.fit_tables import rows
from tests.impact_tables import drives

OWN = ("relative_humidity", "modulus_gpa")


def test_a_constraint_on_what_is_held_holds_it_there_and_says_how_well():
    known = {
        "structural_amplitude_n_per_m": (60.0, 2.0),
        "relative_humidity": (0.4, 0.02),
        "quality_factor": (40.0, 1.0),
    }
    values, others, errors = split_held(OWN, {"tip_radius_nm": 20.0}, known)
    assert values == {"tip_radius_nm": 20.0, "structural_amplitude_n_per_m": 60.0}
    assert others == {"relative_humidity": (0.4, 0.02), "quality_factor": (40.0, 1.0)}
    held = {one.name: one for one in held_of(OWN, EFFECTS, values, errors)}
    assert set(held) == {one.name for one in CONTACT_PARAMETERS} - set(OWN)
    assert held["structural_amplitude_n_per_m"] == Held("structural_amplitude_n_per_m", 60.0, 2.0, assumed=False)
    # 30 % where nothing is said, of the value that is held
    assert held["tip_radius_nm"]._replace(error=6.0) == Held("tip_radius_nm", 20.0, 6.0, assumed=True)
    assert held["tip_radius_nm"].error == pytest.approx(6.0)
    dry = held_of(OWN, ("core", "jkr"), values, errors)
    assert not {"structural_amplitude_n_per_m", "temperature_k", "viscosity_pa_s"} & {one.name for one in dry}


@pytest.mark.slow
@pytest.mark.long
def test_the_error_of_what_is_held_adds_to_that_of_what_does_the_same():
    """Humidity and temperature act through the Kelvin length alone, which goes as 1/(T ln(1/h))."""
    free, table = ("relative_humidity",), rows(drives(), slice(0, None, 2))
    well = {one.name: (PAPER[one.name], 1e-3 * abs(PAPER[one.name])) for one in CONTACT_PARAMETERS}
    well.pop("relative_humidity")
    sharp, loose = (
        fit(table, "contact", free=free, constraints=well | {"temperature_k": (PAPER["temperature_k"], error)})
        for error in (0.01, 30.0)
    )
    assert sharp.valid
    assert loose.valid
    (h, error), (_, wider) = (
        (one.parameters["relative_humidity"].value, one.parameters["relative_humidity"].standard_error or np.nan)
        for one in (sharp, loose)
    )
    of_temperature = h * np.log(1.0 / h) * 30.0 / PAPER["temperature_k"]
    assert of_temperature > 1.5 * error
    assert wider == pytest.approx(np.hypot(error, of_temperature), rel=5e-3)
    # and the law is as well known as it was
    for column in ("rebound_speed_nm_per_us", "rebound_high_nm_per_us", "delay_low_us"):
        np.testing.assert_allclose(getattr(loose.law, column), getattr(sharp.law, column), rtol=1e-4, atol=1e-6)
