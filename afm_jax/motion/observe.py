"""What an instrument reads of a simulated motion: amplitudes, phases, times, forces, energies.

`Observables` is the table: a row is a quantity, its name with the unit, its meaning, its formula (a function of a
`MotionWindow`) and why a scene may not have it. Its names are the JSON keys of `afm-jax simulate` and the columns of
sweeps, so that a new quantity is a new row here.

A response period has N drive periods, T = N 2 pi/omega. Over a window of n response periods a lock-in at the angular
frequency nu in rad/us returns 2/(n T) int z exp(-i nu t) dt in nm. It is evaluated at nu = omega/N, the frequency of
the response; at nu = omega, where instruments demodulate a tip that is driven by its base or by a force; and at any
other multiple k omega/N. Integrals over time are sums over the Gauss nodes of a dense path. The window (`window_of`) is
the last response period once a motion has settled, else the whole response periods in the last fifth of the motion.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated, Any, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.drives import BaseDrive
from afm_jax.apparatus.scene import Scene, drive_of
from afm_jax.apparatus.surface import Surface, surface_of
from afm_jax.contact.contact import Contact
from afm_jax.contact.forces.force import ElasticCurve
from afm_jax.impact.lasting_impact import depth_of_impact, middle_of_contact
from afm_jax.impact.law import Law
from afm_jax.impact.orbits import FlightEnds, highest_of_flight
from afm_jax.motion.record import ContactKind, Contacts, Simulation, State, contacts_left, to_gap, with_response
from afm_jax.motion.settle import Settled, Window, settled, window_of
from afm_jax.motion.trajectory import DensePath, Trajectory, dense_path
from afm_jax.units import RAD_PER_US_PER_KHZ, within_turn

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(12)
_LOADS = 4001
"""Points on the junction's load curve at which its most attractive force is searched for."""
_COVERED = 1e-6
"""Fraction of a window that may be missing from its nodes: rounding."""
_REFINEMENTS = 4
_REFINED = 33
"""Times between two around the best one, of every refinement."""
TOO_SHORT = "the window is shorter than a response period: follow the motion longer"
_ONLY_RESOLVED = "only a resolved contact has a force"
_BASE_RESTS = "the base rests: the deflection is the height"


class Harmonic(NamedTuple):
    """The motion at a multiple k of the response frequency omega/N: z ~ a cos(k omega t/N + phi)."""

    multiple: int
    """k; N at the drive's frequency."""
    frequency_khz: float
    """k omega/(2 pi N)."""
    amplitude_nm: float
    phase_deg: float
    """In [0, 360/N') with N' = N/gcd(k, N): a response may lock to any of its N drive periods, which shifts the phase
    of this harmonic by multiples of 360/N'."""


@dataclass(frozen=True)
class Observable:
    """How a quantity is read of a motion."""

    meaning: str
    read: Callable[["MotionWindow"], float | None]
    """The formula; None where the scene has no such quantity."""
    absent: str = ""
    """Why there may be none; empty where every motion has it."""
    of_a_part: bool = False
    """Whether a window shorter than a response period tells it; else the quantity is NaN there."""
    name: str = ""
    """With the unit: the attribute of `Observables`, the JSON key, the column of a sweep."""

    def of(self, motion: "MotionWindow") -> float | None:
        """Return the quantity of a window; None where the scene has none, NaN where the window is too short."""
        value = self.read(motion)
        return value if value is None or self.of_a_part or motion.responses else math.nan


def _of_deflection(meaning: str, read: Callable[["Signal"], float], *, of_a_part: bool = False) -> Observable:
    """Return how a quantity of the deflection against a moving base is read."""
    return Observable(meaning, lambda m: m.deflection and read(m.deflection), _BASE_RESTS, of_a_part)


