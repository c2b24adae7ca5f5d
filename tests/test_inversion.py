"""Direct inversion of amplitudes and phases, against collisions of free tips and orbits in closed form."""

import dataclasses

import numpy as np
import pytest

from afm_jax.impact.law import ImpactLaw
from fitting.inversion.invert import Inversion, invert
from fitting.simulated.experiment import with_noise
from fitting.tables.csv_text import TableError
from fitting.tables.table import AmplitudeTable
from tests.contact_experiment import paper_collisions, paper_experiment
from tests.fit_tables import steady_readings, table_of

pytestmark = pytest.mark.slow
"""Each compiles programs of its own for a minute or more."""

SPEEDS = np.geomspace(30.0, 200.0, 60)


@pytest.fixture(scope="module")
def exact():
    return invert(paper_experiment().exact)


def noisy(seed: int, phase_deg: float) -> AmplitudeTable:
    """Return the bundled drives with 1 % noise, a phase error, and Q exactly known."""
    table = paper_experiment().exact
    errors = {"phase_error_deg": np.full(table.rows, phase_deg), "quality_factor_error": None}
    table = dataclasses.replace(table, **errors, remarks=())
    return with_noise(table, np.random.default_rng(seed).normal(size=(3, table.rows)))


def impacts(found: Inversion) -> np.ndarray:
    """Return approach speeds, rebound speeds and delays, shape (rows, 3)."""
    return np.stack([found.approach_speed_nm_per_us, found.rebound_speed_nm_per_us, found.collision_delay_us], axis=1)


def worst_law_error(found: Inversion) -> float:
    # the line, between and beyond the rows' speeds
    assert found.preferred == "viscous"
    line = found.lines["viscous"]
    rebound = np.sqrt(SPEEDS**2 - line.epsilon - line.slope * SPEEDS)
    return float(np.max(np.abs(rebound / paper_collisions(SPEEDS)[0] - 1.0)))


def law_table(law: ImpactLaw, quality_factor: float | None, rows) -> tuple[AmplitudeTable, np.ndarray]:
    """Return the amplitudes of a law's orbits, with 1 % and 0.1 degree as errors, and their speeds, shape (rows, 2)."""
    drives = np.array(rows).T
    readings = steady_readings(drives, law, quality_factor)
    phase = {"phase_deg": readings[:, 2], "phase_error_deg": np.full(len(rows), 0.1)}
    amplitude = readings[:, :2]
    return table_of(drives, amplitude, 0.01 * amplitude, quality_factor=quality_factor, **phase), readings[:, 3:]


LAW_ROWS = [
    (1, 177.3, 4.0, 1.0),
    (1, 180.0, 4.0, 0.0),
    (1, 183.6, 4.0, 0.0),
    (2, 349.2, 4.0, -1.0),
    (3, 545.4, 4.0, 0.0),
]


@pytest.mark.parametrize(("quality_factor", "count"), [(500.0, 5), (None, 4)])
def test_orbits_without_delay_are_inverted_exactly(quality_factor, count):
    table, speeds = law_table(ImpactLaw(0.95, 60.0), quality_factor, LAW_ROWS[:count])
    found = invert(table)
    # closed forms on both sides, nothing to correct for an impact that takes no time
    np.testing.assert_allclose(impacts(found)[:, :2], speeds, rtol=1e-7)
    np.testing.assert_allclose(found.collision_delay_us, 0.0, atol=1e-8)
    assert found.note == ("",) * count
    # u_out^2 = r^2 u_in^2 - epsilon is a straight line over (1, u_in^2)
    line = found.lines["restitution"]
    assert (line.epsilon, line.slope) == (pytest.approx(60.0, rel=1e-4), pytest.approx(1.0 - 0.95**2, rel=1e-4))


def test_one_amplitude_and_the_phase_suffice():
    table, speeds = law_table(ImpactLaw(0.95, 60.0), 40.0, LAW_ROWS)
    peak = dataclasses.replace(table, lockin_amplitude_nm=None, lockin_amplitude_error_nm=None)
    lockin = dataclasses.replace(table, peak_amplitude_nm=None, peak_amplitude_error_nm=None)
    for some in (peak, lockin):
        found = invert(some)
        np.testing.assert_allclose(impacts(found)[:, :2], speeds, rtol=1e-7)  # closed forms on both sides


