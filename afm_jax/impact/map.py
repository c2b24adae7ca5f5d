"""The impact map of a law: from the departure of the tip after one impact to that after the next (eqs. 2-4 and 6).

Takes a scene, time in us and velocity in nm/us after an impact; gives those after the next, and an `Outcome`.

`next_impact` is the map of one tip, `iterate_map` a sequence of impacts, `iterate_batch` such sequences of many tips.
Below them, for any surface that the tip sees: `impact_after` ends one flight. Simulations of law scenes, the search for
orbits of many impacts and the sequences here all go from flight to flight by it.
"""

from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from afm_jax.apparatus.scene import Scene
from afm_jax.apparatus.surface import Surface, seen_freely
from afm_jax.checks import check_count, check_parameter, check_scalar, checked, require_float64
from afm_jax.impact.first_impact import DEFAULT_MAX_STEPS, DEFAULT_ROOT_TOLERANCE_US, FirstImpact, Flight, first_impact
from afm_jax.impact.lasting_impact import crawls, delay_before, speeds_of_impact
from afm_jax.impact.law import Law, axes_of_one, impact_law_of
from afm_jax.outcomes import Outcome
from afm_jax.results import Result, public_result
from afm_jax.solve.derivatives import recomputed
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


class Departure(NamedTuple):
    """The beginning of a free flight: time in us, gap in nm and lab velocity in nm/us.

    A gap of None is 0: the tip has just left the surface. Where base or force drive, the velocity is that of the free
    motion, without the steady response (`seen_freely`).
    """

    time_us: Float[Array, "..."]
    gap_nm: Float[Array, "..."] | None
    velocity_nm_per_us: Float[Array, "..."]


class Search(NamedTuple):
    """How far the impact that ends a flight is searched for."""

    max_steps: int
    """Steps before the search gives up with `Outcome.STEP_LIMIT`."""
    root_tolerance_us: ArrayLike = DEFAULT_ROOT_TOLERANCE_US
    """Remaining error of the impact time at which the search stops."""
    until_us: Float[Array, ""] | None = None
    """Time at which the search ends with `Outcome.NO_FURTHER_IMPACT`; None: never."""
    from_above: bool = False
    """Whether a flight may begin above the surface on its way down; if not, the tip leaves the surface."""


@checked
def next_impact(
    scene: Scene,
    time_us: ArrayLike,
    velocity_nm_per_us: ArrayLike,
    *,
    max_steps: int = DEFAULT_MAX_STEPS,
) -> NextImpact:
    """Return the next impact of a tip that has just left the platform (eqs. 2-4 and 6; the Poincare map).

    Args:
        scene: a scene with a law (`ImpactLaw`, `TabulatedLaw`), however driven.
        time_us: when the flight starts, scalar; the tip is then at the platform's position.
        velocity_nm_per_us: tip velocity in the lab just after the impact, scalar, above the platform's velocity.
        max_steps: steps of the search for the impact before it gives up.

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
    seen, response, start = _free_start(scene, time_us, velocity_nm_per_us, max_steps)
    return _in_lab(_next_impact(seen, start, max_steps=max_steps), response)


@checked
def iterate_map(
    scene: Scene,
    time_us: ArrayLike,
    velocity_nm_per_us: ArrayLike,
    impacts: int,
    *,
    max_steps: int = DEFAULT_MAX_STEPS,
    root_tolerance_us: ArrayLike = DEFAULT_ROOT_TOLERANCE_US,
) -> NextImpact:
    """Return a sequence of impacts: `next_impact` iterated.

    Args:
        scene: a scene with a law (`ImpactLaw`, `TabulatedLaw`), however driven.
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
    seen, response, start = _free_start(scene, time_us, velocity_nm_per_us, max_steps)
    check_scalar("root_tolerance_us", root_tolerance_us)
    check_parameter("root_tolerance_us", root_tolerance_us, "above 0")
    tolerance = jnp.asarray(root_tolerance_us, start.time_us.dtype)
    check_count("impacts", impacts)
    return _in_lab(follow_impacts(seen, start, tolerance, impacts=impacts, max_steps=max_steps), response)


