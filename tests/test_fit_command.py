"""`afm-jax fit`: what it prints, writes and returns."""

import csv
import json
from pathlib import Path

import pytest
from click.testing import CliRunner

import fitting.examples
from afm_jax.cli.main import main

EXAMPLE = Path(fitting.examples.__path__[0]) / "amplitudes_law.csv"


def run(*arguments: object):
    return CliRunner().invoke(main, ["fit", *(str(argument) for argument in arguments)])


@pytest.fixture(scope="module")
def reported(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    return run(EXAMPLE, "--json", "--out", folder), folder


def test_json_holds_the_promised_keys_and_nothing_else_is_printed(reported):
    result, _ = reported
    assert result.exit_code == 0
    answer = json.loads(result.stdout)
    assert answer["model"] == "law"
    assert answer["valid"] is True
    assert answer["degrees_of_freedom"] == 162
    assert {"chi2", "warnings", "reasons", "law", "input", "settings", "versions"} <= set(answer)
    for name in ("r", "epsilon"):
        parameter = answer["parameters"][name]
        low, high = parameter["interval95"]
        assert low < parameter["value"] < high
        assert parameter["standard_error"] > 0.0
    law = answer["law"]
    assert len(law["approach_speed_nm_per_us"]) == len(law["rebound_speed_nm_per_us"]) > 50


def test_report_is_written_and_holds_every_input(reported):
    _, folder = reported
    assert {"fit.txt", "fit.json", "fit.png", "fit_rows.csv", "law.csv"} <= {path.name for path in folder.iterdir()}
    kept = json.loads((folder / "fit.json").read_text(encoding="utf-8"))
    with EXAMPLE.open(encoding="utf-8") as file:
        given = list(csv.DictReader(line for line in file if not line.startswith("#")))
    for column in given[0]:
        assert kept["input"][column] == [float(row[column]) for row in given]
    with (folder / "fit_rows.csv").open(encoding="utf-8") as file:
        assert len(list(csv.DictReader(file))) == len(given)
    assert (folder / "fit.png").read_bytes().startswith(b"\x89PNG")


def test_text_says_the_verdict_and_the_law():
    result = run("--example")
    assert result.exit_code == 0
    assert "VALID" in result.stdout
    assert "u_out^2 = r^2 u_in^2 - epsilon" in result.stdout
    assert "0.9492 to 0.9508" in result.stdout


def test_contact_data_end_with_exit_code_3(contact_table_path):
    result = run(contact_table_path, "--model", "law", "--json")
    assert result.exit_code == 3
    answer = json.loads(result.stdout)
    assert answer["valid"] is False
    assert answer["chi2"] / answer["degrees_of_freedom"] > 100.0
    assert answer["parameters"]["r"]["interval95"] == [None, None]
    assert "does not explain" in result.stderr


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["no.csv"], "there is no such file"),
        ([], "give a table to fit"),
        (["--example", str(EXAMPLE)], "give a table to fit"),
        (["--example", "--model", "contact"], "is not one of 'restitution', 'law', 'viscous'"),
        (["--example", "--noise", "120%"], "must be a relative error such as 1% or 0.01"),
    ],
)
def test_wrong_calls_end_with_one_line_and_exit_code_2(arguments, said):
    result = run(*arguments)
    assert result.exit_code == 2
    assert result.stdout == ""
    assert len(result.stderr.strip().splitlines()) == 1
    assert said in result.stderr
