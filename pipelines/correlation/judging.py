"""The checks on one frame: from the numbers of its match to the flags of the verdict."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pipelines.correlation.kernels import Fit, Matches, Texture
from pipelines.correlation.settings import CorrelationSettings
from pipelines.verdict import Verdict

MEDIAN_FROM = 5
"""A running median counts from this many frames on."""


def median(values: Sequence[float]) -> float:
    """Median of the finite values (the higher one of the middle pair), NaN if there is none."""
    finite = sorted(v for v in values if v == v)
    return finite[len(finite) // 2] if finite else math.nan


def alarms_of_match(
    s: CorrelationSettings,
    m: Matches,
    texture: Texture,
    peak_offset_px: NDArray[np.int64],
) -> Verdict:
    """The checks on the correlation surfaces and on the texture of all fragments.

    `peak_offset_px` [F, 2] is the peak's position in its surface, from the centre. With the paper's two
    fragments each one counts; with more, the median one, since outliers are left out of the fit.
    """
    alarms = Verdict.OK
    high, low = (max, min) if s.motion == "paper" else (median, median)
    if high(texture.peak_ratio.tolist()) > s.max_peak_ratio:
        alarms |= Verdict.PEAK_AMBIGUOUS
    if not low(m.peak_correlation.tolist()) >= s.min_correlation:
        alarms |= Verdict.LOW_CORRELATION
    if high([max(abs(i), abs(j)) for i, j in peak_offset_px.tolist()]) >= s.search_radius_px:
        alarms |= Verdict.PEAK_AT_BORDER
    margins = []
    for smallest, rms in zip(texture.smallest_eigenvalue.tolist(), m.residual_rms.tolist(), strict=True):
        # noise of σ grey levels alone gives central differences a power of σ²/2, and a residual of √2 σ
        noise = rms * rms / 4.0 if rms == rms else 0.0
        margins.append(smallest - max(s.min_eigenvalue, s.min_texture_ratio * noise))
    if not low(margins) >= 0.0:
        alarms |= Verdict.LOW_TEXTURE
    if high(texture.condition.tolist()) > s.max_condition:
        alarms |= Verdict.APERTURE
    lengths = texture.delta_length_px.tolist()
    diverged = sum(not length <= s.step_limit_px for length in lengths)
    if diverged > (0 if s.motion == "paper" else len(lengths) // 2):
        alarms |= Verdict.SUBPIXEL_DIVERGED
    return alarms


def alarms_of_fit(s: CorrelationSettings, m: Matches, fit: Fit, uncompensated_rad: float, limit_rad: float) -> Verdict:
    """The checks on brightness, rotation and height of a frame whose fragments agree on a motion."""
    alarms = Verdict.OK
    ratios, changes = [], []
    rows = zip(fit.weight.tolist(), m.gain.tolist(), m.offset.tolist(), m.mean_grey.tolist(), strict=True)
    for weight, gain, offset, level in rows:
        if weight > 0.0 and gain > 0.0:
            ratios.append(gain)
            changes.append(abs(level - (level - offset) / gain))
    ratio, change = median(ratios), median(changes)
    if ratio < s.gain_limits[0] or ratio > s.gain_limits[1] or change > s.max_level_change:
        alarms |= Verdict.EXPOSURE_JUMP
    if abs(uncompensated_rad) > limit_rad:
        alarms |= Verdict.ROTATION_BEYOND_LIMIT
    if abs(fit.scale - 1.0) > s.max_scale_change:
        alarms |= Verdict.HEIGHT_CHANGE
    return alarms


def alarms_over_time(
    s: CorrelationSettings,
    residual: float,
    residuals: Sequence[float],
    gradient: float,
    gradients: Sequence[float],
    dt_s: float,
    intervals_s: Sequence[float],
) -> Verdict:
    """The checks of a frame against the running medians of the frames before it."""
    alarms = Verdict.OK
    if len(residuals) >= MEDIAN_FROM:
        if residual > s.max_residual_ratio * max(median(residuals), 0.3):
            alarms |= Verdict.RESIDUAL_HIGH
        if gradient < s.min_gradient_ratio * median(gradients):
            alarms |= Verdict.BLURRED
    if len(intervals_s) >= 3 and dt_s > s.gap_factor * median(intervals_s):
        alarms |= Verdict.FRAME_GAP
    return alarms
