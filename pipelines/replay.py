"""The loop: Recording + estimator → steps.

The recording is read and the estimator runs in the caller's thread; images are decoded ahead in other threads, at most
`decode_ahead` of them, and taken in order, so that memory is bounded and nothing depends on timing.

Frames are images, pixel tracks or measured landmarks: the samples of one stream. They are numbered 0, 1, …
within that stream of the whole recording, undecodable ones included. With a window, the frames before it are
counted by `Recording.count_before` without decoding them, so that a frame has the same number in every replay
of its recording.
"""

from __future__ import annotations

import contextlib
import dataclasses
import sys
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipelines.estimator import Estimator, Step
from pipelines.latency import LatencyBuffer
from readers.streams import (
    ImageError,
    ImageSample,
    LandmarkSample,
    Problem,
    Recording,
    Sample,
    StreamKind,
    TrackSample,
)

Frame = ImageSample | TrackSample | LandmarkSample | Problem
"""What can stand in a stream of frames; all have a number `frame`."""

OnProgress = Callable[[int, int], None]

OnSample = Callable[[Sample, Sample, Any, Step | None], None]
"""Told after every sample: as it was stored, as the estimator got it, the state after it, and its Step if any."""


@dataclass(frozen=True, slots=True)
class Replayed:
    """One frame of a replay.

    `sample` is the frame as it was stored, or the `Problem` that stands for one that could not be decoded; it
    carries the frame's number. `step` is what the estimator made of it. `shown` is the last image of the stream
    that is only shown, of those since the frame before; None where there is none.
    """

    sample: Frame
    step: Step
    shown: ImageSample | Problem | None = None


def replay(
    recording: Recording,
    estimator: Estimator[Any],
    *,
    image_stream: str,
    other_streams: Sequence[str] = (),
    shown_stream: str = "",
    start_ns: int | None = None,
    stop_ns: int | None = None,
    stride: int = 1,
    latency: LatencyBuffer | None = None,
    decode_ahead: int = 8,
    decode_threads: int = 2,
    on_progress: OnProgress | None = None,
    beside_streams: Sequence[str] = (),
    on_sample: OnSample | None = None,
) -> Generator[Replayed]:
    """Run an estimator over a recording, as fast as it goes; yield every step with its frame.

    The estimator gets each image as an `ImageSample` with the encoding ``mono8`` (``mono16`` for 16-bit
    images) whose payload is the decoded grey image, an image that cannot be decoded as a `Problem` of kind
    IMAGE, and other frames and the samples of `other_streams` as they are, all in the order of time. Closing
    the iterator stops the decoding threads at once.

    Args:
        recording: where the samples come from.
        estimator: takes every sample; makes a Step of every frame that it is to be judged by.
        image_stream: name of the stream of frames: images, pixel tracks or measured landmarks.
        other_streams: names of further streams that the estimator uses.
        shown_stream: name of a stream of images that come with the steps and that the estimator does not get.
        start_ns: first sensor time of the window (included), None for the start of the recording.
        stop_ns: last sensor time of the window (excluded), None for its end.
        stride: use every n-th frame of the window; the others are not decoded.
        latency: a buffer that sorts the samples by time; None: they come as the reader sorts them.
        decode_ahead: how many images are decoded ahead of the estimator.
        decode_threads: by how many threads.
        on_progress: called after each step with the number of steps so far and the frame's time in ns.
        beside_streams: names of streams that only `on_sample` gets; with the state as it is by then.
        on_sample: called after each sample but those that are only shown, in the order in which they came.

    Raises:
        ValueError: `stride`, `decode_ahead` or `decode_threads` is below 1.
        StreamError: a stream is not in the recording.
        RecordingError: nothing more of the file can be read; the steps before it were yielded.
    """
    if min(stride, decode_ahead, decode_threads) < 1:
        given = f"{stride}, {decode_ahead} and {decode_threads}"
        raise ValueError(f"stride, decode_ahead and decode_threads must be 1 or more, not {given}")
    shown = [shown_stream] if shown_stream and shown_stream != image_stream else []
    beside = [name for name in beside_streams if name not in (image_stream, *other_streams, *shown)]
    names = [image_stream, *other_streams, *shown, *beside]
    for name in names:
        recording.stream(name)
    first = 0 if start_ns is None else recording.count_before(image_stream, start_ns)
    if latency is None:
        samples = recording.read(names, start_ns, stop_ns)
    else:
        samples = latency.through(_unsorted(recording, names, start_ns, stop_ns, latency.by_arrival), other_streams)
    chosen = _numbered(samples, image_stream, first, stride)
    ahead = _decoded_ahead(chosen, decode_ahead, decode_threads, [*shown, *beside])
    steps = _steps(ahead, estimator, image_stream, shown, beside, on_sample)
    return _told(_with_shown(steps) if shown else steps, on_progress)


def _unsorted(
    recording: Recording, names: Sequence[str], start_ns: int | None, stop_ns: int | None, by_arrival: bool
) -> Iterator[Sample]:
    """The samples of a window, as they were received or as the reader sorts them."""
    if not by_arrival:
        return recording.read(names, start_ns, stop_ns)
    return (
        sample
        for sample in recording.arrivals(names)
        if (start_ns is None or start_ns <= sample.t_ns) and (stop_ns is None or sample.t_ns < stop_ns)
    )