def _free_start(
    scene: Scene, time_us: ArrayLike, velocity_nm_per_us: ArrayLike, max_steps: int
) -> tuple[Scene, Surface | None, Departure]:
    """Return scene, steady response to base and force, and the start without it, checked.

    A start that is no flight is an outcome.

    Raises:
        RuntimeError: if JAX is not set to 64-bit floats, or was not when the scene was built.
        TypeError: if the scene's interaction is not an impact law.
        ValueError: if something is an array, or the search has no step.
    """
    require_float64(scene)
    impact_law_of(scene)
    for name, value in (("time_us", time_us), ("velocity_nm_per_us", velocity_nm_per_us)):
        check_scalar(name, value, "`iterate_batch` and `jax.vmap` take many")
    check_count("max_steps", max_steps)
    seen, response = seen_freely(scene)
    dtype = scene.platform.frequency_khz.dtype
    time, velocity = jnp.asarray(time_us, dtype), jnp.asarray(velocity_nm_per_us, dtype)
    start = Departure(time, None, velocity if response is None else velocity - response.velocity(time))
    return seen, response, start


def _in_lab(impacts: NextImpact, response: Surface | None) -> NextImpact:
    """Return impacts with the velocities of the steady response added."""
    if response is None:
        return impacts

    def added(velocity, time):
        there = jnp.isfinite(time)
        return velocity + jnp.where(there, response.velocity(jnp.where(there, time, 0.0)), 0.0)

    before = added(impacts.velocity_before_nm_per_us, impacts.arrival_time_us)
    after = added(impacts.velocity_after_nm_per_us, impacts.time_us)
    return eqx.tree_at(
        lambda row: (row.velocity_before_nm_per_us, row.velocity_after_nm_per_us), impacts, (before, after)
    )


@partial(jax.jit, static_argnames=("max_steps",))
def _next_impact(scene: Scene, departure: Departure, *, max_steps: int) -> NextImpact:
    return recomputed(partial(impact_after, search=Search(max_steps)))(scene, departure)


def impact_after(
    scene: Scene, departure: Departure, search: Search, *, flies: Bool[Array, ""] | None = None
) -> NextImpact:
    """Return the impact that ends a flight: `next_impact` without its checks, from any start and over any surface.

    Args:
        scene: the interaction is a law, the platform the surface that the flight is over.
        departure: the flight's beginning.
        search: for the impact.
        flies: whether there is a flight; where there is none the search ends at once with `Outcome.INVALID_START`.
    """
    flight = flight_from(scene, departure, from_above=search.from_above, flies=flies)
    return impact_at_end(scene, flight, end_of_flight(scene, flight, search))


def flight_from(
    scene: Scene, departure: Departure, *, from_above: bool = False, flies: Bool[Array, ""] | None = None
) -> Flight:
    """Return the flight that begins with a departure; where there is none (`flies`), one that ends at once."""
    time, gap, velocity = departure
    if flies is not None:
        # a tip that sinks into the surface from the start is in no flight
        velocity = jnp.where(flies, velocity, scene.platform.velocity(time) - 1.0)
        gap = gap if gap is None else jnp.where(flies, gap, 0.0)
    level = jnp.zeros_like(time) if from_above else None
    return Flight(scene.cantilever, scene.platform, time, velocity, gap, level)


def end_of_flight(scene: Scene, flight: Flight, search: Search) -> FirstImpact:
    """Return when a flight ends; where a negative delay let it begin early, the search begins after the overlap."""
    return first_impact(
        flight,
        skip_us=_overlap(impact_law_of(scene), flight),
        latest_us=None if search.until_us is None else search.until_us - flight.start_us,
        max_steps=search.max_steps,
        root_tolerance_us=search.root_tolerance_us,
    )


