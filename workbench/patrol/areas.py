"""Areas of a patrol from files: GeoJSON, KML, CSV, or the paper's square.

Borders in degrees come into the tangent plane at their first corner, or at an origin that is given.
"""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import MultiPolygon, Polygon
from shapely.geometry.base import BaseGeometry

from pipelines.patrol.area import Area, parts, polygon_of
from pipelines.patrol.place import Origin
from readers.streams import RecordingError
from workbench.settings import SettingsError

Floats = NDArray[np.float64]
Rings = list[list[tuple[float, float]]]

SQUARE = "square"
NO_GO = "no-go"
LATITUDE, LONGITUDE = (
    ("lat", "latitude", "lat_deg", "latitude_deg"),
    ("lon", "lng", "longitude", "lon_deg", "longitude_deg"),
)
X, Y = ("x", "x_m", "east", "east_m"), ("y", "y_m", "north", "north_m")
CURE = "give a GeoJSON, KML or CSV file with polygons, or square:SIDE (docs/patrol.md)"


@dataclass(frozen=True, slots=True)
class Found:
    """The shapes of a file: borders with their holes, of the area and of no-go zones; degrees (lon, lat) or metres."""

    areas: list[Rings] = field(default_factory=list)
    zones: list[Rings] = field(default_factory=list)
    in_degrees: bool = True


@dataclass(frozen=True, slots=True)
class Placed:
    """An area, and where its plane lies on Earth, if that is known."""

    area: Area
    origin: Origin | None


def load(wanted: str, *, no_go: Sequence[Path] = (), origin: Origin | None = None, clearance_m: float = 0.0) -> Placed:
    """The area of a file, or ``square`` or ``square:SIDE`` in metres, with further no-go zones from files.

    Raises:
        RecordingError: a file cannot be read or holds no polygon.
        SettingsError: the area cannot be used, or degrees and metres are mixed.
    """
    found = _square(wanted) if wanted.partition(":")[0] == SQUARE else read(Path(wanted))
    extra = [read(path) for path in no_go]
    for path, more in zip(no_go, extra, strict=True):
        if more.in_degrees != found.in_degrees:
            raise SettingsError(f"{path}: {wanted} and it are not both in degrees or both in metres; give both alike")
    if not found.areas:
        raise RecordingError(wanted, "holds no area, only no-go zones", CURE)
    if found.in_degrees:
        origin = origin or _first_corner(wanted, found.areas)
    zones = found.zones + [rings for more in extra for rings in (*more.areas, *more.zones)]
    try:
        place = origin if found.in_degrees else None
        areas = [part for rings in found.areas for part in parts(_polygon(rings, place))]
        whole = shapely.union_all(areas) if len(areas) > 1 else areas[0]
        return Placed(Area(whole, tuple(_polygon(rings, place) for rings in zones), clearance_m), origin)
    except ValueError as error:
        raise SettingsError(f"{wanted}: {error}") from error


def _square(wanted: str) -> Found:
    side = wanted.partition(":")[2] or "100"
    try:
        length = float(side)
    except ValueError:
        length = math.nan
    if not 0 < length < math.inf:
        raise SettingsError(f"{wanted}: {side!r} is no length in metres; write square:100")
    return Found(areas=[[[(0, 0), (length, 0), (length, length), (0, length)]]], in_degrees=False)


def _first_corner(wanted: str, areas: Sequence[Rings]) -> Origin:
    longitude, latitude = areas[0][0][0]
    try:
        return Origin.of_degrees(latitude, longitude)
    except ValueError as error:
        raise SettingsError(f"{wanted}: {error}") from error


def _polygon(rings: Rings, origin: Origin | None) -> Polygon:
    border, *holes = [_plane(np.array(ring, dtype=np.float64), origin) for ring in rings]
    return polygon_of(border.tolist(), [hole.tolist() for hole in holes])


def _plane(ring: Floats, origin: Origin | None) -> Floats:
    """Corners [n, 2] in metres of some in degrees (lon, lat), or as they are without an origin."""
    if origin is None:
        return ring
    if (np.abs(ring[:, 1]) > 90).any():
        raise ValueError("a latitude beyond 90°: longitude comes before latitude in GeoJSON and KML; swap them")
    return origin.enu(np.radians(ring[:, 1]), np.radians(ring[:, 0]))[:, :2]


# ------------------------------------------------------------------------------------ files


