"""General-purpose integrators with events on one collision and one driven contact, phase by phase in time.

SciPy's and SUNDIALS', and Diffrax's own events: the baselines of the contact benchmarks.
"""

import math
import time
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
from jax import lax
from jaxtyping import Array

from afm_jax.apparatus.scene import Scene
from afm_jax.bench.integrators import EVENT, Integrator, integrate_to_event, title
from afm_jax.bench.problems import SingleContacts
from afm_jax.bench.study import Contestant, Row, named
from afm_jax.contact.contact import Contact
from afm_jax.contact.forces import jkr
from afm_jax.contact.forces.liquid import Capillary, Structural, Viscous
from afm_jax.contact.forces.solid import CoreRepulsion
from afm_jax.contact.junction import find_junction
from afm_jax.motion.record import ContactKind, Simulation

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
        method: see `Integrator`.
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
        met = integrate_to_event(rates, (0.0, _LONGEST_US), state, [event], Integrator(method, rtol, 1e-3 * rtol))
        count += met.evaluations
        return met.time, met.state

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
    assert isinstance(solid, jkr.Jkr)  # the paper's contact  # noqa: S101
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


_MOST_PHASES = 100


class ScipyContact(NamedTuple):
    """What SciPy finds, and what that took."""

    departure_time_us: float
    rebound_speed_nm_per_us: float
    junctions: int
    seconds: float
    evaluations: int


class _Drive(NamedTuple):
    """Cantilever and platform as Python floats."""

    stiffness: float
    friction: float
    amplitude: float
    omega: float
    offset: float
    rate: float
    inverse_mass: float

    def acceleration(self, time_us: float, gap: float, rate: float, force: float) -> float:
        """Return the gap's acceleration in nm/us^2 under a contact force in nN (eq. 16)."""
        cosine, sine = math.cos(self.omega * time_us), math.sin(self.omega * time_us)
        height = self.offset + self.rate * time_us + self.amplitude * cosine
        speed = self.rate - self.amplitude * self.omega * sine
        pull = self.stiffness * (gap + height) + self.friction * (rate + speed)
        return force * self.inverse_mass - pull + self.amplitude * self.omega**2 * cosine


def scipy_driven_contact(
    scene: Scene, arrival_time_us: float, approach_speed_nm_per_us: float, *, rtol: float, method: str = "DOP853"
) -> ScipyContact:
    """Follow one tip from the bridge's formation to its end, with as many turns and junctions as it takes.

    The junction is followed in s = sqrt(A), in which the fold is no singularity of the force. The flight before the
    contact is not part of it.

    Args:
        scene: driven by one cosine of its platform, with the paper's contact, all effects present.
        arrival_time_us: when the bridge forms.
        approach_speed_nm_per_us: relative to the platform.
        rtol: relative tolerance; the absolute one is a thousandth of it.
        method: see `Integrator`.

    Raises:
        ValueError: if the tip does not leave or SciPy gives up.
    """
    numbers, drive = _numbers(scene.interaction), _drive_of(scene)
    began = time.perf_counter()
    count = 0

    def phase(rates: Any, start_us: float, state: list[float], events: list[Any]) -> tuple[int, float, Any]:
        nonlocal count
        span = (start_us, start_us + _LONGEST_US)
        met = integrate_to_event(rates, span, state, events, Integrator(method, rtol, 1e-3 * rtol))
        count += met.evaluations
        return met.event, met.time, met.state

    def in_bridge(now: float, state: np.ndarray) -> list[float]:
        force = _bridge_force(numbers, state[0], state[1])
        return [state[1], drive.acceleration(now, state[0], state[1], force)]

    def in_junction(_: float, state: np.ndarray) -> list[float]:
        # state: s, dD/dt, t, in the fictitious time theta with dt = Delta'(s) dtheta: smooth through the fold
        s, rate, now = state
        slope = numbers.depth * (4.0 * s**3 - jkr.SLOPE)
        gap = numbers.shift - numbers.depth * (s**4 - jkr.SLOPE * s)
        load = numbers.load * s**3 * (s**3 - math.sqrt(6.0))
        return [-rate, slope * drive.acceleration(now, gap, rate, load), slope]

    events = [lambda _, y: y[0] - numbers.snap_on, lambda _, y: y[0] - numbers.breaks]
    on = float(_root_of_depth((numbers.shift - numbers.snap_on) / numbers.depth))
    now, gap, rate, junctions = arrival_time_us, numbers.forms, -approach_speed_nm_per_us, 0
    for _ in range(_MOST_PHASES):
        met, now, (_, rate) = phase(in_bridge, now, [gap, rate], events)
        if met == 1:
            return ScipyContact(now, float(rate), junctions, time.perf_counter() - began, count)
        junctions += 1
        _, _, (_, rate, now) = phase(in_junction, 0.0, [on, float(rate), now], [lambda _, y: y[0] - jkr.FOLD])
        gap, rate, now = numbers.snap_off, float(rate), float(now)
    raise ValueError(f"the tip that arrives at {arrival_time_us:g} us forms the junction {junctions} times: it is held")


