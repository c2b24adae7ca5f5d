"""The folders' order: imports point up the list only, packages start without JAX, its configuration is left alone."""

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from tests.fresh_python import python

ROOT = Path(__file__).parent.parent
# A room may import from rooms of lower or equal level.
LEVELS = {
    "units": 0,
    "version": 0,
    "lazy_names": 0,
    "strict_json": 0,
    "whole_files": 0,
    "words": 0,
    "columns": 0,
    "outcomes": 0,
    "checks": 1,
    "least_squares": 0,
    "saved": 1,
    "results": 1,
    "compilation_cache": 0,
    "solve": 2,
    "apparatus": 2,
    "impact": 3,
    "contact": 4,
    "motion": 5,
    "dynamics": 6,
    "scenefile": 6,
    "effects": 7,
    "sweeps": 7,
    "verify": 7,
    "bench": 8,
    "accuracy": 9,
    "plots": 10,
    "cli": 11,
    "__main__": 12,
}
# The same for fitting: what a fit needs, the fit, what is made of it.
FITTING_LEVELS = {
    "parameters": 0,
    "tables": 0,
    "traces": 6,
    "instruments": 1,
    "models": 1,
    "simulated": 1,
    "forward": 2,
    "gradients": 3,
    "fits": 3,
    "sampling": 4,
    "report": 5,
    "calibration": 6,
    "inversion": 6,
    "tapping_curves": 6,
    "experiments": 6,
    "bulk": 6,
    "benchmark": 7,
    "examples": 7,
}
LIBRARY = sorted(path.relative_to(ROOT) for name in ("afm_jax", "fitting") for path in (ROOT / name).rglob("*.py"))


@cache
def tree_of(path: Path) -> ast.Module:
    """Return a file of the library as its syntax tree, which is only read."""
    return ast.parse((ROOT / path).read_text())


def imported(path: Path) -> Iterator[str]:
    """Give the full names of the modules that a file imports, anywhere in it."""
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
    for package, levels in (("afm_jax", LEVELS), ("fitting", FITTING_LEVELS)):
        rooms = {path.with_suffix("").parts[1] for path in LIBRARY if path.parts[0] == package}
        assert rooms - {"__init__"} == set(levels), package


@pytest.mark.parametrize("path", [path for path in LIBRARY if path.parts[0] == "afm_jax"], ids=str)
def test_imports_point_up_the_list(path: Path):
    here = path.with_suffix("").parts[1]
    for name in imported(path):
        top = name.split(".")[0]
        if top == "fitting":
            assert here == "cli", f"{path} imports {name}"
        if top == "afm_jax" and here != "__init__" and room(name) in LEVELS:
            assert LEVELS[room(name)] <= LEVELS[here], f"{path} imports {name}, which lies below it"


@pytest.mark.parametrize("path", [path for path in LIBRARY if path.parts[0] == "fitting"], ids=str)
def test_imports_of_fitting_point_one_way(path: Path):
    here = path.with_suffix("").parts[1]
    for name in imported(path):
        there = room(name)
        if name.split(".")[0] == "fitting" and here != "__init__" and there in FITTING_LEVELS:
            assert FITTING_LEVELS[there] <= FITTING_LEVELS[here], f"{path} imports {name}, which lies below it"
            equal = there != here and FITTING_LEVELS[there] == FITTING_LEVELS[here]
            assert not equal, f"{path} imports {name}: rooms side by side know nothing of each other"


def test_files_import_each_other_in_no_circle():
    modules = {".".join(path.with_suffix("").parts): path for path in LIBRARY if path.name != "__init__.py"}
    needs = {name: set(imported(path)) & set(modules) for name, path in modules.items()}
    while needs:
        free = {name for name, needed in needs.items() if not needed & set(needs)}
        assert free, f"these files import each other in circles: {sorted(needs)}"
        needs = {name: needed for name, needed in needs.items() if name not in free}


def names_run(node: ast.AST) -> Iterator[str]:
    """Give the names that a definition uses when it runs: all but those of annotations."""
    for field, value in ast.iter_fields(node):
        if field in {"annotation", "returns"}:
            continue
        for part in value if isinstance(value, list) else [value]:
            if isinstance(part, ast.AST):
                yield from names_run(part)
    if isinstance(node, ast.Name):
        yield node.id


Known = dict[tuple[str, str], tuple[str, str] | ast.AST]


@cache
def definitions() -> Known:
    """Return what every name of every module stands for: its definition, or module and name of what is imported."""
    trees = {".".join(path.with_suffix("").parts): tree_of(path) for path in LIBRARY}
    known: Known = {}
    for module, tree in trees.items():
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and node.module:
                known |= {(module, one.asname or one.name): (node.module, one.name) for one in node.names}
        for node in tree.body:
            targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", node)]
            for target in targets:
                for part in ast.walk(target) if isinstance(target, ast.expr) else [target]:
                    name = getattr(part, "id", None) or getattr(part, "name", None)
                    if name is not None:
                        known[module, name] = node
    return known