class Observables(NamedTuple):
    """What is read of a motion over a window: the window, and the quantities of the table."""

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

    # the table: m is the motion in its window
    peak_amplitude_nm: Annotated[
        float, Observable("largest height above the rest position", lambda m: m.height.largest, of_a_part=True)
    ]
    lockin_amplitude_nm: Annotated[
        float, Observable("amplitude at the response frequency omega/N", lambda m: m.height.at_response.amplitude_nm)
    ]
    lockin_phase_deg: Annotated[
        float, Observable("phase at the response frequency, modulo 360/N", lambda m: m.height.at_response.phase_deg)
    ]
    drive_lockin_amplitude_nm: Annotated[
        float, Observable("amplitude at the drive's frequency omega", lambda m: m.height.at_drive.amplitude_nm)
    ]
    drive_lockin_phase_deg: Annotated[
        float, Observable("phase at the drive's frequency omega", lambda m: m.height.at_drive.phase_deg)
    ]
    mean_height_nm: Annotated[float, Observable("mean height", lambda m: m.height.mean)]
    contact_share: Annotated[float, Observable("fraction of time in contact", lambda m: m.in_contact_us / m.span_us)]
    time_in_contact_us: Annotated[
        float,
        Observable("time in contact of a response period", lambda m: m.in_contact_us / m.cycles * m.periods),
    ]
    peak_force_nn: Annotated[
        float | None,
        Observable(
            "largest force on the tip, of a resolved contact", lambda m: m.forces_nn[1], _ONLY_RESOLVED, of_a_part=True
        ),
    ]
    most_attractive_force_nn: Annotated[
        float | None,
        Observable(
            "most attractive force on the tip, of a resolved contact",
            lambda m: m.forces_nn[0],
            _ONLY_RESOLVED,
            of_a_part=True,
        ),
    ]
    dissipated_in_contact_aj: Annotated[
        float, Observable("energy lost to the sample per drive period", lambda m: m.energy.contact_aj / m.cycles)
    ]
    dissipated_per_contact_aj: Annotated[
        float | None,
        Observable(
            "energy lost to the sample per contact",
            lambda m: m.energy.contact_aj / m.contacts if m.contacts else None,
            "no contact begins in the window",
        ),
    ]
    dissipated_in_air_aj: Annotated[
        float, Observable("energy lost to the air per drive period", lambda m: m.energy.air_aj / m.cycles)
    ]
    given_by_drives_aj: Annotated[
        float, Observable("energy given by the drives per drive period", lambda m: m.energy.given_aj / m.cycles)
    ]
    stored_aj: Annotated[
        float,
        Observable(
            "growth of the energy of tip and spring per drive period; 0 once settled",
            lambda m: m.energy.stored_aj / m.cycles,
        ),
    ]
    energy_imbalance: Annotated[
        float | None,
        Observable(
            "what the four energies leave unexplained, of the largest; only of a resolved contact",
            lambda m: m.energy.imbalance,
            "with an impact law the energy given by the drives closes the balance",
            of_a_part=True,
        ),
    ]
    virial_aj: Annotated[float, Observable("mean of force times height", lambda m: m.virial_aj)]
    peak_deflection_nm: Annotated[
        float | None,
        _of_deflection("largest deflection against a moving base", lambda s: s.largest, of_a_part=True),
    ]
    mean_deflection_nm: Annotated[
        float | None, _of_deflection("mean deflection against a moving base", lambda s: s.mean)
    ]
    deflection_lockin_amplitude_nm: Annotated[
        float | None,
        _of_deflection("amplitude of the deflection at the response frequency", lambda s: s.at_response.amplitude_nm),
    ]
    deflection_lockin_phase_deg: Annotated[
        float | None,
        _of_deflection(
            "phase of the deflection at the response frequency, modulo 360/N", lambda s: s.at_response.phase_deg
        ),
    ]
    deflection_drive_lockin_amplitude_nm: Annotated[
        float | None,
        _of_deflection("amplitude of the deflection at the drive's frequency", lambda s: s.at_drive.amplitude_nm),
    ]
    deflection_drive_lockin_phase_deg: Annotated[
        float | None,
        _of_deflection("phase of the deflection at the drive's frequency", lambda s: s.at_drive.phase_deg),
    ]
    phase_lag_deg: Annotated[
        float | None,
        Observable(
            "lag of deflection or height behind base or force at the drive's frequency",
            lambda m: m.phase_lag_deg,
            "no base and no force drives the tip",
        ),
    ]


OBSERVABLES: tuple[Observable, ...] = tuple(
    replace(row, name=name)
    for name, hint in Observables.__annotations__.items()
    for row in get_args(hint)
    if isinstance(row, Observable)
)
"""The rows of the table, in the order of the output."""


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
    height, deflection = motion.height, motion.deflection
    values: dict[str, Any] = {observable.name: observable.of(motion) for observable in OBSERVABLES}
    return Observables(
        settled=verdict,
        window=window,
        contacts=motion.contacts,
        drive_frequency_khz=frequency,
        response_frequency_khz=frequency / window.periods,
        harmonics=tuple(height.harmonic(int(k)) for k in harmonics),
        deflection_harmonics=None if deflection is None else tuple(deflection.harmonic(int(k)) for k in harmonics),
        **values,
    )


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


