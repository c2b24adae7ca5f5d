"""The energy of a tap as a smooth function along each branch, or as a constant, jointly with the instrument.

Near resonance the energy of a single row depends on f0 and Q far beyond their errors (10 Hz of 90 kHz at Q = 200 turn
the phase by 2.5 degrees), but a wrong f0 bends the energy along the whole curve. Each branch has a function, a constant
plus a Gaussian process (Matern 5/2) over the logarithm of the amplitude lost, for energies change fastest at first
contact, and readings are energies(instrument) = function + noise of the row. Linear in small changes of the instrument,
that is generalised least squares: function and instrument are determined together, and the band of the function holds
what the instrument leaves open. A process of no size leaves the constant, one energy for all rows.

Fits of laws compare readings with those that a law predicts (`fitting.fits.objective`). Here no law predicts a reading:
what is compared is the energy that a reading gives with the function that is fitted along, so that residuals and
weights are others. Steps, covariance and thresholds are those of fits (`afm_jax.least_squares`).
"""

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.linalg import get_lapack_funcs
from scipy.optimize import isotonic_regression

from afm_jax.least_squares import IMPROBABLE, TORN, Box, Searches, chi2_tail, covariance_of, descended
from fitting.tapping_curves.branches import free_ends, repulsive_rows, smooth_stretches, ways
from fitting.tapping_curves.curve import HARMONICS_FACTOR, Given, Instrument, Rows, TappingCurve, lag_of_free_tip
from fitting.tapping_curves.energy import Energies, energies, instrument_slopes, noise_of

_inverse_triangle, _solve_triangle = get_lapack_funcs(("trtri", "trtrs"), dtype=float)
_FAR = 4.0
"""Residual in standard errors from which a row is excluded."""
_MOST_OUTLIERS = 0.2
_HARMONICS_THAT_TELL = 4
"""With as many measured, what is left of the others does not matter."""
Z95 = 1.959964
_DRIFT_DEG, _DRIFT = 3.0, 0.02
"""Usual drift of phase and of free amplitude over a table, where free rows do not determine it."""
_WIDE_DRIFT_DEG, _WIDE_DRIFT = 30.0, 0.3
"""Likewise where free rows at both ends determine it."""
_MOST_BINS = 60
"""Rows of a function beyond which neighbours are averaged."""
_SIZES = tuple(0.005 * 2.0**k for k in range(7))
"""Sizes of the process that are tried, of pi k A0^2 s/Q, what the air takes of the free tip in a period."""
_USUAL_SIZE, _LOG_SIZE = 0.03, 1.0
"""Measured curves of graphite: 4 aJ of 108; spread of the logarithm."""
_LENGTHS = (0.3, 0.5, 0.8, 1.3)
"""Lengths of the process that are tried, in the logarithm of the amplitude lost."""
_USUAL_LENGTH, _LOG_LENGTH = 0.7, 0.5
_SHALLOW = 0.03
"""Loss, of the free amplitude, that is added to all: there the length in nm is that at contact."""
_LEAST_SIZE = 1.0
"""Least size of the process, of the largest energy: one that a constant fits may change by as much as itself."""
_MOST_PROCESSES = 5
"""Processes that are tried one after the other, each with the instrument that the last led to."""
_ROUNDS = 30
_RISE = 0.1
"""By which a step may raise chi2: slopes are taken at smooth readings, not at those that chi2 is of."""
_SETTLED = 1e-3
"""Change of the unknowns in their standard errors from which the search has settled."""


class Nuisance(NamedTuple):
    """Something of the instrument that is fitted along.

    Attributes:
        name: its key, with a number where each drive has its own.
        kind: its key without the number.
        given: what is known of it, the unit that of the key; an error of infinity: nothing.
        value: fitted.
        standard_error: after the fit.
    """

    name: str
    kind: str
    given: Given
    value: float
    standard_error: float

    @property
    def pull(self) -> float:
        """Distance of the value from what was given, in the error given."""
        return (self.value - self.given.value) / self.given.error


class _Unknown(NamedTuple):
    """A nuisance: which rows it moves, what is known of it, and the unit it is counted in."""

    name: str
    rows: Bool[np.ndarray, " rows"]
    given: Given

    @property
    def kind(self) -> str:
        """The name without the number of its drive."""
        return self.name.rstrip("_0123456789")

    @property
    def unit(self) -> float:
        return self.given.error if np.isfinite(self.given.error) else 1.0


