"""The map of the PTAM-style baseline: keyframes, points and what the one saw of the other, and how it grows.

A point is made of one epipolar search between two keyframes: no filter waits for a second opinion, so that a wrong
match is a wrong point until the bundle adjustment or the tracking throws it out. G. Klein, D. Murray, "Parallel
tracking and mapping for small AR workspaces", ISMAR 2007, section 6.

Poses are cam_T_world [4, 4]; pixels (u, v) are those of level 0. Every function returns a new map.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry import se3_inverse
from pipelines.semidirect import epipolar
from pipelines.semidirect.baseline_search import SearchOptions, Sources, View, find_points, free_corners, projected
from pipelines.semidirect.optics import Optics, rays
from pipelines.semidirect.pyramid import Grey
from pipelines.semidirect.refinement import Bundle, BundleOptions, Observations, adjust, oldest_fixed, refine_points
from pipelines.semidirect.step import Feature

Floats = NDArray[np.float64]
Longs = NDArray[np.int64]
Flags = NDArray[np.bool_]


class Seen(NamedTuple):
    """m observations: rows of `point` [m] and `keyframe` [m], `pixels` [m, 2], `level` [m]."""

    point: Longs
    keyframe: Longs
    pixels: Floats
    level: Longs

    def chosen(self, which: Flags | Longs) -> Seen:
        """Some of them."""
        return Seen(self.point[which], self.keyframe[which], self.pixels[which], self.level[which])


@dataclass(frozen=True, slots=True)
class Map:
    """Keyframes, oldest first, and points.

    `frames` [k] their numbers, `views` [k], `buffers` [k, size] of the views' pyramids, `poses` [k, 4, 4]; `ids` [n]
    and `points` [n, 3] in the world; `inliers` and `outliers` [n], in how many frames a point was one; `seen`,
    ordered by point, then keyframe. Every point is seen by two keyframes or more. `made` is the next point's number.
    """

    frames: Longs
    views: tuple[View, ...]
    buffers: Grey
    poses: Floats
    ids: Longs
    points: Floats
    inliers: Longs
    outliers: Longs
    seen: Seen
    made: int

    @property
    def first(self) -> Longs:
        """Where each point's observations begin [n + 1]."""
        return np.append(0, np.cumsum(np.bincount(self.seen.point, minlength=len(self.points))))

    @property
    def observations(self) -> Observations:
        """All observations, as the refinement takes them."""
        return Observations(self.first, self.seen.keyframe, self.seen.pixels, self.seen.level)

    @property
    def centres(self) -> Floats:
        """The keyframes' centres in the world [k, 3]."""
        return np.array([se3_inverse(pose)[:3, 3] for pose in self.poses])

    def sources(self, rows: Longs) -> Sources:
        """What the oldest keyframes of some points saw."""
        at = self.first[rows]
        return Sources(self.seen.keyframe[at], self.seen.pixels[at], self.seen.level[at])

    def nearest(self, centre: Floats) -> Longs:
        """The keyframes by their distance from a place [3], nearest first."""
        return np.argsort(np.linalg.norm(self.centres - centre, axis=1), kind="stable")


def empty(buffer_size: int, made: int) -> Map:
    """A map without anything, for pyramids of that size; its first point will have the number `made`."""
    none, nothing = np.zeros(0, np.int64), np.zeros((0, 2))
    return Map(
        none, (), np.zeros((0, buffer_size), np.uint8), np.zeros((0, 4, 4)), none, np.zeros((0, 3)), none, none,
        Seen(none, none, nothing, none), made,
    )  # fmt: skip


# ------------------------------------------------------------------------------- more and less


def with_keyframe(m: Map, frame: int, view: View, pose: Floats) -> Map:
    """The map with a keyframe more, which has seen nothing yet."""
    return replace(
        m,
        frames=np.append(m.frames, frame),
        views=(*m.views, view),
        buffers=np.vstack([m.buffers, view.pyramid.buffer[None]]),
        poses=np.concatenate([m.poses, pose[None]]),
    )


def with_seen(m: Map, more: Seen) -> Map:
    """The map with more observations of its points."""
    seen = Seen(*(np.concatenate(both) for both in zip(m.seen, more, strict=True)))
    return replace(m, seen=seen.chosen(np.lexsort((seen.keyframe, seen.point))))


