"""Make the bundled tapping curve: a cantilever shaken on its resonance over the paper's contact, simulated.

    python -m fitting.examples.make_tapping [FILE]

90 kHz, Q = 200, 5.4 N/m, a tip radius of 10 nm, a force on the tip, free amplitude 40 nm; the sample comes nearer from
50 to 4 nm and goes away again. Each row is the full scene in time, followed from where the row before left it until it
settles, or for 300 periods four times over. Lock-in amplitude and phase carry noise of 0.3 % and 0.2 degrees, the
instrument adds 5 degrees to the lag. What the table states is off by half an error or more: the free frequency by 8 Hz,
Q by 0.75 %, and the zero of the phase, without which the energy would only be bracketed, by 0.1 degrees.
"""

import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.drives import ForceDrive
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.contact.contact import Contact
from afm_jax.motion.observe import observe
from afm_jax.motion.record import Simulation, State
from afm_jax.motion.settle import settled
from afm_jax.motion.simulate import simulate
from afm_jax.units import RAD_PER_US_PER_KHZ
from fitting.simulated.experiment import US_PER_MS
from fitting.tables.table import AmplitudeTable, write_table

FREE_FREQUENCY_KHZ, QUALITY_FACTOR, SPRING_CONSTANT_N_PER_M = 90.0, 200.0, 5.4
FREE_AMPLITUDE_NM, TIP_RADIUS_NM = 40.0, 10.0
ENERGY_AJ = 2.951
"""What a tap of the repulsive branch takes: the simulation's ledger, 2.947 to 2.952 aJ along the curve."""
HEIGHTS_NM = (
    *(-50.0, -48.0, -46.0, -44.0, -43.0, -42.5, -42.0, -41.5, -41.0, -40.5, -40.0, -39.5, -39.0),
    *np.linspace(-38.0, -4.0, 18).tolist(),
    *np.linspace(-5.0, -37.0, 17).tolist(),
    *np.linspace(-38.0, -44.0, 13).tolist(),
    *(-45.0, -47.5, -50.0),
)
NOISE, PHASE_NOISE_DEG, SEED = 0.003, 0.2, 1
PHASE_ZERO_DEG, FREQUENCY_OFF_KHZ, QUALITY_OFF, ZERO_OFF_DEG = 5.0, 0.008, -1.5, 0.1
EXAMPLE = Path(__file__).with_name("tapping_resonance.csv")
_PERIODS, _PIECES, _CLEARANCE_NM = 300, 4, 6.0


class SteadyRow(NamedTuple):
    """What is read of one height: amplitude and lag, and the energy of a period from the ledger."""

    amplitude_nm: float
    lag_deg: float
    energy_aj: float


def steady_curve(
    heights_nm: tuple[float, ...] = HEIGHTS_NM, ratio: float = 1.0, contact: Contact | None = None
) -> list[SteadyRow]:
    """Return what is read at each height, one after the other.

    Args:
        heights_nm: of the sample over the rest position.
        ratio: drive over free frequency.
        contact: of tip and sample; None: the paper's, with a tip radius of 10 nm.
    """
    stiffness, omega = SPRING_CONSTANT_N_PER_M, RAD_PER_US_PER_KHZ * FREE_FREQUENCY_KHZ
    cantilever = Cantilever(FREE_FREQUENCY_KHZ, QUALITY_FACTOR, stiffness / omega**2)
    gamma = 1.0 - ratio**2 + 1j * ratio / QUALITY_FACTOR
    frequency = ratio * FREE_FREQUENCY_KHZ
    period = US_PER_MS / frequency
    force = ForceDrive(stiffness * FREE_AMPLITUDE_NM * abs(gamma), frequency)
    contact = contact or Contact.paper(tip_radius_nm=TIP_RADIUS_NM)
    # the free tip at the top of its swing
    state = State(*map(jnp.asarray, (float(np.angle(gamma)) / (2.0 * np.pi) * period, FREE_AMPLITUDE_NM, 0.0)))
    rows = []
    for height in heights_nm:
        scene = Scene(cantilever, Platform(0.0, frequency, jnp.asarray(float(height))), contact, force=force)
        motion = verdict = None
        for _ in range(_PIECES):
            motion = _to_flight(partial(_for_a_time, scene, state), period, height)
            end = motion.final
            state = State(jnp.asarray(float(end.time_us) % period), end.position_nm, end.velocity_nm_per_us)
            verdict = settled(scene, motion, tolerance=1e-5)
            if verdict.settled:
                break
        assert motion is not None  # noqa: S101
        seen = observe(scene, motion, verdict=verdict)
        lag = -seen.drive_lockin_phase_deg % 360.0
        rows.append(SteadyRow(seen.drive_lockin_amplitude_nm, lag, seen.dissipated_in_contact_aj))
    return rows


