"""Synthetic resonance sweeps from the equation of motion."""

import numpy as np

from fitting.calibration.sweep import Resonance

FREQUENCY_KHZ, QUALITY_FACTOR = 90.0, 400.0


def steady_response(frequency_khz, *, natural_khz: float, quality_factor: float):
    """Return z of z'' + (Omega/Q) z' + Omega^2 z = (Omega^2/Q) exp(i omega t) by solving the first-order system.

    The state (z, z') obeys s' = M s + b exp(i omega t), so s = (i omega - M)^-1 b: nothing is shared with the package.
    """
    omega, natural = 2.0 * np.pi * np.asarray(frequency_khz), 2.0 * np.pi * natural_khz
    matrix = np.array([[0.0, 1.0], [-(natural**2), -natural / quality_factor]])
    force = np.array([0.0, natural**2 / quality_factor])
    return np.array([np.linalg.solve(1j * one * np.eye(2) - matrix, force)[0] for one in omega])


def synthetic_sweep(
    *,
    points: int = 120,
    half_widths: float = 6.0,
    noise: float = 0.0,
    background: complex = 0.0,
    slope: complex = 0.0,
    amplitude_nm: float = 5.0,
    phase: bool = True,
    given: bool = True,
    centre: float = 0.0,
    quality_factor: float = QUALITY_FACTOR,
    seed: int = 1,
) -> Resonance:
    """Return a sweep around the resonance.

    Args:
        points: how many, evenly spaced.
        half_widths: how far the sweep reaches to each side, in f0/2Q.
        noise: of each component, as a share of the amplitude on resonance.
        background: complex, as a share of the amplitude on resonance.
        slope: its change from the middle to an end, likewise.
        amplitude_nm: on resonance.
        phase: whether the sweep has its phase.
        given: whether it has its errors.
        centre: middle of the sweep, in half-widths above the resonance.
        quality_factor: of the cantilever.
        seed: of the noise.
    """
    random = np.random.default_rng(seed)
    position = np.linspace(-1.0, 1.0, points)
    half = FREQUENCY_KHZ / quality_factor / 2.0
    frequency = FREQUENCY_KHZ + half * (centre + half_widths * position)
    shape = steady_response(frequency, natural_khz=FREQUENCY_KHZ, quality_factor=quality_factor)
    clean = np.exp(0.7j) * shape + background + slope * position
    error = noise * amplitude_nm
    spread = error * (random.standard_normal(points) + 1j * random.standard_normal(points))
    measured = amplitude_nm * clean + spread
    return Resonance(
        frequency_khz=frequency,
        amplitude=np.abs(measured),
        phase_deg=np.rad2deg(np.angle(measured)) if phase else None,
        amplitude_error=np.full(points, error) if given and error > 0.0 else None,
    )
