"""What a scene shows in the last fifth of a duration, for motions that do not settle: ramps, several frequencies."""

import jax.numpy as jnp

from afm_jax.apparatus.scene import Scene
from afm_jax.motion.drive_period import Drive, drive_of
from afm_jax.motion.record import Simulation, State
from afm_jax.study.motion_program import Programs
from afm_jax.study.steady_motion import place_of, where_to_go_on, why_impossible

_SHARE = 0.8
_PIECE = 50.0
"""Drive periods simulated at a time."""


def window_of_last_fifth(start: State, drive: Drive, duration_us: float) -> tuple[float, float]:
    """Return beginning and end, in us, of whole drive periods in the last fifth of a duration; at least one."""
    end = float(start.time_us) + duration_us
    periods = max(1, int((1.0 - _SHARE) * duration_us / drive.period_us))
    return end - periods * drive.period_us, end


def follow_to(
    programs: Programs, scene: Scene, start: State, window: tuple[float, float], rate: Scene | None = None
) -> tuple[str | None, Simulation | None, Simulation | None]:
    """Follow a scene from a start through a window.

    Args:
        programs: compiled programs.
        scene: one scene.
        start: where it begins.
        window: beginning and end in us.
        rate: a change of the scene; None: no derivative is wanted.

    Returns:
        Why the window was not reached, or None; the motion that covers the window; its derivative along the change.
    """
    reason = why_impossible(scene)
    if reason is not None:
        return reason, None, None
    period = drive_of(scene).period_us
    state, slope = start, State(*(jnp.zeros(()) for _ in start))
    while True:
        now = float(state.time_us)
        last = now >= window[0] - _PIECE * period
        until = window[1] if last else now + _PIECE * period
        change = None
        if rate is None:
            motion = programs.run(scene, state, until - now)
        else:
            motion, change = programs.run_with_tangent(scene, state, until - now, rate, slope)
        stopped, row = where_to_go_on(scene, motion)
        if stopped:
            return stopped, None, None
        if last and float(motion.final.time_us) >= window[1] - 1e-9 * window[1]:
            return None, motion, change
        state = place_of(motion, row)
        slope = slope if change is None else place_of(change, row)
        if float(state.time_us) <= now:
            return "the motion does not come out of its contact", None, None
