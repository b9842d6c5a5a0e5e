"""Parallel lanes that sweep an area, and passes along its border for what they leave out.

A pass is a polyline [n, 2] in metres; from it the camera sweeps a strip of half a swath to both sides, which
ends square, `along_m`/2 beyond the pass. Directions are counter-clockwise from +x.

Why nothing is left out: of a place deeper than half a swath within the allowed region, the foot on the nearest
lane lies in that region, too, so that the lane passes it; every other place that can be seen lies within half
a swath of the region's border, and a pass along that border sweeps it. Border passes are flown only where the
lanes left something.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import affinity
from shapely.geometry import LineString
from shapely.geometry.base import BaseGeometry

from pipelines.patrol.area import EASE_M, Area, parts

Floats = NDArray[np.float64]

CRUMB = 1e-5
"""What is left out counts from this share of the smaller of the target and a square of a swath."""
ARC_RAD = math.radians(3.0)
"""Arcs become chords of at most that angle."""
SHORTEST = 1e-3
"""A pass is at least that share of a swath long."""


@dataclass(frozen=True, slots=True)
class Strip:
    """What the camera sweeps: `swath_m` wide, `along_m` long, neighbours overlapping by a share of the swath.

    Raises:
        ValueError: no swath, or an overlap that is no share below 1.
    """

    swath_m: float
    along_m: float = 0.0
    overlap: float = 0.0

    def __post_init__(self) -> None:
        if not 0 < self.swath_m < math.inf:
            raise ValueError(f"a swath of {self.swath_m:g} m: it must be positive")
        if not 0 <= self.along_m < math.inf:
            raise ValueError(f"a footprint {self.along_m:g} m long: it must be 0 or more")
        if not 0 <= self.overlap < 1:
            raise ValueError(f"an overlap of {self.overlap:g}: it is a share of the swath, from 0 to below 1")

    @property
    def spacing_m(self) -> float:
        """Greatest distance of neighbouring lanes."""
        return self.swath_m * (1 - self.overlap)

    def swept(self, line: Floats) -> BaseGeometry:
        """What a pass [n, 2] sweeps; in its corners the camera turns with the vehicle."""
        return swept(_lengthened(line, self.along_m / 2), self.swath_m)


def swept(line: Floats, width_m: float) -> BaseGeometry:
    """What a bar across the way sweeps along a polyline [n, 2], turning about its middle in the corners.

    Made of one rectangle a stretch and two sectors a corner: a polyline's buffer leaves holes where the line bends
    within less than half the width.
    """
    ways = np.diff(line, axis=0)
    ways = ways / np.hypot(*ways.T)[:, None]
    aside = width_m / 2 * np.column_stack([-ways[:, 1], ways[:, 0]])
    start, stop = line[:-1], line[1:]
    shapes = shapely.polygons(np.stack([start + aside, stop + aside, stop - aside, start - aside], axis=1)).tolist()
    headings = np.arctan2(ways[:, 1], ways[:, 0])
    turns = (np.diff(headings) + np.pi) % (2 * np.pi) - np.pi
    for corner, heading, turn in zip(line[1:-1], headings[:-1].tolist(), turns.tolist(), strict=True):
        if abs(turn) > 1e-9:
            angle = heading + np.pi / 2 + turn * np.linspace(0, 1, 2 + int(abs(turn) / ARC_RAD))
            fan = width_m / 2 * np.column_stack([np.cos(angle), np.sin(angle)])
            shapes += [shapely.Polygon(np.concatenate([[corner], corner + side * fan])) for side in (1, -1)]
    return shapely.union_all(shapes)


def _lengthened(line: Floats, by_m: float) -> Floats:
    """A polyline [n, 2] that goes on straight at both ends."""
    ends = np.array(line, dtype=np.float64)
    for end, before in ((0, 1), (-1, -2)):
        way = line[end] - line[before]
        ends[end] = line[end] + by_m * way / np.hypot(*way)
    return ends


def lane_offsets(low_m: float, high_m: float, strip: Strip) -> Floats:
    """Where lanes lie between two borders [n]: the outermost reach them, the others evenly between.

    n = 1 + ⌈(H - w)/spacing⌉ for a height H and a swath w, one lane in the middle where H ≤ w.
    """
    rest = high_m - low_m - strip.swath_m
    if rest <= 0:
        return np.array([(low_m + high_m) / 2])
    gaps = math.ceil(rest / strip.spacing_m - 1e-9)
    return np.linspace(low_m + strip.swath_m / 2, high_m - strip.swath_m / 2, gaps + 1)


def lanes(area: Area, strip: Strip, direction_rad: float) -> list[Floats]:
    """Straight passes [2, 2] along a direction, one neighbour after the other, all within the allowed region."""
    c, s = math.cos(direction_rad), math.sin(direction_rad)
    world_r_lane = np.array([[c, -s], [s, c]])
    turned = [c, s, -s, c, 0.0, 0.0]
    target, allowed = (affinity.affine_transform(shape, turned) for shape in (area.target, area.allowed))
    found = []
    for part in parts(allowed):
        near = target.intersection(part.buffer(strip.swath_m / 2))
        if near.is_empty:
            continue
        _, low, _, high = near.bounds
        for y in lane_offsets(low, high, strip).tolist():
            found += [line @ world_r_lane.T for line in _pieces(part, near, y, strip)]
    return found


def _pieces(allowed: BaseGeometry, target: BaseGeometry, y: float, strip: Strip) -> Iterator[Floats]:
    """The passes of one lane, along x: where the region allows it and the strip holds some of the target."""
    left, bottom, right, top = allowed.union(target).bounds
    band = target.intersection(shapely.box(left, y - strip.swath_m / 2, right, y + strip.swath_m / 2))
    y = min(max(y, allowed.bounds[1]), allowed.bounds[3])
    chord = allowed.intersection(LineString([(left - 1, y), (right + 1, y)]))
    spans = shapely.union_all([shapely.box(part.bounds[0], bottom, part.bounds[2], top) for part in parts(band)])
    wanted = shapely.line_merge(chord.intersection(spans.buffer(EASE_M)))
    for piece in getattr(wanted, "geoms", (wanted,)):
        if isinstance(piece, LineString) and piece.length > SHORTEST * strip.swath_m:
            yield np.array([[piece.bounds[0], y], [piece.bounds[2], y]])


def border_passes(area: Area, strip: Strip, lines: Sequence[Floats]) -> list[Floats]:
    """Passes along the border of the allowed region that sweep what others have left out."""
    found: list[Floats] = []
    reachable = area.reachable(strip.swath_m)
    rings = [ring for part in parts(area.allowed) for ring in (part.exterior, *part.interiors)]
    crumb = CRUMB * min(strip.swath_m**2, reachable.area)
    for reach in (0.05, 0.5):
        swept = shapely.union_all([strip.swept(line) for line in (*lines, *found)])
        left = [part for part in parts(reachable.difference(swept)) if part.area > crumb]
        beside = shapely.union_all([part.buffer(reach * strip.swath_m) for part in left])
        for ring in rings:
            found += _along(ring, beside, strip)
    return found


def _along(ring: BaseGeometry, zone: BaseGeometry, strip: Strip) -> Iterator[Floats]:
    """The stretches of a ring within a zone."""
    inside = ring.intersection(zone)
    merged = shapely.line_merge(inside) if inside.geom_type == "MultiLineString" else inside
    for piece in getattr(merged, "geoms", (merged,)):
        if isinstance(piece, LineString) and piece.length > SHORTEST * strip.swath_m:
            yield np.array(piece.coords)


def best_direction(area: Area, strip: Strip) -> float:
    """The direction with the fewest lanes, and of those the one with the shortest.

    Candidates are the directions of all sides: a convex area is narrowest across one of them.
    """
    outline = area.polygon.convex_hull
    sides = np.concatenate([_sides(part) for part in (outline, *parts(area.polygon))])
    angles = np.unique(np.round(np.arctan2(sides[:, 1], sides[:, 0]) % math.pi, 9) % round(math.pi, 9))

    def cost(angle: float) -> tuple[int, float]:
        lines = lanes(area, strip, angle)
        return len(lines), round(sum(float(np.hypot(*(line[1] - line[0]))) for line in lines), 3)

    return float(min(angles.tolist(), key=cost))


def _sides(part: BaseGeometry) -> Floats:
    """The sides [n, 2] of a polygon's rings that have a length."""
    rings = (part.exterior, *part.interiors)
    sides = np.concatenate([np.diff(np.array(ring.coords), axis=0) for ring in rings])
    return np.asarray(sides[np.hypot(*sides.T) > EASE_M])
