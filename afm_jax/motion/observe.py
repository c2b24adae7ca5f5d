"""What an experiment reads of a simulated motion: amplitudes, phases, times, forces, energies.

`OBSERVABLES` is the table of what is read: name with unit, meaning, function of a `MotionWindow`, and why it
may be absent. Text, JSON and sweeps take names and meanings from there. Integrals over time are sums over the Gauss
nodes of a dense path; the stretch is the window of `window_of`: the last response period once a motion has settled,
else whole ones in the last fifth.

A response period has N drive periods, T = N 2 pi/omega. A lock-in reads 2/T int z exp(-i k omega t/N) dt; k = 1 is the
response's frequency and k = N the drive's, where every lock-in reads a tip that base or force drives.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Bool, Float, Int

from afm_jax.apparatus.scene import Scene, drive_of
from afm_jax.apparatus.surface import surface_of
from afm_jax.contact.contact import Contact
from afm_jax.impact.lasting_impact import depth_of_impact, middle_of_contact
from afm_jax.impact.law import Law
from afm_jax.impact.orbits import FlightEnds, peak_amplitude
from afm_jax.motion.record import ContactKind, Simulation, State, to_gap
from afm_jax.motion.settle import Settled, Window, settled, window_of
from afm_jax.motion.trajectory import DensePath, Flights, Trajectory, dense_path, flights_of, fly
from afm_jax.units import RAD_PER_US_PER_KHZ, within_turn

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(12)
_LOADS = 4001
_COVERED = 1e-6
"""Fraction of a window that may be missing from its nodes: rounding."""
_REFINEMENTS = 4
_REFINED = 33
"""Times between two around the best one, of every refinement."""
_GRID = 257
_ZOOMS = 3
TOO_SHORT = "the window is shorter than a response period: follow the motion longer"


class Harmonic(NamedTuple):
    """The motion at a multiple k of the response frequency omega/N: z ~ a cos(k omega t/N + phi)."""

    multiple: int
    """k; N at the drive's frequency."""
    frequency_khz: float
    """k omega/(2 pi N)."""
    amplitude_nm: float
    phase_deg: float
    """In [0, 360/N'): which of the N' = N/gcd(k, N) equivalent periods is locked is unknown."""


class Observables(NamedTuple):
    """What is read of a motion over a window: the quantities of `OBSERVABLES`, and what they are read at.

    None where a quantity does not exist for the scene; NaN where the window is shorter than a response period
    (`window.responses` is 0) and a part of it does not tell the quantity.
    """

    settled: Settled
    window: Window
    contacts: int
    """Contacts that begin in the window."""
    drive_frequency_khz: float
    response_frequency_khz: float
    """The drive's over N."""
    harmonics: tuple[Harmonic, ...]
    """Of the height, at the multiples asked for."""
    deflection_harmonics: tuple[Harmonic, ...] | None
    """Of the deflection z - z_b, at the multiples asked for; None without a moving base."""
    peak_amplitude_nm: float
    lockin_amplitude_nm: float
    lockin_phase_deg: float
    drive_lockin_amplitude_nm: float
    drive_lockin_phase_deg: float
    mean_height_nm: float
    contact_share: float
    time_in_contact_us: float
    peak_force_nn: float | None
    most_attractive_force_nn: float | None
    dissipated_in_contact_aj: float
    dissipated_per_contact_aj: float | None
    dissipated_in_air_aj: float
    given_by_drives_aj: float
    stored_aj: float
    energy_imbalance: float | None
    virial_aj: float
    peak_deflection_nm: float | None
    mean_deflection_nm: float | None
    deflection_lockin_amplitude_nm: float | None
    deflection_lockin_phase_deg: float | None
    deflection_drive_lockin_amplitude_nm: float | None
    deflection_drive_lockin_phase_deg: float | None
    phase_lag_deg: float | None


