"""One energy of a tap for a whole curve, with the instrument free within what is known of it.

Near resonance the energy of a single row hangs on f0 and Q far beyond their errors (10 Hz of 90 kHz at Q = 200 turn the
phase by 2.5 degrees), but a wrong f0 bends the energy over the curve. That all taps of a curve take the same therefore
determines energy and instrument together.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import least_squares

from afm_jax.least_squares import chi2_tail
from fitting.tapping_curves.curve import HARMONICS_FACTOR, Given, Instrument, Rows, TappingCurve, free_lag_deg
from fitting.tapping_curves.energy import energies, noise_of

_ROBUST_FROM = 2.0
"""Residual in standard errors from which a row pulls linearly while outliers are looked for."""
_FAR = 4.0
"""Residual in standard errors from which a row is set aside."""
_MOST_OUTLIERS = 0.2
_HARMONICS_THAT_TELL = 4
"""With as many measured, what is left of the others does not matter."""
_Z95 = 1.959964


class Nuisance(NamedTuple):
    """Something of the instrument that is fitted along.

    Attributes:
        name: its key.
        given: what is known of it, the unit that of the key; an error of infinity: nothing.
        value: fitted.
        standard_error: after the fit.
    """

    name: str
    given: Given
    value: float
    standard_error: float

    @property
    def key(self) -> str:
        """Its name without the number of the drive that it belongs to."""
        return _without_number(self.name)


def _without_number(name: str) -> str:
    return name.rstrip("0123456789").rstrip("_")


@dataclass(frozen=True, kw_only=True)
class ConstantEnergy:
    """Energies of a tap, one for each group of rows, fitted with the instrument free within its errors.

    Attributes:
        energy_aj: of each group.
        standard_error_aj: of each, from noise and instrument, that of the spring constant and the calibration included.
        interval95_aj: of each, shape (groups, 2).
        covariance: of the groups' energies, in aJ^2.
        budget: variance of each group's energy by what it comes from, in aJ^2.
        nuisances: of the instrument.
        instrument: at the minimum.
        used: rows that were fitted.
        free: rows of the free tip, which fix the zero of the phase.
        outliers: rows whose energy is too far from that of the others.
        residual: of the rows fitted, in standard errors; NaN elsewhere.
        chi2: at the minimum.
        degrees_of_freedom: of it.
    """

    energy_aj: Float[np.ndarray, " groups"]
    standard_error_aj: Float[np.ndarray, " groups"]
    interval95_aj: Float[np.ndarray, "groups 2"]
    covariance: Float[np.ndarray, "groups groups"]
    budget: dict[str, Float[np.ndarray, " groups"]]
    nuisances: tuple[Nuisance, ...]
    instrument: Instrument
    used: Bool[np.ndarray, " rows"]
    free: Bool[np.ndarray, " rows"]
    outliers: Bool[np.ndarray, " rows"]
    residual: Rows
    chi2: float
    degrees_of_freedom: int

    @property
    def p_value(self) -> float:
        """Probability of a larger chi2 if each group has one energy."""
        if self.degrees_of_freedom < 1:
            return float("nan")
        return chi2_tail(self.chi2, self.degrees_of_freedom)


class _Unknowns(NamedTuple):
    """What the vector of unknowns means: energies of the groups, then nuisances in units of their errors."""

    curve: TappingCurve
    groups: Int[np.ndarray, " rows"]
    frequencies: Int[np.ndarray, " rows"]
    amplitudes: Int[np.ndarray, " rows"]
    names: tuple[str, ...]
    given: tuple[Given, ...]

    @property
    def energies(self) -> int:
        """Number of groups."""
        return int(self.groups.max(initial=-1)) + 1

    def values(self, x: np.ndarray) -> dict[str, float]:
        """Return the nuisances; Q moves by its logarithm, so that it stays positive."""
        shifts = dict(zip(self.names, x[self.energies :], strict=True))
        values = {}
        for name, given in zip(self.names, self.given, strict=True):
            unit = given.error if np.isfinite(given.error) else 1.0
            if name == "quality_factor":
                values[name] = given.value * float(np.exp(shifts[name] * unit / given.value))
            else:
                values[name] = given.value + float(shifts[name]) * unit
        return values

    def instrument(self, x: np.ndarray) -> Instrument:
        """Return the instrument at a vector of unknowns."""
        values = self.values(x)
        zero = np.array([values.get(f"phase_zero_deg_{i}", 0.0) for i in range(self.frequencies.max(initial=0) + 1)])
        factor = np.array([values.get(f"free_amplitude_{i}", 1.0) for i in range(self.amplitudes.max(initial=0) + 1)])
        return Instrument(
            values.get("free_frequency_khz", self.curve.free_frequency_khz.value),
            values.get("quality_factor", self.curve.quality_factor.value),
            zero[self.frequencies],
            factor[self.amplitudes],
            values.get("harmonics_factor", HARMONICS_FACTOR.value),
        )


def plain_instrument(curve: TappingCurve, free: Bool[np.ndarray, " rows"]) -> Instrument:
    """Return the instrument as it is given, its zero of phase the mean of the free rows of each frequency."""
    given = Instrument(curve.free_frequency_khz.value, curve.quality_factor.value)
    zero = np.full(curve.rows, 0.0 if curve.phase_zero_deg is None else curve.phase_zero_deg.value)
    departure = turned(curve.lag_deg - free_lag_deg(curve, given))
    for frequency in np.unique(curve.drive_frequency_khz):
        here = curve.drive_frequency_khz == frequency
        chosen = here & free & np.isfinite(departure)
        if chosen.any():
            middle = departure[chosen][0]
            zero[here] = middle + np.average(
                turned(departure[chosen] - middle), weights=curve.lag_error_deg[chosen] ** -2.0
            )
    return given._replace(phase_zero_deg=zero)


def turned(degrees: Rows) -> Rows:
    """Return angles between -180 and 180 degrees."""
    return (degrees + 180.0) % 360.0 - 180.0


def fit_constant_energy(
    curve: TappingCurve,
    groups: Int[np.ndarray, " rows"],
    *,
    tapping: Bool[np.ndarray, " rows"],
    free: Bool[np.ndarray, " rows"],
) -> ConstantEnergy:
    """Return one energy of a tap for each group of rows, with the instrument free within its errors.

    Args:
        curve: the curve, with a phase.
        groups: which rows share an energy: 0, 1, ...; of all rows, also those that are not fitted.
        tapping: the rows to fit.
        free: the rows of the free tip.
    """
    unknowns = _unknowns(curve, groups, free)
    x = _start(unknowns, tapping, free)
    used = tapping.copy()
    x = _minimum(unknowns, x, used, free, loss="soft_l1")
    far = np.abs(_row_residuals(unknowns, x, used)) > _FAR
    if 0 < far.sum() <= _MOST_OUTLIERS * used.sum():
        used &= ~far
    x = _minimum(unknowns, x, used, free, loss="linear")
    return _result(unknowns, x, used, free, tapping & ~used)


def _unknowns(curve: TappingCurve, groups: Int[np.ndarray, " rows"], free: Bool[np.ndarray, " rows"]) -> _Unknowns:
    frequencies = np.unique(curve.drive_frequency_khz, return_inverse=True)[1]
    levels = np.unique(np.stack([curve.drive_frequency_khz, curve.free_amplitude_nm]), axis=1, return_inverse=True)[1]
    named = {"free_frequency_khz": curve.free_frequency_khz, "quality_factor": curve.quality_factor}
    named = {name: given for name, given in named.items() if given.error > 0.0}
    start = np.broadcast_to(plain_instrument(curve, free).phase_zero_deg, (curve.rows,))
    for i in range(frequencies.max() + 1):
        known = curve.phase_zero_deg
        if known is None:
            named[f"phase_zero_deg_{i}"] = Given(float(start[frequencies == i][0]), np.inf)
        elif known.error > 0.0:
            named[f"phase_zero_deg_{i}"] = known
    if len(curve.harmonic_amplitudes_nm) < _HARMONICS_THAT_TELL:
        named["harmonics_factor"] = HARMONICS_FACTOR
    if curve.free_amplitude_error > 0.0:
        named |= {f"free_amplitude_{i}": Given(1.0, curve.free_amplitude_error) for i in range(levels.max() + 1)}
    return _Unknowns(curve, groups, frequencies, levels.reshape(-1), tuple(named), tuple(named.values()))


def _start(unknowns: _Unknowns, tapping: Bool[np.ndarray, " rows"], free: Bool[np.ndarray, " rows"]) -> np.ndarray:
    plain = energies(unknowns.curve, plain_instrument(unknowns.curve, free)).energy_aj
    start = np.zeros(unknowns.energies + len(unknowns.names))
    for group in range(unknowns.energies):
        start[group] = np.median(plain[tapping & (unknowns.groups == group)])
    return start


def _row_residuals(unknowns: _Unknowns, x: np.ndarray, used: Bool[np.ndarray, " rows"]) -> Rows:
    """Return what each energy is off its group's, in errors at the same instrument: else one without losses fits."""
    found = energies(unknowns.curve, unknowns.instrument(x))
    return np.where(used, (found.energy_aj - x[unknowns.groups]) / noise_of(unknowns.curve, found), 0.0)


