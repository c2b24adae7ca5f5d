"""Make the bundled amplitude table: single-impact orbits of a known law, with damping and 1 % noise.

    python -m fitting.examples.make_amplitudes [FILE]

The truth: eq. 6 with r = 0.95 and epsilon = 60 nm^2/us^2 on a cantilever of 90 kHz, Q = 40 and 1 ng; orders 1 to 3,
drives from just above capture to 10 nm around each subharmonic resonance, three offsets. Peak and lock-in amplitude
carry independent Gaussian noise of 1 %, the phase one of 0.1 degrees; Q is given as measured, 40 with a standard error
of 0.4. The seed makes it reproducible.
"""

import sys
from itertools import product
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.impact.law import ImpactLaw
from afm_jax.impact.orbits import single_impact_orbits
from fitting.tables.table import AmplitudeTable, write_table

TRUTH = {"r": 0.95, "epsilon": 60.0}
EXAMPLE = Path(__file__).with_name("amplitudes_law.csv")


def example_table() -> AmplitudeTable:
    """Return the bundled table, made anew."""
    jobs = np.array(list(product((1, 2, 3), (0.97, 0.985, 0.995, 1.0, 1.01, 1.02), (1.5, 2.5, 4.0, 6.0, 10.0))))
    offsets = np.arange(len(jobs)) % 3 - 1.0
    order, drive = jobs[:, 0].astype(int), jobs[:, 2]
    frequency = np.round(180.0 * order * jobs[:, 1], 4)
    peak, lockin, phase = (np.asarray(a) for a in _seen(*map(jnp.asarray, (order, frequency, drive, offsets))))
    kept = np.isfinite(peak)
    noise = np.random.default_rng(1997).normal(size=(3, len(jobs)))
    return AmplitudeTable(
        order=order[kept],
        drive_frequency_khz=frequency[kept],
        drive_amplitude_nm=drive[kept],
        offset_nm=offsets[kept],
        free_frequency_khz=90.0,
        quality_factor=40.0,
        quality_factor_error=0.4,
        mass_ng=1.0,
        peak_amplitude_nm=_rounded(peak * (1.0 + 0.01 * noise[0]))[kept],
        peak_amplitude_error_nm=_rounded(peak * 0.01)[kept],
        lockin_amplitude_nm=_rounded(lockin * (1.0 + 0.01 * noise[1]))[kept],
        lockin_amplitude_error_nm=_rounded(lockin * 0.01)[kept],
        phase_deg=np.round((phase + 0.1 * noise[2]) % (360.0 / order), 3)[kept],
        phase_error_deg=np.full(kept.sum(), 0.1),
        remarks=(
            "simulated single-impact orbits of the impact law u_out^2 = r^2 u_in^2 - epsilon",
            "truth: r 0.95, epsilon 60.0 nm^2/us^2, Q 40.0, no delay; noise 1 % and 0.1 degrees, seed 1997",
            "made by python -m fitting.examples.make_amplitudes",
        ),
    )


@jax.jit
@jax.vmap
def _seen(order, frequency_khz, drive_nm, offset_nm):
    """Return peak, lock-in amplitude and phase of the one steady orbit; NaN where there is none or more than one."""
    platform = Platform(drive_nm, frequency_khz, offset_nm)
    scene = Scene(Cantilever(90.0, 40.0), platform, ImpactLaw(TRUTH["r"], TRUTH["epsilon"]))
    orbits = single_impact_orbits(scene, order)
    steady = orbits.stable & orbits.admissible
    slot = jnp.argmax(steady)
    alone = jnp.sum(steady) == 1
    seen = orbits.peak_amplitude_nm, orbits.lockin_amplitude_nm, orbits.lockin_phase_deg
    return tuple(jnp.where(alone, each[slot], jnp.nan) for each in seen)


def _rounded(values: np.ndarray) -> np.ndarray:
    """Round to five significant digits, as an instrument would print them."""
    return np.array([float(f"{value:.5g}") for value in values])


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)  # noqa: FBT003
    write_table(example_table(), sys.argv[1] if len(sys.argv) > 1 else EXAMPLE)
