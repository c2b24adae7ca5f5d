"""The options of `afm-jax design` about what is known before: the cantilever, the law, or a fit of both."""

import functools
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from afm_jax.cli.values import Finite, ValueAndError, example_path, option_of, parse_number
from fitting.parameters import DELAY, DRIFT_NAMES, LAW, MODELS, NUISANCES, PARAMETERS, model_parameters

if TYPE_CHECKING:
    from afm_jax.impact.law import TabulatedLaw
    from fitting.experiments.prior import Prior

_LAW = tuple(parameter.name for parameter in (*LAW, *DELAY))
_REMARKS = {"quality_factor": "; none: no air damping", "offset_origin_nm": "; not with a delay"}
_NUISANCES = tuple(nuisance for nuisance in NUISANCES if nuisance.name not in DRIFT_NAMES)
_NUISANCE_NAMES = tuple(nuisance.name for nuisance in _NUISANCES)
_BELONG = ("mass_ng", "spring_constant_n_per_m", "free", "fix", "value", *_LAW, *_NUISANCE_NAMES)


class PriorOptions(NamedTuple):
    """The options as they were given; None where they were not."""

    fit: Path | None
    measured: Path | None
    model: str | None
    uncertainty: float
    drive: str | None
    law: Path | None
    numbers: Mapping[str, Any]


class Assignment(click.ParamType):
    """A parameter's value, as `relative_humidity=0.4`."""

    name = "assignment"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[str, float]:
        """Return name and value.

        Raises:
            click.BadParameter: if it is no name, equals sign and number.
        """
        if isinstance(value, tuple):
            return value
        name, _, number = str(value).partition("=")
        try:
            return name.strip().replace("-", "_"), parse_number(number)
        except ValueError:
            self.fail(f"`{value}` is no NAME=NUMBER, such as relative_humidity=0.4", param, ctx)


def with_prior_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """Give a command the options of a prior; it gets them as `prior_options`."""

    @functools.wraps(function)
    def command(
        *args: Any,
        fit: Path | None,
        measured: Path | None,
        model: str | None,
        uncertainty: float,
        drive: str | None,
        law: Path | None,
        **options: Any,
    ) -> Any:
        if options.pop("example"):
            if measured is not None:
                raise click.UsageError("--measured and --example both name a table; give one of them")
            measured, model = example_path(), model or "law"
        numbers = {name: options.pop(name) for name in _BELONG}
        given = {name: value for name, value in numbers.items() if value not in (None, ())}
        return function(
            *args, prior_options=PriorOptions(fit, measured, model, uncertainty, drive, law, given), **options
        )

    # click lists options in the order of the decorators, the last one first
    for nuisance in _NUISANCES[::-1]:
        what = f"{nuisance.meaning}, such as '{nuisance.example}'{_REMARKS.get(nuisance.name, '')}."
        kind = ValueAndError(none=nuisance.name == "quality_factor")
        command = click.option(option_of(nuisance.name), type=kind, metavar="X", help=what)(command)
    for name in _LAW[::-1]:
        what = ", ".join(filter(None, (PARAMETERS[name].meaning, PARAMETERS[name].unit)))
        command = click.option(option_of(name), type=Finite(), metavar="X", help=f"{what}; else the paper's.")(command)
    value = "--value", "value"
    for decorate in (
        click.option(
            *value, type=Assignment(), multiple=True, metavar="NAME=X", help="A contact's parameter; repeatable."
        ),
        click.option("--free", metavar="NAMES", help="Parameters that a fit would determine, if not all not fixed."),
        click.option(
            "--fix", type=Assignment(), multiple=True, metavar="NAME=X", help="A parameter that is not fitted."
        ),
        click.option(
            "--drive",
            type=click.Choice(("sample", "force", "base")),
            help="What is driven: the sample, or the cantilever itself; else the sample, or as measured.",
        ),
        click.option("--mass-ng", type=Finite(), metavar="X", help="Effective mass of the tip."),
        click.option(
            "--spring-constant-n-per-m",
            type=Finite(),
            metavar="X",
            help="Or its spring constant, whose mass is k/Omega^2.",
        ),
        click.option("--model", type=click.Choice(MODELS), help="What will be fitted; else law+delay, or the fit's."),
        click.option(
            "--measured",
            type=click.Path(path_type=Path),
            metavar="CSV",
            help="An amplitude table to add to: it is fitted first.",
        ),
        click.option("--example", is_flag=True, help="Add to the bundled table: --measured with it, --model law."),
        click.option(
            "--fit",
            type=click.Path(path_type=Path),
            metavar="JSON",
            help="A fit to add to, as `afm-jax fit --json` writes it.",
        ),
        click.option(
            "--law",
            type=click.Path(path_type=Path),
            metavar="FILE",
            help="A law.csv, a law.json of `collide --make-law`, or a CSV of measured speeds: the model's formula that "
            "is closest to it is planned with. A fit.json is what --fit is.",
        ),
    ):
        command = decorate(command)
    return command


