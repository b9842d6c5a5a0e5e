"""Little folders of every layout, read back exactly, and every shared image folder by its outcome."""

import math
import os
from decimal import Decimal
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from recordings_dir import RECORDINGS
from scipy.spatial.transform import Rotation

from readers.clock import StreamAudit
from readers.folder_layouts import ue4_rotations
from readers.folder_tables import exact_ns, guess_unit, read_table
from readers.frame_times import natural_key, rate_times
from readers.image_folder import open_folder
from readers.streams import (
    GnssSample,
    ImageError,
    ImageSample,
    ImuSample,
    PoseSample,
    Problem,
    RangeSample,
    ReadOptions,
    Recording,
    RecordingError,
    Sample,
    ScalarSample,
    StreamError,
    StreamKind,
)

SECOND = 1_000_000_000


def write(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


def picture(path: Path, level: int = 0, size: tuple[int, int] = (6, 8)) -> Path:
    """An image file of one grey level, of that height and width."""
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), np.full(size, level, np.uint8))
    return path


def pictures(folder: Path, *names: str) -> None:
    for level, name in enumerate(names):
        picture(folder / name, level)


def samples(recording: Recording, *streams: str) -> list[Sample]:
    return list(recording.read(streams or None))


def times(recording: Recording, stream: str) -> list[int]:
    return [s.t_ns for s in recording.read([stream])]


def levels(recording: Recording, stream: str) -> list[int]:
    return [int(s.grey()[0, 0]) for s in recording.read([stream]) if isinstance(s, ImageSample)]


def said(recording: Recording, words: str) -> bool:
    return any(words in note for note in recording.notes)


# ------------------------------------------------------------------------------- exact times


@pytest.mark.parametrize(
    ("text", "unit", "t_ns"),
    [
        ("1341847980.722988", "s", 1341847980722988000),
        ("1403715274.30214", "s", 1403715274302140000),
        ("1403715273262142976", "ns", 1403715273262142976),
        ("1.044989e-01", "s", 104498900),
        ("4.766", "s", 4766000000),
        ("33.333333", "ms", 33333333),
        ("1403715273262142.976", "us", 1403715273262142976),
        ("0.0000000006", "s", 1),
        ("2014-10-19T13:20:51", "s", 1413724851 * SECOND),
        ("2014:10:19 13:20:51.25", "s", 1413724851 * SECOND + 250_000_000),
        ("2014-10-19T13:20:51-05:00", "s", (1413724851 + 5 * 3600) * SECOND),
        ("2011-09-26 13:02:25.964389445", "s", 1317042145964389445),
    ],
)
def test_times_are_exact(text: str, unit: str, t_ns: int) -> None:
    assert exact_ns(text, unit) == t_ns


@pytest.mark.parametrize(
    "text",
    [
        "",
        "x",
        "nan",
        "inf",
        "-1",
        "1e30",
        "9e999999",
        "2014-13-19T13:20:51",
        "1900-01-01 00:00:00",
        "2300-01-01 00:00:00",
    ],
)
def test_what_is_no_time_is_refused(text: str) -> None:
    with pytest.raises(ValueError):  # noqa: PT011
        exact_ns(text, "s")


@pytest.mark.parametrize(
    ("values", "unit"),
    [
        (["1403715273262142976", "1403715273312143104"], "ns"),
        (["1403715273262142", "1403715273312143"], "us"),
        (["1403715273262", "1403715273312"], "ms"),
        (["1403715273", "1403715275"], "s"),
        (["1403715273.2", "1403715273.3"], "s"),
        (["0", "0.0333", "0.0667"], "s"),
        (["0", "2", "4"], "s"),
        (["0", "33", "67"], "ms"),
        (["0", "33333", "66667"], "us"),
        (["0", "33333333", "66666667"], "ns"),
        (["0.0001", "0.0002"], "s"),
        (["1000000000", "1000016667", "1000033333"], "us"),
        (["7"], "s"),
    ],
)
def test_unit_of_times_by_size_and_step(values: list[str], unit: str) -> None:
    assert guess_unit(values) == unit


def test_frames_at_a_rate_do_not_drift() -> None:
    period = Decimal(1001) / Decimal(30000)
    stamps = rate_times(100_000, 30000 / 1001)
    assert stamps[0] == 0
    assert all(abs(Decimal(t) - k * period * SECOND) <= Decimal("0.5") for k, t in enumerate(stamps))


def test_natural_order() -> None:
    names = ["frame10.png", "frame2.png", "a.png", "frame02b.png", "7.png"]
    order = sorted((Path(n) for n in names), key=natural_key)
    assert [p.name for p in order] == ["7.png", "a.png", "frame2.png", "frame02b.png", "frame10.png"]


