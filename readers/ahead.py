"""Blocks of a log unpacked in threads, before they are asked for.

zstd, lz4, bz2 and checksums release Python's global lock, so that a few blocks ahead hide their unpacking behind the
work that is done on the messages; bz2 blocks are unpacked side by side. Where blocks are asked for one right after the
other there is no such work, and the hand-over to a thread would only cost time.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from functools import lru_cache
from typing import Any, Generic, TypeVar

Key = TypeVar("Key")
Value = TypeVar("Value")
AHEAD_BYTES = 8 << 20
AHEAD_BLOCKS = 4
WORTH_A_THREAD_S = 2e-3
"""Work on one block during which it pays to unpack the next one."""


@lru_cache(maxsize=1)
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max_workers=max(2, min(4, os.cpu_count() or 2)), thread_name_prefix="unpack")


class Ahead(Generic[Key, Value]):
    """Results of `load` for keys that will be asked for in the given order, a few of them before they are.

    Args:
        load: unpacks one block; it runs in a thread, and what it raises comes out of `take`.
        blocks: the keys, each with the bytes that its result takes.
        pause_s: how long it must take, from one block to the asking for the next one, for others to be begun.
        running: takes up what is being unpacked, so that who closes the file can wait for it (`settle`) even when this
            object was given up half way.
        after: how many keys are taken before others are begun; who looks at the first few does not read on.
    """

    def __init__(
        self,
        load: Callable[[Key], Value],
        blocks: Iterable[tuple[Key, int]],
        pause_s: float = WORTH_A_THREAD_S,
        running: set[Future[Any]] | None = None,
        after: int = 1,
    ) -> None:
        self._load = load
        self._coming = iter(blocks)
        self._next = next(self._coming, None)
        self._begun: dict[Key, tuple[Future[Value], int]] = {}
        self._pause_s = pause_s
        self._running = set[Future[Any]]() if running is None else running
        self._given_s = float("inf")
        self._after, self._taken = after, 0

    def take(self, key: Key) -> Value:
        """The result for `key`; where it pays the next ones are begun."""
        future = self._begun.pop(key, (None, 0))[0]
        if future is None:
            while (passed := self._advance()) is not None and passed[0] is not key:
                pass
        if self._taken >= self._after and time.perf_counter() - self._given_s >= self._pause_s:
            self._begin()
        self._taken += 1
        value = self._load(key) if future is None else future.result()
        self._given_s = time.perf_counter()
        return value

    def _advance(self) -> tuple[Key, int] | None:
        """Pass over the next block, None after the last."""
        passed, self._next = self._next, next(self._coming, None)
        return passed

    def _begin(self) -> None:
        while self._next is not None and len(self._begun) < AHEAD_BLOCKS:
            key, size = self._next
            if self._begun and size + sum(begun for _, begun in self._begun.values()) > AHEAD_BYTES:
                return
            self._advance()
            future = _threads().submit(self._load, key)
            self._running.add(future)
            future.add_done_callback(self._running.discard)
            self._begun[key] = future, size

    def stop(self) -> None:
        """Unpack nothing more, and wait for what is being unpacked: afterwards nobody reads the file."""
        self._coming, self._next = iter(()), None
        begun = [future for future, _ in self._begun.values()]
        self._begun.clear()
        wait([future for future in begun if not future.cancel()])


def settle(running: set[Future[Any]]) -> None:
    """Cancel what has not begun, and wait for the rest: afterwards nobody reads the file."""
    wait([future for future in list(running) if not future.cancel()])
