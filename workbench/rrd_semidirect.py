"""What is drawn of a visual odometry: points, patches and epipolar segments on the image; map and path in space."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import rerun as rr
from scipy.spatial.transform import Rotation

from pipelines.semidirect.step import Stage
from workbench import traces
from workbench import visual_traces as visual
from workbench.blueprints import Extent
from workbench.rrd_columns import columns, repeated
from workbench.rrd_drawing import Drawing
from workbench.rrd_file import ARROW_SHARE, COLOURS, Floats, Ints, RrdFile, arrow, document, flat, marker
from workbench.schema import Schema
from workbench.traces import Joined

STAGE_COLOURS: Mapping[Stage, int] = {
    Stage.FIRST: 0x42A5F5FF,
    Stage.STARTING: 0x42A5F5FF,
    Stage.STARTED: 0x26C6DAFF,
    Stage.TRACKED: 0x4CAF50FF,
    Stage.RELOCALISED: 0xE040FBFF,
    Stage.LOST: 0xF44336FF,
    Stage.SKIPPED: 0x9E9E9EFF,
}
UNTIMED = (
    "The stages were not timed, since a clock's numbers would differ from replay to replay. Replay with "
    "`--set stage_times=true` to have them here."
)
CAMERA_DEPTH = 0.3
"""Depth of the camera's frustum, in scene depths."""


