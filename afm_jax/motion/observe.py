"""What an experiment reads of a simulated motion: amplitudes, phases, times, forces, energies, sections.

One way of reading for all: sums over the nodes of a dense path, whose contacts are integrated once more or, where that
would cost more than it tells, straight between the points that the simulation keeps (`dense_path`).

What impacts of a law add to a lock-in beyond flights and rests on the surface: as in `impact/amplitude.py`.

In an impact that lasts the tip is below the surface by the indentation of a Hertz contact. A negative collision delay
lets a flight begin before the last one has ended: until then both are there, and the surface once too often.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Float

from afm_jax.apparatus.scene import DrivePeriod, Scene, drive_of
from afm_jax.apparatus.surface import surface_of
from afm_jax.contact.contact import Contact
from afm_jax.impact.amplitude import FlightEnds, peak_amplitude
from afm_jax.impact.lasting_impact import depth_of_impact, middle_of_contact
from afm_jax.impact.law import Law
from afm_jax.motion.record import ContactKind, MotionOutcome, Simulation, State, to_gap
from afm_jax.motion.settle import Settled, Window, held_since, is_stuck, settled, window_of
from afm_jax.motion.trajectory import DensePath, Trajectory, dense_path, flights_of, fly
from afm_jax.units import RAD_PER_US_PER_KHZ, within_turn

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(12)


def impact_integral(
    scene: Scene, simulation: Simulation, from_us: float, to_us: float, angular_frequency: float
) -> complex:
    """Return what is missing of int z exp(-i nu t) dt in nm us, for the impacts whose middle is in a window.

    Args:
        scene: the scene; anything but a law with a delay has nothing to add.
        simulation: of one scene.
        from_us: beginning of the window.
        to_us: its end.
        angular_frequency: nu in rad/us.
    """
    law, rows = scene.interaction, simulation.contacts
    if not isinstance(law, Law) or law.delay is None:
        return 0j
    arrival, departure = np.asarray(rows.arrival_time_us), np.asarray(rows.departure_time_us)
    middle = 0.5 * (arrival + departure)
    here = np.flatnonzero((np.asarray(rows.kind) == ContactKind.IMPACT) & (middle >= from_us) & (middle < to_us))
    depth = 0.0
    surface, response = surface_of(scene)
    if law.lasts:
        approach = jnp.asarray(rows.approach_speed_nm_per_us)[here]
        pulled = middle_of_contact(scene.cantilever, surface, jnp.asarray(middle[here]))
        depth = np.asarray(depth_of_impact(law, approach, pulled, scene.cantilever, angular_frequency))
    total = -np.sum(depth * np.exp(-1j * angular_frequency * middle[here]))
    early = here[departure[here] < arrival[here]]
    if not early.size:
        return complex(total)
    half = 0.5 * (arrival - departure)[early, None]
    times = departure[early, None] + half * (_NODES + 1.0)
    state = State(
        *(
            jnp.asarray(part)[early]
            for part in (departure, rows.departure_position_nm, rows.departure_velocity_nm_per_us)
        )
    )
    gap, rate = to_gap(surface, response, state)
    height, speed = surface.position_and_velocity(state.time_us)
    flight = scene.cantilever.propagator(jnp.asarray(times) - state.time_us[:, None])
    position, _ = flight((gap + height)[:, None], (rate + speed)[:, None])
    gaps = np.asarray(position - surface.position(jnp.asarray(times)))
    return complex(total + np.sum(half * _WEIGHTS * gaps * np.exp(-1j * angular_frequency * times)))


_LOADS = 4001
_COVERED = 1e-6
"""Share of a window that may be missing from its nodes: rounding."""
_REFINEMENTS = 4
_REFINED = 33
"""Times between two around the best one, of every refinement."""
_GRID = 257
_ZOOMS = 3


class Harmonic(NamedTuple):
    """The motion at a multiple k of the response frequency omega/N: z ~ a cos(k omega t/N + phi)."""

    multiple: int
    """k; N at the drive's frequency."""
    frequency_khz: float
    """k omega/(2 pi N)."""
    amplitude_nm: float
    phase_deg: float
    """In [0, 360/N'): which of the N' = N/gcd(k, N) equivalent periods is locked is unknown."""


