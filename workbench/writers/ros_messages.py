"""Sample → ROS message, one function for each kind of sample; the inverse of `readers.messages`.

What is NaN in a sample is unknown. ROS says so by a covariance that begins with -1 (a whole quantity of an Imu),
by a type without that quantity (TwistStamped, PoseStamped), or by NaN in the number itself.
"""

from __future__ import annotations

import math
import struct
from collections import Counter
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import numpy as np
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from readers.messages import TRACK_CHANNEL, pair_stream
from readers.streams import (
    CameraInfo,
    FloatArray,
    GnssSample,
    ImageSample,
    ImuSample,
    OdometrySample,
    PoseSample,
    RangeSample,
    Sample,
    ScalarSample,
    StreamError,
    TextSample,
    TrackSample,
)

COMPRESSED_TOPIC = "/compressed"  # image_transport's name for the compressed form of an image topic
KNOWN_COVARIANCE, GPS = 3, 1
_TRANSFORMS = "tf2_msgs/msg/TFMessage"
_STORES = {1: Stores.ROS1_NOETIC, 2: Stores.ROS2_HUMBLE}


class Envelope(NamedTuple):
    """A message and the topic that it goes to."""

    topic: str
    message: Any


class RosMessages:
    """Builds the messages of one ROS generation; a stream that once needed a richer type keeps it.

    Args:
        generation: 1 (Noetic's definitions) or 2 (Humble's).
    """

    def __init__(self, generation: Literal[1, 2]) -> None:
        self.store = get_typestore(_STORES[generation])
        self.generation = generation
        if _TRANSFORMS not in self.store.types:
            self.store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", _TRANSFORMS))
        self._rich: set[str] = set()
        self._sent: Counter[str] = Counter()
        self._builders: dict[type[Sample], Callable[[Any, str], Envelope]] = {
            ImageSample: self._image,
            CameraInfo: self._camera,
            ImuSample: self._imu,
            OdometrySample: self._odometry,
            PoseSample: self._pose,
            RangeSample: self._range,
            GnssSample: self._fix,
            TrackSample: self._track,
            ScalarSample: self._scalar,
            TextSample: self._text,
        }

    def build(self, sample: Sample, frame: str) -> Envelope | None:
        """The message of a sample; None for a kind of sample that is not ours.

        Args:
            sample: any sample but a `Problem`.
            frame: the coordinate frame of its stream.

        Raises:
            StreamError: a number of it does not fit into the message.
        """
        builder = self._builders.get(type(sample))
        return builder(sample, frame) if builder else None

    def serialized(self, sample: Sample, message: Any) -> bytes:
        """The bytes of a message.

        Raises:
            StreamError: a number of it does not fit.
        """
        serialize = self.store.serialize_ros1 if self.generation == 1 else self.store.serialize_cdr
        try:
            return bytes(serialize(message, message.__msgtype__))
        except (SerdeError, struct.error, OverflowError, ValueError) as error:
            raise StreamError(
                f"{sample.stream}: the message of {sample.t_ns} ns does not fit into {message.__msgtype__} ({error}); "
                "leave the stream out"
            ) from error

    def definition(self, name: str) -> str:
        """The definition of a type with those of its parts."""
        text: str = self.store.generate_msgdef(name, ros_version=self.generation)[0]
        return text

    # ------------------------------------------------------------------------- small parts

    def _make(self, type_name: str, /, **fields: Any) -> Any:
        return self.store.types[type_name](**fields)

    def _header(self, sample: Sample, frame: str) -> Any:
        seconds, nanoseconds = divmod(sample.t_ns, 1_000_000_000)
        stamp = self._make("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)
        number = {}
        if self.generation == 1:
            number = {"seq": self._sent[sample.stream]}
            self._sent[sample.stream] += 1
        return self._make("std_msgs/msg/Header", **number, stamp=stamp, frame_id=frame)

    def _xyz(self, values: FloatArray, name: str = "Vector3") -> Any:
        x, y, z = (float(value) for value in values)
        return self._make(f"geometry_msgs/msg/{name}", x=x, y=y, z=z)

    def _quaternion(self, values: FloatArray) -> Any:
        x, y, z, w = (float(value) for value in values)
        return self._make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)

    def _pose_part(self, position_m: FloatArray, quat_xyzw: FloatArray) -> Any:
        position, orientation = self._xyz(position_m, "Point"), self._quaternion(quat_xyzw)
        return self._make("geometry_msgs/msg/Pose", position=position, orientation=orientation)

    def _needs_rich(self, stream: str, *values: FloatArray) -> bool:
        """Whether one of the values is known, or was in an earlier message of the stream."""
        if any(_known(value) for value in values):
            self._rich.add(stream)
        return stream in self._rich

    # ------------------------------------------------------------------------------ images

    def _image(self, sample: ImageSample, frame: str) -> Envelope:
        data = np.frombuffer(sample.data, dtype=np.uint8)
        header = self._header(sample, frame)
        if not sample.step_bytes:
            message = self._make("sensor_msgs/msg/CompressedImage", header=header, format=sample.encoding, data=data)
            return Envelope(compressed_topic(sample.stream), message)
        message = self._make(
            "sensor_msgs/msg/Image",
            header=header,
            height=sample.height_px,
            width=sample.width_px,
            encoding=sample.encoding,
            is_bigendian=int(sample.big_endian),
            step=sample.step_bytes,
            data=data,
        )
        return Envelope(sample.stream, message)

    def _camera(self, sample: CameraInfo, frame: str) -> Envelope:
        camera = sample.camera
        matrices = {
            "d": camera.distortion,
            "k": camera.matrix.ravel(),
            "r": camera.rectification.ravel(),
            "p": camera.projection.ravel(),
        }
        if self.generation == 1:
            matrices = {name.upper(): values for name, values in matrices.items()}
        region = {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False}
        message = self._make(
            "sensor_msgs/msg/CameraInfo",
            header=self._header(sample, camera.frame or frame),
            height=camera.height_px,
            width=camera.width_px,
            distortion_model=camera.distortion_model,
            **matrices,
            binning_x=0,
            binning_y=0,
            roi=self._make("sensor_msgs/msg/RegionOfInterest", **region),
        )
        return Envelope(sample.stream, message)

    def _track(self, sample: TrackSample, frame: str) -> Envelope:
        ids = sample.ids.astype(np.float32)
        if not np.array_equal(ids.astype(np.int64), sample.ids):
            raise StreamError(
                f"{sample.stream}: a track has a number above 2^24, which a PointCloud does not hold exactly; "
                "leave the stream out"
            )
        points = [self._make("geometry_msgs/msg/Point32", x=float(u), y=float(v), z=1.0) for u, v in sample.points_px]
        message = self._make(
            "sensor_msgs/msg/PointCloud",
            header=self._header(sample, frame),
            points=points,
            channels=[self._make("sensor_msgs/msg/ChannelFloat32", name=TRACK_CHANNEL, values=ids)],
        )
        return Envelope(sample.stream, message)

    # ------------------------------------------------------------------------------ motion

    def _imu(self, sample: ImuSample, frame: str) -> Envelope:
        quat, rate, force = sample.quat_xyzw, sample.angular_velocity_radps, sample.linear_acceleration_mps2
        message = self._make(
            "sensor_msgs/msg/Imu",
            header=self._header(sample, frame),
            orientation=self._quaternion(quat if _known(quat) else np.array([0.0, 0.0, 0.0, 1.0])),
            orientation_covariance=_measured(quat),
            angular_velocity=self._xyz(rate if _known(rate) else np.zeros(3)),
            angular_velocity_covariance=_measured(rate),
            linear_acceleration=self._xyz(force if _known(force) else np.zeros(3)),
            linear_acceleration_covariance=_measured(force),
        )
        return Envelope(sample.stream, message)

    def _odometry(self, sample: OdometrySample, frame: str) -> Envelope:
        header = self._header(sample, frame)
        twist = self._make(
            "geometry_msgs/msg/Twist",
            linear=self._xyz(sample.linear_velocity_mps),
            angular=self._xyz(sample.angular_velocity_radps),
        )
        if not self._needs_rich(sample.stream, sample.position_m, sample.quat_xyzw):
            message = self._make("geometry_msgs/msg/TwistStamped", header=header, twist=twist)
            return Envelope(sample.stream, message)
        pose, unknown = self._pose_part(sample.position_m, sample.quat_xyzw), np.zeros(36)
        message = self._make(
            "nav_msgs/msg/Odometry",
            header=header,
            child_frame_id="",
            pose=self._make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=unknown),
            twist=self._make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=unknown),
        )
        return Envelope(sample.stream, message)

    def _pose(self, sample: PoseSample, frame: str) -> Envelope:
        header = self._header(sample, sample.parent_frame or frame)
        if (topic := transform_topic(sample)) is not None:
            return Envelope(topic, self._make(_TRANSFORMS, transforms=[self._transform(sample, header)]))
        pose = self._pose_part(sample.position_m, sample.quat_xyzw)
        if not self._needs_rich(sample.stream, sample.covariance):
            return Envelope(sample.stream, self._make("geometry_msgs/msg/PoseStamped", header=header, pose=pose))
        covariance = sample.covariance.ravel() if _known(sample.covariance) else np.zeros(36)
        uncertain = self._make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=covariance)
        kind = "geometry_msgs/msg/PoseWithCovarianceStamped"
        return Envelope(sample.stream, self._make(kind, header=header, pose=uncertain))

    def _transform(self, sample: PoseSample, header: Any) -> Any:
        translation, rotation = self._xyz(sample.position_m), self._quaternion(sample.quat_xyzw)
        return self._make(
            "geometry_msgs/msg/TransformStamped",
            header=header,
            child_frame_id=sample.child_frame,
            transform=self._make("geometry_msgs/msg/Transform", translation=translation, rotation=rotation),
        )

    # ------------------------------------------------------------------------------ scalars

    def _range(self, sample: RangeSample, frame: str) -> Envelope:
        message = self._make(
            "sensor_msgs/msg/Range",
            header=self._header(sample, frame),
            radiation_type=self.store.types["sensor_msgs/msg/Range"].INFRARED,
            field_of_view=sample.field_of_view_rad,
            min_range=sample.min_range_m,
            max_range=sample.max_range_m,
            range=sample.range_m,
        )
        return Envelope(sample.stream, message)

    def _fix(self, sample: GnssSample, frame: str) -> Envelope:
        known = _known(sample.covariance_m2)
        message = self._make(
            "sensor_msgs/msg/NavSatFix",
            header=self._header(sample, frame),
            status=self._make("sensor_msgs/msg/NavSatStatus", status=sample.status, service=GPS),
            latitude=math.degrees(sample.latitude_rad),
            longitude=math.degrees(sample.longitude_rad),
            altitude=sample.altitude_m,
            position_covariance=sample.covariance_m2.ravel() if known else np.zeros(9),
            position_covariance_type=KNOWN_COVARIANCE if known else 0,
        )
        return Envelope(sample.stream, message)

    def _scalar(self, sample: ScalarSample, frame: str) -> Envelope:
        return Envelope(sample.stream, self._make("std_msgs/msg/Float64", data=sample.value))

    def _text(self, sample: TextSample, frame: str) -> Envelope:
        return Envelope(sample.stream, self._make("std_msgs/msg/String", data=sample.text))


def compressed_topic(stream: str) -> str:
    """The topic of the compressed images of a stream."""
    return stream if stream.endswith(COMPRESSED_TOPIC) else stream + COMPRESSED_TOPIC


def transform_topic(sample: PoseSample) -> str | None:
    """The topic of transforms that the reader split this stream from, None for a stream of poses."""
    topic = sample.stream.removesuffix(pair_stream("", sample.parent_frame, sample.child_frame))
    return topic if topic != sample.stream else None


def _known(values: FloatArray) -> bool:
    return not bool(np.all(np.isnan(values)))


def _measured(values: FloatArray) -> FloatArray:
    """The 3 x 3 covariance of a quantity of an Imu: unknown, or -1 first where it was not measured at all."""
    covariance = np.zeros(9)
    covariance[0] = 0.0 if _known(values) else -1.0
    return covariance
