"""The camera's pose in a frame, from the map: sparse alignment, feature alignment, pose refinement (paper C).

Nothing of the map is changed here; what was found and missed is the mapping's to note.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipelines.compiled import compiled
from pipelines.geometry import se3_inverse, se3_product
from pipelines.semidirect import alignment, refinement
from pipelines.semidirect.alignment import Alignment
from pipelines.semidirect.features import SIDE, FeatureOptions, Features, align_feature, nearest_view, no_features
from pipelines.semidirect.local_map import LocalMap, Sightings, centre_of, centres_of, projections, rows_of
from pipelines.semidirect.optics import Optics, rays
from pipelines.semidirect.pyramid import Grey, Pyramid
from pipelines.semidirect.refinement import Observations, PoseOptions, RefinedPose
from pipelines.semidirect.settings import SemidirectSettings
from pipelines.semidirect.step import Feature

Floats = NDArray[np.float64]
Longs = NDArray[np.int64]
Flags = NDArray[np.bool_]

MATCHED = int(Feature.MATCHED)
EDGE_PX = 8
"""A point nearer to the border of the image is not looked for: its patch would reach out."""
VIEWS_COUNTED = 1000
SEED = 1
"""Of the order in which cells are served."""


class Known(NamedTuple):
    """A frame whose pose is known: what the next one is aligned with.

    `number` of the frame, `t_ns`, its pyramid, `cam_t_world` [4, 4], and the map points found in it: their numbers
    `point` [n] and `pixels` [n, 2].
    """

    number: int
    t_ns: int
    pyramid: Pyramid
    cam_t_world: Floats
    point: Longs
    pixels: Floats


class Looked(NamedTuple):
    """The map points that were looked for in a frame: rows of the map [n], what came out, and `Feature`s [n]."""

    rows: Longs
    features: Features
    outcome: Longs


class Tracked(NamedTuple):
    """A frame's pose and all that led to it.

    `cam_t_world` [4, 4]; `aligned` is None where there was nothing to align with. `error_px` [n] is each looked-for
    point's error at the final pose, NaN where it was not found. `depth` is the median depth of the points found.
    """

    cam_t_world: Floats
    prior: Floats
    aligned: Alignment | None
    aligned_px: Floats
    aligned_pose: Floats
    looked: Looked
    pose: RefinedPose | None
    error_px: Floats
    sightings: Sightings
    depth: float

    @property
    def points(self) -> int:
        """How many map points agree with the pose."""
        return len(self.sightings.rows)

    def unlike(self, most_error_px: float, least_correlation: float) -> bool:
        """Whether the points neither agree well nor look like their patches.

        So it is where the camera is elsewhere: the alignments settle on whatever is near, and half of them agree by
        chance. Noise and blur cost likeness too, but the points then agree; both are told by medians over all found.
        """
        found = np.isfinite(self.error_px)
        return bool(
            found.any()
            and np.median(self.error_px[found]) > most_error_px
            and np.median(self.looked.features.correlation[found]) < least_correlation
        )


Lap = Callable[[int], None]


def _no_lap(stage: int) -> None:
    """Nobody wants to know."""


class Tracker:
    """Tracks frames of one camera.

    Args:
        optics: the camera.
        size: its image, height and width, px.
        settings: all settings.
    """

    def __init__(self, optics: Optics, size: tuple[int, int], settings: SemidirectSettings) -> None:
        s = settings
        self.optics, self.settings = optics, s
        self._columns = -(-size[1] // s.cell_px)
        cells = self._columns * -(-size[0] // s.cell_px)
        self._turn = np.random.default_rng(SEED).permutation(cells)
        self._levels = alignment.Options(
            s.align_coarsest, s.align_finest, s.align_iterations, s.align_tolerance, s.illumination
        )
        self._features = FeatureOptions(s.feature_iterations, s.feature_tolerance_px, s.min_view_cosine)
        self._pose = PoseOptions(iterations=s.pose_iterations, inlier_px=s.inlier_px)

    def track(self, world: LocalMap, last: Known, frame: Pyramid, prior: Floats, lap: Lap = _no_lap) -> Tracked:
        """The pose of a frame; `prior` [4, 4] is the motion cur_T_last that it starts from.

        `lap` is told when the alignment (1) and the rest (2) are done.
        """
        start = se3_product(prior, last.cam_t_world)
        found, px = self.align(world, last, frame, prior)
        pose = start if found is None else se3_product(found.cur_t_ref, last.cam_t_world)
        lap(1)
        refined = self.refined(world, frame, pose)
        lap(2)
        return refined._replace(prior=start, aligned=found, aligned_px=px, aligned_pose=pose)

    def align(self, world: LocalMap, last: Known, frame: Pyramid, prior: Floats) -> tuple[Alignment | None, Floats]:
        """The motion from a known frame by sparse alignment; and the patches' places there [n, 2].

        None where the known frame has too few points of this map.
        """
        rows = rows_of(world.points.number, last.point)
        px = np.ascontiguousarray(last.pixels[rows >= 0])
        points = on_rays(self.optics, px, world.points.place[rows[rows >= 0]], last.cam_t_world)
        if len(points) < alignment.MIN_PATCHES:
            return None, px
        return alignment.align(last.pyramid, frame, self.optics, px, points, prior, self._levels), px

    def refined(self, world: LocalMap, frame: Pyramid, start: Floats, *, every: bool = False) -> Tracked:
        """The pose of a frame that is about right already: features aligned, pose refined.

        By one point a cell and `max_features` in all, or by every point that the frame lets be expected in its view.
        """
        looked = self._look(world, frame, start, every)
        found, outcome = looked.features, looked.outcome
        good = np.flatnonzero(outcome == Feature.MATCHED)
        error_px = np.full(len(outcome), np.nan)
        refined, pose = None, start
        if len(good) >= alignment.MIN_PATCHES:
            places = world.points.place[looked.rows[good]]
            pixels, level = found.pixels[good], found.level[good]
            refined = refinement.refine_pose(self.optics, places, pixels, level, start, self._pose)
            pose, error_px[good] = refined.cam_t_world, refined.error_px
            outcome[good[~refined.inlier]] = Feature.OUTLIER
            good = good[refined.inlier]
        else:
            good = good[:0]
        order = good[np.argsort(looked.rows[good])]
        sightings = Sightings(looked.rows[order], found.pixels[order], found.level[order])
        depth = projections(self.optics, world.points.place[sightings.rows], pose)[:, 2]
        return Tracked(
            cam_t_world=pose,
            prior=start,
            aligned=None,
            aligned_px=np.zeros((0, 2)),
            aligned_pose=start,
            looked=looked,
            pose=refined,
            error_px=error_px,
            sightings=sightings,
            depth=float(np.median(depth)) if len(depth) else np.nan,
        )

    def _look(self, world: LocalMap, frame: Pyramid, pose: Floats, every: bool) -> Looked:
        """Look for the map's points around where the pose lets them be expected."""
        points, keyframes, seen = world.points, world.keyframes, world.seen
        places = projections(self.optics, points.place, pose)
        u, v = places[:, 0], places[:, 1]
        inside = (u >= EDGE_PX) & (u < frame.width - EDGE_PX) & (v >= EDGE_PX) & (v < frame.height - EDGE_PX)
        rows = np.flatnonzero(inside)
        if every:
            cell, wanted = np.arange(len(rows)), len(rows)
        else:
            rows, cell = self._served(world, rows, u[rows], v[rows])
            wanted = self.settings.max_features
        rows, found = find_points(
            keyframes.grey,
            frame,
            self.optics,
            relative(pose, keyframes.cam_t_world),
            keyframes.cam_t_world,
            centres_of(keyframes.cam_t_world),
            centre_of(pose),
            points.place,
            seen,
            rows,
            cell,
            wanted,
            self._features,
        )
        return Looked(rows, found, found.outcome.copy())

    def _served(self, world: LocalMap, rows: Longs, u: Floats, v: Floats) -> tuple[Longs, Longs]:
        """Rows of points in the order in which they are looked for, cell by cell, the best first; and their cells."""
        side = self.settings.cell_px
        cell = (v // side).astype(np.int64) * self._columns + (u // side).astype(np.int64)
        views = np.minimum(np.diff(world.seen.first)[rows], VIEWS_COUNTED - 1)
        worth = world.points.state[rows] * VIEWS_COUNTED + views
        order = np.argsort(self._turn[cell] * 4 * VIEWS_COUNTED - worth, kind="stable")
        return rows[order], cell[order]


@compiled
def find_points(
    keyframes: Grey,
    frame: Pyramid,
    optics: Optics,
    cur_T_key: Floats,
    keys_t_world: Floats,
    key_centres: Floats,
    centre: Floats,
    places: Floats,
    seen: Observations,
    rows: Longs,
    cell: Longs,
    wanted: int,
    options: FeatureOptions,
) -> tuple[Longs, Features]:
    """Look for map points in a frame, one a cell, until enough are found.

    Args:
        keyframes: the buffers [k, size] of the keyframes' pyramids.
        frame: where to look.
        optics: the camera.
        cur_T_key: transforms [k, 4, 4] from each keyframe to the frame, as known so far.
        keys_t_world: the keyframes' poses [k, 4, 4].
        key_centres: their cameras' centres [k, 3].
        centre: that of the frame's camera [3].
        places: the map's points [P, 3].
        seen: who saw them.
        rows: the points to look for, in this order [n].
        cell: the cell [n] that each lies in; one that has a point is not tried again.
        wanted: so many points are enough.
        options: stop rules.

    Returns:
        The rows that were tried and what came out.
    """
    n, facing = len(rows), np.array([0.0, 0.0, 1.0])
    found, patch = no_features(n), np.empty((SIDE + 2, SIDE + 2))
    taken = np.zeros(cell.max() + 1 if n else 0, np.bool_)
    tried, count = np.empty(n, np.int64), 0
    m = 0
    for i in range(n):
        if count == wanted:
            break
        if taken[cell[i]]:
            continue
        row = rows[i]
        place = places[row]
        j, cosine = nearest_view(place, centre, seen.first[row], seen.first[row + 1], seen.frame, key_centres)
        k = seen.frame[j]
        t = keys_t_world[k]
        depth = t[2, 0] * place[0] + t[2, 1] * place[1] + t[2, 2] * place[2] + t[2, 3]
        key = Pyramid(keyframes[k], frame.height, frame.width)
        align_feature(
            key, frame, optics, cur_T_key[k], seen.pixels[j], seen.level[j], depth, facing, cosine, options, patch,
            found, m,
        )  # fmt: skip
        tried[m] = row
        if found.outcome[m] == MATCHED:
            taken[cell[i]] = True
            count += 1
        m += 1
    return tried[:m].copy(), Features(
        found.pixels[:m].copy(), found.predicted[:m].copy(), found.level[:m].copy(), found.outcome[:m].copy(),
        found.mean_difference[:m].copy(), found.residual_rms[:m].copy(), found.correlation[:m].copy(),
        found.iterations[:m].copy(), found.affine[:m].copy(),
    )  # fmt: skip


@compiled
def relative(cam_t_world: Floats, cams_t_world: Floats) -> Floats:
    """cur_T_key [k, 4, 4] of a camera and k keyframes."""
    found = np.empty((len(cams_t_world), 4, 4))
    for k in range(len(cams_t_world)):
        found[k] = se3_product(cam_t_world, se3_inverse(cams_t_world[k]))
    return found


def on_rays(optics: Optics, pixels: Floats, places: Floats, cam_t_world: Floats) -> Floats:
    """Points [n, 3] in camera axes on the rays of their pixels [n, 2], with the depth of places [n, 3] in the world."""
    depth = places @ cam_t_world[2, :3] + cam_t_world[2, 3]
    return np.asarray(rays(optics, pixels) * depth[:, None])
