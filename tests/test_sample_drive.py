"""The impact map on a platform of two frequencies, against a root search; and the drives that it does not know."""

from typing import Any

import numpy as np
import pytest
from scipy.optimize import brentq

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.drives import BaseDrive, ForceDrive, Tone
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.impact.law import ImpactLaw
from afm_jax.impact.map import iterate_map
from afm_jax.impact.orbits import single_impact_orbits

OMEGA, FIRST, SECOND = (2e-3 * np.pi * frequency for frequency in (90.0, 180.0, 431.0))


def height(t: Any) -> Any:
    """Return z_p as the definition of its cosines says."""
    return -1 + 2 * np.cos(FIRST * t) + 1.5 * np.cos(SECOND * t + 2 * np.pi / 9)


def speed(t: Any) -> Any:
    return -2 * FIRST * np.sin(FIRST * t) - 1.5 * SECOND * np.sin(SECOND * t + 2 * np.pi / 9)


def impact(time: float, velocity: float, loss: float) -> tuple[float, float]:
    """Return time and tip velocity of the first impact of a flight from the platform: a scan, then SciPy's brentq."""
    turn = np.sqrt(OMEGA**2 - loss**2)
    position = height(time)
    sine = (velocity + loss * position) / turn

    def tip(flown: Any) -> Any:
        return np.exp(-loss * flown) * (position * np.cos(turn * flown) + sine * np.sin(turn * flown))

    def gap(flown: Any) -> Any:
        return tip(flown) - height(time + flown)

    grid = np.linspace(1e-3, 12.0, 40_001)
    first = int(np.argmax(gap(grid) < 0.0))
    flown: Any = brentq(gap, grid[first - 1], grid[first], xtol=1e-14)
    turned = position * np.sin(turn * flown) - sine * np.cos(turn * flown)
    return time + flown, -turn * np.exp(-loss * flown) * turned - loss * tip(flown)


@pytest.mark.parametrize("quality", [None, 40.0])
def test_impacts_on_a_platform_of_two_frequencies_are_those_of_a_root_search(quality: float | None):
    platform = Platform(2.0, 180.0, -1.0, second=Tone(1.5, 431.0, 40.0))
    time, velocity = 4.0, 15.0
    rows = iterate_map(Scene(Cantilever(90.0, quality), platform, ImpactLaw(0.9, 3.0)), time, velocity, 3)
    for row in range(3):
        time, before = impact(time, velocity, 0.0 if quality is None else OMEGA / (2.0 * quality))
        velocity = speed(time) + np.sqrt(0.81 * (speed(time) - before) ** 2 - 3.0)
        # roundings of 1e-14, stretched by three impacts
        np.testing.assert_allclose(rows.time_us[row], time, rtol=0, atol=1e-11)
        np.testing.assert_allclose(rows.velocity_before_nm_per_us[row], before, rtol=0, atol=1e-10)
        np.testing.assert_allclose(rows.velocity_after_nm_per_us[row], velocity, rtol=0, atol=1e-10)


LAW = Scene(Cantilever(90.0, 40.0), Platform(2.0, 180.0, 0.0, 0.0), ImpactLaw(0.9))


def test_what_else_drives_is_not_ignored():
    drives: list[dict[str, Any]] = [{"base": BaseDrive(0.8, 88.0)}, {"force": ForceDrive(0.6, 93.0)}]
    for drive in drives:
        with pytest.raises(ValueError, match="no periodic orbits: the drive has several frequencies"):
            single_impact_orbits(Scene(LAW.cantilever, LAW.platform, LAW.interaction, **drive), 1)
    scene = Scene(LAW.cantilever, Platform(2.0, 180.0, second=Tone(1.0, 33.0)), LAW.interaction)
    with pytest.raises(ValueError, match=r"the scene has `platform.second`, .*but only one"):
        single_impact_orbits(scene, 1)
