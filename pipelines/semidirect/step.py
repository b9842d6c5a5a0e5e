"""Everything that the semi-direct odometry and its baseline compute for one frame.

Axes. Camera: x right, y down, z out of the lens; pixel (0, 0) is the centre of the first pixel. World: z up, z = 0 the
plane that the first map lies on, x and heading 0 along the settings' start pose. The camera's heading is that of its
+u axis seen from above, less the mounting yaw. Lengths are in metres where the scale is known (`scale_known`), else
in units of the first map's median depth.

Shapes that differ from frame to frame: M map points that were looked for in the frame, A points of the sparse
alignment, S depth filters, K keyframes, P map points. The arrays over K and P are empty in frames where the map's
structure did not change: what stands there is the last one given. L levels of the alignment and I + 1 costs are of
the settings. Numbers that were not computed are NaN, and the verdict says why.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from pipelines.estimator import Step, quantity

Floats = NDArray[np.float64]
Longs = NDArray[np.int64]


class Stage(IntEnum):
    """What the odometry did with a frame."""

    FIRST = 0
    """The first view of a start, or of a new one."""
    STARTING = 1
    """Corners are followed from the first view until they have moved enough for a first map."""
    STARTED = 2
    """The first map was made with this frame."""
    TRACKED = 3
    RELOCALISED = 4
    """Lost before, found again with this frame."""
    LOST = 5
    SKIPPED = 6
    """A frame that cannot be used: unreadable, repeated, out of order, of another size."""


class Feature(IntEnum):
    """What became of a map point that was looked for in the frame."""

    MATCHED = 0
    OUT_OF_VIEW = 1
    OBLIQUE = 2
    """The keyframe that saw it looks at it from too different an angle."""
    REFERENCE_OUT_OF_VIEW = 3
    """Its patch, warped to this view, reaches out of the keyframe's image."""
    FLAT = 4
    """Its patch has too little texture."""
    LEFT_IMAGE = 5
    NOT_CONVERGED = 6
    NOT_TRIED = 7
    """Its cell had a better point, or enough points were found."""
    OUTLIER = 8
    """Found, but its reprojection error is above the limit after the pose was refined."""


@dataclass(frozen=True, slots=True, kw_only=True)
class VisualStep(Step):
    """One frame of a visual odometry that keeps a map: what the workbench shows of every one of them."""

    # the frame
    accepted: bool = quantity("1", "the camera's pose was found in this frame; otherwise the last one is held")
    stage: int = quantity("1", "`Stage`: starting, tracked, lost, …")
    dt_s: float = quantity("s", "sensor time since the frame before")
    image_size_px: Floats = quantity("px", "width and height of the image", 2)

    # the pose
    position_m: Floats = quantity("m", "the camera's centre in the world", 3)
    quat_xyzw: Floats = quantity("1", "rotation from camera axes to the world", 4)
    pose: Floats = quantity("m, m, rad", "x, y of the camera, heading", 3)
    increment_m: Floats = quantity("m", "(Δx, Δy) since the frame before", 2)
    path_step_m: float = quantity("m", "length of the motion since the frame before")
    delta_heading_rad: float = quantity("rad", "turn since the frame before")
    pose_sigma: Floats = quantity("m, m, m, rad, rad, rad", "standard deviations about the camera's axes", 6)

    # the map
    map_number: int = quantity("1", "number of the map: 0 for the first, -1 before it; a new one has its own scale")
    relocalised_frames: int = quantity("1", "frames since the last relocalisation, -1 without one")
    tracked: int = quantity("1", "map points found in the frame that agree with its pose")
    keyframe: int = quantity("1", "1: the frame became a keyframe")
    keyframes: int = quantity("1", "keyframes in the map")
    map_points: int = quantity("1", "points in the map")
    scene_depth_m: float = quantity("m", "median depth of the points seen")

    # metric scale
    scale_known: int = quantity("1", "1: lengths are metres")
    metres_per_unit: float = quantity("m", "metres of a unit of the first map, NaN while unknown")
    metres_per_unit_sigma: float = quantity("m", "standard deviation of that")

    # map points looked for in the frame
    point_id: Longs = quantity("1", "number of the map point", "M")
    predicted_px: Floats = quantity("px", "where it was expected (u, v)", "M", 2)
    found_px: Floats = quantity("px", "where it was found", "M", 2)
    level: Longs = quantity("1", "level of the pyramid that it was looked for on", "M")
    outcome: Longs = quantity("1", "`Feature`: matched, or why not", "M")
    error_px: Floats = quantity("px", "its reprojection error at the final pose, px of the level", "M")

    # the map's structure, given when it changed
    keyframe_number: Longs = quantity("1", "frame numbers of the keyframes", "K")
    keyframe_position_m: Floats = quantity("m", "their cameras' centres in the world", "K", 3)
    keyframe_quat_xyzw: Floats = quantity("1", "their rotations from camera axes to the world", "K", 4)
    map_id: Longs = quantity("1", "numbers of the map's points", "P")
    map_point_m: Floats = quantity("m", "their places in the world", "P", 3)
    map_point_sigma_m: Floats = quantity("m", "standard deviation along the ray of the first keyframe", "P")
    map_point_views: Longs = quantity("1", "keyframes that saw them", "P")


