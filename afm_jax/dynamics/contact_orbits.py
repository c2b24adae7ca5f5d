"""Orbits of m contacts in N drive periods: closed by Newton's method on the simulated map from departure to departure.

Takes a scene with a contact, m and N; gives orbits: times in us, speeds in nm/us, amplitudes in nm, multipliers
(eq. 16).

First guesses are the orbits of the law with delay that comes closest to the contact, unstable ones included, and what
tips come to that are simulated for a while. The map's Jacobian is the forward derivative of the simulation, so that a
loop is closed to rounding and its multipliers are exact.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.lib.stride_tricks import sliding_window_view

from afm_jax.apparatus.scene import Scene, drive_of
from afm_jax.apparatus.surface import surface_of
from afm_jax.checks import checked, require_float64
from afm_jax.contact.contact import Contact
from afm_jax.contact.law_of_contact import approximate_law
from afm_jax.dynamics.impact_loop import (
    LoopFamily,
    LoopReading,
    highest_of_flights,
    impacts_at,
    lowest_gap,
    trace_and_determinant,
)
from afm_jax.dynamics.impact_orbits import (
    LawLoops,
    ManyImpactOrbits,
    check_loop,
    loops_told_apart,
    orbits_of,
)
from afm_jax.dynamics.many_tips import next_departures, tips_after_contacts
from afm_jax.dynamics.starts import evenly_spread, sample_driven, tips_at
from afm_jax.motion.record import ContactKind
from afm_jax.motion.simulate import DEFAULT_ACCURACY
from afm_jax.motion.start import gap_of_departure, rebound_of_leaving
from afm_jax.solve.arclength import EquationsAt, PointInPlane
from afm_jax.solve.lanes import in_blocks
from afm_jax.solve.newton_rows import LinearisedRows, Newton, newton_rows
from afm_jax.units import RAD_PER_US_PER_KHZ

_STARTS = 9
"""Tips that are simulated for guesses."""
_SETTLING = 60
"""Contacts before their guesses."""
_SAMPLES = 512
"""Of a flight, for its lowest points."""
_DIFFERENCE = 1e-5
"""Of unknowns without dimension, for derivatives of test functions."""


@checked
def contact_orbits(scene: Scene, order: int, impacts: int) -> ManyImpactOrbits:
    """Return the orbits of m contacts in N drive periods of a scene with a contact.

    Args:
        scene: one scene with a `Contact`, driven with one period.
        order: N, drive periods until the motion repeats.
        impacts: m, contacts in them.

    Returns:
        The orbits; a contact begins where the bridge forms and ends at `end_of_contact`. In the reading phases and
        velocities after are those of the departures, delays those between straight paths extrapolated to gap 0
        (as in `collide`); ``loops`` holds departure phases in rad and rebound speeds in
        nm/us. Stable orbits that nine tips do not come to and unstable ones that the closest law lacks are not found.

    Raises:
        RuntimeError: if JAX is not set to 64-bit floats.
        TypeError: if the scene's interaction is no contact.
        ValueError: if order or impacts is no positive integer, there are more impacts than 64, or the drive does not
            repeat.
    """
    require_float64(scene)
    if not isinstance(scene.interaction, Contact):
        raise TypeError("`scene` must have a `Contact`; `many_impact_orbits` has the orbits of a law")
    check_loop(order, impacts)
    family = ContactLoops.of(scene, order)
    loops = family.found(np.zeros(0), impacts)
    return orbits_of(loops, family.readings(loops))


class FlownLoop(NamedTuple):
    """A loop as it was simulated; phases in rad, rebound speeds in nm/us."""

    scene: Scene
    loop: Float[np.ndarray, " n"]
    gaps: Float[np.ndarray, " n"]
    """By how much the departures miss the next ones: m phases, m rebound speeds."""
    maps: Float[np.ndarray, "m 2 unknowns"]
    """Derivatives of the next departure's phase and rebound speed by this one's and by the parameters."""
    contacts: Any
    """`Contacts`, m rows; of each the one that follows the departure."""
    departure_us: Float[np.ndarray, " m"]

    @property
    def slopes(self) -> Float[np.ndarray, "n unknowns"]:
        """The derivatives of the gaps by departure phases, rebound speeds and parameters."""
        count, places = len(self.maps), np.arange(len(self.maps))
        whole = np.zeros((2, count, 2, count))
        whole[:, places, :, places] = self.maps[:, :, :2]
        whole[[0, 1], :, [0, 1]] -= np.roll(np.eye(count), 1, axis=1)
        by_parameters = self.maps[:, :, 2:].transpose(1, 0, 2).reshape(2 * count, -1)
        return np.hstack([whole.reshape(2 * count, 2 * count), by_parameters])

    @jax.jit
    def heights(self) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Return the largest height of the tip in nm, and its lowest point above the gap at which the bridge forms.

        That one is infinite where no flight has a lowest point.
        """
        scene = self.scene
        begin_us = jnp.asarray(self.departure_us)
        rebound = jnp.split(self.loop, 2)[1]
        surface, response = surface_of(scene)
        level, rate = surface.position_and_velocity(begin_us)
        lasts = self.contacts.arrival_time_us - begin_us
        flights = begin_us, level + gap_of_departure(scene), rate + rebound, jnp.zeros_like(begin_us), lasts
        lowest = lowest_gap(scene.cantilever, surface, flights, _SAMPLES) - scene.interaction.bridge_forms_nm
        return highest_of_flights(scene.cantilever, response, flights, _SAMPLES), lowest


