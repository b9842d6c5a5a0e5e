"""Records of the MCAP format, https://mcap.dev/spec: their layouts, and chunks unpacked and checked.

Everything here works on views of the file and trusts none of the lengths in it.
"""

from __future__ import annotations

import enum
import struct
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import KW_ONLY, dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from readers.message_log import Channel, DamagedBlockError, Message, crc32, inflate, name, text
from readers.salvage import Cause

MAGIC = b"\x89MCAP0\r\n"
HEAD = struct.Struct("<BQ")
FOOTER = struct.Struct("<BQQQI8s")
INDEX_HEAD = struct.Struct("<BQHI")
_MESSAGE = struct.Struct("<BQHIQQ")
_MESSAGE_BYTES = _MESSAGE.size - HEAD.size
_CHUNK = struct.Struct("<QQQI")
_CHUNK_INDEX = struct.Struct("<QQQQI")
_LENGTH_AND_NAME = struct.Struct("<QI")
_SIZES = struct.Struct("<QQ")
_COUNT = struct.Struct("<HQ")
_OFFSET = struct.Struct("<HQ")
_INDEX = struct.Struct("<HI")
_STATISTICS = struct.Struct("<QHIIIIQQ")
_TWO_U16 = struct.Struct("<HH")
_U16, _U32, _U64 = struct.Struct("<H"), struct.Struct("<I"), struct.Struct("<Q")
INDEX_ENTRY = np.dtype([("log_ns", "<u8"), ("offset", "<u8")])
ENTRY_BYTES = INDEX_ENTRY.itemsize


class Opcode(enum.IntEnum):
    """Kinds of records."""

    HEADER = 0x01
    FOOTER = 0x02
    SCHEMA = 0x03
    CHANNEL = 0x04
    MESSAGE = 0x05
    CHUNK = 0x06
    MESSAGE_INDEX = 0x07
    CHUNK_INDEX = 0x08
    ATTACHMENT = 0x09
    ATTACHMENT_INDEX = 0x0A
    STATISTICS = 0x0B
    METADATA = 0x0C
    METADATA_INDEX = 0x0D
    SUMMARY_OFFSET = 0x0E
    DATA_END = 0x0F


PRIVATE = 0x80
SHORTEST = {
    Opcode.HEADER: 8,
    Opcode.FOOTER: 20,
    Opcode.SCHEMA: 14,
    Opcode.CHANNEL: 16,
    Opcode.MESSAGE: _MESSAGE_BYTES,
    Opcode.CHUNK: 40,
    Opcode.MESSAGE_INDEX: 6,
    Opcode.CHUNK_INDEX: 64,
    Opcode.ATTACHMENT: 36,
    Opcode.ATTACHMENT_INDEX: 48,
    Opcode.STATISTICS: 46,
    Opcode.METADATA: 8,
    Opcode.METADATA_INDEX: 20,
    Opcode.SUMMARY_OFFSET: 17,
    Opcode.DATA_END: 4,
}
"""The fewest bytes that the body of each kind of record has."""


class RecordError(ValueError):
    """A record whose body is not what its kind should have."""


def known(opcode: int, length: int) -> bool:
    """Whether a record of that kind can have that length; False for kinds that the format does not define."""
    return opcode in SHORTEST and length >= SHORTEST[Opcode(opcode)]


# ---------------------------------------------------------------------------------- bodies


def _sized(body: memoryview, at: int) -> tuple[memoryview, int]:
    """A field that begins with its length, and where the next one begins."""
    try:
        (length,) = _U32.unpack_from(body, at)
    except struct.error as error:
        raise RecordError from error
    end = at + 4 + length
    if end > len(body):
        raise RecordError
    return body[at + 4 : end], end


def _unpack(layout: struct.Struct, body: memoryview, at: int = 0) -> tuple[int, ...]:
    try:
        return layout.unpack_from(body, at)
    except struct.error as error:
        raise RecordError from error


def read_profile(body: memoryview) -> str:
    """The profile that a header record names."""
    return name(_sized(body, 0)[0])


class Schema(NamedTuple):
    """A message definition of the file."""

    name: str
    encoding: str
    data: bytes


