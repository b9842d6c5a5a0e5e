"""A plan as a file of our own, ``plan.json``: in metres, so that it comes back as it was, with its place on Earth."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from pipelines.patrol.area import Area
from pipelines.patrol.lanes import Strip
from pipelines.patrol.place import Origin
from pipelines.patrol.plan import Flight, Leg, Plan, Task
from pipelines.patrol.vehicle import Vehicle
from readers.streams import RecordingError
from workbench.summary import without_nan

NAME = "plan.json"
VERSION = 1


@dataclass(frozen=True, slots=True)
class Saved:
    """A plan with its origin, if it has one, the height of flight and the camera's angles of view across and along."""

    plan: Plan
    origin: Origin | None
    height_m: float
    view_rad: tuple[float, float]


def to_text(saved: Saved) -> str:
    """The file's text."""
    task = saved.plan.task
    values = {
        "version": VERSION,
        "origin": None if saved.origin is None else list(saved.origin.degrees),
        "height_m": saved.height_m,
        "view_rad": list(saved.view_rad),
        "direction_rad": saved.plan.direction_rad,
        "area": {
            "polygon": shapely.geometry.mapping(task.area.polygon),
            "no_go": [shapely.geometry.mapping(zone) for zone in task.area.no_go],
            "clearance_m": task.area.clearance_m,
            "border_room_m": task.area.border_room_m,
            "zone_room_m": task.area.zone_room_m,
        },
        "strip": asdict(task.strip),
        "vehicle": asdict(task.vehicle),
        "vehicles": task.vehicles,
        "home": task.home,
        "run_out_m": task.run_out_m,
        "flights": [
            [{"sweeping": leg.sweeping, "points": leg.points.tolist()} for leg in flight.legs]
            for flight in saved.plan.flights
        ],
    }
    return json.dumps(without_nan(values), indent=1, allow_nan=False) + "\n"


def load(path: Path) -> Saved:
    """The plan of a file or of the folder that holds it.

    Raises:
        RecordingError: it cannot be read, or is no plan of ours.
    """
    file = path / NAME if path.is_dir() else path
    cure = "give plan.json, or the folder that workbench patrol plan wrote"
    try:
        return _saved(json.loads(file.read_text(encoding="utf-8")))
    except OSError as error:
        raise RecordingError(file, f"the plan cannot be read ({error.strerror or error})", cure) from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise RecordingError(file, f"is no plan of the workbench ({error})", cure) from error


def _saved(values: dict[str, Any]) -> Saved:
    if values["version"] != VERSION:
        raise ValueError(f"version {values['version']}, not {VERSION}")
    area, vehicle = values["area"], values["vehicle"]
    shape = shapely.geometry.shape
    task = Task(
        Area(**{**area, "polygon": shape(area["polygon"]), "no_go": tuple(shape(zone) for zone in area["no_go"])}),
        Strip(**values["strip"]),
        Vehicle(**{**vehicle, "wind_mps": tuple(vehicle["wind_mps"]), "power_w": _number(vehicle["power_w"])}),
        values["direction_rad"],
        values["vehicles"],
        None if values["home"] is None else tuple(values["home"]),
        values["run_out_m"],
    )
    flights = tuple(
        Flight(tuple(Leg(np.array(leg["points"], dtype=np.float64), bool(leg["sweeping"])) for leg in legs))
        for legs in values["flights"]
    )
    origin = None if values["origin"] is None else Origin.of_degrees(*values["origin"])
    across, along = (_number(angle) for angle in values["view_rad"])
    return Saved(
        Plan(task, float(values["direction_rad"]), flights), origin, float(values["height_m"]), (across, along)
    )


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)
