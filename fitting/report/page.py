"""What every report of one HTML file shares: tables, pictures, and how a page is made.

The file needs nothing besides itself: pictures are inside, there are no scripts, and its content security policy
forbids a browser to load anything. Every text is escaped when it enters the page.
"""

import base64
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from afm_jax.words import plain_words

_NON_CHARACTERS = "".join(chr(plane << 16 | low) for plane in range(17) for low in (0xFFFE, 0xFFFF))
_FORBIDDEN = re.compile(rf"[\x00-\x08\x0b-\x1f\x7f-\x9f\ud800-\udfff\ufdd0-\ufdef{_NON_CHARACTERS}]")


@dataclass(frozen=True)
class Table:
    """A table of the page; its first column names the rows.

    Attributes:
        caption: what it shows.
        head: the columns' names.
        rows: a cell for each column.
        words: names of columns that hold words, not numbers.
        marked: places of rows that stand out.
        left_out: where the rows are that are not shown, as a sentence.
    """

    caption: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    words: Collection[str] = ()
    marked: Collection[int] = ()
    left_out: str = ""


def page(template: str, **parts: Any) -> str:
    """Return a page from a template of this folder.

    Args:
        template: its file name.
        parts: what it shows; texts are escaped, what HTML may not hold becomes U+FFFD.
    """
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        finalize=_allowed,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(template).render(**parts)


def _allowed(value: Any) -> Any:
    """Return a text with U+FFFD for what HTML may not hold: controls, surrogates, non-characters."""
    if not isinstance(value, str) or isinstance(value, Markup):
        return value
    return _FORBIDDEN.sub("\ufffd", value)


def in_signs(words: str) -> str:
    """Return text with the signs that a terminal may lack: µs for us, ² for ^2."""
    return re.sub(r"\bus\b", "µs", words).replace("^2", "²").replace("^3", "³")


def pairs(caption: str, head: tuple[str, str], values: Mapping[str, Any]) -> Table:
    """Return a table of names and plain values."""
    return Table(caption, head, [[name, plain_words(value)] for name, value in values.items()], words=head[1:])


def pictures_of(files: Sequence[bytes], shows: Sequence[str]) -> list[dict[str, str]]:
    """Return pictures (SVG) with what is to be seen, in words; for those too who do not see them."""
    return [
        {"source": f"data:image/svg+xml;base64,{base64.b64encode(file).decode('ascii')}", "shows": words}
        for file, words in zip(files, shows, strict=True)
    ]
