"""Messages decoded together: the samples are those of the messages one by one, and odd messages are left out."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_logs import ROS1, ROS2, START_NS, Maker, drive, plain, write_ros1
from test_fixed_layout import channel_of

from readers import log_recording, open_recording
from readers.decoding import decoder_of, has_fixed_layout
from readers.fixed_layout import fixed_reader
from readers.fixed_rows import read_rows
from readers.message_log import Channel, Message
from readers.messages import Arrival, reader_of, samples_of
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


def imus(store: Any = ROS2) -> list[Any]:
    found = []
    for i in range(12):
        message = Maker(store).imu(START_NS + i * MS - 7, float(i))
        set_quaternion(message.orientation, 0.0, 0.0, 0.6, 0.8)
        message.linear_acceleration.x = float(i) if i != 5 else np.nan
        found.append(message)
    return found


def odometries(store: Any = ROS2) -> list[Any]:
    return [Maker(store).odometry(START_NS + i * MS, float(i)) for i in range(12)]


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


# ------------------------------------------------------------------------------------ ROS 1


def stored_ros1(kind: str, made: list[Any]) -> list[Message]:
    """The messages as a ROS 1 bag has them, each with a number of its own in its header."""
    definition = ROS1.generate_msgdef(kind, ros_version=1)[0].encode()
    channel = Channel("/t", kind.replace("/msg/", "/"), "ros1", "ros1msg", definition)
    found = []
    for i, message in enumerate(made):
        message.header.seq = 7 * i
        data = memoryview(bytes(ROS1.serialize_ros1(message, kind)))
        found.append(Message(START_NS + i * MS, channel, data))
    return found


def generic_ros1(kind: str, message: Message) -> Sample:
    reader = reader_of(kind)
    assert reader is not None
    decoded = ROS1.deserialize_ros1(message.data, kind)
    (sample,) = samples_of(reader, decoded, Arrival("/t", message.log_ns))
    return sample


@pytest.mark.parametrize(("kind", "made"), [(IMU, imus), (ODOMETRY, odometries)])
def test_rows_of_ros1_are_the_messages_one_by_one(kind: str, made: Callable[[Any], list[Any]]) -> None:
    for frame in ("", "a", "an odd name"):
        messages = made(ROS1)
        for message in messages:
            message.header.frame_id = frame
        rows = stored_ros1(kind, messages)
        samples = read_rows(rows, "/t", 0)
        assert len(samples) == len(rows)
        for sample, row in zip(samples, rows, strict=True):
            assert exactly(sample) == exactly(generic_ros1(kind, row))


@pytest.mark.parametrize("odd", ODD)
def test_rows_of_ros1_that_need_care_are_left_to_the_single_reading(odd: str) -> None:
    made = imus(ROS1)
    ODD[odd](made[3])
    samples = read_rows(stored_ros1(IMU, made), "/t", 0)
    assert [place for place, sample in enumerate(samples) if sample is None] == [3]


def test_ros1_messages_of_other_lengths_or_texts_are_no_rows() -> None:
    messages = stored_ros1(IMU, imus(ROS1))
    first = bytes(messages[0].data)
    for data in (first[:-8], first[:14], first[:16] + b"~" + first[17:], first[:12] + b"\xff\xff\xff\xff" + first[16:]):
        assert not read_rows([*messages, messages[0]._replace(data=data)], "/t", 0)
        assert not read_rows([messages[0]._replace(data=data)] * 4, "/t", 0) or data[16:17] == b"~"


def test_a_bag_gives_the_same_samples_with_rows_and_without(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bag = write_ros1(tmp_path / "a.bag", drive(ROS1))
    counted: list[int] = []

    def counting(messages: Any, stream: str, offset_ns: int) -> Any:
        rows = read_rows(messages, stream, offset_ns)
        counted.append(sum(row is not None for row in rows))
        return rows

    monkeypatch.setattr(log_recording, "read_rows", counting)
    with open_recording(bag) as recording:
        together = [exactly(sample) for sample in recording.read(["/imu", "/odom"])]
    assert 200 <= sum(counted) <= len(together)
    monkeypatch.setattr(log_recording, "read_rows", lambda *_: ())
    with open_recording(bag) as recording:
        assert [exactly(sample) for sample in recording.read(["/imu", "/odom"])] == together


def test_another_definition_of_ros1_has_no_rows() -> None:
    definition = ROS1.generate_msgdef(IMU, ros_version=1)[0]
    swapped = definition.replace("angular_velocity\n", "x\n").replace("linear_acceleration\n", "angular_velocity\n")
    swapped = swapped.replace("Vector3 x\n", "Vector3 linear_acceleration\n")
    assert has_fixed_layout(decoder_of(Channel("/t", "sensor_msgs/Imu", "ros1", "ros1msg", definition.encode())))
    assert not has_fixed_layout(decoder_of(Channel("/t", "sensor_msgs/Imu", "ros1", "ros1msg", swapped.encode())))
