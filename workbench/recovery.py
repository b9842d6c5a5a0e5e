"""`recover`: what can be read of a log, written as a clean MCAP file with an index; and the account of both.

Messages pass through as they were stored, with their encoding, their definitions and all their times; attachments and
metadata of MCAP go before them. All that the log is known to have held is either written or counted with a reason.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter

from readers.decoding import MessageError, definition_of, unpacked
from readers.extras import ExtraKind, Extras, LostExtra
from readers.log_recording import LogRecording
from readers.message_log import Channel, Message
from readers.salvage import Loss
from readers.streams import Recording, RecordingError, StreamError
from workbench.loss_report import Good, GoodMessages
from workbench.writers.door import uninterrupted

Progress = Callable[[int, int], None]
CHUNK_BYTES = 1 << 20
LARGEST_TIME_NS = 2**64 - 1
LARGEST_ATTACHMENT_BYTES = 1 << 28
LIBRARY = "estimator-workbench"
PROFILES = {"ros1": "ros1", "cdr": "ros2"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Recovered:
    """What became of a log.

    `good` counts by topic what was written; `skipped` by topic and reason the messages that could be read and that
    the new file cannot hold. `attachments` and `metadata` count those that were written, `lost` are the others.
    """

    path: Path
    good: Mapping[str, Good]
    skipped: Mapping[tuple[str, str], int]
    losses: tuple[Loss, ...]
    damage: tuple[str, ...]
    attachments: int = 0
    metadata: int = 0
    lost: tuple[LostExtra, ...] = ()

    @property
    def clean(self) -> bool:
        """Whether nothing was damaged and everything was written."""
        return not (self.damage or self.skipped or self.lost)


def recover(recording: Recording, path: Path, *, on_progress: Progress | None = None) -> Recovered:
    """Write the readable messages of a log into an MCAP file, in the order of their log times.

    Args:
        recording: a log of messages: a bag, a database or MCAP.
        path: the file to make; it must not be there yet.
        on_progress: called with the number of messages written and of those expected.

    Raises:
        RecordingError: the path is taken, or cannot be written, or nothing of the damaged log can be read.
        StreamError: the recording is no log of messages.
        KeyboardInterrupt: as it came; what was written before it is a whole file.
    """
    if not isinstance(recording, LogRecording):
        raise StreamError(
            f"{recording.path}: {recording.format} has no messages to recover; give a bag or an MCAP file"
        )
    if recording.path.is_dir() and path.resolve().is_relative_to(recording.path.resolve()):
        raise RecordingError(path, "it would lie among the files of the log itself", "choose another folder")
    try:
        with path.open("xb") as file:
            copy = _Copy(recording, file)
            copy.fill(on_progress)
    except FileExistsError as error:
        raise RecordingError(path, "it exists already", "choose another name or remove it first") from error
    except OSError as error:
        raise RecordingError(
            path, f"it cannot be written ({error.strerror or error})", "choose another folder"
        ) from error
    if recording.damage and not any((copy.good.total, copy.attachments, copy.metadata, copy.skipped, copy.lost)):
        path.unlink()
        problem = f"nothing of it can be read ({recording.damage[0].what})"
        raise RecordingError(recording.path, problem, "copy it again from where it was recorded")
    return Recovered(
        path=path,
        good=copy.good,
        skipped=dict(copy.skipped),
        losses=recording.losses,
        damage=tuple(str(damage) for damage in recording.damage),
        attachments=copy.attachments,
        metadata=copy.metadata,
        lost=tuple(copy.lost),
    )


class _Copy:
    """An MCAP file that is filled with the messages of a log."""

    def __init__(self, recording: LogRecording, file: BinaryIO) -> None:
        self._recording = recording
        self._writer = McapWriter(file, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
        self._channels: dict[Channel, int] = {}
        self._schemas: dict[tuple[str, str, bytes], int] = {}
        self._known: dict[tuple[str, str, int], int] = {}
        self.good = GoodMessages()
        self.skipped: Counter[tuple[str, str]] = Counter()
        self.attachments = self.metadata = 0
        self.lost: list[LostExtra] = []

    def fill(self, on_progress: Progress | None) -> None:
        """Write all that can be read; also after an interrupt the file is whole."""
        encodings = {channel.encoding for channel in self._recording.channels}
        self._writer.start(profile=PROFILES.get(encodings.pop(), "") if len(encodings) == 1 else "", library=LIBRARY)
        expected = sum(channel.count for channel in self._recording.channels)
        try:
            for channel in self._recording.channels:
                self._number(channel)
                self.good.setdefault(channel.topic, Good())
            with uninterrupted():
                self._put_extras(self._recording.extras())
            for done, message in enumerate(self._recording.messages(), start=1):
                with uninterrupted():
                    self._put(message)
                if on_progress is not None:
                    on_progress(done, max(done, expected))
        finally:
            with uninterrupted():
                self._writer.finish()

    def _put_extras(self, extras: Extras) -> None:
        """Write what lies beside the messages."""
        self.lost += extras.lost
        for attachment in extras.attachments:
            name, media_type, log_ns, create_ns, data = attachment
            if len(data) > LARGEST_ATTACHMENT_BYTES:
                reason = f"its {len(data)} bytes are more than the {LARGEST_ATTACHMENT_BYTES} that are copied"
                self.lost.append(LostExtra(ExtraKind.ATTACHMENT, name, reason))
                continue
            self._writer.add_attachment(create_ns, log_ns, name, media_type, bytes(data))
            self.attachments += 1
        for metadata in extras.metadata:
            self._writer.add_metadata(metadata.name, metadata.values)
            self.metadata += 1

    def _put(self, message: Message) -> None:
        channel = message.channel
        try:
            data = unpacked(channel.encoding, message.data)
        except MessageError as error:
            self.skipped[channel.topic, str(error)] += 1
            return
        published_ns = message.log_ns if message.publish_ns < 0 else message.publish_ns
        if not 0 <= message.log_ns <= LARGEST_TIME_NS >= published_ns:
            self.skipped[channel.topic, "the log time does not fit into MCAP"] += 1
            return
        self._writer.add_message(
            self._number(channel),
            log_time=message.log_ns,
            publish_time=published_ns,
            sequence=max(message.sequence, 0),
            data=bytes(data),
        )
        self.good.add(message)

    def _number(self, channel: Channel) -> int:
        """The number of a channel in the new file; the parts of a split log share theirs."""
        if channel not in self._channels:
            schema_encoding, schema = definition_of(channel, self._recording.definitions)
            schema_key = (channel.type, schema_encoding, schema)
            if channel.type and schema_key not in self._schemas:
                self._schemas[schema_key] = self._writer.register_schema(channel.type, schema_encoding, schema)
            key = (channel.topic, channel.encoding, self._schemas.get(schema_key, 0))
            if key not in self._known:
                self._known[key] = self._writer.register_channel(*key)
            self._channels[channel] = self._known[key]
        return self._channels[channel]
