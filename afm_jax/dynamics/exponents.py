"""Lyapunov exponents of the impact map: how fast neighbouring motions part, from the exact Jacobians.

Of the map's two exponents the larger is the growth of a tangent vector, the orthogonal factor of a QR decomposition in
two dimensions, and their sum the mean of ln |det|. Once a motion repeats, after m impacts, they are ln |multipliers|/m
of the Jacobian over one repetition. A tip that comes to rest on the platform and is let go by it, or stays for good,
forgets its start: the map has rank one at the capture and rank zero after the release, and both exponents are minus
infinity. Near grazing the Jacobian grows without bound; such impacts are counted.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene, SceneLike, as_scene
from afm_jax.checks import checked
from afm_jax.contact.contact import Contact
from afm_jax.dynamics.many_tips import (
    MapStep,
    Record,
    Tips,
    advance,
    departure_jacobians,
    record_of,
    skipped,
    tips_after_contacts,
)
from afm_jax.dynamics.starts import batch_and_tips, sample_driven
from afm_jax.dynamics.verdicts import RECORDED, WHY_UNRESOLVED, MotionKind, Verdicts, verdicts_of
from afm_jax.impact.jacobian import contact_jacobian, flight_jacobian
from afm_jax.impact.law import impact_law_of
from afm_jax.motion.record import State
from afm_jax.motion.simulate import DEFAULT_ACCURACY
from afm_jax.outcomes import Outcome
from afm_jax.results import ResultTuple, public_result
from afm_jax.scenefile.parameter_paths import ParameterRange
from afm_jax.solve.lanes import Report, in_blocks
from afm_jax.words import counted, with_error

_PARTS = 20
"""Parts of a motion whose means tell the errors."""
_CONTACTS_AT_ONCE = 256
"""Contacts whose Jacobians are computed together."""
_PUSH = 1e-3
"""Of the speed off the platform, by which a tip leaves an unstable orbit."""
_GROWS = 1e-9
"""Larger exponent per impact above which an orbit is unstable; below it is rounding."""
_ARRIVED = 1e-8
"""Estimated distance from an orbit below which its multipliers are taken for the exponents."""


@public_result(picture="afm_jax.plots.dynamics:exponents_figure")
class Lyapunov(ResultTuple):
    """The two Lyapunov exponents of each of several motions, the larger one first; arrays of one lane a motion.

    Attributes:
        exponents_per_impact: minus infinity where the tip rests on the platform; NaN where the motion ended, without
            an impact to the end, before a tenth of the impacts were made.
        exponents_per_us: exponents per time, in 1/us; minus infinity and NaN where those per impact are.
        exponents_per_impact_error: standard errors from the means of twenty parts; of an orbit how far it may be off.
        exponents_per_us_error: standard errors of the exponents in 1/us, likewise.
        mean_log_determinant: mean of ln |det| of the map's Jacobian.
        impacts: how many the means are over.
        near_grazing: how many of them are near grazing.
        rested: how many of them ended in a rest.
        verdicts: what the motions have come to.
        approach_speed_nm_per_us: of the last impacts of each motion.
        along: the parameter whose values the motions belong to, if they belong to one.
        larger_interval95: what holds 95 % of the larger exponents per impact for drawn laws; None: none drawn.
    """

    exponents_per_impact: Float[np.ndarray, "lanes 2"]
    exponents_per_us: Float[np.ndarray, "lanes 2"]
    exponents_per_impact_error: Float[np.ndarray, "lanes 2"]
    exponents_per_us_error: Float[np.ndarray, "lanes 2"]
    mean_log_determinant: Float[np.ndarray, " lanes"]
    impacts: Int[np.ndarray, " lanes"]
    near_grazing: Int[np.ndarray, " lanes"]
    rested: Int[np.ndarray, " lanes"]
    verdicts: Verdicts
    approach_speed_nm_per_us: Float[np.ndarray, "lanes last"]
    along: ParameterRange | None = None
    larger_interval95: Float[np.ndarray, "lanes 2"] | None = None

    @property
    def reason(self) -> str | None:
        """Why there are no exponents at all; None where there are some."""
        motions = self._motions()
        if not np.isnan(motions.exponents_per_impact[:, 0]).all():
            return None
        verdicts = exponent_verdicts(motions)
        most = "at most " if len(verdicts) > 1 else ""
        words = "; ".join(dict.fromkeys(verdicts))
        return f"{words}; there were {most}{int(motions.impacts.max())} impacts to average over"

    @property
    def impact_speeds_nm_per_us(self) -> Float[np.ndarray, "*lanes last"]:
        """Approach speeds of the last impacts."""
        return self.approach_speed_nm_per_us

    def _motions(self) -> "Lyapunov":
        """Return the exponents of many motions; those of one as a batch of one."""
        return self if np.ndim(self.impacts) else jax.tree.map(lambda array: np.asarray(array)[None], self)

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON object of `afm-jax lyapunov`: numbers of one motion, lists of many."""
        many, verdicts = np.ndim(self.impacts) > 0, exponent_verdicts(self._motions())
        told = {
            **{name: getattr(self, name) for name in _TOLD},
            "orbit": {"impacts": self.verdicts.impacts, "periods": self.verdicts.periods},
            "verdict": verdicts if many else verdicts[0],
        }
        if self.larger_interval95 is not None:
            told["exponent_per_impact_interval95"] = self.larger_interval95
        return told if self.along is None else told | {"parameter": self.along.path, "values": self.along.values}

    def printed(self) -> list[str]:
        """Return the exponents of one motion with their errors; of many how many are positive."""
        larger, error = self.exponents_per_impact[..., 0], self.exponents_per_impact_error[..., 0]
        if np.ndim(self.impacts):
            positive = int(np.sum(np.isfinite(larger) & (larger > CHAOTIC_ERRORS * error)))
            unknown = int(np.sum(np.isnan(larger)))
            what, others = self.along or counted(larger.size, "motion"), larger.size - unknown - positive
            verdict = f"negative or undecided at {others}, unknown at {unknown}"
            return [f"{what}: the larger exponent is positive at {positive} values, {verdict}"]

        def pair(values: np.ndarray, errors: np.ndarray) -> str:
            pairs = zip(values, errors, strict=True)
            return ", ".join(with_error(value, error) if error > 0.0 else f"{value:.6g}" for value, error in pairs)

        lines = [
            f"Lyapunov exponents per impact: {pair(self.exponents_per_impact, self.exponents_per_impact_error)}",
            f"                       per us: {pair(self.exponents_per_us, self.exponents_per_us_error)}",
            f"{int(self.impacts)} impacts; {exponent_verdicts(self._motions())[0]}",
        ]
        if self.near_grazing:
            many = int(self.near_grazing)
            lines.append(f"{many} impacts are near grazing, where the map's slopes grow without bound")
        if self.larger_interval95 is not None:
            low, high = self.larger_interval95
            lines.append(f"the larger per impact: {low:.6g} to {high:.6g} in 95 % of the draws")
        return lines

    def tables(self) -> dict[str, dict[str, Any]]:
        """Return the columns of lyapunov.csv, a row a motion."""
        motions = self._motions()
        columns: dict[str, Any] = {} if self.along is None else {self.along.path: self.along.values}
        columns |= {
            "exponent_per_impact": motions.exponents_per_impact[:, 0],
            "second_exponent_per_impact": motions.exponents_per_impact[:, 1],
            "exponent_per_impact_error": motions.exponents_per_impact_error[:, 0],
            "exponent_per_us": motions.exponents_per_us[:, 0],
            "second_exponent_per_us": motions.exponents_per_us[:, 1],
            "impacts": motions.impacts,
            "near_grazing": motions.near_grazing,
            "rested": motions.rested,
            "verdict": exponent_verdicts(motions),
        }
        if motions.larger_interval95 is not None:
            low, high = motions.larger_interval95.T
            columns |= {"exponent_per_impact_low": low, "exponent_per_impact_high": high}
        return {"lyapunov.csv": columns}


