"""The map after a frame: depth filters updated, converged ones made points, keyframes taken and dropped.

All changes are new arrays, so that the map before stays whole for who still uses it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry import se3_exp, se3_inverse, se3_log, se3_product
from pipelines.semidirect import depth_filter, epipolar, refinement
from pipelines.semidirect.features import CornerOptions, corners, occupied_cells
from pipelines.semidirect.local_map import (
    Filters,
    LocalMap,
    PointState,
    Sightings,
    centre_of,
    centres_of,
    joined,
    new_points,
    observations_of,
    owners,
    projections,
    pyramid_in,
    rows_of,
    taken,
    with_keyframe,
    with_observations,
    with_points,
    without_keyframe,
    without_points,
)
from pipelines.semidirect.optics import rays
from pipelines.semidirect.pyramid import Pyramid
from pipelines.semidirect.refinement import Bundle, BundleOptions, Observations
from pipelines.semidirect.tracking import Tracker

Floats = NDArray[np.float64]
Longs = NDArray[np.int64]
Flags = NDArray[np.bool_]

GOOD_AFTER = 10
"""Frames that find a point before it counts as good."""
LEAST_POINTS = 20
"""Fewer are no bundle."""
GIVEN_UP = 5
"""Place of the filters that were let go in `Growth.filter_count`, after the depth filter's own outcomes."""


class Posed(NamedTuple):
    """A frame with its pose, as the mapping gets it.

    `number`, its pyramid, `cam_t_world` [4, 4]; the numbers of the points `found` [n] with their `pixels` [n, 2]
    and `level` [n], and of those `missed` [m]; the median `depth` of those found.
    """

    number: int
    pyramid: Pyramid
    cam_t_world: Floats
    found: Longs
    pixels: Floats
    level: Longs
    missed: Longs
    depth: float


class Watched(NamedTuple):
    """The filters that were at work in a frame, after it: the tables, and what their searches gave.

    `outcome` [s] `depth_filter.Outcome`, `match` [s] `epipolar.Match`, `inlier` [s] C1, `segment` [s, 4] far and near
    end in px, `found_px` [s, 2].
    """

    filters: Filters
    outcome: Longs
    match: Longs
    inlier: Floats
    segment: Floats
    found_px: Floats


class Growth(NamedTuple):
    """What a frame did to the map.

    `keyframe` says whether it became one, `cam_t_world` [4, 4] its pose after that; `shift` [4, 4] is how the bundle
    moved it, and with it poses that were found in the map before: T ← T shift. `sighted` are the points that it sees as
    a keyframe; `distance` to the nearest keyframe before, over the depth. `removed` [3]: points that went with
    their keyframe, that were not found again, outliers of the bundle adjustment. `filter_count` [6] by
    `depth_filter.Outcome`, and those given up.
    """

    world: LocalMap
    keyframe: bool
    cam_t_world: Floats
    shift: Floats
    sighted: int
    distance: float
    keyframe_removed: int
    refined: int
    added: int
    removed: Longs
    bundle: Bundle | None
    bundle_keyframes: int
    watched: Watched
    filter_count: Longs


