"""Tips driven by a force or by their base over a resting sample: map, orbits, simulation, and a direct integration."""

from itertools import product
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.drives import BaseDrive, ForceDrive
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.dynamics.basins import basins_of_attraction
from afm_jax.dynamics.bifurcations import bifurcation_diagram
from afm_jax.dynamics.charts import stability_chart
from afm_jax.dynamics.exponents import lyapunov_spectrum
from afm_jax.dynamics.impact_orbits import multipliers_of
from afm_jax.impact.jacobian import map_jacobian
from afm_jax.impact.law import CollisionDelay, ImpactLaw
from afm_jax.impact.map import iterate_map, next_impact
from afm_jax.impact.orbits import SingleImpactOrbits, single_impact_orbits
from afm_jax.motion.observe import observe
from afm_jax.motion.record import State
from afm_jax.motion.simulate import simulate
from afm_jax.scenefile.parameter_paths import scene_family

MASS, PER_KHZ = 16.81, 2e-3 * np.pi
INSTANT = ImpactLaw(0.99, 0.1, 0.01)
DELAYED = ImpactLaw(0.99, 0.1, 0.01, CollisionDelay(0.1, 1.0, 0.2, corrections=False))
LASTING = ImpactLaw(0.99, 0.1, 0.01, CollisionDelay(0.1, 1.0, 0.2))


def driven(kind: str, law: ImpactLaw, ratio: float, free_nm: float, offset_nm: float, quality: float) -> Scene:
    """Return a scene whose free tip has an amplitude: the drive's from the textbook's complex response."""
    cantilever, frequency = Cantilever(90.0, quality, MASS), 90.0 * ratio
    push = free_nm * abs(1.0 - ratio**2 + 1j * ratio / quality)
    drives: dict[str, Any] = {"base": BaseDrive(push, frequency, -70.0)}
    if kind == "force":
        drives = {"force": ForceDrive(push * MASS * (PER_KHZ * 90.0) ** 2, frequency, 37.0)}
    # nothing counts in the resting platform's own frequency
    return Scene(cantilever, Platform(0.0, 33.0, offset_nm), law, **drives)


def fastest(found: SingleImpactOrbits) -> int:
    good = np.asarray(found.exists & found.admissible & found.stable)
    assert good.any()
    return int(np.argmax(np.where(good, found.approach_speed_nm_per_us, -np.inf)))


def drive_of(scene: Scene) -> BaseDrive | ForceDrive:
    drive = scene.force if scene.base is None else scene.base
    assert drive is not None
    return drive


def angular_frequency(scene: Scene) -> float:
    return PER_KHZ * float(drive_of(scene).frequency_khz)


def started(scene: Scene, found: SingleImpactOrbits, slot: int) -> State:
    time = jnp.asarray(found.phase_rad[slot] / angular_frequency(scene))
    return State(time, scene.platform.offset_nm, found.velocity_after_nm_per_us[slot])


def fly(scene: Scene, time: float, velocity: float, duration: float, **options: Any) -> Any:
    """Return a flight from the sample, by SciPy's DOP853 on the whole equation of motion."""
    drive, free, damping = drive_of(scene), PER_KHZ * 90.0, 2.0 * float(scene.cantilever.decay_rate)
    push = float(drive.tones[0].amplitude) * (1.0 / MASS if scene.base is None else free**2)
    omega, phase = angular_frequency(scene), np.radians(float(drive.phase_deg))

    def motion(t, state):
        return [state[1], push * np.cos(omega * t + phase) - damping * state[1] - free**2 * state[0]]

    start = [float(scene.platform.offset_nm), velocity]
    return solve_ivp(motion, (time, time + duration), start, "DOP853", rtol=1e-13, atol=1e-12, **options)


def integrated(scene: Scene, time: float, velocity: float, impacts: int) -> np.ndarray:
    """Return times of impacts."""
    level, law = float(scene.platform.offset_nm), scene.interaction

    def meets(_, state):
        return state[0] - level

    vars(meets).update(terminal=True, direction=-1.0)
    times = []
    for _ in range(impacts):
        flight = fly(scene, time, velocity, 100.0, events=meets)
        time, fast = float(flight.t_events[0][0]), -float(flight.y_events[0][0][1])
        velocity = float(np.sqrt((float(law.r) * fast) ** 2 - float(law.viscous_loss) * fast - float(law.epsilon)))
        times.append(time)
    return np.array(times)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["force", "base"])
