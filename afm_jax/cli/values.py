"""Numbers on the command line: lists and ranges of them, whole numbers, shares, and values with their errors.

The argument SCENE.toml|PRESET: a scene file, or one of the paper's scenes by its name.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import click.shell_completion

from afm_jax.cli.session import add_note
from afm_jax.scenefile.tables import cut_short

if TYPE_CHECKING:
    from afm_jax.apparatus.scene import Scene
    from afm_jax.scenefile.parameter_paths import ParameterRange
    from afm_jax.scenefile.scenefile import Start
    from fitting.tables.table import AmplitudeTable


_MOST = 1_000_000


def option_of(parameter: str) -> str:
    """Return the option of a parameter: of tip_radius_nm, --tip-radius-nm."""
    return f"--{parameter.replace('_', '-')}"


class Finite(click.ParamType):
    """A number: neither infinite nor "nan", which compares with no limit."""

    name = "number"

    def __init__(self, *, positive: bool = False):
        """Say whether it must be positive."""
        self.positive = positive

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Return the number that a text says.

        Raises:
            click.BadParameter: if it is none, not finite, or not positive where it must be.
        """
        try:
            number = parse_number(str(value))
        except ValueError:
            number = math.nan
        if not (number > 0.0 if self.positive else math.isfinite(number)):
            shown = cut_short(str(value), 60)
            self.fail(f"must be a {'positive' if self.positive else 'finite'} number, but is {shown}", param, ctx)
        return number


class FiniteOrNone(Finite):
    """A number, or the word "none", which stands for an infinite one."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Return the number that a text says; see `Finite`."""
        return math.inf if value in ("none", math.inf) else super().convert(value, param, ctx)


class Numbers(click.ParamType):
    """A comma list of numbers; each part a number or a range start:stop:step that holds the stop if it fits."""

    name = "numbers"

    def __init__(self, what: str = "number", *, positive: bool = True, example: str = "1,2,5"):
        """Say what the numbers are, one of them in a word, and whether they must be positive."""
        self.what, self.positive, self.example = what, positive, example

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[float, ...]:
        """Return the numbers that a text says, in its order.

        Raises:
            click.BadParameter: if a part is no such number or range, or there is none.
        """
        if isinstance(value, tuple):
            return value
        try:
            return parse_numbers(str(value), self.what, positive=self.positive)
        except ValueError as error:
            wanted = "must hold positive numbers: " if self.positive else ""
            self.fail(f"{wanted}{error}; write {self.example} or start:stop:step", param, ctx)


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


class Ends(click.ParamType):
    """Two positive numbers, low:high."""

    name = "range"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[float, float]:
        """Return the two numbers.

        Raises:
            click.BadParameter: if it is no rising pair of positive numbers.
        """
        if isinstance(value, tuple):
            return value
        try:
            return parse_ends(str(value))
        except ValueError as error:
            self.fail(f"{error}; write low:high, as 12:150", param, ctx)


