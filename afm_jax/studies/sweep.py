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
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import lru_cache, partial
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from afm_jax.apparatus.scene import Scene, drive_of
from afm_jax.apparatus.surface import free_frame
from afm_jax.checks import check_count, checked, require_float64
from afm_jax.compilation_cache import available_cores, open_cache, silence_xla
from afm_jax.contact.collide import collide
from afm_jax.contact.contact import Contact
from afm_jax.dynamics.charts import DRIVEN_NUMBERS, ORBIT_NUMBERS, highest_orbits
from afm_jax.dynamics.exponents import lyapunov_spectrum
from afm_jax.dynamics.starts import sample_driven
from afm_jax.dynamics.verdicts import MotionKind
from afm_jax.impact.law import TabulatedLaw, extrapolation_of, impact_law_of
from afm_jax.motion.follow import follow_long
from afm_jax.motion.observe import OBSERVABLES, TOO_SHORT, observe
from afm_jax.motion.record import MotionOutcome
from afm_jax.motion.simulate import DEFAULT_ACCURACY
from afm_jax.motion.start import start_of
from afm_jax.outcomes import CollisionOutcome
from afm_jax.results import known_columns
from afm_jax.scenefile.parameter_paths import (
    ParameterRange,
    batch_family,
    check_ranges,
    parameter_values,
    parse_range,
    scene_batch,
    scene_family,
)
from afm_jax.scenefile.scenefile import Start, scene_of_tables, scene_tables
from afm_jax.solve.lanes import LANES, in_blocks
from afm_jax.strict_json import strict_json
from afm_jax.units import unit_of, words_of
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


def axes_of(given: Any) -> tuple[Axis, ...]:
    """Return the axes that tables describe.

    >>> axes_of([{"parameter": "interaction.r", "linear": [0.5, 0.9, 5]}])[0].columns["interaction.r"].tolist()
    [0.5, 0.6, 0.7, 0.8, 0.9]

    Args:
        given: of each axis either `parameter` with `linear` or `log` (low, high, count) or `list` (values), or
            `random` (for each parameter its [low, high], or {log = [low, high]}) with `count` and `seed`.

    Raises:
        ValueError: if one is no such table, or a parameter changes along two of them.
    """
    if not given or not isinstance(given, list) or not all(isinstance(table, dict) for table in given):
        raise ValueError(f"a sweep needs axes, tables written as [[axes]], as in {_EXAMPLE}")
    axes: list[Axis] = []
    for number, table in enumerate(given, 1):
        samples = sum(axis.dimension.startswith("sample") for axis in axes)
        try:
            axes.append(_axis(table, f"sample_{samples + 1}" if samples else "sample"))
        except ValueError as error:
            raise ValueError(f"axis {number}: {error}") from error
    for name, times in Counter(name for axis in axes for name in axis.columns).items():
        if times > 1:
            raise ValueError(f"the parameter {name} changes along two axes: leave one of them out")
    return tuple(axes)


def dimension_of(parameter: str) -> str:
    """Return the name that a parameter has in the results."""
    return parameter.replace(".", "_")


def _axis(table: Mapping[str, Any], sample: str) -> Axis:
    kind = next((kind for kind in KINDS if kind in table), "linear")
    keys = (kind, "count", "seed") if kind == "random" else ("parameter", kind)
    if set(table) != set(keys):
        wanted = "`parameter` and one of linear, log and list, or `random`, `count` and `seed`"
        raise ValueError(f"has {', '.join(table) or 'nothing'}; give {wanted}, as in {_EXAMPLE}")
    values, parameter = table[kind], table.get("parameter")
    if kind == "random":
        if not isinstance(values, Mapping) or not values:
            raise ValueError('`random` must name parameters with their ends, as in { "interaction.r" = [0.9, 0.99] }')
        generator = np.random.default_rng(_whole(table["seed"], "seed", 0, 1 << 63))
        shares = generator.random((len(values), _whole(table["count"], "count", 1, _MOST)))
        pairs = zip(values.items(), shares, strict=True)
        return Axis(sample, {name: _drawn(name, ends, share) for (name, ends), share in pairs})
    if not isinstance(parameter, str):
        raise ValueError(f"`parameter` must be a name, but is {parameter!r}")  # noqa: TRY004 (a wrong file)
    if kind == "list":
        column = _numbers(values, "`list`")
        if len(set(column)) < len(column):
            raise ValueError("a value of the list stands there twice: leave one of them out")
        return Axis(dimension_of(parameter), {parameter: np.array(column)})
    if not isinstance(values, list) or len(values) != 3:
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
    numbers = isinstance(given, list) and all(type(each) in (int, float) and math.isfinite(each) for each in given)
    if not numbers or not 0 < len(given) <= _MOST:
        raise ValueError(f"{what} must be a list of finite numbers, at most {_MOST}, but is {given}")
    return [float(value) for value in given]


