"""A replay of ranges: which streams it takes, what it fills in, how it judges, and the whole of it."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import fake_ranges
import numpy as np
import pytest

from pipelines.lens import project
from pipelines.ranging.landmarks.settings import LandmarkKind
from pipelines.ranging.range_settings import RangeSettings
from pipelines.ranging.reference import PoseTrack, ReferenceRanges
from pipelines.ranging.step import RangeStep
from pipelines.replay import Frame
from readers.streams import Camera, Recording, StreamError, StreamKind, TrackSample
from tests.toys import ToyRecording
from workbench import range_inputs, rrd
from workbench.cli import main
from workbench.range_account import RangeAccount
from workbench.range_traces import RangeScene
from workbench.scenarios import load, mission
from workbench.session import Request, run
from workbench.settings import Resolved
from workbench.summary import Tally, lines, range_suitability

TRACKS, ODOMETRY, IMU = "/front/tracks", "/wheel/odometry", "/imu"
EVERYTHING = {
    TRACKS: StreamKind.TRACK,
    "/front/image_raw": StreamKind.IMAGE,
    ODOMETRY: StreamKind.ODOMETRY,
    "/truth/odometry": StreamKind.ODOMETRY,
    IMU: StreamKind.IMU,
}


class Kinds(ToyRecording):
    """A recording that has streams of some kinds, one message each."""

    def __init__(self, kinds: dict[str, StreamKind], cameras: dict[str, Camera] | None = None) -> None:
        super().__init__([TrackSample(stream=name, t_ns=0, received_ns=0, ids=np.zeros(0, np.int64),
                                      points_px=np.zeros((0, 2))) for name in kinds], kinds)  # fmt: skip
        self._cameras = cameras or {}

    @property
    def cameras(self) -> dict[str, Camera]:
        return self._cameras


def chosen(kinds: dict[str, StreamKind], settings: RangeSettings | None = None, **named: str) -> range_inputs.Streams:
    return range_inputs.choose_streams(Kinds(kinds), settings or RangeSettings(), **named)


# ------------------------------------------------------------------------------------- streams


def test_tracks_come_before_images_which_are_then_shown() -> None:
    streams = chosen(EVERYTHING)
    assert (streams.frames, streams.shown) == (TRACKS, "/front/image_raw")
    assert streams.others == (ODOMETRY, IMU)
    assert chosen(EVERYTHING, image="none").shown == ""
    assert chosen(EVERYTHING, imu="none").others == (ODOMETRY,)
    assert chosen(EVERYTHING, odometry="/truth/odometry").odometry == "/truth/odometry"


def test_settings_say_what_the_frames_are() -> None:
    corners = RangeSettings(landmarks=LandmarkKind.CORNERS)
    assert chosen(EVERYTHING, corners).frames == "/front/image_raw"
    assert chosen(EVERYTHING, corners).shown == ""
    with pytest.raises(StreamError, match=r"no stream of landmarks for landmarks = 'bearings'"):
        chosen(EVERYTHING, RangeSettings(landmarks=LandmarkKind.BEARINGS))


def test_what_cannot_be_chosen_is_named_with_the_cure() -> None:
    two = EVERYTHING | {"/rear/tracks": StreamKind.TRACK}
    with pytest.raises(StreamError, match=r"several track streams: /front/tracks, /rear/tracks; choose .*--tracks"):
        chosen(two)
    assert chosen(two, tracks="/rear/tracks").frames == "/rear/tracks"
    with pytest.raises(StreamError, match=r"several odometry streams.*--odometry"):
        chosen(EVERYTHING | {"/visual/odometry": StreamKind.ODOMETRY})
    with pytest.raises(StreamError, match=r"several IMU streams.*--imu"):
        chosen(EVERYTHING | {"/imu2": StreamKind.IMU})
    with pytest.raises(StreamError, match="no odometry, and ranges come from known speeds alone"):
        chosen({TRACKS: StreamKind.TRACK, IMU: StreamKind.IMU})
    with pytest.raises(StreamError, match="holds imu; --tracks can be: /front/tracks"):
        chosen(EVERYTHING, tracks=IMU)


def test_the_camera_is_filled_in_where_the_settings_leave_it_open() -> None:
    made = mission(load("sim:paper-b"))
    streams = range_inputs.choose_streams(made, RangeSettings())
    camera = range_inputs.camera_of(made, streams)
    filled, _ = range_inputs.with_camera(Resolved(RangeSettings(), frozenset()), made, camera, streams)
    s: Any = filled.settings
    assert (s.focal_px, s.centre_px, s.image_size_px) == (500.0, (319.5, 239.5), (640, 480))
    np.testing.assert_allclose(s.body_r_camera, [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], atol=1e-12)
    given = Resolved(RangeSettings(focal_px=400.0, camera_pitch_rad=0.1), frozenset({"focal_px", "camera_pitch_rad"}))
    kept: Any = range_inputs.with_camera(given, made, camera, streams)[0].settings
    assert (kept.focal_px, kept.centre_px, kept.camera_quat_xyzw) == (400.0, None, None)


def test_no_camera_is_an_error_that_says_what_to_give() -> None:
    recording: Recording = Kinds(EVERYTHING)
    streams = range_inputs.choose_streams(recording, RangeSettings())
    with pytest.raises(StreamError, match=r"no calibration of the camera of /front/tracks: give --set focal_px"):
        range_inputs.with_camera(Resolved(RangeSettings(), frozenset()), recording, None, streams)


# ---------------------------------------------------------------------- landmarks of a mission


def test_landmarks_and_camera_of_a_mission_are_where_its_tracks_say() -> None:
    made = mission(load("sim:paper-b", overrides=["tracks.noise_px=0"]))
    camera, poses = made.cameras["/front/image_raw"], PoseTrack()
    for pose in made.read(["/reference/pose"]):
        poses.add(pose.t_ns, pose.position_m, pose.quat_xyzw)  # type: ignore[attr-defined]
    tracks = [sample for sample in made.read([TRACKS]) if isinstance(sample, TrackSample)]
    for sample in (tracks[0], tracks[40], tracks[100]):
        camera_t_world = np.linalg.inv(poses.at(sample.t_ns) @ camera.body_t_camera)
        places = np.array([[*made.landmarks[number].position_m, 1.0] for number in sample.ids.tolist()])
        seen = project(camera, (places @ camera_t_world.T)[:, :3])
        np.testing.assert_allclose(sample.points_px, seen, atol=1e-3)


def test_a_written_mission_carries_its_landmarks(tmp_path: Path) -> None:
    assert main(["simulate", "paper-b", "-o", str(tmp_path / "b.mcap"), "--set", "duration_s=0.4",
                 "--set", "front.width_px=64", "--set", "front.height_px=48"]) == 0  # fmt: skip
    from readers import open_recording

    with open_recording(tmp_path / "b.mcap") as written:
        found = range_inputs.landmarks_of(written)
    made = mission(load("sim:paper-b")).landmarks
    assert found.keys() == made.keys()
    for number, landmark in made.items():
        np.testing.assert_array_equal(found[number].position_m, landmark.position_m)


# ------------------------------------------------------------------------------------- account


class Silent:
    """A log that nothing is told."""

    def __getattr__(self, name: str) -> Any:
        return lambda *args, **options: None


def account_of(steps: list[RangeStep], sigma: float = 1.0) -> dict[str, Any]:
    """The account of steps whose ξ are off the truth by `sigma` σ."""
    ranges = ReferenceRanges(None)
    account = RangeAccount(RangeScene(), ranges, PoseTrack(), np.eye(4), "truth")
    tally = Tally()
    for step in steps:
        depth = 1 / (step.mean[:, 2] - sigma * np.sqrt(step.covariance[:, 2, 2]))
        known = {n: (d, d) for n, d in zip(step.landmark_id.tolist(), depth.tolist(), strict=True) if n == n}
        ranges._measured[step.t_ns] = {int(n): d for n, d in known.items()}
        frame: Frame = TrackSample(
            stream="/t", t_ns=step.t_ns, received_ns=0, ids=np.zeros(0, np.int64), points_px=np.zeros((0, 2))
        )
        account.take(step, frame)
        tally.add(step.verdict, step.alarms, True)
    found, aligned = account.conclude(Silent(), tally, 0.1)
    assert aligned is None
    return found


def test_errors_consistency_and_waits_are_what_they_were_made() -> None:
    steps = list(fake_ranges.steps(80, slots=6, count=4))
    found = account_of(steps, 1.0)["ranging"]
    assert found["error"]["nees"] == pytest.approx(1.0)
    assert found["error"]["coverage"] == 1.0
    assert found["landmarks"] == found["converged_landmarks"] == 4
    told = [step.status[0] == 2 for step in steps]
    one = found["per_landmark"][0]
    assert one["time_to_converge_s"] == pytest.approx(0.1 * told.index(True))
    assert one["converged_share"] == pytest.approx(sum(told) / len(told))
    expected = [
        abs(1 / (s.mean[0, 2] * (1 / (s.mean[0, 2] - np.sqrt(s.covariance[0, 2, 2])))) - 1)
        for s, counts in zip(steps, told, strict=True) if counts
    ]  # fmt: skip
    assert one["error"]["median_percent"] == pytest.approx(100 * float(np.median(expected)))
    nis = np.array([step.nis for step in steps]).clip(max=13.8)  # a blunder counts as the gate
    assert found["nis"]["mean"] == pytest.approx(float(np.nanmean(nis)))
    assert found["nis"]["low"] < 2 < found["nis"]["high"]
    assert account_of(steps, 3.0)["ranging"]["error"]["coverage"] == 0.0


def test_uncertainties_that_do_not_hold_are_not_to_be_trusted() -> None:
    steps = list(fake_ranges.steps(80, slots=6, count=3))
    good, bad = account_of(steps, 1.0), account_of(steps, 3.0)
    assert not good["suitability"][0].startswith("do not trust")
    assert bad["suitability"][0].startswith("do not trust the uncertainties")
    assert "NEES 9 of the inverse depth where 1 is expected, 0 % within 2σ" in bad["suitability"][1]
    loud = account_of([dataclasses.replace(step, nis=3 * step.nis) for step in steps])
    assert "the innovations are larger than the filter's noise settings say" in loud["suitability"][1]
    assert range_suitability(Tally(), {"landmarks": 0}) == ["do not trust: no landmark was ever found"]


# --------------------------------------------------------------------------------- all of it


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run folder of the first ten seconds of paper B's robot, its images left out."""
    out = tmp_path_factory.mktemp("runs")
    (out / "best.tum").write_text("of an earlier run")
    noise = ("sigma_speed=0.002", "tracks.sigma_px=0.1")  # that of the scenario
    request = Request(
        path=Path("sim:paper-b"),
        estimator="range",
        overrides=noise,
        stop="10",
        image="none",
        out=out,
        calibrate=True,
    )
    outcome = run(request)
    (out / "summary.json").write_text(json.dumps(outcome.summary, default=str))
    return out