class Share(click.ParamType):
    """A share between 0 and 100 %, neither of the two: `1%`, `1 %` or `0.01`."""

    name = "share"

    def __init__(self, what: str = "a share"):
        """Say what it is a share of, in a few words of the message."""
        self.what = what

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Return the share that a text says, as a number between 0 and 1.

        Raises:
            click.BadParameter: if it is none.
        """
        try:
            return parse_share(str(value))
        except ValueError:
            self.fail(f"must be {self.what} such as 1% or 0.01, above 0 and below 100 %, but is {value}", param, ctx)


class ValueAndError(click.ParamType):
    """A value with its standard error, as `40 +- 2`; without an error it is exact."""

    name = "value"

    def __init__(self, *, none: bool = False):
        """Say whether it may be the word "none", which stands for an infinite value."""
        self.none = none

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, float | None]:
        """Return the value and its error, None if exact.

        Raises:
            click.BadParameter: if it is no number, or the error is not positive.
        """
        if isinstance(value, tuple):
            return value
        if self.none and value == "none":
            return math.inf, None
        try:
            numbers = parse_around_plus_minus(str(value))
        except ValueError as error:
            self.fail(f"{error}; write 40 or '40 +- 2'", param, ctx)
        if len(numbers) > 2 or (len(numbers) == 2 and numbers[1] <= 0.0):
            self.fail(f"`{value}` is no value with a positive error; write '40 +- 2'", param, ctx)
        return numbers[0], numbers[1] if len(numbers) == 2 else None


_MOST_STARTS = 16_000_000


class Grid(click.ParamType):
    """Columns and rows, 1000x1000."""

    name = "grid"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, int]:
        """Return columns and rows.

        Raises:
            click.BadParameter: if it is no such grid, or one of too many starts.
        """
        parts = str(value).lower().split("x")
        good = len(parts) == 2 and all(part.isascii() and part.isdigit() and len(part) < 6 for part in parts)
        if not good or min(map(int, parts)) < 2 or int(parts[0]) * int(parts[1]) > _MOST_STARTS:
            self.fail(f"must be COLUMNSxROWS as in 1000x1000, 2 to {_MOST_STARTS} starts, but is {value}", param, ctx)
        return int(parts[0]), int(parts[1])


PRESET_NAMES = ("figure2", "figure3", "figure8", "figure9a", "figure9b", "figure10", "figure11", "dry")
"""Of `afm_jax.scenefile.presets`; said here as well, because help and completion must not wait for JAX."""


class SceneName(click.ParamType):
    """A scene file, or one of the paper's scenes by its name."""

    name = "scene"

    def __init__(self, *also: str):
        """Say which other words may stand in its place."""
        self.also = also

    def shell_complete(
        self,
        ctx: click.Context,  # noqa: ARG002
        param: click.Parameter,  # noqa: ARG002
        incomplete: str,
    ) -> list[click.shell_completion.CompletionItem]:
        """Return the names that begin so; then the shell offers files."""
        names = [name for name in (*self.also, *PRESET_NAMES) if name.startswith(incomplete)]
        items = [click.shell_completion.CompletionItem(name) for name in names]
        return items or [click.shell_completion.CompletionItem(incomplete, type="file")]


class PictureFormat(click.ParamType):
    """The suffix of a picture: png, pdf or svg."""

    name = "format"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """Return the suffix without its dot.

        Raises:
            click.BadParameter: if it is another one.
        """
        suffix = str(value).lower().removeprefix(".")
        if suffix not in ("png", "pdf", "svg"):
            self.fail(f"must be png, pdf or svg, but is {value}", param, ctx)
        return suffix


def tables_with(
    paths: Sequence[Path], noise: float | None, quality_factor: tuple[float, float | None] | None
) -> "list[AmplitudeTable]":
    """Return amplitude tables from their files, with the quality factor of the call, if it gives one.

    Raises:
        TableError: if one cannot be read, or the quality factor is impossible.
    """
    from dataclasses import replace  # noqa: PLC0415

    from fitting.tables.table import read_table  # noqa: PLC0415

    read = [read_table(path, noise=noise) for path in paths]
    if quality_factor is None:
        return read
    value, error = quality_factor
    own = None if math.isinf(value) else value
    return [replace(table, quality_factor=own, quality_factor_error=error) for table in read]


def parse_numbers(text: str, what: str = "number", *, positive: bool = False) -> tuple[float, ...]:
    """Return the numbers that a text lists.

    >>> parse_numbers("-1,0,2:3:0.5")
    (-1.0, 0.0, 2.0, 2.5, 3.0)

    Args:
        text: a comma list; each part a number or a range start:stop:step.
        what: one of the numbers, in a word of the messages.
        positive: whether they must be positive.

    Raises:
        ValueError: if it lists none, or a part is no such number or no rising range.
    """
    if not text.strip():
        raise ValueError(f"names no {what}")
    numbers: list[float] = []
    for part in text.split(","):
        numbers += _range(part, what, positive=positive) if ":" in part else [_number(part, what, positive=positive)]
        if len(numbers) > _MOST:
            raise ValueError(f"names more than {_MOST} {what}s")
    return tuple(numbers)


