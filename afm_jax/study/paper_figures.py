"""The data of the paper's figures 2, 3 and 9, with what the paper says of them checked on the data."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import ArrayLike, Float

from afm_jax import presets
from afm_jax.apparatus.scene import Scene
from afm_jax.study.figure_statements import (
    Statement,
    amplitude_slope,
    low_orders_vanish,
    tails_lean,
    tongues_at_resonance,
)
from afm_jax.study.offset_amplitude import OffsetAmplitudes, offset_amplitudes
from afm_jax.study.orbit_verdicts import OrbitVerdicts
from afm_jax.study.spot_checks import SpotChecks, spot_check
from afm_jax.study.stability_regions import StabilityChart, batch_of_scenes, share_above, stability_chart

LAST_ORDER = 14
_REDUCED_FREQUENCIES = (0.301, 6.501)
"""Off round numbers: where n is a fraction N/2k with small integers, the flight of a (1, N) orbit lasts k free periods
exactly, every state returns, and whether that is an orbit is a matter of rounding."""
_DRIVE_AMPLITUDES_NM = (0.0, 3.0)
_OFFSETS_NM = 1.0
_RESTITUTIONS = (50, 99)  # in hundredths
_COARSE = 4
_SPOT_IMPACTS = 2000


@dataclass(frozen=True)
class FigureData:
    """One figure: its data, and how well they stand.

    Attributes:
        data: the chart, or the amplitudes.
        numbers: key numbers of the figure.
        statements: what the paper says of it, checked.
        spot_checks: its verdicts against long iterations.
        compared_with: the chart without adhesion, for figure 3.
    """

    data: StabilityChart | OffsetAmplitudes
    numbers: dict[str, object]
    statements: list[Statement]
    spot_checks: SpotChecks
    compared_with: StabilityChart | None = None

    @property
    def valid(self) -> bool:
        """Whether every statement holds and every spot check agreed."""
        return all(statement.holds for statement in self.statements) and not self.spot_checks.failures


def chart_grid(*, coarse: bool) -> tuple[Float[np.ndarray, " columns"], Float[np.ndarray, " rows"]]:
    """Return reduced frequencies and drive amplitudes (nm) of figures 2 and 3: the middles of cells."""
    stride = _COARSE if coarse else 1
    return _middles(*_REDUCED_FREQUENCIES, 496 // stride), _middles(*_DRIVE_AMPLITUDES_NM, 240 // stride)


def figure2_chart(*, coarse: bool, report: Callable[[str], object] = lambda _: None) -> StabilityChart:
    """Compute the chart of figure 2: no adhesion."""
    return _chart(presets.figure2_scene, "figure 2", coarse=coarse, report=report)


def figure3_chart(*, coarse: bool, report: Callable[[str], object] = lambda _: None) -> StabilityChart:
    """Compute the chart of figure 3: with adhesion."""
    return _chart(presets.figure3_scene, "figure 3", coarse=coarse, report=report)


def figure2(chart: StabilityChart, *, seed: int, points: int) -> FigureData:
    """Check figure 2: tongues at resonance, tails that follow the sign of the offset, verdicts by iteration.

    Args:
        chart: the chart of figure 2.
        seed: of the spot checks.
        points: spot checks of each verdict.
    """
    mirrored = _chart(_positive_offset_scene, "figure 2, positive offset", coarse=True)
    statements = [tongues_at_resonance(chart), tails_lean(chart, mirrored), _complete(chart)]
    return FigureData(chart, _chart_numbers(chart), statements, _check_chart(chart, seed, points))


def figure3(chart: StabilityChart, without: StabilityChart, *, seed: int, points: int) -> FigureData:
    """Check figure 3: tongues at resonance, low orders gone at low drive, verdicts by iteration.

    Args:
        chart: the chart of figure 3.
        without: that of figure 2, on the same grid.
        seed: of the spot checks.
        points: spot checks of each verdict.
    """
    statements = [tongues_at_resonance(chart), low_orders_vanish(without, chart), _complete(chart)]
    return FigureData(chart, _chart_numbers(chart), statements, _check_chart(chart, seed, points), without)


def figure9(*, coarse: bool, seed: int, points: int) -> FigureData:
    """Compute and check figure 9: amplitude against offset below and above resonance.

    Args:
        coarse: a quarter of the offsets only.
        seed: of the spot checks.
        points: spot checks of each verdict.
    """
    steps = 25 if coarse else 100
    low, high = _RESTITUTIONS
    amplitudes = offset_amplitudes(
        presets.figure9_scene,
        reduced_frequency=(presets.OFFSET_SWEEP_BELOW, presets.OFFSET_SWEEP_ABOVE),
        offset_nm=np.arange(-steps, steps + 1) * (_OFFSETS_NM / steps),
        r=np.arange(low, high + 1) / 100.0,
    )
    statements = [amplitude_slope(amplitudes, 0, falls=True), amplitude_slope(amplitudes, 1, falls=False)]
    peak = amplitudes.peak_amplitude_nm[:, :, amplitudes.zero]
    numbers: dict[str, object] = {
        "stable_share": float(np.mean(np.isfinite(amplitudes.peak_amplitude_nm))),
        "peak_amplitude_nm_at_zero_offset_and_highest_r": peak[:, -1].tolist(),
    }
    checks = _check(amplitudes.scene_of, amplitudes.points(), amplitudes.verdicts, seed, points)
    return FigureData(amplitudes, numbers, statements, checks)


def _chart(
    scene_of: Callable[..., Scene], name: str, *, coarse: bool, report: Callable[[str], object] = lambda _: None
) -> StabilityChart:
    def progress(order: int) -> None:
        report(f"{name}: order {order} of {LAST_ORDER}")

    frequency, amplitude = chart_grid(coarse=coarse)
    return stability_chart(
        scene_of, reduced_frequency=frequency, drive_amplitude_nm=amplitude, last_order=LAST_ORDER, report=progress
    )


def _positive_offset_scene(reduced_frequency: ArrayLike, drive_amplitude_nm: ArrayLike) -> Scene:
    """Return figure 2's scene with the offset's sign turned round."""
    return presets.stability_scene(reduced_frequency, drive_amplitude_nm, -presets.STABILITY_OFFSET_NM, 0.0)


def _complete(chart: StabilityChart) -> Statement:
    """Say whether orders above the chart's would add anything."""
    share = share_above(chart, last_order=2 * LAST_ORDER, stride=_COARSE)
    numbers: dict[str, object] = {"share_of_points_added": share, "tried_up_to_order": 2 * LAST_ORDER}
    return Statement(f"orders above {LAST_ORDER} add less than 1e-4 of the points", share < 1e-4, numbers)


def _chart_numbers(chart: StabilityChart) -> dict[str, object]:
    stable = chart.stable
    return {
        "stable_share": chart.stable_share,
        "stable_share_of_order": {n + 1: float(share) for n, share in enumerate(stable.mean(axis=(1, 2)))},
        "share_with_several_orders": float((stable.sum(axis=0) > 1).mean()),
        "points": int(stable[0].size),
    }


def _check_chart(chart: StabilityChart, seed: int, points: int) -> SpotChecks:
    return _check(chart.scene_of, chart.points(), chart.verdicts, seed, points)


def _check(
    scene_of: Callable[..., Scene], columns: tuple[np.ndarray, ...], verdicts: OrbitVerdicts, seed: int, points: int
) -> SpotChecks:
    return spot_check(
        lambda chosen: batch_of_scenes(scene_of, *(column[chosen] for column in columns)),
        verdicts,
        seed=seed,
        points=points,
        impacts=_SPOT_IMPACTS,
    )


def _middles(low: float, high: float, cells: int) -> Float[np.ndarray, " cells"]:
    # Rounded: the table then shows 0.3125 and not 0.31249999999999994.
    return np.round(low + (np.arange(cells) + 0.5) * ((high - low) / cells), 12)
