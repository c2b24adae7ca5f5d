"""Make the bundled tapping curve: a cantilever shaken on its resonance over the paper's contact, simulated.

    python -m fitting.examples.make_tapping [FILE]

90 kHz, Q = 200, 5.4 N/m, a tip radius of 10 nm, a force on the tip, free amplitude 40 nm; the sample comes nearer from
50 to 4 nm and goes away again. Each row is the full scene in time, followed from where the row before left it until it
settles. Lock-in amplitude and phase carry noise of 0.3 % and 0.2 degrees, the instrument adds 5 degrees to the lag.
What the table states is off by half an error or more: the free frequency by 8 Hz, Q by 0.75 %, and the zero of the
phase, without which the energy would only be bracketed, by 0.1 degrees. A tap of the repulsive branch takes 2.951 aJ
by the simulation's ledger (2.945 to 2.952 along the curve).

The bundled file has a row more, on the retract at -43.5 nm: there the tip just lets go, no motion repeats, and the
curve has no reading.
"""

import sys
from pathlib import Path

import jax
import numpy as np

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.drives import ForceDrive
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.contact.contact import Contact
from afm_jax.motion.approach_curve import ApproachCurve, approach_curve
from afm_jax.units import RAD_PER_US_PER_KHZ
from fitting.tables.table import AmplitudeTable, write_table

TIP_RADIUS_NM = 10.0
HEIGHTS_NM = (
    *(-50.0, -48.0, -46.0, -44.0, -43.0, -42.5, -42.0, -41.5, -41.0, -40.5, -40.0, -39.5, -39.0),
    *np.linspace(-38.0, -4.0, 18).tolist(),
    *np.linspace(-5.0, -37.0, 17).tolist(),
    *np.linspace(-38.0, -44.0, 13).tolist(),
    *(-45.0, -47.5, -50.0),
)
EXAMPLE = Path(__file__).with_name("tapping_resonance.csv")


def steady_curve(
    heights_nm: tuple[float, ...] = HEIGHTS_NM, ratio: float = 1.0, contact: Contact | None = None
) -> ApproachCurve:
    """Return what is read at each height, one after the other.

    Args:
        heights_nm: of the sample over the rest position.
        ratio: drive over free frequency.
        contact: of tip and sample; None: the paper's, with a tip radius of 10 nm.
    """
    stiffness, quality_factor, free_nm = 5.4, 200.0, 40.0
    cantilever = Cantilever(90.0, quality_factor, stiffness / (RAD_PER_US_PER_KHZ * 90.0) ** 2)
    force = ForceDrive(stiffness * free_nm * abs(1.0 - ratio**2 + 1j * ratio / quality_factor), 90.0 * ratio)
    contact = contact or Contact.paper(tip_radius_nm=TIP_RADIUS_NM)
    scene = Scene(cantilever, Platform(0.0, 90.0 * ratio, heights_nm[0]), contact, force=force)
    return approach_curve(scene, heights_nm, both_ways=False, accuracy=1e-7)


def table_of(curve: ApproachCurve) -> AmplitudeTable:
    """Return a curve as an instrument gives it, with noise; heights at which nothing could be read are left out."""
    rows = len(curve.height_nm)
    draws = np.random.default_rng(1).normal(size=(2, rows))
    columns = {
        "drive_frequency_khz": np.full(rows, curve.drive_frequency_khz),
        "free_amplitude_nm": np.full(rows, 40.0),
        "offset_nm": curve.height_nm,
        "lockin_amplitude_nm": np.round(curve.amplitude_nm * (1.0 + 0.003 * draws[0]), 4),
        "lockin_amplitude_error_nm": np.round(0.003 * curve.amplitude_nm, 4),
        "phase_lag_deg": np.round(curve.phase_lag_deg + 5.0 + 0.2 * draws[1], 4),
        "phase_lag_error_deg": np.full(rows, 0.2),
        "retract": curve.retract.astype(float),
    }
    return AmplitudeTable(
        drive="force",
        free_frequency_khz=90.008,
        free_frequency_error_khz=0.01,
        quality_factor=198.5,
        quality_factor_error=2.0,
        spring_constant_n_per_m=5.4,
        spring_constant_error_n_per_m=0.1,
        calibration={"phase_zero_deg": (5.1, 0.2)},
        remarks=(
            "simulated: the paper's contact, tip radius 10 nm, a force on the tip at 90 kHz",
            "truth: a tap of the repulsive branch takes 2.951 aJ; f0 90 kHz, Q 200, zero of phase 5 degrees",
            "made by python -m fitting.examples.make_tapping",
        ),
        **{name: column[np.isfinite(curve.amplitude_nm)] for name, column in columns.items()},
    )


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)  # noqa: FBT003
    write_table(table_of(steady_curve()), sys.argv[1] if len(sys.argv) > 1 else EXAMPLE)
