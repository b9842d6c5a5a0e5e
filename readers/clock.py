"""Time: sane stamps, merging by time, and the oddities of a stream's clock, counted.

All times are integer nanoseconds.
"""

from __future__ import annotations

import heapq
import statistics
from array import array
from bisect import insort_right
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from operator import attrgetter
from typing import NamedTuple

import numpy as np

from readers.streams import CameraInfo, Fact, ImageError, ImageSample, Problem, Recording, Sample, StreamKind

SECOND_NS = 1_000_000_000
DAY_NS = 86_400 * SECOND_NS
REORDER_WINDOW_NS = SECOND_NS
GAP_FACTOR = 2.5


def sane_stamp(header_ns: int, received_ns: int) -> bool:
    """Whether a header stamp can be the sensor's time of a message that was logged at `received_ns`.

    A stamp of zero, or one more than a day away from the log time, is of another epoch.
    """
    return header_ns > 0 and abs(header_ns - received_ns) <= DAY_NS


def reorder(samples: Iterable[Sample], window_ns: int = REORDER_WINDOW_NS, *, lag_ns: int = 0) -> Iterator[Sample]:
    """Bring samples that come in log order into the order of `t_ns`, within a bounded delay.

    A sample waits until the log is `window_ns` further than its own stamp; one that comes later than
    that is passed on at once, out of order, and `StreamAudit` counts it. `lag_ns` is by how much the
    log time usually exceeds the stamps: zero unless the sensor's clock is another one.
    """
    waiting: deque[Sample] = deque()  # in order; most samples come in order
    delay_ns = lag_ns + window_ns
    for sample in samples:
        if waiting and sample.t_ns < waiting[-1].t_ns:
            insort_right(waiting, sample, key=attrgetter("t_ns"))
        else:
            waiting.append(sample)
        horizon = sample.received_ns - delay_ns
        while waiting and waiting[0].t_ns <= horizon:
            yield waiting.popleft()
    yield from waiting


def merge(*sources: Iterable[Sample]) -> Iterator[Sample]:
    """Merge sources that are each in the order of `t_ns`; equal stamps keep the order of the sources."""
    return heapq.merge(*sources, key=lambda sample: sample.t_ns)


JUMP_NS = SECOND_NS
LONGEST_NS = 2**62
ROLLOVERS = {
    "a counter of 32 bits in ns": 2**32,
    "a counter of 32 bits in µs": 2**32 * 1_000,
    "a counter of 32 bits in ms": 2**32 * 1_000_000,
    "a counter of 31 bits in µs": 2**31 * 1_000,
    "a counter of 31 bits in ms": 2**31 * 1_000_000,
    "a counter of 24 bits in µs": 2**24 * 1_000,
}
"""How long counters run before they begin anew, ns."""


class Lag(NamedTuple):
    """By how much log time exceeds another time, ns: of `messages`, the least, median and greatest."""

    messages: int
    least_ns: int
    median_ns: int
    greatest_ns: int

    @classmethod
    def of(cls, lags_ns: Sequence[int]) -> Lag:
        """Of the differences of single messages; zeros where there are none."""
        if not lags_ns:
            return cls(0, 0, 0, 0)
        return cls(len(lags_ns), min(lags_ns), int(statistics.median(lags_ns)), max(lags_ns))


