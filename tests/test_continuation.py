"""Continuation: special points against closed forms, curves in two parameters, and the errors that a fit gives them.

Closed forms of the undamped oscillator: eq. 9's orbits and eq. 8's trace, written out here, and eq. 6's capture speed;
the grazing of a resting and of a driven tip.
"""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.optimize import brentq

from afm_jax import (
    Cantilever,
    ForceDrive,
    ImpactLaw,
    Platform,
    Scene,
    TabulatedLaw,
    save_scene,
)
from afm_jax.cli.main import main
from afm_jax.dynamics.continuation import Continuation, continue_orbits
from afm_jax.saved import as_json
from afm_jax.scenefile.parameter_paths import ParameterRange
from tests.strict_reading import strictly

FREE = 2.0 * np.pi * 0.09
"""Omega in rad/us."""


def scene(
    amplitude_nm: float = 2.0, n: float = 1.05, r: float = 0.5, epsilon: float = 0.0, offset: float = -1.0
) -> Scene:
    return Scene(Cantilever(90.0), Platform(amplitude_nm, 180.0 * n, offset), ImpactLaw(r, epsilon))


def root_of(function: Callable[[float], float], low: float, high: float) -> float:
    return float(np.asarray(brentq(function, low, high, xtol=1e-15)))


def eq9_orbit(n: float, beta: float, sigma: float, approach: float, rebound: float) -> tuple[float, float, float]:
    """Return sine and cosine of the impact phase and V' of the undamped (1, 1) orbit with these speeds.

    The flight of duration T returns to its height: V = -V', z = V' cot(Omega T/2)/Omega. With u = v_p - V and
    w = V' - v_p: V' = (u + w)/2, v_p = (u - w)/2. The sum of squares of both is 1 on an orbit.
    """
    omega = 2.0 * n * FREE
    after = 0.5 * (approach + rebound)
    sine = -0.5 * (approach - rebound) / (beta * omega)
    cosine = (after / FREE / np.tan(FREE * np.pi / omega) - sigma) / beta
    return sine, cosine, after


def amplitude_of(approach: float, rebound: float) -> float:
    """Return the drive amplitude whose orbit has these speeds, for n = 1.01 and sigma = -1."""
    sine, cosine, _ = eq9_orbit(1.01, 1.0, -1.0, approach, rebound)
    return float(np.hypot(sine, cosine))


def capture_amplitude(r: float, epsilon: float) -> float:
    return amplitude_of(np.sqrt(epsilon) / r, 0.0)


def amplitude_by_law(approach: float, r: float, epsilon: float) -> float:
    return amplitude_of(approach, np.sqrt((r * approach) ** 2 - epsilon))


def fold_of(r: float, epsilon: float) -> float:
    """Return the approach speed of the fold: the smallest amplitude that closes eq. 9 for any speed."""
    speed = np.sqrt(epsilon) / r

    def slope(u: float) -> float:
        return (amplitude_by_law(u + 1e-5, r, epsilon) - amplitude_by_law(u - 1e-5, r, epsilon)) / 2e-5

    return root_of(slope, 1.05 * speed, 10.0 * speed)


def eq8_trace(n: float, beta: float, sine: float, cosine: float, after: float, r: float) -> float:
    """Return T of eq. 8 as the paper prints it (V = -V')."""
    omega = 2.0 * n * FREE
    turn = FREE * 2.0 * np.pi / omega
    c, s = np.cos(turn), np.sin(turn)
    v_p = -beta * omega * sine
    ratio = (-after - v_p) / (after - v_p)
    bracket = (
        beta * omega * sine
        - beta * omega * sine * c
        - (after + beta * omega * sine * c) * r**2 * ratio
        + beta * omega**2 / FREE * cosine * s * (r**2 * ratio - 1.0)
    )
    return 1.0 + bracket / (v_p + after)


def orbit_of(n: float, beta: float, sigma: float, r: float, near: float) -> tuple[float, float, float]:
    """Return sine, cosine and V' of the orbit whose approach speed is next to one."""

    def misses(approach: float) -> float:
        sine, cosine, _ = eq9_orbit(n, beta, sigma, approach, r * approach)
        return sine**2 + cosine**2 - 1.0

    low, high = 0.8 * near, 1.2 * near
    approach = root_of(misses, low, high)
    return eq9_orbit(n, beta, sigma, approach, r * approach)


def only(found: Continuation, kind: str) -> list[float]:
    return [point.parameter for point in found.special if point.kind == kind]


@pytest.fixture(scope="module")
def doubled() -> Continuation:
    """The (1, 1) orbit of a lossy undamped oscillator through its period doubling, followed in the offset too."""
    given = ParameterRange("platform.reduced_frequency", 0.9, 1.4)
    return continue_orbits(scene(), 1, given, second=ParameterRange("platform.offset_nm", -1.9, 0.0))


