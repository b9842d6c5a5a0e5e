"""What a report plots of a run: curves over its frames, thinned without losing an extreme."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from pipelines.ranging.filter import Status
from pipelines.verdict import Verdict
from workbench.runs import Run
from workbench.schema import Archetype

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

MOST_POINTS = 2000
"""Points of a plot; more are thinned."""
MOST_SLOTS = 8
"""Slots of landmarks that have curves."""
BAND = 0.95
"""Share of a right filter's frames whose mean NIS lies between its bounds."""
CUT = 3.0
"""Ranges so many times the usual one, as a start has them, leave the plot."""


@dataclass(frozen=True, slots=True)
class Curve:
    """One line of a plot: `values` [n] by frame. `role` is ``line``, ``bound`` (dashed) or ``reference``."""

    name: str
    values: Floats
    role: str = "line"


@dataclass(frozen=True, slots=True)
class Chart:
    """A plot over the frames of a run.

    Attributes:
        key: short name, for links.
        title: what it shows.
        unit: of its values.
        about: how to read it, in a sentence.
        frame: numbers of the frames [n].
        t_s: seconds since the first frame [n].
        curves: lines, values [n] each.
        from_zero: whether its axis begins at zero.
        ceiling: where its axis ends at the latest; what lies above leaves the plot.
    """

    key: str
    title: str
    unit: str
    about: str
    frame: Ints
    t_s: Floats
    curves: tuple[Curve, ...]
    from_zero: bool = False
    ceiling: float = math.inf

    def readable(self) -> Chart:
        """The same in mm or µm where metres would be tiny."""
        largest = max((float(np.nanmax(np.abs(c.values), initial=0.0)) for c in self.curves), default=0.0)
        if self.unit != "m" or largest >= 0.1 or largest == 0:
            return self
        factor, unit = (1e3, "mm") if largest >= 1e-4 else (1e6, "µm")
        curves = tuple(dataclasses.replace(curve, values=factor * curve.values) for curve in self.curves)
        return dataclasses.replace(self, unit=unit, curves=curves)

    def thinned(self, most: int = MOST_POINTS) -> Chart:
        """The chart with at most that many points, the extremes of every curve among them."""
        rows = extremes(np.column_stack([curve.values for curve in self.curves]), most)
        curves = tuple(dataclasses.replace(curve, values=curve.values[rows]) for curve in self.curves)
        return dataclasses.replace(self, frame=self.frame[rows], t_s=self.t_s[rows], curves=curves)


@dataclass(frozen=True, slots=True)
class Ways:
    """The estimated and the reference path from above in m [n, 2], at the same frames; the reference may be NaN."""

    frame: Ints
    t_s: Floats
    estimate: Floats
    reference: Floats

    def thinned(self, most: int = MOST_POINTS) -> Ways:
        """The ways with at most that many points."""
        rows = extremes(np.column_stack([self.estimate, self.reference]), most)
        return Ways(self.frame[rows], self.t_s[rows], self.estimate[rows], self.reference[rows])


@dataclass(frozen=True, slots=True)
class Strip:
    """The gravest verdict of each of some stretches of frames: its frame, time and verdict [n]."""

    frame: Ints
    t_s: Floats
    verdicts: tuple[Verdict, ...]