def observe(
    scene: Scene,
    simulation: Simulation,
    *,
    harmonics: Sequence[int] = (1,),
    verdict: Settled | None = None,
    dense: DensePath | None = None,
) -> Observables:
    """Return what is read of a motion: over the last response period once settled, else the last fifth.

    Where nothing repeats N is the nearest integer to the drive periods between two contacts.

    Args:
        scene: the scene that was simulated.
        simulation: of one scene, not of a batch.
        harmonics: multiples k of the response frequency that are read besides 1 and N, positive integers.
        verdict: what `settled` said, if it is known already.
        dense: the tip over the window and whatever else is looked at, if that is known already.

    Raises:
        ValueError: if a harmonic is not a positive integer, or there are none.
        RuntimeError: if the dense trajectory does not cover the window, its contacts having ended otherwise than the
            simulation's.
    """
    if not harmonics or any(k != int(k) or k < 1 for k in harmonics):
        raise ValueError(f"`harmonics` must be positive integers, but are {tuple(harmonics)}")
    verdict = settled(scene, simulation) if verdict is None else verdict
    window = window_of(scene, simulation, verdict)
    dense = dense_path(scene, simulation, window.from_us, window.to_us) if dense is None else dense
    motion = MotionWindow(dense, window.from_us, window.to_us, window.periods, window.responses)
    motion.check_covered()
    frequency = drive_of(scene).angular_frequency / RAD_PER_US_PER_KHZ
    moving_base = scene.base is not None
    values: dict[str, Any] = {observable.name: observable.of(motion) for observable in OBSERVABLES}
    return Observables(
        settled=verdict,
        window=window,
        contacts=motion.contacts,
        drive_frequency_khz=frequency,
        response_frequency_khz=frequency / window.periods,
        harmonics=tuple(motion.harmonic(int(k)) for k in harmonics),
        deflection_harmonics=tuple(motion.harmonic(int(k), "deflection") for k in harmonics) if moving_base else None,
        **values,
    )


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
    motion = MotionWindow(dense, from_us, to_us)
    value = motion.lockin(motion.heights("height"), angular_frequency)
    lost = np.asarray(dense.simulation.contacts.energy_lost_aj)[motion.begun]
    return Reading(
        peak_amplitude_nm=motion.largest("height"),
        lockin_amplitude_nm=float(abs(value)),
        lockin_phase_deg=float(within_turn(np.degrees(np.angle(value)), 360.0)),
        energy_per_impact_aj=float(lost.mean()) if lost.size else None,
        impacts=int(lost.size),
    )


Coordinate = Literal["height", "deflection"]
"""z above the rest position, or z - z_b: what an optical lever over a moving base sees."""


