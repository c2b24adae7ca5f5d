"""One step in time of a tip in contact, and the search for the events that end a phase.

Takes a `TipInContact` (nm, nm/us, us) and the end of the simulation in us; gives the tip one trial later.

The equation of motion (eq. 16, `Driven.rates`) is smooth within a phase. A phase ends where x, the gap in the bridge
and the root s in the junction, meets a threshold:

    free (DRY) --- x = forms_nm, found by the flight's own search ---> BRIDGE
    BRIDGE     --- x = breaks_nm ------------------------------------> free
               --- x = forms_gap_nm ---------------------------------> JUNCTION
    JUNCTION   --- s = fold -----------------------------------------> BRIDGE where that outlives it, else free

A trial is one step of Dormand and Prince's method of order 8 (Diffrax's coefficients):

    trial of length h --- ends within its phase --------------------> taken
                      --- ends on a threshold or at the simulation's
                          end, to 1e-7 of it -----------------------> taken, moved onto it by a parabola; next phase
                      --- ends beyond one, or turned beyond one ----> repeated: h from the cubic through both ends
                      --- is not finite ----------------------------> repeated with a quarter of h

The length of a step follows from the state alone, without an error estimate, so that results are smooth functions of
every parameter; the parabola carries the derivative of the time at which a threshold is met.
"""

from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from afm_jax.contact.driven import ContactState, Driven
from afm_jax.contact.junction import ContactPhase
from afm_jax.solve.derivatives import slope_of
from afm_jax.solve.newton_steps import newton_steps

_NEAR = 1e-7
"""Relative distance from a threshold within which the parabola is exact to rounding."""
_NEAR_FOLD = 1e-5
"""That of a fold at s = 0, relative to where the step began: s bends little there."""
_SHORTEST = 1e-3
"""Bounds of a repeated trial's length over that of the failed one: this, and 1 less a tenth of it."""


class TipInContact(NamedTuple):
    """A tip in contact, with a record of its contact so far; arrays of the tips' shape."""

    state: ContactState
    phase: Int[Array, "..."]
    """A `ContactPhase`."""
    trial_length: Float[Array, "..."]
    """Length of the next trial; 0: chosen from the state; negative: a trial that ends at a turning point."""
    junctions: Int[Array, "..."]
    """How often the junction has formed."""
    junction_forms_us: Float[Array, "..."]
    """When it first formed."""
    junction_breaks_us: Float[Array, "..."]
    """When it last broke."""
    time_in_junction_us: Float[Array, "..."]
    deepest_gap_nm: Float[Array, "..."]
    trials: Int[Array, "..."]

    @classmethod
    def at_start(cls, state: ContactState, phase: Int[Array, "..."]) -> "TipInContact":
        """Return a tip at the start of a contact, or a free tip (phase DRY)."""
        none, zero = jnp.zeros_like(phase, dtype=jnp.int32), jnp.zeros_like(state.x)
        return cls(state, phase.astype(jnp.int32), zero, none, zero, zero, zero, state.x, none)

    @classmethod
    def arriving(cls, driven: Driven, state: ContactState, arrives: Bool[Array, "..."]) -> "TipInContact":
        """Return a tip that meets the bridge, or solids between which nothing acts before; a free tip else."""
        tip = cls.at_start(state, jnp.where(arrives, ContactPhase.BRIDGE, ContactPhase.DRY))
        if driven.bridge.spans:
            return tip
        return tip._replace(
            state=state._replace(x=jnp.where(arrives, driven.junction.forms_root, state.x)),
            phase=jnp.where(arrives, ContactPhase.JUNCTION, ContactPhase.DRY).astype(jnp.int32),
            junctions=arrives.astype(jnp.int32),
            junction_forms_us=jnp.where(arrives, state.time_us, 0.0),
        )


