"""Lyapunov exponents of the impact map: how fast neighbouring motions part, from the exact Jacobians.

Takes a scene and values of a parameter; gives exponents per impact, without unit, and in 1/us (Jacobians: eqs. 5 to 8).

Of the map's two exponents the larger is the growth of a tangent vector, the orthogonal factor of a QR decomposition in
two dimensions, and their sum the mean of ln |det|. Once a motion repeats, after m impacts, they are ln |multipliers|/m
of the Jacobian over one repetition. A tip that comes to rest on the platform and is let go by it, or stays for good,
forgets its start: the map has rank one at the capture and rank zero after the release, and both exponents are minus
infinity. Near grazing the Jacobian grows without bound, and errors with it.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Shaped

from afm_jax.apparatus.scene import Scene
from afm_jax.checks import checked
from afm_jax.columns import CsvColumns, csv_columns
from afm_jax.contact.contact import Contact
from afm_jax.dynamics.impact_orbits import multipliers_of
from afm_jax.dynamics.many_tips import Record, Tips, follow, next_departures
from afm_jax.dynamics.starts import batch_and_tips, sample_driven
from afm_jax.dynamics.verdicts import RECORDED, WHY_UNRESOLVED, MotionKind, Verdicts, verdicts_of
from afm_jax.impact.jacobian import contact_jacobian, flight_jacobian
from afm_jax.impact.law import impact_law_of
from afm_jax.motion.record import State
from afm_jax.motion.simulate import DEFAULT_ACCURACY
from afm_jax.report import Section, sections
from afm_jax.results import ResultTuple, public_result
from afm_jax.saved import as_json
from afm_jax.scenefile.parameter_paths import ParameterRange
from afm_jax.solve.lanes import WIDTHS, Report, in_blocks
from afm_jax.words import counted, with_error

_PARTS = 20
"""Parts of a motion whose means tell the errors."""


@public_result(picture="afm_jax.plots.dynamics:exponents_figure")
class Lyapunov(ResultTuple):
    """The two Lyapunov exponents of each of several motions, the larger one first; arrays of one lane a motion.

    Attributes:
        exponents_per_impact: minus infinity where the tip rests on the platform; NaN where the motion ended, without
            an impact to the end, before a tenth of the impacts were made.
        exponents_per_us: exponents per time, in 1/us; minus infinity and NaN where those per impact are.
        exponents_per_impact_error: standard errors from the means of twenty parts; of an orbit how far it may be off.
        exponents_per_us_error: those over the mean time of an impact.
        impacts: how many the means are over.
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
    impacts: Int[np.ndarray, " lanes"]
    rested: Int[np.ndarray, " lanes"]
    verdicts: Verdicts
    approach_speed_nm_per_us: Float[np.ndarray, "lanes last"]
    along: ParameterRange | None = None
    larger_interval95: Float[np.ndarray, "lanes 2"] | None = None

    @property
    def reason(self) -> str | None:
        """Why there are no exponents at all; None where there are some."""
        motions = _motions(self)
        if not np.isnan(motions.exponents_per_impact[:, 0]).all():
            return None
        words = "; ".join(dict.fromkeys(exponent_verdicts(motions)))
        return f"{words}; there were at most {int(motions.impacts.max())} impacts to average over"

    @property
    def impact_speeds_nm_per_us(self) -> Float[np.ndarray, "*lanes last"]:
        """Approach speeds of the last impacts."""
        return self.approach_speed_nm_per_us


def _motions(result: Lyapunov) -> Lyapunov:
    """Return the exponents of many motions; those of one as a batch of one."""
    return result if np.ndim(result.impacts) else jax.tree.map(lambda array: np.asarray(array)[None], result)


