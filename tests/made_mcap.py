"""MCAP files built record by record: the variants of the format's conformance tests, and hostile files."""

import struct
import zlib
from collections.abc import Iterable, Iterator
from itertools import product
from typing import NamedTuple

MAGIC = b"\x89MCAP0\r\n"
PADDING = b"\x01\xff\xff"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = range(1, 9)
ATTACHMENT, ATTACHMENT_INDEX, STATISTICS, METADATA, METADATA_INDEX, SUMMARY_OFFSET, DATA_END = range(9, 16)
NEVER_PADDED = (FOOTER, MESSAGE, CHUNK, DATA_END)


class Entry(NamedTuple):
    """A message: number of its channel and its own, log and publish time, data."""

    channel: int
    sequence: int
    log_ns: int
    publish_ns: int
    data: bytes


def string(value: str | bytes) -> bytes:
    raw = value.encode() if isinstance(value, str) else value
    return struct.pack("<I", len(raw)) + raw


def strings(pairs: dict[str, str]) -> bytes:
    return string(b"".join(string(key) + string(value) for key, value in pairs.items()))


def record(opcode: int, body: bytes, *, pad: bool = False) -> bytes:
    body += PADDING if pad and opcode not in NEVER_PADDED else b""
    return struct.pack("<BQ", opcode, len(body)) + body


def schema(number: int, name: str, encoding: str, data: bytes) -> bytes:
    return struct.pack("<H", number) + string(name) + string(encoding) + string(data)


def channel(number: int, schema_number: int, topic: str | bytes, encoding: str, metadata: dict[str, str]) -> bytes:
    return struct.pack("<HH", number, schema_number) + string(topic) + string(encoding) + strings(metadata)


def message(entry: Entry) -> bytes:
    return struct.pack("<HIQQ", entry.channel, entry.sequence, entry.log_ns, entry.publish_ns) + entry.data


def chunk(records: bytes, times: tuple[int, int], compression: str = "", packed: bytes | None = None) -> bytes:
    packed = records if packed is None else packed
    head = struct.pack("<QQQI", *times, len(records), zlib.crc32(records))
    return head + string(compression) + struct.pack("<Q", len(packed)) + packed


def message_index(number: int, entries: Iterable[tuple[int, int]]) -> bytes:
    return struct.pack("<H", number) + string(b"".join(struct.pack("<QQ", *pair) for pair in entries))


# ---------------------------------------------------------------------------- conformance

_SCHEMA = schema(1, "Example", "c", bytes([4, 5, 6]))
_CHANNEL = channel(1, 1, "example", "a", {"foo": "bar"})
_ONE = Entry(1, 10, 2, 1, bytes([1, 2, 3]))
INPUTS: dict[str, list[tuple[int, bytes | Entry]]] = {
    "NoData": [],
    "OneSchemalessMessage": [(CHANNEL, channel(1, 0, "example", "text", {})), (MESSAGE, _ONE)],
    "OneMessage": [(SCHEMA, _SCHEMA), (CHANNEL, _CHANNEL), (MESSAGE, _ONE)],
    "OneAttachment": [(ATTACHMENT, b"myFile")],
    "OneMetadata": [(METADATA, b"myMetadata")],
    "TenMessages": [
        (SCHEMA, _SCHEMA),
        (CHANNEL, _CHANNEL),
        *((MESSAGE, Entry(1, i, t, t, bytes([1, 2, 3]))) for i, t in enumerate([0, 2, 1, 3, 3, 5, 4, 7, 8, 9])),
    ],
}
FEATURES = ("ch", "mx", "st", "rsh", "rch", "ax", "mdx", "chx", "sum", "pad")
_NEEDS = {"ax": ATTACHMENT, "mdx": METADATA, "rsh": SCHEMA, "rch": CHANNEL}


def variants() -> Iterator[tuple[str, frozenset[str]]]:
    """Each input with each combination of features that makes sense for it."""
    for name, records in INPUTS.items():
        kinds = {kind for kind, _ in records}
        for chosen in product((False, True), repeat=len(FEATURES)):
            features = frozenset(f for f, on in zip(FEATURES, chosen, strict=True) if on)
            if any(feature in features and kind not in kinds for feature, kind in _NEEDS.items()):
                continue
            if features & {"ch", "chx", "mx"} and not kinds & {SCHEMA, CHANNEL, MESSAGE}:
                continue
            if features & {"chx", "mx"} and "ch" not in features:
                continue
            if "sum" in features and not features & {"chx", "rsh", "rch", "mdx", "ax", "st"}:
                continue
            yield name, features


