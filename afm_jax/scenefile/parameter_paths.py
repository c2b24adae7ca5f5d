"""Parameters of a scene by their paths in its file: ranges of them as text, and scenes with other values of them.

Takes texts and values in the units of the scene file; gives scenes.

`platform.reduced_frequency=0.4:4.4:1000` is a path and a range. A path names a number of the scene file, or the reduced
frequency omega/2 Omega of a drive; where the cantilever's frequency changes, the drives keep theirs in kHz. What base
or force make of the free tip, `force.free_amplitude_nm`, sets their amplitude, which stays when other numbers change.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import reduce
from operator import getitem
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Float

from afm_jax.apparatus.scene import Scene
from afm_jax.apparatus.surface import drive_per_free_height
from afm_jax.checks import checked, is_traced
from afm_jax.scenefile.scenefile import scene_of_tables, scene_tables
from afm_jax.words import nearest_name

_MOST_VALUES = 10_000_000
UNKNOWN = "interaction.unknown_"
"""Begins the paths of the unknowns of a law that is known with errors, numbered from 1, in standard deviations."""


class ParameterRange(NamedTuple):
    """Values of a parameter of a scene from ``low`` to ``high``, in the file's unit; ``number`` of them, if counted."""

    path: str
    low: float
    high: float
    number: int | None = None

    @property
    def values(self) -> Float[np.ndarray, " number"]:
        """The values, evenly spaced, both ends among them."""
        return np.linspace(self.low, self.high, self.number or 2)

    def __str__(self) -> str:
        counted = "" if self.number is None else f":{self.number}"
        return f"{self.path}={self.low:g}:{self.high:g}{counted}"


def parse_range(text: str | ParameterRange, *, counted: bool) -> ParameterRange:
    """Return the range that a text says, the same for options of commands and arguments of functions.

    >>> parse_range("platform.offset_nm=-2:2:5", counted=True).values.tolist()
    [-2.0, -1.0, 0.0, 1.0, 2.0]

    Args:
        text: `path=low:high`, with `:count` behind it if counted; or a range already.
        counted: whether the range is that of a number of values, or everything between its ends.

    Raises:
        ValueError: if it says no rising range, or less than two values of one.
    """
    if isinstance(text, ParameterRange):
        return text
    shape = "PARAMETER=low:high:count" if counted else "PARAMETER=low:high"
    example = f"platform.reduced_frequency=0.9:1.1{':100' if counted else ''}"
    path, _, rest = text.partition("=")
    try:
        low, high = map(float, rest.split(":")[:2])
        count = [int(part) for part in rest.split(":")[2:]]
    except ValueError:
        low, high, count = math.nan, math.nan, []
    if not path.strip() or not -math.inf < low < high < math.inf or len(count) != counted:
        raise ValueError(f"`{text}` is no rising range of a parameter; write {shape} as in {example}")
    if counted and not 2 <= count[0] <= _MOST_VALUES:
        raise ValueError(f"`{text}`: the number of values must be from 2 to {_MOST_VALUES}, but is {count[0]}")
    return ParameterRange(path.strip(), low, high, *count)


def parameter_values(scene: Scene) -> dict[str, float]:
    """Return the parameters that a scene has, by their paths, with their values.

    Args:
        scene: one scene, its numbers known.

    Raises:
        ValueError: if it is none that a file can hold.
    """
    values: dict[str, float] = {}
    for table, contents in scene_tables(scene).items():
        inner = {f"{table}.{key}": part for key, part in contents.items() if isinstance(part, dict) and key != "table"}
        for name, numbers in {table: contents, **inner}.items():
            values |= {f"{name}.{key}": value for key, value in numbers.items() if isinstance(value, float)}
    # of a law with errors, in standard deviations
    unknowns = getattr(scene.interaction, "unknowns", 0)
    values |= {f"{UNKNOWN}{number}": 0.0 for number in range(1, unknowns + 1)}
    free = float(scene.cantilever.frequency_khz)
    for path in [path for path in values if path.endswith(".frequency_khz") and not path.startswith("cantilever")]:
        values[path.replace("frequency_khz", "reduced_frequency")] = values[path] / (2.0 * free)
    for name, drive in (("base", scene.base), ("force", scene.force)):
        if drive is not None:
            per_free = float(drive_per_free_height(scene.cantilever, drive.frequency_khz, type(drive)))
            if per_free > 0.0:
                values[f"{name}.free_amplitude_nm"] = float(drive.tones[0].amplitude) / per_free
    return values


