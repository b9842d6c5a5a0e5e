"""CDR messages of the commonest types → samples, straight from their bytes.

Only where a channel's definition is that of the standard type, and only for messages whose length is exactly the one
that their fields add up to; everything else is left to the generic decoding, which has the words for what is wrong.
The layout is that of plain little-endian CDR: a field lies at a multiple of its size from byte 4 on.
"""

from __future__ import annotations

import struct
from collections.abc import Callable

import numpy as np

from readers.decoding import ros_name
from readers.message_log import Buffer, Channel, text
from readers.messages import (
    Arrival,
    camera_sample,
    compressed_sample,
    image_sample,
    imu_sample,
    odometry_sample,
    plain_frame,
    pose_sample,
)
from readers.streams import Sample

FixedReader = Callable[[Buffer, Arrival], Sample | None]
Fields = tuple[str, ...]

_VECTOR: Fields = ("float64 x", "float64 y", "float64 z")
_QUATERNION: Fields = (*_VECTOR, "float64 w")
_PARTS: dict[str, Fields] = {
    "std_msgs/Header": ("builtin_interfaces/Time stamp", "string frame_id"),
    "builtin_interfaces/Time": ("int32 sec", "uint32 nanosec"),
    "geometry_msgs/Vector3": _VECTOR,
    "geometry_msgs/Point": _VECTOR,
    "geometry_msgs/Quaternion": _QUATERNION,
    "geometry_msgs/Pose": ("Point position", "Quaternion orientation"),
    "geometry_msgs/Twist": ("Vector3 linear", "Vector3 angular"),
    "geometry_msgs/PoseWithCovariance": ("Pose pose", "float64[36] covariance"),
    "geometry_msgs/TwistWithCovariance": ("Twist twist", "float64[36] covariance"),
    "sensor_msgs/Image": (
        "std_msgs/Header header",
        "uint32 height",
        "uint32 width",
        "string encoding",
        "uint8 is_bigendian",
        "uint32 step",
        "uint8[] data",
    ),
    "sensor_msgs/CompressedImage": ("std_msgs/Header header", "string format", "uint8[] data"),
    "sensor_msgs/CameraInfo": (
        "std_msgs/Header header",
        "uint32 height",
        "uint32 width",
        "string distortion_model",
        "float64[] d",
        "float64[9] k",
        "float64[9] r",
        "float64[12] p",
        "uint32 binning_x",
        "uint32 binning_y",
        "RegionOfInterest roi",
    ),
    "sensor_msgs/RegionOfInterest": (
        "uint32 x_offset",
        "uint32 y_offset",
        "uint32 height",
        "uint32 width",
        "bool do_rectify",
    ),
    "geometry_msgs/PoseStamped": ("std_msgs/Header header", "Pose pose"),
    "sensor_msgs/Imu": (
        "std_msgs/Header header",
        "geometry_msgs/Quaternion orientation",
        "float64[9] orientation_covariance",
        "geometry_msgs/Vector3 angular_velocity",
        "float64[9] angular_velocity_covariance",
        "geometry_msgs/Vector3 linear_acceleration",
        "float64[9] linear_acceleration_covariance",
    ),
    "nav_msgs/Odometry": (
        "std_msgs/Header header",
        "string child_frame_id",
        "geometry_msgs/PoseWithCovariance pose",
        "geometry_msgs/TwistWithCovariance twist",
    ),
}
_STANDARD = {name: tuple(field.rpartition("/")[2] for field in fields) for name, fields in _PARTS.items()}
_START = struct.Struct("<4siII")
_U32 = struct.Struct("<I")
_IMAGE_SIZE = struct.Struct("<II")
_IMU_NUMBERS, _ODOMETRY_NUMBERS, _POSE_NUMBERS, _CAMERA_NUMBERS = 37, 85, 7, 30
_AFTER_CAMERA_BYTES = 25
_FLOAT = np.dtype("<f8")
_LITTLE_ENDIAN = b"\0\1\0\0"


def fixed_reader(channel: Channel) -> FixedReader | None:
    """The function that reads the channel's messages by their fixed layout; None if there is none for it.

    What it gives is None for a message that it leaves to the generic decoding.
    """
    name = ros_name(channel.type).replace("/msg/", "/")
    if channel.encoding != "cdr" or name not in _READERS:
        return None
    if channel.schema.strip() and (channel.schema_encoding != "ros2msg" or not _is_standard(name, channel.schema)):
        return None
    return _READERS[name]


def header_of(data: Buffer) -> tuple[int, str] | None:
    """Stamp in ns and frame of a message that begins with a header; None if it is not little-endian CDR."""
    found = _header(data)
    return None if found is None else (found[0], _frame(data, found[1]))


def _is_standard(name: str, schema: bytes) -> bool:
    """Whether a definition, and those of its parts that come with it, have the fields of the standard types."""
    definition = name
    fields: dict[str, list[str]] = {name: []}
    for line in text(schema).splitlines():
        words = line.partition("#")[0].split()
        if line.startswith("====="):
            continue
        if words[:1] == ["MSG:"] and len(words) == 2:
            definition = words[1].replace("/msg/", "/")
            fields[definition] = []
        elif len(words) >= 2 and "=" not in line.partition("#")[0]:
            fields[definition].append(f"{words[0].rpartition('/')[2]} {words[1]}")
    return all(tuple(found) == _STANDARD.get(part) for part, found in fields.items()) and _complete(name, fields)


def _complete(name: str, fields: dict[str, list[str]]) -> bool:
    """Whether all parts of a definition come with it."""
    needed = {field.split()[0].partition("[")[0] for found in fields.values() for field in found}
    plain = {"float64", "uint32", "int32", "uint8", "bool", "string"}
    return needed - plain <= {part.rpartition("/")[2] for part in fields}


