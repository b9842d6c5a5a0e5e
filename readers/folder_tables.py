"""Text tables of recordings in folders: csv and blank-separated files, read row by row, times kept exact."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Collection
from dataclasses import dataclass, field
from datetime import UTC, datetime
from decimal import Decimal
from itertools import islice, pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from readers.streams import Damage, FloatArray, RecordingError

NS_PER_UNIT = {"s": 1_000_000_000, "ms": 1_000_000, "us": 1_000, "ns": 1}
EPOCH_S = (Decimal(900_000_000), Decimal(4_200_000_000))  # years 1998 to 2103
SLOW_STEP_NS = 3600 * NS_PER_UNIT["s"]
LISTED_ROWS = 10
LARGEST = 1e100  # no measurement is larger, and squares of larger numbers overflow
_ISO = re.compile(r"(\d{4})[-:](\d\d)[-:](\d\d)[ T](\d\d):(\d\d):(\d\d)(\.\d+)?(Z|[+-]\d\d:?\d\d)?")


@dataclass(slots=True)
class Table:
    """Rows of a text file.

    `header` is the column names in lower case (empty if there are none), `rows`
    the cells of each row with its line number, `bad` what rows could not be used, as (line, reason).
    """

    path: Path
    header: list[str]
    rows: list[tuple[int, list[str]]]
    decimal_comma: bool = False
    bad: list[tuple[int, str]] = field(default_factory=list)

    def column(self, *beginnings: str, but: str = "\0") -> int | None:
        """Index of the first column whose name begins so (earlier beginnings first) and not like `but`."""
        for beginning in beginnings:
            for index, name in enumerate(self.header):
                if name.startswith(beginning) and not name.startswith(but):
                    return index
        return None

    def columns(self, *beginnings: str) -> list[int] | None:
        """Indices of the columns whose names begin so, None unless all are there."""
        found = [self.column(beginning) for beginning in beginnings]
        return None if None in found else [index for index in found if index is not None]

    def number(self, cell: str) -> float:
        """A finite number.

        Raises:
            ValueError: it is none.
        """
        try:
            value = float(self.plain(cell))
        except ValueError:
            raise ValueError(f"{cell!r} is not a number") from None
        if not abs(value) < LARGEST:
            raise ValueError(f"{cell!r} is not finite")
        return value

    def identity(self, cell: str) -> float:
        """The number by which something is called: whole, not negative, of 32 bits.

        Raises:
            ValueError: it is none.
        """
        value = self.number(cell)
        if not (0 <= value < 2**32 and value.is_integer()):
            raise ValueError(f"{cell!r} is no number of a thing")
        return value

    def timed(
        self, time_column: int, unit: str, columns: list[int], *, identities: Collection[int] = ()
    ) -> tuple[NDArray[np.int64], FloatArray]:
        """Times and numbers of all rows that can be read; the others are added to `bad`.

        Args:
            time_column: index of the column with the times.
            unit: the times' unit.
            columns: indices of the columns with the numbers.
            identities: those of the columns that call something by a number.

        Returns:
            Times in ns [n] and numbers [n, len(columns)].
        """
        times, values = [], []
        for line, cells in self.rows:
            try:
                row = [self.identity(cells[c]) if c in identities else self.number(cells[c]) for c in columns]
                times.append(exact_ns(self.plain(cells[time_column]), unit))
                values.append(row)
            except (ValueError, IndexError) as error:
                self.bad.append((line, _reason(cells, error)))
        return np.array(times, np.int64), np.array(values, float).reshape(len(times), len(columns))

    def plain(self, cell: str) -> str:
        """A number's text with a decimal point."""
        return cell.replace(",", ".") if self.decimal_comma else cell

    def damage(self, root: Path) -> list[Damage]:
        """The bad rows as damage: the first few one by one, the rest as a number."""
        name = self.path.relative_to(root) if self.path.is_relative_to(root) else self.path
        listed = [Damage(what=f"row left out ({why})", where=f"{name} line {n}") for n, why in self.bad[:LISTED_ROWS]]
        rest = len(self.bad) - LISTED_ROWS
        if rest > 0:
            last = self.bad[-1][0]
            listed.append(Damage(what=f"{rest} more rows left out", where=f"{name} up to line {last}"))
        return listed


