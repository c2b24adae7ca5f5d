"""The options of `afm-jax design` about what is known before: the cantilever, the law, or a fit of both."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from afm_jax.cli.fit_options import Fixed, checked_model, named_parameter
from afm_jax.cli.values import Finite, ValueAndError, option_of
from afm_jax.whole_files import in_callers_words
from fitting.parameters import DELAY, DRIFT_NAMES, LAW, MODELS, NUISANCES, PARAMETERS

if TYPE_CHECKING:
    from fitting.experiments.prior import Prior

_LAW = tuple(parameter.name for parameter in (*LAW, *DELAY))
_REMARKS = {"quality_factor": "; none: no air damping", "offset_origin_nm": "; not with a delay"}
_NUISANCES = tuple(nuisance for nuisance in NUISANCES if nuisance.name not in DRIFT_NAMES)
_NUISANCE_NAMES = tuple(nuisance.name for nuisance in _NUISANCES)
_BELONG = ("mass_ng", "spring_constant_n_per_m", "free", "fixed", "value", *_LAW, *_NUISANCE_NAMES)
"""What says the law and the cantilever, where no fit does."""


PRIOR_OPTIONS = (
    click.option(
        "--fit",
        type=click.Path(path_type=Path),
        metavar="JSON",
        help="A fit to add to, as `afm-jax fit --json` writes it, or its folder.",
    ),
    click.option("--model", type=click.Choice(MODELS), help="What will be fitted; else law+delay, or the fit's."),
    click.option(
        "--spring-constant-n-per-m", type=Finite(), metavar="X", help="Or its spring constant, whose mass is k/Omega^2."
    ),
    click.option("--mass-ng", type=Finite(), metavar="X", help="Effective mass of the tip."),
    click.option(
        "--drive",
        type=click.Choice(("sample", "force", "base")),
        help="What is driven: the sample, or the cantilever itself; else the sample.",
    ),
    click.option(
        "--fix", "fixed", type=Fixed(), multiple=True, metavar="NAME=X", help="A parameter that is not fitted."
    ),
    click.option("--free", metavar="NAMES", help="Parameters that a fit would determine, if not all not fixed."),
    click.option("--value", type=Fixed(), multiple=True, metavar="NAME=X", help="A contact's parameter; repeatable."),
    *(
        click.option(
            option_of(name),
            type=Finite(),
            metavar="X",
            help=f"{', '.join(filter(None, (PARAMETERS[name].meaning, PARAMETERS[name].unit)))}; else the paper's.",
        )
        for name in _LAW
    ),
    *(
        click.option(
            option_of(nuisance.name),
            type=ValueAndError(none=nuisance.name == "quality_factor"),
            metavar="X",
            help=f"{nuisance.meaning}, such as '{nuisance.example}'{_REMARKS.get(nuisance.name, '')}.",
        )
        for nuisance in _NUISANCES
    ),
)
"""What is known before: `prior_of_options` takes what a call says of them."""


def prior_of_options(options: Mapping[str, Any]) -> "Prior":
    """Return the prior that the options describe.

    Args:
        options: what a call says of `PRIOR_OPTIONS`; what it does not say may be absent.

    Raises:
        click.UsageError: if they contradict each other, or say nothing of the cantilever.
        ValueError: if a value is impossible, or the file cannot be read.
    """
    given = {name: options[name] for name in _BELONG if options.get(name) not in (None, ())}
    path = options.get("fit")
    if path is None:
        return _from_values(options, given)
    for name in (*given, *(["drive"] if options.get("drive") is not None else [])):
        said = f"`{name}` is what `fit=...` says already; leave one of them out"
        raise click.UsageError(in_callers_words(said))
    from fitting.experiments.prior import read_prior  # noqa: PLC0415

    prior, _ = read_prior(path / "fit.json" if path.is_dir() else path, options["uncertainty"])
    if options.get("model") not in (None, prior.problem.model):
        raise click.UsageError(f"{path} is a fit of the model {prior.problem.model}, not {options['model']}")
    return prior


def _from_values(options: Mapping[str, Any], given: Mapping[str, Any]) -> "Prior":
    from fitting.experiments.prior import prior_of_values  # noqa: PLC0415

    model, free = options.get("model") or "law+delay", _names(given)
    if "free_frequency_khz" not in given:
        raise click.UsageError("give --free-frequency-khz (and --quality-factor), or --fit")
    quality_factor, _ = given.get("quality_factor", (None, None))
    fixed, contact = dict(given.get("fixed", ())), dict(given.get("value", ()))
    own = checked_model(model, free, fixed)
    for name in _NUISANCE_NAMES:
        if name not in {"quality_factor", "free_frequency_khz"} and name in given and given[name][1] is None:
            raise click.UsageError(f"{option_of(name)} needs its standard error; write '{PARAMETERS[name].example}'")
    law_values = {name: value for name, value in given.items() if name in _LAW}
    return prior_of_values(
        model,
        free_frequency_khz=given["free_frequency_khz"][0],
        quality_factor=None if quality_factor == math.inf else quality_factor,
        mass_ng=given.get("mass_ng"),
        spring_constant_n_per_m=given.get("spring_constant_n_per_m"),
        values=law_values | {name: value for name, value in contact.items() if name in own},
        constraints={name: given[name] for name in _NUISANCE_NAMES if given.get(name, (0, None))[1] is not None},
        free=free,
        fixed=fixed | {name: value for name, value in contact.items() if name not in own},
        uncertainty=options["uncertainty"],
        drive=options.get("drive") or "sample",
    )


def _names(given: Mapping[str, Any]) -> tuple[str, ...] | None:
    return tuple(map(named_parameter, given["free"].split(","))) if "free" in given else None
