"""The notebooks: stored without outputs, run from the first cell to the last, ended by an assertion."""

from pathlib import Path

import pytest

NOTEBOOKS = sorted((Path(__file__).parent.parent / "notebooks").glob("*.ipynb"))


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
