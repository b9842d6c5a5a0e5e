"""Message → sample, one function for each type of message.

Each function takes the decoded message, an object with attributes, and its `Arrival`. The same function
serves a type in ROS 1, ROS 2, JSON and protobuf: field names differ only in the time stamps and in the case
of the calibration matrices. Quaternions are x, y, z, w; everything comes out in SI units and radians.
"""

from __future__ import annotations

import base64
import binascii
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, TypedDict

import numpy as np

from readers.clock import sane_stamp
from readers.decoding import MessageError
from readers.images import RAW_FORMATS, image_header, is_depth
from readers.message_log import escaped
from readers.streams import (
    LATEST_NS,
    UNKNOWN_COV3,
    UNKNOWN_COV6,
    UNKNOWN_QUAT,
    UNKNOWN_VEC3,
    Camera,
    CameraInfo,
    Clock,
    FloatArray,
    GnssSample,
    ImageSample,
    ImuSample,
    OdometrySample,
    PoseSample,
    RangeSample,
    Sample,
    ScalarSample,
    StreamKind,
    TextSample,
    TrackSample,
    array,
)

TRACK_CHANNEL = "id"
NORM_TOLERANCE = 1e-3


class UnsupportedError(MessageError):
    """A kind of message that is refused by name, as all messages of its stream are."""


class OtherUseError(UnsupportedError):
    """A message of a type with several uses, and this is another one than its reader's."""


class Stamps(TypedDict):
    """The fields that every sample has."""

    stream: str
    t_ns: int
    received_ns: int
    oddities: tuple[str, ...]
    header_ns: int
    published_ns: int


@dataclass(slots=True)
class Arrival:
    """Where and when a message came, and what its sample's time is to be.

    `trust_stamps` says whether the topic's own stamps are a clock, `clock` which time was asked for, and `offset_ns`
    what is added to it.
    """

    stream: str
    received_ns: int
    trust_stamps: bool = True
    oddities: list[str] = field(default_factory=list)
    published_ns: int = -1
    clock: Clock = Clock.HEADER
    offset_ns: int = 0

    @property
    def source(self) -> str:
        """The message, for people to find it again."""
        return f"{self.stream}, logged at {self.received_ns} ns"

    def stamps(self, stamp: Any = None) -> Stamps:
        """The times of the sample: by the clock asked for where that is sane, else the log time, which is noted.

        Call it last: it takes the oddities found so far with it.
        """
        return self.stamps_ns(None if stamp is None else stamp_ns(stamp))

    def stamps_ns(self, own_ns: int | None) -> Stamps:
        """The same of a stamp in nanoseconds, None for none."""
        header_ns = -1 if own_ns is None else own_ns
        t_ns = self.received_ns
        if self.clock is Clock.PUBLISH:
            t_ns = self._sane(self.published_ns, "foreign_publish_time")
        elif self.clock is Clock.HEADER and own_ns is not None:
            t_ns = self._sane(header_ns, "foreign_stamp")
            if not self.trust_stamps and t_ns == header_ns:
                self.oddities.append("frozen_stamp")
                t_ns = self.received_ns
        return Stamps(
            stream=self.stream,
            t_ns=min(t_ns + self.offset_ns, LATEST_NS),
            received_ns=self.received_ns,
            oddities=tuple(self.oddities),
            header_ns=header_ns,
            published_ns=self.published_ns,
        )

    def _sane(self, t_ns: int, oddity: str) -> int:
        """A time of the log's epoch, or the log time, which is noted."""
        if sane_stamp(t_ns, self.received_ns):
            return t_ns
        self.oddities.append(oddity)
        return self.received_ns


