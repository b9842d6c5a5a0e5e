"""Sparse image alignment: the camera's motion between two frames from the grey levels around known points.

Patches of 4 x 4 px around points of known depth in the reference frame are compared with the current frame. The
minimised sum is Σ (I_cur(π(T p)) - g I_ref(π(exp(ξ) p)) - o)² over the motion T = cur_T_ref, the reference's twist
ξ = (ρ, ω) in m and rad (inverse compositional: T ← T exp(-ξ), so that gradients are those of the reference and are
taken once a level), and, if asked, the gain g and offset o in grey levels. Forster, Pizzoli, Scaramuzza, SVO, ICRA
2014, eqs. 5-10.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipelines.compiled import compiled
from pipelines.geometry import se3_exp, se3_product
from pipelines.semidirect import linear
from pipelines.semidirect.optics import Optics, project
from pipelines.semidirect.pyramid import LEVELS, Grey, Pyramid, level_image, on_level

Floats = NDArray[np.float64]
Longs = NDArray[np.int64]
Flags = NDArray[np.bool_]

SIDE = 4
AREA = SIDE * SIDE
REACH = (SIDE - 1) / 2
"""From the patch's centre to its outermost pixels' centres."""
MIN_PATCHES = 6
"""Fewer visible patches than this do not carry a pose."""
OUTLIER_RATIO = 3.0
"""A patch whose residual is larger than this times the median patch's is no inlier."""
QUANTISATION = 0.3
"""Least residual of a patch in grey levels: rounding to whole levels, 1/sqrt(12)."""


class Stop(IntEnum):
    """Why a level ended."""

    NOT_RUN = 0
    CONVERGED = 1
    ROSE = 2
    ITERATIONS = 3
    SINGULAR = 4
    TOO_FEW_PATCHES = 5


_CONVERGED, _ROSE, _ITERATIONS = int(Stop.CONVERGED), int(Stop.ROSE), int(Stop.ITERATIONS)
_SINGULAR, _TOO_FEW = int(Stop.SINGULAR), int(Stop.TOO_FEW_PATCHES)


class Options(NamedTuple):
    """Levels from `coarsest` to `finest`; most `iterations` a level; converged where |ξ|∞ < `tolerance` (m, rad)."""

    coarsest: int = 4
    finest: int = 2
    iterations: int = 30
    tolerance: float = 1e-6
    illumination: bool = False


class Patches(NamedTuple):
    """The reference on one level: n patches.

    `grey` [n, 16]; `slope` [n, 16, 2] along u and v of the level; `jacobian` [n, 2, 6] of the place on the level by
    ξ; `moment` [n, 4, 4] Σ c cᵀ over the patch, c = (slope u, slope v, grey, 1); `usable` [n]: wholly in the image.
    """

    grey: Floats
    slope: Floats
    jacobian: Floats
    moment: Floats
    usable: Flags


class Residuals(NamedTuple):
    """Residuals r of the patches at one motion.

    `mean_square` [n] of each patch, NaN where it is not seen; `visible` [n]; `gradient` [8] Σ Jᵀ r over (ξ, g, o);
    `cost` the mean square over all pixels of the `seen` visible patches, NaN without any.
    """

    mean_square: Floats
    visible: Flags
    gradient: Floats
    cost: float
    seen: int


class Alignment(NamedTuple):
    """A motion, and how it was found. L levels from `coarsest` to `finest`.

    `cur_t_ref` [4, 4]; `covariance` [6, 6] of the twist ξ (m, rad) with T_true = T exp(ξ): the inverse Hessian times
    the residuals' variance, NaN where it is singular. `cost` [L, iterations + 1]: the mean squared residual (grey
    levels²) before each iteration and after the last, NaN beyond; `iterations` [L]; `stop` [L] a `Stop` each. A last
    cost above the one before it was not taken. On the finest level, at the end: `visible` [n], `residual_rms` [n] of
    each patch, `inlier` [n], `final_cost`.
    """

    cur_t_ref: Floats
    covariance: Floats
    gain: float
    offset: float
    cost: Floats
    iterations: Longs
    stop: Longs
    visible: Flags
    residual_rms: Floats
    inlier: Flags
    final_cost: float


