"""Elements of a page, escaped by construction: whatever text or attribute is given, it stays text."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterable
from typing import TypeAlias

from workbench.safe_text import printable

Element: TypeAlias = ET.Element
Content: TypeAlias = "str | Element | Iterable[Content] | None"


def el(tag: str, *content: Content, **attributes: str | float | None) -> Element:
    """An element with what is in it, and attributes whose underlines are hyphens; None leaves one out.

    A text is escaped where the element is written, in all but ``script`` and ``style``, which only ever hold files of
    our own. Characters that cannot be printed are shown as their codes.
    """
    element = ET.Element(tag)
    for name, value in attributes.items():
        if value is not None:
            element.set(name.rstrip("_").replace("_", "-"), printable(_text(value)))
    for part in content:
        _add(element, part)
    return element


def _text(value: str | float) -> str:
    return value if isinstance(value, str) else f"{value:g}"


def _add(element: Element, content: Content) -> None:
    if content is None:
        return
    if isinstance(content, Element):
        element.append(content)
    elif isinstance(content, str):
        _add_text(element, content if element.tag in ("script", "style") else printable(content))
    else:
        for part in content:
            _add(element, part)


def _add_text(element: Element, text: str) -> None:
    if len(element):
        element[-1].tail = (element[-1].tail or "") + text
    else:
        element.text = (element.text or "") + text


def page(root: Element) -> str:
    """A whole page."""
    return "<!DOCTYPE html>\n" + ET.tostring(root, encoding="unicode", method="html") + "\n"


def drawing(svg: Element) -> str:
    """An ``svg`` element as a file of its own."""
    svg.set("xmlns", "http://www.w3.org/2000/svg")
    return ET.tostring(svg, encoding="unicode", xml_declaration=False) + "\n"
