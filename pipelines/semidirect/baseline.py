"""The PTAM-style baseline that the semi-direct odometry is compared with.

`BaselineOdometry` reads as a frame goes through it: corners on the pyramid's levels, points looked for in a coarse and
a fine step, the pose by robust least squares, now and then a keyframe with new points and bundle adjustments, in place
of PTAM's second thread. G. Klein, D. Murray, "Parallel tracking and mapping for small AR workspaces", ISMAR 2007, with
the changes for small UAVs of S. Weiss et al., "Monocular-SLAM-based navigation for autonomous micro helicopters in
GPS-denied environments", Journal of Field Robotics 28(6), 2011: no corners on level 0, a bounded number of keyframes, a
start without an operator. Search stands in `baseline_search.py`, the map in `baseline_map.py`. Axes and units are
those of `step.py`.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pipelines.correlation.odometry import eight_bit
from pipelines.estimator import EstimatorError, FrameImage, Images
from pipelines.geometry import se3_exp, se3_inverse, se3_log, se3_product, so3_exp, wrap_angle
from pipelines.semidirect import baseline_map, epipolar, scale
from pipelines.semidirect.baseline_map import Adjusted, Growth, Map, Seen
from pipelines.semidirect.baseline_search import (
    Matches,
    SearchOptions,
    View,
    correlation,
    find_points,
    free_corners,
    turn_between,
    view_of,
)
from pipelines.semidirect.baseline_settings import BaselineSettings
from pipelines.semidirect.baseline_step import STAGES, BaselineStep
from pipelines.semidirect.features import FeatureOptions
from pipelines.semidirect.optics import Optics, optics_of, rays
from pipelines.semidirect.pyramid import Grey, level_image
from pipelines.semidirect.refinement import BundleOptions, PoseOptions, RefinedPose, refine_pose
from pipelines.semidirect.start import Start, StartLimits, StartOutcome, start
from pipelines.semidirect.step import Feature, Stage
from pipelines.verdict import Verdict, gravest
from readers.streams import ImageError, ImageSample, Problem, Sample, StreamKind

Floats = NDArray[np.float64]
Longs = NDArray[np.int64]
Flags = NDArray[np.bool_]
T = TypeVar("T")
Notes = dict[str, Any]
"""Fields of the frame's Step, by name."""

INTERVALS = 15
"""Frames whose intervals make the running median."""
NEIGHBOURS = 4
"""Keyframes in which new points are looked for again."""
FLOW_WINDOW_PX = 21


class Trail(NamedTuple):
    """Corners that are followed from the first view of a start, of number `frame` at `t_ns`.

    `first_px` and `now_px` [n, 2] are their pixels there and in the last frame, `level` [n] theirs.
    """

    frame: int
    t_ns: int
    view: View
    first_px: Floats
    now_px: Floats
    level: Longs


class Unit(NamedTuple):
    """The scale: whether lengths are metres, metres of a unit of the first map and their standard deviation."""

    known: bool
    metres: float
    sigma: float


class Tracked(NamedTuple):
    """What tracking made of a frame.

    `prior` and `coarse` are poses [4, 4] before and after the coarse step; `rows` [M] the points of the fine step with
    their `match`, errors and whether they agree with the `pose`, which is None where too few were matched.
    """

    prior: Floats
    coarse: Floats
    coarse_tried: int
    coarse_found: int
    rows: Longs
    match: Matches
    pose: RefinedPose | None
    error_px: Floats
    inlier: Flags

    @property
    def agreeing(self) -> int:
        """Points that agree with the pose."""
        return int(np.count_nonzero(self.inlier))

    @property
    def share(self) -> float:
        """Their share of the points that were looked for."""
        return self.agreeing / max(len(self.rows), 1)


@dataclass(frozen=True, slots=True)
class BaselineState:
    """All that the baseline carries from frame to frame.

    `view`, `frame` and `t_ns` are those of the last frame that could be used; `trail` there is while a map is being
    started. `pose` is the last cam_T_world [4, 4] that was found, at `pose_ns`; `guess` goes on from there while lost,
    with the `velocity` [6], a twist per second.
    `since_bundle` counts the keyframes since the last global bundle.
    """

    frames: int = 0
    frame: int = -1
    t_ns: int = -1
    view: View | None = None
    optics: Optics | None = None
    intervals: tuple[float, ...] = ()
    trail: Trail | None = None
    map: Map | None = None
    map_number: int = -1
    unit: Unit = Unit(False, math.nan, math.nan)
    pose: Floats | None = None
    pose_ns: int = -1
    guess: Floats | None = None
    velocity: Floats | None = None
    lost_frames: int = 0
    relocalised_frames: int = -1
    points_made: int = 0
    since_bundle: int = 0


