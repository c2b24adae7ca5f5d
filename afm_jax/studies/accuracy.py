"""What accuracy costs: error and time of a value and of its gradient, ours beside those of general-purpose integrators.

Three problems: the time of the next impact with a law (`map`), the rebound speed of the paper's contact (`collide`),
and the arrival of one of the first contacts of any scene. Each is a function of a few parameters, solved with every
setting of this package, by SciPy's DOP853 with events (gradients by central differences), and by Diffrax's Dopri8 with
its Event (gradients by differentiation). The two rivals know the equation of motion of each phase
(`EquationOfMotion`), not that flights have a closed form, nor that a contact can be gone through leg by leg. Errors are
achieved ones, against the closed form or quadrature in its finest setting.

Runs in a process of its own on one core (`afm_jax.studies.timing.run_in_own_process`).
"""

import math
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from operator import attrgetter
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int
from scipy.integrate import solve_ivp

from afm_jax.apparatus.scene import Scene
from afm_jax.apparatus.surface import surface_of
from afm_jax.columns import CsvColumns, columns_of, csv_columns
from afm_jax.compilation_cache import quick_options
from afm_jax.contact.collide import batch_of
from afm_jax.contact.contact import Contact
from afm_jax.contact.driven import ContactState, driven_by, free_tip
from afm_jax.contact.junction import ContactPhase, find_junction
from afm_jax.contact.parameters import PAPER
from afm_jax.contact.settings import DRIVEN_SETTINGS, SETTINGS, DrivenSetting, Setting
from afm_jax.dynamics.starts import evenly_spread
from afm_jax.impact.lasting_impact import speeds_of_impact
from afm_jax.impact.law import Law
from afm_jax.impact.map import iterate_map
from afm_jax.impact.orbits import single_impact_orbits
from afm_jax.motion.contact_motion import follow_contacts
from afm_jax.motion.law_motion import follow_law
from afm_jax.motion.record import ContactKind, State, to_gap
from afm_jax.motion.start import start_of
from afm_jax.report import Section, sections, table_of
from afm_jax.results import Result, public_result
from afm_jax.scenefile.scenefile import load_scene, read_scene
from afm_jax.solve.derivatives import value_and_slopes
from afm_jax.studies.timing import compiled_for, progress, seconds_a_call

Row = dict[str, Any]
Parameters = Float[Array, " parameters"]
Values = Float[Any, " tips"]
Slopes = Float[Any, "tips parameters"]

_LONGEST_US, _LONGEST_TOUCH_US = 1000.0, 10.0
"""No flight, and no phase of a contact, of a motion that is compared lasts as long, unless rounding holds the tip."""
_MOST_PHASES = 100
"""Of a tip between two crossings."""
_STEPS_A_PERIOD = 3.0
"""Steps of a flight in a period of what moves fastest, at least: an event is seen by its signs at their ends."""
_FEW = 3
"""Tips that SciPy follows, one after the other."""


class Tip(NamedTuple):
    """A tip at the beginning or the end of a phase; scalars, or arrays of the tips' shape."""

    phase: Int[Array, "..."]
    x: Float[Array, "..."]
    """The gap in nm, in the junction the root s of `Driven`."""
    rate: Float[Array, "..."]
    """Of the gap, in nm/us."""
    time_us: Float[Array, "..."]
    arrived_us: Float[Array, "..."]
    """When the last flight ended."""
    crossings: Int[Array, "..."]
    """How often the tip has arrived at the sample or left it."""


