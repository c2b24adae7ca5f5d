"""A wheel and a source distribution: installed without the repository, they fit the bundled table."""

import os
import subprocess
import sys
import sysconfig
import tarfile
import venv
from importlib.util import find_spec
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


def run(*command: str, cwd: Path) -> str:
    """Return the output of a program that knows nothing of the repository."""
    variables = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(command, cwd=cwd, env=variables, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.slow
@pytest.mark.skipif(not (find_spec("hatchling") and find_spec("build")), reason="no hatchling, or no build")
def test_wheel_from_the_source_distribution_fits_the_example(tmp_path: Path):
    run(sys.executable, "-m", "build", "--no-isolation", "--outdir", str(tmp_path), str(ROOT), cwd=tmp_path)
    (source,), (wheel,) = tmp_path.glob("*.tar.gz"), tmp_path.glob("*.whl")
    with tarfile.open(source) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    documents = {"README.md", "LICENSE", "CITATION.cff", "SECURITY.md", "paper.md", "paper.bib"}
    assert {*documents, "tests/test_readme.py", "notebooks/mkdocs.yml"} <= names
    assert not any(name.startswith((".venv", "build", "report")) for name in names)

    place = tmp_path / "environment"
    venv.create(place, with_pip=False)
    python = str(place / "bin" / "python")
    install = ("install", "--quiet", "--no-deps", "--no-index", str(wheel))
    run(sys.executable, "-m", "pip", "--python", python, *install, cwd=tmp_path)
    # what it depends on comes from here; a .pth file does not bring along what is installed in place (editable)
    own = run(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))", cwd=tmp_path).strip()
    (Path(own) / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    assert run(python, "-c", "import afm_jax; print(afm_jax.__file__)", cwd=tmp_path).startswith(own)
    assert "VALID" in run(str(place / "bin" / "afm-jax"), "fit", "--example", cwd=tmp_path).split()
