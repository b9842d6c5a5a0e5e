"""Rerun recordings: the door to writing and reading ``.rrd`` files.

A mission has one file of what was measured (`SensorWriter`) and one per run of what was concluded
(`RunWriter`); equal recording ids let one viewer show them together. Both write columns, close with a
footer, keep about half a second in memory, and put nothing of the wall clock into the data.
"""

from __future__ import annotations

import abc
import dataclasses
import functools
import hashlib
import itertools
import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Literal, Self

import cv2
import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray

from pipelines.correlation.step import CorrelationStep
from pipelines.estimator import Step
from pipelines.planar import heading_of_quat
from pipelines.ranging.step import RangeStep
from pipelines.semidirect.baseline_step import BaselineStep
from pipelines.semidirect.step import SemidirectStep
from pipelines.verdict import Severity, Verdict
from readers.streams import ImageError, ImageSample, PoseSample, RecordingError, Sample
from workbench import traces
from workbench.blueprints import Bounds, Extent, blueprint_of, sensor_blueprint
from workbench.rrd_columns import blobs, columns, lists, own_columns, repeated
from workbench.rrd_correlation import CorrelationDrawing
from workbench.rrd_drawing import Drawing
from workbench.rrd_file import APPLICATION as APPLICATION
from workbench.rrd_file import (
    ARROW_SHARE,
    COLOURS,
    IMAGE,
    REFERENCE,
    RrdFile,
    arrow,
    document,
    flat,
    marker,
    numbers,
    texts,
)
from workbench.rrd_ranges import RangeDrawing
from workbench.rrd_reading import around, chunks, listed
from workbench.rrd_reading import merge as merge
from workbench.rrd_reading import recover as recover
from workbench.rrd_samples import SampleLog, is_grey
from workbench.rrd_semidirect import SemidirectDrawing, VisualDrawing
from workbench.schema import Archetype, Row, Schema, schema_of

if TYPE_CHECKING:
    import pandas as pd

MAX_ROWS = 1024
MAX_BYTES = 2 << 20
MAX_SAMPLES = 8192
MAX_AGE_S = 0.5
Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


_DRAWINGS: Mapping[type[Step], type[Drawing]] = {
    CorrelationStep: CorrelationDrawing,
    RangeStep: RangeDrawing,
    SemidirectStep: SemidirectDrawing,
    BaselineStep: VisualDrawing,
}


class _Writer(abc.ABC):
    """What both writers share: the file, the age of the buffer, and an orderly end."""

    def __init__(self, path: Path | str, recording_id: str) -> None:
        self._file = RrdFile(Path(path), recording_id)
        self._sent = -np.inf
        self._open = True

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def flush(self) -> None:
        """Write what is buffered."""
        self._write()
        self._file.flush()
        self._sent = time.monotonic()

    def close(self) -> None:
        """Write what is buffered and the footer; a second call does nothing."""
        if self._open:
            self._open = False
            self._write()
            self._file.close()

    def _write_if(self, full: bool) -> None:
        """Send what is buffered where that is much; where it is old, wait until it is written, too."""
        if time.monotonic() - self._sent > MAX_AGE_S:
            self.flush()
        elif full:
            self._write()

    @abc.abstractmethod
    def _write(self) -> None:
        """Send what is buffered as columns."""


# ----------------------------------------------------------------------------- sensors