class EquationOfMotion(eqx.Module):
    """The equation of motion of a tip, phase by phase, as a general-purpose integrator is given it.

    Attributes:
        cantilever: of the flights; None: a free tip that only collides.
        surface: what the flying tip sees, however it is driven (`surface_of`).
        law: what an impact does; None: the contact is resolved.
        driven: the tip in contact; None: there is a law.
        spans: whether there is a bridge between flight and junction.
    """

    cantilever: Any = None
    surface: Any = None
    law: Any = None
    driven: Any = None
    spans: bool = eqx.field(static=True, default=True)

    def rates(self, phase: Any, x: Any, rate: Any, time_us: Any) -> tuple[Array, Array, Array]:
        """Return the rates of gap (or s), gap rate and time by the time (in the junction: fictitious time)."""
        state = ContactState(x, rate, time_us, jnp.zeros_like(x))
        solid = jnp.asarray(phase == ContactPhase.JUNCTION)
        found = (x, x, x) if self.driven is None else self.driven.rates(state, solid)[:3]
        if self.cantilever is None:
            return found
        height, speed = self.surface.position_and_velocity(time_us)
        pull = self.cantilever.acceleration(x + height, rate + speed) - self.surface.acceleration(time_us)
        flight = (rate, pull, jnp.ones_like(x))
        flies = phase == ContactPhase.DRY
        return jax.tree.map(lambda flying, touching: jnp.where(flies, flying, touching), flight, found)

    def limits(self, phase: Any) -> tuple[Array, Array, Array, Array]:
        """Return what a phase is bounded by.

        It ends where x has fallen to the first number, or risen to the second; the third is the longest step in us that
        sees every end of a flight, the fourth how long it lasts at most.
        """
        down, up, step = jnp.zeros(()), jnp.asarray(jnp.inf), jnp.asarray(jnp.inf)
        flies = phase == ContactPhase.DRY
        if self.driven is not None:
            bridged = phase == ContactPhase.BRIDGE
            down = jnp.where(bridged, self.driven.junction.forms_gap_nm, self.driven.forms_nm)
            down = jnp.where(phase == ContactPhase.JUNCTION, self.driven.solid.fold, down)
            up = jnp.where(bridged, self.driven.breaks_nm, up)
        if self.cantilever is not None:
            fastest = jnp.maximum(self.surface.fastest_angular_frequency, self.cantilever.angular_frequency)
            step = jnp.where(flies, 2.0 * jnp.pi / fastest / _STEPS_A_PERIOD, step)
        return down, up, step, jnp.where(flies, _LONGEST_US, _LONGEST_TOUCH_US)

    def after(self, tip: Tip, risen: Bool[Array, ""]) -> Tip:
        """Return what follows the end of a phase; the rate of a tip that a law captures is NaN."""
        if self.driven is None:
            speeds = speeds_of_impact(self.law, -tip.rate, tip.time_us, self.cantilever, self.surface)
            rebound = jnp.where(speeds.rebound > 0.0, speeds.rebound, jnp.nan)
            leaves = tip.time_us + speeds.delay
            return Tip(tip.phase, jnp.zeros_like(rebound), rebound, leaves, tip.time_us, tip.crossings + 2)
        driven, (down, up, *_) = self.driven, self.limits(tip.phase)
        flew, pressed = tip.phase == ContactPhase.DRY, tip.phase == ContactPhase.JUNCTION
        presses = ~risen & (~pressed & ~flew if self.spans else flew)
        gap = jnp.where(pressed, driven.junction.breaks_gap_nm, jnp.where(risen, up, down))
        leaves = risen | (pressed & (driven.junction.breaks_gap_nm >= driven.breaks_nm))
        phase = jnp.where(leaves, ContactPhase.DRY, jnp.where(presses, ContactPhase.JUNCTION, ContactPhase.BRIDGE))
        return Tip(
            phase=phase.astype(tip.phase.dtype),
            x=jnp.where(presses, driven.junction.forms_root, gap),
            rate=tip.rate,
            time_us=tip.time_us,
            arrived_us=jnp.where(flew, tip.time_us, tip.arrived_us),
            crossings=tip.crossings + (flew | leaves).astype(tip.crossings.dtype),
        )


