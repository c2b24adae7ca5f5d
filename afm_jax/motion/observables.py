"""What an experiment reads of a simulated motion: amplitudes, phases, times, forces, energies."""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from afm_jax.apparatus.scene import Scene
from afm_jax.contact.contact import Contact
from afm_jax.motion.drive_period import Drive, drive_of
from afm_jax.motion.energy_balance import energy_balance
from afm_jax.motion.impact_integral import impact_integral
from afm_jax.motion.peak_height import peak_deflection, peak_height
from afm_jax.motion.record import ContactKind, Simulation
from afm_jax.motion.settle import Settled, Window, settled, window_of
from afm_jax.motion.trajectory import Trajectory, dense_path

_LOADS = 4001
_COVERED = 1e-6
"""Share of a window that may be missing from its nodes: rounding."""


class Harmonic(NamedTuple):
    """The motion at a multiple k of the response frequency omega/N: z ~ a cos(k omega t/N + phi)."""

    multiple: int
    amplitude_nm: float
    phase_deg: float
    """In [0, 360/N'): which of the N' = N/gcd(k, N) equivalent periods is locked is unknown."""


class Observables(NamedTuple):
    """What is read of a motion over a window; None where a quantity does not exist for the scene."""

    settled: Settled
    window: Window
    peak_amplitude_nm: float
    """Largest height above the rest position."""
    harmonics: tuple[Harmonic, ...]
    """Of the height; the first of them is the lock-in's."""
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
    """Largest z - z_b; None without a moving base, as the two that follow."""
    deflection_harmonics: tuple[Harmonic, ...] | None
    mean_deflection_nm: float | None

    @property
    def lockin_amplitude_nm(self) -> float:
        """Amplitude of the height at the first of the harmonics asked for."""
        return self.harmonics[0].amplitude_nm

    @property
    def lockin_phase_deg(self) -> float:
        """Its phase."""
        return self.harmonics[0].phase_deg


def observe(
    scene: Scene,
    simulation: Simulation,
    *,
    harmonics: Sequence[int] = (1,),
    drive: Drive | None = None,
    verdict: Settled | None = None,
) -> Observables:
    """Return what is read of a motion: over the last response period once settled, else the last fifth.

    The lock-in's amplitude and phase are 2/T int z exp(-i k omega t/N) dt over whole response periods T = N 2 pi/omega;
    its subharmonics of the drive are k < N. Where nothing repeats N is the nearest integer to the drive periods between
    two contacts.

    Args:
        scene: the scene that was simulated.
        simulation: of one scene, not of a batch.
        harmonics: multiples k of the response frequency, positive integers.
        drive: whose periods count; the scene's if None.
        verdict: what `settled` said, if it is known already.

    Raises:
        ValueError: if a harmonic is not a positive integer, or there are none.
        RuntimeError: if the dense trajectory does not cover the window, its contacts having ended otherwise than the
            simulation's.
    """
    if not harmonics or any(k != int(k) or k < 1 for k in harmonics):
        raise ValueError(f"`harmonics` must be positive integers, but are {tuple(harmonics)}")
    drive = drive_of(scene) if drive is None else drive
    verdict = settled(scene, simulation) if verdict is None else verdict
    window = window_of(scene, simulation, verdict, drive)
    begin, end = window.from_us, window.to_us
    dense = dense_path(scene, simulation, begin, end)
    times, weights = dense.nodes(begin, end)
    _check_covered(float(np.sum(weights)), end - begin)
    path, ends = dense.at(times), dense.at(np.array([begin, end]))
    beyond = partial(impact_integral, scene, simulation, begin, end)
    energy = energy_balance(scene, simulation, path, weights, ends)
    span = end - begin
    cycles = span / drive.period_us
    touched, begun = _time_in_contact(scene, simulation, begin, end)
    peak_force, attraction = _forces(scene, simulation, path, window)
    base = scene.base
    deflection = None if base is None else path.position_nm - np.asarray(base.position_and_velocity(times)[0])
    return Observables(
        settled=verdict,
        window=window,
        peak_amplitude_nm=peak_height(dense, path, begin, end),
        harmonics=_harmonics(path.position_nm, times, weights, window, drive, harmonics, beyond),
        mean_height_nm=(float(np.sum(weights * path.position_nm)) + beyond(0.0).real) / span,
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
        peak_deflection_nm=None if base is None else peak_deflection(dense, path, begin, end),
        deflection_harmonics=None
        if deflection is None
        else _harmonics(deflection, times, weights, window, drive, harmonics, beyond),
        mean_deflection_nm=None
        if deflection is None
        else (float(np.sum(weights * deflection)) + beyond(0.0).real) / span,
    )


def _check_covered(found_us: float, wanted_us: float) -> None:
    """Check that the nodes of a window cover it: integrals over part of it would be wrong in silence."""
    if not abs(found_us - wanted_us) <= _COVERED * wanted_us:
        raise RuntimeError(
            f"the dense trajectory covers {found_us:.6g} of the {wanted_us:.6g} us of the window: integrated "
            "once more, a contact ended otherwise than in the simulation, which is not to be trusted there"
        )


def _harmonics(
    height: Float[np.ndarray, " times"],
    times: Float[np.ndarray, " times"],
    weights: Float[np.ndarray, " times"],
    window: Window,
    drive: Drive,
    multiples: Sequence[int],
    beyond: Callable[[float], complex],
) -> tuple[Harmonic, ...]:
    """Return amplitudes and phases over a window; ``beyond`` is what impacts add at an angular frequency."""
    found = []
    for k in multiples:
        nu = k * drive.angular_frequency / window.periods
        integral = np.sum(weights * height * np.exp(-1j * nu * times)) + beyond(nu)
        value = 2.0 / (window.to_us - window.from_us) * integral
        turn = 360.0 * math.gcd(int(k), window.periods) / window.periods
        found.append(Harmonic(int(k), float(abs(value)), float(np.degrees(np.angle(value)) % turn)))
    return tuple(found)


def _time_in_contact(scene: Scene, simulation: Simulation, begin: float, end: float) -> tuple[float, int]:
    """Return the time in contact within a window, and how many contacts begin in it; impacts of a law take no time."""
    rows = simulation.contacts
    kind = np.asarray(rows.kind)
    arrival = np.asarray(rows.arrival_time_us)
    begun = int(np.count_nonzero((kind != ContactKind.NONE) & (arrival >= begin) & (arrival < end)))
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
        loads = contact.junction.force(np.linspace(float(contact.junction.pull_off_depth_nm), 0.0, _LOADS))
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
