"""Random states with everything that is compared at them: automatic derivatives, written formulas, their terms."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from afm_jax.apparatus.scene import Scene
from afm_jax.impact import jacobian as formulas
from afm_jax.impact.law import impact_law_of, squared_rebound_speed
from afm_jax.study.formula_terms import eq5_terms, eq6_slopes, eq7_terms, flight_terms, impact_terms
from afm_jax.study.verification_autodiff import Automatic, differentiate
from afm_jax.study.verification_condition import condition_number, is_away, is_ordinary
from afm_jax.study.verification_states import Floats, Kind, States, random_states, with_adhesion

BLOCK = 2048
"""States computed at once: few enough for a processor's cache; every block has this shape, so that one compilation
serves any number of states."""
MOST_BLOCKS = 20


class Pair(NamedTuple):
    """A formula's value and the sum of the magnitudes of its terms, arrays of shape (states, ...)."""

    value: Any
    terms: Any


class Sample(NamedTuple):
    """States of one kind whose next impact exists, arrays of shape (states, ...).

    ``ordinary``: neither close to capture or grazing, nor to both at once; see `is_ordinary`. ``away``: not close to
    one of them alone. ``condition``: see `condition_number`. ``written``: by name
    ("eq. 5", ...) the written formula's `Pair`.
    """

    kind: Kind
    states: States
    automatic: Automatic
    written: dict[str, Pair]
    ordinary: NDArray[np.bool_]
    away: NDArray[np.bool_]
    condition: Floats


def draw_sample(random: np.random.Generator, wanted: int, kind: Kind) -> Sample:
    """Return a sample with at least `wanted` ordinary states, and the close ones that came with them.

    Raises:
        RuntimeError: if the impact map finds far fewer impacts than there are.
    """
    evaluate = formula_evaluator(kind)
    blocks: list[Sample] = []
    while sum(int(block.ordinary.sum()) for block in blocks) < wanted:
        if len(blocks) > MOST_BLOCKS + 3 * wanted // BLOCK:
            raise RuntimeError(f"{len(blocks) * BLOCK} random states hold fewer than {wanted} ordinary impacts")
        states = random_states(random, BLOCK, kind)
        states = with_adhesion(random, states, np.asarray(differentiate(*states).approach))
        automatic = differentiate(*states)
        written = evaluate(states, automatic)
        rows = np.asarray(automatic.hit)
        with np.errstate(all="ignore"):  # rows without an impact
            judged = is_ordinary(states.scene, automatic), is_away(states.scene, automatic)
            block = Sample(kind, states, automatic, written, *judged, condition_number(states, automatic))
        blocks.append(_take(block, rows))
    return _join(blocks)


def formula_evaluator(kind: Kind) -> Callable[[States, Automatic], dict[str, Pair]]:
    """Return a function that evaluates the written formulas of a kind at a batch of impacts.

    It is compiled anew for every verification, so that a formula changed in between (as tests do) is the one checked.
    """
    compiled = jax.jit(jax.vmap(_paper_formulas if not kind.damped else _general_formulas))
    chained = jax.jit(jax.vmap(formulas.map_jacobian))

    def evaluate(states: States, automatic: Automatic) -> dict[str, Pair]:
        written = compiled(states, automatic)
        whole = chained(*states)
        return {name: pair._replace(value=whole) if name == "eqs. 5+7" else pair for name, pair in written.items()}

    return evaluate


def _paper_formulas(state: States, impact: Automatic) -> dict[str, Pair]:
    """Evaluate the paper's formulas as printed at one impact."""
    scene, time, velocity = state
    law = impact_law_of(scene)
    flight = formulas.paper_flight(scene.cantilever, scene.platform, time, velocity, impact.arrival_us)
    terms5, terms7 = eq5_terms(flight, time, impact.arrival_us), eq7_terms(flight, impact.before, law.r, law.epsilon)
    general = _general_formulas(state, impact)
    return {
        "eq. 5": Pair(formulas.eq5(flight), terms5),
        "eq. 6": general["eq. 6"],
        "eq. 7": Pair(formulas.eq7(flight, impact.before, law.r, law.epsilon), terms7),
        "eqs. 5+7": Pair(terms7, terms7 @ terms5),
    }


def _general_formulas(state: States, impact: Automatic) -> dict[str, Pair]:
    """Evaluate the formulas with damping, viscous loss and delay at one impact."""
    scene, time, velocity = state
    law = impact_law_of(scene)
    flight = scene.cantilever, scene.platform, time, velocity, impact.arrival_us
    arriving = law, scene.platform, impact.arrival_us, impact.before
    terms5, terms7 = flight_terms(*flight), impact_terms(*arriving)
    return {
        "eq. 5": Pair(formulas.flight_jacobian(*flight), terms5),
        "eq. 6": _eq6(scene, impact),
        "eq. 7": Pair(formulas.impact_jacobian(*arriving), terms7),
        "eqs. 5+7": Pair(terms7, terms7 @ terms5),  # the value is `map_jacobian`'s, which finds the impact itself
    }


def _eq6(scene: Scene, impact: Automatic) -> Pair:
    """Return u_out of eq. 6 and its four slopes, shape (5,)."""
    law = impact_law_of(scene)
    square = squared_rebound_speed(impact.approach, law.r, law.epsilon, law.viscous_loss)
    slopes, terms = eq6_slopes(impact.approach, law)
    moving = jnp.abs(impact.after) + jnp.abs(scene.platform.velocity(impact.leaving_us))
    return Pair(jnp.concatenate([jnp.sqrt(square)[None], slopes]), jnp.concatenate([moving[None], terms]))


def automatic_values(sample: Sample) -> dict[str, Floats]:
    """Return by equation what automatic differentiation gives, the second axis being the mode."""
    automatic = sample.automatic
    rebound = np.asarray(automatic.rebound)
    both = np.stack([rebound, rebound], axis=1)[..., None]
    return {
        "eq. 5": np.asarray(automatic.flight),
        "eq. 6": np.concatenate([both, np.asarray(automatic.slopes)], axis=-1),
        "eq. 7": np.asarray(automatic.law),
        "eqs. 5+7": np.asarray(automatic.chained),
    }


def relative_difference(value: Floats, exact: Floats, terms: Floats) -> Floats:
    """Return |value - exact| over the terms' sum, the largest of each state: shape (states,).

    Where a formula has no terms the value must be exactly its own; what is not a number counts as infinitely wrong.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        difference = np.abs(value - exact)
        relative = np.where(difference == 0.0, 0.0, difference / terms)
    return np.where(np.isnan(relative), np.inf, relative).reshape(len(value), -1).max(axis=1, initial=0.0)


def _take(sample: Sample, rows: NDArray[np.bool_]) -> Sample:
    return Sample(sample.kind, *jax.tree.map(lambda array: np.asarray(array)[rows], tuple(sample[1:])))


def _join(samples: list[Sample]) -> Sample:
    parts = [tuple(sample[1:]) for sample in samples]
    return Sample(samples[0].kind, *jax.tree.map(lambda *arrays: np.concatenate(arrays), *parts))