_TOLD = (
    *("exponents_per_us", "exponents_per_impact", "exponents_per_us_error", "exponents_per_impact_error"),
    *("mean_log_determinant", "impacts", "near_grazing", "rested"),
)
"""Attributes of `Lyapunov` that are keys of its JSON object."""
CHAOTIC_ERRORS = 3.0
"""Standard errors by which the larger exponent must be above 0 to be called positive."""


def exponent_verdicts(exponents: Lyapunov) -> list[str]:
    """Return in words what the exponents of each of many motions say."""
    words, unstable = [], on_unstable_orbit(exponents)
    for lane, name in enumerate(exponents.verdicts.names()):
        kind = exponents.verdicts.kind[lane]
        larger, error = exponents.exponents_per_impact[lane, 0], exponents.exponents_per_impact_error[lane, 0]
        if unstable[lane]:
            words.append(f"undecided: the motion stays on a {name} orbit that is unstable; try another [start]")
        elif kind == MotionKind.ORBIT:
            forgets = ", the tip rests on the platform and forgets its start" if np.isneginf(larger) else ""
            words.append(f"regular: the motion has come to a {name} orbit{forgets}")
        elif kind == MotionKind.STUCK:
            words.append("stuck: the platform holds the tip")
        elif kind == MotionKind.IRREGULAR and np.isneginf(larger):
            words.append("the tip rests on the platform and forgets its start")
        elif kind == MotionKind.IRREGULAR and larger > CHAOTIC_ERRORS * error:
            words.append("chaotic: the larger exponent is positive")
        elif kind == MotionKind.IRREGULAR:
            words.append(
                "undecided: nothing repeats, and the larger exponent is not clearly positive; the motion may still be "
                "settling (`transient=...` gives it more)"
            )
        elif kind == MotionKind.FREE:
            words.append("free: the tip no longer meets the platform")
        else:
            words.append(f"unresolved: the motion comes {WHY_UNRESOLVED}")
    return words