NEEDS_A_RESPONSE = (
    "response",
    "drive",
    "harmonics",
    "mean_height_nm",
    "time_in_contact_us",
    "contact_share",
    "dissipated_in_contact_aj",
    "dissipated_per_contact_aj",
    "dissipated_in_air_aj",
    "given_by_drives_aj",
    "stored_aj",
    "virial_aj",
    "deflection_response",
    "deflection_drive",
    "deflection_harmonics",
    "mean_deflection_nm",
    "phase_lag_deg",
)
"""Observables that a part of a response period cannot tell."""
TOO_SHORT = "the window is shorter than a response period: follow the motion longer"


class Observables(NamedTuple):
    """What is read of a motion over a window; None where a quantity does not exist for the scene.

    Of a window shorter than a response period (`window.responses` is 0) all but the largest heights and forces is NaN:
    see `NEEDS_A_RESPONSE`.
    """

    settled: Settled
    window: Window
    peak_amplitude_nm: float
    """Largest height above the rest position."""
    response: Harmonic
    """Of the height at the response frequency omega/N."""
    drive: Harmonic
    """Of the height at the drive's frequency omega, where every lock-in reads a tip that base or force drives."""
    harmonics: tuple[Harmonic, ...]
    """Of the height, those asked for."""
    mean_height_nm: float
    contacts: int
    """Contacts that begin in the window."""
    time_in_contact_us: float
    """Per response period."""
    contact_share: float
    peak_force_nn: float | None
    most_attractive_force_nn: float | None
    dissipated_in_contact_aj: float
    """Per drive period."""
    dissipated_per_contact_aj: float | None
    dissipated_in_air_aj: float
    """Per drive period."""
    given_by_drives_aj: float
    """Per drive period."""
    stored_aj: float
    """By how much the energy of tip and spring grows per drive period; 0 once settled."""
    energy_imbalance: float | None
    """What the four energies leave unexplained, of the largest; None with a law, where the drives close the balance."""
    virial_aj: float
    """Mean of force times height."""
    peak_deflection_nm: float | None
    """Largest z - z_b; None without a moving base, as the four that follow."""
    deflection_response: Harmonic | None
    deflection_drive: Harmonic | None
    deflection_harmonics: tuple[Harmonic, ...] | None
    mean_deflection_nm: float | None
    phase_lag_deg: float | None
    """By how much the deflection over a moving base, else the height, lags behind base or force at the drive's
    frequency; None where the platform alone drives."""

    @property
    def lockin_amplitude_nm(self) -> float:
        """Amplitude of the height at the response frequency omega/N, in nm."""
        return self.response.amplitude_nm

    @property
    def lockin_phase_deg(self) -> float:
        """Phase of the height at the response frequency omega/N, modulo 360/N."""
        return self.response.phase_deg

    @property
    def drive_lockin_amplitude_nm(self) -> float:
        """Amplitude of the height at the drive's frequency omega, in nm."""
        return self.drive.amplitude_nm

    @property
    def drive_lockin_phase_deg(self) -> float:
        """Phase of the height at the drive's frequency omega."""
        return self.drive.phase_deg

    @property
    def deflection_lockin_amplitude_nm(self) -> float | None:
        """Amplitude of the deflection at the response frequency omega/N, in nm; None without a moving base."""
        return None if self.deflection_response is None else self.deflection_response.amplitude_nm

    @property
    def deflection_lockin_phase_deg(self) -> float | None:
        """Phase of the deflection at the response frequency omega/N, modulo 360/N; None without a moving base."""
        return None if self.deflection_response is None else self.deflection_response.phase_deg

    @property
    def deflection_drive_lockin_amplitude_nm(self) -> float | None:
        """Amplitude of the deflection at the drive's frequency omega, in nm; None without a moving base."""
        return None if self.deflection_drive is None else self.deflection_drive.amplitude_nm

    @property
    def deflection_drive_lockin_phase_deg(self) -> float | None:
        """Phase of the deflection at the drive's frequency omega; None without a moving base."""
        return None if self.deflection_drive is None else self.deflection_drive.phase_deg


