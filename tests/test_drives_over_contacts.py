"""Drives of base and tip over a resolved contact: the base against a sample moved the other way."""

import numpy as np
import pytest

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.drives import BaseDrive, ForceDrive
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.contact.contact import Contact
from afm_jax.motion.simulate import simulate
from afm_jax.motion.start import state

pytestmark = pytest.mark.slow
"""Each compiles programs of its own for a minute or more."""

FREQUENCY_KHZ, QUALITY, OMEGA = 90.0, 40.0, 2e-3 * np.pi * 90.0
AMPLITUDE_NM, DRIVE_KHZ, OFFSET_NM = 4.0, 181.8, 1.0
DRIVE = 2e-3 * np.pi * DRIVE_KHZ
CANTILEVER = Cantilever(FREQUENCY_KHZ, QUALITY)
START = (4.0, 30.0, 70.0)
DURATION_US = 60.0


def test_a_base_drive_over_a_contact_is_the_sample_moved_the_other_way():
    """Seen from a base that moves as -a cos(omega t) the tip feels -m (z_b'' + Omega/Q z_b')."""
    base = BaseDrive(AMPLITUDE_NM, DRIVE_KHZ, 180.0)
    shaken = Scene(CANTILEVER, Platform(0.0, DRIVE_KHZ, OFFSET_NM), Contact.paper(), base)
    one = simulate(shaken, state(*START), DURATION_US, max_contacts=24)
    loss = OMEGA / QUALITY
    push, lag_deg = AMPLITUDE_NM * DRIVE * np.hypot(DRIVE, loss), np.degrees(np.arctan(loss / DRIVE))
    force = ForceDrive(push, DRIVE_KHZ, 180.0 - lag_deg)
    scene = Scene(CANTILEVER, Platform(AMPLITUDE_NM, DRIVE_KHZ, OFFSET_NM), Contact.paper(), force=force)
    angle = DRIVE * START[0]
    height = START[1] + AMPLITUDE_NM * np.cos(angle)
    velocity = START[2] - AMPLITUDE_NM * DRIVE * np.sin(angle)
    other = simulate(scene, state(START[0], height, velocity), DURATION_US, max_contacts=24)
    count = int(one.count)
    assert count == int(other.count) >= 5
    for name in ("arrival_time_us", "approach_speed_nm_per_us", "rebound_speed_nm_per_us", "energy_lost_aj"):
        lab, moving = (np.asarray(getattr(run.contacts, name))[:count] for run in (one, other))
        # one motion, rounded twice: 1e-14, stretched by every contact
        np.testing.assert_allclose(lab, moving, rtol=1e-9, err_msg=name)
