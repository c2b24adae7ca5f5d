"""The first impact of many flights by dense sampling: slow, simple, and unable to miss a root.

The gap is sampled with its slope 64 times in the shortest period. Between two samples it lies within h^4 max|g''''|/384
of the cubic through them, and the cubic above its smallest Bezier coefficient: an interval where even this bound
stays positive holds no root. Any other interval is cut into 64, three times in all. What is left has a width of 4e-6
of the shortest period, over which the gap is a parabola to rounding: a dip below the platform can be missed only if it
is lost in the rounding of the gap, about `ROUNDING` times the flight's amplitude. Nothing here is
shared with the package.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

SAMPLES_PER_PERIOD = 64
INTERVALS = 64
LEVELS = 3
# flights at once: 65 samples each stay in the cache
BLOCK = 1024
GRAZING_NM = 1e-9
# of the gap, in units of the flight's amplitude
ROUNDING = 2e-15


class Flights(NamedTuple):
    """Flights leaving the platform, one entry a flight, all arrays of shape (flights,).

    No air damping is `quality_factor` = inf.
    """

    frequency_khz: Floats
    quality_factor: Floats
    amplitude_nm: Floats
    drive_frequency_khz: Floats
    offset_nm: Floats
    time_us: Floats
    velocity_nm_per_us: Floats


class FirstImpacts(NamedTuple):
    """What ended the flights, arrays of shape (flights,); NaN where no impact was `found`.

    `near_grazing`: the gap's smallest minimum before the impact, or how deep the tip would pass into the platform,
    u^2/(2 g''), is below 1e-9 nm: whether there is an impact then depends on rounding.
    """

    found: NDArray[np.bool_]
    arrival_time_us: Floats
    flight_time_us: Floats
    velocity_before_nm_per_us: Floats
    near_grazing: NDArray[np.bool_]


class Motion(NamedTuple):
    """Flights as numbers of the formulas, shapes (flights, 1): they meet samples of shape (flights, samples)."""

    free: Floats
    decay: Floats
    ringing: Floats
    drive: Floats
    amplitude: Floats
    phase: Floats  # omega t1
    height: Floats  # z at the start
    speed: Floats
    start_gap: Floats
    size: Floats  # R with |z| <= R exp(-decay s), |z''| <= Omega^2 R, |z''''| <= Omega^4 R

    def rows(self, keep: NDArray[np.bool_] | NDArray[np.intp]) -> "Motion":
        """Return the flights named by a mask or an index."""
        return Motion(*(field[keep] for field in self))

    def derivative_bound(self, order: int) -> Floats:
        """Return a bound on the gap's derivative of this order, shape (flights, 1)."""
        return self.free**order * self.size + self.amplitude * self.drive**order

    def gap(self, s: Floats) -> tuple[Floats, Floats]:
        """Return gap (nm) and slope (nm/us) a time s (us) after the start.

        Written with differences from the start, so that tiny hops keep their digits.
        """
        half_sine = np.sin(0.5 * self.ringing * s)
        half_cosine = np.cos(0.5 * self.ringing * s)
        lost = np.expm1(-self.decay * s)
        sine = 2 * half_sine * half_cosine / self.ringing
        versine = 2 * half_sine**2
        leaning = 1 - versine + self.decay * sine
        rise = (lost * leaning - versine + self.decay * sine) * self.height + (1 + lost) * sine * self.speed
        half = 0.5 * self.drive * s
        drive_sine, drive_cosine = np.sin(half), np.cos(half)
        mid_sine = np.sin(self.phase) * drive_cosine + np.cos(self.phase) * drive_sine
        mid_cosine = np.cos(self.phase) * drive_cosine - np.sin(self.phase) * drive_sine
        gap = self.start_gap + rise + 2 * self.amplitude * mid_sine * drive_sine
        pull = 1 - versine - self.decay * sine
        velocity = (1 + lost) * (pull * self.speed - self.free**2 * sine * self.height)
        platform = -self.amplitude * self.drive * (mid_sine * drive_cosine + mid_cosine * drive_sine)
        return gap, velocity - platform

    def curvature(self, s: Floats) -> Floats:
        """Return the gap's second derivative by a central difference of its slope (for the depth of a dip only)."""
        step = 1e-4 / np.maximum(self.free, self.drive)
        return (self.gap(s + step)[1] - self.gap(s - step)[1]) / (2 * step)


