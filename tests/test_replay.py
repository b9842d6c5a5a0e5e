"""The replay loop: order, frame numbers, windows, damage, errors, and the end of the decoding thread."""

import dataclasses
import threading
import time

import numpy as np
import pytest

from pipelines.replay import Replayed, grey_sample, replay
from pipelines.verdict import Verdict
from readers.streams import (
    ImageSample,
    LandmarkSample,
    Problem,
    RangeSample,
    RecordingError,
    Sample,
    StreamError,
    StreamKind,
    TrackSample,
)
from tests.toys import SIZE, ToyEstimator, ToyImage, ToyRecording, ToyStep, image


def twenty() -> ToyRecording:
    return ToyRecording([image(10 * n, n) for n in range(20)])


def frames(steps: list[Replayed]) -> list[int]:
    return [r.step.frame for r in steps]


def decoders() -> int:
    return sum(t.name.startswith("decode") for t in threading.enumerate())


def test_every_frame_makes_a_step_in_order() -> None:
    estimator = ToyEstimator()
    out = list(replay(twenty(), estimator, image_stream="/camera"))
    assert frames(out) == list(range(20))
    assert [r.step.mean for r in out] == list(range(20))
    assert all(r.sample.frame == r.step.frame and isinstance(r.sample, ToyImage) for r in out)
    assert estimator.threads == {threading.get_ident()}
    assert decoders() == 0


def test_the_estimator_gets_decoded_grey() -> None:
    seen: list[Sample] = []
    list(replay(ToyRecording([image(0, 7)]), ToyEstimator(seen=seen.append), image_stream="/camera"))
    (got,) = seen
    assert isinstance(got, ImageSample)
    assert (got.encoding, got.width_px, got.height_px, got.step_bytes) == ("mono8", SIZE[1], SIZE[0], SIZE[1])
    assert bytes(got.data) == bytes([7]) * 12


def test_sixteen_bits_stay_sixteen() -> None:
    grey = np.arange(12, dtype=np.uint16).reshape(SIZE) * 1000

    class Deep(ToyImage):
        __slots__ = ()

        def grey(self) -> np.ndarray:  # type: ignore[type-arg, override]
            return grey.T

    sample = Deep(**{f.name: getattr(image(0), f.name) for f in dataclasses.fields(ToyImage)})
    got = grey_sample(sample)
    assert isinstance(got, ImageSample)
    assert (got.encoding, got.step_bytes) == ("mono16", 6)
    np.testing.assert_array_equal(np.frombuffer(got.data, np.uint16).reshape(4, 3), grey.T)


@pytest.mark.parametrize("stride", [1, 3])
def test_a_window_keeps_the_frame_numbers(stride: int) -> None:
    out = list(replay(twenty(), ToyEstimator(), image_stream="/camera", start_ns=50, stop_ns=120, stride=stride))
    assert frames(out) == list(range(5, 12, stride))
    assert [r.step.t_ns for r in out] == [10 * n for n in range(5, 12, stride)]


def test_damaged_images_and_messages_reach_the_estimator_as_problems() -> None:
    lost = Problem(stream="/camera", t_ns=20, received_ns=20, kind=StreamKind.IMAGE, reason="short message")
    recording = ToyRecording([image(0), image(10, damaged=True), lost, image(30)])
    out = list(replay(recording, ToyEstimator(), image_stream="/camera"))
    assert [r.step.verdict for r in out] == [Verdict.OK, Verdict.UNDECODABLE, Verdict.UNDECODABLE, Verdict.OK]
    assert [isinstance(r.sample, Problem) for r in out] == [False, True, True, False]
    assert [r.sample.reason for r in out if isinstance(r.sample, Problem)] == ["image at 10: no bytes", "short message"]
    assert frames(out) == [0, 1, 2, 3]


def test_other_streams_come_between_the_frames_in_time() -> None:
    ranges = [
        RangeSample(
            stream="/height",
            t_ns=10 * n + 5,
            received_ns=0,
            range_m=1.0,
            min_range_m=0,
            max_range_m=9,
            field_of_view_rad=0,
        )
        for n in range(20)
    ]
    samples = sorted([*[image(10 * n) for n in range(20)], *ranges], key=lambda s: s.t_ns)
    recording = ToyRecording(samples, {"/camera": StreamKind.IMAGE, "/height": StreamKind.RANGE})
    seen: list[Sample] = []
    out = list(
        replay(recording, ToyEstimator(seen=seen.append), image_stream="/camera", other_streams=["/height"], stride=2)
    )
    assert frames(out) == list(range(0, 20, 2))
    times = [s.t_ns for s in seen]
    assert times == sorted(times)
    assert len(times) == 30


def test_reading_stays_a_bounded_number_of_images_ahead() -> None:
    recording = twenty()
    for n, _ in enumerate(replay(recording, ToyEstimator(), image_stream="/camera", decode_ahead=3)):
        assert recording.read_samples <= n + 1 + 3


def test_an_error_of_the_reader_comes_after_the_steps_before_it() -> None:
    error = RecordingError("toy", "the file ends", "record again")
    recording = ToyRecording([image(10 * n) for n in range(9)], fail_at=6, error=error)
    got: list[int] = []
    with pytest.raises(RecordingError) as caught:
        got.extend(r.step.frame for r in replay(recording, ToyEstimator(), image_stream="/camera"))
    assert got == [0, 1, 2, 3, 4, 5]
    assert caught.value.__notes__ == ["after frame 5 of /camera, sensor time 50 ns"]
    assert decoders() == 0


