"""Rows that strain the event-driven picture: how far a law of impacts is off there, and which are set aside.

What is left out grows with the share of the drive's cycle that a leaving tip takes to lose its energy, s = omega L/w
(L: the length over which it does, w: its rebound speed). The error of the amplitude was measured on eight full contacts
(other humidities, adhesion, viscosity, modulus, quality factor, frequency, mass): it stays below about half of what is
taken, 0.05 % + 1.2 % s^3 + 1.6 % (1.5 u_c/u)^6 with the approach speed u and the capture speed u_c.
The three-parameter delay law is right to 0.15 ns, which counts where the delay alone fixes the amplitude.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from afm_jax.contact.law_of_contact import DELAY_ERROR_US, SPEED_ERROR
from afm_jax.impact.lasting_impact import LawImpact
from fitting.forward import Linearised
from fitting.optimise import Objective
from fitting.row_orbits import impact_of

BASE, GROWTH, SLOW = 0.0005, 0.012, 0.016
"""Relative model error of fast impacts, its growth with s^3, and its value at 1.5 times the capture speed."""
DELAY_US = 1.5e-4
"""Error of the delay law in us."""
LONGEST = 1.4
"""s beyond which a row is set aside."""
NEAREST = 1.35
"""Approach speed in terms of the capture speed below which a row is set aside."""


@dataclass(frozen=True)
class Strain:
    """How far a model's picture holds for each row.

    Attributes:
        model_error: relative error of the amplitude that the picture itself has, shape (rows,).
        set_aside: rows that are not used, shape (rows,).
    """

    model_error: Float[np.ndarray, " rows"]
    set_aside: Bool[np.ndarray, " rows"]


def strain_of(objective: Objective, values: Float[np.ndarray, " p"]) -> Strain:
    """Return the strain of every row (padded) at a set of values; none where impacts are instantaneous."""
    rows = objective.measurement.rows
    count = rows.order.shape[0]
    if not objective.problem.lasting:
        return Strain(np.zeros(count), np.zeros(count, dtype=bool))
    impact = impact_of(jnp.asarray(values), objective.measurement, objective.problem)
    linear = objective.at_values(values[None])
    prediction = linear.prediction
    exists = np.asarray(prediction.orbits)[0] > 0
    speeds = jax.vmap(impact.speeds)(jnp.asarray(np.asarray(prediction.coordinate)[0]))
    approach, rebound = np.asarray(speeds.approach), np.asarray(speeds.rebound)
    # without adhesion nothing is captured, and no impact is slow
    lowest = float(impact.lowest)
    capture = float(impact.speeds(jnp.asarray(lowest * (1.0 + 1e-9))).approach) if lowest > 0.0 else 0.0
    share = 2.0 * np.pi * np.asarray(rows.drive_frequency_khz) * 1e-3 * float(impact.length) / np.maximum(rebound, 1e-6)
    slow = (share > LONGEST) | (approach < NEAREST * capture)
    near = np.minimum(1.5 * capture / np.maximum(approach, 1e-6), 1.5 / NEAREST)
    error = BASE + GROWTH * np.minimum(share, LONGEST) ** 3 + SLOW * near**6
    if "delay_offset_nm" in objective.problem.names:
        error = np.hypot(error, DELAY_US * _sensitivity(objective, linear, approach))
    return Strain(np.where(exists, error, BASE), exists & slow)


def untabulated(
    objective: Objective, values: Float[np.ndarray, " p"], approach: Float[np.ndarray, " rows"]
) -> Bool[np.ndarray, " rows"]:
    """Say at which approach speeds the table of a contact misses its accuracy; nowhere for a law, nor at NaN."""
    impact = impact_of(jnp.asarray(values), objective.measurement, objective.problem)
    if isinstance(impact, LawImpact):
        return np.zeros(approach.shape, dtype=bool)
    speed, delay = impact.errors(jnp.asarray(approach))
    held = (np.asarray(speed) <= SPEED_ERROR) & (np.asarray(delay) <= DELAY_ERROR_US)
    return np.isfinite(approach) & ~held


def _sensitivity(
    objective: Objective, linear: Linearised, approach: Float[np.ndarray, " rows"]
) -> Float[np.ndarray, " rows"]:
    """Return by how much the amplitude changes with the delay, relative to itself, in 1/us."""
    count = approach.shape[0]
    offset = objective.problem.names.index("delay_offset_nm")
    slope = linear.jacobian[0, : 2 * count, offset].reshape(count, 2) * np.asarray(objective.measurement.rows.error_nm)
    amplitude = np.asarray(linear.prediction.amplitude_nm)[0]
    # the offset d shortens the delay by d/u
    relative = np.abs(slope) / np.where(amplitude > 0.0, amplitude, 1.0)
    return approach * np.where(amplitude > 0.0, relative, 0.0).max(axis=1)


def relaxed(objective: Objective, strain: Strain) -> Objective:
    """Return the objective with the model's error added to the measured one, without the rows set aside.

    Args:
        objective: with the errors as measured.
        strain: of its rows.
    """
    rows = objective.measurement.rows
    amplitude, error = np.asarray(rows.amplitude_nm), np.asarray(rows.error_nm)
    total = np.hypot(error, strain.model_error[:, None] * amplitude)
    used = np.asarray(rows.measured) & ~strain.set_aside[:, None]
    return objective.with_rows(error_nm=np.where(used, total, 1.0), measured=used)
