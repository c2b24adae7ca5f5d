"""Does the program differentiate rightly? Equations 5 to 8 against automatic differentiation and 50 digits."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from afm_jax.parameters import require_float64
from afm_jax.study.high_precision import exact_orbit, mpmath_or_reason
from afm_jax.study.verification_autodiff import MODES
from afm_jax.study.verification_condition import EPSILON
from afm_jax.study.verification_digits import EQUATIONS, digits_differences, plain_rows
from afm_jax.study.verification_orbits import OrbitSample, draw_orbits
from afm_jax.study.verification_samples import Sample, automatic_values, draw_sample, relative_difference
from afm_jax.study.verification_states import DAMPED, DELAYED, PAPER, Floats

TOLERANCE = 1e-9
ROUNDING_LIMIT = 10.0
"""Largest difference from 50 digits, in units of machine epsilon times the condition number; 1.4 was measured."""
ORBIT_ROUNDING_LIMIT = 1e3
"""The same for eq. 8: an orbit shifts by up to 1e3 times its rounding before it counts as near a fold."""
UNDECIDABLE = 1e-3
"""Machine epsilon times condition number above which float64 cannot tell whether the tip is captured or missed."""
_KIND_NAMES = {PAPER: "", DAMPED: ", damped", DELAYED: ", damped, delayed"}


@dataclass(frozen=True, kw_only=True)
class Check:
    """One line of the verification.

    Attributes:
        equation: what was compared.
        against: "autodiff" (formula against automatic differentiation), or "50 digits" (both against mpmath).
        where: "ordinary", or "close" to capture or grazing.
        points: states compared.
        max_relative_difference: the worst difference over the sum of the magnitudes of the formula's terms; None if
            not compared.
        mode: the mode of differentiation that was worst; None for "50 digits".
        tolerance: what `judged` may not exceed.
        judged: the difference, or with 50 digits the difference over machine epsilon and condition number.
        passed: None if not compared.
        reason: why not compared, or what was left out.
    """

    equation: str
    against: str
    where: str
    points: int
    max_relative_difference: float | None
    mode: str | None
    tolerance: float
    judged: float | None
    passed: bool | None
    reason: str | None = None


def verify(*, states: int = 10_000, seed: int = 0, exact_states: int = 200) -> list[Check]:
    """Run all comparisons.

    Args:
        states: ordinary random states (and orbits) of each kind, at least.
        seed: of the random states; the same seed gives the same result.
        exact_states: states of each kind, ordinary and close each, compared with 50 digits.

    Raises:
        RuntimeError: if JAX is not set to 64-bit floats, or the map finds far fewer impacts than there are.
        ValueError: if a number of states is not positive.
    """
    require_float64()
    for name, number in (("states", states), ("exact_states", exact_states)):
        if number < 1:
            raise ValueError(f"`{name}` must be a positive integer, but is {number}")
    random = np.random.default_rng(seed)
    samples = [draw_sample(random, states, kind) for kind in (PAPER, DAMPED, DELAYED)]
    orbits = [draw_orbits(random, states, kind) for kind in (PAPER, DAMPED)]
    checks = [check for sample in samples for check in _automatic_checks(sample)]
    checks += [check for sample in orbits for check in _orbit_checks(sample)]
    for where in ("ordinary", "close"):
        checks += _digits_checks(samples, where, exact_states)
        checks.append(_orbit_digits_check(orbits[0], where, exact_states))
    return checks


def _automatic_checks(sample: Sample) -> list[Check]:
    """Compare formulas with automatic differentiation at the ordinary states."""
    values, rows = automatic_values(sample), sample.ordinary
    checks = []
    for name in EQUATIONS:
        pair = sample.written[name]
        written, terms = np.asarray(pair.value)[rows], np.asarray(pair.terms)[rows]
        worst = [relative_difference(values[name][rows, mode], written, terms).max() for mode in range(len(MODES))]
        checks.append(_check(name + _KIND_NAMES[sample.kind], worst, int(rows.sum()), _both_at_once(sample)))
    return checks


def _both_at_once(sample: Sample) -> str | None:
    """Say how many states count as close only because they are a little close to both capture and grazing."""
    number = int((sample.away & ~sample.ordinary).sum())
    return (
        f"{number} states close to capture and grazing at once (or late) are left to the 50 digits" if number else None
    )


def _orbit_checks(sample: OrbitSample) -> list[Check]:
    """Compare D and T of eq. 8 with determinant and trace of the automatic derivative."""
    rows = sample.ordinary
    checks = []
    for name, pair in sample.written.items():
        written, terms = np.asarray(pair.value)[rows], np.asarray(pair.terms)[rows]
        found = sample.automatic[name][rows]
        worst = [relative_difference(found[:, mode], written, terms).max() for mode in range(len(MODES))]
        checks.append(_check(f"eq. 8, {name}" + ("" if "T" in sample.written else ", damped"), worst, int(rows.sum())))
    return checks


def _check(equation: str, worst: list[Any], points: int, reason: str | None = None) -> Check:
    largest = float(max(worst))
    return Check(
        equation=equation,
        against="autodiff",
        where="ordinary",
        points=points,
        max_relative_difference=largest,
        mode=MODES[int(np.argmax(worst))],
        tolerance=TOLERANCE,
        judged=largest,
        passed=largest <= TOLERANCE,
        reason=reason,
    )


def _digits_checks(samples: list[Sample], where: str, wanted: int) -> list[Check]:
    """Compare automatic derivatives and formulas with 50 digits, at ordinary or at close states."""
    mp, reason = mpmath_or_reason()
    if mp is None:
        return [_digits_check(name, where, None, reason, ROUNDING_LIMIT) for name in EQUATIONS]
    found: dict[str, list[Floats]] = {name: [] for name in EQUATIONS}
    conditions, left_out = [], 0
    for sample in samples:
        rows = np.flatnonzero(sample.ordinary if where == "ordinary" else ~sample.ordinary)[:wanted]
        differences, condition = digits_differences(mp, sample, rows)
        decidable = EPSILON * condition < UNDECIDABLE
        left_out += int((~decidable).sum())
        conditions.append(condition[decidable])
        for name in EQUATIONS:
            found[name].append(differences[name][decidable])
    note = f"{left_out} states within rounding of capture or of a miss left out" if left_out else None
    condition = np.concatenate(conditions)
    return [
        _digits_check(name, where, (np.concatenate(found[name]), condition), note, ROUNDING_LIMIT) for name in EQUATIONS
    ]


def _orbit_digits_check(sample: OrbitSample, where: str, wanted: int) -> Check:
    """Compare the trace of eq. 8 and of the automatic derivative with 50 digits on the exact orbit."""
    mp, reason = mpmath_or_reason()
    if mp is None:
        return _digits_check("eq. 8, T", where, None, reason, ORBIT_ROUNDING_LIMIT)
    rows = np.flatnonzero(sample.ordinary == (where == "ordinary"))
    rows = rows[EPSILON * sample.condition[rows] < UNDECIDABLE][:wanted]
    plain = plain_rows(sample.states)
    exact = np.array([
        exact_orbit(
            mp,
            {name: None if values is None else values[row] for name, values in plain.items()},
            int(sample.order[row]),
            (float(sample.phase[row]), float(sample.states.velocity[row])),
        )[1]
        for row in rows
    ])  # fmt: skip
    terms = np.asarray(sample.written["T"].terms)[rows]
    candidates = [*sample.automatic["T"][rows].T, np.asarray(sample.written["T"].value)[rows]]
    difference = np.max([relative_difference(value, exact, terms) for value in candidates], axis=0)
    return _digits_check("eq. 8, T", where, (difference, sample.condition[rows]), None, ORBIT_ROUNDING_LIMIT)


def _digits_check(
    equation: str, where: str, compared: tuple[Floats, Floats] | None, reason: str | None, limit: float
) -> Check:
    if compared is None or not len(compared[0]):
        worst, judged, passed, points = None, None, None, 0
        reason = reason or "no such state among those drawn; ask for more"
    else:
        difference, condition = compared
        worst, judged = float(difference.max()), float(np.max(difference / condition) / EPSILON)
        passed, points = judged <= limit, len(difference)
    return Check(
        equation=equation,
        against="50 digits",
        where=where,
        points=points,
        max_relative_difference=worst,
        mode=None,
        tolerance=limit,
        judged=judged,
        passed=passed,
        reason=reason,
    )