@dataclass(frozen=True)
class MotionWindow:
    """A motion between two times, integrated over the Gauss nodes of its dense path.

    Attributes:
        dense: the tip between the two times.
        from_us: the beginning.
        to_us: the end.
        periods: N, drive periods in a response period.
        responses: whole response periods in the stretch; 0 where it is shorter than one.
    """

    dense: DensePath
    from_us: float
    to_us: float
    periods: int = 1
    responses: int = 1
    _harmonics: dict[tuple[int, Coordinate], Harmonic] = field(default_factory=dict)

    @property
    def scene(self) -> Scene:
        """The scene that was simulated."""
        return self.dense.scene

    @property
    def span_us(self) -> float:
        """Length of the stretch."""
        return self.to_us - self.from_us

    @property
    def cycles(self) -> float:
        """Length of the stretch in drive periods."""
        return self.span_us / drive_of(self.scene).period_us

    @cached_property
    def nodes(self) -> tuple[Float[np.ndarray, " nodes"], Float[np.ndarray, " nodes"]]:
        """Times and weights in us of the Gauss nodes."""
        return self.dense.nodes(self.from_us, self.to_us)

    @cached_property
    def path(self) -> Trajectory:
        """The tip at the nodes."""
        return self.dense.at(self.nodes[0])

    @cached_property
    def begun(self) -> Bool[np.ndarray, " rows"]:
        """Which contacts begin in the stretch."""
        rows = self.dense.simulation.contacts
        arrival = np.asarray(rows.arrival_time_us)
        return (np.asarray(rows.kind) != ContactKind.NONE) & (arrival >= self.from_us) & (arrival < self.to_us)

    @property
    def contacts(self) -> int:
        """Number of contacts that begin in the stretch."""
        return int(np.count_nonzero(self.begun))

    @cached_property
    def energy(self) -> "EnergyBalance":
        """The energies of the stretch."""
        return energy_balance(self)

    def check_covered(self) -> None:
        """Check that the nodes cover the stretch: integrals over part of it would be wrong in silence.

        Raises:
            RuntimeError: if they do not.
        """
        covered = float(np.sum(self.nodes[1]))
        if not abs(covered - self.span_us) <= _COVERED * self.span_us:
            raise RuntimeError(
                f"the dense trajectory covers {covered:.6g} of the {self.span_us:.6g} us of the window: integrated "
                "once more, a contact ended otherwise than in the simulation, which is not to be trusted there"
            )

    def heights(self, coordinate: Coordinate, path: Trajectory | None = None) -> Float[np.ndarray, "..."]:
        """Return heights or deflections in nm along a path, that of the nodes unless told otherwise."""
        path = self.path if path is None else path
        if coordinate == "height" or self.scene.base is None:
            return path.position_nm
        return path.position_nm - np.asarray(self.scene.base.position_and_velocity(path.time_us)[0])

    def largest(self, coordinate: Coordinate) -> float:
        """Return the largest height or deflection in nm."""
        if coordinate == "height":
            return largest_height(self.dense, self.path, self.from_us, self.to_us)
        return largest_along(self.dense, partial(self.heights, coordinate), self.nodes[0], self.ends_us)

    @property
    def ends_us(self) -> tuple[float, float]:
        """Beginning and end of the stretch."""
        return self.from_us, self.to_us

    def sum_of(self, rates: Float[np.ndarray, " nodes"]) -> float:
        """Return the integral over time of a quantity given at the nodes."""
        return float(np.sum(self.nodes[1] * rates))

    def lockin(self, heights: Float[np.ndarray, " nodes"], angular_frequency: float) -> complex:
        """Return 2/T int z exp(-i nu t) dt in nm; impacts that last add what flights and rests lack."""
        times, weights = self.nodes
        along = np.sum(weights * heights * np.exp(-1j * angular_frequency * times))
        in_impacts = impact_integral(self.scene, self.dense.simulation, *self.ends_us, angular_frequency)
        return 2.0 / self.span_us * (complex(along) + in_impacts)

    def mean(self, coordinate: Coordinate) -> float:
        """Return the mean height or deflection in nm."""
        return 0.5 * self.lockin(self.heights(coordinate), 0.0).real

    def harmonic(self, multiple: int, coordinate: Coordinate = "height") -> Harmonic:
        """Return amplitude and phase at a multiple of the response frequency; NaN of a part of a response period."""
        known = self._harmonics.get((multiple, coordinate))
        if known is not None:
            return known
        omega = multiple * drive_of(self.scene).angular_frequency / self.periods
        value = self.lockin(self.heights(coordinate), omega) if self.responses else complex(math.nan, math.nan)
        turn = 360.0 * math.gcd(multiple, self.periods) / self.periods
        phase = float(within_turn(np.degrees(np.angle(value)), turn))
        harmonic = Harmonic(multiple, omega / RAD_PER_US_PER_KHZ, float(abs(value)), phase)
        return self._harmonics.setdefault((multiple, coordinate), harmonic)

    @property
    def in_contact_us(self) -> float:
        """The time in contact in us; impacts of a law take none."""
        rows = self.dense.simulation.contacts
        kind = np.asarray(rows.kind)
        lasting = kind != ContactKind.NONE if isinstance(self.scene.interaction, Contact) else kind > ContactKind.IMPACT
        begin = np.maximum(np.asarray(rows.arrival_time_us), self.from_us)
        end = np.minimum(np.asarray(rows.departure_time_us), self.to_us)
        return float(np.sum(np.maximum(end - begin, 0.0)[lasting]))

    @property
    def phase_lag_deg(self) -> float | None:
        """By how much the motion at the drive's frequency lags behind base or force; None without either."""
        scene = self.scene
        drive = scene.base if scene.base is not None else scene.force
        if drive is None:
            return None
        at_drive = self.harmonic(self.periods, "height" if scene.base is None else "deflection")
        return within_turn(float(drive.phase_deg) - at_drive.phase_deg, 360.0)

    @cached_property
    def forces_nn(self) -> tuple[float | None, float | None]:
        """The most attractive and the largest repulsive force in nN; None where the contact is not resolved.

        A junction that broke went through all loads of its branch, the least of them included.
        """
        contact, rows, force = self.scene.interaction, self.dense.simulation.contacts, self.path.force_nn
        if not isinstance(contact, Contact) or rows.detail is None or not force.size:
            return None, None
        arrival, departure = np.asarray(rows.arrival_time_us), np.asarray(rows.departure_time_us)
        whole = (np.asarray(rows.kind) != ContactKind.NONE) & (arrival >= self.from_us) & (departure <= self.to_us)
        largest, least = [max(float(force.max()), 0.0)], [min(float(force.min()), 0.0)]
        largest += np.asarray(rows.detail.peak_force_nn)[whole].tolist()
        if np.any(np.asarray(rows.detail.junctions)[whole] > 0):
            solid = contact.solid
            loads = solid.force(np.linspace(float(solid.depth_scale_nm * solid.depth(solid.fold)), 0.0, _LOADS))
            least.append(float(np.min(np.asarray(loads))))
        return min(least), max(largest)

    @property
    def virial_aj(self) -> float:
        """Return 1/T int F z dt in aJ; an impact of a law counts m (V' - V) z, z halfway where it has a delay."""
        scene, rows = self.scene, self.dense.simulation.contacts
        if scene.interaction is None or isinstance(scene.interaction, Contact):
            return self.sum_of(self.path.force_nn * self.path.position_nm) / self.span_us
        impacts = self.begun & (np.asarray(rows.kind) == ContactKind.IMPACT)
        kick = (np.asarray(rows.departure_velocity_nm_per_us) - np.asarray(rows.arrival_velocity_nm_per_us))[impacts]
        height = 0.5 * (np.asarray(rows.departure_position_nm) + np.asarray(rows.arrival_position_nm))[impacts]
        return float(scene.cantilever.mass_ng) * float(np.sum(kick * height)) / self.span_us


