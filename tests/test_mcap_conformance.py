"""The 416 variants of MCAP's conformance tests, written anew here and read exactly."""

import hashlib
from pathlib import Path

import pytest
from made_mcap import INPUTS, Entry, conformance_file, variants

from readers.mcap_log import McapLog
from readers.message_log import in_log_order

PUBLISHED = {
    "NoData-pad-st-sum": "b5a32905482d1e5c120712614a4923e489303ef55399a2bfe98821613220ab72",
    "OneMetadata": "378cc0683fa355e44bb92666e0d89619e9ab490e85bc6fc240e8d20f8ee58230",
    "OneSchemalessMessage-rch-st-sum": "8dfce65dc710ac026328ce55e7bb13f0e5d9b06dbc29009d8e06f4dd604aa601",
    "OneSchemalessMessage-ch-chx-mx-pad-rch-st-sum": "d5f340ef4c1e80be16711f70d118266375a549c854cd96a9581e60fdd8ef819a",
    "TenMessages-ch-mx-rch-sum": "071de3abb77ce406855532a5e2822298be1b43430054a387dd3b5617c5610d52",
    "TenMessages-ch-chx-pad": "f2485fa0ba073045cd5124a9a7af95672e73bf0e32656765e7f8aa80afd246ec",
}
"""Digests of files in github.com/foxglove/mcap, tests/conformance/data, as its Git LFS pointers state them."""


@pytest.mark.parametrize("name", PUBLISHED)
def test_the_generator_writes_the_published_files(name: str) -> None:
    base, *features = name.split("-")
    assert hashlib.sha256(conformance_file(base, frozenset(features))).hexdigest() == PUBLISHED[name]


def test_all_416_variants_are_read_exactly(tmp_path: Path) -> None:
    path, count = tmp_path / "a.mcap", 0
    for name, features in variants():
        path.write_bytes(conformance_file(name, features))
        log = McapLog(path)
        entries = [entry for _, entry in INPUTS[name] if isinstance(entry, Entry)]
        expected = sorted(entries, key=lambda entry: entry.log_ns)
        found = list(in_log_order(log.sources(log.channels)))
        case = f"{name} {sorted(features)}"
        assert [(m.log_ns, m.publish_ns, m.sequence, bytes(m.data)) for m in found] == [
            (entry.log_ns, entry.publish_ns, entry.sequence, entry.data) for entry in expected
        ], case
        described = any(kind == 4 for kind, _ in INPUTS[name])
        assert [channel.topic for channel in log.channels] == ["example"] * described, case
        kind = {"OneMessage": "Example", "TenMessages": "Example"}.get(name, "")
        for channel in log.channels:
            assert (channel.type, channel.schema) == (kind, bytes([4, 5, 6]) if kind else b""), case
            assert (channel.count, channel.first_ns) == (len(entries), min(e.log_ns for e in entries)), case
        assert log.losses == [], case
        log.close()
        count += 1
    assert count == 416
