"""What a run's own measurements say of its drift, without a reference: backward replay, and revisits of a place.

The mission's logged samples are replayed backward with the run's own settings; where the increments of the two do not
undo one another, one of them is wrong. Where the path comes back to a place, the images tell the motion between the
two visits. `pipelines.self_consistency` has the equations. What comes out is kept in RUN.consistency.json beside the
run, for `workbench.judgement`, until the run is replayed again.
"""

from __future__ import annotations

import bisect
import dataclasses
import hashlib
import heapq
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pipelines.drift import DriftBudget
from pipelines.estimator import Step
from pipelines.evaluation import Trajectory
from pipelines.semidirect.step import VisualStep
from pipelines.verdict import Verdict
from readers.streams import Recording, RecordingError, Sample, StreamInfo
from workbench.runs import Run

if TYPE_CHECKING:
    from pipelines.self_consistency import Loop, Suspect
    from workbench.rrd_sensors import SensorReader

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
OnProgress = Callable[[str, int, int], None]
"""Told the title of what is done, how much of it is done, and of how many."""

WITHIN_SHARE = 0.3
"""Frames whose places differ by less than this share of the shorter side of the image show the same ground."""
LOOP_TIMES = 10
"""A loop is at least so many times as long as its ends may lie apart."""
ALIKE = 0.05
"""Stretches whose explained shares of the loops' drift differ by less are not told apart."""
AGAIN = "run workbench consistency again"


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopDrift:
    """A place that the path came back to: frames of the two visits, what the path between drifted by.

    `loop_m` is the path between the visits, `apart_m` how far apart the path has them, `drift_m` and `drift_rad` what
    of that the images do not confirm.
    """

    first_frame: int
    second_frame: int
    loop_m: float
    apart_m: float
    drift_m: float
    drift_rad: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Stretch:
    """Frames, the first excluded and the last included, that may have made the drift of the loops, see `Suspect`."""

    after_frame: int
    last_frame: int
    loops: int
    mean_m: float
    explained: float


@dataclass(frozen=True, kw_only=True)
class Consistency:
    """How far a run agrees with itself.

    Attributes:
        run: its name.
        unit: of all lengths: m, or px where the scale is not known.
        path_m: length of the backward replay's path.
        end_m: how far apart the two replays end, laid over one another at the start.
        end_rad: by how much their headings differ there.
        frame: numbers of the frames whose increments were compared [m].
        size_m: how far each moves the end [m], whichever way.
        shift_m: the part of wrong shifts along the way the ends lie apart [m]; with `heading_m` they sum to `end_m`.
        heading_m: the part of wrong turns [m].
        loops_why: why no loops were looked for; empty where they were.
        revisits: how many places are come back to.
        loops: those whose motion the images tell, the largest drift first.
        suspects: where the drift of the loops may come from, the likeliest first.
    """

    run: str
    unit: str
    path_m: float
    end_m: float
    end_rad: float
    frame: Ints = field(repr=False)
    size_m: Floats = field(repr=False)
    shift_m: Floats = field(repr=False)
    heading_m: Floats = field(repr=False)
    loops_why: str = ""
    revisits: int = 0
    loops: tuple[LoopDrift, ...] = ()
    suspects: tuple[Stretch, ...] = ()

    @property
    def harm_m(self) -> Floats:
        """What each frame adds to the distance between the ends [m]."""
        return self.shift_m + self.heading_m

    @property
    def usual_m(self) -> float:
        """How far the median frame moves the end."""
        return float(np.median(self.size_m))

    def ranked(self) -> Ints:
        """The compared frames by how far they move the end, the furthest first: rows of `frame` [m]."""
        return np.argsort(-self.size_m, kind="stable").astype(np.int64)

    def suspicion(self) -> tuple[list[tuple[int, int]], float]:
        """Frames, as spans of first and last, one error in which would explain the loops' drift, and its share of it.

        Stretches that explain nearly as much as the likeliest one cannot be told from it, and count as well.
        """
        best = max((one.explained for one in self.suspects), default=math.nan)
        alike = [one for one in self.suspects if one.explained >= best - ALIKE]
        spans: list[tuple[int, int]] = []
        for one in sorted(alike, key=lambda one: one.after_frame):
            if spans and spans[-1][1] == one.after_frame:
                spans[-1] = (spans[-1][0], one.last_frame)
            else:
                spans.append((one.after_frame + 1, one.last_frame))
        return spans, best


# -------------------------------------------------------------------------------- the answer


