"""What drives the tip besides the sample: the cantilever's base that moves, or a force on the tip.

With both, eq. 16 reads m z'' + (m Omega/Q) z' + k z = F(D, D') + f(t) + k z_b(t): the base acts through the spring,
the air damps the motion in the lab. What a detector sees of a tip on a moving base is the deflection z - z_b.
"""

import equinox as eqx
from jaxtyping import Array, ArrayLike, Float

from afm_jax.apparatus.drive import Tone
from afm_jax.parameters import as_argument, as_parameter, check_parameter, readable


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
        check_parameter("amplitude_nm", self.amplitude_nm, "not negative")
        check_parameter("frequency_khz", self.frequency_khz, "positive")
        check_parameter("phase_deg", self.phase_deg, "finite")

    @property
    def tones(self) -> tuple[Tone, ...]:
        """The motion's cosines, amplitudes in nm."""
        first = Tone(self.amplitude_nm, self.frequency_khz, self.phase_deg)
        return (first,) if self.second is None else (first, self.second)

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
        check_parameter("amplitude_nn", self.amplitude_nn, "not negative")
        check_parameter("frequency_khz", self.frequency_khz, "positive")
        check_parameter("phase_deg", self.phase_deg, "finite")

    @property
    def tones(self) -> tuple[Tone, ...]:
        """The force's cosines, amplitudes in nN."""
        first = Tone(self.amplitude_nn, self.frequency_khz, self.phase_deg)
        return (first,) if self.second is None else (first, self.second)

    def force(self, time_us: ArrayLike) -> Float[Array, "..."]:
        """Return f in nN at a time in us."""
        return _sum_of_tones(self.tones, time_us)[0]


def _sum_of_tones(tones: tuple[Tone, ...], time_us: ArrayLike) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    time = as_argument(time_us)
    value, rate = tones[0].value_and_rate(time)
    for tone in tones[1:]:
        more, faster = tone.value_and_rate(time)
        value, rate = value + more, rate + faster
    return value, rate
