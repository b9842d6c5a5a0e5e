"""The first map, from points matched between two views: motion by a homography (a plane) or an essential matrix.

With x_second = R x_first + t and the plane n·x = d in the first view's axes, its points at unit depth move by
H = R + t nᵀ/d. The scale is free: the map is scaled so that its median depth in the first view is 1.

R. Hartley, A. Zisserman, "Multiple View Geometry", 2nd ed., 2003 (normalised DLT 4.1, Sampson error 11.4);
E. Malis, M. Vargas, "Deeper understanding of the homography decomposition", INRIA RR-6303, 2007 (OpenCV's
decomposition: four solutions, of which at most two have all points before the cameras); P. Torr, "An assessment of
information criteria for motion model selection", CVPR 1997 (GRIC, which of the two models holds).

Matched points are rays at unit depth, (a, b), of undistorted cameras; pixels are unit depth times the focal length.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

CONFIDENCE = 0.999
ITERATIONS = 2000
SEED = 1
"""Of OpenCV's random samples: the same points give the same start."""
ALMOST_ALL = 0.95
"""Share of the points that a solution must have before both cameras; noise may carry the rest behind."""


class Model(StrEnum):
    """Which geometry relates the two views."""

    AUTO = "auto"
    """The one with the lower GRIC."""
    PLANE = "plane"
    SPACE = "space"


class StartOutcome(StrEnum):
    """Whether there is a first map, or why there is none."""

    STARTED = "started"
    FEW_MATCHES = "few-matches"
    LITTLE_MOTION = "little-motion"
    """The matches have moved too little: wait for a later view."""
    LITTLE_PARALLAX = "little-parallax"
    """The motion was a turn, which gives no depth."""
    NO_MODEL = "no-model"
    """No homography or essential matrix was found, or none of its solutions has the points before both cameras."""
    FEW_INLIERS = "few-inliers"


class StartLimits(NamedTuple):
    """Settings of a start, px at level 0 of the camera's own size."""

    least_matches: int = 50
    least_motion_px: float = 50.0
    least_parallax_px: float = 10.0
    threshold_px: float = 2.0
    least_inliers: int = 40
    sigma_px: float = 0.5
    """Standard deviation of a matched coordinate, for the choice of the model."""


class Candidate(NamedTuple):
    """One solution of a decomposition: R [3, 3], t/d [3], n [3] (NaN for an essential matrix).

    `in_front` is the share of the inliers before both cameras, `towards_hint` the cosine between n and the normal
    that was expected.
    """

    rotation: Floats
    translation: Floats
    normal: Floats
    in_front: float
    towards_hint: float


@dataclass(frozen=True, slots=True)
class Start:
    """Two views' motion and the first map; NaN from where a start ended.

    Attributes:
        outcome: whether there is a map.
        model: the geometry it was taken from.
        rotation: R of x_second = R x_first + t [3, 3].
        translation: t [3], in units of the median depth.
        normal: n of the plane n·x = d in the first view [3]; NaN for Model.SPACE.
        distance: d, in units of the median depth.
        points: in the first view's axes [n, 3], NaN for matches that are not in the map.
        inlier: matches that are in the map [n].
        error_px: larger reprojection error of the two views [n].
        motion_px: median displacement of the matches.
        parallax_px: median displacement of the inliers that R does not explain.
        gric_plane: criterion of the homography; lower is better.
        gric_space: criterion of the essential matrix.
        matrix: the homography, scaled to R + t nᵀ/d, or the essential matrix [3, 3].
        candidates: all solutions of the decomposition, the chosen one first.
    """

    outcome: StartOutcome
    model: Model
    rotation: Floats
    translation: Floats
    normal: Floats
    distance: float
    points: Floats
    inlier: Bools
    error_px: Floats
    motion_px: float
    parallax_px: float
    gric_plane: float
    gric_space: float
    matrix: Floats
    candidates: tuple[Candidate, ...]


