"""One replay, from a path to a run folder: open, choose, replay, judge, write.

The run folder holds, once per mission, `sensors.rrd` (with `sensors.toml`, which says what is in it), and per
run `RUN.rrd`, `RUN.toml` (settings, versions, input digest, window, summary), `RUN.tum` (trajectory) and `RUN.sha256`
(the manifest of these files, see `workbench.manifest`).
An interrupt is noticed between two frames; everything up to there is written, the files are closed, and
RUN.toml says so. Nothing of the wall clock goes into the files.
"""

from __future__ import annotations

import contextlib
import functools
import importlib.metadata
import math
import platform
import re
import signal
import threading
import tomllib
from array import array
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple, Protocol, Self, TextIO

import numpy as np

from pipelines.estimator import Estimator, Resumable, Step
from pipelines.evaluation import Evaluation, EvaluationError, Trajectory, evaluate, mean_angle, path_lengths
from pipelines.geometry import Floats, wrap_angle
from pipelines.latency import LatencyBuffer
from pipelines.replay import Frame, Replayed, replay
from pipelines.semidirect.step import VisualStep
from pipelines.verdict import Severity
from readers.clock import StreamAudit
from readers.streams import (
    ImageError,
    ImageSample,
    PoseSample,
    Problem,
    ReadOptions,
    Recording,
    RecordingError,
    Sample,
    StreamError,
    StreamInfo,
)
from workbench import inputs, loss_report, manifest, opening, range_inputs, visual_inputs
from workbench.checkpoints import CHECKPOINT_FRAMES, CheckpointError, CheckpointWriter
from workbench.progress import Progress
from workbench.range_account import RangeAccount
from workbench.range_smoothing import Smoothing
from workbench.settings import Plugin, Resolved, SettingsError, plugin, resolve, settings_values, to_toml
from workbench.summary import Tally, evaluation_values, lines, suitability
from workbench.trajectory_files import tum_line, tum_line_in_plane
from workbench.visual_account import VisualAccount

PACKAGES = ("estimator-workbench", "rerun-sdk", "numpy", "numba", "scipy", "opencv-python-headless", "rosbags", "mcap")
FORMAT = 1
CALIBRATION_AGREES = 0.05


# -------------------------------------------------------------------------------- request


