"""Every kind of damaged and hostile MCAP file: what is read, what is said, at what cost."""

import resource
import struct
import time
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import lz4.frame
import numpy as np
import pytest
import zstandard
from made_mcap import (
    CHANNEL,
    CHUNK,
    DATA_END,
    FOOTER,
    HEADER,
    MAGIC,
    MESSAGE,
    MESSAGE_INDEX,
    METADATA_INDEX,
    SCHEMA,
    SUMMARY_OFFSET,
    Entry,
    channel,
    chunk,
    message,
    message_index,
    record,
    schema,
    string,
)
from mcap.writer import CompressionType, IndexType, Writer

from readers import RecordingError, open_recording
from readers.mcap_log import McapLog
from readers.message_log import in_log_order
from readers.salvage import Cause, tallies

COUNT, START_NS, STEP_NS = 240, 1_700_000_000_000_000_000, 10_000_000
CODECS = ["none", "lz4", "zstd"]
MEMORY_BYTES = 400 << 20
Key = tuple[str, int, bytes]


class Log(NamedTuple):
    """A sound file, its messages, and where its chunks lie: (offset, length, messages)."""

    data: bytes
    keys: list[Key]
    chunks: list[tuple[int, int, int]]


def made(path: Path, codec: str = "zstd", *, index: bool = True, chunked: bool = True) -> Log:
    """240 messages of two topics in about ten chunks."""
    rng, keys = np.random.default_rng(5), []
    with path.open("wb") as file:
        kinds = IndexType.ALL if index else IndexType.NONE
        flags = dict.fromkeys(("repeat_channels", "repeat_schemas", "use_statistics", "use_summary_offsets"), index)
        writer = Writer(
            file,
            chunk_size=5400,
            compression=CompressionType[codec.upper()],
            index_types=kinds,
            use_chunking=chunked,
            **flags,
        )
        writer.start(profile="ros2", library="test")
        number = writer.register_schema("my_msgs/msg/Own", "ros2msg", b"uint8[] data")
        channels = [writer.register_channel(topic, "cdr", number) for topic in ("/a", "/b")]
        for i in range(COUNT):
            data = rng.integers(0, 64, 200, dtype=np.uint8).tobytes()
            log_ns = START_NS + i * STEP_NS
            writer.add_message(channels[i % 2], log_ns, data, log_ns - 5, i)
            keys.append(("/a" if i % 2 == 0 else "/b", log_ns, data))
        writer.finish()
    data = path.read_bytes()
    with open_log(path) as log:
        blocks = sorted(log._blocks, key=lambda block: block.offset) if chunked else []
        chunks = [(block.offset, block.size, sum(block.counts.values())) for block in blocks]
    return Log(data, keys, chunks)


@contextmanager
def open_log(path: Path) -> Iterator[McapLog]:
    log = McapLog(path)
    try:
        yield log
    finally:
        log.close()


@contextmanager
def bounded() -> Iterator[None]:
    """No more than 400 MiB of address space on top of what the tests have already, and 5 s."""
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY_BYTES, hard))
    begun = time.monotonic()
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
    assert time.monotonic() - begun < 5.0


def read(path: Path) -> tuple[list[Key], McapLog]:
    """All messages of a file, within bounds."""
    with bounded(), open_log(path) as log:
        found = [(m.channel.topic, m.log_ns, bytes(m.data)) for m in in_log_order(log.sources(log.channels))]
        return found, log


class Case(NamedTuple):
    """What must come of a damaged file: the fewest messages, and the causes that are named with words of the text."""

    data: bytes
    messages: int
    cause: Cause | None
    words: str


def index_of_half(log: Log) -> tuple[int, int]:
    """Where a chunk in the middle begins, and how many messages lie before it."""
    half = len(log.chunks) // 2
    return log.chunks[half][0], sum(count for _, _, count in log.chunks[:half])


def patched(log: Log, number: int, at: int, new: bytes) -> bytes:
    place = log.chunks[number][0] + at
    return log.data[:place] + new + log.data[place + len(new) :]