@as_json.register
def _(result: Lyapunov) -> dict[str, Any]:
    # numbers of one motion, lists of many
    names = ("exponents_per_us", "exponents_per_impact", "exponents_per_us_error", "exponents_per_impact_error")
    verdicts = exponent_verdicts(_motions(result))
    told = {name: getattr(result, name) for name in (*names, "impacts", "rested")} | {
        "orbit": {"impacts": result.verdicts.impacts, "periods": result.verdicts.periods},
        "verdict": verdicts if np.ndim(result.impacts) else verdicts[0],
    }
    if result.larger_interval95 is not None:
        told["exponent_per_impact_interval95"] = result.larger_interval95
    return told if result.along is None else told | {"parameter": result.along.path, "values": result.along.values}


@sections.register
def _(result: Lyapunov) -> list[Section]:
    # the exponents of one motion with their errors; of many how many are positive
    larger, error = result.exponents_per_impact[..., 0], result.exponents_per_impact_error[..., 0]
    if np.ndim(result.impacts):
        positive, what = int(np.sum(larger > CHAOTIC_ERRORS * error)), result.along or counted(larger.size, "motion")
        return [Section("", [f"{what}: the larger exponent is positive at {positive} of {larger.size} values"])]

    def pair(values: np.ndarray, errors: np.ndarray) -> str:
        pairs = zip(values, errors, strict=True)
        return ", ".join(with_error(value, error) if error > 0.0 else f"{value:.6g}" for value, error in pairs)

    lines = [
        f"Lyapunov exponents per impact: {pair(result.exponents_per_impact, result.exponents_per_impact_error)}",
        f"                       per us: {pair(result.exponents_per_us, result.exponents_per_us_error)}",
        f"{int(result.impacts)} impacts; {exponent_verdicts(_motions(result))[0]}",
    ]
    if result.larger_interval95 is not None:
        low, high = result.larger_interval95
        lines.append(f"the larger per impact: {low:.6g} to {high:.6g} in 95 % of the draws")
    return [Section("", lines)]


@csv_columns.register
def _(result: Lyapunov) -> CsvColumns:
    motions = _motions(result)
    columns: dict[str, Any] = {} if result.along is None else {result.along.path: result.along.values}
    columns |= {
        "exponent_per_impact": motions.exponents_per_impact[:, 0],
        "second_exponent_per_impact": motions.exponents_per_impact[:, 1],
        "exponent_per_impact_error": motions.exponents_per_impact_error[:, 0],
        "exponent_per_us": motions.exponents_per_us[:, 0],
        "second_exponent_per_us": motions.exponents_per_us[:, 1],
        "impacts": motions.impacts,
        "rested": motions.rested,
        "verdict": exponent_verdicts(motions),
    }
    if motions.larger_interval95 is not None:
        low, high = motions.larger_interval95.T
        columns |= {"exponent_per_impact_low": low, "exponent_per_impact_high": high}
    return {"lyapunov.csv": columns}


CHAOTIC_ERRORS = 3.0
"""Standard errors by which the larger exponent must be above 0 to be called positive."""


def exponent_verdicts(exponents: Lyapunov) -> list[str]:
    """Return in words what the exponents of each of many motions say."""
    words = []
    for lane, name in enumerate(exponents.verdicts.names()):
        kind = exponents.verdicts.kind[lane]
        larger = exponents.exponents_per_impact[lane, 0]
        error = exponents.exponents_per_impact_error[lane, 0]
        # below it is rounding
        if kind == MotionKind.ORBIT and larger > max(1e-9, error):
            # rounding holds the motion there: no neighbour comes to it
            words.append(f"undecided: the motion stays on a {name} orbit that is unstable; try another [start]")
        elif kind == MotionKind.ORBIT:
            forgets = ", the tip rests on the platform and forgets its start" if np.isneginf(larger) else ""
            words.append(f"regular: the motion has come to a {name} orbit{forgets}")
        elif kind != MotionKind.IRREGULAR:
            words.append(_WITHOUT_EXPONENTS[kind])
        elif np.isneginf(larger):
            words.append("the tip rests on the platform and forgets its start")
        elif larger > CHAOTIC_ERRORS * error:
            words.append("chaotic: the larger exponent is positive")
        else:
            words.append(
                "undecided: nothing repeats, and the larger exponent is not clearly positive; the motion may still be "
                "settling (`transient=...` gives it more)"
            )
    return words


