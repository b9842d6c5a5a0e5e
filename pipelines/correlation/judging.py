"""The checks on one frame: from the numbers of its match to the flags of the verdict."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit

from pipelines.correlation.equations import rotation_limit
from pipelines.correlation.kernels import QUANTISATION, matches_of
from pipelines.correlation.settings import CorrelationSettings
from pipelines.verdict import Verdict

_jit: Any = njit(cache=True, nogil=True, error_model="numpy")
_matches_of = _jit(matches_of)

# compiled code knows flags as plain integers
_PEAK_AMBIGUOUS = int(Verdict.PEAK_AMBIGUOUS)
_PEAK_AT_BORDER = int(Verdict.PEAK_AT_BORDER)
_LOW_CORRELATION = int(Verdict.LOW_CORRELATION)
_LOW_TEXTURE = int(Verdict.LOW_TEXTURE)
_APERTURE = int(Verdict.APERTURE)
_SUBPIXEL_DIVERGED = int(Verdict.SUBPIXEL_DIVERGED)
_ROTATION_BEYOND_LIMIT = int(Verdict.ROTATION_BEYOND_LIMIT)
_HEIGHT_CHANGE = int(Verdict.HEIGHT_CHANGE)
_NOT_RIGID = int(Verdict.NOT_RIGID)


class Limits(NamedTuple):
    """The thresholds of `CorrelationSettings` in a form that compiled code takes."""

    every_fragment: bool
    max_peak_ratio: float
    min_correlation: float
    search_radius_px: float
    min_eigenvalue: float
    min_texture_ratio: float
    slope_noise: float
    max_condition: float
    step_limit_px: float
    rotation_limit_rad: float
    max_scale_change: float
    max_rigidity_px: float


def limits_of(s: CorrelationSettings) -> Limits:
    """The thresholds of the settings."""
    return Limits(
        s.motion == "paper",
        s.max_peak_ratio,
        s.min_correlation,
        float(s.search_radius_px),
        s.min_eigenvalue,
        s.min_texture_ratio,
        0.5 if s.refiner == "one-step" else 1.3923,  # central differences, slopes of the cubic spline
        s.max_condition,
        s.step_limit_px,
        rotation_limit(s.fragment_side_px),
        s.max_scale_change,
        s.max_rigidity_px,
    )


@_jit
def median(values):  # type: ignore[no-untyped-def]
    """Median of the finite values [n] (the higher one of the middle pair), NaN if there is none."""
    kept = np.sort(values[np.isfinite(values)])
    return kept[len(kept) // 2] if len(kept) else math.nan


@_jit
def _high(values, every):  # type: ignore[no-untyped-def]
    """What counts of numbers that are bad when high: the worst of the paper's two, else the median one."""
    return np.max(values) if every else median(values)


@_jit
def alarms_of_match(surface, hessian, block, centres, search, limits):  # type: ignore[no-untyped-def]
    """The checks on the correlation surfaces and the texture of all fragments, as flags of `Verdict`.

    With the paper's two fragments each one counts; with more, the median one, since outliers are left out.
    """
    m = _matches_of(surface, hessian, block)
    every, count = limits.every_fragment, len(centres)
    alarms = 0
    if _high(m.peak_ratio, every) > limits.max_peak_ratio:
        alarms |= _PEAK_AMBIGUOUS
    if not -_high(-m.peak_correlation, every) >= limits.min_correlation:
        alarms |= _LOW_CORRELATION
    away, missing, diverged = np.empty(count), np.empty(count), 0
    for i in range(count):
        away[i] = max(
            abs(centres[i, 0] + m.peak_px[i, 0] - search[i, 0]), abs(centres[i, 1] + m.peak_px[i, 1] - search[i, 1])
        )
        # noise of σ grey levels alone leaves a residual of √2 σ and gives the slopes a power of slope_noise · σ²
        noise = limits.slope_noise * m.residual_rms[i] ** 2 / 2.0
        missing[i] = max(limits.min_eigenvalue, limits.min_texture_ratio * noise) - m.smallest_eigenvalue[i]
        diverged += not m.delta_length_px[i] <= limits.step_limit_px
    if _high(away, every) >= limits.search_radius_px:
        alarms |= _PEAK_AT_BORDER
    if not _high(missing, every) <= 0.0:
        alarms |= _LOW_TEXTURE
    if _high(m.condition, every) > limits.max_condition:
        alarms |= _APERTURE
    if diverged > (0 if every else count // 2):
        alarms |= _SUBPIXEL_DIVERGED
    return alarms


@_jit
def alarms_of_fit(limits, uncompensated_rad, scale, distance_px):  # type: ignore[no-untyped-def]
    """The checks on rigidity, height and rotation of a frame whose motion was fitted.

    `distance_px` is that of the paper's two fragments, whose disagreement shows as a change of scale.
    """
    alarms = 0
    if limits.every_fragment and abs(scale - 1.0) * distance_px > limits.max_rigidity_px:
        return _NOT_RIGID
    if abs(scale - 1.0) > limits.max_scale_change:
        alarms |= _HEIGHT_CHANGE
    if abs(uncompensated_rad) > limits.rotation_limit_rad:
        alarms |= _ROTATION_BEYOND_LIMIT
    return alarms


class Usual(NamedTuple):
    """Running medians before a frame, NaN at first.

    Residual of the match (grey), sharpness (gradient energy over squared mean grey, 1/px²), interval (s).
    """

    residual: float = math.nan
    sharpness: float = math.nan
    interval_s: float = math.nan


def alarms_over_time(
    s: CorrelationSettings,
    residual: float,
    gain: float,
    sharpness: float,
    dt_s: float,
    level_change: float,
    usual: Usual,
) -> int:
    """The checks of a frame against the running medians of the frames before it, as flags of `Verdict`.

    `gain` is that of the match, `level_change` that of the mean grey level since the frame before. A frame is
    blurred where sharpness and gain fall together: over a smoother surface only the sharpness does.
    """
    alarms = 0
    if abs(level_change) > s.max_level_change:
        alarms |= Verdict.EXPOSURE_JUMP
    if residual > s.max_residual_ratio * max(usual.residual, QUANTISATION):
        alarms |= Verdict.RESIDUAL_HIGH
    if sharpness < s.min_sharpness_ratio * usual.sharpness and gain < s.blurred_gain:
        alarms |= Verdict.BLURRED
    if dt_s > s.gap_factor * usual.interval_s:
        alarms |= Verdict.FRAME_GAP
    return int(alarms)
