"""`afm-jax design`: which drives to measure next, and what they will determine."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import click
from click import IntRange

from afm_jax.cli.command import Output
from afm_jax.cli.session import Session
from afm_jax.cli.values import ModelName, Names, Numbers, Orders, Share, option_of
from afm_jax.whole_files import in_callers_words
from fitting.experiments.candidates import drive_grid
from fitting.experiments.design import design
from fitting.experiments.prior import Prior, prior_of_values, read_prior
from fitting.parameters import LAW_NAMES, PRIOR_NUISANCES


def planned(  # noqa: PLR0913
    session: Session,
    *,
    orders: Annotated[tuple[int, ...] | None, Orders()] = None,
    detunings: Annotated[tuple[float, ...] | None, Numbers(), "--detuning"] = None,
    amplitudes_nm: Annotated[tuple[float, ...] | None, Numbers(), "--drive-nm"] = None,
    offsets_nm: Annotated[tuple[float, ...] | None, Numbers(positive=False)] = None,
    heights: Annotated[tuple[float, ...] | None, Numbers(positive=False)] = None,
    largest_nm: float | None = None,
    points: Annotated[int, IntRange(1, 200)] = 8,
    interest: Annotated[tuple[str, ...] | None, Names(), "--for"] = None,
    noise: Annotated[float, Share("a relative error")] = 0.01,
    phase_noise_deg: float = 0.2,
    amplitudes: Literal["both", "peak", "lockin"] = "both",
    uncertainty: Annotated[float, Share("a relative error")] = 0.1,
    fit: Annotated[Path | None, "JSON"] = None,
    model: ModelName | None = None,
    mass_ng: float | None = None,
    drive: Literal["sample", "force", "base"] | None = None,
    **law_and_instrument: Any,
) -> Output:
    """Choose the drives to measure next, and forecast how well the law will then be known.

    Give the cantilever (--free-frequency-khz, --quality-factor '40 +- 2') and the law (--r, --epsilon, ...), or a fit
    of what was measured so far (--fit). Candidates are all combinations of orders, frequencies, amplitudes and offsets;
    with --drive force or base (the cantilever is driven, amplitude and lag are read) all combinations of frequencies,
    free amplitudes and heights. LISTs are numbers and ranges, 1,2,5 or 170:190:1. With --out design.csv, .json and
    .png. Exit code 3 if no candidate can be used, or the points do not determine the law.

    Args:
        session: for progress.
        orders: drive periods from impact to impact; else 1-4, or 1 where the tip is driven.
        detunings: drive frequencies as multiples of each order's resonance 2 N f0, else 0.97:1.05:0.01; or of f0 where
            the tip is driven, else 1.02:1.1:0.02.
        amplitudes_nm: drive amplitudes, else 2,4,7,10; or free ones, else 40,80.
        offsets_nm: offsets, where the sample is driven; else -1,0,1.
        heights: where the tip is driven, in place of offsets: distances of the sample as shares of each free amplitude,
            else 0.1:0.9:0.1.
        largest_nm: largest peak amplitude that the instrument can measure.
        points: how many to choose.
        interest: parameters to determine, as r,epsilon; else the law's.
        noise: relative error of an amplitude.
        phase_noise_deg: error of a lag where the tip is driven.
        amplitudes: the readings of a point.
        uncertainty: error of the law that is assumed where no fit gives one.
        fit: a fit to add to, the fit.json of `afm-jax fit --out`, or its folder.
        model: what will be fitted, of the models of `fit`; else law+delay, or the fit's.
        mass_ng: effective mass of the tip.
        drive: what is driven; else the sample.
        **law_and_instrument: numbers of the law, and of the instrument with their errors.
    """
    stated = {"mass_ng": mass_ng, "drive": drive} | law_and_instrument
    prior = prior_of(fit, model, uncertainty, {name: value for name, value in stated.items() if value is not None})
    with session.working("forecasting (the first run compiles for some seconds)"):
        lists = {"orders": orders, "detunings": detunings, "amplitudes_nm": amplitudes_nm}
        known = {"free_frequency_khz": prior.free_frequency_khz, "drive": prior.problem.drive}
        result = design(
            prior,
            drive_grid(**lists, offsets_nm=offsets_nm, heights=heights, **known),
            points=points,
            noise=noise,
            interest=interest,
            amplitudes=amplitudes,
            largest_nm=largest_nm,
            phase_noise_deg=phase_noise_deg,
        )
    return Output.of(result, "design")


def prior_of(path: Path | None, model: str | None, uncertainty: float, given: Mapping[str, Any]) -> Prior:
    """Return what is known before: what a fit left, or the values of a call.

    Raises:
        click.UsageError: if the options contradict each other, or say nothing of the cantilever.
        ValueError: if a value is impossible, or the file cannot be read.
    """
    if path is not None:
        for name in given:
            raise click.UsageError(in_callers_words(f"`{name}` is what `fit=...` says already; leave one of them out"))
        prior = read_prior(path / "fit.json" if path.is_dir() else path, uncertainty)
        if model not in (None, prior.problem.model):
            raise click.UsageError(f"{path} is a fit of the model {prior.problem.model}, not {model}")
        return prior
    if "free_frequency_khz" not in given:
        raise click.UsageError("give --free-frequency-khz (and --quality-factor), or --fit")
    instrument = {nuisance.name: given[nuisance.name] for nuisance in PRIOR_NUISANCES if nuisance.name in given}
    for name, (_, error) in instrument.items():
        if name not in {"quality_factor", "free_frequency_khz"} and error is None:
            raise click.UsageError(f"{option_of(name)} needs its standard error; write 'VALUE +- ERROR'")
    return prior_of_values(
        model or "law+delay",
        free_frequency_khz=given["free_frequency_khz"][0],
        quality_factor=given.get("quality_factor", (None, None))[0],
        mass_ng=given.get("mass_ng"),
        values={name: given[name] for name in LAW_NAMES if name in given},
        constraints={name: both for name, both in instrument.items() if both[1] is not None},
        uncertainty=uncertainty,
        drive=given.get("drive", "sample"),
    )
