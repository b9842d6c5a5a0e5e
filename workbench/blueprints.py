"""One saved view per estimator: what a viewer shows of a run without any hand work."""

from __future__ import annotations

import colorsys
import functools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from pipelines.correlation.step import CorrelationStep
from pipelines.estimator import Step
from pipelines.ranging.step import RangeStep
from pipelines.semidirect.step import SemidirectStep, VisualStep

FIELD_OF_VIEW = math.radians(55)
"""Of the viewer's eye, from top to bottom."""
ASPECT = 1.35
"""Width over height of the map, at least."""
MARGIN = 1.3
FOLLOWED_SHOWN = 4
"""Depth filters whose course the view shows side by side."""
MOST_LANES = 3
"""Lanes of verdicts that stand side by side."""


@dataclass(frozen=True, slots=True)
class Extent:
    """A rectangle on the ground: centre (x, y), width along x and height along y in metres."""

    x_m: float
    y_m: float
    width_m: float
    height_m: float

    @classmethod
    def of(cls, points: NDArray[np.float64]) -> Extent:
        """The rectangle around points [n, 2]; 1 m where they do not tell."""
        finite = points[np.isfinite(points).all(axis=1)]
        if not len(finite):
            return cls(0.0, 0.0, 1.0, 1.0)
        low, high = finite.min(axis=0), finite.max(axis=0)
        (x, y), (width, height) = ((low + high) / 2).tolist(), (high - low).tolist()
        return cls(x, y, width, height) if width or height else cls(x, y, 1.0, 1.0)

    @property
    def corners(self) -> NDArray[np.float64]:
        """Two opposite corners [2, 2]."""
        x, y = self.width_m / 2, self.height_m / 2
        return np.array([[self.x_m - x, self.y_m - y], [self.x_m + x, self.y_m + y]])

    @property
    def size_m(self) -> float:
        """The longer side."""
        return max(self.width_m, self.height_m)

    @property
    def eye_m(self) -> float:
        """How high the eye must be to see it all, with a margin and a scale bar below."""
        return MARGIN * max(self.height_m, self.width_m / ASPECT) / (2 * math.tan(FIELD_OF_VIEW / 2))

    def bar(self) -> tuple[float, tuple[float, float]]:
        """A round length of at most a quarter of the longer side, and where a scale bar of it begins (x, y)."""
        power = 10.0 ** math.floor(math.log10(self.size_m / 4))
        length = next(n * power for n in (5, 2, 1) if n * power <= self.size_m / 4)
        below = self.y_m - self.height_m / 2 - 0.07 * max(self.height_m, self.width_m / ASPECT)
        return length, (self.x_m - self.width_m / 2, below)


@dataclass(frozen=True, slots=True)
class Bounds:
    """What a view is to show in full; the viewer chooses where something is None.

    Attributes:
        frames: first and last frame, for the axes of the plots.
        extent: the square on the ground, for the map.
        image_px: width and height of the image.
        surfaces_px: width and height of the mosaic of correlation surfaces.
        landmarks: of the range filter: slot, name, and upper end of the plot of ranges in m (0: the viewer's choice).
        smoothed: slots, from 1, of which there are smoothed ranges.
        height_m: of the highest camera over the ground, for views in space.
        silent: entities, relative to the run's root, whose numbers are all 0 or missing: their plots would be empty.
        slowest_ms: upper end of the plot of times (0: the viewer's choice).
    """

    frames: tuple[int, int] | None = None
    extent: Extent | None = None
    image_px: tuple[float, float] | None = None
    surfaces_px: tuple[float, float] | None = None
    landmarks: tuple[tuple[int, str, float], ...] = ()
    smoothed: frozenset[int] = frozenset()
    height_m: float = 0.0
    silent: frozenset[str] = frozenset()
    slowest_ms: float = 0.0


def sensor_blueprint(bounds: Bounds) -> rrb.Blueprint:
    """The view of a mission's sensors alone: image, reference from above, facts."""
    return rrb.Blueprint(
        rrb.Horizontal(
            _image("/camera/image", bounds.image_px, "Image"),
            rrb.Vertical(
                _map("", bounds.extent),
                rrb.Tabs(rrb.TextDocumentView(origin="/recording/facts", name="Recording"), _lags(bounds.frames)),
                row_shares=[3, 2],
            ),
        ),
        *_panels(),
        auto_views=False,
    )


