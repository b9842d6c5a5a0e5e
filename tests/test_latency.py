"""The latency buffer: what arrives late is put in its place, or counted; and what the range filter makes of both."""

import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest
from made_ranges import (
    alarms,
    asynchronous_batch,
    asynchronous_samples,
    asynchronous_settings,
    replayed,
)

from pipelines.latency import LatencyBuffer
from pipelines.ranging.range_filter import RangeFilter
from pipelines.replay import Replayed, replay
from pipelines.verdict import Verdict
from readers import open_recording
from readers.streams import RecordingError, Sample, StreamKind
from tests.toys import ToyRecording
from workbench.cli import main
from workbench.range_inputs import Streams, latency_of

INPUTS = ("imu", "odometry")
MS = 1_000_000


def sample(stream: str, t_ns: int, received_ns: int | None = None) -> Sample:
    return Sample(stream=stream, t_ns=t_ns, received_ns=t_ns if received_ns is None else received_ns)


def given(buffer: LatencyBuffer, samples: Sequence[Sample], inputs: Sequence[str] = ()) -> list[tuple[str, int]]:
    return [(s.stream, s.t_ns) for s in buffer.through(samples, inputs)]


# ----------------------------------------------------------------------------------- the buffer


def test_late_samples_are_put_in_their_place_and_later_ones_counted() -> None:
    arrived = [sample("a", t) for t in (0, 10, 20, 15, 30, 5, 40)]
    buffer = LatencyBuffer(wait_ns=10)
    assert [t for _, t in given(buffer, arrived)] == [0, 10, 15, 20, 5, 30, 40]
    assert buffer.late == {"a": 1}
    assert buffer.facts() == ["a: 1 messages came too late for the latency buffer of 1e-08 s"]
    enough = LatencyBuffer(wait_ns=25)
    assert [t for _, t in given(enough, arrived)] == [0, 5, 10, 15, 20, 30, 40]
    assert not enough.late


def test_a_sample_waits_until_one_is_later_by_the_buffer_and_no_longer() -> None:
    pulled: list[int] = []

    def source() -> Iterator[Sample]:
        for t in range(0, 100, 10):
            pulled.append(t)
            yield sample("a", t)

    out = LatencyBuffer(wait_ns=30).through(source())
    assert next(out).t_ns == 0
    assert pulled == [0, 10, 20, 30]


def test_of_equal_times_frames_come_last() -> None:
    arrived = [sample("frames", 10), sample("b", 10), sample("a", 10), sample("a", 20)]
    assert given(LatencyBuffer(wait_ns=5, frames=["frames"]), arrived)[:3] == [("b", 10), ("a", 10), ("frames", 10)]


@pytest.mark.parametrize("delay_ns", [7, -7])
def test_a_streams_delay_moves_its_place_and_not_its_stamps(delay_ns: int) -> None:
    arrived = [s for t in range(0, 50, 10) for s in (sample("a", t), sample("frames", t))]
    buffer = LatencyBuffer(wait_ns=7, frames=["frames"], delay_ns={"frames": delay_ns})
    found = given(buffer, arrived)
    assert found == sorted(found, key=lambda s: s[1] - delay_ns * (s[0] == "frames"))
    assert sorted(found) == sorted((s.stream, s.t_ns) for s in arrived)


def test_a_frame_waits_for_the_next_message_of_each_input() -> None:
    arrived = [sample("a", 0), sample("b", 0), sample("frames", 5), sample("a", 10), sample("b", 20), sample("a", 30)]
    ahead = LatencyBuffer(wait_ns=50, frames=["frames"], look_ahead=True)
    assert given(ahead, arrived, ["a", "b"]) == [("a", 0), ("b", 0), ("a", 10), ("b", 20), ("frames", 5), ("a", 30)]
    brief = LatencyBuffer(wait_ns=12, frames=["frames"], look_ahead=True)
    assert given(brief, arrived, ["a", "b"]).index(("frames", 5)) == 3  # b's comes too late for it


