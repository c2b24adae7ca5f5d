"""The amplitude of the stable (1, 1) orbit against the offset, for several coefficients of restitution (figure 9)."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from afm_jax.apparatus.scene import Scene
from afm_jax.study.orbit_verdicts import OrbitVerdicts, orbit_verdicts
from afm_jax.study.stability_regions import batch_of_scenes

TABLE_COLUMNS = ("reduced_frequency", "offset_nm", "r", "stable", "peak_amplitude_nm", "rescaled_amplitude")


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
        return [dict(zip(TABLE_COLUMNS, row, strict=True)) for row in rows]


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