class BaselineOdometry:
    """Follows a camera by a map of points that it makes on the way, as PTAM does.

    Samples: images of one stream.

    Args:
        settings: every setting; see `BaselineSettings`.
    """

    name: ClassVar[str] = "ptam"
    step_type: ClassVar[type[BaselineStep]] = BaselineStep
    kinds: ClassVar[tuple[StreamKind, ...]] = (StreamKind.IMAGE,)

    def __init__(self, settings: BaselineSettings) -> None:
        s = self._settings = settings
        alignment = FeatureOptions(s.align_iterations)
        self._coarse = SearchOptions(
            s.coarse_px, s.max_score, s.max_score_share, s.finest_level, s.coarsest_level, s.finest_level, alignment
        )
        self._fine = self._coarse._replace(radius_px=s.fine_px, align_level=s.align_level)
        self._again = self._coarse._replace(radius_px=s.fine_px)
        limits = epipolar.Limits(worst_score=s.max_score, top_level=s.coarsest_level, iterations=s.align_iterations)
        self._growth = Growth(s.corner_cell_px, s.corner_min_score, s.depth_sigmas, s.min_depth_range, limits)

    @property
    def settings(self) -> BaselineSettings:
        """The frozen settings of this estimator."""
        return self._settings

    def start(self) -> BaselineState:
        """The state before the first sample."""
        return BaselineState()

    def step(self, state: BaselineState, sample: Sample, /) -> tuple[BaselineState, BaselineStep | None]:
        """Take one sample; an image, or the `Problem` of one, yields a Step.

        Raises:
            EstimatorError: the camera is unknown, or the images are not of its size or too small.
        """
        if isinstance(sample, ImageSample):
            try:
                grey = eight_bit(sample.grey())
            except ImageError:
                return self._skipped(state, sample, Verdict.UNDECODABLE)
            return self._image(state, sample, grey)
        if isinstance(sample, Problem) and sample.kind is StreamKind.IMAGE:
            return self._skipped(state, sample, Verdict.UNDECODABLE)
        return state, None

    # ---------------------------------------------------------------- going on from the middle

    def packed(self, state: BaselineState) -> BaselineState:
        """The state with the images of its frames by number, see `Resumable`."""
        return _with_views(state, lambda frame, _: FrameImage(frame), None)

    def unpacked(self, packed: Any, images: Images) -> BaselineState:
        """The state that was packed, see `Resumable`.

        Raises:
            EstimatorError: it is no state of this estimator.
        """
        if not isinstance(packed, BaselineState):
            raise EstimatorError(f"{type(packed).__name__} is no state of the estimator {self.name!r}; replay again")
        whole = _with_views(packed, lambda frame, _: self._view(eight_bit(images(frame))), None)
        if whole.map is None:
            return whole
        buffers = np.array([view.pyramid.buffer for view in whole.map.views])
        return replace(whole, map=replace(whole.map, buffers=buffers))

    def adopted(self, state: BaselineState) -> BaselineState:
        """The state under these settings, see `Resumable`.

        Raises:
            EstimatorError: the settings are of another camera, for which the map does not hold.
        """
        if state.view is not None and state.optics != self._optics(state.view):
            raise EstimatorError("the map was made with another camera: replay from the start, or keep the camera")
        return state

    # ------------------------------------------------------------------------------ one frame

    def _image(self, state: BaselineState, sample: ImageSample, grey: Grey) -> tuple[BaselineState, BaselineStep]:
        unusable = _unusable(state, sample, grey)
        if unusable:
            return self._skipped(state, sample, unusable)
        lap = _laps(self._settings.stage_times)
        view = self._view(grey)
        dt_s = (sample.t_ns - state.t_ns) * 1e-9 if state.view is not None else math.nan
        now = replace(
            state,
            frames=state.frames + 1,
            frame=_frame_of(state, sample),
            t_ns=sample.t_ns,
            view=view,
            optics=state.optics or self._optics(view),
            intervals=(*state.intervals[-INTERVALS + 1 :], *([dt_s] if dt_s == dt_s else [])),
            relocalised_frames=state.relocalised_frames + (state.relocalised_frames >= 0),
        )
        notes: Notes = {"corners": len(view.corners.column)}
        alarms = Verdict.OK
        if state.intervals and dt_s > self._settings.gap_factor * float(np.median(state.intervals)):
            alarms |= Verdict.FRAME_GAP
        image_ms = lap()
        if now.map is None:
            now, stage, found = self._starting(now, notes)
            track_ms, map_ms = lap(), math.nan
        else:
            now, tracked, stage, found = self._tracking(now, notes)
            track_ms, map_ms = lap(), math.nan
            if tracked is not None:
                now = self._mapping(now, tracked, notes)
                map_ms = lap()
        notes["stage_ms"] = np.array([image_ms, track_ms, map_ms])
        return now, self._record(state, now, sample, stage, alarms | found, notes)

    def _view(self, grey: Grey) -> View:
        s = self._settings
        try:
            return view_of(grey, s.finest_level, s.coarsest_level, s.corner_threshold)
        except ValueError as error:
            raise EstimatorError(str(error)) from error

    def _optics(self, view: View) -> Optics:
        try:
            return optics_of(self._settings.camera(view.pyramid.width, view.pyramid.height))
        except ValueError as error:
            raise EstimatorError(str(error)) from error

    def _skipped(
        self, state: BaselineState, sample: ImageSample | Problem, why: Verdict
    ) -> tuple[BaselineState, BaselineStep]:
        """A frame that cannot be used: the last pose is held."""
        new_state = replace(state, frames=state.frames + 1)
        return new_state, self._record(state, new_state, sample, Stage.SKIPPED, why, {})

    # ---------------------------------------------------------------------------------- start

    def _starting(self, now: BaselineState, notes: Notes) -> tuple[BaselineState, Stage, Verdict]:
        """Follow the corners of a first view, until they tell the motion and a first map."""
        s, view, optics = self._settings, _known(now.view), _known(now.optics)
        alarms = Verdict.LOST if now.map_number >= 0 else Verdict.OK
        trail = None if now.trail is None else followed(now.trail, view)
        if trail is None or len(trail.now_px) < s.start_min_matches:
            corners = free_corners(view, np.zeros((0, 2)), np.zeros(0, np.int64), s.corner_cell_px, s.corner_min_score)
            fresh = Trail(now.frame, now.t_ns, view, corners.pixels, corners.pixels, corners.level)
            notes |= {"start_matches": len(corners.pixels)}
            return replace(now, trail=fresh), Stage.FIRST, alarms or Verdict.FIRST_FRAME
        limits = StartLimits(
            s.start_min_matches, s.start_motion_px, s.start_parallax_px, s.inlier_px, s.start_min_inliers
        )
        solved = start(
            rays(optics, trail.first_px)[:, :2], rays(optics, trail.now_px)[:, :2], optics.focal_u, limits=limits
        )
        notes |= {
            "start_matches": len(trail.now_px),
            "start_motion_px": solved.motion_px,
            "start_parallax_px": solved.parallax_px,
        }
        now = replace(now, trail=trail)
        if solved.outcome is not StartOutcome.STARTED:
            return now, Stage.STARTING, alarms or Verdict.LOW_PARALLAX
        return self._first_map(now, trail, solved, notes), Stage.STARTED, Verdict.OK

    def _first_map(self, now: BaselineState, trail: Trail, solved: Start, notes: Notes) -> BaselineState:
        """The map of a start: its plane becomes z = 0 and its first view has the start's pose, or the last one known.

        A later map takes the height that the camera had last for its scale, which is not measured.
        """
        s, optics, view = self._settings, _known(now.optics), _known(now.view)
        plane = scale.plane_of(solved.points[solved.inlier])
        planar, height, unit = s.start_pose, plane.distance, Unit(False, math.nan, math.nan)
        if now.pose is not None:
            planar, height = _planar(s, now.pose), float(se3_inverse(now.pose)[2, 3])
        elif s.height_m is not None:
            height = s.height_m
            one = (np.array([x]) for x in (height, s.height_sigma_m, plane.distance, plane.sigma))
            found = scale.from_height(*one)
            unit = Unit(True, found.metres, found.sigma)
        size = height / plane.distance
        world_T_first = levelled(
            -plane.normal, planar[2] + s.mounting_yaw_rad, np.array([planar[0], planar[1], height])
        )
        second_T_first = np.eye(4)
        second_T_first[:3, :3], second_T_first[:3, 3] = solved.rotation, solved.translation * size
        pose = second_T_first @ se3_inverse(world_T_first)

        points = solved.points[solved.inlier] * size @ world_T_first[:3, :3].T + world_T_first[:3, 3]
        both, level = np.tile(np.arange(len(points)), 2), np.tile(trail.level[solved.inlier], 2)
        pixels = np.vstack([trail.first_px[solved.inlier], trail.now_px[solved.inlier]])
        seen = Seen(both, np.repeat([0, 1], len(points)), pixels, level)
        m = baseline_map.empty(len(view.pyramid.buffer), now.points_made)
        m = baseline_map.with_keyframe(m, trail.frame, trail.view, se3_inverse(world_T_first))
        m = baseline_map.with_keyframe(m, now.frame, view, pose)
        m = baseline_map.with_new_points(baseline_map.with_points(m, points, seen), optics, self._growth)
        depth = float(np.median(_depths(pose, points)))
        notes |= {"tracked": len(points), "keyframe": 1, "points_added": len(m.points), "scene_depth_m": depth}
        notes |= _structure(m, optics, 1.0)
        velocity = se3_log(second_T_first) / ((now.t_ns - trail.t_ns) * 1e-9)
        return replace(
            now,
            trail=None,
            map=m,
            map_number=now.map_number + 1,
            unit=unit,
            pose=pose,
            guess=pose,
            pose_ns=now.t_ns,
            velocity=velocity,
            lost_frames=0,
            since_bundle=0,
        )

    # ------------------------------------------------------------------------------- tracking

    def _tracking(self, now: BaselineState, notes: Notes) -> tuple[BaselineState, Tracked | None, Stage, Verdict]:
        """The pose by the motion model and the map; where that fails, by the keyframe that looks alike."""
        s, m, pose = self._settings, _known(now.map), _known(now.pose)
        motion = se3_exp(_known(now.velocity) * now.intervals[-1])
        now = replace(now, guess=se3_product(motion, _known(now.guess)))
        tracked = self._track(now, _known(now.guess))
        stage, alarms = Stage.TRACKED, Verdict.OK
        if not self._holds(tracked, s.good_share if now.lost_frames else s.lost_share):
            found = self._relocalised(now, notes)
            if found is None:
                notes |= _track_notes(m, tracked)
                return self._lost(now), None, Stage.LOST, Verdict.LOST
            tracked, stage, alarms = found, Stage.RELOCALISED, Verdict.REACQUIRED
        refined = _known(tracked.pose)
        moved = se3_log(se3_product(refined.cam_t_world, se3_inverse(pose)))
        now = replace(
            now,
            map=_counted(m, tracked),
            pose=refined.cam_t_world,
            pose_ns=now.t_ns,
            guess=refined.cam_t_world,
            velocity=np.zeros(6) if stage is Stage.RELOCALISED else moved / ((now.t_ns - now.pose_ns) * 1e-9),
            lost_frames=0,
            relocalised_frames=0 if stage is Stage.RELOCALISED else now.relocalised_frames,
        )
        notes |= _track_notes(m, tracked)
        return now, tracked, stage, alarms

    def _track(self, now: BaselineState, prior: Floats) -> Tracked:
        """Few points of the coarse levels in a wide search, then many points in a narrow one."""
        s, m, view, optics = self._settings, _known(now.map), _known(now.view), _known(now.optics)
        seen = baseline_map.visible(m, optics, prior, view)
        high = seen[m.sources(seen).level >= s.coarse_level]
        rows = _spread(high, s.coarse_points)
        match = self._search(now, prior, rows, self._coarse)
        matched = match.outcome == Feature.MATCHED
        coarse, tried, found, fine = prior, len(rows), int(np.count_nonzero(matched)), self._fine
        if found >= s.coarse_min:
            options = PoseOptions(s.pose_iterations, s.pose_iterations, inlier_px=s.inlier_px)
            coarse = refine_pose(
                optics, m.points[rows[matched]], match.found[matched], match.level[matched], prior, options
            ).cam_t_world
            seen = baseline_map.visible(m, optics, coarse, view)
        else:
            fine = fine._replace(radius_px=2 * fine.radius_px)
        rows = _spread(seen, s.fine_points)
        match = self._search(now, coarse, rows, fine)
        matched = match.outcome == Feature.MATCHED
        error, inlier = np.full(len(rows), np.nan), np.zeros(len(rows), np.bool_)
        if np.count_nonzero(matched) < s.min_tracked:
            return Tracked(prior, coarse, tried, found, rows, match, None, error, inlier)
        options = PoseOptions(s.pose_iterations, s.pose_iterations // 2, inlier_px=s.inlier_px)
        pose = refine_pose(optics, m.points[rows[matched]], match.found[matched], match.level[matched], coarse, options)
        error[matched], inlier[matched] = pose.error_px, pose.inlier
        return Tracked(prior, coarse, tried, found, rows, match, pose if pose.solved else None, error, inlier)

    def _search(self, now: BaselineState, pose: Floats, rows: Longs, options: SearchOptions) -> Matches:
        m = _known(now.map)
        return find_points(
            _known(now.optics), m.buffers, m.poses, _known(now.view), pose, m.points[rows], m.sources(rows), options
        )

    def _holds(self, tracked: Tracked, least_share: float) -> bool:
        """Whether enough points agree with the pose."""
        enough = tracked.agreeing >= self._settings.min_tracked and tracked.share >= least_share
        return tracked.pose is not None and enough

    def _lost(self, now: BaselineState) -> BaselineState:
        """The state after a frame without a pose; a new map is begun when that has lasted."""
        s = self._settings
        forgotten = s.restart_s > 0 and (now.t_ns - now.pose_ns) * 1e-9 > s.restart_s
        m, velocity = _known(now.map), _known(now.velocity) * s.velocity_decay
        return replace(
            now,
            velocity=velocity,
            lost_frames=now.lost_frames + 1,
            map=None if forgotten else m,
            points_made=m.made,
        )

    def _relocalised(self, now: BaselineState, notes: Notes) -> Tracked | None:
        """Tracking from the keyframe whose small image is most like this one's, turned as it lies best over it."""
        m, view = _known(now.map), _known(now.view)
        alike = [correlation(keyframe.small, view.small) for keyframe in m.views]
        best = int(np.argmax(alike))
        notes |= {"relocalise_keyframe": int(m.frames[best]), "relocalise_correlation": alike[best]}
        if alike[best] < self._settings.relocalise_correlation:
            return None
        turn = turn_between(_known(now.optics), m.views[best], view)
        if turn is None:
            return None
        view_T_key = np.eye(4)
        view_T_key[:3, :3] = turn
        tracked = self._track(now, se3_product(view_T_key, m.poses[best]))
        return tracked if self._holds(tracked, self._settings.good_share) else None

    # ------------------------------------------------------------------------------- mapping

    def _mapping(self, now: BaselineState, tracked: Tracked, notes: Notes) -> BaselineState:
        """Decide on a keyframe; with one, the map grows and is adjusted."""
        s, m, optics, pose = self._settings, _known(now.map), _known(now.optics), _known(now.pose)
        used = tracked.rows[tracked.inlier]
        depth = float(np.median(_depths(pose, m.points[used])))
        centre = se3_inverse(pose)[:3, 3]
        distance = float(np.min(np.linalg.norm(m.centres - centre, axis=1))) / depth
        notes |= {"scene_depth_m": depth, "keyframe_distance": distance}
        if distance <= s.keyframe_distance or tracked.share < s.good_share:
            return now
        before = m.made, len(m.points)
        m = baseline_map.with_keyframe(m, now.frame, _known(now.view), pose)
        newest = np.full(len(used), len(m.frames) - 1)
        match = tracked.match
        m = baseline_map.with_seen(m, Seen(used, newest, match.found[tracked.inlier], match.level[tracked.inlier]))
        m = baseline_map.without(m, points=(m.outliers > s.point_outliers) & (m.outliers > m.inliers))
        if len(m.frames) > s.max_keyframes:
            m = baseline_map.without(m, keyframe=int(m.nearest(centre)[-1]))
        m = baseline_map.with_new_points(m, optics, self._growth)
        made = np.flatnonzero(m.ids >= before[0])
        m = baseline_map.found_again(m, optics, made, m.nearest(centre)[1 : 1 + NEIGHBOURS], self._again)

        options = BundleOptions(s.local_iterations, s.bundle_huber_px, inlier_px=s.inlier_px)
        local = baseline_map.local_bundle(m, optics, s.local_keyframes, options)
        adjusted, since = [local], now.since_bundle + 1
        if s.global_every and since >= s.global_every:
            options = options._replace(iterations=s.global_iterations)
            adjusted, since = [local, baseline_map.global_bundle(local.map, optics, options)], 0
        m = adjusted[-1].map
        notes |= {
            "keyframe": 1,
            "points_added": m.made - before[0],
            "points_removed": before[1] + m.made - before[0] - len(m.points),
            **_bundle_notes(adjusted),
            **_structure(m, optics, _known(tracked.pose).scale_px),
        }
        return replace(now, map=m, pose=m.poses[-1], guess=m.poses[-1], since_bundle=since)

    # -------------------------------------------------------------------------------- record

    def _record(
        self,
        before: BaselineState,
        now: BaselineState,
        sample: ImageSample | Problem,
        stage: Stage,
        alarms: Verdict,
        notes: Notes,
    ) -> BaselineStep:
        """The frame's Step; what the notes do not tell was not computed."""
        s, m = self._settings, now.map
        position, quat, planar = _published(s, now.pose)
        held, _, planar_before = _published(s, before.pose)
        moved = position - held if before.pose is not None else position - _start_position(s)
        moved = np.where(np.isfinite(moved), moved, 0.0)
        size = (math.nan, math.nan) if now.view is None else (now.view.pyramid.width, now.view.pyramid.height)
        values: Notes = {
            **_nothing(),
            "frame": _frame_of(before, sample),
            "t_ns": sample.t_ns,
            "received_ns": sample.received_ns,
            "verdict": gravest(alarms),
            "alarms": alarms,
            "accepted": stage in (Stage.STARTED, Stage.TRACKED, Stage.RELOCALISED),
            "stage": int(stage),
            "dt_s": (sample.t_ns - before.t_ns) * 1e-9 if before.view is not None else math.nan,
            "image_size_px": np.array(size, np.float64),
            "position_m": position,
            "quat_xyzw": quat,
            "pose": planar,
            "increment_m": moved[:2],
            "path_step_m": float(np.linalg.norm(moved)),
            "delta_heading_rad": wrap_angle(planar[2] - planar_before[2]),
            "map_number": now.map_number,
            "relocalised_frames": now.relocalised_frames,
            "keyframes": 0 if m is None else len(m.frames),
            "map_points": 0 if m is None else len(m.points),
            "scale_known": int(now.unit.known),
            "metres_per_unit": now.unit.metres,
            "metres_per_unit_sigma": now.unit.sigma,
            **notes,
        }
        return BaselineStep(**values)


# ---------------------------------------------------------------------------------- small parts


def followed(trail: Trail, view: View) -> Trail:
    """The trail in the next frame: each corner of the first view, sought from where it was last (Lucas-Kanade)."""
    if not len(trail.now_px):
        return trail
    first, image = level_image(trail.view.pyramid, 0), level_image(view.pyramid, 0)
    window = (FLOW_WINDOW_PX, FLOW_WINDOW_PX)
    there, good, _ = cv2.calcOpticalFlowPyrLK(
        first,
        image,
        trail.first_px.astype(np.float32),
        trail.now_px.astype(np.float32),
        winSize=window,
        maxLevel=2,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    height, width = image.shape
    inside = np.all((there >= 0) & (there <= np.array([width - 1, height - 1])), axis=1)
    stays = (good.ravel() == 1) & inside
    return trail._replace(
        first_px=trail.first_px[stays], now_px=there[stays].astype(np.float64), level=trail.level[stays]
    )


def levelled(up_in_cam: Floats, heading_rad: float, position_m: Floats) -> Floats:
    """world_T_cam [4, 4] of a camera that knows the upward direction [3], the heading of its +u axis and its place."""
    ahead = np.array([1.0, 0.0, 0.0]) - up_in_cam[0] * up_in_cam
    ahead /= np.linalg.norm(ahead)
    in_cam = np.column_stack([ahead, np.cross(up_in_cam, ahead), up_in_cam])
    world_T_cam = np.eye(4)
    world_T_cam[:3, :3] = so3_exp(np.array([0.0, 0.0, heading_rad])) @ in_cam.T
    world_T_cam[:3, 3] = position_m
    return world_T_cam


def _known(value: T | None) -> T:
    """A part of the state that is there whenever it is asked for."""
    assert value is not None
    return value


def _unusable(state: BaselineState, sample: ImageSample, grey: Grey) -> Verdict:
    """Why an image cannot be used after the one before it; OK if it can."""
    if state.view is None:
        return Verdict.OK
    if sample.t_ns <= state.t_ns:
        return Verdict.OUT_OF_ORDER
    before = level_image(state.view.pyramid, 0)
    if grey.shape != before.shape:
        return Verdict.SIZE_CHANGED
    return Verdict.DUPLICATE_FRAME if np.array_equal(grey, before) else Verdict.OK


def _frame_of(state: BaselineState, sample: ImageSample | Problem) -> int:
    return state.frames if sample.frame < 0 else sample.frame


def _laps(wanted: bool) -> Callable[[], float]:
    """A function that tells the ms since its last call, NaN if times are not wanted."""
    last = time.perf_counter()

    def lap() -> float:
        nonlocal last
        before, last = last, time.perf_counter()
        return (last - before) * 1e3 if wanted else math.nan

    return lap


def _with_views(state: BaselineState, change: Callable[[int, Any], Any], buffers: Any) -> BaselineState:
    """The state with its views changed, which are told their frames."""
    m, trail = state.map, state.trail
    if m is not None:
        views = tuple(change(int(frame), view) for frame, view in zip(m.frames, m.views, strict=True))
        m = replace(m, views=views, buffers=buffers)
    if trail is not None:
        trail = trail._replace(view=change(trail.frame, trail.view))
    return replace(state, map=m, trail=trail, view=None if state.view is None else change(state.frame, state.view))


def _spread(rows: Longs, most: int) -> Longs:
    """At most so many of the rows, evenly."""
    return rows if len(rows) <= most else rows[np.linspace(0, len(rows) - 1, most).astype(np.int64)]


def _depths(pose: Floats, points: Floats) -> Floats:
    """Z of points [n, 3] in camera axes [n]."""
    return np.asarray(points @ pose[2, :3] + pose[2, 3])


def _counted(m: Map, tracked: Tracked) -> Map:
    """The map with each point's count of frames in which it agreed or did not."""
    inliers, outliers = m.inliers.copy(), m.outliers.copy()
    matched = tracked.match.outcome == Feature.MATCHED
    inliers[tracked.rows[tracked.inlier]] += 1
    outliers[tracked.rows[matched & ~tracked.inlier]] += 1
    return replace(m, inliers=inliers, outliers=outliers)


def _planar(settings: BaselineSettings, pose: Floats) -> tuple[float, float, float]:
    """x, y and heading of a camera."""
    world_T_cam = se3_inverse(pose)
    heading = math.atan2(world_T_cam[1, 0], world_T_cam[0, 0]) - settings.mounting_yaw_rad
    return float(world_T_cam[0, 3]), float(world_T_cam[1, 3]), wrap_angle(heading)


def _start_position(settings: BaselineSettings) -> Floats:
    """Where the first frame is; its height is NaN if it is unknown."""
    x, y, _ = settings.start_pose
    return np.array([x, y, math.nan if settings.height_m is None else settings.height_m])


def _published(settings: BaselineSettings, pose: Floats | None) -> tuple[Floats, Floats, Floats]:
    """Position, quaternion and planar pose as the Step tells them, those of the start before the first map."""
    if pose is None:
        return _start_position(settings), np.full(4, math.nan), np.array(settings.start_pose)
    world_T_cam = se3_inverse(pose)
    return world_T_cam[:3, 3], Rotation.from_matrix(world_T_cam[:3, :3]).as_quat(), np.array(_planar(settings, pose))


# --------------------------------------------------------------------------------------- notes


def _nothing() -> Notes:
    """The fields of a frame in which nothing was found."""
    nan, none = math.nan, np.zeros(0, np.int64)
    return {
        "pose_sigma": np.full(6, nan),
        "tracked": 0,
        "keyframe": 0,
        "scene_depth_m": nan,
        "point_id": none,
        "predicted_px": np.zeros((0, 2)),
        "found_px": np.zeros((0, 2)),
        "level": none,
        "outcome": none,
        "error_px": np.zeros(0),
        "score": np.zeros(0),
        "keyframe_number": none,
        "keyframe_position_m": np.zeros((0, 3)),
        "keyframe_quat_xyzw": np.zeros((0, 4)),
        "map_id": none,
        "map_point_m": np.zeros((0, 3)),
        "map_point_sigma_m": np.zeros(0),
        "map_point_views": none,
        "prior_position_m": np.full(3, nan),
        "corners": 0,
        "coarse_tried": 0,
        "coarse_found": 0,
        "coarse_position_m": np.full(3, nan),
        "pose_scale_px": nan,
        "keyframe_distance": nan,
        "points_added": 0,
        "points_removed": 0,
        "bundle_keyframes": np.zeros(2, np.int64),
        "bundle_iterations": np.zeros(2, np.int64),
        "bundle_cost": np.full((2, 2), nan),
        "bundle_outliers": np.zeros(2, np.int64),
        "start_matches": 0,
        "start_motion_px": nan,
        "start_parallax_px": nan,
        "relocalise_keyframe": -1,
        "relocalise_correlation": nan,
        "stage_ms": np.full(len(STAGES), nan),
    }


def _track_notes(m: Map, tracked: Tracked) -> Notes:
    match, pose = tracked.match, tracked.pose
    outlier = (match.outcome == Feature.MATCHED) & ~tracked.inlier
    return {
        "tracked": tracked.agreeing,
        "pose_sigma": np.full(6, math.nan) if pose is None else np.sqrt(np.diag(pose.covariance)),
        "pose_scale_px": math.nan if pose is None else pose.scale_px,
        "point_id": m.ids[tracked.rows],
        "predicted_px": match.predicted,
        "found_px": match.found,
        "level": match.level,
        "outcome": np.where(outlier, Feature.OUTLIER, match.outcome),
        "error_px": tracked.error_px,
        "score": match.score,
        "prior_position_m": se3_inverse(tracked.prior)[:3, 3],
        "coarse_position_m": se3_inverse(tracked.coarse)[:3, 3],
        "coarse_tried": tracked.coarse_tried,
        "coarse_found": tracked.coarse_found,
    }


def _structure(m: Map, optics: Optics, sigma_px: float) -> Notes:
    """Keyframes and points as the Step tells them, for errors of so many px."""
    worlds = np.array([se3_inverse(pose) for pose in m.poses])
    return {
        "keyframe_number": m.frames,
        "keyframe_position_m": worlds[:, :3, 3],
        "keyframe_quat_xyzw": Rotation.from_matrix(worlds[:, :3, :3]).as_quat(),
        "map_id": m.ids,
        "map_point_m": m.points,
        "map_point_sigma_m": baseline_map.sigma_along_rays(m, optics, sigma_px),
        "map_point_views": np.diff(m.first),
    }


def _bundle_notes(adjusted: Sequence[Adjusted]) -> Notes:
    """What the local and the global bundle did."""
    keyframes, iterations, outliers = np.zeros((3, 2), np.int64)
    cost = np.full((2, 2), math.nan)
    for i, (_, bundle, dropped) in enumerate(adjusted):
        if bundle is not None:
            keyframes[i] = np.count_nonzero(np.any(bundle.covariance != 0, axis=(1, 2)))
            iterations[i], outliers[i] = bundle.iterations, dropped
            cost[i] = bundle.cost[[0, bundle.iterations]]
    return {
        "bundle_keyframes": keyframes,
        "bundle_iterations": iterations,
        "bundle_cost": cost,
        "bundle_outliers": outliers,
    }
