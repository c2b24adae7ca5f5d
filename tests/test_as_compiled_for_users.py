"""Tests against references once more, compiled as users' programs are: `make test` and `make slow` compile sooner."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

SHARP = (
    "tests/test_apparatus.py::test_sine_and_cosine_are_right_to_the_last_digit",
    "tests/test_poincare.py::test_ten_impacts_in_a_row_agree_with_fifty_digits[delayed]",
    "tests/test_jacobian.py::test_written_and_automatic_jacobians_have_twelve_digits[start0-delayed]",
    "tests/test_orbits.py::test_orbits_are_those_of_the_reference[delayed]",
    "tests/test_collide.py::test_default_accuracy_is_reached_from_11_times_the_capture_speed",
    "tests/test_law_motion.py::test_flights_and_impacts_are_those_of_the_map[delayed]",
    "tests/test_simulate_contact.py::test_tenth_crossing_agrees_with_an_independent_integration",
    "tests/test_forward.py::test_predictions_are_the_orbits_amplitudes",
)


@pytest.mark.slow
def test_references_are_met_with_all_optimisations():
    environment = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *SHARP],
        cwd=Path(__file__).parent.parent,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout[-4000:]
