"""Verdicts on single-impact orbits against long iterations of the impact map, which know neither eq. 9 nor multipliers.

A stable orbit must draw a disturbed tip back, an unstable one must let it go, and where there is no stable orbit no
start may settle on one.
"""

from collections.abc import Callable
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from afm_jax.apparatus.scene import Scene
from afm_jax.dynamics.charts import OrbitVerdicts
from afm_jax.impact.map import next_impact
from afm_jax.impact.orbits import single_impact_orbits
from afm_jax.outcomes import Outcome

STABILITY_MARGIN = 0.01
"""Orbits with | |T| - |1 + D| | below this are left out: they come back, or leave, too slowly."""
CLEARANCE_NM = 1e-3
"""Orbits that pass the platform closer than this on their way are left out: the disturbed tip might touch it."""
DISTURBANCE = 1e-6
"""Relative change of the velocity, and change of the phase in rad, with which an iteration starts."""
_CHATTER = 1e-6
"""Approach speed in units of beta omega below which a tip counts as at rest on the platform."""
_MAX_STEPS = 500
_SAMPLES = 512
_LAST = 32
_STARTS = 4


@dataclass(frozen=True)
class SpotChecks:
    """How many random points agreed; counts by verdict ("stable", "unstable", "none").

    ``excluded``: too close to a boundary for an iteration to tell. ``failures``: index of scene and what was wrong.
    """

    checked: dict[str, int]
    excluded: dict[str, int]
    failures: list[dict[str, object]]

    @property
    def excluded_share(self) -> float:
        """Share of the drawn points that were too close to a boundary."""
        excluded = sum(self.excluded.values())
        return excluded / max(1, excluded + sum(self.checked.values()))


def spot_check(
    scenes_at: Callable[[Int[np.ndarray, " points"]], Scene],
    verdicts: OrbitVerdicts,
    *,
    seed: int,
    points: int,
    impacts: int = 3000,
) -> SpotChecks:
    """Check verdicts at random points by iterating the map.

    Args:
        scenes_at: the scenes with these numbers, as a batch.
        verdicts: the verdicts on all scenes, orders from 1 on.
        seed: of the random choice.
        points: how many points of each verdict are drawn (fewer if there are fewer).
        impacts: how long an iteration is.
    """
    generator = np.random.default_rng(seed)
    stable, admissible = verdicts.any_stable(), verdicts.any_admissible()
    checked, excluded, failures = {}, {}, []
    for verdict, where, orbits in (
        ("stable", stable, verdicts.stable),
        ("unstable", admissible & ~stable, verdicts.admissible),
    ):
        chosen = _draw(generator, where, points)
        clear, agrees = _orbit_checks(scenes_at, chosen, orbits, wanted=verdict == "stable", impacts=impacts)
        checked[verdict], excluded[verdict] = int(clear.sum()), int((~clear).sum())
        problem = "a disturbed orbit does not come back" if verdict == "stable" else "a disturbed orbit does not leave"
        failures += [{"scene": int(scene), "problem": problem} for scene in chosen[clear & ~agrees]]
    chosen = _draw(generator, ~stable, points)
    settled = _settled_order(scenes_at, chosen, generator, impacts=impacts)
    # Orders above those that were looked for are not what the verdict is about.
    wrong = (settled >= 1) & (settled <= len(verdicts.stable))
    checked["none"], excluded["none"] = len(chosen), 0
    for scene, order in zip(chosen[wrong], settled[wrong], strict=True):
        failures.append({"scene": int(scene), "problem": f"the motion settles on a (1,{int(order)}) orbit"})
    return SpotChecks(checked, excluded, failures)


def _draw(generator: np.random.Generator, where: np.ndarray, points: int) -> Int[np.ndarray, " points"]:
    numbers = np.flatnonzero(where)
    return generator.choice(numbers, size=min(points, len(numbers)), replace=False)


def _orbit_checks(scenes_at, chosen, orbits, *, wanted: bool, impacts: int) -> tuple[np.ndarray, np.ndarray]:
    """Return which points are clear of boundaries, and at which the disturbed tip does what the verdict says."""
    if not len(chosen):
        return np.zeros(0, bool), np.zeros(0, bool)
    scenes = scenes_at(chosen)
    orders = jnp.asarray(orbits[:, chosen].argmax(axis=0) + 1.0)
    phase, velocity, margin, clearance = _orbit_at(scenes, orders, jnp.asarray(wanted))
    last, furthest = _disturbed(scenes, phase, velocity, impacts)
    clear = np.asarray((jnp.abs(margin) > STABILITY_MARGIN) & (clearance > CLEARANCE_NM))
    # Back: a thousandth of the disturbance is left. Gone: thirty times as far away, or not flying any more.
    return clear, np.asarray(last < 1e-3 * DISTURBANCE if wanted else furthest > 30.0 * DISTURBANCE)


