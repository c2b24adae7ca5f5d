"""Public names of a package, listed once in its stub `__init__.pyi` and imported when somebody asks for them.

Importing the package then needs no JAX, and type checkers read the names from the stub. What is looked up gets
signatures that a person can read in `help` and on hover in a notebook: `ArrayLike` instead of the eight types that it
stands for, and classes without the modules that they lie in.
"""

import ast
import inspect
import re
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from types import FunctionType
from typing import Any


def names_of_stub(package: str, file: str) -> tuple[Callable[[str], object], Callable[[], list[str]], list[str]]:
    """Return `__getattr__`, `__dir__` and `__all__` of a package whose stub lists its public names.

    Each name is a line of the stub: `from package.module import name as name`, or `import package as package`.

    Args:
        package: name of the package, its `__name__`.
        file: its `__file__`; the stub `__init__.pyi` lies beside it.

    Raises:
        AttributeError: (when a name is looked up) if the stub does not list it.
    """
    homes: dict[str, str] = {}
    for line in ast.parse(Path(file).with_suffix(".pyi").read_text(encoding="utf-8")).body:
        if isinstance(line, ast.ImportFrom):
            homes |= {name.name: str(line.module) for name in line.names}
        elif isinstance(line, ast.Import):
            homes |= {name.name: "" for name in line.names}

    def look_up(name: str) -> object:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(import_module(homes[name]), name) if homes[name] else import_module(name)
        _sign_readably(value)
        setattr(sys.modules[package], name, value)  # so that it is looked up once
        return value

    return look_up, lambda: sorted(homes), sorted(homes)


class _Words(str):
    """An annotation as text, which a signature prints without quotes."""

    __slots__ = ()
    __repr__ = str.__str__


_ARRAY_LIKE = re.compile(
    r"(?:typing\.)?Union\[[\w.]*\.Array, numpy\.ndarray, [^]]*complex(, NoneType)?\]"
    r"|[\w.]*\.Array \| numpy\.ndarray \| (?:[\w.]+ \| )*complex( \| None)?"  # since JAX 0.12
)
_MODULES = re.compile(r"(?:\w+\.)+(?=\w)")
_ARRAY = re.compile(r"(?:Float|Int|Bool)\[Array, '[^']*'\]")


def _sign_readably(public: object) -> None:
    """Give a public function, or a class's constructor and methods, a signature whose annotations are short texts."""
    if isinstance(public, FunctionType):
        _sign(public, {})
    for owner in public.__mro__ if inspect.isclass(public) else ():
        for name in vars(owner) if owner.__module__.split(".")[0] in ("afm_jax", "fitting") else ():
            method = getattr(owner, name, None)
            function = getattr(method, "__func__", method)
            if isinstance(function, FunctionType):
                _sign(function, inspect.get_annotations(owner) if name in ("__init__", "__new__") else {})


def _sign(function: FunctionType, fields: dict[str, Any]) -> None:
    """Set the signature that a function shows; of a constructor with the annotations of the fields that it fills.

    The annotation of a field's converter says nothing, and takes what is array.
    """
    signature, parameters = inspect.signature(function), []
    for parameter in signature.parameters.values():
        text = _short(fields.get(parameter.name, Any) if parameter.annotation is Any else parameter.annotation)
        if fields and isinstance(text, _Words):
            optional = " | None" if parameter.default is None and "None" not in text else ""
            text = _Words(_ARRAY.sub("ArrayLike", text) + optional)
        parameters.append(parameter.replace(annotation=text))
    answer = _short(signature.return_annotation)
    function.__signature__ = signature.replace(parameters=parameters, return_annotation=answer)


def _short(annotation: Any) -> Any:
    """Return an annotation as a text without modules; none stays none."""
    if annotation is inspect.Parameter.empty:
        return annotation
    text = annotation if isinstance(annotation, str) else inspect.formatannotation(annotation)
    text = _ARRAY_LIKE.sub(lambda union: "ArrayLike | None" if union[1] or union[2] else "ArrayLike", text)
    return _Words(_MODULES.sub("", text))
