"""Where single-impact orbits are stable in the plane of drive frequency and drive amplitude (figures 2 and 3)."""

from collections.abc import Callable
from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from afm_jax.apparatus.scene import Scene
from afm_jax.study.orbit_verdicts import OrbitVerdicts, orbit_verdicts

TABLE_COLUMNS = (
    "reduced_frequency",
    "drive_amplitude_nm",
    "stable",
    "lowest_stable_order",
    "admissible",
    "peak_amplitude_nm",
)


@dataclass(frozen=True)
class StabilityChart:
    """A chart of stable admissible single-impact orbits.

    Attributes:
        scene_of: the scene at a reduced frequency and a drive amplitude in nm.
        reduced_frequency: n = omega/2 Omega of the columns, ascending.
        drive_amplitude_nm: beta of the rows, ascending.
        verdicts: orders 1, 2, ... by points; the points are the rows one after the other.
    """

    scene_of: Callable[..., Scene]
    reduced_frequency: Float[np.ndarray, " columns"]
    drive_amplitude_nm: Float[np.ndarray, " rows"]
    verdicts: OrbitVerdicts

    @property
    def orders(self) -> int:
        """Highest order that was looked for."""
        return len(self.verdicts.stable)

    @property
    def stable(self) -> Bool[np.ndarray, "orders rows columns"]:
        """Where an orbit of each order is stable and admissible."""
        return self._plane(self.verdicts.stable)

    @property
    def any_stable(self) -> Bool[np.ndarray, "rows columns"]:
        """Where an orbit of any order is stable and admissible."""
        return self._plane(self.verdicts.any_stable()[None])[0]

    @property
    def lowest_stable_order(self) -> Int[np.ndarray, "rows columns"]:
        """The lowest order with a stable admissible orbit; 0 where there is none."""
        stable = self.stable
        return np.where(stable.any(axis=0), stable.argmax(axis=0) + 1, 0)

    @property
    def stable_share(self) -> float:
        """Share of the chart's area with a stable orbit of any order."""
        return float(self.verdicts.any_stable().mean())

    def points(self) -> tuple[Float[np.ndarray, " points"], Float[np.ndarray, " points"]]:
        """Return reduced frequency and drive amplitude of every point, in the order of the verdicts."""
        frequency, amplitude = np.meshgrid(self.reduced_frequency, self.drive_amplitude_nm)
        return frequency.ravel(), amplitude.ravel()

    def tongue(self, order: int) -> Bool[np.ndarray, "rows columns"]:
        """Return where an orbit of this order is stable with a flight shorter than the tip's free period (n > N/2).

        Longer flights, past the platform without a touch, are possible too: islands apart from the tongue.
        """
        return self.stable[order - 1] & (self.reduced_frequency > 0.5 * order)

    def table(self) -> list[dict[str, object]]:
        """Return one row a point: where it is, its lowest stable order and that orbit's peak amplitude."""
        order = self.lowest_stable_order.ravel()
        peak = np.take_along_axis(self.verdicts.peak_amplitude_nm, np.maximum(order - 1, 0)[None], axis=0)[0]
        columns = (*self.points(), order > 0, order, self.verdicts.any_admissible(), peak)
        rows = zip(*(column.tolist() for column in columns), strict=True)
        return [dict(zip(TABLE_COLUMNS, row, strict=True)) for row in rows]

    def _plane(self, rows: np.ndarray) -> np.ndarray:
        return rows.reshape(len(rows), len(self.drive_amplitude_nm), len(self.reduced_frequency))


def stability_chart(
    scene_of: Callable[..., Scene],
    *,
    reduced_frequency: Float[np.ndarray, " columns"],
    drive_amplitude_nm: Float[np.ndarray, " rows"],
    last_order: int,
    report: Callable[[int], object] = lambda _: None,
) -> StabilityChart:
    """Compute a stability chart.

    Args:
        scene_of: the scene at a reduced frequency and a drive amplitude in nm; it must allow `vmap`.
        reduced_frequency: n of the columns, ascending.
        drive_amplitude_nm: beta of the rows in nm, ascending.
        last_order: highest order N that is looked for.
        report: called with each order before it is computed.

    Raises:
        RuntimeError: if JAX is not set to 64-bit floats.
    """
    frequency, amplitude = np.meshgrid(reduced_frequency, drive_amplitude_nm)
    verdicts = orbit_verdicts(
        batch_of_scenes(scene_of, frequency.ravel(), amplitude.ravel()), last_order=last_order, report=report
    )
    return StabilityChart(scene_of, reduced_frequency, drive_amplitude_nm, verdicts)


def batch_of_scenes(scene_of: Callable[..., Scene], *columns: np.ndarray) -> Scene:
    """Return one scene a row of some columns of arguments, as a batch."""
    return eqx.filter_vmap(scene_of)(*(jnp.asarray(column, float) for column in columns))


def share_above(chart: StabilityChart, *, last_order: int, stride: int) -> float:
    """Return the share of points that only orders above the chart's make stable: 0 if the chart is complete.

    Args:
        chart: the chart.
        last_order: highest order that is tried.
        stride: every so manieth row and column is tried.
    """
    columns, rows = chart.reduced_frequency[::stride], chart.drive_amplitude_nm[::stride]
    frequency, amplitude = np.meshgrid(columns, rows)
    scenes = batch_of_scenes(chart.scene_of, frequency.ravel(), amplitude.ravel())
    higher = orbit_verdicts(scenes, first_order=chart.orders + 1, last_order=last_order).any_stable()
    lower = chart.any_stable[::stride, ::stride].ravel()
    return float((higher & ~lower).mean())