@compiled
def reference_patches(reference: Pyramid, level: int, optics: Optics, pixels: Floats, points_in_ref: Floats) -> Patches:
    """Sample the patches around `pixels` [n, 2] (level 0) that show `points_in_ref` [n, 3], with their derivatives.

    ∂(u, v)/∂ξ = 2^-l · ∂π/∂p · [I | -hat(p)]; slopes are central differences of the interpolated patch.
    """
    n = len(pixels)
    image = level_image(reference, level)
    patches = Patches(
        np.zeros((n, AREA)), np.zeros((n, AREA, 2)), np.zeros((n, 2, 6)), np.zeros((n, 4, 4)), np.zeros(n, np.bool_)
    )
    window = np.empty((SIDE + 2, SIDE + 2))
    for i in range(n):
        u, v = on_level(pixels[i, 0], level), on_level(pixels[i, 1], level)
        x, y, z = points_in_ref[i]
        place = project(optics, x, y, z)
        if not (_inside(image, u, v, REACH + 1) and math.isfinite(place.u)):
            continue
        patches.usable[i] = True
        _sample_square(image, u - REACH - 1, v - REACH - 1, window)
        _derive(window, patches.grey[i], patches.slope[i], patches.moment[i])
        _by_twist(place.u_x, place.u_y, place.u_z, x, y, z, 1 << level, patches.jacobian[i, 0])
        _by_twist(place.v_x, place.v_y, place.v_z, x, y, z, 1 << level, patches.jacobian[i, 1])
    return patches


