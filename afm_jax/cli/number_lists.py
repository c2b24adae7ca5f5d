"""Lists on the command line: numbers and ranges, whole numbers, and values with their errors."""

import math
from typing import Any

import click

_MOST = 100_000


class Numbers(click.ParamType):
    """A comma list of numbers; each part a number or a range start:stop:step that holds the stop if it fits."""

    name = "numbers"

    def __init__(self, *, positive: bool = True):
        """Say whether the numbers must be positive."""
        self.positive = positive

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[float, ...]:
        """Return the numbers that a text says, in its order.

        Raises:
            click.BadParameter: if a part is no such number or range, or there is none.
        """
        if isinstance(value, tuple):
            return value
        try:
            numbers = parse_numbers(str(value))
        except ValueError as error:
            self.fail(f"{error}; write 1,2,5 or start:stop:step", param, ctx)
        if self.positive and min(numbers) <= 0.0:
            self.fail(f"must hold positive numbers, but one is {min(numbers):g}", param, ctx)
        return numbers


class Orders(click.ParamType):
    """A comma list of whole numbers and ranges of them, as `1-3,5`."""

    name = "orders"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, ...]:
        """Return the orders that a text says.

        Raises:
            click.BadParameter: if a part is no positive whole number or range, or there is none.
        """
        if isinstance(value, tuple):
            return value
        try:
            return parse_orders(str(value))
        except ValueError as error:
            self.fail(f"{error}; write 1,2 or 1-4", param, ctx)


class ValueAndError(click.ParamType):
    """A value with its standard error, as `40 +- 2`; without an error it is exact."""

    name = "value"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, float | None]:
        """Return the value and its error, None if exact.

        Raises:
            click.BadParameter: if it is no number, or the error is not positive.
        """
        if isinstance(value, tuple):
            return value
        try:
            numbers = parse_around_plus_minus(str(value))
        except ValueError as error:
            self.fail(f"{error}; write 40 or '40 +- 2'", param, ctx)
        if len(numbers) > 2 or (len(numbers) == 2 and numbers[1] <= 0.0):
            self.fail(f"`{value}` is no value with a positive error; write '40 +- 2'", param, ctx)
        return numbers[0], numbers[1] if len(numbers) == 2 else None


def parse_numbers(text: str) -> tuple[float, ...]:
    """Return the numbers that a text lists.

    >>> parse_numbers("-1,0,2:3:0.5")
    (-1.0, 0.0, 2.0, 2.5, 3.0)

    Raises:
        ValueError: if it lists none, or a part is no finite number or no rising range.
    """
    if not text.strip():
        raise ValueError("names no number")
    numbers: list[float] = []
    for part in text.split(","):
        numbers += _range(part) if ":" in part else [parse_number(part)]
        if len(numbers) > _MOST:
            raise ValueError(f"names more than {_MOST} numbers")
    return tuple(numbers)


def parse_orders(text: str) -> tuple[int, ...]:
    """Return the whole numbers that a text lists.

    >>> parse_orders("1-3,5")
    (1, 2, 3, 5)

    Raises:
        ValueError: if a part is no positive whole number or rising range.
    """
    orders: list[int] = []
    for part in text.split(","):
        ends = [end.strip() for end in part.split("-")]
        if len(ends) > 2 or not all(end.isascii() and end.isdigit() and 0 < len(end) < 4 for end in ends):
            raise ValueError(f"`{part.strip()}` is no order")
        low, high = int(ends[0]), int(ends[-1])
        if low < 1 or high < low:
            raise ValueError(f"`{part.strip()}` is no order")
        orders += range(low, high + 1)
    return tuple(dict.fromkeys(orders))


def _range(part: str) -> list[float]:
    ends = part.split(":")
    if len(ends) != 3:
        raise ValueError(f"`{part.strip()}` is no range")
    start, stop, step = (parse_number(end) for end in ends)
    if step <= 0.0 or stop < start:
        raise ValueError(f"`{part.strip()}` does not rise")
    # a hair more than the quotient, so that rounding does not cost the stop
    steps = (stop - start) / step * (1.0 + 1e-12) + 1e-9
    if steps > _MOST:
        raise ValueError(f"`{part.strip()}` has more than {_MOST} numbers")
    # rounded to what was meant: 0.97 + 3 * 0.01 is 1
    return [float(f"{start + step * index:.12g}") for index in range(math.floor(steps) + 1)]


def parse_around_plus_minus(text: str) -> list[float]:
    """Return the numbers that a text has around +-, +/- or ±.

    >>> parse_around_plus_minus("40 +- 2")
    [40.0, 2.0]

    Raises:
        ValueError: if one of them is no finite number.
    """
    return [parse_number(part) for part in text.replace("±", "+-").replace("+/-", "+-").split("+-")]


def parse_number(text: str) -> float:
    """Return the number that a text says.

    Raises:
        ValueError: if it is no finite number.
    """
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise ValueError(f"`{text.strip()}` is not a number")
    return number
