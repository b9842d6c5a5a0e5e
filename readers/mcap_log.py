"""MCAP files of every profile: with or without index, chunked or not, whole or torn.

With a sound summary the file is opened by its index alone. Without one `readers.mcap_scan` walks over its records.
Chunks are unpacked one at a time, ahead of the reading, and always compared with their checksums.
"""

from __future__ import annotations

import mmap
import time
from collections import Counter, OrderedDict, deque
from collections.abc import Collection, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from itertools import islice, pairwise
from operator import attrgetter
from pathlib import Path
from types import MappingProxyType

import numpy as np

from readers.ahead import WORTH_A_THREAD_S
from readers.extras import Extras
from readers.index_cache import Entry, State
from readers.index_states import mcap_state, put_mcap
from readers.mcap_extras import ExtrasWalk
from readers.mcap_records import (
    ENTRY_BYTES,
    FOOTER,
    HEAD,
    INDEX_HEAD,
    MAGIC,
    ChannelRecord,
    ChunkIndex,
    McapBlock,
    Opcode,
    RecordError,
    Segment,
    Stated,
    Statistics,
    Unpacked,
    Walked,
    read_channel,
    read_chunk_index,
    read_message_index,
    read_profile,
    read_schema,
    read_statistics,
    unpack_chunk,
    walk,
)
from readers.mcap_scan import Scan
from readers.message_log import Channel, Message, MessageLog, Source, crc32
from readers.salvage import Cause, Loss, Tally, lost_by_topic, withheld_by_topic
from readers.streams import RecordingError

READ_AHEAD = 2
KEPT_BLOCKS = 4
KEPT_BYTES = 1 << 24
SHORT_READ = 8  # blocks; for so few no thread is started
WORTH_A_THREAD_BYTES = {"zstd": 1 << 16, "lz4": 1 << 23}  # lz4 unpacks about as fast as a thread is woken
_DEFAULT_ENCODING = {"ros1": "ros1", "ros2": "cdr"}


