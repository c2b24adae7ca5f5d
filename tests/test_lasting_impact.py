"""What a contact that lasts does to an impact: its numbers from integrals and integrations of a Hertz contact."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicHermiteSpline
from scipy.special import beta

import afm_jax as afm
from afm_jax.contact.collide import capture_speed
from afm_jax.contact.junction import find_junction
from afm_jax.contact.law_of_contact import DELAY_ERROR_US, SPEED_ERROR, tabulated
from afm_jax.contact.time_course import time_course
from afm_jax.impact.lasting_impact import (
    AIR,
    PULLS,
    SHALLOWER,
    SPREAD,
    STIFFER,
    USUAL_LEAD,
    Middle,
    corrected,
    depth_of_impact,
    hertz_under_pull,
    indentation,
)
from afm_jax.impact.law import BRIDGE_NM, CollisionDelay, ImpactLaw, Speeds
from tests.reference_hertz import DEEPEST, HERTZ_TIME, under_pull

UNDAMPED = afm.Cantilever(1e-3)
"""Next to no spring."""


def contact_of(motion, *, surface: float = 0.0, speed: float = 1.0) -> Any:
    """Return SciPy's integration of a contact from the surface, downwards, until the tip is back there."""

    def out(_, state):
        return state[0] - surface

    vars(out).update(terminal=True, direction=1.0)
    return solve_ivp(motion, (0.0, 10.0), [surface, -speed], events=out, rtol=1e-11, atol=1e-13, dense_output=True)


def left(motion) -> tuple[float, float]:
    """Return speed and time at which a contact ends that begins at gap 0 and speed 1."""
    end = contact_of(motion)
    return float(end.y_events[0][0][1]), float(end.t_events[0][0])


def integrated(pull: float, jerk: float) -> tuple[float, float]:
    """Return rebound speed and duration of a Hertz contact at speed 1 with acceleration pull + jerk (t - middle)."""
    rebound, duration = 1.0, HERTZ_TIME
    for _ in range(12):
        middle = 0.5 * duration

        def motion(t, state, middle=middle):
            gap, speed = state
            return [speed, np.maximum(-gap, 0.0) ** 1.5 + pull + jerk * (t - middle)]

        rebound, duration = left(motion)
    return rebound, duration


def impact_of(hertz: float, lead_nm: float) -> ImpactLaw:
    """Return a law without loss whose contact lasts `hertz` at speed 1."""
    return ImpactLaw(1.0, delay=CollisionDelay(hertz, lead_nm, 0.0))


def lasting(duration: float) -> Speeds:
    """Return an impact at speed 1 without loss."""
    return Speeds(jnp.array(1.0), jnp.array(1.0), jnp.array(duration))


def around(pull: float, jerk: float = 0.0) -> Middle:
    return Middle(jnp.array(pull), jnp.array(jerk))


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize(("of_pull", "of_jerk"), [(0.35, 0.0), (0.0, 0.1), (0.8, -0.1), (2.0, 0.01)])
def test_corrections_are_those_of_an_integrated_hertz_contact(sign, of_pull, of_jerk):
    pull, jerk = sign * of_pull / HERTZ_TIME, sign * of_jerk / HERTZ_TIME**2
    rebound, duration = integrated(pull, jerk)
    found = corrected(lasting(HERTZ_TIME), around(pull, jerk), UNDAMPED, impact_of(HERTZ_TIME, 0.0))
    # exact in the pull, of first order in its change, 0.1 at most; the corrections reach 0.03 and 0.3
    assert float(found.rebound) == pytest.approx(rebound, abs=2e-4)
    assert float(found.delay) == pytest.approx(duration, abs=5e-3 * HERTZ_TIME)
    if of_jerk == 0.0:
        assert float(found.delay) == pytest.approx(duration, rel=1e-6)


def test_a_pull_acts_as_on_an_integrated_hertz_contact():
    """F and H within 1e-6 of quadratures, and of the closed forms without a pull."""
    kappa = np.linspace(*PULLS, 15)
    lasts, deep = (np.asarray(column) for column in hertz_under_pull(jnp.asarray(kappa)))
    expected = np.array([under_pull(float(k)) for k in kappa]).T
    np.testing.assert_allclose(lasts, expected[0], rtol=1e-6)
    np.testing.assert_allclose(deep, expected[1], rtol=1e-6)
    # no pull, no change; int v^2 and int d are beta functions: v^2 = 1 - (d/deepest)^(5/2)
    assert float(hertz_under_pull(jnp.array(0.0))[0]) == 1.0
    depth = 0.8 * DEEPEST**2 * beta(0.8, 0.5) / HERTZ_TIME**2
    found = indentation(jnp.array(2.0), jnp.array(3.0), around(0.0), UNDAMPED, 0.0)
    assert float(found) == pytest.approx(18.0 * depth, rel=1e-6)
    assert pytest.approx(1.6 * DEEPEST * beta(0.4, 1.5) / HERTZ_TIME, rel=1e-12) == AIR


