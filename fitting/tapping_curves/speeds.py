"""How fast the tip meets the sample: approach speed, rebound speed and time of contact of a row, without any law.

Seen with the free motion taken away, w = z + A0 cos(omega t), the tip flies freely and the sample moves as
sigma + A0 cos(omega t). A flight that starts on the sample at t_out with the relative speed u_out and meets it again
at t_out + T - tau has three unknowns and three conditions: the lock-in's complex W = Z + A0, and the sample's height at
its end. The spring constant does not enter.

`fitting.inversion.flight` finds such flights over a sample that moves by least squares, from the peak too, and takes
back what a Hertz contact does to tip and readings. Here the tip counts as resting on the sample during the contact.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from afm_jax.solve.newton_rows import LinearisedRows, Newton, newton_rows
from afm_jax.units import RAD_PER_US_PER_KHZ, effective_mass_ng
from fitting.tapping_curves.along import EnergyFunctions
from fitting.tapping_curves.curve import Given, Instrument, Mask, Rows, TappingCurve, motion_of

_STEPS = 1e-5 * np.eye(3)[:, :, None]
"""Of differences by the unknowns, in units of their own."""
_CLOSING = Newton(rounds=120, residual_tolerance=5e-10)
"""Of the free amplitude, each of three equations: 1e-9 together."""


@dataclass(frozen=True, kw_only=True)
class MeasuredSpeeds:
    """Speeds of the impacts; NaN where they are not known to a quarter.

    Attributes:
        approach_speed_nm_per_us: u_in > 0.
        rebound_speed_nm_per_us: u_out > 0.
        contact_us: tau, from where the flight meets the sample to where it leaves it.
        pull: g tau/u_in, the speed that lever and drive give the tip during contact, of its own.
        approach_speed_error_nm_per_us: from noise, calibration and the origin of the heights.
        in_capture_speeds: u_in in units of sqrt(2 E/m).
        fast: rows whose impact a law describes.
        why_not: why there are too few of them for a law, and what to record instead.
    """

    approach_speed_nm_per_us: Rows
    rebound_speed_nm_per_us: Rows
    contact_us: Rows
    pull: Rows
    approach_speed_error_nm_per_us: Rows
    in_capture_speeds: Rows
    fast: Mask
    why_not: str


_FEWEST_FOR_LAW = 6
"""Rows with a fast impact: the law has two parameters, its delay three."""
_SLOWEST = 2.5
"""In capture speeds."""
_PULLED = 0.8
"""Largest share of its speed that lever and drive may give the tip during an impact."""
_VAGUE = 0.25
"""Relative error from which a speed counts as not measured."""


def speeds(functions: EnergyFunctions, used: Mask) -> MeasuredSpeeds:
    """Return the impact speeds of some rows, with their errors from noise, calibration and origin of height.

    Args:
        functions: energies along the branches of the curve.
        used: the rows.
    """
    curve, instrument = functions.lever.curves[functions.number], functions.instrument
    start = u, _, _, pull = flights(curve, instrument)
    moved = [
        replace(curve, amplitude_nm=curve.amplitude_nm + curve.amplitude_error_nm),
        replace(curve, lag_deg=curve.lag_deg + curve.lag_error_deg),
        replace(curve, offset_nm=curve.offset_nm + curve.origin_error_nm),
        replace(curve, tip_calibration=Given(sum(curve.tip_calibration))),
    ]
    changes = np.stack([flights(other, instrument)[0] - u for other in moved])
    # a flight that a standard error undoes is no measurement
    error = np.linalg.norm(np.where(np.isfinite(changes), changes, np.inf), axis=0)
    known = used & np.isfinite(u) & (error < _VAGUE * u)
    energy, ratio = np.zeros(curve.rows), curve.amplitude_nm / curve.free_amplitude_nm
    for branch in functions.branches:
        along = branch.curve
        energy[branch.rows] = np.interp(ratio[branch.rows], along.amplitude_ratio, along.estimate_aj)
    mass = effective_mass_ng(curve.spring_constant_n_per_m.value, curve.free_frequency_khz.value)
    capture = np.sqrt(2.0 * np.maximum(energy, 0.0) / mass)
    in_capture = np.divide(u, capture, out=np.full(curve.rows, np.nan), where=known & (capture > 0.0))
    fast = known & (in_capture >= _SLOWEST) & (np.abs(pull) < _PULLED)
    blank = np.where(known, 1.0, np.nan)
    return MeasuredSpeeds(
        **dict(zip(_COLUMNS, blank * start, strict=True)),
        approach_speed_error_nm_per_us=error * blank,
        in_capture_speeds=in_capture,
        fast=fast,
        why_not=_why_not(curve, fast, known, in_capture),
    )


def _why_not(curve: TappingCurve, fast: np.ndarray, known: np.ndarray, in_capture: np.ndarray) -> str:
    """Return why the rows do not allow a law, and what to record instead; empty where they do."""
    if fast.sum() >= _FEWEST_FOR_LAW:
        return ""
    f0 = curve.free_frequency_khz.value
    s = curve.drive_frequency_khz / f0
    largest = np.max(in_capture, where=np.isfinite(in_capture), initial=0.0)
    where = f"{s.min():.3f}" if np.ptp(s) < 5e-4 else f"{s.min():.3f} to {s.max():.3f}"
    what = f"only {int(fast.sum())} rows have fast and brief impacts of known speed, and a law needs {_FEWEST_FOR_LAW}"
    if not known.any():
        what = (
            "the speed of its impacts cannot be determined from this curve: it depends on the origin of heights and "
            "on the calibration more finely than these are known"
        )
    elif 0.0 < largest < _SLOWEST:
        what = f"its impacts are slow, {largest:.2g} times the capture speed at most"
    advice = f"drive 3 to 10 % above resonance ({1.03 * f0:.4g} to {1.1 * f0:.4g} kHz)"
    return f"driven at {where} of the free frequency, {what}; to get the impact law, {advice}"


_COLUMNS = ("approach_speed_nm_per_us", "rebound_speed_nm_per_us", "contact_us", "pull")


def flights(curve: TappingCurve, instrument: Instrument) -> Float[np.ndarray, "4 rows"]:
    """Return approach speed, rebound speed, time of contact and pull of every row, NaN where no flight fits.

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
        columns = np.stack([approach, x[1], x[2], pull * x[2] / approach])
    return np.where(found & (approach > 0.0) & (x[1] > 0.0), columns, np.nan)
