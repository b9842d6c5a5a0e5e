"""What is drawn of the range filter: landmarks on the image and from above, plots of each slot, tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import rerun as rr

from pipelines.ranging.filter import Outcome
from workbench import range_traces as ranges
from workbench import traces
from workbench.blueprints import Extent
from workbench.range_traces import Beside, RangeScene
from workbench.rrd_columns import columns, repeated
from workbench.rrd_drawing import Drawing
from workbench.rrd_file import ARROW_SHARE, COLOURS, Floats, Ints, RrdFile, arrow, document, flat, marker
from workbench.schema import Schema

CHI2 = (5.991, ranges.GATE)
_CHI2_NAMES = ("95 % of χ²", "99.9 %: the gate")


class RangeDrawing(Drawing):
    """Tracked and predicted points, gates, ranges; the camera's way among the landmarks; plots slot by slot.

    The scene is a `RangeScene`, and what comes beside each step a `Beside`.
    """

    def __init__(self, file: RrdFile, schema: Schema, run: str, estimator: str, scene: Any = None) -> None:
        super().__init__(file, schema, run, estimator, scene or RangeScene())
        self._reckoned = np.zeros(3)
        self._path: list[tuple[Ints, Ints, Floats]] = []
        self._reach: list[Floats] = []
        self._tops: Floats = np.zeros(0)
        self._ids: dict[int, set[int]] = {}
        self._slots = 0
        self._smoothed: set[int] = set()

    # ---- what is logged once

    def constants(self) -> None:  # noqa: D102
        thin, thick = rr.Radius.ui_points(0.75), rr.Radius.ui_points(1.25)
        looks: dict[str, rr.AsComponents] = {
            "frame": rr.Boxes2D.from_fields(colors=0x606060FF, radii=thin, draw_order=1),
            "gate": rr.LineStrips2D.from_fields(colors=0xFFFFFFA0, radii=thin, draw_order=10),
            "predicted": rr.Points2D.from_fields(colors=0xFFFFFFFF, radii=rr.Radius.ui_points(2), draw_order=12),
            "innovation": rr.Arrows2D.from_fields(colors=0xFF5252FF, radii=thick, draw_order=13),
            "measured": rr.Points2D.from_fields(radii=rr.Radius.ui_points(3.5), draw_order=11),
            "labels": rr.Points2D.from_fields(radii=rr.Radius.ui_points(0), draw_order=14),
            "ranges": rr.Points2D.from_fields(radii=rr.Radius.ui_points(4.5), draw_order=15),
            "focus": rr.LineStrips2D.from_fields(colors=0x40C4FFFF, radii=thick, draw_order=9),
        }
        for name, look in looks.items():
            self.file.static(f"{self.image}/{name}", look)
        if self.scene.image_px is not None:
            half = np.array(self.scene.image_px) / 2
            self.file.static(f"{self.image}/frame", rr.Boxes2D(centers=[half], half_sizes=[half]))
        world = f"{self.world}/landmarks"
        self.file.static(f"{self.world}/camera", marker("corrected", 5))
        self.file.static(f"{self.world}/camera/heading", arrow("arrow", 2))
        self.file.static(f"{world}/points", rr.Points3D.from_fields(radii=rr.Radius.ui_points(4)))
        self.file.static(f"{world}/rays", rr.LineStrips3D.from_fields(radii=thick))
        look = rr.Ellipsoids3D.from_fields(line_radii=rr.Radius.ui_points(1), fill_mode="MajorWireframe")
        self.file.static(f"{world}/ellipses", look)
        if self.scene.surveyed:
            self._surveyed(f"{world}/surveyed")
        colours = np.array([0xFFB300FF, 0xF44336FF], np.uint32)
        self.file.static(f"{self.root}/bounds/nis", rr.SeriesLines(names=_CHI2_NAMES, colors=colours, widths=[1, 1]))

    def _surveyed(self, entity: str) -> None:
        numbers, places = zip(*sorted(self.scene.surveyed.items()), strict=True)
        points = flat(np.array(places)[:, :2], "markers")
        look = rr.Points3D(
            points,
            colors=COLOURS["arrow"],
            radii=rr.Radius.ui_points(2.5),
            labels=[str(number) for number in numbers],
            show_labels=len(numbers) <= ranges.LABELLED,
        )
        self.file.static(entity, look)

    def legends(self, table: traces.Columns) -> Mapping[str, Any]:  # noqa: D102
        total = table["landmark_id"].shape[1]
        self._slots = min(total, ranges.PLOTTED)
        self._tops = np.zeros(self._slots)
        for plot in ranges.PLOTS:
            colours = np.array(plot.colours, np.uint32)
            widths = [1.0 if thin else 2.0 for thin in plot.thin]
            for k in range(self._slots):
                look = rr.SeriesLines(names=plot.series, colors=colours, widths=widths)
                self.file.static(f"{self.root}/landmark/{k + 1}/{plot.name}", look)
        names = [f"reference {k + 1} [m]" for k in range(total)]
        self.file.static(f"{self.root}/reference", rr.SeriesLines(names=names))
        return {"image_px": self.scene.image_px, "landmarks": self._landmarks()}

    def bytes_a_step(self, table: traces.Columns) -> int:  # noqa: D102
        return 512 + 150 * int(table["landmark_id"].shape[1])  # an eighth: numbers are dear to send, not to hold

    # ---- what is logged with every step

    def write(self, table: traces.Columns, beside: Sequence[Any]) -> None:  # noqa: D102
        n, total = table["landmark_id"].shape
        nothing = Beside(np.full((4, 4), np.nan), np.full(total, np.nan))
        known: list[Beside] = [nothing if one is None else one for one in beside]
        reference = np.array([one.depth_m for one in known]).reshape(n, total)
        camera = np.array([one.world_t_camera for one in known])
        if not self.scene.referenced:
            poses = ranges.dead_reckoned(table, self._reckoned)
            self._reckoned, camera = poses[-1], ranges.level(poses)
        self._remember(table, camera, reference)
        self._on_image(table)
        self._from_above(table, camera)
        self._plots(table, reference)
        texts = ranges.numbers(table, reference)
        media = repeated(rr.TextDocument, n, media_type="text/markdown")
        self.send("numbers", table, columns(rr.TextDocument, text=texts), media)

    def _remember(self, table: traces.Columns, camera: Floats, reference: Floats) -> None:
        """What the views at the end need: the way, who was in which slot, and how far the plots reach."""
        self._path.append((table["frame"], table["t_ns"], camera))
        ids = table["landmark_id"][:, : self._slots]
        for k in range(self._slots):
            self._ids.setdefault(k, set()).update(np.unique(ids[:, k][~np.isnan(ids[:, k])]).astype(int).tolist())
        sure = table["relative_sigma"][:, : self._slots] < ranges.ELLIPSE_SIGMA
        told = np.where(sure, table["range_m"][:, : self._slots], 0)
        highest = np.fmax(np.nan_to_num(told).max(axis=0), np.nan_to_num(reference[:, : self._slots]).max(axis=0))
        self._tops = np.fmax(self._tops, highest)

    def _on_image(self, table: traces.Columns) -> None:
        measured, predicted = (ranges.shown(points, self.scene) for points in self._points(table))
        seen, foreseen = (traces.finite(points, 2) for points in (measured, predicted))
        colours = ranges.status_colours(table["status"])
        self._points2d("measured", table, measured, seen, colors=colours[seen])
        self._points2d("predicted", table, predicted, foreseen)
        both = seen & foreseen
        shifts = (measured - predicted)[both]
        arrows = columns(rr.Arrows2D, both.sum(axis=1), origins=predicted[both], vectors=shifts)
        self.send(f"{self.image}/innovation", table, arrows)
        spread = table["innovation_covariance"]
        gated = foreseen & traces.finite(spread, (2, 3))
        strips = ranges.gates(predicted[gated], spread[gated])
        self.send(f"{self.image}/gate", table, columns(rr.LineStrips2D, gated.sum(axis=1), strips=strips))
        where = np.where(seen[..., None], measured, ranges.shown(table["mean"][..., :2], self.scene))
        carried = traces.finite(where, 2) & np.asarray(table["outcome"] != Outcome.LOST)
        if carried.shape[1] <= ranges.LISTED:
            self._labels(table, where, carried)
        told = carried & np.isfinite(table["range_m"])
        self._points2d("ranges", table, where, told, colors=ranges.range_colours(table["range_m"][told]))
        self._focus(table)

    def _points(self, table: traces.Columns) -> tuple[Floats, Floats]:
        return table["measured_px"], table["prior"][..., :2]

    def _points2d(self, name: str, table: traces.Columns, points: Floats, chosen: Any, **more: Any) -> None:
        drawn = columns(rr.Points2D, chosen.sum(axis=1), positions=points[chosen], **more)
        self.send(f"{self.image}/{name}", table, drawn)

    def _labels(self, table: traces.Columns, where: Floats, carried: Any) -> None:
        """Numbers and ranges; those of many landmarks would hide the image and show only under the mouse."""
        count = carried.sum(axis=1)
        colours = ranges.status_colours(table["status"][carried])
        labels = ranges.labels(table, carried)
        drawn = columns(rr.Points2D, count, positions=where[carried], colors=colours, labels=labels)
        shown = columns(rr.Points2D, show_labels=count <= ranges.LABELLED)
        self.send(f"{self.image}/labels", table, drawn, shown)

    def _focus(self, table: traces.Columns) -> None:
        """A cross where the camera moves to."""
        at = ranges.shown(table["focus_px"][:, None, :], self.scene)[:, 0]
        good = traces.finite(at, 1)
        arm = np.array([[[-6.0, 0], [6.0, 0]], [[0, -6.0], [0, 6.0]]])
        strips = (at[good][:, None, None, :] + arm).reshape(-1, 2, 2)
        self.send(f"{self.image}/focus", table, columns(rr.LineStrips2D, 2 * good, strips=strips))

    def _from_above(self, table: traces.Columns, camera: Floats) -> None:
        above = ranges.from_above(table, camera, self.scene)
        world = f"{self.world}/landmarks"
        self._reach.append(above.points[above.sure])
        places = flat(above.points, "corrected")
        self.send(f"{world}/points", table, columns(rr.Points3D, above.counts, positions=places, colors=above.colours))
        strips = flat(above.rays.reshape(-1, 2), "raw").reshape(-1, 2, 3)
        faint = (above.colours & np.uint32(0xFFFFFF00)) | np.uint32(0x90)
        self.send(f"{world}/rays", table, columns(rr.LineStrips3D, above.counts, strips=strips, colors=faint))
        self._ellipses(f"{world}/ellipses", table, above)
        known = traces.finite(camera, (1, 2))
        there = {"frame": table["frame"][known], "t_ns": table["t_ns"][known]}
        self.send(f"{self.world}/camera", there, columns(rr.Points3D, positions=flat(camera[known, :2, 3], "markers")))

    def _ellipses(self, entity: str, table: traces.Columns, above: ranges.Above) -> None:
        sure = above.sure
        step = np.repeat(np.arange(len(above.counts)), above.counts)
        counts = np.bincount(step[sure], minlength=len(above.counts))
        half = np.column_stack([above.half_axes, np.zeros(len(sure))])[sure]
        angle = above.angle[sure] / 2
        turn = np.column_stack([np.zeros((len(angle), 2)), np.sin(angle), np.cos(angle)])
        ellipses = columns(
            rr.Ellipsoids3D, counts, half_sizes=half, centers=flat(above.points[sure], "corrected"), quaternions=turn,
            colors=above.colours[sure],
        )  # fmt: skip
        self.send(entity, table, ellipses)

    def _plots(self, table: traces.Columns, reference: Floats) -> None:
        for name, values in ranges.plotted(table, reference, self._slots).items():
            for k in range(values.shape[1]):
                self.send(f"landmark/{k + 1}/{name}", table, columns(rr.Scalars, scalars=values[:, k]))
        if np.isfinite(reference).any():
            self.send("reference", table, columns(rr.Scalars, scalars=reference))
        self.send("bounds/nis", table, columns(rr.Scalars, scalars=np.tile(CHI2, (len(reference), 1))))

    # ---- the end

    def smoothed(self, slot: int, frames: Ints, t_ns: Ints, mean: Floats, covariance: Floats) -> None:  # noqa: D102
        root = f"{self.root}/smoothed/{slot + 1}"
        values = {"state": mean, "covariance": covariance.reshape(-1, 9), "range": ranges.smoothed(mean, covariance)}
        for name, rows in values.items():
            self.file.send(f"{root}/{name}", frames, t_ns, columns(rr.Scalars, scalars=rows))
        plot = ranges.SMOOTHED
        widths = [1.0 if thin else 2.0 for thin in plot.thin]
        look = rr.SeriesLines(names=plot.series, colors=np.array(plot.colours, np.uint32), widths=widths)
        self.file.static(f"{root}/range", look)
        names = {"state": ["x [px]", "y [px]", "ξ [1/m]"], "covariance": [f"P {a}{b}" for a in "xyξ" for b in "xyξ"]}
        for name, series in names.items():
            self.file.static(f"{root}/{name}", rr.SeriesLines(names=series))
        self._smoothed.add(slot + 1)

    def finish(self, aligned_path: Floats | None, given: Extent | None) -> Mapping[str, Any]:  # noqa: D102
        if not self._path:
            return {}
        frames, t_ns, camera = (np.concatenate(column) for column in zip(*self._path, strict=True))
        good = traces.finite(camera, (1, 2))
        way, ahead = camera[good, :2, 3], camera[good, :2, 2]
        surveyed = np.array([place[:2] for place in self.scene.surveyed.values()]).reshape(-1, 2)
        shown = [way, surveyed, _bulk(np.concatenate(self._reach))]
        extent = Extent.of(np.concatenate([*shown, *([] if given is None else [given.corners])]))
        name = "reference" if self.scene.referenced else "corrected"
        line = rr.LineStrips3D([flat(way, name)], colors=COLOURS[name], radii=rr.Radius.ui_points(0.8))
        self.file.static(f"{self.world}/camera/path", line)
        self.file.scale_bar(extent)
        vectors = flat(ARROW_SHARE * extent.size_m * ahead)
        arrows = columns(rr.Arrows3D, vectors=vectors, origins=flat(way, "arrows"))
        self.file.send(f"{self.world}/camera/heading", frames[good], t_ns[good], arrows)
        self.file.static(f"{self.root}/slots", document(self._slot_table()))
        return {"extent": extent, "landmarks": self._landmarks(), "smoothed": frozenset(self._smoothed)}

    def _landmarks(self) -> tuple[tuple[int, str, float], ...]:
        """Name and highest range of each slot with plots; slots that stayed empty are left out at the end."""
        named = []
        for k in range(self._slots):
            ids = self._ids.get(k, set())
            if self._path and not ids:
                continue
            name = f"{k + 1}: no. {next(iter(ids))}" if len(ids) == 1 else f"{k + 1}"
            named.append((k + 1, name, 1.4 * float(self._tops[k])))
        return tuple(named)

    def _slot_table(self) -> str:
        rows = [f"| {k + 1} | {_some(sorted(ids))} |" for k, ids in sorted(self._ids.items()) if ids]
        return "\n".join(["| slot | landmarks |", "|---:|---|", *rows])


def _some(numbers: Sequence[int], most: int = 12) -> str:
    listed = ", ".join(map(str, numbers[:most]))
    return listed if len(numbers) <= most else f"{listed} and {len(numbers) - most} more"


def _bulk(points: Floats, share: float = 0.02) -> Floats:
    """Points [n, 2] without the outermost ones of each side."""
    if not len(points):
        return points
    low, high = np.quantile(points, [share, 1 - share], axis=0)
    return np.asarray(points[((points >= low) & (points <= high)).all(axis=1)])