def check_ranges(scene: Scene, *ranges: ParameterRange) -> None:
    """Check that a scene has the parameters of some ranges, each once, and that it can be at their ends.

    Raises:
        ValueError: if not; one line that names what exists, or what is wrong with an end.
    """
    _check_paths(scene, [given.path for given in ranges])
    places = [_leaf_path(given.path) for given in ranges]
    if len(set(places)) < len(places):
        raise ValueError(f"the ranges {' and '.join(map(str, ranges))} change the same parameter: give two different")
    for given in ranges:
        for end in (given.low, given.high):
            with_numbers(scene, {given.path: end}, str(given))


def _check_paths(scene: Scene, paths: Sequence[str]) -> None:
    existing = parameter_values(scene)
    for path in paths:
        if path not in existing:
            nearest = nearest_name(path, existing)
            meant = f"did you mean {nearest}? " if nearest else ""
            raise ValueError(f"the scene has no parameter `{path}`; {meant}it has {', '.join(existing)}")


def _leaf_path(path: str) -> str:
    path = path.replace("reduced_frequency", "frequency_khz")
    return path.replace("free_amplitude_nm", "amplitude_nn" if path.startswith("force") else "amplitude_nm")


@checked
def scene_family(scene: Scene, *paths: str) -> Callable[..., Scene]:
    """Return the function from values of some parameters to the scene that has them, differentiable and for `vmap`.

    >>> from afm_jax import Cantilever, ImpactLaw, Platform
    >>> with jax.enable_x64(True):
    ...     scene = Scene(Cantilever(90.0), Platform(2.0, 180.0), ImpactLaw(0.9))
    ...     scene_family(scene, "platform.reduced_frequency", "interaction.r")(1.5, 0.8).platform.frequency_khz.item()
    270.0

    Args:
        scene: one scene, its numbers known.
        paths: of parameters that it has (`check_ranges`).

    Raises:
        ValueError: if the scene lacks one, with what it has.
    """
    _check_paths(scene, paths)
    if len(set(paths)) < len(paths):
        raise ValueError(f"a parameter is named twice: {', '.join(paths)}")

    def at(*values: ArrayLike) -> Scene:
        if len(values) != len(paths):
            raise TypeError(f"there are {len(values)} values for {len(paths)} parameters: {', '.join(paths)}")
        return with_numbers(scene, dict(zip(paths, values, strict=True)))

    return at


def scene_batch(scene: Scene, values: Mapping[str, ArrayLike]) -> Scene:
    """Return scenes with columns of values of some parameters, as a batch: every number has the columns' shape.

    Args:
        scene: one scene, its numbers known.
        values: for every path one value a scene, arrays of one length.

    Raises:
        ValueError: if the scene lacks a parameter.
    """
    # operation by operation, which JAX knows again: a program of a new function would be compiled at every call
    return batch_family(scene, tuple(values))(values)


def batch_family(scene: Scene, paths: Sequence[str]) -> Callable[[Mapping[str, ArrayLike]], Scene]:
    """Return a function from columns of parameters to a batch of scenes; programs call it, and it is made before.

    Arguments and errors are as of `scene_family`.
    """
    family = scene_family(scene, *paths)
    return lambda values: jax.vmap(family)(*(jnp.asarray(values[path], float) for path in paths))


def with_numbers(scene: Scene, values: Mapping[str, ArrayLike], source: str = "the scene") -> Scene:
    """Return a scene with some of its numbers replaced, by their paths: that of its tables with other numbers in them.

    Args:
        scene: one scene; its numbers may be traced.
        values: by path; the new numbers may be traced.
        source: what an error calls their origin.

    Raises:
        SceneError: if a number that is known is impossible.
    """
    interaction = scene.interaction
    unknowns = [path for path in values if path.startswith(UNKNOWN)]
    if unknowns:
        steps = jnp.zeros(interaction.unknowns)
        for path in unknowns:
            steps = steps.at[int(path.removeprefix(UNKNOWN)) - 1].set(values[path])
        interaction = interaction.moved(steps)
    own = [path for path in values if path.startswith("interaction.") and path not in unknowns]
    tables: Any = scene_tables(scene if own else replace(scene, interaction=None))
    if _rests(scene) and not any(_leaf_path(path) in _PLATFORM_MOVES for path in values):
        # its phase counts in the drive that moves
        del tables["platform"]["frequency_khz"]
    for path in (path for path in values if path not in unknowns):
        *parts, key = path.split(".")
        table = reduce(getitem, parts, tables)
        table.pop(_leaf_path(path).rpartition(".")[2], None)
        table[key] = values[path]
    made = scene_of_tables(tables, source)
    return made if own else replace(made, interaction=interaction)


_PLATFORM_MOVES = ("platform.amplitude_nm", "platform.frequency_khz")


def _rests(scene: Scene) -> bool:
    """Say whether the platform is known to rest while something else moves."""
    amplitude = scene.platform.amplitude_nm
    alone = (scene.base or scene.force) is None or scene.platform.second is not None
    return not alone and not is_traced(amplitude) and not np.any(np.asarray(amplitude))
