"""From amplitudes and phase of single-impact orbits to their impacts: no law needed.

Orbits are those of the fits' program (`fitting.predict.orbit`), over the table of an impact that loses nothing and
takes no time. What an impact really does to the squared rebound speed and to the delay is free for every row: with
coordinate, phase of arrival and delay these are five unknowns for the three gaps of an orbit and up to three readings
(peak and lock-in amplitude, phase), found by least squares. Air, spring and the platform's motion act as during a Hertz
contact that is as long as the delay, since no law separates lead and offset.
"""

import numpy as np
from jaxtyping import Float

from afm_jax.impact.law_table import EXCESS, KNOTS, coordinate_of, table_of
from afm_jax.units import RAD_PER_US_PER_KHZ
from fitting.predict.orbit import Row, evaluated

_NOTHING = table_of(0.0, EXCESS**2, np.zeros(KNOTS), np.zeros(4))
_STEPS, _ARRIVED = 40, 1e-9
"""Steps of Gauss and Newton, and the last one of a row that has arrived, in their units."""


def invert_rows(
    row: Row,
    instrument: Float[np.ndarray, "rows quantities"],
    read: Float[np.ndarray, "rows 3"],
    error: Float[np.ndarray, "rows 3"],
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the impacts of rows with a phase and at least one amplitude, NaN where there is no such orbit.

    Args:
        row: the drives.
        instrument: the last columns of `Local`.
        read: peak and lock-in amplitude in nm, phase in degrees.
        error: their standard errors, infinite where nothing was measured.

    Returns:
        Approach speed, rebound speed and delay of every row; how they change with independent errors of the readings,
        of unit variance; how with each column of the instrument; and chi2, 0 where only two numbers were read.
    """
    # half sines z = a |sin(nu (t - t_out)/2)| have the phase nu t_out + phi = pi, and the lock-in amplitude 4 a/(3 pi)
    height = np.where(np.isfinite(error[:, 0]), read[:, 0], 0.75 * np.pi * read[:, 1])
    speed = RAD_PER_US_PER_KHZ * instrument[:, 0] * height
    period = 1e3 * row.order / row.drive_frequency_khz
    zero, u = np.zeros_like(speed), speed
    # coordinate, phase of arrival and delay; what the impact does to the squared speed, and to the delay
    place = np.stack([coordinate_of(u, 0.0), row.order * (np.pi - np.deg2rad(read[:, 2])), zero, zero, zero], axis=1)
    unit = np.stack([zero + 1.0, zero + 0.3, 0.02 * period, 0.1 * u**2, 0.02 * period], axis=1)
    steps = 0
    while True:
        steps += 1
        hertz = u**0.2
        local = np.column_stack([place[:, 3:], place[:, 4] * hertz, zero, zero, zero, instrument])
        slopes, found, _ = evaluated(place[:, :3], local, row, _NOTHING, "sample")
        slopes[:, :, 4] += slopes[:, :, 5] * hertz[:, None]
        lost = ~np.isfinite(slopes).all(axis=(1, 2))
        slopes[lost], found[lost] = 0.0, 0.0
        slopes[:, 3:6], off, u = slopes[:, 3:6] / error[:, :, None], (found[:, 3:6] - read) / error, found[:, 6]
        gaps, readings = (slopes[:, part, :5] * unit[:, None] for part in (slice(3), slice(3, 6)))
        # orbits stay closed; along what is free then chi2 becomes smallest
        closing, free = np.linalg.pinv(gaps), np.swapaxes(np.linalg.svd(gaps)[2][:, 3:], 1, 2)
        best = -free @ np.linalg.pinv(readings @ free)
        step = (best @ off[:, :, None] - (closing + best @ readings @ closing) @ found[:, :3, None])[..., 0]
        longest = np.max(np.abs(step), axis=1)
        place = place + unit * step / np.maximum(longest, 1.0)[:, None]
        place[:, 0] = np.clip(place[:, 0], 1e-4, KNOTS - 1.01)
        if steps == _STEPS or (lost | (longest < _ARRIVED)).all():
            break
    w = np.sqrt(np.maximum(u**2 + place[:, 3], 1e-4))
    # approach speed, rebound speed and delay by the place
    change = np.zeros((len(u), 3, 5))
    change[:, 0, 0], change[:, 1, 3], change[:, 2, 4] = slopes[:, 6, 0], 0.5 / w, 1.0
    change[:, 1, 0] = u / w * slopes[:, 6, 0]
    change *= unit[:, None]
    shared = best @ slopes[:, 3:6, 9:] - (closing + best @ readings @ closing) @ slopes[:, :3, 9:]
    impact = np.stack([u, w, place[:, 4]], axis=1)
    impact[lost | (longest >= _ARRIVED) | (u**2 + place[:, 3] <= 0.0)] = np.nan
    # what changes is NaN where the impact is
    change = np.where(np.isfinite(impact)[:, :, None], change, np.nan)
    return impact, change @ best, change @ shared, np.sum(off**2, axis=1)
