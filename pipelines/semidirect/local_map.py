"""The map: keyframes, points with the keyframes that saw them, and the depth filters that become points.

All of it is arrays that are replaced, never written to, so that tracking can use a map while the next one is made.
Points, observations and filters are in the order of their numbers; observations are rows of keyframes and points.
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from pipelines.compiled import compiled
from pipelines.geometry import se3_inverse
from pipelines.semidirect.optics import Optics, project
from pipelines.semidirect.pyramid import Grey, Pyramid
from pipelines.semidirect.refinement import Observations

Floats = NDArray[np.float64]
Longs = NDArray[np.int64]
Flags = NDArray[np.bool_]
Rows = TypeVar("Rows", bound=tuple[NDArray[np.generic], ...])


class PointState(IntEnum):
    """How far a point is trusted; better ones are looked for first."""

    CANDIDATE = 0
    """From a depth filter, not yet seen by another keyframe."""
    KNOWN = 1
    """Seen by two keyframes at least."""
    GOOD = 2
    """Found in many frames."""


class Keyframes(NamedTuple):
    """K keyframes, oldest first: frame `number` [K], `cam_t_world` [K, 4, 4], pyramids' buffers `grey` [K, size]."""

    number: Longs
    cam_t_world: Floats
    grey: Grey


class Points(NamedTuple):
    """P points.

    `number` [P] ascending; `place` [P, 3] in the world with its `covariance` [P, 3, 3] for errors of 1 px, NaN
    while unknown; `sigma` [P] along the ray of the first view; `state` [P] a
    `PointState`; `found` [P] frames that found it, `missed` [P] frames in a row that did not.
    """

    number: Longs
    place: Floats
    covariance: Floats
    sigma: Floats
    state: Longs
    found: Longs
    missed: Longs


class Filters(NamedTuple):
    """S depth filters.

    `number` [S], which their points keep; `keyframe` [S] the frame number of theirs; the corner's `pixel` [S, 2] and
    `level` [S]; its unit `bearing` [S, 3] there; the `belief` [S, 4] μ, σ², a, b; `reach` [S] z_range; `age` [S].
    """

    number: Longs
    keyframe: Longs
    pixel: Floats
    level: Longs
    bearing: Floats
    belief: Floats
    reach: Floats
    age: Longs


class LocalMap(NamedTuple):
    """Keyframes, points, who saw which (`seen`), filters, and the `next_number` of a point or filter."""

    keyframes: Keyframes
    points: Points
    seen: Observations
    filters: Filters
    next_number: int


class Sightings(NamedTuple):
    """Points found in a frame: rows of the map's points [n], ascending, `pixels` [n, 2] on level 0, `level` [n]."""

    rows: Longs
    pixels: Floats
    level: Longs


def taken(table: Rows, which: Flags | Longs) -> Rows:
    """The chosen rows of a table of arrays."""
    return type(table)(*(column[which] for column in table))


def joined(first: Rows, second: Rows) -> Rows:
    """The rows of both tables, one after the other."""
    return type(first)(*(np.concatenate(pair) for pair in zip(first, second, strict=True)))


def no_filters() -> Filters:
    """An empty table."""
    zero, whole = np.zeros(0), np.zeros(0, np.int64)
    return Filters(whole, whole, np.zeros((0, 2)), whole, np.zeros((0, 3)), np.zeros((0, 4)), zero, whole)


def new_points(number: Longs, place: Floats, covariance: Floats, sigma: Floats, state: PointState) -> Points:
    """Points that no frame has looked for yet."""
    zeros = np.zeros(len(number), np.int64)
    return Points(number, place, covariance, sigma, np.full(len(number), int(state)), zeros, zeros)


def rows_of(numbers: Longs, wanted: Longs) -> Longs:
    """The row of each wanted number in an ascending column, -1 where it is not there."""
    if not len(numbers):
        return np.full(len(wanted), -1)
    rows = np.minimum(np.searchsorted(numbers, wanted), len(numbers) - 1)
    return np.where(numbers[rows] == wanted, rows, -1)


def owners(seen: Observations) -> Longs:
    """The point's row of each observation [m]."""
    return np.repeat(np.arange(len(seen.first) - 1), np.diff(seen.first))


def observations_of(point: Longs, frame: Longs, pixels: Floats, level: Longs, points: int) -> Observations:
    """Observations of so many points, in any order, as the map holds them: by point, then as they come."""
    order = np.argsort(point, kind="stable")
    first = np.concatenate([[0], np.cumsum(np.bincount(point, minlength=points))]).astype(np.int64)
    return Observations(first, frame[order], np.ascontiguousarray(pixels[order]), level[order])


# ------------------------------------------------------------------------------------ changes


def with_points(world: LocalMap, points: Points, seen_in: Longs, pixels: Floats, level: Longs) -> LocalMap:
    """The map with new points, each seen by one keyframe: its row [n], the pixels [n, 2] and level [n] there."""
    merged = joined(world.points, points)
    owner = np.concatenate([owners(world.seen), np.arange(len(world.points.number), len(merged.number))])
    seen = world.seen
    frame, where = np.concatenate([seen.frame, seen_in]), np.concatenate([seen.pixels, pixels])
    order = np.argsort(merged.number, kind="stable")
    place = np.empty_like(order)
    place[order] = np.arange(len(order))
    found = observations_of(place[owner], frame, where, np.concatenate([seen.level, level]), len(order))
    return world._replace(points=taken(merged, order), seen=found)


