"""Where the fit begins: starts are screened and polished; rows that a law has no orbit for are asked for again.

Leaving out a measured row without an orbit lets a minimiser run into a false minimum, so that rows come before
residuals: `orbits_at` searches for every row's orbits and takes the steady one that explains it best, `recovered` looks
around a law for laws that have the missing ones.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from afm_jax.solve.least_squares import Sum, levenberg_marquardt
from afm_jax.units import RAD_PER_US_PER_KHZ
from fitting.infer.optimiser import minimised
from fitting.infer.rows import Weights, plain_weights, weights_of
from fitting.infer.unknowns import Data, Model, no_orbits
from fitting.parameters import PARAMETERS
from fitting.predict.orbit import Orbits

STARTS, POLISHED, ROWS = 32, 6, 32
"""Starts that are screened, by every second of the rows, how many are polished at most, and the rows, at most."""
_GOOD = 0.3
"""Cost of a reading above what its noise makes up to which a polished start is good enough."""
_WIDTH = 0.1
"""Relative misfit of an amplitude, or one of the phase in rad, that counts as much as all larger ones hardly do."""
_FINER = 0.03
"""The same at the end of a polish."""
_LARGEST = 3.0
LOST_COST = 50.0
"""What a measured row without an orbit adds to chi2 where laws are compared."""
CENSORED = 3.0
"""Residual of a row where no orbit was seen and the model has a steady one: e^(-9/2), a probability of 1 %."""
_STEPS = 40
"""Steps of a descent at most."""
_SOFT = 2.0
"""Residual of a row from which it counts linearly in a search."""
_DRAWN, _ERRORS = 24, (1.0, 3.0, 5.0)
"""Laws that are drawn around one that lacks orbits, and how many of its errors away."""
_LIKELY = 0.2
"""Relative misfit of an amplitude up to which an orbit may be the one that was measured."""


_APART, _STEADY = 1e-3, 1e-3
"""Relative distance of speeds for a slope; how far below 1 a measured orbit's determinant is, about."""


class Found(NamedTuple):
    """The orbits of all rows at unknowns: NaN where there is none; and the number of steady ones of each row."""

    orbits: Orbits
    number: Int[np.ndarray, " rows"]

    @property
    def exists(self) -> Bool[np.ndarray, " rows"]:
        """Which rows have one."""
        return np.isfinite(self.orbits.x[:, 0])


def orbits_at(
    model: Model, theta: Float[np.ndarray, " k"], rows: np.ndarray | None = None, *, roughly: bool = False
) -> Found:
    """Return the steady orbit of each row that explains it best, of a row without one that which nearly is steady.

    Args:
        model: what is fitted.
        theta: its unknowns.
        rows: which of them; None: all.
        roughly: after three steps of Newton's method, steady or not: to screen starts.
    """
    data = model.data
    free, somewhere = data.row.free, np.full((data.time.size, 3), 20.0)
    # of free tips there is nothing to search for
    whole = model.follow(theta, somewhere, most=1) if free.any() else no_orbits(data.time.size)
    for column in (whole.x, whole.approach, whole.rebound):
        column[~free] = np.nan
    count = free.astype(int)
    wanted = np.flatnonzero(~free) if rows is None else rows[~free[rows]]
    which, orbits = model.candidates(theta, wanted, most=4 if roughly else 14, judge=not roughly)
    steady = np.asarray(np.isfinite(orbits.readings).all(axis=1) if roughly else orbits.steady)
    fine = steady | (orbits.growing & ~np.isin(which, which[steady]))
    error = np.maximum(data.error[which], 0.02 * np.abs(data.read[which]))
    with np.errstate(invalid="ignore"):
        misfit = np.where(fine, np.nansum(((orbits.readings - data.read[which]) / error) ** 2, axis=1), np.inf)
    misfit = np.where(np.isfinite(misfit), misfit, np.inf)
    order = np.lexsort((misfit, which))
    best = order[np.unique(which[order], return_index=True)[1]]
    best = best[np.isfinite(misfit[best])]
    for column, candidate in zip(whole, orbits, strict=True):
        column[which[best]] = candidate[best]
    apart = np.unique(np.stack([which, np.round(np.log(orbits.approach), 5)], axis=1)[steady], axis=0)
    return Found(whole, count + np.bincount(apart[:, 0].astype(int), minlength=count.size))


