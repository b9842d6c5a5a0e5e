"""Numpy arrays as the columns that a recording takes.

The columns are those of Rerun's own ``rr.Points2D.columns(…)`` and its like, whose conversions of anything that can be
points take longer than everything else that is done to log a frame.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import ArrayLike, NDArray

from workbench.traces import Joined


class _Arrow:
    """An Arrow array where Rerun wants a batch."""

    def __init__(self, values: pa.Array) -> None:
        self._values = values

    def as_arrow_array(self) -> pa.Array:
        return self._values


def columns(archetype: Any, counts: ArrayLike | None = None, /, **components: Any) -> list[rr.ComponentColumn]:
    """Columns of an archetype's components.

    Args:
        archetype: one of Rerun's, such as `rr.Points2D`.
        counts: how many instances each row has [n], where the values of all rows stand one after another.
        components: values by the names of the archetype's components, one row each where there are no `counts`.
    """
    made = []
    for name, values in components.items():
        descriptor, kind = _component(archetype, name)
        made.append(_column(descriptor, _array(values, kind), counts, len(values)))
    return made


def own_columns(
    archetype: str, components: Mapping[str, Any], counts: ArrayLike | None = None
) -> list[rr.ComponentColumn]:
    """Columns of components that are not Rerun's, likewise; their type is that of their values."""
    made = []
    for name, values in components.items():
        descriptor = rr.ComponentDescriptor(name).with_builtin_archetype(archetype)
        made.append(_column(descriptor, pa.array(values), counts, len(values)))
    return made


def lists(archetype: str, components: Mapping[str, Joined]) -> list[rr.ComponentColumn]:
    """Components of our own whose rows differ in length, also where all of them are empty."""
    made: list[rr.ComponentColumn] = []
    for name, joined in components.items():
        width = math.prod(joined.values.shape[1:])
        made += own_columns(archetype, {name: np.ascontiguousarray(joined.values).ravel()}, joined.counts * width)
    return made


def repeated(archetype: Any, count: int, /, **components: Any) -> list[rr.ComponentColumn]:
    """Columns of `count` rows that are all alike, given once."""
    rows = pa.array(np.zeros(count, np.int32))
    return [
        rr.ComponentColumn(one.component_descriptor(), _Arrow(one.component_batch.as_arrow_array().take(rows)))
        for one in archetype.columns(**{name: [value] for name, value in components.items()})
    ]


def blobs(items: Sequence[Any]) -> pa.Array:
    """Buffers of bytes as one Arrow array of blobs, copied once."""
    parts = [np.frombuffer(item, np.uint8) for item in items]
    return pa.ListArray.from_arrays(
        _offsets([len(part) for part in parts]), pa.array(np.concatenate(parts)), type=_component_type("Blob")
    )


def _column(
    descriptor: rr.ComponentDescriptor, values: pa.Array, counts: ArrayLike | None, rows: int
) -> rr.ComponentColumn:
    """A column of rows of `counts` instances each, or of as many as there are to each row."""
    if counts is not None:
        offsets = _offsets(counts)
    else:
        offsets = np.arange(rows + 1, dtype=np.int32) * np.int32(len(values) // max(rows, 1))
    return rr.ComponentColumn(descriptor, _Arrow(values), offsets=offsets)


def _offsets(counts: ArrayLike) -> NDArray[np.int32]:
    lengths = np.asarray(counts)
    offsets = np.zeros(len(lengths) + 1, np.int32)
    np.cumsum(lengths, out=offsets[1:])
    return offsets


@functools.cache
def _component(archetype: Any, name: str) -> tuple[rr.ComponentDescriptor, pa.DataType]:
    """What a component of an archetype is called, and the Arrow type of its instances."""
    descriptor = getattr(archetype, f"descriptor_{name}")()
    return descriptor, _component_type(descriptor.component_type.rpartition(".")[2])


@functools.cache
def _component_type(name: str) -> pa.DataType:
    return getattr(rr.components, f"{name}Batch")(None).as_arrow_array().type


def _array(values: Any, kind: pa.DataType) -> pa.Array:
    """Values as an Arrow array of a component's type."""
    if isinstance(values, pa.Array):
        return values
    if pa.types.is_fixed_size_list(kind):
        return pa.FixedSizeListArray.from_arrays(_array(values, kind.value_type), type=kind)
    if pa.types.is_list(kind):
        strips = np.asarray(values)
        return pa.ListArray.from_arrays(
            _offsets(np.full(len(strips), strips.shape[1])), _array(strips, kind.value_type), type=kind
        )
    if pa.types.is_string(kind) or pa.types.is_boolean(kind):
        return pa.array(values, kind)
    return pa.array(np.ascontiguousarray(values, kind.to_pandas_dtype()).ravel())
