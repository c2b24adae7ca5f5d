"""Scenes as TOML files, in and out; the loop is exact.

Takes a path or text; gives a `Scene`, units in the names of the keys (eqs. 2, 6, 10 to 16), and writes one.

```toml
[cantilever]
frequency_khz = 90
quality_factor = 40          # leave out: no air damping
mass_ng = 1                  # or spring_constant_n_per_m, whose mass is k/Omega^2; leave both out: 1 ng
[platform]
amplitude_nm = 4
frequency_khz = 180          # or reduced_frequency = omega / 2 Omega
offset_nm = 0
offset_rate_nm_per_us = 0
[platform.second]            # leave out: one frequency; [base] and [force] may have one too
amplitude_nm = 1
frequency_khz = 33           # or reduced_frequency
phase_deg = 0
[base]                       # leave out: the cantilever's base rests
amplitude_nm = 0.1
frequency_khz = 90           # or reduced_frequency
phase_deg = 0
[force]                      # leave out: no force on the tip
amplitude_nn = 0.5           # or here and for [base] free_amplitude_nm, the amplitude of the free tip's height
frequency_khz = 90           # or reduced_frequency
phase_deg = 0
[interaction]
model = "law"                # or "contact", or "none": a free cantilever
r = 0.998
epsilon = 122                # nm^2/us^2
viscous_loss = 0             # nm/us
[interaction.delay]          # leave out: instantaneous impacts
hertz = 0.206
lead_nm = 5.64
offset_nm = 0.726
corrections = true           # false: nothing acts on the tip while the impact lasts
[start]                      # leave out: the simulation chooses
phase_deg = 270
height_above_platform_nm = 5
velocity_nm_per_us = 80
```

A resolved contact instead of a law: `model = "contact"`, `effects = ["capillary", "structural", "core", "viscous",
"jkr"]` (all of them if left out) and any of the parameters of `Contact.paper`; the paper's values if left out.
With [base] or [force] the platform may rest: without `amplitude_nm` and frequency its phase counts in the drive's.
"""

import os
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
import tomli_w
from jaxtyping import ArrayLike

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.drives import BaseDrive, ForceDrive, Tone
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene, check_mass, drive_of
from afm_jax.apparatus.surface import check_steady_response, drive_per_free_height
from afm_jax.checks import check_parameter, checked, is_traced
from afm_jax.impact.law import CollisionDelay, ImpactLaw, Law, TabulatedLaw, law_of_dict
from afm_jax.motion.record import State
from afm_jax.saved import as_json
from afm_jax.scenefile.law_files import load_law
from afm_jax.scenefile.presets import PRESETS, STARTS
from afm_jax.scenefile.tables import (
    KEYS,
    MODELS,
    TABLES,
    SceneError,
    SceneTable,
    Start,
    advise_table,
    in_words,
    read_text,
)
from afm_jax.whole_files import write_whole
from afm_jax.words import printable

MASS_ASSUMED = (
    "1 ng assumed: the file does not give the tip's mass, and all energies and speeds of a contact depend on it; give "
    "mass_ng or spring_constant_n_per_m"
)


@checked
def load_scene(path: str | os.PathLike[str]) -> Scene:
    """Return the scene that a TOML file describes, or that a preset's name means.

    Args:
        path: the file, or a name of `PRESETS` where there is no file of that name.

    Raises:
        SceneError: if the file cannot be read, a table, key, type or value in it is wrong, or its contact has no
            junction; the message names the place and says how to mend it.
    """
    return read_scene(path).scene


class SceneAsRead(NamedTuple):
    """What a scene file holds: scene and start (None: left to the simulation), and what a reader should know of it."""

    scene: Scene
    start: Start | None
    notes: tuple[str, ...]


