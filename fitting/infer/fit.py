"""The fit of an impact law to amplitude tables: the public function, and what it does, from top to bottom.

What is unknown is one vector with priors (`fitting.infer.unknowns`): the law's, the instrument's, and where impacts
last smooth functions and remainders that stand for what a formula leaves out. One least squares finds it: instantaneous
laws by Optax on chi2 (`fitting.infer.instantaneous`), lasting ones by a search that keeps every row's orbit, then with
everything free (`fitting.infer.explain`). The covariance of that vector, (J^T J)^-1, is where the law's band, intervals
and correlations come from (`fitting.infer.summary`).
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from afm_jax.checks import checked, in_float64
from afm_jax.contact.parameters import EFFECTS
from fitting.infer.explain import ROBUST, Explained, fit_lasting
from fitting.infer.instantaneous import fit_instantaneous, profile
from fitting.infer.optimiser import OPTIMISER
from fitting.infer.result import FitResult
from fitting.infer.summary import Fitted, convergence_of, summary_of
from fitting.infer.unknowns import Model, data_of, quantities_of
from fitting.models import Held, Task, held_of, split_held, task_of
from fitting.parameters import is_nuisance, model_parameters
from fitting.predict.law import FormulaLaw
from fitting.tables.several import SeveralTables
from fitting.tables.table import AmplitudeTable, as_table


@checked
@in_float64
def fit(  # noqa: PLR0913
    table: AmplitudeTable | Sequence[AmplitudeTable] | Any,
    model: str = "law",
    *,
    share: Sequence[str] = (),
    scale_errors: bool = False,
    free: Sequence[str] | None = None,
    fixed: dict[str, float] | None = None,
    constraints: dict[str, tuple[float, float]] | None = None,
    effects: Sequence[str] = EFFECTS,
    robust: bool = False,
) -> FitResult:
    """Fit an impact law to measured amplitudes of single-impact orbits.

    Args:
        table: from `read_table`, the path of a file, or a data frame as `AmplitudeTable.from_dataframe` takes it; what
            it gives with an error (Q, calibrations) is a nuisance with that constraint. A Q without error is assumed to
            be known to 5 % where impacts last, and exactly by the instantaneous laws. Several of them: one law for all,
            each with nuisances of its own.
        model: "restitution" (r), "law" (r, epsilon; eq. 6), "viscous" (epsilon, viscous_loss) or "full" (all three),
            each instantaneous or with "+delay", the collision delay; or "contact", physical parameters of the resolved
            contact. On resonance, where a tapping curve determines no impact law, "contact" still can be fitted.
        share: nuisances that several tables have in common, by name; "all": every one.
        scale_errors: take the amplitudes' errors as relative only and scale them until chi2 equals its degrees of
            freedom (the error of Q stays); the result is valid only if the scale is believable and what is left of the
            amplitudes random (see `verdict`).
        free: the parameters that are fitted; None: all of a law and its delay, of "contact" (keywords of
            `Contact.paper`) relative humidity, adhesion energy, viscosity and modulus, without those fixed.
        fixed: values at which other parameters of the model are held; of "contact" what is not named is the paper's.
        constraints: value and standard error of what else is known, by parameter: a nuisance (`quality_factor`,
            `tip_calibration`, `drive_calibration`, `offset_origin_nm`), which then is fitted along, or one of the
            model's parameters. With several tables a nuisance's constraint holds for each of them. In a fit of
            "contact" a constrained parameter that is not free is held at its value, and its error adds to the errors
            of the fitted ones; a held parameter without constraint gets an assumed error, which the report names.
        effects: for "contact": the effects there are.
        robust: leave outliers out; the result is valid only if they are few and the other amplitudes are explained.

    Returns:
        Values, errors, intervals, goodness of fit and a verdict; see `FitResult`.

    Raises:
        ValueError: if there is no such model or parameter, a constraint is impossible or degenerate with the model,
            there are fewer measured amplitudes than parameters, or tables have no law in common.
    """
    whole = tables_of(table)
    errors: dict[str, float] = {}
    if model == "contact":
        own = model_parameters(model, None if free is None else tuple(free), fixed)
        fixed, constraints, errors = split_held(own, fixed, constraints)
    if isinstance(whole, AmplitudeTable) and share:
        raise ValueError("`share` is about several tables: leave it out, or give more than one")
    options = {"free": free, "fixed": fixed, "constraints": constraints, "effects": effects}
    task = task_of(whole, model, share=share, **options)
    data = data_of(whole, task)
    amplitudes = int(data.measured.sum())
    if amplitudes < len(task.problem.own):
        raise ValueError(
            f"{whole.source}: {amplitudes} measured amplitude{'s' if amplitudes != 1 else ''} cannot determine the "
            f"{len(task.problem.own)} parameters of the model {model!r}; measure at other drives, orders or offsets too"
        )
    settings = {
        "model": model,
        "error_scale": None,
        "robust": ROBUST if robust else None,
        "constraints": task.known,
        "free": list(task.problem.own),
        "fixed": dict(fixed or {}),
        "effects": list(effects) if model == "contact" else None,
        "held": held_of(task.problem.own, tuple(effects), fixed or {}, errors) if model == "contact" else (),
    }
    if isinstance(whole, SeveralTables):
        settings["share"] = list(share)
    minimum, scale = _minimum_with_scale(
        model_of(whole, task, settings), scaling=len(task.problem.own) if scale_errors else None, robust=robust
    )
    settings["error_scale"] = scale
    return summary_of(whole, task, minimum, settings)


def tables_of(given: Any) -> AmplitudeTable | SeveralTables:
    """Return what was given as a table, or as several."""

    def table_of(given: Any) -> AmplitudeTable:
        return AmplitudeTable.from_dataframe(given) if hasattr(given, "columns") else as_table(given)

    if isinstance(given, SeveralTables):
        return given
    if isinstance(given, str) or not isinstance(given, Sequence):
        return table_of(given)
    if not given:
        raise ValueError("there is no table: give one, or the path of one")
    tables = tuple(map(table_of, given))
    return tables[0] if len(tables) == 1 else SeveralTables(tables)


def model_of(table: AmplitudeTable | SeveralTables, task: Task, settings: dict[str, Any]) -> Model:
    """Return everything that is unknown, and the rows.

    Where impacts last drag always is unknown: r alone would be biased by what it does.

    Args:
        table: the rows.
        task: what is fitted, and what is known beforehand.
        settings: of the fit: what is held (`fixed`, and of a contact `held`).
    """
    data, problem = data_of(table, task), task.problem
    fixed = settings["fixed"]
    known = {name: pair for name, pair in task.known.items() if not is_nuisance(name)}
    instrument = quantities_of(data, task, table.labels)
    if problem.model == "contact":
        from fitting.predict.contact import ContactLawModel  # noqa: PLC0415  # for contacts alone

        held = tuple(one for one in settings["held"] if one.error > 0.0)
        law = ContactLawModel(problem.own, fixed, held, problem.effects, data.mass_ng)
        return Model(data, law, instrument, known)
    own = problem.own
    if problem.lasting and "viscous_loss" not in (*own, *fixed):
        own = (*own, "viscous_loss")
    law = FormulaLaw(own, fixed, data.mass_ng, lasting=problem.lasting)
    return Model(data, law, instrument, known)


_SCALINGS = 3
"""How often errors are scaled: what is known of the instrument makes the minimum depend on the scale a little."""


def _minimum_with_scale(model: Model, *, scaling: int | None, robust: bool) -> tuple[Fitted, float | None]:
    """Return the minimum, and the factor of the errors that makes chi2 equal its degrees of freedom.

    Args:
        model: what is unknown, and the rows.
        scaling: how many parameters the readings determine; None: errors stay as they are.
        robust: leave outliers out.

    Raises:
        ValueError: if there are no degrees of freedom to take the scale from.
    """
    fitted, scale = minimum_of(model, robust=robust), None
    if scaling is None:
        return fitted, scale
    for _ in range(_SCALINGS):
        residual = fitted.explained.residual[np.isfinite(fitted.explained.residual)]
        if residual.size <= scaling:
            raise ValueError("scaling the errors needs more amplitudes than parameters; give their errors instead")
        factor = float(np.sqrt(np.sum(residual**2) / (residual.size - scaling)))
        if factor == 0.0:
            break
        scale, model = (scale or 1.0) * factor, replace(model, data=model.data.scaled(factor))
        fitted = minimum_of(model, robust=robust)
    return fitted, scale


def explained_of(result: FitResult) -> Explained:
    """Return the minimum of a fit with all its unknowns, which its result does not keep: it is searched for again."""
    table, settings = result.table, result.settings
    options: dict[str, Any] = {name: settings[name] for name in ("free", "fixed", "constraints")}
    options["effects"] = settings["effects"] or EFFECTS
    task = task_of(table, result.model, **options)
    model = model_of(table, task, settings | {"held": tuple(Held(*one) for one in settings["held"])})
    model = replace(model, data=model.data.scaled(settings["error_scale"] or 1.0))
    return minimum_of(model, robust=settings["robust"] is not None).explained


def minimum_of(model: Model, *, robust: bool = False) -> Fitted:
    """Return what explains a model's rows best: the search itself.

    Args:
        model: what is unknown, and the rows.
        robust: leave outliers out.
    """
    if model.law.lasting:
        explained, before = fit_lasting(model, robust=robust)
        steps = OPTIMISER + ", then Levenberg-Marquardt"
        convergence = convergence_of(explained, steps, explained.end.steps)
        return Fitted(explained, before, None, Explained.profile, convergence)
    explained, best, other = fit_instantaneous(model, robust=robust)
    return Fitted(explained, explained, other, profile, convergence_of(explained, OPTIMISER, best.steps))
