"""Fixed layouts of the ROS 1 messages that come most often: IMU, odometry, images.

ROS 1 writes little-endian fields one after the other without padding, so that all numbers behind the texts are one
`struct`. What comes out has the fields of the generic decoder's objects; an image's pixels stay where they are. The
layouts hold for the standard definitions only, which their MD5 sums tell.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from readers.message_log import Buffer, text

_U32 = struct.Struct("<I")
_HEADER = struct.Struct("<IIII")
_STAMP_BYTES = 12
_SIZE = struct.Struct("<II")
_ROW = struct.Struct("<BII")
_IMU = struct.Struct("<37d")
_ODOMETRY = struct.Struct("<85d")


class WireError(ValueError):
    """Bytes that are no message of the type."""


class Stamp(NamedTuple):
    """builtin time."""

    sec: int
    nanosec: int


class Header(NamedTuple):
    """std_msgs/Header."""

    seq: int
    stamp: Stamp
    frame_id: str


class Vector(NamedTuple):
    """geometry_msgs/Vector3 and Point."""

    x: float
    y: float
    z: float


class Quaternion(NamedTuple):
    """geometry_msgs/Quaternion."""

    x: float
    y: float
    z: float
    w: float


class Imu(NamedTuple):
    """sensor_msgs/Imu."""

    header: Header
    orientation: Quaternion
    orientation_covariance: tuple[float, ...]
    angular_velocity: Vector
    angular_velocity_covariance: tuple[float, ...]
    linear_acceleration: Vector
    linear_acceleration_covariance: tuple[float, ...]


class Pose(NamedTuple):
    """geometry_msgs/Pose."""

    position: Vector
    orientation: Quaternion


class Twist(NamedTuple):
    """geometry_msgs/Twist."""

    linear: Vector
    angular: Vector


class PoseWithCovariance(NamedTuple):
    """geometry_msgs/PoseWithCovariance."""

    pose: Pose
    covariance: tuple[float, ...]


class TwistWithCovariance(NamedTuple):
    """geometry_msgs/TwistWithCovariance."""

    twist: Twist
    covariance: tuple[float, ...]


class Odometry(NamedTuple):
    """nav_msgs/Odometry."""

    header: Header
    child_frame_id: str
    pose: PoseWithCovariance
    twist: TwistWithCovariance


class Image(NamedTuple):
    """sensor_msgs/Image; `data` is a view of the message."""

    header: Header
    height: int
    width: int
    encoding: str
    is_bigendian: int
    step: int
    data: Any


def _text(data: Buffer, at: int) -> tuple[str, int]:
    """The text at `at`, and where it ends."""
    (length,) = _U32.unpack_from(data, at)
    stop = at + 4 + length
    if stop > len(data):
        raise WireError
    return text(data[at + 4 : stop]), stop


def _header(data: Buffer) -> tuple[Header, int]:
    seq, sec, nanosec, _ = _HEADER.unpack_from(data)
    frame, at = _text(data, _STAMP_BYTES)
    return Header(seq, Stamp(sec, nanosec), frame), at


def _numbers(form: struct.Struct, data: Buffer, at: int) -> tuple[float, ...]:
    """The numbers that fill the message from `at` on."""
    if at + form.size != len(data):
        raise WireError
    return form.unpack_from(data, at)


def imu_numbers_at(data: Buffer) -> int | None:
    """Where the numbers of sensor_msgs/Imu begin; None if they do not fill the rest of the message."""
    return _numbers_at(data, texts=1, count=37)


def odometry_numbers_at(data: Buffer) -> int | None:
    """Where the numbers of nav_msgs/Odometry begin; None if they do not fill the rest of the message."""
    return _numbers_at(data, texts=2, count=85)


def _numbers_at(data: Buffer, texts: int, count: int) -> int | None:
    """Where `count` numbers begin that fill a message behind its stamp and some texts."""
    at = _STAMP_BYTES
    for _ in range(texts):
        if at + _U32.size > len(data):
            return None
        at += _U32.size + _U32.unpack_from(data, at)[0]
    return at if at + 8 * count == len(data) else None


def imu(data: Buffer) -> Imu:
    """Decode sensor_msgs/Imu."""
    header, at = _header(data)
    v = _numbers(_IMU, data, at)
    return Imu(header, Quaternion(*v[:4]), v[4:13], Vector(*v[13:16]), v[16:25], Vector(*v[25:28]), v[28:])


def odometry(data: Buffer) -> Odometry:
    """Decode nav_msgs/Odometry."""
    header, at = _header(data)
    child, at = _text(data, at)
    v = _numbers(_ODOMETRY, data, at)
    pose = PoseWithCovariance(Pose(Vector(*v[:3]), Quaternion(*v[3:7])), v[7:43])
    twist = TwistWithCovariance(Twist(Vector(*v[43:46]), Vector(*v[46:49])), v[49:])
    return Odometry(header, child, pose, twist)


def image(data: Buffer) -> Image:
    """Decode sensor_msgs/Image."""
    header, at = _header(data)
    height, width = _SIZE.unpack_from(data, at)
    encoding, at = _text(data, at + _SIZE.size)
    big_endian, step, size = _ROW.unpack_from(data, at)
    if at + _ROW.size + size != len(data):
        raise WireError
    pixels = np.frombuffer(data, np.uint8, size, at + _ROW.size)
    return Image(header, height, width, encoding, big_endian, step, pixels)


LAYOUTS: dict[tuple[str, str], Callable[[Buffer], Any]] = {
    ("sensor_msgs/msg/Imu", "6a62c6daae103f4ff57a132d6f95cec2"): imu,
    ("nav_msgs/msg/Odometry", "cd5e73d190d741a2f92e81eda573aca7"): odometry,
    ("sensor_msgs/msg/Image", "060021388200f6f0f447d0fcd9c64743"): image,
}
"""Decoders by the name of the type and the MD5 sum of its definition."""
