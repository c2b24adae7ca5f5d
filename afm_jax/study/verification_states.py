"""Random states for the verification: a scene, a start, and an impact that follows; the hard corners on purpose.

Families, drawn in turn: ordinary; near resonance (omega/2 Omega within 1e-6 to 1e-2 of an integer); near grazing
(offset and velocity solved such that the tip meets the platform at a chosen, small relative speed: both conditions
are linear in them). In each of them epsilon is 0, or of any size, or just short of capturing the tip.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.impact.law import CollisionDelay, ImpactLaw
from afm_jax.units import RAD_PER_US_PER_KHZ

Floats = NDArray[np.float64]

LOWEST_OFFSET_NM, HIGHEST_OFFSET_NM = -20.0, 5.0
FAMILIES = ("ordinary", "near resonance", "near grazing")


class Kind(NamedTuple):
    """What a scene has besides the paper's: air damping, viscous loss with it, and a collision delay."""

    damped: bool
    delayed: bool


PAPER, DAMPED, DELAYED = (
    Kind(damped=False, delayed=False),
    Kind(damped=True, delayed=False),
    Kind(damped=True, delayed=True),
)


class States(NamedTuple):
    """Scenes and starts, every array of shape (states,): time in us, lab velocity just after an impact in nm/us."""

    scene: Scene
    time_us: Any
    velocity: Any


def random_states(random: np.random.Generator, count: int, kind: Kind) -> States:
    """Return states without adhesion; `with_adhesion` adds it once the approach speeds are known.

    Args:
        random: source of randomness.
        count: how many; their shape is always (count,), whether the tip comes back or not.
        kind: which effects the scenes have.
    """
    family = np.arange(count) % len(FAMILIES)
    frequency = logarithmic(random, 40.0, 200.0, count)
    reduced = np.where(family == 1, near_integer(random, count), random.uniform(0.3, 6.0, count))
    quality = logarithmic(random, 2.0, 1e4, count) if kind.damped else None
    amplitude = logarithmic(random, 0.2, 20.0, count)
    offset = random.uniform(LOWEST_OFFSET_NM, HIGHEST_OFFSET_NM, count)
    drive = 2.0 * reduced * frequency * RAD_PER_US_PER_KHZ
    time = random.uniform(0.0, 2.0 * np.pi, count) / drive
    velocity = logarithmic(random, 0.05, 300.0, count) - amplitude * drive * np.sin(drive * time)
    touching = _touching(random, (frequency, quality, amplitude, drive, time))
    offset, velocity = (np.where(family == 2, new, old) for new, old in zip(touching, (offset, velocity), strict=True))
    delay = CollisionDelay(
        *(scale * random.uniform(0.0, 1.5, count) for scale in (0.206, 5.64, 0.726)), corrections=False
    )
    law = ImpactLaw(
        r=random.uniform(0.3, 1.0, count),
        epsilon=np.zeros(count),
        viscous_loss=logarithmic(random, 1e-3, 1.0, count) * kind.damped * (random.random(count) < 0.7),
        delay=delay if kind.delayed else None,
    )
    platform = Platform(amplitude, 2.0 * reduced * frequency, offset, np.zeros(count))
    return States(Scene(Cantilever(frequency, quality, np.ones(count)), platform, law), time, velocity)


