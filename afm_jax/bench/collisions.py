"""Collisions per second through the contact: settings, parameters per tip, derivatives, effects, SciPy."""

import resource
import sys
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from afm_jax.bench.integrators import title
from afm_jax.bench.scipy_contacts import scipy_collision
from afm_jax.bench.study import Contestant, Row, measured, named, timed
from afm_jax.contact.collide import Collision, batch_of, collide
from afm_jax.contact.contact import Contact
from afm_jax.contact.parameters import EFFECTS
from afm_jax.contact.settings import SETTINGS, Setting
from afm_jax.studies.timing import compiled_for, progress, time_calls

SPEEDS_NM_PER_US = (12.0, 200.0)
REFERENCE = Setting("collocation", 40, 40, 48, iterations=14)
"""Converged to rounding; the tests compare it with 20 digits to 1e-12."""
ERRORS = ("rebound_error", "delay_error_us")
COARSER_REFERENCE = Setting("collocation", 32, 32, 40, iterations=12)


def speeds_of(batch: int) -> Float[Array, " batch"]:
    """Return the benchmark's approach speeds in nm/us."""
    return jnp.linspace(*SPEEDS_NM_PER_US, batch)


def errors_against(result: Collision, reference: Collision) -> tuple[float, float]:
    """Return the largest relative error of the rebound speed and the largest error of the delay in us."""
    rebound = np.asarray(result.rebound_speed_nm_per_us, float) / np.asarray(reference.rebound_speed_nm_per_us) - 1.0
    delay = np.asarray(result.collision_delay_us, float) - np.asarray(reference.collision_delay_us)
    return float(np.max(np.abs(rebound))), float(np.max(np.abs(delay)))


def contact_one_core(*, batch: int, repetitions: int, many: int, scipy_speeds: Sequence[float]) -> dict[str, Any]:
    """Measure everything of the contact benchmark; to be run in a process of its own.

    Args:
        batch: how many speeds at once.
        repetitions: of each measurement.
        many: how many speeds in the one large call.
        scipy_speeds: approach speeds of SciPy's tips.

    Returns:
        `rows` with what, batch, microseconds_per_impact, compile_s, rebound_error (relative), delay_error_us,
        ratio_to_plain, flops, instructions, memory_mib; `reference_error`.
    """
    # of a process in which nothing has been traced yet
    gradient = _first_gradient(min(batch, 100))
    contact, speeds = Contact.paper(), speeds_of(batch)
    reference, coarser = (batch_of(contact, 1.0, speeds, setting) for setting in (REFERENCE, COARSER_REFERENCE))

    def errors(_: Any, result: Collision) -> Row:
        return dict(zip(ERRORS, errors_against(result, reference), strict=True))

    contestants = (
        collide_contestant(method, list(SETTINGS[method]), speeds, repetitions, errors) for method in SETTINGS
    )
    rows = [
        {"what": f"{row.pop('method').removeprefix('collide, ')}, {row.pop('setting')}", "batch": batch} | row
        for row in measured("bench: contact", contestants)
    ]
    plain = {row["what"]: row["microseconds_per_impact"] for row in rows}
    for accuracy in (1e-6, 1e-9):
        base = plain[f"diffrax, accuracy {accuracy:g}"]
        rows += [
            row | {"ratio_to_plain": row["microseconds_per_impact"] / base}
            for row in _variants(accuracy, speeds, repetitions)
        ]
    rows += _effects(speeds, repetitions)
    rows += [gradient, _many(many)]
    # the finest setting, of the speeds that SciPy follows
    finest = collide(contact, jnp.asarray(scipy_speeds), accuracy=1e-11)
    for method, tolerances in (("DOP853", [1e-6, 1e-9]), ("LSODA", [1e-9])):
        scipy = integrator_contestant(method, tolerances, scipy_speeds, finest)
        for row in measured("bench: contact", [scipy], unknown=("microseconds_per_impact",)):
            tolerance = row.pop("setting").removeprefix("tolerance ")
            rows.append({"what": f"{row.pop('method')} with events, rtol {tolerance}", "batch": 1} | row)
    return {"rows": rows, "reference_error": max(errors_against(coarser, reference))}


