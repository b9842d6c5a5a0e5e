"""The ranges of a run smoothed after its end (`--smooth`): logged beside the filter's, and held against the reference.

The reference is that of the account; nothing of it enters the smoothing.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipelines.ranging.mission_smoother import Group, MissionLog, SmoothedLife, Watched, smoothed
from pipelines.ranging.range_filter import RangeFilter
from pipelines.ranging.range_settings import RangeSettings

if TYPE_CHECKING:
    from workbench.session import RunLog

Floats = NDArray[np.float64]

COVERED_SIGMAS = 2.0
_NONE: Floats = np.zeros(0)


class _StoppedError(Exception):
    """The user does not want to wait."""


class _Compared(NamedTuple):
    """Ranges that count where the reference knows them.

    Attributes:
        error: relative error of the smoothed range [n].
        squared: (ξ - 1/Z)²/P_ξξ [n].
        before: relative error of the filter's range [n], NaN where that did not count.
    """

    error: Floats
    squared: Floats
    before: Floats


class Smoothing:
    """Looks on while a run is replayed, and smooths it at its end.

    Args:
        settings: of the filter.
    """

    def __init__(self, settings: RangeSettings) -> None:
        self._settings, self._log = settings, MissionLog()
        self._depth, self._slots = array("d"), settings.max_landmarks
        self._told: dict[str, Any] | None = None

    def watching(self, estimator: RangeFilter) -> Watched:
        """The estimator, looked at."""
        return Watched(estimator, self._log)

    def take(self, depth_m: Floats) -> None:
        """Keep the reference depths of the last frame, slot by slot [N], NaN where unknown; skipped ones have none."""
        if len(self._depth) < self._slots * len(self._log.frame):
            self._depth.extend(depth_m)

    def conclude(self, run: RunLog, stopped: Callable[[], bool]) -> None:
        """Smooth and log; ends early, and tells so, once `stopped` says yes."""
        groups: list[Group] = []
        compared: list[_Compared] = []

        def on_pass() -> None:
            if stopped():
                raise _StoppedError

        try:
            for group in smoothed(self._settings, self._log, on_pass):
                self._write(run, group)
                compared += [self._compared(one) for one in group.lives]
                groups.append(group._replace(lives=[one._replace(mean=_NONE, covariance=_NONE) for one in group.lives]))
        except _StoppedError:
            self._told = {"sentence": "not smoothed to the end: the replay was stopped"}
            return
        except ValueError as error:
            self._told = {"sentence": f"not smoothed: {error}"}
            return
        self._told = self._values(groups, compared)

    def told(self) -> dict[str, Any]:
        """What the summary says of it."""
        return self._told or {"sentence": "not smoothed: the replay ended early"}

    # ---- one group

    def _write(self, run: RunLog, group: Group) -> None:
        """Log the lives, slot by slot, in the order of time."""
        frame, t_ns = np.array(self._log.frame), np.array(self._log.t_ns)
        by_slot: dict[int, list[SmoothedLife]] = {}
        for one in group.lives:
            by_slot.setdefault(one.life.slot, []).append(one)
        for slot, lives in by_slot.items():
            at = np.concatenate([np.arange(len(one.mean)) + one.life.born for one in lives])
            mean, covariance = (np.concatenate([getattr(one, k) for one in lives]) for k in ("mean", "covariance"))
            run.smoothed(slot, frame[at], t_ns[at], mean, covariance)

    def _compared(self, one: SmoothedLife) -> _Compared:
        """The ranges that count where the reference knows them; what counts is what counts in the filter."""
        life, xi, s = one.life, one.mean[:, 2], self._settings
        variance = one.covariance[:, 2, 2]
        frames = np.arange(len(xi)) + life.born
        depth = np.array(self._depth).reshape(-1, self._slots)[frames, life.slot]
        good = (np.sqrt(variance) < s.max_relative_sigma * xi) & np.isfinite(depth)
        good &= life.parallax_px >= s.min_parallax_px
        before = np.full(len(xi), np.nan)
        updated = np.array(life.at)[np.array(life.counted, dtype=bool)] - life.born
        path = np.array(life.path).reshape(-1, 3)
        before[updated] = 1 / (path[updated, 2] * depth[updated]) - 1
        squared = (xi - 1 / depth) ** 2 / variance
        return _Compared(1 / (xi[good] * depth[good]) - 1, squared[good], before[good])

    # ---- the end

    def _values(self, groups: list[Group], compared: list[_Compared]) -> dict[str, Any]:
        lives = [one.life for group in groups for one in group.lives]
        ended = all(group.converged for group in groups)
        error, squared, before = (
            np.concatenate([np.zeros(0), *column]) for column in zip(*compared, strict=True)
        ) if compared else (np.zeros(0),) * 3  # fmt: skip
        both = np.isfinite(before)
        return {
            "sentence": _sentence(len(lives), ended),
            "landmarks": len({life.number for life in lives}),
            "lives": len(lives),
            "left_out": sum(len(group.left_out) for group in groups),
            "groups": len(groups),
            "iterations": max((group.iterations for group in groups), default=0),
            "converged": ended,
            "error": error_values(error, float(squared.sum()), int((squared <= COVERED_SIGMAS**2).sum())),
            "same": None if not both.any() else {
                "count": int(both.sum()),
                "filter_median_percent": 100 * float(np.median(np.abs(before[both]))),
                "smoothed_median_percent": 100 * float(np.median(np.abs(error[both]))),
            },
        }  # fmt: skip


def _sentence(lives: int, converged: bool) -> str:
    if not lives:
        return "nothing to smooth: no landmark had an image point after its start"
    return "converged" if converged else "not converged: do not trust it"


def error_values(errors: Floats, nees: float, covered: int) -> dict[str, float] | None:
    """Relative errors of ranges [n], in percent, and their consistency; None where there is none.

    Args:
        errors: Z / reference - 1 [n].
        nees: sum of (ξ - 1/Z)²/P_ξξ over them.
        covered: how many are within 2σ.
    """
    count = len(errors)
    if not count:
        return None
    return {
        "count": count,
        "median_percent": 100 * float(np.median(np.abs(errors))),
        "rms_percent": 100 * float(math.sqrt(np.mean(errors**2))),
        "bias_percent": 100 * float(np.median(errors)),
        "nees": nees / count,
        "coverage": covered / count,
    }
