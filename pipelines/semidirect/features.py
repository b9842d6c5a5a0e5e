"""Corners of a keyframe, and where map points lie in the current frame to a fraction of a pixel.

Corners: FAST finds candidates on the finer levels, the smaller eigenvalue of the structure tensor (Shi, Tomasi 1994)
ranks them, the best of each cell of the image is kept. Alignment: the 8 x 8 patch that a keyframe saw of a
point, warped by the affine map of the point's local plane, is laid over the current frame by inverse-compositional
Gauss-Newton in (δu, δv, mean difference). Forster, Pizzoli, Scaramuzza, SVO, ICRA 2014, section IV.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from pipelines.compiled import compiled
from pipelines.semidirect import linear
from pipelines.semidirect.optics import Optics, project, ray
from pipelines.semidirect.pyramid import Grey, Pyramid, level_image, on_finest, on_level, sample
from pipelines.semidirect.step import Feature

Floats = NDArray[np.float64]
Longs = NDArray[np.int64]
Flags = NDArray[np.bool_]

CORNER_LEVELS = 3
"""Corners are sought, and features aligned, on levels 0 to 2."""
CORNER_BORDER = 8
"""Pixels of a corner's own level that it keeps from the border, for the patch to be warped."""
SIDE = 8
AREA = SIDE * SIDE
REACH = (SIDE - 1) / 2
LARGEST_MAGNIFICATION = 3.0
"""Area of a level's patch pixel, in px² of the current frame, beyond which the next level is searched."""


# --------------------------------------------------------------------------------------- corners


class Corners(NamedTuple):
    """The best corner of each free cell: `pixels` (u, v) [n, 2] on level 0, `level` [n], `score` [n] (grey levels²)."""

    pixels: Floats
    level: Longs
    score: Floats


class CornerOptions(NamedTuple):
    """Side of a cell (px), FAST's threshold (grey levels), least smaller eigenvalue (grey levels²)."""

    cell_px: int = 30
    fast_threshold: int = 7
    min_score: float = 4.0


