"""Containers of messages: what bags and MCAP files have in common, whatever their bytes look like.

A `MessageLog` lists channels and yields their messages as they were stored, in the order of the log
time. It knows nothing of what a message means; `readers.decoding` and `readers.messages` do.
"""

from __future__ import annotations

import abc
import bz2
import heapq
import re
import threading
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple, Protocol

import lz4.frame  # type: ignore[import-untyped, unused-ignore]
import zstandard
from isal.isal_zlib import crc32 as crc32

from readers.extras import Extras
from readers.index_cache import Entry, State, StateError
from readers.salvage import Loss
from readers.streams import Damage

Buffer = bytes | memoryview
_CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069]")
LARGEST_BLOCK_BYTES = 2**30
LARGEST_UNPACKED_BYTES = 2**28
LARGEST_RATIO = 1024
HARMLESS_BYTES = 2**24


class DamagedBlockError(Exception):
    """Stored bytes that cannot be unpacked; the text is a clause that says why."""


class MessageError(Exception):
    """A message, or the definition of one, that cannot be used; the text is a clause that says why."""


@dataclass(eq=False, slots=True)
class Channel:
    """One source of messages: a topic, the type of its messages and how they are serialised.

    `encoding` is ``ros1``, ``cdr``, ``json``, ``protobuf`` or whatever else the log names;
    `schema_encoding` is ``ros1msg``, ``ros2msg``, ``ros2idl``, ``jsonschema``, ``protobuf`` or empty.
    `first_ns` and `last_ns` are log times, -1 without a message.
    """

    topic: str
    type: str
    encoding: str
    schema_encoding: str = ""
    schema: bytes = field(default=b"", repr=False)
    count: int = 0
    first_ns: int = -1
    last_ns: int = -1

    def note(self, log_ns: int) -> None:
        """Count one message that was logged at `log_ns`."""
        self.count += 1
        self.first_ns = log_ns if self.first_ns < 0 else min(self.first_ns, log_ns)
        self.last_ns = max(self.last_ns, log_ns)


class Message(NamedTuple):
    """One message as it was stored, with its log time in nanoseconds.

    `publish_ns` and `sequence` are -1 where the container does not keep them.
    """

    log_ns: int
    channel: Channel
    data: Buffer
    publish_ns: int = -1
    sequence: int = -1


class Opener(Protocol):
    """Starts to read; gives messages in the order of the log time."""

    def __call__(self) -> Iterator[Message]: ...  # noqa: D102


class Source(NamedTuple):
    """Messages in the order of the log time, none before `first_ns`, not read before `open` is called.

    None comes after `last_ns`, where that is known.
    """

    first_ns: int
    open: Opener
    last_ns: int | None = None


def in_log_order(sources: Iterable[Source]) -> Iterator[Message]:
    """Merge sources, which come in the order of their first times, by log time.

    A source is asked for and opened when the merge has come to its first time, so memory is bounded by the sources
    that overlap in time, and the first messages of a log of many do not cost a look at all. Equal times keep the order
    of the sources. A source that overlaps no other is passed on as it is.
    """
    heap: list[tuple[int, int, Message, Iterator[Message]]] = []
    for number, (source, following) in enumerate(_with_following(sources)):
        while heap and heap[0][0] < source.first_ns:
            yield _advance(heap)
        if not heap and (following is None or (source.last_ns is not None and source.last_ns < following.first_ns)):
            yield from source.open()
            continue
        messages = source.open()
        if (first := next(messages, None)) is not None:
            heapq.heappush(heap, (first.log_ns, number, first, messages))
    while heap:
        yield _advance(heap)


def _with_following(sources: Iterable[Source]) -> Iterator[tuple[Source, Source | None]]:
    """Each source with the one after it, None after the last."""
    remaining = iter(sources)
    source = next(remaining, None)
    while source is not None:
        following = next(remaining, None)
        yield source, following
        source = following


def _advance(heap: list[tuple[int, int, Message, Iterator[Message]]]) -> Message:
    """Take the earliest message from the heap and put the next one of its source in its place."""
    _, number, message, rest = heap[0]
    following = next(rest, None)
    if following is None:
        heapq.heappop(heap)
    else:
        heapq.heapreplace(heap, (following.log_ns, number, following, rest))
    return message