@dataclass(frozen=True)
class MotionWindow:
    """A motion between two times: what the formulas of the table are made of.

    Attributes:
        dense: the tip between the two times.
        from_us: the beginning.
        to_us: the end.
        periods: N, drive periods in a response period.
        responses: whole response periods in the window; 0 where it is shorter than one.
    """

    dense: DensePath
    from_us: float
    to_us: float
    periods: int = 1
    responses: int = 1

    @property
    def scene(self) -> Scene:
        """The scene that was simulated."""
        return self.dense.scene

    @property
    def span_us(self) -> float:
        """Length of the window."""
        return self.to_us - self.from_us

    @property
    def cycles(self) -> float:
        """Length of the window in drive periods."""
        return self.span_us / drive_of(self.scene).period_us

    @cached_property
    def nodes(self) -> tuple[Float[np.ndarray, " nodes"], Float[np.ndarray, " nodes"]]:
        """Times and weights in us of the Gauss nodes."""
        return self.dense.nodes(self.from_us, self.to_us)

    @cached_property
    def path(self) -> Trajectory:
        """The tip at the nodes."""
        return self.dense.at(self.nodes[0])

    def integral(self, rates: Float[np.ndarray, " nodes"]) -> float:
        """Return the integral over time, in us, of a quantity given at the nodes."""
        return float(np.sum(self.nodes[1] * rates))

    def check_covered(self) -> None:
        """Check that the nodes cover the window: integrals over part of it would be wrong in silence.

        Raises:
            RuntimeError: if they do not.
        """
        covered = float(np.sum(self.nodes[1]))
        if not abs(covered - self.span_us) <= _COVERED * self.span_us:
            raise RuntimeError(
                f"the dense trajectory covers {covered:.6g} of the {self.span_us:.6g} us of the window: integrated "
                "once more, a contact ended otherwise than in the simulation, which is not to be trusted there"
            )

    @cached_property
    def rows(self) -> Contacts:
        """All contacts of the simulation, as arrays of NumPy's."""
        return jax.tree.map(np.asarray, self.dense.simulation.contacts)

    @cached_property
    def begun(self) -> Bool[np.ndarray, " rows"]:
        """Which contacts begin in the window."""
        kind, arrival = np.asarray(self.rows.kind), self.rows.arrival_time_us
        return np.asarray((kind != ContactKind.NONE) & (arrival >= self.from_us) & (arrival < self.to_us))

    @property
    def contacts(self) -> int:
        """Number of contacts that begin in the window."""
        return int(np.count_nonzero(self.begun))

    @property
    def in_contact_us(self) -> float:
        """Time in contact; impacts of a law take none, but for rests on the sample."""
        lasting = self.rows.kind > (ContactKind.NONE if self._resolved else ContactKind.IMPACT)
        begin = np.maximum(self.rows.arrival_time_us, self.from_us)
        end = np.minimum(self.rows.departure_time_us, self.to_us)
        return float(np.sum(np.maximum(end - begin, 0.0)[lasting]))

    @property
    def _resolved(self) -> bool:
        return isinstance(self.scene.interaction, Contact)

    @cached_property
    def height(self) -> "Signal":
        """The tip's height z above its rest position."""
        return Signal(self, None)

    @cached_property
    def deflection(self) -> "Signal | None":
        """The deflection z - z_b, which an optical lever over a moving base sees; None where the base rests."""
        return None if self.scene.base is None else Signal(self, self.scene.base)

    @property
    def phase_lag_deg(self) -> float | None:
        """Lag of the motion at the drive's frequency behind base (deflection) or force (height); None without them."""
        drive = self.scene.base or self.scene.force
        if drive is None:
            return None
        return within_turn(float(drive.phase_deg) - (self.deflection or self.height).at_drive.phase_deg, 360.0)

    @cached_property
    def forces_nn(self) -> tuple[float | None, float | None]:
        """The most attractive and the largest repulsive force in nN; None where the contact is not resolved.

        A contact that lies in the window counts with its largest load and, if its junction formed, with all loads of
        the junction's branch, which it went through until the junction broke.
        """
        detail, force = self.rows.detail, self.path.force_nn
        if not self._resolved or detail is None or not force.size:
            return None, None
        whole = (self.rows.kind != ContactKind.NONE) & (self.rows.arrival_time_us >= self.from_us)
        whole &= self.rows.departure_time_us <= self.to_us
        loads = [0.0, float(force.min()), float(force.max()), *np.asarray(detail.peak_force_nn)[whole].tolist()]
        if np.any(np.asarray(detail.junctions)[whole] > 0):
            solid = self.scene.interaction.solid
            depths = np.linspace(float(solid.depth_scale_nm * solid.depth(solid.fold)), 0.0, _LOADS)
            loads.append(float(_least_force(solid, depths)))
        return min(loads), max(loads)

    @property
    def virial_aj(self) -> float:
        """1/T int F z dt in aJ; an impact of a law counts m (V' - V) z, z halfway where it has a delay."""
        if self.scene.interaction is None or self._resolved:
            return self.integral(self.path.force_nn * self.path.position_nm) / self.span_us
        rows, impacts = self.rows, self.begun & (self.rows.kind == ContactKind.IMPACT)
        kick = (rows.departure_velocity_nm_per_us - rows.arrival_velocity_nm_per_us)[impacts]
        height = 0.5 * (rows.departure_position_nm + rows.arrival_position_nm)[impacts]
        return float(self.scene.cantilever.mass_ng) * float(np.sum(kick * height)) / self.span_us

    @cached_property
    def energy(self) -> "EnergyBalance":
        """The energies of the window in aJ."""
        return _energy_balance(self)