def observe(
    scene: Scene,
    simulation: Simulation,
    *,
    harmonics: Sequence[int] = (1,),
    verdict: Settled | None = None,
    dense: DensePath | None = None,
) -> Observables:
    """Return what is read of a motion: over the last response period once settled, else the last fifth.

    The lock-in's amplitude and phase are 2/T int z exp(-i k omega t/N) dt over whole response periods T = N 2 pi/omega:
    k = 1 is the response frequency, k = N the drive's; both are always read. Where nothing repeats N is the nearest
    integer to the drive periods between two contacts.

    Args:
        scene: the scene that was simulated.
        simulation: of one scene, not of a batch.
        harmonics: multiples k of the response frequency that are read besides, positive integers.
        verdict: what `settled` said, if it is known already.
        dense: the tip over the window and whatever else is looked at, if that is known already.

    Raises:
        ValueError: if a harmonic is not a positive integer, or there are none.
        RuntimeError: if the dense trajectory does not cover the window, its contacts having ended otherwise than the
            simulation's.
    """
    if not harmonics or any(k != int(k) or k < 1 for k in harmonics):
        raise ValueError(f"`harmonics` must be positive integers, but are {tuple(harmonics)}")
    drive = drive_of(scene)
    verdict = settled(scene, simulation) if verdict is None else verdict
    window = window_of(scene, simulation, verdict)
    begin, end = window.from_us, window.to_us
    dense = dense_path(scene, simulation, begin, end) if dense is None else dense
    times, weights = dense.nodes(begin, end)
    _check_covered(float(np.sum(weights)), end - begin)
    path, ends = dense.at(times), dense.at(np.array([begin, end]))
    energy = _energy_balance(scene, simulation, path, weights, ends)
    span = end - begin
    cycles = span / drive.period_us
    touched, begun = _time_in_contact(scene, simulation, begin, end)
    peak_force, attraction = _forces(scene, simulation, path, window)
    base = scene.base
    deflection = None if base is None else path.position_nm - np.asarray(base.position_and_velocity(times)[0])
    read = partial(_harmonics, dense, times, weights, window, drive, (1, window.periods, *harmonics))
    of_height = read(path.position_nm)
    of_deflection = None if deflection is None else read(deflection)
    seen = Observables(
        settled=verdict,
        window=window,
        peak_amplitude_nm=_peak_height(dense, path, begin, end),
        response=of_height[0],
        drive=of_height[1],
        harmonics=of_height[2:],
        mean_height_nm=_integral(dense, path.position_nm, times, weights, (begin, end), 0.0).real / span,
        contacts=begun,
        time_in_contact_us=touched / cycles * window.periods,
        contact_share=touched / span,
        peak_force_nn=peak_force,
        most_attractive_force_nn=attraction,
        dissipated_in_contact_aj=energy.contact_aj / cycles,
        dissipated_per_contact_aj=energy.contact_aj / begun if begun else None,
        dissipated_in_air_aj=energy.air_aj / cycles,
        given_by_drives_aj=energy.given_aj / cycles,
        stored_aj=energy.stored_aj / cycles,
        energy_imbalance=energy.imbalance,
        virial_aj=_virial(scene, simulation, path, weights, window),
        peak_deflection_nm=None if base is None else _peak_deflection(dense, path, begin, end),
        deflection_response=None if of_deflection is None else of_deflection[0],
        deflection_drive=None if of_deflection is None else of_deflection[1],
        deflection_harmonics=None if of_deflection is None else of_deflection[2:],
        mean_deflection_nm=None
        if deflection is None
        else _integral(dense, deflection, times, weights, (begin, end), 0.0).real / span,
        phase_lag_deg=_lag(scene, (of_deflection or of_height)[1]),
    )
    return seen if window.responses else _of_a_part(seen)


def _of_a_part(seen: Observables) -> Observables:
    """Return readings with NaN for what needs a whole response period."""

    def unknown(value: Any) -> Any:
        if isinstance(value, Harmonic):
            return value._replace(amplitude_nm=math.nan, phase_deg=math.nan)
        if isinstance(value, tuple):
            return tuple(unknown(one) for one in value)
        return None if value is None else math.nan

    return seen._replace(**{name: unknown(getattr(seen, name)) for name in NEEDS_A_RESPONSE})


