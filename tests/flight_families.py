"""Random flights in families, each made to be hard for a root finder in its own way."""

import numpy as np

from tests.brute_force import Flights, Floats

FAMILIES = ("typical", "grazing", "high_order", "low_speed", "damped", "far")


def random_flights(seed: int, n: int, family: str) -> Flights:
    """Return `n` flights that leave the platform.

    Args:
        seed: same seed, same flights.
        n: how many.
        family: "typical" (reduced drive 0.4 to 6, approach of 1 to 200 nm/us, half of them damped), "grazing" (a
            minimum of the gap lies within about 1e-3 to 1e-9 of the speed of touching the platform), "high_order"
            (drive 4 to 16 times the free frequency), "low_speed" (leaves the platform faster than it by 1e-6 to
            1e-2 of its top speed), "damped" (quality factor 5 to 100) or "far" (platform 20 to 80 nm below rest).
    """
    random = np.random.default_rng([seed, FAMILIES.index(family)])
    if family == "grazing":
        return _grazing(random, n)
    frequency = random.uniform(40, 200, n)
    quality = np.where(random.random(n) < 0.5, np.inf, _logarithmic(random, 20, 1000, n))
    ratio = 2 * random.uniform(0.4, 6, n)
    offset = random.uniform(-3, 3, n)
    amplitude = _logarithmic(random, 0.3, 8, n)
    if family == "high_order":
        ratio = random.uniform(4, 16, n)
    if family == "damped":
        quality = _logarithmic(random, 5, 100, n)
    if family == "far":
        offset = -random.uniform(20, 80, n)
    drive_frequency = ratio * frequency
    drive = 2e-3 * np.pi * drive_frequency
    time = random.uniform(0, 2 * np.pi, n) / drive
    leaving = _logarithmic(random, 1, 200, n)
    if family == "low_speed":
        leaving = _logarithmic(random, 1e-6, 1e-2, n) * amplitude * drive
    velocity = leaving - amplitude * drive * np.sin(drive * time)
    return Flights(frequency, quality, amplitude, drive_frequency, offset, time, velocity)


def _logarithmic(random: np.random.Generator, low: float, high: float, n: int) -> Floats:
    """Return numbers spread evenly in their logarithm."""
    return np.exp(random.uniform(np.log(low), np.log(high), n))


def _grazing(random: np.random.Generator, n: int) -> Flights:
    """Return flights whose gap almost touches zero.

    Gap and slope at a chosen time are linear in offset and start velocity: both are solved for, then the velocity is
    shifted. Kept are those that leave the platform, touch at a minimum and stay above before it.
    """
    kept: list[Floats] = []
    while sum(len(some) for some in kept) < n:
        rows = _touching(random, 4 * n + 64)
        shift = random.choice([-1.0, 1.0], len(rows)) * 10 ** random.uniform(-9, -3, len(rows))
        rows[:, 6] += shift * np.abs(rows[:, 6])
        leaves = rows[:, 6] > -rows[:, 2] * 2e-3 * np.pi * rows[:, 3] * np.sin(2e-3 * np.pi * rows[:, 3] * rows[:, 5])
        kept.append(rows[leaves])
    return Flights(*np.concatenate(kept)[:n].T)


def _touching(random: np.random.Generator, n: int) -> Floats:
    """Return rows of `Flights` fields whose gap has a double zero, fewer than `n`."""
    free = 2e-3 * np.pi * random.uniform(40, 200, n)
    quality = np.where(random.random(n) < 0.5, np.inf, _logarithmic(random, 20, 1000, n))
    drive = 2 * free * random.uniform(0.4, 6, n)
    amplitude = _logarithmic(random, 0.3, 8, n)
    start = random.uniform(0, 2 * np.pi, n) / drive
    touch = random.uniform(0.1, 2, n) * 2 * np.pi / free
    decay = 0.5 * free / quality
    ringing = np.sqrt(free**2 - decay**2)

    def flight(s: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        cosine, sine = np.exp(-decay * s) * np.cos(ringing * s), np.exp(-decay * s) * np.sin(ringing * s) / ringing
        return cosine + decay * sine, sine, -(free**2) * sine, cosine - decay * sine

    p11, p12, p21, p22 = flight(touch)
    here, there = amplitude * np.cos(drive * start), amplitude * np.cos(drive * (start + touch))
    fall = -amplitude * drive * np.sin(drive * (start + touch))
    # (p11 - 1) offset + p12 v = there - p11 here;  p21 offset + p22 v = fall - p21 here
    determinant = (p11 - 1) * p22 - p12 * p21
    offset = ((there - p11 * here) * p22 - p12 * (fall - p21 * here)) / determinant
    velocity = ((p11 - 1) * (fall - p21 * here) - p21 * (there - p11 * here)) / determinant

    s = touch[:, None] * np.linspace(0, 1, 402)[None, 1:-1]
    q11, q12, _, _ = (part.T for part in flight(s.T))
    path = q11 * (offset + here)[:, None] + q12 * velocity[:, None]
    gap = path - offset[:, None] - amplitude[:, None] * np.cos(drive[:, None] * (start[:, None] + s))
    leaves = velocity > -amplitude * drive * np.sin(drive * start)
    keep = leaves & (np.abs(offset) < 60) & (velocity < 300) & (gap.min(axis=1) > 0)
    fields = (free / 2e-3 / np.pi, quality, amplitude, drive / 2e-3 / np.pi, offset, start, velocity)
    return np.stack(fields, axis=1)[keep]
