"""Orbits of a law with a delay have the peaks of the contact."""

import numpy as np
import pytest

from afm_jax import Cantilever, CollisionDelay, ImpactLaw, Platform, Scene, single_impact_orbits


@pytest.mark.parametrize(
    ("reduced", "amplitude", "offset", "height"),
    [(1.0001, 2.0, 0.0, 67.5), (1.01, 4.0, -2.0, 51.0), (1.01, 4.0, 0.0, 99.0), (1.01, 4.0, 2.0, 150.2)],
)
def test_without_corrections_the_peaks_are_the_known_ones(reduced, amplitude, offset, height):
    """physics.md, eq. 6 with the tabulated delay; the delay law is 0.001 us off, 1 % of the amplitude at most."""
    heights = []
    for corrections in (False, True):
        law = ImpactLaw(0.9981, 122.0, delay=CollisionDelay(0.206, 5.64, 0.726, corrections=corrections))
        found = single_impact_orbits(
            Scene(Cantilever(90.0, 40.0), Platform(amplitude, 180.0 * reduced, offset), law), 1
        )
        stable = np.asarray(found.exists & found.admissible & found.stable)
        heights.append(np.max(np.asarray(found.peak_amplitude_nm)[stable]))
    assert heights[0] == pytest.approx(height, rel=0.01)
    # what acts on the tip meanwhile brings it closer to the contact's 65.9, 50.6, 98.6 and 149.7
    assert 0.99 * heights[0] < heights[1] < heights[0]
