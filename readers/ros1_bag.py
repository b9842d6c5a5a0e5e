"""ROS 1 bags of format 2.0, http://wiki.ros.org/Bags/Format/2.0: a row of records, read where they lie.

Chunks are found by the chunk infos at the end of the file, or by walking over the records where those are missing or
wrong; behind a stretch that holds no records the walk goes on at the next chunk. What follows each chunk, its index,
says what the chunk holds without unpacking it, and where its messages begin if the records inside break off. The
lengths that the index records state are not believed, since real files have wrong ones: their counts are.
"""

from __future__ import annotations

import mmap
import struct
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import pairwise, permutations
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple
from weakref import WeakSet

import numpy as np
from numpy.typing import NDArray

from readers.ahead import Ahead
from readers.message_log import Buffer, Channel, DamagedBlockError, Message, MessageLog, Source, inflate, text
from readers.salvage import Cause, Loss, Tally
from readers.streams import RecordingError

MAGIC = b"#ROSBAG V2.0\n"
_MESSAGE, _BAG, _INDEX, _CHUNK, _CHUNK_INFO, _CONNECTION = 2, 3, 4, 5, 6, 7
_BETWEEN_CHUNKS = (_INDEX, _CONNECTION, _CHUNK_INFO)
_U32 = struct.Struct("<I")
_TWO_U32 = struct.Struct("<II")
_U64 = struct.Struct("<Q")
_CHUNK_MARK = b"\x04\0\0\0op=\x05"
_LONGEST_CHUNK_HEADER = 80
_LONGEST_HEADER = 1 << 20
_COMPRESSIONS = (b"none", b"bz2", b"lz4")
_END_OF_TIME = 1 << 63
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


def fields_of(raw: Buffer) -> Fields:
    """The named fields of a header.

    Raises:
        TornError: they do not fill it.
    """
    raw, at, found = bytes(raw), 0, {}
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


_FIELDS = {
    b"op": ("8s", b"\x04\0\0\0op=\x02"),
    b"conn": ("9sI", b"\x09\0\0\0conn="),
    b"time": ("9sQ", b"\x0d\0\0\0time="),
}
_HEADER_BYTES = 38


class _Layout:
    """A message record up to its data, with the header's fields in one order, for one look at all of it."""

    def __init__(self, order: tuple[bytes, ...]) -> None:
        self.form = struct.Struct("<I" + "".join(_FIELDS[name][0] for name in order) + "I")
        marks, place = {}, 1
        for name in order:
            marks[name] = place
            place += 1 if name == b"op" else 2
        self.marks = itemgetter(0, *marks.values())
        self.fixed = (_HEADER_BYTES, *(_FIELDS[name][1] for name in order))
        self.connection, self.time = marks[b"conn"] + 1, marks[b"time"] + 1


_LAYOUTS = [_Layout(order) for order in permutations(_FIELDS)]


def _layout_at(data: memoryview, at: int) -> _Layout | None:
    """The order of the fields in the message record at `at`, None if it is no plain message record."""
    if at + _HEADER_BYTES + 8 > len(data):
        return None
    return next((one for one in _LAYOUTS if one.marks(one.form.unpack_from(data, at)) == one.fixed), None)


class Walk:
    """The records of a chunk one after the other; `torn` tells afterwards where they broke off, -1 if nowhere."""

    def __init__(self, data: memoryview, start: int = 0) -> None:
        self.data, self.start, self.torn = data, start, -1

    def __iter__(self) -> Iterator[tuple[int, int, memoryview] | Record]:
        """Of a message its connection, time in ns and data; any other record as it is."""
        data, at, end = self.data, self.start, len(self.data)
        layout = None
        while at < end:
            head: tuple[Any, ...] = ()
            if layout is not None and at + _HEADER_BYTES + 8 <= end:
                head = layout.form.unpack_from(data, at)
            if layout is None or not head or layout.marks(head) != layout.fixed:
                layout = _layout_at(data, at)
                if layout is None:
                    try:
                        record = record_at(data, at)
                        if record.stop > end or record.operation not in (_MESSAGE, _CONNECTION):
                            raise TornError
                        if record.operation == _MESSAGE:
                            yield record.u32(b"conn"), record.time_ns(b"time"), data[record.start : record.stop]
                        else:
                            yield record
                    except TornError:
                        self.torn = at
                        return
                    at = record.stop
                    continue
                head = layout.form.unpack_from(data, at)
            start = at + _HEADER_BYTES + 8
            at = start + head[-1]
            if at > end:
                self.torn = start - _HEADER_BYTES - 8
                return
            time = head[layout.time]
            yield head[layout.connection], (time & 0xFFFFFFFF) * 1_000_000_000 + (time >> 32), data[start:at]


# ----------------------------------------------------------------------------------------- chunks


class Span(NamedTuple):
    """How many messages of one connection a chunk holds, and their first and last log time."""

    messages: int
    first_ns: int
    last_ns: int


