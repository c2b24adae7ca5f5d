"""A page read by a strict parser, and what any page must keep to be valid, self-contained HTML."""

import base64
import re
from xml.etree import ElementTree as ET

ELEMENTS = """
html head meta title style body main section nav h1 h2 div p ul li a
table caption thead tbody tr th td figure img figcaption sub sup strong wbr
"""
VOID = {"meta", "img", "wbr"}


def read_page(text: str) -> ET.Element:
    """Return the page's root; it must be well-formed, hold known elements only and refer to nothing outside."""
    assert text.startswith("<!DOCTYPE html>\n")
    root = ET.fromstring(text)  # noqa: S314 - our own page
    names = [element.attrib["id"] for element in root.iter() if "id" in element.attrib]
    assert len(set(names)) == len(names)
    for element in root.iter():
        assert element.tag in ELEMENTS.split()
        assert not any(name.startswith("on") for name in element.attrib)
        if element.tag in VOID:
            assert not element.text
            assert len(element) == 0
    for link in root.iter("a"):
        assert link.attrib["href"].removeprefix("#") in names
    for picture in root.iter("img"):
        kind, data = picture.attrib["src"].split(",")
        assert kind == "data:image/svg+xml;base64"
        assert ET.fromstring(base64.b64decode(data, validate=True)).tag.endswith("}svg")  # noqa: S314 - our own picture
        assert picture.attrib["alt"]
    (style,) = root.iter("style")
    assert not re.search(r"url\(|@import|</", words_of(style))
    for table in root.iter("table"):
        assert len({len(row) for row in table.iter("tr")}) == 1
        assert [part.tag for part in table] == ["caption", "thead", "tbody"]
    return root


def words_of(element: ET.Element) -> str:
    """Return the text of an element and all in it."""
    return "".join(element.itertext())


def first_screen(root: ET.Element) -> str:
    """Return the text before the first section, a line for each element."""
    (main,) = root.iter("main")
    lines = []
    for element in main:
        if element.tag == "section":
            break
        lines += [words_of(part) for part in (element, *element.iter("p"))]
    return "\n".join(lines)


def section_of(root: ET.Element, name: str) -> ET.Element:
    """Return the section that a link's name leads to."""
    (section,) = (element for element in root.iter("section") if element.attrib["id"] == name)
    return section


def table_of(root: ET.Element, caption: str) -> list[list[str]]:
    """Return the cells of the one table whose caption starts with some words, its head first."""
    (table,) = (t for t in root.iter("table") if words_of(t[0]).startswith(caption))
    return [[words_of(cell) for cell in row] for row in table.iter("tr")]
