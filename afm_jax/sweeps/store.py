"""Where the results of a sweep lie: a Zarr store that xarray opens alone, with an array `computed` over its points.

A chunk is done when `computed` says so, which is written last, and when every array's chunk is there and has the
checksum (crc32c) that it was written with; else it is computed anew. One sweep at a time has the folder.
"""

import contextlib
import errno
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
from zarr.codecs import Crc32cCodec, ZstdCodec

from afm_jax.sweeps.axes import dimension_of
from afm_jax.sweeps.plan import Columns, SweepPlan, Variable, unit_of
from afm_jax.version import __version__
from afm_jax.whole_files import check_plain, whole_folder

FORMAT_VERSION = 4
STORE = "sweep.zarr"
_LOCK = "lock"
_COMPUTED = "computed"
_SLAB = 1_000_000
"""Values of a coordinate that are written, and lie, together."""
# twice as fast as the usual level, and no larger; the checksum is of what lies on the disk
_CODECS = (ZstdCodec(level=1), Crc32cCodec())
_FILLS = {"float64": math.nan, "string": ""}
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
        # a chunk that is all fill value is written, too, so that one which is not there is missing
        with zarr.config.set({"array.write_empty_chunks": True}):
            group = zarr.open_group(str(folder / STORE), mode="r+", zarr_format=3)
            names = (*(variable.name for variable in plan.recorder.variables), _COMPUTED)
            self._arrays: dict[str, Any] = {name: group[name] for name in names}

    def kept(self) -> Kept:
        """Return which chunks are done, every byte of them looked at."""
        begun = [chunk for chunk in range(self.plan.chunks) if self._path(_COMPUTED, chunk).is_file()]
        done = frozenset(chunk for chunk in begun if self._whole(chunk))
        return Kept(done, frozenset(begun) - done)

    def _whole(self, chunk: int) -> bool:
        region = (*self.plan.region(chunk), ...)
        if not all(self._path(name, chunk).is_file() for name in self._arrays):
            return False
        try:
            values = {name: array[region] for name, array in self._arrays.items()}
        # what a damaged chunk does the codec decides
        except (OSError, RuntimeError, ValueError):
            return False
        return bool(np.all(values[_COMPUTED]))

    def write(self, chunk: int, results: Columns) -> None:
        """Write the results of a chunk, and then that it is computed; each array's chunk appears whole or not at all.

        Raises:
            OSError: if there is no room, or the folder is gone; the chunk then counts as not done.
        """
        for name, array in self._arrays.items():
            check_plain(self._path(name, chunk), within=self.folder)
            array[(*self.plan.region(chunk), ...)] = True if name == _COMPUTED else results[name]

    def _path(self, name: str, chunk: int) -> Path:
        """Return where Zarr keeps the chunk of an array."""
        array = self._arrays[name]
        place = self.plan.place(chunk)
        place += (0,) * (array.ndim - len(place))
        return self.folder / STORE / name / array.metadata.encode_chunk_key(place)


def open_store(folder: Path, plan: SweepPlan, *, coordinates: bool = True) -> SweepStore:
    """Return the store of a sweep in a folder, made if there is none.

    Args:
        folder: of the sweep.
        plan: the sweep.
        coordinates: whether a new store has the values along the axes, too.

    Raises:
        ValueError: if there is one of another sweep; says what differs.
        OSError: if there is a link, a device or a pipe in it; names it.
    """
    for unfinished in _unfinished(folder / STORE):
        unfinished.unlink()
    for part in folder.glob(f".{STORE}.*part"):
        check_plain(part)
        shutil.rmtree(part)
    if (folder / STORE / "zarr.json").exists():
        _check_same(folder, plan)
        # what the axes hold is what the plan says
        _write_axes(zarr.open_group(str(folder / STORE), mode="r+", zarr_format=3), plan, coordinates=coordinates)
    else:
        with whole_folder(folder / STORE) as fresh:
            _make_whole(fresh, plan, coordinates=coordinates)
    return SweepStore(folder, plan)


def _unfinished(top: Path) -> list[Path]:
    """Return the files of a store that a killed process left unfinished; everything in it is looked at.

    Raises:
        OSError: if there is a link, a device or a pipe in it; names it.
    """
    check_plain(top)
    unfinished = []
    for place, folders, files in os.walk(top):
        for name in (*folders, *files):
            check_plain(Path(place, name))
        # as Zarr names them until they are whole
        unfinished += [Path(place, name) for name in files if name.endswith(".partial")]
    return unfinished


