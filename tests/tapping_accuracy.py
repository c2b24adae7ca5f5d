"""Tapping curves of random contacts: what is predicted of them, and what whole fits of them give back.

    python -m tests.tapping_accuracy [--contacts 0:6] [--seeds 2] [--truths FOLDER]

The truth is the full scene in time, kept in the folder. Forward: amplitude and lag that the contact's own table of
collisions predicts, at speeds of 4 times the capture speed and more and pulls below 0.8 times what turns the tip round.
Fits: two free amplitudes 3 % above resonance, without noise and with 0.3 % and 0.2 degrees, frequency, Q, calibration,
origin and zero of phase free within their errors. `make tapping` runs it; the exit status is 1 if less is reached than
is wanted. Contacts whose law is refused (too few fast impacts) or whose fit is not valid are counted.
"""

import argparse
import sys
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.surface import detected
from afm_jax.impact.closure import OrbitProblem
from afm_jax.impact.lasting_impact import TabulatedImpact, middle_of_contact
from afm_jax.impact.orbits import orbit_state, readings_of, steady_orbits
from fitting.infer.fit import fit
from fitting.infer.result import FitResult
from fitting.simulated.experiment import with_noise
from fitting.tables.table import AmplitudeTable
from tests.tapping_truths import MASS_NG, SHARES, TappingTruth, as_measured, exact_table, tapping_truth

RATIO, HIGHER_RATIO = 1.03, 1.1
FASTER, LONGEST_PULL = 4.0, 0.8
FEW_SHARES = tuple(np.linspace(0.88, 0.16, 8).tolist())
LARGEST_NM, LARGEST_DEG, MEDIAN_SHARE, MEDIAN_DEG = 0.07, 0.1, 1e-3, 0.01
"""What is wanted of predictions."""
MEDIAN_LAW, WORST_LAW, NOISE_FREE_LAW = 0.006, 0.012, 0.003
"""And of fitted laws, relative."""
NOISE_FREE_CALIBRATION = 1e-3
KNOWN = ("tip_radius_nm", "relative_humidity")
"""Of a contact, where it is fitted: fast impacts say nothing of the humidity."""
WORST_OF_CONTACT = 0.01
"""Relative, of laws from fits of the contact."""
_SPEEDS, _NEAREST = 60, 1.05


class Forward(NamedTuple):
    """Of each row: errors in nm and degrees, the amplitude, speed over capture and g tau/u."""

    nm: Any
    degrees: Any
    amplitude_nm: Any
    speed: Any
    pull: Any

    def fast(self, *, pull_from: float = -np.inf, pull_to: float = LONGEST_PULL) -> "Forward":
        """Return the rows that are fast enough, under so much of a pull, sizes in place of errors."""
        used = (self.speed > FASTER) & (self.pull > pull_from) & (self.pull < pull_to) & np.isfinite(self.nm)
        return Forward(*(np.abs(np.asarray(part)[used]) for part in self))


@jax.jit
def _predicted(impact: TabulatedImpact, quality_factor, frequency_khz, free_nm, offset_nm, read) -> Forward:
    """Return how far the steady orbit nearest to what was read is from it."""

    def one(frequency_khz, free_nm, offset_nm, read):
        cantilever = Cantilever(90.0, quality_factor, MASS_NG)
        platform = Platform(free_nm, frequency_khz, offset_nm)
        problem = OrbitProblem(cantilever, platform, impact, jnp.ones(()))
        orbits = steady_orbits(problem)
        slot = jnp.argmax(jnp.where(orbits.steady, orbits.place.coordinate, -jnp.inf))
        place = jax.tree.map(lambda part: part[slot], orbits.place)
        state = orbit_state(place, problem)
        _, amplitude, phase = readings_of(orbit_state(place, problem), problem)
        ratio = frequency_khz / 90.0
        size, lag = detected(amplitude, phase, free_nm, ratio, quality_factor, base=False)
        middle = middle_of_contact(cantilever, platform, state.flight.start_us - 0.5 * state.speeds.delay)
        u = state.speeds.approach
        turn = (lag - read[1] + 180.0) % 360.0 - 180.0
        error = jnp.where(orbits.steady[slot], size - read[0], jnp.nan)
        return Forward(error, turn, read[0], u / impact.lowest, middle.acceleration * impact.hertz_contact.time(u) / u)

    return jax.vmap(one)(frequency_khz, free_nm, offset_nm, read)


def forward(truth: TappingTruth, exact: AmplitudeTable) -> Forward:
    """Return the errors of what the contact's table of collisions predicts for a table's rows."""
    size = 2 * len(SHARES)
    columns = (exact.drive_frequency_khz, exact.excitation_nm, exact.offset_nm)
    read = np.stack([np.asarray(exact.lockin_amplitude_nm), np.asarray(exact.phase_lag_deg)], axis=1)
    filled = [jnp.asarray(np.resize(column, (size, *column.shape[1:]))) for column in (*columns, read)]
    found = _predicted(truth.impact, jnp.asarray(truth.quality_factor), *filled)
    return Forward(*(np.asarray(part)[: exact.rows] for part in found))


class Fitted(NamedTuple):
    """A fit: relative errors of the law over the speeds covered, calibration less 1 and its error, rows used."""

    law: np.ndarray
    calibration: float
    calibration_error: float
    rows: int


def fitted(truth: TappingTruth, table: AmplitudeTable) -> Fitted | None:
    """Return what a valid fit gives; None where the law is refused or the fit says that it is not valid."""
    result = fit(table, "viscous+delay")
    return against_truth(truth, result) if result.valid else None


