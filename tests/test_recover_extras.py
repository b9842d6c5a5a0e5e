"""`recover` keeps attachments and metadata: as many come out as went in, or each of the others has a reason."""

import io
import json
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from made_mcap import ATTACHMENT, METADATA, record, string, strings
from mcap.reader import make_reader
from mcap.records import Attachment, Metadata
from mcap.writer import CompressionType, IndexType, Writer

from readers import open_recording
from workbench.cli import main

FILES = {
    "calibration.yaml": ("text/yaml", b"K: [1, 2, 3]\n" * 20),
    "map <b>.png": ("image/png", bytes(range(256)) * 3),
    "": ("", b""),
}
TEXTS = {"vehicle": {"name": "rover 3", "wheels": "6"}, "operator": {}}
MESSAGES = 40


def made(*, index: bool = True, statistics: bool = True, messages: int = MESSAGES, chunked: bool = True) -> bytes:
    """A log with messages, and attachments and metadata between them."""
    target = io.BytesIO()
    options: dict[str, Any] = {} if index else {"index_types": IndexType.NONE, "use_summary_offsets": False}
    writer = Writer(
        target,
        chunk_size=300,
        compression=CompressionType.ZSTD,
        use_statistics=statistics,
        use_chunking=chunked,
        **options,
    )
    writer.start("", "test")
    channel = writer.register_channel("/t", "text", writer.register_schema("T", "text", b"x"))
    beside = [
        *((writer.add_attachment, (11 + i, 5 + i, name, *FILES[name])) for i, name in enumerate(FILES)),
        *((writer.add_metadata, (name, TEXTS[name])) for name in TEXTS),
    ]
    for i in range(messages):
        if i % 7 == 3 and beside:
            add, arguments = beside.pop(0)
            add(*arguments)
        writer.add_message(channel, 1000 + i, b"message %d" % i, 1000 + i, i)
    for add, arguments in beside:
        add(*arguments)
    writer.finish()
    return target.getvalue()


def contents(path: Path) -> tuple[list[Attachment], list[Metadata], int]:
    """What the format's own library reads."""
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        found = list(reader.iter_attachments()), list(reader.iter_metadata())
        assert (summary.statistics.attachment_count, summary.statistics.metadata_count) == tuple(map(len, found))
        return *found, sum(1 for _ in reader.iter_messages())


SENT = (
    [Attachment(11 + i, 5 + i, name, *FILES[name]) for i, name in enumerate(FILES)],
    [Metadata(name, TEXTS[name]) for name in TEXTS],
)


def recovered(tmp_path: Path, data: bytes, capsys: pytest.CaptureFixture[str]) -> tuple[Any, int, Path]:
    path, out = tmp_path / "in.mcap", tmp_path / "out.mcap"
    path.write_bytes(data)
    out.unlink(missing_ok=True)
    status = main(["recover", str(path), "-o", str(out), "--json"])
    return json.loads(capsys.readouterr().out), status, out


