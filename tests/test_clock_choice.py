"""Which clock a sample's time comes from, offsets, and what is odd about clocks."""

import json
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
from made_logs import MS, ROS2, START_NS, Maker, Raw, drive, raw_ros, write_mcap

from readers import open_recording
from readers.clock import SECOND_NS, StreamAudit, examine, survey
from readers.log_recording import LogRecording
from readers.message_log import Channel, Message
from readers.streams import Clock, ReadOptions, Sample, ScalarSample, StreamError
from workbench.cli import main
from workbench.opening import open_any
from workbench.session import Request, run

SENT_LATE = 3 * MS


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """Stamps are 5 ms before log time, images' 45 ms."""
    return write_mcap(tmp_path / "a.mcap", raw_ros(drive(ROS2), 2), "ros2", "zstd")


@pytest.fixture
def published(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every message was published 3 ms before it was logged."""
    stored = LogRecording._messages

    def messages(self: LogRecording, channels: Collection[Channel], *window: int | None) -> Iterator[Message]:
        return (m._replace(publish_ns=m.log_ns - SENT_LATE) for m in stored(self, channels, *window))

    monkeypatch.setattr(LogRecording, "_messages", messages)


def read(path: Path, *streams: str, start: int | None = None, stop: int | None = None, **options: Any) -> list[Sample]:
    with open_any(path, ReadOptions(**options)) as recording:
        return list(recording.read(streams, start, stop))


def test_all_three_times_are_kept(log: Path, published: None) -> None:
    for sample in read(log, "/imu", "/cam/image_raw"):
        late = 45 if sample.stream == "/cam/image_raw" else 5
        assert sample.t_ns == sample.header_ns == sample.received_ns - late * MS
        assert sample.published_ns == sample.received_ns - SENT_LATE


def test_a_topic_has_the_clock_that_was_chosen(log: Path, published: None) -> None:
    clocks = (("/imu", Clock.LOG), ("/cam/image_raw", Clock.PUBLISH))
    samples = read(log, "/imu", "/cam/image_raw", "/odom", clocks=clocks)
    for sample in samples:
        expected = {"/imu": sample.received_ns, "/cam/image_raw": sample.published_ns, "/odom": sample.header_ns}
        assert sample.t_ns == expected[sample.stream]
    times = [sample.t_ns for sample in samples]
    assert times == sorted(times)
    assert len(samples) == 200 + 20 + 40


def test_a_log_without_publish_times_says_that_log_time_is_used(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stored = LogRecording._messages
    monkeypatch.setattr(LogRecording, "_messages", lambda *args: (m._replace(publish_ns=-1) for m in stored(*args)))
    with open_recording(log, ReadOptions(clocks=(("/imu", Clock.PUBLISH),))) as recording:
        assert "/imu: it has no publish times of the log's epoch; log time is used." in recording.notes
        samples = list(recording.read(["/imu"]))
    assert all(s.t_ns == s.received_ns and "foreign_publish_time" in s.oddities for s in samples)


@pytest.mark.parametrize("offset_ms", [-2500.0, -12.5, 12.5, 2500.0])
def test_an_offset_is_added_and_windows_are_of_the_new_times(log: Path, offset_ms: float) -> None:
    offset = round(offset_ms * 1e6)
    plain = {s.received_ns: s.t_ns for s in read(log, "/imu", "/odom")}
    offsets = (("/imu", offset),)
    moved = read(log, "/imu", "/odom", offsets_ns=offsets)
    assert [s.t_ns for s in moved] == sorted(s.t_ns for s in moved)
    assert all(s.t_ns == plain[s.received_ns] + offset * (s.stream == "/imu") for s in moved)
    lower, upper = START_NS + offset + 500 * MS, START_NS + offset + 900 * MS
    part = read(log, "/imu", start=lower, stop=upper, offsets_ns=offsets)
    assert [s.t_ns for s in part] == list(range(lower, upper, 10 * MS))
    with open_recording(log, ReadOptions(offsets_ns=offsets)) as recording:
        assert recording.count_before("/imu", lower) == 50


def test_simulated_missions_take_clocks_and_offsets_alike() -> None:
    path = Path("sim:sensors")
    with open_any(path, ReadOptions()) as mission:
        imu = next(info.name for info in mission.streams if info.kind == "imu")
        stop = next(mission.read([imu])).t_ns + SECOND_NS
        plain = list(mission.read([imu], None, stop))
        other = next(info.name for info in mission.streams if info.kind == "odometry")
    moved = read(path, imu, stop=stop - 20 * MS, offsets_ns=((imu, -20 * MS),))
    assert [s.t_ns for s in moved] == [s.t_ns - 20 * MS for s in plain]
    both = read(path, imu, other, stop=stop, offsets_ns=((imu, -20 * MS),), clocks=((other, Clock.LOG),))
    assert [s.t_ns for s in both] == sorted(s.t_ns for s in both)
    assert {s.stream for s in both} == {imu, other}
    assert all(s.t_ns == s.received_ns for s in both if s.stream == other)
    with pytest.raises(StreamError, match="no publish times"):
        open_any(path, ReadOptions(clocks=((imu, Clock.PUBLISH),)))


def test_a_topic_that_is_not_there_is_refused_with_those_that_are(
    log: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(StreamError, match=r"/gps.*there are: .*/imu, /odom, /tf"):
        open_recording(log, ReadOptions(offsets_ns=(("/gps", 1),)))
    for words, text in (
        (["--clock", "/imu=wall"], "header, log or publish"),
        (["--clock", "/imu"], "header, log or publish"),
        (["--offset", "/imu=soon"], "milliseconds"),
        (["--offset", "/imu=nan"], "milliseconds"),
        (["--offset", "5"], "milliseconds"),
    ):
        assert main(["inspect", str(log), *words]) == 2
        assert text in capsys.readouterr().err


def test_inspect_tells_how_late_log_time_is(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["inspect", str(log), "--offset", "/imu=2", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    lag = told["clocks"]["/cam/image_raw"]["log_after_header"]
    assert lag == {"messages": 20, "least_ms": 45.0, "median_ms": 45.0, "greatest_ms": 45.0}
    assert told["clocks"]["/imu"]["log_after_header"]["median_ms"] == 5.0  # as it stands in the log
    assert "/imu: +2 ms are added to its times, as asked." in told["notes"]
    assert main(["inspect", str(log)]) == 0
    assert "45.000" in capsys.readouterr().out


def test_a_replay_warns_of_clocks_before_it_begins(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    entries = [e for e in drive(ROS2, 1.0) if e.topic == "/cam/image_raw"]
    jumped = [
        e._replace(message=Maker(ROS2).image(e.log_ns + (7000 if k >= 5 else 0) * MS)) for k, e in enumerate(entries)
    ]
    path = write_mcap(tmp_path / "a.mcap", raw_ros(jumped, 2), "ros2")
    warned: list[str] = []

    class StopError(Exception):
        pass

    def warn(texts: Sequence[str]) -> None:
        warned.extend(texts)
        raise StopError

    with pytest.raises(StopError):
        run(Request(path=path, out=tmp_path / "out"), on_warnings=warn)
    assert not (tmp_path / "out").exists()
    (jump,) = [text for text in warned if "jump" in text]
    assert jump.startswith("/cam/image_raw, first 10 s: 1 times the header stamps jump")
    assert "+7.000 s" in jump


# ------------------------------------------------------------------------------- oddities


def audit(pairs: list[tuple[int, int]], **fields: Any) -> dict[str, tuple[int, str]]:
    """Facts of a stream by code, from pairs (header stamp, log time)."""
    found = StreamAudit("/s")
    for own, received in pairs:
        t = own if own > 0 else received
        found.add(ScalarSample(stream="/s", t_ns=t, received_ns=received, header_ns=own, value=0.0, **fields))
    return {fact.code: (fact.count, fact.sentence) for fact in found.facts()}


def seconds(*pairs: tuple[float, float]) -> list[tuple[int, int]]:
    return [(round(own * 1e9), round(received * 1e9)) for own, received in pairs]


def test_a_jump_of_the_sensors_clock_is_told_with_its_size() -> None:
    steady = [(100 + k / 10, 100 + k / 10) for k in range(10)]
    for jump, words in ((7.5, "+7.500 s"), (-8.0, "-8.000 s")):
        facts = audit(seconds(*steady, *((a + 1 + jump, b + 1) for a, b in steady)))
        assert facts["clock_jump"][0] == 1
        assert facts["clock_jump"][1].endswith(f"by more than a second against log time, at most by {words}")
        assert "stamp_rollover" not in facts


def test_messages_that_arrive_in_bursts_are_no_jump() -> None:
    late = [(100 + k / 10, 105.0) for k in range(50)]
    assert "clock_jump" not in audit(seconds((99.9, 99.95), *late, (105.1, 105.15)))


@pytest.mark.parametrize(
    ("length_s", "name"),
    [(2**32 / 1e9, "32 bits in ns"), (2**32 / 1e6, "32 bits in µs"), (2**31 / 1e6, "31 bits in µs")],
)
def test_a_counter_that_begins_anew_is_named(length_s: float, name: str) -> None:
    start = length_s - 1000 % length_s - 2
    pairs = [((1000 + start + k / 10) % length_s, 1000 + start + k / 10) for k in range(40)]
    count, sentence = audit(seconds(*pairs))["stamp_rollover"]
    assert count == 1
    assert name in sentence


def test_zero_stamps_and_publish_times_of_another_epoch_are_counted() -> None:
    assert audit(seconds((0, 10), (0, 11)))["zero_stamp"][0] == 2
    facts = audit(seconds((10, 10), (11, 11)), published_ns=0)
    assert facts["foreign_publish_time"] == (2, "2 publish times are of another epoch than log time")


def test_the_difference_of_the_clocks_is_told_by_stream() -> None:
    samples = [
        ScalarSample(stream="/s", t_ns=t, received_ns=t + late, header_ns=t, published_ns=t + late - 2, value=0.0)
        for t, late in ((10**9, 5), (2 * 10**9, 7), (3 * 10**9, 30))
    ]
    found = StreamAudit("/s")
    for sample in samples:
        found.add(sample)
    assert found.lag == (3, 5, 7, 30)
    assert found.publish_lag == (3, 2, 2, 2)


def test_examine_gives_facts_and_audits(log: Path) -> None:
    with open_recording(log) as recording:
        found = examine(recording)
    assert found.audits["/imu"].lag == (200, 5 * MS, 5 * MS, 5 * MS)


def test_times_that_64_bits_do_not_hold_are_told_and_stop_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    raws = list(raw_ros(drive(ROS2, 1.0), 2))
    raws[7], raws[9] = raws[7]._replace(log_ns=2**63), raws[9]._replace(log_ns=2**64 - 1)
    path = write_mcap(tmp_path / "late.mcap", raws, "ros2")
    with open_recording(path) as recording:
        samples = list(recording.read())
        late = [sample for sample in samples if "late_log_time" in sample.oddities]
        assert {(sample.t_ns, sample.received_ns) for sample in late} == {(2**63 - 1, 2**63 - 1)}
        assert {fact.count for fact in survey(recording) if fact.code == "late_log_time"} <= {1, 2}
    assert main(["inspect", str(path)]) == 0
    assert "beyond the year 2262" in capsys.readouterr().out
    assert main(["sync", str(path)]) == 3
    assert main(["inspect", str(path), "--offset", "/imu=1e30"]) == 2
    assert "no clock is a century off" in capsys.readouterr().err
    assert main(["inspect", str(path), "--distro", "humbug"]) == 2
    assert "must be one of dashing" in capsys.readouterr().err


@pytest.mark.parametrize("seconds", ["1e400", "1e30", "null", '"soon"', "NaN", "[1]"])
def test_a_stamp_in_json_that_is_no_time_spoils_its_message_only(tmp_path: Path, seconds: str) -> None:
    def raw(i: int, stamp: str) -> Raw:
        text = (
            f'{{"timestamp": {{"sec": {stamp}, "nsec": 5}}, "frame_id": "cam", "format": "jpeg", "data": "/9j/2Q=="}}'
        )
        schema = ("foxglove.CompressedImage", "jsonschema", b"{}")
        return Raw("/cam", schema, "json", START_NS + i * MS, text.encode())

    raws = [raw(i, seconds if i == 12 else str(START_NS // 10**9)) for i in range(20)]
    with open_recording(write_mcap(tmp_path / "a.mcap", raws)) as recording:
        kinds = [type(sample).__name__ for sample in recording.read()]
    assert kinds == ["ImageSample"] * 12 + ["Problem"] + ["ImageSample"] * 7
