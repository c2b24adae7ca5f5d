"""Lag or lead, and from which zero: curves of a simulated tip stored in four ways, as tables and as recordings."""

from collections.abc import Callable
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from afm_jax.cli.main import main
from fitting import read_curve
from fitting.instruments.curve import table_text
from fitting.instruments.lag import PhaseSense
from fitting.tables.table import AmplitudeTable, parse_table, write_table
from fitting.tapping_curves.result import Tapping
from fitting.tapping_curves.tapping import curve_of, tapping, with_sense_of_phase
from tests.instrument_files import separated
from tests.strict_reading import strictly
from tests.tapping_truth_of_forces import RATIOS, SAMPLES, curve_of_force
from tests.tapping_truth_of_laws import Stated, Tip, Truth, table_of

STATED = Stated(frequency=1e-5, quality=0.005, stiffness=0.01, noise=0.002, phase_noise_deg=0.15)
STORED: dict[str, tuple[float, Callable[[np.ndarray, float], np.ndarray]]] = {
    "lag": (1.0, lambda lag, _: lag),
    "lead": (-1.0, lambda lag, _: -lag),
    "zeroed on the free tip": (1.0, lambda lag, free: lag - free),
    "free minus lag": (-1.0, lambda lag, free: free - lag),
}
"""What becomes of a lag, given the free tip's, and the sign that brings it back."""


def measured(tip: Tip, truth: Truth, stored: str = "lag", **also) -> AmplitudeTable:
    """Return a curve of which nothing is stated of the phase, stored in one of the four ways."""
    table = table_of(tip, truth, STATED, np.random.default_rng(3), free_rows=60, phase_sense="", **also)
    lag = np.asarray(table.phase_lag_deg)
    return replace(table, phase_lag_deg=STORED[stored][1](lag - 3.0, tip.free_reading[1]))


def recorded(tip: Tip, table: AmplitudeTable, folder: Path, **options: Any) -> AmplitudeTable:
    """Return the same curve as an instrument's file that knows no more than its channels, read back."""
    columns = {"Z (nm)": table.offset_nm, "Amp (nm)": table.lockin_amplitude_nm, "Phase (deg)": table.phase_lag_deg}
    path = folder / "curve.csv"
    path.write_text(separated({name: np.asarray(column) for name, column in columns.items()}), "utf-8")
    lever = {
        "drive": tip.drive,
        "drive_frequency_khz": tip.ratio * tip.frequency_khz,
        "free_amplitude_nm": tip.free_reading[0],
        "free_frequency_khz": (table.free_frequency_khz, table.free_frequency_error_khz),
        "quality_factor": (table.quality_factor, table.quality_factor_error),
        "spring_constant_n_per_m": (table.spring_constant_n_per_m, table.spring_constant_error_n_per_m),
    }
    return parse_table(table_text(read_curve(path, **(lever | options))), "curve")


def sense_of(table: AmplitudeTable) -> PhaseSense:
    """Return what is known of the sense of a table's phase."""
    return with_sense_of_phase(curve_of(table), table.phase_sense).phase


def rows_off(result: Tapping, truth: Truth) -> np.ndarray:
    """Return by how many of their errors the energies of rows of taps are off."""
    rows, heights = result.rows, result.curve.offset_nm - result.curve.offset_nm[-1]
    off = heights[:, None] - (truth.height_nm - truth.height_nm[-1])
    near = np.argmin(np.abs(off), axis=1)
    here = (np.min(np.abs(off), axis=1) < 1e-3) & ~rows.free & np.isfinite(rows.energy_aj)
    lever = result.functions.lever
    by, covariance = lever.slopes(result.curve, 0, lever.minimum.at)[0], lever.minimum.covariance
    shared = np.einsum("nu,uv,nv->n", by, covariance, by) + (result.curve.relative_error * rows.energy_aj) ** 2
    error = np.sqrt(rows.energy_noise_aj**2 + shared)
    return ((rows.energy_aj - truth.energy_aj[near]) / error)[here]


