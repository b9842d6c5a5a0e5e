"""Mapping in a thread beside tracking. The compiled parts run without the interpreter lock.

The thread takes posed frames one after the other and publishes a new map after each. When it falls behind, only the
newest frames that wait are kept: a depth filter that misses a frame loses nothing but that measurement. What a frame
meets in the map depends on the thread's timing, so that a replay differs from time to time; and what the mapping did
with a frame is told with a later one.
"""

from __future__ import annotations

import threading
from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry import se3_inverse, se3_product
from pipelines.semidirect.local_map import LocalMap
from pipelines.semidirect.mapping import Growth, Mapper, Posed

Floats = NDArray[np.float64]

WAITING = 4
"""Frames that may wait for the mapping."""


class Newest(NamedTuple):
    """A map; how adjustments moved poses [4, 4] that were found in the map before, T ← T shift; what was done."""

    world: LocalMap
    shift: Floats
    growths: tuple[Growth, ...]


class Beside:
    """A mapper in a thread of its own, which ends with the program.

    Args:
        mapper: what grows the map.
    """

    def __init__(self, mapper: Mapper) -> None:
        self._mapper = mapper
        self._waiting: deque[Posed] = deque(maxlen=WAITING)
        self._change = threading.Condition()
        self._world: LocalMap | None = None
        self._epoch = 0
        self._grown: list[tuple[Posed, Growth]] = []
        self.dropped = 0
        """Frames that the mapping had no time for."""
        self._busy = False
        self._failed: Exception | None = None
        threading.Thread(target=self._work, name="mapping", daemon=True).start()

    def begin(self, world: LocalMap) -> None:
        """Go on from a map; what waits for the one before is dropped."""
        with self._change:
            self._world, self._epoch = world, self._epoch + 1
            self._waiting.clear()
            self._grown.clear()

    def post(self, posed: Posed) -> None:
        """Give a frame to the thread."""
        with self._change:
            self.dropped += len(self._waiting) == WAITING
            self._waiting.append(posed)
            self._change.notify_all()

    def newest(self) -> Newest:
        """The newest map, and what was done to it since this was asked before.

        Raises:
            Exception: what the mapping raised.
        """
        with self._change:
            if self._failed is not None:
                raise self._failed
            assert self._world is not None
            shift, growths = np.eye(4), tuple(growth for _, growth in self._grown)
            for posed, growth in self._grown:
                if growth.keyframe:
                    by = se3_product(se3_inverse(posed.cam_t_world), growth.cam_t_world)
                    shift = se3_product(shift, by)
            self._grown.clear()
            return Newest(self._world, shift, growths)

    def wait(self) -> None:
        """Wait until the frames that were given are mapped, or the mapping has failed."""
        with self._change:
            self._change.wait_for(lambda: self._failed is not None or not (self._waiting or self._busy))

    def _work(self) -> None:
        while True:
            with self._change:
                self._change.wait_for(lambda: bool(self._waiting))
                posed, world, epoch = self._waiting.popleft(), self._world, self._epoch
                self._busy = True
            assert world is not None
            try:
                growth = self._mapper.grown(world, posed)
            except Exception as error:
                with self._change:
                    self._failed = error
                    self._change.notify_all()
                return
            with self._change:
                self._busy = False
                if epoch == self._epoch:
                    self._world = growth.world
                    self._grown.append((posed, growth))
                self._change.notify_all()