def read_scene(path: str | os.PathLike[str]) -> SceneAsRead:
    """Return what a scene file holds, or a preset is.

    Args:
        path: the file, or a name of `PRESETS` where there is no file of that name.

    Raises:
        SceneError: as `load_scene`.
    """
    source = os.fspath(path)
    if not (Path(source).exists() or source.endswith(".toml") or len(Path(source).parts) > 1):
        if source not in PRESETS:
            raise SceneError(f"{printable(source)}: there is no such file or preset; presets are {', '.join(PRESETS)}")
        return SceneAsRead(PRESETS[source](), STARTS.get(source), ())
    tables = _checked(read_toml(source), source)
    scene = _scene_of(tables)
    stated = {"mass_ng", "spring_constant_n_per_m"} & set(tables["cantilever"].values)
    assumed = tables["interaction"].values["model"] == "contact" and not stated
    notes, table = (f"{MASS_ASSUMED} in [cantilever].",) if assumed else (), tables.get("start")
    if table is None:
        return SceneAsRead(scene, None, notes)
    start = Start(**table.numbers(*Start._fields))
    table.build(check_start, start, scene)
    return SceneAsRead(scene, start, notes)


def scene_of_tables(contents: Mapping[str, Any], source: str) -> Scene:
    """Return the scene of tables as a file holds them and `scene_tables` returns them.

    Args:
        contents: the tables.
        source: what the messages call their origin.

    Raises:
        SceneError: as `load_scene`.
    """
    return _scene_of(_checked(contents, source))


@checked
def save_scene(scene: Scene, path: str | os.PathLike[str], *, start: Start | None = None) -> None:
    """Write a scene, and a start if there is one, to a TOML file from which `load_scene` returns an equal scene.

    The file names a contact's effects in the paper's order, whatever the order of its forces.

    Raises:
        OSError: if the file cannot be written.
        TypeError: if the interaction is neither an impact law nor a contact nor None.
        ValueError: if the scene is a batch of scenes, its contact or its drives are none that a file can hold, or the
            start is impossible in it.
    """
    tables = scene_tables(scene)
    scene_of_tables(tables, "the scene")
    if start is not None:
        check_start(start, scene)
        tables["start"] = {key: float(value) for key, value in start._asdict().items()}
    write_whole(path, tomli_w.dumps(tables), named_by_user=True)


def scene_tables(scene: Scene) -> dict[str, dict[str, Any]]:
    """Return a scene as the tables of its file, dicts of numbers, traced ones too; what is absent is left out.

    Raises:
        TypeError: if the interaction is neither an impact law nor a contact nor None.
        ValueError: if the scene is a batch of scenes, or its contact is none that a file can hold.
    """
    drives = {"platform": scene.platform, "base": scene.base, "force": scene.force}
    return {
        "cantilever": _numbers_of(scene.cantilever, "cantilever"),
        **{name: _drive_table(name, drive) for name, drive in drives.items() if drive is not None},
        "interaction": _interaction_table(scene.interaction),
    }


def read_toml(source: str) -> dict[str, Any]:
    """Return the contents of a TOML file.

    Raises:
        SceneError: if it cannot be read, or is no TOML.
    """
    where, text = printable(source), read_text(source)
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise SceneError(f"{where}: not TOML: {' '.join(str(error).split())}") from error


def _checked(contents: Mapping[str, Any], source: str) -> dict[str, SceneTable]:
    """Check the names of tables and of their keys."""
    for name, value in contents.items():
        if name not in TABLES:
            message = advise_table(name, is_table=isinstance(value, dict))
            raise SceneError(f"{printable(source)}: {printable(name)}: {message}")
    tables = {name: _table(source, name, value) for name, value in {**contents, **_inner(contents)}.items()}
    for name in ("cantilever", "platform", "interaction"):
        if name not in tables:
            keys = ", ".join(key for key in KEYS[name] if f"{name}.{key}" not in KEYS)
            raise SceneError(f"{printable(source)}: [{name}] is missing; add it with {keys}")
    # looked at first: it decides which keys are known
    model = tables["interaction"].values.get("model")
    if model not in MODELS:
        tables["interaction"].fail('must be "law" or "contact", or "none" for a free cantilever', "model")
    for table in tables.values():
        table.check(model)
    return tables


def _inner(contents: Mapping[str, Any]) -> dict[str, Any]:
    """Return the tables inside others, by the names that headings give them."""
    outer = [(name, table) for name, table in contents.items() if isinstance(table, dict)]
    inside = {f"{name}.{key}": value for name, table in outer for key, value in table.items()}
    return {name: value for name, value in inside.items() if name in KEYS}


