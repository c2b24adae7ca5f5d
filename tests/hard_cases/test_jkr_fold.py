"""The solid junction where it breaks.

Hard: at the fold the depth has a double root in s, dP/dDelta is infinite, and rounding of the depth costs half of the
digits of everything.

Right answer: the fold's closed form, and the quartic solved with 50 digits.
"""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from scipy.integrate import quad

from afm_jax.contact.forces import Jkr
from afm_jax.contact.forces import jkr as jkr_formulas

CURVE = Jkr().curve


def test_jkr_at_its_fold_and_at_its_largest_tension():
    solid = Jkr()
    pull = float(solid.force(solid.pull_off_depth_nm))
    assert pull == pytest.approx(-5.0 / 6.0 * float(solid.load_scale_nn), rel=1e-7)
    # load control: -3/2 pi w R where s^3 = sqrt(6)/2
    deepest = float(CURVE.load((6.0**0.5 / 2.0) ** (1.0 / 3.0)))
    assert deepest == pytest.approx(-1.5, rel=1e-15)
    assert jnp.isfinite(jax.grad(solid.force)(solid.pull_off_depth_nm + 1e-9))
    for depth in (-0.1, 0.0, 0.5, 4.0):
        work = quad(solid.force, -0.15, depth, epsabs=0.0, epsrel=1e-10)[0]
        rise = float(solid.potential(depth) - solid.potential(-0.15))
        assert rise == pytest.approx(work, rel=1e-8, abs=1e-10)


@pytest.mark.parametrize("away", [1e-2, 1e-8, 1e-14])
def test_force_and_stiffness_next_to_the_fold_lose_half_of_the_digits_and_no_more(away: float):
    depth = float(jkr_formulas.FOLD_DEPTH) * (1.0 - away)
    with mpmath.workdps(50):
        slope = 2 * mpmath.sqrt(6) / 3
        begin = jkr_formulas.FOLD + np.sqrt(away)
        s = mpmath.findroot(lambda x: x**4 - slope * x - mpmath.mpf(depth), begin)
        load = s**6 - mpmath.sqrt(6) * s**3
        stiffness = (6 * s**5 - 3 * mpmath.sqrt(6) * s**2) / (4 * s**3 - slope)
    assert s > jkr_formulas.FOLD

    def force(x):
        return CURVE.load(CURVE.root_of_depth(x))

    # the root of a distance known to rounding
    lost = float(np.finfo(float).eps) / away
    assert float(force(depth)) == pytest.approx(float(load), rel=4e-15 + 4.0 * lost * np.sqrt(away))
    assert float(jax.grad(force)(depth)) == pytest.approx(float(stiffness), rel=1e-14 + 4.0 * lost)
    # beyond the fold: the value there, with a slope that is a number
    assert float(force(float(jkr_formulas.FOLD_DEPTH) * (1.0 + away))) == pytest.approx(-5.0 / 6.0, rel=1e-7)
    assert np.isfinite(jax.grad(force)(float(jkr_formulas.FOLD_DEPTH) * (1.0 + away)))
