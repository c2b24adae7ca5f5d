"""Make `tapping_contact.csv`: two tapping curves of a simulated full contact, 3 % above resonance.

A tip of 20 nm taps on a harder, more humid sample than the paper's, at free amplitudes of 80 and 40 nm; noise of 0.3 %
and 0.2 degrees, the instrument known as an instrument is. Run from the repository: it takes a minute or two.

    python -m fitting.examples.make_tapping_curve
"""

from dataclasses import replace
from pathlib import Path

import jax
import numpy as np

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.contact.contact import Contact
from fitting.simulated.experiment import drives_of, simulate_experiment
from fitting.tables.table import write_table

if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)  # noqa: FBT003
    drives = [(1, 92.7, free, -free * height) for free in (80.0, 40.0) for height in np.linspace(0.9, 0.12, 12)]
    made = simulate_experiment(
        Contact.paper(
            tip_radius_nm=20.0,
            relative_humidity=0.55,
            adhesion_energy_j_per_m2=0.35,
            viscosity_pa_s=0.8e-3,
            modulus_gpa=120.0,
        ),
        Cantilever(90.0, 200.0, 16.81),
        drives_of(drives),
        drive="force",
        noise=0.003,
        phase_noise_deg=0.2,
        seed=1,
        quality_factor_error=2.0,
    )
    known = {"tip_calibration": (1.0, 0.02), "offset_origin_nm": (0.0, 1.0), "phase_zero_deg": (0.0, 0.5)}
    table = replace(made.table, free_frequency_error_khz=0.01, calibration=known)
    write_table(table, Path(__file__).with_name("tapping_contact.csv"))
