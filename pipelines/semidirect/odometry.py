"""Semi-direct visual odometry of a camera that looks at the ground: paper C's chain, one frame at a time.

`SemidirectOdometry` reads as the paper: start from two views, then for every frame sparse alignment, feature alignment
and pose refinement (`tracking.py`), after it depth filters, keyframes and refinement of the structure (`mapping.py`);
when lost, relocalisation. Axes and units are those of `step.py`.

C. Forster, M. Pizzoli, D. Scaramuzza, SVO, ICRA 2014.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from pipelines.correlation.odometry import eight_bit
from pipelines.estimator import EstimatorError, FrameImage, Images
from pipelines.geometry import se3_exp, se3_inverse, se3_log, se3_product, wrap_angle
from pipelines.semidirect import starting
from pipelines.semidirect.beside import BEHIND, Beside, Pending, settled
from pipelines.semidirect.local_map import LocalMap, centre_of, scaled
from pipelines.semidirect.mapping import Mapper, Posed
from pipelines.semidirect.optics import optics_of
from pipelines.semidirect.pyramid import LEVELS, Grey, Pyramid, level_image, pyramid_of
from pipelines.semidirect.records import STAGES, blank_fields, growth_fields, map_fields, quat_of, track_fields
from pipelines.semidirect.relocalisation import Relocalised, relocalised
from pipelines.semidirect.scale_watch import ScaleWatch
from pipelines.semidirect.settings import SemidirectSettings
from pipelines.semidirect.start import Start, StartOutcome
from pipelines.semidirect.starting import Following
from pipelines.semidirect.step import Feature, SemidirectStep, Stage
from pipelines.semidirect.tracking import Known, Tracked, Tracker
from pipelines.verdict import Verdict, gravest
from readers.streams import (
    ImageError,
    ImageSample,
    OdometrySample,
    PoseSample,
    Problem,
    RangeSample,
    Sample,
    ScalarSample,
    StreamKind,
)

Floats = NDArray[np.float64]

USUAL_FRAMES = 31
"""Frames of the running median of the time between frames."""
SHARP_FRAMES = 9
"""Frames of the running median of the sharpness: so few that the ground is still the same."""
SHARP_ROWS = 16
"""Every sixteenth row tells the sharpness."""
STILL = np.eye(4)
MISSED = (Feature.NOT_CONVERGED, Feature.FLAT, Feature.LEFT_IMAGE, Feature.OUTLIER)
"""What counts against a point: it was in view and not found, or found elsewhere."""


class MapScale(NamedTuple):
    """Whether lengths are metres; the metres of a unit of the first map with their σ, NaN while unknown."""

    known: bool = False
    metres: float = math.nan
    sigma: float = math.nan


@dataclass(frozen=True, slots=True)
class SemidirectState:
    """All that the odometry carries from frame to frame.

    Before a map there is `following`, then `world` with the `last` frame whose pose was found; `motion` [4, 4] is the
    last motion between two frames, which took `motion_s`. `held` [4, 4] is the pose that counts now, cam_T_world.
    `pending` are the frames that a mapping beside has still to grow `world` by.
    `lost_ns` is the time of the first frame that was lost, -1 when not.
    """

    frames: int = 0
    previous_ns: int = -1
    size: tuple[int, int] = (0, 0)
    following: Following | None = None
    world: LocalMap | None = None
    pending: tuple[Pending, ...] = ()
    last: Known | None = None
    motion: Floats | None = None
    motion_s: float = math.nan
    held: Floats | None = None
    tracked: int = 0
    lost_ns: int = -1
    map_number: int = -1
    relocalised_frames: int = -1
    scale: MapScale = MapScale()
    watch: ScaleWatch = ScaleWatch()
    height_m: float = math.nan
    mean_grey: float = math.nan
    sharpness: tuple[float, ...] = ()
    intervals_s: tuple[float, ...] = ()
    camera: tuple[Any, ...] = ()


class Met(NamedTuple):
    """What became of one frame: the state after it, its stage and alarms, and the fields that were computed."""

    state: SemidirectState
    stage: Stage
    alarms: Verdict
    fields: dict[str, Any]


class SemidirectOdometry:
    """Estimates the motion of a calibrated camera from its images, and a map of points.

    Samples: images of one stream and, where the settings name them, heights, speeds or positions for the scale.

    Args:
        settings: every setting; see `SemidirectSettings`.

    Raises:
        EstimatorError: the settings do not tell the camera.
    """

    name: ClassVar[str] = "semidirect"
    step_type: ClassVar[type[SemidirectStep]] = SemidirectStep
    kinds: ClassVar[tuple[StreamKind, ...]] = (
        StreamKind.IMAGE, StreamKind.RANGE, StreamKind.SCALAR, StreamKind.POSE, StreamKind.ODOMETRY,
    )  # fmt: skip

    def __init__(self, settings: SemidirectSettings) -> None:
        if settings.focal_px is None:
            raise EstimatorError("the camera is unknown: set focal_px (and centre_px), or give a calibration")
        self._settings = settings
        self._blank = blank_fields(settings)
        self._tracker: Tracker | None = None
        self._mapper: Mapper | None = None
        self._beside: Beside | None = None

    @property
    def settings(self) -> SemidirectSettings:
        """The frozen settings of this estimator."""
        return self._settings

    def start(self) -> SemidirectState:
        """The state before the first sample."""
        height = self._settings.height_m
        return SemidirectState(height_m=math.nan if height is None else height, camera=self._settings.camera_key)

    def step(self, state: SemidirectState, sample: Sample, /) -> tuple[SemidirectState, SemidirectStep | None]:
        """Take one sample; an image, or the `Problem` of one, yields a Step.

        Raises:
            EstimatorError: the images are not of the size that the camera is for, or are too small.
        """
        s = self._settings
        if isinstance(sample, ImageSample):
            try:
                grey = eight_bit(sample.grey())
            except ImageError:
                return self._recorded(state, sample, self._skipped(state, Verdict.UNDECODABLE))
            return self._recorded(state, sample, self._image(state, sample, grey))
        if isinstance(sample, Problem):
            if sample.kind is not StreamKind.IMAGE:
                return state, None
            return self._recorded(state, sample, self._skipped(state, Verdict.UNDECODABLE))
        if sample.stream == s.height_stream:
            height = _height_of(sample)
            return (replace(state, height_m=height + s.height_offset_m) if height > 0 else state), None
        if sample.stream == s.speed_stream and isinstance(sample, OdometrySample):
            speed = float(np.linalg.norm(sample.linear_velocity_mps))
            return replace(state, watch=state.watch.measured(sample.t_ns, speed)), None
        if sample.stream == s.position_stream and isinstance(sample, PoseSample):
            return replace(state, watch=state.watch.placed(sample.t_ns, sample.position_m)), None
        return state, None

    # ---------------------------------------------------------------- going on from the middle

    def packed(self, state: SemidirectState) -> SemidirectState:
        """The state with the images of frames and keyframes by number, see `Resumable`."""
        world, last, following = state.world, state.last, state.following
        images: Any = None
        if world is not None:
            images = tuple(FrameImage(int(number)) for number in world.keyframes.number)
            world = world._replace(keyframes=world.keyframes._replace(grey=images))
        if last is not None:
            images = FrameImage(last.number)
            last = last._replace(pyramid=images)
        if following is not None:
            images = FrameImage(following.first.number)
            first = following.first._replace(pyramid=images)
            images = FrameImage(following.number)
            following = following._replace(first=first, image=images)
        pending: Any = tuple(
            one.posed._replace(pyramid=cast("Any", FrameImage(one.posed.number))) for one in state.pending
        )
        return replace(state, world=world, pending=pending, last=last, following=following)

    def unpacked(self, packed: Any, images: Images) -> SemidirectState:
        """The state that was packed, see `Resumable`.

        Raises:
            EstimatorError: it is no state of this estimator.
        """
        if not isinstance(packed, SemidirectState):
            raise EstimatorError(f"{type(packed).__name__} is no state of the estimator {self.name!r}; replay again")

        def pyramid(number: int) -> Pyramid:
            return self._pyramid(eight_bit(images(number)))

        world, last, following = packed.world, packed.last, packed.following
        if world is not None:
            grey = np.stack([pyramid(int(number)).buffer for number in world.keyframes.number])
            world = world._replace(keyframes=world.keyframes._replace(grey=grey))
        if last is not None:
            last = last._replace(pyramid=pyramid(last.number))
        if following is not None:
            first = following.first._replace(pyramid=pyramid(following.first.number))
            following = following._replace(first=first, image=level_image(pyramid(following.number), 0))
        pending: tuple[Pending, ...] = ()
        if packed.pending:
            frames = [posed._replace(pyramid=pyramid(posed.number)) for posed in cast("Any", packed.pending)]
            self._for_size(*packed.size)
            assert self._beside is not None
            assert world is not None
            pending = self._beside.begun(world, frames)
        return replace(packed, world=world, pending=pending, last=last, following=following)

    def adopted(self, state: SemidirectState) -> SemidirectState:
        """The state under these settings, see `Resumable`: the map stays, and grows as they say.

        Raises:
            EstimatorError: the settings are for another camera.
        """
        if state.camera != self._settings.camera_key:
            raise EstimatorError(
                "the map was made with another camera: replay from the start to change its calibration"
            )
        return state

    # ------------------------------------------------------------------------------ one frame

    def _image(self, state: SemidirectState, sample: ImageSample, grey: Grey) -> Met:
        if state.frames and sample.t_ns <= state.previous_ns:
            return self._skipped(state, Verdict.OUT_OF_ORDER)
        if state.size not in ((0, 0), grey.shape):
            return self._skipped(state, Verdict.SIZE_CHANGED)
        self._for_size(grey.shape[0], grey.shape[1])
        clock = _Stopwatch(self._settings.stage_times)
        pyramid = self._pyramid(grey)
        clock.lap(0)
        alarms, state = self._over_time(state, sample, pyramid)
        if state.world is None:
            met = self._starting(state, sample, pyramid)
            clock.lap(3)
        elif state.lost_ns >= 0:
            met = self._searched(state, sample, pyramid, clock)
        else:
            met = self._followed(state, sample, pyramid, clock)
        seen = {"mean_grey": state.mean_grey, "sharpness": state.sharpness[-1], "stage_ms": clock.ms}
        return met._replace(alarms=met.alarms | alarms, fields=met.fields | seen)

    def _for_size(self, height: int, width: int) -> None:
        """Build the tracker and the mapper for images of that size."""
        if self._tracker is not None:
            return
        try:
            optics = optics_of(self._settings.camera(width, height))
        except ValueError as error:
            raise EstimatorError(str(error)) from error
        self._tracker = Tracker(optics, (height, width), self._settings)
        self._mapper = Mapper(self._tracker)
        if self._settings.mapping == "beside":
            self._beside = Beside(self._mapper)

    @staticmethod
    def _pyramid(grey: Grey) -> Pyramid:
        try:
            return pyramid_of(grey)
        except ValueError as error:
            raise EstimatorError(str(error)) from error

    def _over_time(
        self, state: SemidirectState, sample: ImageSample, pyramid: Pyramid
    ) -> tuple[Verdict, SemidirectState]:
        """What is odd about the frame against those before, and the state with its time and brightness."""
        s, alarms = self._settings, Verdict.OK
        mean_grey = float(level_image(pyramid, LEVELS - 1).mean())
        if abs(mean_grey - state.mean_grey) > s.max_level_change:
            alarms |= Verdict.EXPOSURE_JUMP
        intervals = state.intervals_s
        if state.frames:
            dt_s = (sample.t_ns - state.previous_ns) * 1e-9
            if intervals and dt_s > s.gap_factor * float(np.median(intervals)):
                alarms |= Verdict.FRAME_GAP
            intervals = (*intervals[1 - USUAL_FRAMES :], dt_s)
        sharpness = sharpness_of(level_image(pyramid, 0), mean_grey)
        if state.sharpness and sharpness < s.min_sharpness_ratio * float(np.median(state.sharpness)):
            alarms |= Verdict.BLURRED
        latest = (*state.sharpness[1 - SHARP_FRAMES :], sharpness)
        size = (pyramid.height, pyramid.width)
        return alarms, replace(state, mean_grey=mean_grey, sharpness=latest, intervals_s=intervals, size=size)

    def _skipped(self, state: SemidirectState, verdict: Verdict) -> Met:
        """Pass over a frame that cannot be used; the next one is compared with the frame before it."""
        return Met(state, Stage.SKIPPED, verdict, {})

    # ---------------------------------------------------------------------------------- start

    def _starting(self, state: SemidirectState, sample: ImageSample, pyramid: Pyramid) -> Met:
        """Follow corners from a first view until two views tell a map."""
        s, number = self._settings, _number(state, sample)
        assert self._tracker is not None
        following = state.following
        if following is not None:
            following = starting.followed(following, number, pyramid)
        if following is None or len(following.which) < s.start_min_matches:
            following = starting.first_view(number, sample.t_ns, pyramid, s)
            new = replace(state, following=following)
            verdict = Verdict.FIRST_FRAME if len(following.which) >= s.start_min_matches else Verdict.LOW_TEXTURE
            return Met(new, Stage.FIRST, verdict, {"start_matches": len(following.which)})
        found, known = starting.begun(following, self._tracker.optics, s)
        fields = {
            "start_matches": len(following.which),
            "start_motion_px": found.motion_px,
            "start_parallax_px": found.parallax_px,
        }
        if found.outcome is not StartOutcome.STARTED:
            return Met(replace(state, following=following), Stage.STARTING, Verdict.STARTING, fields)
        return self._started(state, sample, pyramid, following, found, known, fields)

    def _started(
        self,
        state: SemidirectState,
        sample: ImageSample,
        pyramid: Pyramid,
        following: Following,
        found: Start,
        known: NDArray[np.bool_],
        fields: dict[str, Any],
    ) -> Met:
        """The first map, in metres where the height is known."""
        s, number = self._settings, _number(state, sample)
        assert self._tracker is not None
        assert self._mapper is not None
        place, heading = (s.start_pose[0], s.start_pose[1]), s.start_pose[2]
        if state.held is not None:  # a new map goes on from where the last one was lost
            x, y, heading = self._pose(state.held)
            place = (x, y)
        first = starting.first_map(
            following,
            number,
            pyramid,
            found,
            known,
            height_m=state.height_m,
            height_direction=s.height_direction,
            place=place,
            heading_rad=heading + s.mounting_yaw_rad,
            next_number=0 if state.world is None else state.world.next_number,
        )
        world = self._mapper.begun(first.world, pyramid, first.depth)
        sighted = self._tracker.refined(world, pyramid, world.keyframes.cam_t_world[-1])
        scale, alarms = self._scale_at_start(state, first.unit), Verdict.OK
        again = state.map_number >= 0
        if again:
            alarms |= Verdict.NEW_MAP
        new = replace(
            state,
            following=None,
            world=world,
            last=self._known(number, sample.t_ns, pyramid, world.keyframes.cam_t_world[-1], sighted, world),
            motion=None,
            motion_s=math.nan,
            held=world.keyframes.cam_t_world[-1],
            tracked=sighted.points,
            lost_ns=-1,
            map_number=state.map_number + 1,
            relocalised_frames=0 if again else -1,
            scale=scale,
            watch=ScaleWatch(),
        )
        fields = fields | track_fields(sighted, world) | map_fields(world) | {"keyframe": 1, "accepted": True}
        fields |= dict.fromkeys(("keyframe_points", "points_refined"), len(world.points.number))
        return Met(new, Stage.STARTED, alarms, fields)

    def _scale_at_start(self, state: SemidirectState, unit: float) -> MapScale:
        """What the height says of the scale: metres of a unit of the first map's median depth."""
        if math.isnan(state.height_m):
            return MapScale()
        return MapScale(True, unit, unit * self._settings.height_sigma_m / state.height_m)

    # ------------------------------------------------------------------------------- tracking

    def _followed(self, state: SemidirectState, sample: ImageSample, pyramid: Pyramid, clock: _Stopwatch) -> Met:
        """Track a frame by the last one."""
        assert self._tracker is not None
        state, grown = self._caught_up(state, 0 if self._beside is None else BEHIND)
        assert state.world is not None
        assert state.last is not None
        dt_s = (sample.t_ns - state.last.t_ns) * 1e-9
        prior = STILL
        if self._settings.prior == "constant-velocity" and state.motion is not None:
            prior = se3_exp(se3_log(state.motion) * (dt_s / state.motion_s))
        tracked = self._tracker.track(state.world, state.last, pyramid, prior, clock.lap)
        alarms = self._doubts(state, tracked)
        if alarms and prior is not STILL:
            again = self._tracker.track(state.world, state.last, pyramid, STILL, clock.lap)
            if again.points > tracked.points:
                tracked, alarms = again, self._doubts(state, again)
        fields = grown | track_fields(tracked, state.world)
        if alarms:
            return Met(replace(state, lost_ns=sample.t_ns), Stage.LOST, alarms | Verdict.LOST, fields)
        return self._accepted(state, sample, pyramid, tracked, Stage.TRACKED, Verdict.OK, fields, clock)

    def _doubts(self, state: SemidirectState, tracked: Tracked) -> Verdict:
        """Why a frame's pose is not to be believed; OK for nothing."""
        s, alarms = self._settings, Verdict.OK
        if tracked.aligned is None or not math.isfinite(tracked.aligned.final_cost):
            alarms |= Verdict.ALIGNMENT_FAILED
        if tracked.points < s.min_tracked:
            alarms |= Verdict.FEW_POINTS
        elif tracked.points < (1 - s.max_drop) * state.tracked:
            alarms |= Verdict.POINTS_DROPPED
        if tracked.unlike(s.unlike_px, s.unlike_correlation):
            alarms |= Verdict.POINTS_UNLIKE
        return alarms

    def _accepted(
        self,
        state: SemidirectState,
        sample: ImageSample,
        pyramid: Pyramid,
        tracked: Tracked,
        stage: Stage,
        alarms: Verdict,
        fields: dict[str, Any],
        clock: _Stopwatch,
    ) -> Met:
        """Give a frame whose pose was found to the mapping; the state after both."""
        assert state.world is not None
        assert state.last is not None
        assert self._mapper is not None
        number = _number(state, sample)
        points, looked = state.world.points, tracked.looked
        posed = Posed(
            number,
            pyramid,
            tracked.cam_t_world,
            points.number[tracked.sightings.rows],
            tracked.sightings.pixels,
            tracked.sightings.level,
            np.sort(points.number[looked.rows[np.isin(looked.outcome, MISSED)]]),
            tracked.depth,
        )
        world, pending, pose = state.world, state.pending, tracked.cam_t_world
        if self._beside is not None:
            pending = self._beside.posted(world, pending, posed)
        else:
            growth = self._mapper.grown(world, posed)
            world, pose = growth.world, growth.cam_t_world
            fields = fields | growth_fields(growth) | (map_fields(world) if growth.keyframe else {})
        clock.lap(4)
        motion, motion_s = None, math.nan
        if stage is Stage.TRACKED:
            motion = se3_product(pose, se3_inverse(state.last.cam_t_world))
            motion_s = (sample.t_ns - state.last.t_ns) * 1e-9
        last = Known(number, sample.t_ns, pyramid, pose, posed.found, posed.pixels)
        new = replace(
            state,
            world=world,
            pending=pending,
            last=last,
            motion=motion,
            motion_s=motion_s,
            held=pose,
            tracked=tracked.points,
            lost_ns=-1,
        )
        new = self._scaled(new, sample.t_ns)
        return Met(new, stage, alarms | self._scale_alarms(new, fields), fields | {"accepted": True})

    def _caught_up(self, state: SemidirectState, left: int) -> tuple[SemidirectState, dict[str, Any]]:
        """The state whose map has all but the last few pending frames; and what the last of those did, for the log."""
        fields: dict[str, Any] = {}
        while len(state.pending) > left:
            growth, pending = settled(state.pending)
            assert state.last is not None
            pose = se3_product(state.last.cam_t_world, growth.shift)
            last = state.last._replace(cam_t_world=pose)
            state = replace(state, world=growth.world, pending=pending, last=last, held=pose)
            fields = growth_fields(growth) | (map_fields(growth.world) if growth.keyframe else {})
        return state, fields

    def _known(
        self, number: int, t_ns: int, pyramid: Pyramid, pose: Floats, sighted: Tracked, world: LocalMap
    ) -> Known:
        rows = sighted.sightings.rows
        return Known(number, t_ns, pyramid, pose, world.points.number[rows], sighted.sightings.pixels)

    # ---------------------------------------------------------------------------------- scale

    def _scaled(self, state: SemidirectState, t_ns: int) -> SemidirectState:
        """The state once speeds or positions tell the metres of the map."""
        s = self._settings
        if state.scale.known or not (s.speed_stream or s.position_stream):
            return state
        assert state.held is not None
        assert state.world is not None
        assert state.last is not None
        watch = state.watch.went(t_ns, centre_of(state.held))
        found = watch.scale(way=s.scale_way, speed_sigma_mps=s.speed_sigma_mps, position_sigma_m=s.position_sigma_m)
        if found is None:
            return replace(state, watch=watch)
        about = np.array([s.start_pose[0], s.start_pose[1], 0.0])
        pose = _scaled_pose(state.held, found.metres, about)
        motion = None
        if state.motion is not None:
            motion = state.motion.copy()
            motion[:3, 3] *= found.metres
        world, pending = scaled(state.world, found.metres, about), state.pending
        if self._beside is not None:
            pending = self._beside.begun(world, [_scaled_frame(one.posed, found.metres, about) for one in pending])
        return replace(
            state,
            world=world,
            pending=pending,
            last=state.last._replace(cam_t_world=pose),
            held=pose,
            motion=motion,
            scale=MapScale(True, found.metres, found.sigma),
            watch=ScaleWatch(),
        )

    def _scale_alarms(self, state: SemidirectState, fields: dict[str, Any]) -> Verdict:
        if not state.scale.known:
            return Verdict.SCALE_UNKNOWN
        expected = state.height_m
        if self._settings.height_direction == "axis" and state.held is not None:
            expected *= -state.held[2, 2]  # the axis seen from above: cosine of the tilt
        height = fields.get("map_height_m", math.nan) / expected
        drifted = bool(self._settings.height_stream) and abs(height - 1) > self._settings.max_height_ratio
        return Verdict.SCALE_DRIFT if drifted else Verdict.OK

    # --------------------------------------------------------------------------- lost and found

    def _searched(self, state: SemidirectState, sample: ImageSample, pyramid: Pyramid, clock: _Stopwatch) -> Met:
        """Look for a lost camera by the keyframes; begin a new map when that has failed for long."""
        assert self._tracker is not None
        s, (state, grown) = self._settings, self._caught_up(state, max(len(state.pending) - 1, 0))
        assert state.world is not None
        assert state.last is not None
        found = relocalised(self._tracker, state.world, pyramid, state.last.cam_t_world, s.relocalise_correlation)
        clock.lap(3)
        fields = grown | _search_fields(found, state.world)
        if found.tracked is not None and _convincing(found.tracked, s):
            new = replace(state, relocalised_frames=0)
            return self._accepted(
                new, sample, pyramid, found.tracked, Stage.RELOCALISED, Verdict.RELOCALISED, fields, clock
            )
        if s.restart_s > 0 and (sample.t_ns - state.lost_ns) * 1e-9 >= s.restart_s:
            met = self._starting(
                replace(state, world=None, pending=(), last=None, following=None, lost_ns=-1), sample, pyramid
            )
            return met._replace(alarms=met.alarms | Verdict.LOST)
        return Met(state, Stage.LOST, Verdict.LOST, fields)

    # -------------------------------------------------------------------------------- records

    def _pose(self, cam_t_world: Floats) -> tuple[float, float, float]:
        """x, y of the camera and heading: that of its u axis from above, less the mounting yaw."""
        world_t_cam = se3_inverse(cam_t_world)
        heading = math.atan2(world_t_cam[1, 0], world_t_cam[0, 0]) - self._settings.mounting_yaw_rad
        return float(world_t_cam[0, 3]), float(world_t_cam[1, 3]), wrap_angle(heading)

    def _recorded(
        self, before: SemidirectState, sample: ImageSample | Problem, met: Met
    ) -> tuple[SemidirectState, SemidirectStep]:
        """The state and the Step of a frame."""
        state, alarms = met.state, met.alarms
        skipped = met.stage is Stage.SKIPPED
        since = state.relocalised_frames
        if since >= 0 and not skipped:
            if since > 0:
                alarms |= Verdict.AFTER_RELOCALISATION
            state = replace(state, relocalised_frames=since + 1)
        number = _number(before, sample)
        moved_on = sample.t_ns > before.previous_ns or before.frames == 0
        state = replace(state, frames=before.frames + 1, previous_ns=sample.t_ns if moved_on else before.previous_ns)
        pose, was = self._where(state), self._where(before)
        continues = before.held is not None and state.map_number == before.map_number
        increment = pose[:2] - was[:2] if continues else np.zeros(2)
        path = _between(before.held, state.held) if continues else 0.0
        place, quat = np.array([*self._settings.start_pose[:2], math.nan]), np.full(4, math.nan)
        if state.held is not None:
            place, quat = centre_of(state.held), quat_of(state.held)
        width, height = state.size[1], state.size[0]
        common = {
            "frame": number,
            "t_ns": sample.t_ns,
            "received_ns": sample.received_ns,
            "verdict": gravest(alarms),
            "alarms": alarms,
            "stage": int(met.stage),
            "dt_s": (sample.t_ns - before.previous_ns) * 1e-9 if before.frames else math.nan,
            "image_size_px": np.array([width, height], np.float64),
            "position_m": place,
            "quat_xyzw": quat,
            "pose": pose,
            "increment_m": increment,
            "path_step_m": path,
            "delta_heading_rad": wrap_angle(float(pose[2] - was[2])) if continues else 0.0,
            "map_number": state.map_number,
            "relocalised_frames": state.relocalised_frames,
            "keyframes": 0 if state.world is None else len(state.world.keyframes.number),
            "map_points": 0 if state.world is None else len(state.world.points.number),
            "scale_known": int(state.scale.known),
            "metres_per_unit": state.scale.metres,
            "metres_per_unit_sigma": state.scale.sigma,
            "height_m": state.height_m,
        }
        return state, SemidirectStep(**(self._blank | met.fields | common))

    def _where(self, state: SemidirectState) -> Floats:
        """The pose [3] that counts: the start's while there is none."""
        return np.array(self._settings.start_pose if state.held is None else self._pose(state.held))


