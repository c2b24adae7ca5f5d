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
from tests.fresh_python import python
from tests.lower_bounds import PROJECT, lower_bounds

LISTED = tomllib.loads(PROJECT.read_text("utf-8"))["project"]
(JAX,) = (line for line in LISTED["dependencies"] if re.match(r"jax\W", line))


def test_excluded_versions_are_those_of_the_project_and_there_is_no_upper_bound():
    assert set(re.findall(r"!=([\d.]+)", JAX)) == set(EXCLUDED_JAX)
    assert "<" not in JAX
    bound = tuple(int(part) for part in lower_bounds()["jax"].split("."))
    assert all(tuple(int(part) for part in number.split(".")) > bound for number in EXCLUDED_JAX)


def test_this_environment_has_what_the_project_allows():
    assert jax.__version__ not in EXCLUDED_JAX
    assert metadata.version("jaxlib") not in EXCLUDED_JAX


def test_every_dependency_has_one_lower_bound(tmp_path):
    bounds = lower_bounds()
    assert {"jax", "numpy", "pytest", "dask", "mkdocs-material"} <= set(bounds)
    assert bounds["numpy"] == "2.2"
    project = tmp_path / "pyproject.toml"

    def bounds_of(*dependencies: str, extras: str = "") -> dict[str, str]:
        listed = ", ".join(f'"{line}"' for line in dependencies)
        head = f'[project]\nname = "x"\ndependencies = [{listed}]\n'
        project.write_text(f"{head}[project.optional-dependencies]\n{extras}")
        return lower_bounds(project)

    assert bounds_of("a>=1.5", "b>=1,!=1.6", extras='all = ["x[more]"]\n') == {"a": "1.5", "b": "1"}
    for wrong in ("a", "a<2", "a>=2"):
        with pytest.raises(ValueError, match="one lower bound"):
            bounds_of("a>=1.5", wrong)
    with pytest.raises(ValueError, match=r"'a\[c,d\]>=2'"):
        bounds_of("a>=1.5,!=1.6", extras='more = ["a[c,d]>=2"]\n')


def test_what_pip_installs_without_extras_is_what_was_agreed():
    # a package more is a decision: an extra, if only some need it
    names = {re.split(r"\W", line.replace("-", "_"))[0] for line in LISTED["dependencies"]}
    assert names == {
        *("jax", "diffrax", "equinox", "flatbuffers", "optax", "optimistix", "jaxtyping", "numpy", "scipy"),
        *("matplotlib", "click", "jinja2", "rich", "tomli_w"),
    }


@pytest.fixture
def consulted(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Run the doctor, in the text form or another, without its programs: a call takes a moment."""
    monkeypatch.setattr(doctor, "try_cache", lambda _: doctor.CacheTrial(found=True, seconds=0.1))
    monkeypatch.setattr(doctor, "time_impacts", lambda: 0.2)

    def run(*options: str) -> Result:
        return CliRunner().invoke(main.main, ["doctor", *options])

    return run


def test_the_doctor_has_no_complaint_about_this_environment(consulted):
    result = consulted("--json")
    assert result.exit_code == 0, result.stderr
    assert json.loads(result.stdout)["excluded"] is None
    assert "xcluded" not in consulted().stdout


@pytest.mark.parametrize("number", EXCLUDED_JAX)
def test_the_doctor_names_an_excluded_version_that_is_imported(consulted, monkeypatch: pytest.MonkeyPatch, number: str):
    monkeypatch.setattr(jax, "__version__", number)
    result = consulted()
    assert result.exit_code == 3
    (line,) = result.stderr.splitlines()
    assert line.startswith(f"afm-jax: not valid: jax {number} {EXCLUDED_JAX[number]}")
    assert line.endswith("pip install -U 'jax!=0.10.2,!=0.11.1'")
    assert f"Excluded version: jax {number} " in " ".join(result.stdout.split())
    assert json.loads(consulted("--json").stdout)["excluded"].startswith(f"jax {number} ")


@pytest.mark.parametrize("package", ["jax", "jaxlib"])
def test_the_doctor_names_an_excluded_version_that_is_installed(
    consulted, monkeypatch: pytest.MonkeyPatch, package: str
):
    real = metadata.version
    monkeypatch.setattr(metadata, "version", lambda name: "0.11.1" if name == package else real(name))
    result = consulted()
    assert result.exit_code == 3
    assert f"{package} 0.11.1 copies a whole array" in result.stderr


SECONDS = "import time\nbegin = time.process_time()\n{}\nprint(time.process_time() - begin)"


# what is not imported then: tests/test_cli_frame.py
@pytest.mark.parametrize(
    ("code", "limit_s"),
    [
        ("import afm_jax", 0.1),
        ("import fitting", 0.1),
        ("from afm_jax.cli.main import main; main(['--help'], standalone_mode=False)", 0.25),
    ],
)
def test_a_start_takes_a_moment(code: str, limit_s: float):
    # of the processor, the best of ten: other work on the machine hardly adds to it
    assert any(float(python(SECONDS.format(code)).splitlines()[-1]) < limit_s for _ in range(10))
