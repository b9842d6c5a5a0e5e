"""Refinement by reprojection errors: of one pose, of single points, of keyframes and points together.

The error of an observation is e = (π(T P) - u)/2^l, px of the level l on which the point was matched, with
T = cam_T_world and T ← exp(ξ) T, ξ = (ρ, ω) in m and rad. Forster, Pizzoli, Scaramuzza, SVO, ICRA 2014, section
IV C; bundle adjustment after Triggs, McLauchlan, Hartley, Fitzgibbon, Bundle Adjustment - A Modern Synthesis, 2000.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipelines.compiled import compiled
from pipelines.geometry import se3_exp, se3_product
from pipelines.semidirect import linear
from pipelines.semidirect.optics import Optics, project

Floats = NDArray[np.float64]
Longs = NDArray[np.int64]
Flags = NDArray[np.bool_]

TUKEY = 4.6851
"""Width of Tukey's weights in standard deviations, for 95 % efficiency on normal errors."""
MAD = 1.4826
"""Standard deviation of normal errors by their median absolute value."""
SMALLEST_SCALE_PX = 1e-3
LARGEST_DAMPING = 1e10


class PoseOptions(NamedTuple):
    """Settings of `refine_pose`.

    The first `iterations_mad` take the scale from the errors at the start, the rest `late_scale_px`; a point whose
    error is above `inlier_px` in the end is no inlier.
    """

    iterations: int = 10
    iterations_mad: int = 5
    late_scale_px: float = 0.85
    tolerance: float = 1e-10
    inlier_px: float = 2.0


class Errors(NamedTuple):
    """Errors at one pose: `error` [n, 2] in px, NaN without pixel, and what they sum to.

    `cost` is Tukey's; `gradient` [6] its slope Σ w Jᵀ e; `hessian` [6, 6] the lower triangle of Σ w Jᵀ J.
    """

    error: Floats
    cost: float
    gradient: Floats
    hessian: Floats


class RefinedPose(NamedTuple):
    """A pose from n points.

    `cam_t_world` [4, 4]; `covariance` [6, 6] of ξ with T_true = exp(ξ) T: s² (Σ w Jᵀ J)⁻¹; `scale_px` s: 1.4826
    median |e| of the components in the end; `error_px` [n] and `error_before_px` [n] |e|; `inlier` [n]; `cost`
    [iterations + 1] Tukey's cost before each iteration and after the last, NaN beyond; `scale` [iterations + 1] the
    scale that it was taken with; `iterations`; `solved`: False where the Hessian was singular.
    """

    cam_t_world: Floats
    covariance: Floats
    scale_px: float
    error_px: Floats
    error_before_px: Floats
    inlier: Flags
    cost: Floats
    scale: Floats
    iterations: int
    solved: bool


@compiled
def tukey_cost(e: float, scale: float) -> float:
    """ρ(e) = c²/6 (1 - (1 - (e/c)²)³) up to c = 4.6851 scale, c²/6 beyond: ½ e² near 0."""
    c = TUKEY * scale
    rest = max(1 - (e / c) ** 2, 0.0)
    return c * c / 6 * (1 - rest**3)


@compiled
def tukey_weight(e: float, scale: float) -> float:
    """w(e) = ρ'(e)/e = (1 - (e/c)²)² up to c = 4.6851 scale, 0 beyond."""
    return max(1 - (e / (TUKEY * scale)) ** 2, 0.0) ** 2


