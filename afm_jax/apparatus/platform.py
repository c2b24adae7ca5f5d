"""The moving platform that carries the sample: offset + ramp + cosine."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from afm_jax.apparatus.trigonometry import sine_cosine
from afm_jax.parameters import as_argument, as_parameter, check_parameter, readable
from afm_jax.units import RAD_PER_US_PER_KHZ


class Platform(eqx.Module):
    """A platform at z_p(t) = offset + rate t + amplitude cos(omega t).

    Args:
        amplitude_nm: drive amplitude (beta in the paper).
        frequency_khz: drive frequency, omega / 2 pi.
        offset_nm: mean height above the tip's rest position (sigma in the paper).
        offset_rate_nm_per_us: slow ramp of the offset.

    Raises:
        ValueError: if the frequency is not positive, the amplitude negative or a value not finite.
    """

    amplitude_nm: Float[Array, "..."] = eqx.field(converter=as_parameter)
    frequency_khz: Float[Array, "..."] = eqx.field(converter=as_parameter)
    offset_nm: Float[Array, "..."] = eqx.field(converter=as_parameter, default=0.0)
    offset_rate_nm_per_us: Float[Array, "..."] = eqx.field(converter=as_parameter, default=0.0)

    __repr__ = readable

    def __check_init__(self):
        check_parameter("amplitude_nm", self.amplitude_nm, "not negative")
        check_parameter("frequency_khz", self.frequency_khz, "positive")
        check_parameter("offset_nm", self.offset_nm, "finite")
        check_parameter("offset_rate_nm_per_us", self.offset_rate_nm_per_us, "finite")

    @property
    def angular_frequency(self) -> Float[Array, "..."]:
        """Omega of the drive in rad/us."""
        return RAD_PER_US_PER_KHZ * self.frequency_khz

    @property
    def period_us(self) -> Float[Array, "..."]:
        """Drive period in us."""
        return 2.0 * jnp.pi / self.angular_frequency

    @property
    def top_speed_nm_per_us(self) -> Float[Array, "..."]:
        """Largest speed of the cosine, beta omega, in nm/us."""
        return self.amplitude_nm * self.angular_frequency

    def position_and_velocity(self, time_us: ArrayLike) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        """Return z_p in nm and its rate in nm/us at a time in us, from one sine-cosine pair."""
        time = as_argument(time_us)
        sine, cosine = sine_cosine(self.angular_frequency * time)
        position = self.offset_nm + self.offset_rate_nm_per_us * time + self.amplitude_nm * cosine
        return position, self.offset_rate_nm_per_us - self.top_speed_nm_per_us * sine

    def position(self, time_us: ArrayLike) -> Float[Array, "..."]:
        """Return z_p in nm at a time in us."""
        return self.position_and_velocity(time_us)[0]

    def velocity(self, time_us: ArrayLike) -> Float[Array, "..."]:
        """Return dz_p/dt in nm/us at a time in us."""
        return self.position_and_velocity(time_us)[1]

    def acceleration(self, time_us: ArrayLike) -> Float[Array, "..."]:
        """Return d^2z_p/dt^2 in nm/us^2 at a time in us."""
        _, cosine = sine_cosine(self.angular_frequency * as_argument(time_us))
        return -self.top_speed_nm_per_us * self.angular_frequency * cosine
