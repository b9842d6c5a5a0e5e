"""Every container that we write: read back by our own readers, and opened by a library that is not ours."""

import base64
import dataclasses
import json
import os
import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
import pytest
from evo.tools import file_interface
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from recordings_dir import RECORDINGS
from rerun.chunk import RrdReader
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Reader as Ros1Reader
from rosbags.rosbag2 import Reader as Ros2Reader
from rosbags.typesys import Stores, get_typestore
from ruamel.yaml import YAML
from scipy.spatial.transform import Rotation

from pipelines.simulation import faults
from pipelines.simulation import trajectories as ways
from pipelines.simulation.mission import IMAGE, POSE, SimulatedMission, nadir_camera, nadir_mission
from pipelines.simulation.surfaces import tiles
from readers import ReadOptions, open_recording
from readers.streams import (
    UNKNOWN_COV3,
    UNKNOWN_COV6,
    UNKNOWN_QUAT,
    UNKNOWN_VEC3,
    Camera,
    CameraInfo,
    GnssSample,
    ImageError,
    ImageSample,
    ImuSample,
    OdometrySample,
    PoseSample,
    Problem,
    RangeSample,
    Recording,
    RecordingError,
    Sample,
    ScalarSample,
    StreamError,
    StreamInfo,
    StreamKind,
    TextSample,
    TrackSample,
    array,
)
from workbench.writers import Container, Written, write
from workbench.writers.logs import RosMcap

START_NS = 1_700_000_000_123_456_789
MS = 1_000_000
LOGS = {"mcap": "m.mcap", "mcap-json": "m.mcap", "ros1": "m.bag", "ros2": "m"}
PATHS = LOGS | {"paper-a": "GRAVEL/LINE/DRY/speed_2", "euroc": "V0"}
KINDS = {
    ImageSample: StreamKind.IMAGE,
    CameraInfo: StreamKind.CAMERA,
    ImuSample: StreamKind.IMU,
    OdometrySample: StreamKind.ODOMETRY,
    PoseSample: StreamKind.POSE,
    RangeSample: StreamKind.RANGE,
    GnssSample: StreamKind.GNSS,
    TrackSample: StreamKind.TRACK,
    ScalarSample: StreamKind.SCALAR,
    TextSample: StreamKind.TEXT,
    Problem: StreamKind.IMU,
}
FAULTS = faults.to_text([faults.MotionBlur(start_s=1.0, stop_s=1.5, exposure=0.5)], START_NS, {"name": "Überfahrt"})


class Toy(Recording):
    """A recording of given samples; `stop` is called before the sample of that number is given."""

    format, path = "toy", Path("toy")

    def __init__(self, samples: list[Sample], stop: tuple[int, Callable[[], Any]] = (-1, lambda: None)) -> None:
        self._samples, self._stop = samples, stop

    @property
    def streams(self) -> tuple[StreamInfo, ...]:
        names = sorted({sample.stream for sample in self._samples})
        return tuple(self._info(name, [s for s in self._samples if s.stream == name]) for name in names)

    @staticmethod
    def _info(name: str, samples: list[Sample]) -> StreamInfo:
        received = [sample.received_ns for sample in samples]
        return StreamInfo(
            name=name,
            kind=KINDS[type(samples[0])],
            type="",
            count=len(samples),
            first_ns=min(received),
            last_ns=max(received),
            frame="frame of " + name,
        )

    @property
    def cameras(self) -> dict[str, Camera]:
        return {"/cam/image_raw": camera()}

    def read(self, streams=None, start_ns=None, stop_ns=None) -> Iterator[Sample]:
        return self._given(streams, lambda sample: sample.t_ns)

    def arrivals(self, streams=None) -> Iterator[Sample]:
        return self._given(streams, lambda sample: sample.received_ns)

    def _given(self, streams, key) -> Iterator[Sample]:
        chosen = [s for s in self._samples if streams is None or s.stream in streams]
        for number, sample in enumerate(sorted(chosen, key=key)):
            if number == self._stop[0]:
                self._stop[1]()
            yield sample


def camera(**changes: Any) -> Camera:
    fields: dict[str, Any] = {
        "width_px": 16,
        "height_px": 12,
        "matrix": array([101.25, 0, 7.5], [0, 102.5, 5.75], [0, 0, 1]),
        "distortion_model": "plumb_bob",
        "distortion": array(-0.28, 0.07, 1e-4, 2e-4, 0.003),
        "rectification": array([0, -1, 0], [1, 0, 0], [0, 0, 1]),
        "projection": array([90, 0, 7, -4], [0, 91, 6, 0.5], [0, 0, 1, 0.25]),
        "frame": "optical",
    }
    return Camera(**(fields | changes))


def pixels_of(k: int) -> np.ndarray:
    return np.random.default_rng(k).integers(0, 256, (12, 16), dtype=np.uint8)


def raw(stream: str, t_ns: int, pixels: np.ndarray, encoding: str = "mono8", **changes: Any) -> ImageSample:
    fields: dict[str, Any] = {
        "encoding": encoding,
        "payload": pixels.tobytes(),
        "width_px": pixels.shape[1],
        "height_px": pixels.shape[0],
        "step_bytes": pixels[0].nbytes,
        "received_ns": t_ns + 45 * MS,
    }
    return ImageSample(stream=stream, t_ns=t_ns, **(fields | changes))


def stored(stream: str, t_ns: int, k: int, suffix: str) -> ImageSample:
    data = cv2.imencode(suffix, pixels_of(k))[1].tobytes()
    encoding = {".jpg": "jpeg", ".png": "png"}[suffix]
    return ImageSample(stream=stream, t_ns=t_ns, received_ns=t_ns + 31 * MS, encoding=encoding, payload=data)


def quat(k: int) -> np.ndarray:
    return Rotation.from_euler("ZYX", [0.3 + 0.05 * k, 0.02 * k - 0.05, 0.1 - 0.03 * k]).as_quat()