def test_tables_of_every_kind(tmp_path: Path) -> None:
    semicolon = read_table(write(tmp_path / "a.csv", "\ufeffTime [s]; X\r\n1,5;2,25\r\n"))
    assert semicolon.header == ["time [s]", "x"]
    stamps, values = semicolon.timed(0, "s", [1])
    assert (stamps.tolist(), values.tolist()) == ([1_500_000_000], [[2.25]])
    blank = read_table(write(tmp_path / "b.txt", "# first\n# time x\n\n1 2\nnan 3\n4\n5 inf\n6 7\n8 1e200"))
    assert blank.header == ["time", "x"]
    assert blank.timed(0, "s", [1])[0].tolist() == [SECOND, 6 * SECOND]
    assert [line for line, _ in blank.bad] == [5, 6, 7, 9]
    quoted = read_table(write(tmp_path / "c.csv", 'file,time\n"a, b.png",3\n'))
    assert quoted.rows == [(2, ["a, b.png", "3"])]
    empty = read_table(write(tmp_path / "d.csv", ""))
    assert (empty.header, empty.rows) == ([], [])
    with pytest.raises(RecordingError, match="cannot be read"):
        read_table(tmp_path / "none.csv")


# ------------------------------------------------------------------------------------ EuRoC

YAML_TEXT = """%YAML:1.0
# comment
sensor_type: camera
T_BS:
  cols: 4
  rows: 4
  data: [0.0, -1.0, 0.0, 0.5,
         1.0, 0.0, 0.0, 0.0,
         0.0, 0.0, 1.0, 0.0,
         0.0, 0.0, 0.0, 1.0]
resolution: [8, 6]
camera_model: pinhole
intrinsics: [458.654, 457.296, 3.5, 2.5] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [-0.28, 0.07, 0.0002, 1.8e-05]
"""
T0 = 1403715273262142976


def euroc(root: Path) -> Path:
    base = root / "mav0"
    pictures(base / "cam0" / "data", f"{T0}.png", f"{T0 + 50}.png")
    write(base / "cam0" / "data.csv", f"#timestamp [ns],filename\r\n{T0},{T0}.png\r\n{T0 + 50},{T0 + 50}.png\r\n")
    write(base / "cam0" / "sensor.yaml", YAML_TEXT)
    write(
        base / "imu0" / "data.csv",
        "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
        "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]\n"
        f"{T0},0.1,0.2,0.3,1,2,9.75\n{T0 + 5},0.1,x,0.3,1,2,9.75\n{T0 + 10},0.4,0.5,0.6,4,5,6\n",
    )
    return root


@pytest.mark.parametrize(
    "header",
    [
        "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []",
        "#time(ns),px,py,pz,qw,qx,qy,qz",
        "",
    ],
)
def test_euroc_folder(tmp_path: Path, header: str) -> None:
    truth = tmp_path / "set" / "mav0" / "state_groundtruth_estimate0" / "data.csv"
    euroc(tmp_path / "set")
    write(truth, f"{header}\n{T0 + 20},1,2,3,0.5,0.5,-0.5,0.5\n")
    write(tmp_path / "set" / "groundtruth_2hz_tum.txt", "# timestamp(s) tx ty tz qx qy qz qw\n1.5 1 2 3 0 0 0 1\n")
    recording = open_folder(tmp_path / "set")
    assert recording.format == "EuRoC ASL folder"
    assert [s.name for s in recording.streams] == [
        "cam0",
        "groundtruth_2hz_tum",
        "imu0",
        "state_groundtruth_estimate0",
    ]
    cam = recording.stream("cam0")
    assert (cam.count, cam.first_ns, cam.last_ns, cam.type) == (2, T0, T0 + 50, "EuRoC image")
    assert times(recording, "cam0") == [T0, T0 + 50]
    assert levels(recording, "cam0") == [0, 1]
    pose = samples(recording, "state_groundtruth_estimate0")[0]
    assert isinstance(pose, PoseSample)
    np.testing.assert_array_equal(pose.position_m, [1, 2, 3])
    np.testing.assert_array_equal(pose.quat_xyzw, [0.5, -0.5, 0.5, 0.5])
    inertial = samples(recording, "imu0")
    assert [s.t_ns for s in inertial] == [T0, T0 + 10]
    assert isinstance(inertial[0], ImuSample)
    np.testing.assert_array_equal(inertial[0].angular_velocity_radps, [0.1, 0.2, 0.3])
    np.testing.assert_array_equal(inertial[0].linear_acceleration_mps2, [1, 2, 9.75])
    assert np.all(np.isnan(inertial[0].quat_xyzw))
    assert [str(d) for d in recording.damage] == ["row left out ('x' is not a number) at mav0/imu0/data.csv line 3"]
    tum = samples(recording, "groundtruth_2hz_tum")[0]
    assert isinstance(tum, PoseSample)
    assert (tum.t_ns, tum.quat_xyzw.tolist()) == (1_500_000_000, [0, 0, 0, 1])
    camera = recording.cameras["cam0"]
    np.testing.assert_array_equal(camera.matrix, [[458.654, 0, 3.5], [0, 457.296, 2.5], [0, 0, 1]])
    assert (camera.width_px, camera.height_px, camera.distortion_model) == (8, 6, "plumb_bob")
    np.testing.assert_array_equal(camera.distortion, [-0.28, 0.07, 0.0002, 1.8e-05])
    assert said(recording, "cam0: body_T_cam (T_BS) is [[0.0, -1.0, 0.0, 0.5]")
    assert said(recording, "taken by position") == (header == "")