def _lag(scene: Scene, at_drive: Harmonic) -> float | None:
    """Return by how much the motion at the drive's frequency lags behind base or force; None without."""
    drive = scene.base if scene.base is not None else scene.force
    return None if drive is None else within_turn(float(drive.phase_deg) - at_drive.phase_deg, 360.0)


def _check_covered(found_us: float, wanted_us: float) -> None:
    """Check that the nodes of a window cover it: integrals over part of it would be wrong in silence."""
    if not abs(found_us - wanted_us) <= _COVERED * wanted_us:
        raise RuntimeError(
            f"the dense trajectory covers {found_us:.6g} of the {wanted_us:.6g} us of the window: integrated "
            "once more, a contact ended otherwise than in the simulation, which is not to be trusted there"
        )


def _harmonics(
    dense: DensePath,
    times: Float[np.ndarray, " times"],
    weights: Float[np.ndarray, " times"],
    window: Window,
    drive: DrivePeriod,
    multiples: Sequence[int],
    height: Float[np.ndarray, " times"],
) -> tuple[Harmonic, ...]:
    """Return amplitudes and phases over a window, at multiples of the response frequency."""
    found = {}
    for k in map(int, multiples):
        if k in found:
            continue
        omega = k * drive.angular_frequency / window.periods
        value = _lockin(dense, height, times, weights, (window.from_us, window.to_us), omega)
        turn = 360.0 * math.gcd(k, window.periods) / window.periods
        phase = float(within_turn(np.degrees(np.angle(value)), turn))
        found[k] = Harmonic(k, omega / RAD_PER_US_PER_KHZ, float(abs(value)), phase)
    return tuple(found[int(k)] for k in multiples)


def _time_in_contact(scene: Scene, simulation: Simulation, begin: float, end: float) -> tuple[float, int]:
    """Return the time in contact within a window, and how many contacts begin in it; impacts of a law take no time."""
    rows = simulation.contacts
    kind = np.asarray(rows.kind)
    arrival = np.asarray(rows.arrival_time_us)
    begun = int(np.count_nonzero(_begun(simulation, begin, end)))
    lasting = kind != ContactKind.NONE if isinstance(scene.interaction, Contact) else kind > ContactKind.IMPACT
    stays = np.minimum(np.asarray(rows.departure_time_us), end) - np.maximum(arrival, begin)
    return float(np.sum(np.maximum(stays, 0.0)[lasting])), begun


def _forces(
    scene: Scene, simulation: Simulation, path: Trajectory, window: Window
) -> tuple[float | None, float | None]:
    """Return the largest repulsive and the most attractive force in a window; None where the contact is not resolved.

    A junction that broke went through all loads of its branch, the least of them included.
    """
    contact, detail = scene.interaction, simulation.contacts.detail
    if not isinstance(contact, Contact) or detail is None or not path.force_nn.size:
        return None, None
    rows = simulation.contacts
    arrival, departure = np.asarray(rows.arrival_time_us), np.asarray(rows.departure_time_us)
    here = (np.asarray(rows.kind) != ContactKind.NONE) & (arrival >= window.from_us) & (departure <= window.to_us)
    peaks, least = [max(float(path.force_nn.max()), 0.0)], [min(float(path.force_nn.min()), 0.0)]
    if here.any():
        peaks.append(float(np.asarray(detail.peak_force_nn)[here].max()))
    if np.any(np.asarray(detail.junctions)[here] > 0):
        solid = contact.solid
        loads = solid.force(np.linspace(float(solid.depth_scale_nm * solid.depth(solid.fold)), 0.0, _LOADS))
        least.append(float(np.min(np.asarray(loads))))
    return max(peaks), min(least)


