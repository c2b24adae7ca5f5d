"""A law as a table: the same impacts, orbits and motions as the formula it was made of."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import afm_jax as afm
from afm_jax import Cantilever, CollisionDelay, ImpactLaw, Platform, Scene, TabulatedLaw
from afm_jax.impact.law import MOST_KNOTS, Law, extrapolation_of

DELAY = CollisionDelay(0.206, 5.64, 0.726)
WET = ImpactLaw(0.9999, 114.0, 0.48, DELAY)


def table_of(law: Law, *, rows: int = 20, low: float = 1.15, high: float = 300.0, **options) -> TabulatedLaw:
    """Return a law's table from a multiple of its capture speed on."""
    u = np.geomspace(low * float(law.capture_speed_nm_per_us) or 1.0, high, rows)
    return TabulatedLaw(u, law.rebound_speed(u), None if law.delay is None else law.collision_delay(u), **options)


@pytest.mark.parametrize(
    ("r", "epsilon", "c", "rows", "lasts"),
    [
        (0.9999, 114.0, 0.48, 20, True),
        (0.5, 0.5, 0.0, 2 * MOST_KNOTS, True),
        (1.0, 0.0, 0.7, 4, False),
    ],
)
def test_a_table_of_the_formula_is_the_formula(r, epsilon, c, rows, lasts):
    law = ImpactLaw(r, epsilon, c, DELAY if lasts else None)
    table = table_of(law, rows=rows)
    capture = float(law.capture_speed_nm_per_us)
    # what a capture speed that is extrapolated loses to rounding
    assert float(table.capture_speed_nm_per_us) == pytest.approx(capture, rel=1e-9)
    u = np.geomspace(1.001 * capture, 1e4, 50)
    np.testing.assert_allclose(table.rebound_speed(u), law.rebound_speed(u), rtol=1e-6)
    np.testing.assert_allclose(table.approach_speed(table.rebound_speed(u)), u, rtol=1e-12)
    np.testing.assert_allclose(table.rebound_slope(u[5:]), law.rebound_slope(u[5:]), rtol=1e-6)
    np.testing.assert_allclose(table.collision_delay(u[5:]), law.collision_delay(u[5:]), rtol=1e-6, atol=1e-6)
    assert bool(table.captures(0.999 * capture))
    assert float(table.rebound_speed(0.999 * capture)) == 0.0


def odd(u: np.ndarray) -> np.ndarray:
    """Return rebound speeds that no formula has; captured at 10 nm/us."""
    return np.sqrt(u**2 - 100.0) * (0.9 - 0.05 * np.sin(np.log(u)))


def test_a_table_goes_through_its_rows_and_is_smooth_between_and_down_to_capture():
    u = np.geomspace(11.0, 250.0, MOST_KNOTS)
    delay = 0.2 * u**-0.2 + 0.01 * np.cos(np.log(u))
    law = TabulatedLaw(u, odd(u), delay, capture_speed_nm_per_us=10.0)
    np.testing.assert_allclose(law.rebound_speed(u), odd(u), rtol=1e-12)
    np.testing.assert_allclose(law.collision_delay(u), delay, rtol=1e-11)
    between = np.geomspace(12.0, 240.0, 777)
    # fourth order in the distance of the knots, 0.04
    np.testing.assert_allclose(law.rebound_speed(between), odd(between), rtol=1e-4)
    # of more rows than knots the same curve, smoothed
    many = np.geomspace(11.0, 250.0, 40 * MOST_KNOTS)
    smoothed = TabulatedLaw(many, odd(many), capture_speed_nm_per_us=10.0)
    np.testing.assert_allclose(smoothed.rebound_speed(between), odd(between), rtol=1e-4)
    # the squared rebound speed rises from 0 with a slope
    close = 10.0 + np.array([1e-9, 1e-6, 1e-3])
    rate = np.asarray(law.rebound_speed(close)) ** 2 / (close - 10.0)
    np.testing.assert_allclose(rate, rate[0], rtol=1e-3)
    coordinates = law.coordinate(jnp.asarray(between))
    np.testing.assert_allclose(law.speeds(coordinates).approach, between, rtol=1e-13)
    np.testing.assert_allclose(law.speeds(coordinates).rebound, law.rebound_speed(between), rtol=1e-12)


