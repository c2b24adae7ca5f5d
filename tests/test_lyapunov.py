"""Lyapunov exponents against multipliers, determinants and the growth of neighbouring motions."""

import json
from typing import Any

import jax
import numpy as np
import pytest
from click.testing import CliRunner

import afm_jax as afm
from afm_jax.cli.main import main
from afm_jax.dynamics.exponents import exponent_verdicts, lyapunov_spectrum
from afm_jax.dynamics.many_tips import Record, recorded, tips_after_contacts
from afm_jax.dynamics.starts import batch_and_tips
from afm_jax.motion.record import State
from afm_jax.motion.start import default_start, start_of
from afm_jax.scenefile.parameter_paths import scene_batch
from tests.test_dynamics import law_scene

REGULAR, CHAOTIC, RESTING = (0.99, 1.05, 1.2), 1.4875, 0.2
LONG: dict[str, Any] = {"impacts": 1000, "transient": 200}
"""Of all motions here: they share programs."""
OPTIONS = [f"--{name}={value}" for name, value in LONG.items()]


def growth(scene: afm.Scene, time: Any, later: Any, velocity: Any, faster: Any) -> np.ndarray:
    """Return by how much neighbours part a row, from the third to the last; arrays of shape (tips, rows)."""
    omega, top = float(scene.platform.angular_frequency), float(scene.platform.top_speed_nm_per_us)
    apart = np.hypot(omega * np.asarray(later - time), np.asarray(faster - velocity) / top)
    return np.log(apart[:, -1] / apart[:, 2]) / (apart.shape[1] - 3)


@pytest.fixture(scope="module")
def found():
    """The exponents of the regular motions and, last, of the chaotic one."""
    scenes = scene_batch(law_scene(1.0), {"platform.reduced_frequency": np.array([*REGULAR, CHAOTIC])})
    return lyapunov_spectrum(scenes, **LONG)


@pytest.mark.slow
def test_exponents_of_orbits_are_the_logarithms_of_their_multipliers(found):
    assert found.verdicts.names()[:3] == ["(1,1)"] * 3
    for lane, reduced in enumerate(REGULAR):
        orbits = afm.single_impact_orbits(law_scene(reduced), 1)
        slot = int(np.argmax(np.asarray(orbits.stable & orbits.admissible)))
        multipliers = np.roots([1.0, -float(orbits.trace[slot]), float(orbits.determinant[slot])])
        wanted = np.sort(np.log(np.abs(multipliers)))[::-1]
        np.testing.assert_allclose(found.exponents_per_impact[lane], wanted, rtol=0, atol=1e-8)
        period = float(law_scene(reduced).platform.period_us)
        np.testing.assert_allclose(found.exponents_per_us[lane], wanted / period, rtol=0, atol=1e-8)
        # undamped, without adhesion: the determinant is r^2
        assert found.exponents_per_impact[lane].sum() == pytest.approx(2.0 * np.log(0.8), abs=1e-10)


@pytest.mark.slow
def test_the_larger_exponent_is_the_growth_of_neighbouring_motions(found):
    (larger, smaller), error = found.exponents_per_impact[-1], found.exponents_per_impact_error[-1, 0]
    assert larger > 10.0 * error
    # pairs of close tips: how far they part from the third impact to the tenth, and not where one of them grazes
    scene, lanes = law_scene(CHAOTIC), 1000
    time = float(scene.platform.period_us) * (0.5 + np.arange(lanes) / (2.0 * lanes))
    top = float(scene.platform.top_speed_nm_per_us)
    rows = afm.iterate_batch(scene, time, np.asarray(scene.platform.velocity(time)) + top, 100)
    time, velocity = (np.asarray(part[:, -1]) for part in (rows.time_us, rows.velocity_after_nm_per_us))
    one, other = (afm.iterate_batch(scene, time, velocity + by, 10) for by in (0.0, 1e-7))
    grown = growth(scene, one.time_us, other.time_us, one.velocity_after_nm_per_us, other.velocity_after_nm_per_us)
    grown = grown[np.isfinite(grown)]
    assert len(grown) > lanes // 4
    spread = np.std(grown) / np.sqrt(len(grown))
    assert abs(larger - np.mean(grown)) < 4.0 * np.hypot(error, spread) + 0.02
    # the speeds' ratios of many flights cancel but for the ends: 2 ln r is left
    assert larger + smaller == pytest.approx(2.0 * np.log(0.8), abs=5e-3)