def read_schema(body: memoryview) -> tuple[int, Schema]:
    """Number and content of a schema record."""
    (number,) = _unpack(_U16, body)
    title, at = _sized(body, 2)
    encoding, at = _sized(body, at)
    data, _ = _sized(body, at)
    return number, Schema(name(title), name(encoding), bytes(data))


class ChannelRecord(NamedTuple):
    """A channel of the file."""

    schema: int
    topic: str
    encoding: str


def read_channel(body: memoryview) -> tuple[int, ChannelRecord]:
    """Number and content of a channel record; its metadata are not read."""
    number, schema = _unpack(_TWO_U16, body)
    topic, at = _sized(body, 4)
    encoding, at = _sized(body, at)
    _sized(body, at)
    return number, ChannelRecord(schema, name(topic), name(encoding))


class ChunkIndex(NamedTuple):
    """Where a chunk lies and what is in it; `indexes` are the offsets of its message indexes by channel number.

    These take `index_bytes` together.
    """

    first_ns: int
    last_ns: int
    offset: int
    length: int
    indexes: dict[int, int]
    index_bytes: int
    compression: str
    packed_bytes: int
    unpacked_bytes: int


def read_chunk_index(body: memoryview) -> ChunkIndex:
    """A chunk index record."""
    try:
        first_ns, last_ns, offset, length, size = _CHUNK_INDEX.unpack_from(body)
        end = _CHUNK_INDEX.size + size
        pairs = dict(_pairs(_OFFSET, body[_CHUNK_INDEX.size : end]))
        index_bytes, size = _LENGTH_AND_NAME.unpack_from(body, end)
        compression = body[end + _LENGTH_AND_NAME.size :][:size]
        packed, unpacked = _SIZES.unpack_from(body, end + _LENGTH_AND_NAME.size + size)
    except struct.error as error:
        raise RecordError from error
    return ChunkIndex(first_ns, last_ns, offset, length, pairs, index_bytes, text(compression), packed, unpacked)


def _pairs(layout: struct.Struct, packed: memoryview) -> Iterator[tuple[int, int]]:
    if len(packed) % layout.size:
        raise RecordError
    return layout.iter_unpack(packed)


class Statistics(NamedTuple):
    """What the file says of its own content."""

    messages: int
    chunks: int
    counts: dict[int, int]


def read_statistics(body: memoryview) -> Statistics:
    """A statistics record."""
    messages, _, _, _, _, chunks, _, _ = _unpack(_STATISTICS, body)
    pairs, _ = _sized(body, _STATISTICS.size)
    return Statistics(messages, chunks, dict(_pairs(_COUNT, pairs)))


def read_message_index(body: memoryview) -> tuple[int, NDArray[np.void]]:
    """The channel's number, and log time and offset of each of its messages in a chunk."""
    number, _ = _unpack(_INDEX, body)
    entries, end = _sized(body, 2)
    if len(entries) % ENTRY_BYTES or len(body) - end >= ENTRY_BYTES:
        raise RecordError
    return number, np.frombuffer(entries, INDEX_ENTRY)


# ------------------------------------------------------------------- attachments, metadata


def _attachment_parts(body: memoryview) -> tuple[memoryview, memoryview, int, int]:
    """Name, media type, and where the data of an attachment begin and end; its checksum follows."""
    title, at = _sized(body, _SIZES.size)
    media_type, at = _sized(body, at)
    (size,) = _unpack(_U64, body, at)
    if at + _U64.size + size + _U32.size > len(body):
        raise RecordError
    return title, media_type, at + _U64.size, at + _U64.size + size


def attachment_name(body: memoryview) -> str:
    """The name of an attachment, which need not be whole behind it."""
    return name(_sized(body, _SIZES.size)[0])


def metadata_name(body: memoryview) -> str:
    """The name of a metadata record, likewise."""
    return name(_sized(body, 0)[0])


def read_attachment(body: memoryview) -> tuple[str, str, int, int, memoryview]:
    """Name, media type, log time, time of creation (ns) and data of an attachment."""
    log_ns, create_ns = _unpack(_SIZES, body)
    title, media_type, start, stop = _attachment_parts(body)
    return name(title), name(media_type), log_ns, create_ns, body[start:stop]