@dataclass(eq=False, slots=True)
class Chunk:
    """A chunk: its record, and what it holds by connection."""

    record: Record
    spans: dict[int, Span]

    @property
    def first_ns(self) -> int:
        """Log time of its earliest message."""
        return min(span.first_ns for span in self.spans.values())


class ChunkIndex(NamedTuple):
    """The index behind a chunk: by connection the log times (ns) and places of its messages; and where it ends."""

    times_ns: dict[int, NDArray[np.int64]]
    places: list[int]
    stop: int

    @property
    def spans(self) -> dict[int, Span]:
        """What the chunk holds by connection."""
        return {
            number: Span(len(times), int(times.min()), int(times.max()))
            for number, times in self.times_ns.items()
            if len(times)
        }


def index_behind(data: memoryview, chunk: Record) -> ChunkIndex:
    """The index records behind a chunk, as far as they are whole."""
    times: dict[int, NDArray[np.int64]] = {}
    places: list[int] = []
    at = chunk.stop
    try:
        while at < len(data):
            record = record_at(data, at)
            if record.operation != _INDEX or record.stop > len(data):
                break
            entries = np.frombuffer(data[record.start : record.stop], _ENTRY)
            found = entries["seconds"].astype(np.int64) * 1_000_000_000 + entries["rest"]
            number = record.u32(b"conn")
            times[number] = np.concatenate([times[number], found]) if number in times else found
            places += entries["place"].tolist()
            at = record.stop
    except (TornError, ValueError):
        pass
    return ChunkIndex(times, places, at)


class _ChunkInfo(NamedTuple):
    """What the end of the file says of a chunk."""

    first_ns: int
    last_ns: int
    counts: dict[int, int]

    def fits(self, spans: Mapping[int, Span]) -> bool:
        """Whether the chunk's own index says the same."""
        times = [time for span in spans.values() for time in (span.first_ns, span.last_ns)]
        return {n: c for n, c in self.counts.items() if c} == {n: span.messages for n, span in spans.items()} and (
            not times or (min(times), max(times)) == (self.first_ns, self.last_ns)
        )