def test_a_spring_shortens_a_contact():
    cantilever = afm.Cantilever(8.0)
    stiffness = float(cantilever.angular_frequency) ** 2

    def motion(_, state):
        return [state[1], np.maximum(-state[0], 0.0) ** 1.5 - stiffness * state[0]]

    found = corrected(lasting(HERTZ_TIME), around(0.0), cantilever, impact_of(HERTZ_TIME, 0.0))
    # first order in the square of 0.16, the frequency times the duration
    assert HERTZ_TIME - float(found.delay) == pytest.approx(HERTZ_TIME - left(motion)[1], rel=0.01)
    assert float(found.rebound) == 1.0
    deepest = DEEPEST / HERTZ_TIME
    assert pytest.approx(0.7 * beta(1.2, 0.5) / beta(0.4, 0.5) * deepest**2, rel=1e-10) == STIFFER


def test_a_spring_and_a_lockin_make_an_indentation_count_less():
    deeper, shallower = (under_pull(0.0, stiffness)[1] for stiffness in (-1e-3, 1e-3))
    share = (deeper - shallower) / (deeper + shallower) / (1e-3 * HERTZ_TIME**2)
    assert share == pytest.approx(SHALLOWER, rel=1e-4)
    times = np.linspace(0.0, HERTZ_TIME, 2001)
    depth = solve_ivp(lambda _, x: [x[1], -(max(x[0], 0.0) ** 1.5)], (0.0, 4.0), [0.0, 1.0], t_eval=times, rtol=1e-10)
    from_middle = (times / HERTZ_TIME - 0.5) ** 2
    assert np.sum(depth.y[0] * from_middle) / np.sum(depth.y[0]) == pytest.approx(SPREAD, rel=1e-4)
    found = indentation(jnp.array(1.0), jnp.array(1.0), around(0.0), afm.Cantilever(8.0), 0.3)
    missed = SHALLOWER * (0.016 * np.pi) ** 2 + 0.045 * SPREAD
    assert float(found) == pytest.approx(under_pull(0.0)[1] * (1.0 - missed), rel=1e-6)


@pytest.mark.parametrize("pull", [-0.2, 0.4])
def test_a_delay_with_an_offset_is_that_of_a_raised_surface(pull):
    """Parabolas to gap 0 from a Hertz contact whose surface stands above it, and what they leave of the way below."""
    raised, coming = 0.3, np.sqrt(1.0 + 0.6 * pull)
    beside = (coming - 1.0) / pull  # from the surface to gap 0, and as long back

    def motion(_, state):
        return [state[1], max(raised - state[0], 0.0) ** 1.5 + pull]

    end = contact_of(motion, surface=raised, speed=coming)
    leaves = float(end.t_events[0][0])
    times, way = np.linspace(0.0, leaves, 2001), np.linspace(0.0, beside, 2001)
    flown = 2.0 * np.trapezoid(raised - coming * way + 0.5 * pull * way**2, way)
    impact = ImpactLaw(1.0, delay=CollisionDelay(HERTZ_TIME, 0.0, 2.0 * raised))
    found = corrected(lasting(HERTZ_TIME - 2.0 * raised), around(pull), UNDAMPED, impact)
    assert float(found.delay) == pytest.approx(leaves - 2.0 * beside, rel=1e-6)
    depth = float(depth_of_impact(impact, jnp.array(1.0), jnp.array(1.0), around(pull), UNDAMPED, 0.0))
    assert depth == pytest.approx(flown - np.trapezoid(end.sol(times)[0], times), rel=1e-5)


