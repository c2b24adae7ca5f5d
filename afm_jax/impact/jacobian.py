"""The linearised impact map, written out: eqs. 5, 7 and 8, and their damped and delayed generalisation.

Takes times in us, positions in nm and velocities in nm/us; gives derivatives of impact time and velocity by those
before, in these units.

Two layers: formulas of scalars (the paper's eqs. 5, 7 and 8 as printed, and `flight_jacobian`, `impact_jacobian` that
hold with damping, viscous loss and delay), and `map_jacobian`, which finds the next impact of a scene and chains them.
`afm-jax verify` compares all of them with automatic differentiation. An impact that lasts, the delay with its
corrections, has no written formula: its Jacobian is that of automatic differentiation, exact as well.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.apparatus.surface import Surface, seen_freely
from afm_jax.checks import as_argument, check_parameter, checked
from afm_jax.impact.lasting_impact import speeds_of_impact
from afm_jax.impact.law import Impact, Law, impact_law_of
from afm_jax.impact.map import next_impact
from afm_jax.outcomes import Outcome


class PaperFlight(NamedTuple):
    """The symbols of eqs. 2-5 for one undamped flight without ramp.

    ``beta``, ``A``, ``B`` in nm; ``omega``, ``Omega`` in rad/us; sines and cosines: ``s1`` of omega t1, ``c2``,
    ``s2`` of omega t2, ``C``, ``S`` of Omega (t2 - t1).
    """

    beta: Float[Array, ""]
    omega: Float[Array, ""]
    Omega: Float[Array, ""]
    A: Float[Array, ""]
    B: Float[Array, ""]
    s1: Float[Array, ""]
    s2: Float[Array, ""]
    c2: Float[Array, ""]
    C: Float[Array, ""]
    S: Float[Array, ""]


def eq5(flight: PaperFlight) -> Float[Array, "2 2"]:
    """Return d(t2, V2)/d(t1, V1') of an undamped flight: the four elements of eq. 5 as printed.

    Units: [[1, us^2/nm], [nm/us^2, 1]].
    """
    beta, omega, Omega, A, B, s1, s2, _, C, S = flight
    closing = A * Omega * S - B * Omega * C - beta * omega * s2
    return jnp.array(
        [
            [
                (-beta * omega * s1 * C + A * Omega * S - B * Omega * C) / closing,
                S / Omega / closing,
            ],
            [
                beta * omega * Omega * s1 * S - Omega**2 * (A * C + B * S) * beta * omega * (s2 - s1 * C) / closing,
                C - Omega * (A * C + B * S) * S / closing,
            ],
        ]
    )


def eq7(flight: PaperFlight, velocity_before: ArrayLike, r: ArrayLike, epsilon: ArrayLike) -> Float[Array, "2 2"]:
    """Return d(t2, V2')/d(t2, V2) of the impact law without viscous loss and delay: eq. 7 as printed.

    Args:
        flight: the symbols; the second impact's phase is used.
        velocity_before: V2 in nm/us.
        r: coefficient of restitution.
        epsilon: adhesion in nm^2/us^2; the argument of the root must be positive.
    """
    relative = as_argument(velocity_before) + flight.beta * flight.omega * flight.s2
    ratio = r**2 * relative / jnp.sqrt(r**2 * relative**2 - epsilon)
    turn = flight.beta * flight.omega**2 * flight.c2 * (ratio - 1.0)
    return jnp.array([[jnp.ones_like(turn), jnp.zeros_like(turn)], [turn, ratio]])


def eq8(
    flight: PaperFlight, velocity_after: Float[Array, ""], r: Float[Array, ""]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return determinant D and trace T of the map on an undamped single-impact orbit: eq. 8 as printed (V = -V').

    Args:
        flight: the symbols on the orbit, where s1 = s2.
        velocity_after: V' in nm/us.
        r: coefficient of restitution.
    """
    beta, omega, Omega, _, _, _, s, c, C, S = flight
    v_p = -beta * omega * s
    V = -velocity_after
    ratio = (V - v_p) / (velocity_after - v_p)
    bracket = (
        beta * omega * s
        - beta * omega * s * C
        - (velocity_after + beta * omega * s * C) * r**2 * ratio
        + beta * omega**2 / Omega * c * S * (r**2 * ratio - 1.0)
    )
    return r**2, 1.0 + bracket / (v_p - V)


def paper_flight(
    cantilever: Cantilever, platform: Platform, start_us: ArrayLike, velocity: ArrayLike, impact_us: ArrayLike
) -> PaperFlight:
    """Return the symbols of eqs. 2-5 for a flight from one impact (time, velocity just after) to the next (time)."""
    omega, Omega = platform.angular_frequency, cantilever.angular_frequency
    t1, t2 = as_argument(start_us), as_argument(impact_us)
    turn = Omega * (t2 - t1)
    return PaperFlight(
        beta=platform.amplitude_nm,
        omega=omega,
        Omega=Omega,
        A=platform.position(t1),
        B=as_argument(velocity) / Omega,
        s1=jnp.sin(omega * t1),
        s2=jnp.sin(omega * t2),
        c2=jnp.cos(omega * t2),
        C=jnp.cos(turn),
        S=jnp.sin(turn),
    )


def flight_jacobian(
    cantilever: Cantilever, platform: Platform | Surface, start_us: ArrayLike, velocity: ArrayLike, impact_us: ArrayLike
) -> Float[Array, "2 2"]:
    """Return d(t2, V2)/d(t1, V1') of a free flight, damped or not: eq. 5 with the damped propagator p.

    The switching condition p11 z_p(t1) + p12 V1' = z_p(t2) gives dt2/dt1 = (V2 - p11 v_p1)/(V2 - v_p2) and
    dt2/dV1' = -p12/(V2 - v_p2); V2 = p21 z_p(t1) + p22 V1' moves with the tip's acceleration a2 besides.

    Args:
        cantilever: the free flight.
        platform: where it starts and ends.
        start_us: t1, time just after an impact.
        velocity: V1', lab velocity just after it in nm/us.
        impact_us: t2, time of the next impact.
    """
    start, impact = as_argument(start_us), as_argument(impact_us)
    p11, p12, p21, p22 = propagator = cantilever.propagator(impact - start)
    position1, platform_velocity1 = platform.position_and_velocity(start)
    position2, velocity2 = propagator(position1, velocity)
    acceleration2 = cantilever.acceleration(position2, velocity2)
    closing = velocity2 - platform.velocity(impact)
    time_by_time = (velocity2 - p11 * platform_velocity1) / closing
    time_by_velocity = -p12 / closing
    return jnp.array(
        [
            [time_by_time, time_by_velocity],
            [p21 * platform_velocity1 + acceleration2 * (time_by_time - 1.0), p22 + acceleration2 * time_by_velocity],
        ]
    )


def impact_jacobian(
    law: Law, platform: Platform | Surface, arrival_us: ArrayLike, velocity_before: ArrayLike
) -> Float[Array, "2 2"]:
    """Return d(t_out, V')/d(t_in, V) of an impact: eq. 7 with viscous loss and collision delay, without corrections.

    With u = v_p(t_in) - V, slope f' = d u_out/du and t_out = t_in + tau(u): dt_out = (1 + tau' a_p,in) dt_in - tau' dV
    and dV' = a_p,out dt_out + f' (a_p,in dt_in - dV).

    Args:
        law: the impact law.
        platform: gives velocity and acceleration at both times.
        arrival_us: t_in.
        velocity_before: V in nm/us.
    """
    arrival = as_argument(arrival_us)
    motion = platform.motion(arrival)
    approach = motion.velocity - velocity_before
    slope = law.rebound_slope(approach)
    delay_slope = law.delay_slope(approach)
    acceleration_in = acceleration_out = motion.acceleration
    if law.delayed:
        acceleration_out = platform.acceleration(arrival + law.collision_delay(approach))
    time_by_time = 1.0 + delay_slope * acceleration_in
    return jnp.array(
        [
            [time_by_time, -delay_slope],
            [acceleration_out * time_by_time + slope * acceleration_in, -acceleration_out * delay_slope - slope],
        ]
    )


def contact_jacobian(
    impact: Impact, cantilever: Cantilever, platform: Platform | Surface, arrival_us: Array, velocity_before: Array
) -> Float[Array, "2 2"]:
    """Return d(t_out, V')/d(t_in, V) of any impact: the written one, or of one that lasts the automatic one.

    Arguments as for `impact_jacobian`; ``cantilever`` pulls at the tip while the impact lasts.
    """
    if isinstance(impact, Law) and not impact.lasts:
        return impact_jacobian(impact, platform, arrival_us, velocity_before)

    def through(arriving: Float[Array, " 2"]) -> Float[Array, " 2"]:
        arrival, before = arriving
        speeds = speeds_of_impact(impact, platform.velocity(arrival) - before, arrival, cantilever, platform)
        leaving = arrival + speeds.delay
        return jnp.stack([leaving, platform.velocity(leaving) + speeds.rebound])

    return jax.jacfwd(through)(jnp.stack([arrival_us, velocity_before]))


@checked
def map_jacobian(scene: Scene, time_us: ArrayLike, velocity_nm_per_us: ArrayLike) -> Float[Array, "2 2"]:
    """Return d(time, velocity after) of the next impact over d(time, velocity after) of this one (eqs. 5 and 7).

    Args:
        scene: a scene with a law (`ImpactLaw`, `TabulatedLaw`).
        time_us: when the flight starts, scalar.
        velocity_nm_per_us: lab velocity just after the impact then, scalar.

    Returns:
        The 2 x 2 Jacobian [[1, us^2/nm], [nm/us^2, 1]] of the Poincare map, with damping, viscous loss and delay; NaN
        where `next_impact` says that the tip is captured or that there is no further impact.

    Raises:
        RuntimeError: if JAX is not set to 64-bit floats.
        TypeError: if the scene's interaction is not an impact law.
        ValueError: if time or velocity is an array or not finite, or an undamped cantilever is driven at its free
            frequency.
    """
    check_parameter("time_us", time_us, "finite")
    check_parameter("velocity_nm_per_us", velocity_nm_per_us, "finite")
    impact = next_impact(scene, time_us, velocity_nm_per_us)
    seen, response = seen_freely(scene)
    return _map_jacobian(seen, response, as_argument(time_us), as_argument(velocity_nm_per_us), impact)


@jax.jit
def _map_jacobian(seen: Scene, response: Surface | None, time, velocity, impact) -> Float[Array, "2 2"]:
    leaves = impact.outcome == Outcome.IMPACT
    arrival = jnp.where(leaves, impact.arrival_time_us, time)
    before = jnp.where(leaves, impact.velocity_before_nm_per_us, 0.0)
    if response is not None:
        velocity, before = velocity - response.velocity(time), before - response.velocity(arrival)
    flight = flight_jacobian(seen.cantilever, seen.platform, time, velocity, arrival)
    law = contact_jacobian(impact_law_of(seen), seen.cantilever, seen.platform, arrival, before)
    whole = law @ flight
    if response is not None:
        # lab velocities have the response's in them, which changes with the time
        into = jnp.array([[1.0, 0.0], [-response.acceleration(time), 1.0]])
        end = jnp.where(leaves, impact.time_us, time)
        whole = jnp.array([[1.0, 0.0], [response.acceleration(end), 1.0]]) @ whole @ into
    return jnp.where(leaves, whole, jnp.nan)
