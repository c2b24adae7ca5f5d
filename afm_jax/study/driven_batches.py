"""Batches of driven tips for measurements: starts that keep bouncing, and single contacts taken out of their motion."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from afm_jax.apparatus.scene import Scene
from afm_jax.contact.driven import Place, driven_by
from afm_jax.contact.settings import DrivenSetting, QuickSetting
from afm_jax.motion.contact_crossing import cross
from afm_jax.motion.record import ContactKind, MotionOutcome, Simulation, State
from afm_jax.motion.simulate import _contact

ROUNDS = 200_000
"""Most rounds; a batch ends when its last tip does."""
PHASE_DEG, HEIGHT_NM, SPEEDS_NM_PER_US = 270.0, 5.0, (38.0, 120.0)
"""The starts: a drive phase, a height above the platform, and the range of upward velocities in the lab."""
_BEFORE_US = 1e-4
"""How long before its arrival a single contact is started: the arrival itself is then part of the motion."""
_BEYOND_US = 0.1
"""How long after its departure it is stopped: less than a tip needs to come back, more than any error."""
_PASSES = 40
_FINE = QuickSetting(20, 16, 18, 18, 1e-4, 12, 8, 1e-2)
"""Tells contacts that go straight through from those that turn in the bridge."""


class SingleContacts(NamedTuple):
    """Contacts each on its own, arrays of shape (tips,)."""

    starts: State
    """Just before the arrival."""
    until_us: Array
    """A little after the departure."""
    turning: np.ndarray
    """The tip turns in the bridge, or forms the junction more than once or never."""


def batch_run(setting: DrivenSetting, rows: int) -> Callable[[Scene, State, Array], Simulation]:
    """Return a function that follows tips of one scene, driven by its platform alone, each to a time of its own.

    Args:
        setting: how contacts are resolved.
        rows: most contacts of a tip.
    """

    def run(scene: Scene, starts: State, until_us: Array) -> Simulation:
        def one(start: State, until: Array) -> Simulation:
            return _contact(
                scene, scene.platform, None, start, until, rows=rows, setting=setting, rounds=ROUNDS, reverse=False
            )

        return jax.vmap(one)(starts, until_us)

    return run


def spread_starts(scene: Scene, count: int, *, shift: float = 0.0) -> State:
    """Return starts with velocities spread over their range, shape (count,).

    Args:
        scene: the scene.
        count: how many.
        shift: moves the velocities by this share of their distance, for other starts of the same kind.
    """
    time = PHASE_DEG / 360.0 * scene.platform.period_us
    low, high = SPEEDS_NM_PER_US
    velocity = jnp.asarray(low + (high - low) * ((np.arange(count) + 0.5 + shift) / count % 1.0))
    height = scene.platform.position(time) + HEIGHT_NM
    return State(jnp.full(count, time), jnp.full(count, height), velocity)


def bouncing_starts(scene: Scene, run: Callable[..., Any], count: int, duration_us: float) -> tuple[State, float]:
    """Return starts of tips that are not held at the end of a duration, and the share of held ones among those tried.

    Args:
        scene: the scene.
        run: a compiled `batch_run` for `count` tips; its `outcome` is all that is looked at.
        count: how many starts.
        duration_us: how long they must bounce.

    Raises:
        ValueError: if hardly any tip keeps bouncing, or one could not be followed.
    """
    kept, tried, held = [np.zeros((3, 0))], 0, 0
    for number in range(_PASSES):
        starts = spread_starts(scene, count, shift=number * 0.6180339887)
        found = run(scene, starts, starts.time_us + duration_us)
        outcome = np.asarray(found.outcome)
        free = outcome == MotionOutcome.FINISHED
        lost = ~free & (outcome != MotionOutcome.HELD)
        if lost.any():
            reason = MotionOutcome(int(outcome[lost][0])).sentence
            raise ValueError(f"{int(lost.sum())} of {count} tips could not be followed: {reason}")
        kept.append(np.stack([np.asarray(part) for part in starts])[:, free])
        tried, held = tried + count, held + int((~free).sum())
        if sum(part.shape[1] for part in kept) >= count:
            chosen = np.concatenate(kept, axis=1)[:, :count]
            return State(*(jnp.asarray(part) for part in chosen)), held / tried
    raise ValueError(f"of {tried} tips only {tried - held} keep bouncing for {duration_us:.6g} us: take fewer periods")


def single_contacts(scene: Scene, found: Simulation, count: int) -> SingleContacts:
    """Return contacts of a batch, drawn from all that have ended, each to be followed on its own.

    Args:
        scene: the scene, driven by its platform alone.
        found: a batch that was followed.
        count: how many contacts.

    Raises:
        ValueError: if the batch has no finished contact.
    """
    contacts = found.contacts
    tips, rows = np.nonzero(np.asarray(contacts.kind) == ContactKind.IMPACT)
    if not tips.size:
        raise ValueError("the batch has no finished contact: follow it longer")
    # drawn at random: even steps through the list would fall on the same contact of every tip
    chosen = np.sort(np.random.default_rng(1).choice(tips.size, count, replace=tips.size < count))

    def column(values: Any) -> Array:
        return jnp.asarray(np.asarray(values)[tips[chosen], rows[chosen]])

    time = column(contacts.arrival_time_us)
    back = scene.cantilever.propagator(-_BEFORE_US)
    starts = back(column(contacts.arrival_position_nm), column(contacts.arrival_velocity_nm_per_us))
    assert contacts.detail is not None  # resolved contacts have details  # noqa: S101
    turning = np.asarray(column(contacts.detail.junctions)) != 1
    straight = _goes_straight(scene, time, column(contacts.approach_speed_nm_per_us))
    until = column(contacts.departure_time_us) + _BEYOND_US
    return SingleContacts(State(time - _BEFORE_US, *starts), until, turning | ~straight)


def _goes_straight(scene: Scene, time: Array, approach_speed: Array, setting: QuickSetting = _FINE) -> np.ndarray:
    driven = driven_by(scene.interaction, scene.cantilever, scene.platform)
    place = Place(jnp.full_like(time, driven.forms_nm), -approach_speed, time, jnp.zeros_like(time))
    return np.asarray(jax.jit(cross, static_argnums=2)(driven, place, setting).holds)
