"""What a failure mode of the correlation odometry is: how it shows in the numbers, and what to say of it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from pipelines.verdict import Severity
from workbench.diagnosis.finding import Bools, Evidence, Floats
from workbench.diagnosis.path_signals import Signals, usual

Bounds = Mapping[str, float]
Told = tuple[str, tuple[Evidence, ...]]
"""A sentence about this run, and the numbers that show it."""


@dataclass(frozen=True)
class Shown:
    """Where a mode shows: the frames [n], the row of the worst one, and the frames that were claimed before."""

    signals: Signals
    bounds: Bounds
    shows: Bools
    worst: int
    before: Bools

    @property
    def frames(self) -> str:
        """How many frames those are, in words."""
        return frames(int(self.shows.sum()))


@dataclass(frozen=True, kw_only=True)
class Mode:
    """How one failure mode shows.

    Attributes:
        name: of the rule.
        severity: of its finding, unless the position was lost: that is an error.
        cause: what is likely behind it.
        remedy: what to try.
        thresholds: the bounds, by name.
        shows: the frames [n] at which it shows, given the signals, the bounds and the frames claimed before.
        strength: how much it shows at each frame [n], given the signals and the frames claimed before.
        tell: sentence and evidence.
        spreads: whether the unsettled frames that come after a claimed one are claimed with it.
        spoils: whether frames that were searched with the template of such a frame are claimed with it.
    """

    name: str
    severity: Severity
    cause: str
    remedy: str
    thresholds: Bounds
    shows: Callable[[Signals, Bounds, Bools], Bools]
    strength: Callable[[Signals, Bools], Floats]
    tell: Callable[[Shown], Told]
    spreads: bool = True
    spoils: bool = False


def frames(count: int) -> str:
    """A number of frames in words."""
    return "1 frame" if count == 1 else f"{count} frames"


def evidence(
    signals: Signals, name: str, values: Floats, row: int, unit: str = "1", bound: float = math.nan
) -> Evidence:
    """A signal [n] at a row, beside what is usual there."""
    return Evidence(name=name, value=float(values[row]), unit=unit, usual=float(usual(values)[row]), bound=float(bound))
