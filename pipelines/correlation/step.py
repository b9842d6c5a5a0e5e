"""Everything that the correlation odometry computes for one frame.

Axes. Image: u to the right along the columns, v down along the rows; pixel (0, 0) is the centre of the
first pixel. The camera looks straight down, +u is the direction of travel (paper A's Ox), so +v points
to the right of the vehicle seen from above (Oy). World and body: z up, x forward, y left, headings
counter-clockwise seen from above (REP 103); paper A counts them clockwise. All shifts are those of the
image content from the template frame to this frame: the camera moves the other way.

Shapes: F fragments, T tiles, M = 2 · search radius + 1 positions a side. Numbers that were not computed are NaN,
and the verdict says why. Equation numbers are paper A's.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.estimator import Step, quantity

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class CorrelationStep(Step):
    """One frame of the two-fragment (or many-fragment) correlation odometry."""

    # the frame and what it is compared with
    accepted: bool = quantity("1", "the measured motion was used; otherwise the last velocity is held")
    template_frame: int = quantity("1", "number of the frame whose fragments were searched, -1 for none")
    dt_s: float = quantity("s", "sensor time since the frame before")
    image_size_px: Floats = quantity("px", "width and height of the image", 2)
    mean_grey: float = quantity("grey", "mean grey level over every 32nd row of the image")
    gradient_energy: float = quantity("grey²/px²", "mean squared gradient over every 32nd row")

    # 1. integer shift, extremal correlation (2), (3)
    fragment_side_px: int = quantity("px", "side N of a fragment")
    search_radius_px: int = quantity("px", "the search area reaches this far around its centre")
    fragment_px: Floats = quantity("px", "centres (u, v) of the fragments in the template frame", "F", 2)
    predicted_shift_px: Floats = quantity("px", "predicted shift (u, v) of each fragment", "F", 2)
    search_centre_px: Floats = quantity("px", "centres (u, v) of the search areas in this frame", "F", 2)
    surface: NDArray[np.float32] = quantity(
        "1", "normalised correlation for every position (row v, column u), NaN outside the image", "F", "M", "M"
    )
    peak_px: Floats = quantity("px", "integer shift (m, n) of the highest peak", "F", 2)
    peak_correlation: Floats = quantity("1", "value of the highest peak", "F")
    second_peak_px: Floats = quantity("px", "integer shift of the second peak, outside the first one's hill", "F", 2)
    second_peak_correlation: Floats = quantity("1", "value of the second peak", "F")
    peak_ratio: Floats = quantity("1", "second peak over first", "F")
    peak_curvature: Floats = quantity("1/px²", "curvature of the peak, smaller principal value", "F")
    peak_anisotropy: Floats = quantity("1", "ratio of the principal curvatures of the peak", "F")

    # 2. subpixel refinement, optical flow (4)-(11)
    delta_px: Floats = quantity("px", "subpixel Δ (u, v) that is added to the integer shift (8), (9)", "F", 2)
    hessian: Floats = quantity("grey²/px²", "I_xyᵀ I_xy of the fragment (8), (9)", "F", 2, 2)
    condition: Floats = quantity("1", "condition number of I_xyᵀ I_xy", "F")
    smallest_eigenvalue: Floats = quantity("grey²/px²", "smaller eigenvalue of I_xyᵀ I_xy, per pixel", "F")
    iterations: Floats = quantity("1", "iterations of the refinement", "F")
    gain: Floats = quantity("1", "gain of the match: this frame = gain · template + offset", "F")
    offset: Floats = quantity("grey", "offset of the match", "F")
    match_grey: Floats = quantity("grey", "mean grey level of the match", "F")
    gradient: Floats = quantity("grey²/px²", "mean squared gradient of the fragment", "F")
    residual_rms: Floats = quantity("grey", "rms of what remains after the match", "F")
    sigma_px: Floats = quantity("px", "predicted standard deviation (u, v) of the shift", "F", 2)
    shift_px: Floats = quantity("px", "shift of each fragment, integer plus subpixel (10), (11)", "F", 2)

    # 3. rigid motion of the frame (12), (13), (15)
    weight: Floats = quantity("1", "robust weight of each fragment in the rigid fit, 0 for an outlier", "F")
    fit_residual_px: Floats = quantity("px", "shift of each fragment minus the rigid fit", "F", 2)
    inliers: int = quantity("1", "fragments that agree with the rigid fit")
    rigidity_px: float = quantity("px", "distance between matches minus that between fragments, worst pair")
    scale: float = quantity("1", "size of the template in this frame: 1 while the height is constant")
    centre_shift_px: Floats = quantity("px", "shift (m_x0, n_y0) of the image centre from the template frame", 2)
    template_rotation_rad: float = quantity("rad", "rotation from the template frame to this frame")
    tile_px: Floats = quantity("px", "centres (u, v) of the photometric tiles in the template frame", "T", 2)
    tile_shift_px: Floats = quantity("px", "shift (u, v) of each photometric tile", "T", 2)
    tile_weight: Floats = quantity("1", "weight of each tile in the final fit, 0 for an outlier", "T")
    motion_covariance: Floats = quantity("px², px·rad, rad²", "covariance of centre shift and rotation", 3, 3)
    rotation_limit_rad: float = quantity("rad", "largest rotation for this fragment size (1)")

    # 4. motion since the frame before, trajectory (14)-(17)
    frame_shift_px: Floats = quantity("px", "shift (u, v) of the image centre since the frame before", 2)
    delta_heading_rad: float = quantity("rad", "Δα since the frame before (15)")
    heading_rad: float = quantity("rad", "heading α after this frame")
    metres_per_px: float = quantity("m/px", "price of a pixel W")
    height_m: float = quantity("m", "camera height that W comes from, NaN where W was given")
    path_step_m: float = quantity("m", "S, length of the motion since the frame before (14)")
    increment_m: Floats = quantity("m", "(Δx, Δy) in the world (16), (17)", 2)

    # 5. correction (18)-(21)
    segment_frames: int = quantity("1", "frames of the correction segment so far")
    segment_sum_m: float = quantity("m", "S_Σ, path of the segment so far (18)")
    segment_reference_m: float = quantity("m", "S_etal, reference path of the segment so far")
    relative_deviation: float = quantity("1", "ΔS_relate at the end of a segment (19)")
    deviation_m: float = quantity("m", "ΔS_Σ at the end of a segment (20)")
    correction_m: Floats = quantity("m", "correction (x, y) in the world applied with this frame (21)", 2)
    correction_total_m: Floats = quantity("m", "sum of all corrections so far", 2)

    # 6. poses
    pose_raw: Floats = quantity("m, m, rad", "x, y, heading without corrections", 3)
    pose: Floats = quantity("m, m, rad", "x, y, heading with corrections", 3)
    pose_covariance: Floats = quantity("m², m·rad, rad²", "covariance of the pose since the start", 3, 3)