def stamp_ns(stamp: Any) -> int:
    """Nanoseconds of a time stamp of ROS 1, ROS 2, Foxglove JSON or protobuf."""
    for seconds, nanoseconds in (("sec", "nanosec"), ("sec", "nsec"), ("seconds", "nanos"), ("secs", "nsecs")):
        if hasattr(stamp, seconds) and hasattr(stamp, nanoseconds):
            return _nanoseconds(getattr(stamp, seconds), getattr(stamp, nanoseconds))
    raise MessageError("the time stamp has no seconds and nanoseconds")


def _nanoseconds(seconds: Any, rest: Any) -> int:
    try:
        found = int(seconds) * 1_000_000_000 + int(rest)
    except (TypeError, ValueError, OverflowError) as error:
        raise MessageError("the time stamp is no number") from error
    if abs(found) > LATEST_NS:
        raise MessageError(f"the time stamp of {found / 1e9:.3g} s does not fit into 64 bits")
    return found


def header_stamp(message: Any) -> Any:
    """The stamp that a message carries itself, None if its type has none."""
    header = getattr(message, "header", None)
    return header.stamp if header is not None else getattr(message, "timestamp", None)


def frame_of(message: Any) -> str:
    """Name of the frame that the message is in, without a leading slash, "" if it names none."""
    holder = getattr(message, "header", message)
    return plain_frame(getattr(holder, "frame_id", ""))


def plain_frame(name: Any) -> str:
    """A frame's name without the leading slash of old tf, `escaped`."""
    frame = str(name).lstrip("/")
    return frame if frame.isprintable() else escaped(frame)


# ------------------------------------------------------------------------------ small parts


def _number(value: Any) -> float:
    """A number; in JSON, ``null`` is NaN (rosbridge's form), and ``"NaN"``, ``"Infinity"`` are texts (protobuf's)."""
    return math.nan if value is None else float(value)


def _vector(v: Any) -> FloatArray:
    return array(v.x, v.y, v.z)


def _xyzw(q: Any) -> FloatArray:
    return array(q.x, q.y, q.z, q.w)


def _quaternion(q: Any, arrival: Arrival) -> FloatArray:
    """Orientation x, y, z, w; NaN for an all-zero one, scaled where it is not of unit norm. Both are noted."""
    return _unit(_xyzw(q), arrival)


def _unit(quat: FloatArray, arrival: Arrival) -> FloatArray:
    norm = math.hypot(*quat.tolist())
    if norm == 0.0:
        arrival.oddities.append("zero_quaternion")
        return UNKNOWN_QUAT
    if abs(norm - 1.0) > NORM_TOLERANCE:
        arrival.oddities.append("quaternion_norm")
        return array(*(quat / norm))
    return quat


def _matrix(values: Any, rows: int, columns: int) -> FloatArray:
    """Row-major numbers as a matrix; NaN where the message has none."""
    flat = np.array(values, dtype=np.float64).reshape(-1)
    if flat.size == 0:
        flat = np.full(rows * columns, np.nan)
    if flat.size != rows * columns:
        raise MessageError(f"a {rows} x {columns} matrix has {flat.size} numbers")
    flat.setflags(write=False)
    return flat.reshape(rows, columns)


def _covariance6(values: Any) -> FloatArray:
    """A 6 x 6 covariance; ROS writes an unknown one as zeros."""
    covariance = _matrix(values, 6, 6)
    return covariance if np.any(covariance) else UNKNOWN_COV6


def _bytes(data: Any) -> bytes | memoryview:
    """The bytes of a field: as they lie in the message where possible, decoded from base64 in JSON."""
    if isinstance(data, str):
        try:
            return base64.b64decode(data, validate=True)
        except binascii.Error as error:
            raise MessageError(f"the image data are no base64 ({error})") from error
    if isinstance(data, np.ndarray):
        return data.data.cast("B") if data.size else b""
    return bytes(data)


# ----------------------------------------------------------------------------------- images