def soft_cost(data: Data, found: Found, rows: np.ndarray, width: float = _WIDTH) -> float:
    """Return how badly orbits explain rows, outliers and missing orbits counting little more than bad ones."""
    read, predicted = data.read[rows], found.orbits.readings[rows]
    exists = found.exists[rows] & np.isfinite(predicted).all(axis=1)
    with np.errstate(all="ignore"):
        ratio = np.log(np.maximum(predicted[:, :2], 1e-3) / read[:, :2])
        turned = np.deg2rad(predicted[:, 2] - read[:, 2])
    off = np.concatenate([np.clip(ratio, -_LARGEST, _LARGEST), turned[:, None]], axis=1)
    off = np.where(exists[:, None], off, [_LARGEST, _LARGEST, 0.0])
    return float(np.sum(np.log1p((np.where(np.isfinite(read), off, 0.0) / width) ** 2)))


class Descent(NamedTuple):
    """Where a descent has ended: unknowns, orbits, chi2 and the whitened Jacobian with the priors below it."""

    theta: Float[np.ndarray, " k"]
    orbits: Orbits
    chi2: float
    residual: Float[np.ndarray, " n"]
    jacobian: Float[np.ndarray, "n k"]
    steps: int = 0


def descend(
    model: Model,
    theta: Float[np.ndarray, " k"],
    begin: Orbits,
    weights: Weights,
    *,
    soft: float = np.inf,
    settled: float = 1e-3,
    fixed: Bool[np.ndarray, " k"] | None = None,
) -> Descent:
    """Minimise chi2 by Levenberg-Marquardt steps with every row's orbit followed; a step that loses one is refused.

    Args:
        model: what is fitted.
        theta: unknowns to begin with.
        begin: orbits there; rows without one do not count.
        weights: of the rows.
        soft: whitened residual of a row from which it counts linearly.
        settled: fall of chi2 in a step at which a descent has arrived.
        fixed: unknowns that stay; None: none.
    """
    rows = Followed(model, theta, begin, weights, soft)
    longest = np.array([1.0 if name in ("epsilon", "delay_hertz") else np.inf for name in model.names])
    limits = {"longest": longest, "fixed": fixed, "lowest": model.lowest}
    end = levenberg_marquardt(rows.sum, theta, settled=settled, most=_STEPS, **limits)
    return rows.descent(end.place, end.sum, end.steps)


