"""Random states with everything that is compared at them: automatic derivatives, written formulas, rounding errors.

A state is a scene, a start just after an impact, and the impact that follows, with the hard corners on purpose. They
are drawn in turn: ordinary; near resonance (omega/2 Omega within 1e-6 to 1e-2 of an integer); near grazing (offset and
velocity solved such that the tip meets the platform at a chosen, small relative speed: both conditions are linear in
them). In each of them epsilon is 0, or of any size, or just short of capturing the tip.

At each state stand the impact map's derivatives by automatic differentiation, forward and reverse, which use nothing of
the written formulas; the written formulas; and how far rounding alone can move these (`written_formulas`): the sum of
|x df/dx| over the numbers x that a formula f takes, in units of the machine epsilon.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from numpy.typing import NDArray

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.impact import jacobian as formulas
from afm_jax.impact.first_impact import DEFAULT_ROOT_TOLERANCE_US
from afm_jax.impact.law import CollisionDelay, ImpactLaw, formula_of, squared_rebound_speed
from afm_jax.impact.map import NextImpact, next_impact
from afm_jax.outcomes import Outcome
from afm_jax.units import RAD_PER_US_PER_KHZ

Floats = NDArray[np.float64]

LOWEST_OFFSET_NM, HIGHEST_OFFSET_NM = -20.0, 5.0
FAMILIES = ("ordinary", "near resonance", "near grazing")


class Kind(NamedTuple):
    """What a scene has besides the paper's: air damping, viscous loss with it, and a collision delay."""

    damped: bool
    delayed: bool


PAPER, DAMPED, DELAYED = (
    Kind(damped=False, delayed=False),
    Kind(damped=True, delayed=False),
    Kind(damped=True, delayed=True),
)


class States(NamedTuple):
    """Scenes and starts, every array of shape (states,): time in us, lab velocity just after an impact in nm/us."""

    scene: Scene
    time_us: Any
    velocity: Any


def random_states(random: np.random.Generator, count: int, kind: Kind) -> States:
    """Return states without adhesion; `with_adhesion` adds it once the approach speeds are known.

    Args:
        random: source of randomness.
        count: how many; their shape is always (count,), whether the tip comes back or not.
        kind: which effects the scenes have.
    """
    family = np.arange(count) % len(FAMILIES)
    frequency = logarithmic(random, 40.0, 200.0, count)
    reduced = np.where(family == 1, near_integer(random, count), random.uniform(0.3, 6.0, count))
    quality = logarithmic(random, 2.0, 1e4, count) if kind.damped else None
    amplitude = logarithmic(random, 0.2, 20.0, count)
    offset = random.uniform(LOWEST_OFFSET_NM, HIGHEST_OFFSET_NM, count)
    drive = 2.0 * reduced * frequency * RAD_PER_US_PER_KHZ
    time = random.uniform(0.0, 2.0 * np.pi, count) / drive
    velocity = logarithmic(random, 0.05, 300.0, count) - amplitude * drive * np.sin(drive * time)
    touching = _touching(random, (frequency, quality, amplitude, drive, time))
    offset, velocity = (np.where(family == 2, new, old) for new, old in zip(touching, (offset, velocity), strict=True))
    delay = CollisionDelay(
        *(scale * random.uniform(0.0, 1.5, count) for scale in (0.206, 5.64, 0.726)), corrections=False
    )
    law = ImpactLaw(
        r=random.uniform(0.3, 1.0, count),
        epsilon=np.zeros(count),
        viscous_loss=logarithmic(random, 1e-3, 1.0, count) * kind.damped * (random.random(count) < 0.7),
        delay=delay if kind.delayed else None,
    )
    platform = Platform(amplitude, 2.0 * reduced * frequency, offset, np.zeros(count))
    return States(Scene(Cantilever(frequency, quality, np.ones(count)), platform, law), time, velocity)


