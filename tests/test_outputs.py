"""What the commands' JSON has in common: phases follow one convention."""

import math

import numpy as np

from afm_jax.units import within_turn


def test_a_whole_turn_is_none():
    for turn in (2.0 * math.pi, 360.0, 120.0):
        found = within_turn(np.array([-1e-17, -turn, 2.5 * turn, -0.25 * turn, turn]), turn)
        np.testing.assert_allclose(found, [0.0, 0.0, 0.5 * turn, 0.75 * turn, 0.0], rtol=1e-15)
        assert np.all(found < turn)
