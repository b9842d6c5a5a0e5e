"""What an MCAP file holds beside its messages: attachments and metadata, past whatever is damaged.

They lie between the chunks. A walk from record to record finds them, and what the file's own indexes and statistics
say of them afterwards tells which ones are gone.
"""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

from readers.extras import Attachment, ExtraKind, Extras, LostExtra, Metadata
from readers.mcap_records import (
    FOOTER,
    HEAD,
    MAGIC,
    Opcode,
    RecordError,
    Segment,
    attachment_crc,
    attachment_name,
    metadata_name,
    read_attachment,
    read_attachment_index,
    read_extra_counts,
    read_metadata,
    read_metadata_index,
)
from readers.mcap_scan import Scan
from readers.salvage import Cause

if TYPE_CHECKING:
    from readers.mcap_log import McapLog


_KINDS: dict[int, ExtraKind] = {Opcode.ATTACHMENT: ExtraKind.ATTACHMENT, Opcode.METADATA: ExtraKind.METADATA}


class ExtrasWalk:
    """One walk over a file for what lies beside the messages; losses are noted in the log.

    Args:
        log: the file.
        segment: what describes its channels.
    """

    def __init__(self, log: McapLog, segment: Segment) -> None:
        self._log, self._view, self._size = log, log.view, len(log.view)
        self._records = Scan(log, segment, "")
        self._start = 0
        self._met: dict[int, ExtraKind] = {}
        self._lost: dict[int, tuple[LostExtra, Cause, int]] = {}
        self._counted: Counter[ExtraKind] = Counter()
        self.found = Extras()

    def run(self) -> Extras:
        """Walk from the first record to the end of the file."""
        at = len(MAGIC)
        while at < self._size:
            at = self._step(at)
        self._end_segment()
        return self.found

    def _step(self, at: int) -> int:
        """Take the record at `at`; where the next one begins."""
        opcode, end = self._records.head(at)
        body = self._view[at + HEAD.size : end]
        if not opcode or end > self._size or not self._records.leads_on(end):
            return self._broken(at, body)
        if opcode == Opcode.FOOTER:
            return self._next_file(at + FOOTER.size - len(MAGIC))
        try:
            self._take(at, opcode, body)
        except RecordError:
            return self._broken(at, body)
        return end

    def _take(self, at: int, opcode: int, body: memoryview) -> None:
        """Keep an attachment or metadata, or what the file says of its own.

        Raises:
            RecordError: it cannot be parsed.
        """
        if opcode == Opcode.ATTACHMENT:
            name, media_type, log_ns, create_ns, data = read_attachment(body)
            self._met[at] = ExtraKind.ATTACHMENT
            stated, found = attachment_crc(body)
            if stated and stated != found:
                self._lose(at, at + HEAD.size + len(body), name, "it does not match its checksum", Cause.CHECKSUM)
            else:
                self.found.attachments.append(Attachment(name, media_type, log_ns, create_ns, data))
        elif opcode == Opcode.METADATA:
            self.found.metadata.append(Metadata(*read_metadata(body)))
            self._met[at] = ExtraKind.METADATA
        elif opcode == Opcode.ATTACHMENT_INDEX:
            self._indexed(ExtraKind.ATTACHMENT, *read_attachment_index(body))
        elif opcode == Opcode.METADATA_INDEX:
            self._indexed(ExtraKind.METADATA, *read_metadata_index(body))
        elif opcode == Opcode.STATISTICS:
            attachments, metadata = read_extra_counts(body)
            self._counted = Counter({ExtraKind.ATTACHMENT: attachments, ExtraKind.METADATA: metadata})

    def _broken(self, at: int, body: memoryview) -> int:
        """Pass over what is no whole record; an attachment or metadata among it is lost."""
        found = self._records.search(at + 1)
        end = found if found >= 0 else self._size
        kind = _KINDS.get(self._view[at])
        if kind is not None and (name := _name_of(kind, body)) is not None:
            self._met[at] = kind
            cut = found < 0 and at + HEAD.size + len(body) >= self._size
            reason = "the file ends inside of it" if cut else "its record is damaged"
            self._lose(at, end, name, reason, Cause.CUT)
        return self._next_file(end) if self._view[end : end + len(MAGIC)] == MAGIC else end

    def _next_file(self, at: int) -> int:
        """Where the records of the file begin that was joined to the one whose end begins at `at`; the end if none."""
        start = self._log.find(MAGIC, at)
        if start >= 0 and self._view[start + len(MAGIC) : start + 2 * len(MAGIC)] == MAGIC:
            start += len(MAGIC)
        if start < 0 or start + len(MAGIC) >= self._size:
            return self._size
        self._end_segment()
        self._start = start
        return start + len(MAGIC)

    # ------------------------------------------------------------------------------- losses

    def _lose(self, at: int, end: int, name: str, reason: str, cause: Cause) -> None:
        self._lost[at] = LostExtra(self._met[at], name, reason), cause, end

    def _indexed(self, kind: ExtraKind, offset: int, name: str) -> None:
        """Compare with what the index states: one that was not met is lost, and a lost one has that name."""
        at = self._start + offset
        if at not in self._met:
            self._met[at] = kind
            end = min(at, self._size)
            self._lose(at, end, name, "the index names it and it is not there", Cause.CUT)
        elif at in self._lost:
            lost, cause, end = self._lost[at]
            self._lost[at] = lost._replace(name=name), cause, end

    def _end_segment(self) -> None:
        """Compare with the numbers that the statistics state, and note what was lost."""
        met = Counter(self._met.values())
        for number, (kind, count) in enumerate((self._counted - met).items()):
            place = self._size + number
            self._met[place] = kind
            reason = f"the statistics count {count} more than are there"
            self._lose(place, self._size, "", reason, Cause.COUNT)
        for at, (lost, cause, end) in sorted(self._lost.items()):
            self.found.lost.append(lost)
            start = min(at, self._size)
            name = repr(lost.name[:80]) if lost.name else "without a name"
            self._log.report(cause, f"{lost.kind} {name} is left out: {lost.reason}", start, max(start, end))
        self._met, self._lost, self._counted = {}, {}, Counter()


def _name_of(kind: ExtraKind, body: memoryview) -> str | None:
    """The name in a damaged record; None where it is not there: what is only taken for such a record has none."""
    try:
        return attachment_name(body) if kind is ExtraKind.ATTACHMENT else metadata_name(body)
    except RecordError:
        return None