def consistency(run: Run, on_progress: OnProgress | None = None) -> Consistency:
    """Hold a run against itself.

    Args:
        run: of an estimator of the vehicle's path.
        on_progress: told how far it is.

    Raises:
        RecordingError: the run has no path, or the samples that it was made of are not in its folder.
        EvaluationError: the backward replay has fewer than half of the frames.
    """
    from pipelines.self_consistency import Reversed, forward_backward
    from workbench.rrd_sensors import sensors_of

    path = run.trajectory
    if path is None:
        problem = f"is a run of {run.estimator}, which has no path to hold against itself"
        raise RecordingError(run.file, problem, "give a run of an estimator of the vehicle's path, such as correlation")
    if run.visual and run.summary.get("unit") != "m":
        problem = f"is a run of {run.estimator} of unknown scale, and each replay would have a unit of its own"
        raise RecordingError(run.file, problem, "replay it with a height: --height STREAM, or --set height_m=…")
    told = on_progress or (lambda _title, _done, _total: None)
    height = getattr(run.model, "height_stream", "")
    with sensors_of(run) as sensors:
        streams = list(dict.fromkeys([run.about["image_stream"], *run.about["other_streams"]]))
        backward = Reversed(Logged(sensors, streams), streams, held=[name for name in streams if name == height])
        budget = forward_backward(path, _replayed(run, sensors, backward, told), backward.pivot_ns)
        why, revisits, loops, suspected = _loops(run, sensors, path, told)
    frames = run.frames[np.searchsorted(run.t_ns, path.t_ns)]
    return Consistency(
        run=run.name,
        unit=str(run.summary.get("unit", "m")),
        **_budget_values(budget, frames),
        loops_why=why,
        revisits=revisits,
        loops=tuple(_loop_drift(loop, frames) for loop in sorted(loops, key=lambda loop: -loop.drift_m)),
        suspects=tuple(_stretch(suspect, frames) for suspect in suspected),
    )