def blueprint_of(step_type: type[Step], run: str, estimator: str, bounds: Bounds) -> rrb.Blueprint:
    """The view of a run of the estimator that makes these steps; plain where there is none of its own."""
    if issubclass(step_type, CorrelationStep):
        return correlation_blueprint(run, estimator, bounds)
    if issubclass(step_type, RangeStep):
        return range_blueprint(run, estimator, bounds)
    if issubclass(step_type, VisualStep):
        return visual_blueprint(step_type, run, estimator, bounds)
    return rrb.Blueprint(*_panels(), auto_views=True, auto_layout=True)


def compare_blueprint(
    runs: Sequence[str], estimator: str, extent: Extent | None, frames: tuple[int, int], *, path_runs: bool
) -> rrb.Blueprint:
    """Several runs of one mission: image and map above; differences, errors and verdicts of all below."""
    titles = (
        {"distance": "Distance from the first run, m", "heading": "Heading from the first run, rad"}
        if path_runs
        else {"largest": "Largest relative difference of a range", "median": "Median relative difference"}
    )
    plots = [
        rrb.TimeSeriesView(origin=f"/compare/{name}", name=title, axis_x=_axis(frames))
        for name, title in titles.items()
    ]
    errors = [
        rrb.TimeSeriesView(
            origin=f"/runs/{run}/{estimator}/error", contents="$origin", name=f"Errors of {run}", axis_x=_axis(frames)
        )
        for run in (runs if path_runs else ())
    ]
    lanes = [
        rrb.StateTimelineView(
            origin=f"/runs/{run}/{estimator}",
            contents=[f"/runs/{run}/{estimator}/verdict"],
            name=f"Verdicts of {run}",
            time_view=_axis(frames),
        )
        for run in runs
    ]
    contents = ["/world/compare/**", "/world/reference/**", "/world/scale"] if path_runs else ["/world/**"]
    name = "Map: reference green, each run in its colour" if path_runs else "Map"
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(
                _image("/camera/image", None, "Image with the marks of all runs"),
                _map("", extent, name, contents=contents),
            ),
            rrb.Horizontal(*plots, *([rrb.Tabs(*errors)] if errors else [])),
            rrb.Horizontal(*lanes) if len(lanes) <= MOST_LANES else rrb.Tabs(*lanes),
            row_shares=[10, 8, 4],
        ),
        *_panels(),
        auto_views=False,
    )


def correlation_blueprint(run: str, estimator: str = "correlation", bounds: Bounds | None = None) -> rrb.Blueprint:
    """Image, surfaces and map above; plots, tables and events in the middle; verdicts at the foot."""
    bounds = bounds or Bounds()
    root = f"/runs/{run}/{estimator}"
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(
                _image("/camera/image", bounds.image_px, "Image: fragments, search areas, matches",
                       contents=["/camera/image", f"/camera/image/{run}/**"], hidden=[f"/camera/image/{run}/tiles"]),
                _image(f"{root}/search/surface", bounds.surfaces_px, "Correlation surfaces"),
                _map(run, bounds.extent),
            ),
            rrb.Horizontal(_plots(root, bounds.frames), _texts(run, root, _lags(bounds.frames)), column_shares=[3, 2]),
            rrb.StateTimelineView(origin=root, contents=[f"{root}/verdict", f"{root}/verdicts/**"], name="Verdicts",
                                  time_view=_axis(bounds.frames)),
            row_shares=[10, 8, 7],
        ),
        *_panels(),
        auto_views=False,
    )  # fmt: skip


