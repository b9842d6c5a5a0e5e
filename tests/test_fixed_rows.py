"""Messages decoded together: the samples are those of the messages one by one, and odd messages are left out."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from made_logs import ROS2, START_NS, Maker, plain
from test_fixed_layout import channel_of

from readers.fixed_layout import fixed_reader
from readers.fixed_rows import read_rows
from readers.message_log import Channel, Message
from readers.messages import Arrival
from readers.streams import Sample

IMU, ODOMETRY = "sensor_msgs/msg/Imu", "nav_msgs/msg/Odometry"
MS = 1_000_000
UNKNOWN = np.array([-1.0] + [0.0] * 8)


def set_quaternion(q: Any, *xyzw: float) -> None:
    q.x, q.y, q.z, q.w = xyzw


def frozen(message: Any) -> None:
    message.header.stamp.sec = 0


ODD: dict[str, Callable[[Any], None]] = {
    "foreign_stamp": frozen,
    "no rate": lambda m: setattr(m, "angular_velocity_covariance", UNKNOWN),
    "no force": lambda m: setattr(m, "linear_acceleration_covariance", UNKNOWN),
    "norm": lambda m: set_quaternion(m.orientation, 0.0, 0.0, 0.6, 0.9),
    "zero": lambda m: set_quaternion(m.orientation, 0.0, 0.0, 0.0, 0.0),
    "identity": lambda m: set_quaternion(m.orientation, 0.0, 0.0, 0.0, 1.0),
    "nan": lambda m: set_quaternion(m.orientation, np.nan, 0.0, 0.0, 1.0),
    "infinite": lambda m: set_quaternion(m.orientation, np.inf, 0.0, 0.0, 1.0),
}


def stored(channel: Channel, messages: list[Any]) -> list[Message]:
    return [
        Message(START_NS + i * MS, channel, memoryview(bytes(ROS2.serialize_cdr(m, channel.type))), START_NS + i)
        for i, m in enumerate(messages)
    ]


def one_by_one(message: Message, offset_ns: int = 0) -> Sample | None:
    read = fixed_reader(message.channel)
    assert read is not None
    return read(message.data, Arrival("/t", message.log_ns, published_ns=message.publish_ns, offset_ns=offset_ns))


def imus() -> list[Any]:
    found = []
    for i in range(12):
        message = Maker(ROS2).imu(START_NS + i * MS - 7, float(i))
        set_quaternion(message.orientation, 0.0, 0.0, 0.6, 0.8)
        message.linear_acceleration.x = float(i) if i != 5 else np.nan
        found.append(message)
    return found


def odometries() -> list[Any]:
    return [Maker(ROS2).odometry(START_NS + i * MS, float(i)) for i in range(12)]


def exactly(sample: Sample | None) -> Any:
    assert sample is not None
    return plain(sample), sample.header_ns, sample.published_ns


@pytest.mark.parametrize("offset_ns", [0, -3 * MS])
@pytest.mark.parametrize(("kind", "made"), [(IMU, imus), (ODOMETRY, odometries)])
def test_rows_are_the_messages_one_by_one(kind: str, made: Callable[[], list[Any]], offset_ns: int) -> None:
    messages = stored(channel_of(kind), made())
    samples = read_rows(messages, "/t", offset_ns)
    assert len(samples) == len(messages)
    for sample, message in zip(samples, messages, strict=True):
        assert exactly(sample) == exactly(one_by_one(message, offset_ns))
        arrays = [getattr(sample, name) for name in type(sample).__slots__]
        assert all(not a.flags.writeable and a.dtype == np.float64 for a in arrays)


@pytest.mark.parametrize("odd", ODD)
def test_rows_that_need_care_are_left_to_the_single_reading(odd: str) -> None:
    made = imus()
    ODD[odd](made[3])
    messages = stored(channel_of(IMU), made)
    samples = read_rows(messages, "/t", 0)
    assert [place for place, sample in enumerate(samples) if sample is None] == [3]
    assert exactly(samples[4]) == exactly(one_by_one(messages[4]))


def test_an_orientation_that_was_not_measured_is_nan() -> None:
    made = imus()
    for message in made[::2]:
        message.orientation_covariance = UNKNOWN
    messages = stored(channel_of(IMU), made)
    for sample, message in zip(read_rows(messages, "/t", 0), messages, strict=True):
        assert exactly(sample) == exactly(one_by_one(message))


def test_what_is_not_of_one_layout_is_left_as_a_whole() -> None:
    made = imus()
    messages = stored(channel_of(IMU), made)
    frame = messages[2]._replace(data=bytes(messages[2].data).replace(b"imu", b"umi"))
    if frame.data == messages[2].data:
        frame = frame._replace(data=bytes(frame.data[:16]) + b"~" + bytes(frame.data[17:]))
    assert not read_rows([*messages[:2], frame], "/t", 0)
    assert not read_rows([*messages, messages[0]._replace(data=messages[0].data[:-8])], "/t", 0)
    assert not read_rows([*messages, messages[0]._replace(data=b"\0\0" + bytes(messages[0].data[2:]))], "/t", 0)
    assert not read_rows([messages[0]._replace(data=messages[0].data[:40])] * 5, "/t", 0)
    assert not read_rows([*messages, messages[0]._replace(log_ns=2**63)], "/t", 0)
    image = channel_of("sensor_msgs/msg/Image")
    assert not read_rows(stored(image, [Maker(ROS2).image(START_NS, 1)] * 5), "/t", 0)
