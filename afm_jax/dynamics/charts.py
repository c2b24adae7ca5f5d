"""Which of many scenes have a stable single-impact orbit: the question behind charts and amplitude curves.

Where single-impact orbits are stable in the plane of drive frequency and drive amplitude (figures 2 and 3).

The amplitude of the stable (1, 1) orbit against the offset, for several coefficients of restitution (figure 9).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from afm_jax.apparatus.scene import Scene
from afm_jax.impact.orbits import single_impact_orbits

BLOCK = 1000
"""Scenes computed together: few enough for the cache, many enough to fill the vector units; one program."""


class OrbitVerdicts(NamedTuple):
    """What there is at each scene, one row an order 1, 2, ..., one column a scene (NumPy arrays).

    ``stable``: an orbit that is admissible and stable. ``admissible``: an admissible orbit, stable or not.
    ``peak_amplitude_nm``: of the stable one (the highest, if there are several); NaN where there is none.
    """

    stable: Bool[np.ndarray, "orders scenes"]
    admissible: Bool[np.ndarray, "orders scenes"]
    peak_amplitude_nm: Float[np.ndarray, "orders scenes"]

    def any_stable(self) -> Bool[np.ndarray, " scenes"]:
        """Return where an orbit of any order is stable."""
        return np.asarray(self.stable.any(axis=0))

    def any_admissible(self) -> Bool[np.ndarray, " scenes"]:
        """Return where an orbit of any order is admissible."""
        return np.asarray(self.admissible.any(axis=0))


def orbit_verdicts(
    scenes: Scene, *, first_order: int = 1, last_order: int, report: Callable[[int], object] = lambda _: None
) -> OrbitVerdicts:
    """Find the single-impact orbits of many scenes for a range of orders.

    Args:
        scenes: a batch of scenes: every parameter has shape (scenes,).
        first_order: lowest order N.
        last_order: highest order N.
        report: called with each order before it is computed.

    Raises:
        RuntimeError: if JAX is not set to 64-bit floats.
    """
    blocks, count = _blocks(scenes), jax.tree.leaves(scenes)[0].shape[0]
    rows = []
    for order in range(first_order, last_order + 1):
        report(order)
        found = [_one_order(block, jnp.asarray(float(order))) for block in blocks]
        rows.append([np.concatenate(column)[:count] for column in zip(*found, strict=True)])
    return OrbitVerdicts(*(np.stack(column) for column in zip(*rows, strict=True)))


def _blocks(scenes: Scene) -> list[Scene]:
    """Return a batch of scenes in blocks of one length, the last of them filled up."""

    def cut(leaf: Array) -> Float[np.ndarray, "blocks lanes"]:
        values = np.asarray(leaf)
        return np.pad(values, (0, -len(values) % BLOCK), mode="edge").reshape(-1, BLOCK)

    cut_up = jax.tree.map(cut, scenes)
    return [jax.tree.map(lambda leaf, one=one: leaf[one], cut_up) for one in range(len(jax.tree.leaves(cut_up)[0]))]


@eqx.filter_jit
def _one_order(scenes: Scene, order: Float[Array, ""]) -> tuple[Array, Array, Array]:
    def one(scene: Scene) -> tuple[Array, Array, Array]:
        orbits = single_impact_orbits(scene, order)
        admissible = orbits.exists & orbits.admissible
        steady = admissible & orbits.stable
        highest = jnp.max(jnp.where(steady, orbits.peak_amplitude_nm, -jnp.inf))
        return jnp.any(steady), jnp.any(admissible), jnp.where(jnp.any(steady), highest, jnp.nan)

    return jax.vmap(one)(scenes)


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


AMPLITUDE_COLUMNS = ("reduced_frequency", "offset_nm", "r", "stable", "peak_amplitude_nm", "rescaled_amplitude")


@dataclass(frozen=True)
class OffsetAmplitudes:
    """Peak amplitudes over drive frequency, restitution and offset.

    Attributes:
        scene_of: the scene at a reduced frequency, an offset in nm and an r.
        reduced_frequency: n, one a panel.
        offset_nm: sigma, ascending, with 0 among them.
        r: coefficients of restitution, ascending.
        verdicts: of order 1 at all points, the offset varying fastest, then r.
    """

    scene_of: Callable[..., Scene]
    reduced_frequency: tuple[float, ...]
    offset_nm: Float[np.ndarray, " offsets"]
    r: Float[np.ndarray, " restitutions"]
    verdicts: OrbitVerdicts

    @property
    def peak_amplitude_nm(self) -> Float[np.ndarray, "panels restitutions offsets"]:
        """Peak amplitude of the stable (1, 1) orbit; NaN where there is none."""
        return self.verdicts.peak_amplitude_nm[0].reshape(len(self.reduced_frequency), len(self.r), len(self.offset_nm))

    @property
    def rescaled_amplitude(self) -> Float[np.ndarray, "panels restitutions offsets"]:
        """Peak amplitude over its value at offset 0, as figure 9 shows it; NaN for an r without an orbit there."""
        peak = self.peak_amplitude_nm
        return peak / peak[:, :, self.zero, None]

    @property
    def zero(self) -> int:
        """Index of offset 0."""
        return int(np.argmin(np.abs(self.offset_nm)))

    def points(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return reduced frequency, offset and r of every point, in the order of the verdicts."""
        return _points(self.reduced_frequency, self.offset_nm, self.r)

    def table(self) -> list[dict[str, object]]:
        """Return one row a point."""
        columns = (*self.points(), *(self.verdicts.stable), *self.verdicts.peak_amplitude_nm, self.rescaled_amplitude)
        rows = zip(*(column.ravel().tolist() for column in columns), strict=True)
        return [dict(zip(AMPLITUDE_COLUMNS, row, strict=True)) for row in rows]


def offset_amplitudes(
    scene_of: Callable[..., Scene],
    *,
    reduced_frequency: tuple[float, ...],
    offset_nm: Float[np.ndarray, " offsets"],
    r: Float[np.ndarray, " restitutions"],
) -> OffsetAmplitudes:
    """Compute the amplitude of the stable (1, 1) orbit on a grid.

    Args:
        scene_of: the scene at a reduced frequency, an offset in nm and an r; it must allow `vmap`.
        reduced_frequency: n of the panels.
        offset_nm: sigma, ascending; 0 must be among them, the amplitudes are rescaled there.
        r: coefficients of restitution.

    Raises:
        ValueError: if no offset is 0.
        RuntimeError: if JAX is not set to 64-bit floats.
    """
    if not np.any(offset_nm == 0.0):
        raise ValueError("`offset_nm` must contain 0, where the amplitudes are rescaled to 1; add it")
    scenes = batch_of_scenes(scene_of, *_points(reduced_frequency, offset_nm, r))
    return OffsetAmplitudes(scene_of, reduced_frequency, offset_nm, r, orbit_verdicts(scenes, last_order=1))


def _points(
    reduced_frequency: tuple[float, ...], offset_nm: np.ndarray, r: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    frequency, restitution, offset = np.meshgrid(np.asarray(reduced_frequency), r, offset_nm, indexing="ij")
    return frequency.ravel(), offset.ravel(), restitution.ravel()
