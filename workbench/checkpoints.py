"""States of an estimator on file: what a replay needs to go on from the middle of a run.

``RUN.checkpoints`` begins with a line of JSON that says whose states they are; then one record follows another, each
with its frame, its length and a check sum, so that a file torn by a crash is good up to its last whole record. A
record is a value of frozen dataclasses, named tuples, arrays, enums, containers and numbers, written without pickle:
reading it constructs nothing but classes of `pipelines` and `readers.streams`.
"""

from __future__ import annotations

import base64
import dataclasses
import enum
import importlib
import json
import struct
import zlib
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from readers.streams import RecordingError

CHECKPOINT_FRAMES = 100
"""A state is kept every so many frames: as many steps at most stand before the window of a what-if."""

FORMAT = 1
_MAGIC = b"estimator workbench checkpoints\n"
_RECORD = struct.Struct("<qII")  # frame, length of what follows, its CRC-32
_FLOAT = struct.Struct("<d")
_CURE = "replay the recording again"
_LEVEL = 1


class CheckpointError(ValueError):
    """A state that holds what a checkpoint cannot, or bytes that are no state."""


# ------------------------------------------------------------------------------------ codec


def encode(value: Any) -> bytes:
    """A state as bytes; every bit of its numbers is kept, and so is what is shared in it.

    Raises:
        CheckpointError: it holds an object of a class that checkpoints do not keep.
    """
    encoder = _Encoder()
    tree = json.dumps(encoder.tree(value), separators=(",", ":"), allow_nan=False).encode()
    return zlib.compress(struct.pack("<I", len(tree)) + tree + b"".join(encoder.arrays), _LEVEL)


def decode(data: bytes) -> Any:
    """The state that `encode` made bytes of.

    Raises:
        CheckpointError: they are no state, or one with classes that this version does not have.
    """
    try:
        whole = zlib.decompress(data)
        (length,) = struct.unpack_from("<I", whole)
        tree = json.loads(whole[4 : 4 + length])
        return _Decoder(memoryview(whole)[4 + length :]).value(tree)
    except CheckpointError:
        raise
    except (zlib.error, struct.error, ValueError, TypeError, KeyError, AttributeError, ImportError) as error:
        raise CheckpointError(f"the bytes are no state of this version ({error})") from error


class _Encoder:
    """Makes a value a tree of JSON; the arrays' bytes stand beside it."""

    def __init__(self) -> None:
        self.arrays: list[bytes] = []
        self._size = 0
        self._seen: dict[int, tuple[int, Any]] = {}  # keeps the objects alive, so that an id is of one alone

    def tree(self, value: Any) -> Any:
        if value is None or type(value) in (bool, int, str):
            return value
        if type(value) is float:
            return value if value == value and abs(value) != np.inf else ["f", _FLOAT.pack(value).hex()]
        if isinstance(value, enum.Enum):
            return ["e", _name(type(value)), self.tree(value.value)]
        if isinstance(value, np.generic):
            return ["n", value.dtype.str, base64.b64encode(value.tobytes()).decode()]
        return self._shared(value)

    def _shared(self, value: Any) -> Any:
        """An object by its number if it stood here before."""
        if id(value) in self._seen:
            return ["=", self._seen[id(value)][0]]
        tree = self._object(value)
        number = len(self._seen)
        self._seen[id(value)] = (number, value)
        return ["#", number, tree]

    def _object(self, value: Any) -> Any:
        if isinstance(value, np.ndarray):
            return self._array(value)
        if isinstance(value, tuple) and hasattr(value, "_fields"):
            return ["t", _name(type(value)), [self.tree(v) for v in value]]
        if dataclasses.is_dataclass(value) and not isinstance(value, type):
            return ["d", _name(type(value)), {f.name: self.tree(getattr(value, f.name)) for f in _fields(type(value))}]
        if type(value) in (tuple, list):
            return [type(value).__name__, [self.tree(v) for v in value]]
        if type(value) is deque:
            return ["deque", [self.tree(v) for v in value], value.maxlen]
        if type(value) in (set, frozenset):
            return [type(value).__name__, [self.tree(v) for v in sorted(value)]]
        if type(value) is dict:
            return ["dict", [[self.tree(k), self.tree(v)] for k, v in value.items()]]
        if type(value) is bytes:
            return ["bytes", base64.b64encode(value).decode()]
        raise CheckpointError(f"a checkpoint cannot hold a {_name(type(value), check=False)}")

    def _array(self, value: NDArray[Any]) -> Any:
        if value.dtype.hasobject or value.dtype.names or type(value) is not np.ndarray:
            raise CheckpointError(f"a checkpoint cannot hold an array of {value.dtype}")
        data = value.tobytes()
        start, self._size = self._size, self._size + len(data)
        self.arrays.append(data)
        return ["a", value.dtype.str, value.shape, start, _layout(value), value.flags.writeable]


