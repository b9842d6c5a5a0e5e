"""MCAP files of every profile: with or without index, chunked or not, whole or torn.

The layout is that of the MCAP specification, https://mcap.dev/spec. The summary is parsed by the `mcap`
library's record classes. Chunks are unpacked here, one at a time, because a damaged one must not
stop the others and every checksum is to be validated, which the library's reader does not offer.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode

from readers.message_log import Block, BlockLog, Channel, DamagedBlockError, Message, inflate, text
from readers.streams import RecordingError

MAGIC = b"\x89MCAP0\r\n"
RUN_BYTES = 1 << 20
_HEAD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
_CHUNK = struct.Struct("<QQQII")
_INDEX_HEAD = struct.Struct("<BQHI")
_INDEX_ENTRY_BYTES = 16
_FOOTER = struct.Struct("<BQQQI8s")
_DEFAULT_ENCODING = {"ros1": "ros1", "ros2": "cdr"}
_PARSE_ERRORS = (McapError, struct.error, ValueError, KeyError, OverflowError, MemoryError)


def _record(kind: Any, body: bytes | memoryview) -> Any:
    return kind.read(ReadDataStream(BytesIO(body)))


def _split(data: memoryview) -> Iterator[tuple[int, memoryview | None]]:
    """Opcode and body of each record in `data`; a record that does not fit comes last, with None."""
    at = 0
    while at < len(data):
        if at + _HEAD.size > len(data):
            yield 0, None
            return
        opcode, length = _HEAD.unpack_from(data, at)
        at += _HEAD.size
        if opcode == 0 or at + length > len(data):
            yield opcode, None
            return
        yield opcode, data[at : at + length]
        at += length


class McapLog(BlockLog):
    """One MCAP file.

    Raises:
        RecordingError: the file does not begin like an MCAP file.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path, "MCAP")
        self._schemas: dict[int, Any] = {}
        self._by_id: dict[int, Channel] = {}
        self._profile = ""
        try:
            self._read_header()
            fault = self._read_summary()
            if fault is not None:
                self._forget()
                self._scan(fault)
            else:
                self._find_edges()
        except BaseException:
            self.close()
            raise
        if self._profile:
            self.format = f"MCAP, profile {self._profile}"

    def _read_header(self) -> None:
        start = self._bytes(0, 1 << 16)
        if not start.startswith(MAGIC):
            raise RecordingError(self.path, "it does not begin like an MCAP file", "check that the file is complete")
        for opcode, body in _split(memoryview(start)[len(MAGIC) :]):
            if opcode == Opcode.HEADER and body is not None:
                length = struct.unpack_from("<I", body)[0]
                self._profile = text(body[4 : 4 + length])
            return

    def _forget(self) -> None:
        self._schemas, self._by_id, self.channels, self._blocks = {}, {}, [], []

    # ------------------------------------------------------------------------- with index

    def _read_summary(self) -> str | None:
        """Take channels, counts and blocks from the summary.

        Returns:
            None when that is done, else why the file must be scanned: "" if it simply has no full
            index, or a clause that says what is damaged.
        """
        tail = self._bytes(max(0, self._size - _FOOTER.size), _FOOTER.size)
        if len(tail) < _FOOTER.size or tail[-8:] != MAGIC:
            return "the file was not closed (it has no footer)"
        opcode, length, start, _, crc, _ = _FOOTER.unpack(tail)
        if opcode != Opcode.FOOTER or length != 20:
            return "the footer is damaged"
        if start == 0:
            return ""
        if not len(MAGIC) < start < self._size - _FOOTER.size:
            return "the footer points to no place of the file"
        section = self._bytes(start, self._size - start - len(MAGIC))
        if crc and zlib.crc32(section[:-4]) != crc:
            return "the index does not match its checksum"
        try:
            return None if self._take_summary(memoryview(section)) else ""
        except _PARSE_ERRORS:
            return "the index cannot be parsed"

    def _take_summary(self, section: memoryview) -> bool:
        """Read the records of the summary; False where they do not describe the whole file."""
        statistics: Any = None
        indexes: list[Any] = []
        for opcode, body in _split(section):
            if body is None:
                raise ValueError
            if opcode == Opcode.STATISTICS:
                statistics = _record(records.Statistics, body)
            elif opcode == Opcode.CHUNK_INDEX:
                indexes.append(_record(records.ChunkIndex, body))
            else:
                self._describe(opcode, body)
        if statistics is None or (statistics.message_count and not indexes):
            return False
        for index in indexes:
            if not index.message_index_offsets or not set(index.message_index_offsets) <= set(self._by_id):
                return False
            counts = {
                self._by_id[number]: self._indexed_count(offset, number)
                for number, offset in index.message_index_offsets.items()
            }
            self._blocks.append(
                Block(
                    index.chunk_start_offset,
                    index.chunk_length,
                    index.message_start_time,
                    index.message_end_time,
                    counts,
                )
            )
        if not set(statistics.channel_message_counts) <= set(self._by_id):
            return False
        for number, count in statistics.channel_message_counts.items():
            self._by_id[number].count = count
        return True

    def _indexed_count(self, offset: int, number: int) -> int:
        """How many messages of a channel the message index at `offset` lists."""
        opcode, _, channel, size = _INDEX_HEAD.unpack(self._bytes(offset, _INDEX_HEAD.size))
        if opcode != Opcode.MESSAGE_INDEX or channel != number:
            raise ValueError
        return int(size) // _INDEX_ENTRY_BYTES

    def _describe(self, opcode: int, body: memoryview) -> None:
        """Take a schema or a channel; other records are passed over."""
        if opcode == Opcode.SCHEMA:
            schema = _record(records.Schema, body)
            self._schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL:
            channel = _record(records.Channel, body)
            if channel.id in self._by_id:
                return
            schema = self._schemas.get(channel.schema_id)
            taken = Channel(
                topic=channel.topic,
                type=schema.name if schema else "",
                encoding=channel.message_encoding or _DEFAULT_ENCODING.get(self._profile, ""),
                schema_encoding=schema.encoding if schema else "",
                schema=schema.data if schema else b"",
            )
            self._by_id[channel.id] = taken
            self.channels.append(taken)

    # ---------------------------------------------------------------------- without index

    def _scan(self, fault: str) -> None:
        """Walk over the records from the start, up to the end of the data or to the tear."""
        self.notes.append("The file has no usable index; it was read once to list what it holds.")
        offset, run_start = len(MAGIC), -1
        closed, problem = False, ""
        while offset < self._size:
            head = self._bytes(offset, _HEAD.size)
            opcode, length = _HEAD.unpack(head) if len(head) == _HEAD.size else (0, 0)
            end = offset + _HEAD.size + length
            run_ends = opcode != Opcode.MESSAGE or end > self._size or end - run_start > RUN_BYTES
            if run_start >= 0 and run_ends:
                self._take(run_start, offset - run_start)
                run_start = -1
            if opcode in (Opcode.DATA_END, Opcode.FOOTER):
                closed = True
                break
            if opcode == 0 or end > self._size:
                problem = self._torn(offset, opcode)
                break
            if opcode == Opcode.CHUNK:
                self._take(offset, end - offset)
            elif opcode == Opcode.MESSAGE:
                run_start = offset if run_start < 0 else run_start
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._describe_or_report(offset, opcode, self._bytes(offset + _HEAD.size, length))
            offset = end
        else:
            if run_start >= 0:
                self._take(run_start, offset - run_start)
        self._report_end(offset, closed, fault, problem)

    def _torn(self, offset: int, opcode: int) -> str:
        """Read what there is of the record that is cut at `offset`; a clause that says so."""
        if opcode != Opcode.CHUNK:
            return "the file ends inside a record" if opcode else "no record begins where one should"
        found = self._take(offset, self._size - offset, torn=True)
        return f"the file ends inside a chunk, {found} messages of which are read without a checksum; the chunk begins"

    def _report_end(self, offset: int, closed: bool, fault: str, problem: str) -> None:
        if problem:
            self._report(problem, offset, self._size - offset)
        elif closed and fault:
            self._report(f"{fault}, though every message can be read; the damage begins", offset, 0)
        elif not closed:
            self._report("the file was not closed, what is there can be read; it breaks off", offset, 0)

    def _describe_or_report(self, offset: int, opcode: int, body: bytes) -> None:
        try:
            self._describe(opcode, memoryview(body))
        except _PARSE_ERRORS:
            self._report("a schema or channel record cannot be parsed", offset, len(body))

    # ------------------------------------------------------------------------------ blocks

    def _unpack(self, raw: memoryview, torn: bool) -> tuple[list[Message], str]:
        if not raw or raw[0] != Opcode.CHUNK:
            return self._messages(raw, torn)
        body = raw[_HEAD.size :]
        try:
            _, _, size, crc, name_length = _CHUNK.unpack_from(body)
            compression = text(body[_CHUNK.size : _CHUNK.size + name_length])
            (length,) = struct.unpack_from("<Q", body, _CHUNK.size + name_length)
        except struct.error as error:
            raise DamagedBlockError("a chunk ends within its header") from error
        packed = body[_CHUNK.size + name_length + 8 :][:length]
        if len(packed) < length and not torn:
            raise DamagedBlockError(f"a chunk states {length} bytes and {len(packed)} are there")
        data = memoryview(inflate(compression, packed, size, torn=torn))
        if crc and not torn and zlib.crc32(data) != crc:
            raise DamagedBlockError("a chunk does not match its checksum and is left out")
        return self._messages(data, torn)

    def _messages(self, data: memoryview, torn: bool) -> tuple[list[Message], str]:
        found: list[Message] = []
        strangers = 0
        for opcode, body in _split(data):
            if body is None:
                return found, "" if torn else "the records of a chunk break off"
            if opcode == Opcode.MESSAGE:
                if len(body) < _MESSAGE.size:
                    return found, "a message record is too short"
                number, _, log_ns, _ = _MESSAGE.unpack_from(body)
                if (channel := self._by_id.get(number)) is not None:
                    found.append(Message(log_ns, channel, body[_MESSAGE.size :]))
                else:
                    strangers += 1
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                try:
                    self._describe(opcode, body)
                except _PARSE_ERRORS:
                    return found, "a schema or channel record cannot be parsed"
        return found, f"{strangers} messages are of channels that the file does not describe" if strangers else ""
