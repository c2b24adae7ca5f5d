"""Scene files with drives of base and tip and second frequencies: exact loops, and one line for every mistake."""

import tomllib
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from afm_jax import Cantilever, Contact, ImpactLaw, Platform, Scene, SceneError, load_scene, save_scene
from afm_jax.apparatus.drives import BaseDrive, ForceDrive, Tone

CANTILEVER = "[cantilever]\nfrequency_khz = 90\nquality_factor = 40\n"
PLATFORM = "[platform]\namplitude_nm = 4\nfrequency_khz = 181.8\n"
RESTING = "[platform]\noffset_nm = 7\n"
SECOND = "[platform.second]\namplitude_nm = 1.5\nfrequency_khz = 33\nphase_deg = -20\n"
BASE = "[base]\namplitude_nm = 0.25\nfrequency_khz = 88\nphase_deg = 30\n"
BASE_SECOND = "[base.second]\namplitude_nm = 0.5\nreduced_frequency = 2\n"
FORCE = "[force]\namplitude_nn = 0.75\nreduced_frequency = 0.5\n"
FORCE_SECOND = "[force.second]\namplitude_nn = 0.125\nfrequency_khz = 450\nphase_deg = 90\n"
LAW = '[interaction]\nmodel = "law"\nr = 0.9\n'
NONE = '[interaction]\nmodel = "none"\n'
FULL = {
    "cantilever": CANTILEVER,
    "platform": PLATFORM,
    "platform.second": SECOND,
    "base": BASE,
    "base.second": BASE_SECOND,
    "force": FORCE,
    "force.second": FORCE_SECOND,
    "interaction": NONE,
}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "scene.toml"


def loaded(path: Path, *parts: str) -> Scene:
    path.write_text("".join(parts), encoding="utf-8")
    return load_scene(path)


def complaint(path: Path, *parts: str) -> str:
    """Return the one line that loading a text ends with, without the file's name."""
    with pytest.raises(SceneError) as caught:
        loaded(path, *parts)
    line = str(caught.value)
    assert line.isprintable()
    return line.removeprefix(f"{path}: ")


def test_reads_every_key(path: Path):
    scene = Scene(
        Cantilever(90.0, 40.0),
        Platform(4.0, 181.8, second=Tone(1.5, 33.0, -20.0)),
        None,
        BaseDrive(0.25, 88.0, 30.0, Tone(0.5, 360.0)),
        ForceDrive(0.75, 90.0, 0.0, Tone(0.125, 450.0, 90.0)),
    )
    assert eqx.tree_equal(loaded(path, *FULL.values()), scene)


@pytest.mark.parametrize("name", ["platform.second", "base.second", "force.second", "force"])
def test_what_is_left_out_is_absent(path: Path, name: str):
    scene = loaded(path, *(text for table, text in FULL.items() if not table.startswith(name)))
    outer = name.partition(".")[0]
    part = getattr(scene, outer)
    assert (part is None) if name == outer else (part.second is None)
    assert len(jax.tree.leaves(scene)) < len(jax.tree.leaves(loaded(path, *FULL.values())))


@pytest.mark.parametrize("drive", [BASE, FORCE])
@pytest.mark.parametrize("interaction", [NONE, LAW, '[interaction]\nmodel = "contact"\n'])
def test_a_platform_under_another_drive_may_rest(path: Path, drive: str, interaction: str):
    scene = loaded(path, CANTILEVER, RESTING, drive, interaction)
    frequency = 88.0 if drive == BASE else 90.0
    assert eqx.tree_equal(scene.platform, Platform(0.0, frequency, 7.0))
    for text in ("amplitude_nm = 0\n", "amplitude_nm = 0.0\nfrequency_khz = 10\n", "frequency_khz = 10\n"):
        platform = loaded(path, CANTILEVER, RESTING, text, drive, interaction).platform
        own = "frequency" in text
        assert eqx.tree_equal(platform, Platform(0.0, 10.0 if own else frequency, 7.0))
    save_scene(scene, path)
    assert eqx.tree_equal(load_scene(path), scene)