def _whole(value: Any, name: str, least: int, most: int) -> int:
    if type(value) is not int or not least <= value <= most:
        raise ValueError(f"`{name}` must be a whole number from {least} to {most}, but is {value!r}")
    return value


# --- what is recorded of scenes ---------------------------------------------------------------------------------------


MESSAGE = "message"
"""The variable that says why there is no result, or none to be trusted; empty where there is one."""
EXTRAPOLATED = "extrapolated"
"""The variable of scenes with a law that is a table: whether it is used outside the speeds that it is known for."""
APPROACH_SPEED = "approach_speed_nm_per_us"
"""The axis of `collide` that is no parameter of the scene."""
_MARK = "computed"


@dataclass(frozen=True)
class Recorder:
    """What a sweep does at its points.

    Attributes:
        work: from columns of parameters to columns of results, one row a point; arrays of two dimensions have the
            extra one behind.
        points: of a chunk, unless the input says otherwise: some tenths of a second of work at least.
        shown: the most telling results.
        extra: name and values of a dimension besides the axes.
        words: of results that stand for words, what each number means.
        alone: whether a point is computed by itself, on one core: several processes are needed to use several.
    """

    work: Callable[[Columns], Columns]
    points: int
    shown: tuple[str, ...]
    extra: Mapping[str, Sequence[int]] = field(default_factory=dict)
    words: Mapping[str, Mapping[int, str]] = field(default_factory=dict)
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
    if what not in list(_RECORDERS):
        raise ValueError(f"[record]: `what` must be one of {', '.join(_RECORDERS)}, but is {what!r}")
    columns = {name: values for axis in axes for name, values in axis.columns.items()}
    if what == "collide":
        columns.pop(APPROACH_SPEED, None)
    check_ranges(scene, *(ParameterRange(path, values.min(), values.max()) for path, values in columns.items()))
    builder = _RECORDERS[what]
    usual = {
        each.name: each.default for each in signature(builder).parameters.values() if each.kind is each.KEYWORD_ONLY
    }
    settings = {name: value for name, value in usual.items() if name not in ("accuracy", "start")}
    for key in record:
        if key not in settings:
            raise ValueError(f"[record]: unknown key {key} of {what!r}; it has {', '.join(settings)}")
    chosen = {key: _setting(key, value, settings[key]) for key, value in record.items()}
    accuracy = given.get("accuracy")
    if accuracy is not None:
        if not isinstance(scene.interaction, Contact):
            raise ValueError("`accuracy` is about resolved contacts, and this scene has none: leave `accuracy` out")
        if not (isinstance(accuracy, float) and 0.0 < accuracy < 1.0):
            raise ValueError(f"`accuracy` must be a number between 0 and 1, but is {accuracy!r}")
        chosen |= {"accuracy": accuracy} if "accuracy" in usual else {}
    if given.get("start"):
        if "start" not in usual:
            raise ValueError(f"a start is of use for simulations alone: leave it out for {what!r}")
        chosen["start"] = Start(**given["start"])
    return builder(scene, tuple(columns), **chosen)


def _setting(key: str, value: Any, usual: Any) -> Any:
    """Return a setting of the kind of its usual value: a number, a whole one, or several whole ones."""
    several = isinstance(usual, tuple)
    numbers: Any = value if several and isinstance(value, list) else [value]
    kinds = (int, float) if isinstance(usual, float) else (int,)
    if not numbers or not all(type(each) in kinds and each > 0 for each in numbers):
        kind = "positive number" if float in kinds else "positive whole number"
        raise ValueError(f"[record]: `{key}` must be a {kind}{', or several' * several}, but is {value!r}")
    return tuple(numbers) if several else type(usual)(numbers[0])


def _scenes(scene: Scene, paths: Sequence[str]) -> Callable[[Columns], Scene]:
    """Return a function that makes a batch of scenes from columns of parameters; the scene where none of it changes."""
    return batch_family(scene, paths) if paths else lambda _: scene