def with_adhesion(random: np.random.Generator, states: States, approach_speed: Floats) -> States:
    """Return the states with epsilon: a third none, a third any, a third (1 - x) of what captures, x = 1e-9 to 1.

    Args:
        random: source of randomness.
        states: their impacts do not depend on epsilon, which acts only afterwards.
        approach_speed: u_in at their impacts in nm/us; NaN where there is none.
    """
    law = states.scene.interaction
    assert isinstance(law, ImpactLaw)  # noqa: S101
    count = len(approach_speed)
    energy = (np.asarray(law.r) * approach_speed) ** 2
    some = energy * random.uniform(0.0, 1.0, count)
    nearly = energy * (1.0 - logarithmic(random, 1e-9, 1.0, count)) - np.asarray(law.viscous_loss) * approach_speed
    chosen = np.choose(random.integers(0, 3, count), [np.zeros(count), some, nearly])
    epsilon = np.where(np.isfinite(chosen), np.maximum(chosen, 0.0), 0.0)
    law = ImpactLaw(r=law.r, epsilon=epsilon, viscous_loss=law.viscous_loss, delay=law.delay)
    # An invalid start in place of a flight that does not come back: nothing waits for it any more.
    velocity = np.where(np.isfinite(approach_speed), states.velocity, np.nan)
    return States(Scene(states.scene.cantilever, states.scene.platform, law), states.time_us, velocity)


def logarithmic(random: np.random.Generator, low: float, high: float, count: int) -> Floats:
    """Return numbers spread evenly in their logarithm."""
    return np.exp(random.uniform(np.log(low), np.log(high), count))


def near_integer(random: np.random.Generator, count: int) -> Floats:
    """Return numbers within 1e-6 to 1e-2 of 1 to 6, on either side."""
    side = random.choice([-1.0, 1.0], count)
    return random.integers(1, 7, count) + side * logarithmic(random, 1e-6, 1e-2, count)


def _touching(random: np.random.Generator, system: tuple[Floats, Floats | None, Floats, Floats, Floats]):
    """Return offset (nm) and start velocity (nm/us) of flights that close in slowly at a later time.

    Of eight later times and closing speeds for every system the first is taken that has a fitting offset; where there
    is none the velocity is NaN, which `next_impact` calls an invalid start.
    """
    frequency, quality, amplitude, drive, start = (None if part is None else part[:, None] for part in system)
    assert frequency is not None and amplitude is not None and drive is not None and start is not None  # noqa: PT018, S101
    shape = len(frequency), 8
    free = RAD_PER_US_PER_KHZ * frequency
    decay = np.zeros_like(free) if quality is None else 0.5 * free / quality
    duration = random.uniform(0.1, 1.5, shape) * 2.0 * np.pi / free
    speed = amplitude * drive * np.exp(random.uniform(np.log(1e-6), 0.0, shape))
    offset, velocity = _start_for(duration, speed, (free, decay, amplitude, drive, start))
    leaving = velocity + amplitude * drive * np.sin(drive * start)
    fits = (offset > LOWEST_OFFSET_NM) & (offset < HIGHEST_OFFSET_NM) & (leaving > 0.0) & (velocity < 500.0)
    chosen = np.arange(shape[0]), np.argmax(fits, axis=1)
    return np.where(fits[chosen], offset[chosen], 0.0), np.where(fits[chosen], velocity[chosen], np.nan)


def _start_for(duration: Floats, approach: Floats, system: tuple[Floats, Floats, Floats, Floats, Floats]):
    """Solve for offset and start velocity, given when and how fast the tip closes in.

    (p11 - 1) sigma + p12 V' = z_p~(t2) - p11 z_p~(t1) and p21 sigma + p22 V' = v_p(t2) - u - p21 z_p~(t1), with z_p~
    the platform without its offset.
    """
    free, decay, amplitude, drive, start = system
    ringing = np.sqrt(free**2 - decay**2)
    shrink = np.exp(-decay * duration)
    cosine, sine = shrink * np.cos(ringing * duration), shrink * np.sin(ringing * duration) / ringing
    p11, p12, p21, p22 = cosine + decay * sine, sine, -(free**2) * sine, cosine - decay * sine
    end = start + duration
    here, there = amplitude * np.cos(drive * start), amplitude * np.cos(drive * end)
    gap = there - p11 * here
    fall = -amplitude * drive * np.sin(drive * end) - approach - p21 * here
    determinant = (p11 - 1.0) * p22 - p12 * p21
    return (gap * p22 - p12 * fall) / determinant, ((p11 - 1.0) * fall - p21 * gap) / determinant


MAX_STEPS = 500
"""Steps of the search for an impact: a batch waits for its slowest flight, and some undamped ones never come back."""


