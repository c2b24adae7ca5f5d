"""A result as a person reads it: sections of texts, lists, tables and pictures, shown by a terminal, page or notebook.

The title of the first section is that of the result; its verdict and its warnings are added to what a kind of results
says. A page needs nothing besides itself: pictures are inside, there
are no scripts, and its content security policy forbids a browser to load anything. Every text is escaped when it enters
the page.
"""

import enum
import importlib
import re
import sys
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import singledispatch
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from afm_jax.checks import is_array
from afm_jax.saved import fields_of, is_abstract, is_record
from afm_jax.words import is_words, known, text_table

Cell = str | Callable[[Any], Any]
"""The key of a row, with a format behind a colon if its numbers are not to have the table's, or a function of a row."""


@dataclass(frozen=True)
class Bullets:
    """A list of sentences; nothing where there are none.

    Attributes:
        items: the sentences.
        title: a line above; the page has the section's heading instead.
    """

    items: Sequence[str]
    title: str = ""


@dataclass(frozen=True)
class Table:
    """A table; columns of words are set to the left, numbers to the right.

    Attributes:
        caption: what it shows, said on the page.
        head: the columns' names, which may have their units in a second line.
        rows: a text for each column.
    """

    caption: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]

    @property
    def words(self) -> list[bool]:
        """Which columns hold words."""
        return [is_words(column) for column in zip(*self.rows, strict=True)]


@dataclass(frozen=True)
class Picture:
    """A picture of the page.

    Attributes:
        function: "module:function", which draws the result.
        shows: what is to be seen, in words; for those too who do not see it.
    """

    function: str
    shows: str


class Section(NamedTuple):
    """A block of the terminal's text, a heading with what is below it on the page.

    Attributes:
        title: the heading of the page, and its link at the top.
        parts: texts, `Bullets`, `Table` and `Picture`, from top to bottom; those that hold nothing are left out.
        page_only: whether the terminal leaves it out.
    """

    title: str
    parts: Sequence[Any]
    page_only: bool = False


@singledispatch
def sections(result: Any) -> list[Section]:
    """Return a result as sections: its fields, arrays by their range, if its kind does not register how it is shown."""
    words = getattr(type(result), "_words", {})
    rows = [[name, in_words(value, words.get(name))] for name, value in fields_of(result)]
    rows = [[name, text if len(text) <= _WIDTH else f"{text[: _WIDTH - 4]} ..."] for name, text in rows]
    if len(rows) >= MOST_LINES:
        names = ", ".join(name for name, _ in rows[MOST_LINES - 2 :])
        rows = [*rows[: MOST_LINES - 2], ["and", names[:_WIDTH]]]
    return [Section(f"{type(result).__name__}:", [Table("Fields", ["", ""], rows)])]


MOST_LINES, _WIDTH, _SHOWN = 20, 110, 5
"""Of a result's fields, and numbers that are shown one by one."""


def table_of(cells: Mapping[str, Cell], rows: Sequence[Any], *, form: str = ".6g", caption: str = "") -> Table:
    """Return a table of rows: what is unknown is a dash.

    Args:
        cells: of each heading, what stands below it.
        rows: mappings or records of numbers, words and truths.
        form: format of the numbers.
        caption: of the table.
    """
    return Table(caption, [*cells], [[_cell(row, cell, form) for cell in cells.values()] for row in rows])


def _cell(row: Any, cell: Cell, form: str) -> str:
    value: Any = None
    if callable(cell):
        value = cell(row)
    else:
        key, _, own = cell.partition(":")
        value, form = row.get(key) if isinstance(row, Mapping) else getattr(row, key), own or form
    value = value.tolist() if hasattr(value, "tolist") else value
    if isinstance(value, bool):
        return "yes" if value else "no"
    return value if isinstance(value, str) else known(value, form)


def text_of(*results: Any, width: int = sys.maxsize) -> str:
    """Return results as text; pictures, captions and headings are the page's.

    Args:
        results: the first gives the title and the verdict, others only add sections.
        width: of the lines; tables that are wider are turned.
    """
    first, *others = _sections_of(results)
    parts = [[first.title, *first.parts], _verdict(results[0])]
    parts += [section.parts for section in others if not section.page_only]
    blocks = [lines_of(*each, width=width) for each in parts]
    # energies have a unit of their own where no spring constant is known
    in_unit = getattr(results[0], "in_unit", str)
    return in_unit("\n\n".join("\n".join(block) for block in blocks if block))


def lines_of(*parts: Any, width: int = sys.maxsize) -> list[str]:
    """Return the lines of parts, or of whole results, in a terminal so wide; none of a part that holds nothing."""
    lines: list[str] = []
    for part in parts:
        match part:
            case str():
                lines += [part] if part else []
            case Bullets(items, title):
                lines += [*filter(None, [title]), *(f"  - {item}" for item in items)] if items else []
            case Table():
                lines += text_table(part.head, part.rows, width) if part.rows else []
            case Picture() | None:
                pass
            case _:
                lines.append(text_of(part, width=width))
    return lines


