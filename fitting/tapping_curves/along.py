"""Energy and virial along the branches of tapping curves, with bands that hold what the instrument leaves open.

*Along a branch* the energy is a smooth function (`smooth`). Energies of all branches and curves of a lever are
E ~ N(E^, G) with G = diag(noise^2) + S C S^T, S = dE/dx and C the covariance of the instrument x (`lever`).

*No sample gives energy.* Each point's band is its normal distribution, cut where another point would have less than no
energy. What is left says of a point that it is measured, bracketed, or below a bound.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import ndtr, ndtri

from afm_jax.saved import as_json
from afm_jax.solve.least_squares import IMPROBABLE, chi2_tail
from afm_jax.units import TWO_SIDED_95
from fitting.tapping_curves.branches import FEWEST_ROWS, CurveBranch
from fitting.tapping_curves.curve import Instrument, Mask, Rows, TappingCurve
from fitting.tapping_curves.energy import Energies, energies
from fitting.tapping_curves.lever import Lever, LeverUnknown, Nuisance
from fitting.tapping_curves.smooth import SHALLOW, Smoother, size_of, smoothed

_FAR, _MOST_OUTLIERS = 4.0, 0.2
"""Residual in standard errors from which a row is excluded, and share of rows that may be."""
_ALLOWED = 3.0
"""Standard errors within which a negative energy is chance."""
MEASURED, BRACKET = 0.5, 0.1
"""Half of a band over its middle up to which an energy is measured; lower over upper end from which it is bracketed."""
_POINTS = 41
"""At which a branch is given."""
HEADLINE = (0.95, 0.9, 0.8, 0.7, 0.5)
"""Amplitudes, as fractions of the free one, at which the output gives the energy."""


def said_of(low: float, high: float) -> str:
    """Return what a band of 95 % says of an energy: "measured", "bracket", or "upper bound".

    >>> said_of(2.0, 4.0), said_of(0.5, 4.0), said_of(0.1, 4.0)
    ('measured', 'bracket', 'upper bound')
    """
    if high - low <= MEASURED * (high + low):
        return "measured"
    return "bracket" if low > BRACKET * high else "upper bound"


@dataclass(frozen=True, kw_only=True, eq=False)
class EnergyCurve:
    """Energy and virial along a branch, in the order of the amplitude; bands hold the truth in 95 of 100 places.

    Attributes:
        amplitude_ratio: amplitude read over the free one.
        height_nm: of the sample.
        energy_low_aj: lower end of the energy's band, mean over a period of the drive.
        energy_high_aj: its upper end.
        virial_aj: mean of force times height, positive where attraction prevails.
        virial_error_aj: its standard error.
        estimate_aj: energy with the instrument where statements and free rows put it, whatever its sign.
        noise_aj: standard error of that but for the instrument.
        by_instrument: its change by every unknown of the instrument, in standard errors of what is known beforehand,
            shape (points, unknowns).
        certain: whether the place is far enough from first contact to be distinguished from it.
    """

    amplitude_ratio: Float[np.ndarray, " points"]
    height_nm: Float[np.ndarray, " points"]
    energy_low_aj: Float[np.ndarray, " points"]
    energy_high_aj: Float[np.ndarray, " points"]
    virial_aj: Float[np.ndarray, " points"]
    virial_error_aj: Float[np.ndarray, " points"]
    estimate_aj: Float[np.ndarray, " points"]
    noise_aj: Float[np.ndarray, " points"]
    by_instrument: Float[np.ndarray, "points unknowns"]
    certain: Bool[np.ndarray, " points"]

    @property
    def energy_aj(self) -> Float[np.ndarray, " points"]:
        """The middle of the band."""
        return 0.5 * (self.energy_low_aj + self.energy_high_aj)

    @property
    def energy_error_aj(self) -> Float[np.ndarray, " points"]:
        """The standard error that a band of this width has."""
        return 0.5 * (self.energy_high_aj - self.energy_low_aj) / TWO_SIDED_95

    def at(self, ratio: Any) -> Float[np.ndarray, "2 ..."]:
        """Return the band at amplitudes, of the free one, NaN beyond the branch."""
        return interpolated(ratio, self.amplitude_ratio, self.energy_low_aj, self.energy_high_aj)

    def estimates_at(self, ratio: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return energy, its own standard error and its change by the instrument at some amplitudes, NaN beyond.

        With the instrument where statements and free rows put it: differences of branches and curves hardly depend on
        it.
        """
        columns = self.estimate_aj, self.noise_aj, *self.by_instrument.T
        energy, noise, *by = interpolated(ratio, self.amplitude_ratio, *columns)
        return energy, noise, np.stack(by, axis=-1)