def test_an_error_of_the_estimator_names_frame_and_time() -> None:
    with pytest.raises(ZeroDivisionError) as caught:
        list(replay(twenty(), ToyEstimator(explode_at=4), image_stream="/camera"))
    assert caught.value.__notes__ == ["at frame 4 of /camera, sensor time 40 ns"]
    assert decoders() == 0


def test_images_that_take_longer_to_decode_keep_their_place() -> None:
    class Uneven(ToyImage):
        __slots__ = ()

        def grey(self) -> np.ndarray:  # type: ignore[type-arg, override]
            time.sleep(0.02 if self.t_ns % 3 == 0 else 0.0)
            return super().grey()

    fields = [f.name for f in dataclasses.fields(ToyImage)]
    uneven = [Uneven(**{name: getattr(image(n, n), name) for name in fields}) for n in range(30)]
    for threads in (1, 2, 5):
        seen: list[Sample] = []
        estimator = ToyEstimator(seen=seen.append)
        out = list(replay(ToyRecording(uneven), estimator, image_stream="/camera", decode_threads=threads))
        assert frames(out) == list(range(30))
        assert [sample.t_ns for sample in seen] == list(range(30))
        assert [bytes(s.data)[0] for s in seen if isinstance(s, ImageSample)] == [int(i.grey()[0, 0]) for i in uneven]


def test_closing_stops_the_decoding_thread_promptly() -> None:
    class Slow(ToyImage):
        __slots__ = ()

        def grey(self) -> np.ndarray:  # type: ignore[type-arg, override]
            time.sleep(0.05)
            return super().grey()

    fields = [f.name for f in dataclasses.fields(ToyImage)]
    slow = [Slow(**{name: getattr(image(n), name) for name in fields}) for n in range(100)]
    steps = replay(ToyRecording(slow), ToyEstimator(), image_stream="/camera", decode_ahead=50)
    next(steps)
    started = time.monotonic()
    steps.close()
    assert time.monotonic() - started < 0.5  # 50 images under way would take 2.5 s
    assert decoders() == 0


def test_progress_counts_steps() -> None:
    seen: list[tuple[int, int]] = []
    list(
        replay(twenty(), ToyEstimator(), image_stream="/camera", stride=5, on_progress=lambda n, t: seen.append((n, t)))
    )
    assert seen == [(1, 0), (2, 50), (3, 100), (4, 150)]


def test_bad_calls_are_refused_at_once() -> None:
    with pytest.raises(ValueError, match="stride"):
        replay(twenty(), ToyEstimator(), image_stream="/camera", stride=0)
    with pytest.raises(StreamError, match="/front"):
        replay(twenty(), ToyEstimator(), image_stream="/front")


# ------------------------------------------------------------------- frames that are no images


def track(t_ns: int, stream: str = "/tracks") -> TrackSample:
    return TrackSample(stream=stream, t_ns=t_ns, received_ns=t_ns, ids=np.array([1]), points_px=np.array([[t_ns, 2.0]]))


class Counting(ToyEstimator):
    """Makes a step of everything that has a frame's number."""

    def step(self, state: int, sample: Sample, /) -> tuple[int, ToyStep | None]:
        self.seen(sample)
        number = getattr(sample, "frame", -1)
        if number < 0:
            return state, None
        step = ToyStep(
            frame=number,
            t_ns=sample.t_ns,
            received_ns=sample.received_ns,
            verdict=Verdict.OK,
            alarms=Verdict.OK,
            mean=0.0,
            steps_before=state,
        )
        return state + 1, step


TRACKS = {"/tracks": StreamKind.TRACK, "/camera": StreamKind.IMAGE}


def test_tracks_and_landmarks_are_frames_with_numbers() -> None:
    seen = LandmarkSample(
        stream="/tracks",
        t_ns=30,
        received_ns=0,
        ids=np.array([4]),
        range_m=np.array([1.0]),
        bearing_rad=np.array([0.0]),
    )
    recording = ToyRecording([track(0), track(10), track(20), seen], TRACKS)
    out = list(replay(recording, Counting(), image_stream="/tracks", start_ns=10))
    assert frames(out) == [1, 2, 3]
    assert [getattr(one.sample, "frame", -1) for one in out] == [1, 2, 3]
    assert isinstance(out[0].sample, TrackSample)
    assert isinstance(out[2].sample, LandmarkSample)
    assert all(one.shown is None for one in out)


def test_shown_images_come_with_the_steps_and_not_to_the_estimator() -> None:
    given: list[Sample] = []
    # one image of the same stamp after its frame, two between frames, one that is damaged, none for the last frame
    samples: list[Sample] = [track(0), image(0, 7), image(3, 8), image(9, 9), track(10), image(20, damaged=True),
                             track(20), track(30)]  # fmt: skip
    out = list(
        replay(
            ToyRecording(samples, TRACKS),
            Counting(seen=given.append),
            image_stream="/tracks",
            shown_stream="/camera",
            stride=1,
        )
    )
    assert [None if one.shown is None else one.shown.t_ns for one in out] == [0, 9, 20, None]
    assert {type(sample) for sample in given} == {TrackSample}
    assert frames(out) == [0, 1, 2, 3]


def test_an_error_of_the_reader_does_not_swallow_the_step_that_waits_for_its_image() -> None:
    error = RecordingError("toy", "the file ends", "record again")
    recording = ToyRecording([track(10 * n) for n in range(4)], TRACKS, fail_at=3, error=error)
    got: list[int] = []
    with pytest.raises(RecordingError):
        got.extend(r.step.frame for r in replay(recording, Counting(), image_stream="/tracks", shown_stream="/camera"))
    assert got == [0, 1, 2]
    assert decoders() == 0
