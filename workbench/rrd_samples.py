"""The samples that an estimator got, in ``sensors.rrd``: written as columns, read back as the readers' objects.

Each stream has the entity ``/sensors/streams/STREAM``. What every sample has stands in the components ``Sample:…``:
its class, its place `order` in the order in which all streams came, `received_ns`, the number of a frame. Numbers that
make a plot are `Scalars`; tracks and landmarks keep theirs in ``Sample:values``. An image's pixels stand at
``/camera/image``; only where that picture does not give back the very grey levels that the estimator got, these stand
at ``/sensors/grey/STREAM`` once more, as PNG. Of messages that have a stamp, ``/sensors/clocks/STREAM`` plots by how
much log time exceeds it, in ms.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray

from readers.streams import (
    ImageError,
    ImageSample,
    ImuSample,
    LandmarkSample,
    OdometrySample,
    PoseSample,
    Problem,
    RangeSample,
    Sample,
    ScalarSample,
    StreamKind,
    TrackSample,
)
from workbench.rrd_columns import columns, own_columns
from workbench.rrd_file import RrdFile
from workbench.rrd_file import numbers as plain

ROOT = "/sensors/streams"
GREY = "/sensors/grey"
CLOCKS = "/sensors/clocks"
ARCHETYPE = "Sample"
_SCALARS = "Scalars:scalars"


class Form(NamedTuple):
    """How the samples of a class stand in columns.

    `numbers` are the float fields with their shapes, -1 for one that a sample decides; `texts` the fields of text;
    `plotted`: the numbers have the same meaning in every sample, and make a plot.
    """

    kind: type[Sample]
    numbers: tuple[tuple[str, tuple[int, ...]], ...] = ()
    texts: tuple[str, ...] = ()
    plotted: bool = True


FORMS = {
    form.kind.__name__: form
    for form in (
        Form(ImageSample),
        Form(Problem, texts=("kind", "reason")),
        Form(ScalarSample, (("value", ()),)),
        Form(
            RangeSample,
            (("range_m", ()), ("min_range_m", ()), ("max_range_m", ()), ("field_of_view_rad", ())),
        ),
        Form(
            PoseSample,
            (("position_m", (3,)), ("quat_xyzw", (4,)), ("covariance", (6, 6))),
            ("parent_frame", "child_frame"),
        ),
        Form(
            ImuSample,
            (("angular_velocity_radps", (3,)), ("linear_acceleration_mps2", (3,)), ("quat_xyzw", (4,))),
        ),
        Form(
            OdometrySample,
            (
                ("linear_velocity_mps", (3,)),
                ("angular_velocity_radps", (3,)),
                ("position_m", (3,)),
                ("quat_xyzw", (4,)),
            ),
        ),
        Form(TrackSample, (("points_px", (-1, 2)),), plotted=False),
        Form(LandmarkSample, (("range_m", (-1,)), ("bearing_rad", (-1,))), plotted=False),
    )
}


def entity_of(stream: str, root: str = ROOT) -> str:
    """Where the samples of a stream stand; under `GREY` their grey levels, under `CLOCKS` the lag of log time."""
    return "/".join([root, *(rr.escape_entity_path_part(part) for part in stream.split("/") if part)])


class Stored(NamedTuple):
    """A sample of the log and its place in the order of arrival; of an image that was read without its payload."""

    order: int
    sample: Sample


# ---------------------------------------------------------------------------------- writing


class SampleLog:
    """Buffers samples and sends them as columns."""

    def __init__(self, file: RrdFile) -> None:
        self._file = file
        self._rows: list[Stored] = []
        self._greys: list[tuple[ImageSample, bytes]] = []
        self._named: set[str] = set()
        self._count = 0
        self.bytes = 0

    def __len__(self) -> int:
        return len(self._rows)

    def add(self, original: Sample, decoded: Sample) -> None:
        """Take the next sample in the order of arrival, as it was stored and as the estimator got it.

        Samples of classes that no estimator takes count, and are not kept.
        """
        kept = decoded if isinstance(decoded, Problem) else original
        order, self._count = self._count, self._count + 1
        if type(kept).__name__ in FORMS:
            self._rows.append(Stored(order, kept))
        if isinstance(original, ImageSample) and isinstance(decoded, ImageSample) and _differs(original, decoded):
            self._greys.append((original, _png(decoded)))
            self.bytes += len(self._greys[-1][1])

    def write(self) -> None:
        """Send what is buffered."""
        rows, greys = self._rows, self._greys
        self._rows, self._greys, self.bytes = [], [], 0
        for (stream, kind), group in _grouped(rows, lambda row: (row.sample.stream, type(row.sample).__name__)):
            self._send(entity_of(stream), FORMS[kind], group)
        for stream, images in _grouped(greys, lambda grey: grey[0].stream):
            pixels = np.frombuffer(b"".join(data for _, data in images), np.uint8)
            stored = own_columns(ARCHETYPE, {"grey": pixels}, [len(data) for _, data in images])
            frames, t_ns = (np.array([getattr(s, name) for s, _ in images], np.int64) for name in ("frame", "t_ns"))
            self._file.send(entity_of(stream, GREY), frames, t_ns, stored)

    def _send(self, entity: str, form: Form, rows: Sequence[Stored]) -> None:
        samples = [row.sample for row in rows]
        components: dict[str, Any] = {
            "order": [row.order for row in rows],
            "received_ns": [sample.received_ns for sample in samples],
            "class": [form.kind.__name__] * len(rows),
        }
        lists: dict[str, list[Any]] = {
            "texts": [[*(str(getattr(s, name)) for name in form.texts), *s.oddities] for s in samples]
        }
        if hasattr(samples[0], "ids"):
            lists["ids"] = [s.ids for s in samples]  # type: ignore[attr-defined]
        sent: list[rr.ComponentColumn] = []
        if form.numbers and form.plotted:
            self._legend(entity, form)
            sent += columns(rr.Scalars, scalars=_table(form, samples))
        elif form.numbers:
            lists["values"] = [_numbers(form, sample) for sample in samples]
        sent += own_columns(ARCHETYPE, components)
        for name, values in lists.items():
            flat: Any = list(itertools.chain(*values)) if name == "texts" else np.concatenate(values)
            if not len(flat):
                continue
            sent += own_columns(ARCHETYPE, {name: flat}, [len(v) for v in values])
        # not on the timeline of frames: its numbers are those of the frames of one stream
        t_ns = np.array([sample.t_ns for sample in samples], np.int64)
        frames = np.array([getattr(sample, "frame", -1) for sample in samples], np.int64)
        on_frames = bool((frames >= 0).all())
        self._file.send(entity, frames if on_frames else None, t_ns, sent)
        self._lags(samples, frames if on_frames else None, t_ns)

    def _lags(self, samples: Sequence[Sample], frames: NDArray[np.int64] | None, t_ns: NDArray[np.int64]) -> None:
        """Log time less header stamp of the samples that have both, ms."""
        stamped = [sample.header_ns > 0 for sample in samples]
        lags_ms = [(sample.received_ns - sample.header_ns) / 1e6 for sample in itertools.compress(samples, stamped)]
        entity = entity_of(samples[0].stream, CLOCKS)
        if lags_ms and entity not in self._named:
            self._named.add(entity)
            self._file.static(entity, rr.SeriesLines(names=[f"{samples[0].stream}: log time - stamp, ms"]))
        lags = columns(rr.Scalars, scalars=lags_ms)
        self._file.send(entity, None if frames is None else frames[stamped], t_ns[stamped], lags)

    def _legend(self, entity: str, form: Form) -> None:
        if entity not in self._named:
            self._named.add(entity)
            self._file.static(entity, rr.SeriesLines(names=list(_names(form))))


def _numbers(form: Form, sample: Sample) -> NDArray[np.float64]:
    parts = [np.asarray(getattr(sample, name), np.float64).ravel() for name, _ in form.numbers]
    return np.concatenate(parts)


def _table(form: Form, samples: Sequence[Sample]) -> NDArray[np.float64]:
    """The numbers of samples that all have as many of them [n, k]."""
    parts = [np.array([getattr(sample, name) for sample in samples], np.float64) for name, _ in form.numbers]
    return np.concatenate([part.reshape(len(samples), -1) for part in parts], axis=1)


def _names(form: Form) -> Iterable[str]:
    for name, shape in form.numbers:
        for index in np.ndindex(*shape):
            yield f"{name}[{','.join(map(str, index))}]" if index else name


def _grouped(items: Iterable[Any], key: Callable[[Any], Any]) -> list[tuple[Any, list[Any]]]:
    groups: dict[Any, list[Any]] = {}
    for item in items:
        groups.setdefault(key(item), []).append(item)
    return list(groups.items())


def _differs(original: ImageSample, decoded: ImageSample) -> bool:
    """Whether the picture in the log may not give back the grey levels: it is a picture in colour, made for the log."""
    return original is not decoded and original.media_type is None and not is_grey(original.encoding)


def _png(sample: ImageSample) -> bytes:
    good, data = cv2.imencode(".png", sample.grey(), [cv2.IMWRITE_PNG_COMPRESSION, 1])
    if not good:
        raise ImageError(f"{sample.source or sample.stream}: the grey levels cannot be encoded as PNG")
    return bytes(data)


def is_grey(encoding: str) -> bool:
    """Whether a raw encoding is grey levels as they are."""
    return encoding.lower().startswith(("mono", "8uc1", "16uc1"))


# ---------------------------------------------------------------------------------- reading


def samples_of(stream: str, batches: Iterable[pa.RecordBatch], after: int, upto: int) -> list[Stored]:
    """The samples of a stream out of the columns of its entity, in the order of arrival.

    Only those from behind one place in that order up to another included.
    """
    found: list[Stored] = []
    for batch in batches:
        order = order_of(batch)
        rows = np.flatnonzero((order > after) & (order <= upto))
        if len(rows):
            first = int(rows[0])
            part = _of_batch(stream, batch.slice(first, int(rows[-1]) + 1 - first))
            found += (stored for stored in part if after < stored.order <= upto)
    return sorted(found, key=lambda stored: stored.order)


def order_of(batch: pa.RecordBatch) -> NDArray[np.int64]:
    """Places of the rows in the order of arrival."""
    return np.asarray(plain(batch.column(f"{ARCHETYPE}:order").flatten()), np.int64)


def _of_batch(stream: str, batch: pa.RecordBatch) -> Iterable[Stored]:
    names = batch.schema.names

    def column(name: str) -> list[Any]:
        return batch.column(name).to_pylist() if name in names else [None] * batch.num_rows

    t_ns = plain(batch.column("sensor_time")).tolist()
    orders, received, kinds = (column(f"{ARCHETYPE}:{name}") for name in ("order", "received_ns", "class"))
    numbers = _arrays(batch, f"{ARCHETYPE}:values" if f"{ARCHETYPE}:values" in names else _SCALARS, np.float64)
    ids = _arrays(batch, f"{ARCHETYPE}:ids", np.int64)
    texts, frames = column(f"{ARCHETYPE}:texts"), column("frame")
    for i in range(batch.num_rows):
        form = FORMS[kinds[i][0]]
        words = texts[i] or []
        fields: dict[str, Any] = dict(zip(form.texts, words[: len(form.texts)], strict=True))
        fields |= _split(form, numbers[i], len(ids[i]))
        common = {"stream": stream, "t_ns": t_ns[i], "received_ns": received[i][0]}
        common["oddities"] = tuple(words[len(form.texts) :])
        if form.kind in (TrackSample, LandmarkSample):
            fields["ids"] = ids[i]
        if form.kind in (TrackSample, LandmarkSample, ImageSample, Problem):
            fields["frame"] = -1 if frames[i] is None else frames[i]
        if form.kind is Problem:
            fields["kind"] = StreamKind(fields["kind"])
        if form.kind is ImageSample:
            fields |= {"encoding": "", "payload": b""}
        yield Stored(orders[i][0], form.kind(**common, **fields))


def _arrays(batch: pa.RecordBatch, name: str, kind: Any) -> list[NDArray[Any]]:
    """The rows of a column of lists of numbers."""
    if name not in batch.schema.names:
        return [np.empty(0, kind)] * batch.num_rows
    column = batch.column(name)
    lengths = [n or 0 for n in column.value_lengths().to_pylist()]
    flat = plain(column.flatten()).astype(kind, copy=False)
    bounds = np.cumsum([0, *lengths])
    return [flat[a:b] for a, b in itertools.pairwise(bounds)]


def _split(form: Form, numbers: NDArray[np.float64], count: int) -> dict[str, Any]:
    """The numbers of a sample as its fields; -1 in a shape stands for `count`."""
    fields: dict[str, Any] = {}
    start = 0
    for name, shape in form.numbers:
        actual = tuple(count if n < 0 else n for n in shape)
        part = numbers[start : start + math.prod(actual)]
        start += math.prod(actual)
        if shape:
            fields[name] = np.ascontiguousarray(part.reshape(actual))
        else:
            fields[name] = float(part[0])
    return fields
