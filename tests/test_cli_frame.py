"""The frame of the command line: what is imported when, what goes to which stream, and how a command ends."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
import jax
import numpy as np
import pytest
from click.testing import CliRunner, Result

import afm_jax
import fitting
from afm_jax import strict_json
from afm_jax.cli import main
from afm_jax.cli.command import Command, Output
from afm_jax.cli.ending import NotValid
from afm_jax.cli.session import Session
from afm_jax.columns import columns_of
from afm_jax.report import Table, lines_of, table_of
from tests import trial_commands
from tests.fresh_python import outputs, python

HEAVY = "{'jax', 'numpy', 'matplotlib', 'equinox', 'rich'}"


@pytest.fixture
def trial(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Result]:
    """Run a function as the command `trial` of afm-jax."""

    def run(body: Callable[..., Output | None], *arguments: str) -> Result:
        monkeypatch.setattr(trial_commands, "body", body)
        row = Command("trial", "Check", "tests.trial_commands:trial", computes=False)
        monkeypatch.setitem(main.COMMANDS, "trial", row)
        return CliRunner().invoke(main.main, ["trial", *arguments])

    return run


def failing(error: BaseException) -> Callable[[Session], Any]:
    """Return the body of a command that fails."""

    def body(_: Session) -> None:
        raise error

    return body


def test_packages_and_help_import_nothing_heavy():
    # one after the other in one process: whatever imported something would be named, and all that come after it
    calls = [["--help"], ["--version"], ["orbit"], *([name, "--help"] for name in main.COMMANDS)]
    code = f"""
import sys, afm_jax, fitting
heavy = lambda: {HEAVY} & set(sys.modules)
print("found packages", heavy())
from afm_jax.cli.main import main
for call in {calls}:
    try:
        main(call)
    except SystemExit:
        print("found", call, heavy())
"""
    found = [line for line in python(code).splitlines() if line.startswith("found ")]
    assert len(found) == 1 + len(calls)
    assert all(line.endswith(" set()") for line in found), found


def test_energies_of_a_curve_need_neither_jax_nor_the_maker_of_the_example():
    curve = Path(fitting.__file__).parent / "examples" / "tapping_resonance.csv"
    code = f"""
import sys
from afm_jax.cli.main import main
try:
    main(["tapping", {str(curve)!r}, "--json"])
except SystemExit:
    print("loaded", {{"jax", "scipy.interpolate"}} & set(sys.modules))
