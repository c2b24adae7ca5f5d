"""The quick way through a driven contact: through the bridge, the junction and out again, in fixed numbers of steps.

The gap is the variable in the bridge, with time as part of the state, so that thresholds are met without a search; the
junction is crossed in fictitious time, with one step in the velocity to the turning point and one in s to the fold. It
holds for a tip that goes straight in, forms the junction once and leaves straight. Where it does not (the tip turns in
the bridge, or is slow somewhere), speeds become NaN or the embedded error estimates large: `holds` says so, and the
caller goes the way in time.
"""

from collections.abc import Callable
from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from afm_jax.contact.forces import jkr
from afm_jax.contact.junction_way import mean_slope, turning_root
from afm_jax.contact.passage import margin_of
from afm_jax.contact.passage_collocation import nodes_along
from afm_jax.contact.passage_steps import GRADING
from afm_jax.motion.contact_settings import QuickSetting
from afm_jax.motion.driven import Driven, Place

_NODES = 6
"""Gauss nodes of the estimate of how long the junction lasts."""


class Crossing(NamedTuple):
    """A contact crossed; arrays of the tips' shape."""

    place: Place
    """Where the bridge breaks."""
    junction_forms_us: Float[Array, "..."]
    junction_breaks_us: Float[Array, "..."]
    time_in_junction_us: Float[Array, "..."]
    deepest_gap_nm: Float[Array, "..."]
    holds: Bool[Array, "..."]


def cross(driven: Driven, place: Place, setting: QuickSetting) -> Crossing:
    """Return a tip beyond the contact that it has just begun.

    Args:
        driven: the equation of motion.
        place: where the bridge forms; the gap closes.
        setting: numbers of steps.
    """
    junction = driven.junction
    square, time, loss_in, error_in = _bridge(
        driven,
        (driven.forms_nm, junction.forms_gap_nm),
        place.gap_rate**2,
        place.time_us,
        setting.inward,
        setting.solver,
        inward=True,
    )
    solid, deepest, error = _junction(driven, jnp.sqrt(square), time, setting)
    square_out, left, loss_out, error_out = _bridge(
        driven,
        (driven.breaks_nm, junction.breaks_gap_nm),
        solid.gap_rate**2,
        solid.time_us,
        setting.outward,
        setting.solver,
        inward=False,
    )
    rate = jnp.sqrt(square_out)
    loss = place.viscous_loss_aj + loss_in + loss_out
    error = error_in + error + error_out
    straight = (place.gap_rate < 0.0) & (solid.gap_rate > 0.0) & (junction.breaks_gap_nm < driven.breaks_nm)
    return Crossing(
        place=Place(driven.breaks_nm + jnp.zeros_like(rate), rate, left, loss),
        junction_forms_us=time,
        junction_breaks_us=solid.time_us,
        time_in_junction_us=solid.time_us - time,
        deepest_gap_nm=deepest,
        holds=straight & jnp.isfinite(rate) & jnp.isfinite(left) & (error < setting.tolerance),
    )


def _bridge(
    driven: Driven, gaps: tuple[Array, Array], square: Array, time: Array, steps: int, solver: str, *, inward: bool
) -> tuple[Array, Array, Array, Array]:
    """Return squared gap rate, time, viscous loss and estimated relative error after a crossing of the bridge.

    With E = D'^2/2 + U(D)/m + Omega^2 D^2/2, dE/dD = q(t) - (Omega/Q + c(D)/m) D': of the forces only the dissipative
    ones and the drive are integrated. D = outer exp(b - y^2) takes the square root out of a slow tip's way out.
    """
    outer, inner = gaps
    bridge, cantilever = driven.bridge, driven.cantilever
    stiffness = cantilever.angular_frequency**2

    def level(gap):
        return 2.0 * driven.inverse_mass * bridge.potential(gap) + stiffness * gap * gap

    start, end = (outer, inner) if inward else (inner, outer)
    total = square + level(start)
    pull = -2.0 * driven.inverse_mass * bridge.force(outer) * outer
    at_outer = square if inward else total - level(end) + 2.0 * driven.push(time) * (outer - inner)
    margin = lax.stop_gradient(margin_of(jnp.maximum(at_outer, 0.01 * pull), jnp.maximum(pull, 1e-30)))
    at_outer, at_inner = jnp.sqrt(margin), jnp.sqrt(margin + jnp.log(outer / inner))
    begin, sense = (at_outer, 1.0) if inward else (at_inner, -1.0)
    length, scale = at_inner - at_outer, outer * jnp.exp(margin)

    def field(share, state):
        gain, moment, _ = state
        y = begin + sense * length * share
        gap = scale * jnp.exp(-y * y)
        speed = jnp.sqrt(total + gain - level(gap))
        path = 2.0 * length * y * gap
        pushed = -2.0 * sense * path * driven.push(moment)
        drag = 2.0 * path * speed
        lost = path * speed * bridge.damping(gap) if not bridge.conserves else jnp.zeros_like(gap)
        slowed = 2.0 * driven.inverse_mass * lost + drag * 2.0 * cantilever.decay_rate
        return pushed - slowed, path / speed, lost

    shares = np.linspace(0.0, 1.0, steps + 1)
    if inward:
        shares = 1.0 - (1.0 - shares) ** GRADING
    ends = jnp.asarray(np.stack([shares[:-1], shares[1:]], axis=1), total.dtype)
    zero = jnp.zeros_like(total)
    (gain, after, lost), error = _in_steps(field, (zero, time, zero), ends, solver)
    leaving = total + gain - level(end)
    speed = jnp.sqrt(leaving)
    return leaving, after, lost, error[0] / leaving + error[1] * speed / inner