def test_a_base_comes_before_a_force(path: Path):
    assert float(loaded(path, CANTILEVER, RESTING, FORCE, BASE, NONE).platform.frequency_khz) == 88.0


positive = st.floats(min_value=1e-30, max_value=1e30)
# no drive is more than 1e4 times as fast as the tip
frequencies = st.floats(min_value=1e-3, max_value=10.0)
finite = st.floats(min_value=-1e30, max_value=1e30)
not_negative = st.floats(min_value=0.0, max_value=1e30)
tones = st.none() | st.builds(Tone, not_negative, frequencies, finite)


def different(drive: Any) -> bool:
    if drive is None or drive.second is None:
        return True
    return not np.isclose(float(drive.frequency_khz), float(drive.second.frequency_khz), rtol=1e-9, atol=0.0)


@given(
    platform=st.builds(Platform, not_negative, frequencies, finite, finite, tones),
    base=st.none() | st.builds(BaseDrive, not_negative, frequencies, finite, tones),
    force=st.none() | st.builds(ForceDrive, not_negative, frequencies, finite, tones),
    interaction=st.sampled_from([None, ImpactLaw(0.7, 1.1)]),
)
def test_loop_is_exact(platform: Any, base: Any, force: Any, interaction: Any, tmp_path_factory: Any):
    assume(all(different(drive) for drive in (platform, base, force)))
    path = tmp_path_factory.getbasetemp() / "drives.toml"
    scene = Scene(Cantilever(90.0, 40.0), platform, interaction, base, force)
    save_scene(scene, path)
    assert eqx.tree_equal(load_scene(path), scene)


def test_loop_is_exact_with_a_contact_and_in_32_bits(path: Path):
    for contact in (Contact.paper(), None):
        scene = Scene(
            Cantilever(90.0), Platform(0.1, 33.3), contact, BaseDrive(0.1, 88.8, 0.3), ForceDrive(0.7, 1.1, 2.2)
        )
        save_scene(scene, path)
        assert eqx.tree_equal(load_scene(path), scene)
    with jax.enable_x64(False):  # noqa: FBT003
        scene = Scene(Cantilever(90.0), Platform(0.1, 33.3, second=Tone(0.1, 0.3)), force=ForceDrive(0.7, 1.1, 2.2))
        save_scene(scene, path)
        assert eqx.tree_equal(load_scene(path), scene)


def test_saved_file_has_the_keys_of_the_format(path: Path):
    save_scene(loaded(path, *FULL.values()), path)
    rows = tomllib.loads(path.read_text("utf-8"))
    assert list(rows) == ["cantilever", "platform", "base", "force", "interaction"]
    assert rows["interaction"] == {"model": "none"}
    assert rows["platform"]["second"] == {"amplitude_nm": 1.5, "frequency_khz": 33.0, "phase_deg": -20.0}
    assert rows["force"] == {
        "amplitude_nn": 0.75,
        "frequency_khz": 90.0,
        "phase_deg": 0.0,
        "second": {"amplitude_nn": 0.125, "frequency_khz": 450.0, "phase_deg": 90.0},
    }


WRONG_LINES = [
    ("platform", "phase_deg = 1", "phase_deg: unknown key; it belongs in [base] or [force] or [start]"),
    ("platform", "amplitude_nn = 1", "amplitude_nn: unknown key; use amplitude_nm"),
    ("platform.second", "offset_nm = 1", "offset_nm: unknown key; it belongs in [platform] or [interaction.delay]"),
    ("platform.second", "reduced_frequency = 3", "has both frequency_khz and reduced_frequency; give one of them"),
    ("base", "amplitude_nn = 1", "amplitude_nn: unknown key; use amplitude_nm"),
    ("base", "phase = 1", "phase: the unit is missing; use phase_deg"),
    ("base", "phase_rad = 1", "phase_rad: unknown key; use phase_deg"),
    ("base", "offset_nm = 1", "offset_nm: unknown key; it belongs in [platform] or [interaction.delay]"),
    ("base", "reduced_frequency = 1", "has both frequency_khz and reduced_frequency; give one of them"),
    ("base.second", "second = 1", "second: unknown key; it belongs in [platform] or [base] or [force]"),
    ("force", "amplitude_nm = 1", "amplitude_nm: unknown key; use amplitude_nn"),
    ("force", "amplitude_pn = 1", "amplitude_pn: unknown key; use amplitude_nn"),
    ("force.second", "frequency_hz = 1", "frequency_hz: unknown key; use frequency_khz"),
    ("interaction", "r = 1", 'r: unknown key of a free cantilever; it belongs to model = "law"'),
    ("interaction", "viscosity_pa_s = 1", 'viscosity_pa_s: unknown key of a free cantilever; it belongs to model = "c'),
    ("interaction", "delay = {}", 'delay: unknown key of a free cantilever; it belongs to model = "law"'),
]