"""
    assert python(code).splitlines()[-1] == "loaded set()"


def test_exports_are_what_the_modules_define():
    for package, names in ((afm_jax, set(dir(afm_jax)) - {"__version__"}), (fitting, dir(fitting))):
        assert all(getattr(package, name).__name__ == name for name in names)
    with pytest.raises(AttributeError, match="module 'afm_jax' has no attribute 'Cantilevr'"):
        getattr(afm_jax, "Cantilevr")  # noqa: B009


def test_help_lists_all_commands_in_78_columns_and_each_has_json():
    words = " ".join(CliRunner().invoke(main.main, ["--help"]).stdout.split())
    assert [name for name, row in main.COMMANDS.items() if f" {name} {row.summary}" not in words] == []
    root = click.Context(main.main)
    for name in main.COMMANDS:
        command = main.main.get_command(root, name)
        assert command is not None
        assert any("--json" in option.opts for option in command.params), name
        help_text = CliRunner().invoke(main.main, [name, "--help"], terminal_width=78).stdout
        assert [line for line in help_text.splitlines() if len(line) > 78] == [], name


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (ValueError("`r` must be in [0, 1],\nbut is 2"), 2, "`r` must be in [0, 1], but is 2"),
        (fitting.TableError("t.csv, line 3: bad"), 2, "t.csv, line 3: bad"),
        (FileNotFoundError(2, "No such file or directory", "t.csv"), 2, "t.csv: No such file or directory"),
        (OSError(28, "No space left on device"), 2, "standard output: cannot be written (No space left on device)"),
        (OSError(28, "No space left on device", "t.csv"), 2, "t.csv: No space left on device"),
        (ModuleNotFoundError("no", name="mpmath"), 2, "the Python package `mpmath` is missing; install it with: pip"),
        (click.BadParameter("no good"), 2, "Invalid value: no good"),
        (NotValid("no orbit"), 3, "not valid: no orbit"),
        (KeyboardInterrupt(), 130, "interrupted"),
    ],
)
def test_failures_end_in_one_line_and_a_code(trial: Callable[..., Result], error: BaseException, code: int, line: str):
    result = trial(failing(error))
    assert result.exit_code == code
    # click ends the line on which a terminal shows ^C
    (said,) = result.stderr.strip("\n").splitlines()
    assert said.startswith(f"afm-jax: {line}")


def test_inner_failures_are_not_the_users_fault(trial: Callable[..., Result], monkeypatch: pytest.MonkeyPatch):
    def body(_: Session) -> None:
        np.linalg.inv(np.zeros((2, 2)))

    result = trial(body)
    assert (result.exit_code, result.stdout) == (1, "")
    (line,) = result.stderr.splitlines()
    assert line.startswith("afm-jax: the program failed, which is not the input's fault")
    assert "LinAlgError: Singular matrix" in line
    monkeypatch.setenv("AFM_JAX_TRACEBACK", "1")
    assert isinstance(trial(body).exception, np.linalg.LinAlgError)


LABEL = {"format": "afm-jax trial", "format_version": 1}
"""What every JSON object starts with, unless its command says so itself."""


def test_json_is_the_only_output_and_strict(trial: Callable[..., Result]):
    def body(session: Session) -> None:
        session.note("[platform] is not markup")
        told = {"speeds": np.array([1.0, np.nan]), "stuck": np.bool_(0), "count": np.int64(3), "where": Path("d")}
        session.emit(told | {"tips": jax.numpy.array([[0.1, -jax.numpy.inf]]), "more": (True, None, "x")}, "text")

    result = trial(body, "--json")
    told = {"speeds": [1.0, None], "stuck": False, "count": 3, "where": "d", "tips": [[0.1, None]]}
    assert json.loads(result.stdout) == LABEL | told | {"more": [True, None, "x"]}
    assert result.stderr == "[platform] is not markup\n"
    assert trial(body).stdout == "text\n"
    with pytest.raises(TypeError):
        strict_json.strict_json({"a": object()})


def test_text_fits_the_terminal_and_numbers_stay_whole(trial: Callable[..., Result], monkeypatch: pytest.MonkeyPatch):
    heads = [f"speed of {name} nm/us" for name in "abcdefgh"]
    rows = [[f"{1e5 * (k + 1) / 7 + row:.9g}" for k in range(8)] for row in range(5)]

    def body(session: Session) -> None:
        table = Table("", [head.replace(" nm", "\nnm") for head in heads], rows)
        title = "Speeds in a sentence that goes on and on"
        prose = "12345678.9 " * 20 + "[not markup] " + "end " * 20
        session.emit({}, title, table, prose)

    monkeypatch.setenv("COLUMNS", "40")
    result = trial(body)
    assert result.exception is None, result.exception
    words = result.stdout.split()
    assert max(map(len, result.stdout.splitlines())) <= 40
    assert all(words.count(cell) == 1 for row in rows for cell in row)
    assert words.count("12345678.9") == 20
    # nobody looks at a pipe: the table stays as it is
    monkeypatch.delenv("COLUMNS")
    assert sum(all(cell in line for cell in rows[0]) for line in trial(body).stdout.splitlines()) == 1


def test_tables_to_print_have_dashes_and_words():
    cells = {"name": "name", "x\nnm": "x", "short": "x:.2f", "good": "ok", "twice": lambda row: 2.0 * (row["x"] or 0.0)}
    rows = [{"name": "a", "x": 1.23456789, "ok": True}, {"name": "b", "x": None, "ok": np.bool_(0)}]
    table = table_of(cells, rows)
    assert table.rows == [["a", "1.23457", "1.23", "yes", "2.46914"], ["b", "-", "-", "no", "0"]]
    assert table.words == [True, False, False, True, False]
    lines = ["  name        x  short  good    twice", "             nm", "  a     1.23457   1.23  yes   2.46914"]
    assert lines_of("One.", None, table)[:4] == ["One.", *lines]


def test_tables_land_in_the_folder(trial: Callable[..., Result], tmp_path: Path):
    rows = [{"x": 0.1, "ok": True}, {"x": float("nan"), "ok": np.bool_(0)}, {"ok": None}]
    folder = tmp_path / "new" / "folder"
    result = trial(
        lambda session: session.write_columns("rows.csv", columns_of(rows, ["x", "ok"])), "--out", str(folder)
    )
    assert result.exit_code == 0
    assert (folder / "rows.csv").read_text("utf-8") == "x,ok\n0.1,true\n,false\n,\n"


def test_unusable_folder_ends_before_computing(trial: Callable[..., Result], tmp_path: Path):
    (tmp_path / "file").touch()
    called = []
    result = trial(called.append, "--out", str(tmp_path / "file" / "below"))
    assert (result.exit_code, result.stdout, called) == (2, "", [])
    assert "cannot write there" in result.stderr


def test_closed_pipe_is_quiet():
    code = "from afm_jax.cli.main import main\nmain(['--help'])"
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run([sys.executable, "-c", code], stdout=writer, stderr=subprocess.PIPE, check=False)
    os.close(writer)
    assert (done.returncode, done.stderr) == (1, b"")


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such signal")
def test_an_interrupt_while_packages_are_imported_is_one_line(tmp_path: Path):
    (tmp_path / "click.py").write_text("import os, signal, time\nos.kill(os.getpid(), signal.SIGINT)\ntime.sleep(9)\n")
    code = "import runpy, signal\nsignal.signal(signal.SIGINT, signal.default_int_handler)\n"
    code += "runpy.run_module('afm_jax', run_name='__main__')"
    assert outputs(code, {"PYTHONPATH": str(tmp_path)}, codes=(130,)) == ("", "afm-jax: interrupted\n")