# ---------------------------------------------------------------------------------- helpers


class _Stopwatch:
    """Adds up the thread's CPU time of the stages, ms; all NaN where it is not asked for."""

    def __init__(self, running: bool) -> None:
        self._running, self._since = running, time.thread_time()
        self.ms = np.zeros(STAGES) if running else np.full(STAGES, np.nan)

    def lap(self, stage: int) -> None:
        """Count the time since the last lap for a stage."""
        if self._running:
            now = time.thread_time()
            self.ms[stage] += (now - self._since) * 1e3
            self._since = now


def sharpness_of(image: Grey, mean_grey: float) -> float:
    """Mean squared difference of neighbours along some of the rows, over the squared mean grey level.

    Over that, a longer exposure does not pass for a sharper image.
    """
    rows = image[::SHARP_ROWS].astype(np.int32)
    step = np.diff(rows, axis=1).ravel()
    return float(step @ step) / step.size / max(mean_grey, 1.0) ** 2


def _number(state: SemidirectState, sample: ImageSample | Problem) -> int:
    return state.frames if sample.frame < 0 else sample.frame


def _between(before: Floats | None, after: Floats | None) -> float:
    """The way of the camera's centre between two poses, 0 where there is none."""
    if before is None or after is None:
        return 0.0
    return float(np.linalg.norm(centre_of(after) - centre_of(before)))


