"""The surface that a tip sees: derivatives, bounds, and where there is none."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.drives import BaseDrive, ForceDrive, Tone
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.apparatus.surface import Surface, Wave, detected, height_of_free_deflection, surface_of
from tests.driven_scenes import FULL, PER_KHZ, PLATFORM


@pytest.mark.parametrize("scene", [Scene(Cantilever(90.0), PLATFORM), FULL], ids=["platform", "surface"])
def test_velocity_and_acceleration_are_derivatives(scene: Scene):
    (surface, _), time = surface_of(scene), 17.9
    # rounding of lengths of 20 nm
    assert float(jax.grad(surface.position)(time)) == pytest.approx(float(surface.velocity(time)), abs=1e-12)
    assert float(jax.grad(surface.velocity)(time)) == pytest.approx(float(surface.acceleration(time)), abs=1e-12)


def test_bounds_hold_and_are_sharp_for_one_wave():
    time = np.linspace(0.0, 3000.0, 200_001)
    surface, one = surface_of(FULL)[0], Surface(0.5, -2e-3, (Wave(0.3, -1.1, 0.6),))
    for motion in (surface, PLATFORM, one):
        position, velocity = (np.asarray(x) for x in motion.position_and_velocity(jnp.asarray(time)))
        ramp = float(motion.offset_rate_nm_per_us)
        reach = np.max(np.abs(position - float(motion.offset_nm) - ramp * time))
        bend = np.max(np.abs(np.asarray(motion.acceleration(jnp.asarray(time)))))
        assert reach <= float(motion.reach_nm)
        assert bend <= float(motion.largest_acceleration_nm_per_us2)
        assert np.max(np.abs(velocity - ramp)) <= float(motion.top_speed_nm_per_us) * (1 + 1e-12)  # rounding
    # sqrt(0.3^2 + 1.1^2), and its products with 0.6
    bounds = [one.reach_nm, one.top_speed_nm_per_us, one.largest_acceleration_nm_per_us2]
    np.testing.assert_allclose(bounds, np.sqrt(1.3) * np.array([1.0, 0.6, 0.36]), rtol=1e-14)
    assert reach > 0.99 * float(one.reach_nm)
    assert float(PLATFORM.reach_nm) == pytest.approx(2.7, rel=1e-15)
    for motion, khz in ((PLATFORM, 180.0), (surface, 181.0)):
        assert float(motion.fastest_angular_frequency) == pytest.approx(PER_KHZ * khz, rel=1e-15)


def heights(scene: Scene) -> Any:
    surface, response = surface_of(scene)
    assert response is not None
    return jnp.stack([*surface.position_and_velocity(7.7), *response.position_and_velocity(7.7)])


compiled = jax.jit(heights)


def test_every_parameter_has_its_derivative():
    forward, reverse = jax.jacfwd(compiled)(FULL), jax.jacrev(compiled)(FULL)
    leaves, structure = jax.tree.flatten(FULL)
    slopes = zip(jax.tree.leaves(forward), jax.tree.leaves(reverse), strict=True)
    for place, (slope, backward) in enumerate(slopes):
        # sums in another order
        np.testing.assert_allclose(slope, backward, rtol=1e-10, atol=1e-12)
        step = 1e-4 * max(1.0, abs(float(leaves[place])))

        def moved(by, place=place):
            values = [leaf + by if here == place else leaf for here, leaf in enumerate(leaves)]
            return np.asarray(compiled(jax.tree.unflatten(structure, values)))

        near, far = ((moved(h) - moved(-h)) / (2 * h) for h in (step, 2 * step))
        # fourth order in 1e-2 kHz near resonance (width 2 kHz); rounding of 1e-14 over 1e-4
        np.testing.assert_allclose(slope, (4 * near - far) / 3, rtol=1e-6, atol=1e-8)
        assert np.any(np.asarray(slope) != 0.0), f"parameter {place} changes nothing"


def test_undamped_at_resonance_is_refused():
    base, force = BaseDrive(1.0, 90.0), ForceDrive(1.0, 50.0, 0.0, Tone(1.0, 90.0 + 1e-9))
    cases: tuple[tuple[float | None, dict[str, Any]], ...] = ((None, {"base": base}), (np.inf, {"force": force}))
    for quality, drive in cases:
        (name,) = drive
        with pytest.raises(ValueError, match=f"`{name}` drives an undamped cantilever at its free frequency"):
            surface_of(Scene(Cantilever(90.0, quality), PLATFORM, **drive))
    # damped, or a drive that does not move, or the platform at that frequency: all is well
    surface_of(Scene(Cantilever(90.0, 1e6), PLATFORM, base=BaseDrive(1.0, 90.0)))
    surface_of(Scene(Cantilever(90.0), PLATFORM, base=BaseDrive(0.0, 90.0)))
    surface_of(Scene(Cantilever(90.0), Platform(1.0, 90.0), base=BaseDrive(1.0, 91.0)))


@pytest.mark.parametrize("drive", ["force", "base"])
def test_what_a_detector_shows_follows_from_the_motion_in_the_free_tips_frame(drive: str):
    """Complex numbers as in the textbook: z = a/gamma for a drive a, the frame's motion on top of it."""
    ratio, quality, moves = np.array([0.9, 1.0, 1.03]), 200.0, 3.0 * np.exp(0.7j)
    gamma = 1.0 - ratio**2 + 1j * ratio / quality
    free = moves / gamma
    # the frame's clock starts where the free tip is lowest
    clock = -free / np.abs(free)
    moved = np.array([0.0, 20.0 * np.exp(2.0j), 7.0 * np.exp(-1.0j)])
    seen = free + moved * clock - (moves if drive == "base" else 0.0)
    phases_deg, of_base = np.degrees(np.angle(moved)), drive == "base"
    amplitude, lag = detected(np.abs(moved), phases_deg, np.abs(free), ratio, quality, base=of_base)
    np.testing.assert_allclose(amplitude, np.abs(seen), rtol=1e-12)
    np.testing.assert_allclose(lag, np.degrees(np.angle(moves / seen)) % 360.0, rtol=1e-10)
    deflection = height_of_free_deflection(np.abs(free - moves), ratio, quality)
    np.testing.assert_allclose(deflection, np.abs(free), rtol=1e-12)
