"""Pictures of motions: which there are for which scene, what they show, and numbers behind them."""

from pathlib import Path

import matplotlib.image
import numpy as np
import pytest

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.drives import BaseDrive
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.impact.law import ImpactLaw
from afm_jax.impact.orbits import single_impact_orbits
from afm_jax.motion.record import Simulation
from afm_jax.motion.simulate import simulate
from afm_jax.motion.start import default_start, state
from afm_jax.plots.motion import draw_motion, look_at, spectrum_figure, spectrum_of

ALL = ["time_course.png", "spectrum.png", "poincare.png", "force_gap.png"]


def drawn(scene: Scene, found: Simulation, folder: Path) -> list[str]:
    """Return the names of the pictures of a motion, which are neither empty nor black."""
    files = draw_motion(scene, found, folder)
    for path in files:
        image = matplotlib.image.imread(path)
        assert image.shape[1] >= 1400
        assert 0.3 < (image[..., :3].mean(axis=2) > 0.98).mean() < 0.99
    return [path.name for path in files]


def test_a_free_cantilever_has_the_line_of_its_drive(tmp_path: Path):
    base = BaseDrive(0.5, 88.0, 0.0)
    scene = Scene(Cantilever(90.0, 40.0), Platform(0.0, 90.0), None, base)
    found = simulate(scene, state(0.0, 0.0, 0.0), 6000.0)
    assert drawn(scene, found, tmp_path) == ["time_course.png", "spectrum.png"]
    frequency_khz, amplitude_nm = spectrum_of(look_at(scene, found))
    line = int(np.argmax(amplitude_nm))
    assert frequency_khz[line] == pytest.approx(88.0, rel=1e-9)
    # z - z_b of a driven oscillator: |H Omega^2 - 1| times the base's amplitude
    response = 90.0**2 / (90.0**2 - 88.0**2 + 1j * 88.0 * 90.0 / 40.0) - 1.0
    # the transient has decayed by exp(-6000/141)
    assert amplitude_nm[line] == pytest.approx(0.5 * abs(response), rel=1e-9)


def test_a_law_has_no_force_to_draw_and_the_line_at_half_the_drive_is_that_of_the_orbit(tmp_path: Path):
    scene = Scene(Cantilever(90.0, 40.0), Platform(4.0, 363.6), ImpactLaw(0.95, 10.0))
    found = simulate(scene, default_start(scene), 1500.0)
    assert drawn(scene, found, tmp_path) == ALL[:-1]
    look = look_at(scene, found)
    frequency_khz, amplitude_nm = spectrum_of(look)
    assert look.responses.repeats
    response_khz = 1e3 / look.responses.response_us
    assert response_khz == pytest.approx(363.6 / 2.0, rel=1e-12)
    orbits = single_impact_orbits(scene, 2.0)
    slot = int(np.argmax(np.asarray(orbits.stable & orbits.admissible)))
    line = int(np.argmin(np.abs(frequency_khz - response_khz)))
    # 64 samples a response period: the harmonics of a kink, 1/k^2, are folded onto the first line
    assert amplitude_nm[line] == pytest.approx(float(orbits.lockin_amplitude_nm[slot]), rel=2e-3)
    (axes,) = spectrum_figure(look).axes
    assert "subharmonics, drive/2" in axes.get_legend_handles_labels()[1]
