"""Free rows, attractive and repulsive rows, and the heights at which a curve changes between them, out and back.

On approach the bridge forms where the tip's lowest point comes near enough; on retract it may hold longer. And
attractive and repulsive branch coexist over a stretch of heights, so that the jump between them comes at another height
on the way back. Each such pair of heights is a `Hysteresis`.
"""

from dataclasses import dataclass

import numpy as np

from fitting.instruments.lag import turned
from fitting.tapping_curves.curve import Mask, Rows, TappingCurve, TipMotion

_FREE = 4.0
"""Standard errors within which a row counts as free."""
_DRIFT, _DRIFT_DEG = 0.005, 0.3
"""Of the free amplitude, and in degrees: what a free tip may drift beyond its noise."""
_NEIGHBOURS = 20
"""Free rows that the lag of the next is compared with."""
_HELD = 0.1
"""Of the free amplitude: below it the tip is held, not tapping."""
_WINDOW = 0.6
"""Of the free amplitude: down to there the fall of the amplitude is fitted."""
_MOST_ROWS = 60
_STEPS, _MOST_STEPS = 21, 2000
_STEEP = 0.2
"""Of the free amplitude: a fall between two rows that may come anywhere between them."""
_UNIFORM = 12.0**-0.5
"""Standard deviation of what lies anywhere within a unit."""


@dataclass(frozen=True)
class Height:
    """A height in nm and its standard error."""

    offset_nm: float
    standard_error: float


@dataclass(frozen=True)
class Hysteresis:
    """A change that comes at one height as the sample comes nearer and at another as it goes.

    Attributes:
        change: "contact" (the amplitude leaves that of the free tip), "half" (it crosses half of it) or "branch" (from
            the attractive to the repulsive branch).
        drive_frequency_khz: of the rows.
        free_amplitude_nm: of the rows.
        approach: where it comes as the sample comes nearer; None where it does not show.
        retract: where it goes as the sample goes.
    """

    change: str
    drive_frequency_khz: float
    free_amplitude_nm: float
    approach: Height | None
    retract: Height | None

    @property
    def width_nm(self) -> tuple[float, float] | None:
        """By how much it goes later than it came, and the standard error; None where one end does not show."""
        if self.approach is None or self.retract is None:
            return None
        error = float(np.hypot(self.approach.standard_error, self.retract.standard_error))
        return self.approach.offset_nm - self.retract.offset_nm, error


def way_of(retract: bool | np.bool_) -> str:  # noqa: FBT001
    """Return what the way of the sample is called."""
    return "retract" if retract else "approach"


def side_of(repulsive: bool | np.bool_) -> str:  # noqa: FBT001
    """Return what the side of the phase is called."""
    return "repulsive" if repulsive else "attractive"


@dataclass(frozen=True)
class CurveBranch:
    """What tells one branch of a curve from the others.

    Attributes:
        drive_frequency_khz: of the rows.
        free_amplitude_nm: of the rows.
        retract: whether the sample moves away.
        repulsive: whether the lag is below the free tip's.
    """

    drive_frequency_khz: float
    free_amplitude_nm: float
    retract: bool
    repulsive: bool

    @property
    def drive(self) -> tuple[float, float]:
        """Frequency and free amplitude of the rows."""
        return self.drive_frequency_khz, self.free_amplitude_nm

    @property
    def way(self) -> str:
        """Which way the sample moves."""
        return way_of(self.retract)

    @property
    def side(self) -> str:
        """Whether the tip is attracted or repelled."""
        return side_of(self.repulsive)

    @property
    def name(self) -> str:
        """What the branch is called."""
        return f"{self.way}, {self.side}"


def ways(curve: TappingCurve) -> list[np.ndarray]:
    """Return the rows of each drive and way (in, back), numbers in the order of height, the farthest first."""
    keys = np.stack([curve.drive_frequency_khz, curve.free_amplitude_nm, curve.retract])
    order = np.lexsort((curve.offset_nm, *keys[::-1]))
    return np.split(order, np.flatnonzero(np.diff(keys[:, order]).any(axis=0)) + 1) if curve.rows else []


_BOTH_ENDS = 0.6
"""Share of a table between its first and last free row from which a drift along it is known."""
_TIMED_NEIGHBOURS, _TIMED_DRIFT = 5, 0.05
"""Where the order of rows in time is known: free rows that the next is compared with, and how far the amplitude may
have drifted by the first."""


def free_ends(curve: TappingCurve, free: Mask) -> bool:
    """Say whether rows of the free tip stand at both ends of a table."""
    places = np.flatnonzero(free)
    return bool(len(places) > 1 and places[-1] - places[0] >= _BOTH_ENDS * (curve.rows - 1))


