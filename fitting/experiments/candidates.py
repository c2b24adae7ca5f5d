"""The drives among which an experiment is designed: what each would read, and what it would say of the law."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from afm_jax.checks import check_parameter, checked
from afm_jax.least_squares import covariance_of
from fitting.experiments.prior import Prior
from fitting.fits.discrepancy import ModelDiscrepancy
from fitting.fits.law_after import member_after, speed_range
from fitting.fits.minimum import model_errors_of, padding
from fitting.infer.rows import BATCH, Objective
from fitting.fits.step import rows_of_fit, system_of
from fitting.forward import ImpactSlopes
from fitting.models import Measurement, measurement_of
from fitting.simulated.experiment import Drives, check_drive
from fitting.tables.table import AmplitudeTable

MOST = 20_000
"""Drives that a design looks at: some minutes of computing."""
MARGIN = 0.05
"""Uncertainty of every parameter, relative to its size (the loss, for r), that an orbit must bear however well the law
seems to be known: a law is none of a real contact to better than that where its orbits end."""
PHASE_NOISE_DEG = 0.2
"""Standard error of a lag, where nothing is said of it."""
Numbers = Sequence[int | float] | Shaped[np.ndarray, " n"]


@checked
def drive_grid(
    *,
    orders: Numbers,
    amplitudes_nm: Numbers,
    detunings: Numbers,
    free_frequency_khz: float,
    offsets_nm: Numbers = (0.0,),
    drive: str = "sample",
    heights: Numbers | None = None,
) -> Drives:
    """Return every combination of what can be driven, each once.

    Args:
        orders: N, drive periods per impact; 1 where the cantilever is driven itself.
        amplitudes_nm: of the platform; of the free tip where that is driven.
        detunings: drive frequencies as multiples of each order's resonance 2 N f0 (of f0 where the cantilever is driven
            itself).
        free_frequency_khz: f0.
        offsets_nm: mean heights of the platform above the tip's rest position.
        drive: what is driven: "sample", "force" (on the tip) or "base".
        heights: in place of the offsets, distances of the sample from the rest position of a tip that is driven itself,
            as shares of its free amplitude: 0.9 is where it begins to tap.

    Raises:
        ValueError: if a list is empty or a number impossible, or there are too many combinations.
    """
    check_drive(drive)
    check_parameter("free_frequency_khz", free_frequency_khz, "positive")
    lists = {"orders": orders, "amplitudes_nm": amplitudes_nm, "offsets_nm": offsets_nm, "heights": heights}
    for name, numbers in (lists | {"detunings": detunings}).items():
        if numbers is not None:
            _check_list(name, numbers, positive=name not in {"offsets_nm", "heights"})
    sample = drive == "sample"
    if any(order != int(order) or not (sample or order == 1) for order in orders):
        allowed = "whole numbers" if sample else f"1 alone where the {drive} is driven"
        raise ValueError(f"`orders` must hold {allowed}, but is {list(orders)}")
    if heights is not None and sample:
        raise ValueError("`heights` are shares of a free amplitude: give `offsets_nm` where the sample is driven")
    resonance = (2.0 if sample else 1.0) * free_frequency_khz
    places = offsets_nm if heights is None else heights
    # rounded to what an instrument is told: a thousandth of a hertz, a femtometre
    rows = {
        (
            order,
            round(resonance * order * detuning, 6),
            float(amplitude),
            float(place) if heights is None else round(-place * amplitude, 6),
        )
        for order, detuning, amplitude, place in product(orders, detunings, amplitudes_nm, places)
    }
    if len(rows) > MOST:
        raise ValueError(f"these are {len(rows)} drives, more than the {MOST} a design looks at; take coarser steps")
    columns = np.array(sorted(rows), float).T
    return Drives(columns[0].astype(np.int64), *columns[1:])


def _check_list(name: str, numbers: Numbers, *, positive: bool) -> None:
    if np.ndim(numbers) != 1:
        raise ValueError(f"`{name}` must be a list of numbers, but has the shape {np.shape(numbers)}")
    if len(numbers) == 0:
        raise ValueError(f"`{name}` is empty; give at least one number")
    for number in numbers:
        if not np.isfinite(number) or (positive and number <= 0.0):
            raise ValueError(f"`{name}` must hold {'positive' if positive else 'finite'} numbers, but one is {number}")


def same_drives(drives: Drives, others: Float[np.ndarray, "others 4"]) -> np.ndarray:
    """Say which drives are among others, given as rows of order, frequency, amplitude and offset."""
    # no instrument sets nine digits
    places = np.stack(drives, axis=1)[:, None]
    return np.any(np.all(np.isclose(places, others, rtol=1e-9, atol=1e-12), axis=2), axis=1)


LEFT_OUT = {
    "measured": "already measured",
    "no orbit": "no steady single-impact orbit",
    "unsure": "several steady orbits, or none, or one near its end, for some of the values that the prior allows",
    "too large": "amplitudes above what the instrument takes",
    "inaccurate": "impacts too slow, or under too strong a pull, for the model: a fit excludes such rows",
}
"""Why a drive is no candidate, in words."""


@dataclass(frozen=True, eq=False)
class Candidates:
    """Drives, what is expected of each, and which of them can be planned with.

    Attributes:
        drives: all that can be driven.
        why_not: a key of `LEFT_OUT` for each drive; empty for those that can be planned with.
        amplitude_nm: expected peak and lock-in amplitude, shape (rows, 2); of a cantilever that is driven itself
            its lag in degrees too, shape (rows, 3).
        error_nm: standard errors of their measurement, the model's own error included; infinite where not measured.
        approach_speed_nm_per_us: expected.
        slope: d amplitude/d parameter in units of the error, shape (rows, k, p); 0 where not usable.
    """

    drives: Drives
    why_not: tuple[str, ...]
    amplitude_nm: Float[np.ndarray, "rows k"]
    error_nm: Float[np.ndarray, "rows k"]
    approach_speed_nm_per_us: Float[np.ndarray, " rows"]
    slope: Float[np.ndarray, "rows k p"]

    @property
    def usable(self) -> Bool[np.ndarray, " rows"]:
        """Which drives can be planned with."""
        return np.array([not reason for reason in self.why_not], dtype=bool)

    @property
    def information(self) -> Float[np.ndarray, "rows p p"]:
        """The Fisher information of a measurement at each drive."""
        return np.einsum("nap,naq->npq", self.slope, self.slope)

    @property
    def left_out(self) -> dict[str, int]:
        """How many drives are left out for each reason."""
        return {name: self.why_not.count(name) for name in LEFT_OUT if name in self.why_not}


def candidates_of(
    prior: Prior,
    drives: Drives,
    *,
    noise: float,
    amplitudes: str = "both",
    largest_nm: float = np.inf,
    phase_noise_deg: float = PHASE_NOISE_DEG,
) -> Candidates:
    """Return what a measurement at every drive would say, by derivatives of the predicted readings.

    Args:
        prior: the law and the instrument; orbits must be there for values as uncertain as it is.
        drives: what can be driven.
        noise: standard error of an amplitude relative to it.
        amplitudes: what is read: "peak", "lockin" or "both"; of a cantilever that is driven itself always the lock-in
            amplitude and the lag.
        largest_nm: peak amplitude that the instrument takes; of a cantilever that is driven itself the free one.
        phase_noise_deg: standard error of the lag in degrees.
    """
    count, tapping = len(drives.order), prior.problem.tapping
    read = np.array([False, True, True] if tapping else [amplitudes != "lockin", amplitudes != "peak"])
    # of readings of 1 nm with an error of 1 nm the Jacobian is that of the amplitudes
    one = np.ones((count, read.size))
    objective = Objective(_measured(prior, drives, np.where(read, one, np.nan), one), prior.problem)
    linear = objective.at_values(prior.draws(BATCH, least=MARGIN))
    prediction = linear.prediction
    expected = np.asarray(prediction.amplitude_nm)[0]
    # the model's own error goes with what is read
    model_errors = model_errors_of(
        objective.with_rows(amplitude_nm=np.where(expected, expected, 1.0)) if tapping else objective, prior.values
    )
    amplitude, kinds = expected[:count], expected.shape[1]
    own = padding(model_errors.model_error, expected)[:count]
    error = np.where(read, np.hypot(_noise_of(amplitude, noise, phase_noise_deg), own), np.inf)
    raw = np.asarray(linear.jacobian)[0, : kinds * count].reshape(count, kinds, -1)
    orbits = np.asarray(prediction.orbits)[:, :count]
    fold = np.asarray(prediction.near_fold)[:, :count]
    holds = {
        "measured": same_drives(drives, prior.measured),
        "no orbit": orbits[0] == 0,
        "unsure": np.any((orbits != 1) | fold, axis=0) | ~np.isfinite(raw).all(axis=(1, 2)),
        "too large": (drives.amplitude_nm if tapping else amplitude[:, 0]) > largest_nm,
        "inaccurate": model_errors.set_aside[:count],
    }
    why_not = tuple(next((name for name in LEFT_OUT if holds[name][row]), "") for row in range(count))
    usable = np.array([not reason for reason in why_not])
    safe = np.where(usable[:, None] & np.isfinite(error), error, np.inf)
    return Candidates(
        drives=drives,
        why_not=why_not,
        amplitude_nm=amplitude,
        error_nm=error,
        approach_speed_nm_per_us=np.asarray(prediction.approach_speed_nm_per_us)[0, :count],
        slope=np.where(usable[:, None, None], raw, 0.0) / safe[:, :, None],
    )


def _noise_of(
    amplitude: Float[np.ndarray, "rows k"], noise: float, phase_noise_deg: float
) -> Float[np.ndarray, "rows k"]:
    """Return the errors of amplitudes, and of lags if there are any."""
    lag = np.full((len(amplitude), amplitude.shape[1] - 2), phase_noise_deg)
    return np.concatenate([noise * amplitude[:, :2], lag], axis=1)


def _measured(
    prior: Prior, drives: Drives, amplitude: Float[np.ndarray, "rows k"], error: Float[np.ndarray, "rows k"]
) -> Measurement:
    """Return readings (a column of NaN: not read) with their errors as a measurement."""
    tapping, columns = prior.problem.tapping, {}
    columns["free_amplitude_nm" if tapping else "drive_amplitude_nm"] = drives.amplitude_nm
    kinds = (("peak_amplitude", "nm"), ("lockin_amplitude", "nm"), ("phase_lag", "deg"))
    for i, (name, unit) in enumerate(kinds[: amplitude.shape[1]]):
        if np.isfinite(amplitude[:, i]).all():
            columns |= {f"{name}_{unit}": amplitude[:, i], f"{name}_error_{unit}": error[:, i]}
    table = AmplitudeTable(
        drive=prior.problem.drive,
        order=drives.order,
        drive_frequency_khz=drives.frequency_khz,
        offset_nm=drives.offset_nm,
        free_frequency_khz=prior.free_frequency_khz,
        quality_factor=prior.quality_factor,
        mass_ng=prior.mass_ng,
        source="the drives",
        **columns,
    )
    found = measurement_of(table, prior.problem, fixed=prior.fixed)
    if not tapping:
        return found
    # nothing was read that could tell which rows are free
    there = np.arange(len(found.rows.order)) < len(drives.order)
    measured = there[:, None] & np.array([False, True, True])
    return found._replace(rows=found.rows._replace(measured=measured, free=np.zeros_like(there)))


def standard_errors(information: Float[np.ndarray, "... p p"]) -> Float[np.ndarray, "... p"]:
    """Return the standard error of every parameter, the others unknown; infinite where it is not determined."""
    return np.sqrt(np.diagonal(covariance_of(information), axis1=-2, axis2=-1))


def forecast(
    prior: Prior,
    candidates: Candidates,
    chosen: Int[np.ndarray, " points"],
    noise: float,
    phase_noise_deg: float = PHASE_NOISE_DEG,
) -> Float[np.ndarray, "steps p"]:
    """Return the standard errors that a fit will state, before and after each chosen point.

    Where impacts last these contain what the model leaves out, by the same step as after a fit, anew for these points,
    and are those of the formula that is then closest to the law. A prior that a fit left is of that formula already.

    Args:
        prior: the law and the instrument.
        candidates: all drives.
        chosen: numbers of the points.
        noise: standard error of an amplitude relative to it.
        phase_noise_deg: standard error of a lag in degrees.
    """
    problem, each = prior.problem, candidates.information[chosen]
    steps = prior.information + np.concatenate([np.zeros((1, *each.shape[1:])), np.cumsum(each, axis=0)])
    errors = standard_errors(steps)
    if not problem.lasting or not chosen.size:
        return errors
    drives = Drives(*(column[chosen] for column in candidates.drives))
    amplitude = candidates.amplitude_nm[chosen]
    read = np.where(np.isfinite(candidates.error_nm[chosen]), amplitude, np.nan)
    objective = Objective(_measured(prior, drives, read, _noise_of(amplitude, noise, phase_noise_deg)), problem)
    model_errors = model_errors_of(objective, prior.values)
    rows = rows_of_fit(objective, objective.following(prior.values), prior.values, model_errors, 1.0)
    values = prior.fixed | dict(zip(problem.names, prior.values.tolist(), strict=True))
    discrepancy = ModelDiscrepancy(problem, values, speed_range(rows.approach[: len(chosen)]), prior.mass_ng or 1.0)
    size = prior.sizes
    known, axes = np.linalg.eigh(size[:, None] * prior.information * size)
    known = np.sqrt(np.maximum(known, 0.0))[:, None] * axes.T / size
    readings, free = rows.measurement_error.shape, np.ones(len(size), dtype=bool)
    by_row = rows.jacobian[: rows.measurement_error.size].reshape(*readings, -1)
    for count in range(1, len(chosen) + 1):
        # a reading without slopes says nothing
        seen = np.arange(readings[0])[:, None] < count
        jacobian = np.concatenate([(seen[..., None] * by_row).reshape(-1, len(size)), known])
        slopes = ImpactSlopes(*(seen * part for part in rows.slopes))
        some = rows._replace(slopes=slopes, jacobian=jacobian, residual=np.zeros(len(jacobian)))
        step = system_of(some, discrepancy, free).step()
        covariance = step.covariance
        if not len(prior.measured):
            speeds = rows.approach[:count]
            member = member_after(step, discrepancy, objective.measurement, prior.values, speeds, free, computed=False)
            covariance = covariance if member is None else member.covariance
        errors[count] = np.sqrt(np.diag(covariance))[: len(size)]
    return errors