@as_json.register
def _(curve: EnergyCurve) -> dict[str, Any]:
    # what is said of each point stands beside its band
    names = ("amplitude_ratio", "height_nm", "energy_aj", "energy_low_aj", "energy_high_aj", "virial_aj")
    half = TWO_SIDED_95 * curve.virial_error_aj
    return {name: getattr(curve, name) for name in names} | {
        "said": [said_of(*ends) for ends in zip(curve.energy_low_aj, curve.energy_high_aj, strict=True)],
        "virial_low_aj": curve.virial_aj - half,
        "virial_high_aj": curve.virial_aj + half,
    }


def interpolated(ratio: Any, measured: np.ndarray, *columns: np.ndarray) -> np.ndarray:
    """Return columns at amplitudes, of the free one, by straight lines between those measured; NaN beyond them."""
    return np.stack([np.interp(ratio, measured, column, np.nan, np.nan) for column in columns])


@dataclass(frozen=True, eq=False)
class TappingBranch(CurveBranch):
    """Rows of one drive, one way and one side of the phase, and the energy along them.

    Attributes:
        rows: numbers of the rows.
        curve: energy and virial along them.
    """

    rows: Int[np.ndarray, " some"]
    curve: EnergyCurve


@dataclass(frozen=True, kw_only=True)
class EnergyFunctions:
    """Energies along the branches of a curve.

    Attributes:
        lever: the curves of its lever, and their instrument.
        number: of the curve among them.
        smooth: the curve with smooth readings, at which errors of energies are taken.
        energies: of every row, with the instrument where statements and free rows put it.
        branches: energy and virial along each.
        outliers: rows too far from the others.
        rows_chi2: of the rows about their functions.
        rows_freedom: number of these rows less what their functions take.
        scale: what the rows' own errors were multiplied by, the largest of the branches.
        possible: whether some instrument as stated leaves no energy of the lever's curves negative.
    """

    lever: Lever
    number: int
    smooth: TappingCurve
    energies: Energies
    branches: tuple[TappingBranch, ...]
    outliers: Mask
    rows_chi2: float
    rows_freedom: float
    scale: float
    possible: bool

    @property
    def nuisances(self) -> tuple[Nuisance, ...]:
        """What is known of the instrument."""
        return self.lever.nuisances(self.number)

    @property
    def instrument(self) -> Instrument:
        """Where statements and free rows put it."""
        return self.lever.instrument(self.number)


def energies_along(
    lever: Lever, stretches: Sequence[Sequence[np.ndarray]], repulsive: Sequence[Mask]
) -> list[EnergyFunctions]:
    """Return the energies along the branches of the curves of a lever, with their bands.

    Args:
        lever: the curves, and their instrument.
        stretches: rows of each curve along which the energy is smooth.
        repulsive: rows of each curve that are on the repulsive branch.
    """
    each = [_along(lever, i, *pair) for i, pair in enumerate(zip(stretches, repulsive, strict=True))]
    curves = [branch.curve for one in each for branch in one.branches]
    if not curves:
        return each
    names = ("estimate_aj", "noise_aj", "certain")
    estimate, noise, certain = (np.concatenate([getattr(c, name) for c in curves]) for name in names)
    size, axes = np.linalg.eigh(lever.minimum.covariance)
    root = axes * np.sqrt(np.maximum(size, 0.0))
    by_instrument = np.concatenate([c.by_instrument for c in curves]) @ root
    low, high, possible = positive_bands(estimate, noise, certain, by_instrument)
    middle = 0.5 * (low + high)
    common = TWO_SIDED_95 * lever.curves[0].relative_error * middle
    low = np.maximum(middle - np.hypot(middle - low, common), 0.0)
    high = middle + np.hypot(high - middle, common)
    bands = zip(curves, low.reshape(-1, _POINTS), high.reshape(-1, _POINTS), strict=True)
    curves = iter([replace(curve, energy_low_aj=below, energy_high_aj=above) for curve, below, above in bands])
    return [
        replace(one, possible=possible, branches=tuple(replace(branch, curve=next(curves)) for branch in one.branches))
        for one in each
    ]


