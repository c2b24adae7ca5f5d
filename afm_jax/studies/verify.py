"""Equations 5 to 8 of the paper against automatic differentiation of the impact map, over a seeded box of inputs.

The box holds the paper's scenes, undamped tips over a vibrating sample, and starts just after an impact. A third of the
scenes are driven within 1e-6 to 1e-2 of a resonance (omega/2 Omega an integer); a third have no adhesion, a third are
close to capture. Automatic differentiation, forward and reverse, uses nothing of the written formulas. Equation 8 holds
on single-impact orbits and is compared there. `tests` compare both, at fewer states, with fifty digits, and likewise
the formulas with air damping, viscous loss and a collision delay.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.checks import check_count, require_float64
from afm_jax.columns import CsvColumns, columns_of, csv_columns
from afm_jax.impact import jacobian as formulas
from afm_jax.impact.law import ImpactLaw
from afm_jax.impact.map import next_impact
from afm_jax.impact.orbits import single_impact_orbits
from afm_jax.outcomes import Outcome
from afm_jax.report import Cell, Section, sections, table_of
from afm_jax.results import Result, public_result
from afm_jax.saved import as_json
from afm_jax.units import RAD_PER_US_PER_KHZ

TOLERANCE = 1e-10
"""Largest difference over the scale of a formula."""
_FLIGHTS, _ORBITS = ("eq. 5", "eq. 6", "eq. 7", "eqs. 5+7"), ("eq. 8, D", "eq. 8, T")
_BLOCK = 2048
"""States computed at once."""
_MOST_BLOCKS = 60
_MOST_STEPS = 500
"""Of the search for an impact: a batch waits for its slowest flight, and some undamped ones never come back."""
_FLIGHT_CLEARANCE, _ORBIT_CLEARANCE = 3e-3, 3e-2
"""States with less, see `_differences`, are left out: rounding of what vanishes exceeds the tolerance there. An orbit
is known to the rounding of its search, a flight to that of its impact time."""

Floats = Float[np.ndarray, " states"]


class States(NamedTuple):
    """Scenes and starts, arrays of one value a state.

    ``time_us`` and ``velocity`` (lab, nm/us) just after an impact; ``order``: drive periods to the next one, of orbits.
    """

    scene: Scene
    time_us: Any
    velocity: Any
    order: Any


@dataclass(frozen=True)
class Check:
    """One line of the verification."""

    equation: str
    points: int
    """States compared."""
    max_relative_difference: float
    """Largest difference over the formula's scale |f| + sum |x df/dx|, x the numbers of scene and start."""
    passed: bool


@public_result()
@dataclass(frozen=True)
class Verification(Result):
    """All comparisons, and the states they were made at."""

    checks: list[Check]
    states: int
    seed: int

    @property
    def reason(self) -> str | None:
        """Which comparison differs too much; None where none does."""
        failed = [
            f"{check.equation} by {check.max_relative_difference:.2g}" for check in self.checks if not check.passed
        ]
        return f"equations differ by more than {TOLERANCE:g}: {', '.join(failed)}" if failed else None


@as_json.register
def _(result: Verification) -> dict[str, Any]:
    return vars(result) | {"passed": result.reason is None, "tolerance": TOLERANCE}


@sections.register
def _(result: Verification) -> list[Section]:
    cells: dict[str, Cell] = {
        "equation": "equation",
        "points": "points:d",
        "worst rel. difference": "max_relative_difference:.1e",
        "passed": lambda check: "yes" if check.passed else "NO",
    }
    allowed = f"Allowed: {TOLERANCE:g} from automatic differentiation, the worse of forward and reverse."
    return [Section("", [table_of(cells, result.checks), allowed])]


@csv_columns.register
def _(result: Verification) -> CsvColumns:
    return {"verify.csv": columns_of([vars(check) for check in result.checks])}