def diffrax_driven_contact(
    scene: Scene, arrival_time_us: float, approach_speed_nm_per_us: float, *, rtol: float
) -> ScipyContact:
    """Follow the tip of `scipy_driven_contact` by Dopri8, each phase ended by Diffrax's event; compiling is not timed.

    The rebound speed is NaN where a phase has no end.
    """
    numbers = _numbers(scene.interaction)
    on = float(_root_of_depth((numbers.shift - numbers.snap_on) / numbers.depth))
    arguments = scene, numbers, on, arrival_time_us, approach_speed_nm_per_us, rtol
    arguments = jax.tree.map(jnp.asarray, arguments)
    jax.block_until_ready(_diffrax_contact(*arguments))
    began = time.perf_counter()
    found = jax.block_until_ready(_diffrax_contact(*arguments))
    seconds = time.perf_counter() - began
    left, rebound, junctions, steps = (part.item() for part in found)
    return ScipyContact(left, rebound, junctions, seconds, _STAGES * steps)


_STAGES = 14
"""Evaluations of the rates in a step of Dopri8."""


@jax.jit
def _diffrax_contact(
    scene: Scene, numbers: _ContactNumbers, on: Array, arrival: Array, speed: Array, rtol: Array
) -> tuple[Array, Array, Array, Array]:
    """Return departure time, rebound speed, junctions and steps."""
    cantilever, platform, contact = scene.cantilever, scene.platform, scene.interaction

    def acceleration(now: Array, gap: Array, rate: Array, force: Array) -> Array:
        height, wall = platform.position_and_velocity(now)
        free = cantilever.acceleration(gap + height, rate + wall)
        return force / cantilever.mass_ng + free - platform.acceleration(now)

    def in_bridge(now: Any, state: Any, _: Any) -> Any:
        gap, rate = state
        return rate, acceleration(now, gap, rate, contact.forces(jnp.maximum(gap, 0.5 * numbers.snap_on), rate))

    def in_junction(_: Any, state: Any, args: Any) -> Any:
        del args
        s, rate, now = state
        slope = numbers.depth * (4.0 * s**3 - jkr.SLOPE)
        gap = numbers.shift - numbers.depth * (s**4 - jkr.SLOPE * s)
        load = numbers.load * s**3 * (s**3 - math.sqrt(6.0))
        return -rate, slope * acceleration(now, gap, rate, load), slope

    def passing(level: Array) -> Any:
        def beyond(t: Any, y: Any, args: Any, **extra: Any) -> Any:
            del t, args, extra
            return y[0] - level

        return beyond

    def phase(rates: Any, begin: Array, state: tuple[Any, ...], down: Any, up: Any) -> diffrax.Solution:
        """Follow until the first part of the state falls to a value, or rises to another."""
        return diffrax.diffeqsolve(
            diffrax.ODETerm(rates),
            diffrax.Dopri8(),
            begin,
            begin + _LONGEST_US,
            None,
            state,
            stepsize_controller=diffrax.PIDController(rtol=rtol, atol=1e-3 * rtol),
            event=diffrax.Event(
                [passing(down), passing(up)],
                optimistix.Newton(1e-14, 1e-14),
                direction=[False, True],
            ),
            adjoint=diffrax.ForwardMode(),
            max_steps=None,
            throw=False,
        )

    def last(solution: diffrax.Solution) -> tuple[Any, ...]:
        assert solution.ts is not None  # noqa: S101 (for the type checker: the end is saved)
        assert solution.ys is not None  # noqa: S101
        return solution.ts[-1], *(part[-1] for part in solution.ys), solution.stats["num_steps"]

    def round_of(state: tuple[Any, ...]) -> tuple[Any, ...]:
        now, gap, rate, junctions, steps, _ = state
        through = phase(in_bridge, now, (gap, rate), numbers.snap_on, numbers.breaks)
        met: Any = through.event_mask
        forms, leaves = met
        now, _, rate, more = last(through)

        def pressed(now: Array, rate: Array) -> tuple[Array, Array, Array]:
            _, _, rate, now, more = last(phase(in_junction, jnp.zeros_like(now), (on, rate, now), fold, never))
            return now, rate, more

        now, rate, pressing = lax.cond(forms, pressed, lambda now, rate: (now, rate, jnp.zeros_like(more)), now, rate)
        rate = jnp.where(forms | leaves, rate, jnp.nan)
        steps = steps + more + pressing
        return now, numbers.snap_off, rate, junctions + forms.astype(junctions.dtype), steps, ~forms

    fold, never = jnp.full_like(on, jkr.FOLD), jnp.full_like(on, jnp.inf)
    none = jnp.zeros((), int)
    first: tuple[Any, ...] = (arrival, numbers.forms, -speed, none, none, jnp.zeros((), bool))
    found = lax.while_loop(lambda state: ~state[-1] & (state[3] < _MOST_PHASES), round_of, first)
    return found[0], jnp.where(found[-1], found[2], jnp.nan), found[3], found[4]


