"""Tips that have just left a contact: free, whatever the contact, wherever a motion is taken up again.

What follows is compared with SciPy's integration of eq. 16, and with Liouville's theorem: where the contact takes no
energy, the air alone contracts the plane of states, by exp(-Omega T/Q) in a time T.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import afm_jax as afm
from afm_jax.contact.contact import Contact
from afm_jax.contact.junction import end_of_contact
from afm_jax.dynamics.bifurcations import bifurcation_diagram
from afm_jax.dynamics.contact_orbits import contact_orbits
from afm_jax.dynamics.exponents import lyapunov_spectrum
from afm_jax.dynamics.many_tips import tips_after_contacts
from afm_jax.dynamics.starts import batch_and_tips, sample_driven
from afm_jax.motion.follow import follow_long, state_after
from afm_jax.motion.record import ContactKind
from afm_jax.motion.simulate import simulate
from afm_jax.motion.start import default_start
from afm_jax.outcomes import Outcome

QUALITY, MASS, AMPLITUDE_NM, RATIO = 40.0, 1.0, 4.0, 2.02
OMEGA = 2e-3 * np.pi * 90.0
PERIOD_US = 2.0 * np.pi / (RATIO * OMEGA)
CONTACTS = {
    "wet": Contact.paper(),
    # the junction breaks at 8.0 nm, beyond the bridge; only a heavy tip leaves it
    "soft": Contact.paper(modulus_gpa=1.0),
    "dry": Contact.of(["van_der_waals", "dmt"]),
    "hertz": Contact.of(["hertz"]),
}
CONSERVE = ("dry", "hertz")


def scene_of(name: str) -> afm.Scene:
    platform = afm.Platform(amplitude_nm=AMPLITUDE_NM, frequency_khz=90.0 * RATIO)
    return afm.Scene(afm.Cantilever(90.0, QUALITY, 20.0 if name == "soft" else MASS), platform, CONTACTS[name])


def integrated(name: str, time: float, position: float, velocity: float, duration: float) -> np.ndarray:
    """Return position and velocity a duration later by SciPy, from the forces of a dry contact as they are written."""
    begins, attraction = (0.0, 0.0) if name == "hertz" else (0.165, 0.1 * 100.0 / 6.0)
    reach = float(CONTACTS[name].bridge_forms_nm)

    def rates(t, state):
        gap = state[0] - AMPLITUDE_NM * np.cos(RATIO * OMEGA * t)
        force = 100.0 * 10.0 * max(begins - gap, 0.0) ** 1.5
        if attraction and gap < reach:
            force -= attraction / max(gap, begins) ** 2
        return [state[1], force / MASS - OMEGA / QUALITY * state[1] - OMEGA**2 * state[0]]

    way = solve_ivp(
        rates, (time, time + duration), [position, velocity], "DOP853", rtol=1e-12, atol=1e-12, max_step=0.01
    )
    return way.y[:, -1]


def test_the_gap_where_contact_ends_is_that_of_what_lasts_longer():
    assert float(end_of_contact(CONTACTS["wet"])) == 4.7
    assert float(end_of_contact(CONTACTS["soft"])) == pytest.approx(8.0125, abs=1e-3)
    assert float(end_of_contact(CONTACTS["hertz"])) == 0.0
    both = jax.tree.map(lambda *leaves: jnp.stack(leaves), CONTACTS["wet"], CONTACTS["soft"])
    np.testing.assert_allclose(end_of_contact(both), [4.7, float(end_of_contact(CONTACTS["soft"]))], rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["soft", "hertz"])
def test_a_motion_taken_up_at_a_departure_is_the_whole_motion(name):
    scene = scene_of(name)
    whole = simulate(scene, default_start(scene), 12.4 * PERIOD_US, max_contacts=32)
    rows, count = whole.contacts, int((np.asarray(whole.contacts.kind) == ContactKind.IMPACT).sum())
    assert count >= 7
    departure = state_after(whole, 4)
    later = simulate(scene, departure, float(whole.final.time_us - departure.time_us), max_contacts=32)
    assert int(later.count) == int(whole.count) - 5
    for column in ("arrival_time_us", "departure_time_us", "rebound_speed_nm_per_us"):
        again, before = getattr(later.contacts, column)[: count - 5], getattr(rows, column)[5:count]
        np.testing.assert_allclose(again[:-1], before[:-1], rtol=1e-8)
    # and from the gap itself, as maps of departures take it up
    batch, tips = batch_and_tips(sample_driven(scene).scenes, departure)
    _, record = tips_after_contacts(batch, tips, skip=0, record=40, accuracy=1e-9)
    turned = (record.departure_periods + record.departure_us / PERIOD_US)[0, : min(3, count - 5)]
    np.testing.assert_allclose(
        turned % 1.0, np.asarray(rows.departure_time_us)[5 : min(8, count)] / PERIOD_US % 1.0, rtol=0.0, atol=1e-7
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", CONSERVE)
def test_dry_orbits_close_in_scipy_and_contract_by_what_the_air_takes(name):
    scene = scene_of(name)
    found = contact_orbits(scene, 1, 1)
    assert found.stable.tolist() == [True]
    expected = np.exp(-OMEGA * PERIOD_US / QUALITY)
    assert float(found.reading.determinant[0]) == pytest.approx(expected, rel=1e-6)
    # of the simulation, and of Hertz's
    assert float(found.reading.peak_amplitude_nm[0]) == pytest.approx(
        {"dry": 97.3079, "hertz": 93.7513}[name], abs=1e-4
    )
    time = float(found.reading.phase_rad[0, 0]) / (RATIO * OMEGA)
    height = AMPLITUDE_NM * np.cos(RATIO * OMEGA * time) + float(end_of_contact(scene.interaction))
    velocity = float(found.reading.velocity_after_nm_per_us[0, 0])
    after = integrated(name, time, height, velocity, PERIOD_US)
    np.testing.assert_allclose(after, [height, velocity], rtol=0.0, atol=2e-5)


@pytest.mark.slow
def test_exponents_of_dry_contacts_are_those_of_the_air():
    found = lyapunov_spectrum(scene_of("hertz"), impacts=200, transient=500)
    assert found.exponents_per_impact.sum() == pytest.approx(-OMEGA * PERIOD_US / QUALITY, rel=1e-5)
    # the multipliers of both are a pair on a circle
    assert found.exponents_per_impact[0] == pytest.approx(found.exponents_per_impact[1], rel=1e-5)
    assert (int(found.verdicts.impacts), int(found.verdicts.periods)) == (1, 1)


@pytest.mark.slow
def test_six_hundred_and_fifty_periods_have_a_contact_each():
    scene = scene_of("dry")
    run = follow_long(scene, default_start(scene), 650.0 * PERIOD_US)
    assert run.pieces > 2
    rows = run.simulation.contacts
    assert abs(len(rows.kind) - 650) <= 1
    # none is counted twice or has no length: they follow one another by a period
    departures = np.asarray(rows.departure_time_us)[np.isfinite(np.asarray(rows.departure_time_us))]
    np.testing.assert_allclose(np.diff(departures)[-400:], PERIOD_US, rtol=1e-3)
    assert run.verdict.settled
    batch, tips = batch_and_tips(sample_driven(scene).scenes, default_start(scene))
    end, record = tips_after_contacts(batch, tips, skip=640, record=40, accuracy=1e-6)
    assert end.outcome.tolist() == [Outcome.IMPACT]
    np.testing.assert_allclose(np.diff(record.departure_periods + record.departure_us / PERIOD_US), 1.0, atol=1e-6)


@pytest.mark.slow
def test_diagrams_come_to_the_orbit():
    scene, path = scene_of("dry"), "platform.amplitude_nm"
    orbit = contact_orbits(scene, 1, 1)
    (place,) = np.flatnonzero(orbit.stable)
    velocity = float(orbit.reading.velocity_after_nm_per_us[place, 0])
    swept = bifurcation_diagram(scene, path, np.array([AMPLITUDE_NM]), impacts=650)
    assert swept.verdicts.names() == ["(1,1)"]
    assert swept.velocity_after_nm_per_us[0, -1] == pytest.approx(velocity, rel=1e-4)
