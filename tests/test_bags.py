"""ROS 1 and ROS 2 bags: every storage and compression, several files, damage, and the recordings of others."""

import hashlib
import re
import shutil
import sqlite3
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import zstandard
from made_logs import (
    MS,
    ROS1,
    ROS2,
    START_NS,
    Entry,
    Maker,
    drive,
    plain,
    raw_ros,
    write_mcap,
    write_ros1,
    write_ros2,
)
from recordings_dir import RECORDINGS
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

import readers
from readers import bag_folder, open_recording
from readers.bag_folder import missing_numbers
from readers.clock import survey
from readers.log_recording import LogRecording
from readers.messages import Arrival, reader_of, samples_of
from readers.streams import Problem, ReadOptions, Recording, RecordingError, StreamError, StreamKind

DRIVE_STREAMS = {
    "/cam/camera_info": 20,
    "/cam/image_raw": 20,
    "/imu": 200,
    "/odom": 40,
    "/tf:base->camera": 40,
    "/tf:odom->base": 40,
}


def expected_samples(store: Any) -> list[dict[str, Any]]:
    """The drive's samples without any file in between, by time."""
    found = []
    for topic, kind, log_ns, message in drive(store):
        reader = reader_of(kind)
        assert reader is not None
        found += samples_of(reader, message, Arrival(topic, log_ns))
    return sorted((plain(s) for s in found), key=lambda s: (s["t_ns"], s["stream"]))


def read_all(recording: Recording) -> list[dict[str, Any]]:
    times = [sample.t_ns for sample in recording.read()]
    assert times == sorted(times)
    return sorted((plain(s) for s in recording.read()), key=lambda s: (s["t_ns"], s["stream"]))


def snapshot(folder: Path) -> dict[str, tuple[int, int, str]]:
    return {
        str(file.relative_to(folder)): (s.st_size, s.st_mtime_ns, hashlib.sha256(file.read_bytes()).hexdigest())
        for file in sorted(folder.rglob("*"))
        if file.is_file() and (s := file.stat())
    }


# ------------------------------------------------------------------------ what we write ourselves


@pytest.mark.parametrize("compression", ["none", "bz2", "lz4"])
def test_ros1_bag_reads_back_exactly(tmp_path: Path, compression: str) -> None:
    path = write_ros1(tmp_path / "a.bag", drive(ROS1), compression)
    before = snapshot(tmp_path)
    with open_recording(path) as recording:
        assert {s.name: s.count for s in recording.streams} == DRIVE_STREAMS
        assert read_all(recording) == expected_samples(ROS1)
        assert recording.damage == ()
    assert snapshot(tmp_path) == before


@pytest.mark.parametrize(
    ("storage", "mode"),
    [
        ("sqlite3", "none"),
        ("sqlite3", "message"),
        ("sqlite3", "file"),
        ("mcap", "none"),
        ("mcap", "message"),
        ("mcap", "file"),
        ("mcap", "storage"),
    ],
)
@pytest.mark.parametrize("metadata", [True, False])
def test_ros2_bag_reads_back_exactly(tmp_path: Path, storage: str, mode: str, metadata: bool) -> None:
    path = write_ros2(tmp_path / "bag", drive(ROS2), storage, mode)
    if not metadata:
        (path / "metadata.yaml").unlink()
    before = snapshot(tmp_path)
    with open_recording(path) as recording:
        assert recording.format.startswith("ROS 2 bag")
        assert {s.name: s.count for s in recording.streams} == DRIVE_STREAMS
        assert read_all(recording) == expected_samples(ROS2)
        assert any("metadata.yaml" in note for note in recording.notes) is not metadata
    assert snapshot(tmp_path) == before


def test_a_storage_file_and_its_metadata_open_by_themselves(tmp_path: Path) -> None:
    path = write_ros2(tmp_path / "bag", drive(ROS2))
    for part in ("bag.db3", "metadata.yaml"):
        with open_recording(path / part) as recording:
            assert read_all(recording) == expected_samples(ROS2)


