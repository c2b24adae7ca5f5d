"""`afm-jax design`: which drives to measure next, and what they will determine."""

import math
from collections.abc import Mapping
from typing import Any

import click

from afm_jax.cli.command import Output, later
from afm_jax.cli.session import Session
from afm_jax.cli.values import Numbers, Orders, option_of
from afm_jax.plots.picture_style import save
from afm_jax.whole_files import in_callers_words
from fitting.experiments.candidates import drive_grid
from fitting.experiments.design import design
from fitting.experiments.prior import Prior, prior_of_values, read_prior
from fitting.parameters import LAW_NAMES, PRIOR_NUISANCES

_TAPPING = {"orders": "1", "detuning": "1.02:1.1:0.02", "drive_nm": "40,80", "heights": "0.1:0.9:0.1"}
_SAMPLE = {"orders": "1-4", "detuning": "0.97:1.05:0.01", "drive_nm": "2,4,7,10", "offsets_nm": "-1,0,1"}
_OF_DESIGN = ("points", "noise", "amplitudes", "largest_nm", "phase_noise_deg")


def planned(session: Session, *, interest: str | None, **options: Any) -> Output:
    """Return the drives to measure next, of all combinations of the lists, and what they will determine."""
    prior = prior_of_options(options)
    usual = _TAPPING if prior.problem.tapping else _SAMPLE
    chosen = {name: options[name] for name in ("orders", "detuning", "drive_nm", "offsets_nm", "heights")}
    for name, text in usual.items():
        said = chosen[name] is not None or (name == "heights" and chosen["offsets_nm"] is not None)
        kind = Orders() if name == "orders" else Numbers(positive=False)
        chosen[name] = chosen[name] if said else kind.convert(text, None, None)
    names = None if interest is None else tuple(name.strip().replace("-", "_") for name in interest.split(","))
    with session.working("forecasting (the first run compiles for some seconds)"):
        drives = drive_grid(
            orders=chosen["orders"],
            amplitudes_nm=chosen["drive_nm"],
            offsets_nm=chosen["offsets_nm"] or (0.0,),
            heights=chosen["heights"],
            detunings=chosen["detuning"],
            free_frequency_khz=prior.free_frequency_khz,
            drive=prior.problem.drive,
        )
        result = design(prior, drives, interest=names, **{name: options[name] for name in _OF_DESIGN})
    figure = later("fitting.experiments.picture:design_figure")
    return Output.of(result, files={"design.png": lambda path: save(figure(result), path)}, json_file="design.json")


def prior_of_options(options: Mapping[str, Any]) -> Prior:
    """Return what is known before: what a fit left, or the values of a call.

    Raises:
        click.UsageError: if the options contradict each other, or say nothing of the cantilever.
        ValueError: if a value is impossible, or the file cannot be read.
    """
    known = ("mass_ng", "drive", *LAW_NAMES, *(nuisance.name for nuisance in PRIOR_NUISANCES))
    given = {name: options[name] for name in known if options.get(name) is not None}
    path, model = options.get("fit"), options.get("model")
    if path is not None:
        for name in given:
            raise click.UsageError(in_callers_words(f"`{name}` is what `fit=...` says already; leave one of them out"))
        prior = read_prior(path / "fit.json" if path.is_dir() else path, options["uncertainty"])
        if model not in (None, prior.problem.model):
            raise click.UsageError(f"{path} is a fit of the model {prior.problem.model}, not {model}")
        return prior
    if "free_frequency_khz" not in given:
        raise click.UsageError("give --free-frequency-khz (and --quality-factor), or --fit")
    instrument = {nuisance.name: given[nuisance.name] for nuisance in PRIOR_NUISANCES if nuisance.name in given}
    for name, (_, error) in instrument.items():
        if name not in {"quality_factor", "free_frequency_khz"} and error is None:
            raise click.UsageError(f"{option_of(name)} needs its standard error; write 'VALUE +- ERROR'")
    quality_factor, _ = given.get("quality_factor", (math.inf, None))
    return prior_of_values(
        model or "law+delay",
        free_frequency_khz=given["free_frequency_khz"][0],
        quality_factor=None if quality_factor == math.inf else quality_factor,
        mass_ng=given.get("mass_ng"),
        values={name: given[name] for name in LAW_NAMES if name in given},
        constraints={name: both for name, both in instrument.items() if both[1] is not None},
        uncertainty=options["uncertainty"],
        drive=given.get("drive", "sample"),
    )
