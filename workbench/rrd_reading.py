"""Reading ``.rrd`` files quickly: whole columns of numbers, single frames, images; also of files with a torn end."""

from __future__ import annotations

import bisect
import functools
import itertools
import math
import subprocess
import sys
import tempfile
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from rerun.chunk import RrdReader

from readers.streams import RecordingError
from workbench.rrd_file import numbers
from workbench.schema import Archetype, Row, Schema
from workbench.traces import objects

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]


class Series(NamedTuple):
    """Rows of one component: frames [n] (-1 where the row belongs to none), sensor times [n] in ns, values."""

    frame: Ints
    t_ns: Ints
    values: NDArray[Any]


def chunks(
    path: Path, content: str | Sequence[str], *, is_static: bool | None = False, components: Sequence[str] | None = None
) -> Iterator[Any]:
    """The chunks of some entities, also of a file without a footer or with a torn end.

    Raises:
        RecordingError: there is no such file, or nothing of it can be read.
    """
    if not path.is_file():
        raise RecordingError(path, "there is no such file", "give the path of an .rrd file")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            yield from _stream(path).filter(content=content, is_static=is_static, components=components)
        except RuntimeError:
            with tempfile.TemporaryDirectory() as folder:
                fixed = Path(folder) / "recovered.rrd"
                recover(path, fixed)
                yield from _stream(fixed).filter(content=content, is_static=is_static, components=components)


def _stream(path: Path) -> Any:
    reader = RrdReader(path)
    try:
        return reader.store().stream()
    except RuntimeError:
        return reader.stream()


def around(parts: Iterable[Any], frames: range) -> Iterator[Any]:
    """Those of some chunks, each entity's ascending by frame as a run writes them, that reach into some frames.

    Only a few are unpacked to find them.
    """
    by_entity: dict[str, list[Any]] = {}
    for chunk in parts:
        if "frame" in chunk.timeline_names:
            by_entity.setdefault(chunk.entity_path, []).append(chunk)
    for ordered in by_entity.values():
        first = max(bisect.bisect_right(ordered, frames.start, key=_first_frame) - 1, 0)
        yield from itertools.takewhile(lambda chunk: _first_frame(chunk) < frames.stop, ordered[first:])


def _first_frame(chunk: Any) -> int:
    return int(chunk.to_record_batch().column("frame")[0].as_py())


def series(path: Path, entity: str, component: str) -> Series:
    """All rows of one component of one entity, in the order of their frames, then times; n is 0 where there are none.

    Values are [n, k] where all rows hold k numbers, else an array [n] of arrays.

    Raises:
        RecordingError: the file cannot be read.
    """
    return _joined(chunks(path, entity, components=[component]), component)


def _joined(parts: Iterable[Any], component: str) -> Series:
    frames, times, values = [], [], []
    for chunk in parts:
        batch = chunk.to_record_batch()
        if component not in batch.schema.names:
            continue
        times.append(numbers(batch.column("sensor_time")))
        named = "frame" in batch.schema.names
        frames.append(numbers(batch.column("frame")) if named else np.full(len(times[-1]), -1))
        values.append(_rows(batch.column(component)))
    if not times:
        return Series(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 0)))
    found = Series(np.concatenate(frames), np.concatenate(times), _stacked(values))
    if (np.diff(found.frame) > 0).all():
        return found
    order = np.lexsort((found.t_ns, found.frame))
    return Series(found.frame[order], found.t_ns[order], found.values[order])


def _rows(column: pa.ListArray) -> NDArray[Any]:
    """The rows of an Arrow column of lists: [n, k] of numbers where all are equally long, else [n] of arrays."""
    offsets = numbers(column.offsets)
    lengths = np.diff(offsets)
    # flatten() loads Arrow's functions, which takes longer than most commands; only rows that are null need it
    flat = column.flatten() if column.null_count else column.values[int(offsets[0]) : int(offsets[-1])]
    if not (pa.types.is_integer(flat.type) or pa.types.is_floating(flat.type)):
        return objects(column.to_pylist())
    values = numbers(flat)
    if len(lengths) and (lengths == lengths[0]).all():
        return values.reshape(len(lengths), int(lengths[0]))
    return objects(np.split(values, np.cumsum(lengths)[:-1]))


