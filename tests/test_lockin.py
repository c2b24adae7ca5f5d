"""Readings of traces, compared with closed forms, orbits of the law, and the scatter over seeds of the noise."""

import re

import numpy as np
import pytest

from fitting import TableError, Trace, lockin
from fitting.traces.fold import fit_harmonics
from fitting.traces.lockin import LockinResult, table_of
from fitting.traces.report import lockin_summary
from fitting.traces.trace import TraceSettings
from fitting.traces.verdict import TraceKind
from tests.lockin_traces import bounce, law_motion, noisy_bounce, orbit_heights, trace_of, trace_of_motion
from tests.package_scenes import bouncing

SEEDS = 40


def phase_apart(result: LockinResult, wanted_deg: float) -> float:
    """Return the phase's difference from the one wanted, modulo 360/N, in degrees."""
    assert result.phase_deg is not None
    turn = 360.0 / (result.order or np.nan)
    return float(np.mod(result.phase_deg - wanted_deg + turn / 2.0, turn) - turn / 2.0)


def noisy(height: np.ndarray, noise: float, seed: int = 1) -> np.ndarray:
    return height + noise * np.random.default_rng(seed).standard_normal(height.size)


def test_harmonics_are_those_of_least_squares():
    rng = np.random.default_rng(3)
    angle = np.sort(rng.uniform(0.0, 40.0, 300))
    height = rng.standard_normal(300)
    design = np.stack([np.exp(1j * k * angle) for k in range(-5, 6)], axis=1)
    wanted = np.linalg.lstsq(design, height + 0j, rcond=None)[0]
    found = fit_harmonics(angle, height, 5)
    # well-conditioned normal equations of 300 numbers of order 1
    np.testing.assert_allclose(found.coefficients, wanted[5:], rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(found(angle), (design @ wanted).real, rtol=0.0, atol=1e-11)
    for harmonic in (1, 3):
        weights = fit_harmonics(angle, height, 5, harmonic).weights(angle)
        np.testing.assert_allclose(weights @ height, wanted[5 + harmonic], rtol=0.0, atol=1e-12)


@pytest.mark.parametrize(("order", "rate"), [(1, 7.31), (2, 50.0), (5, 7.31)])
def test_a_bounce_in_closed_form(order: int, rate: float):
    drive = 181.8 * order
    time = 3.7 + np.arange(0.0, 200.0 * 1e3 / drive, 1.0 / rate)
    height, value = bounce(time, order=order, drive_khz=drive)
    result = lockin(trace_of(height, rate=rate, drive_khz=drive, start_us=3.7))
    assert (result.kind, result.order, result.impacts_per_period) == (TraceKind.STEADY, order, 1), result.verdict
    # a sextic around the top of a cosine misses 3e-7
    assert result.peak_amplitude_nm == pytest.approx(70.0, rel=3e-7)
    # the kink's harmonics beyond the fitted ones, falling as 1/k^2
    assert result.lockin_amplitude_nm == pytest.approx(abs(value), rel=1e-4)
    assert phase_apart(result, float(np.degrees(np.angle(value)))) == pytest.approx(0.0, abs=0.01)


@pytest.mark.parametrize(("reduced", "order"), [(1.01, 1), (2.02, 2), (5.1, 5)])
def test_orbits_of_the_law_with_damping_and_delay(reduced: float, order: int):
    scene = bouncing(reduced)
    drive = float(scene.platform.frequency_khz)
    time = np.arange(0.0, 120.0 * 1e3 / drive, 1.0 / 9.1)
    height, row = orbit_heights(scene, order, time)
    result = lockin(trace_of(noisy(height, 0.2, order), rate=9.1, drive_khz=drive, quality_factor=40.0, offset_nm=-1.0))
    assert (result.steady, result.order) == (True, order), result.verdict
    for name in ("peak_amplitude", "lockin_amplitude"):
        error = getattr(result, f"{name}_error_nm")
        # four standard errors, which are below 0.1 %
        assert abs(getattr(result, f"{name}_nm") - row[f"{name}_nm"]) < 4.0 * error < 4e-3 * row[f"{name}_nm"]
    assert abs(phase_apart(result, row["lockin_phase_deg"])) < 4.0 * (result.phase_error_deg or 0.0)
    # what any lock-in reads, whatever the order
    turns = np.arange(20_000) / 20_000 * order
    value = 2.0 * np.mean(orbit_heights(scene, order, turns * 1e3 / drive)[0] * np.exp(-2j * np.pi * turns))
    error = result.drive_lockin_amplitude_error_nm or np.inf
    assert abs((result.drive_lockin_amplitude_nm or 0.0) - abs(value)) < 4.0 * error < 0.2
    read = np.exp(1j * np.deg2rad(result.drive_lockin_phase_deg or 0.0))
    assert abs(np.angle(read / value, deg=True)) < 4.0 * (result.drive_lockin_phase_error_deg or 0.0)
    if order == 1:
        assert result.drive_lockin_amplitude_nm == result.lockin_amplitude_nm
    else:
        assert f"at the drive's {drive:.7g} kHz" in lockin_summary(result)
    assert result.noise_nm == pytest.approx(0.2, rel=0.1)


@pytest.mark.parametrize(("periods", "memory"), [(8.0, 0.0), (40.0, 0.7)])
def test_errors_are_the_scatter_over_seeds(periods: float, memory: float):
    pulls = []
    for seed in range(SEEDS):
        trace, value = noisy_bounce(seed, periods=periods, memory=memory)
        result = lockin(trace)
        assert result.steady, result.verdict
        found = (result.peak_amplitude_nm, result.lockin_amplitude_nm, phase_apart(result, np.degrees(np.angle(value))))
        errors = (result.peak_amplitude_error_nm, result.lockin_amplitude_error_nm, result.phase_error_deg)
        pulls.append((np.array(found) - (70.0, abs(value), 0.0)) / np.array(errors))
    spread = np.std(pulls, axis=0)
    # 40 seeds give the scatter to 11 %; errors from few periods scatter themselves, and sampling adds to them
    assert np.all(spread > 0.7)
    assert np.all(spread < 1.3)
    # four standard errors of a mean
    assert np.all(np.abs(np.mean(pulls, axis=0)) < 4.0 / np.sqrt(SEEDS))


@pytest.mark.parametrize(
    ("reduced", "r", "kind", "impacts", "order"),
    [
        (1.7, 0.6, TraceKind.STEADY, 1, 2),
        (1.3, 0.6, TraceKind.PERIOD_MULTIPLIED, 2, 2),
        (1.7, 0.9, TraceKind.SEVERAL_IMPACTS, 8, 12),
        (1.3, 0.9, TraceKind.NOT_PERIODIC, None, None),
    ],
)
def test_motions_of_the_law_are_told_apart(reduced, r, kind: TraceKind, impacts: int | None, order: int | None):
    scene, run = law_motion(reduced, r)
    # the simulation's own verdict, from its impacts
    assert (run.verdict.contacts, run.verdict.periods) == (impacts, order)
    result = lockin(trace_of_motion(scene, run, periods=150.0, rate=20.0, noise=0.02))
    assert (result.kind, result.impacts_per_period, result.order) == (kind, impacts, order), result.verdict
    assert result.steady == (kind is TraceKind.STEADY)
    assert (result.peak_amplitude_nm is None) == (kind is TraceKind.NOT_PERIODIC)


@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_what_is_no_steady_orbit_is_flagged(noise: float):
    time = np.arange(0.0, 800.0, 0.1)
    height, _ = bounce(time, order=1, drive_khz=181.8)
    cosine = np.cos(2e-3 * np.pi * 181.8 * time)
    for motion, kind in (
        (4.0 * cosine - 1.0, TraceKind.STUCK),
        (0.4 * cosine, TraceKind.NO_IMPACT),
        (0.0 * time, TraceKind.NO_RESPONSE),
        (height * (1.0 + 0.05 * time / time[-1]), TraceKind.DRIFTING),
        (height + 2.0 * time / time[-1], TraceKind.DRIFTING),
        (height * (1.0 + 0.01 * (-1.0) ** np.floor((time - 1.3) * 0.1818 + 0.5)), TraceKind.PERIOD_MULTIPLIED),
        (-height, TraceKind.UPSIDE_DOWN),
    ):
        result = lockin(trace_of(noisy(motion, noise), rate=10.0, drive_khz=181.8))
        assert (result.kind, result.steady) == (kind, False), result.verdict
        assert ("multiply it by -1" in result.verdict) == (kind is TraceKind.UPSIDE_DOWN)


def test_a_constant_and_another_drive_frequency_are_told():
    for constant in (0.0, -1e-300):
        result = lockin(trace_of(np.full(2000, constant), rate=10.0, drive_khz=181.8))
        assert (result.kind, result.scatter) == (TraceKind.NO_RESPONSE, 0.0)
        assert f"{constant:.4g} nm throughout" in result.verdict
    height, _ = bounce(np.arange(0.0, 800.0, 0.1), order=1, drive_khz=181.8)
    for share in (2e-4, 1e-2):
        result = lockin(trace_of(noisy(height, 0.3), rate=10.0, drive_khz=181.8 * (1.0 + share)))
        assert result.kind is TraceKind.DRIFTING
        # the phase over 145 periods fixes the frequency to 1e-5
        assert float(result.verdict.partition("seems to be ")[2].split()[0]) == pytest.approx(181.8, rel=2e-5)


@pytest.mark.parametrize("noise", [0.0, 0.3])
@pytest.mark.parametrize("quality", [5.0, 300.0])
def test_a_tip_that_rings_down_freely_is_told_with_its_quality_factor(quality: float, noise: float):
    time, omega = np.arange(0.0, 400.0, 0.1), 2e-3 * np.pi * 90.0
    tip = 50.0 * np.exp(-0.5 * omega / quality * time) * np.cos(omega * np.sqrt(1.0 - 0.25 / quality**2) * time)
    driven = 1.5 * np.cos(2e-3 * np.pi * 181.8 * time + 0.3)
    result = lockin(trace_of(noisy(tip + driven, noise, 2), rate=10.0, drive_khz=181.8))
    assert (result.kind, result.peak_amplitude_nm) == (TraceKind.RINGING, None)
    told = re.search(r"vibration of ([\d.]+) .*Q = ([\d.]*\d)", result.verdict)
    assert told is not None
    assert float(told[1]) == pytest.approx(90.0, rel=1e-3)
    # three digits are printed
    assert float(told[2]) == pytest.approx(quality, rel=0.02)


def test_impacts_are_counted_without_the_free_frequency_too():
    trace, _ = noisy_bounce(0, order=3)
    blind = lockin(trace_of(trace.deflection_nm, rate=5.3, drive_khz=545.4, free_frequency_khz=None))
    assert (blind.steady, blind.impacts_per_period, blind.free_frequency_origin) == (True, 1, "trace")
    # the bending at the top: a second derivative of noisy samples
    assert blind.free_frequency_khz == pytest.approx(90.0, rel=0.02)


@pytest.mark.parametrize("per_period", [27.5, 9.0 + 1.0 / 3.0, 6.2])
@pytest.mark.parametrize("noise", [0.0, 0.5])
def test_sampling_in_step_with_several_drive_periods_makes_no_subharmonics(per_period: float, noise: float):
    rate = 0.1818 * per_period
    time = np.arange(int(60 * per_period)) / rate
    height, _ = bounce(time, order=1, drive_khz=181.8)
    result = lockin(trace_of(noisy(height, noise, 2), rate=rate, drive_khz=181.8))
    assert (result.kind, result.order) == (TraceKind.STEADY, 1), result.verdict


def test_few_phases_in_step_with_the_drive_are_stated_as_an_error():
    time = np.arange(0.0, 40.0 * 1e3 / 181.8 - 1e-9, 1e3 / 181.8 / 8.0)
    height, value = bounce(time, order=1, drive_khz=181.8)
    result = lockin(trace_of(height, rate=8.0 * 0.1818, drive_khz=181.8))
    assert result.steady
    off = abs((result.lockin_amplitude_nm or 0.0) - abs(value))
    # aliasing is a bias: the stated error covers it, and is not ten times too large
    assert off < (result.lockin_amplitude_error_nm or 0.0) < 20.0 * off
    assert any("distinct phases" in warning for warning in result.warnings)


def test_the_reference_column_and_the_drive_phase_shift_the_phase():
    time = np.arange(0.0, 400.0, 0.1)
    height, value = bounce(time, order=2, drive_khz=363.6)
    wanted = float(np.degrees(np.angle(value))) - 50.0 / 2.0
    optional = lockin(trace_of(height, rate=10.0, drive_khz=363.6, drive_phase_deg=50.0))
    assert optional.phase_reference == "drive_phase_deg"
    assert phase_apart(optional, wanted) == pytest.approx(0.0, abs=0.01)

    def with_platform(platform: np.ndarray, *, in_nm: bool) -> LockinResult:
        columns = {"deflection_nm": height, "platform": platform, "platform_in_nm": in_nm}
        return lockin(Trace(start_us=0.0, step_us=0.1, settings=TraceSettings(drive_frequency_khz=363.6), **columns))

    platform = -1.0 + 4.0 * np.cos(2e-3 * np.pi * 363.6 * time + np.deg2rad(50.0))
    seen = with_platform(noisy(platform, 0.1, 4), in_nm=True)
    assert seen.phase_reference == "column"
    assert (seen.drive_amplitude_nm, seen.offset_nm) == (pytest.approx(4.0, rel=0.01), pytest.approx(-1.0, rel=0.01))
    error, least = seen.phase_error_deg or 0.0, optional.phase_error_deg or np.inf
    # noise of the reference: 0.1 sqrt(2/4000)/4 rad, halved by the order, beside what the deflection's sampling leaves
    assert np.sqrt(error**2 - least**2) == pytest.approx(np.degrees(0.1 * np.sqrt(2.0 / 4000.0) / 4.0) / 2.0, rel=0.1)
    assert abs(phase_apart(seen, wanted)) < 4.0 * error
    with pytest.raises(TableError, match=r"it has 364\.0.* kHz, but drive_frequency_khz is 363\.6"):
        with_platform(np.cos(2e-3 * np.pi * 364.0 * time), in_nm=False)


def test_an_expected_order():
    trace, _ = noisy_bounce(0, order=2)
    assert lockin(trace, order=2).steady
    other = lockin(trace, order=1)
    assert (other.kind, other.steady) == (TraceKind.OTHER_ORDER, False)
    with pytest.raises(TableError, match="too short for two response periods of order 40"):
        lockin(trace, order=40)


def test_traces_of_one_drive_are_one_row():
    time = np.arange(0.0, 200.0, 0.1)

    def read(seed: int, *, size: float = 1.0, drive: float = 181.8) -> LockinResult:
        height = noisy(size * bounce(time, order=1, drive_khz=drive)[0], 0.3, seed)
        return lockin(trace_of(height, rate=10.0, drive_khz=drive, offset_nm=-1.0))

    one, two, other, far = read(1), read(2), read(3, drive=183.0), read(4, size=1.2)
    table = table_of([one, two, one, other])
    assert table.drive_frequency_khz.tolist() == [181.8, 183.0]
    assert any("of one drive: one row, their mean" in remark for remark in table.remarks)
    columns = (table.lockin_amplitude_nm, table.lockin_amplitude_error_nm, table.phase_deg)
    size, error, phase = (np.asarray(column)[0] for column in columns)
    amplitudes = [result.lockin_amplitude_nm or 0.0 for result in (one, two)]
    assert min(amplitudes) < size < max(amplitudes)
    assert abs(size - abs(bounce(time, order=1, drive_khz=181.8)[1])) < 4.0 * error
    assert phase == pytest.approx(one.phase_deg or np.nan, abs=0.1)
    # two orbits of one drive: neither is the row
    table = table_of([one, far, other])
    assert table.drive_frequency_khz.tolist() == [183.0]
    assert any("contradict each other" in remark for remark in table.remarks)
    with pytest.raises(TableError, match=r"there is no row: .* contradict each other"):
        table_of([one, far])
