"""ROS 1 bags of format 2.0, http://wiki.ros.org/Bags/Format/2.0: a row of records, read where they lie.

Chunks are found by the chunk infos at the end of the file, or by walking over the records where those are missing or
wrong; behind a stretch that holds no records the walk goes on at the next chunk. What follows each chunk, its index,
says what the chunk holds without unpacking it, and where its messages begin if the records inside break off. The
lengths that the index records state are not believed, since real files have wrong ones: their counts are.
"""

from __future__ import annotations

import mmap
import struct
import time
from bisect import bisect_left, bisect_right
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from itertools import islice, permutations
from operator import gt, itemgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from readers.ahead import WORTH_A_THREAD_S, Ahead, settle
from readers.index_cache import Entry, State
from readers.index_states import Ros1Found, put_ros1, ros1_state
from readers.message_log import (
    HARMLESS_BYTES,
    LARGEST_RATIO,
    LARGEST_UNPACKED_BYTES,
    Buffer,
    Channel,
    DamagedBlockError,
    Message,
    MessageLog,
    Source,
    escaped,
    inflate,
    text,
)
from readers.salvage import Cause, Loss, Tally
from readers.streams import RecordingError

MAGIC = b"#ROSBAG V2.0\n"
_MESSAGE, _BAG, _INDEX, _CHUNK, _CHUNK_INFO, _CONNECTION = 2, 3, 4, 5, 6, 7
_BETWEEN_CHUNKS = (_INDEX, _CONNECTION, _CHUNK_INFO)
_U32 = struct.Struct("<I")
_TWO_U32 = struct.Struct("<II")
_U64 = struct.Struct("<Q")
_CHUNK_MARK = b"\x04\0\0\0op=\x05"
_MESSAGE_MARK = b"\x04\0\0\0op=\x02"
_LONGEST_CHUNK_HEADER = 80
_WINDOW_BYTES = 1 << 12
_LONGEST_HEADER = 1 << 20
_SHORT_HEADER = 64
KEPT_CHUNKS, KEPT_CHUNK_BYTES = 4, 1 << 21
_MAGICS = {b"lz4": b"\x04\x22\x4d\x18", b"bz2": b"BZh9"}
_COMPRESSIONS = (b"none", b"bz2", b"lz4")
_END_OF_TIME = 1 << 63
_SECOND_NS = np.uint64(1_000_000_000)
_ENTRY = np.dtype([("seconds", "<u4"), ("rest", "<u4"), ("place", "<u4")])
Fields = dict[bytes, bytes]


class TornError(Exception):
    """Bytes that are no record, or not a whole one."""


class Record(NamedTuple):
    """One record of a bag: where it begins, its header, and the range of its data (which may be torn)."""

    offset: int
    operation: int
    fields: Fields
    start: int
    stop: int
    torn: bool = False

    def u32(self, name: bytes) -> int:
        """A number of the header.

        Raises:
            TornError: there is none of that name and size.
        """
        return self._number(name, _U32)

    def u64(self, name: bytes) -> int:
        """A long number of the header, as `u32`."""
        return self._number(name, _U64)

    def time_ns(self, name: bytes) -> int:
        """A time of the header, as `u32`."""
        raw = self._number(name, _U64)
        return (raw & 0xFFFFFFFF) * 1_000_000_000 + (raw >> 32)

    def _number(self, name: bytes, form: struct.Struct) -> int:
        raw = self.fields.get(name, b"")
        if len(raw) != form.size:
            raise TornError
        return int(form.unpack(raw)[0])

    @property
    def connection(self) -> bool:
        """Whether it describes a connection, by its kind or, where that is damaged, by its fields."""
        return self.operation == _CONNECTION or (b"conn" in self.fields and b"topic" in self.fields)


def fields_of(raw: Buffer) -> Fields:
    """The named fields of a header, which are not to be changed.

    Raises:
        TornError: they do not fill it.
    """
    raw = bytes(raw)
    return _short_fields(raw) if len(raw) <= _SHORT_HEADER else _fields(raw)


