"""Orbits of m contacts in N drive periods: closed by Newton's method on the simulated map from departure to departure.

First guesses are the orbits of the law with delay that comes closest to the contact, unstable ones included, and what
tips come to that are simulated for a while. The map's Jacobian is the forward derivative of the simulation, so that a
loop is closed to rounding and its multipliers are exact.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Shaped

from afm_jax.apparatus.scene import Scene, SceneLike, as_scene, drive_of
from afm_jax.apparatus.surface import Surface, surface_of
from afm_jax.checks import checked, require_float64
from afm_jax.contact.contact import Contact
from afm_jax.contact.law_of_contact import law_of_contact
from afm_jax.dynamics.contact_sequence import follow_contacts, next_contact
from afm_jax.dynamics.impact_loop import FreeFlights, LoopReading, driven_part, lowest_of_flights
from afm_jax.dynamics.impact_orbits import (
    ManyImpactOrbits,
    check_loop,
    is_stable,
    loops_told_apart,
    many_impact_orbits,
    multipliers_of,
)
from afm_jax.dynamics.iteration import SampleDriven, evenly_spread, laws_of, leaving_tips
from afm_jax.impact.amplitude import FlightEnds, highest_of_sum, peak_amplitude
from afm_jax.impact.orbits import SingleImpactOrbits, single_impact_orbits
from afm_jax.motion.observe import peaks_of_flights
from afm_jax.motion.record import ContactKind, Contacts
from afm_jax.motion.simulate import DEFAULT_ACCURACY
from afm_jax.scenefile.parameter_paths import scene_family
from afm_jax.solve.arclength import EquationsAt
from afm_jax.solve.lanes import Report, in_blocks
from afm_jax.solve.newton import LinearisedRows, Newton, newton_rows, shortened
from afm_jax.units import RAD_PER_US_PER_KHZ

_STARTS = 8
"""Tips that are simulated for guesses."""
_SETTLING = 60
"""Contacts before their guesses."""
_WINDOW = 0.05
"""Periods by which the contacts of a guess may miss N drive periods."""
_LARGEST_CHANGE = 0.3
"""Longest step of Newton's method: in a phase, rad, and of a speed."""
_LANES = 16
"""Contacts followed together, one program."""
_CONTACTS_AT_ONCE = 128
"""Of a chart."""
CHART_ACCURACY = 1e-6
_GRAZING = 3
"""Number of its test function in `closed_loops`."""
_SAMPLES = 512
"""Of a flight, for its lowest points."""
_DIFFERENCE = 1e-5
"""Of unknowns without dimension, for derivatives of test functions."""
_LONGEST_CONTACT = 0.5
"""Time that a contact may take beyond where it was expected to end, in flights of the loop."""


@checked
def contact_orbits(
    scene: SceneLike, order: int, impacts: int, *, accuracy: float = DEFAULT_ACCURACY
) -> ManyImpactOrbits:
    """Return the orbits of m contacts in N drive periods of a scene with a contact.

    Args:
        scene: one scene with a `Contact`, driven with one period.
        order: N, drive periods until the motion repeats.
        impacts: m, contacts in them.
        accuracy: of `simulate`.

    Returns:
        The orbits; a contact begins where the bridge forms and ends where it breaks. In the reading phases and
        velocities after are those of the departures, delays those between straight paths extrapolated to gap 0
        (as in `collide`); ``loops`` holds departure phases in rad and rebound speeds in
        nm/us. Stable orbits that eight tips do not come to and unstable ones that the closest law lacks are not found.

    Raises:
        RuntimeError: if JAX is not set to 64-bit floats.
        TypeError: if the scene's interaction is no contact.
        ValueError: if order or impacts is no positive integer, there are more impacts than 64, or the drive does not
            repeat.
    """
    scene = as_scene(scene)
    require_float64(scene)
    if not isinstance(scene.interaction, Contact):
        raise TypeError("`scene` must have a `Contact`; `many_impact_orbits` has the orbits of a law")
    check_loop(order, impacts)
    flights = ContactFlights(scene, order, (), accuracy=accuracy)
    told = contact_loops(flights, np.zeros(0), impacts)
    readings = flights.readings(told, np.zeros((len(told), 0)))
    known = [(reading, loop) for reading, loop in zip(readings, told, strict=True) if reading is not None]
    known.sort(key=lambda one: -float(one[0].peak_amplitude_nm))
    fields = [*[jnp.zeros((0, impacts))] * 6, *[jnp.zeros(0)] * 3, jnp.zeros(0, bool), jnp.zeros(0)]
    reading = LoopReading(*fields)
    if known:
        reading = jax.tree.map(
            lambda *parts: np.stack([np.asarray(part) for part in parts]), *(one for one, _ in known)
        )
    loops = np.array([loop for _, loop in known]).reshape(-1, 2 * impacts)
    multipliers = multipliers_of(np.asarray(reading.trace), np.asarray(reading.determinant))
    return ManyImpactOrbits(loops, reading, multipliers, is_stable(multipliers))


