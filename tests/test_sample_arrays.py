"""One structured array for a stream: its rows are the samples, in any container, and rosbags' own numbers."""

import itertools
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_logs import MS, ROS1, ROS2, START_NS, Entry, Maker, raw_ros, write_mcap, write_ros1, write_ros2
from recordings_dir import RECORDINGS
from rosbags.highlevel import AnyReader

from readers import ReadOptions, open_recording
from readers.clock import reorder
from readers.sample_arrays import ROW_TYPES, reordered
from readers.streams import Clock, ImuSample, Problem, Recording, Sample, StreamError, StreamKind

IMU, ODOMETRY = "sensor_msgs/msg/Imu", "nav_msgs/msg/Odometry"
KINDS = {"/imu": StreamKind.IMU, "/odom": StreamKind.ODOMETRY}


def motion(store: Any, count: int = 1200) -> list[Entry]:
    """IMU and odometry of random numbers at 200 and 50 Hz; every 7th IMU message has no orientation."""
    make, rng, found = Maker(store), np.random.default_rng(3), []
    for i in range(count):
        t_ns = START_NS + i * 5 * MS
        imu = make.imu(t_ns, float(rng.normal()))
        quat = rng.normal(size=4)
        imu.orientation = make.quaternion(*(quat / np.linalg.norm(quat)).tolist())
        imu.orientation_covariance = np.array([-1.0 if i % 7 == 0 else 0.0] + [0.0] * 8)
        found.append(Entry("/imu", IMU, t_ns + 2 * MS, imu))
        if i % 4 == 0:
            found.append(Entry("/odom", ODOMETRY, t_ns + 3 * MS, make.odometry(t_ns, float(rng.normal()))))
    return found


CONTAINERS: dict[str, Callable[[Path], Path]] = {
    "mcap": lambda path: write_mcap(path / "a.mcap", raw_ros(motion(ROS2), 2), "ros2", "zstd"),
    "mcap without index": lambda path: write_mcap(path / "a.mcap", raw_ros(motion(ROS2), 2), "ros2", index=False),
    "mcap of ROS 1": lambda path: write_mcap(path / "a.mcap", raw_ros(motion(ROS1), 1), "ros1", "lz4"),
    "ros1": lambda path: write_ros1(path / "a.bag", motion(ROS1), "lz4"),
    "db3": lambda path: write_ros2(path / "bag", motion(ROS2)),
    "db3, packed messages": lambda path: write_ros2(path / "bag", motion(ROS2), mode="message"),
}


def assert_rows_are_samples(rows: np.ndarray, samples: list[Sample]) -> None:
    """Every field of every sample, bit for bit."""
    assert len(rows) == len(samples)
    for row, sample in zip(rows, samples, strict=True):
        assert row["readable"] == (not isinstance(sample, Problem))
        for name in rows.dtype.names or ():
            if name != "readable" and hasattr(sample, name):
                assert np.asarray(row[name]).tobytes() == np.asarray(getattr(sample, name), row[name].dtype).tobytes()
            elif name != "readable":
                assert np.isnan(row[name]).all()


@pytest.mark.parametrize("container", CONTAINERS)
def test_rows_are_the_samples_and_those_of_rosbags(tmp_path: Path, container: str) -> None:
    path = CONTAINERS[container](tmp_path)
    with open_recording(path) as recording:
        for stream, kind in KINDS.items():
            rows = recording.array(stream)
            assert rows.dtype == ROW_TYPES[kind]
            assert not rows.flags.writeable
            assert_rows_are_samples(rows, list(recording.read([stream])))
        rows, odometry = recording.array("/imu"), recording.array("/odom")
    oracle = oracle_of(path)
    imus = [message for topic, _, message in oracle if topic == "/imu"]
    logged = [log_ns for topic, log_ns, _ in oracle if topic == "/imu"]
    assert rows["received_ns"].tolist() == logged
    stamps = [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for m in imus]
    assert rows["header_ns"].tolist() == rows["t_ns"].tolist() == stamps
    assert rows["angular_velocity_radps"].tolist() == [vector(m.angular_velocity) for m in imus]
    assert rows["linear_acceleration_mps2"].tolist() == [vector(m.linear_acceleration) for m in imus]
    measured = np.array([m.orientation_covariance[0] != -1.0 for m in imus])
    quats = np.array([[*vector(m.orientation), m.orientation.w] for m in imus])
    assert np.isnan(rows["quat_xyzw"][~measured]).all()
    assert rows["quat_xyzw"][measured].tolist() == quats[measured].tolist()
    odoms = [message for topic, _, message in oracle if topic == "/odom"]
    assert odometry["position_m"].tolist() == [vector(m.pose.pose.position) for m in odoms]
    assert odometry["linear_velocity_mps"].tolist() == [vector(m.twist.twist.linear) for m in odoms]
    assert odometry["angular_velocity_radps"].tolist() == [vector(m.twist.twist.angular) for m in odoms]


