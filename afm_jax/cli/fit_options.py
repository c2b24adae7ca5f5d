"""Options of `afm-jax fit`: their kinds of values (NAME=VALUE, NAME=VALUE+-ERROR, lists), and which go together."""

from typing import Any

import click

from afm_jax.cli.session import Session
from afm_jax.cli.values import ValueKind, parse_around_plus_minus
from afm_jax.contact.parameters import EFFECTS, REMOVABLE_EFFECTS, idle_without
from afm_jax.whole_files import in_callers_words
from fitting.parameters import CONTACT_DEFAULT, model_parameters


class Fixed(ValueKind):
    """A parameter held at a value: NAME=VALUE."""

    name = "value"

    def read(self, text: str) -> tuple[str, float]:
        """Return name and value."""
        try:
            name, (value,) = _assigned(text)
        except ValueError as error:
            raise ValueError(f"must be NAME=VALUE such as modulus_gpa=80, but is {text}") from error
        return name, value


class Constraint(ValueKind):
    """What is known of a parameter: NAME=VALUE+-ERROR."""

    name = "constraint"

    def read(self, text: str) -> tuple[str, tuple[float, float]]:
        """Return name, value and standard error."""
        try:
            name, (value, error) = _assigned(text)
        except ValueError as fault:
            raise ValueError(f"must be NAME=VALUE+-ERROR such as tip_calibration=1+-0.02, but is {text}") from fault
        return name, (value, error)


def _assigned(text: str) -> tuple[str, list[float]]:
    """Return the name before an equals sign and the numbers after it."""
    name, _, numbers = text.partition("=")
    if not name.strip():
        raise ValueError("names no parameter")
    return name.strip().replace("-", "_"), parse_around_plus_minus(numbers)


class Names(ValueKind):
    """Names in a comma list."""

    name = "names"

    def read(self, text: str) -> tuple[str, ...]:
        """Return the names that a text lists, separated by commas."""
        names = tuple(part.strip() for part in text.split(","))
        if not all(names):
            raise ValueError(f"must be names separated by commas, but is {text}")
        return names


def check_fit(_: Session, options: dict[str, Any]) -> None:
    """Check that the options go together, and add the keywords of `fitting.fit` to them as ``settings``.

    Raises:
        click.UsageError: if options contradict each other or the model.
    """
    if options["example"] == bool(options["tables"]):
        both = "not both: " if options["example"] else ""
        raise click.UsageError(f"{both}give a table to fit, `afm-jax fit TABLE.csv`, or --example for the bundled one")
    if options["posterior"] and len(options["tables"]) > 1:
        raise click.UsageError("--posterior is about one table: give one, or leave it out")
    options["settings"] = fit_settings(options["model"], options)


def fit_settings(model: str, options: dict[str, Any]) -> dict[str, Any]:
    """Return the keywords of `fitting.fit`.

    Raises:
        click.UsageError: if options contradict each other or the model.
    """
    if options["left_out"] and model != "contact":
        raise click.UsageError("--no is about the contact's effects; add --model contact")
    fixed, free = dict(options["fixed"]), options["free"]
    settings: dict[str, Any] = {
        "scale_errors": options["scale_errors"],
        "robust": options["robust"],
        **({"share": options["share"]} if options.get("share") else {}),
        "constraints": dict(options["constraints"]),
        "free": free,
        "fixed": fixed,
    }
    if model == "contact":
        settings["effects"] = effects = _effects(options["left_out"] or ())
        _check_of_use(free or (), fixed, effects)
        settings["free"] = free or _usual_parameters(fixed, effects)
    try:
        model_parameters(model, settings["free"], fixed)
    except ValueError as error:
        raise click.UsageError(in_callers_words(str(error))) from error
    return settings


def _effects(left_out: tuple[str, ...]) -> tuple[str, ...]:
    """Return the contact's effects without those left out."""
    for name in left_out:
        if name not in REMOVABLE_EFFECTS:
            raise click.UsageError(f"--no takes {', '.join(REMOVABLE_EFFECTS)}, but one is {name!r}")
    return tuple(name for name in EFFECTS if name not in left_out)


def _usual_parameters(fixed: dict[str, float], effects: tuple[str, ...]) -> tuple[str, ...]:
    """Return which parameters are fitted if the call names none: the usual ones that are neither fixed nor idle."""
    return tuple(name for name in CONTACT_DEFAULT if name not in fixed and not idle_without(name, effects))


def _check_of_use(free: tuple[str, ...], fixed: dict[str, float], effects: tuple[str, ...]) -> None:
    """Check that some effect uses each parameter of a contact.

    Raises:
        click.UsageError: if one is not.
    """
    for option, names in (("--free", free), ("--fix", tuple(fixed))):
        for name in names:
            missing = idle_without(name, effects)
            if missing:
                raise click.UsageError(f"{option} {name} changes nothing without the effect {' or '.join(missing)}")
