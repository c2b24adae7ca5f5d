"""The way of a tip through the junction, free or driven: to the turning point, and from there to the fold.

Takes a tip (`Driven`) and its energy in aJ or state where the junction forms; gives energy or state, time in us and
deepest gap in nm where it breaks (eqs. 15 and 16).

In the root s of the elastic contact (sqrt(A) for JKR) work and depth are polynomials, and the fold, where the contact
breaks, is smooth. With s = turn - y^2, turn the root at the turning point, and w the gap's rate,

    w^2 = y^2 (unit mean(work') + 2 scale mean(depth') g),

mean(f') the mean slope by s from s to the turning point, unit = 2 energy_scale/m, scale the unit of the depth, and g
the mean over that depth of what accelerates the gap beside the contact: drive, spring and air. The square root at the
turning point is thereby gone. The means of g, which varies little, are improved by Picard's iterations.

For a free tip g = 0 and the junction conserves energy: the turning point is a root of the polynomial, and the times are
quadratures (`pass_through_junction`). A free tip that hardly gets away is slow at the fold; from there
s = fold + width sinh(q). `go_through_junction` is the leg of a driven tip.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from afm_jax.contact.driven import ContactState, Driven, Leg
from afm_jax.contact.forces.force import ElasticCurve
from afm_jax.contact.settings import QuickSetting
from afm_jax.solve.derivatives import implicit_root
from afm_jax.solve.newton_steps import newton_steps
from afm_jax.solve.quadrature import mean_matrix, nodes_along


class JunctionWay(NamedTuple):
    """What the way of a free tip through the junction ends with."""

    energy_aj: Float[Array, "..."]
    """Kinetic energy where the junction breaks, signed: negative by what is missing where it does not break."""
    time_us: Float[Array, "..."]
    """Time in the junction; meaningless where the energy is not positive."""
    deepest_gap_nm: Float[Array, "..."]
    """Gap at the turning point, negative where the tip indents the sample."""


def pass_through_junction(tip: Driven, energy_aj: Float[Array, "..."], nodes: int) -> JunctionWay:
    """Return the way of a free tip from the formation of the junction to its breaking.

    Args:
        tip: the tip, without drive.
        energy_aj: kinetic energy where it forms, in aJ.
        nodes: number of Gauss nodes of each quadrature.
    """
    form, solid = tip.junction.forms_root, tip.solid
    unit = solid.energy_scale_aj
    level = solid.work(form) + jnp.maximum(energy_aj, 0.0) / unit
    turn = turning_root(solid, level)
    leaving = energy_aj - tip.elastic_aj
    points, weights, _ = nodes_along(nodes, turn)
    # both ways go from the inner root to the turning point; one that forms at the fold passes the rest both ways, too
    inner, rests = (0.5 * turn, 2.0) if solid.reversible else (form, 1.0)
    at = _Half(tip, inner).along(turn, points)
    inside = jnp.tensordot(weights, at.time_slope, axes=1)
    outside = _time_to_fold(tip, inner, jnp.maximum(leaving, 0.0) / unit, nodes)
    return JunctionWay(leaving, 2.0 * inside + rests * outside, tip.gap_of_root(turn))


class Stretch(NamedTuple):
    """A stretch of a free tip's way at Gauss nodes, its times counted from its beginning."""

    time_us: Float[Array, " nodes"]
    gap_nm: Float[Array, " nodes"]
    velocity: Float[Array, " nodes"]
    """Rate of the gap in nm/us; 0 marks places that are never reached."""
    duration_us: Float[Array, ""]


def stretch_in_junction(
    tip: Driven, level: Float[Array, ""], turn: Float[Array, ""], end: Float[Array, ""], nodes: int
) -> Stretch:
    """Return the stretch from the turning point to another point, which may be one too.

    Args:
        tip: a free tip.
        level: its energy in the unit of the normalised work.
        turn: s at the turning point.
        end: s at the other end.
        nodes: number of Gauss nodes.
    """
    points, weights, cumulative = nodes_along(nodes, turn)
    # both ends may be turning points: sin^2 takes the square roots out
    fraction, bend = jnp.sin(0.5 * jnp.pi * points) ** 2, 0.5 * jnp.pi * jnp.sin(jnp.pi * points)
    s = turn - (turn - end) * fraction
    missing = level - tip.solid.work(s)
    moving = missing > 0.0
    speed = jnp.sqrt(_unit(tip)) * jnp.sqrt(jnp.where(moving, missing, 1.0))
    path = tip.solid.depth_scale_nm * (turn - end) * bend * tip.solid.depth_slope(s)
    time_slope = jnp.where(moving, path / speed, 0.0)
    return Stretch(cumulative @ time_slope, tip.gap_of_root(s), jnp.where(moving, speed, 0.0), weights @ time_slope)


