"""Pieces of work, one after the other or in several processes, with progress and an orderly end on Ctrl-C."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from multiprocessing import get_context
from typing import Any, TypeVar

from workbench.session import Interrupt

T = TypeVar("T")
Tick = Callable[[], None]
Task = Callable[[Tick], T]
OnTick = Callable[[int], None]

LOOK_SECONDS = 0.1
_shared: dict[str, Any] = {}


def carried_out(tasks: Sequence[Task[T]], *, jobs: int, on_tick: OnTick) -> Iterator[T]:
    """Do the tasks and yield what they return, in the order in which they end.

    Args:
        tasks: each is called with a function that it calls for every small step of its work, often.
        jobs: number of processes; with 1 the work is done in this one, else the tasks must be picklable.
        on_tick: called with the number of steps that were made in all.

    Raises:
        KeyboardInterrupt: Ctrl-C was pressed; whatever was finished by then has been yielded.
    """
    if jobs == 1 or len(tasks) < 2:
        return _one_by_one(tasks, on_tick)
    return _side_by_side(tasks, min(jobs, len(tasks)), on_tick)


def _one_by_one(tasks: Sequence[Task[T]], on_tick: OnTick) -> Iterator[T]:
    done = 0
    with Interrupt() as interrupt:

        def tick() -> None:
            nonlocal done
            done += 1
            on_tick(done)
            if interrupt.requested:
                raise KeyboardInterrupt

        for task in tasks:
            yield task(tick)
            if interrupt.requested:
                raise KeyboardInterrupt


def _side_by_side(tasks: Sequence[Task[T]], jobs: int, on_tick: OnTick) -> Iterator[T]:
    context = get_context("spawn")
    counter, stop = context.Value("q", 0), context.Event()
    with Interrupt() as interrupt, ProcessPoolExecutor(jobs, context, _begin, (counter, stop)) as pool:
        waiting: set[Future[T]] = {pool.submit(_do, task) for task in tasks}
        try:
            while waiting:
                ended, waiting = wait(waiting, LOOK_SECONDS, FIRST_COMPLETED)
                on_tick(counter.value)
                for future in ended:
                    yield future.result()
                if interrupt.requested:
                    raise KeyboardInterrupt
        finally:
            stop.set()
            pool.shutdown(cancel_futures=True)


def _begin(counter: Any, stop: Any) -> None:
    """Prepare a process: it is told to stop by its parent, not by the terminal."""
    import cv2

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    cv2.setNumThreads(1)
    _shared["counter"], _shared["stop"] = counter, stop


def _do(task: Task[T]) -> T:
    return task(_tick)


def _tick() -> None:
    with _shared["counter"].get_lock():
        _shared["counter"].value += 1
    if _shared["stop"].is_set():
        raise KeyboardInterrupt