@compiled
def observe(
    optics: Optics,
    t: Floats,
    point: Floats,
    pixel: Floats,
    level: int,
    error: Floats,
    by_pose: Floats,
    by_point: Floats,
) -> bool:
    """The error [2] of an observation, ∂e/∂ξ = 2^-l ∂π/∂p [I | -hat(p)] [2, 6] and ∂e/∂P = 2^-l ∂π/∂p R [2, 3].

    False for a point that has no pixel.
    """
    x = t[0, 0] * point[0] + t[0, 1] * point[1] + t[0, 2] * point[2] + t[0, 3]
    y = t[1, 0] * point[0] + t[1, 1] * point[1] + t[1, 2] * point[2] + t[1, 3]
    z = t[2, 0] * point[0] + t[2, 1] * point[1] + t[2, 2] * point[2] + t[2, 3]
    place, size = project(optics, x, y, z), float(1 << level)
    if not math.isfinite(place.u):
        return False
    error[0], error[1] = (place.u - pixel[0]) / size, (place.v - pixel[1]) / size
    for k in range(2):
        by_x = (place.u_x if k == 0 else place.v_x) / size
        by_y = (place.u_y if k == 0 else place.v_y) / size
        by_z = (place.u_z if k == 0 else place.v_z) / size
        by_pose[k, 0], by_pose[k, 1], by_pose[k, 2] = by_x, by_y, by_z
        by_pose[k, 3], by_pose[k, 4], by_pose[k, 5] = by_z * y - by_y * z, by_x * z - by_z * x, by_y * x - by_x * y
        for j in range(3):
            by_point[k, j] = by_x * t[0, j] + by_y * t[1, j] + by_z * t[2, j]
    return True


# -------------------------------------------------------------------------------------- one pose


def refine_pose(
    optics: Optics, points: Floats, pixels: Floats, level: Longs, start: Floats, options: PoseOptions
) -> RefinedPose:
    """The pose cam_T_world [4, 4] of least Tukey cost of the errors of n points, from `start` on.

    Gauss-Newton with weights; an iteration that raises the cost is taken back and ends its phase (scale from the
    errors, then fixed scale).

    Args:
        optics: the camera.
        points: the points [n, 3] in world axes, m.
        pixels: where they were found (u, v) [n, 2], level 0.
        level: the levels [n] on which they were found.
        start: the first guess [4, 4].
        options: settings.

    Raises:
        ValueError: numbers of points, pixels and levels that differ.
    """
    if not len(points) == len(pixels) == len(level):
        raise ValueError(f"{len(points)} points, {len(pixels)} pixels, {len(level)} levels: give one of each per point")
    before = pose_errors(optics, points, pixels, level, start, 1.0)
    cost, scale = np.full((2, options.iterations + 1), np.nan)
    transform, done, solved = start, 0, True
    phases = ((options.iterations_mad, _mad_scale(before.error)), (options.iterations, options.late_scale_px))
    for last, width in phases:
        transform, count, good = _descend(
            optics, points, pixels, level, transform, width, last - done, options.tolerance, cost[done:]
        )
        scale[done : done + count + 1] = width
        done += count
        solved &= good
    scale_px = _mad_scale(pose_errors(optics, points, pixels, level, transform, 1.0).error)
    after = pose_errors(optics, points, pixels, level, transform, scale_px)
    covariance = linear.inverse(after.hessian, 6) * scale_px**2
    px = np.hypot(*after.error.T)
    inlier = px <= options.inlier_px
    return RefinedPose(
        transform, covariance, scale_px, px, np.hypot(*before.error.T), inlier, cost, scale, done, solved
    )


@compiled
def pose_errors(
    optics: Optics, points: Floats, pixels: Floats, level: Longs, cam_T_world: Floats, scale: float
) -> Errors:
    """Errors of n points at a pose, and the weighted normal equations Σ w Jᵀ J, Σ w Jᵀ e."""
    errors, cost = np.full((len(points), 2), math.nan), 0.0
    gradient, h = np.zeros(6), np.zeros((6, 6))
    error, by_pose, by_point = np.empty(2), np.empty((2, 6)), np.empty((2, 3))
    for i in range(len(points)):
        if not observe(optics, cam_T_world, points[i], pixels[i], level[i], error, by_pose, by_point):
            cost += tukey_cost(math.inf, scale)
            continue
        errors[i, 0], errors[i, 1] = error[0], error[1]
        e = math.hypot(error[0], error[1])
        cost += tukey_cost(e, scale)
        w = tukey_weight(e, scale)
        for a in range(6):
            gradient[a] += w * (by_pose[0, a] * error[0] + by_pose[1, a] * error[1])
            for b in range(a + 1):
                h[a, b] += w * (by_pose[0, a] * by_pose[0, b] + by_pose[1, a] * by_pose[1, b])
    return Errors(errors, cost, gradient, h)


