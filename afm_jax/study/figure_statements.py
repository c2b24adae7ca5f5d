"""What the paper says of figures 2, 3 and 9, as numbers worked out from the computed data."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from afm_jax import presets
from afm_jax.study.offset_amplitude import OffsetAmplitudes
from afm_jax.study.stability_regions import StabilityChart
from afm_jax.units import RAD_PER_US_PER_KHZ

LOW_DRIVE_NM = 1.0
"""Drive amplitudes below |sigma|: where the tails are, and where adhesion takes orbits away."""


@dataclass(frozen=True)
class Statement:
    """A statement of the paper, whether the data bear it out, and the numbers that say so."""

    statement: str
    holds: bool
    numbers: dict[str, object]


def complete_orders(chart: StabilityChart) -> list[int]:
    """Return the orders whose tongue lies within the chart with half an order to spare."""
    return [n for n in range(1, chart.orders + 1) if n + 0.5 < chart.reduced_frequency[-1]]


def tongues_at_resonance(chart: StabilityChart) -> Statement:
    """Figures 2 and 3: at the highest drive amplitude the orders are stable around omega = 2 N Omega."""
    edges, inside = {}, []
    for order in complete_orders(chart):
        row = chart.reduced_frequency[chart.tongue(order)[-1]]
        edges[order] = [float(row.min()), float(row.max())] if len(row) else None
        inside.append(len(row) > 0 and row.min() < order < row.max() and row.max() - row.min() < 1.0)
    return Statement(
        "tongues of stable orbits lie around omega = 2 N Omega",
        bool(inside) and all(inside),
        {"drive_amplitude_nm": float(chart.drive_amplitude_nm[-1]), "reduced_frequency_of_order": edges},
    )


def tail_shift(chart: StabilityChart, order: int) -> float:
    """Return how far in n a tongue's middle at its low-drive end lies from its middle at the highest drive amplitude.

    The low-drive end: the lowest tenth (in rows) of the tongue, islands of longer flights left out.
    """
    rows, columns = np.nonzero(chart.tongue(order))
    if not len(rows):
        return float("nan")
    frequency = chart.reduced_frequency[columns]
    low = rows <= rows.min() + 0.1 * (rows.max() - rows.min())
    return float(frequency[low].mean() - frequency[rows == rows.max()].mean())


def tails_lean(negative: StabilityChart, positive: StabilityChart) -> Statement:
    """Figure 2: the tails lean to lower frequency for a negative offset, to higher frequency for a positive one."""
    down = {order: tail_shift(negative, order) for order in complete_orders(negative)}
    up = {order: tail_shift(positive, order) for order in complete_orders(positive)[:-1]}
    return Statement(
        "tails lean to lower frequency for negative offset, to higher for positive offset",
        bool(down) and bool(up) and all(shift < 0 for shift in down.values()) and all(s > 0 for s in up.values()),
        {"shift_at_negative_offset": down, "shift_at_positive_offset": up},
    )


def adhesion_limit_nm(reduced_frequency: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Return the drive amplitude below which adhesion leaves no orbit: beta omega = sqrt((1 - r^2) epsilon)/2r.

    On an undamped (1, N) orbit V = -V', so that v_p = (u_in - u_out)/2, and eq. 6 lets this be no smaller.
    """
    r = presets.STABILITY_R
    top_speed = np.sqrt((1.0 - r**2) * presets.ADHESION) / (2.0 * r)
    return top_speed / (RAD_PER_US_PER_KHZ * 2.0 * presets.FREE_FREQUENCY_KHZ * reduced_frequency)


def low_orders_vanish(without: StabilityChart, adhesive: StabilityChart) -> Statement:
    """Figure 3: adhesion takes away the low orders at low drive, and little else; the charts share their grid."""
    low = without.drive_amplitude_nm[:, None] < LOW_DRIVE_NM
    orders = complete_orders(without)
    lost, onset = {}, {}
    for order in orders:
        before, after = without.tongue(order), adhesive.tongue(order)
        lost[order] = float((before & ~after & low).sum() / max(1, (before & low).sum()))
        rows = np.nonzero(after.any(axis=1))[0]
        onset[order] = float(without.drive_amplitude_nm[rows[0]]) if len(rows) else None
    shares = [lost[order] for order in orders]
    high = without.any_stable & (without.drive_amplitude_nm[:, None] > 2.0 * LOW_DRIVE_NM)
    kept = float((high & adhesive.any_stable).sum() / max(1, high.sum()))
    forbidden = without.drive_amplitude_nm[:, None] < adhesion_limit_nm(without.reduced_frequency)
    below = int((adhesive.any_stable & forbidden).sum())
    holds = bool(shares) and shares[0] > 0.9 and all(np.diff(shares) < 0) and below == 0 and kept > 0.9
    numbers = {
        "low_drive_below_nm": LOW_DRIVE_NM,
        "lost_share_at_low_drive_of_order": lost,
        "lowest_drive_amplitude_nm_of_order": onset,
        "kept_share_at_twice_low_drive": kept,
        "stable_points_below_limit": below,
    }
    return Statement("adhesion takes away the low orders at low drive, and little else", holds, numbers)


def amplitude_slope(amplitudes: OffsetAmplitudes, panel: int, *, falls: bool) -> Statement:
    """Figure 9: the amplitude falls (or rises) with the offset at offset 0, for every r with an orbit there."""
    rescaled, zero = amplitudes.rescaled_amplitude[panel], amplitudes.zero
    step = amplitudes.offset_nm[zero + 1] - amplitudes.offset_nm[zero - 1]
    slopes = (rescaled[:, zero + 1] - rescaled[:, zero - 1]) / step
    known = np.isfinite(slopes)
    steps = np.diff(rescaled, axis=1)
    steps = steps[np.isfinite(steps)]
    sign = -1.0 if falls else 1.0
    numbers = {
        "reduced_frequency": amplitudes.reduced_frequency[panel],
        "r_range": [float(amplitudes.r[known].min()), float(amplitudes.r[known].max())] if known.any() else None,
        "relative_slope_per_nm_range": [float(np.nanmin(slopes)), float(np.nanmax(slopes))] if known.any() else None,
        "share_of_all_steps_in_this_direction": float((sign * steps > 0.0).mean()) if len(steps) else None,
    }
    verb = "falls" if falls else "rises"
    holds = bool(known.any()) and bool(np.all(sign * slopes[known] > 0.0))
    text = f"the amplitude {verb} with the offset at n = {amplitudes.reduced_frequency[panel]:g}"
    return Statement(text, holds, numbers)
