"""What the PTAM-style baseline sees in an image, and where map points lie in it.

FAST corners of some levels (E. Rosten, T. Drummond, "Machine learning for high-speed corner detection", ECCV 2006) are
the only places where a map point's 8 x 8 patch is compared, by its zero-mean sum of squared differences; the best one
is aligned to a part of a pixel. G. Klein, D. Murray, "Parallel tracking and mapping for small AR workspaces", ISMAR
2007, section 5; small blurred images after their "Improving the agility of keyframe-based SLAM", ECCV 2008.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pipelines.compiled import compiled
from pipelines.geometry import se3_inverse, se3_product
from pipelines.semidirect.epipolar import BORDERED, level_for, warp_of, warped_patch, within, zmssd
from pipelines.semidirect.features import (
    CornerOptions,
    Corners,
    FeatureOptions,
    align_patch,
    keep_best_of_cells,
    occupied_cells,
)
from pipelines.semidirect.optics import Optics, project, rays
from pipelines.semidirect.pyramid import LEVELS, Grey, Pyramid, level_image, on_finest, on_level, pyramid_of
from pipelines.semidirect.step import Feature

Floats = NDArray[np.float64]
Longs = NDArray[np.int64]

SMALLEST_AREA, LARGEST_AREA = 0.25, 3.0
"""A patch whose pixels cover less or more of those of the level searched is not compared."""
SMALL_WIDTH_PX = 40
"""The small image is that of the coarsest level at least so wide."""
SMALL_SIGMA_PX = 1.5
BLANK_RMS = 0.5
"""Grey levels below which a small image shows nothing."""
PATCH_CENTRE = 0.5
"""A patch's corner lies so far beyond the middle of its pixels, which the alignment takes for its place."""

_OUT_OF_VIEW, _OBLIQUE, _FLAT = int(Feature.OUT_OF_VIEW), int(Feature.OBLIQUE), int(Feature.FLAT)
_NO_REFERENCE, _NOT_CONVERGED = int(Feature.REFERENCE_OUT_OF_VIEW), int(Feature.NOT_CONVERGED)


class CornerTable(NamedTuple):
    """FAST corners by level and row: those of row y of level l are `column`[first[l, y] : first[l, y + 1]].

    `column` [n]; `first` [LEVELS, height + 1], no corners on levels that were not looked at.
    """

    column: Longs
    first: Longs


class View(NamedTuple):
    """An image as it is compared: its pyramid, its corners, its small blurred copy of mean 0, [rows, columns]."""

    pyramid: Pyramid
    corners: CornerTable
    small: NDArray[np.float32]


def view_of(image: Grey, finest: int, coarsest: int, threshold: int) -> View:
    """A grey image [height, width] with the corners of the levels from finest to coarsest.

    Raises:
        ValueError: see `pyramid_of`.
    """
    pyramid = pyramid_of(image)
    blurred = cv2.GaussianBlur(level_image(pyramid, small_level(pyramid)).astype(np.float32), (0, 0), SMALL_SIGMA_PX)
    return View(pyramid, corner_table(pyramid, finest, coarsest, threshold), np.asarray(blurred - blurred.mean()))


def small_level(pyramid: Pyramid) -> int:
    """The level of the small image."""
    return max((level for level in range(LEVELS) if pyramid.width >> level >= SMALL_WIDTH_PX), default=0)


# ------------------------------------------------------------------------------------- corners


def corner_table(pyramid: Pyramid, finest: int, coarsest: int, threshold: int) -> CornerTable:
    """The FAST corners of the levels from finest to coarsest; the strongest of neighbours are not singled out."""
    detector = cv2.FastFeatureDetector.create(threshold, nonmaxSuppression=False)
    columns, first = [np.zeros(0, np.int64)], np.zeros((LEVELS, pyramid.height + 1), np.int64)
    for level in range(finest, coarsest + 1):
        places = cv2.KeyPoint.convert(detector.detect(level_image(pyramid, level)))
        column, row = np.asarray(places, np.int64).reshape(-1, 2).T
        first[level] = sum(map(len, columns)) + np.searchsorted(row, np.arange(pyramid.height + 1))
        columns.append(column)  # OpenCV gives them row by row
    return CornerTable(np.concatenate(columns), first)


