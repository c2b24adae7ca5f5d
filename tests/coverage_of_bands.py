"""Whole fits of random contacts: how often 95 % bands and intervals hold the truth, which is not the fitted model.

    python -m tests.coverage_of_bands [--contacts 0:10] [--seeds 12] [--model viscous+delay] [--truths FOLDER]
    python -m tests.coverage_of_bands --intervals [--contacts 0:20] [--seeds 3] [--model law+delay] [--truths FOLDER]

Bands are those of the law. With `--intervals` those of r and epsilon are looked at: they are to hold the r and epsilon
of the formula that is closest to the true law over the rows' speeds, as those of a fit are closest to its own.

Every contact is measured with noise of 0.3, 1 and 3 % and a Q that scatters by its error; the amplitudes are those of
the full scene (`contact_truths`), kept in the folder. Counted are the approach speeds between 30 and 200 nm/us that
were measured. `make bands` runs it; the exit status is 1 if less is reached than is `WANTED`.

The errors of a law at all speeds are two or three numbers, so that the share of one table is mostly 1 and now and then
a half: that of a contact needs a dozen tables, which leave it a standard error of 0.05.
"""

import argparse
import dataclasses
import sys
import tempfile
import zlib
from collections.abc import Callable
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

NOISES = (0.003, 0.01, 0.03)
SLOWEST, FASTEST = 30.0, 200.0
_SPEEDS = 40


WANTED = {0.003: (0.93, 1.7), 0.01: (0.95, 1.5), 0.03: (0.94, 1.3)}
"""Of a noise: mean coverage, and growth of the bands over those of the model taken at its word."""
WORST_CONTACT = 0.85
MEDIAN_Z, WORST_Z = 1.2, 2.5
PER_DEGREE = (0.8, 1.1)
LAW_ERROR = 1e-3
"""Median relative error of the law of viscous+delay at 1 % noise."""


class Measured(NamedTuple):
    """One fit against the truth, over the speeds.

    The share inside the band, the largest deviation over the half-width, the medians of the band's growth and of the
    relative error of the law; and chi2 per degree of freedom.
    """

    contact: int
    valid: bool
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


def measured(truth: ContactTruth, table: AmplitudeTable, model: str) -> Measured:
    """Return what a fit of a table amounts to."""
    result = fit(table, model)
    used = np.where(result.rows.used, result.rows.approach_speed_nm_per_us, np.nan)
    if not (result.valid and np.isfinite(used).any()):
        return Measured(truth.number, False, *(np.full(5, np.nan).tolist()))  # noqa: FBT003
    speeds = np.geomspace(max(SLOWEST, np.nanmin(used)), min(FASTEST, np.nanmax(used)), _SPEEDS)
    right = truth.rebound_and_delay(speeds)[0]
    inside = np.isfinite(right)
    speeds, right = speeds[inside], right[inside]
    fitted, half = law_at(result.law, speeds)
    z = np.abs(fitted - right) / half
    return Measured(
        contact=truth.number,
        valid=True,
        coverage=float(np.mean(z <= 1.0)),
        worst_z=float(z.max()),
        growth=float(np.median(half / half_width_at_its_word(table, model)(speeds))),
        error=float(np.median(np.abs(fitted / right - 1.0))),
        per_degree=result.chi2 / result.degrees_of_freedom,
    )


def half_width_at_its_word(table: AmplitudeTable, model: str) -> Callable[[np.ndarray], np.ndarray]:
    """Return the half-width of the band of the formula alone, taken at its word, at approach speeds."""
    task = task_of(table, model)
    whole = model_of(table, task, {"fixed": {}, "held": ()})
    end = begun(whole)
    nothing = np.zeros(table.rows, bool)
    alone = Explained(
        whole, end, weights_of(whole, end.theta, end.orbits, nothing), orbits_at(whole, end.theta), 0.0, settled=True
    )
    at: AtSpeeds = alone.law_at
    return lambda speeds: TWO_SIDED_95 * np.linalg.norm(at(speeds).factor[0], axis=1)


INTERVALS = 0.92, 0.99
"""Between which the shares lie of the intervals of r, and of those of epsilon, that hold the truth's projection."""


class Held(NamedTuple):
    """Whether the intervals of r and of epsilon of a fit hold the projection of the true law; NaN: not a valid fit."""

    contact: int
    r: float
    epsilon: float


def projection(speeds: np.ndarray, rebound: np.ndarray, weight: np.ndarray) -> tuple[float, float]:
    """Return r and epsilon of the formula of eq. 6 closest to a law: weighted least squares in u_out, within bounds."""

    def off(at: np.ndarray) -> np.ndarray:
        return weight * (np.sqrt(np.maximum((at[0] * speeds) ** 2 - 100.0 * at[1], 1e-6)) - rebound)

    found = least_squares(off, [0.99, 1.0], bounds=([0.01, 0.0], [1.0, np.inf]), x_scale=[1e-3, 0.1], xtol=1e-14)
    return float(found.x[0]), 100.0 * float(found.x[1])


def held(truth: ContactTruth, table: AmplitudeTable, model: str) -> Held:
    """Return whether the intervals of a fit to a table hold the projection of the true law."""
    result = fit(table, model)
    if not result.valid:
        return Held(truth.number, np.nan, np.nan)
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