def attachment_crc(body: memoryview) -> tuple[int, int]:
    """The checksum that an attachment states, 0 for none, and the one that it has."""
    stop = _attachment_parts(body)[3]
    return _unpack(_U32, body, stop)[0], crc32(body[:stop])


def read_metadata(body: memoryview) -> tuple[str, dict[str, str]]:
    """Name and texts of a metadata record."""
    title, at = _sized(body, 0)
    entries, _ = _sized(body, at)
    values, at = {}, 0
    while at < len(entries):
        key, at = _sized(entries, at)
        value, at = _sized(entries, at)
        values[text(key)] = text(value)
    return name(title), values


def read_attachment_index(body: memoryview) -> tuple[int, str]:
    """Place and name of an attachment, by its index."""
    (offset,) = _unpack(_U64, body)
    return offset, name(_sized(body, 5 * _U64.size)[0])


def read_metadata_index(body: memoryview) -> tuple[int, str]:
    """Place and name of a metadata record, by its index."""
    (offset,) = _unpack(_U64, body)
    return offset, name(_sized(body, _SIZES.size)[0])


def read_extra_counts(body: memoryview) -> tuple[int, int]:
    """How many attachments and metadata records the statistics count."""
    _, _, _, attachments, metadata, _, _, _ = _unpack(_STATISTICS, body)
    return attachments, metadata


# ---------------------------------------------------------------------------------- chunks


class Stated(NamedTuple):
    """What a chunk index says of its chunk."""

    compression: str
    packed_bytes: int
    unpacked_bytes: int


class ChunkHead(NamedTuple):
    """What a chunk says of itself; its packed records begin at `start` and should end at `stop` of its body."""

    unpacked_bytes: int
    crc: int
    compression: str
    start: int
    stop: int


def read_chunk_head(body: memoryview) -> ChunkHead:
    """The fields of a chunk record before its packed records."""
    _, _, size, crc = _unpack(_CHUNK, body)
    compression, at = _sized(body, _CHUNK.size)
    (packed,) = _unpack(_U64, body, at)
    return ChunkHead(size, crc, text(compression), at + 8, at + 8 + packed)


@dataclass(frozen=True, slots=True)
class Unpacked:
    """The records of a chunk; `faults` says what is wrong, `withheld` that nothing of it can be given out.

    `crc` is its checksum, 0 if it has none.
    """

    records: memoryview
    faults: tuple[tuple[Cause, str], ...] = ()
    withheld: bool = False
    crc: int = 0


def unpack_chunk(body: memoryview, stated: Stated | None = None, *, torn: bool = False, check: bool = True) -> Unpacked:
    """Unpack the body of a chunk record and compare it with its checksum.

    Where the chunk's own header is damaged, what the index says of it is tried. Of a torn chunk, one that the
    end of the file cuts, as much as there is is given without a checksum.
    """
    try:
        head = read_chunk_head(body)
    except RecordError:
        return Unpacked(memoryview(b""), ((Cause.CUT, "a chunk ends within its header"),), withheld=True)
    found = _try(body, head, torn, check)
    if found.withheld and stated is not None:
        length = head.start + stated.packed_bytes
        repaired = head._replace(unpacked_bytes=stated.unpacked_bytes, compression=stated.compression, stop=length)
        if repaired != head and head.crc and not (second := _try(body, repaired, torn=False, check=True)).withheld:
            return Unpacked(
                second.records, ((Cause.CODEC, "a chunk's header is damaged; the index served"),), crc=head.crc
            )
    return found


def _try(body: memoryview, head: ChunkHead, torn: bool, check: bool) -> Unpacked:
    packed = body[head.start : head.stop]
    if len(packed) < head.stop - head.start and not torn:
        fault = f"a chunk states {head.stop - head.start} bytes and {len(packed)} are there"
        return Unpacked(memoryview(b""), ((Cause.CUT, fault),), withheld=True)
    try:
        data = memoryview(inflate(head.compression, packed, head.unpacked_bytes, torn=torn, exact=False))
    except DamagedBlockError as error:
        return Unpacked(memoryview(b""), ((Cause.CODEC, str(error)),), withheld=True)
    if torn:
        return Unpacked(data)
    if check and head.crc and crc32(data) != head.crc:
        fault = "a chunk does not match its checksum and is left out"
        return Unpacked(memoryview(b""), ((Cause.CHECKSUM, fault),), withheld=True)
    if len(data) != head.unpacked_bytes:
        fault = f"a chunk claims {head.unpacked_bytes} bytes and holds {len(data)}"
        faults = ((Cause.LIMIT if head.unpacked_bytes > len(data) else Cause.CODEC, fault),)
        return Unpacked(data, faults, withheld=not head.crc and len(data) < head.unpacked_bytes < 1 << 32, crc=head.crc)
    return Unpacked(data, crc=head.crc)


