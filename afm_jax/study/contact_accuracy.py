"""Error of a collision against the time it takes: solvers, tolerances, variables, precisions, SciPy.

Runs in a process of its own on one core. Errors are achieved ones, against a quadrature converged to rounding that is
none of the contestants; just above the capture speed, where a tip hardly leaves, they are shown apart.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from afm_jax.contact.accuracy_settings import SETTINGS, Setting
from afm_jax.contact.capture import capture_speed
from afm_jax.contact.collide import batch_of
from afm_jax.contact.collision import Collision, collision_of, go_through
from afm_jax.contact.contact import Contact
from afm_jax.contact.junction import find_junction
from afm_jax.study.adaptive_crossing import pass_adaptively, pass_in_time
from afm_jax.study.contact_benchmark import COARSER_REFERENCE, REFERENCE, speeds_of
from afm_jax.study.own_process import progress
from afm_jax.study.scipy_collision import scipy_collision
from afm_jax.study.timing import compiled_for, time_compiled

Row = dict[str, Any]
Outputs = dict[str, Float[np.ndarray, " tips"]]

_NEAR_CAPTURE = 1.001
_FEW = 8
_VISCOSITY_PA_S = 1.005e-3


def collide_accuracy(
    *,
    tolerances: Sequence[float],
    solvers: Sequence[str],
    accuracies: Sequence[float],
    steps: Sequence[int],
    batch: int,
    repetitions: int,
    scipy_speeds: Sequence[float],
) -> dict[str, Any]:
    """Measure error and time of collisions.

    Args:
        tolerances: of the adaptive solvers and of SciPy.
        solvers: Diffrax's, adaptive in the gap and in time.
        accuracies: which of `collide`'s settings to measure.
        steps: numbers of fixed steps a crossing.
        batch: how many speeds, from 12 to 200 nm/us.
        repetitions: of each time measurement.
        scipy_speeds: approach speeds of SciPy's tips.

    Returns:
        `rows` with method, variable (gap, time), setting, precision, microseconds_per_impact, compile_s,
        rebound_error and delay_error_us (largest over the batch), slope_error (of d u_out/d u_in and
        d u_out/d viscosity, relative), near_capture_error (rebound at 1.001 times the capture speed, relative);
        `reference_error`, and `settings`: the accuracies that `collide` offers.
    """
    bound = float(capture_speed(Contact.paper()))
    speeds = jnp.concatenate([jnp.asarray([_NEAR_CAPTURE * bound]), speeds_of(batch)])
    reference, coarser = (_outputs(_by_setting(setting), speeds) for setting in (REFERENCE, COARSER_REFERENCE))
    rows = []
    for method, settings in SETTINGS.items():
        for accuracy in (level for level in settings if level in accuracies):
            # one setting shows what 32 bits leave; more would show the same
            for precision in ("float64", "float32") if accuracy == 1e-6 else ("float64",):
                name = {"method": f"collide, {method}", "variable": "gap", "setting": f"accuracy {accuracy:g}"}
                run = _by_setting(settings[accuracy])
                row = _row(name, run, speeds.astype(precision), reference, repetitions)
                rows.append(row | {"precision": precision, "accuracy": accuracy})
    for solver in (name for name in solvers if name != "Kvaerno5"):
        for count in steps:
            name = {"method": f"{solver}, fixed steps", "variable": "gap", "setting": f"{count} + {count} steps"}
            setting = Setting("steps", count, count, 16, solver=solver)
            rows.append(_row(name, _by_setting(setting), speeds, reference, repetitions) | {"precision": "float64"})
    for variable, crossing in (("gap", pass_adaptively), ("time", pass_in_time)):
        for solver in (name for name in solvers if variable == "gap" or name != "Kvaerno5"):
            # an implicit method is two hundred times slower here: a few tips and loose tolerances show it
            few = solver == "Kvaerno5"
            chosen = [tolerance for tolerance in tolerances if tolerance >= 1e-5] if few else tolerances
            tips = {key: part[:_FEW] for key, part in reference.items()} if few else reference
            if chosen:
                rows += _adaptive(
                    crossing, variable, solver, (chosen, speeds[:_FEW] if few else speeds, tips, repetitions)
                )
    rows += _scipy(tolerances, scipy_speeds)
    errors = _errors(coarser, reference)
    return {"rows": rows, "reference_error": max(errors["rebound_error"], errors["delay_error_us"])}


def _by_setting(setting: Setting) -> Callable[[Contact, Array], Collision]:
    return lambda contact, speeds: batch_of(contact, 1.0, speeds, setting)


def _row(
    name: Row, run: Callable[[Contact, Array], Collision], speeds: Array, reference: Outputs, repetitions: int
) -> Row:
    progress("accuracy: " + ", ".join(name.values()))
    contact = jax.tree.map(lambda leaf: leaf.astype(speeds.dtype), Contact.paper())
    compiled = compiled_for(run, contact, speeds)
    timing, _ = time_compiled(compiled, contact, speeds, repetitions=repetitions)
    return {
        **name,
        "microseconds_per_impact": 1e6 * timing.best_s / speeds.shape[0],
        "compile_s": timing.compile_s,
        **_errors(_outputs(run, speeds), reference),
    }


def _outputs(run: Callable[[Contact, Array], Collision], speeds: Array) -> Outputs:
    found = jax.jit(lambda at: _values_and_slopes(run, at))(speeds)
    return {key: np.asarray(part, np.float64) for key, part in found.items()}


def _values_and_slopes(run: Callable[[Contact, Array], Collision], speeds: Array) -> dict[str, Array]:
    """Return rebound speeds, delays, and slopes of the rebound speed by speed and by viscosity."""
    dtype = speeds.dtype

    def rebound(factors):
        viscosity = _VISCOSITY_PA_S * factors[1]
        contact = jax.tree.map(lambda leaf: leaf.astype(dtype), Contact.paper(viscosity_pa_s=viscosity))
        result = run(contact, speeds * factors[0])
        return result.rebound_speed_nm_per_us, result.collision_delay_us

    at, unit = jnp.ones(2, dtype), jnp.eye(2, dtype=dtype)
    # both directions in one pass through the program
    (found, delay), (slopes, _) = jax.vmap(lambda along: jax.jvp(rebound, (at,), (along,)), out_axes=((None, None), 0))(
        unit
    )
    return {"rebound": found, "delay": delay, "by_speed": slopes[0], "by_viscosity": slopes[1]}


def _errors(found: Outputs, reference: Outputs) -> Row:
    relative = {key: np.abs(found[key] / reference[key] - 1.0) for key in ("rebound", "by_speed", "by_viscosity")}
    values = {
        "rebound_error": np.max(relative["rebound"][1:]),
        "delay_error_us": np.max(np.abs(found["delay"] - reference["delay"])[1:]),
        "slope_error": max(np.max(relative["by_speed"][1:]), np.max(relative["by_viscosity"][1:])),
        "near_capture_error": relative["rebound"][0],
    }
    return {key: float(value) if np.isfinite(value) else None for key, value in values.items()}


def _adaptive(crossing: Callable, variable: str, solver: str, measured: tuple[Any, ...]) -> list[Row]:
    """Measure an adaptive solver; its tolerance is an argument of one program, so that none is compiled twice."""
    tolerances, speeds, reference, repetitions = measured

    def one(contact, speed, tolerance):
        junction = find_junction(contact)
        mass = jnp.ones_like(speed)
        finest = SETTINGS["diffrax"][1e-11]
        ways = go_through(contact, junction, speed, mass, finest, lambda way: crossing(way, solver, tolerance))
        return collision_of(contact, junction, speed, mass, ways)

    def run(contact, speeds, tolerance):
        return jax.vmap(one, in_axes=(None, 0, None))(contact, speeds, tolerance)

    contact = Contact.paper()
    compiled = compiled_for(run, contact, speeds, jnp.asarray(tolerances[0]))
    slopes = jax.jit(lambda tolerance: _values_and_slopes(lambda c, u: run(c, u, tolerance), speeds))
    rows = []
    for tolerance in tolerances:
        progress(f"accuracy: {solver}, adaptive in the {variable}, {tolerance:g}")
        timing, _ = time_compiled(compiled, contact, speeds, jnp.asarray(tolerance), repetitions=repetitions)
        found = {key: np.asarray(part) for key, part in slopes(jnp.asarray(tolerance)).items()}
        rows.append(
            {
                "method": f"{solver}, adaptive",
                "variable": variable,
                "setting": f"tolerance {tolerance:g}",
                "precision": "float64",
                "tolerance": tolerance,
                "microseconds_per_impact": 1e6 * timing.best_s / speeds.shape[0],
                "compile_s": timing.compile_s,
                **_errors(found, reference),
            }
        )
    return rows


def _scipy(tolerances: Sequence[float], speeds: Sequence[float]) -> list[Row]:
    contact = Contact.paper()
    reference = batch_of(contact, 1.0, jnp.asarray(speeds), REFERENCE)
    rows = []
    for method in ("DOP853", "LSODA"):
        for tolerance in tolerances:
            progress(f"accuracy: SciPy {method}, {tolerance:g}")
            name = {"method": f"SciPy {method}", "variable": "time", "setting": f"tolerance {tolerance:g}"}
            row = {**name, "precision": "float64", "tolerance": tolerance, "slope_error": None}
            try:
                runs = [scipy_collision(contact, speed, method=method, rtol=tolerance) for speed in speeds]
            except ValueError as failure:
                rows.append(row | {"microseconds_per_impact": None, "rebound_error": None, "reason": str(failure)})
                continue
            rebound = np.array([run.rebound_speed_nm_per_us for run in runs])
            delay = np.array([run.collision_delay_us for run in runs])
            rows.append(
                row
                | {
                    "microseconds_per_impact": 1e6 * float(np.mean([run.seconds for run in runs])),
                    "rebound_error": float(np.max(np.abs(rebound / np.asarray(reference.rebound_speed_nm_per_us) - 1))),
                    "delay_error_us": float(np.max(np.abs(delay - np.asarray(reference.collision_delay_us)))),
                    "evaluations_per_impact": float(np.mean([run.evaluations for run in runs])),
                }
            )
    return rows


def cheapest_collision(rows: Sequence[Row], accuracy: float) -> Row | None:
    """Return the fastest float64 contestant with errors within an accuracy: of u_out, and ten times it of the delay."""
    good = [
        row
        for row in rows
        if row["precision"] == "float64"
        and row.get("rebound_error") is not None
        and row["rebound_error"] <= accuracy
        and row["delay_error_us"] is not None
        and row["delay_error_us"] <= 10.0 * accuracy
    ]
    return min(good, key=lambda row: row["microseconds_per_impact"], default=None)
