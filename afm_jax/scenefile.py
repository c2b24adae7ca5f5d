"""Scenes as TOML files, in and out; the loop is exact.

```toml
[cantilever]
frequency_khz = 90
quality_factor = 40          # leave out: no air damping
mass_ng = 1
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
amplitude_nn = 0.5
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
"jkr"]` (all of them if left out) and any of the parameters in `CONTACT_RANGES`; the paper's values if left out.
With [base] or [force] the platform may rest: without `amplitude_nm` and frequency its phase counts in the drive's.
"""

import os
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tomli_w

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.scene import Scene
from afm_jax.impact.law import CollisionDelay, ImpactLaw
from afm_jax.scenefile_drives import drive_tables, number_of, numbers_of, read_drives
from afm_jax.scenefile_keys import CONTACT_RANGES, INNER_TABLES, KEYS, MODELS, TABLES, advise_table
from afm_jax.scenefile_start import Start, check_start
from afm_jax.scenefile_table import SceneError, SceneTable, in_words, printable

if TYPE_CHECKING:
    from afm_jax.contact.contact import Contact

__all__ = [
    "SceneError",
    "Start",
    "load_scene",
    "load_scene_and_start",
    "load_start",
    "save_scene",
    "scene_tables",
]


def load_scene(path: str | os.PathLike[str]) -> Scene:
    """Return the scene that a TOML file describes.

    Args:
        path: the file.

    Raises:
        SceneError: if the file cannot be read, a table, key, type or value in it is wrong, or its contact has no
            junction; the message names the place and says how to mend it.
    """
    return load_scene_and_start(path)[0]


def load_start(path: str | os.PathLike[str]) -> Start | None:
    """Return the start that a scene file asks for, or None where it leaves the choice to the simulation.

    Raises:
        SceneError: if the file is not a valid scene file.
    """
    return load_scene_and_start(path)[1]


def load_scene_and_start(path: str | os.PathLike[str]) -> tuple[Scene, Start | None]:
    """Return what `load_scene` and `load_start` return, from one reading of the file."""
    tables = _tables(path)
    scene = _scene_of(tables)
    return scene, _start_of(tables, scene)


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
    if start is not None:
        check_start(start, scene)
        tables["start"] = {key: float(value) for key, value in start._asdict().items()}
    Path(path).write_bytes(tomli_w.dumps(tables).encode("utf-8"))


def scene_tables(scene: Scene) -> dict[str, dict[str, Any]]:
    """Return a scene as the tables of its file, dicts of numbers; what is absent is left out.

    Raises:
        TypeError: if the interaction is neither an impact law nor a contact nor None.
        ValueError: if the scene is a batch of scenes, or its contact or its drives are none that a file can hold.
    """
    return {
        "cantilever": numbers_of(scene.cantilever, "cantilever"),
        **drive_tables(scene),
        "interaction": _interaction_table(scene.interaction),
    }


def _interaction_table(interaction: Any) -> dict[str, Any]:
    if interaction is None:
        return {"model": "none"}
    return _law_table(interaction) if isinstance(interaction, ImpactLaw) else _contact_table(interaction)


def _law_table(law: ImpactLaw) -> dict[str, Any]:
    table = {"model": "law", **numbers_of(law, "interaction")}
    if law.delay is not None:
        table["delay"] = numbers_of(law.delay, "interaction.delay")
        if not law.delay.corrections:
            table["delay"]["corrections"] = False
    return table


def _contact_table(contact: Any) -> dict[str, Any]:
    # only here, so that scenes with a law do without the contact's modules
    from afm_jax.contact.contact import EFFECTS, Contact  # noqa: PLC0415
    from afm_jax.scenefile_contact import contact_parameters  # noqa: PLC0415

    if not isinstance(contact, Contact):
        raise TypeError(f"a scene file holds an ImpactLaw or a Contact as interaction, not {type(contact).__name__}")
    numbers = {key: number_of(value, key) for key, value in contact_parameters(contact).items()}
    return {"model": "contact", "effects": [name for name in EFFECTS if name in contact.effects], **numbers}


