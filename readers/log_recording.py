"""A log of messages as a `Recording`: topics become streams, messages become samples.

One log may lie in several files. Every topic that can be read is looked at once before the first reading:
its first messages tell its frame, whether its stamps are a clock, and how far that clock is from the log's.
"""

from __future__ import annotations

import heapq
import itertools
import statistics
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from operator import attrgetter
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from readers.clock import REORDER_WINDOW_NS, SECOND_NS, merge, reorder, sane_stamp
from readers.decoding import Decoder, Definitions, MessageError, decoder_of, definition_text, has_fixed_layout
from readers.extras import Extras
from readers.fixed_layout import FixedReader, fixed_reader, header_of
from readers.fixed_rows import fill_rows, read_rows
from readers.message_log import Buffer, Channel, Message, MessageLog, Source, in_log_order
from readers.messages import (
    Arrival,
    OtherUseError,
    Reader,
    UnsupportedError,
    frame_of,
    header_stamp,
    pair_stream,
    reader_of,
    samples_of,
    stamp_ns,
)
from readers.salvage import Loss
from readers.sample_arrays import ARRAY_ROWS, StructuredArray, blank, gathered, reordered, row_type, rows_of, within
from readers.streams import (
    LATEST_NS,
    Camera,
    CameraInfo,
    Clock,
    Damage,
    Problem,
    ReadOptions,
    Recording,
    Sample,
    StreamError,
    StreamInfo,
    StreamKind,
)

SLACK_NS = 2 * SECOND_NS
FIRST_MESSAGES = 10
BATCH_BYTES = 1 << 21
BATCH_MESSAGES = 256
FEWEST_ROWS = 4
FRAME_SEARCH_NS = 30 * SECOND_NS


@dataclass(slots=True)
class Topic:
    """One topic of the log, or the part of it that has one message type.

    `lag_ns` is by how much log time exceeds the samples' times; `pairs` are the streams that a topic of transforms
    splits into. `clock` and `offset_ns` are what the user asked for.
    """

    name: str
    channels: list[Channel]
    reader: Reader | None
    reason: str = ""
    frame: str = ""
    lag_ns: int = 0
    trust_stamps: bool = True
    pairs: tuple[StreamInfo, ...] = ()
    clock: Clock = Clock.HEADER
    offset_ns: int = 0
    decoders: dict[Channel, Decoder] = field(default_factory=dict)
    fixed: dict[Channel, FixedReader] = field(default_factory=dict)

    @property
    def streams(self) -> tuple[StreamInfo, ...]:
        """What the topic is listed as."""
        return self.pairs or (self.info,)

    @property
    def info(self) -> StreamInfo:
        """The topic as one stream."""
        first = [channel.first_ns for channel in self.channels if channel.count]
        last = [channel.last_ns for channel in self.channels if channel.count]
        return StreamInfo(
            name=self.name,
            kind=self.reader.kind if self.reader else StreamKind.UNKNOWN,
            type=self.channels[0].type,
            encoding=self.channels[0].encoding,
            count=sum(channel.count for channel in self.channels),
            first_ns=min(first, default=-1),
            last_ns=max(last, default=-1),
            frame=self.frame,
            definition=definition_text(self.channels[0]),
            readable=not self.reason,
            reason=self.reason,
        )

    def arrival(self, message: Message) -> Arrival:
        """Where and when a message of the topic came."""
        return Arrival(
            self.name,
            min(message.log_ns, LATEST_NS),
            self.trust_stamps,
            ["late_log_time"] if message.log_ns > LATEST_NS else [],
            published_ns=min(message.publish_ns, LATEST_NS),
            clock=self.clock,
            offset_ns=self.offset_ns,
        )

    def rows(self, messages: Sequence[Message]) -> Sequence[Sample | None]:
        """The samples of messages of one channel, as far as they can be made together; none, or None, for others."""
        if not self.at_header_stamps or not self.known(messages[0].channel):
            return ()
        return read_rows(messages, self.name, self.offset_ns)

    @property
    def at_header_stamps(self) -> bool:
        """Whether samples are of the time of their headers, as messages that are decoded together have to be."""
        return self.trust_stamps and self.clock is Clock.HEADER

    @property
    def has_rows(self) -> bool:
        """Whether messages can be decoded together: those of a fixed layout, at their header stamps."""
        return self.at_header_stamps and any(map(self.known, self.channels))

    def known(self, channel: Channel) -> bool:
        """Whether the layout of a channel's messages is known."""
        decode = self.decoders.get(channel)
        return channel in self.fixed or (decode is not None and has_fixed_layout(decode))

    def array(self, messages: Sequence[Message], columns: np.dtype[np.void]) -> StructuredArray:
        """The samples of messages as rows, as `readers.sample_arrays` has them, in the order of the messages."""
        places: dict[Channel, list[int]] = {}
        for place, message in enumerate(messages):
            places.setdefault(message.channel, []).append(place)
        rows = blank(len(messages), columns)
        for channel, own in places.items():
            written = np.zeros(len(own), bool)
            if self.known(channel):
                together = blank(len(own), columns)
                written = fill_rows([messages[place] for place in own], self.offset_ns, together)
                rows[np.array(own)[written]] = together[written]
            alone = [place for place, done in zip(own, written, strict=True) if not done]
            if alone:
                rows[alone] = rows_of([sample for place in alone for sample in self.samples(messages[place])], columns)
        return rows

    def samples(self, message: Message) -> Iterator[Sample]:
        """The samples of one message; a `Problem` if it cannot be made into any."""
        assert self.reader is not None
        try:
            arrival = self.arrival(message)
            fixed = self.fixed.get(message.channel)
            if fixed is not None and (sample := fixed(message.data, arrival)) is not None:
                yield sample
                return
            decoded = self.decoders[message.channel](message.data)
            yield from samples_of(self.reader, decoded, arrival)
        except MessageError as error:
            stream = self.pairs[0].name if self.pairs else self.name
            yield Problem(
                stream=stream,
                t_ns=min(message.log_ns - self.lag_ns, LATEST_NS),
                received_ns=min(message.log_ns, LATEST_NS),
                kind=self.reader.kind,
                reason=str(error),
            )


