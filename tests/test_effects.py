"""`afm-jax effects`: on scenes where it is known what an effect changes."""

from typing import Any

import numpy as np
import pytest

from afm_jax import Cantilever, CollisionDelay, Contact, ImpactLaw, Platform, Scene, save_scene
from afm_jax.apparatus.drives import BaseDrive, ForceDrive
from afm_jax.impact.orbits import single_impact_orbits
from afm_jax.motion.start import start_of
from afm_jax.scenefile.scenefile import read_scene
from afm_jax.studies.effects import Change, effects_in, study_effects
from tests.answers import answer, table

PLAIN_DELAY, LASTING_DELAY = (CollisionDelay(0.206, 5.64, 0.726, corrections=lasts) for lasts in (False, True))
LAW = ImpactLaw(0.998, 100.0, 0.1, LASTING_DELAY)
WITHOUT = {
    "restitution": ImpactLaw(1.0, 100.0, 0.1, LASTING_DELAY),
    "adhesion": ImpactLaw(0.998, 0.0, 0.1, LASTING_DELAY),
    "viscous_loss": ImpactLaw(0.998, 100.0, 0.0, LASTING_DELAY),
    "delay": ImpactLaw(0.998, 100.0, 0.1),
    "delay_corrections": ImpactLaw(0.998, 100.0, 0.1, PLAIN_DELAY),
}
ACCURACY = 0.0205
DRIVE = Platform(4.0, 181.8)


def law_scene(law: ImpactLaw = LAW, quality_factor: float | None = 40.0) -> Scene:
    return Scene(Cantilever(90.0, quality_factor), DRIVE, law)


def orbit_of(scene: Scene):
    """Return peak, lock-in amplitude and energy per impact of the scene's stable (1,1) orbit, in closed form."""
    orbits = single_impact_orbits(scene, 1.0)
    slot = int(np.argmax(np.asarray(orbits.stable & orbits.admissible)))
    speeds = orbits.approach_speed_nm_per_us[slot], orbits.rebound_speed_nm_per_us[slot]
    energy = 0.5 * float(scene.cantilever.mass_ng) * float(speeds[0] ** 2 - speeds[1] ** 2)
    return np.array([float(orbits.peak_amplitude_nm[slot]), float(orbits.lockin_amplitude_nm[slot]), energy])


def by_name(study) -> dict[str, Any]:
    return {report.name: report for report in study.effects}


def amplitudes(change: Change) -> np.ndarray:
    """Return the changes of peak and lock-in amplitude; NaN for none, which equals nothing."""
    return np.array([change.peak_amplitude, change.lockin_amplitude], dtype=float)


def size_of(change: Change) -> float:
    return float(np.abs(amplitudes(change)).max())


@pytest.fixture(scope="module")
def law_study():
    return study_effects(law_scene(), accuracy=ACCURACY, only=list(WITHOUT))


@pytest.mark.slow
@pytest.mark.parametrize("name", WITHOUT)
def test_leaving_an_effect_of_a_law_out_changes_what_the_closed_form_says(law_study, name):
    change = by_name(law_study)[name].change
    expected = orbit_of(law_scene(WITHOUT[name])) / orbit_of(law_scene()) - 1.0
    # the orbit is closed to 1e-9 of the speed; weakly attracting orbits are then known to some 1e-7
    found = np.array([*amplitudes(change), change.energy_per_impact])
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-7)


@pytest.mark.slow
def test_what_a_law_does_not_need_is_known_from_the_closed_form(law_study):
    reports = by_name(law_study)
    expected = orbit_of(law_study.reduced) / orbit_of(law_scene()) - 1.0
    np.testing.assert_allclose(amplitudes(law_study.joint_change), expected[:2], rtol=1e-5, atol=1e-7)
    assert set(law_study.not_needed) == {"delay_corrections", "viscous_loss", "restitution"}
    assert size_of(law_study.joint_change) < ACCURACY
    # adhesion alone changes 2.01 %, which the accuracy would allow; with the others it does not
    assert size_of(reports["adhesion"].change) < ACCURACY
    # numbers cost nothing, a delay does
    costs = {name: reports[name].time_us_per_period for name in ("restitution", "adhesion", "viscous_loss", "delay")}
    assert [name for name, cost in costs.items() if cost != law_study.full.time_us_per_period] == ["delay"]


