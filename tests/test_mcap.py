"""MCAP files: every compression, layout and encoding, Foxglove's types, and every kind of damage."""

import base64
import itertools
import json
import math
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, duration_pb2, message_factory, timestamp_pb2
from made_logs import MS, ROS1, ROS2, START_NS, Maker, Raw, drive, mcap_bytes, plain, raw_ros, write_mcap
from mcap.reader import make_reader
from recordings_dir import RECORDINGS
from rosbags.highlevel import AnyReader, AnyReaderError

from readers import open_recording
from readers.clock import survey
from readers.message_log import Channel, Message, Source, in_log_order
from readers.messages import Arrival, reader_of, samples_of
from readers.streams import CameraInfo, ImageSample, PoseSample, Problem, Recording, StreamKind

LAYOUTS: list[dict[str, Any]] = [
    {},
    {"use_chunking": False},
    {"index": False},
    {"index": False, "use_chunking": False},
    {"repeat_channels": False, "repeat_schemas": False},
    {"enable_crcs": False},
]
Bytes = Callable[[bytes], bytes]


def everything(recording: Recording) -> list[Any]:
    assert hasattr(recording, "_logs")
    return list(recording._messages([c for log in recording._logs for c in log.channels]))


def expected(store: Any) -> list[dict[str, Any]]:
    found = []
    for topic, kind, log_ns, message in drive(store):
        reader = reader_of(kind)
        assert reader is not None
        found += samples_of(reader, message, Arrival(topic, log_ns))
    return sorted((plain(s) for s in found), key=lambda s: (s["t_ns"], s["stream"]))


# --------------------------------------------------------------------------- what is sound


@pytest.mark.parametrize("generation", [1, 2])
@pytest.mark.parametrize("compression", ["none", "lz4", "zstd"])
@pytest.mark.parametrize("layout", LAYOUTS, ids=str)
def test_every_layout_reads_back_exactly(
    tmp_path: Path, generation: int, compression: str, layout: dict[str, Any]
) -> None:
    store = {1: ROS1, 2: ROS2}[generation]
    raws = raw_ros(drive(store), generation)
    path = write_mcap(tmp_path / "a.mcap", raws, f"ros{generation}", compression, **layout)
    with open_recording(path) as recording:
        assert recording.format == f"MCAP, profile ros{generation}"
        assert recording.damage == ()
        assert recording.stream("/imu").count == 200
        assert (recording.stream("/imu").first_ns, recording.stream("/imu").last_ns) == (
            START_NS + 5 * MS,
            START_NS + 1995 * MS,
        )
        samples = list(recording.read())
        assert [s.t_ns for s in samples] == sorted(s.t_ns for s in samples)
        assert sorted((plain(s) for s in samples), key=lambda s: (s["t_ns"], s["stream"])) == expected(store)
        middle = [s.t_ns for s in recording.read(["/imu"], START_NS + 500 * MS, START_NS + 600 * MS)]
        assert middle == [START_NS + i * 10 * MS for i in range(50, 60)]


def test_log_times_out_of_order_come_sorted_and_none_is_lost(tmp_path: Path) -> None:
    raws = list(raw_ros(drive(ROS2), 2))
    shuffled = [raws[i] for i in np.random.default_rng(1).permutation(len(raws))]
    for layout in LAYOUTS:
        with open_recording(write_mcap(tmp_path / "a.mcap", shuffled, "ros2", **layout)) as recording:
            times = [m.log_ns for m in everything(recording)]
            assert times == sorted(raw.log_ns for raw in raws)


def test_distribution_types_serve_a_log_without_definitions(tmp_path: Path) -> None:
    raws = [r._replace(schema=(r.schema[0], "", b"")) for r in raw_ros(drive(ROS2, 0.2), 2) if r.topic == "/imu"]
    with open_recording(write_mcap(tmp_path / "a.mcap", raws, "ros2")) as recording:
        assert [s.angular_velocity_radps[0] for s in recording.read()] == [float(i) for i in range(20)]


def test_a_topic_with_two_types_is_two_streams(tmp_path: Path) -> None:
    raws = [r._replace(topic="/both") for r in raw_ros(drive(ROS2, 0.2), 2) if r.topic in ("/imu", "/odom")]
    with open_recording(write_mcap(tmp_path / "a.mcap", raws, "ros2")) as recording:
        assert {s.name: s.kind for s in recording.streams} == {
            "/both": StreamKind.IMU,
            "/both [nav_msgs/msg/Odometry]": StreamKind.ODOMETRY,
        }
        assert sum(1 for s in recording.read() if not isinstance(s, Problem)) == len(raws)


