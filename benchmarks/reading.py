"""How fast logs are read beside other readers, in CPU time.

    python benchmarks/reading.py [--seconds 75] [--passes 5] [--codecs none lz4 zstd]

The log is 512 x 512 mono8 at 20 Hz of a noisy texture, IMU at 200 Hz and odometry at 50 Hz, in chunks of 1 MiB. Every
figure is the least CPU time of several passes. Each work has a process of its own, and they take turns: in one process
the first work would decide whether the memory of the others is new, which for lz4 is most of the time. The column
`floor` is the ratio that unpacking the same chunks and comparing their checksums has by itself, with nothing else done.
Extra memory is anonymous memory.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import lz4.frame  # type: ignore[import-untyped, unused-ignore]
import numpy as np
import zstandard
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from readers import open_recording
from readers.mcap_log import McapLog
from readers.mcap_records import HEAD, read_chunk_head
from readers.message_log import crc32, in_log_order

SIDE_PX, IMAGE_HZ, IMU_HZ, ODOMETRY_HZ = 512, 20, 200, 50
START_NS, SECOND_NS = 1_700_000_000_000_000_000, 1_000_000_000
TYPES = {"/image": "sensor_msgs/msg/Image", "/imu": "sensor_msgs/msg/Imu", "/odom": "nav_msgs/msg/Odometry"}
ROUNDS = 2
Work = Callable[[], object]


def make(path: Path, codec: str, seconds: int) -> None:
    """Write the log."""
    store = get_typestore(Stores.LATEST)
    rng = np.random.default_rng(7)
    texture = rng.normal(128, 40, (SIDE_PX * 2, SIDE_PX * 2))
    for _ in range(3):
        texture = (texture + np.roll(texture, 1, 0) + np.roll(texture, 1, 1) + np.roll(texture, -1, 0)) / 4
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=1 << 20, compression=CompressionType[codec.upper()])
        writer.start(profile="ros2", library="benchmark")
        channels = {}
        for topic, kind in TYPES.items():
            text = store.generate_msgdef(kind, ros_version=2)[0].encode()
            channels[topic] = writer.register_channel(topic, "cdr", writer.register_schema(kind, "ros2msg", text))
        for i in range(seconds * IMU_HZ):
            t_ns = START_NS + i * SECOND_NS // IMU_HZ
            topics = (
                ["/imu"] + ["/odom"] * (i % (IMU_HZ // ODOMETRY_HZ) == 0) + ["/image"] * (i % (IMU_HZ // IMAGE_HZ) == 0)
            )
            for topic in topics:
                data = bytes(store.serialize_cdr(_message(store, topic, t_ns, i, texture, rng), TYPES[topic]))
                writer.add_message(channels[topic], t_ns, data, t_ns)
        writer.finish()


def _message(store, topic: str, t_ns: int, i: int, texture, rng):
    kinds = store.types
    stamp = kinds["builtin_interfaces/msg/Time"](sec=t_ns // SECOND_NS, nanosec=t_ns % SECOND_NS)
    header = kinds["std_msgs/msg/Header"](stamp=stamp, frame_id="base_link")
    vector = kinds["geometry_msgs/msg/Vector3"]
    turn = kinds["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.6, w=0.8)
    if topic == "/imu":
        nine = np.zeros(9)
        return kinds[TYPES[topic]](header, turn, nine, vector(0.1, 0.2, i * 1.0), nine, vector(0.0, 0.0, 9.81), nine)
    if topic == "/odom":
        zeros = np.zeros(36)
        pose = kinds["geometry_msgs/msg/Pose"](kinds["geometry_msgs/msg/Point"](i * 0.1, 0.0, 0.0), turn)
        twist = kinds["geometry_msgs/msg/Twist"](vector(1.0, 0.0, 0.0), vector(0.0, 0.0, 0.1))
        return kinds[TYPES[topic]](
            header,
            "base_link",
            kinds["geometry_msgs/msg/PoseWithCovariance"](pose, zeros),
            kinds["geometry_msgs/msg/TwistWithCovariance"](twist, zeros),
        )
    u = (i // 10) % SIDE_PX
    pixels = texture[u : u + SIDE_PX, u : u + SIDE_PX] + rng.normal(0, 2.5, (SIDE_PX, SIDE_PX))
    grey = np.clip(pixels, 0, 255).astype(np.uint8).reshape(-1)
    return kinds[TYPES[topic]](header, SIDE_PX, SIDE_PX, "mono8", 0, SIDE_PX, grey)


# ------------------------------------------------------------------------------------ work


def drain(messages: Iterable[object]) -> int:
    """How many there are."""
    return sum(1 for _ in messages)


def own_raw(path: Path, topics: tuple[str, ...] = (), start_ns: int | None = None, stop_ns: int | None = None) -> int:
    """All messages as views, from opening to the last."""
    log = McapLog(path)
    channels = [channel for channel in log.channels if not topics or channel.topic in topics]
    count = drain(in_log_order(log.sources(channels, start_ns, stop_ns)))
    log.close()
    return count


def own_samples(path: Path) -> int:
    """All samples in the order of their stamps, from opening to the last; an image is a view of its pixels."""
    with open_recording(path) as recording:
        return drain(recording.read(["/image", "/imu"]))


def peer_raw(
    path: Path,
    topics: tuple[str, ...] = (),
    start_ns: int | None = None,
    stop_ns: int | None = None,
    *,
    check: bool = False,
) -> int:
    """The same with `mcap`, which does not compare checksums unless it is told to."""
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=check)
        return drain(reader.iter_messages(list(topics) or None, start_time=start_ns, end_time=stop_ns))


def rosbags_decoded(path: Path) -> int:
    """The same with `rosbags`."""
    with AnyReader([path]) as reader:
        wanted = [connection for connection in reader.connections if connection.topic in ("/image", "/imu")]
        return drain(reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages(wanted))


def unpacking(path: Path, start_ns: int = 0, stop_ns: int = 2**63, *, check: bool = True) -> Work:
    """Unpack every chunk of a range of time, compare it with its checksum if asked to, and do nothing with it."""
    log = McapLog(path)
    packed = []
    for block in log._blocks:
        if block.last_ns >= start_ns and block.first_ns < stop_ns:
            body = log.view[block.offset + HEAD.size : block.offset + block.size]
            head = read_chunk_head(body)
            packed.append((head, body[head.start : head.stop]))
    zstd = zstandard.ZstdDecompressor()

    def unpack() -> None:
        for head, stored in packed:
            data: bytes | memoryview = stored
            if head.compression == "zstd":
                data = zstd.decompress(stored)
            elif head.compression == "lz4":
                context = lz4.frame.create_decompression_context()
                data = lz4.frame.decompress_chunk(context, stored, max_length=head.unpacked_bytes)[0]
            assert not check or crc32(data) == head.crc

    return unpack


# ---------------------------------------------------------------------------------- figures


def works(path: Path, seconds: int) -> dict[str, Callable[[], Work]]:
    """What is timed, by name; a call makes it ready."""
    middle = START_NS + seconds * SECOND_NS // 2
    span = (middle, middle + SECOND_NS)
    return {
        "unpack": lambda: unpacking(path, check=False),
        "floor": lambda: unpacking(path),
        "raw": lambda: partial(own_raw, path),
        "imu": lambda: partial(own_raw, path, ("/imu",)),
        "mcap": lambda: partial(peer_raw, path),
        "mcap checks": lambda: partial(peer_raw, path, check=True),
        "samples": lambda: partial(own_samples, path),
        "rosbags": lambda: partial(rosbags_decoded, path),
        "window": lambda: partial(own_raw, path, ("/image",), *span),
        "window floor": lambda: unpacking(path, *span),
        "mcap window": lambda: partial(peer_raw, path, ("/image",), *span),
    }


def least(work: Work, passes: int) -> float:
    """Least CPU time, in ms."""
    best = float("inf")
    for _ in range(passes):
        begun = time.process_time()
        work()
        best = min(best, 1e3 * (time.process_time() - begun))
    return best


def least_of_all(path: Path, seconds: int, passes: int) -> dict[str, float]:
    """Least CPU time of each work in a process of its own, in ms; they take turns."""
    names = list(works(path, seconds))
    best = dict.fromkeys(names, float("inf"))
    for _ in range(ROUNDS):
        for name in names:
            given = [sys.executable, __file__, "--work", name, str(path), f"--seconds={seconds}", f"--passes={passes}"]
            said = subprocess.run(given, capture_output=True, text=True, check=True).stdout
            best[name] = min(best[name], float(said))
    return best


MEMORY = """
import sys, pathlib
sys.path.insert(0, sys.argv[2])
from benchmarks.reading import own_raw
def anonymous():
    lines = pathlib.Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("RssAnon"))
