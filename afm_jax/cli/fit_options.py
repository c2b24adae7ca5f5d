"""Texts of `afm-jax fit`'s options turned into values: `NAME=VALUE`, `NAME=VALUE+-ERROR`, lists of names."""

import math
from typing import Any

import click

from afm_jax.cli.number_lists import parse_around_plus_minus, parse_number


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
