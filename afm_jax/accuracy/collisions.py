"""Error of a collision against the time it takes: solvers, tolerances, variables, precisions, SciPy.

Runs in a process of its own on one core. Errors are achieved ones, against a quadrature converged to rounding that is
none of the contestants; just above the capture speed, where a tip hardly leaves, they are shown apart. Diffrax takes
part twice: over the gap, where the crossing's own equations (`afm_jax.contact.bridge_leg`) are solved with error
control, and in time, where gap and rate are the state, the phase is frozen, and Diffrax's events end the crossing.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from operator import itemgetter
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
from jaxtyping import Array, Float

from afm_jax.bench.collisions import (
    COARSER_REFERENCE,
    REFERENCE,
    collide_contestant,
    errors_against,
    integrator_contestant,
    speeds_of,
)
from afm_jax.bench.study import Contestant, Row, measured, named, timed
from afm_jax.contact.bridge_leg import Passage, Way, nothing_spent, way_rates
from afm_jax.contact.collide import Collision, batch_of, capture_speed, collision_of, three_parts
from afm_jax.contact.contact import Contact
from afm_jax.contact.junction import Junction, find_junction
from afm_jax.contact.settings import SETTINGS, Setting
from afm_jax.studies.timing import compiled_for

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
    reference = _outputs(lambda contact, at: batch_of(contact, 1.0, at, REFERENCE), speeds)
    # one program tells how far the reference is converged and what SciPy should find
    methods, tips = integrators
    coarser = batch_of(Contact.paper(), 1.0, jnp.concatenate([speeds, jnp.asarray(tips)]), COARSER_REFERENCE)
    # the first speed is the one near capture, the last ones are those of single tips
    of_batch = jax.tree.map(itemgetter(slice(1, speeds.size)), coarser)
    of_tips = jax.tree.map(itemgetter(slice(speeds.size, None)), coarser)
    exact = of_batch._replace(
        rebound_speed_nm_per_us=reference["rebound"][1:], collision_delay_us=reference["delay"][1:]
    )

    def contestants() -> Iterator[Contestant]:
        for method, settings in SETTINGS.items():
            levels = [accuracy for accuracy in settings if accuracy in accuracies]
            # one setting shows what 32 bits leave; more would show the same
            for precision, chosen in (("float64", levels), ("float32", [level for level in levels if level == 1e-6])):
                yield _collide(method, chosen, speeds.astype(precision), reference, repetitions)
        for solver in (name for name in solvers["gap"] if name != _IMPLICIT):
            yield _fixed_steps(solver, steps, speeds, reference, repetitions)
        for variable, names in solvers.items():
            for solver in names:
                yield from _adaptive((variable, solver), tolerances, speeds, reference, repetitions)
        told = {"variable": "time", "precision": "float64", "slope_error": None}
        for method in methods:
            yield integrator_contestant(method, tolerances, tips, of_tips)._replace(column="tolerance", told=told)

    rows = list(measured("accuracy: collisions", contestants(), unknown=("microseconds_per_impact", "rebound_error")))
    for row in rows:
        row.pop("median_microseconds_per_impact", None)
    return {"rows": rows, "reference_error": max(errors_against(of_batch, exact))}


def _collide(
    method: str, accuracies: Sequence[float], speeds: Array, reference: Outputs, repetitions: int
) -> Contestant:
    contestant = collide_contestant(
        method, accuracies, speeds[1:], repetitions, lambda run, _: _errors(_outputs(run, speeds), reference)
    )
    return contestant._replace(column="accuracy", told={"variable": "gap", "precision": str(speeds.dtype)})


def _fixed_steps(solver: str, steps: Sequence[int], speeds: Array, reference: Outputs, repetitions: int) -> Contestant:
    contact, timed_speeds = Contact.paper(), speeds[1:]

    def measure(count: int) -> Row:
        setting = Setting("steps", count, count, 16, solver=solver)

        def run(contact: Contact, speeds: Array) -> Collision:
            return batch_of(contact, 1.0, speeds, setting)

        compiled = compiled_for(run, contact, timed_speeds)
        row, _ = timed(compiled, contact, timed_speeds, repetitions=repetitions, events=timed_speeds.size)
        return row | _errors(_outputs(run, speeds), reference)

    settings = {f"{count} + {count} steps": count for count in steps}
    told = {"variable": "gap", "precision": "float64"}
    return Contestant(f"{solver}, fixed steps", settings, measure, told=told)


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
) -> Iterator[Contestant]:
    """Give an adaptive solver; its tolerance is an argument of one program, so that none is compiled twice."""
    variable, solver = kind
    if solver == _IMPLICIT:
        # two hundred times slower here: a few tips and loose tolerances show it
        tolerances = [tolerance for tolerance in tolerances if tolerance >= 1e-5]
        speeds, reference = speeds[:_FEW], {key: part[:_FEW] for key, part in reference.items()}
    if not tolerances:
        return
    # of static forces alone: the viscosity, by which slopes are taken, has no part in it
    contact = Contact.paper()
    junction, run = find_junction(contact), adaptive_collisions(variable, solver)
    # one tip that a loose tolerance keeps near capture would hold up all lanes
    timed_speeds = speeds[1:]
    compiled = compiled_for(run, contact, junction, timed_speeds, jnp.asarray(tolerances[0]))

    def outputs(junction: Junction, tolerance: Array) -> dict[str, Array]:
        return values_and_slopes(lambda contact, speeds: run(contact, junction, speeds, tolerance), speeds)

    slopes = jax.jit(outputs, compiler_options=_UNHURRIED)

    def measure(tolerance: float) -> Row:
        arguments = (contact, junction, timed_speeds, jnp.asarray(tolerance))
        row, _ = timed(compiled, *arguments, repetitions=repetitions, events=timed_speeds.size)
        found = {key: np.asarray(part) for key, part in slopes(junction, jnp.asarray(tolerance)).items()}
        return row | _errors(found, reference)

    told = {"variable": variable, "precision": "float64"}
    yield Contestant(f"{solver}, adaptive", named("tolerance", tolerances), measure, "tolerance", told)


def adaptive_collisions(variable: str, solver: str) -> Callable[[Contact, Junction, Array, Array], Collision]:
    """Return collisions of a contact with its junction, at speeds, by an adaptive solver with a tolerance."""
    crossing = _CROSSINGS[variable]

    def one(contact, junction, speed, tolerance):
        mass = jnp.ones_like(speed)
        finest = SETTINGS["diffrax"][1e-11]
        parts = three_parts(contact, junction, speed, mass, finest, lambda way: crossing(way, solver, tolerance))
        return collision_of(contact, junction, speed, mass, parts)

    return jax.vmap(one, in_axes=(None, None, 0, None))


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
