"""Where the energy of a motion goes: what the drives give, what air and sample take, what is stored."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from afm_jax.apparatus.scene import Scene
from afm_jax.contact.contact import Contact
from afm_jax.motion.record import ContactKind, Simulation
from afm_jax.motion.trajectory import Trajectory


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


def energy_balance(
    scene: Scene, simulation: Simulation, path: Trajectory, weights_us: Float[np.ndarray, " times"], ends: Trajectory
) -> EnergyBalance:
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
        return EnergyBalance(air + contact + stored, air, contact, stored, None)
    # D' = z' - z_p', whatever else drives the tip
    given = float(np.sum(weights_us * path.force_nn * (v - path.gap_rate_nm_per_us)))
    if scene.force is not None:
        given += float(np.sum(weights_us * np.asarray(scene.force.force(path.time_us)) * v))
    if scene.base is not None:
        base = np.asarray(scene.base.position_and_velocity(path.time_us)[0])
        given += stiffness * float(np.sum(weights_us * base * v))
    largest = max(abs(given), abs(air), abs(contact), abs(stored))
    imbalance = (given - air - contact - stored) / largest if largest else 0.0
    return EnergyBalance(given, air, contact, stored, imbalance)


def _ledger(simulation: Simulation, from_us: float, to_us: float) -> float | None:
    """Return what the contacts within a stretch dissipated; None where one of a tip held to the end is among them."""
    rows = simulation.contacts
    inside = (np.asarray(rows.kind) != ContactKind.NONE) & (np.asarray(rows.arrival_time_us) >= from_us)
    inside &= np.asarray(rows.arrival_time_us) < to_us
    lost = float(np.sum(np.asarray(rows.energy_lost_aj)[inside]))
    return None if np.any(np.asarray(rows.kind)[inside] == ContactKind.HELD) else lost
