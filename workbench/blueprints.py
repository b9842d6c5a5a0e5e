"""One saved view per estimator: what a viewer shows of a run without any hand work."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from pipelines.correlation.step import CorrelationStep
from pipelines.estimator import Step


@dataclass(frozen=True, slots=True)
class Extent:
    """A square on the ground: centre (x, y) and side in metres."""

    x_m: float
    y_m: float
    size_m: float

    @classmethod
    def of(cls, points: NDArray[np.float64]) -> Extent:
        """The square around points [n, 2]; 1 m where they do not tell."""
        finite = points[np.isfinite(points).all(axis=1)]
        if not len(finite):
            return cls(0.0, 0.0, 1.0)
        low, high = finite.min(axis=0), finite.max(axis=0)
        x, y = (low + high) / 2
        return cls(float(x), float(y), float((high - low).max()) or 1.0)


def sensor_blueprint() -> rrb.Blueprint:
    """The view of a mission's sensors alone."""
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Spatial2DView(origin="/camera/image", name="Image"),
            rrb.Vertical(
                _map(None),
                rrb.TextDocumentView(origin="/recording/facts", name="Recording"),
                row_shares=[3, 2],
            ),
        ),
        *_panels(),
        auto_views=False,
    )


def blueprint_of(
    step_type: type[Step],
    run: str,
    estimator: str,
    *,
    frames: tuple[int, int] | None = None,
    extent: Extent | None = None,
) -> rrb.Blueprint:
    """The view of a run of the estimator that makes these steps."""
    if issubclass(step_type, CorrelationStep):
        return correlation_blueprint(run, estimator, frames=frames, extent=extent)
    raise KeyError(step_type.__name__)


def correlation_blueprint(
    run: str,
    estimator: str = "correlation",
    *,
    frames: tuple[int, int] | None = None,
    extent: Extent | None = None,
) -> rrb.Blueprint:
    """Image, surfaces and map above; plots, tables and events below; verdicts at the foot.

    Args:
        run: name of the run.
        estimator: name of the estimator.
        frames: first and last frame, for the axes of the plots; all that there is if None.
        extent: the square on the ground that the map shows; the viewer's choice if None.
    """
    root = f"/runs/{run}/{estimator}"
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(
                rrb.Spatial2DView(origin="/camera/image", contents=["/camera/image", f"/camera/image/{run}/**"],
                                  name="Image: fragments, search areas, matches"),
                rrb.Spatial2DView(origin=f"{root}/search/surface", name="Correlation surfaces"),
                _map(run, extent),
            ),
            rrb.Horizontal(_plots(root, frames), _texts(run, root), column_shares=[2, 1]),
            rrb.StateTimelineView(origin=root, contents=[f"{root}/verdict", f"{root}/alarms/**"], name="Verdicts",
                                  time_view=_axis(frames)),
            row_shares=[5, 4, 2],
        ),
        *_panels(),
        auto_views=False,
    )  # fmt: skip


def _panels() -> Sequence[Any]:
    return (
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline="frame"),
    )


def _axis(frames: tuple[int, int] | None) -> rrb.TimeAxis:
    first, last = (rr.TimeRangeBoundary.infinite(),) * 2 if frames is None else map(_absolute, frames)
    return rrb.TimeAxis(view_range=rr.TimeRange(start=first, end=last))


def _absolute(frame: int) -> rr.TimeRangeBoundary:
    return rr.TimeRangeBoundary.absolute(seq=frame)


def _map(run: str | None, extent: Extent | None = None) -> rrb.Spatial3DView:
    """The ground from above: x to the right, y up."""
    eye = None
    if extent is not None:
        eye = rrb.EyeControls3D(
            position=(extent.x_m, extent.y_m, 1.6 * extent.size_m),
            look_target=(extent.x_m, extent.y_m, 0.0),
            eye_up=(0.0, 1.0, 0.0),
        )
    trail = rrb.VisibleTimeRanges(
        [
            rr.VisibleTimeRange(name, start=rr.TimeRangeBoundary.infinite(), end=rr.TimeRangeBoundary.cursor_relative())
            for name in ("frame", "sensor_time")
        ]
    )
    overrides = {} if run is None else {f"/world/runs/{run}/{name}": trail for name in ("raw", "corrected")}
    return rrb.Spatial3DView(
        origin="/world",
        contents="/world/**",
        name="Trajectory from above",
        eye_controls=eye,
        overrides=overrides,
        background=[18, 20, 24],
    )


def _plots(root: str, frames: tuple[int, int] | None) -> rrb.Tabs:
    def plot(name: str, *entities: str, hide: Mapping[str, Sequence[bool]] | None = None) -> rrb.TimeSeriesView:
        overrides = {
            f"{root}/{entity}": rr.SeriesLines.from_fields(visible_series=list(visible))
            for entity, visible in (hide or {}).items()
        }
        return rrb.TimeSeriesView(
            origin=root,
            contents=[f"{root}/{entity}" for entity in entities],
            name=name,
            axis_x=_axis(frames),
            overrides=overrides,
            plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.RightTop),
        )

    return rrb.Tabs(
        plot("Shift", "motion/frame_shift", "fit/centre_shift"),
        plot("Δ subpixel", "subpixel/delta"),
        rrb.Vertical(plot("Δα", "motion/delta_heading"), plot("α", "motion/heading"), name="Δα, α"),
        rrb.Grid(
            plot("Correlation", "search/peak_correlation"),
            plot("Peak ratio", "search/peak_ratio"),
            plot("Residual", "subpixel/residual_rms"),
            plot("Inliers", "fit/inliers"),
            name="Quality",
        ),
        plot("Correction", "correction/applied"),
        rrb.Vertical(
            plot("Error: x, y, distance", "error", hide={"error": [True, True, True, False]}),
            plot("Error: heading", "error", hide={"error": [False, False, False, True]}),
            name="Errors",
        ),
        plot("Covariance", "pose/covariance"),
        name="Plots",
    )


def _texts(run: str, root: str) -> rrb.Tabs:
    return rrb.Tabs(
        rrb.TextDocumentView(origin=f"{root}/numbers", name="Numbers"),
        rrb.TextLogView(origin=f"{root}/events", name="Events"),
        rrb.TextLogView(origin=f"{root}/verdicts", name="Every alarm"),
        rrb.TextDocumentView(origin=f"/runs/{run}/summary", name="Summary"),
        rrb.TextDocumentView(origin=f"/runs/{run}/settings", name="Settings"),
        rrb.TextDocumentView(origin="/recording/facts", name="Recording"),
        active_tab=1,
    )
