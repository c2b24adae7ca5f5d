"""The drives among which an experiment is designed: what each would read, and what it would say of the law."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from afm_jax.checks import check_parameter, checked
from afm_jax.solve.least_squares import covariance_of
from fitting.experiments.prior import Prior
from fitting.infer.closest import closest_parameters
from fitting.infer.explain import Explained
from fitting.infer.law import root_of
from fitting.infer.rows import plain_weights, remainders_of, weights_of
from fitting.infer.search import Descent, orbits_at
from fitting.infer.unknowns import Data, Model, Quantity
from fitting.predict.law import SMOOTH, FormulaLaw
from fitting.predict.orbit import NEAR_FOLD, READINGS, Row
from fitting.simulated.experiment import Drives, check_drive

MOST = 20_000
"""Drives that a design looks at: some minutes of computing."""
DRAWS = 8
"""Sets of values that an orbit must bear."""
PHASE_NOISE_DEG = 0.2
"""Standard error of a lag, where nothing is said of it."""
Numbers = Sequence[int | float] | Shaped[np.ndarray, " n"]

_USUAL: dict[bool, dict[str, Numbers]] = {
    True: {"orders": (1, 2, 3, 4), "detunings": np.arange(97, 106) / 100, "amplitudes_nm": (2.0, 4.0, 7.0, 10.0)},
    False: {"orders": (1,), "detunings": (1.02, 1.04, 1.06, 1.08, 1.1), "amplitudes_nm": (40.0, 80.0)},
}
_USUAL[True]["offsets_nm"], _USUAL[False]["heights"] = (-1.0, 0.0, 1.0), np.arange(1, 10) / 10
"""What is tried if nothing is said; True: of a driven sample."""


@checked
def drive_grid(
    *,
    free_frequency_khz: float,
    drive: str = "sample",
    orders: Numbers | None = None,
    amplitudes_nm: Numbers | None = None,
    detunings: Numbers | None = None,
    offsets_nm: Numbers | None = None,
    heights: Numbers | None = None,
) -> Drives:
    """Return every combination of what can be driven, each once.

    Args:
        free_frequency_khz: f0.
        drive: what is driven: "sample", "force" (on the tip) or "base".
        orders: N, drive periods per impact, else 1 to 4; 1 where the cantilever is driven itself.
        amplitudes_nm: of the platform, else 2, 4, 7, 10; of the free tip where that is driven, else 40, 80.
        detunings: drive frequencies as multiples of each order's resonance 2 N f0, else 0.97 to 1.05; of f0 where the
            cantilever is driven itself, else 1.02 to 1.1.
        offsets_nm: where the sample is driven, its mean heights above the tip's rest position; else -1, 0, 1.
        heights: where the tip is driven, distances of the sample from its rest position as shares of its free
            amplitude, else 0.1 to 0.9; 0.9 is where it begins to tap.

    Raises:
        ValueError: if a list is empty or a number impossible, or there are too many combinations.
    """
    check_drive(drive)
    check_parameter("free_frequency_khz", free_frequency_khz, "positive")
    sample = drive == "sample"
    asked = {"orders": orders, "detunings": detunings, "amplitudes_nm": amplitudes_nm}
    asked |= {"offsets_nm": offsets_nm, "heights": heights}
    lists = _USUAL[sample] | {name: values for name, values in asked.items() if values is not None}
    if len(lists) > 4:
        raise ValueError("give `offsets_nm` where the sample is driven, `heights` where the tip is")
    for name, values in lists.items():
        check_parameter(name, np.asarray(values), "finite" if name in ("offsets_nm", "heights") else "positive")
    if any(order != int(order) or not (sample or order == 1) for order in lists["orders"]):
        allowed = "whole numbers" if sample else f"1 alone where the {drive} is driven"
        raise ValueError(f"`orders` must hold {allowed}, but is {list(lists['orders'])}")
    count = math.prod(map(len, lists.values()))
    if count > MOST:
        raise ValueError(f"these are {count} drives, more than the {MOST} a design looks at; take coarser steps")
    order, detuning, amplitude, place = (np.ravel(axis).astype(float) for axis in np.meshgrid(*lists.values()))
    frequency = (2.0 if sample else 1.0) * free_frequency_khz * order * detuning
    # rounded to what an instrument is told: a thousandth of a hertz, a femtometre
    rows = [order, frequency, amplitude, place if sample else -place * amplitude]
    columns = np.unique(np.round(rows, 6), axis=1)
    return Drives(columns[0].astype(np.int64), *columns[1:])


LEFT_OUT = {
    "measured": "already measured",
    "no orbit": "no steady single-impact orbit",
    "unsure": "several steady orbits, or none, or one near its end, for some of the values that the prior allows",
    "too large": "amplitudes above what the instrument takes",
    "inaccurate": "impacts too slow or too strongly pulled: a fit excludes such rows",
}
"""Why a drive is no candidate, in words."""


@dataclass(frozen=True, eq=False)
class Candidates:
    """Drives, what is expected of each, and which of them can be planned with.

    Attributes:
        drives: all that can be driven.
        why_not: a key of `LEFT_OUT` for each drive; empty for those that can be planned with.
        readings: expected peak and lock-in amplitude in nm, and lag in degrees; NaN of what is not read.
        approach_speed_nm_per_us: expected.
        slope: derivatives of the readings by the parameters, made independent and of unit variance as a fit does it
            (without a model error: divided by their errors), shape (rows, 3, p); 0 where not usable.
    """

    drives: Drives
    why_not: tuple[str, ...]
    readings: Float[np.ndarray, "rows 3"]
    approach_speed_nm_per_us: Float[np.ndarray, " rows"]
    slope: Float[np.ndarray, "rows 3 p"]

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


def model_of(prior: Prior, drives: Drives, values: Float[np.ndarray, " p"]) -> tuple[Model, Float[np.ndarray, " p"]]:
    """Return what a fit of the drives' readings fits, none of them read yet, and its unknowns at values.

    The unknowns are those of the prior's parameters, in their order.
    """
    problem, mass, count = prior.problem, prior.mass_ng or 1.0, len(drives.order)
    zero, never, own = np.zeros(count), np.zeros(count, bool), len(problem.own)
    row = Row(*(np.asarray(column, float) for column in drives), phase_deg=zero, free=never)
    lever = zero + prior.free_frequency_khz, zero + (prior.quality_factor or np.inf), mass
    blank = np.full((count, READINGS), np.nan)
    data = Data(row, blank, np.ones_like(blank), never, zero, zero.astype(int), (problem.drive,), *lever)
    if problem.model == "contact":
        from fitting.predict.contact import ContactLawModel  # noqa: PLC0415  # for contacts alone

        law = ContactLawModel(problem.own, prior.fixed, (), problem.effects, mass)
    else:
        law = FormulaLaw(problem.own, prior.fixed, mass, lasting=problem.lasting)
    theta = np.zeros(len(values))
    for i, (parameter, value) in enumerate(zip(problem.parameters[:own], values.tolist(), strict=False)):
        # 1e-12 stands for 0 where the unknown is a logarithm
        theta[i] = law.unknown_of(parameter.name, value if parameter.lowest < 0.0 else max(value, 1e-12))
    pairs = zip(problem.names[own:], values[own:].tolist(), strict=True)
    return Model(data, law, tuple(Quantity(name, value, 1.0, ~never) for name, value in pairs)), theta


def explained(
    prior: Prior, drives: Drives, *, noise: float, amplitudes: str = "both", phase_noise_deg: float = PHASE_NOISE_DEG
) -> Explained:
    """Return drives as rows of a fit that have read what is expected; its Jacobian is by the prior's parameters.

    Args:
        prior: the law and the instrument.
        drives: what can be driven.
        noise: standard error of an amplitude relative to it.
        amplitudes: what is read: "peak", "lockin" or "both"; of a cantilever that is driven itself always the lock-in
            amplitude and the lag.
        phase_noise_deg: standard error of the lag in degrees.
    """
    model, theta = model_of(prior, drives, prior.values)
    found = orbits_at(model, theta)
    readings, out = found.orbits.readings, np.zeros(len(found.number), bool)
    tapping = prior.problem.tapping
    read = [not tapping and amplitudes != "lockin", tapping or amplitudes != "peak", tapping]
    expected = np.where(read & (found.number > 0)[:, None], readings, np.nan)
    error = np.concatenate([noise * readings[:, :2], np.full((out.size, 1), phase_noise_deg)], axis=1)
    model = replace(model, data=replace(model.data, read=expected, error=error))
    lasting = model.law.lasting
    weights = weights_of(model, theta, found.orbits, out) if lasting else plain_weights(model.data, 0.0, out)
    slopes = model.slopes(theta, found.orbits) / _by_unknown(model, theta)
    jacobian = (weights.whitening @ slopes).reshape(-1, theta.size)
    return Explained(model, Descent(theta, found.orbits, 0.0, out, jacobian), weights, found, 0.0, settled=True)


def _by_unknown(model: Model, theta: Float[np.ndarray, " p"]) -> Float[np.ndarray, " p"]:
    """Return the derivatives of the prior's parameters by their unknowns."""
    law: Any = model.law
    change = np.ones(theta.size)
    change[: len(law.own)] = [law.slope_of(name, y) for name, y in zip(law.own, theta.tolist(), strict=False)]
    return change


