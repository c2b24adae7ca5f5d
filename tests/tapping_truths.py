"""Random contacts under a cantilever that is driven itself: what a lock-in reads of them, and their known law.

The truth is the full scene, followed in time until it repeats: no law, no delay and no correction of the fitted models
goes into it. A contact takes a minute or two, so tables are kept in a folder.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.contact.contact import Contact
from afm_jax.contact.law_of_contact import tabulated
from afm_jax.contact.parameters import PAPER
from afm_jax.impact.lasting_impact import TabulatedImpact
from fitting import read_table
from fitting.simulated.experiment import drives_of, simulate_experiment
from fitting.tables.table import AmplitudeTable, write_table

SEED = 712
MASS_NG = 16.81
FREE_NM = (80.0, 40.0)
NOISE, PHASE_NOISE_DEG = 0.003, 0.2
SHARES = tuple(np.linspace(0.9, 0.12, 12).tolist())
"""Distances of the sample from the rest position, of the free amplitude."""


@dataclass(frozen=True)
class TappingTruth:
    """A contact under a cantilever of 90 kHz and 5.4 N/m; what its impacts do is known from its own table."""

    number: int
    parameters: dict[str, Any]
    quality_factor: float

    @property
    def impact(self) -> TabulatedImpact:
        """The contact's free collisions."""
        return tabulated(Contact.paper(**self.parameters), jnp.asarray(MASS_NG))

    def rebound(self, approach_speeds: np.ndarray) -> np.ndarray:
        """Return rebound speeds in nm/us."""
        return np.asarray(jax.vmap(self.impact.speeds)(jnp.asarray(approach_speeds)).rebound)


def tapping_truth(number: int) -> TappingTruth:
    """Return one of the random contacts; each number always gives the same."""
    random = np.random.default_rng([SEED, number])
    while True:
        share = random.uniform(size=6).tolist()
        truth = TappingTruth(
            number=number,
            parameters={
                "tip_radius_nm": round(10.0 * 3.0 ** share[0], 1),
                "relative_humidity": round(0.2 + 0.6 * share[1], 3),
                "adhesion_energy_j_per_m2": round(0.15 + 0.45 * share[2], 3),
                "viscosity_pa_s": float(f"{5.0 * share[3] ** 2 * PAPER['viscosity_pa_s']:.3g}"),
                "modulus_gpa": round(30.0 * 10.0 ** share[4], 1),
            },
            quality_factor=round(100.0 * 5.0 ** share[5], 1),
        )
        # without a junction there is no table
        if float(truth.impact.lowest) < 30.0:
            return truth


def exact_table(truth: TappingTruth, ratio: float, folder: Path, shares: tuple[float, ...] = SHARES) -> AmplitudeTable:
    """Return two noise-free curves of a contact, read from the folder or simulated and written there.

    Args:
        truth: the contact.
        ratio: drive over free frequency.
        folder: where tables are kept.
        shares: distances of the sample from the rest position, of the free amplitude.
    """
    path = folder / f"tapping_{SEED}_{truth.number}_{ratio:g}_{len(shares)}.csv"
    if not path.exists():
        made = simulate_experiment(
            Contact.paper(**truth.parameters),
            Cantilever(90.0, truth.quality_factor, MASS_NG),
            drives_of([(1, 90.0 * ratio, free, -free * share) for free in FREE_NM for share in shares]),
            drive="force",
            noise=NOISE,
            phase_noise_deg=PHASE_NOISE_DEG,
            remarks=(f"random contact {truth.number}: {truth.parameters}",),
        )
        folder.mkdir(parents=True, exist_ok=True)
        write_table(made.exact, path)
    return read_table(path)


def as_measured(exact: AmplitudeTable) -> AmplitudeTable:
    """Return a table with the instrument known as an instrument is: f0 to 10 Hz, Q to 1 %, the nuisances free."""
    return replace(
        exact,
        free_frequency_error_khz=0.01,
        quality_factor_error=0.01 * (exact.quality_factor or 0.0),
        calibration={"tip_calibration": (1.0, 0.02), "offset_origin_nm": (0.0, 1.0), "phase_zero_deg": (0.0, 0.5)},
    )
