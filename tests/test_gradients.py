"""Derivatives of predicted amplitudes: closed forms, extrapolated differences, refusals."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.contact.contact import Contact
from afm_jax.contact.law_of_contact import tabulated
from afm_jax.impact.closure import OrbitProblem
from afm_jax.impact.law import CollisionDelay, ImpactLaw
from afm_jax.impact.orbits import steady_orbits
from fitting import amplitude_gradients
from fitting.gradients import (
    AT_A_FOLD,
    GRAZE_ON_THE_WAY,
    NO_ORBIT,
)
from fitting.tables.table import AmplitudeTable
from tests import fit_tables
from tests.reference_examples import scene
from tests.reference_flight import constants, platform
from tests.reference_observables import pieces
from tests.reference_orbits import single_impact_orbits

pytestmark = pytest.mark.slow
"""Each compiles programs of its own for a minute or more."""

DELAYED = {"r": 0.9999, "epsilon": 114.0, "delay_hertz": 0.206, "delay_lead_nm": 5.64, "delay_offset_nm": 0.6}
DELAYED |= {"quality_factor": 40.0, "tip_calibration": 1.1, "drive_calibration": 0.98, "offset_origin_nm": 0.05}
LAW = {"r": 0.98, "epsilon": 100.0, "quality_factor": 38.0}
NUISANCES = ("quality_factor", "tip_calibration", "drive_calibration", "offset_origin_nm")
CONTACT = {"relative_humidity": 0.5, "viscosity_pa_s": 1.005e-3, "modulus_gpa": 100.0, "quality_factor": 40.0}
ROWS = ((1, 181.8, 4.0, -1.0), (1, 185.4, 3.0, 1.0), (2, 363.6, 4.0, 0.0), (1, 177.3, 4.0, 0.0), (3, 531.9, 2.0, 0.5))


def table_of(*rows: tuple[int, float, float, float], quality_factor: float | None = 40.0) -> AmplitudeTable:
    """Return a table of drives with amplitudes that are measured badly: they do not matter where there is one orbit."""
    amplitude = np.tile([100.0, np.nan], (len(rows), 1))
    return fit_tables.table_of(zip(*rows, strict=True), amplitude, 0.5 * amplitude, quality_factor=quality_factor)


def impact_of(model: str, law: dict[str, Any]) -> Any:
    """Return what an impact does: the package's own law, or a contact's table."""
    if model == "contact":
        return tabulated(Contact.paper(**law), jnp.asarray(1.0))
    delay = CollisionDelay(law["delay_hertz"], law["delay_lead_nm"], law["delay_offset_nm"])
    return ImpactLaw(law["r"], law["epsilon"], delay=delay)


@partial(jax.jit, static_argnames=("names", "model"))
def amplitudes_at(values, rows, names: tuple[str, ...], model: str):
    """Return peak and lock-in amplitude of the one steady orbit of every row, from `afm_jax` alone."""
    known = dict(zip(names, values, strict=True))
    quality, tip, drive, origin = (known.pop(name, 1.0) for name in NUISANCES)
    cantilever, impact = Cantilever(90.0, quality), impact_of(model, known)

    def one(row):
        order, frequency, amplitude, offset = row
        platform = Platform(drive * amplitude, frequency, offset + (origin if "offset_origin_nm" in names else 0.0))
        orbits = steady_orbits(OrbitProblem(cantilever, platform, impact, order))
        return orbits.steady.sum(), tip * orbits.amplitude_nm[jnp.argmax(orbits.steady), :2]

    return jax.vmap(one)(rows)


def extrapolated(model: str, values: dict[str, float]) -> np.ndarray:
    """Return the derivatives from amplitudes of `afm_jax` alone: central differences, extrapolated twice."""
    names, point = tuple(values), np.array(list(values.values()))
    columns = []
    for index, value in enumerate(point):
        # in thousandths of what it acts on: a length in nm, or itself
        step = 2e-3 * max(abs(value), 0.5 if names[index].endswith("_nm") else 0.0)
        if names[index] == "r":
            step = 0.4 * (1.0 - value)
        shifts = step * np.array([1.0, -1.0, 0.5, -0.5, 0.25, -0.25])
        sets = point + shifts[:, None] * np.eye(len(point))[index]
        found = [amplitudes_at(one, jnp.array(ROWS), names, model) for one in sets]
        assert all(np.all(np.asarray(count) == 1) for count, _ in found)
        amplitude = np.array([amplitude for _, amplitude in found])
        slopes = [(amplitude[2 * i] - amplitude[2 * i + 1]) / (2.0 * shifts[2 * i]) for i in range(3)]
        better = [(4.0 * slopes[i + 1] - slopes[i]) / 3.0 for i in range(2)]
        columns.append((16.0 * better[1] - better[0]) / 15.0)
    return np.stack(columns, axis=-1)


@pytest.mark.parametrize("r", [0.99, 0.5])
def test_on_resonance_it_is_the_closed_form(r):
    """V' = W (1 + r)/(1 - r), W ~ sqrt(beta^2 - sigma^2), without damping or adhesion: d ln V'/dr = 2/(1 - r^2)."""
    table = table_of((1, 180.0, 3.0, 1.0), (2, 360.0, 2.0, -0.5), quality_factor=None)
    values = {"r": r, "tip_calibration": 1.0, "drive_calibration": 1.0, "offset_origin_nm": 0.0}
    found = amplitude_gradients(table, "restitution", values)
    assert found.parameters == ("r", "offset_origin_nm", "tip_calibration", "drive_calibration")
    beta, sigma = np.asarray(table.drive_amplitude_nm, float), table.offset_nm
    square = beta**2 - sigma**2
    peak = 2.0 * table.order * np.sqrt(square) * (1 + r) / (1 - r)
    relative = np.stack([np.full(2, 2 / (1 - r**2)), -sigma / square, np.ones(2), beta**2 / square], axis=-1)
    # the closing condition loses 1/(1 - r) of its digits
    np.testing.assert_allclose(found.predicted_nm[:, 0], peak, rtol=1e-10)
    np.testing.assert_allclose(found.gradient[:, 0], peak[:, None] * relative, rtol=1e-9)
    np.testing.assert_allclose(found.gradient[:, 1], found.predicted_nm[:, 1, None] * relative, rtol=1e-9)


@pytest.mark.parametrize(("model", "values"), [("law+delay", DELAYED), ("contact", CONTACT)])
@pytest.mark.long
def test_it_agrees_with_extrapolated_differences_of_orbits_searched_for(model, values):
    found = amplitude_gradients(table_of(*ROWS), model, values)
    expected = extrapolated(model, {name: values[name] for name in found.parameters})
    assert found.reasons == (None,) * len(ROWS)
    # relative to the largest derivative of its kind
    off = (found.gradient - expected) / np.abs(expected).max(axis=(0, 1))
    np.testing.assert_allclose(off, 0.0, atol=2e-6)


def test_without_an_orbit_it_says_so():
    found = amplitude_gradients(table_of(ROWS[0], (1, 181.8, 0.1, 0.0)), "law", LAW)
    assert found.reasons == (None, NO_ORBIT)
    assert np.isnan(found.predicted_nm[1]).all()
    assert np.isnan(found.gradient[1]).all()
    assert np.isfinite(found.gradient[0]).all()


def cut_off(frequency_khz: float) -> float:
    """Return the smallest drive in nm that keeps an orbit, by bisection."""
    low, high = 0.2, 4.0
    for _ in range(7):
        drives = np.linspace(low, high, 32)
        found = amplitude_gradients(table_of(*((1, frequency_khz, drive, 0.0) for drive in drives)), "law", LAW)
        first = int(np.argmax(np.isfinite(found.predicted_nm[:, 0])))
        low, high = drives[first - 1], drives[first]
    return high


def test_at_a_fold_it_is_refused_and_close_by_it_grows_as_it_must():
    """Two roots that meet part as the square root of the distance: four times closer, the slope is twice as steep."""
    last = cut_off(181.8)
    drives = last * (1.0 + np.array([1e-9, 1e-5, 4e-5, 1e-2]))
    values = LAW | {"drive_calibration": 1.0}
    found = amplitude_gradients(table_of(*((1, 181.8, drive, 0.0) for drive in drives)), "law", values)
    assert found.reasons == (AT_A_FOLD, None, None, None)
    assert np.isfinite(found.predicted_nm).all()
    assert np.isnan(found.gradient[0]).all()
    near, farther = np.abs(found.gradient[1:3, 0, found.parameters.index("drive_calibration")])
    # the next term is smaller by the root of the distance, 0.6 %, times a number
    assert near / farther == pytest.approx(2.0, rel=0.05)


def test_a_graze_on_the_way_is_refused():
    row = (1, 125.38983050847457, 1.0, 0.1875)
    rows = [(*row[:3], row[3] + shift) for shift in (0.0, -0.02, -0.1)]
    found = amplitude_gradients(table_of(*rows), "restitution", {"r": 0.5})
    lowest = [lowest_gap_on_the_way(row, 0.5) for row in rows]
    # the drive's amplitude is 1 nm
    assert lowest[0] < 1e-3 < lowest[1] < lowest[2]
    assert found.reasons == (GRAZE_ON_THE_WAY, None, None)


def lowest_gap_on_the_way(row: tuple[int, float, float, float], r: float) -> float:
    """Return the smallest gap between tip and platform in the flight's middle, from the reference's orbit."""
    order, frequency, amplitude, offset = row
    system = scene(frequency / 180.0, amplitude_nm=amplitude, offset_nm=offset, r=r, epsilon=0.0)
    (orbit,) = [o for o in single_impact_orbits(system, order) if o.stable and o.admissible]
    k = constants(system, np)
    start = float(orbit.phase_rad) / k.drive
    times = float(orbit.flight_time_us) * np.linspace(0.0, 1.0, 20001)
    (_, _, height), _ = pieces(k, order, start, float(orbit.velocity_after_nm_per_us), times[-1])
    gap = height(start + times) - platform(k, start + times, np)[0]
    inside = (gap[1:-1] < gap[:-2]) & (gap[1:-1] < gap[2:])
    return float(gap[1:-1][inside].min())