@dataclass(frozen=True)
class Signal:
    """What a detector shows of the tip in a window: its height, or its deflection against a moving base.

    Attributes:
        motion: the tip in its window.
        against: the base whose motion is subtracted; None: the height.
    """

    motion: MotionWindow
    against: BaseDrive | None

    def along(self, path: Trajectory) -> Float[np.ndarray, "..."]:
        """Return the signal in nm along a path."""
        if self.against is None:
            return path.position_nm
        return path.position_nm - np.asarray(self.against.position_and_velocity(path.time_us)[0])

    @property
    def largest(self) -> float:
        """Largest value in nm."""
        motion = self.motion
        return largest_along(motion.dense, self.along, motion.nodes[0], (motion.from_us, motion.to_us))

    @property
    def mean(self) -> float:
        """The mean of the signal over the window, in nm."""
        return 0.5 * self.lockin(0.0).real

    def lockin(self, angular_frequency: float) -> complex:
        """Return 2/T int z exp(-i nu t) dt in nm over the window's length T.

        Args:
            angular_frequency: nu in rad/us.
        """
        motion, (times, weights) = self.motion, self.motion.nodes
        along = np.sum(weights * self.along(motion.path) * np.exp(-1j * angular_frequency * times))
        return 2.0 / motion.span_us * (complex(along) + _integral_in_impacts(motion, angular_frequency))

    def harmonic(self, multiple: int) -> Harmonic:
        """Return amplitude and phase at a multiple of the response frequency; NaN of a part of a response period."""
        periods = self.motion.periods
        omega = multiple * drive_of(self.motion.scene).angular_frequency / periods
        value = self.lockin(omega) if self.motion.responses else complex(math.nan, math.nan)
        turn = 360.0 * math.gcd(multiple, periods) / periods
        phase = float(within_turn(np.degrees(np.angle(value)), turn))
        return Harmonic(multiple, omega / RAD_PER_US_PER_KHZ, float(abs(value)), phase)

    @cached_property
    def at_response(self) -> Harmonic:
        """The motion at the response's frequency omega/N."""
        return self.harmonic(1)

    @cached_property
    def at_drive(self) -> Harmonic:
        """The motion at the drive's frequency omega."""
        return self.at_response if self.motion.periods == 1 else self.harmonic(self.motion.periods)


class EnergyBalance(NamedTuple):
    """Energies of a window in aJ: given = air + contact + stored."""

    given_aj: float
    """Work of all drives on the tip; with a law what closes the balance, else an integral of its own."""
    air_aj: float
    contact_aj: float
    """Dissipated by the contacts: the sum of their losses (an impact of a law that ends held has lost all its energy
    relative to the surface), or -int F D' dt over the window where it cuts a resolved contact."""
    stored_aj: float
    """By how much the tip's kinetic energy and the spring's energy have grown."""
    imbalance: float | None
    """What is left, of the largest of them; None with a law."""


