"""Calibrations from files: three forms, several cameras, other sizes, and everything that can be wrong with them."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from made_logs import MS, ROS2, START_NS, Entry, Maker, drive, raw_ros, write_mcap

from pipelines.lens import project
from readers import open_recording
from readers.camera_files import read_camera, read_cameras, scaled
from readers.clock import survey
from readers.streams import Camera, CameraFile, ReadOptions, RecordingError, StreamError
from workbench.cli import main

ROS_YAML = """image_width: 640
image_height: 480
camera_name: narrow_stereo
camera_matrix:
  rows: 3
  cols: 3
  data: [430.15, 0.0, 306.69, 0.0, 430.53, 227.22, 0.0, 0.0, 1.0]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.337586, 0.111359, -0.000292, -0.000210, 0.0]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
projection_matrix:
  rows: 3
  cols: 4
  data: [410.0, 0, 300.0, 0, 0, 411.0, 228.0, 0, 0, 0, 1, 0]
"""
KALIBR_YAML = """cam0:
  T_cam_imu:
  - [0.0, -1.0, 0.0, 0.1]
  - [0.0, 0.0, -1.0, 0.2]
  - [1.0, 0.0, 0.0, 0.3]
  - [0.0, 0.0, 0.0, 1.0]
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.28, 0.07, 0.0002, 1.8e-05]
  distortion_model: radtan
  intrinsics: [458.6, 457.3, 367.2, 248.4]
  resolution: [752, 480]
  rostopic: /cam/image_raw
  timeshift_cam_imu: -0.0125
cam1:
  camera_model: pinhole
  distortion_coeffs: [0.01, 0.02, 0.03, 0.04]
  distortion_model: equidistant
  intrinsics: [457.0, 456.0, 379.0, 255.0]
  resolution: [752, 480]
  rostopic: /cam1/image_raw
