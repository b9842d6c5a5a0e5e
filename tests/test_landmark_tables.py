"""Folders and tables of landmarks: what they say comes out in our axes, and what is missing is named."""

import itertools
from pathlib import Path

import cv2
import numpy as np
import pytest
import scipy.io
from recordings_dir import RECORDINGS
from scipy.spatial.transform import Rotation

from readers import ReadOptions, open_recording
from readers.landmark_tables import COURSE_SHAPES
from readers.streams import LandmarkSample, OdometrySample, PoseSample, Recording, RecordingError, TrackSample

STARRY = RECORDINGS / "_no_licence_stated" / "starry_night_stereo_landmarks"
MRCLAM = RECORDINGS / "_no_licence_stated" / "mrclam1_robot1"


def write_mrclam(folder: Path, **changed: str) -> Path:
    files = {
        "Barcodes": "# Subject #    Barcode #\n 1 5\n 6 63\n 7 25\n",
        "Landmark_Groundtruth": "# x\n 6 1.5 -2.5 0.001 0.002\n 7 4 5 0.003 0.004\n",
        "Robot1_Odometry": "1248272272.841 0.074 0.229\n1248272272.903 0.1 -0.5\n",
        "Robot1_Measurement": "1248272273.5 63 2.0 0.25\n1248272273.5 25 3.0 -0.5\n1248272274.25 5 1.0 0.0\n",
    } | changed
    for name, text in files.items():
        (folder / f"{name}.dat").write_text(text)
    return folder


def sightings(recording: Recording) -> list[LandmarkSample]:
    return [s for s in recording.read(["robot1/landmarks"]) if isinstance(s, LandmarkSample)]


def test_mrclam_rows_become_samples(tmp_path: Path) -> None:
    recording = open_recording(write_mrclam(tmp_path))
    first, second = recording.read(["robot1/odometry"])
    assert isinstance(first, OdometrySample)
    assert first.t_ns == 1_248_272_272_841_000_000
    assert first.linear_velocity_mps.tolist() == [0.074, 0, 0]
    assert second.angular_velocity_radps.tolist() == [0, 0, -0.5]
    both, alone = sightings(recording)
    assert (both.ids.tolist(), both.range_m.tolist(), both.bearing_rad.tolist()) == ([6, 7], [2, 3], [0.25, -0.5])
    assert (alone.t_ns, alone.ids.tolist()) == (1_248_272_274_250_000_000, [1])
    assert set(recording.landmarks) == {6, 7}
    assert recording.landmarks[6].position_m[:2].tolist() == [1.5, -2.5]
    assert recording.landmarks[7].sigma_m[:2].tolist() == [0.003, 0.004]
    assert "1 of 3 measurements are of other robots" in " ".join(recording.notes)


def test_mrclam_names_what_is_missing_or_unknown(tmp_path: Path) -> None:
    text = "1248272273.5 63 2.0 0.25\n1248272273.6 99 3.0 -0.5\n1248272273.7 63 oops 0\n"
    recording = open_recording(write_mrclam(tmp_path, Robot1_Measurement=text))
    assert "1 measurements of barcodes that Barcodes.dat lacks" in " ".join(recording.notes)
    assert [s.ids.tolist() for s in sightings(recording)] == [[6]]
    assert "'oops' is not a number" in str(recording.damage[0])
    assert "Robot1_Measurement.dat line 3" in str(recording.damage[0])
    for name in ("Barcodes", "Landmark_Groundtruth"):
        (tmp_path / f"{name}.dat").unlink()
    bare = open_recording(tmp_path)
    assert [s.ids.tolist() for s in sightings(bare)] == [[63], [99]]
    assert not bare.landmarks
    assert {note.partition(" ")[0] for note in bare.notes} == {"Barcodes.dat", "Landmark_Groundtruth.dat"}


def test_mrclam_ground_truth_is_a_reference(tmp_path: Path) -> None:
    (tmp_path / "Robot1_Groundtruth.dat").write_text("1248272272.8 1.0 2.0 0.5\n")
    (pose,) = open_recording(write_mrclam(tmp_path)).read(["robot1/reference"])
    assert isinstance(pose, PoseSample)
    np.testing.assert_allclose(pose.quat_xyzw, Rotation.from_euler("z", 0.5).as_quat())
    assert pose.position_m.tolist() == [1, 2, 0]


def test_measured_bearings_fit_the_surveyed_places() -> None:
    """Landmarks seen at one moment are as far apart as the survey says; but 11 and 17 carry each other's barcodes."""
    recording = open_recording(MRCLAM)

    def distances_off(swapped: dict[int, int]) -> list[float]:
        found = []
        for sample in sightings(recording):
            places = [recording.landmarks.get(swapped.get(int(i), int(i))) for i in sample.ids]
            seen = sample.range_m * np.exp(1j * sample.bearing_rad)
            for (a, at_a), (b, at_b) in itertools.combinations(zip(seen, places, strict=True), 2):
                if at_a is not None and at_b is not None:
                    found.append(abs(a - b) - float(np.linalg.norm(at_a.position_m[:2] - at_b.position_m[:2])))
        return found

    as_published, corrected = distances_off({}), distances_off({11: 17, 17: 11})
    assert len(corrected) > 1500
    assert np.mean(np.abs(corrected) < 0.3) > 0.9
    assert np.mean(np.abs(as_published) < 0.3) < 0.7