@pytest.mark.slow
def test_a_tip_that_rests_is_followed_like_a_simulation_and_forgets_its_start():
    scene = law_scene(RESTING, r=0.5)
    scenes, tips = batch_and_tips(scene, default_start(scene))
    record = Record(*(np.asarray(part).T for part in recorded(scenes, tips, impacts=120)[1]))
    assert record.rested.any()
    motion = afm.simulate(scene, default_start(scene), 600.0, max_contacts=200)
    # the tips have landed once already
    arrivals = np.asarray(motion.contacts.arrival_time_us)[1:101]
    found = (record.arrival_periods * float(scene.platform.period_us) + record.arrival_us)[0, :100]
    # rests are summed up to 1e-5 of their length
    np.testing.assert_allclose(found, arrivals, rtol=0, atol=1e-6)
    exponents = lyapunov_spectrum(scenes, **LONG)
    assert np.all(np.isneginf(exponents.exponents_per_impact))
    assert exponents.rested[0] > 0
    assert "forgets its start" in exponent_verdicts(exponents)[0]


@pytest.mark.slow
@pytest.mark.long
def test_the_contact_is_chaotic_at_high_frequency():
    scene = afm.Scene(afm.Cantilever(90.0, 40.0), afm.Platform(4.0, 180.0 * 5.277), afm.Contact.paper())
    # chaos lasts some hundred contacts here; rounding decides which tips have come to an orbit by then
    starts = [start_of(scene, (270.0, 5.0, speed)) for speed in np.arange(36.0, 56.0, 4.0)]
    spectra = [lyapunov_spectrum(scene, start, impacts=200, transient=40, accuracy=1e-6) for start in starts]
    certain = [found.exponents_per_impact[0] / found.exponents_per_impact_error[0] for found in spectra]
    start, found = starts[int(np.argmax(certain))], spectra[int(np.argmax(certain))]
    larger, error = found.exponents_per_impact[0], found.exponents_per_impact_error[0]
    assert larger > 5.0 * error
    # pairs of close tips, simulated: how far they part from the third contact to the tenth
    lanes, few = 10, 24
    scenes, tips = batch_and_tips(scene, start)
    _, record = tips_after_contacts(scenes, tips, skip=40, record=few * lanes, accuracy=1e-6)
    time, velocity = record.departure_us[0, ::lanes], record.velocity_after_nm_per_us[0, ::lanes]

    def contacts(time, velocity):
        begin = State(time, scene.platform.position(time) + scene.interaction.bridge_breaks_nm, velocity)
        found = afm.simulate(scene, begin, 40.0 * lanes, max_contacts=lanes, accuracy=1e-9).contacts
        return found.departure_time_us, found.departure_velocity_nm_per_us

    flown = jax.jit(jax.vmap(contacts))
    (one, slow), (other, fast) = flown(time, velocity), flown(time, velocity + 1e-6)
    grown = growth(scene, one, other, slow, fast)
    assert np.isfinite(grown).all()
    assert np.mean(grown) == pytest.approx(larger, abs=4.0 * np.hypot(error, np.std(grown) / np.sqrt(few)))


@pytest.mark.slow
def test_the_command_tells_null_where_there_is_no_exponent(tmp_path):
    file = tmp_path / "scene.toml"
    afm.save_scene(law_scene(RESTING, r=0.5), file)
    run = CliRunner().invoke(main, ["lyapunov", str(file), "--json", *OPTIONS])
    told = json.loads(run.stdout)
    assert told["exponents_per_us"] == told["exponents_per_impact"] == [None, None]
    assert "forgets" in told["verdict"]
    assert {"impacts", "exponents_per_us_error", "exponents_per_impact_error"} <= set(told)
