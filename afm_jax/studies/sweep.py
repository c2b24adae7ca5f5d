"""Sweeps: one kind of result over a grid of parameters, in chunks that are kept, resumed where a run was broken off.

A chunk is a block of the grid; what is in it depends on the input and its number alone, whoever computes it. Results
lie in a Zarr store that xarray opens alone. Each chunk is written as a region of the arrays, and then marked in the
array `computed`: what is not marked is computed again. One sweep at a time may write into a folder.
"""

import errno
import itertools
import json
import math
import os
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from afm_jax.apparatus.scene import Scene, drive_of
from afm_jax.apparatus.surface import free_frame
from afm_jax.checks import check_count, checked, require_float64
from afm_jax.compilation_cache import available_cores, open_cache, silence_xla
from afm_jax.contact.collide import ONLY_FREE, collide
from afm_jax.contact.contact import Contact
from afm_jax.dynamics.charts import DRIVEN_NUMBERS, ORBIT_NUMBERS, highest_orbits
from afm_jax.dynamics.contact_orbits import CHART_ACCURACY, single_contact_orbits
from afm_jax.dynamics.exponents import lyapunov_spectrum
from afm_jax.dynamics.starts import sample_driven
from afm_jax.dynamics.verdicts import MotionKind
from afm_jax.impact.law import TabulatedLaw, axes_of_one, extrapolation_of, impact_law_of
from afm_jax.motion.follow import follow_long
from afm_jax.motion.observe import OBSERVABLES, TOO_SHORT, observe
from afm_jax.motion.record import MotionOutcome
from afm_jax.motion.simulate import DEFAULT_ACCURACY
from afm_jax.motion.start import start_of
from afm_jax.outcomes import CollisionOutcome
from afm_jax.results import unit_of
from afm_jax.scenefile.parameter_paths import (
    ParameterRange,
    check_ranges,
    parameter_values,
    parse_range,
    scene_batch,
    scene_family,
)
from afm_jax.scenefile.scenefile import Start, scene_of_tables, scene_tables
from afm_jax.solve.lanes import LANES, filled, in_blocks
from afm_jax.strict_json import strict_json
from afm_jax.version import __version__, version_of
from afm_jax.whole_files import check_plain, whole_folder

if TYPE_CHECKING:
    import xarray
    from distributed import Client

Columns = dict[str, Any]
"""Arrays of one row a point, by name."""
Region = tuple[slice, ...]
"""Of the grid: a slice for each axis."""
STORE = "sweep.zarr"
FORMAT_VERSION = 5

# --- axes -------------------------------------------------------------------------------------------------------------

KINDS = ("linear", "log", "list", "random")
_MOST = 10_000_000
"""Values of an axis."""
_EXAMPLE = '{ parameter = "platform.reduced_frequency", linear = [0.9, 1.1, 100] }'


class Axis(NamedTuple):
    """One axis of a sweep: its name in the results, and the values of every parameter that changes along it."""

    dimension: str
    columns: Mapping[str, np.ndarray]

    @property
    def size(self) -> int:
        """How many values it has."""
        return len(next(iter(self.columns.values())))


def axes_of(given: Sequence[Mapping[str, Any]]) -> tuple[Axis, ...]:
    """Return the axes that tables describe.

    >>> axes_of([{"parameter": "interaction.r", "linear": [0.5, 0.9, 5]}])[0].columns["interaction.r"].tolist()
    [0.5, 0.6, 0.7, 0.8, 0.9]

    Args:
        given: of each axis either `parameter` with `linear` or `log` (low, high, count) or `list` (values), or
            `random` (for each parameter its [low, high], or {log = [low, high]}) with `count` and `seed`.

    Raises:
        ValueError: if one is no such table, or a parameter changes along two of them.
    """
    if not given:
        raise ValueError(f"a sweep needs at least one axis; add [[axes]], as in {_EXAMPLE}")
    axes: list[Axis] = []
    for number, table in enumerate(given, 1):
        samples = sum(axis.dimension.startswith("sample") for axis in axes)
        try:
            axes.append(_axis(table, f"sample_{samples + 1}" if samples else "sample"))
        except (TypeError, ValueError) as error:
            raise ValueError(f"axis {number}: {error}") from error
    names = Counter(name for axis in axes for name in axis.columns)
    for name, times in names.items():
        if times > 1:
            raise ValueError(f"the parameter {name} changes along two axes: leave one of them out")
    return tuple(axes)


def dimension_of(parameter: str) -> str:
    """Return the name that a parameter has in the results."""
    return parameter.replace(".", "_")


