"""Does the program differentiate rightly? Equations 5 to 8 against automatic differentiation and 50 digits.

The comparison with 50 digits, in units of what rounding can do: machine epsilon times the condition number.

Equation 8 at single-impact orbits of random scenes, against the map's automatic derivative there.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.checks import require_float64
from afm_jax.impact import jacobian as formulas
from afm_jax.impact.law import ImpactLaw, formula_of
from afm_jax.impact.orbits import single_impact_orbits
from afm_jax.verify.fifty_digits import exact_impact, exact_orbit, mpmath_or_reason
from afm_jax.verify.samples import (
    BLOCK,
    DAMPED,
    DELAYED,
    EPSILON,
    MODES,
    PAPER,
    Floats,
    Kind,
    Pair,
    Sample,
    States,
    automatic_values,
    condition_number,
    differentiate,
    draw_sample,
    eq8_trace_terms,
    is_ordinary,
    logarithmic,
    near_integer,
    relative_difference,
)

EQUATIONS = ("eq. 5", "eq. 6", "eq. 7", "eqs. 5+7")


def digits_differences(mp: Any, sample: Sample, rows: NDArray[np.int64]) -> tuple[dict[str, Floats], Floats]:
    """Compare automatic derivatives and written formulas with 50 digits.

    Args:
        mp: mpmath's context.
        sample: the states.
        rows: which of them, integer indices of shape (rows,).

    Returns:
        By equation the relative difference of the worst of forward, reverse and written, shape (rows,); and the
        condition numbers, shape (rows,).
    """
    automatic = automatic_values(sample)
    plain = plain_rows(sample.states)
    exact = [
        exact_impact(
            mp,
            {name: None if values is None else values[row] for name, values in plain.items()},
            (float(sample.states.time_us[row]), float(sample.states.velocity[row])),
            float(sample.automatic.arrival_us[row]),
        )
        for row in rows
    ]
    parts = ([one.flight for one in exact], [one.rebound for one in exact], [one.law for one in exact])
    truth = dict(zip(EQUATIONS, map(np.array, (*parts, [one.chained for one in exact])), strict=True))
    differences = {}
    for name in EQUATIONS:
        pair = sample.written[name]
        terms = np.asarray(pair.terms)[rows]
        candidates = [automatic[name][rows, 0], automatic[name][rows, 1], np.asarray(pair.value)[rows]]
        differences[name] = np.max([relative_difference(value, truth[name], terms) for value in candidates], axis=0)
    return differences, sample.condition[rows]


def plain_rows(states: States) -> dict[str, Any]:
    """Return a batch of scenes as columns of plain numbers (a delay as triples), None for absent effects."""
    scene = states.scene
    law = formula_of(scene)
    columns = {
        "frequency_khz": scene.cantilever.frequency_khz,
        "quality_factor": scene.cantilever.quality_factor,
        "amplitude_nm": scene.platform.amplitude_nm,
        "drive_frequency_khz": scene.platform.frequency_khz,
        "offset_nm": scene.platform.offset_nm,
        "r": law.r,
        "epsilon": law.epsilon,
        "viscous_loss": law.viscous_loss,
    }
    plain: dict[str, Any] = {name: None if column is None else np.asarray(column) for name, column in columns.items()}
    triple = None if law.delay is None else (law.delay.hertz, law.delay.lead_nm, law.delay.offset_nm)
    return plain | {"delay": None if triple is None else np.stack([np.asarray(part) for part in triple], axis=-1)}


MOST_BLOCKS = 60
WELL_CONDITIONED = 1e5
"""Condition number up to which orbits count as ordinary (all but 2 %): eq. 8 is taken at the orbit, automatic
differentiation at the impact that it finds, so that the error of the impact time enters."""


class OrbitSample(NamedTuple):
    """Admissible orbits away from folds, arrays of shape (orbits,).

    ``ordinary``: away from capture and grazing, well conditioned; ``condition``: their impacts' condition number.
    ``written``: "D", without damping "T" too; ``automatic``: the same of the map's derivative, shape (orbits, mode).
    """

    states: States
    order: Floats
    phase: Floats
    ordinary: NDArray[np.bool_]
    condition: Floats
    written: dict[str, Pair]
    automatic: dict[str, Floats]


def draw_orbits(random: np.random.Generator, wanted: int, kind: Kind) -> OrbitSample:
    """Return at least `wanted` orbits of random scenes, drawn in blocks of one shape.

    Raises:
        RuntimeError: if the search finds far fewer orbits than there are.
    """
    find = jax.jit(jax.vmap(single_impact_orbits))
    evaluate = jax.jit(jax.vmap(_eq8 if not kind.damped else _damped_determinant))
    blocks: list[OrbitSample] = []
    while sum(int(block.ordinary.sum()) for block in blocks) < wanted:
        if len(blocks) > MOST_BLOCKS + 10 * wanted // BLOCK:
            raise RuntimeError(f"{len(blocks) * BLOCK} random scenes have fewer than {wanted} single-impact orbits")
        blocks.append(_block(random, kind, find, evaluate))
    first = blocks[0]
    return OrbitSample(*jax.tree.map(lambda *arrays: np.concatenate(arrays), first, *blocks[1:]))


def _random_scenes(random: np.random.Generator, kind: Kind) -> tuple[Scene, Floats]:
    """Return scenes driven near omega = 2 N Omega, a third of them within 1e-6 to 1e-2, and their orders N."""
    reduced = near_integer(random, BLOCK)
    order = np.round(reduced)
    wide = order * random.uniform(0.8, 1.2, BLOCK)
    reduced = np.where(random.random(BLOCK) < 1.0 / 3.0, reduced, wide)
    frequency = logarithmic(random, 40.0, 200.0, BLOCK)
    some = random.random(BLOCK) < 0.6
    law = ImpactLaw(
        r=random.uniform(0.3, 0.999, BLOCK),
        epsilon=logarithmic(random, 1e-2, 100.0, BLOCK) * some,
        viscous_loss=logarithmic(random, 1e-3, 1.0, BLOCK) * kind.damped,
    )
    quality = logarithmic(random, 2.0, 1e4, BLOCK) if kind.damped else None
    platform = Platform(
        logarithmic(random, 0.2, 20.0, BLOCK), 2.0 * reduced * frequency, random.uniform(-20.0, 5.0, BLOCK), 0 * order
    )
    return Scene(Cantilever(frequency, quality, np.ones(BLOCK)), platform, law), order


def _block(random: np.random.Generator, kind: Kind, find: Any, evaluate: Any) -> OrbitSample:
    """Return the orbits of one block of scenes; slot after slot, so that every batch has the same shape."""
    scene, order = _random_scenes(random, kind)
    orbits = find(scene, order)
    parts = []
    for slot in range(orbits.exists.shape[1]):
        phase, after = (np.asarray(values[:, slot]) for values in (orbits.phase_rad, orbits.velocity_after_nm_per_us))
        states = States(scene, phase / np.asarray(scene.platform.angular_frequency), after)
        automatic = differentiate(*states)
        rows = np.asarray(orbits.admissible[:, slot] & ~orbits.near_double[:, slot] & automatic.hit)
        with np.errstate(all="ignore"):  # slots without an orbit
            condition = condition_number(states, automatic)
            ordinary = is_ordinary(scene, automatic) & (condition < WELL_CONDITIONED)
        chained = np.asarray(automatic.chained)
        products = chained[..., 0, 0] * chained[..., 1, 1], chained[..., 0, 1] * chained[..., 1, 0]
        found = {"D": products[0] - products[1], "T": chained[..., 0, 0] + chained[..., 1, 1]}
        written = evaluate(states, order)
        # A determinant of numbers cancels, besides what the formula's own terms do.
        cancelled = np.max(np.abs(products[0]) + np.abs(products[1]), axis=1)
        written["D"] = written["D"]._replace(terms=np.asarray(written["D"].terms) + cancelled)
        found = {name: found[name] for name in written}
        parts.append(_take(OrbitSample(states, order, phase, ordinary, condition, written, found), rows))
    return OrbitSample(*jax.tree.map(lambda *arrays: np.concatenate(arrays), *parts))


def _eq8(state: States, order: Any) -> dict[str, Pair]:
    scene, start, after = state
    law = formula_of(scene)
    end = start + order * scene.platform.period_us
    flight = formulas.paper_flight(scene.cantilever, scene.platform, start, after, end)
    determinant, trace = formulas.eq8(flight, after, law.r)
    return {"D": Pair(determinant, law.r**2), "T": Pair(trace, eq8_trace_terms(flight, after, law.r))}


def _damped_determinant(state: States, order: Any) -> dict[str, Pair]:
    """D = (r^2 - c/(2 u_in)) exp(-Omega T/Q): the flight shrinks areas, the law by d(u_out^2)/d(u_in^2)."""
    scene, start, after = state
    law = formula_of(scene)
    rebound = after - scene.platform.velocity(start)
    loss = law.viscous_loss / (2.0 * law.approach_speed(rebound))
    kept = jnp.exp(-2.0 * scene.cantilever.decay_rate * order * scene.platform.period_us)
    return {"D": Pair((law.r**2 - loss) * kept, (law.r**2 + loss) * kept)}


def _take(sample: OrbitSample, rows: NDArray[np.bool_]) -> OrbitSample:
    return OrbitSample(*jax.tree.map(lambda array: np.asarray(array)[rows], tuple(sample)))


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
        if not rows.size:
            continue
        differences, condition = digits_differences(mp, sample, rows)
        decidable = EPSILON * condition < UNDECIDABLE
        left_out += int((~decidable).sum())
        conditions.append(condition[decidable])
        for name in EQUATIONS:
            found[name].append(differences[name][decidable])
    if not conditions:
        return [_digits_check(name, where, None, None, ROUNDING_LIMIT) for name in EQUATIONS]
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
