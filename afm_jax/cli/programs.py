"""Traced programs beside JAX's compilation cache, which finds what it has compiled only after tracing anew.

Commands name the few that gain (processor seconds of a warm call of collide, with and without: 2.1 and 3.3; a
simulation gains too little). `jax.export` writes them, its own serialisation; pickle would run any code that a file
names. A file is found by all that a trace depends on: sources, versions, configuration,
devices, shapes and structure. Results are modules and tuples of arrays; other arguments have a `repr` that says all.
"""

import hashlib
import json
import sys
from collections.abc import Callable, Sequence
from functools import cache
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
from jax import core, export

from afm_jax.whole_files import write_whole

_CONFIGURATION = ("jax_enable_x64", "jax_numpy_dtype_promotion", "jax_default_matmul_precision", "jax_debug_nans")
_OURS = ("afm_jax", "fitting")
_PACKAGES = ("jax", "jaxlib", "numpy", "equinox", "diffrax", "optimistix", "lineax")


def keep_programs(names: Sequence[str], folder: Path, tell: Callable[[str], None]) -> None:
    """Let traced programs of jitted functions, "module:function" each, outlive the process, as files in a folder.

    A function whose programs are kept already stays as it is: a command may ask for each of several curves.
    """
    for module, name in (place.split(":") for place in names):
        function = getattr(import_module(module), name)
        if not isinstance(function, _Keeping):
            setattr(sys.modules[module], name, _Keeping(function, folder, tell))


class _Keeping:
    """A jitted function that finds its traced programs in a folder."""

    def __init__(self, jitted: Any, folder: Path, tell: Callable[[str], None]):
        self.jitted, self.folder, self.tell = jitted, folder, tell
        self.traced: dict[Any, tuple[export.Exported, Any]] = {}
        self.programs: dict[Any, Callable[..., Any]] = {}

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        call, arrays, of_arrays = self._call(arguments, named)
        if any(isinstance(leaf, core.Tracer) for leaf in arrays):
            return self.jitted(*arguments, **named)
        if call not in self.programs:
            program, _ = self._trace(call, arrays, of_arrays)
            # at once: a jitted function would compile again where an argument comes from another program
            like, _ = jax.tree.unflatten(program.in_tree, program.in_avals)
            lowered = jax.jit(program.call).lower(*like)
            self.programs[call] = lowered.compile(getattr(self.jitted, "options", None))
        return jax.tree.unflatten(self.traced[call][1], self.programs[call](arrays))

    def _call(self, arguments: Any, named: Any) -> tuple[Any, list[Any], Callable[[list[Any]], Any]]:
        """Return what names a call's program, its arrays, and the function of these."""
        leaves, tree = jax.tree.flatten((arguments, named))
        arrays, static = eqx.partition(leaves, lambda leaf: hasattr(leaf, "dtype"))

        def of_arrays(arrays: list[Any]) -> Any:
            positional, by_name = jax.tree.unflatten(tree, eqx.combine(arrays, static))
            return self.jitted(*positional, **by_name)

        return (tree, *static, *((leaf.shape, leaf.dtype) for leaf in jax.tree.leaves(arrays))), arrays, of_arrays

    def _trace(self, call: Any, arrays: list[Any], of_arrays: Callable[..., Any]) -> tuple[export.Exported, Any]:
        """Return the traced program of a call and the tree of its result."""
        if call not in self.traced:
            path = self.folder / f"{self.jitted.__name__}-{_digest(call)}.program"
            self.traced[call] = _traced(path, of_arrays, arrays, self.tell)
        return self.traced[call]


def _digest(call: Any) -> str:
    said = [call, *(getattr(jax.config, option) for option in _CONFIGURATION), jax.devices(), *_versions()]
    return hashlib.sha256(f"{said}{_sources()}".encode()).hexdigest()


@cache
def _versions() -> tuple[str, ...]:
    return tuple(map(version, _PACKAGES))


@cache
def _sources() -> str:
    """Return a digest of all sources that a program may come from."""
    folders = (Path(str(import_module(name).__file__)).parent for name in _OURS)
    files = (path for folder in folders for path in sorted(folder.rglob("*.py")))
    return hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest()


def _traced(path: Path, function: Any, arrays: list[Any], tell: Callable[[str], None]) -> tuple[export.Exported, Any]:
    """Return a function's traced program and the tree of its result, from a file if both are behind their digest."""
    kept = path.read_bytes() if path.exists() else b""
    text = kept[32:]
    if kept[:32] != hashlib.sha256(text).digest():
        structure = _structure(jax.eval_shape(function, arrays))
        program = export.export(jax.jit(lambda arrays: jax.tree.leaves(function(arrays))))(arrays)
        text = json.dumps(structure).encode() + b"\n" + program.serialize()
        try:
            write_whole(path, hashlib.sha256(text).digest() + text)
            tell(f"{path.name} was {'damaged' if kept else 'not there'}: traced and written")
        except OSError as error:
            tell(f"{path.name} cannot be written: {error.strerror}")
    structure, _, text = text.partition(b"\n")
    return export.deserialize(bytearray(text)), jax.tree.structure(_made(json.loads(structure)))


def _structure(value: Any) -> Any:
    """Return what JSON can hold of a result: names of a type and of its parts; values as they are, for arrays 0."""
    if not isinstance(value, tuple | eqx.Module):
        return {"value": 0 if isinstance(value, jax.ShapeDtypeStruct) else value}
    parts = vars(value) if isinstance(value, eqx.Module) else dict(enumerate(value))
    return [type(value).__module__, type(value).__name__, {name: _structure(part) for name, part in parts.items()}]


def _made(structure: Any) -> Any:
    if isinstance(structure, dict):
        return structure["value"]
    kind = getattr(sys.modules[structure[0]], structure[1])
    parts = {name: _made(part) for name, part in structure[2].items()}
    if issubclass(kind, tuple):
        return tuple.__new__(kind, parts.values())
    made = object.__new__(kind)  # without its checks, which are for what users write
    vars(made).update(parts)
    return made
