"""Run the notebooks and keep what they show in build/, for the tests and for the site alike."""

import hashlib
import os
import warnings
from pathlib import Path
from tempfile import TemporaryDirectory

import nbformat

from afm_jax.compilation_cache import processor_key

ROOT = Path(__file__).parent.parent
KEPT = ROOT / "build" / "notebooks" / "gallery"
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
_SECONDS_A_CELL = 600


def run(path: Path) -> nbformat.NotebookNode:
    """Run a notebook from the first cell to the last, compiled as for users, and keep it with its outputs.

    Notebooks share what they have compiled: many fit by the same programs.

    Args:
        path: the notebook, which itself stays without outputs.

    Returns:
        The notebook with its outputs.

    Raises:
        nbclient.exceptions.CellExecutionError: if a cell fails.
    """
    notebook = nbformat.read(path, as_version=4)
    environment = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    environment |= {
        "PYTHONPATH": str(ROOT),
        "TF_CPP_MIN_LOG_LEVEL": "3",
        "JAX_COMPILATION_CACHE_DIR": str(ROOT / "build" / f"programs-{processor_key()}"),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    }
    with warnings.catch_warnings(), TemporaryDirectory() as folder:
        # Jupyter's own: event loops and transports, nothing of the notebook's
        warnings.simplefilter("ignore")
        from nbclient import NotebookClient  # noqa: PLC0415

        client = NotebookClient(
            notebook,
            timeout=_SECONDS_A_CELL,
            resources={"metadata": {"path": folder}},
            extra_arguments=["--IPKernelApp.log_level=ERROR"],  # not that kernels talk over TCP, on this very machine
        )
        client.execute(env=environment)
    notebook.metadata.pop("widgets", None)  # a page without a kernel shows pictures
    notebook.metadata["made_from"] = _made_from(path)
    KEPT.mkdir(parents=True, exist_ok=True)
    nbformat.write(notebook, KEPT / path.name)
    return notebook


def kept(path: Path) -> Path:
    """Return where a notebook with its outputs is; it is run unless it was, with this very program."""
    place = KEPT / path.name
    if not place.exists() or nbformat.read(place, as_version=4).metadata.get("made_from") != _made_from(path):
        run(path)
    return place


def _made_from(path: Path) -> str:
    """Return a mark of the notebook and of the library that it ran with."""
    library = [file for room in ("afm_jax", "fitting") for file in sorted((ROOT / room).rglob("*.py"))]
    mark = hashlib.sha256()
    for file in [path, *library]:
        mark.update(file.read_bytes())
    return mark.hexdigest()
