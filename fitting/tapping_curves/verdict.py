"""What makes the energy of a tap no measurement, what a reader should know besides, and what is taken for granted.

The rules look at a `Tapping`. Its energy is given in two ways, as one number for each branch and as a function along
it; `NO_CONSTANT` and `NO_FUNCTIONS` say why one of them is not given, `REASONS` why neither is.
"""

from typing import Any

import numpy as np
from jaxtyping import Bool

from afm_jax.least_squares import IMPROBABLE, LARGEST_SCALE, PULLED, TORN
from afm_jax.outcomes import Rule, Rules
from afm_jax.words import interval
from fitting.instruments.lag import turned
from fitting.parameters import USUAL_DRIFTS, USUAL_ERRORS
from fitting.tapping_curves.branches import FEWEST_ROWS, free_ends, ways
from fitting.tapping_curves.curve import TappingCurve, lag_of_free_tip
from fitting.tapping_curves.energy import (
    FEWEST_FREE_ROWS,
    EnergyFunctions,
    Nuisance,
    OneEnergy,
    what_narrows,
)

_LARGEST_UNASKED_SCALE = 2.0
"""Scatter of rows in contact, of their errors, that is believed without `scale_errors`: measured curves have up to 1.8
times that of the free tip."""
_DRIFTING = 5.0
"""Errors of a drift of the free rows from which it is one."""
_FOLLOWING = 3.0
"""Errors of a drift along the rows, of one energy for all taps, from which it is one."""
_SAY_SO = "if they stand as they were measured, say so by '# rows = in order of time', and the drift is fitted along"
ORIGINS = {
    "free_frequency_khz": "free frequency",
    "quality_factor": "Q",
    "spring_constant_n_per_m": "spring constant",
    "tip_calibration": "calibration",
    "phase_zero_deg": "zero of phase",
    "free_amplitude": "free amplitude",
    "harmonics_factor": "harmonics",
    "phase_drift_deg": "drift of the phase",
    "free_amplitude_drift": "drift of the free amplitude",
}
"""What an error comes from, in words."""


def _torn(fit: EnergyFunctions | OneEnergy) -> list[str]:
    """Return which nuisances had to go too far, in words."""
    torn = [n for n in fit.nuisances if abs(n.pull) > TORN]
    parts = [f"{ORIGINS[n.kind]} {n.pull:+.1f} of its errors from what was given" for n in torn]
    return [f"{' and '.join(parts)} would be needed"] if parts else []


def _followed(e: Any) -> list[str]:
    """Return by what drift rows about one energy follow their order, which the table does not state as that in time."""
    if e.followed is None or not e.followed.minimum.p_value > IMPROBABLE:
        return []
    units = {"phase_drift_deg": (1.0, "degrees"), "free_amplitude_drift": (100.0, "%")}

    def said(one: Nuisance) -> str:
        factor, unit = units[one.kind]
        return f"{ORIGINS[one.kind]} of {factor * one.value:+.2g} +- {factor * one.standard_error:.1g} {unit}"

    drifts = (one for one in e.followed.nuisances if one.kind in units)
    return [said(one) for one in drifts if abs(one.value) > _FOLLOWING * one.standard_error][:1]


NO_CONSTANT: tuple[Rule[Any], ...] = (
    Rule(lambda e: e.fit is None, "no branch has enough rows of taps that come every period for one energy"),
    Rule(lambda e: not e.fit.minimum.settled, "the search for one energy a branch does not settle"),
    Rule(
        lambda e: e.fit.scale == 1.0 and e.fit.minimum.p_value < IMPROBABLE,
        "one energy a branch does not describe the rows (chi2 {e.fit.minimum.chi2:.0f} for "
        "{e.fit.minimum.degrees_of_freedom} degrees of freedom, probability {e.fit.minimum.p_value:.1g})",
    ),
    Rule(
        lambda e: e.fit.scale > LARGEST_SCALE,
        "one energy a branch describes the rows only with errors {e.fit.scale:.1f} times as large",
    ),
    Rule(lambda e: _torn(e.fit), "for one energy a branch {case}"),
    Rule(
        _followed,
        f"the rows follow their order in the table about one energy, as a {{case}} would make them: {_SAY_SO}",
    ),
)
"""Why one energy a branch does not explain the rows; the first that applies."""


