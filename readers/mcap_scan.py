"""A walk over the records of an MCAP file whose index is missing or wrong, past whatever is damaged.

No length is believed that does not lead to another record. Where the records break off, the next place is searched
from which several records follow each other.
"""

from __future__ import annotations

import struct
from collections import Counter
from typing import TYPE_CHECKING

import numpy as np

from readers.mcap_records import (
    FOOTER,
    HEAD,
    MAGIC,
    PRIVATE,
    SHORTEST,
    McapBlock,
    Opcode,
    RecordError,
    Segment,
    Stated,
    Statistics,
    known,
    read_channel,
    read_chunk_head,
    read_message_index,
    read_schema,
    read_statistics,
    unpack_chunk,
    walk,
)
from readers.message_log import Channel, crc32
from readers.salvage import Cause, lost_by_topic, withheld_by_topic

if TYPE_CHECKING:
    from readers.mcap_log import McapLog

RUN_BYTES = 1 << 20
WINDOW_BYTES = 1 << 14, 1 << 22
PROOF_BYTES = 1 << 30  # what may be unpacked to prove chunks, so that no file takes long
CHAIN = 3
ZEROS_BYTES = 512
UNDEFINED = range(0x10, 0x100)
_TWO_U64 = struct.Struct("<QQ")
POINTERS = {
    Opcode.CHUNK_INDEX: 16,
    Opcode.ATTACHMENT_INDEX: 0,
    Opcode.METADATA_INDEX: 0,
    Opcode.SUMMARY_OFFSET: 1,
}
"""Records of the summary: where in them the place and the length of something in the file stand."""
_PLAUSIBLE = np.zeros(256, bool)
_PLAUSIBLE[[*SHORTEST]] = True
_UNREADABLE = "bytes that are no records were passed over"


