"""Energy and virial of a tap as functions of the amplitude, branch by branch, with their 95 % bands."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from fitting.tapping_curves.branches import CurveBranch
from fitting.tapping_curves.curve import Rows, TappingCurve
from fitting.tapping_curves.energy import virial_noise_of
from fitting.tapping_curves.energy_fit import Z95, EnergyFit, losses, smoother_along

FEWEST_ROWS = 3
"""Of a group of rows that gets an energy of its own."""
_MOST_POINTS = 81
HEADLINE = (0.95, 0.9, 0.8, 0.7, 0.5)
"""Amplitudes, of the free one, at which a reader is told the energy."""


def within(ratio: float, measured: np.ndarray, *columns: np.ndarray) -> tuple[float, ...] | None:
    """Return columns at an amplitude, of the free one, by straight lines between those measured; None beyond them."""
    if not measured[0] <= ratio <= measured[-1]:
        return None
    return tuple(float(np.interp(ratio, measured, column)) for column in columns)


@dataclass(frozen=True, kw_only=True, eq=False)
class EnergyCurve:
    """Energy and virial along a branch, in the order of the amplitude; bands hold the truth in 95 of 100 places.

    Attributes:
        amplitude_ratio: amplitude read over the free one.
        height_nm: of the sample.
        energy_aj: of a tap, the mean over a period of the drive.
        energy_error_aj: its standard error, everything in it.
        virial_aj: mean of force times height, positive where attraction prevails.
        virial_error_aj: its standard error.
        energy_by_instrument: change of the energy by every unknown of the fit, in its unit, shape (points, unknowns).
        energy_noise_aj: the part of the standard error that is the branch's own.
    """

    amplitude_ratio: Float[np.ndarray, " points"]
    height_nm: Float[np.ndarray, " points"]
    energy_aj: Float[np.ndarray, " points"]
    energy_error_aj: Float[np.ndarray, " points"]
    virial_aj: Float[np.ndarray, " points"]
    virial_error_aj: Float[np.ndarray, " points"]
    energy_by_instrument: Float[np.ndarray, "points unknowns"]
    energy_noise_aj: Float[np.ndarray, " points"]

    def at(self, ratio: float) -> tuple[float, ...] | None:
        """Return energy and standard error at an amplitude, of the free one; None beyond the branch."""
        return within(ratio, self.amplitude_ratio, self.energy_aj, self.energy_error_aj)

    @property
    def largest(self) -> tuple[float, float, float]:
        """The largest energy, its standard error and the amplitude, of the free one, that it is at."""
        top = int(np.argmax(self.energy_aj))
        return float(self.energy_aj[top]), float(self.energy_error_aj[top]), float(self.amplitude_ratio[top])

    @property
    def by_height(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Height, energy and its standard error in the order of the heights."""
        order = np.argsort(self.height_nm)
        return self.height_nm[order], self.energy_aj[order], self.energy_error_aj[order]

    def to_dict(self) -> dict[str, np.ndarray]:
        """Return amplitude ratio, height, energy and virial with their bands."""
        return {
            "amplitude_ratio": self.amplitude_ratio,
            "height_nm": self.height_nm,
            "energy_aj": self.energy_aj,
            "energy_low_aj": self.energy_aj - Z95 * self.energy_error_aj,
            "energy_high_aj": self.energy_aj + Z95 * self.energy_error_aj,
            "virial_aj": self.virial_aj,
            "virial_low_aj": self.virial_aj - Z95 * self.virial_error_aj,
            "virial_high_aj": self.virial_aj + Z95 * self.virial_error_aj,
        }


@dataclass(frozen=True, kw_only=True, eq=False)
class TappingBranch(CurveBranch):
    """Rows of one drive, one way and one side of the phase, and the energy along them.

    Attributes:
        rows: numbers of the rows.
        curve: energy and virial along them.
    """

    rows: Int[np.ndarray, " some"]
    curve: EnergyCurve


def branches_of(curve: TappingCurve, fit: EnergyFit, repulsive: Bool[np.ndarray, " rows"]) -> tuple[TappingBranch, ...]:
    """Return the branches that the functions of a fit run along."""
    place = losses(curve)
    found = []
    for number, rows in enumerate(fit.rows):
        for state in (False, True):
            here = rows[repulsive[rows] == state]
            if len(here) >= FEWEST_ROWS:
                found.append(
                    TappingBranch(
                        drive_frequency_khz=float(curve.drive_frequency_khz[here[0]]),
                        free_amplitude_nm=float(curve.free_amplitude_nm[here[0]]),
                        retract=bool(curve.retract[here[0]]),
                        repulsive=state,
                        rows=here,
                        curve=_curve(curve, fit, number, here, place),
                    )
                )
    return tuple(sorted(found, key=lambda b: (b.drive, b.retract, b.repulsive)))


