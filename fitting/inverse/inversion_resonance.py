"""The paper's own reading of amplitudes on resonance: the velocities from the amplitudes alone, the phase assumed.

On a subharmonic resonance, omega = 2 N Omega, the paper takes the impact to occur where the sample is fastest (drive
phase 3 pi/2) and the flight to be an undamped half oscillation: V' = Omega a, V = -Omega a, so that

    u_in = Omega a + beta omega,    u_out = Omega a - beta omega.

Air damping and the collision delay are left out, and the offset; with them the phase is another.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from afm_jax.units import RAD_PER_US_PER_KHZ
from fitting.table import AmplitudeTable

ASSUMPTION = (
    "on resonance, omega = 2 N Omega, the tip hits where the sample is fastest (phase 3 pi/2), in instantaneous "
    "impacts between undamped half oscillations: V' = Omega a"
)
TOLERANCE = 5e-4
"""Relative distance of the drive frequency from 2 N times the free one up to which a row counts as on resonance."""
_HALF_SINE = 4.0 / (3.0 * np.pi)
"""Lock-in amplitude of half sines at their own frequency, over their height."""


@dataclass(frozen=True, kw_only=True)
class ResonanceReading:
    """The paper's reading of the rows on resonance; arrays of one entry per such row.

    Attributes:
        assumption: what it takes for granted.
        row: numbers of the rows in the table, from 0.
        approach_speed_nm_per_us: u_in.
        rebound_speed_nm_per_us: u_out.
        speed_error_nm_per_us: standard error of both: they share that of the amplitude.
        reference: what the bias is against: "truth", "phase" (the same rows inverted), "law" (regressed), or "none".
        reference_rebound_nm_per_us: u_out of the reference at the approach speed read, NaN where it has none.
        bias: rebound speed over that of the reference, less 1.
    """

    assumption: str
    row: Int[np.ndarray, " n"]
    approach_speed_nm_per_us: Float[np.ndarray, " n"]
    rebound_speed_nm_per_us: Float[np.ndarray, " n"]
    speed_error_nm_per_us: Float[np.ndarray, " n"]
    reference: str
    reference_rebound_nm_per_us: Float[np.ndarray, " n"]
    bias: Float[np.ndarray, " n"]


def on_resonance(table: AmplitudeTable) -> Bool[np.ndarray, " rows"]:
    """Return which rows of a table are driven at 2 N times the free frequency."""
    return np.abs(table.drive_frequency_khz / (2.0 * table.order * table.free_frequency_khz) - 1.0) <= TOLERANCE


def read_on_resonance(
    table: AmplitudeTable,
    *,
    law: tuple[Float[np.ndarray, " points"], Float[np.ndarray, " points"]] | None,
    reference: str,
) -> ResonanceReading:
    """Return the paper's reading of the rows on resonance, beside a law that is known otherwise.

    The amplitude is the peak height, or what half sines of the lock-in amplitude reach.

    Args:
        table: the table.
        law: approach and rebound speeds in nm/us, ascending, to compare with; None: there is nothing.
        reference: what that law is called.
    """
    blank = np.full(table.rows, np.nan)
    peak, peak_error = table.peak_amplitude_nm, table.peak_amplitude_error_nm
    peak, peak_error = (blank if part is None else part for part in (peak, peak_error))
    lockin, lockin_error = table.lockin_amplitude_nm, table.lockin_amplitude_error_nm
    lockin, lockin_error = (blank if part is None else part / _HALF_SINE for part in (lockin, lockin_error))
    height, error = np.where(np.isfinite(peak), (peak, peak_error), (lockin, lockin_error))
    row = np.flatnonzero(on_resonance(table))
    speed = RAD_PER_US_PER_KHZ * table.free_frequency_khz * height[row]
    top = RAD_PER_US_PER_KHZ * table.drive_frequency_khz[row] * table.drive_amplitude_nm[row]
    approach, rebound = speed + top, speed - top
    expected = np.full(len(row), np.nan)
    if law is not None:
        u, w = law
        inside = (approach >= u[0]) & (approach <= u[-1])
        # the loss is all but linear in the speed, the rebound speed of slow tips is not
        square = approach**2 - np.interp(approach, u, u**2 - w**2)
        expected = np.sqrt(np.where(inside & (square > 0.0), square, np.nan))
    return ResonanceReading(
        assumption=ASSUMPTION,
        row=row,
        approach_speed_nm_per_us=approach,
        rebound_speed_nm_per_us=rebound,
        speed_error_nm_per_us=RAD_PER_US_PER_KHZ * table.free_frequency_khz * error[row],
        reference=reference if law is not None else "none",
        reference_rebound_nm_per_us=expected,
        bias=rebound / expected - 1.0,
    )