def moment(k: int) -> list[Sample]:
    """One sample of every kind and of its special cases; every field has a value of its own."""
    t = START_NS + k * 50 * MS

    def times(stream: str, ahead: int, late: int) -> dict[str, Any]:
        return {"stream": stream, "t_ns": t + ahead, "received_ns": t + ahead + late}

    def xyz(base: float) -> np.ndarray:
        return array(base + 0.1 + k, base + 0.02 - k, base + 0.003 * k)

    covariance = np.arange(36.0).reshape(6, 6) + k + 1
    nan = float("nan")
    return [
        raw("/cam/image_raw", t, pixels_of(k)),
        stored("/left/image", t, 100 + k, ".jpg"),
        stored("/right/image/compressed", t, 200 + k, ".png"),
        CameraInfo(**times("/cam/camera_info", 0, 2 * MS), camera=camera()),
        ImuSample(
            **times("/imu", 7, 3),
            angular_velocity_radps=xyz(1),
            linear_acceleration_mps2=xyz(2),
            quat_xyzw=UNKNOWN_QUAT,
        ),
        ImuSample(
            **times("/ahrs", 8, 11 * MS),
            angular_velocity_radps=xyz(3) if k else UNKNOWN_VEC3,
            linear_acceleration_mps2=UNKNOWN_VEC3 if k else xyz(4),
            quat_xyzw=quat(k),
        ),
        OdometrySample(
            **times("/odom", 21, 5 * MS),
            linear_velocity_mps=xyz(5),
            angular_velocity_radps=xyz(6),
            position_m=xyz(7),
            quat_xyzw=quat(k + 1),
        ),
        OdometrySample(
            **times("/wheels", 22, 6 * MS),
            linear_velocity_mps=xyz(8),
            angular_velocity_radps=array(nan, nan, 0.25 * k),
            position_m=UNKNOWN_VEC3,
            quat_xyzw=UNKNOWN_QUAT,
        ),
        PoseSample(
            **times("/truth/pose", 0, 0),
            position_m=xyz(0),
            quat_xyzw=quat(k),
            covariance=UNKNOWN_COV6,
            parent_frame="world",
            child_frame="body",
        ),
        PoseSample(
            **times("/filter/pose", 31, 9 * MS),
            position_m=xyz(9),
            quat_xyzw=quat(k + 3),
            covariance=array(*covariance),
            parent_frame="map",
        ),
        PoseSample(
            **times("/tf:map->odom", 32, 2 * MS),
            position_m=xyz(10),
            quat_xyzw=quat(k + 4),
            covariance=UNKNOWN_COV6,
            parent_frame="map",
            child_frame="odom",
        ),
        RangeSample(
            **times("/height", 41, 4 * MS),
            range_m=0.2 + 0.001 * k,
            min_range_m=0.03,
            max_range_m=float("inf"),
            field_of_view_rad=0.26,
        ),
        GnssSample(
            **times("/gps", 51, 80 * MS),
            latitude_rad=0.93 + 1e-9 * k,
            longitude_rad=-0.117,
            altitude_m=41.5 + k,
            covariance_m2=array([1, 2, 3], [2, 5, 6], [3, 6, 9 + k]) if k else UNKNOWN_COV3,
            status=k - 1,
        ),
        TrackSample(
            **times("/tracks", 0, 20 * MS),
            ids=np.arange(k, 2 * k + 1) * 1000 + 7,
            points_px=np.arange(2.0 * k + 2).reshape(-1, 2) / 7 + k,
        ),
        ScalarSample(**times("/temperature", 61, 7 * MS), value=20.125 + k if k else nan),
        TextSample(**times("/words", 71, 1), text=f"word {k} \N{SNOWMAN} NaN\n"),
    ]


def everything() -> list[Sample]:
    listed = TextSample(stream=faults.FAULTS_STREAM, t_ns=START_NS, received_ns=START_NS, text=FAULTS)
    return [listed, *(sample for k in range(4) for sample in moment(k))]


@pytest.fixture(scope="module")
def mission() -> SimulatedMission:
    poses = ways.follow(ways.circle(), np.full(7, 0.008))
    return nadir_mission(
        tiles(64, np.random.default_rng(0)),
        poses,
        camera=nadir_camera(80, 60, 100),
        height_m=np.linspace(0.2, 0.21, 8),
    )


def by_stream(samples: Iterator[Sample] | list[Sample]) -> dict[str, list[Sample]]:
    found: dict[str, list[Sample]] = {}
    for sample in samples:
        found.setdefault(sample.stream, []).append(sample)
    return {stream: sorted(of, key=lambda sample: sample.t_ns) for stream, of in found.items()}


def read_back(path: Path) -> dict[str, list[Sample]]:
    with open_recording(path, ReadOptions()) as recording:
        assert recording.damage == ()
        assert all(info.readable for info in recording.streams)
        return by_stream(recording.read())


# ---------------------------------------------------------------------- our own readers: logs


def in_log(sample: Sample, container: str, image_format: str) -> Sample:
    """What becomes of a sample in a log; everything that is not said here stays as it was."""
    single = (lambda x: x) if container == "mcap-json" else (lambda x: float(np.float32(x)))
    if isinstance(sample, ImageSample) and (not sample.step_bytes or image_format != "stored"):
        return dataclasses.replace(sample, stream=sample.stream.removesuffix("/compressed") + "/compressed")
    if isinstance(sample, PoseSample) and not sample.stream.startswith("/tf"):
        return dataclasses.replace(sample, child_frame="")
    if isinstance(sample, RangeSample):
        numbers = {name: single(getattr(sample, name)) for name in ("range_m", "min_range_m", "field_of_view_rad")}
        return dataclasses.replace(sample, **numbers)
    if isinstance(sample, TrackSample) and container != "mcap-json":
        return dataclasses.replace(sample, points_px=sample.points_px.astype(np.float32).astype(float))
    if isinstance(sample, ScalarSample | TextSample):
        return dataclasses.replace(sample, t_ns=sample.received_ns)
    return sample


def assert_same(found: Sample, sent: Sample) -> None:
    assert type(found) is type(sent)
    if isinstance(found, ImageSample) and isinstance(sent, ImageSample):
        assert (found.stream, found.t_ns, found.received_ns) == (sent.stream, sent.t_ns, sent.received_ns)
        assert np.array_equal(found.grey(), sent.grey())
        return
    for field in (f for f in dataclasses.fields(sent) if f.compare):
        assert_equal(getattr(found, field.name), getattr(sent, field.name), f"{sent.stream} {field.name}")


def assert_equal(found: Any, sent: Any, name: str) -> None:
    if isinstance(sent, Camera):
        for field in dataclasses.fields(sent):
            assert_equal(getattr(found, field.name), getattr(sent, field.name), f"{name} {field.name}")
    elif name.endswith(("latitude_rad", "longitude_rad")):
        assert found == pytest.approx(sent, rel=4e-16), name  # through degrees
    elif isinstance(sent, np.ndarray | float):
        np.testing.assert_array_equal(found, sent, err_msg=name)
    else:
        assert found == sent, name


