"""Tests that bite: each wrong formula of `mutations`, put into a copy of the packages, must turn a named test red."""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import pytest

from tests.mutations import MUTATIONS, before_and_after

ROOT = Path(__file__).parent.parent
PACKAGES = ("afm_jax", "fitting")
AT_ONCE = 2
TIME_LIMIT_S = 1200
UNCHANGED = "unchanged"


def copy_of_the_packages(folder: Path, cache: Path) -> Path:
    """Copy what the tests need; compiled programs are kept in a folder that all copies share."""
    for name in (*PACKAGES, "tests"):
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", folder)
    (folder / ".pytest_cache").symlink_to(cache, target_is_directory=True)
    return folder


def run_tests(folder: Path, tests: list[str]) -> subprocess.CompletedProcess[str]:
    """Run tests in a copy, whose packages come before the installed ones."""
    # -x ends at the first red test, a fixed seed keeps hypothesis from looking elsewhere in each run
    options = ("-x", "-q", "-p", "no:cacheprovider", "--hypothesis-seed=0", "-m", "slow or not slow")
    return subprocess.run(
        [sys.executable, "-m", "pytest", *options, *tests],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1", "JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
        timeout=TIME_LIMIT_S,
        check=False,
    )


def mutate(folder: Path, name: str) -> None:
    """Apply a mutation."""
    path, (before, after) = place_of(folder, name), before_and_after(MUTATIONS[name].edit)
    path.write_text(path.read_text().replace(before, after))


def place_of(folder: Path, name: str) -> Path:
    """Return the file of the packages in which a mutation's text stands, exactly once."""
    before, _ = before_and_after(MUTATIONS[name].edit)
    files = [path for package in PACKAGES for path in (folder / package).rglob("*.py")]
    places = {path: count for path in files if (count := path.read_text().count(before))}
    found = {str(path.relative_to(folder)): count for path, count in places.items()}
    assert sum(places.values()) == 1, f"mutation {name!r}: {before!r} stands in {found}, not once"
    return next(iter(places))


def test_every_wrong_formula_has_its_place():
    for name in MUTATIONS:
        place_of(ROOT, name)


@pytest.fixture(scope="module")
def outcome(
    tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest
) -> Iterator[Callable[[str], subprocess.CompletedProcess[str]]]:
    """Run the unchanged copy first, then the mutations that were selected, two at a time."""
    base = tmp_path_factory.mktemp("mutations")
    (base / "cache").mkdir()
    folder = copy_of_the_packages(base / UNCHANGED, base / "cache")
    unchanged = run_tests(folder, sorted({mutation.test for mutation in MUTATIONS.values()}))
    items = [item for item in request.session.items if hasattr(item, "callspec")]
    selected = {vars(item)["callspec"].params.get("name") for item in items}

    def job(number: int, name: str) -> subprocess.CompletedProcess[str]:
        folder = copy_of_the_packages(base / f"copy{number}", base / "cache")
        mutate(folder, name)
        return run_tests(folder, [MUTATIONS[name].test])

    with ThreadPoolExecutor(AT_ONCE) as pool:
        jobs: dict[str, Future[subprocess.CompletedProcess[str]]] = {
            name: pool.submit(job, number, name) for number, name in enumerate(MUTATIONS) if name in selected
        }
        yield lambda name: unchanged if name == UNCHANGED else jobs[name].result()


@pytest.mark.slow
def test_the_unchanged_copy_is_green(outcome):
    done = outcome(UNCHANGED)
    assert done.returncode == 0, done.stdout[-4000:]


@pytest.mark.slow
@pytest.mark.parametrize("name", MUTATIONS)
def test_a_wrong_formula_turns_a_test_red(outcome, name: str):
    done = outcome(name)
    # 1: tests ran and failed; anything else (2 interrupted, 4 no such test, 5 none) proves nothing.
    assert done.returncode == 1, (
        f"{name}: {MUTATIONS[name].test} did not notice\n{done.stdout[-3000:]}{done.stderr[-1000:]}"
    )
    assert " failed" in done.stdout