def with_keyframe(
    world: LocalMap, number: int, cam_t_world: Floats, pyramid: Pyramid, sightings: Sightings
) -> LocalMap:
    """The map with a new keyframe, which saw some of its points."""
    k, seen, rows = world.keyframes, world.seen, sightings.rows
    keyframes = Keyframes(
        np.append(k.number, number),
        np.concatenate([k.cam_t_world, cam_t_world[None]]),
        np.concatenate([k.grey, pyramid.buffer[None]]),
    )
    found = observations_of(
        np.concatenate([owners(seen), rows]),
        np.concatenate([seen.frame, np.full(len(rows), len(k.number))]),
        np.concatenate([seen.pixels, sightings.pixels]),
        np.concatenate([seen.level, sightings.level]),
        len(world.points.number),
    )
    state = world.points.state.copy()
    state[rows] = np.maximum(state[rows], PointState.KNOWN)
    return world._replace(keyframes=keyframes, points=world.points._replace(state=state), seen=found)


def without_keyframe(world: LocalMap, row: int) -> tuple[LocalMap, int]:
    """The map without a keyframe, its filters and the points that no other keyframe saw; and how many these were."""
    kept = np.arange(len(world.keyframes.number)) != row
    number = world.keyframes.number[row]
    stays = world.seen.frame != row
    shorter = with_observations(world, stays)
    frame = shorter.seen.frame - (shorter.seen.frame > row)
    shorter = shorter._replace(
        keyframes=taken(world.keyframes, kept),
        seen=shorter.seen._replace(frame=frame),
        filters=taken(world.filters, world.filters.keyframe != number),
    )
    orphans = np.diff(shorter.seen.first) == 0
    return without_points(shorter, orphans), int(np.count_nonzero(orphans))


def with_observations(world: LocalMap, stays: Flags) -> LocalMap:
    """The map with only some of its observations [m]; points may be left without any."""
    seen, owner = world.seen, owners(world.seen)
    kept = observations_of(
        owner[stays], seen.frame[stays], seen.pixels[stays], seen.level[stays], len(world.points.number)
    )
    return world._replace(seen=kept)


def without_points(world: LocalMap, gone: Flags) -> LocalMap:
    """The map without some of its points [P]."""
    if not gone.any():
        return world
    owner = owners(world.seen)
    stays = ~gone[owner]
    row = np.cumsum(~gone) - 1
    seen = world.seen
    kept = observations_of(
        row[owner[stays]], seen.frame[stays], seen.pixels[stays], seen.level[stays], int(np.count_nonzero(~gone))
    )
    return world._replace(points=taken(world.points, ~gone), seen=kept)


def scaled(world: LocalMap, factor: float, about: Floats) -> LocalMap:
    """The map with all lengths times a factor; the place `about` [3] stays."""

    def moved(places: Floats) -> Floats:
        return np.asarray(about + factor * (places - about))

    poses = world.keyframes.cam_t_world.copy()
    for pose in poses:
        pose[:3, 3] = -pose[:3, :3] @ moved(centre_of(pose))
    points = world.points._replace(
        place=moved(world.points.place),
        covariance=world.points.covariance * factor**2,
        sigma=world.points.sigma * factor,
    )
    belief = world.filters.belief / np.array([factor, factor**2, 1, 1])
    filters = world.filters._replace(belief=belief, reach=world.filters.reach / factor)
    return world._replace(keyframes=world.keyframes._replace(cam_t_world=poses), points=points, filters=filters)


# ---------------------------------------------------------------------------------- questions


def centre_of(cam_t_world: Floats) -> Floats:
    """The camera's centre [3] in the world."""
    return np.asarray(se3_inverse(cam_t_world)[:3, 3])


def centres_of(cams_t_world: Floats) -> Floats:
    """The cameras' centres [k, 3] in the world: -Rᵀ t."""
    return np.asarray(-np.einsum("kji,kj->ki", cams_t_world[:, :3, :3], cams_t_world[:, :3, 3]))


def pyramid_in(world: LocalMap, row: int, like: Pyramid) -> Pyramid:
    """The pyramid of a keyframe, of the size of another."""
    return Pyramid(world.keyframes.grey[row], like.height, like.width)


@compiled
def projections(optics: Optics, places: Floats, cam_T_world: Floats) -> Floats:
    """Pixels and depths (u, v, z) [n, 3] of places [n, 3] of the world; NaN for those that have no pixel."""
    t, found = cam_T_world, np.empty((len(places), 3))
    for i in range(len(places)):
        x, y, z = places[i]
        a = t[0, 0] * x + t[0, 1] * y + t[0, 2] * z + t[0, 3]
        b = t[1, 0] * x + t[1, 1] * y + t[1, 2] * z + t[1, 3]
        c = t[2, 0] * x + t[2, 1] * y + t[2, 2] * z + t[2, 3]
        place = project(optics, a, b, c)
        found[i, 0], found[i, 1], found[i, 2] = place.u, place.v, c
    return found