def free_corners(view: View, taken_px: Floats, taken_level: Longs, cell_px: int, min_score: float) -> Corners:
    """The best corner of each cell of each level that holds none of the pixels taken [n, 2] on that level [n].

    A cell has `cell_px` pixels of the level.
    """
    table, found = view.corners, []
    for level in range(LEVELS):
        options = CornerOptions(cell_px << level)
        occupied = occupied_cells(view.pyramid, taken_px[taken_level == level], options)
        best = np.full((occupied.size, 4), -np.inf)
        bounds = table.first[level]
        rows = np.repeat(np.arange(len(bounds) - 1), np.diff(bounds))
        places = np.column_stack([table.column[bounds[0] : bounds[-1]], rows]).astype(np.float32)
        keep_best_of_cells(level_image(view.pyramid, level), level, places, occupied, options.cell_px, best)
        found.append(best[best[:, 0] > min_score])
    best = np.vstack(found)
    return Corners(best[:, 1:3].copy(), best[:, 3].astype(np.int64), best[:, 0].copy())


# -------------------------------------------------------------------------------------- search


class Sources(NamedTuple):
    """What the first keyframe of each of n points saw: its row `frame` [n], `pixels` [n, 2] and `level` [n]."""

    frame: Longs
    pixels: Floats
    level: Longs


class SearchOptions(NamedTuple):
    """Settings of `find_points`.

    Search radius, px of level 0; worst score, grey levels², and as a share of the patch's variance; levels with
    corners; the first level whose matches are aligned to a part of a pixel, and how.
    """

    radius_px: float
    max_score: float
    max_share: float
    finest: int
    coarsest: int
    align_level: int
    alignment: FeatureOptions


class Matches(NamedTuple):
    """Where n points are; px of level 0, NaN where it did not come so far.

    `predicted` and `found` [n, 2]; `level` [n] that was searched, -1 for none; `outcome` [n] a `Feature` each, where
    NOT_CONVERGED also says that no corner was like the patch; `score` [n] of the best corner, infinite without any.
    """

    predicted: Floats
    found: Floats
    level: Longs
    outcome: Longs
    score: Floats

    @property
    def matched(self) -> NDArray[np.bool_]:
        """Which of them were found [n]."""
        return np.asarray(self.outcome == Feature.MATCHED)

    @property
    def found_count(self) -> int:
        """How many."""
        return int(np.count_nonzero(self.matched))


@compiled
def projected(optics: Optics, cam_T_world: Floats, points: Floats) -> Floats:
    """Pixels [n, 2] of points [n, 3] of the world; NaN for one that has none."""
    pixels, t = np.empty((len(points), 2)), cam_T_world
    for i in range(len(points)):
        p = points[i]
        place = project(
            optics,
            t[0, 0] * p[0] + t[0, 1] * p[1] + t[0, 2] * p[2] + t[0, 3],
            t[1, 0] * p[0] + t[1, 1] * p[1] + t[1, 2] * p[2] + t[1, 3],
            t[2, 0] * p[0] + t[2, 1] * p[1] + t[2, 2] * p[2] + t[2, 3],
        )
        pixels[i, 0], pixels[i, 1] = place.u, place.v
    return pixels


@compiled
def find_points(
    optics: Optics,
    keyframes: Grey,
    keys_T_world: Floats,
    view: View,
    cam_T_world: Floats,
    points: Floats,
    sources: Sources,
    options: SearchOptions,
) -> Matches:
    """Look for points around their projections.

    Args:
        optics: the camera.
        keyframes: the buffers [k, size] of the keyframes' pyramids, of the view's size.
        keys_T_world: the keyframes' poses [k, 4, 4].
        view: the image that is searched.
        cam_T_world: its pose [4, 4], as known so far.
        points: n points [n, 3] in world axes.
        sources: what their first keyframes saw.
        options: settings.
    """
    n, pyramid = len(points), view.pyramid
    m = Matches(
        projected(optics, cam_T_world, points),
        np.full((n, 2), math.nan),
        np.full(n, -1, np.int64),
        np.zeros(n, np.int64),
        np.full(n, math.nan),
    )
    patch, rotation, translation, bearing = np.empty((BORDERED, BORDERED)), np.empty((3, 3)), np.empty(3), np.empty(3)
    last = -1
    for i in range(n):
        if not within(level_image(pyramid, 0), m.predicted[i, 0], m.predicted[i, 1]):
            m.outcome[i] = _OUT_OF_VIEW
            continue
        frame, pixel, ref_level = sources.frame[i], sources.pixels[i], sources.level[i]
        key = keys_T_world[frame]
        if frame != last:
            view_T_key, last = se3_product(cam_T_world, se3_inverse(key)), frame
            rotation[:], translation[:] = view_T_key[:3, :3], view_T_key[:3, 3]
        for k in range(3):
            bearing[k] = key[k, 0] * points[i, 0] + key[k, 1] * points[i, 1] + key[k, 2] * points[i, 2] + key[k, 3]
        distance = math.sqrt(bearing[0] ** 2 + bearing[1] ** 2 + bearing[2] ** 2)
        for k in range(3):
            bearing[k] /= distance
        warp = warp_of(optics, bearing, 1.0 / distance, rotation, translation)
        level = max(level_for(warp, ref_level, options.coarsest), options.finest)
        area = abs(warp.xx * warp.yy - warp.xy * warp.yx) * 4.0 ** (ref_level - level)
        if not SMALLEST_AREA <= area <= LARGEST_AREA:
            m.outcome[i] = _OBLIQUE
            continue
        m.level[i] = level
        reference = level_image(Pyramid(keyframes[frame], pyramid.height, pyramid.width), ref_level)
        if not warped_patch(reference, pixel[0], pixel[1], ref_level, warp, level, patch):
            m.outcome[i] = _NO_REFERENCE
            continue
        image = level_image(pyramid, level)
        u, v = on_level(m.predicted[i, 0], level), on_level(m.predicted[i, 1], level)
        m.score[i], column, row = best_corner(image, view.corners, level, patch, u, v, options.radius_px / (1 << level))
        if not m.score[i] < min(options.max_score, options.max_share * variance(patch)):
            m.outcome[i] = _NOT_CONVERGED
            continue
        found_u, found_v = float(column), float(row)
        if level >= options.align_level:
            place = align_patch(image, patch, column - PATCH_CENTRE, row - PATCH_CENTRE, options.alignment)
            m.outcome[i] = place.outcome
            found_u, found_v = place.u + PATCH_CENTRE, place.v + PATCH_CENTRE
        m.found[i, 0], m.found[i, 1] = on_finest(found_u, level), on_finest(found_v, level)
    return m