class Ros1Log(MessageLog):
    """One ROS 1 bag.

    Raises:
        RecordingError: no bag of format 2.0, or an encrypted one.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path, "ROS 1 bag 2.0")
        with path.open("rb") as file:
            self._map = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        self._data = memoryview(self._map)
        self._size = len(self._data)
        self._by_id: dict[int, Channel] = {}
        self._chunks: list[Chunk] = []
        self._latest: tuple[Chunk | None, list[Message]] = (None, [])
        self._aheads: WeakSet[Ahead[Chunk, Buffer]] = WeakSet()
        if self._data[: len(MAGIC)] != MAGIC:
            raise RecordingError(path, "it is no ROS 1 bag of format 2.0", "check that the file is complete")
        header = self._bag_header()
        records, infos = self._walk(len(MAGIC) if header is None else header.stop)
        if header is not None:
            self._judge_header(header, len(records), len(infos))
        self._list(records, infos)

    def _harm(self, cause: Cause, sentence: str, start: int, stop: int, **known: Any) -> None:
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
                elif record.operation not in _BETWEEN_CHUNKS or record.stop > self._size:
                    raise TornError
                elif record.operation == _CONNECTION:
                    self._connect(record, self._data)
                elif record.operation == _CHUNK_INFO:
                    infos[record.u64(b"chunk_pos")] = _chunk_info(record, self._data)
                at = record.stop
            except TornError:
                following = self._next_chunk(at + 1)
                ends = (
                    "the file ends inside a record" if following == self._size else "no record begins where one should"
                )
                self._harm(Cause.CUT, ends, at, following)
                at = following
        return chunks, infos

    def _chunk(self, record: Record) -> Record:
        """A chunk's record; where it reaches beyond the end of the file it stops at the next chunk or the end."""
        if record.fields.get(b"compression") not in _COMPRESSIONS:
            named = text(record.fields.get(b"compression", b""))
            self._harm(Cause.CODEC, f"a chunk has the unknown compression {named!r}", record.offset, record.stop)
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

    def _connect(self, record: Record, data: memoryview, base: int = 0) -> None:
        """Take a connection record as a channel.

        Raises:
            TornError: its fields cannot be read.
        """
        number, described = record.u32(b"conn"), fields_of(data[record.start : record.stop])
        channel = Channel(
            topic=text(record.fields.get(b"topic", b"")),
            type=text(described.get(b"type", b"")),
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
        elif stated != chunks:
            words = f"the bag header states {stated} chunks and {chunks} are there"
            self._harm(Cause.COUNT, words, header.offset, header.offset)

    def _list(self, records: list[Record], infos: dict[int, _ChunkInfo]) -> None:
        """Find out what each chunk holds: from its index where the chunk info agrees, else from itself."""
        for record in records:
            info, index = infos.pop(record.offset, None), index_behind(self._data, record)
            chunk = Chunk(record, index.spans)
            believed = info.fits(index.spans) if info else bool(index.spans) and self._is_record(index.stop)
            if record.torn or not believed or not chunk.spans.keys() <= self._by_id.keys():
                stated = (
                    {n: Span(c, -1, -1) for n, c in info.counts.items()} if info else index.spans if believed else {}
                )
                chunk.spans = self._look_into(chunk, stated)
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

    def _is_record(self, offset: int) -> bool:
        try:
            return record_at(self._data, offset).operation in (_CHUNK, _CONNECTION, _CHUNK_INFO)
        except TornError:
            return False

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
        return {number: Span(len(found), min(found), max(found)) for number, found in times.items()}

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
        """The records of a chunk.

        Raises:
            DamagedBlockError: they cannot be unpacked.
        """
        record = chunk.record
        packed = self._data[record.start : record.stop]
        compression = text(record.fields[b"compression"])
        return inflate(compression, packed, record.u32(b"size"), torn=record.torn)

    def _load(self, chunk: Chunk, ahead: Ahead[Chunk, Buffer] | None = None) -> list[Message]:
        """The messages of a chunk in the order of log time; what is wrong with it is noted."""
        if self._latest[0] is not chunk:
            try:
                data = self._unpacked(chunk) if ahead is None else ahead.take(chunk)
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
        while at >= 0:
            walk = Walk(data, at)
            for item in walk:
                if isinstance(item, Record):
                    self._connect(item, data, chunk.record.offset)
                    continue
                number, log_ns, payload = item
                counts[number] += 1
                if (channel := self._by_id.get(number)) is not None:
                    found.append(Message(log_ns, channel, payload))
            if walk.torn < 0:
                break
            broken = "the records of a chunk break off"
            places = index_behind(self._data, chunk.record).places
            at = min((place for place in places if place > walk.torn), default=-1)
        self._judge_chunk(chunk, counts, Cause.CUT, "" if chunk.record.torn else broken)
        if any(one.log_ns > next_one.log_ns for one, next_one in pairwise(found)):
            found.sort(key=lambda message: message.log_ns)
        return found

    def _judge_chunk(self, chunk: Chunk, counts: Counter[int], cause: Cause, broken: str) -> None:
        """Compare what a chunk gave with what it was to hold."""
        stated = {number: span.messages for number, span in chunk.spans.items()}
        missing = {number: count - counts[number] for number, count in stated.items() if count > counts[number]}
        strangers = {number: count for number, count in counts.items() if number not in self._by_id}
        surplus = sum(count - stated.get(number, 0) for number, count in counts.items() if stated) > 0
        times = [time for span in chunk.spans.values() for time in (span.first_ns, span.last_ns) if time >= 0]
        known: dict[str, Any] = {"first_ns": min(times), "last_ns": max(times)} if times else {}
        start, stop = chunk.record.offset, chunk.record.stop
        if strangers:
            words = f"{sum(strangers.values())} messages are of connections that the bag does not describe"
            self._harm(Cause.SCHEMA, words, start, start, topics=self._tallies(strangers, withheld=True), **known)
        if broken or missing:
            words = broken or f"a chunk holds {sum(missing.values())} messages fewer than its index states"
            topics = self._tallies(missing, withheld=cause is Cause.CODEC)
            self._harm(cause if broken else Cause.COUNT, words, start, stop, topics=topics, **known)
        elif surplus and not strangers:
            self._harm(Cause.COUNT, "a chunk holds other messages than its index states", start, start, **known)

    # -------------------------------------------------------------------------------- reading

    def sources(
        self, channels: Collection[Channel], start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterable[Source]:
        """One source a chunk that holds one of the channels and overlaps the range."""
        wanted = frozenset(channels)
        numbers = [number for number, channel in self._by_id.items() if channel in wanted]
        chosen = []
        for chunk in self._chunks:
            spans = [chunk.spans[number] for number in numbers if number in chunk.spans]
            if any(
                (start_ns is None or span.last_ns >= start_ns) and (stop_ns is None or span.first_ns < stop_ns)
                for span in spans
            ):
                chosen.append(chunk)
        ahead = Ahead(self._unpacked, [(chunk, chunk.record.u32(b"size")) for chunk in chosen])
        self._aheads.add(ahead)
        low, high = start_ns or 0, stop_ns if stop_ns is not None else _END_OF_TIME
        for chunk in chosen:
            select = partial(self._select, chunk, wanted, low, high, ahead)
            yield Source(chunk.first_ns, select, max(span.last_ns for span in chunk.spans.values()))

    def _select(
        self, chunk: Chunk, wanted: Collection[Channel], low: int, high: int, ahead: Ahead[Chunk, Buffer]
    ) -> Iterator[Message]:
        return (
            message
            for message in self._load(chunk, ahead)
            if message.channel in wanted and low <= message.log_ns < high
        )

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
        for ahead in list(self._aheads):
            ahead.stop()
        self._latest = (None, [])
        self._chunks = []


def _chunk_info(record: Record, data: memoryview) -> _ChunkInfo:
    try:
        counts = dict(_TWO_U32.iter_unpack(data[record.start : record.stop]))
    except struct.error as error:
        raise TornError from error
    return _ChunkInfo(record.time_ns(b"start_time"), record.time_ns(b"end_time"), counts)
