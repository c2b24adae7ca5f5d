"""Steps in time of a tip in contact: frozen phase, thresholds met exactly, turning points not passed over.

A trial is one step of Dormand and Prince's method of order 8, Diffrax's own or a leaner one with the same coefficients.
A trial that ends within the phase is taken. One that passes a threshold, or the end of the simulation, is not: its
cubic says where to try again, until a trial ends so close to the threshold that a parabola corrects its length to
rounding. Step lengths follow from the place alone (no error control), so that results are smooth in every parameter;
the correction carries the derivative of the time at which the threshold is met.
"""

from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from afm_jax.contact.driven import Driven, Place
from afm_jax.contact.junction import Phase

_NEAR = 1e-7
"""Share of a threshold from which on the correction by a parabola is exact to rounding."""
_SHORTEST = 1e-3
"""Bounds of the share of a failed trial at which the next is tried: this, and 1 less a tenth of it."""
_SHARE = 0.4
"""Share of the gap where the junction forms: there the core's force varies in a fraction of the gap, 1 - this."""
_FROM_REST = 0.5
_CUBIC_STEPS = 4


class Touch(NamedTuple):
    """A tip in contact, and what the contact has been so far; arrays of the tips' shape."""

    place: Place
    phase: Int[Array, "..."]
    trial: Float[Array, "..."]
    """Length of the next trial; 0: as the place suggests; negative: ends at a turning point."""
    junctions: Int[Array, "..."]
    junction_forms_us: Float[Array, "..."]
    junction_breaks_us: Float[Array, "..."]
    time_in_junction_us: Float[Array, "..."]
    deepest_gap_nm: Float[Array, "..."]
    trials: Int[Array, "..."]


def fresh_touch(place: Place, phase: Int[Array, "..."]) -> Touch:
    """Return a tip at the beginning of a contact (or a free one, in phase DRY)."""
    none, zero = jnp.zeros_like(phase, dtype=jnp.int32), jnp.zeros_like(place.x)
    return Touch(place, phase.astype(jnp.int32), zero, none, zero, zero, zero, place.x, none)


class Trial(NamedTuple):
    """A step that was tried."""

    length: Float[Array, "..."]
    start: Place
    start_rates: Place
    end: Place
    end_rates: Place
    low: Float[Array, "..."]
    """Thresholds of x in this phase: D_on and the breaking gap, or the fold and none."""
    high: Float[Array, "..."]

    @property
    def near_low(self) -> Float[Array, "..."]:
        """Distance from the low threshold within which the correction is exact; that may be 0, at a dry contact's fold."""
        return _NEAR * jnp.where(self.low > 0.0, self.low, self.start.x)


def advance(
    driven: Driven,
    touch: Touch,
    until_us: Float[Array, "..."],
    fineness: float | Float[Array, "..."],
    method: str = "collocation",
) -> Touch:
    """Return a tip in contact after one trial.

    Args:
        driven: the equation of motion.
        touch: the tip; its phase is not DRY.
        until_us: end of the simulation.
        fineness: steps per unit of the local pace; larger is more accurate.
        method: "diffrax" for steps by Diffrax's solver, else leaner ones with the same coefficients.
    """
    trial = _tried(driven, touch, until_us, fineness, diffrax_step if method == "diffrax" else eighth_order_step)
    solid = touch.phase == Phase.JUNCTION
    early, late, spent = _passed(trial, until_us)
    retry, again = _where_next(trial, touch.trial < 0.0, until_us)
    landed = _land(trial, until_us, early, late, spent)
    hit_low, hit_high = landed.low & ~retry, landed.high & ~retry
    place = landed.place
    # a broken junction leaves the tip in the bridge where that still holds, else free
    wet = driven.junction.breaks_gap_nm < driven.breaks_nm
    broken = solid & hit_low
    formed = ~solid & hit_low
    phase = jnp.where(formed, Phase.JUNCTION, touch.phase)
    phase = jnp.where(broken, jnp.where(wet, Phase.BRIDGE, Phase.DRY), phase)
    phase = jnp.where(~solid & hit_high, Phase.DRY, phase).astype(touch.phase.dtype)
    x = jnp.where(formed, driven.junction.forms_root, place.x)
    x = jnp.where(broken, driven.junction.breaks_gap_nm, x)
    place = place._replace(x=x)
    passed = jnp.where(solid, place.time_us - touch.place.time_us, 0.0)
    return Touch(
        place=_pick(retry, touch.place, place),
        phase=jnp.where(retry, touch.phase, phase),
        trial=jnp.where(retry, again, 0.0),
        junctions=touch.junctions + formed.astype(touch.junctions.dtype),
        junction_forms_us=jnp.where(formed & (touch.junctions == 0), place.time_us, touch.junction_forms_us),
        junction_breaks_us=jnp.where(broken, place.time_us, touch.junction_breaks_us),
        time_in_junction_us=touch.time_in_junction_us + jnp.where(retry, 0.0, passed),
        deepest_gap_nm=jnp.where(
            retry, touch.deepest_gap_nm, jnp.minimum(touch.deepest_gap_nm, _deepest(driven, trial, solid))
        ),
        trials=touch.trials + 1,
    )


