"""How long fits take from the shell, with an empty and with a warm cache, and what each digit of a minimum costs."""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from afm_jax.accuracy.overview import overview_row
from afm_jax.least_squares import Box, Searches, descended
from afm_jax.studies.timing import progress, time_calls
from fitting.fits.objective import PLAIN, Objective, polish
from fitting.models import Problem, measurement_of
from fitting.parameters import model_parameters, paper_values
from fitting.tables.table import AmplitudeTable, write_table

DELAYED = "viscous+delay"
_NOISE = 0.01
_OFF = 0.03
"""How far parameters are off where searches start, in turns up and down."""
_MOST = 300


def time_fits(models: Sequence[str], *, rows: int, beside: Path | None = None) -> list[dict[str, Any]]:
    """Fit made tables twice each, as a user would from the shell: with an empty cache, and again.

    Args:
        models: names of models, or "tapping": a driven tip's curves by viscous+delay. The law has a table of its own,
            the others that of viscous loss with a delay.
        rows: rows of each table.
        beside: folder of another checkout of the project, whose fits are timed in turn with ours, in rows of their own.

    Raises:
        RuntimeError: if a command fails.
    """
    measured = []
    ours = Path(__file__).resolve().parents[1]
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        for name in models:
            model = DELAYED if name == "tapping" else name
            table = tapped_table(rows) if name == "tapping" else made_table(rows, model if model == "law" else DELAYED)
            write_table(table, place / "amplitudes.csv")
            command = ["fit", str(place / "amplitudes.csv"), "--model", model, "--json"]
            checkouts = {name: ours} if beside is None else {name: ours, f"{name} (beside)": beside}
            made: dict[str, dict[str, Any]] = {label: {"model": label, "rows": rows} for label in checkouts}
            for when in ("first", "warm"):
                for label, sources in checkouts.items():
                    seconds, processor, found = _timed(command, sources, place / "cache" / label)
                    made[label] |= {f"{when}_s": seconds, f"{when}_processor_s": processor}
                    made[label] |= {key: found[key] for key in ("valid", "chi2", "degrees_of_freedom")}
            measured += made.values()
    return measured


def _timed(command: Sequence[str], sources: Path, cache: Path) -> tuple[float, float, dict[str, Any]]:
    """Run a command of a checkout; return seconds, processor seconds, and the JSON object that it writes.

    Args:
        command: behind `afm-jax`.
        sources: folder of the checkout.
        cache: folder of compiled programs.

    Raises:
        RuntimeError: if the command fails.
    """
    environment = {name: value for name, value in os.environ.items() if name != "JAX_COMPILATION_CACHE_DIR"}
    environment |= {"XDG_CACHE_HOME": str(cache), "PYTHONPATH": str(sources)}
    cache.mkdir(parents=True, exist_ok=True)
    begin, used = time.perf_counter(), _of_programs_started()
    # from a folder without sources, which Python would take first
    done = subprocess.run(  # noqa: S603
        [sys.executable, "-m", "afm_jax", *command],
        env=environment,
        cwd=cache,
        capture_output=True,
        text=True,
        check=False,
    )
    seconds, processor = time.perf_counter() - begin, _of_programs_started() - used
    if done.returncode not in {0, 3}:
        raise RuntimeError(f"`afm-jax {' '.join(command)}` ended with {done.returncode}: {done.stderr.strip()}")
    return seconds, processor, json.loads(done.stdout)


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
    problem = Problem(DELAYED, model_parameters(DELAYED))
    truth = np.array([paper_values(DELAYED)[name] for name in problem.names])
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
            calls = time_calls(partial(search, stop), repetitions=repetitions)
            error = float(np.max(np.abs(problem.values(calls.result)[0] / truth - 1.0)))
            measured.append(overview_row("fits", method, f"tolerance {stop:g}", 1e6 * calls.best_s, error))
    reference = {
        "error_of": "worst parameter, relative",
        "reference": "the law that made the table",
        "reference_error": 0.0,
    }
    return {"rows": measured, "references": {"fits": reference}}


def made_table(rows: int, model: str = DELAYED, *, seed: int = 0, noise: float = _NOISE) -> AmplitudeTable:
    """Return a table of orders 1 to 4 around resonance with the paper's law, as a model has it, and Q = 40 +- 1.

    Args:
        rows: how many.
        model: a law, with delay or without.
        seed: of the noise.
        noise: relative; the errors that the table states are 1 % whatever it is.
    """
    problem = Problem(model, model_parameters(model))
    values = np.array([paper_values(model)[name] for name in problem.names])
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


def tapped_table(rows: int) -> AmplitudeTable:
    """Return curves of a driven tip of 16.8 ng above its resonance, by the paper's loss and delay; noise as read.

    Args:
        rows: how many.
    """
    mass = 16.81
    problem = Problem(DELAYED, model_parameters(DELAYED), drive="force")
    values = np.array([paper_values(DELAYED, mass)[name] for name in problem.names])
    count = 2 * rows
    free = np.array([60.0, 80.0, 100.0])[np.arange(count) % 3]
    share = np.linspace(0.9, 0.3, count)
    frequency = np.array([92.7, 93.6])[np.arange(count) // 3 % 2]
    draws = np.random.default_rng(0).standard_normal((2, rows))

    def read(some: np.ndarray, amplitude: np.ndarray, lag: np.ndarray) -> AmplitudeTable:
        return AmplitudeTable(
            drive="force",
            drive_frequency_khz=frequency[some],
            free_amplitude_nm=free[some],
            offset_nm=-(share * free)[some],
            lockin_amplitude_nm=amplitude,
            lockin_amplitude_error_nm=0.003 * amplitude,
            phase_lag_deg=lag % 360.0,
            phase_lag_error_deg=np.full(some.size, 0.2),
            free_frequency_khz=90.0,
            quality_factor=200.0,
            quality_factor_error=2.0,
            mass_ng=mass,
        )

    blank = measurement_of(read(np.arange(count), share * free, np.full(count, 5.0)), problem)
    found = Objective(blank, problem).at_values(values[None]).prediction
    there = np.flatnonzero(np.asarray(found.orbits)[0, :count] == 1)
    chosen = there[np.linspace(0, there.size - 1, rows).round().astype(int)]
    _, amplitude, lag = np.asarray(found.amplitude_nm)[0, chosen].T
    return read(chosen, amplitude * (1.0 + 0.003 * draws[0]), lag + 0.2 * draws[1])


def _columns(amplitude: np.ndarray) -> dict[str, Any]:
    peak, lockin = amplitude.T
    return {
        "peak_amplitude_nm": peak,
        "peak_amplitude_error_nm": _NOISE * peak,
        "lockin_amplitude_nm": lockin,
        "lockin_amplitude_error_nm": _NOISE * lockin,
    }
