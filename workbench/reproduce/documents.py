"""What all reports have in common: Markdown, JSON and CSV of tables, statements and pictures."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from readers.streams import RecordingError
from workbench.reproduce import drawing
from workbench.reproduce.judged import Statement
from workbench.session import versions
from workbench.summary import without_nan

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Table = tuple[Sequence[str], list[tuple[str, ...]]]
"""Heads and rows."""


def made_folder(folder: Path) -> Path:
    """The folder of the results, made if it is not there.

    Raises:
        RecordingError: it cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        problem = f"no results can be written there ({error.strerror or error})"
        raise RecordingError(folder, problem, "choose another folder with -o") from error
    return folder


def write_report(lines: Iterable[str], folder: Path) -> Path:
    """Write report.md, whose lines may draw their pictures as they come; returns it."""
    (folder / "pictures").mkdir(exist_ok=True)
    report = folder / "report.md"
    report.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return report


def write_json(values: Mapping[str, Any], file: Path) -> None:
    """Values as JSON, null for every number that is not finite."""
    file.write_text(json.dumps(without_nan(values), indent=1, allow_nan=False) + "\n", encoding="utf-8")


def write_csv(rows: Sequence[Mapping[str, Any]], file: Path) -> None:
    """Rows with the same fields as CSV; no file for no rows."""
    if rows:
        with file.open("w", encoding="utf-8", newline="") as stream:
            writer = csv.DictWriter(stream, list(rows[0]), lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)


def statement_lines(made: Iterable[Statement]) -> Iterator[str]:
    """Statements as a list in Markdown."""
    for statement in made:
        yield f"- **{statement.upshot}** — {statement.claim}. {statement.numbers}."


def picture(folder: Path, name: str, draw: Callable[[], Figure]) -> Iterator[str]:
    """Draw a picture into the folder ``pictures`` of a report; yields the lines that show it."""
    file = drawing.save(folder / "pictures" / name, draw)
    yield from ("", f"![{name}]({file.relative_to(folder).as_posix()})")


def version_lines() -> Iterator[str]:
    """The versions that the results were made with."""
    yield from ("", "## Versions", "", ", ".join(f"{name} {version}" for name, version in versions().items()))


def markdown(table: Table) -> list[str]:
    """A table as Markdown."""
    heads, rows = table
    return [_row(heads), _row(["---"] * len(heads)), *(_row(row) for row in rows)]


def _row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"
