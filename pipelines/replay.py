"""The loop: Recording + estimator → steps.

The recording is read and the estimator runs in the caller's thread; images are decoded ahead in one other
thread, in order, at most `decode_ahead` of them, so that memory is bounded and nothing depends on timing.

Frames are numbered 0, 1, … within the image stream of the whole recording, undecodable ones included. With
a window, the frames before it are counted by `Recording.count_before` without decoding them, so that a
frame has the same number in every replay of its recording.
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
from readers.streams import ImageError, ImageSample, Problem, Recording, Sample, StreamKind

OnProgress = Callable[[int, int], None]


@dataclass(frozen=True, slots=True)
class Replayed:
    """One frame of a replay.

    `sample` is the image as it was stored, or the `Problem` that stands for an image that could not be
    decoded; both carry the frame's number. `step` is what the estimator made of it.
    """

    sample: ImageSample | Problem
    step: Step


def replay(
    recording: Recording,
    estimator: Estimator[Any],
    *,
    image_stream: str,
    other_streams: Sequence[str] = (),
    start_ns: int | None = None,
    stop_ns: int | None = None,
    stride: int = 1,
    decode_ahead: int = 4,
    on_progress: OnProgress | None = None,
) -> Generator[Replayed]:
    """Run an estimator over a recording, as fast as it goes; yield every step with its image.

    The estimator gets each image as an `ImageSample` with the encoding ``mono8`` (``mono16`` for 16-bit
    images) whose payload is the decoded grey image, an image that cannot be decoded as a `Problem` of kind
    IMAGE, and the samples of `other_streams` as they are, all in the order of time. Closing the iterator
    stops the decoding thread at once.

    Args:
        recording: where the samples come from.
        estimator: takes every sample; makes a Step of every frame that it is to be judged by.
        image_stream: name of the stream of frames.
        other_streams: names of further streams that the estimator uses.
        start_ns: first sensor time of the window (included), None for the start of the recording.
        stop_ns: last sensor time of the window (excluded), None for its end.
        stride: use every n-th frame of the window; the others are not decoded.
        decode_ahead: how many images are decoded ahead of the estimator.
        on_progress: called after each step with the number of steps so far and the frame's time in ns.

    Raises:
        ValueError: `stride` or `decode_ahead` is below 1.
        StreamError: a stream is not in the recording.
        RecordingError: nothing more of the file can be read; the steps before it were yielded.
    """
    if stride < 1 or decode_ahead < 1:
        raise ValueError(f"stride and decode_ahead must be 1 or more, not {stride} and {decode_ahead}")
    for name in (image_stream, *other_streams):
        recording.stream(name)
    first = 0 if start_ns is None else recording.count_before(image_stream, start_ns)
    samples = recording.read([image_stream, *other_streams], start_ns, stop_ns)
    chosen = _numbered(samples, image_stream, first, stride)
    return _steps(_decoded_ahead(chosen, decode_ahead), estimator, image_stream, on_progress)


def _steps(
    samples: Generator[tuple[Sample, Sample]],
    estimator: Estimator[Any],
    image_stream: str,
    on_progress: OnProgress | None,
) -> Generator[Replayed]:
    """Give every decoded sample to the estimator; yield the frames' steps."""
    state = estimator.start()
    done = 0
    with contextlib.closing(samples):
        for original, decoded in samples:
            try:
                state, step = estimator.step(state, decoded)
            except Exception as error:
                error.add_note(_where(decoded))
                raise
            shown = decoded if isinstance(decoded, Problem) else original
            if step is None or shown.stream != image_stream or not isinstance(shown, ImageSample | Problem):
                continue
            done += 1
            if on_progress is not None:
                on_progress(done, shown.t_ns)
            yield Replayed(shown, step)


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
        if sample.stream != image_stream or not isinstance(sample, ImageSample | Problem):
            yield sample
            continue
        if (frame - first) % stride == 0:
            yield dataclasses.replace(sample, frame=frame)
        frame += 1


def _decoded_ahead(samples: Iterator[Sample], ahead: int) -> Generator[tuple[Sample, Sample]]:
    """Yield every sample with its decoded form, in order, with at most `ahead` images under way."""
    waiting: deque[tuple[Sample, Future[Sample]]] = deque()
    images = 0
    pool = ThreadPoolExecutor(1, thread_name_prefix="decode")
    try:
        for sample, future in _submitted(samples, pool):
            waiting.append((sample, future))
            images += isinstance(sample, ImageSample)
            while waiting and (images > ahead or not isinstance(waiting[0][0], ImageSample)):
                sample, future = waiting.popleft()
                images -= isinstance(sample, ImageSample)
                yield sample, future.result()
        while waiting:
            sample, future = waiting.popleft()
            yield sample, future.result()
    finally:
        pool.shutdown(cancel_futures=True)


def _submitted(samples: Iterator[Sample], pool: ThreadPoolExecutor) -> Iterator[tuple[Sample, Future[Sample]]]:
    """Pair every sample with the future of its decoded form.

    An error of the reader is held back until the samples before it are through: it is the result of
    one last future.
    """
    last = Sample(stream="", t_ns=0, received_ns=0)
    try:
        for last in samples:
            yield last, pool.submit(grey_sample, last) if isinstance(last, ImageSample) else _settled(last)
    except Exception as error:
        error.add_note(f"after {_where(last)[3:]}" if last.stream else "before the first sample")
        yield last, _settled(error)


def _settled(outcome: Sample | Exception) -> Future[Sample]:
    """A future that is done."""
    future: Future[Sample] = Future()
    if isinstance(outcome, Exception):
        future.set_exception(outcome)
    else:
        future.set_result(outcome)
    return future


def _where(sample: Sample) -> str:
    """Frame and time of a sample, for a note on an error."""
    frame = getattr(sample, "frame", -1)
    number = f"frame {frame} of " if frame >= 0 else "a sample of "
    return f"at {number}{sample.stream}, sensor time {sample.t_ns} ns"
