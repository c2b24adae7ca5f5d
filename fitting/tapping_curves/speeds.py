"""How fast the tip meets the sample: approach speed, rebound speed and time of contact of a row, without any law.

Seen with the free motion taken away, w = z + A0 cos(omega t), the tip flies freely and the sample moves as
sigma + A0 cos(omega t). A flight that starts on the sample at t_out with the relative speed u_out and meets it again
at t_out + T - tau has three unknowns and three conditions: the lock-in's complex W = Z + A0, and the sample's height at
its end. The spring constant does not enter.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool

from afm_jax.units import RAD_PER_US_PER_KHZ
from fitting.tapping_curves.curve import Instrument, Rows, TappingCurve, motion_of

_ROUNDS = 40
_STEP = 1e-6
_CLOSED = 1e-9
"""Of the free amplitude: what the equations may be off at a solution."""
_SHORTEST_STEP = 1.0 / 64.0


class TapSpeeds(NamedTuple):
    """Of every row, NaN where no flight fits.

    Attributes:
        approach_speed_nm_per_us: u_in > 0.
        rebound_speed_nm_per_us: u_out > 0.
        contact_us: tau, from where the flight meets the sample to where it leaves it.
        pull: g tau/u_in, the speed that lever and drive give the tip during contact, of its own.
    """

    approach_speed_nm_per_us: Rows
    rebound_speed_nm_per_us: Rows
    contact_us: Rows
    pull: Rows


class _Seen(NamedTuple):
    """What the flights of all rows are solved from; lengths true."""

    omega: Rows
    free_omega: float
    decay: float
    sigma: Rows
    free: Rows
    lockin: np.ndarray


def speeds(
    curve: TappingCurve, instrument: Instrument, *, origin_nm: float = 0.0, calibration: float = 0.0
) -> TapSpeeds:
    """Return speeds and time of contact of every row.

    Args:
        curve: the curve, heights over the tip's rest position.
        instrument: what turns its readings into motion.
        origin_nm: what is added to every height.
        calibration: true length over the length stated; 0: that of the curve.
    """
    motion = motion_of(curve, instrument)
    scale = calibration or curve.tip_calibration.value
    omega = RAD_PER_US_PER_KHZ * curve.drive_frequency_khz
    own = RAD_PER_US_PER_KHZ * instrument.free_frequency_khz
    decay = own / (2.0 * instrument.quality_factor)
    free = scale * motion.free_amplitude_nm
    lockin = scale * (motion.height + motion.free_amplitude_nm)
    seen = _Seen(omega, own, decay, curve.offset_nm + origin_nm, free, lockin)
    # one brief impact a period: its moment and its impulse from the force's first harmonic
    force = motion.gamma * lockin
    change = own**2 * np.abs(force) * np.pi / omega
    x = np.stack([-np.angle(force), 0.5 * change, np.zeros(curve.rows)])
    # rows that no flight fits run away
    with np.errstate(all="ignore"):
        x, found = _solve(seen, x)
        _, approach, pull = _flight(seen, x)
    good = found & (approach > 0.0) & (x[1] > 0.0)
    columns = (approach, x[1], x[2], pull * x[2] / approach)
    return TapSpeeds(*(np.where(good, column, np.nan) for column in columns))


def _flight(seen: _Seen, x: np.ndarray) -> tuple[np.ndarray, Rows, Rows]:
    """Return what is left of the three equations, the approach speed and the pull of flights.

    Args:
        seen: of the rows.
        x: phase of the sample at departure, rebound speed, time of contact, shape (3, rows).
    """
    phase, rebound, contact = x
    omega, period = seen.omega, 2.0 * np.pi / seen.omega
    ring = np.sqrt(seen.free_omega**2 - seen.decay**2)
    rate = -seen.decay + 1j * ring
    start = seen.sigma + seen.free * np.cos(phase)
    velocity = rebound - seen.free * omega * np.sin(phase)
    flown = period - contact
    # w = Re(c exp(rate t)) = (c exp(rate t) + its conjugate)/2
    c = start - 1j * (velocity + seen.decay * start) / ring
    end, middle = phase + omega * flown, phase + omega * (flown + 0.5 * contact)
    height, speed = np.real(c * np.exp(rate * flown)), np.real(rate * c * np.exp(rate * flown))
    total = (
        0.5
        * np.exp(-1j * phase)
        * (_integral(c, rate - 1j * omega, flown) + _integral(np.conj(c), np.conj(rate) - 1j * omega, flown))
    )
    total += contact * (seen.sigma + seen.free * np.cos(middle)) * np.exp(-1j * middle)
    missing = 2.0 / period * total - seen.lockin
    gap = height - seen.sigma - seen.free * np.cos(end)
    approach = -seen.free * omega * np.sin(end) - speed
    sample, rise = seen.sigma + seen.free * np.cos(middle), -seen.free * omega * np.sin(middle)
    pull = -(seen.free_omega**2) * sample - 2.0 * seen.decay * rise + omega**2 * seen.free * np.cos(middle)
    return np.stack([missing.real, missing.imag, gap]) / seen.free, approach, pull


def _integral(factor: np.ndarray, rate: np.ndarray, until: Rows) -> np.ndarray:
    return factor * (np.exp(rate * until) - 1.0) / rate


def _solve(seen: _Seen, x: np.ndarray) -> tuple[np.ndarray, Bool[np.ndarray, " rows"]]:
    """Return the unknowns by Newton's method, every row with its own length of step, and which rows are solved."""
    left = _flight(seen, x)[0]
    for _ in range(_ROUNDS):
        slopes = np.stack(
            [(_flight(seen, x + _STEP * unit)[0] - left) / _STEP for unit in np.eye(3)[:, :, None]], axis=1
        )
        matrices = np.moveaxis(slopes, 2, 0).copy()
        usable = np.isfinite(matrices).all(axis=(1, 2)) & (np.abs(np.linalg.det(matrices)) > 0.0)
        matrices[~usable] = np.eye(3)
        step = np.linalg.solve(matrices, -left.T[:, :, None])[:, :, 0].T
        share = np.ones(x.shape[1])
        while True:
            trial = x + share * step
            ahead = _flight(seen, trial)[0]
            worse = ~(np.linalg.norm(ahead, axis=0) < np.linalg.norm(left, axis=0)) & (share > _SHORTEST_STEP)
            if not worse.any():
                break
            share = np.where(worse, 0.5 * share, share)
        better = np.linalg.norm(ahead, axis=0) < np.linalg.norm(left, axis=0)
        x, left = np.where(better, trial, x), np.where(better, ahead, left)
        if not (better & (np.linalg.norm(left, axis=0) > _CLOSED)).any():
            break
    period = 2.0 * np.pi / seen.omega
    return x, (np.linalg.norm(left, axis=0) < _CLOSED) & (np.abs(x[2]) < 0.5 * period)
