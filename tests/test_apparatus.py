"""Cantilever, platform, trigonometry and parameters against SciPy, mpmath and their definitions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.drives import ForceDrive, Tone
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.apparatus.trigonometry import sine_cosine
from afm_jax.impact.law import ImpactLaw
from tests.reference_examples import scene
from tests.reference_flight import free_flight, mp, platform_motion

OMEGA = 2e-3 * np.pi * 90.0


def test_a_spring_constant_says_the_mass():
    mass = 5.4 / (2.0 * np.pi * 0.09) ** 2
    cantilever = Cantilever(90.0, 200.0, spring_constant_n_per_m=5.4)
    assert float(cantilever.mass_ng) == pytest.approx(mass, rel=1e-14)
    assert float(cantilever.stiffness_n_per_m) == pytest.approx(5.4, rel=1e-14)
    assert float(Cantilever(90.0).mass_ng) == 1.0
    assert float(Cantilever(90.0, None, 1.01 * mass, spring_constant_n_per_m=5.4).mass_ng) == 1.01 * mass
    for share in (0.97, 1.03):
        with pytest.raises(ValueError, match="contradict each other"):
            Cantilever(90.0, None, share * mass, spring_constant_n_per_m=5.4)
    with pytest.raises(ValueError, match="spring_constant_n_per_m"):
        Cantilever(90.0, spring_constant_n_per_m=0.0)


def matrix(cantilever: Cantilever, duration: float) -> np.ndarray:
    p = cantilever.propagator(duration)
    return np.array([[p[0], p[1]], [p[2], p[3]]], dtype=float)


@pytest.mark.parametrize("quality_factor", [None, 40.0, 0.51])
def test_free_flight_is_that_of_dop853(quality_factor):
    z0, v0, loss = -7.0, 80.0, 0.0 if quality_factor is None else OMEGA / quality_factor
    times = [0.02, 7.3, 55.0]

    def rates(_, y):
        return [y[1], -(OMEGA**2) * y[0] - loss * y[1]]

    found = [Cantilever(90.0, quality_factor).propagator(time)(z0, v0) for time in times]
    for time, mine in zip(times, found, strict=True):
        run = solve_ivp(rates, (0.0, time), [z0, v0], method="DOP853", rtol=1e-13, atol=1e-13)
        # DOP853 keeps about 1e-13 of 80 nm/us a step, over some 100 steps.
        np.testing.assert_allclose(mine, run.y[:, -1], rtol=1e-11, atol=1e-10)


@pytest.mark.parametrize("quality_factor", [None, 40.0, 0.7])
@pytest.mark.parametrize("time", [7.3])
def test_free_flight_agrees_with_fifty_digits(quality_factor, time):
    exact = [float(x) for x in free_flight(scene(quality_factor=quality_factor), time, -7, 80)]
    # A few roundings of numbers up to 100 nm.
    np.testing.assert_allclose(Cantilever(90.0, quality_factor).propagator(time)(-7.0, 80.0), exact, rtol=1e-13)


@settings(deadline=None, max_examples=30)
@given(quality=st.one_of(st.none(), st.floats(0.6, 1e6)), first=st.floats(0.0, 40.0), second=st.floats(0.0, 40.0))
def test_flights_compose_and_areas_shrink_by_the_damping(quality, first, second):
    cantilever = Cantilever(90.0, quality)
    whole = matrix(cantilever, first + second)
    # Absolute: elements are of order 1, or Omega.
    np.testing.assert_allclose(matrix(cantilever, second) @ matrix(cantilever, first), whole, rtol=1e-12, atol=1e-13)
    shrink = 1.0 if quality is None else np.exp(-OMEGA / quality * (first + second))
    assert np.linalg.det(whole) == pytest.approx(shrink, rel=1e-12, abs=1e-13)


def test_derived_quantities_follow_from_their_definitions():
    cantilever, platform = Cantilever(90.0, 40.0, 2.0), Platform(4.0, 180.0, -1.0, 0.25)
    # One rounding each.
    assert float(cantilever.angular_frequency) == pytest.approx(OMEGA, rel=1e-15)
    assert float(cantilever.decay_rate) == pytest.approx(OMEGA / 80.0, rel=1e-15)
    assert float(cantilever.damped_angular_frequency) == pytest.approx(OMEGA * np.sqrt(1 - 1 / 6400), rel=1e-15)
    assert float(platform.period_us) == pytest.approx(1e3 / 180.0, rel=1e-15)
    assert float(platform.top_speed_nm_per_us) == pytest.approx(8.0 * OMEGA, rel=1e-15)
    # m z'' = -k z - (m Omega/Q) z'
    assert float(cantilever.acceleration(3.0, 50.0)) == pytest.approx(-3 * OMEGA**2 - 50 * OMEGA / 40, rel=1e-14)


def test_platform_agrees_with_fifty_digits():
    p = scene()
    platform = Platform(p.amplitude_nm, p.drive_frequency_khz, p.offset_nm)
    found = [platform.position(2.3), platform.velocity(2.3), platform.acceleration(2.3)]
    np.testing.assert_allclose(found, [float(x) for x in platform_motion(p, 2.3)], rtol=1e-13)


@pytest.mark.parametrize("time", [0.0, 33.3])
def test_platform_velocity_and_acceleration_are_derivatives(time):
    platform, drive = Platform(4.0, 180.0, -1.0, 0.25), 2e-3 * np.pi * 180.0
    # Absolute: at a turning point the velocity is a rounding of beta omega.
    assert float(platform.position(time)) == pytest.approx(-1 + 0.25 * time + 4 * np.cos(drive * time), abs=1e-13)
    assert float(jax.grad(platform.position)(time)) == pytest.approx(float(platform.velocity(time)), abs=1e-13)
    assert float(jax.grad(platform.velocity)(time)) == pytest.approx(float(platform.acceleration(time)), abs=1e-13)
    assert float(platform.velocity(time)) == pytest.approx(0.25 - 4 * drive * np.sin(drive * time), abs=1e-12)


def test_sine_and_cosine_are_right_to_the_last_digit():
    random = np.random.default_rng(3)
    angles = np.concatenate(
        [random.uniform(-10, 10, 400), random.uniform(-1e5, 1e5, 400), 0.25 * np.pi * np.arange(-40, 41)]
    )
    with mp.workdps(40):
        exact = np.array([[float(mp.sin(float(a))), float(mp.cos(float(a)))] for a in angles]).T
    sine, cosine = sine_cosine(jnp.asarray(angles))
    # One unit in the last place of 1, and one more near the ends of a quadrant.
    np.testing.assert_allclose(sine, exact[0], rtol=0, atol=2.3e-16)
    np.testing.assert_allclose(cosine, exact[1], rtol=0, atol=2.3e-16)


def test_sine_and_cosine_differentiate_to_each_other_in_every_precision():
    angles = jnp.linspace(-20.0, 20.0, 101)
    (sine, cosine), (rising, falling) = jax.jvp(sine_cosine, (angles,), (jnp.full_like(angles, 2.0),))
    np.testing.assert_array_equal(rising, 2.0 * cosine)
    np.testing.assert_array_equal(falling, -2.0 * sine)
    second = jax.vmap(jax.grad(jax.grad(lambda a: sine_cosine(a)[0])))(angles)
    np.testing.assert_array_equal(second, -sine)
    single = sine_cosine(angles.astype(jnp.float32))
    assert single[0].dtype == jnp.float32
    # Rounding of the angle, 20 * 6e-8, and of the result.
    np.testing.assert_allclose(single[0], sine, rtol=0, atol=2e-6)


def test_sine_and_cosine_of_no_number_are_none():
    assert np.all(np.isnan(sine_cosine(jnp.asarray([jnp.nan, jnp.inf]))))


def test_parameters_are_strong_floats_whatever_they_were():
    for value in (90, 90.0, np.float64(90.0), np.int32(90), jnp.asarray(90), jnp.asarray(90.0)):
        frequency = Cantilever(value).frequency_khz
        assert (frequency.dtype, frequency.weak_type, frequency.shape) == (jnp.float64, False, ())
    assert Cantilever(np.float32(90.0)).frequency_khz.dtype == jnp.float32


def test_traced_parameters_are_not_checked():
    # A compiled program cannot raise; the value outside its range goes through.
    assert float(jax.jit(lambda f: Cantilever(f).frequency_khz)(-1.0)) == -1.0


def test_the_top_speed_of_a_platform_counts_its_second_tone():
    platform = Platform(4.0, 180.0, second=Tone(1.5, 270.0, 20.0))
    speeds = np.abs(platform.velocity(np.linspace(0.0, 2e3 / 90.0, 200_001)))
    # both cosines are steepest at once somewhere near, as their frequencies are 2:3
    expected = 2e-3 * np.pi * (4.0 * 180.0 + 1.5 * 270.0)
    assert float(platform.top_speed_nm_per_us) == pytest.approx(expected, rel=1e-14)
    assert speeds.max() <= expected
    assert speeds.max() > 2e-3 * np.pi * 4.0 * 180.0


def test_a_platform_at_rest_needs_neither_amplitude_nor_frequency():
    lever, rest = Cantilever(90.0, 40.0), Platform(offset_nm=-30.0)
    # as of a scene file: phases count in the drive that moves, or in the free frequency
    for force, frequency in ((ForceDrive(1.0, 91.0), 91.0), (None, 90.0)):
        platform = Scene(lever, rest, ImpactLaw(0.9), force=force).platform
        assert (float(platform.frequency_khz), float(platform.position(3.0))) == (frequency, -30.0)
    with pytest.raises(ValueError, match="`frequency_khz` must be positive, but is 0"):
        Platform(4.0)
