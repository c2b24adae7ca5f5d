"""The sums of the magnitudes of the terms of eqs. 5 to 8: what a difference between two ways to compute is measured in.

A formula whose terms nearly cancel cannot be more exact than its terms. Every function below mirrors one of
`afm_jax.impact.jacobian`, with each difference replaced by a sum and each factor by its magnitude; a denominator stays
as it is. S, the sine of a difference of phases, is one of these differences: |sin a cos b| + |cos a sin b|.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.impact.jacobian import PaperFlight
from afm_jax.impact.law import ImpactLaw, squared_rebound_speed


def eq5_terms(flight: PaperFlight, start: Float[Array, ""], impact_us: Float[Array, ""]) -> Float[Array, "2 2"]:
    """Return the terms' sums for eq. 5."""
    beta, omega, Omega, A, B, s1, s2, _, C, S = flight
    closing = jnp.abs(A * Omega * S - B * Omega * C - beta * omega * s2)
    A, B, s1, s2, C = (jnp.abs(part) for part in (A, B, s1, s2, C))
    S = _sine_terms(Omega, start, impact_us)
    pull = Omega**2 * (A * C + B * S) / closing
    return jnp.array(
        [
            [(beta * omega * s1 * C + A * Omega * S + B * Omega * C) / closing, S / Omega / closing],
            [beta * omega * Omega * s1 * S + pull * beta * omega * (s2 + s1 * C), C + pull * S / Omega],
        ]
    )


def flight_terms(
    cantilever: Cantilever, platform: Platform, start: Float[Array, ""], velocity: Float[Array, ""], impact_us
) -> Float[Array, "2 2"]:
    """Return the terms' sums for `flight_jacobian`, the damped eq. 5.

    dt2/dt1 has a 1 among them: t2 is the start plus a duration, and a damped tip forgets its start, so that dt2/dt1
    is the little that is left of 1 plus the duration's derivative.
    """
    propagator = cantilever.propagator(impact_us - start)
    position, platform_velocity = platform.position_and_velocity(start)
    closing = jnp.abs(propagator(position, velocity)[1] - platform.velocity(impact_us))
    p11, _, p21, p22 = (jnp.abs(part) for part in propagator)
    ringing = cantilever.damped_angular_frequency
    shrink = jnp.exp(-cantilever.decay_rate * (impact_us - start))
    p12 = shrink * _sine_terms(ringing, start, impact_us) / ringing
    position, velocity, platform_velocity = jnp.abs(position), jnp.abs(velocity), jnp.abs(platform_velocity)
    before = p21 * position + p22 * velocity
    pull = cantilever.angular_frequency**2 * (p11 * position + p12 * velocity) + 2.0 * cantilever.decay_rate * before
    time_by_time, time_by_velocity = (before + p11 * platform_velocity) / closing, p12 / closing
    return jnp.array(
        [
            [1.0 + time_by_time, time_by_velocity],
            [p21 * platform_velocity + pull * (time_by_time + 1.0), p22 + pull * time_by_velocity],
        ]
    )


def eq6_slopes(approach: Float[Array, ""], law: ImpactLaw) -> tuple[Float[Array, " 4"], Float[Array, " 4"]]:
    """Return d u_out/d(u_in, r, epsilon, c) of eq. 6, and the sums of the magnitudes of their terms."""
    r, c = law.r, law.viscous_loss
    half = 0.5 / jnp.sqrt(squared_rebound_speed(approach, r, law.epsilon, c))
    rest = [2.0 * r * approach**2 * half, -half, -approach * half]
    slopes = jnp.stack([(2.0 * r**2 * approach - c) * half, *rest])
    return slopes, jnp.abs(slopes).at[0].set((2.0 * r**2 * approach + c) * half)


def eq7_terms(flight: PaperFlight, velocity_before, r: Float[Array, ""], epsilon: Float[Array, ""]):
    """Return the terms' sums for eq. 7, shape (2, 2)."""
    relative = velocity_before + flight.beta * flight.omega * flight.s2
    ratio = r**2 * jnp.abs(relative) / jnp.sqrt(r**2 * relative**2 - epsilon)
    turn = flight.beta * flight.omega**2 * jnp.abs(flight.c2) * (ratio + 1.0)
    return jnp.array([[jnp.ones_like(turn), jnp.zeros_like(turn)], [turn, ratio]])


def impact_terms(law: ImpactLaw, platform: Platform, arrival: Float[Array, ""], before) -> Float[Array, "2 2"]:
    """Return the terms' sums for `impact_jacobian`, eq. 7 with viscous loss and delay."""
    approach = platform.velocity(arrival) - before
    rebound = law.rebound_speed(approach)
    slope = (2.0 * law.r**2 * approach + law.viscous_loss) / (2.0 * rebound)
    delay_slope = jnp.zeros_like(slope)
    if law.delay is not None:
        lead, offset = jnp.abs(law.delay.lead_nm), jnp.abs(law.delay.offset_nm)
        delay_slope = 0.2 * jnp.abs(law.delay.hertz) * approach**-1.2 + lead * slope / rebound**2
        delay_slope = delay_slope + (lead + offset) / approach**2
    pull_in = jnp.abs(platform.acceleration(arrival))
    pull_out = jnp.abs(platform.acceleration(arrival + law.collision_delay(approach)))
    time_by_time = 1.0 + delay_slope * pull_in
    return jnp.array(
        [[time_by_time, delay_slope], [pull_out * time_by_time + slope * pull_in, pull_out * delay_slope + slope]]
    )


def eq8_trace_terms(flight: PaperFlight, velocity_after: Float[Array, ""], r: Float[Array, ""]) -> Float[Array, ""]:
    """Return the terms' sum for the trace of eq. 8."""
    beta, omega, Omega, _, _, _, s, c, C, S = flight
    closing = jnp.abs(velocity_after - beta * omega * s)  # v_p - V, with V = -V'
    ratio = jnp.abs((velocity_after - beta * omega * s) / (velocity_after + beta * omega * s))
    s, c, C, S = (jnp.abs(part) for part in (s, c, C, S))
    bracket = beta * omega * s * (1.0 + C) + (jnp.abs(velocity_after) + beta * omega * s * C) * r**2 * ratio
    bracket = bracket + beta * omega**2 / Omega * c * S * (r**2 * ratio + 1.0)
    return 1.0 + bracket / closing


def _sine_terms(frequency: Float[Array, ""], start: Float[Array, ""], impact_us: Float[Array, ""]) -> Float[Array, ""]:
    """Return |sin a cos b| + |cos a sin b| for the phases a, b of the flight's end and start."""
    end, begin = frequency * impact_us, frequency * start
    return jnp.abs(jnp.sin(end) * jnp.cos(begin)) + jnp.abs(jnp.cos(end) * jnp.sin(begin))