class Followed:
    """The rows' chi2 over the unknowns, with orbits followed from where they were at the best unknowns so far."""

    def __init__(self, model: Model, theta: Float[np.ndarray, " k"], begin: Orbits, weights: Weights, soft: float):
        """Follow the orbits of the rows that count to the unknowns; arguments as of `descend`."""
        self.model, self.weights, self.soft = model, weights, soft
        self.orbits, self.least = model.follow(theta, begin.x), np.inf
        self.counts = np.isfinite(begin.x[:, 0]) & weights.used.any(axis=1)
        self.speeds = np.where(self.counts & ~model.data.row.free, self.orbits.approach, 100.0)
        self.determinant = np.where(self.counts, self.orbits.determinant, 0.0) - self._steepness(theta)[0]

    def _steepness(
        self, place: Float[np.ndarray, " k"]
    ) -> tuple[Float[np.ndarray, " rows"], Float[np.ndarray, "rows k"]]:
        """Return d w^2/d u^2 at every row's approach speed, with which the determinant grows, and its derivatives."""
        theta = self.model.of_law(place)
        speeds = np.outer([1.0 - _APART, 1.0 + _APART], self.speeds)
        # at once: a contact's law takes as long for many speeds as for few
        found, (apart,) = self.model.law.at(theta, speeds.ravel()), np.diff(speeds**2, axis=0)
        slope = np.zeros((apart.size, place.size))
        slope[:, : theta.size] = np.subtract(*np.split(found.square_slope, 2)[::-1]) / apart[:, None]
        return np.subtract(*np.split(found.square, 2)[::-1]) / apart, slope

    def sum(self, place: Float[np.ndarray, " k"]) -> Sum:
        """Return the sum of squares at unknowns, outliers softened; infinite where an orbit is lost."""
        model, counts, (mean, strength) = self.model, self.counts, self.model.prior
        with np.errstate(all="ignore"):
            orbits = model.follow(place, self.orbits.x, most=12)
            if not orbits.closes[counts].all():
                return Sum(np.inf, np.zeros(1), np.zeros((1, place.size)))
            off = np.where(self.weights.used & counts[:, None], orbits.readings - model.data.read, 0.0)
            white = np.einsum("nij,nj->ni", self.weights.whitening, off)
            slope = np.where(counts[:, None, None], model.slopes(place, orbits), 0.0)
            white_slope = np.einsum("nij,njk->nik", self.weights.whitening, np.nan_to_num(slope))
        size, known = np.sum(white**2, axis=1), strength * (place - mean)
        share = (1.0 + size / self.soft**2) ** -0.25
        steep, steep_slope = self._steepness(place)
        near = (self.determinant + steep - (1.0 - 3.0 * _STEADY)) / _STEADY
        over = np.where(self.counts, np.logaddexp(0.0, near), 0.0)
        residual = np.concatenate([(share[:, None] * white).ravel(), over, known])
        by_row = (share[:, None, None] * white_slope).reshape(-1, place.size)
        steep_slope = steep_slope * (np.where(self.counts, -np.expm1(-over), 0.0) / _STEADY)[:, None]
        jacobian = np.concatenate([by_row, steep_slope, np.diag(strength)])
        # 2 s^2 (sqrt(1 + x/s^2) - 1), written so that nothing cancels
        chi2 = float(np.sum(2.0 * size / (1.0 + np.sqrt(1.0 + size / self.soft**2))) + known @ known + over @ over)
        if chi2 < self.least:
            self.least, self.orbits = chi2, orbits
        return Sum(chi2, residual, jacobian)

    def descent(self, place: Float[np.ndarray, " k"], here: Sum, steps: int) -> Descent:
        """Return where a descent has ended, its best unknowns."""
        gone = ~self.orbits.closes & ~self.model.data.row.free
        for column in (self.orbits.x, self.orbits.approach, self.orbits.rebound):
            column[gone] = np.nan
        return Descent(place, self.orbits, here.value, here.residual, here.jacobian, steps)


def polished_by_optax(
    model: Model, theta: Float[np.ndarray, " k"], begin: Orbits, weights: Weights
) -> Float[np.ndarray, " k"]:
    """Return where Optax's L-BFGS takes unknowns on the soft loss; arguments as of `descend`."""
    return minimised(Followed(model, theta, begin, weights, _SOFT).sum, theta, settled=1.0, most=25).place


def starts(model: Model, count: int = STARTS) -> Float[np.ndarray, "starts k"]:
    """Return unknowns to start from: a low-discrepancy sequence over what the formula's parameters may be."""
    law = model.law
    data, own = model.data, law.own
    ratio = 2.0
    for _ in range(60):
        # x^(d+1) = x + 1: the generalised golden ratio (Roberts)
        ratio = (1.0 + ratio) ** (1.0 / (len(own) + 1))
    places = np.mod(0.5 + np.outer(np.arange(1, count + 1), ratio ** -np.arange(1.0, len(own) + 1)), 1.0)
    drive = RAD_PER_US_PER_KHZ * data.row.drive_amplitude_nm * data.row.drive_frequency_khz
    lost = _lost_squared(model)
    theta = np.tile(model.prior[0], (count, 1))
    for name, place in zip(own, places.T, strict=True):
        parameter = PARAMETERS[name]
        scale = np.array([drive.min(), drive.max()]) ** parameter.drive_power * data.mass_ng**parameter.mass_power
        low, high = np.array(parameter.starts) * scale
        if name == "r":
            low, high = 2e-4, 0.5
        if lost is not None and name in ("epsilon", "viscous_loss", "r"):
            power = {"epsilon": 0, "viscous_loss": 1, "r": 2}[name]
            low, high = np.array([0.03, 2.0]) * lost[0] / lost[1] ** power
        if parameter.width:
            theta[:, model.names.index(name)] = law.unknown_of(name, low + (high - low) * place)
            continue
        value = low + (high - low) * place if parameter.even else low * (high / low) ** place
        theta[:, model.names.index(name)] = value if name == "r" else law.unknown_of(name, value)
    return theta