def _axis(table: Mapping[str, Any], sample: str) -> Axis:
    kinds = [kind for kind in KINDS if kind in table]
    if len(kinds) != 1:
        raise ValueError(f"has {' and '.join(kinds) or 'no values'}; give one of {', '.join(KINDS)}, as in {_EXAMPLE}")
    kind = kinds[0]
    keys = (kind, "count", "seed") if kind == "random" else (kind, "parameter")
    for key in table:
        if key not in keys:
            raise ValueError(f"unknown key {key}; an axis of this kind has {', '.join(keys)}")
    values = table[kind]
    if kind == "random":
        if not isinstance(values, Mapping) or not values:
            raise ValueError('`random` must name parameters with their ends, as in { "interaction.r" = [0.9, 0.99] }')
        generator = np.random.default_rng(_whole(table.get("seed"), "seed", 0, 1 << 63))
        shares = generator.random((len(values), _whole(table.get("count"), "count", 1, _MOST)))
        pairs = zip(values.items(), shares, strict=True)
        return Axis(sample, {parameter: _drawn(parameter, ends, share) for (parameter, ends), share in pairs})
    parameter = str(table.get("parameter", ""))
    if not parameter:
        raise ValueError(f"`parameter` is missing; name one, as in {_EXAMPLE}")
    if kind == "list":
        column = _numbers(values, "`list`")
        if len(set(column)) < len(column):
            raise ValueError("a value of the list stands there twice: leave one of them out")
        return Axis(dimension_of(parameter), {parameter: np.array(column)})
    if not isinstance(values, list | tuple) or len(values) != 3:
        raise ValueError(f"`{kind}` must be [low, high, count], but is {values}")
    (low, high), count = _ends(values[:2], f"`{kind}`", log=kind == "log"), _whole(values[2], "count", 1, _MOST)
    spread = np.geomspace if kind == "log" else np.linspace
    return Axis(dimension_of(parameter), {parameter: spread(low, high, count)})


def _drawn(parameter: str, given: Any, share: np.ndarray) -> np.ndarray:
    """Return values at random shares of the way between two ends."""
    log = isinstance(given, Mapping) and list(given) == ["log"]
    low, high = _ends(given["log"] if log else given, parameter, log=log)
    return low * (high / low) ** share if log else low + share * (high - low)


def _ends(given: Any, what: str, *, log: bool) -> list[float]:
    ends = _numbers(given, what)
    if len(ends) != 2 or not ends[0] < ends[1] or (log and ends[0] <= 0.0):
        raise ValueError(f"{what}: {given} is no rising pair{' of positive numbers' if log else ''}")
    return ends


def _numbers(given: Any, what: str) -> list[float]:
    if not isinstance(given, list | tuple) or not 0 < len(given) <= _MOST:
        raise ValueError(f"{what} must be a list of numbers, at most {_MOST}, but is {given}")
    for value in given:
        # JSON, in which inputs are kept, has null for infinity
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise ValueError(f"{what} must hold numbers, but one is {'not finite' if value is None else repr(value)}")
    return [float(value) for value in given]


def _whole(value: Any, name: str, least: int, most: int) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most:
        raise ValueError(f"`{name}` must be a whole number from {least} to {most}, but is {value!r}")
    return value


# --- what is recorded of scenes ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Variable:
    """One of the things that a sweep records of every point.

    Attributes:
        name: with its unit.
        meaning: in words.
        dtype: of the numbers, or "string"; floats are NaN where there is nothing.
        dimensions: besides those of the axes.
        codes: of integers that stand for words, what each means.
    """

    name: str
    meaning: str
    dtype: str = "float64"
    dimensions: tuple[str, ...] = ()
    codes: Mapping[int, str] = field(default_factory=dict)

    def attributes(self) -> dict[str, Any]:
        """Return unit and meaning as attributes of the CF conventions."""
        units = {"units": _unit(self.name)} if self.dtype == "float64" else {}
        flags = {"flag_values": list(self.codes), "flag_meanings": " ".join(self.codes.values())} if self.codes else {}
        return {"long_name": self.meaning, **units, **flags}


MESSAGE = Variable("message", "why there is no result, or none to be trusted; empty where there is one", "string")
_MARK = Variable("computed", "this point has been computed", "bool")
EXTRAPOLATED = "extrapolated"
"""The variable of scenes with a law that is a table."""
APPROACH_SPEED = "approach_speed_nm_per_us"
"""The axis of `collide` that is no parameter of the scene."""


@dataclass(frozen=True)
class Recorder:
    """What a sweep does at its points.

    Attributes:
        variables: what it records, the most telling first.
        work: from columns of parameters to columns of results, one row a point.
        points: of a chunk, unless the input says otherwise: some tenths of a second of work at least.
        extra: values of dimensions besides the axes.
        alone: whether a point is computed by itself, on one core: several processes are needed to use several.
    """

    variables: tuple[Variable, ...]
    work: Callable[[Columns], Columns]
    points: int
    extra: Mapping[str, Sequence[float]] = field(default_factory=dict)
    alone: bool = False