def _energy_balance(motion: MotionWindow) -> EnergyBalance:
    """Return the energies of a window in aJ, from the equation of motion multiplied by z'.

    m z'' + (m Omega/Q) z' + k z = F + f + k z_b, with the contact force F, the drive force f and the base z_b. The gap
    D and the platform z_p split the contact's power, F z' = F D' + F z_p'. Drives give F z_p' + f z' + k z_b z', air
    dissipates (m Omega/Q) z'^2, and the contact receives -F D', and returns the part of conservative forces.
    """
    scene, path = motion.scene, motion.path
    cantilever = scene.cantilever
    mass, stiffness = float(cantilever.mass_ng), float(cantilever.stiffness_n_per_m)
    v, ends = path.velocity_nm_per_us, motion.dense.at(np.array([motion.from_us, motion.to_us]))
    air = 2.0 * float(cantilever.decay_rate) * mass * motion.integral(v * v)
    energy = 0.5 * mass * ends.velocity_nm_per_us**2 + 0.5 * stiffness * ends.position_nm**2
    stored = float(energy[1] - energy[0])
    contact = float(np.sum(motion.rows.energy_lost_aj[motion.begun]))
    if isinstance(scene.interaction, Law):
        return EnergyBalance(air + contact + stored, air, contact, stored, None)
    # a contact that the window cuts has lost what its ledger does not tell yet
    if np.any(motion.rows.kind[motion.begun] == ContactKind.HELD) or np.any(ends.phase):
        contact = -motion.integral(path.force_nn * path.gap_rate_nm_per_us)
    # D' = z' - z_p', whatever else drives the tip
    given = motion.integral(path.force_nn * (v - path.gap_rate_nm_per_us))
    if scene.force is not None:
        given += motion.integral(np.asarray(scene.force.force(path.time_us)) * v)
    if scene.base is not None:
        given += stiffness * motion.integral(np.asarray(scene.base.position_and_velocity(path.time_us)[0]) * v)
    largest = max(abs(given), abs(air), abs(contact), abs(stored))
    imbalance = (given - air - contact - stored) / largest if largest else 0.0
    return EnergyBalance(given, air, contact, stored, imbalance)


def _integral_in_impacts(motion: MotionWindow, angular_frequency: float) -> complex:
    """Return what impacts of a law add to int z exp(-i nu t) dt of flights and rests, in nm us.

    An impact that lasts, with its middle at t_m, adds -I exp(-i nu t_m), where I is the time integral in nm us of the
    indentation of a Hertz contact (`depth_of_impact`; `impact/orbits.py` does this for an orbit). With a negative
    collision delay a flight begins before the previous one has ended. While they overlap, the motion counts as the sum
    of both heights less that of the surface: the nodes hold the earlier flight, and the gap of the later one is added.
    Impacts whose middle is in the window count.

    Args:
        motion: of any scene; only a law with a delay has something to add.
        angular_frequency: nu in rad/us.
    """
    law, rows = motion.scene.interaction, motion.rows
    if not isinstance(law, Law) or law.delay is None:
        return 0j
    arrival, departure = rows.arrival_time_us, rows.departure_time_us
    middle = 0.5 * (arrival + departure)
    inside = (rows.kind == ContactKind.IMPACT) & (middle >= motion.from_us) & (middle < motion.to_us)
    impacts = np.flatnonzero(inside)
    depth = 0.0
    if law.lasts:
        cantilever, (surface, _) = motion.scene.cantilever, surface_of(motion.scene)
        at_middle = middle_of_contact(cantilever, surface, jnp.asarray(middle[impacts]))
        approach = jnp.asarray(rows.approach_speed_nm_per_us)[impacts]
        depth = np.asarray(depth_of_impact(law, approach, at_middle, cantilever, angular_frequency))
    total = -np.sum(depth * np.exp(-1j * angular_frequency * middle[impacts]))
    early = impacts[departure[impacts] < arrival[impacts]]
    return complex(total) + (_integral_of_overlaps(motion, early, angular_frequency) if early.size else 0j)


def _integral_of_overlaps(
    motion: MotionWindow, early: Int[np.ndarray, " impacts"], angular_frequency: float
) -> complex:
    """Return int gap exp(-i nu t) dt of flights from their beginning to the end of the flight before, in nm us."""
    rows, (surface, response) = motion.rows, surface_of(motion.scene)
    columns = (rows.departure_time_us, rows.departure_position_nm, rows.departure_velocity_nm_per_us)
    departure = State(*(jnp.asarray(column)[early] for column in columns))
    half = 0.5 * (rows.arrival_time_us[early] - rows.departure_time_us[early])[:, None]
    times = rows.departure_time_us[early][:, None] + half * (_NODES + 1.0)
    gap, rate = to_gap(surface, response, departure)
    height, speed = surface.position_and_velocity(departure.time_us)
    flight = motion.scene.cantilever.propagator(jnp.asarray(times) - departure.time_us[:, None])
    position, _ = flight((gap + height)[:, None], (rate + speed)[:, None])
    gaps = np.asarray(position - surface.position(jnp.asarray(times)))
    return complex(np.sum(half * _WEIGHTS * gaps * np.exp(-1j * angular_frequency * times)))