@pytest.mark.parametrize("look_ahead", [False, True])
def test_an_error_of_the_reader_comes_after_what_was_held(look_ahead: bool) -> None:
    def broken() -> Iterator[Sample]:
        yield from (sample("a", 0), sample("frames", 1), sample("a", 2))
        raise RecordingError("x", "it ends", "nothing")

    out = LatencyBuffer(wait_ns=100, frames=["frames"], look_ahead=look_ahead).through(broken(), ["a"])
    assert sorted(next(out).t_ns for _ in range(3)) == [0, 1, 2]
    with pytest.raises(RecordingError, match="it ends"):
        next(out)


def test_a_negative_wait_is_refused() -> None:
    with pytest.raises(ValueError, match="wait_ns must be 0 or more, not -1"):
        LatencyBuffer(wait_ns=-1)


# ------------------------------------------------------------------------------------- the filter


def shuffled(samples: Sequence[Sample], longest_ns: int, seed: int = 4) -> list[Sample]:
    """The samples with a lateness of each of its own, in the order in which they then arrive."""
    late = np.random.default_rng(seed).integers(0, longest_ns, len(samples)).tolist()
    arrived = [dataclasses.replace(s, received_ns=s.t_ns + by) for s, by in zip(samples, late, strict=True)]
    return sorted(arrived, key=lambda s: s.received_ns)


def test_bar_shuffled_arrivals_give_the_ranges_of_the_order_to_the_last_digit() -> None:
    samples, settings = asynchronous_samples("hold-both", 0), asynchronous_settings("hold-both")
    arrived = shuffled(samples, 150 * MS)
    plain = replayed(settings, samples)
    long = LatencyBuffer(wait_ns=150 * MS, frames=["tracks"])
    sorted_again = replayed(settings, long.through(arrived))
    assert [s.range_m[0] for s in sorted_again] == [s.range_m[0] for s in plain]
    assert not alarms(sorted_again) & Verdict.INPUT_OUT_OF_ORDER
    assert not long.late
    short = LatencyBuffer(wait_ns=20 * MS, frames=["tracks"])
    too_short = replayed(settings, short.through(arrived))
    assert sum(Verdict.INPUT_OUT_OF_ORDER in s.alarms for s in too_short) > 20
    assert short.late["odometry"] > 20
    assert len(short.facts()) == 3


def test_a_speed_that_comes_after_its_frame_rings_even_if_its_own_order_is_right() -> None:
    samples, settings = asynchronous_samples("hold-both", 0), asynchronous_settings("hold-both")

    def arrival(one: Sample) -> int:
        return one.t_ns + 70 * MS * (one.stream == "odometry")

    steps = replayed(settings, sorted(samples, key=arrival))
    assert sum(Verdict.INPUT_OUT_OF_ORDER in s.alarms for s in steps) > 50
    assert not alarms(replayed(settings, samples)) & Verdict.INPUT_OUT_OF_ORDER


def test_midpoint_has_the_message_after_the_frame() -> None:
    settings, samples = asynchronous_settings("midpoint"), asynchronous_samples("midpoint", 0)
    buffer = LatencyBuffer(wait_ns=200 * MS, frames=["tracks"], look_ahead=True)
    found = np.array([s.mean[0] for s in replayed(settings, buffer.through(shuffled(samples, 150 * MS), INPUTS))])
    np.testing.assert_allclose(found, asynchronous_batch("midpoint").mean[0], rtol=2e-6)
    # there messages and frames coincide; without those that do the next one counts
    frames = {s.t_ns for s in samples if s.stream == "tracks"}
    apart = [s for s in samples if s.stream != "odometry" or s.t_ns not in frames or s.t_ns == samples[0].t_ns]
    buffered = replayed(settings, buffer.through(shuffled(apart, 150 * MS), INPUTS))
    in_hindsight = replayed(settings, sorted(apart, key=lambda s: s.t_ns + 500 * MS * (s.stream == "tracks")))
    at_once = replayed(settings, apart)
    assert [s.range_m[0] for s in buffered] == [s.range_m[0] for s in in_hindsight]
    assert abs(at_once[5].range_m[0] / buffered[5].range_m[0] - 1) > 1e-4


