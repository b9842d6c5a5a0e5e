"""What reading ROS 1 bags and ROS 2 databases costs beside `rosbags`, in CPU time and memory.

    python benchmarks/readers_ros.py [--seconds 30] [--passes 5]

The log is that of a camera of 512 x 512 pixels at 20 Hz with an IMU at 200 Hz and odometry at 50 Hz, textured and
noisy. Both read it in the same process, one after the other, from the page cache; the pass with the least CPU time of
all threads is told. Ours touches every payload (its first and last byte), as a reader of images would.
Bars: ROS 1 raw at most 0.5 x rosbags, uncompressed and lz4; the database's IMU at most 0.2 x; 32 MiB of extra memory.
"""

from __future__ import annotations

import argparse
import contextlib
import sqlite3
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_typestore

from readers import open_recording
from readers.log_recording import LogRecording

START_NS = 1_700_000_000_000_000_000
IMU, ODOMETRY, IMAGE = "sensor_msgs/msg/Imu", "nav_msgs/msg/Odometry", "sensor_msgs/msg/Image"
BARS = {"none raw": 0.5, "lz4 raw": 0.5, "db3 /imu": 0.2}
MEMORY_BAR_MIB = 32
STORES = {1: get_typestore(Stores.ROS1_NOETIC), 2: get_typestore(Stores.LATEST)}