def image(message: Any, arrival: Arrival) -> ImageSample:
    """sensor_msgs/Image and foxglove.RawImage: the pixels stay where they are in the message."""
    stamp = header_stamp(message)
    return image_sample(
        arrival,
        None if stamp is None else stamp_ns(stamp),
        str(message.encoding),
        _bytes(message.data),
        int(message.width),
        int(message.height),
        int(message.step),
        bool(getattr(message, "is_bigendian", False)),
    )


def image_sample(
    arrival: Arrival,
    own_ns: int | None,
    encoding: str,
    payload: bytes | memoryview,
    width_px: int,
    height_px: int,
    step_bytes: int,
    big_endian: bool,
) -> ImageSample:
    """An image whose pixels are the rows of `payload`.

    Raises:
        MessageError: they are fewer than it states.
    """
    if height_px * step_bytes > len(payload):
        raise MessageError(f"the image states {height_px} rows of {step_bytes} bytes and holds {len(payload)} bytes")
    form = RAW_FORMATS.get(encoding.lower())
    if step_bytes and form is not None and len(payload) > (height_px * form.rows + 1) // 2 * step_bytes:
        arrival.oddities.append("spare_bytes")
    return ImageSample(
        **arrival.stamps_ns(own_ns),
        encoding=encoding,
        payload=payload,
        width_px=width_px,
        height_px=height_px,
        step_bytes=step_bytes,
        big_endian=big_endian,
        source=arrival.source,
    )


def compressed_image(message: Any, arrival: Arrival) -> ImageSample:
    """sensor_msgs/CompressedImage and foxglove.CompressedImage."""
    stamp = header_stamp(message)
    own_ns = None if stamp is None else stamp_ns(stamp)
    return compressed_sample(arrival, own_ns, str(message.format), _bytes(message.data))


def compressed_sample(arrival: Arrival, own_ns: int | None, stated: str, payload: bytes | memoryview) -> ImageSample:
    """An image that `payload` holds in a compressed form, which is `stated`.

    Raises:
        MessageError: it holds no bytes.
    """
    if not payload:
        raise MessageError("the image holds no bytes")
    encoding, width, height = (stated, 0, 0) if is_depth(stated) else image_header(payload)
    return ImageSample(
        **arrival.stamps_ns(own_ns),
        encoding=encoding or stated_format(stated),
        payload=payload,
        width_px=width,
        height_px=height,
        source=arrival.source,
    )


def stated_format(stated: str) -> str:
    """Name of the compressed format that a message states.

    ROS states ``jpeg``, ``png``, or a sentence such as ``rgb8; jpeg compressed bgr8``.
    """
    sentence = stated.rpartition(";")[2].split()
    name = sentence[0].lower() if sentence else "unknown"
    return {"jpg": "jpeg", "tif": "tiff"}.get(name, name)


def camera_info(message: Any, arrival: Arrival) -> CameraInfo:
    """sensor_msgs/CameraInfo and foxglove.CameraCalibration."""

    def numbers(name: str) -> Any:
        return getattr(message, name) if hasattr(message, name) else getattr(message, name.lower())

    stamp = header_stamp(message)
    return camera_sample(
        arrival,
        None if stamp is None else stamp_ns(stamp),
        frame_of(message),
        int(message.width),
        int(message.height),
        message.distortion_model,
        *(numbers(name) for name in "DKRP"),
    )


def camera_sample(
    arrival: Arrival,
    own_ns: int | None,
    frame: str,
    width_px: int,
    height_px: int,
    model: str,
    distortion: Any,
    matrix: Any,
    rectification: Any,
    projection: Any,
) -> CameraInfo:
    """Intrinsics; the numbers are in any form, D [n], K [9], R [9] and P [12] row by row.

    Raises:
        MessageError: they have other lengths.
    """
    coefficients = np.array(distortion, dtype=np.float64).reshape(-1)
    coefficients.setflags(write=False)
    camera = Camera(
        width_px=width_px,
        height_px=height_px,
        matrix=_matrix(matrix, 3, 3),
        distortion_model=_distortion_model(model, coefficients),
        distortion=coefficients,
        rectification=_matrix(rectification, 3, 3),
        projection=_matrix(projection, 3, 4),
        frame=frame,
    )
    return CameraInfo(**arrival.stamps_ns(own_ns), camera=camera)


