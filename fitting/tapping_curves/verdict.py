"""What makes the energy of a tap no measurement, what a reader should also know, and what is assumed.

The rules look at a `Tapping`. Its energy is given in two ways, as one number for each branch and as a function along
it; `NO_CONSTANT` and `NO_FUNCTIONS` say why one of them is not given, `REASONS` why neither is.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np

from afm_jax.outcomes import Rule, Rules
from afm_jax.solve.least_squares import IMPROBABLE, LARGEST_SCALE, TORN
from afm_jax.words import interval
from fitting.instruments.lag import turned
from fitting.parameters import USUAL_DRIFTS, USUAL_ERRORS
from fitting.tapping_curves.along import EnergyFunctions, what_narrows
from fitting.tapping_curves.branches import FEWEST_ROWS, free_ends, ways
from fitting.tapping_curves.curve import lag_of_free_tip
from fitting.tapping_curves.lever import FEWEST_FREE_ROWS
from fitting.tapping_curves.one_energy import OneEnergy

_LARGEST_UNASKED_SCALE = 2.0
"""Scatter of rows in contact, of their errors, that is believed without `scale_errors`: measured curves have up to 1.8
times that of the free tip."""
_DRIFTING = 5.0
"""Errors of a drift of the free rows from which it is one."""
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


NO_CONSTANT: tuple[Rule[Any], ...] = (
    Rule(lambda e: e.fit is None, "no branch has enough rows of taps that come every period for one energy"),
    Rule(lambda e: not e.fit.minimum.settled, "the fit of one energy for each branch does not converge"),
    Rule(
        lambda e: e.fit.scale == 1.0 and e.fit.minimum.p_value < IMPROBABLE,
        "one energy for each branch does not describe the rows (chi2 {e.fit.minimum.chi2:.0f} for "
        "{e.fit.minimum.degrees_of_freedom} degrees of freedom, probability {e.fit.minimum.p_value:.1g})",
    ),
    Rule(
        lambda e: e.fit.scale > LARGEST_SCALE,
        "one energy for each branch describes the rows only with errors {e.fit.scale:.1f} times as large",
    ),
    Rule(lambda e: _torn(e.fit), "one energy for each branch contradicts the instrument: {case}"),
)
"""Why one energy for each branch does not explain the rows; the first that applies."""


def _changes_of_free_tip(e: Any, rows: np.ndarray, along: np.ndarray) -> Iterator[tuple[str, float, float, float, str]]:
    """Yield what changes of the free tip along its rows, by how much, the error, what is no change yet, and the unit.

    Args:
        e: a `Tapping`.
        rows: numbers of the free rows.
        along: what a straight line is fitted over; the change is that over 1 of it.
    """
    curve, at, percent = e.curve, e.functions.instrument, 100.0 / e.curve.free_amplitude_nm
    of_amplitude = percent * curve.amplitude_nm - 100.0 * at.free_amplitude_factor
    for name, values, errors, none, unit in (
        ("phase", turned(curve.lag_deg - lag_of_free_tip(curve, at)), curve.lag_error_deg, _BENT_DEG, "degrees"),
        ("amplitude", of_amplitude, percent * curve.amplitude_error_nm, 100.0 * _BENT, "%"),
    ):
        here = np.isfinite(values[rows])
        x, y, weights = along[here], values[rows][here], 1.0 / errors[rows][here]
        if len(x) >= FEWEST_FREE_ROWS and np.ptp(x) > 0.0:
            (slope, start), covariance = np.polyfit(x, y, 1, w=weights, cov="unscaled")
            chi2 = float(np.sum((weights * (y - slope * x - start)) ** 2))
            yield name, slope, float(np.sqrt(max(1.0, chi2 / (len(x) - 2)) * covariance[0, 0])), none, unit


def _drifting(e: Any) -> list[str]:
    """Return by what the free tip drifted along rows whose order in time the table does not state, in words."""
    places = np.flatnonzero(e.rows.free)
    if e.curve.time is not None or len(places) < 2 * FEWEST_ROWS or not free_ends(e.curve, e.rows.free):
        return []
    if np.diff(places).max() <= FEWEST_ROWS:
        # one way only: along it the free tip may feel the sample
        return []
    changes = _changes_of_free_tip(e, places, places / (e.curve.rows - 1.0))
    return [
        f"the {name} of the free tip follows the order of the rows, by {change:+.2g} +- {error:.1g} {unit} over the "
        f"table: {_SAY_SO}"
        for name, change, error, _, unit in changes
        if abs(change) > _DRIFTING * error
    ][:1]


_LONG = 10.0
"""Errors of an amplitude over which rows off the sample must reach: the first in contact loses 1 nm per nm."""
_BENT_DEG, _BENT = 0.3, 0.005
"""Change of the free tip's lag and amplitude along its rows, over the free amplitude, that is no departure yet."""


