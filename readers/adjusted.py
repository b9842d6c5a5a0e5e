"""A recording as the user says it is: other times, another camera.

Logs of messages choose clock and offset where their samples are made, so that reading stays one pass; for every
other recording they are applied here. Cameras from a file replace the recording's own for all of them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence

from readers.clock import merge
from readers.log_recording import LogRecording
from readers.streams import (
    Camera,
    Clock,
    Damage,
    Landmark,
    ReadOptions,
    Recording,
    Sample,
    StreamError,
    StreamInfo,
)


def adjusted(recording: Recording, options: ReadOptions) -> Recording:
    """The recording with the clocks and offsets of the options; itself where nothing is asked for.

    Raises:
        StreamError: a stream that is named is not there, or has no such clock.
    """
    if not (options.clocks or options.offsets_ns):
        return recording
    known = {topic_of(info) for info in recording.streams}
    for topic in [*dict(options.clocks), *dict(options.offsets_ns)]:
        if topic not in known:
            there = ", ".join(sorted(known)) or "none"
            raise StreamError(
                f"{recording.path}: no stream named {topic!r} whose times could be set; there are: {there}"
            )
    return recording if isinstance(recording, LogRecording) else Adjusted(recording, options)


def topic_of(info: StreamInfo) -> str:
    """The name by which the times of a stream are set: its own; that of the topic for a frame pair of tf."""
    topic, colon, pair = info.name.rpartition(":")
    return topic if colon and "->" in pair else info.name


class Adjusted(Recording):
    """A recording with other times for some of its streams.

    Args:
        inner: the recording as it is.
        options: with clocks and offsets.
        cameras: intrinsics that take the place of the recording's own, by image stream.
        notes: what is to be said of them.

    Raises:
        StreamError: publish times are asked for, which only logs of messages have.
    """

    def __init__(
        self,
        inner: Recording,
        options: ReadOptions,
        *,
        cameras: Mapping[str, Camera] | None = None,
        notes: Sequence[str] = (),
    ) -> None:
        self.path, self.format, self._inner = inner.path, inner.format, inner
        own = () if isinstance(inner, LogRecording) else options.clock_notes()
        self.notes = (*inner.notes, *own, *notes)
        self._replaced = dict(cameras or {})
        if isinstance(inner, LogRecording):
            self._offsets: dict[str, int] = {}
            self._by_log: frozenset[str] = frozenset()
            return
        for topic, clock in options.clocks:
            if clock is Clock.PUBLISH:
                raise StreamError(f"{inner.path}: {topic} has no publish times; choose header or log")
        self._by_log = frozenset(topic for topic, clock in options.clocks if clock is Clock.LOG)
        self._offsets = dict(options.offsets_ns)

    @property
    def streams(self) -> tuple[StreamInfo, ...]:
        """All streams."""
        return self._inner.streams

    @property
    def cameras(self) -> dict[str, Camera]:
        """Intrinsics by image stream, the replaced ones first."""
        return self._inner.cameras | self._replaced

    @property
    def landmarks(self) -> dict[int, Landmark]:
        """Surveyed landmarks."""
        return self._inner.landmarks

    @property
    def damage(self) -> tuple[Damage, ...]:
        """What of the file is damaged."""
        return self._inner.damage

    @property
    def identity(self) -> str:
        """See `Recording.identity`; times and cameras are settings, not the recording."""
        return self._inner.identity

    def _moved(self, sample: Sample) -> Sample:
        """A sample at its own time."""
        t_ns = sample.received_ns if sample.stream in self._by_log else sample.t_ns
        t_ns += self._offsets.get(sample.stream, 0)
        return sample if t_ns == sample.t_ns else dataclasses.replace(sample, t_ns=t_ns)

    def read(
        self, streams: Sequence[str] | None = None, start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[Sample]:
        """Yield samples merged by time, see `Recording.read`."""
        wanted = [info.name for info in self.streams if info.readable] if streams is None else list(streams)
        touched = self._by_log | self._offsets.keys()
        rest = [name for name in wanted if name not in touched]
        sources = [self._inner.read(rest, start_ns, stop_ns)] if rest or not wanted else []
        sources += [self._one(name, start_ns, stop_ns) for name in wanted if name in touched]
        return sources[0] if len(sources) == 1 else merge(*sources)

    def _one(self, name: str, start_ns: int | None, stop_ns: int | None) -> Iterator[Sample]:
        """The samples of one stream whose times are set, in their order."""
        if name not in self._by_log:
            offset = self._offsets[name]
            lower, upper = (None if t_ns is None else t_ns - offset for t_ns in (start_ns, stop_ns))
            return map(self._moved, self._inner.read([name], lower, upper))
        return (
            sample
            for sample in map(self._moved, self._inner.arrivals([name]))
            if (start_ns is None or sample.t_ns >= start_ns) and (stop_ns is None or sample.t_ns < stop_ns)
        )

    def arrivals(self, streams: Sequence[str] | None = None) -> Iterator[Sample]:
        """Yield samples in the order in which they were received, see `Recording.arrivals`."""
        return map(self._moved, self._inner.arrivals(streams))

    def count_before(self, stream: str, t_ns: int) -> int:
        """See `Recording.count_before`."""
        if stream in self._by_log:
            return super().count_before(stream, t_ns)
        return self._inner.count_before(stream, t_ns - self._offsets.get(stream, 0))

    def close(self) -> None:
        """Release the file."""
        self._inner.close()
