"""Pictures of motions: which there are for which scene, what they show, and numbers behind them."""

from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import matplotlib.image
import numpy as np
import pytest

from afm_jax import presets
from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.excitation import BaseDrive
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.contact.phases import Phase
from afm_jax.impact.law import ImpactLaw
from afm_jax.motion.simulate import simulate
from afm_jax.motion.start import default_start, state
from afm_jax.plots.motion import draw_motion
from afm_jax.plots.motion_spectrum import spectrum_of
from afm_jax.plots.motion_window import look_at

ALL = ["time_course.png", "spectrum.png", "gap.png", "poincare.png", "force_gap.png"]


def check_pictures(files: list[Path]):
    for path in files:
        image = matplotlib.image.imread(path)
        assert image.shape[1] >= 1400
        assert 0.3 < (image[..., :3].mean(axis=2) > 0.98).mean() < 0.99  # neither empty nor black


@pytest.fixture(scope="module")
def bouncing():
    scene = presets.contact_scene(1.01, 4.0, 0.0)
    return scene, simulate(scene, default_start(scene), 120.0)


def test_a_contact_scene_has_every_picture(bouncing, tmp_path: Path):
    scene, found = bouncing
    files = draw_motion(scene, found, tmp_path)
    assert [path.name for path in files] == ALL
    check_pictures(files)


def test_the_stretch_shown_ends_with_whole_contacts(bouncing):
    scene, found = bouncing
    look = look_at(scene, found)
    rows = int(found.count)
    assert look.arrival_us.size == rows
    # six contacts, each with bridge and junction resolved
    shown = look.arrival_us[-6:]
    assert look.from_us < shown[0] < look.to_us
    for arrival, departure in zip(shown, look.departure_us[-6:], strict=True):
        part = look.between(arrival, departure)
        assert {Phase.BRIDGE, Phase.JUNCTION} <= set(part.phase.tolist())
        assert part.force_nn.min() < -50.0  # the pull-off force is over 100 nN


def test_a_free_cantilever_has_the_line_of_its_drive(tmp_path: Path):
    base = BaseDrive(0.5, 88.0, 0.0)
    scene = Scene(Cantilever(90.0, 40.0), Platform(0.0, 90.0), None, base)
    found = simulate(scene, state(0.0, 0.0, 0.0), 6000.0)
    files = draw_motion(scene, found, tmp_path)
    assert [path.name for path in files] == ["time_course.png", "spectrum.png"]
    check_pictures(files)
    spectrum = spectrum_of(look_at(scene, found))
    line = int(np.argmax(spectrum.amplitude_nm))
    assert spectrum.frequency_khz[line] == pytest.approx(88.0, rel=1e-9)
    # z - z_b of a driven oscillator: |H Omega^2 - 1| times the base's amplitude
    response = 90.0**2 / (90.0**2 - 88.0**2 + 1j * 88.0 * 90.0 / 40.0) - 1.0
    # the transient has decayed by exp(-6000/141)
    assert spectrum.amplitude_nm[line] == pytest.approx(0.5 * abs(response), rel=1e-9)


def test_a_law_has_no_force_to_draw(tmp_path: Path):
    scene = Scene(Cantilever(90.0, 40.0), Platform(2.0, 180.0, -1.0), ImpactLaw(0.9))
    found = simulate(scene, default_start(scene), 150.0)
    files = draw_motion(scene, found, tmp_path)
    assert [path.name for path in files] == ALL[:-1]
    check_pictures(files)


def test_batches_and_empty_simulations_are_refused(bouncing, tmp_path: Path):
    scene, found = bouncing
    batch = replace(found, count=jnp.array([1, 2]))
    with pytest.raises(ValueError, match="pick one of the batch"):
        draw_motion(scene, batch, tmp_path)
    with pytest.raises(ValueError, match="nothing to draw"):
        draw_motion(scene, replace(found, final=found.start), tmp_path)