def scene_recorder(given: Mapping[str, Any], axes: Sequence[Axis]) -> Recorder:
    """Return what a sweep over scenes does.

    Args:
        given: `scene` and perhaps `start`, tables as of a scene file; `record`, a table with `what` and its settings;
            perhaps `accuracy`.
        axes: of the sweep.

    Raises:
        ValueError: if the scene lacks a parameter, cannot be at an end of an axis, or has no such results.
    """
    scene = scene_of_tables(given["scene"], "the sweep's scene")
    record = dict(given["record"])
    what = record.pop("what", None)
    if what not in _RECORDERS:
        raise ValueError(f"[record]: `what` must be one of {', '.join(_RECORDERS)}, but is {what!r}")
    columns = {name: values for axis in axes for name, values in axis.columns.items()}
    if what == "collide":
        columns.pop(APPROACH_SPEED, None)
    check_ranges(scene, *(ParameterRange(path, values.min(), values.max()) for path, values in columns.items()))
    builder, usual = _RECORDERS[what]
    for key in record:
        if key not in usual:
            raise ValueError(f"[record]: unknown key {key} of {what!r}; it has {', '.join(usual)}")
    chosen = {key: _setting(key, record.get(key, value), value) for key, value in usual.items()}
    accuracy = given.get("accuracy")
    if accuracy is not None:
        if not isinstance(scene.interaction, Contact):
            raise ValueError("`accuracy` is about resolved contacts, and this scene has none: leave `accuracy` out")
        if not (isinstance(accuracy, float) and 0.0 < accuracy < 1.0):
            raise ValueError(f"`accuracy` must be a number between 0 and 1, but is {accuracy!r}")
        chosen["accuracy"] = accuracy
    if given.get("start"):
        if what != "simulation":
            raise ValueError(f"a start is of use for simulations alone: leave it out for {what!r}")
        chosen["start"] = Start(**given["start"])
    return builder(scene, tuple(columns), **chosen)


def _setting(key: str, value: Any, usual: Any) -> Any:
    """Return a setting of the kind of its usual value: a number, a whole one, or several different whole ones."""
    several = isinstance(usual, tuple)
    numbers: list[Any] = list(value) if several and isinstance(value, list | tuple) else [value]
    kinds = (int, float) if isinstance(usual, float) else (int,)
    if not numbers or not all(type(each) in kinds and 0 < each < math.inf for each in numbers):
        kind = "list of positive whole numbers" if several else f"positive {'whole ' * (len(kinds) == 1)}number"
        raise ValueError(f"[record]: `{key}` must be a {kind}, but is {value!r}")
    if len(set(numbers)) < len(numbers):
        raise ValueError(f"[record]: `{key}` must be different numbers, but is {value!r}")
    return tuple(numbers) if several else type(usual)(numbers[0])


def _scenes(scene: Scene, paths: Sequence[str]) -> Callable[[Columns], Scene]:
    """Return the function from columns of parameters to a batch of scenes, every number of one value a row."""
    family = scene_family(scene, *paths)

    def made(columns: Columns) -> Scene:
        count = len(next(iter(columns.values())))
        batch = jax.vmap(family)(*(columns[path] for path in paths)) if paths else scene
        return jax.tree.map(
            lambda leaf, axes: jnp.broadcast_to(leaf, (count, *leaf.shape)) if leaf.ndim == axes else leaf,
            batch,
            axes_of_one(scene),
        )

    return made


def _in_batches(record: Callable[[Columns], Columns]) -> Callable[[Columns], Columns]:
    """Return a function of columns of any length, block by block on all cores; blocks of one shape, so one program."""
    # what a processor's cache holds, or what fills an accelerator
    block = 1024 if jax.default_backend() == "cpu" else 1 << 16
    program = jax.jit(record)
    return lambda columns: in_blocks(program, columns, block=block, widths=(block,))


def _one_by_one(record: Callable[[dict[str, float]], dict[str, Any]]) -> Callable[[Columns], Columns]:
    """Return a function of columns from one of a point, whose neighbours would tell in last digits."""

    def work(columns: Columns) -> Columns:
        rows = [record(dict(zip(columns, row, strict=True))) for row in zip(*columns.values(), strict=True)]
        return {name: [row[name] for row in rows] for name in rows[0]}

    return work


def _beyond(scene: Scene, what: str, dimensions: tuple[str, ...] = ()) -> tuple[Variable, ...]:
    """Return the variable that says whether a law that is a table is extrapolated; none of other scenes."""
    law = scene.interaction
    if not isinstance(law, TabulatedLaw):
        return ()
    low, high = float(law.slowest_nm_per_us), float(law.fastest_nm_per_us)
    meaning = f"{what} outside the speeds that the law is known for, {low:.4g} to {high:.4g} nm/us"
    return (Variable(EXTRAPOLATED, meaning, "bool", dimensions),)


def _variables(*dimensions: str, dtype: str = "float64", **meanings: str) -> tuple[Variable, ...]:
    """Return variables of one kind, from names and meanings."""
    return tuple(Variable(name, meaning, dtype, dimensions) for name, meaning in meanings.items())