def with_points(m: Map, points: Floats, seen: Seen) -> Map:
    """The map with new points [n, 3]; `seen.point` are rows of these."""
    n, none = len(m.points), np.zeros(len(points), np.int64)
    grown = replace(
        m,
        ids=np.concatenate([m.ids, m.made + np.arange(len(points))]),
        points=np.vstack([m.points, points]),
        inliers=np.concatenate([m.inliers, none]),
        outliers=np.concatenate([m.outliers, none]),
        made=m.made + len(points),
    )
    return with_seen(grown, seen._replace(point=seen.point + n))


def without(m: Map, *, points: Flags | None = None, seen: Flags | None = None, keyframe: int = -1) -> Map:
    """The map less some points [n], observations [m] and a keyframe, and less points that are left with one view."""
    stays = np.ones(len(m.seen.point), np.bool_) if seen is None else ~seen
    if points is not None:
        stays &= ~points[m.seen.point]
    stays &= m.seen.keyframe != keyframe
    kept_points = np.bincount(m.seen.point[stays], minlength=len(m.points)) >= 2
    kept_frames = np.arange(len(m.frames)) != keyframe
    rest = m.seen.chosen(stays & kept_points[m.seen.point])
    row_of_point, row_of_frame = np.cumsum(kept_points) - 1, np.cumsum(kept_frames) - 1
    return Map(
        m.frames[kept_frames],
        tuple(view for view, kept in zip(m.views, kept_frames, strict=True) if kept),
        m.buffers[kept_frames] if keyframe >= 0 else m.buffers,
        m.poses[kept_frames],
        m.ids[kept_points],
        m.points[kept_points],
        m.inliers[kept_points],
        m.outliers[kept_points],
        rest._replace(point=row_of_point[rest.point], keyframe=row_of_frame[rest.keyframe]),
        m.made,
    )


# -------------------------------------------------------------------------------------- growth


class Growth(NamedTuple):
    """Settings of new points: corners, half the range of inverse depths, the epipolar search."""

    cell_px: int
    min_score: float
    depth_sigmas: float
    min_depth_range: float
    limits: epipolar.Limits


def with_new_points(m: Map, optics: Optics, growth: Growth) -> Map:
    """The map with the points that an epipolar search finds between the newest keyframe and the nearest other one.

    Corners of the newest keyframe where it sees no point yet are looked for along the lines on which the depths of the
    points that it sees would put them.
    """
    new = len(m.frames) - 1
    pose, view, mine = m.poses[new], m.views[new], m.seen.keyframe == new
    other = int(m.nearest(se3_inverse(pose)[:3, 3])[1])
    corners = free_corners(view, m.seen.pixels[mine], m.seen.level[mine], growth.cell_px, growth.min_score)
    bearings = rays(optics, corners.pixels)
    bearings /= np.linalg.norm(bearings, axis=1, keepdims=True)
    inverse_depth = 1.0 / (m.points[m.seen.point[mine]] @ pose[2, :3] + pose[2, 3])
    mean = float(np.mean(inverse_depth))
    spread = max(growth.depth_sigmas * float(np.std(inverse_depth)), growth.min_depth_range * mean)
    other_T_new = m.poses[other] @ se3_inverse(pose)
    record = np.full((len(bearings), len(epipolar.RECORD)), np.nan)
    epipolar.search_bank(
        optics,
        view.pyramid,
        m.views[other].pyramid,
        corners.pixels,
        bearings,
        corners.level,
        mean * bearings[:, 2],
        spread * bearings[:, 2],
        np.ascontiguousarray(other_T_new[:3, :3]),
        np.ascontiguousarray(other_T_new[:3, 3]),
        growth.limits,
        record,
    )
    found = dict(zip(epipolar.RECORD, record.T, strict=True))
    good = (found["outcome"] == epipolar.MATCHED) | (found["outcome"] == epipolar.ALIGNED)
    count = int(np.count_nonzero(good))
    world_T_new = se3_inverse(pose)
    points = (bearings[good] * found["depth"][good, None]) @ world_T_new[:3, :3].T + world_T_new[:3, 3]
    one, both = np.ones(count, np.int64), np.tile(np.arange(count), 2)
    there = np.column_stack([found["u"], found["v"]])[good]
    seen = Seen(
        both,
        np.concatenate([new * one, other * one]),
        np.vstack([corners.pixels[good], there]),
        np.concatenate([corners.level[good], found["level"][good].astype(np.int64)]),
    )
    return with_points(m, points, seen)


