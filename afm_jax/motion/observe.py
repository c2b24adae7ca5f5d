"""What an instrument reads of a simulated motion: amplitudes, phases, times, forces, energies.

Takes a scene and its simulation; gives `Observables`, units in their names.

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
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from afm_jax.apparatus.drives import BaseDrive
from afm_jax.apparatus.scene import Scene, drive_of
from afm_jax.apparatus.surface import surface_of
from afm_jax.contact.contact import Contact
from afm_jax.impact.lasting_impact import depth_of_impact, middle_of_contact
from afm_jax.impact.law import Law
from afm_jax.motion.record import (
    ContactKind,
    Simulation,
    State,
    contacts_left,
    to_gap,
)
from afm_jax.motion.settle import Settled, Window, settled, window_of
from afm_jax.motion.trajectory import DensePath, Trajectory, fly
from afm_jax.units import RAD_PER_US_PER_KHZ, within_turn

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(12)
_COVERED = 1e-6
"""Fraction of a window that may be missing from its nodes: rounding."""
_REFINEMENTS = 4
_TOPS, _REFINED = 4, 33
"""Local maxima that are refined, and times around each in every refinement."""
TOO_SHORT = "the window is shorter than a response period: follow the motion longer"
_RESOLVED = "only a resolved contact has a force"
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


class Observable(NamedTuple):
    """How a quantity is read of a motion."""

    meaning: str
    read: Callable[["MotionWindow"], float | None]
    """The formula; None where the scene has no such quantity."""
    absent: str = ""
    """Why there may be none; empty where every motion has it."""
    of_a_part: bool = False
    """Whether a window shorter than a response period tells it; else the quantity is NaN there."""

    def of(self, motion: "MotionWindow") -> float | None:
        """Return the quantity of a window; None where the scene has none, NaN where the window is too short."""
        value = self.read(motion)
        return value if value is None or self.of_a_part or motion.responses else math.nan


_row: Any = Observable
"""Makes a row of the table: an `Observable` in the place of its number."""


def _of_deflection(meaning: str, read: Callable[["Signal"], float], **options: bool) -> Any:
    """Return the row of a quantity of the deflection against a moving base."""
    return _row(
        f"{meaning} against a moving base", lambda m: m.deflection and read(m.deflection), _BASE_RESTS, **options
    )


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

    # the table: the default of a quantity says how it is read; m is the motion in its window
    peak_amplitude_nm: float = _row(
        "largest height above the rest position", lambda m: m.height.largest, of_a_part=True
    )
    lockin_amplitude_nm: float = _row(
        "amplitude at the response frequency omega/N", lambda m: m.height.at_response.amplitude_nm
    )
    lockin_phase_deg: float = _row(
        "phase at the response frequency, modulo 360/N", lambda m: m.height.at_response.phase_deg
    )
    drive_lockin_amplitude_nm: float = _row(
        "amplitude at the drive's frequency omega", lambda m: m.height.at_drive.amplitude_nm
    )
    drive_lockin_phase_deg: float = _row("phase at the drive's frequency omega", lambda m: m.height.at_drive.phase_deg)
    mean_height_nm: float = _row("mean height", lambda m: m.height.mean)
    contact_share: float = _row("fraction of time in contact", lambda m: m.in_contact_us / m.span_us)
    time_in_contact_us: float = _row(
        "time in contact of a response period", lambda m: m.in_contact_us / m.cycles * m.periods
    )
    peak_force_nn: float | None = _row(
        "largest force on the tip, of a resolved contact", lambda m: m.largest_force_nn(1.0), _RESOLVED, of_a_part=True
    )
    most_attractive_force_nn: float | None = _row(
        "most attractive force on the tip, of a resolved contact",
        lambda m: m.largest_force_nn(-1.0),
        _RESOLVED,
        of_a_part=True,
    )
    dissipated_in_contact_aj: float = _row(
        "energy lost to the sample per drive period", lambda m: m.energy.contact_aj / m.cycles
    )
    dissipated_per_contact_aj: float | None = _row(
        "energy lost to the sample per contact",
        lambda m: m.energy.contact_aj / m.contacts if m.contacts else None,
        "no contact begins in the window",
    )
    dissipated_in_air_aj: float = _row("energy lost to the air per drive period", lambda m: m.energy.air_aj / m.cycles)
    given_by_drives_aj: float = _row(
        "energy given by the drives per drive period", lambda m: m.energy.given_aj / m.cycles
    )
    stored_aj: float = _row(
        "growth of the energy of tip and spring per drive period; 0 once settled",
        lambda m: m.energy.stored_aj / m.cycles,
    )
    energy_imbalance: float | None = _row(
        "what the four energies leave unexplained, of the largest; only of a resolved contact",
        lambda m: m.energy.imbalance,
        "with an impact law the energy given by the drives closes the balance",
        of_a_part=True,
    )
    virial_aj: float = _row("mean of force times height", lambda m: m.virial_aj)
    peak_deflection_nm: float | None = _of_deflection("largest deflection", lambda s: s.largest, of_a_part=True)
    mean_deflection_nm: float | None = _of_deflection("mean deflection", lambda s: s.mean)
    deflection_lockin_amplitude_nm: float | None = _of_deflection(
        "amplitude at the response frequency", lambda s: s.at_response.amplitude_nm
    )
    deflection_lockin_phase_deg: float | None = _of_deflection(
        "phase at the response frequency, modulo 360/N,", lambda s: s.at_response.phase_deg
    )
    deflection_drive_lockin_amplitude_nm: float | None = _of_deflection(
        "amplitude at the drive's frequency", lambda s: s.at_drive.amplitude_nm
    )
    deflection_drive_lockin_phase_deg: float | None = _of_deflection(
        "phase at the drive's frequency", lambda s: s.at_drive.phase_deg
    )
    phase_lag_deg: float | None = _row(
        "lag of deflection or height behind base or force at the drive's frequency",
        lambda m: m.phase_lag_deg,
        "no base and no force drives the tip",
    )


OBSERVABLES: dict[str, Observable] = Observables._field_defaults
"""The rows of the table by their names, in the order of the output: the attributes of `Observables`, the JSON keys, the
columns of a sweep."""


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
        dense: the tip at any time, if that is at hand.

    Raises:
        ValueError: if a harmonic is not a positive integer, or there are none.
        RuntimeError: if the dense trajectory does not cover the window, its contacts having ended otherwise than the
            simulation's.
    """
    if not harmonics or any(k != int(k) or k < 1 for k in harmonics):
        raise ValueError(f"`harmonics` must be positive integers, but are {tuple(harmonics)}")
    verdict = settled(scene, simulation) if verdict is None else verdict
    window = window_of(scene, simulation, verdict)
    dense = DensePath(scene, simulation) if dense is None else dense
    motion = MotionWindow(dense, window.from_us, window.to_us, window.periods, window.responses)
    covered = float(np.sum(motion.nodes[1]))
    # integrals over part of the window would be wrong in silence
    if not abs(covered - motion.span_us) <= _COVERED * motion.span_us:
        raise RuntimeError(
            f"the dense trajectory covers {covered:.6g} of the {motion.span_us:.6g} us of the window: integrated "
            "once more, a contact ended otherwise than in the simulation, which is not to be trusted there"
        )
    frequency = drive_of(scene).angular_frequency / RAD_PER_US_PER_KHZ
    height, deflection = motion.height, motion.deflection
    values: dict[str, Any] = {name: observable.of(motion) for name, observable in OBSERVABLES.items()}
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
    reasons = {} if scene.base is not None else {"deflection_harmonics": _BASE_RESTS}
    for name, observable in OBSERVABLES.items():
        if getattr(seen, name) is None:
            reasons[name] = observable.absent
        elif not (seen.window.responses or observable.of_a_part):
            reasons[name] = TOO_SHORT
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

    @cached_property
    def begun(self) -> Bool[np.ndarray, " rows"]:
        """Which contacts begin in the window."""
        arrival = np.asarray(self.dense.contacts.arrival_time_us)
        return (arrival >= self.from_us) & (arrival < self.to_us)

    @property
    def contacts(self) -> int:
        """Number of contacts that begin in the window."""
        return int(np.count_nonzero(self.begun))

    @property
    def in_contact_us(self) -> float:
        """Time in contact; impacts of a law take none, but for rests on the sample."""
        lasting = self.dense.contacts.kind > (ContactKind.NONE if self._resolved else ContactKind.IMPACT)
        begin = np.maximum(self.dense.contacts.arrival_time_us, self.from_us)
        end = np.minimum(self.dense.contacts.departure_time_us, self.to_us)
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

    def largest(self, quantity: Callable[[Trajectory], np.ndarray]) -> float:
        """Return the largest value of a quantity of trajectories in the window.

        It is evaluated at the nodes, then on ever finer grids around its highest local maxima: at the nodes one may be
        the highest that is not.
        """
        times, largest = np.unique([*self.nodes[0], self.from_us, self.to_us]), -np.inf
        for _ in range(_REFINEMENTS + 1):
            values = quantity(self.dense.at(times))
            largest = max(largest, float(values.max()))
            framed = np.concatenate([[-np.inf], values, [-np.inf]])
            tops = np.flatnonzero((values >= framed[:-2]) & (values >= framed[2:]))
            tops = tops[np.argsort(values[tops])[-_TOPS:]]
            around = times[np.maximum(tops - 1, 0)], times[np.minimum(tops + 1, len(times) - 1)]
            times = np.unique(np.linspace(*around, _REFINED))
        return largest

    def largest_force_nn(self, sign: float) -> float | None:
        """Return the largest repulsive force in nN, with a sign of -1 the most attractive; None without resolution."""
        return sign * max(self.largest(lambda path: sign * path.force_nn), 0.0) if self._resolved else None

    @property
    def virial_aj(self) -> float:
        """1/T int F z dt in aJ; an impact of a law counts m (V' - V) z, z halfway where it has a delay."""
        if self.scene.interaction is None or self._resolved:
            return self.integral(self.path.force_nn * self.path.position_nm) / self.span_us
        rows = self.dense.contacts
        impacts = self.begun & (self.dense.contacts.kind == ContactKind.IMPACT)
        kick = (rows.departure_velocity_nm_per_us - rows.arrival_velocity_nm_per_us)[impacts]
        height = 0.5 * (rows.departure_position_nm + rows.arrival_position_nm)[impacts]
        return float(self.scene.cantilever.mass_ng) * float(np.sum(kick * height)) / self.span_us

    @cached_property
    def energy(self) -> "EnergyBalance":
        """The energies of the window in aJ, from the equation of motion multiplied by z'.

        m z'' + (m Omega/Q) z' + k z = F + f + k z_b, with the contact force F, the drive force f and the base z_b. The
        gap D and the platform z_p split the contact's power, F z' = F D' + F z_p'. Drives give F z_p' + f z' +
        k z_b z', air dissipates (m Omega/Q) z'^2, and the contact receives -F D', and returns the part of conservative
        forces.
        """
        scene, path = self.scene, self.path
        cantilever = scene.cantilever
        mass, stiffness = float(cantilever.mass_ng), float(cantilever.stiffness_n_per_m)
        v, ends = path.velocity_nm_per_us, self.dense.at(np.array([self.from_us, self.to_us]))
        air = 2.0 * float(cantilever.decay_rate) * mass * self.integral(v * v)
        energy = 0.5 * mass * ends.velocity_nm_per_us**2 + 0.5 * stiffness * ends.position_nm**2
        stored = float(energy[1] - energy[0])
        contact = float(np.sum(self.dense.contacts.energy_lost_aj[self.begun]))
        if isinstance(scene.interaction, Law):
            return EnergyBalance(air + contact + stored, air, contact, stored, None)
        # a contact that the window cuts has lost what its ledger does not tell yet
        if np.any(self.dense.contacts.kind[self.begun] == ContactKind.HELD) or np.any(ends.phase):
            contact = -self.integral(path.force_nn * path.gap_rate_nm_per_us)
        # D' = z' - z_p', whatever else drives the tip
        given = self.integral(path.force_nn * (v - path.gap_rate_nm_per_us))
        if scene.force is not None:
            given += self.integral(np.asarray(scene.force.force(path.time_us)) * v)
        if scene.base is not None:
            given += stiffness * self.integral(np.asarray(scene.base.position_and_velocity(path.time_us)[0]) * v)
        largest = max(abs(given), abs(air), abs(contact), abs(stored))
        imbalance = (given - air - contact - stored) / largest if largest else 0.0
        return EnergyBalance(given, air, contact, stored, imbalance)


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
        return self.motion.largest(self.along)

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
    law, rows = motion.scene.interaction, motion.dense.contacts
    if not isinstance(law, Law) or law.delay is None:
        return 0j
    arrival, departure = rows.arrival_time_us, rows.departure_time_us
    middle = 0.5 * (arrival + departure)
    inside = (rows.kind == ContactKind.IMPACT) & (middle >= motion.from_us) & (middle < motion.to_us)
    impacts = np.flatnonzero(inside)
    cantilever, (surface, response), depth = motion.scene.cantilever, surface_of(motion.scene), 0.0
    if law.lasts:
        at_middle = middle_of_contact(cantilever, surface, jnp.asarray(middle[impacts]))
        speeds = (rows.approach_speed_nm_per_us, rows.rebound_speed_nm_per_us)
        approach, rebound = (jnp.asarray(each)[impacts] for each in speeds)
        depth = np.asarray(depth_of_impact(law, approach, rebound, at_middle, cantilever, angular_frequency))
    total = -np.sum(depth * np.exp(-1j * angular_frequency * middle[impacts]))
    # flights from their beginning to the end of the flight before
    early = impacts[departure[impacts] < arrival[impacts], None]
    start = State(departure[early], rows.departure_position_nm[early], rows.departure_velocity_nm_per_us[early])
    half = 0.5 * (arrival[early] - departure[early])
    times = departure[early] + half * (_NODES + 1.0)
    gaps, _ = fly(cantilever, surface, *to_gap(surface, response, start), start.time_us, times)
    return complex(total + np.sum(half * _WEIGHTS * np.asarray(gaps) * np.exp(-1j * angular_frequency * times)))


def poincare_section(scene: Scene, simulation: Simulation) -> tuple[Float[np.ndarray, " contacts"], Any]:
    """Return the paper's Poincare section: the drive's phase in degrees at every departure, and the `Contacts` before.

    Args:
        scene: the scene that was simulated.
        simulation: of one scene.
    """
    rows = contacts_left(simulation)
    return 360.0 * within_turn(np.asarray(rows.departure_time_us) / drive_of(scene).period_us, 1.0), rows
