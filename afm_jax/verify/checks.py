"""Equations 5 to 8 against automatic differentiation of the impact map, and both against 50 digits of mpmath.

Differences from automatic differentiation are measured in the scale of the formula (`Written.scale`), those from 50
digits in units of what rounding can do (`Written.rounding` times the machine epsilon). Equation 8 is compared at
single-impact orbits of random scenes.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from rich.table import Table

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.checks import require_float64
from afm_jax.columns import Cell, columns_of, printed_table
from afm_jax.impact import jacobian as formulas
from afm_jax.impact.law import ImpactLaw, formula_of
from afm_jax.impact.orbits import single_impact_orbits
from afm_jax.results import Result
from afm_jax.verify.fifty_digits import exact_impact, exact_trace, mpmath_or_reason
from afm_jax.verify.samples import (
    BLOCK,
    DAMPED,
    DELAYED,
    EPSILON,
    MODES,
    PAPER,
    Floats,
    Kind,
    Sample,
    States,
    Written,
    draw_sample,
    joined,
    logarithmic,
    near_integer,
    relative_difference,
    rows_of,
    sample_at,
    sum_of_terms,
    written_formulas,
)
from afm_jax.words import known

EQUATIONS = ("eq. 5", "eq. 6", "eq. 7", "eqs. 5+7")
TOLERANCE = 1e-10
ROUNDING_LIMIT = 10.0
"""Largest difference from 50 digits in units of what rounding can do; 0.7 was measured."""
ORBIT_ROUNDING_LIMIT = 1e3
"""The limit for eq. 8: an orbit shifts by up to 1e3 times its rounding before it counts as near a fold."""
UNDECIDABLE = 1e-3
"""Relative error by rounding of what vanishes at grazing and capture, above which float64 cannot tell whether the tip
is captured or missed."""
WELL_CONDITIONED = 1e5
"""Growth of rounding errors up to which orbits count as ordinary (all but 2 %): eq. 8 is taken at the orbit, automatic
differentiation at the impact that it finds, so that the error of the impact time enters."""
MOST_BLOCKS = 60
_KIND_NAMES = {PAPER: "", DAMPED: ", damped", DELAYED: ", damped, delayed"}


@dataclass(frozen=True, kw_only=True)
class Check:
    """One line of the verification.

    Attributes:
        equation: what was compared.
        against: "autodiff" (formula against automatic differentiation), or "50 digits" (both against mpmath).
        where: "ordinary", or "close" to capture or grazing.
        points: states compared.
        max_relative_difference: the worst difference over the formula's scale, |f| + sum |x df/dx| over the numbers x
            of scene and start; None if not compared.
        mode: the mode of differentiation that was worst; None for "50 digits".
        tolerance: what `judged` may not exceed.
        judged: the relative difference, or with 50 digits the difference in units of what rounding can do.
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