def test_sources_are_opened_when_their_time_has_come() -> None:
    raws = []

    def source(number: int) -> Source:
        def open_it() -> Any:
            raws.append(number)
            return iter(())

        return Source(number, open_it)

    merged = in_log_order(source(i) for i in range(3))
    assert list(merged) == []
    assert raws == [0, 1, 2]


def test_no_more_sources_are_made_than_are_come_to() -> None:
    made: list[int] = []

    def sources() -> Iterator[Source]:
        for number in range(100):
            made.append(number)
            message = Message(number * 10, Channel("/a", "", ""), b"")
            yield Source(number * 10, lambda message=message: iter([message]), number * 10 + 5)  # type: ignore[misc]

    assert [message.log_ns for message in itertools.islice(in_log_order(sources()), 3)] == [0, 10, 20]
    assert made == [0, 1, 2, 3]


def test_memory_does_not_grow_with_the_file(tmp_path: Path) -> None:
    import tracemalloc

    make = Maker(ROS2)
    pixels = np.random.default_rng(0).integers(0, 255, 250_000).astype(np.uint8)
    peaks = []
    for count in (80, 320):  # both are long enough to be unpacked ahead, which depends on how fast threads are
        images = (
            Raw(
                "/image",
                ("sensor_msgs/msg/Image", "", b""),
                "cdr",
                START_NS + i * 500 * MS,
                bytes(
                    ROS2.serialize_cdr(
                        make.image(START_NS + i * 500 * MS, height=500, width=500, step=500, data=pixels),
                        "sensor_msgs/msg/Image",
                    )
                ),
            )
            for i in range(count)
        )
        path = write_mcap(tmp_path / f"{count}.mcap", images, "ros2", "zstd", chunk_size=1 << 20)
        tracemalloc.start()
        with open_recording(path) as recording:
            assert sum(1 for _ in recording.read()) == count
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert max(peaks) < 10 * (1 << 20) < 320 * pixels.nbytes / 5
    assert peaks[1] - peaks[0] < 3 * (1 << 20)


# ------------------------------------------------------------------- JSON and protobuf