def verify(*, states: int = 10_000, seed: int = 0) -> Verification:
    """Compare eqs. 5 to 8 with automatic differentiation.

    Args:
        states: random states, and orbits, of each kind that are compared, at least.
        seed: of the random states; the same seed gives the same result.

    Raises:
        RuntimeError: if JAX is not set to 64-bit floats, or the map finds far fewer impacts than there are.
        ValueError: if the number of states is not positive.
    """
    require_float64()
    check_count("states", states)
    return Verification(checks_of(states, seed), states, seed)


def checks_of(states: int, seed: int) -> list[Check]:
    """Return the comparisons."""
    # compiled anew every time: a formula that was changed in between, as tests do, is the one that is compared
    compare, found = jax.jit(jax.vmap(_differences)), {}
    for draw, names, clearance in ((_flights, _FLIGHTS, _FLIGHT_CLEARANCE), (_orbits, _ORBITS, _ORBIT_CLEARANCE)):
        worst = _worst(compare, draw(np.random.default_rng(seed)), states, clearance)
        found |= {name: worst[name] for name in names}
    largest = {name: float(differences.max()) for name, differences in found.items()}
    return [Check(name, len(found[name]), each, each <= TOLERANCE) for name, each in largest.items()]


def _worst(
    compare: Callable[..., Any], drawn: Iterator[States], wanted: int, least_clearance: float
) -> dict[str, Floats]:
    """Return the differences of at least so many states that are clear enough, by the equations' names."""
    blocks, count = [], 0
    for number, states in enumerate(drawn):
        if number > _MOST_BLOCKS + 10 * wanted // _BLOCK:
            raise RuntimeError(f"{number * _BLOCK} random states hold fewer than {wanted} impacts to compare")
        clearance, differences = jax.tree.map(np.asarray, compare(*states))
        clear = clearance > least_clearance
        blocks.append({name: difference[clear] for name, difference in differences.items()})
        count += int(clear.sum())
        if count >= wanted:
            break
    return {name: np.concatenate([block[name] for block in blocks]) for name in blocks[0]}


# --- the box of inputs ------------------------------------------------------------------------------------------------


def _scenes(random: np.random.Generator) -> tuple[Scene, Floats]:
    """Return a block of scenes, and for each the order of the resonance that is nearest."""

    def between(low: float, high: float) -> Floats:
        return random.uniform(low, high, _BLOCK)

    order = random.integers(1, 7, _BLOCK) * 1.0
    near = order + random.choice([-1.0, 1.0], _BLOCK) * _spread(random, 1e-6, 1e-2)
    reduced = np.where(random.random(_BLOCK) < 1.0 / 3.0, near, order * between(0.5, 1.2))
    frequency = _spread(random, 40.0, 200.0)
    law = ImpactLaw(
        r=between(0.3, 0.999),
        epsilon=_spread(random, 1e-2, 100.0) * (random.random(_BLOCK) < 0.6),
        viscous_loss=0.0 * order,
    )
    platform = Platform(_spread(random, 0.2, 20.0), 2.0 * reduced * frequency, between(-20.0, 5.0), 0.0 * order)
    return Scene(Cantilever(frequency, None, np.ones(_BLOCK)), platform, law), order


def _spread(random: np.random.Generator, low: float, high: float) -> Floats:
    """Return numbers spread evenly in their logarithm."""
    return np.exp(random.uniform(np.log(low), np.log(high), _BLOCK))


