"""A `Recording` written as a file that other tools open: MCAP with ROS 2 messages.

The file is a function of the samples: the same recording gives the same bytes.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Literal

import cv2
import numpy as np
from mcap.writer import Writer
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_typestore

from readers.streams import (
    CameraInfo,
    ImageError,
    ImageSample,
    PoseSample,
    Problem,
    RangeSample,
    Recording,
    RecordingError,
    Sample,
    StreamError,
)

ImageFormat = Literal["jpeg", "png", "stored"]
LIBRARY = "estimator-workbench"
JPEG_QUALITY = 92
MONO_ENCODINGS = {"mono8", "mono16", "8uc1", "16uc1"}
COMPRESSED_TOPIC = "/compressed"  # image_transport's name for the compressed form of an image topic

_STORE = get_typestore(Stores.ROS2_HUMBLE)
_TYPES = _STORE.types
_Time, _Header = _TYPES["builtin_interfaces/msg/Time"], _TYPES["std_msgs/msg/Header"]
_Point, _Quaternion = _TYPES["geometry_msgs/msg/Point"], _TYPES["geometry_msgs/msg/Quaternion"]
_Pose, _Region = _TYPES["geometry_msgs/msg/Pose"], _TYPES["sensor_msgs/msg/RegionOfInterest"]


@dataclass(frozen=True, slots=True)
class Written:
    """What was written: number of messages by topic, and of undecodable ones left out by stream."""

    messages: dict[str, int]
    left_out: dict[str, int]


def write_mcap(
    recording: Recording,
    path: Path | str,
    *,
    streams: Sequence[str] | None = None,
    image_format: ImageFormat = "jpeg",
    quality: int = JPEG_QUALITY,
) -> Written:
    """Write a recording as MCAP: profile ros2, CDR messages with their definitions.

    Args:
        recording: what to write; it is read once, one sample at a time.
        path: the file to make.
        streams: names of the streams to write, all readable ones if None.
        image_format: ``jpeg`` or ``png`` encodes raw images so, under the topic `…/compressed`; ``stored``
            leaves them raw. Images that are compressed already pass through as they are.
        quality: JPEG quality, 1…100.

    Raises:
        RecordingError: the file exists already, or its folder does not.
        StreamError: a stream is of a kind that has no message here.
        ImageError: an image cannot be encoded in this format.
    """
    path = Path(path)
    try:
        file = path.open("xb")
    except FileExistsError:
        raise RecordingError(path, "it exists already", "choose another name or remove it first") from None
    except OSError as error:
        raise RecordingError(path, f"it cannot be made ({error.strerror})", "choose another folder") from error
    try:
        with file:
            return _write(recording, file, streams, image_format, quality)
    except BaseException:
        path.unlink()
        raise


def _write(
    recording: Recording, file: BinaryIO, streams: Sequence[str] | None, image_format: ImageFormat, quality: int
) -> Written:
    frames = {info.name: info.frame for info in recording.streams}
    writer = Writer(file)
    writer.start(profile="ros2", library=LIBRARY)
    channels = _Channels(writer)
    left_out: Counter[str] = Counter()
    for sample in recording.read(streams):
        if isinstance(sample, Problem):
            left_out[sample.stream] += 1
            continue
        if isinstance(sample, ImageSample):
            sample = _encoded(sample, image_format, quality)
        topic, message = _message_of(sample, frames.get(sample.stream, ""))
        channels.write(topic, message, sample)
    writer.finish()
    return Written(dict(channels.counts), dict(left_out))


class _Channels:
    """The topics of one file, registered when their first message comes."""

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self.counts: Counter[str] = Counter()

    def write(self, topic: str, message: Any, sample: Sample) -> None:
        """Write one ROS message at the times of its sample."""
        if topic not in self._channels:
            self._channels[topic] = self._register(topic, message.__msgtype__)
        self._writer.add_message(
            channel_id=self._channels[topic],
            log_time=sample.received_ns,
            publish_time=sample.t_ns,
            data=bytes(_STORE.serialize_cdr(message, message.__msgtype__)),
            sequence=self.counts[topic],
        )
        self.counts[topic] += 1

    def _register(self, topic: str, name: str) -> int:
        if name not in self._schemas:
            definition, _ = _STORE.generate_msgdef(name, ros_version=2)
            self._schemas[name] = self._writer.register_schema(name, "ros2msg", definition.encode())
        channel: int = self._writer.register_channel(topic, "cdr", self._schemas[name], {"offered_qos_profiles": ""})
        return channel


# -------------------------------------------------------------------------------- messages


def _header(sample: Sample, frame: str) -> Any:
    sec, nanosec = divmod(sample.t_ns, 1_000_000_000)
    return _Header(_Time(sec, nanosec), frame)


def _image_message(sample: ImageSample, frame: str) -> tuple[str, Any]:
    data = np.frombuffer(sample.data, dtype=np.uint8)
    if not sample.step_bytes:
        topic = sample.stream if sample.stream.endswith(COMPRESSED_TOPIC) else sample.stream + COMPRESSED_TOPIC
        return topic, _TYPES["sensor_msgs/msg/CompressedImage"](_header(sample, frame), sample.encoding, data)
    message = _TYPES["sensor_msgs/msg/Image"](
        header=_header(sample, frame),
        height=sample.height_px,
        width=sample.width_px,
        encoding=sample.encoding,
        is_bigendian=int(sample.big_endian),
        step=sample.step_bytes,
        data=data,
    )
    return sample.stream, message


def _camera_message(sample: CameraInfo, frame: str) -> tuple[str, Any]:
    camera = sample.camera
    message = _TYPES["sensor_msgs/msg/CameraInfo"](
        header=_header(sample, camera.frame or frame),
        height=camera.height_px,
        width=camera.width_px,
        distortion_model=camera.distortion_model,
        d=camera.distortion,
        k=camera.matrix.ravel(),
        r=camera.rectification.ravel(),
        p=camera.projection.ravel(),
        binning_x=0,
        binning_y=0,
        roi=_Region(0, 0, 0, 0, False),
    )
    return sample.stream, message


def _pose_message(sample: PoseSample, frame: str) -> tuple[str, Any]:
    position = _Point(*(float(x) for x in sample.position_m))
    orientation = _Quaternion(*(float(q) for q in sample.quat_xyzw))
    header = _header(sample, sample.parent_frame or frame)
    return sample.stream, _TYPES["geometry_msgs/msg/PoseStamped"](header, _Pose(position, orientation))


def _range_message(sample: RangeSample, frame: str) -> tuple[str, Any]:
    kind = _TYPES["sensor_msgs/msg/Range"]
    message = kind(
        header=_header(sample, frame),
        radiation_type=kind.INFRARED,
        field_of_view=sample.field_of_view_rad,
        min_range=sample.min_range_m,
        max_range=sample.max_range_m,
        range=sample.range_m,
    )
    return sample.stream, message


_MESSAGES: dict[type[Sample], Callable[[Any, str], tuple[str, Any]]] = {
    ImageSample: _image_message,
    CameraInfo: _camera_message,
    PoseSample: _pose_message,
    RangeSample: _range_message,
}


def _message_of(sample: Sample, frame: str) -> tuple[str, Any]:
    """Topic and ROS message of a sample."""
    build = _MESSAGES.get(type(sample))
    if build is None:
        known = ", ".join(kind.__name__ for kind in _MESSAGES)
        raise StreamError(
            f"{sample.stream}: a {type(sample).__name__} cannot be written as a ROS 2 message; "
            f"name the streams to write, of these kinds: {known}"
        )
    return build(sample, frame)


# ---------------------------------------------------------------------------------- images


def _encoded(sample: ImageSample, image_format: ImageFormat, quality: int) -> ImageSample:
    """The sample itself where it is compressed or is to stay raw, else one of the encoded image."""
    if not sample.step_bytes or image_format == "stored":
        return sample
    pixels: NDArray[Any] = sample.grey() if sample.encoding.lower() in MONO_ENCODINGS else sample.colour()
    if pixels.dtype != np.uint8 and image_format == "jpeg":
        raise ImageError(f"{sample.source or sample.stream}: {sample.encoding} does not fit into a JPEG; choose png")
    if pixels.ndim == 3:
        pixels = cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR)
    options = [cv2.IMWRITE_JPEG_QUALITY, quality] if image_format == "jpeg" else []
    done, data = cv2.imencode(f".{image_format}", pixels, options)
    if not done:
        raise ImageError(f"{sample.source or sample.stream}: it could not be encoded as {image_format}; choose stored")
    return ImageSample(
        stream=sample.stream,
        t_ns=sample.t_ns,
        received_ns=sample.received_ns,
        encoding=image_format,
        payload=data.tobytes(),
        source=sample.source,
    )
