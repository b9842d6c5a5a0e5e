"""The shortest ways for a vehicle that cannot turn on the spot (L. E. Dubins, Am. J. Math. 79, 1957).

A pose is x, y in metres and heading in rad, counter-clockwise from +x. A way is three pieces, arcs to the left
or right of the least radius or a straight line: LSL, RSR, LSR, RSL, RLR or LRL.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

WORDS = ("LSL", "RSR", "LSR", "RSL", "RLR", "LRL")
STEP_RAD = math.radians(2.0)
"""Arcs become chords of that angle."""


def pieces(start: Floats, goal: Floats, radius_m: float) -> Floats:
    """Lengths [6, 3, ...] in radii of the pieces of each word from poses [..., 3] to others; NaN where none leads.

    In units of the radius, with d the distance and α, β the headings against the line between the poses
    (A. M. Shkel, V. Lumelsky, Robotics and Autonomous Systems 34, 2001, equations 4-11).
    """
    way = goal[..., :2] - start[..., :2]
    line = np.arctan2(way[..., 1], way[..., 0])
    d = np.hypot(way[..., 0], way[..., 1]) / radius_m
    a, b = start[..., 2] - line, goal[..., 2] - line
    sa, ca, sb, cb, cab = np.sin(a), np.cos(a), np.sin(b), np.cos(b), np.cos(a - b)
    with np.errstate(invalid="ignore"):
        lsl = np.sqrt(np.maximum(2 + d**2 - 2 * cab + 2 * d * (sa - sb), 0))
        rsr = np.sqrt(np.maximum(2 + d**2 - 2 * cab + 2 * d * (sb - sa), 0))
        lsr = np.sqrt(-2 + d**2 + 2 * cab + 2 * d * (sa + sb))
        rsl = np.sqrt(-2 + d**2 + 2 * cab - 2 * d * (sa + sb))
        rlr = 2 * np.pi - np.arccos((6 - d**2 + 2 * cab + 2 * d * (sa - sb)) / 8)
        lrl = 2 * np.pi - np.arccos((6 - d**2 + 2 * cab + 2 * d * (sb - sa)) / 8)
    to_lsl, to_rsr = np.arctan2(cb - ca, d + sa - sb), np.arctan2(ca - cb, d - sa + sb)
    to_lsr = np.arctan2(-ca - cb, d + sa + sb) - np.arctan2(-2.0, lsr)
    to_rsl = np.arctan2(ca + cb, d - sa - sb) - np.arctan2(2.0, rsl)
    first_rlr = _full(a - to_rsr + rlr / 2)
    first_lrl = _full(-a + to_lsl + lrl / 2)
    found = [
        (_full(to_lsl - a), lsl, _full(b - to_lsl)),
        (_full(a - to_rsr), rsr, _full(to_rsr - b)),
        (_full(to_lsr - a), lsr, _full(to_lsr - b)),
        (_full(a - to_rsl), rsl, _full(b - to_rsl)),
        (first_rlr, rlr, _full(a - b - first_rlr + rlr)),
        (first_lrl, lrl, _full(b - a - first_lrl + lrl)),
    ]
    return np.array(found)


def lengths(start: Floats, goal: Floats, radius_m: float) -> Floats:
    """Length in m [...] of the shortest way from poses [..., 3] to others."""
    return np.asarray(np.nanmin(pieces(start, goal, radius_m).sum(axis=1), axis=0) * radius_m)


def ways(start: Floats, goal: Floats, radius_m: float) -> Iterator[Floats]:
    """The ways from a pose [3] to another as polylines [n, 2], the shortest first."""
    found = pieces(start, goal, radius_m)
    totals = found.sum(axis=1)
    for k in np.argsort(totals).tolist():
        if np.isfinite(totals[k]):
            yield _drawn(start, WORDS[k], found[k] * radius_m, radius_m)


def _full(angle: Floats) -> Floats:
    """The same angle within [0, 2π); one that is 0 but for rounding is 0."""
    turned = angle % (2 * np.pi)
    return np.where(turned > 2 * np.pi - 1e-9, 0.0, turned)


def _drawn(start: Floats, word: str, lengths_m: Floats, radius_m: float) -> Floats:
    x, y, heading = (float(v) for v in start)
    points = [(x, y)]
    for letter, length in zip(word, lengths_m.tolist(), strict=True):
        if letter == "S":
            x, y = x + length * math.cos(heading), y + length * math.sin(heading)
            points.append((x, y))
            continue
        side = 1 if letter == "L" else -1
        centre = x - side * radius_m * math.sin(heading), y + side * radius_m * math.cos(heading)
        count = max(1, math.ceil(length / radius_m / STEP_RAD))
        for at in (heading + side * length / radius_m * np.arange(1, count + 1) / count).tolist():
            x, y = centre[0] + side * radius_m * math.sin(at), centre[1] - side * radius_m * math.cos(at)
            points.append((x, y))
        heading += side * length / radius_m
    return np.array(points)