def advance(
    driven: Driven, tip: TipInContact, until_us: Float[Array, "..."], fineness: float | Float[Array, "..."]
) -> TipInContact:
    """Return a tip in contact after one trial step.

    A step that is taken moves state and record on, and where it meets a threshold the phase changes; one that must be
    repeated leaves them as they were and only sets the length of the next trial.

    Args:
        driven: the equation of motion.
        tip: the tip; its phase is not DRY.
        until_us: end of the simulation.
        fineness: steps per unit of the local time scale; larger is more accurate.
    """
    trial = _try_step(driven, tip, until_us, fineness)
    solid = trial.solid
    repeats, next_length = _repetition(trial, until_us)
    end, at_low, at_high = _land(trial, until_us)
    forms, breaks = ~solid & at_low & ~repeats, solid & at_low & ~repeats
    leaves = ~solid & at_high & ~repeats
    # the junction breaks into the bridge where that outlives it, else into free flight
    after_junction = jnp.where(driven.junction.breaks_gap_nm < driven.breaks_nm, ContactPhase.BRIDGE, ContactPhase.DRY)
    phase = jnp.where(forms, ContactPhase.JUNCTION, jnp.where(leaves, ContactPhase.DRY, tip.phase))
    phase = jnp.where(breaks, after_junction, phase).astype(tip.phase.dtype)
    x = jnp.where(forms, driven.junction.forms_root, jnp.where(breaks, driven.junction.breaks_gap_nm, end.x))
    in_junction = jnp.where(solid, end.time_us - tip.state.time_us, 0.0)
    deepest = jnp.minimum(tip.deepest_gap_nm, _deepest_gap(driven, trial))
    return TipInContact(
        state=jax.tree.map(lambda old, new: jnp.where(repeats, old, new), tip.state, end._replace(x=x)),
        phase=phase,
        trial_length=jnp.where(repeats, next_length, 0.0),
        junctions=tip.junctions + forms.astype(tip.junctions.dtype),
        junction_forms_us=jnp.where(forms & (tip.junctions == 0), end.time_us, tip.junction_forms_us),
        junction_breaks_us=jnp.where(breaks, end.time_us, tip.junction_breaks_us),
        time_in_junction_us=tip.time_in_junction_us + jnp.where(repeats, 0.0, in_junction),
        deepest_gap_nm=jnp.where(repeats, tip.deepest_gap_nm, deepest),
        trials=tip.trials + 1,
    )


class _Trial(NamedTuple):
    """A step that was tried, within one phase."""

    solid: Bool[Array, "..."]
    """Whether the phase is the junction."""
    to_turn: Bool[Array, "..."]
    """Whether it should end at a turning point."""
    length: Float[Array, "..."]
    """In us of time in the bridge, in us of fictitious time in the junction (`Driven.rates`)."""
    start: ContactState
    start_rates: ContactState
    end: ContactState
    end_rates: ContactState
    low: Float[Array, "..."]
    """Lower threshold of x: in the bridge the gap where the junction forms, in the junction the root s at the fold."""
    high: Float[Array, "..."]
    """Upper threshold of x: in the bridge the gap where it breaks, in the junction infinite."""

    @property
    def near_low(self) -> Float[Array, "..."]:
        """Distance from the low threshold within which the parabola is exact.

        It is relative to the threshold; where that is 0, as s is at the fold of a contact without bridge and adhesion
        (`Contact.dry`), to the x from which the step began.
        """
        return jnp.where(self.low > 0.0, _NEAR * self.low, _NEAR_FOLD * self.start.x)

    @property
    def path(self) -> "_Cubic":
        """The cubic of x along the step."""
        return _Cubic.of(self.start.x, self.start_rates.x * self.length, self.end.x, self.end_rates.x * self.length)


def _try_step(
    driven: Driven, tip: TipInContact, until_us: Float[Array, "..."], fineness: float | Float[Array, "..."]
) -> _Trial:
    """Return a trial: to a threshold or the end if it lies within 1.2 usual steps, unless its length is given."""
    start, solid = tip.state, tip.phase == ContactPhase.JUNCTION
    low = jnp.where(solid, driven.solid.fold, driven.junction.forms_gap_nm)
    high = jnp.where(solid, jnp.inf, driven.breaks_nm)
    rates = driven.rates(start, solid)
    usual = 1.0 / (fineness * _inverse_step(driven, *lax.stop_gradient((start, rates)), solid))
    aimed = _length_to_event(*lax.stop_gradient((start, rates, low, high, until_us)))
    chosen = jnp.where(aimed < 1.2 * usual, aimed, usual)
    length = lax.stop_gradient(jnp.where(tip.trial_length == 0.0, chosen, jnp.abs(tip.trial_length)))
    end = eighth_order_step(lambda state: driven.rates(state, solid), start, length)
    return _Trial(solid, tip.trial_length < 0.0, length, start, rates, end, driven.rates(end, solid), low, high)


