"""The depth filter of a corner: its inverse depth with an inlier ratio, updated by one search after the other.

A measurement x of the inverse depth is good with probability π and then normal about the truth 1/d, else uniform over
the range of inverse depths z_range:

    p(x | d, π) = π N(x; 1/d, τ²) + (1 - π) U(x; 0, z_range)

The posterior of (1/d, π) is held as N(μ, σ²) Beta(a, b), whose first two moments in both are those of the exact
posterior after each measurement (assumed density filtering).

G. Vogiatzis, C. Hernández, "Video-based, real-time multi-view stereo", Image and Vision Computing 29(7), 2011 (model
and moments); C. Forster, M. Pizzoli, D. Scaramuzza, "SVO: Fast semi-direct monocular visual odometry", ICRA 2014
(inverse depth, start, τ, convergence).

Depth is the distance along the corner's unit bearing from the keyframe's centre, in the map's unit of length; inverse
depth is 1 over it. Functions with `_jit` serve Python and compiled code alike.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipelines.compiled import compiled

Floats = NDArray[np.float64]
Longs = NDArray[np.int64]


START_COUNT = 10.0
"""a and b of a new filter: mean inlier ratio ½, with the weight of twenty measurements."""
CONVERGED_SHARE = 1.0 / 200.0
"""A filter has converged when σ is below this share of z_range."""
LEAST_NEAR_DEPTH = 1e-7
"""Where z - τ is not positive the near end of a measurement's interval is put here."""
STATE = 4
"""Rows of a bank: μ, σ², a, b."""


UPDATED, NO_MATCH, CONVERGED, DIVERGED, UNSEEN = range(5)


class Outcome(IntEnum):
    """What became of a filter in a frame."""

    UPDATED = UPDATED
    NO_MATCH = NO_MATCH
    """The search found nothing: b + 1."""
    CONVERGED = CONVERGED
    """Updated, and σ is now small enough for a map point."""
    DIVERGED = DIVERGED
    """The state is not finite, or the inverse depth has left (0, z_range]: the filter goes."""
    UNSEEN = UNSEEN
    """The point is not in this frame, or τ is not below z_range; the belief stays as it was.

    By the formulas such a measurement, of a camera that stands, would count as bad: N(x; μ, τ²) is low everywhere.
    """


class Belief(NamedTuple):
    """State of a filter: inverse depth N(μ, σ²), inlier ratio Beta(a, b)."""

    mu: float
    variance: float
    a: float
    b: float


class Update(NamedTuple):
    """One update: the belief after it and everything computed on the way.

    `fused_mean` m and `fused_variance` s² are those of the belief multiplied with the measurement; `inlier` C1 and
    `outlier` C2 the probabilities that the measurement was good or not; `first` f and `second` e the moments of the
    inlier ratio E[π], E[π²] after it.
    """

    belief: Belief
    fused_mean: float
    fused_variance: float
    inlier: float
    outlier: float
    first: float
    second: float


# -------------------------------------------------------------------------------- equations


@compiled
def started(mean_depth: float, least_depth: float) -> Belief:
    """The belief of a new corner: μ = 1/d_mean, σ² = z_range²/36, a = b = 10, with z_range = 1/d_min."""
    z_range = 1.0 / least_depth
    return Belief(1.0 / mean_depth, z_range * z_range / 36.0, START_COUNT, START_COUNT)


@compiled
def normal_density(x: float, mean: float, variance: float) -> float:
    """N(x; mean, variance)."""
    return math.exp(-0.5 * (x - mean) ** 2 / variance) / math.sqrt(2.0 * math.pi * variance)


@compiled
def updated(p: Belief, x: float, tau_squared: float, z_range: float) -> Update:
    """The belief after the inverse depth `x` of variance τ² (Vogiatzis, Hernández 2011, equations 19-26 and appendix).

    The exact posterior is the mixture C1 N(m, s²) Beta(a+1, b) + C2 N(μ, σ²) Beta(a, b+1); the new belief has its
    means and variances.
    """
    s2 = 1.0 / (1.0 / p.variance + 1.0 / tau_squared)
    m = s2 * (p.mu / p.variance + x / tau_squared)
    c1 = p.a / (p.a + p.b) * normal_density(x, p.mu, p.variance + tau_squared)
    c2 = p.b / (p.a + p.b) / z_range
    c1, c2 = c1 / (c1 + c2), c2 / (c1 + c2)
    n1 = p.a + p.b + 1.0
    n2 = n1 + 1.0
    f = c1 * (p.a + 1.0) / n1 + c2 * p.a / n1
    e = c1 * (p.a + 1.0) * (p.a + 2.0) / (n1 * n2) + c2 * p.a * (p.a + 1.0) / (n1 * n2)
    # C1 (s² + m²) + C2 (σ² + μ²) - μ'² without subtracting squares of nearly equal size
    mu = c1 * m + c2 * p.mu
    variance = c1 * s2 + c2 * p.variance + c1 * c2 * (m - p.mu) ** 2
    a = (e - f) / (f - e / f)
    return Update(Belief(mu, variance, a, a * (1.0 - f) / f), m, s2, c1, c2, f, e)