def test_ten_impacts_are_those_of_a_direct_integration(kind: str):
    scene = driven(kind, INSTANT, 1.03, 60.0, -40.0, 200.0)
    found = iterate_map(scene, 3.0, 9.0, 10)
    assert np.all(np.asarray(found.outcome) == 0)
    np.testing.assert_allclose(found.time_us, integrated(scene, 3.0, 9.0, 10), rtol=0, atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "law", "ratio"), [("force", LASTING, 1.01), ("base", DELAYED, 1.1)])
def test_map_and_simulation_stay_on_the_orbit_and_read_its_numbers(kind: str, law: ImpactLaw, ratio: float):
    scene = driven(kind, law, ratio, 60.0, -30.0, 200.0)
    found = single_impact_orbits(scene, 1)
    slot, period = fastest(found), 2.0 * np.pi / angular_frequency(scene)
    start = started(scene, found, slot)
    once = next_impact(scene, start.time_us, start.velocity_nm_per_us)
    assert float(once.time_us - start.time_us) == pytest.approx(period, abs=1e-10)
    assert float(once.velocity_after_nm_per_us - start.velocity_nm_per_us) == pytest.approx(0.0, abs=1e-9)
    seen = observe(scene, simulate(scene, start, 60.0 * period))
    assert seen.settled.periods == 1
    names = ("peak_amplitude_nm", "lockin_amplitude_nm", "lockin_phase_deg", "phase_lag_deg")
    for name in (*names, *(("peak_deflection_nm", "deflection_lockin_phase_deg") if kind == "base" else ())):
        assert getattr(seen, name) == pytest.approx(float(getattr(found, name)[slot]), rel=1e-9), name


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["force", "base"])
def test_at_higher_order_the_drives_frequency_is_read_as_a_direct_integration_has_it(kind: str):
    """Orbits and simulations, read at omega/3 and at omega; Fourier sums over the flight that SciPy integrates."""
    scene = driven(kind, INSTANT, 6.06, 4.0, -1.0, 40.0)
    found = single_impact_orbits(scene, 3)
    slot, omega = fastest(found), angular_frequency(scene)
    start, drive = started(scene, found, slot), drive_of(scene)
    time, duration = float(start.time_us), 6.0 * np.pi / omega
    times = np.linspace(time, time + duration, 60_001)
    heights = fly(scene, time, float(start.velocity_nm_per_us), duration, t_eval=times).y[0]
    deflection = heights
    if scene.base is not None:
        base = float(drive.tones[0].amplitude) * np.cos(omega * times + np.radians(float(drive.phase_deg)))
        deflection = heights - base
    seen = observe(scene, simulate(scene, start, 180.0 * np.pi / omega), harmonics=(2,))
    assert seen.settled.periods == 3
    assert seen.drive_frequency_khz == pytest.approx(omega / PER_KHZ, rel=1e-12)
    assert seen.response_frequency_khz == pytest.approx(omega / PER_KHZ / 3.0, rel=1e-12)
    assert [one.multiple for one in seen.harmonics] == [2]
    motions = {"": heights} if scene.base is None else {"": heights, "deflection_": deflection}
    for (name, motion), (share, key) in product(motions.items(), ((1.0, "drive_lockin"), (1.0 / 3.0, "lockin"))):
        turned = motion * np.exp(-1j * share * omega * times)
        value = 2.0 * np.trapezoid(turned, times) / duration
        size, phase = (f"{name}{key}_{what}" for what in ("amplitude_nm", "phase_deg"))
        for amplitude, angle in (
            (getattr(seen, size), getattr(seen, phase)),
            (getattr(found, size)[slot], getattr(found, phase)[slot]),
        ):
            # 1e-7 nm of the sum's step, and what rounding has done to the orbit
            assert float(amplitude) == pytest.approx(abs(value), abs=2e-6)
            turn = 360.0 * share
            away = (float(angle) - np.degrees(np.angle(value)) + 0.5 * turn) % turn - 0.5 * turn
            assert away == pytest.approx(0.0, abs=1e-4)
    at_drive = np.trapezoid(deflection * np.exp(-1j * omega * times), times)
    lag = (float(drive.phase_deg) - np.degrees(np.angle(at_drive))) % 360.0
    assert seen.phase_lag_deg == pytest.approx(lag, abs=1e-4)
    assert found.phase_lag_deg is not None
    assert float(found.phase_lag_deg[slot]) == pytest.approx(lag, abs=1e-4)


