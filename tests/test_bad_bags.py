"""Damaged and hostile bags: what can be read is read, what is lost is told, and nothing costs time or memory."""

import hashlib
import json
import os
import random
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from bad_bags import DB3_CASES, MESSAGES, ROS1_CASES, Case, entries, few_entries
from made_logs import ROS1, ROS2, write_ros1, write_ros2

from readers import open_recording
from readers.log_recording import LogRecording
from readers.message_log import Message
from readers.streams import RecordingError

CASES = {f"ROS 1, {name}": case for name, case in ROS1_CASES.items()} | {
    f"db3, {name}": case for name, case in DB3_CASES.items()
}
WHOLE = bool(os.environ.get("WORKBENCH_EVERY_BYTE"))
SECONDS, MEBIBYTES = 5.0, 400

Plain = tuple[str, int, str]
Originals = dict[str, dict[tuple[int, str], bytes]]


def plain(message: Message) -> Plain:
    return message.channel.topic, message.log_ns, hashlib.sha1(message.data).hexdigest()


def every_message(path: Path) -> tuple[Counter[Plain], LogRecording]:
    with open_recording(path) as recording:
        assert isinstance(recording, LogRecording)
        return Counter(plain(message) for message in recording.messages()), recording


@pytest.fixture(scope="module")
def originals() -> Originals:
    def of(store: Any, serialize: Any) -> dict[tuple[int, str], bytes]:
        stored = {entry.log_ns: bytes(serialize(entry.message, entry.type)) for entry in entries(store)}
        return {(log_ns, hashlib.sha1(data).hexdigest()): data for log_ns, data in stored.items()}

    return {"ROS 1": of(ROS1, ROS1.serialize_ros1), "db3": of(ROS2, ROS2.serialize_cdr)}


@pytest.mark.parametrize("name", CASES)
def test_a_bad_log_gives_what_can_be_read_and_says_what_is_lost(
    tmp_path: Path, name: str, originals: Originals
) -> None:
    case: Case = CASES[name]
    path = case.make(tmp_path)
    folder = path if path.is_dir() else path.parent
    before = {file: file.read_bytes() for file in folder.rglob("*") if file.is_file()}
    if not case.readable:
        with pytest.raises(RecordingError, match=case.words):
            open_recording(path)
        return
    found, recording = every_message(path)
    assert {file: file.read_bytes() for file in folder.rglob("*") if file.is_file()} == before
    assert case.readable <= sum(found.values()) <= MESSAGES
    assert max(found.values()) == 1
    every = originals[name.partition(",")[0]]
    if "bit flip" not in name:
        assert {message[1:] for message in found} <= every.keys()
    left = path.read_bytes() if path.is_file() else b""
    assert case.named or sum(found.values()) >= 0.97 * sum(data in left for data in every.values())
    report = "; ".join([*map(str, recording.damage), *recording.notes])
    assert case.words in report
    assert bool(recording.damage) or sum(found.values()) == MESSAGES
    lost = sum(t.lost + t.withheld for loss in recording.losses for t in loss.topics.values())
    assert lost + sum(found.values()) == MESSAGES if case.counted else lost + sum(found.values()) <= MESSAGES


MEASURED = """
import json, re, sys, time
from pathlib import Path
from readers import open_recording
from readers.streams import RecordingError
def peak_mib():  # of this program alone: getrusage also counts what the parent had when it started this one
    status = Path("/proc/self/status").read_text()
    return int(re.search(r"VmHWM:\\s+(\\d+) kB", status).group(1)) // 1024
for path in sys.argv[1:]:
    began = time.monotonic()
    try:
        with open_recording(Path(path)) as recording:
            count = sum(1 for _ in recording.messages())
    except RecordingError:
        count = 0
    print(json.dumps([path, count, time.monotonic() - began, peak_mib()]))
"""


@pytest.mark.skipif(not Path("/proc/self/status").is_file(), reason="the memory of a process is read from /proc")
def test_no_bad_log_costs_much_time_or_memory(tmp_path: Path) -> None:
    paths = []
    for number, case in enumerate(CASES.values()):
        (tmp_path / str(number)).mkdir()
        paths.append(str(case.make(tmp_path / str(number))))
    done = subprocess.run([sys.executable, "-c", MEASURED, *paths], capture_output=True, text=True, check=True)
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(rows) == len(CASES)
    for _, _, seconds, mebibytes in rows:
        assert seconds < SECONDS
        assert mebibytes < MEBIBYTES


# ------------------------------------------------------------------------------------- every byte


def small(folder: Path, kind: str) -> Path:
    """A log of a few kB in three chunks, or one database."""
    if kind == "db3":
        return write_ros2(folder / "small", few_entries(ROS2)) / "small.db3"
    return write_ros1(folder / "small.bag", few_entries(ROS1), kind, 4000)


KINDS = ("none", "lz4", "bz2", "db3")


class Judge:
    """Reads damaged copies of one small log and checks the promises that hold for all of them."""

    def __init__(self, folder: Path, kind: str) -> None:
        self.kind, self.path = kind, small(folder, kind)
        self.whole = self.path.read_bytes()
        self.copy = folder / f"copy{self.path.suffix}"
        self.every, _ = every_message(self.path)
        self.outlines = {message[:2] for message in self.every}

    def read(self, data: bytes) -> tuple[Counter[Plain], bool]:
        """What a damaged copy gives, and whether damage is reported; no error but ours comes out."""
        self.copy.unlink(missing_ok=True)
        self.copy.write_bytes(data)
        try:
            found, recording = every_message(self.copy)
        except RecordingError:
            return Counter(), True
        return found, bool(recording.damage)


@pytest.mark.parametrize("kind", KINDS)
def test_a_log_cut_at_any_byte_gives_nothing_false_and_says_so(tmp_path: Path, kind: str) -> None:
    judge = Judge(tmp_path, kind)
    share = 0.0
    sizes = range(0, len(judge.whole), 1 if WHOLE else 211)
    for size in sizes:
        found, reported = judge.read(judge.whole[:size])
        assert found <= judge.every, size
        assert reported, size
        share += found.total() / judge.every.total() / len(sizes)
    assert share > {"none": 0.3, "lz4": 0.25, "bz2": 0.25, "db3": 0.05}[kind]


@pytest.mark.parametrize("kind", KINDS)
def test_a_flipped_bit_gives_nothing_false_where_the_container_can_tell(tmp_path: Path, kind: str) -> None:
    judge, rng = Judge(tmp_path, kind), random.Random(5)
    silent = wrong = 0
    places = range(0, len(judge.whole), 1 if WHOLE else 97)
    for place in places:
        data = bytearray(judge.whole)
        data[place] ^= 1 << rng.randrange(8)
        found, reported = judge.read(bytes(data))
        false = found - judge.every
        wrong += bool(false)
        if kind == "bz2":  # what a topic is called also stands outside of the chunks, and is told if it differs
            assert {message[1:] for message in found} <= {message[1:] for message in judge.every}, place
        if not reported and found != judge.every:
            silent += 1
            assert kind != "bz2", place
            if kind == "db3":  # topics and types are texts without a checksum
                assert [m[1] for m in sorted(found)] == [m[1] for m in sorted(judge.every)], place
            else:
                assert {message[:2] for message in found} == judge.outlines, place
    print(f"{kind}: {len(places)} flips, {wrong} with wrong data, {silent} unreported")
