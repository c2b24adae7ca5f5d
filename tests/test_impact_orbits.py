"""Orbits of several impacts: fixed points of the map."""

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from afm_jax import (
    Cantilever,
    CollisionDelay,
    ImpactLaw,
    Platform,
    Scene,
    next_impact,
    save_scene,
    single_impact_orbits,
)
from afm_jax.cli.main import main
from afm_jax.dynamics.impact_orbits import many_impact_orbits, multipliers_of
from afm_jax.outcomes import Outcome

FREE = 2.0 * np.pi * 0.09
"""Omega in rad/us."""


def scene(n: float, r: float, offset: float = -1.0, epsilon: float = 0.0) -> Scene:
    return Scene(Cantilever(90.0), Platform(2.0, 180.0 * n, offset), ImpactLaw(r, epsilon))


def flown(made: Scene, time: float, velocity: float) -> tuple[float, float, float]:
    """Return time, V' and u_in of the next impact of the map, which is compared with brute force elsewhere."""
    impact = next_impact(made, time, velocity)
    assert int(impact.outcome) == Outcome.IMPACT
    approach = made.platform.velocity(impact.arrival_time_us) - impact.velocity_before_nm_per_us
    return float(impact.time_us), float(impact.velocity_after_nm_per_us), float(approach)


@pytest.mark.slow
@pytest.mark.parametrize(("impacts", "order"), [(2, 2), (3, 4)])
def test_orbits_repeat_when_they_are_flown(impacts: int, order: int):
    n, r = 1.24, 0.5
    omega, found = 2.0 * n * FREE, many_impact_orbits(scene(n, r), order, impacts)
    if impacts == 2 and order == 2:
        assert found.stable.sum() == 1
    for index in range(len(found.stable)):
        phases, after = found.reading.phase_rad[index], found.reading.velocity_after_nm_per_us[index]
        time, velocity = float(phases[0]) / omega, float(after[0])
        for place in range(1, impacts + 1):
            time, velocity, approach = flown(scene(n, r), time, velocity)
            where = place % impacts
            assert np.exp(1j * omega * time) == pytest.approx(np.exp(1j * phases[where]), abs=1e-7)
            assert velocity == pytest.approx(float(after[where]), abs=1e-7)
            assert approach == pytest.approx(float(found.reading.approach_speed_nm_per_us[index, where]), abs=1e-7)
        assert omega * time - phases[0] == pytest.approx(2.0 * np.pi * order, abs=1e-7)
        assert found.reading.determinant[index] == pytest.approx(r ** (2 * impacts), rel=1e-8)


@pytest.mark.slow
def test_what_long_iteration_settles_on_is_found():
    # beyond the period doubling of the (1, 1) orbit
    n, r, time, velocity = 1.24, 0.5, 4.0, 6.0
    rows = []
    for _ in range(300):
        time, velocity, approach = flown(scene(n, r), time, velocity)
        rows.append(approach)
    found = many_impact_orbits(scene(n, r), 2, 2)
    stable = found.reading.approach_speed_nm_per_us[found.stable][0]
    assert sorted(rows[-2:], reverse=True) == pytest.approx(list(stable), abs=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize(
    "law", [ImpactLaw(1.0, 60.0, 0.5), ImpactLaw(0.9999, 0.0, 0.48, CollisionDelay(0.206, 5.64, 0.726))]
)
def test_one_impact_is_the_single_impact_orbit(law: ImpactLaw):
    damped = Scene(Cantilever(90.0, 40.0), Platform(4.0, 181.8, -1.0), law)
    found, exact = many_impact_orbits(damped, 1, 1), single_impact_orbits(damped, 1)
    good = np.flatnonzero(np.asarray(exact.admissible))
    rank = good[np.argsort(-np.asarray(exact.peak_amplitude_nm)[good])]
    assert len(found.stable) == len(rank) > 0
    assert found.stable.tolist() == np.asarray(exact.stable)[rank].tolist()
    for name in ("phase_rad", "velocity_after_nm_per_us", "delay_us", "trace", "determinant", "peak_amplitude_nm"):
        # impacts have a column of their own
        value = getattr(found.reading, name).reshape(len(rank), -1)[:, 0]
        expected = np.asarray(getattr(exact, name))[rank]
        of_orbit = name in {"trace", "determinant", "peak_amplitude_nm"}
        rtol, atol = (1e-8, 0.0) if of_orbit else (1e-9, 1e-9)
        np.testing.assert_allclose(value, expected, rtol=rtol, atol=atol, err_msg=name)


def test_multipliers_are_those_of_numpy():
    rng = np.random.default_rng(2)
    matrices = rng.normal(size=(200, 2, 2))
    found = multipliers_of(np.trace(matrices, axis1=1, axis2=2), np.linalg.det(matrices))
    expected = np.linalg.eigvals(matrices)
    for one, other in zip(found, expected, strict=True):
        assert sorted(one, key=lambda z: (z.real, z.imag)) == pytest.approx(
            sorted(other.astype(complex), key=lambda z: (z.real, z.imag)), rel=1e-9
        )
    assert np.all(np.abs(found[:, 0]) >= np.abs(found[:, 1]) * (1.0 - 1e-12))


@pytest.mark.slow
def test_the_command_tells_every_impact(tmp_path: Path):
    save_scene(scene(1.24, 0.5), tmp_path / "scene.toml")
    arguments = ["orbits", str(tmp_path / "scene.toml"), "--order", "2", "--impacts", "2", "--json"]
    result = CliRunner().invoke(main, arguments, prog_name="afm-jax")
    assert result.exit_code == 0, result.stderr
    answer = json.loads(result.stdout)
    found = many_impact_orbits(scene(1.24, 0.5), 2, 2)
    told = [[impact["phase_rad"] for impact in orbit["impacts"]] for orbit in answer["orbits"]]
    assert told == found.reading.phase_rad.tolist()
