"""Time: sane stamps, merging by time, and the oddities of a stream's clock, counted.

All times are integer nanoseconds.
"""

from __future__ import annotations

import heapq
import statistics
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from readers.streams import CameraInfo, Fact, ImageSample, Problem, Recording, Sample, StreamKind

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
    heap: list[tuple[int, int, Sample]] = []
    for number, sample in enumerate(samples):
        heapq.heappush(heap, (sample.t_ns, number, sample))
        horizon = sample.received_ns - lag_ns - window_ns
        while heap and heap[0][0] <= horizon:
            yield heapq.heappop(heap)[2]
    while heap:
        yield heapq.heappop(heap)[2]


def merge(*sources: Iterable[Sample]) -> Iterator[Sample]:
    """Merge sources that are each in the order of `t_ns`; equal stamps keep the order of the sources."""
    return heapq.merge(*sources, key=lambda sample: sample.t_ns)


@dataclass(slots=True)
class StreamAudit:
    """Counts what is odd in one stream while its samples pass by in the order of reading.

    Feed every sample to `add`, then read `facts()`. Memory: 16 bytes a sample.
    """

    stream: str
    counts: Counter[str] = field(default_factory=Counter)
    first_ns: int = -1
    last_ns: int = -1
    samples: int = 0
    longest_gap_ns: int = 0
    size_px: tuple[int, int] = (0, 0)
    _steps_ns: list[int] = field(default_factory=list)

    def add(self, sample: Sample) -> None:
        """Take note of the next sample of this stream."""
        self.samples += 1
        self.counts.update(sample.oddities)
        if isinstance(sample, Problem):
            self.counts["undecodable"] += 1
            return
        if self.last_ns >= 0:
            step = sample.t_ns - self.last_ns
            if step < 0:
                self.counts["out_of_order"] += 1
            elif step == 0:
                self.counts["duplicate_stamp"] += 1
            else:
                self._steps_ns.append(step)
        else:
            self.first_ns = sample.t_ns
        self.last_ns = max(self.last_ns, sample.t_ns)
        quat = getattr(sample, "quat_xyzw", None)
        if quat is not None and not np.any(quat):
            self.counts["zero_quaternion"] += 1
        if isinstance(sample, ImageSample) and sample.width_px:
            size = (sample.width_px, sample.height_px)
            if self.size_px not in ((0, 0), size):
                self.counts["size_change"] += 1
            self.size_px = size
        elif isinstance(sample, CameraInfo):
            self.size_px = (sample.camera.width_px, sample.camera.height_px)

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
            "foreign_stamp": "header stamps are of another epoch; log time was used",
            "frozen_stamp": "header stamps never advance; log time was used",
            "zero_quaternion": "quaternions are all zero and were read as unknown",
            "quaternion_norm": "quaternions are not of unit norm and were scaled",
            "identity_orientation": "orientations are the identity with zero covariance, as if never measured; kept",
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
    for name, size, against in listed:
        if against and size != (0, 0) and size not in against:
            found = " or ".join(f"{width} x {height} px" for width, height in sorted(against))
            sentence = f"the calibration is for {size[0]} x {size[1]} px, the images are {found}"
            yield Fact(stream=name, code="calibration_size", count=1, sentence=sentence)


def survey(recording: Recording, progress: Callable[[int, int], None] | None = None) -> tuple[Fact, ...]:
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
    return tuple(facts)