def largest_along(
    dense: DensePath,
    quantity: Callable[[Trajectory], np.ndarray],
    times_us: Float[np.ndarray, " times"],
    ends_us: tuple[float, float],
) -> float:
    """Return the largest value of a quantity of trajectories between two times.

    The quantity is evaluated at the given times, then on ever finer grids around its two highest local maxima. Two are
    refined because a response period that begins just before its maximum ends on one that is nearly as high.

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


def peaks_of_flights(
    scene: Scene, start_us: ArrayLike, position_nm: ArrayLike, velocity_nm_per_us: ArrayLike, end_us: ArrayLike
) -> Float[np.ndarray, " flights"]:
    """Return the largest height of each of some flights (`highest_of_flight`).

    Args:
        scene: the scene.
        start_us: where the flights start, shape (flights,).
        position_nm: height in the lab there.
        velocity_nm_per_us: velocity in the lab there.
        end_us: where they end.
    """
    _, response = surface_of(scene)
    columns = (jnp.asarray(column, float) for column in (start_us, position_nm, velocity_nm_per_us, end_us))
    return np.asarray(_peaks(scene.cantilever, response, *columns))


@jax.jit
def _least_force(solid: ElasticCurve, depths_nm: Float[np.ndarray | Array, " loads"]) -> Float[Array, ""]:
    return jnp.min(solid.force(depths_nm))


@jax.jit
def _peaks(
    cantilever: Cantilever,
    response: Surface | None,
    start_us: Float[Array, " flights"],
    position_nm: Float[Array, " flights"],
    velocity_nm_per_us: Float[Array, " flights"],
    end_us: Float[Array, " flights"],
) -> Float[Array, " flights"]:
    """Return the largest heights in the lab of flights."""
    duration = end_us - start_us
    _, position, velocity = with_response(response, State(start_us, position_nm, velocity_nm_per_us), -1.0)
    ends = cantilever.propagator(duration)(position, velocity)
    flights = FlightEnds(start_us, duration, position, velocity, *ends)
    return jax.vmap(lambda flight: highest_of_flight(cantilever, flight, response))(flights)


def peaks_between_contacts(scene: Scene, simulation: Simulation) -> Float[np.ndarray, " flights"]:
    """Return the largest heights of the flights from a contact to the next one, in order."""
    rows = simulation.contacts
    count = int(np.sum(np.asarray(rows.kind) != ContactKind.NONE))
    departures = (rows.departure_time_us, rows.departure_position_nm, rows.departure_velocity_nm_per_us)
    start, position, velocity = (np.asarray(column)[: max(count - 1, 0)] for column in departures)
    return peaks_of_flights(scene, start, position, velocity, np.asarray(rows.arrival_time_us)[1 : max(count, 1)])


class Section(NamedTuple):
    """The paper's Poincare section: one point a contact that the tip left; arrays of shape (contacts,)."""

    time_us: Float[np.ndarray, " contacts"]
    drive_phase_deg: Float[np.ndarray, " contacts"]
    """Of the departure, in [0, 360)."""
    departure_velocity_nm_per_us: Float[np.ndarray, " contacts"]
    approach_speed_nm_per_us: Float[np.ndarray, " contacts"]


def poincare_section(scene: Scene, simulation: Simulation) -> Section:
    """Return the drive's phase and the tip's velocity at every departure, and how fast the tip had come.

    Args:
        scene: the scene that was simulated.
        simulation: of one scene.
    """
    rows, has_left = simulation.contacts, contacts_left(simulation)
    time = np.asarray(rows.departure_time_us)[has_left]
    return Section(
        time_us=time,
        drive_phase_deg=360.0 * within_turn(time / drive_of(scene).period_us, 1.0),
        departure_velocity_nm_per_us=np.asarray(rows.departure_velocity_nm_per_us)[has_left],
        approach_speed_nm_per_us=np.asarray(rows.approach_speed_nm_per_us)[has_left],
    )