def contact_loops(
    flights: "ContactFlights", values: Float[np.ndarray, " parameters"], impacts: int
) -> Float[np.ndarray, "loops n"]:
    """Return the loops of m contacts that are found at values of a scene's parameters, each once (`FlownLoop`)."""
    scene, order = flights.family(*values), flights.order
    guesses = [*_orbits_of_law(scene, order, impacts), *_simulated(scene, order, impacts, flights.accuracy)]
    loops = _closed(np.array(guesses).reshape(-1, 2 * impacts), flights, values)
    return loops_told_apart(loops, order)


def _orbits_of_law(scene: Scene, order: int, impacts: int) -> list[np.ndarray]:
    """Return the orbits of the law with delay closest to the contact, as guesses."""
    law = law_of_contact(scene.interaction, float(scene.cantilever.mass_ng))
    if law is None:
        return []
    simple = eqx.tree_at(lambda parts: parts.interaction, scene, law)
    if impacts == 1:
        # all of them, close to capture too, where no start of a search stays
        single = single_impact_orbits(simple, order)
        there = np.asarray(single.exists & single.admissible)
        phases, rebounds = (
            np.asarray(part)[there, None] for part in (single.phase_rad, single.rebound_speed_nm_per_us)
        )
    else:
        reading = many_impact_orbits(simple, order, impacts).reading
        phases, rebounds = np.asarray(reading.phase_rad), np.asarray(reading.rebound_speed_nm_per_us)
    # `phase_rad` is within a turn: the impacts follow one another
    starts = np.array([_rising(phase) for phase in phases]).reshape(rebounds.shape)
    departures, speeds = _where_the_bridge_breaks(scene, starts, rebounds)
    return [
        np.concatenate(guess)
        for guess in zip(departures, speeds, strict=True)
        if np.isfinite(guess).all() and np.min(guess[1]) > 0.0
    ]


def _where_the_bridge_breaks(
    scene: Scene, phases: Float[np.ndarray, "orbits m"], rebounds: Float[np.ndarray, "orbits m"]
) -> tuple[Float[np.ndarray, "orbits m"], Float[np.ndarray, "orbits m"]]:
    """Return phases and speeds against the surface at which flights from the surface first are as high; NaN if never.

    Straight paths are not enough: slow tips take a good part of a drive period.
    """
    surface, _ = surface_of(scene)
    omega = float(drive_of(scene).angular_frequency)
    begin, after = phases[..., None] / omega, np.linspace(0.0, 2.0 * np.pi / omega, _SAMPLES)
    height, rate = surface.position_and_velocity(begin)
    position, velocity = scene.cantilever.propagator(after)(height, rate + rebounds[..., None])
    level, moves = surface.position_and_velocity(begin + after)
    above = np.asarray(position - level) - float(scene.interaction.bridge_breaks_nm)
    place = np.argmax(above > 0.0, axis=-1)[..., None]
    before, now = (np.take_along_axis(above, np.maximum(place - back, 0), axis=-1)[..., 0] for back in (1, 0))
    share = np.where(now > 0.0, now / np.maximum(now - before, 1e-300), np.nan)
    risen = (place[..., 0] - share) * after[1]
    return phases + omega * risen, np.take_along_axis(np.asarray(velocity - moves), place, axis=-1)[..., 0]


