"""The energy of a tap off a tapping curve: closed forms, simulated truths, thresholds, what is refused, the command."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

import fitting
from afm_jax.cli.main import main
from afm_jax.saved import as_json
from fitting.tables.csv_text import TableError
from fitting.tapping_curves.along import positive_bands, said_of
from fitting.tapping_curves.branches import changes, free_rows
from fitting.tapping_curves.curve import Given, Instrument, TappingCurve
from fitting.tapping_curves.energy import energies, largest_energies
from fitting.tapping_curves.lever import Lever
from fitting.tapping_curves.tapping import tapping
from tests.answers import answer
from tests.html_pages import first_screen, read_page
from tests.strict_reading import strictly
from tests.tapping_truth_of_laws import Stated, Tip, curve_of_energy, table_of

EXAMPLES = Path(fitting.__file__).parent / "examples"
EXAMPLE, REAL = EXAMPLES / "tapping_resonance.csv", EXAMPLES / "real"
ENERGY_AJ = 2.951
"""What a tap of the bundled curve takes by the ledger of its simulation (`fitting.examples.make_tapping`)."""
K, F0, Q = 5.4, 90.0, 200.0


def curve_of_rows(rows: int = 1, **changed: Any) -> TappingCurve:
    """Return rows of a lever on resonance, 40 nm free, with some of the columns changed; numbers fill a column."""
    columns = {"offset_nm": -20.0, "amplitude_nm": 20.0, "amplitude_error_nm": 0.1, "lag_deg": 90.0}
    columns |= {"lag_error_deg": 0.2, "free_amplitude_nm": 40.0, "drive_frequency_khz": F0, "retract": False}
    also = {name: value for name, value in changed.items() if name not in columns}
    return TappingCurve(
        **{name: np.broadcast_to(changed.get(name, value), rows).copy() for name, value in columns.items()},
        **{"source": "made", "drive": "force", "lines": np.arange(rows)} | also,
        free_frequency_khz=Given(F0),
        quality_factor=Given(Q),
        spring_constant_n_per_m=Given(K),
    )


def linear_curve(*, drive: str, s: float, damping: float = 0.02, stiffness: float = 0.3):
    """Return one row, the tip's amplitude and omega: a linear sample, its force -damping z' - stiffness z.

    The damping is in nN us/nm, the stiffness in nN/nm. Solved as m z'' + m Omega/Q (z' or lab) + k (z - z_b) = F + f.
    """
    omega, own = 2e-3 * np.pi * s * F0, 2e-3 * np.pi * F0
    mass = K / own**2
    free = K - mass * omega**2 + 1j * omega * mass * own / Q
    force = 40.0 * free
    height = force / (free + stiffness + 1j * omega * damping)
    seen, seen_free, reference = height, force / free, force
    if drive == "base":
        # the base's motion acts through the spring, the deflection is seen
        reference = force / K
        seen, seen_free = height - reference, seen_free - reference
    curve = curve_of_rows(
        drive=drive,
        amplitude_nm=abs(seen),
        lag_deg=np.degrees(np.angle(reference / seen)),
        free_amplitude_nm=abs(seen_free),
        drive_frequency_khz=s * F0,
    )
    return curve, abs(height), omega


@pytest.mark.parametrize("drive", ["force", "base"])
def test_energy_and_virial_of_a_linear_sample_are_the_closed_forms(drive: str):
    for s in (0.98, 1.0, 1.03, 1.1):
        curve, amplitude, omega = linear_curve(drive=drive, s=s)
        # the force of a linear sample has no harmonics
        at = Instrument(F0, Q, harmonics_factor=0.0)
        found = energies(curve, at)
        # the damper takes pi c omega A^2 a period, the spring's virial is -k_s A^2/2; rounding only
        np.testing.assert_allclose(found.energy_aj, np.pi * 0.02 * omega * amplitude**2, rtol=1e-9)
        np.testing.assert_allclose(found.virial_aj, -0.15 * amplitude**2, rtol=1e-9)
        assert largest_energies(curve, at)[0] >= found.energy_aj[0]


def test_the_air_takes_the_harmonics_of_a_brief_impact():
    n = np.arange(2, 41)
    curve = curve_of_rows(2, amplitude_nm=[20.0, 15.0], lag_deg=[70.0, 60.0])
    found = energies(curve, Instrument(F0, Q, harmonics_factor=0.8))
    force = np.abs(1j / Q * (40.0 - curve.amplitude_nm * np.exp(-1j * np.radians(curve.lag_deg - 90.0))))
    squares = 0.8 * (force / np.abs(1.0 - n[:, None] ** 2 + 1j * n[:, None] / Q)) ** 2
    np.testing.assert_allclose(
        found.harmonics_aj, np.pi * K / Q * np.sum(n[:, None] ** 2 * squares, axis=0), rtol=1e-12
    )


def test_bands_are_those_of_all_instruments_that_leave_energies_above_nothing():
    # one unknown x ~ N(0, 1) moves five energies to and fro; hardly a noise: x is cut where one of them is zero
    energy, by = np.array([4.0, 2.0, 1.0, 3.0, 0.5]), np.array([3.0, 2.5, 1.5, -1.0, 0.2])
    low, high, possible = positive_bands(energy, np.full(5, 1e-6), np.ones(5, bool), by[:, None])
    assert possible
    lowest, highest = -1.0 / 1.5, 3.0
    x = np.random.default_rng(0).normal(size=400_000)
    x = x[(x > lowest) & (x < highest)]
    for i in range(5):
        # the densest 95 % by counting: towards 0 the density grows up to the cut
        values = np.sort(energy[i] + by[i] * x)
        inside = round(0.95 * len(values))
        first = int(np.argmin(values[inside:] - values[:-inside]))
        np.testing.assert_allclose([low[i], high[i]], [values[first], values[first + inside]], atol=0.03 * abs(by[i]))
    # an energy that no instrument brings above nothing
    assert not positive_bands(np.array([1.0, -5.0]), np.full(2, 0.1), np.ones(2, bool), np.ones((2, 1)))[2]
    # two that would need opposite ones
    opposite = positive_bands(np.array([-2.0, -2.0]), np.full(2, 0.1), np.ones(2, bool), np.array([[1.0], [-1.0]]))
    assert not opposite[2]
    # first contact cannot say so
    assert positive_bands(np.array([1.0, -5.0]), np.full(2, 0.1), np.array([True, False]), np.ones((2, 1)))[2]
    assert [said_of(*ends) for ends in ((1.0, 2.9), (1.0, 3.1), (0.2, 3.0))] == ["measured", "bracket", "upper bound"]


def test_rows_in_contact_tell_nothing_of_the_instrument():
    table = made_curve(frequency_off=0.01)
    result = tapping(table, law=False)
    assert result.functions is not None
    found = {one.kind: one for one in result.functions.nuisances}
    assert found["free_frequency_khz"].value == pytest.approx(F0 + 0.01, rel=1e-12)
    assert found["free_frequency_khz"].standard_error == pytest.approx(0.01, rel=1e-3)
    # the zero is what f0 and Q leave of the free rows' lag: 2 Q df/f0, and their noise
    wanted = np.hypot(np.degrees(2.0 * Q * 0.01 / F0), 0.2 / np.sqrt(5.0))
    assert found["phase_zero_deg"].standard_error == pytest.approx(wanted, rel=0.01)
    # a zero that is stated tells f0; stated of two curves it counts once
    known = replace(table, calibration={"phase_zero_deg": (3.0, 0.2)})
    alone, both = (
        Lever([curve] * count, [result.rows.free] * count) for curve in [tapping(known).curve] for count in (1, 2)
    )
    errors = [lever.nuisances(0)[0].standard_error for lever in (alone, both)]
    wanted = F0 / (2.0 * Q) * np.radians(np.hypot(0.2, 0.2 / np.sqrt(5.0)))
    assert errors[0] == pytest.approx((wanted**-2.0 + 0.01**-2.0) ** -0.5, rel=0.02)
    assert errors[1] > 0.9 * errors[0]


TIP = Tip(stiffness=K, quality=Q, frequency_khz=F0)


def made_curve(seed: int = 0, *, noise: float = 0.003, phase_noise: float = 0.2, frequency_off: float = 0.0):
    """Return a table on resonance whose taps all take 3 aJ, with five free rows in front."""
    truth = curve_of_energy(TIP, np.linspace(0.9, 0.15, 16), np.full(16, 3.0), np.ones(16, bool))
    stated = Stated(1e-12, 1e-12, 1e-12, noise, phase_noise)
    errors = {"free_frequency_error_khz": 0.01, "quality_factor_error": 2.0, "calibration": {}}
    table = table_of(TIP, truth, stated, np.random.default_rng(seed), free_rows=5, **errors)
    return replace(table, free_frequency_khz=F0 + frequency_off, spring_constant_error_n_per_m=None)


@pytest.mark.slow
def test_noise_free_energy_is_the_one_put_in_even_with_the_frequency_off():
    # 10 Hz off turn the phase by 2.5 degrees; taken as given the mean is wrong by far
    result = tapping(made_curve(noise=1e-4, phase_noise=0.01, frequency_off=0.01))
    # the frequency is found back; Q is off by nothing: what is left is its prior's pull
    assert result.energy["value"] == pytest.approx(3.0, rel=3e-3)
    assert abs(result.rows.energy_aj[result.rows.used].mean() / 3.0 - 1.0) > 0.3
    assert result.fit is not None
    frequency = next(one for one in result.fit.nuisances if one.name == "free_frequency_khz")
    assert frequency.value == pytest.approx(F0, abs=1e-3)


def test_bundled_curve_gives_the_energy_of_the_simulations_ledger():
    # on resonance, k 5.4 N/m, 40 nm, 0.3 % and 0.2 degrees, the frequency 8 Hz and Q 0.75 % off: the truth within 5 %
    result = fitting.tapping(fitting.read_table(EXAMPLE))
    assert result.valid
    assert result.energy["value"] == pytest.approx(ENERGY_AJ, rel=0.05)
    low, high = result.energy["interval95"]
    assert low < ENERGY_AJ < high
    repulsive = result.rows.used & (np.array(result.rows.state) == "repulsive")
    assert result.rows.energy_aj[repulsive].mean() == pytest.approx(ENERGY_AJ, rel=0.05)
    # the law is refused, with what to record instead
    assert result.law is None
    assert "3 to 10 % above resonance" in (result.reason or "")
    assert "No impact law: driven at 1.000" in str(result)
    (branch,) = (one for one in result.hysteresis if one.change == "branch")
    assert branch.approach is not None
    assert branch.retract is not None
    # where the simulation jumps: between 38 and 36 nm on approach, 40 and 40.5 nm on retract
    assert -38.0 < branch.approach.offset_nm < -36.0
    assert -40.5 < branch.retract.offset_nm < -40.0
    assert {"attractive", "repulsive", "free", "held"} <= set(result.rows.state)


@pytest.mark.parametrize("width", [0.0, 3.0])
def test_thresholds_are_found_to_a_tenth_of_a_nanometre(width: float):
    # 0.6 % noise; the amplitude of a tip of 3.2 nm is lost at -1.03 nm and back at -1.03 - width, every 0.1 nm a row
    way = np.arange(-10.0, 5.0, 0.1)
    offset, retract = np.concatenate([way, way[::-1]]), np.repeat([False, True], len(way))
    rows, rng = len(offset), np.random.default_rng(2)
    amplitude = np.where(offset < np.where(retract, -1.03 - width, -1.03), 3.2, 0.05)
    read = {"amplitude_nm": amplitude * (1.0 + 0.006 * rng.normal(size=rows)), "amplitude_error_nm": 0.006 * amplitude}
    read |= {"lag_deg": np.nan, "lag_error_deg": np.nan, "free_amplitude_nm": 3.2}
    curve = curve_of_rows(rows, offset_nm=offset, retract=retract, **read)
    free = free_rows(curve)
    found = {one.change: one for one in changes(curve, free=free, repulsive=~free)}
    for change in ("contact", "half"):
        for end, wanted in ((found[change].approach, -1.03), (found[change].retract, -1.03 - width)):
            assert end is not None
            assert end.offset_nm == pytest.approx(wanted, abs=0.1)


def test_phases_of_another_sign_or_zero_are_told_by_the_free_rows():
    table = made_curve()
    assert table.phase_lag_deg is not None
    lag = table.phase_lag_deg
    known = replace(table, calibration=table.calibration | {"phase_zero_deg": (0.0, 1.0)}, phase_sense="")
    wanted = tapping(known, law=False)
    for other, said in ((-lag, "the phase leads"), (lag - 90.0, "zero is -90 degrees off")):
        found = tapping(replace(known, phase_lag_deg=other), law=False)
        np.testing.assert_allclose(found.rows.energy_aj, wanted.rows.energy_aj, atol=1e-9)
        assert any(said in one for one in found.assumptions)
    wrong = lag.copy()
    row = int(np.argmax(table.offset_nm * (np.asarray(table.lockin_amplitude_nm) > 0.6 * table.excitation_nm)))
    wrong[row] = 250.0
    for other, said in (
        (np.deg2rad(lag), "it is in radians; write degrees"),
        (wrong, r"lags by 250.0 degrees .*outside 0 to 180, as 1 of"),
    ):
        with pytest.raises(TableError, match=said):
            tapping(replace(known, phase_lag_deg=other), law=False)


def test_without_a_spring_constant_energies_are_over_it():
    table = replace(made_curve(), calibration={"phase_zero_deg": (3.0, 0.2)})
    found = tapping(replace(table, spring_constant_n_per_m=None, mass_ng=None), law=False)
    told = as_json(found)
    wanted = as_json(tapping(replace(table, spring_constant_error_n_per_m=1e-6), law=False))
    assert told["energy_per_tap_aj"] is None
    per_tap = told["energy_per_tap_over_k_nm2"]
    assert per_tap["value"] == pytest.approx(wanted["energy_per_tap_aj"]["value"] / K, rel=1e-3)
    for one, other in zip(told["branches"], wanted["branches"], strict=True):
        np.testing.assert_allclose(one["curve"]["energy_over_k_nm2"], np.array(other["curve"]["energy_aj"]) / K, 1e-2)
        assert "energy_aj" not in one["curve"]
    # m/k cancels in it
    assert told["epsilon_nm2_per_us2"]["value"] == pytest.approx(wanted["epsilon_nm2_per_us2"]["value"], rel=1e-3)
    text = str(found)
    assert re.search(r"Energy of a tap: [\d.]+ \+- [\d.]+ nm\^2 ", text)
    assert not re.search(r" eV|\d aJ", text)


def test_without_a_phase_there_is_a_bound():
    exact = {"spring_constant_error_n_per_m": 1e-6, "calibration": {"tip_calibration": (1.0, 1e-6)}}
    result = tapping(replace(made_curve(), phase_lag_deg=None, phase_lag_error_deg=None, **exact))
    assert (result.valid, result.energy["value"]) == (False, None)
    # pi k A0^2/(4 Q), the most that a tap can take on resonance, with 1 % of Q on top
    assert result.energy["interval95"] == (0.0, pytest.approx(np.pi * K * 40.0**2 / (4.0 * Q), rel=0.03))


@pytest.mark.slow
def test_command_prints_and_writes_the_report(tmp_path: Path):
    told = answer(tmp_path, "tapping", EXAMPLE)
    assert len(told["rows"]) == 64
    assert all(one["reason"].startswith("excluded") for one in told["set_aside"])
    page = read_page((tmp_path / "tapping.html").read_text(encoding="utf-8"))
    assert "VALID" in first_screen(page)
    assert len(list(page.iter("img"))) == len(list(tmp_path.glob("*.png"))) == 1


@pytest.mark.slow
def test_real_files_give_what_they_support():
    def told(name: str, *options: str) -> dict[str, Any]:
        result = CliRunner().invoke(main, ["tapping", str(REAL / name), "--json", *options])
        assert result.exit_code == 3
        return strictly(result.stdout)

    known = ("--free-frequency-khz", "264.1 +- 0.3", "--quality-factor", "400 +- 150", "--spring-constant", "40 +- 15")
    neasnom = told("tapping_approach_neasnom.txt", *known)
    # eight rows in contact, f0 known to more than its width: no energy, and no bracket that says more than that
    assert (neasnom["energy_per_tap_aj"], neasnom["law"]) == (None, None)
    assert neasnom["energy_per_tap_reason"]
    wsxm = told("tapping_amplitude_wsxm.f.curves", "--nm-per-volt", "slope")
    assert [one["curve"] for one in wsxm["refused"]] == [2, 3, 4]
    for curve in wsxm["curves"]:
        (half,) = (one for one in curve["hysteresis"] if one["change"] == "half")
        assert half["width_nm"][0] == pytest.approx(6.0, abs=0.2)
        assert curve["energy_per_tap_aj"]["kind"] == "upper bound"
        # pi k A0^2/(4 Q) at 3.16 nm, 5.34 N/m and Q 202, with the error of the slope on top
        assert 0.2 < curve["energy_per_tap_aj"]["interval95"][1] < 0.26
