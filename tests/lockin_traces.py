"""Traces with known amplitudes: bounces in closed form."""

import cmath
import math

import numpy as np
from scipy.signal import lfilter

FREE_KHZ = 90.0
OMEGA = 2e-3 * np.pi * FREE_KHZ


def bounce(
    time: np.ndarray, *, order: int, drive_khz: float, peak: float = 70.0, top_us: float = 1.3
) -> tuple[np.ndarray, complex]:
    """Return undamped single-impact flights of any order and their exact lock-in value.

    z = A cos Omega s, s the time since the top, repeats with T = 2 pi N/omega; 2/T int z exp(-i k t) dt with k = 2 pi/T
    is the sum of two sines over (Omega +- k).
    """
    period = 1e3 * order / drive_khz
    since = np.asarray(np.mod(time - top_us + 0.5 * period, period)) - 0.5 * period
    k = 2.0 * np.pi / period
    above = math.sin((OMEGA + k) * period / 2.0) / (OMEGA + k)
    below = math.sin((OMEGA - k) * period / 2.0) / (OMEGA - k)
    value = 2.0 / period * peak * (above + below) * cmath.exp(-1j * k * top_us)
    return peak * np.asarray(np.cos(OMEGA * since)), value


def noisy_bounce(
    seed: int, *, periods: float = 60.0, noise: float = 0.7, rate: float = 5.3, order: int = 1, memory: float = 0.0
) -> tuple[np.ndarray, np.ndarray, complex]:
    """Return times, heights and lock-in value of a bounce with noise; `memory`: of the noise of the sample before."""
    drive = 181.8 * order
    time = np.arange(0.0, periods * 1e3 / drive, 1.0 / rate)
    height, value = bounce(time, order=order, drive_khz=drive)
    white = np.random.default_rng(seed).standard_normal(time.size)
    kept = np.asarray(lfilter([np.sqrt(1.0 - memory**2)], [1.0, -memory], white))
    return time, height + noise * kept, value