@pytest.mark.parametrize("image_format", ["png", "stored"])
@pytest.mark.parametrize("container", LOGS)
def test_logs_give_the_same_samples_again(tmp_path: Path, container: str, image_format: Any) -> None:
    path = tmp_path / LOGS[container]
    written = write(Toy(everything()), path, container=container, image_format=image_format)
    found = read_back(path)
    sent = by_stream([in_log(sample, container, image_format) for sample in everything()])
    assert set(found) == set(sent)
    for stream, samples in sent.items():
        assert len(found[stream]) == len(samples)
        for one, other in zip(found[stream], samples, strict=True):
            assert_same(one, other)
    assert written.left_out == {}
    topics = {"/tf" if name.startswith("/tf:") else name: len(samples) for name, samples in sent.items()}
    assert written.messages == topics


@pytest.mark.parametrize("container", LOGS)
def test_messages_lie_in_the_order_in_which_they_came(tmp_path: Path, container: str) -> None:
    path = tmp_path / LOGS[container]
    write(Toy(everything()), path, container=container)
    with open_recording(path) as recording:
        channels = [c for log in recording._logs for c in log.channels]  # type: ignore[attr-defined]
        logged = [message.log_ns for message in recording._messages(channels)]  # type: ignore[attr-defined]
        images = list(recording.read(["/cam/image_raw/compressed"]))
    assert logged == sorted(sample.received_ns for sample in everything())
    assert all(image.received_ns - image.t_ns == 45 * MS for image in images)
    if "mcap" in container:
        with path.open("rb") as file:
            in_file = [message.log_time for _, _, message in make_reader(file).iter_messages(log_time_order=False)]
        assert in_file == logged


def test_a_stream_keeps_its_richer_type(tmp_path: Path) -> None:
    """A pose or covariance that comes late opens a channel for it, and is not given up again."""
    posed, bare = (s for s in moment(1) if isinstance(s, OdometrySample))
    given = [
        dataclasses.replace(s, stream="/o", t_ns=START_NS + i, received_ns=START_NS + i)
        for i, s in enumerate((bare, posed, bare))
    ]
    write(Toy(given), tmp_path / "m.mcap")
    with open_recording(tmp_path / "m.mcap") as recording:
        counts = {info.type: info.count for info in recording.streams}
        assert counts == {"geometry_msgs/msg/TwistStamped": 1, "nav_msgs/msg/Odometry": 2}
        last = list(recording.read())[-1]
    assert isinstance(last, OdometrySample)
    assert np.all(np.isnan(last.position_m))
    assert np.all(np.isnan(last.quat_xyzw))


def test_big_endian_images_in_json_and_bags(tmp_path: Path) -> None:
    deep = np.arange(192, dtype=np.uint16).reshape(12, 16) * 300
    image = raw("/deep", START_NS, deep.astype(">u2"), "mono16", big_endian=True)
    for container, name in LOGS.items():
        (tmp_path / container).mkdir()
        path = tmp_path / container / name
        write(Toy([image]), path, container=container, image_format="stored")
        (sample,) = read_back(path)["/deep"]
        assert isinstance(sample, ImageSample)
        assert np.array_equal(sample.grey(), deep)


def test_what_a_log_cannot_hold_is_refused_with_its_name(tmp_path: Path) -> None:
    far = TrackSample(
        stream="/far", t_ns=START_NS, received_ns=START_NS, ids=np.array([2**24 + 1]), points_px=np.zeros((1, 2))
    )
    with pytest.raises(StreamError, match=r"/far: a track has a number above 2\^24"):
        write(Toy([far]), tmp_path / "a.mcap")
    late = ScalarSample(stream="/late", t_ns=1, received_ns=2**32 * 10**9, value=1.0)
    with pytest.raises(StreamError, match="/late: the log time 4294967296000000000 ns does not fit"):
        write(Toy([late]), tmp_path / "a.bag")
    old = RangeSample(
        stream="/old",
        t_ns=2**31 * 10**9,
        received_ns=2**31 * 10**9,
        range_m=1.0,
        min_range_m=0.0,
        max_range_m=1.0,
        field_of_view_rad=0.0,
    )
    with pytest.raises(StreamError, match="/old: the message of 2147483648000000000 ns does not fit into sensor_msgs"):
        write(Toy([old]), tmp_path / "b.mcap")
    twice = [raw("/c", START_NS, pixels_of(0)), stored("/c/compressed", START_NS, 1, ".png")]
    with pytest.raises(StreamError, match="/c/compressed and /c would both be written as /c/compressed"):
        write(Toy(twice), tmp_path / "c.mcap")
    assert list(tmp_path.iterdir()) == []


def test_problems_and_unreadable_streams_are_named(tmp_path: Path) -> None:
    problem = Problem(stream="/imu", t_ns=START_NS, received_ns=START_NS, kind=StreamKind.IMU, reason="short")
    with open_recording(RECORDINGS / "ros2_fixtures" / "sqlite3" / "talker") as talker:
        written = write(talker, tmp_path / "talker.mcap")
    assert written.messages == {"/topic": 10}
    assert written.left_out["/rosout"] == "no reader for type rcl_interfaces/msg/Log"
    written = write(Toy([problem, problem, *moment(0)]), tmp_path / "p.mcap", streams=["/imu"])
    assert written == Written({"/imu": 1}, {"/imu": "2 of its messages: they could not be decoded"})


# ------------------------------------------------------------------- our own readers: folders


def test_euroc_gives_the_same_samples_again(tmp_path: Path) -> None:
    written = write(Toy(everything()), tmp_path / "V0", container="euroc")
    found = read_back(tmp_path / "V0")
    sources = {
        "cam0": "/cam/image_raw",
        "cam1": "/left/image",
        "cam2": "/right/image/compressed",
        "imu1": "/imu",
        "pose0": "/filter/pose",
        "pose1": "/tf:map->odom",
        "state_groundtruth_estimate0": "/truth/pose",
        "/truth/faults": "/truth/faults",
    }
    assert set(found) - {"imu0"} == set(sources)
    sent = by_stream(everything())
    for name, source in sources.items():
        for one, other in zip(found[name], sent[source], strict=True):
            changes: dict[str, Any] = {"stream": name, "received_ns": other.t_ns}
            if isinstance(other, PoseSample):
                changes |= {"covariance": UNKNOWN_COV6, "parent_frame": "world", "child_frame": "body"}
                assert isinstance(one, PoseSample)
                np.testing.assert_allclose(one.quat_xyzw, other.quat_xyzw, rtol=0, atol=4e-16)
                changes["quat_xyzw"] = one.quat_xyzw
            assert_same(one, dataclasses.replace(other, **changes))
    assert written.messages["cam0"] == 4
    assert written.messages["faults.json"] == 1
    assert (tmp_path / "V0" / "faults.json").read_text(encoding="utf-8") == FAULTS
    left_out = written.left_out
    places = {"/odom": "odometry", "/wheels": "odometry", "/gps": "gnss", "/tracks": "track", "/height": "range"}
    for stream, kind in {**places, "/temperature": "scalar", "/words": "text"}.items():
        assert left_out.pop(stream) == f"an EuRoC folder has no place for {kind} streams"
    assert left_out.pop("/filter/pose").startswith("its covariance")
    assert left_out.pop("/ahrs").startswith("its orientation")
    assert left_out.pop("/left/image") == "its sensor.yaml has no intrinsics, since the recording has none"
    assert set(left_out) == {"/cam/camera_info", "/right/image/compressed"}


