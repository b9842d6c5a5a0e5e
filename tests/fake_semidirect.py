"""Plausible steps of a semi-direct odometry for tests of the log, from a seed, without the estimator.

A camera flies along x at 1.5 m over a plane, looking down; it starts, tracks, loses itself and is found again. The
number of points, filters and patches is another one in every frame, and now and then none.
"""

import dataclasses
import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pipelines.semidirect.baseline_step import BaselineStep
from pipelines.semidirect.step import Feature, SemidirectStep, Stage
from pipelines.verdict import Verdict

PERIOD_NS = 16_666_667
START_NS = 1_712_345_678_123_456_789
SIZE = (752.0, 480.0)
FOCAL, HEIGHT = 420.0, 1.5
LEVELS, COSTS, REFINED, BUNDLED = 3, 31, 11, 11
DOWN = Rotation.from_matrix([[1, 0, 0], [0, -1, 0], [0, 0, -1]])
LOST = range(60, 75)


def t_of(frame: int) -> int:
    return START_NS + frame * PERIOD_NS


def stage_of(frame: int) -> Stage:
    if frame < 5:
        return (Stage.FIRST, *[Stage.STARTING] * 3, Stage.STARTED)[frame]
    if frame in LOST:
        return Stage.LOST
    return Stage.RELOCALISED if frame == LOST.stop else Stage.TRACKED


def position(frame: int) -> NDArray[np.float64]:
    return np.array([0.02 * frame, 0.1 * math.sin(frame / 20), HEIGHT + 0.05 * math.sin(frame / 30)])


def steps(number: int, *, seed: int = 3, scale_known: bool = True) -> Iterator[SemidirectStep]:
    rng = np.random.default_rng(seed)
    points = rng.uniform([-0.5, -0.6, -0.02], [0.02 * number + 0.5, 0.6, 0.02], (60 + number, 3))
    for frame in range(number):
        yield _step(rng, frame, points, scale_known)