def _table(source: str, name: str, value: Any) -> SceneTable:
    if not isinstance(value, dict):
        raise SceneError(f"{printable(source)}: {name} must be a table, [{name}], but is {in_words(value)}")
    return SceneTable(source, name, value)


def _scene_of(tables: dict[str, SceneTable]) -> Scene:
    table = tables["cantilever"]
    cantilever = table.build(Cantilever, **table.numbers("frequency_khz"))
    base, force = (_drive_of(tables, name, cantilever) for name in ("base", "force"))
    platform = _drive_of(tables, "platform", cantilever, may_rest=(base or force) is not None)
    interaction = _interaction_of(tables)
    tables["interaction"].build(check_mass, interaction, cantilever)
    return tables["platform"].build(Scene, cantilever, platform, interaction, base, force)


_KINDS: dict[str, Any] = {"platform": Platform, "base": BaseDrive, "force": ForceDrive}


def _drive_of(tables: Mapping[str, SceneTable], name: str, cantilever: Cantilever, *, may_rest: bool = False) -> Any:
    """Return platform, base or force, with its second frequency if it has one; None if the file does not have it.

    Args:
        tables: of the file.
        name: of the drive's table.
        cantilever: reduced frequencies are in its unit, free amplitudes those of its tip.
        may_rest: whether it may be without amplitude and frequency, as a platform under another drive.
    """
    table, of_second = tables.get(name), tables.get(f"{name}.second")
    if table is None:
        return None
    numbers = _tone(table, name, cantilever, may_rest=may_rest and of_second is None)
    if of_second is not None:
        own = _tone(of_second, name, cantilever)
        numbers["second"] = of_second.build(Tone, own.pop(_amplitude(name)), **own)
    return table.build(_KINDS[name], **numbers)


def _tone(table: SceneTable, name: str, cantilever: Cantilever, *, may_rest: bool = False) -> dict[str, Any]:
    """Return the numbers of a drive's cosine, with its own amplitude and frequency, whichever way the table gives them.

    The amplitude may be given as that of the free tip's height, `free_amplitude_nm`, the frequency as a reduced one.
    """
    amplitude, free = _amplitude(name), "free_amplitude_nm"
    given = free if free in table.values else amplitude
    numbers = table.numbers(*(() if may_rest else (given,)))
    reduced = numbers.pop("reduced_frequency", None)
    if reduced is not None:
        table.build(check_parameter, "reduced_frequency", reduced, "positive")
        # omega / 2 Omega
        numbers["frequency_khz"] = 2.0 * reduced * cantilever.frequency_khz
    if "frequency_khz" not in numbers and not (may_rest and not numbers.get(amplitude)):
        table.fail("the drive frequency is missing; add frequency_khz or reduced_frequency")
    table.build(check_parameter, given, numbers.get(given, 0.0), "not negative")
    if name != "platform":
        tone = table.build(Tone, numbers[given], numbers["frequency_khz"])
        table.build(check_steady_response, cantilever, (tone,), name)
    if given == free:
        per_height = drive_per_free_height(cantilever, numbers["frequency_khz"], _KINDS[name])
        numbers[amplitude] = numbers.pop(free) * per_height
    return numbers


def _interaction_of(tables: dict[str, SceneTable]) -> Any:
    table = tables["interaction"]
    model = table.values["model"]
    if model == "none":
        return None
    if model == "contact":
        # only here, so that scenes with a law do without the contact's modules
        from afm_jax.contact.parameters import EFFECTS  # noqa: PLC0415
        from afm_jax.scenefile.contact import make_contact  # noqa: PLC0415

        return table.build(make_contact, table.values.get("effects", EFFECTS), table.numbers())
    source = next((key for key in ("file", "table") if key in table.values), None)
    if source is not None:
        others = [key for key in table.values if key not in ("model", source)]
        if others:
            table.fail(f"the law is that of `{source}`: leave out {', '.join(others)}")
        if source == "file":
            return table.build(load_law, Path(table.source).parent / table.values["file"])
        try:
            return table.build(law_of_dict, table.values["table"])
        except (KeyError, TypeError) as error:
            table.fail(f"is no law: {error}", "table")
    numbers, delay = table.numbers("r"), tables.get("interaction.delay")
    if delay is None:
        return table.build(ImpactLaw, **numbers)
    parameters = delay.numbers("hertz", "lead_nm", "offset_nm")
    corrections = delay.values.get("corrections", True)
    return table.build(ImpactLaw, **numbers, delay=delay.build(CollisionDelay, **parameters, corrections=corrections))