def _curve(
    curve: TappingCurve, fit: EnergyFit, number: int, here: Int[np.ndarray, " some"], place: Rows
) -> EnergyCurve:
    """Return the functions of a fit along some of their rows."""
    rows = fit.rows[number]
    ends = curve.offset_nm[here]
    height = np.linspace(ends.min(), ends.max(), min(max(len(here), FEWEST_ROWS), _MOST_POINTS))
    _, first = np.unique(curve.offset_nm[rows], return_index=True)
    at = np.interp(height, curve.offset_nm[rows][first], place[rows][first])
    energy, own, slopes = fit.function(number, at)
    factor = np.broadcast_to(fit.instrument.free_amplitude_factor, (curve.rows,))[rows]
    read = curve.amplitude_nm[rows] / (curve.free_amplitude_nm[rows] * factor)
    read_noise = fit.scale * curve.amplitude_error_nm[rows] / curve.free_amplitude_nm[rows]
    smoother = smoother_along(place[rows], read, read_noise, 0.3)
    weights, ratio_variance = smoother.at(at)
    ratio = weights @ smoother.bins.average(read)
    # an energy at a height is one at an amplitude that is known no better than it was read
    ratio_error = np.sqrt(ratio_variance)
    energy_error = np.hypot(fit.error(energy, own, slopes), _steepness(energy, ratio) * ratio_error)
    read = fit.energies_at.virial_aj[rows]
    noise = fit.scale * virial_noise_of(curve, fit.energies_at)[rows]
    smoother = smoother_along(place[rows], read, noise, max(float(np.ptp(read)), float(noise.mean())))
    weights, virial_own = smoother.at(at)
    virial = weights @ smoother.bins.average(read)
    virial_slopes = weights @ smoother.bins.average(fit.virial_slopes[rows])
    virial_error = np.hypot(fit.error(virial, virial_own, virial_slopes), _steepness(virial, ratio) * ratio_error)
    order = np.argsort(ratio, kind="stable")
    return EnergyCurve(
        amplitude_ratio=ratio[order],
        height_nm=height[order],
        energy_aj=energy[order],
        energy_error_aj=energy_error[order],
        virial_aj=virial[order],
        virial_error_aj=virial_error[order],
        energy_by_instrument=slopes[order],
        energy_noise_aj=np.sqrt(own)[order],
    )


def _steepness(values: np.ndarray, ratio: np.ndarray) -> np.ndarray:
    """Return the size of the slope of values over the amplitude, 0 where it cannot be told."""
    if len(ratio) < 3 or not np.all(np.diff(ratio)):
        return np.zeros(len(ratio))
    return np.abs(np.gradient(values, ratio))


@dataclass(frozen=True)
class WayDifference:
    """Retract less approach at the same amplitude and on the same side of the phase.

    Attributes:
        amplitude_ratio: where they differ most, in errors.
        energy_aj: by how much there.
        standard_error: its error; what both have in common cancels.
    """

    amplitude_ratio: float
    energy_aj: float
    standard_error: float


def differences_of_ways(branches: tuple[TappingBranch, ...], fit: EnergyFit) -> dict[tuple[int, int], WayDifference]:
    """Return by how much retract differs from approach, by the numbers of the two branches."""
    found = {}
    for i, one in enumerate(branches):
        for j, other in enumerate(branches):
            if one.retract or not other.retract or (one.drive, one.repulsive) != (other.drive, other.repulsive):
                continue
            a, b = one.curve, other.curve
            low = max(a.amplitude_ratio[0], b.amplitude_ratio[0])
            high = min(a.amplitude_ratio[-1], b.amplitude_ratio[-1])
            ratio = np.linspace(low, high, 41)
            if not low < high:
                continue

            def of(curve: EnergyCurve, column: np.ndarray, ratio: np.ndarray = ratio) -> np.ndarray:
                return np.interp(ratio, curve.amplitude_ratio, column)

            slopes = np.stack(
                [of(b, y) - of(a, x) for x, y in zip(a.energy_by_instrument.T, b.energy_by_instrument.T, strict=True)]
                or [np.zeros(0)],
                axis=-1,
            )
            off = of(b, b.energy_aj) - of(a, a.energy_aj)
            own = of(a, a.energy_noise_aj) ** 2 + of(b, b.energy_noise_aj) ** 2 + (fit.share * off) ** 2
            error = np.sqrt(own + (fit.by_instrument(slopes) if len(slopes) == len(ratio) else 0.0))
            most = int(np.argmax(np.abs(off) / error))
            found[i, j] = WayDifference(float(ratio[most]), float(off[most]), float(error[most]))
    return found
