"""The impact law: its values, its inverse and its slopes."""

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from afm_jax.impact.law import CollisionDelay, ImpactLaw
from tests.reference_examples import DELAY, SCENES
from tests.reference_flight import Parameters, capture_speed, delay_us, rebound_slope, rebound_speed

restitution = st.floats(0.3, 1.0)
losses = st.floats(0.0, 300.0)
speeds = st.floats(1.0, 300.0)


def law_of(p: Parameters) -> ImpactLaw:
    delay = None if p.delay is None else CollisionDelay(*p.delay)
    return ImpactLaw(r=p.r, epsilon=p.epsilon, viscous_loss=p.viscous_loss, delay=delay)


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("speed", [12.0, 40.0, 200.0])
def test_law_agrees_with_fifty_digits(name, speed):
    p, law = SCENES[name], law_of(SCENES[name])
    # A few roundings, and 144/(144 - 122) times as many close to the capture speed of 11 nm/us.
    assert float(law.rebound_speed(speed)) == pytest.approx(float(rebound_speed(p, speed)), rel=1e-14)
    assert float(law.rebound_slope(speed)) == pytest.approx(float(rebound_slope(p, speed)), rel=1e-14)
    assert float(law.capture_speed_nm_per_us) == pytest.approx(float(capture_speed(p)), rel=1e-14)
    assert float(law.collision_delay(speed)) == pytest.approx(float(delay_us(p, speed)), rel=1e-12)


@settings(deadline=None)
@given(r=restitution, epsilon=losses, c=st.floats(0.0, 2.0), w=st.floats(0.1, 300.0))
def test_read_backwards_and_forwards_it_is_the_identity(r, epsilon, c, w):
    law = ImpactLaw(r=r, epsilon=epsilon, viscous_loss=c)
    u = law.approach_speed(w)
    assert not bool(law.captures(u))
    # u_out^2 is a difference of numbers as large as r^2 u^2.
    allowed = 1e-14 * (1.0 + (r * float(u) / w) ** 2)
    assert float(law.rebound_speed(u)) == pytest.approx(w, rel=allowed)


@pytest.mark.parametrize("speed", [0.0, 10.0])
def test_a_captured_tip_has_finite_derivatives(speed):
    law = ImpactLaw(r=0.9, epsilon=100.0, viscous_loss=0.5, delay=CollisionDelay(*DELAY))
    for function in (law.rebound_speed, law.rebound_slope, law.collision_delay, law.delay_slope):
        assert float(function(speed)) == 0.0
        assert float(jax.grad(function)(speed)) == 0.0
    slopes = jax.grad(lambda some: some.rebound_speed(speed))(law)
    assert all(np.isfinite(leaf) for leaf in jax.tree.leaves(slopes))
