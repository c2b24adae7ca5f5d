"""`afm-jax collide`: its numbers against 30 digits and closed forms, its output, and how it ends."""

import csv
import inspect
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from matplotlib.image import imread

from afm_jax import Cantilever, Contact, Platform, Scene, save_scene
from afm_jax.cli.main import main
from afm_jax.cli.values import Numbers
from afm_jax.contact.collide import _COLUMNS as COLUMNS
from afm_jax.contact.collide import default_speeds
from afm_jax.contact.parameters import PAPER
from afm_jax.plots.collisions import collisions_figure
from tests.reference_contact import ContactParameters, capture_speed, collision, junction
from tests.strict_reading import strictly

EFFECTS = ("capillary", "structural", "core", "jkr")
SPEEDS = (12.0, 15.0, 20.0, 200.0)


def run(*arguments: object):
    return CliRunner().invoke(main, ["collide", *(str(argument) for argument in arguments)])


def answer(*arguments: object) -> dict[str, Any]:
    """Return the JSON object of a successful call; NaN and Infinity, which JSON does not have, are refused."""
    result = run(*arguments, "--json")
    assert result.exit_code == 0, result.stderr
    return strictly(result.stdout)


def test_a_mass_that_nothing_says_is_named_as_assumed(tmp_path):
    assumed = answer("--speeds", 40)
    assert assumed["notes"][0].startswith("1 ng assumed")
    assert "1 ng assumed" in run("--speeds", 40).stdout
    path = tmp_path / "scene.toml"
    head, rest = (
        "[cantilever]\nfrequency_khz = 90\n",
        "[platform]\namplitude_nm = 4\nfrequency_khz = 180\noffset_nm = 0\n",
    )
    path.write_text(f'{head}{rest}[interaction]\nmodel = "contact"\n')
    assert answer(path, "--speeds", 40)["notes"][0].startswith("1 ng assumed")
    path.write_text(f'{head}spring_constant_n_per_m = 0.5\n{rest}[interaction]\nmodel = "contact"\n')
    stated = answer(path, "--speeds", 40)
    assert "notes" not in stated
    assert stated["mass_ng"] == pytest.approx(0.5 / (2.0 * np.pi * 0.09) ** 2, rel=1e-14)


def test_a_spring_constant_says_the_mass():
    given = ("--speeds", 40, "--spring-constant-n-per-m", 0.5)
    assert answer(*given, "--free-frequency-khz", 90)["mass_ng"] == pytest.approx(0.5 / (2.0 * np.pi * 0.09) ** 2)
    alone = run(*given)
    assert alone.exit_code == 2
    assert "--free-frequency-khz" in alone.stderr
    both = run(*given, "--free-frequency-khz", 90, "--mass-ng", 1.6)
    assert both.exit_code == 2
    assert "contradict each other" in both.stderr


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("collide")


@pytest.fixture(scope="module")
def paper(out: Path) -> dict[str, Any]:
    return answer("--speeds", "5,12,15,20,200", "--out", out)


def test_speeds_and_delays_are_the_references(paper: dict[str, Any]):
    parameters = ContactParameters()
    for index, speed in enumerate(SPEEDS, start=1):
        exact = collision(parameters, speed, digits=15)
        # the accuracy asked for: 1e-9, ten times that in us for the delay
        for name, value, (rtol, atol) in (
            ("rebound_speed_nm_per_us", exact.rebound_speed_nm_per_us, (1e-9, 0.0)),
            ("collision_delay_us", exact.delay_us, (0.0, 1e-8)),
            ("time_in_junction_us", exact.time_in_junction_us, (1e-8, 0.0)),
            ("deepest_gap_nm", exact.deepest_gap_nm, (1e-8, 0.0)),
            ("viscous_loss_aj", exact.viscous_loss_aj, (1e-7, 0.0)),
        ):
            np.testing.assert_allclose(paper[name][index], float(value), rtol=rtol, atol=atol)
    np.testing.assert_allclose(paper["capture_speed_nm_per_us"], float(capture_speed(parameters, digits=15)), rtol=1e-9)
    solid = junction(parameters, digits=15)
    for name, value in (("forms_gap_nm", solid.snap_on_gap_nm), ("breaks_gap_nm", solid.snap_off_gap_nm)):
        np.testing.assert_allclose(paper["junction"][name], float(value), rtol=1e-10, atol=0.0)
    hysteresis = solid.bridge_hysteresis_aj + solid.junction_hysteresis_aj
    np.testing.assert_allclose(paper["junction"]["hysteresis_aj"], float(hysteresis), rtol=1e-10, atol=0.0)


