"""Order, stamps, and the count of a stream's oddities."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from readers.clock import DAY_NS, SECOND_NS, StreamAudit, merge, reorder, sane_stamp, survey
from readers.streams import (
    UNKNOWN_VEC3,
    ImageSample,
    ImuSample,
    Problem,
    Recording,
    Sample,
    ScalarSample,
    StreamInfo,
    StreamKind,
)


def at(t_ns: int, received_ns: int | None = None, **fields: Any) -> ScalarSample:
    received_ns = t_ns if received_ns is None else received_ns
    return ScalarSample(stream="/s", t_ns=t_ns, received_ns=received_ns, value=0.0, **fields)


@pytest.mark.parametrize(
    ("header", "received", "sane"),
    [(0, 10, False), (-5, 10, False), (DAY_NS, 2 * DAY_NS, True), (DAY_NS - 1, 2 * DAY_NS, False), (7, 7, True)],
)
def test_sane_stamps(header: int, received: int, sane: bool) -> None:
    assert sane_stamp(header, received) is sane


@given(st.lists(st.tuples(st.integers(0, 10**11), st.integers(0, 999_999_999)), max_size=80), st.integers(-50, 50))
def test_reorder_sorts_what_is_late_by_less_than_the_window(pairs: list[tuple[int, int]], lag_s: int) -> None:
    lag = lag_s * SECOND_NS
    log = sorted((at(received - delay - lag, received) for received, delay in pairs), key=lambda s: s.received_ns)
    times = [sample.t_ns for sample in reorder(log, lag_ns=lag)]
    assert times == sorted(sample.t_ns for sample in log)


def test_reorder_holds_no_more_than_the_window() -> None:
    taken = 0

    def log() -> Iterator[Sample]:
        nonlocal taken
        for i in range(10_000):
            taken += 1
            yield at(i * 10_000_000, i * 10_000_000 + 1)

    ordered = reorder(log())
    next(ordered)
    assert taken <= 102


def test_reorder_passes_on_what_comes_too_late() -> None:
    log = [at(5 * SECOND_NS), at(9 * SECOND_NS), at(SECOND_NS, 10 * SECOND_NS)]
    assert [s.t_ns // SECOND_NS for s in reorder(log)] == [5, 1, 9]


def test_merge_keeps_the_order_of_sources_at_equal_times() -> None:
    first, second = [at(1), at(3)], [at(1), at(2)]
    assert [id(s) for s in merge(first, second)] == [id(s) for s in (first[0], second[0], second[1], first[1])]


def counts(samples: Sequence[Sample]) -> dict[str, int]:
    audit = StreamAudit("/s")
    for sample in samples:
        audit.add(sample)
    return {fact.code: fact.count for fact in audit.facts()}


def test_an_even_stream_has_no_facts() -> None:
    assert counts([at(i * 100) for i in range(10)]) == {}


def test_disorder_duplicates_and_gaps_are_counted() -> None:
    times = [0, 10, 20, 20, 30, 25, 40, 50, 200, 210]
    assert counts([at(t) for t in times]) == {"duplicate_stamp": 1, "out_of_order": 1, "gap": 1}


def test_a_gap_is_told_in_seconds() -> None:
    audit = StreamAudit("/s")
    for t in (0, 1, 2, 3, 10):
        audit.add(at(t * SECOND_NS))
    (fact,) = audit.facts()
    assert "the longest 7.000 s" in fact.sentence


def test_oddities_of_single_messages_are_counted_with_a_sentence_each() -> None:
    codes = ("foreign_stamp", "frozen_stamp", "zero_quaternion", "quaternion_norm", "identity_orientation")
    samples = [at(i, oddities=codes[: i + 1]) for i in range(5)]
    assert counts(samples) == {code: 5 - i for i, code in enumerate(codes)}


def test_a_zero_quaternion_that_a_reader_left_is_counted() -> None:
    sample = ImuSample(
        stream="/s",
        t_ns=1,
        received_ns=1,
        angular_velocity_radps=UNKNOWN_VEC3,
        linear_acceleration_mps2=UNKNOWN_VEC3,
        quat_xyzw=np.zeros(4),
    )
    assert counts([sample]) == {"zero_quaternion": 1}


def test_image_sizes_that_change_are_counted() -> None:
    images = [
        ImageSample(stream="/s", t_ns=i, received_ns=i, encoding="mono8", payload=b"", width_px=w, height_px=4)
        for i, w in enumerate((4, 4, 5, 5, 4))
    ]
    assert counts(images) == {"size_change": 2}


def test_images_that_cannot_be_decoded_are_counted_with_the_reason_of_the_first() -> None:
    def image(encoding: str, width_px: int = 4, step_bytes: int = 0) -> ImageSample:
        return ImageSample(
            stream="/s",
            t_ns=1,
            received_ns=1,
            encoding=encoding,
            payload=b"",
            width_px=width_px,
            height_px=4,
            step_bytes=step_bytes,
        )

    good = [image(name) for name in ("mono8", "YUYV", "jpeg", "JPG", "32FC1", "16UC1; compressedDepth png")]
    assert "bad_image" not in counts(good)
    bad = [image("zorro8"), image("mono8", width_px=0), image("bgr8", step_bytes=11), image("32FC1", step_bytes=15)]
    audit = StreamAudit("/s")
    for sample in [*good, *bad]:
        audit.add(sample)
    (fact,) = [fact for fact in audit.facts() if fact.code == "bad_image"]
    assert fact.count == 4
    assert "'zorro8': this encoding is not known; known are rgb8" in fact.sentence


class Listed(Recording):
    """A recording of one readable and one unreadable stream."""

    def __init__(self, samples: list[Sample], count: int) -> None:
        self._samples = samples
        self._count = count

    @property
    def streams(self) -> tuple[StreamInfo, ...]:
        return (
            StreamInfo(name="/s", kind=StreamKind.SCALAR, type="x", count=self._count),
            StreamInfo(name="/u", kind=StreamKind.UNKNOWN, type="y", count=5, readable=False, reason="no reader"),
        )

    def read(
        self, streams: Sequence[str] | None = None, start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[Sample]:
        return iter(self._samples)


def test_survey_reads_once_counts_and_tells_its_progress() -> None:
    problem = Problem(stream="/s", t_ns=2, received_ns=2, kind=StreamKind.SCALAR, reason="broken")
    calls: list[tuple[int, int]] = []
    samples: list[Sample] = [at(1), problem, *(at(3 + i) for i in range(2500))]
    facts = survey(Listed(samples, 2510), lambda done, total: calls.append((done, total)))
    assert {(f.stream, f.code): f.count for f in facts} == {("/s", "undecodable"): 1, ("/s", "count_differs"): 8}
    assert "8 messages fewer than the file states" in {f.sentence for f in facts}
    assert calls == [(1000, 2510), (2000, 2510), (2502, 2502)]


def test_survey_of_an_unknown_count_claims_no_difference() -> None:
    assert survey(Listed([at(1)], -1)) == ()
