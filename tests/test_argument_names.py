"""Messages of the library name arguments of Python; commands name their options for them, wherever they say it."""

import ast
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
import pytest
from click.testing import CliRunner

import fitting
from afm_jax.cli import main
from afm_jax.cli.command import in_options
from afm_jax.strict_json import strict_json
from afm_jax.whole_files import in_callers_words
from fitting.parameters import model_parameters
from tests.instrument_files import separated, tapping_rows
from tests.test_imports import LIBRARY, tree_of

EXAMPLE = Path(fitting.__file__).parent / "examples" / "amplitudes_law.csv"
OFFSET, AMPLITUDE, LAG = tapping_rows()


CALLS: dict[str, tuple[Callable[[Path], Any], str, tuple[str, ...], str]] = {
    "which channels": (
        lambda path: fitting.read_curves(path / "abc.csv"),
        'say `columns="offset_nm=a:nm,lockin_amplitude_nm=b:nm,phase_lag_deg=c:deg"`',
        ("read", "abc.csv"),
        "say --columns offset_nm=a:nm,lockin_amplitude_nm=b:nm,phase_lag_deg=c:deg",
    ),
    "a parameter's value": (
        lambda _: model_parameters("law", fixed={"r": 3.0}),
        "`fixed`: r must lie between 0.01 and 1, but is 3.0",
        ("fit", str(EXAMPLE), "--fix", "r=3"),
        "--fix: r must lie between 0.01 and 1, but is 3.0",
    ),
}


@pytest.mark.parametrize("name", CALLS)
def test_python_is_told_of_arguments_and_the_command_line_of_options(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    Path("abc.csv").write_text(separated({"a": OFFSET, "b": AMPLITUDE, "c": LAG}, ";"), "utf-8")
    call, in_python, command, in_the_shell = CALLS[name]
    with pytest.raises(ValueError, match=re.escape(in_python)):
        call(tmp_path)
    result = CliRunner().invoke(main.main, list(command), prog_name="afm-jax")
    assert (result.exit_code, len(result.stderr.splitlines())) == (2, 1)
    assert in_the_shell in result.stderr


def test_what_becomes_of_an_argument():
    options = {
        str(each.name): each
        for row in (main.COMMANDS["read"], main.COMMANDS["fit"])
        for each in row.click_command().params
        if isinstance(each, click.Option)
    }
    for said, wanted in {
        "`curve` must be 1": "--curve must be 1",
        "`drive` must go with `bin_nm`, not `offset_nm`": "--drive must go with --bin-nm, not `offset_nm`",
        "f.csv: `curve` must be 1": "f.csv: `curve` must be 1",
        "(`robust=True`, `bin_nm=...`)": "(--robust, --bin-nm)",
        "try `quality_factor=none`, `order=1`": "try --quality-factor none, `order=1`",
        "`quality_factor=40, quality_factor_error=2`": "--quality-factor '40 +- 2'",
    }.items():
        assert in_options(said, options) == wanted
        assert in_callers_words(said) == said
    for written in (strict_json, lambda text: text.replace('"', "&#34;")):
        assert "--nm-per-volt slope." in in_options(written('say `nm_per_volt="slope"`.'), options)


_COMMAND_LINE = re.compile(r"afm-jax [a-z][^`]*")
"""A whole command, which says where it is typed; to the end of its quotes or of the message."""


def _messages(tree: ast.Module) -> list[tuple[int, str]]:
    """Return the texts of a file with their lines, docstrings and comments apart; x where a value is put in."""
    apart = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    apart |= {id(part) for node in ast.walk(tree) if isinstance(node, ast.JoinedStr) for part in node.values}
    found = []
    for node in ast.walk(tree):
        if id(node) in apart:
            continue
        if isinstance(node, ast.JoinedStr):
            parts = [part.value if isinstance(part, ast.Constant) else "x" for part in node.values]
            found.append((node.lineno, "".join(map(str, parts))))
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            found.append((node.lineno, node.value))
    return found


def test_no_message_of_the_library_names_an_option_of_a_command():
    named = []
    for path in LIBRARY:
        if path.parts[:2] == ("afm_jax", "cli"):
            continue
        for line, text in _messages(tree_of(path)):
            # alone it is an argument of a process
            if not re.fullmatch(r"\s*--\S*", text) and re.search(r"(?<![\w-])--\w", _COMMAND_LINE.sub("", text)):
                named.append(f"{path}:{line}: {text}")
    assert not named, "\n".join(["write `argument=value` for these; the command line makes an option of it:", *named])
