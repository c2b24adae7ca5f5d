"""What a sweep is: its whole input, its axes, what it records, and how it is cut into chunks.

A chunk is a block of the grid of axes; what is in it depends on the input and its number alone, whoever computes it.
"""

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any

import jax
import numpy as np

from afm_jax.results import unit_of as unit_of_field
from afm_jax.strict_json import strict_json
from afm_jax.sweeps.axes import Axis, axes_of, dimension_of
from afm_jax.version import version_of

_PACKAGES = ("afm-jax", "jax", "jaxlib", "numpy", "scipy")
_NAMED = {"epsilon": "nm2/us2", "viscous_loss": "nm/us", "hertz": "us (nm/us)^(1/5)"}
"""Units of parameters whose names do not say them."""

Columns = dict[str, Any]
"""Arrays of one row a point, by name; JAX's or NumPy's."""


@dataclass(frozen=True)
class Variable:
    """One of the things that a sweep records of every point.

    Attributes:
        name: with its unit.
        meaning: in words.
        dtype: of the numbers, or "string"; floats are NaN where there is nothing.
        dimensions: besides those of the axes.
        unit: None: as the name says.
        flags: for integers that are codes, what each means.
        sentences: the same in whole sentences, in their order.
    """

    name: str
    meaning: str
    dtype: str = "float64"
    dimensions: tuple[str, ...] = ()
    unit: str | None = None
    flags: Mapping[int, str] = field(default_factory=dict)
    sentences: tuple[str, ...] = ()

    def attributes(self) -> dict[str, Any]:
        """Return unit and meaning as attributes of the CF conventions."""
        found: dict[str, Any] = {"long_name": self.meaning}
        if self.dtype == "float64":
            found["units"] = unit_of(self.name) if self.unit is None else self.unit
        if self.flags:
            found |= {"flag_values": list(self.flags), "flag_meanings": " ".join(self.flags.values())}
        if self.sentences:
            found["flag_sentences"] = list(self.sentences)
        return found


MESSAGE = Variable("message", "why there is no result, or none to be trusted; empty where there is one", "string")


@dataclass(frozen=True)
class Recorder:
    """What a sweep does at its points.

    Attributes:
        variables: what it records, the most telling first.
        work: from columns of parameters to columns of results, one row a point.
        points: of a chunk, unless told otherwise: some tenths of a second of work at least.
        extra: values of dimensions besides the axes.
        labels: attributes of axes' coordinates, by parameter.
        alone: whether a point is computed by itself, on one core: several processes are needed to use several.
    """

    variables: tuple[Variable, ...]
    work: Callable[[Columns], Columns]
    points: int
    extra: Mapping[str, Sequence[float]] = field(default_factory=dict)
    labels: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    alone: bool = False


def unit_of(name: str) -> str:
    """Return the unit that a name says; "1" for a number.

    >>> unit_of("platform.offset_nm"), unit_of("interaction.r")
    ('nm', '1')
    """
    plain = name.rpartition(".")[2].removesuffix("_error")
    named = next((unit for ending, unit in _NAMED.items() if plain.endswith(ending)), "")
    return named or unit_of_field(plain).replace("^", "") or "1"


def versions() -> dict[str, str]:
    """Return the versions on which results depend, and the kind of device."""
    return {package: version_of(package) for package in _PACKAGES} | {"device": jax.default_backend()}


@dataclass(frozen=True)
class SweepPlan:
    """A sweep that can be computed.

    Attributes:
        given: the whole input, as JSON has it: `builder` (what makes the recorder, "module:function"), `axes`, `chunk`
            (points of one, or None), `versions` and what the builder takes.
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
    def points(self) -> int:
        """Points of the grid."""
        return math.prod(self.shape)

    @property
    def block(self) -> tuple[int, ...]:
        """Shape of a chunk; those at the ends of the axes may be smaller."""
        left = self.given["chunk"] or self.recorder.points
        sizes = []
        for size in reversed(self.shape):
            sizes.append(min(size, left))
            left = max(left // sizes[-1], 1)
        return tuple(reversed(sizes))

    @property
    def grid(self) -> tuple[int, ...]:
        """Chunks along each axis."""
        return tuple(-(-size // part) for size, part in zip(self.shape, self.block, strict=True))

    @property
    def chunks(self) -> int:
        """How many chunks there are."""
        return math.prod(self.grid)

    def place(self, chunk: int) -> tuple[int, ...]:
        """Return where in the grid of chunks one lies."""
        return tuple(int(index) for index in np.unravel_index(chunk, self.grid))

    def region(self, chunk: int) -> tuple[slice, ...]:
        """Return which part of the results a chunk is."""
        sides = zip(self.place(chunk), self.block, self.shape, strict=True)
        return tuple(slice(at * part, min((at + 1) * part, size)) for at, part, size in sides)

    def compute(self, chunk: int) -> Columns:
        """Return the results of a chunk, arrays of its shape with the recorder's own dimensions behind."""
        region = self.region(chunk)
        sides = tuple(part.stop - part.start for part in region)
        columns: Columns = {}
        for number, (axis, part) in enumerate(zip(self.axes, region, strict=True)):
            along = [1] * len(sides)
            along[number] = sides[number]
            for name, values in axis.columns.items():
                one = values(part.start, part.stop).reshape(along)
                columns[name] = np.broadcast_to(one, sides).ravel()
        # a worker has JAX's usual precision, whatever its caller has said
        with jax.enable_x64(True):  # noqa: FBT003
            found = self.recorder.work(columns)
        return {
            variable.name: np.asarray(
                found[variable.name], object if variable.dtype == "string" else variable.dtype
            ).reshape((*sides, *(len(self.recorder.extra[name]) for name in variable.dimensions)))
            for variable in self.recorder.variables
        }


def plan_of(given: Mapping[str, Any]) -> SweepPlan:
    """Return the plan of an input, complete but for the versions, which are this process's.

    Raises:
        ValueError: if it is none.
    """
    whole = json.loads(strict_json({"chunk": None, **given, "versions": versions()}))
    chunk = whole["chunk"]
    if chunk is not None and (isinstance(chunk, bool) or not isinstance(chunk, int) or chunk < 1):
        raise ValueError(f"`chunk` must be a positive whole number of points, but is {chunk!r}")
    axes = axes_of(whole["axes"])
    module, function = whole["builder"].split(":")
    recorder = getattr(import_module(module), function)(whole, axes)
    taken = [*recorder.extra, *(variable.name for variable in recorder.variables)]
    for axis in axes:
        if axis.dimension in taken or any(dimension_of(name) in taken for name in axis.columns):
            raise ValueError(f"the axis {axis.dimension} has the name of something that is recorded")
    return SweepPlan(whole, axes, recorder)


def plan_of_worker(text: str) -> SweepPlan:
    """Return the plan for a process that knows nothing but its input, `SweepPlan.given` as JSON.

    Raises:
        RuntimeError: if this process would compute otherwise than the one that asks.
    """
    from afm_jax.compilation_cache import open_cache, silence_xla  # noqa: PLC0415

    silence_xla()
    open_cache()
    given = json.loads(text)
    with jax.enable_x64(True):  # noqa: FBT003
        plan = plan_of(given)
    changes = [
        f"{name} is {own}, not {given['versions'][name]}"
        for name, own in plan.given["versions"].items()
        if own != given["versions"][name]
    ]
    if changes:
        raise RuntimeError(f"a worker would compute otherwise than the others: {'; '.join(changes)}")
    return plan
