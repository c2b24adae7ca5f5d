"""Random states with everything that is compared at them: automatic derivatives, written formulas, their terms.

Random states for the verification: a scene, a start, and an impact that follows; the hard corners on purpose.

Families, drawn in turn: ordinary; near resonance (omega/2 Omega within 1e-6 to 1e-2 of an integer); near grazing
(offset and velocity solved such that the tip meets the platform at a chosen, small relative speed: both conditions
are linear in them). In each of them epsilon is 0, or of any size, or just short of capturing the tip.

The impact map's derivatives by automatic differentiation, forward and reverse: nothing of the written formulas.

Where rounding alone decides: impacts close to capture and grazing, and how far errors grow there.

The sums of the magnitudes of the terms of eqs. 5 to 8: what a difference between two ways to compute is measured in.

A formula whose terms nearly cancel cannot be more exact than its terms. Every function below mirrors one of
`afm_jax.impact.jacobian`, with each difference replaced by a sum and each factor by its magnitude; a denominator stays
as it is. S, the sine of a difference of phases, is one of these differences: |sin a cos b| + |cos a sin b|.
"""

from collections.abc import Callable
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
from afm_jax.impact.jacobian import PaperFlight
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
MODES = ("forward", "reverse")


class Automatic(NamedTuple):
    """One impact and its derivatives; the first axis of a derivative is the mode (forward, reverse).

    ``arrival_us``, ``before``, ``leaving_us``, ``after``: the impact in us and nm/us. ``hit``: the tip leaves again.
    ``approach``: u_in in nm/us. ``margin``: (r^2 u^2 - c u - epsilon)/(r^2 u^2). ``rebound``: V' - v_p(t_out) in nm/us.
    ``flight``: d(t2, V2)/d(t1, V1'). ``law``: d(t_out, V')/d(t2, V2). ``chained``: d(t_out, V')/d(t1, V1').
    ``slopes``: d u_out/d(u_in, r, epsilon, c).
    """

    arrival_us: Float[Array, "..."]
    before: Float[Array, "..."]
    leaving_us: Float[Array, "..."]
    after: Float[Array, "..."]
    hit: Bool[Array, "..."]
    approach: Float[Array, "..."]
    margin: Float[Array, "..."]
    rebound: Float[Array, "..."]
    flight: Float[Array, "... 2 2 2"]
    law: Float[Array, "... 2 2 2"]
    chained: Float[Array, "... 2 2 2"]
    slopes: Float[Array, "... 2 4"]


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
    return Automatic(
        arrival_us=arrival,
        before=before,
        leaving_us=impact.time_us,
        after=impact.velocity_after_nm_per_us,
        hit=hit,
        approach=jnp.where(jnp.isfinite(impact.arrival_time_us), approach, jnp.nan),
        margin=squared_rebound_speed(approach, law.r, law.epsilon, law.viscous_loss) / (law.r * approach) ** 2,
        rebound=impact.velocity_after_nm_per_us - platform.velocity(impact.time_us),
        flight=whole[:, :2],
        law=jnp.stack([mode(law_step)(arriving, law, platform) for mode in (jax.jacfwd, jax.jacrev)]),
        chained=whole[:, 2:],
        slopes=jnp.stack([mode(_rebound_speed)(parameters) for mode in (jax.jacfwd, jax.jacrev)]),
    )


differentiate = jax.jit(jax.vmap(_differentiate))
"""`Automatic` of a batch of scenes, start times (us) and lab velocities just after impact (nm/us)."""


EPSILON = float(np.finfo(np.float64).eps)
CLOSE_TO_CAPTURE = 1e-5
CLOSE_TO_GRAZING = 1e-3
LARGE_AMPLIFICATION = 1e6


def is_away(scene: Scene, automatic: Automatic) -> NDArray[np.bool_]:
    """Say which impacts are away from capture and away from grazing, each for itself."""
    top_speed = np.asarray(scene.platform.top_speed_nm_per_us)
    away = np.asarray(automatic.approach) > CLOSE_TO_GRAZING * top_speed
    return away & (np.asarray(automatic.margin) > CLOSE_TO_CAPTURE)


