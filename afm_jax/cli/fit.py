"""`afm-jax fit TABLE.csv`: the impact law from measured vibration amplitudes."""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import click
from click import IntRange

from afm_jax.cli.command import Output, hand_out
from afm_jax.cli.session import Session
from afm_jax.cli.tables import example_path
from afm_jax.cli.values import Constraint, Fixed, ModelName, Names, QualityFactor, Share
from afm_jax.contact.parameters import EFFECTS, REMOVABLE_EFFECTS, idle_without
from afm_jax.report import text_of
from afm_jax.saved import as_json
from fitting.infer.comparison import compare as compared_models
from fitting.infer.comparison import rivals
from fitting.infer.fit import fit as fit_tables
from fitting.infer.result import FitResult
from fitting.parameters import CONTACT_DEFAULT
from fitting.sampling.posterior import posterior as sampled_posterior
from fitting.sampling.posterior import require_blackjax, sampled_by_gaussian
from fitting.tables.several import SeveralTables
from fitting.tables.table import as_table


def fit(  # noqa: PLR0913
    session: Session,
    tables: Annotated[Sequence[Path], "[TABLE.csv]..."],
    *,
    model: ModelName = "law",
    noise: Annotated[float | None, Share("a relative error")] = None,
    quality_factor: QualityFactor | None = None,
    scale_errors: bool = False,
    robust: bool = False,
    free: Annotated[tuple[str, ...] | None, Names()] = None,
    fixed: Annotated[Sequence[tuple[str, float]], Fixed(), "--fix", "NAME=VALUE"] = (),
    constraints: Annotated[
        Sequence[tuple[str, tuple[float, float]]], Constraint(), "--constrain", "NAME=VALUE+-ERROR"
    ] = (),
    no: Annotated[tuple[str, ...] | None, Names()] = None,
    compare: bool = False,
    posterior: bool = False,
    seed: Annotated[int, IntRange(0)] = 0,
    share: Annotated[tuple[str, ...] | None, Names()] = None,
    example: bool = False,  # noqa: ARG001 (stands for a table: the command's row)
) -> Output | None:
    """Fit the impact law to a table of vibration amplitudes, or one law to several tables.

    The table is a CSV file: comment lines `# free_frequency_khz = 90`, `# quality_factor = 40 +- 1`, and columns order,
    drive_frequency_khz, drive_amplitude_nm, offset_nm, peak_amplitude_nm and/or lockin_amplitude_nm, each with its
    ..._error_nm; a column no_orbit marks by 1 drives at which the tip did not settle; phase_deg is used if present.
    With a line `# drive = force` (or base) it is a tapping curve: drive_frequency_khz, free_amplitude_nm, offset_nm,
    lockin_amplitude_nm and phase_lag_deg. Several tables have one law; their nuisances are separate or shared
    (--share), and the report gives each table's pull: the distance between its law and that of the others, in
    standard deviations. With --out the report: fit.html, fit.txt, fit.json, fit.png, fit_rows.csv, law.csv. Exit code 3
    if the result is not valid: not converged, not explained by the model, or a parameter not identified.

    Args:
        session: for progress and messages.
        tables: files.
        model: restitution: a restitution without adhesion (r); law: a restitution with adhesion (r, epsilon); viscous:
            a loss linear in speed with adhesion (epsilon, viscous_loss); full: a restitution, a loss linear in speed
            and adhesion (r, epsilon, viscous_loss); each with the collision delay, which amplitudes near resonance need
            (+delay); contact: physical parameters through the resolved contact, of tapping curves 3 to 10 % above
            resonance.
        noise: relative error of amplitudes for which the table states none, such as 1%.
        quality_factor: instead of the table's; '40 +- 2', or none: no air damping.
        scale_errors: treat the errors as relative: scale them, by 3 at most, until chi2/dof is 1.
        robust: leave out outliers, at most one row in ten.
        free: the parameters to fit; else all that are not fixed, and of a contact
            relative_humidity,adhesion_energy_j_per_m2,viscosity_pa_s,modulus_gpa.
        fixed: hold a parameter at a value.
        constraints: a value known beforehand, with its error: of quality_factor, offset_origin_nm, tip_calibration,
            drive_calibration, free_frequency_khz, phase_zero_deg, phase_drift_deg, free_amplitude_drift, or of a
            parameter of the model; of a contact also of a parameter that is held at that value.
        no: of a contact: effects to leave out.
        compare: fit the rival models too and say which of them the table distinguishes.
        posterior: also give credible intervals, by the no-U-turn sampler (extra `nuts`); where impacts last, from a
            Gaussian around the fit.
        seed: seed of the random numbers.
        share: of several tables: the nuisances (see --constrain) that they have in common, or all; else each table has
            its own.
        example: fit the bundled table instead of a file.
    """
    if posterior and len(tables) > 1:
        raise click.UsageError("--posterior is about one table: give one, or leave it out")
    if no and model != "contact":
        raise click.UsageError("--no is about the contact's effects; add --model contact")
    settings: dict[str, Any] = {"scale_errors": scale_errors, "robust": robust, "constraints": dict(constraints)}
    settings |= {"free": free, "fixed": dict(fixed)} | ({"share": share} if share else {})
    if model == "contact":
        settings |= parameters_of_contact(free, settings["fixed"], no or ())
    if posterior and not sampled_by_gaussian(model):
        require_blackjax()
    read = [as_table(path, noise=noise, quality_factor=quality_factor) for path in tables or (example_path(),)]
    measured = read[0] if len(read) == 1 else SeveralTables(tuple(read))
    first = "the first run compiles for ten seconds" if "delay" in model or model == "contact" else "some seconds"
    rows = f"{measured.rows} rows" + (f" of {len(read)} tables" if len(read) > 1 else "")
    with session.working(f"fitting {rows}, model {model} ({first})"):
        result = fit_tables(measured, model, **settings)
    if posterior and not result.valid:
        session.note("no posterior: the fit is not valid")
    extras: dict[str, Any] = {}
    try:
        if compare:
            models = rivals(result.model, settings["fixed"])
            with session.working(f"comparing {', '.join(models)}"):
                known = {result.model: result}
                extras["comparison"] = compared_models(result.table, models, known=known, **settings)
        if posterior and result.valid:
            with session.working("sampling the posterior"):
                extras["posterior"] = sampled_posterior(result, seed=seed)
    except Exception:
        # the fit itself stands
        hand_out(session, _output(result, extras))
        raise
    return _output(result, extras)


