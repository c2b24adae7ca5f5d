"""Do the 95 % bands of the energy of a tap hold the energies of simulated curves? `make energies` prints and judges.

Curves of laws with a restitution and a viscous loss and of contacts with a viscous bridge, force and base drive, on
resonance and 2 % above, and curves of two branches that change at other heights out than back: 0.3 % and 0.15 degrees
of noise, the instrument drawn from its stated errors (f0 1e-5, in a second set 1e-4; Q 1 %, k 5 %). A third set has
an exact instrument and 100 rows.
"""

import argparse
import itertools
import sys
from typing import NamedTuple

import numpy as np

from fitting.tables.table import AmplitudeTable
from fitting.tapping_curves.energy_fit import Z95
from fitting.tapping_curves.result import Tapping
from fitting.tapping_curves.tapping import tapping
from tests.tapping_truth_of_contacts import RATIOS, VISCOSITIES, curve_of_contact
from tests.tapping_truth_of_laws import (
    GRAPHITE,
    RAD_PER_US,
    Stated,
    Tip,
    Truth,
    curve_of_energy,
    curve_of_law,
    error_implied,
    table_of,
)

TIPS = (Tip(), Tip(free_nm=15.0, quality=250.0, stiffness=40.0, frequency_khz=300.0))
LAWS = list(itertools.product(TIPS, (1.0, 1.02), ("force", "base")))
CONTACTS = list(itertools.product(VISCOSITIES, RATIOS, ("force", "base")))
KINDS = ("law", "law", "law", "contact", "two branches")
EXACT = Stated(frequency=1e-9, quality=1e-9, stiffness=1e-9)
LOWEST, HIGHEST, LARGEST_Z, LARGEST_MEDIAN, LARGEST_EXACT = 0.92, 0.99, 4.0, 1.2, 0.03
"""Share of points in their bands, deviation in errors, its median over that of errors as stated and as implied by noise
and instrument, and relative error of an energy with an exact instrument."""
_MEDIAN = 0.6745
"""Of the size of a normal deviate."""


class Points(NamedTuple):
    """Points of the branches of a curve: true energy, how far off, its stated error, that implied, virial in errors."""

    true: np.ndarray
    off: np.ndarray
    error: np.ndarray
    implied: np.ndarray
    virial: np.ndarray

    @property
    def energy(self) -> np.ndarray:
        """How far energies are off, in their stated errors."""
        return self.off / self.error


class Simulated(NamedTuple):
    """A simulated curve: its kind, points, deviations of its hysteresis in errors, and whether it is valid."""

    kind: str
    points: Points
    hysteresis: np.ndarray
    valid: bool


def law_of(tip: Tip, rng: np.random.Generator):
    """Return the rebound speed of a random law: a restitution and a viscous loss, larger on resonance."""
    fast = tip.free_nm * RAD_PER_US * tip.frequency_khz
    restitution = rng.uniform(0.3, 0.8) if tip.ratio == 1.0 else rng.uniform(0.8, 0.98)
    loss = fast * (0.006 if tip.ratio == 1.0 else 0.03) * rng.uniform()
    return lambda u: np.sqrt(np.maximum((restitution * u) ** 2 - loss * u, (0.05 * u) ** 2))


class TwoWays(NamedTuple):
    """A curve out and back: its table, the truth of each branch, and the heights at which the branch changes."""

    table: AmplitudeTable
    truths: dict[tuple[bool, bool], Truth]
    heights_nm: tuple[float, float]


def two_ways(stated: Stated, rng: np.random.Generator, rows: int = 50) -> TwoWays:
    """Return a curve that leaves the attractive branch at one height and returns to it farther out.

    The energy is a share of what the air leaves a tap, another on each branch and on each way.
    """
    tip, step, spacing = GRAPHITE, 0.03 * GRAPHITE.free_nm, 0.6 * GRAPHITE.free_nm / rows
    most = np.pi * tip.stiffness * tip.free_nm**2 / tip.quality
    height = -tip.free_nm * 0.98 + spacing * np.arange(rows)
    changes = -tip.free_nm * rng.uniform(0.78, 0.83), -tip.free_nm * rng.uniform(0.88, 0.92)
    parts, truths = [], {}
    for retract, change in zip((False, True), changes, strict=True):
        repulsive = height > change
        ratio = np.where(repulsive, -height - step, -height) / tip.free_nm
        bent = 1.0 + rng.uniform(-0.3, 0.3) * (ratio - 0.7)
        part = np.where(repulsive, rng.uniform(0.5, 0.8), rng.uniform(0.2, 0.5)) * bent
        truth = curve_of_energy(tip, ratio, part * most * ratio * (1.0 - ratio), repulsive)._replace(height_nm=height)
        for state in (False, True):
            truths[retract, state] = Truth(*(column[repulsive == state] for column in truth))
        parts.append(truth)
    table = table_of(tip, parts[0], stated, rng, back=parts[1])
    return TwoWays(table, truths, changes)


