"""`afm-jax fit TABLE.csv`: the impact law from measured vibration amplitudes.

Texts of `afm-jax fit`'s options turned into values: `NAME=VALUE`, `NAME=VALUE+-ERROR`, lists of names.
"""

import math
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from afm_jax.cli.each import fit_tables
from afm_jax.cli.main import NotValid
from afm_jax.cli.options import NOISE, QUALITY_FACTOR
from afm_jax.cli.session import FIT_PROGRAMS, Session, prepare_folder, with_session
from afm_jax.cli.values import (
    example_path,
    parse_around_plus_minus,
    parse_number,
    tables_with,
)
from afm_jax.contact.parameters import EFFECTS, REMOVABLE_EFFECTS, idle_without
from afm_jax.words import text_table
from fitting.parameters import CONTACT_DEFAULT, DELAY_LAW, LAWS, MODELS, NUISANCE_NAMES, model_parameters

if TYPE_CHECKING:
    from fitting.fits.fit import Found
    from fitting.fits.result import FitResult
    from fitting.sampling.posterior_result import Posterior
    from fitting.sampling.trust_pack import TrustPack


class Fixed(click.ParamType):
    """A parameter held at a value: NAME=VALUE."""

    name = "value"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[str, float]:
        """Return name and value.

        Raises:
            click.BadParameter: if the text is something else.
        """
        name, sign, text = str(value).partition("=")
        try:
            number = parse_number(text)
        except ValueError:
            sign, number = "", math.nan
        if not sign or not name.strip():
            self.fail(f"must be NAME=VALUE such as modulus_gpa=80, but is {value}", param, ctx)
        return name.strip(), number


class Constraint(click.ParamType):
    """What is known of a parameter: NAME=VALUE+-ERROR."""

    name = "constraint"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[str, tuple[float, float]]:
        """Return name, value and standard error.

        Raises:
            click.BadParameter: if the text is something else.
        """
        name, sign, text = str(value).partition("=")
        try:
            numbers = parse_around_plus_minus(text)
        except ValueError:
            numbers = []
        if not sign or not name.strip() or len(numbers) != 2:
            self.fail(f"must be NAME=VALUE+-ERROR such as tip_calibration=1+-0.02, but is {value}", param, ctx)
        return name.strip(), (numbers[0], numbers[1])


class Names(click.ParamType):
    """Names in a comma list."""

    name = "names"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[str, ...]:
        """Return the names.

        Raises:
            click.BadParameter: if one is blank.
        """
        names = tuple(part.strip() for part in str(value).split(","))
        if not all(names):
            self.fail(f"must be names separated by commas, but is {value}", param, ctx)
        return names


