"""What drives the tip besides the sample: the cantilever's base that moves, or a force on the tip.

Takes amplitude (nm of the base, nN of the force), frequency in kHz and phase in degrees. Gives waves a cos(omega t +
phi).

A drive is one cosine, or two. With both drives eq. 16 reads m z'' + (m Omega/Q) z' + k z = F(D, D') + f(t) + k z_b(t):
the base acts through the spring, the air damps the motion in the lab. What a detector sees of a tip on a moving base
is the deflection z - z_b.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from afm_jax.apparatus.trigonometry import sine_cosine
from afm_jax.checks import as_argument, as_parameter, check_kind, check_parameter, readable
from afm_jax.units import RAD_PER_US_PER_KHZ

SAME_FREQUENCY = 1e-12
"""Relative distance below which two frequencies are one."""


class Wave(eqx.Module):
    """A wave c cos(omega t) + s sin(omega t): the one form in which every motion is evaluated.

    Args:
        cosine: c, of a motion in nm, of a force in nN.
        sine: s.
        angular_frequency: omega in rad/us.
    """

    cosine: Float[Array, "..."] = eqx.field(converter=as_parameter)
    sine: Float[Array, "..."] = eqx.field(converter=as_parameter)
    angular_frequency: Float[Array, "..."] = eqx.field(converter=as_parameter)

    __repr__ = readable

    def __add__(self, other: "Wave") -> "Wave":
        """Return the sum of two waves of one frequency."""
        return Wave(self.cosine + other.cosine, self.sine + other.sine, self.angular_frequency)

    def __neg__(self) -> "Wave":
        """Return the wave turned round."""
        return Wave(-self.cosine, -self.sine, self.angular_frequency)

    @property
    def amplitude_nm(self) -> Float[Array, "..."]:
        """sqrt(c^2 + s^2), with slope 0 where both vanish."""
        square = self.cosine**2 + self.sine**2
        moves = square > 0.0
        return jnp.where(moves, jnp.sqrt(jnp.where(moves, square, 1.0)), 0.0)

    def value_and_rate(self, time_us: Float[Array, "..."]) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        """Return the wave at a time in us and its rate per us."""
        omega = self.angular_frequency
        sine, cosine = sine_cosine(omega * time_us)
        return self.cosine * cosine + self.sine * sine, self.sine * omega * cosine - self.cosine * omega * sine


class Tone(eqx.Module):
    """One cosine of a drive, amplitude cos(omega t + phase): a motion in nm or a force in nN.

    Args:
        amplitude: not negative; of a motion in nm, of a force in nN.
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

    @property
    def wave(self) -> Wave:
        """The tone as a cos(phi) cos(omega t) - a sin(phi) sin(omega t)."""
        phase = self.phase_rad
        return Wave(self.amplitude * jnp.cos(phase), -self.amplitude * jnp.sin(phase), self.angular_frequency)


class BaseDrive(eqx.Module):
    """A base of the cantilever that moves as z_b(t) = amplitude cos(omega t + phase) [+ second].

    Args:
        amplitude_nm: amplitude of the motion.
        frequency_khz: omega / 2 pi.
        phase_deg: phase at time 0, when a platform's own cosine is highest.
        second: a second frequency, its amplitude in nm; None leaves it out of the program.

    Raises:
        ValueError: if the frequency is not positive, the amplitude negative or the phase not finite.
    """

    amplitude_nm: Float[Array, "..."] = eqx.field(converter=as_parameter)
    frequency_khz: Float[Array, "..."] = eqx.field(converter=as_parameter)
    phase_deg: Float[Array, "..."] = eqx.field(converter=as_parameter, default=0.0)
    second: Tone | None = None

    __repr__ = readable

    def __check_init__(self):
        _check(self, "amplitude_nm")

    @property
    def tones(self) -> tuple[Tone, ...]:
        """The motion's cosines, amplitudes in nm."""
        return _tones(self, self.amplitude_nm)

    def position_and_velocity(self, time_us: ArrayLike) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        """Return z_b in nm and its rate in nm/us at a time in us."""
        return _sum_of_tones(self.tones, time_us)


class ForceDrive(eqx.Module):
    """A force on the tip of f(t) = amplitude cos(omega t + phase) [+ second], upward where positive.

    Args:
        amplitude_nn: amplitude in nN.
        frequency_khz: omega / 2 pi.
        phase_deg: phase at time 0, when a platform's own cosine is highest.
        second: a second frequency, its amplitude in nN; None leaves it out of the program.

    Raises:
        ValueError: if the frequency is not positive, the amplitude negative or the phase not finite.
    """

    amplitude_nn: Float[Array, "..."] = eqx.field(converter=as_parameter)
    frequency_khz: Float[Array, "..."] = eqx.field(converter=as_parameter)
    phase_deg: Float[Array, "..."] = eqx.field(converter=as_parameter, default=0.0)
    second: Tone | None = None

    __repr__ = readable

    def __check_init__(self):
        _check(self, "amplitude_nn")

    @property
    def tones(self) -> tuple[Tone, ...]:
        """The force's cosines, amplitudes in nN."""
        return _tones(self, self.amplitude_nn)

    def force(self, time_us: ArrayLike) -> Float[Array, "..."]:
        """Return f in nN at a time in us."""
        return _sum_of_tones(self.tones, time_us)[0]


def _check(drive: BaseDrive | ForceDrive, amplitude: str) -> None:
    """Check the parameters of a drive whose amplitude has this name."""
    check_parameter(amplitude, getattr(drive, amplitude), "not negative")
    check_parameter("frequency_khz", drive.frequency_khz, "positive")
    check_parameter("phase_deg", drive.phase_deg, "finite")
    check_kind("second", drive.second, Tone | None)


def _tones(drive: BaseDrive | ForceDrive, amplitude: Float[Array, "..."]) -> tuple[Tone, ...]:
    first = Tone(amplitude, drive.frequency_khz, drive.phase_deg)
    return (first,) if drive.second is None else (first, drive.second)


def _sum_of_tones(tones: tuple[Tone, ...], time_us: ArrayLike) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    values, rates = zip(*(tone.wave.value_and_rate(as_argument(time_us)) for tone in tones), strict=True)
    still = jnp.zeros_like(values[0])
    return sum(values, start=still), sum(rates, start=still)