def test_euroc_rows_with_unknown_numbers_are_counted(tmp_path: Path) -> None:
    written = write(Toy(everything()), tmp_path / "V0", container="euroc", streams=["/ahrs"])
    assert "imu0" not in written.messages
    assert "4 of its messages: a number of it is not known" in written.left_out["/ahrs"]


@pytest.mark.parametrize(
    ("changes", "model", "count"),
    [
        ({}, "plumb_bob", 5),
        ({"distortion": array(-0.28, 0.07, 1e-4, 2e-4, 0)}, "plumb_bob", 4),
        ({"distortion_model": "equidistant", "distortion": array(1, 2, 3, 4)}, "equidistant", 4),
        ({"distortion_model": "none", "distortion": array()}, "none", 0),
        ({"body_t_camera": np.vstack([np.arange(12.0).reshape(3, 4) / 7, [0, 0, 0, 1]])}, "plumb_bob", 5),
    ],
)
def test_euroc_keeps_the_calibration(tmp_path: Path, changes: dict[str, Any], model: str, count: int) -> None:
    class Calibrated(Toy):
        @property
        def cameras(self) -> dict[str, Camera]:
            return {"/cam/image_raw": camera(**changes)}

    write(Calibrated(everything()), tmp_path / "V0", container="euroc")
    with open_recording(tmp_path / "V0") as recording:
        found = recording.cameras["cam0"]
        assert set(recording.cameras) == {"cam0"}
    sent = camera(**changes)
    np.testing.assert_array_equal(found.matrix, sent.matrix)
    np.testing.assert_array_equal(found.distortion, sent.distortion[:count])
    np.testing.assert_array_equal(found.body_t_camera, sent.body_t_camera)
    assert (found.distortion_model, found.width_px, found.height_px) == (model, 16, 12)
    settings = YAML(typ="safe").load(tmp_path / "V0" / "mav0" / "cam0" / "sensor.yaml")
    assert settings["comment"] == "/cam/image_raw"
    assert settings["rate_hz"] == pytest.approx(20)
    assert settings["distortion_model"] == {"plumb_bob": "radial-tangential"}.get(model, model)


def test_images_of_one_stamp_do_not_overwrite_each_other(tmp_path: Path) -> None:
    twins = [raw("/c", START_NS, pixels_of(0)), raw("/c", START_NS, pixels_of(1))]
    write(Toy(twins), tmp_path / "V0", container="euroc")
    found = read_back(tmp_path / "V0")["cam0"]
    assert [np.array_equal(s.grey(), pixels_of(k)) for k, s in enumerate(found)] == [True, True]  # type: ignore


def paper_samples() -> list[Sample]:
    """Frames at 20 Hz with pose, height and wheel speed at their times."""
    wanted = ("/cam/image_raw", "/truth/pose", "/height", "/wheels")
    return [
        dataclasses.replace(sample, t_ns=START_NS + k * 50 * MS, received_ns=START_NS + k * 50 * MS + 5)
        for k in range(6)
        for sample in moment(k)
        if sample.stream in wanted
    ]


def test_paper_a_gives_the_same_samples_again(tmp_path: Path) -> None:
    path = tmp_path / PATHS["paper-a"]
    written = write(Toy([*paper_samples(), everything()[0]]), path, container="paper-a")
    found = read_back(path)
    sent = by_stream(paper_samples())
    assert set(found) == {"images", "reference", "height", "speed_mps", "/truth/faults"}
    assert sorted(p.name for p in path.iterdir()) == [
        "faults.json",
        "file.csv",
        *(f"img_{k:03d}.png" for k in range(1, 7)),
    ]
    for k in range(6):
        image, pose, height, speed = (found[n][k] for n in ("images", "reference", "height", "speed_mps"))
        true_pose, true_height, wheels = (sent[n][k] for n in ("/truth/pose", "/height", "/wheels"))
        assert isinstance(image, ImageSample)
        assert isinstance(pose, PoseSample)
        assert isinstance(true_pose, PoseSample)
        assert isinstance(wheels, OdometrySample)
        assert isinstance(speed, ScalarSample)
        assert image.t_ns == pose.t_ns == height.t_ns == speed.t_ns == START_NS + k * 50 * MS
        assert np.array_equal(image.grey(), pixels_of(k))
        np.testing.assert_allclose(pose.position_m, true_pose.position_m, rtol=1e-15)
        turned = Rotation.from_quat(pose.quat_xyzw).inv() * Rotation.from_quat(true_pose.quat_xyzw)
        assert turned.magnitude() < 1e-15
        assert height.range_m == pytest.approx(true_height.range_m, rel=1e-15)  # type: ignore[attr-defined]
        assert speed.value == pytest.approx(float(np.linalg.norm(wheels.linear_velocity_mps)), rel=1e-15)
    assert written.messages == {"images": 6, "file.csv": 6, "faults.json": 1}
    assert written.left_out == {
        "/height": "its limits and field of view",
        "/wheels": "everything but its speed",
    }


def test_paper_a_is_in_ue4s_axes_cm_degrees_and_kmh(tmp_path: Path) -> None:
    """Forward 1 m, left 2 m, up 3 m, turned left by 30°: UE4's y is to the right and its yaw clockwise."""
    turned = Rotation.from_euler("ZYX", [30, 10, 5], degrees=True).as_quat()
    t = {"t_ns": 1_500_000_001, "received_ns": 1_500_000_001}
    pose = PoseSample(
        stream="/p", **t, position_m=array(1, 2, 3), quat_xyzw=turned, covariance=UNKNOWN_COV6, parent_frame="world"
    )
    speed = ScalarSample(stream="/speed", **t, value=2.0)
    image = raw("/c", 1_500_000_001, pixels_of(0))
    written = write(Toy([pose, speed, image]), tmp_path / "s", container="paper-a")
    table = pd.read_csv(tmp_path / "s" / "file.csv", dtype={"time [s]": str})
    assert list(table.columns) == [
        "time [s]", "x [cm]", "y [cm]", "z [cm]", "roll [deg]", "pitch [deg]", "yaw [deg]", "speed [km/h]",
    ]  # fmt: skip
    assert table["time [s]"][0] == "1.500000001"
    np.testing.assert_allclose(table.iloc[0, 1:].to_numpy(float), [100, -200, 300, 5, -10, -30, 7.2], rtol=1e-14)
    assert written.left_out == {"column distance": "no stream of the recording gives it"}


