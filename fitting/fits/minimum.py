"""The minimum of chi2: screened, polished from the best starts, and again with the model's own errors in the weights.

The screening is a coarse grid over what a model's parameters can be. Where a law has no orbit on a row that was
measured, chi2 is a plateau there: nothing tells a minimisation which way the orbit lies. The laws around the minimum
are then asked for these rows alone, and the minimisation goes on from the best ones. Two minimisers do it: Optax's
L-BFGS for all starts side by side (`polish`), and damped Gauss-Newton steps between bounds (`descended`).

Slow impacts are more than a law of impacts describes; rows where it is too far off are excluded. What is left out grows
with the share of the drive's cycle that a leaving tip takes to lose its energy, s = omega L/w (L: the length over which
it does, w: its rebound speed). The error of the amplitude was measured on eight full contacts (other humidities,
adhesion, viscosity, modulus, quality factor, frequency, mass): it stays below about half of what is taken,
0.05 % + 1.2 % s^3 + 1.6 % (1.5 u_c/u)^6 with the approach speed u and the capture speed u_c. The three-parameter delay
law is right to 0.15 ns, which counts where the delay alone fixes the amplitude.
"""

from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Shaped

from afm_jax.impact.lasting_impact import TabulatedImpact
from afm_jax.least_squares import Box, descended
from afm_jax.solve.lanes import compiled_quickly
from afm_jax.units import RAD_PER_US_PER_KHZ
from fitting.fits.intervals import Places
from fitting.fits.objective import BATCH, FINE, PLAIN, ROUGH, SOFT, Objective, Polished, lowest, polish
from fitting.forward import Linearised, free_impacts, impact_at
from fitting.models import ROWS_PER_PROGRAM, Measurement, Problem, Rows, tip_work
from fitting.parameters import PARAMETERS, Parameter


@dataclass(frozen=True)
class Minimum:
    """The best of several polished starts.

    Attributes:
        coordinates: of the best one, shape (p,).
        ends: where every start ended, parameter values, shape (starts, p).
        chi2: there, shape (starts,).
    """

    coordinates: Float[np.ndarray, " p"]
    ends: Float[np.ndarray, "starts p"]
    chi2: Float[np.ndarray, " starts"]


@dataclass(frozen=True)
class ModelErrors:
    """How far a model's picture holds for each row.

    Attributes:
        model_error: relative error of the amplitude that the picture itself has, shape (rows,).
        slow_error: the part of it that slow impacts have, without that of the delay law.
        reasons: why rows are not used, empty for the others, shape (rows,).
    """

    model_error: Float[np.ndarray, " rows"]
    slow_error: Float[np.ndarray, " rows"]
    reasons: Shaped[np.ndarray, " rows"]

    @property
    def set_aside(self) -> Bool[np.ndarray, " rows"]:
        """Rows that are not used."""
        return self.reasons != ""


_MODEL_ERROR_ROUNDS = 3


_FEWEST_LEFT, _LEAST_LEFT = 4, 0.2
"""Rows of a driven tip, and their share, of which at least a law of impacts is read off."""


def minimum_with_model_errors(stated: Objective) -> tuple[Objective, Minimum, ModelErrors, bool]:
    """Return the minimum with the model's own error in the weights and inaccurate rows excluded, until both settle.

    The last is True if hardly a row of a driven tip is left then: they are not excluded, and the law is refused.
    """
    minimum = minimise(stated)
    model_errors = model_errors_of(stated, stated.problem.values(minimum.coordinates))
    if not stated.problem.lasting:
        return stated, minimum, model_errors, False
    if _few_left(stated, model_errors, minimum):
        return stated, minimum, model_errors, True
    objective = with_inflated_errors(stated, model_errors)
    for _ in range(_MODEL_ERROR_ROUNDS):
        minimum = settle(objective, minimum)
        again = model_errors_of(stated, stated.problem.values(minimum.coordinates))
        same = np.array_equal(again.set_aside, model_errors.set_aside)
        close = np.allclose(again.model_error, model_errors.model_error, rtol=0.02)
        if _few_left(stated, again, minimum):
            return stated, minimum, again, True
        if same and close:
            return objective, minimum, model_errors, False
        objective, model_errors = with_inflated_errors(stated, again), again
    return objective, settle(objective, minimum), model_errors, False