class Mapper:
    """Grows the map of one camera.

    Args:
        tracker: finds the map's points in a keyframe; the camera and all settings are its.
    """

    def __init__(self, tracker: Tracker) -> None:
        s = tracker.settings
        self.optics, self.settings, self._tracker = tracker.optics, s, tracker
        self._corners = CornerOptions(s.cell_px, s.corner_threshold, s.corner_min_score)
        self._limits = epipolar.Limits(worst_score=s.epipolar_score)
        self._bundle = BundleOptions(s.bundle_iterations, s.bundle_huber_px, inlier_px=s.inlier_px)

    # ---------------------------------------------------------------------------- one frame

    def grown(self, world: LocalMap, posed: Posed) -> Growth:
        """The map after a frame whose pose is known."""
        removed = np.zeros(3, np.int64)
        world, removed[1] = self._counted(world, posed)
        world, watched, added, filter_count = self._filtered(world, posed)
        distance = nearest_keyframe(world, posed.cam_t_world) / posed.depth
        keyframe = bool(distance > self.settings.keyframe_distance)
        bundle, taking_part, dropped, pose, sighted, refined = None, 0, -1, posed.cam_t_world, 0, 0
        shift = np.eye(4)
        if keyframe:
            pose, sightings = self._sighted(world, posed)
            sighted = len(sightings.rows)
            world = with_keyframe(world, posed.number, pose, posed.pyramid, sightings)
            if self.settings.bundle_keyframes:
                found, (world, bundle, taking_part, removed[2]) = pose, self._bundled(world)
                pose = world.keyframes.cam_t_world[-1]
                shift = motion_between(found, pose)
            world, refined = self._refined(world)
            if len(world.keyframes.number) > self.settings.max_keyframes:
                world, dropped, removed[0] = _without_farthest(world, pose)
            world, gone = self._without_old_filters(world)
            filter_count[GIVEN_UP] += gone
            world = self.with_filters(world, posed.pyramid, posed.depth)
        return Growth(
            world=world,
            keyframe=keyframe,
            cam_t_world=pose,
            shift=shift,
            sighted=sighted,
            distance=distance,
            keyframe_removed=dropped,
            refined=refined,
            added=added,
            removed=removed,
            bundle=bundle,
            bundle_keyframes=taking_part,
            watched=watched,
            filter_count=filter_count,
        )

    def _counted(self, world: LocalMap, posed: Posed) -> tuple[LocalMap, int]:
        """Note which points were found and which not; points that are not found again go."""
        s, points = self.settings, world.points
        hit, miss = (rows[rows >= 0] for rows in (rows_of(points.number, n) for n in (posed.found, posed.missed)))
        found, missed, state = points.found.copy(), points.missed.copy(), points.state.copy()
        found[hit] += 1
        missed[hit] = 0
        missed[miss] += 1
        state[(state == PointState.KNOWN) & (found >= GOOD_AFTER)] = PointState.GOOD
        limit = np.where(state == PointState.CANDIDATE, s.candidate_failures, s.point_failures)
        gone = missed > limit
        world = world._replace(points=points._replace(found=found, missed=missed, state=state))
        return without_points(world, gone), int(np.count_nonzero(gone))

    # ---------------------------------------------------------------------------- filters

    def begun(self, world: LocalMap, pyramid: Pyramid, depth: float) -> LocalMap:
        """The first map with its points refined, and filters for its last keyframe."""
        return self.with_filters(self._refined(world)[0], pyramid, depth)

    def with_filters(self, world: LocalMap, pyramid: Pyramid, depth: float) -> LocalMap:
        """The map with a filter for the best corner of each cell of the last keyframe that has no point."""
        k = world.keyframes
        pose = k.cam_t_world[-1]
        seen = projections(self.optics, world.points.place, pose)[:, :2]
        held = occupied_cells(pyramid, seen[np.isfinite(seen).all(axis=1)], self._corners)
        found = corners(pyramid, held, self._corners)
        n = len(found.level)
        bearing = rays(self.optics, found.pixels)
        bearing /= np.linalg.norm(bearing, axis=1)[:, None]
        # the filter's depth is along the ray: that of a surface which faces the camera grows to the image's corners
        away = depth / bearing[:, 2]
        least = self.settings.filter_min_depth * away
        belief = np.array([depth_filter.started(*pair) for pair in zip(away, least, strict=True)]).reshape(n, 4)
        reach = 1.0 / least
        number = world.next_number + np.arange(n)
        fresh = Filters(
            number, np.full(n, k.number[-1]), found.pixels, found.level, bearing, belief, reach, np.zeros(n, np.int64)
        )
        filters = joined(world.filters, taken(fresh, np.isfinite(bearing).all(axis=1)))
        return world._replace(filters=filters, next_number=world.next_number + n)

    def _filtered(self, world: LocalMap, posed: Posed) -> tuple[LocalMap, Watched, int, Longs]:
        """All filters updated by a frame; converged ones become points, diverged ones go."""
        filters, n = world.filters, len(world.filters.number)
        record = np.empty((n, len(epipolar.RECORD)))
        for number in np.unique(filters.keyframe):
            self._search(world, posed, np.flatnonzero(filters.keyframe == number), record)
        inverse, tau, seen = epipolar.measurements(record)
        state = np.ascontiguousarray(filters.belief.T)
        inlier, outcome = np.full(n, np.nan), np.zeros(n, np.int64)
        share = self.settings.filter_converged
        depth_filter.update_bank(state, filters.reach, inverse, tau, seen, share, inlier, outcome)
        after = filters._replace(belief=np.ascontiguousarray(state.T), age=filters.age + 1)
        watched = Watched(
            after,
            outcome,
            record[:, 0].astype(np.int64),
            inlier,
            record[:, [epipolar.RECORD.index(name) for name in ("far_u", "far_v", "near_u", "near_v")]],
            record[:, [epipolar.RECORD.index(name) for name in ("u", "v")]],
        )
        count = np.bincount(outcome, minlength=6)
        done, lost = outcome == depth_filter.CONVERGED, outcome == depth_filter.DIVERGED
        world = self._with_converged(world, taken(after, done))
        return world._replace(filters=taken(after, ~(done | lost))), watched, int(np.count_nonzero(done)), count

    def _search(self, world: LocalMap, posed: Posed, rows: Longs, record: Floats) -> None:
        """Look for the corners of one keyframe in a frame; enter what came out in their rows of the record."""
        filters = world.filters
        key = int(rows_of(world.keyframes.number, filters.keyframe[rows[:1]])[0])
        cur_T_key = se3_product(posed.cam_t_world, se3_inverse(world.keyframes.cam_t_world[key]))
        part = np.empty((len(rows), record.shape[1]))
        belief = filters.belief[rows]
        epipolar.search_bank(
            self.optics,
            pyramid_in(world, key, posed.pyramid),
            posed.pyramid,
            filters.pixel[rows],
            filters.bearing[rows],
            filters.level[rows],
            belief[:, 0].copy(),
            np.sqrt(belief[:, 1]),
            cur_T_key[:3, :3].copy(),
            cur_T_key[:3, 3].copy(),
            self._limits,
            part,
        )
        record[rows] = part

    def _with_converged(self, world: LocalMap, done: Filters) -> LocalMap:
        """The map with the points of converged filters, candidates that only their own keyframe has seen."""
        if not len(done.number):
            return world
        rows = rows_of(world.keyframes.number, done.keyframe)
        poses = world.keyframes.cam_t_world[rows]
        mu, variance = done.belief[:, 0], done.belief[:, 1]
        in_key = done.bearing / mu[:, None]
        place = centres_of(poses) + np.einsum("nji,nj->ni", poses[:, :3, :3], in_key)
        sigma = np.sqrt(variance) / mu**2
        ray = np.einsum("nji,nj->ni", poses[:, :3, :3], done.bearing)
        covariance = covariance_on_ray(ray, sigma, 1 / (mu * self.optics.focal_u))
        points = new_points(done.number, place, covariance, sigma, PointState.CANDIDATE)
        return with_points(world, points, rows, done.pixel, done.level)

    def _without_old_filters(self, world: LocalMap) -> tuple[LocalMap, int]:
        """Only the filters of the last keyframes are kept."""
        newest = world.keyframes.number[-self.settings.filter_keyframes :]
        stays = np.isin(world.filters.keyframe, newest)
        return world._replace(filters=taken(world.filters, stays)), int(np.count_nonzero(~stays))

    # ---------------------------------------------------------------------------- refinement

    def _sighted(self, world: LocalMap, posed: Posed) -> tuple[Floats, Sightings]:
        """The pose [4, 4] of a new keyframe and the points that it sees.

        All points of the map in its view are looked for, and the pose is by all that were found: every later frame
        and filter builds upon it, and tracking needs too few points for that. Where this finds fewer than tracking
        did, what tracking found holds.
        """
        tracked = sightings_of(world, posed)
        if self.settings.keyframe_points == "tracked":
            return posed.cam_t_world, tracked
        again = self._tracker.refined(world, posed.pyramid, posed.cam_t_world, every=True)
        if again.points < len(tracked.rows):
            return posed.cam_t_world, tracked
        return again.cam_t_world, again.sightings

    def _refined(self, world: LocalMap) -> tuple[LocalMap, int]:
        """All points that the last keyframe sees are refined on their own, by all of their views."""
        points, seen = world.points, world.seen
        of_last = owners(seen)[seen.frame == len(world.keyframes.number) - 1]
        rows = of_last[np.diff(seen.first)[of_last] > 1]
        if not len(rows):
            return world, 0
        chosen = _observations_of_points(seen, rows)
        done = refinement.refine_points(
            self.optics, world.keyframes.cam_t_world, chosen, points.place[rows], self.settings.refine_iterations
        )
        place, sigma = points.place.copy(), points.sigma.copy()
        place[rows] = done.points
        sigma[rows] = _along_ray(done.covariance, done.points, world, rows, sigma[rows])
        covariance = points.covariance.copy()
        told = np.isfinite(done.covariance).all(axis=(1, 2))
        covariance[rows[told]] = done.covariance[told]
        refined = points._replace(place=place, covariance=covariance, sigma=sigma)
        return world._replace(points=refined), len(rows)

    def _bundled(self, world: LocalMap) -> tuple[LocalMap, Bundle | None, int, int]:
        """Local bundle adjustment over the last keyframe and those that share most points with it.

        All views of their points count: keyframes beyond these are held as they are, and so are the two oldest.
        """
        sharing = sharing_keyframes(world, self.settings.bundle_keyframes)
        inside, owner = np.isin(world.seen.frame, sharing), owners(world.seen)
        takes_part = np.zeros(len(world.points.number), np.bool_)
        takes_part[owner[inside]] = True
        takes_part &= np.diff(world.seen.first) > 1
        points = np.flatnonzero(takes_part)
        if len(sharing) < 3 or len(points) < LEAST_POINTS:
            return world, None, 0, 0
        which = np.flatnonzero(takes_part[owner])
        rows = np.unique(world.seen.frame[which])
        fixed = ~np.isin(rows, sharing[2:])
        local = observations_of(
            np.searchsorted(points, owner[which]),
            np.searchsorted(rows, world.seen.frame[which]),
            world.seen.pixels[which],
            world.seen.level[which],
            len(points),
        )
        done = refinement.adjust(
            self.optics,
            world.keyframes.cam_t_world[rows],
            fixed,
            local,
            world.points.place[points],
            self._bundle,
        )
        poses, place = world.keyframes.cam_t_world.copy(), world.points.place.copy()
        poses[rows], place[points] = done.cams_t_world, done.points
        world = world._replace(
            keyframes=world.keyframes._replace(cam_t_world=poses), points=world.points._replace(place=place)
        )
        stays = np.ones(len(world.seen.frame), np.bool_)
        stays[which[~done.inlier]] = False
        world = with_observations(world, stays)
        orphans = np.diff(world.seen.first) == 0
        return without_points(world, orphans), done, len(sharing), int(np.count_nonzero(orphans))


