"""The paper's scenes, with what each figure varies as arguments. They can be batched: `eqx.filter_vmap(figure2_scene)`.

The reduced frequency is n = omega/2 Omega; the free frequency is 90 kHz throughout. Sections II and III leave air
damping out; section IV, with the resolved contact, has Q = 40. Figures 4 to 7 show the contact alone,
`Contact.paper()`. `preset` makes one scene of a name, for the command line.
"""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from jaxtyping import Array, ArrayLike, Float

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.checks import as_argument
from afm_jax.impact.law import ImpactLaw
from afm_jax.scenefile.scenefile import SceneAsRead, Start, read_scene

FREE_FREQUENCY_KHZ = 90.0
STABILITY_R = 0.5
STABILITY_OFFSET_NM = -1.0
ADHESION = 1.0
"""Epsilon of figures 3 and 9 in nm^2/us^2 = uJ/kg."""
OFFSET_SWEEP_AMPLITUDE_NM = 0.75
"""Drive amplitude of figure 9."""
OFFSET_SWEEP_BELOW, OFFSET_SWEEP_ABOVE = 0.97, 1.03
"""Reduced frequencies of figures 9a and 9b: just below and just above the first resonance."""

QUALITY_FACTOR = 40.0
"""Of the cantilever in figures 8, 10 and 11."""
RAMP_NM_PER_US = 1e-3
"""How fast the presets of figures 10 and 11 raise the offset: 0.14 nm while a free vibration decays by 1/e. The paper
does not say how slow its change was."""


def stability_scene(
    reduced_frequency: ArrayLike, drive_amplitude_nm: ArrayLike, offset_nm: ArrayLike, epsilon: ArrayLike
) -> Scene:
    """Return a scene of the stability charts: r = 0.5, no air damping.

    Args:
        reduced_frequency: n = omega/2 Omega.
        drive_amplitude_nm: beta.
        offset_nm: sigma.
        epsilon: adhesion in nm^2/us^2.
    """
    platform = Platform(drive_amplitude_nm, drive_frequency_khz(reduced_frequency), offset_nm)
    return Scene(Cantilever(FREE_FREQUENCY_KHZ), platform, ImpactLaw(STABILITY_R, epsilon))


def figure2_scene(reduced_frequency: ArrayLike, drive_amplitude_nm: ArrayLike) -> Scene:
    """Return a point of figure 2: sigma = -1 nm, no adhesion."""
    return stability_scene(reduced_frequency, drive_amplitude_nm, STABILITY_OFFSET_NM, 0.0)


def figure3_scene(reduced_frequency: ArrayLike, drive_amplitude_nm: ArrayLike) -> Scene:
    """Return a point of figure 3: figure 2 with adhesion."""
    return stability_scene(reduced_frequency, drive_amplitude_nm, STABILITY_OFFSET_NM, ADHESION)


def figure9_scene(reduced_frequency: ArrayLike, offset_nm: ArrayLike, r: ArrayLike) -> Scene:
    """Return a point of figure 9: beta = 0.75 nm, with adhesion, no air damping.

    Args:
        reduced_frequency: 0.97 in figure 9a, 1.03 in figure 9b.
        offset_nm: sigma.
        r: coefficient of restitution.
    """
    platform = Platform(OFFSET_SWEEP_AMPLITUDE_NM, drive_frequency_khz(reduced_frequency), offset_nm)
    return Scene(Cantilever(FREE_FREQUENCY_KHZ), platform, ImpactLaw(r, ADHESION))


def figure8_scene() -> Scene:
    """Return the scene of figure 8: n = 5.277, beta = 4 nm, sigma = 0; the paper's strange attractor.

    Followed longer, it is transient chaos: from all twelve starts of the notebook on the paper's figures (drive phase
    270 degrees, 5 nm above the platform, upward at 40 to 110 nm/us) the motion locks to the (1,5) orbit in the end,
    after some tens to a thousand broadband impacts. After how many is a matter of rounding, and so of the machine;
    while it lasts, small distances grow by an exponent of about 0.8 an impact.
    """
    return contact_scene(reduced_frequency=5.277, drive_amplitude_nm=4.0, offset_nm=0.0)


def figure8_start(velocity_nm_per_us: float = 80.0) -> Start:
    """Return a start of figure 8: drive phase 270 degrees, 5 nm above the platform, upward at a velocity in nm/us."""
    return Start(phase_deg=270.0, height_above_platform_nm=5.0, velocity_nm_per_us=velocity_nm_per_us)


def figure10_scene(offset_nm: ArrayLike = -0.5, offset_rate_nm_per_us: ArrayLike = 0.0) -> Scene:
    """Return the scene of figure 10, below resonance: n = 0.97, beta = 2 nm, the paper's offsets -0.5 to 5 nm."""
    return contact_scene(0.97, 2.0, offset_nm, offset_rate_nm_per_us)


def figure11_scene(offset_nm: ArrayLike = -2.0, offset_rate_nm_per_us: ArrayLike = 0.0) -> Scene:
    """Return the scene of figure 11, above resonance: n = 1.01, beta = 4 nm, offsets -2 to 2 nm."""
    return contact_scene(1.01, 4.0, offset_nm, offset_rate_nm_per_us)


