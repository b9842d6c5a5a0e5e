"""Plans in the formats of others: QGroundControl's .plan, MAVLink's waypoint text, GeoJSON, KML; and as scenarios.

Heights are those over the place of take-off, which is taken to be as high as the ground.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from pipelines.patrol.flight import stretches
from pipelines.patrol.footprint import half_tangent
from pipelines.patrol.place import Origin
from pipelines.patrol.plan import Flight, Plan
from workbench.patrol.areas import NO_GO, polygons_of

Floats = NDArray[np.float64]

WAYPOINT, LAND_AT_START, TAKE_OFF, SPEED, TRIGGER = 16, 20, 22, 178, 206
"""MAV_CMD of MAVLink: NAV_WAYPOINT, NAV_RETURN_TO_LAUNCH, NAV_TAKEOFF, DO_CHANGE_SPEED, DO_SET_CAM_TRIGG_DIST."""
ABSOLUTE, OVER_HOME, NO_PLACE = 0, 3, 2
"""MAV_FRAME of MAVLink: GLOBAL, GLOBAL_RELATIVE_ALT, MISSION."""
CAMERA_PX = 512
"""Rows of a simulated camera's image, which lie across the way."""
GENERIC, MULTIROTOR, FIXED_WING = 12, 2, 1
"""QGroundControl's firmware (PX4) and vehicle types."""


@dataclass(frozen=True, slots=True)
class Sheet:
    """What an export needs beside the plan: its origin, the height of flight, metres between pictures (0: none)."""

    plan: Plan
    origin: Origin
    height_m: float
    picture_every_m: float = 0.0


@dataclass(frozen=True, slots=True)
class Item:
    """One command of a mission: its seven parameters, the last three latitude (°), longitude (°) and height (m)."""

    command: int
    frame: int
    params: tuple[float, ...]


def items(sheet: Sheet, flight: Flight) -> list[Item]:
    """Take off, fly at the speed, take pictures along the passes, return."""
    ways = [(leg.sweeping, sheet.origin.geodetic(leg.points, sheet.height_m)) for leg in flight.legs]
    latitude, longitude, _ = ways[0][1][0]
    found = [
        Item(TAKE_OFF, OVER_HOME, (0, 0, 0, math.nan, latitude, longitude, sheet.height_m)),
        Item(SPEED, NO_PLACE, (1, sheet.plan.task.vehicle.speed_mps, -1, 0, 0, 0, 0)),
    ]
    last: tuple[float, float] | None = None
    for sweeping, points in ways:
        for k, (latitude, longitude, _) in enumerate(points.tolist()):
            if (latitude, longitude) != last:
                place = (latitude, longitude, sheet.height_m)
                found.append(Item(WAYPOINT, OVER_HOME, (0, 0, 0, math.nan, *place)))
                last = (latitude, longitude)
            if k == 0 and sweeping and sheet.picture_every_m:
                found.append(Item(TRIGGER, NO_PLACE, (sheet.picture_every_m, 0, 1, 0, 0, 0, 0)))
        if sweeping and sheet.picture_every_m:
            found.append(Item(TRIGGER, NO_PLACE, (0, 0, 0, 0, 0, 0, 0)))
    return [*found, Item(LAND_AT_START, NO_PLACE, (0, 0, 0, 0, 0, 0, 0))]


def home_of(sheet: Sheet, flight: Flight) -> tuple[float, float, float]:
    """Latitude (°), longitude (°) and altitude (m) where a flight begins."""
    latitude, longitude, altitude = sheet.origin.geodetic(flight.points[:1])[0].tolist()
    return latitude, longitude, altitude