@dataclass(frozen=True)
class AccuracyProblem:
    """A value of some tips as a function of parameters; the study gives errors of value and gradient.

    Attributes:
        what: the value in words, with its unit.
        at: the parameters.
        solve: from a setting and the parameters the values.
        settings: by their names; numbers are arguments of one program, others shape theirs.
        reference: what errors are taken against, in words.
        finest: its setting, and a coarser one that shows how far it is converged.
        begin: from the parameters the motion and the tips that rivals follow.
        crossings: how far they follow them, and of the last tip...
        read: ...what the value is.
        events: impacts or contacts of a tip.
        relative: whether the error of the value is relative.
        options: of the compiler, as users' programs have them.
    """

    what: str
    at: Parameters
    solve: Callable[[Any, Parameters], Values]
    settings: Mapping[str, Any]
    reference: str
    finest: tuple[Any, Any]
    begin: Callable[[Parameters], tuple[EquationOfMotion, Tip]]
    crossings: int = 1
    read: Callable[[Tip], Any] = attrgetter("arrived_us")
    events: int = 1
    relative: bool = False
    options: dict[str, Any] | None = None

    @cached_property
    def exact(self) -> tuple[Values, Slopes]:
        """Values, and slopes by the parameters, of the reference."""
        return self._with_slopes(self.finest[0])

    @cached_property
    def doubt(self) -> tuple[float, float]:
        """The reference's own errors of value and gradient."""
        return self.errors(*self._with_slopes(self.finest[1]))

    def _with_slopes(self, setting: Any) -> tuple[Values, Slopes]:
        """Return values and slopes, by a program that compiles quickly: it is not timed."""
        value = partial(value_and_slopes, partial(self.solve, setting))
        return jax.tree.map(np.asarray, compiled_for(value, self.at, options=quick_options(0))(self.at))

    def errors(self, values: Any, slopes: Any, tips: Any = slice(None)) -> tuple[float, float]:
        """Return the largest errors of value and gradient; of a slope relative to its largest among the tips."""
        exact, exact_slopes = (part[tips] for part in self.exact)
        scale = np.abs(exact) if self.relative else 1.0
        size = np.max(np.abs(exact_slopes), axis=0)
        value = np.max(np.abs(np.asarray(values) - exact) / scale)
        return float(value), float(np.max(np.abs(np.asarray(slopes) - exact_slopes) / size))


@public_result(picture="afm_jax.plots.accuracy:accuracy_figure")
@dataclass(frozen=True)
class AccuracyStudy(Result):
    """Errors and times of a problem.

    Attributes:
        problem: its name.
        rows: each with of ("value" or "gradient"), method, setting, microseconds (of one impact or contact), error,
            and reason where there is no error.
        value_of: what the value is.
        reference: what errors are taken against.
        reference_error: its own error of the value.
        reference_gradient_error: its own error of the gradient.
    """

    problem: str
    rows: list[Row]
    value_of: str
    reference: str
    reference_error: float
    reference_gradient_error: float


_COLUMNS = ("of", "method", "setting", "microseconds", "error")


@sections.register
def _(study: AccuracyStudy) -> list[Section]:
    reference = (
        f"Reference: {study.reference}, itself known to {study.reference_error:.0e} (gradient: "
        f"{study.reference_gradient_error:.0e}). Times are those of one impact or contact on one core, programs "
        "compiled. A gradient is that by all parameters of the problem, relative to its largest value among the tips."
    )
    table = table_of({name: name for name in _COLUMNS}, study.rows, form=".3g")
    faults = [f"{row['method']}, {row['setting']}: {row['reason']}" for row in study.rows if "reason" in row]
    title = f"Error of the {study.value_of} and of its gradient against time"
    return [Section(title, [table, *dict.fromkeys(faults), reference])]


@csv_columns.register
def _(study: AccuracyStudy) -> CsvColumns:
    return {"accuracy.csv": columns_of(study.rows, (*_COLUMNS, "reason"))}