def extremes(values: Floats, most: int) -> Ints:
    """Rows of `values` [n, k] to keep, at most `most`: of stretches of equal length those with each column's extremes.

    The first and the last row are among them; a stretch without a number keeps its first row.
    """
    n, k = values.shape
    if n <= most:
        return np.arange(n)
    stretches = max(1, (most - 2) // (2 * k))
    edges = np.linspace(0, n, stretches + 1).astype(np.int64)
    kept = {0, n - 1}
    for start, stop in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        part = values[start:stop]
        low, high = np.where(np.isnan(part), np.inf, part), np.where(np.isnan(part), -np.inf, part)
        kept.update((start + np.concatenate([low.argmin(axis=0), high.argmax(axis=0)])).tolist())
    return np.array(sorted(kept), np.int64)


def seconds(run: Run) -> Floats:
    """Seconds since the first frame [n]."""
    return np.asarray((run.t_ns - run.t_ns[0]) / 1e9, np.float64)


def strip(run: Run, most: int = 500) -> Strip:
    """The verdicts of a run, the gravest of each stretch of frames."""
    verdicts = run.verdicts
    grave = np.array([(v.severity, v.value) for v in verdicts], dtype=[("s", "i8"), ("v", "i8")])
    order = np.argsort(np.argsort(grave, order=("s", "v"), kind="stable"), kind="stable")
    edges = np.linspace(0, len(verdicts), min(most, len(verdicts)) + 1).astype(np.int64)
    rows = [a + int(np.argmax(order[a:b])) for a, b in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True)]
    return Strip(run.frames[rows], seconds(run)[rows], tuple(verdicts[row] for row in rows))


def ways(run: Run) -> Ways | None:
    """The paths of a run, laid over one another as its evaluation did; None of an estimator without a path."""
    from pipelines.evaluation import Alignment, associate

    path = run.column("pose")[:, :3] if "pose" in run.fields else None
    if path is None:
        return None
    evaluation = run.summary.get("evaluation")
    if evaluation:
        told = evaluation["alignment"]
        path = Alignment(
            rotation_rad=math.radians(told["rotation_deg"]),
            translation_m=np.array(told["translation_m"], np.float64),
            scale=told["scale"],
        )(path)
    reference = np.full((len(path), 3), np.nan)
    if run.reference is not None:
        offset_ns = round(float(run.toml["run"].get("reference_offset_s", 0.0)) * 1e9)
        reference = associate(run.t_ns, run.reference, offset_ns=offset_ns)
    return Ways(run.frames, seconds(run), path[:, :2], reference[:, :2])


def errors(run: Run) -> list[Chart]:
    """Errors against the reference; none where there is none."""
    if run.errors is None:
        return []
    frames, t_s = run.frames, seconds(run)
    place = np.full((len(frames), 4), np.nan)
    rows = np.searchsorted(frames, run.errors.frame).clip(0, len(frames) - 1)
    good = frames[rows] == run.errors.frame
    place[rows[good]] = run.errors.values[good]
    found = [
        Chart("position-error", "Position error", "m", "Distance from the reference after alignment.", frames, t_s,
              (Curve("position error", place[:, 2]),), from_zero=True)
    ]  # fmt: skip
    if np.isfinite(place[:, 3]).any():
        heading = (Curve("heading error", np.degrees(place[:, 3])),)
        about = "Heading of the estimate minus that of the reference, after alignment."
        found.append(Chart("heading-error", "Heading error", "°", about, frames, t_s, heading))
    return found


def own(run: Run) -> list[Chart]:
    """What the estimator itself says of its work."""
    if run.visual:
        return _visual(run)
    return {"correlation": _correlation, "range": _range}.get(run.estimator, _nothing)(run)


def _nothing(run: Run) -> list[Chart]:
    return []