@compiled
def _descend(
    optics: Optics,
    points: Floats,
    pixels: Floats,
    level: Longs,
    start: Floats,
    scale: float,
    iterations: int,
    tolerance: float,
    cost: Floats,
) -> tuple[Floats, int, bool]:
    """At most that many iterations at one scale: the pose, how many were taken, whether all had a solution."""
    transform = start
    found = pose_errors(optics, points, pixels, level, transform, scale)
    cost[0] = found.cost
    for i in range(iterations):
        h, step = found.hessian, found.gradient
        if not linear.factor(h, 6):
            return transform, i, False
        linear.substitute(h, step, 6)
        moved = se3_product(se3_exp(-step), transform)
        found = pose_errors(optics, points, pixels, level, moved, scale)
        if found.cost > cost[i]:
            return transform, i, True
        transform, cost[i + 1] = moved, found.cost
        if linear.largest(step) < tolerance:
            return transform, i + 1, True
    return transform, max(iterations, 0), True


def _mad_scale(error: Floats) -> float:
    """1.4826 median |e| over the components of the errors [n, 2], at least `SMALLEST_SCALE_PX`; 1 px without any."""
    sizes = np.abs(error[np.isfinite(error)])
    return max(MAD * float(np.median(sizes)), SMALLEST_SCALE_PX) if len(sizes) else 1.0


# ---------------------------------------------------------------------------------- single points


class Observations(NamedTuple):
    """m observations of n points, ordered by point: those of point i are rows first[i] to first[i + 1] - 1.

    `first` [n + 1]; `frame` [m] the keyframe's row; `pixels` [m, 2] on level 0; `level` [m].
    """

    first: Longs
    frame: Longs
    pixels: Floats
    level: Longs


class RefinedPoints(NamedTuple):
    """`points` [n, 3]; `covariance` [n, 3, 3], m², for errors of 1 px; mean square error `before`, `after` [n], px²."""

    points: Floats
    covariance: Floats
    before: Floats
    after: Floats


@compiled
def refine_points(
    optics: Optics, cams_T_world: Floats, observations: Observations, points: Floats, iterations: int
) -> RefinedPoints:
    """Each point [n, 3] by Gauss-Newton on its own errors in the keyframes [k, 4, 4]; taken back where they grow.

    The covariance is (Σ Jᵀ J)⁻¹, NaN where the observations do not tell the depth.
    """
    n = len(points)
    refined = points.copy()
    covariance, before, after = np.full((n, 3, 3), math.nan), np.full(n, math.nan), np.full(n, math.nan)
    for i in range(n):
        square, gradient, h = _point_errors(optics, cams_T_world, observations, i, refined[i])
        before[i] = after[i] = square
        for _ in range(iterations):
            factored, step = h.copy(), gradient
            if not linear.factor(factored, 3):
                break
            linear.substitute(factored, step, 3)
            moved = refined[i] - step
            square, gradient, moved_h = _point_errors(optics, cams_T_world, observations, i, moved)
            if not square <= after[i]:
                break
            refined[i], after[i], h = moved, square, moved_h
            if linear.largest(step) < 1e-10:
                break
        covariance[i] = linear.inverse(h, 3)
    return RefinedPoints(refined, covariance, before, after)


