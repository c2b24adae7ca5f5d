"""Whole fits of random contacts: how often 95 % bands and intervals hold the truth, which is not the fitted model.

    python -m tests.coverage_of_bands [--seeds 12]
    python -m tests.coverage_of_bands --intervals [--seeds 3]

Bands are those of the law of viscous+delay. With `--intervals` those of r and epsilon of law+delay are looked at: they
are to hold the r and epsilon of the formula that is closest to the true law over the rows' speeds, as those of a fit
are closest to its own.

Every contact is measured with noise of 0.3, 1 and 3 % and a Q that scatters by its error; the amplitudes are those of
the full scene (`contact_truths`), kept in /tmp. Counted are the approach speeds between 30 and 200 nm/us that were
measured. `make bands` runs it; the exit status is 1 if less is reached than is `WANTED`.

The errors of a law at all speeds are two or three numbers, so that the share of one table is mostly 1 and now and then
a half: that of a contact needs a dozen tables, which leave it a standard error of 0.05.
"""

import argparse
import dataclasses
import sys
import tempfile
import zlib
from collections.abc import Callable
from functools import partial
from itertools import chain, product
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from scipy.optimize import least_squares

from afm_jax.units import TWO_SIDED_95
from fitting.infer.explain import Explained
from fitting.infer.fit import fit, model_of
from fitting.infer.law import AtSpeeds
from fitting.infer.result import FittedLaw
from fitting.infer.rows import weights_of
from fitting.infer.search import begun, orbits_at
from fitting.models import task_of
from fitting.simulated.experiment import with_noise
from fitting.tables.table import AmplitudeTable
from tests.contact_truths import ERROR_OF_Q, ContactTruth, contact_truth, exact_table

WANTED = {0.003: (0.93, 1.7), 0.01: (0.95, 1.5), 0.03: (0.94, 1.3)}
"""Of a noise: mean coverage, and growth of the bands over those of the model taken at its word."""
INTERVALS = 0.92, 0.99
"""Between which the shares lie of the intervals of r, and of those of epsilon, that hold the truth's projection."""


class Measured(NamedTuple):
    """One fit against the truth, over the speeds.

    The share inside the band, the largest deviation over the half-width, the medians of the band's growth and of the
    relative error of the law; and chi2 per degree of freedom.
    """

    contact: int
    coverage: float
    worst_z: float
    growth: float
    error: float
    per_degree: float


def noisy(exact: AmplitudeTable, noise: float, random: np.random.Generator) -> AmplitudeTable:
    """Return a table as it would have been measured, Q too."""
    stated = dataclasses.replace(
        exact,
        peak_amplitude_error_nm=noise * np.asarray(exact.peak_amplitude_nm),
        lockin_amplitude_error_nm=noise * np.asarray(exact.lockin_amplitude_nm),
        quality_factor=(exact.quality_factor or 0.0) * (1.0 + ERROR_OF_Q * random.normal()),
    )
    return with_noise(stated, random.normal(size=(3, exact.rows)))


def measured(truth: ContactTruth, table: AmplitudeTable) -> Measured | None:
    """Return what a fit of a table amounts to; None where it is not valid."""
    result = fit(table, "viscous+delay")
    used = np.where(result.rows.used, result.rows.approach_speed_nm_per_us, np.nan)
    if not (result.valid and np.isfinite(used).any()):
        return None
    speeds = np.geomspace(max(30.0, np.nanmin(used)), min(200.0, np.nanmax(used)), 40)
    right = truth.rebound_and_delay(speeds)[0]
    inside = np.isfinite(right)
    speeds, right = speeds[inside], right[inside]
    fitted, half = law_at(result.law, speeds)
    z = np.abs(fitted - right) / half
    return Measured(
        contact=truth.number,
        coverage=float(np.mean(z <= 1.0)),
        worst_z=float(z.max()),
        growth=float(np.median(half / half_width_at_its_word(table)(speeds))),
        error=float(np.median(np.abs(fitted / right - 1.0))),
        per_degree=result.chi2 / result.degrees_of_freedom,
    )


def half_width_at_its_word(table: AmplitudeTable) -> Callable[[np.ndarray], np.ndarray]:
    """Return the half-width of the band of the formula alone, taken at its word, at approach speeds."""
    task = task_of(table, "viscous+delay")
    whole = model_of(table, task, {"fixed": {}, "held": ()})
    end = begun(whole)
    nothing = np.zeros(table.rows, bool)
    alone = Explained(
        whole, end, weights_of(whole, end.theta, end.orbits, nothing), orbits_at(whole, end.theta), 0.0, settled=True
    )
    at: AtSpeeds = alone.law_at
    return lambda speeds: TWO_SIDED_95 * np.linalg.norm(at(speeds).factor[0], axis=1)


class Held(NamedTuple):
    """Whether the intervals of r and of epsilon of a fit hold the projection of the true law."""

    contact: int
    r: float
    epsilon: float


def projection(speeds: np.ndarray, rebound: np.ndarray, weight: np.ndarray) -> tuple[float, float]:
    """Return r and epsilon of the formula of eq. 6 closest to a law: weighted least squares in u_out, within bounds."""

    def off(at: np.ndarray) -> np.ndarray:
        return weight * (np.sqrt(np.maximum((at[0] * speeds) ** 2 - 100.0 * at[1], 1e-6)) - rebound)

    found = least_squares(off, [0.99, 1.0], bounds=([0.01, 0.0], [1.0, np.inf]), x_scale=[1e-3, 0.1], xtol=1e-14)
    return float(found.x[0]), 100.0 * float(found.x[1])