@pytest.mark.parametrize("storage", ["sqlite3", "mcap"])
@pytest.mark.parametrize("metadata", [True, False])
def test_several_files_are_one_log(tmp_path: Path, storage: str, metadata: bool) -> None:
    entries = drive(ROS2)
    folder = tmp_path / "bag"
    folder.mkdir()
    suffix = {"sqlite3": ".db3", "mcap": ".mcap"}[storage]
    names = []
    for i in range(12):
        part = write_ros2(tmp_path / f"part{i}", entries[i::12], storage)
        names.append(f"bag_{i}{suffix}")
        shutil.copy(part / f"part{i}{suffix}", folder / names[-1])
    if metadata:
        text = (tmp_path / "part0" / "metadata.yaml").read_text()
        listed = "".join(f"\n  - ../elsewhere/{name}" for name in names)
        head, _, tail = text.partition("relative_file_paths:")
        tail = re.sub(r"\A(\s+- \S+)+", "", tail)
        (folder / "metadata.yaml").write_text(f"{head}relative_file_paths:{listed}{tail}")
    with open_recording(folder) as recording:
        assert "12 files" in recording.format
        assert {s.name: s.count for s in recording.streams} == DRIVE_STREAMS
        assert read_all(recording) == expected_samples(ROS2)


def split_bag(tmp_path: Path, storage: str) -> Path:
    """A bag of two parts, the first half of the drive and the second, with metadata.yaml of the whole."""
    entries, suffix = drive(ROS2), {"sqlite3": ".db3", "mcap": ".mcap"}[storage]
    folder = write_ros2(tmp_path / "bag", entries, storage)
    (folder / f"bag{suffix}").unlink()
    for i, part in enumerate((entries[: len(entries) // 2], entries[len(entries) // 2 :])):
        shutil.copy(write_ros2(tmp_path / f"p{i}", part, storage) / f"p{i}{suffix}", folder / f"bag_{i}{suffix}")
    metadata = folder / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace(f"- bag{suffix}", f"- bag_0{suffix}\n  - bag_1{suffix}", 1))
    return folder


@pytest.mark.parametrize("storage", ["sqlite3", "mcap"])
@pytest.mark.parametrize("metadata", [True, False])
@pytest.mark.parametrize("content", [None, b"", b"garbage" * 99])
def test_a_part_that_is_gone_is_a_loss_and_the_others_are_read(
    tmp_path: Path, storage: str, metadata: bool, content: bytes | None
) -> None:
    folder = split_bag(tmp_path, storage)
    with open_recording(folder) as recording:
        assert not recording.damage
        whole = {stream.name: stream.count for stream in recording.streams}
    part = next(folder.glob("bag_1.*"))
    part.unlink()
    if content is not None:
        part.write_bytes(content)
    if not metadata:
        (folder / "metadata.yaml").unlink()
    with open_recording(folder) as recording:
        assert isinstance(recording, LogRecording)
        left = {stream.name: stream.count for stream in recording.streams}
        assert left["/imu"] == len(list(recording.read(["/imu"]))) > 90
        if metadata:
            lost = {topic: tally.lost for loss in recording.losses for topic, tally in loss.topics.items()}
            assert left["/imu"] + lost["/imu"] == whole["/imu"]
        said = any(part.name in str(damage) for damage in recording.damage)
        assert said or (content is None and not metadata)


def test_numbers_that_lack_between_the_parts_are_noted(tmp_path: Path) -> None:
    assert missing_numbers(["a_9.bag", "a_10.bag", "a_13.bag"]) == ["a_11.bag", "a_12.bag"]
    assert missing_numbers(["20240102.bag", "20250304.bag"]) == missing_numbers(["a.bag"]) == []
    folder = split_bag(tmp_path, "mcap")
    (folder / "metadata.yaml").unlink()
    (folder / "bag_1.mcap").rename(folder / "bag_2.mcap")
    with open_recording(folder) as recording:
        assert "There is no bag_1.mcap between the parts of the log." in recording.notes
        assert read_all(recording) == expected_samples(ROS2)


def packed(folder: Path, plain: Path) -> tuple[Path, bytes]:
    """A file packed with zstd, in blocks of which each can be unpacked without the next."""
    writer = zstandard.ZstdCompressor(level=1).compressobj()
    data = plain.read_bytes()
    pieces = [
        writer.compress(data[at : at + 4096]) + writer.flush(zstandard.COMPRESSOBJ_FLUSH_BLOCK)
        for at in range(0, len(data), 4096)
    ]
    path = folder / f"{plain.name}.zstd"
    path.write_bytes(b"".join(pieces) + writer.flush())
    return path, path.read_bytes()


@pytest.mark.parametrize("damage", ["cut", "flip", "more"])
def test_of_a_damaged_zstd_file_the_part_before_the_damage_is_read(tmp_path: Path, damage: str) -> None:
    plain = write_mcap(tmp_path / "a.mcap", raw_ros(drive(ROS2), 2), "ros2", chunk_size=4096)
    path, data = packed(tmp_path, plain)
    half = len(data) // 2
    path.write_bytes(
        {"cut": data[:half], "flip": data[:half] + bytes(99) + data[half + 99 :], "more": data + b"?"}[damage]
    )
    with open_recording(path) as recording:
        assert isinstance(recording, LogRecording)
        found = [(m.channel.topic, m.log_ns, bytes(m.data)) for m in recording.messages()]
        told = " ".join(loss.text for loss in recording.losses)
    written = [(entry.topic, entry.log_ns, entry.data) for entry in raw_ros(drive(ROS2), 2)]
    assert told
    assert set(found) <= set(written) or "read without a checksum" in told
    assert len(found) == len(written) if damage == "more" else len(found) > 0.4 * len(written)


def test_a_zstd_bomb_does_not_fill_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bag_folder, "HARMLESS_BYTES", 1 << 20)
    monkeypatch.setattr(bag_folder, "LARGEST_RATIO", 8)
    folder = write_ros2(tmp_path / "bag", drive(ROS2))
    path = tmp_path / "a.db3.zstd"
    path.write_bytes(zstandard.compress((folder / "bag.db3").read_bytes() + bytes(1 << 24)))
    with open_recording(path) as recording:
        assert isinstance(recording, LogRecording)
        assert any("bytes are unpacked of" in loss.text for loss in recording.losses)
        assert recording._scratch is not None
        assert sum(file.stat().st_size for file in Path(recording._scratch.name).iterdir()) < 2 << 20


def test_a_refused_zstd_file_leaves_no_folder_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "scratch"))
    (tmp_path / "scratch").mkdir()
    path = tmp_path / "a.mcap.zstd"
    path.write_bytes(zstandard.compress(b"SQLite format 3\0" + bytes(5000)))
    try:
        open_recording(path)
    except RecordingError as error:
        kept = error  # as a caller keeps it, with all that its frames refer to
    assert "zstd" in str(kept)
    assert list((tmp_path / "scratch").iterdir()) == []


