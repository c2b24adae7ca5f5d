"""How long fits take from the shell, with an empty and with a warm cache, and what each digit of a minimum costs."""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from afm_jax.accuracy.overview import overview_row
from afm_jax.bench.timing import progress
from fitting.fits.least_squares import Box, Searches, descended
from fitting.fits.objective import PLAIN, Objective, polish
from fitting.models import Problem, measurement_of
from fitting.parameters import model_parameters, paper_values
from fitting.tables.table import AmplitudeTable, write_table

_NOISE = 0.01
_OFF = 0.03
"""How far parameters are off where searches start, in turns up and down."""
_MOST = 300


def time_fits(models: Sequence[str], *, rows: int) -> list[dict[str, Any]]:
    """Fit a made table by each model twice, as a user would from the shell: with an empty cache, and again.

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
            seconds, processor, found = [], [], {}
            for _ in range(2):
                begin, used = time.perf_counter(), _of_programs_started()
                done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)  # noqa: S603
                seconds.append(time.perf_counter() - begin)
                processor.append(_of_programs_started() - used)
                # a law without delay is refused, which is right
                if done.returncode not in {0, 3}:
                    raise RuntimeError(f"the fit of {model} ended with {done.returncode}: {done.stderr.strip()}")
                found = json.loads(done.stdout)
            row = {"model": model, "rows": rows, "first_s": seconds[0], "first_processor_s": processor[0]}
            row |= {"warm_s": seconds[1], "warm_processor_s": processor[1]}
            measured.append(row | {key: found[key] for key in ("valid", "chi2", "degrees_of_freedom")})
    return measured


def _of_programs_started() -> float:
    """Return the processor time in seconds of programs that were started from here and have ended."""
    spent = os.times()
    return spent.children_user + spent.children_system


def minimum_accuracy(
    *, rows: int, settled: Sequence[float], tolerances: Sequence[float], repetitions: int
) -> dict[str, Any]:
    """Measure searches for the minimum of chi2, from one start, on a table without noise: the truth is known.

    The loss and the delay of the paper's contact are looked for (model "viscous+delay"); all searches share one
    compiled forward model.

    Args:
        rows: rows of the table.
        settled: estimated distances of chi2 to its minimum at which our own searches stop.
        tolerances: xtol, ftol and gtol of SciPy's `least_squares`.
        repetitions: of each time measurement.

    Returns:
        `rows` and `references` as in `afm_jax.accuracy.overview`; the error is the largest relative one of a parameter.
    """
    problem = Problem("viscous+delay", model_parameters("viscous+delay"))
    truth = np.array([paper_values("viscous+delay")[name] for name in problem.names])
    start = problem.coordinates(truth[None] * (1.0 + _OFF * (-1.0) ** np.arange(truth.size)))
    table = made_table(rows, noise=0.0)
    objective = Objective(measurement_of(table, problem), problem).following(problem.values(start)[0])

    def look(places: np.ndarray, _: np.ndarray) -> Searches:
        residual, jacobian = objective.linearise(places)
        return Searches(places, residual, jacobian, (residual**2).sum(axis=1))

    def marquardt(stop: float) -> np.ndarray:
        free = Box(np.full(truth.size, -np.inf), np.full(truth.size, np.inf), np.zeros(start.shape, bool))
        return descended(look, look(start, np.arange(1)), free, settled=stop, most=_MOST).place

    def lbfgs(stop: float) -> np.ndarray:
        return polish(objective, start, PLAIN, settled=stop, most=_MOST).coordinates

    def scipy(stop: float, jacobian: Any) -> np.ndarray:
        def residual(place: np.ndarray) -> np.ndarray:
            return objective.linearise(place[None])[0][0]

        return least_squares(residual, start[0], jac=jacobian, xtol=stop, ftol=stop, gtol=stop, method="lm").x[None]

    def slopes(place: np.ndarray) -> np.ndarray:
        return objective.linearise(place[None])[1][0]

    searches: list[tuple[str, Callable[[float], np.ndarray], Sequence[float]]] = [
        ("Levenberg-Marquardt", marquardt, settled),
        ("optax L-BFGS", lbfgs, settled),
        ("SciPy least_squares, our Jacobian", lambda stop: scipy(stop, slopes), tolerances),
        ("SciPy least_squares, differences", lambda stop: scipy(stop, "2-point"), tolerances),
    ]
    measured = []
    for method, search, stops in searches:
        progress(f"accuracy: fits, {method}")
        for stop in stops:
            found, seconds = problem.values(search(stop))[0], []
            for _ in range(repetitions):
                begin = time.perf_counter()
                search(stop)
                seconds.append(time.perf_counter() - begin)
            error = float(np.max(np.abs(found / truth - 1.0)))
            measured.append(overview_row("fits", method, f"tolerance {stop:g}", 1e6 * min(seconds), error))
    reference = {
        "error_of": "worst parameter, relative",
        "reference": "the law that made the table",
        "reference_error": 0.0,
    }
    return {"rows": measured, "references": {"fits": reference}}


def made_table(rows: int, *, seed: int = 0, noise: float = _NOISE) -> AmplitudeTable:
    """Return a table of orders 1 to 4 around resonance with the paper's law and delay and Q = 40 +- 1.

    Args:
        rows: how many.
        seed: of the noise.
        noise: relative; the errors that the table states are 1 % whatever it is.
    """
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
    noisy = exact * (1.0 + noise * np.random.default_rng(seed).standard_normal(exact.shape))
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