def test_slopes_and_the_inverse_are_derivatives():
    u = np.geomspace(11.0, 250.0, 12)
    law = TabulatedLaw(u, odd(u), 0.2 * u**-0.2)
    at, step = 33.0, 1e-4
    for function, slope in ((law.rebound_speed, law.rebound_slope), (law.collision_delay, law.delay_slope)):
        difference = float(function(at + step) - function(at - step)) / (2.0 * step)
        assert float(slope(at)) == pytest.approx(difference, rel=1e-7)
    w = law.rebound_speed(at)
    assert float(jax.grad(law.approach_speed)(w)) == pytest.approx(1.0 / float(law.rebound_slope(at)), rel=1e-12)

    def rebound_at_20(scale):
        return TabulatedLaw(u, odd(u) * scale).rebound_speed(20.0)

    difference = (rebound_at_20(1.0 + 1e-5) - rebound_at_20(1.0 - 1e-5)) / 2e-5
    assert float(jax.jit(jax.grad(rebound_at_20))(1.0)) == pytest.approx(float(difference), rel=1e-7)


def test_it_says_where_it_is_extrapolated():
    law = table_of(WET, low=1.5, high=200.0)
    slowest = 1.5 * float(WET.capture_speed_nm_per_us)
    beyond = law.extrapolated(np.array([slowest - 1.0, slowest + 1.0, 199.0, 201.0]))
    assert beyond.tolist() == [True, False, False, True]
    assert not bool(WET.extrapolated(1e4))
    said = extrapolation_of(law, [[slowest + 1.0, 250.0], [np.nan, 300.0]])
    known = f"the law is known from {slowest:.4g} to 200 nm/us"
    assert said == f"Extrapolated: {known}, but 2 of 3 impacts come at 250 to 300 nm/us."
    assert (extrapolation_of(law, [150.0, np.nan]), extrapolation_of(WET, [1e4])) == (None, None)


def test_rows_that_are_captured_bound_the_capture_speed_and_without_adhesion_there_are_none():
    u = np.array([5.0, 9.0, 12.0, 20.0, 60.0, 200.0])
    law = TabulatedLaw(u, np.where(u > 10.0, odd(np.maximum(u, 10.0)), 0.0))
    assert 9.0 <= float(law.capture_speed_nm_per_us) < 12.0
    assert not bool(law.captures(12.0))
    law = TabulatedLaw(u, 0.8 * u)
    assert float(law.capture_speed_nm_per_us) == 0.0
    assert not bool(law.adheres)
    assert float(law.slow_restitution) == pytest.approx(0.8, rel=1e-12)
    assert float(law.rebound_speed(0.01)) == pytest.approx(0.008, rel=1e-12)


@pytest.fixture(scope="module")
def scenes() -> tuple[Scene, Scene]:
    """The same scene with a formula and with its table."""
    parts = Cantilever(90.0, 40.0), Platform(4.0, 181.8, -1.0)
    return Scene(*parts, WET), Scene(*parts, table_of(WET))


@pytest.mark.slow
@pytest.mark.parametrize("lasts", [True, False])
def test_orbits_are_those_of_the_formula(lasts, scenes):
    """Without a delay as well: of a formula a quartic, of a table a scan."""
    if not lasts:
        law = ImpactLaw(0.99, 100.0, 0.3)
        scenes = [Scene(scenes[0].cantilever, scenes[0].platform, one) for one in (law, table_of(law))]
    found = [afm.single_impact_orbits(scene, 1) for scene in scenes]
    numbers = ("approach_speed_nm_per_us", "peak_amplitude_nm", "lockin_amplitude_nm", "trace", "determinant")
    for name in (*numbers, "stable", "admissible"):
        ours, theirs = (np.asarray(getattr(one, name))[np.asarray(one.exists)] for one in found)
        assert ours.size >= 2
        np.testing.assert_allclose(ours, theirs, rtol=1e-6)
