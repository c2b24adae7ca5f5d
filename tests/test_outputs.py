"""What the commands' JSON has in common: it says what it is, and phases follow one convention."""

import math
from pathlib import Path

import click
import numpy as np
import pytest

from afm_jax.cli import main
from afm_jax.units import within_turn


def test_a_whole_turn_is_none():
    for turn in (2.0 * math.pi, 360.0, 120.0):
        found = within_turn(np.array([-1e-17, -turn, 2.5 * turn, -0.25 * turn, turn]), turn)
        np.testing.assert_allclose(found, [0.0, 0.0, 0.5 * turn, 0.75 * turn, 0.0], rtol=1e-15)
        assert np.all(found < turn)


@pytest.mark.parametrize("name", main.COMMANDS)
def test_every_command_labels_its_json(name: str):
    """Every command writes JSON through the session, which labels what is not labelled."""
    command = main.main.get_command(click.Context(main.main), name)
    assert command is not None
    assert "--json" in [option for each in command.params for option in each.opts]


def test_only_the_session_writes_json():
    folder = Path(main.__file__).parent
    writing = [path.name for path in sorted(folder.rglob("*.py")) if "strict_json(" in path.read_text("utf-8")]
    assert writing == ["session.py"]