def _flights(random: np.random.Generator) -> Iterator[States]:
    """Yield blocks of starts; epsilon is nothing, any share of what captures the tip, or nearly all of it."""
    find = jax.jit(jax.vmap(partial(next_impact, max_steps=_MOST_STEPS)))
    while True:
        scene, order = _scenes(random)
        top_speed = np.asarray(scene.platform.top_speed_nm_per_us)
        turn = random.uniform(0.0, 2.0 * np.pi, _BLOCK)
        time = turn / (RAD_PER_US_PER_KHZ * np.asarray(scene.platform.frequency_khz))
        velocity = _spread(random, 0.05, 300.0) - top_speed * np.sin(turn)
        scene = _with_epsilon(scene, np.zeros(_BLOCK))
        impact = find(scene, time, velocity)
        # the impact does not depend on epsilon, which acts only afterwards
        squared = np.asarray(impact.velocity_after_nm_per_us - scene.platform.velocity(impact.time_us)) ** 2
        any_share, nearly = random.random(_BLOCK), 1.0 - _spread(random, 1e-9, 1.0)
        share = np.choose(random.integers(0, 3, _BLOCK), [np.zeros(_BLOCK), any_share, nearly])
        hit = np.asarray(impact.outcome) == Outcome.IMPACT
        # an invalid start in place of a flight that does not come back: nothing waits for it any more
        yield States(
            _with_epsilon(scene, np.where(hit, share * squared, 0.0)), time, np.where(hit, velocity, np.nan), order
        )


def _with_epsilon(scene: Scene, epsilon: Floats) -> Scene:
    return eqx.tree_at(lambda one: one.interaction.epsilon, scene, jnp.asarray(epsilon))


def _orbits(random: np.random.Generator) -> Iterator[States]:
    """Yield blocks of single-impact orbits, admissible and away from folds; an invalid start where there is none."""
    find = jax.jit(jax.vmap(single_impact_orbits))
    while True:
        scene, order = _scenes(random)
        orbits = find(scene, order)
        good = np.asarray(orbits.admissible & ~orbits.near_double)
        for slot in range(good.shape[1]):
            time = np.asarray(orbits.phase_rad[:, slot] / scene.platform.angular_frequency)
            velocity = np.asarray(orbits.velocity_after_nm_per_us[:, slot])
            yield States(scene, time, np.where(good[:, slot], velocity, np.nan), order)


# --- one state --------------------------------------------------------------------------------------------------------


def _differences(scene: Scene, time: Array, velocity: Array, order: Array) -> tuple[Array, dict[str, Array]]:
    """Return the clearance of a state, and how far each formula is from automatic differentiation, over its scale.

    The clearance is the smaller of u/(beta omega), which vanishes at grazing, and u_out/(r u), which vanishes at
    capture; 0 where the tip does not leave again.
    """
    law, platform = scene.interaction, scene.platform
    (forward, impact), (reverse, _) = (
        mode(_whole_map, has_aux=True)(jnp.stack([time, velocity]), scene) for mode in (jax.jacfwd, jax.jacrev)
    )
    whole = jnp.stack([forward, reverse])
    hit = impact.outcome == Outcome.IMPACT
    # rows without an impact are computed with some harmless state
    arrival = jnp.where(hit, impact.arrival_time_us, time)
    before = jnp.where(hit, impact.velocity_before_nm_per_us, 0.0)
    approach = platform.velocity(arrival) - before
    squared = law.r**2 * approach**2 - law.epsilon
    rebound_share = jnp.sqrt(jnp.maximum(squared, 0.0)) / (law.r * approach)
    shares = jnp.minimum(approach / platform.top_speed_nm_per_us, rebound_share)
    clearance = jnp.where(hit, shares, 0.0)

    def both(function: Callable[[Array], Array], at: list[Array]) -> Array:
        return jnp.stack([mode(function)(jnp.stack(at)) for mode in (jax.jacfwd, jax.jacrev)])

    rebound = impact.velocity_after_nm_per_us - platform.velocity(impact.time_us)
    slopes = both(lambda x: ImpactLaw(*x[1:]).rebound_speed(x[0]), [approach, law.r, law.epsilon])
    chained = whole[:, 2:]
    products = chained[:, 0, 0] * chained[:, 1, 1], chained[:, 0, 1] * chained[:, 1, 0]
    automatic = {
        "eq. 5": whole[:, :2],
        "eq. 6": jnp.concatenate([jnp.broadcast_to(rebound, (2, 1)), slopes], axis=1),
        "eq. 7": both(partial(_law_step, law, platform), [arrival, before]),
        "eqs. 5+7": chained,
        "eq. 8, D": products[0] - products[1],
        "eq. 8, T": chained[:, 0, 0] + chained[:, 1, 1],
    }
    written, scale = _with_scale(partial(_formulas, arrival=arrival, order=order), (scene, time, velocity))
    # `map_jacobian` finds the impact itself; a determinant of numbers cancels, besides what the formula's terms do
    written["eqs. 5+7"] = formulas.map_jacobian(scene, time, velocity)
    scale["eq. 8, D"] += jnp.max(jnp.abs(products[0]) + jnp.abs(products[1]))
    return clearance, {name: _relative(automatic[name], written[name], scale[name]) for name in written}