def measured(problem: str, *, contacts: int = 10, quick: bool = False) -> AccuracyStudy:
    """Measure errors and times of a problem.

    Args:
        problem: "map", "collide", or a scene's file or preset.
        contacts: of a scene: number of the contact whose arrival is compared.
        quick: few settings, each measured once: to see that it works.

    Raises:
        ValueError: if a scene's tip has fewer contacts.
    """
    tips, repetitions = (20, 1) if quick else (500, 5)
    tolerances = {f"tolerance {each:g}": each for each in ((1e-8,) if quick else (1e-6, 1e-8, 1e-10, 1e-12))}
    problems = {"map": partial(impact_times, tips), "collide": partial(rebound_speeds, tips)}
    solved = problems.get(problem, partial(contact_arrivals, problem, contacts))()
    names = list(solved.settings)
    chosen = {name: solved.settings[name] for name in ((names[0], names[-1]) if quick else names)}
    rows = [
        *_compiled_rows(solved, "afm-jax", solved.solve, chosen, repetitions),
        *_compiled_rows(solved, "Diffrax Dopri8", partial(by_diffrax, solved), tolerances, repetitions),
        *_scipy_rows(solved, tolerances),
    ]
    rows.sort(key=lambda row: row["of"] == "gradient")
    return AccuracyStudy(problem, rows, solved.what, solved.reference, *solved.doubt)


def _row(of: str, method: str, setting: str, seconds: float, error: float) -> Row:
    row = {"of": of, "method": method, "setting": setting, "microseconds": 1e6 * seconds, "error": error}
    if math.isfinite(error):
        return row
    none = {"microseconds": None, "error": None, "reason": "the tip is captured, or the integrator gave up"}
    return row | none


def _compiled_rows(
    problem: AccuracyProblem,
    method: str,
    solve: Callable[[Any, Parameters], Values],
    settings: Mapping[str, Any],
    repetitions: int,
) -> Iterator[Row]:
    """Give the rows of compiled values and gradients, forwards; settings that are numbers share one program."""
    events, programs = problem.events * np.asarray(problem.exact[0]).size, []
    for name, setting in settings.items():
        progress(f"accuracy: {method}, {name}")
        number = isinstance(setting, float)
        arguments = (jnp.asarray(setting), problem.at) if number else (problem.at,)
        if not (number and programs):
            value = solve if number else partial(solve, setting)
            both = value, jax.jacfwd(value, argnums=len(arguments) - 1)
            programs = [compiled_for(each, *arguments, options=problem.options) for each in both]
        errors = problem.errors(*(run(*arguments) for run in programs))
        for of, run, error in zip(("value", "gradient"), programs, errors, strict=True):
            seconds = min(seconds_a_call(run, *arguments, repetitions=repetitions))
            yield _row(of, method, name, seconds / events, error)