def _output(result: FitResult, extras: Mapping[str, Any]) -> Output:
    """Return what is handed out of a fit, with a comparison and a posterior where there are some."""
    results = (result, *extras.values())
    return Output.of(
        result,
        payload=as_json(result) | {name: as_json(extra) for name, extra in extras.items()},
        text=[lambda: text_of(*results)],
        report=partial(result.report, more=results[1:]),
    )


def parameters_of_contact(free: Sequence[str] | None, fixed: Mapping[str, float], no: Sequence[str]) -> dict[str, Any]:
    """Return which parameters of a contact `fitting.fit` fits, and the effects that it has.

    Raises:
        click.UsageError: if the options contradict each other.
    """
    for name in no:
        if name not in REMOVABLE_EFFECTS:
            raise click.UsageError(f"--no takes {', '.join(REMOVABLE_EFFECTS)}, but one is {name!r}")
    effects = tuple(name for name in EFFECTS if name not in no)
    for name in (*(free or ()), *fixed):
        missing = idle_without(name, effects)
        if missing:
            raise click.UsageError(f"{name} changes nothing without the effect {' or '.join(missing)}: leave it out")
    usual = tuple(name for name in CONTACT_DEFAULT if name not in fixed and not idle_without(name, effects))
    return {"effects": effects, "free": free or usual}
