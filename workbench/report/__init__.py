"""What there is to say about a run, as a page that opens offline, as Markdown, and as plain values.

facts = facts_of(open_run("results/mission"))
write_page(facts, Path("report.html"))
"""

from __future__ import annotations

import os
from pathlib import Path

from workbench.report.facts import Facts, facts_of, values
from workbench.report.markup import drawing
from workbench.report.page import PICTURED, html
from workbench.report.pictures import Picture, pictures
from workbench.report.text import markdown

__all__ = ["Facts", "facts_of", "page_of", "pictures_of", "text_of", "values", "write"]


def pictures_of(facts: Facts) -> dict[int, Picture]:
    """The pictures of the worst frames of the first findings.

    Raises:
        RecordingError: the run's own file cannot be read.
    """
    return pictures(facts.run, [finding.worst_frame for finding in facts.findings[:PICTURED]])


def page_of(facts: Facts) -> str:
    """The report as one page of HTML."""
    return html(facts, pictures_of(facts))


def text_of(facts: Facts, folder: Path | None = None, beside: Path | None = None) -> str:
    """The report as Markdown.

    Args:
        facts: what to say.
        folder: where the pictures of findings go as SVG files; none are made by default.
        beside: the folder that the Markdown will lie in, to which links are relative; the current one by default.

    Raises:
        OSError: the pictures cannot be written.
    """
    links: dict[int, list[str]] = {}
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        for frame, picture in pictures_of(facts).items():
            for name, element in (("image", picture.image), ("closer", picture.closer)):
                if element is not None:
                    file = folder / f"{name}-{frame}.svg"
                    file.write_text(drawing(element), encoding="utf-8")
                    links.setdefault(frame, []).append(Path(os.path.relpath(file, beside or ".")).as_posix())
    return markdown(facts, links)


def write(text: str, out: Path) -> Path:
    """Write a report whole or not at all; return its path.

    Raises:
        OSError: it cannot be written.
    """
    out.parent.mkdir(parents=True, exist_ok=True)
    part = out.with_name(out.name + ".part")
    part.write_text(text, encoding="utf-8")
    return part.replace(out)