def test_a_mission_is_replayed_with_honest_ranges(folder: Path) -> None:
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["frames"] == 50
    assert summary["image_stream"] == TRACKS
    ranging = summary["ranging"]
    assert ranging["converged_landmarks"] >= 20
    assert ranging["nis"]["low"] - 0.2 < ranging["nis"]["mean"] < ranging["nis"]["high"] + 0.2
    assert ranging["error"]["median_percent"] < 5
    assert ranging["error"]["coverage"] > 0.85
    assert not summary["suitability"][0].startswith("do not trust")
    assert not (folder / "best.tum").exists()
    rows = [name for name, _ in lines(summary)]
    assert {"landmarks", "converged", "NIS", "range error", "landmark"} <= set(rows)
    assert "path length" not in rows


def test_a_replay_tells_of_its_sensors(folder: Path) -> None:
    summary = json.loads((folder / "summary.json").read_text())
    told = summary["calibration"]
    assert told["key"].startswith("focus") or "gyro_bias, focus" in told["key"]
    off = (np.array(told["focus"]["focus_px"]) - [319.5, 239.5]) / told["focus"]["sigma_px"]
    assert np.abs(off).max() < 3
    assert [text for name, text in lines(summary) if name == "calibration"] == told["sentences"]


def test_the_log_of_a_replay_reads_back(folder: Path) -> None:
    fields = rrd.read_fields(folder / "best.rrd", "best", RangeStep, ["frame", "range_m", "landmarks"])
    assert fields["frame"] == list(range(50))
    assert int(fields["landmarks"][-1]) == np.isfinite(fields["range_m"][-1]).sum()