def oracle_of(path: Path) -> list[tuple[str, int, Any]]:
    """Topic, log time and message, as rosbags reads them."""
    if path.suffix == ".mcap":
        from mcap.reader import NonSeekingReader

        with path.open("rb") as file:
            return [
                (channel.topic, message.log_time, decoded(channel.message_encoding, message.data, schema.name))
                for schema, channel, message in NonSeekingReader(file).iter_messages()
                if schema is not None
            ]
    with AnyReader([path]) as reader:
        return [(c.topic, log_ns, reader.deserialize(raw, c.msgtype)) for c, log_ns, raw in reader.messages()]


def decoded(encoding: str, data: bytes, name: str) -> Any:
    if encoding == "cdr":
        return ROS2.deserialize_cdr(data, name)
    return ROS1.deserialize_ros1(data, name.replace("/", "/msg/"))


def vector(v: Any) -> list[float]:
    return [v.x, v.y, v.z]


def test_parts_of_a_split_log_are_one_array(tmp_path: Path) -> None:
    whole = motion(ROS2)
    for number, part in enumerate((whole[:400], whole[400:900], whole[900:])):
        write_mcap(tmp_path / f"bag_{number}.mcap", raw_ros(part, 2), "ros2", "zstd")
    with open_recording(tmp_path) as recording:
        rows = recording.array("/imu")
        assert len(rows) == 1200
        assert_rows_are_samples(rows, list(recording.read(["/imu"])))


@pytest.mark.parametrize("window", [(None, START_NS + 2000 * MS), (START_NS + 1003 * MS, None), (START_NS, START_NS)])
def test_a_window_is_half_open(tmp_path: Path, window: tuple[int | None, int | None]) -> None:
    with open_recording(CONTAINERS["mcap"](tmp_path)) as recording:
        rows = recording.array("/imu", *window)
        everything = recording.array("/imu")
        low, high = window[0] or 0, window[1] or 2**62
        assert rows.tobytes() == everything[(everything["t_ns"] >= low) & (everything["t_ns"] < high)].tobytes()


def test_pieces_are_bounded_and_make_the_whole(tmp_path: Path) -> None:
    with open_recording(CONTAINERS["mcap"](tmp_path)) as recording:
        pieces = list(recording.arrays("/imu", rows=100))
        assert np.concatenate(pieces).tobytes() == recording.array("/imu").tobytes()
        longest_wait = 1_000 // 5
        assert max(map(len, pieces)) <= 100 + longest_wait
        assert len(pieces) > 5


def odd(store: Any) -> list[Entry]:
    """Messages that are not of one layout: a cut one, odd quaternions, foreign stamps, other frames, disorder."""
    entries = motion(store, 600)
    imus = [entry.message for entry in entries if entry.topic == "/imu"]
    imus[20].orientation = Maker(store).quaternion(0.0, 0.0, 0.0, 0.0)
    imus[21].orientation = Maker(store).quaternion(0.0, 0.0, 3.0, 4.0)
    imus[40].header.stamp.sec = 5
    imus[50].header.frame_id = "another"
    imus[60].angular_velocity_covariance = np.array([-1.0] + [0.0] * 8)
    imus[70].header.stamp, imus[75].header.stamp = imus[75].header.stamp, imus[70].header.stamp
    for late in imus[300:305]:
        late.header.stamp.sec -= 1
    return entries


