"""Results in a CSV file that grows part by part, so that an interrupted computation goes on where it stopped."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Protocol, TypeVar

from readers.streams import RecordingError
from workbench.reproduce.tasks import OnTick, Tick, carried_out

Value = str | int | float


class Part(Protocol):
    """A part of the work, which gives some rows."""

    @property
    def keys(self) -> Sequence[Mapping[str, Value]]:
        """What tells its rows from others."""
        ...

    @property
    def steps(self) -> int:
        """Number of steps of its progress."""
        ...

    def rows(self, tick: Tick) -> Sequence[Mapping[str, Value]]:
        """Do the work; `tick` is called after each step."""
        ...


P = TypeVar("P", bound=Part)


class Ledger:
    """Rows of a CSV file, found again by some of their fields.

    A last line that was not finished is dropped.

    Args:
        file: where the rows stand; it is made with the first row.
        key: the fields that tell what a row is about.
        fields: the other fields.

    Raises:
        RecordingError: the file has other fields.
    """

    def __init__(self, file: Path, key: Sequence[str], fields: Sequence[str]) -> None:
        self.file, self._key, self._fields = file, tuple(key), (*key, *fields)
        self._rows: dict[tuple[str, ...], dict[str, str]] = {}
        text = file.read_text("utf-8") if file.is_file() else ""
        whole = text[: text.rfind("\n") + 1]
        if whole != text:
            file.write_text(whole, "utf-8")
        reader = csv.DictReader(io.StringIO(whole))
        if whole and tuple(reader.fieldnames or ()) != self._fields:
            raise RecordingError(
                file, "it holds results of another form", "choose another folder with -o, or remove it"
            )
        for row in reader:
            self._rows[self._key_of(row)] = row

    def __contains__(self, key: Mapping[str, Value]) -> bool:
        return self._key_of(key) in self._rows

    def row(self, key: Mapping[str, Value]) -> dict[str, str]:
        """The row of that key.

        Raises:
            KeyError: there is none.
        """
        return self._rows[self._key_of(key)]

    def add(self, rows: Iterable[Mapping[str, Value]]) -> None:
        """Append rows and bring them to the disk."""
        new = not self.file.is_file() or not self.file.stat().st_size
        with self.file.open("a", encoding="utf-8", newline="") as stream:
            writer = csv.DictWriter(stream, self._fields, lineterminator="\n")
            if new:
                writer.writeheader()
            for row in rows:
                texts = {name: _text(row[name]) for name in self._fields}
                writer.writerow(texts)
                self._rows[self._key_of(texts)] = texts

    def missing_of(self, parts: Iterable[P]) -> list[P]:
        """The parts of which a row is missing."""
        return [part for part in parts if not all(key in self for key in part.keys)]

    def fill(self, parts: Iterable[Part], *, jobs: int, on_tick: OnTick) -> None:
        """Do what is missing; the rows of every part are on the disk as soon as it is done."""
        for rows in carried_out([part.rows for part in self.missing_of(parts)], jobs=jobs, on_tick=on_tick):
            self.add(rows)

    def _key_of(self, row: Mapping[str, Value]) -> tuple[str, ...]:
        return tuple(_text(row[name]) for name in self._key)


def _text(value: Value) -> str:
    return f"{value:.9g}" if isinstance(value, float) else str(value)
