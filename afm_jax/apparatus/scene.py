"""A scene: a cantilever, a moving platform, what happens when they meet, and what drives the tip besides.

Takes these parts, checks that they fit together, and gives what all of it repeats by: the drive's period in us.
"""

import math
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import numpy as np

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.drives import SAME_FREQUENCY, BaseDrive, ForceDrive
from afm_jax.apparatus.platform import Platform
from afm_jax.checks import in_a_word, is_traced, readable


class Scene(eqx.Module):
    """A scene to simulate: a cantilever over a sample, what happens when they meet, and what drives them.

    Numbers are traced parameters; which parts there are decides what is compiled.

    Args:
        cantilever: the tip and its spring.
        platform: the moving sample.
        interaction: an `ImpactLaw` or a `TabulatedLaw`, with or without a collision delay, or a `Contact`; None: the
            tip never meets the sample.
        base: a motion of the cantilever's base; None: it rests.
        force: a force on the tip; None: there is none.
    """

    made_of_text: ClassVar[str] = "`afm_jax.load_scene` makes one of the path of a scene file or the name of a preset"

    cantilever: Cantilever
    platform: Platform
    # the modules of the interactions import this one, not the other way round
    interaction: Any = None
    base: BaseDrive | None = None
    force: ForceDrive | None = None

    __repr__ = readable

    def __post_init__(self):
        platform = self.platform
        if isinstance(platform, Platform) and platform.takes_any_frequency:
            frequency = getattr(self.base or self.force or self.cantilever, "frequency_khz", platform.frequency_khz)
            self.platform = eqx.tree_at(lambda part: part.frequency_khz, platform, frequency)
        if hasattr(self.interaction, "for_scene"):
            # of the law of a fit the law alone
            self.interaction = self.interaction.for_scene()

    def __check_init__(self):
        kinds = {"cantilever": Cantilever, "platform": Platform, "base": BaseDrive, "force": ForceDrive}
        for name, kind in kinds.items():
            part = getattr(self, name)
            if not isinstance(part, kind) and not (part is None and name in ("base", "force")):
                article = "" if name in ("cantilever", "platform") else " or None"
                raise TypeError(f"the scene's `{name}` must be a {kind.__name__}{article}, but is {in_a_word(part)}")
        if self.interaction is not None and (
            not isinstance(self.interaction, eqx.Module) or isinstance(self.interaction, tuple(kinds.values()))
        ):
            what = in_a_word(self.interaction)
            raise TypeError(f"the scene's `interaction` must be an ImpactLaw, a Contact or None, but is {what}")
        _check_frequencies(self)
        check_mass(self.interaction, self.cantilever)


_SAME_MASS = 1e-3
"""Relative difference of two masses that are one."""


def check_mass(interaction: Any, cantilever: Cantilever) -> None:
    """Check that a law that was found with a tip of a known mass meets a tip of that mass.

    Args:
        interaction: of a scene; anything but a table of a law with a mass passes.
        cantilever: of the scene.

    Raises:
        ValueError: if not.
    """
    of_law, mass = getattr(interaction, "mass_ng", None), cantilever.mass_ng
    if of_law is None or is_traced(of_law) or is_traced(mass):
        return
    ratio = np.asarray(mass) / np.asarray(of_law)
    if np.any(np.abs(ratio - 1.0) > _SAME_MASS):
        raise ValueError(
            f"the law is that of a tip of {np.asarray(of_law).flat[0]:.6g} ng, but the cantilever's `mass_ng` is "
            f"{np.asarray(mass).flat[0]:.6g}: the energy lost in an impact depends on the mass; give the law's"
        )


LARGEST_FREQUENCY_RATIO = 1e4
"""Of a drive to the cantilever's free frequency: a search for impacts goes through every period of the drive."""


def _check_frequencies(scene: Scene) -> None:
    """Check that nothing drives a scene so fast that the tip cannot be followed.

    Raises:
        ValueError: if something does; says what.
    """
    free = scene.cantilever.frequency_khz
    for name in ("platform", "base", "force"):
        part = getattr(scene, name)
        for place, tone in ((name, part), (f"{name}.second", getattr(part, "second", None))):
            if tone is None or is_traced(free) or is_traced(tone.frequency_khz):
                continue
            ratio = np.max(np.asarray(tone.frequency_khz) / np.asarray(free), initial=0.0)
            if ratio > LARGEST_FREQUENCY_RATIO:
                raise ValueError(
                    f"`{place}.frequency_khz` must be at most {LARGEST_FREQUENCY_RATIO:g} times the cantilever's free "
                    f"frequency, but is {ratio:g} times as high"
                )


def require_one_frequency(scene: Scene) -> None:
    """Check that no part of a scene has a second frequency.

    Raises:
        ValueError: if one has; says which.
    """
    for name in ("platform", "base", "force"):
        part = getattr(scene, name)
        if part is not None and part.second is not None:
            raise ValueError(
                f"the scene has `{name}.second`, a second frequency, but only one is allowed here: leave it out, or "
                "simulate the scene"
            )


RANGE_OF_ONE = "a range of a frequency moves one part's alone: give the others that move an amplitude of 0"
"""Why base and sample of one frequency cannot be taken through it together."""


class DrivePeriod(NamedTuple):
    """What the phases of a motion count in."""

    period_us: float
    angular_frequency: float
    """In rad/us."""
    aperiodic: str | None
    """Why no motion can repeat under this drive; None where it can."""


def drive_of(scene: Scene) -> DrivePeriod:
    """Return a scene's drive: the frequency of what moves, the platform's where several things do or nothing does.

    Args:
        scene: one scene, its numbers known.
    """
    platform = scene.platform
    excitations = [tone.wave for part in (scene.base, scene.force) if part is not None for tone in part.tones]
    waves = [wave for wave in (*platform.waves, *excitations) if float(wave.amplitude_nm) != 0.0]
    moving = [float(wave.angular_frequency) for wave in waves]
    omega = moving[0] if moving else float(platform.angular_frequency)
    aperiodic = None
    if any(abs(other - omega) > SAME_FREQUENCY * omega for other in moving):
        aperiodic = "the drive has several frequencies, so that no period of the drive repeats"
    elif float(platform.offset_rate_nm_per_us) != 0.0:
        aperiodic = "the offset ramps, so that no period of the drive repeats"
    return DrivePeriod(2.0 * math.pi / omega, omega, aperiodic)
