"""The energy of a tap as a function along a branch: shapes of measured curves, drifts, instruments without errors."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from afm_jax.cli.main import main
from afm_jax.saved import as_json, load
from fitting.tables.csv_text import TableError
from fitting.tables.table import write_table
from fitting.tapping_curves.result import Tapping
from fitting.tapping_curves.tapping import tapping
from fitting.tapping_curves.together import tapping_together
from tests.coverage_of_tapping import LEVERS, SHAPES, random_curve
from tests.strict_reading import strictly
from tests.tapping_truth_of_laws import (
    GRAPHITE,
    SHARP,
    Stated,
    Tip,
    Truth,
    curve_like_graphite,
    curve_of_energy,
    curve_of_law,
    table_of,
)

ONE_ENERGY_AJ = 5.53


def deviations(result: Tapping, truth: Truth, free_nm: float) -> np.ndarray:
    """Return by how many of its errors the energy is off, at all points of all branches."""
    curves = [branch.curve for branch in result.branches]
    true = [truth.at("energy_aj", one.amplitude_ratio, free_nm) for one in curves]
    return np.concatenate([(c.energy_aj - t) / c.energy_error_aj for c, t in zip(curves, true, strict=True)])


def one_energy(rows: int = 60, energy_aj: float = ONE_ENERGY_AJ, tip: Tip = Tip()) -> Truth:  # noqa: B008
    """Return a repulsive branch whose taps all take the same, on resonance."""
    return curve_of_energy(tip, np.linspace(0.9, 0.15, rows), np.full(rows, energy_aj), np.ones(rows, bool))


def test_a_curve_with_the_shape_of_measured_ones_has_its_energy_as_a_function(tmp_path: Path):
    truth = curve_like_graphite()
    table = table_of(GRAPHITE, truth, Stated(**SHARP), np.random.default_rng(1), free_rows=30)
    result = tapping(table, law=False)
    result.save(tmp_path / "tapping.json")
    assert str(load(tmp_path / "tapping.json")) == str(result)
    answer = as_json(result)
    assert answer["valid"]
    assert answer["energy_per_tap_aj"] is None
    assert "one energy for each branch does not describe the rows" in answer["energy_per_tap_reason"]
    # the instrument is that of statements and free rows, not the one that a constant would need
    assert answer["nuisances_of_one_energy"] == {}
    assert [(one["repulsive"], one["constant"]) for one in answer["branches"]] == [(False, False), (True, False)]
    for branch in answer["branches"]:
        along = {name: np.array(column) for name, column in branch["curve"].items()}
        assert np.all(np.diff(along["amplitude_ratio"]) >= 0.0)
        for name in ("energy", "virial"):
            true = truth.at(f"{name}_aj", along["amplitude_ratio"], 13.4)
            held = (along[f"{name}_low_aj"] < true) & (true < along[f"{name}_high_aj"])
            assert held.mean() > 0.9, name
        # the sign of the virial says which side it is
        assert (along["virial_aj"].mean() > 0.0) != branch["repulsive"]
    assert [round(one["amplitude_ratio"], 2) for one in answer["energies_at"]] == [0.95, 0.9, 0.8]
    (turn,) = [one for one in answer["hysteresis"] if one["change"] == "branch"]
    ratio = np.interp(turn["approach"]["offset_nm"], truth.height_nm, truth.amplitude_nm / 13.4)
    assert ratio == pytest.approx(0.912, abs=0.004)
    assert answer["largest_energy_aj"]["value"] == pytest.approx(12.0, rel=0.08)
    assert re.search(r"Energy of a tap: 1[12].\d+ \+- 0.\d+ aJ at 0.[78]\d of the free amplitude", str(result))


EXACT = Stated(frequency=1e-9, quality=1e-9, stiffness=1e-9, phase_noise_deg=0.2)


@pytest.mark.slow
@pytest.mark.parametrize("zero_known", [False, True])
def test_an_instrument_without_errors_has_usual_ones_and_ends_right_or_not_valid(zero_known: bool):  # noqa: FBT001
    truth, rng, widths = one_energy(), np.random.default_rng(25), []
    for _ in range(10):
        table = table_of(Tip(), truth, EXACT, rng, free_frequency_error_khz=None, quality_factor_error=None)
        frequency = table.free_frequency_khz * (1.0 + 2e-4 * rng.uniform(-1.0, 1.0))
        quality = (table.quality_factor or 0.0) * (1.0 + 0.05 * rng.uniform(-1.0, 1.0))
        zero = {"phase_zero_deg": (3.0 + 0.2 * rng.normal(), 0.2)} if zero_known else {}
        table = replace(table, calibration=table.calibration | zero)
        result = tapping(replace(table, free_frequency_khz=frequency, quality_factor=quality), law=False)
        answer = as_json(result)
        assert answer["assumed_errors"] == {"free_frequency_khz": 2e-4, "quality_factor": 0.05}
        assert np.mean(np.abs(deviations(result, truth, 40.0)) < 1.96) > 0.9
        assert result.valid == zero_known
        if result.energy["value"] is not None:
            low, high = result.energy["interval95"]
            assert low < ONE_ENERGY_AJ < high
            (branch,) = answer["branches"]
            # the branch says what the energy for all says
            assert branch["energy_aj"] == pytest.approx(result.energy["value"])
        low, high = result.energies_at[2]["interval95_aj"]
        widths.append((high - low) / ONE_ENERGY_AJ)
        if not zero_known:
            assert re.search("state the (zero of the phase|free frequency) to", answer["reasons"][0])
    # it is no emptiness that holds the truth
    assert not zero_known or np.median(widths) < 0.5


ISSUED = Stated(1e-12, 1e-12, 1e-12, 0.003, 0.2)
NOTHING_STATED: dict[str, Any] = {
    "free_frequency_error_khz": None,
    "quality_factor_error": None,
    "spring_constant_error_n_per_m": None,
    "calibration": {},
}


@pytest.mark.parametrize(
    ("shape", "lever", "largest_aj"),
    [
        ("a sqrt(1 - a)", "k 40", 3.0),
        ("graphite", "k 44", 12.0),
        pytest.param("saturation", "k 5.4", 5.0, marks=pytest.mark.slow),
        # a soft polymer
        pytest.param("a (1 - a)", "soft", 500.0, marks=pytest.mark.slow),
    ],
)
def test_a_course_of_the_energy_is_never_taken_for_an_error_of_the_frequency(shape: str, lever: str, largest_aj: float):
    """The free frequency is exactly as stated, its usual error 2e-4: a joint fit made 0.1 +- 0.5 of 3 aJ, and valid."""
    tip = LEVERS[lever] if lever in LEVERS else Tip(free_nm=100.0, quality=150.0, stiffness=40.0, frequency_khz=300.0)
    ratio = np.linspace(0.97, 0.3, 100)
    energy = largest_aj * SHAPES[shape](ratio) / SHAPES[shape](ratio).max()
    repulsive = ratio < (0.912 if shape == "graphite" else 1.0)
    truth = curve_of_energy(tip, ratio, energy, repulsive)
    table = table_of(tip, truth, ISSUED, np.random.default_rng(0), free_rows=30, **NOTHING_STATED)
    result = tapping(table, law=False)
    off = deviations(result, truth, tip.free_nm)
    assert np.mean(np.abs(off) < 1.96) > 0.92
    assert np.abs(off).max() < 4.0
    if not result.valid:
        assert re.search(
            r"only bracketed .*; state the .* \('# (phase_zero_deg|free_frequency_khz) = ", result.reasons[0]
        )
    # what it says to state makes it a measurement, and right
    known = replace(table, calibration={"phase_zero_deg": (3.0, 0.2)})
    sharp = tapping(known, law=False)
    off = deviations(sharp, truth, tip.free_nm)
    assert np.mean(np.abs(off) < 1.96) > 0.92
    assert sharp.valid, sharp.reasons
    by_frequency = tapping(replace(table, free_frequency_error_khz=1e-5 * tip.frequency_khz), law=False)
    assert np.mean(np.abs(deviations(by_frequency, truth, tip.free_nm)) < 1.96) > 0.92


def test_an_instrument_that_no_energy_allows_contradicts_the_curve():
    truth = one_energy()
    table = table_of(Tip(), truth, Stated(), np.random.default_rng(3), calibration={"phase_zero_deg": (3.0, 0.2)})
    # 6e-4 off with an error of 1e-5 both ways: on one side a tap would take less than nothing
    wrong = [
        tapping(replace(table, free_frequency_khz=90.0 * (1.0 + off), calibration={}), law=False)
        for off in (-6e-4, 6e-4)
    ]
    refused = [one for one in wrong if not one.valid]
    assert len(refused) == 1
    # that the sign of the phase may be the other is said before
    assert "the instrument contradicts the curve" in refused[0].why_not_functions
    # with the zero stated, statements contradict each other
    torn = tapping(replace(table, free_frequency_khz=90.0 * (1.0 + 2e-4)), law=False)
    assert "of its errors from what was given would be needed" in torn.reasons[0]


@pytest.mark.parametrize(("phase", "amplitude"), [(5.0, 0.0), (0.0, 0.03)])
def test_a_drift_along_the_rows_is_fitted_where_their_order_is_known_and_else_said(phase: float, amplitude: float):
    truth, stated = one_energy(40), Stated(stiffness=1e-4, phase_noise_deg=0.2)
    drifts = {"phase_drift_deg": phase, "amplitude_drift": amplitude, "back": truth}
    table = table_of(Tip(), truth, stated, np.random.default_rng(7), **drifts, rows_in_order_of_time=True)
    result = tapping(table, law=False)
    assert result.valid, result.reasons
    low, high = result.energy["interval95"]
    assert low < ONE_ENERGY_AJ < high
    assert np.mean(np.abs(deviations(result, truth, 40.0)) < 1.96) > 0.9
    assert result.functions is not None
    found = {one.kind: one for one in result.functions.nuisances}
    for name, true in (("phase_drift_deg", phase), ("free_amplitude_drift", amplitude)):
        assert abs(found[name].value - true) < 3.5 * found[name].standard_error
    blind = tapping(replace(table, rows_in_order_of_time=False), law=False)
    assert not blind.valid
    assert "# rows = in order of time" in blind.reasons[0]


def test_each_free_amplitude_has_an_energy_of_its_own():
    rng, stated = np.random.default_rng(3), Stated(*EXACT[:3])
    tips = {4.1: Tip(free_nm=40.0), 6.4: Tip(free_nm=60.0)}
    one, other = (table_of(tip, one_energy(40, energy, tip), stated, rng) for energy, tip in tips.items())
    both = {
        name: np.concatenate([value, getattr(other, name)])
        for name, value in vars(one).items()
        if isinstance(value, np.ndarray) and value.shape == one.offset_nm.shape
    }
    error = {"free_frequency_error_khz": 9e-4, "quality_factor_error": 2.0, "spring_constant_error_n_per_m": 0.05}
    result = tapping(replace(one, **both, **error), law=False)
    assert (result.valid, result.energy["value"]) == (True, None)
    assert "each drive has its own" in result.energy["reason"]
    for branch, true in zip(as_json(result)["branches"], tips, strict=True):
        low, high = branch["interval95_aj"]
        assert low < true < high


@pytest.mark.slow
@pytest.mark.long
def test_bands_hold_the_energies_of_random_curves():
    # `make energies` takes more of them, and an instrument that is known better; points of a curve are off together
    found = [random_curve(number, Stated(frequency=1e-4)) for number in range(1000, 1040)]
    assert {one.kind.split(" ")[0] for one in found} == {"law", "contact", "two"}
    off = np.abs(np.concatenate([one.points.energy for one in found]))
    assert np.mean(off < 1.96) > 0.9
    assert off.max() < 4.0
    assert np.median(off) < 1.2 * 0.6745
    changes = np.concatenate([one.hysteresis for one in found])
    assert len(changes) == 16
    assert np.abs(changes).max() < 2.0


@pytest.mark.slow
def test_curves_of_one_lever_share_frequency_and_q_and_tell_their_scatter(tmp_path: Path):
    truth, rng = curve_like_graphite(120), np.random.default_rng(4)
    lever: dict[str, Any] = {"free_frequency_khz": 344.604, "quality_factor": 233.0, "spring_constant_n_per_m": 44.0}
    lever |= {"free_frequency_error_khz": 0.005, "quality_factor_error": 5.0, "spring_constant_error_n_per_m": 2.0}
    tables, files = [], [tmp_path / f"{number}.csv" for number in range(4)]
    for number, path in enumerate(files):
        # curves of one lever that differ by 0.4 aJ on average at the top
        energy = truth.energy_aj * (1.0 + 0.04 * (number - 1.5))
        one = curve_of_energy(GRAPHITE, truth.amplitude_nm / 13.4, energy, truth.lag_deg < 90.0)
        stated = EXACT._replace(**SHARP)
        tables.append(table_of(GRAPHITE, one, stated, rng, free_rows=30, source=f"curve {number}", **lever))
        write_table(tables[-1], path)
    run = CliRunner().invoke(main, ["tapping", *map(str, files), "--no-law", "--json", "--out", str(tmp_path / "out")])
    assert run.exit_code == 0, run.stderr
    answer = strictly(run.stdout)
    together = answer["together"]
    assert (len(answer["curves"]), together["valid"]) == (4, True)
    for name in ("free_frequency_khz", "quality_factor"):
        assert len({round(one["functions"]["nuisances"][name]["value"], 9) for one in answer["curves"]}) == 1
    repulsive = next(one for one in together["branches"] if one["repulsive"])
    columns = ("energy_aj", "energy_scatter_aj", "energy_own_error_aj", "energy_common_error_aj")
    mean, scatter, own, common = (np.interp(0.85, repulsive["amplitude_ratio"], repulsive[name]) for name in columns)
    # 4 % steps scatter by 5.2 %, far beyond a curve's own errors
    assert scatter == pytest.approx(0.052 * mean, rel=0.2)
    assert own < 0.5 * scatter
    assert abs(mean - truth.at("energy_aj", np.array(0.85), 13.4)) < 2.0 * np.hypot(common, own)
    again = load(tmp_path / "out" / "together.json")
    assert str(again) == (tmp_path / "out" / "together.txt").read_text().rstrip("\n")
    assert {path.name for path in (tmp_path / "out").iterdir()} >= {"together.png", "together.html"}
    # not one lever
    with pytest.raises(TableError, match="states the Q as 150 \\+- 5"):
        tapping_together([tables[0], replace(tables[1], quality_factor=150.0)])


@pytest.mark.parametrize(("restitution", "viscous"), [(0.95, 0.0), (1.0, 1.0)])
def test_speeds_of_taps_are_those_of_the_law_that_made_them(restitution: float, viscous: float):
    tip = Tip(free_nm=80.0, ratio=1.05)

    def rebound(u: np.ndarray) -> np.ndarray:
        return np.sqrt(np.maximum((restitution * u) ** 2 - viscous * u - 0.3, 1e-6))

    truth = curve_of_law(tip, -80.0 * np.linspace(0.95, 0.12, 60), rebound)
    result = tapping(table_of(tip, truth, Stated(), np.random.default_rng(2)), law=False)
    assert result.speeds is not None
    u = result.speeds.approach_speed_nm_per_us
    known = np.isfinite(u)
    assert known.sum() > 40
    np.testing.assert_allclose(result.speeds.rebound_speed_nm_per_us[known], rebound(u[known]), rtol=0.05)
    assert result.law_allowed