def _residuals(
    unknowns: _Unknowns, used: Bool[np.ndarray, " rows"], free: Bool[np.ndarray, " rows"]
) -> Callable[[np.ndarray], np.ndarray]:
    """Return residuals of the rows fitted, of the free rows' mean phase and amplitude, and of what is known before."""
    curve, priors = unknowns.curve, np.array([np.isfinite(given.error) for given in unknowns.given], bool)
    lags = _means(curve.lag_deg, curve.lag_error_deg, unknowns.frequencies, free, turning=True)
    factors = _means(
        curve.amplitude_nm / curve.free_amplitude_nm,
        curve.amplitude_error_nm / curve.free_amplitude_nm,
        unknowns.amplitudes,
        free,
    )

    def residuals(x: np.ndarray) -> np.ndarray:
        instrument = unknowns.instrument(x)
        expected = free_lag_deg(curve, instrument)
        factor = np.broadcast_to(instrument.free_amplitude_factor, (curve.rows,))
        of_free = [turned(lags.mean - expected[lags.row]) / lags.error]
        of_free.append((factors.mean - factor[factors.row]) / factors.error)
        rows = _row_residuals(unknowns, x, used)[used]
        return np.concatenate([rows, *of_free, x[unknowns.energies :][priors]])

    return residuals


