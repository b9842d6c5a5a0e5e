"""The account of a visual odometry: its losses, its map, its scale, and its path in space against the reference."""

from __future__ import annotations

import math
from array import array
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pipelines import spatial
from pipelines.estimator import Step
from pipelines.evaluation import Evaluation, EvaluationError, Statistics, Trajectory, evaluate
from pipelines.geometry import Floats
from pipelines.semidirect.step import Stage, VisualStep
from pipelines.spatial import SpatialPath
from workbench.inputs import Reference
from workbench.summary import Tally, evaluation_values, statistics_values, visual_suitability
from workbench.visual_inputs import ScaleSource

METRES, UNITS = "m", "units"
THIRD = 3
"""The scale's drift is that of the last third of the path against the first."""


@dataclass(frozen=True, slots=True, kw_only=True)
class VisualScene:
    """What the drawing of a visual odometry needs to know beyond its steps.

    Attributes:
        focal_px: focal length along u and v, px.
        centre_px: principal point, px.
        coarsest_level: of the pyramid that a sparse alignment begins with.
    """

    focal_px: tuple[float, float]
    centre_px: tuple[float, float] | None
    coarsest_level: int = 0

    @classmethod
    def of(cls, settings: Any) -> VisualScene:
        """The scene that some settings tell."""
        return cls(
            focal_px=(settings.focal_px, settings.focal_y_px or settings.focal_px),
            centre_px=settings.centre_px,
            coarsest_level=getattr(settings, "align_coarsest", 0),
        )


class ErrorLog(Protocol):
    """What the account needs of the run's log."""

    def errors(self, frames: Any, t_ns: Any, values: Floats) -> None: ...  # noqa: D102


@dataclass(slots=True)
class _Track:
    """The numbers of the frames that have a pose, while they pass: about 100 bytes a frame."""

    frame: array[int] = field(default_factory=lambda: array("q"))
    t_ns: array[int] = field(default_factory=lambda: array("q"))
    place: array[float] = field(default_factory=lambda: array("d"))
    pose: array[float] = field(default_factory=lambda: array("d"))
    known: array[int] = field(default_factory=lambda: array("b"))
    map: array[int] = field(default_factory=lambda: array("q"))

    def add(self, step: VisualStep) -> None:
        self.frame.append(step.frame)
        self.t_ns.append(step.t_ns)
        self.place.extend([*step.position_m.tolist(), *step.quat_xyzw.tolist()])
        self.pose.extend(step.pose.tolist())
        self.known.append(step.scale_known)
        self.map.append(step.map_number)