STAMP = {"sec": START_NS // 10**9, "nsec": 250_000_000}
POSITION, ROTATION = {"x": 1.0, "y": 2.0, "z": 3.0}, {"x": 0.0, "y": 0.0, "z": 0.6, "w": 0.8}
JPEG = b"\xff\xd8\xff\xe0 not really a picture"
FOXGLOVE: dict[str, dict[str, Any]] = {
    "CompressedImage": {"timestamp": STAMP, "frame_id": "cam", "data": JPEG, "format": "jpeg"},
    "RawImage": {
        "timestamp": STAMP,
        "frame_id": "cam",
        "width": 4,
        "height": 2,
        "encoding": "rgb8",
        "step": 12,
        "data": bytes(range(24)),
    },
    "CameraCalibration": {
        "timestamp": STAMP,
        "frame_id": "cam",
        "width": 4,
        "height": 2,
        "distortion_model": "plumb_bob",
        "D": [0.1, 0.0, 0.0, 0.0, 0.0],
        "K": [50.0, 0.0, 2.0, 0.0, 50.0, 1.0, 0.0, 0.0, 1.0],
        "R": [],
        "P": [50.0, 0.0, 2.0, 0.0, 0.0, 50.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0],
    },
    "PoseInFrame": {"timestamp": STAMP, "frame_id": "map", "pose": {"position": POSITION, "orientation": ROTATION}},
    "FrameTransform": {
        "timestamp": STAMP,
        "parent_frame_id": "map",
        "child_frame_id": "base",
        "translation": POSITION,
        "rotation": ROTATION,
    },
}


def as_json(name: str, fields: dict[str, Any]) -> Raw:
    data = json.dumps(fields, default=lambda raw: base64.b64encode(raw).decode()).encode()
    return Raw(f"/{name}", (f"foxglove.{name}", "jsonschema", b"{}"), "json", START_NS + 300 * MS, data)


def as_protobuf(name: str, fields: dict[str, Any]) -> Raw:
    files = proto_files()
    pool = descriptor_pool.DescriptorPool()
    for file in reversed(files.file):
        pool.Add(file)
    message = message_factory.GetMessageClass(pool.FindMessageTypeByName(f"foxglove.{name}"))()
    fill(message, fields)
    schema = (f"foxglove.{name}", "protobuf", files.SerializeToString())
    return Raw(f"/{name}", schema, "protobuf", START_NS + 300 * MS, message.SerializeToString())


def fill(message: Any, fields: dict[str, Any]) -> None:
    for key, value in fields.items():
        if key == "timestamp":
            message.timestamp.seconds, message.timestamp.nanos = value["sec"], value["nsec"]
        elif isinstance(value, dict):
            fill(getattr(message, key), value)
        elif isinstance(value, list):
            getattr(message, key).extend(value)
        else:
            setattr(message, key, value)


def proto_files() -> Any:
    """Foxglove's messages as a FileDescriptorSet whose files come in the wrong order, users first."""
    kinds = {float: 1, int: 13, bytes: 12, str: 9}
    file = descriptor_pb2.FileDescriptorProto(name="foxglove/all.proto", package="foxglove", syntax="proto3")
    file.dependency.append("google/protobuf/timestamp.proto")
    parts = {"Vector3": POSITION, "Quaternion": ROTATION, "Pose": FOXGLOVE["PoseInFrame"]["pose"]}
    inner = {"position": "Vector3", "translation": "Vector3", "orientation": "Quaternion", "rotation": "Quaternion"}
    for name, fields in (parts | FOXGLOVE).items():
        message = file.message_type.add(name=name)
        for number, (key, value) in enumerate(fields.items(), start=1):
            field = message.field.add(name=key, number=number, label=1)
            if key == "timestamp":
                field.type, field.type_name = 11, ".google.protobuf.Timestamp"
            elif isinstance(value, dict):
                field.type, field.type_name = 11, f".foxglove.{inner.get(key, 'Pose')}"
            elif isinstance(value, list):
                field.type, field.label = 1, 3
            else:
                field.type = kinds[type(value)]
    stamp = descriptor_pb2.FileDescriptorProto()
    timestamp_pb2.DESCRIPTOR.CopyToProto(stamp)
    return descriptor_pb2.FileDescriptorSet(file=[file, stamp])


@pytest.mark.parametrize("encode", [as_json, as_protobuf])
def test_foxglove_types_become_samples(tmp_path: Path, encode: Callable[[str, dict[str, Any]], Raw]) -> None:
    raws = [encode(name, fields) for name, fields in FOXGLOVE.items()]
    with open_recording(write_mcap(tmp_path / "a.mcap", raws, compression="zstd")) as recording:
        samples = {sample.stream: sample for sample in recording.read()}
        cameras = recording.cameras
        definition = recording.stream("/PoseInFrame").definition
    assert {s.t_ns for s in samples.values()} == {START_NS + 250 * MS}
    assert {s.received_ns for s in samples.values()} == {START_NS + 300 * MS}
    compressed, raw = samples["/CompressedImage"], samples["/RawImage"]
    assert isinstance(compressed, ImageSample)
    assert isinstance(raw, ImageSample)
    assert (bytes(compressed.data), compressed.encoding) == (JPEG, "jpeg")
    assert (bytes(raw.data), raw.encoding, raw.step_bytes, raw.width_px) == (bytes(range(24)), "rgb8", 12, 4)
    calibration = samples["/CameraCalibration"]
    assert isinstance(calibration, CameraInfo)
    assert calibration.camera.matrix[0, 0] == 50.0
    assert np.isnan(calibration.camera.rectification).all()
    assert cameras["/RawImage"].frame == "cam"
    for name in ("/PoseInFrame", "/FrameTransform:map->base"):
        pose = samples[name]
        assert isinstance(pose, PoseSample)
        np.testing.assert_array_equal(pose.position_m, [1, 2, 3])
        np.testing.assert_array_equal(pose.quat_xyzw, [0, 0, 0.6, 0.8])
        assert pose.parent_frame == "map"
    assert ("PoseInFrame" in definition) is (encode is as_protobuf)


def test_protobuf_schema_may_leave_out_the_well_known_types(tmp_path: Path) -> None:
    raw = as_protobuf("PoseInFrame", FOXGLOVE["PoseInFrame"])
    files = descriptor_pb2.FileDescriptorSet.FromString(raw.schema[2])
    del files.file[1]
    raw = raw._replace(schema=(*raw.schema[:2], files.SerializeToString()))
    with open_recording(write_mcap(tmp_path / "a.mcap", [raw])) as recording:
        assert len(list(recording.read())) == 1
    assert duration_pb2.DESCRIPTOR.name == "google/protobuf/duration.proto"


def test_ros_types_in_json_are_read(tmp_path: Path) -> None:
    message = {
        "header": {"stamp": {"sec": STAMP["sec"], "nanosec": 5}, "frame_id": "/lidar"},
        "range": 1.5,
        "min_range": 0.1,
        "max_range": 9.0,
        "field_of_view": 0.2,
    }
    raw = Raw("/height", ("sensor_msgs/msg/Range", "jsonschema", b"{}"), "json", START_NS, json.dumps(message).encode())
    with open_recording(write_mcap(tmp_path / "a.mcap", [raw])) as recording:
        (sample,) = recording.read()
        assert recording.stream("/height").frame == "lidar"
    assert (sample.range_m, sample.max_range_m, sample.t_ns) == (1.5, 9.0, START_NS + 5)


# ------------------------------------------------------------------------- what is unsound


@pytest.mark.parametrize(
    ("schema", "encoding", "reason"),
    [
        (("sensor_msgs/msg/Imu", "ros2msg", b"this is } no definition ["), "cdr", "cannot be parsed"),
        (("sensor_msgs/msg/Imu", "ros2msg", b"other_msgs/Thing x"), "cdr", "cannot be parsed"),
        (("sensor_msgs/msg/Imu", "ros2idl", b"module x {"), "cdr", "cannot be parsed"),
        (("foxglove.RawImage", "protobuf", b"\xff\xff\xff"), "protobuf", "cannot be parsed"),
        (("foxglove.RawImage", "protobuf", b""), "protobuf", "cannot be parsed"),
        (("sensor_msgs/msg/Imu", "ros2msg", b""), "cbor", "serialization format 'cbor' is not supported"),
        (("", "", b""), "cdr", "no schema"),
        (("my_msgs/msg/Own", "ros2msg", b"int32 a"), "cdr", "no reader for type my_msgs/msg/Own"),
    ],
)
def test_an_unreadable_topic_leaves_the_others(
    tmp_path: Path, schema: tuple[str, str, bytes], encoding: str, reason: str
) -> None:
    raws = [r for r in raw_ros(drive(ROS2, 0.1), 2) if r.topic == "/imu"]
    raws.append(Raw("/bad", schema, encoding, START_NS, b"\x00\x01\x00\x00 whatever"))
    with open_recording(write_mcap(tmp_path / "a.mcap", raws, "ros2")) as recording:
        assert not recording.stream("/bad").readable
        assert reason in recording.stream("/bad").reason
        assert recording.stream("/bad").count == 1
        assert [s.stream for s in recording.read()] == ["/imu"] * 10


def test_undecodable_messages_are_problems_in_their_place(tmp_path: Path) -> None:
    raws = [r for r in raw_ros(drive(ROS2, 0.2), 2) if r.topic == "/imu"]
    raws[5] = raws[5]._replace(data=raws[5].data[:60])
    raws[6] = raws[6]._replace(data=b"")
    raws[7] = raws[7]._replace(data=raws[7].data + bytes(40))
    bad = as_json("PoseInFrame", {"timestamp": STAMP})
    raws.append(bad)
    raws.append(bad._replace(data=b"{"))
    raws.append(as_json("PoseInFrame", FOXGLOVE["PoseInFrame"]))
    with open_recording(write_mcap(tmp_path / "a.mcap", raws)) as recording:
        samples = list(recording.read())
        facts = {(f.stream, f.code): f.count for f in survey(recording)}
    problems = [s for s in samples if isinstance(s, Problem)]
    assert len(samples) == 23
    assert [p.t_ns for p in problems if p.stream == "/imu"] == [START_NS + i * 10 * MS for i in (5, 6, 7)]
    assert facts == {("/imu", "undecodable"): 3, ("/imu", "gap"): 1, ("/PoseInFrame", "undecodable"): 2}
    assert any("missing" in p.reason for p in problems)


@pytest.mark.parametrize("compression", ["none", "lz4", "zstd"])
@pytest.mark.parametrize("chunked", [True, False])
def test_a_torn_file_gives_what_is_there_and_says_so(tmp_path: Path, compression: str, chunked: bool) -> None:
    raws = list(raw_ros(drive(ROS2, 1.0), 2))
    known = {(r.topic, r.log_ns, r.data) for r in raws}
    whole = mcap_bytes(raws, "ros2", compression, use_chunking=chunked)
    path, counts = tmp_path / "torn.mcap", []
    for size in [*range(8, len(whole), len(whole) // 70), len(whole) - 1]:
        path.write_bytes(whole[:size])
        with open_recording(path) as recording:
            found = [(m.channel.topic, m.log_ns, bytes(m.data)) for m in everything(recording)]
            assert set(found) <= known
            assert recording.damage
            assert sum(s.count for s in recording.streams if s.count > 0 and "tf" not in s.name) <= len(found)
            counts.append(len(found))
    assert counts == sorted(counts)
    assert counts[-1] == len(raws)
    if compression == "none":
        halfway = counts[len(counts) // 2]
        assert 0.3 * len(raws) < halfway < 0.8 * len(raws)


def chunk_of(data: bytes, number: int) -> tuple[int, int]:
    """Where the chunk record of that number begins and how long it is."""
    at = 8
    while True:
        opcode, length = struct.unpack_from("<BQ", data, at)
        if opcode == 6:
            if number == 0:
                return at, 9 + length
            number -= 1
        at += 9 + length


def flip_in_chunk(data: bytes) -> bytes:
    at, size = chunk_of(data, 2)
    changed = bytearray(data)
    changed[at + size // 2] ^= 0x10
    return bytes(changed)


def zero_second_half(data: bytes) -> bytes:
    return data[: len(data) // 2] + bytes(len(data) - len(data) // 2)


def unknown_compression(data: bytes) -> bytes:
    at, size = chunk_of(data, 2)
    return data[:at] + data[at : at + size].replace(b"zstd", b"zopf", 1) + data[at + size :]


def huge_claim(data: bytes) -> bytes:
    at, _ = chunk_of(data, 2)
    return data[: at + 9 + 16] + struct.pack("<Q", 2**40) + data[at + 9 + 24 :]


def huge_record(data: bytes) -> bytes:
    at, _ = chunk_of(data, 2)
    return data[: at + 1] + struct.pack("<Q", 2**62) + data[at + 9 :]


def huge_record_without_index(data: bytes) -> bytes:
    return huge_record(data)[:-100]


def bad_summary_offset(data: bytes) -> bytes:
    return data[:-28] + struct.pack("<Q", len(data) * 2) + data[-20:]


def bad_summary_crc(data: bytes) -> bytes:
    return data[:-12] + b"abcd" + data[-8:]


def garbage_after(data: bytes) -> bytes:
    return data + b"something else"


def twice(data: bytes) -> bytes:
    return data + data


CHUNK_LOST = {"flip_in_chunk"}
ALL_READ = {
    "unknown_compression",  # the chunk index knows the right one
    "huge_claim",
    "huge_record",
    "huge_record_without_index",
    "bad_summary_offset",
    "bad_summary_crc",
    "garbage_after",
    "twice",
}
SILENT = {"huge_record"}  # nothing of the chunk's own record header is needed where there is an index


@pytest.mark.parametrize(
    "harm",
    [
        flip_in_chunk,
        unknown_compression,
        huge_claim,
        huge_record,
        bad_summary_offset,
        bad_summary_crc,
        garbage_after,
        twice,
        zero_second_half,
        huge_record_without_index,
    ],
)
def test_damage_is_said_and_costs_only_itself(tmp_path: Path, harm: Bytes) -> None:
    raws = list(raw_ros(drive(ROS2, 4.0), 2))
    known = {(r.topic, r.log_ns, r.data) for r in raws}
    whole = mcap_bytes(raws, "ros2", "zstd")
    path = tmp_path / "a.mcap"
    path.write_bytes(harm(whole))
    with open_recording(path) as recording:
        found = [(m.channel.topic, m.log_ns, bytes(m.data)) for m in everything(recording)]
        assert set(found) <= known
        survey(recording)
        assert bool(recording.damage) is (harm.__name__ not in SILENT)
        if harm.__name__ in ALL_READ:
            assert len(found) == len(raws) * (2 if harm is twice else 1)
        else:
            assert "byte" in str(recording.damage[0])
            assert 0 < len(found) < len(raws)
        if harm.__name__ in CHUNK_LOST:
            assert len(found) > 0.8 * len(raws)


def test_wrong_bytes_never_pass_a_checksum(tmp_path: Path) -> None:
    raws = list(raw_ros(drive(ROS2, 0.3), 2))
    known = {(r.topic, r.log_ns, r.data) for r in raws}
    whole = mcap_bytes(raws, "ros2", "lz4", chunk_size=1500)
    path = tmp_path / "a.mcap"
    for place in range(60, len(whole) - 40, 97):
        changed = bytearray(whole)
        changed[place] ^= 1 << place % 8
        path.write_bytes(changed)
        with open_recording(path) as recording:
            found = {(m.channel.topic, m.log_ns, bytes(m.data)) for m in everything(recording)}
            assert {f[1:] for f in found} <= {k[1:] for k in known}
            assert found == known or recording.damage


def test_messages_of_an_undescribed_channel_are_counted(tmp_path: Path) -> None:
    whole = mcap_bytes(raw_ros(drive(ROS2, 0.2), 2), "ros2", index=False, use_chunking=False, enable_crcs=False)
    at = whole.index(b"/imu") - 4 - 2 - 2 - 9
    assert whole[at] == 4
    path = tmp_path / "a.mcap"
    path.write_bytes(whole[:at] + b"\x7f" + whole[at + 1 :])
    with open_recording(path) as recording:
        assert "/imu" not in {s.name for s in recording.streams}
        texts = [harm.what for harm in recording.damage]
        assert any("passed over" in text for text in texts)
        strangers = [text for text in texts if "messages are of channels that the file does not describe" in text]
        assert sum(int(text.split()[0]) for text in strangers) == 20
        assert recording.stream("/odom").count == 4


def test_no_random_bytes_raise_anything_but_our_errors(tmp_path: Path) -> None:
    from readers.streams import WorkbenchError

    rng = np.random.default_rng(7)
    whole = mcap_bytes(raw_ros(drive(ROS2, 0.2), 2), "ros2", "zstd", enable_crcs=False)
    path = tmp_path / "a.mcap"
    opened = 0
    for _ in range(150):
        changed = bytearray(whole)
        for place in rng.integers(8, len(whole), 6):
            changed[place] = rng.integers(0, 256)
        path.write_bytes(changed)
        try:
            with open_recording(path) as recording:
                survey(recording)
            opened += 1
        except WorkbenchError:
            pass
    assert opened > 100


# ------------------------------------------------------------------ recordings of others


SOUND = sorted(path for path in RECORDINGS.rglob("*.mcap") if "truncated" not in path.parts)


def test_sound_files_hold_the_messages_that_mcap_and_rosbags_read() -> None:
    by_rosbags = 0
    for path in SOUND:
        with open_recording(path) as recording, path.open("rb") as file:
            ours = sorted((m.log_ns, m.channel.topic, bytes(m.data)) for m in everything(recording))
            assert recording.damage == ()
            theirs = make_reader(file, validate_crcs=True).iter_messages()
            assert ours == sorted((m.log_time, channel.topic, m.data) for _, channel, m in theirs)
            if "ros2" in recording.format:
                try:
                    with AnyReader([path]) as reader:
                        raws = sorted((t_ns, connection.topic, raw) for connection, t_ns, raw in reader.messages())
                except AnyReaderError:  # it refuses the definition of one topic, and with it the log
                    continue
                assert ours == raws
                by_rosbags += 1
    assert by_rosbags >= 4


def test_custom_camera_model_has_log_times_and_says_why() -> None:
    with open_recording(RECORDINGS / "mcap_json" / "custom-camera-model.mcap") as recording:
        images = list(recording.read(["/image/compressed"]))
        assert [i.t_ns for i in images] == [i.received_ns for i in images]
        assert math.isclose(np.diff([i.t_ns for i in images]).mean() / MS, 100.0, rel_tol=1e-3)
        assert {i.encoding for i in images} == {"jpeg"}
        assert any("looks like milliseconds" in note for note in recording.notes)
        assert {f.code: f.count for f in survey(recording) if f.stream == "/image/compressed"} == {"foreign_stamp": 10}
        assert recording.cameras["/image/compressed"].matrix[0, 0] == 800.0
