"""Loops of impacts of a law, and orbits of m impacts in N drive periods: found from many starts, sorted, polished.

Takes a scene with a law, m and N; gives orbits: phases in rad, speeds in nm/us, amplitudes in nm, multipliers
(eqs. 2 to 8).

Starts are flown through the map; every window of m of their impacts that takes about N periods is a first guess, and
Newton's method closes the whole loop (`impact_loop`). What is left are loops that the map flies, each once.
"""

from dataclasses import replace
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float

from afm_jax.apparatus.scene import Scene, drive_of
from afm_jax.apparatus.surface import surface_of
from afm_jax.checks import checked, require_float64
from afm_jax.columns import rows_of
from afm_jax.dynamics.impact_loop import (
    CAPTURE,
    ImpactLoop,
    LoopFamily,
    LoopReading,
    closing_gaps,
    flights_of,
    impacts_at,
    lowest_gap,
    reading_of,
    rolled_states,
    trace_and_determinant_of,
)
from afm_jax.dynamics.starts import evenly_spread
from afm_jax.impact.first_impact import DEFAULT_ROOT_TOLERANCE_US
from afm_jax.impact.law import impact_law_of
from afm_jax.impact.map import Departure, follow_impacts
from afm_jax.impact.orbits import single_impact_orbits
from afm_jax.outcomes import Outcome
from afm_jax.results import ResultTuple, public_result
from afm_jax.solve.arclength import EquationsAt, PointInPlane
from afm_jax.solve.derivatives import largest, value_and_slopes
from afm_jax.solve.lanes import in_blocks
from afm_jax.solve.newton import newton
from afm_jax.solve.newton_rows import Newton
from afm_jax.units import RAD_PER_US_PER_KHZ

BLOCK = 64
"""Loops read together: one program."""
MOST_IMPACTS = 64
"""m: the linear system that closes a loop has twice as many unknowns."""
_WINDOWS = (0, 1, 2, 4, 8, 16, 48)
"""Impacts after a start at which a window may begin."""
_CLOSED = 1e-11
"""Largest distance from closing, of the loop's speeds: 1e-12, and what heights of many periods lose by rounding."""
IMPACT_COLUMNS = (
    *("phase_rad", "velocity_after_nm_per_us", "velocity_before_nm_per_us"),
    *("approach_speed_nm_per_us", "rebound_speed_nm_per_us", "delay_us"),
)
"""Columns of an impact: attributes of `LoopReading`."""


@public_result(picture="afm_jax.plots.dynamics:orbits_figure")
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
    impacts = rows_of({name: getattr(reading, name)[index] for name in IMPACT_COLUMNS})
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


def is_stable(multipliers: Complex[np.ndarray, "*orbits 2"]) -> Bool[np.ndarray, "*orbits"]:
    """Say whether multipliers, the larger first, lie inside the unit circle."""
    return np.asarray(np.abs(multipliers[..., 0]) < 1.0)