def _whole_map(start: Float[Array, " 2"], scene: Scene) -> tuple[Float[Array, " 4"], Any]:
    impact = next_impact(scene, start[0], start[1], max_steps=_MOST_STEPS)
    ends = [impact.arrival_time_us, impact.velocity_before_nm_per_us, impact.time_us, impact.velocity_after_nm_per_us]
    return jnp.stack(ends), impact


def _law_step(law: ImpactLaw, platform: Platform, arriving: Float[Array, " 2"]) -> Float[Array, " 2"]:
    """Return (t_out, V') for (t_in, V): what an impact does, in us and nm/us (eq. 6)."""
    arrival, before = arriving
    moving = platform.velocity(arrival)
    return jnp.stack([arrival, moving + law.rebound_speed(moving - before)])


def _formulas(state: tuple[Scene, Array, Array], *, arrival: Array, order: Array) -> dict[str, Array]:
    """Evaluate the written formulas."""
    scene, start, velocity = state
    law, platform = scene.interaction, scene.platform
    before = scene.cantilever.propagator(arrival - start)(platform.position(start), velocity)[1]
    approach = platform.velocity(arrival) - before
    flight = formulas.paper_flight(scene.cantilever, platform, start, velocity, arrival)
    eq5, eq7 = formulas.eq5(flight), formulas.eq7(flight, before, law.r, law.epsilon)
    orbit = formulas.paper_flight(scene.cantilever, platform, start, velocity, start + order * platform.period_us)
    determinant, trace = formulas.eq8(orbit, velocity, law.r)
    rebound = jnp.sqrt(law.r**2 * approach**2 - law.epsilon)
    half = 0.5 / rebound
    eq6 = jnp.stack([rebound, 2.0 * law.r**2 * approach * half, 2.0 * law.r * approach**2 * half, -half])
    # as `map_jacobian` has them
    chained = formulas.impact_jacobian(law, platform, arrival, before)
    chained = chained @ formulas.flight_jacobian(scene.cantilever, platform, start, velocity, arrival)
    return {"eq. 5": eq5, "eq. 6": eq6, "eq. 7": eq7, "eqs. 5+7": chained, "eq. 8, D": determinant, "eq. 8, T": trace}


def _with_scale(formula: Callable[[Any], dict[str, Array]], state: Any) -> tuple[dict[str, Array], dict[str, Array]]:
    """Return values f and their scales |f| + sum |x df/dx| over the numbers x of a state."""
    values, scales = formula(state), {}
    for name, slopes in jax.jacfwd(formula)(state).items():
        terms = jax.tree.map(lambda slope, number: jnp.abs(slope * number), slopes, state)
        scales[name] = jnp.abs(values[name]) + jax.tree.reduce(jnp.add, terms)
    return values, scales


def _relative(automatic: Array, written: Array, scale: Array) -> Array:
    """Return the largest |difference| over its scale; where that is 0 both must be equal, and NaN is infinite."""
    difference = jnp.abs(automatic - written)
    relative = jnp.where(difference == 0.0, 0.0, difference / scale)
    return jnp.max(jnp.where(jnp.isnan(relative), jnp.inf, relative))
