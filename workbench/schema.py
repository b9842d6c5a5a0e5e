"""Where each field of a Step lies in the recording: its entity, its archetype and its series.

An entity path here is relative to the root of a run, ``/runs/RUN/ESTIMATOR``. Unit, shape and meaning
are those that the Step declares (`pipelines.estimator.quantities`) and are not repeated here. Fields
that share an entity form one group of series, in the order of the rows; a field whose length the
settings decide (a letter in its shape) has its entity to itself. Fields whose length changes from frame to
frame are lists: one row a frame of as many numbers as there are, whole numbers as such, row by row of the
field's array. `docs/schema.md` is made from this.
"""

from __future__ import annotations

import colorsys
import enum
import functools
import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, get_args, get_type_hints

import numpy as np
from numpy.typing import NDArray

from pipelines.correlation.step import CorrelationStep
from pipelines.estimator import Step, quantities
from pipelines.ranging.step import RangeStep
from pipelines.semidirect.baseline_step import BaselineStep
from pipelines.semidirect.step import Feature, SemidirectStep
from readers.streams import WorkbenchError


class Archetype(enum.StrEnum):
    """How a field is logged, and in which component its values stand."""

    TIMELINE = "timeline"
    SCALARS = "Scalars:scalars"
    INTEGERS = "Integers"
    LISTS = "Lists"
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
            case Archetype.INTEGERS | Archetype.LISTS:
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

    def of(self, archetype: Archetype) -> Mapping[str, tuple[Row, ...]]:
        """The rows of one archetype by entity, in order."""
        return self._groups.get(archetype, {})

    @functools.cached_property
    def _declared(self) -> Mapping[str, Mapping[str, Any]]:
        return quantities(self.step_type)

    @functools.cached_property
    def _groups(self) -> dict[Archetype, dict[str, tuple[Row, ...]]]:
        groups: dict[Archetype, dict[str, tuple[Row, ...]]] = {}
        for row in self.rows:
            entities = groups.setdefault(row.archetype, {})
            entities[row.entity] = (*entities.get(row.entity, ()), row)
        return groups

    def entity(self, field: str) -> str:
        """The entity of a field, relative to the run's root."""
        return next(row.entity for row in self.rows if row.field == field)

    def sharing(self, fields: Collection[str]) -> tuple[Row, ...]:
        """The rows of these fields and of all that are needed to tell them apart or their shapes."""
        wanted = {*fields, *map(self.leading, fields)}
        entities = {(row.archetype, row.entity) for row in self.rows if row.field in wanted}
        return tuple(
            row
            for row in self.rows
            if (row.archetype, row.entity) in entities and (row.archetype is not Archetype.LISTS or row.field in wanted)
        )

    @functools.cached_property
    def lists(self) -> tuple[str, ...]:
        """The fields that are lists."""
        return tuple(row.field for row in self.rows if row.archetype is Archetype.LISTS)

    def leading(self, field: str) -> str:
        """The field that is as long as a list of two open axes has rows; empty for all others."""
        shape = self.shape(field) if field in self.lists else ()
        if sum(isinstance(n, str) for n in shape) < 2:
            return ""
        return next(other for other in self.lists if self.shape(other) == shape[:1])

    def listed(self, field: str, flat: NDArray[Any], rows: int = -1) -> NDArray[Any]:
        """The numbers of a list as the field's array; `rows` is the length of its `leading` field."""
        fixed = [n for n in self.shape(field) if isinstance(n, int)]
        if not self.leading(field):
            return flat.reshape(-1, *fixed)
        return flat.reshape(rows, len(flat) // rows if rows else 0)

    def whole(self, field: str) -> bool:
        """Whether a field is an array of whole numbers."""
        inner = get_args(self.kinds[field])
        return len(inner) == 2 and get_args(inner[1]) == (np.int64,)

    def shape(self, field: str) -> tuple[int | str, ...]:
        """The declared shape of a field; a letter stands for a length that the settings decide."""
        return tuple(self._declared[field]["shape"])

    def series(self, entity: str, width: int) -> list[Series]:
        """The series of a scalar entity whose rows hold `width` numbers."""
        found: list[Series] = []
        for row in self.of(Archetype.SCALARS)[entity]:
            quantity = self._declared[row.field]
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


@functools.cache
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


def _names(kind: type[enum.IntEnum]) -> tuple[str, ...]:
    """The members of an enumeration as words, in the order of their values."""
    return tuple(member.name.lower().replace("_", " ") for member in sorted(kind))


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

_XK = ("x", "y", "ξ")
_P = tuple(f"{a}{b}" for a in _XK for b in _XK)
_XYS = ("xx", "xy", "yx", "yy")
_INPUTS = ("xω", "xV", "yω", "yV", "ξω", "ξV")
_GAIN = ("xx", "xy", "yx", "yy", "ξx", "ξy")
_SLOT = "`landmark/K/{}`".format
_IMAGE = "`/camera/image/RUN/{}`".format

RANGE = Schema(
    RangeStep,
    (
        Row("frame", "frame", Archetype.TIMELINE),
        Row("t_ns", "sensor_time", Archetype.TIMELINE),
        Row("received_ns", "received", Archetype.INTEGERS),
        Row("verdict", "outcome", also="state lane `verdict`; `events` where it changes"),
        Row("alarms", "outcome", also="state lanes `verdicts/NAME`; lines of `alarms`"),
        Row("omega_radps", "inputs/omega", title="ω", also=_TABLE),
        Row("speed_mps", "inputs/speed", title="V", also=f"path from above; {_TABLE}"),
        Row("dt_s", "inputs/dt", title="dt"),
        Row("intervals", "inputs/intervals", title="intervals"),
        Row("still", "inputs/intervals", title="stands still"),
        Row("gyro_age_s", "inputs/age", title="age of ω"),
        Row("odometer_age_s", "inputs/age", title="age of V"),
        Row("gyro_bias_radps", "inputs/gyro_bias", title="gyro bias"),
        Row("focus_px", "inputs/focus", axes=_UV, title="focus of expansion", also=f"cross {_IMAGE('focus')}"),
        Row("landmarks", "count", title="carried"),
        Row("measured", "count", title="measured"),
        Row("converged", "count", title="converged"),
        Row("landmark_id", "landmarks/id", title="number", also=f"labels on the image; {_TABLE}"),
        Row("outcome", "landmarks/outcome", also=_TABLE),
        Row("status", "landmarks/status", also=f"colours on the image and the map; {_TABLE}"),
        Row("age_frames", "landmarks/age", title="age"),
        Row("prior", "prior/state", axes=_XK, title="X⁻", also=f"crosses {_IMAGE('predicted')}"),
        Row("prior_covariance", "prior/covariance", axes=_P, title="P⁻"),
        Row("transition", "prior/transition", axes=_P, title="A"),
        Row("noise_gain", "prior/noise_gain", axes=_INPUTS, title="G"),
        Row("measured_px", "update/measured", axes=_UV, title="z", also=f"points {_IMAGE('measured')}"),
        Row("innovation_px", "update/innovation", axes=_UV, title="ν",
            also=f"{_SLOT('innovation')}; arrows {_IMAGE('innovation')}"),
        Row("innovation_covariance", "update/innovation_covariance", axes=_XYS, title="S",
            also=f"ellipses {_IMAGE('gate')}: the gate, χ² = 13.8; {_TABLE}"),
        Row("gain", "update/gain", axes=_GAIN, title="K", also=f"{_SLOT('gain')}; {_TABLE}"),
        Row("nis", "update/nis", title="NIS", also=f"{_SLOT('nis')}; {_TABLE}"),
        Row("log_likelihood", "update/log_likelihood", title="log likelihood"),
        Row("rejections", "update/rejections", title="rejections in a row"),
        Row("mean", "posterior/state", axes=_XK, title="X", also=f"ξ: {_SLOT('xi')}; {_TABLE}"),
        Row("covariance", "posterior/covariance", axes=_P, title="P", also=f"as σ: {_SLOT('sigma')}; {_TABLE}"),
        Row("range_m", "range/range", title="Z",
            also=f"{_SLOT('range')}; {_IMAGE('ranges')}; points from above; {_TABLE}"),
        Row("range_interval_m", "range/interval", axes=("nearest", "farthest"), title="Z",
            also=f"{_SLOT('range')}; rays from above; {_TABLE}"),
        Row("relative_sigma", "range/relative_sigma", title="σ_ξ/ξ", also=f"{_SLOT('relative_sigma')}; {_TABLE}"),
        Row("parallax_px", "range/parallax", title="parallax", also=f"{_SLOT('parallax')}"),
        Row("derotated_parallax_px", "range/derotated_parallax", title="derotated", also=f"{_SLOT('parallax')}"),
        Row("focus_distance_px", "range/focus_distance", title="to the focus", also=f"{_SLOT('parallax')}"),
    ),
)  # fmt: skip

_XYZ = ("x", "y", "z")
_QUAT = ("qx", "qy", "qz", "qw")
_TWIST = ("x", "y", "z", "rx", "ry", "rz")
_FILTER_OUTCOMES = ("updated", "no match", "converged", "diverged", "unseen", "given up")
"""As `depth_filter.Outcome`, which comes with compiled code, and one more."""
_STAGES = ("pyramid", "alignment", "features and pose", "start or search", "mapping")
_BUNDLES = ("local", "global")
_STATES = "points `/camera/image/RUN/{}`".format
_MAP = "`/world/runs/RUN/map/{}`".format
_LIST = Archetype.LISTS

VISUAL: tuple[Row, ...] = (
    Row("frame", "frame", Archetype.TIMELINE),
    Row("t_ns", "sensor_time", Archetype.TIMELINE),
    Row("received_ns", "received", Archetype.INTEGERS),
    Row("verdict", "outcome", also="state lane `verdict`; `events` where it changes; points of the path"),
    Row("alarms", "outcome", also="state lanes `verdicts/NAME`; lines of `alarms`"),
    Row("accepted", "outcome"),
    Row("stage", "outcome", also=f"state lane `stage`; {_TABLE}"),
    Row("dt_s", "conditions", title="dt"),
    Row("image_size_px", "conditions", title="image", axes=("width", "height")),
    Row("position_m", "pose/position", axes=_XYZ, title="camera", also="`/world/runs/RUN/camera`, `/corrected`"),
    Row("quat_xyzw", "pose/rotation", axes=_QUAT, title="rotation", also="`/world/runs/RUN/camera`"),
    Row("pose", "pose/plane", axes=_HEADING, title="pose", also="`/world/runs/RUN/above`"),
    Row("increment_m", "motion/increment", axes=_XY, title="Δ"),
    Row("path_step_m", "motion/increment", title="S"),
    Row("delta_heading_rad", "motion/delta_heading", title="Δα"),
    Row("pose_sigma", "pose/sigma", axes=_TWIST, title="σ"),
    Row("map_number", "map/number", title="map"),
    Row("relocalised_frames", "map/number", title="frames since the relocalisation"),
    Row("tracked", "tracked", also=_TABLE),
    Row("keyframe", "keyframe/made", title="keyframe"),
    Row("keyframes", "map/size", title="keyframes"),
    Row("map_points", "map/size", title="points"),
    Row("scene_depth_m", "map/scene_depth", title="scene depth"),
    Row("scale_known", "scale/known", title="scale known", also="lengths are metres, or units of the first map"),
    Row("metres_per_unit", "scale/metres_per_unit", title="metres per unit", also=_TABLE),
    Row("metres_per_unit_sigma", "scale/metres_per_unit", title="σ of it"),
    Row("point_id", "features/points", _LIST),
    Row("predicted_px", "features/points", _LIST, also=_STATES("predicted")),
    Row("found_px", "features/points", _LIST, also=_STATES("features")),
    Row("level", "features/points", _LIST, also="size of the points on the image"),
    Row("outcome", "features/points", _LIST, also="colour of the points on the image"),
    Row("error_px", "features/points", _LIST, also="`features/error`: median and largest"),
    Row("keyframe_number", "map/keyframes", _LIST, also=_MAP("keyframes")),
    Row("keyframe_position_m", "map/keyframes", _LIST, also=_MAP("keyframes")),
    Row("keyframe_quat_xyzw", "map/keyframes", _LIST, also=_MAP("keyframes")),
    Row("map_id", "map/points", _LIST),
    Row("map_point_m", "map/points", _LIST, also=_MAP("points")),
    Row("map_point_sigma_m", "map/points", _LIST, also=_MAP("sigma")),
    Row("map_point_views", "map/points", _LIST),
)

_BEGINNINGS: tuple[Row, ...] = (
    Row("start_matches", "start/matches", title="corners"),
    Row("start_motion_px", "start/motion", title="motion"),
    Row("start_parallax_px", "start/motion", title="parallax"),
    Row("relocalise_keyframe", "relocalisation/keyframe", title="keyframe"),
    Row("relocalise_correlation", "relocalisation/correlation", title="correlation"),
)

SEMIDIRECT = Schema(
    SemidirectStep,
    (
        *VISUAL,
        Row("map_point_covariance", "map/points", _LIST, also=_MAP("covariance")),
        Row("mean_grey", "image/grey", title="mean grey"),
        Row("sharpness", "image/sharpness", title="sharpness"),
        Row("prior_position_m", "prior/position", axes=_XYZ, title="prior"),
        Row("prior_quat_xyzw", "prior/rotation", axes=_QUAT, title="prior"),
        Row("align_cost", "alignment/cost", _LIST, also="`alignment/level`: before and after, of each level"),
        Row("align_iterations", "alignment/level_work", _LIST, also="`alignment/iterations`"),
        Row("align_stop", "alignment/level_work", _LIST, also=_TABLE),
        Row("align_final_cost", "alignment/final_cost", title="cost"),
        Row("align_gain", "alignment/illumination", title="gain"),
        Row("align_offset", "alignment/offset", title="offset"),
        Row("align_patches", "alignment/patch_count", title="patches"),
        Row("align_inliers", "alignment/patch_count", title="inliers"),
        Row("align_sigma", "alignment/sigma", axes=_TWIST, title="σ"),
        Row("align_px", "alignment/patches", _LIST, also=_STATES("patches")),
        Row("align_residual", "alignment/patches", _LIST, also="colour of these points"),
        Row("aligned_position_m", "alignment/position", axes=_XYZ, title="aligned"),
        Row("point_state", "features/points", _LIST, also="shade of the points on the image"),
        Row("residual_rms", "features/points", _LIST),
        Row("correlation", "features/points", _LIST),
        Row("iterations", "features/points", _LIST),
        Row("outcome_count", "features/count", axes=_names(Feature), title="points"),
        Row("pose_cost", "refinement/cost", _LIST, also=_TABLE),
        Row("pose_iterations", "refinement/iterations", title="iterations"),
        Row("pose_scale_px", "refinement/error", title="scale"),
        Row("error_before_px", "refinement/error", title="before"),
        Row("error_after_px", "refinement/error", title="after"),
        Row("pose_covariance", "refinement/covariance", axes=tuple(f"{a},{b}" for a in _TWIST for b in _TWIST),
            title="P"),
        Row("keyframe_distance", "keyframe/distance", title="distance / depth"),
        Row("keyframe_removed", "keyframe/removed", title="removed"),
        Row("keyframe_points", "keyframe/points", title="points"),
        Row("points_refined", "structure/refined", title="refined"),
        Row("points_added", "structure/changed", title="added"),
        Row("points_removed", "structure/changed", axes=("with keyframe", "not found", "outlier"), title="removed"),
        Row("bundle_cost", "bundle/cost", _LIST, also=_TABLE),
        Row("bundle_iterations", "bundle/iterations", title="iterations"),
        Row("bundle_keyframes", "bundle/size", title="keyframes"),
        Row("bundle_points", "bundle/size", title="points"),
        Row("bundle_outliers", "bundle/size", title="outliers"),
        Row("filters", "filters/number", title="filters"),
        Row("filter_count", "filters/count", axes=_FILTER_OUTCOMES, title="filters"),
        Row("filter_id", "filters/each", _LIST),
        Row("filter_keyframe", "filters/each", _LIST),
        Row("filter_px", "filters/each", _LIST),
        Row("filter_mu", "filters/each", _LIST, also="`filters/shown/K/depth`"),
        Row("filter_sigma", "filters/each", _LIST, also="`filters/shown/K/depth`"),
        Row("filter_range", "filters/each", _LIST),
        Row("filter_ratio", "filters/each", _LIST, also="`filters/shown/K/ratio`"),
        Row("filter_age", "filters/each", _LIST),
        Row("filter_outcome", "filters/each", _LIST, also="colour of the epipolar segments"),
        Row("filter_match", "filters/each", _LIST),
        Row("filter_inlier", "filters/each", _LIST, also="`filters/shown/K/ratio`"),
        Row("epipolar_px", "filters/each", _LIST, also="segments `/camera/image/RUN/epipolar`"),
        Row("filter_found_px", "filters/each", _LIST, also=_STATES("filters")),
        *_BEGINNINGS,
        Row("height_m", "scale/height", title="sensor", also=_TABLE),
        Row("map_height_m", "scale/height", title="map", also=_TABLE),
        Row("stage_ms", "work/stages", axes=_STAGES, title="time of"),
    ),
)  # fmt: skip

BASELINE = Schema(
    BaselineStep,
    (
        *VISUAL,
        Row("prior_position_m", "prior/position", axes=_XYZ, title="prior"),
        Row("corners", "tracking/corners", title="corners"),
        Row("coarse_tried", "tracking/coarse", title="tried"),
        Row("coarse_found", "tracking/coarse", title="found"),
        Row("coarse_position_m", "tracking/coarse_position", axes=_XYZ, title="coarse"),
        Row("score", "features/points", _LIST),
        Row("pose_scale_px", "tracking/scale", title="scale"),
        Row("keyframe_distance", "keyframe/distance", title="distance / depth"),
        Row("points_added", "structure/changed", title="added"),
        Row("points_removed", "structure/changed", title="removed"),
        Row("bundle_keyframes", "bundle/size", axes=_BUNDLES, title="keyframes"),
        Row("bundle_iterations", "bundle/iterations", axes=_BUNDLES, title="iterations"),
        Row("bundle_cost", "bundle/cost", axes=("local before", "local after", "global before", "global after"),
            title="cost"),
        Row("bundle_outliers", "bundle/outliers", axes=_BUNDLES, title="outliers"),
        *_BEGINNINGS,
        Row("stage_ms", "work/stages", axes=("pyramid and corners", "tracking", "mapping"), title="time of"),
    ),
)  # fmt: skip

CLOCKED = frozenset({"stage_ms"})
"""Fields that the machine's clock tells: no replay repeats them."""

SCHEMAS: Mapping[type[Step], Schema] = {
    CorrelationStep: CORRELATION,
    RangeStep: RANGE,
    SemidirectStep: SEMIDIRECT,
    BaselineStep: BASELINE,
}


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
| `/sensors/streams/STREAM` | the samples that the estimator got, by stream; on `sensor_time`, of frames on both |
| `/sensors/clocks/STREAM` | log time less header stamp (ms), of messages that have both: latency and jitter |
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

## Every run of the range filter
Slot K is the place of a landmark in the arrays of a Step, from 1; the entities `landmark/K` repeat what is plotted
of it, one entity per plot, for the first 24 slots. `reference` is what surveyed landmarks and a reference pose, a
board, or measured ranges say; it is computed beside the estimator, which never sees it.

| Entity | What |
|---|---|
| `/runs/RUN/range/landmark/K/range` | Z, nearest and farthest (ξ ± 2 σ_ξ), reference (m) |
| `/runs/RUN/range/landmark/K/xi` | ξ, ξ - 2σ, ξ + 2σ, reference (1/m) |
| `/runs/RUN/range/landmark/K/sigma`, `/relative_sigma` | σ_x, σ_y (px); σ_ξ/ξ |
| `/runs/RUN/range/landmark/K/innovation` | ν_x, ν_y, ± 2 √S_xx, ± 2 √S_yy (px) |
| `/runs/RUN/range/landmark/K/nis` | NIS |
| `/runs/RUN/range/landmark/K/gain` | K: of x and y (1), of ξ (1/m/px) |
| `/runs/RUN/range/landmark/K/parallax` | parallax, derotated parallax, distance to the focus of expansion (px) |
| `/runs/RUN/range/bounds/nis` | 5.99 (95 % of χ² with 2 degrees of freedom), 13.8 (99.9 %, the gate) |
| `/runs/RUN/range/reference` | reference depth of every slot (m) |
| `/runs/RUN/range/smoothed/K/range` | with `--smooth`: smoothed Z, nearest and farthest (ξ ± 2 σ_ξ) (m); every slot |
| `/runs/RUN/range/smoothed/K/state`, `/covariance` | smoothed x, y, ξ (px, px, 1/m) and their P, row by row |
| `/camera/image/RUN/measured`, `/predicted`, `/innovation`, `/gate`, `/focus` | drawn on the image |
| `/camera/image/RUN/ranges` | the landmarks coloured by their range, red near, blue far |
| `/world/runs/RUN/camera`, `/camera/path` | where the camera is: reference, else dead reckoned |
| `/world/runs/RUN/landmarks/points`, `/rays`, `/ellipses` | the landmarks from above, with their intervals and 2σ |
| `/world/runs/RUN/landmarks/surveyed` | where they are, if that is known |

## Every run of visual odometry
Entities on the image and in the world stand once a frame, those of the map where it changed. Numbers in lists
(`Lists`) are one row a frame, as many as there are; `workbench.rrd.read_fields` gives them back as arrays. `filters/…`
and the patches are of the semi-direct odometry. A slot of `filters/shown` follows one filter from its start to its
end, then the next one that starts.

| Entity | What |
|---|---|
| `/runs/RUN/ESTIMATOR/stage` | lane: starting, tracked, lost, … |
| `/runs/RUN/ESTIMATOR/features/error` | median and 90 % quantile of the reprojection error (px of the level) |
| `/runs/RUN/ESTIMATOR/alignment/level`, `/iterations` | cost before and after (grey²), and iterations, of each level |
| `/runs/RUN/ESTIMATOR/prior/correction` | way from the prior to the aligned position, and to the final one (m) |
| `/runs/RUN/ESTIMATOR/untimed` | how the stages' times are asked for; shown where they were not |
| `/runs/RUN/ESTIMATOR/filters/spread` | medians over the filters of σ/z_range and of a/(a+b) |
| `/runs/RUN/ESTIMATOR/filters/shown/K/depth` | μ, μ ± σ (1/m) of the filter that slot K follows, 1 to 8 |
| `/runs/RUN/ESTIMATOR/filters/shown/K/ratio`, `/number` | its a/(a+b) and C1; its number |
| `/runs/RUN/ESTIMATOR/filters/diverged/ID/…` | the same of the first 16 filters that diverged, 300 frames back |
| `/camera/image/RUN/features`, `/missed` | points where they were found, or expected and not found, by outcome |
| `/camera/image/RUN/predicted` | where the map's points were expected |
| `/camera/image/RUN/patches` | patches of the alignment in the frame before, red from a residual of 20 grey |
| `/camera/image/RUN/epipolar`, `/filters` | segments that were searched, and what was found there, by outcome |
| `/world/runs/RUN/camera` | the camera with its view |
| `/world/runs/RUN/corrected`, `/path/corrected` | one point a frame; the whole path in space |
| `/world/runs/RUN/path/reference` | the reference laid over it by Sim(3) |
| `/world/runs/RUN/above/path`, `/body`, `/heading` | the path seen from above |
| `/world/runs/RUN/map/points` | the map's points, green where σ is 0.1 % of the scene's depth, red at 10 % |
| `/world/runs/RUN/map/sigma` | the same as balls of radius σ, in a tab of its own for the baseline |
| `/world/runs/RUN/map/covariance` | the same as ellipsoids of one standard deviation (semidirect) |
| `/world/runs/RUN/map/keyframes`, `/plane` | frusta of the keyframes; z = 0, the first map's plane, as a grid |
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
