"""The moving platform that carries the sample: offset + ramp + cosine, and a second cosine where there is one.

Takes amplitude and offset in nm, frequency in kHz and a ramp in nm/us. Gives position z_p in nm, velocity in nm/us and
bounds of both and of the acceleration at a time in us (eq. 2).
"""

from abc import abstractmethod
from collections.abc import Iterable
from functools import reduce
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from afm_jax.apparatus.drives import Tone, Wave
from afm_jax.checks import as_argument, as_parameter, check_kind, check_parameter, is_traced, readable
from afm_jax.units import RAD_PER_US_PER_KHZ


class SurfaceMotion(NamedTuple):
    """The height of a surface at one time in nm, and its derivatives by the time in us."""

    position: Float[Array, "..."]
    velocity: Float[Array, "..."]
    acceleration: Float[Array, "..."]
    jerk: Float[Array, "..."]


class MovingSurface(eqx.Module):
    """A surface at offset + rate t + a sum of waves: the platform, or what a driven tip sees of it (`Surface`)."""

    offset_nm: eqx.AbstractVar[Float[Array, "..."]]
    offset_rate_nm_per_us: eqx.AbstractVar[Float[Array, "..."]]

    @property
    @abstractmethod
    def waves(self) -> tuple[Wave, ...]:
        """What the motion is the sum of."""

    @property
    def reach_nm(self) -> Float[Array, "..."]:
        """A bound of the distance from the ramped offset in nm; sharp for a single wave."""
        return self._total(wave.amplitude_nm for wave in self.waves)

    @property
    def top_speed_nm_per_us(self) -> Float[Array, "..."]:
        """A bound of the speed against the ramp in nm/us, beta omega; sharp for a single wave."""
        return self._total(wave.amplitude_nm * wave.angular_frequency for wave in self.waves)

    @property
    def largest_acceleration_nm_per_us2(self) -> Float[Array, "..."]:
        """A bound of the acceleration in nm/us^2, beta omega^2; sharp for a single wave."""
        return self._total(wave.amplitude_nm * wave.angular_frequency**2 for wave in self.waves)

    @property
    def fastest_angular_frequency(self) -> Float[Array, "..."]:
        """The largest angular frequency of the motion in rad/us; 0 without waves."""
        still = jnp.zeros_like(self.offset_nm)
        return reduce(jnp.maximum, (wave.angular_frequency for wave in self.waves), still)

    def motion(self, time_us: ArrayLike) -> SurfaceMotion:
        """Return the height with its derivatives at a time in us, from one sine-cosine pair a wave."""
        time = as_argument(time_us)
        position = self.offset_nm + self.offset_rate_nm_per_us * time
        velocity = jnp.broadcast_to(self.offset_rate_nm_per_us, position.shape)
        acceleration = jerk = jnp.zeros_like(position)
        for wave in self.waves:
            height, rate = wave.value_and_rate(time)
            square = wave.angular_frequency**2
            position, velocity = position + height, velocity + rate
            acceleration, jerk = acceleration - square * height, jerk - square * rate
        return SurfaceMotion(position, velocity, acceleration, jerk)

    def position_and_velocity(self, time_us: ArrayLike) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        """Return height in nm and velocity in nm/us at a time in us."""
        return self.motion(time_us)[:2]

    def position(self, time_us: ArrayLike) -> Float[Array, "..."]:
        """Return the height in nm at a time in us."""
        return self.motion(time_us).position

    def velocity(self, time_us: ArrayLike) -> Float[Array, "..."]:
        """Return the velocity in nm/us at a time in us."""
        return self.motion(time_us).velocity

    def acceleration(self, time_us: ArrayLike) -> Float[Array, "..."]:
        """Return the acceleration in nm/us^2 at a time in us."""
        return self.motion(time_us).acceleration

    def _total(self, parts: Iterable[Float[Array, "..."]]) -> Float[Array, "..."]:
        return sum(parts, start=jnp.zeros_like(self.offset_nm))


class Platform(MovingSurface):
    """A platform at z_p(t) = offset + rate t + amplitude cos(omega t) [+ second].

    Args:
        amplitude_nm: drive amplitude (beta in the paper).
        frequency_khz: drive frequency, omega / 2 pi. A platform without amplitude needs none: in a scene it has that of
            base or force, or else the cantilever's, in which phases count.
        offset_nm: mean height above the tip's rest position (sigma in the paper).
        offset_rate_nm_per_us: slow ramp of the offset.
        second: a second frequency of the drive, its amplitude in nm; None leaves it out of the program.

    Raises:
        ValueError: if the frequency is not positive, the amplitude negative or a value not finite.
    """

    amplitude_nm: Float[Array, "..."] = eqx.field(converter=as_parameter, default=0.0)
    frequency_khz: Float[Array, "..."] = eqx.field(converter=as_parameter, default=0.0)
    offset_nm: Float[Array, "..."] = eqx.field(converter=as_parameter, default=0.0)
    offset_rate_nm_per_us: Float[Array, "..."] = eqx.field(converter=as_parameter, default=0.0)
    second: Tone | None = None

    __repr__ = readable

    def __check_init__(self):
        check_parameter("amplitude_nm", self.amplitude_nm, "not negative")
        check_parameter("offset_nm", self.offset_nm, "finite")
        check_parameter("offset_rate_nm_per_us", self.offset_rate_nm_per_us, "finite")
        check_kind("second", self.second, Tone | None)
        if not self.takes_any_frequency:
            check_parameter("frequency_khz", self.frequency_khz, "positive")

    @property
    def takes_any_frequency(self) -> bool:
        """Whether it is known to rest and has no frequency of its own yet."""
        numbers = self.amplitude_nm, self.frequency_khz
        return self.second is None and not any(is_traced(number) or np.any(np.asarray(number)) for number in numbers)

    @property
    def angular_frequency(self) -> Float[Array, "..."]:
        """Omega of the drive in rad/us."""
        return RAD_PER_US_PER_KHZ * self.frequency_khz

    @property
    def period_us(self) -> Float[Array, "..."]:
        """Drive period in us."""
        return 2.0 * jnp.pi / self.angular_frequency

    @property
    def waves(self) -> tuple[Wave, ...]:
        """The cosine, and that of the second frequency where there is one."""
        first = Wave(self.amplitude_nm, jnp.zeros_like(self.amplitude_nm), self.angular_frequency)
        return (first,) if self.second is None else (first, self.second.wave)