def _fields(raw: bytes) -> Fields:
    at, end, found = 0, len(raw), {}
    while at < end:
        if at + 4 > end:
            raise TornError
        (length,) = _U32.unpack_from(raw, at)
        at += 4 + length
        name, separator, value = raw[at - length : at].partition(b"=")
        if at > end or not separator:
            raise TornError
        found[name] = value
    return found


_short_fields = lru_cache(maxsize=4096)(_fields)  # most headers of index records come again with every chunk


def record_at(data: memoryview, offset: int) -> Record:
    """The record at `offset`, whose data may reach beyond the end.

    Raises:
        TornError: there is no whole header.
    """
    try:
        (length,) = _U32.unpack_from(data, offset)
        start = offset + 8 + length
        if not 0 < length <= _LONGEST_HEADER or start > len(data):
            raise TornError
        (size,) = _U32.unpack_from(data, start - 4)
    except struct.error as error:
        raise TornError from error
    fields = fields_of(data[offset + 4 : start - 4])
    operation = (fields.get(b"op") or b"\0")[0]
    if operation == _INDEX and fields.get(b"ver") == _U32.pack(1) and len(fields.get(b"count", b"")) == 4:
        size = _ENTRY.itemsize * _U32.unpack(fields[b"count"])[0]
    return Record(offset, operation, fields, start, start + size)


# ------------------------------------------------------------------------------ message records


_MARKS = {
    b"op": b"\x04\0\0\0op=\x02",
    b"conn": b"\x09\0\0\0conn=",
    b"time": b"\x0d\0\0\0time=",
}
_VALUES = {b"op": "", b"conn": "I", b"time": "Q"}
_HEADER_BYTES = 38


class _Layout(NamedTuple):
    """A message record up to its data, with the header's fields in one order, for one look at all of it.

    `form` unpacks the marks before the first value, that value, the marks before the second one, that value, the marks
    behind it, and the length of the data. `time_first` tells which value is the time, the other one is the connection.
    """

    form: struct.Struct
    marks: tuple[bytes, bytes, bytes]
    time_first: bool

    @classmethod
    def of(cls, order: tuple[bytes, ...]) -> _Layout:
        """The layout with the fields in that order."""
        marks, values = [_U32.pack(_HEADER_BYTES)], [""]
        for name in order:
            marks[-1] += _MARKS[name]
            if _VALUES[name]:
                values[-1] = _VALUES[name]
                marks.append(b"")
                values.append("")
        form = struct.Struct(
            "<" + "".join(f"{len(mark)}s{value}" for mark, value in zip(marks, values, strict=True)) + "I"
        )
        before, between, behind = marks
        return cls(form, (before, between, behind), values[0] == "Q")


_LAYOUTS = [_Layout.of(order) for order in permutations(_MARKS)]


def layout_at(data: memoryview, at: int) -> _Layout | None:
    """The layout of the message record at `at`; None if there is none such."""
    if at + _HEADER_BYTES + 8 > len(data):
        return None
    return next((one for one in _LAYOUTS if one.form.unpack_from(data, at)[:5:2] == one.marks), None)


Item = tuple[int, int, memoryview] | Record


class Walk:
    """The records of a chunk one after the other, from `start` on.

    Attributes:
        items: of a message its connection, time in ns and data; a connection's record as it is.
        torn: where they break off, -1 if nowhere.
        last: where the last record begins, -1 if there is none.
    """

    def __init__(self, data: memoryview, start: int = 0) -> None:
        self.data = data
        self.items: list[Item] = []
        self.torn = self.last = -1
        add, at, end, last = self.items.append, start, len(data), -1
        last_head = end - _HEADER_BYTES - 8
        form, marks, time_first = _LAYOUTS[0]
        while at < end:
            head = form.unpack_from(data, at) if at <= last_head else ()
            if head[:5:2] != marks:
                layout = layout_at(data, at)
                form, marks, time_first = layout or _LAYOUTS[0]
                head = form.unpack_from(data, at) if layout else ()
            if head:
                _, number, _, time, _, length = head
                if time_first:
                    number, time = time, number
                start = at + _HEADER_BYTES + 8
                stop = start + length
                item: Item = (number, (time & 0xFFFFFFFF) * 1_000_000_000 + (time >> 32), data[start:stop])
            else:
                try:
                    item, stop = _any_record(data, at)
                except TornError:
                    break
            if stop > end:
                break
            last, at = at, stop
            add(item)
        self.last, self.torn = last, at if at < end else -1


