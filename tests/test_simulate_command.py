"""`afm-jax simulate`: its numbers against orbits of the impact law, its files, and its refusals."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

from afm_jax import Cantilever, Contact, ImpactLaw, Platform, Scene, save_scene, single_impact_orbits
from afm_jax.cli.main import main
from afm_jax.motion.motion_table import lines_of
from afm_jax.motion.trajectory import pieces_between
from afm_jax.scenefile.scenefile import Start
from fitting.traces.lockin import lockin
from fitting.traces.trace import read_trace
from tests.strict_reading import strictly

LAW = Scene(Cantilever(90.0, 40.0), Platform(4.0, 181.8), ImpactLaw(0.9, 20.0))
KEYS = {"impacts", "stuck", "settled", "order", "peak_amplitude_nm", "lockin_amplitude_nm", "final"}


def simulate(*arguments: object) -> Result:
    return CliRunner().invoke(main, ["simulate", *map(str, arguments)], prog_name="afm-jax")


@pytest.fixture
def law_file(tmp_path: Path) -> Path:
    path = tmp_path / "law.toml"
    save_scene(LAW, path)
    return path


def nulls(answer: dict[str, object]) -> set[str]:
    """Return the keys at the top of an answer that are null."""
    return {key for key, item in answer.items() if item is None}


def test_without_a_duration_it_ends_when_settled(law_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    worked_out = []
    monkeypatch.setattr(
        "afm_jax.motion.trajectory.pieces_between", lambda *where: worked_out.append(where) or pieces_between(*where)
    )
    result = simulate(law_file, "--json", "--out", tmp_path / "out", "--harmonics", "1,3")
    assert result.exit_code == 0, result.stderr
    # observables, files and pictures look at one path
    assert len(worked_out) == 1
    answer = strictly(result.stdout)
    assert answer.keys() >= KEYS
    assert nulls(answer) == answer["null_reasons"].keys()
    orbits = single_impact_orbits(LAW, 1)
    slot = int(np.argmax(np.asarray(orbits.admissible) & np.asarray(orbits.stable)))
    assert (answer["settled"], answer["stuck"], answer["order"], answer["contacts_per_response"]) == (True, False, 1, 1)
    # the start is on the orbit, the impact map stays there to rounding
    for key in ("peak_amplitude_nm", "lockin_amplitude_nm", "lockin_phase_deg"):
        np.testing.assert_allclose(answer[key], float(getattr(orbits, key)[slot]), rtol=1e-7, err_msg=key)
    assert [harmonic["multiple"] for harmonic in answer["harmonics"]] == [1, 3]
    with (tmp_path / "out" / "contacts.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == answer["impacts"]
    speed = float(orbits.approach_speed_nm_per_us[slot])
    np.testing.assert_allclose([float(row["approach_speed_nm_per_us"]) for row in rows], speed, rtol=1e-7)
    with (tmp_path / "out" / "trajectory.csv").open(encoding="utf-8", newline="") as file:
        heights = [float(row["position_nm"]) for row in csv.DictReader(file)]
    # 2001 points a period: the highest misses the top by (pi/2001)^2/2 of the curve's scale at most
    np.testing.assert_allclose(max(heights), answer["peak_amplitude_nm"], rtol=1e-5)
    assert json.loads((tmp_path / "out" / "simulate.json").read_text()) == answer


def test_the_text_says_the_same(law_file: Path):
    answer = strictly(simulate(law_file, "--periods", 60.5, "--json").stdout)
    text = simulate(law_file, "--periods", 60.5).stdout
    assert f"{answer['impacts']} contacts" in text
    assert "Settled: the motion repeats: 1 contact in 1 drive period." in text
    assert f"Peak amplitude {answer['peak_amplitude_nm']:.6g} nm" in text
    assert answer["impacts"] == 60
    period = float(LAW.platform.period_us)
    np.testing.assert_allclose(answer["final"]["time_us"] - answer["start"]["time_us"], 60.5 * period, rtol=1e-12)
    assert answer["final"]["phase"] == "dry"


def test_too_short_to_settle_is_said_and_no_failure(law_file: Path):
    result = simulate(law_file, "--duration-us", 20, "--json")
    answer = strictly(result.stdout)
    assert (result.exit_code, answer["settled"], answer["order"]) == (0, False, None)
    assert "no sequence" in answer["settled_reason"]
    assert "Not settled: " in simulate(law_file, "--duration-us", 20).stdout


@pytest.mark.slow
def test_a_part_of_a_response_period_has_no_mean(law_file: Path):
    result = simulate(law_file, "--duration-us", 3, "--harmonics", "1,2", "--json")
    answer = strictly(result.stdout)
    assert (result.exit_code, answer["window"]["responses"]) == (0, 0)
    assert nulls(answer) == answer["null_reasons"].keys()
    short = {name for name, reason in answer["null_reasons"].items() if "shorter than a response period" in reason}
    assert short >= {"lockin_amplitude_nm", "lockin_phase_deg", "mean_height_nm", "given_by_drives_aj", "virial_aj"}
    assert short >= {"drive_lockin_amplitude_nm", "drive_lockin_phase_deg"}
    unread = {"amplitude_nm": None, "phase_deg": None}
    assert answer["harmonics"] == [
        {"multiple": k, "frequency_khz": pytest.approx(k * answer["response_frequency_khz"])} | unread for k in (1, 2)
    ]
    # the highest it has been is known
    assert answer["peak_amplitude_nm"] > 0.0


@pytest.mark.slow
@pytest.mark.parametrize("order", [1, 3])
def test_lockin_reads_the_trace_it_writes(tmp_path: Path, order: int):
    scene = Scene(Cantilever(90.0, 40.0), Platform(4.0, 181.8 * order, -1.0), LAW.interaction)
    save_scene(scene, tmp_path / "scene.toml")
    result = simulate(tmp_path / "scene.toml", "--json", "--out", tmp_path / "out", "--samples", "uniform")
    assert result.exit_code == 0, result.stderr
    answer = strictly(result.stdout)
    trace = read_trace(tmp_path / "out" / "trace.csv")
    assert (trace.settings.drive_amplitude_nm, trace.settings.offset_nm, trace.settings.quality_factor) == (4, -1, 40)
    read = lockin(trace)
    assert (read.steady, read.order) == (True, answer["order"])
    assert read.lockin_amplitude_nm is not None
    assert read.peak_amplitude_nm is not None
    # two ways through the same motion: integrals over flights, and a fit of harmonics to 400 samples a drive period
    np.testing.assert_allclose(read.lockin_amplitude_nm, answer["lockin_amplitude_nm"], rtol=1e-3)
    np.testing.assert_allclose(read.peak_amplitude_nm, answer["peak_amplitude_nm"], rtol=1e-4)
    turn = 360.0 / order
    assert abs((read.phase_deg - answer["lockin_phase_deg"] + 0.5 * turn) % turn - 0.5 * turn) < 0.05


@pytest.mark.slow
def test_a_tip_too_slow_sticks(tmp_path: Path):
    path = tmp_path / "stuck.toml"
    # 2 nm over the sample at rest: it comes far below the capture speed of 10.9 nm/us
    scene = Scene(Cantilever(90.0, 40.0), Platform(0.1, 180.0), Contact.paper())
    save_scene(scene, path, start=Start(0.0, 8.0, -1.0))
    result = simulate(path, "--periods", 60, "--json")
    answer = strictly(result.stdout)
    assert result.exit_code == 0, result.stderr
    assert (answer["stuck"], answer["settled"], answer["order"], answer["impacts"]) == (True, True, None, 1)
    assert answer["final"]["phase"] in ("bridge", "junction")
    # it rests within the range of the junction: between the deepest static gap and where the junction breaks
    assert abs(answer["final"]["position_nm"]) < 2.0
    assert nulls(answer) == answer["null_reasons"].keys()


def test_nothing_is_said_over_a_response_period_that_is_not_there():
    numbers = ("peak_amplitude_nm", "mean_height_nm", "given_by_drives_aj", "dissipated_in_air_aj")
    nothing = dict.fromkeys(("peak_deflection_nm", "phase_lag_deg", "peak_force_nn"))
    payload = dict.fromkeys(numbers, 1.0) | nothing | {"dissipated_in_contact_aj": 1.0, "stuck": False}
    payload |= {"impacts": 3, "settled": False, "settled_reason": "too short", "start": {"time_us": 0.0}}
    payload |= {"harmonics": [], "drive_frequency_khz": 180.0}
    payload |= dict.fromkeys(("lockin_amplitude_nm", "drive_lockin_amplitude_nm"), 10.0)
    payload |= dict.fromkeys(("lockin_phase_deg", "drive_lockin_phase_deg"), 0.0)
    payload |= {"final": {"time_us": 9.0, "position_nm": 1.0, "velocity_nm_per_us": 1.0, "phase": "dry"}}

    def said(responses: int) -> str:
        return " ".join(
            lines_of(payload | {"window": {"from_us": 7.2, "to_us": 9.0, "periods": 1, "responses": responses}})
        )

    assert "At the drive's frequency (180 kHz): 10 nm, 0 deg." in said(1)
    assert "Energy of a drive period" in said(1)
    assert "10 nm" not in said(0)
    assert "Energy" not in said(0)
    assert "Less than a response period" in said(0)


FORCED = """\
[cantilever]
frequency_khz = 90
quality_factor = 40
[platform]
amplitude_nm = 0
frequency_khz = 33
offset_nm = -1
[force]
free_amplitude_nm = 4
frequency_khz = 545.4
[interaction]
model = "law"
r = 0.99
epsilon = 0.1
viscous_loss = 0.01
"""


@pytest.mark.slow
def test_the_drives_frequency_is_read_and_named_whatever_harmonics_are_asked_for(tmp_path: Path):
    path = tmp_path / "forced.toml"
    path.write_text(FORCED)
    answers = [strictly(simulate(path, "--json", "--harmonics", asked).stdout) for asked in ("1", "2", "3,4,6")]
    keys = ("lockin_amplitude_nm", "lockin_phase_deg", "drive_lockin_amplitude_nm", "drive_lockin_phase_deg")
    assert [answer["order"] for answer in answers] == [3] * 3
    for answer in answers:
        # neither is one of those asked for, nor depends on them
        assert [answer[key] for key in keys] == [answers[0][key] for key in keys]
        assert answer["drive_frequency_khz"] == pytest.approx(545.4, rel=1e-12)
        assert answer["response_frequency_khz"] == pytest.approx(181.8, rel=1e-12)
    third = answers[2]["harmonics"][0]
    assert (third["multiple"], third["amplitude_nm"]) == (3, answers[0]["drive_lockin_amplitude_nm"])
    assert third["frequency_khz"] == pytest.approx(545.4, rel=1e-12)
    text = simulate(path, "--harmonics", "3,4,6").stdout
    one = answers[0]
    size, phase, slow_size, slow_phase = (f"{one[key]:.6g}" for key in (*keys[2:], *keys[:2]))
    # lines are broken where a terminal ends
    said = " ".join(text.split())
    assert f"At the drive's frequency (545.4 kHz): {size} nm, {phase} deg." in said
    assert f"At the response frequency (181.8 kHz, 1/3 of the drive's): {slow_size} nm, {slow_phase} deg." in said
    assert "At 4 times the response frequency (727.2 kHz, 4/3 of the drive's): " in said
    assert "At 2 times the drive's frequency (1090.8 kHz): " in said
    assert f"Phase lag of the height behind the force at the drive's frequency: {one['phase_lag_deg']:.6g} deg." in said