def qgroundcontrol(sheet: Sheet, flight: Flight) -> str:
    """A QGroundControl plan, version 1.

    Its fence is the area and the zones, where a clearance keeps the way off them; without one it would be on it.
    """
    vehicle = sheet.plan.task.vehicle
    simple = [
        {
            "AMSLAltAboveTerrain": None,
            "Altitude": item.params[6],
            "AltitudeMode": 1,
            "autoContinue": True,
            "command": item.command,
            "doJumpId": number,
            "frame": item.frame,
            "params": [None if math.isnan(p) else p for p in item.params],
            "type": "SimpleItem",
        }
        for number, item in enumerate(items(sheet, flight), 1)
    ]
    return _json(
        {
            "fileType": "Plan",
            "version": 1,
            "groundStation": "QGroundControl",
            "geoFence": {"version": 2, "circles": [], "polygons": _fence(sheet)},
            "mission": {
                "version": 2,
                "cruiseSpeed": vehicle.speed_mps,
                "hoverSpeed": vehicle.speed_mps,
                "firmwareType": GENERIC,
                "vehicleType": FIXED_WING if vehicle.turn_radius_m else MULTIROTOR,
                "globalPlanAltitudeMode": 1,
                "plannedHomePosition": list(home_of(sheet, flight)),
                "items": simple,
            },
            "rallyPoints": {"version": 2, "points": []},
        }
    )


def _fence(sheet: Sheet) -> list[dict[str, Any]]:
    area = sheet.plan.task.area
    if not area.clearance_m:
        return []
    leaves = sheet.plan.task.home is not None or sheet.plan.task.run_out_m > 0
    shapes = [(False, zone) for zone in area.no_go] + ([] if leaves else [(True, area.polygon)])
    return [
        {"inclusion": inside, "polygon": sheet.origin.geodetic(rings[0][:-1])[:, :2].tolist(), "version": 1}
        for inside, shape in shapes
        for rings in polygons_of(shape)
    ]


def waypoints(sheet: Sheet, flight: Flight) -> str:
    """MAVLink's plain text of a mission, ``QGC WPL 110``; its first row is home."""
    home = Item(WAYPOINT, ABSOLUTE, (0, 0, 0, 0, *home_of(sheet, flight)))
    lines = ["QGC WPL 110"]
    for number, item in enumerate([home, *items(sheet, flight)]):
        numbers = [0.0 if math.isnan(p) else p for p in item.params]
        texts = [f"{p:.9f}" for p in numbers]
        lines.append("\t".join([str(number), str(int(number == 0)), str(item.frame), str(item.command), *texts, "1"]))
    return "\n".join(lines) + "\n"


def geojson(sheet: Sheet) -> str:
    """Area, no-go zones, passes and the ways between them as features of RFC 7946; ``role`` says which is which."""
    area = sheet.plan.task.area
    features = [
        _feature({"role": role}, "Polygon", [_lon_lat(ring, sheet) for ring in rings])
        for role, shapes in (("area", [area.polygon]), (NO_GO, area.no_go))
        for shape in shapes
        for rings in polygons_of(shape)
    ]
    for number, flight in enumerate(sheet.plan.flights, 1):
        for k, leg in enumerate(flight.legs):
            role = "pass" if leg.sweeping else "way"
            values = {"role": role, "flight": number, "leg": k, "height_m": sheet.height_m}
            features.append(_feature(values, "LineString", _lon_lat(leg.points, sheet, sheet.height_m)))
    return _json({"type": "FeatureCollection", "features": features})


def _feature(properties: dict[str, Any], kind: str, coordinates: Any) -> dict[str, Any]:
    return {"type": "Feature", "properties": properties, "geometry": {"type": kind, "coordinates": coordinates}}


def _lon_lat(points: Floats, sheet: Sheet, height_m: float = 0.0) -> list[list[float]]:
    places = sheet.origin.geodetic(points, height_m)
    return [[lon, lat] for lat, lon, _ in places.tolist()]