class Logged(Recording):
    """The samples in a mission's ``sensors.rrd`` as a recording; images come without their pixels.

    Args:
        sensors: the file.
        streams: the streams that will be read.
    """

    format = "samples of a replay"

    def __init__(self, sensors: SensorReader, streams: Sequence[str]) -> None:
        self.path = sensors.path
        self._sensors = sensors
        self._samples = {
            name: sorted((stored.sample for stored in sensors.bare(name)), key=lambda s: s.t_ns) for name in streams
        }

    @property
    def streams(self) -> tuple[StreamInfo, ...]:
        """None are listed: who reads it knows which streams the run had."""
        return ()

    def read(
        self, streams: Sequence[str] | None = None, start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[Sample]:
        """Yield the samples by their times, see `Recording.read`."""
        parts = []
        for name in self._samples if streams is None else streams:
            samples = self._samples[name]
            first = 0 if start_ns is None else bisect.bisect_left(samples, start_ns, key=lambda s: s.t_ns)
            stop = len(samples) if stop_ns is None else bisect.bisect_left(samples, stop_ns, key=lambda s: s.t_ns)
            parts.append(samples[first:stop])
        return heapq.merge(*parts, key=lambda s: s.t_ns)

    def close(self) -> None:
        """Release the file."""
        self._sensors.close()


def _pose_of(step: Step) -> Floats:
    """The pose of a step [3]; NaN where a visual odometry holds the last one."""
    pose: Floats = step.pose  # type: ignore[attr-defined]  # a run with a path has it
    return np.full(3, np.nan) if isinstance(step, VisualStep) and not step.accepted else pose


def _replayed(run: Run, sensors: SensorReader, backward: Recording, on_progress: OnProgress) -> Trajectory:
    """The path of the replay of a recording whose time runs backward, at its own times."""
    from pipelines.replay import stepped

    estimator = run.plugin.build(run.model)
    state, steps = estimator.start(), []
    for sample in backward.read():
        state, step = stepped(estimator, state, sensors.decoded(sample))
        if step is not None:
            steps.append((step.t_ns, _pose_of(step)))
            on_progress("backward", len(steps), len(run.frames))
    return Trajectory.of([t_ns for t_ns, _ in steps], np.array([pose for _, pose in steps]))


def _budget_values(budget: DriftBudget, frames: Ints) -> dict[str, Any]:
    turned = float(budget.increment_error[:, 2].sum())
    return {
        "path_m": budget.path_m,
        "end_m": float(np.hypot(*budget.end_error_m)),
        "end_rad": math.remainder(turned, 2 * math.pi),
        "frame": frames[budget.index],
        "size_m": budget.size_m,
        "shift_m": budget.shift_harm_m,
        "heading_m": budget.heading_harm_m,
    }


# ------------------------------------------------------------------------------------- loops


def _loops(
    run: Run, sensors: SensorReader, path: Trajectory, on_progress: OnProgress
) -> tuple[str, int, list[Loop], list[Suspect]]:
    """Why there are no loops, how many places are come back to, the loops that can be measured, what they suspect."""
    from pipelines.correlation.revisit import ImageMotions
    from pipelines.correlation.settings import CorrelationSettings
    from pipelines.self_consistency import close_loops, revisits, suspects

    if not isinstance(run.model, CorrelationSettings):
        return f"the matcher of {run.estimator} does not measure the motion between any two frames", 0, [], []
    rows = np.searchsorted(run.t_ns, path.t_ns)
    price, frames = run.column("metres_per_px")[rows], run.frames[rows]
    visible = _with_image(run)[rows]
    within = WITHIN_SHARE * float(np.nanmedian(run.column("image_size_px").min(axis=1) * run.column("metres_per_px")))
    if not within > 0:
        return "no frame tells the size of its image on the ground", 0, [], []
    measure = ImageMotions(
        run.model,
        grey_of=lambda row: sensors.grey(int(frames[row])),
        metres_per_px=lambda row: float(price[row]),
    )
    found = revisits(path, within_m=within, loop_m=LOOP_TIMES * within)
    tried = 0

    def told(first: int, second: int, expected: Floats) -> Floats | None:
        nonlocal tried
        measured = measure(first, second, expected) if visible[first] and visible[second] else None
        tried += 1
        on_progress("loops", tried, len(found))
        return measured

    loops = close_loops(found, told)
    return "", len(found), loops, suspects(loops)


def _with_image(run: Run) -> NDArray[np.bool_]:
    """The frames [n] whose image could be decoded."""
    undecodable: NDArray[np.bool_] = (run.column("alarms").astype(np.int64) & int(Verdict.UNDECODABLE)) != 0
    return ~undecodable


def _loop_drift(loop: Loop, frames: Ints) -> LoopDrift:
    revisit = loop.revisit
    return LoopDrift(
        first_frame=int(frames[revisit.first]),
        second_frame=int(frames[revisit.second]),
        loop_m=revisit.loop_m,
        apart_m=revisit.apart_m,
        drift_m=loop.drift_m,
        drift_rad=float(loop.drift[2]),
    )


def _stretch(suspect: Suspect, frames: Ints) -> Stretch:
    return Stretch(
        after_frame=int(frames[suspect.start]),
        last_frame=int(frames[suspect.stop]),
        loops=suspect.loops,
        mean_m=suspect.mean_m,
        explained=suspect.explained,
    )


# -------------------------------------------------------------------------------- what is kept


def file_of(run: Run) -> Path:
    """Where what was found of a run is kept."""
    return run.path("consistency.json")


def write(run: Run, found: Consistency) -> Path:
    """Keep what was found, whole or not at all; return its file.

    Raises:
        OSError: it cannot be written.
    """
    from workbench.summary import without_nan

    values = without_nan({"key": _key(run), **values_of(found)})
    part = file_of(run).with_suffix(".part")
    part.write_text(json.dumps(values, allow_nan=False), encoding="utf-8")
    return part.replace(file_of(run))


def read(run: Run) -> Consistency | None:
    """What was found of a run before; None where nobody asked.

    Raises:
        RecordingError: the file is damaged, or of another replay than the run's.
    """
    file = file_of(run)
    try:
        values = json.loads(file.read_text(encoding="utf-8"))
        key, found = values.pop("key"), _of_values(values)
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise RecordingError(file, f"cannot be read ({error})", AGAIN) from error
    if key != _key(run):
        raise RecordingError(file, f"is of another replay than {run.file.name}", AGAIN)
    return found


def values_of(found: Consistency) -> dict[str, Any]:
    """What was found as plain values."""
    return {
        **{f.name: getattr(found, f.name) for f in dataclasses.fields(found)},
        **{name: getattr(found, name).tolist() for name in ("frame", "size_m", "shift_m", "heading_m")},
        "loops": [dataclasses.asdict(loop) for loop in found.loops],
        "suspects": [dataclasses.asdict(stretch) for stretch in found.suspects],
    }


def _of_values(values: Mapping[str, Any]) -> Consistency:
    arrays = {name: np.array(values[name], np.float64) for name in ("size_m", "shift_m", "heading_m")}
    lists = {
        "loops": tuple(LoopDrift(**one) for one in values["loops"]),
        "suspects": tuple(Stretch(**one) for one in values["suspects"]),
    }
    return Consistency(**{**values, **arrays, **lists, "frame": np.array(values["frame"], np.int64)})


def _key(run: Run) -> str:
    """What makes a replay the one that it is: all that its RUN.toml says."""
    return hashlib.sha256(run.path("toml").read_bytes()).hexdigest()
