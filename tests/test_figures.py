"""Figures 2, 3 and 9: verdicts against 50-digit orbits, closed forms and long iterations; the command."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
from click.testing import CliRunner, Result

from afm_jax.cli.main import main
from afm_jax.dynamics.charts import (
    OrbitVerdicts,
    StabilityChart,
    batch_of_scenes,
    offset_amplitudes,
    orbit_verdicts,
    share_above,
    stability_chart,
)
from afm_jax.paper import charts as paper_figures
from afm_jax.paper.charts import (
    SpotChecks,
    adhesion_limit_nm,
    amplitude_slope,
    low_orders_vanish,
    spot_check,
    tails_lean,
    tongues_at_resonance,
)
from afm_jax.scenefile import presets
from tests.reference_flight import Parameters
from tests.reference_orbits import single_impact_orbits

POINTS = 100  # spot checks of each verdict


@pytest.fixture(scope="module")
def figure2() -> StabilityChart:
    return paper_figures.figure2_chart(coarse=True)


@pytest.fixture(scope="module")
def figure3() -> StabilityChart:
    return paper_figures.figure3_chart(coarse=True)


def verdicts_at(chart: StabilityChart, verdicts: OrbitVerdicts, points: int) -> SpotChecks:
    columns = chart.points()

    def scenes(chosen: np.ndarray):
        return batch_of_scenes(chart.scene_of, *(column[chosen] for column in columns))

    return spot_check(scenes, verdicts, seed=7, points=points, impacts=2000)


@pytest.mark.parametrize("epsilon", [0.0, presets.ADHESION])
def test_verdicts_are_those_of_the_50_digit_orbits(epsilon: float, figure2: StabilityChart, figure3: StabilityChart):
    chart = figure3 if epsilon else figure2
    frequency, amplitude = chart.points()
    generator = np.random.default_rng(11)
    # Stable for half of the points, anything for the others; the order nearest to resonance has most to tell.
    stable = generator.choice(np.flatnonzero(chart.verdicts.any_stable()), 10, replace=False)
    for point in (*stable, *generator.choice(frequency.size, 10, replace=False)):
        order = int(chart.lowest_stable_order.ravel()[point]) or max(1, round(float(frequency[point])))
        parameters = Parameters(
            frequency_khz=90.0,
            quality_factor=None,
            amplitude_nm=float(amplitude[point]),
            drive_frequency_khz=float(180.0 * frequency[point]),
            offset_nm=-1.0,
            r=0.5,
            epsilon=epsilon,
        )
        orbits = [orbit for orbit in single_impact_orbits(parameters, order) if orbit.admissible]
        assert chart.verdicts.admissible[order - 1, point] == bool(orbits)
        steady = [orbit for orbit in orbits if orbit.stable]
        assert chart.verdicts.stable[order - 1, point] == bool(steady)
        if steady:
            exact = max(orbit.peak_amplitude_nm for orbit in steady)
            # the reference samples its peak; a root near a fold keeps half of float64's digits at worst
            np.testing.assert_allclose(chart.verdicts.peak_amplitude_nm[order - 1, point], exact, rtol=1e-7)


@pytest.mark.parametrize("order", [1, 2, 3, 6])
def test_at_resonance_an_orbit_needs_a_drive_that_reaches_the_rest_position(order: int):
    """Omega = omega/2N: the tangent of eq. 9 is infinite, so the impact height is 0, beta cos(omega t) = -sigma."""
    amplitude = np.array([0.9, 0.999, 1.001, 1.1])
    scenes = batch_of_scenes(presets.figure2_scene, np.full(4, float(order)), amplitude)
    verdicts = orbit_verdicts(scenes, first_order=order, last_order=order)
    assert verdicts.stable[0].tolist() == [False, False, True, True]
    # Half a free period above the rest position, leaving at V' = v_p (1 + r)/(1 - r) (eq. 1 with V = -V').
    platform_speed = 2e-3 * np.pi * 180.0 * order * np.sqrt(amplitude[2:] ** 2 - 1.0)
    height = 3.0 * platform_speed / (2e-3 * np.pi * 90.0)
    # V' is a closed form; rounding only
    np.testing.assert_allclose(verdicts.peak_amplitude_nm[0, 2:], height, rtol=1e-9)


def test_no_orbit_where_adhesion_takes_more_than_the_platform_gives():
    """On an undamped orbit v_p = (u_in - u_out)/2, at least sqrt((1 - r^2) epsilon)/2r by eq. 6."""
    frequency = np.linspace(0.6, 6.4, 200)
    for factor, some in ((0.999, False), (1.05, True)):
        scenes = batch_of_scenes(presets.figure3_scene, frequency, factor * adhesion_limit_nm(frequency))
        assert orbit_verdicts(scenes, last_order=8).admissible.any() == some


def test_elastic_limit_of_the_amplitude():
    """For r -> 1 the platform stands still at impact: half a free oscillation about 0 from z = sigma -+ beta."""
    offset = np.array([-0.2, 0.0, 0.2])
    amplitudes = offset_amplitudes(
        presets.figure9_scene, reduced_frequency=(0.97, 1.03), offset_nm=offset, r=np.array([0.9999])
    )
    for panel, (n, side) in enumerate(((0.97, -1.0), (1.03, 1.0))):
        height = (offset + side * 0.75) / np.cos(np.pi / (2.0 * n))
        # 1 - r = 1e-4, with the square root of the loss's effect on the phase: some parts in a thousand
        np.testing.assert_allclose(amplitudes.peak_amplitude_nm[panel, 0], height, rtol=5e-3)


def test_offsets_need_a_zero():
    with pytest.raises(ValueError, match="must contain 0"):
        offset_amplitudes(
            presets.figure9_scene, reduced_frequency=(0.97,), offset_nm=np.array([0.5, 1.0]), r=np.array([0.9])
        )


@pytest.mark.slow
@pytest.mark.parametrize("adhesion", [False, True])
def test_long_iterations_agree(adhesion: bool, figure2: StabilityChart, figure3: StabilityChart):  # noqa: FBT001
    chart = figure3 if adhesion else figure2
    checks = verdicts_at(chart, chart.verdicts, POINTS)
    assert checks.failures == []
    assert all(checks.checked[verdict] > 0.9 * POINTS for verdict in ("stable", "unstable", "none"))
    assert checks.excluded_share < 0.05


@pytest.mark.slow
def test_long_iterations_find_wrong_verdicts(figure2: StabilityChart):
    none = np.zeros_like(figure2.verdicts.stable)
    stable = figure2.verdicts.stable
    denied = figure2.verdicts._replace(stable=none, admissible=stable)
    checks = verdicts_at(figure2, denied, 20)
    # `none`: about half of the points do have a stable orbit. `unstable`: there is no unstable one to depart from.
    problems = [failure["problem"] for failure in checks.failures]
    assert sum("settles" in str(problem) for problem in problems) >= 5


def test_statements_hold_and_can_fail(figure2: StabilityChart, figure3: StabilityChart):
    frequency, amplitude = paper_figures.chart_grid(coarse=True)
    positive = stability_chart(
        lambda n, beta: presets.stability_scene(n, beta, 1.0, 0.0),
        x_values=frequency,
        y_values=amplitude,
        last_order=8,
    )
    assert tails_lean(figure2, positive).holds
    assert not tails_lean(positive, figure2).holds
    assert tongues_at_resonance(figure2).holds
    assert not tongues_at_resonance(replace(figure2, x_values=frequency + 0.5)).holds
    assert low_orders_vanish(figure2, figure3).holds
    assert not low_orders_vanish(figure2, figure2).holds
    assert not low_orders_vanish(figure3, figure2).holds


def test_amplitude_slopes_hold_and_can_fail():
    amplitudes = offset_amplitudes(
        presets.figure9_scene,
        reduced_frequency=(0.97, 1.03),
        offset_nm=np.array([-0.1, 0.0, 0.1]),
        r=np.array([0.4, 0.7, 0.95]),
    )
    for panel, falls in ((0, True), (1, False)):
        assert amplitude_slope(amplitudes, panel, falls=falls).holds
        assert not amplitude_slope(amplitudes, panel, falls=not falls).holds
    # r = 0.4: the drive never reaches what adhesion takes, so there is nothing to show, and nothing is made up
    assert np.isnan(amplitudes.rescaled_amplitude[:, 0]).all()
    assert (amplitudes.rescaled_amplitude[:, 1:, amplitudes.zero] == 1.0).all()


@pytest.mark.slow
def test_share_above_tells_missing_orders(figure2: StabilityChart):
    frequency, amplitude = figure2.x_values, figure2.y_values
    short = stability_chart(presets.figure2_scene, x_values=frequency, y_values=amplitude, last_order=5)
    # independent sum: what the complete chart has of order 6 alone
    sixth = (figure2.lowest_stable_order == 6)[::2, ::2]
    assert share_above(short, last_order=6, stride=2) == pytest.approx(sixth.mean(), abs=1e-12)
    assert share_above(figure2, last_order=20, stride=2) < 1e-3


PARAMETERS = ("reduced_frequency", "offset_nm", "r")
"""Of figure 9."""


def figures(*arguments: str) -> Result:
    return CliRunner().invoke(main, ["figures", *arguments], prog_name="afm-jax")


@pytest.mark.slow
def test_command_writes_pictures_and_tables(tmp_path: Path):
    result = figures("--only", "2,3,9", "--coarse", "--json", "--out", str(tmp_path))
    assert result.exit_code == 0, result.stderr
    answer = json.loads(result.stdout)
    assert answer["valid"]
    assert [figure["figure"] for figure in answer["figures"]] == [2, 3, 9]
    for figure in answer["figures"]:
        picture, table = figure["files"]
        image = matplotlib.image.imread(tmp_path / picture)
        assert image.shape[1] >= 1500
        assert 0.05 < (image[..., :3].mean(axis=2) > 0.98).mean() < 0.95  # neither empty nor black
        with (tmp_path / table).open(encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file))
        stable = [row["stable"] == "true" for row in rows]
        assert np.mean(stable) == pytest.approx(figure["stable_share"], abs=1e-12)
        # gaps stay gaps
        assert [row["peak_amplitude_nm"] != "" for row in rows] == stable
        assert figure["spot_checks"]["failures"] == []
        assert sum(figure["spot_checks"]["checked"].values()) >= 30
        assert all(statement["holds"] for statement in figure["statements"])


def test_a_statement_that_fails_is_exit_code_3(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    original = presets.figure9_scene
    monkeypatch.setattr(presets, "figure9_scene", lambda n, offset, r: original(2.0 - n, offset, r))
    result = figures("--only", "9", "--coarse", "--json", "--out", str(tmp_path))
    assert result.exit_code == 3
    assert not json.loads(result.stdout)["valid"]
    assert (tmp_path / "figure9.png").exists()


def test_without_out_the_folder_is_figures(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.chdir(tmp_path)
    result = figures("--only", " 9,9 ", "--coarse")
    assert result.exit_code == 0, result.stderr
    assert sorted(path.name for path in (tmp_path / "figures").iterdir()) == ["figure9.csv", "figure9.png"]
    with (tmp_path / "figures" / "figure9.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    # a row for each of its own parameters; only amplitudes may have gaps
    assert set(rows[0]) == {*PARAMETERS, "stable", "peak_amplitude_nm", "rescaled_amplitude"}
    assert len({tuple(row[name] for name in PARAMETERS) for row in rows}) == len(rows)
    assert all(float(row["r"]) <= 1.0 for row in rows)
    assert "holds: the amplitude falls" in result.stdout
