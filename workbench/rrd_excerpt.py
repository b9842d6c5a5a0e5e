"""A part of a large ``.rrd``: the chunks of some entities that hold some frames, found by the file's own index.

Rerun 0.41 hands out whole streams only. A file that was closed ends with an index that says of every chunk where it
stands and which frames it holds; the chunks that are wanted, copied byte by byte behind the file's first message, are
a recording of their own. A file without an index is read as a whole.
"""

from __future__ import annotations

import shutil
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rerun.chunk import RrdReader

_HEAD_BYTES = 12  # of the file: its name, version, options
_MESSAGE = struct.Struct("<QQ")  # before every message: its kind, its length


class Place(NamedTuple):
    """A chunk of the index: its entity, its place in the file, the frames from `first` to `last` in it (or none)."""

    entity: str
    start: int
    size: int
    first: int | None
    last: int | None


Wanted = Callable[[Place], bool]


def excerpt(path: Path, out: Path, wanted: Wanted) -> None:
    """Write the chunks that are wanted as a recording of their own; all of it where the file has no index.

    Raises:
        OSError: a file cannot be read or written.
    """
    places = index(path)
    if places is None:
        shutil.copyfile(path, out)
        return
    with path.open("rb") as source, out.open("wb") as target:
        head = source.read(_HEAD_BYTES + _MESSAGE.size)
        _, length = _MESSAGE.unpack_from(head, _HEAD_BYTES)
        target.write(head + source.read(length))
        for place in places:
            if wanted(place):
                source.seek(place.start - _MESSAGE.size)
                target.write(source.read(_MESSAGE.size + place.size))


def index(path: Path) -> list[Place] | None:
    """The chunks of a file in their order; None where it has no index."""
    try:
        batch = RrdReader(path).store()._chunk_index().to_arrow()
    except (RuntimeError, AttributeError):
        return None

    def column(name: str) -> list[Any]:
        return batch.column(name).to_pylist() if name in batch.schema.names else [None] * batch.num_rows

    names = ("chunk_entity_path", "chunk_byte_offset", "chunk_byte_size", "frame:start", "frame:end")
    places = [Place(*values) for values in zip(*map(column, names), strict=True)]
    return sorted(places, key=lambda place: place.start)


def within(first: int, stop: int) -> Wanted:
    """Chunks that may hold frames of a half-open range."""

    def wanted(place: Place) -> bool:
        return place.first is not None and place.last is not None and place.first < stop and place.last >= first

    return wanted


def any_frame(frames: np.ndarray[Any, np.dtype[np.int64]]) -> Wanted:
    """Chunks that may hold one of some frames, given in rising order."""

    def wanted(place: Place) -> bool:
        if place.first is None or place.last is None:
            return False
        at = int(np.searchsorted(frames, place.first))
        return at < len(frames) and int(frames[at]) <= place.last

    return wanted