def _few_left(stated: Objective, model_errors: ModelErrors, minimum: Minimum) -> bool:
    """Say whether the law has an orbit on fewer than four accurate rows of a driven tip, or on fewer than a fifth."""
    if not stated.problem.tapping:
        return False
    rows = stated.measurement.rows
    hits = np.asarray(rows.measured).any(axis=1) & ~np.asarray(rows.free)
    lost = lost_rows(stated, stated.problem.values(minimum.coordinates))
    left = int((hits & ~lost & ~model_errors.set_aside).sum())
    return bool(left < max(_FEWEST_LEFT, _LEAST_LEFT * hits.sum()))


def minimise(objective: Objective) -> Minimum:
    """Screen starts, polish the best ones with outliers counting less, then plainly.

    With impacts that last the search for orbits is what costs: the screening and the first polish look at a part of the
    rows, the rest follows orbits once they are known.
    """
    common = objective.of_common_parameters()
    if common is not None:
        return _with_own_nuisances(objective, minimise(common))
    points = starts(objective.problem, objective.measurement)
    scout = _thinned(objective, ROWS_PER_PROGRAM) if objective.problem.lasting else objective
    best = np.argsort(scout.screen(points), kind="stable")[:BATCH]
    first = objective.problem.coordinates(points[best])
    if not objective.problem.lasting:
        return _polished(objective, polish(scout, first, SOFT, settled=ROUGH).coordinates)
    found = settle(objective, _whole(objective, _scouted(scout, first)))
    lost = lost_rows(objective, objective.problem.values(found.coordinates))
    back = recovered(objective, found.coordinates, lost) if lost.any() else None
    if back is None:
        return found
    other = settle(objective, replace(found, coordinates=back))
    return other if other.chi2[0] < found.chi2[0] else found


def _with_own_nuisances(objective: Objective, found: Minimum) -> Minimum:
    """Return the minimum with the nuisances that tables have to themselves, from one where these were held."""
    known = np.asarray(objective.measurement.constraint_value)[len(found.coordinates) :]

    def whole(values: Float[np.ndarray, "... q"]) -> Float[np.ndarray, "... p"]:
        return np.concatenate([values, np.broadcast_to(known, (*values.shape[:-1], known.size))], axis=-1)

    ends = whole(found.ends)
    best = objective.problem.coordinates(ends[lowest(found.chi2)])
    begun = replace(found, coordinates=best, ends=ends)
    return settle(objective, begun) if objective.problem.lasting else _polished(objective, best[None])


_ROUNDS = 4


_STEPS_PER_SEARCH = 15


def _scouted(scout: Objective, coordinates: Float[np.ndarray, "starts p"]) -> Float[np.ndarray, "starts p"]:
    """Polish every start softly: orbits are followed, and searched for again now and then, for they come and go."""
    for _ in range(_ROUNDS):
        follower = scout.following_each(scout.problem.values(coordinates))
        end = polish(follower, coordinates, SOFT, settled=ROUGH, most=_STEPS_PER_SEARCH)
        coordinates = end.coordinates
        if end.steps == 0:
            break
    return coordinates


def _whole(objective: Objective, found: Float[np.ndarray, "starts p"]) -> Minimum:
    """Return the best of the scouts' ends by all rows, polished with orbits followed from there."""
    values = objective.problem.values(found)
    chi2 = objective.screen(values)
    winner = lowest(chi2)
    follower = objective.following(values[winner])
    softly = polish(follower, found[winner][None], SOFT, settled=ROUGH)
    end = _plainly(follower, softly.coordinates)
    best = objective.problem.values(end.coordinates)[0]
    return Minimum(end.coordinates[0], np.vstack([best, values]), np.append(end.objective, chi2))


