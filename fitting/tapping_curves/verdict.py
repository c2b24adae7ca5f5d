"""What makes the energy of a tap no measurement, what a reader should know besides, and what is taken for granted.

The rules look at a `Tapping`. Its energy is given in two ways, as one number for each branch and as a function along
it; `NO_CONSTANT` and `NO_FUNCTIONS` say why one of them is not given, `REASONS` why neither is.
"""

from typing import Any

import numpy as np
from jaxtyping import Bool

from afm_jax.least_squares import IMPROBABLE, LARGEST_SCALE, PULLED
from afm_jax.outcomes import Rule, Rules
from fitting.parameters import USUAL_ERRORS
from fitting.tapping_curves.branches import free_ends
from fitting.tapping_curves.curve import TappingCurve
from fitting.tapping_curves.energy_curve import FEWEST_ROWS
from fitting.tapping_curves.energy_fit import EnergyFit, Nuisance

BRACKET = 0.5
"""Relative standard error from which a number is only a bracket."""
_LARGEST_UNASKED_SCALE = 2.0
"""Scatter of rows in contact, of their errors, that is believed without `scale_errors`: measured curves have up to 1.8
times that of the free tip."""
_DRIFTING = 5.0
"""Errors of a drift of the free rows from which it is one."""
_FOLLOWING = 3.0
"""Errors of a drift along the rows, of one energy for all taps, from which it is one."""
_NEGATIVE = 3.0
"""Standard errors below zero from which an energy is impossible."""
_SAY_SO = "if they stand as they were measured, say so by '# rows = in order of time', and the drift is fitted along"
ORIGINS = {
    "noise": "noise",
    "free_frequency_khz": "free frequency",
    "quality_factor": "Q",
    "spring_constant_n_per_m": "spring constant",
    "tip_calibration": "calibration",
    "phase_zero_deg": "zero of phase",
    "free_amplitude": "free amplitude",
    "harmonics_factor": "harmonics",
    "harmonics": "harmonics",
    "phase_drift_deg": "drift of the phase",
    "free_amplitude_drift": "drift of the free amplitude",
}
"""What an error comes from, in words."""


def _torn(fit: EnergyFit) -> list[str]:
    """Return which nuisances had to go too far, in words."""
    parts = [f"{ORIGINS[n.kind]} {n.pull:+.1f} of its errors from what was given" for n in fit.torn]
    return [f"{' and '.join(parts)} would be needed"] if parts else []


def _followed(e: Any) -> list[str]:
    """Return by what drift rows about one energy follow their order, which the table does not state as that in time."""
    if e.followed is None or not e.followed.p_value > IMPROBABLE:
        return []
    units = {"phase_drift_deg": (1.0, "degrees"), "free_amplitude_drift": (100.0, "%")}

    def said(one: Nuisance) -> str:
        factor, unit = units[one.kind]
        return f"{ORIGINS[one.kind]} of {factor * one.value:+.2g} +- {factor * one.standard_error:.1g} {unit}"

    drifts = (one for one in e.followed.nuisances if one.kind in units)
    return [said(one) for one in drifts if abs(one.value) > _FOLLOWING * one.standard_error][:1]


NO_CONSTANT: tuple[Rule[Any], ...] = (
    Rule(lambda e: e.fit is None, "no branch has enough rows of taps that come every period for one energy"),
    Rule(
        lambda e: e.fit.scale == 1.0 and e.fit.p_value < IMPROBABLE,
        "one energy a branch does not describe the rows (chi2 {e.fit.chi2:.0f} for {e.fit.degrees_of_freedom} degrees "
        "of freedom, probability {e.fit.p_value:.1g})",
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


def _impossible(e: Any) -> bool:
    """Say whether an energy along a branch is below zero by more than its errors."""
    return any(np.any(b.curve.energy_aj + _NEGATIVE * b.curve.energy_error_aj < 0.0) for b in e.branches)


NO_FUNCTIONS: tuple[Rule[Any], ...] = (
    Rule(
        lambda e: e.functions is None or e.largest is None,
        "no branch has enough rows in contact for an energy of a tap",
    ),
    Rule(lambda e: _torn(e.functions), "the energy along the branches has no instrument as given: {case}"),
    Rule(
        lambda e: e.functions.scale > (LARGEST_SCALE if e.scale_errors else _LARGEST_UNASKED_SCALE),
        "the rows scatter {e.functions.scale:.1f} times as much about a smooth energy as their errors say",
    ),
    Rule(lambda e: e.drift, "{case}"),
    Rule(_impossible, "energies below zero beyond their errors: frequency, Q or the zero of the phase is wrong"),
    Rule(
        lambda e: not e.largest["standard_error"] < BRACKET * e.largest["value"],
        lambda e, _: (
            f"the energy along the branches is only bracketed, {max(e.largest['value'], 0.0):.2g} aJ at its largest "
            f"with a standard error of {e.largest['standard_error']:.2g}"
        ),
    ),
)
"""Why the energy along the branches is not determined; the first that applies."""


def _undetermined(e: Any) -> list[str]:
    """Return why neither one energy nor one along the branches is determined; nothing where one of them is."""
    energy = e.energy
    one = energy["reason"]
    if energy["kind"] == "bracket":
        chief = max(energy["share_of_variance"], key=lambda name: energy["share_of_variance"][name])
        low, high = energy["interval95"]
        one = f"the energy of a tap is only bracketed, {low:.2g} to {high:.2g} aJ; most of that is {ORIGINS[chief]}"
    if energy["kind"] == "several":
        each = [e.constant(i) for i in e.chief]
        if all(error < BRACKET * value for value, error, _ in each):
            return []
    return list(dict.fromkeys([one, e.why_not_functions])) if one and e.why_not_functions else []


REASONS: Rules[Any] = [
    (
        Rule(lambda e: [e.curve.phase.reason] if e.curve.phase.reason else [], "{case}"),
        Rule(
            lambda e: not e.curve.has_phase and e.bound_aj is not None,
            "without a phase the curve gives no more than an upper bound of the energy of a tap",
        ),
        Rule(lambda e: e.drift, "{case}"),
        Rule(_undetermined, "{case}"),
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
        lambda e: _given(e) and bool(e.why_not_functions),
        "as a function of the amplitude it is not determined: {e.why_not_functions}",
    ),
    Rule(
        _scaled,
        "the rows scatter {case[1]:.2g} times more about {case[0]} than their errors say: its errors are multiplied by "
        "that",
    ),
    Rule(
        lambda e: [n for n in e.fit.nuisances if abs(n.pull) > PULLED] if _given(e) and e.described else [],
        lambda _, n: (
            f"{ORIGINS[n.kind]} ends {n.pull:+.1f} standard errors from what was given ({n.given} to {n.value:.6g})"
        ),
    ),
    Rule(
        lambda e: _given(e) and not e.rows.free.any() and e.curve.phase_zero_deg is None,
        "no row of the free tip fixes the zero of the phase: it is fitted, and the energy depends on it",
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
    zero = "the zero of the phase from the free rows"
    if not e.rows.free.any():
        zero = f"zero of phase {e.curve.phase_zero_deg or 'fitted'}"
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
        Rule(lambda _: True, "phase and free amplitude drift evenly along the rows, usually by 3 degrees and 2 %"),
    ),
    Rule(lambda e: list(e.curve.phase.notes), "{case}"),
    Rule(lambda e: [_lag(e)] if e.curve.has_phase else [], "{case}"),
    Rule(
        lambda e: not e.curve.harmonic_amplitudes_nm,
        "harmonics were not measured: those of one brief impact a period, to 10 %",
    ),
]
"""What the numbers take for granted."""