class VisualAccount:
    """Follows the steps of a visual odometry; only frames whose pose was found are held against the reference.

    Args:
        settings: of the estimator.
        reference: the path to compare with.
        offset_ns: added to the frames' times before the reference is looked up.
        source: what the scale comes from.
    """

    trajectory = True

    def __init__(self, settings: Any, reference: Reference, offset_ns: int, source: ScaleSource) -> None:
        self._reference, self._offset_ns, self._source = reference, offset_ns, source
        self.scene = VisualScene.of(settings)
        self._track = _Track()
        self._tracked: array[int] = array("q")
        self._losses: list[tuple[int, int]] = []
        self._starts: list[int] = []
        self._relocalised: list[int] = []
        self._keyframes = 0
        self._way = 0.0
        self._last: VisualStep | None = None

    def take(self, step: Step, sample: Any) -> None:
        """Take note of one step of a visual odometry."""
        assert isinstance(step, VisualStep)
        if step.accepted:
            self._way += _distance(self._last, step)
            self._track.add(step)
            self._tracked.append(step.tracked)
        if step.stage == Stage.LOST:
            goes_on = bool(self._losses) and self._last is not None and self._last.stage == Stage.LOST
            first = self._losses.pop()[0] if goes_on else step.frame
            self._losses.append((first, step.frame))
        if step.stage == Stage.STARTED:
            self._starts.append(step.frame)
        if step.stage == Stage.RELOCALISED:
            self._relocalised.append(step.frame)
        self._keyframes += step.keyframe
        self._last = step

    # ---- the end

    def conclude(self, run: ErrorLog, tally: Tally, median_dt_s: float) -> tuple[dict[str, Any], Floats | None]:
        """Hold the path against the reference and log its errors; also the reference [n, 3] laid over the path."""
        unit, scale = self._scale()
        kept = self._kept(unit)
        found = self._odometry(kept)
        evaluation, refused = self._evaluate(kept, unit)
        if evaluation is not None:
            index = kept[evaluation.index]
            run.errors(self._column("frame")[index], self._column("t_ns")[index], evaluation.errors)
        found["space"], laid = self._in_space(kept, unit)
        return {
            "path_length": self._way,
            "unit": unit,
            "scale": scale,
            "reference": refused,
            "evaluation": None if evaluation is None else evaluation_values(evaluation),
            "calibration": None,
            "odometry": found,
            "suitability": visual_suitability(tally, found, evaluation),
        }, laid

    def _column(self, name: str) -> NDArray[Any]:
        return np.array(getattr(self._track, name))

    def _scale(self) -> tuple[str, str]:
        """The unit of the path, and where it comes from."""
        last = self._last
        if last is None or not self._column("known").any():
            told = f": {self._source.sentence} did not tell it" if self._source.sentence else ""
            return UNITS, f"scale unknown{told}; a unit is the median depth of the first map; compared with scale"
        per = last.metres_per_unit
        sigma = f" ± {last.metres_per_unit_sigma:.2g}" if math.isfinite(last.metres_per_unit_sigma) else ""
        value = f"; {per:.5g}{sigma} m a unit of the first map" if math.isfinite(per) else ""
        return METRES, f"{self._source.sentence or 'as the estimator says'}{value}"

    def _kept(self, unit: str) -> NDArray[np.int64]:
        """The rows of the track that are in the path's unit, which without a known scale is each map's own."""
        known = self._column("known").astype(bool)
        rows = np.flatnonzero(known if unit == METRES else ~known)
        return rows if unit == METRES else self._largest(rows)

    def _largest(self, rows: NDArray[np.int64]) -> NDArray[np.int64]:
        """Those of some rows that are of the map with the most of them."""
        numbers, counts = np.unique(self._column("map")[rows], return_counts=True)
        return rows[self._column("map")[rows] == numbers[np.argmax(counts)]] if len(rows) else rows

    def _odometry(self, kept: NDArray[np.int64]) -> dict[str, Any]:
        last = self._last
        return {
            "frames_with_pose": len(self._track.frame),
            "frames_without_scale": int((self._column("known") == 0).sum()),
            "starts": self._starts,
            "losses": [list(span) for span in self._losses],
            "lost_frames": sum(b - a + 1 for a, b in self._losses),
            "relocalised": self._relocalised,
            "maps": 0 if last is None else last.map_number + 1,
            "keyframes_made": self._keyframes,
            "keyframes": 0 if last is None else last.keyframes,
            "map_points": 0 if last is None else last.map_points,
            "tracked_median": float(np.median(self._tracked)) if self._tracked else math.nan,
            "tracked_least": min(self._tracked, default=0),
            "metres_per_unit": math.nan if last is None else last.metres_per_unit,
            "scale_source": self._source.sentence or "none",
        }

    def _evaluate(self, kept: NDArray[np.int64], unit: str) -> tuple[Evaluation | None, str]:
        """The path seen from above against the reference, and what that is; or why there is no comparison."""
        sentence = self._reference.sentence
        if not self._reference.poses:
            return None, sentence
        if unit != METRES and self._last is not None and self._last.map_number > 0:
            sentence += "; the map with the most frames alone, as each has a unit of its own"
        pose = self._column("pose").reshape(-1, 3)[kept]
        estimate = Trajectory(self._column("t_ns")[kept].astype(np.int64), pose)
        try:
            result = evaluate(estimate, self._reference.path, with_scale=unit != METRES, offset_ns=self._offset_ns)
        except EvaluationError as error:
            return None, f"{sentence}; not compared: {error}"
        return result, sentence

    def _in_space(self, kept: NDArray[np.int64], unit: str) -> tuple[dict[str, Any] | None, Floats | None]:
        """The path in space against the reference; and the reference [n, 3] laid over the path.

        Of several maps only the one with the most frames, as each has a place and a scale of its own.
        """
        if not self._reference.poses or not len(kept):
            return None, None
        kept = self._largest(kept)
        place = self._column("place").reshape(-1, 7)[kept]
        estimate = SpatialPath.of(self._column("t_ns")[kept].astype(np.int64), place[:, :3], place[:, 3:])
        reference = SpatialPath.of_poses(self._reference.poses)
        if not len(reference):
            return {"sentence": f"not compared in space: {self._reference.stream} has no attitude"}, None
        try:
            values, laid = in_space(estimate, reference, offset_ns=self._offset_ns, with_scale=unit != METRES)
            alone = (
                {"of_map": int(self._column("map")[kept[0]])}
                if self._last is not None and self._last.map_number
                else {}
            )
            return values | alone, laid
        except (ValueError, EvaluationError) as error:
            return {"sentence": f"not compared in space: {error}"}, None