def cut_in_chunk(log: Log) -> Case:
    at, before = index_of_half(log)
    return Case(log.data[: at + log.chunks[len(log.chunks) // 2][1] // 2], before, Cause.CUT, "ends inside a chunk")


def cut_at_chunk(log: Log) -> Case:
    at, before = index_of_half(log)
    return Case(log.data[:at], before, Cause.CUT, "not closed")


def last_byte(log: Log) -> Case:
    return Case(log.data[:-1], COUNT, Cause.CUT, "footer")


def zeros(log: Log) -> Case:
    at, before = index_of_half(log)
    return Case(log.data[:at] + bytes(len(log.data) - at), before, Cause.CUT, "passed over")


def crc_wrong(log: Log) -> Case:
    return Case(patched(log, 3, 9 + 24, b"abcd"), COUNT - log.chunks[3][2], Cause.CHECKSUM, "left out")


def bit_flip(log: Log) -> Case:
    offset, size, count = log.chunks[3]
    place = offset + size // 2
    data = log.data[:place] + bytes([log.data[place] ^ 8]) + log.data[place + 1 :]
    return Case(data, COUNT - count, None, "chunk")


def two_bit_flips_without_index(log: Log) -> Case:
    case = bit_flip(log)
    return Case(case.data[:-1], case.messages, None, "chunk")


def record_length(log: Log) -> Case:
    return Case(patched(log, 3, 1, struct.pack("<Q", 2**62)), COUNT, None, "")


def record_length_no_index(log: Log) -> Case:
    return Case(patched(log, 3, 1, struct.pack("<Q", 2**62))[:-8], COUNT, Cause.LIMIT, "the chunk's own")


def declared(log: Log) -> Case:
    return Case(patched(log, 3, 9 + 16, struct.pack("<Q", 2**40)), COUNT, Cause.LIMIT, f"claims {2**40} bytes")


def summary_past_end(log: Log) -> Case:
    return Case(log.data[:-28] + struct.pack("<Q", 2**50) + log.data[-20:], COUNT, Cause.CUT, "no place of the file")


def summary_inside_data(log: Log) -> Case:
    return Case(log.data[:-28] + struct.pack("<Q", 100) + log.data[-20:], COUNT, Cause.CUT, "index")


def garbage_after(log: Log) -> Case:
    return Case(log.data + b"no more of a log than this", COUNT, Cause.CUT, "26 bytes follow")


def joined(log: Log) -> Case:
    return Case(log.data + log.data, 2 * COUNT, Cause.ORDER, "another log begins")


DAMAGES = [
    cut_in_chunk,
    cut_at_chunk,
    last_byte,
    zeros,
    crc_wrong,
    bit_flip,
    two_bit_flips_without_index,
    record_length,
    record_length_no_index,
    declared,
    summary_past_end,
    summary_inside_data,
    garbage_after,
    joined,
]


@pytest.mark.parametrize("codec", CODECS)
@pytest.mark.parametrize("damage", DAMAGES, ids=lambda damage: damage.__name__)
def test_damage_costs_only_itself_and_is_said(tmp_path: Path, codec: str, damage: Callable[[Log], Case]) -> None:
    path = tmp_path / "a.mcap"
    log = made(path, codec)
    case = damage(log)
    path.write_bytes(case.data)
    found, opened = read(path)
    assert set(found) <= set(log.keys)
    assert len(found) >= case.messages
    assert len(set(found)) == len(found) or damage is joined
    if case.words:
        losses = [loss for loss in opened.losses if case.words in loss.text]
        assert losses, opened.losses
        assert case.cause is None or {loss.what for loss in losses} == {case.cause}
        assert all(loss.file_bytes == len(case.data) for loss in losses)


def test_a_withheld_chunk_is_counted_by_topic_with_its_times(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    log = made(path)
    for data in (bit_flip(log).data, bit_flip(log).data[:-1]):
        path.write_bytes(data)
        found, opened = read(path)
        recovered = {topic: sum(key[0] == topic for key in found) for topic in ("/a", "/b")}
        total = tallies(recovered, opened.losses)
        assert {topic: tally.recovered + tally.withheld for topic, tally in total.items()} == {"/a": 120, "/b": 120}
        (loss,) = [loss for loss in opened.losses if loss.topics]
        before = sum(count for _, _, count in log.chunks[:3])
        assert loss.first_ns == START_NS + before * STEP_NS
        assert loss.last_ns == START_NS + (before + log.chunks[3][2] - 1) * STEP_NS
        assert (loss.start, loss.stop) == (log.chunks[3][0], log.chunks[3][0] + log.chunks[3][1])


@pytest.mark.parametrize("codec", CODECS)
@pytest.mark.parametrize("chunked", [True, False])
def test_without_a_summary_all_is_read(tmp_path: Path, codec: str, chunked: bool) -> None:
    path = tmp_path / "a.mcap"
    log = made(path, codec, index=False, chunked=chunked)
    found, opened = read(path)
    assert (found, opened.losses) == (log.keys, [])


@pytest.mark.parametrize(("content", "words"), [(b"", r"empty \(0 bytes\)"), (MAGIC[:4], "4 bytes|begins with 89 4d")])
def test_a_file_of_no_bytes_is_named(tmp_path: Path, content: bytes, words: str) -> None:
    path = tmp_path / "none.mcap"
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=words) as error:
        open_recording(path)
    assert "none.mcap" in str(error.value)


# --------------------------------------------------------------- files that no writer writes

HEAD = MAGIC + record(HEADER, string("ros2") + string(""))
ENTRIES = [Entry(1, i, START_NS + i, START_NS + i, bytes([i])) for i in range(24)]
DESCRIBED = record(SCHEMA, schema(1, "my_msgs/msg/Own", "ros2msg", b"uint8 data")) + record(
    CHANNEL, channel(1, 1, "/a", "cdr", {})
)
RECORDS = b"".join(record(MESSAGE, message(entry)) for entry in ENTRIES)
END = record(DATA_END, bytes(4)) + record(2, bytes(20)) + MAGIC


def hostile(tmp_path: Path, *parts: bytes) -> tuple[list[Key], McapLog]:
    path = tmp_path / "a.mcap"
    path.write_bytes(HEAD + b"".join(parts) + END)
    return read(path)


def good_chunk(records: bytes = RECORDS) -> bytes:
    return record(CHUNK, chunk(records, (START_NS, START_NS + 23), "zstd", zstandard.compress(records)))


def test_an_unknown_compression_is_named(tmp_path: Path) -> None:
    bad = record(CHUNK, chunk(RECORDS, (0, 1), "zopfli", b"whatever"))
    found, log = hostile(tmp_path, DESCRIBED, good_chunk(), bad, good_chunk())
    assert len(found) == 48
    assert [(loss.what, loss.text) for loss in log.losses] == [
        (Cause.CODEC, "a chunk has the unknown compression 'zopfli'")
    ]


def test_a_zstd_bomb_is_not_unpacked(tmp_path: Path) -> None:
    packer = zstandard.ZstdCompressor(level=1).compressobj()
    packed = b"".join(packer.compress(bytes(1 << 24)) for _ in range(128)) + packer.flush()
    for claim in (1 << 31, 1 << 20):
        body = struct.pack("<QQQI", 0, 1, claim, 0) + string("zstd") + struct.pack("<Q", len(packed)) + packed
        found, log = hostile(tmp_path, DESCRIBED, good_chunk(), record(CHUNK, body), good_chunk())
        assert len(found) == 48
        assert ["unpacked at once" in loss.text for loss in log.losses] == [True]


@pytest.mark.parametrize("codec", ["zstd", "lz4"])
def test_a_claim_of_any_size_costs_no_memory(tmp_path: Path, codec: str) -> None:
    """A frame that does not state its size, in a chunk that claims 2^40 or 2^62 bytes."""
    packed = {
        "zstd": zstandard.ZstdCompressor(write_content_size=False).compress(RECORDS),
        "lz4": lz4.frame.compress(RECORDS, store_size=False),
    }[codec]
    for claim in (2**40, 2**62):
        body = struct.pack("<QQQI", 0, 1, claim, zlib.crc32(RECORDS)) + string(codec)
        bad = record(CHUNK, body + struct.pack("<Q", len(packed)) + packed)
        found, log = hostile(tmp_path, DESCRIBED, good_chunk(), bad)
        assert len(found) == 48
        assert [loss.what for loss in log.losses] == [Cause.LIMIT]


def test_a_chunk_in_a_chunk_is_refused(tmp_path: Path) -> None:
    found, log = hostile(tmp_path, DESCRIBED, good_chunk(RECORDS + good_chunk() + RECORDS))
    assert len(found) == 48
    assert ["inside of a chunk" in loss.text for loss in log.losses] == [True]


def test_messages_without_a_channel_or_schema_are_said(tmp_path: Path) -> None:
    found, log = hostile(tmp_path, good_chunk())
    assert found == []
    assert [loss.text for loss in log.losses] == ["24 messages are of channels that the file does not describe"]
    found, log = hostile(tmp_path, record(CHANNEL, channel(1, 7, "/a", "cdr", {})), good_chunk())
    assert (len(found), log.channels[0].type) == (24, "")
    assert [loss.what for loss in log.losses] == [Cause.SCHEMA]
    assert "schema 7" in log.losses[0].text


def test_times_at_the_ends_of_their_range_are_kept(tmp_path: Path) -> None:
    times = [0, 2**63, 2**64 - 1, START_NS, START_NS - 3_600_000_000_000]
    records = b"".join(record(MESSAGE, message(Entry(1, 0, t, t, b""))) for t in times)
    found, log = hostile(tmp_path, DESCRIBED, good_chunk(records), records)
    assert [key[1] for key in found] == sorted(times + times)
    assert log.losses == []
    with open_recording(tmp_path / "a.mcap") as recording:
        assert recording.stream("/a").count == 10


@pytest.mark.parametrize(
    "topic",
    [b"../../etc/x", b"/a\x00\n\x1b[31m<script>", b"/\xff\xfe", b"/" + b"x" * 1_000_000],
    ids=["path", "control", "bytes", "long"],
)
def test_hostile_names_are_data(tmp_path: Path, topic: bytes) -> None:
    found, log = hostile(tmp_path, record(CHANNEL, channel(1, 0, topic, "cdr", {})), good_chunk())
    (name,) = {key[0] for key in found}
    assert len(found) == 24
    assert name.isprintable()
    assert len(name) >= len(topic)
    assert log.losses == []


def test_statistics_that_lie_are_compared(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    log = made(path, "none")
    at = log.data.rindex(struct.pack("<Q", COUNT) + struct.pack("<HI", 1, 2))
    counts = log.data.index(struct.pack("<HQ", 1, 120), at)
    data = bytearray(log.data)
    data[at : at + 8] = struct.pack("<Q", 2400)
    data[counts + 2 : counts + 10] = struct.pack("<Q", 2280)
    data[-12:-8] = bytes(4)
    path.write_bytes(data)
    found, opened = read(path)
    assert found == log.keys
    assert [loss.what for loss in opened.losses] == [Cause.COUNT]
    assert "claims 2400 messages and 240" in opened.losses[0].text


def test_the_data_checksum_guards_messages_that_have_no_other(tmp_path: Path) -> None:
    body = HEAD + DESCRIBED + RECORDS
    end = record(DATA_END, struct.pack("<I", zlib.crc32(body))) + record(2, bytes(20)) + MAGIC
    path = tmp_path / "a.mcap"
    path.write_bytes(body + end)
    assert read(path)[1].losses == []
    path.write_bytes(body[:-1] + b"\xff" + end)
    found, log = read(path)
    assert len(found) == 24
    assert [loss.what for loss in log.losses] == [Cause.CHECKSUM]
    assert "24 messages have no other" in log.losses[0].text


# ------------------------------------------------------------ what checksums prove, and what statistics tell


def dead_head(log: Log) -> bytes:
    """The first bytes of a chunk record are zeros."""
    return patched(log, 3, 0, bytes(60))


@pytest.mark.parametrize("codec", CODECS)
def test_a_chunk_that_its_checksum_proves_is_read_whatever_follows_it(tmp_path: Path, codec: str) -> None:
    path = tmp_path / "a.mcap"
    log = made(path, codec, index=False)
    path.write_bytes(dead_head(log))
    found, opened = read(path)
    assert Counter(log.keys) - Counter(found) == Counter(log.keys[sum(c[2] for c in log.chunks[:3]) :][:24])
    assert opened.losses


@pytest.mark.parametrize("codec", CODECS)
@pytest.mark.parametrize("bit", range(8))
def test_a_chunk_whose_kind_is_damaged_is_read_by_its_checksum(tmp_path: Path, codec: str, bit: int) -> None:
    path = tmp_path / "a.mcap"
    log = made(path, codec, index=False)
    path.write_bytes(patched(log, 3, 0, bytes([CHUNK ^ 1 << bit])))
    found, opened = read(path)
    assert found == log.keys
    assert [loss.text for loss in opened.losses] == [
        "the head of a chunk record is damaged; the chunk's checksum served"
    ]
    damaged = bytearray(patched(log, 3, 0, bytes([CHUNK ^ 1 << bit])))
    damaged[log.chunks[3][0] + 300] ^= 1
    path.write_bytes(damaged)
    found, opened = read(path)
    assert set(found) < set(log.keys)
    assert opened.losses


def test_a_damaged_chunk_does_not_swallow_the_sound_one_that_it_reaches_into(tmp_path: Path) -> None:
    first, second = (
        bytearray(record(CHUNK, chunk(b"".join(records), (START_NS, START_NS + 23))))
        for records in (
            [record(MESSAGE, message(entry)) for entry in ENTRIES[:12]],
            [record(MESSAGE, message(entry)) for entry in ENTRIES[12:]],
        )
    )
    head = len(record(CHUNK, chunk(b"", (0, 0))))
    for at in (1, head - 8):  # both lengths reach up to the first message in the second chunk
        struct.pack_into("<Q", first, at, struct.unpack_from("<Q", first, at)[0] + head)
    found, log = hostile(tmp_path, DESCRIBED, bytes(first), bytes(second))
    assert [key[1] for key in found] == [START_NS + i for i in range(12, 24)]
    (loss,) = log.losses
    assert (loss.what, loss.stop - loss.start) == (Cause.CHECKSUM, len(first))


@pytest.mark.parametrize("kind", [HEADER, METADATA_INDEX, 0x80 | MESSAGE])
def test_a_message_that_turned_into_another_record_is_said(tmp_path: Path, kind: int) -> None:
    path = tmp_path / "a.mcap"
    log = made(path, index=False, chunked=False)
    data = bytearray(log.data)
    data[log.data.index(log.keys[7][2]) - 31] = kind
    path.write_bytes(data)
    found, opened = read(path)
    assert found == log.keys[:7] + log.keys[8:]
    assert any(loss.stop > loss.start for loss in opened.losses)


def test_the_last_message_is_read_though_the_record_behind_it_is_damaged(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    log = made(path, index=False, chunked=False)
    data = bytearray(log.data)
    data[log.data.rindex(log.keys[-1][2]) + 200] = SUMMARY_OFFSET
    path.write_bytes(data)
    found, opened = read(path)
    assert found == log.keys
    assert opened.losses


def test_the_statistics_of_a_summary_that_was_moved_count_what_is_gone(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    log = made(path)
    at, size, count = log.chunks[3]
    path.write_bytes(log.data[:at] + log.data[at + size :])
    found, opened = read(path)
    assert len(found) == COUNT - count
    total = tallies({topic: sum(key[0] == topic for key in found) for topic in ("/a", "/b")}, opened.losses)
    assert {topic: (tally.recovered, tally.lost) for topic, tally in total.items()} == {
        "/a": (108, 12),
        "/b": (108, 12),
    }
    flipped = bytearray(log.data[:at] + log.data[at + size :])
    flipped[flipped.rindex(struct.pack("<QH", COUNT, 1)) + 4] ^= 1  # statistics that nothing proves
    path.write_bytes(flipped)
    assert not any(loss.topics for loss in read(path)[1].losses)


@pytest.mark.parametrize("wanted", [("/a",), ("/a", "/b"), ("/b", "/a")])
def test_a_chunk_that_is_gone_is_counted_by_topic_however_it_is_read(tmp_path: Path, wanted: tuple[str, ...]) -> None:
    path = tmp_path / "a.mcap"
    log = made(path)
    path.write_bytes(dead_head(log))
    with open_log(path) as opened:
        for topic in wanted:
            list(in_log_order(opened.sources([channel for channel in opened.channels if channel.topic == topic])))
        (loss,) = opened.losses
        assert {topic: tally.lost for topic, tally in loss.topics.items()} == {"/a": 12, "/b": 12}
        assert (loss.start, loss.stop) == (log.chunks[3][0], log.chunks[3][0] + log.chunks[3][1])


def test_channels_that_share_a_topic_are_counted_together(tmp_path: Path) -> None:
    second = record(CHANNEL, channel(2, 1, "/a", "json", {}))
    records = RECORDS + b"".join(record(MESSAGE, message(entry._replace(channel=2))) for entry in ENTRIES[:5])
    damaged = bytearray(good_chunk(records))
    damaged[-3] ^= 4
    indexes = [record(MESSAGE_INDEX, message_index(n, [(START_NS, 0)] * count)) for n, count in ((1, 24), (2, 5))]
    _, log = hostile(tmp_path, DESCRIBED, second, bytes(damaged), *indexes, good_chunk())
    assert {topic: tally.withheld for loss in log.losses for topic, tally in loss.topics.items()} == {"/a": 29}


def test_a_file_of_many_false_chunk_heads_takes_no_long_time(tmp_path: Path) -> None:
    head = record(CHUNK, struct.pack("<QQQI", 0, 0, 1 << 20, 1) + string("") + struct.pack("<Q", 1 << 20))
    path = tmp_path / "a.mcap"
    path.write_bytes(HEAD + head * 40_000 + bytes(1 << 20))
    _, log = read(path)
    assert log.losses


@pytest.mark.parametrize("index", [True, False])
def test_a_chunk_whose_checksum_is_gone_is_said_to_be_unproven(tmp_path: Path, index: bool) -> None:
    path = tmp_path / "a.mcap"
    log = made(path, "none", index=index)
    for number in (0, 3):
        path.write_bytes(patched(log, number, 9 + 24, bytes(4)))
        found, opened = read(path)
        assert found == log.keys
        (loss,) = opened.losses
        assert (loss.what, loss.start) == (Cause.CHECKSUM, log.chunks[number][0])
        assert f"its {log.chunks[number][2]} messages are read without a checksum" in loss.text
    bare = log.data
    for offset, _, _ in log.chunks:
        bare = bare[: offset + 33] + bytes(4) + bare[offset + 37 :]
    path.write_bytes(bare)
    assert read(path)[1].losses == []


def test_a_chunk_that_seems_to_be_empty_is_said_to_hold_more(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    log = made(path, index=False)
    path.write_bytes(patched(log, 3, 25, bytes(60)))
    found, opened = read(path)
    assert set(found) < set(log.keys)
    offset, size, _ = log.chunks[3]
    assert (Cause.CUT, offset + size) in {(loss.what, loss.stop) for loss in opened.losses}


@pytest.mark.parametrize(("more", "by_index"), [(0, True), (1, True), (16, False)])
def test_the_length_of_the_message_indexes_is_not_trusted(tmp_path: Path, more: int, by_index: bool) -> None:
    """One that cannot be is passed over for the indexes themselves; one that could be is seen by the statistics."""
    path = tmp_path / "a.mcap"
    log = made(path)
    summary = int.from_bytes(log.data[-28:-20], "little")
    at = log.data.index(struct.pack("<Q", log.chunks[3][0]), summary) + 16  # its offset, its length, its index offsets
    (offsets_bytes,) = struct.unpack_from("<I", log.data, at)
    at += 4 + offsets_bytes
    (size,) = struct.unpack_from("<Q", log.data, at)
    data = log.data[:at] + struct.pack("<Q", size + more) + log.data[at + 8 : -12] + bytes(4) + log.data[-8:]
    path.write_bytes(data)
    found, opened = read(path)
    assert sorted(found) == sorted(log.keys)
    assert (not opened.notes) == by_index


def test_messages_that_nothing_proves_are_said_to_be_unproven(tmp_path: Path) -> None:
    """A cut file whose first chunk lost its head looks like messages outside of chunks."""
    path = tmp_path / "a.mcap"
    log = made(path, "none")
    start, length, _ = log.chunks[0]
    damaged = bytearray(log.data[: start + length // 2])
    damaged[start : start + 40] = bytes(40)
    path.write_bytes(damaged)
    found, opened = read(path)
    assert found
    assert any("without a checksum" in loss.text for loss in opened.losses)


@pytest.mark.parametrize("codec", CODECS)
def test_channels_that_only_the_summary_describes_any_more_serve(tmp_path: Path, codec: str) -> None:
    path = tmp_path / "a.mcap"
    log = made(path, codec)
    first = log.chunks[0]
    damaged = bytearray(log.data[:-1])  # without an end, so that the summary is no index
    damaged[first[0] + first[1] // 2] ^= 8
    path.write_bytes(damaged)
    found, opened = read(path)
    assert found == log.keys[first[2] :]
    assert not any("does not describe" in loss.text for loss in opened.losses)


def test_a_log_goes_on_behind_a_footer_in_its_middle(tmp_path: Path) -> None:
    found, log = hostile(tmp_path, DESCRIBED, good_chunk(), record(FOOTER, bytes(20)), good_chunk())
    assert len(found) == 48
    assert [loss.text for loss in log.losses] == ["the log goes on behind its footer"]
