"""A cache of what opening a log costs a walk through all of it: where its blocks lie, what they hold, what is damaged.

An entry is one file in a folder of the user's, never beside the log. It holds for a log of the same path, size,
times and digests of its first and last bytes, and for the same code of the readers. What an entry says is checked
before it is believed; one that is damaged or does not fit is made anew. Losses are part of it, and blocks are compared
with their checksums when they are read, so that a log tells the same of its damage with and without the cache.
"""

from __future__ import annotations

import contextlib
import json
import os
import pkgutil
import tempfile
from dataclasses import dataclass, field
from functools import lru_cache
from hashlib import blake2b
from pathlib import Path
from typing import Any

import zstandard

State = dict[str, Any]
ENVIRONMENT = "WORKBENCH_CACHE"
OFF = ("off", "0")
MAGIC = b"EWINDEX\x01"
EDGE_BYTES = 1 << 16
DIGEST_BYTES = 32
WORTH_KEEPING_S = 0.05
"""Opening that takes less is not worth a file."""
LARGEST_PACKED_BYTES = 1 << 25
LARGEST_ENTRY_BYTES = 1 << 27
FOLDER_BYTES = 1 << 28
SUFFIX = ".index"
_CODE = (
    "index_cache.py",
    "index_states.py",
    "mcap_log.py",
    "mcap_records.py",
    "mcap_scan.py",
    "message_log.py",
    "ros1_bag.py",
    "ros2_db3.py",
    "salvage.py",
)


class StateError(ValueError):
    """An entry that cannot be used; the text is a clause that says why."""


def user_folder() -> Path | None:
    """Where entries are kept; None if the environment says that there is no cache.

    ``WORKBENCH_CACHE`` is ``off`` or a folder; without it that is ``estimator-workbench`` in ``XDG_CACHE_HOME``, or in
    ``~/.cache``.
    """
    if wish := os.environ.get(ENVIRONMENT, ""):
        return None if wish.lower() in OFF else Path(wish)
    base = os.environ.get("XDG_CACHE_HOME", "")
    try:
        return (Path(base) if os.path.isabs(base) else Path.home() / ".cache") / "estimator-workbench"  # noqa: PTH117
    except RuntimeError:  # no home
        return None


@lru_cache(maxsize=1)
def code_digest() -> str:
    """A digest of the readers' own code: other code may see other things in the same log."""
    digest = blake2b(digest_size=DIGEST_BYTES)
    for name in _CODE:
        digest.update(pkgutil.get_data("readers", name) or b"")
    return digest.hexdigest()


def key_of(path: Path) -> dict[str, str | int]:
    """What must be the same for an entry to hold."""
    stat = path.stat()
    edges = blake2b(digest_size=DIGEST_BYTES)
    with path.open("rb") as file:
        edges.update(file.read(EDGE_BYTES))
        file.seek(max(0, stat.st_size - EDGE_BYTES))
        edges.update(file.read(EDGE_BYTES))
    return {
        "path": str(path.resolve()),
        "size": stat.st_size,
        "mtime_ns": stat.st_mtime_ns,
        "ctime_ns": stat.st_ctime_ns,  # no tool sets it back
        "edges": edges.hexdigest(),
        "code": code_digest(),
    }


@dataclass(slots=True)
class Entry:
    """The place of one log in the cache.

    Attributes:
        log: the log.
        folder: where entries are kept.
        used: whether the log was opened with it.
        trouble: what is to be told about it, a sentence; "" for nothing.
    """

    log: Path
    folder: Path
    used: bool = False
    trouble: str = ""
    _key: dict[str, str | int] = field(default_factory=dict)

    @property
    def file(self) -> Path:
        """The file of the entry: one for each path, so that a log that grows does not leave old ones behind."""
        name = blake2b(os.fsencode(self.log.resolve()), digest_size=16).hexdigest()
        return self.folder / f"{name}{SUFFIX}"

    def load(self) -> State | None:
        """What was kept of the log; None if nothing was, or nothing that holds."""
        self._key = key_of(self.log)
        try:
            stored = _read(self.file)
        except FileNotFoundError:
            return None
        except (OSError, StateError) as error:
            self.reject(str(error))
            return None
        if stored.get("key") != self._key:
            return None
        self.used = True
        with contextlib.suppress(OSError):
            os.utime(self.file)
        state = stored.get("state")
        return state if isinstance(state, dict) else {}

    def reject(self, reason: str) -> None:
        """Take note that what was kept cannot be used."""
        self.used = False
        self.trouble = f"The cached index {self.file} was not used: {reason}; the file was read anew."

    def worth(self, taken_s: float) -> bool:
        """Whether what took `taken_s` seconds to find is to be kept; an entry that was damaged is always replaced."""
        return taken_s >= WORTH_KEEPING_S or bool(self.trouble)

    def save(self, state: State) -> None:
        """Keep what opening found, unless the file has changed meanwhile."""
        try:
            if key_of(self.log) != self._key:
                return
            self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            _write(self.file, {"key": self._key, "state": state})
            _shrink(self.folder)
        except OSError as error:
            why = error.strerror or error
            self.trouble = f"The index could not be kept in {self.folder}: {why} ({ENVIRONMENT}=off leaves it out)."


def _read(file: Path) -> State:
    """The content of an entry.

    Raises:
        StateError: it is none, or damaged.
    """
    with file.open("rb") as opened:
        raw = opened.read(LARGEST_PACKED_BYTES + 1)
    head = len(MAGIC) + DIGEST_BYTES
    if raw[: len(MAGIC)] != MAGIC or len(raw) > LARGEST_PACKED_BYTES:
        raise StateError("it is no entry of this version")
    if blake2b(raw[head:], digest_size=DIGEST_BYTES).digest() != raw[len(MAGIC) : head]:
        raise StateError("it does not match its digest")
    try:
        with zstandard.ZstdDecompressor().stream_reader(raw[head:]) as stream:
            text = stream.read(LARGEST_ENTRY_BYTES + 1)
        if len(text) > LARGEST_ENTRY_BYTES:
            raise StateError("it is larger than entries can be")
        stored = json.loads(text)
    except (zstandard.ZstdError, ValueError, RecursionError, MemoryError) as error:
        raise StateError(f"it cannot be parsed ({error})") from error
    if not isinstance(stored, dict):
        raise StateError("it is no entry")
    return stored


def _write(file: Path, content: State) -> None:
    """Write an entry at once or not at all; one that would be too large is not written."""
    text = json.dumps(content, separators=(",", ":")).encode()
    packed = zstandard.ZstdCompressor(level=3).compress(text)
    raw = MAGIC + blake2b(packed, digest_size=DIGEST_BYTES).digest() + packed
    if len(text) > LARGEST_ENTRY_BYTES or len(raw) > LARGEST_PACKED_BYTES:
        return
    handle, name = tempfile.mkstemp(dir=file.parent, suffix=".part")
    try:
        with os.fdopen(handle, "wb") as opened:
            opened.write(raw)
        Path(name).replace(file)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise


def _shrink(folder: Path) -> None:
    """Remove the entries that were not used for the longest time, until the folder is small enough."""
    found = [(entry.stat(), entry) for entry in folder.glob(f"*{SUFFIX}")]
    total = sum(stat.st_size for stat, _ in found)
    for stat, entry in sorted(found, key=lambda one: one[0].st_mtime_ns):
        if total <= FOLDER_BYTES:
            return
        entry.unlink(missing_ok=True)
        total -= stat.st_size
