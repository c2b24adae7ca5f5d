"""Speeds on the command line: numbers and ranges in a comma list, as `12,15,20:200:10`."""

import math
from typing import Any

import click

_MOST = 1_000_000


class Speeds(click.ParamType):
    """A comma list of speeds in nm/us; each part a number or a range start:stop:step that holds the stop if it fits."""

    name = "speeds"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[float, ...]:
        """Return the speeds that a text says, in its order.

        Raises:
            click.BadParameter: if a part is no positive number or no rising range, or there is none.
        """
        if isinstance(value, tuple):
            return value
        try:
            return parse_speeds(str(value))
        except ValueError as error:
            self.fail(f"{error}; write 12,15,20 or start:stop:step", param, ctx)


def parse_speeds(text: str) -> tuple[float, ...]:
    """Return the speeds that a text lists.

    >>> parse_speeds("12,15,20:50:10")
    (12.0, 15.0, 20.0, 30.0, 40.0, 50.0)

    Raises:
        ValueError: if it lists none, or a part is no positive number or no rising range.
    """
    if not text.strip():
        raise ValueError("names no speed")
    speeds: list[float] = []
    for part in text.split(","):
        speeds += _range(part) if ":" in part else [_positive(part, "speed")]
        if len(speeds) > _MOST:
            raise ValueError(f"names more than {_MOST} speeds")
    return tuple(speeds)


def parse_speed_range(text: str) -> tuple[float, float]:
    """Return the two speeds of `low:high`.

    >>> parse_speed_range("12:150")
    (12.0, 150.0)

    Raises:
        ValueError: if it is no rising pair of positive numbers.
    """
    ends = text.split(":")
    if len(ends) != 2:
        raise ValueError(f"`{text.strip()}` is no range")
    low, high = _positive(ends[0], "lower end"), _positive(ends[1], "upper end")
    if high <= low:
        raise ValueError(f"`{text.strip()}` does not rise")
    return low, high


def _range(part: str) -> list[float]:
    ends = part.split(":")
    if len(ends) != 3:
        raise ValueError(f"`{part.strip()}` is no range")
    start, stop, step = (_positive(end, what) for end, what in zip(ends, ("start", "stop", "step"), strict=True))
    if stop < start:
        raise ValueError(f"`{part.strip()}` ends below its start")
    # a hair more than the quotient, so that rounding does not cost the stop
    steps = (stop - start) / step * (1.0 + 1e-12)
    if steps > _MOST:
        raise ValueError(f"`{part.strip()}` has more than {_MOST} speeds")
    return [start + step * index for index in range(math.floor(steps) + 1)]


def _positive(text: str, what: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not (number > 0.0 and math.isfinite(number)):
        raise ValueError(f"the {what} `{text.strip()}` is not a positive number")
    return number
