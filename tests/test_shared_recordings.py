"""What becomes of every file and folder that others recorded: it opens with these streams, or one line refuses it."""

import json
from pathlib import Path
from typing import NamedTuple

import pytest
from recordings_dir import RECORDINGS

from readers import ReadOptions, RecordingError, open_recording
from readers.clock import survey
from readers.streams import ImageSample, Recording, StreamKind
from workbench.cli import main


class Opens(NamedTuple):
    """The format begins so, so many messages are in each readable stream, so many streams are only listed."""

    form: str
    readable: dict[str, int]
    listed: int = 0
    facts: tuple[str, ...] = ()
    damage: str = ""
    rate_hz: float | None = None


class Refused(NamedTuple):
    """These words are in the line."""

    words: str


SEVERAL = Refused("several logs that are not parts of one")
NOT_HERE = Refused("give one of the folders in it")
HUSKY = {"/fix": 989, "/husky_velocity_controller/odom": 3952, "/imu/data": 11865}
TURTLE = {
    "/tf:world->turtle1": 1344,
    "/tf:world->turtle2": 1344,
    "/tf_static:turtle1->carrot": 1,
    "/turtle1/cmd_vel": 357,
    "/turtle2/cmd_vel": 208,
}
TILT = {
    "/imu_data": 356,
    "/position_gps": 356,
    "/tf:tilt_axis->camera": 178,
    "/tf:tilt_axis->laser": 178,
    "/tf:tilt_base->tilt_axis": 355,
    "/velocity": 712,
}
CAMERA = {"/camera_calibration": 10, "/camera_calibration/custom": 10, "/image/compressed": 10}
STARRY = {
    "camera/left/tracks": 900,
    "camera/right/tracks": 900,
    "vehicle/odometry": 900,
    "vehicle/reference": 900,
}
GENERATOR = ("quaternion_norm",)