def test_paper_a_interpolates_to_the_frames_and_leaves_out_those_outside(tmp_path: Path) -> None:
    t0 = START_NS
    poses: list[Sample] = [
        PoseSample(
            stream="/reference/pose",
            t_ns=t0 + 10 * i * MS,
            received_ns=t0,
            position_m=array(4.0 * i, -i, 0.5),
            quat_xyzw=Rotation.from_euler("z", 0.4 * i).as_quat(),
            covariance=UNKNOWN_COV6,
            parent_frame="world",
        )
        for i in range(3)
    ]
    at = [-3, 0, 5, 12, 25]
    images: list[Sample] = [raw("/c", t0 + a * MS, pixels_of(k)) for k, a in enumerate(at)]
    written = write(Toy([*poses, *images]), tmp_path / "s", container="paper-a")
    found = read_back(tmp_path / "s")
    assert [s.t_ns - t0 for s in found["images"]] == [0, 5 * MS, 12 * MS]
    assert [np.array_equal(s.grey(), pixels_of(k)) for k, s in enumerate(found["images"], 1)] == [True] * 3  # type: ignore
    for pose, share in zip(found["reference"], (0, 0.5, 1.2), strict=True):
        assert isinstance(pose, PoseSample)
        np.testing.assert_allclose(pose.position_m, [4 * share, -share, 0.5], atol=1e-14)
        turned = Rotation.from_quat(pose.quat_xyzw) * Rotation.from_euler("z", -0.4 * share)
        assert turned.magnitude() < 1e-14
    assert (
        written.left_out["/reference/pose"]
        == "2 of its messages are at no frame's time; it is interpolated at 2 frames"
    )
    assert written.left_out["/c"] == "2 of its messages: outside of the times of pose, distance or speed"


def test_paper_a_needs_one_image_and_one_pose_stream(tmp_path: Path) -> None:
    with pytest.raises(StreamError, match="no images to write"):
        write(Toy([s for s in everything() if s.stream == "/truth/pose"]), tmp_path / "a", container="paper-a")
    with pytest.raises(StreamError, match="one stream of images and these could be it: /cam/image_raw, /left/image"):
        write(Toy(everything()), tmp_path / "a", container="paper-a")
    wanted = ["/cam/image_raw", "/truth/pose", "/odom", "/wheels"]
    with pytest.raises(StreamError, match="one stream of speed and these could be it: /odom, /wheels"):
        write(Toy(everything()), tmp_path / "a", container="paper-a", streams=wanted)
    with pytest.raises(StreamError, match="no reference poses to write"):
        write(Toy(everything()), tmp_path / "a", container="paper-a", streams=["/cam/image_raw"])
    wanted = ["/cam/image_raw", "/truth/pose", "/filter/pose", "/gps", "/cam/camera_info"]
    written = write(Toy(everything()), tmp_path / "a", container="paper-a", streams=wanted)
    assert written.messages["images"] == 4
    assert written.left_out["/filter/pose"] == "paper A's folder has no place for a second pose stream"
    assert written.left_out["/gps"] == "paper A's folder has no place for a gnss stream"
    assert written.left_out["/cam/camera_info"] == "paper A's folder has no place for a calibration"


def test_stored_images_stay_as_they_are_in_folders(tmp_path: Path) -> None:
    samples = [raw("/a", START_NS, pixels_of(0)), stored("/b", START_NS, 1, ".jpg")]
    write(Toy(samples), tmp_path / "V0", container="euroc", image_format="stored")
    data = [next((tmp_path / "V0" / "mav0" / f"cam{n}" / "data").iterdir()) for n in (0, 1)]
    assert [file.name for file in data] == [f"{START_NS}.png", f"{START_NS}.jpg"]
    assert data[1].read_bytes() == samples[1].data
    odd = dataclasses.replace(samples[1], encoding="rvl")
    with pytest.raises(ImageError, match="no image file is rvl"):
        write(Toy([odd]), tmp_path / "V1", container="euroc")


# ---------------------------------------------------------------------------- faults of folders


def test_plain_frames_bring_their_faults_along(tmp_path: Path) -> None:
    for k in range(2):
        cv2.imwrite(str(tmp_path / f"frame{k}.png"), pixels_of(k))
    (tmp_path / "faults.json").write_text(FAULTS, encoding="utf-8")
    with open_recording(tmp_path, ReadOptions(rate_hz=10)) as recording:
        (text,) = recording.read(["/truth/faults"])
        assert isinstance(text, TextSample)
        assert (text.text, text.t_ns) == (FAULTS, 0)
    (tmp_path / "faults.json").write_bytes(b"\xff\xfe")
    with open_recording(tmp_path, ReadOptions(rate_hz=10)) as recording:
        assert "the list of faults cannot be read" in str(recording.damage[0])


# --------------------------------------------------------------------------------- the door


def tree(path: Path) -> dict[str, bytes]:
    files = [path] if path.is_file() else sorted(p for p in path.rglob("*") if p.is_file())
    return {str(file.relative_to(path.parent)): file.read_bytes() for file in files}


def some(container: str) -> list[Sample]:
    return paper_samples() if container == "paper-a" else everything()


@pytest.mark.parametrize("container", PATHS)
def test_the_same_recording_gives_the_same_bytes(tmp_path: Path, container: str) -> None:
    trees = []
    for run in "ab":
        (tmp_path / run).mkdir()
        write(Toy(some(container)), tmp_path / run / PATHS[container], container=container)
        trees.append(tree(tmp_path / run / PATHS[container]))
    assert trees[0] == trees[1]
    assert any(trees[0].values())


@pytest.mark.parametrize("container", PATHS)
def test_what_exists_is_not_touched(tmp_path: Path, container: str) -> None:
    path = tmp_path / "there"
    path.write_bytes(b"precious")
    (tmp_path / "folder").mkdir()
    for taken in (path, tmp_path / "folder"):
        with pytest.raises(RecordingError, match="it exists already; choose another name"):
            write(Toy(some(container)), taken, container=container)
    assert path.read_bytes() == b"precious"
    with pytest.raises(RecordingError, match="it cannot be made"):
        write(Toy(some(container)), path / "below", container=container)


