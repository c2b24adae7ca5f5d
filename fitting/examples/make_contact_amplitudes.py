"""Make the bundled table of the full contact model: the experiment that the paper's conclusion proposes, simulated.

    python -m fitting.examples.make_contact_amplitudes [FILE]

The paper's contact on a cantilever of 90 kHz, Q = 40 and 1 ng; orders 1 to 4, drives around each subharmonic resonance
and on it, three offsets. Every row is a motion of the full scene in time, followed until it repeats. Peak and lock-in
amplitude carry independent Gaussian noise of 1 %, the phase 0.1 degree; Q is given as measured, 40 with a standard
error of 0.5. The seed makes it reproducible.
"""

import sys
from itertools import product
from pathlib import Path

import jax

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.contact.contact import Contact
from fitting.simulated.experiment import Drives, SimulatedExperiment, drives_of, simulate_experiment
from fitting.tables.table import write_table

ORDERS = (1, 2, 3, 4)
DRIVES_NM = (2.0, 4.0, 8.0)
OFFSETS_NM = (-1.0, 0.0, 1.0)
EXAMPLE = Path(__file__).with_name("amplitudes_contact.csv")


def example_drives(free_frequency_khz: float = 90.0) -> Drives:
    """Return the drives of the bundled table.

    Args:
        free_frequency_khz: of the cantilever; the drive frequencies go with it.
    """
    rows = []
    for number, (order, detuning, amplitude) in enumerate(product(ORDERS, (0.97, 0.985, 1.0, 1.01, 1.02), DRIVES_NM)):
        # the offset also moves on from one detuning to the next, so that it does not go with the drive
        offset = OFFSETS_NM[(number + number // len(DRIVES_NM)) % len(OFFSETS_NM)]
        rows.append((order, round(2.0 * free_frequency_khz * order * detuning, 4), amplitude, offset))
    return drives_of(rows)


def example_experiment() -> SimulatedExperiment:
    """Return the bundled table, made anew, with its noise-free amplitudes."""
    return simulate_experiment(
        Contact.paper(),
        Cantilever(90.0, 40.0),
        example_drives(),
        noise=0.01,
        phase_noise_deg=0.1,
        seed=1997,
        quality_factor_error=0.5,
        remarks=(
            "simulated single-impact orbits of the paper's contact (liquid bridge and solid junction), 1 ng",
            "truth: Q 40.0; noise 1 % and 0.1 degrees, seed 1997",
            "made by python -m fitting.examples.make_contact_amplitudes",
        ),
    )


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)  # noqa: FBT003
    write_table(example_experiment().table, sys.argv[1] if len(sys.argv) > 1 else EXAMPLE)
