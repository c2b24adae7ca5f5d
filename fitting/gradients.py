"""Derivatives of predicted amplitudes by a model's parameters, and where they do not exist.

By the implicit function theorem an orbit moves smoothly with the parameters, except at a fold, where it meets another
one and ends, and where the tip grazes the platform, at the impact or on the way. There, and where there is no steady
orbit, the derivatives of amplitudes, forward or reverse, are NaN and a sentence says why.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from afm_jax.checks import checked, require_float64
from afm_jax.contact.parameters import EFFECTS
from afm_jax.impact.closure import OrbitPlace, OrbitProblem
from afm_jax.impact.first_impact import Flight, flight_gap
from afm_jax.impact.map import NEAR_GRAZING
from afm_jax.impact.orbits import amplitudes, orbit_state
from afm_jax.results import Result, public_result
from afm_jax.solve.lanes import compiled_quickly, in_blocks
from fitting.forward import branch_of, impact_of, orbit_problem, shown
from fitting.models import ROWS_PER_PROGRAM, Measurement, Problem, Rows, measurement_of
from fitting.parameters import CONTACT_NAMES, NUISANCE_NAMES, PARAMETERS, model_parameters
from fitting.tables.table import TableLike, as_table

NO_ORBIT = "there is no steady single-impact orbit at these values"
AT_A_FOLD = "the orbit is close to a fold, where it ends and no derivative exists"
SLOW_GRAZE = "the impact grazes the platform: its approach is slower than a thousandth of the platform's speed"
GRAZE_ON_THE_WAY = "the flight grazes the platform on the way: a small change makes another impact there"


@public_result()
@dataclass(frozen=True)
class AmplitudeGradients(Result):
    """Predicted amplitudes of a table's rows, peak and lock-in, and their derivatives.

    Attributes:
        parameters: names, in the order of the last axis of the gradient.
        predicted_nm: amplitudes in nm, shape (rows, 2); NaN where there is no orbit.
        gradient: in nm per unit of each parameter, shape (rows, 2, p); NaN where it is refused.
        reasons: why a row's gradient is refused, or None.
    """

    parameters: tuple[str, ...]
    predicted_nm: Float[np.ndarray, "rows 2"]
    gradient: Float[np.ndarray, "rows 2 p"]
    reasons: tuple[str | None, ...]


class _Judged(NamedTuple):
    """Amplitudes and their slopes of every row, and what speaks against the slopes."""

    amplitude_nm: Float[Array, "rows 2"]
    slope: Float[Array, "rows 2 p"]
    exists: Bool[Array, " rows"]
    near_fold: Bool[Array, " rows"]
    slow: Bool[Array, " rows"]
    touching: Bool[Array, " rows"]


@checked
def amplitude_gradients(
    table: TableLike,
    model: str,
    values: Mapping[str, float],
    *,
    mode: str = "forward",
    fixed: dict[str, float] | None = None,
    effects: Sequence[str] = EFFECTS,
) -> AmplitudeGradients:
    """Return the derivatives of the amplitudes that a model predicts for a table's drives.

    Where several steady orbits coexist, the one closest to the measured amplitudes counts.

    Args:
        table: the drives, and the amplitudes that tell coexisting orbits apart.
        model: as for `fit`.
        values: the model's parameters (for "contact" any of them) and any nuisances, by name: what is not named is the
            table's.
        mode: "forward" costs as much as there are parameters, "reverse" as there are amplitudes; same numbers.
        fixed: values of the model's parameters that are not differentiated by; of a contact else the paper's.
        effects: for "contact": the effects there are.

    Raises:
        ValueError: if there is no such model, mode or parameter, or one is missing or outside its range.
        RuntimeError: if JAX is not set to 64-bit floats.
    """
    table = as_table(table)
    require_float64()
    if mode not in ("forward", "reverse"):
        raise ValueError(f'`mode` must be "forward" or "reverse", but is {mode!r}')
    problem = replace(_problem(model, values, effects, fixed), drive=table.drive)
    measurement = measurement_of(table, problem, fixed=fixed)
    point = jnp.asarray([float(values[name]) for name in problem.names])
    judged = in_blocks(
        lambda rows: _judged(point, measurement._replace(rows=rows), problem, mode),
        measurement.rows,
        block=ROWS_PER_PROGRAM,
        widths=(),
    )
    judged = jax.tree.map(lambda column: column[: table.rows], judged)
    reasons = tuple(map(_reason, judged.exists, judged.near_fold, judged.slow, judged.touching))
    refused = np.array([reason is not None for reason in reasons])
    return AmplitudeGradients(
        parameters=problem.names,
        predicted_nm=np.where(judged.exists[:, None], judged.amplitude_nm, np.nan),
        gradient=np.where(refused[:, None, None], np.nan, judged.slope),
        reasons=reasons,
    )


def _problem(
    model: str, values: Mapping[str, float], effects: Sequence[str], fixed: dict[str, float] | None
) -> Problem:
    """Return the parameters that are differentiated by, the model's own first."""
    chosen = tuple(name for name in values if name in CONTACT_NAMES)
    own = model_parameters(model, chosen if model == "contact" else None, fixed)
    missing = [name for name in own if name not in values]
    if missing:
        raise ValueError(f"`values` lacks {' and '.join(missing)}, which the model {model!r} needs; add it")
    for name, value in values.items():
        if name not in (*own, *NUISANCE_NAMES):
            raise ValueError(f"`values` names {name!r}: choose from {', '.join((*own, *NUISANCE_NAMES))}")
        parameter = PARAMETERS[name]
        if not parameter.lowest <= value <= parameter.highest:
            raise ValueError(
                f"`values`: {name} must lie between {parameter.lowest:g} and {parameter.highest:g}, but is {value!r}"
            )
    return Problem(model, own + tuple(name for name in NUISANCE_NAMES if name in values), tuple(effects))


