"""Reference orbits against each other, closed forms and the known results."""

import numpy as np
import pytest

from tests.reference_examples import DELAY, SCENES, digits, scene
from tests.reference_flight import constants, mp
from tests.reference_map import iterate
from tests.reference_orbits import orbits_by_phase, orbits_by_speed, single_impact_orbits


@pytest.mark.parametrize("name", SCENES)
def test_orbits_repeat_themselves_under_the_map(name: str):
    p = SCENES[name]
    orbits = [orbit for orbit in single_impact_orbits(p, 1) if orbit.admissible]
    assert orbits
    for orbit in orbits:
        with mp.workdps(65):
            k = constants(p)
            impact = iterate(p, orbit.phase_rad / k.drive, orbit.velocity_after_nm_per_us, 1)[0]
            assert digits(impact.velocity_after_nm_per_us, orbit.velocity_after_nm_per_us) > 45
            assert digits(impact.time_us, orbit.phase_rad / k.drive + k.drive_period) > 45


def test_orbit_at_resonance_without_adhesion_is_closed_form():
    p = scene(1.0, quality_factor=None, offset_nm=0.0, epsilon=0.0, r=0.8)
    (orbit,) = [orbit for orbit in single_impact_orbits(p, 1) if orbit.admissible]
    with mp.workdps(65):
        k = constants(p)
        after = k.amplitude * k.drive * (1 + k.r) / (1 - k.r)
        assert digits(orbit.velocity_after_nm_per_us, after) > 50
        assert digits(orbit.phase_rad, 3 * mp.pi / 2) > 50
    # Half a sine of height V'/Omega, then the next: the peak and the fundamental of |sin| (4/3 pi) in closed form.
    height = float(after / k.free)
    assert orbit.peak_amplitude_nm == pytest.approx(height, rel=1e-12)  # dense sampling and a parabola
    assert orbit.lockin_amplitude_nm == pytest.approx(height * 4 / (3 * np.pi), rel=1e-12)  # Gauss in float64
    # z is highest half a period after the impact, at omega t = 5 pi/2: phi = -90 degrees.
    assert orbit.lockin_phase_deg == pytest.approx(270.0, abs=1e-9)


@pytest.mark.parametrize(("reduced", "quality_factor"), [(0.6, 15.0), (1.0, None), (3.1, 15.0)])
def test_two_ways_to_the_orbits_agree(reduced: float, quality_factor: float | None):
    changes = {"quality_factor": quality_factor, "r": 0.5, "epsilon": 1.0, "offset_nm": 1.0}
    p = scene(reduced, **changes)
    found = 0
    for order in (1, 2, 3):
        by_phase = sorted(orbits_by_phase(p, order), key=lambda pair: pair[1])
        by_speed = sorted(orbits_by_speed(p, order), key=lambda pair: pair[1])
        assert len(by_phase) == len(by_speed)
        found += len(by_phase)
        for left, right in zip(by_phase, by_speed, strict=True):
            assert min(digits(left[0], right[0]), digits(left[1], right[1])) > 40  # near folds digits go
    assert found


@pytest.mark.parametrize(
    ("reduced", "amplitude", "offset", "plain", "delayed"),
    [
        (1.0001, 2.0, 0.0, 166, 67.5),
        (1.01, 4.0, -2.0, 108, 51.0),
        (1.01, 4.0, 0.0, 208, 99.0),
        (1.01, 4.0, 2.0, 291, 150.2),
    ],
)
def test_peak_heights_of_the_known_orbits(
    reduced: float, amplitude: float, offset: float, plain: float, delayed: float
):
    changes = {"amplitude_nm": amplitude, "offset_nm": offset}
    for delay, height, within in ((None, plain, 0.005), (DELAY, delayed, 0.01)):
        # Printed without decimals; with delay the table used the tabulated one, which the law fits to 0.001 us.
        stable = [
            o for o in single_impact_orbits(scene(reduced, delay=delay, **changes), 1) if o.stable and o.admissible
        ]
        assert len(stable) == 1
        assert stable[0].peak_amplitude_nm == pytest.approx(height, rel=within)