def test_a_captured_tip_has_no_numbers_but_a_sentence(paper: dict[str, Any]):
    assert paper["captured"] == [True, False, False, False, False]
    for name in ("rebound_speed_nm_per_us", "collision_delay_us", "time_in_contact_us", "bridge_hysteresis_aj"):
        assert paper[name][0] is None
        assert None not in paper[name][1:]
    assert "the liquid bridge holds it" in paper["outcome"][0]
    assert paper["end_energy_aj"][0] < 0.0
    assert paper["capture_speed_reason"] is None


def rows_of(paper: dict[str, Any]) -> list[dict[str, Any]]:
    return [dict(zip(COLUMNS, row, strict=True)) for row in zip(*(paper[name] for name in COLUMNS), strict=True)]


def test_energy_ledger_closes(paper: dict[str, Any]):
    rows = rows_of(paper)
    for row in rows[1:]:
        kept = 0.5 * row["rebound_speed_nm_per_us"] ** 2
        lost = row["bridge_hysteresis_aj"] + row["junction_hysteresis_aj"] + row["viscous_loss_aj"]
        # of numbers of 2e4 aJ, each to the accuracy of the rebound speed
        np.testing.assert_allclose(kept + lost, 0.5 * row["approach_speed_nm_per_us"] ** 2, rtol=3e-9, atol=0.0)