def _layout(value: NDArray[Any]) -> Any:
    """How an array lies in memory, which may decide in which order a library adds up: C, F, or the strides."""
    if value.flags.c_contiguous:
        return "C"
    if value.flags.f_contiguous:
        return "F"
    plain = all(s > 0 and s % value.itemsize == 0 for s in value.strides)
    return value.strides if plain else "C"


class _Decoder:
    """Makes a tree of JSON the value again."""

    def __init__(self, arrays: memoryview) -> None:
        self._arrays = arrays
        self._seen: dict[int, Any] = {}
        self._kinds: Mapping[str, Callable[..., Any]] = {
            "f": lambda data: _FLOAT.unpack(bytes.fromhex(data))[0],
            "e": lambda name, value: _class(name, enum.Enum)(self.value(value)),
            "n": lambda dtype, data: np.frombuffer(base64.b64decode(data), dtype)[0],
            "=": lambda number: self._seen[number],
            "#": self._numbered,
            "a": self._array,
            "t": lambda name, values: _class(name, tuple)(*self._all(values)),
            "d": lambda name, values: _class(name)(**{k: self.value(v) for k, v in values.items()}),
            "tuple": lambda values: tuple(self._all(values)),
            "list": self._all,
            "deque": lambda values, most: deque(self._all(values), most),
            "set": lambda values: set(self._all(values)),
            "frozenset": lambda values: frozenset(self._all(values)),
            "dict": lambda pairs: {self.value(k): self.value(v) for k, v in pairs},
            "bytes": base64.b64decode,
        }

    def value(self, tree: Any) -> Any:
        return self._kinds[tree[0]](*tree[1:]) if isinstance(tree, list) else tree

    def _all(self, values: list[Any]) -> list[Any]:
        return [self.value(v) for v in values]

    def _numbered(self, number: int, tree: Any) -> Any:
        value = self._seen[number] = self.value(tree)
        return value

    def _array(self, dtype: str, shape: list[int], start: int, layout: Any, writeable: bool) -> NDArray[Any]:
        kind, count = np.dtype(dtype), int(np.prod(shape, dtype=np.int64))
        stored = np.frombuffer(self._arrays, kind, count, start).reshape(shape)
        if isinstance(layout, list):
            span = sum((n - 1) * step for n, step in zip(shape, layout, strict=True)) // kind.itemsize + 1
            value: NDArray[Any] = np.ndarray(shape, kind, np.empty(span, kind).data, strides=layout)
            value[...] = stored
        else:
            value = np.array(stored, order=layout)
        if not writeable:
            value.setflags(write=False)
        return value


def _fields(kind: type) -> list[Any]:
    return [f for f in dataclasses.fields(kind) if f.init]


def _name(kind: type, *, check: bool = True) -> str:
    """Module and name of a class.

    Raises:
        CheckpointError: it is not of the pipelines or the readers' samples.
    """
    if check and not _ours(kind.__module__):
        raise CheckpointError(f"a checkpoint cannot hold a {kind.__module__}.{kind.__qualname__}")
    return f"{kind.__module__}:{kind.__qualname__}"


def _ours(module: str) -> bool:
    return module.startswith("pipelines.") or module == "readers.streams"


