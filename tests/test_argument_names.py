"""Messages of the library name arguments of Python; commands name their options for them, wherever they say it."""

import ast
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest
from click.testing import CliRunner

import fitting
from afm_jax.cli import main
from afm_jax.cli.command import in_options
from afm_jax.strict_json import strict_json
from afm_jax.whole_files import in_callers_words
from fitting.instruments.curve import table_text
from fitting.parameters import model_parameters
from fitting.tables.several import SeveralTables
from tests.instrument_files import separated, tapping_rows
from tests.strict_reading import strictly
from tests.test_imports import LIBRARY, tree_of

EXAMPLE = Path(fitting.__file__).parent / "examples" / "amplitudes_law.csv"
OFFSET, AMPLITUDE, LAG = tapping_rows()
IMAGE = np.full((4, 4), 10.0)
CURVE = """# drive = force
# free_frequency_khz = 90
drive_frequency_khz,free_amplitude_nm,offset_nm,lockin_amplitude_nm,lockin_amplitude_error_nm
92,40,-50,40,0.1
92,40,-20,20,0.1
"""


def _written(path: Path) -> Path:
    """Write the files of the calls below into a folder and return it."""
    for name, text in {
        "abc.csv": separated({"a": OFFSET, "b": AMPLITUDE, "c": LAG}, ";"),
        "force.csv": separated({"Z (nm)": OFFSET, "Amp (nm)": AMPLITUDE, "Phase (deg)": np.deg2rad(LAG)}),
        "wrong.csv": separated({"Z (V)": OFFSET, "Amp (nm)": AMPLITUDE}),
        "volts.csv": separated({"Z (nm)": OFFSET, "Amp (V)": AMPLITUDE, "Phase (deg)": LAG}),
        "tap.csv": CURVE,
        "table.csv": EXAMPLE.read_text("utf-8").replace("_error_nm", "_erased_nm"),
        "no_errors.csv": "# free_frequency_khz = 90\n# quality_factor = 40\norder,drive_frequency_khz,"
        "drive_amplitude_nm,offset_nm,peak_amplitude_nm\n1,174.6,6,-1,125.87\n",
        "no_quality.csv": re.sub("# quality_factor.*\n", "", EXAMPLE.read_text("utf-8")),
    }.items():
        (path / name).write_text(text, "utf-8")
    np.savez(path / "volts.npz", amplitude_v=IMAGE, phase_deg=IMAGE)
    np.savez(path / "names.npz", first=IMAGE, second=IMAGE)
    return path


LEVER: dict[str, Any] = {"free_frequency_khz": 90.0, "quality_factor": 200.0}
LEVER_OPTIONS = ("--free-frequency-khz", "90", "--quality-factor", "200")
CALLS: dict[str, tuple[Callable[[Path], Any], str, tuple[str, ...], str]] = {
    "which channels": (
        lambda path: fitting.read_curves(path / "abc.csv"),
        'say `columns="offset_nm=a:nm,lockin_amplitude_nm=b:nm,phase_lag_deg=c:deg"`',
        ("read", "abc.csv"),
        "say --columns offset_nm=a:nm,lockin_amplitude_nm=b:nm,phase_lag_deg=c:deg",
    ),
    "what a table needs": (
        lambda path: table_text(fitting.read_curve(path / "volts.csv")),
        '`free_frequency_khz=KHZ` `nm_per_volt=NM_PER_V|"slope"`',
        ("tapping", "volts.csv"),
        "--free-frequency-khz KHZ --nm-per-volt NM_PER_V|slope",
    ),
    "a table's Q": (
        lambda path: fitting.invert(fitting.read_table(path / "no_quality.csv")),
        "give `quality_factor=40, quality_factor_error=2` (",
        ("invert", "no_quality.csv"),
        "give --quality-factor '40 +- 2' (",
    ),
    "sensitivity": (
        lambda path: fitting.tapping_map(path / "volts.npz", free_amplitude_nm=13.4, free_phase_deg=90.0, **LEVER),
        "give `nm_per_volt=NM`",
        ("tapping-map", "volts.npz", "--free-amplitude-nm", "13.4", "--free-phase-deg", "90", *LEVER_OPTIONS),
        "give --nm-per-volt NM",
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
    monkeypatch.chdir(_written(tmp_path))
    call, in_python, command, in_the_shell = CALLS[name]
    with pytest.raises(ValueError, match=re.escape(in_python)):
        call(tmp_path)
    result = CliRunner().invoke(main.main, list(command), prog_name="afm-jax")
    assert (result.exit_code, len(result.stderr.splitlines())) == (2, 1)
    assert in_the_shell in result.stderr


def test_text_json_and_files_of_a_command_name_its_options(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(_written(tmp_path))
    columns, noise = "offset_nm=a:nm,lockin_amplitude_nm=b:nm,phase_lag_deg=c:deg", np.random.default_rng(1)
    images = 10.0 + noise.normal(size=(9, 9)), 80.0 + noise.normal(size=(9, 9))
    np.savez("image.npz", amplitude_nm=images[0], phase_deg=images[1])
    (curve,) = fitting.read_curves("abc.csv", columns=columns, **LEVER)
    found = fitting.tapping_map("image.npz", free_amplitude_nm=13.4, free_phase_deg=90.0, **LEVER)
    assert any('say `phase_sense="lag|lead"`' in note for note in curve.notes)
    assert any("(`amplitude_error_nm=...`, `phase_error_deg=...`)" in note for note in found.notes)
    for call, out, files, said in (
        (
            ["read", "abc.csv", "--columns", columns],
            "t.csv",
            ["t.csv"],
            "say --phase-sense lag|lead.",
        ),
        (
            ["tapping-map", "image.npz", "--free-amplitude-nm", "13.4", "--free-phase-deg", "90"],
            "map",
            ["map/map.json", "map/map.txt"],
            "(--amplitude-error-nm, --phase-error-deg)",
        ),
    ):
        text, as_json = (
            CliRunner().invoke(main.main, [*call, *LEVER_OPTIONS, *more]) for more in ((), ("--json", "--out", out))
        )
        strictly(as_json.stdout)
        assert "option --free-frequency-khz" in text.stdout
        for each in (text.stdout, as_json.stdout, *(Path(name).read_text("utf-8") for name in files)):
            # a terminal wraps where it is narrow
            assert said in " ".join(each.split())
            assert "`" not in each


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


def test_laws_of_different_tips_are_refused_with_both_ways_out():
    table = fitting.read_table(EXAMPLE)
    with pytest.raises(ValueError, match="fit each by itself"):
        SeveralTables((table, replace(table, mass_ng=2.0, source="other")))


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
