"""The leg of the quick way through the junction: to its turning point, and from there to the fold where it breaks.

With s = turn - y^2, w^2 = y^2 (unit mean(work') + 2 scale mean(depth') g), where mean(f') is the mean slope from s to
the turning point and g the mean over that depth of what accelerates the gap beside the contact: drive, spring and air.
Both square roots at the turning point are thereby gone. The means of g, which varies little, are improved in sweeps.
"""

from functools import cache
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from afm_jax.contact.forces import jkr
from afm_jax.contact.junction_way import mean_slope, turning_root
from afm_jax.contact.passage_collocation import gauss_nodes, nodes_along
from afm_jax.motion.contact_leg import Leg, settled
from afm_jax.motion.contact_settings import QuickSetting
from afm_jax.motion.driven import Driven, Place


def go_through_junction(driven: Driven, place: Place, setting: QuickSetting) -> Leg:
    """Return a tip where the junction has broken, from where it has formed with the gap closing; x is the gap."""
    form = driven.junction.forms_root + jnp.zeros_like(place.x)
    fold = jnp.full_like(form, jkr.FOLD)
    level = jkr.work(form) + place.gap_rate**2 / _unit(driven)
    turn = turning_root(level)
    others = driven.acceleration(driven.gap_of_root(form), place.gap_rate, place.time_us, jnp.zeros_like(turn))
    for _ in range(2):
        turn = _turn_under(driven, form, level, others, turn)
    half = _Half(driven, form, level, place.time_us, pressing=True)
    inward = half.swept(turn, others, setting.pressing, setting)
    turn, at_turn = inward.turn, inward.time_us
    others = driven.acceleration(driven.gap_of_root(turn), jnp.zeros_like(turn), at_turn, jnp.zeros_like(turn))
    half = _Half(driven, fold, level, at_turn, pressing=False)
    outward = half.swept(turn, others, setting.releasing, setting)
    work, depth = (of(turn) - of(fold) for of in (jkr.work, jkr.depth))
    leaving = jnp.sqrt(_unit(driven) * work + 2.0 * driven.depth_scale_nm * outward.mean * depth)
    return Leg(
        place=Place(
            x=driven.junction.breaks_gap_nm + jnp.zeros_like(turn),
            gap_rate=leaving,
            time_us=outward.time_us,
            viscous_loss_aj=place.viscous_loss_aj,
        ),
        deepest_gap_nm=driven.gap_of_root(turn),
        holds=inward.holds & outward.holds & (leaving > 0.0) & (place.gap_rate < 0.0),
    )


def _unit(driven: Driven) -> Array:
    """Return twice the unit of the junction's energy over the mass."""
    return 2.0 * driven.load_scale_nn * driven.depth_scale_nm * driven.inverse_mass


def _turn_under(driven: Driven, form: Array, level: Array, mean: Array, turn: Array) -> Array:
    """Return the turning point, improved by a step of Newton's method, under a mean of the other forces."""
    unit, twice = _unit(driven), 2.0 * driven.depth_scale_nm
    excess = unit * (jkr.work(turn) - level) + twice * mean * (jkr.depth(turn) - jkr.depth(form))
    return turn - excess / (jkr.depth_slope(turn) * (unit * jkr.load(turn) + twice * mean))


class _Swept(NamedTuple):
    """A half of the way through the junction, swept."""

    turn: Float[Array, "..."]
    time_us: Float[Array, "..."]
    mean: Float[Array, "..."]
    """The mean of g over all of the depth."""
    holds: Bool[Array, "..."]


class _Half(NamedTuple):
    """The way from where the junction forms to the turning point (`pressing`), or from there to the fold."""

    driven: Driven
    end: Array
    """s at the end that is not the turning point."""
    level: Array
    begin_us: Array
    pressing: bool

    def swept(self, turn: Array, mean: Array, nodes: int, setting: QuickSetting) -> _Swept:
        """Return this half.

        Args:
            turn: s at the turning point, to be improved on the way to it.
            mean: a guess of the mean of g.
            nodes: number of Gauss nodes.
            setting: numbers of sweeps, and what is allowed.
        """
        driven, twice = self.driven, 2.0 * self.driven.depth_scale_nm
        points, weights, cumulative = nodes_along(nodes, turn)
        averages = jnp.asarray(_mean_matrix(nodes), turn.dtype)
        passing = weights - cumulative if self.pressing else cumulative

        def sweep(_, swept):
            turn, means, _, _ = swept
            s, y, speed, slope = self._along(turn, means, points)
            pace = twice * jnp.sqrt(turn - self.end) * slope / speed
            moment = self.begin_us + jnp.tensordot(passing, pace, axes=1)
            rate = -y * speed if self.pressing else y * speed
            others = driven.acceleration(driven.gap_of_root(s), rate, moment, jnp.zeros_like(rate))
            # in the mean over the depth every node counts by its slope
            total = jnp.tensordot(averages, others * slope, axes=1)
            mean = total[-1] / _mean_depth_slope(turn, self.end)
            after = _turn_under(driven, self.end, self.level, mean, turn) if self.pressing else turn
            return after, total[:-1] / _mean_depth_slope(turn, s), means, mean

        guess = mean + jnp.zeros_like(points)
        turn, means, before, mean = lax.fori_loop(0, setting.junction_sweeps, sweep, (turn, guess, guess, mean))
        s, _, speed, slope = self._along(turn, means, points)
        pace = twice * jnp.sqrt(turn - self.end) * slope / speed
        duration = jnp.tensordot(weights, pace, axes=1)
        change = jnp.abs((means - before) * twice * _mean_depth_slope(turn, s)) / (speed * speed)
        return _Swept(turn, self.begin_us + duration, mean, settled(change, pace, duration, setting))

    def _along(self, turn: Array, means: Array, points: Array) -> tuple[Array, Array, Array, Array]:
        """Return s, y, the speed over y, and the slope of the depth at the nodes."""
        y = jnp.sqrt(turn - self.end) * points
        s = turn - y * y
        pulled = 2.0 * self.driven.depth_scale_nm * _mean_depth_slope(turn, s) * means
        return s, y, jnp.sqrt(_unit(self.driven) * mean_slope(turn, s) + pulled), jkr.depth_slope(s)


def _mean_depth_slope(turn: Array, s: Array) -> Array:
    """Return (depth(turn) - depth(s)) / (turn - s)."""
    return (turn + s) * (turn * turn + s * s) - jkr.SLOPE


@cache
def _mean_matrix(count: int) -> np.ndarray:
    """Return what takes f at Gauss nodes on [0, 1] to its means (1/y^2) int_0^y f d(y^2), at the nodes and at 1."""
    points, weights, _ = gauss_nodes(count)
    values = np.polynomial.legendre.legvander(2.0 * points - 1.0, count - 1)
    project = (2.0 * np.arange(count)[:, None] + 1.0) * values.T * weights
    shares, share_weights, _ = gauss_nodes(count + 1)

    def mean(y):
        series = np.polynomial.legendre.legvander(2.0 * y * shares - 1.0, count - 1)
        return (2.0 * shares * share_weights) @ series @ project

    return np.stack([mean(y) for y in (*points, 1.0)])
