"""Damaged and hostile ROS 1 bags and ROS 2 databases, made when they are needed.

Every good log holds 240 messages: an IMU at 100 Hz, images at 10 Hz, odometry at 10 Hz, for 2 s.
"""

import bz2
import re
import shutil
import sqlite3
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from made_logs import MS, ROS1, ROS2, START_NS, Entry, Maker, write_ros1, write_ros2

MESSAGES = 240
TOPICS = {"/imu": 200, "/odom": 20, "/cam/image_raw": 20}


class Case(NamedTuple):
    """A damaged log: how many messages can be read of it at least (0: it is refused), and words of the report.

    `counted` where the report accounts for every message; `named` where the bytes of messages are there, and what
    they are is not.
    """

    make: Callable[[Path], Path]
    readable: int
    words: str
    counted: bool = False
    named: bool = False


def entries(store: Any) -> list[Entry]:
    make, found = Maker(store), []
    for i in range(200):
        t = START_NS + i * 10 * MS
        found.append(Entry("/imu", "sensor_msgs/msg/Imu", t, make.imu(t, float(i))))
        if i % 10 == 0:
            found.append(Entry("/odom", "nav_msgs/msg/Odometry", t + 1, make.odometry(t, float(i))))
            found.append(Entry("/cam/image_raw", "sensor_msgs/msg/Image", t + 2, make.image(t, i)))
    return found


def few_entries(store: Any) -> list[Entry]:
    """A log of a few kB."""
    return [entry for entry in entries(store) if entry.topic != "/odom"][:33]


# ----------------------------------------------------------------------------------- ROS 1


def bag(folder: Path, compression: str = "none") -> Path:
    return write_ros1(folder / "a.bag", entries(ROS1), compression, 8192)


def edited(change: Callable[[bytearray], Any], compression: str = "none") -> Callable[[Path], Path]:
    """A bag whose bytes were changed: in place, or to what `change` returns."""

    def make(folder: Path) -> Path:
        path = bag(folder, compression)
        data = bytearray(path.read_bytes())
        result = change(data)
        path.write_bytes(data if result is None else result)
        return path

    return make


def value(data: bytes, name: bytes) -> int:
    """Where the value of the first header field of that name begins."""
    return data.index(name + b"=") + len(name) + 1


def chunks(data: bytes) -> list[int]:
    """Where the chunk records begin."""
    found = []
    for mark in re.finditer(rb"\x04\0\0\0op=\x05", data):
        found += [at for at in range(mark.start() - 60, mark.start()) if _is_chunk(data, at)]
    return sorted(found)


def _is_chunk(data: bytes, at: int) -> bool:
    (length,) = struct.unpack_from("<I", data, at)
    return 30 < length < 80 and b"compression=" in data[at : at + length] and b"op=\x05" in data[at : at + 4 + length]


def chunk_data(data: bytes, at: int) -> tuple[int, int]:
    """The range of a chunk's data."""
    (length,) = struct.unpack_from("<I", data, at)
    (size,) = struct.unpack_from("<I", data, at + 4 + length)
    return at + 8 + length, at + 8 + length + size


def index_place(data: bytes) -> int:
    return int(struct.unpack_from("<Q", data, value(data, b"index_pos"))[0])


def _unindexed(data: bytearray) -> bytes:
    end = index_place(data)
    struct.pack_into("<Q", data, value(data, b"index_pos"), 0)
    return bytes(data[:end])


def _patched(form: str, name: bytes, number: int) -> Callable[[bytearray], None]:
    return lambda data: struct.pack_into(form, data, value(data, name), number)