def cells_of(pyramid: Pyramid, options: CornerOptions) -> tuple[int, int]:
    """Rows and columns of cells that cover the image."""
    return -(-pyramid.height // options.cell_px), -(-pyramid.width // options.cell_px)


def occupied_cells(pyramid: Pyramid, pixels: Floats, options: CornerOptions) -> Flags:
    """Which cells [rows, columns] hold one of the pixels (u, v) [n, 2] of level 0."""
    occupied = np.zeros(cells_of(pyramid, options), np.bool_)
    column, row = np.floor((pixels + 0.5) / options.cell_px).astype(np.int64).T
    inside = (row >= 0) & (row < occupied.shape[0]) & (column >= 0) & (column < occupied.shape[1])
    occupied[row[inside], column[inside]] = True
    return occupied


def corners(pyramid: Pyramid, occupied: Flags, options: CornerOptions) -> Corners:
    """The best corner over levels 0 to 2 of each cell that is not occupied.

    Raises:
        ValueError: `occupied` has not the shape of `cells_of`.
    """
    rows, columns = cells_of(pyramid, options)
    if occupied.shape != (rows, columns):
        raise ValueError(f"occupied cells {list(occupied.shape)}: this image has [{rows}, {columns}] cells")
    best = np.full((rows * columns, 4), -np.inf)
    detector = cv2.FastFeatureDetector.create(options.fast_threshold)
    for level in range(CORNER_LEVELS):
        image = level_image(pyramid, level)
        found = np.asarray(cv2.KeyPoint.convert(detector.detect(image)), np.float32)
        if len(found):
            keep_best_of_cells(image, level, found, occupied, options.cell_px, best)
    best = best[best[:, 0] > options.min_score]
    return Corners(best[:, 1:3].copy(), best[:, 3].astype(np.int64), best[:, 0].copy())


@compiled
def keep_best_of_cells(
    image: Grey, level: int, found: NDArray[np.float32], occupied: Flags, cell_px: int, best: Floats
) -> None:
    """Enter the corners [n, 2] of one level that beat their cells' best rows (score, u, v, level) [cells, 4]."""
    rows, columns = image.shape
    for i in range(len(found)):
        u, v = int(found[i, 0]), int(found[i, 1])
        if not (CORNER_BORDER <= u < columns - CORNER_BORDER and CORNER_BORDER <= v < rows - CORNER_BORDER):
            continue
        finest_u, finest_v = on_finest(u, level), on_finest(v, level)
        row, column = int((finest_v + 0.5) / cell_px), int((finest_u + 0.5) / cell_px)
        if occupied[row, column]:
            continue
        score, winner = corner_score(image, u, v), best[row * occupied.shape[1] + column]
        if score > winner[0]:
            winner[0], winner[1], winner[2], winner[3] = score, finest_u, finest_v, level


@compiled
def corner_score(image: Grey, u: int, v: int) -> float:
    """The smaller eigenvalue of the mean Σ d dᵀ/(2 · 64) over 8 x 8 px, d the differences of the neighbours."""
    xx, xy, yy = 0.0, 0.0, 0.0
    for y in range(v - 4, v + 4):
        above, here, below = image[y - 1], image[y], image[y + 1]
        for x in range(u - 4, u + 4):
            dx, dy = float(here[x + 1]) - float(here[x - 1]), float(below[x]) - float(above[x])
            xx += dx * dx
            xy += dx * dy
            yy += dy * dy
    return (xx + yy - math.sqrt((xx - yy) ** 2 + 4 * xy * xy)) / (4 * AREA)


# ------------------------------------------------------------------------------- point and keyframe


class Views(NamedTuple):
    """For each point the observation from the nearest angle: its row, -1 without any; the angle's cosine."""

    observation: Longs
    cosine: Floats


@compiled
def nearest_views(points: Floats, centre: Floats, first: Longs, frame: Longs, frame_centres: Floats) -> Views:
    """Which keyframe saw each point from nearest to where the camera is now.

    Args:
        points: n points [n, 3] in world axes, m.
        centre: the camera's centre [3] now.
        first: the observations of point i are rows first[i] to first[i + 1] - 1; [n + 1].
        frame: the keyframe of each observation.
        frame_centres: the keyframes' centres [k, 3].
    """
    n = len(points)
    observation, cosine = np.empty(n, np.int64), np.empty(n)
    for i in range(n):
        observation[i], cosine[i] = nearest_view(points[i], centre, first[i], first[i + 1], frame, frame_centres)
    return Views(observation, cosine)


@compiled
def nearest_view(
    point: Floats, centre: Floats, begin: int, end: int, frame: Longs, frame_centres: Floats
) -> tuple[int, float]:
    """Of the observations begin to end - 1 of a point that from the nearest angle, and the angle's cosine."""
    observation, cosine = -1, -1.0
    x, y, z = centre[0] - point[0], centre[1] - point[1], centre[2] - point[2]
    for j in range(begin, end):
        of = frame_centres[frame[j]]
        a, b, c = of[0] - point[0], of[1] - point[1], of[2] - point[2]
        found = (x * a + y * b + z * c) / math.sqrt((x * x + y * y + z * z) * (a * a + b * b + c * c))
        if observation < 0 or found > cosine:
            observation, cosine = j, found
    return observation, cosine


@compiled
def affine_of_plane(optics: Optics, pixel: Floats, depth: float, normal: Floats, cur_T_ref: Floats) -> Floats:
    """∂(u, v)_cur/∂(u, v)_ref [2, 2] on level 0 for a plane through the point at a pixel [2] and z = `depth`.

    The plane's `normal` [3] is in reference axes; (0, 0, 1) is a plane that faces the camera. With the ray
    f = (a, b, 1) the plane's point is p = f · d/(n·f), d = depth · n·f₀, so that at f₀
    ∂p/∂(a, b) = depth (I - f nᵀ/(n·f)) restricted to a and b; then the chain of the two projections. NaN where one
    has no derivative.
    """
    a, b = ray(optics, pixel[0], pixel[1])
    ahead = normal[0] * a + normal[1] * b + normal[2]
    t, d = cur_T_ref, depth
    here = project(optics, a * d, b * d, d)
    place = project(
        optics,
        (t[0, 0] * a + t[0, 1] * b + t[0, 2]) * d + t[0, 3],
        (t[1, 0] * a + t[1, 1] * b + t[1, 2]) * d + t[1, 3],
        (t[2, 0] * a + t[2, 1] * b + t[2, 2]) * d + t[2, 3],
    )
    by_ray = np.empty((2, 2))
    for k in range(2):
        slide = normal[k] / ahead
        x, y, z = d * ((k == 0) - a * slide), d * ((k == 1) - b * slide), -d * slide
        moved_x = t[0, 0] * x + t[0, 1] * y + t[0, 2] * z
        moved_y = t[1, 0] * x + t[1, 1] * y + t[1, 2] * z
        moved_z = t[2, 0] * x + t[2, 1] * y + t[2, 2] * z
        by_ray[0, k] = place.u_x * moved_x + place.u_y * moved_y + place.u_z * moved_z
        by_ray[1, k] = place.v_x * moved_x + place.v_y * moved_y + place.v_z * moved_z
    # at the reference pixel, ∂(u, v)/∂(a, b) = depth · ∂(u, v)/∂(x, y)
    determinant = (here.u_x * here.v_y - here.u_y * here.v_x) * d
    ray_by_pixel = np.array([[here.v_y, -here.u_y], [-here.v_x, here.u_x]]) / determinant
    affine = np.empty((2, 2))
    for i in range(2):
        for j in range(2):
            affine[i, j] = by_ray[i, 0] * ray_by_pixel[0, j] + by_ray[i, 1] * ray_by_pixel[1, j]
    return affine


@compiled
def search_level(affine: Floats, ref_level: int) -> int:
    """The level of the current frame whose pixels are about as large as the reference patch's."""
    area = abs(affine[0, 0] * affine[1, 1] - affine[0, 1] * affine[1, 0]) * 4.0**ref_level
    level = 0
    while area > LARGEST_MAGNIFICATION and level < CORNER_LEVELS - 1:
        level += 1
        area /= 4
    return level


@compiled
def warped_patch(image: Grey, u: float, v: float, cur_by_ref: Floats, out: Floats) -> bool:
    """Sample a square patch [s, s] of the current level's axes out of the reference image around (u, v).

    `cur_by_ref` [2, 2] maps offsets on the reference's level to those on the current level. False where the patch
    leaves the image, or where the map has no inverse.
    """
    rows, columns = image.shape
    determinant = cur_by_ref[0, 0] * cur_by_ref[1, 1] - cur_by_ref[0, 1] * cur_by_ref[1, 0]
    uu, uv = cur_by_ref[1, 1] / determinant, -cur_by_ref[0, 1] / determinant
    vu, vv = -cur_by_ref[1, 0] / determinant, cur_by_ref[0, 0] / determinant
    half = (out.shape[0] - 1) / 2
    across, down = half * (abs(uu) + abs(uv)), half * (abs(vu) + abs(vv))
    if not (across <= u < columns - 1 - across and down <= v < rows - 1 - down):
        return False
    for y in range(out.shape[0]):
        for x in range(out.shape[1]):
            dx, dy = x - half, y - half
            out[y, x] = sample(image, u + uu * dx + uv * dy, v + vu * dx + vv * dy)
    return True


# ------------------------------------------------------------------------------ feature alignment


_MATCHED, _OUT_OF_VIEW, _OBLIQUE = int(Feature.MATCHED), int(Feature.OUT_OF_VIEW), int(Feature.OBLIQUE)
_REFERENCE_OUT_OF_VIEW, _FLAT = int(Feature.REFERENCE_OUT_OF_VIEW), int(Feature.FLAT)
_LEFT_IMAGE, _NOT_CONVERGED = int(Feature.LEFT_IMAGE), int(Feature.NOT_CONVERGED)
_NOT_TRIED = int(Feature.NOT_TRIED)


class FeatureOptions(NamedTuple):
    """Most `iterations`; converged where a step is shorter than `tolerance_px`; least cosine of the viewing angle."""

    iterations: int = 10
    tolerance_px: float = 0.03
    min_cosine: float = 0.5


class Found(NamedTuple):
    """A patch's place on the current level: `u`, `v`, mean difference (grey levels), residual rms, iterations.

    `correlation` is that of the patch with the image there, from -1 to 1.
    """

    u: float
    v: float
    mean_difference: float
    residual_rms: float
    correlation: float
    iterations: int
    outcome: int


class Features(NamedTuple):
    """Alignments of n points; pixels on level 0, px of the level for the rest; NaN where it did not come so far.

    `pixels` [n, 2]; `predicted` [n, 2] the projections that they started from; `level` [n] the level searched, -1 if
    none; `outcome` [n] a `Feature` each; `mean_difference` [n] and `residual_rms` [n] in grey levels;
    `correlation` [n] of the patch with the image where it was found; `iterations` [n]; `affine` [n, 2, 2] from the
    reference's to the current level 0.
    """

    pixels: Floats
    predicted: Floats
    level: Longs
    outcome: Longs
    mean_difference: Floats
    residual_rms: Floats
    correlation: Floats
    iterations: Longs
    affine: Floats


class References(NamedTuple):
    """What the keyframes saw of n points.

    `frame` [n]: the keyframe's row in the stack of pyramids and poses; `pixels` [n, 2] on level 0; `level` [n];
    `depth` [n], z in the keyframe, m; `normal` [n, 3] of the local plane in the keyframe's axes; `cosine` [n] of the
    angle between the two views.
    """

    frame: Longs
    pixels: Floats
    level: Longs
    depth: Floats
    normal: Floats
    cosine: Floats


@compiled
def align_patch(image: Grey, patch: Floats, u: float, v: float, options: FeatureOptions) -> Found:
    """Lay the inner 8 x 8 of a patch [10, 10] over the image, from (u, v) on.

    J = (T_u, T_v, 1) with the patch's central differences and H = Σ J Jᵀ, once; r = I(u, v) - T + m,
    (δu, δv, δm) = -H⁻¹ Σ J r. Converged when δu² + δv² < tolerance². The correlation is that of the two 8 x 8, by
    Σ r² less the mean = S_T + S_I - 2 S_TI, S their sums of squares about the means.
    """
    rows, columns = image.shape
    h, slope = np.zeros((3, 3)), np.empty((AREA, 2))
    sum_t, sum_tt = 0.0, 0.0
    for k in range(AREA):
        y, x = k // SIDE + 1, k % SIDE + 1
        slope[k, 0] = (patch[y, x + 1] - patch[y, x - 1]) / 2
        slope[k, 1] = (patch[y + 1, x] - patch[y - 1, x]) / 2
        h[0, 0] += slope[k, 0] ** 2
        h[1, 0] += slope[k, 0] * slope[k, 1]
        h[1, 1] += slope[k, 1] ** 2
        h[2, 0] += slope[k, 0]
        h[2, 1] += slope[k, 1]
        sum_t += patch[y, x]
        sum_tt += patch[y, x] ** 2
    h[2, 2] = AREA
    nan = math.nan
    if not linear.factor(h, 3):
        return Found(nan, nan, nan, nan, nan, 0, _FLAT)
    mean, step = 0.0, np.empty(3)
    for i in range(options.iterations):
        if not (REACH <= u < columns - 1 - REACH and REACH <= v < rows - 1 - REACH):
            return Found(nan, nan, nan, nan, nan, i, _LEFT_IMAGE)
        column, row = int(u - REACH), int(v - REACH)
        f, g = u - REACH - column, v - REACH - row
        w00, w01, w10, w11 = (1 - f) * (1 - g), f * (1 - g), (1 - f) * g, f * g
        by_u, by_v, by_mean, square, sum_gg = 0.0, 0.0, 0.0, 0.0, 0.0
        for y in range(SIDE):
            above, below, template = image[row + y], image[row + y + 1], patch[y + 1]
            for x in range(SIDE):
                c = column + x
                grey = w00 * above[c] + w01 * above[c + 1] + w10 * below[c] + w11 * below[c + 1]
                r = grey - template[x + 1] + mean
                by_u += slope[y * SIDE + x, 0] * r
                by_v += slope[y * SIDE + x, 1] * r
                by_mean += r
                square += r * r
                sum_gg += grey * grey
        step[0], step[1], step[2] = -by_u, -by_v, -by_mean
        linear.substitute(h, step, 3)
        u, v, mean = u + step[0], v + step[1], mean + step[2]
        if step[0] ** 2 + step[1] ** 2 < options.tolerance_px**2:
            sum_g = by_mean + sum_t - AREA * (mean - step[2])
            s_t, s_g = sum_tt - sum_t**2 / AREA, sum_gg - sum_g**2 / AREA
            unlike = square - by_mean**2 / AREA
            correlation = (s_t + s_g - unlike) / (2 * math.sqrt(s_t * s_g)) if s_t > 0 and s_g > 0 else 0.0
            # what the last step takes away from the squares: gᵀ H⁻¹ g
            square += by_u * step[0] + by_v * step[1] + by_mean * step[2]
            return Found(u, v, -mean, math.sqrt(max(square, 0.0) / AREA), correlation, i + 1, _MATCHED)
    return Found(u, v, -mean, nan, nan, options.iterations, _NOT_CONVERGED)


@compiled
def no_features(n: int) -> Features:
    """Room for n alignments, none of them tried."""
    return Features(
        np.full((n, 2), math.nan),
        np.full((n, 2), math.nan),
        np.full(n, -1, np.int64),
        np.full(n, _NOT_TRIED, np.int64),
        np.full(n, math.nan),
        np.full(n, math.nan),
        np.full(n, math.nan),
        np.zeros(n, np.int64),
        np.full((n, 2, 2), math.nan),
    )


@compiled
def align_features(
    keyframes: Grey,
    current: Pyramid,
    optics: Optics,
    cur_T_key: Floats,
    references: References,
    options: FeatureOptions,
) -> Features:
    """Find points of keyframes in the current frame.

    Args:
        keyframes: the buffers [k, size] of the keyframes' pyramids, of the current frame's size.
        current: the current frame.
        optics: the camera.
        cur_T_key: transforms [k, 4, 4] from each keyframe to the current frame, as known so far.
        references: what the keyframes saw of the points.
        options: stop rules.

    Raises:
        ValueError: keyframes that are not of the current frame's size.
    """
    if keyframes.shape[1] != len(current.buffer):
        raise ValueError("keyframes and current frame differ in size: align features of frames of one size")
    found, patch, r = no_features(len(references.frame)), np.empty((SIDE + 2, SIDE + 2)), references
    for i in range(len(r.frame)):
        key = Pyramid(keyframes[r.frame[i]], current.height, current.width)
        t = cur_T_key[r.frame[i]]
        align_feature(
            key, current, optics, t, r.pixels[i], r.level[i], r.depth[i], r.normal[i], r.cosine[i], options, patch,
            found, i,
        )  # fmt: skip
    return found


@compiled
def align_feature(
    key: Pyramid,
    current: Pyramid,
    optics: Optics,
    cur_T_key: Floats,
    pixel: Floats,
    ref_level: int,
    depth: float,
    normal: Floats,
    cosine: float,
    options: FeatureOptions,
    patch: Floats,
    found: Features,
    i: int,
) -> None:
    """Find one point, see `References`; enter what came out in row i. `patch` [10, 10] is room to work in."""
    t = cur_T_key
    a, b = ray(optics, pixel[0], pixel[1])
    place = project(
        optics,
        (t[0, 0] * a + t[0, 1] * b + t[0, 2]) * depth + t[0, 3],
        (t[1, 0] * a + t[1, 1] * b + t[1, 2]) * depth + t[1, 3],
        (t[2, 0] * a + t[2, 1] * b + t[2, 2]) * depth + t[2, 3],
    )
    found.predicted[i, 0], found.predicted[i, 1] = place.u, place.v
    if not (0 <= place.u <= current.width - 1 and 0 <= place.v <= current.height - 1):
        found.outcome[i] = _OUT_OF_VIEW
        return
    if not cosine >= options.min_cosine:
        found.outcome[i] = _OBLIQUE
        return
    affine = affine_of_plane(optics, pixel, depth, normal, t)
    found.affine[i] = affine
    level = search_level(affine, ref_level)
    found.level[i] = level
    image = level_image(key, ref_level)
    u, v = on_level(pixel[0], ref_level), on_level(pixel[1], ref_level)
    if not warped_patch(image, u, v, affine * 2.0 ** (ref_level - level), patch):
        found.outcome[i] = _REFERENCE_OUT_OF_VIEW
        return
    u, v = on_level(place.u, level), on_level(place.v, level)
    result = align_patch(level_image(current, level), patch, u, v, options)
    found.outcome[i], found.iterations[i] = result.outcome, result.iterations
    found.mean_difference[i], found.residual_rms[i] = result.mean_difference, result.residual_rms
    found.correlation[i] = result.correlation
    found.pixels[i, 0], found.pixels[i, 1] = on_finest(result.u, level), on_finest(result.v, level)
