"""The best ranges after a mission: all that the filter was given, smoothed as one (`smoother.py`).

`MissionLog` notes while the filter runs: the way to every frame interval by interval, the image points that the gate
accepted, and what was believed of each landmark where it started. `smoothed` then finds the most probable lives of all
landmarks together with the errors of the speeds, which all of them share. The equations are always the exact ones.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipelines.ranging import smoother
from pipelines.ranging.filter import Outcome, Status
from pipelines.ranging.range_filter import RangeFilter, RangeState
from pipelines.ranging.range_settings import JOINT_LIMIT, MotionModel, RangeSettings
from pipelines.ranging.robot_motion import Ride, noise_of
from pipelines.ranging.settings import Flow, GainForm, Model, TransitionForm
from pipelines.ranging.smoother import Drive, Lives
from pipelines.ranging.step import RangeStep
from pipelines.verdict import Verdict
from readers.streams import Sample, StreamKind

Floats = NDArray[np.float64]
Longs = NDArray[np.int64]

MEMORY_BYTES = 2**30
"""What smoothing may take; landmarks are smoothed in groups of as many slots as this allows, up to `JOINT_LIMIT`."""
MAX_ITERATIONS, TOLERANCE = 60, 1e-5
"""Of the search, see `smoother.most_probable`; logs whose noise is not what the settings say take many."""
HALVINGS = 12
"""So often is the ξ halved that a search starts from, until the landmark stays before the camera."""


@dataclass
class Life:
    """One life of a landmark, from its start or its reset to its last accepted image point.

    Attributes:
        number: of the landmark.
        slot: where it was.
        born: number of its first frame in the log.
        mean: X̂ there [3].
        covariance: P there [3, 3].
        path: what the filter said at every frame since, X one after another; it may go on after the last point.
        at: numbers of the frames with accepted image points.
        pixel: these points, x, y, one after another.
        variance: of their coordinates, px².
        sigma_xi: how sure the filter was of ξ after these frames.
        counted: 1 where its range counted.
        parallax_px: the largest derotated parallax.
    """

    number: int
    slot: int
    born: int
    mean: Floats
    covariance: Floats
    path: array[float] = field(default_factory=lambda: array("d"))
    at: array[int] = field(default_factory=lambda: array("q"))
    pixel: array[float] = field(default_factory=lambda: array("d"))
    variance: array[float] = field(default_factory=lambda: array("d"))
    sigma_xi: array[float] = field(default_factory=lambda: array("d"))
    counted: array[int] = field(default_factory=lambda: array("b"))
    parallax_px: float = 0.0


class MissionLog:
    """All that smoothing needs of a run; 65 bytes an image point, 65 bytes an interval, 120 bytes a frame."""

    def __init__(self) -> None:
        self.lives: list[Life] = []
        self.frame, self.t_ns, self.upto = array("q"), array("q"), array("q")
        self._now: dict[int, Life] = {}
        self._dt, self._turns, self._shifts, self._still = array("d"), array("d"), array("d"), array("b")

    def take(self, step: RangeStep, state: RangeState) -> None:
        """Note one frame: what the filter told of it, and its state after it. Skipped frames are passed over."""
        if Verdict.OUT_OF_ORDER in step.alarms:
            return
        if state.ride is not None:
            self._way(state.ride)
        self.frame.append(step.frame)
        self.t_ns.append(step.t_ns)
        self.upto.append(len(self._dt))
        sigma = dict(zip(state.sighting.ids[::-1].tolist(), state.sighting.sigma_px[::-1].tolist(), strict=True))
        for slot in np.flatnonzero(np.isfinite(step.landmark_id)).tolist():
            self._follow(step, slot, sigma)

    def _way(self, ride: Ride) -> None:
        self._dt.extend(ride.dt)
        self._turns.extend(ride.omega.ravel())
        self._shifts.extend(ride.velocity.ravel())
        self._still.extend(ride.still.astype(np.int8))

    def _follow(self, step: RangeStep, slot: int, sigma: dict[int, float]) -> None:
        outcome, number = step.outcome[slot], int(step.landmark_id[slot])
        mean, covariance = step.mean[slot].copy(), step.covariance[slot].copy()
        if outcome in (Outcome.STARTED, Outcome.RESET):
            self._now[slot] = Life(number, slot, len(self.frame) - 1, mean, covariance)
            self.lives.append(self._now[slot])
        elif outcome == Outcome.LOST:
            self._now.pop(slot, None)
        elif outcome == Outcome.UPDATED and slot in self._now:
            life = self._now[slot]
            life.at.append(len(self.frame) - 1)
            life.pixel.extend(step.measured_px[slot])
            life.variance.append(sigma[number] ** 2)
            life.sigma_xi.append(np.sqrt(covariance[2, 2]))
            life.counted.append(int(step.status[slot] == Status.CONVERGED))
            life.parallax_px = max(life.parallax_px, np.nan_to_num(step.derotated_parallax_px[slot]))
        if slot in self._now:
            self._now[slot].path.extend(mean)

    def drive(self, settings: RangeSettings) -> Drive:
        """The way through all frames, with the speeds' noise of the settings."""
        noise, dt = noise_of(settings), np.array(self._dt)
        q = noise.density / dt[:, None]
        q[np.ix_(np.array(self._still, dtype=bool), noise.speeds)] = 0.0
        return Drive(
            dt=dt,
            omega=np.array(self._turns).reshape(-1, 3),
            velocity=np.array(self._shifts).reshape(-1, 3),
            columns=noise.columns,
            q=q,
            upto=np.array(self.upto, dtype=np.int64),
            aligned=settings.motion is MotionModel.ALIGNED,
        )


