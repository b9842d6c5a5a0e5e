"""Message → sample: each type, its units, and what is odd in it."""

import math
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from made_logs import MS, ROS1, ROS2, START_NS, Maker

from readers.decoding import MessageError
from readers.messages import READERS, Arrival, OtherUseError, reader_of, samples_of, stamp_ns
from readers.streams import StreamKind

LOG_NS = START_NS + 7 * MS
make = Maker(ROS2)


def read(kind: str, message: Any, received_ns: int = LOG_NS, **arrival: Any) -> Any:
    reader = reader_of(kind)
    assert reader is not None
    (sample,) = samples_of(reader, message, Arrival("/s", received_ns, **arrival))
    return sample


def covariance(first: float, size: int = 9) -> Any:
    values = np.zeros(size)
    values[0] = first
    return values


@pytest.mark.parametrize(
    "name",
    [
        "sensor_msgs/Imu",
        "sensor_msgs/msg/Imu",
    ],
)
def test_imu(name: str) -> None:
    sample = read(name, make.imu(START_NS, 0.5))
    assert (sample.stream, sample.t_ns, sample.received_ns, sample.oddities) == ("/s", START_NS, LOG_NS, ())
    np.testing.assert_array_equal(sample.angular_velocity_radps, [0.5, 0.1, 0.2])
    np.testing.assert_array_equal(sample.linear_acceleration_mps2, [0, 0.5, 9.8])
    np.testing.assert_array_equal(sample.quat_xyzw, [0, 0, 0.6, 0.8])


def test_imu_parts_that_are_marked_as_not_measured_are_nan() -> None:
    marked = covariance(-1.0)
    sample = read("sensor_msgs/Imu", make.imu(START_NS, orientation_covariance=marked))
    assert np.isnan(sample.quat_xyzw).all()
    assert sample.oddities == ()
    sample = read("sensor_msgs/Imu", make.imu(START_NS, angular_velocity_covariance=marked))
    assert np.isnan(sample.angular_velocity_radps).all()
    sample = read("sensor_msgs/Imu", make.imu(START_NS, linear_acceleration_covariance=marked))
    assert np.isnan(sample.linear_acceleration_mps2).all()


@pytest.mark.parametrize(
    ("quat", "first", "result", "oddities"),
    [
        ((0, 0, 0, 0), 0.0, [math.nan] * 4, ("zero_quaternion",)),
        ((0, 0, 0, 1), 0.0, [0, 0, 0, 1], ("identity_orientation",)),
        ((0, 0, 0, 1), 0.01, [0, 0, 0, 1], ()),
        ((0, 0, 0, 2), 0.01, [0, 0, 0, 1], ("quaternion_norm",)),
        ((0, 0, 0.6001, 0.8), 0.0, [0, 0, 0.6001, 0.8], ()),
    ],
)
def test_orientations_that_are_none(
    quat: tuple[float, ...], first: float, result: list[float], oddities: tuple[str, ...]
) -> None:
    message = make.imu(START_NS, orientation=make.quaternion(*quat), orientation_covariance=covariance(first))
    sample = read("sensor_msgs/Imu", message)
    np.testing.assert_array_equal(sample.quat_xyzw, result)
    assert sample.oddities == oddities


def test_odometry_has_body_twist_and_pose() -> None:
    sample = read("nav_msgs/Odometry", make.odometry(START_NS, 4.0))
    np.testing.assert_array_equal(sample.linear_velocity_mps, [4, 0, 0])
    np.testing.assert_array_equal(sample.angular_velocity_radps, [0, 0, 0.5])
    np.testing.assert_array_equal(sample.position_m, [4, 2, 3])
    np.testing.assert_array_equal(sample.quat_xyzw, [0, 0, 0, 1])


def test_twist_with_and_without_header() -> None:
    bare = make("geometry_msgs/msg/Twist", linear=make.vector(1, 2, 3), angular=make.vector(4, 5, 6))
    stamped = make("geometry_msgs/msg/TwistStamped", header=make.header(START_NS), twist=bare)
    for name, message, t_ns in (("Twist", bare, LOG_NS), ("TwistStamped", stamped, START_NS)):
        sample = read(f"geometry_msgs/{name}", message)
        assert (sample.t_ns, sample.oddities) == (t_ns, ())
        np.testing.assert_array_equal(sample.linear_velocity_mps, [1, 2, 3])
        np.testing.assert_array_equal(sample.angular_velocity_radps, [4, 5, 6])
        assert np.isnan(sample.position_m).all()