class Automatic(NamedTuple):
    """One impact and its derivatives; the first axis of a derivative is the mode (forward, reverse).

    ``arrival_us``: of the impact. ``hit``: the tip leaves again. ``approach``: u_in in nm/us. ``margin``:
    (r^2 u^2 - c u - epsilon)/(r^2 u^2). ``flight``: d(t2, V2)/d(t1, V1'). ``law``: d(t_out, V')/d(t2, V2).
    ``chained``: d(t_out, V')/d(t1, V1'). ``rebound``: u_out = V' - v_p(t_out) and d u_out/d(u_in, r, epsilon, c).
    """

    arrival_us: Float[Array, "..."]
    hit: Bool[Array, "..."]
    approach: Float[Array, "..."]
    margin: Float[Array, "..."]
    flight: Float[Array, "... 2 2 2"]
    law: Float[Array, "... 2 2 2"]
    chained: Float[Array, "... 2 2 2"]
    rebound: Float[Array, "... 2 5"]


def law_step(arriving: Float[Array, " 2"], law: ImpactLaw, platform: Platform) -> Float[Array, " 2"]:
    """Return (t_out, V') for (t_in, V): what an impact does, in us and nm/us (eq. 6, with the delay)."""
    arrival, before = arriving
    approach = platform.velocity(arrival) - before
    leaving = arrival + law.collision_delay(approach)
    return jnp.stack([leaving, platform.velocity(leaving) + law.rebound_speed(approach)])


def _whole_map(start: Float[Array, " 2"], scene: Scene) -> tuple[Float[Array, " 4"], NextImpact]:
    impact = next_impact(scene, start[0], start[1], max_steps=MAX_STEPS)
    ends = [impact.arrival_time_us, impact.velocity_before_nm_per_us, impact.time_us, impact.velocity_after_nm_per_us]
    return jnp.stack(ends), impact


def _rebound_speed(parameters: Float[Array, " 4"]) -> Float[Array, ""]:
    approach, r, epsilon, viscous_loss = parameters
    return ImpactLaw(r=r, epsilon=epsilon, viscous_loss=viscous_loss).rebound_speed(approach)


def _differentiate(scene: Scene, time: Float[Array, ""], velocity: Float[Array, ""]) -> Automatic:
    start = jnp.stack([time, velocity])
    law, platform = formula_of(scene), scene.platform
    forward, impact = jax.jacfwd(_whole_map, has_aux=True)(start, scene)
    reverse, _ = jax.jacrev(_whole_map, has_aux=True)(start, scene)
    whole = jnp.stack([forward, reverse])
    hit = impact.outcome == Outcome.IMPACT
    # Rows without an impact are computed with some harmless state and left out later.
    arrival = jnp.where(hit, impact.arrival_time_us, time)
    before = jnp.where(hit, impact.velocity_before_nm_per_us, 0.0)
    approach = platform.velocity(arrival) - before
    arriving = jnp.stack([arrival, before])
    parameters = jnp.stack([approach, law.r, law.epsilon, law.viscous_loss])
    rebound = impact.velocity_after_nm_per_us - platform.velocity(impact.time_us)
    slopes = [mode(_rebound_speed)(parameters) for mode in (jax.jacfwd, jax.jacrev)]
    return Automatic(
        arrival_us=arrival,
        hit=hit,
        approach=jnp.where(jnp.isfinite(impact.arrival_time_us), approach, jnp.nan),
        margin=squared_rebound_speed(approach, law.r, law.epsilon, law.viscous_loss) / (law.r * approach) ** 2,
        flight=whole[:, :2],
        law=jnp.stack([mode(law_step)(arriving, law, platform) for mode in (jax.jacfwd, jax.jacrev)]),
        chained=whole[:, 2:],
        rebound=jnp.stack([jnp.concatenate([rebound[None], slope]) for slope in slopes]),
    )


differentiate = jax.jit(jax.vmap(_differentiate))
"""`Automatic` of a batch of scenes, start times (us) and lab velocities just after impact (nm/us)."""


EPSILON = float(np.finfo(np.float64).eps)
CLOSE_TO_CAPTURE = 1e-5
CLOSE_TO_GRAZING = 1e-3


class Written(NamedTuple):
    """A written formula f at an impact; arrays of shape (states, ...).

    ``value``: f. ``scale``: |f| + sum |x df/dx| over scene, start time and start velocity, each number x apart, at the
    impact time as it is: relative differences are measured in it. ``rounding``: what the error of the impact time adds
    included; times the machine epsilon it is what rounding can do.
    """

    value: Any
    scale: Any
    rounding: Any


