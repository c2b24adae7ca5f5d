"""The drives of a scene file: the platform, the base and the force on the tip, each with a second frequency or not."""

from collections.abc import Mapping
from typing import Any, TypeVar

import equinox as eqx
import numpy as np
from jaxtyping import ArrayLike

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.drive import Tone
from afm_jax.apparatus.excitation import BaseDrive, ForceDrive
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.apparatus.surface import check_steady_response
from afm_jax.parameters import check_parameter
from afm_jax.scenefile_keys import KEYS
from afm_jax.scenefile_table import SceneTable

Excited = TypeVar("Excited", BaseDrive, ForceDrive)
Driven = TypeVar("Driven", Platform, BaseDrive, ForceDrive)

_SAME_FREQUENCY = 1e-12
"""Relative distance of two frequencies that only rounding makes different."""


def read_drives(
    tables: Mapping[str, SceneTable], cantilever: Cantilever
) -> tuple[Platform, BaseDrive | None, ForceDrive | None]:
    """Return what drives a scene.

    Args:
        tables: the tables of the file, their keys checked.
        cantilever: gives the unit of reduced frequencies, and may have no steady response to a drive.

    Raises:
        SceneError: if a value is missing, of a wrong type or impossible.
    """
    base = _excitation_of(tables, "base", BaseDrive, cantilever)
    force = _excitation_of(tables, "force", ForceDrive, cantilever)
    return _platform_of(tables, cantilever, base or force), base, force


def drive_tables(scene: Scene) -> dict[str, dict[str, Any]]:
    """Return the tables of a scene's drives; what is absent is left out.

    Raises:
        ValueError: if the scene is a batch of scenes, a second frequency is equal to the first, or an undamped
            cantilever is driven at its free frequency.
    """
    drives = {"platform": scene.platform, "base": scene.base, "force": scene.force}
    for name, drive in drives.items():
        if isinstance(drive, BaseDrive | ForceDrive):
            check_steady_response(scene.cantilever, drive.tones, name)
    return {name: _table_of(name, drive) for name, drive in drives.items() if drive is not None}


def numbers_of(part: eqx.Module, table: str) -> dict[str, Any]:
    """Return the numbers of a part of a scene under the keys of its table; what is absent or no number is left out.

    Raises:
        ValueError: if one is no single number.
    """
    values = {key: getattr(part, key, None) for key in KEYS[table]}
    return {
        key: number_of(value, key)
        for key, value in values.items()
        if value is not None and not isinstance(value, (eqx.Module, bool))
    }


def number_of(value: ArrayLike, key: str) -> float:
    """Return a parameter as a number.

    Raises:
        ValueError: if it is an array of numbers.
    """
    number = np.asarray(value)
    if number.ndim:
        raise ValueError(f"`{key}` has shape {number.shape}, but a scene file holds one scene: save them one by one")
    return float(number)


def _platform_of(
    tables: Mapping[str, SceneTable], cantilever: Cantilever, excitation: BaseDrive | ForceDrive | None
) -> Platform:
    """Return the platform; a resting one under another drive takes that drive's frequency if it has none of its own."""
    table = tables["platform"]
    may_rest = excitation is not None and "platform.second" not in tables
    needed = () if may_rest else ("amplitude_nm",)
    optional = ("amplitude_nm", "frequency_khz", "reduced_frequency", "offset_nm", "offset_rate_nm_per_us")
    numbers = {"amplitude_nm": 0.0} | table.numbers(required=needed, optional=optional)
    own_frequency = "frequency_khz" in numbers or "reduced_frequency" in numbers
    if excitation is not None and may_rest and numbers["amplitude_nm"] == 0.0 and not own_frequency:
        return table.build(Platform, **numbers, frequency_khz=excitation.frequency_khz)
    platform = table.build(Platform, **_with_frequency(table, numbers, cantilever))
    return _with_second(tables, "platform", platform, cantilever)


def _excitation_of(
    tables: Mapping[str, SceneTable], name: str, kind: type[Excited], cantilever: Cantilever
) -> Excited | None:
    table = tables.get(name)
    if table is None:
        return None
    numbers = table.numbers(required=(_amplitude(name),), optional=("frequency_khz", "reduced_frequency", "phase_deg"))
    drive = table.build(kind, **_with_frequency(table, numbers, cantilever))
    drive = _with_second(tables, name, drive, cantilever)
    table.build(check_steady_response, cantilever, drive.tones, name)
    return drive


def _with_second(tables: Mapping[str, SceneTable], name: str, drive: Driven, cantilever: Cantilever) -> Driven:
    """Return a drive with the second frequency that its file gives it, if any."""
    table = tables.get(f"{name}.second")
    if table is None:
        return drive
    key = _amplitude(name)
    numbers = table.numbers(required=(key,), optional=("frequency_khz", "reduced_frequency", "phase_deg"))
    table.build(check_parameter, key, numbers[key], "not negative")
    numbers = _with_frequency(table, numbers, cantilever)
    second = table.build(Tone, numbers.pop(key), **numbers)
    if _same_frequency(drive, second):
        table.fail(f"has the frequency of [{name}]; add the two up to one cosine and leave this table out")
    return eqx.tree_at(lambda drive: drive.second, drive, second, is_leaf=lambda leaf: leaf is None)


def _with_frequency(table: SceneTable, numbers: dict[str, float], cantilever: Cantilever) -> dict[str, float]:
    """Return a drive's numbers with `frequency_khz`, whichever way the table gives it."""
    reduced = numbers.get("reduced_frequency")
    if reduced is not None and "frequency_khz" in numbers:
        table.fail("has both frequency_khz and reduced_frequency; give one of them")
    if reduced is None and "frequency_khz" not in numbers:
        table.fail("the drive frequency is missing; add frequency_khz or reduced_frequency")
    if reduced is None:
        return numbers
    table.build(check_parameter, "reduced_frequency", reduced, "positive")
    others = {key: value for key, value in numbers.items() if key != "reduced_frequency"}
    # omega / 2 Omega
    return {**others, "frequency_khz": 2.0 * reduced * float(cantilever.frequency_khz)}


def _table_of(name: str, drive: Platform | BaseDrive | ForceDrive) -> dict[str, Any]:
    table = numbers_of(drive, name)
    second = drive.second
    if second is None:
        return table
    if _same_frequency(drive, second):
        raise ValueError(f"the second frequency of `{name}` is that of the first: add the two up to one cosine")
    amplitude = {_amplitude(name): number_of(second.amplitude, _amplitude(name))}
    return {**table, "second": {**amplitude, **numbers_of(second, f"{name}.second")}}


def _same_frequency(drive: Platform | BaseDrive | ForceDrive, second: Tone) -> bool:
    return bool(np.all(np.isclose(drive.frequency_khz, second.frequency_khz, rtol=_SAME_FREQUENCY, atol=0.0)))


def _amplitude(name: str) -> str:
    return "amplitude_nn" if name == "force" else "amplitude_nm"