def drift_of_free_rows(curve: TappingCurve, free: Bool[np.ndarray, " rows"]) -> list[str]:
    """Return by what the free tip drifted along rows whose order in time the table does not state, in words."""
    places = np.flatnonzero(free)
    if curve.time is not None or len(places) < 2 * FEWEST_ROWS or not free_ends(curve, free):
        return []
    if np.diff(places).max() <= FEWEST_ROWS:
        # one way only: along it the free tip may feel the sample
        return []
    share = 100.0 / curve.free_amplitude_nm
    columns = {
        "phase": (curve.lag_deg, curve.lag_error_deg, "degrees"),
        "amplitude": (share * curve.amplitude_nm, share * curve.amplitude_error_nm, "%"),
    }
    found = []
    for name, (values, errors, unit) in columns.items():
        here = free & np.isfinite(values)
        if here.sum() < 2 * FEWEST_ROWS:
            continue
        x, y, weights = np.flatnonzero(here) / (curve.rows - 1.0), values[here], 1.0 / errors[here]
        (slope, start), covariance = np.polyfit(x, y, 1, w=weights, cov="unscaled")
        chi2 = float(np.sum((weights * (y - slope * x - start)) ** 2))
        error = float(np.sqrt(max(1.0, chi2 / (len(x) - 2)) * covariance[0, 0]))
        if abs(slope) > _DRIFTING * error:
            drift = f"{slope:+.2g} +- {error:.1g} {unit}"
            found.append(
                f"the {name} of the free tip follows the order of the rows, by {drift} over the table: {_SAY_SO}"
            )
    return found[:1]


_LONG = 10.0
"""Errors of an amplitude over which rows off the sample must reach: the first in contact loses 1 nm per nm."""
_BENT_DEG, _BENT = 0.3, 0.005
"""Change of the free tip's lag and amplitude along its rows, over the free amplitude, that is no departure yet."""


def _not_flat(e: Any) -> list[str]:
    """Return why rows that count as the free tip's may be those of first contact, which depart by two, in words."""
    curve, lever, number = e.curve, e.functions.lever, e.functions.number
    at, free = lever.instrument(number), lever.free[number]
    columns = {
        "lag": (turned(curve.lag_deg - lag_of_free_tip(curve, at)), curve.lag_error_deg, _BENT_DEG, "degrees"),
        "amplitude": (
            100.0 * (curve.amplitude_nm / curve.free_amplitude_nm - at.free_amplitude_factor),
            100.0 * curve.amplitude_error_nm / curve.free_amplitude_nm,
            100.0 * _BENT,
            "%",
        ),
    }
    for way in ways(curve):
        rows, nearer = way[free[way]], way[~free[way]]
        if len(rows) < FEWEST_FREE_ROWS or not len(nearer):
            continue
        reach = curve.offset_nm[nearer].min() - curve.offset_nm[rows].min()
        if reach < _LONG * np.median(curve.amplitude_error_nm[rows]):
            return [f"the free part is {reach:.2g} nm long, too short to tell it from first contact: {_MORE_FREE}"]
        height = (curve.offset_nm[rows] - curve.offset_nm[rows].mean()) / max(np.ptp(curve.offset_nm[rows]), 1e-9)
        for name, (values, errors, least, unit) in columns.items():
            # weighted by the error of a row, which is one for all
            change = float(height @ values[rows] / max(height @ height, 1e-9))
            left = values[rows] - values[rows].mean() - change * height
            noise = max(float(np.median(errors[rows])), float(np.sqrt(left @ left / max(len(rows) - 2, 1))))
            error = noise / np.sqrt(max(height @ height, 1e-9))
            if abs(change) > max(_DRIFTING * error, least):
                change_in_words = f"{change:+.2g} +- {error:.1g} {unit}"
                return [f"the free part is not flat: its {name} changes by {change_in_words} along it: {_MORE_FREE}"]
    return []


_MORE_FREE = "record more heights off the sample"


def _bracketed(e: Any) -> list[str]:
    """Return what is known of the energy where it is largest, if that is no measurement, and what would narrow it."""
    top = e.largest
    if top["said"] == "measured":
        return []
    low, high = top["interval95"]
    words = f"{interval(low, high)} aJ" if top["said"] == "bracket" else f"below {high:.3g} aJ"
    return [f"{words} at {top['amplitude_ratio']:.2f} of the free amplitude; {what_narrows(e.functions)}"]