@dataclass(slots=True)
class StreamAudit:
    """Counts what is odd in one stream while its samples pass by in the order of reading.

    Feed every sample to `add`, then read `facts()` and `lag`. Memory: 24 bytes a sample.
    """

    stream: str
    counts: Counter[str] = field(default_factory=Counter)
    first_ns: int = -1
    last_ns: int = -1
    samples: int = 0
    longest_gap_ns: int = 0
    longest_jump_ns: int = 0
    first_bad_image: str = ""
    size_px: tuple[int, int] = (0, 0)
    _steps_ns: array[int] = field(default_factory=lambda: array("q"))
    _lags_ns: array[int] = field(default_factory=lambda: array("q"))
    _publish_lags_ns: array[int] = field(default_factory=lambda: array("q"))
    _own: tuple[int, int] | None = None
    _rollovers: Counter[str] = field(default_factory=Counter)

    def add(self, sample: Sample) -> None:
        """Take note of the next sample of this stream."""
        self.samples += 1
        if sample.oddities:
            self.counts.update(sample.oddities)
        if isinstance(sample, Problem):
            self.counts["undecodable"] += 1
            return
        self._add_clocks(sample)
        if self.last_ns >= 0:
            step = sample.t_ns - self.last_ns
            if step < 0:
                self.counts["out_of_order"] += 1
            elif step == 0:
                self.counts["duplicate_stamp"] += 1
            else:
                self._steps_ns.append(min(step, LONGEST_NS))
        else:
            self.first_ns = sample.t_ns
        self.last_ns = max(self.last_ns, sample.t_ns)
        quat = getattr(sample, "quat_xyzw", None)
        if quat is not None and quat[3] == 0.0 and not np.any(quat):
            self.counts["zero_quaternion"] += 1
        if isinstance(sample, ImageSample):
            self._check_image(sample)
        if isinstance(sample, ImageSample) and sample.width_px:
            size = (sample.width_px, sample.height_px)
            if self.size_px not in ((0, 0), size):
                self.counts["size_change"] += 1
            self.size_px = size
        elif isinstance(sample, CameraInfo):
            self.size_px = (sample.camera.width_px, sample.camera.height_px)

    def _check_image(self, sample: ImageSample) -> None:
        try:
            sample.check()
        except ImageError as error:
            self.counts["bad_image"] += 1
            self.first_bad_image = self.first_bad_image or str(error)

    def _add_clocks(self, sample: Sample) -> None:
        """Take note of how the message's own stamp and its publish time stand to log time."""
        if sample.published_ns >= 0:
            if sane_stamp(sample.published_ns, sample.received_ns):
                self._publish_lags_ns.append(sample.received_ns - sample.published_ns)
            elif "foreign_publish_time" not in sample.oddities:
                self.counts["foreign_publish_time"] += 1
        if sample.header_ns < 0:
            return
        if sample.header_ns == 0 and "foreign_stamp" not in sample.oddities:
            self.counts["zero_stamp"] += 1
        elif sane_stamp(sample.header_ns, sample.received_ns):
            self._lags_ns.append(sample.received_ns - sample.header_ns)
        if self._own is not None:
            self._judge_step(sample.header_ns - self._own[0], sample.received_ns - self._own[1])
        self._own = sample.header_ns, sample.received_ns

    def _judge_step(self, own_ns: int, log_ns: int) -> None:
        """Whether the sensor's clock jumped between two messages, and whether it began anew from zero."""
        jump_ns = own_ns - log_ns
        if -JUMP_NS <= own_ns <= max(log_ns, 0) + JUMP_NS:
            return
        for counter, length_ns in ROLLOVERS.items():
            if abs(jump_ns + length_ns) <= JUMP_NS + length_ns // 1000:
                self.counts["stamp_rollover"] += 1
                self._rollovers[counter] += 1
                return
        self.counts["clock_jump"] += 1
        self.longest_jump_ns = max(self.longest_jump_ns, jump_ns, key=abs)

    @property
    def lag(self) -> Lag:
        """By how much log time exceeds the messages' own sane stamps."""
        return Lag.of(self._lags_ns)

    @property
    def publish_lag(self) -> Lag:
        """By how much log time exceeds sane publish times."""
        return Lag.of(self._publish_lags_ns)

    def facts(self) -> tuple[Fact, ...]:
        """The oddities met so far, each with its count and a sentence."""
        found = dict(self.counts)
        if len(self._steps_ns) >= 3:
            usual = statistics.median(self._steps_ns)
            gaps = [s for s in self._steps_ns if s > GAP_FACTOR * usual]
            if gaps:
                found["gap"] = len(gaps)
                self.longest_gap_ns = max(gaps)
        sentences = {
            "undecodable": "messages could not be decoded",
            "out_of_order": "stamps lie before an earlier one",
            "duplicate_stamp": "stamps repeat the one before",
            "zero_stamp": "header stamps are 0",
            "clock_jump": "times the header stamps jump by more than a second against log time, "
            f"at most by {self.longest_jump_ns / 1e9:+.3f} s",
            "stamp_rollover": f"times the header stamps begin anew, as {' and '.join(self._rollovers)} does",
            "foreign_publish_time": "publish times are of another epoch than log time",
            "late_log_time": "log times lie beyond the year 2262, where 64 bits end; the last moment was used",
            "foreign_stamp": "header stamps are of another epoch; log time was used",
            "frozen_stamp": "header stamps never advance; log time was used",
            "zero_quaternion": "quaternions are all zero and were read as unknown",
            "quaternion_norm": "quaternions are not of unit norm and were scaled",
            "identity_orientation": "orientations are the identity with zero covariance, as if never measured; kept",
            "spare_bytes": "images hold more bytes than their rows and step make; the rest was left out",
            "bad_image": f"images cannot be decoded, the first of {self.first_bad_image}",
            "size_change": "images differ in size from the one before",
            "gap": f"gaps are longer than {GAP_FACTOR:g} usual steps, the longest {self.longest_gap_ns / 1e9:.3f} s",
        }
        return tuple(
            Fact(stream=self.stream, code=code, count=n, sentence=f"{n} {sentences[code]}")
            for code, n in sorted(found.items())
        )