class McapLog(MessageLog):
    """One MCAP file.

    Raises:
        RecordingError: the file does not begin like an MCAP file.
    """

    def __init__(self, path: Path, cached: Entry | None = None) -> None:
        super().__init__(path, "MCAP", cached)
        if not path.stat().st_size:
            raise RecordingError(path, "the file is empty (0 bytes)", "record or copy it again")
        with path.open("rb") as file:
            self._map = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        self.view = memoryview(self._map)
        self.statistics: Statistics | None = None
        self._blocks: list[McapBlock] = []
        self._unpacked: OrderedDict[int, Future[Unpacked]] = OrderedDict()
        self._checked: set[int] = set()
        self._first: dict[tuple[int, bool], McapBlock] = {}  # by segment: the first chunk with, and without a checksum
        self.told: set[int] = set()
        self._thread: ThreadPoolExecutor | None = None
        self._given_s = 0.0
        self._extras: Extras | None = None
        try:
            self._open()
        except BaseException:
            self.close()
            raise

    def _open(self) -> None:
        if self.view[: len(MAGIC)] != MAGIC:
            raise RecordingError(self.path, "it does not begin like an MCAP file", "check that the file is complete")
        segment = Segment(profile=self.profile(0))
        fault = self._read_summary(segment)
        if fault is None:
            self._find_edges()
        elif not self.recall(self._put):
            begun = time.perf_counter()
            self._blocks.clear()
            Scan(self, segment, fault).run()
            self.keep(lambda: mcap_state(self, self._blocks), time.perf_counter() - begun)
        self._blocks.sort(key=attrgetter("first_ns"))
        if segment.profile:
            self.format = f"MCAP, profile {segment.profile}"

    def _put(self, state: State) -> None:
        self._blocks = put_mcap(self, state)

    def profile(self, start: int) -> str:
        """The profile of the file that begins at `start`, "" if its header is damaged."""
        opcode, body = self.record(start + len(MAGIC))
        try:
            return read_profile(body) if opcode == Opcode.HEADER else ""
        except RecordError:
            return ""

    def find(self, what: bytes, start: int) -> int:
        """Where `what` occurs next in the file, -1 if nowhere."""
        return self._map.find(what, start)

    def record(self, at: int) -> tuple[int, memoryview]:
        """Opcode and body of the record at `at`, as far as the file goes; opcode 0 if there is none."""
        if at + HEAD.size > len(self.view):
            return 0, self.view[:0]
        opcode, length = HEAD.unpack_from(self.view, at)
        return opcode, self.view[at + HEAD.size : at + HEAD.size + length]

    # ---------------------------------------------------------------------------- summary

    def _read_summary(self, segment: Segment) -> str | None:
        """Take channels, counts and blocks from the summary.

        Returns:
            None when that is done, else why the file must be scanned: "" if it simply has no full
            index, or a clause that says what is damaged.
        """
        view, size = self.view, len(self.view)
        if size < FOOTER.size + len(MAGIC) or view[-len(MAGIC) :] != MAGIC:
            return "the file was not closed (it has no footer)"
        opcode, length, start, _, crc, _ = FOOTER.unpack_from(view, size - FOOTER.size)
        if opcode != Opcode.FOOTER or length != FOOTER.size - HEAD.size - len(MAGIC):
            return "the footer is damaged"
        if start == 0:
            return ""
        end = size - FOOTER.size
        if not len(MAGIC) < start < end:
            return "the footer points to no place of the file"
        if crc and crc32(view[start : size - len(MAGIC) - 4]) != crc:
            return "the index does not match its checksum"
        trial = Segment(profile=segment.profile)
        try:
            complete = self._take_summary(trial, start, end)
        except (RecordError, OverflowError):
            self.channels.clear()
            return "the index cannot be parsed"
        segment.schemas, segment.records, segment.channels = trial.schemas, trial.records, trial.channels
        return None if complete else ""

    def _take_summary(self, segment: Segment, start: int, end: int) -> bool:
        """Read the records of the summary; False where they do not describe the whole file."""
        indexes: list[ChunkIndex] = []
        at = start
        while at < end:
            opcode, body = self.record(at)
            at += HEAD.size + len(body)
            if at > end or opcode in (0, Opcode.HEADER, Opcode.FOOTER, Opcode.MESSAGE, Opcode.CHUNK, Opcode.DATA_END):
                raise RecordError
            if opcode == Opcode.STATISTICS:
                self.statistics = read_statistics(body)
            elif opcode == Opcode.CHUNK_INDEX:
                indexes.append(read_chunk_index(body))
            else:
                self.describe(segment, opcode, body)
        if self.statistics is None or any(not index.indexes for index in indexes):
            return False
        if not all(index.indexes.keys() <= segment.channels.keys() for index in indexes):
            return False
        if any(record.schema and record.schema not in segment.schemas for record in segment.records.values()):
            return False
        self._blocks = [self._block(segment, index, start) for index in indexes]
        return self._agrees(segment, self.statistics)

    def _block(self, segment: Segment, index: ChunkIndex, limit: int) -> McapBlock:
        if index.offset + index.length > limit or index.length < HEAD.size or index.first_ns > index.last_ns:
            raise RecordError
        channels = [segment.channels[number] for number in index.indexes]
        return McapBlock(
            index.offset,
            index.length,
            index.first_ns,
            index.last_ns,
            dict(zip(channels, self._indexed_counts(index), strict=True)),
            segment=segment,
            stated=Stated(index.compression, index.packed_bytes, index.unpacked_bytes),
            indexes=dict(zip(channels, index.indexes.values(), strict=True)),
        )

    def _indexed_counts(self, index: ChunkIndex) -> list[int]:
        """How many messages each message index of a chunk lists.

        They lie one behind the other behind the chunk, so that the next one's place tells their length without a look
        at the file; where that does not work out they are read.

        Raises:
            RecordError: there is no such message index.
        """
        behind = index.offset + index.length
        places = [*index.indexes.values(), behind + index.index_bytes]
        counts: list[int] = []
        for start, stop in pairwise(places) if places[0] == behind else ():
            count, rest = divmod(stop - start - INDEX_HEAD.size, ENTRY_BYTES)
            if rest or count < 0:
                break
            counts.append(count)
        if len(counts) == len(index.indexes):
            return counts
        return [self._indexed_count(number, at) for number, at in index.indexes.items()]

    def _indexed_count(self, number: int, at: int) -> int:
        """How many messages the message index at `at` lists.

        Raises:
            RecordError: there is no index of the channel of that number.
        """
        if at + INDEX_HEAD.size > len(self.view):
            raise RecordError
        opcode, length, found, size = INDEX_HEAD.unpack_from(self.view, at)
        if opcode != Opcode.MESSAGE_INDEX or found != number or size % ENTRY_BYTES or size + 6 > length:
            raise RecordError
        return int(size) // ENTRY_BYTES

    def _agrees(self, segment: Segment, statistics: Statistics) -> bool:
        """Whether the indexes and the statistics count the same messages; keeps the counts."""
        total: dict[Channel, int] = {}
        for block in self._blocks:
            for channel, count in block.counts.items():
                total[channel] = total.get(channel, 0) + count
        stated = {segment.channels.get(number): count for number, count in statistics.counts.items() if count}
        if {channel: count for channel, count in total.items() if count} != stated or sum(
            total.values()
        ) != statistics.messages:
            return False
        for channel, count in total.items():
            channel.count = count
        return True

    def describe(self, segment: Segment, opcode: int, body: memoryview, *, sure: bool = False) -> bool:
        """Take a schema or a channel; other records are passed over.

        Returns:
            False where it contradicts an earlier one, which it replaces if it is `sure`, guarded by a checksum.

        Raises:
            RecordError: it cannot be parsed.
        """
        if opcode == Opcode.SCHEMA:
            number, schema = read_schema(body)
            agrees = segment.schemas.get(number, schema) == schema
            if number not in segment.schemas or (sure and not agrees):
                segment.schemas[number] = schema
                for other, record in segment.records.items():
                    if record.schema == number:
                        self._describe_channel(segment, other, record)
            return agrees
        if opcode == Opcode.CHANNEL:
            number, record = read_channel(body)
            agrees = segment.records.get(number, record) == record
            if number not in segment.records or (sure and not agrees):
                self._describe_channel(segment, number, record)
            return agrees
        return True

    def _describe_channel(self, segment: Segment, number: int, record: ChannelRecord) -> None:
        if number not in segment.channels:
            segment.channels[number] = Channel("", "", "")
            self.channels.append(segment.channels[number])
        segment.records[number] = record
        channel, schema = segment.channels[number], segment.schemas.get(record.schema)
        channel.topic = record.topic
        channel.encoding = record.encoding or _DEFAULT_ENCODING.get(segment.profile, "")
        if schema is not None:
            channel.type, channel.schema_encoding, channel.schema = schema

    def _find_edges(self) -> None:
        """Fill in the first and last log time of every channel, from the message indexes that can hold them."""
        for block in sorted(self._blocks, key=attrgetter("first_ns")):
            for channel in block.counts:
                if channel.first_ns < 0 or block.first_ns < channel.first_ns:
                    found = self._indexed_times(block, channel)[0]
                    channel.first_ns = found if channel.first_ns < 0 else min(found, channel.first_ns)
        for block in sorted(self._blocks, key=attrgetter("last_ns"), reverse=True):
            for channel in block.counts:
                if block.last_ns > channel.last_ns:
                    channel.last_ns = max(self._indexed_times(block, channel)[1], channel.last_ns)

    def _indexed_times(self, block: McapBlock, channel: Channel) -> tuple[int, int]:
        """First and last log time of a channel in a block; those of the block where its index is damaged."""
        try:
            times = read_message_index(self.record(block.indexes[channel])[1])[1]["log_ns"]
        except RecordError:
            times = np.empty(0, np.uint64)
        inside = times[(times >= block.first_ns) & (times <= block.last_ns)]
        return (int(inside.min()), int(inside.max())) if len(inside) else (block.first_ns, block.last_ns)

    # ------------------------------------------------------------------------------ losses

    def report(
        self,
        what: Cause,
        text: str,
        start: int,
        stop: int,
        topics: dict[str, Tally] | None = None,
        times_ns: tuple[int, int] = (-1, -1),
    ) -> None:
        """Note what was lost between two bytes of the file."""
        self.lose(
            Loss(
                what=what,
                text=text,
                start=start,
                stop=stop,
                file_bytes=len(self.view),
                first_ns=times_ns[0],
                last_ns=times_ns[1],
                topics=MappingProxyType(topics or {}),
            )
        )

    def _report_block(self, block: McapBlock, unpacked: Unpacked) -> None:
        for what, fault in unpacked.faults:
            counts = withheld_by_topic((channel.topic, count) for channel, count in block.counts.items())
            span = (block.offset, block.offset + block.size if unpacked.withheld else block.offset)
            times = (block.first_ns, block.last_ns)
            self.report(what, fault, *span, counts if unpacked.withheld else None, times)

    # ------------------------------------------------------------------------------ blocks

    def unpack(self, block: McapBlock) -> Unpacked:
        """The records of a block, compared with their checksum once."""
        body = self.view[block.offset : block.offset + block.size]
        if not block.chunk:
            return Unpacked(body)
        unchecked = block.offset not in self._checked
        found = unpack_chunk(body[HEAD.size :], block.stated, torn=block.torn, check=unchecked)
        if not found.withheld:
            self._checked.add(block.offset)
        return found

    def _load(self, block: McapBlock, ahead: Collection[McapBlock] = (), *, keep: bool = True) -> Unpacked:
        """The records of a block; those that will be asked for next are unpacked in a thread where that saves time.

        It saves none where the messages are passed on sooner than a thread wakes. Blocks are kept for a second look
        only at the begin of the log: memory that is free again is taken again, which is quicker than new memory.
        """
        future = self._unpacked.get(block.offset)
        small = block.memory_bytes * KEPT_BLOCKS <= KEPT_BYTES
        begun = 0
        if small and time.perf_counter() - self._given_s > WORTH_A_THREAD_S:
            begun = sum(self._begin(following) for following in ahead)
        if future is None:
            future = Future()
            future.set_result(self.unpack(block))
            self._unpacked[block.offset] = future
        self._unpacked.move_to_end(block.offset)
        unpacked = future.result()
        kept = KEPT_BLOCKS if keep and small else 1 + begun
        while len(self._unpacked) > kept:
            self._unpacked.popitem(last=False)
        self._given_s = time.perf_counter()
        self._judge_checksum(block, unpacked)
        if unpacked.faults and (unpacked.withheld or block.offset not in self.told):
            self.told.add(block.offset)
            self._report_block(block, unpacked)
        return unpacked

    def _judge_checksum(self, block: McapBlock, unpacked: Unpacked) -> None:
        """Report the first chunk that was met without a checksum in a file that has others with one."""
        if not block.chunk or block.torn or unpacked.withheld or not unpacked.records:
            return
        start = block.segment.start
        self._first.setdefault((start, bool(unpacked.crc)), block)
        if (start, True) in self._first and (bare := self._first.get((start, False))) is not None:
            count = sum(bare.counts.values())
            text = f"a chunk has no checksum though others have; its {count} messages are read without a checksum"
            self.report(Cause.CHECKSUM, text, bare.offset, bare.offset, None, (bare.first_ns, bare.last_ns))

    def _begin(self, block: McapBlock) -> bool:
        """Unpack a block in a thread, where it is worth one; whether that was begun, now or earlier."""
        if block.offset in self._unpacked:
            return True
        if block.memory_bytes < WORTH_A_THREAD_BYTES.get(block.compression, 1 << 16):
            return False
        self._thread = self._thread or ThreadPoolExecutor(1, "unpack")
        self._unpacked[block.offset] = self._thread.submit(self.unpack, block)
        return True

    def _select(
        self,
        block: McapBlock,
        channels: Collection[Channel],
        start_ns: int | None,
        stop_ns: int | None,
        ahead: Collection[McapBlock] = (),
        *,
        keep: bool = True,
    ) -> Iterator[Message]:
        """Messages of `channels` in the block with ``start_ns <= log time < stop_ns``, in the order of log time."""
        unpacked = self._load(block, ahead, keep=keep)
        if unpacked.withheld:
            return iter(())
        wanted = {number: channel for number, channel in block.segment.channels.items() if channel in channels}
        walked = walk(unpacked.records, block.segment, wanted)
        messages = walked.messages
        if not walked.ordered:
            messages.sort(key=lambda message: message.log_ns)
        self._compare(block, walked, sum(block.counts.get(channel, 0) for channel in wanted.values()))
        if start_ns is not None and block.first_ns < start_ns:
            messages = [message for message in messages if message.log_ns >= start_ns]
        if stop_ns is not None and block.last_ns >= stop_ns:
            messages = [message for message in messages if message.log_ns < stop_ns]
        return iter(messages)

    def _compare(self, block: McapBlock, walked: Walked, expected: int) -> None:
        """Report what of a block's messages does not agree with its index."""
        span, found = (block.offset, block.offset), walked.messages
        if walked.fault and not block.torn:
            self.report(Cause.CUT, walked.fault, *span)
        if len(found) != expected and not block.torn:
            self._report_count(block)
        if found and (found[0].log_ns < block.first_ns or found[-1].log_ns > block.last_ns):
            self.report(Cause.ORDER, "a chunk holds messages of other times than it states", *span)

    def _report_count(self, block: McapBlock) -> None:
        """Report how the messages of a block differ in number from its index, of all channels, whichever are read."""
        segment = block.segment
        found = Counter(
            message.channel for message in walk(self.unpack(block).records, segment, segment.channels).messages
        )
        listed = Counter(block.counts)
        lost = lost_by_topic((channel.topic, count) for channel, count in (listed - found).items())
        text = f"a chunk's index lists {listed.total()} messages and {found.total()} are there"
        stop = block.offset + block.size if lost else block.offset
        self.report(Cause.COUNT, text, block.offset, stop, lost, (block.first_ns, block.last_ns))

    def sources(
        self, channels: Collection[Channel], start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterable[Source]:
        """One source a block that holds one of the channels and overlaps the range, see `MessageLog.sources`."""
        wanted = frozenset(channels)
        blocks = (
            block
            for block in self._blocks
            if (start_ns is None or block.last_ns >= start_ns)
            and (stop_ns is None or block.first_ns < stop_ns)
            and not wanted.isdisjoint(block.counts)
        )
        coming, place = deque(islice(blocks, 1 + READ_AHEAD)), 0
        while coming:
            block = coming.popleft()
            ahead = tuple(coming) if place >= SHORT_READ else ()
            keep = start_ns is None and place < KEPT_BLOCKS
            open_it = partial(self._select, block, wanted, start_ns, stop_ns, ahead, keep=keep)
            yield Source(block.first_ns, open_it, block.last_ns)
            coming.extend(islice(blocks, 1))
            place += 1

    def count_before(self, channels: Collection[Channel], stop_ns: int) -> int:
        """How many messages of `channels` were logged before `stop_ns`, by the index for all but the last blocks.

        The messages of a damaged block that has an index are counted, so that the later ones keep their numbers.
        """
        wanted, total = frozenset(channels), 0
        for block in self._blocks:
            if block.first_ns >= stop_ns or wanted.isdisjoint(block.counts):
                continue
            if block.last_ns < stop_ns:
                total += sum(block.counts.get(channel, 0) for channel in wanted)
            else:
                total += sum(1 for _ in self._select(block, wanted, None, stop_ns))
        return total

    def add_block(self, block: McapBlock) -> None:
        """Take a block that a scan found."""
        self._blocks.append(block)

    def withhold(self, blocks: Collection[McapBlock]) -> None:
        """Take back messages that a scan found where none should be."""
        for block in blocks:
            self._blocks.remove(block)
            for channel, count in block.counts.items():
                channel.count -= count
            counts = withheld_by_topic((channel.topic, count) for channel, count in block.counts.items())
            text = f"{sum(block.counts.values())} messages outside of chunks, where the others are, are left out"
            span = (block.offset, block.offset + block.size)
            self.report(Cause.CHECKSUM, text, *span, counts, (block.first_ns, block.last_ns))

    def extras(self) -> Extras:
        """Attachments and metadata; the file is walked over once, from record to record."""
        if self._extras is None:
            first = min(self._blocks, key=attrgetter("offset"), default=None)
            self._extras = ExtrasWalk(self, first.segment if first is not None else Segment()).run()
        return self._extras

    def close(self) -> None:
        """Release the file; images that are still held keep their part of it."""
        if self._thread is not None:
            self._thread.shutdown(wait=True, cancel_futures=True)
        self._unpacked.clear()
        self._extras = None
        try:
            self.view.release()
            self._map.close()
        except BufferError:
            pass