def test_poses_with_and_without_covariance() -> None:
    inner = make(
        "geometry_msgs/msg/Pose", position=make.vector(1, 2, 3, "Point"), orientation=make.quaternion(0, 0, 0, 1)
    )
    stamped = make("geometry_msgs/msg/PoseStamped", header=make.header(START_NS, "/map"), pose=inner)
    sample = read("geometry_msgs/PoseStamped", stamped)
    np.testing.assert_array_equal(sample.position_m, [1, 2, 3])
    assert np.isnan(sample.covariance).all()
    assert sample.parent_frame == "map"
    for diagonal in (0.0, 0.25):
        both = make("geometry_msgs/msg/PoseWithCovariance", pose=inner, covariance=(diagonal * np.eye(6)).ravel())
        message = make("geometry_msgs/msg/PoseWithCovarianceStamped", header=make.header(START_NS), pose=both)
        sample = read("geometry_msgs/PoseWithCovarianceStamped", message)
        if diagonal:
            np.testing.assert_array_equal(sample.covariance, diagonal * np.eye(6))
        else:
            assert np.isnan(sample.covariance).all()


@pytest.mark.parametrize("kind", ["tf2_msgs/msg/TFMessage", "tf/tfMessage"])
def test_transforms_split_by_frame_pair(kind: str) -> None:
    message = make.tf(make.transform(START_NS, "/odom", "/base", 2.0), make.transform(START_NS + MS, "base", "cam"))
    reader = reader_of(kind)
    assert reader is not None
    assert reader.splits
    samples = list(samples_of(reader, message, Arrival("/tf", LOG_NS)))
    assert [s.stream for s in samples] == ["/tf:odom->base", "/tf:base->cam"]
    assert [s.t_ns for s in samples] == [START_NS, START_NS + MS]


def test_a_single_transform() -> None:
    sample = read("geometry_msgs/TransformStamped", make.transform(START_NS, "/a", "b", 3.0))
    assert (sample.stream, sample.parent_frame, sample.child_frame) == ("/s", "a", "b")
    np.testing.assert_array_equal(sample.position_m, [3, 0, 0])


@pytest.mark.parametrize("known", [0, 2])
def test_fix_is_in_radians(known: int) -> None:
    message = make(
        "sensor_msgs/msg/NavSatFix",
        header=make.header(START_NS),
        status=make("sensor_msgs/msg/NavSatStatus", status=-1, service=1),
        latitude=45.0,
        longitude=-90.0,
        altitude=120.0,
        position_covariance=np.arange(9.0),
        position_covariance_type=known,
    )
    sample = read("sensor_msgs/NavSatFix", message)
    assert (sample.latitude_rad, sample.longitude_rad) == (math.pi / 4, -math.pi / 2)
    assert (sample.altitude_m, sample.status) == (120.0, -1)
    if known:
        np.testing.assert_array_equal(sample.covariance_m2, np.arange(9.0).reshape(3, 3))
    else:
        assert np.isnan(sample.covariance_m2).all()


def test_range_keeps_infinity() -> None:
    fields = {"radiation_type": 0, "field_of_view": 0.3, "min_range": 0.2, "max_range": 5.0, "range": math.inf}
    message = SimpleNamespace(header=make.header(START_NS), **fields)
    sample = read("sensor_msgs/Range", message)
    assert sample.range_m == math.inf
    assert (sample.min_range_m, sample.max_range_m, sample.field_of_view_rad) == (0.2, 5.0, 0.3)


def test_float_has_log_time() -> None:
    sample = read("std_msgs/Float64", make("std_msgs/msg/Float64", data=2.5))
    assert (sample.value, sample.t_ns, sample.oddities) == (2.5, LOG_NS, ())


def test_raw_image_is_not_copied() -> None:
    message = make.image(START_NS, encoding="bayer_rggb8", is_bigendian=1)
    sample = read("sensor_msgs/Image", message)
    assert (sample.encoding, sample.width_px, sample.height_px, sample.step_bytes) == ("bayer_rggb8", 8, 6, 8)
    assert sample.big_endian
    assert np.shares_memory(np.frombuffer(sample.data, np.uint8), message.data)


