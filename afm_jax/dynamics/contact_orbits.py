"""Orbits of m contacts in N drive periods: closed by Newton's method on the simulated map from departure to departure.

First guesses are the orbits of the law with delay that comes closest to the contact, unstable ones included, and what
tips come to that are simulated for a while. The map's Jacobian is the forward derivative of the simulation, so that a
loop is closed to rounding and its multipliers are exact.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Shaped

from afm_jax.apparatus.scene import Scene, drive_of
from afm_jax.apparatus.surface import Surface, surface_of
from afm_jax.checks import checked, require_float64
from afm_jax.contact.contact import Contact
from afm_jax.contact.law_of_contact import law_of_contact
from afm_jax.dynamics.impact_loop import LoopFamily, LoopReading, driven_part, lowest_gap
from afm_jax.dynamics.impact_orbits import (
    ManyImpactOrbits,
    check_loop,
    is_stable,
    loops_told_apart,
    many_impact_orbits,
    multipliers_of,
)
from afm_jax.dynamics.many_tips import next_contact, tips_after_contacts
from afm_jax.dynamics.starts import SampleDriven, evenly_spread, laws_of, leaving_tips, sample_driven
from afm_jax.impact.law import Law
from afm_jax.impact.orbits import FlightEnds, SingleImpactOrbits, highest_of_flight, single_impact_orbits
from afm_jax.motion.observe import peaks_of_flights
from afm_jax.motion.record import ContactKind, Contacts, State
from afm_jax.motion.simulate import DEFAULT_ACCURACY
from afm_jax.motion.start import default_start, gap_of_departure
from afm_jax.scenefile.parameter_paths import scene_family
from afm_jax.solve.arclength import EquationsAt, PointInPlane
from afm_jax.solve.lanes import Report, compiled_quickly, in_blocks
from afm_jax.solve.newton import LinearisedRows, Newton, newton_rows, shortened
from afm_jax.units import RAD_PER_US_PER_KHZ

_STARTS = 8
"""Tips that are simulated for guesses, besides the one that starts where `simulate` does."""
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
"""Number of its test function in `curves`."""
_SAMPLES = 512
"""Of a flight, for its lowest points."""
_DIFFERENCE = 1e-5
"""Of unknowns without dimension, for derivatives of test functions."""
_LONGEST_CONTACT = 0.5
"""Time that a contact may take beyond where it was expected to end, in flights of the loop."""


@checked
def contact_orbits(scene: Scene, order: int, impacts: int, *, accuracy: float = DEFAULT_ACCURACY) -> ManyImpactOrbits:
    """Return the orbits of m contacts in N drive periods of a scene with a contact.

    Args:
        scene: one scene with a `Contact`, driven with one period.
        order: N, drive periods until the motion repeats.
        impacts: m, contacts in them.
        accuracy: of `simulate`.

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
    flights = ContactFlights(scene, order, (), accuracy=accuracy)
    loops = contact_loops(flights, np.zeros(0), impacts)
    readings = flights.readings(loops, np.zeros((len(loops), 0)))
    flown = [(reading, loop) for reading, loop in zip(readings, loops, strict=True) if reading is not None]
    flown.sort(key=lambda orbit: -float(orbit[0].peak_amplitude_nm))
    reading = _stacked([reading for reading, _ in flown], impacts)
    multipliers = multipliers_of(np.asarray(reading.trace), np.asarray(reading.determinant))
    loops = np.array([loop for _, loop in flown]).reshape(-1, 2 * impacts)
    return ManyImpactOrbits(loops, reading, multipliers, is_stable(multipliers))


def _stacked(readings: Sequence[LoopReading], impacts: int) -> LoopReading:
    """Return readings of loops of m contacts as one of NumPy arrays with a leading axis of loops."""
    if not readings:
        each, whole = jnp.zeros((0, impacts)), jnp.zeros(0)
        fields = [*[each] * 6, *[whole] * 3, jnp.zeros(0, bool), whole]
        return LoopReading(*fields)
    return jax.tree.map(lambda *numbers: np.stack([np.asarray(number) for number in numbers]), *readings)