@pytest.mark.parametrize("options", [{}, {"offsets_ns": (("/imu", -7 * MS),)}, {"clocks": (("/imu", Clock.LOG),)}])
def test_odd_messages_have_the_rows_of_their_samples(tmp_path: Path, options: Any) -> None:
    raws = list(raw_ros(odd(ROS2), 2))
    places = [place for place, raw in enumerate(raws) if raw.topic == "/imu"]
    for place, data in ((places[10], raws[places[10]].data[:-9]), (places[11], b"")):
        raws[place] = raws[place]._replace(data=data)
    path = write_mcap(tmp_path / "a.mcap", raws, "ros2")
    with open_recording(path, ReadOptions(**options)) as recording:
        rows, samples = recording.array("/imu"), list(recording.read(["/imu"]))
        assert_rows_are_samples(rows, samples)
        assert np.count_nonzero(~rows["readable"]) == 2
        problem = rows[~rows["readable"]][0]
        assert problem["received_ns"] > 0
        assert np.isnan(problem["angular_velocity_radps"]).all()


TIMES = st.tuples(st.integers(0, 40), st.integers(-25, 25))


@settings(max_examples=200, deadline=None)
@given(st.lists(TIMES, max_size=60), st.integers(1, 20), st.booleans())
def test_rows_are_put_in_order_as_samples_are(steps: list[tuple[int, int]], size: int, in_log_order: bool) -> None:
    received, times = 10**12, []
    for step, early in steps:
        received += (step if in_log_order else step - 15) * 100 * MS
        times.append((received + early * 100 * MS, received))
    rows = np.zeros(len(times), ROW_TYPES[StreamKind.IMU])
    rows["t_ns"], rows["received_ns"] = np.array(times, np.int64).reshape(-1, 2).T
    rows["header_ns"] = np.arange(len(times))
    one = {"angular_velocity_radps": np.zeros(3), "linear_acceleration_mps2": np.zeros(3), "quat_xyzw": np.zeros(4)}
    samples = [ImuSample(stream="", t_ns=t, received_ns=r, header_ns=i, **one) for i, (t, r) in enumerate(times)]
    batches = (rows[at : at + size] for at in range(0, len(rows), size))
    found = list(itertools.chain.from_iterable(batch["header_ns"].tolist() for batch in reordered(batches, lag_ns=MS)))
    assert found == [sample.header_ns for sample in reorder(samples, lag_ns=MS)]


FOLDERS = [
    ("ros1_wheeled/husky_odom_imu_gps.bag", StreamKind.GNSS),
    ("ros2_db3_metadata_v2", StreamKind.POSE),
    ("euroc_v1_01_standstill_a", StreamKind.IMU),
    ("euroc_v1_01_standstill_a", StreamKind.POSE),
    ("ros1_custom_types/tilt_laser.bag", StreamKind.POSE),
]


@pytest.mark.parametrize(("name", "kind"), FOLDERS)
def test_every_recording_gives_arrays_of_numbers(name: str, kind: StreamKind) -> None:
    with open_recording(RECORDINGS / name) as recording:
        info = recording.of_kind(kind)[0]
        assert_rows_are_samples(recording.array(info.name), list(recording.read([info.name])))


def test_what_is_no_row_of_numbers_is_refused(tmp_path: Path) -> None:
    with open_recording(RECORDINGS / "kitti_06_first51") as recording:
        with pytest.raises(StreamError, match="image_0 is a stream of kind image, which is no array; arrays are of"):
            recording.array("image_0")
        with pytest.raises(StreamError, match="no stream named"):
            recording.array("image_7")
    raws = [raw._replace(log_ns=2**63 + i) for i, raw in enumerate(raw_ros(motion(ROS2, 8), 2))]
    with open_recording(write_mcap(tmp_path / "late.mcap", raws, "ros2")) as recording:
        assert isinstance(recording, Recording)
        rows = recording.array("/imu")
        assert set(rows["received_ns"]) == set(rows["t_ns"]) == {2**63 - 1}
        assert all(sample.oddities[0] == "late_log_time" for sample in recording.read(["/imu"]))


def test_the_example_of_the_page_runs(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    root = Path(__file__).parents[1]
    (block,) = re.findall(r"^```python\n(.*?)^```$", (root / "docs/readers.md").read_text(), re.MULTILINE | re.DOTALL)
    monkeypatch.chdir(root)
    exec(compile(block, "readers.md", "exec"), {})
    assert re.fullmatch(r"300 poses, \d+ heights in the first second, mean \d\.\d{3} m\n", capsys.readouterr().out)