def _tried(
    driven: Driven, touch: Touch, until_us: Float[Array, "..."], fineness: float | Array, step: Callable[..., Place]
) -> Trial:
    start, solid = touch.place, touch.phase == Phase.JUNCTION
    low = jnp.where(solid, driven.solid.fold, driven.junction.forms_gap_nm)
    high = jnp.where(solid, jnp.inf, driven.breaks_nm)
    rates = driven.rates(start, solid)
    fixed, slopes = lax.stop_gradient((start, rates))
    natural = 1.0 / (fineness * _pace(driven, fixed, slopes, solid))
    aim = _aimed(fixed, slopes, lax.stop_gradient((low, high)), lax.stop_gradient(until_us))
    fresh = jnp.where(aim < 1.2 * natural, aim, natural)
    length = lax.stop_gradient(jnp.where(touch.trial == 0.0, fresh, jnp.abs(touch.trial)))
    end = step(lambda place: driven.rates(place, solid), start, length)
    return Trial(length, start, rates, end, driven.rates(end, solid), low, high)


def _pace(driven: Driven, place: Place, rates: Place, solid: Bool[Array, "..."]) -> Float[Array, "..."]:
    place = lax.stop_gradient(place)
    in_bridge = place._replace(x=jnp.where(solid, driven.forms_nm, place.x))
    in_junction = place._replace(x=jnp.where(solid, place.x, 1.0))
    wet = bridge_pace(driven, in_bridge, rates.gap_rate)
    return lax.stop_gradient(jnp.where(solid, junction_pace(driven, in_junction), wet))


def _aimed(place: Place, rates: Place, thresholds: tuple[Array, Array], until_us: Float[Array, "..."]) -> Array:
    """Return the length after which the place's parabola meets the threshold ahead, or time ends; infinite if never."""
    low, high = thresholds
    aim = _to_meet(place, rates, jnp.where(rates.x < 0.0, low, high) - place.x)
    left = (until_us - place.time_us) / rates.time_us
    return jnp.minimum(jnp.where(aim > 0.0, aim, jnp.inf), jnp.where(left > 0.0, left, jnp.inf))


def _to_meet(place: Place, rates: Place, distance: Array) -> Array:
    """Return the length after which the place's parabola has gone a distance in x; infinite if never."""
    # x'' along the step: in both phases x' is proportional to the gap's rate, whose slope is known
    ratio = rates.x / jnp.where(place.gap_rate == 0.0, 1.0, place.gap_rate)
    bend = 0.5 * ratio * rates.gap_rate
    square = rates.x * rates.x + 4.0 * bend * distance
    meets = (square > 0.0) & jnp.isfinite(distance) & (rates.x != 0.0)
    root = jnp.where(rates.x < 0.0, -1.0, 1.0) * jnp.sqrt(jnp.where(meets, square, 1.0))
    return jnp.where(meets, 2.0 * jnp.where(meets, distance, 1.0) / jnp.where(meets, rates.x + root, 1.0), jnp.inf)


def _passed(
    trial: Trial, until_us: Float[Array, "..."]
) -> tuple[Bool[Array, "..."], Bool[Array, "..."], Bool[Array, "..."]]:
    """Say whether the trial ends at or beyond the low threshold, the high one, the end of the simulation."""
    x = trial.end.x
    # a step shorter than the rounding of the time would never end
    rounding = 8.0 * jnp.finfo(x.dtype).eps * (1.0 + jnp.abs(until_us))
    return x <= trial.low, x >= trial.high, trial.end.time_us >= until_us - rounding


