"""The order in which passes are flown, and each one's sense: quick ways, found greedily and then improved.

Pass k has the ends 2k (its first point) and 2k + 1; flown forth it is entered at 2k, flown back at 2k + 1.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

STARTS = 8
"""Passes from which a greedy round is begun, spread over all."""
ROUNDS = 20
"""Improving rounds at most."""


def ordered(between_s: Floats, passes_s: Floats) -> list[tuple[int, bool]]:
    """Passes in a quick order: number, and whether flown back.

    Args:
        between_s: time from end to end [2n, 2n].
        passes_s: time of each pass [n, 2], forth and back.
    """
    n = len(passes_s)
    starts = np.unique(np.linspace(0, n - 1, min(STARTS, n)).round().astype(int))
    tours = [_greedy(between_s, int(first), back) for first in starts for back in (False, True)]
    best = min(tours, key=lambda tour: _seconds(tour, between_s, passes_s))
    return _improved(best, between_s, passes_s)


def _entry(step: tuple[int, bool]) -> int:
    return 2 * step[0] + step[1]


def _exit(step: tuple[int, bool]) -> int:
    return 2 * step[0] + (not step[1])


def _greedy(between_s: Floats, first: int, back: bool) -> list[tuple[int, bool]]:
    """Always on to the pass that is entered soonest."""
    tour = [(first, back)]
    open_ends = np.ones(len(between_s), dtype=bool)
    open_ends[2 * first : 2 * first + 2] = False
    while open_ends.any():
        time = np.where(open_ends, between_s[_exit(tour[-1])], np.inf)
        end = int(np.argmin(time)) if np.isfinite(time).any() else int(np.argmax(open_ends))
        tour.append((end // 2, bool(end % 2)))
        open_ends[2 * (end // 2) : 2 * (end // 2) + 2] = False
    return tour


def _seconds(tour: list[tuple[int, bool]], between_s: Floats, passes_s: Floats) -> float:
    exits, entries = np.array([_exit(s) for s in tour]), np.array([_entry(s) for s in tour])
    flown = sum(float(passes_s[k, int(back)]) for k, back in tour)
    return float(between_s[exits[:-1], entries[1:]].sum()) + flown


def _improved(tour: list[tuple[int, bool]], between_s: Floats, passes_s: Floats) -> list[tuple[int, bool]]:
    """2-opt: turn a stretch of the tour round, each of its passes too, while that saves time."""
    best = _seconds(tour, between_s, passes_s)
    for _ in range(ROUNDS):
        before = best
        for i in range(len(tour)):
            for j in range(i, len(tour)):
                if not _promises(tour, i, j, between_s, passes_s):
                    continue
                turned = tour[:i] + [(k, not back) for k, back in reversed(tour[i : j + 1])] + tour[j + 1 :]
                if (seconds := _seconds(turned, between_s, passes_s)) < best - 1e-9:
                    tour, best = turned, seconds
        if best >= before - 1e-9:
            break
    return tour


def _promises(tour: list[tuple[int, bool]], i: int, j: int, between_s: Floats, passes_s: Floats) -> bool:
    """Whether new joints at both ends of a stretch are quicker than the old ones; wind within it is not counted."""
    old = new = 0.0
    if i > 0:
        old += between_s[_exit(tour[i - 1]), _entry(tour[i])]
        new += between_s[_exit(tour[i - 1]), _exit(tour[j])]
    if j + 1 < len(tour):
        old += between_s[_exit(tour[j]), _entry(tour[j + 1])]
        new += between_s[_entry(tour[i]), _entry(tour[j + 1])]
    return bool(new < old)


def shares(pass_s: Floats, joint_s: Floats, out_s: Floats, home_s: Floats, parts: int) -> list[range]:
    """Cut a row of passes into parts of which the longest takes as little time as it can.

    Args:
        pass_s: time of each pass [n].
        joint_s: time from each to the next [n - 1].
        out_s: time from home to each pass's begin [n].
        home_s: time from each pass's end home [n].
        parts: how many vehicles there are; no more than n get one.

    Returns:
        The passes of each part, in their order.
    """
    n = len(pass_s)
    until = np.concatenate([[0.0], np.cumsum(pass_s)]) + np.concatenate([[0.0, 0.0], np.cumsum(joint_s)])[: n + 1]
    joint = np.concatenate([joint_s, [0.0]])

    def time(first: int, stop: int) -> float:
        before = until[first] + (joint[first - 1] if first else 0.0)
        return float(out_s[first] + until[stop] - before + home_s[stop - 1])

    best = np.full((min(parts, n) + 1, n + 1), np.inf)
    cut = np.zeros(best.shape, dtype=int)
    best[0, 0] = 0.0
    for k in range(1, len(best)):
        for stop in range(k, n + 1):
            worst = [max(float(best[k - 1, first]), time(first, stop)) for first in range(k - 1, stop)]
            cut[k, stop] = k - 1 + int(np.argmin(worst))
            best[k, stop] = min(worst)
    k = int(np.argmin(best[:, n]))
    found: list[range] = []
    stop = n
    for part in range(k, 0, -1):
        found.append(range(int(cut[part, stop]), stop))
        stop = int(cut[part, stop])
    return found[::-1]
