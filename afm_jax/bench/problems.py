"""The scenes that speed and accuracy are measured on, and where their tips start.

Batches of driven tips start so that they keep bouncing; single contacts are taken out of their motion.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.contact.driven import ContactState, driven_by
from afm_jax.contact.settings import DrivenSetting, QuickSetting
from afm_jax.dynamics.starts import evenly_spread
from afm_jax.impact.law import MOST_KNOTS, ImpactLaw, TabulatedLaw
from afm_jax.impact.map import iterate_batch
from afm_jax.motion.contact_motion import cross, follow_contacts
from afm_jax.motion.record import ContactKind, MotionOutcome, Simulation, State
from afm_jax.outcomes import Outcome
from afm_jax.scenefile.presets import FREE_FREQUENCY_KHZ, drive_frequency_khz, figure2_scene


class Starts(NamedTuple):
    """Where tips start: ``time_us`` and ``velocity_nm_per_us``, both of shape (batch,)."""

    time_us: Float[Array, " batch"]
    velocity_nm_per_us: Float[Array, " batch"]


class BenchmarkScene(NamedTuple):
    """A scene to measure, and whether a tip keeps its digits there.

    ``chaotic``: nearby tips part, so that errors can be told impact by impact only.
    """

    name: str
    scene: Scene
    chaotic: bool


def regular_scene() -> BenchmarkScene:
    """Return the scene of the stated aims: n = 1, beta = 2 nm, sigma = -1 nm, r = 0.5, undamped."""
    return BenchmarkScene("regular", figure2_scene(1.0, 2.0), chaotic=False)


def tabulated_scene() -> BenchmarkScene:
    """Return the regular scene with its law as a table of 24 speeds."""
    regular = regular_scene()
    speeds = np.geomspace(0.5, 100.0, MOST_KNOTS)
    law = TabulatedLaw(speeds, regular.scene.interaction.rebound_speed(speeds))
    return BenchmarkScene("regular", Scene(regular.scene.cantilever, regular.scene.platform, law), chaotic=False)


def chaotic_scene() -> BenchmarkScene:
    """Return a scene between the tongues of orders 1 and 2: n = 1.5, r = 0.8, otherwise the regular one."""
    platform = Platform(2.0, drive_frequency_khz(1.5), -1.0)
    return BenchmarkScene("chaotic", Scene(Cantilever(FREE_FREQUENCY_KHZ), platform, ImpactLaw(0.8)), chaotic=True)


def grazing_scene() -> BenchmarkScene:
    """Return a scene with slow impacts and chatter, a platform above the rest position: n = 0.722, sigma = 1 nm."""
    platform = Platform(2.0, drive_frequency_khz(0.722), 1.0)
    return BenchmarkScene("grazing", Scene(Cantilever(FREE_FREQUENCY_KHZ), platform, ImpactLaw(0.8)), chaotic=True)


def high_order_scene() -> BenchmarkScene:
    """Return a scene with one impact in five drive periods: n = 5.02, beta = 4 nm, Q = 40, r = 0.9."""
    platform = Platform(4.0, drive_frequency_khz(5.02), 0.0)
    return BenchmarkScene(
        "order 5", Scene(Cantilever(FREE_FREQUENCY_KHZ, 40.0), platform, ImpactLaw(0.9)), chaotic=False
    )


_SETTLING = 200
"""Impacts after which a motion counts as settled."""
_SPREAD = 1e-2
"""Share of a drive period, and relative part of the rebound speed, by which starts on a regular attractor are scattered
around it."""


def settled_starts(scene: Scene, batch: int) -> Starts:
    """Return starts near where the motion settles, the first of them the same for every batch size.

    Args:
        scene: the scene.
        batch: how many.

    Raises:
        ValueError: if tips do not stay in motion in this scene.
    """
    lanes = 64
    scattered = scattered_starts(scene, lanes)
    rows = iterate_batch(scene, scattered.time_us, scattered.velocity_nm_per_us, _SETTLING)
    flying = np.flatnonzero(np.asarray(rows.outcome[:, -1]) == Outcome.IMPACT)
    if flying.size == 0:
        raise ValueError("no tip stays in motion in this scene; speeds cannot be measured")
    lane = jnp.asarray(flying[np.arange(batch) % flying.size])
    period = scene.platform.period_us
    time = jnp.mod(rows.time_us[lane, -1], period)
    rebound = rows.velocity_after_nm_per_us[lane, -1] - scene.platform.velocity(rows.time_us[lane, -1])
    first, second = evenly_spread(batch).T
    moved = time + _SPREAD * period * (first - 0.5)
    return Starts(moved, scene.platform.velocity(moved) + rebound * (1.0 + _SPREAD * (second - 0.5)))


def scattered_starts(scene: Scene, batch: int) -> Starts:
    """Return starts all over the drive period, rebound speeds from 0.5 to 4 times the platform's top speed."""
    first, second = evenly_spread(batch).T
    time = scene.platform.period_us * first
    return Starts(time, scene.platform.velocity(time) + (0.5 + 3.5 * second) * scene.platform.top_speed_nm_per_us)


def cast(scene: Scene, dtype: str) -> Scene:
    """Return a scene whose parameters have another precision, "float32" or "float64"."""
    return jax.tree.map(lambda leaf: leaf.astype(dtype), scene)


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
            world = (scene, scene.platform, None, start, until)
            return follow_contacts(*world, max_contacts=rows, setting=setting, max_rounds=ROUNDS)

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


def _goes_straight(scene: Scene, time: Array, approach_speed: Array) -> np.ndarray:
    driven = driven_by(scene.interaction, scene.cantilever, scene.platform)
    state = ContactState(jnp.full_like(time, driven.forms_nm), -approach_speed, time, jnp.zeros_like(time))
    return np.asarray(jax.jit(cross, static_argnums=2)(driven, state, _FINE).holds)
