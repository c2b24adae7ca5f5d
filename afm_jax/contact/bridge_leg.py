"""The way of a tip through the liquid bridge, free or driven, with the gap D as independent variable.

Takes a tip (`Driven`), its kinetic energy in aJ or its state at one end; gives energy, time in us and what was
dissipated in aJ at the other end (eqs. 10 to 13 and 16).

Where the bridge is crossed monotonically the gap can replace time. With the kinetic energy K = m w^2/2, w the size of
the gap's rate, the potential U of the static forces and the spring, and the energy S that is spent, K + U + S is the
energy at the start (eq. 16, integrated once). The static forces, which vary most, leave the equation, S is integrated,

    dS/d|path| = (damping(D) + m Omega/Q) w + sense m q(t),    dt/d|path| = 1/w,

sense +1 on the way in and -1 on the way out, q the push of the surface's motion on the gap in nm/us^2 (`Drive`). S is
what bridge and air dissipate and what the push takes; a `Passage` tells what the bridge dissipates apart. A free tip
has neither Omega nor q. A new force is a term of the contact (`bridge_of`) and needs nothing here. The gap is a
function of the fraction of the way that is done, chosen so that the square roots of w at the ends are gone (`Exit`,
`Turning`).

`way_through` states the problem, `pass_bridge` solves it for a free tip by one of two integrators: Picard's iterations
over Gauss nodes (`collocate`), or Diffrax's steps (`pass_in_steps`). `go_in` and `go_out` are the legs of driven
tips, `turn_in_bridge` is the impact of a tip that never reaches the junction.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from afm_jax.contact.driven import ContactState, Driven, Leg
from afm_jax.contact.settings import QuickSetting, Setting
from afm_jax.solve.derivatives import halved, implicit_root
from afm_jax.solve.quadrature import gauss_nodes, nodes_along

_NEAREST = 1e-14
"""Lower bound of b: at 0 speed and square root would vanish together."""
_STEEP = 1e-10
"""Values of b below which it has no derivative."""
GRADING = 1.6
"""Steps towards the inner end shrink on the way in, where the core repulsion rises as the 8th power."""
_SLOWEST = 0.01
"""Fraction of K at the start below which no iteration lets it fall: a slower driven tip is followed in time."""
_REMEMBERED = 20
"""Steps up to which reverse mode keeps what it needs of each; of more it computes them again."""
_WRITTEN_OUT = 3
"""Iterations up to which a loop of them is written out in the program."""
_SCAN = 256
"""Gaps at which a turning point is looked for."""


class Exit(NamedTuple):
    """D = scale exp(-y^2), y linear in the fraction: smooth where the tip is slow at the outer end, on either way.

    The scale is exp(b) times the outer gap. A tip that is slow at the outer end would, a little farther out, be turned
    round by the bridge's pull: b is how much farther in ln D, and at most 1 (`margin_of`).
    """

    scale_nm: Float[Array, "..."]
    start_y: Float[Array, "..."]
    length: Float[Array, "..."]
    sense: float

    def at(self, fraction: Float[Array, "..."]) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        """Return the gap in nm, and the path |dD| per fraction of the way."""
        y = self.start_y + self.sense * (self.length * fraction)
        gap = self.scale_nm * jnp.exp(-y * y)
        return gap, 2.0 * self.length * y * gap


class Turning(NamedTuple):
    """ln D from start to end as sin^2(pi fraction/2): smooth where the tip turns round at either end."""

    start_nm: Float[Array, "..."]
    end_nm: Float[Array, "..."]

    def at(self, fraction: Float[Array, "..."]) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        """Return the gap in nm, and the path |dD| per fraction of the way."""
        width = jnp.log(self.end_nm / self.start_nm)
        gap = self.start_nm * jnp.exp(width * jnp.sin(0.5 * jnp.pi * fraction) ** 2)
        return gap, jnp.abs(width) * 0.5 * jnp.pi * jnp.sin(jnp.pi * fraction) * gap


class Passage(NamedTuple):
    """What a way through the bridge ends with."""

    energy_aj: Float[Array, "..."]
    """Kinetic energy at the end, signed: negative by what is missing where the tip does not get there."""
    time_us: Float[Array, "..."]
    """Time taken; meaningless where the energy is not positive."""
    dissipated_aj: Float[Array, "..."]
    """Energy lost to the contact's dissipative forces, without the cantilever's own damping."""


class Along(NamedTuple):
    """What does not depend on the speed, at points of a way."""

    gap_nm: Float[Array, "..."]
    path_nm: Float[Array, "..."]
    """|dD| per fraction of the way."""
    drag: Float[Array, "..."]
    """Path times damping, in nN us: times the speed it is the energy dissipated per fraction."""
    available_aj: Float[Array, "..."]
    """The kinetic energy if nothing had been spent."""


class Way(NamedTuple):
    """A way through the bridge; made by `way_through`."""

    tip: Driven
    sense: float
    """+1 on the way in, -1 on the way out."""
    begin_us: Float[Array, "..."]
    total_aj: Float[Array, "..."]
    """Energy at the start, kinetic and potential."""
    end_potential_aj: Float[Array, "..."]
    course: Exit | Turning
    slowest_aj: Float[Array, "..."] | None = None
    """Floor of the kinetic energy, which keeps the integrand finite; None: a tip stops where it has none."""

    @property
    def inward(self) -> bool:
        """Whether the tip approaches."""
        return self.sense > 0.0

    @property
    def quiet(self) -> bool:
        """Whether nothing is spent along the way."""
        return self.tip.drive is None and self.tip.bridge.conserves

    def along(self, fraction: Float[Array, "..."]) -> Along:
        """Return gap, path, drag and energy at fractions of the way."""
        gap, path = self.course.at(fraction)
        drag = jnp.zeros_like(path) if self.tip.bridge.conserves else path * self.tip.bridge.damping(gap)
        return Along(gap, path, drag, self.total_aj - self.tip.potential(gap))

    def speed_and_time_slope(
        self, path: Float[Array, "..."], kinetic: Float[Array, "..."]
    ) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        """Return the speed in nm/us, and the time in us per fraction; both 0 where the tip has stopped.

        Args:
            path: |dD| per fraction.
            kinetic: kinetic energy in aJ.
        """
        twice_inverse_mass = 2.0 * self.tip.inverse_mass
        if self.slowest_aj is not None:
            speed = jnp.sqrt(twice_inverse_mass * jnp.maximum(kinetic, self.slowest_aj))
            return speed, path / speed
        moving = kinetic > 0.0
        speed = jnp.sqrt(jnp.where(moving, kinetic * twice_inverse_mass, 1.0))
        return jnp.where(moving, speed, 0.0), jnp.where(moving, path / speed, 0.0)

    def spending(self, at: Along, speed: Float[Array, "..."], lasted_us: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return dS/d(fraction) in aJ: what drag, air and the surface's push take of the kinetic energy.

        Args:
            at: the points of the way.
            speed: there, in nm/us.
            lasted_us: times since the start, at which the push is taken.
        """
        drive, lost = self.tip.drive, at.drag * speed
        if drive is None:
            return lost
        friction = 2.0 * drive.cantilever.decay_rate
        push = drive.push.position(self.begin_us + lasted_us)
        return lost + self.tip.mass_ng * at.path_nm * (friction * speed + self.sense * push)

    def end(
        self, spent: Float[Array, "..."], time: Float[Array, "..."], dissipated: Float[Array, "..."] | None = None
    ) -> Passage:
        """Return the passage from the energy spent, the time, and the energy dissipated; None: all that is spent."""
        return Passage(self.total_aj - self.end_potential_aj - spent, time, spent if dissipated is None else dissipated)