def _virial(scene: Scene, simulation: Simulation, path: Trajectory, weights: np.ndarray, window: Window) -> float:
    """Return 1/T int F z dt over a window; an impact of a law counts m (V' - V) z, z halfway where it has a delay."""
    span = window.to_us - window.from_us
    if scene.interaction is None or isinstance(scene.interaction, Contact):
        return float(np.sum(weights * path.force_nn * path.position_nm)) / span
    rows = simulation.contacts
    arrival = np.asarray(rows.arrival_time_us)
    here = (np.asarray(rows.kind) == ContactKind.IMPACT) & (arrival >= window.from_us) & (arrival < window.to_us)
    kick = (np.asarray(rows.departure_velocity_nm_per_us) - np.asarray(rows.arrival_velocity_nm_per_us))[here]
    height = 0.5 * (np.asarray(rows.departure_position_nm) + np.asarray(rows.arrival_position_nm))[here]
    return float(scene.cantilever.mass_ng) * float(np.sum(kick * height)) / span


class Reading(NamedTuple):
    """What a motion shows in a window of time, in a few numbers."""

    peak_amplitude_nm: float
    """Largest height above the rest position."""
    lockin_amplitude_nm: float
    """2/T |integral z exp(-i omega t)| at the given frequency."""
    lockin_phase_deg: float
    """In [0, 360)."""
    energy_per_impact_aj: float | None
    """None without impacts."""
    impacts: int


def read_window(dense: DensePath, from_us: float, to_us: float, *, angular_frequency: float) -> Reading:
    """Return what a motion shows between two times.

    With contacts that are not integrated once more this is a smooth function of the simulation's numbers.

    Args:
        dense: the tip over the window.
        from_us: beginning of the window.
        to_us: its end.
        angular_frequency: of the lock-in, in rad/us.
    """
    times, weights = dense.nodes(from_us, to_us)
    path = dense.at(times)
    value = _lockin(dense, path.position_nm, times, weights, (from_us, to_us), angular_frequency)
    lost = np.asarray(dense.simulation.contacts.energy_lost_aj)[_begun(dense.simulation, from_us, to_us)]
    return Reading(
        peak_amplitude_nm=_peak_height(dense, path, from_us, to_us),
        lockin_amplitude_nm=float(abs(value)),
        lockin_phase_deg=float(within_turn(np.degrees(np.angle(value)), 360.0)),
        energy_per_impact_aj=float(lost.mean()) if lost.size else None,
        impacts=int(lost.size),
    )


def _lockin(
    dense: DensePath,
    height: np.ndarray,
    times: np.ndarray,
    weights: np.ndarray,
    ends_us: tuple[float, float],
    omega: float,
) -> complex:
    """Return 2/T int z exp(-i omega t) dt."""
    return 2.0 / (ends_us[1] - ends_us[0]) * _integral(dense, height, times, weights, ends_us, omega)


def _integral(
    dense: DensePath,
    height: np.ndarray,
    times: np.ndarray,
    weights: np.ndarray,
    ends_us: tuple[float, float],
    omega: float,
) -> complex:
    """Return int z exp(-i omega t) dt of heights at nodes, with what impacts that last add."""
    along = np.sum(weights * height * np.exp(-1j * omega * times))
    return complex(along) + impact_integral(dense.scene, dense.simulation, *ends_us, omega)


def _begun(simulation: Simulation, from_us: float, to_us: float) -> np.ndarray:
    """Return which contacts begin between two times."""
    arrival = np.asarray(simulation.contacts.arrival_time_us)
    return (np.asarray(simulation.contacts.kind) != ContactKind.NONE) & (arrival >= from_us) & (arrival < to_us)


class _EnergyBalance(NamedTuple):
    """Energies of a stretch of time in aJ: given = air + contact + stored."""

    given_aj: float
    """Work of all drives on the tip; with a law what closes the balance, else an integral of its own."""
    air_aj: float
    contact_aj: float
    """Dissipated by the contacts; from their ledger, or from the work of the force where one is cut."""
    stored_aj: float
    """By how much the tip's kinetic energy and the spring's energy have grown."""
    imbalance: float | None
    """What is left, of the largest of them; None with a law."""