def motion(flights: Flights, position_nm: Floats | None = None) -> Motion:
    """Return flights as the formulas need them; they start on the platform unless a position is given."""
    free = 2e-3 * np.pi * flights.frequency_khz
    drive = 2e-3 * np.pi * flights.drive_frequency_khz
    decay = 0.5 * free / flights.quality_factor
    ringing = np.sqrt((free - decay) * (free + decay))
    phase = drive * flights.time_us
    on_platform = flights.offset_nm + flights.amplitude_nm * np.cos(phase)
    height = on_platform if position_nm is None else position_nm
    size = np.hypot(height, (flights.velocity_nm_per_us + decay * height) / ringing)
    fields = (free, decay, ringing, drive, flights.amplitude_nm, phase, height, flights.velocity_nm_per_us)
    return Motion(*(np.asarray(field, np.float64)[:, None] for field in (*fields, height - on_platform, size)))


def first_suspect(moving: Motion, left: Floats, step: Floats) -> NDArray[np.intp]:
    """Return the first of 64 intervals that may hold a root or a minimum below 1e-9 nm; 64 if none does."""
    gap, slope = moving.gap(left + step * np.arange(INTERVALS + 1))
    reach = step * slope / 3
    lowest = np.minimum(gap[:, :-1], gap[:, 1:])
    lowest = np.minimum(lowest, np.minimum(gap[:, :-1] + reach[:, :-1], gap[:, 1:] - reach[:, 1:]))
    uncertain = moving.derivative_bound(4) * step**4 / 384 + ROUNDING * moving.derivative_bound(0)
    turning = (slope[:, :-1] < 0) & (slope[:, 1:] > 0)
    suspect = lowest <= uncertain + np.where(turning, GRAZING_NM, 0.0)
    return np.where(suspect.any(axis=1), suspect.argmax(axis=1), INTERVALS)


def lowest_point(moving: Motion, left: Floats, right: Floats) -> tuple[Floats, Floats]:
    """Return place and value of the gap's minimum in intervals whose slope goes from negative to positive.

    Bisection of the slope; elsewhere the minimum is an end and the right end is returned.
    """
    low, high = left.copy(), right.copy()
    for _ in range(40):
        middle = 0.5 * (low + high)
        falling = moving.gap(middle)[1] < 0
        low, high = np.where(falling, middle, low), np.where(falling, high, middle)
    inside = (moving.gap(left)[1] < 0) & (moving.gap(right)[1] > 0)
    place = np.where(inside, high, right)
    return place, np.where(inside, moving.gap(place)[0], np.inf)


def bisect(moving: Motion, above: Floats, below: Floats) -> Floats:
    """Return the root between times where the gap is positive and negative, to the last bit of the time."""
    for _ in range(60):
        middle = 0.5 * (above + below)
        positive = moving.gap(middle)[0] > 0
        above, below = np.where(positive, middle, above), np.where(positive, below, middle)
    return 0.5 * (above + below)


