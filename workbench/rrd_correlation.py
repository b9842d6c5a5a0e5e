"""What is drawn of correlation odometry: fragments and surfaces, the path from above, tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import rerun as rr

from workbench import traces
from workbench.blueprints import Extent
from workbench.rrd_columns import columns, repeated
from workbench.rrd_drawing import Drawing
from workbench.rrd_file import (
    ARROW_SHARE,
    COLOURS,
    Floats,
    Ints,
    RrdFile,
    arrow,
    flat,
    marker,
)
from workbench.schema import Schema


class CorrelationDrawing(Drawing):
    """Boxes and arrows on the image, correlation surfaces with their peaks, raw and corrected path."""

    def __init__(self, file: RrdFile, schema: Schema, run: str, estimator: str, scene: Any = None) -> None:
        super().__init__(file, schema, run, estimator, scene)
        self._path: list[tuple[Ints, Ints, Floats, Floats]] = []
        self._arrangement: bytes | None = None

    def constants(self) -> None:  # noqa: D102
        thin, thick = rr.Radius.ui_points(0.75), rr.Radius.ui_points(1.25)
        self.file.static(
            f"{self.image}/fragments", rr.Boxes2D.from_fields(colors=0xFFFFFFB0, radii=thin, draw_order=11)
        )
        self.file.static(f"{self.image}/search", rr.Boxes2D.from_fields(colors=0x4FC3F7FF, radii=thin, draw_order=10))
        self.file.static(f"{self.image}/matches", rr.Boxes2D.from_fields(radii=thick, draw_order=12))
        self.file.static(f"{self.image}/tiles", rr.Points2D.from_fields(radii=rr.Radius.ui_points(2), draw_order=14))
        self.file.static(f"{self.image}/shifts", rr.Arrows2D.from_fields(radii=thick, draw_order=13))
        surface = f"{self.root}/{self.schema.entity('surface')}"
        self.file.static(
            surface,
            rr.DepthImage.from_fields(
                colormap="viridis", depth_range=(-0.5, 1.0), meter=1.0, magnification_filter="nearest"
            ),
        )
        for name, colour, radius in (("second", 0xFF8A65FF, 3), ("first", 0xFF1744FF, 4)):
            marks = rr.Points2D.from_fields(colors=colour, radii=rr.Radius.ui_points(radius))
            self.file.static(f"{surface}/{name}", marks)
        labels = rr.Points2D.from_fields(colors=0xFFFFFFFF, radii=rr.Radius.ui_points(0), show_labels=True)
        self.file.static(f"{surface}/labels", labels)
        for name in ("raw", "corrected"):
            self.file.static(f"{self.world}/{name}", rr.Points3D.from_fields(radii=rr.Radius.ui_points(2)))
        self.file.static(f"{self.world}/raw", rr.Points3D.from_fields(colors=COLOURS["raw"]))
        self.file.static(f"{self.world}/body", marker("corrected", 4.5))
        self.file.static(f"{self.world}/heading", arrow("arrow", 1.5))
        self.file.static(
            f"{self.world}/covariance",
            rr.Ellipsoids3D.from_fields(
                colors=COLOURS["corrected"], line_radii=rr.Radius.ui_points(1), fill_mode="MajorWireframe"
            ),
        )

    def legends(self, table: traces.Columns) -> Mapping[str, Any]:  # noqa: D102
        labels = [str(k + 1) for k in range(table["fragment_px"].shape[1])]
        self.file.static(f"{self.image}/fragments", rr.Boxes2D.from_fields(labels=labels))
        group = next(traces.mosaics(table))
        height, width = group.images.shape[1:]
        image_px = tuple(table["image_size_px"][0].tolist())
        return {"image_px": image_px, "surfaces_px": (float(width), float(height))}

    def bytes_a_step(self, table: traces.Columns) -> int:  # noqa: D102
        return int(table["surface"].nbytes) + 4096

    def write(self, table: traces.Columns, beside: Sequence[Any]) -> None:  # noqa: D102
        self._surfaces(table)
        self._overlays(table)
        self._map(table)
        texts = traces.numbers(table)
        media = repeated(rr.TextDocument, len(texts), media_type="text/markdown")
        self.send("numbers", table, columns(rr.TextDocument, text=texts), media)

    def _surfaces(self, table: traces.Columns) -> None:
        root = f"{self.root}/{self.schema.entity('surface')}"
        for group in traces.mosaics(table):
            frames, t_ns = table["frame"][group.rows], table["t_ns"][group.rows]
            n, height, width = group.images.shape
            buffers = group.images.view(np.uint8).reshape(n, -1)
            format_ = rr.components.ImageFormat(width=width, height=height, color_model="L", channel_datatype="F16")
            self.file.send(
                root, frames, t_ns,
                columns(rr.DepthImage, buffer=buffers), repeated(rr.DepthImage, n, format=format_),
            )  # fmt: skip
            for name, points in (("second", group.second), ("first", group.first)):
                marks = traces.shapes(points, points)
                drawn = columns(rr.Points2D, marks.counts, positions=marks.points)
                self.file.send(f"{root}/{name}", frames, t_ns, drawn)
            if group.corners.tobytes() != self._arrangement:
                self._arrangement = group.corners.tobytes()
                labels = [str(k + 1) for k in range(len(group.corners))]
                names = columns(rr.Points2D, [len(labels)], positions=group.corners + 1.5, labels=labels)
                self.file.send(f"{root}/labels", frames[:1], t_ns[:1], names)

    def _overlays(self, table: traces.Columns) -> None:
        for name, drawn in traces.overlays(table).items():
            colours: dict[str, Any] = {} if drawn.colours is None else {"colors": drawn.colours}
            kind: Any
            match name:
                case "shifts":
                    kind, at = rr.Arrows2D, {"origins": drawn.points, "vectors": drawn.extents}
                case "tiles":
                    kind, at = rr.Points2D, {"positions": drawn.points}
                case _:
                    kind, at = rr.Boxes2D, {"centers": drawn.points, "half_sizes": drawn.extents}
            self.send(f"{self.image}/{name}", table, columns(kind, drawn.counts, **at, **colours))

    def _map(self, table: traces.Columns) -> None:
        raw, pose = table["pose_raw"], table["pose"]
        colours = traces.verdict_colours(table["verdict"], COLOURS["corrected"])
        at, on_top = (flat(pose[:, :2], layer) for layer in ("corrected", "markers"))
        self.send(f"{self.world}/raw", table, columns(rr.Points3D, positions=flat(raw[:, :2], "raw")))
        self.send(f"{self.world}/corrected", table, columns(rr.Points3D, positions=at, colors=colours))
        self.send(f"{self.world}/body", table, columns(rr.Points3D, positions=on_top))
        half, angle = traces.ellipses(table["pose_covariance"])
        turn = np.column_stack([np.zeros((len(at), 2)), np.sin(angle / 2), np.cos(angle / 2)])
        ellipses = columns(rr.Ellipsoids3D, half_sizes=flat(np.nan_to_num(half)), centers=at, quaternions=turn)
        self.send(f"{self.world}/covariance", table, ellipses)
        self._path.append((table["frame"], table["t_ns"], raw, pose))

    # ---- the end

    def finish(self, aligned_path: Floats | None, given: Extent | None) -> Mapping[str, Any]:  # noqa: D102
        if aligned_path is not None and len(aligned_path):
            self._line("aligned", aligned_path)
        if not self._path:
            return {}
        frames, t_ns, raw, pose = (np.concatenate(column) for column in zip(*self._path, strict=True))
        self._line("raw", raw[:, :2])
        self._line("corrected", pose[:, :2])
        extent = Extent.of(np.concatenate([pose[:, :2], *([] if given is None else [given.corners])]))
        good = np.isfinite(pose).all(axis=1)
        self.file.scale_bar(extent)
        vectors = ARROW_SHARE * extent.size_m * np.column_stack([np.cos(pose[:, 2]), np.sin(pose[:, 2])])
        arrows = columns(rr.Arrows3D, vectors=flat(vectors[good]), origins=flat(pose[good, :2], "arrows"))
        self.file.send(f"{self.world}/heading", frames[good], t_ns[good], arrows)
        return {"extent": extent}

    def _line(self, name: str, points: Floats) -> None:
        finite = points[np.isfinite(points).all(axis=1)]
        line = rr.LineStrips3D([flat(finite, name)], colors=COLOURS[name], radii=rr.Radius.ui_points(0.6))
        self.file.static(f"{self.world}/path/{name}", line)