@compiled
def _point_errors(
    optics: Optics, cams_T_world: Floats, observations: Observations, i: int, point: Floats
) -> tuple[float, Floats, Floats]:
    """Mean square error (px²) of one point, Σ Jᵀ e [3] and Σ Jᵀ J [3, 3]; infinite where a keyframe cannot see it."""
    total, gradient, h = 0.0, np.zeros(3), np.zeros((3, 3))
    error, by_pose, by_point = np.empty(2), np.empty((2, 6)), np.empty((2, 3))
    start, end = observations.first[i], observations.first[i + 1]
    for j in range(start, end):
        t, pixel = cams_T_world[observations.frame[j]], observations.pixels[j]
        if not observe(optics, t, point, pixel, observations.level[j], error, by_pose, by_point):
            return math.inf, gradient, h
        total += error[0] ** 2 + error[1] ** 2
        for a in range(3):
            gradient[a] += by_point[0, a] * error[0] + by_point[1, a] * error[1]
            for b in range(3):
                h[a, b] += by_point[0, a] * by_point[0, b] + by_point[1, a] * by_point[1, b]
    return total / (end - start), gradient, h


# ------------------------------------------------------------------------------- bundle adjustment


class BundleOptions(NamedTuple):
    """Most `iterations`; Huber's width; relative fall of the cost that ends it; an outlier is above `inlier_px`."""

    iterations: int = 10
    huber_px: float = 1.0
    tolerance: float = 1e-6
    inlier_px: float = 2.0


class Bundle(NamedTuple):
    """Keyframes and points, adjusted together.

    `cams_t_world` [k, 4, 4]; `points` [n, 3]; `covariance` [k, 6, 6] of each free pose's ξ for errors of 1 px, 0 for a
    fixed one, NaN where the system is singular; `error_px` [m] and `inlier` [m] of the observations; `cost` [iterations
    + 1] Huber's cost before each iteration and after the last, NaN beyond; `damping` [iterations] λ; `accepted`
    [iterations]; `iterations`.
    """

    cams_t_world: Floats
    points: Floats
    covariance: Floats
    error_px: Floats
    inlier: Flags
    cost: Floats
    damping: Floats
    accepted: Flags
    iterations: int


class Normal(NamedTuple):
    """The normal equations of a bundle, split: f free poses, n points, m observations.

    `poses` [6 f, 6 f] block diagonal, `points` [n, 3, 3], `cross` [m, 6, 3], right sides `pose_side` [6 f] and
    `point_side` [n, 3]; all Σ w Jᵀ J, Σ w Jᵀ e. `cost` of Huber; `error_px` [m].
    """

    poses: Floats
    points: Floats
    cross: Floats
    pose_side: Floats
    point_side: Floats
    cost: float
    error_px: Floats


def oldest_fixed(count: int) -> Flags:
    """Which of `count` keyframes, oldest first, a local bundle adjustment holds: the first two, which fix the scale."""
    return np.arange(count) < 2


def adjust(
    optics: Optics,
    cams_T_world: Floats,
    fixed: Flags,
    observations: Observations,
    points: Floats,
    options: BundleOptions,
) -> Bundle:
    """Free keyframes and all points that they see, by Levenberg-Marquardt on Huber's cost.

    Args:
        optics: the camera.
        cams_T_world: the keyframes' poses [k, 4, 4].
        fixed: which of them [k] are held; see `oldest_fixed`.
        observations: of the n points in the keyframes.
        points: their first guess [n, 3] in world axes, m.
        options: settings.

    Raises:
        ValueError: fewer than two keyframes are held, so that pose or scale of the whole is free; observations that
            are not of these points or keyframes.
    """
    _demand_matching(cams_T_world, fixed, observations, points)
    if np.count_nonzero(fixed) < 2:
        raise ValueError(f"{np.count_nonzero(fixed)} keyframes are fixed: hold two, else the scale is free")
    slot = np.where(fixed, -1, np.cumsum(~fixed) - 1)
    cost = np.full(options.iterations + 1, np.nan)
    damping, accepted = np.full(options.iterations, np.nan), np.zeros(options.iterations, np.bool_)
    poses, places, done, normal = _levenberg_marquardt(
        optics, cams_T_world, slot, observations, points, options, cost, damping, accepted
    )
    free = int(np.count_nonzero(~fixed))
    spread = np.zeros((len(fixed), 6, 6))
    reduced, _ = reduce_to_poses(normal, slot, observations, 0.0)
    whole = linear.inverse(reduced, 6 * free)
    for k in np.flatnonzero(~fixed):
        block = slice(6 * slot[k], 6 * slot[k] + 6)
        spread[k] = whole[block, block]
    inlier = normal.error_px <= options.inlier_px
    return Bundle(poses, places, spread, normal.error_px, inlier, cost, damping, accepted, done)