def _size_facts(recording: Recording, audits: Mapping[str, StreamAudit]) -> Iterator[Fact]:
    """Calibrations for another size than the images have: that of their own images, else that of any."""
    images = {info.name: audits[info.name].size_px for info in recording.of_kind(StreamKind.IMAGE)}
    sizes = {size for size in images.values() if size != (0, 0)}
    made_for = {info.name: audits[info.name].size_px for info in recording.of_kind(StreamKind.CAMERA)}
    listed = [(name, size, sizes) for name, size in made_for.items()]
    if not listed:
        cameras = recording.cameras.items()
        listed = [
            (name, (camera.width_px, camera.height_px), {images[name]} & sizes)
            for name, camera in cameras
            if name in images
        ]
    for name, camera in recording.cameras.items():
        if not camera.calibrated:
            yield Fact(stream=name, code="calibration_empty", count=1, sentence="the calibration has no focal length")
    for name, size, against in listed:
        if against and size != (0, 0) and size not in against:
            found = " or ".join(f"{width} x {height} px" for width, height in sorted(against))
            sentence = f"the calibration is for {size[0]} x {size[1]} px, the images are {found}"
            yield Fact(stream=name, code="calibration_size", count=1, sentence=sentence)


class Survey(NamedTuple):
    """What reading a recording once tells of its streams: oddities, and each stream's audit by name."""

    facts: tuple[Fact, ...]
    audits: Mapping[str, StreamAudit]


def survey(recording: Recording, progress: Callable[[int, int], None] | None = None) -> tuple[Fact, ...]:
    """The oddities that `examine` finds."""
    return examine(recording, progress).facts


def examine(recording: Recording, progress: Callable[[int, int], None] | None = None) -> Survey:
    """Read every readable stream once, without decoding images, and count what is odd.

    `progress` is called about every thousand samples with the number read and the number expected.

    Raises:
        RecordingError: nothing more of the file can be read.
    """
    readable = [info for info in recording.streams if info.readable]
    audits = {info.name: StreamAudit(info.name) for info in readable}
    expected = sum(max(info.count, 0) for info in readable)
    done = 0
    for done, sample in enumerate(recording.read(), start=1):
        audits[sample.stream].add(sample)
        if progress is not None and done % 1000 == 0:
            progress(done, max(done, expected))
    if progress is not None:
        progress(done, done)
    facts = [fact for info in readable for fact in audits[info.name].facts()]
    facts += _size_facts(recording, audits)
    for info in readable:
        missing = info.count - audits[info.name].samples
        if info.count >= 0 and missing:
            sentence = f"{abs(missing)} messages {'fewer' if missing > 0 else 'more'} than the file states"
            facts.append(Fact(stream=info.name, code="count_differs", count=abs(missing), sentence=sentence))
    return Survey(tuple(facts), audits)
