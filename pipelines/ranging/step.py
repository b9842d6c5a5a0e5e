"""All that the range filter computes at a frame, for N landmarks side by side.

N is the number of slots that the settings give. A landmark keeps its slot from its first to its last frame; a slot
without a landmark holds NaN. Camera axes and signs are those of `equations.py`; x, y are undistorted pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.estimator import Step, quantity

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class RangeStep(Step):
    """One frame of the range filter; whole numbers of landmarks stand as floats, so that NaN can say "none"."""

    # ---- what was used
    omega_radps: float = quantity("rad/s", "ω̃ about the camera's y axis, mean since the frame before, bias taken out")
    speed_mps: float = quantity("m/s", "Ṽ along the camera's z axis, mean since the frame before")
    dt_s: float = quantity("s", "time since the frame before")
    intervals: int = quantity("1", "intervals of constant inputs since the frame before")
    still: int = quantity("1", "1: the camera stood, V was taken as 0 (zero-velocity update)")
    gyro_age_s: float = quantity("s", "age of the last angular velocity at the frame")
    odometer_age_s: float = quantity("s", "age of the last speed at the frame")
    gyro_bias_radps: float = quantity("rad/s", "gyro bias that was taken out")
    focus_px: Floats = quantity("px", "focus of expansion on the image (u, v)", 2)

    # ---- which landmarks
    landmarks: int = quantity("1", "landmarks that are carried")
    measured: int = quantity("1", "landmarks with an image point in this frame")
    converged: int = quantity("1", "landmarks whose range counts")
    landmark_id: Floats = quantity("1", "number of the landmark in each slot", "N")
    outcome: Floats = quantity("1", "`Outcome` of each landmark: predicted, updated, rejected, reset, lost", "N")
    status: Floats = quantity("1", "`Status` of each landmark: what its range is worth", "N")
    age_frames: Floats = quantity("1", "frames since the landmark's start", "N")

    # ---- prediction (23), (24), (28), (29)
    prior: Floats = quantity("px, px, 1/m", "X⁻ = x, y, ξ", "N", 3)
    prior_covariance: Floats = quantity("px, px, 1/m", "P⁻", "N", 3, 3)
    transition: Floats = quantity("px, px, 1/m", "A over the last interval", "N", 3, 3)
    noise_gain: Floats = quantity("1", "G over the last interval, columns ω and V", "N", 3, 2)

    # ---- update (25)-(27)
    measured_px: Floats = quantity("px", "z, the image point", "N", 2)
    innovation_px: Floats = quantity("px", "ν = z - H X⁻", "N", 2)
    innovation_covariance: Floats = quantity("px²", "S = H P⁻ Hᵀ + R", "N", 2, 2)
    gain: Floats = quantity("1", "K", "N", 3, 2)
    nis: Floats = quantity("1", "νᵀ S⁻¹ ν", "N")
    log_likelihood: Floats = quantity("1", "of the innovation", "N")
    rejections: Floats = quantity("1", "rejections in a row", "N")
    mean: Floats = quantity("px, px, 1/m", "X = x, y, ξ", "N", 3)
    covariance: Floats = quantity("px, px, 1/m", "P", "N", 3, 3)

    # ---- what it says
    range_m: Floats = quantity("m", "Z = 1/ξ, depth along the optical axis", "N")
    range_interval_m: Floats = quantity("m", "depth at ξ ± 2 σ_ξ: nearest, farthest", "N", 2)
    relative_sigma: Floats = quantity("1", "σ_ξ/ξ", "N")
    parallax_px: Floats = quantity("px", "distance from the landmark's first image point", "N")
    derotated_parallax_px: Floats = quantity("px", "the same without the rotation's share", "N")
    focus_distance_px: Floats = quantity("px", "distance from the focus of expansion", "N")