@compiled
def missed(p: Belief) -> Belief:
    """The belief after a search without a match: b + 1."""
    return Belief(p.mu, p.variance, p.a, p.b + 1.0)


@compiled
def inlier_ratio(p: Belief) -> float:
    """Mean inlier ratio a/(a + b)."""
    return p.a / (p.a + p.b)


@compiled
def judged(p: Belief, z_range: float, converged_share: float) -> int:
    """DIVERGED, CONVERGED or UPDATED: what an update has made of a filter."""
    good = p.variance > 0.0 and p.a > 0.0 and p.b > 0.0 and p.mu > 0.0 and p.mu <= z_range
    if not (good and p.variance < math.inf and p.a < math.inf and p.b < math.inf):
        return DIVERGED
    return CONVERGED if p.variance < (converged_share * z_range) ** 2 else UPDATED


@compiled
def pixel_angle(focal_px: float) -> float:
    """Angle that a pixel at the image's centre spans, 2 atan(1/(2f)), rad."""
    return 2.0 * math.atan(0.5 / focal_px)


@compiled
def angle_between(ax: float, ay: float, az: float, bx: float, by: float, bz: float) -> float:
    """Angle of two vectors in [0, π], exact near its ends too."""
    cx, cy, cz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    return math.atan2(math.sqrt(cx * cx + cy * cy + cz * cz), ax * bx + ay * by + az * bz)


@compiled
def depth_error(bearing: Floats, centre_in_ref: Floats, depth: float, angle_rad: float) -> float:
    """τ: how much farther the point would be if the other camera's ray were turned by an angle (law of sines).

    In the triangle of the baseline t and the rays z f and a = z f - t, with α = ∠(f, t) and β = ∠(a, -t), the turned
    ray meets f at z⁺ = |t| sin β⁺ / sin γ⁺, β⁺ = β + angle, γ⁺ = π - α - β⁺ (SVO, section VI).

    Args:
        bearing: unit bearing f of the corner in its keyframe [3].
        centre_in_ref: centre t of the other camera in the keyframe's axes [3].
        depth: z along the bearing.
        angle_rad: the error of the other ray's direction, usually `pixel_angle`.

    Returns:
        z⁺ - z; inf where the turned ray does not meet f any more.
    """
    tx, ty, tz = centre_in_ref[0], centre_in_ref[1], centre_in_ref[2]
    fx, fy, fz = bearing[0], bearing[1], bearing[2]
    alpha = angle_between(fx, fy, fz, tx, ty, tz)
    beta = angle_between(depth * fx - tx, depth * fy - ty, depth * fz - tz, -tx, -ty, -tz)
    beta_plus = beta + angle_rad
    gamma_plus = math.pi - alpha - beta_plus
    if not gamma_plus > 0.0:
        return math.inf
    return math.sqrt(tx * tx + ty * ty + tz * tz) * math.sin(beta_plus) / math.sin(gamma_plus) - depth


@compiled
def inverse_depth_error(depth: float, tau: float) -> float:
    """τ of the inverse depth, half the interval between 1/(z - τ) and 1/(z + τ)."""
    return 0.5 * (1.0 / max(LEAST_NEAR_DEPTH, depth - tau) - 1.0 / (depth + tau))


# ------------------------------------------------------------------------------------- bank