def _any_record(data: memoryview, at: int) -> tuple[Item, int]:
    """A message or a connection whose header has other fields, or more, and where it ends."""
    record = record_at(data, at)
    if record.connection:
        return record, record.stop
    if record.operation != _MESSAGE:
        raise TornError
    return (record.u32(b"conn"), record.time_ns(b"time"), data[record.start : record.stop]), record.stop


# ----------------------------------------------------------------------------------------- chunks


class Span(NamedTuple):
    """Messages of one connection in a chunk: how many, first and last log time, and the sum of all times mod 2^64."""

    messages: int
    first_ns: int
    last_ns: int
    sum_ns: int

    @classmethod
    def of(cls, times_ns: NDArray[np.uint64]) -> Span:
        """The span of at least one log time."""
        first_ns, last_ns = np.minimum.reduce(times_ns), np.maximum.reduce(times_ns)
        return cls(len(times_ns), int(first_ns), int(last_ns), int(np.add.reduce(times_ns)))


@dataclass(eq=False, slots=True)
class Chunk:
    """A chunk: its record, and what it holds by connection."""

    record: Record
    spans: dict[int, Span]

    @property
    def packed(self) -> bool:
        """Whether it is compressed."""
        return self.record.fields[b"compression"] != b"none"

    @property
    def first_ns(self) -> int:
        """Log time of its earliest message."""
        return min(span.first_ns for span in self.spans.values())

    @property
    def last_ns(self) -> int:
        """Log time of its latest message."""
        return max(span.last_ns for span in self.spans.values())

    @property
    def sum_ns(self) -> int:
        """Sum of all its log times mod 2^64."""
        return sum(span.sum_ns for span in self.spans.values()) % 2**64


class ChunkIndex(NamedTuple):
    """The index behind a chunk: its entries by connection; `complete` where another record follows it."""

    entries: dict[int, NDArray[np.void]]
    complete: bool

    @property
    def places(self) -> list[int]:
        """Where the messages begin in the chunk."""
        return [place for entries in self.entries.values() for place in entries["place"].tolist()]

    @property
    def outline(self) -> tuple[dict[int, Span], bool]:
        """What the chunk holds by connection, and whether the index is complete; it takes little memory."""
        spans = {
            number: Span.of(entries["seconds"] * _SECOND_NS + entries["rest"])
            for number, entries in self.entries.items()
            if len(entries)
        }
        return spans, self.complete


def index_behind(data: memoryview, chunk: Record) -> ChunkIndex:
    """The index records behind a chunk, as far as they are whole."""
    entries: dict[int, NDArray[np.void]] = {}
    at, complete = chunk.stop, False
    try:
        while at < len(data):
            record = record_at(data, at)
            complete = record.operation in (_CHUNK, _CONNECTION, _CHUNK_INFO)
            if record.operation != _INDEX or record.stop > len(data):
                break
            found = np.frombuffer(data[record.start : record.stop], _ENTRY)
            number = record.u32(b"conn")
            entries[number] = np.concatenate([entries[number], found]) if number in entries else found
            at = record.stop
    except (TornError, ValueError):
        pass
    return ChunkIndex(entries, complete)


class _ChunkInfo(NamedTuple):
    """What the end of the file says of a chunk."""

    first_ns: int
    last_ns: int
    counts: dict[int, int]

    @property
    def key(self) -> tuple[int, int, frozenset[tuple[int, int]]]:
        """What two infos have in common that say the same."""
        return self.first_ns, self.last_ns, frozenset(self.counts.items())

    @classmethod
    def of(cls, spans: Mapping[int, Span]) -> _ChunkInfo:
        """What it would say of a chunk with that index."""
        times = [time for span in spans.values() for time in (span.first_ns, span.last_ns)]
        return cls(min(times, default=0), max(times, default=0), {n: span.messages for n, span in spans.items()})