def test_errors_are_one_line(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    out = ["-o", str(tmp_path / "out")]
    assert main(["replay", "sim:figure-eight", "-e", "range", *out]) == 2
    said = capsys.readouterr().err.strip().splitlines()
    problems = [line for line in said if "no frame yet" not in line]  # which a slow machine says
    assert len(problems) == 1
    assert "no odometry" in problems[0]
    assert main(["settings", "-e", "range"]) == 0
    assert "max_landmarks" in capsys.readouterr().out


CAMERA_YAML = """image_width: 640
image_height: 480
camera_matrix: {rows: 3, cols: 3, data: [500, 0, 319.5, 0, 500, 239.5, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0, 0, 0, 0, 0]}
"""


def test_a_calibration_for_images_of_another_size_is_refused_or_scaled(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """The images are 64 x 48 px; those that are only shown may be small copies, of which it is said."""
    log, camera = str(tmp_path / "b.mcap"), tmp_path / "camera.yaml"
    camera.write_text(CAMERA_YAML, encoding="utf-8")
    small = ("--set", "duration_s=0.4", "--set", "front.width_px=64", "--set", "front.height_px=48")
    assert main(["simulate", "paper-b", "-o", log, *small]) == 0
    replay = ["replay", log, "-e", "range", "--camera", str(camera), "-o", str(tmp_path / "out"), "--json"]
    capsys.readouterr()
    assert main([*replay, "--set", "landmarks=corners"]) == 2
    (problem,) = [line for line in capsys.readouterr().err.splitlines() if "calibration is for" in line]
    assert (
        "b.mcap: /front/image_raw/compressed: the calibration is for 640 x 480 px, but the images are 64 x 48 px"
        in problem
    )
    assert "--scale-camera" in problem
    assert main([*replay, "--set", "landmarks=corners", "--scale-camera"]) in (0, 1, 3)
    assert "is scaled to 64 x 48 px" in json.dumps(json.loads(capsys.readouterr().out))
    assert main([*replay, "--image", "/front/image_raw/compressed"]) in (0, 1, 3)
    shown = "but the images are 64 x 48 px of /front/image_raw/compressed, which are only shown"
    assert shown in json.dumps(json.loads(capsys.readouterr().out))


# --------------------------------------------------------------------------- boards, late images


def test_the_pose_of_a_board_is_the_reference_of_its_corners(tmp_path: Path) -> None:
    """Corner 0 of the board is not surveyed landmark 0 of the scene, a post elsewhere."""
    scenario = tmp_path / "board.toml"
    scenario.write_text(BOARD, encoding="utf-8")
    board = ("landmarks=chessboard", "board.columns=5", "board.rows=4", "sigma_speed=0.002")
    request = Request(path=scenario, estimator="range", overrides=(*board, "board.square_m=0.1"), out=tmp_path / "out")
    summary = run(request).summary
    assert summary["reference"] == "the pose of the board, whose size was given"
    assert [one["landmark"] for one in summary["ranging"]["per_landmark"]] == [0, 4, 15, 19]
    assert summary["ranging"]["error"]["count"] > 10
    assert abs(summary["ranging"]["error"]["bias_percent"]) < 5
    unknown = run(dataclasses.replace(request, overrides=board, stop="0.5", name="unknown")).summary
    assert "nothing tells where they are (a board's size would)" in unknown["reference"]


BOARD = """
duration_s = 4
reference.timing.rate_hz = 20
imu.timing.rate_hz = 50
trajectory = { curve = "line", speed_kmh = 1.44, profile = "constant" }
tracks.timing.rate_hz = 5
odometer = { timing.rate_hz = 20, speed_density = 0.002 }
front = { width_px = 320, height_px = 240, focal_px = 250, timing.rate_hz = 5 }

[surroundings]
landmarks_m = [[9.0, 1.1, 1.1]]
chessboard = { columns = 5, rows = 4, square_m = 0.1, position_m = [3.0, 0.05, 0.8] }
"""


def test_late_frames_are_bad_until_they_have_the_delay_that_is_told(tmp_path: Path) -> None:
    scenario = tmp_path / "weave.toml"
    scenario.write_text(WEAVE, encoding="utf-8")
    request = Request(
        path=scenario,
        estimator="range",
        overrides=("tracks.sigma_px=0.3", "sigma_speed=0.002", "max_landmarks=12"),
        image="none",
        out=tmp_path / "out",
        calibrate=True,
    )
    late = run(request).summary
    told = late["calibration"]
    assert late["suitability"][0].startswith("do not trust")
    delay_s = told["time_offset"]["camera_delay_s"]
    # the gyro's values are held for 10 ms, 5 ms in the mean
    assert delay_s == pytest.approx(0.045, abs=0.007)
    assert f"use --set camera_delay_s={delay_s:.3f}" in told["sentence"]
    given = (*request.overrides, f"camera_delay_s={delay_s:.3f}")
    right = run(dataclasses.replace(request, overrides=given, name="right")).summary
    assert not right["suitability"][0].startswith("do not trust")
    assert right["ranging"]["error"]["median_percent"] < 5 < late["ranging"]["error"]["median_percent"]
    assert "none that could be told from 0" in right["calibration"]["sentence"]


WEAVE = """
duration_s = 10
reference.timing.rate_hz = 50
imu.timing.rate_hz = 100
tracks = { timing = { rate_hz = 10, clock_offset_s = 0.05 }, noise_px = 0.3 }
odometer = { timing.rate_hz = 20, speed_density = 0.002 }
front = {}

[trajectory]
curve = "serpentine"
parameters = { amplitude_m = 0.06, wavelength_m = 1.2 }
speed_kmh = 1.08
profile = "constant"

[surroundings]
landmarks_m = [[7.2, 1.6, 1.4], [7.6, -1.5, 0.9], [6.2, 1.3, 0.3], [7.8, -0.9, 0.3]]
chessboard = { position_m = [7.0, 0.0, 0.8] }
"""
