"""ROS 1 messages by fixed layouts: the same samples as by the generic decoder; only for the standard definitions."""

from functools import partial
from typing import Any

import numpy as np
import pytest
from made_logs import ROS1, START_NS, Maker, plain

from readers import decoding
from readers.decoding import MessageError, decoder_of
from readers.message_log import Channel
from readers.messages import Arrival, reader_of, samples_of

MAKE = Maker(ROS1)
MESSAGES = {
    "sensor_msgs/msg/Imu": [
        MAKE.imu(START_NS + 7, 1.5, header=MAKE.header(START_NS + 7, frame))
        for frame in ("", "/imu", "a longer name of a frame, Überbau")
    ]
    + [MAKE.imu(START_NS, orientation_covariance=np.array([-1.0, *range(8)])), MAKE.imu(0)],
    "nav_msgs/msg/Odometry": [MAKE.odometry(START_NS + i, 0.25 * i) for i in range(3)],
    "sensor_msgs/msg/Image": [
        MAKE.image(START_NS, 3),
        MAKE.image(START_NS, 0, encoding="mono16", step=16, height=3, is_bigendian=1),
        MAKE.image(START_NS, 0, data=np.zeros(0, np.uint8), height=0),
    ],
}


def channel(kind: str, definition: str | None = None) -> Channel:
    known = ROS1.generate_msgdef(kind, ros_version=1)[0] if definition is None else definition
    return Channel("/t", kind.replace("/msg/", "/"), "ros1", "ros1msg", known.encode())


def samples(kind: str, message: Any) -> list[dict[str, Any]]:
    reader = reader_of(kind)
    assert reader is not None
    return [plain(sample) for sample in samples_of(reader, message, Arrival("/t", START_NS + 10))]


@pytest.mark.parametrize("kind", MESSAGES)
def test_both_decoders_give_the_same_samples(kind: str) -> None:
    decode = decoder_of(channel(kind))
    assert isinstance(decode, partial)
    assert decode.func is decoding._decode_fixed
    for message in MESSAGES[kind]:
        data = memoryview(bytes(ROS1.serialize_ros1(message, kind)))
        assert samples(kind, decode(data)) == samples(kind, ROS1.deserialize_ros1(data, kind))


@pytest.mark.parametrize("kind", MESSAGES)
def test_a_message_of_another_length_is_refused(kind: str) -> None:
    decode = decoder_of(channel(kind))
    data = bytes(ROS1.serialize_ros1(MESSAGES[kind][0], kind))
    for size in range(len(data)):
        with pytest.raises(MessageError, match="does not fit"):
            decode(data[:size])
    with pytest.raises(MessageError, match="does not fit"):
        decode(data + b"\0")


def test_another_definition_is_decoded_as_it_says() -> None:
    """A type of the same name with fields swapped keeps the generic decoder."""
    definition = ROS1.generate_msgdef("sensor_msgs/msg/Imu", ros_version=1)[0]
    swapped = definition.replace("angular_velocity\n", "x\n").replace("linear_acceleration\n", "angular_velocity\n")
    swapped = swapped.replace("Vector3 x\n", "Vector3 linear_acceleration\n")
    decode = decoder_of(channel("sensor_msgs/msg/Imu", swapped))
    data = bytes(ROS1.serialize_ros1(MAKE.imu(START_NS, 2.0), "sensor_msgs/msg/Imu"))
    assert decode(data).linear_acceleration.x == 2.0
    assert decode(data).angular_velocity.z == 9.8


def test_pixels_are_not_copied() -> None:
    data = np.frombuffer(bytes(ROS1.serialize_ros1(MAKE.image(START_NS), "sensor_msgs/msg/Image")), np.uint8)
    assert np.shares_memory(decoder_of(channel("sensor_msgs/msg/Image"))(data.data).data, data)