def _repetition(trial: _Trial, until_us: Float[Array, "..."]) -> tuple[Bool[Array, "..."], Float[Array, "..."]]:
    """Return whether a trial must be repeated, and with which length (negative: to a turning point)."""
    trial, until = lax.stop_gradient((trial, until_us))
    start, rates, end, end_rates, length = trial.start, trial.start_rates, trial.end, trial.end_rates, trial.length
    finite = jnp.isfinite(end.x) & jnp.isfinite(end.gap_rate) & jnp.isfinite(end_rates.gap_rate)
    below, above, late = end.x < trial.low, end.x > trial.high, end.time_us > until

    # a threshold met within rounding of the parabola needs no other trial
    too_far = below & (trial.low - end.x > trial.near_low) | above & (end.x - trial.high > _NEAR * trial.high)
    too_late = late & (end.time_us - until > _NEAR * length * jnp.maximum(end_rates.time_us, 1e-3))
    level = jnp.where(below, trial.low, jnp.where(above, trial.high, 0.0))
    in_x = _Cubic.of(start.x - level, rates.x * length, end.x - level, end_rates.x * length)
    in_time = _Cubic.of(start.time_us - until, rates.time_us * length, end.time_us - until, end_rates.time_us * length)
    fraction = jnp.minimum(jnp.where(too_far, in_x.crossing(), 1.0), jnp.where(too_late, in_time.crossing(), 1.0))

    # a turning point beyond a threshold, both ends within: found by a trial that ends there
    within = ~(below | above | late)
    turning, extremum = trial.path.turning_point()
    hidden = (rates.x * end_rates.x < 0.0) & ~trial.to_turn & within
    hidden = hidden & ((extremum <= trial.low) | (extremum >= trial.high))
    shortest, longest = _SHORTEST, 1.0 - 0.1 * _SHORTEST
    again = length * jnp.clip(fraction, shortest, longest)
    again = jnp.where(hidden, -length * jnp.clip(turning, shortest, longest), again)
    # lengths at which rounding decides are taken as they are
    resolved = length > 1e-15 * (1.0 + jnp.abs(start.time_us))
    return (too_far | too_late | hidden | ~finite) & resolved, jnp.where(finite, again, 0.25 * length)


def _land(trial: _Trial, until_us: Float[Array, "..."]) -> tuple[ContactState, Bool[Array, "..."], Bool[Array, "..."]]:
    """Return the end of a trial, moved by a parabola onto what it met, and whether that is the low or the high level.

    It meets a threshold, or the end of the simulation.
    """
    end, rates, low, high = trial.end, trial.end_rates, trial.low, trial.high
    closing = (end.x - low < trial.near_low) & (end.gap_rate != 0.0) & (rates.x < 0.0)
    opening = (high - end.x < _NEAR * high) & (rates.x > 0.0)
    at_low, at_high = (end.x <= low) | closing, (end.x >= high) | opening
    target = jnp.where(at_low, low, jnp.where(at_high, high, end.x))
    at_threshold = at_low | at_high
    # where the tip is slow, its acceleration counts even in so short a rest of the way
    rest = _length_to_go(end, rates, target - end.x)
    rest = jnp.where(at_threshold & jnp.isfinite(rest), rest, 0.0)
    # a step shorter than the rounding of the time would never end
    rounding = 8.0 * jnp.finfo(end.x.dtype).eps * (1.0 + jnp.abs(until_us))
    over = (end.time_us >= until_us - rounding) & ~at_threshold
    rest = jnp.where(over, (until_us - end.time_us) / jnp.where(over, rates.time_us, 1.0), rest)
    moved = jax.tree.map(lambda value, rate: value + rate * rest, end, rates)
    x, time = jnp.where(at_threshold, target, moved.x), jnp.where(over, until_us, moved.time_us)
    return moved._replace(x=x, time_us=time), at_low, at_high


def _deepest_gap(driven: Driven, trial: _Trial) -> Float[Array, "..."]:
    """Return the smallest gap of a trial in nm: at its end, or where its cubic turns."""
    turns = (trial.start.gap_rate < 0.0) & (trial.end.gap_rate > 0.0)
    x = jnp.where(turns, trial.path.turning_point()[1], trial.end.x)
    return jnp.where(trial.solid, driven.gap_of_root(jnp.where(trial.solid, x, 1.0)), x)