def contact_contestants(
    scene: Scene,
    reference: Simulation,
    single: SingleContacts,
    count: int,
    *,
    methods: Sequence[str] = ("DOP853",),
    tolerances: Sequence[float] = (1e-6, 1e-9),
) -> list[Contestant]:
    """Return integrators that follow a few single contacts, flights not included; half of them turn where some do.

    Args:
        scene: the scene.
        reference: the contacts, each the first of its tip.
        single: the same contacts, and which of them turn.
        count: how many to follow.
        methods: see `Integrator`, or `EVENT`.
        tolerances: relative ones, the settings.
    """
    contacts = reference.contacts
    ended = np.asarray(contacts.kind)[:, 0] == ContactKind.IMPACT
    straight, turning = np.flatnonzero(ended & ~single.turning), np.flatnonzero(ended & single.turning)
    half = count // 2 if turning.size else 0
    tips = np.concatenate([straight[: count - half], turning[:half]])
    arrival, approach, rebound, departure = (
        np.asarray(column)[tips, 0]
        for column in (
            contacts.arrival_time_us,
            contacts.approach_speed_nm_per_us,
            contacts.rebound_speed_nm_per_us,
            contacts.departure_time_us,
        )
    )
    parts = {"straight": slice(0, count - half), "turning": slice(count - half, None)}

    def contestant(method: str) -> Contestant:
        follow = diffrax_driven_contact if method == EVENT else partial(scipy_driven_contact, method=method)

        def measure(rtol: float) -> Row:
            runs = [
                follow(scene, float(at), float(speed), rtol=rtol) for at, speed in zip(arrival, approach, strict=True)
            ]
            errors = {
                "rebound_error": np.abs(np.array([run.rebound_speed_nm_per_us for run in runs]) / rebound - 1.0),
                "time_error_us": np.abs(np.array([run.departure_time_us for run in runs]) - departure),
            }
            return {
                "contacts": len(runs),
                "microseconds_per_contact": 1e6 * float(np.median([run.seconds for run in runs])),
                "evaluations_per_contact": float(np.mean([run.evaluations for run in runs])),
                **{
                    f"{part}_{name}_worst": float(values[rows].max())
                    for part, rows in parts.items()
                    for name, values in errors.items()
                    if values[rows].size
                },
            }

        return Contestant(title(method), named("tolerance", tolerances), measure)

    return [contestant(method) for method in methods] if tips.size else []


def _drive_of(scene: Scene) -> _Drive:
    cantilever, platform = scene.cantilever, scene.platform
    values = (
        cantilever.angular_frequency**2,
        2.0 * cantilever.decay_rate,
        platform.amplitude_nm,
        platform.angular_frequency,
        platform.offset_nm,
        platform.offset_rate_nm_per_us,
        1.0 / cantilever.mass_ng,
    )
    return _Drive(*(float(value) for value in values))
