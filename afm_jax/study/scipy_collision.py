"""SciPy's `solve_ivp` with events on one collision, phase by phase in time: the baseline of the contact benchmark."""

import time
from typing import Any, NamedTuple

import jax
import numpy as np
from scipy.integrate import solve_ivp

from afm_jax.contact.contact import Contact
from afm_jax.contact.forces import jkr
from afm_jax.contact.forces.capillary import Capillary
from afm_jax.contact.forces.core_repulsion import CoreRepulsion
from afm_jax.contact.forces.structural import Structural
from afm_jax.contact.forces.viscous import Viscous
from afm_jax.contact.junction import find_junction

_LONGEST_US = 50.0
"""No phase of a tip that leaves lasts as long."""
_junction_of, _root_of_depth = jax.jit(find_junction), jax.jit(jkr.root_of_depth)


class ScipyCollision(NamedTuple):
    """What SciPy finds, and what that took."""

    rebound_speed_nm_per_us: float
    collision_delay_us: float
    seconds: float
    evaluations: int


class _ContactNumbers(NamedTuple):
    """The paper's contact as Python floats: SciPy calls the force thousands of times."""

    pull: float
    width: float
    structural: float
    decay: float
    core: float
    drag: float
    load: float
    depth: float
    shift: float
    forms: float
    snap_on: float
    snap_off: float
    breaks: float


def scipy_collision(contact: Contact, approach_speed_nm_per_us: float, *, method: str, rtol: float) -> ScipyCollision:
    """Follow one tip of 1 ng through the paper's forces in time.

    The junction is followed in s = sqrt(A), in which the fold is no singularity of the force.

    Args:
        contact: the paper's contact, all effects present.
        approach_speed_nm_per_us: fast enough for the tip to leave.
        method: of `solve_ivp`.
        rtol: relative tolerance; the absolute one is a thousandth of it.

    Raises:
        ValueError: if the tip does not leave or SciPy gives up.
    """
    numbers = _numbers(contact)
    on = float(_root_of_depth((numbers.shift - numbers.snap_on) / numbers.depth))
    began = time.perf_counter()
    count = 0

    def phase(rates: Any, state: list[float], event: Any) -> tuple[float, np.ndarray]:
        nonlocal count
        vars(event)["terminal"] = True
        path = solve_ivp(rates, (0.0, _LONGEST_US), state, method=method, rtol=rtol, atol=1e-3 * rtol, events=event)
        count += path.nfev
        if path.status != 1:
            raise ValueError(f"at {approach_speed_nm_per_us:g} nm/us SciPy ended without an event: {path.message}")
        return float(path.t_events[0][0]), path.y_events[0][0]

    def in_bridge(_: float, state: np.ndarray) -> list[float]:
        return [state[1], _bridge_force(numbers, state[0], state[1])]

    def in_junction(_: float, state: np.ndarray) -> list[float]:
        # state: s, dD/dt, in the time t' with dt = -Delta'(s) dt': smooth through the fold
        s, rate = state[0], state[1]
        slope = 4.0 * s**3 - jkr.SLOPE
        load = numbers.load * s**3 * (s**3 - np.sqrt(6.0))
        return [-rate / numbers.depth, load * slope, slope]

    first, (_, fast) = phase(in_bridge, [numbers.forms, -approach_speed_nm_per_us], lambda _, y: y[0] - numbers.snap_on)
    _, (_, back, second) = phase(in_junction, [on, fast, 0.0], lambda _, y: y[0] - jkr.FOLD)
    third, (_, rebound) = phase(in_bridge, [numbers.snap_off, back], lambda _, y: y[0] - numbers.breaks)
    delay = first + second + third - numbers.forms / approach_speed_nm_per_us - numbers.breaks / rebound
    return ScipyCollision(float(rebound), float(delay), time.perf_counter() - began, count)


def _numbers(contact: Contact) -> _ContactNumbers:
    terms: dict[type, Any] = {type(term): term for term in contact.forces.terms}
    junction, solid = _junction_of(contact), contact.junction
    capillary, structural = terms[Capillary], terms[Structural]
    values = (
        capillary.pull_nn,
        2.0 * capillary.liquid.kelvin_radius_nm,
        structural.strength_nn,
        structural.decay_nm,
        terms[CoreRepulsion](1.0),
        terms[Viscous].coefficients()[0],
        solid.load_scale_nn,
        solid.depth_scale_nm,
        junction.shift_nm,
        contact.bridge_forms_nm,
        junction.forms_gap_nm,
        junction.breaks_gap_nm,
        contact.bridge_breaks_nm,
    )
    return _ContactNumbers(*(float(value) for value in values))


def _bridge_force(numbers: _ContactNumbers, gap: float, rate: float) -> float:
    # a trial step may overshoot the junction; the forces have no value at contact
    gap = max(gap, 0.5 * numbers.snap_on)
    static = -numbers.pull / (1.0 + gap / numbers.width) + numbers.structural * np.exp(-gap / numbers.decay)
    return static + numbers.core / gap**8 - numbers.drag * rate / gap