def _where_next(trial: Trial, at_turn: Bool[Array, "..."], until_us: Float[Array, "..."]) -> tuple[Array, Array]:
    """Say whether a trial must be repeated, and with which length (negative: to a turning point)."""
    start, rates, end, slopes = lax.stop_gradient((trial.start, trial.start_rates, trial.end, trial.end_rates))
    low, high, until = lax.stop_gradient((trial.low, trial.high, until_us))
    length = trial.length
    finite = jnp.isfinite(end.x) & jnp.isfinite(end.gap_rate) & jnp.isfinite(slopes.gap_rate)
    below, above, late = (end.x < low), (end.x > high), end.time_us > until

    # a threshold nearly met needs no other trial
    beyond_low = below & (low - end.x > lax.stop_gradient(trial.near_low))
    beyond_high = above & (end.x - high > _NEAR * high)
    beyond_time = late & (end.time_us - until > _NEAR * length * jnp.maximum(slopes.time_us, 1e-3))
    level = jnp.where(below, low, jnp.where(above, high, 0.0))
    in_x = _crossing_share(start.x - level, rates.x * length, end.x - level, slopes.x * length)
    in_time = _crossing_share(
        start.time_us - until, rates.time_us * length, end.time_us - until, slopes.time_us * length
    )
    shares = jnp.minimum(jnp.where(beyond_low | beyond_high, in_x, 1.0), jnp.where(beyond_time, in_time, 1.0))
    missed = beyond_low | beyond_high | beyond_time
    turns = (rates.x * slopes.x < 0.0) & ~at_turn & ~missed & ~(below | above | late)
    turn, extremum = _turning_point(start.x, rates.x * length, end.x, slopes.x * length)
    hidden = turns & ((extremum <= low) | (extremum >= high))
    again = length * jnp.clip(shares, _SHORTEST, 1.0 - 0.1 * _SHORTEST)
    again = jnp.where(hidden, -length * jnp.clip(turn, _SHORTEST, 1.0 - 0.1 * _SHORTEST), again)
    # lengths at which rounding decides are taken as they are
    resolved = length > 1e-15 * (1.0 + jnp.abs(start.time_us))
    return (missed | hidden | ~finite) & resolved, jnp.where(finite, again, 0.25 * length)


class _Landing(NamedTuple):
    place: Place
    low: Bool[Array, "..."]
    high: Bool[Array, "..."]


def _land(trial: Trial, until_us: Float[Array, "..."], below: Array, above: Array, late: Array) -> _Landing:
    """Return the trial's end, moved onto the threshold that it has met."""
    end, rates = trial.end, trial.end_rates
    near_low = below | (end.x - trial.low < trial.near_low) & (end.gap_rate != 0.0) & (rates.x < 0.0)
    near_high = above | (trial.high - end.x < _NEAR * trial.high) & (rates.x > 0.0)
    target = jnp.where(near_low, trial.low, jnp.where(near_high, trial.high, end.x))
    at_threshold = near_low | near_high
    # where the tip is slow, its acceleration counts in that little, too
    rest = _to_meet(end, rates, target - end.x)
    rest = jnp.where(at_threshold & jnp.isfinite(rest), rest, 0.0)
    ends = late & ~at_threshold
    rest = jnp.where(ends, (until_us - end.time_us) / jnp.where(ends, rates.time_us, 1.0), rest)
    moved = jax.tree.map(lambda value, rate: value + rate * rest, end, rates)
    place = moved._replace(x=jnp.where(at_threshold, target, moved.x), time_us=jnp.where(ends, until_us, moved.time_us))
    return _Landing(place, near_low, near_high)


def _deepest(driven: Driven, trial: Trial, solid: Bool[Array, "..."]) -> Float[Array, "..."]:
    """Return the smallest gap of a trial: at its ends, or where its cubic turns."""
    length = trial.length
    turns = (trial.start.gap_rate < 0.0) & (trial.end.gap_rate > 0.0)
    _, extremum = _turning_point(trial.start.x, trial.start_rates.x * length, trial.end.x, trial.end_rates.x * length)
    x = jnp.where(turns, extremum, trial.end.x)
    return jnp.where(solid, driven.gap_of_root(jnp.where(solid, x, 1.0)), x)


def _pick(condition: Bool[Array, "..."], first: Place, second: Place) -> Place:
    return Place(*(jnp.where(condition, one, other) for one, other in zip(first, second, strict=True)))