def settle(objective: Objective, minimum: Minimum) -> Minimum:
    """Polish again until the orbits that are found at the minimum are the ones that were followed to it."""
    for _ in range(_ROUNDS):
        values = objective.problem.values(minimum.coordinates)
        follower = objective.following(values)
        end = _plainly(follower, minimum.coordinates[None])
        chi2 = float(np.sum(objective.searching().residual(objective.problem.values(end.coordinates)) ** 2))
        minimum = replace(minimum, coordinates=end.coordinates[0], chi2=np.append(chi2, minimum.chi2[1:]))
        if abs(chi2 - end.objective[0]) < 1e-6 * (1.0 + chi2):
            break
    return minimum


_MOST_STEPS = 150


def _plainly(objective: Objective, starts: Float[np.ndarray, "starts p"]) -> Polished:
    """Polish plainly, then with damped steps between bounds where that has not arrived.

    A loss close to 0 has no curvature by its coordinate: damped steps go there.
    """
    polished = polish(objective, starts, PLAIN, settled=FINE)
    places = Places(objective)
    here = places.of_values(objective.problem.values(polished.coordinates))
    box = Box(places.lowest, places.highest, np.zeros(here.shape, dtype=bool))
    end = descended(places.look, places.look(here, np.arange(len(here))), box, settled=FINE, most=_MOST_STEPS)
    found = Polished(places.coordinates(end.place), end.chi2, 0)
    # the last digits stay
    return found if np.any(end.chi2 < polished.objective - FINE) else polished


def _polished(objective: Objective, starts: Float[np.ndarray, "starts p"]) -> Minimum:
    """Polish plainly and keep the best."""
    final = polish(objective, starts, PLAIN, settled=FINE)
    winner = lowest(final.objective)
    return Minimum(final.coordinates[winner], objective.problem.values(final.coordinates), final.objective)


def _thinned(objective: Objective, most: int) -> Objective:
    """Return the objective of so many rows at most, spread over orders, frequencies and drives."""
    rows = jax.tree.map(np.asarray, objective.measurement.rows)
    seen = np.flatnonzero(rows.measured.any(axis=1) | rows.no_orbit)
    if seen.size <= most:
        return objective
    ranked = seen[np.lexsort((rows.drive_amplitude_nm[seen], rows.drive_frequency_khz[seen], rows.order[seen]))]
    chosen = ranked[np.linspace(0, ranked.size - 1, most).round().astype(int)]
    return objective.of_rows(chosen)


def rescale_errors(objective: Objective, minimum: Minimum, parameters: int) -> tuple[Objective, Minimum, float]:
    """Scale the amplitudes' errors until their chi2 equals its degrees of freedom; the constraint on Q stays.

    Args:
        objective: with the errors as given.
        minimum: of it.
        parameters: how many parameters the amplitudes determine.

    Returns:
        The objective with scaled errors, its minimum, and the factor.

    Raises:
        ValueError: if there are no degrees of freedom to take the scale from.
    """
    rows = objective.measurement.rows
    freedom = int(np.asarray(rows.measured).sum()) - parameters
    if freedom < 1:
        raise ValueError("scaling the errors needs more amplitudes than parameters; give their errors instead")
    total = 1.0
    # The constraint on Q makes the minimum depend on the scale a little: three rounds settle it.
    for _ in range(3):
        residual = objective.amplitude_residuals(objective.problem.values(minimum.coordinates))
        factor = float(np.sqrt(np.sum(residual**2) / freedom))
        if factor == 0.0:
            break
        total *= factor
        objective = objective.with_rows(error_nm=objective.measurement.rows.error_nm * factor)
        if objective.problem.lasting:
            minimum = settle(objective, minimum)
        else:
            minimum = _polished(objective, objective.problem.coordinates(minimum.ends))
    return objective, minimum, total