def _rising(phase: Float[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
    turned = phase.copy()
    for place in range(1, len(turned)):
        turned[place] += 2.0 * np.pi * np.ceil((turned[place - 1] - turned[place]) / (2.0 * np.pi))
    return turned


def _simulated(scene: Scene, order: int, impacts: int, accuracy: float) -> list[np.ndarray]:
    """Return what a few tips do after a while, where it nearly repeats, as guesses."""
    scenes = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (_STARTS, *leaf.shape)), scene)
    tips = leaving_tips(scenes)
    period = drive_of(scene).period_us
    across, up = evenly_spread(_STARTS).T
    time = period * across
    faster = np.asarray(tips.velocity_nm_per_us - scene.platform.velocity(tips.time_us)) * (0.5 + 3.0 * up)
    tips = tips._replace(time_us=time, velocity_nm_per_us=np.asarray(scene.platform.velocity(time)) + faster)
    _, record = follow_contacts(scenes, tips, skip=_SETTLING, record=2 * impacts + 1, accuracy=accuracy)
    turns = record.departure_periods + record.departure_us / period
    rebound = record.velocity_after_nm_per_us - np.asarray(scene.platform.velocity(record.departure_us))
    found = []
    for lane in range(_STARTS):
        for begin in range(impacts + 1):
            own = turns[lane, begin : begin + impacts + 1]
            if abs(own[-1] - own[0] - order) < _WINDOW:
                phases = 2.0 * np.pi * (own[:-1] - np.floor(own[0]))
                found.append(np.concatenate([phases, rebound[lane, begin : begin + impacts]]))
    return found


def _closed(
    guesses: Float[np.ndarray, "guesses n"], flights: "ContactFlights", values: Float[np.ndarray, " parameters"]
) -> Float[np.ndarray, "loops n"]:
    """Return the loops that Newton's method finds, departure phases and rebound speeds."""
    count = guesses.shape[1] // 2

    def units(loops: Float[np.ndarray, "loops n"]) -> Float[np.ndarray, "loops n"]:
        fastest = loops[:, count:].max(axis=1, keepdims=True)
        return np.repeat(np.concatenate([np.ones_like(fastest), fastest], axis=1), count, axis=1)

    def linearised(loops: Float[np.ndarray, "loops n"], _: Any) -> LinearisedRows:
        residual, slopes = np.full_like(loops, np.nan), np.full((*loops.shape, loops.shape[1]), np.nan)
        for row, flown in enumerate(flights.flown(loops, np.tile(values, (len(loops), 1)))):
            if flown is not None:
                residual[row], slopes[row] = flown.gaps, flown.slopes[:, : loops.shape[1]]
        return LinearisedRows(residual / units(loops), slopes / units(loops)[:, :, None])

    roots = newton_rows(linearised, guesses, _CLOSING._replace(unit=units, damping=_damped))
    return roots.x[roots.converged]


def _damped(loops: Float[np.ndarray, "loops n"], step: Float[np.ndarray, "loops n"]) -> Float[np.ndarray, "loops n"]:
    """Return a step of Newton's method that turns no phase and changes no speed by too much."""
    phases, speeds = np.split(loops, 2, axis=1)
    return shortened(step, np.concatenate([np.full_like(phases, _LARGEST_CHANGE), _LARGEST_CHANGE * speeds], axis=1))