class Observable(NamedTuple):
    """A quantity that is read of a motion."""

    name: str
    """With its unit; of the attribute of `Observables`, the JSON key, the variable of a sweep."""
    meaning: str
    read: Callable[[MotionWindow], float | None]
    of_a_part: bool = False
    """Whether a part of a response period tells it."""
    absent: str = ""
    """Why it may be None; empty where it never is."""

    def of(self, motion: MotionWindow) -> float | None:
        """Return the quantity of a stretch; None where the scene has none, NaN where the stretch is too short."""
        value = self.read(motion)
        return value if value is None or self.of_a_part or motion.responses else math.nan


def _with_base(read: Callable[[MotionWindow], float]) -> Callable[[MotionWindow], float | None]:
    """Return a function of stretches that is None without a moving base."""
    return lambda s: None if s.scene.base is None else read(s)


_ONLY_RESOLVED = "only a resolved contact has a force"
_BASE_RESTS = "the base rests: the deflection is the height"
OBSERVABLES = (
    Observable(
        "peak_amplitude_nm", "largest height above the rest position", lambda s: s.largest("height"), of_a_part=True
    ),
    Observable(
        "lockin_amplitude_nm", "amplitude at the response frequency omega/N", lambda s: s.harmonic(1).amplitude_nm
    ),
    Observable("lockin_phase_deg", "phase at the response frequency, modulo 360/N", lambda s: s.harmonic(1).phase_deg),
    Observable(
        "drive_lockin_amplitude_nm",
        "amplitude at the drive's frequency omega",
        lambda s: s.harmonic(s.periods).amplitude_nm,
    ),
    Observable(
        "drive_lockin_phase_deg", "phase at the drive's frequency omega", lambda s: s.harmonic(s.periods).phase_deg
    ),
    Observable("mean_height_nm", "mean height", lambda s: s.mean("height")),
    Observable("contact_share", "share of time in contact", lambda s: s.in_contact_us / s.span_us),
    Observable(
        "time_in_contact_us",
        "time in contact of a response period",
        lambda s: s.in_contact_us / s.cycles * s.periods,
    ),
    Observable(
        "peak_force_nn",
        "largest force on the tip, of a resolved contact",
        lambda s: s.forces_nn[1],
        of_a_part=True,
        absent=_ONLY_RESOLVED,
    ),
    Observable(
        "most_attractive_force_nn",
        "most attractive force on the tip, of a resolved contact",
        lambda s: s.forces_nn[0],
        of_a_part=True,
        absent=_ONLY_RESOLVED,
    ),
    Observable(
        "dissipated_in_contact_aj",
        "energy lost to the sample per drive period",
        lambda s: s.energy.contact_aj / s.cycles,
    ),
    Observable(
        "dissipated_per_contact_aj",
        "energy lost to the sample per contact",
        lambda s: s.energy.contact_aj / s.contacts if s.contacts else None,
        absent="no contact begins in the window",
    ),
    Observable("dissipated_in_air_aj", "energy lost to the air per drive period", lambda s: s.energy.air_aj / s.cycles),
    Observable(
        "given_by_drives_aj", "energy given by the drives per drive period", lambda s: s.energy.given_aj / s.cycles
    ),
    Observable(
        "stored_aj",
        "growth of the energy of tip and spring per drive period; 0 once settled",
        lambda s: s.energy.stored_aj / s.cycles,
    ),
    Observable(
        "energy_imbalance",
        "what the four energies leave unexplained, of the largest; only of a resolved contact",
        lambda s: s.energy.imbalance,
        of_a_part=True,
        absent="with an impact law the energy given by the drives closes the balance",
    ),
    Observable("virial_aj", "mean of force times height", lambda s: s.virial_aj),
    Observable(
        "peak_deflection_nm",
        "largest deflection against a moving base",
        _with_base(lambda s: s.largest("deflection")),
        of_a_part=True,
        absent=_BASE_RESTS,
    ),
    Observable(
        "mean_deflection_nm",
        "mean deflection against a moving base",
        _with_base(lambda s: s.mean("deflection")),
        absent=_BASE_RESTS,
    ),
    Observable(
        "deflection_lockin_amplitude_nm",
        "amplitude of the deflection at the response frequency",
        _with_base(lambda s: s.harmonic(1, "deflection").amplitude_nm),
        absent=_BASE_RESTS,
    ),
    Observable(
        "deflection_lockin_phase_deg",
        "phase of the deflection at the response frequency, modulo 360/N",
        _with_base(lambda s: s.harmonic(1, "deflection").phase_deg),
        absent=_BASE_RESTS,
    ),
    Observable(
        "deflection_drive_lockin_amplitude_nm",
        "amplitude of the deflection at the drive's frequency",
        _with_base(lambda s: s.harmonic(s.periods, "deflection").amplitude_nm),
        absent=_BASE_RESTS,
    ),
    Observable(
        "deflection_drive_lockin_phase_deg",
        "phase of the deflection at the drive's frequency",
        _with_base(lambda s: s.harmonic(s.periods, "deflection").phase_deg),
        absent=_BASE_RESTS,
    ),
    Observable(
        "phase_lag_deg",
        "lag of deflection or height behind base or force at the drive's frequency",
        lambda s: s.phase_lag_deg,
        absent="no base and no force drives the tip",
    ),
)
"""All quantities, in the order in which they are told."""


