"""Do the 95 % bands of the energy of a tap hold the energies of simulated curves? `make energies` prints and judges.

Curves of laws with a restitution and a viscous loss, force and base drive, on resonance and 2 % above, 0.3 % and 0.15
degrees of noise, the instrument drawn from its stated errors (f0 1e-5, in a second set 1e-4; Q 1 %, k 5 %).
"""

import argparse
import itertools
import sys
from typing import NamedTuple

import numpy as np

from fitting.tapping_curves.tapping import tapping
from tests.tapping_truth_of_laws import RAD_PER_US, Stated, Tip, Truth, curve_of_law, table_of

TIPS = (Tip(), Tip(free_nm=15.0, quality=250.0, stiffness=40.0, frequency_khz=300.0))
LOWEST, HIGHEST, LARGEST_Z, LARGEST_MEDIAN = 0.92, 0.99, 4.0, 1.2
"""Share of points in their bands, deviation in errors, and its median over that of errors as stated."""


class Deviations(NamedTuple):
    """Deviations of energy and virial along a curve, in their stated errors, and whether it is valid."""

    energy: np.ndarray
    virial: np.ndarray
    valid: bool


def law_of(tip: Tip, rng: np.random.Generator):
    """Return the rebound speed of a random law: a restitution and a viscous loss, larger on resonance."""
    fast = tip.free_nm * RAD_PER_US * tip.frequency_khz
    restitution = rng.uniform(0.3, 0.8) if tip.ratio == 1.0 else rng.uniform(0.8, 0.98)
    loss = fast * (0.006 if tip.ratio == 1.0 else 0.03) * rng.uniform()
    return lambda u: np.sqrt(np.maximum((restitution * u) ** 2 - loss * u, (0.05 * u) ** 2))


def deviations(tip: Tip, truth: Truth, stated: Stated, rng: np.random.Generator) -> Deviations:
    """Return how far the energies and virials of a noisy table are from the truth, point by point."""
    result = tapping(table_of(tip, truth, stated, rng), law=False)
    free = tip.free_reading[0]
    parts = []
    for name in ("energy", "virial"):
        column = []
        for branch in result.branches:
            curve = branch.curve
            true = truth.at(f"{name}_aj", curve.amplitude_ratio, free)
            column.append((getattr(curve, f"{name}_aj") - true) / getattr(curve, f"{name}_error_aj"))
        parts.append(np.concatenate(column))
    return Deviations(parts[0], parts[1], result.valid)


def random_curve(number: int, frequency_error: float) -> Deviations:
    """Return the deviations of one random curve; its kind goes round with its number."""
    kinds = list(itertools.product(TIPS, (1.0, 1.02), ("force", "base")))
    rng = np.random.default_rng([number, round(1e6 * frequency_error)])
    tip, ratio, drive = kinds[number % len(kinds)]
    tip = tip._replace(ratio=ratio, drive=drive)
    truth = curve_of_law(tip, -tip.free_nm * np.linspace(0.985, 0.12, 100), law_of(tip, rng))
    return deviations(tip, truth, Stated(frequency=frequency_error), rng)


def main() -> int:
    """Measure, print and judge."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0] if __doc__ else None)
    parser.add_argument("--curves", type=int, default=200, help="curves of each set")
    missed = 0
    for frequency_error in (1e-5, 1e-4):
        found = [random_curve(number, frequency_error) for number in range(parser.parse_args().curves)]
        off = np.abs(np.concatenate([one.energy for one in found]))
        covered, median = float(np.mean(off < 1.96)), float(np.median(off)) / 0.6745
        virial = np.abs(np.concatenate([one.virial for one in found]))
        sys.stdout.write(
            f"f0 to {frequency_error:g}: {len(found)} curves, {sum(one.valid for one in found)} valid; energy in its "
            f"band at {covered:.3f} of {len(off)} points, largest deviation {off.max():.1f} errors, median "
            f"{median:.2f} of what the errors imply; virial {np.mean(virial < 1.96):.3f}, {virial.max():.1f}\n"
        )
        missed += not (LOWEST <= covered <= HIGHEST and off.max() <= LARGEST_Z and median <= LARGEST_MEDIAN)
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