def _make_whole(path: Path, plan: SweepPlan, *, coordinates: bool) -> None:
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
        for parameter in axis.columns:
            own = {"parameter": parameter, "units": unit_of(parameter)} | dict(plan.recorder.labels.get(parameter, {}))
            _coordinate(group, dimension_of(parameter), axis.dimension, own, axis.size)
    for name, values in plan.recorder.extra.items():
        _coordinate(group, name, name, {}, len(values))
    _write_axes(group, plan, coordinates=coordinates)
    _make(group, plan)
    with warnings.catch_warnings():
        # that xarray opens the store by one file is worth a part of the format that is not settled yet
        warnings.simplefilter("ignore")
        zarr.consolidate_metadata(str(path))


def _write_axes(group: zarr.Group, plan: SweepPlan, *, coordinates: bool) -> None:
    """Write the values along the axes, where they do not stand there already."""
    for axis in plan.axes if coordinates else ():
        for parameter, values in axis.columns.items():
            for first in range(0, axis.size, _SLAB):
                _write_once(group, dimension_of(parameter), first, values(first, min(first + _SLAB, axis.size)))
    for name, values in plan.recorder.extra.items():
        for first in range(0, len(values), _SLAB):
            _write_once(group, name, first, values[first : first + _SLAB])


def _write_once(group: zarr.Group, name: str, first: int, values: Any) -> None:
    """Write a chunk of a coordinate, unless it holds these values."""
    array: Any = group[name]
    wanted = np.asarray(values, float)
    place = slice(first, first + wanted.size)
    try:
        there = np.array_equal(array[place], wanted, equal_nan=True)
    # what a damaged chunk does the codec decides
    except (OSError, RuntimeError, ValueError):
        there = False
    if not there:
        array[place] = wanted


def _make(group: zarr.Group, plan: SweepPlan) -> None:
    """Make the arrays of what is recorded."""
    for variable in (*plan.recorder.variables, Variable(_COMPUTED, "this point has been computed", "bool")):
        extra = tuple(len(plan.recorder.extra[name]) for name in variable.dimensions)
        group.create_array(
            variable.name,
            shape=plan.shape + extra,
            chunks=plan.block + extra,
            dtype=variable.dtype,
            compressors=_CODECS,
            fill_value=_FILLS.get(variable.dtype, 0),
            dimension_names=tuple(axis.dimension for axis in plan.axes) + variable.dimensions,
            attributes={**variable.attributes(), "coordinates": _others(plan)},
        )


def _others(plan: SweepPlan) -> str:
    """Return the coordinates that are no dimension, as the CF conventions list them."""
    return " ".join(
        dimension_of(name) for axis in plan.axes for name in axis.columns if dimension_of(name) != axis.dimension
    )


def _coordinate(group: zarr.Group, name: str, dimension: str, attributes: Mapping[str, Any], size: int) -> None:
    group.create_array(
        name,
        shape=(size,),
        chunks=(min(size, _SLAB),),
        dtype="float64",
        compressors=_CODECS,
        fill_value=math.nan,
        dimension_names=(dimension,),
        attributes=dict(attributes),
    )


def _check_same(folder: Path, plan: SweepPlan) -> None:
    try:
        whole = json.loads((folder / STORE / "zarr.json").read_bytes())
        there, version = json.loads(whole["attributes"]["input"]), whole["attributes"]["format_version"]
        block = whole["consolidated_metadata"]["metadata"][_COMPUTED]["chunk_grid"]["configuration"]["chunk_shape"]
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{folder / STORE}: is not a sweep of afm-jax; choose another folder") from error
    if version != FORMAT_VERSION:
        raise ValueError(f"{folder / STORE}: has format_version {version}, not {FORMAT_VERSION}; choose another folder")
    # how a sweep is cut that leaves it open is settled by the program
    differences = changes(there, plan.given) or changes(block, list(plan.block), "shape of its chunks")
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
    if (
        isinstance(old, list)
        and isinstance(new, list)
        and len(old) == len(new)
        and any(isinstance(value, dict) for value in old)
    ):
        return [
            line
            for number, pair in enumerate(zip(old, new, strict=True))
            for line in changes(*pair, f"{place}[{number + 1}]")
        ]
    return [f"{place} is {_short(old)}, not {_short(new)}"]


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
    check_plain(path)
    with os.fdopen(_open_itself(path), "a+", encoding="utf-8") as file:
        if os.fstat(file.fileno()).st_nlink > 1:
            raise OSError(errno.EMLINK, "is another file, too (a hard link); delete it", str(path))
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


def _open_itself(path: Path) -> int:
    """Open a file to append to it, never what a link points to, and without waiting for the other end of a pipe."""
    careful = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
    return os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND | careful, 0o666)


def _lock(descriptor: int) -> None:
    """Lock an open file; the system takes the lock back when the process ends, however it ends."""
    try:
        import fcntl  # noqa: PLC0415
    except ModuleNotFoundError:  # Windows: nothing keeps two sweeps apart there
        return
    fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