def why_absent(scene: Scene, seen: Observables) -> dict[str, str]:
    """Return why a quantity is None or NaN, by its name, for each that is."""
    reasons = {}
    for observable in OBSERVABLES:
        value = getattr(seen, observable.name)
        if value is None:
            reasons[observable.name] = observable.absent
        elif not (seen.window.responses or observable.of_a_part):
            reasons[observable.name] = TOO_SHORT
    if scene.interaction is None:
        reasons |= {name: "no contact" for name, reason in reasons.items() if reason == _ONLY_RESOLVED}
    if scene.base is None:
        reasons["deflection_harmonics"] = _BASE_RESTS
    return reasons


class EnergyBalance(NamedTuple):
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


def energy_balance(motion: MotionWindow) -> EnergyBalance:
    """Return the energies of a stretch of time.

    m z'' + (m Omega/Q) z' + k z = F + f + k z_b, times z': with F z' = F D' + F z_p', the drives give
    F z_p' + f z' + k z_b z', air takes (m Omega/Q) z'^2, the contact -F D' but for what its forces store.
    """
    scene, path = motion.scene, motion.path
    cantilever = scene.cantilever
    mass, stiffness = float(cantilever.mass_ng), float(cantilever.stiffness_n_per_m)
    v, ends = path.velocity_nm_per_us, motion.dense.at(np.array(motion.ends_us))
    air = 2.0 * float(cantilever.decay_rate) * mass * motion.sum_of(v * v)
    energy = 0.5 * mass * ends.velocity_nm_per_us**2 + 0.5 * stiffness * ends.position_nm**2
    stored = float(energy[1] - energy[0])
    ledger = _ledger(motion)
    if isinstance(scene.interaction, Law):
        contact = ledger or 0.0
        return EnergyBalance(air + contact + stored, air, contact, stored, None)
    taken = -motion.sum_of(path.force_nn * path.gap_rate_nm_per_us)
    contact = ledger if ledger is not None and not np.any(ends.phase) else taken
    # D' = z' - z_p', whatever else drives the tip
    given = motion.sum_of(path.force_nn * (v - path.gap_rate_nm_per_us))
    if scene.force is not None:
        given += motion.sum_of(np.asarray(scene.force.force(path.time_us)) * v)
    if scene.base is not None:
        given += stiffness * motion.sum_of(np.asarray(scene.base.position_and_velocity(path.time_us)[0]) * v)
    largest = max(abs(given), abs(air), abs(contact), abs(stored))
    imbalance = (given - air - contact - stored) / largest if largest else 0.0
    return EnergyBalance(given, air, contact, stored, imbalance)