def by_diffrax(problem: AccuracyProblem, tolerance: Float[Array, ""], parameters: Parameters) -> Values:
    """Return the values of tips that are followed from phase to phase, each ended by Diffrax's Event; NaN if none."""
    motion, tips = problem.begin(parameters)

    def phase_of(tip: Tip) -> Tip:
        down, up, step, longest = motion.limits(tip.phase)
        # called by position or by these names
        falls: Any = lambda t, y, args, **_: y[0] - down  # noqa: ARG005, E731
        rises: Any = lambda t, y, args, **_: y[0] - up  # noqa: ARG005, E731
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(lambda _, y, __: motion.rates(tip.phase, *y)),
            diffrax.Dopri8(),
            0.0,
            longest,
            None,
            (tip.x, tip.rate, tip.time_us),
            stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=1e-3 * tolerance, dtmax=step),
            # downwards alone: a tip leaves a surface with a gap of 0
            event=diffrax.Event([falls, rises], optimistix.Newton(1e-14, 1e-14), direction=[False, True]),
            adjoint=diffrax.ForwardMode(),
            max_steps=None,
            throw=False,
        )
        assert solution.ys is not None  # noqa: S101 (for the type checker: the end is saved)
        met: Any = solution.event_mask
        x, rate, now = (part[-1] for part in solution.ys)
        rate = jnp.where(met[0] | met[1], rate, jnp.nan)
        return motion.after(tip._replace(x=x, rate=rate, time_us=now), met[1])

    def goes_on(state: tuple[Array, Tip]) -> Array:
        count, tip = state
        return (tip.crossings < problem.crossings) & jnp.isfinite(tip.rate) & (count < _MOST_PHASES * problem.crossings)

    def next_phase(state: tuple[Array, Tip]) -> tuple[Array, Tip]:
        return state[0] + 1, phase_of(state[1])

    none = jnp.zeros((), jnp.int32)
    _, ends = jax.vmap(lambda tip: jax.lax.while_loop(goes_on, next_phase, (none, tip)))(tips)
    return jnp.where(ends.crossings < problem.crossings, jnp.nan, problem.read(ends))


def _scipy_rows(problem: AccuracyProblem, tolerances: Mapping[str, float]) -> Iterator[Row]:
    """Give DOP853 with events on a few tips one by one; gradients by central differences of a step that suits."""
    begin = jax.jit(problem.begin)
    template, starts = begin(problem.at)
    tips = np.unique(np.linspace(0, starts.x.size - 1, _FEW).astype(int)).tolist()
    programs, at = ScipyPrograms(template), np.asarray(problem.at)

    def value(tip: int, parameters: np.ndarray, tolerance: float) -> np.ndarray:
        motion, starts = begin(jnp.asarray(parameters))
        start = jax.tree.map(lambda part: np.asarray(part)[tip], starts)
        vector = jax.block_until_ready(programs.vector(motion))
        began = time.perf_counter()
        end = by_scipy(programs, vector, start, problem.crossings, tolerance)
        return np.array([problem.read(end), time.perf_counter() - began])

    for name, tolerance in tolerances.items():
        progress(f"accuracy: SciPy DOP853, {name}")
        step = tolerance ** (1.0 / 3.0)
        places = np.concatenate([at[None], at + step * np.eye(at.size), at - step * np.eye(at.size)])
        # once for the programs
        value(tips[0], at, tolerance)
        found = np.array([[value(tip, place, tolerance) for place in places] for tip in tips])
        values, seconds = np.moveaxis(found, -1, 0)
        slopes = (values[:, 1 : 1 + at.size] - values[:, 1 + at.size :]) / (2.0 * step)
        spent = np.mean(seconds[:, 0]), np.mean(np.sum(seconds[:, 1:], axis=1))
        errors = problem.errors(values[:, 0], slopes, tips)
        for of, each, error in zip(("value", "gradient"), spent, errors, strict=True):
            yield _row(of, "SciPy DOP853", name, float(each) / problem.events, error)


class ScipyPrograms:
    """What SciPy calls, compiled once: functions of a motion's numbers in a vector."""

    def __init__(self, template: EquationOfMotion):
        """Take the structure of a motion; its numbers are an argument of the programs."""
        numbers, rest = eqx.partition(template, eqx.is_inexact_array)
        _, unravel = ravel_pytree(numbers)

        def of(vector: Array) -> EquationOfMotion:
            return eqx.combine(unravel(vector), rest)

        self.after = jax.jit(lambda vector, tip, risen: of(vector).after(tip, risen))
        self.limits = jax.jit(lambda vector, phase: of(vector).limits(phase))
        self.touching = jax.jit(lambda vector, phase, y: jnp.stack(of(vector).rates(phase, *y)), static_argnums=1)
        self.flight = jax.jit(lambda vector: _flight_numbers(of(vector)))

    @staticmethod
    def vector(motion: EquationOfMotion) -> Array:
        """Return the numbers of a motion."""
        return ravel_pytree(eqx.filter(motion, eqx.is_inexact_array))[0]


