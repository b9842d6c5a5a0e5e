"""When a sensor measures, what its clock says, and when its messages reach the log.

All differences are computed in seconds since the mission's start and rounded once to whole nanoseconds;
absolute times are integers throughout.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from pipelines.simulation.channels import Longs, rng_of
from pipelines.simulation.checks import check
from pipelines.simulation.faults import DroppedFrames, DuplicateFrames, Fault, LateImages, SwappedStamps, of_kind

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]
Array = TypeVar("Array", bound=NDArray[Any])


@dataclass(frozen=True, slots=True, kw_only=True)
class Timing:
    """A sensor's rate, its clock and its way to the log; by default exact and without delay.

    Attributes:
        rate_hz: measurements per second of true time.
        start_s: true time of the first measurement since the mission's start.
        latency_s: what every message needs to the log.
        latency_jitter_s: mean (and standard deviation) of an exponential delay on top of it. Messages queue:
            none overtakes another by this, so that one late message holds up those behind it.
        drop_share: share of the messages that never arrive.
        duplicate_share: share of the messages that arrive twice, with one stamp.
        clock_offset_s: what the sensor's clock is ahead of the log's at the mission's start.
        clock_drift_ppm: what it gains since, in µs per second.
        stamp_jitter_s: standard deviation of the stamps about the sensor's clock.
        disorder_share: share of the messages that are overtaken by the next one on the way to the log, so
            that their stamps are out of order there; at most 0.5, every other one.

    Raises:
        ValueError: a parameter is out of its range; the text names it.
    """

    rate_hz: float
    start_s: float = 0.0
    latency_s: float = 0.0
    latency_jitter_s: float = 0.0
    drop_share: float = 0.0
    duplicate_share: float = 0.0
    clock_offset_s: float = 0.0
    clock_drift_ppm: float = 0.0
    stamp_jitter_s: float = 0.0
    disorder_share: float = 0.0

    def __post_init__(self) -> None:
        check(self, "above 0", "rate_hz")
        check(self, "0 or more", "start_s", "latency_s", "latency_jitter_s", "stamp_jitter_s")
        check(self, "a share within 0 and 1", "drop_share", "duplicate_share")
        check(self, "a share within 0 and 0.5", "disorder_share")
        check(self, "a finite number", "clock_drift_ppm")
        check(self, "within ±1e9", "clock_offset_s")  # so that stamps stay whole nanoseconds of 64 bits

    def times_s(self, duration_s: float) -> Floats:
        """True times ``start_s + k / rate_hz`` [n] of all measurements of a mission, its end included.

        Raises:
            ValueError: the mission ends before the first measurement.
        """
        if duration_s < self.start_s:
            raise ValueError(f"Timing: start_s is {self.start_s!r}, the mission of {duration_s!r} s is over by then")
        last = int((duration_s - self.start_s) * self.rate_hz + 1e-6)  # the end itself, whatever the last digit
        return np.minimum(self.start_s + np.arange(last + 1) / self.rate_hz, duration_s)


@dataclass(frozen=True, slots=True, kw_only=True)
class Schedule:
    """n measurements, and the m messages that carry them, in the order of their arrival.

    Attributes:
        t_s: true time of each measurement, in seconds since the mission's start [n].
        number: which measurement each message carries [m].
        stamp_ns: the sensor's own time of each message [m].
        received_ns: the log's time of each message, rising by at least 1 ns [m].
    """

    t_s: Floats
    number: Longs
    stamp_ns: Longs
    received_ns: Longs


def schedule(
    timing: Timing, *, duration_s: float, start_ns: int, seed: int, stream: str, faults: Sequence[Fault] = ()
) -> Schedule:
    """Measurements and messages of one stream of a mission that starts at `start_ns` of the log's time.

    With t the true time since the start, the stamp is t + offset + drift · t + jitter, and the message is
    received at t + latency + delay, not before the one ahead of it.

    Faults that act, on whatever stream they are passed for: `DroppedFrames`; `DuplicateFrames`, where the last
    measurement that was sent before is sent again with the stamps of the new ones; `LateImages`, which come
    and are stamped later; `SwappedStamps`, where messages in pairs carry each other's stamps.

    Raises:
        ValueError: the mission ends before the first measurement.
    """
    dice = partial(rng_of, seed, stream)
    t_s = timing.times_s(duration_s)
    n = len(t_s)
    late_s = _lateness(faults, t_s)
    delay_s = timing.latency_s + timing.latency_jitter_s * dice("latency").standard_exponential(n)
    jitter_s = timing.stamp_jitter_s * dice("stamp").standard_normal(n)
    clock_s = timing.clock_offset_s + 1e-6 * timing.clock_drift_ppm * t_s
    taken_ns = start_ns + _whole_ns(t_s)

    sent = (dice("drop").random(n) >= timing.drop_share) & ~during(of_kind(faults, DroppedFrames), t_s)
    kept = np.flatnonzero(sent)
    number = _shown(sent, during(of_kind(faults, DuplicateFrames), t_s))[kept]
    stamp_ns = (taken_ns + _whole_ns(late_s + jitter_s + clock_s))[kept]
    received_ns = (taken_ns + _whole_ns(late_s + delay_s))[kept]
    for fault in of_kind(faults, SwappedStamps):
        stamp_ns = _swapped(stamp_ns, np.flatnonzero(during([fault], t_s[kept])))

    overtaken = 2 * np.flatnonzero(dice("disorder").random(n)[: len(kept) // 2] < 2 * timing.disorder_share)
    pairs = np.ravel(np.column_stack([overtaken, overtaken + 1]))
    twice = 1 + (dice("duplicate").random(n)[: len(kept)] < timing.duplicate_share)
    return Schedule(
        t_s=frozen(t_s),
        number=frozen(np.repeat(_swapped(number, pairs), twice)),
        stamp_ns=frozen(np.repeat(_swapped(stamp_ns, pairs), twice)),
        received_ns=frozen(_queued(np.repeat(received_ns, twice))),
    )


def during(faults: Iterable[Fault], t_s: Floats) -> Flags:
    """Whether any of the faults is there at times [n]."""
    held = np.zeros(len(t_s), dtype=bool)
    for fault in faults:
        held |= (fault.start_s <= t_s) & (t_s < fault.stop_s)
    return held


def frozen(array: Array) -> Array:
    """The same array, from now on read-only."""
    array.setflags(write=False)
    return array


def _whole_ns(seconds: Floats) -> Longs:
    return np.rint(1e9 * seconds).astype(np.int64)


def _lateness(faults: Sequence[Fault], t_s: Floats) -> Floats:
    """What `LateImages` adds to stamp and arrival of each measurement [n]."""
    late_s = np.zeros(len(t_s))
    for fault in of_kind(faults, LateImages):
        late_s += fault.latency_s * during([fault], t_s)
    return late_s


def _shown(sent: Flags, repeated: Flags) -> Longs:
    """Which measurement goes out for each [n]: itself, or the last one sent before the repeats began."""
    fresh = np.where(sent & ~repeated, np.arange(len(sent)), 0)
    return np.where(repeated, np.maximum.accumulate(fresh), np.arange(len(sent)))


def _swapped(values: Longs, places: Longs) -> Longs:
    """The values with those at the first and second, third and fourth, … of the places exchanged."""
    pairs = places[: len(places) // 2 * 2].reshape(-1, 2)
    swapped = values.copy()
    swapped[pairs] = values[pairs[:, ::-1]]
    return swapped


def _queued(times_ns: Longs) -> Longs:
    """The times at which messages leave a queue that they come to at `times_ns`: 1 ns or more apart, in order."""
    steps = np.arange(len(times_ns))
    return np.maximum.accumulate(times_ns - steps) + steps
