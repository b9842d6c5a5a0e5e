"""Where each field of a Step lies in the recording: its entity, its archetype and its series.

An entity path here is relative to the root of a run, ``/runs/RUN/ESTIMATOR``. Unit, shape and meaning
are those that the Step declares (`pipelines.estimator.quantities`) and are not repeated here. Fields
that share an entity form one group of series, in the order of the rows; a field whose length the
settings decide (a letter in its shape) has its entity to itself. `docs/schema.md` is made from this.
"""

from __future__ import annotations

import colorsys
import enum
import functools
import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, get_type_hints

from pipelines.correlation.step import CorrelationStep
from pipelines.estimator import Step, quantities
from readers.streams import WorkbenchError


class Archetype(enum.StrEnum):
    """How a field is logged, and in which component its values stand."""

    TIMELINE = "timeline"
    SCALARS = "Scalars:scalars"
    INTEGERS = "Integers"
    SURFACES = "DepthImage:buffer"


@dataclass(frozen=True, slots=True)
class Row:
    """One field of a Step.

    Args:
        field: name of the field.
        entity: entity path relative to the run's root; the timeline's name for `Archetype.TIMELINE`.
        archetype: how it is logged.
        title: short name in legends, the field's name if empty.
        axes: names along the field's fixed axes, flattened.
        also: where else it can be seen.
    """

    field: str
    entity: str
    archetype: Archetype = Archetype.SCALARS
    title: str = ""
    axes: tuple[str, ...] = ()
    also: str = ""

    @property
    def component(self) -> str:
        """The component of the entity that holds the values, empty for a timeline."""
        match self.archetype:
            case Archetype.TIMELINE:
                return ""
            case Archetype.INTEGERS:
                return f"{self.archetype.value}:{self.field}"
        return self.archetype.value


class Series(NamedTuple):
    """One line of a plot: its name in legends, its colour as RGBA."""

    name: str
    colour: int


