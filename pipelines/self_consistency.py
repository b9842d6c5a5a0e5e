"""What an estimator's own data say of its drift, without a reference: replay backward, and revisits of a place.

Backward: the frames in reverse order are the same measurement taken the other way round, so that the increment from
frame k back to k - 1 must undo that from k - 1 to k. What does not agree is noise, failures and bias that depend on
the direction; a scale error or a fixed mounting angle is the same both ways and stays unseen.

Revisits: where the path comes back to a place, the motion between the two frames can be measured directly. The chain
of poses between them must end where that measurement does; what is left is the drift of the loop between them.

Poses are rows x, y, heading (m, m, rad); motions from pose i to pose j are in the body's axes at i.
"""

from __future__ import annotations

import dataclasses
import heapq
import math
from array import array
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from scipy.spatial import cKDTree

from pipelines.drift import DriftBudget, drift_budget
from pipelines.evaluation import Floats, Trajectory, motions, path_lengths
from pipelines.planar import wrap_angle
from readers.streams import (
    Camera,
    Damage,
    ImuSample,
    Landmark,
    OdometrySample,
    Recording,
    Sample,
    StreamError,
    StreamInfo,
)

CHUNK = 256
"""Samples that are held at once while a stream is read backward."""


# ------------------------------------------------------------------------------- backward