def test_mav0_itself_opens_and_bad_rows_are_named(tmp_path: Path) -> None:
    base = euroc(tmp_path) / "mav0"
    rows = f"{T0},{T0}.png\nx,a.png\n{T0},../../../etc/passwd\n{T0},/etc/passwd\n{T0 + 9},gone.png\n{T0 + 1}\n"
    write(base / "cam0" / "data.csv", rows)
    picture(base / "cam0" / "data" / "5.png")
    write(base / "cam0" / "sensor.yaml", YAML_TEXT.replace("[8, 6]", "[16, 12]"))
    recording = open_folder(base)
    found = samples(recording, "cam0")
    assert [type(s) for s in found] == [ImageSample, Problem]
    assert isinstance(found[1], Problem)
    assert found[1].kind is StreamKind.IMAGE
    assert "gone.png" in found[1].reason
    assert "No such file" in found[1].reason
    damage = [str(d) for d in recording.damage if "cam0" in d.where]
    assert len(damage) == 4
    assert all(f"line {n}" in line for n, line in zip((2, 3, 4, 6), damage, strict=True))
    assert said(recording, "2 images in data/ are not in data.csv")
    assert said(recording, "calibration is for 16 x 12 px, the images are 8 x 6 px")


def test_euroc_without_a_usable_yaml_has_no_camera(tmp_path: Path) -> None:
    write(euroc(tmp_path) / "mav0" / "cam0" / "sensor.yaml", "intrinsics: [1, 2\n  : :")
    recording = open_folder(tmp_path)
    assert recording.cameras == {}
    assert said(recording, "sensor.yaml cannot be read")
    assert said(recording, "no intrinsics")


def test_ranges_are_half_open_and_streams_merge(tmp_path: Path) -> None:
    recording = open_folder(euroc(tmp_path))
    assert [(s.stream, s.t_ns - T0) for s in recording.read(None, T0 + 5, T0 + 50)] == [("imu0", 10)]
    assert [(s.stream, s.t_ns - T0) for s in recording.read(["imu0", "cam0"], T0, T0 + 51)] == [
        ("imu0", 0),
        ("cam0", 0),
        ("imu0", 10),
        ("cam0", 50),
    ]
    assert list(recording.read(None, T0 + 51)) == []
    with pytest.raises(StreamError, match=r"no stream named 'cam9'.*cam0, imu0"):
        recording.read(["cam9"])


# ------------------------------------------------------------------------------- TUM, KITTI


def test_tum_folder(tmp_path: Path) -> None:
    for level, name in enumerate(("rgb/1341847980.722988.png", "rgb/1341847984.106759.png", "depth/a b.png")):
        picture(tmp_path / name, level)
    write(
        tmp_path / "rgb.txt",
        "# color images\n# timestamp filename\n1341847984.106759 rgb/1341847984.106759.png\n"
        "1341847980.722988 rgb/1341847980.722988.png\n1341847985.0 ../../secret.png\n",
    )
    write(tmp_path / "depth.txt", "1341847981.000001 depth/a b.png\n")
    write(tmp_path / "groundtruth.txt", "# t\n1341847980.7 1 2 3 0 0 2 0\n1341847980.8 1 2 3 0 0 0 0\n")
    recording = open_folder(tmp_path)
    assert recording.format == "TUM RGB-D folder"
    assert [s.name for s in recording.streams] == ["depth", "groundtruth", "rgb"]
    assert times(recording, "rgb") == [1341847980722988000, 1341847984106759000]
    assert levels(recording, "rgb") == [0, 1]
    assert levels(recording, "depth") == [2]
    assert said(recording, "rgb: 1 times lie before the one in the row above")
    assert [d.where for d in recording.damage] == ["rgb.txt line 5"]
    poses = samples(recording, "groundtruth")
    assert [p.quat_xyzw.tolist() for p in poses if isinstance(p, PoseSample)] == [[0, 0, 1, 0], [0, 0, 0, 0]]
    assert said(recording, "1 quaternions are off unit norm")


KITTI_P = "718 0 607 {} 0 718 185 0 0 0 1 0"


def kitti(root: Path, *, labels: bool, poses: str) -> Path:
    pictures(root / "image_0", "000000.png", "000001.png", "000002.png")
    pictures(root / "image_1", "000000.png", "000002.png")
    write(root / "times.txt", "0.000000e+00\n1.044989e-01\n2.077935e-01")
    rows = [KITTI_P.format(0), KITTI_P.format(-386)]
    write(root / "calib.txt", "\n".join(f"P{i}: {r}" if labels else r for i, r in enumerate(rows)))
    write(root / "poses.txt", poses)
    return root