@click.command()
@click.argument("tables", metavar="[TABLE.csv]...", nargs=-1, type=click.Path(path_type=Path))
@click.option(
    "--model",
    default="law",
    show_default=True,
    type=click.Choice(MODELS),
    help="; ".join(f"{name}: {law.meaning}" for name, law in LAWS.items())
    + f"; each with {DELAY_LAW.meaning} (+delay); contact: physical parameters through the resolved contact, "
    "of tapping curves on resonance too.",
)
@NOISE
@QUALITY_FACTOR
@click.option(
    "--scale-errors",
    is_flag=True,
    help="Take the errors as relative: scale them, by 3 at most, until chi2/dof is 1.",
)
@click.option("--robust", is_flag=True, help="Let outliers, one row in ten at most, count linearly from two errors on.")
@click.option(
    "--free",
    type=Names(),
    metavar="NAME,...",
    help="The parameters that are fitted, if not all that are not fixed; of a contact, if left out, "
    f"{','.join(CONTACT_DEFAULT)}.",
)
@click.option("--fix", type=Fixed(), multiple=True, metavar="NAME=VALUE", help="Hold a parameter at a value.")
@click.option(
    "--constrain",
    type=Constraint(),
    multiple=True,
    metavar="NAME=VALUE+-ERROR",
    help=f"What is known beforehand: {', '.join(NUISANCE_NAMES)}, or a parameter of the model; "
    "of a contact also one that is held, at the value then.",
)
@click.option("--no", "left_out", type=Names(), metavar="EFFECT,...", help="contact: effects that it does not have.")
@click.option("--compare", "comparing", is_flag=True, help="Fit the rival models too and say what the table can tell.")
@click.option(
    "--bootstrap",
    type=click.IntRange(min=50, max=100_000),
    metavar="SAMPLES",
    help="Intervals by refitting this many synthetic tables, too.",
)
@click.option(
    "--posterior", is_flag=True, help="Credible intervals, too: by a grid, or NUTS for more than two parameters."
)
@click.option(
    "--trust",
    is_flag=True,
    help="What speaks for the posterior and against it, too (with --posterior): predicted readings, ranks in 100 "
    "simulated tables, leave-one-out, influence of single rows.",
)
@click.option(
    "--arviz",
    metavar="FILE.nc",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Write the posterior for ArviZ (with --posterior; extra `arviz`).",
)
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Of everything random.")
@click.option(
    "--share",
    type=Names(),
    metavar="NAME,...",
    help="Of several tables: nuisances (of --constrain) that all have in common, or all; left out, each has its own.",
)
@click.option(
    "--hierarchical", is_flag=True, help="Let the laws of several tables scatter around their mean, and say how much."
)
@click.option("--example", is_flag=True, help="Fit the bundled table instead of a file.")
@click.option("--each", is_flag=True, help="Fit each of several tables by itself; with --out what is done is kept.")
@click.option("--workers", type=click.IntRange(1, 1024), metavar="N", help="Processes that --each takes, by Dask.")
@with_session
def command(session: Session, tables: tuple[Path, ...], model: str, noise: float | None, **options: Any) -> None:
    """Fit the impact law to a table of vibration amplitudes, or one law to several tables.

    The table is a CSV file: comment lines `# free_frequency_khz = 90`, `# quality_factor = 40 +- 1`, and columns
    order, drive_frequency_khz, drive_amplitude_nm, offset_nm, peak_amplitude_nm and/or lockin_amplitude_nm, each
    with its ..._error_nm; a column no_orbit marks by 1 drives on which the tip settled on nothing; phase_deg
    counts too. With a line `# drive = force` (or base) it is a tapping curve: drive_frequency_khz, free_amplitude_nm,
    offset_nm, lockin_amplitude_nm and phase_lag_deg. Several tables have one law, each nuisances of its own or shared
    ones, and the report says how far each is from the others (its pull). With --out the report: fit.html, fit.txt,
    fit.json, fit.png, fit_rows.csv, law.csv, and with --trust trust.png, trust_rows.csv. Exit code 3 if the result is
    not valid: not converged, not explained by the model, or a parameter not identified.
    """
    if options["example"] == bool(tables):
        both = "not both: " if options["example"] else ""
        raise click.UsageError(f"{both}give a table to fit, `afm-jax fit TABLE.csv`, or --example for the bundled one")
    _check_each(tables, options)
    settings = _settings(model, options)
    if options["each"]:
        read = tables_with(tables, noise, options["quality_factor"])
        fit_tables(session, read, {"model": model, **settings}, options["workers"])
        return
    session.start_computing(*FIT_PROGRAMS)
    from fitting.fits.fit import find_fit, summarise_in_units  # noqa: PLC0415
    from fitting.report.report import summary  # noqa: PLC0415
    from fitting.tables.several import SeveralTables  # noqa: PLC0415

    if options["arviz"] is not None:
        from fitting.sampling.inference_data import require_netcdf  # noqa: PLC0415

        prepare_folder(options["arviz"].absolute().parent)
        require_netcdf()
    options["posterior"] = options["posterior"] or options["trust"] or options["arviz"] is not None
    read = tables_with(tables or (example_path(),), noise, options["quality_factor"])
    measured = read[0] if len(read) == 1 else SeveralTables(tuple(read))
    first = "the first run compiles for half a minute" if "delay" in model or model == "contact" else "some seconds"
    rows = f"{measured.rows} rows" + (f" of {len(read)} tables" if len(read) > 1 else "")
    with session.working(f"fitting {rows}, model {model} ({first})"):
        found = find_fit(measured, model, **settings)
        result = summarise_in_units(measured, found)
    extras, failure = _extras(session, found, result, settings, options)
    payload = result.to_dict() | {name: extra.to_dict() for name, extra in extras.items()}
    session.emit(payload, partial(summary, result), *(partial(_words, name, extra) for name, extra in extras.items()))
    if session.out is not None:
        from fitting.report.report import write_report  # noqa: PLC0415

        for path in write_report(result, session.out, session.write_table, **extras):
            session.note(f"wrote {path}")
    if failure is not None:
        raise failure
    if not result.valid:
        raise NotValid(result.reasons[0])


