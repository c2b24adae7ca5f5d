"""Do the 95 % bands of the energy of a tap hold the energies of simulated curves? `make energies` prints and judges.

*Shapes*: seven courses of the energy over a = A/A0 on resonance, four levers, force and base drive, one way or both.
The instrument is drawn from what is stated of it (f0 1e-5, 1e-4 or the usual 2e-4; Q 1 %, k 5 %), and in a third of the
curves the zero of the phase is stated to 0.2 degrees. The truth must be in its band at 0.92 to 1 of the points of every
shape and every lever, and nowhere more than four errors off where the instrument was drawn within three of its errors.

*Laws and contacts*: curves of laws with a restitution and a viscous loss and of contacts with a viscous bridge, force
and base drive, on resonance and 2 % above, and curves of two branches that change at other heights out than back: 0.3 %
and 0.15 degrees of noise. The last set has an exact instrument and 100 rows.
"""

import argparse
import itertools
import sys
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.interpolate import PchipInterpolator

from afm_jax.units import TWO_SIDED_95
from fitting.tables.table import AmplitudeTable
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
LOWEST, LARGEST_Z, LARGEST_MEDIAN, LARGEST_EXACT = 0.92, 4.0, 1.2, 0.03
"""Share of points in their bands, deviation in errors, its median over that of errors as stated and as implied by noise
and instrument, and relative error of an energy with an exact instrument."""


def step(ratio: np.ndarray) -> np.ndarray:
    """Return an energy that jumps where the attractive branch ends."""
    return np.where(ratio >= ATTRACTIVE_TO, 0.3, 1.0) * np.sqrt(1.0 - ratio)


ATTRACTIVE_TO = 0.8
"""Amplitude, of the free one, at which the attractive branch of the step ends."""
SHAPES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "constant": np.ones_like,
    "sqrt(1 - a)": lambda a: np.sqrt(1.0 - a),
    "a sqrt(1 - a)": lambda a: a * np.sqrt(1.0 - a),
    "a (1 - a)": lambda a: a * (1.0 - a),
    "graphite": PchipInterpolator(
        [0.0, 0.5, 0.8, 0.86, 0.9, 0.92, 0.94, 0.98, 1.0], [9, 12, 12, 10.9, 9.3, 7.6, 4.2, 1.6, 0]
    ),
    "step": step,
    "saturation": lambda a: 1.0 - np.exp(-(1.0 - a) / 0.1),
}
"""Courses of the energy over a = A/A0, up to a factor; on the attractive branch those that begin there."""
LEVERS = {
    "k 2": Tip(free_nm=60.0, quality=120.0, stiffness=2.0, frequency_khz=70.0),
    "k 5.4": Tip(),
    "k 40": Tip(free_nm=20.0, quality=400.0, stiffness=40.0, frequency_khz=300.0),
    "k 44": GRAPHITE,
}
FARTHEST = 3.0
"""Errors of frequency, Q and k together up to which a deviation counts by its size: farther off no band can hold."""
FREQUENCIES = (1e-5, 1e-4, 2e-4)
"""Relative errors of the free frequency: calibrated, stated with care, and the usual one."""


def curve_of_shape(shape: str, tip: Tip, largest: float, rows: int = 120) -> tuple[Truth, np.ndarray]:
    """Return a curve on resonance of a course of the energy, and which rows are repulsive.

    Args:
        shape: one of `SHAPES`.
        tip: the cantilever.
        largest: energy over the most that a tap can take, where it comes nearest to that.
        rows: of the curve.
    """
    ratio = np.linspace(0.985 if shape in {"graphite", "step", "a (1 - a)"} else 0.93, 0.2, rows)
    most = np.pi * tip.stiffness * tip.free_nm**2 / tip.quality * ratio * (1.0 - ratio)
    energy = SHAPES[shape](ratio)
    energy *= largest / np.max(energy / most)
    repulsive = ratio < {"step": ATTRACTIVE_TO, "graphite": 0.912}.get(shape, 1.0)
    return curve_of_energy(tip, ratio, energy, repulsive), repulsive