def test_times_at_the_end_of_their_range_are_read(tmp_path: Path) -> None:
    path = write_ros2(tmp_path / "bag", drive(ROS2)) / "bag.db3"
    with sqlite3.connect(path) as connection:
        connection.execute("UPDATE messages SET timestamp = ? WHERE id = 5", (2**63 - 1,))
        connection.execute("UPDATE messages SET timestamp = 0 WHERE id = 6")
    connection.close()
    with open_recording(path) as recording:
        assert isinstance(recording, LogRecording)
        times = [message.log_ns for message in recording.messages()]
    assert (times[0], times[-1], len(times)) == (0, 2**63 - 1, len(drive(ROS2)))


@pytest.mark.parametrize("text", ["", "a: [", "rosbag2_bagfile_information: 3", "&a [*a, *a]"])
def test_broken_metadata_is_said_and_the_files_are_read(tmp_path: Path, text: str) -> None:
    folder = write_ros2(tmp_path / "bag", drive(ROS2))
    (folder / "metadata.yaml").write_text(text)
    with open_recording(folder) as recording:
        assert any("cannot be parsed" in note for note in recording.notes)
        assert len(list(recording.read(["/imu"]))) == 200


def test_logs_that_are_no_parts_of_one_are_refused(tmp_path: Path) -> None:
    for name in ("garden.bag", "street.bag"):
        write_ros1(tmp_path / name, drive(ROS1, 0.1))
    with pytest.raises(RecordingError, match=r"open one of garden\.bag, street\.bag"):
        open_recording(tmp_path)


