"""Small logs for the tests, written by the libraries' own writers."""

import dataclasses
import io
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mcap.writer import CompressionType, IndexType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from readers.streams import Camera, Sample

START_NS = 1_700_000_000_000_000_000
MS = 1_000_000
ROS1, ROS2 = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_HUMBLE)
for _name in ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"):
    ROS1.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", _name))


class Entry(NamedTuple):
    """One message to write."""

    topic: str
    type: str
    log_ns: int
    message: Any


class Maker:
    """Makes ROS messages of one generation."""

    def __init__(self, store: Any) -> None:
        self.store = store

    def __call__(self, name: str, **fields: Any) -> Any:
        cls = self.store.types[name]
        names = {f.name: f.type for f in dataclasses.fields(cls) if not f.name.startswith("__")}
        return cls(**{name: fields[name] if name in fields else self._blank(hint) for name, hint in names.items()})

    def _blank(self, hint: Any) -> Any:
        text = str(hint)
        if "ndarray" in text:
            return np.zeros(0)
        return {"int": 0, "float": 0.0, "str": "", "bool": False}.get(text.rpartition(".")[2], [])

    def header(self, t_ns: int, frame: str = "base") -> Any:
        stamp = self.store.types["builtin_interfaces/msg/Time"](t_ns // 10**9, t_ns % 10**9)
        return self("std_msgs/msg/Header", seq=0, stamp=stamp, frame_id=frame)

    def vector(self, x: float, y: float, z: float, name: str = "Vector3") -> Any:
        return self.store.types[f"geometry_msgs/msg/{name}"](x, y, z)

    def quaternion(self, x: float, y: float, z: float, w: float) -> Any:
        return self.store.types["geometry_msgs/msg/Quaternion"](x, y, z, w)

    def imu(self, t_ns: int, value: float = 0.0, **fields: Any) -> Any:
        covariance = np.zeros(9)
        base = {
            "header": self.header(t_ns, "imu"),
            "orientation": self.quaternion(0.0, 0.0, 0.6, 0.8),
            "orientation_covariance": covariance,
            "angular_velocity": self.vector(value, 0.1, 0.2),
            "angular_velocity_covariance": covariance,
            "linear_acceleration": self.vector(0.0, value, 9.8),
            "linear_acceleration_covariance": covariance,
        }
        return self("sensor_msgs/msg/Imu", **(base | fields))

    def image(self, t_ns: int, value: int = 0, **fields: Any) -> Any:
        pixels = (np.arange(48) + value).astype(np.uint8)
        base = {
            "header": self.header(t_ns, "camera"),
            "height": 6,
            "width": 8,
            "encoding": "mono8",
            "is_bigendian": 0,
            "step": 8,
            "data": pixels,
        }
        return self("sensor_msgs/msg/Image", **(base | fields))

    def camera_info(self, t_ns: int) -> Any:
        k, r = np.array([100.0, 0, 4, 0, 100, 3, 0, 0, 1]), np.eye(3).ravel()
        p = np.array([100.0, 0, 4, 0, 0, 100, 3, 0, 0, 0, 1, 0])
        d = np.array([0.1, -0.2, 0.0, 0.0, 0.0])
        region = self.store.types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
        both = {"D": d, "d": d, "K": k, "k": k, "R": r, "r": r, "P": p, "p": p}
        header = self.header(t_ns, "camera")
        info = {"header": header, "height": 6, "width": 8, "distortion_model": "plumb_bob", "roi": region}
        return self("sensor_msgs/msg/CameraInfo", **info, **both, binning_x=0, binning_y=0)

    def odometry(self, t_ns: int, value: float = 0.0) -> Any:
        pose = self(
            "geometry_msgs/msg/Pose",
            position=self.vector(value, 2.0, 3.0, "Point"),
            orientation=self.quaternion(0.0, 0.0, 0.0, 1.0),
        )
        twist = self("geometry_msgs/msg/Twist", linear=self.vector(value, 0.0, 0.0), angular=self.vector(0.0, 0.0, 0.5))
        covariance = np.zeros(36)
        return self(
            "nav_msgs/msg/Odometry",
            header=self.header(t_ns, "odom"),
            child_frame_id="base",
            pose=self("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=covariance),
            twist=self("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=covariance),
        )

    def transform(self, t_ns: int, parent: str, child: str, x: float = 0.0) -> Any:
        inner = self(
            "geometry_msgs/msg/Transform",
            translation=self.vector(x, 0.0, 0.0),
            rotation=self.quaternion(0.0, 0.0, 0.0, 1.0),
        )
        header = self.header(t_ns, parent)
        return self("geometry_msgs/msg/TransformStamped", header=header, child_frame_id=child, transform=inner)

    def tf(self, *transforms: Any) -> Any:
        return self("tf2_msgs/msg/TFMessage", transforms=list(transforms))


def drive(store: Any, seconds: float = 2.0) -> list[Entry]:
    """IMU at 100 Hz, images at 10 Hz with camera info, odometry at 20 Hz, tf; stamps 5 ms before log time."""
    make = Maker(store)
    entries = []
    for i in range(round(seconds * 100)):
        t = START_NS + i * 10 * MS
        log = t + 5 * MS
        entries.append(Entry("/imu", "sensor_msgs/msg/Imu", log, make.imu(t, float(i))))
        if i % 5 == 0:
            entries.append(Entry("/odom", "nav_msgs/msg/Odometry", log, make.odometry(t, float(i))))
            parts = make.tf(make.transform(t, "/odom", "/base", float(i)), make.transform(t, "base", "camera"))
            entries.append(Entry("/tf", "tf2_msgs/msg/TFMessage", log, parts))
        if i % 10 == 0:
            # Images arrive late: 45 ms after exposure.
            entries.append(Entry("/cam/image_raw", "sensor_msgs/msg/Image", log + 40 * MS, make.image(t, i)))
            entries.append(Entry("/cam/camera_info", "sensor_msgs/msg/CameraInfo", log, make.camera_info(t)))
    return sorted(entries, key=lambda entry: entry.log_ns)


def write_ros1(path: Path, entries: Iterable[Entry], compression: str = "none", chunk_bytes: int = 4096) -> Path:
    writer = Ros1Writer(path)
    writer.chunk_threshold = chunk_bytes
    if compression != "none":
        writer.set_compression(getattr(Ros1Writer.CompressionFormat, compression.upper()))
    with writer:
        connections: dict[str, Any] = {}
        for topic, kind, log_ns, message in entries:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=ROS1)
            writer.write(connections[topic], log_ns, ROS1.serialize_ros1(message, kind))
    return path


def write_ros2(path: Path, entries: Iterable[Entry], storage: str = "sqlite3", mode: str = "none") -> Path:
    plugin = {"sqlite3": StoragePlugin.SQLITE3, "mcap": StoragePlugin.MCAP}[storage]
    writer = Ros2Writer(path, version=9, storage_plugin=plugin)
    if mode != "none":
        writer.set_compression(CompressionMode[mode.upper()], CompressionFormat.ZSTD)
    with writer:
        connections: dict[str, Any] = {}
        for topic, kind, log_ns, message in entries:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=ROS2)
            writer.write(connections[topic], log_ns, ROS2.serialize_cdr(message, kind))
    return path


class Raw(NamedTuple):
    """One message to write into an MCAP file as it is."""

    topic: str
    schema: tuple[str, str, bytes]
    encoding: str
    log_ns: int
    data: bytes


def raw_ros(entries: Iterable[Entry], generation: int) -> Iterator[Raw]:
    """ROS messages as they lie in MCAP files of the profiles ros1 and ros2."""
    store = ROS1 if generation == 1 else ROS2
    definitions: dict[str, bytes] = {}
    for topic, kind, log_ns, message in entries:
        if kind not in definitions:
            definitions[kind] = store.generate_msgdef(kind, ros_version=generation)[0].encode()
        if generation == 1:
            schema = (kind.replace("/msg/", "/"), "ros1msg", definitions[kind])
            yield Raw(topic, schema, "ros1", log_ns, bytes(store.serialize_ros1(message, kind)))
        else:
            schema = (kind, "ros2msg", definitions[kind])
            yield Raw(topic, schema, "cdr", log_ns, bytes(store.serialize_cdr(message, kind)))


def write_mcap(
    path: Path, messages: Iterable[Raw], profile: str = "", compression: str = "none", **options: Any
) -> Path:
    path.write_bytes(mcap_bytes(messages, profile, compression, **options))
    return path


def mcap_bytes(messages: Iterable[Raw], profile: str = "", compression: str = "none", **options: Any) -> bytes:
    target = io.BytesIO()
    options = {"chunk_size": 4096} | options
    if options.pop("index", True) is False:
        options |= {
            "index_types": IndexType.NONE,
            "use_statistics": False,
            "use_summary_offsets": False,
            "repeat_channels": False,
            "repeat_schemas": False,
        }
    writer = McapWriter(target, compression=CompressionType[compression.upper()], **options)
    writer.start(profile=profile, library="test")
    schemas: dict[Any, int] = {}
    channels: dict[Any, int] = {}
    for topic, schema, encoding, log_ns, data in messages:
        if schema not in schemas:
            schemas[schema] = writer.register_schema(*schema) if schema[0] else 0
        key = (topic, schema, encoding)
        if key not in channels:
            channels[key] = writer.register_channel(topic, encoding, schemas[schema])
        writer.add_message(channels[key], log_time=log_ns, publish_time=log_ns, data=data)
    writer.finish()
    return target.getvalue()


def plain(sample: Sample) -> dict[str, Any]:
    """What two equal samples have in common, as a dictionary that can be compared with ==."""
    compared = (f for f in dataclasses.fields(sample) if f.compare)
    return {f.name: _plain(getattr(sample, f.name)) for f in compared} | {"": type(sample).__name__}


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return np.round(value, 12).tobytes(), value.shape
    if isinstance(value, memoryview):
        return bytes(value)
    if isinstance(value, Camera):
        return {f.name: _plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    return value