def intervals_missed(fits: list[Held]) -> tuple[str, list[str]]:
    """Return a line about the intervals, and which of the two shares are not as wanted."""
    valid = [fit for fit in fits if np.isfinite(fit.r)]
    if not valid:
        return "intervals: no valid fit", ["a valid fit"]
    shares = {name: float(np.mean([getattr(fit, name) for fit in valid])) for name in ("r", "epsilon")}
    line = (
        f"intervals: {len(valid)} of {len(fits)} fits of {len({fit.contact for fit in valid})} contacts valid; "
        f"coverage of r {shares['r']:.3f}, of epsilon {shares['epsilon']:.3f}"
    )
    least, most = INTERVALS
    return line, [f"{least:g} to {most:g} of {name}" for name, share in shares.items() if not least <= share <= most]


def law_at(law: FittedLaw, speeds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rebound speeds and half-widths of the band at approach speeds."""
    columns = (law.rebound_speed_nm_per_us, law.rebound_high_nm_per_us - law.rebound_speed_nm_per_us)
    fitted, half = (np.interp(speeds, law.approach_speed_nm_per_us, column) for column in columns)
    return fitted, half


def shortfalls(noise: float, fits: list[Measured], model: str) -> tuple[str, list[str]]:
    """Return a line about the fits at a noise, and what is not as wanted."""
    valid = [fit for fit in fits if fit.valid]
    if not valid:
        return f"{100 * noise:g} %: no valid fit", ["a valid fit"]
    contacts = sorted({fit.contact for fit in valid})
    shares = [np.mean([fit.coverage for fit in valid if fit.contact == contact]) for contact in contacts]
    z, growth, error, degree = (
        np.array([getattr(fit, name) for fit in valid]) for name in ("worst_z", "growth", "error", "per_degree")
    )
    coverage, widest = WANTED[noise]
    line = (
        f"{100 * noise:g} %: {len(valid)} of {len(fits)} valid; coverage {np.mean(shares):.3f}, worst contact "
        f"{min(shares):.2f} (number {contacts[int(np.argmin(shares))]}); worst |z| {np.median(z):.2f} in the median, "
        f"{z.max():.2f} at most; bands {np.median(growth):.2f} times as wide; chi2/dof {np.median(degree):.2f}; "
        f"law error {100 * np.median(error):.3f} %"
    )
    tests = {
        f"coverage of {coverage:g}": np.mean(shares) >= coverage,
        f"coverage of {WORST_CONTACT:g} of the worst contact": min(shares) >= WORST_CONTACT,
        f"a median worst |z| of {MEDIAN_Z:g}": np.median(z) <= MEDIAN_Z,
        f"a worst |z| of {WORST_Z:g}": z.max() <= WORST_Z,
        f"bands {widest:g} times as wide": np.median(growth) <= widest,
        f"a chi2/dof of {PER_DEGREE[0]:g} to {PER_DEGREE[1]:g}": PER_DEGREE[0] <= np.median(degree) <= PER_DEGREE[1],
    }
    if noise == 0.01 and model == "viscous+delay":
        tests[f"a law error of {100 * LAW_ERROR:g} %"] = np.median(error) <= LAW_ERROR
    return line, [name for name, reached in tests.items() if not reached]


def main() -> int:
    """Measure, print and judge."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0] if __doc__ else None)
    parser.add_argument("--intervals", action="store_true", help="look at the intervals of r and epsilon, not at bands")
    parser.add_argument("--contacts", help="numbers of the random contacts, first:end (0:10, of intervals 0:20)")
    parser.add_argument("--seeds", type=int, help="tables of each contact and noise (12, of intervals 3)")
    parser.add_argument("--model", help="viscous+delay, of intervals law+delay")
    parser.add_argument("--truths", type=Path, default=Path(tempfile.gettempdir()) / "afm-jax-truths")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)  # noqa: FBT003
    usual = ("0:20", 3, "law+delay", held) if options.intervals else ("0:10", 12, "viscous+delay", measured)
    contacts, seeds, model, look = usual
    first, end = (int(number) for number in (options.contacts or contacts).split(":"))
    model = options.model or model
    fits: dict[float, list[Any]] = {noise: [] for noise in NOISES}
    for number in range(first, end):
        truth = contact_truth(number)
        exact = exact_table(truth, options.truths)
        for noise, seed in ((noise, seed) for noise in NOISES for seed in range(options.seeds or seeds)):
            random = np.random.default_rng([zlib.crc32(str(noise).encode()), number, seed])
            found = look(truth, noisy(exact, noise, random), model)
            fits[noise].append(found)
            sys.stderr.write(f"contact {number}, {100 * noise:g} %, table {seed}: {found}\n")
    if options.intervals:
        told = [intervals_missed([one for some in fits.values() for one in some])]
    else:
        told = [shortfalls(noise, some, model) for noise, some in fits.items()]
    for line, missed in told:
        sys.stdout.write(f"{line}\n" + "".join(f"    MISSED: {name}\n" for name in missed))
    return 1 if any(missed for _, missed in told) else 0


if __name__ == "__main__":
    sys.exit(main())
