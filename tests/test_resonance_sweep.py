"""Reading resonance sweeps in both forms."""

from pathlib import Path

import numpy as np
import pytest

from fitting import read_resonance
from fitting.calibration.sweep import Resonance

ROWS = ("89.5,1.25,60", "90,2.5,-3.5e1", "90.5,1.125,-120")
NANONIS = (
    "Experiment\tFrequency Sweep\t\nDate\t27.02.2023 14:26:53\t\nUser\t\t\nf_res (Hz)\t30281.5\t\nQ\t1161\t\n\n[DATA]\n"
    "Frequency Shift (Hz)\tCenter Frequency (Hz)\tAmplitude (m)\tPhase (deg)\tExcitation (V)\n"
    "-38.1000E+0\t30.2829E+3\t520.545E-12\t90.3060E+0\tx\n"
    "37.8013E+0\t30.2829E+3\t459.461E-12\t-39.6350E+0\tx\n"
)


def read(folder: Path, text: str) -> Resonance:
    path = folder / "sweep.txt"
    path.write_bytes(text.encode())
    return read_resonance(path)


@pytest.mark.parametrize("order", [(2, 1, 0), (1, 0, 2)])
def test_plain_columns_come_back_sorted(tmp_path, order):
    head = ["# driven at 20 mV", "#", "frequency_khz,amplitude_nm,phase_deg"]
    sweep = read(tmp_path, "\r\n".join([*head, *(ROWS[i] for i in order)]))
    columns = [[89.5, 90.0, 90.5], [1.25, 2.5, 1.125], [60.0, -35.0, -120.0]]
    np.testing.assert_array_equal([sweep.frequency_khz, sweep.amplitude, sweep.phase_deg], columns)
    assert sweep.amplitude_unit == "nm"
    assert not sweep.amplitude.flags.writeable


def test_hertz_and_amplitudes_of_any_unit(tmp_path):
    sweep = read(tmp_path, "amplitude, frequency_hz, amplitude_error\n0.5,30000,0.01\n1.5,30001.5,0.02\n")
    assert sweep.frequency_khz.tolist() == [30.0, 30.0015]
    assert (sweep.amplitude_unit, sweep.phase_deg) == ("", None)
    np.testing.assert_array_equal(sweep.amplitude_error, [0.01, 0.02])


def test_nanonis_text_comes_back(tmp_path):
    sweep = read(tmp_path, NANONIS)
    # sums and units of decimal numbers: to the rounding of the last bit
    assert sweep.frequency_khz == pytest.approx([30.2448, 30.3207013], rel=1e-14)
    assert sweep.amplitude == pytest.approx([0.520545, 0.459461], rel=1e-14)
    np.testing.assert_array_equal(sweep.phase_deg, [90.306, -39.635])
    assert sweep.instrument == {"frequency_khz": pytest.approx(30.2815, rel=1e-14), "quality_factor": 1161.0}
