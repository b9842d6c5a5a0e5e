"""The scale of a map from speeds or positions: both are gathered until the camera has gone far enough to tell it.

A known height needs no way and is used at the start of the map, see `starting.first_map`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipelines.semidirect.scale import Scale, from_reference, from_speed

Floats = NDArray[np.float64]

MAP_SIGMA = 0.002
"""Standard deviation of a camera's place in the map, in units of the first map's depth."""


class ScaleWatch(NamedTuple):
    """What was gathered since the map was begun.

    Times (ns) with places [3] of the `camera` in units of the map, with its `speed` (m/s), and with metric
    `positions` [3]; the camera's `way` in the map.
    """

    camera: tuple[tuple[int, Floats], ...] = ()
    speed: tuple[tuple[int, float], ...] = ()
    positions: tuple[tuple[int, Floats], ...] = ()
    way: float = 0.0

    def went(self, t_ns: int, centre: Floats) -> ScaleWatch:
        """The watch after a frame whose camera stood at a place [3] of the map."""
        step = float(np.linalg.norm(centre - self.camera[-1][1])) if self.camera else 0.0
        return self._replace(camera=(*self.camera, (t_ns, centre)), way=self.way + step)

    def measured(self, t_ns: int, speed_mps: float) -> ScaleWatch:
        """The watch after a speed."""
        return self._replace(speed=(*self.speed, (t_ns, speed_mps)))

    def placed(self, t_ns: int, position_m: Floats) -> ScaleWatch:
        """The watch after a metric position [3]."""
        return self._replace(positions=(*self.positions, (t_ns, position_m)))

    def scale(self, *, way: float, speed_sigma_mps: float, position_sigma_m: float) -> Scale | None:
        """Metres per unit of the map once the camera has gone so far in it; None while it is not to be told."""
        if self.way < way or len(self.camera) < 2:
            return None
        times = np.array([t for t, _ in self.camera], np.int64)
        places = np.array([p for _, p in self.camera])
        try:
            if self.speed:
                return _by_speed(times, places, self.speed, speed_sigma_mps)
            return _by_positions(times, places, self.positions, position_sigma_m)
        except ValueError:  # too few of them by now, or none that moves
            return None


def _by_speed(times: NDArray[np.int64], places: Floats, speeds: tuple[tuple[int, float], ...], sigma: float) -> Scale:
    """From the ways between one speed and the next, with the mean of both."""
    at = np.array([t for t, _ in speeds], np.int64)
    value = np.array([abs(v) for _, v in speeds])
    inside = (at >= times[0]) & (at <= times[-1])
    at, value = at[inside], value[inside]
    moved = np.diff(_at(times, places, at), axis=0)
    dt_s = np.diff(at) / 1e9
    mean = (value[1:] + value[:-1]) / 2
    n = len(dt_s)
    return from_speed(mean, np.full(n, sigma), dt_s, moved, np.full(n, MAP_SIGMA * np.sqrt(2)))


def _by_positions(
    times: NDArray[np.int64], places: Floats, positions: tuple[tuple[int, Floats], ...], sigma: float
) -> Scale:
    at = np.array([t for t, _ in positions], np.int64)
    inside = (at >= times[0]) & (at <= times[-1])
    metric = np.array([p for _, p in positions]).reshape(-1, 3)[inside]
    return from_reference(metric, sigma, _at(times, places, at[inside]), MAP_SIGMA)


def _at(times: NDArray[np.int64], places: Floats, at: NDArray[np.int64]) -> Floats:
    """Places [n, 3] at other times, straight between the known ones."""
    t0 = times[0]
    return np.column_stack([np.interp(at - t0, times - t0, places[:, k]) for k in range(3)])