# ---------------------------------------------------------------------------------- helpers


def covariance_on_ray(ray: Floats, along: Floats, across: Floats) -> Floats:
    """Covariance [n, 3, 3] of points by σ [n] along their unit rays [n, 3] and across: σ∥² f fᵀ + σ⊥² (I - f fᵀ)."""
    on_ray = ray[:, :, None] * ray[:, None, :]
    return np.asarray(along[:, None, None] ** 2 * on_ray + across[:, None, None] ** 2 * (np.eye(3) - on_ray))


def motion_between(before: Floats, after: Floats) -> Floats:
    """The shift [4, 4] with before · shift = after, its rotation orthonormal to the last digit.

    Poses take such shifts again and again: in Rᵀ R' what R lacks of a rotation would stand once more, and each
    product would treble it.
    """
    return se3_exp(se3_log(se3_product(se3_inverse(before), after)))


def nearest_keyframe(world: LocalMap, cam_t_world: Floats) -> float:
    """Distance from a camera to the nearest keyframe."""
    away = centres_of(world.keyframes.cam_t_world) - centre_of(cam_t_world)
    return float(np.sqrt(np.min(np.sum(away**2, axis=1))))


def sightings_of(world: LocalMap, posed: Posed) -> Sightings:
    """What the frame saw, in rows of the map's points by now."""
    rows = rows_of(world.points.number, posed.found)
    there = rows >= 0
    return Sightings(rows[there], posed.pixels[there], posed.level[there])