def _demand_matching(cams_T_world: Floats, fixed: Flags, observations: Observations, points: Floats) -> None:
    """Compiled code does not look whether an index lies in its array."""
    frame = observations.frame
    fits = len(observations.first) == len(points) + 1 and observations.first[-1] == len(frame)
    known = len(frame) == 0 or (frame.min() >= 0 and frame.max() < len(cams_T_world))
    if not (fits and known and len(fixed) == len(cams_T_world)):
        raise ValueError(
            f"{len(frame)} observations of {len(observations.first) - 1} points in keyframes up to "
            f"{frame.max(initial=-1)} do not belong to {len(points)} points and {len(cams_T_world)} keyframes, "
            f"{len(fixed)} of them marked; rebuild the observations after points or keyframes are removed"
        )


@compiled
def huber_cost(e: float, width: float) -> float:
    """ρ(e) = ½ e² up to the width, width (e - width/2) beyond."""
    return 0.5 * e * e if e <= width else width * (e - width / 2)


@compiled
def normal_equations(
    optics: Optics, cams_T_world: Floats, slot: Longs, observations: Observations, points: Floats, huber_px: float
) -> Normal:
    """Linearise all observations; `slot` [k] is a keyframe's place among the free ones, -1 for a held one.

    Huber's weights w = min(1, width/|e|). An observation without pixel (NaN in `error_px`) makes the cost infinite,
    so that no step is taken there.
    """
    n, m, free = len(points), len(observations.frame), 6 * np.count_nonzero(slot >= 0)
    poses, pose_side = np.zeros((free, free)), np.zeros(free)
    blocks, point_side, cross = np.zeros((n, 3, 3)), np.zeros((n, 3)), np.zeros((m, 6, 3))
    error_px, cost = np.full(m, math.nan), 0.0
    error, by_pose, by_point = np.empty(2), np.empty((2, 6)), np.empty((2, 3))
    for i in range(n):
        for j in range(observations.first[i], observations.first[i + 1]):
            t, pixel = cams_T_world[observations.frame[j]], observations.pixels[j]
            if not observe(optics, t, points[i], pixel, observations.level[j], error, by_pose, by_point):
                cost = math.inf
                continue
            e = math.hypot(error[0], error[1])
            error_px[j] = e
            cost += huber_cost(e, huber_px)
            w = 1.0 if e <= huber_px else huber_px / e
            for a in range(3):
                point_side[i, a] += w * (by_point[0, a] * error[0] + by_point[1, a] * error[1])
                for b in range(3):
                    blocks[i, a, b] += w * (by_point[0, a] * by_point[0, b] + by_point[1, a] * by_point[1, b])
            corner = 6 * slot[observations.frame[j]]
            if corner < 0:
                continue
            for a in range(6):
                pose_side[corner + a] += w * (by_pose[0, a] * error[0] + by_pose[1, a] * error[1])
                for b in range(6):
                    poses[corner + a, corner + b] += w * (by_pose[0, a] * by_pose[0, b] + by_pose[1, a] * by_pose[1, b])
                for b in range(3):
                    cross[j, a, b] = w * (by_pose[0, a] * by_point[0, b] + by_pose[1, a] * by_point[1, b])
    return Normal(poses, blocks, cross, pose_side, point_side, cost, error_px)