OUTCOMES: dict[str, Opens | Refused] = {
    "ros1_wheeled/husky_odom_imu_gps.bag": Opens("ROS 1 bag 2.0", HUSKY),
    "ros1_wheeled": Opens("ROS 1 bag 2.0", HUSKY),
    "ros1_imu/ardrone_imu.bag": Opens("ROS 1 bag", {"/ardrone/imu": 4308}, 1, ("gap",)),
    "ros1_imu/sparkfun_razor.bag": Opens("ROS 1 bag", {"/imu/data_raw": 2144}, 1, ("identity_orientation",)),
    "ros1_imu": SEVERAL,
    "ros1_custom_types/tilt_laser.bag": Opens("ROS 1 bag", TILT, 5, ("duplicate_stamp",)),
    "ros1_custom_types": Opens("ROS 1 bag", TILT, 5, ("duplicate_stamp",)),
    "ros1_compression/example.bag": Opens("ROS 1 bag", TURTLE, 5, ("gap",)),
    "ros1_compression/example-bz2.bag": Opens("ROS 1 bag", TURTLE, 5, ("gap",)),
    "ros1_compression/example-lz4.bag": Opens("ROS 1 bag", TURTLE, 5, ("gap",)),
    "ros1_compression": SEVERAL,
    "ros2_db3_metadata_v2": Opens("ROS 2 bag, sqlite3", {"/imu": 1565, "/pose": 1565}, 3, GENERATOR),
    "ros2_fixtures": NOT_HERE,
    "ros2_fixtures/mcap": NOT_HERE,
    "ros2_fixtures/sqlite3": NOT_HERE,
    "ros2_fixtures/mcap/talker": Opens("ROS 2 bag, MCAP", {"/topic": 10}, 2),
    "ros2_fixtures/mcap/cdr_test": Opens("ROS 2 bag, MCAP", {}, 2),
    "ros2_fixtures/sqlite3/talker": Opens("ROS 2 bag, sqlite3", {"/topic": 10}, 2),
    "ros2_fixtures/sqlite3/cdr_test": Opens("ROS 2 bag, sqlite3", {}, 2),
    "mcap_json/custom-camera-model.mcap": Opens("MCAP", CAMERA, 0, ("foreign_stamp", "calibration_size")),
    "mcap_json/example_logs.mcap": Opens("MCAP", {}, 2),
    "mcap_json": SEVERAL,
    "odd_files": NOT_HERE,
    "odd_files/ros1": SEVERAL,
    "odd_files/ros1/empty-file.bag": Refused("the file is empty (0 bytes)"),
    "odd_files/ros1/no-messages.bag": Opens("ROS 1 bag", {}),
    "odd_files/ros1/example-unsorted-chunks.bag": Opens("ROS 1 bag", {"foo": 3}),
    "odd_files/ros1/index_record_wrong_length.bag": Opens("ROS 1 bag", {}, 1),
    "odd_files/ros1/old_format_v1_2.bag": Refused("a format older than 2.0"),
    "odd_files/ros2": NOT_HERE,
    "odd_files/ros2/mcap_three_files_no_metadata": Opens("ROS 2 bag, MCAP, profile ros2, 3 files", {"/chatter": 3177}),
    "odd_files/ros2/sqlite3_three_files_no_metadata": Opens("ROS 2 bag, sqlite3, 3 files", {"/chatter": 3177}),
    "odd_files/ros2/mcap_unknown_serialization": Opens("ROS 2 bag, MCAP", {}, 2),
    "odd_files/ros2/sqlite3_unknown_serialization": Opens("ROS 2 bag, sqlite3", {}, 2),
    "odd_files/ros2/sqlite3_no_messages": Opens("ROS 2 bag, sqlite3", {}, 2),
    "odd_files/truncated": SEVERAL,
    "odd_files/truncated/custom-camera-model.first60pct.mcap": Opens(
        "MCAP",
        dict.fromkeys(CAMERA, 6),
        0,
        ("foreign_stamp", "calibration_size"),
        damage="ends inside a chunk, 18 messages",
    ),
    "odd_files/truncated/talker.first80pct.mcap": Opens("MCAP", {"/topic": 10}, 2, damage="it has no footer"),
    "odd_files/truncated/husky.first50pct.bag": Opens(
        "ROS 1 bag", {"/fix": 413, "/husky_velocity_controller/odom": 1653, "/imu/data": 4959}, damage="16.6%"
    ),
    "odd_files/truncated/example-lz4.first70pct.bag": Opens(
        "ROS 1 bag", TURTLE, 5, ("gap",), damage="what is there can"
    ),
    "odd_files/truncated/rosbag2_test_0.first60pct.db3": Opens(
        "ROS 2 bag, sqlite3", {"/imu": 932, "/pose": 934}, 3, ("gap", *GENERATOR), damage="2800 messages could be read"
    ),
    "drone_nadir_caliterra_a": Opens("image folder with a GNSS table", {"gps": 42, "images": 42}),
    "drone_nadir_caliterra_a/full_size": Opens("image folder", {"gps": 2, "images": 2}),
    "drone_nadir_caliterra_a/images": Opens("image folder", {"gps": 42, "images": 42}),
    "drone_nadir_seneca_size_change": Opens(
        "image folder with a GNSS table", {"gps": 6, "images": 6}, 0, ("size_change",)
    ),
    "kitti_06_first51": Opens("KITTI odometry folder", {"image_0": 51, "poses": 51}),
    "euroc_v1_01_standstill_a": Opens(
        "EuRoC ASL folder",
        {"cam0": 25, "groundtruth_200hz_tum": 53, "imu0": 261, "state_groundtruth_estimate0": 27},
    ),
    "stereo_chessboard": Opens("image folder", {"left": 13, "right": 13}, rate_hz=10.0),
    "rgbd_5_frames": Opens("image folder", {"color": 5, "depth": 5, "pose": 5}, rate_hz=10.0),
    "tum_fr3_office_4_frames": Opens("TUM RGB-D folder", {"rgb": 4}),
    "ground_textures": Opens("image folder", {"images": 3}, rate_hz=10.0),
    "paper_a_surface_frames": Opens("image folder", {"images": 11}, rate_hz=10.0),
    "_no_licence_stated": NOT_HERE,
    "_no_licence_stated/downward_checker_60fps_a": Opens(
        "image folder with a motion-capture table", {"images": 869, "mocap": 7315}, 0, ("gap",)
    ),
    "_no_licence_stated/mrclam1_robot1": Opens(
        "UTIAS MRCLAM folder", {"robot1/landmarks": 3774, "robot1/odometry": 97890}, 0, ("gap",)
    ),
    "_no_licence_stated/starry_night_stereo_landmarks": Opens("UTIAS course table", STARRY, 0, ("gap",)),
    "_no_licence_stated/starry_night_stereo_landmarks/dataset3_k0000_0899.mat": Opens(
        "UTIAS course table", STARRY, 0, ("gap",)
    ),
}