def _distortion_model(stated: str, distortion: FloatArray) -> str:
    if stated:
        return stated
    if not np.any(distortion):
        return "none"
    return "rational_polynomial" if distortion.size == 8 else "plumb_bob"


# ----------------------------------------------------------------------------------- motion


def imu(message: Any, arrival: Arrival) -> ImuSample:
    """sensor_msgs/Imu."""
    return imu_sample(
        arrival,
        stamp_ns(message.header.stamp),
        _xyzw(message.orientation),
        array(*message.orientation_covariance),
        _vector(message.angular_velocity),
        message.angular_velocity_covariance[0],
        _vector(message.linear_acceleration),
        message.linear_acceleration_covariance[0],
    )


def imu_sample(
    arrival: Arrival,
    own_ns: int,
    quat: FloatArray,
    quat_covariance: FloatArray,
    rate_radps: FloatArray,
    rate_variance: float,
    force_mps2: FloatArray,
    force_variance: float,
) -> ImuSample:
    """An inertial measurement; what a covariance that begins with -1 marks as not measured is NaN."""
    quat = UNKNOWN_QUAT if quat_covariance[0] == -1.0 else _unit(quat, arrival)
    if quat[3] == 1.0 and not np.any(quat[:3]) and not np.any(quat_covariance):
        arrival.oddities.append("identity_orientation")
    return ImuSample(
        **arrival.stamps_ns(own_ns),
        angular_velocity_radps=UNKNOWN_VEC3 if rate_variance == -1.0 else rate_radps,
        linear_acceleration_mps2=UNKNOWN_VEC3 if force_variance == -1.0 else force_mps2,
        quat_xyzw=quat,
    )


def odometry(message: Any, arrival: Arrival) -> OdometrySample:
    """nav_msgs/Odometry: twist in the child frame, pose in the header's frame."""
    pose, twist = message.pose.pose, message.twist.twist
    return odometry_sample(
        arrival,
        stamp_ns(message.header.stamp),
        _vector(pose.position),
        _xyzw(pose.orientation),
        _vector(twist.linear),
        _vector(twist.angular),
    )


def odometry_sample(
    arrival: Arrival,
    own_ns: int,
    position_m: FloatArray,
    quat: FloatArray,
    velocity_mps: FloatArray,
    rate_radps: FloatArray,
) -> OdometrySample:
    """A pose with velocities."""
    quat = _unit(quat, arrival)
    return OdometrySample(
        **arrival.stamps_ns(own_ns),
        linear_velocity_mps=velocity_mps,
        angular_velocity_radps=rate_radps,
        position_m=position_m,
        quat_xyzw=quat,
    )


def twist(message: Any, arrival: Arrival) -> OdometrySample:
    """geometry_msgs/Twist (at its log time) and TwistStamped."""
    velocity = message.twist if hasattr(message, "twist") else message
    return OdometrySample(
        **arrival.stamps(header_stamp(message)),
        linear_velocity_mps=_vector(velocity.linear),
        angular_velocity_radps=_vector(velocity.angular),
        position_m=UNKNOWN_VEC3,
        quat_xyzw=UNKNOWN_QUAT,
    )


def pose(message: Any, arrival: Arrival) -> PoseSample:
    """geometry_msgs/PoseStamped, PoseWithCovarianceStamped and foxglove.PoseInFrame."""
    inner, covariance = message.pose, UNKNOWN_COV6
    if hasattr(inner, "covariance"):
        inner, covariance = inner.pose, _covariance6(inner.covariance)
    stamp = header_stamp(message)
    own_ns = None if stamp is None else stamp_ns(stamp)
    position_m, quat = _vector(inner.position), _xyzw(inner.orientation)
    return pose_sample(arrival, own_ns, frame_of(message), position_m, quat, covariance)


