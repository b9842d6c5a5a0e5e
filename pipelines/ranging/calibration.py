"""What a mission tells of its own sensors: gyro bias at a stop, focus of expansion, camera's time offset."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from pipelines.ranging.equations import turned

Floats = NDArray[np.float64]


ROBUST_SIGMA = 0.8493
"""σ per axis of the median length of a normal vector in the plane: 1/√(2 ln 2)."""


class Focus(NamedTuple):
    """Focus of expansion [2], px, and its covariance [2, 2]; `lines` tracks were long enough."""

    pixel: Floats
    covariance: Floats
    lines: int


class Offset(NamedTuple):
    """Time offset, s, and the correlation that it reaches."""

    seconds: float
    correlation: float


def gyro_bias(omega: Floats, dt: Floats, sigma_omega: float) -> tuple[float, float]:
    """Bias of ω̃ and its σ, rad/s, from intervals at standstill: the mean, uncertain by σ_ω/√T.

    Args:
        omega: ω̃ of each interval [m], rad/s.
        dt: lengths of the intervals [m], s.
        sigma_omega: spectral density of the gyro's noise, rad/s/√Hz.

    Raises:
        ValueError: there is no interval.
    """
    total = float(dt.sum())
    if not total > 0.0:
        raise ValueError("the gyro's bias needs at least one interval at standstill")
    return float(omega @ dt) / total, sigma_omega / math.sqrt(total)


def focus_from_tracks(
    tracks: Sequence[Floats],
    turns_rad: Sequence[Floats],
    pixel_sigma: float,
    focal_px: float,
    centre_px: tuple[float, float],
    *,
    min_length_px: float = 5.0,
    rounds: int = 5,
) -> Focus:
    """The point from which all tracks of a straight drive spread: where the camera's velocity points.

    Every derotated track lies on a line through it. Lines are fitted by total least squares, the point by least
    squares weighted with each line's uncertainty at that point. Where the camera looks along the travel it is the
    principal point; the filter wants it in its place, or a bias of the range by e / (y - c_y) follows.

    Args:
        tracks: image points of each landmark [m, 2], px.
        turns_rad: turn of the camera at each of them since some common time [m], rad.
        pixel_sigma: noise of an image point per axis, px.
        focal_px: focal length.
        centre_px: principal point.
        min_length_px: shorter tracks tell nothing and are left out.
        rounds: of the weights.

    Raises:
        ValueError: fewer than two tracks are long enough, or they are parallel.
    """
    lines = []
    straight = float(np.mean([turn.mean() for turn in turns_rad])) if turns_rad else 0.0
    for pixel, turn in zip(tracks, turns_rad, strict=True):
        points = turned(pixel, straight - turn, focal_px, centre_px)
        middle = points.mean(axis=0)
        along = np.linalg.svd(points - middle, full_matrices=False)[2][0]
        places = (points - middle) @ along
        if np.ptp(places) >= min_length_px:
            lines.append((middle, along, len(points), float(places @ places)))
    if len(lines) < 2:
        raise ValueError(f"{len(lines)} tracks of {min_length_px} px or more: the focus needs two; drive farther")
    middle = np.array([line[0] for line in lines])
    along = np.array([line[1] for line in lines])
    count, spread = np.array([line[2] for line in lines]), np.array([line[3] for line in lines])
    normal = np.stack([-along[:, 1], along[:, 0]], axis=1)
    focus = np.array(centre_px, dtype=np.float64)
    information = np.zeros((2, 2))
    for _ in range(rounds):
        reach = ((focus - middle) * along).sum(axis=1)
        weight = 1.0 / (pixel_sigma**2 * (1.0 / count + reach**2 / spread))
        information = (normal * weight[:, None]).T @ normal
        if np.linalg.cond(information) > 1e10:
            raise ValueError("all tracks are parallel: the focus of expansion is not determined")
        focus = np.asarray(np.linalg.solve(information, normal.T @ (weight * (normal * middle).sum(axis=1))))
    return Focus(focus, np.asarray(np.linalg.inv(information), dtype=np.float64), len(lines))


def image_turn_rate(before: Floats, after: Floats, dt: float, focal_px: float, centre_px: tuple[float, float]) -> float:
    """ω as the image sees it, rad/s: from the motion of image points [n, 2] within dt, the way ahead taken out.

    By (13a, b) at the middle of the interval Δx = -(f + u²/f) ω dt + s u and Δy = -(u v/f) ω dt + s v, with one
    s = ξ V dt for all points. Least squares, and once more without the points that are off by more than 3 σ, σ by the
    median. A point is left out where a coordinate is NaN; without any the rate is NaN.
    """
    middle, moved = 0.5 * (before + after) - np.array(centre_px), after - before
    known = np.isfinite(moved).all(axis=1)
    u, v = middle[known].T
    turn = np.stack([-(focal_px + u * u / focal_px), -u * v / focal_px], axis=1)
    system, moved = np.stack([turn, np.stack([u, v], axis=1)], axis=2), moved[known]
    kept = np.ones(len(moved), bool)
    found = np.full(2, np.nan)
    for _ in range(2):
        if not kept.any():
            break
        found = np.linalg.lstsq(system[kept].reshape(-1, 2), moved[kept].ravel(), rcond=None)[0]
        off = np.linalg.norm(moved - system @ found, axis=1)
        kept = off <= 3.0 * ROBUST_SIGMA * np.median(off)
    return float(found[0] / dt)


def time_offset(
    first_s: Floats, first: Floats, second_s: Floats, second: Floats, max_offset_s: float, step_s: float = 0.005
) -> Offset:
    """By how much the second signal's stamps are late: first(t) resembles second(t + offset) most.

    The correlation of the two, the second interpolated, is searched on a grid and refined between its points.

    Args:
        first_s: times of the first signal [i], s, such as those of the image's turn rates.
        first: its values [i].
        second_s: times of the second signal [j], s, such as the gyro's.
        second: its values [j].
        max_offset_s: the offset is sought between ± this.
        step_s: of the grid.

    Raises:
        ValueError: a signal does not vary where the two overlap, so that no offset can be told.
    """
    inside = (first_s >= second_s[0] + max_offset_s) & (first_s <= second_s[-1] - max_offset_s)
    times, values = first_s[inside], first[inside]
    if len(times) < 3 or np.ptp(values) == 0.0 or np.ptp(second) == 0.0:
        raise ValueError("the signals do not vary where they overlap: the time offset needs turns")
    values = (values - values.mean()) / values.std()

    def unlike(offset: float) -> float:
        other = np.interp(times + offset, second_s, second)
        spread = float(other.std())
        return -float(((other - other.mean()) * values).mean()) / spread if spread > 0.0 else 0.0

    grid = np.arange(-max_offset_s, max_offset_s + 0.5 * step_s, step_s)
    best = float(grid[np.argmin([unlike(offset) for offset in grid])])
    low, high = max(best - step_s, -max_offset_s), min(best + step_s, max_offset_s)
    found = minimize_scalar(unlike, bounds=(low, high), method="bounded", options={"xatol": 1e-6})
    return Offset(float(found.x), -float(found.fun))