@pytest.mark.parametrize("labels", [False, True])
def test_kitti_folder(tmp_path: Path, labels: bool) -> None:
    """The camera goes 2 forward, 1 to the right, 3 down and looks to the right by 30 degrees."""
    turn = Rotation.from_rotvec([0, math.radians(30), 0]).as_matrix()  # about y down: to the right
    moved = np.column_stack([turn, [1, 3, 2]]).reshape(-1)
    rows = ["1 0 0 0 0 1 0 0 0 0 1 0", " ".join(repr(float(v)) for v in moved)]
    recording = open_folder(kitti(tmp_path, labels=labels, poses="\n".join(rows)))
    assert recording.format == "KITTI odometry folder"
    assert times(recording, "image_0") == [0, 104498900, 207793500]
    assert times(recording, "image_1") == [0, 207793500]
    poses = samples(recording, "poses")
    assert [p.t_ns for p in poses] == [0, 104498900]
    assert isinstance(poses[0], PoseSample)
    assert isinstance(poses[1], PoseSample)
    np.testing.assert_array_equal(poses[0].position_m, [0, 0, 0])
    np.testing.assert_allclose(poses[0].quat_xyzw, [0, 0, 0, 1], atol=1e-15)
    np.testing.assert_allclose(poses[1].position_m, [2, -1, -3], atol=1e-15)
    heading = Rotation.from_quat(poses[1].quat_xyzw).as_rotvec(degrees=True)
    np.testing.assert_allclose(heading, [0, 0, -30], atol=1e-12)
    camera = recording.cameras["image_1"]
    np.testing.assert_array_equal(camera.matrix, [[718, 0, 607], [0, 718, 185], [0, 0, 1]])
    assert camera.projection[0, 3] == -386
    for name, right_m in (("image_0", 0.0), ("image_1", 386 / 718)):
        mounted = recording.cameras[name].body_t_camera
        np.testing.assert_array_equal(mounted[:3, :3], [[0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # it looks ahead
        np.testing.assert_allclose(mounted[:3, 3], [0, -right_m, 0], atol=1e-12)
    assert (camera.width_px, camera.height_px, camera.distortion_model) == (8, 6, "none")
    assert said(recording, "calib.txt has no labels") == (not labels)
    assert said(recording, "poses.txt has 2 poses for 3 images")


def test_a_kitti_projection_that_cannot_be_inverted_tells_no_mounting(tmp_path: Path) -> None:
    root = kitti(tmp_path, labels=True, poses="")
    write(root / "calib.txt", "P0: 718 0 607 0 0 0 0 0 0 0 1 0")
    assert np.isnan(open_folder(root).cameras["image_0"].body_t_camera).all()


def test_kitti_with_too_many_poses_bad_rows_and_too_few_times(tmp_path: Path) -> None:
    good = "1 0 0 0 0 1 0 0 0 0 1 0"
    kitti(tmp_path, labels=True, poses="\n".join([good, "1 2 3", "2 0 0 0 0 2 0 0 0 0 2 0", good, good]))
    write(tmp_path / "times.txt", "0\n0.1\n")
    write(tmp_path / "calib.txt", "P0: 1 2 3\n")
    recording = open_folder(tmp_path)
    assert times(recording, "image_0") == [0, 100_000_000]
    assert times(recording, "poses") == [0]
    assert said(recording, "image_0: 1 images have no row in times.txt")
    assert said(recording, "2 poses have no time")
    assert [d.where for d in recording.damage] == ["calib.txt line 1", "poses.txt line 2", "poses.txt line 3"]
    assert recording.cameras == {}


def test_kitti_without_times_needs_a_rate(tmp_path: Path) -> None:
    root = kitti(tmp_path, labels=True, poses="")
    (root / "times.txt").unlink()
    with pytest.raises(RecordingError, match="--rate HZ"):
        open_folder(root)
    recording = open_folder(root, ReadOptions(rate_hz=10))
    assert times(recording, "image_0") == [0, 100_000_000, 200_000_000]
    assert times(recording, "image_1") == [0, 200_000_000]


# ---------------------------------------------------------------- surface set, tables beside


def ue4_matrix(roll: float, pitch: float, yaw: float) -> np.ndarray:
    """UE4's rotation matrix; its columns are the body's forward, right and up in UE4's world."""
    (cr, cp, cy), (sr, sp, sy) = np.cos([roll, pitch, yaw]), np.sin([roll, pitch, yaw])
    forward = [cp * cy, cp * sy, sp]
    right = [sr * sp * cy - cr * sy, sr * sp * sy + cr * cy, -sr * cp]
    up = [-(cr * sp * cy + sr * sy), cy * sr - cr * sp * sy, cr * cp]
    return np.array([forward, right, up]).T


def test_ue4_axes() -> None:
    angles = np.random.default_rng(3).uniform(-1.4, 1.4, (50, 3))
    flip = np.diag([1.0, -1.0, 1.0])
    for angle, rotation in zip(angles, ue4_rotations(angles), strict=True):
        np.testing.assert_allclose(rotation, flip @ ue4_matrix(*angle) @ flip, atol=1e-14)
    nose_up, to_the_right = ue4_rotations(np.array([[0, 0.3, 0], [0, 0, 0.3]]))
    assert nose_up[2, 0] > 0
    assert to_the_right[1, 0] < 0


@pytest.mark.parametrize(
    ("header", "mark"),
    [
        ("time,x,y,z,roll,pitch,yaw,distance,speed", ","),
        ("Time [s];X [cm];Y [cm];Z [cm];Roll [deg];Pitch [deg];Yaw [deg];Distance to surface [cm];Speed [km/h]", ";"),
        ("Time,Yaw,Pitch,Roll,Z,Y,X,Speed (km/h),Dist", ","),
    ],
)
def test_surface_set(tmp_path: Path, header: str, mark: str) -> None:
    pictures(tmp_path, "img_001.png", "img_002.png", "img_010.png")
    values = {
        "t": "0.0166666",
        "x": "150.5",
        "y": "20",
        "z": "-3",
        "r": "0",
        "p": "0",
        "w": "90",
        "d": "20",
        "s": "7.2",
    }
    order = "twprzyxsd" if header.startswith("Time,Yaw") else "txyzrpwds"
    row = mark.join(values[key] for key in order)
    later = mark.join({**values, "t": "0.5"}[key] for key in order)
    body = "\n".join([row, later])
    write(tmp_path / "file.csv", f"{header}\n{body.replace('.', ',') if mark == ';' else body}\n")
    recording = open_folder(tmp_path)
    assert [s.name for s in recording.streams] == ["height", "images", "reference", "speed_mps"]
    assert times(recording, "images") == [16_666_600, 500_000_000]
    assert levels(recording, "images") == [0, 1]
    assert said(recording, "2 rows for 3 images")
    assert said(recording, "img_010.png")
    pose, height, speed = (samples(recording, name)[0] for name in ("reference", "height", "speed_mps"))
    assert isinstance(pose, PoseSample)
    np.testing.assert_allclose(pose.position_m, [1.505, -0.2, -0.03])
    np.testing.assert_allclose(pose.quat_xyzw, [0, 0, -math.sqrt(0.5), math.sqrt(0.5)], atol=1e-15)
    assert isinstance(height, RangeSample)
    assert height.range_m == pytest.approx(0.2)
    assert isinstance(speed, ScalarSample)
    assert speed.value == pytest.approx(2.0)
    assert speed.t_ns == 16_666_600


def test_mocap_table(tmp_path: Path) -> None:
    pictures(tmp_path / "images", "test9.png", "test10.png", "test11.png", "test12.png")
    write(
        tmp_path / "mocap.csv",
        "time_s,frame,x_m,y_m,z_m,qx,qy,qz\n4.766,9,1,2,3,0.6,0,0\n4.768,9,1,2,3,0.6,0,0\n"
        "4.770,10,1,2,3,0,0,0\n4.9,12,1,2,3,1,1,0\n5.0,77,1,2,oops,0,0,0\n5.1,78,1,2,3,0,0,0\n",
    )
    recording = open_folder(tmp_path)
    assert times(recording, "images") == [4_766_000_000, 4_770_000_000, 4_900_000_000]
    assert [s.source for s in recording.read(["images"]) if isinstance(s, ImageSample)] == [
        "images/test9.png",
        "images/test10.png",
        "images/test12.png",
    ]
    poses = [s for s in recording.read(["mocap"]) if isinstance(s, PoseSample)]
    assert len(poses) == 5
    np.testing.assert_allclose(poses[0].quat_xyzw, [0.6, 0, 0, 0.8])
    np.testing.assert_allclose(poses[3].quat_xyzw, [math.sqrt(0.5), math.sqrt(0.5), 0, 0])
    for words in ("1 images without a row in mocap.csv are left out (test11.png)", "qw is not stored", "1 frames of"):
        assert said(recording, words)
    assert [d.where for d in recording.damage] == ["mocap.csv line 6"]


def test_mocap_table_with_qw(tmp_path: Path) -> None:
    picture(tmp_path / "7.png")
    write(tmp_path / "poses.csv", "time_ms,frame,x_m,y_m,z_m,qx,qy,qz,qw\n1500,7,1,2,3,0,0,0.6,-0.8\n")
    recording = open_folder(tmp_path)
    pose = samples(recording, "mocap")[0]
    assert isinstance(pose, PoseSample)
    assert (pose.t_ns, pose.quat_xyzw.tolist()) == (1_500_000_000, [0, 0, 0.6, -0.8])
    assert not said(recording, "qw")


def test_gnss_table(tmp_path: Path) -> None:
    pictures(tmp_path / "images", "IMG_2.jpg", "IMG_10.jpg", "IMG_11.jpg")
    picture(tmp_path / "full_size" / "IMG_2.jpg")
    write(
        tmp_path / "gps.csv",
        "file,exif_time,lat_deg,lon_deg,alt_m,east_m\nIMG_2.jpg,2014-10-19T13:20:51,30,-98,317.3,0\n"
        "IMG_10.jpg,2014-10-19T13:20:51,30,-98,317.3,0\nIMG_3.jpg,2014-10-19T13:20:55,30,-98,317.3,0\n"
        "IMG_4.jpg,yesterday,30,-98,317.3,0\n",
    )
    recording = open_folder(tmp_path)
    assert times(recording, "images") == [1413724851 * SECOND] * 2
    fixes = [s for s in recording.read(["gps"]) if isinstance(s, GnssSample)]
    assert len(fixes) == 3
    assert (fixes[0].latitude_rad, fixes[0].longitude_rad) == (math.radians(30), math.radians(-98))
    assert fixes[0].altitude_m == 317.3
    audit = StreamAudit("images")
    for sample in recording.read(["images"]):
        audit.add(sample)
    assert [(f.code, f.count) for f in audit.facts()] == [("duplicate_stamp", 1)]
    assert said(recording, "IMG_11.jpg")
    assert said(recording, "full_size")
    assert [d.where for d in recording.damage] == ["gps.csv line 5", "images"]


# ------------------------------------------------------------------------------ plain frames


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [
        ("times.txt", "0.1\n0.2\n0.35\n", [100, 200, 350]),
        ("times.txt", "100\n200\n350\n", [100, 200, 350]),
        ("timestamps.csv", "index,timestamp [us]\n0,100000\n1,200000\n2,350000\n", [100, 200, 350]),
        ("timestamps.txt", "0 0.1\n1 0.2\n2 0.35\n", [100, 200, 350]),
        ("image_times.csv", "file,time\nf3.png,0.35\nf1.png,0.1\nf2.png,0.2\n", [100, 200, 350]),
        ("times.csv", "1,0.1\n2,0.2\n3,0.35\n", [100, 200, 350]),
        ("timestamps.txt", "0.1 f1.png\n0.2 f2.png\n0.35 f3.png\n", [100, 200, 350]),
    ],
)
@pytest.mark.parametrize("given", [False, True])
def test_plain_frames_with_a_times_file(tmp_path: Path, name: str, text: str, expected: list[int], given: bool) -> None:
    pictures(tmp_path / "set", "f1.png", "f2.png", "f3.png")
    path = write((tmp_path / "my_file.dat") if given else (tmp_path / "set" / name), text)
    recording = open_folder(tmp_path / "set", ReadOptions(times_file=path) if given else None)
    assert times(recording, "images") == [t * 1_000_000 for t in expected]
    assert levels(recording, "images") == [0, 1, 2]
    assert said(recording, f"times from {path.name} in ")


def test_the_given_unit_beats_the_guess(tmp_path: Path) -> None:
    pictures(tmp_path, "f1.png", "f2.png")
    write(tmp_path / "times.txt", "1\n2\n")
    assert times(open_folder(tmp_path, ReadOptions(times_unit="ms")), "images") == [1_000_000, 2_000_000]
    with pytest.raises(RecordingError, match="unknown unit of times 'min'"):
        open_folder(tmp_path, ReadOptions(times_unit="min"))


def test_times_that_do_not_fit_the_frames_are_refused(tmp_path: Path) -> None:
    pictures(tmp_path, "f1.png", "f2.png", "f3.png")
    path = write(tmp_path / "times.txt", "1\n2\n")
    with pytest.raises(RecordingError, match="2 rows for 3 frames"):
        open_folder(tmp_path)
    path.write_text("")
    with pytest.raises(RecordingError, match="0 rows for 3 frames"):
        open_folder(tmp_path)
    path.write_text("a b\nc d\ne f\n")
    with pytest.raises(RecordingError, match=r"times\.txt"):
        open_folder(tmp_path)
    with pytest.raises(RecordingError, match=r"none\.txt: cannot be read"):
        open_folder(tmp_path, ReadOptions(times_file=tmp_path / "none.txt"))


def test_a_table_that_times_no_image_is_refused(tmp_path: Path) -> None:
    picture(tmp_path / "a.jpg")
    write(tmp_path / "gps.csv", "file,time,lat,lon,alt\na.jpg,13:20:51,1,2,3\n")
    with pytest.raises(RecordingError, match=r"gps\.csv: gives no image a time: line 2: '13:20:51' is not a time"):
        open_folder(tmp_path)


def test_a_pose_file_named_like_a_folder(tmp_path: Path) -> None:
    pictures(tmp_path / "pose", "1.png")
    write(tmp_path / "pose.txt", "1 2 3 0 0 0 1\n")
    assert [s.name for s in open_folder(tmp_path, ReadOptions(rate_hz=1)).streams] == ["pose", "pose_"]


def test_numbers_without_a_word_before_them_are_one_stream(tmp_path: Path) -> None:
    pictures(tmp_path, "1.png", "2.png", "b1.png", "b2.png")
    assert [s.name for s in open_folder(tmp_path, ReadOptions(rate_hz=1)).streams] == ["images"]


def test_a_bad_time_leaves_its_frame_out(tmp_path: Path) -> None:
    pictures(tmp_path, "f1.png", "f2.png", "f3.png")
    write(tmp_path / "times.txt", "0.1\n?\n0.3\n")
    recording = open_folder(tmp_path)
    assert levels(recording, "images") == [0, 2]
    assert [d.where for d in recording.damage] == ["times.txt line 2"]


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["1403715273262142976.png", "1403715273312143104.png"], [1403715273262142976, 1403715273312143104]),
        (["f_1341847980.722988.png", "f_1341847984.106759.png"], [1341847980722988000, 1341847984106759000]),
        (["1403715273262.png", "1403715273312.png"], [1403715273262 * 10**6, 1403715273312 * 10**6]),
        (["0.100000.png", "12.250000.png"], [100_000_000, 12_250_000_000]),
    ],
)
def test_names_that_are_time_stamps(tmp_path: Path, names: list[str], expected: list[int]) -> None:
    pictures(tmp_path, *names)
    recording = open_folder(tmp_path, ReadOptions(rate_hz=5))
    assert times(recording, "images") == expected
    assert said(recording, "times from the file names")
    assert said(recording, "the given rate of 5 Hz was not used")