def _energy_balance(
    scene: Scene, simulation: Simulation, path: Trajectory, weights_us: Float[np.ndarray, " times"], ends: Trajectory
) -> _EnergyBalance:
    """Return the energies of a stretch of time.

    m z'' + (m Omega/Q) z' + k z = F + f + k z_b, times z': with F z' = F D' + F z_p', the drives give
    F z_p' + f z' + k z_b z', air takes (m Omega/Q) z'^2, the contact -F D' but for what its forces store.

    Args:
        scene: the scene.
        simulation: of one scene.
        path: its trajectory at the nodes of the stretch.
        weights_us: their weights.
        ends: its trajectory at the two ends.
    """
    cantilever = scene.cantilever
    mass, stiffness = float(cantilever.mass_ng), float(cantilever.stiffness_n_per_m)
    v = path.velocity_nm_per_us
    air = 2.0 * float(cantilever.decay_rate) * mass * float(np.sum(weights_us * v * v))
    energy = 0.5 * mass * ends.velocity_nm_per_us**2 + 0.5 * stiffness * ends.position_nm**2
    stored = float(energy[1] - energy[0])
    resolved = isinstance(scene.interaction, Contact)
    taken = -float(np.sum(weights_us * path.force_nn * path.gap_rate_nm_per_us))
    ledger = _ledger(simulation, float(ends.time_us[0]), float(ends.time_us[1]))
    contact = ledger if ledger is not None and not np.any(ends.phase) else taken
    if scene.interaction is not None and not resolved:
        contact = ledger or 0.0
        return _EnergyBalance(air + contact + stored, air, contact, stored, None)
    # D' = z' - z_p', whatever else drives the tip
    given = float(np.sum(weights_us * path.force_nn * (v - path.gap_rate_nm_per_us)))
    if scene.force is not None:
        given += float(np.sum(weights_us * np.asarray(scene.force.force(path.time_us)) * v))
    if scene.base is not None:
        base = np.asarray(scene.base.position_and_velocity(path.time_us)[0])
        given += stiffness * float(np.sum(weights_us * base * v))
    largest = max(abs(given), abs(air), abs(contact), abs(stored))
    imbalance = (given - air - contact - stored) / largest if largest else 0.0
    return _EnergyBalance(given, air, contact, stored, imbalance)


def _ledger(simulation: Simulation, from_us: float, to_us: float) -> float | None:
    """Return what the contacts within a stretch dissipated; None where one of a tip held to the end is among them."""
    rows = simulation.contacts
    inside = _begun(simulation, from_us, to_us)
    lost = float(np.sum(np.asarray(rows.energy_lost_aj)[inside]))
    return None if np.any(np.asarray(rows.kind)[inside] == ContactKind.HELD) else lost


def _peak_height(dense: DensePath, path: Trajectory, from_us: float, to_us: float) -> float:
    """Return the largest height above the rest position between two times, in nm.

    A tip that only the sample drives flies freely: its highest point in a flight is the first turning point from above,
    or an end. What drives of base or force add, and contacts, are looked at along the path and refined.

    Args:
        dense: the tip between the two times.
        path: the tip at times in between that resolve contacts and flights, those of `nodes`.
        from_us: beginning.
        to_us: end.
    """
    scene = dense.scene
    if scene.base is None and scene.force is None:
        flights = _top_of_flights(scene, dense.simulation, from_us, to_us)
        # no contact comes as high in most motions: then it need not be looked at more closely
        if path.position_nm.size and flights >= float(path.position_nm.max()):
            return flights
    return _refined(dense, _height, path.time_us, (from_us, to_us))


def _peak_deflection(dense: DensePath, path: Trajectory, from_us: float, to_us: float) -> float:
    """Return the largest deflection z - z_b of a tip on a moving base between two times, in nm; arguments as above."""
    base = dense.scene.base
    if base is None:
        return _peak_height(dense, path, from_us, to_us)

    def deflection(path: Trajectory) -> np.ndarray:
        return path.position_nm - np.asarray(base.position_and_velocity(path.time_us)[0])

    return _refined(dense, deflection, path.time_us, (from_us, to_us))


def _height(path: Trajectory) -> np.ndarray:
    return path.position_nm