def pose_sample(
    arrival: Arrival,
    own_ns: int | None,
    frame: str,
    position_m: FloatArray,
    quat: FloatArray,
    covariance: FloatArray = UNKNOWN_COV6,
) -> PoseSample:
    """A pose in a frame."""
    quat = _unit(quat, arrival)
    return PoseSample(
        **arrival.stamps_ns(own_ns),
        position_m=position_m,
        quat_xyzw=quat,
        covariance=covariance,
        parent_frame=frame,
    )


def transform(message: Any, arrival: Arrival) -> PoseSample:
    """geometry_msgs/TransformStamped and foxglove.FrameTransform, as `parent_T_child`."""
    inner = getattr(message, "transform", message)
    parent = message.parent_frame_id if hasattr(message, "parent_frame_id") else message.header.frame_id
    quat = _quaternion(inner.rotation, arrival)
    return PoseSample(
        **arrival.stamps(header_stamp(message)),
        position_m=_vector(inner.translation),
        quat_xyzw=quat,
        covariance=UNKNOWN_COV6,
        parent_frame=plain_frame(parent),
        child_frame=plain_frame(message.child_frame_id),
    )


def transforms(message: Any, arrival: Arrival) -> list[PoseSample]:
    """tf2_msgs/TFMessage, tf/tfMessage, foxglove.FrameTransform(s): each frame pair is a stream of its own."""
    found = []
    for part in message.transforms if hasattr(message, "transforms") else [message]:
        single = transform(part, replace(arrival, oddities=[]))
        stream = pair_stream(arrival.stream, single.parent_frame, single.child_frame)
        found.append(replace(single, stream=stream))
    return found


def pair_stream(topic: str, parent: str, child: str) -> str:
    """Name of the stream of one frame pair of a tf topic, such as ``/tf:odom->base_link``."""
    return f"{topic}:{plain_frame(parent)}->{plain_frame(child)}"


# ---------------------------------------------------------------------------------- scalars


def fix(message: Any, arrival: Arrival) -> GnssSample:
    """sensor_msgs/NavSatFix, and foxglove.LocationFix, which has no status; degrees become radians."""
    known = message.position_covariance_type != 0
    return GnssSample(
        **arrival.stamps(header_stamp(message)),
        latitude_rad=math.radians(_number(message.latitude)),
        longitude_rad=math.radians(_number(message.longitude)),
        altitude_m=_number(message.altitude),
        covariance_m2=_matrix(message.position_covariance, 3, 3) if known else UNKNOWN_COV3,
        status=int(message.status.status) if hasattr(message, "status") else 0,
    )


def distance(message: Any, arrival: Arrival) -> RangeSample:
    """sensor_msgs/Range."""
    return RangeSample(
        **arrival.stamps(message.header.stamp),
        range_m=_number(message.range),
        min_range_m=_number(message.min_range),
        max_range_m=_number(message.max_range),
        field_of_view_rad=_number(message.field_of_view),
    )


def scalar(message: Any, arrival: Arrival) -> ScalarSample:
    """std_msgs/Float64, at its log time."""
    return ScalarSample(**arrival.stamps(), value=_number(message.data))


# ----------------------------------------------------------------------------- tracks and text


def tracks(message: Any, arrival: Arrival) -> TrackSample:
    """sensor_msgs/PointCloud of pixel tracks: x = u and y = v in px, the tracks' numbers in the channel ``id``."""
    ids = next((channel.values for channel in message.channels if channel.name == TRACK_CHANNEL), None)
    if ids is None:
        raise OtherUseError(f"a PointCloud without a channel {TRACK_CHANNEL!r} holds no pixel tracks")
    points = np.array([(point.x, point.y) for point in message.points], dtype=np.float64).reshape(-1, 2)
    if len(ids) != len(points):
        raise MessageError(f"the PointCloud has {len(points)} points and {len(ids)} numbers of tracks")
    numbers = np.array(ids, dtype=np.float64).astype(np.int64)
    for values in (numbers, points):
        values.setflags(write=False)
    return TrackSample(**arrival.stamps(message.header.stamp), ids=numbers, points_px=points)