@compiled
def update_bank(
    state: Floats,
    z_range: Floats,
    inverse_depth: Floats,
    tau: Floats,
    seen: NDArray[np.bool_],
    converged_share: float,
    inlier: Floats,
    outcome: Longs,
) -> None:
    """Update n filters in place.

    Args:
        state: rows μ, σ², a, b [4, n].
        z_range: range of inverse depths of each [n].
        inverse_depth: measured [n], NaN for a search without a match.
        tau: its standard deviation [n].
        seen: which points are in the frame [n]; the others stay as they are.
        converged_share: of z_range, below which σ counts as converged.
        inlier: room for the probability C1 that the measurement was good [n]; NaN where there was none.
        outcome: room for the `Outcome` of each [n].
    """
    for i in range(state.shape[1]):
        inlier[i] = math.nan
        if not seen[i] or tau[i] >= z_range[i]:
            outcome[i] = UNSEEN
            continue
        p = Belief(state[0, i], state[1, i], state[2, i], state[3, i])
        if math.isfinite(inverse_depth[i]):
            done = updated(p, inverse_depth[i], tau[i] * tau[i], z_range[i])
            p, inlier[i] = done.belief, done.inlier
            outcome[i] = judged(p, z_range[i], converged_share)
        else:
            p = missed(p)
            outcome[i] = NO_MATCH
        state[0, i], state[1, i], state[2, i], state[3, i] = p.mu, p.variance, p.a, p.b


class DepthFilters:
    """n independent depth filters, updated in place by one compiled call.

    Args:
        mean_depth: depth at which each starts [n].
        least_depth: the least depth possible for each, d_min [n].
        converged_share: of z_range, below which σ counts as converged; 1/200 as published, 1/800 keeps the scale
            better.

    Attributes:
        state: rows μ, σ², a, b [4, n].
        z_range: range of inverse depths of each [n].
        inlier: probability that the last measurement was good [n], NaN where there was none.
        outcome: `Outcome` of the last frame [n].

    Raises:
        ValueError: a depth that is not positive or not finite, a mean depth below the least, a share not within (0, 1).
    """

    def __init__(self, mean_depth: Floats, least_depth: Floats, *, converged_share: float = CONVERGED_SHARE) -> None:
        mean, least = np.asarray(mean_depth, np.float64), np.asarray(least_depth, np.float64)
        if mean.ndim != 1 or mean.shape != least.shape:
            raise ValueError(f"mean and least depth need one shape [n], not {mean.shape} and {least.shape}")
        if not np.all((least > 0) & (mean >= least) & np.isfinite(mean)):
            raise ValueError("depth filters need 0 < least depth <= mean depth, both finite")
        if not 0.0 < converged_share < 1.0:
            raise ValueError(f"converged_share = {converged_share} must lie within (0, 1); published is 1/200")
        self._share = converged_share
        self.z_range: Floats = 1.0 / least
        count = np.full(len(mean), START_COUNT)
        self.state: Floats = np.stack([1.0 / mean, self.z_range**2 / 36.0, count, count])
        self.inlier: Floats = np.full(len(mean), np.nan)
        self.outcome: Longs = np.full(len(mean), Outcome.UNSEEN, np.int64)

    def __len__(self) -> int:
        return int(self.state.shape[1])

    def update(self, inverse_depth: Floats, tau: Floats, seen: NDArray[np.bool_]) -> None:
        """Take one frame's measurements into all filters.

        Args:
            inverse_depth: measured [n], NaN for a search without a match.
            tau: standard deviation of each [n], positive where there is a measurement.
            seen: which points are in the frame [n].

        Raises:
            ValueError: shapes that do not fit, a measurement whose τ is not positive.
        """
        n = len(self)
        if not inverse_depth.shape == tau.shape == seen.shape == (n,):
            raise ValueError(f"{n} filters need three arrays ({n},): {inverse_depth.shape}, {tau.shape}, {seen.shape}")
        if np.any(seen & np.isfinite(inverse_depth) & ~(tau > 0.0)):
            raise ValueError("a measured inverse depth needs a positive τ")
        update_bank(self.state, self.z_range, inverse_depth, tau, seen, self._share, self.inlier, self.outcome)

    def kept(self, which: NDArray[np.bool_]) -> None:
        """Drop the filters outside `which` [n]."""
        self.state, self.z_range = np.ascontiguousarray(self.state[:, which]), self.z_range[which]
        self.inlier, self.outcome = self.inlier[which], self.outcome[which]

    @property
    def depth(self) -> Floats:
        """1/μ [n]."""
        return np.asarray(1.0 / self.state[0])

    @property
    def sigma(self) -> Floats:
        """Standard deviation of the inverse depth [n]."""
        return np.asarray(np.sqrt(self.state[1]))

    @property
    def ratio(self) -> Floats:
        """Mean inlier ratio a/(a + b) [n]."""
        return np.asarray(self.state[2] / (self.state[2] + self.state[3]))