def test_noise_free_contact_gives_the_free_collision(exact):
    """Compare with free tips on a sample at rest: another program than the driven scene behind the amplitudes."""
    assert np.isfinite(impacts(exact)).all()
    impact = impacts(exact)[exact.approach_speed_nm_per_us > 30.0]
    rebound, delay = paper_collisions(impact[:, 0])
    # what the corrections for a moving sample leave: most where the drive is weak and the tip slow
    for apart, most in ((np.abs(impact[:, 1] / rebound - 1.0), 5e-4), (np.abs(impact[:, 2] - delay), 1e-3)):
        assert np.median(apart) < 2e-5
        assert np.max(apart) < most
    # and so does the line
    assert worst_law_error(exact) < 1e-3
    # as fitted to free collisions, physics.md: 113.6 and 0.50; their values depend on the weights
    line = exact.lines["viscous"]
    assert line.epsilon == pytest.approx(113.6, rel=0.02)
    assert line.slope == pytest.approx(0.50, rel=0.1)
    assert not exact.in_lines.all()
    assert np.all(exact.approach_speed_nm_per_us[~exact.in_lines] < 27.0)


def test_laws_of_noisy_tables_are_close_and_error_bars_mean_what_they_say():
    pulls, errors = [], []
    for seed in range(12):
        result = invert(noisy(100 + seed, 0.1))
        assert result.valid
        errors.append(worst_law_error(result))
        used = result.in_lines
        u, step = result.approach_speed_nm_per_us[used], 0.01
        truth, lower, upper = (np.stack(paper_collisions(at)) for at in (u, u - step, u + step))
        # an error of u moves the truth along its curve
        along = np.zeros((2, u.size, 3))
        along[..., 0] = -(upper - lower) / (2.0 * step)
        along[0, :, 1] = along[1, :, 2] = 1.0
        variance = np.einsum("kni,nij,knj->kn", along, result.covariance[used], along)
        pulls.append((impacts(result)[used, 1:].T - truth) / np.sqrt(variance))
    assert np.median(errors) < 1e-3
    assert max(errors) < 1.5e-3
    found = np.concatenate(pulls, axis=1)
    # 650 pulls: the standard deviation is known to 3 %, the mean to 0.04
    np.testing.assert_allclose(found.std(axis=1), 1.0, atol=0.12)
    np.testing.assert_allclose(found.mean(axis=1), 0.0, atol=0.2)


def test_a_wrong_quality_factor_is_covered_by_its_error():
    table = dataclasses.replace(paper_experiment().exact, quality_factor=40.8, quality_factor_error=0.8)
    found = invert(table)
    true = invert(dataclasses.replace(table, quality_factor=40.0))
    shift = np.abs(impacts(found) - impacts(true))
    # to first order in 2 % of Q: the rows move by what they state
    np.testing.assert_allclose(np.abs(found.shared[:, 1, 0]), shift[:, 1], rtol=0.1, atol=1e-4)
    # and so does the line, no more than its errors
    line, exact = found.lines["viscous"], true.lines["viscous"]
    assert abs(line.epsilon - exact.epsilon) < 2.0 * line.epsilon_error
    alone = invert(dataclasses.replace(table, quality_factor_error=None)).lines["viscous"]
    assert alone.epsilon_error < line.epsilon_error


def test_calibration_of_the_instrument_is_taken_back(exact):
    table = paper_experiment().exact
    names = [f"{kind}_amplitude{error}_nm" for kind in ("peak", "lockin") for error in ("", "_error")]
    read = {name: 1.02 * np.asarray(getattr(table, name)) for name in names}
    known = {"tip_calibration": (1.02, 0.01), "drive_calibration": (0.5, 0.005), "offset_origin_nm": (0.3, 0.1)}
    known["phase_zero_deg"] = (4.0, 0.2)
    other = dataclasses.replace(
        table,
        **read,
        drive_amplitude_nm=2.0 * np.asarray(table.drive_amplitude_nm, float),
        offset_nm=table.offset_nm - 0.3,
        phase_deg=np.asarray(table.phase_deg) + 4.0,
        calibration=known,
    )
    found = invert(other)
    # the same numbers but for rounding
    np.testing.assert_allclose(impacts(found), impacts(exact), rtol=1e-7)
    assert {*found.shared_names} == {"quality_factor", *known}


def test_rows_that_give_nothing_are_named():
    table, _ = law_table(ImpactLaw(0.95, 60.0), 40.0, LAW_ROWS)
    amplitude, phase = np.array(table.peak_amplitude_nm), np.array(table.phase_deg)
    amplitude[1], phase[3] = 1e-3, np.nan
    other = dataclasses.replace(
        table,
        peak_amplitude_nm=amplitude,
        lockin_amplitude_nm=None,
        lockin_amplitude_error_nm=None,
        phase_deg=phase,
        phase_error_deg=np.where(np.isnan(phase), np.nan, 0.1),
    )
    found = invert(other)
    assert [bool(note) for note in found.note] == [False, True, False, True, False]
    assert found.note[1] == "no flight between two impacts has this amplitude and phase"
    assert found.note[3] == "no phase with an amplitude: nothing to invert"
    assert np.isnan(impacts(found)[[1, 3]]).all()
    with pytest.raises(TableError, match="no row has a phase with an amplitude; add the columns phase_deg"):
        invert(dataclasses.replace(table, phase_deg=None, phase_error_deg=None))