@pytest.mark.parametrize("index", [True, False])
@pytest.mark.parametrize("chunked", [True, False])
def test_all_of_a_sound_log_comes_out(
    tmp_path: Path, index: bool, chunked: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    report, status, out = recovered(tmp_path, made(index=index, chunked=chunked), capsys)
    attachments, metadata, messages = contents(out)
    assert (attachments, metadata, messages) == (*SENT, MESSAGES)
    assert status == 0, report["damage"]
    assert (report["attachments"], report["metadata"], report["lost_beside_messages"]) == (3, 2, [])


def test_two_logs_that_were_joined_bring_both(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    report, status, out = recovered(tmp_path, made() + made(), capsys)
    assert contents(out) == (2 * SENT[0], 2 * SENT[1], 2 * MESSAGES)
    assert report["lost_beside_messages"] == []
    assert status == 3


def flipped(data: bytes, what: bytes, shift: int = 0) -> bytes:
    at = data.index(what) + shift
    return data[:at] + bytes([data[at] ^ 16]) + data[at + 1 :]


def zeroed(data: bytes, what: bytes, before: int, behind: int) -> bytes:
    at = data.index(what)
    return data[: at - before] + bytes(before + behind) + data[at + behind :]


NAMED = {"kind": "attachment", "name": "calibration.yaml"}
DAMAGE: dict[str, tuple[Callable[[], bytes], list[dict[str, str]], tuple[int, int]]] = {
    "a bit of the data": (
        lambda: flipped(made(), b"K: [1, 2"),
        [NAMED | {"reason": "it does not match its checksum"}],
        (2, 2),
    ),
    "a bit of the length": (
        lambda: flipped(made(), b"calibration.yaml", -4 - 16 - 5),
        [NAMED | {"reason": "its record is damaged"}],
        (2, 2),
    ),
    "cut inside": (
        lambda: (data := made(index=False, statistics=False))[: data.index(b"K: [1, 2") + 40],
        [NAMED | {"reason": "the file ends inside of it"}],
        (0, 0),
    ),
    "zeros, but an index": (
        lambda: zeroed(made(), b"calibration.yaml", 29, 300),
        [NAMED | {"reason": "the index names it and it is not there"}],
        (2, 2),
    ),
    "metadata zeroed, but an index": (
        lambda: zeroed(made(), b"vehicle", 13, 40),
        [{"kind": "metadata", "name": "vehicle", "reason": "the index names it and it is not there"}],
        (3, 1),
    ),
    "zeros, but statistics": (
        lambda: zeroed(made(index=False), b"vehicle", 13, 40),
        [
            {
                "kind": "metadata",
                "name": "",
                "reason": "the statistics count 1 more than are there",
            }
        ],
        (3, 1),
    ),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_what_is_lost_has_a_name_and_a_reason(tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    make, lost, counts = DAMAGE[name]
    report, status, out = recovered(tmp_path, make(), capsys)
    assert report["lost_beside_messages"] == lost
    assert (report["attachments"], report["metadata"]) == counts
    assert status == 3
    assert any(lost[0]["reason"] in text for text in report["damage"])
    attachments, metadata, _ = contents(out)
    assert all(one in SENT[0] for one in attachments)
    assert all(one in SENT[1] for one in metadata)
    shown = main(["inspect", str(tmp_path / "in.mcap"), "--json"])
    values = json.loads(capsys.readouterr().out)
    assert shown == 3
    assert values["lost_beside_messages"] == lost
    assert values["damage"] == report["damage"]


def test_they_are_shown_with_control_characters_escaped(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "a.mcap").write_bytes(made().replace(b"map <b>.png", b"map\x1b[31m.pg"))
    main(["inspect", str(tmp_path / "a.mcap")])
    shown = capsys.readouterr().out
    assert "calibration.yaml, text/yaml, 260 bytes" in shown
    assert "vehicle: 2 values" in shown
    assert "\x1b" not in shown
    assert main(["recover", str(tmp_path / "a.mcap"), "-o", str(tmp_path / "b.mcap")]) == 3
    shown = capsys.readouterr().out
    assert f"{MESSAGES} messages, 2 attachments, 2 records of metadata of" in shown
    assert "attachment map\\x1b[31m.pg: it does not match its checksum" in shown


def test_an_attachment_without_a_checksum_is_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    body = struct.pack("<QQ", 2, 1) + string("free") + string("text/plain") + struct.pack("<Q", 3) + b"abc"
    data = made(index=False, statistics=False)
    at = data.index(record(METADATA, string("vehicle") + strings(TEXTS["vehicle"])))
    more = data[:at] + record(ATTACHMENT, body + bytes(4), pad=True) + data[at:]
    report, _, out = recovered(tmp_path, more, capsys)
    assert Attachment(1, 2, "free", "text/plain", b"abc") in contents(out)[0]
    assert report["attachments"] == 4
    right = data[:at] + record(ATTACHMENT, body + struct.pack("<I", zlib.crc32(body)), pad=True) + data[at:]
    assert recovered(tmp_path, right, capsys)[0]["attachments"] == 4


@pytest.mark.parametrize("index", [True, False])
def test_no_flip_and_no_cut_loses_one_without_a_word(tmp_path: Path, index: bool) -> None:
    data = made(index=index, messages=6)
    sent = {(a.name, bytes(a.data)) for a in SENT[0]}
    path = tmp_path / "in.mcap"
    cases = [data[:at] + bytes([data[at] ^ 1 << at % 8]) + data[at + 1 :] for at in range(8, len(data), 6)]
    cases += [data[:at] for at in range(30, len(data), 19)]
    for damaged in cases:
        path.write_bytes(damaged)
        with open_recording(path) as recording:
            found = recording.extras()
            assert {(a.name, bytes(a.data)) for a in found.attachments} <= sent
            if len(found.attachments) < len(SENT[0]) or len(found.metadata) < len(SENT[1]):
                assert recording.losses
            del found
