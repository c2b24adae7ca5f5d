"""README and pages: what they tell to type works, and README shows what comes of it."""

import re
import shlex
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from afm_jax.cli import main

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")
PAGES = [ROOT / "README.md", *sorted((ROOT / "notebooks").rglob("*.md"))]
COMMAND = re.compile(r"^ {4}afm-jax (.*)$|`afm-jax ([a-z][^`]*)`", re.MULTILINE)
RELATIVE = 2e-3
"""How far a number shown may be from the one that this machine prints: last digits of fits."""


def commands(text: str) -> list[list[str]]:
    return [shlex.split(found.group(1) or found.group(2)) for found in COMMAND.finditer(text)]


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", README, re.MULTILINE | re.DOTALL)


def same(shown: str, printed: str) -> bool:
    """Say whether two lines have the same words, and numbers that agree."""
    words, others = shown.split(), printed.split()
    return len(words) == len(others) and all(map(_same_word, words, others))


def _same_word(word: str, other: str) -> bool:
    try:
        return float(word) == pytest.approx(float(other), rel=RELATIVE, abs=0.02)
    except ValueError:
        return word == other


def test_readme_is_short_and_keeps_its_promises():
    assert len(README.splitlines()) <= 150
    for target in ("fit", "test", "check", "thorough", "docs"):
        assert f"make {target}" in README
    for link in re.findall(r"\]\(([^)]+)\)", README):
        assert (ROOT / link).exists(), link


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_commands_named_exist_with_their_options(page: Path):
    for name, *arguments in commands(page.read_text(encoding="utf-8")):
        if name == "COMMAND":
            continue
        command = main.main.get_command(click.Context(main.main), name)
        assert command is not None, name
        known = {option for parameter in command.params for option in [*parameter.opts, *parameter.secondary_opts]}
        assert {word for word in arguments if word.startswith("--")} <= {*known, "--help"}, [name, *arguments]


@pytest.mark.slow
def test_readme_shows_what_its_commands_print(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    (table,) = blocks("csv")
    (tmp_path / "my_amplitudes.csv").write_text(table)
    (tmp_path / "fitting").symlink_to(ROOT / "fitting")
    typed = re.findall(r"^ {4}(afm-jax .*)$", README, re.MULTILINE)
    printed: list[str] = []
    for line in typed:
        result = CliRunner().invoke(main.main, shlex.split(line)[1:])
        assert result.exit_code == 0, (line, result.output, result.exception)
        printed += result.output.splitlines()
    for line in (line for block in blocks("text") for line in block.splitlines() if line.strip()):
        assert any(same(line, other) for other in printed), line


@pytest.mark.slow
def test_python_of_readme_runs(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(ROOT)
    (code,) = blocks("python")
    names: dict = {}
    exec(code, names)  # noqa: S102
    assert names["result"].valid
    assert names["orbits"].stable.any()