def _check_each(tables: tuple[Path, ...], options: dict[str, Any]) -> None:
    """Check that options are those of one table, of several together, or of each of several by itself.

    Raises:
        click.UsageError: if not.
    """
    for option in ("share", "hierarchical"):
        if options[option] and (len(tables) < 2 or options["each"]):
            raise click.UsageError(f"--{option} is about several tables that are fitted together; leave it out")
    if options["workers"] is not None and not options["each"]:
        raise click.UsageError("--workers is about several tables: add --each")
    alone = {
        "--example": "example",
        "--compare": "comparing",
        "--bootstrap": "bootstrap",
        "--posterior": "posterior",
        "--trust": "trust",
        "--arviz": "arviz",
    }
    for option, name in alone.items():
        if options["each"] and options[name]:
            raise click.UsageError(f"{option} is about one table: leave --each out")
        if len(tables) > 1 and options[name] and option != "--compare":
            raise click.UsageError(f"{option} is about one table: give one, or leave it out")
    if options["comparing"] and options["hierarchical"]:
        raise click.UsageError("--compare is about tables that have one law: leave --hierarchical out")


def _settings(model: str, options: dict[str, Any]) -> dict[str, Any]:
    """Return the keywords of `fitting.fit`.

    Raises:
        click.UsageError: if options contradict each other or the model.
    """
    if options["left_out"] and model != "contact":
        raise click.UsageError("--no is about the contact's effects; add --model contact")
    fixed, free = dict(options["fix"]), options["free"]
    settings: dict[str, Any] = {
        "scale_errors": options["scale_errors"],
        "robust": options["robust"],
        **{name: options[name] for name in ("share", "hierarchical") if options.get(name)},
        "constraints": dict(options["constrain"]),
        "free": free,
        "fixed": fixed,
    }
    for name in free or ():
        if name in fixed:
            raise click.UsageError(f"{name} is both fitted (--free) and held fixed (--fix); remove it from one")
    if model == "contact":
        settings["effects"] = effects = _effects(options["left_out"] or ())
        _check_of_use(free or (), fixed, effects)
        settings["free"] = free or _usual_parameters(fixed, effects)
    try:
        model_parameters(model, settings["free"], fixed)
    except ValueError as error:
        raise click.UsageError(str(error).replace("`free`", "--free").replace("`fixed`", "--fix")) from error
    return settings


def _effects(left_out: tuple[str, ...]) -> tuple[str, ...]:
    """Return the contact's effects without those left out."""
    for name in left_out:
        if name not in REMOVABLE_EFFECTS:
            raise click.UsageError(f"--no takes {', '.join(REMOVABLE_EFFECTS)}, but one is {name!r}")
    return tuple(name for name in EFFECTS if name not in left_out)


def _usual_parameters(fixed: dict[str, float], effects: tuple[str, ...]) -> tuple[str, ...]:
    """Return which parameters are fitted if the call names none: the usual ones that are neither fixed nor idle."""
    chosen = [name for name in CONTACT_DEFAULT if name not in fixed and not idle_without(name, effects)]
    if not chosen:
        raise click.UsageError("--fix holds every parameter that is usually fitted; name others to fit with --free")
    return tuple(chosen)


def _check_of_use(free: tuple[str, ...], fixed: dict[str, float], effects: tuple[str, ...]) -> None:
    """Check that each parameter of a contact is of use.

    Raises:
        click.UsageError: if one is not.
    """
    for option, names in (("--free", free), ("--fix", tuple(fixed))):
        for name in names:
            missing = idle_without(name, effects)
            if missing:
                raise click.UsageError(f"{option} {name} changes nothing without the effect {' or '.join(missing)}")