@pytest.mark.parametrize("kind", ["ros1", "sqlite3", "mcap"])
def test_time_range_is_half_open_in_sensor_time(tmp_path: Path, kind: str) -> None:
    if kind == "ros1":
        path = write_ros1(tmp_path / "a.bag", drive(ROS1, 8.0))
    else:
        path = write_ros2(tmp_path / "bag", drive(ROS2, 8.0), kind)
    start, stop = START_NS + 3000 * MS, START_NS + 3500 * MS
    with open_recording(path) as recording:
        every = [plain(s) for s in recording.read()]
        assert [plain(s) for s in recording.read(None, start, stop)] == [s for s in every if start <= s["t_ns"] < stop]
        images = list(recording.read(["/cam/image_raw"], start, stop))
        assert [s.t_ns for s in images] == [start + i * 100 * MS for i in range(5)]
        assert len(list(recording.read(["/imu"], None, start))) == 300
        assert len(list(recording.read(["/imu"], start))) == 500
        assert list(recording.read(None, stop, start)) == []
        assert list(recording.read(None, stop + 10**15)) == []


@pytest.mark.parametrize("lag_s", [-40.0, 40.0])
def test_a_sensor_clock_far_from_the_log_clock_is_followed(tmp_path: Path, lag_s: float) -> None:
    make, lag = Maker(ROS1), round(lag_s * 1e9)
    entries = [e for e in drive(ROS1, 4.0) if e.topic == "/imu"]
    entries += [
        Entry("/late", "sensor_msgs/msg/Imu", t + lag, make.imu(t, 1.0))
        for t in range(START_NS, START_NS + 4 * 10**9, 50 * MS)
    ]
    path = write_ros1(tmp_path / "a.bag", sorted(entries, key=lambda e: e.log_ns))
    with open_recording(path) as recording:
        start, stop = START_NS + 10**9, START_NS + 2 * 10**9
        times = [(s.t_ns, s.stream) for s in recording.read(None, start, stop)]
        assert [t for t, _ in times] == sorted(t for t, _ in times)
        assert sum(stream == "/late" for _, stream in times) == 20
        assert sum(stream == "/imu" for _, stream in times) == 100


def test_only_topics_that_were_asked_for_are_decoded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recording = open_recording(write_ros1(tmp_path / "a.bag", drive(ROS1)))
    decoded = []
    for topic in recording._topics:
        for channel, decode in topic.decoders.items():

            def spy(data: Any, decode: Any = decode, name: str = channel.topic) -> Any:
                decoded.append(name)
                return decode(data)

            topic.decoders[channel] = spy
    assert len(list(recording.read(["/imu"]))) == 200
    assert set(decoded) == {"/imu"}


def test_named_frame_pairs_become_the_only_tf_streams(tmp_path: Path) -> None:
    path = write_ros1(tmp_path / "a.bag", drive(ROS1))
    with open_recording(path, ReadOptions(pose_frames=(("odom", "base"),))) as recording:
        assert [s.name for s in recording.of_kind(StreamKind.POSE)] == ["/tf:odom->base"]
        samples = list(recording.read(["/tf:odom->base"]))
    assert [s.position_m[0] for s in samples] == [5.0 * i for i in range(40)]
    assert {(s.parent_frame, s.child_frame) for s in samples} == {("odom", "base")}


def test_a_broken_tf_message_is_one_problem(tmp_path: Path) -> None:
    folder = write_ros2(tmp_path / "bag", drive(ROS2))
    with sqlite3.connect(folder / "bag.db3") as database:
        (topic,) = database.execute("SELECT id FROM topics WHERE name = '/tf'").fetchone()
        (row,) = database.execute("SELECT max(id) FROM messages WHERE topic_id = ?", (topic,)).fetchone()
        database.execute("UPDATE messages SET data = x'0001' WHERE id = ?", (row,))
    database.close()
    with open_recording(folder) as recording:
        assert sum(isinstance(s, Problem) for s in recording.read()) == 1
        assert {f.code for f in survey(recording)} == {"undecodable"}


def test_camera_belongs_to_the_image_of_its_namespace(tmp_path: Path) -> None:
    with open_recording(write_ros1(tmp_path / "a.bag", drive(ROS1))) as recording:
        camera = recording.cameras["/cam/image_raw"]
    np.testing.assert_array_equal(camera.matrix, [[100, 0, 4], [0, 100, 3], [0, 0, 1]])
    assert (camera.width_px, camera.height_px, camera.distortion_model) == (8, 6, "plumb_bob")