class Watched:
    """The range filter, and a log that looks on."""

    name: ClassVar[str] = RangeFilter.name
    step_type: ClassVar[type[RangeStep]] = RangeFilter.step_type
    kinds: ClassVar[tuple[StreamKind, ...]] = RangeFilter.kinds

    def __init__(self, estimator: RangeFilter, log: MissionLog) -> None:
        self._filter, self._log = estimator, log

    @property
    def settings(self) -> RangeSettings:
        """Those of the filter."""
        return self._filter.settings

    def start(self) -> RangeState:
        """See `RangeFilter`."""
        return self._filter.start()

    def step(self, state: RangeState, sample: Sample, /) -> tuple[RangeState, RangeStep | None]:
        """See `RangeFilter`."""
        after, step = self._filter.step(state, sample)
        if step is not None:
            self._log.take(step, after)
        return after, step


class SmoothedLife(NamedTuple):
    """A life, and its most probable states at all its frames, `life.born` to `life.at[-1]`.

    Attributes:
        life: what was known.
        mean: x, y, ξ (px, px, 1/m) [k, 3]; a ξ below 0 says that the range is not known.
        covariance: [k, 3, 3].
    """

    life: Life
    mean: Floats
    covariance: Floats


class Group(NamedTuple):
    """Lives that were smoothed together.

    Attributes:
        lives: of the landmarks.
        left_out: lives for which no start before the camera was found.
        iterations: Gauss-Newton steps.
        converged: whether they found the minimum.
    """

    lives: list[SmoothedLife]
    left_out: list[Life]
    iterations: int
    converged: bool


def smoothed(settings: RangeSettings, log: MissionLog, on_pass: Callable[[], None] | None = None) -> Iterator[Group]:
    """The most probable lives of all landmarks that had an image point after their start, group by group.

    All landmarks in up to `JOINT_LIMIT` slots are one group where `MEMORY_BYTES` allow it; groups do not learn from
    each other.

    Args:
        settings: of the filter that the log looked at; its camera, motion and noise.
        log: of the run.
        on_pass: called before each pass over the mission; what it raises ends the smoothing.
    """
    lives = [life for life in log.lives if len(life.at)]
    if not lives:
        return
    drive, model = log.drive(settings), _exact(settings)
    slots = sorted({life.slot for life in lives})
    size = group_size(len(log.frame), len(drive.dt), drive.columns.shape[1])
    for at in range(0, len(slots), size):
        members = set(slots[at : at + size])
        yield _group(model, drive, log, [life for life in lives if life.slot in members], on_pass)


def group_size(frames: int, intervals: int, inputs: int) -> int:
    """How many slots are smoothed at once."""
    fitting = (
        n for n in range(JOINT_LIMIT, 1, -1) if smoother.memory_bytes(frames, intervals, n, inputs) <= MEMORY_BYTES
    )
    return next(fitting, 1)


def _exact(settings: RangeSettings) -> Model:
    forms = {"flow": Flow.EXACT, "transition": TransitionForm.EXACT, "noise_gain": GainForm.EXACT}
    return settings.model_copy(update=forms).kernel_model


def _group(model: Model, drive: Drive, log: MissionLog, lives: list[Life], on_pass: Callable[[], None] | None) -> Group:
    if on_pass is not None:
        on_pass()
    known, about = _known(log, lives)
    first, error = smoother.start_about(model, drive, known, about)
    failed, left_out = np.zeros(len(lives), np.int64), list[Life]()
    while lives and (at := smoother.behind(model, drive, known, first, error)) >= 0:
        first[at, 2] *= 0.5
        failed[at] += 1
        if failed[at] > HALVINGS:
            left_out.append(lives.pop(at))
            first, failed, known = np.delete(first, at, 0), np.delete(failed, at), _known(log, lives)[0]
    if not lives:
        return Group([], left_out, 0, True)
    found = smoother.most_probable(
        model, drive, known, first, error, max_iterations=MAX_ITERATIONS, tolerance=TOLERANCE, on_pass=on_pass
    )
    told = []
    for life, column in zip(lives, known.slot.tolist(), strict=True):
        frames = np.s_[life.born : life.at[-1] + 1, column]
        told.append(SmoothedLife(life, found.mean[frames], found.covariance[frames]))
    return Group(told, left_out, found.iterations, found.converged)


def _known(log: MissionLog, lives: list[Life]) -> tuple[Lives, Floats]:
    """The lives as the smoother takes them, their slots side by side; and the filter's path [F, N, 3]."""
    column = {slot: place for place, slot in enumerate(sorted({life.slot for life in lives}))}
    pixel = np.full((len(log.frame), len(column), 2), np.nan)
    variance, about = np.ones(pixel.shape[:2]), np.full((*pixel.shape[:2], 3), np.nan)
    for life in lives:
        pixel[life.at, column[life.slot]] = np.array(life.pixel).reshape(-1, 2)
        variance[life.at, column[life.slot]] = life.variance
        path = np.array(life.path).reshape(-1, 3)
        about[life.born : life.born + len(path), column[life.slot]] = path
    known = Lives(
        slot=np.array([column[life.slot] for life in lives], dtype=np.int64),
        born=np.array([life.born for life in lives], dtype=np.int64),
        last=np.array([life.at[-1] for life in lives], dtype=np.int64),
        mean=np.array([life.mean for life in lives]).reshape(-1, 3),
        covariance=np.array([life.covariance for life in lives]).reshape(-1, 3, 3),
        pixel=pixel,
        variance=variance,
    )
    return known, about
