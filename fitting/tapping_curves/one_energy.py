"""One energy for all taps of a drive and side: an assumption that narrows the instrument.

It stands apart from the energy along the branches, and makes no curve valid.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Int

from afm_jax.units import TWO_SIDED_95
from fitting.tapping_curves.branches import FEWEST_ROWS, side_of
from fitting.tapping_curves.curve import Mask, Rows, TappingCurve
from fitting.tapping_curves.energy import energies, noise_of
from fitting.tapping_curves.lever import Lever, Nuisance, Solution, least_squares


@dataclass(frozen=True, kw_only=True)
class EnergyGroup:
    """One energy of rows of one drive and one side of the phase.

    Attributes:
        drive: frequency in kHz and free amplitude in nm.
        repulsive: whether the lag is below the free tip's.
        rows: numbers of the rows.
        energy_aj: of a tap.
        error_aj: its standard error.
    """

    drive: tuple[float, float]
    repulsive: bool
    rows: Int[np.ndarray, " some"]
    energy_aj: float
    error_aj: float

    @property
    def name(self) -> str:
        """What it is called."""
        frequency, amplitude = self.drive
        return f"{side_of(self.repulsive)}, {frequency:g} kHz, free amplitude {amplitude:.4g} nm"

    @property
    def interval95_aj(self) -> tuple[float, float]:
        """Ends of the 95 % interval of the energy of a tap in aJ."""
        return self.energy_aj - TWO_SIDED_95 * self.error_aj, self.energy_aj + TWO_SIDED_95 * self.error_aj


@dataclass(frozen=True, kw_only=True)
class OneEnergy:
    """One energy for each group of rows, fitted together with the instrument.

    Attributes:
        groups: rows and energies.
        nuisances: of the instrument.
        residual: of the rows fitted, in standard errors; NaN elsewhere.
        minimum: chi2 of rows, free rows and what is stated, its degrees of freedom.
        scale: what the rows' own errors were multiplied by.
    """

    groups: tuple[EnergyGroup, ...]
    nuisances: tuple[Nuisance, ...]
    residual: Rows
    minimum: Solution
    scale: float

    @property
    def used(self) -> Mask:
        """Rows that were fitted."""
        return np.isfinite(self.residual)


def one_energy(
    lever: Lever, usable: Mask, repulsive: Mask, smooth: TappingCurve, scale: float = 1.0
) -> OneEnergy | None:
    """Return one energy for each drive and side of a lever's only curve, the instrument free within what is stated.

    Args:
        lever: the curve, and its instrument.
        usable: rows that may share an energy; None where no drive and side has enough of them.
        repulsive: rows of the repulsive branch.
        smooth: the curve with smooth readings, at which errors of energies are taken.
        scale: what the rows' own errors are multiplied by.
    """
    curve, count = lever.curves[0], len(lever.unknowns)
    columns = np.stack([curve.drive_frequency_khz, curve.free_amplitude_nm, ~repulsive], axis=1)
    kinds = np.unique(columns[usable], axis=0)
    groups = [np.flatnonzero(usable & np.all(columns == kind, axis=1)) for kind in kinds]
    groups = [rows for rows in groups if len(rows) >= FEWEST_ROWS]
    if not groups:
        return None
    rows = np.concatenate(groups)
    group = np.repeat(np.arange(len(groups)), [len(part) for part in groups])
    own = (group[:, None] == np.arange(len(groups))).astype(float)

    def off(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return how far the rows' energies are from those of their groups, and their noise."""
        at = lever.instrument(0, x)
        noise = scale * noise_of(smooth, energies(smooth, at))[0][rows]
        return energies(curve, at).energy_aj[rows] - x[count:][group], noise

    def residual(x: np.ndarray) -> np.ndarray:
        left, noise = off(x)
        return np.concatenate([lever.residual(x), left / noise])

    def jacobian(x: np.ndarray) -> np.ndarray:
        """Return the changes at the likeliest readings with the groups' energies.

        At others slopes depend on the scatter of the energies, and pull Q and f0 to where all of them are smaller.
        """
        noise, there = off(x)[1], energies(smooth, lever.instrument(0, x))
        missing = (x[count:][group] - there.energy_aj[rows]) / (noise / scale) ** 2
        moved = replace(smooth, amplitude_nm=smooth.amplitude_nm.copy(), lag_deg=smooth.lag_deg.copy())
        moved.amplitude_nm[rows] += missing * (there.amplitude_slopes[0] * smooth.amplitude_error_nm**2)[rows]
        moved.lag_deg[rows] += missing * (there.lag_slopes[0] * smooth.lag_error_deg**2)[rows]
        by = lever.slopes(moved, 0, x)[0][rows]
        of_free = np.pad(lever.jacobian(x), ((0, 0), (0, len(groups))))
        return np.concatenate([of_free, np.concatenate([by, -own], axis=1) / noise[:, None]])

    start = energies(curve, lever.instrument(0)).energy_aj
    x = np.concatenate([lever.minimum.at, [float(np.mean(start[part])) for part in groups]])
    minimum = least_squares(residual, jacobian, x)
    residuals = np.full(curve.rows, np.nan)
    residuals[rows] = np.divide(*off(minimum.at))
    found = zip(groups, minimum.at[count:].tolist(), np.sqrt(np.diag(minimum.covariance)[count:]).tolist(), strict=True)
    return OneEnergy(
        groups=tuple(
            EnergyGroup(
                drive=(float(curve.drive_frequency_khz[part[0]]), float(curve.free_amplitude_nm[part[0]])),
                repulsive=bool(repulsive[part[0]]),
                rows=part,
                energy_aj=energy,
                error_aj=float(np.hypot(error, curve.relative_error * energy)),
            )
            for part, energy, error in found
        ),
        nuisances=lever.nuisances(0, minimum),
        residual=residuals,
        minimum=minimum,
        scale=scale,
    )
