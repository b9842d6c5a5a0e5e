"""What the PTAM-style baseline computes for one frame beyond that which every visual odometry does."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.estimator import quantity
from pipelines.semidirect.step import VisualStep

Floats = NDArray[np.float64]
Longs = NDArray[np.int64]

STAGES = ("image", "track", "map")
"""What `stage_ms` tells the times of: pyramid and corners, pose, keyframe."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BaselineStep(VisualStep):
    """One frame of the PTAM-style baseline.

    An outcome NOT_CONVERGED of a point also says that no corner near its projection is like its patch.
    """

    # tracking
    prior_position_m: Floats = quantity("m", "the camera's centre by the motion model", 3)
    corners: int = quantity("1", "FAST corners on all levels")
    coarse_tried: int = quantity("1", "points looked for in the coarse step")
    coarse_found: int = quantity("1", "of these found")
    coarse_position_m: Floats = quantity("m", "the camera's centre after the coarse step", 3)
    score: Floats = quantity("grey²", "mean squared difference of each point's patch and the best corner", "M")
    pose_scale_px: float = quantity("px", "scale of the reprojection errors, by their median absolute value")

    # keyframes and map
    keyframe_distance: float = quantity("1", "distance to the nearest keyframe over the scene's depth")
    points_added: int = quantity("1", "points that the epipolar search between two keyframes gave")
    points_removed: int = quantity("1", "points that went: outliers, or seen by one keyframe only")
    bundle_keyframes: Longs = quantity("1", "keyframes that moved in the local and in the global bundle", 2)
    bundle_iterations: Longs = quantity("1", "iterations of both, 0 without", 2)
    bundle_cost: Floats = quantity("px²", "Huber's cost of both before and after", 2, 2)
    bundle_outliers: Longs = quantity("1", "observations that both dropped", 2)

    # start and relocalisation
    start_matches: int = quantity("1", "corners followed since the first view")
    start_motion_px: float = quantity("px", "median way of these corners")
    start_parallax_px: float = quantity("px", "median way that no rotation explains")
    relocalise_keyframe: int = quantity("1", "frame number of the keyframe that was tried, -1 for none")
    relocalise_correlation: float = quantity("1", "correlation of the small images")

    # work: what the frame cost
    stage_ms: Floats = quantity("ms", "time of pyramid and corners, tracking, mapping; NaN unless asked for", 3)