def prior_of_options(options: PriorOptions, noise: float) -> "Prior":
    """Return the prior that the options describe.

    Args:
        options: as given.
        noise: relative error of amplitudes of a measured table that has none of its own.

    Raises:
        click.UsageError: if they contradict each other, or say nothing of the cantilever.
        ValueError: if a value is impossible, or a file cannot be read.
    """
    sources = {"--fit": options.fit, "--measured": options.measured, "--law": options.law}
    known = [name for name, path in sources.items() if path is not None]
    if len(known) > 1:
        raise click.UsageError(f"{known[0]} and {known[1]} both say what is known; give one of them")
    if not known:
        return _from_values(options)
    if options.law is not None:
        from afm_jax.scenefile.law_files import law_and_fit  # noqa: PLC0415

        law, found = law_and_fit(options.law)
        if not found:
            return _from_values(options, law)
        fitted = options.law / "fit.json" if options.law.is_dir() else options.law
        options = options._replace(fit=fitted)
    (source,) = known
    for name in options.numbers:
        if options.measured is None or name not in {"free", "fix"}:
            raise click.UsageError(f"{option_of(name)} is what {source} says already; leave one of them out")
    if options.drive is not None:
        raise click.UsageError(f"--drive is what {source} says already; leave one of them out")
    from fitting.experiments.prior import prior_of_fit, read_prior  # noqa: PLC0415

    if options.fit is not None:
        prior, _ = read_prior(options.fit, options.uncertainty)
        if options.model not in (None, prior.problem.model):
            raise click.UsageError(f"{options.fit} is a fit of the model {prior.problem.model}, not {options.model}")
        return prior
    from fitting.fits.fit import fit  # noqa: PLC0415
    from fitting.tables.table import read_table  # noqa: PLC0415

    table = read_table(options.measured or "", noise=noise)
    return prior_of_fit(
        fit(table, options.model or "law+delay", free=_names(options), fixed=dict(options.numbers.get("fix", ()))),
        options.uncertainty,
    )


def _from_values(options: PriorOptions, law: "TabulatedLaw | None" = None) -> "Prior":
    from fitting.experiments.prior import prior_of_values  # noqa: PLC0415

    usual = "law+delay" if law is None or law.delayed else "law"
    numbers, model, free = options.numbers, options.model or usual, _names(options)
    if "free_frequency_khz" not in numbers:
        raise click.UsageError("give --free-frequency-khz (and --quality-factor), or --fit or --measured")
    quality_factor, _ = numbers.get("quality_factor", (None, None))
    if quality_factor == math.inf:
        quality_factor = None
    fixed = dict(numbers.get("fix", ()))
    try:
        own = model_parameters(model, free, fixed)
    except ValueError as error:
        raise click.UsageError(str(error).replace("`free`", "--free").replace("`fixed`", "--fix")) from error
    contact = dict(numbers.get("value", ()))
    values = {name: value for name, value in numbers.items() if name in _LAW}
    for name in _NUISANCE_NAMES:
        if name not in {"quality_factor", "free_frequency_khz"} and name in numbers and numbers[name][1] is None:
            raise click.UsageError(f"{option_of(name)} needs its standard error; write '{PARAMETERS[name].example}'")
    return prior_of_values(
        model,
        free_frequency_khz=numbers["free_frequency_khz"][0],
        quality_factor=quality_factor,
        mass_ng=numbers.get("mass_ng"),
        spring_constant_n_per_m=numbers.get("spring_constant_n_per_m"),
        values=values | {name: value for name, value in contact.items() if name in own},
        constraints={name: numbers[name] for name in _NUISANCE_NAMES if numbers.get(name, (0, None))[1] is not None},
        free=free,
        fixed=fixed | {name: value for name, value in contact.items() if name not in own},
        uncertainty=options.uncertainty,
        drive=options.drive or "sample",
        law=law,
    )


def _names(options: PriorOptions) -> tuple[str, ...] | None:
    names = options.numbers.get("free")
    return None if names is None else tuple(name.strip().replace("-", "_") for name in names.split(","))
