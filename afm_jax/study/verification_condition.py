"""Where rounding alone decides: impacts close to capture and grazing, and how far errors grow there."""

import numpy as np
from numpy.typing import NDArray

from afm_jax.apparatus.scene import Scene
from afm_jax.impact.first_impact import DEFAULT_ROOT_TOLERANCE_US
from afm_jax.impact.law import impact_law_of
from afm_jax.study.verification_autodiff import Automatic
from afm_jax.study.verification_states import Floats, States

EPSILON = float(np.finfo(np.float64).eps)
CLOSE_TO_CAPTURE = 1e-5
CLOSE_TO_GRAZING = 1e-3
LARGE_AMPLIFICATION = 1e6


def is_away(scene: Scene, automatic: Automatic) -> NDArray[np.bool_]:
    """Say which impacts are away from capture and away from grazing, each for itself."""
    top_speed = np.asarray(scene.platform.top_speed_nm_per_us)
    away = np.asarray(automatic.approach) > CLOSE_TO_GRAZING * top_speed
    return away & (np.asarray(automatic.margin) > CLOSE_TO_CAPTURE)


def is_ordinary(scene: Scene, automatic: Automatic) -> NDArray[np.bool_]:
    """Say which impacts are neither close to capture nor to grazing.

    (r^2 u^2 - c u - epsilon)/(r^2 u^2) > 1e-5 and u > 1e-3 beta omega. Where both are small at once, or a delay
    magnifies a small rebound speed, rounding alone makes more than 1e-9: the relative rounding error of u is
    eps (|V| + beta omega)/u, that of the squared rebound speed larger by 1/margin, that of the phase after the delay by
    omega b/u_out; a product above 1e6 counts as close too.
    """
    approach, margin = np.asarray(automatic.approach), np.asarray(automatic.margin)
    top_speed = np.asarray(scene.platform.top_speed_nm_per_us)
    amplification = (np.abs(np.asarray(automatic.before)) + top_speed) / approach / margin
    law = impact_law_of(scene)
    if law.delay is not None:
        rebound = np.asarray(law.r) * approach * np.sqrt(np.maximum(margin, 0.0))
        omega = np.asarray(scene.platform.angular_frequency)
        with np.errstate(divide="ignore"):
            amplification = amplification * (1.0 + omega * np.asarray(law.delay.lead_nm) / rebound)
    return is_away(scene, automatic) & (amplification < LARGE_AMPLIFICATION)


def condition_number(states: States, automatic: Automatic) -> Floats:
    """Return by how much rounding errors of the inputs grow on the way to the derivatives: shape (states,).

    The impact time t2 is known to eps (t2 + G/u) and the tolerance of its search, where G = |p11 z_p1| + |p12 V'| +
    |z_p2| are the terms of eq. 3, which cancel, and u = v_p - V is the closing velocity. A time's error moves u by
    M = Omega sqrt(V'^2 + Omega^2 z^2) + beta omega^2 times as much, besides the rounding eps (|V| + beta omega) of its
    own terms: dividing by u gives the growth through the closing velocity. It shifts the phase of the platform's
    acceleration, too: omega |tan omega t2| times as much, relatively. Through the root of eq. 6 it grows by
    1 + 1/margin, margin = (r^2 u^2 - c u - epsilon)/(r^2 u^2), and with a delay by 1 + omega (b/u_out + t_out) in the
    platform's phase, times 1 + |tan omega t_out| for its acceleration there; 1 is for the rounding of the result.
    """
    cantilever, platform = states.scene.cantilever, states.scene.platform
    approach, top_speed = np.asarray(automatic.approach), np.asarray(platform.top_speed_nm_per_us)
    Omega, omega = np.asarray(cantilever.angular_frequency), np.asarray(platform.angular_frequency)
    reach = np.abs(np.asarray(platform.offset_nm)) + np.asarray(platform.amplitude_nm)
    speed = np.sqrt(np.asarray(states.velocity) ** 2 + (Omega * reach) ** 2)
    pull = Omega * speed + top_speed * omega
    gap_terms = 2.0 * reach + speed / Omega
    arrival = np.asarray(automatic.arrival_us)
    time_error = arrival + gap_terms / approach + DEFAULT_ROOT_TOLERANCE_US / EPSILON
    through_speed = (speed + top_speed + pull * time_error) / approach
    through_phase = omega * np.abs(np.tan(omega * arrival)) * time_error
    number = 1.0 + through_speed * (1.0 + 1.0 / np.asarray(automatic.margin)) + through_phase
    law = impact_law_of(states.scene)
    if law.delay is None:
        return number
    rebound = np.asarray(law.r) * approach * np.sqrt(np.asarray(automatic.margin))
    leaving = np.asarray(automatic.leaving_us)
    later = 1.0 + omega * (np.asarray(law.delay.lead_nm) / rebound + np.abs(leaving))
    return number * later * (1.0 + np.abs(np.tan(omega * leaving)))