class Verification(NamedTuple):
    """All comparisons, and of how many states."""

    checks: list[Check]
    states: int
    seed: int
    exact_states: int

    text = Result.text

    @property
    def reason(self) -> str | None:
        """Which comparison differs too much; None where none does."""
        failed = [check for check in self.checks if check.passed is False]
        if not failed:
            return None
        first = failed[0]
        return (
            f"{len(failed)} of {len(self.checks)} comparisons differ too much, first {first.equation} "
            f"({first.against}, {first.where}): {first.judged:.2g}, allowed {first.tolerance:g}"
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON object of `afm-jax verify`."""
        settings = {name: getattr(self, name) for name in ("seed", "states", "exact_states")}
        return {"checks": [asdict(check) for check in self.checks], "passed": self.reason is None, **settings}

    def printed(self) -> list[str | Table]:
        """Return the comparisons as a table, what the columns were held against, and the reasons, each once."""
        cells: dict[str, Cell] = {
            "equation": "equation",
            "against": "against",
            "where": "where",
            "points": "points:d",
            "worst rel. difference": "max_relative_difference:.1e",
            "in rounding": lambda check: "" if check.against == "autodiff" else known(check.judged, ".2g"),
            "passed": lambda check: {True: "yes", False: "NO", None: "not compared"}[check.passed],
        }
        limits = {check.against: check.tolerance for check in reversed(self.checks)}
        reasons = (f"{check.where}, {check.against}: {check.reason}." for check in self.checks if check.reason)
        allowed = (
            f"Allowed: {limits['autodiff']:g} against automatic differentiation (worse of forward and reverse); "
            f"{limits['50 digits']:g} times what rounding can do against 50 digits "
            f"(eq. 8: {max(check.tolerance for check in self.checks):g})."
        )
        return [printed_table("", cells, self.checks), allowed, *dict.fromkeys(reasons)]

    def tables(self) -> dict[str, dict[str, list[Any]]]:
        """Return the columns of verify.csv, a row a comparison."""
        return {"verify.csv": columns_of([asdict(check) for check in self.checks])}


def verify(*, states: int = 10_000, seed: int = 0, exact_states: int = 200) -> list[Check]:
    """Compare eqs. 5 to 8 with automatic differentiation, and both with 50 digits.

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
    return [_automatic_check(name + _KIND_NAMES[sample.kind], sample, name) for name in EQUATIONS]


def _orbit_checks(orbits: Sample) -> list[Check]:
    """Compare D and T of eq. 8 with determinant and trace of the automatic derivative."""
    names = ("D", "T") if orbits.kind == PAPER else ("D",)
    return [_automatic_check(f"eq. 8, {name}{_KIND_NAMES[orbits.kind]}", orbits, name) for name in names]


def _automatic_check(equation: str, sample: Sample, name: str) -> Check:
    written = jax.tree.map(lambda array: array[sample.ordinary], sample.written[name])
    automatic = sample.automatic[name][sample.ordinary]
    worst = [
        float(relative_difference(automatic[:, mode], written.value, written.scale).max()) for mode in range(len(MODES))
    ]
    return Check(
        equation=equation,
        against="autodiff",
        where="ordinary",
        points=int(sample.ordinary.sum()),
        max_relative_difference=max(worst),
        mode=MODES[int(np.argmax(worst))],
        tolerance=TOLERANCE,
        judged=max(worst),
        passed=max(worst) <= TOLERANCE,
    )


def _digits_checks(samples: list[Sample], where: str, wanted: int) -> list[Check]:
    """Compare automatic derivatives and formulas with 50 digits, at ordinary or at close states."""
    mp, reason = mpmath_or_reason()
    if mp is None:
        return [_digits_check(name, where, [], reason, ROUNDING_LIMIT) for name in EQUATIONS]
    differences: dict[str, list[Difference]] = {name: [] for name in EQUATIONS}
    left_out = 0
    for sample in samples:
        chosen = np.flatnonzero(sample.ordinary == (where == "ordinary"))[:wanted]
        decidable = chosen[EPSILON * sample.growth[chosen] < UNDECIDABLE]
        left_out += len(chosen) - len(decidable)
        rows = rows_of(sample, decidable)
        exact = [
            exact_impact(mp, row, start, float(arrival))
            for row, start, arrival in zip(*_plain_rows(rows.states), rows.arrival_us, strict=True)
        ]
        for name in EQUATIONS:
            differences[name].append(_difference(rows, name, np.array([impact[name] for impact in exact])))
    note = f"{left_out} states within rounding of capture or of a miss left out" if left_out else None
    return [_digits_check(name, where, differences[name], note, ROUNDING_LIMIT) for name in EQUATIONS]


def _orbit_digits_check(orbits: Sample, where: str, wanted: int) -> Check:
    """Compare the trace of eq. 8 and of the automatic derivative with 50 digits on the exact orbit."""
    mp, reason = mpmath_or_reason()
    if mp is None:
        return _digits_check("eq. 8, T", where, [], reason, ORBIT_ROUNDING_LIMIT)
    chosen = (orbits.ordinary == (where == "ordinary")) & (EPSILON * orbits.growth < UNDECIDABLE)
    rows = rows_of(orbits, np.flatnonzero(chosen)[:wanted])
    exact = []
    for row, (time, velocity), arrival in zip(*_plain_rows(rows.states), rows.arrival_us, strict=True):
        periods_per_us = float(row["drive_frequency_khz"]) / 1e3
        order, phase = round((arrival - time) * periods_per_us), 2.0 * np.pi * time * periods_per_us
        exact.append(exact_trace(mp, row, order, (phase, velocity)))
    return _digits_check("eq. 8, T", where, [_difference(rows, "T", np.array(exact))], None, ORBIT_ROUNDING_LIMIT)


class Difference(NamedTuple):
    """Largest difference of each state from 50 digits, over the formula's scale and over what rounding can do."""

    over_scale: Floats
    over_rounding: Floats


def _difference(sample: Sample, name: str, exact: Floats) -> Difference:
    """Return how far the worst of forward, reverse and written is from 50 digits."""
    written, automatic = sample.written[name], sample.automatic[name]
    exact = exact.reshape(written.value.shape)
    candidates = (automatic[:, 0], automatic[:, 1], written.value)
    return Difference(
        *(
            np.max([relative_difference(value, exact, unit) for value in candidates], axis=0)
            for unit in (written.scale, EPSILON * written.rounding)
        )
    )


def _plain_rows(states: States) -> tuple[list[dict[str, Any]], list[tuple[float, float]]]:
    """Return scenes as rows of plain numbers (a delay as a triple), None for absent effects, and their starts."""
    scene, law = states.scene, formula_of(states.scene)
    columns = {
        "frequency_khz": scene.cantilever.frequency_khz,
        "quality_factor": scene.cantilever.quality_factor,
        "amplitude_nm": scene.platform.amplitude_nm,
        "drive_frequency_khz": scene.platform.frequency_khz,
        "offset_nm": scene.platform.offset_nm,
        "r": law.r,
        "epsilon": law.epsilon,
        "viscous_loss": law.viscous_loss,
        "delay": None if law.delay is None else np.stack([law.delay.hertz, law.delay.lead_nm, law.delay.offset_nm], 1),
    }
    starts = [(float(time), float(velocity)) for time, velocity in zip(states.time_us, states.velocity, strict=True)]
    rows = [
        {name: None if column is None else np.asarray(column)[row] for name, column in columns.items()}
        for row in range(len(starts))
    ]
    return rows, starts


def _digits_check(equation: str, where: str, differences: list[Difference], reason: str | None, limit: float) -> Check:
    worst, judged, passed = None, None, None
    points = sum(len(part.over_scale) for part in differences)
    if points:
        worst, judged = (float(np.concatenate(parts).max()) for parts in zip(*differences, strict=True))
        passed = judged <= limit
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
        reason=reason if points or reason else "no such state among those drawn; ask for more",
    )