def is_ordinary(scene: Scene, automatic: Automatic) -> NDArray[np.bool_]:
    """Say which impacts are neither close to capture nor to grazing.

    (r^2 u^2 - c u - epsilon)/(r^2 u^2) > 1e-5 and u > 1e-3 beta omega. Where both are small at once, or a delay
    magnifies a small rebound speed, rounding alone makes more than 1e-9: the relative rounding error of u is
    eps (|V| + beta omega)/u, that of the squared rebound speed larger by 1/margin, that of the phase after the delay by
    omega b/u_out; a product above 1e6 counts as close too.
    """
    approach, margin = np.asarray(automatic.approach), np.asarray(automatic.margin)
    top_speed = np.asarray(scene.platform.top_speed_nm_per_us)
    amplification = (np.abs(np.asarray(automatic.before)) + top_speed) / approach / margin
    law = formula_of(scene)
    if law.delay is not None:
        rebound = np.asarray(law.r) * approach * np.sqrt(np.maximum(margin, 0.0))
        omega = np.asarray(scene.platform.angular_frequency)
        with np.errstate(divide="ignore"):
            amplification = amplification * (1.0 + omega * np.asarray(law.delay.lead_nm) / rebound)
    return is_away(scene, automatic) & (amplification < LARGE_AMPLIFICATION)


def condition_number(states: States, automatic: Automatic) -> Floats:
    """Return by how much rounding errors of the inputs grow on the way to the derivatives: shape (states,).

    The impact time t2 is known to eps (t2 + G/u) and the tolerance of its search, where G = |p11 z_p1| + |p12 V'| +
    |z_p2| are the terms of eq. 3, which cancel, and u = v_p - V is the closing velocity. A time's error moves u by
    M = Omega sqrt(V'^2 + Omega^2 z^2) + beta omega^2 times as much, besides the rounding eps (|V| + beta omega) of its
    own terms: dividing by u gives the growth through the closing velocity. It shifts the phase of the platform's
    acceleration, too: omega |tan omega t2| times as much, relatively. Through the root of eq. 6 it grows by
    1 + 1/margin, margin = (r^2 u^2 - c u - epsilon)/(r^2 u^2), and with a delay by 1 + omega (b/u_out + t_out) in the
    platform's phase, times 1 + |tan omega t_out| for its acceleration there; 1 is for the rounding of the result.
    """
    cantilever, platform = states.scene.cantilever, states.scene.platform
    approach, top_speed = np.asarray(automatic.approach), np.asarray(platform.top_speed_nm_per_us)
    Omega, omega = np.asarray(cantilever.angular_frequency), np.asarray(platform.angular_frequency)
    reach = np.abs(np.asarray(platform.offset_nm)) + np.asarray(platform.amplitude_nm)
    speed = np.sqrt(np.asarray(states.velocity) ** 2 + (Omega * reach) ** 2)
    pull = Omega * speed + top_speed * omega
    gap_terms = 2.0 * reach + speed / Omega
    arrival = np.asarray(automatic.arrival_us)
    time_error = arrival + gap_terms / approach + DEFAULT_ROOT_TOLERANCE_US / EPSILON
    through_speed = (speed + top_speed + pull * time_error) / approach
    through_phase = omega * np.abs(np.tan(omega * arrival)) * time_error
    number = 1.0 + through_speed * (1.0 + 1.0 / np.asarray(automatic.margin)) + through_phase
    law = formula_of(states.scene)
    if law.delay is None:
        return number
    rebound = np.asarray(law.r) * approach * np.sqrt(np.asarray(automatic.margin))
    leaving = np.asarray(automatic.leaving_us)
    later = 1.0 + omega * (np.asarray(law.delay.lead_nm) / rebound + np.abs(leaving))
    return number * later * (1.0 + np.abs(np.tan(omega * leaving)))


def eq5_terms(flight: PaperFlight, start: Float[Array, ""], impact_us: Float[Array, ""]) -> Float[Array, "2 2"]:
    """Return the terms' sums for eq. 5."""
    beta, omega, Omega, A, B, s1, s2, _, C, S = flight
    closing = jnp.abs(A * Omega * S - B * Omega * C - beta * omega * s2)
    A, B, s1, s2, C = (jnp.abs(part) for part in (A, B, s1, s2, C))
    S = _sine_terms(Omega, start, impact_us)
    pull = Omega**2 * (A * C + B * S) / closing
    return jnp.array(
        [
            [(beta * omega * s1 * C + A * Omega * S + B * Omega * C) / closing, S / Omega / closing],
            [beta * omega * Omega * s1 * S + pull * beta * omega * (s2 + s1 * C), C + pull * S / Omega],
        ]
    )


