"""Tips that the contact holds.

Hard: a held tip rings in the junction a thousand times faster than the cantilever, forms and breaks it hardly, each
time stretching what it was off, and takes steps without an impact to show for them.

Right answer: SciPy's integration phase by phase (tests/reference_driven_contact.py).
"""

from typing import Any

import jax
import numpy as np
import pytest

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.contact.contact import Contact
from afm_jax.motion.record import ContactKind, MotionOutcome
from afm_jax.motion.simulate import simulate
from tests.reference_driven_contact import DrivenContact, follow
from tests.test_simulate_contact import ROOM, reference, scene_of, state


@pytest.mark.slow
def test_a_held_tip_is_followed():
    system = reference(1.01, 0.5)
    start = system.start(phase_deg=0, height_nm=5, velocity_nm_per_us=-8.0)
    course = follow(system, *start, until_us=start[0] + 9.0)
    simulation = simulate(scene_of(system), state(start), 9.0)
    assert course.phase == "junction"
    last = int(simulation.count) - 1
    assert int(simulation.outcome) == MotionOutcome.HELD
    assert bool(simulation.held)
    assert int(simulation.contacts.kind[last]) == ContactKind.HELD
    assert np.isinf(simulation.contacts.departure_time_us[last])
    assert float(simulation.final.time_us) == pytest.approx(start[0] + 9.0, abs=1e-12)
    # six junctions form and break, hardly: the error of 1e-9 grows tenfold with each
    assert float(simulation.final.position_nm) == pytest.approx(course.position_nm, abs=1e-4)
    assert float(simulation.final.velocity_nm_per_us) == pytest.approx(course.velocity_nm_per_us, abs=3e-3)
    detail: Any = simulation.contacts.detail
    assert int(detail.junctions[0]) == course.contacts[0].junctions == 6


@pytest.mark.slow
def test_a_tip_that_is_held_for_long_is_followed_to_the_end():
    # held for a period of a slow cantilever, 1,000 oscillations in the junction: room for 64 contacts is enough
    scene = Scene(Cantilever(5.0, 40.0), Platform(4.0, 10.1), Contact.paper(modulus_gpa=70.0))
    simulation = simulate(scene, state((0.0, 10.0, -8.0)), 200.0)
    assert MotionOutcome(int(simulation.outcome)) == MotionOutcome.HELD
    assert float(simulation.final.time_us) == 200.0
    assert int(simulation.count) == 1


@pytest.mark.slow
def test_slopes_of_a_held_tip_are_those_of_the_independent_integration():
    # held in the junction by the platform's ramp from below: a single junction, so that slopes stay moderate
    def made(amplitude) -> DrivenContact:
        return reference(1.01, amplitude)

    start = made(0.5).start(phase_deg=0, height_nm=5, velocity_nm_per_us=-8.0)
    duration = 0.9

    def end(amplitude):
        scene = Scene(Cantilever(90.0, 40.0), Platform(amplitude, 181.8), Contact.paper())
        return simulate(scene, state(start), duration, max_contacts=ROOM).final.position_nm

    slope = float(jax.jit(jax.jacfwd(end))(0.5))
    step = 1e-4
    above, below = (follow(made(0.5 + s), *start, until_us=start[0] + duration).position_nm for s in (step, -step))
    assert slope == pytest.approx((above - below) / (2.0 * step), rel=1e-4)