def _correlation(run: Run) -> list[Chart]:
    frames, t_s = run.frames, seconds(run)
    names = ["residual_rms", "peak_ratio", "peak_correlation", "inliers"]
    residual, ratio, peak, inliers = (run.columns(names)[name] for name in names)

    def bound(name: str) -> tuple[Curve, ...]:
        value = run.settings.get(name)
        return () if value is None else (Curve(f"bound {name}", np.full(len(frames), float(value)), "bound"),)

    def chart(key: str, title: str, unit: str, about: str, *curves: Curve) -> Chart:
        return Chart(key, title, unit, about, frames, t_s, curves)

    return [
        chart("residual", "Residual of the match", "grey", "Root mean square of what remains after matching.",
              Curve("median of the fragments", _over(np.nanmedian, residual)),
              Curve("worst fragment", _over(np.nanmax, residual))),
        chart("peak-ratio", "Second peak against the first", "1",
              "Near one, two places look equally good and the match may be the wrong one.",
              Curve("median of the fragments", _over(np.nanmedian, ratio)),
              Curve("worst fragment", _over(np.nanmax, ratio)), *bound("max_peak_ratio")),
        chart("correlation", "Correlation at the peak", "1", "Near one, the fragment looks like its template.",
              Curve("median of the fragments", _over(np.nanmedian, peak)),
              Curve("worst fragment", _over(np.nanmin, peak)), *bound("min_correlation")),
        chart("inliers", "Fragments that agree", "1", "How many fragments and tiles fit one rigid motion.",
              Curve("inliers", inliers.astype(np.float64)), *bound("min_inliers")),
    ]  # fmt: skip


def _visual(run: Run) -> list[Chart]:
    frames, t_s = run.frames, seconds(run)

    def chart(key: str, title: str, unit: str, about: str, *curves: Curve, from_zero: bool = False) -> Chart:
        return Chart(key, title, unit, about, frames, t_s, curves, from_zero)

    def curve(name: str, field: str) -> Curve:
        return Curve(name, run.column(field).astype(np.float64))

    def bound(setting: str) -> tuple[Curve, ...]:
        value = run.settings.get(setting)
        return () if value is None else (Curve(f"bound {setting}", np.full(len(frames), float(value)), "bound"),)

    charts = [
        chart("tracked", "Points that agree with the pose", "1", "Below the bound the camera is lost.",
              curve("points", "tracked"), *bound("min_tracked"), from_zero=True),
        chart("map", "Points in the map", "1", "What the camera can be found by.", curve("points", "map_points"),
              from_zero=True),
        chart("keyframe-distance", "Distance to the nearest keyframe over the scene's depth", "1",
              "Above the bound the frame becomes a keyframe.", curve("distance", "keyframe_distance"),
              *bound("keyframe_distance")),
    ]  # fmt: skip
    if "error_after_px" in run.fields:
        charts.insert(1, chart("reprojection", "Reprojection error", "px", "Median, before and after the refinement.",
                               curve("before", "error_before_px"), curve("after", "error_after_px")))  # fmt: skip
        charts.append(chart("alignment", "Residual of the alignment", "grey²", "Mean square, at the finest level.",
                            curve("residual", "align_final_cost")))  # fmt: skip
        charts.append(chart("filters", "Depth filters at work", "1", "Corners whose depth is not sure yet.",
                            curve("filters", "filters"), from_zero=True))  # fmt: skip
    if "height_m" in run.fields and np.isfinite(run.column("height_m")).any():
        charts.append(chart("height", "Height", "m", "Where both part, the scale has drifted or the ground changed.",
                            curve("over the map", "map_height_m"),
                            Curve("sensor", run.column("height_m").astype(np.float64), "reference")))  # fmt: skip
    return charts


def _over(statistic: Any, values: Floats) -> Floats:
    """A statistic of each row [n] of `values` [n, k], NaN left out; NaN of a row without a number."""
    found = np.full(len(values), np.nan)
    some = np.isfinite(values).any(axis=1)
    if some.any():
        found[some] = statistic(np.where(np.isfinite(values[some]), values[some], np.nan), axis=1)
    return found