def _not_flat(e: Any) -> list[str]:
    """Return why rows that count as the free tip's may be those of first contact, which depart by two, in words."""
    curve, free = e.curve, e.functions.lever.free[e.functions.number]
    for way in ways(curve):
        rows, nearer = way[free[way]], way[~free[way]]
        if len(rows) < FEWEST_FREE_ROWS or not len(nearer):
            continue
        height = curve.offset_nm[rows]
        reach = curve.offset_nm[nearer].min() - height.min()
        if reach < _LONG * np.median(curve.amplitude_error_nm[rows]):
            return [f"the free part is {reach:.2g} nm long, too short to tell it from first contact: {_MORE_FREE}"]
        for name, change, error, none, unit in _changes_of_free_tip(e, rows, height / max(np.ptp(height), 1e-9)):
            if abs(change) > max(_DRIFTING * error, none):
                by = f"{change:+.2g} +- {error:.1g} {unit}"
                return [f"the free part is not flat: its {name} changes by {by} along it: {_MORE_FREE}"]
    return []


_MORE_FREE = "record more heights off the sample"


def _bracketed(e: Any) -> list[str]:
    """Return what is known of the energy where it is largest, if that is no measurement, and what would narrow it."""
    top = e.largest
    low, high = top["interval95"]
    words = f"{interval(low, high)} aJ" if top["said"] == "bracket" else f"below {high:.3g} aJ"
    said = f"{words} at {top['amplitude_ratio']:.2f} of the free amplitude; {what_narrows(e.functions)}"
    return [] if top["said"] == "measured" else [said]


NO_FUNCTIONS: tuple[Rule[Any], ...] = (
    Rule(
        lambda e: not e.functions.lever.minimum.settled,
        "the fit of the instrument to statements and free rows does not converge",
    ),
    Rule(
        lambda e: e.largest is None,
        "no branch has enough rows in contact for an energy of a tap",
    ),
    Rule(lambda e: _torn(e.functions), "no instrument as stated explains the energy along the branches: {case}"),
    Rule(
        lambda e: e.functions.scale > (LARGEST_SCALE if e.scale_errors else _LARGEST_UNASKED_SCALE),
        "rows scatter about a smooth energy by {e.functions.scale:.1f} times their errors",
    ),
    Rule(_drifting, "{case}"),
    Rule(_not_flat, "{case}"),
    Rule(
        lambda e: not e.functions.possible,
        "the instrument contradicts the curve: with every frequency, Q and zero of the phase within the stated errors "
        "some tap would gain energy, and no sample gives energy",
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
            "without a phase the curve gives only an upper bound of the energy of a tap",
        ),
        Rule(lambda e: [e.why_not_functions] if e.why_not_functions else [], "{case}"),
    )
]
"""What makes the energy no measurement."""


def _scaled(e: Any) -> list[tuple[str, float]]:
    fits = {"one energy for each branch": e.fit, "a smooth energy": e.functions}
    return [(what, fit.scale) for what, fit in fits.items() if fit and fit.scale > 1.0] if e.valid else []


WARNINGS: Rules[Any] = [
    Rule(
        lambda e: e.why_not_constant if e.valid and e.fit is not None else "",
        "one energy for all taps is not given: {case}",
    ),
    Rule(
        _scaled,
        "rows scatter about {case[0]} by {case[1]:.2g} times their errors: its errors are multiplied by that",
    ),
    Rule(
        lambda e: [len(e.set_aside)] if e.set_aside else [],
        "excluded: {case} of {e.curve.rows} rows; the column `note` of the table of rows says why",
    ),
]
"""What a reader should also know."""


def _spring_constant(e: Any) -> list[str]:
    if e.curve.over_spring_constant:
        return ["spring constant not known: energies and virials are divided by it, in nm^2 (aJ over N/m)"]
    return [f"spring constant {e.curve.spring_constant_n_per_m} N/m"]


def _lag(e: Any) -> list[str]:
    behind = "the base" if e.curve.drive == "base" else "the force on the tip"
    zero = "from the free rows" if e.rows.free.any() else "not known"
    if e.curve.phase_zero_deg is not None:
        zero = f"{e.curve.phase_zero_deg} degrees"
    lag = f"lag behind {behind}, zero of the phase {zero}; heights upward, virial positive where attraction prevails"
    return [lag] if e.curve.has_phase else []


def _usual(e: Any) -> list[str]:
    return [f"no error given for {ORIGINS[name]}; {100.0 * USUAL_ERRORS[name]:g} % assumed" for name in e.curve.assumed]


ASSUMPTIONS: Rules[Any] = [
    Rule(
        _spring_constant,
        "free frequency {e.curve.free_frequency_khz} kHz, Q {e.curve.quality_factor}, {case}, calibration "
        "{e.curve.tip_calibration}",
    ),
    Rule(_usual, "{case}"),
    (
        Rule(lambda e: e.curve.time is None, "the drive does not change along the curve"),
        Rule(
            lambda e: free_ends(e.curve, e.rows.free),
            "phase and free amplitude drift evenly along the rows; free rows at both ends measure the drift",
        ),
        Rule(
            lambda _: True,
            f"phase and free amplitude drift evenly along the rows, by {USUAL_DRIFTS['phase_drift_deg']:g} degrees and "
            f"{100.0 * USUAL_DRIFTS['free_amplitude_drift']:g} % (assumed standard errors)",
        ),
    ),
    Rule(lambda e: list(e.curve.phase.notes), "{case}"),
    Rule(_lag, "{case}"),
    Rule(lambda _: True, "harmonics were not measured; those of one brief impact in each period are assumed, to 10 %"),
]
"""What the numbers assume."""