@pytest.mark.parametrize("delay_s", [0.05, -0.05])
def test_frames_with_shifted_stamps_are_put_right_by_the_delay(delay_s: float) -> None:
    samples, settings = asynchronous_samples("hold-both", 0), asynchronous_settings("hold-both")
    shift_ns = round(1e9 * delay_s)
    wrong = [dataclasses.replace(s, t_ns=s.t_ns + shift_ns * (s.stream == "tracks")) for s in samples]
    wrong.sort(key=lambda s: s.t_ns)
    cured = settings.model_copy(update={"camera_delay_s": delay_s})
    streams = Streams("tracks", StreamKind.TRACK, "", *INPUTS[::-1], ())
    buffer = latency_of(cured, streams)
    assert buffer is not None
    assert not buffer.by_arrival
    plain, steps = replayed(settings, samples), replayed(cured, buffer.through(wrong, INPUTS))
    assert [s.t_ns for s in steps] == [s.t_ns for s in plain]
    assert [s.range_m[0] for s in steps] == [s.range_m[0] for s in plain]
    off = replayed(settings, wrong)
    assert abs(off[-1].range_m[0] / plain[-1].range_m[0] - 1) > 1e-3
    assert latency_of(settings, streams) is None


# ------------------------------------------------------------------------------------- the replay


class Arriving(ToyRecording):
    """A recording that reads by stamps, and knows the order of arrival."""

    def __init__(self, samples: Sequence[Sample]) -> None:
        kinds = {"imu": StreamKind.IMU, "odometry": StreamKind.ODOMETRY, "tracks": StreamKind.TRACK}
        super().__init__(sorted(samples, key=lambda s: (s.t_ns, s.stream)), kinds)

    def arrivals(self, streams: Sequence[str] | None = None) -> Iterator[Sample]:
        return iter(sorted(self.read(streams), key=lambda s: s.received_ns))


def test_the_replay_takes_messages_as_they_arrived_and_sorts_them() -> None:
    recording = Arriving(shuffled(asynchronous_samples("hold-both", 0), 150 * MS))
    settings = asynchronous_settings("hold-both")
    start_ns, stop_ns = 3_000 * MS, 9_000 * MS

    def ranges(latency: LatencyBuffer | None) -> list[Replayed]:
        return list(
            replay(
                recording,
                RangeFilter(settings),
                image_stream="tracks",
                other_streams=INPUTS,
                start_ns=start_ns,
                stop_ns=stop_ns,
                latency=latency,
            )
        )

    plain, buffered = ranges(None), ranges(LatencyBuffer(wait_ns=150 * MS, frames=["tracks"]))
    assert [r.sample.frame for r in plain] == [r.sample.frame for r in buffered] == list(range(10, 40))
    assert [r.step.range_m[0] for r in plain] == [r.step.range_m[0] for r in buffered]  # type: ignore[attr-defined]
    unsorted = ranges(LatencyBuffer(wait_ns=0, frames=["tracks"]))
    assert any(Verdict.INPUT_OUT_OF_ORDER in r.step.alarms for r in unsorted)


def test_a_log_gives_its_messages_as_they_were_logged(tmp_path: Path) -> None:
    brief = ("duration_s=0.6", "camera.width_px=64", "camera.height_px=48", "front.width_px=64", "front.height_px=48")
    file = tmp_path / "late.mcap"
    assert main(["simulate", "sensors", "-o", str(file), *(word for one in brief for word in ("--set", one))]) == 0
    names = ["/imu", "/wheel/odometry", "/front/tracks"]
    with open_recording(file) as log:
        arrived, by_stamp = list(log.arrivals(names)), list(log.read(names))
    assert {s.stream for s in arrived} == set(names)
    assert [s.received_ns for s in arrived] == sorted(s.received_ns for s in by_stamp)
    assert sorted(s.t_ns for s in arrived) == [s.t_ns for s in by_stamp] != [s.t_ns for s in arrived]