def page_of(*results: Any, drawn: Mapping[str, str] | None = None, template: str = "page.html.jinja") -> str:
    """Return results as one HTML file; it is well-formed XML too.

    Args:
        results: as for `text_of`.
        drawn: pictures, SVG files in base64, by the functions that draw them; others are left out.
        template: the whole page, or its body.
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined  # noqa: PLC0415 (only a page needs it)

    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent), autoescape=True, finalize=_allowed, undefined=StrictUndefined
    )
    environment.filters["signed"] = signed
    shown, drawn = _sections_of(results), drawn or {}
    title = (shown[0].title or type(results[0]).__name__).rstrip(":")
    if not pictures_of(*results):
        shown.append(Section("Picture", [Picture(function, title) for function in drawn]))
    (_, lead), *others = ((each.title, [part for part in each.parts if _is_shown(part, drawn)]) for each in shown)
    page = environment.get_template(template).render(
        title=title,
        verdict=_verdict(results[0]),
        lead=lead,
        sections=[(name, parts) for name, parts in others if parts],
        drawn=drawn,
    )
    return getattr(results[0], "in_unit", str)(page)


def _is_shown(part: Any, drawn: Mapping[str, str]) -> bool:
    return part.function in drawn if isinstance(part, Picture) else bool(lines_of(part))


def pictures_of(*results: Any) -> list[str]:
    """Return the functions that draw the pictures of results."""
    return [part.function for each in _sections_of(results) for part in each.parts if isinstance(part, Picture)]


def _sections_of(results: Sequence[Any]) -> list[Section]:
    shown: list[Section] = []
    for each in results:
        notes = Section("Notes", [Bullets(getattr(each, "warnings", ()), "Notes:")])
        shown += sorted([*sections(at_home(each)), notes], key=lambda section: section.page_only)
    return shown


def at_home(result: Any) -> Any:
    """Return a result after the module has been imported that registers how it is shown."""
    if getattr(result, "_home", ""):
        importlib.import_module(getattr(result, "_home", ""))
    return result


def _verdict(result: Any) -> list[Any]:
    if not hasattr(result, "valid"):
        return []
    # what a result that is not valid is no measurement of: bounds of an energy may be stated all the same
    doubt = getattr(result, "_doubt", "")
    return ["VALID" if result.valid else f"NOT VALID{doubt}", Bullets(result.reasons)]


_NON_CHARACTERS = "".join(chr(plane << 16 | low) for plane in range(17) for low in (0xFFFE, 0xFFFF))
_FORBIDDEN = re.compile(rf"[\x00-\x08\x0b-\x1f\x7f-\x9f\ud800-\udfff\ufdd0-\ufdef{_NON_CHARACTERS}]")


def _allowed(value: Any) -> Any:
    """Return a text with U+FFFD for what HTML may not hold: controls, surrogates, non-characters."""
    return _FORBIDDEN.sub("\ufffd", value) if type(value) is str else value


def signed(words: str) -> str:
    """Return text with the signs that a terminal may lack: µs for us, ² for ^2, ± for +-."""
    return re.sub(r"\bus\b", "µs", words).replace("^2", "²").replace("^3", "³").replace("+-", "±")


def in_words(value: Any, words: type[enum.IntEnum] | None = None) -> str:  # noqa: PLR0911 (one return a kind of value)
    """Return a value as text: a number, arrays by their range, outcomes by their names."""
    if is_abstract(value):
        return f"{value.dtype}[{','.join(map(str, value.shape))}]"
    if is_record(value):
        return f"{type(value).__name__}({in_words(dict(fields_of(value)))})"
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {in_words(item)}" for key, item in value.items()) or "nothing"
    if isinstance(value, list | tuple):
        more = [f"and {len(value) - _SHOWN} more"] * (len(value) > _SHOWN)
        return "; ".join([*map(in_words, value[:_SHOWN]), *more]) or "nothing"
    if not is_array(value):
        value = "none" if value is None else "a function" if callable(value) else value
        return _number(value) if isinstance(value, bool | int | float) else " ".join(str(value).split()) or "''"
    flat = np.ravel(value)
    shape = "" if np.ndim(value) < 2 and flat.size <= _SHOWN else f"({', '.join(map(str, np.shape(value)))}) "
    if words is not None:
        names = {int(each): each.name.lower().replace("_", " ") for each in words}
        counts = Counter(names.get(each, str(each)) for each in flat.tolist())
        return shape + ", ".join(f"{count} {name}" if flat.size > 1 else name for name, count in counts.items())
    if flat.size <= _SHOWN or flat.dtype.kind not in "iuf":
        return shape + ", ".join(map(_number, flat[:_SHOWN].tolist())) + ", ..." * (flat.size > _SHOWN)
    finite = flat[np.isfinite(flat)].tolist()
    return f"{shape}{_number(min(finite))} to {_number(max(finite))}" if finite else f"{shape}none known"


def _number(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return "-" if value != value else f"{value:.6g}"  # noqa: PLR0124 (NaN alone is not itself)
