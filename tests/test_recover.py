"""`recover`: what can be read of a log as a clean MCAP file, with an account of every message."""

import json
import os
import signal
import subprocess
import sys
import textwrap
from collections import Counter
from pathlib import Path

import pytest
from bad_bags import DB3_CASES, MESSAGES, ROS1_CASES, TOPICS, chunk_data, chunks, entries
from made_logs import ROS1, ROS2, START_NS, plain, write_ros1, write_ros2
from mcap.reader import make_reader
from mcap_ros1.decoder import DecoderFactory as Ros1Decoder
from mcap_ros2.decoder import DecoderFactory as Ros2Decoder
from recordings_dir import RECORDINGS

from readers import ReadOptions, open_recording
from readers.log_recording import LogRecording
from readers.streams import Problem, RecordingError, StreamError
from workbench.cli import main
from workbench.recovery import recover


def raw(path: Path) -> Counter[tuple[str, int, bytes]]:
    with open_recording(path) as recording:
        assert isinstance(recording, LogRecording)
        return Counter((m.channel.topic, m.log_ns, bytes(m.data)) for m in recording.messages())


SOURCES = {f"ros1 {name}": ROS1_CASES[name] for name in ("unindexed", "bz2 bit flip", "second half zeros")} | {
    f"db3 {name}": DB3_CASES[name] for name in ("8 kB of zeros", "half in the write-ahead log", "no data and text time")
}


@pytest.mark.parametrize("name", SOURCES)
def test_what_can_be_read_comes_out_and_the_rest_is_counted(tmp_path: Path, name: str) -> None:
    path, out = SOURCES[name].make(tmp_path), tmp_path / "out.mcap"
    before = raw(path)
    with open_recording(path) as recording:
        done = recover(recording, out)
        assert done.clean is (name == "db3 half in the write-ahead log")
    assert raw(out) == before
    assert {topic: good.count for topic, good in done.good.items()} == Counter(topic for topic, *_ in before.elements())
    with open_recording(out) as recovered, open_recording(path) as source:
        assert recovered.damage == ()
        assert [plain(s) for s in recovered.read()] == [plain(s) for s in source.read()]
    with out.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[Ros1Decoder(), Ros2Decoder()])
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count == before.total()
        assert len(summary.chunk_indexes) > 0
        kinds = {(schema.encoding, channel.message_encoding) for schema, channel, _ in reader.iter_messages() if schema}
        assert kinds == {("ros1msg", "ros1") if name.startswith("ros1") else ("ros2msg", "cdr")}
        seen = [message.header.frame_id for *_, message in reader.iter_decoded_messages(topics=["/imu"])]
        assert set(seen) == {"imu"}


