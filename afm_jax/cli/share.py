"""A share on the command line: `1%`, `1 %` or `0.01`."""

import math
from typing import Any

import click


class Share(click.ParamType):
    """A share between 0 and 100 %, neither of the two."""

    name = "share"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Return the share that a text says, as a number between 0 and 1.

        Raises:
            click.BadParameter: if it is none.
        """
        try:
            share = parse_share(str(value))
        except ValueError as error:
            self.fail(str(error), param, ctx)
        return share


def parse_share(text: str) -> float:
    """Return the share that a text says.

    >>> parse_share("1 %"), parse_share("0.01")
    (0.01, 0.01)

    Raises:
        ValueError: if it is no number, or not between 0 and 100 %.
    """
    number, percent, rest = text.strip().partition("%")
    try:
        share = float(number) / (100.0 if percent else 1.0)
    except ValueError:
        share = math.nan
    if rest or not 0.0 < share < 1.0:
        raise ValueError(f"must be above 0 and below 100 %, as in 1% or 0.01, but is {text.strip()!r}")
    return share
