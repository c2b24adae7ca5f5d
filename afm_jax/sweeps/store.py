"""Where the results of a sweep lie: a Zarr store that xarray opens alone, and beside it which chunks are done.

A chunk is done when its marker says so: a file of its own, written whole after the chunk's, with the checksums of their
bytes. A chunk without one, or whose bytes are others, is computed anew. One sweep at a time has the folder.
"""

import contextlib
import errno
import hashlib
import json
import math
import os
import shutil
import socket
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import zarr

from afm_jax.strict_json import strict_json
from afm_jax.sweeps.axes import dimension_of
from afm_jax.sweeps.plan import Columns, SweepPlan, unit_of
from afm_jax.version import __version__
from afm_jax.whole_files import write_whole

FORMAT_VERSION = 1
STORE = "sweep.zarr"
_MARKERS, _LOCK = "done", "lock"
_COMPUTED = "computed"
_SLAB = 1_000_000
"""Values of a coordinate that are written, and lie, together."""
_MOST_SHOWN = 60


class Kept(NamedTuple):
    """What there is of a sweep."""

    done: frozenset[int]
    damaged: frozenset[int]
    """Said to be done, but with other bytes than it was written with."""


class SweepStore:
    """The results of one sweep in a folder."""

    def __init__(self, folder: Path, plan: SweepPlan):
        """Take the store of a folder; see `open_store`."""
        self.folder, self.plan = folder, plan
        self._group = zarr.open_group(str(folder / STORE), mode="r+", use_consolidated=False)
        # opened once: that takes as long as a chunk's writing
        self._arrays: dict[str, zarr.Array] = {}

    def kept(self) -> Kept:
        """Return which chunks are done, every byte of them looked at."""
        done, damaged = set(), set()
        for path in (self.folder / _MARKERS).glob("*.json"):
            chunk = int(path.stem)
            try:
                sums = json.loads(path.read_bytes())
            except ValueError:
                sums = None
            (done if sums == self._sums(chunk) else damaged).add(chunk)
        return Kept(frozenset(done), frozenset(damaged))

    def write(self, chunk: int, results: Columns) -> None:
        """Write the results of a chunk, and then that it is done.

        Raises:
            OSError: if there is no room, or the folder is gone; the chunk then counts as not done.
        """
        region = self.plan.region(chunk)
        for name, part in results.items():
            self._array(name)[(*region, ...)] = part
        self._array(_COMPUTED)[region] = True
        write_whole(self._marker(chunk), strict_json(self._sums(chunk)))

    def size_of(self, chunk: int) -> int:
        """Return the bytes that a chunk takes on the disk."""
        return sum(path.stat().st_size for path in [*self._files(chunk).values(), self._marker(chunk)] if path.exists())

    def _marker(self, chunk: int) -> Path:
        return self.folder / _MARKERS / f"{chunk}.json"

    def _array(self, name: str) -> zarr.Array:
        if name not in self._arrays:
            found = self._group[name]
            assert isinstance(found, zarr.Array)  # as it was made  # noqa: S101
            self._arrays[name] = found
        return self._arrays[name]

    def _files(self, chunk: int) -> dict[str, Path]:
        place = self.plan.place(chunk)
        behind = {variable.name: len(variable.dimensions) for variable in self.plan.recorder.variables}
        behind[_COMPUTED] = 0
        return {
            name: self.folder.joinpath(STORE, name, "c", *map(str, place + (0,) * count))
            for name, count in behind.items()
        }

    def _sums(self, chunk: int) -> dict[str, str | None]:
        """Return the checksums of a chunk's files; None where there is none, all of it being the fill value."""
        sums = {}
        for name, path in self._files(chunk).items():
            try:
                sums[name] = hashlib.sha256(path.read_bytes()).hexdigest()
            except FileNotFoundError:
                sums[name] = None
        return sums


def open_store(folder: Path, plan: SweepPlan, *, coordinates: bool = True) -> SweepStore:
    """Return the store of a sweep in a folder, made if there is none.

    Args:
        folder: of the sweep.
        plan: the sweep.
        coordinates: whether a new store has the values along the axes, too.

    Raises:
        ValueError: if there is one of another sweep; says what differs.
    """
    if (folder / STORE / "zarr.json").exists():
        _check_same(folder, plan)
    else:
        # beside its place first: it is there whole or not at all
        fresh = folder / f".{STORE}.part"
        shutil.rmtree(fresh, ignore_errors=True)
        _make(fresh, plan, coordinates=coordinates)
        shutil.rmtree(folder / _MARKERS, ignore_errors=True)
        shutil.rmtree(folder / STORE, ignore_errors=True)
        fresh.rename(folder / STORE)
    (folder / _MARKERS).mkdir(exist_ok=True)
    for unfinished in (*(folder / STORE).rglob("*.partial"), *(folder / _MARKERS).glob(".*.part")):
        unfinished.unlink()
    return SweepStore(folder, plan)


