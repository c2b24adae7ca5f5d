"""What rows count for: which are excluded, how uncertain the picture of impacts is for each, and their covariance.

A law of impacts lacks what slow impacts are: with the capture speed u_c, the length L over which a leaving tip keeps
its energy and s = omega L/w, amplitudes of eight full contacts are off by less than about 0.05 % + 1.2 % s^3 + 1.6 %
(1.5 u_c/u)^6. Peak and lock-in of a row share that error. Rows where it is too large are excluded.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Shaped

from afm_jax.units import RAD_PER_US_PER_KHZ
from fitting.infer.unknowns import Data, Model
from fitting.predict.orbit import READINGS, Orbits

BASE, GROWTH, SLOW = 0.0005, 0.012, 0.016
"""Relative model error of fast impacts, its growth with s^3, and its value at 1.5 times the capture speed."""
TAPPED, IN_FRAME = 0.0012, 1e-4
"""Growth of that of a driven tip, and its error in the frame of the free tip, over the amplitude there."""
LONGEST, NEAREST, CRAWLING = 1.4, 1.35, 2.5
"""s beyond which a row is excluded, and approach over capture speed below which it is; the last for driven tips."""
BY_LEVER = 1.2
"""Pull times Hertz time over the approach speed from which rows of a driven tip are excluded."""
_MOST_LOST, _MOST_IRREGULAR = 0.05, 0.2
"""Share at most of the rows without an orbit that are taken to be slow impacts, or irregular motion of a driven tip."""
SIZE_OF_PHASE = float(np.rad2deg(0.125))
"""Error of the phase in degrees over the relative error of the amplitude: what the tip loses fixes the phase."""
_TOGETHER, _APART = 2.0, 1.0 / 16.0
"""Variance of the mean and of the difference of peak and lock-in of a slow row (times root 2), over that of each."""
TOO_SLOW = "too slow for a law of impacts"
TOO_BENT = "under too strong a pull of the lever (more than 1.2 times what turns the tip round)"
IRREGULAR = "not one a period"
OUTLIER_LEFT_OUT = "outliers"
"""Why rows are excluded."""


class Weights(NamedTuple):
    """What the rows count for.

    Attributes:
        whitening: makes residuals of a row independent and of unit variance; 0 for what does not count.
        used: which readings count.
        model_error: relative error of the amplitude that the picture of impacts has.
        reasons: why rows are excluded; "" for the others.
    """

    whitening: Float[np.ndarray, "rows 3 3"]
    used: Bool[np.ndarray, "rows 3"]
    model_error: Float[np.ndarray, " rows"]
    reasons: Shaped[np.ndarray, " rows"]


def plain_weights(data: Data, extra: float, out: Bool[np.ndarray, " rows"]) -> Weights:
    """Return weights with a relative error of all readings added, in rad of the phase; without a picture's own error.

    Args:
        data: the rows.
        extra: that error: for searches, in which a law is not there yet.
        out: rows that are left out.
    """
    used = data.measured & ~out[:, None]
    size = np.concatenate([np.abs(data.read[:, :2]), np.full((len(used), 1), np.rad2deg(1.0))], axis=1)
    error = np.where(used, np.hypot(data.error, extra * size), np.inf)
    whitening = np.eye(READINGS) / np.where(used, error, np.inf)[:, None]
    return Weights(whitening, used, np.zeros(len(used)), np.where(out, OUTLIER_LEFT_OUT, "").astype(object))


def weights_of(
    model: Model,
    theta: Float[np.ndarray, " k"],
    orbits: Orbits,
    out: Bool[np.ndarray, " rows"],
    kept: Shaped[np.ndarray, " rows"] | None = None,
) -> Weights:
    """Return the rows' weights at a law: measured errors and what slow impacts lack, without excluded rows.

    Args:
        model: what is fitted.
        theta: its unknowns.
        orbits: of the rows there, NaN where there is none.
        out: rows that are left out as outliers.
        kept: why rows are excluded, decided before; None: decided here.
    """
    data, law = model.data, model.of_law(theta)
    capture = model.law.capture(law)
    hertz, length = model.law.coefficients(law)[0][0], model.law.length_nm
    exists = np.isfinite(orbits.x[:, 0])
    approach = np.where(exists, orbits.approach, np.inf)
    rebound = np.where(exists, np.maximum(orbits.rebound, 1e-6), np.inf)
    s = RAD_PER_US_PER_KHZ * data.row.drive_frequency_khz * length / rebound
    slow = (s > LONGEST) | (approach < np.where(data.tapping, CRAWLING, NEAREST) * capture)
    slow = np.where(exists, slow, _lost_slowly(data, exists, CRAWLING * capture))
    reasons = np.where(slow, TOO_SLOW, "").astype(object)
    with np.errstate(invalid="ignore"):
        bent = orbits.pull * hertz * approach**-0.2 > BY_LEVER * approach
    reasons[data.tapping & exists & bent] = TOO_BENT
    reasons[_irregular(data, exists)] = IRREGULAR
    reasons[data.row.free] = ""
    reasons[out] = OUTLIER_LEFT_OUT
    reasons = reasons if kept is None else kept
    # which rows are excluded was decided before the law was: one that is kept may be slower than NEAREST
    near = np.minimum(1.5 * capture / approach, 1.5)
    frame = IN_FRAME * (
        1.0 + data.row.drive_amplitude_nm / np.abs(np.where(data.measured[:, 1], data.read[:, 1], np.inf))
    )
    error = np.where(data.tapping, frame, BASE) + SLOW * near**6
    error += np.where(data.tapping, TAPPED, GROWTH) * np.minimum(s, LONGEST) ** 3
    error = np.where(data.row.free, 0.0, np.where(exists, error, BASE))
    used = data.measured & (reasons == "")[:, None] & exists[:, None]
    return Weights(_whitening(data, used, error), used, error, reasons)


_FEWEST_LEFT, _LEAST_LEFT = 4, 0.2
"""Fewest rows of a driven tip, and their smallest share, from which a law of impacts is read off."""


def few_left(data: Data, weights: Weights) -> bool:
    """Say whether the law has an orbit on fewer than four accurate rows of a driven tip, or on fewer than a fifth."""
    hits = data.tapping & data.measured.any(axis=1) & ~data.row.free
    left = int((hits & weights.used.any(axis=1)).sum())
    return bool(hits.any() and left < max(_FEWEST_LEFT, _LEAST_LEFT * hits.sum()))


def _whitening(
    data: Data, used: Bool[np.ndarray, "rows 3"], model_error: Float[np.ndarray, " rows"]
) -> Float[np.ndarray, "rows 3 3"]:
    """Return the inverse Cholesky factors of the rows' covariances: noise, and what peak and lock-in lack together."""
    size = np.concatenate([np.abs(data.read[:, :2]), np.full((len(used), 1), SIZE_OF_PHASE)], axis=1)
    padding = np.where(used, model_error[:, None] * size, 0.0)
    both = used[:, 0] & used[:, 1]
    shares = np.tile(np.eye(READINGS), (len(used), 1, 1))
    shares[both, :2, :2] = 0.5 * (_TOGETHER + _APART * np.array([[1.0, -1.0], [-1.0, 1.0]]))
    covariance = shares * padding[:, :, None] * padding[:, None, :]
    covariance += np.eye(READINGS) * np.where(used, data.error, 1.0)[:, :, None] ** 2
    whitening = np.linalg.inv(np.linalg.cholesky(covariance))
    return np.where(used[:, :, None] & used[:, None, :], whitening, 0.0)


