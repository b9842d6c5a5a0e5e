"""A plan and a flight on the map, as an ``.rrd``: lines, coverage as a coloured sheet on the ground, gaps, curves."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from pipelines.patrol.coverage import Coverage
from pipelines.patrol.plan import Plan
from workbench.blueprints import Extent, ground_view
from workbench.patrol.areas import rings_of
from workbench.patrol.colours import Scale
from workbench.patrol.evaluating import Evaluation
from workbench.rrd_columns import columns
from workbench.rrd_file import RrdFile, document

Floats = NDArray[np.float64]

COLOURS = {
    "area": 0xFFFFFFFF, "no_go": 0xFF5252FF, "pass": 0x4FC3F7FF, "way": 0x90A4AEFF, "flown": 0xFFD54FFF,
    "gap": 0xFF4081FF, "footprint": 0xFFFFFFFF,
}  # fmt: skip
HEIGHTS = {"coverage": 0.0, "area": 0.02, "gap": 0.03, "plan": 0.04, "flown": 0.05, "footprint": 0.06}
"""Heights of the layers of the map in shares of 1 % of its size, so that none flickers through another."""
PLAN_MS = 1_000_000_000


def write_plan(path: Path, plan: Plan, text: str) -> Path:
    """Write a plan's map."""
    file = RrdFile(path, f"patrol-{path.stem}")
    extent = Extent.of(np.concatenate([_corners(plan.task.area.polygon), *(f.points for f in plan.flights)]))
    _plan(file, plan, extent)
    file.static("/patrol/account", document(text))
    file.scale_bar(extent)
    file.blueprint(
        _blueprint([ground_view("/world/**", extent, "Plan: passes blue, ways between them grey, no-go red")], (), [])
    )
    file.close()
    return path


def write_flight(path: Path, done: Evaluation, text: str) -> Path:
    """Write a flight's map: what was seen, how finely, the path, the plan, the gaps."""
    file = RrdFile(path, f"patrol-{path.stem}")
    found = done.found
    corners = [found.middles.reshape(-1, 2)[[0, -1]]]
    corners += [_corners(done.target)] if done.target is not None else []
    extent = Extent.of(np.concatenate(corners))
    count = Scale.of_counts(found.count)
    finest = found.best_m[np.isfinite(found.best_m)]
    sheets = ["times"]
    _sheet(file, "times", found, count.colours(np.where(found.count > 0, found.count, np.nan)))
    maps = [_view(sheets[0], extent, f"Times seen: 1 (blue) to {count.high:.0f} (yellow)", ["resolution"])]
    if len(finest):
        fine = Scale.of_sizes(finest)
        _sheet(file, "resolution", found, fine.colours(found.best_m))
        low, high = fine.low * 100, fine.high * 100
        maps.append(
            _view("resolution", extent, f"Finest pixel: {low:.2g} cm (blue) to {high:.2g} cm (yellow)", ["times"])
        )
    if done.plan is not None:
        _plan(file, done.plan, extent)
    elif done.target is not None:
        _outlines(file, "/world/area", rings_of(done.target), "area", HEIGHTS["area"], extent)
    _outlines(file, "/world/gaps", [r for gap in done.gaps for r in rings_of(gap)], "gap", HEIGHTS["gap"], extent)
    _flown(file, done, extent)
    file.static("/patrol/account", document(text))
    file.scale_bar(extent)
    plots = _curves(file, done)
    file.blueprint(_blueprint(maps, plots, []))
    file.close()
    return path


def _view(shown: str, extent: Extent, name: str, hidden: Sequence[str]) -> rrb.Spatial3DView:
    return ground_view(["/world/**", *(f"- /world/coverage/{other}/**" for other in hidden)], extent, name)