def _extras(
    session: Session, found: "Found", result: "FitResult", settings: dict[str, Any], options: dict[str, Any]
) -> tuple[dict[str, Any], Exception | None]:
    """Return what was asked for besides the fit, as far as it came, and what ended it: the fit itself stands."""
    extras: dict[str, Any] = {}
    for name in ("bootstrap", "posterior", "trust", "arviz"):
        if options[name] and not result.valid:
            session.note(f"no {name}: the fit is not valid")
    try:
        if options["comparing"]:
            extras["comparison"] = _comparison(session, found, result, settings)
        if options["bootstrap"] and result.valid:
            extras["bootstrap"] = _bootstrap(session, result, options["bootstrap"], options["seed"])
        if options["posterior"] and result.valid:
            extras["posterior"] = believed = _posterior(session, result, options["seed"])
            if options["arviz"]:
                _write_arviz(session, result, believed, options)
            if options["trust"]:
                extras["trust"] = _trust(session, result, believed, options["seed"])
    except Exception as error:  # noqa: BLE001
        return extras, error
    return extras, None


def _comparison(session: Session, found: "Found", result: "FitResult", settings: dict[str, Any]) -> Any:
    from fitting.fits.comparison import compare, rivals  # noqa: PLC0415

    models = rivals(result.model, settings["fixed"])
    with session.working(f"comparing {', '.join(models)}", "models") as tell:
        return compare(
            result.table,
            models,
            report=lambda model: tell(models.index(model), len(models)),
            known={result.model: (found, result)},
            **settings,
        )


def _bootstrap(session: Session, result: "FitResult", samples: int, seed: int) -> Any:
    from fitting.sampling.bootstrap import bootstrap  # noqa: PLC0415

    with session.working(f"fitting {samples} synthetic tables"):
        return bootstrap(result, samples=samples, seed=seed)


def _posterior(session: Session, result: "FitResult", seed: int) -> Any:
    from fitting.sampling.posterior import posterior  # noqa: PLC0415

    with session.working("sampling the posterior"):
        return posterior(result, seed=seed)


def _write_arviz(session: Session, result: "FitResult", found: "Posterior", options: dict[str, Any]) -> None:
    from fitting.sampling.inference_data import write_inference_data  # noqa: PLC0415

    write_inference_data(result, found, options["arviz"], seed=options["seed"])
    session.note(f"wrote {options['arviz']}")


def _trust(session: Session, result: "FitResult", found: "Posterior", seed: int) -> "TrustPack":
    from fitting.sampling.trust_pack import trust  # noqa: PLC0415

    with session.working("checking the posterior", "simulated tables") as report:
        return trust(result, found, seed=seed, report=report)


def _words(name: str, extra: Any) -> str:
    """Return a comparison, a bootstrap, a posterior or what speaks for it as text."""
    if name == "trust":
        from fitting.report.words import trust_in_words  # noqa: PLC0415

        head = [f"  - {line}" for line in extra.complaints] or ["  Nothing speaks against it."]
        return "\n".join(["", "Trust in the posterior:", *head, *(f"  {line}" for line in trust_in_words(extra))])
    if name == "comparison":
        cells = [
            [
                row["model"],
                f"{row['chi2']:.1f}/{row['degrees_of_freedom']}",
                f"{row['aic']:.1f}",
                f"{row['bic']:.1f}",
                f"{100.0 * row['law_change']:.2f} %",
            ]
            for row in extra.rows
        ]
        lines = text_table(["model", "chi2/dof", "AIC", "BIC", "law differs"], cells)
        lines += [f"  {model:<18} failed: {reason}" for model, reason in extra.failed.items()]
        head = "Models, best first (AIC and BIC: of the formula alone, on the rows that all models use):"
        return "\n".join(["", head, *lines, f"  {extra.verdict}"])
    intervals = {key: found["interval95"] for key, found in extra.to_dict()["parameters"].items()}
    head = "95 % credible intervals (posterior, flat priors):"
    if name == "bootstrap":
        head = f"95 % intervals of {len(extra.samples)} synthetic tables (bootstrap):"
    lines = text_table(
        ["parameter", "from", "to"], [[key, *(f"{e:.6g}" for e in ends)] for key, ends in intervals.items()]
    )
    return "\n".join(["", head, *lines])