@compiled
def variance(patch: Floats) -> float:
    """Variance of the inner 8 x 8 of a patch [10, 10], grey levels²: the score of a corner without any texture."""
    return float(np.var(patch[1:-1, 1:-1]))


@compiled
def best_corner(
    image: Grey, corners: CornerTable, level: int, patch: Floats, u: float, v: float, radius: float
) -> tuple[float, int, int]:
    """Score, column and row of the corner within a radius of (u, v) that is most like the patch; px of the level."""
    best, best_u, best_v = math.inf, 0, 0
    first = corners.first[level]
    for y in range(max(math.ceil(v - radius), 0), min(math.floor(v + radius), image.shape[0] - 1) + 1):
        half = math.sqrt(radius * radius - (y - v) ** 2)
        start = first[y] + np.searchsorted(corners.column[first[y] : first[y + 1]], math.ceil(u - half))
        for k in range(start, first[y + 1]):
            x = corners.column[k]
            if x > u + half:
                break
            if within(image, x, y):
                score = zmssd(patch, image, x, y)
                if score < best:
                    best, best_u, best_v = score, x, y
    return best, best_u, best_v


# ------------------------------------------------------------------------- small blurred images


def correlation(a: NDArray[np.float32], b: NDArray[np.float32]) -> float:
    """The normalised correlation of two small images of mean 0; 0 where one is blank."""
    sizes = float(np.linalg.norm(a)), float(np.linalg.norm(b))
    if min(sizes) < BLANK_RMS * math.sqrt(a.size):
        return 0.0
    return float(np.vdot(a, b)) / (sizes[0] * sizes[1])


def turn_between(optics: Optics, before: View, after: View) -> Floats | None:
    """The rotation R [3, 3], x_after = R x_before, that lays one small image best over the other; None without any.

    A shift and a turn of the small images is found (enhanced correlation, G. Evangelidis, E. Psarakis, PAMI 30(10),
    2008), then the rotation that moves the rays of their pixels so.
    """
    warp = np.eye(2, 3, dtype=np.float32)
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 50, 1e-4)
    try:
        _, warp = cv2.findTransformECC(before.small, after.small, warp, cv2.MOTION_EUCLIDEAN, criteria, None, 1)
    except cv2.error:  # it does not converge
        return None
    rows, columns = before.small.shape
    grid = np.stack(np.meshgrid(np.linspace(0, columns - 1, 5), np.linspace(0, rows - 1, 5)), axis=-1).reshape(-1, 2)
    there = grid @ warp[:, :2].T + warp[:, 2]
    size = 1 << small_level(before.pyramid)
    seen = [rays(optics, (pixels + 0.5) * size - 0.5) for pixels in (grid, there)]
    known = np.all(np.isfinite(seen[0]) & np.isfinite(seen[1]), axis=1)
    if np.count_nonzero(known) < 3:
        return None
    x, y = (r[known] / np.linalg.norm(r[known], axis=1, keepdims=True) for r in seen)
    return np.asarray(Rotation.align_vectors(y, x)[0].as_matrix())