class _Fit(NamedTuple):
    """A model fitted to the matches: R, t (over d, or of length 1), n, its matrix, candidates, error of each match.

    The error is that of one view's noise: a deviation of one coordinate in both views shows with its own size.
    """

    rotation: Floats
    translation: Floats
    normal: Floats
    matrix: Floats
    candidates: tuple[Candidate, ...]
    error: Floats


def start(
    first: Floats,
    second: Floats,
    focal_px: float,
    *,
    model: Model = Model.AUTO,
    expected_normal: tuple[float, float, float] = (0.0, 0.0, 1.0),
    limits: StartLimits | None = None,
) -> Start:
    """The motion between two views and the first map.

    Args:
        first: matched points of the first view at unit depth [n, 2].
        second: the same points in the second view [n, 2].
        focal_px: focal length.
        model: the geometry, or the choice between both.
        expected_normal: about where the plane's normal points, away from the first camera in its axes. Of two
            solutions that explain the matches alike, that with the nearer normal is right: (0, 0, 1) for a camera that
            looks down on a floor.
        limits: settings.

    Raises:
        ValueError: arrays of different or wrong shape, not finite, or a focal length that is not positive.
    """
    x1, x2 = np.asarray(first, np.float64), np.asarray(second, np.float64)
    if x1.ndim != 2 or x1.shape[1] != 2 or x1.shape != x2.shape:
        raise ValueError(f"matched points must be two arrays of one shape [n, 2], not {x1.shape} and {x2.shape}")
    if not (np.all(np.isfinite(x1)) and np.all(np.isfinite(x2)) and focal_px > 0):
        raise ValueError("matched points must be finite and the focal length positive; drop the matches that are not")
    limits = limits or StartLimits()
    motion = float(np.median(np.linalg.norm(x2 - x1, axis=1))) * focal_px if len(x1) else math.nan
    if len(x1) < max(limits.least_matches, 8):
        return _refused(StartOutcome.FEW_MATCHES, model, len(x1), motion)
    if motion < limits.least_motion_px:
        return _refused(StartOutcome.LITTLE_MOTION, model, len(x1), motion)
    hint = np.asarray(expected_normal, np.float64) / np.linalg.norm(expected_normal)
    threshold = limits.threshold_px / focal_px
    plane = plane_motion(x1, x2, threshold, hint) if model != Model.SPACE else None
    space = space_motion(x1, x2, threshold) if model != Model.PLANE else None
    grics = _compared(plane, space, threshold, limits.sigma_px / focal_px)
    if plane and (space is None or grics[0] <= grics[1]):
        fit, chosen = plane, Model.PLANE
    elif space:
        fit, chosen = space, Model.SPACE
    else:
        return _refused(StartOutcome.NO_MODEL, model, len(x1), motion)
    return _mapped(x1, x2, focal_px, limits, fit, chosen, motion, grics)


def _compared(plane: _Fit | None, space: _Fit | None, threshold: float, sigma: float) -> tuple[float, float]:
    """GRIC of both models over the matches that fit either: the others say nothing about which of them holds."""
    fits = [fit.error < threshold for fit in (plane, space) if fit]
    either = np.any(fits, axis=0) if fits else np.zeros(0, np.bool_)
    return (
        gric(plane.error[either], sigma, dimension=2, parameters=8) if plane else math.nan,
        gric(space.error[either], sigma, dimension=3, parameters=5) if space else math.nan,
    )