def flight_terms(
    cantilever: Cantilever, platform: Platform, start: Float[Array, ""], velocity: Float[Array, ""], impact_us
) -> Float[Array, "2 2"]:
    """Return the terms' sums for `flight_jacobian`, the damped eq. 5.

    dt2/dt1 has a 1 among them: t2 is the start plus a duration, and a damped tip forgets its start, so that dt2/dt1
    is the little that is left of 1 plus the duration's derivative.
    """
    propagator = cantilever.propagator(impact_us - start)
    position, platform_velocity = platform.position_and_velocity(start)
    closing = jnp.abs(propagator(position, velocity)[1] - platform.velocity(impact_us))
    p11, _, p21, p22 = (jnp.abs(part) for part in propagator)
    ringing = cantilever.damped_angular_frequency
    shrink = jnp.exp(-cantilever.decay_rate * (impact_us - start))
    p12 = shrink * _sine_terms(ringing, start, impact_us) / ringing
    position, velocity, platform_velocity = jnp.abs(position), jnp.abs(velocity), jnp.abs(platform_velocity)
    before = p21 * position + p22 * velocity
    pull = cantilever.angular_frequency**2 * (p11 * position + p12 * velocity) + 2.0 * cantilever.decay_rate * before
    time_by_time, time_by_velocity = (before + p11 * platform_velocity) / closing, p12 / closing
    return jnp.array(
        [
            [1.0 + time_by_time, time_by_velocity],
            [p21 * platform_velocity + pull * (time_by_time + 1.0), p22 + pull * time_by_velocity],
        ]
    )


def eq6_slopes(approach: Float[Array, ""], law: ImpactLaw) -> tuple[Float[Array, " 4"], Float[Array, " 4"]]:
    """Return d u_out/d(u_in, r, epsilon, c) of eq. 6, and the sums of the magnitudes of their terms."""
    r, c = law.r, law.viscous_loss
    half = 0.5 / jnp.sqrt(squared_rebound_speed(approach, r, law.epsilon, c))
    rest = [2.0 * r * approach**2 * half, -half, -approach * half]
    slopes = jnp.stack([(2.0 * r**2 * approach - c) * half, *rest])
    return slopes, jnp.abs(slopes).at[0].set((2.0 * r**2 * approach + c) * half)


def eq7_terms(flight: PaperFlight, velocity_before, r: Float[Array, ""], epsilon: Float[Array, ""]):
    """Return the terms' sums for eq. 7, shape (2, 2)."""
    relative = velocity_before + flight.beta * flight.omega * flight.s2
    ratio = r**2 * jnp.abs(relative) / jnp.sqrt(r**2 * relative**2 - epsilon)
    turn = flight.beta * flight.omega**2 * jnp.abs(flight.c2) * (ratio + 1.0)
    return jnp.array([[jnp.ones_like(turn), jnp.zeros_like(turn)], [turn, ratio]])


def impact_terms(law: ImpactLaw, platform: Platform, arrival: Float[Array, ""], before) -> Float[Array, "2 2"]:
    """Return the terms' sums for `impact_jacobian`, eq. 7 with viscous loss and delay."""
    approach = platform.velocity(arrival) - before
    rebound = law.rebound_speed(approach)
    slope = (2.0 * law.r**2 * approach + law.viscous_loss) / (2.0 * rebound)
    delay_slope = jnp.zeros_like(slope)
    if law.delay is not None:
        lead, offset = jnp.abs(law.delay.lead_nm), jnp.abs(law.delay.offset_nm)
        delay_slope = 0.2 * jnp.abs(law.delay.hertz) * approach**-1.2 + lead * slope / rebound**2
        delay_slope = delay_slope + (lead + offset) / approach**2
    pull_in = jnp.abs(platform.acceleration(arrival))
    pull_out = jnp.abs(platform.acceleration(arrival + law.collision_delay(approach)))
    time_by_time = 1.0 + delay_slope * pull_in
    return jnp.array(
        [[time_by_time, delay_slope], [pull_out * time_by_time + slope * pull_in, pull_out * delay_slope + slope]]
    )


def eq8_trace_terms(flight: PaperFlight, velocity_after: Float[Array, ""], r: Float[Array, ""]) -> Float[Array, ""]:
    """Return the terms' sum for the trace of eq. 8."""
    beta, omega, Omega, _, _, _, s, c, C, S = flight
    closing = jnp.abs(velocity_after - beta * omega * s)  # v_p - V, with V = -V'
    ratio = jnp.abs((velocity_after - beta * omega * s) / (velocity_after + beta * omega * s))
    s, c, C, S = (jnp.abs(part) for part in (s, c, C, S))
    bracket = beta * omega * s * (1.0 + C) + (jnp.abs(velocity_after) + beta * omega * s * C) * r**2 * ratio
    bracket = bracket + beta * omega**2 / Omega * c * S * (r**2 * ratio + 1.0)
    return 1.0 + bracket / closing


def _sine_terms(frequency: Float[Array, ""], start: Float[Array, ""], impact_us: Float[Array, ""]) -> Float[Array, ""]:
    """Return |sin a cos b| + |cos a sin b| for the phases a, b of the flight's end and start."""
    end, begin = frequency * impact_us, frequency * start
    return jnp.abs(jnp.sin(end) * jnp.cos(begin)) + jnp.abs(jnp.cos(end) * jnp.sin(begin))


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
    law = formula_of(scene)
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
    law = formula_of(scene)
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
    law = formula_of(scene)
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
