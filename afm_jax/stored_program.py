"""Compiled functions that need no tracing in the next process either: their programs lie beside JAX's cache.

JAX keeps compiled programs, but to find one it traces the function anew, which takes seconds where the function is
long. Here the traced program (`jax.export`) is kept as well, found by everything that it depends on: the sources of the
packages, the versions, the configuration, the arguments' shapes and structure. Commands say where (`keep_programs`);
elsewhere, and inside another traced function, this is `jax.jit` and nothing else.
"""

import contextlib
import dataclasses
import functools
import hashlib
import inspect
import os
import pickle
import shutil
import tempfile
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import export
from jax.core import Tracer

_KEPT = 4
"""Versions of the sources whose programs are kept."""
_CONFIGURATION = ("jax_enable_x64", "jax_numpy_dtype_promotion", "jax_default_matmul_precision", "jax_debug_nans")
_ARRAYS = (np.ndarray, np.generic, jax.Array)
_OURS = {"afm_jax", "fitting", "builtins", "collections"}
_PACKAGES = ("jax", "jaxlib", "equinox", "diffrax", "optimistix", "lineax", "numpy")


class StoredProgram:
    """A jitted function whose traced programs outlive the process."""

    def __init__(self, function: Callable[..., Any], *static: str):
        """Wrap a function.

        Args:
            function: of arrays and trees of them, and returning them.
            static: names of the arguments that shape the program: hashable, with a `repr` that says all of them.
        """
        functools.update_wrapper(self, function)
        self._function, self._static = function, static
        self._signature = inspect.signature(function)
        self._plain = jax.jit(function, static_argnames=static)
        self._programs: dict[Any, Callable[..., Any] | None] = {}

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        """Return the function's value."""
        folder = _folder()
        if folder is None:
            return self._plain(*arguments, **named)
        bound = self._signature.bind(*arguments, **named)
        bound.apply_defaults()
        static = tuple((name, bound.arguments.pop(name)) for name in self._static)
        leaves, tree = jax.tree.flatten(dict(bound.arguments))
        if any(isinstance(leaf, Tracer) or not isinstance(leaf, _ARRAYS) for leaf in leaves):
            return self._plain(*arguments, **named)
        shapes = tuple((leaf.shape, str(leaf.dtype), bool(getattr(leaf, "weak_type", False))) for leaf in leaves)
        key = (static, tree, shapes, *(getattr(jax.config, name) for name in _CONFIGURATION))
        if key not in self._programs:
            self._programs[key] = self._program(folder, static, tree, shapes)
        program = self._programs[key]
        return self._plain(*arguments, **named) if program is None else program(leaves)

    def lower(self, *arguments: Any, **named: Any) -> Any:
        """Return the lowered function, as `jax.jit` does."""
        return self._plain.lower(*arguments, **named)

    def _cache_size(self) -> int:
        """Return how many programs were compiled where none is kept, as `jax.jit` does."""
        return self._plain._cache_size()  # noqa: SLF001  # pyright: ignore[reportAttributeAccessIssue]

    def _program(self, folder: Path, static: Any, tree: Any, shapes: tuple[Any, ...]) -> Callable[..., Any] | None:
        """Return the program from its file, or a new one, which is written down; None: it has no name to keep it by."""
        described = f"{static!r} {tree}"
        # objects without a description of their own would never be found again; what other people's classes compute is
        # not in the sources that are looked at
        if " at 0x" in described or not _is_ours(tree):
            return None
        configuration = [getattr(jax.config, name) for name in _CONFIGURATION]
        text = f"{described} {shapes} {configuration} {jax.devices()}"
        name = f"{self._function.__module__}.{self._function.__qualname__}-{_digest(text)}.program"
        kept = _read(folder / name) or self._export(static, tree, shapes)
        if kept is None:
            return None
        if not (folder / name).exists():
            _write(folder / name, kept)
        called, structure = jax.jit(kept.program.call), jax.tree.structure(kept.skeleton)
        return lambda leaves: jax.tree.unflatten(structure, called(leaves))

    def _export(self, static: Any, tree: Any, shapes: tuple[Any, ...]) -> "_Kept | None":
        """Return the traced program of a list of leaves; None: it cannot be kept."""
        structures: list[Any] = []

        def flat(leaves):
            bound = self._signature.bind_partial()
            bound.arguments |= dict(static) | jax.tree.unflatten(tree, leaves)
            results, structure = jax.tree.flatten(self._function(*bound.args, **bound.kwargs))
            structures.append(structure)
            return results

        described = [jax.ShapeDtypeStruct(shape, np.dtype(kind), weak_type=weak) for shape, kind, weak in shapes]
        try:
            # without derivatives: whoever differentiates traces anyway
            program = dataclasses.replace(export.export(jax.jit(flat))(described), _get_vjp=None)
        except (NotImplementedError, ValueError, TypeError):
            # a program with callbacks, for example: it is traced as ever
            return None
        structure = structures[0]
        return _Kept(program, jax.tree.unflatten(structure, range(structure.num_leaves)))


class _Kept(NamedTuple):
    """A traced program of a list of leaves, and its result's structure filled with numbers."""

    program: export.Exported
    skeleton: Any


def stored(*static: str) -> Callable[[Callable[..., Any]], StoredProgram]:
    """Return a decorator that makes a function a `StoredProgram`; `static` as there."""
    return lambda function: StoredProgram(function, *static)


def _is_ours(tree: Any) -> bool:
    """Say whether a tree consists of containers and of classes of these packages."""
    node = tree.node_data()
    kind = type(None) if node is None else node[0]
    return kind.__module__.partition(".")[0] in _OURS and all(_is_ours(child) for child in tree.children())


def keep_programs(folder: Path | None) -> None:
    """Keep the programs of this process in a folder from now on; None: nowhere."""
    _chosen[:] = [] if folder is None else [folder]


_chosen: list[Path] = []


def _folder() -> Path | None:
    """Return where programs of these sources are kept, if anywhere."""
    return _chosen[0] / _sources() if _chosen else None


@functools.cache
def _sources() -> str:
    """Return a digest of all sources and versions that a program can depend on."""
    here = Path(__file__).parent
    digest = hashlib.sha256()
    for folder in (here, here.parent / "fitting"):
        for path in sorted(folder.rglob("*.py")):
            digest.update(path.read_bytes())
    for package in _PACKAGES:
        with contextlib.suppress(PackageNotFoundError):
            digest.update(version(package).encode())
    return digest.hexdigest()[:16]


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:24]


def _read(path: Path) -> _Kept | None:
    """Return what a file holds, None where there is none or it is damaged."""
    try:
        # written by this program, in the folder that JAX loads machine code from
        return _Kept(*pickle.loads(path.read_bytes()))  # noqa: S301
    except Exception:  # noqa: BLE001
        return None


def _write(path: Path, kept: _Kept) -> None:
    """Write a file in one step; where that fails, the next process traces again."""
    try:
        text = pickle.dumps(tuple(kept))
        fresh = not path.parent.exists()
        path.parent.mkdir(parents=True, exist_ok=True)
        if fresh:
            _tidy(path.parent.parent)
        with tempfile.NamedTemporaryFile(dir=path.parent, delete=False) as file:
            file.write(text)
        os.replace(file.name, path)  # noqa: PTH105
    except Exception:  # noqa: BLE001
        return


def _tidy(folder: Path) -> None:
    """Remove the programs of all but the last versions of the sources."""
    versions = sorted(folder.iterdir(), key=lambda path: path.stat().st_mtime, reverse=True)
    for path in versions[_KEPT:]:
        shutil.rmtree(path, ignore_errors=True)
