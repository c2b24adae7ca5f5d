"""The linearised map and the implicit derivative, against 50 digits, differences and closed forms."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

from afm_jax.impact.jacobian import map_jacobian
from afm_jax.impact.map import next_impact
from tests import reference_map
from tests.package_scenes import scene_of
from tests.reference_examples import SCENES

STARTS = [(4.0, 60.0), (0.7, 35.0)]


def ends(start, scene):
    """Return (time, velocity after) of the next impact."""
    impact = next_impact(scene, start[0], start[1])
    return jnp.stack([impact.time_us, impact.velocity_after_nm_per_us])


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("start", STARTS)
def test_written_and_automatic_jacobians_have_twelve_digits(name, start):
    p, scene = SCENES[name], scene_of(SCENES[name])
    guess = float(next_impact(scene, *start).arrival_time_us)
    time, velocity = start
    exact = np.array(reference_map.map_jacobian(p, time, velocity, guess).tolist(), dtype=float)
    at = jnp.array(start)
    # Condition numbers of these impacts stay below a few hundred.
    for found in (map_jacobian(scene, *start), jax.jacfwd(ends)(at, scene), jax.jacrev(ends)(at, scene)):
        np.testing.assert_allclose(found, exact, rtol=1e-12)


def test_second_derivatives_of_the_impact_time_have_nine_digits():
    p, scene, (time, velocity) = SCENES["damped"], scene_of(SCENES["damped"]), STARTS[0]
    guess = float(next_impact(scene, time, velocity).arrival_time_us)

    def arrival(t, v):
        return reference_map.next_impact(p, t, v, guess).arrival_time_us

    with mpmath.workdps(60):
        pairs = [(2, 0), (1, 1), (0, 2)]
        exact = [float(mpmath.diff(arrival, (mpmath.mpf(time), mpmath.mpf(velocity)), pair)) for pair in pairs]

    def automatic(at):
        return next_impact(scene, at[0], at[1]).arrival_time_us

    for second in (jax.hessian(automatic), jax.jacfwd(jax.jacfwd(automatic))):
        hessian = np.array(second(jnp.array([time, velocity])))
        np.testing.assert_allclose(hessian[[0, 0, 1], [0, 1, 1]], exact, rtol=1e-9)
        np.testing.assert_allclose(hessian[0, 1], hessian[1, 0], rtol=1e-10)