class Ros1Log(MessageLog):
    """One ROS 1 bag.

    Raises:
        RecordingError: no bag of format 2.0, or an encrypted one.
    """

    def __init__(self, path: Path, cached: Entry | None = None) -> None:
        super().__init__(path, "ROS 1 bag 2.0", cached)
        with path.open("rb") as file:
            self._map = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        self._data = memoryview(self._map)
        self._size = len(self._data)
        self._by_id: dict[int, Channel] = {}
        self._chunks: list[Chunk] = []
        self._latest: tuple[Chunk | None, list[Message]] = (None, [])
        self._kept: dict[Chunk, Buffer] = {}
        self._told: set[tuple[str, int]] = set()
        self._running: set[Future[Any]] = set()
        if self._data[: len(MAGIC)] != MAGIC:
            raise RecordingError(path, "it is no ROS 1 bag of format 2.0", "check that the file is complete")
        if not self.recall(self._put):
            begun = time.perf_counter()
            self._open()
            found = Ros1Found(self._by_id, self._chunks, self._told)
            self.keep(lambda: ros1_state(self, found), time.perf_counter() - begun)

    def _put(self, state: State) -> None:
        self._by_id, self._chunks, self._told = put_ros1(self, state, self._size)

    def _open(self) -> None:
        header = self._bag_header()
        records, infos = self._walk(len(MAGIC) if header is None else header.stop)
        if header is not None:
            self._judge_header(header, len(records), len(infos))
        self._list(records, infos)

    def _harm(self, cause: Cause, sentence: str, start: int, stop: int, **known: Any) -> None:
        """Note a loss, once for each place: what is read again is not lost again."""
        if (sentence, start) in self._told:
            return
        self._told.add((sentence, start))
        self.lose(Loss(what=cause, text=sentence, start=start, stop=stop, file_bytes=self._size, **known))

    # --------------------------------------------------------------------------- the records

    def _bag_header(self) -> Record | None:
        """The bag header, None if it is damaged."""
        try:
            header = record_at(self._data, len(MAGIC))
            if header.operation != _BAG or header.stop > self._size:
                raise TornError
        except TornError:
            self._harm(Cause.CUT, "the bag header is damaged", len(MAGIC), len(MAGIC))
            return None
        if encryptor := header.fields.get(b"encryptor"):
            raise RecordingError(
                self.path, f"the bag is encrypted by {text(encryptor)}", "decrypt it with `rosbag decrypt` first"
            )
        return header

    def _walk(self, at: int) -> tuple[list[Record], dict[int, _ChunkInfo]]:
        """The chunks of the file in their order, and what the chunk infos say, by the place of the chunk."""
        chunks: list[Record] = []
        infos: dict[int, _ChunkInfo] = {}
        while at < self._size:
            try:
                record = record_at(self._data, at)
                if record.operation == _CHUNK:
                    record = self._chunk(record)
                    chunks.append(record)
                elif record.stop > self._size or not (record.connection or record.operation in _BETWEEN_CHUNKS):
                    raise TornError
                elif record.connection:
                    self._connect(record, self._data)
                elif record.operation == _CHUNK_INFO:
                    infos[record.u64(b"chunk_pos")] = _chunk_info(record, self._data)
                at = record.stop
            except TornError:
                following = self._next_chunk(at + 1)
                whole = following < self._size
                ends = "no record begins where one should" if whole else "no record can be read from here to the end"
                self._harm(Cause.CUT, ends, at, following)
                chunks += self._bare_messages(at, following)
                at = following
        return chunks, infos

    def _chunk(self, record: Record) -> Record:
        """A chunk's record; where it reaches beyond the end of the file it stops at the next chunk or the end."""
        if b"compression" not in record.fields:
            raise TornError
        record.u32(b"size")
        if record.stop <= self._size:
            return record
        record = record._replace(stop=self._next_chunk(record.start), torn=True)
        ends = (
            "the file ends inside a chunk" if record.stop == self._size else "a chunk states a size that is not its own"
        )
        self._harm(Cause.CUT, f"{ends}, which is read as far as it goes", record.offset, record.stop)
        return record

    def _next_chunk(self, offset: int) -> int:
        """Where the next chunk at or after `offset` begins; the end of the file if there is none."""
        mark = self._map.find(_CHUNK_MARK, offset)
        while mark >= 0:
            for start in range(max(offset, mark - _LONGEST_CHUNK_HEADER), mark - 3):
                try:
                    record = record_at(self._data, start)
                    if record.operation == _CHUNK and record.fields.get(b"compression") in _COMPRESSIONS:
                        record.u32(b"size")
                        return start
                except TornError:
                    continue
            mark = self._map.find(_CHUNK_MARK, mark + 1)
        return self._size

    def _bare_messages(self, start: int, stop: int) -> Iterator[Record]:
        """What is left of a chunk without its head, as a torn chunk: from its first message or the codec's mark on."""
        found = {codec: self._map.find(magic, start, stop) for codec, magic in _MAGICS.items()}
        found[b"none"] = start + _next_message(self._data[start:stop], 0)
        at, compression = min(((at, codec) for codec, at in found.items() if at >= start), default=(-1, b""))
        if at >= 0:
            packed = stop - at
            size = packed if compression == b"none" else max(HARMLESS_BYTES, LARGEST_RATIO * packed)
            fields = {b"compression": compression, b"size": _U32.pack(min(size, LARGEST_UNPACKED_BYTES))}
            yield Record(start, _CHUNK, fields, at, stop, torn=True)

    def _connect(self, record: Record, data: memoryview, base: int = 0) -> None:
        """Take a connection record as a channel.

        Raises:
            TornError: its fields cannot be read.
        """
        number, described = record.u32(b"conn"), fields_of(data[record.start : record.stop])
        topic = record.fields.get(b"topic", described.get(b"topic"))
        if topic is None:
            raise TornError
        if record.operation != _CONNECTION or b"topic" not in record.fields:
            words = f"the description of connection {number} is damaged; what is left of it served"
            self._harm(Cause.SCHEMA, words, base or record.offset, base or record.offset)
        channel = Channel(
            topic=escaped(text(topic)),
            type=escaped(text(described.get(b"type", b""))),
            encoding="ros1",
            schema_encoding="ros1msg",
            schema=described.get(b"message_definition", b""),
        )
        known = self._by_id.setdefault(number, channel)
        if known is channel:
            self.channels.append(channel)
        elif (known.topic, known.type, known.schema) != (channel.topic, channel.type, channel.schema):
            words = f"connection {number} is described twice, differently ({known.topic} and {channel.topic})"
            self._harm(Cause.SCHEMA, words, base or record.offset, base or record.offset)

    def _connect_within(self, chunk: Chunk, record: Record, data: memoryview) -> None:
        try:
            self._connect(record, data, chunk.record.offset)
        except TornError:
            start = chunk.record.offset
            self._harm(Cause.SCHEMA, "the description of a connection in a chunk is damaged", start, start)

    # --------------------------------------------------------------------------- what there is

    def _judge_header(self, header: Record, chunks: int, infos: int) -> None:
        """Say whether the bag was closed, and whether its header tells the truth."""
        try:
            place, stated = header.u64(b"index_pos"), header.u32(b"chunk_count")
            operation = record_at(self._data, place).operation if place < self._size else 0
        except TornError:
            place, stated, operation = self._size + 1, 0, 0
        if place == 0 or infos == 0 != chunks:
            words = "the bag was not closed (it has no index), what is there can be read"
            self._harm(Cause.CUT, words, self._size, self._size)
        elif place > self._size or (place < self._size and operation not in (_CONNECTION, _CHUNK_INFO)):
            self._harm(Cause.CUT, "the bag header states no place of an index", header.offset, header.offset)
        elif infos < chunks:
            words = f"the index describes {infos} of {chunks} chunks, the others are read as they are"
            self._harm(Cause.CUT, words, self._size, self._size)
        elif stated != chunks:
            words = f"the bag header states {stated} chunks and {chunks} are there"
            self._harm(Cause.COUNT, words, header.offset, header.offset)

    def _list(self, records: list[Record], infos: dict[int, _ChunkInfo]) -> None:
        """Find out what each chunk holds: from its index where the chunk info agrees, else from itself."""
        indexes = [index_behind(self._data, record).outline for record in records]
        for record, (spans, complete), info in zip(records, indexes, _infos_of(records, indexes, infos), strict=True):
            chunk, own = Chunk(record, spans), _ChunkInfo.of(spans)
            believed = info == own if info else bool(spans) and complete
            if record.torn or not believed or not chunk.spans.keys() <= self._by_id.keys():
                chunk.spans = self._look_into(chunk, spans if believed else _announced(info))
            if chunk.spans:
                self._chunks.append(chunk)
        for place, info in infos.items():
            topics = self._tallies(info.counts)
            words = "a chunk is not where the index states it"
            self._harm(Cause.CUT, words, place, place, first_ns=info.first_ns, last_ns=info.last_ns, topics=topics)
        self._chunks.sort(key=lambda chunk: chunk.first_ns)
        for chunk in self._chunks:
            for number, span in chunk.spans.items():
                channel = self._by_id[number]
                channel.count += span.messages
                channel.first_ns = span.first_ns if channel.first_ns < 0 else min(channel.first_ns, span.first_ns)
                channel.last_ns = max(channel.last_ns, span.last_ns)

    def _look_into(self, chunk: Chunk, stated: Mapping[int, Span]) -> dict[int, Span]:
        """What a chunk really holds, by connection; what it should hold is `stated`."""
        chunk.spans = dict(stated)
        times: dict[int, list[int]] = {}
        numbers = {channel: number for number, channel in self._by_id.items()}
        for message in self._load(chunk):
            number = numbers.get(message.channel)
            if number is None:
                numbers = {channel: number for number, channel in self._by_id.items()}
                number = numbers[message.channel]
            times.setdefault(number, []).append(message.log_ns)
        return {number: Span.of(np.array(found, np.uint64)) for number, found in times.items()}

    def _tallies(self, counts: Mapping[int, int], *, withheld: bool = False) -> dict[str, Tally]:
        found: dict[str, Tally] = {}
        for number, count in counts.items():
            channel = self._by_id.get(number)
            topic = channel.topic if channel else f"connection {number}"
            tally = Tally(withheld=count) if withheld else Tally(lost=count)
            found[topic] = found.get(topic, Tally()) + tally
        return found

    # ------------------------------------------------------------------------------- messages

    def _unpacked(self, chunk: Chunk) -> Buffer:
        """The records of a chunk; the first few that were packed are kept, for a second look at the log's begin.

        Raises:
            DamagedBlockError: they cannot be unpacked.
        """
        if (kept := self._kept.get(chunk)) is not None:
            return kept
        record = chunk.record
        packed = self._data[record.start : record.stop]
        data = inflate(text(record.fields[b"compression"]), packed, record.u32(b"size"), torn=record.torn)
        if chunk.packed and len(data) <= KEPT_CHUNK_BYTES and len(self._kept) < KEPT_CHUNKS:
            self._kept[chunk] = data
        return data

    def _load(self, chunk: Chunk, ahead: Ahead[Chunk, Buffer] | None = None) -> list[Message]:
        """The messages of a chunk in the order of log time; what is wrong with it is noted."""
        if self._latest[0] is not chunk:
            try:
                data = ahead.take(chunk) if ahead is not None and chunk.packed else self._unpacked(chunk)
                found = self._messages(chunk, memoryview(data))
            except DamagedBlockError as error:
                found = []
                self._judge_chunk(chunk, Counter(), Cause.CODEC, str(error))
            self._latest = (chunk, found)
        return self._latest[1]

    def _messages(self, chunk: Chunk, data: memoryview) -> list[Message]:
        found: list[Message] = []
        counts: Counter[int] = Counter()
        at, broken = 0, ""
        places: list[int] | None = None
        channel_of, new = self._by_id.get, tuple.__new__
        while at >= 0:
            walk = Walk(data, at)
            items = walk.items
            if walk.torn >= 0:
                broken = "the records of a chunk break off"
                places = sorted(index_behind(self._data, chunk.record).places) if places is None else places
                at = self._after_break(chunk, walk, items, places)
            else:
                at = -1
            for item in items:
                if isinstance(item, Record):
                    self._connect_within(chunk, item, data)
            messages = [item for item in items if not isinstance(item, Record)]
            counts.update(map(itemgetter(0), messages))
            found += [
                new(Message, (log_ns, channel, payload, -1, -1))
                for number, log_ns, payload in messages
                if (channel := channel_of(number)) is not None
            ]
        times_ns = [message[0] for message in found]
        self._judge_chunk(chunk, counts, Cause.CUT, "" if chunk.record.torn else broken, sum(times_ns))
        if any(map(gt, times_ns, islice(times_ns, 1, None))):
            found.sort(key=itemgetter(0))
        return found

    def _after_break(self, chunk: Chunk, walk: Walk, items: list[Item], places: list[int]) -> int:
        """Where the messages of a chunk go on behind the place where they broke off; -1 if nowhere.

        That is the next of the sorted `places` that its index names, or, where none of them holds a message, the next
        that does. A record that ends where none can begin has a wrong length: it is taken out of `items`, except where
        the file was cut there.
        """
        at = walk.torn
        cut = chunk.record.torn and chunk.record.stop == self._size
        listed = bisect_left(places, at) < bisect_right(places, at)
        if not listed and walk.last >= 0 and not cut and not _is_record(walk.data, at):
            items.pop()
            at = walk.last
        behind = islice(places, bisect_right(places, at), None)
        indexed = next((place for place in behind if layout_at(walk.data, place)), -1)
        return indexed if indexed >= 0 or cut else _next_message(walk.data, at + 1)

    def _judge_chunk(self, chunk: Chunk, counts: Counter[int], cause: Cause, broken: str, sum_ns: int = 0) -> None:
        """Compare what a chunk gave (messages by connection, sum of their times) with what it was to hold."""
        stated = {number: span.messages for number, span in chunk.spans.items()}
        missing = {number: count - counts[number] for number, count in stated.items() if count > counts[number]}
        strangers = {number: count for number, count in counts.items() if number not in self._by_id}
        moved = bool(stated) and all(span.sum_ns for span in chunk.spans.values()) and sum_ns % 2**64 != chunk.sum_ns
        surplus = sum(max(0, count - stated.get(number, 0)) for number, count in counts.items()) if stated else 0
        times = [time for span in chunk.spans.values() for time in (span.first_ns, span.last_ns) if time >= 0]
        known: dict[str, Any] = {"first_ns": min(times), "last_ns": max(times)} if times else {}
        start, stop = chunk.record.offset, chunk.record.stop
        if strangers:
            words = f"{sum(strangers.values())} messages are of connections that the bag does not describe"
            self._harm(Cause.SCHEMA, words, start, start, topics=self._tallies(strangers, withheld=True), **known)
        if broken or sum(missing.values()) > surplus:
            words = broken or f"a chunk holds {sum(missing.values())} messages fewer than its index states"
            topics = self._tallies(missing, withheld=cause is Cause.CODEC)
            self._harm(cause if broken else Cause.COUNT, words, start, stop, topics=topics, **known)
        elif not strangers and (surplus or moved):
            words = "a chunk holds other messages, or other times, than its index states"
            self._harm(Cause.COUNT, words, start, start, **known)

    # -------------------------------------------------------------------------------- reading

    def sources(
        self, channels: Collection[Channel], start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterable[Source]:
        """One source a chunk that holds one of the channels and overlaps the range, see `MessageLog.sources`."""
        wanted = frozenset(channels)
        numbers = [number for number, channel in self._by_id.items() if channel in wanted]

        def chosen() -> Iterator[Chunk]:
            for chunk in self._chunks:
                spans = [chunk.spans[number] for number in numbers if number in chunk.spans]
                if any(
                    (start_ns is None or span.last_ns >= start_ns) and (stop_ns is None or span.first_ns < stop_ns)
                    for span in spans
                ):
                    yield chunk

        packed = ((chunk, chunk.record.u32(b"size")) for chunk in chosen() if chunk.packed)
        pause_s = 0.0 if self._slow else WORTH_A_THREAD_S
        ahead = Ahead(self._unpacked, packed, pause_s, self._running, after=KEPT_CHUNKS)
        low, high = start_ns or 0, stop_ns if stop_ns is not None else _END_OF_TIME
        for chunk in chosen():
            select = partial(self._select, chunk, wanted, low, high, ahead)
            yield Source(chunk.first_ns, select, chunk.last_ns)

    @cached_property
    def _slow(self) -> bool:
        """Whether unpacking takes so long that it is worth a thread in any case."""
        return any(chunk.record.fields[b"compression"] == b"bz2" for chunk in self._chunks)

    def _select(
        self, chunk: Chunk, wanted: frozenset[Channel], low: int, high: int, ahead: Ahead[Chunk, Buffer]
    ) -> Iterator[Message]:
        messages = self._load(chunk, ahead)
        if not wanted.issuperset(self._by_id.values()):
            messages = [message for message in messages if message[1] in wanted]
        first, last = bisect_left(messages, low, key=itemgetter(0)), bisect_left(messages, high, key=itemgetter(0))
        return iter(messages) if last - first == len(messages) else islice(messages, first, last)

    def count_before(self, channels: Collection[Channel], stop_ns: int) -> int:
        """How many messages of `channels` were logged before `stop_ns`; by the index, a few chunks are unpacked.

        The messages of a damaged chunk that has an index are counted, so that the later ones keep their numbers.
        """
        numbers, total = [n for n, channel in self._by_id.items() if channel in channels], 0
        for chunk in self._chunks:
            spans = [chunk.spans[number] for number in numbers if number in chunk.spans]
            total += sum(span.messages for span in spans if span.last_ns < stop_ns)
            if open_ends := [span for span in spans if span.first_ns < stop_ns <= span.last_ns]:
                edge = {self._by_id[n] for n in numbers if chunk.spans.get(n) in open_ends}
                total += sum(m.channel in edge and m.log_ns < stop_ns for m in self._load(chunk))
        return total

    def close(self) -> None:
        """Release the file; the system does so when the last message of it is gone."""
        settle(self._running)
        self._latest = (None, [])
        self._kept.clear()
        self._chunks = []


def _next_message(data: memoryview, start: int) -> int:
    """Where the next message record at or after `start` begins, -1 if nowhere."""
    for window in range(start, len(data), _WINDOW_BYTES):
        raw = bytes(data[window : window + _WINDOW_BYTES + len(_MESSAGE_MARK) - 1])
        mark = raw.find(_MESSAGE_MARK)
        while mark >= 0:
            for at in range(max(start, window + mark - _HEADER_BYTES), window + mark):
                if layout_at(data, at):
                    return at
            mark = raw.find(_MESSAGE_MARK, mark + 1)
    return -1


def _is_record(data: memoryview, offset: int) -> bool:
    """Whether a record of those outside of chunks begins there."""
    try:
        return record_at(data, offset).operation in (_CHUNK, *_BETWEEN_CHUNKS)
    except TornError:
        return False


def _announced(info: _ChunkInfo | None) -> dict[int, Span]:
    """What a chunk should hold if its own index cannot be believed; times are unknown."""
    return {number: Span(count, -1, -1, 0) for number, count in info.counts.items()} if info else {}


def _infos_of(
    records: Sequence[Record], indexes: Sequence[tuple[dict[int, Span], bool]], infos: dict[int, _ChunkInfo]
) -> list[_ChunkInfo | None]:
    """The chunk info of each chunk, which is taken out of `infos`: the one that agrees with its index, or its place's.

    Those that agree come first, so that chunks which were moved do not take the infos of others.
    """
    found: list[_ChunkInfo | None] = []
    places: dict[tuple[int, int, frozenset[tuple[int, int]]], list[int]] = {}
    for place, info in infos.items():
        places.setdefault(info.key, []).append(place)
    for record, (spans, _) in zip(records, indexes, strict=True):
        agreeing = places.get(_ChunkInfo.of(spans).key, [])
        found.append(None)
        if agreeing:
            place = agreeing.pop(agreeing.index(record.offset) if record.offset in agreeing else 0)
            found[-1] = infos.pop(place)
    return [info or infos.pop(record.offset, None) for record, info in zip(records, found, strict=True)]


def _chunk_info(record: Record, data: memoryview) -> _ChunkInfo:
    try:
        counts = {number: count for number, count in _TWO_U32.iter_unpack(data[record.start : record.stop]) if count}
    except struct.error as error:
        raise TornError from error
    return _ChunkInfo(record.time_ns(b"start_time"), record.time_ns(b"end_time"), counts)