@pytest.mark.parametrize("camera", ["camera/left/tracks", "camera/right/tracks"])
def test_the_courses_landmarks_project_onto_their_tracks(camera: str) -> None:
    """Poses, extrinsics, intrinsics and landmarks agree with the tracks to the noise that the table states."""
    recording = open_recording(STARRY)
    poses = {s.t_ns: s for s in recording.read(["vehicle/reference"]) if isinstance(s, PoseSample)}
    model = recording.cameras[camera]
    camera_t_body = np.linalg.inv(model.body_t_camera)
    errors = []
    for sample in recording.read([camera]):
        assert isinstance(sample, TrackSample)
        pose = poses[sample.t_ns]
        places = np.array([recording.landmarks[int(i)].position_m for i in sample.ids]).reshape(-1, 3)
        in_body = Rotation.from_quat(pose.quat_xyzw).inv().apply(places - pose.position_m) if len(places) else places
        rays = (in_body @ camera_t_body[:3, :3].T + camera_t_body[:3, 3]) @ model.matrix.T
        errors.append(rays[:, :2] / rays[:, 2:] - sample.points_px)
    stacked = np.vstack(errors)
    stated = np.sqrt(scipy.io.loadmat(next(STARRY.glob("*.mat")))["y_var"].ravel())
    expected = stated[:2] if "left" in camera else stated[2:]
    np.testing.assert_allclose(np.sqrt(np.mean(stacked**2, axis=0)), expected, rtol=0.15)


def test_the_courses_velocities_integrate_to_its_poses() -> None:
    recording = open_recording(STARRY)
    poses = [s for s in recording.read(["vehicle/reference"]) if isinstance(s, PoseSample)]
    speeds = [s for s in recording.read(["vehicle/odometry"]) if isinstance(s, OdometrySample)]
    moved, measured = [], []
    for k in range(len(poses) - 1):
        dt = (poses[k + 1].t_ns - poses[k].t_ns) / 1e9
        turn = Rotation.from_quat(poses[k].quat_xyzw)
        moved.append(turn.inv().apply(poses[k + 1].position_m - poses[k].position_m))
        measured.append(speeds[k].linear_velocity_mps * dt)
    gain = np.sum(np.array(moved) * measured) / np.sum(np.square(measured))
    assert gain == pytest.approx(1, abs=0.05)


def test_tables_of_another_layout_are_refused(tmp_path: Path) -> None:
    scipy.io.savemat(tmp_path / "other.mat", {"depth": np.ones((2, 2))})
    with pytest.raises(RecordingError, match=r"other\.mat.*t is missing or misshapen.*variables are depth"):
        open_recording(tmp_path / "other.mat")
    head = b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + (0x0200).to_bytes(2, "little") + b"IM"
    (tmp_path / "new.mat").write_bytes(head + bytes(600))
    with pytest.raises(RecordingError, match=r"new\.mat: it is a MATLAB 7\.3 table \(HDF5\); save it with -v7"):
        open_recording(tmp_path / "new.mat")
    (tmp_path / "torn.mat").write_bytes(next(STARRY.glob("*.mat")).read_bytes()[:5000])
    with pytest.raises(RecordingError, match=r"torn\.mat.*file is complete"):
        open_recording(tmp_path / "torn.mat")


def test_a_table_beside_images_leaves_them_a_folder_of_images(tmp_path: Path) -> None:
    scipy.io.savemat(tmp_path / "calibration.mat", {"K": np.eye(3)})
    for k in range(2):
        cv2.imwrite(str(tmp_path / f"{k}.png"), np.zeros((4, 6), np.uint8))
    recording = open_recording(tmp_path, ReadOptions(rate_hz=10.0))
    assert recording.format.startswith("image folder")
    assert [info.count for info in recording.streams] == [2]


@pytest.mark.parametrize("number", ["9e30", "63.5", "-1"])
def test_what_is_no_number_of_a_landmark_is_left_out_and_said(tmp_path: Path, number: str) -> None:
    sighting = f"1248272273.5 63 2.0 0.25\n1248272273.6 {number} 3.0 -0.5\n"
    survey, codes = f"6 1 2 0 0\n{number} 4 5 0 0\n", f"6 63\n{number} 5\n"
    folder = write_mrclam(tmp_path, Robot1_Measurement=sighting, Landmark_Groundtruth=survey, Barcodes=codes)
    with np.errstate(invalid="raise"):
        recording = open_recording(folder)
    assert [s.ids.tolist() for s in sightings(recording)] == [[6]]
    assert set(recording.landmarks) == {6}
    assert {damage.where for damage in recording.damage} == {
        "Robot1_Measurement.dat line 2",
        "Landmark_Groundtruth.dat line 2",
        "Barcodes.dat line 2",
    }


@pytest.mark.parametrize("times", [[[0.0, np.nan]], [[0.0, 1e300]], [[0.0, 1j]], np.array([["a", "b"]])], ids=str)
def test_a_course_table_of_other_than_finite_numbers_is_refused(tmp_path: Path, times: object) -> None:
    shapes = {"K": 2, "J": 3}
    table = {name: np.zeros([shapes.get(str(n), n) for n in shape]) for name, shape in COURSE_SHAPES.items()}
    scipy.io.savemat(tmp_path / "sound.mat", table | {"t": [[0.0, 1.0]]})
    assert open_recording(tmp_path / "sound.mat").streams
    scipy.io.savemat(tmp_path / "dataset.mat", table | {"t": times})
    with pytest.raises(RecordingError, match=r"dataset\.mat.*\bt\b"):
        open_recording(tmp_path / "dataset.mat")