@pytest.mark.parametrize("container", PATHS)
def test_an_error_leaves_nothing_behind(tmp_path: Path, container: str) -> None:
    def fail() -> None:
        raise ImageError("the renderer broke")

    for number in (0, 7):
        with pytest.raises(ImageError, match="the renderer broke"):
            write(Toy(some(container), (number, fail)), tmp_path / PATHS[container], container=container)
        assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("container", PATHS)
def test_an_interrupt_leaves_what_was_written_so_far(tmp_path: Path, container: str) -> None:
    def interrupt() -> None:
        raise KeyboardInterrupt

    path = tmp_path / PATHS[container]
    with pytest.raises(KeyboardInterrupt):
        write(Toy(some(container), (13, interrupt)), path, container=container)
    whole = tmp_path / "whole"
    whole.mkdir()
    write(Toy(some(container)), whole / PATHS[container], container=container)
    found, all_of_them = read_back(path), read_back(whole / PATHS[container])
    count, total = (sum(map(len, streams.values())) for streams in (found, all_of_them))
    assert 0 < count < total
    if container in LOGS:
        assert count == 13
    for stream, samples in found.items():
        assert [s.t_ns for s in samples] == [s.t_ns for s in all_of_them[stream]][: len(samples)]


def test_ctrl_c_does_not_cut_a_message(tmp_path: Path) -> None:
    """The signal comes while an image is being made; that image is written before the interrupt is raised."""

    def payload() -> bytes:
        os.kill(os.getpid(), signal.SIGINT)
        return pixels_of(3).tobytes()

    before = signal.getsignal(signal.SIGINT)
    struck = dataclasses.replace(raw("/c", START_NS + 1, pixels_of(3)), payload=payload)
    samples: list[Sample] = [raw("/c", START_NS, pixels_of(0)), struck, raw("/c", START_NS + 2, pixels_of(1))]
    with pytest.raises(KeyboardInterrupt):
        write(Toy(samples), tmp_path / "m.bag", image_format="png")
    assert signal.getsignal(signal.SIGINT) is before
    found = read_back(tmp_path / "m.bag")["/c/compressed"]
    assert [np.array_equal(s.grey(), pixels_of(k)) for k, s in zip((0, 3), found, strict=True)] == [True, True]  # type: ignore


def test_ctrl_c_during_the_end_leaves_the_whole_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    close = RosMcap.close

    def struck(self: RosMcap) -> None:
        close(self)
        os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(RosMcap, "close", struck)
    with pytest.raises(KeyboardInterrupt):
        write(Toy(moment(0)), tmp_path / "m.mcap")
    assert sum(map(len, read_back(tmp_path / "m.mcap").values())) == len(moment(0))


def test_an_interrupt_before_anything_useful_leaves_nothing(tmp_path: Path) -> None:
    def interrupt() -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write(Toy(paper_samples(), (1, interrupt)), tmp_path / "a" / "b", container="paper-a")
    assert list(tmp_path.iterdir()) == []


def test_the_container_is_guessed_from_plain_names_only(tmp_path: Path) -> None:
    samples = moment(0)
    write(Toy(samples), tmp_path / "a.BAG", streams=["/imu"])
    assert (tmp_path / "a.BAG").read_bytes().startswith(b"#ROSBAG V2.0")
    with pytest.raises(
        RecordingError, match="its name does not say what to write; name the container: mcap, mcap-json"
    ):
        write(Toy(samples), tmp_path / "folder")
    with pytest.raises(RecordingError, match="no container is named 'bag'; name one of mcap"):
        write(Toy(samples), tmp_path / "folder", container="bag")
    with pytest.raises(StreamError, match="no stream named '/nothing'"):
        write(Toy(samples), tmp_path / "folder", container="euroc", streams=["/nothing"])
    with pytest.raises(ImageError, match="no image format is named 'gif'"):
        write(Toy(samples), tmp_path / "a.mcap", image_format="gif")  # type: ignore[arg-type]
    with pytest.raises(ImageError, match="quality of 0 does not exist"):
        write(Toy(samples), tmp_path / "a.mcap", quality=0)
    assert [p.name for p in tmp_path.iterdir()] == ["a.BAG"]


def test_progress_counts_up_to_the_expected(tmp_path: Path) -> None:
    seen: list[tuple[int, int]] = []
    write(Toy(everything()), tmp_path / "a.mcap", on_progress=lambda done, expected: seen.append((done, expected)))
    total = len(everything())
    assert seen == [(k, total) for k in range(1, total + 1)]


@pytest.mark.parametrize("container", PATHS)
def test_a_simulated_mission_goes_into_every_container(
    tmp_path: Path, container: Container, mission: SimulatedMission
) -> None:
    path = tmp_path / PATHS[container]
    write(mission, path, container=container, image_format="png")
    with open_recording(path) as recording:
        (images,) = recording.of_kind(StreamKind.IMAGE)
        frames = [s for s in recording.read([images.name]) if isinstance(s, ImageSample)]
        (poses,) = recording.of_kind(StreamKind.POSE)
        found = [s for s in recording.read([poses.name]) if isinstance(s, PoseSample)]
        if container != "paper-a":
            np.testing.assert_array_equal(recording.cameras[images.name].matrix, mission.camera.matrix)
    assert [s.t_ns for s in frames] == [s.t_ns for s in found] == mission.truth_t_ns.tolist()
    assert all(np.array_equal(frame.grey(), mission.frame(k)) for k, frame in enumerate(frames))
    np.testing.assert_allclose([s.position_m[:2] for s in found], mission.truth_poses[:, :2], rtol=0, atol=1e-15)
    headings = Rotation.from_quat([s.quat_xyzw for s in found]).as_euler("ZYX")[:, 0]
    np.testing.assert_allclose(np.unwrap(headings), np.unwrap(mission.truth_poses[:, 2]), rtol=0, atol=1e-14)


# ------------------------------------------------------------------- libraries that are not ours


def test_mcap_ros2_decodes_every_message(tmp_path: Path) -> None:
    write(Toy(everything()), tmp_path / "m.mcap", image_format="png")
    found: dict[str, list] = {}
    with (tmp_path / "m.mcap").open("rb") as file:
        for _, channel, _, ros in make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages():
            found.setdefault(channel.topic, []).append(ros)
    assert {len(messages) for topic, messages in found.items() if topic != "/truth/faults"} == {4}
    check_ros(found, pixels_of)


