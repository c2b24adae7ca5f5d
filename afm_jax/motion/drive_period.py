"""The period that a scene is driven with, and whether there is only one."""

import math
from typing import NamedTuple

from afm_jax.apparatus.scene import Scene

_SAME = 1e-12
"""Relative distance below which two frequencies are one."""


class Drive(NamedTuple):
    """What the phases of a motion count in."""

    period_us: float
    angular_frequency: float
    """In rad/us."""
    aperiodic: str | None
    """Why no motion can repeat under this drive; None where it can."""


def drive_of(scene: Scene) -> Drive:
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
    return Drive(2.0 * math.pi / omega, omega, aperiodic)
