"""The impact map: from just after one impact to just after the next, and its iteration.

Many tips at once, at full speed: blocks of lanes that fit the processor's cache, one after the other.

A plain `vmap` over 100,000 tips streams every intermediate result through main memory, and all tips wait for the one
that needs most steps. Blocks of some hundred lanes do neither; `afm-jax bench` shows the difference.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from afm_jax.apparatus.scene import Scene, SceneLike, as_scene
from afm_jax.apparatus.surface import Surface, seen_freely
from afm_jax.checks import check_count, check_parameter, check_scalar, checked, require_float64
from afm_jax.impact.first_impact import DEFAULT_MAX_STEPS, DEFAULT_ROOT_TOLERANCE_US, Flight, first_impact
from afm_jax.impact.lasting_impact import crawls, delay_before, speeds_of_impact
from afm_jax.impact.law import Law, axes_of_one, impact_law_of
from afm_jax.outcomes import Outcome
from afm_jax.results import Result, public_result
from afm_jax.solve.lanes import map_in_blocks

NEAR_GRAZING = 1e-3
"""Approach speed over beta omega below which an impact counts as near grazing: its derivatives lose their meaning."""


@public_result(outcome=Outcome)
class NextImpact(Result, eqx.Module):
    """The impact that follows a start, one tip and one time; batches by `vmap`.

    Attributes:
        time_us: when the next flight starts: the impact, plus the collision delay if the law has one, corrected for
            what happens while the impact lasts. Infinite where there is no further impact within the search.
        arrival_time_us: when the free flight reaches gap 0; equal to `time_us` without a delay.
        velocity_before_nm_per_us: tip velocity in the lab just before; NaN where there is no impact (see `outcome`).
        velocity_after_nm_per_us: tip velocity in the lab just after; the platform's where the tip is captured, NaN
            where there is no impact.
        outcome: an `Outcome` as an integer.
        near_grazing: the approach is slower than 1e-3 beta omega.
    """

    time_us: Float[Array, "..."]
    arrival_time_us: Float[Array, "..."]
    velocity_before_nm_per_us: Float[Array, "..."]
    velocity_after_nm_per_us: Float[Array, "..."]
    outcome: Int[Array, "..."]
    near_grazing: Bool[Array, "..."]

    def _known_rows(self) -> np.ndarray:
        """Return which rows were reached at all."""
        return np.asarray(self.outcome) != Outcome.NOT_REACHED

    def _unknown(self) -> dict[str, np.ndarray]:
        """Return by column which rows have no value there: without an impact there is none of its numbers."""
        none = ~np.isin(np.asarray(self.outcome), (Outcome.IMPACT, Outcome.CAPTURED))
        names = ("time_us", "arrival_time_us", "velocity_before_nm_per_us", "velocity_after_nm_per_us")
        return dict.fromkeys(names, none)


@checked
def next_impact(
    scene: SceneLike,
    time_us: ArrayLike,
    velocity_nm_per_us: ArrayLike,
    *,
    max_steps: int = DEFAULT_MAX_STEPS,
    root_tolerance_us: ArrayLike = DEFAULT_ROOT_TOLERANCE_US,
) -> NextImpact:
    """Return the next impact of a tip that has just left the platform (eqs. 2-4 and 6; the Poincare map).

    Args:
        scene: a scene whose interaction is an `ImpactLaw`, however driven.
        time_us: when the flight starts, scalar; the tip is then at the platform's position.
        velocity_nm_per_us: tip velocity in the lab just after the impact, scalar, above the platform's velocity.
        max_steps: steps of the search for the impact before it gives up.
        root_tolerance_us: remaining error of the impact time at which the search stops.

    Returns:
        The impact, differentiable in everything: forward, reverse, to any order (implicit function theorem).

    Raises:
        RuntimeError: if JAX is not set to 64-bit floats, or was not when the scene was built.
        TypeError: if the scene's interaction is not an impact law.
        ValueError: if an undamped cantilever is driven at its free frequency.

    >>> import jax
    >>> from afm_jax import Cantilever, ImpactLaw, Platform, Scene
    >>> with jax.enable_x64(True):
    ...     scene = Scene(Cantilever(90.0), Platform(amplitude_nm=2.0, frequency_khz=180.0), ImpactLaw(r=0.5))
    ...     print(round(float(next_impact(scene, 4.0, 6.0).time_us), 6))
    9.646489
    """
    scene = as_scene(scene)
    require_float64(scene)
    impact_law_of(scene)
    _check_search(time_us, velocity_nm_per_us, max_steps, root_tolerance_us)
    seen, response = seen_freely(scene)
    start = _start_of(scene, response, time_us, velocity_nm_per_us)
    tolerance = jnp.asarray(root_tolerance_us, scene.platform.frequency_khz.dtype)
    return _in_lab(_next_impact(seen, start, tolerance, max_steps=max_steps), response)


@checked
def iterate_map(
    scene: SceneLike,
    time_us: ArrayLike,
    velocity_nm_per_us: ArrayLike,
    impacts: int,
    *,
    max_steps: int = DEFAULT_MAX_STEPS,
    root_tolerance_us: ArrayLike = DEFAULT_ROOT_TOLERANCE_US,
) -> NextImpact:
    """Return a sequence of impacts: `next_impact` iterated.

    Args:
        scene: a scene whose interaction is an `ImpactLaw`, however driven.
        time_us: when the first flight starts, scalar.
        velocity_nm_per_us: tip velocity in the lab at that time, scalar.
        impacts: how many impacts to follow; a plain integer, it shapes the result.
        max_steps: steps of the search for one impact before it gives up.
        root_tolerance_us: remaining error of an impact time at which a search stops.

    Returns:
        A `NextImpact` with a leading axis of length `impacts`. After an impact that is the last (captured, no further
        impact) the rows say `Outcome.NOT_REACHED`.

    Raises:
        RuntimeError: if JAX is not set to 64-bit floats, or was not when the scene was built.
        TypeError: if the scene's interaction is not an impact law.
        ValueError: if `impacts` is not positive, or an undamped cantilever is driven at its free frequency.
    """
    scene = as_scene(scene)
    require_float64(scene)
    impact_law_of(scene)
    if impacts < 1:
        raise ValueError(f"`impacts` must be a positive integer, but is {impacts}")
    _check_search(time_us, velocity_nm_per_us, max_steps, root_tolerance_us)
    seen, response = seen_freely(scene)
    start = _start_of(scene, response, time_us, velocity_nm_per_us)
    tolerance = jnp.asarray(root_tolerance_us, scene.platform.frequency_khz.dtype)
    return _in_lab(_iterate_map(seen, start, tolerance, impacts=impacts, max_steps=max_steps), response)


def _start_of(
    scene: Scene, response: Surface | None, time_us: ArrayLike, velocity_nm_per_us: ArrayLike
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return time and velocity of a start, the velocity without the steady response's."""
    dtype = scene.platform.frequency_khz.dtype
    time, velocity = jnp.asarray(time_us, dtype), jnp.asarray(velocity_nm_per_us, dtype)
    return time, velocity if response is None else velocity - response.velocity(time)


