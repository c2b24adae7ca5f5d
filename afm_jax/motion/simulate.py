"""A scene followed in time, whatever its interaction: free, from impact to impact of a law, or through contacts.

Takes a scene, a start (us, nm, nm/us in the lab) and a duration in us; gives a `Simulation` (eqs. 2 to 6 with a law,
eq. 16 with a contact).
"""

import math
from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.apparatus.surface import Surface, surface_of
from afm_jax.checks import check_count, check_parameter, check_scalar, checked, is_traced, require_float64
from afm_jax.contact.contact import Contact
from afm_jax.contact.junction import ContactPhase, end_of_contact, find_junction, require_junction
from afm_jax.contact.settings import driven_setting_of
from afm_jax.impact.law import Law
from afm_jax.motion.contact_motion import follow_contacts, has_just_left
from afm_jax.motion.law_motion import follow_law
from afm_jax.motion.record import (
    Contacts,
    MotionOutcome,
    Simulation,
    State,
    to_gap,
    with_response,
)
from afm_jax.motion.start import default_start

DEFAULT_ACCURACY = 1e-9
_CONTACTS_PER_PERIOD = 4.0
_MORE_ROOM = 4
_MOST_CONTACTS = 1 << 20
"""Contacts for which room is made unasked: with a resolved contact 100 MB."""
_LEAST_ROOM = 64
"""Rows made unasked are a power of two from here on: few shapes, so that few programs are compiled."""


@checked
def simulate(  # noqa: PLR0913
    scene: Scene,
    start: State | None = None,
    duration_us: ArrayLike = 1000.0,
    *,
    max_contacts: int | None = None,
    accuracy: float = DEFAULT_ACCURACY,
    method: str = "collocation",
    reverse: bool = False,
    max_rounds: int | None = None,
) -> Simulation:
    """Return a scene followed in time from a start.

    Works under `jit`, `vmap` (over scenes and starts; the effects are the same for all) and forward differentiation.

    Args:
        scene: a scene with an `ImpactLaw`, a `Contact`, or no interaction (a free cantilever).
        start: time, height and velocity of the tip in the lab, scalars; None: where `afm-jax simulate` starts a scene
            without a start of its own (`default_start`), whose numbers must be known.
        duration_us: how long to follow it, in us.
        max_contacts: most contacts (impacts) there is room for, a plain integer that shapes the result; None: a power
            of two, enough for the duration, which must then be a number. A motion with more (chatter with r close to 1)
            is then followed once more with room for them, outside `jit` and `vmap` up to a million.
        accuracy: of each resolved contact: relative of the rebound speed, a tenth of it in us of the times. Contacts
            that magnify errors are computed again in finer steps until two in a row agree so well (not in reverse
            mode). At least 99.5 % of random contacts hold it, from the capture speed on.
        method: the way through a resolved contact: "collocation" (leg by leg, and in time where a tip turns in the
            bridge or is held) or "diffrax" (in time throughout, with the coefficients of Diffrax's Dopri8; slower).
        reverse: make it differentiable in reverse mode, in memory that grows with the square root of the length.
        max_rounds: most rounds; a tip that is held takes one every 60 steps of its oscillation. None: as many as it
            takes, four for every contact in reverse mode, where all of them are run.

    Returns:
        A `Simulation`; how it ended is its `outcome`, a `MotionOutcome`.

    Raises:
        RuntimeError: if JAX is not set to 64-bit floats, or was not when the scene was built.
        TypeError: if the interaction is neither a law nor a contact nor None.
        ValueError: if the duration is not positive, start or duration are arrays, there is room for nothing, the
            contact has no junction, the start is inside the sample, or there is no such method or accuracy.
    """
    require_float64(scene)
    check_parameter("duration_us", duration_us, "positive")
    start = default_start(scene) if start is None else start
    for name, value in (("duration_us", duration_us), *zip(State._fields, start, strict=True)):
        check_scalar(name, value)
    for name, count in (("max_contacts", max_contacts), ("max_rounds", max_rounds)):
        if count is not None:
            check_count(name, count)
    setting = driven_setting_of(accuracy, method)
    surface, response = surface_of(scene)
    dtype = scene.cantilever.frequency_khz.dtype
    begin = State(*(jnp.asarray(value, dtype) for value in start))
    world = (scene, surface, response, begin, begin.time_us + jnp.asarray(duration_us, dtype))
    if scene.interaction is None:
        return _follow_free(scene.cantilever, response, begin, world[-1])
    if isinstance(scene.interaction, Law):
        follow = partial(follow_law, *world, reverse=reverse)
    elif isinstance(scene.interaction, Contact):
        _check_contact(scene, surface, response, begin)
        follow = partial(follow_contacts, *world, setting=setting, max_rounds=max_rounds, reverse=reverse)
    else:
        kind = type(scene.interaction).__name__
        raise TypeError(f"the interaction must be an ImpactLaw, a Contact or None, not {kind}")
    if max_contacts is not None:
        return follow(max_contacts=max_contacts)
    room = _room(scene, surface, duration_us)
    # in reverse mode every round is run, needed or not
    return _with_room(follow, room if reverse else max(_LEAST_ROOM, room))


