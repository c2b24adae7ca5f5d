"""The legs of the quick way through the bridge: in to where the junction forms, out to where the bridge breaks.

With w the gap's rate, w^2 = total - level(D) + gain: the static forces enter by the level 2 U(D)/m + Omega^2 D^2, and
only the work of drive, air and viscosity is integrated, d gain/dD = 2 q(t) - 2 (Omega/Q + c(D)/m) w, in sweeps: speeds
from the gain, times from the speeds, the gain from both. D = outer exp(b - y^2) takes the square root out of the way of
a slow tip at the outer end.
"""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from afm_jax.contact.passage import margin_of
from afm_jax.contact.passage_collocation import nodes_along
from afm_jax.motion.contact_leg import Leg, settled
from afm_jax.motion.contact_settings import QuickSetting
from afm_jax.motion.driven import Driven, Place

_SLOWEST = 0.01
"""Share of w^2 at the start below which no sweep lets it fall; a tip that gets slower is not for the quick way."""


def go_in(driven: Driven, place: Place, setting: QuickSetting) -> Leg:
    """Return a tip where the junction forms, from a place in the bridge with the gap closing; x is s at the end."""
    gaps = place.x, driven.junction.forms_gap_nm
    leg = _cross(driven, gaps, place, setting, setting.inward, inward=True)
    root = driven.junction.forms_root + jnp.zeros_like(place.x)
    return leg._replace(place=leg.place._replace(x=root), holds=leg.holds & (place.gap_rate < 0.0))


def go_out(driven: Driven, place: Place, setting: QuickSetting) -> Leg:
    """Return a tip where the bridge breaks, from where the junction has broken with the gap opening."""
    gaps = driven.breaks_nm, driven.junction.breaks_gap_nm
    leg = _cross(driven, gaps, place, setting, setting.outward, inward=False)
    return leg._replace(holds=leg.holds & (place.gap_rate > 0.0) & (gaps[1] < gaps[0]))


def _cross(
    driven: Driven, gaps: tuple[Array, Array], place: Place, setting: QuickSetting, nodes: int, *, inward: bool
) -> Leg:
    outer, inner = gaps
    bridge, inverse_mass = driven.bridge, driven.inverse_mass
    stiffness, friction = driven.cantilever.angular_frequency**2, 2.0 * driven.cantilever.decay_rate

    def level(gap):
        return 2.0 * inverse_mass * bridge.potential(gap) + stiffness * gap * gap

    start, end = (outer, inner) if inward else (inner, outer)
    square, push = place.gap_rate**2, driven.push(place.time_us)
    total = square + level(start)
    at_outer = square if inward else total - level(end) + 2.0 * push * (outer - inner)
    y_outer, y_inner, margin = _ends(driven, gaps, at_outer)
    points, weights, cumulative = nodes_along(nodes, square)
    length = y_inner - y_outer
    y = y_outer + length * points if inward else y_inner - length * points
    gap = outer * jnp.exp(margin - y * y)
    path = 2.0 * length * y * gap
    available, damping = total - level(gap), bridge.damping(gap)
    drag = 2.0 * path * (friction + damping * inverse_mass)
    along = -2.0 * path if inward else 2.0 * path
    slowest = _SLOWEST * square

    def sweep(_, swept):
        gain = swept[0]
        speed = jnp.sqrt(jnp.maximum(available + gain, slowest))
        moment = place.time_us + jnp.tensordot(cumulative, path / speed, axes=1)
        rate = along * driven.push(moment) - drag * speed
        return jnp.tensordot(cumulative, rate, axes=1), gain, rate

    # the first guess: a push that stays as it is
    guess = 2.0 * push * (gap - start)
    gain, before, rate = lax.fori_loop(0, setting.sweeps, sweep, (guess, guess, guess))
    kinetic = available + gain
    speed = jnp.sqrt(kinetic)
    duration = jnp.tensordot(weights, path / speed, axes=1)
    leaving = jnp.sqrt(total + jnp.tensordot(weights, rate, axes=1) - level(end))
    lost = jnp.tensordot(weights, path * damping * speed, axes=1)
    holds = settled(jnp.abs(gain - before) / kinetic, path / speed, duration, setting)
    return Leg(
        place=Place(
            x=end + jnp.zeros_like(leaving),
            gap_rate=-leaving if inward else leaving,
            time_us=place.time_us + duration,
            viscous_loss_aj=place.viscous_loss_aj + lost,
        ),
        deepest_gap_nm=inner + jnp.zeros_like(leaving),
        holds=holds & jnp.all(kinetic > slowest, axis=0) & (leaving > 0.0),
    )


def _ends(driven: Driven, gaps: tuple[Array, Array], at_outer: Array) -> tuple[Array, Array, Array]:
    """Return y at the outer and at the inner gap, and b, from a guess of w^2 at the outer gap."""
    outer, inner = gaps
    pull = -2.0 * driven.inverse_mass * driven.bridge.force(outer) * outer
    margin = lax.stop_gradient(margin_of(jnp.maximum(at_outer, 0.01 * pull), jnp.maximum(pull, 1e-30)))
    return jnp.sqrt(margin), jnp.sqrt(margin + jnp.log(outer / inner)), margin
