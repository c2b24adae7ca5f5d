"""Reports as sections of text, lists, tables and pictures: one renderer for the terminal, one for the HTML page.

A page needs nothing besides itself: pictures are inside, there are no scripts, and its content security policy
forbids a browser to load anything. Every text is escaped when it enters the page.
"""

import base64
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from afm_jax.words import plain_words, text_table

_NON_CHARACTERS = "".join(chr(plane << 16 | low) for plane in range(17) for low in (0xFFFE, 0xFFFF))
_FORBIDDEN = re.compile(rf"[\x00-\x08\x0b-\x1f\x7f-\x9f\ud800-\udfff\ufdd0-\ufdef{_NON_CHARACTERS}]")


@dataclass(frozen=True)
class Text:
    """A paragraph.

    Attributes:
        words: the paragraph; of several lines, for the terminal.
        look: how the page sets it: "" (plain) or "lines" (spaces and ends of lines as they are).
    """

    words: str
    look: str = ""
    kind: ClassVar[str] = "text"


@dataclass(frozen=True)
class Bullets:
    """A list of sentences; nothing where there are none.

    Attributes:
        items: the sentences.
        title: a line above; the page has the section's heading instead.
    """

    items: Sequence[str]
    title: str = ""
    kind: ClassVar[str] = "bullets"


@dataclass(frozen=True)
class Table:
    """A table of the page; its first column names the rows.

    Attributes:
        caption: what it shows.
        head: the columns' names.
        rows: a cell for each column.
        words: names of columns that hold words, not numbers.
    """

    caption: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    words: Collection[str] = ()
    kind: ClassVar[str] = "table"


@dataclass(frozen=True)
class Picture:
    """A picture of the page.

    Attributes:
        source: an SVG file as an address that holds it.
        shows: what is to be seen, in words; for those too who do not see it.
    """

    source: str
    shows: str
    kind: ClassVar[str] = "picture"


Part = Text | Bullets | Table | Picture


@dataclass(frozen=True)
class ReportSection:
    """A section: a block of the terminal's text, a heading with what is below it on the page.

    Attributes:
        title: the heading of the page, and its link at the top.
        parts: what it holds, from top to bottom; those that hold nothing are left out.
    """

    title: str
    parts: Sequence[Part]

    @property
    def name(self) -> str:
        """The section's place in the page's address."""
        return self.title.split()[0].lower()


@dataclass(frozen=True)
class Report:
    """A result as a person reads it: verdict first, then the sections.

    Attributes:
        title: what it is about.
        valid: whether the result may be used.
        reasons: why it is not valid.
        sections: the rest; those that hold nothing are left out.
        about: lines below the title in the terminal; on the page paragraphs below the verdict.
        doubt: what a result that is not valid is no measurement of, a sentence behind the verdict.
    """

    title: str
    valid: bool
    reasons: Sequence[str]
    sections: Sequence[ReportSection]
    about: Sequence[str] = ()
    doubt: str = ""

    @property
    def shown(self) -> list[ReportSection]:
        """The sections that hold something, without the parts that do not."""
        parts = [[one for one in each.parts if isinstance(one, Picture) or lines_of(one)] for each in self.sections]
        return [ReportSection(each.title, held) for each, held in zip(self.sections, parts, strict=True) if held]


def text_of(report: Report) -> str:
    """Return a report as text: blocks with an empty line between; pictures, captions and headings are the page's."""
    title = [report.title, *(f"  {line}" for line in report.about)]
    verdict = ["VALID" if report.valid else f"NOT VALID{report.doubt and f': {report.doubt}'}"]
    verdict += [f"  - {reason}" for reason in report.reasons]
    blocks = [title, verdict] if report.about else [title + verdict]
    blocks += [[line for part in section.parts for line in lines_of(part)] for section in report.shown]
    return "\n\n".join("\n".join(block) for block in blocks if block)


def lines_of(part: Part) -> list[str]:
    """Return the lines of a part in a terminal; none of one that holds nothing."""
    match part:
        case Text(words):
            return [words] if words else []
        case Bullets(items, title):
            return [*filter(None, [title]), *(f"  - {item}" for item in items)] if items else []
        case Table(head=head, rows=rows, words=words):
            columns = [k for k, name in enumerate(head) if name in words or k == 0]
            return text_table(head, rows, words=columns) if rows else []
        case Picture():
            return []


def page_of(report: Report) -> str:
    """Return a report as one HTML file; it is well-formed XML too."""
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        finalize=_allowed,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["signed"] = signed
    return environment.get_template("page.html.jinja").render(result=report, lead=[*map(Text, report.about)])


def _allowed(value: Any) -> Any:
    """Return a text with U+FFFD for what HTML may not hold: controls, surrogates, non-characters."""
    if not isinstance(value, str) or isinstance(value, Markup):
        return value
    return _FORBIDDEN.sub("\ufffd", value)


def signed(words: str) -> str:
    """Return text with the signs that a terminal may lack: µs for us, ² for ^2, ± for +-."""
    return re.sub(r"\bus\b", "µs", words).replace("^2", "²").replace("^3", "³").replace("+-", "±")


def pairs(caption: str, head: tuple[str, str], values: Mapping[str, Any]) -> Table:
    """Return a table of names and plain values."""
    return Table(caption, head, [[name, plain_words(value)] for name, value in values.items()], words=head[1:])


def pictures_of(files: Sequence[bytes], shows: Sequence[str]) -> list[Picture]:
    """Return pictures, SVG files, with what is to be seen in words."""
    return [
        Picture(f"data:image/svg+xml;base64,{base64.b64encode(file).decode('ascii')}", words)
        for file, words in zip(files, shows, strict=True)
    ]
