"""Example data that the project makes itself, and the scripts that make it."""

from pathlib import Path
from typing import Any

RAW_CURVE = Path(__file__).with_name("raw_tapping.txt")
RAW_CURVE_OPTIONS: dict[str, Any] = {
    "columns": "offset_nm=1/2:nm,lockin_amplitude_nm=5/6:V,phase_lag_deg=7/8:deg",
    "drive": "force",
    "nm_per_volt": "slope",
    "spring_constant_n_per_m": "44 +- 4",
    "quality_factor": "230 +- 5",
    "free_frequency_khz": "344.60 +- 0.01",
}
"""What its reader knows of the instrument: the arguments of `read_curves` for the raw curve."""