def _step(rng: np.random.Generator, frame: int, points: NDArray[np.float64], scale_known: bool) -> SemidirectStep:
    stage = stage_of(frame)
    tracked = stage in (Stage.STARTED, Stage.TRACKED, Stage.RELOCALISED)
    m, a, s = (int(n) if tracked else 0 for n in rng.integers([20, 30, 5], [60, 90, 40]))
    made = tracked and frame % 12 == 4
    k = 1 + frame // 12 if made else 0
    p = len(points) if made else 0
    place = position(frame if tracked else LOST.start - 1) if frame > 4 else np.array([0.0, 0.0, HEIGHT])
    turn = DOWN.as_quat()
    alarms = Verdict.FIRST_FRAME if frame == 0 else Verdict.LOST if stage is Stage.LOST else Verdict.OK
    seen = rng.integers(0, len(points), m)
    away = points[seen] - place
    predicted = np.column_stack([FOCAL * away[:, 0], -FOCAL * away[:, 1]]) / -away[:, 2:] + np.array(SIZE) / 2
    outcome = rng.choice(len(Feature), m, p=[0.7, 0.05, 0.02, 0.03, 0.05, 0.03, 0.05, 0.05, 0.02]).astype(np.int64)
    found = np.where(np.isin(outcome, [Feature.MATCHED, Feature.OUTLIER])[:, None], predicted + 0.3, np.nan)
    corner = rng.uniform([0, 0], SIZE, (s, 2))
    sigma = rng.uniform(0.005, 0.2, s)
    costs = np.full((LEVELS, COSTS), np.nan)
    if tracked:
        costs[:, :4] = np.sort(rng.uniform(10, 90, (LEVELS, 4)))[:, ::-1]
    numbers: dict[str, Any] = {
        "frame": frame,
        "t_ns": t_of(frame),
        "received_ns": t_of(frame) + 7,
        "verdict": alarms,
        "alarms": alarms,
        "accepted": tracked,
        "stage": int(stage),
        "dt_s": PERIOD_NS * 1e-9 if frame else math.nan,
        "image_size_px": np.array(SIZE),
        "position_m": place,
        "quat_xyzw": turn,
        "pose": np.array([place[0], place[1], 0.0]),
        "increment_m": rng.normal(0, 0.02, 2),
        "path_step_m": 0.02,
        "delta_heading_rad": float(rng.normal(0, 1e-3)),
        "pose_sigma": rng.uniform(1e-4, 1e-3, 6),
        "map_number": 0 if frame > 3 else -1,
        "relocalised_frames": frame - LOST.stop if frame >= LOST.stop else -1,
        "tracked": int((outcome == Feature.MATCHED).sum()),
        "keyframe": int(made),
        "keyframes": 1 + frame // 12,
        "map_points": len(points),
        "scene_depth_m": HEIGHT,
        "scale_known": int(scale_known),
        "metres_per_unit": 1.52 if scale_known else math.nan,
        "metres_per_unit_sigma": 0.01 if scale_known else math.nan,
        "point_id": seen.astype(np.int64),
        "predicted_px": predicted,
        "found_px": found,
        "level": rng.integers(0, 3, m),
        "outcome": outcome,
        "error_px": rng.gamma(2, 0.2, m),
        "keyframe_number": np.arange(k, dtype=np.int64) * 12,
        "keyframe_position_m": np.array([position(12 * i) for i in range(k)]).reshape(-1, 3),
        "keyframe_quat_xyzw": np.tile(turn, (k, 1)).reshape(-1, 4),
        "map_id": np.arange(p, dtype=np.int64) + (1 << 53),
        "map_point_m": points[:p],
        "map_point_sigma_m": rng.gamma(2, 0.01, p),
        "map_point_views": rng.integers(2, 9, p),
        "map_point_covariance": np.einsum("pij,pkj->pik", *[rng.normal(0, 0.01, (p, 3, 3))] * 2),
        "mean_grey": float(rng.uniform(80, 120)),
        "sharpness": float(rng.uniform(0.01, 0.02)),
        "prior_position_m": place,
        "prior_quat_xyzw": turn,
        "align_cost": costs,
        "align_iterations": rng.integers(1, 9, LEVELS),
        "align_stop": rng.integers(0, 3, LEVELS),
        "align_final_cost": float(costs[-1, 3]),
        "align_gain": 1.0,
        "align_offset": 0.0,
        "align_patches": a,
        "align_inliers": a // 2,
        "align_sigma": rng.uniform(1e-4, 1e-3, 6),
        "align_px": rng.uniform([0, 0], SIZE, (a, 2)),
        "align_residual": rng.gamma(2, 3, a),
        "aligned_position_m": place,
        "point_state": rng.integers(0, 3, m),
        "residual_rms": rng.gamma(2, 3, m),
        "correlation": rng.uniform(0.8, 1, m),
        "iterations": rng.integers(1, 10, m),
        "outcome_count": np.bincount(outcome, minlength=len(Feature)).astype(np.int64),
        "pose_cost": rng.uniform(0, 5, REFINED),
        "pose_iterations": 4,
        "pose_scale_px": 0.4,
        "error_before_px": 0.9,
        "error_after_px": float(rng.gamma(4, 0.1)),
        "pose_covariance": np.eye(6) * 1e-6,
        "keyframe_distance": 0.01 * (frame % 12),
        "keyframe_removed": -1,
        "keyframe_points": 100,
        "points_refined": 20,
        "points_added": 7 * made,
        "points_removed": rng.integers(0, 3, 3),
        "bundle_cost": np.full(BUNDLED, np.nan),
        "bundle_iterations": 0,
        "bundle_keyframes": 0,
        "bundle_points": 0,
        "bundle_outliers": 0,
        "filters": s,
        "filter_count": rng.integers(0, 9, 6),
        "filter_id": np.sort(rng.choice(200, s, replace=False)).astype(np.int64),
        "filter_keyframe": np.full(s, frame // 12 * 12, np.int64),
        "filter_px": corner,
        "filter_mu": rng.normal(1 / HEIGHT, 0.05, s),
        "filter_sigma": sigma,
        "filter_range": np.full(s, 2 / HEIGHT),
        "filter_ratio": rng.beta(10, 5, s),
        "filter_age": rng.integers(0, 40, s),
        "filter_outcome": rng.integers(0, 5, s),
        "filter_match": rng.integers(0, 9, s),
        "filter_inlier": rng.beta(5, 1, s),
        "epipolar_px": np.column_stack([corner, corner + 100 * sigma[:, None]]),
        "filter_found_px": np.where(rng.random((s, 1)) < 0.6, corner + 50 * sigma[:, None], np.nan),
        "start_matches": 150 if frame < 5 else 0,
        "start_motion_px": 12.0 * frame if frame < 5 else math.nan,
        "start_parallax_px": 11.0 * frame if frame < 5 else math.nan,
        "relocalise_keyframe": 48 if stage in (Stage.LOST, Stage.RELOCALISED) else -1,
        "relocalise_correlation": 0.5 if stage is Stage.LOST else math.nan,
        "height_m": float(place[2]) if scale_known else math.nan,
        "map_height_m": float(place[2]) * 1.01,
        "stage_ms": np.full(5, np.nan),
    }
    return SemidirectStep(**numbers)


def baseline_steps(number: int, *, seed: int = 5) -> Iterator[BaselineStep]:
    """The same flight as the baseline tells it."""
    rng = np.random.default_rng(seed)
    own = {
        "corners": 900,
        "coarse_tried": 50,
        "coarse_found": 40,
        "coarse_position_m": np.zeros(3),
        "bundle_keyframes": np.array([4, 0]),
        "bundle_iterations": np.array([3, 0]),
        "bundle_outliers": np.array([1, 0]),
        "points_removed": 2,
        "stage_ms": np.full(3, math.nan),
    }
    names = {field.name for field in dataclasses.fields(BaselineStep)}
    for step in steps(number, seed=seed):
        shared = {name: getattr(step, name) for name in names if name not in own and hasattr(step, name)}
        more = {"score": rng.gamma(2, 50, len(step.point_id)), "bundle_cost": rng.uniform(0, 9, (2, 2))}
        yield BaselineStep(**(shared | own | more))