def test_every_message_is_written_or_has_a_reason(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = ROS1_CASES["bz2 bit flip"].make(tmp_path)
    assert main(["recover", str(path), "-o", str(tmp_path / "out.mcap"), "--json"]) == 3
    report = json.loads(capsys.readouterr().out)
    topics = {topic["name"]: topic for topic in report["topics"]}
    for name, count in TOPICS.items():
        topic = topics[name]
        assert topic["recovered"] + topic["lost"] + topic["withheld"] + topic["undecodable"] == count
    assert sum(topic["withheld"] for topic in topics.values()) > 0
    assert topics["/imu"]["first_good_ns"] == START_NS
    (loss,) = report["losses"]
    assert loss["what"] == "codec"
    assert loss["bytes"][0] < loss["bytes"][1] < path.stat().st_size
    assert START_NS < loss["first_ns"] < loss["last_ns"] < topics["/imu"]["last_good_ns"]
    assert main(["inspect", str(path), "--json"]) == 3
    assert json.loads(capsys.readouterr().out)["loss"]["topics"] == report["topics"]
    assert main(["inspect", str(path)]) == 3
    shown = capsys.readouterr().out
    assert "withheld" in shown
    assert "last good s" in shown


def test_a_sound_log_is_clean(tmp_path: Path) -> None:
    path = write_ros2(tmp_path / "bag", entries(ROS2), mode="message")
    out = tmp_path / "out.mcap"
    assert main(["recover", str(path), "-o", str(out)]) == 0
    with open_recording(out) as recovered, open_recording(path) as source:
        assert [plain(s) for s in recovered.read()] == [plain(s) for s in source.read()]
        assert not any(isinstance(s, Problem) for s in recovered.read())
    with out.open("rb") as file:
        decoded = make_reader(file, decoder_factories=[Ros2Decoder()]).iter_decoded_messages()
        assert sum(1 for _ in decoded) == MESSAGES


def test_it_refuses_what_it_must_not_write(tmp_path: Path) -> None:
    path = write_ros1(tmp_path / "a.bag", entries(ROS1))
    folder = write_ros2(tmp_path / "bag", entries(ROS2))
    before = path.read_bytes()
    assert main(["recover", str(path), "-o", str(path)]) == 2
    assert path.read_bytes() == before
    assert main(["recover", str(folder), "-o", str(folder / "new.mcap")]) == 2
    assert not (folder / "new.mcap").exists()
    assert main(["recover", str(path), "-o", str(tmp_path / "no" / "such" / "folder.mcap")]) == 2
    empty = tmp_path / "empty.bag"
    empty.touch()
    assert main(["recover", str(empty), "-o", str(tmp_path / "b.mcap")]) == 2
    assert not (tmp_path / "b.mcap").exists()
    with open_recording(path) as recording, pytest.raises(RecordingError, match="exists already"):
        recover(recording, path)
    with (
        open_recording(RECORDINGS / "stereo_chessboard", ReadOptions(rate_hz=10.0)) as images,
        pytest.raises(StreamError, match="no messages to recover"),
    ):
        recover(images, tmp_path / "c.mcap")


def test_parts_of_a_split_log_become_one_file(tmp_path: Path) -> None:
    whole = entries(ROS1)
    folder = tmp_path / "parts"
    folder.mkdir()
    for number in range(3):
        write_ros1(folder / f"run_{number}.bag", whole[number * 80 : number * 80 + 80])
    data = bytearray((folder / "run_1.bag").read_bytes())
    (folder / "run_1.bag").write_bytes(data[: len(data) // 2])
    out = tmp_path / "out.mcap"
    assert main(["recover", str(folder), "-o", str(out)]) == 3
    assert raw(out) == raw(folder)
    with open_recording(out) as recording:
        assert isinstance(recording, LogRecording)
        assert sorted(channel.topic for channel in recording.channels) == sorted(TOPICS)
        assert 160 < sum(channel.count for channel in recording.channels) < 240


def test_definitions_come_from_the_users_folder(tmp_path: Path) -> None:
    path = write_ros2(tmp_path / "bag", [e for e in entries(ROS2) if e.topic == "/imu"])
    import sqlite3

    with sqlite3.connect(path / "bag.db3") as database:
        database.execute("DELETE FROM message_definitions")
        database.execute("UPDATE topics SET type = 'own_msgs/msg/Odd'")
    database.close()
    package = tmp_path / "src" / "own_msgs" / "msg"
    package.mkdir(parents=True)
    (package / "Odd.msg").write_text(
        "std_msgs/Header header\nfloat64[37] values\nown_msgs/Part[0] none\n".replace("own_msgs/Part[0] none\n", "")
    )
    for options, found in ((ReadOptions(), b""), (ReadOptions(msg_folder=tmp_path / "src"), b"float64[37] values")):
        out = tmp_path / f"{len(found)}.mcap"
        with open_recording(path, options) as recording:
            assert recover(recording, out).clean
        with open_recording(out) as recording:
            assert isinstance(recording, LogRecording)
            (channel,) = recording.channels
            assert channel.type == "own_msgs/msg/Odd"
            assert found in channel.schema
            assert channel.count == 200


SLOWED = textwrap.dedent(
    """
    import sys, time
    from workbench import cli
    class Slow(cli.Bar):
        def __call__(self, progress):
            print(progress.done, flush=True)
            time.sleep(0.01)
    cli.Bar = Slow
    sys.exit(cli.main())
    """
)


def test_ctrl_c_leaves_a_readable_file(tmp_path: Path) -> None:
    path, out = write_ros1(tmp_path / "a.bag", entries(ROS1)), tmp_path / "out.mcap"
    child = subprocess.Popen(
        [sys.executable, "-c", SLOWED, "recover", str(path), "-o", str(out)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=dict(os.environ, PYTHONPATH=str(Path(__file__).parents[1])),
    )
    assert child.stdout is not None
    for line in child.stdout:
        if line.strip() == "50":
            child.send_signal(signal.SIGINT)
            break
    _, errors = child.communicate()
    assert child.returncode == 130
    assert "holds what was written so far" in errors
    with open_recording(out) as recording:
        assert isinstance(recording, LogRecording)
        assert recording.damage == ()
        assert 50 <= sum(1 for _ in recording.messages()) < MESSAGES


def test_a_log_of_which_nothing_can_be_read_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, out = write_ros1(tmp_path / "a.bag", entries(ROS1), "bz2", 8192), tmp_path / "out.mcap"
    data = bytearray(path.read_bytes())
    for at in chunks(data):
        data[sum(chunk_data(data, at)) // 2] ^= 1
    path.write_bytes(data)
    (tmp_path / "b.mcap").write_bytes(b"\x89MCAP0\r\n")
    for file, words in ((path, "a bz2 chunk"), (tmp_path / "b.mcap", "was not closed")):
        assert main(["inspect", str(file)]) == 2
        assert words in capsys.readouterr().out
        assert main(["recover", str(file), "-o", str(out)]) == 2
        assert f"{file.name}: nothing of it can be read (" in capsys.readouterr().err
        assert not out.exists()