def on_unstable_orbit(exponents: Lyapunov) -> Bool[np.ndarray, " lanes"]:
    """Say which of many motions repeat on an orbit with a multiplier outside the unit circle."""
    larger, error = exponents.exponents_per_impact[:, 0], exponents.exponents_per_impact_error[:, 0]
    return (exponents.verdicts.kind == MotionKind.ORBIT) & (larger > np.maximum(_GROWS, error))


class _Sums(NamedTuple):
    """Of a part of a motion, arrays of one lane a motion."""

    growth: Float[Any, " lanes"]
    """Sum of ln |J q|."""
    determinant: Float[Any, " lanes"]
    """Sum of ln |det J|."""
    impacts: Float[Any, " lanes"]
    time_us: Float[Any, " lanes"]
    near_grazing: Float[Any, " lanes"]
    rested: Float[Any, " lanes"]


@checked
def lyapunov_spectrum(
    scene: SceneLike,
    start: State | None = None,
    *,
    impacts: int = 2000,
    transient: int = 500,
    accuracy: float = DEFAULT_ACCURACY,
    report: Report | None = None,
) -> Lyapunov:
    """Return the two Lyapunov exponents of a motion, or of many, in 1/us and per impact.

    Args:
        scene: a scene with a law or a contact, driven with one frequency; or a batch of scenes.
        start: where the motion begins; None: one scene's default, of many `bouncing_tips`.
        impacts: impacts over which the exponents are taken.
        transient: impacts before.
        accuracy: of resolved contacts, as for `simulate`.
        report: called with how many of how many motions are done.

    Returns:
        A `Lyapunov`; of one scene without the axis of lanes.

    Raises:
        RuntimeError: if JAX is not set to 64-bit floats, or was not when the scene was built.
        ValueError: if the scene does not repeat with one drive period, or there are too few impacts to tell errors.
    """
    scene = as_scene(scene)
    seen = sample_driven(scene)
    if impacts < _PARTS or transient < 0:
        raise ValueError(f"`impacts` must be {_PARTS} or more and `transient` not negative: {impacts} and {transient}")
    single = scene.platform.frequency_khz.ndim == 0
    scenes, tips = batch_and_tips(seen.scenes, None if start is None else seen.start(start))

    def spectrum_from(tips: Tips) -> Lyapunov:
        if isinstance(scene.interaction, Contact):
            return _exponents_of_contacts(scenes, tips, impacts=impacts, transient=transient, accuracy=accuracy)
        return exponents_of_law(scenes, tips, impacts=impacts, transient=transient, report=report)

    exponents = spectrum_from(tips)
    unstable = on_unstable_orbit(exponents)
    if unstable.any():
        # rounding may hold a tip on such an orbit for ever: no neighbour comes to it
        velocity = np.asarray(tips.velocity_nm_per_us)
        speed = velocity - np.asarray(jax.vmap(Platform.velocity)(scenes.platform, jnp.asarray(tips.time_us)))
        exponents = spectrum_from(
            tips._replace(velocity_nm_per_us=velocity + np.where(unstable, _PUSH * np.abs(speed), 0.0))
        )
    return jax.tree.map(lambda part: part[0], exponents) if single else exponents