@jax.jit
def _follow_free(cantilever: Cantilever, response: Surface | None, start: State, until: Float[Array, ""]) -> Simulation:
    """Return a free tip at the end of a simulation, in closed form; no contacts.

    Args:
        cantilever: the tip and its spring.
        response: the steady response to drives of base and tip, or None.
        start: the tip at the start, in the lab.
        until: time of the end in us.
    """
    free = with_response(response, start, -1.0)
    final = with_response(response, State(until, *cantilever.propagator(until - start.time_us)(*free[1:])))
    none, count = jnp.zeros((0,), until.dtype), jnp.zeros((), jnp.int32)
    sane = jnp.isfinite(final.position_nm) & jnp.isfinite(final.velocity_nm_per_us)
    outcome = jnp.where(sane, MotionOutcome.FINISHED, MotionOutcome.INVALID_START).astype(jnp.int32)
    contacts = Contacts(none.astype(jnp.int32), *[none] * 9, detail=None)
    return Simulation(start, contacts, count, final, jnp.full_like(count, ContactPhase.DRY), outcome)


def _with_room(follow: Callable[..., Simulation], room: int) -> Simulation:
    """Return a motion with room for all its contacts: as long as there is too little, followed again with more."""
    while True:
        simulation = follow(max_contacts=room)
        known = not is_traced(simulation.outcome) and room < _MOST_CONTACTS
        if not (known and bool(jnp.any(simulation.outcome == MotionOutcome.CONTACT_LIMIT))):
            return simulation
        room = min(_MORE_ROOM * room, _MOST_CONTACTS)


def _room(scene: Scene, surface: Platform | Surface, duration_us: ArrayLike) -> int:
    """Return how many contacts a duration may hold: four for every period of the fastest motion.

    Filled up to a power of two: few sizes, so that a program serves many durations.
    """
    fastest = jnp.maximum(scene.cantilever.angular_frequency, surface.fastest_angular_frequency)
    if is_traced(fastest) or is_traced(duration_us):
        raise ValueError("`max_contacts` must be given where frequencies or the duration are traced")
    periods = float(jnp.max(jnp.asarray(duration_us) * fastest)) / (2.0 * math.pi)
    return 1 << (15 + math.ceil(_CONTACTS_PER_PERIOD * periods)).bit_length()


def _check_contact(scene: Scene, surface: Platform | Surface, response: Surface | None, start: State) -> None:
    """Check what is known of a contact scene before it is traced: operation by operation a batch would wait for it."""
    if any(map(is_traced, jax.tree.leaves((scene, start)))):
        return
    junction = find_junction(scene.interaction)
    require_junction(scene.interaction, junction.exists)
    gap, rate = to_gap(surface, response, start)
    leaves = has_just_left(surface, end_of_contact(scene.interaction), start.time_us, gap, rate)
    if not (bool(leaves) or float(gap) > float(junction.forms_gap_nm)):
        raise ValueError(
            f"the start is inside the sample: the gap is {float(gap):.6g} nm, but must be above "
            f"{float(junction.forms_gap_nm):.6g} nm, where the junction forms; start higher"
        )