class MessageLog(abc.ABC):
    """One file of messages, open for reading.

    Attributes:
        path: the file.
        format: what it was taken for.
        channels: all channels, with their counts and times.
        damage: what was found to be damaged so far.
        losses: the same in the form that can be counted, of the readers that know it.
        notes: choices that the reader made, one sentence each.
        cached: where the index of the file is kept; None if it is not to be.
    """

    def __init__(self, path: Path, form: str, cached: Entry | None = None) -> None:
        self.path = path
        self.format = form
        self.channels: list[Channel] = []
        self.damage: list[Damage] = []
        self.losses: list[Loss] = []
        self.notes: list[str] = []
        self.cached = cached

    def recall(self, put: Callable[[State], None]) -> bool:
        """Give what is kept of the file to `put`; whether there was something that it took."""
        if self.cached is None or (state := self.cached.load()) is None:
            return False
        try:
            put(state)
        except StateError as error:
            self.cached.reject(str(error))
            return False
        return True

    def keep(self, state: Callable[[], State | None], taken_s: float) -> None:
        """Keep what took `taken_s` seconds to find, if that was long; `state` gives it, None if it cannot be kept."""
        if self.cached is not None and self.cached.worth(taken_s) and (found := state()) is not None:
            self.cached.save(found)

    def lose(self, loss: Loss) -> None:
        """Note a loss, once."""
        if loss not in self.losses:
            self.losses.append(loss)
            self.damage.append(loss.damage)

    @abc.abstractmethod
    def sources(
        self, channels: Collection[Channel], start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterable[Source]:
        """Where the messages of `channels` with ``start_ns <= log time < stop_ns`` can be read.

        In the order of their first times; one is made when it is asked for.
        """

    def count_before(self, channels: Collection[Channel], stop_ns: int) -> int:
        """How many messages of `channels` were logged before `stop_ns`."""
        return sum(1 for source in self.sources(channels, None, stop_ns) for _ in source.open())

    def extras(self) -> Extras:
        """What the log holds beside its messages; what of it cannot be read becomes a loss."""
        return Extras()

    @abc.abstractmethod
    def close(self) -> None:
        """Release the file."""


class _Codecs(threading.local):
    """Decompressors, which are made once for each thread."""

    def __init__(self) -> None:
        self.zstd = zstandard.ZstdDecompressor()


_codecs = _Codecs()


def inflate(compression: str, data: Buffer, size: int, *, torn: bool = False, exact: bool = True) -> Buffer:
    """Unpack a chunk that claims `size` bytes; of a torn one as much as there is.

    However large the claim, no more is unpacked than `LARGEST_UNPACKED_BYTES`, nor, beyond `HARMLESS_BYTES`, than
    `LARGEST_RATIO` times the packed bytes.

    Raises:
        DamagedBlockError: unknown compression, damaged data, more than is unpacked, or, where it is to be `exact`,
            another size than the claim.
    """
    if compression in ("", "none"):
        return data
    if compression not in ("zstd", "lz4", "bz2"):
        raise DamagedBlockError(f"a chunk has the unknown compression {compression[:40]!r}")
    limit = min(LARGEST_UNPACKED_BYTES, max(HARMLESS_BYTES, LARGEST_RATIO * len(data)))
    if exact and size > limit:
        raise DamagedBlockError(f"a chunk claims {size} bytes, more than the {limit} that are unpacked at once")
    try:
        found = _unpack(compression, data, size, limit, torn)
    except (zstandard.ZstdError, RuntimeError, OSError, EOFError, ValueError, MemoryError) as error:
        raise DamagedBlockError(f"a {compression} chunk cannot be unpacked ({error})") from error
    if len(found) > limit:
        raise DamagedBlockError(f"a {compression} chunk holds more than the {limit} bytes that are unpacked at once")
    if exact and len(found) != size and not torn:
        raise DamagedBlockError(f"a {compression} chunk states {size} bytes and holds {len(found)}")
    return memoryview(found)


def _unpack(compression: str, data: Buffer, size: int, limit: int, torn: bool) -> bytes:
    """Unpack up to one byte more than `limit`; the size that is claimed serves to unpack in one go."""
    if compression == "bz2":
        return bz2.BZ2Decompressor().decompress(data, min(size, limit) + 1)
    if compression == "lz4":
        context = lz4.frame.create_decompression_context()  # one that met damage goes on to refuse sound data
        most = min(size, limit)  # one byte more is ten times as slow
        found, read, whole = lz4.frame.decompress_chunk(context, data, max_length=most)
        if not whole and len(found) <= limit and not torn:
            more, _, whole = lz4.frame.decompress_chunk(context, memoryview(data)[read:], max_length=1)
            found += more
            if not whole and len(found) <= most:
                raise EOFError("its end is missing")
        return bytes(found)
    stated = zstandard.frame_content_size(data) if not torn else -1
    if 0 <= stated == size <= limit:
        return _codecs.zstd.decompress(data)
    pieces, total = [], 0
    with _codecs.zstd.stream_reader(data, read_across_frames=True) as stream:
        while total <= limit and (piece := stream.read(min(1 << 20, limit + 1 - total))):
            pieces.append(piece)
            total += len(piece)
    return b"".join(pieces)


def text(raw: Buffer) -> str:
    """Decode UTF-8; bytes that are not UTF-8 come out as backslash escapes."""
    return str(raw, "utf-8", "backslashreplace")


def name(raw: Buffer) -> str:
    """Decode a name, `escaped`."""
    return escaped(text(raw))


def escaped(given: str) -> str:
    """A name whose control characters are backslash escapes, so that it can be shown anywhere."""
    return _CONTROL.sub(lambda found: found[0].encode("unicode_escape").decode(), given)