class Reversed(Recording):
    """A recording whose time runs backward: what was sampled at t comes at 2 · `pivot_ns` - t.

    Velocities and angular velocities change their sign, accelerations and poses stay. Samples of `held` streams are
    values that hold until the next one (a height, a scalar): each comes when, backward, its time begins, that is at
    the time of the one after it; the last one comes first of all, 1 ns before `pivot_ns`. Memory holds `CHUNK` samples
    a stream; the times of all samples are read once, in an own pass, 8 bytes each.

    Args:
        inner: the recording.
        streams: the streams that will be read.
        held: those of them whose values hold until the next one.
        start_ns: first sensor time that is used (included), None for the start.
        stop_ns: last sensor time (excluded), None for the end.

    Attributes:
        pivot_ns: the last time of the streams, at which backward and forward time are equal.

    Raises:
        StreamError: a stream is not in the recording, or there is no sample in the window.
    """

    def __init__(
        self,
        inner: Recording,
        streams: Sequence[str],
        *,
        held: Sequence[str] = (),
        start_ns: int | None = None,
        stop_ns: int | None = None,
    ) -> None:
        self.path, self.format, self.notes = inner.path, f"{inner.format}, backward", inner.notes
        self._inner, self._held = inner, frozenset(held)
        times = {name: array("q") for name in streams}
        for sample in inner.read(list(streams), start_ns, stop_ns):
            times[sample.stream].append(sample.t_ns)
        self._times = {name: np.unique(np.array(t)) for name, t in times.items()}
        if not any(map(len, self._times.values())):
            raise StreamError(f"{inner.path}: no sample of {', '.join(streams)} lies in the window to be read backward")
        self.pivot_ns = max(int(t[-1]) for t in self._times.values() if len(t))

    def mirrored(self, t_ns: int) -> int:
        """A forward time in backward time, and the other way round."""
        return 2 * self.pivot_ns - t_ns

    @property
    def streams(self) -> tuple[StreamInfo, ...]:
        """The streams; their times are those of the recording, forward."""
        return self._inner.streams

    @property
    def cameras(self) -> dict[str, Camera]:
        """The cameras of the recording."""
        return self._inner.cameras

    @property
    def landmarks(self) -> dict[int, Landmark]:
        """The landmarks of the recording."""
        return self._inner.landmarks

    @property
    def damage(self) -> tuple[Damage, ...]:
        """The damage of the recording."""
        return self._inner.damage

    def read(
        self, streams: Sequence[str] | None = None, start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[Sample]:
        """Yield the samples backward; the range is half-open in backward time.

        Raises:
            StreamError: a stream was not named when this was made.
        """
        names = list(self._times) if streams is None else list(streams)
        for name in names:
            if name not in self._times:
                raise StreamError(f"{self.path}: stream {name!r} was not prepared to be read backward")
        # of samples with equal times those that hold come last: backward, the frame was there before the next value
        names.sort(key=lambda name: name in self._held)
        merged = heapq.merge(*map(self._backward, names), key=lambda sample: sample.t_ns)
        for sample in merged:
            if stop_ns is not None and sample.t_ns >= stop_ns:
                return
            if start_ns is None or sample.t_ns >= start_ns:
                yield sample

    def _backward(self, name: str) -> Iterator[Sample]:
        """The samples of one stream, in backward time."""
        samples = self._latest_first(name)
        if name not in self._held:
            return (self._turned(sample, sample) for sample in samples)
        return self._holding(samples)

    def _holding(self, samples: Iterator[Sample]) -> Iterator[Sample]:
        last = next(samples, None)
        if last is None:
            return
        before_all = self.pivot_ns + 1
        yield self._turned(last, dataclasses.replace(last, t_ns=before_all, received_ns=before_all))
        after = last
        for sample in samples:
            yield self._turned(sample, after)
            after = sample

    def _latest_first(self, name: str) -> Iterator[Sample]:
        times = self._times[name]
        for stop in range(len(times), 0, -CHUNK):
            first, last = int(times[max(stop - CHUNK, 0)]), int(times[stop - 1])
            yield from reversed(list(self._inner.read([name], first, last + 1)))

    def _turned(self, sample: Sample, at: Sample) -> Sample:
        """A sample in backward time, at the time of another one."""
        moved = dataclasses.replace(sample, t_ns=self.mirrored(at.t_ns), received_ns=self.mirrored(at.received_ns))
        if isinstance(moved, OdometrySample):
            return dataclasses.replace(
                moved,
                linear_velocity_mps=-moved.linear_velocity_mps,
                angular_velocity_radps=-moved.angular_velocity_radps,
            )
        if isinstance(moved, ImuSample):
            return dataclasses.replace(moved, angular_velocity_radps=-moved.angular_velocity_radps)
        return moved

    def close(self) -> None:
        """Release the file of the recording."""
        self._inner.close()


def in_forward_time(backward: Trajectory, pivot_ns: int) -> Trajectory:
    """The path of a backward replay, its poses in the order and at the times of the forward one."""
    return Trajectory(2 * pivot_ns - backward.t_ns[::-1], backward.pose[::-1].copy())


def forward_backward(forward: Trajectory, backward: Trajectory, pivot_ns: int) -> DriftBudget:
    """How far a forward and a backward replay disagree, increment by increment, and what that does to the end.

    The backward path, turned round, takes the place of the reference in `drift_budget`: `increment_error` is the
    disagreement of each increment, `contribution_m` what it moves at the end of the path, in metres. Frames that only
    one of the two judged are missing from it, or are several frames in one.

    Args:
        forward: the path of the forward replay.
        backward: that of the replay of a `Reversed` recording, at its own times.
        pivot_ns: `Reversed.pivot_ns`.

    Raises:
        EvaluationError: fewer than half of the forward frames are in the backward replay.
    """
    return drift_budget(forward, in_forward_time(backward, pivot_ns), method="nearest", max_gap_ns=0)


# -------------------------------------------------------------------------------- revisits


@dataclass(frozen=True, slots=True, kw_only=True)
class Revisit:
    """Two poses `first` < `second` of a path that lie close to one another, with `loop_m` of path between them.

    `apart_m` is their distance, `expected` [3] the motion from the first to the second by the chain.
    """

    first: int
    second: int
    loop_m: float
    apart_m: float
    expected: Floats = field(repr=False)


def revisits(
    path: Trajectory,
    *,
    within_m: float,
    loop_m: float,
    turn_rad: float = math.pi,
    at_most: int = 50,
) -> list[Revisit]:
    """Pairs of poses that lie within `within_m` of one another after at least `loop_m` of path, the closest first.

    The path is thinned to steps of an eighth of `within_m`, and of the pairs around one crossing, whose both poses lie
    within `within_m` of path of those of a closer pair, only the closest one is kept.

    Args:
        path: x, y, heading; NaN headings are refused.
        within_m: largest distance: what the images overlap by, plus the drift that is expected.
        loop_m: least path between the two.
        turn_rad: largest difference of the headings.
        at_most: how many pairs are given at most.

    Raises:
        ValueError: `within_m` or `loop_m` is not positive, or a heading is unknown.
    """
    if not within_m > 0 or not loop_m > 0:
        raise ValueError("within_m and loop_m must be positive")
    if not np.isfinite(path.pose).all():
        raise ValueError("revisits need the heading of every pose")
    along = path_lengths(path.pose[:, :2]) if len(path) else np.empty(0)
    steps = np.floor(along / (within_m / 8))
    thin = np.flatnonzero(np.diff(steps, prepend=-1) > 0)
    near = cKDTree(path.pose[thin, :2]).query_pairs(within_m, output_type="ndarray") if len(thin) else np.empty((0, 2))
    pairs = thin[near.astype(np.int64)]
    pairs.sort(axis=1)
    motion = motions(path.pose, pairs[:, 0], pairs[:, 1])
    loop = along[pairs[:, 1]] - along[pairs[:, 0]]
    turn = np.abs((motion[:, 2] + np.pi) % (2 * np.pi) - np.pi)
    kept = np.flatnonzero((loop >= loop_m) & (turn <= turn_rad))
    apart = np.hypot(*motion[:, :2].T)
    order = kept[np.lexsort((pairs[kept, 1], pairs[kept, 0], apart[kept]))]
    chosen: list[int] = []
    taken = np.empty((0, 2))
    for k in order.tolist():
        place = along[pairs[k]]
        if len(taken) and (np.abs(taken - place) < within_m).all(axis=1).any():
            continue
        chosen.append(k)
        taken = np.vstack([taken, place])
        if len(chosen) == at_most:
            break
    return [
        Revisit(
            first=int(pairs[k, 0]),
            second=int(pairs[k, 1]),
            loop_m=float(loop[k]),
            apart_m=float(apart[k]),
            expected=np.array([*motion[k, :2], wrap_angle(float(motion[k, 2]))]),
        )
        for k in chosen
    ]


@dataclass(frozen=True, slots=True, kw_only=True)
class Loop:
    """A revisit whose motion was measured: what the chain between the two poses drifted by.

    `measured` [3] is the motion from the first to the second pose as the images show it. `drift` [3] is the chain's
    second pose, less where the measured motion puts it, in the body's axes at the first pose (m, m, rad).
    """

    revisit: Revisit
    measured: Floats = field(repr=False)
    drift: Floats

    @property
    def drift_m(self) -> float:
        """Length of the drift in metres."""
        return math.hypot(self.drift[0], self.drift[1])

    @property
    def share(self) -> float:
        """Drift over the path of the loop."""
        return self.drift_m / self.revisit.loop_m


Measure = Callable[[int, int, Floats], Floats | None]
"""Measures the motion [3] from pose `first` to pose `second`, near an expected one [3]; None if it cannot."""


def close_loops(found: Iterable[Revisit], measure: Measure) -> list[Loop]:
    """Measure revisits; those whose motion cannot be measured are left out.

    Args:
        found: the pairs of poses, such as `revisits` gives them.
        measure: the estimator's own matcher, such as `pipelines.correlation.revisit.ImageMotions`.
    """
    loops = []
    for revisit in found:
        measured = measure(revisit.first, revisit.second, revisit.expected)
        if measured is not None:
            drift = revisit.expected - measured
            loops.append(
                Loop(
                    revisit=revisit,
                    measured=measured,
                    drift=np.array([drift[0], drift[1], wrap_angle(float(drift[2]))]),
                )
            )
    return loops


@dataclass(frozen=True, slots=True, kw_only=True)
class Suspect:
    """A stretch of poses, `start` excluded and `stop` included, that may have made the drift of loops.

    `loops` is how many go over it and `mean_m` their mean drift. `explained` is the share of the squared drift of all
    loops that one error in this stretch explains, which the loops over it have and the others do not: 1 at best, below
    0 where that is worse than no error at all.
    """

    start: int
    stop: int
    loops: int
    mean_m: float
    explained: float


def suspects(loops: Sequence[Loop]) -> list[Suspect]:
    """The stretches of the path between the ends of loops, the likeliest source of the drift first.

    An error in a stretch shows in every loop that goes over it, and in no other. Several errors in different stretches
    are told apart only as far as loops part them; a slow drift all along the path explains itself by none of them.
    """
    ends = sorted({end for loop in loops for end in (loop.revisit.first, loop.revisit.second)})
    drift = np.array([loop.drift_m for loop in loops])
    total = float(drift @ drift)
    first, second = (np.array([getattr(loop.revisit, end) for loop in loops]) for end in ("first", "second"))
    result = []
    for start, stop in pairwise(ends):
        over = (first <= start) & (stop <= second)
        if not over.any() or not total > 0:
            continue
        mean = float(drift[over].mean())
        unexplained = float(np.sum((drift - mean * over) ** 2))
        result.append(
            Suspect(start=start, stop=stop, loops=int(over.sum()), mean_m=mean, explained=1 - unexplained / total)
        )
    return sorted(result, key=lambda s: (-s.explained, s.stop - s.start, s.start))