def _ledger(motion: MotionWindow) -> float | None:
    """Return what the contacts dissipated, in aJ; None where one of a tip held to the end is among them."""
    rows = motion.dense.simulation.contacts
    lost = float(np.sum(np.asarray(rows.energy_lost_aj)[motion.begun]))
    return None if np.any(np.asarray(rows.kind)[motion.begun] == ContactKind.HELD) else lost


def impact_integral(
    scene: Scene, simulation: Simulation, from_us: float, to_us: float, angular_frequency: float
) -> complex:
    """Return what impacts of a law add to int z exp(-i nu t) dt of flights and rests, in nm us.

    In an impact that lasts the tip is below the surface by the indentation of a Hertz contact (`impact/orbits.py`
    has the same of an orbit). A negative collision delay lets a flight begin before the last one has ended: until then
    both are there, and the surface once too often. Counted are impacts whose middle is in the window.

    Args:
        scene: the scene; anything but a law with a delay has nothing to add.
        simulation: of one scene.
        from_us: beginning of the window.
        to_us: end of the window.
        angular_frequency: nu in rad/us.
    """
    law, rows = scene.interaction, simulation.contacts
    if not isinstance(law, Law) or law.delay is None:
        return 0j
    arrival, departure = np.asarray(rows.arrival_time_us), np.asarray(rows.departure_time_us)
    middle = 0.5 * (arrival + departure)
    impacts = np.flatnonzero((np.asarray(rows.kind) == ContactKind.IMPACT) & (middle >= from_us) & (middle < to_us))
    depth = 0.0
    if law.lasts:
        surface, _ = surface_of(scene)
        approach = jnp.asarray(rows.approach_speed_nm_per_us)[impacts]
        pulled = middle_of_contact(scene.cantilever, surface, jnp.asarray(middle[impacts]))
        depth = np.asarray(depth_of_impact(law, approach, pulled, scene.cantilever, angular_frequency))
    total = -np.sum(depth * np.exp(-1j * angular_frequency * middle[impacts]))
    early = impacts[departure[impacts] < arrival[impacts]]
    return complex(total) + (_overlaps(scene, simulation, early, angular_frequency) if early.size else 0j)