def _drive_table(name: str, drive: Platform | BaseDrive | ForceDrive) -> dict[str, Any]:
    table = _numbers_of(drive, name)
    if drive.second is not None:
        amplitude = _number_of(drive.second.amplitude, _amplitude(name))
        table["second"] = {_amplitude(name): amplitude, **_numbers_of(drive.second, f"{name}.second")}
    return table


def _amplitude(name: str) -> str:
    return "amplitude_nn" if name == "force" else "amplitude_nm"


def _interaction_table(interaction: Any) -> dict[str, Any]:
    if interaction is None:
        return {"model": "none"}
    if isinstance(interaction, TabulatedLaw):
        # a batch is refused
        _number_of(interaction.capture, "interaction")
        return {"model": "law", "table": as_json(interaction)}
    if isinstance(interaction, ImpactLaw):
        table: dict[str, Any] = {"model": "law", **_numbers_of(interaction, "interaction")}
        if interaction.delay is not None:
            table["delay"] = _numbers_of(interaction.delay, "interaction.delay")
            if not interaction.delay.corrections:
                table["delay"]["corrections"] = False
        return table
    # only here, so that scenes with a law do without the contact's modules
    from afm_jax.contact.contact import Contact  # noqa: PLC0415
    from afm_jax.contact.parameters import ALL_EFFECTS  # noqa: PLC0415
    from afm_jax.scenefile.contact import contact_parameters  # noqa: PLC0415

    if not isinstance(interaction, Contact):
        kind = type(interaction).__name__
        raise TypeError(f"a scene file holds an ImpactLaw or a Contact as interaction, not {kind}")
    numbers = {key: _number_of(value, key) for key, value in contact_parameters(interaction).items()}
    return {"model": "contact", "effects": [name for name in ALL_EFFECTS if name in interaction.effects], **numbers}


def _numbers_of(part: eqx.Module, table: str) -> dict[str, Any]:
    """Return the numbers of a part of a scene under the keys of its table; what is absent or no number is left out.

    Raises:
        ValueError: if one is no single number.
    """
    values = {key: getattr(part, key, None) for key in KEYS[table]}
    return {
        key: _number_of(value, key)
        for key, value in values.items()
        if value is not None and not isinstance(value, (eqx.Module, bool))
    }


def _number_of(value: ArrayLike, key: str) -> Any:
    """Return a parameter as a number; a traced one as it is.

    Raises:
        ValueError: if it is an array of numbers.
    """
    if is_traced(value):
        return value
    number = np.asarray(value)
    if number.ndim:
        raise ValueError(f"`{key}` has shape {number.shape}, but a scene file holds one scene: save them one by one")
    return float(number)


_TOUCHING_NM = 1e-9
"""Height of a start that is one on the surface, but for rounding."""


def check_start(start: Start, scene: Scene) -> None:
    """Check that a tip can begin at a start: outside the sample.

    Args:
        start: the start.
        scene: one scene, its numbers known.

    Raises:
        ValueError: if it cannot; says why.
    """
    for name, value in start._asdict().items():
        check_parameter(name, value, "finite")
    if scene.interaction is None:
        return
    height = start.height_above_platform_nm
    law = isinstance(scene.interaction, Law)
    # else the tip would start inside the sample; whether it starts inside a junction or sinks, `simulate` says
    if abs(height) > _TOUCHING_NM or not (law or not scene.interaction.spans):
        check_parameter("height_above_platform_nm", height, "not negative" if law else "above 0")


def as_in_file(scene: Scene, state: State) -> Start:
    """Return the start from which `start_of` makes a state again, within the drive's first period.

    Args:
        scene: one scene.
        state: time, height and velocity in the lab.
    """
    time = float(state.time_us)
    phase = 360.0 * (time / drive_of(scene).period_us)
    height = float(state.position_nm) - float(scene.platform.position(time))
    return Start(phase % 360.0, height, float(state.velocity_nm_per_us))