def _check_search(time_us: ArrayLike, velocity_nm_per_us: ArrayLike, max_steps: int, tolerance_us: ArrayLike) -> None:
    """Check what a search for impacts is given; a start that is no flight is an outcome.

    Raises:
        ValueError: if something is an array, or the search has no step or no tolerance.
    """
    for name, value in (("time_us", time_us), ("velocity_nm_per_us", velocity_nm_per_us)):
        check_scalar(name, value, "`iterate_batch` and `jax.vmap` take many")
    check_scalar("root_tolerance_us", tolerance_us)
    check_count("max_steps", max_steps)
    check_parameter("root_tolerance_us", tolerance_us, "above 0")


def _in_lab(found: NextImpact, response: Surface | None) -> NextImpact:
    """Return impacts with the velocities of the steady response added."""
    if response is None:
        return found

    def added(velocity, time):
        there = jnp.isfinite(time)
        return velocity + jnp.where(there, response.velocity(jnp.where(there, time, 0.0)), 0.0)

    before = added(found.velocity_before_nm_per_us, found.arrival_time_us)
    after = added(found.velocity_after_nm_per_us, found.time_us)
    return eqx.tree_at(
        lambda row: (row.velocity_before_nm_per_us, row.velocity_after_nm_per_us), found, (before, after)
    )


