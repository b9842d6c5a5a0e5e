"""From what a command was told to a plan and its files."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from pipelines.patrol.area import EASE_M
from pipelines.patrol.flight import picture_spacing
from pipelines.patrol.footprint import height_for_range, height_for_sample_distance, height_for_swath, swath
from pipelines.patrol.lanes import Strip
from pipelines.patrol.plan import Account, Task, account, snake
from pipelines.patrol.vehicle import Vehicle
from readers.streams import RecordingError
from workbench.patrol import areas, exports, saved
from workbench.patrol.saved import Saved
from workbench.scenarios import to_text
from workbench.settings import Layer, SettingsError, validated


@dataclass(frozen=True, slots=True, kw_only=True)
class Optics:
    """The camera, and one wish of four for the height; None is not given, NaN not known."""

    across_rad: float
    along_rad: float = math.nan
    across_px: int | None = None
    height_m: float | None = None
    swath_m: float | None = None
    sample_distance_m: float | None = None
    range_m: float | None = None

    def height(self) -> float:
        """The height that is wished for.

        Raises:
            SettingsError: none or several wishes, or a sample distance without pixels.
        """
        wishes = {
            "--height": self.height_m,
            "--swath": self.swath_m,
            "--gsd": self.sample_distance_m,
            "--range": self.range_m,
        }
        given = [(name, value) for name, value in wishes.items() if value is not None]
        if len(given) != 1:
            told = " and ".join(name for name, _ in given) or "none"
            raise SettingsError(f"{told} given: one of {', '.join(wishes)} tells the height")
        ((name, value),) = given
        if not 0 < value < math.inf:
            raise SettingsError(f"{name} {value:g}: must be positive")
        if name == "--gsd" and not self.across_px:
            raise SettingsError("--gsd: needs --pixels, the image's pixels across the way of flight")
        try:
            if name == "--swath":
                return height_for_swath(value, self.across_rad)
            if name == "--gsd":
                return height_for_sample_distance(value, self.across_rad, self.across_px or 0)
            if name == "--range":
                return height_for_range(value, self.across_rad, 0 if math.isnan(self.along_rad) else self.along_rad)
        except ValueError as error:
            raise SettingsError(f"--fov: {error}") from error
        return value

    def strip(self, overlap: float) -> Strip:
        """What the camera sweeps from that height.

        Raises:
            SettingsError: an angle or overlap that cannot be.
        """
        height = self.height()
        try:
            along = 0.0 if math.isnan(self.along_rad) else swath(height, self.along_rad)
            return Strip(swath(height, self.across_rad), along, overlap)
        except ValueError as error:
            raise SettingsError(str(error)) from error


@dataclass(frozen=True, slots=True)
class Planned:
    """A plan, what it costs, and the files that were written."""

    saved: Saved
    account: Account
    sample_distance_m: float
    files: tuple[Path, ...]


def plan(
    placed: areas.Placed,
    optics: Optics,
    *,
    overlap: float = 0.0,
    vehicle: Vehicle,
    direction_rad: float | None = None,
    vehicles: int = 1,
    home: tuple[float, float] | None = None,
    run_out_m: float = 0.0,
    pictures_overlap: float | None = None,
    out: Path,
) -> Planned:
    """Plan a patrol and write its files into a folder.

    Raises:
        SettingsError: it cannot be planned so.
        RecordingError: a file cannot be written.
    """
    strip, height = optics.strip(overlap), optics.height()
    try:
        task = Task(placed.area, strip, vehicle, direction_rad, vehicles, home, run_out_m)
        made = snake(task)
        every = 0.0 if pictures_overlap is None else picture_spacing(strip.along_m, pictures_overlap)
    except ValueError as error:
        raise SettingsError(str(error)) from error
    found = Saved(made, placed.origin, height, (optics.across_rad, optics.along_rad))
    costs = account(made)
    distance = strip.swath_m / optics.across_px if optics.across_px else math.nan
    files = _write(found, every, out)
    files.append(_map(found, costs, distance, out))
    return Planned(found, costs, distance, tuple(files))


def _write(found: Saved, every_m: float, out: Path) -> list[Path]:
    texts = {saved.NAME: saved.to_text(found)}
    for name, flight in exports.flights(found.plan):
        values = exports.scenario(
            found.plan, flight, name=name, height_m=found.height_m, view_rad=found.view_rad, origin=found.origin
        )
        texts[f"{name}.toml"] = _scenario_text(values, name)
    if found.origin is not None:
        sheet = exports.Sheet(found.plan, found.origin, found.height_m, every_m)
        texts |= {"plan.geojson": exports.geojson(sheet), "plan.kml": exports.kml(sheet)}
        for name, flight in exports.flights(found.plan):
            texts |= {
                f"{name}.plan": exports.qgroundcontrol(sheet, flight),
                f"{name}.waypoints": exports.waypoints(sheet, flight),
            }
    written = []
    try:
        out.mkdir(parents=True, exist_ok=True)
        for name, text in texts.items():
            (out / name).write_text(text, encoding="utf-8")
            written.append(out / name)
    except OSError as error:
        problem = f"the plan cannot be written there ({error.strerror or error})"
        raise RecordingError(out, problem, "choose another folder with -o") from error
    return written


def _scenario_text(values: dict[str, Any], name: str) -> str:
    from pipelines.simulation.scenario import Scenario

    scenario = validated(Scenario(name=name), [Layer("the plan", values)]).settings
    assert isinstance(scenario, Scenario)
    return to_text(scenario)


def _map(found: Saved, costs: Account, distance_m: float, out: Path) -> Path:
    from workbench.patrol import rrd_patrol

    lines = ["# Plan", "", *(f"- {line}" for line in sentences(found, costs, distance_m))]
    return rrd_patrol.write_plan(out / "plan.rrd", found.plan, "\n".join(lines))


def sentences(found: Saved, costs: Account, distance_m: float) -> list[str]:
    """A plan in words."""
    task = found.plan.task
    strip, several = task.strip, costs.flights > 1
    finest = "" if math.isnan(distance_m) else f", {100 * distance_m:.2g} cm a pixel"
    lines = [
        f"{found.height_m:.4g} m high: swath {strip.swath_m:.4g} m{finest}; a lane every {strip.spacing_m:.4g} m",
        f"lanes at {math.degrees(found.plan.direction_rad):.1f}° from +x; {costs.passes} passes, {costs.turns} turns",
        f"{costs.length_m:.1f} m in {costs.flights} flight{'s' * several}, {costs.time_s / 60:.2f} min"
        + " (the longest)" * several,
        f"sweeps {costs.covered_share:.2%} of {costs.target_m2:.0f} m², {costs.covered_reachable_share:.2%} of what "
        f"can be reached ({costs.reachable_share:.2%}); {costs.useful_m2_per_m:.2f} m² a metre",
    ]
    if costs.flights > task.vehicles:
        lines.append(f"{costs.flights} flights: zones or clearance cut the area in parts, one flight each at least")
    if not math.isnan(costs.energy_wh):
        lines.append(f"{costs.energy_wh:.1f} Wh in all")
    if task.area.zone_room_m > EASE_M:
        lines.append(f"passes keep {task.area.zone_room_m:.1f} m more from zones as room for turns")
    if found.origin is None:
        lines.append("no place on Earth: give --origin LAT,LON for the files of QGroundControl, GeoJSON and KML")
    return lines


def values(done: Planned) -> dict[str, Any]:
    """A plan as plain values."""
    task = done.saved.plan.task
    return {
        "height_m": done.saved.height_m,
        "swath_m": task.strip.swath_m,
        "along_m": task.strip.along_m,
        "spacing_m": task.strip.spacing_m,
        "sample_distance_m": done.sample_distance_m,
        "direction_rad": done.saved.plan.direction_rad,
        **asdict(done.account),
        "flight_m": [flight.length_m for flight in done.saved.plan.flights],
        "files": [str(file) for file in done.files],
    }
