"""The fitted law at a few round speeds, in words: a table to read off."""

import numpy as np

from fitting.reporting.report_band import band_width
from fitting.reporting.report_plot import has_delay
from fitting.result import FitResult

_ROUND = (1.0, 2.0, 3.0, 5.0, 7.0)


def law_points(result: FitResult) -> list[list[str]]:
    """Return a row for each round speed among the measured ones.

    Each holds approach speed, rebound speed, its band and the energy lost in per cent; where impacts last, also the
    delay in ns and its band.
    """
    width = band_width(result)
    if width is None:
        return []
    speeds = np.array([digit * 10.0**power for power in range(-3, 7) for digit in _ROUND])
    speeds = speeds[(speeds >= width.slowest_nm_per_us) & (speeds <= width.fastest_nm_per_us)]
    law = result.law
    columns = np.array(
        [
            np.interp(speeds, law.approach_speed_nm_per_us, column)
            for column in (law.rebound_speed_nm_per_us, law.rebound_low_nm_per_us, law.rebound_high_nm_per_us)
        ]
        + [
            1e3 * np.interp(speeds, law.approach_speed_nm_per_us, column)
            for column in (law.collision_delay_us, law.delay_low_us, law.delay_high_us)
        ]
    )
    lasting = has_delay(result)
    return [
        _row(float(speed), column.tolist(), lasting=lasting) for speed, column in zip(speeds, columns.T, strict=True)
    ]


def _row(speed: float, values: list[float], *, lasting: bool) -> list[str]:
    rebound, low, high, delay, early, late = values
    lost, most, least = (100.0 * (1.0 - (value / speed) ** 2) for value in (rebound, low, high))
    cells = [f"{speed:g}", *_with_band(rebound, low, high), _with_band(lost, least, most)[0]]
    return cells + (_with_band(delay, early, late) if lasting else [])


def _with_band(value: float, low: float, high: float) -> list[str]:
    """Return a value and its band with the digits that the band warrants."""
    if not (np.isfinite(low) and np.isfinite(high)):
        return [f"{value:.4g}", "-"]
    digits = int(np.clip(1 - np.floor(np.log10(max(high - low, 1e-12))), 0, 6))
    return [f"{value:.{digits}f}", f"{low:.{digits}f} to {high:.{digits}f}"]