@partial(jax.jit, static_argnames=("max_steps",))
def _next_impact(scene: Scene, start, tolerance: Float[Array, ""], *, max_steps: int) -> NextImpact:
    flight = Flight(scene.cantilever, scene.platform, *start)
    return impact_after(scene, flight, tolerance, max_steps=max_steps)


def impact_after(
    scene: Scene,
    flight: Flight,
    tolerance: Float[Array, ""],
    *,
    max_steps: int,
    latest_us: Float[Array, ""] | None = None,
) -> NextImpact:
    """Return the impact that ends a flight: `next_impact` without its checks, from any start and over any surface.

    Args:
        scene: the interaction is an `ImpactLaw`, the platform the surface that the flight is over.
        flight: the flight; where it begins at gap 0 the tip has just left.
        tolerance: remaining error of the impact time at which the search stops, in us.
        max_steps: steps of the search for the impact before it gives up.
        latest_us: the search ends at this time (us) after the flight's start; None: never.
    """
    law = impact_law_of(scene)
    impact = first_impact(
        flight,
        skip_us=_overlap(law, flight),
        latest_us=latest_us,
        max_steps=max_steps,
        root_tolerance_us=tolerance,
    )
    arrival = flight.start_us + impact.duration_us
    _, before = scene.cantilever.propagator(impact.duration_us)(flight.position, flight.velocity)
    hit = impact.outcome == Outcome.IMPACT
    approach = jnp.where(hit, scene.platform.velocity(arrival) - before, 1.0)
    impact_speeds = speeds_of_impact(law, approach, arrival, scene.cantilever, scene.platform)
    captured = hit & law.captures(approach)
    if law.delay is not None:
        free = law.at_approach(approach)
        captured = captured | (hit & crawls(law, free, scene.cantilever))
        impact_speeds = impact_speeds._replace(
            rebound=jnp.where(captured, 0.0, impact_speeds.rebound), delay=jnp.where(captured, 0.0, impact_speeds.delay)
        )
    leaving = arrival + impact_speeds.delay if law.delay is not None else arrival
    after = scene.platform.velocity(leaving) + impact_speeds.rebound
    return NextImpact(
        time_us=jnp.where(hit, leaving, jnp.inf),
        arrival_time_us=jnp.where(hit, arrival, jnp.inf),
        velocity_before_nm_per_us=jnp.where(hit, before, jnp.nan),
        velocity_after_nm_per_us=jnp.where(hit, after, jnp.nan),
        outcome=jnp.where(captured, Outcome.CAPTURED, impact.outcome),
        near_grazing=hit & (approach < NEAR_GRAZING * scene.platform.top_speed_nm_per_us),
    )


def _overlap(law: Law, flight: Flight) -> Float[Array, ""] | None:
    """Return how long a flight that a negative delay let begin early overlaps the last one, in us after its start."""
    if not law.delayed:
        return None
    rebound = flight.velocity - flight.platform.velocity(flight.start_us)
    delay = delay_before(law, rebound, flight.start_us, flight.cantilever, flight.platform)
    overlap = jnp.maximum(-delay, 0.0)
    # a flight that begins above the surface follows no impact
    return overlap if flight.start_gap is None else jnp.where(flight.start_gap > 0.0, 0.0, overlap)


@partial(jax.jit, static_argnames=("impacts", "max_steps"))
def _iterate_map(scene: Scene, start, tolerance: Float[Array, ""], *, impacts: int, max_steps: int) -> NextImpact:
    def one(state, _):
        flying, time, velocity = state
        # A finished tip does not leave the platform, so that its search ends at once; its rows are marked below.
        resting = scene.platform.velocity(time) - 1.0
        impact = _next_impact(scene, (time, jnp.where(flying, velocity, resting)), tolerance, max_steps=max_steps)
        outcome = jnp.where(flying, impact.outcome, Outcome.NOT_REACHED)
        impact = eqx.tree_at(lambda row: row.outcome, impact, outcome)
        flying = outcome == Outcome.IMPACT
        time = jnp.where(flying, impact.time_us, time)
        velocity = jnp.where(flying, impact.velocity_after_nm_per_us, velocity)
        return (flying, time, velocity), impact

    _, rows = lax.scan(one, (jnp.array(True), *start), length=impacts)  # noqa: FBT003
    ended = rows.outcome == Outcome.NOT_REACHED
    return NextImpact(
        time_us=jnp.where(ended, jnp.inf, rows.time_us),
        arrival_time_us=jnp.where(ended, jnp.inf, rows.arrival_time_us),
        velocity_before_nm_per_us=jnp.where(ended, jnp.nan, rows.velocity_before_nm_per_us),
        velocity_after_nm_per_us=jnp.where(ended, jnp.nan, rows.velocity_after_nm_per_us),
        outcome=rows.outcome,
        near_grazing=rows.near_grazing & ~ended,
    )