NO_FUNCTIONS: tuple[Rule[Any], ...] = (
    Rule(
        lambda e: not e.functions.lever.minimum.settled,
        "the least squares of the instrument, from what is stated and free rows, does not settle",
    ),
    Rule(
        lambda e: e.largest is None,
        "no branch has enough rows in contact for an energy of a tap",
    ),
    Rule(lambda e: _torn(e.functions), "the energy along the branches has no instrument as given: {case}"),
    Rule(
        lambda e: e.functions.scale > (LARGEST_SCALE if e.scale_errors else _LARGEST_UNASKED_SCALE),
        "the rows scatter {e.functions.scale:.1f} times as much about a smooth energy as their errors say",
    ),
    Rule(lambda e: e.drift, "{case}"),
    Rule(_not_flat, "{case}"),
    Rule(
        lambda e: not e.functions.possible,
        "the instrument contradicts the curve: with no frequency, Q and zero of the phase as stated are all energies "
        "above nothing, and no sample gives energy",
    ),
    Rule(
        lambda e: e.curve.phase_zero_deg is None and not e.functions.lever.free[e.functions.number].any(),
        f"fewer than {FEWEST_FREE_ROWS} rows are off the sample, and no zero of the phase is stated: {_MORE_FREE}",
    ),
    Rule(_bracketed, "the energy along the branches is only bracketed where it is largest: {case}"),
)
"""Why the energy along the branches is not measured; the first that applies."""


REASONS: Rules[Any] = [
    (
        Rule(lambda e: [e.curve.phase.reason] if e.curve.phase.reason else [], "{case}"),
        Rule(
            lambda e: not e.curve.has_phase and e.bound_aj is not None,
            "without a phase the curve gives no more than an upper bound of the energy of a tap",
        ),
        Rule(lambda e: [e.why_not_functions] if e.why_not_functions else [], "{case}"),
    )
]
"""What makes the energy no measurement."""


def _given(e: Any) -> bool:
    return e.valid and e.curve.has_phase


def _scaled(e: Any) -> list[tuple[str, float]]:
    fits = {"one energy a branch": e.fit, "a smooth energy": e.functions}
    return [(what, fit.scale) for what, fit in fits.items() if _given(e) and fit is not None and fit.scale > 1.0]


WARNINGS: Rules[Any] = [
    Rule(
        lambda e: _given(e) and e.fit is not None and not e.described,
        "one energy for all taps is not given: {e.why_not_constant}",
    ),
    Rule(
        _scaled,
        "the rows scatter {case[1]:.2g} times more about {case[0]} than their errors say: its errors are multiplied by "
        "that",
    ),
    Rule(
        lambda e: [n for n in e.fit.nuisances if abs(n.pull) > PULLED] if e.described else [],
        lambda _, n: (
            f"for one energy {ORIGINS[n.kind]} ends {n.pull:+.1f} standard errors from what was given ({n.given} to "
            f"{n.value:.6g})"
        ),
    ),
    Rule(
        lambda e: [len(e.set_aside)] if e.set_aside else [],
        "{case} of {e.curve.rows} rows are excluded; the column `note` of the table of rows says why",
    ),
]
"""What a reader should know besides."""


def _spring_constant(e: Any) -> str:
    if e.curve.over_spring_constant:
        return "spring constant not known: energies and virials are over it, in nm^2 (aJ over N/m)"
    return f"spring constant {e.curve.spring_constant_n_per_m} N/m"


def _lag(e: Any) -> str:
    behind = "the base" if e.curve.drive == "base" else "the force on the tip"
    known = "from the free rows" if e.rows.free.any() else "not known"
    zero = f"zero of the phase {known if e.curve.phase_zero_deg is None else f'{e.curve.phase_zero_deg} degrees'}"
    return f"lag behind {behind}, {zero}; heights upward, virial positive where attraction prevails"


def _usual(e: Any) -> list[str]:
    articles = {name: ORIGINS[name] if name == "quality_factor" else f"the {ORIGINS[name]}" for name in USUAL_ERRORS}
    usual = ", ".join(f"{articles[name]} to {100.0 * USUAL_ERRORS[name]:g} %" for name in e.curve.assumed)
    return [usual] if usual else []


ASSUMPTIONS: Rules[Any] = [
    Rule(
        lambda e: [_spring_constant(e)],
        "free frequency {e.curve.free_frequency_khz} kHz, Q {e.curve.quality_factor}, {case}, calibration "
        "{e.curve.tip_calibration}",
    ),
    Rule(_usual, "given without an error, so usual ones: {case}"),
    (
        Rule(lambda e: e.curve.time is None, "the drive stays as it is along the curve"),
        Rule(
            lambda e: free_ends(e.curve, e.rows.free),
            "phase and free amplitude drift evenly along the rows, as free rows at both ends tell",
        ),
        Rule(
            lambda _: True,
            f"phase and free amplitude drift evenly along the rows, usually by {USUAL_DRIFTS['phase_drift_deg']:g} "
            f"degrees and {100.0 * USUAL_DRIFTS['free_amplitude_drift']:g} %",
        ),
    ),
    Rule(lambda e: list(e.curve.phase.notes), "{case}"),
    Rule(lambda e: [_lag(e)] if e.curve.has_phase else [], "{case}"),
    Rule(lambda _: True, "harmonics were not measured: those of one brief impact a period, to 10 %"),
]
"""What the numbers take for granted."""