def _tables(path: str | os.PathLike[str]) -> dict[str, SceneTable]:
    """Read a file and check the names of its tables and keys."""
    source = os.fspath(path)
    contents = _parsed(source)
    for name, value in contents.items():
        if name not in TABLES:
            message = advise_table(name, is_table=isinstance(value, dict))
            raise SceneError(f"{printable(source)}: {printable(name)}: {message}")
    tables = {name: _table(source, name, value) for name, value in contents.items()}
    for name in ("cantilever", "platform", "interaction"):
        if name not in tables:
            keys = ", ".join(key for key in KEYS[name] if f"{name}.{key}" not in INNER_TABLES)
            raise SceneError(f"{printable(source)}: [{name}] is missing; add it with {keys}")
    model = _model_of(tables["interaction"])
    tables["interaction"] = tables["interaction"]._replace(model=model)
    for name in INNER_TABLES:
        outer, _, key = name.partition(".")
        if outer in tables and key in tables[outer].values and (outer != "interaction" or model == "law"):
            tables[name] = _table(source, name, tables[outer].values[key])
    for table in tables.values():
        table.check_keys()
    return tables


def _parsed(source: str) -> dict[str, Any]:
    where = printable(source)
    try:
        # a byte order mark, as some editors write, is no part of the text
        text = Path(source).read_bytes().decode("utf-8-sig")
    except FileNotFoundError as error:
        raise SceneError(f"{where}: there is no such file") from error
    except OSError as error:
        raise SceneError(f"{where}: cannot be read ({error.strerror})") from error
    except UnicodeDecodeError as error:
        line = error.object[: error.start].count(b"\n") + 1
        raise SceneError(f"{where}: line {line} is not UTF-8 text; save the file as UTF-8") from error
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise SceneError(f"{where}: not TOML: {' '.join(str(error).split())}") from error


def _table(source: str, name: str, value: Any) -> SceneTable:
    if not isinstance(value, dict):
        raise SceneError(f"{printable(source)}: {name} must be a table, [{name}], but is {in_words(value)}")
    return SceneTable(source, name, value)


def _model_of(table: SceneTable) -> str:
    """Return the model, looked at first: it decides which keys are known."""
    model = table.values.get("model")
    if model is None:
        table.fail('missing; add model = "law" or model = "contact", or model = "none" for a free cantilever', "model")
    if model not in MODELS:
        table.fail('must be "law" or "contact", or "none" for a free cantilever', "model")
    return model


def _scene_of(tables: dict[str, SceneTable]) -> Scene:
    table = tables["cantilever"]
    numbers = table.numbers(required=("frequency_khz",), optional=("quality_factor", "mass_ng"))
    cantilever = table.build(Cantilever, **numbers)
    platform, base, force = read_drives(tables, cantilever)
    return Scene(cantilever, platform, _interaction_of(tables), base, force)


def _interaction_of(tables: dict[str, SceneTable]) -> Any:
    table = tables["interaction"]
    if table.model == "none":
        return None
    if table.model == "contact":
        return _contact_of(table)
    law = table.numbers(required=("r",), optional=("epsilon", "viscous_loss"))
    return table.build(ImpactLaw, **law, delay=_delay_of(tables.get("interaction.delay")))


def _contact_of(table: SceneTable) -> "Contact":
    # only here, so that scenes with a law do without the contact's modules
    from afm_jax.contact.contact import EFFECTS  # noqa: PLC0415
    from afm_jax.scenefile_contact import make_contact  # noqa: PLC0415

    effects = table.texts("effects")
    numbers = table.numbers(optional=tuple(CONTACT_RANGES))
    return table.build(make_contact, EFFECTS if effects is None else effects, numbers)


def _delay_of(table: SceneTable | None) -> CollisionDelay | None:
    if table is None:
        return None
    numbers = table.numbers(required=tuple(key for key in KEYS["interaction.delay"] if key != "corrections"))
    return table.build(CollisionDelay, **numbers, corrections=table.truth("corrections", usual=True))


def _start_of(tables: dict[str, SceneTable], scene: Scene) -> Start | None:
    table = tables.get("start")
    if table is None:
        return None
    start = Start(**table.numbers(required=KEYS["start"]))
    table.build(check_start, start, scene)
    return start