def _cut_in_a_chunk(data: bytearray) -> bytes:
    start, stop = chunk_data(data, chunks(data)[-1])
    return bytes(data[: (start + stop) // 2])


def _zeros(data: bytearray) -> None:
    half = len(data) // 2
    data[half:] = bytes(len(data) - half)


def _flip(data: bytearray) -> None:
    start, stop = chunk_data(data, chunks(data)[3])
    data[(start + stop) // 2] ^= 0x10


def _wrong_index_lengths(data: bytearray) -> None:
    """What a real recorder did: the lengths of index records are not 12 bytes an entry."""
    for mark in re.finditer(rb"op=\x04", bytes(data)):
        header = data.rindex(b"\x04\0\0\0op=", 0, mark.end())
        for start in range(header - 60, header + 1):
            (length,) = struct.unpack_from("<I", data, start)
            if 20 < length < 80 and data[start + 4 : start + 4 + length].count(b"count=") == 1:
                at = start + 4 + length
                if struct.unpack_from("<I", data, at)[0] % 12 == 0:
                    struct.pack_into("<I", data, at, 8)
                break


def _unknown_compression(data: bytearray) -> None:
    at = data.index(b"compression=none", chunks(data)[2])
    data[at : at + 16] = b"compression=zpaq"


def _message_length(data: bytearray) -> None:
    """The second message of a chunk states 2^32 - 1 bytes."""
    start, _ = chunk_data(data, chunks(data)[2])
    first = data.index(b"op=\x02", start)
    second = data.index(b"op=\x02", first + 4)
    (length,) = struct.unpack_from("<I", data, _header_of(data, second))
    struct.pack_into("<I", data, _header_of(data, second) + 4 + length, 2**32 - 1)


def _header_of(data: bytearray, mark: int) -> int:
    for at in range(mark - 4, mark - 50, -1):
        if struct.unpack_from("<I", data, at)[0] == 38:
            return at
    raise ValueError


def _bomb(data: bytearray, claim: int = 2**26) -> bytes:
    """A chunk that is 64 MiB of zeros in bz2 and says so, put in the place of the first one."""
    at = chunks(data)[0]
    start, stop = chunk_data(data, at)
    packer = bz2.BZ2Compressor()
    packed = b"".join(packer.compress(bytes(1 << 24)) for _ in range(4)) + packer.flush()
    header = bytearray(data[at:start])
    struct.pack_into("<I", header, value(header, b"size"), claim)
    struct.pack_into("<I", header, len(header) - 4, len(packed))
    return bytes(data[:at] + header + packed + data[stop:])


def _hostile_topic(data: bytearray) -> None:
    for mark in re.finditer(rb"topic=/odom", bytes(data)):
        data[mark.start() + 6 : mark.end()] = b"/\x00\n\x1b["


def _chunk_taken_out(data: bytearray) -> bytes:
    at = chunks(data)
    return bytes(data[: at[3]] + data[at[4] :])


def _chunks_swapped(data: bytearray) -> bytes:
    at = chunks(data)
    return bytes(data[: at[3]] + data[at[4] : at[5]] + data[at[3] : at[4]] + data[at[5] :])


def _no_head(data: bytearray) -> None:
    at = chunks(data)[3]
    data[at : at + 40] = bytes(40)


def _hundred_bytes_gone(data: bytearray) -> bytes:
    start, _ = chunk_data(data, chunks(data)[3])
    return bytes(data[: start + 500] + data[start + 600 :])


def _no_kind_of_connections(data: bytearray) -> bytes:
    """Neither in the chunks nor, as there is none, in the index."""
    return _unindexed(bytearray(bytes(data).replace(b"op=\x07", b"op=\x17")))


def _no_topic(data: bytearray) -> bytes:
    return _unindexed(bytearray(bytes(data).replace(b"topic=/imu", b"tobic=/imu")))


def _stranger(data: bytearray) -> None:
    start, _ = chunk_data(data, chunks(data)[3])
    data[data.index(b"conn=\0\0\0\0", start) + 5] = 9


def _index_of_a_stranger(data: bytearray) -> bytes:
    _, stop = chunk_data(data, chunks(data)[3])
    data[data.index(b"conn=", stop) + 5] = 9
    return _unindexed(data)


def joined(folder: Path) -> Path:
    path = bag(folder)
    path.write_bytes(path.read_bytes() + b"garbage after the end" * 10)
    return path


def raw(content: bytes) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        path = folder / "a.bag"
        path.write_bytes(content)
        return path

    return make


ROS1_CASES = {
    "zero length": Case(raw(b""), 0, "0 bytes"),
    "4 bytes": Case(raw(b"#ROS"), 0, "does not begin like one"),
    "unindexed": Case(edited(_unindexed), 240, "not closed"),
    "unindexed bz2": Case(edited(_unindexed, "bz2"), 240, "not closed"),
    "cut mid-chunk": Case(edited(_cut_in_a_chunk), 225, "ends inside a chunk"),
    "cut mid-chunk lz4": Case(edited(_cut_in_a_chunk, "lz4"), 220, "ends inside a chunk"),
    "cut in the index": Case(edited(lambda data: data[: (index_place(data) + len(data)) // 2]), 240, ""),
    "index past the end": Case(edited(_patched("<Q", b"index_pos", 2**50)), 240, "no place of an index"),
    "wrong chunk_count": Case(edited(_patched("<I", b"chunk_count", 3)), 240, "states 3 chunks"),
    "header length 2^32-1": Case(
        edited(lambda data: struct.pack_into("<I", data, 13, 2**32 - 1)), 240, "bag header is damaged"
    ),
    "chunk header length 2^32-1": Case(
        edited(lambda data: struct.pack_into("<I", data, chunks(data)[2], 2**32 - 1)), 240, "no record begins"
    ),
    "lz4 bit flip": Case(edited(_flip, "lz4"), 215, ""),
    "bz2 bit flip": Case(edited(_flip, "bz2"), 215, "a bz2 chunk", counted=True),
    "second half zeros": Case(edited(_zeros), 110, "no record can be read"),
    "second half zeros bz2": Case(edited(_zeros, "bz2"), 100, ""),
    "wrong index lengths": Case(edited(_wrong_index_lengths), 240, ""),
    "unknown compression": Case(
        edited(_unknown_compression), 215, "unknown compression 'zpaq'", counted=True, named=True
    ),
    "message length 2^32-1": Case(edited(_message_length), 239, "break off", counted=True),
    "bomb": Case(edited(_bomb, "bz2"), 215, "more than the", counted=True),
    "bomb that claims little": Case(edited(lambda d: _bomb(d, 8000), "bz2"), 215, "states 8000 bytes", counted=True),
    "hostile topic": Case(edited(_hostile_topic), 240, ""),
    "chunk taken out": Case(edited(_chunk_taken_out), 218, "not where the index states", counted=True),
    "chunks swapped": Case(edited(_chunks_swapped), 240, ""),
    "chunks swapped lz4": Case(edited(_chunks_swapped, "lz4"), 240, ""),
    "chunk without a head": Case(edited(_no_head), 240, "no record begins"),
    "chunk without a head lz4": Case(edited(_no_head, "lz4"), 240, "no record begins"),
    "chunk without a head bz2": Case(edited(_no_head, "bz2"), 240, "no record begins"),
    "100 bytes gone": Case(edited(_hundred_bytes_gone), 239, "break off", counted=True),
    "damaged kind of connections": Case(edited(_no_kind_of_connections), 240, "what is left of it served"),
    "connection without a topic": Case(edited(_no_topic), 40, "a connection in a chunk is damaged", named=True),
    "message of a stranger": Case(edited(_stranger), 239, "does not describe", counted=True, named=True),
    "index of a stranger": Case(edited(_index_of_a_stranger, "lz4"), 240, "than its index states"),
    "garbage after the end": Case(joined, 240, "no record can be read"),
}


# ------------------------------------------------------------------------------------ db3


def folder_of(path: Path) -> Path:
    return write_ros2(path / "bag", entries(ROS2))


def database(path: Path) -> Path:
    return folder_of(path) / "bag.db3"


def changed(*statements: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        path = database(folder)
        with sqlite3.connect(path) as connection:
            for statement in statements:
                connection.execute(statement)
        connection.close()
        return path

    return make


def metadata(change: Callable[[str], str] | None) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        path = folder_of(folder)
        file = path / "metadata.yaml"
        if change is None:
            file.unlink()
        else:
            file.write_text(change(file.read_text()))
        return path

    return make


def write_ahead(folder: Path) -> Path:
    """Half of the rows are in the write-ahead log."""
    return _left_behind(folder, "-wal", "PRAGMA journal_mode = WAL", "PRAGMA wal_autocheckpoint = 0")


def _rewrite(file: Path, change: Callable[[bytearray], Any]) -> None:
    """Change the bytes of a file where they are, or put what `change` gives in their place."""
    data = bytearray(file.read_bytes())
    result = change(data)
    file.write_bytes(data if result is None else result)


def torn_log(change: Callable[[bytearray], Any]) -> Callable[[Path], Path]:
    """The same, with the write-ahead log damaged: SQLite leaves out what follows, without a word."""

    def make(folder: Path) -> Path:
        path = write_ahead(folder)
        _rewrite(path.with_name(path.name + "-wal"), change)
        return path

    return make


def _flip_in_the_middle(data: bytearray) -> None:
    data[len(data) // 2] ^= 4


def old_pages_in_the_log(folder: Path) -> Path:
    """A write-ahead log that was begun anew: behind its pages lie those of the use before, which count no more."""
    source, target = database(folder), folder / "live.db3"
    connection = sqlite3.connect(source, isolation_level=None)
    connection.execute("PRAGMA journal_mode = WAL")
    connection.execute("PRAGMA wal_autocheckpoint = 0")
    connection.execute("UPDATE messages SET timestamp = timestamp + 1")
    connection.execute("UPDATE messages SET timestamp = timestamp - 1")
    connection.execute("PRAGMA wal_checkpoint")
    connection.execute("UPDATE messages SET timestamp = timestamp WHERE id = 1")
    shutil.copy(source, target)
    shutil.copy(source.with_name(source.name + "-wal"), target.with_name(target.name + "-wal"))
    connection.close()
    return target


def hot_journal(folder: Path) -> Path:
    """A transaction that deletes half of the rows and was not finished; the journal undoes it."""
    source, target = database(folder), folder / "live.db3"
    connection = sqlite3.connect(source, isolation_level=None)
    connection.execute("PRAGMA cache_size = 1")
    connection.execute("PRAGMA cache_spill = 1")
    connection.execute("BEGIN")
    connection.execute("DELETE FROM messages WHERE id > 120")
    connection.execute("UPDATE messages SET data = zeroblob(5000) WHERE id < 60")
    shutil.copy(source, target)
    shutil.copy(source.with_name("bag.db3-journal"), folder / "live.db3-journal")
    connection.execute("ROLLBACK")
    connection.close()
    return target


def _left_behind(folder: Path, end: str, *pragmas: str) -> Path:
    source, target = database(folder), folder / "live.db3"
    connection = sqlite3.connect(source)
    rows = list(connection.execute("SELECT * FROM messages WHERE id > 120"))
    connection.execute("DELETE FROM messages WHERE id > 120")
    connection.commit()
    for pragma in pragmas:
        connection.execute(pragma)
    connection.executemany("INSERT INTO messages VALUES (?, ?, ?, ?)", rows)
    connection.commit()
    shutil.copy(source, target)
    shutil.copy(source.with_name(source.name + end), target.with_name(target.name + end))
    connection.close()
    return target


def pages(change: Callable[[bytearray], Any]) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        path = database(folder)
        _rewrite(path, change)
        return path

    return make


def _zero_pages(data: bytearray) -> None:
    middle = len(data) // 2 // 4096 * 4096
    data[middle : middle + 8192] = bytes(8192)


def _no_first_page(data: bytearray) -> None:
    data[100:4096] = bytes(3996)


def _false_index(data: bytearray) -> None:
    """The index of times has message 100 at another time: SQLite leaves it out of every range, without a word."""
    leaf, time = b"\x0a", struct.pack(">q", START_NS + 1000 * MS)
    for page in range(0, len(data), 4096):
        at = data.find(time, page, page + 4096)
        if data[page : page + 1] == leaf and at >= 0:
            data[at] ^= 0x40
            return
    raise ValueError


BOMB = "a: &a [x,x,x,x,x,x,x,x,x]\n" + "".join(
    f"{name}: &{name} [{','.join(['*' + before] * 9)}]\n" for before, name in zip("abcdefgh", "bcdefghi", strict=True)
)

DB3_CASES = {
    "zero length": Case(lambda folder: raw(b"")(folder).rename(folder / "a.db3"), 0, "0 bytes"),
    "half in the write-ahead log": Case(write_ahead, 240, ""),
    "torn write-ahead log": Case(torn_log(_flip_in_the_middle), 120, "not completed or are damaged", named=True),
    "cut write-ahead log": Case(
        torn_log(lambda data: data[: len(data) // 2]), 120, "not completed or are damaged", named=True
    ),
    "garbage as write-ahead log": Case(torn_log(lambda data: b"garbage" * 999), 120, "cannot be merged", named=True),
    "old pages in the write-ahead log": Case(old_pages_in_the_log, 240, "copied and merged"),
    "hot journal": Case(hot_journal, 240, ""),
    "8 kB of zeros": Case(pages(_zero_pages), 215, "known to be lost", counted=True),
    "false index of times": Case(pages(_false_index), 240, "the index of times differs"),
    "first page zeros": Case(pages(_no_first_page), 240, "could be read"),
    "cut at 50 %": Case(pages(lambda data: data[: len(data) // 2]), 80, "known to be lost"),
    "no data and text time": Case(
        changed(
            "CREATE TABLE m (id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL, data BLOB)",
            "INSERT INTO m SELECT * FROM messages",
            "DROP TABLE messages",
            "ALTER TABLE m RENAME TO messages",
            "UPDATE messages SET timestamp = 'noon' WHERE id = 5",
            "UPDATE messages SET data = NULL WHERE id = 6",
        ),
        238,
        "1 messages have no number as time",
    ),
    "no metadata": Case(metadata(None), 240, ""),
    "wrong counts": Case(
        metadata(lambda text: re.sub(r"message_count: 200", "message_count: 2000", text)), 240, "states 2000 messages"
    ),
    "path outside": Case(
        metadata(lambda text: text.replace("- bag.db3", "- ../../etc/passwd\n  - ../x/bag.db3")), 240, ""
    ),
    "YAML bomb": Case(metadata(lambda text: BOMB + text), 240, ""),
    "YAML tag of Python": Case(metadata(lambda text: '!!python/object/apply:os.system ["touch x"]'), 240, ""),
    "topic without a name": Case(
        changed("DELETE FROM topics WHERE name = '/odom'"), 220, "topics that the database", named=True
    ),
}