@dataclass(frozen=True, slots=True, kw_only=True)
class SemidirectStep(VisualStep):
    """One frame of the semi-direct odometry."""

    # 0. the image, the map's covariances
    map_point_covariance: Floats = quantity("m²", "covariance of the map's points, for errors of 1 px", "P", 3, 3)
    mean_grey: float = quantity("grey", "mean grey level of the coarsest level")
    sharpness: float = quantity("1", "mean squared step along the rows over the squared mean grey level")

    # 1. prior, sparse image alignment
    prior_position_m: Floats = quantity("m", "the camera's centre before any image was looked at", 3)
    prior_quat_xyzw: Floats = quantity("1", "its rotation to the world", 4)
    align_cost: Floats = quantity("grey²", "mean squared residual before each iteration and after the last", "L", "I")
    align_iterations: Longs = quantity("1", "iterations of each level", "L")
    align_stop: Longs = quantity("1", "`alignment.Stop` of each level", "L")
    align_final_cost: float = quantity("grey²", "mean squared residual in the end")
    align_gain: float = quantity("1", "gain of this frame against the one before")
    align_offset: float = quantity("grey", "offset of this frame against the one before")
    align_patches: int = quantity("1", "patches that both frames show")
    align_inliers: int = quantity("1", "patches whose residual is like the others'")
    align_sigma: Floats = quantity("m, m, m, rad, rad, rad", "standard deviations of the aligned motion", 6)
    align_px: Floats = quantity("px", "places of the patches in the frame before", "A", 2)
    align_residual: Floats = quantity("grey", "rms residual of each patch", "A")
    aligned_position_m: Floats = quantity("m", "the camera's centre after the alignment", 3)

    # 2. feature alignment
    point_state: Longs = quantity("1", "`PointState` of each point looked for", "M")
    residual_rms: Floats = quantity("grey", "rms of what remains after its alignment", "M")
    correlation: Floats = quantity("1", "correlation of its patch with the image where it was found", "M")
    iterations: Longs = quantity("1", "iterations of its alignment", "M")
    outcome_count: Longs = quantity("1", "how many points had each `Feature`", 9)

    # 3. pose refinement
    pose_cost: Floats = quantity("px²", "Tukey's cost before each iteration and after the last", "J")
    pose_iterations: int = quantity("1", "iterations of the pose refinement")
    pose_scale_px: float = quantity("px", "scale of the errors, by their median absolute value")
    error_before_px: float = quantity("px", "median reprojection error before the refinement")
    error_after_px: float = quantity("px", "median reprojection error after it")
    pose_covariance: Floats = quantity("m, m, m, rad, rad, rad", "covariance of the pose about the camera's axes", 6, 6)

    # 4. keyframe decision
    keyframe_distance: float = quantity("1", "distance to the nearest keyframe over the scene's depth")
    keyframe_removed: int = quantity("1", "number of the keyframe that went, -1 for none")
    keyframe_points: int = quantity("1", "map points that the frame sees as a keyframe, 0 where it is none")

    # 5. structure: points refined, added, removed
    points_refined: int = quantity("1", "points of the keyframe, refined on their own")
    points_added: int = quantity("1", "points that the depth filters gave to the map")
    points_removed: Longs = quantity("1", "points that went: keyframe gone, not found again, outlier of bundle", 3)

    # 6. local bundle adjustment
    bundle_cost: Floats = quantity("px²", "Huber's cost before each iteration and after the last", "B")
    bundle_iterations: int = quantity("1", "iterations, 0 without a bundle adjustment")
    bundle_keyframes: int = quantity("1", "keyframes that took part")
    bundle_points: int = quantity("1", "points that took part")
    bundle_outliers: int = quantity("1", "observations that it dropped")

    # 7. depth filters
    filters: int = quantity("1", "depth filters at work")
    filter_count: Longs = quantity("1", "filters updated, without match, converged, diverged, unseen, given up", 6)
    filter_id: Longs = quantity("1", "number of the filter; its point keeps it", "S")
    filter_keyframe: Longs = quantity("1", "frame number of its keyframe", "S")
    filter_px: Floats = quantity("px", "its corner in the keyframe", "S", 2)
    filter_mu: Floats = quantity("1/m", "μ, inverse depth along the ray", "S")
    filter_sigma: Floats = quantity("1/m", "σ of it", "S")
    filter_range: Floats = quantity("1/m", "z_range, the range of inverse depths", "S")
    filter_ratio: Floats = quantity("1", "a/(a+b), mean inlier ratio", "S")
    filter_age: Longs = quantity("1", "frames since its start", "S")
    filter_outcome: Longs = quantity("1", "`depth_filter.Outcome` in this frame", "S")
    filter_match: Longs = quantity("1", "`epipolar.Match` in this frame", "S")
    filter_inlier: Floats = quantity("1", "C1, probability that the measurement was good", "S")
    epipolar_px: Floats = quantity("px", "ends (u, v) of its epipolar segment in this frame: far, near", "S", 4)
    filter_found_px: Floats = quantity("px", "where it was found in this frame", "S", 2)

    # 8. start and relocalisation
    start_matches: int = quantity("1", "corners followed since the first view")
    start_motion_px: float = quantity("px", "median way of these corners")
    start_parallax_px: float = quantity("px", "median way that no rotation explains")
    relocalise_keyframe: int = quantity("1", "frame number of the keyframe that was tried, -1 for none")
    relocalise_correlation: float = quantity("1", "correlation of the small images after their alignment")

    # 9. height, as a check of the scale
    height_m: float = quantity("m", "height that the sensor or the settings give, NaN without")
    map_height_m: float = quantity("m", "height over the plane of the points seen")

    # 10. work: what the frame cost
    stage_ms: Floats = quantity("ms", "time of pyramid, alignment, features and pose, start or search, mapping", 5)