@jax.jit
def _follow(scene: Scene, start: State, time_us: jax.Array) -> Simulation:
    return simulate(scene, start, time_us, max_contacts=1024, accuracy=1e-7)


def _for_a_time(scene: Scene, start: State, time_us: float) -> Simulation:
    return _follow(scene, start, jnp.asarray(time_us))


def _to_flight(follow: Callable[[float], Simulation], period: float, height: float) -> Simulation:
    """Return a motion that ends well above the sample, where the next one can begin."""
    motion = follow(_PERIODS * period)
    for share in (0.25, 0.5, 0.75, 0.1, 0.6):
        if float(motion.final.position_nm) > height + _CLEARANCE_NM:
            break
        motion = follow((_PERIODS + share) * period)
    return motion


def table_of(rows: list[SteadyRow], heights_nm: tuple[float, ...] = HEIGHTS_NM, ratio: float = 1.0) -> AmplitudeTable:
    """Return rows as an instrument gives them, with noise."""
    amplitude, lag, _ = np.array(rows).T
    draws = np.random.default_rng(SEED).normal(size=(2, len(rows)))
    heights = np.array(heights_nm)
    same = np.ones(len(rows))
    return AmplitudeTable(
        drive="force",
        drive_frequency_khz=ratio * FREE_FREQUENCY_KHZ * same,
        free_amplitude_nm=FREE_AMPLITUDE_NM * same,
        offset_nm=heights,
        lockin_amplitude_nm=np.round(amplitude * (1.0 + NOISE * draws[0]), 4),
        lockin_amplitude_error_nm=np.round(NOISE * amplitude, 4),
        phase_lag_deg=np.round(lag + PHASE_ZERO_DEG + PHASE_NOISE_DEG * draws[1], 4),
        phase_lag_error_deg=PHASE_NOISE_DEG * same,
        retract=(np.arange(len(rows)) > np.argmax(heights)).astype(float),
        free_frequency_khz=FREE_FREQUENCY_KHZ + FREQUENCY_OFF_KHZ,
        free_frequency_error_khz=0.01,
        quality_factor=QUALITY_FACTOR + QUALITY_OFF,
        quality_factor_error=2.0,
        spring_constant_n_per_m=SPRING_CONSTANT_N_PER_M,
        spring_constant_error_n_per_m=0.1,
        calibration={"phase_zero_deg": (PHASE_ZERO_DEG + ZERO_OFF_DEG, 0.2)},
        remarks=(
            "simulated: the paper's contact, tip radius 10 nm, a force on the tip at 90 kHz",
            f"truth: a tap of the repulsive branch takes {ENERGY_AJ} aJ; f0 90 kHz, Q 200, zero of phase 5 degrees",
            "made by python -m fitting.examples.make_tapping",
        ),
    )


def main() -> None:
    """Write the table."""
    jax.config.update("jax_enable_x64", True)  # noqa: FBT003
    target = Path(sys.argv[1]) if len(sys.argv) > 1 else EXAMPLE
    write_table(table_of(steady_curve()), target)


if __name__ == "__main__":
    main()