_WITHOUT_EXPONENTS = {
    MotionKind.STUCK: "stuck: the platform holds the tip",
    MotionKind.FREE: "free: the tip no longer meets the platform",
    MotionKind.UNRESOLVED: f"unresolved: the motion comes {WHY_UNRESOLVED}",
}


@checked
def lyapunov_spectrum(
    scene: Scene,
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
        start: where the motion begins; None: `bouncing_tips`.
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
    seen = sample_driven(scene)
    if impacts < _PARTS or transient < 0:
        raise ValueError(f"`impacts` must be {_PARTS} or more and `transient` not negative: {impacts} and {transient}")
    single = scene.platform.frequency_khz.ndim == 0
    scenes, tips = batch_and_tips(seen.scenes, None if start is None else seen.start(start))

    def work(lanes: tuple[Scene, Tips]) -> Lyapunov:
        return _exponents_of_block(*lanes, impacts=impacts, transient=transient, accuracy=accuracy)

    # impacts recorded together: of long motions a block holds fewer; no contact is simulated for copies of a lane
    widths = [width for width in WIDTHS if width * impacts <= 2_000_000] or [1]
    if isinstance(scenes.interaction, Contact):
        widths = [len(tips.time_us)]
    exponents = in_blocks(work, (scenes, tips), widths=widths, report=report)
    return jax.tree.map(lambda part: part[0], exponents) if single else exponents


def _exponents_of_block(scenes: Scene, tips: Tips, *, impacts: int, transient: int, accuracy: float) -> Lyapunov:
    """Return the exponents of a block of motions: the motion first, then the Jacobians of all its impacts at once.

    They are means over all impacts, of orbits the logarithms of the multipliers. A part of the motion before those that
    count turns the tangent vectors.
    """
    each = -(-impacts // _PARTS)
    steps = (_PARTS + 1) * each
    recorded = max(steps, RECORDED) + 1
    tips, record = follow(scenes, tips, skip=max(transient - 1, 0), record=recorded, accuracy=accuracy)
    period = np.asarray(scenes.platform.period_us)
    last = Record(*(part[:, -RECORDED:] for part in record))
    # so near to an orbit its multipliers are taken for the exponents
    verdicts = verdicts_of(last, np.asarray(tips.outcome), period, tolerance=1e-8)
    jacobians, determinants, passed = _linearised(scenes, record, period, accuracy)

    def parts(of_impacts: np.ndarray) -> Shaped[np.ndarray, "parts lanes"]:
        return of_impacts[:, -steps:].reshape(len(period), _PARTS + 1, each).sum(axis=2).T[1:]

    growth = parts(_growth_of(jacobians[:, -steps:]))
    both = np.stack([growth, parts(np.log(np.abs(determinants))) - growth], axis=-1)
    made, rested = parts(np.isfinite(passed)), parts(record.rested[:, 1:]).sum(axis=0)
    orbit = verdicts.kind == MotionKind.ORBIT
    forgotten = (verdicts.kind == MotionKind.STUCK) | (rested > 0)
    measured = (made > 0).all(axis=0) & (orbit | (verdicts.kind == MotionKind.IRREGULAR))
    count = np.where(measured, made.sum(axis=0), 1.0)
    mean = both.sum(axis=0) / count[:, None]
    error = np.sqrt(((both - mean * made[..., None]) ** 2).sum(axis=0) * _PARTS / (_PARTS - 1)) / count[:, None]
    larger = np.argsort(-mean, axis=1)
    mean, error = (np.take_along_axis(part, larger, axis=1) for part in (mean, error))
    mean = np.where(orbit[:, None], _exponents_of_orbits(verdicts, jacobians, determinants), mean)
    error = np.where(orbit[:, None], verdicts.remaining[:, None], error)
    cases = [forgotten, measured]
    per_impact, error = np.select(cases, [-np.inf, mean.T], np.nan).T, np.select(cases, [0.0, error.T], np.nan).T
    # of an orbit the time that it repeats in
    lasts_us = np.where(orbit, verdicts.periods * period, parts(np.nan_to_num(passed)).sum(axis=0))
    pace_us = np.where(measured, lasts_us / np.where(orbit, verdicts.impacts, count), 1.0)[:, None]
    return Lyapunov(
        exponents_per_impact=per_impact,
        exponents_per_us=per_impact / pace_us,
        exponents_per_impact_error=error,
        exponents_per_us_error=error / pace_us,
        impacts=made.sum(axis=0),
        rested=rested,
        verdicts=verdicts,
        approach_speed_nm_per_us=last.approach_nm_per_us,
    )


def _exponents_of_orbits(
    verdicts: Verdicts, jacobians: Float[np.ndarray, "lanes steps 2 2"], determinants: Float[np.ndarray, "lanes steps"]
) -> Float[np.ndarray, "lanes 2"]:
    """Return ln |multipliers|/m of the motions that have come to an orbit, from the last Jacobians; 0 of the others."""
    m = verdicts.impacts
    product, determinant = np.broadcast_to(np.eye(2), (len(m), 2, 2)), np.ones(len(m))
    for back in range(int(m.max(initial=0)), 0, -1):
        counts = m >= back
        product = np.where(counts[:, None, None], jacobians[:, -back] @ product, product)
        determinant = determinant * np.where(counts, determinants[:, -back], 1.0)
    larger = np.log(np.abs(multipliers_of(np.trace(product, axis1=1, axis2=2), determinant)[:, 0]))
    return np.stack([larger, np.log(np.abs(determinant)) - larger], axis=1) / np.maximum(m, 1)[:, None]


def _linearised(
    scenes: Scene, record: Record, period_us: Float[np.ndarray, " lanes"], accuracy: float
) -> tuple[Float[np.ndarray, "lanes steps 2 2"], Float[np.ndarray, "lanes steps"], Float[np.ndarray, "lanes steps"]]:
    """Return the map's Jacobians between recorded impacts, their determinants, and the times in us in between.

    The coordinates are drive phase and velocity (of contacts the rebound speed) over beta omega. Where there is no
    impact, or the tip rested before its departure, the Jacobian is 1.
    """

    def since(periods: np.ndarray, time_us: np.ndarray) -> np.ndarray:
        # from the beginning of the period of the departure before
        return (periods[:, 1:] - record.departure_periods[:, :-1]) * period_us[:, None] + time_us[:, 1:]

    departure, passed = record.departure_us[:, :-1], since(record.departure_periods, record.departure_us)
    flown, there = since(record.arrival_periods, record.arrival_us), np.isfinite(passed)
    rows = departure, record.velocity_after_nm_per_us[:, :-1], passed, flown, record.approach_nm_per_us[:, 1:]
    rows = [np.where(there, part, 0.0) for part in rows]
    if isinstance(scenes.interaction, Contact):
        jacobians = _contact_jacobians(scenes, *rows[:3], accuracy=accuracy)
        determinants, unit = np.linalg.det(jacobians), np.asarray(scenes.platform.top_speed_nm_per_us)
    else:
        jacobians, determinants = map(np.asarray, _impact_jacobians(scenes, *rows[:2], *rows[3:]))
        unit = np.asarray(scenes.platform.angular_frequency * scenes.platform.top_speed_nm_per_us)
    scale = np.stack([np.ones_like(unit), unit, 1.0 / unit, np.ones_like(unit)], axis=1).reshape(-1, 1, 2, 2)
    counts = there & ~record.rested[:, 1:]
    jacobians = np.where(counts[..., None, None], jacobians * scale, np.eye(2))
    return jacobians, np.where(counts & (determinants != 0.0), determinants, 1.0), passed - departure


def _contact_jacobians(
    scenes: Scene,
    departure_us: Float[np.ndarray, "lanes steps"],
    velocity_nm_per_us: Float[np.ndarray, "lanes steps"],
    next_departure_us: Float[np.ndarray, "lanes steps"],
    *,
    accuracy: float,
) -> Float[np.ndarray, "lanes steps 2 2"]:
    """Return the derivatives of next departures, d(phase, rebound speed) over d(phase, rebound speed) of these."""
    each = jax.tree.map(lambda leaf: jnp.repeat(jnp.asarray(leaf), departure_us.shape[1], axis=0), scenes)
    omega, time = np.asarray(each.platform.angular_frequency), departure_us.ravel()
    rebound = velocity_nm_per_us.ravel() - np.asarray(each.platform.velocity(time))
    # a thousandth of a free period after a departure no contact goes on, and the next one has not begun
    until = omega * (next_departure_us.ravel() + 1.0 / each.cantilever.frequency_khz)

    lanes = each, np.stack([omega * time, rebound], axis=1), until
    slopes = in_blocks(lambda some: next_departures(*some, accuracy=accuracy)[1], lanes, widths=WIDTHS[:-1])
    return slopes.reshape(*departure_us.shape, 2, 2)


@jax.jit
def _impact_jacobians(
    scenes: Scene,
    departure_us: Float[Array, "lanes steps"],
    velocity_nm_per_us: Float[Array, "lanes steps"],
    arrival_us: Float[Array, "lanes steps"],
    approach_nm_per_us: Float[Array, "lanes steps"],
) -> tuple[Float[Array, "lanes steps 2 2"], Float[Array, "lanes steps"]]:
    """Return the Jacobians of the impact map in time and velocity, and their determinants.

    The determinant of a flight is known: -exp(-Omega T/Q) u_out/u_in, with the speeds at its start and end.
    """

    def jacobian_of(scene: Scene, time: Array, velocity: Array, arrival: Array, approach: Array) -> tuple[Array, Array]:
        cantilever, platform = scene.cantilever, scene.platform
        flight = flight_jacobian(cantilever, platform, time, velocity, arrival)
        before = platform.velocity(arrival) - approach
        contact = contact_jacobian(impact_law_of(scene), cantilever, platform, arrival, before)
        damped = jnp.exp(-2.0 * cantilever.decay_rate * (arrival - time))
        ratio = (platform.velocity(time) - velocity) / approach
        determinant = damped * ratio * (contact[0, 0] * contact[1, 1] - contact[0, 1] * contact[1, 0])
        # products and a sum: under `vmap` a matrix product of this size costs ten times as much
        return jnp.sum(contact[:, :, None] * flight, axis=1), determinant

    over_impacts = jax.vmap(jacobian_of, in_axes=(None, 0, 0, 0, 0))
    return jax.vmap(over_impacts)(scenes, departure_us, velocity_nm_per_us, arrival_us, approach_nm_per_us)


def _growth_of(jacobians: Float[np.ndarray, "lanes steps 2 2"]) -> Float[np.ndarray, "lanes steps"]:
    """Return ln |J q| of every step, q the unit tangent vector that the steps before have turned."""
    vector = np.broadcast_to([0.8, 0.6], (len(jacobians), 2))
    growth = np.zeros(jacobians.shape[:2])
    for number in range(jacobians.shape[1]):
        image = np.einsum("lij,lj->li", jacobians[:, number], vector)
        length = np.linalg.norm(image, axis=1)
        length = np.where(length > 0.0, length, 1.0)
        vector, growth[:, number] = image / length[:, None], np.log(length)
    return growth
