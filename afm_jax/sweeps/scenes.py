"""What a sweep records of scenes: single-impact orbits, simulations, collisions, Lyapunov exponents.

Orbits and collisions are one program over a block of scenes that fits the cache, a block for every local device; the
blocks are filled up, so that there is one shape of it and no result depends on its neighbours.
"""

import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array

from afm_jax.apparatus.scene import Scene, drive_of
from afm_jax.apparatus.surface import free_frame
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
from afm_jax.scenefile.parameter_paths import ParameterRange, check_ranges, scene_batch, scene_family
from afm_jax.scenefile.scenefile import Start, scene_of_tables
from afm_jax.solve.lanes import LANES, filled
from afm_jax.sweeps.axes import Axis
from afm_jax.sweeps.plan import MESSAGE, Columns, Recorder, Variable

APPROACH_SPEED = "approach_speed_nm_per_us"
"""The axis of `collide` that is no parameter of the scene."""
SCENE_BUILDER = "afm_jax.sweeps.scenes:scene_recorder"
_BLOCKS, _BLOCKS_OF_ACCELERATORS = {"cpu": (1024, 16)}, (1 << 16, 1)
"""Scenes of a block, what a cache holds, or what fills an accelerator; and blocks that a device is given at once."""
_CALLS = 2
"""Calls of a program under way while an earlier one's results are put in place."""
_MOST_ORDERS = 100


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
    paths = {name: ends for axis in axes for name, ends in axis.ends.items() if name != APPROACH_SPEED}
    if what != "collide" and any(APPROACH_SPEED in axis.ends for axis in axes):
        raise ValueError(f"`{APPROACH_SPEED}` is an axis of `collide` alone")
    check_ranges(scene, *(ParameterRange(path, low, high) for path, (low, high) in paths.items()))
    builder, settings = _RECORDERS[what]
    unknown = sorted(set(record) - set(settings))
    if unknown:
        known = f"it has {', '.join(settings)}" if settings else "it has no settings"
        raise ValueError(f"[record]: unknown key {unknown[0]} of {what!r}; {known}")
    start = Start(**given["start"]) if given.get("start") else None
    if start is not None and what != "simulation":
        raise ValueError(f"a start is of use for simulations alone: leave it out for {what!r}")
    chosen = {key: _checked(key, record.get(key, usual), usual) for key, usual in settings.items()}
    accuracy = given.get("accuracy")
    if accuracy is not None and not isinstance(scene.interaction, Contact):
        raise ValueError("`accuracy` is about resolved contacts, and this scene has none: leave `accuracy` out")
    if accuracy is not None and not (isinstance(accuracy, float) and 0.0 < accuracy < 1.0):
        raise ValueError(f"`accuracy` must be a number between 0 and 1, but is {accuracy!r}")
    if accuracy is not None:
        chosen["accuracy"] = accuracy
    if start is not None:
        chosen["start"] = start
    return builder(scene, tuple(paths), **chosen)


def _checked(key: str, value: Any, usual: Any) -> Any:
    if isinstance(usual, tuple):
        if not (isinstance(value, (list, tuple)) and value and all(type(each) is int and each > 0 for each in value)):
            raise ValueError(f"[record]: `{key}` must be a list of positive whole numbers, but is {value!r}")
        if len(value) > _MOST_ORDERS or len(set(value)) < len(value):
            raise ValueError(f"[record]: `{key}` must be at most {_MOST_ORDERS} different numbers")
        return tuple(value)
    wanted = int if isinstance(usual, int) else (int, float)
    if isinstance(value, bool) or not isinstance(value, wanted) or not 0 < value < math.inf:
        raise ValueError(f"[record]: `{key}` must be a positive {'whole ' if wanted is int else ''}number: {value!r}")
    return value if wanted is int else float(value)


# --- over devices -----------------------------------------------------------------------------------------------------