@pytest.mark.slow
def test_charts_sweeps_exponents_and_basins_of_driven_tips_come_to_the_orbit():
    """What they come to is the orbit of `single_impact_orbits`, in the scene's own clock and in the lab."""
    scene = driven("base", ImpactLaw(0.8, 0.5), 1.1, 6.0, -5.0, 40.0)
    orbits = single_impact_orbits(scene, 1)
    slot = fastest(orbits)
    place = float(orbits.phase_rad[slot]), float(orbits.velocity_after_nm_per_us[slot])
    swept = bifurcation_diagram(scene, "platform.offset_nm", np.array([-5.0, -4.9]), impacts=600)
    assert swept.verdicts.names()[0] == "(1,1)"
    found = swept.phase_rad[0, -1], swept.velocity_after_nm_per_us[0, -1]
    assert found == pytest.approx(place, rel=1e-8)
    assert swept.height_nm[0, -1] == pytest.approx(-5.0, abs=1e-12)
    lyapunov = lyapunov_spectrum(scene, impacts=400, transient=400)
    multipliers = multipliers_of(*(np.asarray(part)[[slot]] for part in (orbits.trace, orbits.determinant)))[0]
    assert lyapunov.exponents_per_impact == pytest.approx(np.log(np.abs(multipliers)), abs=1e-8)
    basins = basins_of_attraction(scene, columns=6, rows=4)
    (orbit,) = (one for one in basins.attractors if one.name == "(1,1)")
    assert (orbit.phase_rad[0], orbit.velocity_nm_per_us[0]) == pytest.approx(place, rel=1e-6)
    plane = scene_family(scene, "platform.offset_nm", "interaction.r")
    chart = stability_chart(plane, x_values=np.array([-5.0, -4.5]), y_values=np.array([0.8]), last_order=1)
    assert chart.verdicts.peak_amplitude_nm[0, 0] == pytest.approx(float(orbits.peak_amplitude_nm[slot]), rel=1e-12)


@pytest.mark.slow
def test_a_diagram_begins_where_there_is_motion_or_where_it_is_told_to():
    """Adhesion holds a tip that merely leaves the sample, beside a stable orbit at a free amplitude of 80 nm."""
    scene = driven("force", ImpactLaw(0.9, 60.0), 92.0 / 90.0, 80.0, -61.0, 40.0)
    orbits = single_impact_orbits(scene, 1)
    slot, values = fastest(orbits), np.array([-67.0, -64.0, -61.0])
    swept = bifurcation_diagram(scene, "platform.offset_nm", values, impacts=600)
    # too long a step for the tip, which begins anew
    assert swept.verdicts.names() == ["(1,1)", "stuck", "(1,1)"]
    found = swept.phase_rad[2, -1], swept.velocity_after_nm_per_us[2, -1]
    assert found == pytest.approx((float(orbits.phase_rad[slot]), float(orbits.velocity_after_nm_per_us[slot])))
    at_rest = bifurcation_diagram(scene, "platform.offset_nm", values, start=(0.0, 1.0, 0.0), impacts=600)
    assert at_rest.verdicts.names() == ["stuck"] * 3


@pytest.mark.slow
def test_jacobian_trace_and_determinant_are_those_of_automatic_differentiation():
    scene = driven("force", INSTANT, 1.03, 60.0, -40.0, 200.0)
    found = single_impact_orbits(scene, 1)
    slot = fastest(found)
    start = started(scene, found, slot)
    at = jnp.stack([start.time_us, start.velocity_nm_per_us])

    def after(state):
        impact = next_impact(scene, *state)
        return jnp.stack([impact.time_us, impact.velocity_after_nm_per_us])

    jacobian = np.asarray(map_jacobian(scene, *at))
    np.testing.assert_allclose(jacobian, jax.jacfwd(after)(at), rtol=1e-9)
    assert np.trace(jacobian) == pytest.approx(float(found.trace[slot]), rel=1e-9)
    assert np.linalg.det(jacobian) == pytest.approx(float(found.determinant[slot]), rel=1e-9)
