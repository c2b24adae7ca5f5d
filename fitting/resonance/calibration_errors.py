"""The standard errors of a sweep's points: from the file, from a stated noise, or estimated from the misfit."""

import numpy as np
from jaxtyping import Float

from fitting.resonance.resonance_model import SweepObjective, model_at, slope_at
from fitting.resonance.resonance_sweep import ResonanceSweep

SMALLEST = 1e-7
"""Error of an estimated noise in units of the largest amplitude: a sweep without noise must not divide by zero."""


def first_errors(
    sweep: ResonanceSweep, noise: float | None, guess: float
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return the errors that a fit starts with, along and across the vector, in units of the largest amplitude.

    Args:
        sweep: the sweep.
        noise: error of every point as a share of the largest amplitude, for a sweep without errors of its own.
        guess: the error where nothing is known.
    """
    largest = sweep.amplitude.max()
    if sweep.amplitude_error is None:
        along = np.full(sweep.points, max(guess, SMALLEST) if noise is None else noise)
    else:
        along = sweep.amplitude_error / largest
    if sweep.phase_error_deg is None:
        return along, along
    # Far from the resonance the vector may be shorter than its noise.
    across = np.maximum(sweep.amplitude / largest, 1e-6) * np.deg2rad(sweep.phase_error_deg)
    return along, across


def with_estimated_errors(
    objective: SweepObjective, values: Float[np.ndarray, " p"], points: int
) -> tuple[SweepObjective, float, float]:
    """Return the objective with errors that explain the misfit of a fit.

    The noise of a lock-in amplifier is equal in all directions. A drive whose frequency is rounded or wanders moves the
    response along its curve besides, by the slope dz/df times the error of the frequency: with the phase measured, the
    two are told apart by their direction. Without it all misfit is taken as noise of the amplitude.

    Returns:
        The objective, the noise in units of the largest amplitude, and the jitter of the frequency in kHz.
    """
    model = np.asarray(model_at(values, objective.points, objective.kind))[:points]
    misfit = model - np.asarray(objective.points.measured)[:points]
    parameters = len(values)
    if objective.kind == "amplitude":
        noise = float(np.sqrt(np.sum(np.real(misfit) ** 2) / (points - parameters)))
        along = np.full(points, max(noise, SMALLEST))
        return objective.with_errors(along, along), noise, 0.0
    slope = np.asarray(slope_at(values, objective.points, objective.kind))[:points]
    steep = np.abs(slope)
    direction = np.where(steep > 0.0, slope, 1.0) / np.where(steep > 0.0, steep, 1.0)
    turned = misfit * np.conj(direction)
    freedom = points - parameters / 2.0
    noise = max(float(np.sqrt(np.sum(np.imag(turned) ** 2) / freedom)), SMALLEST)
    excess = np.sum(np.real(turned) ** 2) * points / freedom - points * noise**2
    jitter = float(np.sqrt(max(excess, 0.0) / np.sum(steep**2)))
    along = np.hypot(noise, jitter * steep)
    return objective.with_errors(along, np.full(points, noise), direction), noise, jitter
