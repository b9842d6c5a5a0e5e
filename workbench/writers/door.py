"""The one door to all containers: an error leaves nothing behind, an interrupt leaves what was written so far."""

from __future__ import annotations

import contextlib
import enum
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from readers.streams import Recording, RecordingError, StreamError
from workbench.writers.folders import EurocFolder, PaperFolder
from workbench.writers.logs import JsonMcap, Ros1Bag, Ros2Bag, RosMcap
from workbench.writers.target import JPEG_QUALITY, ImageCoding, ImageFormat, Order, Target, Written

Progress = Callable[[int, int], None]


class Container(enum.StrEnum):
    """What a recording is written as."""

    MCAP = "mcap"
    MCAP_JSON = "mcap-json"
    ROS1 = "ros1"
    ROS2 = "ros2"
    PAPER_A = "paper-a"
    EUROC = "euroc"


class _Kind(NamedTuple):
    target: Callable[[Order], Target]
    image_format: ImageFormat


_KINDS = {
    Container.MCAP: _Kind(RosMcap, "jpeg"),
    Container.MCAP_JSON: _Kind(JsonMcap, "jpeg"),
    Container.ROS1: _Kind(Ros1Bag, "jpeg"),
    Container.ROS2: _Kind(Ros2Bag, "jpeg"),
    Container.PAPER_A: _Kind(PaperFolder, "png"),
    Container.EUROC: _Kind(EurocFolder, "png"),
}
_SUFFIXES = {".mcap": Container.MCAP, ".bag": Container.ROS1}


def write(
    recording: Recording,
    path: Path | str,
    *,
    container: Container | str | None = None,
    streams: Sequence[str] | None = None,
    image_format: ImageFormat | None = None,
    quality: int = JPEG_QUALITY,
    on_progress: Progress | None = None,
) -> Written:
    """Write a recording.

    Args:
        recording: what to write; it is read once, one sample at a time.
        path: the file or folder to make. A folder is made with those above it.
        container: one of `Container`; by the suffix ``.mcap`` or ``.bag`` if None.
        streams: names of the streams to write, all readable ones if None.
        image_format: ``jpeg`` or ``png`` encodes raw images so; ``stored`` leaves them raw in a log and makes them
            PNG in a folder. Images that are compressed already pass through as they are. ``jpeg`` in logs and
            ``png`` in folders if None.
        quality: JPEG quality, 1…100.
        on_progress: called after each sample with the number of those read and of those expected.

    Returns:
        The number of messages by topic, and what the container does not hold, by stream.

    Raises:
        RecordingError: the path is taken or cannot be made, or does not say which container is meant.
        StreamError: the streams do not fit into this container as they are.
        ImageError: an image cannot be encoded in this format.
        KeyboardInterrupt: as it came; a whole container of what was written before it stays behind (nothing, where
            that was too little for one).
    """
    path = Path(path)
    _check(recording, streams)
    kind = _KINDS[_container(container, path)]
    order = Order(recording, path, streams, ImageCoding(image_format or kind.image_format, quality))
    if path.exists() or path.is_symlink():
        raise RecordingError(path, "it exists already", "choose another name or remove it first")
    target = kind.target(order)
    try:
        _open(target)
        _fill(target, on_progress)
        with uninterrupted():
            target.finish()
    except KeyboardInterrupt:
        with uninterrupted():
            _keep(target)
        raise
    except BaseException:
        target.discard()
        raise
    return target.written()


def write_mcap(
    recording: Recording,
    path: Path | str,
    *,
    streams: Sequence[str] | None = None,
    image_format: ImageFormat = "jpeg",
    quality: int = JPEG_QUALITY,
) -> Written:
    """Write a recording as MCAP with ROS 2 messages, see `write`."""
    return write(recording, path, container=Container.MCAP, streams=streams, image_format=image_format, quality=quality)


def _container(name: Container | str | None, path: Path) -> Container:
    known = ", ".join(Container)
    if name is None:
        if (guess := _SUFFIXES.get(path.suffix.lower())) is None:
            raise RecordingError(path, "its name does not say what to write", f"name the container: {known}")
        return guess
    try:
        return Container(name)
    except ValueError:
        raise RecordingError(path, f"no container is named {str(name)!r}", f"name one of {known}") from None


def _check(recording: Recording, streams: Sequence[str] | None) -> None:
    for name in streams or ():
        if not (info := recording.stream(name)).readable:
            raise StreamError(f"{recording.path}: the stream {name!r} cannot be read: {info.reason}; leave it out")


def _open(target: Target) -> None:
    try:
        with uninterrupted():
            target.open()
    except OSError as error:
        raise RecordingError(target.path, f"it cannot be made ({error.strerror})", "choose another folder") from error


def _fill(target: Target, on_progress: Progress | None) -> None:
    expected = sum(max(info.count, 0) for info in target.order.infos)
    for done, sample in enumerate(target.samples(), start=1):
        with uninterrupted():
            target.write(sample)
        if on_progress is not None:
            on_progress(done, max(done, expected))


def _keep(target: Target) -> None:
    """Close an interrupted target; remove it where too little came in for that."""
    try:
        target.finish()
    except Exception:
        target.discard()


@contextlib.contextmanager
def uninterrupted() -> Iterator[None]:
    """Puts off Ctrl-C to the end of the block, so that no message is cut in two."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    waiting: list[int] = []
    previous = signal.signal(signal.SIGINT, lambda number, _: waiting.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, previous or signal.default_int_handler)
    if waiting:
        signal.raise_signal(signal.SIGINT)
