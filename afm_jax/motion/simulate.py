"""A scene followed in time, whatever its interaction: free, from impact to impact of a law, or through contacts."""

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, ArrayLike, Float

from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene, SceneLike, as_scene
from afm_jax.apparatus.surface import Surface, surface_of
from afm_jax.checks import check_count, check_parameter, check_scalar, checked, is_traced, require_float64
from afm_jax.contact.contact import Contact
from afm_jax.contact.driven import Driven, driven_by
from afm_jax.contact.junction import explain_missing_junction, find_junction
from afm_jax.contact.settings import DrivenSetting, driven_setting_of
from afm_jax.impact.law import Law
from afm_jax.motion.contact_motion import ContactRow, begin, follow
from afm_jax.motion.law_motion import follow_free, follow_law
from afm_jax.motion.record import (
    ContactDetail,
    ContactKind,
    Contacts,
    MotionOutcome,
    Simulation,
    State,
    contacts_in_lab,
    to_gap,
    to_lab,
)
from afm_jax.solve.lanes import power_of_two

DEFAULT_ACCURACY = 1e-9
_ROUNDS_PER_CONTACT = 4
_SPARE_ROUNDS = 64
_HELD_ROUNDS_PER_CONTACT, _LEAST_HELD_ROUNDS = 256, 1 << 16
"""Far more rounds than any motion takes that comes to an end: for every contact there is room for, and at least."""
_CONTACTS_PER_PERIOD = 4.0
_MORE_ROOM = 4
_MOST_CONTACTS = 1 << 20
"""Contacts for which room is made unasked: with a resolved contact 100 MB."""
_LEAST_ROOM = 64
"""Rows made unasked are a power of two from here on: few shapes, so that few programs are compiled."""
_TRIALS_BACKWARDS = 40
"""Trial steps of a round when all of them are run and kept for the way back."""