def _orbits(scene: Scene, paths: tuple[str, ...], *, orders: tuple[int, ...] = (1,)) -> Recorder:
    """Record the stable single-impact orbits of scenes; of several of one order the highest."""
    if isinstance(scene.interaction, Contact):
        raise ValueError("'orbits' are those of laws: `afm-jax collide --make-law` gives that of a contact")  # noqa: TRY004
    sample_driven(scene)
    for path in paths:
        if path.endswith("offset_rate_nm_per_us"):
            raise ValueError(f"under a ramp no orbit repeats: {path} cannot be an axis of 'orbits'")
        if "frequency" in path:
            # a little aside: says why not, where another part has the same frequency
            sample_driven(scene_batch(scene, {path: np.array([1.001 * parameter_values(scene)[path]])}))
    made = _scenes(scene, paths)

    def record_batch(columns: Columns) -> Columns:
        scenes = made(columns)
        found = highest_orbits(scenes, free_frame(scenes), jnp.asarray(orders, float), names=names)
        if not isinstance(scene.interaction, TabulatedLaw):
            return found
        outside = jax.vmap(lambda law, speed: law.extrapolated(speed))
        return found | {EXTRAPOLATED: outside(scenes.interaction, found[APPROACH_SPEED])}

    names = ORBIT_NUMBERS + (() if scene.base is None and scene.force is None else DRIVEN_NUMBERS)
    points = 4096 if impact_law_of(scene).delay else 1 << 18
    # what a processor's cache holds, or what fills an accelerator; blocks of one shape have one program
    block = 1024 if jax.default_backend() == "cpu" else 1 << 16
    work = partial(in_blocks, jax.jit(record_batch), widths=(block,))
    return Recorder(work, points, ("peak_amplitude_nm", "stable_orbits"), {"order": orders})


def _codes(kinds: Any) -> dict[int, str]:
    return {int(kind): kind.name.lower() for kind in kinds}


def _collisions(
    scene: Scene, paths: tuple[str, ...], *, approach_speed_nm_per_us: float = 30.0, accuracy: float = 1e-9
) -> Recorder:
    """Record collisions of free tips with the contacts of scenes."""
    if not isinstance(scene.interaction, Contact):
        raise ValueError("'collide' is about a resolved contact: the scene needs model = \"contact\"")  # noqa: TRY004
    made = jax.jit(_scenes(scene, paths))

    def work(columns: Columns) -> Columns:
        count = len(next(iter(columns.values())))
        speeds = np.broadcast_to(columns.get(APPROACH_SPEED, approach_speed_nm_per_us), (count,))
        scenes = made(columns)
        found = collide(scenes.interaction, speeds, scenes.cantilever.mass_ng, accuracy=accuracy)
        results = {name: column for name, (column, _) in known_columns(found).items() if name not in _NOT_KEPT}
        # that of a tip that is captured is 0
        return results | {shown[0]: np.where(found.captured, 0.0, results[shown[0]])}

    shown = ("rebound_speed_nm_per_us", "collision_delay_us")
    return Recorder(work, 16384, shown, words={"outcome": _codes(CollisionOutcome)})


_NOT_KEPT = (APPROACH_SPEED, "end_energy_aj")
"""Fields of a collision that no sweep records: an axis, and what the energies lost say."""


def _lyapunov(
    scene: Scene,
    paths: tuple[str, ...],
    *,
    impacts: int = 2000,
    transient: int = 500,
    accuracy: float = DEFAULT_ACCURACY,
) -> Recorder:
    """Record the exponents of motions that begin as in `bouncing_tips`."""
    sample_driven(scene)
    resolved = isinstance(scene.interaction, Contact)
    lanes = 16 if resolved else LANES
    made = jax.jit(_scenes(scene, paths))
    exponents = ("exponents_per_impact", "exponents_per_us", "exponents_per_impact_error", "exponents_per_us_error")

    def record(columns: Columns) -> Columns:
        found = lyapunov_spectrum(made(columns), impacts=impacts, transient=transient, accuracy=accuracy)
        verdicts = found.verdicts
        results = {name: getattr(found, name) for name in (*exponents, "impacts")}
        results |= {"kind": verdicts.kind, "orbit_impacts": verdicts.impacts, "orbit_periods": verdicts.periods}
        if isinstance(scene.interaction, TabulatedLaw):
            outside = scene.interaction.extrapolated(found.approach_speed_nm_per_us)
            results[EXTRAPOLATED] = np.asarray(outside).any(axis=1)
        return results

    # blocks of one width, so that there is one shape of every program
    work = partial(in_blocks, record, widths=(lanes,))
    points, words = lanes if resolved else 4 * lanes, {"kind": _codes(MotionKind)}
    return Recorder(work, points, exponents[:2], {"exponent": (1, 2)}, words, alone=resolved)


_REFUSED = -1


