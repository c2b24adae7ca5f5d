"""A scene: a cantilever, a moving platform, what happens when they meet, and what drives the tip besides.

The period that a scene is driven with, and whether there is only one.
"""

import math
from typing import Any, NamedTuple

import equinox as eqx

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.drives import BaseDrive, ForceDrive
from afm_jax.apparatus.platform import Platform
from afm_jax.checks import readable


class Scene(eqx.Module):
    """A container, nothing more: its parts are traced parameters, its structure says what is simulated.

    Args:
        cantilever: the tip and its spring.
        platform: the moving sample.
        interaction: an `ImpactLaw`, with or without a collision delay, or a `Contact`; None: the tip never meets the
            sample.
        base: a motion of the cantilever's base; None: it rests.
        force: a force on the tip; None: there is none.
    """

    cantilever: Cantilever
    platform: Platform
    interaction: Any = None  # the modules of the interactions import this one, not the other way round
    base: BaseDrive | None = None
    force: ForceDrive | None = None

    __repr__ = readable


def require_sample_drive(scene: Scene, *, second_frequency: bool = False) -> None:
    """Check that nothing drives a scene but its platform, for what knows nothing else.

    Args:
        scene: the scene.
        second_frequency: whether the platform may have a second frequency.

    Raises:
        ValueError: if there is another drive; says which.
    """
    if scene.base is not None:
        drive = "`base`, a motion of the cantilever's base"
    elif scene.force is not None:
        drive = "`force`, a force on the tip"
    elif scene.platform.second is not None and not second_frequency:
        drive = "`platform.second`, a second frequency of the platform"
    else:
        return
    known = "the platform's motion" if second_frequency else "one cosine of the platform"
    raise ValueError(f"the scene has {drive}, but only {known} is allowed here: leave it out, or simulate the scene")


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


_SAME = 1e-12
"""Relative distance below which two frequencies are one."""


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
    moving = []
    platform = scene.platform
    if float(platform.amplitude_nm) != 0.0:
        moving.append(float(platform.angular_frequency))
    tones = () if platform.second is None else (platform.second,)
    for part in (scene.base, scene.force):
        tones += () if part is None else part.tones
    moving += [float(tone.angular_frequency) for tone in tones if float(tone.amplitude) != 0.0]
    omega = moving[0] if moving else float(platform.angular_frequency)
    aperiodic = None
    if any(abs(other - omega) > _SAME * omega for other in moving):
        aperiodic = "the drive has several frequencies, so that no period of the drive repeats"
    elif float(platform.offset_rate_nm_per_us) != 0.0:
        aperiodic = "the offset ramps, so that no period of the drive repeats"
    return DrivePeriod(2.0 * math.pi / omega, omega, aperiodic)