def check_ros(found: dict[str, list], image: Callable[[int], np.ndarray]) -> None:
    """What the fields of ROS messages say by ROS's conventions; the names are those of ROS 2."""
    for k in range(4):
        sent = {sample.stream: sample for sample in moment(k)}
        pixels = cv2.imdecode(np.frombuffer(bytes(found["/cam/image_raw/compressed"][k].data), np.uint8), -1)
        assert np.array_equal(pixels, image(k))
        imu, ahrs = found["/imu"][k], found["/ahrs"][k]
        assert imu.header.frame_id == "frame of /imu"
        assert imu.orientation_covariance[0] == -1
        assert imu.angular_velocity.x == sent["/imu"].angular_velocity_radps[0]
        assert imu.linear_acceleration.z == sent["/imu"].linear_acceleration_mps2[2]
        assert ahrs.orientation_covariance[0] == 0
        assert ahrs.orientation.w == sent["/ahrs"].quat_xyzw[3]
        assert (ahrs.angular_velocity_covariance[0], ahrs.linear_acceleration_covariance[0]) == (
            (0, -1) if k else (-1, 0)
        )
        assert found["/odom"][k].pose.pose.position.y == sent["/odom"].position_m[1]
        assert found["/odom"][k].twist.twist.angular.z == sent["/odom"].angular_velocity_radps[2]
        assert found["/wheels"][k].twist.linear.x == sent["/wheels"].linear_velocity_mps[0]
        assert found["/truth/pose"][k].pose.orientation.x == sent["/truth/pose"].quat_xyzw[0]
        assert list(found["/filter/pose"][k].pose.covariance) == sent["/filter/pose"].covariance.ravel().tolist()
        (moved,) = found["/tf"][k].transforms
        assert (moved.header.frame_id, moved.child_frame_id) == ("map", "odom")
        assert moved.transform.translation.y == sent["/tf:map->odom"].position_m[1]
        assert found["/height"][k].max_range == np.inf
        fix = found["/gps"][k]
        assert (fix.status.status, fix.position_covariance_type) == (k - 1, 3 if k else 0)
        assert fix.latitude == pytest.approx(np.degrees(sent["/gps"].latitude_rad), rel=1e-15)
        cloud = found["/tracks"][k]
        assert [point.z for point in cloud.points] == [1.0] * (k + 1)
        assert [channel.name for channel in cloud.channels] == ["id"]
        assert list(cloud.channels[0].values) == sent["/tracks"].ids.tolist()
        assert found["/words"][k].data == sent["/words"].text
        stamp = found["/height"][k].header.stamp
        nanoseconds = stamp.nanosec if hasattr(stamp, "nanosec") else stamp.nsecs
        assert stamp.sec * 10**9 + nanoseconds == sent["/height"].t_ns
    assert found["/truth/faults"][0].data == FAULTS


@pytest.mark.parametrize("container", ["mcap", "mcap-json"])
def test_rerun_opens_the_logs(tmp_path: Path, container: str, mission: SimulatedMission) -> None:
    log, converted = tmp_path / "m.mcap", tmp_path / "m.rrd"
    write(mission, log, container=container, image_format="png")
    checked = rerun("mcap", "check", str(log))
    assert [line.split()[0] for line in checked.splitlines() if " /" in line] == ["ok"] * len(mission.streams)
    assert f"Messages {sum(info.count for info in mission.streams)}" in " ".join(
        rerun("mcap", "info", str(log)).split()
    )
    rerun("mcap", "convert", str(log), "-o", str(converted))
    rows: Counter[str] = Counter()
    shown: list[np.ndarray] = []
    for chunk in RrdReader(converted).stream().to_chunks():
        if not chunk.is_static:
            rows[chunk.entity_path] += chunk.num_rows
            columns = chunk.to_record_batch().to_pydict()
            shown += [cv2.imdecode(np.array(row[0], np.uint8), -1) for row in columns.get("EncodedImage:blob", ())]
    images = IMAGE + "/compressed"
    expected = {images if info.name == IMAGE else info.name: info.count for info in mission.streams}
    assert {topic: rows[topic] for topic in expected} == expected
    frames = [mission.frame(k) for k in range(8)] if container == "mcap" else []  # of JSON Rerun keeps the text
    np.testing.assert_array_equal(shown, frames)


def rerun(*words: str) -> str:
    """What Rerun's own command line says."""
    return subprocess.run([sys.executable, "-m", "rerun", *words], capture_output=True, text=True, check=True).stdout


@pytest.mark.parametrize("container", ["ros1", "ros2"])
def test_rosbags_reads_the_bags(tmp_path: Path, container: str) -> None:
    path = tmp_path / LOGS[container]
    write(Toy(everything()), path, container=container, image_format="png")
    reader_of, store = (Ros1Reader, get_typestore(Stores.ROS1_NOETIC)) if container == "ros1" else (Ros2Reader, None)
    with reader_of(path) as reader:
        assert reader.message_count == len(everything())
        counts = {topic: info.msgcount for topic, info in reader.topics.items()}
        assert set(counts.values()) == {1, 4}
        assert [t for _, t, _ in reader.messages()] == sorted(s.received_ns for s in everything())
    found: dict[str, list] = {}
    with AnyReader([path]) as anything:
        for connection, _, data in anything.messages():
            found.setdefault(connection.topic, []).append(anything.deserialize(data, connection.msgtype))
    check_ros(found, pixels_of)
    info = found["/cam/camera_info"][0]
    assert np.array_equal(np.reshape(info.P if store else info.p, (3, 4)), camera().projection)
    if store:
        assert [message.header.seq for message in found["/imu"]] == [0, 1, 2, 3]


@pytest.mark.parametrize("container", ["ros1", "ros2"])
def test_evo_reads_the_trajectory_of_a_log(tmp_path: Path, container: str, mission: SimulatedMission) -> None:
    path = tmp_path / LOGS[container]
    write(mission, path, container=container, streams=[POSE])
    with (Ros1Reader if container == "ros1" else Ros2Reader)(path) as reader:
        way = file_interface.read_bag_trajectory(reader, POSE)
    np.testing.assert_array_equal(way.positions_xyz[:, :2], mission.truth_poses[:, :2])
    np.testing.assert_array_equal(way.positions_xyz[:, 2], mission.on_board[0].heights_m)
    np.testing.assert_allclose(way.timestamps, mission.truth_t_ns / 1e9, rtol=0, atol=3e-7)


def test_evo_reads_the_euroc_truth(tmp_path: Path, mission: SimulatedMission) -> None:
    write(mission, tmp_path / "V0", container="euroc")
    way = file_interface.read_euroc_csv_trajectory(
        str(tmp_path / "V0" / "mav0" / "state_groundtruth_estimate0" / "data.csv")
    )
    np.testing.assert_array_equal(way.positions_xyz[:, :2], mission.truth_poses[:, :2])
    headings = [Rotation.from_matrix(pose[:3, :3]).as_euler("ZYX")[0] for pose in way.poses_se3]
    np.testing.assert_allclose(np.unwrap(headings), np.unwrap(mission.truth_poses[:, 2]), rtol=0, atol=1e-14)
    np.testing.assert_allclose(way.timestamps, mission.truth_t_ns / 1e9, rtol=0, atol=3e-7)