def over_devices(record: Callable[[Columns], Columns]) -> Callable[[Columns], Columns]:
    """Return a function of columns of any length that records them block by block, on all local devices.

    A call of the program is many blocks, since to make it takes as long as some hundred scenes; how many is an
    argument, so that it does not change the program, and with it last digits.

    Args:
        record: from columns of one length to columns of that length, for JAX to trace.
    """
    devices = jax.local_devices()
    lanes, blocks = _BLOCKS.get(devices[0].platform, _BLOCKS_OF_ACCELERATORS)
    spread = PartitionSpec("devices")
    mesh = Mesh(np.array(devices), ("devices",))
    specs = {"in_specs": (spread, PartitionSpec()), "out_specs": spread}
    program = jax.jit(jax.shard_map(_first_blocks(record, blocks), mesh=mesh, check_vma=False, **specs))
    number = len(devices)

    def spread_out(column: np.ndarray, count: int) -> np.ndarray:
        rows = np.empty((number, blocks, lanes))
        rows[:, :count] = filled(column, number * count * lanes).reshape(number, count, lanes)
        return rows.reshape(-1, lanes)

    def gathered(found: Array, count: int, rows: int) -> np.ndarray:
        values = np.asarray(found)
        values = values.reshape(number, blocks, *values.shape[1:])[:, :count]
        return values.reshape(-1, *values.shape[3:])[:rows]

    def work(columns: Columns) -> Columns:
        total = len(next(iter(columns.values())))
        results: Columns = {}
        calls: deque[tuple[int, int, int, dict[str, Array]]] = deque()

        def put_in_place() -> None:
            first, rows, count, found = calls.popleft()
            for name, part in found.items():
                values = gathered(part, count, rows)
                results.setdefault(name, np.empty((total, *values.shape[1:]), values.dtype))[first:][:rows] = values

        for first in range(0, total, number * blocks * lanes):
            rows = min(number * blocks * lanes, total - first)
            count = -(-rows // (number * lanes))
            whole = {name: spread_out(column[first : first + rows], count) for name, column in columns.items()}
            calls.append((first, rows, count, program(whole, count)))
            if len(calls) > _CALLS:
                put_in_place()
        while calls:
            put_in_place()
        return results

    return work


def _first_blocks(record: Callable[[Columns], Columns], blocks: int) -> Callable[..., dict[str, Array]]:
    """Return a function of columns of so many blocks and of how many of these to record."""
    record = jax.jit(record)

    def each(columns: dict[str, Array], count: Array) -> dict[str, Array]:
        """Record the first blocks of one device."""
        shapes = jax.eval_shape(record, {name: column[0] for name, column in columns.items()})
        empty = {name: jnp.zeros((blocks, *shape.shape), shape.dtype) for name, shape in shapes.items()}

        def block(at: Array, found: dict[str, Array]) -> dict[str, Array]:
            part = record({name: column[at] for name, column in columns.items()})
            return {name: found[name].at[at].set(part[name]) for name in found}

        return lax.fori_loop(0, count, block, empty)

    return each


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


EXTRAPOLATED = "extrapolated"
"""The variable of scenes with a law that is a table."""


def _beyond(scene: Scene, what: str, dimensions: tuple[str, ...] = ()) -> tuple[Variable, ...]:
    """Return the variable that says whether a law that is a table is extrapolated; none of other scenes."""
    law = scene.interaction
    if not isinstance(law, TabulatedLaw):
        return ()
    low, high = float(law.slowest_nm_per_us), float(law.fastest_nm_per_us)
    meaning = f"{what} outside the speeds that the law is known for, {low:.4g} to {high:.4g} nm/us"
    return (Variable(EXTRAPOLATED, meaning, "bool", dimensions),)


# --- single-impact orbits ---------------------------------------------------------------------------------------------

_ORBIT_VARIABLES = (
    Variable("peak_amplitude_nm", "largest height above the rest position", dimensions=("order",)),
    Variable("stable_orbits", "number of admissible stable single-impact orbits", "int8", ("order",)),
    Variable("admissible_orbits", "number of admissible single-impact orbits", "int8", ("order",)),
    Variable("lockin_amplitude_nm", "amplitude at the response frequency omega/N", dimensions=("order",)),
    Variable("lockin_phase_deg", "its phase, modulo 360/N", dimensions=("order",)),
    Variable("approach_speed_nm_per_us", "speed towards the platform before the impact", dimensions=("order",)),
    Variable("phase_rad", "drive phase just after the impact", dimensions=("order",)),
    Variable("velocity_after_nm_per_us", "velocity in the lab just after the impact", dimensions=("order",)),
    Variable("largest_multiplier", "size of the larger multiplier of the map", dimensions=("order",), unit="1"),
)
_DRIVEN_ORBIT_VARIABLES = (
    Variable("drive_lockin_amplitude_nm", "amplitude at the drive's frequency omega", dimensions=("order",)),
    Variable("drive_lockin_phase_deg", "its phase", dimensions=("order",)),
    Variable("phase_lag_deg", "lag of deflection or height behind base or force at omega", dimensions=("order",)),
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
    law = impact_law_of(scene)
    made = _scenes(scene, paths)

    beyond = _beyond(scene, "the stable orbit's impact comes", ("order",))

    def record(columns: Columns) -> dict[str, Array]:
        scenes = made(columns)
        found = highest_orbits(scenes, free_frame(scenes), jnp.asarray(orders, float))
        if not beyond:
            return found
        laws, speeds = impact_law_of(scenes), found["approach_speed_nm_per_us"]
        return found | {EXTRAPOLATED: jax.vmap(lambda law, speed: law.extrapolated(speed))(laws, speeds)}

    points = 4096 if law.delay else 1 << 18
    driven = () if scene.base is None and scene.force is None else _DRIVEN_ORBIT_VARIABLES
    return Recorder((*_ORBIT_VARIABLES, *driven, *beyond), over_devices(record), points, extra)


_CONTACT_ORBIT_VARIABLES = (
    _ORBIT_VARIABLES[0],
    Variable("stable", "an admissible single-impact orbit is stable", "bool", ("order",)),
    Variable("admissible", "there is an admissible single-impact orbit", "bool", ("order",)),
    Variable("unresolved", "the law closest to the contact has an orbit, but none was found", "bool", ("order",)),
    _ORBIT_VARIABLES[-1],
    MESSAGE,
)


def _contact_orbits(
    scene: Scene, orders: tuple[int, ...], accuracy: float, extra: Mapping[str, list[float]]
) -> Recorder:
    """Record orbits of resolved contacts, one scene at a time: how many are followed together tells in last digits."""
    nothing = {
        variable.name: np.full((1, len(orders)), math.nan if variable.dtype == "float64" else False)
        for variable in _CONTACT_ORBIT_VARIABLES[:-1]
    }

    def seen(row: dict[str, float]) -> Columns:
        try:
            one = sample_driven(scene_batch(scene, {name: np.array([value]) for name, value in row.items()}))
            found = single_contact_orbits(one, orders, accuracy=accuracy)
        except ValueError as error:
            return nothing | {MESSAGE.name: [str(error)]}
        return found | {MESSAGE.name: [""]}

    def work(columns: Columns) -> Columns:
        rows = [seen(dict(zip(columns, row, strict=True))) for row in zip(*columns.values(), strict=True)]
        return {name: np.concatenate([row[name] for row in rows]) for name in rows[0]}

    return Recorder(_CONTACT_ORBIT_VARIABLES, work, 16, extra, alone=True)


# --- collisions -------------------------------------------------------------------------------------------------------

_COLLISION_VARIABLES = (
    Variable("rebound_speed_nm_per_us", "speed away from the sample; 0 where the tip is captured"),
    Variable(
        "collision_delay_us", "time between the crossings of gap 0 by the straight paths in and out, if it leaves"
    ),
    Variable("captured", "the tip stays at the sample", "bool"),
    Variable(
        "outcome",
        "how the collision ended",
        "int8",
        flags={o.value: o.name.lower() for o in CollisionOutcome},
        sentences=tuple(o.sentence for o in CollisionOutcome),
    ),
    Variable("time_in_contact_us", "from the formation of the bridge to its breaking"),
    Variable("time_in_junction_us", "with the solids joined"),
    Variable("deepest_gap_nm", "smallest gap"),
    Variable("bridge_hysteresis_aj", "energy that the bridge takes"),
    Variable("junction_hysteresis_aj", "energy that the junction takes"),
    Variable("viscous_loss_aj", "energy that viscosity takes"),
)


def _collisions(
    scene: Scene, paths: tuple[str, ...], *, approach_speed_nm_per_us: float, accuracy: float = 1e-9
) -> Recorder:
    """Record collisions of free tips with the contacts of scenes."""
    if not isinstance(scene.interaction, Contact):
        raise TypeError("'collide' is about a resolved contact: the scene needs model = \"contact\"")
    made = _scenes(scene, paths)

    def record(columns: Columns) -> dict[str, Array]:
        count = len(next(iter(columns.values())))
        speeds = jnp.broadcast_to(columns.get(APPROACH_SPEED, approach_speed_nm_per_us), (count,))
        scenes = made(columns)
        found = collide(scenes.interaction, speeds, scenes.cantilever.mass_ng, accuracy=accuracy)
        trusted = found.outcome <= CollisionOutcome.CAPTURED_BY_JUNCTION

        def known(variable: Variable) -> Array:
            part, exists = getattr(found, variable.name), trusted
            if variable.name in ONLY_FREE and variable.name != "rebound_speed_nm_per_us":
                exists &= ~found.captured
            return jnp.where(exists, part, jnp.nan) if variable.dtype == "float64" else part

        return {variable.name: known(variable) for variable in _COLLISION_VARIABLES}

    return Recorder(_COLLISION_VARIABLES, over_devices(record), 16384)


# --- Lyapunov exponents -----------------------------------------------------------------------------------------------

_CONTACTS = 16
"""Motions with a resolved contact that are followed together."""
_EXPONENTS = ("exponents_per_impact", "exponents_per_us", "exponents_per_impact_error", "exponents_per_us_error")
_EXPONENT_VARIABLES = (
    Variable("exponents_per_impact", "Lyapunov exponents, larger first", dimensions=("exponent",), unit="1"),
    Variable("exponents_per_us", "the same in time", dimensions=("exponent",)),
    Variable("exponents_per_impact_error", "their standard errors", dimensions=("exponent",), unit="1"),
    Variable("exponents_per_us_error", "their standard errors", dimensions=("exponent",)),
    Variable("impacts", "how many the means are over", "int64"),
    Variable("kind", "what the motion has come to", "int8", flags={k.value: k.name.lower() for k in MotionKind}),
    Variable("orbit_impacts", "impacts of the orbit, 0 where there is none", "int32"),
    Variable("orbit_periods", "drive periods of the orbit, 0 where there is none", "int32"),
)


def _lyapunov(
    scene: Scene, paths: tuple[str, ...], *, impacts: int, transient: int, accuracy: float = DEFAULT_ACCURACY
) -> Recorder:
    """Record the exponents of motions that begin as in `bouncing_tips`."""
    sample_driven(scene)
    resolved = isinstance(scene.interaction, Contact)
    lanes = _CONTACTS if resolved else LANES
    made = jax.jit(_scenes(scene, paths))
    beyond = _beyond(scene, "the last impacts come")

    def work(columns: Columns) -> Columns:
        count = len(next(iter(columns.values())))
        # always as many lanes, so that there is one shape of every program
        width = lanes * -(-count // lanes)
        whole = {name: jnp.asarray(filled(column, width)) for name, column in columns.items()}
        found = lyapunov_spectrum(made(whole), impacts=impacts, transient=transient, accuracy=accuracy)
        verdicts = found.verdicts
        known = {name: getattr(found, name) for name in (*_EXPONENTS, "impacts")}
        known |= {"kind": verdicts.kind, "orbit_impacts": verdicts.impacts, "orbit_periods": verdicts.periods}
        if beyond:
            known[EXTRAPOLATED] = np.asarray(scene.interaction.extrapolated(found.approach_speed_nm_per_us)).any(axis=1)
        return {name: np.asarray(part)[:count] for name, part in known.items()}

    points = _CONTACTS if resolved else 4 * LANES
    return Recorder((*_EXPONENT_VARIABLES, *beyond), work, points, {"exponent": [1.0, 2.0]}, alone=resolved)


# --- simulations ------------------------------------------------------------------------------------------------------

_OBSERVED = {observable.name: observable.meaning for observable in OBSERVABLES}
_REFUSED = -1
_SIMULATION_VARIABLES = (
    *(Variable(name, meaning) for name, meaning in _OBSERVED.items()),
    Variable("settled", "the motion repeats", "bool"),
    Variable("stuck", "the sample holds the tip", "bool"),
    Variable("order", "drive periods of a repetition, 0 where nothing repeats", "int32"),
    Variable("contacts_per_response", "contacts of a repetition, 0 where nothing repeats", "int32"),
    Variable("impacts", "contacts in all", "int64"),
    Variable(
        "outcome",
        "how the simulation ended",
        "int8",
        flags={_REFUSED: "not_possible"} | {o.value: o.name.lower() for o in MotionOutcome},
    ),
    MESSAGE,
)


def _simulation(
    scene: Scene, paths: tuple[str, ...], *, periods: float, accuracy: float = 1e-9, start: Start | None = None
) -> Recorder:
    """Record what an experiment reads of scenes in time, followed until they settle or for some drive periods."""
    family = scene_family(scene, *paths)
    variables = (*_SIMULATION_VARIABLES, *_beyond(scene, "impacts come"))

    def work(columns: Columns) -> Columns:
        rows = zip(*(columns[path] for path in paths), strict=True)
        seen = [_seen(family(*row), periods, accuracy, start) for row in rows]
        return {variable.name: [each[variable.name] for each in seen] for variable in variables}

    return Recorder(variables, work, 16, alone=True)


def _seen(scene: Scene, periods: float, accuracy: float, start: Start | None) -> dict[str, Any]:
    """Return what is recorded of one scene; NaN where nothing is known, and of a motion that cannot be."""
    nothing = dict.fromkeys(_OBSERVED, math.nan) | dict.fromkeys(("settled", "stuck", EXTRAPOLATED), False)
    nothing |= dict.fromkeys(("order", "contacts_per_response", "impacts"), 0) | {MESSAGE.name: ""}
    try:
        longest = periods * drive_of(scene).period_us
        run = follow_long(scene, start_of(scene, start), longest, until_settled=True, accuracy=accuracy)
    except ValueError as error:
        return nothing | {"outcome": _REFUSED, MESSAGE.name: str(error)}
    found, verdict = run.simulation, run.verdict
    outcome = MotionOutcome(int(found.outcome))
    told = {
        "settled": verdict.settled,
        "stuck": verdict.stuck,
        "order": verdict.periods or 0,
        "contacts_per_response": verdict.contacts or 0,
        "impacts": int(found.count),
        "outcome": int(outcome),
        EXTRAPOLATED: extrapolation_of(scene.interaction, found.contacts.approach_speed_nm_per_us) is not None,
    }
    if outcome not in (MotionOutcome.FINISHED, MotionOutcome.HELD):
        return nothing | told | {MESSAGE.name: outcome.sentence}
    seen = observe(scene, found, verdict=verdict)
    values = {name: getattr(seen, name) for name in _OBSERVED}
    told |= {} if seen.window.responses else {MESSAGE.name: TOO_SHORT}
    return nothing | {name: value for name, value in values.items() if value is not None} | told


_RECORDERS: dict[str, tuple[Callable[..., Recorder], dict[str, Any]]] = {
    "orbits": (_orbits, {"orders": (1,)}),
    "collide": (_collisions, {APPROACH_SPEED: 30.0}),
    "lyapunov": (_lyapunov, {"impacts": 2000, "transient": 500}),
    "simulation": (_simulation, {"periods": 2000.0}),
}
"""What can be recorded of scenes, each with its settings and their usual values."""