def _scaled_pose(cam_t_world: Floats, factor: float, about: Floats) -> Floats:
    """A camera whose centre is moved away from a place by a factor, its rotation kept."""
    moved = cam_t_world.copy()
    moved[:3, 3] = -moved[:3, :3] @ (about + factor * (centre_of(cam_t_world) - about))
    return moved


def _scaled_frame(posed: Posed, factor: float, about: Floats) -> Posed:
    """A frame for a map whose lengths are multiplied by a factor, `about` [3] staying."""
    return posed._replace(cam_t_world=_scaled_pose(posed.cam_t_world, factor, about), depth=posed.depth * factor)


def _convincing(tracked: Tracked, settings: SemidirectSettings) -> bool:
    """Whether a relocalisation holds: enough points, most of those looked for, and what is there looks like them."""
    s = settings
    most = tracked.points >= s.min_tracked and 2 * tracked.points >= len(tracked.looked.rows)
    return most and not tracked.unlike(s.unlike_px, s.unlike_correlation)


def _search_fields(found: Relocalised, world: LocalMap) -> dict[str, Any]:
    tracked = {} if found.tracked is None else track_fields(found.tracked, world)
    return tracked | {"relocalise_keyframe": found.keyframe, "relocalise_correlation": found.correlation}


def _height_of(sample: Sample) -> float:
    """Camera height in metres: a range, a number, or the z of a pose; NaN for others."""
    if isinstance(sample, RangeSample):
        return sample.range_m
    if isinstance(sample, ScalarSample):
        return sample.value
    return float(sample.position_m[2]) if isinstance(sample, PoseSample) else math.nan