def read_table(path: Path, *, lines_read: int | None = None) -> Table:
    """Read a text table (its first `lines_read` lines); its delimiter is found from its first row.

    Lines that begin with ``#`` or ``%`` are comments; the last one before the rows, or a first line
    without any number, names the columns.

    Raises:
        RecordingError: the file cannot be read.
    """
    try:
        with path.open(encoding="utf-8-sig", errors="replace") as file:
            lines = [(number, line.strip()) for number, line in enumerate(islice(file, lines_read), 1)]
    except OSError as error:
        problem = f"cannot be read ({error.strerror})"
        raise RecordingError(path, problem, "check that it is there and may be read") from None
    lines = [(number, line) for number, line in lines if line]
    data = [(number, line) for number, line in lines if line[0] not in "#%"]
    delimiter = _delimiter(data[0][1] if data else "")
    rows = [(number, _split(line, delimiter)) for number, line in data]
    first = rows[0][0] if rows else math.inf
    names = [line.lstrip("#% ") for number, line in lines if line[0] in "#%" and number < first][-1:]
    header = _split(names[0], delimiter) if names else []
    if rows and not any(cell[:1].isdigit() or _is_number(cell) for cell in rows[0][1]):
        header = rows.pop(0)[1]
    return Table(path, [_column_name(name) for name in header], rows, decimal_comma=delimiter == ";")


def exact_ns(text: str, unit: str) -> int:
    """Nanoseconds of a decimal number in `unit`, or of a date and time (UTC where it names no zone).

    The text is never made a float. Digits below a nanosecond are rounded.

    Raises:
        ValueError: it is no time, is negative, or does not fit into 64 bits.
    """
    text = text.strip()
    if match := _ISO.fullmatch(text):
        return _calendar_ns(match)
    try:
        value = (Decimal(text) * NS_PER_UNIT[unit]).to_integral_value()
        in_range = 0 <= value < 2**63
    except ArithmeticError:
        raise ValueError(f"{text!r} is not a time") from None
    if not in_range:
        raise ValueError(f"{text!r} is not a time from 0 to 2^63 ns")
    return int(value)


def guess_unit(texts: list[str]) -> str:
    """Unit of times, from their size if they are of this epoch, else from their usual step.

    Times of the epoch lie between 1998 and 2103 in exactly one unit. Of others, the step of a camera
    lies between 5 ms and 5 s in exactly one unit; faster means seconds.

    Raises:
        ValueError: a text is not a number.
    """
    try:
        values = [Decimal(text) for text in texts if not _ISO.fullmatch(text)]
        steps = sorted(abs(b - a) for a, b in pairwise(values) if a != b)
        step = steps[len(steps) // 2] if steps else Decimal(0)
        for unit, scale in NS_PER_UNIT.items():
            size = NS_PER_UNIT["s"] // scale
            of_epoch = all(EPOCH_S[0] * size <= value < EPOCH_S[1] * size for value in values)
            if values and of_epoch and step * scale <= SLOW_STEP_NS:
                return unit
    except ArithmeticError:
        raise ValueError("a time is not a number") from None
    for unit, limit in (("s", Decimal(5)), ("ms", Decimal(5_000)), ("us", Decimal(5_000_000))):
        if step < limit:
            return unit
    return "ns"


def unit_of_name(name: str) -> str | None:
    """Unit that a column's name states at its end (``time_s``, ``timestamp [ns]``, ``t (ms)``), None if none."""
    match = re.search(r"[\s_\[(](s|sec|ms|us|ns)[\])]?$", name.strip().lower())
    return {"sec": "s"}.get(match[1], match[1]) if match else None


def inside(folder: Path, name: str) -> Path:
    """The file of that name below `folder`.

    Raises:
        ValueError: the name is empty or leads out of the folder.
    """
    relative = Path(name)
    if not name or "\0" in name or relative.is_absolute() or ".." in relative.parts:
        raise ValueError(f"{name!r} is not the name of a file in the recording")
    return folder / relative


def _calendar_ns(match: re.Match[str]) -> int:
    year, month, day, hour, minute, second = (int(match[i]) for i in range(1, 7))
    moment = datetime(year, month, day, hour, minute, second, tzinfo=UTC)
    seconds = int(moment.timestamp()) - _zone_s(match[8] or "Z")
    t_ns = seconds * NS_PER_UNIT["s"] + int(Decimal(f"0{match[7] or '.0'}") * NS_PER_UNIT["s"])
    if not 0 <= t_ns < 2**63:
        raise ValueError(f"{match[0]!r} lies before 1970 or after 2262")
    return t_ns


def _zone_s(zone: str) -> int:
    """Seconds east of UTC of ``Z``, ``+02:00`` or ``-0530``."""
    if zone == "Z":
        return 0
    hours, minutes = int(zone[1:3]), int(zone[-2:])
    return (1 if zone[0] == "+" else -1) * (hours * 3600 + minutes * 60)


def _delimiter(line: str) -> str:
    return next((mark for mark in ";,\t" if mark in line), "")


def _split(line: str, delimiter: str) -> list[str]:
    if not delimiter:
        return [line] if _ISO.fullmatch(line) else line.split()
    return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter, skipinitialspace=True))]


def _is_number(cell: str) -> bool:
    try:
        float(cell.replace(",", "."))
    except ValueError:
        return False
    return True


def _column_name(text: str) -> str:
    return text.strip().strip("\"'").lower()


def _reason(cells: list[str], error: Exception) -> str:
    return "too few columns" if isinstance(error, IndexError) else str(error)
