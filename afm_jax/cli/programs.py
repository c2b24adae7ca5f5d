"""Traced programs beside JAX's compilation cache: what that has compiled it finds only after tracing anew.

Commands name the few that gain by being kept traced as well (processor seconds of a warm call, with and without: fit by
viscous+delay 5.3 and 11.9, collide 2.1 and 3.3, a contact simulated 5.2 and 5.9): by `jax.export`, its own
serialisation (what `serialize_executable` writes is read by pickle, which runs any code that a file names). A file is
found by all that a trace depends on: loaded sources, versions, configuration, devices, shapes and structure. Results
are modules and tuples of arrays; arguments that are no arrays have a `repr` that says all of them.
"""

import hashlib
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
from jax import export
from jax.core import Tracer

from afm_jax.whole_files import write_whole

_CONFIGURATION = ("jax_enable_x64", "jax_numpy_dtype_promotion", "jax_default_matmul_precision", "jax_debug_nans")
_SOON = {"xla_cpu_use_fusion_emitters": False, "xla_backend_optimization_level": 1}
"""Half of the time that these programs take to compile, for a tenth of the time that they run."""
_PACKAGES = ("jax", "jaxlib", "numpy", "equinox", "diffrax", "optimistix", "lineax")


def keep_programs(names: Sequence[str], folder: Path, tell: Callable[[str], None]) -> None:
    """Let traced programs of jitted functions, "module:function" each, outlive the process, as files in a folder."""
    for module, function in (name.split(":") for name in names):
        setattr(import_module(module), function, _keeping(getattr(sys.modules[module], function), folder, tell))


def _keeping(jitted: Any, folder: Path, tell: Callable[[str], None]) -> Callable[..., Any]:
    programs: dict[Any, tuple[Any, Any]] = {}

    def kept(*arguments: Any, **named: Any) -> Any:
        leaves, tree = jax.tree.flatten((arguments, named))
        arrays = [leaf for leaf in leaves if hasattr(leaf, "dtype")]
        if any(isinstance(leaf, Tracer) for leaf in arrays):
            return jitted(*arguments, **named)
        static = tuple(None if hasattr(leaf, "dtype") else leaf for leaf in leaves)
        call = (tree, static, *((leaf.shape, leaf.dtype) for leaf in arrays))
        if call in programs:
            program, result = programs[call]
            return jax.tree.unflatten(result, program(arrays))

        def flat(arrays: list[Any]) -> list[Any]:
            given = iter(arrays)
            both = zip(leaves, static, strict=True)
            whole = [next(given) if hasattr(leaf, "dtype") else known for leaf, known in both]
            positional, by_name = jax.tree.unflatten(tree, whole)
            return jax.tree.leaves(jitted(*positional, **by_name))

        def trace() -> tuple[Any, Any]:
            return export.export(jax.jit(flat))(arrays), _structure(jax.eval_shape(jitted, *arguments, **named))

        program, structure = _program(folder / f"{jitted.__name__}-{_digest(call)}.program", trace, tell)
        # at once: a jitted function would compile again where an argument comes from another program
        kinds = [jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for leaf in arrays]
        compiled = jax.jit(program).lower(kinds).compile(_known_options())
        found = _filled(structure, iter(compiled(arrays)))
        programs[call] = compiled, jax.tree.structure(found)
        return found

    return kept


def _digest(call: Any) -> str:
    settings = [getattr(jax.config, option) for option in _CONFIGURATION]
    said = f"{call} {settings} {jax.devices()} {_versions(_PACKAGES)}".encode()
    ours = sorted(name for name in sys.modules if name.startswith(("afm_jax.", "fitting.")))
    files = (getattr(sys.modules[name], "__file__", None) for name in ours)
    sources = b"".join(Path(file).read_bytes() for file in files if file)
    return hashlib.sha256(said + sources).hexdigest()[:32]


@cache
def _versions(packages: tuple[str, ...]) -> list[str]:
    return [version(name) for name in packages]


def _program(path: Path, trace: Callable[[], tuple[Any, Any]], tell: Callable[[str], None]) -> tuple[Any, Any]:
    """Return program and structure of its result from a file, where both are behind their digest, or traced anew."""
    kept = path.read_bytes() if path.exists() else b""
    if kept[:32] == hashlib.sha256(kept[32:]).digest():
        structure, _, text = kept[32:].partition(b"\n")
        return export.deserialize(bytearray(text)).call, json.loads(structure)
    program, structure = trace()
    text = json.dumps(structure).encode() + b"\n" + program.serialize()
    try:
        write_whole(path, hashlib.sha256(text).digest() + text)
        tell(f"{path.name} was {'damaged' if kept else 'not there'}: traced and written")
    except OSError as error:
        tell(f"{path.name} cannot be written: {error.strerror}")
    return program.call, structure


@cache
def _known_options() -> dict[str, Any] | None:
    """Return options that leave the compiler's slowest passes on the CPU out, where it knows them by those names."""
    try:
        jax.jit(lambda x: x, compiler_options=_SOON)(0.0)
    except jax.errors.JaxRuntimeError:
        return None
    return _SOON


def _structure(value: Any) -> Any:
    if type(value) is tuple:
        return ["builtins", "tuple", {str(place): _structure(part) for place, part in enumerate(value)}]
    if not hasattr(value, "_asdict") and not isinstance(value, eqx.Module):
        return 0 if isinstance(value, jax.ShapeDtypeStruct) else {"static": value}
    parts = getattr(value, "_asdict", lambda: vars(value))()
    return [type(value).__module__, type(value).__name__, {name: _structure(part) for name, part in parts.items()}]


def _filled(structure: Any, leaves: Iterator[Any]) -> Any:
    if not isinstance(structure, list):
        return structure["static"] if isinstance(structure, dict) else next(leaves)
    kind = getattr(sys.modules[structure[0]], structure[1])
    parts = {name: _filled(part, leaves) for name, part in structure[2].items()}
    if kind is tuple:
        return tuple(parts.values())
    if issubclass(kind, tuple):
        return kind(**parts)
    made = object.__new__(kind)  # without its checks, which are for what users write
    vars(made).update(parts)
    return made