@checked
def simulate(  # noqa: PLR0913
    scene: SceneLike,
    start: State,
    duration_us: ArrayLike,
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
        start: time, height and velocity of the tip in the lab, scalars.
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
    scene = as_scene(scene)
    require_float64(scene)
    check_parameter("duration_us", duration_us, "positive")
    _check_sizes(start, duration_us, max_contacts=max_contacts, max_rounds=max_rounds)
    setting = driven_setting_of(accuracy, method)
    surface, response = surface_of(scene)
    dtype = scene.cantilever.frequency_khz.dtype
    begin_at = State(*(jnp.asarray(value, dtype) for value in start))
    until = begin_at.time_us + jnp.asarray(duration_us, dtype)
    world = (scene, surface, response, begin_at, until)
    if scene.interaction is None:
        return follow_free(*world)
    follow_with = _follower(world, setting, max_rounds, reverse=reverse)
    try:
        if max_contacts is not None:
            simulation = follow_with(max_contacts)
        else:
            room = _room(scene, surface, duration_us)
            # in reverse mode every round is run, needed or not
            rows = room if reverse else max(_LEAST_ROOM, power_of_two(room))
            simulation = _with_room(follow_with, rows)
    except TypeError as error:
        # JAX's own, where reverse derivatives through its loop are differentiated once more
        if reverse or "NoneType" not in str(error):
            raise
        raise ValueError(_NOT_BACKWARDS) from error
    return simulation if reverse else jax.tree.map(_only_forwards, simulation)


def _follower(
    world: tuple[Any, ...], setting: DrivenSetting, max_rounds: int | None, *, reverse: bool
) -> Callable[[int], Simulation]:
    """Return the function that follows a scene with room for some contacts.

    Raises:
        TypeError: if the interaction is neither a law nor a contact.
        ValueError: if the contact has no junction, or the start is inside the sample.
    """
    scene, surface, response, start, _ = world
    if isinstance(scene.interaction, Law):
        return lambda room: follow_law(*world, max_contacts=room, reverse=reverse)
    if not isinstance(scene.interaction, Contact):
        kind = type(scene.interaction).__name__
        raise TypeError(f"the interaction must be an ImpactLaw, a Contact or None, not {kind}")
    _check_contact(scene, surface, response, start)
    if reverse:
        # legs tell by NaN that they do not hold, which reverse derivatives would spread
        setting = setting._replace(quick=None, trials=_TRIALS_BACKWARDS, agreement=None)

    def follow_contacts(room: int) -> Simulation:
        rounds = max_rounds if max_rounds is not None else _rounds(room, reverse=reverse)
        return _contact(*world, rows=room, setting=setting, rounds=rounds, reverse=reverse)

    return follow_contacts


def _check_sizes(start: State, duration_us: ArrayLike, **counts: int | None) -> None:
    """Check that start and duration are of one scene, and that there is room for something.

    Raises:
        ValueError: if not.
    """
    for name, value in (("duration_us", duration_us), *zip(State._fields, start, strict=True)):
        check_scalar(name, value)
    for name, count in counts.items():
        if count is not None:
            check_count(name, count)


_forwards = Primitive("forwards")
"""A number itself, which says in reverse mode what that needs, before JAX says that a loop has none."""
_forwards.def_impl(lambda number: number)
_forwards.def_abstract_eval(lambda number: number)
mlir.register_lowering(_forwards, lambda _, number: [number])
batching.primitive_batchers[_forwards] = lambda numbers, axes: (_forwards.bind(*numbers), axes[0])


_NOT_BACKWARDS = (
    "`simulate` is differentiable in reverse mode (`grad`, `vjp`, `jacrev`, `hessian`) with `reverse=True` only: add "
    "it, or take `jvp` or `jacfwd`"
)


def _refuse(*_):
    raise ValueError(_NOT_BACKWARDS)


ad.deflinear2(_forwards, _refuse)


def _only_forwards(part: Array) -> Array:
    """Return a part of a result that is traced so that it refuses reverse mode."""
    return _forwards.bind(part) if is_traced(part) and jnp.issubdtype(part.dtype, jnp.floating) else part


def _rounds(room: int, *, reverse: bool) -> int:
    """Return the most rounds of a motion with room for some contacts."""
    if reverse:
        return _ROUNDS_PER_CONTACT * room + _SPARE_ROUNDS
    return max(_HELD_ROUNDS_PER_CONTACT * room, _LEAST_HELD_ROUNDS)


def _with_room(follow_with: Callable[[int], Simulation], room: int) -> Simulation:
    """Return a motion with room for all its contacts: as long as there is too little, followed again with more."""
    simulation = follow_with(room)
    while room < _MOST_CONTACTS and not is_traced(simulation.outcome):
        if not bool(jnp.any(simulation.outcome == MotionOutcome.CONTACT_LIMIT)):
            break
        room = min(_MORE_ROOM * room, _MOST_CONTACTS)
        simulation = follow_with(room)
    return simulation


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
    """Check what can be known of a contact scene before it is traced."""
    leaves = jax.tree.leaves((scene, start))
    if any(is_traced(leaf) for leaf in leaves):
        return
    junction = find_junction(scene.interaction)
    if not bool(junction.exists):
        raise ValueError(f"the contact has no junction: {explain_missing_junction(scene.interaction)}")
    gap = float(to_gap(surface, response, start)[0])
    if not gap > float(junction.forms_gap_nm):
        raise ValueError(
            f"the start is inside the sample: the gap is {gap:.6g} nm, but must be above "
            f"{float(junction.forms_gap_nm):.6g} nm, where the junction forms; raise `position_nm`"
        )


@partial(jax.jit, static_argnames=("rows", "setting", "rounds", "reverse"))
def _contact(  # noqa: PLR0913
    scene: Scene,
    surface: Platform | Surface,
    response: Surface | None,
    start: State,
    until: Float[Array, ""],
    *,
    rows: int,
    setting: DrivenSetting,
    rounds: int,
    reverse: bool,
) -> Simulation:
    driven = driven_by(scene.interaction, scene.cantilever, surface)
    gap, rate = to_gap(surface, response, start)
    begun = begin(driven, start.time_us, gap, rate, rows)
    end = follow(driven, begun, until, setting, rounds=rounds, reverse=reverse)
    state, phase = end.tip.state, end.tip.phase
    table = ContactRow(*jnp.moveaxis(end.rows, -1, 0))
    return Simulation(
        start=start,
        contacts=_contacts(table, scene, surface, response, driven),
        count=jnp.minimum(end.contacts, rows),
        final=to_lab(surface, response, state.time_us, driven.gap(state.x, phase), state.gap_rate),
        phase=phase,
        held=end.outcome == MotionOutcome.HELD,
        outcome=end.outcome,
    )


def _contacts(
    row: ContactRow, scene: Scene, surface: Platform | Surface, response: Surface | None, driven: Driven
) -> Contacts:
    """Return the rows as contacts in the lab."""
    junction = driven.junction
    has_left, touched = row.kind == ContactKind.IMPACT, row.junctions > 0.0
    bridge = jnp.where(has_left, junction.bridge_hysteresis_aj, 0.0)
    solid = row.junctions * junction.junction_hysteresis_aj
    depth = junction.shift_nm - jnp.where(touched, row.deepest_gap_nm, 0.0)
    force = jnp.where(touched, scene.interaction.solid.force(depth), 0.0)
    detail = ContactDetail(
        junctions=row.junctions.astype(jnp.int32),
        junction_forms_us=row.junction_forms_us,
        junction_breaks_us=row.junction_breaks_us,
        time_in_junction_us=row.time_in_junction_us,
        deepest_gap_nm=row.deepest_gap_nm,
        peak_force_nn=jnp.maximum(force, 0.0),
        bridge_hysteresis_aj=bridge,
        junction_hysteresis_aj=solid,
        viscous_loss_aj=row.viscous_loss_aj,
    )
    arrival = State(row.arrival_us, row.arrival_gap_nm, row.arrival_rate)
    departure = State(row.departure_us, row.departure_gap_nm, row.departure_rate)
    lost = bridge + solid + row.viscous_loss_aj
    return contacts_in_lab(surface, response, row.kind, arrival, departure, lost, detail)