def _along(lever: Lever, number: int, stretches: Sequence[np.ndarray], repulsive: Mask) -> EnergyFunctions:
    """Return the energies along the branches of one curve, without their bands."""
    # where the instrument's search did not settle there is no energy
    stretches = stretches if lever.minimum.settled else ()
    curve, at = lever.curves[number], lever.instrument(number)
    smooth, place, stretches = smoothed(curve, stretches, at.free_amplitude_factor)
    found, at_smooth = energies(curve, at), energies(smooth, at)
    by_reading = np.stack([at_smooth.amplitude_slopes, at_smooth.lag_slopes])
    by_instrument = lever.slopes(smooth, number, lever.minimum.at)
    unknowns = [one if one.curve == number else one._replace(rows=np.zeros(curve.rows)) for one in lever.unknowns]
    outliers, branches, fits = np.zeros(curve.rows, bool), [], []
    for rows in stretches:
        fit = _stretch(curve, rows, place, found.energy_aj, by_reading[:, 0])
        of_virial = _stretch(curve, fit.rows, place, found.virial_aj, by_reading[:, 1])
        outliers[rows] = ~np.isin(rows, fit.rows)
        fits.append(fit)
        for side in (False, True):
            here = fit.rows[repulsive[fit.rows] == side]
            if len(here) < FEWEST_ROWS:
                continue
            ratios = 1.0 + SHALLOW - np.exp(place[here])
            ratio = np.linspace(max(ratios.min(), 0.0), ratios.max(), _POINTS)
            estimate, noise, by = _at(unknowns, fit, found.energy_aj, by_instrument[0], ratio)
            virial, virial_noise, virial_by = _at(unknowns, of_virial, found.virial_aj, by_instrument[1], ratio)
            variance = np.einsum("nu,uv,nv->n", virial_by, lever.minimum.covariance, virial_by) + virial_noise**2
            heights = fit.smoother.average(curve.offset_nm[fit.rows])
            uncertain = _ALLOWED * np.median(curve.amplitude_error_nm[here] / curve.free_amplitude_nm[here])
            along = EnergyCurve(
                amplitude_ratio=ratio,
                height_nm=np.interp(np.log(SHALLOW + 1.0 - ratio), fit.smoother.place, heights),
                energy_low_aj=estimate,
                energy_high_aj=estimate,
                virial_aj=virial,
                virial_error_aj=np.sqrt(variance + (curve.relative_error * virial) ** 2),
                estimate_aj=estimate,
                noise_aj=noise,
                by_instrument=by,
                certain=1.0 - ratio > uncertain,
            )
            drive = float(curve.drive_frequency_khz[here[0]]), float(curve.free_amplitude_nm[here[0]])
            branches.append(TappingBranch(*drive, bool(curve.retract[here[0]]), side, rows=np.sort(here), curve=along))
    return EnergyFunctions(
        lever=lever,
        number=number,
        smooth=smooth,
        energies=found,
        branches=tuple(sorted(branches, key=lambda b: (b.drive, b.retract, b.repulsive))),
        outliers=outliers,
        rows_chi2=sum((fit.chi2 for fit in fits), 0.0),
        rows_freedom=sum((fit.freedom for fit in fits), 0.0),
        scale=max([1.0, *(fit.scale for fit in fits)]),
        possible=True,
    )


class _Stretch(NamedTuple):
    """A smooth function along rows: those kept, their smoother, what they scatter about it, and the scale of errors."""

    rows: Int[np.ndarray, " some"]
    smoother: Smoother
    chi2: float
    freedom: float
    scale: float