def free_rows(curve: TappingCurve) -> Mask:
    """Return the rows of the free tip: those farther away than the first that departs in amplitude or phase.

    A single row that departs is none; the zero of the phase is that of the rows farther away. Each row is tested by its
    own error. `fitting.instruments.branch.look_at` looks for the free part of a recording of unknown noise.
    """
    free = np.zeros(curve.rows, bool)
    for part in ways(curve):
        for place, row in enumerate(part.tolist()):
            following = part[place : place + 2].tolist()
            if all(_departs(curve, other, part[:place][free[part[:place]]]) for other in following):
                break
            free[row] = not _departs(curve, row, part[:place][free[part[:place]]])
        other = np.flatnonzero(free & (curve.drive_frequency_khz == curve.drive_frequency_khz[part[0]]))
        other, own = np.setdiff1d(other, part), part[free[part]]
        off = np.subtract.outer(curve.lag_deg[own], curve.lag_deg[other])
        # a tip that still taps at its farthest row has by chance the free one's amplitude, not its lag
        if np.isfinite(off).any() and abs(np.nanmedian(turned(off))) > _OTHER_MOTION_DEG:
            free[part] = False
    return free


_OTHER_MOTION_DEG = 30.0
"""How far the lag of a way's free rows is from that of the other's if these rows are not free."""


def _departs(curve: TappingCurve, row: int, before: np.ndarray) -> bool:
    """Say whether a row is not free, against those farther away."""
    free, amplitude = curve.free_amplitude_nm[row], curve.amplitude_nm[row]
    error = np.hypot(curve.amplitude_error_nm[row], curve.free_amplitude_error * free)
    before, drift = before[-_NEIGHBOURS:], _DRIFT
    if curve.time is not None:
        before = before[-_TIMED_NEIGHBOURS:]
        free, drift = (np.mean(curve.amplitude_nm[before]), _DRIFT) if len(before) else (free, _TIMED_DRIFT)
    if abs(amplitude - free) > max(_FREE * error, drift * free):
        return True
    lags = curve.lag_deg[before]
    if not np.isfinite(lags).any() or not np.isfinite(curve.lag_deg[row]):
        return False
    spread = curve.lag_error_deg[row] * np.sqrt(1.0 + 1.0 / np.isfinite(lags).sum())
    return bool(abs(curve.lag_deg[row] - np.nanmean(lags)) > max(_FREE * spread, _DRIFT_DEG))


_STEADY = 3.0
"""Errors of its lag from which a row says that it is attractive or repulsive; else it is as its neighbour."""
_JUMP_ERRORS, _JUMP_STEPS = 6.0, 4.0
"""A change of the lag between neighbours is a jump if larger than so many errors and so many of the steps around."""
_AROUND = 4


def repulsive_rows(curve: TappingCurve, touching: Mask, departure: Rows) -> Mask:
    """Return the rows on the repulsive branch: those whose lag is below the free tip's.

    Rows whose lag departs by less than three errors are as their neighbour on the side of the sample.

    Args:
        curve: the curve.
        touching: rows that are neither free nor held.
        departure: lag less that of the free tip, in degrees.
    """
    repulsive = departure < 0.0
    for part in ways(curve):
        rows = part[touching[part]]
        clear = np.abs(departure[rows]) > _STEADY * curve.lag_error_deg[rows]
        clear[-1:] = True
        says = np.flatnonzero(clear)[np.cumsum(clear) - clear]
        repulsive[rows] = repulsive[rows[says]]
    return repulsive


FEWEST_ROWS = 3
"""Of a group or a stretch of rows that gets an energy of its own."""


def smooth_stretches(curve: TappingCurve, touching: Mask, repulsive: Mask) -> list[np.ndarray]:
    """Return the rows of each drive and way, cut where the lag jumps between attraction and repulsion.

    Along each the energy is a smooth function.

    Args:
        curve: the curve, with a phase.
        touching: the rows wanted.
        repulsive: from `repulsive_rows`.
    """
    found = []
    for part in ways(curve):
        rows = part[touching[part]]
        lag, error = curve.lag_deg[rows], curve.lag_error_deg[rows]
        steps = np.abs(np.diff(lag))
        cuts = []
        for i in np.flatnonzero(np.diff(repulsive[rows])).tolist():
            others = np.concatenate([steps[max(i - _AROUND, 0) : i], steps[i + 1 : i + 1 + _AROUND]])
            usual = float(np.median(others)) if len(others) else 0.0
            if steps[i] > max(_JUMP_ERRORS * np.hypot(error[i], error[i + 1]), _JUMP_STEPS * usual):
                cuts.append(i + 1)
        found += [stretch for stretch in np.split(rows, cuts) if len(stretch) >= FEWEST_ROWS]
    return found


def held_rows(curve: TappingCurve) -> Mask:
    """Return the rows in which the sample holds the tip: there is hardly an amplitude left."""
    return curve.amplitude_nm < _HELD * curve.free_amplitude_nm