def _range(run: Run) -> list[Chart]:
    frames, t_s = run.frames, seconds(run)
    nis, sigma = run.columns(["nis", "relative_sigma"]).values()
    used = [k for k in range(sigma.shape[1]) if np.isfinite(sigma[:, k]).any()]
    shown, rest = used[:MOST_SLOTS], len(used) - len(used[:MOST_SLOTS])
    more = f" {rest} more slots are in the recording's columns." if rest else ""
    logged = {k: _logged(run, k) for k in shown}
    charts = _range_error(run, logged)
    charts += [_slot(run, k, values) for k, values in logged.items()]
    charts.append(_nis(run, nis))
    about = "σ_ξ/ξ of the landmark in each slot: what the filter believes to know of its range." + more
    lines = tuple(Curve(f"slot {k + 1}", np.where(np.isfinite(sigma[:, k]), sigma[:, k], np.nan)) for k in shown)
    if lines:
        charts.append(Chart("relative-sigma", "Relative uncertainty", "1", about, frames, t_s, lines, from_zero=True))
    return charts


def _logged(run: Run, slot: int) -> Floats:
    """Range, nearest, farthest and reference range [n, 4] of the landmark in a slot, as the replay logged them."""
    from workbench.rrd_reading import series

    found = series(run.file, f"{run.root}/landmark/{slot + 1}/range", Archetype.SCALARS.value)
    values = np.full((len(run.frames), 4), np.nan)
    if len(found.frame):
        rows = np.searchsorted(run.frames, found.frame).clip(0, len(run.frames) - 1)
        good = run.frames[rows] == found.frame
        values[rows[good]] = found.values[good]
    return values


def _range_error(run: Run, logged: Mapping[int, Floats]) -> list[Chart]:
    """Error of the ranges that count; none without a reference."""
    if not logged:
        return []
    depth, _, _, reference = np.stack(list(logged.values()), axis=1).transpose(2, 0, 1)
    counts = run.column("status")[:, list(logged)] == Status.CONVERGED
    error = np.where(counts, 100 * np.abs(depth / reference - 1), np.nan)
    if not np.isfinite(error).any():
        return []
    curves = (Curve("median of the landmarks", _over(np.nanmedian, error)),
              Curve("worst landmark", _over(np.nanmax, error)))  # fmt: skip
    about = "Of the ranges that count, against the reference."
    return [Chart("range-error", "Range error", "%", about, run.frames, seconds(run), curves, from_zero=True)]


def _slot(run: Run, slot: int, logged: Floats) -> Chart:
    """Range of the landmark in a slot against the reference."""
    depth, near, far, reference = logged.T
    known = reference if np.isfinite(reference).any() else depth
    ceiling = CUT * float(np.nanpercentile(known, 90)) if np.isfinite(known).any() else math.inf
    curves = [Curve("range Z", depth), Curve("nearest (2σ)", near, "bound"), Curve("farthest (2σ)", far, "bound")]
    if np.isfinite(reference).any():
        curves.append(Curve("reference", reference, "reference"))
    about = "Depth along the optical axis, with what ± 2 σ_ξ leaves open; the wild ranges of a start leave the plot."
    return Chart(
        f"range-{slot + 1}",
        f"Range of the landmark in slot {slot + 1}",
        "m",
        about,
        run.frames,
        seconds(run),
        tuple(curves),
        from_zero=True,
        ceiling=ceiling,
    )


def _nis(run: Run, nis: Floats) -> Chart:
    """Mean NIS of each frame's landmarks, with the band that it keeps in 95 % of the frames of a right filter."""
    count = np.isfinite(nis).sum(axis=1)
    degrees = float(run.summary.get("ranging", {}).get("nis", {}).get("expected", 2.0))
    mean = _over(np.nanmean, nis)
    dof = np.where(count > 0, degrees * count, np.nan)
    low, high = (chi2.ppf(end, dof) / np.where(count > 0, count, 1) for end in ((1 - BAND) / 2, (1 + BAND) / 2))
    curves = (Curve("mean NIS", mean), Curve("χ² low", low, "bound"), Curve("χ² high", high, "bound"))
    about = "Squared innovations over what the filter expects, mean of the frame's landmarks; the band holds 95 %."
    return Chart("nis", "Innovations (NIS)", "1", about, run.frames, seconds(run), curves, from_zero=True)
