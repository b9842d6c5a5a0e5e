"""The cache of indexes: a log tells the same with and without it, and whatever is wrong with it is only a delay."""

import copy
import json
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from bad_bags import DB3_CASES, ROS1_CASES, entries
from made_logs import ROS2, mcap_bytes, plain, raw_ros

from readers import ReadOptions, index_cache, open_recording
from readers.index_cache import MAGIC, Entry, key_of
from readers.log_recording import LogRecording
from readers.mcap_scan import Scan
from readers.streams import RecordingError
from workbench.cli import main

WITHOUT = ReadOptions(cache=False)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache that keeps every index, however quickly it was found."""
    monkeypatch.setenv(index_cache.ENVIRONMENT, str(tmp_path / "cache"))
    monkeypatch.setattr(index_cache, "WORTH_KEEPING_S", 0.0)
    return tmp_path / "cache"


def unindexed(**options: Any) -> bytes:
    return mcap_bytes(raw_ros(entries(ROS2), 2), "ros2", "zstd", index=False, **options)


def flipped(data: bytes, at: int) -> bytes:
    return data[:at] + bytes([data[at] ^ 4]) + data[at + 1 :]


MCAPS: dict[str, Callable[[], bytes]] = {
    "no index": unindexed,
    "no chunks": lambda: unindexed(use_chunking=False),
    "cut": lambda: (data := unindexed())[: len(data) * 2 // 3],
    "a chunk flipped": lambda: flipped(data := unindexed(), len(data) // 2),
    "zeros": lambda: (data := unindexed())[: len(data) // 3] + bytes(2000) + data[len(data) // 3 + 2000 :],
    "two joined": lambda: unindexed() + unindexed(),
}
LOGS: dict[str, Callable[[Path], Path]] = {
    **{f"mcap, {name}": lambda path, make=make: _written(path / "a.mcap", make()) for name, make in MCAPS.items()},
    **{f"ros1, {name}": case.make for name, case in ROS1_CASES.items()},
    **{f"db3, {name}": case.make for name, case in DB3_CASES.items()},
}


def _written(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path


def told(path: Path, options: ReadOptions = ReadOptions()) -> Any:  # noqa: B008 (frozen)
    """All that a log tells: at opening, its messages and samples, and what was found to be damaged by then."""
    try:
        with open_recording(path, options) as recording:
            assert isinstance(recording, LogRecording)
            opened = (recording.streams, recording.notes, recording.damage, recording.losses, recording.format)
            messages = [(m.channel.topic, m.log_ns, m.publish_ns, bytes(m.data)) for m in recording.messages()]
            samples = [plain(sample) for sample in recording.read()]
            return opened, messages, samples, recording.damage, recording.losses
    except RecordingError as error:
        return str(error)


@pytest.mark.parametrize("name", LOGS)
def test_a_log_tells_the_same_with_and_without_the_cache(tmp_path: Path, folder: Path, name: str) -> None:
    (tmp_path / "log").mkdir()
    path = LOGS[name](tmp_path / "log")
    before = sorted(file.name for file in (tmp_path / "log").rglob("*"))
    expected = told(path, WITHOUT)
    assert not folder.exists()
    assert told(path) == expected
    assert told(path) == expected
    assert sorted(file.name for file in (tmp_path / "log").rglob("*")) == before
    if name.startswith(("mcap", "ros1")) and not isinstance(expected, str):
        assert len(list(folder.iterdir())) == 1


@pytest.fixture
def log(tmp_path: Path, folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A log without an index whose opening is in the cache, and `walks` that counts the openings that are not."""
    path = _written(tmp_path / "a.mcap", unindexed())
    told(path)
    walks.clear()
    run = Scan.run

    def counted(scan: Scan) -> None:
        walks.append(1)
        run(scan)

    monkeypatch.setattr(Scan, "run", counted)
    yield path
    walks.clear()


walks: list[int] = []


def trouble(path: Path) -> tuple[str, ...]:
    with open_recording(path) as recording:
        return recording.cache_troubles


def test_a_log_that_is_known_is_not_walked_over(log: Path) -> None:
    assert told(log) == told(log)
    assert walks == []
    assert trouble(log) == ()


