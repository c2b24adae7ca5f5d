"""Derivatives of predicted amplitudes by a model's parameters, and where they do not exist.

By the implicit function theorem an orbit moves smoothly with the parameters, except at a fold, where it meets another
one and ends, and where the tip grazes the platform on the way. There, and where there is no steady
orbit, the derivatives of amplitudes are NaN and a sentence says why.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from afm_jax.checks import checked, in_float64
from afm_jax.contact.parameters import EFFECTS
from afm_jax.results import Result, public_result
from fitting.infer.fit import model_of
from fitting.infer.search import orbits_at
from fitting.models import task_of
from fitting.parameters import CONTACT_NAMES, NUISANCE_NAMES, PARAMETERS, is_nuisance, model_parameters
from fitting.predict.orbit import NEAR_FOLD, Local, Row, platform_and_cantilever
from fitting.tables.table import TableLike, as_table

NO_ORBIT = "there is no steady single-impact orbit at these values"
AT_A_FOLD = "the orbit is close to a fold, where it ends and no derivative exists"
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


@checked
@in_float64
def amplitude_gradients(
    table: TableLike,
    model: str,
    values: Mapping[str, float],
    *,
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
        fixed: values of the model's parameters that are not differentiated by; of a contact else the paper's.
        effects: for "contact": the effects there are.

    Raises:
        ValueError: if there is no such model or parameter, or one is missing or outside its range.
    """
    table = as_table(table)
    held = dict(fixed or {})
    own = _own_parameters(model, values, held)
    task = task_of(table, model, free=own, fixed=held, effects=effects)
    # an error of 1: derivatives by the unknown are those by the value
    known = task.known | {name: (values[name], 1.0) for name in NUISANCE_NAMES if name in values}
    problem = replace(task.problem, names=(*own, *filter(is_nuisance, known)))
    # nothing but what was asked for: a fit adds a viscous loss where impacts last
    settings = {"fixed": held if model == "contact" else {"viscous_loss": 0.0} | held, "held": ()}
    whole = model_of(table, task._replace(known=known, problem=problem), settings)
    law: Any = whole.law
    theta = np.zeros(len(whole.names))
    # 0 has no logarithm
    theta[: len(own)] = [law.unknown_of(name, max(values[name], 1e-300)) for name in own]
    orbits = orbits_at(whole, theta).orbits
    slopes = whole.slopes(theta, orbits)
    exists, hits = np.isfinite(orbits.x[:, 0]), ~whole.data.row.free
    touching = _touches(orbits.x, orbits.approach, whole.local(theta), whole.data.row, table.drive)
    near_fold = hits & (np.abs(orbits.fold) < NEAR_FOLD)
    faults = {NO_ORBIT: ~exists, AT_A_FOLD: near_fold, GRAZE_ON_THE_WAY: hits & touching}
    reasons = [next((reason for reason, rows in faults.items() if rows[i]), None) for i in range(table.rows)]
    names = (*own, *(name for name in NUISANCE_NAMES if name in values))
    slope_of_value = [law.slope_of(name, y) for name, y in zip(own, theta, strict=False)]
    gradient = slopes[:, :2, [whole.names.index(name) for name in names]]
    gradient[:, :, : len(own)] /= slope_of_value
    gradient[[reason is not None for reason in reasons]] = np.nan
    predicted = np.where(exists[:, None], orbits.readings[:, :2], np.nan)
    return AmplitudeGradients(names, predicted, gradient, tuple(reasons))


def _own_parameters(model: str, values: Mapping[str, float], fixed: Mapping[str, float]) -> tuple[str, ...]:
    """Return the model's parameters that are differentiated by.

    Raises:
        ValueError: if a value is missing, of no parameter, or outside its range.
    """
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
    return own


_LOOKS = 512
"""Times at which the gap of a flight is looked at for a graze on the way."""
_TOUCHING = 1e-3
"""Smallest gap on the way, in terms of the drive's amplitude, below which a flight counts as grazing."""


@partial(jax.jit, static_argnames="drive")
def _touches(
    x: Float[Array, "rows 3"],
    approach: Float[Array, " rows"],
    local: Float[Array, "rows local"],
    row: Row,
    drive: str,
) -> Bool[Array, " rows"]:
    """Say of rows whether the flight before the impact touches the platform on the way."""

    def one(x, approach, local, row):
        cantilever, platform = platform_and_cantilever(Local(*local), row, drive)
        arrival, delay = x[1] / platform.angular_frequency, x[2]
        landing = platform.motion(arrival)
        # back from the impact to where the flight begins to count: at max(t_in, t_out)
        longest = row.order * platform.period_us - jnp.maximum(delay, 0.0)
        times = -longest * jnp.asarray(np.linspace(1.0, 0.0, _LOOKS))
        height, _ = cantilever.propagator(times)(landing.position, landing.velocity - approach)
        gap = height - platform.position(arrival + times)
        before, here, after = gap[:-2], gap[1:-1], gap[2:]
        bend = before - 2.0 * here + after
        dip = (here <= before) & (here <= after) & (bend > 0.0)
        # the parabola through three neighbours: between two looks the flight may come closer
        lowest = here - (after - before) ** 2 / (8.0 * jnp.where(dip, bend, 1.0))
        return jnp.any(dip & (lowest < _TOUCHING * platform.amplitude_nm))

    return jax.vmap(one)(x, approach, local, row)
