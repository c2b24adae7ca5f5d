"""Chatter has more impacts than any number of periods tells: a motion gets the room it needs, unless told otherwise."""

import numpy as np
import pytest

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.impact.law import ImpactLaw
from afm_jax.motion.record import ContactKind, MotionOutcome
from afm_jax.motion.simulate import simulate
from afm_jax.motion.start import state

R, OFFSET_NM, START_NM = 0.97, 20.0, 25.0
SCENE = Scene(Cantilever(90.0), Platform(0.0, 20.0, OFFSET_NM), ImpactLaw(R))
"""A platform at rest presses the tip up; the tip falls on it and bounces ever lower."""


@pytest.fixture(scope="module")
def bounced():
    return simulate(SCENE, state(0.0, START_NM, 0.0), 100.0)


def test_every_impact_of_a_long_chatter_finds_room(bounced):
    count = int(bounced.count)
    # four for every period of the free vibration would be 52
    assert count > 300
    assert int(bounced.outcome) == MotionOutcome.HELD
    kind = np.asarray(bounced.contacts.kind)
    assert (kind[: count - 1] == ContactKind.IMPACT).all()
    assert kind[count - 1] == ContactKind.HELD


def test_each_impact_comes_r_times_as_fast_as_the_one_before_and_all_energy_is_lost_in_them(bounced):
    count, omega = int(bounced.count), 2e-3 * np.pi * 90.0
    speed = np.asarray(bounced.contacts.approach_speed_nm_per_us)[:count]
    first = omega * np.sqrt(START_NM**2 - OFFSET_NM**2)
    # flights without damping over a platform at rest end as fast as they began; the times of impacts are known to 1e-12
    # us, thus the speeds to the push, 6 nm/us^2, times that, an impact
    np.testing.assert_allclose(speed, first * R ** np.arange(speed.size), rtol=1e-9, atol=1e-10)
    lost = np.asarray(bounced.contacts.energy_lost_aj)[:count].sum()
    # the impacts that are summed up have speeds below 1e-6 of the first
    np.testing.assert_allclose(lost, 0.5 * first**2, rtol=1e-10)