def single_contact_orbits(
    seen: SampleDriven, orders: Sequence[int], *, accuracy: float = CHART_ACCURACY, report: Report | None = None
) -> dict[str, Shaped[np.ndarray, "lanes orders"]]:
    """Return which orbits of one contact there are at many scenes with a contact.

    Every orbit of the law with delay closest to the contact is a guess, from which Newton's method closes the simulated
    map. What the law lacks is not found, and where no guess closes there may be an orbit nevertheless: ``unresolved``.

    Args:
        seen: the scenes, a batch.
        orders: N.
        accuracy: of `simulate`.
        report: told how many of how many orbits of the law have been followed.

    Returns:
        ``stable``, ``admissible`` and ``unresolved``, and of the stable orbit, the highest if there are several,
        ``peak_amplitude_nm`` and ``largest_multiplier``, NaN where there is none.
    """
    lanes, columns, phase, rebound, turns = _guesses_of_law(seen, orders)
    numpy_scenes = jax.tree.map(np.asarray, seen)

    def linearised(departures: Float[np.ndarray, "open 2"], rows: Int[np.ndarray, " open"]) -> LinearisedRows:
        if report is not None:
            report(len(lanes) - len(rows), len(lanes))

        def work(part: tuple[SampleDriven, Array, Array, Array]) -> _Return:
            return _returns(*part, accuracy=accuracy)

        scenes = jax.tree.map(lambda leaf: leaf[lanes[rows]], numpy_scenes)
        flown = in_blocks(work, (scenes, *departures.T, turns[rows]), block=_CONTACTS_AT_ONCE)
        scale = np.stack([np.ones(len(rows)), departures[:, 1]], axis=1)
        details = list(zip(flown.trace, flown.determinant, flown.peak_amplitude_nm, strict=True))
        return LinearisedRows(flown.gaps / scale, flown.slopes / scale[:, :, None], details)

    roots = newton_rows(linearised, np.stack([phase, rebound], axis=1), _CLOSING_A_CHART)
    closed = np.flatnonzero(roots.converged)
    if report is not None and len(lanes):
        report(len(lanes), len(lanes))
    trace, determinant, peak = np.array([roots.details[row] for row in closed]).reshape(-1, 3).T
    multipliers = np.abs(multipliers_of(trace, determinant)[:, 0])
    shape = len(seen.scenes.platform.frequency_khz), len(orders)
    orbits = {name: np.zeros(shape, bool) for name in ("stable", "admissible", "unresolved")}
    orbits |= {name: np.full(shape, np.nan) for name in ("peak_amplitude_nm", "largest_multiplier")}
    orbits["admissible"][lanes[closed], columns[closed]] = True
    # the highest last: of several values for one place the last one stays
    stable = np.flatnonzero(multipliers < 1.0)
    stable = stable[np.argsort(peak[stable], kind="stable")]
    place = lanes[closed[stable]], columns[closed[stable]]
    orbits["stable"][place] = True
    orbits["peak_amplitude_nm"][place], orbits["largest_multiplier"][place] = peak[stable], multipliers[stable]
    orbits["unresolved"][lanes[~roots.converged], columns[~roots.converged]] = True
    orbits["unresolved"] &= ~orbits["admissible"]
    return orbits


