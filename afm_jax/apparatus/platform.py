"""The moving platform that carries the sample: offset + ramp + cosine, and a second cosine where there is one."""

from collections.abc import Iterable
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from afm_jax.apparatus.drives import Tone
from afm_jax.apparatus.trigonometry import sine_cosine
from afm_jax.checks import as_argument, as_parameter, check_kind, check_parameter, readable
from afm_jax.units import RAD_PER_US_PER_KHZ


class Oscillation(NamedTuple):
    """A harmonic part of a motion at one time: angular frequency in rad/us, position in nm and velocity in nm/us."""

    angular_frequency: Float[Array, "..."]
    position: Float[Array, "..."]
    velocity: Float[Array, "..."]


class SurfaceMotion(NamedTuple):
    """The motion of a surface at one time: a ramp and oscillations, whose derivatives all follow from the first two."""

    ramped_nm: Float[Array, "..."]
    """The offset at that time."""
    rate_nm_per_us: Float[Array, "..."]
    oscillations: tuple[Oscillation, ...]

    @property
    def position(self) -> Float[Array, "..."]:
        """Height in nm."""
        return sum((part.position for part in self.oscillations), start=self.ramped_nm)

    @property
    def velocity(self) -> Float[Array, "..."]:
        """First derivative of the height by time, in nm/us."""
        still = jnp.broadcast_to(self.rate_nm_per_us, self.ramped_nm.shape)
        return sum((part.velocity for part in self.oscillations), start=still)

    @property
    def acceleration(self) -> Float[Array, "..."]:
        """Second derivative of the height by time, in nm/us^2."""
        return self._sum(-(part.angular_frequency**2) * part.position for part in self.oscillations)

    @property
    def jerk(self) -> Float[Array, "..."]:
        """Third derivative of the height by time, in nm/us^3."""
        return self._sum(-(part.angular_frequency**2) * part.velocity for part in self.oscillations)

    def _sum(self, parts: Iterable[Float[Array, "..."]]) -> Float[Array, "..."]:
        first, *others = [*parts] or [jnp.zeros_like(self.ramped_nm)]
        return sum(others, start=first)


class Platform(eqx.Module):
    """A platform at z_p(t) = offset + rate t + amplitude cos(omega t) [+ second].

    Args:
        amplitude_nm: drive amplitude (beta in the paper).
        frequency_khz: drive frequency, omega / 2 pi.
        offset_nm: mean height above the tip's rest position (sigma in the paper).
        offset_rate_nm_per_us: slow ramp of the offset.
        second: a second frequency of the drive, its amplitude in nm; None leaves it out of the program.

    Raises:
        ValueError: if the frequency is not positive, the amplitude negative or a value not finite.
    """

    amplitude_nm: Float[Array, "..."] = eqx.field(converter=as_parameter)
    frequency_khz: Float[Array, "..."] = eqx.field(converter=as_parameter)
    offset_nm: Float[Array, "..."] = eqx.field(converter=as_parameter, default=0.0)
    offset_rate_nm_per_us: Float[Array, "..."] = eqx.field(converter=as_parameter, default=0.0)
    second: Tone | None = None

    __repr__ = readable

    def __check_init__(self):
        check_parameter("amplitude_nm", self.amplitude_nm, "not negative")
        check_parameter("frequency_khz", self.frequency_khz, "positive")
        check_parameter("offset_nm", self.offset_nm, "finite")
        check_parameter("offset_rate_nm_per_us", self.offset_rate_nm_per_us, "finite")
        check_kind("second", self.second, Tone | None)

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
        """Largest speed against the ramp, beta omega, in nm/us; a bound where there are two cosines."""
        first = self.amplitude_nm * self.angular_frequency
        return first if self.second is None else first + self.second.amplitude * self.second.angular_frequency

    @property
    def reach_nm(self) -> Float[Array, "..."]:
        """Largest distance from the ramped offset in nm; a bound where there are two cosines."""
        return self.amplitude_nm if self.second is None else self.amplitude_nm + self.second.amplitude

    @property
    def largest_acceleration_nm_per_us2(self) -> Float[Array, "..."]:
        """Largest acceleration, beta omega^2, in nm/us^2; a bound where there are two cosines."""
        first = self.amplitude_nm * self.angular_frequency**2
        return first if self.second is None else first + self.second.amplitude * self.second.angular_frequency**2

    @property
    def fastest_angular_frequency(self) -> Float[Array, "..."]:
        """The largest angular frequency of the motion in rad/us."""
        first = self.angular_frequency
        return first if self.second is None else jnp.maximum(first, self.second.angular_frequency)

    def motion(self, time_us: ArrayLike) -> SurfaceMotion:
        """Return z_p with its derivatives at a time in us, from one sine-cosine pair a frequency."""
        time = as_argument(time_us)
        sine, cosine = sine_cosine(self.angular_frequency * time)
        omega = self.angular_frequency
        first = Oscillation(omega, self.amplitude_nm * cosine, -self.amplitude_nm * omega * sine)
        others = [] if self.second is None else [_of_tone(self.second, time)]
        return SurfaceMotion(
            self.offset_nm + self.offset_rate_nm_per_us * time, self.offset_rate_nm_per_us, (first, *others)
        )

    def position_and_velocity(self, time_us: ArrayLike) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        """Return z_p in nm and its rate in nm/us at a time in us."""
        motion = self.motion(time_us)
        return motion.position, motion.velocity

    def position(self, time_us: ArrayLike) -> Float[Array, "..."]:
        """Return z_p in nm at a time in us."""
        return self.position_and_velocity(time_us)[0]

    def velocity(self, time_us: ArrayLike) -> Float[Array, "..."]:
        """Return dz_p/dt in nm/us at a time in us."""
        return self.position_and_velocity(time_us)[1]

    def acceleration(self, time_us: ArrayLike) -> Float[Array, "..."]:
        """Return d^2z_p/dt^2 in nm/us^2 at a time in us."""
        return self.motion(time_us).acceleration


def _of_tone(tone: Tone, time_us: Float[Array, "..."]) -> Oscillation:
    return Oscillation(tone.angular_frequency, *tone.value_and_rate(time_us))
