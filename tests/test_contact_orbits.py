"""Orbits of resolved contacts against an integration of their own (`reference_driven_contact`)."""

import numpy as np
import pytest

import afm_jax as afm
from afm_jax.dynamics.contact_orbits import contact_orbits
from afm_jax.dynamics.continuation import continue_orbits
from afm_jax.scenefile.parameter_paths import ParameterRange
from tests.reference_driven_contact import DrivenContact, follow

pytestmark = pytest.mark.slow
AMPLITUDE_NM, FREQUENCY_KHZ = 4.0, 181.8
PERIOD_US, OMEGA = 1e3 / FREQUENCY_KHZ, 2e-3 * np.pi * FREQUENCY_KHZ


@pytest.fixture(scope="module")
def scene():
    platform = afm.Platform(amplitude_nm=AMPLITUDE_NM, frequency_khz=FREQUENCY_KHZ)
    return afm.Scene(afm.Cantilever(frequency_khz=90.0, quality_factor=40.0), platform, afm.Contact.paper())


@pytest.fixture(scope="module")
def found(scene):
    return contact_orbits(scene, 1, 1)


def next_departure(
    time_us: float,
    velocity: float,
    amplitude_nm: float = AMPLITUDE_NM,
    frequency_khz: float = FREQUENCY_KHZ,
    contacts: int = 1,
) -> np.ndarray:
    """Return time and velocity in the lab by the reference, at the end of some contacts after a departure."""
    system = DrivenContact(amplitude_nm=amplitude_nm, drive_frequency_khz=frequency_khz)
    omega = 2e-3 * np.pi * frequency_khz
    height = amplitude_nm * np.cos(omega * time_us) + system.contact.bridge_breaks_nm
    last = follow(system, time_us, height, velocity, contacts=contacts).contacts[-1]
    rate = -amplitude_nm * omega * np.sin(omega * last.departure_time_us)
    return np.array([last.departure_time_us, last.rebound_speed_nm_per_us + rate])


def reference_jacobian(time: float, velocity: float, steps: tuple[float, float], amplitude_nm: float) -> np.ndarray:
    """Return the derivatives of the next departure by central differences of the reference."""
    columns = []
    for step, move in zip(steps, np.diag(steps), strict=True):
        ahead, behind = (next_departure(time + by[0], velocity + by[1], amplitude_nm) for by in (move, -move))
        columns.append((ahead - behind) / (2.0 * step))
    return np.stack(columns, axis=1)


def test_a_stable_orbit_and_a_saddle_near_capture_close_in_the_reference(found):
    assert found.stable.tolist() == [True, False]
    assert found.reading.missing.max() < 1e-10
    # from another simulation (the table of the delay)
    assert found.reading.peak_amplitude_nm[0] == pytest.approx(98.7, rel=2e-3)
    for phase, velocity in zip(
        found.reading.phase_rad[:, 0], found.reading.velocity_after_nm_per_us[:, 0], strict=True
    ):
        time = float(phase) / OMEGA
        later = next_departure(time, float(velocity))
        assert later[0] - time == pytest.approx(PERIOD_US, abs=1e-7)
        assert later[1] == pytest.approx(float(velocity), rel=1e-7)


def test_the_multipliers_are_those_of_differences_in_the_reference(found):
    for index in range(2):
        time = float(found.reading.phase_rad[index, 0]) / OMEGA
        velocity = float(found.reading.velocity_after_nm_per_us[index, 0])
        matrix = reference_jacobian(time, velocity, (1e-4, 1e-3) if index == 0 else (1e-5, 1e-4), AMPLITUDE_NM)
        assert np.trace(matrix) == pytest.approx(float(found.reading.trace[index]), rel=2e-4)
        assert np.linalg.det(matrix) == pytest.approx(float(found.reading.determinant[index]), rel=2e-4)


@pytest.mark.long
def test_the_fold_that_ends_both_orbits_is_one_of_the_reference(scene):
    found = continue_orbits(scene, 1, ParameterRange("platform.amplitude_nm", 1.0, 4.5))
    assert [point.kind for point in found.special] == ["fold"]
    (fold,) = found.special
    assert fold.parameter > 1.0
    peaks = found.branches[0].reading.peak_amplitude_nm
    assert {len(found.branches), found.branches[0].ends} == {1, ("range", "range")}
    assert found.branches[0].parameter[[0, -1]].tolist() == [4.5, 4.5]
    assert max(peaks[0], peaks[-1]) > 5.0 * min(peaks[0], peaks[-1])
    time = float(fold.reading.phase_rad[0]) / OMEGA
    velocity = float(fold.reading.velocity_after_nm_per_us[0])
    later = next_departure(time, velocity, fold.parameter)
    assert later[0] - time == pytest.approx(PERIOD_US, abs=1e-7)
    assert later[1] == pytest.approx(velocity, rel=1e-6)
    multipliers = np.linalg.eigvals(reference_jacobian(time, velocity, (1e-4, 1e-3), fold.parameter))
    assert np.abs(multipliers - 1.0).min() < 2e-4


def test_beyond_its_period_doubling_an_orbit_makes_two_contacts_in_the_reference():
    # the orbit of one contact doubles its period at 1.3202 times 180 kHz
    amplitude_nm, frequency_khz = 15.0, 180.0 * 1.3217
    omega = 2e-3 * np.pi * frequency_khz
    platform = afm.Platform(amplitude_nm=amplitude_nm, frequency_khz=frequency_khz)
    found = contact_orbits(afm.Scene(afm.Cantilever(90.0, 40.0), platform, afm.Contact.paper()), 2, 2)
    assert found.stable.tolist() == [True]
    phase, velocity = found.reading.phase_rad[0], found.reading.velocity_after_nm_per_us[0]
    time, speed = float(phase[0]) / omega, float(velocity[0])
    half = next_departure(time, speed, amplitude_nm, frequency_khz)
    assert np.exp(1j * omega * half[0]) == pytest.approx(np.exp(1j * float(phase[1])), abs=1e-6)
    assert half[1] == pytest.approx(float(velocity[1]), rel=1e-6)
    # not the orbit of one contact twice
    assert abs(half[1] - speed) > 1e-3 * abs(speed)
    whole = next_departure(time, speed, amplitude_nm, frequency_khz, contacts=2)
    assert whole == pytest.approx([time + 2e3 / frequency_khz, speed], abs=1e-5)


def test_scenes_without_a_contact_and_numbers_that_are_none_are_refused(scene):
    law = afm.Scene(scene.cantilever, scene.platform, afm.ImpactLaw(r=0.998, epsilon=122.0))
    with pytest.raises(TypeError, match="many_impact_orbits"):
        contact_orbits(law, 1, 1)
    with pytest.raises(ValueError, match="`impacts` must be a positive integer"):
        contact_orbits(scene, 1, 0)
