"""Mapping in a thread beside tracking. The compiled parts run without the interpreter lock.

A frame is tracked in the map as it was `BEHIND` frames before, no older and no newer one: tracking waits for a mapping
that is slower, and no frame is left out. Which map a frame meets therefore does not depend on the threads' timing, so
that every run of a log comes out alike.

The threads share arrays that neither writes to: maps and frames are replaced, see `local_map.py`. The thread belongs
to an executor, which ends it when nobody holds the mapper any more, and lets it finish its frames before the
interpreter goes: a thread that is stopped within OpenCV's or compiled code takes the whole process down.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry import se3_product
from pipelines.semidirect.local_map import LocalMap
from pipelines.semidirect.mapping import Growth, Mapper, Posed

Floats = NDArray[np.float64]

BEHIND = 3
"""Frames before the last one that the map does not have yet when the next one is tracked."""


class Pending(NamedTuple):
    """A frame that the map does not have yet: its pose is by the map without the frames that wait ahead of it."""

    posed: Posed
    growth: Future[Growth]


class Beside:
    """A mapper in a thread of its own, which takes frames in their order.

    Args:
        mapper: what grows the map.
    """

    def __init__(self, mapper: Mapper) -> None:
        self._mapper = mapper
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="mapping")

    def posted(self, world: LocalMap, pending: tuple[Pending, ...], posed: Posed) -> tuple[Pending, ...]:
        """Give the thread a frame; `pending` are those that grow the map `world` before."""
        ahead = [one.growth for one in pending]
        return (*pending, Pending(posed, self._thread.submit(_grown, self._mapper, world, ahead, posed)))

    def begun(self, world: LocalMap, frames: Sequence[Posed]) -> tuple[Pending, ...]:
        """Give the thread frames that are to grow a map, one after the other."""
        pending: tuple[Pending, ...] = ()
        for posed in frames:
            pending = self.posted(world, pending, posed)
        return pending


def settled(pending: tuple[Pending, ...]) -> tuple[Growth, tuple[Pending, ...]]:
    """What the first frame did, waited for; and the others, whose poses follow.

    Raises:
        Exception: what the mapping raised.
    """
    done = pending[0].growth.result()
    return done, tuple(one._replace(posed=_moved(one.posed, done.shift)) for one in pending[1:])


def _grown(mapper: Mapper, world: LocalMap, ahead: Sequence[Future[Growth]], posed: Posed) -> Growth:
    """What a frame does to the map, once it has those ahead."""
    for future in ahead:
        done = future.result()
        world, posed = done.world, _moved(posed, done.shift)
    return mapper.grown(world, posed)


def _moved(posed: Posed, shift: Floats) -> Posed:
    return posed._replace(cam_t_world=se3_product(posed.cam_t_world, shift))
