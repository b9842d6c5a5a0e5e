"""A recording as the user says it is: other times, another camera.

Logs of messages choose clock and offset where their samples are made, so that reading stays one pass; for every
other recording they are applied here. Cameras from a file replace the recording's own for all of them.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
from collections.abc import Iterator, Mapping, Sequence

from readers.camera_files import plain_topic, read_camera, read_cameras, scaled
from readers.clock import merge
from readers.extras import Extras
from readers.log_recording import LogRecording
from readers.sample_arrays import ARRAY_ROWS, StructuredArray
from readers.streams import (
    Camera,
    CameraFile,
    Clock,
    Damage,
    ImageError,
    ImageSample,
    Landmark,
    ReadOptions,
    Recording,
    Sample,
    StreamError,
    StreamInfo,
    StreamKind,
)

FIRST_IMAGES = 20


def adjusted(recording: Recording, options: ReadOptions) -> Recording:
    """The recording with the clocks, offsets and cameras of the options; itself where nothing is asked for.

    Raises:
        StreamError: a stream that is named is not there, or has no such clock.
        RecordingError: the file of a camera cannot be used.
    """
    known = {topic_of(info) for info in recording.streams}
    for topic in [*dict(options.clocks), *dict(options.offsets_ns)]:
        if topic not in known:
            there = ", ".join(sorted(known)) or "none"
            raise StreamError(f"{recording.path}: no stream {topic!r} to set the times of; there are: {there}")
    cameras, notes = _cameras(recording, options)
    clocked = bool(options.clocks or options.offsets_ns) and not isinstance(recording, LogRecording)
    if not (clocked or cameras):
        return recording
    return Adjusted(recording, options, cameras=cameras, notes=notes)


def _cameras(recording: Recording, options: ReadOptions) -> tuple[dict[str, Camera], list[str]]:
    """The cameras that take the place of the recording's own, by image stream, and what is to be said of them."""
    images = [info.name for info in recording.of_kind(StreamKind.IMAGE)]
    found: dict[str, Camera] = {}
    notes: list[str] = []
    for file in options.cameras:
        for topic in _topics_of(recording, file, images):
            calibration = read_camera(file.path, name=file.name, topic=topic)
            found[topic] = calibration.camera
            notes += calibration.notes
    if options.scale_cameras:
        for topic, camera in (recording.cameras | found).items():
            size = image_size(recording, topic)
            if camera.calibrated and size is not None and size != (camera.width_px, camera.height_px):
                try:
                    found[topic] = scaled(camera, *size)
                except ValueError as error:
                    raise StreamError(f"{recording.path}: {topic} cannot be scaled to: {error}") from error
                old = f"{camera.width_px} x {camera.height_px}"
                notes.append(f"{topic}: its calibration for {old} px is scaled to {size[0]} x {size[1]} px, as asked.")
    return found, notes


def _topics_of(recording: Recording, file: CameraFile, images: list[str]) -> list[str]:
    """The streams of images that the camera of a file is for."""
    if file.topic:
        if file.topic not in images:
            there = ", ".join(images) or "none"
            raise StreamError(f"{recording.path}: no images named {file.topic!r} for {file.path}; there are: {there}")
        return [file.topic]
    if len(images) == 1:
        return images
    named = {plain_topic(c.topic) for c in read_cameras(file.path) if c.topic and file.name in ("", c.name, c.topic)}
    matching = [topic for topic in images if plain_topic(topic) in named]
    if not matching:
        there = ", ".join(images) or "none"
        raise StreamError(
            f"{recording.path}: which images is {file.path} for? Write --camera TOPIC={file.path}; there are: {there}"
        )
    return matching


def image_size(recording: Recording, topic: str) -> tuple[int, int] | None:
    """Width and height in px of the first image of a stream, None where none can be told."""
    for sample in itertools.islice(recording.read([topic]), FIRST_IMAGES):
        if isinstance(sample, ImageSample):
            if sample.width_px:
                return sample.width_px, sample.height_px
            with contextlib.suppress(ImageError):
                height, width = sample.grey().shape
                return width, height
    return None


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
    def cache_troubles(self) -> tuple[str, ...]:
        """What was wrong with the cache of indexes."""
        return self._inner.cache_troubles

    def extras(self) -> Extras:
        """Attachments and metadata of the log."""
        return self._inner.extras()

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

    def arrays(
        self, stream: str, start_ns: int | None = None, stop_ns: int | None = None, *, rows: int = ARRAY_ROWS
    ) -> Iterator[StructuredArray]:
        """The samples of a stream as rows, see `Recording.arrays`."""
        if stream in self._by_log or stream in self._offsets:
            return super().arrays(stream, start_ns, stop_ns, rows=rows)
        return self._inner.arrays(stream, start_ns, stop_ns, rows=rows)

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
