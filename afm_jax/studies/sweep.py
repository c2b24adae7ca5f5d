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
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from afm_jax.apparatus.scene import Scene, SceneLike, as_scene, drive_of
from afm_jax.apparatus.surface import free_frame
from afm_jax.checks import check_count, checked, require_float64
from afm_jax.compilation_cache import available_cores, open_cache, silence_xla
from afm_jax.contact.collide import ONLY_FREE, collide
from afm_jax.contact.contact import Contact
from afm_jax.dynamics.charts import highest_orbits
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
from afm_jax.results import Result, unit_of
from afm_jax.scenefile.parameter_paths import ParameterRange, check_ranges, scene_batch, scene_family
from afm_jax.scenefile.scenefile import Start, scene_of_tables, scene_tables
from afm_jax.solve.lanes import LANES, filled, in_blocks
from afm_jax.strict_json import strict_json
from afm_jax.version import __version__, version_of
from afm_jax.whole_files import check_plain, whole_folder
from afm_jax.words import counted

if TYPE_CHECKING:
    import xarray
    from distributed import Client

Columns = dict[str, Any]
"""Arrays of one row a point, by name."""
STORE = "sweep.zarr"
FORMAT_VERSION = 5
_COMPUTED = "computed"

# --- axes -------------------------------------------------------------------------------------------------------------

KINDS = ("linear", "log", "list", "random")
_MOST_HELD = 10_000_000
"""Values of an axis."""
_MOST_CHUNKS = 1_000_000
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
    for number, table in enumerate(given):
        samples = sum("random" in each for each in given[:number])
        try:
            axes.append(_axis(dict(table), f"sample_{samples + 1}" if samples else "sample"))
        except (TypeError, ValueError) as error:
            raise ValueError(f"axis {number + 1}: {error}") from error
    names = [name for axis in axes for name in axis.columns]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ValueError(f"the parameter {twice[0]} changes along two axes: leave one of them out")
    return tuple(axes)


def dimension_of(parameter: str) -> str:
    """Return the name that a parameter has in the results."""
    return parameter.replace(".", "_")


def _axis(table: dict[str, Any], sample: str) -> Axis:
    kinds = [kind for kind in KINDS if kind in table]
    if len(kinds) != 1:
        raise ValueError(f"has {' and '.join(kinds) or 'no values'}; give one of {', '.join(KINDS)}, as in {_EXAMPLE}")
    kind = kinds[0]
    known = (kind, "count", "seed") if kind == "random" else (kind, "parameter")
    unknown = sorted(set(table) - set(known))
    if unknown:
        raise ValueError(f"unknown key {unknown[0]}; an axis of this kind has {', '.join(known)}")
    if kind == "random":
        return Axis(sample, _random(table))
    parameter = str(table.get("parameter", ""))
    if not parameter:
        raise ValueError(f"`parameter` is missing; name one, as in {_EXAMPLE}")
    values = _listed(table["list"]) if kind == "list" else _ladder(kind, table[kind])
    return Axis(dimension_of(parameter), {parameter: values})


def _listed(given: Any) -> np.ndarray:
    if not isinstance(given, list | tuple):
        raise TypeError(f"`list` must be [value, ...], but is {given}")
    numbers = [_number(value, "a value of the list") for value in given]
    if not 0 < len(numbers) <= _MOST_HELD:
        raise ValueError(f"a list needs from 1 to {_MOST_HELD} values, but has {len(numbers)}")
    if len(set(numbers)) < len(numbers):
        raise ValueError("a value of the list stands there twice: leave one of them out")
    return np.array(numbers)


def _ladder(kind: str, given: Any) -> np.ndarray:
    if not isinstance(given, list | tuple) or len(given) != 3:
        raise ValueError(f"`{kind}` must be [low, high, count], but is {given}")
    low, high = (_number(end, f"an end of `{kind}`") for end in given[:2])
    count = _whole(given[2], "count", least=1, most=_MOST_HELD)
    if not (low < high or (low == high and count == 1)):
        raise ValueError(f"`{kind}` = {list(given)} does not rise: its first end must be below its second")
    if kind == "log" and low <= 0.0:
        raise ValueError(f"the ends of `log` must be positive, but one is {low:g}")
    return np.geomspace(low, high, count) if kind == "log" else np.linspace(low, high, count)


