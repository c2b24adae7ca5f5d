"""Bifurcation diagrams and basins against plain loops over the map and single tips."""

import numpy as np
import pytest

import afm_jax as afm
from afm_jax.dynamics.basins import basins_of_attraction
from afm_jax.dynamics.bifurcations import bifurcation_diagram
from afm_jax.dynamics.charts import stability_chart
from afm_jax.scenefile.parameter_paths import scene_family

FREQUENCY = "platform.reduced_frequency"


def law_scene(reduced: float, r: float = 0.8) -> afm.Scene:
    return afm.Scene(afm.Cantilever(90.0), afm.Platform(2.0, 180.0 * reduced, -1.0), afm.ImpactLaw(r))


def repeats_after(velocities: np.ndarray, longest: int = 6) -> np.ndarray:
    """Return after how many impacts the last velocities of each row repeat; 0 where they do not."""
    found = np.zeros(len(velocities), int)
    for m in range(longest, 0, -1):
        same = np.abs(velocities[:, -m:] - velocities[:, -2 * m : -m]).max(axis=1) < 1e-7
        found[same] = m
    return found


def swept_by_one_tip(values: np.ndarray, impacts: int) -> np.ndarray:
    """Return m at each value of the frequency, by one tip that keeps phase and rebound speed; values in its order."""
    phase, rebound, found = 1.5 * np.pi, None, []
    for value in values:
        scene = law_scene(value)
        omega = float(scene.platform.angular_frequency)
        rebound = float(scene.platform.top_speed_nm_per_us) if rebound is None else rebound
        time = np.array([phase / omega])
        rows = afm.iterate_batch(scene, time, np.asarray(scene.platform.velocity(time)) + rebound, 2 * impacts)
        velocities = np.asarray(rows.velocity_after_nm_per_us)
        # of what repeats but is slow to settle twice as many impacts tell the shortest repetition
        found.append(repeats_after(velocities)[0] if repeats_after(velocities[:, :impacts])[0] else 0)
        last = float(rows.time_us[0, impacts - 1])
        phase = omega * last % (2.0 * np.pi)
        rebound = float(rows.velocity_after_nm_per_us[0, impacts - 1] - scene.platform.velocity(last))
    return np.array(found)


@pytest.mark.slow
def test_sweeps_in_lanes_are_those_of_one_tip_and_show_hysteresis():
    values = np.linspace(1.54, 1.62, 17)
    ways = (True, False)
    up, down = (bifurcation_diagram(law_scene(1.5), FREQUENCY, values, upward=way, impacts=600) for way in ways)
    np.testing.assert_array_equal(up.verdicts.impacts, swept_by_one_tip(values, 600))
    np.testing.assert_array_equal(down.verdicts.impacts, swept_by_one_tip(values[::-1], 600)[::-1])
    assert np.any(up.verdicts.impacts != down.verdicts.impacts)
    for sweep in (up, down):
        m = sweep.verdicts.impacts
        orbit = m > 0
        assert np.array_equal(np.isfinite(sweep.phase_rad).sum(axis=1)[orbit], m[orbit])
        # the platform's height at the impact is its height at the phase
        np.testing.assert_allclose(sweep.height_nm, -1.0 + 2.0 * np.cos(sweep.phase_rad), rtol=0, atol=1e-9)


@pytest.mark.slow
def test_ranges_as_texts_are_those_of_the_command():
    scene, ranges = law_scene(1.0), (f"{FREQUENCY}=0.9:1.1:3", "platform.amplitude_nm=1:4:2")
    x, y = np.linspace(0.9, 1.1, 3), np.linspace(1.0, 4.0, 2)
    plane = scene_family(scene, FREQUENCY, "platform.amplitude_nm")
    chart = stability_chart(scene, x_values=ranges[0], y_values=ranges[1], last_order=2)
    wanted = stability_chart(plane, x_values=x, y_values=y, last_order=2)
    assert np.array_equal(chart.verdicts.stable, wanted.verdicts.stable)
    assert (str(chart.x), str(chart.y)) == ranges
    found, same = bifurcation_diagram(scene, ranges[1]), bifurcation_diagram(scene, "platform.amplitude_nm", y)
    assert np.array_equal(found.values, same.values)
    assert np.array_equal(found.phase_rad, same.phase_rad, equal_nan=True)


@pytest.mark.slow
def test_shares_of_basins_are_those_of_random_starts():
    scene = law_scene(1.57)
    found = basins_of_attraction(scene, columns=100, rows=100, speeds_nm_per_us=(0.0, 15.0))
    assert {attractor.name for attractor in found.attractors} == {"(3,4)", "(2,4)"}
    starts = 10_000
    phase, rebound = np.random.default_rng(7).uniform([[0.0], [0.0]], [[2.0 * np.pi], [15.0]], (2, starts))
    time = phase / float(scene.platform.angular_frequency)
    flown = afm.iterate_batch(scene, time, np.asarray(scene.platform.velocity(time)) + rebound, 300)
    m = repeats_after(np.asarray(flown.velocity_after_nm_per_us))
    for attractor, share, error in zip(found.attractors, found.share, found.share_error, strict=True):
        other = np.mean(m == attractor.impacts)
        assert abs(share - other) < 4.0 * np.hypot(error, np.sqrt(other * (1.0 - other) / starts))