@dataclass(frozen=True, slots=True, kw_only=True)
class Request:
    """What a user asks of one replay.

    `start` and `stop` are times as `inputs.parse_time` reads them; `image`, `reference`, `height`, `tracks`,
    `odometry` and `imu` are names of streams, ``none`` for one that is not to be used; `reference_offset_s` is added
    to the frames' times before the reference is looked up; `raw_images` says how images without a viewable stored
    form are kept.
    """

    path: Path
    estimator: str = "correlation"
    preset: str | None = None
    settings_file: Path | None = None
    overrides: tuple[str, ...] = ()
    start: str | None = None
    stop: str | None = None
    stride: int = 1
    out: Path | None = None
    name: str | None = None
    image: str | None = None
    reference: str | None = None
    reference_offset_s: float = 0.0
    height: str | None = None
    tracks: str | None = None
    odometry: str | None = None
    imu: str | None = None
    options: ReadOptions = field(default_factory=ReadOptions)
    calibrate: bool = False
    smooth: bool = False
    raw_images: str = "png"


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of a replay: its files and its summary, which is the table ``summary`` of RUN.toml."""

    folder: Path
    run_file: Path
    sensors_file: Path
    summary: dict[str, Any]


# -------------------------------------------------------------------------------- writers


class SensorLog(Protocol):
    """What the session needs of `workbench.rrd.SensorWriter`."""

    def image(self, frame: int, sample: ImageSample) -> None: ...  # noqa: D102
    def sample(self, original: Sample, decoded: Sample) -> None: ...  # noqa: D102
    def undecodable(self, frame: int, t_ns: int, reason: str) -> None: ...  # noqa: D102
    def reference(self, poses: Sequence[PoseSample]) -> None: ...  # noqa: D102
    def facts(self, lines: Sequence[str]) -> None: ...  # noqa: D102
    def close(self) -> None: ...  # noqa: D102


class RunLog(Protocol):
    """What the session needs of `workbench.rrd.RunWriter`."""

    def step(self, step: Step, beside: Any = None) -> None: ...  # noqa: D102
    def event(self, frame: int, t_ns: int, severity: Severity, text: str) -> None: ...  # noqa: D102
    def errors(self, frames: Any, t_ns: Any, values: Floats) -> None: ...  # noqa: D102
    def smoothed(self, slot: int, frames: Any, t_ns: Any, mean: Floats, covariance: Floats) -> None: ...  # noqa: D102
    def finish(self, summary: Mapping[str, str | float | int], aligned_path: Floats | None) -> None: ...  # noqa: D102
    def close(self) -> None: ...  # noqa: D102


class Writers(NamedTuple):
    """What makes the writers of the two kinds of files.

    Both are called with the file and, by name, the `recording_id`, the `run`, the name of its `estimator` and its
    `step_type`; `sensors` with `raw_images` as well, `run` with `settings_text`, `ground` [n, 2], positions of the
    reference in m that the map shows (None where there are none, or the path is not in metres), and `scene`, what
    the drawing of this estimator's steps needs to know beyond them. `rows` counts the rows of a written file.
    """

    sensors: Callable[..., SensorLog]
    run: Callable[..., RunLog]
    rows: manifest.CountRows = manifest.stored_rows


def rerun_writers() -> Writers:
    """The writers of Rerun recordings; both files bring the view of the run along, whichever is opened last."""
    from workbench.blueprints import blueprint_of
    from workbench.rrd import RunWriter, SensorWriter

    def sensors(file: Path, *, run: str, estimator: str, step_type: type[Step], **options: Any) -> SensorLog:
        return SensorWriter(file, view=partial(blueprint_of, step_type, run, estimator), **options)

    return Writers(sensors, RunWriter)


# ------------------------------------------------------------------------------ interrupt


class Interrupt:
    """Turns the first Ctrl-C or SIGTERM into a request to stop; the second Ctrl-C raises KeyboardInterrupt.

    A context manager; the handlers before it are put back at its end.
    """

    def __init__(self) -> None:
        self.requested = False
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Self:
        if threading.current_thread() is not threading.main_thread():
            return self
        for number in (signal.SIGINT, signal.SIGTERM):
            self._before[number] = signal.signal(number, self._note)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self.requested:
            raise KeyboardInterrupt
        self.requested = True


# -------------------------------------------------------------------------------- session


def run(
    request: Request,
    *,
    recording: Recording | None = None,
    on_progress: Callable[[Progress], None] | None = None,
    on_warnings: Callable[[Sequence[str]], None] | None = None,
    writers: Writers | None = None,
) -> Outcome:
    """Replay a recording and write its run folder.

    Args:
        request: what is asked for.
        recording: the recording, where it is no file (a simulated mission); else `request.path` is opened.
        on_progress: called after every frame.
        on_warnings: called before the first frame with what is odd about the clocks in its first seconds, if anything.
        writers: the classes that write the files; those of `workbench.rrd` by default.

    Raises:
        WorkbenchError: the request cannot be met; nothing is written.
        KeyboardInterrupt: a second interrupt came while the files were being finished.
    """
    estimator = plugin(request.estimator)
    preset = request.preset or estimator.usual_preset
    resolved = resolve(estimator, preset=preset, file=request.settings_file, overrides=request.overrides)
    name = run_name(request.name or preset)
    if request.smooth and estimator.answers != "ranges":
        raise SettingsError(f"--smooth is for ranges, not for {request.estimator}: leave it out, or take -e range")
    if request.stride < 1:
        raise SettingsError(f"--stride {request.stride}: must be 1 or more")
    with recording or opening.open_any(request.path, request.options) as opened:
        session = _prepare(request, opened, estimator, resolved, name, preset)
        if on_warnings is not None and (warnings := [*opened.cache_troubles, *session.clock_warnings()]):
            on_warnings(warnings)
        with Interrupt() as interrupt:
            return session.replay(writers or rerun_writers(), interrupt, on_progress)


def run_name(name: str) -> str:
    """A run's name, which is part of file names and entity paths.

    Raises:
        SettingsError: it has other characters than letters, digits, dot, dash and underscore, or is taken.
    """
    if not re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,99}", name) or name == "sensors":
        raise SettingsError(
            f"{name!r} cannot be the name of a run: use letters, digits, dot, dash, underscore (not 'sensors')"
        )
    return name


def run_folder(request: Request) -> Path:
    """Where the results go: the folder asked for, else ``results/`` and the recording's name.

    Raises:
        RecordingError: it lies within the recording, which is never written to, or is a file.
    """
    source = request.path.resolve()
    stem = source.name if source.is_dir() else source.stem
    folder = request.out or Path("results") / (re.sub(r"[^\w.-]+", "_", stem) or "recording")
    target = folder.resolve()
    if target == source or source in target.parents:
        raise RecordingError(folder, "the results would lie within the recording", "choose another folder with -o")
    if target.exists() and not target.is_dir():
        raise RecordingError(folder, "there is a file of that name", "choose another folder with -o")
    return folder


def _prepare(
    request: Request, recording: Recording, estimator: Plugin, resolved: Resolved, name: str, preset: str
) -> _Session:
    """Make every choice that can fail before anything is written."""
    chosen = _chooser(estimator)(request, recording, resolved)
    built: Any = estimator.build(chosen.resolved.settings)
    return _Session(
        request=request,
        recording=_Audited(recording),
        estimator=built if chosen.smoothing is None else chosen.smoothing.watching(built),
        name=name,
        preset=preset,
        folder=run_folder(request),
        chosen=chosen,
        notes=[*recording.notes, *chosen.notes],
        digest=inputs.digest_of(recording, request.path),
    )


def _chooser(estimator: Plugin) -> Callable[[Request, Recording, Resolved], _Chosen]:
    """Who makes the choices for an estimator."""
    if estimator.answers == "ranges":
        return _choose_for_ranges
    visual = estimator.step is not None and issubclass(estimator.step, VisualStep)
    return _choose_for_visual if visual else _choose_for_path


@dataclass(frozen=True, slots=True, kw_only=True)
class _Chosen:
    """What a replay takes of its recording: streams, window, reference; the settings that follow; who judges."""

    frames: str
    others: tuple[str, ...]
    shown: str = ""
    start_ns: int | None
    stop_ns: int | None
    resolved: Resolved
    reference: inputs.Reference
    account: Account
    ground: Floats | None
    scene: Any = None
    latency: LatencyBuffer | None = None
    notes: Sequence[str] = ()
    smoothing: Smoothing | None = None


class _Footage(NamedTuple):
    """Images of a path: their stream, the window, the first one, and the reference with its offset."""

    image: str
    start_ns: int | None
    stop_ns: int | None
    first: inputs.FirstFrame
    reference: inputs.Reference
    offset_ns: int


def _footage(request: Request, recording: Recording) -> _Footage:
    """The images and the reference of a path."""
    image = inputs.choose_images(recording, request.image)
    start_ns, stop_ns = _window(request, recording, image)
    first = inputs.first_frame(recording, image, start_ns, stop_ns)
    offset_ns = _offset_ns(request)
    reference = inputs.load_reference(recording, request.reference, start_ns, stop_ns, offset_ns)
    reference = inputs.overlapping(recording, reference, request.reference, image, first.t_ns, offset_ns)
    return _Footage(image, start_ns, stop_ns, first, reference, offset_ns)


def _choose_for_path(request: Request, recording: Recording, resolved: Resolved) -> _Chosen:
    """The choices of an estimator of the vehicle's path: images, height, scale, start."""
    image, start_ns, stop_ns, first, reference, offset_ns = _footage(request, recording)
    if request.calibrate and not reference.poses:
        raise StreamError(f"{request.path}: --calibrate needs a reference, but there is {reference.sentence}")
    height = inputs.choose_height(recording, request.height)
    resolved, scale, notes = inputs.with_scale(resolved, recording, image, first.size_px, height)
    resolved = inputs.with_start(resolved, reference, first.t_ns + offset_ns)
    stream = getattr(resolved.settings, "height_stream", "")
    if stream:
        recording.stream(stream)
    return _Chosen(
        frames=image,
        others=(stream,) if stream and stream != image else (),
        start_ns=start_ns,
        stop_ns=stop_ns,
        resolved=resolved,
        reference=reference,
        account=_PathAccount(request.calibrate, resolved.settings, reference, offset_ns, scale),
        ground=reference.path.pose[:, :2] if reference.poses and scale.known else None,
        notes=notes,
    )