def range_blueprint(run: str, estimator: str = "range", bounds: Bounds | None = None) -> rrb.Blueprint:
    """Image and map at the left, plots of all landmarks or of one at the right; verdicts and texts at the foot."""
    bounds = bounds or Bounds()
    root, image = f"/runs/{run}/{estimator}", f"/camera/image/{run}"
    drawn = ["/camera/image", *(f"{image}/{name}" for name in _ON_IMAGE)]
    ranged = ["/camera/image", f"{image}/frame", f"{image}/ranges"]
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(
                rrb.Vertical(
                    rrb.Tabs(
                        _image("/camera/image", bounds.image_px, "Image: measured, predicted (white), gate, focus",
                               contents=drawn),
                        _image("/camera/image", bounds.image_px, "Ranges: 0.5 m red to 50 m blue", contents=ranged),
                    ),
                    _map(run, bounds.extent, "Map: camera blue, surveyed white, landmarks by status", ()),
                ),
                _landmark_plots(root, bounds),
                column_shares=[2, 3],
            ),
            rrb.Horizontal(
                rrb.StateTimelineView(origin=root, contents=[f"{root}/verdict", f"{root}/verdicts/**"],
                                      name="Verdicts", time_view=_axis(bounds.frames)),
                _texts(run, root, rrb.TextDocumentView(origin=f"{root}/slots", name="Slots"), _lags(bounds.frames)),
                column_shares=[2, 3],
            ),
            row_shares=[18, 7],
        ),
        *_panels(),
        auto_views=False,
    )  # fmt: skip


_ON_IMAGE = ("frame", "measured", "predicted", "innovation", "gate", "labels", "focus")
_ONE = (  # of one landmark: entity, name
    ("range", "Range Z with ξ ± 2σ, reference green, m"),
    ("nis", "NIS; 5.99 and 13.8 of χ²"),
    ("xi", "Inverse depth ξ ± 2σ, 1/m"),
    ("innovation", "Innovation ν (x blue, y orange) ± 2 √S, px"),
    ("relative_sigma", "σ_ξ/ξ"),
    ("sigma", "σ of x (blue) and y, px"),
    ("parallax", "Parallax: derotated blue, raw grey; to the focus orange, px"),
    ("gain", "Gain K (xx blue, yy orange, ξx green, ξy red)"),
)


def _lags(frames: tuple[int, int] | None) -> rrb.TimeSeriesView:
    """How late log time is after the stamps of each stream; of others than the frames by `sensor_time`."""
    name = "Log time after stamp, ms"
    return rrb.TimeSeriesView(origin="/sensors/clocks", contents="$origin/**", name=name, axis_x=_axis(frames))


def _landmark_plots(root: str, bounds: Bounds) -> rrb.Tabs:
    """A tab for all landmarks, and one for each."""

    def plot(
        name: str, contents: Sequence[str], *, top: float = 0.0, overrides: Mapping[Any, Any] | None = None
    ) -> rrb.TimeSeriesView:
        return rrb.TimeSeriesView(
            origin=root,
            contents=list(contents),
            name=name,
            axis_x=_axis(bounds.frames),
            axis_y=rrb.ScalarAxis(range=(0.0, top), zoom_lock=False) if top > 0 else None,
            overrides=dict(overrides or {}),
            plot_legend=rrb.PlotLegend(visible=False),
        )

    def every(title: str, entity: str, *more: str, top: float = 0.0, show: Sequence[bool] = (True,)) -> Any:
        """One series of each landmark, in the landmark's colour."""
        entities = {f"{root}/landmark/{slot}/{entity}": _slot_colour(slot) for slot, _, _ in bounds.landmarks}
        looks = {
            path: rr.SeriesLines.from_fields(visible_series=list(show), colors=np.full(len(show), colour, np.uint32))
            for path, colour in entities.items()
        }
        return plot(title, [*entities, *more], top=top, overrides=looks)

    def beside(slot: int, entity: str) -> list[str]:
        """What the plot of one landmark shows besides."""
        if entity == "range" and slot in bounds.smoothed:
            return [f"{root}/smoothed/{slot}/range"]
        return [chi2] if entity == "nis" else []

    chi2 = f"{root}/bounds/nis"
    highest = max((top for _, _, top in bounds.landmarks), default=0.0)
    all_of_them = rrb.Grid(
        every("Ranges Z, m", "range", top=highest, show=[True, False, False, False]),
        every("NIS; 5.99 and 13.8 of χ²", "nis", chi2, top=4 * 5.99),
        every("σ_ξ/ξ", "relative_sigma", top=0.5),
        every("Derotated parallax, px", "parallax", show=[False, True, False]),
        plot("Landmarks: carried, measured, converged", [f"{root}/count"]),
        plot("ω, rad/s, and V, m/s", [f"{root}/inputs/omega", f"{root}/inputs/speed"]),
        grid_columns=2,
        name="All",
    )
    tabs = [
        rrb.Grid(
            *(
                plot(
                    title + (", smoothed purple" if entity == "range" and slot in bounds.smoothed else ""),
                    [f"{root}/landmark/{slot}/{entity}", *beside(slot, entity)],
                    top={"range": top, "nis": 4 * 5.99, "relative_sigma": 0.5}.get(entity, 0.0),
                )
                for entity, title in _ONE
            ),
            grid_columns=2,
            name=name,
        )
        for slot, name, top in bounds.landmarks
    ]
    return rrb.Tabs(all_of_them, *tabs, active_tab=1 if tabs else 0)