def conformance_file(name: str, features: frozenset[str]) -> bytes:
    """One variant, byte for byte as the format's own generator writes it."""
    pad, records = "pad" in features, INPUTS[name]
    out = MAGIC + record(HEADER, string("") + string(""), pad=pad)
    inside, offsets, indexed = b"", [], {"ax": b"", "mdx": b"", "chx": b""}
    entries = [entry for _, entry in records if isinstance(entry, Entry)]
    for kind, body in records:
        if isinstance(body, Entry):
            piece = record(MESSAGE, message(body))
            offsets.append((body.log_ns, len(inside)))
        elif kind == ATTACHMENT:
            data = struct.pack("<QQ", 2, 1) + string(body) + string("application/octet-stream")
            data += struct.pack("<Q", 3) + bytes([1, 2, 3])
            piece = record(kind, data + struct.pack("<I", zlib.crc32(data)), pad=pad)
            index = struct.pack("<QQQQQ", len(out), len(piece), 2, 1, 3)
            index += string(body) + string("application/octet-stream")
            indexed["ax"] = record(ATTACHMENT_INDEX, index, pad=pad)
        elif kind == METADATA:
            piece = record(kind, string(body) + strings({"foo": "bar"}), pad=pad)
            index = struct.pack("<QQ", len(out), len(piece)) + string(body)
            indexed["mdx"] = record(METADATA_INDEX, index, pad=pad)
        else:
            piece = record(kind, body, pad=pad and "ch" not in features)
        inside, out = (inside + piece, out) if "ch" in features else (inside, out + piece)
    times = [entry.log_ns for entry in entries] or [0]
    if "ch" in features:
        start = len(out)
        out += record(CHUNK, chunk(inside, (min(times), max(times))))
        length, index_start, places = len(out) - start, len(out), b""
        if "mx" in features and entries:
            places = struct.pack("<HQ", 1, len(out))
            out += record(MESSAGE_INDEX, message_index(1, offsets), pad=pad)
        body = struct.pack("<QQQQ", min(times), max(times), start, length) + string(places)
        body += struct.pack("<Q", len(out) - index_start) + string("") + struct.pack("<QQ", len(inside), len(inside))
        indexed["chx"] = record(CHUNK_INDEX, body, pad=pad)
    out += record(DATA_END, struct.pack("<I", zlib.crc32(out)))
    return out + _summary(records, features, indexed, times, len(out))


def _summary(
    records: list[tuple[int, bytes | Entry]],
    features: frozenset[str],
    indexed: dict[str, bytes],
    times: list[int],
    start: int,
) -> bytes:
    pad = "pad" in features

    def count(kind: int) -> int:
        return sum(found == kind for found, _ in records)

    def repeated(kind: int) -> bytes:
        return b"".join(record(kind, body, pad=pad) for found, body in records if found == kind)  # type: ignore[arg-type]

    kinds = [SCHEMA, CHANNEL, ATTACHMENT, METADATA]
    counts = [count(MESSAGE), *map(count, kinds), int("ch" in features), min(times), max(times)]
    statistics = struct.pack("<QHIIIIQQ", *counts)
    statistics += string(struct.pack("<HQ", 1, count(MESSAGE)) if count(MESSAGE) else b"")
    groups = [
        ("rsh", SCHEMA, repeated(SCHEMA)),
        ("rch", CHANNEL, repeated(CHANNEL)),
        ("st", STATISTICS, record(STATISTICS, statistics, pad=pad)),
        ("mdx", METADATA_INDEX, indexed["mdx"]),
        ("ax", ATTACHMENT_INDEX, indexed["ax"]),
        ("chx", CHUNK_INDEX, indexed["chx"]),
    ]
    section, offsets = b"", b""
    for feature, kind, group in groups:
        if feature in features and group:
            offsets += record(SUMMARY_OFFSET, struct.pack("<BQQ", kind, start + len(section), len(group)), pad=pad)
            section += group
    places = struct.pack("<QQ", start if section else 0, start + len(section) if "sum" in features else 0)
    section += offsets if "sum" in features else b""
    head = struct.pack("<BQ", FOOTER, 20) + places
    return section + head + struct.pack("<I", zlib.crc32(section + head)) + MAGIC