def sides_of(truth: Truth, repulsive: np.ndarray | None = None) -> dict[tuple[bool, bool], Truth]:
    """Return what is true on each way and side of a curve that jumps between the sides, or that does not."""
    keep = {side: slice(None) if repulsive is None else repulsive == side for side in (False, True)}
    sides = {side: Truth(*(column[rows] for column in truth)) for side, rows in keep.items()}
    return {(retract, side): sides[side] for retract in (False, True) for side in (False, True)}


def shaped_curve(shape: str, lever: str, number: int) -> "Simulated":
    """Return how far a random curve of a shape and a lever is off."""
    rng = np.random.default_rng([number, list(SHAPES).index(shape), list(LEVERS).index(lever)])
    tip = LEVERS[lever]._replace(drive=("force", "base")[number % 2])
    truth, repulsive = curve_of_shape(shape, tip, rng.uniform(0.05, 0.9), int(rng.integers(60, 200)))
    stated = Stated(frequency=FREQUENCIES[number % 3], phase_noise_deg=0.2)
    zero = {"phase_zero_deg": (3.0 + 0.2 * rng.normal(), 0.2)} if rng.uniform() < 1.0 / 3.0 else {}
    also = {"calibration": {"tip_calibration": (1.0, 1e-6)} | zero, "back": truth if rng.uniform() < 0.5 else None}
    table = table_of(tip, truth, stated, rng, **also)
    result = tapping(table, law=False)
    said = table.free_frequency_khz, table.quality_factor, table.spring_constant_n_per_m
    true = tip.frequency_khz, tip.quality, tip.stiffness
    off = [(float(one or 0.0) / other - 1.0) / e for one, other, e in zip(said, true, stated[:3], strict=True)]
    # where nothing jumps, rows whose lag is next to the free one may count as of the other side
    points = points_of(tip, result, sides_of(truth, repulsive if shape == "step" else None), stated)
    return Simulated(f"{shape}, {lever}", points, np.zeros(0), result.valid, float(np.linalg.norm(off)))


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
    """A simulated curve: its kind, points, deviations of its hysteresis in errors, whether it is valid.

    ``drawn`` is how far f0, Q and k as stated are from the truth, all together, in their errors.
    """

    kind: str
    points: Points
    hysteresis: np.ndarray
    valid: bool
    drawn: float = 0.0


def law_of(tip: Tip, rng: np.random.Generator):
    """Return the rebound speed of a random law: a restitution and a viscous loss, larger on resonance."""
    fast = tip.free_nm * RAD_PER_US * tip.frequency_khz
    restitution = rng.uniform(0.3, 0.8) if tip.ratio == 1.0 else rng.uniform(0.8, 0.98)
    loss = fast * (0.006 if tip.ratio == 1.0 else 0.03) * rng.uniform()
    return lambda u: np.sqrt(np.maximum((restitution * u) ** 2 - loss * u, (0.05 * u) ** 2))


Sides = dict[tuple[bool, bool], Truth]


def two_ways(stated: Stated, rng: np.random.Generator) -> tuple[AmplitudeTable, Sides, tuple[float, float]]:
    """Return a curve that leaves the attractive branch at one height and returns to it farther out, and its truth.

    The energy is a share of what the air leaves a tap, another on each branch and on each way.
    """
    tip, step, rows = GRAPHITE, 0.03 * GRAPHITE.free_nm, 50
    most = np.pi * tip.stiffness * tip.free_nm**2 / tip.quality
    height = tip.free_nm * (-0.98 + 0.6 / rows * np.arange(rows))
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
    return table_of(tip, parts[0], stated, rng, back=parts[1]), truths, changes


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
        table, truths, heights_nm = two_ways(stated, rng)
        result = tapping(table, law=False)
        points = points_of(GRAPHITE, result, truths, stated)
        return Simulated(kind, points, hysteresis_off(result, heights_nm), result.valid)
    if kind == "contact":
        tip, truth = curve_of_contact(*CONTACTS[number % len(CONTACTS)])
    else:
        tip, ratio, drive = LAWS[number % len(LAWS)]
        tip = tip._replace(ratio=ratio, drive=drive)
        truth = curve_of_law(tip, -tip.free_nm * np.linspace(0.985, 0.12, 100), law_of(tip, rng))
    result = tapping(table_of(tip, truth, stated, rng), law=False)
    kind += " on resonance" if tip.ratio == 1.0 else " above resonance"
    return Simulated(kind, points_of(tip, result, sides_of(truth), stated), np.zeros(0), result.valid)