def _runner(method: str, accuracy: float) -> Callable[[Contact, Array], Collision]:
    setting = SETTINGS[method][accuracy]
    return lambda contact, speeds: batch_of(contact, 1.0, speeds, setting)


def collide_contestant(
    method: str,
    accuracies: Sequence[float],
    speeds: Array,
    repetitions: int,
    errors: Callable[[Callable[[Contact, Array], Collision], Collision], Row],
) -> Contestant:
    """Return `collide` with accuracies as settings.

    Args:
        method: "diffrax" or "collocation".
        accuracies: which of its settings.
        speeds: approach speeds in nm/us of the batch that is timed, in the precision that is measured.
        repetitions: of each measurement.
        errors: from the function of contact and speeds, and its result for these speeds, the columns of errors.
    """
    contact = jax.tree.map(lambda leaf: leaf.astype(speeds.dtype), Contact.paper())

    def measure(accuracy: float) -> Row:
        run = _runner(method, accuracy)
        compiled = compiled_for(run, contact, speeds)
        row, result = timed(compiled, contact, speeds, repetitions=repetitions, events=speeds.size)
        return row | errors(run, result)

    return Contestant(f"collide, {method}", named("accuracy", accuracies), measure)


def integrator_contestant(
    method: str, tolerances: Sequence[float], speeds: Sequence[float], reference: Collision
) -> Contestant:
    """Return an integrator that follows tips of some approach speeds one by one, with tolerances as settings."""
    contact = Contact.paper()

    def measure(tolerance: float) -> Row:
        runs = [scipy_collision(contact, speed, method=method, rtol=tolerance) for speed in speeds]
        rebound = np.array([run.rebound_speed_nm_per_us for run in runs])
        delay = np.array([run.collision_delay_us for run in runs])
        found = reference._replace(rebound_speed_nm_per_us=rebound, collision_delay_us=delay)
        return {
            "microseconds_per_impact": 1e6 * float(np.mean([run.seconds for run in runs])),
            "evaluations_per_impact": float(np.mean([run.evaluations for run in runs])),
            **dict(zip(ERRORS, errors_against(found, reference), strict=True)),
        }

    return Contestant(title(method), named("tolerance", tolerances), measure)


def _row(what: str, function: Callable[..., Any], arguments: tuple[Any, ...], repetitions: int) -> Row:
    progress(f"bench: contact, {what}")
    batch = arguments[-1].shape[0]
    compiled = compiled_for(function, *arguments)
    return {"what": what, "batch": batch} | timed(compiled, *arguments, repetitions=repetitions, events=batch)[0]


def _variants(accuracy: float, speeds: Float[Array, " batch"], repetitions: int) -> list[Row]:
    """Measure parameters that differ from tip to tip, and derivatives."""
    run = _runner("diffrax", accuracy)
    contact = Contact.paper()
    share = jnp.linspace(0.8, 1.2, speeds.shape[0])
    varied = Contact.paper(
        relative_humidity=0.5 * share, viscosity_pa_s=1.005e-3 * share, adhesion_energy_j_per_m2=0.3 * share[::-1]
    )

    def outputs(contact, speeds):
        result = run(contact, speeds)
        return result.rebound_speed_nm_per_us, result.collision_delay_us

    def forward(contact, speeds):
        return jax.jvp(lambda moved: outputs(moved, speeds), (contact,), (jax.tree.map(jnp.ones_like, contact),))[1]

    def reverse(contact, speeds):
        return jax.grad(lambda *at: sum(jnp.sum(part) for part in outputs(*at)), argnums=(0, 1))(contact, speeds)

    # 5 nm/us faster: dry or sticky contacts among them capture a little above 12
    cases: dict[str, tuple[Callable[..., Any], tuple[Any, Any]]] = {
        "parameters of each tip its own": (outputs, (varied, speeds + 5.0)),
        "one forward derivative": (forward, (contact, speeds)),
        "reverse gradient by all parameters and speeds": (reverse, (contact, speeds)),
    }
    return [
        _row(f"{what}, accuracy {accuracy:g}", function, arguments, repetitions)
        for what, (function, arguments) in cases.items()
    ]