def _make(path: Path, plan: SweepPlan, *, coordinates: bool) -> None:
    group = zarr.open_group(str(path), mode="w", zarr_format=3)
    group.attrs.update(
        {
            "format": "afm-jax sweep",
            "format_version": FORMAT_VERSION,
            "afm_jax": __version__,
            "input": json.dumps(plan.given),
        }
    )
    for axis in plan.axes:
        for parameter, values in axis.columns.items():
            own = {"parameter": parameter, "units": unit_of(parameter)} | dict(plan.recorder.labels.get(parameter, {}))
            array = _coordinate(group, dimension_of(parameter), axis.dimension, own, axis.size)
            for first in range(0, axis.size if coordinates else 0, _SLAB):
                end = min(first + _SLAB, axis.size)
                array[first:end] = values(first, end)
    for name, values in plan.recorder.extra.items():
        _coordinate(group, name, name, {}, len(values))[:] = np.asarray(values)
    dimensions = tuple(axis.dimension for axis in plan.axes)
    for variable in plan.recorder.variables:
        extra = tuple(len(plan.recorder.extra[name]) for name in variable.dimensions)
        group.create_array(
            variable.name,
            shape=plan.shape + extra,
            chunks=plan.block + extra,
            dtype=variable.dtype,
            fill_value=math.nan if variable.dtype == "float64" else 0,
            dimension_names=dimensions + variable.dimensions,
            attributes={**variable.attributes(), "coordinates": _others(plan)},
        )
    group.create_array(
        _COMPUTED,
        shape=plan.shape,
        chunks=plan.block,
        dtype="bool",
        fill_value=False,
        dimension_names=dimensions,
        attributes={"long_name": "this point has been computed", "coordinates": _others(plan)},
    )
    with warnings.catch_warnings():
        # that xarray opens the store by one file is worth a part of the format that is not settled yet
        warnings.simplefilter("ignore")
        zarr.consolidate_metadata(str(path))


def _others(plan: SweepPlan) -> str:
    """Return the coordinates that are no dimension, as the CF conventions list them."""
    return " ".join(
        dimension_of(name) for axis in plan.axes for name in axis.columns if dimension_of(name) != axis.dimension
    )


def _coordinate(group: zarr.Group, name: str, dimension: str, attributes: Mapping[str, Any], size: int) -> zarr.Array:
    return group.create_array(
        name,
        shape=(size,),
        chunks=(min(size, _SLAB),),
        dtype="float64",
        fill_value=math.nan,
        dimension_names=(dimension,),
        attributes=dict(attributes),
    )


def _check_same(folder: Path, plan: SweepPlan) -> None:
    try:
        found = json.loads((folder / STORE / "zarr.json").read_bytes())["attributes"]
        there, version = json.loads(found["input"]), found["format_version"]
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{folder / STORE}: is not a sweep of afm-jax; choose another folder") from error
    if version != FORMAT_VERSION:
        raise ValueError(f"{folder / STORE}: has format_version {version}, not {FORMAT_VERSION}; choose another folder")
    differences = changes(there, plan.given)
    if differences:
        raise ValueError(
            f"{folder}: holds another sweep, in which {'; '.join(differences[:3])}"
            f"{' and more' if len(differences) > 3 else ''}: choose another folder, or restore the input"
        )


def changes(old: Any, new: Any, place: str = "") -> list[str]:
    """Return in words in what two inputs differ.

    >>> changes({"record": {"what": "orbits", "orders": [1]}}, {"record": {"what": "orbits", "orders": [1, 2]}})
    ['record.orders is [1], not [1, 2]']
    """
    if old == new:
        return []
    if isinstance(old, dict) and isinstance(new, dict):
        names = [*old, *(name for name in new if name not in old)]
        return [
            line
            for name in names
            for line in changes(old.get(name), new.get(name), f"{place}.{name}" if place else name)
        ]
    if isinstance(old, list) and isinstance(new, list) and len(old) == len(new) and any(map(_is_table, old)):
        return [
            line
            for number, pair in enumerate(zip(old, new, strict=True))
            for line in changes(*pair, f"{place}[{number + 1}]")
        ]
    return [f"{place} is {_short(old)}, not {_short(new)}"]


def _is_table(value: Any) -> bool:
    return isinstance(value, dict)


def _short(value: Any) -> str:
    text = "absent" if value is None else json.dumps(value)
    return text if len(text) <= _MOST_SHOWN else f"{text[:_MOST_SHOWN]}..."


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Have a folder alone for as long as this lasts; a lock that a process left behind when it died does not count.

    Raises:
        ValueError: if another sweep has it; says which process on which machine.
        OSError: if the folder cannot be written to.
    """
    path = folder / _LOCK
    with path.open("a+", encoding="utf-8") as file:
        try:
            _lock(file.fileno())
        except OSError as error:
            if error.errno not in (errno.EAGAIN, errno.EACCES):
                raise
            file.seek(0)
            raise ValueError(
                f"{folder}: another sweep is writing there ({file.read().strip() or 'it has just begun'}); wait for "
                "it, or choose another folder"
            ) from error
        file.truncate(0)
        file.write(f"process {os.getpid()} on {socket.gethostname()}\n")
        file.flush()
        yield


def _lock(descriptor: int) -> None:
    """Lock an open file; the system takes the lock back when the process ends, however it ends."""
    try:
        import fcntl  # noqa: PLC0415
    except ModuleNotFoundError:  # Windows: nothing keeps two sweeps apart there
        return
    fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