def test_unknown_and_refused_streams_are_listed_and_not_read(tmp_path: Path) -> None:
    make = Maker(ROS1)
    depth = make(
        "sensor_msgs/msg/CompressedImage",
        header=make.header(START_NS),
        format="16UC1; compressedDepth png",
        data=np.zeros(20, np.uint8),
    )
    note = make("std_msgs/msg/Bool", data=True)
    cloud = make("sensor_msgs/msg/PointCloud", header=make.header(START_NS), points=[], channels=[])
    entries = [
        Entry("/scan", "sensor_msgs/msg/PointCloud", START_NS, cloud),
        Entry("/depth", "sensor_msgs/msg/CompressedImage", START_NS, depth),
        Entry("/note", "std_msgs/msg/Bool", START_NS, note),
    ]
    with open_recording(write_ros1(tmp_path / "a.bag", entries)) as recording:
        assert recording.stream("/depth").kind is StreamKind.IMAGE
        scan = recording.stream("/scan")
        assert (scan.kind, scan.readable) == (StreamKind.UNKNOWN, False)
        assert "without a channel 'id'" in scan.reason
        assert recording.stream("/note").reason == "no reader for type std_msgs/Bool"
        assert "bool data" in recording.stream("/note").definition
        assert [sample.encoding for sample in recording.read()] == ["16UC1; compressedDepth png"]
        with pytest.raises(StreamError, match="no stream named '/nothing'"):
            recording.read(["/nothing"])


def test_one_bad_message_harms_no_other(tmp_path: Path) -> None:
    make = Maker(ROS1)
    entries = [Entry("/imu", "sensor_msgs/msg/Imu", START_NS + i * MS, make.imu(START_NS + i * MS)) for i in range(5)]
    entries.append(
        Entry("/image", "sensor_msgs/msg/Image", START_NS + 6 * MS, make.image(START_NS + 6 * MS, height=4800))
    )
    entries.append(Entry("/image", "sensor_msgs/msg/Image", START_NS + 7 * MS, make.image(START_NS + 7 * MS)))
    with open_recording(write_ros1(tmp_path / "a.bag", entries)) as recording:
        samples = list(recording.read())
        facts = {(f.stream, f.code): f.count for f in survey(recording)}
    problems = [s for s in samples if isinstance(s, Problem)]
    assert [(p.stream, p.kind) for p in problems] == [("/image", StreamKind.IMAGE)]
    assert "4800 rows of 8 bytes and holds 48" in problems[0].reason
    assert len(samples) == 7
    assert facts == {("/image", "undecodable"): 1}


def test_foreign_and_frozen_stamps_fall_back_to_log_time(tmp_path: Path) -> None:
    make = Maker(ROS1)
    entries = []
    for i in range(6):
        log_ns = START_NS + i * 10 * MS
        entries.append(Entry("/zero", "sensor_msgs/msg/Imu", log_ns, make.imu(0)))
        entries.append(Entry("/frozen", "sensor_msgs/msg/Imu", log_ns, make.imu(START_NS - MS)))
    with open_recording(write_ros1(tmp_path / "a.bag", entries)) as recording:
        assert all(s.t_ns == s.received_ns for s in recording.read())
        facts = {(f.stream, f.code): f.count for f in survey(recording)}
        assert facts == {("/zero", "foreign_stamp"): 6, ("/frozen", "frozen_stamp"): 6}
        assert any(note.startswith("/frozen: the header stamps do not advance") for note in recording.notes)


# ---------------------------------------------------------------------------------- damage


