"""How fast the tip meets the sample: approach speed, rebound speed and time of contact of a row, without any law.

Seen with the free motion taken away, w = z + A0 cos(omega t), the tip flies freely and the sample moves as
sigma + A0 cos(omega t). A flight that starts on the sample at t_out with the relative speed u_out and meets it again
at t_out + T - tau has three unknowns and three conditions: the lock-in's complex W = Z + A0, and the sample's height at
its end. The spring constant does not enter.

`fitting.inversion.flight` finds such flights over a sample that moves by least squares, from the peak too, and takes
back what a Hertz contact does to tip and readings. Here the tip counts as resting on the sample during the contact.
"""

from typing import Any, NamedTuple

import numpy as np

from afm_jax.solve.newton import LinearisedRows, Newton, newton_rows
from afm_jax.units import RAD_PER_US_PER_KHZ
from fitting.tapping_curves.curve import Instrument, Rows, TappingCurve, motion_of

_STEPS = 1e-5 * np.eye(3)[:, :, None]
"""Of differences by the unknowns, in units of their own."""
_CLOSING = Newton(rounds=120, residual_tolerance=5e-10, halvings=6)
"""Of the free amplitude, each of three equations: 1e-9 together."""


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


def speeds(curve: TappingCurve, instrument: Instrument) -> TapSpeeds:
    """Return speeds and time of contact of every row.

    Args:
        curve: the curve, heights over the tip's rest position.
        instrument: what turns its readings into motion.
    """
    motion, scale = motion_of(curve, instrument), curve.tip_calibration.value
    omega = RAD_PER_US_PER_KHZ * curve.drive_frequency_khz
    own = RAD_PER_US_PER_KHZ * instrument.free_frequency_khz
    decay = own / (2.0 * instrument.quality_factor)
    ring = np.sqrt(own**2 - decay**2)
    free = scale * motion.free_amplitude_nm
    lockin = scale * (motion.height + motion.free_amplitude_nm)

    def flight(x: np.ndarray, rows: Any = slice(None)) -> tuple[np.ndarray, Rows, Rows]:
        """Return of some rows the three equations over the free amplitude, approach speed and pull during the contact.

        Args:
            x: phase of the sample at departure, rebound speed, time of contact, shape (3, rows).
            rows: their numbers.
        """
        phase, rebound, contact = x
        drive, sigma, level = omega[rows], curve.offset_nm[rows], free[rows]
        period, rate = 2.0 * np.pi / drive, -decay + 1j * ring
        flown = period - contact
        # the sample's motion at departure, in the middle of the contact and at the end of the flight
        leaving, resting = np.exp(1j * phase), np.exp(1j * (phase - 0.5 * drive * contact))
        ending = np.exp(1j * (phase - drive * contact))
        start = sigma + level * leaving.real
        velocity = rebound - level * drive * leaving.imag
        # w = Re(c exp(rate t)) = (c exp(rate t) + its conjugate)/2
        c = start - 1j * (velocity + decay * start) / ring
        grown, back = np.exp(rate * flown), np.exp(-1j * drive * flown)
        up = (grown * back - 1.0) / (rate - 1j * drive)
        down = (grown.conj() * back - 1.0) / (rate.conjugate() - 1j * drive)
        height, speed = np.real(c * grown), np.real(rate * c * grown)
        sample, rise = sigma + level * resting.real, -level * drive * resting.imag
        of_flight = 0.5 * leaving.conj() * (c * up + np.conj(c) * down)
        missing = 2.0 / period * (of_flight + contact * sample * resting.conj()) - lockin[rows]
        gap = height - sigma - level * ending.real
        pull = -(own**2) * sample - 2.0 * decay * rise + drive**2 * level * resting.real
        return np.stack([missing.real, missing.imag, gap]) / level, -level * drive * ending.imag - speed, pull

    # one brief impact a period: its moment and its impulse from the force's first harmonic
    force = motion.gamma * lockin
    change = own**2 * np.abs(force) * np.pi / omega
    x = np.stack([-np.angle(force), 0.5 * change, np.zeros(curve.rows)])
    unit = np.stack([np.ones(curve.rows), free * omega, 1.0 / omega])

    def linearised(unknowns: np.ndarray, rows: np.ndarray) -> LinearisedRows:
        def left(x: np.ndarray) -> np.ndarray:
            return flight(x * unit[:, rows], rows)[0].T

        at = unknowns.T
        slopes = [(left(at + step) - left(at - step)) / (2.0 * _STEPS.max()) for step in _STEPS]
        return LinearisedRows(left(at), np.stack(slopes, axis=2))

    # rows that no flight fits run away
    with np.errstate(all="ignore"):
        roots = newton_rows(linearised, (x / unit).T, _CLOSING)
        x = roots.x.T * unit
        found = roots.converged & (np.abs(x[2]) < np.pi / omega)
        _, approach, pull = flight(x)
    good = found & (approach > 0.0) & (x[1] > 0.0)
    columns = (approach, x[1], x[2], pull * x[2] / approach)
    return TapSpeeds(*(np.where(good, column, np.nan) for column in columns))
