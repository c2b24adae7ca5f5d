"""A million impacts in a row.

Hard: an error of the phase that always has the same sign, or an energy that rounding feeds, adds up unseen; and late
times have lost seven digits of the drive's phase.

Right answers: without losses over a platform at rest every flight lasts half a free period and the speed never changes;
on a stable orbit every impact is one period after the last.
"""

from functools import partial

import jax
import numpy as np
import pytest

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.impact.law import ImpactLaw
from afm_jax.impact.map import iterate_map
from afm_jax.impact.orbits import single_impact_orbits
from afm_jax.outcomes import Outcome

pytestmark = pytest.mark.slow

IMPACTS = 1_000_000
EPS = float(np.finfo(float).eps)
_run = jax.jit(partial(iterate_map, impacts=IMPACTS))


def test_an_elastic_tip_over_a_platform_at_rest_keeps_time_and_energy():
    rows = _run(Scene(Cantilever(90.0, np.inf), Platform(0.0, 180.0), ImpactLaw(r=1.0)), 0.0, 60.0)
    assert (np.asarray(rows.outcome) == Outcome.IMPACT).all()
    half = 1e3 / 180.0
    # an impact is known to 1e-13 us and its time is rounded: were all errors of one sign
    ideal = half * np.arange(1, IMPACTS + 1)
    off = np.abs(np.asarray(rows.time_us) - ideal)
    assert np.all(off <= np.arange(1, IMPACTS + 1) * (1e-13 + EPS * ideal))
    assert off[-1] < 2e-11 * ideal[-1]
    # cos(error) of the speed, one rounding or two each
    assert np.abs(np.asarray(rows.velocity_after_nm_per_us) / 60.0 - 1.0).max() < 1e-10


def test_a_stable_orbit_is_never_left():
    scene = Scene(Cantilever(90.0, 40.0), Platform(4.0, 181.8, -1.0), ImpactLaw(r=0.95, epsilon=60.0))
    found = single_impact_orbits(scene, 1)
    slot = int(np.flatnonzero(found.stable & found.admissible)[-1])
    begin = float(found.phase_rad[slot] / scene.platform.angular_frequency)
    rows = _run(scene, begin, float(found.velocity_after_nm_per_us[slot]))
    period = 1e3 / 181.8
    # errors do not add up, for the platform holds the phase: what is left is the rounding of late times
    off = np.abs(np.asarray(rows.time_us) - begin - period * np.arange(1, IMPACTS + 1))
    assert off.max() < 1e-10 + 16 * EPS * period * IMPACTS
    speed = np.asarray(rows.velocity_after_nm_per_us) / float(found.velocity_after_nm_per_us[slot])
    assert np.abs(speed - 1.0).max() < 1e-8