def _random(table: dict[str, Any]) -> dict[str, np.ndarray]:
    chosen = table["random"]
    if not isinstance(chosen, Mapping) or not chosen:
        raise ValueError('`random` must name parameters with their ends, as in { "interaction.r" = [0.9, 0.99] }')
    count = _whole(table.get("count"), "count", least=1, most=_MOST_HELD)
    generator = np.random.default_rng(_whole(table.get("seed"), "seed", least=0, most=1 << 63))
    columns = {}
    for parameter, given in chosen.items():
        log = isinstance(given, Mapping) and list(given) == ["log"]
        ends = given["log"] if log else given
        if not isinstance(ends, list | tuple) or len(ends) != 2:
            raise ValueError(f"{parameter}: must be [low, high] or {{ log = [low, high] }}, but is {given}")
        low, high = (_number(end, f"an end of {parameter}") for end in ends)
        if not low < high or (log and low <= 0.0):
            raise ValueError(f"{parameter}: {list(ends)} is no rising pair{' of positive numbers' if log else ''}")
        share = generator.random(count)
        columns[parameter] = low * (high / low) ** share if log else low + share * (high - low)
    return columns


def _number(value: Any, what: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        # JSON, in which inputs are kept, has no infinity
        raise ValueError(f"{what} must be a number, but is {'not finite' if value is None else repr(value)}")
    return float(value)


def _whole(value: Any, name: str, *, least: int, most: int) -> int:
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
_MARK = Variable(_COMPUTED, "this point has been computed", "bool")
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
            `accuracy`, a number or None.
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
    if what != "collide" and APPROACH_SPEED in columns:
        raise ValueError(f"`{APPROACH_SPEED}` is an axis of `collide` alone")
    columns.pop(APPROACH_SPEED, None)
    check_ranges(scene, *(ParameterRange(path, values.min(), values.max()) for path, values in columns.items()))
    builder, settings = _RECORDERS[what]
    unknown = sorted(set(record) - set(settings))
    if unknown:
        known = f"it has {', '.join(settings)}" if settings else "it has no settings"
        raise ValueError(f"[record]: unknown key {unknown[0]} of {what!r}; {known}")
    chosen = {key: _setting(key, record.get(key, usual), usual) for key, usual in settings.items()}
    accuracy = given.get("accuracy")
    if accuracy is not None and not isinstance(scene.interaction, Contact):
        raise ValueError("`accuracy` is about resolved contacts, and this scene has none: leave `accuracy` out")
    if accuracy is not None and not (isinstance(accuracy, float) and 0.0 < accuracy < 1.0):
        raise ValueError(f"`accuracy` must be a number between 0 and 1, but is {accuracy!r}")
    if given.get("start"):
        if what != "simulation":
            raise ValueError(f"a start is of use for simulations alone: leave it out for {what!r}")
        chosen["start"] = Start(**given["start"])
    return builder(scene, tuple(columns), **chosen, **({} if accuracy is None else {"accuracy": accuracy}))


def _setting(key: str, value: Any, usual: Any) -> Any:
    if isinstance(usual, tuple):
        if not (isinstance(value, list | tuple) and value and all(type(each) is int and each > 0 for each in value)):
            raise ValueError(f"[record]: `{key}` must be a list of positive whole numbers, but is {value!r}")
        if len(set(value)) < len(value):
            raise ValueError(f"[record]: `{key}` must be different numbers, but is {value!r}")
        return tuple(value)
    wanted = int if isinstance(usual, int) else (int, float)
    if isinstance(value, bool) or not isinstance(value, wanted) or not 0 < value < math.inf:
        raise ValueError(f"[record]: `{key}` must be a positive {'whole ' if wanted is int else ''}number: {value!r}")
    return value if wanted is int else float(value)


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


def _variables(meanings: Mapping[str, str], dimension: str | None = None) -> tuple[Variable, ...]:
    """Return variables that are numbers, from names and meanings."""
    return tuple(
        Variable(name, meaning, dimensions=() if dimension is None else (dimension,))
        for name, meaning in meanings.items()
    )


_ORBIT_VARIABLES = (
    *_variables({"peak_amplitude_nm": "largest height above the rest position"}, "order"),
    Variable("stable_orbits", "number of admissible stable single-impact orbits", "int8", ("order",)),
    Variable("admissible_orbits", "number of admissible single-impact orbits", "int8", ("order",)),
    *_variables(
        {
            "lockin_amplitude_nm": "amplitude at the response frequency omega/N",
            "lockin_phase_deg": "its phase, modulo 360/N",
            APPROACH_SPEED: "speed towards the platform before the impact",
            "phase_rad": "drive phase just after the impact",
            "velocity_after_nm_per_us": "velocity in the lab just after the impact",
            "largest_multiplier": "size of the larger multiplier of the map",
        },
        "order",
    ),
)
_DRIVEN_ORBIT_VARIABLES = _variables(
    {
        "drive_lockin_amplitude_nm": "amplitude at the drive's frequency omega",
        "drive_lockin_phase_deg": "its phase",
        "phase_lag_deg": "lag of deflection or height behind base or force at omega",
    },
    "order",
)
"""What is recorded besides of orbits that base or force drives."""


def _orbits(
    scene: Scene, paths: tuple[str, ...], *, orders: tuple[int, ...], accuracy: float = CHART_ACCURACY
) -> Recorder:
    """Record the stable single-impact orbits of scenes; of several of one order the highest."""
    sample_driven(scene)
    for path in paths:
        if path.endswith("offset_rate_nm_per_us"):
            raise ValueError(f"under a ramp no orbit repeats: {path} cannot be an axis of 'orbits'")
    extra = {"order": [float(order) for order in orders]}
    if isinstance(scene.interaction, Contact):
        return _contact_orbits(scene, orders, accuracy, extra)
    law, made = impact_law_of(scene), _scenes(scene, paths)
    beyond = _beyond(scene, "the stable orbit's impact comes", ("order",))

    def record(columns: Columns) -> Columns:
        scenes = made(columns)
        found = highest_orbits(scenes, free_frame(scenes), jnp.asarray(orders, float))
        if not beyond:
            return found
        laws, speeds = impact_law_of(scenes), found[APPROACH_SPEED]
        return found | {EXTRAPOLATED: jax.vmap(lambda law, speed: law.extrapolated(speed))(laws, speeds)}

    driven = () if scene.base is None and scene.force is None else _DRIVEN_ORBIT_VARIABLES
    points = 4096 if law.delay else 1 << 18
    return Recorder((*_ORBIT_VARIABLES, *driven, *beyond), _in_batches(record), points, extra)


def _contact_orbits(
    scene: Scene, orders: tuple[int, ...], accuracy: float, extra: Mapping[str, list[float]]
) -> Recorder:
    """Record single-impact orbits of resolved contacts."""
    variables = (
        _ORBIT_VARIABLES[0],
        Variable("stable", "an admissible single-impact orbit is stable", "bool", ("order",)),
        Variable("admissible", "there is an admissible single-impact orbit", "bool", ("order",)),
        Variable("unresolved", "the law closest to the contact has an orbit, but none was found", "bool", ("order",)),
        _ORBIT_VARIABLES[-1],
    )
    nothing = {each.name: np.full(len(orders), math.nan if each.dtype == "float64" else False) for each in variables}

    def record(row: dict[str, float]) -> dict[str, Any]:
        try:
            one = sample_driven(scene_batch(scene, {name: np.array([value]) for name, value in row.items()}))
            found = single_contact_orbits(one, orders, accuracy=accuracy)
        except ValueError as error:
            return nothing | {MESSAGE.name: str(error)}
        return {each.name: found[each.name][0] for each in variables} | {MESSAGE.name: ""}

    return Recorder((*variables, MESSAGE), _one_by_one(record), 16, extra, alone=True)


def _codes(kinds: Any) -> dict[int, str]:
    return {int(kind): kind.name.lower() for kind in kinds}


_COLLISION_VARIABLES = (
    *_variables(
        {
            "rebound_speed_nm_per_us": "speed away from the sample; 0 where the tip is captured",
            "collision_delay_us": "time between the crossings of gap 0 by the straight paths in and out, if it leaves",
        }
    ),
    Variable("captured", "the tip stays at the sample", "bool"),
    Variable("outcome", "how the collision ended", "int8", codes=_codes(CollisionOutcome)),
    *_variables(
        {
            "time_in_contact_us": "from the formation of the bridge to its breaking",
            "time_in_junction_us": "with the solids joined",
            "deepest_gap_nm": "smallest gap",
            "bridge_hysteresis_aj": "energy that the bridge takes",
            "junction_hysteresis_aj": "energy that the junction takes",
            "viscous_loss_aj": "energy that viscosity takes",
        }
    ),
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

        def known(variable: Variable) -> Any:
            values, exists = getattr(found, variable.name), trusted
            if variable.name in ONLY_FREE and variable.name != "rebound_speed_nm_per_us":
                exists &= ~found.captured
            return jnp.where(exists, values, jnp.nan) if variable.dtype == "float64" else values

        return {variable.name: known(variable) for variable in _COLLISION_VARIABLES}

    return Recorder(_COLLISION_VARIABLES, _in_batches(record), 16384)


_EXPONENT_VARIABLES = (
    *_variables(
        {
            "exponents_per_impact": "Lyapunov exponents, larger first",
            "exponents_per_us": "the same in time",
            "exponents_per_impact_error": "their standard errors",
            "exponents_per_us_error": "their standard errors",
        },
        "exponent",
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
    *_variables({observable.name: observable.meaning for observable in OBSERVABLES}),
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
        beyond = extrapolation_of(one.interaction, found.contacts.approach_speed_nm_per_us) is not None
        results = nothing | {
            "settled": verdict.settled,
            "stuck": verdict.stuck,
            "order": verdict.periods or 0,
            "contacts_per_response": verdict.contacts or 0,
            "impacts": int(found.count),
            "outcome": int(outcome),
            **({EXTRAPOLATED: beyond} if EXTRAPOLATED in nothing else {}),
        }
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

    def regions(self) -> list[tuple[slice, ...]]:
        """Return which part of the results each chunk is."""
        sides = zip(self.shape, self.block, strict=True)
        parts = [[slice(at, min(at + part, size)) for at in range(0, size, part)] for size, part in sides]
        return list(itertools.product(*parts))

    def compute(self, region: tuple[slice, ...]) -> Columns:
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

    Raises:
        ValueError: if it is none.
    """
    packages = ("afm-jax", "jax", "jaxlib", "numpy", "scipy")
    versions = {package: version_of(package) for package in packages} | {"device": jax.default_backend()}
    whole = json.loads(strict_json({**given, "versions": versions}))
    chunk = whole.get("chunk")
    if chunk is not None and (isinstance(chunk, bool) or not isinstance(chunk, int) or chunk < 1):
        raise ValueError(f"`chunk` must be a positive whole number of points, but is {chunk!r}")
    axes = axes_of(whole["axes"])
    recorder = recorder_of(whole, axes)
    taken = [*recorder.extra, *(variable.name for variable in recorder.variables)]
    for axis in axes:
        if axis.dimension in taken or any(dimension_of(name) in taken for name in axis.columns):
            raise ValueError(f"the axis {axis.dimension} has the name of something that is recorded")
    plan = SweepPlan(whole | {"chunk": chunk or recorder.points}, axes, recorder)
    chunks = math.prod(-(-size // side) for size, side in zip(plan.shape, plan.block, strict=True))
    if chunks > _MOST_CHUNKS:
        raise ValueError(f"{chunks} chunks are too many: `chunk` must be larger, or take fewer values along the axes")
    return plan


def _unit(name: str) -> str:
    """Return the unit that a name says; "1" for a number."""
    named = {"epsilon": "nm2/us2", "viscous_loss": "nm/us", "hertz": "us (nm/us)^(1/5)"}
    plain = name.rpartition(".")[2].removesuffix("_error")
    unit = next((unit for ending, unit in named.items() if plain.endswith(ending)), "")
    return unit or unit_of(plain).replace("^", "") or "1"


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
    fills = {"float64": math.nan, "string": ""}
    along = {name: axis.dimension for axis in plan.axes for name in axis.columns}

    def make(name: str, dimensions: Sequence[str], chunks: Sequence[int], each: Variable, **attributes: Any) -> Any:
        sizes = dict(zip((axis.dimension for axis in plan.axes), plan.shape, strict=True))
        sizes |= {extra: len(values) for extra, values in plan.recorder.extra.items()}
        return group.create_array(
            name,
            shape=tuple(sizes[dimension] for dimension in dimensions),
            chunks=tuple(chunks),
            dtype=each.dtype,
            fill_value=fills.get(each.dtype, 0),
            dimension_names=tuple(dimensions),
            attributes=attributes,
        )

    number = Variable("", "")
    for axis in plan.axes:
        for parameter, values in axis.columns.items():
            attributes = {"parameter": parameter, "units": _unit(parameter)}
            make(dimension_of(parameter), [axis.dimension], [axis.size], number, **attributes)[:] = values
    for name, values in plan.recorder.extra.items():
        make(name, [name], [len(values)], number)[:] = np.asarray(values)
    others = " ".join(dimension_of(name) for name, dimension in along.items() if dimension_of(name) != dimension)
    for each in (*plan.recorder.variables, _MARK):
        dimensions = (*(axis.dimension for axis in plan.axes), *each.dimensions)
        chunks = (*plan.block, *(len(plan.recorder.extra[name]) for name in each.dimensions))
        make(each.name, dimensions, chunks, each, **each.attributes(), coordinates=others)


def _check_same(folder: Path, plan: SweepPlan) -> None:
    try:
        attributes = json.loads((folder / STORE / "zarr.json").read_bytes())["attributes"]
        found, version = json.loads(attributes["input"]), attributes["format_version"]
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{folder / STORE}: is not a sweep of afm-jax; choose another folder") from error
    if version != FORMAT_VERSION:
        raise ValueError(f"{folder / STORE}: has format_version {version}, not {FORMAT_VERSION}; choose another folder")
    for name, wanted in plan.given.items():
        if found.get(name) != wanted:
            old, new = (json.dumps(each) for each in (found.get(name), wanted))
            difference = f"{name} is {old}, not {new}"
            raise ValueError(
                f"{folder}: holds another sweep, in which {difference}: choose another folder, or restore the input"
            )


class SweepRun(NamedTuple):
    """What a run over a sweep did: chunks in all, those kept from before, those computed now, and its seconds."""

    chunks: int
    kept: int
    computed: int
    seconds: float


Progress = Callable[[int, int], object]
"""Told how many of how many points are done."""


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
    marks = group[_COMPUTED][...]
    missing = [region for region in regions if not marks[region].all()]
    kept = len(regions) - len(missing)
    try:
        for region, results in _results(plan, missing, workers=workers, scheduler=scheduler):
            for each in plan.recorder.variables:
                group[each.name][(*region, ...)] = results[each.name]
            group[_COMPUTED][region] = True
            done += 1
            if report is not None:
                report(round((kept + done) * marks.size / len(regions)), marks.size)
    except OSError as error:
        what = f"{error.strerror or error}: {kept + done} of {len(regions)} chunks are kept; mend that"
        raise OSError(error.errno, f"{what}, and give the same command again", str(folder)) from error
    return SweepRun(len(regions), kept, done, time.monotonic() - begin)


def _results(
    plan: SweepPlan, regions: Sequence[tuple[slice, ...]], *, workers: int, scheduler: str | None
) -> Iterator[tuple[tuple[slice, ...], Columns]]:
    """Give chunks with their results: in this process, or as workers have done them, two under way for each."""
    if not regions or (workers <= 1 and scheduler is None):
        yield from ((region, plan.compute(region)) for region in regions)
        return
    from distributed import as_completed  # noqa: PLC0415 (an extra package)

    with _client(min(workers, len(regions)), scheduler) as client:
        text, waiting, under_way = json.dumps(plan.given), iter(regions), as_completed()
        places: dict[Any, tuple[slice, ...]] = {}

        def hand_out(count: int) -> None:
            for region in itertools.islice(waiting, count):
                future = client.submit(compute_chunk, text, region, pure=False)
                places[future.key] = region
                under_way.add(future)

        threads: Any = client.ncores()
        hand_out(2 * sum(threads.values()))
        for future in under_way:
            yield places.pop(future.key), future.result()
            hand_out(1)


def compute_chunk(text: str, region: tuple[slice, ...]) -> Columns:
    """Return the results of a chunk, for a process that knows nothing but the input.

    Args:
        text: `SweepPlan.given` as JSON.
        region: of the chunk.

    Raises:
        RuntimeError: if this process would compute otherwise than the one that asks.
    """
    return _plan_of_worker(text).compute(region)


@lru_cache(maxsize=4)
def _plan_of_worker(text: str) -> SweepPlan:
    silence_xla()
    open_cache()
    given = json.loads(text)
    with jax.enable_x64(True):  # noqa: FBT003
        plan = plan_of(given)
    for name, own in plan.given["versions"].items():
        if own != given["versions"][name]:
            other = given["versions"][name]
            raise RuntimeError(f"a worker would compute otherwise than the others: {name} is {own}, not {other}")
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


def processes_for(plan: SweepPlan) -> int:
    """Return how many processes use this machine best: one for batches, which take every core themselves."""
    if not plan.recorder.alone or find_spec("distributed") is None:
        return 1
    return min(available_cores(), len(plan.regions()))


# --- what is told, and Python's way -----------------------------------------------------------------------------------

_MOST_MESSAGES = 3


class Swept(NamedTuple):
    """What `afm-jax sweep` tells of a sweep that is done."""

    plan: SweepPlan
    run: SweepRun
    store: Path
    messages: Counter[str]
    """Why points have no result to be trusted, and how many each time."""
    extrapolated: str | None
    """A sentence on points whose law is asked at other speeds than it is known for; None without any."""

    text = Result.text

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON object."""
        return {
            "store": self.store,
            "points": math.prod(self.plan.shape),
            "shape": self.plan.shape,
            "chunks": self.run.chunks,
            "chunks_kept": self.run.kept,
            "chunks_computed": self.run.computed,
            "seconds": self.run.seconds,
            "without_result": sum(self.messages.values()),
            "messages": dict(self.messages),
            "extrapolated": self.extrapolated,
        }

    def printed(self) -> list[str | None]:
        """Return what was computed, why points have no result, and how to open them."""
        run, many = self.run, sum(self.messages.values())
        grid = " x ".join(map(str, self.plan.shape))
        took = f"Computed in {run.seconds:.1f} s: {run.computed}; done before and kept: {run.kept}."
        lines: list[str | None] = [f"{grid} points in {counted(run.chunks, 'chunk')}. {took}"]
        if many:
            lines.append(f"{many} points have no result to be trusted (`message` says why), most of them:")
            lines += [f"  {count}: {text}" for text, count in self.messages.most_common(_MOST_MESSAGES)]
        return [*lines, f"Open them with xarray.open_zarr({str(self.store)!r}).", self.extrapolated]


def swept(plan: SweepPlan, run: SweepRun, store: Path) -> Swept:
    """Return what is told of a sweep whose results are in a store."""
    import xarray  # noqa: PLC0415 (an extra package)

    meanings = {variable.name: variable.meaning for variable in plan.recorder.variables}
    messages, beyond = Counter[str](), None
    with xarray.open_zarr(str(store)) as found:
        if MESSAGE.name in meanings:
            messages.update(text for text in found[MESSAGE.name].values.ravel().tolist() if text)
        if EXTRAPOLATED in meanings:
            points = math.prod(plan.shape)
            outside = int(found[EXTRAPOLATED].values.reshape(points, -1).any(axis=1).sum())
            if outside:
                beyond = f"Extrapolated: at {outside} of {points} points {meanings[EXTRAPOLATED]}."
    return Swept(plan, run, store, messages, beyond)


@checked
def sweep(  # noqa: PLR0913
    scene: SceneLike,
    axes: Sequence[Mapping[str, Any]],
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
        axes: of the grid, tables as in a sweep file: {"parameter": "interaction.r", "linear": [0.5, 0.9, 100]}, "log"
            likewise, "list" with values; or {"random": {"interaction.r": [0.5, 0.9]}, "count": 100, "seed": 1}.
            Parameters are paths of the scene file.
        record: "orbits", "collide", "lyapunov" or "simulation", or a table with that as `what` and settings.
        out: folder of the results: chunks that are done there are kept; None: nothing is kept on the disk. What two
            sweeps write into one folder at the same time is undefined.
        accuracy: of resolved contacts.
        start: of simulations; None: `default_start` of each.
        chunk: points that are computed, kept and handed out together; None: as suits what is recorded.
        workers: processes; above 1 a local Dask cluster is started, which needs the extra `sweep`, and a script that
            calls this below `if __name__ == "__main__":`.
        scheduler: address of a Dask scheduler whose workers do the work, "tcp://...".
        report: told how many of how many points are done.

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

    scene = as_scene(scene)
    require_float64(scene)
    check_count("workers", workers)
    table = {"what": record} if isinstance(record, str) else dict(record)
    plan = plan_of(input_of(scene, axes, table, accuracy=accuracy, start=start, chunk=chunk))
    with ExitStack() as stack:
        folder = Path(out if out is not None else stack.enter_context(tempfile.TemporaryDirectory()))
        run_plan(plan, folder, workers=workers, scheduler=scheduler, report=report)
        found = xarray.open_zarr(str(folder / STORE))
        return found if out is not None else found.load()


def input_of(
    scene: Scene,
    axes: Sequence[Mapping[str, Any]],
    record: Mapping[str, Any],
    *,
    accuracy: float | None = None,
    start: Start | None = None,
    chunk: int | None = None,
) -> dict[str, Any]:
    """Return the input of a plan; arguments as of `sweep`."""
    return {
        "scene": scene_tables(scene),
        "start": None if start is None else start._asdict(),
        "axes": [dict(axis) for axis in axes],
        "record": dict(record),
        "accuracy": accuracy,
        "chunk": chunk,
    }