def kml(sheet: Sheet) -> str:
    """Area, no-go zones and flights as placemarks of KML 2.2, for maps and globes."""
    root = ElementTree.Element("kml", xmlns="http://www.opengis.net/kml/2.2")
    document = ElementTree.SubElement(root, "Document")
    area = sheet.plan.task.area
    for name, shapes in (("area", [area.polygon]), (NO_GO, list(area.no_go))):
        for rings in (rings for shape in shapes for rings in polygons_of(shape)):
            polygon = ElementTree.SubElement(_placemark(document, name), "Polygon")
            for k, ring in enumerate(rings):
                border = ElementTree.SubElement(polygon, "innerBoundaryIs" if k else "outerBoundaryIs")
                _coordinates(ElementTree.SubElement(border, "LinearRing"), ring, sheet, 0.0)
    for number, flight in enumerate(sheet.plan.flights, 1):
        line = ElementTree.SubElement(_placemark(document, f"flight {number}"), "LineString")
        ElementTree.SubElement(line, "altitudeMode").text = "relativeToGround"
        _coordinates(line, flight.points, sheet, sheet.height_m)
    ElementTree.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"


def _placemark(document: ElementTree.Element, name: str) -> ElementTree.Element:
    placemark = ElementTree.SubElement(document, "Placemark")
    ElementTree.SubElement(placemark, "name").text = name
    return placemark


def _coordinates(parent: ElementTree.Element, points: Floats, sheet: Sheet, height_m: float) -> None:
    places = sheet.origin.geodetic(points, height_m)
    texts = [f"{lon:.9f},{lat:.9f},{height_m:.3f}" for lat, lon, _ in places.tolist()]
    ElementTree.SubElement(parent, "coordinates").text = " ".join(texts)


def scenario(
    plan: Plan,
    flight: Flight,
    *,
    name: str,
    height_m: float,
    view_rad: tuple[float, float],
    origin: Origin | None,
) -> dict[str, Any]:
    """A scenario of a simulated flight: the world's origin is the first way point, x east and y north.

    It stops and turns at each corner, as `pipelines.patrol.flight.motion` does. The simulated camera's columns lie
    along the way; without an angle of view along it, its image is square.
    """
    across, along = view_rad
    focal = CAMERA_PX / (2 * half_tangent(across))
    columns = CAMERA_PX if math.isnan(along) else max(round(2 * focal * half_tangent(along)), 1)
    legs: list[dict[str, float]] = []
    for turn, length in stretches(flight.points):
        legs += [{"turn_rad": turn, "turn_s": max(abs(turn), 0.1)}] if abs(turn) > 1e-9 else []
        legs.append({"drive_m": length, "acceleration_mps2": 1.0})
    speed = plan.task.vehicle.speed_mps
    values: dict[str, Any] = {
        "name": name,
        "about": f"a planned patrol of {flight.length_m:.0f} m at {speed:g} m/s",
        "trajectory": {"speed_kmh": speed * 3.6, "legs": legs},
        "camera": {
            "height_m": height_m,
            "width_px": columns,
            "height_px": CAMERA_PX,
            "focal_px": focal,
            "timing": {"rate_hz": 4.0},
        },
        "ground": {"metres_per_px": height_m / focal},
        "reference": {"timing": {"rate_hz": 20.0}},
    }
    if origin is not None:
        (latitude, longitude, altitude) = origin.geodetic(flight.points[:1])[0].tolist()
        values["gnss"] = {
            "latitude_rad": math.radians(latitude),
            "longitude_rad": math.radians(longitude),
            "altitude_m": altitude,
            "point_m": (0.0, 0.0, height_m),
        }
    return values


def _json(values: dict[str, Any]) -> str:
    return json.dumps(values, indent=1, allow_nan=False) + "\n"


def flights(plan: Plan) -> Iterator[tuple[str, Flight]]:
    """The flights of a plan with the names of their files: ``plan``, or ``plan-1``, ``plan-2`` and so on."""
    for number, flight in enumerate(plan.flights, 1):
        yield ("plan" if len(plan.flights) == 1 else f"plan-{number}"), flight