def written_formulas(paper: bool) -> Callable[[States, Automatic], dict[str, Written]]:  # noqa: FBT001
    """Return a function that evaluates the written formulas at a batch of impacts, as printed or with every effect.

    "approach" and "squared rebound" are the numbers that vanish at grazing and at capture. The function is compiled
    anew for every verification, so that a formula changed in between (as tests do) is the one checked.
    """
    compiled = jax.jit(jax.vmap(partial(_written, _as_printed if paper else _with_every_effect)))
    chained = jax.jit(jax.vmap(formulas.map_jacobian))

    def evaluate(states: States, automatic: Automatic) -> dict[str, Written]:
        written = compiled(states, automatic.arrival_us)
        # `map_jacobian` finds the impact itself
        return written | {"eqs. 5+7": written["eqs. 5+7"]._replace(value=chained(*states))}

    return evaluate


def _written(of: Callable[..., dict[str, Array]], state: States, arrival: Float[Array, ""]) -> dict[str, Written]:
    """Evaluate formulas of (state, impact time) with their sensitivities to every number in the state and to the time.

    The impact time is known to its own rounding, to the tolerance of its search, and to what rounding makes of the
    distance between tip and platform, over the closing velocity (eq. 3).
    """
    values = of(state, arrival)
    slopes = jax.jacfwd(of, argnums=(0, 1))(state, arrival)
    closing = jnp.abs(values["approach"])
    time = (
        jnp.abs(arrival)
        + DEFAULT_ROOT_TOLERANCE_US / EPSILON
        + sum_of_terms(jax.grad(_gap)(state, arrival), state) / closing
    )
    written = {}
    for name, value in values.items():
        by_state, by_time = slopes[name]
        scale = jnp.abs(value) + sum_of_terms(by_state, state)
        written[name] = Written(value, scale, scale + jnp.abs(by_time) * time)
    return written


def sum_of_terms(slopes: States, state: States) -> Array:
    """Return sum |x df/dx| over the numbers x of a state, from the derivatives df/dx."""
    terms = jax.tree.map(lambda slope, number: jnp.abs(slope * number), slopes, state)
    return jax.tree.reduce(jnp.add, terms)


def _gap(state: States, arrival: Float[Array, ""]) -> Float[Array, ""]:
    scene, start, velocity = state
    height, _ = scene.cantilever.propagator(arrival - start)(scene.platform.position(start), velocity)
    return height - scene.platform.position(arrival)


def _as_printed(state: States, arrival: Float[Array, ""]) -> dict[str, Array]:
    """Evaluate eqs. 5 and 7 as the paper prints them, for scenes without damping, viscous loss and delay."""
    scene, start, velocity = state
    law = formula_of(scene)
    flight = formulas.paper_flight(scene.cantilever, scene.platform, start, velocity, arrival)
    before = _velocity_before(state, arrival)
    printed = {"eq. 5": formulas.eq5(flight), "eq. 7": formulas.eq7(flight, before, law.r, law.epsilon)}
    return _with_every_effect(state, arrival) | printed


def _with_every_effect(state: States, arrival: Float[Array, ""]) -> dict[str, Array]:
    """Evaluate the formulas with damping, viscous loss and delay."""
    scene, start, velocity = state
    law, before = formula_of(scene), _velocity_before(state, arrival)
    eq5 = formulas.flight_jacobian(scene.cantilever, scene.platform, start, velocity, arrival)
    eq7 = formulas.impact_jacobian(law, scene.platform, arrival, before)
    return {"eq. 5": eq5, "eq. 7": eq7, "eqs. 5+7": eq7 @ eq5, **_eq6(law, scene.platform.velocity(arrival) - before)}


def _velocity_before(state: States, arrival: Float[Array, ""]) -> Float[Array, ""]:
    scene, start, velocity = state
    return scene.cantilever.propagator(arrival - start)(scene.platform.position(start), velocity)[1]


def _eq6(law: ImpactLaw, approach: Float[Array, ""]) -> dict[str, Array]:
    """Return u_out of eq. 6 and d u_out/d(u_in, r, epsilon, c), shape (5,), with the approach speed and u_out^2."""
    r, c = law.r, law.viscous_loss
    square = squared_rebound_speed(approach, r, law.epsilon, c)
    half = 0.5 / jnp.sqrt(square)
    slopes = [(2.0 * r**2 * approach - c) * half, 2.0 * r * approach**2 * half, -half, -approach * half]
    return {"eq. 6": jnp.stack([jnp.sqrt(square), *slopes]), "approach": approach, "squared rebound": square}


