"""Orbits of m impacts in N drive periods: found from many starts, sorted, polished.

Starts are flown through the map; every window of m of their impacts that takes about N periods is a first guess, and
Newton's method closes the whole loop (`impact_loop`). What is left are loops that the map flies, each once.
"""

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float

from afm_jax.apparatus.scene import Scene
from afm_jax.checks import check_count, checked, require_float64
from afm_jax.dynamics.impact_loop import (
    ImpactLoop,
    LoopReading,
    closing_gaps,
    driven_part,
    loop_of,
    reading_of,
    samples_for,
)
from afm_jax.dynamics.starts import evenly_spread
from afm_jax.impact.first_impact import DEFAULT_ROOT_TOLERANCE_US
from afm_jax.impact.law import impact_law_of
from afm_jax.impact.map import Departure, follow_impacts
from afm_jax.outcomes import Outcome
from afm_jax.results import ResultTuple, public_result
from afm_jax.solve.lanes import compiled_quickly, power_of_two
from afm_jax.solve.newton import Newton, newton

DEFAULT_STARTS = 512
MOST_IMPACTS = 64
"""m: the linear system that closes a loop has twice as many unknowns."""
_WINDOWS = (0, 1, 2, 4, 8, 16, 48)
"""Impacts after a start at which a window may begin."""
_CLOSING = Newton(rounds=30, step_tolerance=1e-14)
_TURN = 0.5
"""Longest step of Newton's method in a phase, rad."""
_SHARE = 0.7
"""Longest step towards capture, of the distance from it."""
_CLOSED = 1e-11
"""Largest distance from closing, of the loop's speeds: 1e-12, and what heights of many periods lose by rounding."""
_GRAZES = 1e-8
"""Coordinate above capture, over the drive's speed, up to which an impact is none."""
_SAME = 1e-7
"""Relative distance below which two loops are one."""
_FASTEST = 100.0
"""Of the speeds that starts have, over the drive's."""
_STEPS = 2000
IMPACT_COLUMNS = (
    *("phase_rad", "velocity_after_nm_per_us", "velocity_before_nm_per_us"),
    *("approach_speed_nm_per_us", "rebound_speed_nm_per_us", "delay_us"),
)
"""Columns of an impact: attributes of `LoopReading`."""


@public_result(picture="afm_jax.plots.dynamics:many_orbits_figure")
class ManyImpactOrbits(ResultTuple):
    """Orbits of m impacts in N drive periods, by falling peak amplitude; NumPy arrays.

    The first impact is the hardest one, the others follow in time. Orbits that only repeat one with fewer impacts are
    left out.

    Attributes:
        loops: drive phases at the arrivals in rad, ascending, then coordinates in nm/us (`Law.speeds`).
        reading: impacts, peak amplitude, trace and determinant of each orbit, a `LoopReading`; all are admissible.
        multipliers: eigenvalues of the linearised map, the larger first.
        stable: whether both multipliers of an orbit lie inside the unit circle.
    """

    loops: Float[np.ndarray, "orbits n"]
    reading: LoopReading
    multipliers: Complex[np.ndarray, "orbits 2"]
    stable: Bool[np.ndarray, " orbits"]


def multipliers_of(
    trace: Float[np.ndarray, "*orbits"], determinant: Float[np.ndarray, "*orbits"]
) -> Complex[np.ndarray, "*orbits 2"]:
    """Return the two eigenvalues of a 2 x 2 map, the larger modulus first, shape (..., 2)."""
    half = 0.5 * np.asarray(trace, float)
    determinant = np.asarray(determinant, float)
    root = np.sqrt(half * half - determinant + 0j)
    large = half + np.where(half < 0.0, -1.0, 1.0) * root
    # the smaller one from the product: as a difference it cancels
    small = np.where(np.imag(root) != 0.0, np.conj(large), determinant / np.where(large == 0.0, 1.0, large))
    return np.stack([large, small], axis=-1)


def orbit_facts(reading: LoopReading, index: int) -> dict[str, Any]:
    """Return the row of an orbit of several impacts: the numbers of the first, and all of them in `impacts`."""
    trace, determinant = float(reading.trace[index]), float(reading.determinant[index])
    multipliers = multipliers_of(np.asarray(trace), np.asarray(determinant))
    impacts = impact_rows(reading, index)
    first = impacts[0] if impacts else dict.fromkeys(IMPACT_COLUMNS)
    return {
        "phase_rad": first["phase_rad"],
        "velocity_after_nm_per_us": first["velocity_after_nm_per_us"],
        "peak_amplitude_nm": float(reading.peak_amplitude_nm[index]),
        "trace": trace,
        "determinant": determinant,
        "multipliers": [[float(each.real), float(each.imag)] for each in multipliers],
        "stable": bool(is_stable(multipliers)),
        "admissible": bool(reading.admissible[index]),
        "impacts": impacts,
    }


