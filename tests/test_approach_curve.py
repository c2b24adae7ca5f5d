"""Approach curves: the free tip, the law's own loss, orbits in closed form, SciPy, and the way to `tapping`."""

from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import afm_jax as afm
import fitting
from afm_jax.motion.approach_curve import CurveOutcome
from tests.answers import answer

KHZ, QUALITY, MASS_NG, FREE_NM, RATIO, R, EPSILON = 90.0, 200.0, 16.9, 80.0, 1.03, 0.98, 0.4
LAW = afm.ImpactLaw(R, EPSILON)
OMEGA, DRIVE = 2e-3 * np.pi * KHZ, 2e-3 * np.pi * KHZ * RATIO


def gamma_of(quality: float) -> complex:
    """Return the force over k of a steady height of 1."""
    return 1.0 - RATIO**2 + 1j * RATIO / quality


def driven(kind: str, quality: float = QUALITY) -> afm.Scene:
    cantilever = afm.Cantilever(KHZ, quality, MASS_NG)
    size = FREE_NM * abs(gamma_of(quality))
    force = afm.ForceDrive(size * MASS_NG * OMEGA**2, KHZ * RATIO) if kind == "force" else None
    base = afm.BaseDrive(size, KHZ * RATIO) if kind == "base" else None
    return afm.Scene(cantilever, afm.Platform(0.0, KHZ * RATIO), LAW, base=base, force=force)


@pytest.fixture(scope="module")
def curve() -> afm.ApproachCurve:
    return afm.approach_curve(driven("force"), np.linspace(-88.0, -8.0, 11))


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


@pytest.mark.slow
def test_points_are_the_stable_orbits_of_their_heights_and_lose_what_the_law_says(curve: afm.ApproachCurve):
    scene = driven("force")
    taps = np.flatnonzero(curve.outcome == CurveOutcome.TAPS)
    assert taps.size > 15
    for point in taps[::4]:
        platform = afm.Platform(0.0, KHZ * RATIO, curve.height_nm[point])
        here = afm.Scene(scene.cantilever, platform, scene.interaction, force=scene.force)
        orbits = afm.single_impact_orbits(here, 1)
        those = np.asarray(orbits.stable & orbits.admissible)
        # N = 1: the response's frequency is the drive's
        amplitudes = np.asarray(orbits.lockin_amplitude_nm)[those]
        nearest = int(np.argmin(np.abs(amplitudes - curve.amplitude_nm[point])))
        np.testing.assert_allclose(amplitudes[nearest], curve.amplitude_nm[point], rtol=1e-5)
        assert orbits.phase_lag_deg is not None
        lag = np.asarray(orbits.phase_lag_deg)[those][nearest]
        np.testing.assert_allclose(lag, curve.phase_lag_deg[point], atol=1e-3)
        speed = float(np.asarray(orbits.approach_speed_nm_per_us)[those][nearest])
        lost = 0.5 * MASS_NG * ((1.0 - R**2) * speed**2 + EPSILON)
        np.testing.assert_allclose(curve.dissipated_in_contact_aj[point], lost, rtol=1e-4)

    # the way back keeps to the branch of the taps
    highest = curve.height_nm == -88.0
    assert [CurveOutcome(one) for one in curve.outcome[highest]] == [CurveOutcome.FREE, CurveOutcome.TAPS]
    assert curve.amplitude_nm[highest][1] > curve.free_amplitude_nm + 3.0


@pytest.mark.slow
def test_a_point_agrees_with_scipy():
    quality, height = 30.0, -50.0
    found = afm.approach_curve(driven("force", quality), [-70.0, -60.0, height], both_ways=False)
    assert CurveOutcome(found.outcome[2]) == CurveOutcome.TAPS
    push = OMEGA**2 * FREE_NM * abs(gamma_of(quality))
    period = 2.0 * np.pi / DRIVE

    def rates(time: float, state: np.ndarray) -> list[float]:
        moments = (state[0] * np.cos(DRIVE * time), state[0] * np.sin(DRIVE * time))
        acceleration = push * np.cos(DRIVE * time) - OMEGA / quality * state[1] - OMEGA**2 * state[0]
        return [state[1], acceleration, *moments]

    def touches(_: float, state: np.ndarray) -> float:
        return state[0] - height

    touches.terminal, touches.direction = True, -1  # type: ignore[attr-defined]
    time, state, periods = 0.0, np.array([0.0, 0.0, 0.0, 0.0]), 220
    begun = np.zeros(2)
    for stop in ((periods - 1) * period, periods * period):
        begun = state[2:].copy()
        while time < stop:
            run = solve_ivp(rates, (time, stop), state, "DOP853", events=touches, rtol=1e-10, atol=1e-10)
            time, state = float(run.t[-1]), run.y[:, -1].copy()
            if run.status == 1:
                state[1] = np.sqrt(R**2 * state[1] ** 2 - EPSILON)
    lockin = 2.0 / period * ((state[2] - begun[0]) - 1j * (state[3] - begun[1]))
    np.testing.assert_allclose(found.amplitude_nm[2], abs(lockin), rtol=1e-5)
    np.testing.assert_allclose(found.phase_lag_deg[2], -np.degrees(np.angle(lockin)) % 360.0, atol=1e-3)


@pytest.mark.slow
def test_the_command_writes_what_tapping_reads(tmp_path: Path):
    afm.save_scene(driven("force"), tmp_path / "scene.toml")
    out, noise = tmp_path / "out", ("--noise", "0.1%", "--phase-noise-deg", "0.1")
    told = answer(out, "simulate", tmp_path / "scene.toml", "--heights", "-88:-8:11", *noise)
    assert sorted(path.name for path in out.iterdir()) == ["curve.csv", "curve.json", "curve.png", "curve_points.csv"]
    assert told["drive"] == "force"
    assert told["free_amplitude_nm"] == pytest.approx(FREE_NM, rel=1e-9)
    assert len(told["height_nm"]) == 21
    table = fitting.read_table(out / "curve.csv")
    assert table.no_orbit is not None
    lost = [name not in ("taps", "free") for name in told["outcome"]]
    assert (table.no_orbit == 1.0).tolist() == lost
    found = fitting.tapping(table, law=False).rows
    taken = np.array([energy for energy, none in zip(told["dissipated_in_contact_aj"], lost, strict=True) if not none])
    assert np.max(np.abs(found.energy_aj - taken) / found.energy_noise_aj) < 4.0


def test_scenes_that_have_no_approach_curve_are_refused():
    force = driven("force")
    sample, moving = afm.Platform(4.0, 180.0), afm.Platform(1.0, KHZ * RATIO)
    for scene, heights, said in (
        (afm.Scene(force.cantilever, sample, force.interaction), [-5.0], r"give the scene a \[force\] or a \[base\]"),
        (afm.Scene(force.cantilever, moving, force.interaction, force=force.force), [-5.0], "`platform.amplitude_nm`"),
        (force, [], "at least one"),
    ):
        with pytest.raises(ValueError, match=said):
            afm.approach_curve(scene, heights)