class Process(NamedTuple):
    """Standard deviation of a Gaussian process, and its length."""

    size: float
    length: float

    def covariance(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Return the Matern 5/2 covariance between two sets of places."""
        distance = np.sqrt(5.0) * np.abs(a[:, None] - b[None, :]) / self.length
        return self.size**2 * (1.0 + distance + distance**2 / 3.0) * np.exp(-distance)


class Bins(NamedTuple):
    """Rows of a function, neighbours averaged: places, where each bin starts, rows' weights in it, its variance."""

    place: Float[np.ndarray, " bins"]
    starts: Int[np.ndarray, " bins"]
    weights: Float[np.ndarray, " rows"]
    variance: Float[np.ndarray, " bins"]

    @classmethod
    def of(cls, place: np.ndarray, noise: np.ndarray, most: int = _MOST_BINS) -> "Bins":
        """Return bins of rows that stand in the order of their places."""
        count = min(len(place), most)
        starts = -(-np.arange(count) * len(place) // count)
        information = noise**-2.0
        total = np.add.reduceat(information, starts)
        weights = information / np.repeat(total, np.diff(starts, append=len(place)))
        return cls(np.add.reduceat(weights * place, starts), starts, weights, 1.0 / total)

    @property
    def of_rows(self) -> Int[np.ndarray, " rows"]:
        """Number of each row's bin."""
        return np.repeat(np.arange(len(self.starts)), np.diff(self.starts, append=len(self.weights)))

    def average(self, values: np.ndarray) -> np.ndarray:
        """Return the weighted averages over the bins of values of the rows, shape (rows, ...)."""
        return np.add.reduceat((self.weights * values.T).T, self.starts, axis=0)


class Smoother(NamedTuple):
    """A constant and a process given binned readings: what a reading of a bin contributes anywhere.

    Attributes:
        bins: of the readings.
        process: beside the constant.
        factor: Cholesky factor of the readings' covariance, noise and process.
        ones: `factor`'s inverse times a vector of ones.
    """

    bins: Bins
    process: Process
    factor: Float[np.ndarray, "bins bins"]
    ones: Float[np.ndarray, " bins"]

    @classmethod
    def of(cls, bins: Bins, process: Process) -> "Smoother":
        """Return the smoother of some bins."""
        return cls.trials(bins, [process])[0]

    @classmethod
    def trials(cls, bins: Bins, processes: list[Process]) -> "list[Smoother]":
        """Return the smoothers of some bins for several processes."""
        lengths = {process.length for process in processes if process.size > 0.0}
        alike = {length: Process(1.0, length).covariance(bins.place, bins.place) for length in lengths}
        found = []
        for process in processes:
            if process.size > 0.0:
                covariance = process.size**2 * alike[process.length]
                covariance.flat[:: len(covariance) + 1] += bins.variance
                factor = np.linalg.cholesky(covariance)
            else:
                factor = np.diag(np.sqrt(bins.variance))
            found.append(cls(bins, process, factor, _solved(factor, np.ones(len(factor)))))
        return found

    @property
    def log_determinant(self) -> float:
        """Of the covariance; the constant is not known beforehand: what lies along it tells nothing."""
        return float(2.0 * np.log(np.diag(self.factor)).sum() + np.log(self.ones @ self.ones))

    def whitened(self, values: np.ndarray) -> np.ndarray:
        """Return binned values, shape (bins, ...), in standard errors, without what lies along the constant."""
        found = _solved(self.factor, values)
        return found - np.multiply.outer(self.ones, self.ones @ found) / (self.ones @ self.ones)

    def noise_in(self, values: np.ndarray) -> np.ndarray:
        """Return what of binned values is noise, shape (bins,): what constant and process leave of them."""
        return self.bins.variance * _solved(self.factor, self.whitened(values), transposed=True)

    def mean(self, place: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Return the function's mean at some places, given binned values."""
        ones = _solved(self.factor, self.ones, transposed=True)
        constant = float(ones @ values / ones.sum())
        if self.process.size == 0.0:
            return np.full(len(place), constant)
        weighted = _solved(self.factor, self.whitened(values), transposed=True)
        return constant + self.process.covariance(place, self.bins.place) @ weighted

    def at(self, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return at some places the weights of the bins, shape (places, bins), and the variance besides."""
        inverse = self.inverse
        ones = inverse.sum(axis=1)
        total = ones.sum()
        if self.process.size == 0.0:
            return np.tile(ones / total, (len(place), 1)), np.full(len(place), 1.0 / total)
        cross = self.process.covariance(place, self.bins.place)
        left, weights = 1.0 - cross @ ones, cross @ inverse
        variance = self.process.size**2 - np.sum(weights * cross, axis=1) + left**2 / total
        return weights + np.outer(left, ones / total), np.maximum(variance, 0.0)

    def leverage(self, place: np.ndarray) -> np.ndarray:
        """Return for the rows in the bins, which stand at some places, by how much each moves its own mean."""
        inverse, own = self.inverse, self.bins.of_rows
        ones = inverse.sum(axis=1)
        cross = self.process.covariance(place, self.bins.place)
        weights = np.sum(cross * inverse[own], axis=1) + (1.0 - cross @ ones) * ones[own] / ones.sum()
        return weights * self.bins.weights

    @property
    def inverse(self) -> np.ndarray:
        """Of the readings' covariance, shape (bins, bins)."""
        root = _inverse_triangle(self.factor.T)[0]
        return root @ root.T


def _solved(factor: np.ndarray, values: np.ndarray, *, transposed: bool = False) -> np.ndarray:
    """Return what the inverse of a lower triangular factor, or of its transpose, makes of values, shape (bins, ...)."""
    if values.ndim == 1:
        return _solve_triangle(factor.T, values, trans=int(not transposed))[0]
    found = np.empty_like(values)
    # one by one: for several columns LAPACK starts threads, which on a busy machine take a thousand times as long
    for i, column in enumerate(values.T):
        found[:, i] = _solved(factor, column, transposed=transposed)
    return found


@dataclass(frozen=True, kw_only=True)
class EnergyFit:
    """Functions of the height, or constants, fitted jointly with the instrument.

    Attributes:
        rows: of each function, in the order of their heights.
        smoothers: of the energy of each function.
        energies_at: of every row, with the instrument as fitted.
        slopes: change of each row's energy by every unknown's unit, shape (rows, unknowns).
        virial_slopes: likewise of its virial.
        covariance: of the unknowns, in their units.
        known: which unknowns have a finite error beforehand.
        nuisances: of the instrument.
        instrument: at the minimum.
        used: rows that were fitted.
        outliers: rows too far from the others.
        residual: of the rows fitted, in standard errors; NaN elsewhere.
        chi2: of rows, free rows and what is known beforehand.
        degrees_of_freedom: of it.
        rows_chi2: of the rows alone.
        rows_freedom: of it, less what their functions take.
        scale: what the rows' own errors were multiplied by.
        relative_error: of every energy, by spring constant and calibration, by name.
        search: the least squares that it is the minimum of.
        at: the unknowns, in their units from what is given.
    """

    rows: tuple[np.ndarray, ...]
    smoothers: tuple[Smoother, ...]
    energies_at: Energies
    slopes: Float[np.ndarray, "rows unknowns"]
    virial_slopes: Float[np.ndarray, "rows unknowns"]
    covariance: Float[np.ndarray, "unknowns unknowns"]
    known: Bool[np.ndarray, " unknowns"]
    nuisances: tuple[Nuisance, ...]
    instrument: Instrument
    used: Bool[np.ndarray, " rows"]
    outliers: Bool[np.ndarray, " rows"]
    residual: Rows
    chi2: float
    degrees_of_freedom: int
    rows_chi2: float
    rows_freedom: float
    scale: float
    relative_error: dict[str, float]
    search: "_EnergySearch" = field(repr=False)
    at: Float[np.ndarray, " unknowns"]

    @property
    def p_value(self) -> float:
        """Probability of a larger chi2 if the model is right."""
        if self.degrees_of_freedom < 1:
            return float("nan")
        return chi2_tail(self.chi2, self.degrees_of_freedom)

    @property
    def share(self) -> float:
        """Relative error that all energies have in common, from spring constant and calibration."""
        return float(np.linalg.norm(list(self.relative_error.values())))

    @property
    def torn(self) -> list[Nuisance]:
        """Nuisances that had to go beyond three of their errors."""
        return [one for one in self.nuisances if abs(one.pull) > TORN]

    def function(self, number: int, place: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return a function's energy at some places in aJ, its own variance, and its change by every unknown."""
        smoother, rows = self.smoothers[number], self.rows[number]
        weights, variance = smoother.at(place)
        energy = weights @ smoother.bins.average(self.energies_at.energy_aj[rows])
        return energy, variance, weights @ smoother.bins.average(self.slopes[rows])

    def error(self, energy: np.ndarray, variance: np.ndarray, slopes: np.ndarray) -> np.ndarray:
        """Return the standard error of what `function` gives, that of spring constant and calibration included."""
        return np.sqrt(variance + self.by_instrument(slopes) + (self.share * energy) ** 2)

    def by_instrument(self, slopes: np.ndarray) -> np.ndarray:
        """Return the variance that the instrument leaves in what changes by it with some slopes."""
        return np.einsum("nu,uv,nv->n", slopes, self.covariance, slopes)

    def covariance_with(self, known: tuple[str, ...]) -> np.ndarray:
        """Return the covariance of the unknowns if some of the nuisances, by name, were known."""
        places = [i for i, one in enumerate(self.nuisances) if one.name in known]
        gain = np.linalg.solve(self.covariance[np.ix_(places, places)], self.covariance[places])
        return self.covariance - gain.T @ self.covariance[places]

    def budget(self, number: int) -> dict[str, float]:
        """Return what the variance of a constant comes from, in aJ^2."""
        energy, variance, slopes = self.function(number, np.zeros(1))
        parts: dict[str, float] = {}
        moved = (slopes[0] @ self.covariance) ** 2 * self.known
        for one, part in zip(self.nuisances, moved.tolist(), strict=True):
            parts[one.kind] = parts.get(one.kind, 0.0) + part
        noise = float(variance[0] + self.by_instrument(slopes)[0] - sum(parts.values()))
        relative = {name: (share * float(energy[0])) ** 2 for name, share in self.relative_error.items()}
        return {"noise": max(noise, 0.0)} | parts | relative


def losses(curve: TappingCurve) -> Rows:
    """Return the logarithm of what each row's amplitude has lost of the free one, smoothed along its way.

    By amplitude an energy is smooth where by height it is not: an attractive plateau ends within a nanometre.
    """
    place = np.zeros(curve.rows)
    for part in ways(curve):
        free = curve.free_amplitude_nm[part]
        weights = (free / curve.amplitude_error_nm[part]) ** 2
        ratio = isotonic_regression(curve.amplitude_nm[part] / free, weights=weights, increasing=False).x
        place[part] = np.log(_SHALLOW + np.maximum(1.0 - ratio, 0.0))
    return place


def turned(degrees: Rows) -> Rows:
    """Return angles between -180 and 180 degrees."""
    return (degrees + 180.0) % 360.0 - 180.0


def plain_instrument(curve: TappingCurve, free: Bool[np.ndarray, " rows"]) -> Instrument:
    """Return the instrument as it is given; the free rows tell the zero of phase of each frequency, and drifts."""
    given = Instrument(curve.free_frequency_khz.value, curve.quality_factor.value)
    zero = np.full(curve.rows, 0.0 if curve.phase_zero_deg is None else curve.phase_zero_deg.value)
    factor = np.ones(curve.rows)
    departure = turned(curve.lag_deg - lag_of_free_tip(curve, given))
    known = free & np.isfinite(departure)
    if curve.time is not None and free_ends(curve, free):
        share = curve.amplitude_nm / curve.free_amplitude_nm
        factor += np.polyval(np.polyfit(curve.time[free], share[free], 1), curve.time) - 1.0
        if known.any():
            middle = departure[known][0]
            slope = np.polyfit(curve.time[known], turned(departure[known] - middle), 1)[0]
            departure, zero = departure - slope * curve.time, zero + slope * curve.time
    for frequency in np.unique(curve.drive_frequency_khz):
        here = curve.drive_frequency_khz == frequency
        chosen = here & known
        if chosen.any():
            middle = departure[chosen][0]
            mean = np.average(turned(departure[chosen] - middle), weights=curve.lag_error_deg[chosen] ** -2.0)
            zero[here] += middle + mean - (0.0 if curve.phase_zero_deg is None else curve.phase_zero_deg.value)
    return given._replace(phase_zero_deg=zero, free_amplitude_factor=factor)


def fit_energy(
    curve: TappingCurve,
    groups: list[np.ndarray],
    free: Bool[np.ndarray, " rows"],
    *,
    smooth: bool,
    scale_errors: bool = False,
) -> EnergyFit:
    """Return an energy for each group of rows, a smooth function of the height or a constant, with the instrument free.

    Args:
        curve: the curve, with a phase.
        groups: the rows of each function or constant.
        free: the rows of the free tip.
        smooth: whether the energy may change with the height.
        scale_errors: multiply the rows' own errors such that chi2 is as large as its degrees of freedom, if larger.
    """
    groups = [rows[np.argsort(curve.offset_nm[rows], kind="stable")] for rows in groups]
    touching = np.isin(np.arange(curve.rows), np.concatenate(groups))
    search = _EnergySearch(curve, free, _unknowns(curve, free), touching, smooth=smooth)
    found = search.fitted(groups, 1.0)
    far = np.abs(found.residual) > _FAR * (max(1.0, _scale(found)) if smooth else 1.0)
    if 0 < far.sum() <= _MOST_OUTLIERS * found.used.sum():
        kept = [rows[~far[rows]] for rows in groups]
        if all(len(rows) for rows in kept):
            found = replace(search.fitted(kept, 1.0), outliers=far)
            groups = kept
    if not smooth and not scale_errors:
        return found
    scale = _scale(found) if smooth else float(np.sqrt(found.chi2 / max(found.degrees_of_freedom, 1)))
    return replace(search.fitted(groups, scale), outliers=found.outliers) if scale > 1.0 else found


def _scale(found: EnergyFit) -> float:
    """Return by how much the rows scatter more about their functions than their errors say, 1 where chance does it."""
    freedom = max(found.rows_freedom, 1.0)
    probable = chi2_tail(found.rows_chi2, max(round(freedom), 1)) > IMPROBABLE
    return 1.0 if probable else float(np.sqrt(found.rows_chi2 / freedom))


def _unknowns(curve: TappingCurve, free: Bool[np.ndarray, " rows"]) -> list[_Unknown]:
    every = np.ones(curve.rows, bool)
    lever = {"free_frequency_khz": curve.free_frequency_khz, "quality_factor": curve.quality_factor}
    found = [_Unknown(name, every, given) for name, given in lever.items() if given.error > 0.0]
    start = np.broadcast_to(plain_instrument(curve, free).phase_zero_deg, (curve.rows,))
    for i, frequency in enumerate(np.unique(curve.drive_frequency_khz).tolist()):
        here = curve.drive_frequency_khz == frequency
        known = curve.phase_zero_deg or Given(float(np.mean(start[here])), np.inf)
        if known.error > 0.0:
            found.append(_Unknown(f"phase_zero_deg_{i}", here, known))
    if len(curve.harmonic_amplitudes_nm) < _HARMONICS_THAT_TELL:
        found.append(_Unknown("harmonics_factor", every, HARMONICS_FACTOR))
    if curve.free_amplitude_error > 0.0:
        known = Given(1.0, curve.free_amplitude_error)
        found += [_Unknown(f"free_amplitude_{i}", here, known) for i, here in enumerate(_levels(curve))]
    if curve.time is not None:
        phase, amplitude = (_WIDE_DRIFT_DEG, _WIDE_DRIFT) if free_ends(curve, free) else (_DRIFT_DEG, _DRIFT)
        found.append(_Unknown("phase_drift_deg", every, Given(0.0, phase)))
        found.append(_Unknown("free_amplitude_drift", every, Given(0.0, amplitude)))
    return found


def usual_drifts(curve: TappingCurve, free: Bool[np.ndarray, " rows"]) -> tuple[float, float]:
    """Return by how much phase (degrees) and free amplitude (a share) may have drifted after what free rows tell."""
    if curve.time is None or not free_ends(curve, free):
        return _DRIFT_DEG, _DRIFT
    known = free & np.isfinite(curve.lag_error_deg)
    spread = np.sqrt(np.sum((curve.time[known] - curve.time[known].mean()) ** 2)) if known.any() else np.inf
    share = np.median(curve.amplitude_error_nm[free] / curve.free_amplitude_nm[free])
    return float(np.median(curve.lag_error_deg[known]) / spread) if known.any() else _DRIFT_DEG, float(share / spread)


def _levels(curve: TappingCurve) -> list[Bool[np.ndarray, " rows"]]:
    keys = np.stack([curve.drive_frequency_khz, curve.free_amplitude_nm])
    which = np.unique(keys, axis=1, return_inverse=True)[1].reshape(-1)
    return [which == i for i in range(which.max(initial=-1) + 1)]


class _EnergySlopes(NamedTuple):
    """Changes by one unit of each unknown, shape (rows, unknowns): energy, virial, free tip's lag and amplitude."""

    energy: np.ndarray
    virial: np.ndarray
    free_lag: np.ndarray
    factor: np.ndarray


class _State(NamedTuple):
    """The search at some values of the unknowns.

    Attributes:
        x: the unknowns, in their units from what is given.
        found: energies of the readings.
        smooth: energies of the readings smoothed along their branches.
        of_free: residuals of the free rows' means.
        bins: of each function.
        energies: in the bins of each function, in aJ.
    """

    x: np.ndarray
    found: Energies
    smooth: Energies
    of_free: np.ndarray
    bins: list[Bins]
    energies: list[np.ndarray]


@dataclass
class _EnergySearch:
    """The least squares: readings of a curve, unknowns of its instrument, functions of groups of rows."""

    curve: TappingCurve
    free: Bool[np.ndarray, " rows"]
    unknowns: list[_Unknown]
    touching: Bool[np.ndarray, " rows"]
    smooth: bool

    def __post_init__(self):
        curve, free = self.curve, self.free
        self.place = losses(curve)
        self.smoothed = _smoothed_readings(curve, self.touching, self.place, free)
        frequency = np.unique(curve.drive_frequency_khz, return_inverse=True)[1]
        level = np.argmax(np.stack(_levels(curve)), axis=0) if curve.rows else frequency
        share = curve.amplitude_nm / curve.free_amplitude_nm
        self.lags = _means(curve, curve.lag_deg, curve.lag_error_deg, frequency, free, turning=True)
        self.shares = _means(curve, share, curve.amplitude_error_nm / curve.free_amplitude_nm, level, free)
        self.known = np.array([np.isfinite(one.given.error) for one in self.unknowns], bool)

    def instrument(self, x: np.ndarray) -> Instrument:
        """Return the instrument at values of the unknowns, in their units from what is given."""
        curve, parts = self.curve, {}
        time = np.zeros(curve.rows) if curve.time is None else curve.time
        zero = np.full(curve.rows, 0.0 if curve.phase_zero_deg is None else curve.phase_zero_deg.value)
        factor = np.ones(curve.rows)
        for one, value in zip(self.unknowns, self.values(x).tolist(), strict=True):
            if one.kind == "phase_zero_deg":
                zero = np.where(one.rows, zero * 0.0 + value, zero)
            elif one.kind == "free_amplitude":
                factor = np.where(one.rows, value, factor)
            else:
                parts[one.kind] = value
        zero = zero + parts.pop("phase_drift_deg", 0.0) * time
        factor = factor + parts.pop("free_amplitude_drift", 0.0) * time
        given = Instrument(curve.free_frequency_khz.value, curve.quality_factor.value, zero, factor)
        return given._replace(**parts)

    def values(self, x: np.ndarray) -> np.ndarray:
        """Return the unknowns in the units of their keys; Q stays positive."""
        values = np.array([one.given.value for one in self.unknowns]) + x * np.array([u.unit for u in self.unknowns])
        for i, one in enumerate(self.unknowns):
            if one.kind == "quality_factor":
                values[i] = one.given.value * np.exp(x[i] * one.unit / one.given.value)
        return values

    def _state(self, x: np.ndarray, groups: list, scale: float) -> _State:
        """Return the search at some unknowns, the rows' own errors multiplied by a scale."""
        at = self.instrument(x)
        found, smooth = energies(self.curve, at), energies(self.smoothed, at)
        noise = scale * noise_of(self.smoothed, smooth)
        bins = [Bins.of(self.place[rows], noise[rows]) for rows in groups]
        averages = [one.average(found.energy_aj[rows]) for one, rows in zip(bins, groups, strict=True)]
        return _State(x, found, smooth, self._of_free(at), bins, averages)

    def _slopes(self, state: _State, groups: list, smoothers: list[Smoother]) -> _EnergySlopes:
        """Return the changes by every unknown at the most probable readings whose energies are those of the functions.

        At readings with noise slopes hang on the noise of the same rows, and pull the instrument to where all energies,
        noise included, are smaller.
        """
        curve, start = self.smoothed, state.smooth
        variance = noise_of(curve, start) ** 2
        amplitude, lag = curve.amplitude_nm.copy(), curve.lag_deg.copy()
        for rows, smoother, values in zip(groups, smoothers, state.energies, strict=True):
            off = smoother.mean(self.place[rows], values) - start.energy_aj[rows]
            off /= variance[rows]
            amplitude[rows] += off * start.amplitude_slope[rows] * curve.amplitude_error_nm[rows] ** 2
            lag[rows] += off * start.lag_slope[rows] * curve.lag_error_deg[rows] ** 2
        return self._slopes_at(state.x, replace(curve, amplitude_nm=amplitude, lag_deg=lag))

    def _slopes_at(self, x: np.ndarray, curve: TappingCurve) -> _EnergySlopes:
        """Return the changes by every unknown at some readings."""
        by = instrument_slopes(curve, self.instrument(x))
        time = np.zeros(curve.rows) if curve.time is None else curve.time
        fields = {"phase_drift_deg": "phase_zero_deg", "free_amplitude_drift": "free_amplitude_factor"}
        fields |= {"free_amplitude": "free_amplitude_factor"}
        slopes = np.zeros((len(_EnergySlopes._fields), curve.rows, len(self.unknowns)))
        for i, one in enumerate(self.unknowns):
            field = fields.get(one.kind, one.kind)
            # the logarithm of Q is what moves
            unit = one.unit * (self.values(x)[i] / one.given.value if one.kind == "quality_factor" else 1.0)
            here = unit * one.rows * (time if one.kind.endswith(("drift", "drift_deg")) else 1.0)
            slopes[:-1, :, i] = np.stack(by[field]) * here
            slopes[-1, :, i] = here if field == "free_amplitude_factor" else 0.0
        return _EnergySlopes(*slopes)

    def fitted(self, groups: list[np.ndarray], scale: float) -> EnergyFit:
        """Return the fit of some groups, the rows' own errors multiplied by a scale."""
        x = self._start()
        if not self.smooth:
            processes = [Process(0.0, 1.0)] * len(groups)
            return self.result(self._descended(x, groups, processes, scale), groups, processes, scale)
        processes = self._processes(x, groups, scale)
        for _ in range(_MOST_PROCESSES):
            x = self._descended(x, groups, processes, scale)
            again = self._processes(x, groups, scale)
            if again == processes:
                break
            processes = again
        return self.result(x, groups, processes, scale)

    def _start(self) -> np.ndarray:
        """Return the unknowns of the instrument as it is given."""
        plain = plain_instrument(self.curve, self.free)
        drifting = {"phase_drift_deg": plain.phase_zero_deg, "free_amplitude_drift": plain.free_amplitude_factor}
        at, time = np.zeros(len(self.unknowns)), self.curve.time
        for i, one in enumerate(self.unknowns):
            if one.kind in drifting and time is not None and np.ptp(time) > 0.0:
                along = np.broadcast_to(drifting[one.kind], (self.curve.rows,))
                at[i] = np.polyfit(time, along, 1)[0] / one.unit
        return at

    def _of_free(self, at: Instrument) -> np.ndarray:
        """Return residuals of the free rows' means."""
        lags, shares = self.lags, self.shares
        factor = np.broadcast_to(at.free_amplitude_factor, (self.curve.rows,))
        left = [-turned(lags.mean - lags.average(lag_of_free_tip(self.curve, at))) / lags.error]
        left.append((shares.average(factor) - shares.mean) / shares.error)
        return np.concatenate(left)

    def _residuals(
        self, state: _State, slopes: _EnergySlopes, groups: list, smoothers: list[Smoother]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the residuals in standard errors and their changes by the unknowns.

        Those of what is known beforehand, of the free rows' means, and of the binned energies about their functions.
        """
        lags, shares, x = self.lags, self.shares, state.x
        residual = [self.known * x, state.of_free]
        jacobian = [
            np.diag(self.known.astype(float)),
            lags.average(slopes.free_lag) / lags.error[:, None],
            shares.average(slopes.factor) / shares.error[:, None],
        ]
        weights = np.sqrt(self._weights(groups))
        for rows, bins, one, values, weight in zip(groups, state.bins, smoothers, state.energies, weights, strict=True):
            binned = self._without_scale(one, bins.average(slopes.energy[rows]), values)
            residual.append(weight * one.whitened(values))
            jacobian.append(weight * one.whitened(binned))
        return np.concatenate(residual), np.concatenate(jacobian)

    def _weights(self, groups: list[np.ndarray]) -> list[float]:
        """Return how much each function counts where it tells the instrument by how smooth it is.

        Approach and retract of one sample have functions that are alike: both together count as one.
        """
        if not self.smooth:
            return [1.0] * len(groups)
        curve = self.curve
        keys = [
            (curve.drive_frequency_khz[rows[0]], curve.free_amplitude_nm[rows[0]], bool(curve.retract[rows[0]]))
            for rows in groups
        ]
        return [1.0 / len({way for *other, way in keys if tuple(other) == key[:2]}) for key in keys]

    def _without_scale(self, smoother: Smoother, slopes: np.ndarray, energy: np.ndarray) -> np.ndarray:
        """Return the changes of binned energies, for Q without what only makes all of them larger or smaller.

        On resonance that is all that Q does, and the size of a process is no measure of it: larger Q would be preferred
        for the smaller energies.
        """
        if smoother.process.size == 0.0:
            return slopes
        function = energy - smoother.noise_in(energy)
        function -= function.mean()
        slopes = slopes.copy()
        for i, one in enumerate(self.unknowns):
            if one.kind == "quality_factor":
                share = function @ slopes[:, i] / max(float(function @ function), 1e-300)
                slopes[:, i] -= share * function
        return slopes

    def _descended(self, x: np.ndarray, groups: list, processes: list[Process], scale: float) -> np.ndarray:
        """Return the unknowns at the minimum for given processes."""
        if not len(x):
            return x

        def evaluate(places: np.ndarray, _: np.ndarray) -> Searches:
            state = self._state(places[0], groups, scale)
            smoothers = [Smoother.of(*pair) for pair in zip(state.bins, processes, strict=True)]
            slopes = self._slopes(state, groups, smoothers)
            residual, jacobian = self._residuals(state, slopes, groups, smoothers)
            chi2 = float(residual @ residual)
            return Searches(places, residual[None], jacobian[None], np.array([chi2 if np.isfinite(chi2) else np.inf]))

        free = Box(np.full(len(x), -np.inf), np.full(len(x), np.inf), np.zeros((1, len(x)), bool))
        start = evaluate(x[None], np.arange(1))
        return descended(evaluate, start, free, settled=_SETTLED**2, most=_ROUNDS, rise=_RISE).place[0]

    def _processes(self, x: np.ndarray, groups: list, scale: float) -> list[Process]:
        """Return the processes of the groups, of the size and length that the readings make most probable."""
        curve, state = self.curve, self._state(x, groups, scale)
        s = curve.drive_frequency_khz / curve.free_frequency_khz.value
        tip = curve.spring_constant_n_per_m.value * curve.tip_calibration.value**2
        free = curve.free_amplitude_nm
        lost = np.pi * tip * free**2 * s / curve.quality_factor.value

        def processes(size: float, length: float) -> list[Process]:
            made = []
            for rows in groups:
                largest = np.max(np.abs(_smoothed(state.found.energy_aj[rows])))
                made.append(Process(max(size * float(lost[rows].mean()), _LEAST_SIZE * float(largest)), length))
            return made

        usual = processes(_USUAL_SIZE, _USUAL_LENGTH)
        slopes = self._slopes(state, groups, [Smoother.of(*pair) for pair in zip(state.bins, usual, strict=True)])
        tried = [(size, length, tuple(processes(size, length))) for size in _SIZES for length in _LENGTHS]
        # small sizes are raised to the same least one
        distinct = list(dict.fromkeys(trial for *_, trial in tried))
        by_group = [
            Smoother.trials(bins, list(some))
            for bins, some in zip(state.bins, zip(*distinct, strict=True), strict=True)
        ]
        trials = [list(smoothers) for smoothers in zip(*by_group, strict=True)]
        residual, jacobian = (
            np.stack(part)
            for part in zip(*(self._residuals(state, slopes, groups, smoothers) for smoothers in trials), strict=True)
        )
        matrix, gradient = np.swapaxes(jacobian, 1, 2) @ jacobian, np.einsum("tnu,tn->tu", jacobian, residual)
        inverse, weights = np.linalg.pinv(matrix, hermitian=True), self._weights(groups)
        found = np.einsum("tu,tuv,tv->t", gradient, inverse, gradient) - np.linalg.slogdet(matrix)[1]
        found -= np.sum(residual**2, axis=1)
        found -= [sum(w * s.log_determinant for w, s in zip(weights, smoothers, strict=True)) for smoothers in trials]
        known = dict(zip(distinct, found.tolist(), strict=True))

        def evidence(size: float, length: float, trial: tuple[Process, ...]) -> float:
            usual = (np.log(size / _USUAL_SIZE) / _LOG_SIZE) ** 2 + (np.log(length / _USUAL_LENGTH) / _LOG_LENGTH) ** 2
            return known[trial] - usual

        return list(max(tried, key=lambda one: evidence(*one))[2])

    def result(
        self,
        x: np.ndarray,
        groups: list,
        processes: list[Process],
        scale: float,
        covariance: np.ndarray | None = None,
    ) -> EnergyFit:
        """Return the fit at some unknowns; their covariance is that of its readings where none is given."""
        curve, state = self.curve, self._state(x, groups, scale)
        smoothers = [Smoother.of(*pair) for pair in zip(state.bins, processes, strict=True)]
        slopes = self._slopes(state, groups, smoothers)
        if covariance is None:
            _, jacobian = self._residuals(state, slopes, groups, smoothers)
            covariance = covariance_of(jacobian.T @ jacobian)
        units = self.values(x) - self.values(x - 1e-6) if len(x) else x
        errors = np.sqrt(np.diag(covariance)) * units / 1e-6
        residual = self._of_rows(state, groups, smoothers, scale)
        taken = sum(float(one.leverage(self.place[rows]).sum()) for rows, one in zip(groups, smoothers, strict=True))
        used = np.isin(np.arange(curve.rows), np.concatenate(groups))
        rows_chi2, of_free = float(np.nansum(residual**2)), state.of_free
        return EnergyFit(
            rows=tuple(groups),
            smoothers=tuple(smoothers),
            energies_at=state.found,
            slopes=slopes.energy,
            virial_slopes=slopes.virial,
            covariance=covariance,
            known=self.known,
            nuisances=tuple(
                Nuisance(one.name, one.kind, one.given, float(value), float(error))
                for one, value, error in zip(self.unknowns, self.values(x), errors, strict=True)
            ),
            instrument=self.instrument(x),
            used=used,
            outliers=np.zeros(curve.rows, bool),
            residual=residual,
            chi2=rows_chi2 + float(of_free @ of_free + np.sum((self.known * x) ** 2)),
            # what the instrument takes of the rows' freedom: at most one each
            degrees_of_freedom=round(used.sum() + len(of_free) + self.known.sum() - len(x) - taken),
            rows_chi2=rows_chi2,
            rows_freedom=float(used.sum() - taken),
            scale=scale,
            relative_error=curve.relative_errors,
            search=self,
            at=x,
        )

    def _of_rows(self, state: _State, groups: list, smoothers: list[Smoother], scale: float) -> Rows:
        """Return how far the rows' energies are from their functions, in errors; NaN for rows of none."""
        noise = scale * noise_of(self.smoothed, state.smooth)
        residual = np.full(self.curve.rows, np.nan)
        for rows, one, values in zip(groups, smoothers, state.energies, strict=True):
            residual[rows] = (state.found.energy_aj[rows] - one.mean(self.place[rows], values)) / noise[rows]
        return residual


COMMON = ("free_frequency_khz", "quality_factor", "harmonics_factor")
"""Nuisances that curves of one lever have in common."""


class Common(NamedTuple):
    """What curves of one lever tell together of what they have in common.

    Attributes:
        names: of the nuisances.
        p_value: probability that the curves, each alone, disagree more on them.
    """

    names: tuple[str, ...]
    p_value: float


def fitted_together(fits: list[EnergyFit]) -> tuple[list[EnergyFit], Common]:
    """Return fits of curves of one lever with frequency, Q and harmonics fitted to all of them.

    Each curve alone tells them by a Gaussian, mostly by how smooth it makes the energy; energies of curves of one
    sample are alike, so that this is counted as that of one curve: the weighted mean with the error of one. Each
    curve's own unknowns and functions follow. Tables fitted together (`fitting.fits.several`) are independent instead.

    Args:
        fits: of curves for which the same is given of the lever.
    """
    names = tuple(name for name in COMMON if all(name in [n.name for n in one.nuisances] for one in fits))
    places = [np.array([[n.name for n in one.nuisances].index(name) for name in names], int) for one in fits]
    prior = np.eye(len(names))
    blocks = [one.covariance[np.ix_(place, place)] for one, place in zip(fits, places, strict=True)]
    told = [np.linalg.inv(block) - prior for block in blocks]
    # of each alone: what its own readings say, before what is given pulls it
    weighted = [np.linalg.inv(b) @ one.at[p] for b, one, p in zip(blocks, fits, places, strict=True)]
    covariance = np.linalg.inv(prior + np.mean(told, axis=0))
    mean = covariance @ np.mean(weighted, axis=0)
    moved = []
    for one, place, block in zip(fits, places, blocks, strict=True):
        gain = np.linalg.solve(block, one.covariance[place]).T
        own = one.covariance - gain @ (block - covariance) @ gain.T
        processes = [smoother.process for smoother in one.smoothers]
        at = one.at + gain @ (mean - one.at[place])
        again = one.search.result(at, list(one.rows), processes, one.scale, own)
        moved.append(replace(again, outliers=one.outliers))
    return moved, Common(names, _agreement(told, weighted))


_TELLS = 0.01
"""Information, of that known beforehand, from which a curve alone tells something of a nuisance."""


def _agreement(told: list[np.ndarray], weighted: list[np.ndarray]) -> float:
    """Return the probability that curves which tell the same disagree more, from what each tells."""

    def of(information: np.ndarray, vector: np.ndarray) -> tuple[float, int]:
        values, vectors = np.linalg.eigh(information)
        chosen = values > _TELLS
        return float(np.sum((vectors.T @ vector)[chosen] ** 2 / values[chosen])), int(chosen.sum())

    each = [of(*pair) for pair in zip(told, weighted, strict=True)]
    whole = of(np.sum(told, axis=0), np.sum(weighted, axis=0))
    freedom = sum(count for _, count in each) - whole[1]
    return chi2_tail(max(sum(part for part, _ in each) - whole[0], 0.0), freedom) if freedom > 0 else 1.0


def _smoothed(values: np.ndarray) -> np.ndarray:
    """Return running means of five values along the curve."""
    width = min(5, len(values))
    return np.convolve(values, np.full(width, 1.0 / width), "valid")


class _Means(NamedTuple):
    """Means of free rows: the weights of the rows in each, its value and its error."""

    weights: Float[np.ndarray, "means rows"]
    mean: Float[np.ndarray, " means"]
    error: Float[np.ndarray, " means"]

    def average(self, values: np.ndarray) -> np.ndarray:
        """Return averages over the rows of each mean of something that has a value for every row."""
        return self.weights @ values


_FEWEST_OF_MEAN, _MOST_MEANS = 4, 8


def _means(
    curve: TappingCurve,
    values: Rows,
    errors: Rows,
    kinds: Int[np.ndarray, " rows"],
    free: Bool[np.ndarray, " rows"],
    *,
    turning: bool = False,
) -> _Means:
    """Return means of the free rows of each kind, their errors with what they scatter beyond their noise.

    Where the order of the rows is known each stretch of neighbours has means of its own, which tell a drift.
    """
    weights, means, error = [], [], []
    for kind in np.unique(kinds).tolist():
        rows = np.flatnonzero(free & (kinds == kind) & np.isfinite(values))
        for part in _stretches(curve, rows):
            off = values[part] - values[part[0]]
            off = turned(off) if turning else off
            own = errors[part] ** -2.0
            mean = np.average(off, weights=own)
            excess = np.sqrt(max(np.var(off) - 1.0 / own.mean(), 0.0))
            row = np.zeros(curve.rows)
            row[part] = own / own.sum()
            weights.append(row)
            means.append(values[part[0]] + mean)
            error.append(np.hypot(own.sum() ** -0.5, excess))
    return _Means(np.array(weights).reshape(-1, curve.rows), np.array(means), np.array(error))


def _stretches(curve: TappingCurve, rows: Int[np.ndarray, " some"]) -> list[np.ndarray]:
    """Return the rows in one piece, or where their order in time is known those that follow each other in several."""
    if not len(rows) or curve.time is None:
        return [rows] if len(rows) else []
    runs = np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1)
    return [
        part
        for run in runs
        for part in np.array_split(run, max(1, min(len(run) // _FEWEST_OF_MEAN, _MOST_MEANS)))
        if len(part)
    ]


def _smoothed_readings(
    curve: TappingCurve, touching: Bool[np.ndarray, " rows"], place: Rows, free: Bool[np.ndarray, " rows"]
) -> TappingCurve:
    """Return a curve with its readings smoothed along each branch: errors of energies are taken there."""
    amplitude, lag = curve.amplitude_nm.copy(), curve.lag_deg.copy()
    departure = turned(curve.lag_deg - lag_of_free_tip(curve, plain_instrument(curve, free)))
    for rows in smooth_stretches(curve, touching, repulsive_rows(curve, touching, departure)):
        for readings, errors in ((amplitude, curve.amplitude_error_nm), (lag, curve.lag_error_deg)):
            values = readings[rows]
            smoother = smoother_along(
                place[rows], values, errors[rows], max(float(np.ptp(values)), float(errors[rows[0]]))
            )
            readings[rows] = smoother.mean(place[rows], smoother.bins.average(values))
    return replace(curve, amplitude_nm=amplitude, lag_deg=lag)


def smoother_along(place: np.ndarray, values: np.ndarray, noise: np.ndarray, scale: float) -> Smoother:
    """Return the most probable smoother of readings, for processes of some sizes and lengths.

    Args:
        place: of the readings, in order, as of `losses`.
        values: the readings.
        noise: their standard errors.
        scale: size that the process may have, in the unit of the readings; those tried are 0.1 to 3 times as large.
    """
    bins = Bins.of(place, noise)
    y = bins.average(values)
    trials = [Process(size * scale, length) for size in (0.1, 0.3, 1.0, 3.0) for length in _LENGTHS]
    return max(
        Smoother.trials(bins, trials), key=lambda one: -float(np.sum(one.whitened(y) ** 2)) - one.log_determinant
    )
