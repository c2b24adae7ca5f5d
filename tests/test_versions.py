"""Which versions the project runs with: what pyproject.toml allows, says and excludes, and what a start costs."""

import json
import re
import tomllib
from importlib import metadata
from typing import Any

import jax
import pytest
from click.testing import CliRunner, Result

from afm_jax.cli import doctor, main
from afm_jax.version import EXCLUDED_JAX
from tests.lower_bounds import PROJECT, lower_bounds

LISTED = tomllib.loads(PROJECT.read_text("utf-8"))["project"]
(JAX,) = (line for line in LISTED["dependencies"] if re.match(r"jax\W", line))


def test_excluded_versions_are_those_of_the_project_and_there_is_no_upper_bound():
    assert set(re.findall(r"!=([\d.]+)", JAX)) == set(EXCLUDED_JAX)
    assert "<" not in JAX
    assert not {jax.__version__, metadata.version("jaxlib")} & set(EXCLUDED_JAX)
    bound = tuple(int(part) for part in lower_bounds()["jax"].split("."))
    assert all(tuple(int(part) for part in number.split(".")) > bound for number in EXCLUDED_JAX)


def test_every_dependency_has_one_lower_bound(tmp_path):
    assert {"jax", "numpy", "pytest", "dask", "mkdocs-material"} <= set(lower_bounds())
    project = tmp_path / "pyproject.toml"
    head = (
        '[project]\nname = "x"\ndependencies = ["a>=1.5,!=1.6"]\n[project.optional-dependencies]\nall = ["x[more]"]\n'
    )
    project.write_text(f'{head}more = ["b[c,d]>=1"]')
    assert lower_bounds(project) == {"a": "1.5", "b": "1"}
    for wrong in ("a", "a<2", "a[c,d]>=2"):
        project.write_text(f'{head}more = ["{wrong}"]')
        with pytest.raises(ValueError, match=f"one lower bound.*{re.escape(wrong)}"):
            lower_bounds(project)


@pytest.fixture
def consulted(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Run the doctor, in the text form or another, without its programs: a call takes a moment."""
    monkeypatch.setattr(doctor, "try_cache", lambda _: True)

    def run(*options: str) -> Result:
        return CliRunner().invoke(main.main, ["doctor", *options])

    return run


@pytest.mark.parametrize("number", EXCLUDED_JAX)
def test_the_doctor_names_an_excluded_version(consulted, monkeypatch: pytest.MonkeyPatch, number: str):
    result, real = consulted("--json"), metadata.version
    assert (result.exit_code, json.loads(result.stdout)["excluded"]) == (0, None)
    with monkeypatch.context() as installed:
        installed.setattr(metadata, "version", lambda name: number if name == "jaxlib" else real(name))
        assert f"jaxlib {number} {EXCLUDED_JAX[number]}" in consulted().stderr
    # and one that is imported, too
    monkeypatch.setattr(jax, "__version__", number)
    result = consulted("--json")
    assert result.exit_code == 3
    (line,) = result.stderr.splitlines()
    assert line.startswith(f"afm-jax: not valid: jax {number} {EXCLUDED_JAX[number]}")
    assert line.endswith("pip install -U 'jax!=0.10.2,!=0.11.1'")
    assert json.loads(result.stdout)["excluded"].startswith(f"jax {number} ")
