"""ROS 1 bags (format 2.0) and the SQLite storage of ROS 2 bags.

A ROS 1 bag is a row of records, http://wiki.ros.org/Bags/Format/2.0. Chunks are found by the chunk infos at
its end, or by walking over the records where those are missing; the index records between the chunks are
not needed, so wrong ones do no harm. Type definitions and message layouts are `rosbags`' business.
"""

from __future__ import annotations

import re
import shutil
import sqlite3
import struct
from collections.abc import Collection, Iterable, Iterator
from functools import partial
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple
from urllib.parse import quote

import zstandard
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from readers.message_log import (
    Block,
    BlockLog,
    Buffer,
    Channel,
    DamagedBlockError,
    Message,
    MessageLog,
    Source,
    inflate,
    text,
)
from readers.streams import Damage, RecordingError

MAGIC = b"#ROSBAG V2.0\n"
SQLITE_MAGIC = b"SQLite format 3\0"
_MESSAGE, _BAG, _INDEX, _CHUNK, _CHUNK_INFO, _CONNECTION = 2, 3, 4, 5, 6, 7
_U32 = struct.Struct("<I")
_TWO_U32 = struct.Struct("<II")
_U64 = struct.Struct("<Q")
Fields = dict[bytes, bytes]


class TornError(Exception):
    """Records that break off."""


def _fields(header: Buffer) -> Fields:
    raw, at, found = bytes(header), 0, {}
    while at < len(raw):
        if at + 4 > len(raw):
            raise TornError
        (length,) = _U32.unpack_from(raw, at)
        at += 4 + length
        name, separator, value = raw[at - length : at].partition(b"=")
        if at > len(raw) or not separator:
            raise TornError
        found[name] = value
    return found


def _split(data: memoryview) -> Iterator[tuple[int, Fields, memoryview]]:
    """Operation code, header fields and data of each record.

    Raises:
        TornError: a record does not fit into `data`.
    """
    at = 0
    while at < len(data):
        try:
            (length,) = _U32.unpack_from(data, at)
            header = data[at + 4 : at + 4 + length]
            at += 4 + length
            (length,) = _U32.unpack_from(data, at)
        except struct.error as error:
            raise TornError from error
        body = data[at + 4 : at + 4 + length]
        if len(body) < length:
            raise TornError
        at += 4 + length
        fields = _fields(header)
        yield _operation(fields), fields, body


def _operation(fields: Fields) -> int:
    return (fields.get(b"op") or b"\0")[0]


def _time_ns(raw: bytes) -> int:
    seconds, nanoseconds = _TWO_U32.unpack(raw)
    return int(seconds * 1_000_000_000 + nanoseconds)


