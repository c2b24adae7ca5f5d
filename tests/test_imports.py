"""The folders' order: imports point up the list only, packages start without JAX, its configuration is left alone."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.fresh_python import python

ROOT = Path(__file__).parent.parent
# A room may import from rooms of lower or equal level.
LEVELS = {
    "units": 0,
    "version": 0,
    "lazy_names": 0,
    "compilation_cache": 0,
    "strict_json": 0,
    "outcome": 0,
    "words": 0,
    "parameters": 1,
    "apparatus": 2,
    "impact": 3,
    "contact": 4,
    "motion": 5,
    "scenefile": 6,
    "scenefile_contact": 6,
    "scenefile_drives": 6,
    "scenefile_keys": 6,
    "scenefile_start": 6,
    "scenefile_table": 6,
    "presets": 6,
    "study": 7,
    "plots": 8,
    "cli": 9,
    "__main__": 10,
}
LIBRARY = sorted(path.relative_to(ROOT) for name in ("afm_jax", "fitting") for path in (ROOT / name).rglob("*.py"))


def imported(path: Path) -> Iterator[str]:
    """Give the full names of the modules that a file imports, anywhere in it."""
    for node in ast.walk(ast.parse((ROOT / path).read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path} has a relative import"
            yield node.module or ""
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def room(name: str) -> str:
    """Return the part of a module's name below its package: afm_jax.impact.law is in `impact`."""
    parts = name.split(".")
    return parts[1] if len(parts) > 1 else ""


def test_every_module_is_in_a_known_room():
    assert len(LIBRARY) > 30
    rooms = {path.with_suffix("").parts[1] for path in LIBRARY if path.parts[0] == "afm_jax"}
    assert rooms - {"__init__"} <= set(LEVELS)


@pytest.mark.parametrize("path", [path for path in LIBRARY if path.parts[0] == "afm_jax"], ids=str)
def test_imports_point_up_the_list(path: Path):
    here = path.with_suffix("").parts[1]
    for name in imported(path):
        top = name.split(".")[0]
        if top == "fitting":
            assert here == "cli", f"{path} imports {name}"
        if top == "afm_jax" and here != "__init__" and room(name) in LEVELS:
            assert LEVELS[room(name)] <= LEVELS[here], f"{path} imports {name}, which lies below it"


def test_the_tests_of_the_imports_see_what_they_must():
    names = set(imported(Path("afm_jax/impact/poincare.py")))
    assert "afm_jax.impact.first_impact" in names
    assert room("afm_jax.impact.first_impact") == "impact"
    assert LEVELS["apparatus"] < LEVELS["impact"] < LEVELS["study"] < LEVELS["plots"] < LEVELS["cli"]


def test_packages_start_without_jax():
    # Names are taken when they are used; then JAX is there.
    code = "import sys, afm_jax, fitting; print('jax' in sys.modules); afm_jax.Cantilever; print('jax' in sys.modules)"
    assert python(code).split() == ["False", "True"]


def changes_of_configuration(path: Path) -> list[int]:
    """Return the lines of a file that set an option of JAX or of its surroundings.

    Left out is what only runs when the file is a program: its `__main__` block and the functions called there.
    """
    tree = ast.parse((ROOT / path).read_text())
    programs = [node for node in tree.body if isinstance(node, ast.If) and "__main__" in ast.unparse(node.test)]
    called = {ast.unparse(inner.func) for node in programs for inner in ast.walk(node) if isinstance(inner, ast.Call)}
    programs += [node for node in tree.body if isinstance(node, ast.FunctionDef) and node.name in called]
    excused = {id(inner) for node in programs for inner in ast.walk(node)}
    lines = []
    for node in ast.walk(tree):
        if id(node) in excused:
            continue
        if isinstance(node, ast.Call) and ast.unparse(node.func).endswith("config.update"):
            lines.append(node.lineno)
        if isinstance(node, ast.Assign | ast.AugAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            lines += [node.lineno for target in targets if ".config." in f".{ast.unparse(target)}"]
            lines += [node.lineno for target in targets if "environ[" in ast.unparse(target)]
    return lines


@pytest.mark.parametrize("path", LIBRARY, ids=str)
def test_the_library_leaves_jax_as_it_is(path: Path):
    if path.parts[:2] == ("afm_jax", "cli") or path == Path("afm_jax/compilation_cache.py"):
        return  # a command is a program of its own, and `use_cache` is asked to change it
    lines = changes_of_configuration(path)
    assert not lines, f"{path}, lines {lines}: the library must not change JAX's configuration"


def test_the_command_line_does_change_it():
    # So that the test above is known to see such lines.
    changed = [path for path in LIBRARY if path.parts[:2] == ("afm_jax", "cli") and changes_of_configuration(path)]
    assert changed


def test_importing_everything_changes_no_setting():
    code = (
        "import importlib, pkgutil, jax, afm_jax, fitting\n"
        "before = dict(jax.config.values)\n"
        "for package in (afm_jax, fitting):\n"
        "    for module in pkgutil.walk_packages(package.__path__, package.__name__ + '.'):\n"
        "        if not module.name.endswith('__main__'):\n"
        "            importlib.import_module(module.name)\n"
        "print({name for name, value in before.items() if jax.config.values[name] != value})"
    )
    assert python(code) == "set()"
