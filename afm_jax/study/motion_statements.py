"""What the paper says of figures 8, 10 and 11, as numbers worked out from the computed motions."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from afm_jax.study.figure_statements import Statement
from afm_jax.study.section_survey import Course, Growth
from afm_jax.study.slow_ramps import Ramp

BROADBAND_CONTACTS = 400
BROADBAND_NM = (3.0, 110.0)
BAND_NM = 39.0
RISE_NM = (51.0, 150.0)


def section_statements(courses: Sequence[Course], attractor: Course, growth: Growth | None) -> list[Statement]:
    """Figure 8: a long broadband motion without capture, and the band in which it ends.

    Args:
        courses: the motions from all starts.
        attractor: the one whose end is shown.
        growth: of small distances along a broadband motion, where it was computed.
    """
    lengths = {f"{course.velocity_nm_per_us:g}": course.broadband for course in courses}
    longest = max(courses, key=lambda course: course.broadband)
    peaks = longest.motion.peak_height_nm[: longest.broadband]
    peaks = peaks[np.isfinite(peaks)]
    low, high = float(np.min(peaks, initial=np.inf)), float(np.max(peaks, initial=-np.inf))
    captured = [course.velocity_nm_per_us for course in courses if course.motion.captured]
    statements = [
        Statement(
            f"from some starts the motion is broadband, with peaks from {BROADBAND_NM[0]:g} to {BROADBAND_NM[1]:g} nm, "
            f"for at least {BROADBAND_CONTACTS} impacts, and no start ends in capture",
            longest.broadband >= BROADBAND_CONTACTS
            and low <= BROADBAND_NM[0]
            and high >= BROADBAND_NM[1]
            and not captured,
            {
                "start_nm_per_us": longest.velocity_nm_per_us,
                "starts": len(courses),
                "starts_that_are_broadband_so_long": sum(course.broadband >= BROADBAND_CONTACTS for course in courses),
                "peak_height_nm": [low, high],
                "broadband_impacts_from": lengths,
                "captured_from_nm_per_us": captured,
            },
        ),
        _band(attractor),
        _transient(courses),
    ]
    if growth is not None:
        statements.append(_growth(growth))
    return statements


def _band(course: Course) -> Statement:
    end = course.motion.peak_height_nm[course.broadband :]
    end = end[np.isfinite(end)]
    last = end[-min(50, end.size) :]
    near = course.periods is not None and bool(np.all(np.abs(last - BAND_NM) < 2.0))
    numbers: dict[str, Any] = {
        "impacts_before": course.broadband,
        "drive_periods_per_impact": course.periods,
        "last_peak_heights_nm": [float(last.min()), float(last.max())] if last.size else None,
    }
    return Statement(
        f"from {course.velocity_nm_per_us:g} nm/us the motion settles into a band near {BAND_NM:g} nm around a (1,5) "
        "orbit",
        near and course.periods == 5,
        numbers,
    )


def _transient(courses: Sequence[Course]) -> Statement:
    """Say what the broadband motion becomes: the paper calls it a strange attractor."""
    ends = {f"{course.velocity_nm_per_us:g}": course.periods for course in courses}
    locked = [course for course in courses if course.periods is not None]
    lengths = [course.broadband for course in locked]
    # an unlucky start may outlast the simulation: how long one stays broadband is a matter of rounding
    return Statement(
        "the broadband motion is a transient (the paper: an attractor): most starts, or all, lock to the (1,5) orbit",
        len(locked) > 0.5 * len(courses) and all(course.periods == 5 for course in locked),
        {
            "drive_periods_per_impact_at_the_end_from": ends,
            "locked_share": len(locked) / len(courses),
            "broadband_impacts_before": [min(lengths), max(lengths)] if lengths else None,
        },
    )


def _growth(growth: Growth) -> Statement:
    exponent = float(growth.exponent[-1])
    half = float(growth.exponent[growth.exponent.size // 2])
    return Statement(
        "while it lasts, small distances grow from impact to impact: transient chaos",
        exponent > 5.0 * growth.error and abs(half - exponent) < 0.2 * exponent,
        {
            "growth_exponent_per_impact": exponent,
            "standard_error": growth.error,
            "after_half_of_the_impacts": half,
            "impacts": int(growth.contacts[-1]),
        },
    )


def sticking_statements(settled_nm: float, ramps: Sequence[Ramp]) -> list[Statement]:
    """Figure 10: the amplitude falls with the offset, then the tip sticks.

    Args:
        settled_nm: peak height before the ramp.
        ramps: slow ramps.
    """
    falls, sticks = [], []
    numbers: dict[str, Any] = {"settled_peak_nm": settled_nm}
    for ramp in ramps:
        peaks, offset = _peaks(ramp)
        # until the orbit is lost: its last impacts are single ones, with peaks below half of the first
        half = int(np.argmax(peaks < 0.5 * settled_nm)) if np.any(peaks < 0.5 * settled_nm) else peaks.size
        before = np.append(settled_nm, peaks[:half])
        falls.append(half < peaks.size and bool(np.all(np.diff(before) < 1e-3 * settled_nm)))
        held = ramp.motion.held_from_us
        sticks.append(held is not None)
        numbers[f"at_{ramp.rate_nm_per_us:g}_nm_per_us"] = {
            "half_of_the_peak_at_offset_nm": float(offset[half]) if half < peaks.size else None,
            "sticks_at_offset_nm": None if held is None else ramp.offset_at(held),
            "followed_to_offset_nm": ramp.offset_at(ramp.motion.end_us),
            "impacts": int(peaks.size),
        }
    return [
        Statement("the amplitude falls with the offset to less than half", bool(falls) and all(falls), numbers),
        Statement("then the tip sticks, to the end of the ramp", bool(sticks) and all(sticks), numbers),
    ]


def rise_statements(settled_nm: float, ramps: Sequence[Ramp]) -> list[Statement]:
    """Figure 11: the amplitude rises from 51 to 150 nm.

    Args:
        settled_nm: peak height before the ramp.
        ramps: slow ramps, the slowest last.
    """
    slowest = ramps[-1]
    peaks, _ = _peaks(slowest)
    first, last = RISE_NM
    back = float(np.max(np.maximum.accumulate(peaks) - peaks))
    law = slowest.law_peak_nm[np.isfinite(slowest.motion.peak_height_nm)]
    fast = _peaks(ramps[0])[0]
    upper = slice(peaks.size // 2, None)
    distance = float(np.max(np.abs(peaks[upper] / law[upper] - 1.0)))
    return [
        Statement(
            f"the amplitude rises from {first:g} to {last:g} nm, within 2 %",
            bool(abs(settled_nm - first) < 0.02 * first and abs(peaks[-1] - last) < 0.02 * last)
            and back < 0.02 * settled_nm
            and not slowest.motion.captured,
            {
                "peak_nm": [settled_nm, float(peaks[-1])],
                "largest_fall_back_nm": back,
                "rate_nm_per_us": slowest.rate_nm_per_us,
            },
        ),
        Statement(
            "the amplitude follows the orbit of the impact law with delay, and lags behind it the more, the faster the "
            "ramp",
            bool(distance < 0.02 and fast[-1] < peaks[-1]),
            {
                "worst_relative_distance_in_the_upper_half": distance,
                "last_peak_nm_at_rate": {f"{ramp.rate_nm_per_us:g}": float(_peaks(ramp)[0][-1]) for ramp in ramps},
            },
        ),
    ]


def _peaks(ramp: Ramp) -> tuple[np.ndarray, np.ndarray]:
    """Return peak heights and offsets of the flights that were followed to their end."""
    whole = np.isfinite(ramp.motion.peak_height_nm)
    return ramp.motion.peak_height_nm[whole], ramp.offset_nm[whole]