class VisualDrawing(Drawing):
    """Of every visual odometry: the points looked for, the map, keyframes and path; `scene` is a `VisualScene`."""

    def __init__(self, file: RrdFile, schema: Schema, run: str, estimator: str, scene: Any = None) -> None:
        super().__init__(file, schema, run, estimator, scene)
        self._path: list[tuple[Ints, Ints, Floats, Floats, Any]] = []
        self._depths: list[Floats] = []
        self._stages_ms: list[Floats] = []
        self._stage = -1
        self._size = np.array([np.nan, np.nan])
        self.silent = frozenset({"features/error"})

    # ---- what is logged once

    def constants(self) -> None:  # noqa: D102
        point, thin = rr.Radius.ui_points, rr.Radius.ui_points(0.75)
        self.file.static(
            f"{self.image}/predicted", rr.Points2D.from_fields(colors=0xFFFFFFA0, radii=point(1.5), draw_order=11)
        )
        self.file.static(f"{self.image}/missed", rr.Points2D.from_fields(radii=point(2.5), draw_order=12))
        self.file.static(f"{self.image}/features", rr.Points2D.from_fields(draw_order=13))
        self.file.static(f"{self.world}/corrected", rr.Points3D.from_fields(radii=point(2)))
        above = f"{self.world}/above"
        self.file.static(f"{above}/path", rr.Points3D.from_fields(radii=point(2)))
        self.file.static(f"{above}/heading", arrow("arrow", 1.5))
        self.file.static(f"{above}/body", marker("corrected", 4.5))
        self.file.static(f"{self.world}/map/points", rr.Points3D.from_fields(radii=point(1.5)))
        self.file.static(f"{self.world}/map/keyframes", rr.LineStrips3D.from_fields(colors=0xFFA726FF, radii=thin))
        names = list(visual.STAGE_NAMES)
        colours = [STAGE_COLOURS[stage] for stage in Stage]
        self.file.static(f"{self.root}/stage", rr.StateConfiguration(values=names, labels=names, colors=colours))
        self.file.static(f"{self.root}/untimed", document(UNTIMED))
        self.file.static(f"{self.root}/features/error", rr.SeriesLines(names=["median [px]", "90 % [px]"]))

    def legends(self, table: traces.Columns) -> Mapping[str, Any]:  # noqa: D102
        self._size = table["image_size_px"][0]
        self._camera(CAMERA_DEPTH)
        return {"image_px": tuple(self._size.tolist())}

    def _camera(self, depth: float) -> None:
        """The camera's frustum; `depth` of it in the path's unit."""
        if self.scene is None or not np.isfinite(self._size).all():
            return
        focal, centre = self.scene.focal_px, self.scene.centre_px
        pinhole = rr.Pinhole(
            focal_length=focal,
            width=self._size[0],
            height=self._size[1],
            principal_point=None if centre is None else np.array(centre) + 0.5,
            image_plane_distance=depth,
            color=COLOURS["corrected"],
        )
        self.file.static(f"{self.world}/camera", pinhole)

    def bytes_a_step(self, table: traces.Columns) -> int:  # noqa: D102
        return 16384

    # ---- what is logged with every step

    def write(self, table: traces.Columns, beside: Sequence[Any]) -> None:  # noqa: D102
        self._features(table)
        self._structure(table)
        self._way(table)
        self._stages(table)
        self._stages_ms.append(table["stage_ms"])
        errors = Joined.of(table["error_px"]).chosen(visual.found(np.concatenate(table["outcome"])))
        spread = np.column_stack([visual.quantiles(errors, 0.5), visual.quantiles(errors, 0.9)])
        self._series("features/error", table, spread)
        texts = self._texts(table)
        media = repeated(rr.TextDocument, len(texts), media_type="text/markdown")
        self.send("numbers", table, columns(rr.TextDocument, text=texts), media)

    def _series(self, entity: str, table: traces.Columns, values: Floats) -> None:
        """Log rows of numbers [n, k] for a plot, and whether there ever was one."""
        told = bool(np.nan_to_num(values).any())
        self.silent = self.silent - {entity} if told else self.silent
        self.send(entity, table, columns(rr.Scalars, scalars=values))

    def _texts(self, table: traces.Columns) -> list[str]:
        return visual.numbers(table, semidirect=False)

    def _features(self, table: traces.Columns) -> None:
        outcome = np.concatenate(table["outcome"])
        state = np.concatenate(table["point_state"]) if "point_state" in table else None
        level = np.maximum(np.concatenate(table["level"]), 0)
        colours = visual.feature_colours(outcome, state)
        predicted, at = (Joined.of(table[name]) for name in ("predicted_px", "found_px"))
        self._points("predicted", table, predicted, traces.finite(predicted.values, 1))
        found = visual.found(outcome) & traces.finite(at.values, 1)
        radii = -(2.5 + 1.25 * level)  # points of the screen are negative
        self._points("features", table, at, found, colors=colours[found], radii=radii[found])
        missed = ~visual.found(outcome) & traces.finite(predicted.values, 1)
        self._points("missed", table, predicted, missed, colors=colours[missed])

    def _points(self, name: str, table: traces.Columns, points: Joined, chosen: Any, **more: Any) -> None:
        """Draw some points on the image."""
        some = points.chosen(chosen)
        drawn = columns(rr.Points2D, some.counts, positions=some.values + 0.5, **more)
        self.send(f"{self.image}/{name}", table, drawn)

    def _structure(self, table: traces.Columns) -> None:
        """The map where it changed; in between the last one stays."""
        depth = table["scene_depth_m"]
        self._depths.append(depth[np.isfinite(depth)])
        changed = np.array([len(ids) > 0 for ids in table["map_id"]])
        if changed.any():
            at = {"frame": table["frame"][changed], "t_ns": table["t_ns"][changed]}
            points = Joined.of(table["map_point_m"][changed])
            sigma = np.concatenate(table["map_point_sigma_m"][changed])
            colours = visual.heat(visual.sureness(sigma, depth[changed][points.rows]))
            drawn = columns(rr.Points3D, points.counts, positions=points.values, colors=colours)
            self.send(f"{self.world}/map/points", at, drawn)
            self._uncertain(at, points, sigma)
            if "map_point_covariance" in table:
                self._ellipsoids(at, points, np.concatenate(table["map_point_covariance"][changed]))
        framed = np.array([len(ids) > 0 for ids in table["keyframe_number"]])
        if framed.any() and self.scene is not None:
            self._keyframes(table, framed)

    def _uncertain(self, at: traces.Columns, points: Joined, sigma: Floats) -> None:
        """The points as balls of radius σ, where that is known."""
        known = np.isfinite(sigma)
        some = points.chosen(known)
        balls = columns(rr.Points3D, some.counts, positions=some.values, radii=sigma[known])
        self.send(f"{self.world}/map/sigma", at, balls)

    def _ellipsoids(self, at: traces.Columns, points: Joined, covariance: Floats) -> None:
        """The points as ellipsoids of one standard deviation, where their covariance is known."""
        known = np.asarray(np.isfinite(covariance).all(axis=(1, 2)))
        some = points.chosen(known)
        variance, axes = np.linalg.eigh(covariance[known])
        axes[:, :, 2] *= np.sign(np.linalg.det(axes))[:, None]  # right-handed
        ellipsoids = columns(
            rr.Ellipsoids3D,
            some.counts,
            centers=some.values,
            half_sizes=np.sqrt(np.maximum(variance, 0.0)),
            quaternions=Rotation.from_matrix(axes).as_quat() if len(axes) else np.zeros((0, 4)),
        )
        self.send(f"{self.world}/map/covariance", at, ellipsoids)

    def _keyframes(self, table: traces.Columns, framed: Any) -> None:
        at = {"frame": table["frame"][framed], "t_ns": table["t_ns"][framed]}
        places = Joined.of(table["keyframe_position_m"][framed])
        turns = np.concatenate(table["keyframe_quat_xyzw"][framed])
        depth = np.nan_to_num(table["scene_depth_m"][framed], nan=1.0)[places.rows] * visual.FRUSTUM_DEPTH
        strips = visual.frusta(places.values, turns, self.scene.focal_px, self._size, depth)
        self.send(f"{self.world}/map/keyframes", at, columns(rr.LineStrips3D, places.counts, strips=strips))

    def _way(self, table: traces.Columns) -> None:
        good = table["accepted"].astype(bool) & traces.finite(table["position_m"], 1)
        there = {"frame": table["frame"][good], "t_ns": table["t_ns"][good]}
        position, turn = table["position_m"][good], table["quat_xyzw"][good]
        colours = traces.verdict_colours(table["verdict"][good], COLOURS["corrected"])
        moved = columns(rr.Transform3D, translation=position, quaternion=turn)
        self.send(f"{self.world}/camera", there, moved)
        self.send(f"{self.world}/corrected", there, columns(rr.Points3D, positions=position, colors=colours))
        above = f"{self.world}/above"
        ground, on_top = (flat(position[:, :2], layer) for layer in ("corrected", "markers"))
        self.send(f"{above}/path", there, columns(rr.Points3D, positions=ground, colors=colours))
        self.send(f"{above}/body", there, columns(rr.Points3D, positions=on_top))
        self._path.append((there["frame"], there["t_ns"], position, table["pose"][good], table["map_number"][good]))

    def _stages(self, table: traces.Columns) -> None:
        changes = visual.stage_changes(self._stage, table["stage"].tolist())
        self._stage = int(table["stage"][-1])
        if changes:
            rows = [row for row, _ in changes]
            at = {"frame": table["frame"][rows], "t_ns": table["t_ns"][rows]}
            self.send("stage", at, columns(rr.StateChange, state=[name for _, name in changes]))

    # ---- the end

    def finish(self, aligned_path: Floats | None, given: Extent | None) -> Mapping[str, Any]:
        """Draw the whole path, and the reference [n, 3] that was laid over it, if any."""
        if aligned_path is not None and len(aligned_path):
            self._line("reference", [aligned_path], 1.2)
        known = {"slowest_ms": visual.top_of_times(np.concatenate(self._stages_ms))}
        frames, t_ns, position, pose, maps = (np.concatenate(column) for column in zip(*self._path, strict=True))
        if not len(frames):
            return known
        cuts = np.flatnonzero((np.diff(maps) != 0) | (np.diff(frames) > self._gap(frames))) + 1
        self._line("corrected", np.split(position, cuts), 0.6)
        extent = Extent.of(np.concatenate([position[:, :2], *([] if given is None else [given.corners])]))
        self.file.scale_bar(extent)
        vectors = ARROW_SHARE * extent.size_m * np.column_stack([np.cos(pose[:, 2]), np.sin(pose[:, 2])])
        arrows = columns(rr.Arrows3D, vectors=flat(vectors), origins=flat(position[:, :2], "arrows"))
        self.file.send(f"{self.world}/above/heading", frames, t_ns, arrows)
        depths = np.concatenate(self._depths)
        depth = float(np.median(depths)) if len(depths) else 1.0
        self._camera(CAMERA_DEPTH * depth)
        self._ground(extent)
        return {**known, "extent": extent, "height_m": float(position[:, 2].max())}

    def _gap(self, frames: Ints) -> float:
        """More frames than this without a pose part the line of the path."""
        steps = np.diff(frames)
        return 3 * float(np.median(steps)) if len(steps) else 1.0

    def _line(self, name: str, parts: Sequence[Floats], radius: float) -> None:
        strips = [part[traces.finite(part, 1)].astype(np.float32) for part in parts]
        look = rr.LineStrips3D(strips, colors=COLOURS[name], radii=rr.Radius.ui_points(radius))
        self.file.static(f"{self.world}/path/{name}", look)

    def _ground(self, extent: Extent) -> None:
        """The plane z = 0, which the first map lies on, as a grid over the path and a margin."""
        (x0, y0), (x1, y1) = extent.corners + 0.1 * extent.size_m * np.array([[-1, -1], [1, 1]])
        step = extent.bar()[0]
        across = [[(x, y0, 0), (x, y1, 0)] for x in np.arange(np.ceil(x0 / step), x1 / step) * step]
        along = [[(x0, y, 0), (x1, y, 0)] for y in np.arange(np.ceil(y0 / step), y1 / step) * step]
        lines = np.array([*across, *along], np.float32).reshape(-1, 2, 3)
        self.file.static(
            f"{self.world}/plane", rr.LineStrips3D(lines, colors=0x455A64FF, radii=rr.Radius.ui_points(0.4))
        )