class Scan:
    """One walk over a file, which gives its blocks to the log.

    Args:
        log: the file.
        segment: what its summary describes, as far as that is sound.
        fault: what is wrong with the index, "" if there simply is none.
    """

    def __init__(self, log: McapLog, segment: Segment, fault: str) -> None:
        self.log, self.segment, self.fault = log, segment, fault
        self.view, self.size = log.view, len(log.view)
        self.run_start = -1
        self.closed = False
        self.unchecked = 0
        self.summed = False  # the checksum of the whole data section was there to compare with
        self.cost: Counter[Channel] = Counter()
        self.loose: list[McapBlock] = []
        self.chunked = False
        self.losses = len(log.losses)
        self.magic = 0  # where the next file that was joined may begin, -1 if none does
        self.summary = 0  # where the summary begins, 0 as long as the data go on
        self.stated: Statistics | None = None
        self.proofs = PROOF_BYTES
        self.strange: list[tuple[int, int, McapBlock]] = []

    def run(self) -> None:
        """Walk from the first record to the end of the file."""
        self.log.notes.append("The file has no usable index; it was read once to list what it holds.")
        at = len(MAGIC)
        while at < self.size:
            at = self._step(at)
        self._end_run(self.size)
        self._end_segment()
        self._report_end()

    # ------------------------------------------------------------------------------- steps

    def _step(self, at: int) -> int:
        """Take what lies at `at`; where the next record begins."""
        opcode, end = self.head(at)
        if opcode == Opcode.MESSAGE and self.leads_on(end):
            if self.run_start >= 0 and end - self.run_start > RUN_BYTES:
                self._end_run(at)
            self.run_start = at if self.run_start < 0 else self.run_start
            return end
        self._end_run(at)
        if opcode == Opcode.FOOTER:
            return self._footer(at, end)
        if opcode == Opcode.CHUNK:
            return self._chunk(at, end)
        if opcode and self.leads_on(end) and self._take(at, opcode, end):
            return end
        if not opcode and self.view[at] in UNDEFINED and end <= self.size and self.leads_on(end):
            return self._undefined(at, end)
        return self._passed_over(at)

    def head(self, at: int) -> tuple[int, int]:
        """Kind and end of the record at `at`; kind 0 where none can be."""
        if at + HEAD.size > self.size:
            return 0, self.size
        opcode, length = HEAD.unpack_from(self.view, at)
        return (opcode if known(opcode, length) else 0), at + HEAD.size + length

    def leads_on(self, at: int) -> bool:
        """Whether at `at` the file ends or another record can begin, be it cut."""
        if at >= self.size:
            return at == self.size
        if at + HEAD.size > self.size:
            return self.view[at] in SHORTEST or self.view[at] == MAGIC[0]
        opcode, end = self.head(at)
        if opcode or self.view[at : at + len(MAGIC)] == MAGIC:
            return True
        zeros = self.view[at : at + ZEROS_BYTES]
        if zeros == bytes(len(zeros)):  # a power loss leaves zeros
            return True
        return end <= self.size and (end == self.size or bool(self.head(end)[0]))

    def _take(self, at: int, opcode: int, end: int) -> bool:
        """Take a record that is neither message nor chunk; False if it cannot be what it says."""
        body = self.view[at + HEAD.size : end]
        try:
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                if not self.log.describe(self.segment, opcode, body):
                    self.log.report(Cause.SCHEMA, "a schema or channel is described in two ways", at, at)
            elif opcode == Opcode.MESSAGE_INDEX:
                read_message_index(body)
                self.chunked = True
            elif opcode == Opcode.DATA_END:
                self._data_end(at, body)
                self.summary = end
            elif opcode == Opcode.STATISTICS:
                self.stated = read_statistics(body)
            elif opcode == Opcode.HEADER:
                return at == self.segment.start + len(MAGIC)
            elif opcode in POINTERS and not self.summary:
                return self._points_into_file(opcode, body)
        except RecordError:
            return False
        return True

    def _points_into_file(self, opcode: int, body: memoryview) -> bool:
        """Whether a record that belongs into the summary, and lies before it, states places that can be."""
        place, length = _TWO_U64.unpack_from(body, POINTERS[Opcode(opcode)])
        return int(place + length) <= self.size

    def _undefined(self, at: int, end: int) -> int:
        """Pass over a record of an undefined kind, which may be a defined one with a damaged first byte."""
        if stop := self._disguised(at):
            return stop
        kind, body = self.view[at], self.view[at + HEAD.size : end]
        message = kind == PRIVATE | Opcode.MESSAGE and int.from_bytes(body[:2], "little") in self.segment.channels
        try:
            chunk = read_chunk_head(body).stop == len(body)
        except RecordError:
            chunk = False
        if kind < PRIVATE or chunk or message:
            self.log.report(Cause.CODEC, f"a record of the unknown kind {kind:#x} was passed over", at, end)
        else:
            self.log.notes.append(f"A record of the private kind {kind:#x} was passed over.")
        return end

    def _disguised(self, at: int) -> int:
        """Take a chunk that its checksum proves though its record's head is damaged; its end, 0 if none is there."""
        try:
            head = read_chunk_head(self.view[at + HEAD.size :])
        except RecordError:
            return 0
        end = at + HEAD.size + head.stop
        if end > self.size or not head.crc or not self._proven(at, end):
            return 0
        self.log.report(Cause.CODEC, "the head of a chunk record is damaged; the chunk's checksum served", at, at)
        self.chunked = True
        return self._block(at, end)[1]

    def _data_end(self, at: int, body: memoryview) -> None:
        """Compare the whole data section with its checksum where messages have none of their own."""
        stated = int.from_bytes(body[:4], "little")
        self.summed = stated != 0
        if stated and (self.unchecked or self.strange) and crc32(self.view[self.segment.start : at]) != stated:
            bare = f"{self.unchecked} messages have" if self.unchecked else "messages may have"
            text = f"the data do not match their checksum; {bare} no other and may be wrong"
            self.log.report(Cause.CHECKSUM, text, self.segment.start, self.segment.start)
        self.closed = True

    def _footer(self, at: int, end: int) -> int:
        """The end of one file; where another one begins that was joined to it."""
        end = at + FOOTER.size - len(MAGIC)
        if self.view[end : end + len(MAGIC)] != MAGIC:
            if end + len(MAGIC) > self.size:
                return self.size
            if not self.leads_on(end):
                return self._passed_over(at)
            self.log.report(Cause.CUT, "the log goes on behind its footer", end, end)
            return end
        self.closed = True
        self._take_statistics(at)
        end += len(MAGIC)
        if end == self.size:
            return end
        if self.view[end : end + len(MAGIC)] != MAGIC:
            found = self.log.find(MAGIC, end)
            text = f"{(found if found >= 0 else self.size) - end} bytes follow after the end of the log"
            self.log.report(Cause.CUT, text, end, found if found >= 0 else self.size)
            if found < 0:
                return self.size
            end = found
        return self._joined(end)

    def _take_statistics(self, footer: int) -> None:
        """Believe the counts of a summary that is not where the footer states it, if its checksum proves them."""
        crc, before_crc = FOOTER.unpack_from(self.view, footer)[4], footer + FOOTER.size - len(MAGIC) - 4
        if self.log.statistics is None and crc and self.summary and not self.segment.start:
            self.log.statistics = self.stated if crc32(self.view[self.summary : before_crc]) == crc else None

    def _joined(self, at: int) -> int:
        """Begin with another file that was joined to this one."""
        self.log.report(Cause.ORDER, "another log begins; the two were joined and both are read", at, at)
        self._end_segment()
        self.segment = Segment(start=at, profile=self.log.profile(at))
        self.closed, self.summed, self.unchecked = False, False, 0
        return at + len(MAGIC)

    # ------------------------------------------------------------------------------ blocks

    def _end_run(self, end: int) -> None:
        if self.run_start >= 0:
            start, self.run_start = self.run_start, -1
            self.unchecked += self._block(start, end, chunk=False)[0]

    def _chunk(self, at: int, end: int) -> int:
        """Take the chunk at `at`, by its own length where that of the record leads nowhere."""
        body = self.view[at + HEAD.size :]
        try:
            head = read_chunk_head(body)
        except RecordError:
            return self._passed_over(at)
        self.chunked = True
        inner = at + HEAD.size + head.stop
        if end <= self.size and inner <= end and (self.leads_on(end) or (inner == end and self._proven(at, end))):
            if inner < end:
                self.log.report(Cause.CUT, "a chunk's records end before it does; the rest is lost", inner, end)
            return self._block(at, end)[1]
        if inner <= self.size and (self.leads_on(inner) or self._proven(at, inner)):
            self.log.report(Cause.LIMIT, "the length of a chunk record is wrong; the chunk's own served", at, at)
            return self._block(at, inner)[1]
        if end > self.size and inner > self.size and self.search(at + 1, chunks_only=True) < 0:
            count, _ = self._block(at, self.size, torn=True)
            text = f"the file ends inside a chunk, {count} messages of which are read without a checksum"
            self.log.report(Cause.CUT, text, at, self.size)
            return self.size
        return self._passed_over(at)

    def _proven(self, at: int, end: int) -> bool:
        """Whether a chunk matches its checksum, which is more than that a record follows it."""
        if self.proofs < 0:
            return False
        unpacked = unpack_chunk(self.view[at + HEAD.size : end])
        self.proofs -= len(unpacked.records)
        return bool(unpacked.crc) and not unpacked.withheld

    def _before_overlap(self, start: int, end: int) -> int:
        """Where a damaged chunk really ends: at a sound one that it reaches into, as it lost bytes; else at `end`.

        A chunk that lies wholly inside of it may be what a message holds.
        """
        at = start
        while 0 <= (at := self.search(at + 1, chunks_only=True)) < end:
            if (following := self.head(at)[1]) > end and self._proven(at, following):
                return at
        return end

    def _block(self, start: int, end: int, *, chunk: bool = True, torn: bool = False) -> tuple[int, int]:
        """Read a block once, count what it holds and give it to the log; the number of its messages, and its end."""
        stated = None
        if chunk:
            head = read_chunk_head(self.view[start + HEAD.size : end])
            stated = Stated(head.compression, head.stop - head.start, head.unpacked_bytes)
        block = McapBlock(start, end - start, 0, 0, {}, torn, segment=self.segment, chunk=chunk, stated=stated)
        unpacked = self.log.unpack(block)
        if unpacked.faults:
            self.log.told.add(start)
        if unpacked.withheld:
            end = end if torn else self._before_overlap(start, end)
            counts, times = self._listed(end)
            self.cost.update(counts)
            withheld = withheld_by_topic((channel.topic, count) for channel, count in counts.items())
            for what, fault in unpacked.faults:
                self.log.report(what, fault, start, end, withheld, times)
            return 0, end
        for what, fault in unpacked.faults:
            self.log.report(what, fault, start, start)
        return self._count(start, end, block, unpacked.records, checked=bool(unpacked.crc) and not torn), end

    def _count(
        self, start: int, end: int, block: McapBlock, records: memoryview, *, checked: bool, last: bool = False
    ) -> int:
        """Count the messages of a block; one that has undescribed channels waits, as they may be described later."""
        self._describe_inside(start, records, sure=checked)
        walked = walk(records, self.segment, self.segment.channels)
        if walked.strangers and not last and not block.torn:
            self.strange.append((start, end, block))
            return 0
        if walked.fault and not block.torn:
            self.log.report(Cause.CUT, walked.fault, start, start)
        if walked.strangers:
            text = f"{walked.strangers.total()} messages are of channels that the file does not describe"
            unknown = withheld_by_topic((f"channel {number}", count) for number, count in walked.strangers.items())
            self.log.report(Cause.SCHEMA, text, start, end, unknown)
        for message in walked.messages:
            message.channel.note(message.log_ns)
        if walked.messages:
            times = [message.log_ns for message in walked.messages]
            block = block.of(min(times), max(times), Counter(m.channel for m in walked.messages))
            self.log.add_block(block)
            if not block.chunk:
                self.loose.append(block)
        if block.chunk and not checked:
            self.unchecked += len(walked.messages)
        return len(walked.messages)

    def _describe_inside(self, start: int, records: memoryview, *, sure: bool) -> None:
        """Take the schemas and channels inside of a chunk; a chunk in it is refused."""
        for opcode, body in walk(records, self.segment, {}).others:
            try:
                if opcode == Opcode.CHUNK:
                    self.log.report(Cause.CODEC, "a chunk inside of a chunk was passed over", start, start)
                elif not self.log.describe(self.segment, opcode, body, sure=sure):
                    self.log.report(Cause.SCHEMA, "a schema or channel is described in two ways", start, start)
            except RecordError:
                self.log.report(Cause.SCHEMA, "a schema or channel record cannot be parsed", start, start)

    def _listed(self, at: int) -> tuple[Counter[Channel], tuple[int, int]]:
        """What the message indexes that begin at `at` list: messages by channel, first and last log time."""
        counts: Counter[Channel] = Counter()
        times: list[int] = []
        while (head := self.head(at))[0] == Opcode.MESSAGE_INDEX and head[1] <= self.size:
            try:
                number, entries = read_message_index(self.view[at + HEAD.size : head[1]])
            except RecordError:
                break
            if (channel := self.segment.channels.get(number)) is not None and len(entries):
                counts[channel] += len(entries)
                times += [int(entries["log_ns"].min()), int(entries["log_ns"].max())]
            at = head[1]
        return counts, (min(times, default=-1), max(times, default=-1))

    # ------------------------------------------------------------------------------ search

    def _passed_over(self, at: int) -> int:
        """Report what lies between `at` and the next record, and go on there."""
        if stop := self._disguised(at):
            return stop
        found = self.search(at + 1)
        end = found if found >= 0 else self.size
        if not self.closed or found >= 0:
            cut = found < 0 and self.head(at)[0]
            self.log.report(Cause.CUT, "the file ends inside a record" if cut else _UNREADABLE, at, end)
        if self.view[end : end + len(MAGIC)] == MAGIC and end + len(MAGIC) < self.size:
            return self._joined(end)
        return end

    def search(self, start: int, *, chunks_only: bool = False) -> int:
        """The first place from `start` on from which several records follow each other, -1 if there is none."""
        if 0 <= self.magic < start:
            self.magic = self.log.find(MAGIC, start)
        magic = self.magic
        stop = magic if 0 <= magic < self.size - len(MAGIC) else self.size
        window, (width, widest) = start, WINDOW_BYTES
        while window < stop:
            raw = np.frombuffer(self.view[window : min(window + width + HEAD.size, stop)], np.uint8)
            if len(raw) < HEAD.size:
                break
            short = raw[5:-3] | raw[6:-2] | raw[7:-1] | raw[8:]
            for place in np.flatnonzero(_PLAUSIBLE[raw[: len(short)]] & (short == 0)):
                at = window + int(place)
                if (not chunks_only or self.view[at] == Opcode.CHUNK) and self._begins(at):
                    return at
            window, width = window + width, min(4 * width, widest)
        return stop if stop < self.size else -1

    def _begins(self, at: int) -> bool:
        """Whether records follow each other from `at` on, the first of which can be parsed."""
        opcode, end = self.head(at)
        if end > self.size:
            return False
        body = self.view[at + HEAD.size : end]
        try:
            if opcode == Opcode.CHUNK:
                head = read_chunk_head(body)
                return head.stop <= len(body) and self.leads_on(end)
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                (read_schema if opcode == Opcode.SCHEMA else read_channel)(body)
            elif opcode == Opcode.MESSAGE_INDEX:
                read_message_index(body)
            elif opcode == Opcode.MESSAGE and int.from_bytes(body[:2], "little") not in self.segment.channels:
                return False
        except RecordError:
            return False
        for _ in range(CHAIN):
            if end == self.size or self.view[end : end + len(MAGIC)] == MAGIC:
                return True
            opcode, end = self.head(end)
            if not opcode or end > self.size:
                return False
        return True

    # --------------------------------------------------------------------------------- end

    def _end_segment(self) -> None:
        """Withhold messages outside of chunks where others lie in chunks with checksums and the file is damaged.

        They may be the inside of a chunk whose beginning is damaged, or other records that turned into messages.
        Where no other chunk tells whether that is so they are read, and it is said that nothing proves them.
        """
        self._count_strange()
        loose, self.loose = self.loose, []
        damaged = len(self.log.losses) > self.losses or (self.fault and self._count_differs())
        if loose and self.chunked and damaged:
            self.log.withhold(loose)
            for block in loose:
                self.cost.update(block.counts)
        elif loose and not self.summed and (damaged or not self.closed):
            count = sum(sum(block.counts.values()) for block in loose)
            text = f"{count} messages outside of chunks are read without a checksum and may be wrong"
            self.log.report(Cause.CHECKSUM, text, self.segment.start, self.segment.start)
        self.chunked = False

    def _count_strange(self) -> None:
        """Count the blocks whose channels were not described before them, now that all descriptions are known."""
        strange, self.strange = self.strange, []
        for start, end, block in strange:
            unpacked = self.log.unpack(block)
            checked = bool(unpacked.crc) and not block.torn
            self._count(start, end, block, unpacked.records, checked=checked, last=True)

    def _count_differs(self) -> bool:
        """Whether the file states how many messages of each channel it holds, and others were found."""
        return self.log.statistics is not None and not self.segment.start and any(self._differences().values())

    def _differences(self) -> Counter[Channel]:
        """By channel: how many more messages the file states than were found, or withheld with a cause."""
        statistics, channels = self.log.statistics, self.segment.channels
        assert statistics is not None
        more = Counter({channel: statistics.counts.get(number, 0) for number, channel in channels.items()})
        more.subtract(self.cost)
        more.subtract({channel: channel.count for channel in channels.values()})
        return more

    def _report_end(self) -> None:
        """Report how the file ends, and where its own counts differ from what was found."""
        if not self.closed:
            self.log.report(
                Cause.CUT, "the file was not closed, what is there can be read; it breaks off", self.size, self.size
            )
        elif self.fault:
            self.log.report(Cause.CUT, f"{self.fault}; the file was read without it", self.size, self.size)
        for number, record in self.segment.records.items():
            if record.schema and record.schema not in self.segment.schemas:
                text = f"the schema {record.schema} of {self.segment.channels[number].topic[:80]!r} is missing"
                self.log.report(Cause.SCHEMA, text, -1, -1)
        statistics = self.log.statistics
        if statistics is None or self.segment.start:
            return
        found = sum(channel.count for channel in self.segment.channels.values()) + self.cost.total()
        more = self._differences()
        if any(more.values()) or statistics.messages != found:
            text = f"the file claims {statistics.messages} messages and {found} were found"
            lost = lost_by_topic((channel.topic, count) for channel, count in more.items() if count > 0)
            self.log.report(Cause.COUNT, text, -1, -1, lost if len(self.log.losses) > self.losses else None)
