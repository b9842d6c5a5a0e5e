"""Samples as they arrive → samples by stamp: what a buffer does that waits for late messages.

A live estimator that holds every message for a while before it uses it can put what comes late in its place. The
same buffer stands here between the reader and the estimator, so that a replay shows what such an estimator makes of
a log. The samples themselves are not altered.
"""

from __future__ import annotations

import heapq
from collections import Counter, deque
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field

from readers.streams import Sample

NS = 1e-9


@dataclass(frozen=True, slots=True, kw_only=True)
class LatencyBuffer:
    """Sorts samples by the time that they are of.

    A sample waits until one has come whose time is `wait_ns` later. One that is late by more goes on at once, out of
    order, and is counted. Of equal times frames come last, else the order of arrival holds.

    Attributes:
        wait_ns: how long a sample is held; the longest lateness that is cured.
        frames: streams whose samples are frames; the others are their inputs.
        delay_ns: of a stream what its stamps are late, by name: its samples are of the time `t_ns` less that.
        by_arrival: whether the replay gives the samples as they were received, not as the reader sorts them.
        look_ahead: hold every frame until the next message of each input has gone before it, at most `wait_ns`.
        late: how many samples of each stream came too late so far.
    """

    wait_ns: int
    frames: Collection[str] = ()
    delay_ns: Mapping[str, int] = field(default_factory=dict)
    by_arrival: bool = True
    look_ahead: bool = False
    late: Counter[str] = field(default_factory=Counter)

    def __post_init__(self) -> None:
        if self.wait_ns < 0:
            raise ValueError(f"wait_ns must be 0 or more, not {self.wait_ns}")

    @property
    def order(self) -> str:
        """In what order the samples come out, in words that are equal for equal orders."""
        late = ", ".join(f"{stream} {ns} ns late" for stream, ns in sorted(self.delay_ns.items()) if ns)
        parts = [f"{'arrival' if self.by_arrival else 'stamps'}, held for {self.wait_ns} ns", late]
        return "; ".join(part for part in (*parts, "frames look ahead" if self.look_ahead else "") if part)

    def through(self, samples: Iterable[Sample], inputs: Collection[str] = ()) -> Iterator[Sample]:
        """Give the samples on, by time; an error of the reader comes after all that came before it.

        Args:
            samples: as they arrive.
            inputs: the streams that a frame waits for if the buffer looks ahead.
        """
        by_time = self._by_time(samples)
        return self._with_next(by_time, inputs) if self.look_ahead else by_time

    def facts(self) -> list[str]:
        """What came too late, a sentence for each stream."""
        return [
            f"{stream}: {count} messages came too late for the latency buffer of {self.wait_ns * NS:g} s"
            for stream, count in sorted(self.late.items())
        ]

    def _time_ns(self, sample: Sample) -> int:
        return sample.t_ns - self.delay_ns.get(sample.stream, 0)

    def _by_time(self, samples: Iterable[Sample]) -> Iterator[Sample]:
        held: list[tuple[int, bool, int, Sample]] = []
        failed: list[Exception] = []
        newest_ns = given_ns = None
        for number, sample in enumerate(_caught(samples, failed)):
            time_ns = self._time_ns(sample)
            if given_ns is not None and time_ns < given_ns:
                self.late[sample.stream] += 1
                yield sample
                continue
            heapq.heappush(held, (time_ns, sample.stream in self.frames, number, sample))
            newest_ns = time_ns if newest_ns is None else max(newest_ns, time_ns)
            while held and held[0][0] <= newest_ns - self.wait_ns:
                given_ns, _, _, ready = heapq.heappop(held)
                yield ready
        while held:
            yield heapq.heappop(held)[-1]
        for error in failed:
            raise error

    def _with_next(self, samples: Iterable[Sample], inputs: Collection[str]) -> Iterator[Sample]:
        """Hold back the frames, in their order, until the inputs are past them."""
        waiting: deque[Sample] = deque()
        failed: list[Exception] = []
        reached_ns: dict[str, int | None] = dict.fromkeys(inputs)
        for sample in _caught(samples, failed):
            time_ns = self._time_ns(sample)
            while waiting and time_ns > self._time_ns(waiting[0]) + self.wait_ns:
                yield waiting.popleft()
            if sample.stream in self.frames:
                waiting.append(sample)
                continue
            yield sample
            if sample.stream in reached_ns:
                reached_ns[sample.stream] = time_ns
            while waiting and _all_past(reached_ns.values(), self._time_ns(waiting[0])):
                yield waiting.popleft()
        yield from waiting
        for error in failed:
            raise error


def _all_past(reached_ns: Iterable[int | None], time_ns: int) -> bool:
    return all(reached is not None and reached > time_ns for reached in reached_ns)


def _caught(samples: Iterable[Sample], failed: list[Exception]) -> Iterator[Sample]:
    """The samples up to an error, which is noted, so that what is held can go out before it is raised."""
    try:
        yield from samples
    except Exception as error:
        failed.append(error)