class _Means(NamedTuple):
    row: Int[np.ndarray, " kinds"]
    mean: Float[np.ndarray, " kinds"]
    error: Float[np.ndarray, " kinds"]


def _means(
    values: Rows,
    errors: Rows,
    kinds: Int[np.ndarray, " rows"],
    free: Bool[np.ndarray, " rows"],
    *,
    turning: bool = False,
) -> _Means:
    """Return the mean of the free rows of each kind: one of these rows, mean, and an error that allows for drift."""
    found = []
    for kind in np.unique(kinds):
        rows = np.flatnonzero(free & (kinds == kind) & np.isfinite(values))
        if rows.size:
            off = values[rows] - values[rows[0]]
            off = turned(off) if turning else off
            weights = errors[rows] ** -2.0
            mean = np.average(off, weights=weights)
            drift = np.sqrt(max(np.var(off) - 1.0 / weights.mean(), 0.0))
            found.append((rows[0], values[rows[0]] + mean, np.hypot(weights.sum() ** -0.5, drift)))
    row, mean, error = np.array(found).reshape(-1, 3).T
    return _Means(row.astype(int), mean, error)


def _minimum(
    unknowns: _Unknowns,
    x: np.ndarray,
    used: Bool[np.ndarray, " rows"],
    free: Bool[np.ndarray, " rows"],
    *,
    loss: Literal["linear", "soft_l1"],
) -> np.ndarray:
    residuals = _residuals(unknowns, used, free)
    return least_squares(residuals, x, loss=loss, f_scale=_ROBUST_FROM, x_scale="jac").x


