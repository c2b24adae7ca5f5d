"""The comparison with 50 digits, in units of what rounding can do: machine epsilon times the condition number."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from afm_jax.impact.law import impact_law_of
from afm_jax.study.high_precision import exact_impact
from afm_jax.study.verification_samples import Sample, automatic_values, relative_difference
from afm_jax.study.verification_states import Floats, States

EQUATIONS = ("eq. 5", "eq. 6", "eq. 7", "eqs. 5+7")


def digits_differences(mp: Any, sample: Sample, rows: NDArray[np.int64]) -> tuple[dict[str, Floats], Floats]:
    """Compare automatic derivatives and written formulas with 50 digits.

    Args:
        mp: mpmath's context.
        sample: the states.
        rows: which of them, integer indices of shape (rows,).

    Returns:
        By equation the relative difference of the worst of forward, reverse and written, shape (rows,); and the
        condition numbers, shape (rows,).
    """
    automatic = automatic_values(sample)
    plain = plain_rows(sample.states)
    exact = [
        exact_impact(
            mp,
            {name: None if values is None else values[row] for name, values in plain.items()},
            (float(sample.states.time_us[row]), float(sample.states.velocity[row])),
            float(sample.automatic.arrival_us[row]),
        )
        for row in rows
    ]
    parts = ([one.flight for one in exact], [one.rebound for one in exact], [one.law for one in exact])
    truth = dict(zip(EQUATIONS, map(np.array, (*parts, [one.chained for one in exact])), strict=True))
    differences = {}
    for name in EQUATIONS:
        pair = sample.written[name]
        terms = np.asarray(pair.terms)[rows]
        candidates = [automatic[name][rows, 0], automatic[name][rows, 1], np.asarray(pair.value)[rows]]
        differences[name] = np.max([relative_difference(value, truth[name], terms) for value in candidates], axis=0)
    return differences, sample.condition[rows]


def plain_rows(states: States) -> dict[str, Any]:
    """Return a batch of scenes as columns of plain numbers (a delay as triples), None for absent effects."""
    scene = states.scene
    law = impact_law_of(scene)
    columns = {
        "frequency_khz": scene.cantilever.frequency_khz,
        "quality_factor": scene.cantilever.quality_factor,
        "amplitude_nm": scene.platform.amplitude_nm,
        "drive_frequency_khz": scene.platform.frequency_khz,
        "offset_nm": scene.platform.offset_nm,
        "r": law.r,
        "epsilon": law.epsilon,
        "viscous_loss": law.viscous_loss,
    }
    plain: dict[str, Any] = {name: None if column is None else np.asarray(column) for name, column in columns.items()}
    triple = None if law.delay is None else (law.delay.hertz, law.delay.lead_nm, law.delay.offset_nm)
    return plain | {"delay": None if triple is None else np.stack([np.asarray(part) for part in triple], axis=-1)}