@pytest.mark.slow
def test_period_doubling_is_that_of_eq_8(doubled: Continuation):
    (at,) = only(doubled, "period_doubling")
    speed = float(doubled.special[0].reading.approach_speed_nm_per_us[0])

    def stability(n: float) -> float:
        sine, cosine, after = orbit_of(n, 2.0, -1.0, 0.5, speed)
        return eq8_trace(n, 2.0, sine, cosine, after, 0.5) + 1.25

    assert at == pytest.approx(root_of(stability, at - 0.01, at + 0.01), abs=1e-8)


@pytest.mark.slow
def test_points_on_a_branch_are_eq_9s_orbits_with_eq_8s_trace(doubled: Continuation):
    (branch,) = doubled.branches
    assert branch.parameter[[0, -1]] == pytest.approx([0.9, 1.4])
    for index in range(0, len(branch.parameter), 7):
        n, reading = branch.parameter[index], branch.reading
        sine, cosine, after = orbit_of(n, 2.0, -1.0, 0.5, float(reading.approach_speed_nm_per_us[index, 0]))
        assert np.exp(1j * reading.phase_rad[index, 0]) == pytest.approx(cosine + 1j * sine, abs=1e-10)
        assert reading.velocity_after_nm_per_us[index, 0] == pytest.approx(after, rel=1e-10)
        assert reading.trace[index] == pytest.approx(eq8_trace(n, 2.0, sine, cosine, after, 0.5), rel=1e-9)
        assert reading.determinant[index] == pytest.approx(0.25, rel=1e-9)


@pytest.mark.slow
def test_a_curve_in_two_parameters_is_eq_8_all_along(doubled: Continuation):
    (curve,) = doubled.curves
    assert curve.kind == "period_doubling"
    assert np.ptp(curve.second) == pytest.approx(1.9)
    for n, sigma in zip(curve.parameter[::4], curve.second[::4], strict=True):
        # of all orbits there one must be at the doubling
        speeds = np.linspace(0.05, 40.0, 4001)
        orbits = np.array([eq9_orbit(n, 2.0, sigma, float(speed), 0.5 * float(speed)) for speed in speeds])
        miss = orbits[:, 0] ** 2 + orbits[:, 1] ** 2 - 1.0
        near = speeds[:-1][miss[:-1] * miss[1:] < 0.0]
        orbits = [orbit_of(n, 2.0, sigma, 0.5, float(speed) + 0.005) for speed in near]
        left = [abs(eq8_trace(n, 2.0, *orbit, 0.5) + 1.25) for orbit in orbits]
        assert min(left) < 1e-7


@pytest.mark.slow
def test_with_adhesion_a_branch_turns_at_a_fold_and_ends_at_capture():
    r, epsilon = 0.95, 60.0
    found = continue_orbits(scene(4.0, 1.01, r, epsilon), 1, ParameterRange("platform.amplitude_nm", 0.5, 6.0))
    (captured,), speed = only(found, "capture"), np.sqrt(epsilon) / r
    assert captured == pytest.approx(capture_amplitude(r, epsilon), abs=1e-8)
    # the branch reaches as far: its last point leaves as slowly as it may
    (branch,) = found.branches
    last = 0 if branch.ends[0] == "capture" else -1
    assert branch.parameter[last] == pytest.approx(captured, abs=1e-4)
    assert 0.0 < branch.reading.rebound_speed_nm_per_us[last, 0] < 0.02 * speed

    (fold,) = only(found, "fold")
    assert fold == pytest.approx(amplitude_by_law(fold_of(r, epsilon), r, epsilon), abs=1e-8)
    point = next(point for point in found.special if point.kind == "fold")
    # |T| = |1 + D| there
    assert float(point.reading.trace) == pytest.approx(1.0 + r**2, rel=1e-8)


@pytest.mark.slow
def test_a_driven_tip_grazes_where_it_must():
    # A tip driven by a force of 0.08 nN over a resting sample: the free amplitude of a damped oscillator of 1 ng.
    drive, quality = 2.0 * np.pi * 0.089, 40.0
    size = 0.08 / np.hypot(FREE**2 - drive**2, FREE * drive / quality)
    driven = Scene(Cantilever(90.0, quality), Platform(0.0, 90.0, -5.0), ImpactLaw(0.9), force=ForceDrive(0.08, 89.0))
    given = ParameterRange("platform.offset_nm", -10.0, -4.0)
    free = continue_orbits(driven, 1, given, impacts=0)
    assert only(free, "grazing") == pytest.approx([-size], abs=1e-8)
    assert float(free.special[0].reading.peak_amplitude_nm) == pytest.approx(size, rel=1e-9)
    # the orbit of one impact begins there, with a speed of 0: one border, whatever tells it
    one = continue_orbits(driven, 1, given, second=ParameterRange("force.amplitude_nn", 0.06, 0.12))
    assert only(one, "grazing") == pytest.approx([-size], abs=1e-8)
    (curve,) = (curve for curve in one.curves if curve.kind == "grazing")
    np.testing.assert_allclose(curve.parameter, -size / 0.08 * curve.second, atol=1e-7)