_PEAK = _variables("order", peak_amplitude_nm="largest height above the rest position")
_MULTIPLIER = _variables("order", largest_multiplier="size of the larger multiplier of the map")
_ORBIT_VARIABLES = (
    *_PEAK,
    *_variables(
        "order",
        dtype="int8",
        stable_orbits="number of admissible stable single-impact orbits",
        admissible_orbits="number of admissible single-impact orbits",
    ),
    *_variables(
        "order",
        lockin_amplitude_nm="amplitude at the response frequency omega/N",
        lockin_phase_deg="its phase, modulo 360/N",
        approach_speed_nm_per_us="speed towards the platform before the impact",
        phase_rad="drive phase just after the impact",
        velocity_after_nm_per_us="velocity in the lab just after the impact",
    ),
    *_MULTIPLIER,
)
_DRIVEN_ORBIT_VARIABLES = _variables(
    "order",
    drive_lockin_amplitude_nm="amplitude at the drive's frequency omega",
    drive_lockin_phase_deg="its phase",
    phase_lag_deg="lag of deflection or height behind base or force at omega",
)
"""What is recorded besides of orbits that base or force drives."""
_CONTACT_ORBIT_VARIABLES = (
    *_PEAK,
    *_variables(
        "order",
        dtype="bool",
        stable="an admissible single-impact orbit is stable",
        admissible="there is an admissible single-impact orbit",
        unresolved="the law closest to the contact has an orbit, but none was found",
    ),
    *_MULTIPLIER,
)


def _orbits(
    scene: Scene, paths: tuple[str, ...], *, orders: tuple[int, ...], accuracy: float = CHART_ACCURACY
) -> Recorder:
    """Record the stable single-impact orbits of scenes; of several of one order the highest."""
    sample_driven(scene)
    for path in paths:
        if path.endswith("offset_rate_nm_per_us"):
            raise ValueError(f"under a ramp no orbit repeats: {path} cannot be an axis of 'orbits'")
        if "frequency" in path:
            # a little aside: says why not, where another part has the same frequency
            sample_driven(scene_batch(scene, {path: np.array([1.001 * parameter_values(scene)[path]])}))
    extra = {"order": [float(order) for order in orders]}
    if isinstance(scene.interaction, Contact):
        record = partial(_contact_orbits, scene, orders, accuracy)
        return Recorder((*_CONTACT_ORBIT_VARIABLES, MESSAGE), _one_by_one(record), 16, extra, alone=True)
    law, made = impact_law_of(scene), _scenes(scene, paths)
    beyond = _beyond(scene, "the stable orbit's impact comes", ("order",))

    def record_batch(columns: Columns) -> Columns:
        scenes = made(columns)
        found = highest_orbits(scenes, free_frame(scenes), jnp.asarray(orders, float), names=names)
        outside = jax.vmap(lambda law, speed: law.extrapolated(speed)) if beyond else None
        return found | ({} if outside is None else {EXTRAPOLATED: outside(scenes.interaction, found[APPROACH_SPEED])})

    driven = () if scene.base is None and scene.force is None else _DRIVEN_ORBIT_VARIABLES
    names = ORBIT_NUMBERS + (DRIVEN_NUMBERS if driven else ())
    points = 4096 if law.delay else 1 << 18
    return Recorder((*_ORBIT_VARIABLES, *driven, *beyond), _in_batches(record_batch), points, extra)


def _contact_orbits(scene: Scene, orders: tuple[int, ...], accuracy: float, row: dict[str, float]) -> dict[str, Any]:
    """Return what is recorded of the single-impact orbits of one resolved contact."""
    try:
        one = scene_batch(scene, {name: np.array([value]) for name, value in row.items()})
        found = single_contact_orbits(one, orders, accuracy=accuracy)
    except ValueError as error:
        blank = {"float64": math.nan, "bool": False}
        nothing = {each.name: np.full(len(orders), blank[each.dtype]) for each in _CONTACT_ORBIT_VARIABLES}
        return nothing | {MESSAGE.name: str(error)}
    return {each.name: found[each.name][:, 0] for each in _CONTACT_ORBIT_VARIABLES} | {MESSAGE.name: ""}


def _codes(kinds: Any) -> dict[int, str]:
    return {int(kind): kind.name.lower() for kind in kinds}


_COLLISION_VARIABLES = (
    *_variables(
        rebound_speed_nm_per_us="speed away from the sample; 0 where the tip is captured",
        collision_delay_us="time between the crossings of gap 0 by the straight paths in and out, if it leaves",
        time_in_contact_us="from the formation of the bridge to its breaking",
        time_in_junction_us="with the solids joined",
        deepest_gap_nm="smallest gap",
        bridge_hysteresis_aj="energy that the bridge takes",
        junction_hysteresis_aj="energy lost in the junction",
        viscous_loss_aj="energy lost to viscosity",
    ),
    Variable("captured", "the tip stays at the sample", "bool"),
    Variable("outcome", "how the collision ended", "int8", codes=_codes(CollisionOutcome)),
)


def _collisions(
    scene: Scene, paths: tuple[str, ...], *, approach_speed_nm_per_us: float, accuracy: float = 1e-9
) -> Recorder:
    """Record collisions of free tips with the contacts of scenes."""
    if not isinstance(scene.interaction, Contact):
        raise TypeError("'collide' is about a resolved contact: the scene needs model = \"contact\"")
    made = _scenes(scene, paths)

    def record(columns: Columns) -> Columns:
        count = len(next(iter(columns.values())))
        speeds = jnp.broadcast_to(columns.get(APPROACH_SPEED, approach_speed_nm_per_us), (count,))
        scenes = made(columns)
        found = collide(scenes.interaction, speeds, scenes.cantilever.mass_ng, accuracy=accuracy)
        trusted = found.outcome <= CollisionOutcome.CAPTURED_BY_JUNCTION
        results = {variable.name: getattr(found, variable.name) for variable in _COLLISION_VARIABLES}
        for each in _COLLISION_VARIABLES:
            if each.dtype == "float64":
                free = ~found.captured if each.name in ONLY_FREE else True
                exists = trusted & (free | (each.name == "rebound_speed_nm_per_us"))
                results[each.name] = jnp.where(exists, results[each.name], jnp.nan)
        return results

    return Recorder(_COLLISION_VARIABLES, _in_batches(record), 16384)


