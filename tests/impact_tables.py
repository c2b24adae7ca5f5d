"""Amplitude tables of any impact, of a contact or of a law that is in no family, without following scenes in time.

The impact is free to be what no fitted model is: a contact's table of speeds and delays, its loss changed at will.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.contact.contact import Contact
from afm_jax.contact.law_of_contact import tabulated
from afm_jax.impact.closure import OrbitProblem
from afm_jax.impact.lasting_impact import TabulatedImpact
from afm_jax.impact.orbits import steady_orbits
from fitting import read_table
from fitting.examples.make_contact_amplitudes import EXAMPLE
from fitting.infer.result import FitResult
from fitting.tables.table import AmplitudeTable
from tests.fit_tables import rows as some_rows
from tests.fit_tables import with_amplitudes

_TERMS = 96
"""Of series that hold a change of the loss a fifth of a decade wide."""


def drives() -> AmplitudeTable:
    """Return the bundled table of contact amplitudes, whose drives are taken, without its phases."""
    return dataclasses.replace(read_table(EXAMPLE), phase_deg=None, phase_error_deg=None)


def contact_impact(**parameters: Any) -> TabulatedImpact:
    """Return the impact of the paper's contact with other parameters, as long series as `with_loss` gives."""
    return with_loss(tabulated(Contact.paper(**parameters), jnp.asarray(1.0)), np.ones_like)


def with_loss(impact: TabulatedImpact, share: Callable[[np.ndarray], np.ndarray]) -> TabulatedImpact:
    """Return an impact whose loss is multiplied by a function of the approach speed in nm/us."""
    place = np.cos(np.pi * (np.arange(_TERMS) + 0.5) / _TERMS)
    far = 0.5 * (place + 1.0) * float(impact.end)
    u = np.sqrt(float(impact.lowest) ** 2 + (float(impact.scale) * np.sinh(far)) ** 2)
    loss, time = (np.polynomial.chebyshev.chebval(place, np.asarray(part)) for part in (impact.loss, impact.time))
    loss = loss * share(u)
    fitted = np.polynomial.chebyshev.chebfit(place, np.stack([loss, time], axis=1), _TERMS - 1)
    return dataclasses.replace(impact, loss=jnp.asarray(fitted[:, 0]), time=jnp.asarray(fitted[:, 1]))


def bump(middle: float, height: float = 0.4, decades: float = 0.2) -> Callable[[np.ndarray], np.ndarray]:
    """Return 1 with a bump around a speed, so many decades wide at half its height."""
    return lambda u: 1.0 + height * np.exp2(-((2.0 * np.log10(u / middle) / decades) ** 2))


def steady_amplitudes(table: AmplitudeTable, impact: TabulatedImpact) -> np.ndarray:
    """Return peak and lock-in amplitude (rows, 2) of the largest steady orbit of each row; NaN where there is none."""
    columns = (table.order, table.drive_frequency_khz, table.drive_amplitude_nm, table.offset_nm)
    cantilever = Cantilever(table.free_frequency_khz, table.quality_factor, table.mass_ng)
    found: Any = _orbits(cantilever, impact, *(jnp.asarray(column, float) for column in columns))
    steady, amplitude = np.asarray(found[0]), np.asarray(found[1])[:, :, :2]
    size = np.where(steady, amplitude[:, :, 0], -np.inf)
    found = amplitude[np.arange(table.rows), np.argmax(size, axis=1)]
    return np.where(np.any(steady, axis=1, keepdims=True), found, np.nan)


@jax.jit
def _orbits(cantilever, impact, *drives):
    def one(order, frequency_khz, amplitude_nm, offset_nm):
        platform = Platform(amplitude_nm, frequency_khz, offset_nm)
        found = steady_orbits(OrbitProblem(cantilever, platform, impact, order))
        return found.steady, found.amplitude_nm

    return jax.vmap(one)(*drives)


def measured(table: AmplitudeTable, exact: np.ndarray, noise: float, seed: int) -> AmplitudeTable:
    """Return rows with an orbit, read with a relative noise that is stated, and a Q that scatters by its error."""
    random = np.random.default_rng([seed, round(1e4 * noise)])
    there = np.isfinite(exact[:, 0])
    read = exact[there] * (1.0 + noise * random.normal(size=(int(there.sum()), 2)))
    error = table.quality_factor_error or 0.0
    scattered = (table.quality_factor or 0.0) + error * random.normal()
    return with_amplitudes(some_rows(table, there), read, noise * read, quality_factor=scattered)


def deviation(
    result: FitResult, impact: TabulatedImpact, slowest: float = 30.0, fastest: float = 200.0
) -> tuple[np.ndarray, np.ndarray]:
    """Return approach speeds that were measured, and how far the law is off there, in half-widths of its band."""
    known = result.rows.approach_speed_nm_per_us[result.rows.used]
    speeds = np.geomspace(max(slowest, np.nanmin(known)), min(fastest, np.nanmax(known)), 40)
    right = np.asarray(impact.speeds(jnp.asarray(speeds)).rebound)
    law = result.law
    columns = (law.rebound_speed_nm_per_us, law.rebound_low_nm_per_us, law.rebound_high_nm_per_us)
    fitted, low, high = (np.interp(speeds, law.approach_speed_nm_per_us, column) for column in columns)
    return speeds, np.where(right > fitted, (right - fitted) / (high - fitted), (fitted - right) / (fitted - low))