def _stretch(curve: TappingCurve, rows: np.ndarray, place: Rows, values: Rows, slopes: np.ndarray) -> _Stretch:
    """Return the smooth function of values along a stretch of rows, without those that are more than four errors off.

    An energy is one at an amplitude, which is known no better than it was read: an error dA of the reading moves it by
    E_A dA at the height, and by (E_A - E'/A0) dA at the ratio.
    """
    amplitude_slope, lag_slope = (slope[rows] for slope in slopes)
    free, ratios = curve.free_amplitude_nm[rows], 1.0 + SHALLOW - np.exp(place[rows])
    by_lag = lag_slope * curve.lag_error_deg[rows]
    steep = np.zeros(len(rows))
    kept = np.ones(len(rows), bool)
    for last in (False, False, True):
        steepest = np.maximum(np.abs(amplitude_slope), np.abs(amplitude_slope - steep / free))
        here = rows[kept]
        noise = np.hypot(steepest * curve.amplitude_error_nm[rows], by_lag)[kept]
        size = size_of(values[here], noise)
        smoother = Smoother.of(place[here], noise, size)
        mean, taken = smoother.of_rows(place[here], values[here])
        off, freedom = (values[here] - mean) / noise, max(len(here) - taken, 1.0)
        chi2 = float(off @ off)
        scale = 1.0 if chi2_tail(chi2, max(round(freedom), 1)) > IMPROBABLE else float(np.sqrt(chi2 / freedom))
        ratio, first = np.unique(ratios[kept], return_index=True)
        if len(ratio) > 4:
            steep = np.interp(ratios, ratio, np.gradient(mean[first], ratio))
        far = np.abs(off) > _FAR * scale
        if not last and kept.all() and far.sum() <= _MOST_OUTLIERS * len(here):
            kept[far] = False
    smoother = Smoother.of(place[here], noise * scale, size) if scale > 1.0 else smoother
    return _Stretch(here, smoother, chi2, freedom, scale)


