"""What the parts of the PTAM-style baseline give for a frame, as fields of its `BaselineStep` by name."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pipelines.geometry import se3_inverse
from pipelines.semidirect import baseline_map
from pipelines.semidirect.baseline_map import Adjusted, Map
from pipelines.semidirect.baseline_search import Matches
from pipelines.semidirect.baseline_step import STAGES
from pipelines.semidirect.optics import Optics
from pipelines.semidirect.refinement import RefinedPose
from pipelines.semidirect.step import Feature

Floats = NDArray[np.float64]
Longs = NDArray[np.int64]
Flags = NDArray[np.bool_]
Notes = dict[str, Any]
"""Fields of the frame's Step, by name."""


class Tracked(NamedTuple):
    """What tracking made of a frame.

    `prior` and `coarse` are poses [4, 4] before and after the coarse step; `rows` [M] the points of the fine step with
    their `match`, errors and whether they agree with the `pose`, which is None where too few were matched.
    """

    prior: Floats
    coarse: Floats
    coarse_tried: int
    coarse_found: int
    rows: Longs
    match: Matches
    pose: RefinedPose | None
    error_px: Floats
    inlier: Flags

    @property
    def agreeing(self) -> int:
        """Points that agree with the pose."""
        return int(np.count_nonzero(self.inlier))

    @property
    def share(self) -> float:
        """Their share of the points that were looked for."""
        return self.agreeing / max(len(self.rows), 1)


def nothing() -> Notes:
    """The fields of a frame in which nothing was found."""
    nan, none = math.nan, np.zeros(0, np.int64)
    return {
        "pose_sigma": np.full(6, nan),
        "tracked": 0,
        "keyframe": 0,
        "scene_depth_m": nan,
        "point_id": none,
        "predicted_px": np.zeros((0, 2)),
        "found_px": np.zeros((0, 2)),
        "level": none,
        "outcome": none,
        "error_px": np.zeros(0),
        "score": np.zeros(0),
        "keyframe_number": none,
        "keyframe_position_m": np.zeros((0, 3)),
        "keyframe_quat_xyzw": np.zeros((0, 4)),
        "map_id": none,
        "map_point_m": np.zeros((0, 3)),
        "map_point_sigma_m": np.zeros(0),
        "map_point_views": none,
        "prior_position_m": np.full(3, nan),
        "corners": 0,
        "coarse_tried": 0,
        "coarse_found": 0,
        "coarse_position_m": np.full(3, nan),
        "pose_scale_px": nan,
        "keyframe_distance": nan,
        "points_added": 0,
        "points_removed": 0,
        "bundle_keyframes": np.zeros(2, np.int64),
        "bundle_iterations": np.zeros(2, np.int64),
        "bundle_cost": np.full((2, 2), nan),
        "bundle_outliers": np.zeros(2, np.int64),
        "start_matches": 0,
        "start_motion_px": nan,
        "start_parallax_px": nan,
        "relocalise_keyframe": -1,
        "relocalise_correlation": nan,
        "stage_ms": np.full(len(STAGES), nan),
    }


def of_tracking(m: Map, tracked: Tracked) -> Notes:
    """The points that were looked for, and what became of the pose."""
    match, pose = tracked.match, tracked.pose
    outlier = match.matched & ~tracked.inlier
    return {
        "tracked": tracked.agreeing,
        "pose_sigma": np.full(6, math.nan) if pose is None else np.sqrt(np.diag(pose.covariance)),
        "pose_scale_px": math.nan if pose is None else pose.scale_px,
        "point_id": m.ids[tracked.rows],
        "predicted_px": match.predicted,
        "found_px": match.found,
        "level": match.level,
        "outcome": np.where(outlier, Feature.OUTLIER, match.outcome),
        "error_px": tracked.error_px,
        "score": match.score,
        "prior_position_m": se3_inverse(tracked.prior)[:3, 3],
        "coarse_position_m": se3_inverse(tracked.coarse)[:3, 3],
        "coarse_tried": tracked.coarse_tried,
        "coarse_found": tracked.coarse_found,
    }


def of_map(m: Map, optics: Optics, sigma_px: float) -> Notes:
    """Keyframes and points as the Step tells them, for errors of so many px."""
    worlds = np.array([se3_inverse(pose) for pose in m.poses])
    return {
        "keyframe_number": m.frames,
        "keyframe_position_m": worlds[:, :3, 3],
        "keyframe_quat_xyzw": Rotation.from_matrix(worlds[:, :3, :3]).as_quat(),
        "map_id": m.ids,
        "map_point_m": m.points,
        "map_point_sigma_m": baseline_map.sigma_along_rays(m, optics, sigma_px),
        "map_point_views": np.diff(m.first),
    }


def of_bundles(adjusted: Sequence[Adjusted]) -> Notes:
    """What the local and the global bundle did."""
    keyframes, iterations, outliers = np.zeros((3, 2), np.int64)
    cost = np.full((2, 2), math.nan)
    for i, (_, bundle, dropped) in enumerate(adjusted):
        if bundle is not None:
            keyframes[i] = np.count_nonzero(np.any(bundle.covariance != 0, axis=(1, 2)))
            iterations[i], outliers[i] = bundle.iterations, dropped
            cost[i] = bundle.cost[[0, bundle.iterations]]
    return {
        "bundle_keyframes": keyframes,
        "bundle_iterations": iterations,
        "bundle_cost": cost,
        "bundle_outliers": outliers,
    }