def with_adhesion(random: np.random.Generator, states: States, approach_speed: Floats) -> States:
    """Return the states with epsilon: a third none, a third any, a third (1 - x) of what captures, x = 1e-9 to 1.

    Args:
        random: source of randomness.
        states: their impacts do not depend on epsilon, which acts only afterwards.
        approach_speed: u_in at their impacts in nm/us; NaN where there is none.
    """
    law = states.scene.interaction
    assert isinstance(law, ImpactLaw)  # noqa: S101
    count = len(approach_speed)
    energy = (np.asarray(law.r) * approach_speed) ** 2
    some = energy * random.uniform(0.0, 1.0, count)
    nearly = energy * (1.0 - logarithmic(random, 1e-9, 1.0, count)) - np.asarray(law.viscous_loss) * approach_speed
    chosen = np.choose(random.integers(0, 3, count), [np.zeros(count), some, nearly])
    epsilon = np.where(np.isfinite(chosen), np.maximum(chosen, 0.0), 0.0)
    law = ImpactLaw(r=law.r, epsilon=epsilon, viscous_loss=law.viscous_loss, delay=law.delay)
    # An invalid start in place of a flight that does not come back: nothing waits for it any more.
    velocity = np.where(np.isfinite(approach_speed), states.velocity, np.nan)
    return States(Scene(states.scene.cantilever, states.scene.platform, law), states.time_us, velocity)


def logarithmic(random: np.random.Generator, low: float, high: float, count: int) -> Floats:
    """Return numbers spread evenly in their logarithm."""
    return np.exp(random.uniform(np.log(low), np.log(high), count))


def near_integer(random: np.random.Generator, count: int) -> Floats:
    """Return numbers within 1e-6 to 1e-2 of 1 to 6, on either side."""
    side = random.choice([-1.0, 1.0], count)
    return random.integers(1, 7, count) + side * logarithmic(random, 1e-6, 1e-2, count)


def _touching(random: np.random.Generator, system: tuple[Floats, Floats | None, Floats, Floats, Floats]):
    """Return offset (nm) and start velocity (nm/us) of flights that close in slowly at a later time.

    Of eight later times and closing speeds for every system the first is taken that has a fitting offset; where there
    is none the velocity is NaN, which `next_impact` calls an invalid start.
    """
    frequency, quality, amplitude, drive, start = (None if part is None else part[:, None] for part in system)
    assert frequency is not None and amplitude is not None and drive is not None and start is not None  # noqa: PT018, S101
    shape = len(frequency), 8
    free = RAD_PER_US_PER_KHZ * frequency
    decay = np.zeros_like(free) if quality is None else 0.5 * free / quality
    duration = random.uniform(0.1, 1.5, shape) * 2.0 * np.pi / free
    speed = amplitude * drive * np.exp(random.uniform(np.log(1e-6), 0.0, shape))
    offset, velocity = _start_for(duration, speed, (free, decay, amplitude, drive, start))
    leaving = velocity + amplitude * drive * np.sin(drive * start)
    fits = (offset > LOWEST_OFFSET_NM) & (offset < HIGHEST_OFFSET_NM) & (leaving > 0.0) & (velocity < 500.0)
    chosen = np.arange(shape[0]), np.argmax(fits, axis=1)
    return np.where(fits[chosen], offset[chosen], 0.0), np.where(fits[chosen], velocity[chosen], np.nan)


def _start_for(duration: Floats, approach: Floats, system: tuple[Floats, Floats, Floats, Floats, Floats]):
    """Solve for offset and start velocity, given when and how fast the tip closes in.

    (p11 - 1) sigma + p12 V' = z_p~(t2) - p11 z_p~(t1) and p21 sigma + p22 V' = v_p(t2) - u - p21 z_p~(t1), with z_p~
    the platform without its offset.
    """
    free, decay, amplitude, drive, start = system
    ringing = np.sqrt(free**2 - decay**2)
    shrink = np.exp(-decay * duration)
    cosine, sine = shrink * np.cos(ringing * duration), shrink * np.sin(ringing * duration) / ringing
    p11, p12, p21, p22 = cosine + decay * sine, sine, -(free**2) * sine, cosine - decay * sine
    end = start + duration
    here, there = amplitude * np.cos(drive * start), amplitude * np.cos(drive * end)
    gap = there - p11 * here
    fall = -amplitude * drive * np.sin(drive * end) - approach - p21 * here
    determinant = (p11 - 1.0) * p22 - p12 * p21
    return (gap * p22 - p12 * fall) / determinant, ((p11 - 1.0) * fall - p21 * gap) / determinant
