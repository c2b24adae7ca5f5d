"""Derivatives of orbits by the scene's parameters, and what is said near a fold, where they diverge."""

import dataclasses
from itertools import pairwise
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

from afm_jax.impact.orbits import single_impact_orbits
from tests.package_scenes import scene_of
from tests.reference_examples import DELAY, SCENES, scene
from tests.reference_flight import Parameters, capture_speed, constants, mp
from tests.reference_orbits import _closing_by_speed
from tests.reference_orbits import single_impact_orbits as exact_orbits
from tests.test_map_derivatives import NAMES, PARAMETERS, moved, named

pytestmark = pytest.mark.slow

P = scene(1.02, r=0.98, epsilon=100.0, viscous_loss=0.4, delay=DELAY)
FIELDS = ("peak_amplitude_nm", "lockin_amplitude_nm", "lockin_phase_deg", "velocity_after_nm_per_us", "trace")


@pytest.fixture(scope="module")
def slope():
    """The derivatives of the steady orbit's numbers by every parameter."""
    orbits = single_impact_orbits(scene_of(P), 1)
    slot = int(np.flatnonzero(orbits.stable & orbits.admissible)[0])

    def steady(values: dict[str, Any]) -> Any:
        orbits = single_impact_orbits(scene_of(dataclasses.replace(P, **values)), 1)
        return jnp.stack([getattr(orbits, field)[slot] for field in FIELDS])

    return jax.jit(jax.jacfwd(steady))({name: getattr(P, name) for name in (*NAMES, "delay")})


def differences(name: str) -> np.ndarray:
    """Return the same derivatives by central differences of the reference's orbits."""
    value = float(named(vars(P), name))
    step = 1e-4 * value if value else 1e-4

    def numbers(by: float) -> np.ndarray:
        (orbit,) = [orbit for orbit in exact_orbits(moved(P, name, by), 1) if orbit.stable and orbit.admissible]
        return np.array([float(getattr(orbit, field)) for field in FIELDS])

    near, far = ((numbers(h) - numbers(-h)) / (2 * h) for h in (step, 2 * step))
    return (4 * near - far) / 3  # Richardson: the error is of fourth order


@pytest.mark.parametrize("name", PARAMETERS[::2])
def test_orbits_have_the_derivatives_that_differences_show(slope, name):
    exact = differences(name)
    assert np.all(np.isfinite(exact))
    # Differences: the step 1e-4 to the fourth power, and 1e-13 of the reference's quadratures over 1e-4.
    np.testing.assert_allclose(named(slope, name), exact, rtol=1e-6, atol=1e-8 * np.max(np.abs(exact)))


def drive_amplitude(p: Parameters, approach: Any) -> Any:
    """Return the drive amplitude whose orbit of order 1 hits with an approach speed (closing is linear in it)."""
    cosine, sine, scale = _closing_by_speed(constants(dataclasses.replace(p, amplitude_nm=1.0)), 1, approach, mp)
    return mp.sqrt(cosine**2 + sine**2) / abs(scale)


def fold_of(p: Parameters) -> tuple[Any, Any]:
    """Return approach speed and drive amplitude of the fold: the least amplitude that has orbits."""
    with mp.workdps(30):
        speeds = [float(capture_speed(p)) + 0.5 * i for i in range(1, 200)]
        near = min(speeds, key=lambda u: drive_amplitude(p, mp.mpf(u)))
        approach = mp.findroot(lambda u: mp.diff(lambda v: drive_amplitude(p, v), u), near)
        return approach, drive_amplitude(p, approach)


@pytest.mark.parametrize(
    ("name", "beyond", "orbits", "flagged"),
    [("damped", 1e-9, 2, True), ("damped", 0.3, 2, False), ("delayed", -1e-6, 0, False), ("delayed", 1e-7, 2, True)],
)
def test_orbits_that_almost_merge_are_found_and_flagged(name, beyond, orbits, flagged):
    p = SCENES[name]
    with mp.workdps(30):
        middle, fold = fold_of(p)
        amplitude = fold * (1 + beyond)
        exact: Any = []
        if orbits:
            width = min(0.9999, 100.0 * beyond**0.5) * float(middle - capture_speed(p))
            excess = lambda u: float(drive_amplitude(p, mp.mpf(u)) - amplitude)  # noqa: E731
            ends = (float(middle) - width, float(middle), float(middle) + width * (20.0 if beyond > 0.1 else 1.0))
            exact = [brentq(excess, low, high, xtol=1e-14) for low, high in pairwise(ends)]
    mine = single_impact_orbits(scene_of(dataclasses.replace(p, amplitude_nm=float(amplitude))), 1)
    assert int(np.sum(mine.exists)) == orbits
    assert bool(mine.complete)
    np.testing.assert_array_equal(mine.near_double[mine.exists], flagged)
    # An amplitude rounded by 1e-16 moves a pair that is sqrt(beyond) apart by 1e-16/sqrt(beyond), times some 10.
    np.testing.assert_allclose(
        mine.approach_speed_nm_per_us[mine.exists], exact, rtol=1e-14 / abs(beyond) ** 0.5 + 1e-12
    )