def go_through_junction(driven: Driven, state: ContactState, setting: QuickSetting) -> Leg:
    """Return a tip where the junction has broken, from where it has formed with the gap closing; x is the gap."""
    form = driven.junction.forms_root + jnp.zeros_like(state.x)
    solid = driven.solid
    fold = jnp.full_like(form, solid.fold)
    level = solid.work(form) + state.gap_rate**2 / _unit(driven)
    turn = turning_root(solid, level)
    g = driven.acceleration(driven.gap_of_root(form), state.gap_rate, state.time_us, jnp.zeros_like(turn))
    for _ in range(2):
        turn = _turn_under(driven, form, level, g, turn)
    half = _Half(driven, form, pressing=True)
    turn, at_turn, _, holds = _iterated(half, level, state.time_us, (turn, g), setting)
    g = driven.acceleration(driven.gap_of_root(turn), jnp.zeros_like(turn), at_turn, jnp.zeros_like(turn))
    half = _Half(driven, fold, pressing=False)
    _, end_us, mean, holds_out = _iterated(half, level, at_turn, (turn, g), setting)
    work, depth = (of(turn) - of(fold) for of in (solid.work, solid.depth))
    leaving = jnp.sqrt(_unit(driven) * work + 2.0 * driven.solid.depth_scale_nm * mean * depth)
    return Leg(
        state=ContactState(
            x=driven.junction.breaks_gap_nm + jnp.zeros_like(turn),
            gap_rate=leaving,
            time_us=end_us,
            viscous_loss_aj=state.viscous_loss_aj,
        ),
        deepest_gap_nm=driven.gap_of_root(turn),
        holds=holds & holds_out & (leaving > 0.0) & (state.gap_rate < 0.0),
    )