def _steps(
    samples: Generator[tuple[Sample, Sample]],
    estimator: Estimator[Any],
    frames: str,
    shown: Sequence[str],
    beside: Sequence[str],
    on_sample: OnSample | None,
) -> Generator[Replayed | ImageSample | Problem]:
    """Give every decoded sample to the estimator; yield the frames' steps, and the images that are only shown."""
    state = estimator.start()
    with contextlib.closing(samples):
        for original, decoded in samples:
            if original.stream in shown:
                if isinstance(original, ImageSample | Problem):
                    yield original
                continue
            step = None
            if original.stream not in beside:
                state, step = stepped(estimator, state, decoded)
            if on_sample is not None:
                on_sample(original, decoded, state, step)
            frame = decoded if isinstance(decoded, Problem) else original
            if step is not None and frame.stream == frames and isinstance(frame, Frame):
                yield Replayed(frame, step)


def stepped(estimator: Estimator[Any], state: Any, sample: Sample) -> tuple[Any, Step | None]:
    """Give a sample to an estimator; an error of it has a note that says at which."""
    try:
        return estimator.step(state, sample)
    except Exception as error:
        error.add_note(_where(sample))
        raise


def _with_shown(steps: Generator[Replayed | ImageSample | Problem]) -> Generator[Replayed]:
    """Give each step the last image up to its time; one of the very same time may come after it."""
    image: ImageSample | Problem | None = None
    held: Replayed | None = None
    failed: Exception | None = None
    with contextlib.closing(steps):
        while True:
            try:
                item = next(steps, None)
            except Exception as error:
                item, failed = None, error
            if held is not None and (item is None or isinstance(item, Replayed) or item.t_ns > held.sample.t_ns):
                yield dataclasses.replace(held, shown=image)
                held, image = None, None
            if item is None:
                break
            if isinstance(item, Replayed):
                held = item
            else:
                image = item
    if failed is not None:
        raise failed


def _told(steps: Generator[Replayed | ImageSample | Problem], on_progress: OnProgress | None) -> Generator[Replayed]:
    """The steps, each told to `on_progress` before it is given out."""
    done = 0
    with contextlib.closing(steps):
        for item in steps:
            if isinstance(item, Replayed):
                done += 1
                if on_progress is not None:
                    on_progress(done, item.sample.t_ns)
                yield item


def grey_sample(sample: ImageSample) -> Sample:
    """The decoded form of an image: ``mono8`` or ``mono16``, or a `Problem` where it cannot be decoded."""
    try:
        grey = np.ascontiguousarray(sample.grey())
    except ImageError as error:
        return Problem(
            stream=sample.stream,
            t_ns=sample.t_ns,
            received_ns=sample.received_ns,
            kind=StreamKind.IMAGE,
            reason=str(error),
            frame=sample.frame,
        )
    height, width = grey.shape
    return dataclasses.replace(
        sample,
        encoding="mono16" if grey.dtype == np.uint16 else "mono8",
        payload=grey.data.cast("B"),
        width_px=width,
        height_px=height,
        step_bytes=width * grey.itemsize,
        big_endian=sys.byteorder == "big",
    )


def _numbered(samples: Iterator[Sample], image_stream: str, first: int, stride: int) -> Iterator[Sample]:
    """Number the frames, drop those that the stride leaves out, pass the other streams on."""
    frame = first
    for sample in samples:
        if sample.stream != image_stream or not isinstance(sample, Frame):
            yield sample
            continue
        if (frame - first) % stride == 0:
            yield dataclasses.replace(sample, frame=frame)
        frame += 1


def _decoded_ahead(
    samples: Iterator[Sample], ahead: int, threads: int, shown: Sequence[str] = ()
) -> Generator[tuple[Sample, Sample]]:
    """Yield every sample with its decoded form, in order, with at most `ahead` images under way.

    Images that are only shown stay as they are.
    """
    waiting: deque[tuple[Sample, Future[Sample] | None]] = deque()
    images = 0
    pool = ThreadPoolExecutor(threads, thread_name_prefix="decode")
    try:
        for sample, future in _submitted(samples, pool, shown):
            waiting.append((sample, future))
            images += _decodes(sample, shown)
            while waiting and (images > ahead or not _decodes(waiting[0][0], shown)):
                sample, future = waiting.popleft()
                images -= _decodes(sample, shown)
                yield sample, sample if future is None else future.result()
        while waiting:
            sample, future = waiting.popleft()
            yield sample, sample if future is None else future.result()
    finally:
        pool.shutdown(cancel_futures=True)


def _decodes(sample: Sample, shown: Sequence[str]) -> bool:
    """Whether a sample is an image that the estimator gets."""
    return isinstance(sample, ImageSample) and sample.stream not in shown


def _submitted(
    samples: Iterator[Sample], pool: ThreadPoolExecutor, shown: Sequence[str]
) -> Iterator[tuple[Sample, Future[Sample] | None]]:
    """Pair every sample with the future of its decoded form, None where it stays as it is.

    An error of the reader is held back until the samples before it are through: it is the result of
    one last future.
    """
    last = Sample(stream="", t_ns=0, received_ns=0)
    try:
        for last in samples:
            if isinstance(last, ImageSample) and _decodes(last, shown):
                yield last, pool.submit(grey_sample, last)
            else:
                yield last, None
    except Exception as error:
        error.add_note(f"after {_where(last)[3:]}" if last.stream else "before the first sample")
        failed: Future[Sample] = Future()
        failed.set_exception(error)
        yield last, failed


def _where(sample: Sample) -> str:
    """Frame and time of a sample, for a note on an error."""
    frame = getattr(sample, "frame", -1)
    number = f"frame {frame} of " if frame >= 0 else "a sample of "
    return f"at {number}{sample.stream}, sensor time {sample.t_ns} ns"