def points_of(tip: Tip, result: Tapping, truths: dict[tuple[bool, bool], Truth], stated: Stated) -> Points:
    """Return how far the energies and virials of a result are from the truth of its branches, point by point."""
    free, parts = tip.free_reading[0], []
    for branch in result.branches:
        curve, truth = branch.curve, truths[branch.retract, branch.repulsive]
        energy, virial = (truth.at(f"{name}_aj", curve.amplitude_ratio, free) for name in ("energy", "virial"))
        errors = truth._replace(energy_aj=error_implied(tip, truth, stated))
        implied, off = errors.at("energy_aj", curve.amplitude_ratio, free), curve.energy_aj - energy
        parts.append((energy, off, curve.energy_error_aj, implied, (curve.virial_aj - virial) / curve.virial_error_aj))
    return Points(*map(np.concatenate, zip(*parts, strict=True)))


def hysteresis_off(result: Tapping, heights_nm: tuple[float, float]) -> np.ndarray:
    """Return how far the heights at which the branch changes are off, out and back, in their errors."""
    (change,) = (one for one in result.hysteresis if one.change == "branch")
    ends = zip((change.approach, change.retract), heights_nm, strict=True)
    return np.array([np.inf if end is None else (end.offset_nm - true) / end.standard_error for end, true in ends])


def random_curve(number: int, stated: Stated) -> Simulated:
    """Return how far a random curve is off; its kind goes round with its number."""
    kind = KINDS[number % len(KINDS)]
    rng = np.random.default_rng([number, round(1e6 * stated.frequency)])
    if kind == "two branches":
        out_and_back = two_ways(stated, rng)
        result = tapping(out_and_back.table, law=False)
        points = points_of(GRAPHITE, result, out_and_back.truths, stated)
        return Simulated(kind, points, hysteresis_off(result, out_and_back.heights_nm), result.valid)
    if kind == "contact":
        tip, truth = curve_of_contact(*CONTACTS[number % len(CONTACTS)])
    else:
        tip, ratio, drive = LAWS[number % len(LAWS)]
        tip = tip._replace(ratio=ratio, drive=drive)
        truth = curve_of_law(tip, -tip.free_nm * np.linspace(0.985, 0.12, 100), law_of(tip, rng))
    result = tapping(table_of(tip, truth, stated, rng), law=False)
    every = {(retract, repulsive): truth for retract in (False, True) for repulsive in (False, True)}
    kind += " on resonance" if tip.ratio == 1.0 else " above resonance"
    return Simulated(kind, points_of(tip, result, every, stated), np.zeros(0), result.valid)


def judge(name: str, found: list[Simulated], largest_share: float = np.inf) -> bool:
    """Print how a set of curves does, all and by kind; return whether all together are as wanted."""
    reached = True
    for kind in ("", *dict.fromkeys(one.kind for one in found)):
        chosen = [one for one in found if kind in {"", one.kind}]
        points = Points(*(np.concatenate(column) for column in zip(*(one.points for one in chosen), strict=True)))
        off, virial = np.abs(points.energy), np.abs(points.virial)
        covered, median = float(np.mean(off < Z95)), float(np.median(off)) / _MEDIAN
        of_implied = float(np.median(np.abs(points.off) / points.implied)) / _MEDIAN
        share = float(np.median(np.abs(points.off / points.true)))
        hysteresis = max((float(np.abs(one.hysteresis).max(initial=0.0)) for one in chosen), default=0.0)
        sys.stdout.write(
            f"{f'    {kind}' if kind else name}: {len(chosen)} curves, {sum(one.valid for one in chosen)} valid; "
            f"energy in its band at {covered:.3f} of {len(off)} points, largest deviation {off.max():.1f} errors, "
            f"median error {median:.2f} of those stated, {of_implied:.2f} of those that noise and instrument imply, "
            f"{share:.1%} of the energy; virial {np.mean(virial < Z95):.3f}, {virial.max():.1f}"
            + (f"; changes of branch within {hysteresis:.1f} errors\n" if hysteresis else "\n")
        )
        if not kind:
            reached = LOWEST <= covered <= HIGHEST and max(off.max(), hysteresis) <= LARGEST_Z
            reached &= max(median, of_implied) <= LARGEST_MEDIAN and share <= largest_share
    return reached


def main() -> int:
    """Measure, print and judge."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0] if __doc__ else None)
    parser.add_argument("--curves", type=int, default=200, help="curves of each set")
    numbers = range(parser.parse_args().curves)
    sets = [(f"f0 to {error:g}", Stated(frequency=error), np.inf) for error in (1e-5, 1e-4)]
    sets.append(("exact instrument", EXACT, LARGEST_EXACT))
    return sum(not judge(name, [random_curve(n, stated) for n in numbers], most) for name, stated, most in sets)


if __name__ == "__main__":
    sys.exit(main())