@pytest.mark.parametrize(("table", "line", "expected"), WRONG_LINES)
def test_a_wrong_line_is_named(path: Path, table: str, line: str, expected: str):
    parts = [text + (f"{line}\n" if name == table else "") for name, text in FULL.items()]
    assert complaint(path, *parts).startswith(f"[{table}] {expected}")


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("= 0.25", "= -0.25", "[base] `amplitude_nm` must not be negative, but is -0.25"),
        ("= 0.25", "= nan", "[base] `amplitude_nm` must not be negative, but is nan"),
        ("= 88", "= 0", "[base] `frequency_khz` must be positive, but is 0"),
        ("= 30", "= inf", "[base] `phase_deg` must be a finite number, but is inf"),
        ("amplitude_nm = 0.25\n", "", "[base] amplitude_nm: missing; add it"),
        ("frequency_khz = 88\n", "", "[base] the drive frequency is missing; add frequency_khz or reduced_frequency"),
        ("= 88", '= "88"', "[base] frequency_khz: must be a number, but is the text '88'; leave out the quotes"),
        ("reduced_frequency = 2", "reduced_frequency = 0", "[base.second] `reduced_frequency` must be positive, but"),
        ("reduced_frequency = 2", "frequency_khz = 88", "[base.second] has the frequency of [base]; add the two up to"),
        (
            "= 33",
            "= 181.8",
            "[platform.second] has the frequency of [platform]; add the two up to one cosine and leave",
        ),
        ("= 450", "= 90.00000000000001", "[force.second] has the frequency of [force]; add the two up to one cosine"),
        ("= 1.5", "= -1.5", "[platform.second] `amplitude_nm` must not be negative, but is -1.5"),
        ("= -20", "= nan", "[platform.second] `phase_deg` must be a finite number, but is nan"),
        ("amplitude_nn = 0.125\n", "", "[force.second] amplitude_nn: missing; add it"),
        ("= 0.125", "= inf", "[force.second] `amplitude_nn` must not be negative, but is inf"),
        ("amplitude_nm = 4\n", "", "[platform] amplitude_nm: missing; add it"),
        ("frequency_khz = 181.8\n", "", "[platform] the drive frequency is missing; add frequency_khz or reduced"),
        (SECOND, "second = 3\n", "platform.second must be a table, [platform.second], but is a number"),
        (FORCE + FORCE_SECOND, "[[force]]\n", "force must be a table, [force], but is a list"),
        (FORCE, "", "[force] amplitude_nn: missing; add it"),
        ("[base]", "[bsae]", "bsae: unknown table; use [base]"),
        ("[platform.second]", "[second]", "second: unknown table; use [platform.second] or [base.second] or [force.s"),
        ("[interaction]", "[start]\nphase_rad = 1\n[interaction]", "[start] phase_rad: unknown key; use phase_deg"),
        ('"none"', '"free"', '[interaction] model: must be "law" or "contact", or "none" for a free cantilever'),
        ("quality_factor = 40", "quality_factor = 0", "[cantilever] `quality_factor` must be above 0.5, but is 0"),
        ("quality_factor = 40", "mass_ng = -1", "[cantilever] `mass_ng` must be positive, but is -1"),
        (
            "quality_factor = 40",
            "",
            "[force] `force` drives an undamped cantilever at its free frequency, where the vibration grows",
        ),
    ],
)
def test_a_wrong_scene_is_named(path: Path, old: str, new: str, expected: str):
    text = "".join(FULL.values())
    assert text.count(old) == 1
    assert complaint(path, text.replace(old, new)).startswith(expected)


