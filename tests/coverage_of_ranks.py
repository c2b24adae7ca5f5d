"""Simulation-based calibration of whole posteriors, with many simulated tables of the bundled ones.

    python -m tests.coverage_of_ranks [--sets 1000]

A line for each table and model; then the same posterior a fifth too narrow and half a standard deviation off, which
must be noticed. `make ranks` runs it; the exit status is 1 if a posterior is not uniform, or a wrong one is taken for
right.
"""

import argparse
import sys
from pathlib import Path

import jax

import fitting.examples
from fitting import fit, posterior, read_table
from fitting.sampling.draws import posterior_draws, refit_of_rows
from fitting.sampling.rank_calibration import calibrate_ranks

TABLES = (
    ("amplitudes_law.csv", "law"),
    ("amplitudes_contact.csv", "viscous+delay"),
)
PROBABILITY = 1e-3


def main() -> int:
    """Simulate, print and judge."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0] if __doc__ else None)
    parser.add_argument("--sets", type=int, default=1000, help="simulated tables of each")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)  # noqa: FBT003
    missed = 0
    for name, model in TABLES:
        result = fit(read_table(Path(fitting.examples.__path__[0]) / name), model)
        drawn = posterior_draws(result, posterior(result)).values
        drawn = drawn.reshape(-1, drawn.shape[2])
        middle, error = drawn.mean(axis=0), drawn.std(axis=0)
        narrow, shifted = middle + 0.8 * (drawn - middle), drawn + 0.5 * error
        for said, draws in (("as sampled", drawn), ("a fifth too narrow", narrow), ("half an error off", shifted)):
            ranks = calibrate_ranks(refit_of_rows(result)[0], draws, sets=options.sets)
            right = (ranks.p_value >= PROBABILITY) == (said == "as sampled")
            missed += not right
            sys.stdout.write(
                f"{name}, {model}, {said}: probability {ranks.p_value:.2g}, Gaussian {ranks.gaussian_p_value:.2g}, "
                f"{ranks.failed} of {options.sets} failed{'' if right else '  MISSED'}\n"
            )
            sys.stdout.flush()
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