def found_again(m: Map, optics: Optics, rows: Longs, keyframes: Longs, options: SearchOptions) -> Map:
    """The map with the observations of some points that a search in some keyframes finds."""
    for k in keyframes:
        known = np.isin(rows, m.seen.point[m.seen.keyframe == k])
        asked = rows[~known]
        match = find_points(
            optics, m.buffers, m.poses, m.views[k], m.poses[k], m.points[asked], m.sources(asked), options
        )
        got = match.outcome == Feature.MATCHED
        more = Seen(asked[got], np.full(np.count_nonzero(got), k), match.found[got], match.level[got])
        m = with_seen(m, more)
    return m


# ------------------------------------------------------------------------------------- bundles


class Adjusted(NamedTuple):
    """A map after a bundle adjustment, and what that was; the bundle is None where nothing could move."""

    map: Map
    bundle: Bundle | None
    outliers: int


def local_bundle(m: Map, optics: Optics, moving: int, options: BundleOptions) -> Adjusted:
    """The newest keyframe and those nearest to it move with the points that they see; others that see these hold."""
    free = np.zeros(len(m.frames), np.bool_)
    free[m.nearest(se3_inverse(m.poses[-1])[:3, 3])[:moving]] = True
    return _adjusted(m, optics, free & ~oldest_fixed(len(free)), options)


def global_bundle(m: Map, optics: Optics, options: BundleOptions) -> Adjusted:
    """All keyframes but the two oldest, and all points."""
    return _adjusted(m, optics, ~oldest_fixed(len(m.frames)), options)


def _adjusted(m: Map, optics: Optics, free: Flags, options: BundleOptions) -> Adjusted:
    """The map with the free keyframes [k] and their points moved, less the observations that are outliers then."""
    moved = np.zeros(len(m.points), np.bool_)
    moved[m.seen.point[free[m.seen.keyframe]]] = True
    if not (np.any(free) and np.any(moved)):
        return Adjusted(m, None, 0)
    part = np.flatnonzero(moved[m.seen.point])
    used = np.zeros(len(free), np.bool_)
    used[m.seen.keyframe[part]] = True
    used |= _two_that_hold(used & ~free, free)
    row, seen = np.cumsum(used) - 1, m.seen.chosen(part)
    first = np.searchsorted(seen.point, np.append(np.flatnonzero(moved), len(m.points)))
    observations = Observations(first, row[seen.keyframe], seen.pixels, seen.level)
    bundle = adjust(optics, m.poses[used], ~free[used], observations, m.points[moved], options)
    poses, points, outlier = m.poses.copy(), m.points.copy(), np.zeros(len(m.seen.point), np.bool_)
    poses[used], points[moved], outlier[part] = bundle.cams_t_world, bundle.points, ~bundle.inlier
    better = without(replace(m, poses=poses, points=points), seen=outlier)
    return Adjusted(better, bundle, int(np.count_nonzero(outlier)))


def _two_that_hold(holding: Flags, free: Flags) -> Flags:
    """The oldest keyframes that are needed beside those that hold already, so that two do."""
    spare = np.flatnonzero(~free & ~holding)[: max(2 - int(np.count_nonzero(holding)), 0)]
    return np.isin(np.arange(len(free)), spare)


# --------------------------------------------------------------------------------------- state


def visible(m: Map, optics: Optics, pose: Floats, view: View) -> Longs:
    """The rows of the points that project into the image."""
    u, v = projected(optics, pose, m.points).T
    return np.flatnonzero((u >= 0) & (u <= view.pyramid.width - 1) & (v >= 0) & (v <= view.pyramid.height - 1))


def sigma_along_rays(m: Map, optics: Optics, sigma_px: float) -> Floats:
    """Standard deviation of each point along the ray of its oldest keyframe [n], for errors of so many px."""
    covariance = refine_points(optics, m.poses, m.observations, m.points, 0).covariance
    ray = m.points - m.centres[m.sources(np.arange(len(m.points))).frame]
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    return np.asarray(sigma_px * np.sqrt(np.einsum("ni,nij,nj->n", ray, covariance, ray)))
