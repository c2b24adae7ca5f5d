"""Error of a collision against the time it takes: solvers, tolerances, variables, precisions, SciPy.

Runs in a process of its own on one core. Errors are achieved ones, against a quadrature converged to rounding that is
none of the contestants; just above the capture speed, where a tip hardly leaves, they are shown apart. Diffrax takes
part twice: over the gap, where the crossing's own equations (`afm_jax.contact.bridge_leg`) are solved with error
control, and in time, where gap and rate are the state, the phase is frozen, and Diffrax's events end the crossing.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
from jaxtyping import Array, Float

from afm_jax.bench.collisions import COARSER_REFERENCE, REFERENCE, speeds_of
from afm_jax.bench.integrators import title
from afm_jax.bench.scipy_contacts import scipy_collision
from afm_jax.bench.timing import compiled_for, progress, time_compiled
from afm_jax.contact.bridge_leg import Passage, Way, nothing_spent, way_rates
from afm_jax.contact.collide import Collision, batch_of, capture_speed, collision_of, three_parts
from afm_jax.contact.contact import Contact
from afm_jax.contact.junction import Junction, find_junction
from afm_jax.contact.settings import SETTINGS, Setting

SOLVERS = {
    "Tsit5": diffrax.Tsit5,
    "Dopri5": diffrax.Dopri5,
    "Dopri8": diffrax.Dopri8,
    "Kvaerno5": diffrax.Kvaerno5,
}
_MAX_STEPS = 4096
_LONGEST_US = 4.0
"""Just above the capture speed a contact lasts 0.9 us; a tip that an inexact solver keeps would go on for ever."""


def pass_adaptively(way: Way, solver: str, tolerance: Float[Array, ""]) -> Passage:
    """Return the passage of one tip in the gap, with step sizes controlled to a tolerance."""
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(lambda share, state, _: way_rates(way, share, state)),
        SOLVERS[solver](),
        0.0,
        1.0,
        None,
        nothing_spent(way),
        stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance),
        adjoint=diffrax.ForwardMode(),
        max_steps=_MAX_STEPS,
        throw=False,
    )
    assert solution.ys is not None  # noqa: S101 (for the type checker: the end is saved)
    return way.end(*(part[-1] for part in solution.ys))


def pass_in_time(way: Way, solver: str, tolerance: Float[Array, ""]) -> Passage:
    """Return the passage of one tip in time, ended by an event at the far threshold."""
    bridge, mass = way.tip.bridge, way.tip.mass_ng
    start, end = (way.along(jnp.full_like(way.total_aj, share)).gap_nm for share in (0.0, 1.0))

    def field(time: Any, state: Any, args: Any) -> Any:
        del time, args
        gap, rate = state
        safe = jnp.maximum(gap, 0.05)
        return rate, (bridge.force(safe) - bridge.damping(safe) * rate) / mass

    def reached(t: Any, y: Any, args: Any, **extra: Any) -> Any:
        del t, args, extra
        return way.sense * (y[0] - end)

    kinetic = way.total_aj - way.tip.potential(start)
    rate = -way.sense * jnp.sqrt(2.0 * jnp.maximum(kinetic, 1e-12) / mass)
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(field),
        SOLVERS[solver](),
        0.0,
        _LONGEST_US,
        None,
        (start, rate),
        stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance),
        event=diffrax.Event(reached, optimistix.Newton(1e-12, 1e-12)),
        adjoint=diffrax.ForwardMode(),
        max_steps=_MAX_STEPS,
        throw=False,
    )
    assert solution.ys is not None  # noqa: S101 (for the type checker: the end is saved)
    assert solution.ts is not None  # noqa: S101
    left = 0.5 * mass * solution.ys[1][-1] ** 2
    return Passage(left, solution.ts[-1], way.total_aj - way.end_potential_aj - left)


Row = dict[str, Any]
Outputs = dict[str, Float[np.ndarray, " tips"]]

_NEAR_CAPTURE = 1.001
_FEW = 9
_VISCOSITY_PA_S = 1.005e-3
_IMPLICIT = "Kvaerno5"
_CROSSINGS = {"gap": pass_adaptively, "time": pass_in_time}
# what is not timed need not run fast: it compiles in two thirds of the time
_UNHURRIED = {"xla_backend_optimization_level": 0}


def collide_accuracy(
    *,
    tolerances: Sequence[float],
    solvers: Mapping[str, Sequence[str]],
    accuracies: Sequence[float],
    steps: Sequence[int],
    batch: int,
    repetitions: int,
    integrators: Sequence[Sequence[Any]],
) -> dict[str, Any]:
    """Measure error and time of collisions.

    Args:
        tolerances: of the adaptive solvers and of the integrators.
        solvers: Diffrax's, by the variable they step in (gap, time); those in the gap also with fixed steps.
        accuracies: which of `collide`'s settings to measure.
        steps: numbers of fixed steps a crossing.
        batch: how many speeds, from 12 to 200 nm/us.
        repetitions: of each time measurement.
        integrators: methods of general-purpose ones to compare with (see `Integrator`), approach speeds of their tips.

    Returns:
        `rows` with method, variable (gap, time), setting, precision, microseconds_per_impact (of the batch), compile_s,
        rebound_error and delay_error_us (largest over the batch), slope_error (of d u_out/d u_in and
        d u_out/d viscosity, relative), near_capture_error (rebound at 1.001 times the capture speed, relative);
        `reference_error`: how far the reference is converged.
    """
    bound = float(capture_speed(Contact.paper()))
    speeds = jnp.concatenate([jnp.asarray([_NEAR_CAPTURE * bound]), speeds_of(batch)])
    reference = _outputs(_by_setting(REFERENCE), speeds)
    rows = [
        *_settings(accuracies, speeds, reference, repetitions),
        *_fixed_steps(solvers["gap"], steps, speeds, reference, repetitions),
    ]
    for variable, names in solvers.items():
        for solver in names:
            rows += _adaptive((variable, solver), tolerances, speeds, reference, repetitions)
    # one program tells how far the reference is converged and what SciPy should find
    every_speed = jnp.concatenate([speeds, jnp.asarray(integrators[1])])
    coarser = batch_of(Contact.paper(), 1.0, every_speed, COARSER_REFERENCE)
    rebound, delay = (np.asarray(part, float) for part in (coarser.rebound_speed_nm_per_us, coarser.collision_delay_us))
    tips = slice(1, speeds.size)
    reference_error = max(
        np.max(np.abs(rebound[tips] / reference["rebound"][1:] - 1.0)),
        np.max(np.abs(delay[tips] - reference["delay"][1:])),
    )
    methods, tips_of = integrators
    rows += _integrators(methods, tips_of, tolerances, (rebound[speeds.size :], delay[speeds.size :]))
    return {"rows": rows, "reference_error": float(reference_error)}


def _settings(accuracies: Sequence[float], speeds: Array, reference: Outputs, repetitions: int) -> Iterator[Row]:
    for method, settings in SETTINGS.items():
        for accuracy in (level for level in settings if level in accuracies):
            # one setting shows what 32 bits leave; more would show the same
            for precision in ("float64", "float32") if accuracy == 1e-6 else ("float64",):
                name = {"method": f"collide, {method}", "variable": "gap", "setting": f"accuracy {accuracy:g}"}
                row = _row(name, _by_setting(settings[accuracy]), speeds.astype(precision), reference, repetitions)
                yield row | {"precision": precision, "accuracy": accuracy}


def _fixed_steps(
    solvers: Sequence[str], steps: Sequence[int], speeds: Array, reference: Outputs, repetitions: int
) -> Iterator[Row]:
    for solver in (name for name in solvers if name != _IMPLICIT):
        for count in steps:
            name = {"method": f"{solver}, fixed steps", "variable": "gap", "setting": f"{count} + {count} steps"}
            setting = Setting("steps", count, count, 16, solver=solver)
            yield _row(name, _by_setting(setting), speeds, reference, repetitions) | {"precision": "float64"}


def _by_setting(setting: Setting) -> Callable[[Contact, Array], Collision]:
    return lambda contact, speeds: batch_of(contact, 1.0, speeds, setting)


def _row(
    name: Row, run: Callable[[Contact, Array], Collision], speeds: Array, reference: Outputs, repetitions: int
) -> Row:
    progress("accuracy: " + ", ".join(name.values()))
    contact = jax.tree.map(lambda leaf: leaf.astype(speeds.dtype), Contact.paper())
    timed = speeds[1:]
    timing, _ = time_compiled(compiled_for(run, contact, timed), contact, timed, repetitions=repetitions)
    return {
        **name,
        "microseconds_per_impact": 1e6 * timing.best_s / timed.size,
        "compile_s": timing.compile_s,
        **_errors(_outputs(run, speeds), reference),
    }


def _outputs(run: Callable[[Contact, Array], Collision], speeds: Array) -> Outputs:
    found = jax.jit(lambda at: values_and_slopes(run, at), compiler_options=_UNHURRIED)(speeds)
    return {key: np.asarray(part, np.float64) for key, part in found.items()}


def values_and_slopes(run: Callable[[Contact, Array], Collision], speeds: Array) -> dict[str, Array]:
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


def _adaptive(
    kind: tuple[str, str], tolerances: Sequence[float], speeds: Array, reference: Outputs, repetitions: int
) -> list[Row]:
    """Measure an adaptive solver; its tolerance is an argument of one program, so that none is compiled twice."""
    variable, solver = kind
    if solver == _IMPLICIT:
        # two hundred times slower here: a few tips and loose tolerances show it
        tolerances = [tolerance for tolerance in tolerances if tolerance >= 1e-5]
        speeds, reference = speeds[:_FEW], {key: part[:_FEW] for key, part in reference.items()}
    if not tolerances:
        return []
    # of static forces alone: the viscosity, by which slopes are taken, has no part in it
    place, run = find_junction(Contact.paper()), adaptive_collisions(variable, solver)
    contact = Contact.paper()
    # one tip that a loose tolerance keeps near capture would hold up all lanes
    timed = speeds[1:]
    compiled = compiled_for(run, contact, place, timed, jnp.asarray(tolerances[0]))

    @partial(jax.jit, compiler_options=_UNHURRIED)
    def slopes(junction, tolerance):
        return values_and_slopes(lambda contact, speeds: run(contact, junction, speeds, tolerance), speeds)

    rows = []
    for tolerance in tolerances:
        progress(f"accuracy: {solver}, adaptive in the {variable}, {tolerance:g}")
        timing, _ = time_compiled(compiled, contact, place, timed, jnp.asarray(tolerance), repetitions=repetitions)
        found = {key: np.asarray(part) for key, part in slopes(place, jnp.asarray(tolerance)).items()}
        rows.append(
            {
                "method": f"{solver}, adaptive",
                "variable": variable,
                "setting": f"tolerance {tolerance:g}",
                "precision": "float64",
                "tolerance": tolerance,
                "microseconds_per_impact": 1e6 * timing.best_s / timed.size,
                "compile_s": timing.compile_s,
                **_errors(found, reference),
            }
        )
    return rows


def adaptive_collisions(variable: str, solver: str) -> Callable[[Contact, Junction, Array, Array], Collision]:
    """Return collisions of a contact with its junction, at speeds, by an adaptive solver with a tolerance."""
    crossing = _CROSSINGS[variable]

    def one(contact, junction, speed, tolerance):
        mass = jnp.ones_like(speed)
        finest = SETTINGS["diffrax"][1e-11]
        parts = three_parts(contact, junction, speed, mass, finest, lambda way: crossing(way, solver, tolerance))
        return collision_of(contact, junction, speed, mass, parts)

    return jax.vmap(one, in_axes=(None, None, 0, None))


def _integrators(
    methods: Sequence[str],
    speeds: Sequence[float],
    tolerances: Sequence[float],
    expected: tuple[np.ndarray, np.ndarray],
) -> list[Row]:
    contact = Contact.paper()
    expected_rebound, expected_delay = expected
    rows = []
    for method in methods:
        for tolerance in tolerances:
            progress(f"accuracy: {title(method)}, {tolerance:g}")
            name = {"method": title(method), "variable": "time", "setting": f"tolerance {tolerance:g}"}
            row = {**name, "precision": "float64", "tolerance": tolerance, "slope_error": None}
            try:
                runs = [scipy_collision(contact, speed, method=method, rtol=tolerance) for speed in speeds]
            except (ValueError, ModuleNotFoundError) as failure:
                rows.append(row | {"microseconds_per_impact": None, "rebound_error": None, "reason": str(failure)})
                continue
            rebound = np.array([run.rebound_speed_nm_per_us for run in runs])
            delay = np.array([run.collision_delay_us for run in runs])
            rows.append(
                row
                | {
                    "microseconds_per_impact": 1e6 * float(np.mean([run.seconds for run in runs])),
                    "rebound_error": float(np.max(np.abs(rebound / expected_rebound - 1.0))),
                    "delay_error_us": float(np.max(np.abs(delay - expected_delay))),
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
