"""Tips of contact scenes from departure to departure, many at once: the same as the impact map, simulated.

A tip departs where the bridge breaks, at one gap always, so that its next contact depends on time and velocity alone:
a map of two variables like that of impacts. Its Jacobian is the forward derivative of the simulation.
"""

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from afm_jax.apparatus.scene import Scene
from afm_jax.contact.junction import Phase
from afm_jax.dynamics.iteration import Record, Tips
from afm_jax.motion.record import ContactKind, Contacts, Simulation, State
from afm_jax.motion.settle import HELD_PERIODS
from afm_jax.motion.simulate import simulate
from afm_jax.outcomes import Outcome

_ROWS = 40
"""Contacts of a piece."""
_PERIODS_EACH = 6.0
"""Slower ones of drive and free period that are allowed for each of them."""
_AWAY = 30.0
"""The same: without a contact for so long the tip has left the sample."""
_BEYOND = 1e-3
"""Free periods after a departure at which its contact is surely over, and the next not begun."""


def follow_contacts(scenes: Scene, tips: Tips, *, skip: int, record: int, accuracy: float) -> tuple[Tips, Record]:
    """Return tips some contacts later, and the last contacts.

    Args:
        scenes: a batch of scenes with a contact.
        tips: at a departure each, or anywhere free above the sample.
        skip: contacts before those that are recorded.
        record: contacts that are recorded.
        accuracy: of `simulate`.
    """
    pieces = []
    kept = -(-record // _ROWS)
    tips = jax.tree.map(np.asarray, tips)
    for _ in range(-(-skip // _ROWS) + kept):
        tips, rows = _piece(scenes, tips, accuracy)
        pieces = [*pieces, rows][-kept:] if kept else []
        if np.all(tips.outcome != Outcome.IMPACT):
            break
    if not pieces:
        empty = np.full((len(tips.time_us), record), np.nan)
        return tips, Record(*[empty] * 6, *[np.zeros_like(empty, bool)] * 2)
    whole = [np.concatenate(parts, axis=1)[:, -record:] for parts in zip(*pieces, strict=True)]
    return tips, Record(*(np.pad(part, ((0, 0), (record - part.shape[1], 0)), mode="edge") for part in whole))


def _piece(scenes: Scene, tips: Tips, accuracy: float) -> tuple[Tips, Record]:
    """Return tips after the contacts of a piece, and these."""
    period, slower = np.asarray(scenes.platform.period_us), _slower_period_us(scenes)
    motion = jax.tree.map(np.asarray, _followed(scenes, tips, _PERIODS_EACH * _ROWS * slower, accuracy=accuracy))
    contacts = motion.contacts
    going = tips.outcome == Outcome.IMPACT
    left = (contacts.kind == ContactKind.IMPACT) & going[:, None]
    count = left.sum(axis=1)
    last = np.maximum(count - 1, 0)[:, None]
    departure = np.where(left, contacts.departure_time_us, np.nan)
    arrival = np.where(left, contacts.arrival_time_us, np.nan)
    full = count == _ROWS
    since = motion.final.time_us - np.where(count > 0, np.take_along_axis(departure, last, axis=1)[:, 0], tips.time_us)
    held = (motion.phase != Phase.DRY) & (since > HELD_PERIODS * slower)
    ended = np.where(held, Outcome.CAPTURED, np.where(since > _AWAY * slower, Outcome.NO_FURTHER_IMPACT, 3))
    outcome = np.where(full, Outcome.IMPACT, ended)
    goes_on = going & full
    whole, whole_arrival = np.floor(departure / period[:, None]), np.floor(arrival / period[:, None])
    velocity = np.where(left, contacts.departure_velocity_nm_per_us, np.nan)

    def of_last(rows: np.ndarray, old: np.ndarray) -> np.ndarray:
        return np.where(goes_on, np.take_along_axis(rows, last, axis=1)[:, 0], old)

    within = departure - whole * period[:, None]
    end = Tips(
        time_us=of_last(within, tips.time_us),
        periods=tips.periods + of_last(whole, np.zeros_like(tips.periods)),
        gap_nm=np.where(goes_on, np.asarray(scenes.interaction.bridge_breaks_nm), tips.gap_nm),
        velocity_nm_per_us=of_last(velocity, tips.velocity_nm_per_us),
        outcome=np.where(going, outcome, tips.outcome).astype(np.int32),
    )
    rows = Record(
        arrival_us=arrival - whole_arrival * period[:, None],
        approach_nm_per_us=np.where(left, contacts.approach_speed_nm_per_us, np.nan),
        departure_us=within,
        velocity_after_nm_per_us=velocity,
        arrival_periods=tips.periods[:, None] + whole_arrival,
        departure_periods=tips.periods[:, None] + whole,
        near_grazing=np.zeros_like(left),
        rested=np.zeros_like(left),
    )
    return end, rows


@eqx.filter_jit
def _followed(scenes: Scene, tips: Tips, duration_us: Float[Any, " lanes"], *, accuracy: float) -> Simulation:
    def one(scene: Scene, tip: Tips, duration: Array) -> Simulation:
        position = scene.platform.position(tip.time_us) + tip.gap_nm
        # one whose motion has ended flies for next to no time
        duration = jnp.where(tip.outcome == Outcome.IMPACT, duration, 1e-9)
        start = State(tip.time_us, position, tip.velocity_nm_per_us)
        return simulate(scene, start, duration, max_contacts=_ROWS, accuracy=accuracy)

    return jax.vmap(one)(scenes, tips, duration_us)


def next_contact(
    scene: Scene, departure_us: Array, velocity_nm_per_us: Array, until_us: Array, accuracy: float
) -> Contacts:
    """Return the first contact after a departure, followed until a time; one scene, a velocity in the lab."""
    height = scene.platform.position(departure_us) + scene.interaction.bridge_breaks_nm
    start = State(departure_us, height, velocity_nm_per_us)
    rows = simulate(scene, start, until_us - departure_us, max_contacts=1, accuracy=accuracy).contacts
    return jax.tree.map(lambda part: part[0], rows._replace(detail=None))


@partial(jax.jit, static_argnames=("accuracy",))
def departure_jacobians(
    scenes: Scene,
    departure_us: Float[Array, " lanes"],
    velocity_nm_per_us: Float[Array, " lanes"],
    next_departure_us: Float[Array, " lanes"],
    *,
    accuracy: float,
) -> Float[Array, "lanes 2 2"]:
    """Return the derivatives of next departures, d(time, velocity) over d(time, velocity) of these.

    Args:
        scenes: a batch of scenes with a contact.
        departure_us: when the tips depart.
        velocity_nm_per_us: in the lab, then.
        next_departure_us: when their next contacts end.
        accuracy: of `simulate`.
    """

    def one(scene: Scene, time: Array, velocity: Array, later: Array) -> Array:
        until = later + _BEYOND / scene.cantilever.frequency_khz * 1e3

        def next_departure(state: Array) -> Array:
            contact = next_contact(scene, state[0], state[1], until, accuracy)
            return jnp.stack([contact.departure_time_us, contact.departure_velocity_nm_per_us])

        return jax.jacfwd(next_departure)(jnp.stack([time, velocity]))

    return jax.vmap(one)(scenes, departure_us, velocity_nm_per_us, next_departure_us)


def _slower_period_us(scenes: Scene) -> Float[np.ndarray, " lanes"]:
    free = 2.0 * np.pi / np.asarray(scenes.cantilever.angular_frequency)
    return np.maximum(np.asarray(scenes.platform.period_us), free)