def messages(store: Any, seconds: float) -> Iterator[tuple[str, str, int, Any]]:
    """Topic, type, log time and message, in the order of time."""
    make = store.types
    rng = np.random.default_rng(0)
    texture = rng.normal(128, 25, (600, 600))
    header_fields = {"seq": 0} if "seq" in make["std_msgs/msg/Header"].__dataclass_fields__ else {}

    def header(t_ns: int) -> Any:
        stamp = make["builtin_interfaces/msg/Time"](t_ns // 10**9, t_ns % 10**9)
        return make["std_msgs/msg/Header"](**header_fields, stamp=stamp, frame_id="base")

    def vector(name: str = "Vector3") -> Any:
        return make[f"geometry_msgs/msg/{name}"](*rng.normal(size=3))

    rotation = make["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.6, 0.8)
    for tick in range(round(seconds * 200)):
        t_ns = START_NS + tick * 5_000_000
        nine, many = np.ones(9), np.ones(36)
        yield "/imu", IMU, t_ns, make[IMU](header(t_ns), rotation, nine, vector(), nine, vector(), nine)
        if tick % 4 == 0:
            pose = make["geometry_msgs/msg/Pose"](vector("Point"), rotation)
            twist = make["geometry_msgs/msg/Twist"](vector(), vector())
            held = make["geometry_msgs/msg/PoseWithCovariance"](pose, many)
            moved = make["geometry_msgs/msg/TwistWithCovariance"](twist, many)
            yield "/odom", ODOMETRY, t_ns, make[ODOMETRY](header(t_ns), "base", held, moved)
        if tick % 10 == 0:
            shift = tick // 10 % 80
            pixels = texture[shift : shift + 512, :512] + rng.normal(0, 2.5, (512, 512))
            data = pixels.clip(0, 255).astype(np.uint8).reshape(-1)
            yield "/camera", IMAGE, t_ns, make[IMAGE](header(t_ns), 512, 512, "mono8", 0, 512, data)


def fill(writer: Any, generation: int, seconds: float) -> None:
    """Write the log."""
    store, connections = STORES[generation], {}
    serialize = store.serialize_ros1 if generation == 1 else store.serialize_cdr
    with writer:
        for topic, kind, t_ns, message in messages(store, seconds):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(connections[topic], t_ns, serialize(message, kind))


def made(folder: Path, seconds: float) -> dict[str, Path]:
    """The logs by name; bz2 is slow, so its log is an eighth as long."""
    paths = {}
    for form in ("none", "lz4", "bz2"):
        paths[form] = folder / f"{form}.bag"
        writer = Ros1Writer(paths[form])
        if form != "none":
            writer.set_compression(Ros1Writer.CompressionFormat[form.upper()])
        fill(writer, 1, seconds / 8 if form == "bz2" else seconds)
    paths["db3"] = folder / "bag"
    fill(Ros2Writer(paths["db3"], version=9, storage_plugin=StoragePlugin.SQLITE3), 2, seconds)
    return paths


# ------------------------------------------------------------------------------------ readers


def ours(path: Path, topics: list[str] | None, window: tuple[int, int] | None) -> int:
    """Messages as they are stored."""
    count = 0
    with open_recording(path) as recording:
        assert isinstance(recording, LogRecording)
        channels = [channel for channel in recording.channels if topics is None or channel.topic in topics]
        for message in recording.messages(channels, *(window or (None, None))):
            count += 1
            message.data[0], message.data[-1]
    return count


def theirs(path: Path, topics: list[str] | None, window: tuple[int, int] | None) -> int:
    """Messages as they are stored, by rosbags."""
    start, stop = window or (None, None)
    with AnyReader([path], default_typestore=STORES[2]) as reader:
        connections = [c for c in reader.connections if topics is None or c.topic in topics]
        return sum(1 for _ in reader.messages(connections, start, stop))


def sqlite_alone(path: Path, topic: str) -> int:
    """The rows of a topic in the order of time, fetched by Python's sqlite3, and nothing done with them."""
    query = "SELECT timestamp, data FROM messages WHERE topic_id = (SELECT id FROM topics WHERE name = ?) ORDER BY 1"
    with contextlib.closing(sqlite3.connect(next(path.glob("*.db3")))) as database:
        return sum(1 for _ in database.execute(query, (topic,)))


def ours_decoded(path: Path, topics: list[str] | None, window: tuple[int, int] | None) -> int:
    """Samples in the order of their stamps."""
    start, stop = window or (None, None)
    with open_recording(path) as recording:
        return sum(1 for _ in recording.read(topics, start, stop))


def theirs_decoded(path: Path, topics: list[str] | None, window: tuple[int, int] | None) -> int:
    """Deserialised messages, by rosbags."""
    start, stop = window or (None, None)
    count = 0
    with AnyReader([path], default_typestore=STORES[2]) as reader:
        connections = [c for c in reader.connections if topics is None or c.topic in topics]
        for connection, _, data in reader.messages(connections, start, stop):
            reader.deserialize(data, connection.msgtype)
            count += 1
    return count


def least(work: Callable[[], int], passes: int) -> tuple[float, int]:
    """The least CPU time (s) of some passes, and what they count."""
    times, count = [], 0
    for _ in range(passes):
        began = time.process_time()
        count = work()
        times.append(time.process_time() - began)
    return min(times), count


def anonymous_mib() -> float:
    """Anonymous memory of this process, in MiB; what is mapped of a file is not counted."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("RssAnon:"):
            return int(line.split()[1]) / 1024
    return float("nan")


def extra_memory(path: Path) -> float:
    """Most anonymous memory (MiB) that reading through a log takes on top of what was there."""
    before, most = anonymous_mib(), 0.0
    with open_recording(path) as recording:
        assert isinstance(recording, LogRecording)
        for number, message in enumerate(recording.messages()):
            message.data[0]
            if number % 50 == 0:
                most = max(most, anonymous_mib() - before)
    return most


def main() -> None:
    """Make the logs, time both readers and print the ratios."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--passes", type=int, default=5)
    given = parser.parse_args()
    middle = START_NS + round(given.seconds / 2 * 1e9)
    window = (middle, middle + 10**9)
    jobs: list[tuple[str, str, Any, Any, list[str] | None, tuple[int, int] | None]] = []
    for form in ("none", "lz4", "bz2", "db3"):
        jobs += [
            (f"{form} raw", form, ours, theirs, None, None),
            (f"{form} decoded", form, ours_decoded, theirs_decoded, None, None),
            (f"{form} /imu", form, ours, theirs, ["/imu"], None),
            (f"{form} /imu decoded", form, ours_decoded, theirs_decoded, ["/imu"], None),
        ]
        if form != "bz2":
            jobs.append((f"{form} 1 s of images", form, ours, theirs, ["/camera"], window))
    missed = 0
    with tempfile.TemporaryDirectory() as folder:
        paths = made(Path(folder), given.seconds)
        print(f"{'':24}{'ours ms':>10}{'rosbags ms':>12}{'ratio':>8}{'bar':>6}")
        for name, form, mine, other, topics, span in jobs:
            own_s, own = least(lambda m=mine, f=form, t=topics, s=span: m(paths[f], t, s), given.passes)
            peer_s, peer = least(lambda o=other, f=form, t=topics, s=span: o(paths[f], t, s), given.passes)
            assert own == peer, (name, own, peer)
            bar = BARS.get(name)
            missed += bar is not None and own_s / peer_s > bar
            print(f"{name:24}{own_s * 1e3:10.1f}{peer_s * 1e3:12.1f}{own_s / peer_s:8.3f}{bar or '':>6}")
        alone_s, rows = least(lambda: sqlite_alone(paths["db3"], "/imu"), given.passes)
        print(
            f"db3 /imu, fetching its {rows} rows alone: {alone_s * 1e3:.1f} ms, which no reader through SQLite is below"
        )
        for form, path in paths.items():
            extra = extra_memory(path)
            missed += extra > MEMORY_BAR_MIB
            print(f"{form}: {extra:.1f} MiB of extra memory, bar {MEMORY_BAR_MIB}")
    sys.exit(1 if missed else 0)


if __name__ == "__main__":
    main()