def held(truth: ContactTruth, table: AmplitudeTable) -> Held | None:
    """Return whether the intervals of a fit to a table hold the projection of the true law; None: it is not valid."""
    result = fit(table, "law+delay")
    if not result.valid:
        return None
    speeds = result.rows.approach_speed_nm_per_us[result.rows.used]
    right = truth.rebound_and_delay(speeds)[0]
    inside = np.isfinite(right)
    _, half = law_at(result.law, speeds)
    values = projection(speeds[inside], right[inside], 1.0 / half[inside])
    inner = []
    for name, value in zip(("r", "epsilon"), values, strict=True):
        low, high = result.parameters[name].interval95
        # an end that is open is the end of the range
        inner.append(float((low is None or low <= value) and (high is None or value <= high)))
    return Held(truth.number, *inner)


def law_at(law: FittedLaw, speeds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rebound speeds and half-widths of the band at approach speeds."""
    columns = (law.rebound_speed_nm_per_us, law.rebound_high_nm_per_us - law.rebound_speed_nm_per_us)
    fitted, half = (np.interp(speeds, law.approach_speed_nm_per_us, column) for column in columns)
    return fitted, half


def of_intervals(fits: list[Held]) -> tuple[str, dict[str, bool]]:
    """Return a line about intervals, and what is wanted of them, with whether it is reached."""
    shares = {name: float(np.mean([getattr(fit, name) for fit in fits])) for name in ("r", "epsilon")}
    wanted = {
        f"{INTERVALS[0]:g} to {INTERVALS[1]:g} of {name}": INTERVALS[0] <= shares[name] <= INTERVALS[1]
        for name in shares
    }
    return f"coverage of r {shares['r']:.3f}, of epsilon {shares['epsilon']:.3f}", wanted


def of_bands(noise: float, fits: list[Measured]) -> tuple[str, dict[str, bool]]:
    """Return a line about the bands at a noise, and what is wanted of them, with whether it is reached."""
    contact, inside, z, growth, error, degree = np.array(fits).T
    shares = {number: float(np.mean(inside[contact == number])) for number in contact}
    worst = min(shares, key=shares.__getitem__)
    coverage, widest = WANTED[noise]
    line = (
        f"coverage {np.mean([*shares.values()]):.3f}, worst contact {shares[worst]:.2f} (number {worst:g}); worst |z| "
        f"{np.median(z):.2f}, {z.max():.2f} at most; bands {np.median(growth):.2f} times as wide; "
        f"chi2/dof {np.median(degree):.2f}; law error {100 * np.median(error):.3f} %"
    )
    return line, {
        f"coverage of {coverage:g}": bool(np.mean([*shares.values()]) >= coverage),
        "coverage of 0.85 of the worst contact": shares[worst] >= 0.85,
        "a worst |z| of 1.2 in the median, 2.5 at most": bool(np.median(z) <= 1.2 and z.max() <= 2.5),
        f"bands {widest:g} times as wide": bool(np.median(growth) <= widest),
        "a chi2/dof of 0.8 to 1.1": bool(0.8 <= np.median(degree) <= 1.1),
        "a law error of 0.1 % at 1 %": bool(noise != 0.01 or np.median(error) <= 1e-3),
    }


def main() -> int:
    """Measure, print and judge."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0] if __doc__ else None)
    parser.add_argument("--intervals", action="store_true", help="look at the intervals of r and epsilon, not at bands")
    parser.add_argument("--seeds", type=int, help="tables of each contact and noise (12, of intervals 3)")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)  # noqa: FBT003
    contacts, seeds, look = (20, 3, held) if options.intervals else (10, 12, measured)
    fits: dict[float, list[Any]] = {noise: [] for noise in WANTED}
    for number in range(contacts):
        truth = contact_truth(number)
        exact = exact_table(truth, Path(tempfile.gettempdir()) / "afm-jax-truths")
        for noise, seed in product(WANTED, range(options.seeds or seeds)):
            random = np.random.default_rng([zlib.crc32(str(noise).encode()), number, seed])
            fits[noise].append(look(truth, noisy(exact, noise, random)))
            sys.stderr.write(f"contact {number}, {100 * noise:g} %, table {seed}: {fits[noise][-1]}\n")
    sets = {f"{100 * noise:g} %": (some, partial(of_bands, noise)) for noise, some in fits.items()}
    if options.intervals:
        sets = {"intervals": (list(chain(*fits.values())), of_intervals)}
    missed = False
    for name, (some, judged) in sets.items():
        valid = [one for one in some if one is not None]
        line, wanted = judged(valid) if valid else ("", {"a valid fit": False})
        sys.stdout.write(f"{name}: {len(valid)} of {len(some)} valid; {line}\n")
        sys.stdout.write("".join(f"    MISSED: {each}\n" for each, reached in wanted.items() if not reached))
        missed |= not all(wanted.values())
    return int(missed)


if __name__ == "__main__":
    sys.exit(main())