def read(path: Path) -> Found:
    """The shapes of a file; what it is told by its content.

    Raises:
        RecordingError: it cannot be read, or holds no polygon.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise RecordingError(path, f"the area cannot be read ({error.strerror or error})", CURE) from error
    except UnicodeDecodeError as error:
        raise RecordingError(path, "is no text in UTF-8", CURE) from error
    start = text.lstrip()[:1]
    try:
        found = _geojson(text) if start == "{" else _kml(text) if start == "<" else _csv(text)
    except (ValueError, KeyError, TypeError, IndexError, AttributeError, ElementTree.ParseError) as error:
        kind = {"{": "GeoJSON", "<": "KML"}.get(start, "CSV")
        raise RecordingError(path, f"cannot be read as {kind} with polygons ({error})", CURE) from error
    if not (found.areas or found.zones):
        raise RecordingError(path, "holds no polygon", CURE)
    return found


def _geojson(text: str) -> Found:
    """Polygons of RFC 7946; a feature whose property ``role`` is ``no-go`` is a zone, other roles of plans are none."""
    found = Found()
    for properties, geometry in _features(json.loads(text)):
        role = str(properties.get("role", "area"))
        coordinates: list[Any] = geometry.get("coordinates", [])
        by_kind = {"Polygon": [coordinates], "MultiPolygon": coordinates}
        for rings in by_kind.get(geometry["type"], []):
            shape = [[(float(c[0]), float(c[1])) for c in ring] for ring in rings]
            if role in ("area", NO_GO):
                (found.zones if role == NO_GO else found.areas).append(shape)
    return found


def _features(value: Mapping[str, Any]) -> Iterator[tuple[Mapping[str, Any], Mapping[str, Any]]]:
    """All geometries with the properties of their features."""
    if value["type"] == "FeatureCollection":
        for feature in value["features"]:
            yield from _features(feature)
    elif value["type"] == "Feature":
        if value["geometry"] is not None:
            yield value.get("properties") or {}, value["geometry"]
    else:
        yield {}, value


def _kml(text: str) -> Found:
    """Polygons of placemarks; one whose name begins with ``no-go`` is a zone."""
    found = Found()
    for placemark in (e for e in ElementTree.fromstring(text).iter() if _tag(e) == "Placemark"):
        name = next((e.text or "" for e in placemark if _tag(e) == "name"), "")
        for polygon in (e for e in placemark.iter() if _tag(e) == "Polygon"):
            borders = [e for side in ("outerBoundaryIs", "innerBoundaryIs") for e in polygon if _tag(e) == side]
            rings = [_kml_ring(border) for border in borders]
            (found.zones if name.strip().lower().startswith(NO_GO) else found.areas).append(rings)
    return found


def _kml_ring(border: ElementTree.Element) -> list[tuple[float, float]]:
    text = next(e.text or "" for e in border.iter() if _tag(e) == "coordinates")
    corners = [[float(number) for number in corner.split(",")] for corner in text.split()]
    return [(corner[0], corner[1]) for corner in corners]


def _tag(element: ElementTree.Element) -> str:
    return element.tag.rpartition("}")[2]


def _csv(text: str) -> Found:
    """One corner a row: lat and lon in degrees or x and y in metres; a column ``ring`` tells several borders apart.

    A ring whose name begins with ``no-go`` is a zone, one that begins with ``hole`` a hole of the area before it.
    """
    rows = list(csv.DictReader(text.splitlines(), skipinitialspace=True))
    heads = {str(head).strip().lower(): head for head in (rows[0] if rows else {})}
    pairs = [(_one(heads, LONGITUDE), _one(heads, LATITUDE)), (_one(heads, X), _one(heads, Y))]
    in_degrees = None not in pairs[0]
    first, second = pairs[0] if in_degrees else pairs[1]
    if first is None or second is None:
        raise ValueError("its first line names no columns lat and lon, or x and y")
    rings: dict[str, list[tuple[float, float]]] = {}
    for row in rows:
        name = str(row.get(heads.get("ring", ""), "") or "area").strip().lower()
        rings.setdefault(name, []).append((float(row[first]), float(row[second])))
    found = Found(in_degrees=in_degrees)
    for name, corners in rings.items():
        if name.startswith("hole"):
            found.areas[-1].append(corners)
        else:
            (found.zones if name.startswith(NO_GO) else found.areas).append([corners])
    return found


def _one(heads: Mapping[str, str], names: Sequence[str]) -> Any:
    return next((heads[name] for name in names if name in heads), None)


def polygons_of(shape: Polygon | MultiPolygon) -> Iterator[list[Floats]]:
    """The borders [n, 2] of each polygon, the outer one first, closed."""
    for part in parts(shape):
        yield [np.array(ring.coords) for ring in (part.exterior, *part.interiors)]


def rings_of(shape: BaseGeometry) -> list[Floats]:
    """The outlines [m, 2] of a shape, holes included."""
    return [ring for rings in polygons_of(shape) for ring in rings]