def contact_scene(
    reduced_frequency: ArrayLike,
    drive_amplitude_nm: ArrayLike,
    offset_nm: ArrayLike,
    offset_rate_nm_per_us: ArrayLike = 0.0,
) -> Scene:
    """Return a scene of section IV: the paper's contact, 90 kHz, Q = 40, 1 ng.

    Args:
        reduced_frequency: n = omega/2 Omega.
        drive_amplitude_nm: beta.
        offset_nm: sigma at time 0.
        offset_rate_nm_per_us: how fast sigma changes, in nm/us.
    """
    drive = drive_frequency_khz(reduced_frequency)
    platform = Platform(drive_amplitude_nm, drive, offset_nm, offset_rate_nm_per_us)
    # only here, so that files of scenes with a law do without the contact's modules
    from afm_jax.contact.contact import Contact  # noqa: PLC0415

    return Scene(Cantilever(FREE_FREQUENCY_KHZ, QUALITY_FACTOR, 1.0), platform, Contact.paper())


def dry_scene() -> Scene:
    """Return figure 10's scene at offset 0 with a dry contact in place of the liquid bridge and the JKR junction."""
    scene = contact_scene(0.97, 2.0, 0.0)
    from afm_jax.contact.contact import Contact  # noqa: PLC0415 (as above)

    return Scene(scene.cantilever, scene.platform, Contact.of(("van_der_waals", "dmt")))


def drive_frequency_khz(reduced_frequency: ArrayLike) -> Float[Array, "..."]:
    """Return the drive frequency 2 n Omega / 2 pi of a reduced frequency n."""
    return 2.0 * FREE_FREQUENCY_KHZ * as_argument(reduced_frequency)


class _Preset(NamedTuple):
    sentence: str
    scene: Callable[[], Scene]
    start: Start | None = None


_PRESETS = {
    "figure2": _Preset(
        "Impact law, r = 0.5, offset -1 nm; of figure 2's chart the point n = 1, drive amplitude 2 nm.",
        lambda: figure2_scene(1.0, 2.0),
    ),
    "figure3": _Preset(
        "Figure 2's point with adhesion, epsilon = 1 nm^2/us^2.",
        lambda: figure3_scene(1.0, 2.0),
    ),
    "figure8": _Preset(
        "Contact, n = 5.277, drive amplitude 4 nm, offset 0: the paper's strange attractor, a long chaotic transient.",
        figure8_scene,
        figure8_start(),
    ),
    "figure9a": _Preset(
        "Impact law with adhesion just below resonance, n = 0.97, drive amplitude 0.75 nm; r = 0.9, offset 0.",
        lambda: figure9_scene(OFFSET_SWEEP_BELOW, 0.0, 0.9),
    ),
    "figure9b": _Preset(
        "Impact law with adhesion just above resonance, n = 1.03, drive amplitude 0.75 nm; r = 0.9, offset 0.",
        lambda: figure9_scene(OFFSET_SWEEP_ABOVE, 0.0, 0.9),
    ),
    "figure10": _Preset(
        "Contact below resonance, n = 0.97, drive amplitude 2 nm; the offset rises from -0.5 nm, to 5 nm in 5500 us.",
        lambda: figure10_scene(offset_rate_nm_per_us=RAMP_NM_PER_US),
    ),
    "figure11": _Preset(
        "Contact above resonance, n = 1.01, drive amplitude 4 nm; the offset rises from -2 nm, to 2 nm in 4000 us.",
        lambda: figure11_scene(offset_rate_nm_per_us=RAMP_NM_PER_US),
    ),
    "dry": _Preset(
        "Dry contact (van der Waals, DMT) below resonance, n = 0.97, drive amplitude 2 nm, offset 0.",
        dry_scene,
    ),
}

PRESETS = {name: kind.sentence for name, kind in _PRESETS.items()}
"""The names that `preset` knows, with a sentence on each."""


def preset(name: str) -> Scene:
    """Return a scene of the paper by its name.

    Args:
        name: one of `PRESETS`.

    Raises:
        ValueError: if there is no such preset.
    """
    if name not in _PRESETS:
        raise ValueError(f"there is no preset {name!r}; choose from {', '.join(_PRESETS)}")
    return _PRESETS[name].scene()


def read_named_scene(name: str) -> SceneAsRead:
    """Return the scene that a path or a name means, its start, and what a reader should know of the file.

    Args:
        name: a path, or a name of `PRESETS` where there is no file of that name.

    Raises:
        ValueError: if there is neither such a file nor such a preset, or the file is no valid scene file.
    """
    if Path(name).exists() or name.endswith(".toml") or len(Path(name).parts) > 1:
        return read_scene(name)
    if name not in _PRESETS:
        raise ValueError(f"{name}: there is no such file or preset; presets are {', '.join(PRESETS)}")
    return SceneAsRead(preset(name), _PRESETS[name].start, ())
