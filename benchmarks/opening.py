"""What opening a log without an index costs, and what the cache of indexes leaves of it, in CPU time.

    python benchmarks/opening.py [--seconds 30] [--imus 300000] [--passes 3]

The logs lie in the page cache: images of a camera with IMU and odometry (those of `readers_ros.py`), and an IMU alone,
in MCAP files without an index, in a ROS 1 bag whose index records are taken out, and in a database.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Iterable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any

from mcap.writer import CompressionType, IndexType
from mcap.writer import Writer as McapWriter
from readers_ros import IMU, STORES, messages
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer

from readers import ReadOptions, open_recording
from readers.index_cache import ENVIRONMENT
from readers.ros1_bag import MAGIC, record_at

Row = tuple[str, str, int, bytes]
CHUNK, BAG_HEADER = 5, 3


def images(version: int, seconds: float) -> Iterator[Row]:
    """Topic, type, log time and bytes of a camera's mission."""
    store = STORES[version]
    for topic, kind, t_ns, message in messages(store, seconds):
        yield topic, kind, t_ns, bytes((store.serialize_ros1 if version == 1 else store.serialize_cdr)(message, kind))


def imus(version: int, count: int) -> Iterator[Row]:
    """The same of an IMU at 200 Hz, ten messages over and over."""
    ten = list(islice((row for row in images(version, 1.0) if row[1] == IMU), 10))
    for tick in range(count):
        topic, kind, _, data = ten[tick % 10]
        yield topic, kind, ten[0][2] + tick * 5_000_000, data


def write_mcap(path: Path, rows: Iterable[Row], compression: CompressionType) -> None:
    """An MCAP file that was never closed properly: it has no index."""
    with path.open("wb") as file:
        none: dict[str, Any] = dict.fromkeys(("use_statistics", "use_summary_offsets"), False)
        none |= dict.fromkeys(("repeat_channels", "repeat_schemas"), False)
        writer = McapWriter(file, chunk_size=1 << 20, compression=compression, index_types=IndexType.NONE, **none)
        writer.start("ros2")
        channels: dict[str, int] = {}
        for topic, kind, t_ns, data in rows:
            if topic not in channels:
                schema = writer.register_schema(kind, "ros2msg", STORES[2].generate_msgdef(kind)[0].encode())
                channels[topic] = writer.register_channel(topic, "cdr", schema)
            writer.add_message(channels[topic], t_ns, data, t_ns)
        writer.finish()


def write_bag(path: Path, rows: Iterable[Row]) -> None:
    """A ROS 1 bag of which only the chunks are left."""
    whole = path.with_suffix(".whole")
    with Ros1Writer(whole) as writer:
        connections: dict[str, Any] = {}
        for topic, kind, t_ns, data in rows:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=STORES[1])
            writer.write(connections[topic], t_ns, data)
    data, at = memoryview(whole.read_bytes()), len(MAGIC)
    with path.open("wb") as file:
        file.write(data[:at])
        while at < len(data):
            record = record_at(data, at)
            if record.operation in (CHUNK, BAG_HEADER):
                file.write(data[at : record.stop])
            at = record.stop
    whole.unlink()


def write_database(path: Path, rows: Iterable[Row]) -> None:
    """A ROS 2 bag."""
    with Ros2Writer(path, version=8, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connections: dict[str, Any] = {}
        for topic, kind, t_ns, data in rows:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=STORES[2])
            writer.write(connections[topic], t_ns, data)


def opening_s(path: Path, passes: int, *, cache: bool) -> float:
    """CPU time of one opening, the least of some."""
    found = []
    for _ in range(passes + cache):  # the first one fills the cache
        begun = time.process_time()
        open_recording(path, ReadOptions(cache=cache)).close()
        found.append(time.process_time() - begun)
    return min(found[cache:])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--imus", type=int, default=300_000)
    parser.add_argument("--passes", type=int, default=3)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        os.environ[ENVIRONMENT] = str(folder / "cache")
        for compression in (CompressionType.NONE, CompressionType.LZ4, CompressionType.ZSTD):
            write_mcap(folder / f"images {compression.name}.mcap", images(2, asked.seconds), compression)
        write_mcap(folder / "imu ZSTD.mcap", imus(2, asked.imus), CompressionType.ZSTD)
        write_bag(folder / "images.bag", images(1, asked.seconds))
        write_bag(folder / "imu.bag", imus(1, asked.imus))
        write_database(folder / "imu", imus(2, asked.imus))
        for path in sorted(folder.iterdir()):
            size = sum(file.stat().st_size for file in (path.iterdir() if path.is_dir() else (path,)))
            without = opening_s(path, asked.passes, cache=False)
            with_it = opening_s(path, asked.passes, cache=True)
            told = f"without {without * 1e3:7.1f} ms, with {with_it * 1e3:5.1f} ms, {without / with_it:5.1f} x"
            print(f"{path.name:18} {size / 1e6:6.1f} MB  {told}")


if __name__ == "__main__":
    main()
