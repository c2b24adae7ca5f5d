"""What the commands' JSON has in common: it says what it is, and phases follow one convention."""

import math
from collections.abc import Iterator
from pathlib import Path

import click
import numpy as np
import pytest
from click.testing import CliRunner

from afm_jax.cli import main
from afm_jax.units import within_turn
from tests.strict_reading import strictly

SCENE = """[cantilever]
frequency_khz = 90
quality_factor = 40
[platform]
amplitude_nm = 4
frequency_khz = 181.8
[interaction]
model = "law"
r = 0.9
epsilon = 20
[interaction.delay]
hertz = 0.05
lead_nm = 1.0
offset_nm = 0.2
"""
CALLS = {
    "orbits": ["--order", "1"],
    "simulate": ["--periods", "60"],
    "continue": ["--order", "1", "--parameter", "platform.frequency_khz=181:183"],
    "bifurcation": ["--parameter", "platform.frequency_khz=181:183:4", "--impacts", "200"],
    "basins": ["--grid", "8x8"],
}


def angles(value: object, name: str = "") -> Iterator[tuple[str, float]]:
    """Return all numbers of an answer that stand under the name of a phase or a lag."""
    if isinstance(value, dict):
        for key, item in value.items():
            yield from angles(item, key)
    elif isinstance(value, list):
        for item in value:
            yield from angles(item, name)
    elif isinstance(value, float) and name.endswith(("phase_rad", "phase_deg", "lag_deg")):
        yield name, value


def test_a_whole_turn_is_none():
    for turn in (2.0 * math.pi, 360.0, 120.0):
        found = within_turn(np.array([-1e-17, -turn, 2.5 * turn, -0.25 * turn, turn]), turn)
        np.testing.assert_allclose(found, [0.0, 0.0, 0.5 * turn, 0.75 * turn, 0.0], rtol=1e-15)
        assert np.all(found < turn)


@pytest.mark.slow
@pytest.mark.parametrize("command", CALLS)
def test_phases_lie_within_one_turn(tmp_path: Path, command: str):
    scene = tmp_path / "scene.toml"
    scene.write_text(SCENE, encoding="utf-8")
    result = CliRunner().invoke(main.main, [command, str(scene), *CALLS[command], "--json"])
    assert result.exit_code == 0, result.stderr
    answer = strictly(result.stdout)
    assert (answer["format"], answer["format_version"]) == (f"afm-jax {command}", 1)
    found = list(angles(answer))
    assert found
    for name, angle in found:
        assert 0.0 <= angle < (2.0 * math.pi if name.endswith("rad") else 360.0), (name, angle)


@pytest.mark.parametrize("name", main.COMMANDS)
def test_every_command_labels_its_json(name: str):
    """Every command writes JSON through the session, which labels what is not labelled."""
    command = main.main.get_command(click.Context(main.main), name)
    assert command is not None
    assert "--json" in [option for each in command.params for option in each.opts]


def test_only_the_session_writes_json():
    folder = Path(main.__file__).parent
    writing = [path.name for path in sorted(folder.glob("*.py")) if "strict_json(" in path.read_text("utf-8")]
    assert writing == ["session.py"]