def _lost_slowly(data: Data, exists: Bool[np.ndarray, " rows"], slowest: float) -> Bool[np.ndarray, " rows"]:
    """Say which measured rows without an orbit have amplitudes of slow impacts; none if there are many of them."""
    # a tip that comes free of the platform reaches about its speed over its angular frequency; the lock-in reads half
    height = np.max(np.where(data.measured, data.read, 0.0)[:, :2] * np.array([1.0, 2.0]), axis=1)
    speed = height * RAD_PER_US_PER_KHZ * data.free_frequency_khz
    measured = data.measured.any(axis=1)
    lost = measured & ~exists & (speed < slowest)
    return lost if lost.sum() <= _MOST_LOST * measured.sum() else np.zeros_like(lost)


def _irregular(data: Data, exists: Bool[np.ndarray, " rows"]) -> Bool[np.ndarray, " rows"]:
    """Say for which measured rows of a driven tip the law has no steady orbit; none if there are many of them."""
    measured = data.measured.any(axis=1) & data.tapping
    lost = measured & ~exists
    return lost if lost.sum() <= _MOST_IRREGULAR * measured.sum() else np.zeros_like(lost)


def remainders_of(model: Model, theta: Float[np.ndarray, " k"], orbits: Orbits) -> Float[np.ndarray, "2 rows 7"]:
    """Return what one standard deviation of each remainder of the corrections does to w^2 and delay of every row."""
    data, exists = model.data, np.isfinite(orbits.x[:, 0]) & ~model.data.row.free
    found = np.zeros((2, len(exists), 7))
    hertz = model.law.coefficients(model.of_law(theta))[0][0]
    for tapping in (False, True):
        some = exists & (data.tapping == tapping)
        if some.any():
            u, w = orbits.approach[some], np.maximum(orbits.rebound[some], 1.0)
            change = _remainders(u, w, orbits.pull[some], orbits.change[some], hertz * u**-0.2, tapping=tapping)
            found[:, some] = change
    return found


_CORRECTIONS = 1.5
"""Standard deviation of a correction's remainder over what was seen."""


def _remainders(
    u: Float[np.ndarray, " rows"],
    w: Float[np.ndarray, " rows"],
    pull: Float[np.ndarray, " rows"],
    change: Float[np.ndarray, " rows"],
    time: Float[np.ndarray, " rows"],
    *,
    tapping: bool,
) -> Float[np.ndarray, "2 rows m"]:
    """Return the leading remainders of the corrections, of the squared rebound speed and of the delay, for each row.

    Args:
        u: approach speed in nm/us.
        w: rebound speed in nm/us.
        pull: acceleration at mid contact in nm/us^2.
        change: its derivative by time in nm/us^3.
        time: Hertz time in us.
        tapping: the cantilever is driven itself.
    """
    # slope in nm/us of the loss u^2 - w^2 over the speed, by regression; 0 where all rows have one speed
    apart = u - u.mean()
    slope = max(float(apart @ (u**2 - w**2)) / max(float(apart @ apart), 1e-9), 0.0)
    nothing = np.zeros_like(u)
    # where the lever's own pull is most of it, it hardly changes during the contact: full contacts say so
    by_square = 0.02 if tapping else 5.0
    late = (0.5 * pull / w**3, 0.008 * pull * time**2 / u, 8.0 * change / w**4)
    gained = (
        15.0 * slope * change / w**2,
        2.0 * slope * pull / u,
        0.06 * change * time**2 * u,
        by_square * pull**2 / w**2,
    )
    columns = [(nothing, one) for one in late] + [(one, nothing) for one in gained]
    return _CORRECTIONS * np.moveaxis(np.array(columns), 0, 2)