def way_through(
    tip: Driven,
    gaps_nm: tuple[Float[Array, "..."], Float[Array, "..."]],
    start_energy_aj: Float[Array, "..."],
    margin: Float[Array, "..."],
    *,
    inward: bool,
    begin_us: Float[Array, "..."] | float = 0.0,
) -> Way:
    """Return a way through the bridge.

    Args:
        tip: the tip.
        gaps_nm: the outer and the inner gap, whatever the direction.
        start_energy_aj: kinetic energy at the start.
        margin: b, how far beyond the outer end the speed would vanish, in ln D (`margin_of`).
        inward: whether the tip goes from the outer to the inner gap.
        begin_us: time at the start.
    """
    potentials = tuple(tip.potential(gap) for gap in gaps_nm)
    start, end = potentials if inward else potentials[::-1]
    total = start_energy_aj + start
    outer, inner = gaps_nm
    at_outer, at_inner = jnp.sqrt(margin), jnp.sqrt(margin + jnp.log(outer / inner))
    sense = 1.0 if inward else -1.0
    course = Exit(outer * jnp.exp(margin), at_outer if inward else at_inner, at_inner - at_outer, sense)
    return Way(tip, sense, jnp.asarray(begin_us, total.dtype), total, end, course)


def margin_of(energy: Float[Array, "..."], pull: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return b, without unit, between 0 and 1: the kinetic energy at the outer end over that end's pull.

    Close to capture b has no derivative: it chooses the variable of the integration and not its result, and the
    derivative of sqrt(b), up to 1e7, would bring the last digits of the integration into every gradient. Farther off
    the derivative keeps the variable where the speed is smooth in it.

    Args:
        energy: kinetic energy at the outer end, in aJ.
        pull: -F(D) D there, the bridge's attraction times the gap, in aJ.
    """
    near = energy < pull
    margin = jnp.where(near, jnp.maximum(energy, _NEAREST * pull) / jnp.where(near, pull, 1.0), 1.0)
    return jnp.where(margin < _STEEP, lax.stop_gradient(margin), margin)


class Collocation(NamedTuple):
    """A way by Picard's iterations: its end, and values at the Gauss nodes."""

    passage: Passage
    at: Along
    kinetic_aj: Float[Array, "nodes ..."]
    speed: Float[Array, "nodes ..."]
    time_slope: Float[Array, "nodes ..."]
    """Time in us per fraction."""
    lasted_us: Float[Array, "nodes ..."]
    """Time from the start."""
    change_aj: Float[Array, "nodes ..."]
    """By how much the last iteration has changed the energy spent at the nodes."""
    end_change_aj: Float[Array, "..."]
    """By how much the last iteration has changed the energy that a free tip has spent at the end."""


def collocate(way: Way, nodes: int, iterations: int) -> Collocation:
    """Return a way by collocation at Gauss nodes.

    Each iteration takes the speeds from the energy spent, the times from the speeds, and the energy spent from both.

    Args:
        way: the way.
        nodes: number of Gauss nodes.
        iterations: how many.
    """
    points, weights, cumulative = nodes_along(nodes, way.total_aj)
    at, drive = way.along(points), way.tip.drive

    def again(spent: Array) -> tuple[Array, Array]:
        speed, time_slope = way.speed_and_time_slope(at.path_nm, at.available_aj - spent)
        spending = way.spending(at, speed, jnp.tensordot(cumulative, time_slope, axes=1))
        return jnp.tensordot(cumulative, spending, axes=1), spending

    guess = jnp.zeros_like(at.available_aj)
    if drive is not None:
        # of a push that does not change on the way
        start_nm = way.course.at(jnp.zeros_like(way.total_aj))[0]
        guess = guess - way.tip.mass_ng * drive.push.position(way.begin_us) * (at.gap_nm - start_nm)
    spent = before = spending = guess
    if not way.quiet:
        # few are written out in the program
        unroll = iterations <= _WRITTEN_OUT
        before = lax.fori_loop(1, iterations, lambda _, spent: again(spent)[0], guess, unroll=unroll)
        spent, spending = again(before)
    kinetic = at.available_aj - spent
    speed, time_slope = way.speed_and_time_slope(at.path_nm, kinetic)
    lost = at.drag * speed
    ends = [jnp.tensordot(weights, part, axes=1) for part in (lost, time_slope, spending)]
    return Collocation(
        # the push at the nodes costs more than another iteration's digits of the end are worth
        passage=way.end(ends[0], ends[1]) if drive is None else way.end(ends[2], ends[1], ends[0]),
        at=at,
        kinetic_aj=kinetic,
        speed=speed,
        time_slope=time_slope,
        lasted_us=jnp.tensordot(cumulative, time_slope, axes=1),
        change_aj=jnp.abs(spent - before),
        end_change_aj=jnp.abs(ends[0] - ends[2]),
    )


def _pass_conserving(way: Way, nodes: int) -> Passage:
    """Return the passage where nothing is spent: one quadrature of the time, its nodes in a loop of one small body.

    Arrays of all nodes, as `collocate` has them, take four times as long.
    """
    points, weights, _ = gauss_nodes(nodes)

    def add(total, node):
        at = way.along(node[0])
        return total + node[1] * way.speed_and_time_slope(at.path_nm, at.available_aj)[1], None

    nothing = jnp.zeros_like(way.total_aj)
    pairs = jnp.asarray(np.stack([points, weights], axis=1), nothing.dtype)
    return way.end(nothing, lax.scan(add, nothing, pairs)[0])


def pass_in_steps(way: Way, steps: int, solver: str = "Dopri8") -> Passage:
    """Return the passage of a free tip after a fixed number of Diffrax's steps; differentiable forward and reverse.

    Args:
        way: the way.
        steps: number of steps.
        solver: the name of a Runge-Kutta solver of Diffrax.
    """
    import diffrax  # noqa: PLC0415  # half a second

    # the kind of scan that can be differentiated both ways
    chosen = getattr(diffrax, solver)(scan_kind="bounded")

    def rates(fraction: Any, spent_and_time: tuple[Array, Array], _: Any) -> tuple[Array, Array]:
        at = way.along(fraction)
        speed, time_slope = way.speed_and_time_slope(at.path_nm, at.available_aj - spent_and_time[0])
        return at.drag * speed, time_slope

    term = diffrax.ODETerm(rates)

    # The fraction of the way is the time of the solver, one for all tips: a batch is an axis of the state, which costs
    # less than a batch of solvers.
    def step(carried, ends):
        state, memory = carried
        after, _, _, memory, _ = chosen.step(term, ends[0], ends[1], state, None, memory, made_jump=False)
        return (after, memory), None

    fractions = np.linspace(0.0, 1.0, steps + 1)
    if way.inward:
        fractions = 1.0 - (1.0 - fractions) ** GRADING
    begin = (jnp.zeros_like(way.total_aj),) * 2
    ends = jnp.stack([fractions[:-1], fractions[1:]], axis=1).astype(begin[0].dtype)
    memory = chosen.init(term, ends[0, 0], ends[0, 1], begin, None)
    # in reverse mode many steps are computed again one by one, few are remembered
    (state, _), _ = lax.scan(step if steps <= _REMEMBERED else jax.checkpoint(step), (begin, memory), ends)
    return way.end(*state)


def approach_through_bridge(tip: Driven, energy_aj: Float[Array, "..."], setting: Setting) -> Passage:
    """Return the way of a free tip from where the bridge forms to where the junction does, from a kinetic energy."""
    margin = margin_of(energy_aj, pull_at(tip, tip.forms_nm))
    gaps = tip.forms_nm, tip.junction.forms_gap_nm
    return _pass_bridge(way_through(tip, gaps, energy_aj, margin, inward=True), setting)


def retract_through_bridge(tip: Driven, energy_aj: Float[Array, "..."], setting: Setting) -> Passage:
    """Return the way of a free tip from where the junction breaks to where contact ends, from a kinetic energy."""
    gaps = tip.ends_nm, tip.junction.breaks_gap_nm

    def out(margin: Float[Array, "..."]) -> Way:
        return way_through(tip, gaps, energy_aj, margin, inward=False)

    # twice: roughly, for the energy at its end and so for its margin, then as the setting says
    trial = out(jnp.full_like(energy_aj, 1e-3))
    end = trial.total_aj - trial.end_potential_aj if trial.quiet else collocate(trial, 6, 1).passage.energy_aj
    return _pass_bridge(out(margin_of(end, pull_at(tip, tip.ends_nm))), setting)


def pull_at(tip: Driven, gap_nm: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return -F(D) D in aJ: beside it a small kinetic energy counts as slow (`margin_of`)."""
    return -tip.bridge.force(gap_nm) * gap_nm


def _pass_bridge(way: Way, setting: Setting) -> Passage:
    """Return the passage by the integrator of a setting; of no length where the solids meet where contact begins."""
    if not way.tip.bridge.spans:
        nothing = jnp.zeros_like(way.total_aj)
        return way.end(nothing, nothing)
    size = setting.inward if way.inward else setting.outward
    if way.quiet:
        return _pass_conserving(way, max(size, setting.junction_nodes))
    if setting.rule == "collocation":
        return collocate(way, size, setting.iterations).passage
    return pass_in_steps(way, size, setting.solver)


def go_in(driven: Driven, state: ContactState, setting: QuickSetting) -> Leg:
    """Return a tip where the junction forms, from a state in the bridge with the gap closing; x is s at the end."""
    if not driven.bridge.spans:
        # it has formed where the contact began
        return Leg(state, state.x, jnp.zeros_like(state.x, bool))
    gaps = state.x, driven.junction.forms_gap_nm
    leg = _cross(driven, gaps, state, setting, setting.inward, inward=True)
    root = driven.junction.forms_root + jnp.zeros_like(state.x)
    return leg._replace(state=leg.state._replace(x=root), holds=leg.holds & (state.gap_rate < 0.0))


def go_out(driven: Driven, state: ContactState, setting: QuickSetting) -> Leg:
    """Return a tip where the bridge breaks, from where the junction has broken with the gap opening."""
    if not driven.bridge.spans:
        return Leg(state, state.x, state.gap_rate > 0.0)
    gaps = driven.breaks_nm, driven.junction.breaks_gap_nm
    leg = _cross(driven, gaps, state, setting, setting.outward, inward=False)
    return leg._replace(holds=leg.holds & (state.gap_rate > 0.0) & (gaps[1] < gaps[0]))


def _cross(
    driven: Driven, gaps: tuple[Array, Array], state: ContactState, setting: QuickSetting, nodes: int, *, inward: bool
) -> Leg:
    """Return the leg of a tip from a state at the outer (`inward`) or at the inner one of two gaps to the other one."""
    outer, inner = gaps
    start = 0.5 * driven.mass_ng * state.gap_rate**2
    at_outer, pull, slowest = start, pull_at(driven, outer), _SLOWEST * start
    if not inward:
        at_outer = start + driven.potential(inner) - driven.potential(outer)
        if driven.drive is not None:
            at_outer = at_outer + driven.mass_ng * driven.drive.push.position(state.time_us) * (outer - inner)
    margin = lax.stop_gradient(margin_of(jnp.maximum(at_outer, 0.01 * pull), jnp.maximum(pull, 1e-30)))
    way = way_through(driven, gaps, start, margin, inward=inward, begin_us=state.time_us)
    collocation = collocate(way._replace(slowest_aj=slowest), nodes, setting.iterations)
    end = collocation.passage
    leaving = jnp.sqrt(2.0 * driven.inverse_mass * end.energy_aj)
    holds = setting.suffices(collocation.change_aj / collocation.kinetic_aj, collocation.time_slope, end.time_us)
    return Leg(
        state=ContactState(
            x=(inner if inward else outer) + jnp.zeros_like(leaving),
            gap_rate=-leaving if inward else leaving,
            time_us=state.time_us + end.time_us,
            viscous_loss_aj=state.viscous_loss_aj + end.dissipated_aj,
        ),
        deepest_gap_nm=inner + jnp.zeros_like(leaving),
        holds=holds & jnp.all(collocation.kinetic_aj > slowest, axis=0) & (leaving > 0.0),
    )


class Turn(NamedTuple):
    """What an impact ends with when the bridge's repulsion stops a slow tip before the junction forms.

    It turns at the gap where the potential equals the energy that is left.
    """

    turns: Bool[Array, "..."]
    """Whether the tip turns before it reaches the gap where the junction forms."""
    gap_nm: Float[Array, "..."]
    energy_aj: Float[Array, "..."]
    """Kinetic energy where the bridge breaks, signed."""
    dissipated_aj: Float[Array, "..."]
    time_us: Float[Array, "..."]
    """From the formation of the bridge to its breaking."""
    settled: Bool[Array, "..."]
    """Whether the iterations for the dissipated energy settled."""


@jax.jit
def turn_in_bridge(tip: Driven, approach_speed: Float[Array, "..."], spent: Float[Array, "..."]) -> Turn:
    """Return the impact of a free tip that turns in the bridge.

    Args:
        tip: the tip.
        approach_speed: in nm/us.
        spent: energy dissipated on the way in, estimated, in aJ.
    """
    total = 0.5 * tip.mass_ng * approach_speed**2 + tip.potential(tip.forms_nm)

    def half(start: Array, end: Array, level: Array) -> tuple[Passage, Array]:
        way = Way(tip, 1.0, jnp.zeros_like(level), level, tip.potential(end), Turning(start, end))
        found = collocate(way, 48, 12)
        scale = jnp.abs(level) + jnp.abs(found.passage.dissipated_aj)
        return found.passage, found.end_change_aj <= 1e-9 * scale + 1e-12

    def inwards(_, before):
        # as often as the gap needs to settle
        gap, turns = _turning_gap(tip, total - before[2].dissipated_aj)
        return gap, turns, *half(tip.forms_nm, gap, total)

    nothing = jnp.zeros_like(total)
    guess = nothing, nothing > 0.0, Passage(nothing, nothing, spent + nothing), nothing > 0.0
    gap, turns, inward, settles_in = lax.fori_loop(0, 3, inwards, guess)
    outward, settles_out = half(gap, tip.breaks_nm, tip.potential(gap))
    return Turn(
        turns=turns,
        gap_nm=gap,
        energy_aj=outward.energy_aj,
        dissipated_aj=inward.dissipated_aj + outward.dissipated_aj,
        time_us=inward.time_us + outward.time_us,
        settled=settles_in & settles_out,
    )


def _turning_gap(tip: Driven, level: Float[Array, "..."]) -> tuple[Float[Array, "..."], Bool[Array, "..."]]:
    """Return the largest gap in nm at which the potential rises to a level in aJ, and whether there is one."""
    outer, inner = tip.forms_nm, tip.junction.forms_gap_nm
    log_gaps = jnp.log(outer) + jnp.log(inner / outer) * jnp.linspace(0.0, 1.0, _SCAN, dtype=level.dtype)
    log_gaps, *fixed = lax.stop_gradient((log_gaps, tip, level))
    above = _potential_excess(log_gaps, fixed)
    # only repulsion stops a tip, so that it turns closer to the sample than where the potential is least
    stopped = (jnp.arange(_SCAN) > jnp.argmin(above)) & (above >= 0.0)
    first = jnp.maximum(jnp.argmax(stopped), 1)
    ends = log_gaps[first - 1], log_gaps[first]
    turning = halved(lambda log_gap: _potential_excess(log_gap, fixed) < 0.0, *ends, rounds=60)[1]
    return jnp.exp(implicit_root(_potential_excess, turning, (tip, level))), stopped.any()


def _potential_excess(log_gap: Float[Array, "..."], of: Sequence[Any]) -> Float[Array, "..."]:
    """Return by how much in aJ the potential at a gap is above a level."""
    tip, level = of
    return tip.potential(jnp.exp(log_gap)) - level