@pytest.mark.slow
@pytest.mark.parametrize(("quality_factor", "needed"), [(40.0, True), (1e6, False)])
def test_air_damping_is_needed_near_resonance_unless_there_is_nearly_none(quality_factor, needed):
    # lossy impacts, so that the motion settles without air too
    scene = law_scene(ImpactLaw(0.9, 1.0), quality_factor)
    study = study_effects(scene, accuracy=0.01, only=["air_damping"])
    bare = orbit_of(law_scene(ImpactLaw(0.9, 1.0), None)) / orbit_of(scene) - 1.0
    change = by_name(study)["air_damping"].change
    # as above
    np.testing.assert_allclose(amplitudes(change), bare[:2], rtol=1e-5, atol=1e-7)
    assert ("air_damping" in study.not_needed) is not needed


def test_a_free_cantilever_without_air_at_resonance_has_no_steady_response():
    scene = Scene(Cantilever(90.0, 40.0), Platform(0.0, 90.0, -100.0), None, force=ForceDrive(0.1, 90.0))
    study = study_effects(scene, accuracy=0.01)
    air, drive = (by_name(study)[name] for name in ("air_damping", "force_drive"))
    assert (air.change.peak_amplitude, air.time_us_per_period) == (None, None)
    assert "free frequency" in air.reason
    assert "only drive" in drive.reason
    # F Q/k
    expected = 0.1 * 40.0 / float(scene.cantilever.stiffness_n_per_m)
    np.testing.assert_allclose(study.full.peak_amplitude_nm, expected, rtol=1e-6)
    assert study.not_needed == []


def test_all_effects_are_named():
    platform = Platform(4.0, 181.8)
    base, force = BaseDrive(0.1, 90.0), ForceDrive(0.1, 90.0)
    scene = Scene(Cantilever(90.0, 40.0), platform, Contact.paper(structural_amplitude_n_per_m=0.0), base, force)
    effects = {effect.name: effect for effect in effects_in(scene)}
    assert set(effects) == {
        *("capillary", "structural", "core", "viscous", "jkr", "air_damping"),
        *("base_drive", "force_drive"),
    }
    assert {name for name, effect in effects.items() if effect.required} == {"core", "jkr"}
    assert effects["base_drive"].without(scene).base is None
    assert effects["force_drive"].without(scene).force is None
    assert "capillary" not in effects["capillary"].without(scene).interaction.effects


@pytest.mark.slow
def test_a_force_of_no_strength_is_dropped_and_those_of_the_junction_required():
    scene = Scene(Cantilever(90.0, 40.0), DRIVE, Contact.paper(structural_amplitude_n_per_m=0.0))
    names = ["structural", "core", "jkr"]
    study = study_effects(scene, start_of(scene, (270.0, 5.0, 60.0)), accuracy=0.01, only=names)
    reports = by_name(study)
    # two programs for one motion: rounding, and the accuracy of 1e-9 to which the orbit is closed
    assert size_of(reports["structural"].change) < 1e-7
    assert study.not_needed == ["structural"]
    assert study.reduced.interaction.effects == ("capillary", "core", "viscous", "jkr")
    for time in (reports["structural"].time_us_per_period, study.reduced_time_us_per_period):
        assert time != study.full.time_us_per_period
    for name in ("core", "jkr"):
        assert reports[name].reason.startswith("required: ")
        assert (reports[name].change.of_amplitude, reports[name].time_us_per_period) == (None, None)


@pytest.mark.slow
def test_the_reduced_file_is_as_accurate_as_wanted_and_the_command_writes_what_it_says(tmp_path):
    full = law_scene(WITHOUT["delay_corrections"])
    save_scene(full, tmp_path / "scene.toml")
    options = ("--accuracy", "1 %", "--only", "restitution,viscous_loss,adhesion")
    payload = answer(tmp_path / "out", "effects", tmp_path / "scene.toml", *options)
    assert payload["not_needed"] == ["viscous_loss", "restitution"]
    reduced = read_scene(tmp_path / "out" / "reduced.toml")
    assert float(reduced.scene.interaction.r) == 1.0
    assert 0.0 < np.abs(orbit_of(reduced.scene)[:2] / orbit_of(full)[:2] - 1.0).max() < 0.01
    assert reduced.start is not None
    assert reduced.start._asdict() == payload["start"]
    told = [(each["name"], each["change"]["peak_amplitude"]) for each in payload["effects"]]
    rows = table(tmp_path / "out" / "effects.csv")
    assert [(row["name"], float(row["change_peak_amplitude"])) for row in rows] == told