class SemidirectDrawing(VisualDrawing):
    """Of the semi-direct odometry besides: patches of the alignment, depth filters with their epipolar segments."""

    def __init__(self, file: RrdFile, schema: Schema, run: str, estimator: str, scene: Any = None) -> None:
        super().__init__(file, schema, run, estimator, scene)
        self._filters = visual.FilterLog()
        self.silent |= {"alignment/level", "alignment/iterations", "prior/correction", "filters/spread"}

    def constants(self) -> None:  # noqa: D102
        super().constants()
        point, thin = rr.Radius.ui_points, rr.Radius.ui_points(0.75)
        self.file.static(f"{self.image}/patches", rr.Points2D.from_fields(radii=point(2), draw_order=10))
        self.file.static(f"{self.image}/epipolar", rr.LineStrips2D.from_fields(radii=thin, draw_order=9))
        self.file.static(f"{self.image}/filters", rr.Points2D.from_fields(radii=point(2), draw_order=10))
        spread = ["median σ / z_range", "median a/(a+b)"]
        self.file.static(f"{self.root}/filters/spread", rr.SeriesLines(names=spread))
        corrections = ["by the alignment [m]", "in the end [m]"]
        self.file.static(f"{self.root}/prior/correction", rr.SeriesLines(names=corrections))
        for k in range(visual.FOLLOWED):
            self._filter_legends(f"{self.root}/filters/shown/{k + 1}")

    def _filter_legends(self, entity: str) -> None:
        blue = np.array([0x42A5F5FF, 0x42A5F580, 0x42A5F580], np.uint32)
        names = ["μ [1/m]", "μ - σ [1/m]", "μ + σ [1/m]"]
        self.file.static(f"{entity}/depth", rr.SeriesLines(names=names, colors=blue, widths=[2, 1, 1]))
        self.file.static(f"{entity}/ratio", rr.SeriesLines(names=["a/(a+b)", "C1"], colors=[0x66BB6AFF, 0x9E9E9EFF]))

    def legends(self, table: traces.Columns) -> Mapping[str, Any]:  # noqa: D102
        coarsest = self.scene.coarsest_level if self.scene is not None else 0
        levels = [abs(coarsest - k) for k in range(len(table["align_iterations"][0]))]
        names = [f"level {level} {when}" for level in levels for when in ("before", "after")]
        colours = visual.level_colours(len(levels))
        pairs = np.repeat(colours, 2)
        pairs[::2] = pairs[::2] & ~np.uint32(0xFF) | np.uint32(0x80)  # before: paler
        self.file.static(f"{self.root}/alignment/level", rr.SeriesLines(names=names, colors=pairs))
        iterations = [f"level {level}" for level in levels]
        self.file.static(f"{self.root}/alignment/iterations", rr.SeriesLines(names=iterations, colors=colours))
        return super().legends(table)

    def _texts(self, table: traces.Columns) -> list[str]:
        return visual.numbers(table, semidirect=True)

    def write(self, table: traces.Columns, beside: Sequence[Any]) -> None:  # noqa: D102
        super().write(table, beside)
        self._alignment(table)
        self._epipolar(table)
        self._courses(table)

    def _alignment(self, table: traces.Columns) -> None:
        patches, residual = Joined.of(table["align_px"]), np.concatenate(table["align_residual"])
        good = traces.finite(patches.values, 1)
        self._points("patches", table, patches, good, colors=visual.heat(residual[good] / visual.BAD_RESIDUAL))
        costs = visual.level_costs(table)
        self._series("alignment/level", table, costs)
        ways = [table[name] - table["prior_position_m"] for name in ("aligned_position_m", "position_m")]
        corrections = np.linalg.norm(np.stack(ways, axis=1), axis=2)
        corrections[~table["accepted"].astype(bool)] = np.nan  # the last pose is held there
        self._series("prior/correction", table, corrections)
        self._series("alignment/iterations", table, np.stack(list(table["align_iterations"])).astype(float))

    def _epipolar(self, table: traces.Columns) -> None:
        ends, outcome = Joined.of(table["epipolar_px"]), np.concatenate(table["filter_outcome"])
        colours = np.array(visual.FILTER_COLOURS, np.uint32)[np.clip(outcome, 0, len(visual.FILTER_COLOURS) - 1)]
        good = traces.finite(ends.values, 1) & (outcome != visual.UNSEEN)
        some = ends.chosen(good)
        segments = some.values.reshape(-1, 2, 2) + 0.5
        drawn = columns(rr.LineStrips2D, some.counts, strips=segments, colors=colours[good])
        self.send(f"{self.image}/epipolar", table, drawn)
        places = Joined.of(table["filter_found_px"])
        good = traces.finite(places.values, 1)
        self._points("filters", table, places, good, colors=colours[good])
        sigma, scale = np.concatenate(table["filter_sigma"]), np.concatenate(table["filter_range"])
        medians = [
            visual.quantiles(Joined(ends.counts, values), 0.5)
            for values in (sigma / scale, np.concatenate(table["filter_ratio"]))
        ]
        self._series("filters/spread", table, np.column_stack(medians))

    def _courses(self, table: traces.Columns) -> None:
        shown, diverged = self._filters.take(table)
        for k, rows in enumerate(shown):
            if rows:
                at = [row for row, _, _ in rows]
                there = {"frame": table["frame"][at], "t_ns": table["t_ns"][at]}
                numbers = np.array([number for _, number, _ in rows], np.float64)
                self._course(f"filters/shown/{k + 1}", there, numbers, np.array([values for _, _, values in rows]))
        for one in diverged:
            entity = f"filters/diverged/{one.number}"
            self._filter_legends(f"{self.root}/{entity}")
            there = {"frame": one.frame, "t_ns": one.t_ns}
            self._course(entity, there, np.full(len(one.frame), float(one.number)), one.values)

    def _course(self, entity: str, there: traces.Columns, numbers: Floats, values: Floats) -> None:
        self.send(f"{entity}/depth", there, columns(rr.Scalars, scalars=values[:, :3]))
        self.send(f"{entity}/ratio", there, columns(rr.Scalars, scalars=values[:, 3:]))
        self.send(f"{entity}/number", there, columns(rr.Scalars, scalars=numbers[:, None]))