def draw_orbits(random: np.random.Generator, wanted: int, kind: Kind) -> Sample:
    """Return at least `wanted` ordinary orbits of random scenes, admissible and away from folds.

    A state is an orbit's impact; "D", without damping "T" too, stand beside determinant and trace of the map's
    automatic derivative.

    Raises:
        RuntimeError: if the search finds far fewer orbits than there are.
    """
    find = jax.jit(jax.vmap(single_impact_orbits))
    evaluate = written_formulas(paper=not kind.damped)
    eq8 = jax.jit(jax.vmap(_eq8 if not kind.damped else _damped_determinant))
    samples: list[Sample] = []
    blocks = 0
    while sum(int(sample.ordinary.sum()) for sample in samples) < wanted:
        blocks += 1
        if blocks > MOST_BLOCKS + 10 * wanted // BLOCK:
            raise RuntimeError(f"{blocks * BLOCK} random scenes have fewer than {wanted} single-impact orbits")
        scene, order = _random_scenes(random, kind)
        orbits = find(scene, order)
        # slot after slot, so that every batch has one shape
        for slot in range(orbits.exists.shape[1]):
            phase, after = orbits.phase_rad[:, slot], orbits.velocity_after_nm_per_us[:, slot]
            states = States(scene, np.asarray(phase / scene.platform.angular_frequency), np.asarray(after))
            sample = with_eq8(sample_at(states, kind, evaluate), eq8(states, order))
            samples.append(
                rows_of(sample, sample.exists & np.asarray(orbits.admissible & ~orbits.near_double)[:, slot])
            )
    return joined(samples)


def with_eq8(sample: Sample, eq8: dict[str, Written]) -> Sample:
    """Return a sample of orbits with eq. 8 and with determinant and trace of the automatic derivative."""
    automatic, written = np.asarray(sample.automatic["eqs. 5+7"]), sample.written["eqs. 5+7"]
    one, other = automatic[..., 0, 0] * automatic[..., 1, 1], automatic[..., 0, 1] * automatic[..., 1, 0]
    # a determinant of numbers cancels, besides what the formula's own terms do
    cancelled = np.max(np.abs(one) + np.abs(other), axis=1)
    determinant = eq8["D"]._replace(scale=eq8["D"].scale + cancelled)
    formulas_of_orbits = {"D": determinant}
    if "T" in eq8:
        rounding = eq8["T"].rounding + np.trace(written.rounding, axis1=1, axis2=2)
        formulas_of_orbits["T"] = eq8["T"]._replace(rounding=rounding)
    return sample._replace(
        automatic={"D": one - other, "T": automatic[..., 0, 0] + automatic[..., 1, 1]},
        written=formulas_of_orbits,
        ordinary=sample.ordinary & (sample.growth < WELL_CONDITIONED),
    )


def _eq8(state: States, order: Array) -> dict[str, Written]:
    """Evaluate D and T of eq. 8 at an orbit without damping, viscous loss and delay."""

    def determinant_and_trace(state: States) -> tuple[Array, Array]:
        scene, start, after = state
        end = start + order * scene.platform.period_us
        flight = formulas.paper_flight(scene.cantilever, scene.platform, start, after, end)
        return formulas.eq8(flight, after, formula_of(scene).r)

    return _with_scales(("D", "T"), determinant_and_trace, state)


def _damped_determinant(state: States, order: Array) -> dict[str, Written]:
    """D = (r^2 - c/(2 u_in)) exp(-Omega T/Q): the flight shrinks areas, the law by d(u_out^2)/d(u_in^2)."""

    def determinant(state: States) -> tuple[Array]:
        scene, start, after = state
        law = formula_of(scene)
        loss = law.viscous_loss / (2.0 * law.approach_speed(after - scene.platform.velocity(start)))
        shrinking = jnp.exp(-2.0 * scene.cantilever.decay_rate * order * scene.platform.period_us)
        return ((law.r**2 - loss) * shrinking,)

    return _with_scales(("D",), determinant, state)


def _with_scales(
    names: tuple[str, ...], formula: Callable[[States], tuple[Array, ...]], state: States
) -> dict[str, Written]:
    written = {}
    for name, value, slopes in zip(names, formula(state), jax.jacfwd(formula)(state), strict=True):
        scale = jnp.abs(value) + sum_of_terms(slopes, state)
        written[name] = Written(value, scale, scale)
    return written


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