_EXPONENT_VARIABLES = (
    *_variables(
        "exponent",
        exponents_per_impact="Lyapunov exponents, larger first",
        exponents_per_us="the same in time",
        exponents_per_impact_error="their standard errors",
        exponents_per_us_error="their standard errors",
    ),
    Variable("impacts", "how many the means are over", "int64"),
    Variable("kind", "what the motion has come to", "int8", codes=_codes(MotionKind)),
    Variable("orbit_impacts", "impacts of the orbit, 0 where there is none", "int32"),
    Variable("orbit_periods", "drive periods of the orbit, 0 where there is none", "int32"),
)


def _lyapunov(
    scene: Scene, paths: tuple[str, ...], *, impacts: int, transient: int, accuracy: float = DEFAULT_ACCURACY
) -> Recorder:
    """Record the exponents of motions that begin as in `bouncing_tips`."""
    sample_driven(scene)
    resolved = isinstance(scene.interaction, Contact)
    lanes = 16 if resolved else LANES
    made, beyond = jax.jit(_scenes(scene, paths)), _beyond(scene, "the last impacts come")

    def work(columns: Columns) -> Columns:
        count = len(next(iter(columns.values())))
        # always whole blocks of lanes, so that there is one shape of every program
        width = lanes * -(-count // lanes)
        whole = {name: jnp.asarray(filled(column, width)) for name, column in columns.items()}
        found = lyapunov_spectrum(made(whole), impacts=impacts, transient=transient, accuracy=accuracy)
        verdicts = found.verdicts
        results = {each.name: getattr(found, each.name) for each in _EXPONENT_VARIABLES[:5]}
        results |= {"kind": verdicts.kind, "orbit_impacts": verdicts.impacts, "orbit_periods": verdicts.periods}
        if beyond:
            outside = scene.interaction.extrapolated(found.approach_speed_nm_per_us)
            results[EXTRAPOLATED] = np.asarray(outside).any(axis=1)
        return {name: np.asarray(part)[:count] for name, part in results.items()}

    points = lanes if resolved else 4 * lanes
    return Recorder((*_EXPONENT_VARIABLES, *beyond), work, points, {"exponent": [1.0, 2.0]}, alone=resolved)


_REFUSED = -1
_SIMULATION_VARIABLES = (
    *_variables(**{observable.name: observable.meaning for observable in OBSERVABLES}),
    Variable("settled", "the motion repeats", "bool"),
    Variable("stuck", "the sample holds the tip", "bool"),
    Variable("order", "drive periods of a repetition, 0 where nothing repeats", "int32"),
    Variable("contacts_per_response", "contacts of a repetition, 0 where nothing repeats", "int32"),
    Variable("impacts", "contacts in all", "int64"),
    Variable("outcome", "how it ended", "int8", codes={_REFUSED: "not_possible"} | _codes(MotionOutcome)),
)


def _simulation(
    scene: Scene, paths: tuple[str, ...], *, periods: float, accuracy: float = 1e-9, start: Start | None = None
) -> Recorder:
    """Record what an experiment reads of scenes in time, followed until they settle or for some drive periods."""
    family = scene_family(scene, *paths)
    variables = (*_SIMULATION_VARIABLES, *_beyond(scene, "impacts come"), MESSAGE)
    empty = {"float64": math.nan, "bool": False, "string": ""}
    nothing = {each.name: empty.get(each.dtype, 0) for each in variables}

    def record(row: dict[str, float]) -> dict[str, Any]:
        one = family(*row.values())
        try:
            longest = periods * drive_of(one).period_us
            run = follow_long(one, start_of(one, start), longest, until_settled=True, accuracy=accuracy)
        except ValueError as error:
            return nothing | {"outcome": _REFUSED, MESSAGE.name: str(error)}
        found, verdict = run.simulation, run.verdict
        outcome = MotionOutcome(int(found.outcome))
        results = nothing | {
            "settled": verdict.settled,
            "stuck": verdict.stuck,
            "order": verdict.periods or 0,
            "contacts_per_response": verdict.contacts or 0,
            "impacts": int(found.count),
            "outcome": int(outcome),
        }
        if EXTRAPOLATED in nothing:
            speeds = found.contacts.approach_speed_nm_per_us
            results[EXTRAPOLATED] = extrapolation_of(one.interaction, speeds) is not None
        if outcome not in (MotionOutcome.FINISHED, MotionOutcome.HELD):
            return results | {MESSAGE.name: outcome.sentence}
        seen = observe(one, found, verdict=verdict)
        values = {each.name: getattr(seen, each.name) for each in OBSERVABLES}
        told = {} if seen.window.responses else {MESSAGE.name: TOO_SHORT}
        return results | {name: value for name, value in values.items() if value is not None} | told

    return Recorder(variables, _one_by_one(record), 16, alone=True)


_RECORDERS: dict[str, tuple[Callable[..., Recorder], dict[str, Any]]] = {
    "orbits": (_orbits, {"orders": (1,)}),
    "collide": (_collisions, {APPROACH_SPEED: 30.0}),
    "lyapunov": (_lyapunov, {"impacts": 2000, "transient": 500}),
    "simulation": (_simulation, {"periods": 2000.0}),
}
"""What can be recorded of scenes, each with its settings and their usual values."""

# --- plan, store, run -------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SweepPlan:
    """A sweep that can be computed.

    Attributes:
        given: the whole input, as JSON has it: scene, start, axes, record, accuracy, `chunk` (points of one), versions.
        axes: of the grid; the last one varies fastest.
        recorder: what is done at its points.
    """

    given: dict[str, Any]
    axes: tuple[Axis, ...]
    recorder: Recorder

    @property
    def shape(self) -> tuple[int, ...]:
        """Sizes of the axes."""
        return tuple(axis.size for axis in self.axes)

    @property
    def block(self) -> tuple[int, ...]:
        """Shape of a chunk; those at the ends of the axes may be smaller."""
        left, sizes = self.given["chunk"], []
        for size in reversed(self.shape):
            sizes.append(min(size, left))
            left = max(left // sizes[-1], 1)
        return tuple(reversed(sizes))

    def regions(self) -> list[Region]:
        """Return which part of the results each chunk is."""
        sides = zip(self.shape, self.block, strict=True)
        parts = [[slice(at, min(at + part, size)) for at in range(0, size, part)] for size, part in sides]
        return list(itertools.product(*parts))

    def compute(self, region: Region) -> Columns:
        """Return the results of a chunk, arrays of its shape with the recorder's own dimensions behind."""
        names = [name for axis in self.axes for name in axis.columns]
        places = np.meshgrid(*(np.arange(part.start, part.stop) for part in region), indexing="ij")
        values = [
            column[place.ravel()]
            for axis, place in zip(self.axes, places, strict=True)
            for column in axis.columns.values()
        ]
        # a worker has JAX's usual precision, whatever its caller has said
        with jax.enable_x64(True):  # noqa: FBT003
            found = self.recorder.work(dict(zip(names, values, strict=True)))
        return {
            each.name: np.asarray(found[each.name], object if each.dtype == "string" else each.dtype).reshape(
                (*places[0].shape, *(len(self.recorder.extra[name]) for name in each.dimensions))
            )
            for each in self.recorder.variables
        }


def plan_of(
    given: Mapping[str, Any], recorder_of: Callable[[Mapping[str, Any], Sequence[Axis]], Recorder] = scene_recorder
) -> SweepPlan:
    """Return the plan of an input, complete but for the versions, which are this process's.

    Args:
        given: `scene`, `axes` and `record`, and perhaps `start`, `accuracy` and `chunk`, as `SweepPlan` has them.
        recorder_of: makes what is done at the points.

    Raises:
        ValueError: if it is none.
    """
    packages = ("afm-jax", "jax", "jaxlib", "numpy", "scipy")
    versions = {package: version_of(package) for package in packages} | {"device": jax.default_backend()}
    whole = json.loads(strict_json({**given, "versions": versions}))
    axes = axes_of(whole.get("axes", ()))
    recorder = recorder_of(whole, axes)
    taken = [*recorder.extra, *(variable.name for variable in recorder.variables)]
    for axis in axes:
        if axis.dimension in taken or any(dimension_of(name) in taken for name in axis.columns):
            raise ValueError(f"the axis {axis.dimension} has the name of something that is recorded")
    chunk = whole.get("chunk")
    plan = SweepPlan(
        whole | {"chunk": recorder.points if chunk is None else _whole(chunk, "chunk", 1, _MOST)}, axes, recorder
    )
    if math.prod(plan.shape) > _MOST_CHUNKS * math.prod(plan.block):
        raise ValueError("that makes too many chunks: `chunk` must be larger, or take fewer values along the axes")
    return plan


_MOST_CHUNKS = 1_000_000


def _unit(name: str) -> str:
    """Return the unit that a name says; "1" for a number."""
    named = {"epsilon": "nm2/us2", "viscous_loss": "nm/us", "hertz": "us (nm/us)^(1/5)"}
    plain = name.rpartition(".")[2].removesuffix("_error")
    return named.get(plain) or unit_of(plain).replace("^", "") or "1"


def _open(folder: Path, plan: SweepPlan) -> Any:
    """Return the Zarr group of a sweep in a folder, made if there is none.

    Raises:
        ValueError: if there is one of another sweep; says what differs.
        OSError: if there is a link, a device or a pipe in it; names it.
    """
    import zarr  # noqa: PLC0415 (an extra package)

    store = folder / STORE
    for place in (*folder.glob(f".{STORE}.*part"), store, *store.rglob("*")):
        check_plain(place)
        # as Zarr names what a killed process left unfinished
        if place.suffix == ".partial":
            place.unlink()
    if (store / "zarr.json").exists():
        _check_same(folder, plan)
    else:
        with whole_folder(store) as fresh:
            _make(zarr.open_group(str(fresh), mode="w", zarr_format=3), plan)
            with warnings.catch_warnings():
                # that xarray opens the store by one file is worth a part of the format that is not settled yet
                warnings.simplefilter("ignore")
                zarr.consolidate_metadata(str(fresh))
    return zarr.open_group(str(store), mode="r+", zarr_format=3)


def _make(group: Any, plan: SweepPlan) -> None:
    """Make coordinates, and arrays of what is recorded."""
    about = {"format": "afm-jax sweep", "format_version": FORMAT_VERSION, "afm_jax": __version__}
    group.attrs.update({**about, "input": json.dumps(plan.given)})
    others = []
    for axis in plan.axes:
        for parameter, values in axis.columns.items():
            name, attributes = dimension_of(parameter), {"parameter": parameter, "units": _unit(parameter)}
            group.create_array(name, data=values, dimension_names=[axis.dimension], attributes=attributes)
            others += [name] if name != axis.dimension else []
    for name, values in plan.recorder.extra.items():
        group.create_array(name, data=np.asarray(values), dimension_names=[name])
    for each in (*plan.recorder.variables, _MARK):
        further = tuple(len(plan.recorder.extra[name]) for name in each.dimensions)
        group.create_array(
            each.name,
            shape=plan.shape + further,
            chunks=plan.block + further,
            dtype=each.dtype,
            fill_value={"float64": math.nan, "string": ""}.get(each.dtype, 0),
            dimension_names=[*(axis.dimension for axis in plan.axes), *each.dimensions],
            attributes=each.attributes() | {"coordinates": " ".join(others)},
        )


def _check_same(folder: Path, plan: SweepPlan) -> None:
    try:
        attributes = json.loads((folder / STORE / "zarr.json").read_bytes())["attributes"]
        kept, version = json.loads(attributes["input"]), attributes["format_version"]
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{folder / STORE}: is not a sweep of afm-jax; choose another folder") from error
    if version != FORMAT_VERSION:
        raise ValueError(f"{folder / STORE}: has format_version {version}, not {FORMAT_VERSION}; choose another folder")
    for name, wanted in plan.given.items():
        if kept.get(name) != wanted:
            difference = f"{name} is {json.dumps(kept.get(name))}, not {json.dumps(wanted)}"
            raise ValueError(
                f"{folder}: holds another sweep, in which {difference}: choose another folder, or restore the input"
            )


class SweepRun(NamedTuple):
    """What a run over a sweep did: chunks kept from before and those computed now, and its seconds."""

    kept: int
    computed: int
    seconds: float


Progress = Callable[[int, int], object]
"""Called with how many of how many points are done."""


def run_plan(
    plan: SweepPlan,
    folder: Path,
    *,
    workers: int = 1,
    scheduler: str | None = None,
    report: Progress | None = None,
) -> SweepRun:
    """Compute what a folder does not hold yet of a sweep; arguments and errors as of `sweep`."""
    begin, regions, done = time.monotonic(), plan.regions(), 0
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError) as error:
        what = "is no folder, or lies in none; choose another `out`"
        raise NotADirectoryError(errno.ENOTDIR, what, str(folder)) from error
    group = _open(folder, plan)
    marks = group[_MARK.name][...]
    missing = [region for region in regions if not marks[region].all()]
    kept = len(regions) - len(missing)
    try:
        for region, results in _results(plan, missing, workers=workers, scheduler=scheduler):
            for name, values in results.items():
                group[name][(*region, ...)] = values
            group[_MARK.name][region] = True
            done += 1
            if report is not None:
                report(round((kept + done) * marks.size / len(regions)), marks.size)
    except OSError as error:
        what = f"{error.strerror or error}: {kept + done} of {len(regions)} chunks are kept; mend that"
        raise OSError(error.errno, f"{what}, and give the same command again", str(folder)) from error
    return SweepRun(kept, done, time.monotonic() - begin)


def _results(
    plan: SweepPlan, regions: Sequence[Region], *, workers: int, scheduler: str | None
) -> Iterator[tuple[Region, Columns]]:
    """Give chunks with their results: in this process, or as workers have done them, two under way for each."""
    if not regions or (workers <= 1 and scheduler is None):
        yield from ((region, plan.compute(region)) for region in regions)
        return
    from distributed import as_completed  # noqa: PLC0415 (an extra package)

    with _client(min(workers, len(regions)), scheduler) as client:
        work, waiting = partial(compute_chunk, json.dumps(plan.given)), iter(regions)
        threads: Any = client.ncores()
        first = itertools.islice(waiting, 2 * sum(threads.values()))
        under_way = as_completed(client.map(work, list(first), pure=False))
        for future in under_way:
            yield future.result()
            under_way.update(client.map(work, list(itertools.islice(waiting, 1)), pure=False))


def compute_chunk(text: str, region: Region) -> tuple[Region, Columns]:
    """Return a chunk with its results, for a process that knows nothing but the input.

    Args:
        text: `SweepPlan.given` as JSON.
        region: of the chunk.

    Raises:
        RuntimeError: if this process would compute otherwise than the one that asks.
    """
    return region, _plan_of_worker(text).compute(region)


@lru_cache(maxsize=4)
def _plan_of_worker(text: str) -> SweepPlan:
    silence_xla()
    open_cache()
    given = json.loads(text)
    with jax.enable_x64(True):  # noqa: FBT003
        plan = plan_of(given)
    for name, version in given["versions"].items():
        if plan.given["versions"][name] != version:
            difference = f"{name} is {plan.given['versions'][name]}, not {version}"
            raise RuntimeError(f"a worker would compute otherwise than the others: {difference}")
    return plan


@contextmanager
def _client(workers: int, scheduler: str | None) -> "Iterator[Client]":
    """Give a client of a Dask scheduler, or of a cluster of local processes that share this machine's cores."""
    from distributed import Client, LocalCluster  # noqa: PLC0415

    with ExitStack() as stack:
        if scheduler is None:
            # workers import what their caller's program imports before they can be told anything
            silence_xla()
            scratch = stack.enter_context(tempfile.TemporaryDirectory())
            # of XLA's threads: its flags do not reach them
            cores = {"NPROC": str(max(available_cores() // workers, 1))}
            settings: dict[str, Any] = {"threads_per_worker": 1, "memory_limit": None, "dashboard_address": None}
            cluster = LocalCluster(n_workers=workers, env=cores, local_directory=scratch, **settings)
            yield stack.enter_context(Client(stack.enter_context(cluster)))
            return
        try:
            client = stack.enter_context(Client(scheduler, timeout=30))
            client.wait_for_workers(1, timeout=600)
        except (OSError, TimeoutError, ValueError) as error:
            raise ValueError(f"{scheduler}: no Dask scheduler with workers answers there ({error})") from error
        yield client


def _axis_table(axis: str | Mapping[str, Any]) -> dict[str, Any]:
    """Return an axis of a grid as its table in a sweep file."""
    if not isinstance(axis, str):
        return dict(axis)
    along = parse_range(axis, counted=True)
    return {"parameter": along.path, "linear": [along.low, along.high, along.number]}


@checked
def sweep(  # noqa: PLR0913
    scene: Scene,
    axes: Sequence[str | Mapping[str, Any]],
    record: str | Mapping[str, Any],
    *,
    out: str | os.PathLike[str] | None = None,
    accuracy: float | None = None,
    start: Start | None = None,
    chunk: int | None = None,
    workers: int = 1,
    scheduler: str | None = None,
    report: Progress | None = None,
) -> "xarray.Dataset":
    """Return what is recorded of a scene over a grid of its parameters.

    Args:
        scene: one scene.
        axes: of the grid, "interaction.r=0.5:0.9:100" as in commands, or tables as in a sweep file: {"parameter":
            "interaction.r", "linear": [0.5, 0.9, 100]}, "log" likewise, "list" with values; or {"random":
            {"interaction.r": [0.5, 0.9]}, "count": 100, "seed": 1}. Parameters are paths of the scene file.
        record: "orbits", "collide", "lyapunov" or "simulation", or a table with that as `what` and settings.
        out: folder of the results: chunks that are done there are kept; None: nothing is kept on the disk. What two
            sweeps write into one folder at the same time is undefined.
        accuracy: of resolved contacts.
        start: of simulations; None: `default_start` of each.
        chunk: points that are computed, kept and handed out together; None: as suits what is recorded.
        workers: processes; above 1 a local Dask cluster is started, which needs the extra `sweep`, and a script that
            calls this below `if __name__ == "__main__":`.
        scheduler: address of a Dask scheduler whose workers do the work, "tcp://...".
        report: called with how many of how many points are done.

    Returns:
        The results with a coordinate for every parameter, units, and the whole input as attributes; from a folder they
        are read when they are used.

    Raises:
        ModuleNotFoundError: if xarray or Zarr, or for several workers Dask, is not installed (extra `sweep`).
        OSError: if the disk is full; what is done is kept.
        RuntimeError: if JAX is not set to 64-bit floats.
        ValueError: if the input is impossible, or the folder holds another sweep.
    """
    import xarray  # noqa: PLC0415 (an extra package)

    require_float64(scene)
    check_count("workers", workers)
    table = {"what": record} if isinstance(record, str) else dict(record)
    given = {"scene": scene_tables(scene), "axes": list(map(_axis_table, axes)), "record": table}
    begin = None if start is None else start._asdict()
    plan = plan_of(given | {"start": begin, "accuracy": accuracy, "chunk": chunk})
    with ExitStack() as stack:
        folder = Path(out if out is not None else stack.enter_context(tempfile.TemporaryDirectory()))
        run_plan(plan, folder, workers=workers, scheduler=scheduler, report=report)
        found = xarray.open_zarr(str(folder / STORE))
        return found if out is not None else found.load()
