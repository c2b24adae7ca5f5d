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
[interaction]
model = "law"                # or "contact"
r = 0.998
epsilon = 122                # nm^2/us^2
viscous_loss = 0             # nm/us
[interaction.delay]          # leave out: instantaneous impacts
hertz = 0.206
lead_nm = 5.64
offset_nm = 0.726
[start]                      # leave out: the simulation chooses
phase_deg = 270
height_above_platform_nm = 5
velocity_nm_per_us = 80
```

A resolved contact instead of a law: `model = "contact"`, `effects = ["capillary", "structural", "core", "viscous",
"jkr"]` (all of them if left out) and any of the parameters in `CONTACT_RANGES`; the paper's values if left out.
"""

import os
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import tomli_w
from jaxtyping import ArrayLike

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.impact.law import CollisionDelay, ImpactLaw
from afm_jax.parameters import check_parameter
from afm_jax.scenefile_keys import CONTACT_RANGES, KEYS, advise_table
from afm_jax.scenefile_table import SceneError, SceneTable, in_words, printable

if TYPE_CHECKING:
    from afm_jax.contact.contact import Contact


class Start(NamedTuple):
    """Where a simulation begins: `phase_deg` of the drive, height above the platform, velocity in the lab."""

    phase_deg: float
    height_above_platform_nm: float
    velocity_nm_per_us: float


def load_scene(path: str | os.PathLike[str]) -> Scene:
    """Return the scene that a TOML file describes.

    Args:
        path: the file.

    Raises:
        SceneError: if the file cannot be read, a table, key, type or value in it is wrong, or its contact has no
            junction; the message names the place and says how to mend it.
    """
    return _scene_of(_tables(path))


def load_start(path: str | os.PathLike[str]) -> Start | None:
    """Return the start that a scene file asks for, or None where it leaves the choice to the simulation.

    Raises:
        SceneError: if the file is not a valid scene file.
    """
    tables = _tables(path)
    _scene_of(tables)
    return _start_of(tables)


def save_scene(scene: Scene, path: str | os.PathLike[str], *, start: Start | None = None) -> None:
    """Write a scene, and a start if there is one, to a TOML file from which `load_scene` returns an equal scene.

    The file names a contact's effects in the paper's order, whatever the order of its forces.

    Raises:
        OSError: if the file cannot be written.
        TypeError: if the interaction is neither an impact law nor a contact.
        ValueError: if the scene is a batch of scenes, or its contact has what the format has no key for.
    """
    tables = scene_tables(scene)
    if start is not None:
        tables["start"] = {key: float(value) for key, value in start._asdict().items()}
    Path(path).write_bytes(tomli_w.dumps(tables).encode("utf-8"))


def scene_tables(scene: Scene) -> dict[str, dict[str, Any]]:
    """Return a scene as the tables of its file, dicts of numbers; what is absent is left out.

    Raises:
        TypeError: if the interaction is neither an impact law nor a contact.
        ValueError: if the scene is a batch of scenes, or its contact has what the format has no key for.
    """
    law = scene.interaction
    return {
        "cantilever": _numbers_of(scene.cantilever, "cantilever"),
        "platform": _numbers_of(scene.platform, "platform"),
        "interaction": _law_table(law) if isinstance(law, ImpactLaw) else _contact_table(law),
    }


def _law_table(law: ImpactLaw) -> dict[str, Any]:
    table = {"model": "law", **_numbers_of(law, "interaction")}
    if law.delay is not None:
        table["delay"] = _numbers_of(law.delay, "interaction.delay")
    return table


def _contact_table(contact: Any) -> dict[str, Any]:
    # only here, so that scenes with a law do without the contact's modules
    from afm_jax.contact.contact import EFFECTS, Contact  # noqa: PLC0415
    from afm_jax.scenefile_contact import contact_parameters  # noqa: PLC0415

    if not isinstance(contact, Contact):
        raise TypeError(f"a scene file holds an ImpactLaw or a Contact as interaction, not {type(contact).__name__}")
    numbers = {key: _number_of(value, key) for key, value in contact_parameters(contact).items()}
    return {"model": "contact", "effects": [name for name in EFFECTS if name in contact.effects], **numbers}


def _numbers_of(part: Cantilever | Platform | ImpactLaw | CollisionDelay, table: str) -> dict[str, Any]:
    values = {key: getattr(part, key, None) for key in KEYS[table] if key != "delay"}
    return {key: _number_of(value, key) for key, value in values.items() if value is not None}


def _number_of(value: ArrayLike, key: str) -> float:
    number = np.asarray(value)
    if number.ndim:
        raise ValueError(f"`{key}` has shape {number.shape}, but a scene file holds one scene: save them one by one")
    return float(number)


def _tables(path: str | os.PathLike[str]) -> dict[str, SceneTable]:
    """Read a file and check the names of its tables and keys."""
    source = os.fspath(path)
    contents = _parsed(source)
    for name, value in contents.items():
        if name not in ("cantilever", "platform", "interaction", "start"):
            message = advise_table(name, is_table=isinstance(value, dict))
            raise SceneError(f"{printable(source)}: {printable(name)}: {message}")
    tables = {name: _table(source, name, value) for name, value in contents.items()}
    for name in ("cantilever", "platform", "interaction"):
        if name not in tables:
            raise SceneError(f"{printable(source)}: [{name}] is missing; add it with {', '.join(KEYS[name])}")
    model = _model_of(tables["interaction"])
    tables["interaction"] = tables["interaction"]._replace(model=model)
    if model == "law" and "delay" in tables["interaction"].values:
        tables["interaction.delay"] = _table(source, "interaction.delay", tables["interaction"].values["delay"])
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
        table.fail('missing; add model = "law" or model = "contact"', "model")
    if model not in ("law", "contact"):
        table.fail('must be "law" or "contact"', "model")
    return model


def _scene_of(tables: dict[str, SceneTable]) -> Scene:
    table = tables["cantilever"]
    cantilever_numbers = table.numbers(required=("frequency_khz",), optional=("quality_factor", "mass_ng"))
    cantilever = table.build(Cantilever, **cantilever_numbers)
    platform = _platform_of(tables["platform"], cantilever_numbers["frequency_khz"])
    table = tables["interaction"]
    _start_of(tables)
    if table.model == "contact":
        return Scene(cantilever, platform, _contact_of(table))
    law = table.numbers(required=("r",), optional=("epsilon", "viscous_loss"))
    interaction = table.build(ImpactLaw, **law, delay=_delay_of(tables.get("interaction.delay")))
    return Scene(cantilever, platform, interaction)


def _contact_of(table: SceneTable) -> "Contact":
    # only here, so that scenes with a law do without the contact's modules
    from afm_jax.contact.contact import EFFECTS  # noqa: PLC0415
    from afm_jax.scenefile_contact import make_contact  # noqa: PLC0415

    effects = table.texts("effects")
    numbers = table.numbers(optional=tuple(CONTACT_RANGES))
    return table.build(make_contact, EFFECTS if effects is None else effects, numbers)


def _platform_of(table: SceneTable, free_frequency_khz: float) -> Platform:
    optional = ("frequency_khz", "reduced_frequency", "offset_nm", "offset_rate_nm_per_us")
    numbers = table.numbers(required=("amplitude_nm",), optional=optional)
    reduced = numbers.pop("reduced_frequency", None)
    if reduced is not None and "frequency_khz" in numbers:
        table.fail("has both frequency_khz and reduced_frequency; give one of them")
    if reduced is None and "frequency_khz" not in numbers:
        table.fail("the drive frequency is missing; add frequency_khz or reduced_frequency")
    if reduced is not None:
        table.build(check_parameter, "reduced_frequency", reduced, "positive")
        # omega / 2 Omega
        numbers["frequency_khz"] = 2.0 * reduced * free_frequency_khz
    return table.build(Platform, **numbers)


def _delay_of(table: SceneTable | None) -> CollisionDelay | None:
    return None if table is None else table.build(CollisionDelay, **table.numbers(required=KEYS["interaction.delay"]))


def _start_of(tables: dict[str, SceneTable]) -> Start | None:
    table = tables.get("start")
    if table is None:
        return None
    start = Start(**table.numbers(required=KEYS["start"]))
    table.build(check_parameter, "phase_deg", start.phase_deg, "finite")
    table.build(check_parameter, "height_above_platform_nm", start.height_above_platform_nm, "not negative")
    table.build(check_parameter, "velocity_nm_per_us", start.velocity_nm_per_us, "finite")
    return start