def open_one(name: str, rate_hz: float | None) -> Recording:
    return open_recording(RECORDINGS / name, ReadOptions(rate_hz=rate_hz))


@pytest.mark.parametrize("name", OUTCOMES)
def test_the_recordings_of_others(name: str) -> None:
    outcome = OUTCOMES[name]
    if isinstance(outcome, Refused):
        with pytest.raises(RecordingError) as caught:
            open_one(name, 10.0)
        assert_one_line(str(caught.value), name, outcome.words)
        return
    if outcome.rate_hz is not None:
        with pytest.raises(RecordingError) as caught:
            open_one(name, None)
        assert_one_line(str(caught.value), name, "nothing says when they were taken")
    with open_one(name, outcome.rate_hz) as recording:
        assert recording.format.startswith(outcome.form)
        assert {info.name: info.count for info in recording.streams if info.readable} == outcome.readable
        assert len([info for info in recording.streams if not info.readable]) == outcome.listed
        assert all(info.reason for info in recording.streams if not info.readable)
        facts = survey(recording)
        assert {fact.code for fact in facts} == set(outcome.facts)
        damage = "; ".join(str(harm) for harm in recording.damage)
        assert bool(damage) == bool(outcome.damage)
        assert outcome.damage in damage
        assert_counts_before_agree(recording)
        for info in recording.of_kind(StreamKind.IMAGE):
            first = next(iter(recording.read([info.name])))
            assert isinstance(first, ImageSample)
            assert first.width_px in (0, first.grey().shape[1])


def assert_one_line(text: str, name: str, words: str) -> None:
    """The line names the file, and holds these words."""
    assert "\n" not in text
    assert name in text
    assert words in text


def assert_counts_before_agree(recording: Recording) -> None:
    """The number of a frame by the index is the one that reading everything gives."""
    for info in recording.streams:
        if info.readable and info.count > 1:
            times = [sample.t_ns for sample in recording.read([info.name])]
            middle = sorted(times)[2 * len(times) // 3]
            assert recording.count_before(info.name, middle) == sum(t < middle for t in times)
            assert recording.count_before(info.name, times[0]) == sum(t < times[0] for t in times)


def test_the_outcomes_are_of_all_recordings_that_there_are() -> None:
    """Every folder directly below, and every bag, database and table, is in the table or a part of an entry."""
    logs = {".bag", ".mcap", ".db3", ".mat"}
    found = [p.relative_to(RECORDINGS) for p in RECORDINGS.rglob("*") if p.suffix in logs]
    found += [p.relative_to(RECORDINGS) for p in RECORDINGS.glob("*/")]
    found += [p.relative_to(RECORDINGS) for p in RECORDINGS.glob("_no_licence_stated/*/")]
    known = {Path(name) for name in OUTCOMES}
    parts = {Path(name) for name, outcome in OUTCOMES.items() if isinstance(outcome, Opens)}
    unnamed = [p for p in found if p not in known and p.parent not in parts]
    assert not unnamed


def test_inspecting_all_of_them_never_faults(capsys: pytest.CaptureFixture[str]) -> None:
    for name, outcome in OUTCOMES.items():
        words = ["inspect", str(RECORDINGS / name), "--json"]
        rate = outcome.rate_hz if isinstance(outcome, Opens) else None
        status = main([*words, "--rate", str(rate)] if rate else words)
        said = capsys.readouterr()
        if isinstance(outcome, Refused):
            assert status == 2, name
            assert said.out == ""
            assert_one_line(said.err.removesuffix("\n"), name, outcome.words)
        else:
            values = json.loads(said.out)
            assert (status, said.err) == (3 if values["damage"] else 0, ""), name
            assert len(values["streams"]) == len(outcome.readable) + outcome.listed


def test_unknown_types_are_listed_with_their_definition(capsys: pytest.CaptureFixture[str]) -> None:
    main(["inspect", str(RECORDINGS / "ros1_custom_types" / "tilt_laser.bag"), "--quick"])
    said = capsys.readouterr().out
    assert "no reader for type xsens_mtig/Thermistor, its definition: Header header; float32 reading;" in said