def candidates_of(prior: Prior, drives: Drives, rows: Explained, largest_nm: float = np.inf) -> Candidates:
    """Return what a measurement at every drive would say, by derivatives of the predicted readings.

    Args:
        prior: the law and the instrument; orbits must be there for values as uncertain as it is.
        drives: what can be driven.
        rows: the drives, from `explained`.
        largest_nm: peak amplitude that the instrument takes; of a cantilever that is driven itself the free one.
    """
    orbits, number = rows.end.orbits, rows.found.number
    sure = (number == 1) & (np.abs(orbits.fold) > NEAR_FOLD)
    for values in prior.draws(DRAWS)[1:]:
        drawn = model_of(prior, drives, values)
        found = orbits_at(*drawn, np.flatnonzero(sure))
        sure &= (found.number == 1) & (np.abs(found.orbits.fold) > NEAR_FOLD)
    slope = rows.end.jacobian.reshape(len(sure), READINGS, -1)
    size = drives.amplitude_nm if prior.problem.tapping else orbits.readings[:, 0]
    # no instrument sets nine digits
    same = np.all(np.isclose(np.stack(drives, axis=1)[:, None], prior.measured, rtol=1e-9, atol=1e-12), axis=2)
    holds = {
        "measured": np.any(same, axis=1),
        "no orbit": number == 0,
        "unsure": ~sure | ~np.isfinite(slope).all(axis=(1, 2)),
        "too large": size > largest_nm,
        "inaccurate": rows.weights.reasons != "",
    }
    why_not = np.select(list(holds.values()), list(holds), "")
    return Candidates(
        drives=drives,
        why_not=tuple(why_not.tolist()),
        readings=np.mod(rows.model.data.read, [np.inf, np.inf, 360.0]),
        approach_speed_nm_per_us=orbits.approach,
        slope=np.where((why_not == "")[:, None, None], slope, 0.0),
    )


