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
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import zarr
from zarr.codecs import ZstdCodec
from zarr.storage import MemoryStore

from afm_jax.strict_json import strict_json
from afm_jax.sweeps.axes import dimension_of
from afm_jax.sweeps.plan import Columns, SweepPlan, Variable, plan_of_worker, unit_of
from afm_jax.version import __version__
from afm_jax.whole_files import check_plain, whole_folder, write_whole

FORMAT_VERSION = 3
STORE = "sweep.zarr"
_MARKERS, _LOCK = "done", "lock"
_COMPUTED = "computed"
_SLAB = 1_000_000
"""Values of a coordinate that are written, and lie, together."""
_FILLS = {"float64": math.nan, "string": ""}
_MOST_SHOWN = 60


ChunkFiles = dict[str, bytes | None]
"""What a chunk's files hold, by the variable; None where there is none, all of it being the fill value."""


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

    def kept(self) -> Kept:
        """Return which chunks are done, every byte of them looked at.

        Raises:
            ValueError: if something else lies among the markers; says what.
        """
        done, damaged = set(), set()
        for path in (self.folder / _MARKERS).iterdir():
            if path.name.startswith(".") and path.is_file():
                # what systems leave in folders
                continue
            chunk = int(path.stem) if path.stem.isascii() and path.stem.isdecimal() and len(path.stem) < 20 else -1
            if not 0 <= chunk < self.plan.chunks or path.name != f"{chunk}.json" or not path.is_file():
                raise ValueError(f"{path}: is no mark of a chunk of this sweep; delete it")
            try:
                sums = json.loads(path.read_bytes())
            except ValueError:
                sums = None
            (done if sums == _sums(self._there(chunk)) else damaged).add(chunk)
        return Kept(frozenset(done), frozenset(damaged))

    def write(self, chunk: int, files: ChunkFiles) -> None:
        """Write the files of a chunk, and then that it is done.

        Raises:
            OSError: if there is no room, or the folder is gone; the chunk then counts as not done.
        """
        # what a power cut takes, the checksums tell: the disk's time is saved
        for name, data in files.items():
            path = self._path(name, chunk)
            check_plain(path, within=self.folder)
            if data is None:
                path.unlink(missing_ok=True)
                continue
            try:
                write_whole(path, data, synced=False, within=self.folder)
            except FileNotFoundError:
                path.parent.mkdir(parents=True, exist_ok=True)
                write_whole(path, data, synced=False, within=self.folder)
        write_whole(self._marker(chunk), strict_json(_sums(files)), synced=False, within=self.folder)

    def _marker(self, chunk: int) -> Path:
        return self.folder / _MARKERS / f"{chunk}.json"

    def _path(self, name: str, chunk: int) -> Path:
        return self.folder / STORE / _key(self.plan, name, chunk)

    def _there(self, chunk: int) -> ChunkFiles:
        """Return the files of a chunk as they lie on the disk."""
        files: ChunkFiles = {}
        for name in _names(self.plan):
            try:
                files[name] = self._path(name, chunk).read_bytes()
            except FileNotFoundError:
                files[name] = None
        return files


def _names(plan: SweepPlan) -> list[str]:
    return [*(variable.name for variable in plan.recorder.variables), _COMPUTED]


def _key(plan: SweepPlan, name: str, chunk: int) -> str:
    """Return where in a Zarr store the chunk of a variable lies."""
    behind = {variable.name: len(variable.dimensions) for variable in plan.recorder.variables}
    return "/".join([name, "c", *map(str, plan.place(chunk) + (0,) * behind.get(name, 0))])


def _sums(files: ChunkFiles) -> dict[str, str | None]:
    return {name: None if data is None else hashlib.sha256(data).hexdigest() for name, data in files.items()}


class ChunkEncoder:
    """Makes files of results, as Zarr would write them: a worker does, so that writing is all that is left."""

    def __init__(self, plan: SweepPlan):
        """Take a plan."""
        self.plan = plan
        self._files: dict[str, Any] = {}
        self._arrays = _make(zarr.open_group(MemoryStore(self._files), mode="w", zarr_format=3), plan)

    def files(self, chunk: int, results: Columns) -> ChunkFiles:
        """Return the files of a chunk, from what was computed."""
        region = self.plan.region(chunk)
        files: ChunkFiles = {}
        for name in _names(self.plan):
            self._arrays[name][(*region, ...)] = True if name == _COMPUTED else results[name]
            data = self._files.pop(_key(self.plan, name, chunk), None)
            files[name] = None if data is None else data.to_bytes()
        return files


def compute_chunk(text: str, chunk: int) -> ChunkFiles:
    """Return the files of a chunk, for a process that knows nothing but the input.

    Args:
        text: `SweepPlan.given` as JSON.
        chunk: its number.

    Raises:
        RuntimeError: if this process would compute otherwise than the one that asks.
    """
    encoder = _known_encoder(text)
    return encoder.files(chunk, encoder.plan.compute(chunk))


@lru_cache(maxsize=4)
def _known_encoder(text: str) -> ChunkEncoder:
    return ChunkEncoder(plan_of_worker(text))


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
    for unfinished in _unfinished(folder):
        unfinished.unlink()
    for left in folder.glob(f".{STORE}.*part"):
        check_plain(left)
        shutil.rmtree(left)
    if (folder / STORE / "zarr.json").exists():
        _check_same(folder, plan)
        # of the axes no checksum is kept: they are what the plan says
        _write_axes(zarr.open_group(str(folder / STORE), mode="r+", zarr_format=3), plan, coordinates=coordinates)
    else:
        with whole_folder(folder / STORE) as fresh:
            _make_whole(fresh, plan, coordinates=coordinates)
            shutil.rmtree(folder / _MARKERS, ignore_errors=True)
    (folder / _MARKERS).mkdir(exist_ok=True)
    return SweepStore(folder, plan)


def _unfinished(folder: Path) -> list[Path]:
    """Return the files of a store that a killed process left unfinished; everything in it is looked at.

    Raises:
        OSError: if there is a link, a device or a pipe in it; names it.
    """
    found = []
    for top in (folder / STORE, folder / _MARKERS):
        check_plain(top)
        for place, folders, files in os.walk(top):
            for name in (*folders, *files):
                check_plain(Path(place, name))
            found += [Path(place, name) for name in files if name.startswith(".") and name.endswith(".part")]
    return found


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


def _make(group: zarr.Group, plan: SweepPlan) -> dict[str, zarr.Array]:
    """Make the arrays of what is recorded."""
    arrays = {}
    for variable in (*plan.recorder.variables, Variable(_COMPUTED, "this point has been computed", "bool")):
        extra = tuple(len(plan.recorder.extra[name]) for name in variable.dimensions)
        arrays[variable.name] = group.create_array(
            variable.name,
            shape=plan.shape + extra,
            chunks=plan.block + extra,
            dtype=variable.dtype,
            # twice as fast as the usual level, and no larger
            compressors=ZstdCodec(level=1),
            fill_value=_FILLS.get(variable.dtype, 0),
            dimension_names=tuple(axis.dimension for axis in plan.axes) + variable.dimensions,
            attributes={**variable.attributes(), "coordinates": _others(plan)},
        )
    return arrays


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