def _junction(driven: Driven, speed: Array, time: Array, setting: QuickSetting) -> tuple[Place, Array, Array]:
    """Return the place where the junction breaks, the smallest gap in it, and the estimated relative error."""
    scale, junction = driven.depth_scale_nm, driven.junction
    unit = 2.0 * driven.load_scale_nn * scale * driven.inverse_mass
    pace = scale / jnp.sqrt(unit)
    begin = junction.forms_root + jnp.zeros_like(speed)

    def rates(s, rate, moment):
        slope = jkr.depth_slope(s)
        force = driven.load_scale_nn * jkr.load(s)
        return -rate / scale, slope * driven.acceleration(driven.gap_of_root(s), rate, moment, force), slope

    def in_theta(share, state, length):
        del share
        return tuple(length * rate for rate in rates(*state))

    def to_rest(share, state, first):
        s, moment = state
        rate = first * (1.0 - share)
        ds, dv, dt = rates(s, rate, moment)
        return -first * ds / dv, -first * dt / dv

    def to_fold(share, state, first):
        rate, moment = state
        s = first + share * (jkr.FOLD - first)
        ds, dv, dt = rates(s, rate, moment)
        return (jkr.FOLD - first) * dv / ds, (jkr.FOLD - first) * dt / ds

    def even(steps):
        # the last step, in another variable, is as long as the others
        shares = np.arange(steps + 1) / (steps + 1.0)
        return jnp.asarray(np.stack([shares[:-1], shares[1:]], axis=1), speed.dtype)

    turn = turning_root(jkr.work(begin) + speed * speed / unit)
    length = lax.stop_gradient(pace * _theta_to_turn(begin, turn))
    state, error = _in_steps(
        lambda share, now: in_theta(share, now, length),
        (begin, -speed, time),
        even(setting.pressing),
        setting.junction_solver,
    )
    s, rate, moment = state
    once = jnp.asarray([[0.0, 1.0]], speed.dtype)
    (turn, moment), error_turn = _in_steps(
        lambda share, now: to_rest(share, now, rate), (s, moment), once, setting.junction_solver
    )
    length = lax.stop_gradient(pace * _theta_to_turn(jnp.full_like(turn, jkr.FOLD), turn))
    zero = jnp.zeros_like(rate)
    state, error_out = _in_steps(
        lambda share, now: in_theta(share, now, length),
        (turn, zero, moment),
        even(setting.releasing),
        setting.junction_solver,
    )
    last, rate, moment = state
    (rate, moment), error_fold = _in_steps(
        lambda share, now: to_fold(share, now, last), (rate, moment), once, setting.junction_solver
    )
    of_root = (error[0] + error_turn[0] + error_out[0]) / turn
    of_speed = (error[1] + error_out[1] + error_fold[0]) / rate
    place = Place(jnp.full_like(turn, jkr.FOLD), rate, moment, zero)
    return place, driven.gap_of_root(turn), of_root + of_speed


def _theta_to_turn(start: Array, turn: Array) -> Float[Array, "..."]:
    """Return the integral of ds / sqrt(work(turn) - work(s)) from s = start to the turning point: an estimate."""
    points, weights, _ = nodes_along(_NODES, turn)
    reach = jnp.sqrt(turn - start)
    s = turn - (reach * points) ** 2
    return 2.0 * reach * jnp.tensordot(weights, 1.0 / jnp.sqrt(mean_slope(turn, s)), axes=1)


def _in_steps(
    field: Callable, begin: tuple[Array, ...], ends: Float[Array, "steps 2"], solver_name: str
) -> tuple[tuple, tuple]:
    """Return the state after steps of Dormand and Prince's method of order 8, and the sum of its error estimates."""
    solver = getattr(diffrax, solver_name)(scan_kind="lax")

    def rates(share, state, args):
        del args
        return field(share, state)

    term = diffrax.ODETerm(rates)

    def step(carried, span):
        state, memory, errors = carried
        after, estimate, _, memory, _ = solver.step(term, span[0], span[1], state, None, memory, made_jump=False)
        errors = jax.tree.map(lambda total, more: total + jnp.abs(lax.stop_gradient(more)), errors, estimate)
        return (after, memory, errors), None

    memory = solver.init(term, ends[0, 0], ends[0, 1], begin, None)
    none = jax.tree.map(jnp.zeros_like, begin)
    (state, _, errors), _ = lax.scan(step, (begin, memory, none), ends)
    return state, errors