def contact_loops(
    flights: "ContactFlights", values: Float[np.ndarray, " parameters"], impacts: int
) -> Float[np.ndarray, "loops n"]:
    """Return the loops of m contacts that are found where parameters have some values, each loop once.

    Args:
        flights: of the scene and its parameters.
        values: of the parameters.
        impacts: m.

    Returns:
        One row a loop: m departure phases in rad, ascending, and m rebound speeds in nm/us.
    """
    scene, order = flights.scene_at(*values), flights.order
    seen = sample_driven(scene)
    guesses = [*_orbits_of_law(scene, order, impacts), *_repetitions(scene, seen, order, impacts, flights.accuracy)]
    loops = _closed(np.array(guesses).reshape(-1, 2 * impacts), flights, values)
    return loops_told_apart(loops, order)


def _orbits_of_law(scene: Scene, order: int, impacts: int) -> Float[np.ndarray, "guesses n"]:
    """Return the orbits of the law with delay closest to the contact, as guesses: m departure phases, m speeds."""
    law = law_of_contact(scene.interaction, float(scene.cantilever.mass_ng))
    if law is None:
        return np.zeros((0, 2 * impacts))
    law_scene = eqx.tree_at(lambda scene: scene.interaction, scene, law)
    if impacts == 1:
        # all of them, close to capture too, where no start of a search stays
        orbits = single_impact_orbits(law_scene, order)
        admissible = np.asarray(orbits.exists & orbits.admissible)
        phases = np.asarray(orbits.phase_rad)[admissible, None]
        rebounds = np.asarray(orbits.rebound_speed_nm_per_us)[admissible, None]
    else:
        reading = many_impact_orbits(law_scene, order, impacts).reading
        phases, rebounds = np.asarray(reading.phase_rad), np.asarray(reading.rebound_speed_nm_per_us)
    # `phase_rad` is within [0, 2 pi), but the impacts follow one another: a phase that falls is one turn later
    turns = np.cumsum(np.diff(phases, axis=1) < 0.0, axis=1)
    starts = phases + 2.0 * np.pi * np.pad(turns, ((0, 0), (1, 0)))
    departures, speeds = _where_contact_ends(scene, starts, rebounds)
    guesses = np.concatenate([departures, speeds], axis=1)
    return guesses[np.isfinite(guesses).all(axis=1) & (speeds > 0.0).all(axis=1)]