def contact_of(truth: TappingTruth, table: AmplitudeTable) -> FitResult:
    """Return the fit of the contact to a table, the tip's radius and the humidity known."""
    return fit(table, "contact", fixed={name: truth.parameters[name] for name in KNOWN})


def speeds_covered(truth: TappingTruth, result: FitResult) -> np.ndarray:
    """Return speeds from the slowest to the fastest impact of the rows used, above capture."""
    used = result.rows.approach_speed_nm_per_us[result.rows.used]
    return np.linspace(max(np.nanmin(used), _NEAREST * float(truth.impact.lowest)), np.nanmax(used), _SPEEDS)


def against_truth(truth: TappingTruth, result: FitResult) -> Fitted | None:
    """Return how a fit's law compares with the truth where that is free; None where it has no speeds."""
    used, found = result.rows.used, result.parameters["tip_calibration"]
    if found.standard_error is None or not np.isfinite(result.rows.approach_speed_nm_per_us[used]).any():
        return None
    speeds = speeds_covered(truth, result)
    law = np.interp(speeds, result.law.approach_speed_nm_per_us, result.law.rebound_speed_nm_per_us)
    return Fitted(law / truth.rebound(speeds) - 1.0, found.value - 1.0, found.standard_error, int(used.sum()))


def noisy(exact: AmplitudeTable, truth: TappingTruth, seed: int) -> AmplitudeTable:
    """Return a table as it would have been measured."""
    return with_noise(exact, np.random.default_rng([truth.number, seed]).normal(size=(3, exact.rows)))


def _judge(line: str, tests: dict[str, bool]) -> int:
    missed = [name for name, reached in tests.items() if not reached]
    sys.stdout.write(f"{line}\n" + "".join(f"    MISSED: {name}\n" for name in missed))
    return len(missed)


def judge_forward(name: str, found: Forward) -> int:
    """Print a line about predictions of fast rows, and what is not as wanted; return how much that is."""
    if not len(found.nm):
        return _judge(f"forward, {name}: no row is as fast under as little a pull", {})
    share, degrees = float(np.median(found.nm / found.amplitude_nm)), float(np.median(found.degrees))
    line = (
        f"forward, {name}: {len(found.nm)} rows; at most {found.nm.max():.4f} nm and {found.degrees.max():.4f} degrees"
    )
    tests = {
        f"{LARGEST_NM} nm": found.nm.max() <= LARGEST_NM,
        f"{LARGEST_DEG} degrees": found.degrees.max() <= LARGEST_DEG,
        f"a median of {100 * MEDIAN_SHARE:g} %": share <= MEDIAN_SHARE,
        f"a median of {MEDIAN_DEG} degrees": degrees <= MEDIAN_DEG,
    }
    return _judge(f"{line}, medians {100 * share:.4f} % and {degrees:.4f} degrees", tests)


def judge_fits(name: str, fits: list[Fitted], *, exact: bool) -> int:
    """Print a line about fits, and what is not as wanted; return how much that is."""
    if not fits:
        return _judge(f"{name}: no law", {"a law": False})
    median = float(np.median([np.median(np.abs(one.law)) for one in fits]))
    worst = float(max(np.abs(one.law).max() for one in fits))
    off = [abs(one.calibration) for one in fits]
    line = (
        f"{name}: {len(fits)} valid laws, errors {100 * median:.3f} % in the median, {100 * worst:.3f} % at worst; "
        f"calibration off by {100 * np.median(off):.3f} % in the median, {100 * max(off):.3f} % at most, "
        f"stated {100 * np.median([one.calibration_error for one in fits]):.3f} %; "
        f"{np.mean([one.rows for one in fits]):.0f} rows used"
    )
    if exact:
        calibrated = bool(np.median(off) <= NOISE_FREE_CALIBRATION)
        return _judge(line, {f"{100 * NOISE_FREE_LAW} %": worst <= NOISE_FREE_LAW, "calibration": calibrated})
    return _judge(line, {f"{100 * MEDIAN_LAW} % in the median": median <= MEDIAN_LAW, "at worst": worst <= WORST_LAW})


def main() -> int:
    """Measure, print and judge."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0] if __doc__ else None)
    parser.add_argument("--contacts", default="0:6", help="numbers of the random contacts, first:end")
    parser.add_argument("--seeds", type=int, default=2, help="noisy tables of each contact")
    parser.add_argument("--truths", type=Path, default=Path(tempfile.gettempdir()) / "afm-jax-truths")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)  # noqa: FBT003
    truths = [tapping_truth(number) for number in range(*map(int, options.contacts.split(":")))]
    missed = 0
    for ratio, shares in ((RATIO, SHARES), (HIGHER_RATIO, FEW_SHARES)):
        parts = [forward(truth, exact_table(truth, ratio, options.truths, shares)) for truth in truths]
        every = Forward(*(np.concatenate(part) for part in zip(*parts, strict=True)))
        missed += judge_forward(f"s = {ratio:g}", every.fast())
    exact = [as_measured(exact_table(truth, RATIO, options.truths)) for truth in truths]
    without = [fitted(truth, table) for truth, table in zip(truths, exact, strict=True)]
    known = [i for i, one in enumerate(without) if one is not None]
    sys.stdout.write(f"no valid law of {len(truths) - len(known)} of {len(truths)} contacts\n")
    missed += judge_fits("fits without noise", [one for one in without if one is not None], exact=True)
    drawn = [fitted(truths[i], noisy(exact[i], truths[i], seed)) for i in known for seed in range(options.seeds)]
    missed += judge_fits("fits at 0.3 % and 0.2 degrees", [one for one in drawn if one is not None], exact=False)
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