@pytest.mark.parametrize(
    "numbers", [{}, {"relative_humidity": 0.637, "adhesion_energy_j_per_m2": 0.19, "modulus_gpa": 32.9}]
)
def test_depth_and_loss_by_the_air_are_those_of_the_course_through_bridge_and_solid(numbers):
    """From 1.5 times the capture speed on; of a soft and wet contact the bridge makes up half of the depth."""
    contact, cantilever = afm.Contact.paper(**numbers), afm.Cantilever(100.0, 50.0)
    impact = tabulated(contact, jnp.array(1.0))
    for ratio in (1.5, 2.0, 3.0, 5.0, 10.0):
        speed = ratio * impact.lowest
        speeds, course = impact.speeds(speed), time_course(contact, speed)
        later = np.flatnonzero(np.diff(course.time_us, prepend=-1.0) > 0.0)
        time, gap = course.time_us[later], course.gap_nm[later]
        path = CubicHermiteSpline(time, gap, course.velocity_nm_per_us[later])
        u, w, first, last = float(speed), float(speeds.rebound), gap[0], gap[-1]
        deep = 0.5 * first**2 / u + 0.5 * last**2 / w - path.integrate(time[0], time[-1])
        depth = depth_of_impact(impact, speeds.approach, speeds.rebound, around(0.0), UNDAMPED, 0.0)
        assert float(depth) == pytest.approx(deep, rel=0.06)
        # d(v^2)/dt = -4 gamma v^2, gamma = Omega/2Q; the straight paths lose theirs in flight
        dense = np.linspace(time[0], time[-1], 40001)
        squared = np.trapezoid(path(dense, 1) ** 2, dense) - u * first - w * last
        lost = w**2 - float(corrected(speeds, around(0.0), cantilever, impact).rebound) ** 2
        assert lost == pytest.approx(4.0 * float(cantilever.decay_rate) * squared, rel=0.15 if ratio < 2.0 else 0.06)


@pytest.mark.parametrize("pull", [-20.0, 15.0])
def test_a_lead_is_covered_sooner_with_a_push(pull):
    u, w, lead = 40.0, 36.0, 5.0
    free = Speeds(jnp.array(u), jnp.array(w), jnp.array(0.0))
    delay = float(corrected(free, around(pull), UNDAMPED, impact_of(0.0, lead)).delay)

    def time(speed: float, acceleration: float) -> float:
        roots = np.roots([0.5 * acceleration, speed, -BRIDGE_NM])
        return float(min(roots[roots > 0.0]))

    way = BRIDGE_NM
    later = (time(w, pull) - way / w) - (time(u, pull) - way / u)
    assert delay == pytest.approx(-later * lead / (USUAL_LEAD * BRIDGE_NM), rel=1e-9)


WET: dict[str, Any] = {"relative_humidity": 0.8, "adhesion_energy_j_per_m2": 0.15, "viscosity_pa_s": 1.005e-2}


def random_contact(rng: np.random.Generator) -> dict[str, Any]:
    """Return numbers of a contact between dry and wet, soft and hard; one in ten without drag."""
    drag = 0.0 if rng.random() < 0.1 else 10.0 ** rng.uniform(-1.0, 1.0)
    return {
        "relative_humidity": rng.uniform(0.2, 0.9),
        "adhesion_energy_j_per_m2": rng.uniform(0.1, 0.6),
        "viscosity_pa_s": drag * 1.005e-3,
        "modulus_gpa": 10.0 ** rng.uniform(1.0, 2.5),
    }


@jax.jit
def every_speed(table, speeds):
    return jax.vmap(table.speeds)(speeds), jax.vmap(table.errors)(speeds)


def check_against_collisions(numbers: dict[str, Any]) -> bool:
    """Compare a table with collisions over all of it; False if the contact has no junction, and the table says so."""
    contact = afm.Contact.paper(**numbers)
    table = tabulated(contact, jnp.array(1.0))
    lowest = float(table.lowest)
    if not bool(find_junction(contact).exists):
        assert lowest > 1e5
        return False
    # closer to capture the collisions themselves are off by more
    speeds = np.geomspace(1.03 * lowest, float(table.highest), 32)
    truth = afm.collide(contact, speeds)
    found, (share, late) = every_speed(table, jnp.asarray(speeds))
    assert not np.any(truth.captured)
    np.testing.assert_allclose(found.rebound, truth.rebound_speed_nm_per_us, rtol=SPEED_ERROR)
    np.testing.assert_allclose(found.delay, truth.collision_delay_us, rtol=0, atol=DELAY_ERROR_US)
    assert np.all(np.asarray(share) < SPEED_ERROR), numbers
    assert np.all(np.asarray(late) < DELAY_ERROR_US), numbers
    return True


@pytest.mark.slow
def test_random_contacts_are_tabulated_from_capture_on():
    rng = np.random.default_rng(11)
    assert sum(check_against_collisions(random_contact(rng)) for _ in range(12)) >= 10
    assert check_against_collisions(WET)


@pytest.mark.parametrize("numbers", [{}, WET, {"modulus_gpa": 10.0, "adhesion_energy_j_per_m2": 0.6}])
def test_a_table_begins_at_the_capture_speed(numbers):
    contact = afm.Contact.paper(**numbers)
    assert float(tabulated(contact, jnp.array(1.0)).lowest) == pytest.approx(float(capture_speed(contact)), rel=1e-9)
