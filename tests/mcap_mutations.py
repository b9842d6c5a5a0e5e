"""MCAP files cut and flipped at every byte: what no reader may do with them.

``python tests/mcap_mutations.py`` runs every cut and every flip of a log per codec, and prints the figures.
"""

import tempfile
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from mcap.writer import CompressionType, IndexType, Writer

from readers.mcap_log import McapLog
from readers.message_log import in_log_order
from readers.streams import WorkbenchError

Key = tuple[str, int, bytes]
CODECS = ("none", "lz4", "zstd")


class Small(NamedTuple):
    """A log of three chunks and its messages."""

    data: bytes
    keys: list[Key]


def small_log(path: Path, codec: str, *, index: bool = True) -> Small:
    rng, keys = np.random.default_rng(1), []
    flags = dict.fromkeys(("repeat_channels", "repeat_schemas", "use_statistics", "use_summary_offsets"), index)
    kinds = IndexType.ALL if index else IndexType.NONE
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=1000, compression=CompressionType[codec.upper()], index_types=kinds, **flags)
        writer.start(profile="ros2", library="test")
        number = writer.register_schema("my_msgs/msg/Own", "ros2msg", b"uint8[] data")
        channels = [writer.register_channel(topic, "cdr", number) for topic in ("/a", "/b")]
        for i in range(30):
            data = rng.integers(0, 16, 64, dtype=np.uint8).tobytes()
            writer.add_message(channels[i % 2], 1000 + i, data, 1000 + i, i)
            keys.append(("/a" if i % 2 == 0 else "/b", 1000 + i, data))
        writer.finish()
    return Small(path.read_bytes(), keys)


def judged(path: Path, small: Small, data: bytes, *, torn: bool = False) -> str:
    """What became of one changed file; "" if that is as it should be."""
    path.write_bytes(data)
    try:
        log = McapLog(path)
        found = [(m.channel.topic, m.log_ns, bytes(m.data)) for m in in_log_order(log.sources(log.channels))]
        losses = list(log.losses)
        log.close()
    except WorkbenchError:
        return "refused"
    except Exception as error:
        return f"raised {type(error).__name__}: {error}"
    if not set(found) <= set(small.keys):
        return "WRONG DATA"
    if Counter(found) != Counter(small.keys) and not losses:
        return "SILENT LOSS"
    if torn and not losses:
        return "UNREPORTED CUT"
    return "" if len(found) == len(small.keys) else "reported loss"


def cuts(small: Small, step: int = 1, start: int = 8) -> Iterator[bytes]:
    for size in range(start, len(small.data), step):
        yield small.data[:size]


def flips(small: Small, step: int = 1, start: int = 8) -> Iterator[bytes]:
    """One bit of every `step`-th byte, another one each time."""
    for place in range(start, len(small.data), step):
        changed = bytearray(small.data)
        changed[place] ^= 1 << (place * 5 + place // 8) % 8
        yield bytes(changed)


def outcomes(path: Path, small: Small, files: Iterable[bytes], *, torn: bool = False) -> Counter[str]:
    return Counter(judged(path, small, data, torn=torn) for data in files)


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.mcap"
        for codec in CODECS:
            small = small_log(path, codec)
            for name, files in (("cuts", cuts(small)), ("flips", flips(small))):
                begun = time.monotonic()
                found = outcomes(path, small, files, torn=name == "cuts")
                print(f"{codec:5} {name:5} {found.total():6} files in {time.monotonic() - begun:5.1f} s: {dict(found)}")


if __name__ == "__main__":
    main()