import threading, time
before, peak, over = anonymous(), 0, False
def watch():
    global peak
    while not over:
        peak = max(peak, anonymous()); time.sleep(0.002)
thread = threading.Thread(target=watch); thread.start()
own_raw(pathlib.Path(sys.argv[1])); over = True; thread.join()
print((peak - before) / 1024)
"""


def extra_mib(path: Path) -> float:
    """Peak of the anonymous memory that reading the whole log takes, in MiB."""
    root = str(Path(__file__).parents[1])
    return float(
        subprocess.run(
            [sys.executable, "-c", MEMORY, str(path), root], capture_output=True, text=True, check=True
        ).stdout
    )


class Figure(NamedTuple):
    """CPU time (ms), its ratio to the peer's, the ratio that is allowed, and the one that nothing can be below."""

    name: str
    own: float
    ratio: float
    bar: float = float("nan")
    floor: float = float("nan")


def bars(path: Path, codec: str, seconds: int, passes: int) -> list[Figure]:
    """All figures of a log."""
    found = least_of_all(path, seconds, passes)

    def figure(name: str, own: str, peer: str, bar: float = float("nan"), floor: str = "floor") -> Figure:
        return Figure(name, found[own], found[own] / found[peer], bar, found[floor] / found[peer])

    plain = codec == "none"
    rows = [
        figure("raw / mcap", "raw", "mcap", 0.10) if plain else figure("raw / decompression", "raw", "unpack", 1.35)
    ]
    rows.append(figure("raw / mcap with checksums", "raw", "mcap checks"))
    rows.append(figure("image + imu samples / rosbags", "samples", "rosbags", 0.10 if plain else 0.35))
    rows.append(figure("1 s of images / mcap", "window", "mcap window", 0.7, "window floor"))
    rows.append(figure("/imu alone / mcap all", "imu", "mcap"))
    rows.append(Figure("extra memory, MiB", extra_mib(path), float("nan"), 32.0))
    return rows


def main() -> None:
    """Print the figures of every codec."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=int, default=75)
    parser.add_argument("--passes", type=int, default=5)
    parser.add_argument("--codecs", nargs="+", default=["none", "lz4", "zstd"])
    parser.add_argument("--work", nargs=2, metavar=("NAME", "LOG"), help=argparse.SUPPRESS)  # of a process of its own
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    if options.work:
        name, log = options.work
        print(least(works(Path(log), options.seconds)[name](), options.passes))
        return
    with tempfile.TemporaryDirectory() as folder:
        for codec in options.codecs:
            path = Path(folder) / f"{codec}.mcap"
            make(path, codec, options.seconds)
            print(f"{codec}: {path.stat().st_size / 1e6:.0f} MB")
            for name, own, ratio, bar, floor in bars(path, codec, options.seconds, options.passes):
                print(f"  {name:32} {own:9.1f}  ratio {ratio:6.3f}  bar {bar:.2f}  floor {floor:.3f}")
            path.unlink()


if __name__ == "__main__":
    main()
