"""Parts of a large ``.rrd``: the chunks of some entities that hold some frames, found by the file's own index.

Rerun 0.41 hands out whole streams only. A file that was closed ends with an index that says of every chunk where it
stands and which frames it holds; the chunks that are wanted, copied byte by byte behind the file's first message, are
a recording of their own. A file without an index gets one in a copy first.
"""

from __future__ import annotations

import functools
import struct
import tempfile
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple, Self

import pyarrow as pa
from rerun.chunk import RrdReader

from readers.streams import RecordingError

_HEAD_BYTES = 12  # of the file: its name, version, options
_MESSAGE = struct.Struct("<QQ")  # before every message: its kind, its length


class Place(NamedTuple):
    """A chunk of the index: its entity, its place in the file, its frames (None: it is on no timeline of frames)."""

    entity: str
    start: int
    size: int
    first: int | None
    last: int | None

    def overlaps(self, first: int, stop: int) -> bool:
        """Whether it may hold frames of a half-open range."""
        return self.first is not None and self.last is not None and self.first < stop and self.last >= first


class RrdParts:
    """A recording whose parts can be taken out one by one.

    Raises:
        RecordingError: the file cannot be read as a recording.
    """

    def __init__(self, path: Path) -> None:
        self._folder = tempfile.TemporaryDirectory()
        self._path = path
        try:
            self.places = self._indexed()
        except BaseException:
            self.close()
            raise
        with self._path.open("rb") as file:
            head = file.read(_HEAD_BYTES + _MESSAGE.size)
            _, length = _MESSAGE.unpack_from(head, _HEAD_BYTES)
            self._head = head + file.read(length)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Remove what was made beside the file."""
        self._folder.cleanup()

    def of(self, entities: Iterable[str]) -> list[Place]:
        """The chunks of some entities."""
        wanted = set(entities)
        return [place for place in self.places if place.entity in wanted]

    def excerpt(self, wanted: Iterable[Place]) -> Path:
        """Some chunks as a recording of their own, which the next call replaces."""
        out = Path(self._folder.name) / "excerpt.rrd"
        with self._path.open("rb") as source, out.open("wb") as target:
            target.write(self._head)
            for place in wanted:
                source.seek(place.start - _MESSAGE.size)
                target.write(source.read(_MESSAGE.size + place.size))
        return out

    def batches(self, wanted: Iterable[Place]) -> list[tuple[str, pa.RecordBatch]]:
        """The entity and the columns of some chunks; both timelines and all components are columns."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # an excerpt has no index
            chunks = RrdReader(self.excerpt(wanted)).stream().filter(is_static=False).to_chunks()
        return [(chunk.entity_path, chunk.to_record_batch()) for chunk in chunks]

    def _indexed(self) -> list[Place]:
        if not self._path.is_file():
            raise RecordingError(self._path, "there is no such file", "replay the recording again")
        try:
            return _places(self._path)
        except RuntimeError:
            from workbench.rrd import recover

            fixed = Path(self._folder.name) / "recovered.rrd"
            recover(self._path, fixed)
            self._path = fixed
            return _places(fixed)


def _places(path: Path) -> list[Place]:
    about = path.stat()
    return _places_of(path, about.st_size, about.st_mtime_ns)


@functools.lru_cache(maxsize=4)  # one command asks for several parts of the same two files
def _places_of(path: Path, size: int, time_ns: int) -> list[Place]:
    """The index of a file as it is at that size and time."""
    batch = RrdReader(path).store()._chunk_index().to_arrow()

    def column(name: str) -> list[Any]:
        return list(batch.column(name).to_pylist()) if name in batch.schema.names else [None] * batch.num_rows

    names = ("chunk_entity_path", "chunk_byte_offset", "chunk_byte_size", "frame:start", "frame:end")
    places = [Place(*values) for values in zip(*map(column, names), strict=True)]
    return sorted(places, key=lambda place: place.start)