def test_pandas_and_opencv_read_the_folders(tmp_path: Path, mission: SimulatedMission) -> None:
    write(mission, tmp_path / "V0", container="euroc")
    cam = tmp_path / "V0" / "mav0" / "cam0"
    table = pd.read_csv(cam / "data.csv")
    assert table["#timestamp [ns]"].tolist() == mission.truth_t_ns.tolist()
    for k, name in enumerate(table["filename"]):
        assert np.array_equal(cv2.imread(str(cam / "data" / name), cv2.IMREAD_UNCHANGED), mission.frame(k))
    write(mission, tmp_path / "speed_2", container="paper-a")
    table = pd.read_csv(tmp_path / "speed_2" / "file.csv")
    np.testing.assert_allclose(table["x [cm]"], mission.truth_poses[:, 0] * 100, rtol=0, atol=1e-13)
    np.testing.assert_allclose(table["y [cm]"], mission.truth_poses[:, 1] * -100, rtol=0, atol=1e-13)
    np.testing.assert_allclose(table["distance to the surface [cm]"], mission.on_board[0].heights_m * 100, rtol=1e-15)
    yaw = np.unwrap(np.radians(table["yaw [deg]"]))
    np.testing.assert_allclose(yaw, -np.unwrap(mission.truth_poses[:, 2]), rtol=0, atol=1e-14)
    for k in range(len(table)):
        image = cv2.imread(str(tmp_path / "speed_2" / f"img_{k + 1:03d}.png"), cv2.IMREAD_UNCHANGED)
        assert np.array_equal(image, mission.frame(k))


# ------------------------------------------------------------------------------------- JSON


def refuse_constant(text: str) -> None:
    raise AssertionError(f"{text} is no JSON")


def json_messages(path: Path) -> Iterator[tuple[str, Any, dict, dict]]:
    """Topic, type, schema and message, as `mcap` and `json` read them."""
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
            fields = json.loads(message.data, parse_constant=refuse_constant)
            yield channel.topic, schema.name, json.loads(schema.data), fields


def assert_fits(value: Any, schema: dict, where: str) -> None:
    """The value has exactly the fields of the schema, of its types; numbers beyond JSON are the texts of protobuf."""
    kind = schema["type"]
    if kind == "object":
        assert set(value) == set(schema["properties"]), where
        for name, part in schema["properties"].items():
            assert_fits(value[name], part, f"{where}.{name}")
    elif kind == "array":
        for part in value:
            assert_fits(part, schema["items"], where)
    elif kind == "number" and isinstance(value, str):
        assert value in ("NaN", "Infinity", "-Infinity"), where
    else:
        types = {"string": str, "integer": int, "number": int | float, "boolean": bool}
        assert isinstance(value, types[kind]), where
        assert schema.get("minimum", -np.inf) <= value <= schema.get("maximum", np.inf) if kind != "string" else True


def test_json_messages_fit_their_schemas(tmp_path: Path) -> None:
    write(Toy(everything()), tmp_path / "j.mcap", container="mcap-json", image_format="png")
    types = {}
    for topic, name, schema, fields in json_messages(tmp_path / "j.mcap"):
        assert schema["title"] == name
        assert_fits(fields, schema, topic)
        types[topic] = name
        if topic == "/cam/image_raw/compressed":
            assert base64.b64decode(fields["data"]).startswith(b"\x89PNG")
        if topic == "/height":
            assert fields["max_range"] == "Infinity"
    assert types == {
        "/cam/image_raw/compressed": "foxglove.CompressedImage",
        "/left/image/compressed": "foxglove.CompressedImage",
        "/right/image/compressed": "foxglove.CompressedImage",
        "/cam/camera_info": "foxglove.CameraCalibration",
        "/truth/pose": "foxglove.PoseInFrame",
        "/tf": "foxglove.FrameTransform",
        "/filter/pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
        "/imu": "sensor_msgs/msg/Imu",
        "/ahrs": "sensor_msgs/msg/Imu",
        "/odom": "nav_msgs/msg/Odometry",
        "/wheels": "geometry_msgs/msg/TwistStamped",
        "/height": "sensor_msgs/msg/Range",
        "/gps": "sensor_msgs/msg/NavSatFix",
        "/tracks": "sensor_msgs/msg/PointCloud",
        "/temperature": "std_msgs/msg/Float64",
        "/words": "std_msgs/msg/String",
        "/truth/faults": "std_msgs/msg/String",
    }


def test_foxglove_types_have_the_fields_of_foxgloves_own_schemas(tmp_path: Path) -> None:
    """The schemas in a recording of others were generated by Foxglove."""
    file = RECORDINGS / "mcap_json" / "custom-camera-model.mcap"
    theirs = {name: schema for _, name, schema, _ in json_messages(file)}
    write(Toy(everything()), tmp_path / "j.mcap", container="mcap-json")
    compared = set()
    for topic, name, _, fields in json_messages(tmp_path / "j.mcap"):
        if name in theirs:
            assert_fits(fields, theirs[name], topic)
            compared.add(name)
    assert compared == {"foxglove.CompressedImage", "foxglove.CameraCalibration"}


def test_raw_images_in_json(tmp_path: Path) -> None:
    write(Toy(moment(2)), tmp_path / "j.mcap", container="mcap-json", image_format="stored", streams=["/cam/image_raw"])
    ((_, name, schema, fields),) = json_messages(tmp_path / "j.mcap")
    assert name == "foxglove.RawImage"
    assert_fits(fields, schema, name)
    pixels = np.frombuffer(base64.b64decode(fields["data"]), np.uint8).reshape(fields["height"], fields["step"])
    assert np.array_equal(pixels, pixels_of(2))


def test_unknown_matrices_are_empty_in_json(tmp_path: Path) -> None:
    nan3, nan34 = np.full((3, 3), np.nan), np.full((3, 4), np.nan)
    info = CameraInfo(
        stream="/i", t_ns=START_NS, received_ns=START_NS, camera=camera(rectification=nan3, projection=nan34)
    )
    write(Toy([info]), tmp_path / "j.mcap", container="mcap-json")
    ((_, _, _, fields),) = json_messages(tmp_path / "j.mcap")
    assert (fields["R"], fields["P"]) == ([], [])
    (found,) = read_back(tmp_path / "j.mcap")["/i"]
    assert_same(found, info)
