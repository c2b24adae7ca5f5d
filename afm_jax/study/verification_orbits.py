"""Equation 8 at single-impact orbits of random scenes, against the map's automatic derivative there."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.impact import jacobian as formulas
from afm_jax.impact.law import ImpactLaw, impact_law_of
from afm_jax.impact.orbits import single_impact_orbits
from afm_jax.study.formula_terms import eq8_trace_terms
from afm_jax.study.verification_autodiff import differentiate
from afm_jax.study.verification_condition import condition_number, is_ordinary
from afm_jax.study.verification_samples import BLOCK, Pair
from afm_jax.study.verification_states import Floats, Kind, States, logarithmic, near_integer

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
    law = impact_law_of(scene)
    end = start + order * scene.platform.period_us
    flight = formulas.paper_flight(scene.cantilever, scene.platform, start, after, end)
    determinant, trace = formulas.eq8(flight, after, law.r)
    return {"D": Pair(determinant, law.r**2), "T": Pair(trace, eq8_trace_terms(flight, after, law.r))}


def _damped_determinant(state: States, order: Any) -> dict[str, Pair]:
    """D = (r^2 - c/(2 u_in)) exp(-Omega T/Q): the flight shrinks areas, the law by d(u_out^2)/d(u_in^2)."""
    scene, start, after = state
    law = impact_law_of(scene)
    rebound = after - scene.platform.velocity(start)
    loss = law.viscous_loss / (2.0 * law.approach_speed(rebound))
    kept = jnp.exp(-2.0 * scene.cantilever.decay_rate * order * scene.platform.period_us)
    return {"D": Pair((law.r**2 - loss) * kept, (law.r**2 + loss) * kept)}


def _take(sample: OrbitSample, rows: NDArray[np.bool_]) -> OrbitSample:
    return OrbitSample(*jax.tree.map(lambda array: np.asarray(array)[rows], tuple(sample)))