def _flight_numbers(motion: EquationOfMotion) -> tuple[Array, ...]:
    """Return Omega^2, Omega/Q, offset and ramp of the surface, and its cosines as rows."""
    cantilever, surface = motion.cantilever, motion.surface
    waves = jnp.array([[wave.cosine, wave.sine, wave.angular_frequency] for wave in surface.waves])
    own = cantilever.angular_frequency**2, 2.0 * cantilever.decay_rate
    return *own, surface.offset_nm, surface.offset_rate_nm_per_us, waves.reshape(-1, 3)


def _rates_of_flight(square: Array, friction: Array, offset: Array, ramp: Array, waves: Array) -> Callable[..., Any]:
    """Return `EquationOfMotion.rates` of a flight in plain numbers, without JAX, whose calls take longer than these."""
    (stiff, loss, mean, drift), rows = map(float, (square, friction, offset, ramp)), np.asarray(waves).tolist()

    def rates(_: float, y: Any) -> tuple[float, float, float]:
        gap, rate, now = y.tolist()
        height, speed, pull = gap + mean + drift * now, rate + drift, 0.0
        for along, across, omega in rows:
            cosine, sine = math.cos(omega * now), math.sin(omega * now)
            moved = along * cosine + across * sine
            height += moved
            speed += omega * (across * cosine - along * sine)
            pull += omega**2 * moved
        return rate, pull - stiff * height - loss * speed, 1.0

    return rates


def by_scipy(programs: ScipyPrograms, vector: Array, tip: Tip, crossings: int, tolerance: float) -> Tip:
    """Follow a tip from phase to phase, each ended by an event of `solve_ivp`.

    Args:
        programs: of motions like this one.
        vector: this motion's numbers (`ScipyPrograms.vector`).
        tip: at the beginning of a phase.
        crossings: how often it arrives at the sample or leaves it.
        tolerance: relative; the absolute one is a thousandth of it.

    Returns:
        The tip there; its rate and its arrival are NaN if a phase has no end, or the sample holds the tip.
    """
    for _ in range(_MOST_PHASES * crossings):
        if tip.crossings >= crossings:
            return tip
        phase = ContactPhase(int(tip.phase))
        down, up, step, longest = (float(limit) for limit in programs.limits(vector, phase))
        events: list[Any] = [lambda _, y, down=down: y[0] - down, lambda _, y, up=up: y[0] - up]
        for event, direction in zip(events, (-1.0, 1.0), strict=True):
            vars(event).update(terminal=True, direction=direction)
        rates: Any = lambda _, y, phase=phase: np.asarray(programs.touching(vector, phase, y))  # noqa: E731
        if phase == ContactPhase.DRY:
            rates = _rates_of_flight(*programs.flight(vector))
        # a trial step of a loose tolerance may go beyond all numbers; it is then rejected
        with np.errstate(all="ignore"):
            path = solve_ivp(
                rates,
                (0.0, longest),
                [float(tip.x), float(tip.rate), float(tip.time_us)],
                method="DOP853",
                rtol=tolerance,
                atol=1e-3 * tolerance,
                max_step=step,
                events=events,
            )
        if path.status != 1:
            break
        x, rate, now = map(np.asarray, path.y[:, -1])
        ended = tip._replace(x=x, rate=rate, time_us=now)
        tip = jax.tree.map(np.asarray, programs.after(vector, ended, len(path.t_events[1]) > 0))
        if not np.isfinite(tip.rate):
            break
    return tip._replace(rate=np.nan, arrived_us=np.nan)