@pytest.mark.parametrize("ratio", [0.5, 0.515])
def test_a_drive_is_as_strong_as_the_free_tips_amplitude_says(path: Path, ratio: float):
    # z = a/(k gamma), gamma = 1 - s^2 + i s/Q, of a force a; of a base a/gamma
    size = 40.0 * abs(1.0 - (2.0 * ratio) ** 2 + 2.0j * ratio / 40.0)
    lines = f"free_amplitude_nm = 40\nreduced_frequency = {ratio}\n"
    of_base = loaded(path, CANTILEVER, RESTING, "[base]\n", lines, LAW).base
    of_force = loaded(path, CANTILEVER, RESTING, "[force]\n", lines, LAW).force
    assert of_base is not None
    assert of_force is not None
    assert float(of_base.amplitude_nm) == pytest.approx(size, rel=1e-12)
    assert float(of_force.amplitude_nn) == pytest.approx(size * (2e-3 * np.pi * 90.0) ** 2, rel=1e-12)


@pytest.mark.parametrize(
    ("lines", "expected"),
    [
        ("free_amplitude_nm = 40\namplitude_nn = 1", "[force] has both amplitude_nn and free_amplitude_nm; give one"),
        ("free_amplitude_nm = -1", "[force] `free_amplitude_nm` must not be negative, but is -1"),
        ("free_amplitude = 1", "[force] free_amplitude: the unit is missing; use free_amplitude_nm"),
    ],
)
def test_a_wrong_free_amplitude_is_named(path: Path, lines: str, expected: str):
    force = f"[force]\nfrequency_khz = 90\n{lines}\n"
    assert complaint(path, CANTILEVER, RESTING, force, LAW).startswith(expected)


def test_an_undamped_tip_has_no_free_amplitude_at_its_free_frequency(path: Path):
    text = "[cantilever]\nfrequency_khz = 90\n", RESTING, "[force]\nfrequency_khz = 90\nfree_amplitude_nm = 4\n", LAW
    assert complaint(path, *text).startswith("[force] `force` drives an undamped cantilever at its free frequency")


def test_a_platform_that_alone_drives_must_say_how(path: Path):
    assert complaint(path, CANTILEVER, RESTING, LAW) == "[platform] amplitude_nm: missing; add it"
    expected = "[platform] the drive frequency is missing; add frequency_khz or reduced_frequency"
    assert complaint(path, CANTILEVER, RESTING, "amplitude_nm = 0\n", LAW) == expected
    assert complaint(path, CANTILEVER, RESTING, "amplitude_nm = 1e-9\n", BASE, LAW) == expected


@pytest.mark.parametrize(
    ("scene", "said"),
    [
        (
            Scene(Cantilever(90.0), Platform(1.0, 50.0, second=Tone(1.0, 50.0, 90.0))),
            "the second frequency of `platform` is that of the first: add the two up to one cosine",
        ),
        (
            Scene(Cantilever(90.0), Platform(1.0, 50.0), base=BaseDrive(1.0, 90.0)),
            "`base` drives an undamped cantilever",
        ),
        (
            Scene(Cantilever(90.0), Platform(1.0, 50.0), base=BaseDrive(np.array([1.0, 2.0]), 91.0)),
            r"`amplitude_nm` has shape \(2,\), but a scene file holds one scene",
        ),
        (
            Scene(
                Cantilever(90.0),
                Platform(1.0, 50.0),
                force=ForceDrive(1.0, 1.0, 0.0, Tone(jnp.array([1.0, 2.0]), 91.0)),
            ),
            r"`amplitude_nn` has shape \(2,\), but a scene file holds one scene",
        ),
    ],
)
def test_what_cannot_be_loaded_is_not_saved(path: Path, scene: Scene, said: str):
    with pytest.raises(ValueError, match=said):
        save_scene(scene, path)
    assert not path.exists()