@eqx.filter_jit
@eqx.filter_vmap(in_axes=(eqx.if_array(0), 0, None))
def _orbit_at(scene: Scene, order: Float[Array, ""], wanted: Array) -> tuple[Array, Array, Array, Array]:
    """Return phase, velocity, 1 + D - |T| and smallest gap in flight (nm) of the first orbit with a verdict."""
    orbits = single_impact_orbits(scene, order)
    slot = jnp.argmax(orbits.exists & orbits.admissible & (orbits.stable == wanted))
    phase, velocity = orbits.phase_rad[slot], orbits.velocity_after_nm_per_us[slot]
    margin = 1.0 + orbits.determinant[slot] - jnp.abs(orbits.trace[slot])
    start = phase / scene.platform.angular_frequency
    flown = jnp.linspace(0.0, 1.0, _SAMPLES) * order * scene.platform.period_us
    height, _ = jax.vmap(scene.cantilever.propagator)(flown)(scene.platform.position(start), velocity)
    gap = height - scene.platform.position(start + flown)
    minimum = (gap[1:-1] < gap[:-2]) & (gap[1:-1] < gap[2:])
    return phase, velocity, margin, jnp.min(jnp.where(minimum, gap[1:-1], jnp.inf))


@eqx.filter_jit
@eqx.filter_vmap(in_axes=(eqx.if_array(0), 0, 0, None))
def _disturbed(scene: Scene, phase: Array, velocity: Array, impacts: int) -> tuple[Array, Array]:
    """Return distances from an orbit after a small disturbance: the largest of the last impacts, and of all."""
    omega = scene.platform.angular_frequency
    time, speed = _iterate(scene, (phase + DISTURBANCE) / omega, velocity * (1.0 + DISTURBANCE), impacts)
    turn = omega * time - phase
    distance = jnp.hypot(jnp.arctan2(jnp.sin(turn), jnp.cos(turn)), speed / velocity - 1.0)
    distance = jnp.where(jnp.isfinite(distance), distance, jnp.inf)
    return jnp.max(distance[-_LAST:]), jnp.max(distance)


def _settled_order(scenes_at, chosen, generator: np.random.Generator, *, impacts: int) -> Int[np.ndarray, " points"]:
    """Return the order of the (1, N) orbit on which one of several random starts settles; 0 if none does."""
    if not len(chosen):
        return np.zeros(0, int)
    scenes = scenes_at(np.repeat(chosen, _STARTS))
    phase = generator.uniform(0.0, 2.0 * np.pi, len(chosen) * _STARTS)
    speed = 10.0 ** generator.uniform(-1.0, 0.5, len(chosen) * _STARTS)
    orders = _settled(scenes, jnp.asarray(phase), jnp.asarray(speed), impacts)
    return np.asarray(orders).astype(int).reshape(len(chosen), _STARTS).max(axis=1)


@eqx.filter_jit
@eqx.filter_vmap(in_axes=(eqx.if_array(0), 0, 0, None))
def _settled(scene: Scene, phase: Array, speed: Array, impacts: int) -> Array:
    """Return the order of the orbit on which a motion is at its end; `speed`: off the platform, over beta omega."""
    start = phase / scene.platform.angular_frequency
    velocity = scene.platform.velocity(start) + speed * scene.platform.top_speed_nm_per_us
    time, after = _iterate(scene, start, velocity, impacts)
    periods = jnp.diff(time[-_LAST - 1 :]) / scene.platform.period_us
    last = after[-_LAST:]
    order = jnp.round(periods[-1])
    # False where the motion has ended: NaN is near to nothing.
    same = jnp.all(jnp.abs(periods - order) < 1e-7)
    steady = jnp.max(last) - jnp.min(last) < 1e-7 * jnp.abs(last[-1])
    return jnp.where(same & steady, order, 0.0)


def _iterate(scene: Scene, time: Array, velocity: Array, impacts: int) -> tuple[Array, Array]:
    """Return time and velocity after every impact; NaN from where the tip is captured or comes to rest by chatter.

    `iterate_map` follows chatter down to the rounding of the gap, where every hop costs as much as a hundred flights.
    """

    def one(state: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        impact = next_impact(scene, *state, max_steps=_MAX_STEPS)
        approach = scene.platform.velocity(impact.arrival_time_us) - impact.velocity_before_nm_per_us
        flies = (impact.outcome == Outcome.IMPACT) & (approach > _CHATTER * scene.platform.top_speed_nm_per_us)
        state = jnp.where(flies, impact.time_us, jnp.nan), jnp.where(flies, impact.velocity_after_nm_per_us, jnp.nan)
        return state, state

    _, rows = lax.scan(one, (time, velocity), length=impacts)
    return rows