@pytest.mark.parametrize("change", [{"height": 7}, {"step": 9}, {"data": np.zeros(0, np.uint8)}])
def test_an_image_with_too_few_bytes_is_an_error(change: dict[str, Any]) -> None:
    with pytest.raises(MessageError, match="and holds"):
        read("sensor_msgs/Image", make.image(START_NS, **change))


@pytest.mark.parametrize(
    ("start", "stated", "result"),
    [
        (b"\xff\xd8\xff\xe0", "jpeg", "jpeg"),
        (b"\xff\xd8\xff\xe0", "png", "jpeg"),
        (b"\x89PNG\r\n\x1a\n", "", "png"),
        (b"RIFF1234WEBP", "", "webp"),
        (b"II*\0", "tif", "tiff"),
        (b"????", "rgb8; jpeg compressed bgr8", "jpeg"),
        (b"????", "mono16; png compressed ", "png"),
        (b"????", "JPG", "jpeg"),
        (b"????", "h264", "h264"),
        (b"????", "", "unknown"),
    ],
)
def test_compressed_formats(start: bytes, stated: str, result: str) -> None:
    message = SimpleNamespace(header=make.header(START_NS), format=stated, data=np.frombuffer(start + bytes(8), "u1"))
    assert read("sensor_msgs/CompressedImage", message).encoding == result


def test_compressed_images_tell_their_size() -> None:
    data = cv2.imencode(".jpg", np.zeros((30, 40), np.uint8))[1].reshape(-1)
    message = SimpleNamespace(header=make.header(START_NS), format="jpeg", data=data)
    found = read("sensor_msgs/CompressedImage", message)
    assert (found.width_px, found.height_px) == (40, 30)


def test_compressed_depth_keeps_the_format_that_says_how_to_read_it() -> None:
    message = SimpleNamespace(header=make.header(START_NS), format="32FC1; compressedDepth rvl", data=b"x" * 20)
    assert read("sensor_msgs/CompressedImage", message).encoding == "32FC1; compressedDepth rvl"


def test_bytes_beyond_the_last_row_are_noted() -> None:
    pixels = np.zeros(50, np.uint8)
    assert read("sensor_msgs/Image", make.image(START_NS)).oddities == ()
    assert read("sensor_msgs/Image", make.image(START_NS, data=pixels)).oddities == ("spare_bytes",)
    nv12 = make.image(START_NS, data=np.zeros(72, np.uint8), encoding="nv12")
    assert read("sensor_msgs/Image", nv12).oddities == ()


@pytest.mark.parametrize("store", [ROS1, ROS2])
def test_camera_info_of_both_generations(store: Any) -> None:
    camera = read("sensor_msgs/CameraInfo", Maker(store).camera_info(START_NS)).camera
    np.testing.assert_array_equal(camera.matrix, [[100, 0, 4], [0, 100, 3], [0, 0, 1]])
    np.testing.assert_array_equal(camera.distortion, [0.1, -0.2, 0, 0, 0])
    np.testing.assert_array_equal(camera.rectification, np.eye(3))
    assert camera.projection.shape == (3, 4)
    assert (camera.width_px, camera.height_px, camera.frame, camera.calibrated) == (8, 6, "camera", True)


def test_header_stamps_that_are_none_give_log_time() -> None:
    for t_ns in (0, 1, START_NS - 2 * 86_400 * 10**9, START_NS + 2 * 86_400 * 10**9):
        sample = read("sensor_msgs/Imu", make.imu(t_ns))
        assert (sample.t_ns, sample.oddities) == (LOG_NS, ("foreign_stamp",))
    sample = read("sensor_msgs/Imu", make.imu(START_NS), trust_stamps=False)
    assert (sample.t_ns, sample.oddities) == (LOG_NS, ("frozen_stamp",))


def test_stamps_of_every_encoding() -> None:
    for names in (("sec", "nanosec"), ("sec", "nsec"), ("seconds", "nanos"), ("secs", "nsecs")):
        assert stamp_ns(SimpleNamespace(**dict(zip(names, (12, 34), strict=True)))) == 12_000_000_034
    with pytest.raises(MessageError):
        stamp_ns(SimpleNamespace(time=1))


