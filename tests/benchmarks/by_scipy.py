"""The same impacts, collisions and driven contacts by SciPy's `solve_ivp` with events, in plain Python numbers.

The junction is followed in s = sqrt(A), in which the fold is no singularity of the force, and in the fictitious time
theta with dt = Delta'(s) dtheta.
"""

import math
import statistics
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import numpy as np
from scipy.integrate import solve_ivp

import afm_jax as afm
from afm_jax.contact.forces import jkr
from afm_jax.contact.forces.liquid import Capillary, Structural, Viscous
from afm_jax.contact.forces.solid import CoreRepulsion
from tests.benchmarks.tasks import contact_scene, starts_above

TOLERANCE = 1e-9
_LONGEST_US = 50.0
"""No phase lasts as long."""
_SPEEDS = (12.0, 30.0, 100.0)


def scipy_rows() -> Iterator[tuple[str, float]]:
    """Give what SciPy does, and the median of its seconds."""
    yield f"SciPy DOP853, {TOLERANCE:g}: impact of the map", statistics.median(_impact() for _ in range(7))
    contact = _numbers(afm.Contact.paper())
    rest = _Drive(0.0, 0.0, 0.0, 0.0, 1.0)
    told = f"SciPy DOP853, {TOLERANCE:g}: collision"
    yield told, statistics.median(_seconds(contact, rest, 0.0, speed) for speed in _SPEEDS * 3)
    for reduced in (1.01, 5.277):
        scene = contact_scene(reduced)
        start = afm.State(*(part[0] for part in starts_above(scene, 1, 0.0)))
        found = afm.simulate(scene, start, 60.0 * float(scene.platform.period_us)).contacts
        met = np.flatnonzero(np.asarray(found.kind) == 1)[:9]
        columns = np.asarray(found.arrival_time_us)[met], np.asarray(found.approach_speed_nm_per_us)[met]
        cantilever, platform = scene.cantilever, scene.platform
        drive = _Drive(
            float(cantilever.angular_frequency) ** 2,
            2.0 * float(cantilever.decay_rate),
            float(platform.amplitude_nm),
            float(platform.angular_frequency),
            1.0,
        )
        told = f"SciPy DOP853, {TOLERANCE:g}: driven contact alone, n = {reduced:g}"
        yield told, statistics.median(_seconds(contact, drive, *each) for each in zip(*columns, strict=True))


def _impact() -> float:
    """Return the seconds of one impact of figure 2's scene: the flight, and where it meets the platform."""
    free, omega, beta, sigma = 2e-3 * math.pi * 90.0, 2e-3 * math.pi * 180.0, 2.0, -1.0

    def gap(now: float, state: Any) -> float:
        # the start itself is no event, whatever rounding makes of its gap of 0
        return state[0] - sigma - beta * math.cos(omega * now) if now > 0.5 else 1.0

    begin = [sigma + beta * math.cos(0.5 * omega), 30.0]
    began = time.perf_counter()
    _to_event(lambda _, y: (y[1], -free * free * y[0]), 0.5, begin, [gap], longest=2.0 * math.pi / omega / 3.0)
    return time.perf_counter() - began


class _Drive(NamedTuple):
    """Spring, air and platform as numbers; all 0 for a free tip."""

    square: float
    friction: float
    amplitude: float
    omega: float
    inverse_mass: float

    def acceleration(self, now: float, gap: float, rate: float, force: float) -> float:
        """Return the gap's acceleration in nm/us^2 under a contact force in nN (eq. 16)."""
        cosine, sine = math.cos(self.omega * now), math.sin(self.omega * now)
        pull = self.square * (gap + self.amplitude * cosine)
        pull += self.friction * (rate - self.amplitude * self.omega * sine)
        return force * self.inverse_mass - pull + self.amplitude * self.omega**2 * cosine


class _Numbers(NamedTuple):
    """The paper's contact as numbers: SciPy calls the force thousands of times."""

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
    root: float

    def bridge_force(self, gap: float, rate: float) -> float:
        """Return the force in nN in the bridge; a trial step may overshoot to where it has none."""
        gap = max(gap, 0.5 * self.snap_on)
        static = -self.pull / (1.0 + gap / self.width) + self.structural * math.exp(-gap / self.decay)
        return static + self.core / gap**8 - self.drag * rate / gap


def _numbers(contact: Any) -> _Numbers:
    terms: dict[type, Any] = {type(term): term for term in contact.forces.terms}
    junction, solid = jax.jit(afm.find_junction)(contact), contact.junction
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
        junction.forms_root,
    )
    return _Numbers(*(float(value) for value in values))


def _seconds(contact: _Numbers, drive: _Drive, arrival_us: float, approach_speed: float) -> float:
    began = time.perf_counter()
    follow(contact, drive, float(arrival_us), float(approach_speed))
    return time.perf_counter() - began


def follow(contact: _Numbers, drive: _Drive, arrival_us: float, approach_speed: float) -> tuple[float, float]:
    """Follow a tip of 1 ng from the bridge's formation to its end; return when it leaves, and how fast.

    Raises:
        ValueError: if it does not leave.
    """

    def in_bridge(now: float, state: Any) -> list[float]:
        force = contact.bridge_force(state[0], state[1])
        return [state[1], drive.acceleration(now, state[0], state[1], force)]

    def in_junction(_: float, state: Any) -> list[float]:
        s, rate, now = state
        slope = contact.depth * (4.0 * s**3 - jkr.SLOPE)
        gap = contact.shift - contact.depth * (s**4 - jkr.SLOPE * s)
        load = contact.load * s**3 * (s**3 - math.sqrt(6.0))
        return [-rate, slope * drive.acceleration(now, gap, rate, load), slope]

    ends: list[Callable[[float, Any], float]]
    ends = [lambda _, y: y[0] - contact.snap_on, lambda _, y: y[0] - contact.breaks]
    now, gap, rate = arrival_us, contact.forms, -approach_speed
    while True:
        met, now, (_, rate) = _to_event(in_bridge, now, [gap, rate], ends)
        if met == 1:
            return now, rate
        pressed = [contact.root, rate, now]
        _, _, (_, rate, now) = _to_event(in_junction, 0.0, pressed, [lambda _, y: y[0] - jkr.FOLD])
        gap = contact.snap_off


def _to_event(
    rates: Callable[[float, Any], Any],
    begin: float,
    state: list[float],
    events: list[Callable[[float, Any], float]],
    longest: float = math.inf,
) -> tuple[int, float, Any]:
    """Return which event ends an integration, when, and the state there.

    Raises:
        ValueError: if none does.
    """
    for event in events:
        vars(event).update(terminal=True)
    span, accuracy = (begin, begin + _LONGEST_US), (TOLERANCE, 1e-3 * TOLERANCE)
    path = solve_ivp(
        rates, span, state, method="DOP853", events=events, max_step=longest, rtol=accuracy[0], atol=accuracy[1]
    )
    if path.status != 1:
        raise ValueError(f"SciPy ended without an event: {path.message}")
    met = next(place for place, times in enumerate(path.t_events) if len(times))
    return met, float(path.t_events[met][0]), path.y_events[met][0]