def standard_errors(information: Float[np.ndarray, "... p p"]) -> Float[np.ndarray, "... p"]:
    """Return the standard error of every parameter, the others unknown; infinite where it is not determined."""
    return np.sqrt(np.diagonal(covariance_of(information), axis1=-2, axis2=-1))


def stated_errors(prior: Prior, rows: Explained, chosen: Int[np.ndarray, " points"]) -> Float[np.ndarray, " p"]:
    """Return the standard errors that a fit of some of the rows states, whose impacts last.

    They contain what a formula leaves out, and are those of the formula closest to the law. A prior that a fit left is
    of that formula already.

    Args:
        prior: the law and the instrument.
        rows: the drives, from `explained`.
        chosen: numbers of the rows.
    """
    law = rows.model.law
    own = prior.problem.own
    measured = np.isin(np.arange(len(rows.found.number)), chosen)[:, None]
    orbits = rows.end.orbits._replace(x=np.where(measured, rows.end.orbits.x, np.nan))
    if isinstance(law, FormulaLaw):
        # a fit has drag whatever the formula is; a prior that a fit left is of the formula alone
        drag = not len(prior.measured) and "viscous_loss" not in (*law.own, *law.fixed)
        ends = float(orbits.approach[chosen].min()), float(orbits.approach[chosen].max())
        law = replace(law, own=(*law.own, "viscous_loss") if drag else law.own).beside(ends, SMOOTH)
    model = replace(rows.model, law=law, remainders=remainders_of(rows.model, rows.end.theta, orbits))
    places = [model.names.index(name) for name in prior.problem.names]
    theta = np.zeros(len(model.names))
    theta[places], change = rows.end.theta, _by_unknown(rows.model, rows.end.theta)
    of_rows = (rows.weights.whitening @ model.slopes(theta, orbits))[chosen].reshape(-1, theta.size)
    of_prior = np.zeros((len(places), theta.size))
    of_prior[:, places] = root_of(prior.information).T * change
    of_law = np.diag(model.prior[1])[: theta.size - len(model.instrument)]
    end = rows.end._replace(theta=theta, jacobian=np.concatenate([of_rows, of_prior, of_law]))
    fit = replace(rows, model=model, end=end, weights=rows.weights._replace(used=rows.weights.used & measured))
    errors = np.sqrt(np.diag(fit.covariance))[places] * np.abs(change)
    if not len(prior.measured):
        stated = closest_parameters(fit, own, prior.fixed).errors[: len(own)]
        # NaN where rows are too few, 0 of a lead that does nothing because no impact loses speed
        errors[: len(own)] = np.where(stated > 0.0, stated, np.inf)
    return errors
