"""The fields of a `SemidirectStep`, part by part: each function names what one part of the chain has computed."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pipelines.geometry import quat_of_rotation, se3_inverse
from pipelines.semidirect.local_map import LocalMap, centre_of, centres_of
from pipelines.semidirect.mapping import Growth
from pipelines.semidirect.settings import SemidirectSettings
from pipelines.semidirect.step import Feature, Stage
from pipelines.semidirect.tracking import Tracked

Floats = NDArray[np.float64]
STAGES = 5
"""Pyramid, alignment, features with the pose, relocalisation or start, mapping."""

_NAN3, _NAN4, _NAN6 = (np.full(n, np.nan) for n in (3, 4, 6))
_NONE = np.zeros(0, np.int64)
_EMPTY = np.zeros(0)


def blank_fields(s: SemidirectSettings) -> dict[str, Any]:
    """Every field that a part of the chain fills in, as it is where that part did not run."""
    levels = s.align_coarsest - s.align_finest + 1
    return {
        "accepted": False,
        "stage": int(Stage.SKIPPED),
        "map_point_covariance": np.zeros((0, 3, 3)),
        "mean_grey": np.nan,
        "sharpness": np.nan,
        "pose_sigma": _NAN6,
        "tracked": 0,
        "keyframe": 0,
        "scene_depth_m": np.nan,
        "point_id": _NONE,
        "predicted_px": np.zeros((0, 2)),
        "found_px": np.zeros((0, 2)),
        "level": _NONE,
        "outcome": _NONE,
        "error_px": _EMPTY,
        "keyframe_number": _NONE,
        "keyframe_position_m": np.zeros((0, 3)),
        "keyframe_quat_xyzw": np.zeros((0, 4)),
        "map_id": _NONE,
        "map_point_m": np.zeros((0, 3)),
        "map_point_sigma_m": _EMPTY,
        "map_point_views": _NONE,
        "prior_position_m": _NAN3,
        "prior_quat_xyzw": _NAN4,
        "align_cost": np.full((levels, s.align_iterations + 1), np.nan),
        "align_iterations": np.zeros(levels, np.int64),
        "align_stop": np.zeros(levels, np.int64),
        "align_final_cost": np.nan,
        "align_gain": np.nan,
        "align_offset": np.nan,
        "align_patches": 0,
        "align_inliers": 0,
        "align_sigma": _NAN6,
        "align_px": np.zeros((0, 2)),
        "align_residual": _EMPTY,
        "aligned_position_m": _NAN3,
        "point_state": _NONE,
        "residual_rms": _EMPTY,
        "correlation": _EMPTY,
        "iterations": _NONE,
        "outcome_count": np.zeros(len(Feature), np.int64),
        "pose_cost": np.full(s.pose_iterations + 1, np.nan),
        "pose_iterations": 0,
        "pose_scale_px": np.nan,
        "error_before_px": np.nan,
        "error_after_px": np.nan,
        "pose_covariance": np.full((6, 6), np.nan),
        "keyframe_distance": np.nan,
        "keyframe_removed": -1,
        "keyframe_points": 0,
        "points_refined": 0,
        "points_added": 0,
        "points_removed": np.zeros(3, np.int64),
        "bundle_cost": np.full(s.bundle_iterations + 1, np.nan),
        "bundle_iterations": 0,
        "bundle_keyframes": 0,
        "bundle_points": 0,
        "bundle_outliers": 0,
        "filters": 0,
        "filter_count": np.zeros(6, np.int64),
        "filter_id": _NONE,
        "filter_keyframe": _NONE,
        "filter_px": np.zeros((0, 2)),
        "filter_mu": _EMPTY,
        "filter_sigma": _EMPTY,
        "filter_range": _EMPTY,
        "filter_ratio": _EMPTY,
        "filter_age": _NONE,
        "filter_outcome": _NONE,
        "filter_match": _NONE,
        "filter_inlier": _EMPTY,
        "epipolar_px": np.zeros((0, 4)),
        "filter_found_px": np.zeros((0, 2)),
        "start_matches": 0,
        "start_motion_px": np.nan,
        "start_parallax_px": np.nan,
        "relocalise_keyframe": -1,
        "relocalise_correlation": np.nan,
        "map_height_m": np.nan,
        "stage_ms": np.full(STAGES, np.nan),
    }


def track_fields(tracked: Tracked, world: LocalMap) -> dict[str, Any]:
    """Prior, alignment, features and pose of a frame, tracked in a map."""
    looked, points = tracked.looked, world.points
    found = looked.features
    fields: dict[str, Any] = {
        "tracked": tracked.points,
        "scene_depth_m": tracked.depth,
        "point_id": points.number[looked.rows],
        "predicted_px": found.predicted,
        "found_px": found.pixels,
        "level": found.level,
        "outcome": looked.outcome,
        "error_px": tracked.error_px,
        "prior_position_m": centre_of(tracked.prior),
        "prior_quat_xyzw": quat_of(tracked.prior),
        "aligned_position_m": centre_of(tracked.aligned_pose),
        "align_px": tracked.aligned_px,
        "align_residual": np.full(len(tracked.aligned_px), np.nan),
        "point_state": points.state[looked.rows],
        "residual_rms": found.residual_rms,
        "correlation": found.correlation,
        "iterations": found.iterations,
        "outcome_count": np.bincount(looked.outcome, minlength=len(Feature)),
        "map_height_m": height_over(tracked, world),
    }
    if tracked.aligned is not None:
        aligned = tracked.aligned
        fields |= {
            "align_cost": aligned.cost,
            "align_iterations": aligned.iterations,
            "align_stop": aligned.stop,
            "align_final_cost": aligned.final_cost,
            "align_gain": aligned.gain,
            "align_offset": aligned.offset,
            "align_patches": int(np.count_nonzero(aligned.visible)),
            "align_inliers": int(np.count_nonzero(aligned.inlier)),
            "align_sigma": _sigma(aligned.covariance),
            "align_residual": aligned.residual_rms,
        }
    if tracked.pose is not None:
        pose = tracked.pose
        fields |= {
            "pose_cost": pose.cost,
            "pose_iterations": pose.iterations,
            "pose_scale_px": pose.scale_px,
            "error_before_px": _median(pose.error_before_px),
            "error_after_px": _median(pose.error_px),
            "pose_covariance": pose.covariance,
            "pose_sigma": _sigma(pose.covariance),
        }
    return fields


def growth_fields(growth: Growth) -> dict[str, Any]:
    """What a frame did to the map: keyframe, points, bundle, filters."""
    watched = growth.watched
    belief = watched.filters.belief
    fields: dict[str, Any] = {
        "keyframe": int(growth.keyframe),
        "keyframe_distance": growth.distance,
        "keyframe_removed": growth.keyframe_removed,
        "keyframe_points": growth.sighted,
        "points_refined": growth.refined,
        "points_added": growth.added,
        "points_removed": growth.removed,
        "filters": len(growth.world.filters.number),
        "filter_count": growth.filter_count,
        "filter_id": watched.filters.number,
        "filter_keyframe": watched.filters.keyframe,
        "filter_px": watched.filters.pixel,
        "filter_mu": belief[:, 0],
        "filter_sigma": np.sqrt(belief[:, 1]),
        "filter_range": watched.filters.reach,
        "filter_ratio": belief[:, 2] / (belief[:, 2] + belief[:, 3]),
        "filter_age": watched.filters.age,
        "filter_outcome": watched.outcome,
        "filter_match": watched.match,
        "filter_inlier": watched.inlier,
        "epipolar_px": watched.segment,
        "filter_found_px": watched.found_px,
    }
    if growth.bundle is not None:
        bundle = growth.bundle
        fields |= {
            "bundle_cost": bundle.cost,
            "bundle_iterations": bundle.iterations,
            "bundle_keyframes": growth.bundle_keyframes,
            "bundle_points": len(bundle.points),
            "bundle_outliers": int(np.count_nonzero(~bundle.inlier)),
        }
    return fields


def map_fields(world: LocalMap) -> dict[str, Any]:
    """Keyframes and points of a map."""
    poses = world.keyframes.cam_t_world
    return {
        "keyframe_number": world.keyframes.number,
        "keyframe_position_m": centres_of(poses),
        "keyframe_quat_xyzw": Rotation.from_matrix(poses[:, :3, :3].transpose(0, 2, 1)).as_quat(),
        "map_id": world.points.number,
        "map_point_m": world.points.place,
        "map_point_sigma_m": world.points.sigma,
        "map_point_covariance": world.points.covariance,
        "map_point_views": np.diff(world.seen.first),
    }


def quat_of(cam_t_world: Floats) -> Floats:
    """The rotation from camera axes to the world as a unit quaternion x, y, z, w [4]."""
    return quat_of_rotation(se3_inverse(cam_t_world))


def height_over(tracked: Tracked, world: LocalMap) -> float:
    """Median height of the camera over the points that it sees; NaN without any."""
    places = world.points.place[tracked.sightings.rows]
    return float(centre_of(tracked.cam_t_world)[2] - np.median(places[:, 2])) if len(places) else np.nan


def _sigma(covariance: Floats) -> Floats:
    return np.sqrt(np.diag(covariance))


def _median(values: Floats) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else np.nan