def _effects(speeds: Float[Array, " batch"], repetitions: int) -> list[Row]:
    """Measure contacts without one of their effects: time, and size of the compiled program."""
    rows = []
    for missing in (None, "structural", "viscous"):
        contact = Contact.paper(effects=tuple(name for name in EFFECTS if name != missing))
        run = _runner("diffrax", 1e-9)
        row = _row("all effects" if missing is None else f"without {missing}", run, (contact, speeds), repetitions)
        compiled = jax.jit(run).lower(contact, speeds[:64]).compile()
        cost = compiled.cost_analysis() or {}
        text = compiled.as_text() or ""
        rows.append(row | {"flops": cost.get("flops"), "instructions": text.count(" = ")})
    return rows


def _first_gradient(batch: int) -> Row:
    """Measure a gradient outside of compiled programs: what a session waits for, the first time and then."""
    what = "gradient by all parameters and speeds, outside of compiled programs"
    progress(f"bench: contact, {what}")

    def total(contact: Contact, speeds: Array) -> Array:
        result = collide(contact, speeds)
        return jnp.sum(result.rebound_speed_nm_per_us) + jnp.sum(result.collision_delay_us)

    gradient = jax.grad(total, argnums=(0, 1))
    calls = time_calls(lambda: gradient(Contact.paper(), speeds_of(batch) + 1.0), repetitions=2)
    return {
        "what": what,
        "batch": batch,
        "microseconds_per_impact": 1e6 * calls.best_s / batch,
        "compile_s": calls.compile_s,
    }


def _many(count: int) -> Row:
    """Measure one large call, and how much memory it takes beyond its arguments and results."""
    contact, speeds = Contact.paper(), speeds_of(count)
    run = compiled_for(_runner("diffrax", 1e-9), contact, speeds)
    scratch = getattr(run.run, "memory_analysis", lambda: None)()
    row, result = timed(run, contact, speeds, repetitions=1, events=count)
    del row["median_microseconds_per_impact"]
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10)
    return row | {
        "what": "one call with many speeds, accuracy 1e-09",
        "batch": count,
        "memory_mib": scratch.temp_size_in_bytes / 2**20 if scratch is not None else None,
        "results_mib": sum(part.nbytes for part in result) / 2**20,
        "peak_process_mib": peak,
    }


def aims(rows: Sequence[Row]) -> list[tuple[str, float | None, float]]:
    """Return what was aimed at: name, reached (None if not measured), largest allowed."""
    by_name = {row["what"]: row for row in rows}

    def of(what: str, column: str) -> float | None:
        return by_name.get(what, {}).get(column)

    return [
        ("contact, us an impact at 1e-6", of("diffrax, accuracy 1e-06", "microseconds_per_impact"), 1.5),
        ("contact, error of u_out at the 1e-6 setting", of("diffrax, accuracy 1e-06", "rebound_error"), 1e-6),
        ("contact, us an impact at 1e-9", of("diffrax, accuracy 1e-09", "microseconds_per_impact"), 3.0),
        ("contact, error of u_out at the 1e-9 setting", of("diffrax, accuracy 1e-09", "rebound_error"), 1e-9),
        (
            "contact, own parameters, plain runs",
            of("parameters of each tip its own, accuracy 1e-09", "ratio_to_plain"),
            2.0,
        ),
        (
            "contact, forward derivative, plain runs",
            of("one forward derivative, accuracy 1e-09", "ratio_to_plain"),
            3.0,
        ),
        (
            "contact, reverse gradient, plain runs",
            of("reverse gradient by all parameters and speeds, accuracy 1e-09", "ratio_to_plain"),
            6.0,
        ),
    ]
