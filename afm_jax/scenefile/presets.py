"""The paper's scenes by name, and with what its figures vary as arguments (they can be batched by `vmap`).

Gives scenes: kHz, nm, ng, nm^2/us^2 (eqs. 2 and 6; section IV: eqs. 10 to 16).

The reduced frequency is n = omega/2 Omega; the free frequency is 90 kHz throughout. Sections II and III leave air
damping out; section IV, with the resolved contact, has Q = 40. Figures 4 to 7 show the contact alone,
`Contact.paper()`. `load_scene` makes one scene of a name.
"""

from collections.abc import Callable
from functools import partial

from jaxtyping import ArrayLike

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.checks import as_argument
from afm_jax.impact.law import ImpactLaw
from afm_jax.scenefile.tables import Start

FREE_FREQUENCY_KHZ = 90.0


def law_scene(
    reduced_frequency: ArrayLike,
    drive_amplitude_nm: ArrayLike,
    offset_nm: ArrayLike = -1.0,
    r: ArrayLike = 0.5,
    epsilon: ArrayLike = 0.0,
) -> Scene:
    """Return a scene of sections II and III: a law, 90 kHz, no air damping; a point of figure 2 by its first two.

    Args:
        reduced_frequency: n = omega/2 Omega.
        drive_amplitude_nm: beta.
        offset_nm: sigma.
        r: coefficient of restitution.
        epsilon: adhesion in nm^2/us^2 = uJ/kg; 1 in figures 3 and 9.
    """
    drive = 2.0 * FREE_FREQUENCY_KHZ * as_argument(reduced_frequency)
    platform = Platform(drive_amplitude_nm, drive, offset_nm)
    return Scene(Cantilever(FREE_FREQUENCY_KHZ), platform, ImpactLaw(r, epsilon))


def contact_scene(
    reduced_frequency: ArrayLike,
    drive_amplitude_nm: ArrayLike,
    offset_nm: ArrayLike,
    offset_rate_nm_per_us: ArrayLike = 0.0,
    *,
    dry: bool = False,
) -> Scene:
    """Return a scene of section IV: the paper's contact, 90 kHz, Q = 40, 1 ng.

    Args:
        reduced_frequency: n = omega/2 Omega.
        drive_amplitude_nm: beta.
        offset_nm: sigma at time 0.
        offset_rate_nm_per_us: how fast sigma changes, in nm/us.
        dry: a dry contact in place of the liquid bridge and the JKR junction.
    """
    # only here, so that files of scenes with a law do without the contact's modules
    from afm_jax.contact.contact import Contact  # noqa: PLC0415

    drive = 2.0 * FREE_FREQUENCY_KHZ * as_argument(reduced_frequency)
    platform = Platform(drive_amplitude_nm, drive, offset_nm, offset_rate_nm_per_us)
    contact = Contact.of(("van_der_waals", "dmt")) if dry else Contact.paper()
    return Scene(Cantilever(FREE_FREQUENCY_KHZ, 40.0, 1.0), platform, contact)


_RAMP_NM_PER_US = 1e-3
"""How fast the presets of figures 10 and 11 raise the offset: 0.14 nm while a free vibration decays by 1/e. The paper
does not say how slow its change was."""

PRESETS: dict[str, Callable[[], Scene]] = {
    # of a chart the point n = 1, drive amplitude 2 nm
    "figure2": partial(law_scene, 1.0, 2.0),
    "figure3": partial(law_scene, 1.0, 2.0, epsilon=1.0),
    # The paper's strange attractor. Followed longer, it is transient chaos: from all twelve starts of the notebook on
    # the paper's figures (drive phase 270 degrees, 5 nm above the platform, upward at 40 to 110 nm/us) the motion locks
    # to the (1,5) orbit in the end, after some tens to a thousand broadband impacts. After how many is a matter of
    # rounding, and so of the machine; while it lasts, small distances grow by an exponent of about 0.8 an impact.
    "figure8": partial(contact_scene, 5.277, 4.0, 0.0),
    # just below and just above resonance
    "figure9a": partial(law_scene, 0.97, 0.75, 0.0, 0.9, 1.0),
    "figure9b": partial(law_scene, 1.03, 0.75, 0.0, 0.9, 1.0),
    # below resonance; the offset rises from -0.5 nm, to the paper's 5 nm in 5500 us
    "figure10": partial(contact_scene, 0.97, 2.0, -0.5, _RAMP_NM_PER_US),
    # above resonance; the offset rises from -2 nm, to 2 nm in 4000 us
    "figure11": partial(contact_scene, 1.01, 4.0, -2.0, _RAMP_NM_PER_US),
    # figure 10 at offset 0, with van der Waals forces and a DMT junction
    "dry": partial(contact_scene, 0.97, 2.0, 0.0, dry=True),
}
"""The paper's scenes by their names; they are made when they are asked for."""

STARTS = {"figure8": Start(phase_deg=270.0, height_above_platform_nm=5.0, velocity_nm_per_us=80.0)}
"""The starts of those that have one."""
