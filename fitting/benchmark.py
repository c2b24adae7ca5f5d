"""How long fits take from the shell: whole commands, with an empty and with a warm compilation cache."""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fitting.fits.objective import Objective
from fitting.models import Problem, measurement_of
from fitting.parameters import model_parameters, paper_values
from fitting.tables.table import AmplitudeTable, write_table

_NOISE = 0.01


def time_fits(models: Sequence[str], *, rows: int) -> list[dict[str, Any]]:
    """Fit a made table by each model twice, as a user would from the shell.

    Args:
        models: names of models.
        rows: rows of the table.

    Raises:
        RuntimeError: if a command fails.
    """
    measured = []
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        write_table(made_table(rows), place / "amplitudes.csv")
        for model in models:
            environment = {name: value for name, value in os.environ.items() if name != "JAX_COMPILATION_CACHE_DIR"}
            environment["XDG_CACHE_HOME"] = str(place / "cache" / model)
            command = [
                sys.executable,
                "-m",
                "afm_jax",
                "fit",
                str(place / "amplitudes.csv"),
                "--model",
                model,
                "--json",
            ]
            seconds, found = [], {}
            for _ in range(2):
                begin = time.perf_counter()
                done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)  # noqa: S603
                seconds.append(time.perf_counter() - begin)
                # a law without delay is refused, which is right
                if done.returncode not in {0, 3}:
                    raise RuntimeError(f"the fit of {model} ended with {done.returncode}: {done.stderr.strip()}")
                found = json.loads(done.stdout)
            row = {"model": model, "rows": rows, "first_s": seconds[0], "warm_s": seconds[1]}
            measured.append(row | {key: found[key] for key in ("valid", "chi2", "degrees_of_freedom")})
    return measured


def made_table(rows: int, *, seed: int = 0) -> AmplitudeTable:
    """Return a table of orders 1 to 4 around resonance with the paper's law and delay, 1 % noise and Q = 40 +- 1."""
    problem = Problem("viscous+delay", model_parameters("viscous+delay"))
    values = np.array([paper_values("viscous+delay")[name] for name in problem.names])
    place = np.arange(4 * rows)
    order = place % 4 + 1
    drive: dict[str, Any] = {
        "order": order,
        "drive_frequency_khz": 180.0 * order * np.linspace(0.975, 1.025, 4 * rows),
        "drive_amplitude_nm": np.array([2.0, 4.0, 7.0, 10.0])[(place // 4) % 4],
        "offset_nm": np.array([-1.0, 0.0, 1.0])[(place // 16) % 3],
    }
    cantilever: dict[str, Any] = {"free_frequency_khz": 90.0, "quality_factor": 40.0}
    blank = AmplitudeTable(**drive, **cantilever, **_columns(np.ones((4 * rows, 2))))
    found = Objective(measurement_of(blank, problem), problem).at_values(values[None]).prediction
    # every one of them is there and far from capture
    good = (np.asarray(found.orbits)[0] == 1) & (np.asarray(found.approach_speed_nm_per_us)[0] > 30.0)
    chosen = np.flatnonzero(good[: 4 * rows])
    chosen = chosen[np.linspace(0, chosen.size - 1, rows).round().astype(int)]
    exact = np.asarray(found.amplitude_nm)[0][chosen]
    noisy = exact * (1.0 + _NOISE * np.random.default_rng(seed).standard_normal(exact.shape))
    kept = {name: column[chosen] for name, column in drive.items()}
    return AmplitudeTable(**kept, **cantilever, quality_factor_error=1.0, **_columns(noisy))


def _columns(amplitude: np.ndarray) -> dict[str, Any]:
    peak, lockin = amplitude.T
    return {
        "peak_amplitude_nm": peak,
        "peak_amplitude_error_nm": _NOISE * peak,
        "lockin_amplitude_nm": lockin,
        "lockin_amplitude_error_nm": _NOISE * lockin,
    }