def _mapped(
    x1: Floats,
    x2: Floats,
    focal_px: float,
    limits: StartLimits,
    fit: _Fit,
    model: Model,
    motion: float,
    grics: tuple[float, float],
) -> Start:
    """The map of a fitted motion, its inliers and its scale."""
    points = triangulated(x1, x2, fit.rotation, fit.translation)
    error = reprojection_error(points, x1, x2, fit.rotation, fit.translation) * focal_px
    inlier = np.asarray(error < limits.threshold_px)  # NaN, a point behind a camera, is none
    turned = _flat(_homogeneous(x1) @ fit.rotation.T)
    shift = np.linalg.norm(x2 - turned, axis=1)[inlier]
    parallax = float(np.median(shift)) * focal_px if len(shift) else 0.0
    outcome = StartOutcome.STARTED
    if np.count_nonzero(inlier) < limits.least_inliers:
        outcome = StartOutcome.FEW_INLIERS
    if parallax < limits.least_parallax_px:
        outcome = StartOutcome.LITTLE_PARALLAX
    started = outcome == StartOutcome.STARTED
    unit = 1.0 / float(np.median(points[inlier, 2])) if started else math.nan
    return Start(
        outcome=outcome,
        model=model,
        rotation=fit.rotation if started else np.full((3, 3), np.nan),
        translation=fit.translation * unit,
        normal=fit.normal,
        distance=unit if model == Model.PLANE else math.nan,
        points=np.where(inlier[:, None], points * unit, np.nan),
        inlier=inlier & started,
        error_px=error,
        motion_px=motion,
        parallax_px=parallax,
        gric_plane=grics[0],
        gric_space=grics[1],
        matrix=fit.matrix,
        candidates=fit.candidates,
    )


def _refused(outcome: StartOutcome, model: Model, n: int, motion: float) -> Start:
    nan, three = math.nan, np.full(3, np.nan)
    square = np.full((3, 3), nan)
    return Start(
        outcome=outcome,
        model=model,
        rotation=square,
        translation=three,
        normal=three,
        distance=nan,
        points=np.full((n, 3), nan),
        inlier=np.zeros(n, np.bool_),
        error_px=np.full(n, nan),
        motion_px=motion,
        parallax_px=nan,
        gric_plane=nan,
        gric_space=nan,
        matrix=square,
        candidates=(),
    )


# ------------------------------------------------------------------------------------ plane


def plane_motion(x1: Floats, x2: Floats, threshold: float, expected_normal: Floats) -> _Fit | None:
    """R, t/d and n from the homography of matches; None if none is found.

    RANSAC finds the inliers, the normalised DLT the homography, its decomposition the solution, and Gauss-Newton on
    the transfer error of the inliers the last digits.
    """
    cv2.setRNGSeed(SEED)
    _, mask = cv2.findHomography(x1, x2, cv2.RANSAC, threshold, maxIters=ITERATIONS, confidence=CONFIDENCE)
    if mask is None or np.count_nonzero(mask) < 8:
        return None
    good = mask.ravel().astype(bool)
    candidates = decomposed(homography(x1[good], x2[good]), x1[good], expected_normal)
    if not candidates or candidates[0].in_front < ALMOST_ALL:
        return None
    best = candidates[0]
    rotation, translation, normal = refined_plane(best, x1[good], x2[good])
    matrix = rotation + np.outer(translation, normal)
    error = np.linalg.norm(_flat(_homogeneous(x1) @ matrix.T) - x2, axis=1) / math.sqrt(2.0)
    return _Fit(rotation, translation, normal, matrix, candidates, error)


def homography(x1: Floats, x2: Floats) -> Floats:
    """H with x2 ~ H x1, by the direct linear transform of normalised points; determinant's sign made positive."""
    t1, t2 = _normalising(x1), _normalising(x2)
    p, q = _homogeneous(x1) @ t1.T, _homogeneous(x2) @ t2.T
    zero = np.zeros_like(p)
    rows = np.vstack([np.hstack([zero, -p, q[:, 1:2] * p]), np.hstack([p, zero, -q[:, :1] * p])])
    h = np.linalg.inv(t2) @ np.linalg.svd(rows, full_matrices=False)[2][-1].reshape(3, 3) @ t1
    return np.asarray(h * np.sign(np.linalg.det(h)))