@compiled
def reduce_to_poses(normal: Normal, slot: Longs, observations: Observations, damping: float) -> tuple[Floats, Floats]:
    """Schur's complement [6 f, 6 f] and its right side [6 f]: U - Σ W V⁻¹ Wᵀ, a - Σ W V⁻¹ b, with U, V times 1 + λ.

    A point whose V has no inverse is left out.
    """
    reduced, side = normal.poses.copy(), normal.pose_side.copy()
    for a in range(len(side)):
        reduced[a, a] *= 1 + damping
    weighted = np.empty((6, 3))
    for i in range(len(normal.points)):
        v = _damped_inverse(normal.points[i], damping)
        if not math.isfinite(v[0, 0]):
            continue
        for j in range(observations.first[i], observations.first[i + 1]):
            row = 6 * slot[observations.frame[j]]
            if row < 0:
                continue
            for a in range(6):
                for b in range(3):
                    c = normal.cross[j, a]
                    weighted[a, b] = c[0] * v[0, b] + c[1] * v[1, b] + c[2] * v[2, b]
                for b in range(3):
                    side[row + a] -= weighted[a, b] * normal.point_side[i, b]
            for k in range(observations.first[i], observations.first[i + 1]):
                column = 6 * slot[observations.frame[k]]
                if column < 0:
                    continue
                for a in range(6):
                    for b in range(6):
                        other = normal.cross[k, b]
                        reduced[row + a, column + b] -= (
                            weighted[a, 0] * other[0] + weighted[a, 1] * other[1] + weighted[a, 2] * other[2]
                        )
    return reduced, side


@compiled
def _damped_inverse(block: Floats, damping: float) -> Floats:
    damped = block.copy()
    for a in range(3):
        damped[a, a] *= 1 + damping
    return linear.inverse(damped, 3)


@compiled
def _stepped(
    normal: Normal,
    slot: Longs,
    observations: Observations,
    pose_step: Floats,
    damping: float,
    cams_T_world: Floats,
    points: Floats,
) -> tuple[Floats, Floats]:
    """Poses and points after a step of the free poses [6 f]; each point follows by V⁻¹ (b - Σ Wᵀ δ)."""
    poses, places = cams_T_world.copy(), points.copy()
    for k in range(len(slot)):
        if slot[k] >= 0:
            poses[k] = se3_product(se3_exp(-pose_step[6 * slot[k] : 6 * slot[k] + 6]), cams_T_world[k])
    for i in range(len(points)):
        v, side = _damped_inverse(normal.points[i], damping), normal.point_side[i].copy()
        if not math.isfinite(v[0, 0]):
            continue
        for j in range(observations.first[i], observations.first[i + 1]):
            row = 6 * slot[observations.frame[j]]
            if row >= 0:
                for a in range(6):
                    for b in range(3):
                        side[b] -= normal.cross[j, a, b] * pose_step[row + a]
        for a in range(3):
            places[i, a] -= v[a, 0] * side[0] + v[a, 1] * side[1] + v[a, 2] * side[2]
    return poses, places


@compiled
def _levenberg_marquardt(
    optics: Optics,
    cams_T_world: Floats,
    slot: Longs,
    observations: Observations,
    points: Floats,
    options: BundleOptions,
    cost: Floats,
    damping: Floats,
    accepted: Flags,
) -> tuple[Floats, Floats, int, Normal]:
    """Poses, points, iterations, the normal equations there; λ falls tenfold after success, rises after failure."""
    poses, places, done, strength = cams_T_world, points, 0, 1e-4
    normal = normal_equations(optics, poses, slot, observations, places, options.huber_px)
    cost[0] = normal.cost
    for i in range(options.iterations):
        done, damping[i] = i + 1, strength
        reduced, step = reduce_to_poses(normal, slot, observations, strength)
        solved = linear.factor(reduced, len(step))
        if solved:
            linear.substitute(reduced, step, len(step))
            new_poses, new_places = _stepped(normal, slot, observations, step, strength, poses, places)
            trial = normal_equations(optics, new_poses, slot, observations, new_places, options.huber_px)
            accepted[i] = trial.cost < normal.cost
        cost[i + 1] = normal.cost
        if not accepted[i]:
            strength *= 10
            if strength > LARGEST_DAMPING:
                break
            continue
        fall = normal.cost - trial.cost
        poses, places, normal, cost[i + 1], strength = new_poses, new_places, trial, trial.cost, strength / 10
        if fall <= options.tolerance * trial.cost:
            break
    return poses, places, done, normal
