"""Samples read by their fixed CDR layout: equal to those of the generic decoding, whatever the lengths of strings."""

from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
import pytest
from made_logs import ROS2, START_NS, Maker, plain

from readers.decoding import MessageError, decoder_of
from readers.fixed_layout import fixed_reader, header_of
from readers.message_log import Channel
from readers.messages import Arrival, reader_of, samples_of

KINDS = [
    "sensor_msgs/msg/Imu",
    "nav_msgs/msg/Odometry",
    "sensor_msgs/msg/Image",
    "sensor_msgs/msg/CompressedImage",
    "sensor_msgs/msg/CameraInfo",
    "geometry_msgs/msg/PoseStamped",
]
MAY_REFUSE = ("Image", "CompressedImage")
FORMATS = ("jpeg", "", "bgr8; jpeg compressed bgr8", "16UC1; compressedDepth png", "png")


def channel_of(kind: str, schema: bytes | None = None, **changes: str) -> Channel:
    text = ROS2.generate_msgdef(kind, ros_version=2)[0].encode() if schema is None else schema
    return Channel("/t", kind, changes.get("encoding", "cdr"), changes.get("schema_encoding", "ros2msg"), text)


def messages(kind: str) -> Iterator[Any]:
    make = Maker(ROS2)
    for length in range(12):
        if kind.endswith("Imu"):
            message = make.imu(START_NS + length, float(length))
            if length == 3:
                message.angular_velocity_covariance[0] = -1.0
            if length == 4:
                message.orientation_covariance[0] = -1.0
            if length == 5:
                message.orientation.w = 2.0
            if length == 6:
                message.linear_acceleration_covariance[0] = -1.0
            if length == 7:
                message.linear_acceleration.x = np.nan
        elif kind.endswith("Odometry"):
            message = make.odometry(START_NS + length, float(length))
            message.child_frame_id = "c" * (length * 5 % 7)
        elif kind.endswith("CompressedImage"):
            picture = cv2.imencode(".jpg", np.full((4, 5 + length), 40 * length % 256, np.uint8))[1].reshape(-1)
            data = picture if length % 3 else np.arange(length + 1, dtype=np.uint8)
            message = make(kind, header=make.header(START_NS + length), format=FORMATS[length % 5], data=data)
        elif kind.endswith("CameraInfo"):
            message = make.camera_info(START_NS + length)
            message.distortion_model = "m" * (length * 5 % 7)
            message.d = np.arange(length % 6, dtype=np.float64) * length
            message.k[0] = 100.0 + length
        elif kind.endswith("PoseStamped"):
            turn = make.quaternion(0.0, 0.0, 0.6, 0.8 if length != 5 else 8.0)
            place = make.vector(length, 2.0, np.nan if length == 6 else 3.0, "Point")
            pose = make("geometry_msgs/msg/Pose", position=place, orientation=turn)
            message = make(kind, header=make.header(START_NS + length), pose=pose)
        else:
            message = make.image(START_NS + length, length)
        message.header.frame_id = "f" * length
        yield message


def generic(channel: Channel, data: bytes, arrival: Arrival) -> Any:
    reader = reader_of(channel.type)
    assert reader is not None
    (sample,) = samples_of(reader, decoder_of(channel)(data), arrival)
    return sample


@pytest.mark.parametrize("kind", KINDS)
def test_the_samples_are_those_of_the_generic_decoding(kind: str) -> None:
    channel = channel_of(kind)
    read = fixed_reader(channel)
    assert read is not None
    for message in messages(kind):
        data = bytes(ROS2.serialize_cdr(message, kind))
        sample = read(memoryview(data), Arrival("/t", START_NS))
        assert sample is not None
        assert plain(sample) == plain(generic(channel, data, Arrival("/t", START_NS)))
        assert header_of(data) == (sample.t_ns, message.header.frame_id)


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_out_of_shape_is_left_to_the_generic_decoding(kind: str) -> None:
    channel = channel_of(kind)
    read = fixed_reader(channel)
    assert read is not None
    data = bytes(ROS2.serialize_cdr(next(messages(kind)), kind))
    for size in range(len(data)):
        try:
            assert read(data[:size], Arrival("/t", START_NS)) is None
        except MessageError:
            assert kind.endswith(MAY_REFUSE)
    assert read(data + bytes(8), Arrival("/t", START_NS)) is None
    assert read(b"\0\0" + data[2:], Arrival("/t", START_NS)) is None
    assert read(data[:12] + b"\xff\xff\xff\xff" + data[16:], Arrival("/t", START_NS)) is None


def test_other_definitions_have_no_fixed_layout() -> None:
    text = ROS2.generate_msgdef(KINDS[0], ros_version=2)[0]
    assert fixed_reader(channel_of(KINDS[0], b"")) is not None
    assert (
        fixed_reader(channel_of(KINDS[0], ("# a comment\n" + text.replace("\n", "  # note\n", 1)).encode())) is not None
    )
    for changed in (
        text.replace("float64 x", "float32 x", 1),
        text.replace("float64[9] orientation_covariance", "float64[10] orientation_covariance"),
        text.replace("angular_velocity\n", "rate\n", 1),
        text + "\nint32 more",
        text.partition("====")[0],
    ):
        assert changed != text
        assert fixed_reader(channel_of(KINDS[0], changed.encode())) is None
    assert fixed_reader(channel_of(KINDS[0], encoding="ros1")) is None
    assert fixed_reader(channel_of(KINDS[0], schema_encoding="ros2idl")) is None
