"""Paper C's spirals: concentric circles from the outermost inwards, a swath apart; and its Table 2.

The square lies from the origin along +x and +y, the circles about its middle.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from pipelines.patrol.area import Area
from pipelines.patrol.lanes import Strip, lane_offsets, swept

Floats = NDArray[np.float64]

SIDE_M, SWATH_M, SPEED_MPS = 100.0, 15.0, 3.0
PRINTED_ROOT = 1.41
"""√2 as the paper rounds it: half the diagonal of its square is 70.5 m."""
PRINTED: Mapping[str, tuple[float, float, float]] = {
    "snake": (805.0, 10_500.0, 4.47),
    "spiral 1": (1358.0, 15_700.0, 7.54),
    "spiral 2": (756.0, 7_850.0, 4.2),
}
"""Table 2: length in m, area in m², time in minutes."""
ROUND = 256
"""Chords of a quarter circle."""
CHORD_M = 1.0
"""Circles become chords of at most that length."""


def radii(outermost_m: float, step_m: float) -> Floats:
    """Radii [n] of the circles R - k w that are left, from the outermost inwards."""
    if not (outermost_m > 0 and step_m > 0):
        raise ValueError(f"circles from {outermost_m:g} m inwards every {step_m:g} m: both must be positive")
    return np.asarray(outermost_m - step_m * np.arange(math.ceil(outermost_m / step_m - 1e-9)))


def spiral_length(outermost_m: float, step_m: float) -> float:
    """Length of the circles, of the way inwards to their centre, and of one step more to get there: 2π Σ r + R + w.

    The reading that gives paper C's Table 2 to the metre; the paper states no formula.
    """
    return float(2 * math.pi * radii(outermost_m, step_m).sum()) + outermost_m + step_m


def spiral(centre_m: tuple[float, float], outermost_m: float, step_m: float) -> Floats:
    """The way [n, 2]: in by a step to the outermost circle, round it, on inwards, round, …, to the centre."""
    found = [np.array([[outermost_m + step_m, 0.0]])]
    for radius in radii(outermost_m, step_m).tolist():
        angle = np.linspace(0, 2 * np.pi, max(16, math.ceil(2 * np.pi * radius / CHORD_M)) + 1)
        found.append(radius * np.column_stack([np.cos(angle), np.sin(angle)]))
    found.append(np.zeros((1, 2)))
    return np.asarray(np.concatenate(found) + centre_m)


def spiral_strip(centre_m: tuple[float, float], outermost_m: float, step_m: float) -> BaseGeometry:
    """What a bar of a step's width sweeps along `spiral` from its outermost circle on: rings, and the way inwards."""
    centre, half = shapely.Point(centre_m), step_m / 2
    shapes = [shapely.box(centre.x, centre.y - half, centre.x + outermost_m, centre.y + half)]
    for radius in radii(outermost_m, step_m).tolist():
        inner = centre.buffer(max(radius - half, 0.0), quad_segs=ROUND)
        shapes.append(centre.buffer(radius + half, quad_segs=ROUND).difference(inner))
    return shapely.union_all(shapes)


def paper_snake(side_m: float = SIDE_M, swath_m: float = SWATH_M) -> Floats:
    """Lanes [n, 2] of the square's side, exactly a swath apart, the outermost beginning half a swath inside."""
    count = math.ceil(side_m / swath_m)
    lows = swath_m * (np.arange(count) + 0.5)
    return np.array([(x, y) for k, y in enumerate(lows.tolist()) for x in ((0.0, side_m), (side_m, 0.0))[k % 2]])


@dataclass(frozen=True, slots=True)
class Row:
    """One method of Table 2, in the paper's reading, and what a strip along its path really sweeps.

    Attributes:
        name: snake, spiral 1 or spiral 2.
        length_m: length in the paper's reading.
        area_m2: area in the paper's reading.
        time_min: time at the paper's speed.
        swept_m2: ground that the strip sweeps.
        square_share: share of the square in it.
        useful_m2_per_m: swept ground of the square per metre of the path.
        reading: how length and area are read.
    """

    name: str
    length_m: float
    area_m2: float
    time_min: float
    swept_m2: float
    square_share: float
    useful_m2_per_m: float
    reading: str

    @property
    def printed(self) -> tuple[float, float, float]:
        """Length in m, area in m² and time in minutes as the paper prints them."""
        return PRINTED[self.name.partition(",")[0]]


def table_2() -> list[Row]:
    """Paper C's Table 2, recomputed."""
    half, outer = SIDE_M / 2, SIDE_M / 2 * PRINTED_ROOT
    lanes = math.ceil(SIDE_M / SWATH_M)
    return [
        _row(
            "snake", lanes * (SIDE_M + SWATH_M), lanes * SWATH_M * SIDE_M, swept(paper_snake(), SWATH_M),
            f"{lanes} lanes and {lanes} steps of a swath; {lanes} lanes times a swath times the side",
        ),
        _spiral_row("spiral 1", outer, math.pi * half**2 * 2, "half the diagonal with √2 = 1.41"),
        _spiral_row("spiral 2", half, math.pi * half**2, "half the side"),
    ]  # fmt: skip


def pulled_in() -> list[Row]:
    """The spirals with the outermost circle half a swath farther in, so that the strip's edge is on the circle."""
    half = SIDE_M / 2
    return [
        _spiral_row("spiral 1, pulled in", half * math.sqrt(2) - SWATH_M / 2, math.nan, "half a swath inside"),
        _spiral_row("spiral 2, pulled in", half - SWATH_M / 2, math.nan, "half a swath inside"),
    ]


def tight_snake() -> Row:
    """The snake with as many steps as are needed between its lanes, and these spread evenly over the square."""
    offsets = lane_offsets(0.0, SIDE_M, Strip(SWATH_M))
    ends = ((0.0, SIDE_M), (SIDE_M, 0.0))
    way = np.array([(x, y) for k, y in enumerate(offsets.tolist()) for x in ends[k % 2]])
    length = float(np.hypot(*np.diff(way, axis=0).T).sum())
    return _row(
        "snake, spread evenly",
        length,
        math.nan,
        swept(way, SWATH_M),
        f"{len(offsets)} lanes, {len(offsets) - 1} steps between",
    )


def _spiral_row(name: str, outermost_m: float, circle_m2: float, circle: str) -> Row:
    strip = spiral_strip((SIDE_M / 2, SIDE_M / 2), outermost_m, SWATH_M)
    text = f"circles from R = {outermost_m:g} m ({circle}), R and a swath of way in; area of the circle"
    return _row(name, spiral_length(outermost_m, SWATH_M), circle_m2, strip, text)


def _row(name: str, length_m: float, area_m2: float, strip: BaseGeometry, reading: str) -> Row:
    inside = float(strip.intersection(Area.square(SIDE_M).target).area)
    return Row(
        name=name,
        length_m=length_m,
        area_m2=area_m2,
        time_min=length_m / SPEED_MPS / 60,
        swept_m2=float(strip.area),
        square_share=inside / SIDE_M**2,
        useful_m2_per_m=inside / length_m,
        reading=reading,
    )
