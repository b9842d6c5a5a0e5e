"""What a flight has really seen: how often each cell of the ground was in a picture, and how finely.

World: z up, level ground. The grid's row i and column j are the cell whose lower left corner is at
`origin` + (j, i) · `cell_m`; a cell is seen in a picture that holds its middle.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from pipelines.patrol.area import parts
from pipelines.patrol.footprint import View

Floats = NDArray[np.float64]
Counts = NDArray[np.int32]

MOST_CELLS = 4_000_000


@dataclass(frozen=True, slots=True, eq=False)
class Looks:
    """Where the camera's body was at n pictures: `t_ns` [n], `position_m` [n, 3], `world_r_body` [n, 3, 3]."""

    t_ns: NDArray[np.int64]
    position_m: Floats
    world_r_body: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Coverage:
    """What was seen.

    Attributes:
        origin_m: lower left corner of the grid (x, y).
        cell_m: side of a cell.
        count: in how many pictures each cell is [rows, columns].
        best_m: finest ground sample distance of each cell [rows, columns]; NaN where unseen or not known.
        frames: numbers [k] of the pictures that have a footprint.
        footprints: their outlines [m, 2].
        without: why the others have none, by number.
    """

    origin_m: tuple[float, float]
    cell_m: float
    count: Counts
    best_m: Floats
    frames: NDArray[np.int64]
    footprints: tuple[Floats, ...]
    without: dict[int, str]

    @property
    def seen(self) -> BaseGeometry:
        """The ground that was in any picture."""
        return shapely.union_all([shapely.make_valid(shapely.Polygon(outline)) for outline in self.footprints])

    @property
    def middles(self) -> Floats:
        """Middles of all cells [rows, columns, 2]."""
        rows, columns = self.count.shape
        x = self.origin_m[0] + self.cell_m * (np.arange(columns) + 0.5)
        y = self.origin_m[1] + self.cell_m * (np.arange(rows) + 0.5)
        return np.stack(np.meshgrid(x, y), axis=-1)

    def within(self, area: BaseGeometry) -> NDArray[np.bool_]:
        """Which cells have their middle in an area [rows, columns]."""
        middles = self.middles
        shapely.prepare(area)
        return np.asarray(shapely.contains_xy(area, middles[..., 0], middles[..., 1]))


def coverage(view: View, looks: Looks, *, cell_m: float, ground_m: float = 0.0) -> Coverage:
    """What some pictures have seen of level ground.

    Raises:
        ValueError: no picture has a footprint, or the cells are so small that there are too many.
    """
    if not 0 < cell_m < math.inf:
        raise ValueError(f"cells of {cell_m:g} m: they must be larger than 0")
    outlines: dict[int, Floats] = {}
    without: dict[int, str] = {}
    for k, (position, turn) in enumerate(zip(looks.position_m, looks.world_r_body, strict=True)):
        try:
            outlines[k] = view.footprint(position, turn, ground_m)
        except ValueError as error:
            without[k] = str(error)
    if not outlines:
        raise ValueError(f"no picture shows ground: {next(iter(without.values()), 'there are no poses')}")
    low, shape = _grid(list(outlines.values()), cell_m)
    count, best = np.zeros(shape, np.int32), np.full(shape, np.nan)
    found = Coverage(
        (float(low[0]), float(low[1])), cell_m, count, best, np.array(list(outlines)), tuple(outlines.values()), without
    )
    middles = found.middles
    for k, outline in outlines.items():
        i, j = _window(outline, low, cell_m, shape)
        points = middles[i, j].reshape(-1, 2)
        hit = shapely.contains_xy(_prepared(outline), points[:, 0], points[:, 1]).reshape(count[i, j].shape)
        finest = view.sample_distance(points, looks.position_m[k], looks.world_r_body[k], ground_m).reshape(hit.shape)
        count[i, j] += hit
        best[i, j] = np.where(hit, np.fmin(best[i, j], finest), best[i, j])
    return found


def _grid(outlines: Sequence[Floats], cell_m: float) -> tuple[Floats, tuple[int, int]]:
    """Lower left corner [2], on a multiple of the cell, and numbers of rows and columns."""
    points = np.concatenate(outlines)
    low = np.floor(points.min(axis=0) / cell_m) * cell_m
    columns, rows = np.maximum(np.ceil((points.max(axis=0) - low) / cell_m), 1).tolist()
    if rows * columns > MOST_CELLS:
        least = math.sqrt(rows * columns / MOST_CELLS) * cell_m
        raise ValueError(
            f"cells of {cell_m:g} m make {rows * columns:.0f} of them: take {least:.2g} m or more, or leave poses out "
            "that look to the horizon"
        )
    return low, (int(rows), int(columns))


def _window(outline: Floats, low: Floats, cell_m: float, shape: tuple[int, int]) -> tuple[slice, slice]:
    """Rows and columns of the cells around an outline."""
    first = np.floor((outline.min(axis=0) - low) / cell_m).astype(int)
    stop = np.ceil((outline.max(axis=0) - low) / cell_m).astype(int)
    return slice(max(first[1], 0), min(stop[1], shape[0])), slice(max(first[0], 0), min(stop[0], shape[1]))


def _prepared(outline: Floats) -> BaseGeometry:
    shape = shapely.make_valid(shapely.Polygon(outline))
    shapely.prepare(shape)
    return shape


# ---------------------------------------------------------------------------------- figures


def forward_overlaps(found: Coverage) -> Floats:
    """Share [k - 1] of each picture's footprint that the one before shows, too; NaN across pictures without one."""
    shapes = [shapely.make_valid(shapely.Polygon(outline)) for outline in found.footprints]
    shares = [
        float(after.intersection(before).area / after.area) if next_to else math.nan
        for before, after, next_to in zip(shapes[:-1], shapes[1:], np.diff(found.frames) == 1, strict=True)
    ]
    return np.array(shares)


def gaps(found: Coverage, target: BaseGeometry | None) -> list[BaseGeometry]:
    """What was not seen of a target, or the holes in what was seen if there is none; the largest first.

    Pieces smaller than a cell are left out.
    """
    seen = found.seen
    if target is None:
        target = shapely.union_all([shapely.Polygon(part.exterior) for part in parts(seen)])
    pieces = [part for part in parts(target.difference(seen)) if part.area > found.cell_m**2]
    return sorted(pieces, key=lambda part: -float(part.area))
