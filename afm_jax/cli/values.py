"""Kinds of values on the command line (numbers, lists, shares, grids), and what options name in files.

A kind makes a value of a text, and says in a sentence what is wrong with the text where it makes none.
"""

import math
import re
from contextlib import suppress
from typing import Annotated, Any, Literal

import click

from afm_jax.words import value_and_error
from fitting.parameters import MODELS

_MOST_NUMBERS = 1_000_000
_MOST_STARTS = 16_000_000


class ValueKind(click.ParamType):
    """A kind of value; each defines how its text is read.

    Attributes:
        advice: what every message ends with.
    """

    advice = ""

    def read(self, text: str) -> Any:
        """Return the value that a text says.

        Raises:
            ValueError: if it says none; the message is what the user reads.
        """
        raise NotImplementedError

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the value of a text; a default that is no text is a value already.

        Raises:
            click.BadParameter: if the text says none.
        """
        try:
            return self.read(value) if isinstance(value, str) else value
        except ValueError as error:
            self.fail(f"{error}{self.advice}", param, ctx)


class Finite(ValueKind):
    """A number: neither infinite nor "nan", which compares with no limit."""

    name = "number"

    def __init__(self, *, positive: bool = False):
        """Say whether it must be positive."""
        self.positive = positive

    def read(self, text: str) -> float:
        """Return the number that a text says."""
        return _number(text, "value", positive=self.positive)


class Numbers(ValueKind):
    """A comma list of numbers; each part a number or a range start:stop:step that holds the stop if it fits.

    >>> Numbers(positive=False).read("-1,0,2:3:0.5")
    (-1.0, 0.0, 2.0, 2.5, 3.0)
    """

    name = "numbers"

    advice = "; write 1,2,5 or start:stop:step"

    def __init__(self, *, positive: bool = True):
        """Say whether they must be positive."""
        self.positive = positive

    def read(self, text: str) -> tuple[float, ...]:
        """Return the numbers in their order."""
        if not text.strip():
            raise ValueError("names no number")
        numbers: list[float] = []
        for part in text.split(","):
            numbers += self._range(part) if ":" in part else [_number(part, "number", positive=self.positive)]
        return tuple(numbers)

    def _range(self, part: str) -> list[float]:
        ends = part.split(":")
        if len(ends) != 3:
            raise ValueError(f"`{part.strip()}` is no range")
        start, stop = (_number(end, "end", positive=self.positive) for end in ends[:2])
        step = _number(ends[2], "step", positive=True)
        if stop < start:
            raise ValueError(f"`{part.strip()}` ends below its start")
        # a hair more than the quotient, so that rounding does not cost the stop
        steps = (stop - start) / step * (1.0 + 1e-12) + 1e-9
        if steps > _MOST_NUMBERS:
            raise ValueError(f"`{part.strip()}` has more than {_MOST_NUMBERS} numbers")
        # rounded to what was meant: 0.97 + 3 * 0.01 is 1
        return [float(f"{start + step * index:.12g}") for index in range(math.floor(steps) + 1)]


class Orders(ValueKind):
    """A comma list of whole numbers and ranges of them.

    >>> Orders().read("1-3,5")
    (1, 2, 3, 5)
    """

    name = "orders"
    advice = "; write 1,2 or 1-4"

    def read(self, text: str) -> tuple[int, ...]:
        """Return the orders, without repetitions."""
        orders: list[int] = []
        for part in text.split(","):
            ends = re.fullmatch(r"\s*([0-9]{1,3})\s*(?:-\s*([0-9]{1,3})\s*)?", part)
            low, high = (0, 0) if ends is None else (int(ends[1]), int(ends[2] or ends[1]))
            if not 1 <= low <= high:
                raise ValueError(f"`{part.strip()}` is no positive whole number")
            orders += range(low, high + 1)
        return tuple(dict.fromkeys(orders))


class Ends(ValueKind):
    """Two positive numbers, low:high.

    >>> Ends().read("12:150")
    (12.0, 150.0)
    """

    name = "range"
    advice = "; write low:high, as 12:150"

    def read(self, text: str) -> tuple[float, float]:
        """Return the two numbers."""
        lower, _, upper = text.partition(":")
        low, high = (_number(end, "end", positive=True) for end in (lower, upper))
        if high <= low:
            raise ValueError(f"`{text.strip()}` does not rise")
        return low, high


class Share(ValueKind):
    """A share between 0 and 100 %, neither of the two.

    >>> Share().read("1%"), Share().read(" 1 % "), Share().read("0.01")
    (0.01, 0.01, 0.01)
    """

    name = "share"

    def __init__(self, what: str = "a share"):
        """Say what it is a share of, in a few words of the message."""
        self.what = what

    def read(self, text: str) -> float:
        """Return the share as a number between 0 and 1."""
        number, percent, rest = text.strip().partition("%")
        share = _number_or_nan(number) / (100.0 if percent else 1.0)
        if rest or not 0.0 < share < 1.0:
            raise ValueError(f"must be {self.what} such as 1% or 0.01, above 0 and below 100 %, but is {text}")
        return share


class ValueAndError(ValueKind):
    """A value with its standard error; without an error it is exact.

    >>> ValueAndError().read("40 +- 2"), ValueAndError().read("40")
    ((40.0, 2.0), (40.0, None))
    """

    name = "value"

    def __init__(self, **words: Any):
        """Say which words may stand in its place, and for what."""
        self.words = words

    def read(self, text: str) -> Any:
        """Return the value and its error, None if exact; or what a word stands for."""
        return self.words[text] if text in self.words else value_and_error(text)


class Grid(ValueKind):
    """Columns and rows, 1000x1000."""

    name = "grid"

    def read(self, text: str) -> tuple[int, int]:
        """Return columns and rows."""
        sides = re.fullmatch(r"([0-9]{1,5})x([0-9]{1,5})", text.lower())
        columns, rows = (0, 0) if sides is None else (int(sides[1]), int(sides[2]))
        if min(columns, rows) < 2 or columns * rows > _MOST_STARTS:
            raise ValueError(f"must be COLUMNSxROWS as in 1000x1000, 2 to {_MOST_STARTS} starts, but is {text}")
        return columns, rows


class Course(ValueKind):
    """Numbers evenly spaced between two ends, from:to:count, in the order in which they are gone through."""

    name = "course"

    def read(self, text: str) -> tuple[float, ...]:
        """Return the numbers, both ends among them."""
        parts = re.fullmatch(r"([^:]+):([^:]+):([0-9]{1,4})", text)
        first, last, count = (_number(part, "part", positive=False) for part in parts.groups()) if parts else (0, 0, 0)
        if first == last or count < 2:
            raise ValueError(f"must be from:to:count as in -50:-4:24, but is {text}")
        return tuple(first + (last - first) * index / (count - 1) for index in range(int(count)))


class Fixed(ValueKind):
    """A parameter held at a value: NAME=VALUE."""

    name = "value"
    form, has_error = "NAME=VALUE such as modulus_gpa=80", False

    def read(self, text: str) -> tuple[str, Any]:
        """Return the name before an equals sign, and the number after it, or the numbers around +-."""
        name, _, numbers = text.partition("=")
        with suppress(ValueError):
            value, error = value_and_error(numbers)
            if name.strip() and (error is not None) == self.has_error:
                return name.strip().replace("-", "_"), (value, error) if self.has_error else value
        raise ValueError(f"must be {self.form}, but is {text}")


class Constraint(Fixed):
    """What is known of a parameter: NAME=VALUE+-ERROR."""

    name = "constraint"
    form, has_error = "NAME=VALUE+-ERROR such as tip_calibration=1+-0.02", True


class Names(ValueKind):
    """Names in a comma list."""

    name = "names"

    def read(self, text: str) -> tuple[str, ...]:
        """Return the names that a text lists, separated by commas."""
        names = tuple(part.strip() for part in text.split(","))
        if not all(names):
            raise ValueError(f"must be names separated by commas, but is {text}")
        return names


def option_of(parameter: str) -> str:
    """Return the option of a parameter: of tip_radius_nm, --tip-radius-nm."""
    return f"--{parameter.replace('_', '-')}"


def _number_or_nan(text: str) -> float:
    """Return the number that a text says; what is no finite number is NaN."""
    try:
        number = float(text)
    except ValueError:
        return math.nan
    return number if math.isfinite(number) else math.nan


def _number(text: str, what: str, *, positive: bool) -> float:
    number = _number_or_nan(text)
    if not (number > 0.0 if positive else math.isfinite(number)):
        raise ValueError(f"the {what} `{text.strip()}` is not a {'positive ' if positive else ''}number")
    return number


Positive = Annotated[float, Finite(positive=True)]
CurveNumber = Annotated[int, click.IntRange(1)]
ModelName = Annotated[str, click.Choice(MODELS), "MODEL"]
Quantity = Annotated[tuple[float, float | None], ValueAndError()]
QualityFactor = Annotated[tuple[float, float | None] | Literal["none"], ValueAndError(none="none")]
Sensitivity = Annotated[tuple[float, float | None] | Literal["slope"], ValueAndError(slope="slope"), "NM|slope"]