def _blueprint(maps: Sequence[Any], plots: Sequence[Any], more: Sequence[Any]) -> rrb.Blueprint:
    text = rrb.TextDocumentView(origin="/patrol/account", name="Account")
    side = rrb.Vertical(text, *plots, *more, row_shares=[3, *([1] * len(plots))])
    return rrb.Blueprint(
        rrb.Horizontal(rrb.Vertical(*maps), side, column_shares=[3, 2]),
        rrb.TimePanel(state="collapsed", timeline="sensor_time"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        auto_views=False,
    )


# ----------------------------------------------------------------------------------- layers


def _layer(points: Floats, height: float, extent: Extent) -> NDArray[np.float32]:
    return np.column_stack([points, np.full(len(points), height * extent.size_m / 100)]).astype(np.float32)


def _plan(file: RrdFile, plan: Plan, extent: Extent) -> None:
    area = plan.task.area
    _outlines(file, "/world/area", rings_of(area.polygon), "area", HEIGHTS["area"], extent)
    _outlines(
        file, "/world/no_go", [r for zone in area.no_go for r in rings_of(zone)], "no_go", HEIGHTS["area"], extent
    )
    for number, flight in enumerate(plan.flights, 1):
        for name, sweeping in (("pass", True), ("way", False)):
            lines = [leg.points for leg in flight.legs if leg.sweeping is sweeping]
            _outlines(file, f"/world/plan/{number}/{name}", lines, name, HEIGHTS["plan"], extent)
        start = _layer(flight.points[:1], HEIGHTS["plan"], extent)
        point = rr.Points3D(start, radii=rr.Radius.ui_points(5), colors=COLOURS["pass"], labels=f"begin {number}")
        file.static(f"/world/plan/{number}/begin", point)


def _outlines(file: RrdFile, entity: str, lines: Iterable[Floats], colour: str, height: float, extent: Extent) -> None:
    strips = [_layer(line, height, extent) for line in lines]
    if strips:
        file.static(entity, rr.LineStrips3D(strips, colors=COLOURS[colour], radii=rr.Radius.ui_points(1.5)))


def _corners(shape: BaseGeometry) -> Floats:
    return np.array(shape.bounds, dtype=np.float64).reshape(2, 2)


def _sheet(file: RrdFile, name: str, found: Coverage, rgb: NDArray[np.uint8]) -> None:
    """A picture [rows, columns, 3] laid on the ground, its first row at the bottom of the map."""
    rows, columns = found.count.shape
    x, y = found.origin_m
    right, top = x + columns * found.cell_m, y + rows * found.cell_m
    corners = np.array([[x, y, 0], [right, y, 0], [right, top, 0], [x, top, 0]], dtype=np.float32)
    mesh = rr.Mesh3D(
        vertex_positions=corners,
        triangle_indices=[[0, 1, 2], [0, 2, 3]],
        vertex_texcoords=[[0, 0], [1, 0], [1, 1], [0, 1]],
        vertex_normals=[[0, 0, 1]] * 4,
        albedo_texture=rgb,
    )
    file.static(f"/world/coverage/{name}", mesh)


def _flown(file: RrdFile, done: Evaluation, extent: Extent) -> None:
    _outlines(file, "/world/flown", [done.track.position_m[:, :2]], "flown", HEIGHTS["flown"], extent)
    found = done.found
    strips = [_layer(np.concatenate([o, o[:1]]), HEIGHTS["footprint"], extent) for o in found.footprints]
    looks = columns(rr.LineStrips3D, strips=strips)
    file.static(
        "/world/footprint", rr.LineStrips3D.from_fields(colors=COLOURS["footprint"], radii=rr.Radius.ui_points(1))
    )
    file.send("/world/footprint", found.frames, done.looks.t_ns[found.frames], looks)


def _curves(file: RrdFile, done: Evaluation) -> list[rrb.TimeSeriesView]:
    frames, t_ns = np.arange(len(done.looks.t_ns)), done.looks.t_ns
    curves = {"height": ("Height over ground, m", frames, t_ns, done.looks.position_m[:, 2] - done.ground_m)}
    known = np.isfinite(done.overlaps)
    if known.any():
        at = done.found.frames[1:][known]
        curves["overlap"] = ("Overlap with the picture before", at, t_ns[at], done.overlaps[known])
    plots = []
    for name, (title, numbers, times, values) in curves.items():
        file.send(f"/patrol/{name}", numbers, times, columns(rr.Scalars, scalars=values))
        plots.append(rrb.TimeSeriesView(origin=f"/patrol/{name}", name=title))
    if done.beside is not None:
        cross = columns(rr.Scalars, scalars=done.beside.cross_m)
        file.send("/patrol/cross_track", None, done.track.t_ns, cross)
        plots.append(rrb.TimeSeriesView(origin="/patrol/cross_track", name="Beside the plan, m (left positive)"))
    return plots