def _result(
    unknowns: _Unknowns,
    x: np.ndarray,
    used: Bool[np.ndarray, " rows"],
    free: Bool[np.ndarray, " rows"],
    outliers: Bool[np.ndarray, " rows"],
) -> ConstantEnergy:
    curve, count = unknowns.curve, unknowns.energies
    residuals = _residuals(unknowns, used, free)
    at = least_squares(residuals, x, x_scale="jac")
    sizes = np.linalg.norm(at.jac, axis=0)
    sizes[sizes == 0.0] = 1.0
    inverse = np.linalg.pinv(at.jac / sizes) / sizes[:, None]
    covariance = inverse @ inverse.T
    # each residual has variance 1, and moves the minimum by a column of this
    gains = inverse
    known = [name for name, given in zip(unknowns.names, unknowns.given, strict=True) if np.isfinite(given.error)]
    sources = ["noise"] * (len(at.fun) - len(known)) + [_without_number(name) for name in known]
    budget: dict[str, np.ndarray] = {}
    for source, gain in zip(sources, gains[:count].T, strict=True):
        budget[source] = budget.get(source, np.zeros(count)) + gain**2
    energy = at.x[:count]
    scale = {
        "spring_constant_n_per_m": curve.spring_constant_n_per_m.error / curve.spring_constant_n_per_m.value,
        "tip_calibration": 2.0 * curve.tip_calibration.error / curve.tip_calibration.value,
    }
    budget |= {name: (share * energy) ** 2 for name, share in scale.items() if share > 0.0}
    share = float(np.linalg.norm(list(scale.values())))
    errors = np.sqrt(np.diag(covariance))
    values = unknowns.values(at.x)
    nuisances = tuple(
        Nuisance(name, given, values[name], errors[count + i] * (given.error if np.isfinite(given.error) else 1.0))
        for i, (name, given) in enumerate(zip(unknowns.names, unknowns.given, strict=True))
    )
    total = covariance[:count, :count] + share**2 * np.outer(energy, energy)
    rows = np.full(curve.rows, np.nan)
    rows[used] = _row_residuals(unknowns, at.x, used)[used]
    return ConstantEnergy(
        energy_aj=energy,
        standard_error_aj=np.sqrt(np.diag(total)),
        interval95_aj=np.array([_interval(energy[i], errors[i], share) for i in range(count)]),
        covariance=total,
        budget=budget,
        nuisances=nuisances,
        instrument=unknowns.instrument(at.x),
        used=used,
        free=free,
        outliers=outliers,
        residual=rows,
        chi2=float(np.sum(at.fun**2)),
        degrees_of_freedom=len(at.fun) - len(at.x),
    )


def _interval(energy: float, error: float, share: float) -> tuple[float, float]:
    """Return the 95 % interval of an energy, with the relative error of a factor in logarithms: it is positive."""
    low, high = energy - _Z95 * error, energy + _Z95 * error
    if share == 0.0 or energy <= 0.0:
        return low, high
    above = float(np.hypot(np.log(high / energy), _Z95 * share))
    if low <= 0.0:
        return low, float(energy * np.exp(above))
    return float(energy * np.exp(-np.hypot(np.log(energy / low), _Z95 * share))), float(energy * np.exp(above))