def _slot_colour(slot: int) -> int:
    """RGBA of a landmark's slot, hues by the golden section."""
    rgb = colorsys.hsv_to_rgb((0.57 + slot * 0.618) % 1, 0.6, 0.95)
    return sum(int(c * 255) << shift for c, shift in zip(rgb, (24, 16, 8), strict=True)) | 0xFF


def visual_blueprint(step_type: type[Step], run: str, estimator: str, bounds: Bounds | None = None) -> rrb.Blueprint:
    """Image and map above; plots and texts in the middle; lanes of verdicts and stages at the foot."""
    bounds = bounds or Bounds()
    root, image = f"/runs/{run}/{estimator}", f"/camera/image/{run}"
    semidirect = issubclass(step_type, SemidirectStep)
    pictures: dict[str, tuple[str, ...]] = {
        "Image: matched green, failed by cause, predicted white": ("predicted", "features", "missed")
    }
    if semidirect:
        pictures["Filters: epipolar segments by outcome"] = ("epipolar", "filters")
        pictures["Alignment: patches, green to red by residual"] = ("patches",)
    images = [
        _image("/camera/image", bounds.image_px, name, contents=["/camera/image", *(f"{image}/{one}" for one in drawn)])
        for name, drawn in pictures.items()
    ]
    lanes = [f"{root}/verdict", f"{root}/stage", f"{root}/verdicts/**"]
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(rrb.Tabs(*images), _visual_maps(run, bounds, semidirect=semidirect), column_shares=[5, 6]),
            rrb.Horizontal(
                _visual_plots(root, bounds, semidirect=semidirect),
                _texts(run, root, _lags(bounds.frames)),
                column_shares=[3, 2],
            ),
            rrb.StateTimelineView(origin=root, contents=lanes, name="Verdicts", time_view=_axis(bounds.frames)),
            row_shares=[10, 8, 5],
        ),
        *_panels(),
        auto_views=False,
    )


def _visual_maps(run: str, bounds: Bounds, *, semidirect: bool) -> rrb.Tabs:
    """The map in space, with the reference laid over the path, and from above, with the reference as it is."""
    world = f"/world/runs/{run}"
    eye = None
    if bounds.extent is not None:
        reach = bounds.extent.size_m + 2 * bounds.height_m
        eye = rrb.EyeControls3D(
            position=(bounds.extent.x_m - 0.25 * reach, bounds.extent.y_m - 0.55 * reach, 0.5 * reach),
            look_target=(bounds.extent.x_m, bounds.extent.y_m, bounds.height_m / 2),
            eye_up=(0.0, 0.0, 1.0),
        )

    def space(name: str, hidden: Sequence[str]) -> rrb.Spatial3DView:
        unseen: dict[Any, Any] = {f"{world}/map/{one}": rrb.EntityBehavior(visible=False) for one in hidden}
        return rrb.Spatial3DView(
            origin="/world",
            contents=[f"{world}/**", f"- {world}/above/**", "/world/scale"],
            name=name,
            eye_controls=eye,
            overrides=unseen,
            background=[18, 20, 24],
        )

    above = _map(
        run, bounds.extent, "Map: path blue, reference green", ("above/path",),
        ["/world/reference/**", "/world/scale", *(f"{world}/{one}" for one in _FROM_ABOVE)],
    )  # fmt: skip
    points = space("Space: points by σ, keyframes orange, reference green", ("sigma", "covariance"))
    uncertain = (
        space("Covariances of the points, 1σ", ("sigma", "points"))
        if semidirect
        else space("σ of the points as balls", ("points",))
    )
    return rrb.Tabs(points, above, uncertain)


