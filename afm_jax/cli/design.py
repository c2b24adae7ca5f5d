"""`afm-jax design`: which drives to measure next, and what they will determine."""

import math
from collections.abc import Mapping
from typing import Any

import click
import numpy as np

from afm_jax.cli.command import Output
from afm_jax.cli.session import Session
from afm_jax.cli.values import option_of
from afm_jax.whole_files import in_callers_words
from fitting.experiments.candidates import drive_grid
from fitting.experiments.design import design
from fitting.experiments.prior import Prior, prior_of_values, read_prior
from fitting.parameters import LAW_NAMES, PRIOR_NUISANCES

_TIP = {"orders": (1,), "detunings": (1.02, 1.04, 1.06, 1.08, 1.1), "amplitudes_nm": (40.0, 80.0)}
_SAMPLE = {"orders": (1, 2, 3, 4), "detunings": np.arange(97, 106) / 100, "amplitudes_nm": (2.0, 4.0, 7.0, 10.0)}
"""What is looked at if a call does not say, where the tip or the sample is driven."""
_OF_DESIGN = ("points", "noise", "interest", "amplitudes", "largest_nm", "phase_noise_deg")


def planned(session: Session, **options: Any) -> Output:
    """Return the drives to measure next, of all combinations of the lists, and what they will determine."""
    prior, places = prior_of_options(options), {"offsets_nm": options["offsets_nm"], "heights": options["heights"]}
    tapping = prior.problem.tapping
    if places == {"offsets_nm": None, "heights": None}:
        places = {"heights": np.arange(1, 10) / 10} if tapping else {"offsets_nm": (-1.0, 0.0, 1.0)}
    lists = {name: options[name] or usual for name, usual in (_TIP if tapping else _SAMPLE).items()}
    with session.working("forecasting (the first run compiles for some seconds)"):
        known = {"free_frequency_khz": prior.free_frequency_khz, "drive": prior.problem.drive}
        result = design(prior, drive_grid(**lists, **places, **known), **{name: options[name] for name in _OF_DESIGN})
    return Output.of(result, "design")


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
