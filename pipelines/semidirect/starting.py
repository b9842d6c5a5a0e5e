"""The first map of a sequence: corners followed from a first view until a homography or essential matrix tells it."""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from pipelines.semidirect.features import CornerOptions, cells_of, corners
from pipelines.semidirect.local_map import (
    Keyframes,
    LocalMap,
    PointState,
    new_points,
    no_filters,
    observations_of,
)
from pipelines.semidirect.optics import Optics, rays
from pipelines.semidirect.pyramid import Grey, Pyramid, level_image
from pipelines.semidirect.scale import Plane, plane_of
from pipelines.semidirect.settings import SemidirectSettings
from pipelines.semidirect.start import Model, Start, StartLimits, start

Floats = NDArray[np.float64]
Longs = NDArray[np.int64]
Flags = NDArray[np.bool_]

WINDOW_PX = 21
BACK_PX = 0.5
"""A corner that does not come back within this, followed forth and back, is not used."""


class FirstView(NamedTuple):
    """The first view of a start: `number`, `t_ns`, its pyramid; its `corners` [n, 2] with their `level` [n]."""

    number: int
    t_ns: int
    pyramid: Pyramid
    corners: Floats
    level: Longs


class Following(NamedTuple):
    """Corners on their way to the frame `number`, whose image is `image`.

    Rows `which` [m] of the first view's corners, and where they are now: `pixels` [m, 2].
    """

    first: FirstView
    number: int
    image: Grey
    which: Longs
    pixels: Floats


class FirstMap(NamedTuple):
    """A first map in the axes of the world, the median `depth` in its first view, and the `unit` in metres.

    The unit is that of `start.Start`, in which that depth is 1.
    """

    world: LocalMap
    depth: float
    unit: float


def first_view(number: int, t_ns: int, pyramid: Pyramid, settings: SemidirectSettings) -> Following:
    """Begin to follow the best corners of a frame."""
    options = CornerOptions(settings.cell_px, settings.corner_threshold, settings.corner_min_score)
    found = corners(pyramid, np.zeros(cells_of(pyramid, options), np.bool_), options)
    best = np.sort(np.argsort(-found.score, kind="stable")[: settings.start_corners])
    view = FirstView(number, t_ns, pyramid, found.pixels[best], found.level[best])
    return Following(view, number, level_image(pyramid, 0), np.arange(len(best)), view.corners)


def followed(following: Following, number: int, pyramid: Pyramid) -> Following:
    """The corners in the next frame, by pyramidal Lucas-Kanade forth and back; those that are lost drop out."""
    image = level_image(pyramid, 0)
    if not len(following.which):
        return following._replace(number=number, image=image)
    before = np.ascontiguousarray(following.pixels, np.float32)[:, None]
    window = (WINDOW_PX, WINDOW_PX)
    there, found, _ = cv2.calcOpticalFlowPyrLK(following.image, image, before, before.copy(), winSize=window)
    back, returned, _ = cv2.calcOpticalFlowPyrLK(image, following.image, there, there.copy(), winSize=window)
    good = (found.ravel() == 1) & (returned.ravel() == 1)
    good &= np.linalg.norm((back - before)[:, 0], axis=1) < BACK_PX
    now = there[:, 0].astype(np.float64)
    good &= np.all((now > 0) & (now < (pyramid.width - 1, pyramid.height - 1)), axis=1)
    return Following(following.first, number, image, following.which[good], now[good])


def begun(following: Following, optics: Optics, settings: SemidirectSettings) -> tuple[Start, Flags]:
    """The motion from the first view and the first map's points, if they can be told; and the second view's rays."""
    s = settings
    first = rays(optics, np.ascontiguousarray(following.first.corners[following.which]))
    second = rays(optics, following.pixels)
    known = np.isfinite(first).all(axis=1) & np.isfinite(second).all(axis=1)
    limits = StartLimits(s.start_min_matches, s.start_motion_px, s.start_parallax_px, s.inlier_px, s.start_min_inliers)
    found = start(first[known, :2], second[known, :2], optics.focal_u, model=Model(s.start_model), limits=limits)
    return found, known


def first_map(
    following: Following,
    number: int,
    pyramid: Pyramid,
    found: Start,
    known: Flags,
    *,
    height_m: float,
    height_direction: Literal["vertical", "axis"],
    place: tuple[float, float],
    heading_rad: float,
    next_number: int,
) -> FirstMap:
    """The map of two views: the world's z = 0 is the plane of its points, z away from the cameras.

    Args:
        following: the corners, as they were followed.
        number: of the second view.
        pyramid: of the second view.
        found: what `begun` told.
        known: likewise.
        height_m: height of the second camera over the plane, NaN to leave the median depth at 1.
        height_direction: whether that is over the ground or along the camera's axis.
        place: x, y of the first camera.
        heading_rad: of its u axis.
        next_number: of the first point.
    """
    which, inlier = following.which[known][found.inlier], found.inlier
    points = found.points[inlier]
    plane = plane_of(points)
    normal = found.rotation @ plane.normal
    second = plane._replace(normal=normal, distance=plane.distance + float(normal @ found.translation))
    unit = unit_of(second, height_m, height_direction)
    first_t_world = standing(plane.normal, plane.distance * unit, place, heading_rad)
    second_t_first = np.eye(4)
    second_t_first[:3, :3], second_t_first[:3, 3] = found.rotation, found.translation * unit
    poses = np.stack([first_t_world, second_t_first @ first_t_world])
    world_t_first = np.linalg.inv(first_t_world)
    n = len(points)
    first = following.first
    keyframes = Keyframes(np.array([first.number, number]), poses, np.stack([first.pyramid.buffer, pyramid.buffer]))
    places = points * unit @ world_t_first[:3, :3].T + world_t_first[:3, 3]
    sigma = np.full(n, np.nan)
    rows = np.arange(n)
    seen = observations_of(
        np.concatenate([rows, rows]),
        np.repeat([0, 1], n),
        np.concatenate([first.corners[which], following.pixels[known][inlier]]),
        np.concatenate([first.level[which], first.level[which]]),
        n,
    )
    table = new_points(next_number + rows, places, np.full((n, 3, 3), np.nan), sigma, PointState.KNOWN)
    world = LocalMap(keyframes, table, seen, no_filters(), next_number + n)
    return FirstMap(world, float(np.median(points[:, 2])) * unit, unit)


def unit_of(plane: Plane, height_m: float, direction: Literal["vertical", "axis"]) -> float:
    """Metres of a unit in which a camera sees a plane n·x = d; 1 for an unknown height.

    The camera is d over the plane, and d/n_z from it along its axis.
    """
    if math.isnan(height_m):
        return 1.0
    away = plane.distance if direction == "vertical" else plane.distance / plane.normal[2]
    return float(height_m / away)


def standing(normal: Floats, height: float, place: tuple[float, float], heading_rad: float) -> Floats:
    """cam_T_world [4, 4] of a camera over the plane n·x = d of its own axes.

    World z is -n; the camera's u axis seen from above has the heading.
    """
    up = -normal
    along = np.array([1.0, 0.0, 0.0])
    along -= (along @ up) * up
    along /= np.linalg.norm(along)
    left = np.cross(up, along)
    c, s = np.cos(heading_rad), np.sin(heading_rad)
    # rows: world axes in camera axes
    world_r_cam = np.stack([c * along - s * left, s * along + c * left, up])
    pose = np.eye(4)
    pose[:3, :3] = world_r_cam.T
    pose[:3, 3] = -world_r_cam.T @ np.array([*place, height])
    return pose