def _overlaps(
    scene: Scene, simulation: Simulation, early: Int[np.ndarray, " impacts"], angular_frequency: float
) -> complex:
    """Return int gap exp(-i nu t) dt of flights from their beginning to the end of the flight before, in nm us."""
    rows, (surface, response) = simulation.contacts, surface_of(scene)
    begin, end = np.asarray(rows.departure_time_us)[early], np.asarray(rows.arrival_time_us)[early]
    half = 0.5 * (end - begin)[:, None]
    times = begin[:, None] + half * (_NODES + 1.0)
    columns = (rows.departure_time_us, rows.departure_position_nm, rows.departure_velocity_nm_per_us)
    departure = State(*(jnp.asarray(column)[early] for column in columns))
    gap, rate = to_gap(surface, response, departure)
    height, speed = surface.position_and_velocity(departure.time_us)
    flight = scene.cantilever.propagator(jnp.asarray(times) - departure.time_us[:, None])
    position, _ = flight((gap + height)[:, None], (rate + speed)[:, None])
    gaps = np.asarray(position - surface.position(jnp.asarray(times)))
    return complex(np.sum(half * _WEIGHTS * gaps * np.exp(-1j * angular_frequency * times)))


def largest_height(dense: DensePath, path: Trajectory, from_us: float, to_us: float) -> float:
    """Return the largest height between two times.

    Args:
        dense: the tip between the two times.
        path: the tip at times in between that resolve contacts and flights, those of `DensePath.nodes`.
        from_us: beginning.
        to_us: end.
    """
    scene = dense.scene
    if scene.base is None and scene.force is None:
        in_flight = _largest_in_flights(scene, dense.simulation, from_us, to_us)
        # no contact comes as high in most motions: then it need not be looked at more closely
        if path.position_nm.size and in_flight >= float(path.position_nm.max()):
            return in_flight
    return largest_along(dense, lambda path: path.position_nm, path.time_us, (from_us, to_us))