@dataclass(frozen=True)
class Schema:
    """The rows of one Step class."""

    step_type: type[Step]
    rows: tuple[Row, ...]

    @functools.cached_property
    def kinds(self) -> dict[str, Any]:
        """The declared type of each field."""
        return get_type_hints(self.step_type)

    def of(self, archetype: Archetype) -> dict[str, tuple[Row, ...]]:
        """The rows of one archetype by entity, in order."""
        groups: dict[str, tuple[Row, ...]] = {}
        for row in self.rows:
            if row.archetype is archetype:
                groups[row.entity] = (*groups.get(row.entity, ()), row)
        return groups

    def entity(self, field: str) -> str:
        """The entity of a field, relative to the run's root."""
        return next(row.entity for row in self.rows if row.field == field)

    def sharing(self, fields: Collection[str]) -> tuple[Row, ...]:
        """The rows of these fields and of all that share an entity with them."""
        entities = {(row.archetype, row.entity) for row in self.rows if row.field in fields}
        return tuple(row for row in self.rows if (row.archetype, row.entity) in entities)

    def shape(self, field: str) -> tuple[int | str, ...]:
        """The declared shape of a field; a letter stands for a length that the settings decide."""
        return tuple(quantities(self.step_type)[field]["shape"])

    def series(self, entity: str, width: int) -> list[Series]:
        """The series of a scalar entity whose rows hold `width` numbers."""
        found: list[Series] = []
        for row in self.of(Archetype.SCALARS)[entity]:
            quantity = quantities(self.step_type)[row.field]
            fixed = math.prod(n for n in quantity["shape"] if isinstance(n, int))
            free = [n for n in quantity["shape"] if isinstance(n, str)]
            axes = row.axes or tuple(map(str, range(fixed))) if fixed > 1 else ("",)
            units = _units(quantity["unit"], len(axes))
            title = row.title or row.field
            for head in [f"{title} {k + 1}" for k in range(width // fixed)] if free else [title]:
                for axis, unit in zip(axes, units, strict=True):
                    name = f"{head} {axis}".rstrip() + unit
                    found.append(Series(name, _colour(len(found), axes.index(axis), len(axes))))
        return found


def _colour(place: int, axis: int, axes: int) -> int:
    """RGBA of a series: shades of blue and orange for the two axes of a plane, else a hue of its own."""
    hue = (0.57, 0.08)[axis] if axes == 2 else 0.57 + place * 0.618
    shade = 0.45 + 0.5 * ((place // 2 * 0.382) % 1) if axes == 2 else 0.6
    rgb = colorsys.hsv_to_rgb(hue % 1, shade, 0.95)
    return sum(int(c * 255) << shift for c, shift in zip(rgb, (24, 16, 8), strict=True)) | 0xFF


def _units(unit: str, count: int) -> list[str]:
    """The unit of each of `count` axes in brackets; nothing where it is 1 or differs within a matrix."""
    parts = unit.split(", ")
    parts = parts * count if len(parts) == 1 else parts
    if len(parts) != count:
        return [""] * count
    return ["" if part == "1" else f" [{part}]" for part in parts]


_UV = ("u", "v")
_XY = ("x", "y")
_HEADING = ("x", "y", "heading")
_H2 = ("uu", "uv", "vu", "vv")
_P3 = ("xx", "xy", "xα", "yx", "yy", "yα", "αx", "αy", "αα")
_TABLE = "table in `numbers`"

CORRELATION = Schema(
    CorrelationStep,
    (
        Row("frame", "frame", Archetype.TIMELINE),
        Row("t_ns", "sensor_time", Archetype.TIMELINE),
        Row("received_ns", "received", Archetype.INTEGERS),
        Row("verdict", "outcome", also="state lane `verdict`; `events` where it changes; points of the path"),
        Row("alarms", "outcome", also="state lanes `verdicts/NAME`; lines of `alarms`"),
        Row("accepted", "outcome"),
        Row("template_frame", "outcome", title="template frame"),
        Row("dt_s", "conditions", title="dt"),
        Row("image_size_px", "conditions", title="image", axes=("width", "height")),
        Row("fragment_side_px", "conditions", title="fragment side", also="size of the boxes on the image"),
        Row("search_radius_px", "conditions", title="search radius", also="size of the boxes on the image"),
        Row("rotation_limit_rad", "conditions", title="rotation limit"),
        Row("metres_per_px", "conditions", title="W"),
        Row("height_m", "conditions", title="height"),
        Row("mean_grey", "image/grey", title="mean grey"),
        Row("gradient_energy", "image/gradient_energy", title="gradient energy"),
        Row("fragment_px", "search/fragment", axes=_UV, title="fragment", also="boxes on the image"),
        Row("predicted_shift_px", "search/predicted_shift", axes=_UV, title="predicted"),
        Row("search_centre_px", "search/centre", axes=_UV, title="centre", also="boxes on the image"),
        Row("surface", "search/surface", Archetype.SURFACES, also="fragments arranged as on the image, float16"),
        Row("peak_px", "search/peak", axes=_UV, title="peak", also="points on the surfaces"),
        Row("peak_correlation", "search/peak_correlation", title="peak", also=_TABLE),
        Row("second_peak_px", "search/second_peak", axes=_UV, title="second peak", also="points on the surfaces"),
        Row("second_peak_correlation", "search/second_peak_correlation", title="second peak"),
        Row("peak_ratio", "search/peak_ratio", title="ratio", also=_TABLE),
        Row("peak_curvature", "search/peak_curvature", title="curvature"),
        Row("peak_anisotropy", "search/peak_anisotropy", title="anisotropy"),
        Row("delta_px", "subpixel/delta", axes=_UV, title="Δ", also=_TABLE),
        Row("hessian", "subpixel/hessian", axes=_H2, title="H", also=_TABLE),
        Row("condition", "subpixel/condition", title="condition", also=_TABLE),
        Row("smallest_eigenvalue", "subpixel/smallest_eigenvalue", title="λ min"),
        Row("iterations", "subpixel/iterations", title="iterations"),
        Row("gain", "subpixel/gain", title="gain"),
        Row("offset", "subpixel/offset", title="offset"),
        Row("match_grey", "subpixel/match_grey", title="mean grey"),
        Row("gradient", "subpixel/gradient", title="gradient"),
        Row("residual_rms", "subpixel/residual_rms", title="residual", also=_TABLE),
        Row("sigma_px", "subpixel/sigma", axes=_UV, title="σ"),
        Row("shift_px", "subpixel/shift", axes=_UV, title="shift", also="arrows and boxes on the image"),
        Row("weight", "fit/weight", title="weight", also=f"colour of the boxes on the image; {_TABLE}"),
        Row("fit_residual_px", "fit/residual", axes=_UV, title="fit residual", also=_TABLE),
        Row("inliers", "fit/inliers", title="inliers"),
        Row("rigidity_px", "fit/rigidity", title="rigidity"),
        Row("scale", "fit/scale", title="scale"),
        Row("centre_shift_px", "fit/centre_shift", axes=_UV, title="from the template"),
        Row("template_rotation_rad", "fit/rotation", title="from the template"),
        Row("tile_px", "fit/tiles/centre", axes=_UV, title="tile"),
        Row("tile_shift_px", "fit/tiles/shift", axes=_UV, title="tile shift", also="points `/camera/image/RUN/tiles`"),
        Row("tile_weight", "fit/tiles/weight", title="tile weight", also="colour of these points"),
        Row("motion_covariance", "fit/covariance", axes=("uu", "uv", "uα", "vu", "vv", "vα", "αu", "αv", "αα"),
            title="motion P", also=_TABLE),
        Row("frame_shift_px", "motion/frame_shift", axes=_UV, title="since the frame before"),
        Row("delta_heading_rad", "motion/delta_heading", title="Δα"),
        Row("heading_rad", "motion/heading", title="α"),
        Row("path_step_m", "motion/increment", title="S"),
        Row("increment_m", "motion/increment", axes=_XY, title="Δ"),
        Row("segment_frames", "correction/segment_frames", title="segment frames"),
        Row("segment_sum_m", "correction/segment", title="S_Σ"),
        Row("segment_reference_m", "correction/segment", title="S_etal"),
        Row("relative_deviation", "correction/relative_deviation", title="ΔS_relate"),
        Row("deviation_m", "correction/deviation", title="ΔS_Σ"),
        Row("correction_m", "correction/applied", axes=_XY, title="correction"),
        Row("correction_total_m", "correction/applied", axes=_XY, title="total"),
        Row("pose_raw", "pose/raw", axes=_HEADING, title="raw", also="`/world/runs/RUN/raw`"),
        Row("pose", "pose/corrected", axes=_HEADING, title="corrected", also="`/world/runs/RUN/corrected`"),
        Row("pose_covariance", "pose/covariance", axes=_P3, title="pose P",
            also=f"ellipse `/world/runs/RUN/covariance`; {_TABLE}"),
    ),
)  # fmt: skip

SCHEMAS: Mapping[type[Step], Schema] = {CorrelationStep: CORRELATION}


def schema_of(step_type: type[Step]) -> Schema:
    """The schema of a Step class.

    Raises:
        WorkbenchError: the class has none.
    """
    if step_type not in SCHEMAS:
        raise WorkbenchError(f"{step_type.__name__}: no schema for the recording; add its rows to workbench/schema.py")
    return SCHEMAS[step_type]


_PREFACE = """# What is in the recording

A mission has one file of what was measured, `sensors.rrd`, and one for each run, `RUN.rrd`; equal recording
ids let one viewer show them together. Timelines: `frame` (number of the frame in its stream) and
`sensor_time` (exact nanoseconds). World: z up, x forward, y left, metres. Image: u right, v down, pixels; the
viewer puts the corner of the first pixel at (0, 0), so that drawings lie half a pixel further than the fields say.

This page is made by `python -m workbench.schema`; a test demands that it is current.

## Sensors
| Entity | What |
|---|---|
| `/camera/image` | the images: stored JPEG and PNG bytes unaltered, others as PNG or raw pixels |
| `/camera/problems` | frames without an image, and why |
| `/world/reference/path`, `/pose`, `/heading` | the reference from above: whole path, and its pose at each frame |
| `/sensors/reference` | the reference as numbers: x, y, z (m), heading (rad); on `sensor_time` |
| `/world/scale` | a scale bar |
| `/recording/facts` | facts of the recording |

## Every run
| Entity | What |
|---|---|
| `/runs/RUN/settings`, `/runs/RUN/summary` | settings, and what was found at the end |
| `/runs/RUN/ESTIMATOR/verdict`, `/verdicts/NAME` | lanes: the verdict, each alarm that ever rang (save FIRST_FRAME) |
| `/runs/RUN/ESTIMATOR/events` | log of where the verdict changed, and of what the replay met |
| `/runs/RUN/ESTIMATOR/alarms` | log of every frame with an alarm |
| `/runs/RUN/ESTIMATOR/numbers` | matrices and fragments of the frame as tables |
| `/runs/RUN/ESTIMATOR/error` | x, y, distance (m), heading (rad) against the reference |
| `/world/runs/RUN/raw`, `/corrected` | one point a frame, coloured by verdict |
| `/world/runs/RUN/body`, `/heading`, `/covariance` | where it is now, with the 3σ ellipse of the position |
| `/world/runs/RUN/path/NAME` | the whole path, raw, corrected and aligned with the reference |
| `/camera/image/RUN/fragments`, `/search`, `/matches`, `/shifts` | drawn on the image |
| `/camera/image/RUN/tiles` | where the photometric tiles were found; hidden until it is switched on |
"""


def document() -> str:
    """The text of `docs/schema.md`."""
    parts = [_PREFACE]
    for schema in SCHEMAS.values():
        parts.append(f"\n## Fields of `{schema.step_type.__name__}`\nEntities are below `/runs/RUN/ESTIMATOR`.\n\n")
        parts.append(_markdown(schema) + "\n")
    return "".join(parts)


def _markdown(schema: Schema) -> str:
    lines = [
        "| Field | Entity | Component | Shape | Unit | Meaning | Also shown as |",
        "|---|---|---|---|---|---|---|",
    ]
    declared = quantities(schema.step_type)
    for row in schema.rows:
        field = declared[row.field]
        shape = " × ".join(str(n) for n in field["shape"]) or "–"
        entity = f"timeline `{row.entity}`" if row.archetype is Archetype.TIMELINE else f"`{row.entity}`"
        component = f"`{row.component}`" if row.component else "–"
        cells = (f"`{row.field}`", entity, component, shape, field["unit"], field["meaning"], row.also)
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


if __name__ == "__main__":
    (Path(__file__).parents[1] / "docs" / "schema.md").write_text(document(), encoding="utf-8")