def _distance(before: VisualStep | None, step: VisualStep) -> float:
    """Way from one found pose to the next of the same map; 0 where one of them was not found."""
    if before is None or not before.accepted or before.map_number != step.map_number:
        return 0.0
    return float(np.linalg.norm(step.position_m - before.position_m))


def in_space(
    estimate: SpatialPath, reference: SpatialPath, *, offset_ns: int = 0, with_scale: bool = True
) -> tuple[dict[str, Any], Floats]:
    """A path in space against its reference: errors after alignment by Sim(3), scale, its drift, attitude.

    The reference may be of the vehicle and the estimate of its camera: a constant turn between the two, the mean of
    the differences, is taken off the attitude; a lever arm between them is not. Roll, pitch and yaw are not told apart.

    Args:
        estimate: the path.
        reference: what it is compared with.
        offset_ns: added to the estimate's times.
        with_scale: whether the path's own scale means nothing; else the errors by SE(3) are told, too.

    Returns:
        Plain values; and the reference's positions [n, 3] in the axes and the unit of the estimate.

    Raises:
        EvaluationError: fewer than 2 poses, or fewer than half of them, have a reference.
        ValueError: the positions lie on one line or in one point.
    """
    mine, truth = spatial.associated(estimate, reference, offset_ns=offset_ns)
    fitted = spatial.align(mine, truth, "sim3")
    aligned = fitted(mine)
    length = float(spatial.path_lengths(truth)[-1])
    mounting = (aligned.rotation.inv() * truth.rotation).mean()
    turned = SpatialPath(aligned.t_ns, aligned.position_m, (aligned.rotation * mounting).as_quat())
    errors = spatial.absolute_error(turned, truth)
    values = {
        "matched": len(mine),
        "reference_path_m": length,
        "ape_m": statistics_values(errors.translation),
        "ape_percent": 100 * errors.translation.rmse / length if length > 0 else math.nan,
        "attitude_deg": statistics_values(errors.rotation, math.degrees(1)),
        "scale": fitted.scale,
        "scale_drift_percent": 100 * _scale_drift(mine, truth),
    }
    if not with_scale:
        rigid = spatial.align(mine, truth, "se3")(mine)
        values["ape_without_scale_m"] = statistics_values(
            Statistics.of(np.linalg.norm(rigid.position_m - truth.position_m, axis=1))
        )
    back = Rotation.from_matrix(fitted.rotation).inv()
    laid: Floats = back.apply(truth.position_m - fitted.translation_m) / fitted.scale
    return values, laid


def _scale_drift(estimate: SpatialPath, truth: SpatialPath) -> float:
    """Scale of the last third of the path against that of the first, less 1; NaN where a third tells none."""
    along = spatial.path_lengths(truth)
    first, last = along <= along[-1] / THIRD, along >= along[-1] * (THIRD - 1) / THIRD
    try:
        early, late = (
            spatial.align(estimate.at(np.flatnonzero(rows)), truth.at(np.flatnonzero(rows)), "sim3").scale
            for rows in (first, last)
        )
    except ValueError:
        return math.nan
    return early / late - 1
