"""Figures 8, 10 and 11: numbers of the contact in motion, statements that hold and that can fail, the command."""

import csv
import json
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
from click.testing import CliRunner

from afm_jax.cli.main import main
from afm_jax.motion.follow import follow_long
from afm_jax.motion.section import departures
from afm_jax.motion.start import default_start
from afm_jax.paper import motion_figures
from afm_jax.paper.motion_figures import (
    Growth,
    locked_from,
    rise_statements,
    section_statements,
    slow_ramps,
    sticking_statements,
    survey,
    tangent_growth,
)
from afm_jax.scenefile import presets


@pytest.fixture(scope="module")
def rising():
    return slow_ramps(presets.figure11_scene, ((1e-2, 2.0), (2e-3, 2.0)))


@pytest.fixture(scope="module")
def sticking():
    # to 0.3 nm, three free periods, beyond where it sticks: only then it counts as held
    return slow_ramps(presets.figure10_scene, ((1e-2, 1.6),))


def holds(statements) -> list[bool]:
    return [statement.holds for statement in statements]


@pytest.mark.slow
def test_pieces_join_to_one_motion():
    scene = presets.contact_scene(1.01, 4.0, 0.0)
    start = default_start(scene)
    runs = [follow_long(scene, start, 300.0 - float(start.time_us), piece_contacts=count) for count in (20, 400)]
    assert runs[0].pieces >= 3
    assert runs[1].pieces == 1
    pieces, whole = (departures(scene, run.simulation) for run in runs)
    # a stable orbit: the same contacts, counted once, each to the accuracy of 1e-9
    np.testing.assert_allclose(pieces.departure_time_us, whole.departure_time_us, rtol=1e-9)
    np.testing.assert_allclose(pieces.peak_height_nm[:-1], whole.peak_height_nm[:-1], rtol=1e-7)
    times, heights = whole.path()
    assert np.all(np.diff(times) >= 0.0)
    # 24 points a flight miss its top by up to (pi/46)^2/2
    assert heights.max() == pytest.approx(np.nanmax(whole.peak_height_nm), rel=3e-3)


@pytest.mark.slow
def test_the_amplitude_rises_above_resonance(rising):
    settled, ramps = rising
    # physics.md, independent code: 50.6 nm at -2 nm
    assert settled == pytest.approx(50.6, rel=2e-3)
    statements = rise_statements(settled, ramps)
    assert holds(statements) == [True, True], statements
    # the fast ramp alone lags too far behind; ramps in the wrong order do not lag
    assert holds(rise_statements(settled, ramps[:1])) == [False, False]
    assert not rise_statements(settled, ramps[::-1])[1].holds


@pytest.mark.slow
def test_the_tip_sticks_below_resonance(sticking, rising):
    settled, ramps = sticking
    assert holds(sticking_statements(settled, ramps)) == [True, True]
    assert ramps[0].motion.captured
    assert 0.5 < ramps[0].offset_at(ramps[0].motion.held_from_us) < 1.3
    # above resonance it neither falls nor sticks
    assert holds(sticking_statements(*rising)) == [False, False]


def test_locking_is_told_from_broadband():
    period = 2.0
    wild = np.cumsum(np.random.default_rng(3).uniform(2.0, 12.0, 100))
    locked = wild[-1] + 5.0 * period * np.arange(1, 81)
    first, periods = locked_from(np.concatenate([wild, locked]), period)
    assert periods == 5
    assert 97 <= first <= 100
    assert locked_from(wild, period) == (100, None)
    assert locked_from(locked[:20], period) == (20, None)


@pytest.mark.slow
def test_figure_8_is_broadband_then_locks():
    courses = survey((60.0, 80.0))
    end = courses[-1]
    statements = section_statements(courses, end, None)
    assert statements[1].holds, statements[1]
    assert not section_statements([end._replace(broadband=0)], end._replace(periods=None), None)[1].holds
    assert not section_statements([end._replace(broadband=300)], end, None)[0].holds
    assert not section_statements([end._replace(periods=None)], end, None)[2].holds
    assert not section_statements([end._replace(periods=4)], end, None)[2].holds
    assert not any(course.motion.captured for course in courses)


@pytest.mark.slow
def test_tangents_grow_as_neighbours_part():
    course = survey((80.0,))[0]
    growth = tangent_growth(course._replace(broadband=40))
    scene = course.motion.scene
    # two starts 1e-7 nm/us apart, over contacts before they have parted to a finite distance
    from afm_jax.motion.start import start_of  # noqa: PLC0415

    ends = []
    for velocity in (80.0, 80.0 + 1e-7):
        run = follow_long(scene, start_of(scene, presets.figure8_start(velocity)), 60.0, piece_contacts=400)
        motion = departures(scene, run.simulation)
        ends.append(motion.departure_time_us[:8] * float(scene.platform.angular_frequency))
    parted = np.abs(ends[1] - ends[0])
    mean = np.log(parted[7] / parted[0]) / 7.0
    # phase alone instead of phase and speed: a factor of a few over seven contacts
    assert growth.exponent[6] == pytest.approx(mean, abs=0.5)
    flat = Growth(growth.contacts, np.full(growth.contacts.shape, -0.02), growth.error)
    assert not section_statements([course], course, flat)[-1].holds


@pytest.mark.slow
def test_the_command_writes_figures_10_and_11(tmp_path: Path):
    result = CliRunner().invoke(
        main, ["figures", "--only", "10,11", "--coarse", "--json", "--out", str(tmp_path)], prog_name="afm-jax"
    )
    assert result.exit_code == 0, result.stderr
    answer = json.loads(result.stdout)
    assert [figure["figure"] for figure in answer["figures"]] == [10, 11]
    assert answer["valid"]
    for number in (10, 11):
        assert matplotlib.image.imread(tmp_path / f"figure{number}.png").shape[0] > 800
        with (tmp_path / f"figure{number}.csv").open(encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file))
        assert len(rows) > 20
        assert float(rows[0]["peak_height_nm"]) > 40.0
    assert "100 % of the time" in result.stderr


def test_the_figures_are_those_of_the_command():
    assert list(motion_figures.MOTION_FIGURES) == ["8", "10", "11"]