def test_a_log_that_changed_is_read_anew(log: Path) -> None:
    data, stat = log.read_bytes(), log.stat()
    os.utime(log, ns=(stat.st_atime_ns, stat.st_mtime_ns + 1))
    told(log)
    assert len(walks) == 1
    stat = log.stat()
    log.write_bytes(flipped(data, len(data) // 2))
    os.utime(log, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    assert told(log) == told(log, WITHOUT)
    assert len(walks) == 3
    log.write_bytes(data[:-100])
    assert told(log)[-1]
    assert len(walks) == 4
    keys = [key_of(_written(log, one))["edges"] for one in (data, flipped(data, 9), flipped(data, len(data) - 1))]
    assert len(set(keys)) == 3


def test_other_code_reads_anew(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(index_cache, "code_digest", lambda: "another")
    told(log)
    assert len(walks) == 1


def test_damage_that_no_key_notices_is_still_found(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(index_cache, "key_of", lambda _: {})
    told(log)
    data = log.read_bytes()
    log.write_bytes(flipped(data, len(data) // 2))
    walks.clear()
    with open_recording(log) as recording:
        assert isinstance(recording, LogRecording)
        assert walks == []
        messages = sum(1 for _ in recording.messages())
        assert messages < sum(info.count for info in recording.streams)
        assert any("checksum" in loss.text or "unpacked" in loss.text for loss in recording.losses)


# ---------------------------------------------------------------------------- a bad cache


def entry(folder: Path) -> Path:
    (file,) = folder.iterdir()
    return file


def test_a_damaged_entry_is_said_and_made_anew(log: Path, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    expected, sound = told(log, WITHOUT), entry(folder).read_bytes()
    bad = [flipped(sound, at) for at in range(0, len(sound), max(1, len(sound) // 40))]
    bad += [b"", sound[:20], sound[:-1], sound + b"x", b"\x80\x04K\x01.", MAGIC * 9]
    for raw in bad:
        entry(folder).write_bytes(raw)
        (said,) = trouble(log)
        assert "was not used: " in said
        assert said.endswith("the file was read anew.")
        assert entry(folder).read_bytes() == sound
    assert told(log) == expected
    entry(folder).write_bytes(sound[:-1])
    assert main(["inspect", str(log), "--quick"]) == 0
    assert "does not match its digest" in capsys.readouterr().err
    assert trouble(log) == ()


WILD: list[Any] = [None, -7, 2**70, 1.5, "x", [], {}, [[]], True]


def places(value: Any) -> Iterator[tuple[Any, ...]]:
    """The way to every value inside of a state, of long lists the first two."""
    items = list(value.items()) if isinstance(value, dict) else list(enumerate(value))[:2]
    for key, inner in items:
        yield (key,)
        if isinstance(inner, dict | list):
            yield from ((key, *rest) for rest in places(inner))


@pytest.mark.parametrize("name", ["mcap, a chunk flipped", "ros1, unindexed", "db3, 8 kB of zeros", "db3, plain"])
def test_a_hostile_entry_with_a_right_digest_breaks_nothing(tmp_path: Path, folder: Path, name: str) -> None:
    path = LOGS[name](tmp_path) if name in LOGS else _sound_db3(tmp_path)
    told(path)
    if not folder.exists():
        assert name == "db3, 8 kB of zeros"  # what is read page by page is not kept
        return
    file = entry(folder)
    sound = index_cache._read(file)
    refused = 0
    for way in places(sound["state"]):
        for wild in WILD:
            content = copy.deepcopy(sound)
            inner = content["state"]
            for key in way[:-1]:
                inner = inner[key]
            inner[way[-1]] = wild
            index_cache._write(file, content)
            with open_recording(path) as recording:
                assert isinstance(recording, LogRecording)
                refused += bool(recording.cache_troubles)
                for _ in recording.messages():
                    pass
    assert refused > 20


def _sound_db3(folder: Path) -> Path:
    from made_logs import write_ros2

    (found,) = write_ros2(folder / "bag", entries(ROS2)).glob("*.db3")
    return found


def test_entries_that_are_too_large_are_not_believed(log: Path, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(index_cache, "LARGEST_ENTRY_BYTES", 100)
    assert "larger than entries can be" in trouble(log)[0]
    monkeypatch.undo()
    file = folder / "deep.index"
    packed = index_cache.zstandard.ZstdCompressor().compress(b"[" * 200_000)
    digest = index_cache.blake2b(packed, digest_size=index_cache.DIGEST_BYTES).digest()
    file.write_bytes(MAGIC + digest + packed)
    with pytest.raises(index_cache.StateError, match="cannot be parsed"):
        index_cache._read(file)


def test_a_cache_that_cannot_be_written_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = _written(tmp_path / "a.mcap", unindexed())
    (tmp_path / "file").touch()
    monkeypatch.setattr(index_cache, "WORTH_KEEPING_S", 0.0)
    monkeypatch.setenv(index_cache.ENVIRONMENT, str(tmp_path / "file"))
    expected = told(path, WITHOUT)
    assert trouble(path)[0]
    assert told(path) == expected


# --------------------------------------------------------------------------------- bounds


def test_the_folder_keeps_what_was_used_last(tmp_path: Path, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    paths = [_written(tmp_path / f"log_{name}.mcap", unindexed()) for name in "abcd"]
    told(paths[0])
    monkeypatch.setattr(index_cache, "FOLDER_BYTES", 3 * entry(folder).stat().st_size + 200)
    for path in paths[1:3]:
        told(path)
    for age, path in enumerate((paths[1], paths[2], paths[0])):
        os.utime(Entry(path, folder).file, ns=(age, age))
    told(paths[3])
    assert {file.name for file in folder.iterdir()} == {Entry(paths[i], folder).file.name for i in (0, 2, 3)}
    assert folder.stat().st_mode & 0o077 == 0


def test_it_can_be_left_out(tmp_path: Path, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = _written(tmp_path / "a.mcap", unindexed())
    assert main(["inspect", str(path), "--no-cache"]) == 0
    assert main(["recover", str(path), "-o", str(tmp_path / "b.mcap"), "--no-cache"]) == 0
    assert not folder.exists()
    monkeypatch.setenv(index_cache.ENVIRONMENT, "off")
    assert index_cache.user_folder() is None
    told(path)
    monkeypatch.setenv(index_cache.ENVIRONMENT, "")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert index_cache.user_folder() == tmp_path / "xdg" / "estimator-workbench"
    monkeypatch.setenv("XDG_CACHE_HOME", "not/absolute")
    assert index_cache.user_folder() == Path.home() / ".cache" / "estimator-workbench"
    assert not folder.exists()


def test_a_log_that_opens_quickly_is_not_kept(tmp_path: Path, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(index_cache, "WORTH_KEEPING_S", 1e9)
    told(_written(tmp_path / "a.mcap", unindexed()))
    assert not folder.exists()


def test_entries_are_plain_json(log: Path, folder: Path) -> None:
    stored = index_cache._read(entry(folder))
    assert json.loads(json.dumps(stored)) == stored
    assert stored["key"]["path"] == str(log.resolve())