def bridge_pace(driven: Driven, place: Place, acceleration: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return the pace of a tip in the bridge in 1/us: the inverse of a step.

    The root of the local stiffness over the mass, the speed over the distance in which the forces change, the root of
    the acceleration over it, and the frequencies of cantilever and drive, in squares.

    Args:
        driven: the equation of motion.
        place: where the tip is.
        acceleration: of the gap there, in nm/us^2.
    """
    nearest = driven.junction.forms_gap_nm
    gap = jnp.maximum(place.x, 0.3 * nearest)
    stiffness = jnp.abs(driven.bridge.stiffness(gap)) * driven.inverse_mass
    distance = jnp.maximum(gap - _SHARE * nearest, 0.3 * nearest)
    moving = (place.gap_rate / distance) ** 2 + _FROM_REST * jnp.abs(acceleration) / distance
    return jnp.sqrt(stiffness + moving + _drive_pace(driven) ** 2)


def junction_pace(driven: Driven, place: Place) -> Float[Array, "..."]:
    """Return the pace of a tip in the junction per unit of fictitious time, from the same three."""
    s, curve = place.x, driven.solid
    energy = 0.5 * driven.mass_ng * place.gap_rate**2 / curve.energy_scale_aj
    elastic = curve.bend(s) * driven.load_scale_nn * driven.inverse_mass / driven.depth_scale_nm
    passing = 3.0 * place.gap_rate / (driven.depth_scale_nm * curve.reach(s, energy))
    return 0.8 * jnp.sqrt(elastic + passing**2 + (_drive_pace(driven) * curve.depth_slope(s)) ** 2)


def _drive_pace(driven: Driven) -> Array:
    if driven.drive is None:
        return jnp.zeros_like(driven.inverse_mass)
    return driven.cantilever.angular_frequency + driven.surface.fastest_angular_frequency


def eighth_order_step(rates: Callable[[Place], Place], begin: Place, length: Float[Array, "..."]) -> Place:
    """Return the place after a step, without an error estimate.

    The stages are one small loop over one array, which costs less than half of a general solver's step and hardly
    grows with the number of tips up to a few dozen.

    Args:
        rates: rates of a place, which do not depend on time but by the place.
        begin: the place at the beginning; arrays of one shape.
        length: of the step.
    """
    rows, weights = (jnp.asarray(part, begin.x.dtype) for part in _coefficients())
    start = jnp.stack(begin)

    def stage(number, slopes):
        row = lax.dynamic_index_in_dim(rows, number, keepdims=False)
        place = start + length * jnp.tensordot(row, slopes, axes=1)
        return slopes.at[number].set(jnp.stack(rates(Place(*place))))

    slopes = lax.fori_loop(0, len(weights), stage, jnp.zeros((len(weights), *start.shape), start.dtype))
    return Place(*(start + length * jnp.tensordot(weights, slopes, axes=1)))


def diffrax_step(rates: Callable[[Place], Place], begin: Place, length: Float[Array, "..."]) -> Place:
    """Return the place after a step of Diffrax's own solver; arguments as of `eighth_order_step`."""
    import diffrax  # noqa: PLC0415  # half a second

    solver = diffrax.Dopri8(scan_kind="lax")

    def field(share, place, args):
        del share, args
        return Place(*(length * rate for rate in rates(place)))

    term = diffrax.ODETerm(field)
    zero, one = jnp.zeros((), begin.x.dtype), jnp.ones((), begin.x.dtype)
    memory = solver.init(term, zero, one, begin, None)
    return solver.step(term, zero, one, begin, None, memory, made_jump=False)[0]


@cache
def _coefficients() -> tuple[np.ndarray, np.ndarray]:
    """Return the matrix of the stages, and the weights; the tableau's last stage is the next step's first."""
    from diffrax import Dopri8  # noqa: PLC0415

    tableau = Dopri8.tableau
    weights = np.asarray(tableau.b_sol)[:-1]
    rows = np.zeros((len(weights), len(weights)))
    for number, row in enumerate(tableau.a_lower[:-1]):
        rows[number + 1, : number + 1] = row
    return rows, weights


def _crossing_share(start: Array, start_slope: Array, end: Array, end_slope: Array) -> Float[Array, "..."]:
    """Return the share of a step at which its cubic (values and slopes at both ends) vanishes, between two signs.

    Args:
        start: value at the start.
        start_slope: slope there, times the length of the step.
        end: value at the end, of the other sign.
        end_slope: slope there, times the length of the step.
    """
    bend = 3.0 * (end - start) - 2.0 * start_slope - end_slope
    twist = 2.0 * (start - end) + start_slope + end_slope
    share = start / jnp.where(start == end, 1.0, start - end)

    # a few steps of Newton's method: a miss is only tried again
    def improve(_, share):
        value = start + share * (start_slope + share * (bend + share * twist))
        slope = start_slope + share * (2.0 * bend + 3.0 * share * twist)
        return jnp.clip(share - value / jnp.where(slope == 0.0, 1.0, slope), 0.0, 1.0)

    return lax.fori_loop(0, _CUBIC_STEPS, improve, share)


def _turning_point(start: Array, start_slope: Array, end: Array, end_slope: Array) -> tuple[Array, Array]:
    """Return share and value of the extremum of a step's cubic whose slope changes sign; arguments as above."""
    bend = 3.0 * (end - start) - 2.0 * start_slope - end_slope
    twist = 2.0 * (start - end) + start_slope + end_slope
    # 3 twist x^2 + 2 bend x + start_slope = 0, the root between 0 and 1 in the form that does not cancel
    square = bend * bend - 3.0 * twist * start_slope
    real = square > 0.0
    root = jnp.where(real, jnp.sqrt(jnp.where(real, square, 1.0)), 0.0)
    below = jnp.where(start_slope > 0.0, root, -root) - bend
    share = start_slope / jnp.where(below == 0.0, 1.0, below)
    share = jnp.clip(share, 0.0, 1.0)
    return share, start + share * (start_slope + share * (bend + share * twist))
