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
from afm_jax.apparatus.surface import surface_of
from afm_jax.contact.contact import Contact
from afm_jax.contact.junction import end_of_contact
from afm_jax.dynamics.basins import basins_of_attraction
from afm_jax.dynamics.bifurcations import bifurcation_diagram
from afm_jax.dynamics.contact_orbits import contact_orbits
from afm_jax.dynamics.exponents import lyapunov_spectrum
from afm_jax.dynamics.many_tips import tips_after_contacts
from afm_jax.dynamics.starts import batch_and_tips, sample_driven
from afm_jax.motion.follow import follow_long, state_after
from afm_jax.motion.record import ContactKind, MotionOutcome
from afm_jax.motion.simulate import simulate
from afm_jax.motion.start import default_start
from afm_jax.outcomes import Outcome
from afm_jax.studies.sweep import sweep

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
    reach = 0.0 if name == "hertz" else float(CONTACTS[name].bridge_forms_nm)

    def platform(t):
        return AMPLITUDE_NM * np.cos(RATIO * OMEGA * t)

    def rates(region):
        def of(t, state):
            gap = state[0] - platform(t)
            if region == "free":
                force = 0.0
            elif region == "attracted":
                force = -attraction / gap**2
            else:
                force = 100.0 * 10.0 * max(begins - gap, 0.0) ** 1.5 - (attraction / begins**2 if begins else 0.0)
            return [state[1], force / MASS - OMEGA / QUALITY * state[1] - OMEGA**2 * state[0]]

        return of

    # regions from outside inwards, with the gaps between them
    regions, levels = (
        (["free", "solid"], [0.0]) if name == "hertz" else (["free", "attracted", "solid"], [reach, begins])
    )
    at, end, state = 0, time + duration, [position, velocity]
    while time < end:
        events = []
        ends = [(level, -1.0) for level in levels[at : at + 1]] + [
            (level, 1.0) for level in levels[max(at - 1, 0) : at]
        ]
        for level, direction in ends:

            def meets(t, s, level=level):
                return s[0] - platform(t) - level

            vars(meets).update(terminal=True, direction=direction)
            events.append(meets)
        way = solve_ivp(rates(regions[at]), (time, end), state, "DOP853", events=events, rtol=1e-12, atol=1e-12)
        time, state = float(way.t[-1]), way.y[:, -1]
        if way.status == 1:
            inwards = at < len(levels) and way.t_events[0].size
            at += 1 if inwards else -1
            # a step off the level, lest the event is met again at once
            state, time = state + 1e-13 * np.array(rates(regions[at])(time, state)), time + 1e-13
    return np.asarray(state)


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
def test_sweeps_diagrams_and_basins_come_to_the_orbit():
    scene, path = scene_of("dry"), "platform.amplitude_nm"
    orbit = contact_orbits(scene, 1, 1)
    ends = sweep(scene, [{"parameter": path, "list": [AMPLITUDE_NM]}], {"what": "simulation", "periods": 650.0})
    assert (ends["settled"].values.tolist(), ends["contacts_per_response"].values.tolist()) == ([True], [1])
    # of the orbit that closes in SciPy
    assert float(ends["peak_amplitude_nm"][0]) == pytest.approx(97.3079, abs=1e-4)
    (place,) = np.flatnonzero(orbit.stable)
    velocity = float(orbit.reading.velocity_after_nm_per_us[place, 0])
    swept = bifurcation_diagram(scene, path, np.array([AMPLITUDE_NM]), impacts=650)
    assert swept.verdicts.names() == ["(1,1)"]
    assert swept.velocity_after_nm_per_us[0, -1] == pytest.approx(velocity, rel=1e-4)
    basins = basins_of_attraction(scene, columns=2, rows=2, speeds_nm_per_us=(20.0, 60.0))
    assert basins.reason is None
    (main,) = (attractor for attractor in basins.attractors if attractor.name.startswith("(1,1)"))
    assert main.velocity_nm_per_us[0] == pytest.approx(velocity, rel=1e-4)


@pytest.mark.slow
def test_a_tip_that_grazes_is_turned_round_by_its_drive_alone():
    # the free tip swings by 40 nm, and its sample is 40 nm below
    ratio, free_nm = 1.05, 40.0
    force = free_nm * OMEGA**2 * abs(1.0 - ratio**2 + 1j * ratio / QUALITY)
    drive = afm.ForceDrive(force, 90.0 * ratio)
    scene = afm.Scene(
        afm.Cantilever(90.0, QUALITY, MASS), afm.Platform(0.0, 90.0 * ratio, -free_nm), CONTACTS["hertz"], force=drive
    )
    # in its steady motion, but for next to nothing
    _, steady = surface_of(scene)
    assert steady is not None
    position, velocity = (float(part) for part in steady.position_and_velocity(4.0))
    motion = simulate(scene, afm.State(4.0, position, velocity + 1e-7), 1500.0, max_contacts=512)
    rows = motion.contacts
    assert rows.detail is not None
    left = np.asarray(rows.kind) == ContactKind.IMPACT
    arrival, departure, approach, rebound, deepest = (
        np.asarray(part)[left]
        for part in (
            *(rows.arrival_time_us, rows.departure_time_us, rows.approach_speed_nm_per_us),
            *(rows.rebound_speed_nm_per_us, rows.detail.deepest_gap_nm),
        )
    )
    assert (departure > arrival).all()
    assert (arrival[1:] > departure[:-1]).all()
    slow = approach < 1e-3
    assert slow.sum() > 20
    # a parabola under the acceleration at the lowest point of the swing; the contact's own force is nothing there
    upward = free_nm * (ratio * OMEGA) ** 2
    np.testing.assert_allclose(rebound[slow], approach[slow], rtol=2e-3)
    np.testing.assert_allclose(-deepest[slow], approach[slow] ** 2 / (2.0 * upward), rtol=2e-2)
    resumed = simulate(scene, state_after(motion, int(np.flatnonzero(left)[-1])), 50.0, max_contacts=64)
    assert int(resumed.outcome) in (MotionOutcome.FINISHED, MotionOutcome.HELD)