def _choose_for_visual(request: Request, recording: Recording, resolved: Resolved) -> _Chosen:
    """The choices of a visual odometry with a map: images, camera, what tells the scale, start."""
    if request.calibrate:
        raise SettingsError("--calibrate is for correlation: a camera of visual odometry is calibrated with a board")
    image, start_ns, stop_ns, first, reference, offset_ns = _footage(request, recording)
    resolved, notes = visual_inputs.with_camera(resolved, recording, image, first.size_px)
    resolved, source = visual_inputs.with_scale(
        resolved,
        recording,
        kinds=plugin(request.estimator).build(resolved.settings).kinds,
        height=request.height,
        odometry=request.odometry,
        start_ns=first.t_ns,
    )
    resolved = inputs.with_start(resolved, reference, first.t_ns + offset_ns)
    account = VisualAccount(resolved.settings, reference, offset_ns, source)
    return _Chosen(
        frames=image,
        others=source.streams,
        start_ns=start_ns,
        stop_ns=stop_ns,
        resolved=resolved,
        reference=reference,
        account=account,
        ground=reference.path.pose[:, :2] if reference.poses and source.sentence else None,
        scene=account.scene,
        notes=[*notes, *visual_inputs.scale_notes(source, reference)],
    )


def _choose_for_ranges(request: Request, recording: Recording, resolved: Resolved) -> _Chosen:
    """The choices of an estimator of ranges to landmarks: frames, odometry, IMU, camera."""
    streams = range_inputs.choose_streams(
        recording,
        resolved.settings,
        tracks=request.tracks,
        image=request.image,
        odometry=request.odometry,
        imu=request.imu,
    )
    start_ns, stop_ns = _window(request, recording, streams.frames)
    inputs.first_time(recording, streams.frames, start_ns, stop_ns)
    offset_ns = _offset_ns(request)
    reference = range_inputs.load_reference(recording, request.reference, start_ns, stop_ns, offset_ns)
    camera = range_inputs.camera_of(recording, streams)
    resolved, notes = range_inputs.with_camera(resolved, recording, camera, streams)
    landmarks = range_inputs.landmarks_of(recording)
    account = RangeAccount.of(
        resolved, landmarks, reference, streams, offset_ns, calibrate=request.calibrate, smooth=request.smooth
    )
    return _Chosen(
        frames=streams.frames,
        others=streams.others,
        shown=streams.shown,
        start_ns=start_ns,
        stop_ns=stop_ns,
        resolved=resolved,
        reference=reference,
        account=account,
        ground=None,
        scene=account.scene,
        smoothing=account.smoothing,
        latency=range_inputs.latency_of(resolved.settings, streams),
        notes=[*streams.notes, *notes],
    )


