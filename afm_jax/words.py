"""Numbers and tables as a person reads them: the digits that an error warrants, a dash where nothing is known."""

import difflib
import math
import re
import sys
from collections.abc import Iterable, Sequence
from typing import SupportsFloat


def decimals(width: float, *, unknown: int = 4) -> int:
    """Return the decimals that show a width, or an error, to two significant digits; at most twelve.

    Args:
        width: what must show.
        unknown: the decimals where there is no width.

    >>> decimals(0.034), decimals(34.0)
    (3, 0)
    """
    if not math.isfinite(width) or width <= 0.0:
        return unknown
    return min(max(1 - math.floor(math.log10(width)), 0), 12)


def value_alone(value: float, error: float | None, *, unknown: str = ".3g") -> str:
    """Return a value with the digits that its error warrants; the error stands elsewhere.

    Args:
        value: the value.
        error: its standard error, or None.
        unknown: how a value without an error is written.

    >>> value_alone(40.1234, 0.4), value_alone(40.1234, None)
    ('40.1', '40.1')
    """
    # the 95 % interval is about four standard errors wide
    return f"{value:{unknown}}" if error is None else f"{value:z.{decimals(4.0 * error)}f}"


def with_error(value: float | None, error: float | None) -> str:
    """Return a value and its error with two digits of the error.

    >>> with_error(40.1234, 0.41), with_error(-0.001, 0.41), with_error(40.1, None)
    ('40.12 +- 0.41', '0.00 +- 0.41', 'not known')
    """
    if value is None or error is None:
        return "not known"
    digits = decimals(error)
    return f"{value:z.{digits}f} +- {error:.{digits}f}"


NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?", re.ASCII)
"""A number as a file writes it; stricter than ``float``, which also takes "nan", "inf" and "1_000"."""


def value_and_error(text: str, example: str = "40 or '40 +- 2'") -> tuple[float, float | None]:
    """Return the value and the standard error that a text says, with +-, +/- or ± between them; None without an error.

    >>> value_and_error("40 +- 2"), value_and_error("40")
    ((40.0, 2.0), (40.0, None))

    Args:
        text: of a command, a call or a file.
        example: how it may be written, for the message.

    Raises:
        ValueError: if it says no finite number, or an error that is not above 0.
    """
    parts = [part.strip() for part in re.split(r"\+-|\+/-|±", text)]
    value, *error = (float(part) if NUMBER.fullmatch(part) else math.nan for part in parts)
    if not all(map(math.isfinite, (value, *error))) or len(error) > 1 or (error and error[0] <= 0.0):
        said = printable(cut_short(text.strip(), 60))
        raise ValueError(f"`{said}` is neither a number nor one with a positive error; write {example}")
    return value, error[0] if error else None


def nearest_name(text: str, known: Iterable[str]) -> str | None:
    """Return the known name that a misspelt one was meant to be, or None.

    >>> nearest_name("platfrom", ["cantilever", "platform"]), nearest_name("tip", ["platform"])
    ('platform', None)
    """
    return next(iter(difflib.get_close_matches(text, list(known), n=1, cutoff=_SIMILAR)), None)


_SIMILAR = 0.62
"""Similarity (0 to 1, as difflib counts it) that a misspelling must reach."""


def interval(low: float, high: float) -> str:
    """Return an interval with two digits of its width.

    >>> interval(0.94921, 0.95083)
    '0.9492 to 0.9508'
    """
    digits = decimals(high - low)
    return f"{low:z.{digits}f} to {high:z.{digits}f}"


def known(value: SupportsFloat | None, form: str = ".3g") -> str:
    """Return a number in a format, a dash where there is none or it is not finite.

    >>> known(0.12345), known(None), known(float("nan"), "+.2f")
    ('0.123', '-', '-')
    """
    return "-" if value is None or not math.isfinite(value) else f"{value:{form}}"


def percent(fraction: float) -> str:
    """Return a fraction in per cent with two significant digits.

    >>> percent(0.0031)
    '0.31 %'
    """
    return f"{float(f'{100.0 * fraction:.2g}'):g} %"


def counted(number: int, what: str) -> str:
    """Return a number of things.

    >>> counted(1, "impact"), counted(2, "drive period")
    ('1 impact', '2 drive periods')
    """
    return f"{number} {what}{'' if number == 1 else 's'}"


def is_words(cells: Iterable[str]) -> bool:
    """Say whether a column holds words, not numbers: some cell begins with a letter, or has two beside each other.

    >>> is_words(["0.95 to 0.96", "-"]), is_words(["1e-05", "12/13", "0.3 +- 0.1"])
    (True, False)
    """
    return any(_WORD.search(cell) for cell in cells)


_WORD = re.compile(r"^[^\W\d_]|[^\W\d_]{2}")


def text_table(head: Sequence[str], rows: Iterable[Sequence[str]], width: int = sys.maxsize) -> list[str]:
    r"""Return lines of a table, indented, columns as wide as what is in them: words to the left, numbers to the right.

    Args:
        head: the columns' names, in one line or two; empty ones take no line.
        rows: a cell for each column.
        width: a table of three columns or more that is wider than so many signs has a line a cell.

    >>> text_table(["", "value\nnm"], [["r", "0.95"], ["epsilon", "60"]])
    ['           value', '              nm', '  r         0.95', '  epsilon     60']
    >>> text_table(["law", "value", "error"], [["r", "0.95", "0.01"], ["epsilon", "60", "2"]], 16)
    ['  law    r', '  value  0.95', '  error  0.01', '', '  law    epsilon', '  value  60', '  error  2']
    """
    rows, heads = [*map(list, rows)], [name.split("\n") for name in head]
    depth = max(map(len, heads)) if any(head) else 0
    above = [[name[k] if k < len(name) else "" for name in heads] for k in range(depth)]
    widths = [max(map(len, column)) for column in zip(*above, *rows, strict=True)]
    sides = ["<" if is_words(column) else ">" for column in zip(*rows, strict=True)] or [">"] * len(head)
    lines = [
        "".join(f"  {cell:{side}{wide}}" for cell, side, wide in zip(line, sides, widths, strict=True)).rstrip()
        for line in [*above, *rows]
    ]
    if len(head) < 3 or max(map(len, lines)) <= width:
        return lines
    names = [" ".join(name).strip() for name in heads]
    left = max(map(len, names))
    blocks = [["", *(f"  {name:{left}}  {cell}" for name, cell in zip(names, row, strict=True))] for row in rows]
    return [line for block in blocks for line in block][1:]


def shown(text: str) -> str:
    r"""Return a text as a terminal may have it: control characters, as file names may hold them, are escaped.

    >>> print(shown("a\x1b[31m.csv"))
    a\x1b[31m.csv
    """
    return "".join(sign if sign.isprintable() or sign in "\n\t" else repr(sign)[1:-1] for sign in text)


def printable(text: str) -> str:
    """Return a text that fits on one line of a message: escaped where it holds line breaks or control characters.

    What is far longer than names are is cut in its middle.
    """
    short = cut_short(text, _LONGEST_NAME)
    return short if short.isprintable() else repr(short)


_LONGEST_NAME = 300


def cut_short(text: str, length: int) -> str:
    """Return a text without its middle where it is longer than a number of letters."""
    half = (length - 5) // 2
    return text if len(text) <= length else f"{text[:half]} ... {text[-half:]}"