class LawLoops(LoopFamily):
    """Loops of a scene with a law, all of whose flights are closed forms."""

    def found(self, values: Float[np.ndarray, " parameters"], impacts: int) -> Float[np.ndarray, "loops n"]:
        """Return loops of m impacts in rad and nm/us; see `LoopFamily`."""
        scene, order = self.scene_at(values), int(self.order)
        several = any(
            part is not None and part.second is not None for part in (scene.platform, scene.base, scene.force)
        )
        if impacts > 1 or several:
            return many_impact_orbits(scene, order, impacts).loops
        # all of them, close to capture too, where no start of a search stays
        orbits = single_impact_orbits(scene, order)
        admissible = np.asarray(orbits.exists & orbits.admissible)
        phases = np.asarray(orbits.phase_rad) - drive_of(scene).angular_frequency * np.asarray(orbits.delay_us)
        coordinates = np.asarray(impact_law_of(scene).coordinate(orbits.approach_speed_nm_per_us))
        return np.stack([phases, coordinates], axis=1)[admissible]

    def linearised(self, point: Float[np.ndarray, " n"]) -> EquationsAt:
        """Return the closing conditions and the wanted test function at a point of a curve."""
        return EquationsAt(*map(np.asarray, self._value_and_slopes(point)))

    @jax.jit
    def _value_and_slopes(self, point: Float[Array, " n"]) -> tuple[Array, Array]:
        return value_and_slopes(self.equations, point)

    def tests(self, solved: PointInPlane) -> tuple[Float[np.ndarray, " kinds"], float]:
        """Return the test functions at a point of a curve, and the longest delay of an impact in drive periods."""
        tests, delay = self._tests_and_delay(solved.x)
        return np.asarray(tests), float(delay)

    @jax.jit
    def _tests_and_delay(self, point: Float[Array, " n"]) -> tuple[Array, Array]:
        unknowns, loop = self.at(point)
        delays = jnp.abs(impacts_at(unknowns, loop).speeds.delay) * loop.angular_frequency / (2.0 * jnp.pi)
        return jnp.stack(self.test_functions(unknowns, loop)), jnp.max(delays, initial=0.0)

    def readings(self, points: Float[np.ndarray, "points n"]) -> LoopReading:
        """Return the readings of the orbits at points of a curve, NumPy arrays."""
        some = points if len(points) else np.ones((1, points.shape[1]))
        return jax.tree.map(lambda leaf: leaf[: len(points)], in_blocks(self._read, some, widths=(BLOCK,)))

    @jax.jit
    def _read(self, points: Float[Array, "points n"]) -> LoopReading:
        return jax.vmap(lambda point: reading_of(*self.at(point), self.samples))(points)

    def captures_nothing(self, point: Float[np.ndarray, " n"]) -> bool:
        """Say whether impacts at a point of a curve are of a law without adhesion, which any speed leaves."""
        return float(self.at(jnp.asarray(point))[1].impact.lowest) == 0.0

    def at(self, point: Float[Array, " n"]) -> tuple[Float[Array, " unknowns"], ImpactLoop]:
        """Return the unknowns at a point of a curve, and what they close there."""
        count = point.shape[0] - len(self.paths)
        scene = self.scene_at(self.low + self.width * point[count:])
        omega = RAD_PER_US_PER_KHZ * getattr(scene, self.driven).frequency_khz
        law, period = impact_law_of(scene), 2.0 * jnp.pi * self.order / omega
        return point[:count], ImpactLoop(scene.cantilever, *surface_of(scene), law, period, omega, self.speed_unit)

    def equations(self, point: Float[Array, " n"]) -> Float[Array, " rows"]:
        """Return the closing conditions at a point of a curve, and behind them the test function that is to be 0."""
        unknowns, loop = self.at(point)
        gaps = closing_gaps(unknowns, loop)
        return gaps if self.test is None else jnp.append(gaps, self.test_functions(unknowns, loop)[self.test])

    def test_functions(self, unknowns: Array, loop: ImpactLoop) -> list[Array]:
        """Return the test functions in the order of `KINDS`, without dimension."""
        trace, determinant = trace_and_determinant_of(unknowns, loop)
        near = lowest_gap(loop.cantilever, loop.surface, flights_of(unknowns, loop), self.samples)
        if self.test == CAPTURE:
            near = jnp.minimum(near, _rise_when_captured(unknowns, loop))
        speeds = unknowns[unknowns.shape[0] // 2 :]
        slowest = -largest(-speeds) if speeds.size else jnp.inf
        return [
            1.0 - trace + determinant,
            1.0 + trace + determinant,
            near * loop.cantilever.angular_frequency / loop.speed_unit,
            slowest - loop.impact.lowest / loop.speed_unit,
        ]


def _rise_when_captured(unknowns: Array, loop: ImpactLoop) -> Array:
    """Return how the gap opens after the slowest impact, which leaves without speed: z'' - z_p'' over Omega^2, in nm.

    Where it is negative the tip passes through the surface, in a dip too shallow and short to be seen among samples.
    """
    impacts = impacts_at(unknowns, loop)
    slowest = jnp.argmin(unknowns[unknowns.shape[0] // 2 :])
    leaving = impacts.leaving_us[slowest]
    height = impacts.height[slowest]
    velocity = impacts.velocity[slowest]
    omega, decay = loop.cantilever.angular_frequency, loop.cantilever.decay_rate
    return -height - (2.0 * decay * velocity + jax.grad(loop.surface.velocity)(leaving)) / omega**2


@checked
def many_impact_orbits(scene: Scene, order: int, impacts: int) -> ManyImpactOrbits:
    """Return the orbits of m impacts in N drive periods that a search from 512 starts finds.

    Args:
        scene: one scene with an `ImpactLaw`, driven with one period.
        order: N, drive periods until the motion repeats.
        impacts: m, impacts in them.

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
    check_loop(order, impacts)
    top_speed = surface_of(scene)[0].top_speed_nm_per_us
    family = replace(LawLoops.of(scene, order), speed_unit=top_speed)
    unknowns, closed = _search(family, jnp.asarray((0.5 + evenly_spread(512)) % 1.0), impacts=int(impacts))
    loops = loops_told_apart(np.asarray(unknowns)[np.asarray(closed)], order)
    reading = family.readings(loops)
    fly = reading.admissible & (reading.missing < _CLOSED)
    return orbits_of(loops[fly] * family.units(impacts), jax.tree.map(lambda leaf: leaf[fly], reading))


def orbits_of(loops: Float[np.ndarray, "loops n"], reading: LoopReading) -> ManyImpactOrbits:
    """Return loops and their readings by falling peak amplitude."""
    rank = np.argsort(-np.asarray(reading.peak_amplitude_nm), kind="stable")
    reading = jax.tree.map(lambda leaf: leaf[rank], reading)
    multipliers = multipliers_of(np.asarray(reading.trace), np.asarray(reading.determinant))
    return ManyImpactOrbits(loops[rank], reading, multipliers, is_stable(multipliers))


def check_loop(order: int, impacts: int) -> None:
    """Check the numbers N and m of an orbit.

    Raises:
        ValueError: if one is no positive integer, or there are more impacts than 64.
    """
    for name, value, most in (("order", order, 1_000_000), ("impacts", impacts, MOST_IMPACTS)):
        if int(value) != value or not 1 <= value <= most:
            raise ValueError(f"`{name}` must be a positive integer up to {most}, but is {value}")


@partial(jax.jit, static_argnames=("impacts",))
def _search(family: LawLoops, starts: Float[Array, "starts 2"], *, impacts: int) -> tuple[Array, Array]:
    """Return the unknowns of loops, and which of them close.

    Args:
        family: without parameters.
        starts: phases and logarithms of speeds, both as fractions of their ranges.
        impacts: m.
    """
    _, loop = family.at(jnp.zeros(0))
    seen = eqx.tree_at(lambda parts: parts.platform, family.scene, loop.surface)
    phases, speeds = _walks(seen, loop, starts, _WINDOWS[-1] + impacts + 1)
    guesses, misfit = [], []
    for begin in _WINDOWS:
        phase, speed = phases[:, begin : begin + impacts + 1], speeds[:, begin : begin + impacts + 1]
        turns = (phase[:, -1] - phase[:, 0]) / (2.0 * jnp.pi) - family.order
        change = (speed[:, -1] - speed[:, 0]) / (speed[:, -1] + speed[:, 0])
        misfit.append(jnp.abs(turns) + jnp.abs(change))
        coordinates = loop.impact.coordinate(speed[:, :-1])
        guesses.append(jnp.concatenate([phase[:, :-1], coordinates / loop.speed_unit], axis=1))
    guesses, misfit = jnp.concatenate(guesses), jnp.concatenate(misfit)
    near = jnp.argsort(jnp.where(jnp.isfinite(misfit), misfit, jnp.inf))[: starts.shape[0]]
    usable = jnp.isfinite(misfit[near])
    guesses = jnp.where(usable[:, None], guesses[near], 1.0)
    capture = loop.impact.lowest / loop.speed_unit

    def damped(unknowns: Array, step: Array) -> Array:
        # half a radian at most, and towards capture not quite the distance from it
        nearer = -0.7 * (unknowns[impacts:] - capture)
        return jnp.concatenate([jnp.clip(step[:impacts], -0.5, 0.5), jnp.maximum(step[impacts:], nearer)])

    settings = Newton(rounds=30, step_tolerance=1e-14, damping=damped)
    loops = jax.vmap(lambda guess: newton(closing_gaps, guess, loop, settings).x)(guesses)
    missing = jax.vmap(lambda unknowns: jnp.max(jnp.abs(closing_gaps(unknowns, loop))))(loops)
    # a free motion that touches the surface is no orbit of impacts
    # above capture by less, over the drive's speed, an impact is none
    leaves = jnp.min(loops[:, impacts:], axis=1) > capture + 1e-8
    return loops, usable & (missing < _CLOSED) & leaves


def _walks(seen: Scene, loop: ImpactLoop, starts: Array, length: int) -> tuple[Array, Array]:
    """Return arrival phases in rad and approach speeds in nm/us of starts through the map; NaN where it ends."""
    surface = loop.surface
    tolerance = jnp.asarray(DEFAULT_ROOT_TOLERANCE_US)

    def walk(start):
        time = start[0] * 2.0 * jnp.pi / loop.angular_frequency
        # up to a hundred times the drive's
        velocity = surface.velocity(time) + surface.top_speed_nm_per_us * 0.03 * (100.0 / 0.03) ** start[1]
        rows = follow_impacts(seen, Departure(time, None, velocity), tolerance, impacts=length, max_steps=2000)
        hit = rows.outcome == Outcome.IMPACT
        arrival = jnp.where(hit, rows.arrival_time_us, 0.0)
        approach = surface.velocity(arrival) - rows.velocity_before_nm_per_us
        return jnp.where(hit, arrival * loop.angular_frequency, jnp.nan), jnp.where(hit, approach, jnp.nan)

    return jax.vmap(walk)(starts)


def loops_told_apart(loops: Float[np.ndarray, "found n"], order: int) -> Float[np.ndarray, "loops n"]:
    """Return each loop once, its hardest impact first; without those that repeat a shorter one."""
    count, result, known = loops.shape[1] // 2, [], np.zeros((0, 3, loops.shape[1] // 2))
    for unknowns in loops:
        phases, speeds = unknowns[:count], unknowns[count:]
        if np.any(np.diff(phases) <= 0.0) or phases[-1] - phases[0] >= 2.0 * np.pi * order:
            continue
        first = int(np.argmax(np.round(speeds / speeds.max(), 7)))
        turned = np.concatenate([phases[first:], phases[:first] + 2.0 * np.pi * order])
        turned -= 2.0 * np.pi * np.floor(turned[0] / (2.0 * np.pi))
        speeds = np.roll(speeds, -first)
        rolled = rolled_states(np.append(turned, speeds / speeds.max()))
        shorter = [shift for shift in range(1, count) if count % shift == 0]
        # relative to the hardest impact, nearer loops are one
        if not any((np.abs(others - rolled[0]).max(axis=(1, 2)) < 1e-7).any() for others in (rolled[shorter], known)):
            known = np.concatenate([known, rolled])
            result.append(np.append(turned, speeds))
    return np.array(result).reshape(-1, 2 * count)
