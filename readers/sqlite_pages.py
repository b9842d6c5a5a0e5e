"""Rows of a damaged SQLite file, read from its pages, https://sqlite.org/fileformat2.html.

Every page that says it is a leaf of a table is read by itself, so that neither the root of the table nor the pages
between have to be there. A row that is longer than its page goes on in a chain of overflow pages; where the chain
breaks, the row is lost, but its first numbers are known.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import NamedTuple

LEAF, INTERIOR = 0x0D, 0x05
_U16 = struct.Struct(">H")
_U32 = struct.Struct(">I")
_INTEGER_BYTES = {1: 1, 2: 2, 3: 3, 4: 4, 5: 6, 6: 8}
_LONGEST_VARINT = 9
_MOST_COLUMNS = 32


class BrokenRowError(Exception):
    """Bytes that are no row, or one whose overflow pages are gone."""


class Column(NamedTuple):
    """Where one value lies in a row's payload, and its serial type."""

    serial: int
    start: int
    stop: int


class Row(NamedTuple):
    """A row: its number, the page and place of its cell, its columns, and its payload."""

    number: int
    page: int
    columns: tuple[Column, ...]
    size: int
    start: int
    local: int
    chain: int


def varint(data: memoryview, at: int) -> tuple[int, int]:
    """A number of variable length at `at`, and where it ends.

    Raises:
        BrokenRowError: the data end inside of it.
    """
    value = 0
    for index in range(_LONGEST_VARINT):
        if at + index >= len(data):
            raise BrokenRowError
        byte = data[at + index]
        if index == _LONGEST_VARINT - 1:
            return (value << 8) | byte, at + _LONGEST_VARINT
        value = (value << 7) | (byte & 0x7F)
        if byte < 0x80:
            return value, at + index + 1
    raise BrokenRowError


class Pages:
    """The pages of a database file.

    Args:
        data: the file.

    Attributes:
        page_bytes: size of a page, from the header where that can be, else 4096.
        stated: number of pages by the header.
    """

    def __init__(self, data: memoryview) -> None:
        self.data = data
        size = _U16.unpack_from(data, 16)[0] if len(data) >= 100 else 0
        size = 65536 if size == 1 else size
        self.page_bytes = size if size >= 512 and size & (size - 1) == 0 else 4096
        self._usable = self.page_bytes - (data[20] if len(data) >= 100 and data[20] <= 32 else 0)
        self.stated = _U32.unpack_from(data, 28)[0] if len(data) >= 100 else 0

    def __len__(self) -> int:
        return -(-len(self.data) // self.page_bytes)

    def _page(self, number: int) -> memoryview:
        """Page `number`, counted from 1; shorter at the end of a cut file."""
        start = (number - 1) * self.page_bytes
        return self.data[start : start + self.page_bytes]

    def rows(self) -> Iterator[Row]:
        """The rows of all tables, in the order of the pages."""
        for page in range(1, len(self) + 1):
            kind = self.data[(page - 1) * self.page_bytes + (100 if page == 1 else 0) :][:1]
            if kind == bytes([LEAF]):
                yield from self._leaf(page)

    def largest_key(self) -> int:
        """The largest row number that a page between root and leaves names; 0 if there is none."""
        largest = 0
        for page in range(1, len(self) + 1):
            data, head = self._page(page), 100 if page == 1 else 0
            if len(data) <= head + 12 or data[head] != INTERIOR:
                continue
            (count,) = _U16.unpack_from(data, head + 3)
            for place in range(head + 12, min(head + 12 + 2 * count, len(data) - 1), 2):
                try:
                    largest = max(largest, varint(data, _U16.unpack_from(data, place)[0] + 4)[0])
                except BrokenRowError:
                    continue
        return largest

    def _leaf(self, page: int) -> Iterator[Row]:
        data, head = self._page(page), 100 if page == 1 else 0
        if len(data) < head + 8:
            return
        (count,) = _U16.unpack_from(data, head + 3)
        if head + 8 + 2 * count > len(data):
            count = (len(data) - head - 8) // 2
        for place in range(head + 8, head + 8 + 2 * count, 2):
            (cell,) = _U16.unpack_from(data, place)
            try:
                yield self._row(page, data, cell)
            except (BrokenRowError, struct.error):
                continue

    def _row(self, page: int, data: memoryview, cell: int) -> Row:
        size, at = varint(data, cell)
        number, start = varint(data, at)
        local = self._local_bytes(size)
        chain = _U32.unpack_from(data, start + local)[0] if local < size else 0
        if start + local > len(data) or size > len(self.data):
            raise BrokenRowError
        columns = tuple(_columns(data[start : start + local], size))
        return Row(number, page, columns, size, (page - 1) * self.page_bytes + start, local, chain)

    def _local_bytes(self, size: int) -> int:
        """How much of a payload lies in its leaf page."""
        most, least = self._usable - 35, (self._usable - 12) * 32 // 255 - 23
        if size <= most:
            return size
        local = least + (size - least) % (self._usable - 4)
        return local if local <= most else least

    def _pieces(self, row: Row) -> Iterator[tuple[int, int]]:
        """Where in the file the parts of a row's payload lie.

        Raises:
            BrokenRowError: an overflow page of it is not there, or the chain of them breaks.
        """
        yield row.start, row.start + row.local
        left, following = row.size - row.local, row.chain
        while left > 0:
            start = (following - 1) * self.page_bytes
            size = min(self._usable - 4, left)
            if following < 2 or start + 4 + size > len(self.data):
                raise BrokenRowError
            yield start + 4, start + 4 + size
            left -= size
            (following,) = _U32.unpack_from(self.data, start)
        if following:
            raise BrokenRowError

    def is_whole(self, row: Row) -> bool:
        """Whether all pages of a row are there."""
        try:
            return all(True for _ in self._pieces(row))
        except BrokenRowError:
            return False

    def payload(self, row: Row) -> memoryview:
        """The whole payload of a row; errors as of `_pieces`."""
        if row.local == row.size:
            return self.data[row.start : row.start + row.size]
        return memoryview(b"".join(self.data[start:stop] for start, stop in self._pieces(row)))

    def value(self, row: Row, column: int) -> int | float | str | memoryview | None:
        """One value of a row; text that is not UTF-8 comes out as backslash escapes.

        Raises:
            BrokenRowError: as for `payload`, where the value is not in the leaf page.
        """
        serial, start, stop = row.columns[column]
        data = self.data[row.start : row.start + row.local] if stop <= row.local else self.payload(row)
        return _value(serial, data[start:stop])


def _columns(data: memoryview, size: int) -> Iterator[Column]:
    """The columns that the head of a row's payload names; they must fill it."""
    head, at = varint(data, 0)
    if not at <= head <= len(data):
        raise BrokenRowError
    start, count = head, 0
    while at < head:
        serial, at = varint(data, at)
        if serial in (10, 11) or (count := count + 1) > _MOST_COLUMNS:
            raise BrokenRowError
        length = (serial - 12) // 2 if serial >= 12 else {7: 8}.get(serial, _INTEGER_BYTES.get(serial, 0))
        yield Column(serial, start, start + length)
        start += length
    if start != size or at != head:
        raise BrokenRowError


def _value(serial: int, data: memoryview) -> int | float | str | memoryview | None:
    if serial >= 12:
        return bytes(data).decode("utf-8", "backslashreplace") if serial % 2 else data
    if serial == 7:
        return float(struct.unpack(">d", data)[0])
    if serial in (8, 9):
        return serial - 8
    return int.from_bytes(data, "big", signed=True) if serial else None
