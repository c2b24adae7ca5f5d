"""README and pages: what they tell to type works, and README shows what comes of it."""

import contextlib
import io
import math
import re
import shlex
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from afm_jax.cli import main
from tests.mutations import MUTATIONS
from tests.resonance_sweeps import synthetic_sweep

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")
PAGES = [ROOT / "README.md", *sorted((ROOT / "notebooks").rglob("*.md"))]
COMMAND = re.compile(r"^ {4}afm-jax (.*)$|`afm-jax ([a-z][^`]*)`", re.MULTILINE)
RELATIVE = 2e-3
"""How far a number shown may be from the one that this machine prints: last digits of fits."""


def commands(text: str) -> list[list[str]]:
    return [shlex.split(found.group(1) or found.group(2)) for found in COMMAND.finditer(text)]


def blocks(text: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.MULTILINE | re.DOTALL)


def same(shown: str, printed: str) -> bool:
    """Say whether two lines have the same words, and numbers that agree."""
    words, others = shown.split(), printed.split()
    return len(words) == len(others) and all(map(_same_word, words, others))


def _same_word(word: str, other: str) -> bool:
    try:
        return float(word) == pytest.approx(float(other), rel=RELATIVE, abs=0.02)
    except ValueError:
        return word == other


def test_no_page_counts_the_mutations_differently():
    texts = [page.read_text(encoding="utf-8") for page in [*PAGES, ROOT / "paper.md"]]
    assert {count for text in texts for count in re.findall(r"(\d+) wrong formulas", text)} <= {str(len(MUTATIONS))}


def test_readme_is_short_and_keeps_its_promises():
    assert len(README.splitlines()) <= 90
    assert all(f"make {target}" in README for target in ("fit", "test", "check", "thorough", "docs"))
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


def printed_by(line: str, arguments: list[str], code: int = 0) -> list[str]:
    """Return the lines that a command of a page prints."""
    result = CliRunner().invoke(main.main, arguments)
    assert result.exit_code == code, (line, result.output, result.exception)
    return result.output.splitlines()


def assert_shown(texts: list[str], printed: list[str]) -> None:
    for shown in "".join(texts).splitlines():
        assert not shown.strip() or any(same(shown, other) for other in printed), shown


@pytest.mark.slow
def test_readme_shows_what_its_commands_print(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    (tmp_path / "fitting").symlink_to(ROOT / "fitting")
    typed = [line for line in re.findall(r"^ {4}afm-jax (.*)$", README, re.MULTILINE) if "MY_FILE" not in line]
    printed = [told for line in typed for told in printed_by(line, shlex.split(line))]
    with contextlib.redirect_stdout(io.StringIO()) as output:
        for code in blocks(README, "python"):
            exec(code, {})  # noqa: S102
    assert_shown(blocks(README, "text"), [*printed, *output.getvalue().splitlines()])


EXAMPLES = ROOT / "fitting" / "examples"
STAND_FOR = {
    "TABLE.csv": str(EXAMPLES / "amplitudes_law.csv"),
    "my_amplitudes.csv": str(EXAMPLES / "amplitudes_law.csv"),
    "SWEEP": "resonance.csv",
    **dict.fromkeys(("first.csv", "second.csv", "third.csv"), str(EXAMPLES / "tapping_resonance.csv")),
    "TRACE": "half.csv",
}
FEWER = (
    (r"(:\d+(?:\.\d+)?):\d+$", r"\1:3"),
    (r"^\d+x\d+$", "4x4"),
    (r"^viscous\+delay$", "law"),
)
"""What pages name, as what is there; grids of a few points, and models that compile quickly."""
PAGES_WITH_COMMANDS = ("first_steps", "simulate", "drives", "contact", "fit", "orbits")
PAGES_WITH_COMMANDS += ("dynamics", "instrument", "design", "tapping", "sweeps")
LEFT_OUT = {
    "simulate figure8": "tests/test_simulate_contact.py simulates such scenes",
    "calibrate fitting/examples/real": "tests/test_thermal.py fits such spectra",
    "fit monday.csv": "three tables are fitted by tests/test_several_tables.py",
    "fit my_amplitudes.csv --model law --posterior": "samples for a minute: tests/test_posterior.py",
    "tapping RAMP.txt": "an export of a program that is not at hand: tests/test_instruments.py reads one like it",
    "basins": "compiles for twenty seconds: tests/test_dynamics.py",
    "bifurcation": "compiles for twenty seconds: tests/test_dynamics.py",
    "lyapunov": "compiles for twenty seconds: tests/test_lyapunov.py",
    "design --drive force": "a law with a delay compiles for half a minute: tests/test_experiment_drives.py",
    "tapping fitting/examples/real": "its sensitivity is found for ten seconds: tests/test_instruments.py",
}


def text_of(page: str) -> str:
    return (ROOT / "notebooks" / "pages" / f"{page}.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with what the pages tell to save, and what their first commands write."""
    folder = tmp_path_factory.mktemp("desk")
    (folder / "fitting").symlink_to(ROOT / "fitting")
    sweep = synthetic_sweep(noise=0.01)
    points = zip(sweep.frequency_khz.tolist(), sweep.amplitude.tolist(), strict=True)
    lines = [f"{khz!r},{amplitude!r}\n" for khz, amplitude in points]
    (folder / "resonance.csv").write_text("".join(["frequency_khz,amplitude_nm\n", *lines]))
    halves = [f"{0.25 * n!r},{5.0 * math.cos(2e-3 * math.pi * 181.8 * 0.25 * n)!r}\n" for n in range(2000)]
    (folder / "half.csv").write_text("".join(["time_us,deflection_nm\n", *halves]))
    (folder / "scene.toml").write_text(blocks(text_of("first_steps"), "toml")[0])
    (folder / "sweep.toml").write_text(blocks(text_of("sweeps"), "toml")[0].replace("201", "3"))
    for name, scene in zip(("base", "force", "two_tones"), blocks(text_of("drives"), "toml"), strict=True):
        (folder / f"{name}.toml").write_text(scene)
    return folder


def cheap(arguments: list[str]) -> list[str]:
    """Return the arguments of a command as it can be called here."""
    made = []
    for word in arguments:
        other = STAND_FOR.get(word, word)
        for pattern, new in FEWER:
            other = re.sub(pattern, new, other)
        made += [other] if other else []
    return made


@pytest.mark.slow
def test_commands_of_the_pages_run(desk: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(desk)
    monkeypatch.setenv("COLUMNS", "200")
    for page in PAGES_WITH_COMMANDS:
        text, printed = text_of(page), []
        for line, comment in re.findall(r"^ {4}afm-jax ([^#\n]*)(.*)$", text, re.MULTILINE):
            if not line.startswith(tuple(LEFT_OUT)):
                printed += printed_by(f"{page}: {line}", cheap(shlex.split(line)), 3 if "exit code 3" in comment else 0)
        if page == "drives":
            assert_shown(blocks(text, "text"), printed)


@pytest.mark.slow
def test_python_of_the_pages_runs(desk: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(desk)
    # slopes through contacts compile for half a minute: tests/test_collide_derivatives.py has them
    for page in ("first_steps", "contact", "fit", "orbits", "results", "simulate"):
        (code,) = blocks(text_of(page), "python")
        exec(re.sub(r"^slope = jax.*$", "", code, flags=re.MULTILINE), {})  # noqa: S102