@compiled_quickly(static_argnames=("problem", "mode"))
def _judged(values: Float[Array, " p"], measurement: Measurement, problem: Problem, mode: str) -> _Judged:
    impact = impact_of(values, measurement, problem)
    differentiated = jax.jacfwd if mode == "forward" else jax.jacrev

    def one(row: Rows):
        orbit = orbit_problem(values, impact, row, measurement, problem)
        branch = lax.stop_gradient(branch_of(orbit, row, values, problem))

        def predicted(v):
            orbit = orbit_problem(v, impact_of(v, measurement, problem), row, measurement, problem)
            return shown(amplitudes(branch.place, orbit), orbit, row, v, problem)[:2]

        slow, touching = _grazes(branch.place, orbit)
        slope = differentiated(predicted)(values)
        return _Judged(predicted(values), slope, branch.exists, branch.near_fold, slow, touching)

    return jax.vmap(one)(measurement.rows)


_LOOKS = 512
"""Times at which the gap of a flight is looked at for a graze on the way."""
_TOUCHING = 1e-3
"""Smallest gap on the way, in terms of the drive's amplitude, below which a flight counts as grazing."""


def _grazes(place: OrbitPlace, orbit: OrbitProblem) -> tuple[Bool[Array, ""], Bool[Array, ""]]:
    """Say whether the impact is a graze, and whether the flight touches the platform on the way."""
    state = orbit_state(place, orbit)
    slow = state.speeds.approach < NEAR_GRAZING * orbit.platform.top_speed_nm_per_us
    flight = Flight(orbit.cantilever, orbit.platform, state.flight.start_us, state.flight.start_velocity)
    begin = jnp.maximum(-state.speeds.delay, 0.0)
    times = begin + (state.flight.duration_us - begin) * jnp.asarray(np.linspace(0.0, 1.0, _LOOKS))
    gap = jax.vmap(lambda time: flight_gap(time, flight))(times)
    before, here, after = gap[:-2], gap[1:-1], gap[2:]
    bend = before - 2.0 * here + after
    dip = (here <= before) & (here <= after) & (bend > 0.0)
    # the parabola through three neighbours: between two looks the flight may come closer
    lowest = here - (after - before) ** 2 / (8.0 * jnp.where(dip, bend, 1.0))
    return slow, jnp.any(dip & (lowest < _TOUCHING * orbit.platform.amplitude_nm))


def _reason(exists: np.bool_, near_fold: np.bool_, slow: np.bool_, touching: np.bool_) -> str | None:
    """Return why a row has no gradient, None if it has one."""
    faults = (not exists, NO_ORBIT), (near_fold, AT_A_FOLD), (slow, SLOW_GRAZE), (touching, GRAZE_ON_THE_WAY)
    return next((reason for there, reason in faults if there), None)
