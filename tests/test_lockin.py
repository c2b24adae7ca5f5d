"""Readings of traces, compared with closed forms, and the scatter over seeds of the noise."""

from pathlib import Path

import numpy as np
import pytest

from fitting import LockinResult, lockin, read_trace
from tests.lockin_traces import bounce, noisy_bounce

SEEDS = 40
DRIVE = 181.8


def phase_apart(result: LockinResult, wanted_deg: float) -> float:
    """Return the phase's difference from the one wanted, modulo 360/N, in degrees."""
    turn = 360.0 / result.order
    return float(np.mod(result.phase_deg - wanted_deg + turn / 2.0, turn) - turn / 2.0)


def noisy(height: np.ndarray, noise: float, seed: int = 1) -> np.ndarray:
    return height + noise * np.random.default_rng(seed).standard_normal(height.size)


@pytest.mark.parametrize(("order", "rate"), [(1, 7.31), (2, 50.0), (5, 7.31)])
def test_a_bounce_in_closed_form(order: int, rate: float):
    drive = DRIVE * order
    time = 3.7 + np.arange(0.0, 200.0 * 1e3 / drive, 1.0 / rate)
    height, value = bounce(time, order=order, drive_khz=drive)
    result = lockin(time, height, drive, order)
    assert result.valid, result.reasons
    # trapezia around the kink, at phases spread over the period: the square of the step, 7 steps a drive period
    assert result.lockin_amplitude_nm == pytest.approx(abs(value), rel=1e-3 if order == 5 else 2e-4)
    assert abs(result.lockin_amplitude_nm - abs(value)) < 3.0 * result.lockin_amplitude_error_nm
    assert phase_apart(result, float(np.degrees(np.angle(value)))) == pytest.approx(0.0, abs=0.05)


@pytest.mark.parametrize("order", [1, 2, 3, 4])
def test_harmonics_of_a_motion_are_read_and_nothing_beside_them(order: int):
    """Compare with Fourier's coefficients of |sin|, 4 A/(pi (4 k^2 - 1)): none at the drive over what is no divisor."""
    drive = 180.0 * order
    time = np.arange(0.0, 420.0 * 1e3 / drive, 0.013)
    # undamped half periods: no damping, the drive at twice the free frequency
    height, _ = bounce(time, order=order, drive_khz=drive)
    result = lockin(time, height, drive, order)
    assert result.valid, result.reasons
    for n, amplitude in zip(result.orders.tolist(), result.amplitudes_nm.tolist(), strict=True):
        wanted = 0.0 if order % n else 4.0 * 70.0 / (np.pi * (4.0 * (order // n) ** 2 - 1.0))
        # the square of 40 steps a period of the highest harmonic
        assert amplitude == pytest.approx(wanted, abs=0.03), n


@pytest.mark.parametrize(("periods", "memory"), [(14.0, 0.0), (40.0, 0.7)])
def test_errors_are_the_scatter_over_seeds(periods: float, memory: float):
    pulls = []
    for seed in range(SEEDS):
        time, height, value = noisy_bounce(seed, periods=periods, noise=0.3, memory=memory)
        result = lockin(time, height, DRIVE, 1)
        assert result.valid, result.reasons
        found = np.array([result.lockin_amplitude_nm - abs(value), phase_apart(result, np.degrees(np.angle(value)))])
        pulls.append(found / (result.lockin_amplitude_error_nm, result.phase_error_deg))
    spread = np.std(pulls, axis=0)
    # 40 seeds give the scatter to 11 %; errors from twelve blocks scatter themselves, and sampling adds to them
    assert np.all(spread > 0.6)
    assert np.all(spread < 1.4)
    # four standard errors of a mean
    assert np.all(np.abs(np.mean(pulls, axis=0)) < 4.0 / np.sqrt(SEEDS))


@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_what_is_not_periodic_at_the_order_is_flagged(noise: float):
    time = np.arange(0.0, 800.0, 0.1)
    height, _ = bounce(time, order=1, drive_khz=DRIVE)
    alternate = (-1.0) ** np.floor((time - 1.3) * DRIVE * 1e-3 + 0.5)
    for motion, said in (
        (0.0 * time, "no response at the drive's frequency"),
        (height * (1.0 + 0.1 * time / time[-1]), "parts of the trace differ by"),
        (height * (1.0 + 0.02 * alternate), "nm at the drive's frequency over 2, beside"),
    ):
        result = lockin(time, noisy(motion, noise), DRIVE, 1)
        assert not result.valid
        assert said in result.reasons[0]
    # another drive frequency
    assert "parts of the trace differ" in lockin(time, noisy(height, noise), DRIVE * 1.001, 1).reasons[0]
    # every drive period is alike: nothing is at half the drive's frequency
    assert not lockin(time, noisy(height, noise), DRIVE, 2).valid
    # fifths of the drive, doubled to tenths, which is no order from 1 to 8
    five, _ = bounce(time, order=5, drive_khz=5.0 * DRIVE)
    assert lockin(time, noisy(five, noise), 5.0 * DRIVE, 5).valid
    result = lockin(time, noisy(five * (1.0 + 0.02 * alternate), noise), 5.0 * DRIVE, 5)
    assert "nm at the drive's frequency over 10, beside" in result.reasons[0]


@pytest.mark.parametrize("per_period", [27.5, 9.0 + 1.0 / 3.0, 6.2])
@pytest.mark.parametrize("noise", [0.0, 0.5])
def test_sampling_in_step_with_several_drive_periods_makes_no_subharmonics(per_period: float, noise: float):
    rate = 1e-3 * DRIVE * per_period
    time = np.arange(int(60 * per_period)) / rate
    height, _ = bounce(time, order=1, drive_khz=DRIVE)
    others = lockin(time, noisy(height, noise, 2), DRIVE, 1)
    assert "beside" not in (others.reason or ""), others.reason


@pytest.mark.parametrize("sign", [",", "\t", ";", "  ", ", "])
@pytest.mark.parametrize(("unit", "size"), [("us", 1.0), ("s", 1e-6)])
def test_text_of_any_separator_is_read_back(tmp_path: Path, sign: str, unit: str, size: float):
    time, height, _ = noisy_bounce(1, periods=20.0)
    path = tmp_path / "trace.txt"
    rows = [f"{t * size!r}{sign}{z!r}" for t, z in zip(time.tolist(), height.tolist(), strict=True)]
    head = ["# drive_frequency_khz = 181.8", "# Tuesday's tip", f"time_{unit}{sign}deflection_nm"]
    path.write_text("\n".join([*head, *rows]), encoding="utf-8")
    trace = read_trace(path)
    assert trace.drive_frequency_khz == 181.8
    # units are powers of ten
    np.testing.assert_allclose(trace.time_us, time, rtol=1e-14)
    np.testing.assert_array_equal(trace.deflection_nm, height)
