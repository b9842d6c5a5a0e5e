"""Samples of one stream as rows of a structured numpy array, one row for each message.

Every array has the columns `t_ns`, `header_ns`, `received_ns`, `published_ns` (int64, as the fields of `Sample`; -1
where there is none) and `readable`. The others are the fields of the stream's samples, float64 in SI units and radians
by their names. A message that cannot be made a sample is a row of its own: not readable, its numbers NaN.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from readers.clock import REORDER_WINDOW_NS
from readers.streams import Problem, Sample, StreamError, StreamInfo, StreamKind

StructuredArray = NDArray[np.void]
_TIMES = ("t_ns", "header_ns", "received_ns", "published_ns")
_VEC3, _QUAT, _COV3, _COV6 = (3,), (4,), (3, 3), (6, 6)
_SHAPES: dict[StreamKind, dict[str, tuple[int, ...]]] = {
    StreamKind.IMU: {"angular_velocity_radps": _VEC3, "linear_acceleration_mps2": _VEC3, "quat_xyzw": _QUAT},
    StreamKind.ODOMETRY: {
        "linear_velocity_mps": _VEC3,
        "angular_velocity_radps": _VEC3,
        "position_m": _VEC3,
        "quat_xyzw": _QUAT,
    },
    StreamKind.POSE: {"position_m": _VEC3, "quat_xyzw": _QUAT, "covariance": _COV6},
    StreamKind.RANGE: {"range_m": (), "min_range_m": (), "max_range_m": (), "field_of_view_rad": ()},
    StreamKind.GNSS: {
        "latitude_rad": (),
        "longitude_rad": (),
        "altitude_m": (),
        "covariance_m2": _COV3,
        "status": (),
    },
    StreamKind.SCALAR: {"value": ()},
}
_NO_FIX = -1
ARRAY_ROWS = 1 << 12


def _row_type(shapes: dict[str, tuple[int, ...]]) -> np.dtype[np.void]:
    times: list[tuple[Any, ...]] = [(name, "<i8") for name in _TIMES]
    fields = [(name, "<i4" if name == "status" else "<f8", shape) for name, shape in shapes.items()]
    return np.dtype([*times, ("readable", "?"), *fields])


ROW_TYPES: dict[StreamKind, np.dtype[np.void]] = {kind: _row_type(shapes) for kind, shapes in _SHAPES.items()}
"""The columns of the arrays by kind of stream."""


def row_type(info: StreamInfo) -> np.dtype[np.void]:
    """The columns of a stream's arrays.

    Raises:
        StreamError: its samples are no rows of numbers, as images are not.
    """
    if info.kind not in ROW_TYPES:
        kinds = ", ".join(sorted(ROW_TYPES))
        raise StreamError(f"{info.name} is a stream of kind {info.kind}, which is no array; arrays are of {kinds}")
    return ROW_TYPES[info.kind]


def blank(count: int, columns: DTypeLike) -> StructuredArray:
    """Rows of messages that cannot be read: NaN, a GNSS status of no fix, -1 for times."""
    rows = np.zeros(count, columns)
    assert rows.dtype.names is not None
    for name in rows.dtype.names:
        kind = rows.dtype[name].base.kind
        rows[name] = {"f": np.nan, "i": _NO_FIX, "b": False}[kind]
    return rows


def rows_of(samples: Sequence[Sample], columns: np.dtype[np.void]) -> StructuredArray:
    """One row for each sample.

    Raises:
        StreamError: a time does not fit into 64 bits.
    """
    rows = blank(len(samples), columns)
    readable = np.array([not isinstance(sample, Problem) for sample in samples], bool)
    rows["readable"] = readable
    whole = [sample for sample in samples if not isinstance(sample, Problem)]
    for name in columns.names or ():
        if name in _TIMES:
            rows[name] = _times(samples, name)
        elif name != "readable" and whole:
            rows[name][readable] = [getattr(sample, name) for sample in whole]
    return rows


def _times(samples: Sequence[Sample], name: str) -> NDArray[np.int64]:
    values = [getattr(sample, name) for sample in samples]
    try:
        return np.array(values, np.int64)
    except OverflowError:
        where = f"{samples[0].stream}: {name} {max(values, key=abs)}"
        cure = "choose a window without it, or take the samples of `read`"
        raise StreamError(f"{where} is too large for an array; {cure}") from None


def arrays_of(samples: Iterable[Sample], columns: np.dtype[np.void], rows: int) -> Iterator[StructuredArray]:
    """Arrays of up to `rows` samples each, in their order."""
    remaining = iter(samples)
    while batch := list(itertools.islice(remaining, rows)):
        yield rows_of(batch, columns)


def gathered(pieces: Iterable[StructuredArray], rows: int) -> Iterator[StructuredArray]:
    """Small arrays put together to ones of `rows` or a little more; the last one has what is left."""
    held: list[StructuredArray] = []
    for piece in pieces:
        held.append(piece)
        if sum(map(len, held)) >= rows:
            yield np.concatenate(held)
            held = []
    if held:
        yield np.concatenate(held)


def joined(arrays: Iterable[StructuredArray], columns: np.dtype[np.void]) -> StructuredArray:
    """One array of several, read-only."""
    whole = np.concatenate([np.empty(0, columns), *arrays])
    whole.setflags(write=False)
    return whole


# ------------------------------------------------------------------------------------ order


def reordered(batches: Iterable[StructuredArray], *, lag_ns: int = 0) -> Iterator[StructuredArray]:
    """Rows in the order in which `readers.clock.reorder` gives their samples, batch by batch.

    A row goes out with the first row, itself or a later one, that was received a window later than its own stamp;
    rows that go out together are sorted by their stamps.
    """
    held: StructuredArray | None = None
    for batch in batches:
        rows = batch if held is None or not len(held) else np.concatenate([held, batch])
        leaves = _leave(rows, lag_ns + REORDER_WINDOW_NS)
        order = np.lexsort((rows["t_ns"], leaves))
        gone = int(np.count_nonzero(leaves < len(rows)))
        yield rows[order[:gone]]
        held = rows[np.sort(order[gone:])]
    if held is not None:
        yield held[np.argsort(held["t_ns"], kind="stable")]


def _leave(rows: StructuredArray, delay_ns: int) -> NDArray[np.intp]:
    """By row: the place of the row with which it goes out, the number of rows if none of them."""
    t_ns, horizon_ns = rows["t_ns"], rows["received_ns"] - delay_ns
    places = np.arange(len(rows))
    leaves = np.maximum(np.searchsorted(np.maximum.accumulate(horizon_ns), t_ns), places)
    for place in np.flatnonzero((leaves == places) & (horizon_ns < t_ns)):  # log times that go back
        late = np.flatnonzero(horizon_ns[place:] >= t_ns[place])
        leaves[place] = place + late[0] if len(late) else len(rows)
    return leaves


def within(rows: StructuredArray, start_ns: int | None, stop_ns: int | None) -> StructuredArray:
    """The rows with ``start_ns <= t_ns < stop_ns``."""
    keep = np.ones(len(rows), bool)
    if start_ns is not None:
        keep &= rows["t_ns"] >= start_ns
    if stop_ns is not None:
        keep &= rows["t_ns"] < stop_ns
    return rows if keep.all() else rows[keep]
