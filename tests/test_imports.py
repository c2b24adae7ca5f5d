"""The folders' order: imports point up the list only, packages start without JAX, its configuration is left alone."""

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from tests.fresh_python import python

ROOT = Path(__file__).parent.parent
# A room may import from earlier rows, not from neighbours. For fitting: what a fit needs, the fit, what is made of it.
ROWS = {
    "afm_jax": (
        ("units", "version", "lazy_names", "strict_json", "whole_files", "words", "outcomes"),
        ("columns",),
        ("compilation_cache",),
        ("checks",),
        ("saved",),
        ("report",),
        ("results",),
        ("solve", "apparatus"),
        ("impact",),
        ("contact",),
        ("motion",),
        ("scenefile",),
        ("dynamics",),
        ("studies",),
        ("plots",),
        ("cli",),
        ("__main__",),
    ),
    "fitting": (
        ("parameters", "tables"),
        ("instruments", "models", "simulated"),
        ("predict",),
        ("infer",),
        ("gradients", "sampling"),
        ("report",),
        ("traces", "calibration", "inversion", "tapping_curves", "experiments"),
        ("examples",),
    ),
}
LEVELS = {
    package: {room: level for level, rooms in enumerate(rows) for room in rooms} for package, rows in ROWS.items()
}
LIBRARY = sorted(path.relative_to(ROOT) for name in ("afm_jax", "fitting") for path in (ROOT / name).rglob("*.py"))


@cache
def tree_of(path: Path) -> ast.Module:
    """Return a file of the library as its syntax tree, which is only read."""
    return ast.parse((ROOT / path).read_text())


def imported(path: Path) -> Iterator[str]:
    """Give the full names of the modules that a file imports, anywhere in it, within functions, too."""
    for node in ast.walk(tree_of(path)):
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
    for package, levels in LEVELS.items():
        rooms = {path.with_suffix("").parts[1] for path in LIBRARY if path.parts[0] == package}
        assert rooms - {"__init__"} == set(levels), package


@pytest.mark.parametrize("path", LIBRARY, ids=str)
def test_imports_point_up_the_list(path: Path):
    package, here = path.with_suffix("").parts[:2]
    levels = LEVELS[package]
    for name in imported(path):
        top, there = name.split(".")[0], room(name)
        assert (package, top) != ("afm_jax", "fitting") or here == "cli", f"{path} imports {name}"
        if top == package and here != "__init__" and there in levels and there != here:
            assert levels[there] < levels[here], f"{path} imports {name}, which lies beside or below it"


@cache
def needs() -> dict[str, set[str]]:
    """Return for every module those of the library that it imports."""
    modules = {".".join(path.with_suffix("").parts): path for path in LIBRARY if path.name != "__init__.py"}
    return {name: set(imported(path)) & set(modules) for name, path in modules.items()}


def test_files_import_each_other_in_no_circle():
    left = needs()
    while left:
        free = {name for name, needed in left.items() if not needed & set(left)}
        assert free, f"these files import each other in circles: {sorted(left)}"
        left = {name: needed for name, needed in left.items() if name not in free}


def test_no_two_classes_have_one_name():
    found: dict[str, list[str]] = {}
    for path in LIBRARY:
        for node in tree_of(path).body:
            if isinstance(node, ast.ClassDef):
                found.setdefault(node.name, []).append(str(path))
    assert not {name: paths for name, paths in found.items() if len(paths) > 1}


PROGRAM = """
import importlib, inspect, pkgutil, sys
import afm_jax, fitting
import jax
before = dict(jax.config.values)
# a scene with a law does without contacts
scene = afm_jax.Scene(afm_jax.Cantilever(90.0), afm_jax.Platform(4.0, 180.0), afm_jax.ImpactLaw(0.9))
afm_jax.save_scene(scene, "/dev/null")
assert not [name for name in sys.modules if name.startswith(("afm_jax.contact", "diffrax", "scipy.optimize"))]
# statistics alone take as long as JAX, and posteriors import them
import fitting.infer.fit, fitting.report.report
assert "scipy" not in sys.modules
import afm_jax.plots.motion
assert "matplotlib.pyplot" not in sys.modules
for package in (afm_jax, fitting):
    for module in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
        if not module.name.endswith("__main__"):
            importlib.import_module(module.name)
assert {name for name, value in before.items() if jax.config.values[name] != value} == set()
public = {name: getattr(package, name) for package in (afm_jax, fitting) for name in dir(package)}
# `import fitting.calibration.sweep` puts the name `calibration` into `fitting`: were a folder called `calibrate`,
# the function of that name would be gone
assert [name for name, each in public.items() if inspect.ismodule(each)] == ["fitting"]
"""


def test_importing_brings_no_more_than_is_used_changes_no_setting_and_takes_no_functions_place():
    assert python(PROGRAM) == ""


WITHOUT_EXTRAS = """
import importlib, sys
for package in ("blackjax", "dask", "distributed", "mpmath", "numcodecs", "pandas", "xarray", "zarr"):
    sys.modules[package] = None  # imports fail
import jax
jax.config.update("jax_enable_x64", True)
from afm_jax.cli.main import COMMANDS
for row in COMMANDS.values():
    try:
        importlib.import_module(row.runs.partition(":")[0], "afm_jax.cli")
    except ModuleNotFoundError as error:
        print(row.name, error.name)
"""


def test_a_command_needs_the_packages_of_extras_only_for_what_they_are_for():
    # most of them take a second to import, too
    assert python(WITHOUT_EXTRAS).splitlines() == ["sweep xarray"]
