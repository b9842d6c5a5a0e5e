"""The area of a patrol: what is to be seen, and where the vehicle may be.

Plane coordinates in metres, x east and y north where the area has a place on Earth. Holes of the area need
not be seen but may be flown over; no-go zones are neither seen nor flown over.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import shapely
from shapely.geometry import MultiPolygon, Polygon
from shapely.geometry.base import BaseGeometry

EASE_M = 1e-6
"""By how much a point on a border may be outside it in floating point and still be on it."""

CORNER_CHORDS = 8
"""Chords of a quarter turn round a corner."""


@dataclass(frozen=True, slots=True)
class Area:
    """An area with its no-go zones.

    Attributes:
        polygon: the area, with holes.
        no_go: zones that must not be flown over.
        clearance_m: distance that is kept from the outer border and from every zone.
        border_room_m: what passes keep from the outer border beyond that, as room for turns.
        zone_room_m: what they keep from the zones beyond that.

    Raises:
        ValueError: a border that crosses itself, no area, a negative clearance, or one that leaves no room.
    """

    polygon: Polygon | MultiPolygon
    no_go: tuple[Polygon, ...] = ()
    clearance_m: float = 0.0
    border_room_m: float = 0.0
    zone_room_m: float = 0.0

    def __post_init__(self) -> None:
        for name, shape in (("the area", self.polygon), *(("a no-go zone", zone) for zone in self.no_go)):
            if not isinstance(shape, Polygon | MultiPolygon) or shape.is_empty or not shape.area > 0:
                raise ValueError(f"{name} encloses nothing: give a polygon of at least three corners")
            if not shape.is_valid:
                raise ValueError(f"{name} is no simple polygon ({shapely.is_valid_reason(shape)}): mend its corners")
        if not 0 <= self.clearance_m < math.inf:
            raise ValueError(f"a clearance of {self.clearance_m:g} m: it must be 0 or more")
        if self.allowed.is_empty:
            raise ValueError(
                "clearance, room for turns and no-go zones leave no place to fly: take less clearance, smaller turns "
                "or more run-out"
            )

    @classmethod
    def square(cls, side_m: float = 100.0) -> Area:
        """The paper's square, from the origin along +x and +y."""
        return cls(shapely.box(0.0, 0.0, side_m, side_m))

    @property
    def target(self) -> BaseGeometry:
        """What is to be seen: the area without its holes and no-go zones."""
        return self.polygon.difference(shapely.union_all(self.no_go))

    @property
    def allowed(self) -> BaseGeometry:
        """Where passes may be: within the outer border, off the no-go zones."""
        return self.room(-self.border_room_m, self.zone_room_m)

    @property
    def forbidden(self) -> BaseGeometry:
        """The no-go zones with the clearance around them."""
        return self._zones(self.clearance_m)

    def room(self, run_out_m: float, zone_room_m: float = 0.0) -> BaseGeometry:
        """The inside of the outer border, widened by `run_out_m`, without the widened zones; both with clearance.

        Borders move round corners in chords that keep at least their distance, and at most two percent more.
        """
        inside = shapely.union_all([Polygon(part.exterior) for part in parts(self.polygon)])
        wide = moved(inside, run_out_m - self.clearance_m)
        return wide.difference(self._zones(self.clearance_m + zone_room_m))

    def _zones(self, margin_m: float) -> BaseGeometry:
        return shapely.union_all([moved(zone, margin_m) for zone in self.no_go])

    def reachable(self, swath_m: float) -> BaseGeometry:
        """What of the target lies within half a swath of a place where passes may be."""
        return self.target.intersection(self.allowed.buffer(swath_m / 2, quad_segs=32))


def moved(shape: BaseGeometry, by_m: float) -> BaseGeometry:
    """A shape whose border is moved out (in, if negative) by at least a distance.

    The chords round a corner are too near by its cosine, and GEOS simplifies borders by a hundredth of the distance
    before it moves them.
    """
    if abs(by_m) < EASE_M:
        return shape
    return shape.buffer(1.01 * by_m / math.cos(math.pi / (4 * CORNER_CHORDS)), quad_segs=CORNER_CHORDS)


def parts(shape: BaseGeometry) -> Iterator[Polygon]:
    """The polygons of a shape."""
    for part in getattr(shape, "geoms", (shape,)):
        if isinstance(part, Polygon) and not part.is_empty:
            yield part


def polygon_of(corners: Sequence[Sequence[float]], holes: Sequence[Sequence[Sequence[float]]] = ()) -> Polygon:
    """A polygon of corners [n][2], with holes likewise.

    Raises:
        ValueError: fewer than three corners.
    """
    for ring in (corners, *holes):
        if len(ring) < 3:
            raise ValueError(f"a border of {len(ring)} corners: give at least three")
    return Polygon(corners, holes)
