"""Numbers and tables as a person reads them: the digits that an error warrants, a dash where nothing is known."""

import contextlib
import math
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextvars import ContextVar
from itertools import zip_longest
from typing import Any, SupportsFloat


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


def plain_words(value: Any) -> str:
    """Return a plain value as text: numbers short, lists joined, mappings as 'name: value'.

    >>> plain_words({"seed": 3, "ends": [0.1, None], "scaled": False})
    'seed: 3; ends: 0.1, none; scaled: no'
    """
    if value is None:
        return "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, Mapping):
        return "; ".join(f"{name}: {plain_words(item)}" for name, item in value.items()) or "none"
    if isinstance(value, Iterable) and not isinstance(value, str):
        return ", ".join(plain_words(item) for item in value) or "none"
    return str(value)


def text_table(head: Sequence[str], rows: Iterable[Sequence[str]], *, words: Sequence[int] = (0,)) -> list[str]:
    """Return lines of a table, indented, columns as wide as what is in them.

    Args:
        head: the columns' names.
        rows: a cell for each column.
        words: the columns that hold words, set to the left; numbers are set to the right.

    >>> text_table(["", "value"], [["r", "0.95"], ["epsilon", "60"]])
    ['           value', '  r         0.95', '  epsilon     60']
    """
    lines = [list(head), *map(list, rows)]
    sides = ["<" if k in words else ">" for k in range(len(head))]
    room = _room.get()
    whole = _aligned(lines, sides)
    if len(lines) == 1 or _widest(whole) <= room:
        return whole
    if sides[-1] == "<" or len(head) == 2:
        # remarks at the end of a line go on below where they begin
        left = room - _widest(_aligned([line[:-1] for line in lines], sides)) - 2
        cells = [broken(line[-1], max(int(left), 1)) for line in lines]
        if left >= _LEAST_REMARK and max(map(_widest, cells)) <= left:
            lines = [[*line[:-1], "\n".join(cell)] for line, cell in zip(lines, cells, strict=True)]
            return _aligned(lines, [*sides[:-1], "<"])
    return whole if len(head) == 2 else _turned(lines, int(room))


@contextlib.contextmanager
def lines_at_most(width: int) -> Iterator[None]:
    """Within this block a table wider than so many signs is turned: a line a column, as many rows abreast as fit.

    >>> with lines_at_most(16):
    ...     text_table(["", "value", "error"], [["r", "0.95", "0.01"], ["epsilon", "60", "2"]])
    ['            r', '  value  0.95', '  error  0.01', '', '         epsilon', '  value       60', '  error        2']
    """
    before = _room.set(float(width))
    try:
        yield
    finally:
        _room.reset(before)


_room: ContextVar[float] = ContextVar("_room", default=math.inf)


_LEAST_REMARK = 12


def broken(text: str, width: int, indent: str = "") -> list[str]:
    """Return a text in lines of at most so many signs, broken between words; a value keeps its error beside it.

    Args:
        text: one line.
        width: signs in a line; words that are longer stay whole.
        indent: what all lines but the first begin with.

    >>> broken("epsilon 59.8 +- 0.3 nm^2/us^2 (given)", 16)
    ['epsilon', '59.8 +- 0.3', 'nm^2/us^2', '(given)']
    """
    whole = text.replace(" +- ", "\0+-\0")
    lines = textwrap.wrap(whole, width, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)
    return [line.replace("\0", " ") for line in lines] or [""]


def _widest(lines: Iterable[str]) -> int:
    return max(map(len, lines), default=0)


def _aligned(lines: Sequence[Sequence[str]], sides: Sequence[str]) -> list[str]:
    """Return rows as lines of text; a cell may have several lines."""
    cells = [[cell.split("\n") for cell in line] for line in lines]
    widths = [max(_widest(cell) for cell in column) for column in zip(*cells, strict=True)]
    return [
        "  "
        + "  ".join(f"{part:{side}{width}}" for part, side, width in zip(parts, sides, widths, strict=False)).rstrip()
        for line in cells
        for parts in zip_longest(*line, fillvalue="")
    ]


def _turned(lines: Sequence[Sequence[str]], room: int) -> list[str]:
    """Return a table with its columns below each other, in blocks of rows that fit in the room."""
    head, *rows = lines
    head = ["\n".join(broken(name, room // 2)) if len(name) > room // 2 else name for name in head]
    left = 2 + max(_widest(name.split("\n")) for name in head)
    # names and remarks longer than the room go on below
    most = max(room - left - 2, _LEAST_REMARK)
    rows = [["\n".join(broken(cell, most)) if len(cell) > most else cell for cell in row] for row in rows]
    blocks: list[list[Sequence[str]]] = []
    used = room + 1
    for row in rows:
        width = 2 + max(_widest(cell.split("\n")) for cell in row)
        if used + width > room:
            blocks.append([])
            used = left
        blocks[-1].append(row)
        used += width
    turned: list[str] = []
    for block in blocks:
        cells = [[name, *values] for name, *values in zip(head, *block, strict=True)]
        turned += ["", *_aligned(cells, ["<", *("<" if any("\n" in cell for cell in row) else ">" for row in block)])]
    return turned[1:]


def bullets(title: str, items: Sequence[str]) -> list[str]:
    """Return lines of a list below its title, an empty line before it; nothing if there are no items.

    >>> bullets("Notes:", ["one"])
    ['', 'Notes:', '  - one']
    """
    return ["", title, *(f"  - {item}" for item in items)] if items else []


def shown(text: str) -> str:
    r"""Return a text as a terminal may have it: control characters, as file names may hold them, are escaped.

    >>> print(shown("a\x1b[31m.csv"))
    a\x1b[31m.csv
    """
    if text.isprintable():
        return text
    return "".join(sign if sign.isprintable() or sign in "\n\t" else repr(sign)[1:-1] for sign in text)