def run(made: Scene, folder: Path, command: str, *arguments: str) -> dict:
    """Run a command on a scene and return what it prints."""
    save_scene(made, folder / "scene.toml")
    result = CliRunner().invoke(main, [command, str(folder / "scene.toml"), *arguments, "--json"])
    assert result.exit_code == 0, result.stderr
    return strictly(result.stdout)


COVARIANCE = [[4e-4**2, 0.2 * 4e-4 * 0.93], [0.2 * 4e-4 * 0.93, 0.93**2]]
"""Of r and epsilon."""


def fit_file(path: Path) -> str:
    """Write what `afm-jax fit --out` writes of r = 0.95 and epsilon = 60, as far as it is read, and return the path."""
    u = np.geomspace(10.0, 100.0, 12)
    w = np.sqrt((0.95 * u) ** 2 - 60.0)
    # r and epsilon change with two independent unknowns
    by_r, by_epsilon = np.stack([0.95 * u**2 / w, np.full(12, -1.0) / (2.0 * w)])
    of_capture = np.array([-np.sqrt(60.0) / 0.95**2, 0.5 / np.sqrt(60.0) / 0.95])
    factor = np.linalg.cholesky(COVARIANCE)
    law = TabulatedLaw.with_errors(
        u,
        w,
        rebound_changes=factor.T @ np.stack([by_r, by_epsilon]),
        capture_changes=factor.T @ of_capture,
        capture_speed_nm_per_us=np.sqrt(60.0) / 0.95,
    )
    payload = {"format": "afm-jax fit", "format_version": 2, "valid": True, "law": as_json(law)}
    path.write_text(json.dumps(payload), encoding="utf-8")
    return str(path)


@pytest.mark.slow
def test_the_law_of_a_fit_gives_intervals(tmp_path: Path):
    law = ("--law", fit_file(tmp_path / "fit.json"))
    ranges = ("--parameter", "platform.amplitude_nm=0.5:6")
    answer = run(scene(4.0, 1.01, 0.5), tmp_path, "continue", "--order", "1", *ranges, *law)
    special = {point["kind"]: point for point in answer["special"]}
    # a fold is the least amplitude: to first order it changes as that of its own speed
    turn = fold_of(0.95, 60.0)

    def fold_amplitude(r: float, epsilon: float) -> float:
        return amplitude_by_law(turn, r, epsilon)

    # between its twelve speeds the table is the formula to 1e-5
    closed_forms = {"capture": (capture_amplitude, 1e-8, 1e-5), "fold": (fold_amplitude, 1e-5, 1e-3)}
    for kind, (amplitude, value_tolerance, error_tolerance) in closed_forms.items():
        point = special[kind]
        assert point["parameter"] == pytest.approx(amplitude(0.95, 60.0), abs=value_tolerance)
        by_r = (amplitude(0.9501, 60.0) - amplitude(0.9499, 60.0)) / 2e-4
        by_epsilon = (amplitude(0.95, 60.01) - amplitude(0.95, 59.99)) / 0.02
        one, other = by_r * 4e-4, by_epsilon * 0.93
        error = np.sqrt(one**2 + other**2 + 0.4 * one * other)
        assert point["parameter_error"] == pytest.approx(error, rel=error_tolerance)
        assert np.diff(point["interval95"]) == pytest.approx([3.92 * error], rel=max(1e-4, error_tolerance))
    assert all(point["peak_amplitude_error_nm"] > 0.0 for point in answer["points"])


@pytest.mark.slow
def test_a_tip_at_rest_that_the_sample_goes_through_is_no_grazing():
    """Without adhesion loops of no speed close at both ends of the sample's motion; a tip can rest above it only."""
    beta = 2.0
    scene = Scene(Cantilever(90.0, 40.0), Platform(beta, 183.6), ImpactLaw(0.9))
    found = continue_orbits(scene, 1, ParameterRange("platform.offset_nm", -6.0, 6.0))
    grazes = [point for point in found.special if point.kind == "grazing"]
    assert all(point.admissible for point in grazes)
    # once each: at rest on the highest sample, and where the flight touches the sample on its way
    assert [point.parameter for point in grazes] == [pytest.approx(-beta, abs=1e-9), pytest.approx(2.1222, abs=1e-3)]
    assert not any(abs(point.parameter - beta) < 1e-3 for point in found.special)
    # nothing is captured without adhesion
    ends = {end: one.parameter[place] for one in found.branches for place, end in ((0, one.ends[0]), (-1, one.ends[1]))}
    assert "capture" not in ends
    assert abs(ends["no_speed"]) == pytest.approx(beta, abs=1e-3)