def _stacked(parts: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Rows one after another; [n] of arrays where their lengths differ."""
    if all(part.ndim == 2 and part.shape[1] == parts[0].shape[1] for part in parts):
        return np.concatenate(parts)
    ragged: NDArray[Any] = np.concatenate([objects(list(part)) for part in parts])
    return ragged


def columns(
    path: Path,
    root: str,
    schema: Schema,
    fields: Iterable[str],
    choose: Callable[[Sequence[Any]], Iterable[Any]] | None = None,
) -> dict[str, NDArray[Any]]:
    """Fields of all steps of a run as arrays [n, *shape], with ``frame`` and ``t_ns`` [n]; surfaces are not for it.

    Lists are arrays [n] of arrays.

    Frames that lack one of the fields' entities are left out: they stood at the torn end of a file. Where the shape
    changes within a run, the fields of the steps with fewer numbers are filled up with NaN at the end.

    Args:
        path: the run's file.
        root: entity path of the run, ``/runs/RUN/ESTIMATOR``.
        schema: the rows of its steps.
        fields: names of fields.
        choose: which of an entity's chunks to read, in their order, such as `spread`; None for all.

    Raises:
        RecordingError: the file cannot be read, or holds no such run.
    """
    wanted = list(dict.fromkeys(fields))
    needed = schema.sharing({*wanted, "verdict"})
    components = sorted({row.component for row in needed if row.component})
    groups: dict[tuple[str, str], list[Any]] = {(row.entity, row.component): [] for row in needed if row.component}
    for chunk in chunks(path, sorted({f"{root}/{entity}" for entity, _ in groups}), components=components):
        for name in components:
            key = (chunk.entity_path.removeprefix(f"{root}/"), name)
            if key in groups:
                groups[key].append(chunk)
    chosen = groups if choose is None else {key: list(choose(parts)) for key, parts in groups.items()}
    rows = {key: _joined(parts, key[1]) for key, parts in chosen.items()}
    whole = functools.reduce(_common, (part.frame for part in rows.values()))
    if not len(whole):
        raise RecordingError(path, f"holds no steps of a run at {root}", "name a run of this file")
    rows = {key: _only(part, whole) for key, part in rows.items()}
    first = next(iter(rows.values()))
    found: dict[str, NDArray[Any]] = {"frame": first.frame, "t_ns": first.t_ns}
    for entity, group in schema.of(Archetype.SCALARS).items():
        if (entity, group[0].component) in rows:
            found |= _split(schema, group, rows[entity, group[0].component].values)
    for row in needed:
        if row.archetype is Archetype.INTEGERS:
            found[row.field] = rows[row.entity, row.component].values[:, 0]
    lists = {row.field: list(rows[row.entity, row.component].values) for row in needed if row.field in schema.lists}
    found |= {name: objects(values) for name, values in listed(schema, lists).items()}
    return {name: found[name] for name in ("frame", "t_ns", *wanted) if name in found}


def listed(schema: Schema, flat: Mapping[str, Sequence[NDArray[Any]]]) -> dict[str, list[NDArray[Any]]]:
    """Lists as they lie in a file, one row of numbers a frame, as the fields' arrays."""
    found = {}
    for field, values in flat.items():
        lead = schema.leading(field)
        lengths = map(len, flat[lead]) if lead else itertools.repeat(-1, len(values))
        found[field] = [schema.listed(field, row, rows) for row, rows in zip(values, lengths, strict=True)]
    return found


def _common(one: Ints, other: Ints) -> Ints:
    return one if np.array_equal(one, other) else np.intersect1d(one, other)


def spread(frame: int, margin: int, blocks: int) -> Callable[[Sequence[Any]], list[Any]]:
    """A choice of chunks for `columns`: those around a frame, and `blocks` spread evenly over the whole run."""

    def choose(parts: Sequence[Any]) -> list[Any]:
        near = {id(chunk) for chunk in around(parts, range(frame - margin, frame + margin + 1))}
        even = set(np.linspace(0, len(parts) - 1, blocks).astype(int).tolist()) if parts else set()
        return [chunk for place, chunk in enumerate(parts) if place in even or id(chunk) in near]

    return choose


def _only(part: Series, whole: Ints) -> Series:
    if np.array_equal(part.frame, whole):
        return part
    kept = np.isin(part.frame, whole)
    return Series(part.frame[kept], part.t_ns[kept], part.values[kept])


def _split(schema: Schema, rows: Sequence[Row], values: NDArray[Any]) -> dict[str, NDArray[Any]]:
    """The columns of a group of scalars [n, k] as those of its fields."""
    if values.dtype == object:
        values = _filled(values)
    found: dict[str, NDArray[Any]] = {}
    start = 0
    for row in rows:
        shape = schema.shape(row.field)
        fixed = [n for n in shape if isinstance(n, int)]
        width = math.prod(fixed)
        if len(fixed) < len(shape):  # it has the entity to itself
            found[row.field] = values.reshape(len(values), -1, *fixed)
        else:
            part = values[:, start : start + width]
            found[row.field] = part.reshape(len(values), *fixed) if shape else part[:, 0]
        start += width
    kinds = schema.kinds
    return {
        name: array.astype(np.int64) if kinds[name] in (int, bool) or schema.whole(name) else array
        for name, array in found.items()
    }


def _filled(values: NDArray[Any]) -> Floats:
    """Rows of different lengths as one array, NaN behind the shorter ones."""
    filled = np.full((len(values), max(map(len, values))), np.nan)
    for row, known in zip(filled, values, strict=True):
        row[: len(known)] = known
    return filled


def stored_image(path: Path, entity: str, frame: int) -> Mapping[str, Any] | None:
    """One frame's image as it was logged: the components of its row by name; None where the frame has none.

    Raises:
        RecordingError: the file cannot be read.
    """
    for chunk in around(chunks(path, entity), range(frame, frame + 1)):
        batch = chunk.to_record_batch()
        at = np.flatnonzero(numbers(batch.column("frame")) == frame)
        if len(at):
            row = batch.slice(int(at[0]), 1)
            found = {name: row.column(name)[0].as_py() for name in row.schema.names if ":" in name}
            if any(found.values()):
                return found
    return None


def stored_images(path: Path, entity: str, frames: Sequence[int]) -> Iterator[tuple[int, Mapping[str, Any]]]:
    """The images of some frames as they were logged, number and components, in one pass over the file.

    Raises:
        RecordingError: the file cannot be read.
    """
    for chunk in chunks(path, entity):
        batch = chunk.to_record_batch()
        if "frame" not in batch.schema.names:
            continue
        logged = numbers(batch.column("frame"))
        for at in np.flatnonzero(np.isin(logged, frames)).tolist():
            row = batch.slice(at, 1)
            found = {name: row.column(name)[0].as_py() for name in row.schema.names if ":" in name}
            if any(found.values()):
                yield int(logged[at]), found


def stored_rows(path: Path) -> dict[str, int]:
    """How many rows each entity holds, static ones included, counted over the data and not by the footer.

    Raises:
        RecordingError: the file cannot be read whole.
    """
    rows: Counter[str] = Counter()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            for chunk in RrdReader(path).stream():
                rows[chunk.entity_path] += chunk.num_rows
        except (RuntimeError, ValueError, OSError) as error:
            reason = (str(error).splitlines() or ["no reason given"])[0]
            raise RecordingError(path, f"cannot be read whole ({reason})", "replay the recording again") from error
    return dict(rows)


# ------------------------------------------------------------------------- whole files


CURE = "give a file that a replay wrote"


def merge(paths: Sequence[Path | str], out: Path | str) -> None:
    """Join files of one mission into one portable file.

    Raises:
        RecordingError: a file cannot be read.
    """
    _tool(Path(paths[0]), "merge", *map(str, paths), "-o", str(out))


def without_view(path: Path, out: Path, application: str, recording_id: str) -> None:
    """Copy a recording without the view that it brings along, so that another file's view holds.

    Raises:
        RecordingError: the file cannot be read.
    """
    try:
        RrdReader(path).store().write_rrd(out, application_id=application, recording_id=recording_id)
    except RuntimeError as error:
        raise RecordingError(path, f"cannot be read as a Rerun recording ({error})", CURE) from error


def recover(path: Path | str, out: Path | str) -> None:
    """Copy what is whole of an unfinished or torn file and write a footer.

    Raises:
        RecordingError: nothing can be read.
    """
    _tool(Path(path), "filter", str(path), "-o", str(out), "--continue-on-error")
    if not RrdReader(out).recordings():
        raise RecordingError(path, "is not a Rerun recording, or nothing of it is whole", CURE)


def _tool(path: Path, *arguments: str) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "rerun", "rrd", *arguments], capture_output=True, text=True, check=False
    )
    if done.returncode:
        reason = (done.stderr.strip().splitlines() or ["no reason given"])[-1]
        raise RecordingError(path, f"cannot be read as a Rerun recording ({reason})", CURE)