class Said(NamedTuple):
    """Share of points in their bands, largest deviation in errors, medians over those of errors, of the energy."""

    covered: float
    largest: float
    medians: float
    share: float


def said(name: str, found: list[Simulated]) -> Said:
    """Print how curves do, and return it; the largest deviation of those whose instrument was drawn near the truth."""
    points = Points(*(np.concatenate(column) for column in zip(*(one.points for one in found), strict=True)))
    near = np.concatenate([np.full(len(one.points.true), one.drawn < FARTHEST) for one in found])
    off, virial = np.abs(points.energy), np.abs(points.virial)
    hysteresis = max(float(np.abs(one.hysteresis).max(initial=0.0)) for one in found)
    # 0.6745 is the median size of a normal deviate
    median, of_implied = (float(np.median(np.abs(some))) / 0.6745 for some in (off, points.off / points.implied))
    share = float(np.median(np.abs(points.off / points.true)))
    largest, covered = float(off.max(where=near, initial=0.0)), float(np.mean(off < TWO_SIDED_95))
    sys.stdout.write(
        f"{name}: {sum(one.valid for one in found)} of {len(found)} valid; {covered:.3f} of {len(off)} energies in "
        f"their bands, largest deviation {largest:.1f} errors, median {median:.2f} of those stated, "
        f"{of_implied:.2f} of those implied by noise and instrument, {share:.1%} of the energy; "
        f"virial {np.mean(virial < TWO_SIDED_95):.3f}, {virial.max():.1f}; "
        f"changes of branch within {hysteresis:.1f} errors\n"
    )
    return Said(covered, max(largest, hysteresis), max(median, of_implied), share)


def judge_shapes(curves: int) -> bool:
    """Print how the bands of every shape and lever do; return whether each is as wanted."""
    found = {pair: [shaped_curve(*pair, n) for n in range(curves)] for pair in itertools.product(SHAPES, LEVERS)}
    # those of one shape and lever are too few to be judged by their share: errors of a curve go together
    reached = max([said(", ".join(pair), some).largest for pair, some in found.items()]) <= LARGEST_Z
    for name in (*SHAPES, *LEVERS):
        some = said(name, [one for pair, some in found.items() if name in pair for one in some])
        reached &= some.covered >= LOWEST
    return reached


def judge(name: str, found: list[Simulated], largest_share: float) -> bool:
    """Print how a set of curves does, all and by kind; return whether all together are as wanted."""
    for kind in dict.fromkeys(one.kind for one in found):
        said(f"    {kind}", [one for one in found if one.kind == kind])
    every = said(name, found)
    within = every.covered >= LOWEST and every.largest <= LARGEST_Z
    return within and every.medians <= LARGEST_MEDIAN and every.share <= largest_share


def main() -> int:
    """Measure, print and judge."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0] if __doc__ else None)
    parser.add_argument("--curves", type=int, default=200, help="curves of each set of laws and contacts")
    parser.add_argument("--shaped", type=int, default=75, help="curves of each shape and lever")
    arguments = parser.parse_args()
    reached = judge_shapes(arguments.shaped)
    sets = [(f"f0 to {error:g}", Stated(frequency=error), np.inf) for error in (1e-5, 1e-4)]
    for name, stated, most in (*sets, ("exact instrument", EXACT, LARGEST_EXACT)):
        reached &= judge(name, [random_curve(number, stated) for number in range(arguments.curves)], most)
    return int(not reached)


if __name__ == "__main__":
    sys.exit(main())