def sharing_keyframes(world: LocalMap, most: int) -> Longs:
    """Rows of the last keyframe and those that share most points with it, ascending."""
    seen, last = world.seen, len(world.keyframes.number) - 1
    owner = owners(seen)
    of_last = np.zeros(len(world.points.number), np.bool_)
    of_last[owner[seen.frame == last]] = True
    shared = np.bincount(seen.frame[of_last[owner]], minlength=last + 1)
    order = np.argsort(-shared[:last], kind="stable")[: most - 1]
    return np.sort(np.append(order[shared[order] > 0], last))


def _without_farthest(world: LocalMap, cam_t_world: Floats) -> tuple[LocalMap, int, int]:
    """The map without the keyframe that is farthest from a camera: its frame number, the points that went with it."""
    away = np.sum((centres_of(world.keyframes.cam_t_world) - centre_of(cam_t_world)) ** 2, axis=1)
    row = int(np.argmax(away))
    shorter, orphans = without_keyframe(world, row)
    return shorter, int(world.keyframes.number[row]), orphans


def _observations_of_points(seen: Observations, rows: Longs) -> Observations:
    """The observations of some points."""
    count = np.diff(seen.first)[rows]
    first = np.concatenate([[0], np.cumsum(count)]).astype(np.int64)
    which = np.repeat(seen.first[rows] - first[:-1], count) + np.arange(first[-1])
    return Observations(first, seen.frame[which], seen.pixels[which], seen.level[which])


def _along_ray(covariance: Floats, places: Floats, world: LocalMap, rows: Longs, before: Floats) -> Floats:
    """Standard deviation of points along the ray of their first view; as before where the views do not tell it."""
    first = world.seen.frame[world.seen.first[rows]]
    ray = places - centres_of(world.keyframes.cam_t_world[first])
    ray /= np.linalg.norm(ray, axis=1)[:, None]
    variance = np.einsum("ni,nij,nj->n", ray, covariance, ray)
    return np.where(np.isfinite(variance), np.sqrt(np.maximum(variance, 0.0)), before)
