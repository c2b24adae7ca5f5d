"""Public names of a package, listed once in its stub `__init__.pyi` and imported when somebody asks for them.

Importing the package then needs no JAX, and type checkers read the names from the stub.
"""

import ast
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path


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
        setattr(sys.modules[package], name, value)  # so that it is looked up once
        return value

    return look_up, lambda: sorted(homes), sorted(homes)
