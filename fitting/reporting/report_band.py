"""How sure a fitted law is where it was measured: the width of its 95 % band in one number."""

from dataclasses import dataclass

import numpy as np

from fitting.result import FitResult


@dataclass(frozen=True)
class BandWidth:
    """The band of the rebound speed over the approach speeds of the rows that were used.

    Attributes:
        slowest_nm_per_us: the slowest approach of a used row.
        fastest_nm_per_us: the fastest one.
        worst: largest half-width of the 95 % band there, relative to the rebound speed; NaN if there is no band.
        worst_at_nm_per_us: the approach speed it is found at; NaN likewise.
    """

    slowest_nm_per_us: float
    fastest_nm_per_us: float
    worst: float
    worst_at_nm_per_us: float


def band_width(result: FitResult) -> BandWidth | None:
    """Return the worst relative half-width of the law's band over the measured speeds; None if no row has a speed.

    The band is known at the law's points; between them it is interpolated, at the slowest and fastest row.
    """
    reached = result.rows.approach_speed_nm_per_us[result.rows.used]
    reached = reached[np.isfinite(reached)]
    if not reached.size:
        return None
    slowest, fastest = float(reached.min()), float(reached.max())
    law = result.law
    inside = (law.approach_speed_nm_per_us > slowest) & (law.approach_speed_nm_per_us < fastest)
    speeds = np.concatenate(([slowest], law.approach_speed_nm_per_us[inside], [fastest]))
    rebound, high = (
        np.interp(speeds, law.approach_speed_nm_per_us, column)
        for column in (law.rebound_speed_nm_per_us, law.rebound_high_nm_per_us)
    )
    # the lower edge is cut at zero, the upper one never
    known = np.isfinite(high) & (rebound > 0.0)
    if not known.any():
        return BandWidth(slowest, fastest, float("nan"), float("nan"))
    share = (high[known] - rebound[known]) / rebound[known]
    worst = int(np.argmax(share))
    return BandWidth(slowest, fastest, float(share[worst]), float(speeds[known][worst]))


def band_in_words(result: FitResult) -> str:
    """Return how well the law is known over the measured speeds, or why that cannot be said; a sentence."""
    width = band_width(result)
    if width is None:
        return "No row reached a steady orbit: the law was measured at no speed."
    slowest, fastest = f"{width.slowest_nm_per_us:.3g}", f"{width.fastest_nm_per_us:.3g}"
    where = f"Over the measured approach speeds, {slowest} to {fastest} nm/us,"
    if slowest == fastest:
        where = f"At the one measured approach speed, {slowest} nm/us,"
    if not np.isfinite(width.worst):
        cause = "the parameters' errors are not known" if result.valid else "the fit is not valid"
        return f"{where} no band can be given: {cause}."
    return (
        f"{where} the rebound speed is known to {percent(width.worst)} or better "
        f"(95 % band, widest at {width.worst_at_nm_per_us:.3g} nm/us)."
    )


def percent(share: float) -> str:
    """Return a share in per cent with two significant digits, '0.31 %'."""
    return f"{float(f'{100.0 * share:.2g}'):g} %"
