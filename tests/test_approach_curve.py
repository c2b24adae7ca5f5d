"""Approach curves: the free tip, the law's own loss, orbits in closed form, and the way to `tapping`."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import afm_jax as afm
import fitting
from afm_jax.motion.approach_curve import CurveOutcome
from tests.answers import answer

KHZ, QUALITY, MASS_NG, FREE_NM, RATIO, R, EPSILON = 90.0, 200.0, 16.9, 80.0, 1.03, 0.98, 0.4
LAW = afm.ImpactLaw(R, EPSILON)
OMEGA = 2e-3 * np.pi * KHZ


def gamma_of(quality: float) -> complex:
    """Return the force over k of a steady height of 1."""
    return 1.0 - RATIO**2 + 1j * RATIO / quality


def driven(kind: str, quality: float = QUALITY) -> afm.Scene:
    cantilever = afm.Cantilever(KHZ, quality, MASS_NG)
    size = FREE_NM * abs(gamma_of(quality))
    force = afm.ForceDrive(size * MASS_NG * OMEGA**2, KHZ * RATIO) if kind == "force" else None
    base = afm.BaseDrive(size, KHZ * RATIO) if kind == "base" else None
    return afm.Scene(cantilever, afm.Platform(0.0, KHZ * RATIO), LAW, base=base, force=force)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["force", "base"])
def test_a_free_tip_has_the_amplitude_and_the_lag_of_a_driven_oscillator(kind: str):
    found = afm.approach_curve(driven(kind), [-100.0, -95.0])
    # height behind the force: 1/gamma; deflection behind the base: 1/gamma - 1
    response = (1.0 if kind == "force" else 1.0 - gamma_of(QUALITY)) / gamma_of(QUALITY)
    size = FREE_NM * abs(gamma_of(QUALITY) * response)
    assert [CurveOutcome(one) for one in found.outcome] == [CurveOutcome.FREE] * 3
    assert found.retract.tolist() == [False, False, True]
    np.testing.assert_allclose([*found.amplitude_nm, found.free_amplitude_nm], size, rtol=1e-5)
    lags = [*found.phase_lag_deg, found.free_phase_lag_deg]
    np.testing.assert_allclose(lags, -np.degrees(np.angle(response)) % 360.0, atol=1e-3)
    np.testing.assert_allclose(found.dissipated_in_contact_aj, 0.0, atol=1e-12)


@pytest.fixture(scope="module")
def told(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], Path]:
    """Return what the command says of a curve out and back, and its folder."""
    folder = tmp_path_factory.mktemp("curve")
    afm.save_scene(driven("force"), folder / "scene.toml")
    heights = ("--heights", "-88:-8:11", "--noise", "0.1%", "--phase-noise-deg", "0.1")
    return answer(folder / "out", "simulate", folder / "scene.toml", *heights), folder / "out"


@pytest.mark.slow
def test_points_are_the_stable_orbits_of_their_heights_and_lose_what_the_law_says(told):
    scene, (curve, _) = driven("force"), told
    taps = [point for point, outcome in enumerate(curve["outcome"]) if outcome == "taps"]
    assert len(taps) > 15
    for point in taps[::4]:
        height, amplitude, lag, energy = (
            curve[name][point] for name in ("height_nm", "amplitude_nm", "phase_lag_deg", "dissipated_in_contact_aj")
        )
        platform = afm.Platform(0.0, KHZ * RATIO, height)
        orbits = afm.single_impact_orbits(afm.Scene(scene.cantilever, platform, LAW, force=scene.force), 1)
        those = np.asarray(orbits.stable & orbits.admissible)
        # N = 1: the response's frequency is the drive's
        found = (orbits.lockin_amplitude_nm, orbits.phase_lag_deg, orbits.approach_speed_nm_per_us)
        amplitudes, lags, speeds = (np.asarray(column)[those] for column in found)
        nearest = int(np.argmin(np.abs(amplitudes - amplitude)))
        np.testing.assert_allclose(amplitudes[nearest], amplitude, rtol=1e-5)
        np.testing.assert_allclose(lags[nearest], lag, atol=1e-3)
        lost = 0.5 * MASS_NG * ((1.0 - R**2) * speeds[nearest] ** 2 + EPSILON)
        np.testing.assert_allclose(energy, lost, rtol=1e-4)

    # the way back keeps to the branch of the taps
    out, back = (point for point, height in enumerate(curve["height_nm"]) if height == -88.0)
    assert (curve["outcome"][out], curve["outcome"][back]) == ("free", "taps")
    assert curve["amplitude_nm"][back] > curve["free_amplitude_nm"] + 3.0


@pytest.mark.slow
def test_the_command_writes_what_tapping_reads(told):
    curve, out = told
    assert sorted(path.name for path in out.iterdir()) == ["curve.csv", "curve.json", "curve.png", "curve_points.csv"]
    assert (curve["drive"], curve["free_amplitude_nm"]) == ("force", pytest.approx(FREE_NM, rel=1e-9))
    assert len(curve["height_nm"]) == 21
    table = fitting.read_table(out / "curve.csv")
    lost = np.array([name not in ("taps", "free") for name in curve["outcome"]])
    np.testing.assert_array_equal(np.asarray(table.no_orbit) == 1.0, lost)
    found = fitting.tapping(table, law=False).rows
    taken = np.array(curve["dissipated_in_contact_aj"], dtype=float)[~lost]
    assert np.max(np.abs(found.energy_aj - taken) / found.energy_noise_aj) < 4.0


def test_scenes_that_have_no_approach_curve_are_refused():
    force = driven("force")
    undriven = afm.Scene(force.cantilever, afm.Platform(4.0, 180.0), LAW)
    moving = afm.Scene(force.cantilever, afm.Platform(1.0, KHZ * RATIO), LAW, force=force.force)
    for scene, heights, said in (
        (undriven, [-5.0], r"give the scene a \[force\] or a \[base\]"),
        (moving, [-5.0], "`platform.amplitude_nm`"),
        (force, [], "at least one"),
    ):
        with pytest.raises(ValueError, match=said):
            afm.approach_curve(scene, heights)