_USUAL_SPEED = 0.2
"""Approach speed of a tip that taps above resonance, about, over the speed of the free tip."""


def _lost_squared(model: Model) -> tuple[float, float] | None:
    """Return the loss u^2 - w^2 that amplitude and phase of driven tips amount to, and a usual speed; None without."""
    data = model.data
    some = data.tapping & data.measured[:, 1] & data.measured[:, 2] & ~data.row.free
    if not some.any():
        return None
    ratio = data.row.drive_frequency_khz / data.free_frequency_khz
    free = data.row.drive_amplitude_nm
    amplitude = data.read[:, 1]
    lag = np.deg2rad(data.read[:, 2])
    size = np.hypot(1.0 - ratio**2, ratio / data.quality_factor)
    frequency = RAD_PER_US_PER_KHZ * data.free_frequency_khz
    lost = (
        2.0 * np.pi * frequency**2 * amplitude * (free * size * np.sin(lag) - ratio * amplitude / data.quality_factor)
    )
    lost = lost[some & (np.nan_to_num(lost) > 0.0)]
    if not lost.size:
        return None
    top = RAD_PER_US_PER_KHZ * data.row.drive_amplitude_nm * data.row.drive_frequency_khz
    return float(np.median(lost)), _USUAL_SPEED * float(np.median(top))


def _thinned(data: Data) -> np.ndarray:
    """Return so many rows at most, spread over orders, frequencies and drives."""
    seen = np.flatnonzero(data.measured.any(axis=1) & ~data.row.free)
    row = data.row
    ranked = seen[np.lexsort((row.drive_amplitude_nm[seen], row.drive_frequency_khz[seen], row.order[seen]))]
    return np.sort(ranked[np.unique(np.linspace(0, ranked.size - 1, min(ranked.size, ROWS)).round().astype(int))])


def _narrowed(model: Model, rows: np.ndarray) -> Model:
    """Return a model of some of the rows."""
    data = model.data
    small = replace(
        data, row=data.row.take(rows), read=data.read[rows], error=data.error[rows], no_orbit=data.no_orbit[rows],
        time=data.time[rows], number=data.number[rows], free_frequency_khz=data.free_frequency_khz[rows],
        quality_factor=data.quality_factor[rows],
    )  # fmt: skip
    instrument = tuple(quantity._replace(rows=quantity.rows[rows]) for quantity in model.instrument)
    return replace(model, data=small, instrument=instrument)


def screened(model: Model) -> Float[np.ndarray, " k"]:
    """Return the unknowns of the best start, polished on some of the rows."""
    rows = _thinned(model.data)
    small = model if len(set(model.data.drives)) > 1 else _narrowed(model, rows)
    every = np.arange(small.data.time.size) if small is not model else rows
    points = starts(model)
    some = every[::2]
    cost = [soft_cost(small.data, orbits_at(small, point, some, roughly=True), some) for point in points]
    nothing = np.zeros(small.data.time.size, bool)
    with np.errstate(invalid="ignore"):
        noise = (small.data.error / np.where(np.arange(3) < 2, np.abs(small.data.read), np.rad2deg(1.0)))[
            every
        ] / _FINER
    good = float(np.nansum(np.log1p(noise**2) + _GOOD))
    best, least = points[int(np.argmin(cost))], np.inf
    for theta in points[np.argsort(cost, kind="stable")[:POLISHED]]:
        found = orbits_at(small, theta, every)
        if found.exists[every].sum() < min(6, every.size):
            continue
        weights = plain_weights(small.data, _WIDTH, nothing)
        end = polished_by_optax(small, theta, found.orbits, weights)
        found = orbits_at(small, end, every)
        weights = plain_weights(small.data, _FINER, nothing)
        end = descend(small, end, found.orbits, weights, soft=_SOFT, settled=0.1).theta
        here = soft_cost(small.data, orbits_at(small, end, every), every, _FINER)
        if here < least:
            best, least = end, here
        if least < good:
            break
    return best


