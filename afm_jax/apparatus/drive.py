"""One cosine of a drive: what a platform, a base or a force does at one frequency."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from afm_jax.apparatus.trigonometry import sine_cosine
from afm_jax.parameters import as_argument, as_parameter, check_parameter, readable
from afm_jax.units import RAD_PER_US_PER_KHZ


class Tone(eqx.Module):
    """A cosine amplitude cos(omega t + phase); what it is the amplitude of, its use says.

    Args:
        amplitude: in nm of a motion, in nN of a force.
        frequency_khz: omega / 2 pi.
        phase_deg: phase at time 0.

    Raises:
        ValueError: if the frequency is not positive, the amplitude negative or the phase not finite.
    """

    amplitude: Float[Array, "..."] = eqx.field(converter=as_parameter)
    frequency_khz: Float[Array, "..."] = eqx.field(converter=as_parameter)
    phase_deg: Float[Array, "..."] = eqx.field(converter=as_parameter, default=0.0)

    __repr__ = readable

    def __check_init__(self):
        check_parameter("amplitude", self.amplitude, "not negative")
        check_parameter("frequency_khz", self.frequency_khz, "positive")
        check_parameter("phase_deg", self.phase_deg, "finite")

    @property
    def angular_frequency(self) -> Float[Array, "..."]:
        """Omega of the tone in rad/us."""
        return RAD_PER_US_PER_KHZ * self.frequency_khz

    @property
    def phase_rad(self) -> Float[Array, "..."]:
        """Phase at time 0 in rad."""
        return jnp.deg2rad(self.phase_deg)

    def value_and_rate(self, time_us: ArrayLike) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        """Return the cosine at a time in us, in the amplitude's unit, and its rate per us."""
        sine, cosine = sine_cosine(self.angular_frequency * as_argument(time_us) + self.phase_rad)
        return self.amplitude * cosine, -self.amplitude * self.angular_frequency * sine