class SensorWriter(_Writer):
    """Writes what was measured: the images as they were stored, the reference, facts of the recording.

    Args:
        path: the file to write.
        recording_id: the mission's id, equal in all its files.
        raw_images: whether images without a viewable stored form go in as PNG or as raw pixels.
        view: the view that the file brings along. A viewer shows that of the file it read last: give that of
            a run (``functools.partial(blueprint_of, step_type, run, estimator)``) or open the run's file last.

    Raises:
        WorkbenchError: Rerun is switched off.
        RecordingError: the file cannot be written.
    """

    def __init__(
        self,
        path: Path | str,
        *,
        recording_id: str,
        raw_images: Literal["png", "raw"] = "png",
        view: Callable[[Bounds], rr.blueprint.Blueprint] = sensor_blueprint,
    ) -> None:
        super().__init__(path, recording_id)
        self._view = view
        self._bounds: Bounds | None = Bounds()  # of the view as it is to be sent, None once it is
        self._raw_images = raw_images
        self._images: list[tuple[int, int, Any, str]] = []
        self._pixels: list[tuple[int, int, NDArray[Any]]] = []
        self._frames: list[tuple[int, int]] = []
        self._bytes = 0
        self._samples = SampleLog(self._file)
        self._reference: tuple[Ints, Floats, Floats] | None = None
        self._arrow_m = 1.0

    def image(self, frame: int, sample: ImageSample) -> None:
        """Log a frame's image; stored JPEG and PNG bytes pass through unaltered.

        Raises:
            ImageError: the image has to be decoded for the log and cannot be.
        """
        if sample.media_type is not None:
            self._encoded(frame, sample.t_ns, sample.data, sample.media_type)
        else:
            pixels = sample.grey() if is_grey(sample.encoding) else sample.colour()
            if self._raw_images == "raw":
                self._pixels.append((frame, sample.t_ns, pixels))
                self._bytes += pixels.nbytes
            else:
                self._encoded(frame, sample.t_ns, _png(pixels, sample), "image/png")
        self._frames.append((frame, sample.t_ns))
        if self._bytes > MAX_BYTES:
            self._write_images()
        self._write_if(len(self._frames) >= MAX_ROWS)

    def sample(self, original: Sample, decoded: Sample) -> None:
        """Log the next sample in the order of arrival, as it was stored and as the estimator got it."""
        self._samples.add(original, decoded)
        self._write_if(self._samples.bytes > MAX_BYTES or len(self._samples) >= MAX_SAMPLES)

    def undecodable(self, frame: int, t_ns: int, reason: str) -> None:
        """Log that a frame has no image, and why; the viewer then shows none."""
        self._write()
        at = np.array([frame]), np.array([t_ns])
        self._file.send("/camera/problems", *at, texts([traces.Event(frame, Severity.ERROR, reason)]))
        self._file.send(IMAGE, *at, columns(rr.Clear, is_recursive=[False]))

    def reference(self, poses: Sequence[PoseSample]) -> None:
        """Log the reference: its path, its numbers, and from now on its pose at every image's time."""
        ordered = sorted(poses, key=lambda pose: pose.t_ns)
        if not ordered:
            return
        t_ns = np.array([pose.t_ns for pose in ordered], np.int64)
        position = np.array([pose.position_m for pose in ordered], np.float64)
        heading = np.array([heading_of_quat(pose.quat_xyzw) for pose in ordered])
        self._reference = t_ns, position, np.unwrap(heading)
        extent = Extent.of(position[:, :2])
        self._arrow_m = extent.size_m * ARROW_SHARE
        self._file.scale_bar(extent)
        self._bounds = Bounds(extent=extent)
        points = flat(position[:, :2], "reference")
        path = rr.LineStrips3D([points], colors=COLOURS["reference"], radii=rr.Radius.ui_points(2.5))
        self._file.static(f"{REFERENCE}/path", path)
        self._file.static(f"{REFERENCE}/pose", marker("reference", 7))
        self._file.static(f"{REFERENCE}/heading", arrow("reference", 3))
        names = ["x [m]", "y [m]", "z [m]", "heading [rad]"]
        self._file.static("/sensors/reference", rr.SeriesLines(names=names))
        values = np.column_stack([position, heading])
        self._file.send("/sensors/reference", None, t_ns, columns(rr.Scalars, scalars=values))

    def facts(self, lines: Iterable[str]) -> None:
        """Log facts of the recording, one Markdown line each."""
        self._file.static("/recording/facts", document("\n".join(f"- {line}" for line in lines)))

    def _encoded(self, frame: int, t_ns: int, data: Any, media_type: str) -> None:
        self._images.append((frame, t_ns, data, media_type))
        self._bytes += len(data)

    def _write(self) -> None:
        if self._bounds is not None:
            self._file.blueprint(self._view(self._bounds))
            self._bounds = None
        self._write_images()
        self._samples.write()
        if self._frames and self._reference is not None:
            frames, t_ns = np.array(self._frames, np.int64).T
            self._write_reference(frames, t_ns, *self._reference)
        self._frames = []

    def _write_images(self) -> None:
        """Send the images alone: they are many bytes long before they are many rows."""
        if self._images:
            frames, t_ns, data, media = zip(*self._images, strict=True)
            images = columns(rr.EncodedImage, blob=blobs(data), media_type=media)
            self._file.send(IMAGE, np.array(frames), np.array(t_ns), images)
        for frame, when, pixels in self._pixels:
            buffer = columns(rr.Image, buffer=blobs([pixels.tobytes()]))
            form = repeated(rr.Image, 1, format=_format(pixels))
            self._file.send(IMAGE, np.array([frame]), np.array([when]), buffer, form)
        self._images, self._pixels, self._bytes = [], [], 0

    def _write_reference(self, frames: Ints, t_ns: Ints, at_ns: Ints, position: Floats, heading: Floats) -> None:
        inside = (t_ns >= at_ns[0]) & (t_ns <= at_ns[-1])
        frames, t_ns = frames[inside], t_ns[inside]
        since, known = (t_ns - at_ns[0]).astype(float), (at_ns - at_ns[0]).astype(float)
        x, y, alpha = (np.interp(since, known, values) for values in (position[:, 0], position[:, 1], heading))
        points = flat(np.column_stack([x, y]), "reference")
        self._file.send(f"{REFERENCE}/pose", frames, t_ns, columns(rr.Points3D, positions=points))
        vectors = flat(self._arrow_m * np.column_stack([np.cos(alpha), np.sin(alpha)]))
        good = np.isfinite(vectors).all(axis=1)
        arrows = columns(rr.Arrows3D, vectors=vectors[good], origins=points[good])
        self._file.send(f"{REFERENCE}/heading", frames[good], t_ns[good], arrows)


