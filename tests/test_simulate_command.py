"""`afm-jax simulate`: its numbers against orbits of the impact law, and its files."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result

from afm_jax import Cantilever, Contact, ImpactLaw, Platform, Scene, save_scene, single_impact_orbits
from afm_jax.cli.main import main
from afm_jax.motion.trajectory import DensePath
from afm_jax.scenefile.scenefile import Start
from fitting import lockin, read_trace
from tests import answers
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


def json_of(*arguments: object) -> dict[str, Any]:
    """Return the JSON object of a successful call."""
    result = simulate(*arguments, "--json")
    assert result.exit_code == 0, result.stderr
    return strictly(result.stdout)


def nulls(answer: dict[str, object]) -> set[str]:
    """Return the keys at the top of an answer that are null."""
    return {key for key, item in answer.items() if item is None}


def test_without_a_duration_it_ends_when_settled(law_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    worked_out, own = [], DensePath.__init__
    monkeypatch.setattr(DensePath, "__init__", lambda *where: worked_out.append(where) or own(*where))
    answer = answers.answer(tmp_path / "out", "simulate", law_file, "--harmonics", "1,3")
    # observables, files and pictures look at one path
    assert len(worked_out) == 1
    assert answer.keys() >= KEYS
    assert nulls(answer) == answer["null_reasons"].keys()
    orbits = single_impact_orbits(LAW, 1)
    slot = int(np.argmax(np.asarray(orbits.admissible) & np.asarray(orbits.stable)))
    assert (answer["settled"], answer["stuck"], answer["order"], answer["contacts_per_response"]) == (True, False, 1, 1)
    # the start is on the orbit, the impact map stays there to rounding
    for key in ("peak_amplitude_nm", "lockin_amplitude_nm", "lockin_phase_deg"):
        np.testing.assert_allclose(answer[key], float(getattr(orbits, key)[slot]), rtol=1e-7, err_msg=key)
    assert [harmonic["multiple"] for harmonic in answer["harmonics"]] == [1, 3]
    rows = answers.table(tmp_path / "out" / "contacts.csv")
    assert len(rows) == answer["impacts"]
    speed = float(orbits.approach_speed_nm_per_us[slot])
    np.testing.assert_allclose([float(row["approach_speed_nm_per_us"]) for row in rows], speed, rtol=1e-7)
    heights = [float(row["position_nm"]) for row in answers.table(tmp_path / "out" / "trajectory.csv")]
    # 2001 points a period: the highest misses the top by (pi/2001)^2/2 of the curve's scale at most
    np.testing.assert_allclose(max(heights), answer["peak_amplitude_nm"], rtol=1e-5)


def test_the_text_says_the_same(law_file: Path):
    answer = json_of(law_file, "--periods", 60.5)
    text = simulate(law_file, "--periods", 60.5).stdout
    assert "Settled: the motion repeats: 1 contact in 1 drive period." in text
    assert f"Peak amplitude {answer['peak_amplitude_nm']:.6g} nm" in text
    assert (answer["impacts"], answer["final"]["phase"]) == (60, "dry")
    period = float(LAW.platform.period_us)
    np.testing.assert_allclose(answer["final"]["time_us"] - answer["start"]["time_us"], 60.5 * period, rtol=1e-12)


@pytest.mark.slow
def test_lockin_reads_the_trace_it_writes(tmp_path: Path):
    scene = Scene(Cantilever(90.0, 40.0), Platform(4.0, 3.0 * 181.8, -1.0), LAW.interaction)
    save_scene(scene, tmp_path / "scene.toml")
    answer = answers.answer(tmp_path / "out", "simulate", tmp_path / "scene.toml", "--samples", "uniform")
    trace = read_trace(tmp_path / "out" / "trace.csv")
    assert trace.drive_frequency_khz == pytest.approx(3.0 * 181.8, rel=1e-12)
    read: Any = lockin(trace.time_us, trace.deflection_nm, 3.0 * 181.8, answer["order"])
    assert read.valid, read.reasons
    # two ways through the same motion: integrals over flights, and over 400 samples a drive period
    np.testing.assert_allclose(read.lockin_amplitude_nm, answer["lockin_amplitude_nm"], rtol=1e-3)
    turn = 360.0 / 3
    assert abs((read.phase_deg - answer["lockin_phase_deg"] + 0.5 * turn) % turn - 0.5 * turn) < 0.05


@pytest.mark.slow
def test_a_tip_too_slow_sticks(tmp_path: Path):
    path = tmp_path / "stuck.toml"
    # 2 nm over the sample at rest: it comes far below the capture speed of 10.9 nm/us
    scene = Scene(Cantilever(90.0, 40.0), Platform(0.1, 180.0), Contact.paper())
    save_scene(scene, path, start=Start(0.0, 8.0, -1.0))
    answer = json_of(path, "--periods", 60)
    assert (answer["stuck"], answer["settled"], answer["order"], answer["impacts"]) == (True, True, None, 1)
    assert answer["final"]["phase"] in ("bridge", "junction")
    # it rests within the range of the junction: between the deepest static gap and where the junction breaks
    assert abs(answer["final"]["position_nm"]) < 2.0
    assert nulls(answer) == answer["null_reasons"].keys()