@pytest.mark.parametrize("kind", sorted(READERS))
def test_messages_without_the_fields_are_message_errors(kind: str) -> None:
    with pytest.raises(MessageError):
        list(samples_of(READERS[kind], SimpleNamespace(), Arrival("/s", LOG_NS)))


def test_type_names_are_recognised_in_all_forms() -> None:
    for name in ("foxglove.RawImage", "foxglove_msgs/msg/RawImage", "foxglove_msgs/RawImage"):
        reader = reader_of(name)
        assert reader is not None
        assert reader.kind is StreamKind.IMAGE
    assert reader_of("sensor_msgs/msg/LaserScan") is None


def test_text_comes_at_its_log_time() -> None:
    sample = read("std_msgs/String", make("std_msgs/msg/String", data="two\nlines"))
    assert (sample.text, sample.t_ns, sample.received_ns) == ("two\nlines", LOG_NS, LOG_NS)


def cloud(*channels: tuple[str, list[float]], points: int = 2) -> Any:
    return make(
        "sensor_msgs/msg/PointCloud",
        header=make.header(START_NS),
        points=[make("geometry_msgs/msg/Point32", x=1.5 + k, y=2.25 - k, z=1.0) for k in range(points)],
        channels=[
            ROS2.types["sensor_msgs/msg/ChannelFloat32"](name, np.array(values, np.float32))
            for name, values in channels
        ],
    )


def test_a_point_cloud_with_ids_is_pixel_tracks() -> None:
    sample = read("sensor_msgs/PointCloud", cloud(("u", [9, 9]), ("id", [7, 3])))
    assert sample.t_ns == START_NS
    assert (sample.ids.dtype, sample.ids.tolist()) == (np.int64, [7, 3])
    np.testing.assert_array_equal(sample.points_px, [[1.5, 2.25], [2.5, 1.25]])
    none = read("sensor_msgs/PointCloud", cloud(("id", []), points=0))
    assert none.points_px.shape == (0, 2)
    with pytest.raises(MessageError, match="2 points and 3 numbers of tracks"):
        read("sensor_msgs/PointCloud", cloud(("id", [1, 2, 3])))
    with pytest.raises(OtherUseError, match="without a channel 'id'"):
        read("sensor_msgs/PointCloud", cloud(("intensity", [1, 2])))


def test_location_fix() -> None:
    stamp = SimpleNamespace(sec=START_NS // 10**9, nsec=START_NS % 10**9)
    place = {"latitude": 60.0, "longitude": -30.0, "altitude": 12.5}
    known = {"position_covariance": list(range(1, 10)), "position_covariance_type": 3}
    sample = read("foxglove.LocationFix", SimpleNamespace(timestamp=stamp, frame_id="gps", **place, **known))
    assert (sample.t_ns, sample.altitude_m, sample.status) == (START_NS, 12.5, 0)
    assert sample.latitude_rad == pytest.approx(math.pi / 3)
    assert sample.longitude_rad == pytest.approx(-math.pi / 6)
    np.testing.assert_array_equal(sample.covariance_m2, np.arange(1, 10).reshape(3, 3))


def test_numbers_that_json_has_not() -> None:
    message = make(
        "sensor_msgs/msg/Range",
        header=make.header(START_NS),
        radiation_type=1,
        field_of_view=None,
        min_range="-Infinity",
        max_range="Infinity",
        range="NaN",
    )
    sample = read("sensor_msgs/Range", message)
    assert (sample.min_range_m, sample.max_range_m) == (-math.inf, math.inf)
    assert math.isnan(sample.range_m)
    assert math.isnan(sample.field_of_view_rad)
    pose = make(
        "geometry_msgs/msg/PoseStamped",
        header=make.header(START_NS),
        pose=make(
            "geometry_msgs/msg/Pose",
            position=make.vector(None, "NaN", 3.0, "Point"),
            orientation=make.quaternion("NaN", None, "NaN", "NaN"),
        ),
    )
    sample = read("geometry_msgs/PoseStamped", pose)
    np.testing.assert_array_equal(sample.position_m, [math.nan, math.nan, 3])
    assert np.isnan(sample.quat_xyzw).all()
    assert sample.oddities == ()
