"""Where a simulation begins: the start of a scene file, whether it is possible in its scene, and that of a state."""

from typing import NamedTuple

from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.impact.law import ImpactLaw
from afm_jax.motion.drive_period import drive_of
from afm_jax.motion.record import State
from afm_jax.parameters import check_parameter


class Start(NamedTuple):
    """Where a simulation begins: `phase_deg` of the drive, height above the platform, velocity in the lab."""

    phase_deg: float
    height_above_platform_nm: float
    velocity_nm_per_us: float


def check_start(start: Start, scene: Scene) -> None:
    """Check that a tip can begin at a start: outside the sample, and not on its way into it from its surface.

    Args:
        start: the start.
        scene: one scene, its numbers known.

    Raises:
        ValueError: if it cannot; says why.
    """
    height = start.height_above_platform_nm
    check_parameter("phase_deg", start.phase_deg, "finite")
    check_parameter("velocity_nm_per_us", start.velocity_nm_per_us, "finite")
    check_parameter("height_above_platform_nm", height, "finite")
    if scene.interaction is None:
        return
    if isinstance(scene.interaction, ImpactLaw):
        check_parameter("height_above_platform_nm", height, "not negative")
        if height == 0.0:
            _check_leaves(start, scene.platform)
        return
    # only here, so that scenes with a law do without the contact's modules
    from afm_jax.scenefile_contact import junction_of  # noqa: PLC0415

    if height <= 0.0:
        raise ValueError(
            f"`height_above_platform_nm` must be positive, but is {height:g}: the tip would start inside the sample"
        )
    junction = junction_of(scene.interaction)
    forms = float(junction.forms_gap_nm)
    if bool(junction.exists) and height <= forms:
        raise ValueError(
            f"`height_above_platform_nm` must be above {forms:.6g}, where the solid junction forms, but is {height:g}"
        )


def _check_leaves(start: Start, platform: Platform) -> None:
    """Check that a tip on the platform moves away from it."""
    time_us = start.phase_deg / 360.0 * float(platform.period_us)
    moving = float(platform.velocity(time_us))
    if start.velocity_nm_per_us <= moving:
        raise ValueError(
            f"`velocity_nm_per_us` must be above the platform's {moving:.6g} where the tip starts on it, but is "
            f"{start.velocity_nm_per_us:.6g}: start faster or higher"
        )


def as_in_file(scene: Scene, state: State) -> Start:
    """Return the start from which `start_of` makes a state again, within the drive's first period.

    Args:
        scene: one scene.
        state: time, height and velocity in the lab.
    """
    time = float(state.time_us)
    phase = 360.0 * (time / drive_of(scene).period_us)
    height = float(state.position_nm) - float(scene.platform.position(time))
    return Start(phase % 360.0, height, float(state.velocity_nm_per_us))