class Ros1Log(BlockLog):
    """One ROS 1 bag.

    Raises:
        RecordingError: no bag of format 2.0, or an encrypted one.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path, "ROS 1 bag 2.0")
        self._by_id: dict[int, Channel] = {}
        try:
            start, index = self._read_bag_header()
            fault = self._read_index(index)
            if fault:
                self._by_id, self.channels, self._blocks = {}, [], []
                self._scan(start, fault)
            else:
                self._find_edges()
        except BaseException:
            self.close()
            raise

    def _record_at(self, offset: int) -> tuple[Fields, int, int]:
        """Header fields of the record at `offset`, where its data begin, and how long they should be.

        Raises:
            TornError: there is no whole header.
        """
        try:
            (length,) = _U32.unpack(self._bytes(offset, 4))
            header = self._bytes(offset + 4, length)
            (data_length,) = _U32.unpack(self._bytes(offset + 4 + length, 4))
        except struct.error as error:
            raise TornError from error
        if length == 0:
            raise TornError
        return _fields(header), offset + 8 + length, data_length

    def _read_bag_header(self) -> tuple[int, tuple[int, int, int]]:
        """Where the first record after the bag header begins, and (place, connections, chunks) of the index."""
        if self._bytes(0, len(MAGIC)) != MAGIC:
            raise RecordingError(self.path, "it is no ROS 1 bag of format 2.0", "check that the file is complete")
        try:
            fields, data, length = self._record_at(len(MAGIC))
            place = _U64.unpack(fields[b"index_pos"])[0]
            connections = _U32.unpack(fields[b"conn_count"])[0]
            chunks = _U32.unpack(fields[b"chunk_count"])[0]
        except (TornError, KeyError, struct.error):
            return len(MAGIC), (0, 0, 0)
        if encryptor := fields.get(b"encryptor"):
            raise RecordingError(
                self.path, f"the bag is encrypted by {text(encryptor)}", "decrypt it with `rosbag decrypt` first"
            )
        return data + length, (place, connections, chunks)

    # ------------------------------------------------------------------------- with index

    def _read_index(self, index: tuple[int, int, int]) -> str:
        """Take channels and blocks from the end of the file; why that fails, or "" when it is done."""
        place, connections, chunks = index
        if not 0 < place <= self._size:
            return "the bag was not closed (it has no index at the stated place)"
        try:
            if place < self._size and _operation(self._record_at(place)[0]) not in (_CONNECTION, _CHUNK_INFO):
                return "the index is not at the stated place"
            infos = []
            for operation, fields, body in _split(memoryview(self._bytes(place, self._size - place))):
                if operation == _CONNECTION:
                    self._connect(fields, body)
                elif operation == _CHUNK_INFO:
                    infos.append((fields, body))
                else:
                    return "the index holds records that do not belong there"
            if (len(self._by_id), len(infos)) != (connections, chunks):
                return "the index is not the one that the bag header announces"
            self._take_chunk_infos(infos, place)
        except (TornError, KeyError, struct.error):
            return "the index is damaged"
        return ""

    def _take_chunk_infos(self, infos: list[tuple[Fields, memoryview]], end: int) -> None:
        infos.sort(key=lambda info: _U64.unpack(info[0][b"chunk_pos"])[0])
        places = [_U64.unpack(fields[b"chunk_pos"])[0] for fields, _ in infos] + [end]
        for (fields, body), place, following in zip(infos, places, places[1:], strict=False):
            counts = {self._by_id[number]: count for number, count in _TWO_U32.iter_unpack(body)}
            for channel, count in counts.items():
                channel.count += count
            if counts:
                first, last = _time_ns(fields[b"start_time"]), _time_ns(fields[b"end_time"])
                self._blocks.append(Block(place, following - place, first, last, counts))

    def _connect(self, fields: Fields, body: memoryview) -> None:
        """Take a connection record as a channel."""
        (number,) = _U32.unpack(fields[b"conn"])
        if number in self._by_id:
            return
        described = _fields(body)
        channel = Channel(
            topic=text(fields[b"topic"]),
            type=text(described.get(b"type", b"")),
            encoding="ros1",
            schema_encoding="ros1msg",
            schema=described.get(b"message_definition", b""),
        )
        self._by_id[number] = channel
        self.channels.append(channel)

    # ---------------------------------------------------------------------- without index

    def _scan(self, offset: int, fault: str) -> None:
        """Walk over the records from the start, up to the end of the file or to the tear."""
        self.notes.append("The bag has no usable index; it was read once to list what it holds.")
        lost = ""
        while offset < self._size:
            try:
                fields, data, length = self._record_at(offset)
                operation = _operation(fields)
                if operation == _INDEX and fields.get(b"ver") == _U32.pack(1):
                    length = 12 * _U32.unpack(fields[b"count"])[0]
                torn = data + length > self._size
                if operation == _CHUNK:
                    found = self._take(offset, min(data + length, self._size) - offset, torn=torn)
                    lost = f", {found} messages of its last chunk can be read" if torn else ""
                elif operation == _CONNECTION and not torn:
                    self._connect(fields, memoryview(self._bytes(data, length)))
                elif operation not in (_INDEX, _CHUNK_INFO, _CONNECTION):
                    break
                if torn:
                    break
            except (TornError, KeyError, struct.error):
                break
            offset = data + length
        self._report(
            f"{fault}{lost or ', what is there can be read'}; the damage begins",
            offset,
            self._size - min(offset, self._size),
        )

    # ------------------------------------------------------------------------------ blocks

    def _unpack(self, raw: memoryview, torn: bool) -> tuple[list[Message], str]:
        try:
            (length,) = _U32.unpack_from(raw)
            fields = _fields(raw[4 : 4 + length])
            (size,) = _U32.unpack_from(raw, 4 + length)
            compression = text(fields[b"compression"])
            (unpacked_size,) = _U32.unpack(fields[b"size"])
        except (TornError, KeyError, struct.error) as error:
            raise DamagedBlockError("no chunk begins where one should") from error
        packed = raw[8 + length :][:size]
        if len(packed) < size and not torn:
            raise DamagedBlockError(f"a chunk states {size} bytes and {len(packed)} are there")
        found: list[Message] = []
        strangers = 0
        try:
            for operation, header, body in _split(memoryview(inflate(compression, packed, unpacked_size, torn=torn))):
                if operation == _CONNECTION:
                    self._connect(header, body)
                elif operation == _MESSAGE:
                    channel = self._by_id.get(_U32.unpack(header[b"conn"])[0])
                    if channel is None:
                        strangers += 1
                    else:
                        found.append(Message(_time_ns(header[b"time"]), channel, body))
        except (TornError, KeyError, struct.error):
            return found, "" if torn else "the records of a chunk break off"
        return found, f"{strangers} messages are of connections that the bag does not describe" if strangers else ""


# ---------------------------------------------------------------------------------- SQLite


class SqliteLog(MessageLog):
    """One ``.db3`` file of a ROS 2 bag.

    The file is opened so that SQLite writes nothing beside it. Where a write-ahead log or a journal lies
    beside it, both are copied to a temporary folder first, because SQLite must merge them.

    Raises:
        RecordingError: no database of a ROS 2 bag, or one of which nothing can be read.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path, "ROS 2 bag, sqlite3")
        self._by_id: dict[int, Channel] = {}
        self._copy: TemporaryDirectory[str] | None = None
        self._rows: list[tuple[int, int, int]] | None = None
        self._database = self._connect()
        try:
            self._list_channels()
        except BaseException:
            self.close()
            raise

    def _connect(self) -> sqlite3.Connection:
        beside = [self.path.with_name(self.path.name + end) for end in ("-wal", "-journal")]
        pending = [file for file in beside if file.is_file() and file.stat().st_size > 0]
        if not pending:
            uri = f"file:{quote(str(self.path.resolve()))}?mode=ro&immutable=1"
            return sqlite3.connect(uri, uri=True, check_same_thread=False)
        self._copy = TemporaryDirectory(prefix="workbench-")
        copy = Path(self._copy.name) / self.path.name
        for file in (self.path, *pending):
            shutil.copyfile(file, copy.with_name(file.name))
        self.notes.append(
            f"{pending[0].name} lies beside the database; both were copied and merged in a temporary folder."
        )
        return sqlite3.connect(copy, check_same_thread=False)

    _COUNT = (
        "SELECT topic_id, typeof(timestamp) = 'integer', count(*), min(timestamp), max(timestamp)"
        " FROM messages GROUP BY 1, 2"
    )

    def _list_channels(self) -> None:
        try:
            self._read_tables()
            counted = list(self._database.execute(self._COUNT))
        except sqlite3.DatabaseError as error:
            self._salvage(str(error))
            return
        for number, timed, count, first_ns, last_ns in counted:
            if not timed:
                self._harm(f"{count} messages have no number as time and are left out", "table messages")
            elif (channel := self._by_id.get(number)) is not None:
                channel.count, channel.first_ns, channel.last_ns = count, first_ns, last_ns
            else:
                self._harm(f"{count} messages are of a topic that the database does not describe", "table messages")

    def _harm(self, what: str, where: str, affected: float = float("nan")) -> None:
        self.damage.append(Damage(what=what, where=where, affected=affected))

    def _read_tables(self) -> None:
        tables = {row[0] for row in self._database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
        if not {"topics", "messages"} <= tables:
            raise RecordingError(
                self.path, "the database has no tables topics and messages", "give the .db3 file of a ROS 2 bag"
            )
        definitions: dict[str, tuple[str, str]] = {}
        if "message_definitions" in tables:
            query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
            definitions = {name: (encoding, source) for name, encoding, source in self._database.execute(query)}
        query = "SELECT id, name, type, serialization_format FROM topics ORDER BY id"
        for number, topic, kind, encoding in self._database.execute(query):
            schema_encoding, schema = definitions.get(kind, ("", ""))
            self._by_id[number] = Channel(str(topic), str(kind), str(encoding), schema_encoding, schema.encode())
        self.channels = list(self._by_id.values())

    def sources(
        self, channels: Collection[Channel], start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterable[Source]:
        """One source for the whole database."""
        numbers = [number for number, channel in self._by_id.items() if channel in channels and channel.count]
        if not numbers:
            return
        first_ns = min(self._by_id[number].first_ns for number in numbers)
        last_ns = max(self._by_id[number].last_ns for number in numbers)
        start_ns = first_ns if start_ns is None else max(start_ns, first_ns)
        stop_ns = last_ns + 1 if stop_ns is None else min(stop_ns, last_ns + 1)
        if start_ns < stop_ns:
            rows = self._saved_rows if self._rows is not None else self._sound_rows
            yield Source(start_ns, partial(self._messages, rows(numbers, start_ns, stop_ns)))

    def count_before(self, channels: Collection[Channel], stop_ns: int) -> int:
        """How many messages of `channels` were logged before `stop_ns`."""
        numbers = [number for number, channel in self._by_id.items() if channel in channels]
        if self._rows is not None:
            return sum(1 for log_ns, _, number in self._rows if log_ns < stop_ns and number in numbers)
        marks = ", ".join("?" * len(numbers))
        query = (
            "SELECT count(*) FROM messages WHERE timestamp < ?"
            f" AND typeof(timestamp) = 'integer' AND topic_id IN ({marks})"
        )
        try:
            count: int = self._database.execute(query, (stop_ns, *numbers)).fetchone()[0]
        except sqlite3.DatabaseError:
            return super().count_before(channels, stop_ns)
        return count

    def _messages(self, rows: Iterator[tuple[int, int, Any]]) -> Iterator[Message]:
        for number, log_ns, data in rows:
            yield Message(log_ns, self._by_id[number], data.encode() if isinstance(data, str) else data or b"")

    def _sound_rows(self, numbers: list[int], start_ns: int, stop_ns: int) -> Iterator[tuple[int, int, Any]]:
        marks = ", ".join("?" * len(numbers))
        query = (
            "SELECT topic_id, timestamp, data FROM messages WHERE timestamp >= ? AND timestamp < ?"
            f" AND typeof(timestamp) = 'integer' AND topic_id IN ({marks}) ORDER BY timestamp, id"
        )
        try:
            yield from self._database.execute(query, (start_ns, stop_ns, *numbers))
        except sqlite3.DatabaseError as error:
            self._harm(f"reading stopped, the database is damaged ({error})", "table messages")

    # ------------------------------------------------------------------------------ damage

    _GIVE_UP_ROWS = 2000

    def _salvage(self, fault: str) -> None:
        """List the rows that can still be read, in the order of their numbers.

        SQLite refuses a database that is shorter than its header says, unless the schema is writable.
        """
        self.channels, self._by_id, self._rows = [], {}, []
        cure = "recover it with sqlite3's .recover command"
        try:
            self._database.execute("PRAGMA writable_schema = ON")
            self._read_tables()
        except sqlite3.DatabaseError as error:
            raise RecordingError(self.path, f"the database is damaged ({fault})", cure) from error
        self._list_rows()
        if not self._rows:
            raise RecordingError(self.path, f"no message of the database can be read ({fault})", cure)
        self._rows.sort()
        for log_ns, _, number in self._rows:
            self._by_id[number].note(log_ns)
        share = self._missing_share()
        where = "the pages beyond the end of the file" if share > 0 else "some of its pages"
        self._harm(f"{len(self._rows)} messages could be read, the others are lost: {fault}", where, share)

    def _list_rows(self) -> None:
        """Collect (log time, row, topic) of what can be read; step over rows that cannot, up to a limit."""
        assert self._rows is not None
        query = "SELECT id, topic_id, timestamp, data FROM messages WHERE id > ? ORDER BY id"
        last, failures = 0, 0
        while failures < self._GIVE_UP_ROWS:
            try:
                for row, number, log_ns, _ in self._database.execute(query, (last,)):
                    last, failures = row, 0
                    if number in self._by_id and isinstance(log_ns, int):
                        self._rows.append((log_ns, row, number))
                return
            except sqlite3.DatabaseError:
                last, failures = last + 1, failures + 1

    def _missing_share(self) -> float:
        """Share of the pages that the header announces and the file does not have, NaN if that is not the fault."""
        with self.path.open("rb") as file:
            header = file.read(100)
        page = struct.unpack_from(">H", header, 16)[0]
        expected = (65536 if page == 1 else page) * struct.unpack_from(">I", header, 28)[0]
        missing = expected - self.path.stat().st_size
        return missing / expected if missing > 0 else float("nan")

    def _saved_rows(self, numbers: list[int], start_ns: int, stop_ns: int) -> Iterator[tuple[int, int, Any]]:
        for log_ns, row, number in self._rows or ():
            if number in numbers and start_ns <= log_ns < stop_ns:
                for (data,) in self._database.execute("SELECT data FROM messages WHERE id = ?", (row,)):
                    yield number, log_ns, data

    def close(self) -> None:
        """Release the database and the temporary copy, if there is one."""
        self._database.close()
        if self._copy is not None:
            self._copy.cleanup()


def natural_key(name: str) -> list[tuple[int, str]]:
    """Sort key by which ``part_10`` comes after ``part_9``."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name)]


# ---------------------------------------------------------------------------------- folders


class BagMetadata(NamedTuple):
    """What a ROS 2 bag's metadata.yaml says: its files (None if it cannot tell) and each topic's serialisation."""

    files: list[str] | None
    formats: dict[str, str]
    remarks: list[str]


def read_metadata(folder: Path) -> BagMetadata:
    """Read metadata.yaml of a ROS 2 bag, if there is one.

    Only the last part of a stated path counts, so nothing outside of the folder is opened.
    """
    metadata = folder / "metadata.yaml"
    if not metadata.is_file():
        return BagMetadata(None, {}, ["The bag has no metadata.yaml; its files were found by their names."])
    try:
        stated = YAML(typ="safe", pure=True).load(metadata.read_text("utf-8"))["rosbag2_bagfile_information"]
        files = [PurePosixPath(str(name)).name for name in stated["relative_file_paths"]]
        topics = [entry["topic_metadata"] for entry in stated.get("topics_with_message_count") or ()]
        return BagMetadata(files, {str(t["name"]): str(t["serialization_format"]) for t in topics}, [])
    except (YAMLError, UnicodeDecodeError, LookupError, TypeError, AttributeError):
        return BagMetadata(None, {}, ["metadata.yaml cannot be parsed; the bag's files were found by their names."])


def unpack(path: Path, scratch: list[TemporaryDirectory[str]]) -> Path:
    """Unpack a zstd file into a temporary folder, which is made and added to `scratch` if there is none.

    Raises:
        RecordingError: the file cannot be unpacked.
    """
    if not scratch:
        scratch.append(TemporaryDirectory(prefix="workbench-"))
    target = Path(scratch[0].name) / (path.stem if path.suffix in (".zstd", ".zst") else path.name)
    try:
        with path.open("rb") as packed, target.open("wb") as plain:
            stream = zstandard.ZstdDecompressor().stream_reader(packed, read_across_frames=True)
            shutil.copyfileobj(stream, plain, 1 << 20)
    except zstandard.ZstdError as error:
        raise RecordingError(path, f"it cannot be unpacked ({error})", "copy it again") from error
    return target