def turning_root(solid: ElasticCurve, level: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return the largest s at which the normalised work is `level`, by Newton's method from above.

    The work is convex to the right of its minimum, so that Newton's steps from above never pass the root.
    """
    fixed_curve, fixed = lax.stop_gradient((solid, level))

    def excess_and_slope(root):
        slope = fixed_curve.load(root) * fixed_curve.depth_slope(root)
        return fixed_curve.work(root) - fixed, jnp.maximum(slope, 0.0)

    return implicit_root(_excess_work, newton_steps(excess_and_slope, fixed_curve.beyond(fixed), 8), (solid, level))


def _excess_work(root: Float[Array, "..."], of: tuple[ElasticCurve, Float[Array, "..."]]) -> Float[Array, "..."]:
    solid, level = of
    return solid.work(root) - level


def _unit(driven: Driven) -> Array:
    """Return twice the unit of the junction's energy over the mass: w^2 is that times the normalised energy."""
    return 2.0 * driven.solid.energy_scale_aj * driven.inverse_mass


class _Along(NamedTuple):
    """Points between the turning point and the other end of a half."""

    s: Array
    y: Array
    over_y: Array
    """The speed over y."""
    slope: Array
    """Of the depth."""
    time_slope: Array
    """Time in us per fraction of the half."""


class _Half(NamedTuple):
    """The way from where the junction forms to the turning point (`pressing`), or from there to the fold."""

    driven: Driven
    end: Array
    """s at the end that is not the turning point."""
    pressing: bool = True

    def along(self, turn: Array, points: Array, means: Array | None = None) -> _Along:
        """Return the points at nodes of y, under means of g; None: under none."""
        apart = turn > self.end
        reach = jnp.where(apart, jnp.sqrt(jnp.where(apart, turn - self.end, 1.0)), 0.0)
        twice = 2.0 * self.driven.solid.depth_scale_nm
        y = reach * points
        s = turn - y * y
        work_slope, depth_slope = self.driven.solid.mean_slopes(turn, s)
        square = _unit(self.driven) * work_slope
        if means is not None:
            square = square + twice * depth_slope * means
        over_y, slope = jnp.sqrt(square), self.driven.solid.depth_slope(s)
        return _Along(s, y, over_y, slope, twice * reach * slope / over_y)


def _iterated(
    half: _Half, level: Array, begin_us: Array, guess: tuple[Array, Array], setting: QuickSetting
) -> tuple[Array, Array, Array, Bool[Array, "..."]]:
    """Return s at the turning point, the time at the end, and the mean of g over the depth of a half under a drive.

    The last one says whether nodes and iterations are enough.

    Args:
        half: the half.
        level: the energy in the unit of the normalised work where the junction forms.
        begin_us: time at the start.
        guess: s at the turning point, to be improved on the way to it, and the mean of g.
        setting: numbers of nodes and iterations, and what is allowed.
    """
    driven, twice = half.driven, 2.0 * half.driven.solid.depth_scale_nm
    nodes = setting.pressing if half.pressing else setting.releasing
    turn, mean = guess
    points, weights, cumulative = nodes_along(nodes, turn)
    averages = jnp.asarray(mean_matrix(nodes), turn.dtype)

    def mean_depth_slope(turn, s):
        return driven.solid.mean_slopes(turn, s)[1]

    passing = weights - cumulative if half.pressing else cumulative

    def improve(turn: Array, means: Array) -> tuple[Array, Array, Array]:
        at = half.along(turn, points, means)
        moment = begin_us + jnp.tensordot(passing, at.time_slope, axes=1)
        rate = -at.y * at.over_y if half.pressing else at.y * at.over_y
        g = driven.acceleration(driven.gap_of_root(at.s), rate, moment, jnp.zeros_like(rate))
        # in the mean over the depth every node counts by its slope
        total = jnp.tensordot(averages, g * at.slope, axes=1)
        mean = total[-1] / mean_depth_slope(turn, half.end)
        after = _turn_under(driven, half.end, level, mean, turn) if half.pressing else turn
        return after, total[:-1] / mean_depth_slope(turn, at.s), mean

    state = turn, mean + jnp.zeros_like(points)
    turn, before = lax.fori_loop(1, setting.junction_iterations, lambda _, state: improve(*state)[:2], state)
    turn, means, mean = improve(turn, before)
    at = half.along(turn, points, means)
    duration = jnp.tensordot(weights, at.time_slope, axes=1)
    change = jnp.abs((means - before) * twice * mean_depth_slope(turn, at.s)) / at.over_y**2
    return turn, begin_us + duration, mean, setting.suffices(change, at.time_slope, duration)


def _turn_under(driven: Driven, form: Array, level: Array, mean: Array, turn: Array) -> Array:
    """Return s at the turning point, improved by a step of Newton's method, under a mean of g."""
    unit, twice, solid = _unit(driven), 2.0 * driven.solid.depth_scale_nm, driven.solid
    excess = unit * (solid.work(turn) - level) + twice * mean * (solid.depth(turn) - solid.depth(form))
    return turn - excess / (solid.depth_slope(turn) * (unit * solid.load(turn) + twice * mean))


def _time_to_fold(tip: Driven, start: Float[Array, "..."], leaving: Float[Array, "..."], nodes: int) -> Array:
    """Return the time between the fold, left with a kinetic energy in the unit of the work, and s = start."""
    points, weights, _ = nodes_along(nodes, leaving)
    solid = tip.solid
    fold, width = solid.fold, solid.width(leaving)
    reach = jnp.arcsinh((start - fold) / width)
    # sinh and cosh from one exponential: the library's own are ten times slower
    grown = jnp.exp(reach * points)
    s = fold + 0.5 * width * (grown - 1.0 / grown)
    kinetic = leaving + (solid.work(fold) - solid.work(s))
    moving = kinetic > 0.0
    rate = jnp.sqrt(jnp.where(moving, kinetic, 1.0))
    time_slope = jnp.where(moving, solid.depth_slope(s) * 0.5 * width * (grown + 1.0 / grown) / rate, 0.0)
    scale = tip.solid.depth_scale_nm / jnp.sqrt(_unit(tip))
    return jnp.tensordot(weights, reach * time_slope * scale, axes=1)