_GRID_PER_PARAMETER = {1: 96, 2: 16}


_SPREAD_POINTS = 64
"""Points of a low-discrepancy sequence, where a grid would have too many."""


def starts(problem: Problem, measurement: Measurement) -> Float[np.ndarray, "points p"]:
    """Return the values to start from, a grid or a sequence over the `starts` of the model's parameters.

    Nuisances stay where they were measured.
    """
    own = problem.own
    if measurement.joint is not None:
        measurement = measurement._replace(rows=measurement.of_drive(problem.drive).rows)

    def started(name: str, place: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        return _range(PARAMETERS[name], measurement, problem, place)

    if len(own) in _GRID_PER_PARAMETER and not problem.lasting:
        count = _GRID_PER_PARAMETER[len(own)]
        mesh = np.meshgrid(*(started(name, np.linspace(0.0, 1.0, count)) for name in own), indexing="ij")
        columns = {name: axis.ravel() for name, axis in zip(own, mesh, strict=True)}
    else:
        places = _spread(_SPREAD_POINTS, len(own))
        columns = {name: started(name, place) for name, place in zip(own, places.T, strict=True)}
    count = len(columns[own[0]])
    known = dict(zip(problem.names, np.asarray(measurement.constraint_value).tolist(), strict=True))
    return np.stack([columns.get(name, np.full(count, known[name])) for name in problem.names], axis=1)


def _spread(count: int, dimensions: int) -> Float[np.ndarray, "count dimensions"]:
    """Return the additive recurrence of Kronecker whose steps are powers of the generalised golden ratio (Roberts)."""
    ratio = 2.0
    for _ in range(60):
        # x^(d+1) = x + 1
        ratio = (1.0 + ratio) ** (1.0 / (dimensions + 1))
    steps = ratio ** -np.arange(1.0, dimensions + 1.0)
    return np.mod(0.5 + np.outer(np.arange(1, count + 1), steps), 1.0)


_STARTS_OF_LOSS = 0.03, 2.0
"""Range of the starts of a loss of a driven tip, in terms of what its readings say."""


_USUAL_SPEED = 0.2
"""Approach speed of a tip that taps above resonance, about, over the speed of the free tip."""


def _lost_squared(measurement: Measurement, problem: Problem) -> tuple[float, float] | None:
    """Return the loss u_in^2 - u_out^2 that amplitude and phase of a driven tip amount to, and a usual speed.

    In nm^2/us^2 and nm/us, roughly: the first harmonic's energy, at the middle of the rows; None if nothing is lost.
    """
    rows, cantilever = measurement.rows, measurement.cantilever
    lost = -2.0 * np.pi * float(cantilever.angular_frequency) ** 2 * np.imag(tip_work(rows, cantilever, problem.drive))
    lost = lost[np.isfinite(lost) & (lost > 0.0) & ~np.asarray(rows.free)]
    top = RAD_PER_US_PER_KHZ * np.asarray(rows.drive_amplitude_nm) * np.asarray(rows.drive_frequency_khz)
    return (float(np.median(lost)), _USUAL_SPEED * float(np.median(top))) if lost.size else None


def _range(
    parameter: Parameter, measurement: Measurement, problem: Problem, place: Float[np.ndarray, " n"]
) -> Float[np.ndarray, " n"]:
    """Return the values that places between 0 and 1 of a parameter's starting range stand for."""
    rows = measurement.rows
    if problem.tapping and parameter.drive_power:
        lost = _lost_squared(measurement, problem)
        if lost is not None:
            low, high = np.array(_STARTS_OF_LOSS) * lost[0] / lost[1] ** (2.0 - parameter.drive_power)
            return parameter.reference + parameter.sign * low * (high / low) ** place
    drive = RAD_PER_US_PER_KHZ * np.asarray(rows.drive_amplitude_nm) * np.asarray(rows.drive_frequency_khz)
    scale = np.array([drive.min(), drive.max()]) ** parameter.drive_power
    scale *= float(np.asarray(measurement.cantilever.mass_ng)) ** parameter.mass_power
    low, high = np.array(parameter.starts) * scale
    if parameter.width or parameter.even:
        return low + (high - low) * place
    start = low * (high / low) ** place
    return parameter.reference + parameter.sign * start if parameter.sign else start


def lost_rows(objective: Objective, values: Float[np.ndarray, " p"]) -> Bool[np.ndarray, " rows"]:
    """Say on which rows something was measured that the law has no orbit for.

    Args:
        objective: its orbits are searched for.
        values: of the law.
    """
    measured = np.asarray(objective.measurement.rows.measured).any(axis=1)
    return measured & (np.asarray(objective.searching().at_values(values[None]).prediction.orbits)[0] == 0)


def recovered(
    objective: Objective, coordinates: Float[np.ndarray, " p"], lost: Bool[np.ndarray, " rows"]
) -> Float[np.ndarray, " p"] | None:
    """Return a minimum from which fewer orbits are missing, None if the laws around have no more of them.

    Args:
        objective: of all rows.
        coordinates: the minimum.
        lost: rows without orbit there.
    """
    around = _beside(objective, coordinates)
    found = (
        np.asarray(objective.searching().of_rows(lost).at_values(objective.problem.values(around)).prediction.orbits)
        > 0
    )
    if not found.any():
        return None
    # the closest ones come first
    best = around[np.argsort(-found.sum(axis=1), kind="stable")[:BATCH]]
    follower = objective.following_each(objective.problem.values(best))
    ends = polish(follower, best, SOFT, settled=ROUGH).coordinates
    follower = objective.following_each(objective.problem.values(ends))
    ends = polish(follower, ends, PLAIN, settled=FINE).coordinates
    chi2 = np.sum(objective.searching().residual(objective.problem.values(ends)) ** 2, axis=1)
    return ends[lowest(chi2)]


_STEPS = (0.01, 0.03, 0.1, 0.3)
"""How far around a minimum laws are tried, in the optimiser's coordinates; those of losses relative to themselves."""


def _beside(objective: Objective, coordinates: Float[np.ndarray, " p"]) -> Float[np.ndarray, "sets p"]:
    """Return coordinates to either side of a point along every parameter of the law, close ones first."""
    problem = objective.problem
    sets = []
    for step in _STEPS:
        for index, parameter in enumerate(problem.parameters[: len(problem.own)]):
            for side in (-step, step):
                moved = coordinates.copy()
                moved[index] += side * (coordinates[index] if parameter.sign else 1.0)
                sets.append(moved)
    return np.array(sets)


BASE, GROWTH, SLOW = 0.0005, 0.012, 0.016
"""Relative model error of fast impacts, its growth with s^3, and its value at 1.5 times the capture speed."""


TAPPED, IN_FRAME = 0.0012, 1e-4
"""Growth of that of a driven tip, and its error in the frame of the free tip, over the amplitude there: what the law's
parameters do not make up for (full contacts of tips of 12, 20 and 100 nm, 3 and 10 % above resonance)."""


DELAY_US = 1.5e-4
"""Error of the delay law in us."""


LONGEST = 1.4
"""s beyond which a row is set aside."""


NEAREST = 1.35
"""Approach speed in terms of the capture speed below which a row is set aside."""


_CRAWLING, _MOST_LOST = 2.5, 0.05
"""The same for rows that the law has no steady orbit for, their speed told from the amplitude, and for driven tips; and
the share of those without at most: that close to where orbits end, a hair of the law decides whether there is one."""


_BY_LEVER = 1.2
"""Pull times Hertz time over the approach speed from which the rows of a driven tip are set aside. Six full contacts
3 % above resonance are predicted as well there as under little pull."""


_MOST_IRREGULAR = 0.2
"""Share of the rows of a driven tip at most that are taken not to be one impact a period."""


_TURNED = 0.125
"""Error of the phase in rad over the relative error of the amplitude: what the tip loses fixes the phase."""


TOO_SLOW = "too slow for a law of impacts"


TOO_BENT = "under too strong a pull of the lever (more than 1.2 times what turns the tip round)"


IRREGULAR = "not one a period"


ATTRACTED = "none: the sample only draws the tip"
"""Why rows are set aside."""


def padding(share: Float[np.ndarray, " rows"], readings: Float[np.ndarray, "rows k"]) -> Float[np.ndarray, "rows k"]:
    """Return the errors of readings that a relative error of the amplitude stands for: of amplitudes and phase."""
    of_phase = np.full((len(share), readings.shape[1] - 2), np.rad2deg(_TURNED))
    return share[:, None] * np.concatenate([readings[:, :2], of_phase], axis=1)


def model_errors_of(objective: Objective, values: Float[np.ndarray, " p"]) -> ModelErrors:
    """Return the model errors of every row (padded) at a set of values; none where impacts are instantaneous."""
    count = objective.measurement.rows.order.shape[0]
    found = ModelErrors(np.zeros(count), np.zeros(count), np.full(count, "", dtype=object))
    if objective.problem.lasting:
        for mine, part in objective.by_instrument():
            model_errors = _model_errors_of_part(part, values)
            for whole, some in zip(vars(found).values(), vars(model_errors).values(), strict=True):
                whole[mine] = some
    return found


def _model_errors_of_part(objective: Objective, values: Float[np.ndarray, " p"]) -> ModelErrors:
    """Return the model errors of every row of one instrument."""
    rows = objective.measurement.rows
    impact = impact_at(values, objective.measurement, objective.problem).impact
    linear = objective.at_values(values[None])
    prediction = linear.prediction
    exists = np.asarray(prediction.orbits)[0] > 0
    tips = jax.tree.map(np.asarray, free_impacts(impact, np.asarray(prediction.coordinate)[0]))
    approach, rebound = tips.speeds.approach, tips.speeds.rebound
    # without adhesion nothing is captured, and no impact is slow
    capture = float(tips.capture_speed) if tips.lowest > 0.0 else 0.0
    share = 2.0 * np.pi * np.asarray(rows.drive_frequency_khz) * 1e-3 * float(tips.length) / np.maximum(rebound, 1e-6)
    tapping, free = objective.problem.tapping, np.asarray(rows.free)
    slow = (share > LONGEST) | (approach < (_CRAWLING if tapping else NEAREST) * capture)
    slow = np.where(exists, slow, _lost_slowly(objective, exists, _CRAWLING * capture))
    reasons = np.where(slow, TOO_SLOW, "").astype(object)
    if tapping:
        by_lever = np.asarray(prediction.pull_nm_per_us2)[0] * tips.hertz_time
        reasons[exists & (by_lever > _BY_LEVER * approach)] = TOO_BENT
        reasons[_irregular(objective, exists)] = IRREGULAR
        reasons[free] = ""
    near = np.minimum(1.5 * capture / np.maximum(approach, 1e-6), 1.5 / NEAREST)
    base, growth = (_frame_error(rows), TAPPED) if tapping else (BASE, GROWTH)
    slow_error = base + growth * np.minimum(share, LONGEST) ** 3 + SLOW * near**6
    error = slow_error
    if "delay_offset_nm" in objective.problem.names:
        error = np.hypot(error, DELAY_US * _sensitivity(objective, linear, approach))
    error, slow_error = (np.where(exists, part, BASE) for part in (error, slow_error))
    if tapping:
        error, slow_error = (np.where(free, 0.0, part) for part in (error, slow_error))
    return ModelErrors(error, slow_error, reasons)


def _frame_error(rows: Rows) -> Float[np.ndarray, " rows"]:
    """Return the relative model error of a driven tip's amplitude: that of its motion in the free tip's frame."""
    return IN_FRAME * (1.0 + np.asarray(rows.drive_amplitude_nm) / np.asarray(rows.amplitude_nm)[:, 1])


def _irregular(objective: Objective, exists: Bool[np.ndarray, " rows"]) -> Bool[np.ndarray, " rows"]:
    """Say for which measured rows of a driven tip the law has no steady orbit; none if there are many of them."""
    measured = np.asarray(objective.measurement.rows.measured).any(axis=1)
    lost = measured & ~exists
    return lost if lost.sum() <= _MOST_IRREGULAR * measured.sum() else np.zeros_like(lost)


def _lost_slowly(objective: Objective, exists: Bool[np.ndarray, " rows"], slowest: float) -> Bool[np.ndarray, " rows"]:
    """Say which measured rows without an orbit have amplitudes of slow impacts; none if there are many of them."""
    rows = jax.tree.map(np.asarray, objective.measurement.rows)
    measured = rows.measured.any(axis=1)
    # a tip that comes free of the platform reaches about its speed over its angular frequency; the lock-in reads half
    height = np.max(np.where(rows.measured, rows.amplitude_nm, 0.0)[:, :2] * np.array([1.0, 2.0]), axis=1)
    speed = height * RAD_PER_US_PER_KHZ * float(objective.measurement.cantilever.frequency_khz)
    lost = measured & ~exists & (speed < slowest)
    return lost if lost.sum() <= _MOST_LOST * measured.sum() else np.zeros_like(lost)


def untabulated(
    objective: Objective, values: Float[np.ndarray, " p"], approach: Float[np.ndarray, " rows"]
) -> Bool[np.ndarray, " rows"]:
    """Say at which approach speeds the table of a contact misses its accuracy; nowhere for a law, nor at NaN."""
    if objective.problem.model != "contact":
        return np.zeros(approach.shape, dtype=bool)
    from afm_jax.contact.law_of_contact import DELAY_ERROR_US, SPEED_ERROR  # noqa: PLC0415  # for contacts alone

    impact: Any = impact_at(values, objective.measurement, objective.problem).impact
    speed, delay = jax.tree.map(np.asarray, _errors(impact, approach))
    held = (speed <= SPEED_ERROR) & (delay <= DELAY_ERROR_US)
    return np.isfinite(approach) & ~held


@compiled_quickly()
def _errors(impact: TabulatedImpact, approach: Float[Array, " n"]) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    return impact.errors(approach)


def _sensitivity(
    objective: Objective, linear: Linearised, approach: Float[np.ndarray, " rows"]
) -> Float[np.ndarray, " rows"]:
    """Return by how much the amplitude changes with the delay, relative to itself, in 1/us."""
    offset = objective.problem.names.index("delay_offset_nm")
    error = np.asarray(objective.measurement.rows.error_nm)
    slope = (linear.jacobian[0, : error.size, offset].reshape(error.shape) * error)[:, :2]
    amplitude = np.asarray(linear.prediction.amplitude_nm)[0, :, :2]
    # the offset d shortens the delay by d/u
    relative = np.abs(slope) / np.where(amplitude > 0.0, amplitude, 1.0)
    return approach * np.where(amplitude > 0.0, relative, 0.0).max(axis=1)


def with_inflated_errors(objective: Objective, model_errors: ModelErrors) -> Objective:
    """Return the objective with the model's error added to the measured one, without the rows set aside.

    Args:
        objective: with the errors as measured.
        model_errors: of its rows.
    """
    rows = objective.measurement.rows
    amplitude, error = np.asarray(rows.amplitude_nm), np.asarray(rows.error_nm)
    total = np.hypot(error, padding(model_errors.model_error, amplitude))
    used = np.asarray(rows.measured) & ~model_errors.set_aside[:, None]
    return objective.with_rows(error_nm=np.where(used, total, 1.0), measured=used)