def exponents_of_law(
    scenes: Scene, tips: Tips, *, impacts: int, transient: int, report: Report | None = None
) -> Lyapunov:
    """Return the exponents of motions in a batch of law scenes; arguments as for `lyapunov_spectrum`."""

    def work(lanes: tuple[Scene, Tips]) -> Lyapunov:
        return _exponents_of_block(*lanes, impacts=impacts, transient=transient)

    program = (_exponents_of_block, impacts, transient)
    return in_blocks(work, (scenes, tips), report=report, program=program)


def _exponents_of_contacts(scenes: Scene, tips: Tips, *, impacts: int, transient: int, accuracy: float) -> Lyapunov:
    """Return the exponents of contact scenes: the motion first, then the Jacobians of all its contacts at once."""
    each = -(-impacts // _PARTS)
    count = (_PARTS + 1) * each + 1
    tips, record = tips_after_contacts(scenes, tips, skip=transient, record=max(count, RECORDED + 1), accuracy=accuracy)
    period, lanes = np.asarray(scenes.platform.period_us), len(tips.time_us)
    verdicts = verdicts_of(record, tips.outcome, period, tolerance=_ARRIVED)
    departure, velocity = record.departure_us, record.velocity_after_nm_per_us
    turns = record.departure_periods * period[:, None] + departure
    passed = np.diff(turns, axis=1)
    exists = np.isfinite(passed)
    steps = passed.shape[1]
    pairs = [np.where(exists, part, 0.0).ravel() for part in (departure[:, :-1], velocity[:, :-1], passed)]
    of_all = jax.tree.map(lambda leaf: np.repeat(np.asarray(leaf), steps, axis=0), scenes)

    def work(rows: tuple[Scene, Array, Array, Array]) -> Array:
        each_scene, time, speed, duration = rows
        return departure_jacobians(each_scene, time, speed, time + duration, accuracy=accuracy)

    slopes = in_blocks(work, (of_all, *pairs), block=_CONTACTS_AT_ONCE).reshape(lanes, steps, 2, 2)
    unit = np.asarray(scenes.platform.angular_frequency * scenes.platform.top_speed_nm_per_us)
    scale = np.stack([np.ones_like(unit), unit, 1.0 / unit, np.ones_like(unit)], axis=1).reshape(lanes, 1, 2, 2)
    jacobians = np.moveaxis(np.where(exists[..., None, None], slopes * scale, np.eye(2)), 1, 0)
    determinants = np.linalg.det(jacobians)
    last = steps - (_PARTS + 1) * each
    sums = _sums_of(
        jacobians[last:], determinants[last:], exists.T[last:], np.where(exists, passed, 0.0).T[last:], each
    )
    flat = np.moveaxis(jacobians.reshape(steps, lanes, 4), 1, 2)
    return _of_orbits(_of_sums(sums, verdicts, record.approach_nm_per_us[:, -RECORDED:]), flat, determinants, period)


def _sums_of(
    jacobians: np.ndarray, determinants: np.ndarray, exists: np.ndarray, passed: np.ndarray, each: int
) -> _Sums:
    """Return the sums of `_measured` from Jacobians that are known, the axis of impacts first."""
    vector = np.broadcast_to([0.8, 0.6], (jacobians.shape[1], 2))
    growth = np.zeros(exists.shape)
    for number, matrix in enumerate(jacobians):
        image = np.einsum("lij,lj->li", matrix, vector)
        length = np.linalg.norm(image, axis=1)
        length = np.where(length > 0.0, length, 1.0)
        vector, growth[number] = image / length[:, None], np.log(length)
    logs = np.log(np.where(exists & (determinants != 0.0), np.abs(determinants), 1.0))
    parts = [growth, logs, exists.astype(float), passed, np.zeros(exists.shape), np.zeros(exists.shape)]
    return _Sums(*(part.reshape(_PARTS + 1, each, -1).sum(axis=1)[1:] for part in parts))


def _exponents_of_block(scenes: Scene, tips: Tips, *, impacts: int, transient: int) -> Lyapunov:
    """Return the exponents of a block of motions in law scenes: means over all impacts, of orbits the multipliers."""
    each = -(-impacts // _PARTS)
    tips = skipped(scenes, tips, impacts=transient)
    tips, sums = _measured(scenes, tips, each=each)
    tips, (record, jacobians, determinants) = _recorded(scenes, tips)
    record = Record(*(np.asarray(part).T for part in record))
    period = np.asarray(scenes.platform.period_us)
    outcome = np.asarray(tips.outcome)
    verdicts = verdicts_of(record, outcome, period, tolerance=_ARRIVED)
    means = _of_sums(_Sums(*(np.asarray(part) for part in sums)), verdicts, record.approach_nm_per_us)
    return _of_orbits(means, np.asarray(jacobians), np.asarray(determinants), period)


@partial(jax.jit, static_argnames=("each",))
def _measured(scenes: Scene, tips: Tips, *, each: int) -> tuple[Tips, _Sums]:
    """Return tips later, and the sums of parts of `each` impacts; before them a part turns the tangent vectors."""
    none = jnp.zeros_like(tips.time_us)
    begin = _Sums(none, none, none, none, none, none)

    def impact(_, state):
        tips, vector, sums = state
        step = advance(scenes, tips)
        jacobian, determinant, landed = _jacobian(scenes, step)
        a, b = vector
        image = jacobian[0] * a + jacobian[1] * b, jacobian[2] * a + jacobian[3] * b
        square = image[0] ** 2 + image[1] ** 2
        counts = landed & ~step.rested & (square > 0.0)
        growth = 0.5 * jnp.log(jnp.where(counts, square, 1.0))
        length = jnp.sqrt(jnp.where(counts, square, 1.0))
        vector = tuple(jnp.where(counts, new / length, old) for new, old in zip(image, vector, strict=True))
        end = step.end
        passed = (end.periods - tips.periods) * scenes.platform.period_us + end.time_us - tips.time_us
        more = _Sums(
            growth,
            jnp.log(jnp.where(counts, jnp.abs(determinant), 1.0)),
            landed.astype(none.dtype),
            jnp.where(landed, passed, 0.0),
            (landed & step.impact.near_grazing).astype(none.dtype),
            (landed & step.rested).astype(none.dtype),
        )
        return end, vector, jax.tree.map(jnp.add, sums, more)

    def part_of_run(state, _):
        tips, vector, sums = lax.fori_loop(0, each, impact, (*state, begin))
        return (tips, vector), sums

    one = jnp.ones_like(none)
    (tips, _), sums = lax.scan(part_of_run, (tips, (0.8 * one, 0.6 * one)), length=_PARTS + 1)
    return tips, jax.tree.map(lambda rows: rows[1:], sums)


@jax.jit
def _recorded(scenes: Scene, tips: Tips) -> tuple[Tips, tuple[Record, Array, Array]]:
    """Return tips later, their impacts, Jacobians and determinants, with the axis of impacts first."""

    def next_impacts(now: Tips, _: Any):
        step = advance(scenes, now)
        jacobian, determinant, _ = _jacobian(scenes, step)
        return step.end, (record_of(scenes, step), jnp.stack(jacobian), determinant)

    return lax.scan(next_impacts, tips, length=RECORDED)


def _jacobian(scenes: Scene, step: MapStep) -> tuple[tuple[Array, Array, Array, Array], Array, Array]:
    """Return the map's Jacobian in drive phase and velocity over beta omega, its determinant, and whether it has one.

    The determinant of a flight is known: -exp(-Omega T/Q) u_out/u_in, with the speeds at its start and end.
    """
    impact, start = step.impact, step.start
    landed = (start.outcome == Outcome.IMPACT) & (step.end.outcome == Outcome.IMPACT)
    arrival = jnp.where(landed, impact.arrival_time_us, start.time_us + scenes.platform.period_us)
    before = jnp.where(landed, impact.velocity_before_nm_per_us, scenes.platform.velocity(arrival) - 1.0)

    def jacobian_of(scene: Scene, time: Array, velocity: Array, arrival: Array, before: Array):
        cantilever, platform = scene.cantilever, scene.platform
        law = impact_law_of(scene)
        flight = flight_jacobian(cantilever, platform, time, velocity, arrival)
        contact = contact_jacobian(law, cantilever, platform, arrival, before)
        damped = jnp.exp(-2.0 * cantilever.decay_rate * (arrival - time))
        ratio = (velocity - platform.velocity(time)) / (before - platform.velocity(arrival))
        determinant = damped * ratio * (contact[0, 0] * contact[1, 1] - contact[0, 1] * contact[1, 0])
        (a, b), (c, d) = contact
        (e, f), (g, h) = flight
        unit = platform.angular_frequency * platform.top_speed_nm_per_us
        return (a * e + b * g, (a * f + b * h) * unit, (c * e + d * g) / unit, c * f + d * h), determinant

    jacobian, determinant = jax.vmap(jacobian_of)(scenes, start.time_us, start.velocity_nm_per_us, arrival, before)
    return jacobian, determinant, landed


def _of_sums(sums: _Sums, verdicts: Verdicts, approach: Float[np.ndarray, "lanes last"]) -> Lyapunov:
    """Return the exponents as means over all impacts."""
    impacts = sums.impacts.sum(axis=0)
    enough = (sums.impacts > 0).all(axis=0)
    kind = verdicts.kind
    rested = sums.rested.sum(axis=0)
    forgotten = (kind == MotionKind.STUCK) | (rested > 0)
    measured = enough & ~forgotten & np.isin(kind, (MotionKind.ORBIT, MotionKind.IRREGULAR))
    logs = np.stack([sums.growth, sums.determinant - sums.growth], axis=-1)

    def mean_and_error(weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        total = np.where(measured, weight.sum(axis=0), 1.0)[:, None]
        mean = logs.sum(axis=0) / total
        off = logs - mean * weight[..., None]
        error = np.sqrt((off**2).sum(axis=0) * _PARTS / (_PARTS - 1)) / total
        larger = np.argsort(-mean, axis=1)
        mean, error = (np.take_along_axis(part, larger, axis=1) for part in (mean, error))
        mean = np.where(measured[:, None], mean, np.where(forgotten[:, None], -np.inf, np.nan))
        return mean, np.where(measured[:, None], error, np.where(forgotten[:, None], 0.0, np.nan))

    per_impact, per_us = mean_and_error(sums.impacts), mean_and_error(sums.time_us)
    determinant = sums.determinant.sum(axis=0) / np.where(measured, impacts, 1.0)
    return Lyapunov(
        exponents_per_impact=per_impact[0],
        exponents_per_us=per_us[0],
        exponents_per_impact_error=per_impact[1],
        exponents_per_us_error=per_us[1],
        mean_log_determinant=np.where(measured, determinant, np.where(forgotten, -np.inf, np.nan)),
        impacts=impacts.astype(int),
        near_grazing=sums.near_grazing.sum(axis=0).astype(int),
        rested=rested.astype(int),
        verdicts=verdicts,
        approach_speed_nm_per_us=approach,
    )


def _of_orbits(means: Lyapunov, jacobians: np.ndarray, determinants: np.ndarray, period: np.ndarray) -> Lyapunov:
    """Return exponents with the multipliers' logarithms in place of means where the motion has come to an orbit.

    Args:
        means: exponents as means over all impacts.
        jacobians: of the last impacts, (impacts, 4, lanes).
        determinants: of these Jacobians, (impacts, lanes).
        period: of the drive in us.
    """
    verdicts = means.verdicts
    count = verdicts.impacts
    lanes = np.flatnonzero((count > 0) & np.isfinite(means.exponents_per_impact[:, 0]))
    if not lanes.size:
        return means
    m = count[lanes]
    product = np.broadcast_to(np.eye(2), (lanes.size, 2, 2))
    logarithm = np.zeros(lanes.size)
    for back in range(int(m.max()), 0, -1):
        here = m >= back
        matrix = np.moveaxis(jacobians[-back][:, lanes].reshape(2, 2, -1), -1, 0)
        product = np.where(here[:, None, None], matrix @ product, product)
        logarithm += np.where(here, np.log(np.abs(np.where(here, determinants[-back, lanes], 1.0))), 0.0)
    half, sign = 0.5 * (product[:, 0, 0] + product[:, 1, 1]), np.sign(np.linalg.det(product))
    inside = half**2 - sign * np.exp(logarithm)
    # a pair on a circle has the root of the determinant for its size
    real = inside > 0.0
    larger = np.where(real, np.log(np.abs(half) + np.sqrt(np.where(real, inside, 0.0)) + 1e-300), 0.5 * logarithm)
    logs = np.stack([larger, logarithm - larger], axis=1) / m[:, None]
    per_us = m / (verdicts.periods[lanes] * period[lanes])
    error = np.repeat(verdicts.remaining[lanes][:, None], 2, axis=1)

    def replaced(old: np.ndarray, new: np.ndarray) -> np.ndarray:
        old = old.copy()
        old[lanes] = new
        return old

    return means._replace(
        exponents_per_impact=replaced(means.exponents_per_impact, logs),
        exponents_per_us=replaced(means.exponents_per_us, logs * per_us[:, None]),
        exponents_per_impact_error=replaced(means.exponents_per_impact_error, error),
        exponents_per_us_error=replaced(means.exponents_per_us_error, error * per_us[:, None]),
        mean_log_determinant=replaced(means.mean_log_determinant, logarithm / m),
    )