def _orbits_of_law(scene: Scene, order: int, impacts: int) -> Float[np.ndarray, "guesses n"]:
    """Return the orbits of the law with delay closest to the contact, as guesses: m departure phases, m speeds."""
    law = approximate_law(scene.interaction, float(scene.cantilever.mass_ng))
    if law is None:
        return np.zeros((0, 2 * impacts))
    family = LawLoops.of(eqx.tree_at(lambda scene: scene.interaction, scene, law), order)
    of_law = jax.vmap(lambda loop: impacts_at(*family.at(loop)))(jnp.asarray(family.found(np.zeros(0), impacts)))
    omega, rebound = float(drive_of(scene).angular_frequency), np.asarray(of_law.speeds.rebound)
    # a straight path to the gap at which contact ends
    phases = omega * (np.asarray(of_law.leaving_us) + float(gap_of_departure(scene)) / rebound)
    return np.concatenate([phases, rebound], axis=1)[(rebound > 0.0).all(axis=1)]


def _repetitions(scene: Scene, order: int, impacts: int) -> Float[np.ndarray, "guesses n"]:
    """Return sequences of m contacts in nearly N drive periods that a few simulated tips come to, as guesses.

    The tips start evenly spread. They are simulated in the frame in which the drive is a platform's: what they come to
    does not depend on the clock that the drive's phase counts in.
    """
    seen = sample_driven(scene)
    platform = seen.scenes.platform
    scenes = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (_STARTS, *leaf.shape)), seen.scenes)
    period, (across, up) = float(platform.period_us), evenly_spread(_STARTS).T
    faster = float(rebound_of_leaving(seen.scenes)) * (0.5 + 3.0 * up)
    tips = tips_at(scenes, period * across, np.asarray(platform.velocity(period * across)) + faster)
    _, record = tips_after_contacts(scenes, tips, skip=_SETTLING, record=2 * impacts + 1, accuracy=DEFAULT_ACCURACY)
    turns = record.departure_periods + record.departure_us / period + float(seen.frame.phase_rad) / (2.0 * np.pi)
    rebound = record.velocity_after_nm_per_us - np.asarray(platform.velocity(record.departure_us))
    (times, speeds) = (sliding_window_view(part, impacts + 1, axis=1) for part in (turns, rebound))
    # the contacts of a guess may miss N drive periods by this
    near = np.abs(times[..., -1] - times[..., 0] - order) < 0.05
    phases = 2.0 * np.pi * (times[near] - np.floor(times[near][:, :1]))
    return np.concatenate([phases[:, :-1], speeds[near][:, :-1]], axis=1)