def largest_along(
    dense: DensePath,
    quantity: Callable[[Trajectory], np.ndarray],
    times_us: Float[np.ndarray, " times"],
    ends_us: tuple[float, float],
) -> float:
    """Return the largest value of a quantity of trajectories between two times.

    It is evaluated at the given times, then ever closer to the two best ones: a period that begins just before its top
    ends nearly as high.

    Args:
        dense: the tip between the two times.
        quantity: of a trajectory, an array of its times' shape.
        times_us: times to begin with.
        ends_us: the two times.
    """
    times = np.unique(np.concatenate([times_us, ends_us]))
    largest = -np.inf
    for _ in range(_REFINEMENTS + 1):
        values = quantity(dense.at(times))
        largest = max(largest, float(values.max()))
        framed = np.concatenate([[-np.inf], values, [-np.inf]])
        tops = np.flatnonzero((values >= framed[:-2]) & (values >= framed[2:]))
        tops = tops[np.argsort(values[tops])[-2:]]
        around = times[np.maximum(tops - 1, 0)], times[np.minimum(tops + 1, len(times) - 1)]
        times = np.unique(np.linspace(*around, _REFINED))
    return largest


def _largest_in_flights(scene: Scene, simulation: Simulation, from_us: float, to_us: float) -> float:
    """Return the largest height of flights between two times, of a tip that only the sample drives."""
    flights = flights_of(scene, simulation)
    begin, end = np.maximum(flights.begin_us, from_us), np.minimum(flights.end_us, to_us)
    inside = end > begin
    if not inside.any():
        return -np.inf
    position, velocity = fly(scene, Flights(*(column[inside] for column in flights)), begin[inside][None, :])
    return float(peaks_of_flights(scene, begin[inside], position[0], velocity[0], end[inside]).max())


def peaks_of_flights(
    scene: Scene, start_us: ArrayLike, position_nm: ArrayLike, velocity_nm_per_us: ArrayLike, end_us: ArrayLike
) -> Float[np.ndarray, " flights"]:
    """Return the largest height of each of some flights.

    With drives of base or force: a grid over the flight, then finer grids about its highest point; a flight shorter
    than a few dozen periods of the fastest motion is resolved to rounding.

    Args:
        scene: the scene.
        start_us: where the flights start, shape (flights,).
        position_nm: height in the lab there.
        velocity_nm_per_us: velocity in the lab there.
        end_us: where they end.
    """
    _, response = surface_of(scene)
    if response is None:
        start, z, v = (jnp.asarray(column, float) for column in (start_us, position_nm, velocity_nm_per_us))
        duration = jnp.asarray(end_us, float) - start
        flights = FlightEnds(start, duration, z, v, *scene.cantilever.propagator(duration)(z, v))
        return np.asarray(jax.vmap(partial(peak_amplitude, scene.cantilever))(flights))
    start, end = (np.asarray(column, float)[:, None] for column in (start_us, end_us))
    position, velocity = (jnp.asarray(column)[:, None] for column in (position_nm, velocity_nm_per_us))
    steady, rate = response.position_and_velocity(start)
    low, high, heights = start, end, np.zeros(start.shape)
    for _ in range(_ZOOMS):
        times = low + (high - low) * np.linspace(0.0, 1.0, _GRID)
        free, _ = scene.cantilever.propagator(times - start)(position - steady, velocity - rate)
        heights = np.asarray(free + response.position_and_velocity(times)[0])
        top, spacing = np.argmax(heights, axis=1)[:, None], (high - low) / (_GRID - 1)
        peak = np.take_along_axis(times, top, axis=1)
        low, high = np.maximum(peak - spacing, start), np.minimum(peak + spacing, end)
    return heights.max(axis=1)


def peaks_between_contacts(scene: Scene, simulation: Simulation) -> Float[np.ndarray, " flights"]:
    """Return the largest heights of the flights from a contact to the next one, in order."""
    rows = simulation.contacts
    count = int(np.sum(np.asarray(rows.kind) != ContactKind.NONE))
    departures = (rows.departure_time_us, rows.departure_position_nm, rows.departure_velocity_nm_per_us)
    start, position, velocity = (np.asarray(column)[: max(count - 1, 0)] for column in departures)
    return peaks_of_flights(scene, start, position, velocity, np.asarray(rows.arrival_time_us)[1 : max(count, 1)])