def _simulation(
    scene: Scene, paths: tuple[str, ...], *, periods: float = 2000.0, accuracy: float = 1e-9, start: Start | None = None
) -> Recorder:
    """Record what an experiment reads of scenes in time, followed until they settle or for some drive periods."""
    family = scene_family(scene, *paths)
    nothing = dict.fromkeys(OBSERVABLES, math.nan) | {"settled": False, "stuck": False}
    nothing |= dict.fromkeys(("order", "contacts_per_response", "impacts"), 0) | {"outcome": _REFUSED, MESSAGE: ""}
    nothing |= {EXTRAPOLATED: False} if isinstance(scene.interaction, TabulatedLaw) else {}

    def record(one: Scene) -> Columns:
        longest = periods * drive_of(one).period_us
        run = follow_long(one, start_of(one, start), longest, until_settled=True, accuracy=accuracy)
        found, verdict = run.simulation, run.verdict
        outcome = MotionOutcome(int(found.outcome))
        results: Columns = {
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
            return results | {MESSAGE: outcome.sentence}
        seen = observe(one, found, verdict=verdict)
        values = {name: getattr(seen, name) for name in OBSERVABLES}
        told = {} if seen.window.responses else {MESSAGE: TOO_SHORT}
        return results | {name: value for name, value in values.items() if value is not None} | told

    def at(*values: float) -> Columns:
        try:
            return nothing | record(family(*values))
        except ValueError as error:
            return nothing | {MESSAGE: str(error)}

    def work(columns: Columns) -> Columns:
        # one by one: neighbours would tell in last digits
        rows = [at(*values) for values in zip(*columns.values(), strict=True)]
        return {name: [row[name] for row in rows] for name in nothing}

    words = {"outcome": {_REFUSED: "not_possible"} | _codes(MotionOutcome)}
    return Recorder(work, 16, ("peak_amplitude_nm", "lockin_amplitude_nm"), words=words, alone=True)


_RECORDERS: dict[str, Callable[..., Recorder]] = {
    "orbits": _orbits,
    "collide": _collisions,
    "lyapunov": _lyapunov,
    "simulation": _simulation,
}
"""What can be recorded of scenes; the settings are the keywords, with their usual values."""

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
        places = np.meshgrid(*(np.arange(part.start, part.stop) for part in region), indexing="ij")
        pairs = list(zip(self.axes, places, strict=True))
        values = {name: column[at.ravel()] for axis, at in pairs for name, column in axis.columns.items()}
        # a worker has JAX's usual precision, whatever its caller has said
        with jax.enable_x64(True):  # noqa: FBT003
            found = self.recorder.work(values)
        arrays = {name: np.asarray(column) for name, column in found.items()}
        return {name: array.reshape(places[0].shape + array.shape[1:]) for name, array in arrays.items()}


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
    chunk = whole.get("chunk")
    whole["chunk"] = recorder.points if chunk is None else _whole(chunk, "chunk", 1, _MOST)
    plan = SweepPlan(whole, axes, recorder)
    if math.prod(plan.shape) > 1_000_000 * math.prod(plan.block):
        raise ValueError("that makes too many chunks: `chunk` must be larger, or take fewer values along the axes")
    return plan


def _unit(name: str) -> str:
    """Return the unit that a name says; "1" for a number."""
    named = {"epsilon": "nm2/us2", "viscous_loss": "nm/us", "hertz": "us (nm/us)^(1/5)"}
    plain = name.rpartition(".")[2].removesuffix("_error")
    return named.get(plain) or unit_of(plain).replace("^", "") or "1"


def _is_begun(folder: Path, plan: SweepPlan) -> bool:
    """Say whether a folder holds this sweep, after clearing what a killed process left unfinished.

    Raises:
        ValueError: if there is another sweep; says what differs.
        OSError: if there is a link, a device or a pipe in it; names it.
    """
    store = folder / STORE
    for place in (*folder.glob(f".{STORE}.*part"), store, *store.rglob("*")):
        check_plain(place)
        # as Zarr names it
        if place.suffix == ".partial":
            place.unlink()
    head = store / "zarr.json"
    if not head.exists():
        return False
    try:
        attributes = json.loads(head.read_bytes())["attributes"]
        kept = {"format_version": attributes["format_version"]} | json.loads(attributes["input"])
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{store}: is not a sweep of afm-jax; choose another folder") from error
    for name, wanted in ({"format_version": FORMAT_VERSION} | plan.given).items():
        if kept.get(name) != wanted:
            difference = f"{name} is {json.dumps(kept.get(name))}, not {json.dumps(wanted)}"
            raise ValueError(
                f"{folder}: holds another sweep, in which {difference}: choose another folder, or restore the input"
            )
    return True


def _make(store: Path, plan: SweepPlan, results: Columns) -> None:
    """Make a Zarr group with coordinates, and arrays for results like those of a chunk."""
    import zarr  # noqa: PLC0415 (an extra package)

    axes = [axis.dimension for axis in plan.axes]
    others = [dimension_of(name) for axis in plan.axes for name in axis.columns if dimension_of(name) != axis.dimension]
    with whole_folder(store) as fresh:
        group: Any = zarr.open_group(str(fresh), mode="w", zarr_format=3)
        group.attrs.update({"format": "afm-jax sweep", "format_version": FORMAT_VERSION, "afm_jax": __version__})
        group.attrs.update({"input": json.dumps(plan.given)})
        for axis in plan.axes:
            for parameter, values in axis.columns.items():
                about = {"parameter": parameter, "units": _unit(parameter)}
                group.create_array(
                    dimension_of(parameter), data=values, dimension_names=[axis.dimension], attributes=about
                )
        for name, values in plan.recorder.extra.items():
            group.create_array(name, data=np.asarray(values), dimension_names=[name])
        for name, array in results.items():
            further, is_float = array.shape[len(axes) :], array.dtype.kind == "f"
            is_text = array.dtype.kind == "U"
            words = plan.recorder.words.get(name, {})
            flags = {"flag_values": list(words), "flag_meanings": " ".join(words.values())} if words else {}
            units = {"units": _unit(name)} if is_float else {}
            group.create_array(
                name,
                shape=plan.shape + further,
                chunks=plan.block + further,
                dtype="string" if is_text else array.dtype,
                fill_value="" if is_text else math.nan if is_float else 0,
                dimension_names=[*axes, *plan.recorder.extra][: array.ndim],
                attributes={"long_name": words_of(name), **units, **flags, "coordinates": " ".join(others)},
            )
        with warnings.catch_warnings():
            # that xarray opens the store by one file is worth a part of the format that is not settled yet
            warnings.simplefilter("ignore")
            zarr.consolidate_metadata(str(fresh))


Progress = Callable[[int, int], object]
"""Called with how many of how many points are done."""


def run_plan(
    plan: SweepPlan,
    folder: Path,
    *,
    workers: int = 1,
    scheduler: str | None = None,
    report: Progress | None = None,
) -> tuple[int, int]:
    """Compute what a folder does not hold yet of a sweep; return how many chunks it held, and how many are new.

    Arguments and errors are as of `sweep`.
    """
    import zarr  # noqa: PLC0415 (an extra package)

    regions, done = plan.regions(), 0
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError) as error:
        what = "is no folder, or lies in none; choose another `out`"
        raise NotADirectoryError(errno.ENOTDIR, what, str(folder)) from error
    store, begun = folder / STORE, _is_begun(folder, plan)
    marks: Any = np.zeros(plan.shape, bool)
    if begun:
        marks = zarr.open_array(str(store / _MARK), mode="r")[...]
    missing = [region for region in regions if not marks[region].all()]
    kept = len(regions) - len(missing)
    try:
        for region, results in _results(plan, missing, workers=workers, scheduler=scheduler):
            # the mark is the last of them
            results[_MARK] = np.ones_like(marks[region])
            if not (begun or done):
                _make(store, plan, results)
            group: Any = zarr.open_group(str(store), mode="r+")
            for name, values in results.items():
                group[name][(*region, ...)] = values
            done += 1
            if report is not None:
                report(round((kept + done) * marks.size / len(regions)), marks.size)
    except OSError as error:
        what = f"{error.strerror or error}: {kept + done} of {len(regions)} chunks are kept; mend that"
        raise OSError(error.errno, f"{what}, and give the same command again", str(folder)) from error
    return kept, done


def _results(
    plan: SweepPlan, regions: Sequence[Region], *, workers: int, scheduler: str | None
) -> Iterator[tuple[Region, Columns]]:
    """Give chunks with their results: in this process, or as workers have done them."""
    if not regions or (workers <= 1 and scheduler is None):
        yield from ((region, plan.compute(region)) for region in regions)
        return
    from distributed import as_completed  # noqa: PLC0415 (an extra package)

    with _client(min(workers, len(regions)), scheduler) as client:
        work = partial(_computed, json.dumps(plan.given))
        for future in as_completed(client.map(work, regions, pure=False)):
            yield future.result()


def _computed(text: str, region: Region) -> tuple[Region, Columns]:
    """Return a chunk with its results, for a process that knows nothing but the input as JSON."""
    return region, _plan_of_worker(text).compute(region)


@lru_cache(maxsize=4)
def _plan_of_worker(text: str) -> SweepPlan:
    """Return the plan of an input.

    Raises:
        RuntimeError: if this process would compute otherwise than the one that asks.
    """
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