def parse_ends(text: str) -> tuple[float, float]:
    """Return the two numbers of `low:high`.

    >>> parse_ends("12:150")
    (12.0, 150.0)

    Raises:
        ValueError: if it is no rising pair of positive numbers.
    """
    ends = text.split(":")
    if len(ends) != 2:
        raise ValueError(f"`{text.strip()}` is no range")
    low, high = (_number(end, what, positive=True) for end, what in zip(ends, ("lower end", "upper end"), strict=True))
    if high <= low:
        raise ValueError(f"`{text.strip()}` does not rise")
    return low, high


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


def _range(part: str, what: str, *, positive: bool) -> list[float]:
    ends = part.split(":")
    if len(ends) != 3:
        raise ValueError(f"`{part.strip()}` is no range")
    start, stop = (_number(end, name, positive=positive) for end, name in zip(ends[:2], ("start", "stop"), strict=True))
    step = _number(ends[2], "step", positive=True)
    if stop < start:
        raise ValueError(f"`{part.strip()}` ends below its start")
    # a hair more than the quotient, so that rounding does not cost the stop
    steps = (stop - start) / step * (1.0 + 1e-12) + 1e-9
    if steps > _MOST:
        raise ValueError(f"`{part.strip()}` has more than {_MOST} {what}s")
    # rounded to what was meant: 0.97 + 3 * 0.01 is 1
    return [float(f"{start + step * index:.12g}") for index in range(math.floor(steps) + 1)]


def _number(text: str, what: str, *, positive: bool) -> float:
    try:
        number = parse_number(text)
    except ValueError:
        number = math.nan
    if not (number > 0.0 if positive else math.isfinite(number)):
        raise ValueError(f"the {what} `{text.strip()}` is not a {'positive ' if positive else ''}number")
    return number


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


def parse_share(text: str) -> float:
    """Return the share that a text says.

    >>> parse_share("1 %"), parse_share("0.01")
    (0.01, 0.01)

    Raises:
        ValueError: if it is no number, or not between 0 and 100 %.
    """
    number, percent, rest = text.strip().partition("%")
    share = parse_number(number) / (100.0 if percent else 1.0)
    if rest or not 0.0 < share < 1.0:
        raise ValueError(f"`{text.strip()}` is no share")
    return share


def scene_and_start(name: str, *, notes: bool = True) -> "tuple[Scene, Start | None]":
    """Return the scene that an argument names and its start; see `afm_jax.scenefile.presets.read_named_scene`.

    Args:
        name: a path, or a preset's name.
        notes: whether the result says what the file leaves to be assumed.
    """
    from afm_jax.scenefile import presets  # noqa: PLC0415

    read = presets.read_named_scene(name)
    for note in read.notes if notes else ():
        add_note(note)
    return read.scene, read.start


def ranges_of(name: str, scene: "Scene", texts: Sequence[str], *, counted: bool) -> "list[ParameterRange]":
    """Return the ranges of a scene's parameters that options give.

    Args:
        name: of the scene, for messages.
        scene: the scene.
        texts: PARAMETER=low:high:count, or without count.
        counted: whether with count.

    Raises:
        ValueError: if one is no range, or the scene lacks a parameter or cannot be at an end.
    """
    from afm_jax.scenefile.parameter_paths import check_ranges, parse_range  # noqa: PLC0415

    ranges = [parse_range(text, counted=counted) for text in texts]
    try:
        check_ranges(scene, *ranges)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error
    return ranges


def example_path() -> Path:
    """Return where the bundled table of `--example` lies, the short way if that is below the working folder."""
    import fitting.examples  # noqa: PLC0415

    path = Path(fitting.examples.__path__[0]) / "amplitudes_law.csv"
    return path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path