@pytest.mark.parametrize("compression", ["none", "bz2", "lz4"])
def test_a_torn_ros1_bag_gives_what_is_there_and_says_so(tmp_path: Path, compression: str) -> None:
    whole = write_ros1(tmp_path / "whole.bag", drive(ROS1), compression).read_bytes()
    every = expected_samples(ROS1)
    torn = tmp_path / "torn.bag"
    counts = []
    for size in [*range(20, len(whole), len(whole) // 60), len(whole) - 1]:
        torn.write_bytes(whole[:size])
        with open_recording(torn) as recording:
            samples = [plain(s) for s in recording.read()]
            assert all(sample in every for sample in samples)
            assert recording.damage
            counts.append(len(samples))
    assert counts == sorted(counts)
    assert counts[0] == 0
    assert counts[-1] == len(every)


def test_a_damaged_chunk_costs_only_itself(tmp_path: Path) -> None:
    path = write_ros1(tmp_path / "a.bag", drive(ROS1), "bz2")
    data = bytearray(path.read_bytes())
    with open_recording(path) as recording:
        chunk = recording._logs[0]._chunks[3]
        lost = len(recording._logs[0]._load(chunk))
        total = sum(c.count for c in recording._logs[0].channels)
    data[(chunk.record.start + chunk.record.stop) // 2] ^= 0xFF
    path.write_bytes(data)
    with open_recording(path) as recording:
        messages = sum(1 for _ in recording._messages(recording._logs[0].channels))
        assert messages == total - lost
        (harm,) = recording.damage
        assert "bz2" in harm.what
        assert f"byte {chunk.record.offset} " in harm.where
        assert any(fact.code == "count_differs" for fact in survey(recording))


def test_a_bag_with_a_false_index_is_scanned(tmp_path: Path) -> None:
    path = write_ros1(tmp_path / "a.bag", drive(ROS1))
    data = path.read_bytes()
    at = data.index(b"chunk_count=") + len(b"chunk_count=")
    path.write_bytes(data[:at] + b"\x01\0\0\0" + data[at + 4 :])
    with open_recording(path) as recording:
        assert read_all(recording) == expected_samples(ROS1)
        assert "the bag header states 1 chunks and 29 are there" in recording.damage[0].what


def test_rows_in_a_write_ahead_log_are_read_from_a_copy(tmp_path: Path) -> None:
    source = write_ros2(tmp_path / "bag", drive(ROS2)) / "bag.db3"
    folder = tmp_path / "open"
    folder.mkdir()
    copy = tmp_path / "live.db3"
    shutil.copy(source, copy)
    with sqlite3.connect(copy) as database:
        database.execute("PRAGMA journal_mode = WAL")
        database.execute("PRAGMA wal_autocheckpoint = 0")
        rows = list(database.execute("SELECT id, topic_id, timestamp, data FROM messages WHERE id > 100"))
        database.execute("DELETE FROM messages WHERE id > 100")
        database.commit()
        database.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        database.executemany("INSERT INTO messages VALUES (?, ?, ?, ?)", rows)
        database.commit()
        for name in ("live.db3", "live.db3-wal"):
            shutil.copy(tmp_path / name, folder / name)
    database.close()
    before = snapshot(folder)
    with open_recording(folder / "live.db3") as recording:
        assert read_all(recording) == expected_samples(ROS2)
        assert any("-wal" in note for note in recording.notes)
    assert snapshot(folder) == before


def test_zeroed_pages_of_a_database_cost_only_their_rows(tmp_path: Path) -> None:
    path = write_ros2(tmp_path / "bag", drive(ROS2, 10.0)) / "bag.db3"
    data = bytearray(path.read_bytes())
    middle = len(data) // 2 // 4096 * 4096
    data[middle : middle + 8192] = bytes(8192)
    path.write_bytes(data)
    with open_recording(path) as recording:
        found = sum(1 for _ in recording.read(["/imu"]))
        assert 900 < found < 1000
        assert "messages could be read" in recording.damage[0].what or "reading stopped" in recording.damage[0].what


def test_rows_without_data_or_time_are_counted(tmp_path: Path) -> None:
    path = write_ros2(tmp_path / "bag", [e for e in drive(ROS2) if e.topic == "/imu"]) / "bag.db3"
    with sqlite3.connect(path) as database:
        database.execute("UPDATE messages SET timestamp = 'noon' WHERE id = 5")
        database.execute("UPDATE messages SET data = '' WHERE id = 6")
    database.close()
    with open_recording(path) as recording:
        samples = list(recording.read())
        assert [isinstance(s, Problem) for s in samples] == [i == 4 for i in range(199)]
        assert "1 messages have no number as time and are left out" in recording.damage[0].what


@pytest.mark.parametrize("share", [0.3, 0.6, 0.95])
def test_a_torn_database_gives_the_rows_that_are_left(tmp_path: Path, share: float) -> None:
    path = write_ros2(tmp_path / "bag", drive(ROS2, 5.0)) / "bag.db3"
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])
    before = snapshot(tmp_path)
    with open_recording(path) as recording:
        assert recording.damage[0].affected == pytest.approx(1 - share, abs=0.02)
        found = [s.t_ns for s in recording.read(["/imu"])]
    assert found == sorted(set(found) & {START_NS + i * 10 * MS for i in range(500)})
    assert found[:100] == [START_NS + i * 10 * MS for i in range(100)]
    assert 0.7 * share * 500 < len(found) < 500
    assert snapshot(tmp_path) == before


def test_a_database_without_a_readable_row_is_refused(tmp_path: Path) -> None:
    path = write_ros2(tmp_path / "bag", drive(ROS2, 5.0)) / "bag.db3"
    path.write_bytes(path.read_bytes()[:9000])
    with pytest.raises(RecordingError, match="database") as caught:
        open_recording(path)
    assert ".recover" in caught.value.cure


# ------------------------------------------------------------------------------- the door


@pytest.mark.parametrize(
    ("content", "name", "words"),
    [
        (b"", "a.bag", "0 bytes"),
        (b"#ROSRECORD V1.2\n", "a.bag", "older than 2.0"),
        (b"#ROSBAG V3.1\n", "a.bag", "other than 2.0"),
        (b"\x00" * 100, "a.mcap", "named .mcap but does not begin like one"),
        (b"PK\x03\x04aaaaaaa", "a.zip", "zip archive"),
        (b"SQLite format 3\0" + bytes(200), "a.db3", "database"),
        (
            b"\x28\xb5\x2f\xfd" + b"\xff" * 50,
            "a.db3.zstd",
            "a.db3.zstd: it cannot be unpacked",
        ),
        (b"RRF2aaaa", "a.rrd", "Rerun recording"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_what_is_no_log_is_refused_in_one_line(tmp_path: Path, content: bytes, name: str, words: str) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(RecordingError) as caught:
        open_recording(path)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_path_that_is_not_there_is_said() -> None:
    with pytest.raises(RecordingError, match="no such file"):
        open_recording("/nowhere/at/all.bag")


def test_other_files_go_to_the_video_reader_and_the_tried_formats_are_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def open_video(path: Path, options: ReadOptions) -> Recording:
        raise RecordingError(path, "no video", "give a video")

    module = ModuleType("readers.video")
    module.open_video = open_video  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "readers.video", module)
    path = tmp_path / "letter.txt"
    path.write_text("dear all")
    with pytest.raises(RecordingError, match="tried MCAP, ROS 1 bag, ROS 2 database, plug-ins and video: no video"):
        open_recording(path)


def test_plugins_are_asked_for_what_is_no_bag(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    other = write_ros1(tmp_path / "inner.bag", drive(ROS1, 0.1))
    path = tmp_path / "log.own"
    path.write_text("own format")

    class Entry:
        name, value = "own", "own.reader:open"

        @staticmethod
        def load() -> Any:
            return lambda path, options: open_recording(other) if path.suffix == ".own" else None

    monkeypatch.setattr(readers, "entry_points", lambda group: [Entry] if group == readers.PLUGIN_GROUP else [])
    with open_recording(path) as recording:
        assert len(list(recording.read(["/imu"]))) == 10


# --------------------------------------------------------------------- recordings of others

SHARED = {
    "ros1_wheeled/husky_odom_imu_gps.bag": (16806, 16806),
    "ros1_imu/ardrone_imu.bag": (8616, 4308),
    "ros1_imu/sparkfun_razor.bag": (4288, 2144),
    "ros1_custom_types/tilt_laser.bag": (4093, 2135),
    "ros1_compression/example.bag": (8647, 3254),
    "ros1_compression/example-bz2.bag": (8647, 3254),
    "ros1_compression/example-lz4.bag": (8647, 3254),
    "ros2_db3_metadata_v2": (4695, 3130),
    "ros2_fixtures/sqlite3/talker": (20, 10),
    "ros2_fixtures/sqlite3/cdr_test": (7, 0),
    "ros2_fixtures/mcap/talker": (20, 10),
    "ros2_fixtures/mcap/cdr_test": (7, 0),
    "odd_files/ros1/no-messages.bag": (0, 0),
    "odd_files/ros1/example-unsorted-chunks.bag": (3, 3),
    "odd_files/ros2/sqlite3_no_messages": (0, 0),
}


@pytest.mark.parametrize("name", SHARED)
def test_shared_bags_hold_the_messages_that_rosbags_reads(name: str) -> None:
    path = RECORDINGS / name
    messages, samples = SHARED[name]
    # By folder rosbags drops topics whose QoS text in metadata.yaml is not that of the file.
    files = [path] if path.is_file() else [*path.glob("*.db3"), *path.glob("*.mcap")]
    with (
        open_recording(path) as recording,
        AnyReader(files, default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as oracle,
    ):
        channels = [c for log in recording._logs for c in log.channels]
        ours = sorted((m.log_ns, m.channel.topic, bytes(m.data)) for m in recording._messages(channels))
        theirs = sorted((t, c.topic, data) for c, t, data in oracle.messages()) if oracle.connections else []
        assert ours == theirs
        assert len(ours) == messages == sum(c.count for c in channels)
        counted = {c.topic: 0 for c in channels} | {topic: info.msgcount for topic, info in oracle.topics.items()}
        assert {t: sum(c.count for c in channels if c.topic == t) for t in counted} == counted
        assert sum(1 for s in recording.read() if not isinstance(s, Problem)) == samples
        assert recording.damage == ()


OUTCOMES = {
    "odd_files/ros1/empty-file.bag": "the file is empty (0 bytes); record or copy it again",
    "odd_files/ros1/old_format_v1_2.bag": "it is a ROS bag of a format older than 2.0; rewrite it with ROS 1's",
    "odd_files/ros1/index_record_wrong_length.bag": 360,
    "odd_files/ros2/sqlite3_three_files_no_metadata": 3177,
    "odd_files/ros2/mcap_three_files_no_metadata": 3177,
    "odd_files/ros2/sqlite3_unknown_serialization": 7,
    "odd_files/ros2/mcap_unknown_serialization": 7,
    "odd_files/truncated/husky.first50pct.bag": 7025,
    "odd_files/truncated/example-lz4.first70pct.bag": 8647,
    "odd_files/truncated/rosbag2_test_0.first60pct.db3": 2800,
    "odd_files/truncated/talker.first80pct.mcap": 20,
    "odd_files/truncated/custom-camera-model.first60pct.mcap": 18,
}


@pytest.mark.parametrize("name", OUTCOMES)
def test_odd_files_have_their_outcome(name: str) -> None:
    path, outcome = RECORDINGS / name, OUTCOMES[name]
    assert path.exists()
    before = snapshot(path if path.is_dir() else path.parent)
    if isinstance(outcome, str):
        with pytest.raises(RecordingError) as caught:
            open_recording(path)
        assert outcome in str(caught.value)
    else:
        with open_recording(path) as recording:
            channels = [c for log in recording._logs for c in log.channels]
            assert sum(1 for _ in recording._messages(channels)) == outcome
            survey(recording)
            assert bool(recording.damage) is ("truncated" in name)
            if "mcap_unknown" in name:
                assert {s.reason for s in recording.streams} == {"serialization format 'wrong_format' is not supported"}
    assert snapshot(path if path.is_dir() else path.parent) == before


def test_shared_bags_have_the_facts_that_are_known_of_them() -> None:
    def facts(name: str) -> dict[tuple[str, str], int]:
        with open_recording(RECORDINGS / name) as recording:
            return {(f.stream, f.code): f.count for f in survey(recording)}

    assert facts("ros1_imu/sparkfun_razor.bag") == {("/imu/data_raw", "identity_orientation"): 2144}
    assert facts("ros1_imu/ardrone_imu.bag") == {("/ardrone/imu", "gap"): 44}
    assert facts("ros1_custom_types/tilt_laser.bag")["/velocity", "duplicate_stamp"] == 356
    assert facts("ros1_wheeled/husky_odom_imu_gps.bag") == {}


def test_tilt_laser_is_in_order_although_it_was_recorded_late() -> None:
    with open_recording(RECORDINGS / "ros1_custom_types" / "tilt_laser.bag") as recording:
        samples = list(recording.read())
        assert [s.t_ns for s in samples] == sorted(s.t_ns for s in samples)
        assert max(s.received_ns - s.t_ns for s in samples) > 600 * MS
        assert "tilt_axis->laser" in " ".join(s.name for s in recording.streams)


def test_husky_frames_lose_their_leading_slash() -> None:
    with open_recording(RECORDINGS / "ros1_wheeled" / "husky_odom_imu_gps.bag") as recording:
        assert recording.stream("/fix").frame == "gps"
        first = next(iter(recording.read(["/fix"])))
    assert 0.5 < abs(first.latitude_rad) < 1.0
