"""A state as a scene file writes it down."""

from afm_jax.apparatus.scene import Scene
from afm_jax.motion.drive_period import drive_of
from afm_jax.motion.record import State
from afm_jax.scenefile_start import Start


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