def _at(
    unknowns: Sequence[LeverUnknown], fit: _Stretch, values: Rows, slopes: np.ndarray, ratio: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a smooth function at some amplitudes, its own standard error, and its change by every unknown.

    Args:
        unknowns: of the instrument.
        fit: of the function.
        values: of it in each row of the curve.
        slopes: changes of the values by every unknown, shape (rows, unknowns).
        ratio: the amplitudes, of the free one.
    """
    weights, variance = fit.smoother.at(np.log(SHALLOW + 1.0 - ratio))
    mean, by = (weights @ fit.smoother.average(column[fit.rows]) for column in (values, slopes))
    # with more of a free amplitude the same ratio is at a larger reading; a branch may be all at one amplitude
    moved = np.gradient(mean, ratio) * ratio if np.ptp(ratio) > 0.0 else np.zeros(len(ratio))
    for i, unknown in enumerate(unknowns):
        if unknown.kind.startswith("free_amplitude"):
            by[:, i] += moved * unknown.given.error * (weights @ fit.smoother.average(unknown.rows[fit.rows]))
    return mean, np.sqrt(variance), by


def positive_bands(
    estimate: Rows, noise: Rows, certain: Mask, by_instrument: Float[np.ndarray, "rows unknowns"]
) -> tuple[Rows, Rows, bool]:
    """Return bands of 95 % of energies that are nowhere negative, and whether such energies exist.

    With E(a) = t at one point, E(a') of another has the mean E^' + (t - E^) G(a', a)/G(a, a) and a variance: t may be
    what leaves each mean + 3 standard deviations >= 0.

    Args:
        estimate: energies of all points of a lever.
        noise: their own standard errors.
        certain: points that may say so.
        by_instrument: changes of the energies by independent unknowns of the instrument, each known to 1.
    """
    variance = noise**2 + np.sum(by_instrument**2, axis=1)
    possible = not np.any((estimate + _ALLOWED * np.sqrt(variance) <= 0.0) & certain)
    certain = certain & (estimate + _ALLOWED * np.sqrt(variance) > 0.0)
    ends = []
    for n, middle in enumerate(estimate.tolist()):
        shared = by_instrument @ by_instrument[n]
        gain = shared / variance[n]
        left = np.sqrt(np.maximum(variance - gain * shared, 0.0))
        gain[n], left[n] = 1.0, 0.0
        with np.errstate(divide="ignore", invalid="ignore"):
            limits = middle - (estimate + _ALLOWED * left) / gain
        least = max(limits[certain & (gain > 1e-9)].max(initial=-np.inf), 0.0)
        most = limits[certain & (gain < -1e-9)].min(initial=np.inf)
        if least > most - noise[n]:
            # no instrument leaves all above nothing but by chance: none is taken for more than it is
            possible = possible and bool(least <= most)
            least, most = 0.0, np.inf
        low, high = _densest(middle, float(np.sqrt(variance[n])), least, most)
        ends.append((low, max(high, low + TWO_SIDED_95 * noise[n])))
    low, high = np.array(ends).T
    return low, high, possible


def _densest(mean: float, error: float, low: float, high: float) -> tuple[float, float]:
    """Return the 95 % of highest density of a normal distribution that is cut at low and high.

    Equal tails would never hold a truth that is next to nothing.
    """
    below, above = (low - mean) / error, (high - mean) / error
    if below > 0.0:
        # the tail that is left, without cancellation
        low, high = _densest(-mean, error, -high, -low)
        return -high, -low
    inside = 0.95 * (ndtr(above) - ndtr(below))
    # about the mean as far as the cuts allow
    first = np.clip(0.5 - 0.5 * inside, ndtr(below), ndtr(above) - inside)
    ends = np.clip(ndtri([first, first + inside]), max(below, min(above, 0.0) - 9.0), above)
    return mean + error * float(ends[0]), mean + error * float(ends[1])


def largest_of(branches: Sequence[TappingBranch]) -> tuple[int, int]:
    """Return the branch and the point at which the middle of the band is largest."""
    tops = [int(np.argmax(branch.curve.energy_aj)) for branch in branches]
    branch = max(range(len(branches)), key=lambda i: float(branches[i].curve.energy_aj[tops[i]]))
    return branch, tops[branch]


_NARROWS = 0.7
"""Half of a band over that of today up to which something more that is known narrows it."""


def what_narrows(functions: EnergyFunctions) -> str:
    """Return what to state to narrow the band where the energy is largest: zero of the phase, or free frequency.

    What is known of an unknown i to an error e takes (S C)_i^2/(e^2 + C_ii) off the variance S C S.
    """
    branch, point = largest_of(functions.branches)
    lever = functions.lever
    c = functions.branches[branch].curve
    row = functions.branches[branch].rows[0]
    covariance, by = lever.minimum.covariance, c.by_instrument[point]
    zero = next(i for i, n in lever.zeros if n == functions.number and lever.unknowns[i].rows[row])

    def half_of_band(i: int, error: float) -> float:
        known = (error / lever.unknowns[i].given.error) ** 2
        left = by @ covariance @ by - (by @ covariance[i]) ** 2 / (known + covariance[i, i])
        return TWO_SIDED_95 * float(np.sqrt(max(left, 0.0) + c.noise_aj[point] ** 2))

    frequency = f"'# free_frequency_khz = VALUE +- {1e-5 * functions.instrument.free_frequency_khz:.1g}'"
    half, words = min(
        (half_of_band(zero, 0.2), "the zero of the phase to 0.2 degrees ('# phase_zero_deg = VALUE +- 0.2')"),
        (half_of_band(0, 1e-5), f"the free frequency to 1e-5 of itself ({frequency})"),
    )
    if half > _NARROWS * half_of_band(zero, np.inf):
        return "zero of the phase and free frequency would not narrow that; less noise or more rows would"
    return f"state {words}, which would leave +- {half:.2g} aJ"


def differences_of_ways(functions: EnergyFunctions) -> list[dict[str, Any]]:
    """Return by how much retract differs from approach at the same amplitude and on the same side of the phase.

    Of each two branches, by their numbers, where they differ most in errors; what both have in common cancels.
    """
    found, covariance = [], functions.lever.minimum.covariance
    share = functions.lever.curves[functions.number].relative_error
    for (i, one), (j, other) in itertools.product(enumerate(functions.branches), repeat=2):
        low = max(b.curve.amplitude_ratio[0] for b in (one, other))
        high = min(b.curve.amplitude_ratio[-1] for b in (one, other))
        same = (one.drive, one.repulsive) == (other.drive, other.repulsive)
        if one.retract or not other.retract or not same or not low < high:
            continue
        ratio = np.linspace(low, high, _POINTS)
        (a, of_a, by_a), (b, of_b, by_b) = (branch.curve.estimates_at(ratio) for branch in (one, other))
        off, by = b - a, by_b - by_a
        error = np.sqrt(of_a**2 + of_b**2 + np.einsum("nu,uv,nv->n", by, covariance, by) + (share * off) ** 2)
        most = int(np.argmax(np.abs(off) / error))
        at = {"amplitude_ratio": ratio[most], "energy_aj": off[most], "standard_error": error[most]}
        found.append({"approach": i, "retract": j} | at)
    return found
