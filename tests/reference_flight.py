"""What the references are made of: parameters, free flight, platform and impact law, in mpmath or NumPy.

Written from the equations alone and sharing nothing with the package, so that agreement with it means something.
Every formula takes the library that computes it, `mp` (any number of digits) or `np` (float64 arrays). Units are the
program's: nm, us, nm/us, rad/us.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, ParamSpec, TypeVar

import mpmath
import numpy as np

DIGITS = 50
# lost on the way, so that DIGITS are right in the result
GUARD_DIGITS = 15

# mpmath makes its functions at run time, where type checkers do not see them
mp: Any = mpmath.mp
# an mpmath number, or a float or array where NumPy computes
Number = Any
Matrix = Any  # an mpmath matrix

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


def high_precision(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Run a function with at least DIGITS right digits, with more where the caller already works with more."""

    @functools.wraps(function)
    def wrapped(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        with mp.workdps(max(mp.dps, DIGITS + GUARD_DIGITS)):
            return function(*args, **kwargs)

    return wrapped


@dataclass(frozen=True, kw_only=True)
class Parameters:
    """One tip, one platform, one impact law, as plain numbers.

    Args:
        frequency_khz: free frequency of the tip.
        quality_factor: above 1/2; None for no air damping.
        amplitude_nm: drive amplitude beta of the platform.
        drive_frequency_khz: drive frequency of the platform.
        offset_nm: rest height sigma of the platform above the tip's.
        r: coefficient of restitution.
        epsilon: absolute loss, nm^2/us^2.
        viscous_loss: loss c per approach speed, nm/us.
        delay: None, or (hertz in us (nm/us)^(1/5), lead in nm, offset in nm).
    """

    frequency_khz: float
    quality_factor: float | None
    amplitude_nm: float
    drive_frequency_khz: float
    offset_nm: float
    r: float
    epsilon: float
    viscous_loss: float = 0.0
    delay: tuple[float, float, float] | None = None


class Constants(NamedTuple):
    """The parameters in the program's units, as numbers of the library that computes."""

    free: Number  # Omega, rad/us
    decay: Number  # Omega/2Q, 1/us
    ringing: Number  # Omega sqrt(1 - 1/4Q^2), rad/us
    drive: Number  # omega, rad/us
    amplitude: Number
    offset: Number
    r: Number
    epsilon: Number
    viscous: Number
    delay: tuple[Number, Number, Number] | None
    drive_period: Number  # us


def constants(p: Parameters, lib: Any = mp) -> Constants:
    """Return the parameters as numbers of `lib` at its present precision."""
    number = mp.mpf if lib is mp else np.float64
    turn = 2 * lib.pi
    free = turn * number(p.frequency_khz) / 1000
    drive = turn * number(p.drive_frequency_khz) / 1000
    decay = number(0) if p.quality_factor is None else free / (2 * number(p.quality_factor))
    delay = None if p.delay is None else (number(p.delay[0]), number(p.delay[1]), number(p.delay[2]))
    return Constants(
        free=free,
        decay=decay,
        ringing=lib.sqrt(free**2 - decay**2),
        drive=drive,
        amplitude=number(p.amplitude_nm),
        offset=number(p.offset_nm),
        r=number(p.r),
        epsilon=number(p.epsilon),
        viscous=number(p.viscous_loss),
        delay=delay,
        drive_period=turn / drive,
    )


def propagator(k: Constants, t: Number, lib: Any = mp) -> tuple[Number, Number, Number, Number]:
    """Return (p11, p12, p21, p22) of the free flight: z(t) = p11 z0 + p12 v0, v(t) = p21 z0 + p22 v0."""
    shrink = lib.exp(-k.decay * t)
    cosine = shrink * lib.cos(k.ringing * t)
    sine = shrink * lib.sin(k.ringing * t) / k.ringing
    return cosine + k.decay * sine, sine, -(k.free**2) * sine, cosine - k.decay * sine


def platform(k: Constants, t: Number, lib: Any = mp) -> tuple[Number, Number, Number]:
    """Return position (nm), velocity (nm/us) and acceleration (nm/us^2) of the platform at time t."""
    angle = k.drive * t
    swing = k.amplitude * lib.cos(angle)
    return k.offset + swing, -k.amplitude * k.drive * lib.sin(angle), -(k.drive**2) * swing


@high_precision
def free_flight(p: Parameters, duration_us: Number, z0: Number, v0: Number) -> tuple[Number, Number]:
    """Return position (nm) and velocity (nm/us) of the free tip after a duration (us)."""
    p11, p12, p21, p22 = propagator(constants(p), mp.mpf(duration_us))
    return p11 * z0 + p12 * v0, p21 * z0 + p22 * v0


@high_precision
def platform_motion(p: Parameters, time_us: Number) -> tuple[Number, Number, Number]:
    """Return position (nm), velocity (nm/us) and acceleration (nm/us^2) of the platform."""
    return platform(constants(p), mp.mpf(time_us))


def outgoing(k: Constants, u: Number, lib: Any = mp) -> Number:
    """Return the rebound speed: u_out^2 = r^2 u^2 - c u - epsilon (eq. 6 for c = 0)."""
    return lib.sqrt(k.r**2 * u**2 - k.viscous * u - k.epsilon)


def outgoing_slope(k: Constants, u: Number) -> Number:
    """Return d u_out/d u_in = (2 r^2 u - c)/(2 u_out)."""
    return (2 * k.r**2 * u - k.viscous) / (2 * outgoing(k, u))


def capture_limit(k: Constants, lib: Any = mp) -> Number:
    """Return the approach speed (nm/us) up to which the tip stays on the sample."""
    return (k.viscous + lib.sqrt(k.viscous**2 + 4 * k.r**2 * k.epsilon)) / (2 * k.r**2)


def collision_delay(k: Constants, u: Number, lib: Any = mp) -> Number:
    """Return tau = a u^(-1/5) - b (1/u_out - 1/u) - d/u in us; 0 without delay."""
    if k.delay is None:
        return 0 * u
    hertz, lead, offset = k.delay
    return hertz * lib.exp(-lib.log(u) / 5) - lead * (1 / outgoing(k, u, lib) - 1 / u) - offset / u


@high_precision
def rebound_speed(p: Parameters, approach_speed_nm_per_us: Number) -> Number:
    """Return u_out in nm/us; complex where the tip is captured."""
    return outgoing(constants(p), mp.mpf(approach_speed_nm_per_us))


@high_precision
def rebound_slope(p: Parameters, approach_speed_nm_per_us: Number) -> Number:
    """Return d u_out/d u_in."""
    return outgoing_slope(constants(p), mp.mpf(approach_speed_nm_per_us))


@high_precision
def capture_speed(p: Parameters) -> Number:
    """Return the approach speed in nm/us up to which the tip is captured."""
    return capture_limit(constants(p))


@high_precision
def delay_us(p: Parameters, approach_speed_nm_per_us: Number) -> Number:
    """Return the collision delay in us."""
    return collision_delay(constants(p), mp.mpf(approach_speed_nm_per_us))
