"""The notebooks: eight, on public names, stored without outputs, run from first to last cell, ended by an assertion."""

import ast
from pathlib import Path
from typing import Any

import pytest

import afm_jax
import fitting

NOTEBOOKS = sorted((Path(__file__).parent.parent / "notebooks").glob("*.ipynb"))


PACKAGES = {"afm_jax": afm_jax, "fitting": fitting}


def names_that_are_not_public(source: str) -> list[str]:
    """Return what a program takes of the two packages by import or attribute that `dir` of them does not list."""
    public = {package: {*dir(module)} - {"cli"} for package, module in PACKAGES.items()}
    found, called = [], {}
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            for name in node.names:
                if name.name in PACKAGES:
                    called[name.asname or name.name] = name.name
                elif name.name.partition(".")[0] in PACKAGES:
                    found.append(name.name)
        elif isinstance(node, ast.ImportFrom) and (node.module or "").partition(".")[0] in PACKAGES:
            names = public.get(str(node.module), set())
            found += [f"{node.module}.{name.name}" for name in node.names if name.name not in names]
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in called:
            package = called[node.value.id]
            if node.attr not in public[package] | {"__file__"}:
                found.append(f"{package}.{node.attr}")
    return found


def code_of(path: Path) -> str:
    """Return the cells of code of a notebook as one program, without lines that are for IPython alone."""
    import nbformat  # noqa: PLC0415  # a second and a half, which listing the tests need not take

    cells: list[Any] = nbformat.read(path, as_version=4).cells
    text = "\n".join(cell.source for cell in cells if cell.cell_type == "code")
    return "\n".join(line for line in text.splitlines() if not line.startswith("%"))


def test_there_are_eight():
    assert len(NOTEBOOKS) == 8


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_only_public_names(path):
    assert names_that_are_not_public(code_of(path)) == []


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_stored_without_outputs_and_ending_with_an_assertion(path):
    import nbformat  # noqa: PLC0415  # a second and a half, which listing the tests need not take

    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert all(cell.outputs == [] and cell.execution_count is None for cell in code)
    assert any(line.startswith("assert ") for line in code[-1].source.splitlines())


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_runs(path):
    from notebooks.run_notebooks import run  # noqa: PLC0415  # imports nbformat

    # kept for the site
    cells = run(path).cells
    assert any("image/png" in output.get("data", {}) for cell in cells for output in cell.get("outputs", []))