@pytest.mark.parametrize("names", [["000123.png", "000124.png"], ["0000000005.png", "0000000006.png"], ["a.png"]])
def test_frame_numbers_are_no_times(tmp_path: Path, names: list[str]) -> None:
    pictures(tmp_path, *names)
    with pytest.raises(RecordingError, match="`--rate HZ` or a file of times with `--times FILE`"):
        open_folder(tmp_path)


def photo(path: Path, stamp: str, *, sub: str = "", zone: str = "", place: bool = False) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    tags = Image.Exif()
    detail = tags.get_ifd(0x8769)
    detail[0x9003] = stamp
    if sub:
        detail[0x9291] = sub
    if zone:
        detail[0x9011] = zone
    if place:
        tags.get_ifd(0x8825).update({1: "S", 2: (30.0, 10.0, 30.0), 3: "W", 4: (98.0, 30.0, 0.0), 5: b"\x00", 6: 12.5})
    Image.new("L", (8, 6)).save(path, exif=tags)


def test_exif_times_and_positions(tmp_path: Path) -> None:
    photo(tmp_path / "a2.jpg", "2014:10:19 13:20:51", sub="25", place=True)
    photo(tmp_path / "a10.jpg", "2014:10:19 15:20:52", zone="+02:00")
    recording = open_folder(tmp_path)
    start = 1413724851 * SECOND
    assert times(recording, "images") == [start + SECOND // 4, start + SECOND]
    (fix,) = samples(recording, "gps")
    assert isinstance(fix, GnssSample)
    assert fix.t_ns == start + SECOND // 4
    assert fix.latitude_rad == pytest.approx(-math.radians(30 + 10 / 60 + 30 / 3600), abs=1e-15)
    assert fix.longitude_rad == pytest.approx(-math.radians(98.5), abs=1e-15)
    assert fix.altitude_m == 12.5
    assert said(recording, "times from EXIF")


def test_exif_times_that_stand_still_are_of_no_use(tmp_path: Path) -> None:
    for number in range(4):
        photo(tmp_path / f"{number}.jpg", "2014:10:19 13:20:51")
    with pytest.raises(RecordingError, match="no useful EXIF times"):
        open_folder(tmp_path)
    recording = open_folder(tmp_path, ReadOptions(rate_hz=4))
    assert times(recording, "images") == [0, SECOND // 4, SECOND // 2, 3 * SECOND // 4]


def test_families_of_names_are_streams_paired_by_number(tmp_path: Path) -> None:
    pictures(tmp_path, "left01.jpg", "left02.jpg", "left04.jpg", "right01.jpg", "right04.jpg")
    recording = open_folder(tmp_path, ReadOptions(rate_hz=10))
    assert times(recording, "left") == [0, 100_000_000, 200_000_000]
    assert times(recording, "right") == [0, 200_000_000]
    assert said(recording, "left: times from the given rate of 10 Hz; 1 numbers are missing")


def test_subfolders_are_streams_and_poses_without_times_go_by_frame(tmp_path: Path) -> None:
    pictures(tmp_path / "color", "1.png", "2.png", "10.png")
    pictures(tmp_path / "depth", "1.pgm", "2.pgm", "10.pgm")
    write(tmp_path / "pose.txt", "1 2 3 0 0 0 1\n4 5 6 0 0 1 0\n7 8 9 1 0 0 0\n7 8 9 1 0 0 0\n")
    recording = open_folder(tmp_path, ReadOptions(rate_hz=2))
    assert [s.name for s in recording.streams] == ["color", "depth", "pose"]
    assert times(recording, "color") == times(recording, "depth") == [0, SECOND // 2, SECOND]
    poses = [s for s in recording.read(["pose"]) if isinstance(s, PoseSample)]
    assert [p.position_m.tolist() for p in poses] == [[1, 2, 3], [4, 5, 6], [7, 8, 9]]
    assert said(recording, "4 poses for 3 frames")


def test_kitti_raw_style_folders_with_their_own_times(tmp_path: Path) -> None:
    for camera in ("image_00", "image_01"):
        pictures(tmp_path / camera / "data", "0000000000.png", "0000000001.png")
        write(tmp_path / camera / "timestamps.txt", "2011-09-26 13:02:25.964389445\n2011-09-26 13:02:26.067698221\n")
    recording = open_folder(tmp_path)
    assert [s.name for s in recording.streams] == ["image_00", "image_01"]
    assert times(recording, "image_01") == [1317042145964389445, 1317042146067698221]


def test_folders_that_do_not_belong_together_are_refused(tmp_path: Path) -> None:
    pictures(tmp_path / "one", "a.png", "b.png")
    pictures(tmp_path / "two", "1.png", "2.png")
    for options in (ReadOptions(), ReadOptions(rate_hz=2)):
        with pytest.raises(RecordingError, match=r"\(one, two\) have no frame numbers in common; give one"):
            open_folder(tmp_path, options)


@pytest.mark.parametrize("rate", [0.0, -3.0, math.nan, math.inf])
def test_a_rate_that_is_none(tmp_path: Path, rate: float) -> None:
    pictures(tmp_path, "1.png", "2.png")
    with pytest.raises(RecordingError, match="positive number"):
        open_folder(tmp_path, ReadOptions(rate_hz=rate))


# ---------------------------------------------------------------------- damaged and odd files


def test_images_stay_lazy_and_damaged_ones_are_found(tmp_path: Path) -> None:
    pictures(tmp_path, "1.png", "2.png", "3.png", "4.png", "5.png", "6.png", "7.png")
    (tmp_path / "2.png").write_bytes((tmp_path / "2.png").read_bytes()[:-20])
    (tmp_path / "3.png").write_bytes(b"")
    (tmp_path / "4.png").write_text("<html>not found</html>")
    (tmp_path / "5.png").unlink()
    os.mkfifo(tmp_path / "5.png")
    (tmp_path / "6.png").unlink()
    (tmp_path / "6.png").symlink_to(tmp_path / "6.png")
    picture(tmp_path / ".hidden.png")
    recording = open_folder(tmp_path, ReadOptions(rate_hz=1))
    found = samples(recording, "images")
    assert [type(s).__name__ for s in found] == ["ImageSample"] * 2 + ["Problem"] * 4 + ["ImageSample"]
    reasons = [s.reason for s in found if isinstance(s, Problem)]
    assert all(
        words in reason
        for words, reason in zip(("empty", "not begin like an image", "regular file", "6.png"), reasons, strict=True)
    )
    cut, last = found[1], found[6]
    assert isinstance(cut, ImageSample)
    assert (cut.width_px, cut.height_px, cut.encoding) == (8, 6, "png")
    with pytest.raises(ImageError, match=r"images \(2\.png\).*cut short"):
        cut.grey()
    assert isinstance(last, ImageSample)
    (tmp_path / "7.png").unlink()
    with pytest.raises(ImageError, match="cannot be read"):
        last.grey()


def test_size_changes_become_facts(tmp_path: Path) -> None:
    picture(tmp_path / "1.jpg", size=(6, 8))
    picture(tmp_path / "2.png", size=(6, 9))
    audit = StreamAudit("images")
    for sample in open_folder(tmp_path, ReadOptions(rate_hz=1)).read():
        audit.add(sample)
    assert [(f.code, f.count) for f in audit.facts()] == [("size_change", 1)]


def test_many_bad_rows_are_summed_up(tmp_path: Path) -> None:
    euroc(tmp_path)
    rows = "".join(f"bad{n},x\n" for n in range(500))
    write(tmp_path / "mav0" / "cam0" / "data.csv", f"{T0},{T0}.png\n{rows}")
    damage = open_folder(tmp_path).damage
    assert len([d for d in damage if "cam0" in d.where]) == 11
    assert any("490 more rows" in d.what for d in damage)


@pytest.mark.parametrize(
    ("files", "words"),
    [
        ([], "the folder is empty"),
        (["a.bag", "b.mcap"], "2 recordings, not one; give one: a.bag, b.mcap"),
        (["odometry.dat"], r"no images: its .dat or .mat tables \(odometry.dat\)"),
        (["notes.txt"], "no images"),
        (["evil\nname\x1b[31m.dat"], r"evil\\nname\\x1b\[31m.dat"),
    ],
)
def test_folders_without_images_are_refused(tmp_path: Path, files: list[str], words: str) -> None:
    for name in files:
        write(tmp_path / name, "1 2 3\n")
    with pytest.raises(RecordingError, match=words) as caught:
        open_folder(tmp_path)
    assert "\n" not in str(caught.value)
    assert str(tmp_path) in str(caught.value)


def test_a_file_is_no_folder(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="is not a folder"):
        open_folder(picture(tmp_path / "a.png"))


# ------------------------------------------------------------------------ shared recordings


def test_shared_oddities_have_their_answers() -> None:
    seneca = StreamAudit("images")
    for sample in open_folder(RECORDINGS / "drone_nadir_seneca_size_change").read(["images"]):
        seneca.add(sample)
    assert [(f.code, f.count) for f in seneca.facts()] == [("size_change", 1)]
    kitti06 = open_folder(RECORDINGS / "kitti_06_first51")
    path = np.array([s.position_m for s in kitti06.read(["poses"]) if isinstance(s, PoseSample)])
    assert np.linalg.norm(np.diff(path, axis=0), axis=1).sum() == pytest.approx(59.9, abs=0.1)
    assert path[-1, 0] > 59
    assert said(kitti06, "calib.txt has no labels")
    standstill = open_folder(RECORDINGS / "euroc_v1_01_standstill_a")
    poses = {s.stream: s for s in standstill.read() if isinstance(s, PoseSample)}
    ours, theirs = poses["state_groundtruth_estimate0"], poses["groundtruth_200hz_tum"]
    np.testing.assert_allclose(ours.position_m, theirs.position_m, atol=0.05)
    assert abs(float(ours.quat_xyzw @ theirs.quat_xyzw)) > 0.998  # the published sets differ by 6 degrees
    checker = open_folder(RECORDINGS / "_no_licence_stated" / "downward_checker_60fps_a")
    assert said(checker, "11 images without a row in mocap.csv are left out (test756.png")
    assert said(checker, "qw is not stored")
    assert times(checker, "images")[:2] == [4_766_000_000, 4_770_000_000]