def _header(data: Buffer) -> tuple[int, int] | None:
    """Stamp in ns, and where the frame's name ends."""
    if len(data) < _START.size:
        return None
    kind, seconds, nanoseconds, length = _START.unpack_from(data)
    end = _START.size + length
    if kind != _LITTLE_ENDIAN or end > len(data):
        return None
    return seconds * 1_000_000_000 + nanoseconds, end


def _frame(data: Buffer, end: int) -> str:
    """The frame that a header names."""
    return plain_frame(text(data[_START.size : end]).rstrip("\0"))


def _sized(data: Buffer, at: int) -> tuple[int, int] | None:
    """Where a text begins and where it ends, with its last zero; None if there is none, or it is not all there."""
    at += -at % 4
    if at + 4 > len(data):
        return None
    (length,) = _U32.unpack_from(data, at)
    return (at + 4, at + 4 + length) if 0 < length <= len(data) - at - 4 else None


def imu_numbers_at(data: Buffer) -> int | None:
    """Where the numbers of sensor_msgs/Imu begin; None if they do not fill the rest of the message."""
    if (header := _header(data)) is None:
        return None
    at = header[1] + (4 - header[1]) % 8
    return at if at + 8 * _IMU_NUMBERS == len(data) else None


def odometry_numbers_at(data: Buffer) -> int | None:
    """Where the numbers of nav_msgs/Odometry begin; None if they do not fill the rest of the message."""
    if (header := _header(data)) is None:
        return None
    at = header[1] + -header[1] % 4
    if at + 4 > len(data):
        return None
    at += 4 + _U32.unpack_from(data, at)[0]
    at += (4 - at) % 8
    return at if at + 8 * _ODOMETRY_NUMBERS == len(data) else None


def _stamp_ns(data: Buffer) -> int:
    _, seconds, nanoseconds, _ = _START.unpack_from(data)
    return int(seconds) * 1_000_000_000 + int(nanoseconds)


def _imu(data: Buffer, arrival: Arrival) -> Sample | None:
    if (at := imu_numbers_at(data)) is None:
        return None
    n = np.frombuffer(bytes(data[at:]), _FLOAT)  # a copy, which does not keep the chunk, and read-only
    return imu_sample(arrival, _stamp_ns(data), n[:4], n[4:13], n[13:16], n[16], n[25:28], n[28])


def _odometry(data: Buffer, arrival: Arrival) -> Sample | None:
    if (at := odometry_numbers_at(data)) is None:
        return None
    n = np.frombuffer(bytes(data[at:]), _FLOAT)
    return odometry_sample(arrival, _stamp_ns(data), n[:3], n[3:7], n[43:46], n[46:49])


def _image(data: Buffer, arrival: Arrival) -> Sample | None:
    if (header := _header(data)) is None:
        return None
    at = header[1] + -header[1] % 4
    if at + 12 > len(data):
        return None
    height, width = _IMAGE_SIZE.unpack_from(data, at)
    (length,) = _U32.unpack_from(data, at + 8)
    end = at + 12 + length
    step_at = end + 1 + -(end + 1) % 4
    if length == 0 or step_at + 8 > len(data):
        return None
    step, size = _IMAGE_SIZE.unpack_from(data, step_at)
    pixels = memoryview(data)[step_at + 8 :]
    if size != len(pixels):
        return None
    encoding = text(data[at + 12 : end - 1])
    return image_sample(arrival, header[0], encoding, pixels, width, height, step, bool(data[end]))


def _compressed_image(data: Buffer, arrival: Arrival) -> Sample | None:
    if (header := _header(data)) is None or (form := _sized(data, header[1])) is None:
        return None
    at = form[1] + -form[1] % 4 + 4
    if at > len(data) or at + _U32.unpack_from(data, at - 4)[0] != len(data):
        return None
    return compressed_sample(arrival, header[0], text(data[form[0] : form[1] - 1]), memoryview(data)[at:])


def _camera_info(data: Buffer, arrival: Arrival) -> Sample | None:
    if (header := _header(data)) is None:
        return None
    at = header[1] + -header[1] % 4
    if at + _IMAGE_SIZE.size > len(data) or (model := _sized(data, at + _IMAGE_SIZE.size)) is None:
        return None
    height, width = _IMAGE_SIZE.unpack_from(data, at)
    at = model[1] + -model[1] % 4 + 4
    if at > len(data):
        return None
    (count,) = _U32.unpack_from(data, at - 4)
    at += (4 - at) % 8
    if at + 8 * (count + _CAMERA_NUMBERS) + _AFTER_CAMERA_BYTES != len(data):
        return None
    n = np.frombuffer(bytes(data[at:-_AFTER_CAMERA_BYTES]), _FLOAT)
    name = text(data[model[0] : model[1] - 1])
    parts = np.split(n, [count, count + 9, count + 18])
    return camera_sample(arrival, header[0], _frame(data, header[1]), width, height, name, *parts)


def _pose(data: Buffer, arrival: Arrival) -> Sample | None:
    if (header := _header(data)) is None:
        return None
    at = header[1] + (4 - header[1]) % 8
    if at + 8 * _POSE_NUMBERS != len(data):
        return None
    n = np.frombuffer(bytes(data[at:]), _FLOAT)
    return pose_sample(arrival, header[0], _frame(data, header[1]), n[:3], n[3:])


_READERS: dict[str, FixedReader] = {
    "geometry_msgs/PoseStamped": _pose,
    "sensor_msgs/CameraInfo": _camera_info,
    "sensor_msgs/CompressedImage": _compressed_image,
    "sensor_msgs/Image": _image,
    "sensor_msgs/Imu": _imu,
    "nav_msgs/Odometry": _odometry,
}