_COARSEST_US = 1e-1
"""The loosest root tolerance of the search for an impact; the tightest is its default."""
_BY_ROOTS: dict[str, Any] = {
    "settings": {f"root tolerance {each:g} us": each for each in (_COARSEST_US, 1e-2, 1e-4, 1e-6, 1e-8, 1e-10, 1e-13)},
    "reference": "root tolerance 1e-15 us",
    "finest": (1e-15, 1e-14),
}
"""Settings and reference of impacts with a law."""
_IN_TIME: dict[str, Any] = {
    "settings": {f"accuracy {level:g}": setting for level, setting in DRIVEN_SETTINGS.items()},
    "reference": "every contact in time, in fine steps",
    "finest": (DrivenSetting(None, 12.0, 400), DrivenSetting(None, 9.0, 300)),
}
"""Those of contacts in time."""


def impact_times(tips: int) -> AccuracyProblem:
    """Return the time of the next impact, by the time and the velocity of departures around figure 2's (1,1) orbit."""
    scene = load_scene("figure2")
    orbits = jax.jit(single_impact_orbits)(scene, 1)
    stable = int(np.argmax(np.asarray(orbits.exists & orbits.admissible & orbits.stable)))
    first, second = evenly_spread(tips).T - 0.5
    starts = orbits.phase_rad[stable] / scene.platform.angular_frequency + 0.1 * first * scene.platform.period_us
    speeds = orbits.velocity_after_nm_per_us[stable] * (1.0 + 0.4 * second)

    def solve(tolerance: Any, parameters: Parameters) -> Values:
        def one(start: Array, speed: Array) -> Array:
            return iterate_map(scene, start, speed, 1, root_tolerance_us=tolerance).arrival_time_us[0]

        return jax.vmap(one)(starts + parameters[0], speeds + parameters[1])

    def begin(parameters: Parameters) -> tuple[EquationOfMotion, Tip]:
        now = starts + parameters[0]
        rate = speeds + parameters[1] - scene.platform.velocity(now)
        motion = EquationOfMotion(scene.cantilever, scene.platform, scene.interaction)
        return motion, tips_at(ContactPhase.DRY, jnp.zeros_like(rate), rate, now)

    return AccuracyProblem(
        what="time of the next impact (us)",
        at=jnp.zeros(2),
        solve=solve,
        begin=begin,
        **_BY_ROOTS,
    )


def tips_at(phase: ContactPhase, x: Any, rate: Any, now: Any) -> Tip:
    """Return tips at the beginning of a phase, as many as there are gap rates."""
    rate = jnp.asarray(rate)
    like = partial(jnp.broadcast_to, shape=rate.shape)
    start = like(jnp.asarray(now, rate.dtype))
    none = jnp.zeros(rate.shape, jnp.int32)
    return Tip(none + jnp.int32(phase), like(x), rate, start, start, none)


_SPEEDS_NM_PER_US = (12.0, 200.0)
_QUADRATURES = (Setting("collocation", 40, 40, 48, iterations=14), Setting("collocation", 32, 32, 40, iterations=12))
"""Converged to rounding (the tests compare it with 20 digits), and a coarser one that shows how far."""


def rebound_speeds(tips: int) -> AccuracyProblem:
    """Return the rebound speed of the paper's contact, by logarithms of approach speed and viscosity."""
    speeds = jnp.linspace(*_SPEEDS_NM_PER_US, tips)

    def contact_at(parameters: Parameters) -> Contact:
        return Contact.paper(viscosity_pa_s=PAPER["viscosity_pa_s"] * jnp.exp(parameters[1]))

    def solve(setting: Setting, parameters: Parameters) -> Values:
        found = batch_of(contact_at(parameters), 1.0, speeds * jnp.exp(parameters[0]), setting)
        return found.rebound_speed_nm_per_us

    def begin(parameters: Parameters) -> tuple[EquationOfMotion, Tip]:
        contact = contact_at(parameters)
        driven = free_tip(contact, find_junction(contact), jnp.ones(()))
        rate = -speeds * jnp.exp(parameters[0])
        return EquationOfMotion(driven=driven), tips_at(ContactPhase.BRIDGE, driven.forms_nm, rate, 0.0)

    return AccuracyProblem(
        what="rebound speed (relative)",
        relative=True,
        at=jnp.zeros(2),
        solve=solve,
        settings={
            f"{method}, accuracy {level:g}": setting
            for method, levels in SETTINGS.items()
            for level, setting in levels.items()
        },
        reference="a quadrature converged to rounding",
        finest=_QUADRATURES,
        begin=begin,
        read=attrgetter("rate"),
    )


