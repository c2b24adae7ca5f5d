"""The fit: screen, polish, check, and say what was found and whether to believe it."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from afm_jax.contact.contact import EFFECTS
from afm_jax.parameters import require_float64
from fitting.contact_values import check_contact_values
from fitting.fit_summary import Found, summarise
from fitting.measurement import constraints_of, measurement_of
from fitting.minimum import Minimum, minimise, rescale_errors, settle
from fitting.models import NUISANCE_NAMES, Problem, model_parameters
from fitting.optimise import BATCH, ROBUST, SOFT, Objective
from fitting.result import FitResult
from fitting.strained import Strain, relaxed, strain_of
from fitting.table import AmplitudeTable

_STRAIN_ROUNDS = 3


def fit(  # noqa: PLR0913
    table: AmplitudeTable,
    model: str = "law",
    *,
    scale_errors: bool = False,
    free: Sequence[str] | None = None,
    fixed: dict[str, float] | None = None,
    constraints: dict[str, tuple[float, float]] | None = None,
    effects: Sequence[str] = EFFECTS,
    robust: bool = False,
) -> FitResult:
    """Fit an impact law to measured amplitudes of single-impact orbits.

    Args:
        table: from `read_table`; what it gives with an error (Q, calibrations) is a nuisance with that constraint.
        model: "restitution" (r), "law" (r, epsilon; eq. 6) or "viscous" (epsilon, viscous_loss), each instantaneous or
            with "+delay", the collision delay; or "contact", physical parameters through the resolved contact.
        scale_errors: take the amplitudes' errors as relative only and scale them until chi2 equals its degrees of
            freedom (the error of Q stays); the result is valid only if the scale is believable and what is left of the
            amplitudes random (see `verdict`).
        free: for "contact": the parameters that are fitted, by keyword of `Contact.paper`; None: relative humidity,
            adhesion energy, viscosity and modulus.
        fixed: for "contact": values of parameters that are not the paper's.
        constraints: value and standard error of what else is known, by parameter: a nuisance (`quality_factor`,
            `tip_calibration`, `drive_calibration`, `offset_origin_nm`), which then is fitted along, or one of the
            model's parameters.
        effects: for "contact": the effects there are.
        robust: let outliers count linearly from two errors on; the result is valid only if they are few and the other
            amplitudes are explained.

    Returns:
        Values, errors, intervals, goodness of fit and a verdict; see `FitResult`.

    Raises:
        ValueError: if there is no such model or parameter, a constraint is impossible or degenerate with the model, or
            there are fewer measured amplitudes than parameters.
        RuntimeError: if JAX is not set to 64-bit floats.
    """
    options: dict[str, Any] = {"free": free, "fixed": fixed, "constraints": constraints, "effects": effects}
    found = find_fit(table, model, scale_errors=scale_errors, robust=robust, **options)
    return summarise(table, found)


def find_fit(  # noqa: PLR0913
    table: AmplitudeTable,
    model: str,
    *,
    scale_errors: bool = False,
    free: Sequence[str] | None = None,
    fixed: dict[str, float] | None = None,
    constraints: dict[str, tuple[float, float]] | None = None,
    effects: Sequence[str] = EFFECTS,
    robust: bool = False,
) -> Found:
    """Return the minimum of a fit; arguments and errors as of `fit`."""
    require_float64()
    known = constraints_of(table, constraints)
    problem = problem_of(table, model, free=free, constraints=known, effects=effects)
    check_contact_values(model, fixed)
    measurement = measurement_of(table, problem, known, fixed)
    amplitudes = int(np.asarray(measurement.rows.measured).sum())
    if amplitudes < len(problem.own):
        raise ValueError(
            f"{table.source}: {amplitudes} measured amplitude(s) cannot determine the {len(problem.own)} "
            f"parameters of the model {model!r}; measure at other drives, orders or offsets too"
        )
    stated = Objective(measurement, problem, robust=robust)
    objective, minimum, strain = unstrained_minimum(stated)
    scale = None
    if scale_errors:
        objective, minimum, scale = rescale_errors(objective, minimum, len(problem.own))
    settings = {
        "model": model,
        "error_scale": scale,
        "starts": BATCH,
        "soft": SOFT,
        "robust": ROBUST if robust else None,
        "constraints": known,
        "free": list(problem.own),
        "fixed": fixed or {},
        "effects": list(effects) if model == "contact" else None,
    }
    return Found(stated, objective, minimum, strain, settings)


def problem_of(
    table: AmplitudeTable,
    model: str,
    *,
    free: Sequence[str] | None = None,
    constraints: dict[str, tuple[float, float]] | None = None,
    effects: Sequence[str] = EFFECTS,
) -> Problem:
    """Return what is fitted for a table: the model's parameters, and the nuisances that are constrained.

    Raises:
        ValueError: if there is no such model or parameter, or a constraint is impossible.
    """
    own = model_parameters(model, None if free is None else tuple(free))
    known = constraints_of(table, constraints)
    for name, (value, error) in known.items():
        if name not in (*own, *NUISANCE_NAMES):
            raise ValueError(
                f"the constraint on {name!r} is on no parameter: choose from {', '.join((*own, *NUISANCE_NAMES))}"
            )
        if not (np.isfinite(value) and 0.0 < error < np.inf):
            raise ValueError(
                f"the constraint on {name} must be a value and a positive error, but is {value} +- {error}"
            )
    if "offset_origin_nm" in known and model.endswith("+delay"):
        raise ValueError(
            "offset_origin_nm and delay_offset_nm shift the same thing: with a delay leave the constraint on "
            "offset_origin_nm out (delay_offset_nm takes it up), or fit the model 'contact'"
        )
    nuisances = tuple(name for name in NUISANCE_NAMES if name in known)
    return Problem(model, own + nuisances, tuple(effects))


def unstrained_minimum(stated: Objective) -> tuple[Objective, Minimum, Strain]:
    """Return the minimum with the model's own error in the weights and strained rows set aside, until both settle."""
    minimum = minimise(stated)
    strain = strain_of(stated, stated.problem.values(minimum.coordinates))
    if not stated.problem.lasting:
        return stated, minimum, strain
    objective = relaxed(stated, strain)
    for _ in range(_STRAIN_ROUNDS):
        minimum = settle(objective, minimum)
        again = strain_of(stated, stated.problem.values(minimum.coordinates))
        same = np.array_equal(again.set_aside, strain.set_aside)
        close = np.allclose(again.model_error, strain.model_error, rtol=0.02)
        if same and close:
            return objective, minimum, strain
        objective, strain = relaxed(stated, again), again
    return objective, settle(objective, minimum), strain