class LogRecording(Recording):
    """A recording that consists of messages in one file or several.

    Args:
        path: what the user opened.
        logs: the files of the log.
        options: which frame pairs of tf are wanted.
        form: what the whole was taken for; the format of the first file if empty.
        notes: choices made while opening.
        scratch: a temporary folder that the recording needs until it is closed.
        losses: what is lost of the log beside what its files lost.
    """

    def __init__(
        self,
        path: Path,
        logs: Sequence[MessageLog],
        options: ReadOptions,
        *,
        form: str = "",
        notes: Sequence[str] = (),
        scratch: TemporaryDirectory[str] | None = None,
        losses: Sequence[Loss] = (),
    ) -> None:
        self.path = path
        self.format = form or logs[0].format
        self._logs = tuple(logs)
        self._options = options
        self._scratch = scratch
        self._losses = tuple(losses)
        self.notes = (*notes, *options.clock_notes(), *dict.fromkeys(note for log in logs for note in log.notes))
        self._topics = self._list_topics()
        listed = (info for topic in self._topics for info in topic.streams)
        self._streams = tuple(sorted(listed, key=lambda info: info.name))

    # ------------------------------------------------------------------------------ streams

    def _list_topics(self) -> tuple[Topic, ...]:
        grouped: dict[tuple[str, str, str], list[Channel]] = {}
        for log in self._logs:
            for channel in log.channels:
                grouped.setdefault((channel.topic, channel.type, channel.encoding), []).append(channel)
        names: set[str] = set()
        topics = []
        clocks, offsets = dict(self._options.clocks), dict(self._options.offsets_ns)
        for (name, type_name, _), channels in grouped.items():
            if name in names:
                name = f"{name} [{type_name}]"
            names.add(name)
            topic = self._topic(name, channels)
            topic.clock, topic.offset_ns = clocks.get(name, Clock.HEADER), offsets.get(name, 0)
            topics.append(topic)
        for topic in topics:
            if not topic.reason and topic.reader is not None:
                self._look_at(topic)
        return tuple(topics)

    def _topic(self, name: str, channels: list[Channel]) -> Topic:
        type_name = channels[0].type
        topic = Topic(name=name, channels=channels, reader=reader_of(type_name))
        try:
            if topic.reader is None:
                topic.reason = f"no reader for type {type_name}" if type_name else "the file has no schema for it"
            for channel in channels:
                fixed = fixed_reader(channel)
                if fixed is not None:
                    topic.fixed[channel] = fixed
                    topic.decoders[channel] = partial(_decode_late, channel)
                    continue
                known = topic.reader or channel.encoding not in ("ros1", "cdr")
                decoder = decoder_of(channel, self.definitions) if known else None
                if decoder is not None and topic.reader is not None:
                    topic.decoders[channel] = decoder
        except MessageError as error:
            topic.reason = str(error)
        return topic

    def _look_at(self, topic: Topic) -> None:
        """Learn from the first messages of a topic what its stamps are worth and what frame it is in."""
        assert topic.reader is not None
        if topic.reader.splits:
            self._find_pairs(topic)
            return
        stamps: list[tuple[int, int]] = []
        for message in itertools.islice(self._messages(topic.channels), FIRST_MESSAGES):
            try:
                if topic.clock is Clock.PUBLISH:
                    stamps.append((message.log_ns, message.publish_ns))
                if message.channel in topic.fixed and (found := header_of(message.data)) is not None:
                    topic.frame = topic.frame or found[1]
                    if topic.clock is Clock.HEADER:
                        stamps.append((message.log_ns, found[0]))
                    continue
                decoded = topic.decoders[message.channel](message.data)
                list(samples_of(topic.reader, decoded, Arrival(topic.name, message.log_ns)))
                topic.frame = topic.frame or frame_of(decoded)
                stamp = header_stamp(decoded)
                if stamp is not None and topic.clock is Clock.HEADER:
                    stamps.append((message.log_ns, stamp_ns(stamp)))
            except UnsupportedError as error:
                topic.reason = str(error)
                if isinstance(error, OtherUseError):
                    topic.reader = None
                return
            except MessageError:
                continue
        self._judge_clock(topic, stamps)

    def _judge_clock(self, topic: Topic, stamps: list[tuple[int, int]]) -> None:
        """Decide from pairs (log time, stamp) whether the stamps are a clock, and how far off it is."""
        topic.lag_ns = -topic.offset_ns
        lags = [log_ns - own_ns for log_ns, own_ns in stamps if sane_stamp(own_ns, log_ns)]
        log_times, own_times = {pair[0] for pair in stamps}, {pair[1] for pair in stamps}
        topic.trust_stamps = len(log_times) < 3 or len(own_times) > 1
        if stamps and not lags and topic.clock is Clock.PUBLISH:
            self._note(f"{topic.name}: it has no publish times of the log's epoch; log time is used.")
        elif stamps and not lags:
            self._note(f"{topic.name}: {_epochs(*stamps[0])}; log time is used.")
        elif not topic.trust_stamps:
            self._note(f"{topic.name}: the header stamps do not advance; log time is used.")
        elif lags:
            topic.lag_ns += int(statistics.median(lags))

    def _find_pairs(self, topic: Topic) -> None:
        """List the frame pairs of a topic of transforms: those that were asked for, or those that come first."""
        whole = topic.info
        stop_ns = whole.first_ns + FRAME_SEARCH_NS
        times: dict[str, list[int]] = {}
        lags: list[int] = []
        wanted = {pair_stream(topic.name, *pair) for pair in self._options.pose_frames}
        problems = 0
        for message in self._messages(topic.channels, None, stop_ns) if whole.count else ():
            for sample in topic.samples(message):
                if isinstance(sample, Problem):
                    problems += 1
                elif not wanted or sample.stream in wanted:
                    times.setdefault(sample.stream, []).append(sample.received_ns)
                    lags.append(sample.received_ns - sample.t_ns)
        seen_all = whole.last_ns < stop_ns
        if not seen_all and not wanted:
            self._note(f"{topic.name}: frame pairs were looked for in its first {FRAME_SEARCH_NS // SECOND_NS} s; "
                       "name others by pose_frames.")  # fmt: skip
        names = sorted(wanted or times)
        counts = {name: len(times.get(name, ())) + problems * (name == names[0]) for name in names}
        topic.lag_ns = int(statistics.median(lags)) if lags else 0
        topic.pairs = tuple(
            StreamInfo(
                name=name,
                kind=StreamKind.POSE,
                type=whole.type,
                encoding=whole.encoding,
                count=counts[name] if seen_all else -1,
                first_ns=min(times.get(name, ()), default=-1),
                last_ns=max(times.get(name, ()), default=-1) if seen_all else whole.last_ns,
                frame=name.rpartition(":")[2].partition("->")[0],
                definition=whole.definition,
            )
            for name in names
        )
        if not topic.pairs and whole.count:
            topic.reason = "no frame pair was found in it"

    def _note(self, sentence: str) -> None:
        if sentence not in self.notes:
            self.notes = (*self.notes, sentence)

    @property
    def streams(self) -> tuple[StreamInfo, ...]:
        """All streams, readable or not, in the order of their names."""
        return self._streams

    @property
    def damage(self) -> tuple[Damage, ...]:
        """What of the files is damaged, as far as they were read by now."""
        own = tuple(loss.damage for loss in self._losses)
        if len(self._logs) == 1:
            return (*own, *self._logs[0].damage)
        return own + tuple(
            Damage(what=harm.what, where=f"{log.path.name}, {harm.where}", affected=harm.affected)
            for log in self._logs
            for harm in log.damage
        )

    @property
    def losses(self) -> tuple[Loss, ...]:
        """What of the files could not be read, as far as they were read by now, in the form that can be counted."""
        return (*self._losses, *(loss for log in self._logs for loss in log.losses))

    @property
    def cache_troubles(self) -> tuple[str, ...]:
        """What was wrong with the cache of indexes, one sentence each."""
        return tuple(log.cached.trouble for log in self._logs if log.cached is not None and log.cached.trouble)

    def extras(self) -> Extras:
        """Attachments and metadata, which MCAP files can have; those that are lost become damage."""
        found = Extras()
        for log in self._logs:
            found.add(log.extras())
        return found

    @property
    def definitions(self) -> Definitions:
        """Where definitions are looked up that the log does not have."""
        return Definitions(self._options.distribution, self._options.msg_folder)

    @property
    def channels(self) -> tuple[Channel, ...]:
        """The channels of all files."""
        return tuple(channel for log in self._logs for channel in log.channels)

    def messages(
        self, channels: Collection[Channel] | None = None, start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[Message]:
        """The messages of `channels` (all if None) as they are stored, in the order of their log times.

        Those with ``start_ns <= log time < stop_ns``, as far as they can be read.
        """
        return self._messages(self.channels if channels is None else channels, start_ns, stop_ns)

    # ------------------------------------------------------------------------------ cameras

    @cached_property
    def _cameras(self) -> dict[str, Camera]:
        infos = [t for t in self._topics if t.reader and t.reader.kind is StreamKind.CAMERA and not t.reason]
        found: dict[str, Camera | None] = {}

        def first(topic: Topic) -> Camera | None:
            if topic.name not in found:
                samples = (s for s in self.read([topic.name]) if isinstance(s, CameraInfo))
                found[topic.name] = next((s.camera for s in samples), None)
            return found[topic.name]

        cameras = {}
        for topic in self._topics:
            if topic.reader is None or topic.reader.kind is not StreamKind.IMAGE or topic.reason:
                continue
            match = _camera_topic(topic, infos)
            if match is not None and (camera := first(match)) is not None:
                cameras[topic.name] = camera
        return cameras

    @property
    def cameras(self) -> dict[str, Camera]:
        """Intrinsics by image stream, from the first message of the camera topic that belongs to it."""
        return self._cameras

    # ------------------------------------------------------------------------------ reading

    def _messages(
        self, channels: Collection[Channel], start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[Message]:
        sources: list[Iterable[Source]] = []
        for log in self._logs:
            own = [channel for channel in log.channels if channel in channels]
            if own:
                sources.append(log.sources(own, start_ns, stop_ns))
        return in_log_order(heapq.merge(*sources, key=attrgetter("first_ns")))

    def read(
        self,
        streams: Sequence[str] | None = None,
        start_ns: int | None = None,
        stop_ns: int | None = None,
    ) -> Iterator[Sample]:
        """Yield samples merged by time, see `Recording.read`."""
        wanted = self._wanted(streams)
        groups = [self._read_group(g, wanted, start_ns, stop_ns) for g in self._clock_groups(wanted)]
        return groups[0] if len(groups) == 1 else merge(*groups)

    def arrays(
        self, stream: str, start_ns: int | None = None, stop_ns: int | None = None, *, rows: int = ARRAY_ROWS
    ) -> Iterator[StructuredArray]:
        """The samples of a stream as rows, see `Recording.arrays`; IMU and odometry in CDR without samples between."""
        columns = row_type(self.stream(stream))
        self._wanted([stream])
        topic = next(t for t in self._topics if any(info.name == stream for info in t.streams))
        if not topic.has_rows:
            return super().arrays(stream, start_ns, stop_ns, rows=rows)
        messages = self._messages(topic.channels, *self._log_range([topic], start_ns, stop_ns))
        batches = iter(lambda: list(itertools.islice(messages, min(rows, BATCH_MESSAGES))), [])
        pieces = gathered((topic.array(batch, columns) for batch in batches), rows)
        ordered = reordered(pieces, lag_ns=topic.lag_ns)
        return (found for piece in ordered if len(found := within(piece, start_ns, stop_ns)))

    def arrivals(self, streams: Sequence[str] | None = None) -> Iterator[Sample]:
        """Yield samples in the order of the log, see `Recording.arrivals`."""
        wanted = self._wanted(streams)
        by_channel = {
            channel: topic
            for topic in self._topics
            if any(info.name in wanted for info in topic.streams)
            for channel in topic.channels
        }
        return (sample for sample in _samples(self._messages(by_channel), by_channel) if sample.stream in wanted)

    def _wanted(self, streams: Sequence[str] | None) -> frozenset[str]:
        if streams is None:
            return frozenset(info.name for info in self.streams if info.readable)
        for name in streams:
            info = self.stream(name)
            if not info.readable:
                raise StreamError(f"{self.path}: the stream {name!r} cannot be read: {info.reason}")
        return frozenset(streams)

    def _clock_groups(self, wanted: Collection[str]) -> list[list[Topic]]:
        """The topics of the wanted streams, those together whose clocks agree to half the reorder window."""
        groups: list[list[Topic]] = []
        topics = [t for t in self._topics if any(info.name in wanted for info in t.streams)]
        for topic in sorted(topics, key=lambda t: t.lag_ns):
            if groups and topic.lag_ns - groups[-1][0].lag_ns <= REORDER_WINDOW_NS // 2:
                groups[-1].append(topic)
            else:
                groups.append([topic])
        return groups

    def _log_range(
        self, topics: Sequence[Topic], start_ns: int | None, stop_ns: int | None
    ) -> tuple[int | None, int | None]:
        """The log times between which the samples of a range of time can lie; topics in the order of their lags."""
        return (
            None if start_ns is None else start_ns + topics[0].lag_ns - SLACK_NS,
            None if stop_ns is None else stop_ns + topics[-1].lag_ns + SLACK_NS,
        )

    def _read_group(
        self, topics: list[Topic], wanted: Collection[str], start_ns: int | None, stop_ns: int | None
    ) -> Iterator[Sample]:
        """Samples of topics with about the same lag, in the order of their stamps."""
        high = topics[-1].lag_ns
        by_channel = {channel: topic for topic in topics for channel in topic.channels}
        messages = self._messages(by_channel, *self._log_range(topics, start_ns, stop_ns))
        samples = (sample for sample in _samples(messages, by_channel) if sample.stream in wanted)
        for sample in reorder(samples, lag_ns=high):
            if (start_ns is None or sample.t_ns >= start_ns) and (stop_ns is None or sample.t_ns < stop_ns):
                yield sample

    def count_before(self, stream: str, t_ns: int) -> int:
        """See `Recording.count_before`; by the index up to shortly before `t_ns`."""
        self._wanted([stream])
        topic = next(t for t in self._topics if any(info.name == stream for info in t.streams))
        if topic.pairs:
            return super().count_before(stream, t_ns)
        lower, upper = t_ns + topic.lag_ns - SLACK_NS, t_ns + topic.lag_ns + SLACK_NS
        before = sum(log.count_before([c for c in log.channels if c in topic.channels], lower) for log in self._logs)
        near = self._messages(topic.channels, lower, upper)
        return before + sum(sample.t_ns < t_ns for message in near for sample in topic.samples(message))

    def close(self) -> None:
        """Release the files and temporary copies."""
        for log in self._logs:
            log.close()
        if self._scratch is not None:
            self._scratch.cleanup()


def _samples(messages: Iterable[Message], by_channel: Mapping[Channel, Topic]) -> Iterator[Sample]:
    """The samples of messages, in their order; they are decoded together, in batches that end before they are large."""
    batch: list[Message] = []
    size = 0
    for message in messages:
        batch.append(message)
        size += len(message.data)
        if size >= BATCH_BYTES or len(batch) >= BATCH_MESSAGES:
            yield from _batch_samples(batch, by_channel)
            batch, size = [], 0
    yield from _batch_samples(batch, by_channel)


def _batch_samples(batch: list[Message], by_channel: Mapping[Channel, Topic]) -> Iterator[Sample]:
    places: dict[Channel, list[int]] = {}
    for place, message in enumerate(batch):
        places.setdefault(message.channel, []).append(place)
    ready: list[Sample | None] = [None] * len(batch)
    for channel, own in places.items():
        if len(own) >= FEWEST_ROWS:
            for place, sample in zip(own, by_channel[channel].rows([batch[place] for place in own]), strict=False):
                ready[place] = sample
    for message, sample in zip(batch, ready, strict=True):
        if sample is not None:
            yield sample
        else:
            yield from by_channel[message.channel].samples(message)


def _decode_late(channel: Channel, data: Buffer) -> Any:
    """Decode a message of a channel whose decoder is seldom needed; it is made with the first."""
    return decoder_of(channel)(data)


def _camera_topic(image: Topic, infos: list[Topic]) -> Topic | None:
    """The camera topic of an image topic: the one in its namespace, else the only one in its frame."""
    parts = image.name.split("/")
    for length in (len(parts) - 1, len(parts) - 2 if parts[-1].startswith("compressed") else 0):
        space = "/".join(parts[:length])
        beside = [info for info in infos if length and info.name.rpartition("/")[0] == space]
        named = [info for info in beside if info.name.endswith("/camera_info")] or beside
        if len(named) == 1:
            return named[0]
    framed = [info for info in infos if image.frame and info.frame == image.frame]
    return framed[0] if len(framed) == 1 else None


def _epochs(log_ns: int, own_ns: int) -> str:
    """A clause that says how a log time and a header stamp of different epochs differ."""
    units = {"microseconds": 1_000, "milliseconds": 1_000_000, "seconds": 1_000_000_000}
    unit = next((name for name, factor in units.items() if sane_stamp(own_ns, log_ns * factor)), None)
    guess = f" (it looks like {unit} written as nanoseconds)" if unit else ""
    return f"header stamps are of {_date(own_ns)}, log time of {_date(log_ns)}{guess}"


def _date(t_ns: int) -> str:
    """UTC of a time stamp, to the day."""
    return str(np.datetime64(t_ns // SECOND_NS, "s"))[:10] if 0 <= t_ns < 2**63 else f"{t_ns} ns"
