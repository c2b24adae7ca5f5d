"""The building blocks of an HTML page: text that is always escaped, elements, tables, lists.

>>> element("p", "a < b", element("em", "said"), id="one")
'<p id="one">a &lt; b<em>said</em></p>'
"""

import base64
import html
import io
import re
from collections.abc import Iterable, Sequence

from matplotlib.figure import Figure

_VOID = {"img", "meta", "wbr"}
_PICTURE_DPI = 110


class Markup(str):
    """Text that is HTML already; every other text is escaped when it enters an element."""

    __slots__ = ()


def escaped(content: str) -> Markup:
    """Return a text as HTML; markup stays what it is, and characters that HTML does not allow become U+FFFD."""
    if isinstance(content, Markup):
        return content
    allowed = "".join(letter if _is_allowed(ord(letter)) else "\ufffd" for letter in content)
    return Markup(html.escape(allowed))


def _is_allowed(code: int) -> bool:
    """Say whether HTML may hold a character: no controls, no surrogates, no non-characters."""
    if code < 0x20:
        return code in {0x09, 0x0A}
    return not (0x7F <= code <= 0x9F or 0xD800 <= code <= 0xDFFF or 0xFDD0 <= code <= 0xFDEF or code & 0xFFFE == 0xFFFE)


def element(tag: str, *content: str, **attributes: str) -> Markup:
    """Return an element; `class_` stands for the attribute class, `aria_label` for aria-label."""
    pairs = (f' {name.rstrip("_").replace("_", "-")}="{escaped(value)}"' for name, value in attributes.items())
    opening = f"{tag}{''.join(pairs)}"
    if tag in _VOID:
        return Markup(f"<{opening}/>")
    return Markup(f"<{opening}>{together(content)}</{tag}>")


def together(parts: Iterable[str], between: str = "") -> Markup:
    """Return parts one after the other, each escaped unless it is markup."""
    return Markup(escaped(between).join(escaped(part) for part in parts))


def section(title: str, *content: str, name: str) -> Markup:
    """Return a section with its heading; `name` is what a link to it ends with."""
    return Markup(element("section", element("h2", title), *content, id=name) + "\n")


def bullets(items: Sequence[str]) -> Markup:
    """Return a list of items; nothing if there are none."""
    return element("ul", *(element("li", item) for item in items)) if items else Markup()


def table(
    caption: str,
    head: Sequence[str],
    rows: Iterable[Sequence[str]],
    *,
    words: Sequence[str] = (),
    marked: Sequence[bool] = (),
) -> Markup:
    """Return a table whose first column names the rows.

    Args:
        caption: what it shows.
        head: the columns' names.
        rows: a cell for each column.
        words: names of columns that hold words, not numbers.
        marked: for each row whether it stands out.
    """
    kinds = [{"class_": "words"} if name in words else {} for name in head]
    lines = []
    for i, row in enumerate(rows):
        first, *others = row
        cells = [element("th", first, scope="row")]
        cells += [element("td", cell, **kinds[k]) for k, cell in enumerate(others, 1)]
        mark = {"class_": "marked"} if i < len(marked) and marked[i] else {}
        lines.append(element("tr", *cells, **mark))
    columns = element("tr", *(element("th", name, scope="col", **kind) for name, kind in zip(head, kinds, strict=True)))
    body = element("tbody", *(Markup(line + "\n") for line in lines))
    whole = element("table", element("caption", caption), element("thead", columns), body)
    # a wide table scrolls in its frame, by keyboard too
    return element("div", whole, class_="wide", tabindex="0", role="region", aria_label=caption)


def picture(figure: Figure, *, shows: str) -> Markup:
    """Return a figure with its caption, the picture inside the page.

    Args:
        figure: what is drawn.
        shows: what is to be seen, in words; for those too who do not see it.
    """
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=_PICTURE_DPI)
    source = f"data:image/png;base64,{base64.b64encode(buffer.getvalue()).decode('ascii')}"
    return element("figure", element("img", src=source, alt=shows), element("figcaption", shows))


def in_signs(words: str) -> str:
    """Return text with the signs that a terminal may lack: µs for us, ² for ^2."""
    return re.sub(r"\bus\b", "µs", words).replace("^2", "²").replace("^3", "³")


def breakable(name: str) -> Markup:
    """Return a name that may be broken after its underscores, so that a narrow column can hold it."""
    return together(name.split("_"), together(["_", element("wbr")]))