def contact_arrivals(name: str, contacts: int) -> AccuracyProblem:
    """Return the arrival of one of the first contacts of a scene, by the velocity at the start.

    Raises:
        ValueError: if the tip is free, or has fewer contacts.
    """
    scene, begins, _ = read_scene(name)
    if scene.interaction is None:
        raise ValueError(f"{name}: the cantilever is free: its motion is a closed form and has no contacts to measure")
    start, world = start_of(scene, begins), surface_of(scene)
    surface = world[0]
    if isinstance(scene.interaction, Law):
        motion = EquationOfMotion(scene.cantilever, surface, scene.interaction)
        # the coarsest setting may be as late
        compared, beyond_us = _BY_ROOTS, 2.0 * _COARSEST_US
    else:
        driven = driven_by(scene.interaction, scene.cantilever, surface)
        motion = EquationOfMotion(scene.cantilever, surface, None, driven, scene.interaction.spans)
        compared, beyond_us = _IN_TIME, 1e-3
    left = times_of_contact(scene, contacts, start.time_us + _LONGEST_US * contacts, compared["finest"][0], start)[1]
    # no longer than until the last of them has left
    until = jnp.where(jnp.isfinite(left), left + beyond_us, start.time_us)

    def moved(parameters: Parameters) -> State:
        return start._replace(velocity_nm_per_us=start.velocity_nm_per_us + parameters[0])

    def solve(setting: Any, parameters: Parameters) -> Values:
        return times_of_contact(scene, contacts, until, setting, moved(parameters))[:1]

    def begin(parameters: Parameters) -> tuple[EquationOfMotion, Tip]:
        gap, rate = to_gap(*world, moved(parameters))
        # a start on the surface but for rounding lies on it
        gap = jnp.where(jnp.abs(gap) < 1e-9, 0.0, gap)
        return motion, tips_at(ContactPhase.DRY, gap[None], rate[None], start.time_us)

    problem = AccuracyProblem(
        what=f"arrival of contact {contacts} (us)",
        at=jnp.zeros(1),
        solve=solve,
        begin=begin,
        crossings=2 * contacts - 1,
        events=contacts,
        options=quick_options(),
        **compared,
    )
    if not np.isfinite(problem.exact[0]).all():
        raise ValueError(
            f"{name}: the tip has not as many as {contacts} contacts before it is held or flies on: lower "
            "`contacts=...`, or start elsewhere"
        )
    return problem


def times_of_contact(scene: Scene, number: int, until: Any, setting: Any, start: State) -> Float[Array, "2"]:
    """Return arrival and departure in us at one of the contacts of a tip; NaN if it has not left again by a time.

    Args:
        scene: with a law or a contact.
        number: of the contact, from 1.
        until: the time, in us.
        setting: of a law the root tolerance in us, of a contact how finely it is resolved.
        start: of the tip.
    """
    follow = partial(follow_law, tolerance=setting)
    if not isinstance(scene.interaction, Law):
        follow = partial(follow_contacts, setting=setting)
    found = follow(scene, *surface_of(scene), start, jnp.asarray(until), max_contacts=number).contacts
    times = jnp.stack([found.arrival_time_us[number - 1], found.departure_time_us[number - 1]])
    return jnp.where(found.kind[number - 1] == ContactKind.IMPACT, times, jnp.nan)