def lost_rows(data: Data, found: Found) -> Bool[np.ndarray, " rows"]:
    """Say on which rows something was measured that the law has no orbit for."""
    return data.measured.any(axis=1) & (found.number == 0)


def recovered(
    model: Model, theta: Float[np.ndarray, " k"], jacobian: Float[np.ndarray, "n k"], lost: Bool[np.ndarray, " rows"]
) -> Float[np.ndarray, " k"] | None:
    """Return, of laws drawn around one, the one that has most of the orbits that it lacks; None if none has any.

    Args:
        model: what is fitted.
        theta: its unknowns.
        jacobian: whitened, which says how far around.
        lost: rows without an orbit.
    """
    rows = np.flatnonzero(lost)
    normal = jacobian.T @ jacobian
    unit = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    curvature, axes = np.linalg.eigh(normal / np.outer(unit, unit))
    root = axes / np.sqrt(np.maximum(curvature, 1e-9)) / unit[:, None]
    draws, best, most = np.random.default_rng(1), None, 0
    for number in range(_DRAWN):
        point = theta + _ERRORS[number % len(_ERRORS)] * root @ draws.normal(size=theta.size)
        with np.errstate(all="ignore"):
            found = orbits_at(model, point, rows)
            off = np.abs(np.log(np.maximum(found.orbits.readings[rows, :2], 1e-3) / model.data.read[rows, :2]))
        likely = found.exists[rows] & (np.nanmax(np.where(np.isfinite(off), off, -1.0), axis=1) < _LIKELY)
        if likely.sum() > most:
            best, most = point, int(likely.sum())
    return best


def total(model: Model, theta: Float[np.ndarray, " k"], chi2: float) -> float:
    """Return chi2 with what rows without an orbit add to it."""
    found = orbits_at(model, theta)
    unseen = model.data.no_orbit & found.exists
    return chi2 + LOST_COST * float(lost_rows(model.data, found).sum()) + CENSORED**2 * float(unseen.sum())


def begun(model: Model) -> Descent:
    """Return the formula's minimum: screened, polished on all rows, with as few lost rows as can be found."""
    return improved(model, _polished(model, screened(model), (0.03, 0.01)))


def improved(model: Model, end: Descent) -> Descent:
    """Return a minimum that has the rows that one lacks, where laws around it have them."""
    least = total(model, end.theta, end.chi2)
    for _ in range(3):
        lost = lost_rows(model.data, orbits_at(model, end.theta))
        if not lost.any():
            break
        other = recovered(model, end.theta, end.jacobian, lost)
        if other is None:
            break
        back = _polished(model, other, (0.03,))
        here = total(model, back.theta, back.chi2)
        if here >= least:
            break
        end, least = back, here
    return end


def _polished(model: Model, theta: Float[np.ndarray, " k"], extras: tuple[float, ...]) -> Descent:
    """Return the minimum by all rows, with larger errors first and with the stated ones at the end."""
    nothing = np.zeros(model.data.time.size, bool)
    end = None
    for extra in (*extras, None):
        found = orbits_at(model, theta)
        weights = (
            weights_of(model, theta, found.orbits, nothing)
            if extra is None
            else plain_weights(model.data, extra, nothing)
        )
        end = descend(model, theta, found.orbits, weights, soft=_SOFT, settled=0.01)
        theta = end.theta
    assert end is not None  # noqa: S101
    return end