def changes(curve: TappingCurve, *, free: Mask, repulsive: Mask) -> list[Hysteresis]:
    """Return the changes of each drive, as far as they show on approach or retract.

    Args:
        curve: the curve.
        free: from `free_rows`.
        repulsive: which of the others are on the repulsive branch.
    """
    columns = curve.drive_frequency_khz, curve.free_amplitude_nm, curve.retract
    parts = {tuple(column[part[0]].item() for column in columns): part for part in ways(curve)}
    heights = {
        "contact": lambda part: _contact(curve, part, free),
        "half": lambda part: _half(curve, part),
        "branch": lambda part: _turn(curve, part[~free[part]], repulsive),
    }
    found = []
    for drive in dict.fromkeys(key[:2] for key in parts):
        for change, height in heights.items():
            into, back = (height(parts[*drive, way]) if (*drive, way) in parts else None for way in (False, True))
            if into or back:
                found.append(Hysteresis(change, *drive, approach=into, retract=back))
    return found


def _turn(curve: TappingCurve, touching: np.ndarray, repulsive: Mask) -> Height | None:
    """Return where a way turns repulsive: between the last attractive row in front of the nearest repulsive one."""
    before = np.flatnonzero(~repulsive[touching])
    if not before.size or before[-1] + 1 == len(touching):
        return None
    return _between(*curve.offset_nm[touching[before[-1] : before[-1] + 2]].tolist())


def _half(curve: TappingCurve, part: np.ndarray) -> Height | None:
    """Return where the amplitude crosses half of the free one for good, by the straight line between two rows."""
    above = np.flatnonzero(curve.amplitude_nm[part] >= 0.5 * curve.free_amplitude_nm[part])
    if not above.size or above[-1] + 1 == len(part):
        return None
    rows = part[above[-1] : above[-1] + 2]
    (far, near), (before, after) = curve.offset_nm[rows].tolist(), curve.amplitude_nm[rows].tolist()
    level, slope = curve.free_amplitude_nm[rows[0]], (after - before) / (near - far)
    if before - after > _STEEP * level:
        return _between(far, near)
    at = far + (0.5 * level - before) / slope
    return Height(float(at), float(curve.amplitude_error_nm[rows].max() / abs(slope)))


def _between(low: float, high: float) -> Height:
    return Height(float(0.5 * (low + high)), float(_UNIFORM * abs(high - low)))


def _contact(curve: TappingCurve, part: np.ndarray, free: Mask) -> Height | None:
    """Return where the amplitude leaves that of the free tip: between two rows, or where its fall began."""
    touching = ~free[part]
    first = int(np.argmax(touching))
    if not touching.any() or first == 0:
        return None
    bracket = _between(*curve.offset_nm[part[first - 1 : first + 1]].tolist())
    below = np.flatnonzero(curve.amplitude_nm[part] < _WINDOW * curve.free_amplitude_nm[part])
    until = min(below[0] if below.size else len(part), first + _MOST_ROWS)
    fit = _hinge(curve, part[:until], bracket.offset_nm) if until - first >= 4 else None
    return fit if fit is not None and fit.standard_error < bracket.standard_error else bracket


def _hinge(curve: TappingCurve, rows: np.ndarray, step_nm: float) -> Height | None:
    """Return where a straight fall from the free amplitude began; None where a step explains it better."""
    height, error = curve.offset_nm[rows], curve.amplitude_error_nm[rows]
    target = (curve.amplitude_nm[rows] - curve.free_amplitude_nm[rows]) / error
    grid = np.linspace(height[0], height[-2], min(_STEPS * len(height), _MOST_STEPS))
    fall = np.maximum(height - grid[:, None], 0.0) / error
    # the least squares of the slope, in closed form
    chi2 = target @ target - (fall @ target) ** 2 / np.sum(fall**2, axis=1)
    best = int(np.argmin(chi2))
    step = np.stack([np.maximum(height - step_nm, 0.0), height > step_nm], axis=1) / error[:, None]
    if np.sum((target - step @ np.linalg.lstsq(step, target)[0]) ** 2) < chi2[best] - 2.0 * _FREE:
        return None
    inside = grid[chi2 < chi2[best] + max(1.0, chi2[best] / len(height))]
    return Height(float(grid[best]), float(max(0.5 * (inside[-1] - inside[0]), grid[1] - grid[0])))


_HARDLY = 0.2
"""Of the free amplitude: change of the motion up to which taps need not come every period."""


def hardly_touching_rows(motion: TipMotion) -> Mask:
    """Return rows whose motion is all but that of the free tip: where contact begins, taps may leave periods out."""
    return np.abs(motion.height + motion.free_amplitude_nm) < _HARDLY * motion.free_amplitude_nm
