"""Random contacts whose law and delay are known, and the amplitudes that experiments on them would read.

The truth is the full scene, followed in time until it repeats, as for the bundled table: no law, no delay and no
correction of the fitted models goes into it. It takes minutes, so tables are kept in a folder.
"""

from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.contact.contact import Contact
from afm_jax.contact.law_of_contact import tabulated
from afm_jax.contact.parameters import PAPER
from afm_jax.impact.lasting_impact import TabulatedImpact
from fitting import read_table
from fitting.examples.make_contact_amplitudes import DRIVES_NM, OFFSETS_NM, ORDERS
from fitting.simulated.experiment import Drives, drives_of, simulate_experiment
from fitting.tables.table import AmplitudeTable, write_table

SEED = 2026
REDUCED_DETUNINGS = (0.965, 0.98, 0.99, 1.0, 1.008, 1.016, 1.025)
ERROR_OF_Q = 0.0125
"""Relative, as in the bundled table."""


@dataclass(frozen=True)
class ContactTruth:
    """A contact and its instrument; what its impacts do is known from its own table."""

    number: int
    parameters: dict[str, Any]
    frequency_khz: float
    quality_factor: float

    @property
    def impact(self) -> TabulatedImpact:
        """The contact's free collisions."""
        return tabulated(Contact.paper(**self.parameters), jnp.asarray(1.0))

    def rebound_and_delay(self, approach_speeds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return rebound speeds in nm/us and delays in us; NaN where the contact captures or its table ends."""
        impact = self.impact
        speeds = impact.speeds(jnp.asarray(approach_speeds))
        known = (approach_speeds > 1.01 * float(impact.lowest)) & (approach_speeds < float(impact.highest))
        return np.where(known, speeds.rebound, np.nan), np.where(known, speeds.delay, np.nan)

    def drives(self) -> Drives:
        """Return drives like the bundled table's, in terms of the contact's capture speed."""
        scale = 90.0 / self.frequency_khz * np.sqrt(float(self.impact.lowest) / 11.0)
        rows = []
        for number, (order, detuning, amplitude) in enumerate(product(ORDERS, REDUCED_DETUNINGS, DRIVES_NM)):
            offset = OFFSETS_NM[(number + number // len(DRIVES_NM)) % len(OFFSETS_NM)]
            frequency = round(2.0 * self.frequency_khz * order * detuning, 3)
            rows.append((order, frequency, float(f"{amplitude * scale:.3g}"), offset))
        return drives_of(rows)


def contact_truth(number: int) -> ContactTruth:
    """Return one of the random contacts; each number always gives the same."""
    random = np.random.default_rng([SEED, number])
    while True:
        share = random.uniform(size=6)
        truth = ContactTruth(
            number=number,
            parameters={
                "relative_humidity": round(0.2 + 0.6 * share[0], 3),
                "adhesion_energy_j_per_m2": round(0.15 + 0.45 * share[1], 3),
                "viscosity_pa_s": float(f"{10.0 * share[2] ** 2 * PAPER['viscosity_pa_s']:.3g}"),
                "modulus_gpa": round(30.0 * 10.0 ** share[3], 1),
            },
            frequency_khz=round(60.0 * 5.0 ** share[4], 2),
            quality_factor=round(15.0 * 20.0 ** share[5], 1),
        )
        # without a junction there is no table
        if float(truth.impact.lowest) < 100.0:
            return truth


def exact_table(truth: ContactTruth, folder: Path) -> AmplitudeTable:
    """Return noise-free amplitudes of a contact, read from the folder or simulated and written there."""
    path = folder / f"contact_{SEED}_{truth.number}.csv"
    if not path.exists():
        made = simulate_experiment(
            Contact.paper(**truth.parameters),
            Cantilever(truth.frequency_khz, truth.quality_factor),
            truth.drives(),
            quality_factor_error=ERROR_OF_Q * truth.quality_factor,
            remarks=(f"random contact {truth.number}: {truth.parameters}",),
        )
        folder.mkdir(parents=True, exist_ok=True)
        write_table(made.exact, path)
    return read_table(path)