# ------------------------------------------------------------------------------------ walk


@dataclass(slots=True)
class Segment:
    """Schemas and channels of one file; files that were joined have one each."""

    start: int = 0
    profile: str = ""
    schemas: dict[int, Schema] = field(default_factory=dict)
    records: dict[int, ChannelRecord] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)


@dataclass(slots=True, eq=False)
class McapBlock:
    """A stretch of the file that is read at once: a chunk, or a run of messages outside of chunks.

    `counts` says how many messages of each channel it holds. `torn` marks a block that the end of the file cuts: what
    it holds up to there is read. `stated` is what the chunk index says of it, `indexes` the offsets of its message
    indexes by channel. It is never changed, yet not frozen: large logs have many, and frozen ones take three times as
    long to make.
    """

    offset: int
    size: int
    first_ns: int
    last_ns: int
    counts: Mapping[Channel, int]
    torn: bool = False
    _: KW_ONLY
    segment: Segment
    chunk: bool = True
    stated: Stated | None = None
    indexes: Mapping[Channel, int] = field(default_factory=dict)

    def of(self, first_ns: int, last_ns: int, counts: Mapping[Channel, int]) -> McapBlock:
        """The same block, whose content is known."""
        return replace(self, first_ns=first_ns, last_ns=last_ns, counts=counts)

    @property
    def compression(self) -> str:
        """How it is compressed, "" where it is not or where that is not stated."""
        return self.stated.compression if self.stated is not None else ""

    @property
    def memory_bytes(self) -> int:
        """How much memory it takes to unpack it; none where it lies in the file as it is."""
        return self.stated.unpacked_bytes if self.stated is not None and self.compression else 0


@dataclass(slots=True)
class Walked:
    """What a walk over records met: messages in their order, and what is wrong."""

    messages: list[Message]
    ordered: bool = True
    strangers: Counter[int] = field(default_factory=Counter)
    others: list[tuple[int, memoryview]] = field(default_factory=list)
    fault: str = ""


def walk(data: memoryview, segment: Segment, wanted: Mapping[int, Channel]) -> Walked:
    """The messages of the `wanted` channels in `data`, and all records that are no messages.

    One unpacking and one view for each message, nothing is copied.
    """
    messages: list[Message] = []
    found = Walked(messages)
    append, unpack, take, known_ids = messages.append, _MESSAGE.unpack_from, wanted.get, segment.channels
    new, head = tuple.__new__, _MESSAGE.size
    at, end, latest, ordered = 0, len(data), 0, True
    limit = end - head
    while at <= limit:
        opcode, length, number, sequence, log_ns, publish_ns = unpack(data, at)
        body = at + head
        at += 9 + length
        if opcode == 5 and body <= at <= end:
            channel = take(number)
            if channel is not None:
                append(new(Message, (log_ns, channel, data[body:at], publish_ns, sequence)))
                if log_ns < latest:
                    ordered = False
                latest = log_ns
            elif number not in known_ids:
                found.strangers[number] += 1
        elif opcode == 5 or opcode == 0 or at > end:
            found.fault = "the records of a chunk break off"
            break
        else:
            found.others.append((opcode, data[body - _MESSAGE_BYTES : at]))
    else:
        _walk_tail(data, at, found)
    found.ordered = ordered
    return found


def _walk_tail(data: memoryview, at: int, found: Walked) -> None:
    """The last records, which are shorter than a message."""
    while at < len(data):
        opcode, length = HEAD.unpack_from(data, at) if at + HEAD.size <= len(data) else (0, 0)
        end = at + HEAD.size + length
        if opcode in (0, Opcode.MESSAGE) or end > len(data):
            found.fault = "the records of a chunk break off"
            return
        found.others.append((opcode, data[at + HEAD.size : end]))
        at = end
