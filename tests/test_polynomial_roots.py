"""All real roots of a polynomial in an interval, against polynomials made from their roots and 50-digit roots."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from afm_jax.solve.polynomial_roots import real_roots

LOW, HIGH = 0.0, 10.0
find = jax.jit(real_roots)


def found_in(coefficients, low=LOW, high=HIGH) -> np.ndarray:
    roots, exists = find(jnp.asarray(coefficients, float), jnp.asarray(float(low)), jnp.asarray(float(high)))
    assert np.all(np.isfinite(roots))
    return np.asarray(roots)[np.asarray(exists)]


@pytest.mark.filterwarnings("ignore:Descending")  # newer mpmath would like the lowest power first, older cannot
@settings(deadline=None, max_examples=80)
@given(coefficients=st.lists(st.integers(-50, 50), min_size=5, max_size=5))
def test_roots_of_any_quartic_are_those_of_mpmath(coefficients):
    leading = np.flatnonzero(coefficients)
    if len(leading) == 0 or leading[0] > 2:
        return
    with mpmath.workdps(60):
        exact = mpmath.polyroots(coefficients[leading[0] :], maxsteps=500, extraprec=400)
        real = [float(mpmath.re(z)) for z in exact if abs(mpmath.im(z)) < 1e-15]
        almost = [z for z in exact if 1e-15 <= abs(mpmath.im(z)) < 1e-6]
    low, high = 0.0031415, 9.9973  # no root of these is so near that it could fall on either side
    real = np.sort([x for x in real if low < x < high])
    if almost or np.any(np.diff(real) < 1e-6):
        return  # double roots are judged below
    found = found_in(coefficients, low, high)
    assert found.shape == real.shape
    # Simple roots of integers up to 50; the closest pairs lose some digits.
    np.testing.assert_allclose(found, real, rtol=1e-9)


@pytest.mark.parametrize("gap", [1e-2, 1e-6])
def test_a_close_pair_is_told_apart(gap):
    exact = np.array([2.0, 2.0 + gap, 5.0, 11.0])
    with mpmath.workdps(50):
        coefficients = [mpmath.mpf(1)]
        for root in exact:
            shifted = [*coefficients, mpmath.mpf(0)]
            coefficients = [a - mpmath.mpf(float(root)) * b for a, b in zip(shifted, [0, *coefficients], strict=True)]
    found = found_in([float(c) for c in coefficients])
    assert found.shape == (3,)
    # Coefficients of 200 rounded to 1e-14 move the pair by 1e-14/(27 gap).
    np.testing.assert_allclose(found, exact[:3], rtol=0, atol=max(1e-13 / gap, 1e-12))


def test_ends_of_the_interval_belong_to_it():
    np.testing.assert_allclose(found_in(np.poly([0.0, 4.0, 10.0, -3.0])), [0.0, 4.0, 10.0], rtol=0, atol=1e-13)
    np.testing.assert_allclose(found_in(np.poly([2.0, 5.0, 6.0, 9.0]), 5.5, 8.0), [6.0], rtol=1e-12)
    assert found_in([1.0, 0.0, 2.0, 0.0, 1.0]).size == 0


def test_roots_of_very_different_size_keep_their_digits():
    exact = np.array([1e-6, 1e-2, 3.0, 1e5])
    # Relative accuracy over eleven decades: the coefficients determine each root to some roundings.
    np.testing.assert_allclose(found_in(np.poly(exact), 0.0, 1e6), exact, rtol=1e-13)