def decomposed(matrix: Floats, x1: Floats, expected_normal: Floats) -> tuple[Candidate, ...]:
    """The solutions R, t/d, n of a homography, best first.

    Before both cameras a point has n·x > 0 and (R x + t (n·x)/d)_z > 0. Solutions that have nearly all points there
    come first, among them the one whose normal is nearest to the expected one.
    """
    points, found = _homogeneous(x1), []
    _, rotations, translations, normals = cv2.decomposeHomographyMat(matrix, np.eye(3))
    for r, t, n in zip(rotations, translations, normals, strict=True):
        t, n = t.ravel(), n.ravel()
        facing = points @ n
        front = float(np.mean((facing > 0) & (points @ r[2] + t[2] * facing > 0)))
        found.append(Candidate(r, t, n, front, float(n @ expected_normal)))
    return tuple(sorted(found, key=lambda c: (min(c.in_front, ALMOST_ALL), c.towards_hint), reverse=True))


def refined_plane(c: Candidate, x1: Floats, x2: Floats) -> tuple[Floats, Floats, Floats]:
    """R, t/d, n that make the squared transfer error least, from a solution near it.

    Eight unknowns: a turn, t/d and the normal's shift within its tangent plane.
    """
    points, tangent = _homogeneous(x1), _tangent(c.normal)

    def moved(p: Floats) -> tuple[Floats, Floats, Floats]:
        n = c.normal + tangent @ p[6:]
        return Rotation.from_rotvec(p[:3]).as_matrix() @ c.rotation, c.translation + p[3:6], n / np.linalg.norm(n)

    def residuals(p: Floats) -> Floats:
        r, t, n = moved(p)
        return np.asarray((_flat(points @ (r + np.outer(t, n)).T) - x2).ravel())

    solved = least_squares(residuals, np.zeros(8), method="lm", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    return moved(solved.x)


# ------------------------------------------------------------------------------------ space


def space_motion(x1: Floats, x2: Floats, threshold: float) -> _Fit | None:
    """R and t (of length 1) from the essential matrix of matches; None if none is found.

    RANSAC on five points finds the inliers, OpenCV the solution with the points before both cameras, and
    Gauss-Newton on the Sampson error of the inliers the rest.
    """
    cv2.setRNGSeed(SEED)
    essential, mask = cv2.findEssentialMat(
        x1, x2, np.eye(3), method=cv2.RANSAC, prob=CONFIDENCE, threshold=threshold, maxIters=ITERATIONS
    )
    if essential is None or essential.shape != (3, 3) or np.count_nonzero(mask) < 8:
        return None
    good = mask.ravel().astype(bool)
    one, two, t = cv2.decomposeEssentialMat(essential)
    solutions = [_judged(r, s * t.ravel(), x1[good], x2[good]) for r in (one, two) for s in (1.0, -1.0)]
    candidates = tuple(sorted(solutions, key=lambda c: c.in_front, reverse=True))
    if candidates[0].in_front < ALMOST_ALL:
        return None
    rotation, translation = refined_space(candidates[0], x1[good], x2[good])
    matrix = skew(translation) @ rotation
    error = np.abs(sampson(matrix, x1, x2))
    return _Fit(rotation, translation, np.full(3, np.nan), matrix, candidates, error)


def _judged(r: Floats, t: Floats, x1: Floats, x2: Floats) -> Candidate:
    front = float(np.mean(np.isfinite(triangulated(x1, x2, r, t)[:, 0])))
    return Candidate(r, t, np.full(3, np.nan), front, math.nan)


def refined_space(c: Candidate, x1: Floats, x2: Floats) -> tuple[Floats, Floats]:
    """R and t of length 1 that make the squared Sampson error least, from a solution near it."""
    tangent = _tangent(c.translation)

    def moved(p: Floats) -> tuple[Floats, Floats]:
        t = c.translation + tangent @ p[3:]
        return Rotation.from_rotvec(p[:3]).as_matrix() @ c.rotation, t / np.linalg.norm(t)

    def residuals(p: Floats) -> Floats:
        r, t = moved(p)
        return sampson(skew(t) @ r, x1, x2)

    solved = least_squares(residuals, np.zeros(5), method="lm", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    return moved(solved.x)


def sampson(matrix: Floats, x1: Floats, x2: Floats) -> Floats:
    """Signed distance of matches from x2ᵀ E x1 = 0 to first order [n], at unit depth."""
    p, q = _homogeneous(x1), _homogeneous(x2)
    ep, eq = p @ matrix.T, q @ matrix
    return np.asarray(np.sum(q * ep, axis=1) / np.sqrt(np.sum(ep[:, :2] ** 2, 1) + np.sum(eq[:, :2] ** 2, 1)))


# ----------------------------------------------------------------------------------- shared


def gric(error: Floats, sigma: float, *, dimension: int, parameters: int) -> float:
    """Torr's criterion Σ min(e²/σ², 2 (4 - d)) + n d ln 4 + k ln 4n of two views' matches.

    Args:
        error: distance of each match from the model [n].
        sigma: standard deviation of a coordinate, in the error's unit.
        dimension: d of the model, 2 for a homography and 3 for an essential matrix.
        parameters: k of the model.
    """
    n = len(error)
    fit = np.minimum((error / sigma) ** 2, 2.0 * (4 - dimension)).sum()
    return float(fit + n * dimension * math.log(4.0) + parameters * math.log(4.0 * n))


def triangulated(x1: Floats, x2: Floats, rotation: Floats, translation: Floats) -> Floats:
    """Points in the first view's axes [n, 3], nearest to both rays; NaN where they meet behind a camera or not at all.

    Midpoint method: z1, z2 of min |z1 Rx1 + t - z2 x2|, then the mean of both ends.
    """
    f, g = _homogeneous(x1) @ rotation.T, _homogeneous(x2)
    ff, gg, fg = np.sum(f * f, 1), np.sum(g * g, 1), np.sum(f * g, 1)
    ft, gt = f @ translation, g @ translation
    det = ff * gg - fg * fg
    with np.errstate(divide="ignore", invalid="ignore"):
        z1, z2 = (fg * gt - gg * ft) / det, (ff * gt - fg * ft) / det
        middle = 0.5 * (z1[:, None] * f + translation + z2[:, None] * g)
    points = (middle - translation) @ rotation
    good = (det > 1e-14 * ff * gg) & (z1 > 0) & (z2 > 0) & (points[:, 2] > 0) & (middle[:, 2] > 0)
    return np.where(good[:, None], points, np.nan)


def reprojection_error(points: Floats, x1: Floats, x2: Floats, rotation: Floats, translation: Floats) -> Floats:
    """The larger of both views' distances of a point from its match [n], at unit depth; NaN for a NaN point."""
    there = points @ rotation.T + translation
    return np.asarray(np.maximum(np.linalg.norm(_flat(points) - x1, axis=1), np.linalg.norm(_flat(there) - x2, axis=1)))


def skew(v: Floats) -> Floats:
    """The matrix [v]× of the cross product with v [3]."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def _homogeneous(x: Floats) -> Floats:
    return np.column_stack([x, np.ones(len(x))])


def _flat(points: Floats) -> Floats:
    return np.asarray(points[:, :2] / points[:, 2:])


def _normalising(x: Floats) -> Floats:
    """The similarity that puts the points' mean at 0 and their mean distance from it to √2."""
    mean = x.mean(axis=0)
    scale = math.sqrt(2.0) / max(float(np.mean(np.linalg.norm(x - mean, axis=1))), 1e-300)
    return np.array([[scale, 0.0, -scale * mean[0]], [0.0, scale, -scale * mean[1]], [0.0, 0.0, 1.0]])


def _tangent(v: Floats) -> Floats:
    """Two unit vectors across v [3, 2]."""
    return np.asarray(np.linalg.svd(v[None, :])[2][1:].T)