def growth_of_rounding(written: dict[str, Written]) -> Floats:
    """Return how much rounding errors grow on the way to what vanishes at grazing or capture: shape (states,)."""
    growths = [np.asarray(written[name].rounding) / np.abs(np.asarray(written[name].value)) for name in LIMITS]
    return np.max(growths, axis=0)


BLOCK = 2048
"""States computed at once: few enough for a processor's cache; every block has this shape, so that one compilation
serves any number of states."""
MOST_BLOCKS = 20


LIMITS = ("approach", "squared rebound")
"""What vanishes at grazing and at capture."""
MODES = ("forward", "reverse")


class Sample(NamedTuple):
    """States of one kind; all fields but ``kind`` are arrays of shape (states, ...).

    ``exists``: the tip meets the platform again, at ``arrival_us``, and leaves it.
    ``automatic``, ``written``: by name ("eq. 5", ...) what automatic differentiation gives, the second axis being the
    mode, and the written formula. ``growth``: see `growth_of_rounding`. ``ordinary``: away from capture and grazing,
    (r^2 u^2 - c u - epsilon)/(r^2 u^2) > 1e-5 and u > 1e-3 beta omega.
    """

    kind: Kind
    states: States
    exists: NDArray[np.bool_]
    arrival_us: Floats
    automatic: dict[str, Any]
    written: dict[str, Written]
    growth: Floats
    ordinary: NDArray[np.bool_]


def draw_sample(random: np.random.Generator, wanted: int, kind: Kind) -> Sample:
    """Return a sample with at least `wanted` ordinary states, and the close ones that came with them.

    Raises:
        RuntimeError: if the impact map finds far fewer impacts than there are.
    """
    evaluate = written_formulas(paper=not kind.damped)
    blocks: list[Sample] = []
    while sum(int(block.ordinary.sum()) for block in blocks) < wanted:
        if len(blocks) > MOST_BLOCKS + 3 * wanted // BLOCK:
            raise RuntimeError(f"{len(blocks) * BLOCK} random states hold fewer than {wanted} ordinary impacts")
        states = random_states(random, BLOCK, kind)
        states = with_adhesion(random, states, np.asarray(differentiate(*states).approach))
        sample = sample_at(states, kind, evaluate)
        blocks.append(rows_of(sample, sample.exists))
    return joined(blocks)


def sample_at(states: States, kind: Kind, evaluate: Callable[[States, Automatic], dict[str, Written]]) -> Sample:
    """Return what is compared at states, whether or not a next impact exists."""
    automatic = differentiate(*states)
    written = evaluate(states, automatic)
    with np.errstate(all="ignore"):  # states without an impact
        ordinary = np.asarray(automatic.approach) > CLOSE_TO_GRAZING * np.asarray(
            states.scene.platform.top_speed_nm_per_us
        )
        ordinary &= np.asarray(automatic.margin) > CLOSE_TO_CAPTURE
        growth = growth_of_rounding(written)
    values = {
        "eq. 5": automatic.flight,
        "eq. 6": automatic.rebound,
        "eq. 7": automatic.law,
        "eqs. 5+7": automatic.chained,
    }
    arrival = np.asarray(automatic.arrival_us)
    return Sample(kind, states, np.asarray(automatic.hit), arrival, values, written, growth, ordinary)


def relative_difference(value: Floats, exact: Floats, scale: Floats) -> Floats:
    """Return |value - exact| over a scale, the largest of each state: shape (states,).

    Where the scale is 0 both must be equal; what is not a number counts as infinitely wrong.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        difference = np.abs(value - exact)
        relative = np.where(difference == 0.0, 0.0, difference / scale)
    return np.where(np.isnan(relative), np.inf, relative).max(axis=tuple(range(1, relative.ndim)), initial=0.0)


def rows_of(sample: Sample, rows: NDArray[Any]) -> Sample:
    """Return chosen states of a sample, by a mask or by their numbers."""
    return Sample(sample.kind, *jax.tree.map(lambda array: np.asarray(array)[rows], tuple(sample[1:])))


def joined(samples: list[Sample]) -> Sample:
    """Return samples of one kind as one."""
    fields = [tuple(sample[1:]) for sample in samples]
    return Sample(samples[0].kind, *jax.tree.map(lambda *arrays: np.concatenate(arrays), *fields))