def _length_to_event(
    state: ContactState, rates: ContactState, low: Array, high: Array, until_us: Float[Array, "..."]
) -> Float[Array, "..."]:
    """Return the length after which the parabola of x meets the threshold ahead, or time ends; infinite if never."""
    to_threshold = _length_to_go(state, rates, jnp.where(rates.x < 0.0, low, high) - state.x)
    to_end = (until_us - state.time_us) / rates.time_us
    return jnp.minimum(*(jnp.where(length > 0.0, length, jnp.inf) for length in (to_threshold, to_end)))


def _length_to_go(state: ContactState, rates: ContactState, distance: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return the length h after which the parabola of x has gone a distance d; infinite if never.

    The first root of d = x' h + x'' h^2/2 is h = 2 d/(x' +- sqrt(x'^2 + 2 x'' d)), with the sign of x'.
    """
    # x'' along the step: in both phases x' is proportional to the gap's rate, whose slope is known
    ratio = rates.x / jnp.where(state.gap_rate == 0.0, 1.0, state.gap_rate)
    bend = 0.5 * ratio * rates.gap_rate
    square = rates.x * rates.x + 4.0 * bend * distance
    meets = (square > 0.0) & jnp.isfinite(distance) & (rates.x != 0.0)
    root = jnp.where(rates.x < 0.0, -1.0, 1.0) * jnp.sqrt(jnp.where(meets, square, 1.0))
    return jnp.where(meets, 2.0 * jnp.where(meets, distance, 1.0) / jnp.where(meets, rates.x + root, 1.0), jnp.inf)


def _inverse_step(
    driven: Driven, state: ContactState, rates: ContactState, solid: Bool[Array, "..."]
) -> Float[Array, "..."]:
    """Return the inverse of the time scale of either phase, its formula evaluated within the phase's range alone."""
    bridge_state = state._replace(x=jnp.where(solid, driven.forms_nm, state.x))
    junction_state = state._replace(x=jnp.where(solid, state.x, 1.0))
    in_bridge = inverse_bridge_step(driven, bridge_state, rates.gap_rate)
    return lax.stop_gradient(jnp.where(solid, inverse_junction_step(driven, junction_state), in_bridge))


def inverse_bridge_step(driven: Driven, state: ContactState, acceleration: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return the inverse of the time scale of a tip in the bridge, in 1/us.

    sqrt(|k_b|/m + (w/L)^2 + |a|/(2 L) + (Omega + omega)^2), k_b the bridge's stiffness at the gap, w the speed and a
    the acceleration of the gap, L the distance over which the forces change, Omega + omega the frequencies of
    cantilever and drive.

    Args:
        driven: the equation of motion.
        state: of the tip.
        acceleration: of the gap there, in nm/us^2.
    """
    nearest = driven.junction.forms_gap_nm
    gap = jnp.maximum(state.x, 0.3 * nearest)
    stiffness = jnp.abs(driven.bridge.stiffness(gap)) * driven.inverse_mass
    # the core's force varies over the gap less 0.4 of that where the junction forms
    distance = jnp.maximum(gap - 0.4 * nearest, 0.3 * nearest)
    # without the acceleration a tip at rest would take no notice of the forces
    moving = (state.gap_rate / distance) ** 2 + 0.5 * jnp.abs(acceleration) / distance
    return jnp.sqrt(stiffness + moving + _drive_frequency(driven) ** 2)


def inverse_junction_step(driven: Driven, state: ContactState) -> Float[Array, "..."]:
    """Return the inverse of the scale of fictitious time of a tip in the junction, in 1/us.

    0.8 times the root of the sum of four squares: the frequency of the junction's stiffness; that with which cantilever
    and drive alone would turn a tip round, as they do one that grazes; three times the speed over the distance in which
    the load changes; and the frequencies of cantilever and drive times the depth's slope by s, which turns time into
    fictitious time.
    """
    s, curve = state.x, driven.solid
    energy = 0.5 * driven.mass_ng * state.gap_rate**2 / curve.energy_scale_aj
    elastic = curve.bend(s) * curve.load_scale_nn * driven.inverse_mass / curve.depth_scale_nm
    passing = 3.0 * state.gap_rate / (curve.depth_scale_nm * curve.reach(s, energy))
    pull = driven.acceleration(driven.gap_of_root(s), state.gap_rate, state.time_us, jnp.zeros_like(s))
    # of s'' = -pull depth_slope(s)/depth_scale
    pulled = jnp.abs(pull * slope_of(curve.depth_slope, s)) / curve.depth_scale_nm
    return 0.8 * jnp.sqrt(elastic + pulled + passing**2 + (_drive_frequency(driven) * curve.depth_slope(s)) ** 2)


def _drive_frequency(driven: Driven) -> Float[Array, "..."]:
    """Return the sum of the angular frequencies of cantilever and surface in rad/us; 0 for a free tip."""
    if driven.drive is None:
        return jnp.zeros_like(driven.inverse_mass)
    return driven.drive.cantilever.angular_frequency + driven.drive.surface.fastest_angular_frequency


def eighth_order_step(
    rates: Callable[[ContactState], ContactState], start: ContactState, length: Float[Array, "..."]
) -> ContactState:
    """Return the state after a step of Dormand and Prince's method of order 8, without an error estimate.

    The stages are one small loop over one array, which costs less than half of a general solver's step and hardly
    grows with the number of tips up to a few dozen.

    Args:
        rates: rates of a state, which do not depend on time but by the state.
        start: the state at the beginning; arrays of one shape.
        length: of the step.
    """
    rows, weights = (jnp.asarray(part, start.x.dtype) for part in _coefficients())
    begin = jnp.stack(start)

    def stage(number, slopes):
        row = lax.dynamic_index_in_dim(rows, number, keepdims=False)
        state = begin + length * jnp.tensordot(row, slopes, axes=1)
        return slopes.at[number].set(jnp.stack(rates(ContactState(*state))))

    slopes = lax.fori_loop(0, len(weights), stage, jnp.zeros((len(weights), *begin.shape), begin.dtype))
    return ContactState(*(begin + length * jnp.tensordot(weights, slopes, axes=1)))


@cache
def _coefficients() -> tuple[np.ndarray, np.ndarray]:
    """Return the matrix of the stages, and the weights; the tableau's last stage is the next step's first."""
    from diffrax import Dopri8  # noqa: PLC0415  # half a second

    tableau = Dopri8.tableau
    weights = np.asarray(tableau.b_sol)[:-1]
    rows = np.zeros((len(weights), len(weights)))
    for number, row in enumerate(tableau.a_lower[:-1]):
        rows[number + 1, : number + 1] = row
    return rows, weights


class _Cubic(NamedTuple):
    """The cubic f(u) = start + u (slope + u (bend + u twist)) along a step, u the fraction that is done."""

    start: Float[Array, "..."]
    slope: Float[Array, "..."]
    bend: Float[Array, "..."]
    twist: Float[Array, "..."]
    end: Float[Array, "..."]

    @classmethod
    def of(cls, start: Array, start_slope: Array, end: Array, end_slope: Array) -> "_Cubic":
        """Return the cubic of values at both ends, and of slopes there times the length of the step."""
        bend = 3.0 * (end - start) - 2.0 * start_slope - end_slope
        return cls(start, start_slope, bend, 2.0 * (start - end) + start_slope + end_slope, end)

    def value(self, fraction: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return f at a fraction of the step."""
        return self.start + fraction * (self.slope + fraction * (self.bend + fraction * self.twist))

    def crossing(self) -> Float[Array, "..."]:
        """Return the fraction of the step at which f vanishes, where its ends have different signs."""

        def value_and_slope(fraction):
            return self.value(fraction), self.slope + fraction * (2.0 * self.bend + 3.0 * fraction * self.twist)

        secant = self.start / jnp.where(self.start == self.end, 1.0, self.start - self.end)
        # few: a miss is only tried again; a loop of four makes the whole step in time 1.14 times as long
        return newton_steps(value_and_slope, secant, 4, 0.0, 1.0, unroll=True)

    def turning_point(self) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        """Return fraction and value of the extremum, where the slopes at the ends have different signs."""
        # 3 twist u^2 + 2 bend u + slope = 0, the root between 0 and 1 in the form that does not cancel
        square = self.bend * self.bend - 3.0 * self.twist * self.slope
        real = square > 0.0
        root = jnp.where(real, jnp.sqrt(jnp.where(real, square, 1.0)), 0.0)
        below = jnp.where(self.slope > 0.0, root, -root) - self.bend
        fraction = jnp.clip(self.slope / jnp.where(below == 0.0, 1.0, below), 0.0, 1.0)
        return fraction, self.value(fraction)