def _offset_ns(request: Request) -> int:
    return round(request.reference_offset_s * 1e9)


def _window(request: Request, recording: Recording, frames: str) -> tuple[int | None, int | None]:
    """The window in nanoseconds; the beginning of the recording is read only if its time is needed."""
    if request.start is None and request.stop is None:
        return None, None
    origin_ns = inputs.first_time(recording, frames, None, None)
    start_ns, stop_ns = (
        None if text is None else inputs.parse_time(text, origin_ns) for text in (request.start, request.stop)
    )
    if start_ns is not None and stop_ns is not None and stop_ns <= start_ns:
        raise StreamError(f"--to {request.stop} does not lie after --from {request.start}")
    return start_ns, stop_ns


class _Audited(Recording):
    """A recording whose streams are audited while they are read."""

    def __init__(self, inner: Recording) -> None:
        self.path, self.format, self.notes = inner.path, inner.format, inner.notes
        self.inner = inner
        self.audits: dict[str, StreamAudit] = {}

    @property
    def streams(self) -> tuple[StreamInfo, ...]:
        return self.inner.streams

    def read(
        self, streams: Sequence[str] | None = None, start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[Sample]:
        return self._audited(self.inner.read(streams, start_ns, stop_ns))

    def arrivals(self, streams: Sequence[str] | None = None) -> Iterator[Sample]:
        return self._audited(self.inner.arrivals(streams))

    def _audited(self, samples: Iterator[Sample]) -> Iterator[Sample]:
        for sample in samples:
            if sample.stream not in self.audits:
                self.audits[sample.stream] = StreamAudit(sample.stream)
            self.audits[sample.stream].add(sample)
            yield sample

    def count_before(self, stream: str, t_ns: int) -> int:
        return self.inner.count_before(stream, t_ns)

    def facts(self) -> list[str]:
        """The oddities of what was read, one sentence each."""
        return [f"{fact.stream}: {fact.sentence}" for audit in self.audits.values() for fact in audit.facts()]

    def damage_lines(self) -> list[str]:
        """What of the file was found damaged so far, and what is known to be lost by topic."""
        return [*(str(damage) for damage in self.inner.damage), *loss_report.sentences(self.inner.losses)]


class Account(Protocol):
    """Follows the steps of a run and says at its end what they are worth."""

    @property
    def trajectory(self) -> bool:
        """Whether the steps tell the vehicle's path."""
        ...

    def take(self, step: Step, sample: Frame, /) -> Any:
        """Take note of one step; what is known of its frame from elsewhere, for the log (see `RunLog.step`)."""
        ...

    def conclude(self, run: RunLog, tally: Tally, median_dt_s: float, /) -> tuple[dict[str, Any], Floats | None]:
        """What the summary says of the result; and the path [n, 2] aligned with the reference, None for none.

        Of a path in space: the reference [n, 3] laid over the path.
        """
        ...


@dataclass(slots=True)
class _Span:
    """The times of a run's frames while they pass: 8 bytes a frame; and the number of the last one."""

    frame: int = -1
    t_ns: array[int] = field(default_factory=lambda: array("q"))

    def add(self, step: Step) -> None:
        self.frame = step.frame
        self.t_ns.append(step.t_ns)

    @property
    def duration_s(self) -> float:
        return float(self.t_ns[-1] - self.t_ns[0]) / 1e9 if self.t_ns else 0.0

    @property
    def median_dt_s(self) -> float:
        return float(np.median(np.diff(np.array(self.t_ns)))) / 1e9 if len(self.t_ns) > 1 else math.nan


class _PathAccount:
    """The account of an estimator of the vehicle's path: its trajectory, held against the reference.

    The trajectory takes 40 bytes a frame.
    """

    trajectory = True

    def __init__(
        self, calibrate: bool, settings: Any, reference: inputs.Reference, offset_ns: int, scale: inputs.Scale
    ) -> None:
        self._calibrate, self._settings = calibrate, settings
        self._reference, self._offset_ns, self._scale = reference, offset_ns, scale
        self._frames, self._t_ns, self._poses = array("q"), array("q"), array("d")

    def take(self, step: Step, sample: Frame) -> None:
        """Take the pose (x, y, heading) of one step."""
        pose = getattr(step, "pose", None)
        if pose is not None:
            self._frames.append(step.frame)
            self._t_ns.append(step.t_ns)
            self._poses.extend(np.asarray(pose, np.float64).tolist())

    def conclude(self, run: RunLog, tally: Tally, median_dt_s: float) -> tuple[dict[str, Any], Floats | None]:
        """Hold the path against the reference and log its errors."""
        poses = np.array(self._poses, dtype=np.float64).reshape(-1, 3)
        estimate = Trajectory.of(np.array(self._t_ns, dtype=np.int64), poses)
        evaluation, refused = self._evaluate(estimate)
        aligned = None
        if evaluation is not None:
            aligned = evaluation.alignment(estimate.pose)[:, :2]
            frames = self._frames_of(estimate)[evaluation.index]
            run.errors(frames=frames, t_ns=estimate.t_ns[evaluation.index], values=evaluation.errors)
        return {
            "path_length": float(path_lengths(poses[:, :2])[-1]) if len(poses) else 0.0,
            "unit": self._scale.unit,
            "scale": self._scale.sentence,
            "reference": refused,
            "evaluation": None if evaluation is None else evaluation_values(evaluation),
            "calibration": self._calibration(evaluation),
            "suitability": suitability(tally, median_dt_s, evaluation),
        }, aligned

    def _frames_of(self, estimate: Trajectory) -> Any:
        """The frame numbers [n] of a trajectory's poses, which are in the order of time."""
        times, first = np.unique(np.array(self._t_ns, dtype=np.int64), return_index=True)
        frames = np.array(self._frames, dtype=np.int64)[first]
        return frames[np.searchsorted(times, estimate.t_ns)]

    def _evaluate(self, estimate: Trajectory) -> tuple[Evaluation | None, str]:
        """The evaluation, and what the reference is; or why there is none."""
        reference = self._reference
        if not reference.poses:
            return None, reference.sentence
        try:
            result = evaluate(estimate, reference.path, with_scale=not self._scale.known, offset_ns=self._offset_ns)
        except EvaluationError as error:
            return None, f"{reference.sentence}; not compared: {error}"
        return result, reference.sentence

    def _calibration(self, evaluation: Evaluation | None) -> dict[str, Any] | None:
        """The settings that bring the path over the reference, None if nobody asked."""
        if not self._calibrate:
            return None
        if evaluation is None:
            return {"key": "", "sentence": "not possible: the run cannot be compared with a reference"}
        return calibration(self._settings, evaluation)


class _Keeper:
    """Keeps what a replay that goes on from the middle needs: samples as the estimator got them, and its states.

    A state that cannot be kept ends the keeping of states, and a note says so.
    """

    def __init__(
        self, estimator: Estimator[Any], states: CheckpointWriter, sensors: SensorLog | None, notes: list[str]
    ) -> None:
        self._estimator, self._states, self._sensors, self._notes = estimator, states, sensors, notes
        self._steps, self._keeps = 0, True
        self._keep(-1, estimator.start())

    @property
    def logs(self) -> bool:
        """Whether samples are wanted."""
        return self._sensors is not None

    def __call__(self, original: Sample, decoded: Sample, state: Any, step: Step | None) -> None:
        """Take note of one sample and the state after it."""
        if self._sensors is not None:
            self._sensors.sample(original, decoded)
        if step is not None:
            self._steps += 1
            if self._keeps and self._steps % CHECKPOINT_FRAMES == 0:
                self._keep(step.frame, state)

    def _keep(self, frame: int, state: Any) -> None:
        packed = self._estimator.packed(state) if isinstance(self._estimator, Resumable) else state
        try:
            self._states.write(frame, packed)
        except CheckpointError as error:
            self._keeps = False
            self._notes.append(f"no states are kept to go on from: {error}")


@dataclass(frozen=True, kw_only=True)
class _Session:
    """One replay with every choice made."""

    request: Request
    recording: _Audited
    estimator: Estimator[Any]
    name: str
    preset: str
    folder: Path
    chosen: _Chosen
    notes: list[str]
    digest: str

    # ---- the loop

    def clock_warnings(self) -> list[str]:
        """What is odd about the clocks of the streams that are used, in the first seconds of the window."""
        recording, chosen = self.recording.inner, self.chosen
        first_ns = inputs.first_time(recording, chosen.frames, chosen.start_ns, chosen.stop_ns)
        return inputs.clock_warnings(recording, [chosen.frames, *chosen.others], first_ns, chosen.stop_ns)

    def replay(self, writers: Writers, interrupt: Interrupt, on_progress: Callable[[Progress], None] | None) -> Outcome:
        """Replay, judge and write; RUN.toml says how it ended."""
        self._make_folder()
        try:
            summary = self._written(writers, interrupt, on_progress)
        except KeyboardInterrupt:
            self._write_toml({"complete": False, "summary": {"interrupted": True}})
            raise
        self._write_toml({"complete": True, "summary": summary})
        manifest.write(self.folder, self.name, manifest.taken(self.folder, self.name, writers.rows))
        return Outcome(self.folder, self._file("rrd"), self.folder / "sensors.rrd", summary)

    def _make_folder(self) -> None:
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            manifest.file_of(self.folder, self.name).unlink(missing_ok=True)
            self._write_toml({"complete": False})
        except OSError as error:
            problem = f"no results can be written there ({error.strerror or error})"
            raise RecordingError(self.folder, problem, "choose another folder with -o") from error

    def _written(
        self, writers: Writers, interrupt: Interrupt, on_progress: Callable[[Progress], None] | None
    ) -> dict[str, Any]:
        """Replay and write the recordings and the trajectory; the summary."""
        tally, span, stopped = Tally(), _Span(), ""
        with contextlib.ExitStack() as files:
            sensors = self._sensors(writers, files)
            run = files.enter_context(contextlib.closing(self._run_writer(writers)))
            tum = self._trajectory(files)
            keep = _Keeper(self.estimator, files.enter_context(self._checkpoints()), sensors, self.notes)
            steps = files.enter_context(contextlib.closing(self._steps(on_progress, keep)))
            try:
                for replayed in steps:
                    self._take(replayed, sensors, run, tum, tally, span)
                    if interrupt.requested:
                        break
            except RecordingError as error:
                if not tally.frames:
                    raise
                stopped = str(error)
            if self.chosen.smoothing is not None and tally.frames:
                self.chosen.smoothing.conclude(run, lambda: interrupt.requested)
            summary = self._finish(sensors, run, tally, span, interrupt.requested, stopped)
        if sensors is not None and not summary["interrupted"] and not stopped:
            _replace(self.folder / "sensors.toml", to_toml(self._sensors_values()))
        return summary | {"interrupted": interrupt.requested}

    def _trajectory(self, files: contextlib.ExitStack) -> TextIO | None:
        """The file of the trajectory, None where the estimator has none; one of an earlier run of that name goes."""
        if self.chosen.account.trajectory:
            return files.enter_context(self._file("tum").open("w", encoding="ascii"))
        self._file("tum").unlink(missing_ok=True)
        return None

    def _checkpoints(self) -> CheckpointWriter:
        about = {"digest": self.digest, "run": self.name, "estimator": self.estimator.name}
        return CheckpointWriter(self._file("checkpoints"), about)

    def _steps(self, on_progress: Callable[[Progress], None] | None, keep: _Keeper) -> Generator[Replayed]:
        total = self._expected()

        def tell(done: int, t_ns: int) -> None:
            if on_progress is not None:
                on_progress(Progress(done, total, t_ns))

        return replay(
            self.recording,
            self.estimator,
            image_stream=self.chosen.frames,
            other_streams=self.chosen.others,
            shown_stream=self.chosen.shown,
            start_ns=self.chosen.start_ns,
            stop_ns=self.chosen.stop_ns,
            stride=self.request.stride,
            latency=self.chosen.latency,
            on_progress=tell,
            beside_streams=self._kept_streams() if keep.logs else (),
            on_sample=keep,
        )

    def _take(
        self, replayed: Replayed, sensors: SensorLog | None, run: RunLog, tum: TextIO | None, tally: Tally, span: _Span
    ) -> None:
        step, sample = replayed.step, replayed.sample
        image = replayed.shown if self.chosen.shown else sample
        if sensors is not None and isinstance(image, ImageSample | Problem):
            _log_sample(sensors, step, image)
        run.step(step, self.chosen.account.take(step, sample))
        if isinstance(sample, Problem):
            run.event(step.frame, step.t_ns, Severity.ERROR, sample.reason)
        tally.add(step.verdict, step.alarms, bool(getattr(step, "accepted", True)))
        span.add(step)
        if tum is not None:
            tum.write(_trajectory_line(step))

    def _expected(self) -> int | None:
        """How many frames there will be, as far as the recording says it."""
        info, start_ns, stop_ns = self.recording.stream(self.chosen.frames), self.chosen.start_ns, self.chosen.stop_ns
        if info.count < 0:
            return None
        share = 1.0
        if (start_ns is not None or stop_ns is not None) and info.last_ns > info.first_ns:
            first = max(info.first_ns, start_ns if start_ns is not None else info.first_ns)
            last = min(info.last_ns, stop_ns if stop_ns is not None else info.last_ns)
            share = min(1.0, max(0.0, (last - first) / (info.last_ns - info.first_ns)))
        return math.ceil(share * info.count / self.request.stride)

    # ---- the end

    def _finish(
        self, sensors: SensorLog | None, run: RunLog, tally: Tally, span: _Span, interrupted: bool, stopped: str
    ) -> dict[str, Any]:
        """Judge the run, log what is known at its end, and return the summary."""
        facts, damage = self.recording.facts(), self.recording.damage_lines()
        if self.chosen.latency is not None:
            facts += self.chosen.latency.facts()
        found, aligned = self.chosen.account.conclude(run, tally, span.median_dt_s)
        summary = self._summary(tally, span, found, interrupted, stopped) | {"facts": facts, "damage": damage}
        if tally.frames:
            for text in damage:
                run.event(span.frame, span.t_ns[-1], Severity.WARNING, f"damage: {text}")
            if stopped:
                run.event(span.frame, span.t_ns[-1], Severity.ERROR, stopped)
        if sensors is not None:
            oddities = [*(f"damage: {text}" for text in damage), *facts]
            sensors.facts([*self._contents(), *self.notes, *(oddities or ["nothing odd was met"])])
        run.finish(_flat(lines(summary)), aligned)
        return summary

    def _contents(self) -> Iterator[str]:
        """The recording and its streams, one line each."""
        yield f"**{self.request.path.name}** ({self.recording.format})"
        for stream in self.recording.streams:
            count = f", {stream.count} messages" if stream.count >= 0 else ""
            yield f"`{stream.name}`: {stream.kind}{count}"

    def _summary(
        self, tally: Tally, span: _Span, found: Mapping[str, Any], interrupted: bool, stopped: str
    ) -> dict[str, Any]:
        return {
            "recording": str(self.request.path),
            "format": self.recording.format,
            "estimator": self.estimator.name,
            "preset": self.preset,
            "run": self.name,
            "image_stream": self.chosen.frames,
            "frames": tally.frames,
            "duration_s": span.duration_s,
            "median_dt_s": span.median_dt_s,
            "verdicts": tally.named(),
            "alarms": tally.named_alarms(),
            **found,
            "notes": self.notes,
            "interrupted": interrupted,
            "stopped_early": stopped,
        }

    # ---- files

    def _file(self, suffix: str) -> Path:
        return self.folder / f"{self.name}.{suffix}"

    def _sensors(self, writers: Writers, files: contextlib.ExitStack) -> SensorLog | None:
        """The writer of the mission's measurements, None where they stand there already."""
        record, file = self.folder / "sensors.toml", self.folder / "sensors.rrd"
        wanted = to_toml(self._sensors_values())
        if file.is_file() and _recorded(record) == tomllib.loads(wanted):
            return None
        record.unlink(missing_ok=True)
        writer = writers.sensors(
            file,
            recording_id=self.recording_id,
            raw_images=self.request.raw_images,
            run=self.name,
            estimator=self.estimator.name,
            step_type=self.estimator.step_type,
        )
        files.enter_context(contextlib.closing(writer))
        writer.reference(self.chosen.reference.poses)
        return writer

    def _run_writer(self, writers: Writers) -> RunLog:
        return writers.run(
            self._file("rrd"),
            recording_id=self.recording_id,
            run=self.name,
            estimator=self.estimator.name,
            step_type=self.estimator.step_type,
            settings_text=to_toml(settings_values(self.estimator.settings)),
            ground=self.chosen.ground,
            scene=self.chosen.scene,
        )

    @property
    def recording_id(self) -> str:
        """The mission's id: equal for equal input, so that several runs of it lie over one another."""
        return self.digest[:32]

    def _window_values(self) -> dict[str, Any]:
        return {"start_ns": self.chosen.start_ns, "stop_ns": self.chosen.stop_ns, "stride": self.request.stride}

    def _sensors_values(self) -> dict[str, Any]:
        return {
            "format": FORMAT,
            "digest": self.digest,
            **{k: v for k, v in option_values(self.request.options).items() if k in ("clocks", "offsets_ms")},
            "image_stream": self.chosen.shown or self.chosen.frames,
            "frame_stream": self.chosen.frames,
            "streams": self._kept_streams(),
            "order": self._order,
            "reference_stream": self.chosen.reference.stream,
            "raw_images": self.request.raw_images,
            "window": self._window_values(),
            "versions": {"estimator-workbench": _version("estimator-workbench"), "rerun-sdk": _version("rerun-sdk")},
        }

    @functools.cached_property
    def _earlier(self) -> dict[str, Any]:
        """What stands in the sensors' file by now, empty where there is none."""
        return _recorded(self.folder / "sensors.toml")

    @property
    def _order(self) -> str:
        """In what order and with which times the estimator gets the samples, in words."""
        order = "stamps" if self.chosen.latency is None else self.chosen.latency.order
        times = {k: v for k, v in option_values(self.request.options).items() if k in ("clocks", "offsets_ms")}
        return f"{order}; {times}" if times else order

    def _kept_streams(self) -> list[str]:
        """The streams whose samples the sensors' file holds: this run's, and those of the runs before it."""
        earlier = self._earlier
        same = ("digest", "image_stream", "frame_stream", "window", "order")
        now = {
            "digest": self.digest,
            "image_stream": self.chosen.shown or self.chosen.frames,
            "frame_stream": self.chosen.frames,
            "window": {key: value for key, value in self._window_values().items() if value is not None},
            "order": self._order,
        }
        kept = earlier.get("streams", []) if all(earlier.get(key) == now[key] for key in same) else []
        return sorted({self.chosen.frames, *self.chosen.others, *kept})

    def _write_toml(self, state: dict[str, Any]) -> None:
        values = {
            "format": FORMAT,
            "complete": state["complete"],
            "interrupted": bool(state.get("summary", {}).get("interrupted", False)),
            "run": {
                "name": self.name,
                "estimator": self.estimator.name,
                "preset": self.preset,
                "recording": str(self.request.path),
                "digest": self.digest,
                **option_values(self.request.options),
                "image_stream": self.chosen.frames,
                "other_streams": list(self.chosen.others),
                "order": self._order,
                "reference_stream": self.chosen.reference.stream,
                "reference_offset_s": self.request.reference_offset_s,
            },
            "window": self._window_values(),
            "settings": settings_values(self.estimator.settings),
            "versions": versions(),
            "summary": state.get("summary", {}),
        }
        _replace(self._file("toml"), to_toml(values))


# -------------------------------------------------------------------------------- helpers


def calibration(settings: Any, evaluation: Evaluation) -> dict[str, Any]:
    """What the scale settings would have to be, by least squares over the positions and by path length.

    Where the reference has headings, also the mounting yaw: a path that is turned against its own headings comes
    of a camera that is turned in the vehicle. Where no scale can be told, `key` is empty and `sentence` says why.
    """
    key = "metres_per_px" if getattr(settings, "metres_per_px", None) is not None else "focal_px"
    used = getattr(settings, key, None)
    if used is None:
        return {"key": "", "sentence": "not possible: this estimator has no scale to calibrate"}
    if not evaluation.alignment.determined or not evaluation.path_m > 0:
        return {"key": "", "sentence": "not possible: the path or its reference does not move"}
    by_length = evaluation.alignment.scale * evaluation.reference_path_m / evaluation.path_m
    factors = evaluation.fitted_scale, by_length
    fit, ratio = (used * f if key == "metres_per_px" else used / f for f in factors)
    found = {"key": key, "least_squares": fit, "path_ratio": ratio}
    advice = f"--set {key}={fit:.6g}"
    offsets = evaluation.errors[:, 3]
    if np.isfinite(offsets).any() and hasattr(settings, "mounting_yaw_rad"):
        found["mounting_yaw_rad"] = wrap_angle(settings.mounting_yaw_rad + mean_angle(offsets))
        advice += f" --set mounting_yaw_rad={found['mounting_yaw_rad']:.4f}"
    if abs(ratio / fit - 1) <= CALIBRATION_AGREES:
        advice = f"use {advice}"
    else:
        advice = "not to be used: the two do not agree, so that the path's shape is wrong, not only its scale"
    sentence = f"{key} = {fit:.6g} by least squares, {ratio:.6g} by path length; {advice}"
    return found | {"sentence": sentence}


def option_values(options: ReadOptions) -> dict[str, Any]:
    """The clocks, offsets and cameras that were asked for, as RUN.toml keeps them; nothing where none was."""
    values: dict[str, Any] = {}
    if options.clocks:
        values["clocks"] = [f"{topic}={clock}" for topic, clock in options.clocks]
    if options.offsets_ns:
        values["offsets_ms"] = [f"{topic}={ns / 1e6:.6f}" for topic, ns in options.offsets_ns]
    if options.cameras:
        values["cameras"] = [f"{c.topic}={c.path}#{c.name}" for c in options.cameras]
    if options.scale_cameras:
        values["scale_cameras"] = True
    return values


def versions() -> dict[str, str]:
    """Versions of Python, of the workbench and of the packages that results depend on."""
    return {"python": platform.python_version(), **{name: _version(name) for name in PACKAGES}}


@functools.cache
def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


def _trajectory_line(step: Step) -> str:
    """The line of a step in the trajectory's file, in space where it tells that; empty where it tells no pose."""
    if isinstance(step, VisualStep):
        return tum_line(step.t_ns, step.position_m, step.quat_xyzw) if step.accepted else ""
    pose = getattr(step, "pose", None)
    return "" if pose is None else tum_line_in_plane(step.t_ns, pose)


def _log_sample(sensors: SensorLog, step: Step, sample: ImageSample | Problem) -> None:
    if isinstance(sample, Problem):
        sensors.undecodable(step.frame, step.t_ns, sample.reason)
        return
    try:
        sensors.image(step.frame, sample)
    except ImageError as error:
        sensors.undecodable(step.frame, step.t_ns, str(error))


def _recorded(record: Path) -> dict[str, Any]:
    """What a file of TOML says, nothing where there is none that can be read."""
    try:
        return tomllib.loads(record.read_text("utf-8"))
    except (OSError, ValueError):
        return {}


def _flat(rows: Sequence[tuple[str, str]]) -> dict[str, str]:
    """Rows of names and texts as a mapping; texts of the same name are joined."""
    joined: dict[str, str] = {}
    for name, text in rows:
        joined[name] = f"{joined[name]}; {text}" if name in joined else text
    return joined


def _replace(file: Path, text: str) -> None:
    """Write a file so that it is there as a whole or not at all."""
    part = file.with_name(file.name + ".part")
    part.write_text(text, encoding="utf-8")
    part.replace(file)