def _class(name: str, base: type = object) -> Any:
    """The class of that name; a dataclass, or one under `base`.

    Raises:
        CheckpointError: it is no such class of the pipelines or the readers' samples.
    """
    module, _, path = name.partition(":")
    found: Any = None
    if _ours(module):
        found = importlib.import_module(module)
        for part in path.split("."):
            found = getattr(found, part)
    suits = isinstance(found, type) and found.__module__ == module
    if not suits or not (issubclass(found, base) if base is not object else dataclasses.is_dataclass(found)):
        raise CheckpointError(f"a checkpoint cannot hold a {name}")
    return found


# ------------------------------------------------------------------------------------- file


class Checkpoint(NamedTuple):
    """A packed state and the frame that it stands after, -1 before the first."""

    frame: int
    state: Any


class CheckpointWriter:
    """Writes states of one run; each record is handed to the operating system as soon as it is made.

    Args:
        path: the file to write.
        about: whose states they are (digest of the recording, run, estimator): texts that reading compares.

    Raises:
        RecordingError: the file cannot be written.
    """

    def __init__(self, path: Path, about: Mapping[str, str]) -> None:
        self._path = path
        try:
            self._file: BinaryIO = path.open("wb")
        except OSError as error:
            raise _unwritable(path, error) from error
        head = json.dumps({"format": FORMAT, **about}, separators=(",", ":"))
        self._put(_MAGIC + head.encode() + b"\n")

    def write(self, frame: int, packed: Any) -> None:
        """Keep the state after a frame.

        Raises:
            CheckpointError: the state holds what a checkpoint cannot; nothing was written.
            RecordingError: the file cannot be written.
        """
        data = encode(packed)
        self._put(_RECORD.pack(frame, len(data), zlib.crc32(data)) + data)

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _put(self, data: bytes) -> None:
        try:
            self._file.write(data)
            self._file.flush()
        except OSError as error:
            raise _unwritable(self._path, error) from error


def _unwritable(path: Path, error: OSError) -> RecordingError:
    return RecordingError(path, f"cannot be written ({error.strerror or error})", "choose another folder with -o")


def nearest(path: Path, before: int, about: Mapping[str, str]) -> Checkpoint:
    """The last state that stands after a frame below `before`; only headers and that one record are read.

    Raises:
        RecordingError: there is no such file or state, it is of another format, run or recording, or is damaged.
    """
    try:
        file = path.open("rb")
    except OSError as error:
        problem = "the run has no checkpoints" if isinstance(error, FileNotFoundError) else "cannot be read"
        raise RecordingError(path, problem, f"{_CURE}: this version keeps them beside the run") from error
    with file:
        _check_head(path, file, about)
        best: tuple[int, int, int, int] | None = None
        size = path.stat().st_size
        while len(head := file.read(_RECORD.size)) == _RECORD.size:
            frame, length, crc = _RECORD.unpack(head)
            at = file.tell()
            if at + length > size:
                break  # torn by a crash
            if frame < before and (best is None or frame >= best[0]):
                best = frame, at, length, crc
            file.seek(length, 1)
        if best is None:
            raise RecordingError(path, f"holds no state before frame {before}", _CURE)
        frame, at, length, crc = best
        file.seek(at)
        data = file.read(length)
    if zlib.crc32(data) != crc:
        raise RecordingError(path, f"the state after frame {frame} is damaged", _CURE)
    try:
        return Checkpoint(frame, decode(data))
    except CheckpointError as error:
        raise RecordingError(path, f"the state after frame {frame} cannot be used: {error}", _CURE) from error


def _check_head(path: Path, file: BinaryIO, about: Mapping[str, str]) -> None:
    if file.read(len(_MAGIC)) != _MAGIC:
        raise RecordingError(path, "is not a file of checkpoints", _CURE)
    try:
        head = json.loads(file.readline(1 << 20))
    except ValueError:
        head = {}
    if head.get("format") != FORMAT:
        raise RecordingError(path, f"is of format {head.get('format')}, this version reads {FORMAT}", _CURE)
    for key, value in about.items():
        if head.get(key) != value:
            raise RecordingError(path, f"is of another {key} than the run's files beside it", _CURE)
