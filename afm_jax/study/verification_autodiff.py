"""The impact map's derivatives by automatic differentiation, forward and reverse: nothing of the written formulas."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.impact.law import ImpactLaw, impact_law_of, squared_rebound_speed
from afm_jax.impact.poincare import NextImpact, next_impact
from afm_jax.outcome import Outcome

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
    law, platform = impact_law_of(scene), scene.platform
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