def impact_at_end(scene: Scene, flight: Flight, first: FirstImpact) -> NextImpact:
    """Return the impact of a law (eqs. 2 and 4) with which a flight ends."""
    law, cantilever, surface = impact_law_of(scene), scene.cantilever, scene.platform
    arrival = flight.start_us + first.duration_us
    _, before = cantilever.propagator(first.duration_us)(flight.position, flight.velocity)
    hit = first.outcome == Outcome.IMPACT
    approach = jnp.where(hit, surface.velocity(arrival) - before, 1.0)
    speeds = speeds_of_impact(law, approach, arrival, cantilever, surface)
    captured = hit & law.captures(approach)
    if law.delay is not None:
        captured = captured | (hit & crawls(law, law.at_approach(approach), cantilever))
        speeds = speeds._replace(
            rebound=jnp.where(captured, 0.0, speeds.rebound), delay=jnp.where(captured, 0.0, speeds.delay)
        )
    leaving = arrival if law.delay is None else arrival + speeds.delay
    after = surface.velocity(leaving) + speeds.rebound
    return NextImpact(
        time_us=jnp.where(hit, leaving, jnp.inf),
        arrival_time_us=jnp.where(hit, arrival, jnp.inf),
        velocity_before_nm_per_us=jnp.where(hit, before, jnp.nan),
        velocity_after_nm_per_us=jnp.where(hit, after, jnp.nan),
        outcome=jnp.where(captured, Outcome.CAPTURED, first.outcome),
        near_grazing=hit & (approach < NEAR_GRAZING * surface.top_speed_nm_per_us),
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
def follow_impacts(
    scene: Scene, departure: Departure, tolerance: Float[Array, ""], *, impacts: int, max_steps: int
) -> NextImpact:
    """Return the impacts that follow a departure, with a leading axis of their number: `iterate_map` without checks.

    Args:
        scene: the interaction is a law, the platform the surface that the free tip sees.
        departure: just after an impact.
        tolerance: remaining error in us of an impact time at which a search stops.
        impacts: how many are followed.
        max_steps: steps of the search for one impact before it gives up.
    """
    search = Search(max_steps, tolerance)

    def one_flight(tip: tuple[Departure, Array], _: None) -> tuple[tuple[Departure, Array], NextImpact]:
        start, flies = tip
        impact = recomputed(partial(impact_after, search=search))(scene, start, flies=flies)
        outcome = jnp.where(flies, impact.outcome, Outcome.NOT_REACHED)
        goes_on = outcome == Outcome.IMPACT
        time = jnp.where(goes_on, impact.time_us, start.time_us)
        velocity = jnp.where(goes_on, impact.velocity_after_nm_per_us, start.velocity_nm_per_us)
        row = eqx.tree_at(lambda row: row.outcome, impact, outcome)
        return (Departure(time, None, velocity), goes_on), row

    # the row of a flight that does not take place has neither times nor velocities
    return lax.scan(one_flight, (departure, jnp.array(True)), length=impacts)[1]  # noqa: FBT003


BLOCK = 1000
"""Tips that run together; 300 to 2000 differ little on processors with vector units and 0.5 to 2 MB of cache."""


@checked
def iterate_batch(
    scene: Scene,
    time_us: ArrayLike,
    velocity_nm_per_us: ArrayLike,
    impacts: int,
    *,
    max_steps: int = DEFAULT_MAX_STEPS,
) -> NextImpact:
    """Return the impacts of many tips: `iterate_map` for every row of a batch of any size.

    Args:
        scene: a scene with a law (`ImpactLaw`, `TabulatedLaw`); parameters are scalars, or of shape (batch,).
        time_us: when the first flights start, shape (batch,).
        velocity_nm_per_us: tip velocities in the lab then, shape (batch,).
        impacts: how many impacts to follow.
        max_steps: steps of the search for one impact before it gives up.

    Returns:
        A `NextImpact` of shape (batch, impacts), differentiable in scene and starts.

    Raises:
        RuntimeError: if JAX is not set to 64-bit floats, or was not when the scene was built.
        TypeError: if the scene's interaction is not an impact law.
        ValueError: if shapes do not fit together, or `impacts` is not positive.
    """
    require_float64(scene)
    impact_law_of(scene)
    dtype = scene.platform.frequency_khz.dtype
    times, velocities = jnp.asarray(time_us, dtype), jnp.asarray(velocity_nm_per_us, dtype)
    check_count("impacts", impacts)
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
    return _iterate_batch(scene, (times, velocities), impacts=impacts, max_steps=max_steps)


@partial(jax.jit, static_argnames=("impacts", "max_steps"))
def _iterate_batch(
    scene: Scene,
    starts: tuple[Float[Array, " batch"], Float[Array, " batch"]],
    *,
    impacts: int,
    max_steps: int,
) -> NextImpact:
    varied, shared = eqx.partition(scene, jax.tree.map(lambda leaf, axes: leaf.ndim > axes, scene, axes_of_one(scene)))

    def one_tip(row):
        parameters, (time, velocity) = row
        return iterate_map(eqx.combine(parameters, shared), time, velocity, impacts, max_steps=max_steps)

    return map_in_blocks(jax.vmap(one_tip), (varied, starts), block=BLOCK)
