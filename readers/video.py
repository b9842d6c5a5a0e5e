"""Video files: anything that OpenCV opens, as a stream of decoded frames."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from fractions import Fraction
from itertools import takewhile
from pathlib import Path
from typing import Any

import cv2

from readers.frame_times import frame_period_ns
from readers.images import image_header
from readers.streams import (
    Damage,
    ImageSample,
    Problem,
    ReadOptions,
    Recording,
    RecordingError,
    Sample,
    StreamInfo,
    StreamKind,
)

STREAM = "frames"
PLAUSIBLE_RATE_HZ = (0.01, 10_000)
HEAD_BYTES = 4096

os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # libraries never print; errors come as RecordingError


def open_video(path: Path, options: ReadOptions | None = None) -> Recording:
    """Open a video file.

    Args:
        path: the file.
        options: `rate_hz` overrides the frame rate that the file states.

    Returns:
        A recording with one image stream, ``frames``.

    Raises:
        RecordingError: the file is of no known format, no frame can be decoded, or its rate is not known.
    """
    path, options = Path(path), options or ReadOptions()
    _refuse_others(path)
    return VideoRecording(path, options)


class VideoRecording(Recording):
    """Frames of a video, decoded one after the other; frame k is at k / rate from 0.

    The number of frames that the container states is checked whenever the video is read to its end.
    """

    def __init__(self, path: Path, options: ReadOptions) -> None:
        self.path = path
        capture = _capture(path)
        try:
            stated = capture.get(cv2.CAP_PROP_FRAME_COUNT)
            rate = options.rate_hz if options.rate_hz is not None else capture.get(cv2.CAP_PROP_FPS)
            codec = int(capture.get(cv2.CAP_PROP_FOURCC)).to_bytes(4, "little", signed=True)
            if not capture.grab() or (stated <= 0 and codec == bytes(4)):
                raise _unknown(path)
            self._rate_hz = _checked_rate(path, rate, given=options.rate_hz is not None)
            counted = stated <= 0
            self._count = 1 + _grab_all(capture) if counted else int(stated)
        finally:
            capture.release()
        self._damage: tuple[Damage, ...] = ()
        name = codec.decode("ascii", "replace").strip("\0 ")
        name = name if name.isprintable() and name else "raw"
        self.format = f"video ({name})"
        source = "given" if options.rate_hz is not None else "stated in the file"
        self.notes = (
            f"frames: a video has no sensor clock; frame k is at k / {self._rate_hz:g} s (the rate {source}), from 0",
        )
        if counted:
            self.notes += (f"frames: the file does not state how many frames it holds; {self._count} were counted",)

    @property
    def streams(self) -> tuple[StreamInfo, ...]:
        """See `Recording.streams`."""
        return (
            StreamInfo(
                name=STREAM,
                kind=StreamKind.IMAGE,
                type="decoded video frame",
                encoding="bgr8",
                count=self._count,
                first_ns=0 if self._count else -1,
                last_ns=self._time(self._count - 1) if self._count else -1,
            ),
        )

    @property
    def damage(self) -> tuple[Damage, ...]:
        """That frames are missing at the end, once they were looked for."""
        return self._damage

    def read(
        self,
        streams: Sequence[str] | None = None,
        start_ns: int | None = None,
        stop_ns: int | None = None,
    ) -> Iterator[Sample]:
        """See `Recording.read`; the frames before `start_ns` are skipped by index."""
        for name in streams or ():
            self.stream(name)
        if streams is not None and STREAM not in streams:
            return iter(())
        first = 0 if start_ns is None else self._index_from(start_ns)
        stop = None if stop_ns is None else self._index_from(stop_ns)
        return self._frames(first, stop)

    def count_before(self, stream: str, t_ns: int) -> int:
        """See `Recording.count_before`; by the frame rate."""
        self.stream(stream)
        return min(self._index_from(t_ns), self._count)

    def _frames(self, first: int, stop: int | None) -> Iterator[Sample]:
        if stop is not None and stop <= first:
            return
        capture = _capture(self.path)
        try:
            index = first
            if not _seek(capture, first):
                capture.release()
                capture = _capture(self.path)
                index = sum(1 for _ in takewhile(lambda _: capture.grab(), range(first)))
            while stop is None or index < stop:
                intact, frame = capture.read()
                if not intact:
                    self._ended(index)
                    return
                yield self._sample(index, frame)
                index += 1
        finally:
            capture.release()

    def _sample(self, index: int, frame: Any) -> Sample:
        t_ns = self._time(index)
        source = f"frame {index}"
        if frame.ndim != 3 or frame.shape[2] != 3:
            reason = f"{source}: decoded to shape {frame.shape}, not to colour"
            return Problem(stream=STREAM, t_ns=t_ns, received_ns=t_ns, kind=StreamKind.IMAGE, reason=reason)
        height, width, _ = frame.shape
        return ImageSample(
            stream=STREAM,
            t_ns=t_ns,
            received_ns=t_ns,
            encoding="bgr8",
            payload=frame.data.cast("B").toreadonly(),
            width_px=width,
            height_px=height,
            step_bytes=3 * width,
            source=source,
        )

    def _ended(self, index: int) -> None:
        """Take note of where the video really ends."""
        if index == self._count:
            return
        share = max(0.0, 1 - index / self._count)
        what = f"the file states {self._count} frames, {index} can be decoded"
        self._damage = (Damage(what=what, where=f"frame {index}", affected=share),)
        self._count = index

    def _time(self, index: int) -> int:
        return round(index * self._period_ns())

    def _period_ns(self) -> Fraction:
        return frame_period_ns(self._rate_hz)

    def _index_from(self, t_ns: int) -> int:
        """Index of the first frame at `t_ns` or later."""
        index = max(0, int(t_ns / self._period_ns()) - 1)
        while self._time(index) < t_ns:
            index += 1
        return index


def _capture(path: Path) -> Any:
    """An open capture.

    Raises:
        RecordingError: OpenCV does not open the file.
    """
    try:
        capture = cv2.VideoCapture(str(path))
    except cv2.error:
        raise _unknown(path) from None
    if not capture.isOpened():
        raise _unknown(path)
    return capture


def _grab_all(capture: Any) -> int:
    count = 0
    while capture.grab():
        count += 1
    return count


def _seek(capture: Any, index: int) -> bool:
    """Go to a frame by its index; False if the container does not get there."""
    if index == 0:
        return True
    return bool(capture.set(cv2.CAP_PROP_POS_FRAMES, index)) and round(capture.get(cv2.CAP_PROP_POS_FRAMES)) == index


def _checked_rate(path: Path, rate_hz: float, *, given: bool) -> float:
    low, high = PLAUSIBLE_RATE_HZ
    if low <= rate_hz <= high:
        return rate_hz
    problem = f"a frame rate of {rate_hz} Hz was asked for" if given else f"states a frame rate of {rate_hz} Hz"
    raise RecordingError(path, problem, f"give one from {low:g} to {high:g} Hz with `--rate HZ`")


def _refuse_others(path: Path) -> None:
    """Refuse what OpenCV would take for a video although it is none: pictures, texts (playlists), tables."""
    try:
        with path.open("rb") as file:
            head = file.read(HEAD_BYTES)
    except OSError as error:
        raise RecordingError(path, f"cannot be read ({error.strerror})", "check that it is there") from None
    if not head:
        raise RecordingError(path, "the file is empty (0 bytes)", "give a recording that holds data")
    if kind := image_header(head)[0]:
        raise RecordingError(path, f"a single image ({kind}), not a recording", "give the folder that holds the images")
    if _is_text(head):
        raise RecordingError(
            path,
            "a text file, neither a bag, an MCAP file nor a video",
            "if it belongs to an image recording, give the folder that it is in",
        )


def _is_text(head: bytes) -> bool:
    return all(byte >= 32 or byte in b"\t\n\r\f\v\x1b" for byte in head) and b"\x7f" not in head


def _unknown(path: Path) -> RecordingError:
    return RecordingError(
        path,
        "of none of the known formats (ROS 1 bag, ROS 2 bag, MCAP, image folder, video)",
        "give a file of one of these formats, or check that it was copied whole",
    )
