"""The cantilever: a single mass on a spring, damped by air or not, with its free flight in closed form.

Takes free frequency in kHz, Q and mass in ng or spring constant in N/m. Gives Omega in rad/us, the acceleration of a
free tip in nm/us^2 and its propagator: position in nm and velocity in nm/us a duration in us later (eq. 16 without
contact).
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from afm_jax.apparatus.trigonometry import sine_cosine
from afm_jax.checks import as_argument, as_parameter, check_parameter, is_traced, readable
from afm_jax.units import RAD_PER_US_PER_KHZ, contradicting_mass, effective_mass_ng


class Propagator(NamedTuple):
    """The free flight's linear map over a duration: (z, v) after = matrix times (z, v) before.

    ``position_per_velocity`` is in us, ``velocity_per_position`` in 1/us, the other two are numbers.
    """

    position_per_position: Float[Array, "..."]
    position_per_velocity: Float[Array, "..."]
    velocity_per_position: Float[Array, "..."]
    velocity_per_velocity: Float[Array, "..."]

    def __call__(self, position: ArrayLike, velocity: ArrayLike) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        """Return position in nm and velocity in nm/us after the flight."""
        return (
            self.position_per_position * position + self.position_per_velocity * velocity,
            self.velocity_per_position * position + self.velocity_per_velocity * velocity,
        )


def mass_of(frequency_khz: Any, mass_ng: Any, spring_constant_n_per_m: Any) -> Any:
    """Return the effective mass in ng that mass and spring constant, either of them or neither, come to.

    Args:
        frequency_khz: of the free cantilever.
        mass_ng: or None.
        spring_constant_n_per_m: or None.

    Raises:
        ValueError: if both are given and 2 % apart or more, or the spring constant is not positive.
    """
    if spring_constant_n_per_m is None:
        return 1.0 if mass_ng is None else mass_ng
    check_parameter("spring_constant_n_per_m", spring_constant_n_per_m, "positive")
    check_parameter("frequency_khz", frequency_khz, "positive")
    if mass_ng is None:
        return effective_mass_ng(as_parameter(spring_constant_n_per_m), as_parameter(frequency_khz))
    numbers = mass_ng, spring_constant_n_per_m, frequency_khz
    if not any(map(is_traced, numbers)):
        for one in np.broadcast(*map(np.asarray, numbers)):
            if wrong := contradicting_mass(*map(float, one)):
                raise ValueError(wrong)
    return mass_ng


class Cantilever(eqx.Module):
    """A cantilever with its tip as one mass: z'' + (Omega/Q) z' + Omega^2 z = 0 between impacts.

    Args:
        frequency_khz: free frequency, Omega / 2 pi.
        quality_factor: Q > 1/2 of the free resonance; None leaves air damping out of the program.
        mass_ng: effective mass; without it and a spring constant 1 ng.
        spring_constant_n_per_m: what the mass is taken from, m = k/Omega^2; not kept.

    Raises:
        ValueError: if the frequency or the mass is not positive, mass and spring constant are 2 % apart or more, or the
            motion is overdamped (Q <= 1/2).
    """

    frequency_khz: Float[Array, "..."] = eqx.field(converter=as_parameter)
    quality_factor: Float[Array, "..."] | None = eqx.field(converter=as_parameter, default=None)
    mass_ng: Float[Array, "..."] = eqx.field(converter=as_parameter, default=1.0)

    __repr__ = readable

    def __init__(
        self,
        frequency_khz: ArrayLike,
        quality_factor: ArrayLike | None = None,
        mass_ng: ArrayLike | None = None,
        *,
        spring_constant_n_per_m: ArrayLike | None = None,
    ) -> None:
        """Keep the numbers; the mass is that of the spring constant, or 1 ng, where it is not given."""
        self.frequency_khz = frequency_khz  # pyright: ignore[reportAttributeAccessIssue]
        self.quality_factor = quality_factor  # pyright: ignore[reportAttributeAccessIssue]
        self.mass_ng = mass_of(frequency_khz, mass_ng, spring_constant_n_per_m)

    def __check_init__(self):
        check_parameter("frequency_khz", self.frequency_khz, "positive")
        check_parameter("quality_factor", self.quality_factor, "above 0.5", optional=True)
        check_parameter("mass_ng", self.mass_ng, "positive")

    @property
    def angular_frequency(self) -> Float[Array, "..."]:
        """Omega in rad/us."""
        return RAD_PER_US_PER_KHZ * self.frequency_khz

    @property
    def stiffness_n_per_m(self) -> Float[Array, "..."]:
        """Spring constant m Omega^2 in nN/nm = N/m."""
        return self.mass_ng * self.angular_frequency**2

    @property
    def decay_rate(self) -> Float[Array, "..."]:
        """Rate Omega/2Q in 1/us at which the amplitude decays; 0 without damping."""
        if self.quality_factor is None:
            return jnp.zeros_like(self.frequency_khz)
        return self.angular_frequency / (2.0 * self.quality_factor)

    @property
    def damped_angular_frequency(self) -> Float[Array, "..."]:
        """Omega_d = Omega sqrt(1 - 1/4Q^2) in rad/us."""
        if self.quality_factor is None:
            return self.angular_frequency
        return self.angular_frequency * jnp.sqrt(1.0 - 0.25 / self.quality_factor**2)

    def propagator(self, duration_us: ArrayLike) -> Propagator:
        """Return the free flight's linear map over a duration in us (eqs. 2 and 4; damped: times exp(-Omega t/2Q))."""
        omega, omega_d = self.angular_frequency, self.damped_angular_frequency
        sine, cosine = sine_cosine(omega_d * as_argument(duration_us))
        if self.quality_factor is None:
            return Propagator(cosine, sine / omega, -omega * sine, cosine)
        decay = jnp.exp(-self.decay_rate * duration_us)
        lag = (self.decay_rate / omega_d) * sine
        reach = sine / omega_d
        return Propagator(
            decay * (cosine + lag), decay * reach, -decay * (omega * omega) * reach, decay * (cosine - lag)
        )

    def acceleration(self, position: ArrayLike, velocity: ArrayLike) -> Float[Array, "..."]:
        """Return the tip's free acceleration in nm/us^2 at a position in nm and a velocity in nm/us."""
        return -(self.angular_frequency**2) * position - 2.0 * self.decay_rate * velocity