class _Plot(NamedTuple):
    """One plot: its title, its entity, and which of the entity's series it shows, all of them if empty."""

    title: str
    entity: str
    show: tuple[bool, ...] = ()


_FROM_ABOVE = ("above/**", "map/points")
_FILTERS = "One filter"
_TIMES = "Times"
_VISUAL_PLOTS: Mapping[str, Sequence[_Plot]] = {
    "Tracking": (
        _Plot("Points that agree", "tracked"),
        _Plot("Reprojection error, px", "features/error"),
        _Plot("Map; since found again", "map/number"),
    ),
    "Map": (
        _Plot("Points", "map/size", (False, True)),
        _Plot("Keyframes", "map/size", (True, False)),
        _Plot("Median depth of the scene", "map/scene_depth"),
    ),
    "Scale": (_Plot("Metres a unit of the first map", "scale/metres_per_unit"),),
    "Pose": (_Plot("Camera in the world", "pose/position"), _Plot("Standard deviations", "pose/sigma")),
}
_BEGINNINGS = (
    _Plot("Corners followed since the first view", "start/matches"),
    _Plot("Their way, and what no turn explains", "start/motion"),
    _Plot("Lost: likeness of the keyframe tried", "relocalisation/correlation"),
)
_BASELINE_PLOTS: Mapping[str, Sequence[_Plot]] = {
    "Search": (
        _Plot("Corners of the frame", "tracking/corners"),
        _Plot("Coarse step: points tried and found", "tracking/coarse"),
    ),
    "Keyframes": (
        _Plot("Distance to the nearest / depth", "keyframe/distance"),
        _Plot("Points added and removed", "structure/changed"),
        _Plot("Bundle: cost, px²", "bundle/cost"),
    ),
    "Start, lost": _BEGINNINGS,
    _TIMES: (_Plot("Time of the stages, ms", "work/stages"),),
}
_SEMIDIRECT_PLOTS: Mapping[str, Sequence[_Plot]] = {
    "Prior": (
        _Plot("How far the prior was off, m", "prior/correction"),
        _Plot("Standard deviations of the alignment", "alignment/sigma"),
    ),
    "Alignment": (
        _Plot("Cost, grey²", "alignment/level"),
        _Plot("Iterations by level", "alignment/iterations"),
        _Plot("Patches and inliers", "alignment/patch_count"),
    ),
    "Refinement": (
        _Plot("Error and its scale, px", "refinement/error"),
        _Plot("Points found", "features/count", (True, *[False] * 8)),
        _Plot("Points not found, by cause", "features/count", (False, *[True] * 8)),
    ),
    "Keyframes": (
        _Plot("Distance to the nearest / depth", "keyframe/distance"),
        _Plot("Points added and removed", "structure/changed"),
        _Plot("Bundle", "bundle/size"),
    ),
    _FILTERS: (),
    "Filters": (
        _Plot("By outcome", "filters/count"),
        _Plot("At work", "filters/number"),
        _Plot("Median σ/z_range", "filters/spread", (True, False)),
        _Plot("Median a/(a+b)", "filters/spread", (False, True)),
    ),
    "Image": (_Plot("Mean grey level", "image/grey"), _Plot("Sharpness", "image/sharpness")),
    "Height": (_Plot("Height: sensor, and over the map, m", "scale/height"),),
    "Start, lost": _BEGINNINGS,
    _TIMES: (_Plot("Time of the stages, ms", "work/stages"),),
}
_ERRORS = (
    _Plot("Position error, m (x blue, y orange, distance white)", "error", (True, True, True, False)),
    _Plot("Heading error, rad", "error", (False, False, False, True)),
)