def words(message: Any, arrival: Arrival) -> TextSample:
    """std_msgs/String, at its log time."""
    return TextSample(**arrival.stamps(), text=str(message.data))


# --------------------------------------------------------------------------------- the table


class Reader(NamedTuple):
    """What the messages of a type become; `splits` where one message makes samples of several streams."""

    kind: StreamKind
    read: Callable[[Any, Arrival], Sample] | Callable[[Any, Arrival], list[PoseSample]]
    splits: bool = False


READERS = {
    "sensor_msgs/Image": Reader(StreamKind.IMAGE, image),
    "sensor_msgs/CompressedImage": Reader(StreamKind.IMAGE, compressed_image),
    "sensor_msgs/CameraInfo": Reader(StreamKind.CAMERA, camera_info),
    "sensor_msgs/Imu": Reader(StreamKind.IMU, imu),
    "sensor_msgs/NavSatFix": Reader(StreamKind.GNSS, fix),
    "sensor_msgs/Range": Reader(StreamKind.RANGE, distance),
    "nav_msgs/Odometry": Reader(StreamKind.ODOMETRY, odometry),
    "geometry_msgs/Twist": Reader(StreamKind.ODOMETRY, twist),
    "geometry_msgs/TwistStamped": Reader(StreamKind.ODOMETRY, twist),
    "geometry_msgs/PoseStamped": Reader(StreamKind.POSE, pose),
    "geometry_msgs/PoseWithCovarianceStamped": Reader(StreamKind.POSE, pose),
    "geometry_msgs/TransformStamped": Reader(StreamKind.POSE, transform),
    "tf2_msgs/TFMessage": Reader(StreamKind.POSE, transforms, splits=True),
    "tf/tfMessage": Reader(StreamKind.POSE, transforms, splits=True),
    "sensor_msgs/PointCloud": Reader(StreamKind.TRACK, tracks),
    "std_msgs/Float64": Reader(StreamKind.SCALAR, scalar),
    "std_msgs/String": Reader(StreamKind.TEXT, words),
    "foxglove/RawImage": Reader(StreamKind.IMAGE, image),
    "foxglove/CompressedImage": Reader(StreamKind.IMAGE, compressed_image),
    "foxglove/CameraCalibration": Reader(StreamKind.CAMERA, camera_info),
    "foxglove/LocationFix": Reader(StreamKind.GNSS, fix),
    "foxglove/PoseInFrame": Reader(StreamKind.POSE, pose),
    "foxglove/FrameTransform": Reader(StreamKind.POSE, transforms, splits=True),
    "foxglove/FrameTransforms": Reader(StreamKind.POSE, transforms, splits=True),
}


def reader_of(type_name: str) -> Reader | None:
    """The reader of a message type, by whichever of its names; None if there is none."""
    name = type_name.replace("/msg/", "/").replace("foxglove_msgs/", "foxglove/")
    return READERS.get(name.replace("foxglove.", "foxglove/"))


def samples_of(reader: Reader, message: Any, arrival: Arrival) -> Iterable[Sample]:
    """The samples of one decoded message.

    Raises:
        MessageError: a field is missing or holds what it must not.
    """
    try:
        found = reader.read(message, arrival)
    except AttributeError as error:
        raise MessageError(f"a field of the message is missing ({error})") from error
    except (TypeError, ValueError, OverflowError, LookupError) as error:
        raise MessageError(f"a field of the message cannot be used ({error})") from error
    return found if isinstance(found, list) else (found,)