def crossed(start: tuple[str, str]) -> set[str]:
    """Return the modules with something that a public call can enter: definitions followed by the names they use."""
    known = definitions()
    seen, ahead = {start}, [start]
    while ahead:
        here = ahead.pop()
        there = known.get(here)
        if isinstance(there, ast.AST):
            found = {(here[0], name) for name in names_run(there)} & set(known)
        else:
            found = {there} if there is not None else set()
        ahead += found - seen
        seen |= found
    # a name that is imported lies in the file that defines it
    return {module for module, name in seen if isinstance(known.get((module, name)), ast.AST)}


@pytest.mark.parametrize(
    ("module", "name", "most"),
    [
        ("afm_jax.motion.simulate", "simulate", 39),
        ("fitting.fits.fit", "fit", 57),
        ("afm_jax.contact.collide", "collide", 20),
        ("afm_jax.effects.study", "study_effects", 54),
    ],
)
def test_a_call_crosses_few_files(module: str, name: str, most: int):
    # the four of a scene are named because its path may be given instead
    # five of them write results into files; those of a contact are the most of the others; two of a fit's are blocks
    # of lanes, which it shares with scenes; discrepancy, step and law after it are a file each
    files = crossed((module, name))
    assert {module, "afm_jax.results"} <= files
    assert len(files) <= most, sorted(files)


def test_no_two_classes_have_one_name():
    found: dict[str, list[str]] = {}
    for path in LIBRARY:
        for node in tree_of(path).body:
            if isinstance(node, ast.ClassDef):
                found.setdefault(node.name, []).append(str(path))
    assert not {name: paths for name, paths in found.items() if len(paths) > 1}


def test_the_tests_of_the_imports_see_what_they_must():
    names = set(imported(Path("afm_jax/impact/map.py")))
    assert "afm_jax.impact.first_impact" in names
    assert room("afm_jax.impact.first_impact") == "impact"
    assert LEVELS["apparatus"] < LEVELS["impact"] < LEVELS["effects"] < LEVELS["plots"] < LEVELS["cli"]


PROGRAM = """
import importlib, inspect, pkgutil, sys
import afm_jax, fitting
print("jax" in sys.modules)
import jax
before = dict(jax.config.values)
import fitting.fits.fit, fitting.report.report
print("scipy" in sys.modules)
import afm_jax.plots.motion
print("matplotlib.pyplot" in sys.modules)
for package in (afm_jax, fitting):
    for module in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
        if not module.name.endswith("__main__"):
            importlib.import_module(module.name)
print({name for name, value in before.items() if jax.config.values[name] != value})
for package in (afm_jax, fitting):
    for name in dir(package):
        public = getattr(package, name)
        if callable(public) and not isinstance(public, type):
            print(name, inspect.signature(public))
        elif not callable(public):
            print(name, type(public).__name__)
print(inspect.signature(afm_jax.Cantilever))
print(inspect.signature(afm_jax.Cantilever.propagator))
"""


def test_importing_brings_no_more_than_is_used_changes_no_setting_and_takes_no_functions_place():
    lines = python(PROGRAM).splitlines()
    # names are taken when they are used; statistics alone take as long as JAX, and posteriors import them
    jax_is_there, scipy_is_there, pyplot_is_there, changed_settings = lines[:4]
    assert (jax_is_there, scipy_is_there, pyplot_is_there) == ("False", "False", "False")
    assert changed_settings == "set()"
    # `import fitting.calibration.sweep` puts the name `calibration` into `fitting`: were a folder called `calibrate`,
    # the function of that name would be gone
    assert [line for line in lines if line.endswith(" module")] == ["fitting module"]
    functions = {line.partition(" (")[0] for line in lines[4:-2] if " (" in line}
    assert {"fit", "calibrate", "lockin", "invert", "design", "simulate", "collide"} <= functions
    # signatures are short words
    assert not [line for line in lines if "Union[" in line or "afm_jax." in line or "collections" in line]
    constructor = "(frequency_khz: ArrayLike, quality_factor: ArrayLike | None = None, mass_ng: ArrayLike | None = None"
    assert lines[-2].startswith(constructor)
    assert lines[-1] == "(self, duration_us: ArrayLike) -> Propagator"


def changes_of_configuration(path: Path) -> list[int]:
    """Return the lines of a file that set an option of JAX or of its surroundings.

    Left out is what only runs when the file is a program: its `__main__` block and the functions called there.
    """
    tree = tree_of(path)
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