def _visual_plots(root: str, bounds: Bounds, *, semidirect: bool) -> rrb.Tabs:
    """A tab for each stage; what has nothing to show is left out, and the times say how they are asked for."""

    def view(plot: _Plot, *, legend: bool = True, top: float = 0.0) -> rrb.TimeSeriesView:
        entity = f"{root}/{plot.entity}"
        lines = rr.SeriesLines.from_fields(visible_series=list(plot.show))
        return rrb.TimeSeriesView(
            origin=root,
            contents=[entity],
            name=plot.title,
            axis_x=_axis(bounds.frames),
            axis_y=rrb.ScalarAxis(range=(0.0, top), zoom_lock=False) if top > 0 else None,
            overrides={entity: lines} if plot.show else {},
            plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.LeftTop, visible=legend and sum(plot.show) != 1),
        )

    tabs: list[Any] = []
    groups = {**_VISUAL_PLOTS, **(_SEMIDIRECT_PLOTS if semidirect else _BASELINE_PLOTS), "Errors": _ERRORS}
    for tab, plots in groups.items():
        loud = [plot for plot in plots if plot.entity not in bounds.silent]
        top = bounds.slowest_ms if tab == _TIMES else 0.0
        if tab == _FILTERS and "filters/number" not in bounds.silent:
            tabs.append(_one_filter(view))
        elif loud:
            tabs.append(rrb.Horizontal(*(view(plot, top=top) for plot in loud), name=tab))
        elif tab == _TIMES:
            tabs.append(rrb.TextDocumentView(origin=f"{root}/untimed", name=tab))
    return rrb.Tabs(*tabs)


def _one_filter(view: Callable[..., rrb.TimeSeriesView]) -> rrb.Grid:
    """The courses of some depth filters side by side."""
    shown = [f"filters/shown/{k}" for k in range(1, FOLLOWED_SHOWN + 1)]
    return rrb.Grid(
        *(view(_Plot(f"Slot {k}: μ ± σ, 1/m", f"{slot}/depth"), legend=False) for k, slot in enumerate(shown, 1)),
        *(view(_Plot(f"Slot {k}: a/(a+b), C1", f"{slot}/ratio"), legend=False) for k, slot in enumerate(shown, 1)),
        grid_columns=FOLLOWED_SHOWN,
        name=_FILTERS,
    )


def _panels() -> Sequence[Any]:
    return (
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline="frame"),
    )


def _image(
    origin: str,
    size_px: tuple[float, float] | None,
    name: str,
    *,
    contents: Sequence[str] = ("$origin/**",),
    hidden: Sequence[str] = (),
) -> rrb.Spatial2DView:
    bounds = None
    if size_px is not None and np.isfinite(size_px).all():
        bounds = rrb.VisualBounds2D(x_range=(0.0, size_px[0]), y_range=(0.0, size_px[1]))
    overrides: dict[Any, Any] = {entity: rrb.EntityBehavior(visible=False) for entity in hidden}
    return rrb.Spatial2DView(
        origin=origin, contents=list(contents), name=name, visual_bounds=bounds, overrides=overrides
    )


@functools.lru_cache(maxsize=4)
def _axis(frames: tuple[int, int] | None) -> rrb.TimeAxis:
    """The axis of time that all plots of a view share."""
    first, last = (rr.TimeRangeBoundary.infinite(),) * 2 if frames is None else map(_absolute, frames)
    return rrb.TimeAxis(view_range=rr.TimeRange(start=first, end=last))


def _absolute(frame: int) -> rr.TimeRangeBoundary:
    return rr.TimeRangeBoundary.absolute(seq=frame)


def _map(
    run: str,
    extent: Extent | None,
    name: str = "Map: reference green, raw grey, corrected blue, aligned violet",
    trails: Sequence[str] = ("raw", "corrected"),
    contents: str | Sequence[str] = "/world/**",
) -> rrb.Spatial3DView:
    """The ground from above, x to the right, y up; the trails of a run up to the cursor, where one is named."""
    trail = rrb.VisibleTimeRanges(
        [
            rr.VisibleTimeRange(name, start=rr.TimeRangeBoundary.infinite(), end=rr.TimeRangeBoundary.cursor_relative())
            for name in ("frame", "sensor_time")
        ]
    )
    overrides: dict[Any, Any] = {f"/world/runs/{run}/{trailed}": trail for trailed in trails if run}
    return ground_view(contents, extent, name, overrides)