DEFAULT_BLOCK = 1000
"""Lanes that run together; 300 to 2000 differ little on processors with vector units and 0.5 to 2 MB of cache."""


@checked
def iterate_batch(
    scene: SceneLike,
    time_us: ArrayLike,
    velocity_nm_per_us: ArrayLike,
    impacts: int,
    *,
    block: int = DEFAULT_BLOCK,
    max_steps: int = DEFAULT_MAX_STEPS,
    root_tolerance_us: ArrayLike = DEFAULT_ROOT_TOLERANCE_US,
) -> NextImpact:
    """Return the impacts of many tips: `iterate_map` for every row of a batch of any size.

    Args:
        scene: a scene whose interaction is an `ImpactLaw`; each parameter a scalar for all rows, or of shape (batch,).
        time_us: when the first flights start, shape (batch,).
        velocity_nm_per_us: tip velocities in the lab then, shape (batch,).
        impacts: how many impacts to follow.
        block: how many tips run together; does not change a result.
        max_steps: steps of the search for one impact before it gives up.
        root_tolerance_us: remaining error of an impact time at which a search stops.

    Returns:
        A `NextImpact` of shape (batch, impacts), differentiable in scene and starts.

    Raises:
        RuntimeError: if JAX is not set to 64-bit floats, or was not when the scene was built.
        TypeError: if the scene's interaction is not an impact law.
        ValueError: if shapes do not fit together, or `impacts` or `block` is not positive.
    """
    scene = as_scene(scene)
    require_float64(scene)
    impact_law_of(scene)
    dtype = scene.platform.frequency_khz.dtype
    times, velocities = jnp.asarray(time_us, dtype), jnp.asarray(velocity_nm_per_us, dtype)
    _check(scene, times, velocities, impacts, block)
    tolerance = jnp.asarray(root_tolerance_us, dtype)
    return _iterate_batch(scene, (times, velocities), tolerance, impacts=impacts, block=block, max_steps=max_steps)


def _check(scene: Scene, times: Array, velocities: Array, impacts: int, block: int) -> None:
    if times.ndim != 1 or times.shape != velocities.shape or times.size == 0:
        raise ValueError(
            "`time_us` and `velocity_nm_per_us` must have one shape (batch,) with at least one row, "
            f"but have {times.shape} and {velocities.shape}"
        )
    for leaf, own in zip(jax.tree.leaves(scene), jax.tree.leaves(axes_of_one(scene)), strict=True):
        if leaf.ndim > own and leaf.shape[: leaf.ndim - own] != times.shape:
            raise ValueError(
                f"a parameter of the scene has shape {leaf.shape}; it must be a number or match {times.shape}"
            )
    for name, value in (("impacts", impacts), ("block", block)):
        if value < 1:
            raise ValueError(f"`{name}` must be a positive integer, but is {value}")


@partial(jax.jit, static_argnames=("impacts", "block", "max_steps"))
def _iterate_batch(
    scene: Scene,
    starts: tuple[Float[Array, " batch"], Float[Array, " batch"]],
    tolerance: Float[Array, ""],
    *,
    impacts: int,
    block: int,
    max_steps: int,
) -> NextImpact:
    own, shared = eqx.partition(scene, jax.tree.map(lambda leaf, axes: leaf.ndim > axes, scene, axes_of_one(scene)))

    def one_tip(row):
        own_parameters, (time, velocity) = row
        return iterate_map(
            eqx.combine(own_parameters, shared),
            time,
            velocity,
            impacts,
            max_steps=max_steps,
            root_tolerance_us=tolerance,
        )

    return map_in_blocks(jax.vmap(one_tip), (own, starts), block=block)