"""


def file_of(folder: Path, text: str, name: str = "camera.yaml") -> Path:
    file = folder / name
    file.write_text(text)
    return file


def opencv(folder: Path, **values: Any) -> Path:
    """A file as OpenCV itself writes it."""
    file = folder / "opencv.yml"
    storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_WRITE)
    for name, value in values.items():
        storage.write(name, value)
    storage.release()
    return file


K = np.array([[430.0, 0, 306.0], [0, 431.0, 227.0], [0, 0, 1]])


def test_a_file_of_ros(tmp_path: Path) -> None:
    found = read_camera(file_of(tmp_path, ROS_YAML))
    camera = found.camera
    assert (found.name, camera.width_px, camera.height_px) == ("narrow_stereo", 640, 480)
    assert camera.matrix.tolist() == [[430.15, 0, 306.69], [0, 430.53, 227.22], [0, 0, 1]]
    assert camera.distortion_model == "plumb_bob"
    assert camera.distortion.tolist() == [-0.337586, 0.111359, -0.000292, -0.00021, 0.0]
    assert camera.projection[:, 2].tolist() == [300.0, 228.0, 1.0]
    assert camera.source == "camera.yaml"


@pytest.mark.parametrize(("count", "model"), [(5, "plumb_bob"), (8, "rational_polynomial"), (4, "plumb_bob")])
@pytest.mark.parametrize("directive", ["%YAML:1.0", "%YAML 1.2"])
def test_a_file_that_opencv_wrote(tmp_path: Path, count: int, model: str, directive: str) -> None:
    lens = np.arange(1.0, count + 1)[None] / 100
    file = opencv(tmp_path, image_width=640, image_height=480, camera_matrix=K, distortion_coefficients=lens)
    _, _, rest = file.read_text().partition("\n")
    file.write_text(f"{directive}\n{rest}")
    camera = read_camera(file).camera
    np.testing.assert_array_equal(camera.matrix, K)
    np.testing.assert_array_equal(camera.distortion, lens[0])
    assert (camera.distortion_model, camera.width_px) == (model, 640)


def test_a_stereo_pair_of_opencv_is_chosen_from_by_number(tmp_path: Path) -> None:
    lens = np.zeros((1, 5))
    file = opencv(tmp_path, M1=K, D1=lens, M2=K * [[2], [2], [1]], D2=lens)
    assert [c.name for c in read_cameras(file)] == ["1", "2"]
    assert read_camera(file, name="2").camera.matrix[0, 0] == 860
    with pytest.raises(RecordingError, match=r"several cameras: 1, 2; name one, such as opencv\.yml#1"):
        read_camera(file)


def test_a_camchain_of_kalibr_is_chosen_from_by_name_and_topic(tmp_path: Path) -> None:
    file = file_of(tmp_path, KALIBR_YAML)
    first, second = read_cameras(file)
    assert read_camera(file, name="cam1").camera.source == second.camera.source == "camera.yaml#cam1"
    assert read_camera(file, topic="/cam1/image_raw/compressed").name == "cam1"
    assert (second.camera.distortion_model, first.camera.distortion_model) == ("equidistant", "plumb_bob")
    assert first.camera.matrix[:2].ravel().tolist() == [458.6, 0, 367.2, 0, 457.3, 248.4]
    cam_t_imu = np.array([[0, -1, 0, 0.1], [0, 0, -1, 0.2], [1, 0, 0, 0.3], [0, 0, 0, 1]])
    np.testing.assert_allclose(first.camera.body_t_camera @ cam_t_imu, np.eye(4), atol=1e-12)
    assert "T_cam_imu" in first.notes[0]
    assert "--offset /cam/image_raw=-12.5" in first.notes[1]
    assert np.isnan(second.camera.body_t_camera).all()
    with pytest.raises(RecordingError, match=r"no camera 'cam7'.*cam0 \(/cam/image_raw\)"):
        read_camera(file, name="cam7")


def without(text: str, word: str) -> str:
    return "\n".join(line for line in text.splitlines() if word not in line)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "no table"),
        ("- 1\n- 2\n", "no table"),
        ("a: [1, 2", "no YAML"),
        ("a: !!python/object/apply:os.system ['true']\n", "no YAML"),
        ("a: 1\n", "no camera_matrix"),
        (ROS_YAML.replace("430.15", "0.0"), "must be positive"),
        (ROS_YAML.replace("430.15", "-5"), "must be positive"),
        (ROS_YAML.replace("430.15", ".nan"), "not finite"),
        (ROS_YAML.replace("430.15, ", ""), "8 numbers, not 9"),
        (ROS_YAML.replace("430.15", "many"), "no list of numbers"),
        (ROS_YAML.replace("0.0, 0.0, 1.0]", "0.0, 0.0, 2.0]"), "last row"),
        (ROS_YAML.replace("plumb_bob", "wavy"), "'wavy' is not known; known are radtan"),
        (ROS_YAML.replace("-0.000210, 0.0]", "-0.000210]").replace("plumb_bob", "rational_polynomial"), "takes 8"),
        (ROS_YAML.replace("640", "-640"), "no size"),
        (ROS_YAML.replace("640", "1.0e+9"), "no size"),
        (KALIBR_YAML.replace("pinhole", "omni"), "'omni'"),
        (KALIBR_YAML.replace("458.6, ", ""), "3 numbers, not 4"),
        (without(KALIBR_YAML, "resolution"), "no resolution"),
        (KALIBR_YAML.replace("[0.0, -1.0, 0.0, 0.1]", "[0.0, -2.0, 0.0, 0.1]"), "no rigid transform"),
        ("&a [*a]\n", "no table"),
    ],
)
def test_a_file_that_is_wrong_is_refused_in_one_line(tmp_path: Path, text: str, words: str) -> None:
    file = file_of(tmp_path, text)
    with pytest.raises(RecordingError) as caught:
        read_camera(file)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)
    assert str(file) in str(caught.value)


def test_files_that_are_no_text_or_too_large_or_missing_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"\xff\xfe\x00binary")
    (tmp_path / "b").write_bytes(b"a: 1\n" * 300_000)
    for name, words in (("a", "no text"), ("b", "too many"), ("c", "cannot be read")):
        with pytest.raises(RecordingError, match=words):
            read_camera(tmp_path / name)


def test_a_scaled_camera_sees_what_the_resized_image_shows(tmp_path: Path) -> None:
    camera = read_camera(file_of(tmp_path, ROS_YAML)).camera
    half = scaled(camera, 320, 240)
    points = np.array([[0.1, -0.2, 1.0], [-0.4, 0.3, 2.0]])
    full, small = project(camera, points), project(half, points)
    np.testing.assert_allclose((full + 0.5) / 2 - 0.5, small, atol=1e-9)  # centres of pixels
    assert half.projection[0, 0] == 205.0
    with pytest.raises(ValueError, match="cropped, not scaled"):
        scaled(camera, 640, 360)


# ------------------------------------------------------------------------------ recordings


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return write_mcap(tmp_path / "a.mcap", raw_ros(drive(ROS2, 0.3), 2), "ros2")


def cameras(path: Path, **options: Any) -> dict[str, Camera]:
    with open_recording(path, ReadOptions(**options)) as recording:
        return recording.cameras


def test_a_file_takes_the_place_of_the_logs_calibration(log: Path, tmp_path: Path) -> None:
    ros, kalibr = file_of(tmp_path, ROS_YAML), file_of(tmp_path, KALIBR_YAML, "chain.yaml")
    assert cameras(log)["/cam/image_raw"].matrix[0, 0] == 100
    assert cameras(log, cameras=(CameraFile(ros),))["/cam/image_raw"].matrix[0, 0] == 430.15
    assert cameras(log, cameras=(CameraFile(kalibr),))["/cam/image_raw"].source == "chain.yaml#cam0"
    assert cameras(log, cameras=(CameraFile(kalibr, name="cam1"),))["/cam/image_raw"].source == "chain.yaml#cam1"
    with pytest.raises(StreamError, match=r"no images named '/other'.*/cam/image_raw"):
        cameras(log, cameras=(CameraFile(ros, topic="/other"),))


def test_a_calibration_for_another_size_is_scaled_only_when_asked(log: Path, tmp_path: Path) -> None:
    file = file_of(tmp_path, ROS_YAML.replace("640", "16").replace("480", "12"))
    options = {"cameras": (CameraFile(file, "/cam/image_raw"),)}
    assert cameras(log, **options)["/cam/image_raw"].width_px == 16
    with open_recording(log, ReadOptions(**options, scale_cameras=True)) as recording:
        camera = recording.cameras["/cam/image_raw"]
        assert (camera.width_px, camera.height_px, camera.matrix[0, 0]) == (8, 6, 430.15 / 2)
        assert "/cam/image_raw: its calibration for 16 x 12 px is scaled to 8 x 6 px, as asked." in recording.notes
    with pytest.raises(StreamError, match="cropped"):
        cameras(log, cameras=(CameraFile(file_of(tmp_path, ROS_YAML.replace("480", "640"))),), scale_cameras=True)


def test_inspect_names_the_source_of_a_camera(log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = file_of(tmp_path, KALIBR_YAML, "chain.yaml")
    assert main(["inspect", str(log), "--camera", f"/cam/image_raw={file}#cam1", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)["cameras"]["/cam/image_raw"]
    assert (told["source"], told["matrix"][0][0]) == ("chain.yaml#cam1", 457.0)
    assert main(["inspect", str(log), "--camera", str(file), "--quick"]) == 0
    assert "of chain.yaml#cam0" in capsys.readouterr().out
    assert main(["inspect", str(log), "--camera", str(tmp_path / "none.yaml")]) == 2
    assert "cannot be read" in capsys.readouterr().err


def test_an_empty_calibration_is_a_fact(tmp_path: Path) -> None:
    make = Maker(ROS2)
    info = make.camera_info(START_NS)
    info.k = np.zeros(9)
    entries = [
        Entry("/cam/camera_info", "sensor_msgs/msg/CameraInfo", START_NS, info),
        *(Entry("/cam/image_raw", "sensor_msgs/msg/Image", START_NS + k * MS, make.image(START_NS)) for k in range(2)),
    ]
    with open_recording(write_mcap(tmp_path / "a.mcap", raw_ros(entries, 2), "ros2")) as recording:
        assert ("/cam/image_raw", "calibration_empty") in {(f.stream, f.code) for f in survey(recording)}