def _guesses_of_law(
    seen: SampleDriven, orders: Sequence[int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return guesses: numbers of scenes and of orders, departure phases, rebound speeds, rad that an orbit takes."""
    scenes = jax.tree.map(jnp.asarray, seen.scenes)
    found = laws_of(scenes)
    if found is None:
        none = np.zeros(0)
        return none.astype(int), none.astype(int), none, none, none
    law, known = found
    own, parts = np.flatnonzero(known), []
    simple = jax.tree.map(lambda leaf: leaf[own], Scene(scenes.cantilever, scenes.platform, law))
    rise = np.asarray(scenes.platform.angular_frequency * scenes.interaction.bridge_breaks_nm)
    for column, order in enumerate(orders):

        def work(part: Scene, order: int = order) -> SingleImpactOrbits:
            return jax.vmap(lambda scene: single_impact_orbits(scene, order))(part)

        orbits = in_blocks(work, simple, block=_CONTACTS_AT_ONCE)
        lane, slot = np.nonzero(orbits.exists & orbits.admissible)
        rebound, at = orbits.rebound_speed_nm_per_us[lane, slot], own[lane]
        phase, turn = orbits.phase_rad[lane, slot] + rise[at] / rebound, np.full(len(lane), 2.0 * np.pi * order)
        parts.append((at, np.full(len(lane), column), phase, rebound, turn))
    lanes, columns, phase, rebound, turns = (np.concatenate(part) for part in zip(*parts, strict=True))
    return lanes, columns, phase, rebound, turns


class _Return(NamedTuple):
    """What comes of departures after a contact, arrays of one lane each; NaN where it does not end in time."""

    gaps: Any
    """By how much the next departure misses this one: phase in rad, rebound speed in nm/us."""
    slopes: Any
    """Their derivatives by phase and rebound speed."""
    trace: Any
    determinant: Any
    peak_amplitude_nm: Any


@partial(jax.jit, static_argnames=("accuracy",))
def _returns(seen: SampleDriven, phase: Array, rebound: Array, turns: Array, *, accuracy: float) -> _Return:
    def one(seen: SampleDriven, phase: Array, rebound: Array, turn: Array) -> _Return:
        scene = seen.scenes
        platform, omega = scene.platform, scene.platform.angular_frequency

        def departs(unknowns: Array) -> tuple[Array, Contacts]:
            time = unknowns[0] / omega
            velocity = unknowns[1] + platform.velocity(time)
            contact = next_contact(scene, time, velocity, (phase + (1.0 + _LONGEST_CONTACT) * turn) / omega, accuracy)
            return jnp.stack([omega * contact.departure_time_us, contact.rebound_speed_nm_per_us]), contact

        unknowns = jnp.stack([phase, rebound])
        # forward once: value and derivatives of one simulation
        (value, contact), slopes = _with_slopes(departs, unknowns)
        good = contact.kind == ContactKind.IMPACT
        gaps = jnp.where(good, value - unknowns - jnp.array([1.0, 0.0]) * turn, jnp.nan)
        start = phase / omega
        height, rate = platform.position_and_velocity(start)
        height, rate, lasts = (
            height + scene.interaction.bridge_breaks_nm,
            rate + rebound,
            contact.arrival_time_us - start,
        )
        flight = FlightEnds(start, lasts, height, rate, *scene.cantilever.propagator(lasts)(height, rate))
        if seen.frame.response is None:
            peak = peak_amplitude(scene.cantilever, flight)
        else:
            still = jnp.zeros_like(start)
            peak = highest_of_sum(scene.cantilever, flight, Surface(still, still, (seen.frame.response,)))
        determinant = slopes[0, 0] * slopes[1, 1] - slopes[0, 1] * slopes[1, 0]
        return _Return(gaps, slopes - jnp.eye(2), slopes[0, 0] + slopes[1, 1], determinant, peak)

    return jax.vmap(one)(seen, phase, rebound, turns)


def _with_slopes(function: Any, unknowns: Array) -> tuple[Any, Array]:
    def twice(unknowns: Array) -> tuple[Array, Any]:
        value, other = function(unknowns)
        return value, (value, other)

    slopes, found = jax.jacfwd(twice, has_aux=True)(unknowns)
    return found, slopes


_CLOSING = Newton(rounds=25, step_tolerance=1e-10, residual_tolerance=1e-10)
"""Of loops: phases in rad, speeds of the fastest one."""
_CLOSING_A_CHART = Newton(rounds=15, residual_tolerance=1e-7, damping=_damped)
"""Of single contacts: a phase in rad, a speed relative to itself."""


class CurveUnits(NamedTuple):
    """What a curve of loops is measured in: the unit of speeds, and the parameters' ranges."""

    speed_nm_per_us: float
    low: Float[np.ndarray, " parameters"]
    width: Float[np.ndarray, " parameters"]

    def scales(self, impacts: int) -> Float[np.ndarray, " n"]:
        """Return the units of a loop's unknowns: m phases, m speeds."""
        return np.repeat([1.0, self.speed_nm_per_us], impacts)

    def of_points(self, points: Float[np.ndarray, "points n"]) -> tuple[np.ndarray, np.ndarray]:
        """Return the loops and the values of the parameters at points of a curve."""
        count = points.shape[1] - len(self.low)
        return points[:, :count] * self.scales(count // 2), self.low + self.width * points[:, count:]


class FlownLoop(NamedTuple):
    """A loop as it was simulated; phases in rad, rebound speeds in nm/us."""

    loop: Float[np.ndarray, " n"]
    values: Float[np.ndarray, " parameters"]
    gaps: Float[np.ndarray, " n"]
    """By how much the departures miss the next ones: m phases, m rebound speeds."""
    slopes: Float[np.ndarray, "n unknowns"]
    """Their derivatives by departure phases, rebound speeds and parameters."""
    contacts: Any
    """`Contacts`, m rows; of each the one that follows the departure."""
    maps: Float[np.ndarray, "m 2 2"]
    """Derivatives of the next departure's phase and rebound speed by this one's."""

    @property
    def trace_and_determinant(self) -> tuple[float, float]:
        """T and D of the linearised map."""
        whole = np.eye(2)
        for one in self.maps:
            whole = one @ whole
        # the determinant of the product cancels
        return float(np.trace(whole)), float(np.prod(np.linalg.det(self.maps)))


def _closing_slopes(slopes: Float[np.ndarray, "m 2 unknowns"]) -> Float[np.ndarray, "n all"]:
    """Return the derivatives of all gaps of a loop, from those of each contact by its departure and the parameters."""
    count, parameters = len(slopes), slopes.shape[2] - 2
    whole = np.zeros((2, count, 2 * count + parameters))
    places, later = np.arange(count), (np.arange(count) + 1) % count
    for row in range(2):
        for column in range(2):
            whole[row, places, column * count + places] = slopes[:, row, column]
        whole[row, places, row * count + later] -= 1.0
        whole[row, :, 2 * count :] = slopes[:, row, 2:]
    return whole.reshape(2 * count, -1)


class ContactFlights:
    """A contact scene from departure to departure; some of its parameters may move.

    Args:
        scene: one scene with a contact, its numbers known.
        order: N, drive periods in which a loop closes.
        paths: of the parameters.
        accuracy: of `simulate`.
    """

    def __init__(self, scene: Scene, order: int, paths: Sequence[str], *, accuracy: float = DEFAULT_ACCURACY):
        """Make the program, which is compiled when it is first used."""
        self.accuracy = accuracy
        self.order, self._driven = order, driven_part(scene)
        self.family = scene_family(scene, *paths) if paths else lambda: scene

        def one(phase: Array, rebound: Array, until: Array, values: Array) -> tuple[Array, Contacts, Array]:
            def departs(unknowns: Array) -> tuple[Array, Contacts]:
                there = self.family(*unknowns[2:])
                omega = RAD_PER_US_PER_KHZ * getattr(there, self._driven).frequency_khz
                time = unknowns[0] / omega
                velocity = unknowns[1] + there.platform.velocity(time)
                contact = next_contact(there, time, velocity, until / omega, accuracy)
                return jnp.stack([omega * contact.departure_time_us, contact.rebound_speed_nm_per_us]), contact

            (value, contact), slopes = _with_slopes(departs, jnp.concatenate([jnp.stack([phase, rebound]), values]))
            return value, contact, slopes

        self._fly = jax.jit(jax.vmap(one))

    def flown(
        self, loops: Float[np.ndarray, "loops n"], values: Float[np.ndarray, "loops parameters"]
    ) -> list[FlownLoop | None]:
        """Return loops with each of their contacts simulated, all at once; None where one does not end in time.

        Args:
            loops: of each m departure phases in rad and m rebound speeds in nm/us.
            values: of the parameters.
        """
        count, turn = loops.shape[1] // 2, 2.0 * np.pi * self.order
        phase, rebound = loops[:, :count], loops[:, count:]
        following = np.concatenate([phase[:, 1:], phase[:, :1] + turn], axis=1)
        shortest = np.min(following - phase, axis=1, keepdims=True)
        found: list[FlownLoop | None] = [None] * len(loops)
        flies = np.flatnonzero((shortest[:, 0] > 0.0) & (rebound > 0.0).all(axis=1))
        if not flies.size:
            return found
        lanes = (part[flies].ravel() for part in (phase, rebound, following + _LONGEST_CONTACT * shortest))
        whole = (*lanes, np.repeat(values[flies], count, axis=0))
        flown = in_blocks(lambda part: self._fly(*part), whole, block=_LANES, widths=())
        by_loops = jax.tree.map(lambda part: part.reshape(-1, count, *part.shape[1:]), flown)
        for place, one in enumerate(flies):
            later, contacts, slopes = jax.tree.map(lambda part, place=place: part[place], by_loops)
            if (contacts.kind == ContactKind.IMPACT).all() and np.isfinite(slopes).all():
                gaps = np.concatenate([later[:, 0] - following[one], later[:, 1] - np.roll(rebound[one], -1)])
                whole = _closing_slopes(slopes)
                found[one] = FlownLoop(loops[one], values[one], gaps, whole, contacts, slopes[:, :, :2])
        return found

    def readings(
        self, loops: Float[np.ndarray, "loops n"], values: Float[np.ndarray, "loops parameters"]
    ) -> list[LoopReading | None]:
        """Return what there is to know of closed loops, NumPy arrays; arguments as for `flown`."""
        return [None if one is None else self._reading(one) for one in self.flown(loops, values)]

    def _reading(self, flown: FlownLoop) -> LoopReading:
        there, time, rebound = self._departures(flown)
        loop, contacts, count = flown.loop, flown.contacts, len(rebound)
        height, rate = (np.asarray(part) for part in there.platform.position_and_velocity(time))
        breaks, forms = (float(getattr(there.interaction, f"bridge_{what}_nm")) for what in ("breaks", "forms"))
        peaks = peaks_of_flights(there, time, height + breaks, rebound + rate, contacts.arrival_time_us)
        # of the contact before each departure
        approach = np.roll(contacts.approach_speed_nm_per_us, 1)
        lasts = np.roll(contacts.departure_time_us - contacts.arrival_time_us, 1)
        facts = (
            loop[:count] % (2.0 * np.pi),
            rebound + rate,
            np.roll(contacts.arrival_velocity_nm_per_us, 1),
            approach,
            rebound,
            lasts - forms / approach - breaks / rebound,
            np.max(peaks),
            *flown.trace_and_determinant,
            True,
            np.abs(flown.gaps * np.repeat([1.0, 1.0 / rebound.max()], count)).max(),
        )
        return LoopReading(*(jnp.asarray(part) for part in facts))

    def readings_of_points(self, points: Float[np.ndarray, "points n"], units: CurveUnits) -> LoopReading:
        """Return what there is to know of the loops at points of a curve (`solve`), NumPy arrays."""
        read = [one for one in self.readings(*units.of_points(points)) if one is not None]
        if len(read) < len(points):
            raise ValueError("a loop that was closed does not fly")
        return jax.tree.map(lambda *parts: np.stack([np.asarray(part) for part in parts]), *read)

    def _departures(self, flown: FlownLoop) -> tuple[Scene, np.ndarray, np.ndarray]:
        """Return the scene of a loop, its departure times in us and rebound speeds in nm/us."""
        phase, rebound = np.split(flown.loop, 2)
        there = self.family(*flown.values)
        return there, phase / float(RAD_PER_US_PER_KHZ * getattr(there, self._driven).frequency_khz), rebound

    def linearised(self, point: Float[np.ndarray, " n"], units: CurveUnits, kind: int | None) -> EquationsAt | None:
        """Return the closing conditions at a point of a curve, and the test functions there; None where none flies.

        Args:
            point: m phases in rad, m rebound speeds in the unit of speeds, the parameters as shares of their ranges.
            units: of the same.
            kind: number of the test function that is to be 0 besides; None: the loop closes, and that is all.
        """
        # the test function's derivatives are differences, which only lead to its root
        size = len(point)
        around = [np.eye(size), -np.eye(size)] if kind is not None else []
        aside = _DIFFERENCE * np.concatenate([np.zeros((1, size)), *around])
        flown = [one for one in self.flown(*units.of_points(point + aside)) if one is not None]
        if len(flown) < len(aside):
            return None
        here = flown[0]
        scales = units.scales(len(here.loop) // 2)
        value, slopes = here.gaps / scales, here.slopes * np.concatenate([scales, units.width]) / scales[:, None]
        if kind is not None:
            tests = np.array([self.tests(one, units, grazing=kind == _GRAZING)[kind] for one in flown])
            value = np.append(value, tests[0])
            slopes = np.vstack([slopes, (tests[1 : size + 1] - tests[size + 1 :]) / (2.0 * _DIFFERENCE)])
        return EquationsAt(value, slopes, here)

    def tests(self, flown: FlownLoop, units: CurveUnits, *, grazing: bool = True) -> np.ndarray:
        """Return the test functions of `closed_loops`; that of grazing NaN where it is not asked for."""
        trace, determinant = flown.trace_and_determinant
        slowest = np.split(flown.loop, 2)[1].min() / units.speed_nm_per_us
        near = np.nan
        if grazing:
            lowest, omega = _lowest_gap(*self._departures(flown), flown.contacts.arrival_time_us)
            near = float(lowest * omega) / units.speed_nm_per_us
        return np.append(np.array([1.0 - trace, 1.0 + trace, -1.0]) + determinant, [near, slowest])


@jax.jit
def _lowest_gap(scene: Scene, begin_us: Array, rebound: Array, arrival_us: Array) -> tuple[Array, Array]:
    """Return the lowest point of flights between two contacts above the gap at which the bridge forms, in nm.

    Infinite where no flight has one; and the free tip's angular frequency in rad/us.
    """
    surface, _ = surface_of(scene)
    height, rate = surface.position_and_velocity(begin_us)
    contact, still = scene.interaction, jnp.zeros_like(begin_us)
    flights = FreeFlights(begin_us, height + contact.bridge_breaks_nm, rate + rebound, still, arrival_us - begin_us)
    lowest = lowest_of_flights(scene.cantilever, surface, flights, _SAMPLES).gap_nm - contact.bridge_forms_nm
    return lowest, scene.cantilever.angular_frequency