def impact_rows(reading: LoopReading, index: int | None = None) -> list[dict[str, float]]:
    """Return the rows of the impacts of an orbit, one or several."""
    columns = {name: getattr(reading, name) for name in IMPACT_COLUMNS}
    lists = {name: (values if index is None else values[index]).tolist() for name, values in columns.items()}
    return [dict(zip(lists, values, strict=True)) for values in zip(*lists.values(), strict=True)]


def is_stable(multipliers: Complex[np.ndarray, "*orbits 2"]) -> Bool[np.ndarray, "*orbits"]:
    """Say whether multipliers, the larger first, lie inside the unit circle."""
    return np.asarray(np.abs(multipliers[..., 0]) < 1.0)


@checked
def many_impact_orbits(scene: Scene, order: int, impacts: int, *, starts: int = DEFAULT_STARTS) -> ManyImpactOrbits:
    """Return the orbits of m impacts in N drive periods that a search from many starts finds.

    Args:
        scene: one scene with an `ImpactLaw`, driven with one period.
        order: N, drive periods until the motion repeats.
        impacts: m, impacts in them.
        starts: how many flights the search begins with; more find more of the unstable orbits of a chaotic scene.

    Returns:
        The orbits, closed to 1e-11 of their speeds or better. Stable ones are found surely enough; of unstable ones
        those near which some start comes.

    Raises:
        RuntimeError: if JAX is not set to 64-bit floats.
        TypeError: if the scene's interaction is not an impact law.
        ValueError: if order or impacts is no positive integer, there are more impacts than 64, or the drive does not
            repeat.
    """
    require_float64(scene)
    impact_law_of(scene)
    driven = driven_part(scene)
    check_loop(order, impacts)
    check_count("starts", starts)
    number = jnp.asarray(float(order))
    unknowns, speed_unit, closed = _search(scene, number, _starts(starts), impacts=int(impacts), driven=driven)
    loops = loops_told_apart(np.asarray(unknowns)[np.asarray(closed)], order)
    padded = np.concatenate([loops, np.zeros((power_of_two(len(loops), 16) - len(loops), 2 * impacts))])
    reading = _read_loops(scene, number, jnp.asarray(padded), driven=driven, samples=samples_for(scene, order, driven))
    reading = jax.tree.map(lambda leaf: np.asarray(leaf)[: len(loops)], reading)
    keep = reading.admissible & (reading.missing < _CLOSED)
    rank = np.argsort(-reading.peak_amplitude_nm, kind="stable")
    chosen = rank[keep[rank]]
    reading = jax.tree.map(lambda leaf: leaf[chosen], reading)
    absolute = loops[chosen] * np.repeat([1.0, float(speed_unit)], impacts)
    multipliers = multipliers_of(reading.trace, reading.determinant)
    return ManyImpactOrbits(absolute, reading, multipliers, is_stable(multipliers))


def check_loop(order: int, impacts: int) -> None:
    """Check the numbers N and m of an orbit.

    Raises:
        ValueError: if one is no positive integer, or there are more impacts than 64.
    """
    for name, value, most in (("order", order, 1_000_000), ("impacts", impacts, MOST_IMPACTS)):
        if int(value) != value or not 1 <= value <= most:
            raise ValueError(f"`{name}` must be a positive integer up to {most}, but is {value}")


@compiled_quickly(static_argnames=("driven", "samples"))
def _read_loops(
    scene: Scene, order: Float[Array, ""], loops: Float[Array, "loops n"], *, driven: str, samples: int
) -> LoopReading:
    """Return what there is to know of loops of one scene (`reading_of`)."""
    loop = loop_of(scene, order, driven)
    return jax.vmap(lambda unknowns: reading_of(unknowns, loop, samples))(loops)


def _starts(number: int) -> Float[Array, "starts 2"]:
    """Return phases and logarithms of speeds, both as fractions of their range, that fill the square evenly."""
    return jnp.asarray((0.5 + evenly_spread(number)) % 1.0)