class ContactLoops(LoopFamily):
    """Loops of a scene with a contact, each of whose contacts is simulated: departure phases and rebound speeds."""

    def flown(
        self, loops: Float[np.ndarray, "loops n"], values: Float[np.ndarray, "loops parameters"]
    ) -> list[FlownLoop | None]:
        """Return loops with each of their contacts simulated, all at once; None where one does not end in time.

        Args:
            loops: of each m departure phases in rad and m rebound speeds in nm/us.
            values: of the parameters.
        """
        count = loops.shape[1] // 2
        phase, rebound = np.split(loops, 2, axis=1)
        following = np.concatenate([phase[:, 1:], phase[:, :1] + 2.0 * np.pi * float(self.order)], axis=1)
        shortest = np.min(following - phase, axis=1, keepdims=True)
        flown: list[FlownLoop | None] = [None] * len(loops)
        flies = np.flatnonzero((shortest[:, 0] > 0.0) & (rebound > 0.0).all(axis=1))
        if not flies.size:
            return flown
        parameters = np.repeat(values[:, None], count, axis=1)
        unknowns = np.concatenate([np.stack([phase, rebound], axis=2), parameters], axis=2)
        # a contact may take longer than expected by this, in flights of the loop
        until = following + 0.5 * shortest
        lanes = [part[flies].reshape(flies.size * count, *part.shape[2:]) for part in (unknowns, until)]
        scenes = jax.tree.map(lambda leaf: np.broadcast_to(leaf, (len(lanes[1]), *np.shape(leaf))), self.scene)

        def work(some: tuple[Scene, Array, Array]) -> Any:
            return next_departures(*some, paths=self.paths, driven=self.driven, accuracy=DEFAULT_ACCURACY)

        # one program for all numbers of contacts
        results = in_blocks(work, (scenes, *lanes), widths=(16,))
        later, maps, contacts, there = jax.tree.map(lambda part: part.reshape(-1, count, *part.shape[1:]), results)
        ends = (contacts.kind == ContactKind.IMPACT).all(axis=1) & np.isfinite(maps).all(axis=(1, 2, 3))
        omega = np.asarray(RAD_PER_US_PER_KHZ * getattr(there, self.driven).frequency_khz)
        for row in np.flatnonzero(ends):
            number = flies[row]
            gaps = later[row].T - np.stack([following[number], np.roll(rebound[number], -1)])
            scene, contact = jax.tree.map(lambda leaf, row=row: leaf[row], (there, contacts))
            scene = jax.tree.map(lambda leaf: jnp.asarray(leaf[0]), scene)
            departures = phase[number] / omega[row]
            flown[number] = FlownLoop(scene, loops[number], gaps.ravel(), maps[row], contact, departures)
        return flown

    def found(self, values: Float[np.ndarray, " parameters"], impacts: int) -> Float[np.ndarray, "loops n"]:
        """Return loops of m contacts in rad and nm/us, each once; see `LoopFamily`."""
        scene, order = self.scene_at(values), int(self.order)
        guesses = np.concatenate([_orbits_of_law(scene, order, impacts), _repetitions(scene, order, impacts)])

        def units(loops: Float[np.ndarray, "loops n"]) -> Float[np.ndarray, "loops n"]:
            """Return 1 rad for phases and the fastest speed for speeds."""
            fastest = np.repeat(loops[:, impacts:].max(axis=1, keepdims=True), impacts, axis=1)
            return np.concatenate([np.ones_like(fastest), fastest], axis=1)

        def damped(loops: Float[np.ndarray, "loops n"], step: Float[np.ndarray, "loops n"]) -> np.ndarray:
            # of a phase in rad, and of a speed
            longest = 0.3 * np.concatenate([np.ones_like(loops[:, impacts:]), loops[:, impacts:]], axis=1)
            return step / np.abs(step / longest).max(axis=1, keepdims=True).clip(1.0)

        def linearised(loops: Float[np.ndarray, "loops n"], _: Any) -> LinearisedRows:
            residual, slopes = np.full_like(loops, np.nan), np.full((*loops.shape, loops.shape[1]), np.nan)
            for row, loop in enumerate(self.flown(loops, np.tile(values, (len(loops), 1)))):
                if loop is not None:
                    residual[row], slopes[row] = loop.gaps, loop.slopes[:, : loops.shape[1]]
            return LinearisedRows(residual / units(loops), slopes / units(loops)[:, :, None])

        closing = Newton(rounds=25, step_tolerance=1e-10, residual_tolerance=1e-10, unit=units, damping=damped)
        roots = newton_rows(linearised, guesses, closing)
        return loops_told_apart(roots.x[roots.converged], order)

    def linearised(self, point: Float[np.ndarray, " n"]) -> EquationsAt | None:
        """Return the closing conditions and the wanted test function at a point of a curve; None where none flies."""
        # the test function's derivatives are differences, which only lead to its root
        size = len(point)
        around = [np.eye(size), -np.eye(size)] if self.test is not None else []
        aside = _DIFFERENCE * np.concatenate([np.zeros((1, size)), *around])
        flown = [loop for loop in self.flown(*self.loops_and_values(point + aside)) if loop is not None]
        if len(flown) < len(aside):
            return None
        here = flown[0]
        units = self.units(len(here.loop) // 2)
        value = here.gaps / units
        slopes = here.slopes * np.concatenate([units, self.width]) / units[:, None]
        if self.test is not None:
            tests = np.array([self._tests(loop)[self.test] for loop in flown])
            value = np.append(value, tests[0])
            slopes = np.vstack([slopes, (tests[1 : size + 1] - tests[size + 1 :]) / (2.0 * _DIFFERENCE)])
        return EquationsAt(value, slopes, here)

    def tests(self, solved: PointInPlane) -> tuple[Float[np.ndarray, " kinds"], float]:
        """Return the test functions at a point of a curve; of a simulated loop no delay is too long."""
        return self._tests(solved.details), 0.0

    def readings(self, points: Float[np.ndarray, "points n"]) -> LoopReading:
        """Return the readings of the orbits at points of a curve, NumPy arrays."""
        flown = [loop for loop in self.flown(*self.loops_and_values(points)) if loop is not None]
        if len(flown) < len(points):
            raise ValueError("a loop that was closed does not fly")
        if not flown:
            each, whole = jnp.zeros((0, (points.shape[1] - len(self.paths)) // 2)), jnp.zeros(0)
            return LoopReading(*[*[each] * 6, *[whole] * 3, whole > 0.0, whole])
        return jax.tree.map(lambda *numbers: np.stack([np.asarray(each) for each in numbers]), *map(_reading_of, flown))

    def _tests(self, flown: FlownLoop) -> np.ndarray:
        """Return the test functions of `LoopFamily.tests`."""
        trace, determinant = trace_and_determinant(flown.maps)
        near = float(flown.heights()[1]) * float(flown.scene.cantilever.angular_frequency)
        speeds = np.array([near, np.split(flown.loop, 2)[1].min()]) / float(self.speed_unit)
        return np.append(np.array([1.0 - trace, 1.0 + trace]) + determinant, speeds)


def _reading_of(flown: FlownLoop) -> LoopReading:
    scene, contacts, (phase, rebound) = flown.scene, flown.contacts, np.split(flown.loop, 2)
    trace, determinant = trace_and_determinant(flown.maps)
    # of the contact before each departure
    approach = np.roll(contacts.approach_speed_nm_per_us, 1)
    lasts = np.roll(contacts.departure_time_us - contacts.arrival_time_us, 1)
    straight = scene.interaction.bridge_forms_nm / approach + gap_of_departure(scene) / rebound
    values: dict[str, Any] = {
        "phase_rad": phase % (2.0 * np.pi),
        "velocity_after_nm_per_us": rebound + scene.platform.velocity(flown.departure_us),
        "velocity_before_nm_per_us": np.roll(contacts.arrival_velocity_nm_per_us, 1),
        "approach_speed_nm_per_us": approach,
        "rebound_speed_nm_per_us": rebound,
        "delay_us": lasts - straight,
        "peak_amplitude_nm": flown.heights()[0],
        "trace": trace,
        "determinant": determinant,
        "admissible": True,
        "missing": np.abs(flown.gaps * np.repeat([1.0, 1.0 / rebound.max()], len(phase))).max(),
    }
    return LoopReading(**{name: jnp.asarray(value) for name, value in values.items()})