def outcome(tip: Tip, truth: Truth, sign: float, result: Tapping) -> str:
    """Return what is said of a curve, having checked that it is right, marked as assumed, or refused with a remedy."""
    sense = result.curve.phase
    if sense.origin == "unknown":
        assert tip.ratio != 1.0
        assert not result.valid
        assert 'say `phase_sense="lag|lead"`' in result.reasons[0]
        return "refused"
    if sense.origin == "assumed":
        assert tip.ratio == 1.0
        assert any("which is assumed" in note for note in sense.notes)
        text = str(result)
        assert "repulsive?" in text or "attractive?" in text
    else:
        assert sense.sign == sign
        assert "repulsive?" not in str(result)
    off = rows_off(result, truth)
    assert len(off) > 20
    # harmonics of a lasting impact are not quite those assumed
    assert np.percentile(np.abs(off), 90.0) < 3.0
    return "assumed" if sense.assumed else "right"


CASES = [(*case, 150.0, "force") for case in product(SAMPLES, RATIOS)]
CASES += [pytest.param(*case, 400.0, "base", marks=pytest.mark.slow) for case in product(SAMPLES, RATIOS)]


@pytest.mark.parametrize(("sample", "ratio", "quality", "drive"), CASES)
def test_a_phase_is_taken_right_or_as_assumed_or_the_curve_refused(
    sample: str, ratio: float, quality: float, drive: str, tmp_path: Path
):
    tip, truth = curve_of_force(sample, quality, ratio, drive)
    for stored, (sign, _) in STORED.items():
        table = measured(tip, truth, stored)
        sense = sense_of(table)
        said = "refused" if sense.reason else "assumed" if sense.assumed else "right"
        assert said != "right" or sense.sign == sign
        # the energies of the other three are of the same lags
        if stored == "free minus lag":
            assert outcome(tip, truth, sign, tapping(table, law=False)) == said
        # what is known of the sense does not depend on who reads the curve
        of_file = recorded(tip, table, tmp_path)
        again = sense_of(of_file)
        assert again.assumed == (said != "right")
        assert bool(again.reason) == (said == "refused")
        if ratio > 1.0:
            assert said == "right"
        if said == "right":
            # the frequency that is stated is off by 1e-5 and turns the free lag by half a degree
            assert of_file.phase_lag_deg is not None
            np.testing.assert_allclose(of_file.phase_lag_deg, _true_lag(tip, table, sign), atol=2.0)
        # who says it needs no curve that decides
        stated = sense_of(replace(table, phase_sense="lag" if sign > 0.0 else "lead"))
        assert (stated.sign, stated.origin, stated.reason) == (sign, "stated", "")


def _true_lag(tip: Tip, table: AmplitudeTable, sign: float) -> np.ndarray:
    lag = sign * np.asarray(table.phase_lag_deg)
    return lag - np.median(lag[:60]) + tip.free_reading[1]


def test_a_curve_that_is_attracted_where_it_should_be_repelled_has_its_phase_turned():
    # on resonance energies are the same; attraction reaches farther than repulsion
    tip, truth = curve_of_force("attractive", 150.0, 1.0, "force")
    table = measured(tip, truth)
    mirrored = replace(table, phase_lag_deg=180.0 - np.asarray(table.phase_lag_deg))
    right, turned = tapping(table, law=False), tapping(mirrored, law=False)
    assert (right.curve.phase.origin, turned.curve.phase.origin, turned.curve.phase.sign) == ("order", "order", -1.0)
    assert right.rows.state == turned.rows.state
    assert {"attractive", "repulsive"} <= set(right.rows.state)
    outer = [state for state in right.rows.state if state != "free"][:3]
    assert outer == ["attractive"] * 3


def test_a_sign_that_the_curve_contradicts_is_refused():
    tip, truth = curve_of_force("repulsive", 150.0, 1.03, "force")
    assert "was stated to lead, but" in sense_of(replace(measured(tip, truth), phase_sense="lead")).reason
    # a lever whose frequency is another one: neither sign will do
    wrong = replace(measured(tip, truth), free_frequency_khz=300.0 * 1.029, mass_ng=None)
    assert not tapping(wrong, law=False).valid


def test_the_option_that_decides_is_named_and_decides(tmp_path: Path):
    tip, truth = curve_of_force("repulsive", 150.0, 0.99, "force")
    path = tmp_path / "table.csv"
    write_table(measured(tip, truth, "free minus lag"), path)
    call = ["tapping", str(path), "--no-law", "--json"]
    refused = CliRunner().invoke(main, call)
    assert refused.exit_code == 3
    assert "--phase-sense lag|lead" in refused.stderr
    told = strictly(CliRunner().invoke(main, [*call, "--phase-sense", "lead"]).stdout)
    assert (told["phase_sense"]["origin"], told["phase_sense"]["sign"]) == ("stated", -1)