@partial(jax.jit, static_argnames=("impacts", "driven"))
def _search(scene: Scene, order: Array, starts: Array, *, impacts: int, driven: str):
    """Return the unknowns of loops, the unit of their coordinates in nm/us, and which of them close."""
    loop = loop_of(scene, order, driven)
    seen = eqx.tree_at(lambda parts: parts.platform, scene, loop.surface)
    phases, speeds = _walks(seen, loop, starts, _WINDOWS[-1] + impacts + 1)
    guesses, misfit = [], []
    for begin in _WINDOWS:
        phase, speed = phases[:, begin : begin + impacts + 1], speeds[:, begin : begin + impacts + 1]
        turns = (phase[:, -1] - phase[:, 0]) / (2.0 * jnp.pi) - order
        change = (speed[:, -1] - speed[:, 0]) / (speed[:, -1] + speed[:, 0])
        misfit.append(jnp.abs(turns) + jnp.abs(change))
        coordinates = loop.impact.coordinate(speed[:, :-1])
        guesses.append(jnp.concatenate([phase[:, :-1], coordinates / loop.speed_unit], axis=1))
    guesses, misfit = jnp.concatenate(guesses), jnp.concatenate(misfit)
    near = jnp.argsort(jnp.where(jnp.isfinite(misfit), misfit, jnp.inf))[: starts.shape[0]]
    usable = jnp.isfinite(misfit[near])
    guesses = jnp.where(usable[:, None], guesses[near], 1.0)
    loops = jax.vmap(lambda guess: _closed_loop(guess, loop))(guesses)
    missing = jax.vmap(lambda unknowns: jnp.max(jnp.abs(closing_gaps(unknowns, loop))))(loops)
    # a free motion that touches the surface is no orbit of impacts
    leaves = jnp.min(loops[:, impacts:], axis=1) > loop.impact.lowest / loop.speed_unit + _GRAZES
    return loops, loop.speed_unit, usable & (missing < _CLOSED) & leaves


def _walks(seen: Scene, loop: ImpactLoop, starts: Array, length: int) -> tuple[Array, Array]:
    """Return arrival phases in rad and approach speeds in nm/us of starts through the map; NaN where it ends."""
    surface = loop.surface
    tolerance = jnp.asarray(DEFAULT_ROOT_TOLERANCE_US)

    def walk(start):
        time = start[0] * 2.0 * jnp.pi / loop.angular_frequency
        velocity = surface.velocity(time) + surface.top_speed_nm_per_us * 0.03 * (_FASTEST / 0.03) ** start[1]
        rows = follow_impacts(seen, Departure(time, None, velocity), tolerance, impacts=length, max_steps=_STEPS)
        hit = rows.outcome == Outcome.IMPACT
        arrival = jnp.where(hit, rows.arrival_time_us, 0.0)
        approach = surface.velocity(arrival) - rows.velocity_before_nm_per_us
        return jnp.where(hit, arrival * loop.angular_frequency, jnp.nan), jnp.where(hit, approach, jnp.nan)

    return jax.vmap(walk)(starts)


def _closed_loop(guess: Float[Array, " n"], loop: ImpactLoop) -> Float[Array, " n"]:
    """Return the unknowns that Newton's method finds from a guess; whether the loop closes is for the caller to see."""
    count = guess.shape[0] // 2

    def damped(unknowns: Array, step: Array) -> Array:
        nearer = -_SHARE * (unknowns[count:] - loop.impact.lowest / loop.speed_unit)
        return jnp.concatenate([jnp.clip(step[:count], -_TURN, _TURN), jnp.maximum(step[count:], nearer)])

    return newton(closing_gaps, guess, loop, _CLOSING._replace(damping=damped)).x


def loops_told_apart(loops: Float[np.ndarray, "found n"], order: int) -> Float[np.ndarray, "loops n"]:
    """Return each loop once, its hardest impact first; without those that repeat a shorter one."""
    count = loops.shape[1] // 2
    distinct, result = np.zeros((0, 3, count)), []
    for unknowns in loops:
        phases, sizes = unknowns[:count], unknowns[count:]
        if np.any(np.diff(phases) <= 0.0) or phases[-1] - phases[0] >= 2.0 * np.pi * order:
            continue
        first = int(np.argmax(np.round(sizes / sizes.max(), 7)))
        turned = np.concatenate([phases[first:], phases[:first] + 2.0 * np.pi * order])
        turned -= 2.0 * np.pi * np.floor(turned[0] / (2.0 * np.pi))
        states = np.stack([np.cos(turned), np.sin(turned), np.roll(sizes, -first) / sizes.max()])
        rolled = [np.roll(states, -shift, axis=1) for shift in range(count)]
        repeats = any(np.abs(states - rolled[shift]).max() < _SAME for shift in range(1, count) if count % shift == 0)
        if repeats or any((np.abs(distinct - each).max(axis=(1, 2)) < _SAME).any() for each in rolled):
            continue
        distinct = np.concatenate([distinct, states[None]])
        result.append(np.concatenate([turned, np.roll(sizes, -first)]))
    return np.array(result).reshape(-1, 2 * count)