def ground_view(
    contents: str | Sequence[str], extent: Extent | None, name: str, overrides: Mapping[Any, Any] | None = None
) -> rrb.Spatial3DView:
    """What is in the world, seen from above: x to the right, y up."""
    eye = None
    if extent is not None:
        eye = rrb.EyeControls3D(
            position=(extent.x_m, extent.y_m, extent.eye_m),
            look_target=(extent.x_m, extent.y_m, 0.0),
            eye_up=(0.0, 1.0, 0.0),
        )
    return rrb.Spatial3DView(
        origin="/world",
        contents=contents if isinstance(contents, str) else list(contents),
        name=name,
        eye_controls=eye,
        overrides=dict(overrides or {}),
        background=[18, 20, 24],
    )


def _plots(root: str, frames: tuple[int, int] | None) -> rrb.Tabs:
    def plot(name: str, entity: str, *, legend: bool = True, show: Sequence[bool] = ()) -> rrb.TimeSeriesView:
        lines = rr.SeriesLines.from_fields(visible_series=list(show))
        overrides: dict[Any, Any] = {f"{root}/{entity}": lines} if show else {}
        return rrb.TimeSeriesView(
            origin=f"{root}/{entity}",
            contents="$origin",
            name=name,
            axis_x=_axis(frames),
            overrides=overrides,
            plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.LeftTop, visible=legend),
        )

    xy = [place in (0, 4) for place in range(9)]
    heading = [place == 8 for place in range(9)]
    return rrb.Tabs(
        rrb.Horizontal(
            plot("Shift since the frame before, px (u blue, v orange)", "motion/frame_shift", legend=False),
            plot("Shift from the template frame, px (u blue, v orange)", "fit/centre_shift", legend=False),
            name="Shift",
        ),
        rrb.Horizontal(
            plot("Subpixel Δ of the fragments, px (u blue, v orange)", "subpixel/delta", legend=False),
            plot("Left by the rigid fit, px (u blue, v orange)", "fit/residual", legend=False),
            name="Δ",
        ),
        rrb.Horizontal(
            plot("Δα since the frame before, rad", "motion/delta_heading", legend=False),
            plot("Heading α, rad", "motion/heading", legend=False),
            name="Δα, α",
        ),
        rrb.Horizontal(
            plot("Peak", "search/peak_correlation", legend=False),
            plot("Second / first", "search/peak_ratio", legend=False),
            plot("Residual, grey", "subpixel/residual_rms", legend=False),
            plot("Inliers", "fit/inliers", legend=False),
            name="Quality",
        ),
        rrb.Horizontal(
            plot("Correction and its sum, m", "correction/applied"),
            plot("Path of the segment and its reference, m", "correction/segment"),
            name="Correction",
        ),
        rrb.Horizontal(
            plot(
                "Position error, m (x blue, y orange, distance white)",
                "error",
                legend=False,
                show=[True, True, True, False],
            ),
            plot("Heading error, rad", "error", legend=False, show=[False, False, False, True]),
            name="Errors",
        ),
        rrb.Horizontal(
            plot("Variance of x (blue) and y, m²", "pose/covariance", legend=False, show=xy),
            plot("Variance of the heading, rad²", "pose/covariance", legend=False, show=heading),
            name="Covariance",
        ),
    )


def _texts(run: str, root: str, *more: rrb.View) -> rrb.Tabs:
    columns = rrb.TextLogColumns(text_log_columns=["LogLevel", "Body"])
    return rrb.Tabs(
        rrb.TextDocumentView(origin=f"{root}/numbers", name="Numbers"),
        rrb.TextLogView(origin=f"{root}/events", name="Events", columns=columns),
        rrb.TextLogView(origin=f"{root}/alarms", name="Alarms", columns=columns),
        rrb.TextDocumentView(origin=f"/runs/{run}/summary", name="Summary"),
        rrb.TextDocumentView(origin=f"/runs/{run}/settings", name="Settings"),
        rrb.TextDocumentView(origin="/recording/facts", name="Recording"),
        *more,
        active_tab=1,
    )