@compiled
def residuals(
    current: Pyramid,
    level: int,
    optics: Optics,
    patches: Patches,
    points_in_ref: Floats,
    cur_T_ref: Floats,
    gain: float,
    offset: float,
) -> Residuals:
    """Residuals r = I_cur(π(T p)) - g I_ref - o of every patch that the current frame shows wholly, and its sums."""
    n = len(points_in_ref)
    image = level_image(current, level)
    mean_square, visible = np.full(n, math.nan), np.zeros(n, np.bool_)
    gradient, total, count = np.zeros(8), 0.0, 0
    window = np.empty((SIDE, SIDE))
    t = cur_T_ref
    for i in range(n):
        if not patches.usable[i]:
            continue
        x, y, z = points_in_ref[i]
        place = project(
            optics,
            t[0, 0] * x + t[0, 1] * y + t[0, 2] * z + t[0, 3],
            t[1, 0] * x + t[1, 1] * y + t[1, 2] * z + t[1, 3],
            t[2, 0] * x + t[2, 1] * y + t[2, 2] * z + t[2, 3],
        )
        u, v = on_level(place.u, level), on_level(place.v, level)
        if not _inside(image, u, v, REACH):
            continue
        visible[i] = True
        count += 1
        _sample_square(image, u - REACH, v - REACH, window)
        grey, slope, jacobian = patches.grey[i], patches.slope[i], patches.jacobian[i]
        square, by_u, by_v, by_gain, by_offset = 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(AREA):
            r = window[k // SIDE, k % SIDE] - gain * grey[k] - offset
            square += r * r
            by_u += slope[k, 0] * r
            by_v += slope[k, 1] * r
            by_gain += grey[k] * r
            by_offset += r
        for a in range(6):
            gradient[a] += jacobian[0, a] * by_u + jacobian[1, a] * by_v
        gradient[6] += by_gain
        gradient[7] += by_offset
        mean_square[i] = square / AREA
        total += square
    return Residuals(mean_square, visible, gradient, total / (AREA * count), count)


@compiled
def hessian(patches: Patches, visible: Flags) -> Floats:
    """Σ Jᵀ J [8, 8] over (ξ, g, o) of the visible patches, lower triangle: Bᵀ M B with the patch's moment M.

    B = diag(∂(u, v)/∂ξ, I): all pixels of a patch share the derivative of its centre.
    """
    h = np.zeros((8, 8))
    column = np.empty(4)
    for i in range(len(visible)):
        if not visible[i]:
            continue
        j, m = patches.jacobian[i], patches.moment[i]
        for a in range(8):
            for k in range(4):
                column[k] = j[0, a] * m[k, 0] + j[1, a] * m[k, 1] if a < 6 else m[k, a - 4]
            for b in range(a, 6):
                h[b, a] += j[0, b] * column[0] + j[1, b] * column[1]
            for b in range(max(a, 6), 8):
                h[b, a] += column[b - 4]
    return h


class Level(NamedTuple):
    """What one level yields: the motion, why it ended, and the residuals and their Hessian there."""

    cur_t_ref: Floats
    gain: float
    offset: float
    iterations: int
    stop: int
    hessian: Floats
    mean_square: Floats
    visible: Flags
    cost: float


def align(
    reference: Pyramid,
    current: Pyramid,
    optics: Optics,
    pixels: Floats,
    points_in_ref: Floats,
    start: Floats,
    options: Options,
) -> Alignment:
    """The motion cur_T_ref [4, 4] that makes the current frame agree with the reference, from `start` on.

    A level ends when |ξ|∞ < tolerance, when the cost rises (the iteration before counts), at the most iterations,
    when the Hessian is singular, or when fewer than `MIN_PATCHES` are seen.

    Args:
        reference: the frame before.
        current: the frame whose motion is asked; of the same size.
        optics: the camera.
        pixels: places (u, v) [n, 2] of the points in the reference, level 0.
        points_in_ref: the points [n, 3] in the reference camera's axes, m, on the rays of those pixels.
        start: the first guess [4, 4].
        options: levels and stop rules.

    Raises:
        ValueError: frames of two sizes, numbers of pixels and points that differ, levels that no pyramid has.
    """
    if len(pixels) != len(points_in_ref):
        raise ValueError(f"{len(pixels)} pixels and {len(points_in_ref)} points: give one point per pixel")
    if reference[1:] != current[1:]:
        raise ValueError(f"frames of {reference[1:]} and {current[1:]} (height, width): align frames of one size")
    if not 0 <= options.finest <= options.coarsest < LEVELS:
        raise ValueError(f"levels {options.coarsest} to {options.finest}: take them from {LEVELS - 1} down to 0")
    levels = range(options.coarsest, options.finest - 1, -1)
    cost = np.full((len(levels), options.iterations + 1), np.nan)
    iterations, stop = np.zeros(len(levels), np.int64), np.zeros(len(levels), np.int64)
    motion = (start, 1.0, 0.0)
    for k, level in enumerate(levels):
        found = align_level(reference, current, level, optics, pixels, points_in_ref, *motion, options, cost[k])
        motion = (found.cur_t_ref, found.gain, found.offset)
        iterations[k], stop[k] = found.iterations, found.stop
    rms = np.sqrt(found.mean_square)
    middle = float(np.median(rms[found.visible])) if found.visible.any() else np.nan
    return Alignment(
        found.cur_t_ref,
        _covariance(found, 8 if options.illumination else 6),
        found.gain,
        found.offset,
        cost,
        iterations,
        stop,
        found.visible,
        rms,
        rms <= OUTLIER_RATIO * max(middle, QUANTISATION),
        found.cost,
    )


@compiled
def align_level(
    reference: Pyramid,
    current: Pyramid,
    level: int,
    optics: Optics,
    pixels: Floats,
    points_in_ref: Floats,
    start: Floats,
    gain: float,
    offset: float,
    options: Options,
    cost: Floats,
) -> Level:
    """Gauss-Newton on one level; `cost` [iterations + 1] takes the cost before each iteration and the last."""
    unknowns = 8 if options.illumination else 6
    patches = reference_patches(reference, level, optics, pixels, points_in_ref)
    transform, before, before_gain, before_offset = start, start, gain, offset
    stop, done = _ITERATIONS, 0
    found = residuals(current, level, optics, patches, points_in_ref, transform, gain, offset)
    for i in range(options.iterations + 1):
        cost[i] = found.cost
        if found.seen < MIN_PATCHES or (i > 0 and found.cost > cost[i - 1]):
            stop = _TOO_FEW if found.seen < MIN_PATCHES else _ROSE
            transform, gain, offset = before, before_gain, before_offset
            found = residuals(current, level, optics, patches, points_in_ref, transform, gain, offset)
            break
        if stop == _CONVERGED or i == options.iterations:
            break
        h, step = hessian(patches, found.visible), found.gradient
        if not linear.factor(h, unknowns):
            stop = _SINGULAR
            break
        linear.substitute(h, step, unknowns)
        xi = step[:6] / gain  # the reference's slopes appear in the current frame times the gain
        before, before_gain, before_offset = transform, gain, offset
        transform = se3_product(transform, se3_exp(-xi))
        if options.illumination:
            gain, offset = gain + step[6], offset + step[7]
        found = residuals(current, level, optics, patches, points_in_ref, transform, gain, offset)
        done = i + 1
        if linear.largest(xi) < options.tolerance:
            stop = _CONVERGED
    h = hessian(patches, found.visible)
    return Level(transform, gain, offset, done, stop, h, found.mean_square, found.visible, found.cost)


def _covariance(found: Level, unknowns: int) -> Floats:
    """σ² H⁻¹ [6, 6] of the twist, with σ² = Σ r²/(pixels - unknowns).

    Right for patches on whole pixels. Between them, bilinear samples smooth the noise that σ² is taken from, but
    not the slow part of it that moves the pose: the covariance is then 1.5 to 1.7 times too small.
    """
    pixels = AREA * int(found.visible.sum())
    if pixels <= unknowns:
        return np.full((6, 6), np.nan)
    variance = found.cost * pixels / (pixels - unknowns)
    return linear.inverse(found.hessian, unknowns)[:6, :6] * (variance / found.gain**2)


@compiled
def _inside(image: Grey, u: float, v: float, margin: float) -> bool:
    """Whether a square of that margin around a place has all its bilinear neighbours; False for NaN."""
    rows, columns = image.shape
    return bool(margin <= u < columns - 1 - margin and margin <= v < rows - 1 - margin)


@compiled
def _sample_square(image: Grey, left: float, top: float, out: Floats) -> None:
    """Bilinear samples one pixel apart; all share the four weights of the first."""
    column, row = int(left), int(top)
    f, g = left - column, top - row
    w00, w01, w10, w11 = (1 - f) * (1 - g), f * (1 - g), (1 - f) * g, f * g
    for y in range(out.shape[0]):
        above, below = image[row + y], image[row + y + 1]
        for x in range(out.shape[1]):
            c = column + x
            out[y, x] = w00 * above[c] + w01 * above[c + 1] + w10 * below[c] + w11 * below[c + 1]


@compiled
def _derive(window: Floats, grey: Floats, slope: Floats, moment: Floats) -> None:
    """Grey levels, central differences and Σ c cᵀ of the inner pixels of a window."""
    for k in range(AREA):
        y, x = k // SIDE + 1, k % SIDE + 1
        grey[k] = window[y, x]
        slope[k, 0] = (window[y, x + 1] - window[y, x - 1]) / 2
        slope[k, 1] = (window[y + 1, x] - window[y - 1, x]) / 2
        c = (slope[k, 0], slope[k, 1], grey[k], 1.0)
        for a in range(4):
            for b in range(4):
                moment[a, b] += c[a] * c[b]


@compiled
def _by_twist(by_x: float, by_y: float, by_z: float, x: float, y: float, z: float, scale: int, row: Floats) -> None:
    """One row [6] of ∂π/∂p · [I | -hat(p)] over the level's scale."""
    row[0], row[1], row[2] = by_x / scale, by_y / scale, by_z / scale
    row[3] = (by_z * y - by_y * z) / scale
    row[4] = (by_x * z - by_z * x) / scale
    row[5] = (by_y * x - by_x * y) / scale