def _refined(
    dense: DensePath,
    height: Callable[[Trajectory], np.ndarray],
    times_us: np.ndarray,
    ends_us: tuple[float, float],
) -> float:
    """Return the largest value of what `height` makes of a trajectory: on the times, then ever closer to the best.

    To the two best: a period that begins just before its top ends nearly as high.
    """
    times = np.unique(np.concatenate([times_us, ends_us]))
    best = -np.inf
    for _ in range(_REFINEMENTS + 1):
        values = height(dense.at(times))
        best = max(best, float(values.max()))
        framed = np.concatenate([[-np.inf], values, [-np.inf]])
        tops = np.flatnonzero((values >= framed[:-2]) & (values >= framed[2:]))
        tops = tops[np.argsort(values[tops])[-2:]]
        ends = times[np.maximum(tops - 1, 0)], times[np.minimum(tops + 1, len(times) - 1)]
        times = np.unique(np.linspace(*ends, _REFINED))
    return best


def _top_of_flights(scene: Scene, simulation: Simulation, from_us: float, to_us: float) -> float:
    """Return the largest height in nm of flights between two times, of a tip that only the sample drives."""
    flights = flights_of(scene, simulation)
    begin, end = np.maximum(flights.begin_us, from_us), np.minimum(flights.end_us, to_us)
    inside = end > begin
    if not inside.any():
        return -np.inf
    flights = type(flights)(*(part[inside] for part in flights))
    position, velocity = (part[0] for part in fly(scene, flights, begin[inside][None, :]))
    return float(peaks_of_flights(scene, begin[inside], position, velocity, end[inside]).max())


def peaks_of_flights(
    scene: Scene, start_us: ArrayLike, position_nm: ArrayLike, velocity_nm_per_us: ArrayLike, end_us: ArrayLike
) -> Float[np.ndarray, " flights"]:
    """Return the largest height of the tip above its rest position in each flight, in nm.

    A tip that only the sample drives flies freely: its highest point is an end, or the first turning point from above.
    Otherwise a grid over the flight, then finer grids about its highest point: a flight shorter than a few dozen
    periods of the fastest motion is resolved to rounding.

    Args:
        scene: the scene.
        start_us: where the flights start, shape (flights,).
        position_nm: height in the lab there.
        velocity_nm_per_us: velocity in the lab there.
        end_us: where they end.
    """
    _, response = surface_of(scene)
    start, end = (np.asarray(part, float)[:, None] for part in (start_us, end_us))
    position, velocity = (jnp.asarray(part)[:, None] for part in (position_nm, velocity_nm_per_us))
    if response is None:
        start, duration, z, v = (jnp.asarray(part)[:, 0] for part in (start, end - start, position, velocity))
        last_z, last_v = scene.cantilever.propagator(duration)(z, v)
        flights = FlightEnds(start, duration, z, v, last_z, last_v)
        return np.asarray(jax.vmap(partial(peak_amplitude, scene.cantilever))(flights))
    steady, rate = response.position_and_velocity(start)
    position, velocity = position - steady, velocity - rate
    low, high, heights = start, end, np.zeros(start.shape)
    for _ in range(_ZOOMS):
        times = low + (high - low) * np.linspace(0.0, 1.0, _GRID)
        free, _ = scene.cantilever.propagator(times - start)(position, velocity)
        heights = np.asarray(free + response.position_and_velocity(times)[0])
        top, spacing = np.argmax(heights, axis=1)[:, None], (high - low) / (_GRID - 1)
        peak = np.take_along_axis(times, top, axis=1)
        low, high = np.maximum(peak - spacing, start), np.minimum(peak + spacing, end)
    return heights.max(axis=1)


def peaks_between_contacts(scene: Scene, found: Simulation) -> Float[np.ndarray, " flights"]:
    """Return the largest heights in nm of the flights from a contact to the next one, in order."""
    rows = found.contacts
    columns = (
        rows.kind,
        rows.departure_time_us,
        rows.departure_position_nm,
        rows.departure_velocity_nm_per_us,
        rows.arrival_time_us,
    )
    kind, start, position, velocity, arrival = (np.asarray(column) for column in columns)
    used = int(np.sum(kind != ContactKind.NONE))
    left = slice(0, max(used - 1, 0))
    return peaks_of_flights(scene, start[left], position[left], velocity[left], arrival[1 : max(used, 1)])