def _where_contact_ends(
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
    surface_height, surface_rate = surface.position_and_velocity(begin + after)
    above = np.asarray(position - surface_height) - float(gap_of_departure(scene))
    crossing = np.argmax(above > 0.0, axis=-1)[..., None]
    before = np.take_along_axis(above, np.maximum(crossing - 1, 0), axis=-1)[..., 0]
    behind = np.take_along_axis(above, crossing, axis=-1)[..., 0]
    # linear between two samples
    fraction = np.where(behind > 0.0, behind / np.maximum(behind - before, 1e-300), np.nan)
    rise_us = (crossing[..., 0] - fraction) * after[1]
    speed = np.take_along_axis(np.asarray(velocity - surface_rate), crossing, axis=-1)[..., 0]
    return phases + omega * rise_us, speed


def _repetitions(scene: Scene, seen: SampleDriven, order: int, impacts: int, accuracy: float) -> list[np.ndarray]:
    """Return sequences of m contacts in nearly N drive periods that a few simulated tips come to, as guesses.

    The tips start evenly spread, and where `simulate` starts. They are simulated in the frame in which the drive is a
    platform's: what they come to does not depend on the clock that the drive's phase counts in.
    """
    platform = seen.scenes.platform
    scenes = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (_STARTS + 1, *leaf.shape)), seen.scenes)
    leaving, period = leaving_tips(scenes), float(platform.period_us)
    across, up = evenly_spread(_STARTS).T
    usual = seen.start(default_start(scene))
    time = np.append(period * across, float(usual.time_us))
    faster = float(leaving.velocity_nm_per_us[0] - platform.velocity(leaving.time_us[0])) * (0.5 + 3.0 * up)
    velocity = np.asarray(platform.velocity(time)) + np.append(faster, 0.0)
    velocity[-1] = float(usual.velocity_nm_per_us)
    gap = np.array(leaving.gap_nm)
    gap[-1] = float(usual.position_nm - platform.position(usual.time_us))
    tips = leaving._replace(time_us=time, gap_nm=gap, velocity_nm_per_us=velocity)
    _, record = tips_after_contacts(scenes, tips, skip=_SETTLING, record=2 * impacts + 1, accuracy=accuracy)
    turns = record.departure_periods + record.departure_us / period + float(seen.frame.phase_rad) / (2.0 * np.pi)
    rebound = record.velocity_after_nm_per_us - np.asarray(platform.velocity(record.departure_us))
    guesses = []
    for lane in range(_STARTS + 1):
        for begin in range(impacts + 1):
            window = turns[lane, begin : begin + impacts + 1]
            if abs(window[-1] - window[0] - order) < _WINDOW:
                phases = 2.0 * np.pi * (window[:-1] - np.floor(window[0]))
                guesses.append(np.concatenate([phases, rebound[lane, begin : begin + impacts]]))
    return guesses


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
) -> dict[str, Shaped[np.ndarray, "orders lanes"]]:
    """Return which orbits of one contact there are at many scenes with a contact.

    Every orbit of the law with delay closest to the contact is a guess, from which Newton's method closes the simulated
    map. What the law lacks is not found, and where no guess closes there may be an orbit nevertheless: ``unresolved``.

    Args:
        seen: the scenes, a batch.
        orders: N.
        accuracy: of `simulate`.
        report: called with how far it is, in scenes.

    Returns:
        ``stable``, ``admissible`` and ``unresolved``, and of the stable orbit, the highest if there are several,
        ``peak_amplitude_nm`` and ``largest_multiplier``, NaN where there is none.
    """
    laws = laws_of(jax.tree.map(jnp.asarray, seen.scenes))
    of_orders, lanes = [], len(seen.scenes.platform.frequency_khz)
    for number, order in enumerate(orders, 1):
        of_orders.append(_of_one_order(seen, laws, order, accuracy))
        if report is not None:
            report(number * lanes // len(orders), lanes)
    return {name: np.stack([columns[name] for columns in of_orders]) for name in of_orders[0]}


def _of_one_order(
    seen: SampleDriven, laws: tuple[Law, np.ndarray] | None, order: int, accuracy: float
) -> dict[str, Shaped[np.ndarray, " lanes"]]:
    """Return what `single_contact_orbits` returns, of one order; the laws closest to the contacts as of `laws_of`."""
    scenes = jax.tree.map(jnp.asarray, seen.scenes)
    lanes = len(scenes.platform.frequency_khz)
    columns = {name: np.zeros(lanes, bool) for name in ("stable", "admissible", "unresolved")}
    columns |= {name: np.full(lanes, np.nan) for name in ("peak_amplitude_nm", "largest_multiplier")}
    if laws is None:
        return columns
    law, exists = laws
    with_law, all_seen = np.flatnonzero(exists), jax.tree.map(np.asarray, seen)

    def of_law(block: Scene) -> SingleImpactOrbits:
        return jax.vmap(lambda scene: single_impact_orbits(scene, order))(block)

    law_scenes = jax.tree.map(lambda leaf: leaf[with_law], Scene(scenes.cantilever, scenes.platform, law))
    orbits = in_blocks(of_law, law_scenes, block=_CONTACTS_AT_ONCE)
    row, slot = np.nonzero(orbits.exists & orbits.admissible)
    lane, rebound = with_law[row], orbits.rebound_speed_nm_per_us[row, slot]
    # a straight path to the gap at which contact ends
    rise = np.asarray(scenes.platform.angular_frequency * gap_of_departure(scenes))
    guesses = np.stack([orbits.phase_rad[row, slot] + rise[lane] / rebound, rebound], axis=1)

    def linearised(departures: Float[np.ndarray, "open 2"], rows: Int[np.ndarray, " open"]) -> LinearisedRows:
        def work(block: tuple[SampleDriven, Array, Array, Array]) -> _Return:
            return _returns(*block, accuracy=accuracy)

        turns = np.full(len(rows), 2.0 * np.pi * order)
        flown = jax.tree.map(lambda leaf: leaf[lane[rows]], all_seen), *departures.T, turns
        returns = in_blocks(work, flown, block=_CONTACTS_AT_ONCE)
        scale = np.stack([np.ones(len(rows)), departures[:, 1]], axis=1)
        details = np.stack([returns.trace, returns.determinant, returns.peak_amplitude_nm], axis=1)
        return LinearisedRows(returns.gaps / scale, returns.slopes / scale[:, :, None], list(details))

    roots = newton_rows(linearised, guesses, _CLOSING_A_CHART)
    closed = np.flatnonzero(roots.converged)
    trace, determinant, peak = np.array([roots.details[row] for row in closed]).reshape(-1, 3).T
    multipliers = np.abs(multipliers_of(trace, determinant)[:, 0])
    columns["admissible"][lane[closed]] = True
    columns["unresolved"][lane[~roots.converged]] = True
    columns["unresolved"] &= ~columns["admissible"]
    stable = np.flatnonzero(multipliers < 1.0)
    # the highest last: of several values for one place the last one stays
    stable = stable[np.argsort(peak[stable], kind="stable")]
    place = lane[closed[stable]]
    columns["stable"][place] = True
    columns["peak_amplitude_nm"][place], columns["largest_multiplier"][place] = peak[stable], multipliers[stable]
    return columns


class _Return(NamedTuple):
    """What follows departures after a contact, arrays of one lane each; NaN where the contact does not end in time."""

    gaps: Any
    """By how much the next departure misses this one: phase in rad, rebound speed in nm/us."""
    slopes: Any
    """Derivatives of the gaps by phase and rebound speed."""
    trace: Any
    determinant: Any
    peak_amplitude_nm: Any


@compiled_quickly(static_argnames=("accuracy",))
def _returns(seen: SampleDriven, phase: Array, rebound: Array, turns: Array, *, accuracy: float) -> _Return:
    def return_of(seen: SampleDriven, phase: Array, rebound: Array, turn: Array) -> _Return:
        scene = seen.scenes
        omega, until = scene.platform.angular_frequency, phase + (1.0 + _LONGEST_CONTACT) * turn

        def departs(unknowns: Array) -> tuple[Array, Contacts]:
            return _next_departure(scene, omega, unknowns, until, accuracy)

        unknowns = jnp.stack([phase, rebound])
        (following, contact), slopes = _with_slopes(departs, unknowns)
        closes = following - unknowns - jnp.array([1.0, 0.0]) * turn
        gaps = jnp.where(contact.kind == ContactKind.IMPACT, closes, jnp.nan)
        peak = _peak_of_flight(seen, phase / omega, rebound, contact.arrival_time_us)
        determinant = slopes[0, 0] * slopes[1, 1] - slopes[0, 1] * slopes[1, 0]
        return _Return(gaps, slopes - jnp.eye(2), slopes[0, 0] + slopes[1, 1], determinant, peak)

    return jax.vmap(return_of)(seen, phase, rebound, turns)


def _peak_of_flight(seen: SampleDriven, begin_us: Array, rebound: Array, arrival_us: Array) -> Array:
    """Return the largest height in nm, in the lab, of the flight between two contacts of one scene."""
    scene = seen.scenes
    height, rate = scene.platform.position_and_velocity(begin_us)
    height, velocity, lasts = height + gap_of_departure(scene), rate + rebound, arrival_us - begin_us
    flight = FlightEnds(begin_us, lasts, height, velocity, *scene.cantilever.propagator(lasts)(height, velocity))
    wave, still = seen.frame.response, jnp.zeros_like(begin_us)
    return highest_of_flight(scene.cantilever, flight, None if wave is None else Surface(still, still, (wave,)))


def _next_departure(
    scene: Scene, omega: Array, departure: Array, until_rad: Array, accuracy: float
) -> tuple[Float[Array, " 2"], Contacts]:
    """Return drive phase in rad and rebound speed in nm/us of the departure after this one, and the contact between.

    Args:
        scene: one scene with a contact.
        omega: angular frequency of its drive in rad/us.
        departure: phase and rebound speed.
        until_rad: phase until which the tip is followed.
        accuracy: of `simulate`.
    """
    time = departure[0] / omega
    velocity = departure[1] + scene.platform.velocity(time)
    contact = next_contact(scene, time, velocity, until_rad / omega, accuracy)
    return jnp.stack([omega * contact.departure_time_us, contact.rebound_speed_nm_per_us]), contact


def _with_slopes(function: Callable[[Array], tuple[Array, Any]], unknowns: Array) -> tuple[tuple[Array, Any], Array]:
    """Return a value with what is computed besides, and the value's derivatives, from one simulation forward."""

    def twice(unknowns: Array) -> tuple[Array, Any]:
        value, besides = function(unknowns)
        return value, (value, besides)

    slopes, value_and_besides = jax.jacfwd(twice, has_aux=True)(unknowns)
    return value_and_besides, slopes


_CLOSING = Newton(rounds=25, step_tolerance=1e-10, residual_tolerance=1e-10)
"""Of loops: phases in rad, speeds of the fastest one."""
_CLOSING_A_CHART = Newton(rounds=15, residual_tolerance=1e-7, damping=_damped)
"""Of single contacts: a phase in rad, a speed relative to itself."""


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
        product = np.eye(2)
        for slopes in self.maps:
            product = slopes @ product
        # the determinant of the product cancels
        return float(np.trace(product)), float(np.prod(np.linalg.det(self.maps)))


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
        self.scene_at = scene_family(scene, *paths) if paths else lambda: scene

        def next_departure(phase: Array, rebound: Array, until: Array, values: Array) -> tuple[Array, Contacts, Array]:
            def departs(unknowns: Array) -> tuple[Array, Contacts]:
                there = self.scene_at(*unknowns[2:])
                omega = RAD_PER_US_PER_KHZ * getattr(there, self._driven).frequency_khz
                return _next_departure(there, omega, unknowns[:2], until, accuracy)

            (following, contact), slopes = _with_slopes(departs, jnp.concatenate([jnp.stack([phase, rebound]), values]))
            return following, contact, slopes

        self._fly = jax.jit(jax.vmap(next_departure))

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
        flown_loops: list[FlownLoop | None] = [None] * len(loops)
        flies = np.flatnonzero((shortest[:, 0] > 0.0) & (rebound > 0.0).all(axis=1))
        if not flies.size:
            return flown_loops
        lanes = (part[flies].ravel() for part in (phase, rebound, following + _LONGEST_CONTACT * shortest))
        whole = (*lanes, np.repeat(values[flies], count, axis=0))
        flown = in_blocks(lambda part: self._fly(*part), whole, block=_LANES, widths=())
        by_loops = jax.tree.map(lambda part: part.reshape(-1, count, *part.shape[1:]), flown)
        for place, number in enumerate(flies):
            later, contacts, slopes = jax.tree.map(lambda part, place=place: part[place], by_loops)
            if (contacts.kind == ContactKind.IMPACT).all() and np.isfinite(slopes).all():
                gaps = np.concatenate([later[:, 0] - following[number], later[:, 1] - np.roll(rebound[number], -1)])
                whole = _closing_slopes(slopes)
                flown_loops[number] = FlownLoop(loops[number], values[number], gaps, whole, contacts, slopes[:, :, :2])
        return flown_loops

    def readings(
        self, loops: Float[np.ndarray, "loops n"], values: Float[np.ndarray, "loops parameters"]
    ) -> list[LoopReading | None]:
        """Return what there is to know of closed loops, NumPy arrays; arguments as for `flown`."""
        return [None if loop is None else self._reading(loop) for loop in self.flown(loops, values)]

    def _reading(self, flown: FlownLoop) -> LoopReading:
        there, time, rebound = self.departures(flown)
        loop, contacts, count = flown.loop, flown.contacts, len(rebound)
        height, rate = (np.asarray(part) for part in there.platform.position_and_velocity(time))
        ends, forms = float(gap_of_departure(there)), float(there.interaction.bridge_forms_nm)
        peaks = peaks_of_flights(there, State(time, height + ends, rebound + rate), contacts.arrival_time_us)
        # of the contact before each departure
        approach = np.roll(contacts.approach_speed_nm_per_us, 1)
        lasts = np.roll(contacts.departure_time_us - contacts.arrival_time_us, 1)
        facts = (
            loop[:count] % (2.0 * np.pi),
            rebound + rate,
            np.roll(contacts.arrival_velocity_nm_per_us, 1),
            approach,
            rebound,
            lasts - forms / approach - ends / rebound,
            np.max(peaks),
            *flown.trace_and_determinant,
            True,
            np.abs(flown.gaps * np.repeat([1.0, 1.0 / rebound.max()], count)).max(),
        )
        return LoopReading(*(jnp.asarray(part) for part in facts))

    def departures(self, flown: FlownLoop) -> tuple[Scene, np.ndarray, np.ndarray]:
        """Return the scene of a loop, its departure times in us and rebound speeds in nm/us."""
        phase, rebound = np.split(flown.loop, 2)
        there = self.scene_at(*flown.values)
        return there, phase / float(RAD_PER_US_PER_KHZ * getattr(there, self._driven).frequency_khz), rebound

    def lowest_gap(self, flown: FlownLoop) -> float:
        """Return the lowest point of a loop's flights above the gap at which the bridge forms, in nm times rad/us."""
        lowest, omega = _lowest_gap(*self.departures(flown), flown.contacts.arrival_time_us)
        return float(lowest * omega)


class ContactLoops(LoopFamily):
    """Loops of a scene with a contact, each of whose contacts is simulated."""

    flights: ContactFlights = eqx.field(static=True, kw_only=True)

    def linearised(self, point: Float[np.ndarray, " n"]) -> EquationsAt | None:
        """Return the closing conditions and the wanted test function at a point of a curve; None where none flies."""
        # the test function's derivatives are differences, which only lead to its root
        size = len(point)
        around = [np.eye(size), -np.eye(size)] if self.test is not None else []
        aside = _DIFFERENCE * np.concatenate([np.zeros((1, size)), *around])
        flown = [loop for loop in self.flights.flown(*self.loops_and_values(point + aside)) if loop is not None]
        if len(flown) < len(aside):
            return None
        here = flown[0]
        units = self.units(len(here.loop) // 2)
        value, slopes = here.gaps / units, here.slopes * np.concatenate([units, self.width]) / units[:, None]
        if self.test is not None:
            tests = np.array([self._tests(loop, grazing=self.test == _GRAZING)[self.test] for loop in flown])
            value = np.append(value, tests[0])
            slopes = np.vstack([slopes, (tests[1 : size + 1] - tests[size + 1 :]) / (2.0 * _DIFFERENCE)])
        return EquationsAt(value, slopes, here)

    def tests(self, solved: PointInPlane) -> tuple[Float[np.ndarray, " kinds"], float]:
        """Return the test functions at a point of a curve; of a simulated loop no delay is too long."""
        return self._tests(solved.details), 0.0

    def readings(self, points: Float[np.ndarray, "points n"]) -> LoopReading:
        """Return the readings of the orbits at points of a curve, NumPy arrays."""
        found = self.flights.readings(*self.loops_and_values(points))
        readings = [reading for reading in found if reading is not None]
        if len(readings) < len(points):
            raise ValueError("a loop that was closed does not fly")
        return _stacked(readings, len(readings[0].phase_rad))

    def captures_nothing(self, point: Float[np.ndarray, " n"]) -> bool:  # noqa: ARG002
        """Say no: a contact may capture."""
        return False

    def _tests(self, flown: FlownLoop, *, grazing: bool = True) -> np.ndarray:
        """Return the test functions of `curves`; that of grazing NaN where it is not asked for."""
        trace, determinant = flown.trace_and_determinant
        near, slowest = self.flights.lowest_gap(flown) if grazing else np.nan, np.split(flown.loop, 2)[1].min()
        speeds = np.array([near, slowest]) / float(self.speed_unit)
        return np.append(np.array([1.0 - trace, 1.0 + trace, -1.0]) + determinant, speeds)


@jax.jit
def _lowest_gap(scene: Scene, begin_us: Array, rebound: Array, arrival_us: Array) -> tuple[Array, Array]:
    """Return the lowest point of flights between two contacts above the gap at which the bridge forms, in nm.

    Infinite where no flight has one; and the free tip's angular frequency in rad/us.
    """
    surface, _ = surface_of(scene)
    height, rate = surface.position_and_velocity(begin_us)
    contact, still = scene.interaction, jnp.zeros_like(begin_us)
    flights = begin_us, height + gap_of_departure(scene), rate + rebound, still, arrival_us - begin_us
    lowest = lowest_gap(scene.cantilever, surface, flights, _SAMPLES)
    return lowest - contact.bridge_forms_nm, scene.cantilever.angular_frequency