def _png(pixels: NDArray[Any], sample: ImageSample) -> bytes:
    bgr = pixels if pixels.ndim == 2 else cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR)
    good, data = cv2.imencode(".png", bgr, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    if not good:
        raise ImageError(f"{sample.source or sample.stream}: the image cannot be encoded as PNG")
    return bytes(data)


def _format(pixels: NDArray[Any]) -> rr.components.ImageFormat:
    return rr.components.ImageFormat(
        width=pixels.shape[1],
        height=pixels.shape[0],
        color_model="L" if pixels.ndim == 2 else "RGB",
        channel_datatype="U8" if pixels.dtype == np.uint8 else "U16",
    )


# -------------------------------------------------------------------------------- runs


class RunWriter(_Writer):
    """Writes what one run concluded: every field of its steps, what is drawn of them, verdicts.

    Args:
        path: the file to write.
        recording_id: the mission's id, equal in all its files.
        run: name of the run, one part of an entity path.
        estimator: name of the estimator, likewise.
        step_type: class of the steps; it needs a schema.
        settings_text: the settings as they are saved beside the result.
        ground: points [n, 2] in m that the map shows beside the run's own path, such as the reference's.
        scene: what the drawing of this estimator's steps needs to know beyond them, see its `Drawing`.

    Raises:
        WorkbenchError: Rerun is switched off, or the Step class has no schema.
        RecordingError: the file cannot be written.
    """

    def __init__(
        self,
        path: Path | str,
        *,
        recording_id: str,
        run: str,
        estimator: str,
        step_type: type[Step],
        settings_text: str,
        ground: Floats | None = None,
        scene: Any = None,
    ) -> None:
        self._schema = schema_of(step_type)
        self._run, self._estimator = run, estimator
        super().__init__(path, recording_id)
        self._root = f"/runs/{run}/{estimator}"
        self._steps: list[Step] = []
        self._beside: list[Any] = []
        self._shape_of = traces.shape_of(self._schema)
        self._shape: Any = None
        self._changes = traces.Changes()
        self._lanes: dict[Verdict, bool] = {}
        self._span: tuple[int, int] | None = None
        self._told: set[str] = set()
        drawing = _DRAWINGS.get(step_type, Drawing)
        self._drawing = drawing(self._file, self._schema, run, estimator, scene)
        self._file.static(f"/runs/{run}/settings", rr.TextDocument(settings_text, media_type="text/plain"))
        self._constants()
        self._bounds = Bounds(extent=None if ground is None else Extent.of(ground))

    def step(self, step: Step, beside: Any = None) -> None:
        """Log one step, and what is known of its frame from elsewhere, for estimators whose drawing shows that."""
        shape = self._shape_of(step)
        if shape != self._shape:
            self._write()
            self._shape = shape
            self._legends(step)
        self._steps.append(step)
        self._beside.append(beside)
        self._write_if(len(self._steps) >= self._capacity)

    def event(self, frame: int, t_ns: int, severity: Severity, text: str) -> None:
        """Log something worth stepping to that no verdict says."""
        line = texts([traces.Event(0, severity, text)])
        self._file.send(f"{self._root}/events", np.array([frame]), np.array([t_ns]), line)

    def errors(self, frames: Ints, t_ns: Ints, values: Floats) -> None:
        """Log the errors against the reference: x, y, distance (m), heading (rad) [n, 4] at frames and times [n]."""
        names = ["x [m]", "y [m]", "distance [m]", "heading [rad]"]
        colours = np.array([0x42A5F5FF, 0xFFB74DFF, 0xFFFFFFFF, 0x42A5F5FF], np.uint32)
        self._file.static(f"{self._root}/error", rr.SeriesLines(names=names, colors=colours))
        self._told |= {"error"} if np.isfinite(values).any() else set()
        rows = columns(rr.Scalars, scalars=values)
        self._file.send(f"{self._root}/error", np.asarray(frames, np.int64), np.asarray(t_ns, np.int64), rows)

    def smoothed(self, slot: int, frames: Ints, t_ns: Ints, mean: Floats, covariance: Floats) -> None:
        """Log what smoothing says of the landmarks in a slot, at n of its frames.

        Args:
            slot: from 0.
            frames: numbers of the frames [n], rising.
            t_ns: their times [n].
            mean: x, y, ξ (px, px, 1/m) [n, 3].
            covariance: of these [n, 3, 3].
        """
        self.flush()
        self._drawing.smoothed(slot, frames, t_ns, mean, covariance)

    def finish(self, summary: Mapping[str, str | float | int], aligned_path: Floats | None) -> None:
        """Log what is known at the end: the summary, the whole path, and the path [n, 2] aligned with the reference."""
        self.flush()
        rows = "\n\n".join(f"**{key}** – {_number(value)}" for key, value in summary.items())
        self._file.static(f"/runs/{self._run}/summary", document(rows))
        known = self._drawing.finish(aligned_path, self._bounds.extent)
        silent = frozenset({*self._schema.of(Archetype.SCALARS), "error"} - self._told) | self._drawing.silent
        self._view(**({} if self._span is None else {"frames": self._span}), silent=silent, **known)

    # ---- what is logged once

    def _constants(self) -> None:
        verdicts = list(Verdict)
        names = [str(v.name) for v in [Verdict.OK, *verdicts]]
        colours = [traces.SEVERITY_COLOURS[v.severity] for v in [Verdict.OK, *verdicts]]
        lanes = rr.StateConfiguration(values=names, labels=names, colors=colours)
        self._file.static(f"{self._root}/verdict", lanes)
        self._drawing.constants()

    def _legends(self, step: Step) -> None:
        """Log the names of the series, which depend on the number of fragments or landmarks."""
        table = traces.columns(self._schema, [step])
        for entity, values in traces.scalar_groups(self._schema, table):
            series = self._schema.series(entity, values.shape[1])
            colours = np.array([one.colour for one in series], np.uint32)
            lines = rr.SeriesLines(names=[one.name for one in series], colors=colours)
            self._file.static(f"{self._root}/{entity}", lines)
        self._view(**self._drawing.legends(table))
        self._capacity = max(1, min(MAX_ROWS, MAX_BYTES // self._drawing.bytes_a_step(table)))

    # ---- what is logged with every step

    def _write(self) -> None:
        if not self._steps:
            return
        table, beside = traces.columns(self._schema, self._steps), self._beside
        self._steps, self._beside = [], []
        frames = table["frame"]
        first, last = int(frames.min()), int(frames.max())
        self._span = (first, last) if self._span is None else (min(first, self._span[0]), max(last, self._span[1]))
        self._values(table)
        self._drawing.write(table, beside)
        self._verdicts(table)

    def _send(self, entity: str, table: traces.Columns, *columns: Iterable[Any]) -> None:
        self._file.send(f"{self._root}/{entity}", table["frame"], table["t_ns"], *columns)

    def _values(self, table: traces.Columns) -> None:
        for entity, values in traces.scalar_groups(self._schema, table):
            if entity not in self._told and np.nan_to_num(values).any():
                self._told.add(entity)
            self._send(entity, table, columns(rr.Scalars, scalars=values))
        for entity, rows in self._schema.of(Archetype.INTEGERS).items():
            integers = {row.field: table[row.field] for row in rows}
            self._send(entity, table, own_columns(Archetype.INTEGERS.value, integers))
        for entity, rows in self._schema.of(Archetype.LISTS).items():
            joined = {row.field: traces.Joined.of(table[row.field]) for row in rows}
            self._send(entity, table, lists(Archetype.LISTS.value, joined))

    def _verdicts(self, table: traces.Columns) -> None:
        events, changes = self._changes.take(table)
        self._log("events", table, events)
        self._log("alarms", table, traces.verdict_lines(table))
        if not changes:
            return
        at = np.array([row for row, _, _ in changes])
        frames, t_ns = table["frame"][at], table["t_ns"][at]
        names = [str(verdict.name) for _, verdict, _ in changes]
        self._file.send(f"{self._root}/verdict", frames, t_ns, columns(rr.StateChange, state=names))
        for row, _, alarms in changes:
            self._alarm_lanes(int(table["frame"][row]), int(table["t_ns"][row]), alarms)

    def _alarm_lanes(self, frame: int, t_ns: int, alarms: Verdict) -> None:
        """One lane for every alarm that ever rang; the first frame of every run needs none."""
        for flag in (flag for flag in Verdict if flag is not Verdict.FIRST_FRAME):
            rings = flag in alarms
            if rings == self._lanes.get(flag, False):
                continue
            entity = f"{self._root}/verdicts/{flag.name}"
            if flag not in self._lanes:
                name, colour = str(flag.name), traces.SEVERITY_COLOURS[flag.severity]
                self._file.static(entity, rr.StateConfiguration(values=[name], labels=[name], colors=[colour]))
            self._lanes[flag] = rings
            state = str(flag.name) if rings else ""
            self._file.send(entity, np.array([frame]), np.array([t_ns]), columns(rr.StateChange, state=[state]))

    def _log(self, entity: str, table: traces.Columns, events: Sequence[traces.Event]) -> None:
        if events:
            at = np.array([event.row for event in events])
            self._file.send(f"{self._root}/{entity}", table["frame"][at], table["t_ns"][at], texts(events))

    # ---- the view

    def _view(self, **known: Any) -> None:
        """Send the view again with what is known by now."""
        self._bounds = dataclasses.replace(self._bounds, **known)
        self._file.blueprint(blueprint_of(self._schema.step_type, self._run, self._estimator, self._bounds))


def _number(value: str | float | int) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


# ----------------------------------------------------------------------------- reading


def read_steps(path: Path | str, run: str, step_type: type[Step], frames: range | None = None) -> list[Step]:
    """The Steps of a run, or of some of its frames, from a finished file or from what a killed process left.

    Every number is exactly the one that was logged, surfaces within the step of float16. All steps stand in
    memory at once, about 25 kB each with nine surfaces: of a long run, take single fields with `read_fields`.

    Raises:
        RecordingError: the file cannot be read, or holds no such run.
    """
    schema = schema_of(step_type)
    fields = [row.field for row in schema.rows]
    return list(traces.rebuild(schema, read_fields(path, run, step_type, fields, frames)))


def read_fields(
    path: Path | str, run: str, step_type: type[Step], fields: Iterable[str], frames: range | None = None
) -> dict[str, Sequence[Any]]:
    """Some fields of a run's steps: one value per frame, in the order of the frames.

    Args:
        path: the run's file.
        run: name of the run.
        step_type: class of its steps.
        fields: names of fields.
        frames: numbers of the frames, a range without steps; None for all.

    Raises:
        RecordingError: the file cannot be read, or holds no such run or none of the frames.
    """
    schema = schema_of(step_type)
    wanted = list(fields)
    needed = schema.sharing({*wanted, "verdict", *(_SURFACE_NEEDS if "surface" in wanted else ())})
    components = sorted({row.component for row in needed if row.component} | {_FORMAT})
    parts = chunks(Path(path), f"/runs/{run}/**", components=components)
    rows = _whole_rows(parts if frames is None else around(parts, frames), needed, frames)
    logged, t_ns, _ = next(iter(rows.values()))
    if not len(logged):
        some = "" if frames is None else f" from frame {frames.start} to before {frames.stop}"
        raise RecordingError(path, f"holds no steps of a run named {run!r}{some}", "name a run of this file")
    table: dict[str, Sequence[Any]] = {}
    for entity, group in schema.of(Archetype.SCALARS).items():
        if (entity, group[0].component) in rows:
            table |= _split(schema, group, rows[entity, group[0].component][2])
    for row in needed:
        if row.archetype is Archetype.TIMELINE:
            table[row.field] = {"frame": logged, "sensor_time": t_ns}[row.entity].tolist()
        elif row.archetype is Archetype.INTEGERS:
            table[row.field] = [int(value[0]) for value in rows[row.entity, row.component][2]]
        elif row.archetype is Archetype.SURFACES:
            formats = rows[row.entity, _FORMAT][2]
            table[row.field] = _surfaces(rows[row.entity, row.component][2], formats, table)
    table |= listed(
        schema, {row.field: rows[row.entity, row.component][2] for row in needed if row.field in schema.lists}
    )
    return {field: table[field] for field in wanted}


def read_table(path: Path | str, run: str, step_type: type[Step], fields: Iterable[str]) -> pd.DataFrame:
    """Some fields of a run's steps as a table with one row per frame, the frame's number as its index.

    A field of one number is a column of its name, an element of an array one named like ``pose[0]`` or
    ``shift_px[3,1]``.

    Raises:
        RecordingError: the file cannot be read, or holds no such run.
    """
    import pandas as pd

    values = read_fields(path, run, step_type, ["frame", *fields])
    frames = values.pop("frame")
    columns: dict[str, Any] = {}
    for field, items in values.items():
        array = np.asarray(items)
        for index in np.ndindex(array.shape[1:]):
            name = f"{field}[{','.join(map(str, index))}]" if index else field
            columns[name] = array[(slice(None), *index)]
    return pd.DataFrame(columns, index=pd.Index(frames, name="frame"))


_FORMAT = "DepthImage:format"
_SURFACE_NEEDS = ("fragment_px", "fragment_side_px")  # where each surface lies in the mosaic
_Rows = tuple[Ints, Ints, list[Any]]


def _whole_rows(
    chunks: Iterable[Any], needed: Iterable[Row], wanted: range | None = None
) -> dict[tuple[str, str], _Rows]:
    """Frames, sensor times and values of each component, in the order of the frames; of the wanted frames only.

    Frames that lack a component are left out: they stood at the torn end of a file.
    """
    parts: dict[tuple[str, str], list[_Rows]] = {}
    for row in needed:
        if row.component:
            parts[row.entity, row.component] = []
        if row.archetype is Archetype.SURFACES:
            parts[row.entity, _FORMAT] = []
    entities = {entity for entity, _ in parts}
    for chunk in chunks:
        entity = chunk.entity_path.split("/", 4)[-1]  # below /runs/RUN/ESTIMATOR
        if entity not in entities:
            continue
        batch = chunk.to_record_batch()
        if wanted is not None:
            frames = numbers(batch.column("frame"))
            batch = batch.filter(pa.array((frames >= wanted.start) & (frames < wanted.stop)))
        for component in batch.schema.names:
            if batch.num_rows and (entity, component) in parts:
                frames = numbers(batch.column("frame"))
                t_ns = numbers(batch.column("sensor_time"))
                parts[entity, component].append((frames, t_ns, _lists(batch.column(component))))
    whole = functools.reduce(np.intersect1d, (_concatenated(part)[0] for part in parts.values()))
    return {key: _only(whole, *_concatenated(part)) for key, part in parts.items()}


def _concatenated(parts: Sequence[_Rows]) -> _Rows:
    empty = np.empty(0, np.int64)
    frames, t_ns = (np.concatenate([empty, *(part[i] for part in parts)]) for i in (0, 1))
    return frames, t_ns, [value for part in parts for value in part[2]]


def _only(whole: Ints, frames: Ints, t_ns: Ints, values: list[Any]) -> _Rows:
    order = np.argsort(frames, kind="stable")
    order = order[np.isin(frames[order], whole)]
    return frames[order], t_ns[order], [values[i] for i in order]


def _split(schema: Schema, rows: Sequence[Row], values: Sequence[Floats]) -> dict[str, list[Any]]:
    """The rows of a group of scalars as the values of its fields."""
    table: dict[str, list[Any]] = {}
    start = 0
    for row in rows:
        shape = schema.shape(row.field)
        fixed = [n for n in shape if isinstance(n, int)]
        width = math.prod(fixed)
        if len(fixed) < len(shape):
            table[row.field] = [value.reshape(-1, *fixed) for value in values]
        elif shape:
            table[row.field] = [value[start : start + width].reshape(fixed) for value in values]
        else:
            table[row.field] = [value[start] for value in values]
        start += width
    return table


def _surfaces(
    buffers: Iterable[Any], formats: Iterable[Any], table: Mapping[str, Sequence[Any]]
) -> list[NDArray[np.float32]]:
    surfaces = []
    fragments = zip(table["fragment_px"], table["fragment_side_px"], strict=True)
    for buffer, (format_,), (px, side) in zip(buffers, formats, fragments, strict=True):
        image = buffer.view(np.float16).reshape(format_["height"], format_["width"])
        surfaces.append(traces.unmosaic(image, traces.cells(px, float(side))))
    return surfaces


def _lists(column: pa.ListArray) -> list[Any]:
    """The rows of an Arrow column of lists: numpy arrays of numbers, else Python lists."""
    kind = column.type.value_type
    if pa.types.is_list(kind):
        column, kind = column.flatten(), kind.value_type
    if not (pa.types.is_integer(kind) or pa.types.is_floating(kind)):
        return list(column.to_pylist())
    bounds = np.cumsum([0, *column.value_lengths().to_pylist()])
    flat = numbers(column.flatten())
    return [flat[a:b] for a, b in itertools.pairwise(bounds)]


# ------------------------------------------------------------------------- whole files


def digest(path: Path | str) -> str:
    """SHA-256 of a file's data, equal for equal data however the rows were cut into chunks.

    Raises:
        RecordingError: the file cannot be read.
    """
    rows: dict[tuple[str, ...], list[bytes]] = {}
    for chunk in chunks(Path(path), "/**", is_static=None):
        batch = chunk.to_record_batch()
        names = sorted(name for name in batch.schema.names if not name.startswith("rerun.controls."))
        for row in batch.select(names).to_pylist():
            key = (chunk.entity_path, str([row.get(name) for name in ("frame", "sensor_time")]), *names)
            rows.setdefault(key, []).append(hashlib.sha256(repr(row).encode()).digest())
    total = hashlib.sha256()
    for key in sorted(rows):
        total.update(repr((key, rows[key])).encode())
    return total.hexdigest()
