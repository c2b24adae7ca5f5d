"""Cantilever, platform and trigonometry against mpmath and their definitions."""

import jax.numpy as jnp
import numpy as np
import pytest

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.drives import ForceDrive
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.apparatus.trigonometry import sine_cosine
from afm_jax.impact.law import ImpactLaw
from tests.reference_examples import scene
from tests.reference_flight import free_flight, mp


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


@pytest.mark.parametrize("quality_factor", [None, 40.0, 0.7])
@pytest.mark.parametrize("time", [7.3])
def test_free_flight_agrees_with_fifty_digits(quality_factor, time):
    exact = [float(x) for x in free_flight(scene(quality_factor=quality_factor), time, -7, 80)]
    # A few roundings of numbers up to 100 nm.
    np.testing.assert_allclose(Cantilever(90.0, quality_factor).propagator(time)(-7.0, 80.0), exact, rtol=1e-13)


@pytest.mark.parametrize("time", [0.0, 33.3])
def test_a_platform_is_offset_ramp_and_cosine(time):
    platform, drive = Platform(4.0, 180.0, -1.0, 0.25), 2e-3 * np.pi * 180.0
    # Absolute: at a turning point the velocity is a rounding of beta omega.
    assert float(platform.position(time)) == pytest.approx(-1 + 0.25 * time + 4 * np.cos(drive * time), abs=1e-13)
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


def test_a_platform_at_rest_needs_neither_amplitude_nor_frequency():
    lever, rest = Cantilever(90.0, 40.0), Platform(offset_nm=-30.0)
    # as of a scene file: phases count in the drive that moves, or in the free frequency
    for force, frequency in ((ForceDrive(1.0, 91.0), 91.0), (None, 90.0)):
        platform = Scene(lever, rest, ImpactLaw(0.9), force=force).platform
        assert (float(platform.frequency_khz), float(platform.position(3.0))) == (frequency, -30.0)
    with pytest.raises(ValueError, match="`frequency_khz` must be positive, but is 0"):
        Platform(4.0)