def test_files_hold_what_is_printed(paper: dict[str, Any], out: Path):
    assert {path.name for path in out.iterdir()} == {"collide.csv", "collide.json", "collide.png"}
    assert json.loads((out / "collide.json").read_text("utf-8")) == paper
    with (out / "collide.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert tuple(rows[0]) == COLUMNS
    assert rows[0]["rebound_speed_nm_per_us"] == ""
    assert [float(row["rebound_speed_nm_per_us"]) for row in rows[1:]] == paper["rebound_speed_nm_per_us"][1:]
    assert [row["captured"] for row in rows] == ["true", "false", "false", "false", "false"]


def test_picture_shows_curve_capture_delay_and_losses(out: Path, paper: dict[str, Any]):
    assert imread(out / "collide.png").shape[1] >= 1400
    rows = rows_of(paper)
    panels = collisions_figure(rows, paper["capture_speed_nm_per_us"]).axes
    drawn = [{line.get_label(): np.asarray(line.get_ydata())[1:] for line in axes.lines} for axes in panels]
    np.testing.assert_array_equal(drawn[0]["contact"], paper["rebound_speed_nm_per_us"][1:])
    np.testing.assert_array_equal(np.asarray(panels[1].lines[0].get_ydata())[1:], paper["collision_delay_us"][1:])
    for label, name in (
        ("liquid bridge", "bridge_hysteresis_aj"),
        ("solid junction", "junction_hysteresis_aj"),
        ("viscous", "viscous_loss_aj"),
    ):
        np.testing.assert_array_equal(drawn[2][label], paper[name][1:])
    # the captured range is shaded in each panel
    for axes in panels:
        (shade,) = axes.patches
        assert shade.get_extents().transformed(axes.transData.inverted()).x1 == pytest.approx(
            paper["capture_speed_nm_per_us"]
        )


def test_without_viscosity_the_speed_follows_from_the_energy():
    found = answer("--no-viscous", "--speeds", "20:60:20", "--mass-ng", "2")
    hysteresis = found["junction"]["hysteresis_aj"]
    speeds = np.array([20.0, 40.0, 60.0])
    # nothing is integrated but potentials in closed form
    np.testing.assert_allclose(found["rebound_speed_nm_per_us"], np.sqrt(speeds**2 - hysteresis), rtol=1e-12, atol=0.0)
    np.testing.assert_allclose(found["capture_speed_nm_per_us"], np.sqrt(hysteresis), rtol=1e-9, atol=0.0)
    assert found["viscous_loss_aj"] == [0.0, 0.0, 0.0]
    assert found["contact"]["effects"] == list(EFFECTS)
    assert "viscosity_pa_s" not in found["contact"]


def test_options_and_scenes_reach_the_contact(tmp_path: Path):
    path = tmp_path / "scene.toml"
    contact = Contact.paper(effects=EFFECTS, modulus_gpa=80.0, relative_humidity=0.45)
    save_scene(Scene(Cantilever(90.0, mass_ng=1.5), Platform(4.0, 180.0), contact), path)
    found = answer(path, "--speeds", "30", "--relative-humidity", "0.4", "--bridge-forms-nm", "3")
    assert found["mass_ng"] == 1.5
    changes = {"modulus_gpa": 80.0, "relative_humidity": 0.4, "bridge_forms_nm": 3.0}
    exact = collision(ContactParameters(**changes, mass_ng=1.5, effects=EFFECTS), 30.0, digits=15)
    # the accuracy that is asked for by default
    np.testing.assert_allclose(found["rebound_speed_nm_per_us"], [float(exact.rebound_speed_nm_per_us)], rtol=1e-9)
    assert {name: found["contact"][name] for name in changes} == changes
    assert answer(path, "--speeds", "30", "--mass-ng", "1")["mass_ng"] == 1.0


def test_help_names_the_papers_values():
    keywords = inspect.signature(Contact.paper).parameters
    assert {name: keyword.default for name, keyword in keywords.items() if name != "effects"} == PAPER
    # wrapped to a width, and indented
    text = " ".join(CliRunner().invoke(main, ["collide", "--help"]).output.split())
    for name, value in PAPER.items():
        said = text.partition(f"--{name.replace('_', '-')} X ")[2].partition("paper: ")[2].partition(". ")[0]
        assert float(said) == value, name


def test_default_speeds_begin_above_the_capture_speed():
    speeds = answer()["approach_speed_nm_per_us"]
    # four digits
    np.testing.assert_allclose(speeds[0], 1.1 * 10.93845, rtol=1e-3, atol=0.0)
    assert speeds[-1] == 200.0
    assert len(speeds) == 20
    assert default_speeds(100.0)[-1] == 1100.0
    assert default_speeds(np.inf)[0] == default_speeds(0.0)[0] == 10.0


@pytest.mark.parametrize(
    ("text", "speeds"),
    [
        ("12,15,20", (12, 15, 20)),
        ("12:200:47", (12, 59, 106, 153, 200)),
        ("12:20:5", (12, 17)),
        ("7", (7,)),
        (" 30 , 10:12:1", (30, 10, 11, 12)),
    ],
)
def test_speeds_are_read(text: str, speeds: tuple[float, ...]):
    assert Numbers().read(text) == speeds


def test_a_range_holds_its_stop_in_spite_of_rounding():
    # 0.1 is no binary number: eighty steps of it reach 20 only nearly
    assert len(Numbers().read("12:20:0.1")) == 81
    assert len(Numbers().read("0.1:0.3:0.1")) == 3


def test_that_all_are_captured_is_a_result():
    result = run("--speeds", "1,2")
    assert result.exit_code == 0
    assert "All of these tips are captured; faster ones leave again." in result.stdout
    drowned = answer("--viscosity-pa-s", "1e6", "--speeds", "20")
    assert drowned["captured"] == [True]
    assert drowned["capture_speed_nm_per_us"] is None
    assert "There is no capture speed" in drowned["capture_speed_reason"]


def test_unresolved_collisions_end_with_exit_code_3():
    result = run("--speeds", "20,1e300", "--json")
    assert result.exit_code == 3
    assert "not valid: 1 of 2 collisions: The integration did not resolve" in result.stderr
    found = json.loads(result.stdout)
    assert found["captured"] == [False, None]
    assert found["rebound_speed_nm_per_us"][1] is None


def test_long_lists_are_cut_in_the_text_only():
    result = run("--speeds", "12:60:1")
    assert result.exit_code == 0
    assert "The first 40 of 49 collisions" in result.stdout
    assert "unit" not in result.stderr
    assert len(answer("--speeds", "12:60:1")["captured"]) == 49
