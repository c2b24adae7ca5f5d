"""How fast the tip meets the sample: approach speed, rebound speed and time of contact of a row, without any law.

Seen with the free motion taken away, w = z + A0 cos(omega t), the tip flies freely and the sample moves as
sigma + A0 cos(omega t). A flight that starts on the sample at t_out with the relative speed u_out and meets it again
at t_out + T - tau has three unknowns and three conditions: the lock-in's complex W = Z + A0, and the sample's height at
its end. The spring constant does not enter.

`fitting.inversion.flight` finds such flights over a sample that moves by least squares, from the peak too, and takes
back what a Hertz contact does to tip and readings. Here the tip counts as resting on the sample during the contact.
"""

from typing import NamedTuple

import numpy as np

from afm_jax.solve.newton import LinearisedRows, Newton, newton_rows
from afm_jax.units import RAD_PER_US_PER_KHZ
from fitting.tapping_curves.curve import Instrument, Rows, TappingCurve, motion_of

_STEP = 1e-5
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


class _Seen(NamedTuple):
    """What the flights of all rows are solved from; lengths true."""

    omega: Rows
    free_omega: float
    decay: float
    sigma: Rows
    free: Rows
    lockin: np.ndarray

    def of(self, rows: np.ndarray) -> "_Seen":
        """Return what the flights of some rows are solved from."""
        omega, sigma, free, lockin = (part[rows] for part in (self.omega, self.sigma, self.free, self.lockin))
        return _Seen(omega, self.free_omega, self.decay, sigma, free, lockin)


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
    unit = np.stack([np.ones(curve.rows), free * omega, 1.0 / omega])

    def linearised(unknowns: np.ndarray, rows: np.ndarray) -> LinearisedRows:
        here, steps = seen.of(rows), _STEP * np.eye(3)[:, :, None]
        at = unknowns.T * unit[:, rows]
        left = [_flight(here, at + way * step * unit[:, rows]).left for step in steps for way in (1.0, -1.0)]
        slopes = np.stack([(left[2 * i] - left[2 * i + 1]).T / (2.0 * _STEP) for i in range(3)], axis=2)
        return LinearisedRows(_flight(here, at).left.T, slopes)

    # rows that no flight fits run away
    with np.errstate(all="ignore"):
        roots = newton_rows(linearised, (x / unit).T, _CLOSING)
        x = roots.x.T * unit
        found = roots.converged & (np.abs(x[2]) < np.pi / omega)
        at = _flight(seen, x)
    good = found & (at.approach > 0.0) & (x[1] > 0.0)
    columns = (at.approach, x[1], x[2], at.pull * x[2] / at.approach)
    return TapSpeeds(*(np.where(good, column, np.nan) for column in columns))


class _Flight(NamedTuple):
    """Flights of all rows at trial values of their unknowns.

    Attributes:
        left: of the three equations, over the free amplitude, shape (3, rows).
        approach: relative speed at the end.
        pull: of lever and drive during the contact.
    """

    left: np.ndarray
    approach: Rows
    pull: Rows


def _flight(seen: _Seen, x: np.ndarray) -> _Flight:
    """Return the tip's flights between taps.

    Args:
        seen: of the rows.
        x: phase of the sample at departure, rebound speed, time of contact, shape (3, rows).
    """
    phase, rebound, contact = x
    omega, period = seen.omega, 2.0 * np.pi / seen.omega
    ring = np.sqrt(seen.free_omega**2 - seen.decay**2)
    rate = -seen.decay + 1j * ring
    flown = period - contact
    # the sample's motion at departure, in the middle of the contact and at the end of the flight
    leaving, resting = np.exp(1j * phase), np.exp(1j * (phase - 0.5 * omega * contact))
    ending = np.exp(1j * (phase - omega * contact))
    start = seen.sigma + seen.free * leaving.real
    velocity = rebound - seen.free * omega * leaving.imag
    # w = Re(c exp(rate t)) = (c exp(rate t) + its conjugate)/2
    c = start - 1j * (velocity + seen.decay * start) / ring
    grown, back = np.exp(rate * flown), np.exp(-1j * omega * flown)
    up, down = (grown * back - 1.0) / (rate - 1j * omega), (grown.conj() * back - 1.0) / (rate.conjugate() - 1j * omega)
    height, speed = np.real(c * grown), np.real(rate * c * grown)
    sample, rise = seen.sigma + seen.free * resting.real, -seen.free * omega * resting.imag
    of_flight = 0.5 * leaving.conj() * (c * up + np.conj(c) * down)
    missing = 2.0 / period * (of_flight + contact * sample * resting.conj()) - seen.lockin
    gap = height - seen.sigma - seen.free * ending.real
    approach = -seen.free * omega * ending.imag - speed
    pull = -(seen.free_omega**2) * sample - 2.0 * seen.decay * rise + omega**2 * seen.free * resting.real
    left = np.stack([missing.real, missing.imag, gap]) / seen.free
    return _Flight(left, approach, pull)
