"""The contract of a container that is being written, and how images go into it."""

from __future__ import annotations

import abc
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from readers.streams import ImageError, ImageSample, Problem, Recording, Sample, StreamInfo

ImageFormat = Literal["jpeg", "png", "stored"]
JPEG_QUALITY = 92
MONO_ENCODINGS = {"mono8", "mono16", "8uc1", "16uc1"}


@dataclass(frozen=True, slots=True)
class Written:
    """What was written: number of messages by topic, and by stream a sentence on what was left out and why."""

    messages: dict[str, int]
    left_out: dict[str, str]


@dataclass(frozen=True, slots=True)
class ImageCoding:
    """How raw images are stored; compressed ones always stay as they are.

    Raises:
        ImageError: there is no such format or quality.
    """

    format: ImageFormat
    quality: int = JPEG_QUALITY

    def __post_init__(self) -> None:
        if self.format not in get_args(ImageFormat):
            raise ImageError(f"no image format is named {self.format!r}; choose {', '.join(get_args(ImageFormat))}")
        if not 1 <= self.quality <= 100:
            raise ImageError(f"a JPEG quality of {self.quality} does not exist; choose 1 to 100")

    def encoded(self, sample: ImageSample) -> ImageSample:
        """The sample itself where it is compressed or is to stay raw, else one of the encoded image.

        Raises:
            ImageError: the image does not fit into this format.
        """
        if not sample.step_bytes or self.format == "stored":
            return sample
        pixels: NDArray[Any] = sample.grey() if sample.encoding.lower() in MONO_ENCODINGS else sample.colour()
        if pixels.dtype != np.uint8 and self.format == "jpeg":
            raise ImageError(f"{_name(sample)}: {sample.encoding} does not fit into a JPEG; choose png")
        if pixels.ndim == 3:
            pixels = cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR)
        options = [cv2.IMWRITE_JPEG_QUALITY, self.quality] if self.format == "jpeg" else []
        done, data = cv2.imencode(f".{self.format}", pixels, options)
        if not done:
            raise ImageError(f"{_name(sample)}: it could not be encoded as {self.format}; choose stored")
        return replace(
            sample,
            encoding=self.format,
            payload=data.tobytes(),
            width_px=0,
            height_px=0,
            step_bytes=0,
            big_endian=False,
        )


def _name(sample: ImageSample) -> str:
    return sample.source or sample.stream


@dataclass(frozen=True, slots=True)
class Order:
    """What is to be written: streams of a recording (all readable ones if None), and the coding of images."""

    recording: Recording
    path: Path
    streams: Sequence[str] | None
    coding: ImageCoding

    @property
    def infos(self) -> tuple[StreamInfo, ...]:
        """The readable streams that were asked for."""
        return tuple(
            info
            for info in self.recording.streams
            if info.readable and (self.streams is None or info.name in self.streams)
        )


class Target(abc.ABC):
    """A container: opened, filled sample by sample, then closed, or discarded if it cannot be finished."""

    def __init__(self, order: Order) -> None:
        self.order, self.path = order, order.path
        self.messages: Counter[str] = Counter()
        self._finished = False
        self._left_out: dict[str, list[str]] = {}
        self._skipped: Counter[tuple[str, str]] = Counter()
        if order.streams is None:
            for info in order.recording.streams:
                if not info.readable:
                    self.leave_out(info.name, info.reason or "it cannot be read")

    @abc.abstractmethod
    def open(self) -> None:
        """Make the file or folder.

        Raises:
            OSError: it cannot be made.
        """

    @abc.abstractmethod
    def samples(self) -> Iterator[Sample]:
        """The samples to write, in the order in which the container wants them."""

    @abc.abstractmethod
    def put(self, sample: Sample) -> None:
        """Write one sample that could be decoded."""

    @abc.abstractmethod
    def close(self) -> None:
        """Write what the container ends with."""

    @abc.abstractmethod
    def discard(self) -> None:
        """Remove everything that was made; nothing if nothing was."""

    def finish(self) -> None:
        """Close the container once, so that all that was put into it can be read."""
        if not self._finished:
            self._finished = True
            self.close()

    def write(self, sample: Sample) -> None:
        """Write one sample, or count it as left out."""
        if isinstance(sample, Problem):
            self.skip(sample.stream, "they could not be decoded")
        else:
            self.put(sample)

    def leave_out(self, stream: str, why: str) -> None:
        """Note that a stream, or a part of what it holds, is not written."""
        reasons = self._left_out.setdefault(stream, [])
        if why not in reasons:
            reasons.append(why)

    def skip(self, stream: str, why: str) -> None:
        """Count one message of a stream that is not written."""
        self._skipped[stream, why] += 1

    def written(self) -> Written:
        """What was written and what was not."""
        reasons = {stream: list(found) for stream, found in self._left_out.items()}
        for (stream, why), count in self._skipped.items():
            reasons.setdefault(stream, []).append(f"{count} of its messages: {why}")
        return Written(dict(self.messages), {stream: "; ".join(found) for stream, found in sorted(reasons.items())})


def first_missing(path: Path) -> Path:
    """The highest of the folders that have to be made for `path`, which is not there yet."""
    missing = path
    while not missing.parent.exists():
        missing = missing.parent
    return missing