class Section(NamedTuple):
    """The paper's section: one point a contact that the tip left; arrays of shape (contacts,)."""

    time_us: Float[np.ndarray, " contacts"]
    drive_phase_deg: Float[np.ndarray, " contacts"]
    """Of the departure, in [0, 360)."""
    departure_velocity_nm_per_us: Float[np.ndarray, " contacts"]
    approach_speed_nm_per_us: Float[np.ndarray, " contacts"]


def poincare_section(scene: Scene, simulation: Simulation) -> Section:
    """Return phase of the drive and velocity at every departure, and how fast the tip had come.

    Args:
        scene: the scene that was simulated.
        simulation: of one scene.
    """
    rows = simulation.contacts
    left = _left(simulation)
    time = np.asarray(rows.departure_time_us)[left]
    return Section(
        time_us=time,
        drive_phase_deg=360.0 * within_turn(time / drive_of(scene).period_us, 1.0),
        departure_velocity_nm_per_us=np.asarray(rows.departure_velocity_nm_per_us)[left],
        approach_speed_nm_per_us=np.asarray(rows.approach_speed_nm_per_us)[left],
    )


class Departures(NamedTuple):
    """Every contact that the tip left, and the flight after it; NumPy arrays of one row a contact."""

    scene: Scene
    arrival_time_us: Float[np.ndarray, " contacts"]
    approach_speed_nm_per_us: Float[np.ndarray, " contacts"]
    departure_time_us: Float[np.ndarray, " contacts"]
    departure_position_nm: Float[np.ndarray, " contacts"]
    departure_velocity_nm_per_us: Float[np.ndarray, " contacts"]
    peak_height_nm: Float[np.ndarray, " contacts"]
    """Of the flight after each contact; NaN where it was not followed to its end."""
    begin_us: float
    end_us: float
    """Of what is known; the last departure where there was no room for more contacts."""
    held_from_us: float | None
    """When the contact began that holds the tip to the end (`is_stuck`); None if none does."""

    @property
    def captured(self) -> bool:
        """Whether the sample holds the tip at the end."""
        return self.held_from_us is not None

    @property
    def drive_phase_deg(self) -> Float[np.ndarray, " contacts"]:
        """Phase of the drive at each departure."""
        return 360.0 * within_turn(self.departure_time_us / drive_of(self.scene).period_us, 1.0)

    def path(self, points: int = 24) -> Float[np.ndarray, "2 times"]:
        """Return times in us and heights in nm along all flights that ended, a straight line through every contact."""
        begin, stop = self.departure_time_us[:-1, None], self.arrival_time_us[1:, None]
        times = begin + (stop - begin) * np.linspace(0.0, 1.0, points)
        position, velocity = (
            jnp.asarray(part)[:-1, None] for part in (self.departure_position_nm, self.departure_velocity_nm_per_us)
        )
        heights, _ = self.scene.cantilever.propagator(times - begin)(position, velocity)
        return np.stack([times.reshape(-1), np.asarray(heights).reshape(-1)])


def departures(scene: Scene, simulation: Simulation) -> Departures:
    """Return the contacts that the tip left, of one scene that its platform alone drives."""
    rows = simulation.contacts
    left = _left(simulation)
    columns = (
        rows.arrival_time_us,
        rows.approach_speed_nm_per_us,
        rows.departure_time_us,
        rows.departure_position_nm,
        rows.departure_velocity_nm_per_us,
    )
    columns = [np.asarray(column)[left] for column in columns]
    peaks = peaks_between_contacts(scene, simulation)
    full = simulation.outcome == MotionOutcome.CONTACT_LIMIT
    return Departures(
        scene,
        *columns,
        peak_height_nm=np.append(peaks, np.full(columns[0].size - peaks.size, np.nan)),
        begin_us=float(simulation.start.time_us),
        end_us=float(columns[2][-1]) if full and columns[2].size else float(simulation.final.time_us),
        held_from_us=held_since(simulation) if is_stuck(scene, simulation) else None,
    )


def _left(simulation: Simulation) -> np.ndarray:
    """Return which contacts the tip left."""
    return np.isin(np.asarray(simulation.contacts.kind), (ContactKind.IMPACT, ContactKind.CHATTER))