def narrow(moving: Motion, left: Floats, base: Floats) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Cut the first suspect interval of the next 64 down to its smallest size.

    Returns left and right end (flights, 1) of what is still suspect and a mask of these flights; for the others the
    right end says up to where there is certainly no impact.
    """
    left, right = left.copy(), left + INTERVALS * base
    suspect = np.arange(len(left))
    for level in range(LEVELS + 1):
        step = base[suspect] / INTERVALS**level
        place = first_suspect(moving.rows(suspect), left[suspect], step)
        clear = place == INTERVALS
        right[suspect[clear]] = left[suspect[clear]] + INTERVALS * step[clear]
        suspect, step, place = suspect[~clear], step[~clear], place[~clear]
        left[suspect] += place[:, None] * step
        right[suspect] = left[suspect] + step
    mask = np.zeros(len(left), np.bool_)
    mask[suspect] = True
    return left, right, mask


def march(moving: Motion, duration: Floats) -> tuple[Floats, Floats]:
    """Return time of the first root (NaN: none) and smallest minimum before it, shapes (flights, 1)."""
    root = np.full_like(moving.height, np.nan)
    closest = np.full_like(moving.height, np.inf)
    base = 2 * np.pi / np.maximum(moving.free, moving.drive) / SAMPLES_PER_PERIOD
    # Until g'/max|g''| the gap is at least g'^2/(2 max|g''|) > 0: the root at the start itself is left behind.
    start_slope = moving.gap(np.zeros_like(base))[1]
    time = np.where(moving.start_gap > 0, 0.0, np.minimum(start_slope / moving.derivative_bound(2), base))
    active = np.arange(len(time))
    while len(active):
        left, right, suspect = narrow(moving.rows(active), time[active], base[active])
        time[active] = right
        rows, left, right = active[suspect], left[suspect], right[suspect]
        some = moving.rows(rows)
        place, lowest = lowest_point(some, left, right)
        below = np.where(lowest < 0, place, right)
        strikes = some.gap(below)[0][:, 0] < 0
        root[rows[strikes]] = bisect(some.rows(strikes), left[strikes], below[strikes])
        closest[rows[~strikes]] = np.minimum(closest[rows[~strikes]], lowest[~strikes])
        active = active[(np.isnan(root[active]) & (time[active] < duration[active]))[:, 0]]
    return np.where(root <= duration, root, np.nan), closest


def first_impact(flights: Flights, *, duration_us: float, position_nm: Floats | None = None) -> FirstImpacts:
    """Return the first impact of each flight within a duration.

    Args:
        flights: shape (flights,); each leaves the platform, or starts above it at `position_nm`.
        duration_us: how long a flight is followed.
        position_nm: height of the tip at the start, shape (flights,); None: on the platform.
    """
    blocks = []
    for first in range(0, len(flights.time_us), BLOCK):
        some = slice(first, first + BLOCK)
        moving = motion(
            Flights(*(field[some] for field in flights)), None if position_nm is None else position_nm[some]
        )
        slope = moving.gap(np.zeros_like(moving.height))[1]
        assert ((moving.start_gap > 0) | ((moving.start_gap == 0) & (slope > 0))).all(), (
            "a flight does not leave the platform"
        )
        blocks.append(np.concatenate(_impacts(moving, duration_us), axis=1))
    flight, before, closest, depth = np.concatenate(blocks).T
    near = np.minimum(closest, np.where(np.isnan(depth), np.inf, depth)) < GRAZING_NM
    return FirstImpacts(~np.isnan(flight), flights.time_us + flight, flight, before, near)


def _impacts(moving: Motion, duration_us: float) -> tuple[Floats, Floats, Floats, Floats]:
    """Return flight time, velocity before, closest gap and dip depth (inf: it does not turn), shapes (flights, 1)."""
    # A damped tip stops reaching the platform once its envelope lies above the platform's top.
    top = moving.height - moving.start_gap + moving.amplitude * (1 - np.cos(moving.phase))
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = np.log(moving.size / -top) / moving.decay
    duration = np.where((moving.decay > 0) & (top < 0), np.fmin(reach, duration_us), duration_us)
    flight, closest = march(moving, duration)
    slope = moving.gap(flight)[1]
    curvature = moving.curvature(flight)
    before = slope - moving.amplitude * moving.drive * np.sin(moving.phase + moving.drive * flight)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.where(curvature > 0, slope**2 / (2 * curvature), np.inf)
    return flight, before, closest, np.where(np.isnan(flight), np.nan, depth)
