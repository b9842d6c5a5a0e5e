"""Two-fragment correlation odometry: paper A's chain and its robust successor, one frame at a time.

`CorrelationOdometry` reads as the chain of the paper's Fig. 4: match the fragments (blocks 1, 2), fit the
motion of the frame (3, 4), integrate the trajectory (5-8), correct it (9, 10), judge. Matching stands in
`matching.py`, equations in `equations.py`, checks in `judging.py`, inner loops in `kernels.py`. Axes and signs
are those of `step.py`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipelines.correlation import equations as eq
from pipelines.correlation import kernels
from pipelines.correlation.equations import STILL, Motion
from pipelines.correlation.judging import Usual, alarms_over_time, median
from pipelines.correlation.matching import NO_COVARIANCE, Candidate, Matcher, Template
from pipelines.correlation.settings import CorrelationSettings
from pipelines.correlation.step import CorrelationStep
from pipelines.correlation.trajectory import Pose, Segment, corrected, integrated
from pipelines.estimator import EstimatorError, FrameImage, Images
from pipelines.verdict import Verdict, gravest
from readers.streams import ImageError, ImageSample, PoseSample, Problem, RangeSample, Sample, ScalarSample, StreamKind

Floats = NDArray[np.float64]
Grey = NDArray[np.uint8]

JITTER = 0.6
"""Intervals below this share of the usual one are taken for jitter of the stamps."""


class Advance(NamedTuple):
    """The motion since the frame before, and what follows from it for the trajectory."""

    frame: int
    dt_s: float
    metres_per_px: float
    motion: Motion
    covariance_px: Floats
    path_m: float
    increment_m: tuple[float, float]


@dataclass(frozen=True, slots=True)
class CorrelationState:
    """All that the odometry carries from frame to frame.

    `template` is the frame that is searched next and `relative` the motion from it to the last frame;
    `previous` is the last frame. `velocity` is the last measured motion between frames, which took
    `velocity_s`. `usual` are the running medians over `history` [3, K]: residuals, sharpness, intervals.
    """

    frames: int = 0
    template: Template | None = None
    previous: Template | None = None
    previous_ns: int = -1
    relative: Motion = STILL
    velocity: Motion | None = None
    velocity_s: float = math.nan
    last_shift: Floats | None = None
    inliers: int = 0
    lost_frames: int = 0
    pose: Pose = (0.0, 0.0, 0.0)
    covariance: Floats | None = None
    segment: Segment = Segment()
    correction_total: tuple[float, float] = (0.0, 0.0)
    height_m: float = math.nan
    mean_grey: float = math.nan
    gradient: float = math.nan
    history: Floats | None = None
    usual: Usual = Usual()


class CorrelationOdometry:
    """Estimates the planar motion of a downward camera from image fragments.

    Samples: images of one stream and, where the settings name a height stream, its ranges, numbers or poses.

    Args:
        settings: every setting; see `CorrelationSettings`.

    Raises:
        EstimatorError: neither `metres_per_px` nor a height together with `focal_px` is set.
    """

    name: ClassVar[str] = "correlation"
    step_type: ClassVar[type[CorrelationStep]] = CorrelationStep
    kinds: ClassVar[tuple[StreamKind, ...]] = (StreamKind.IMAGE, StreamKind.RANGE, StreamKind.SCALAR, StreamKind.POSE)

    def __init__(self, settings: CorrelationSettings) -> None:
        height_known = settings.height_m is not None or bool(settings.height_stream)
        if settings.metres_per_px is None and not (settings.focal_px is not None and height_known):
            raise EstimatorError(
                "the scale is unknown: set metres_per_px, or focal_px together with height_m or height_stream"
            )
        self._settings = settings
        self._matcher = Matcher(settings)
        self._limit_rad = eq.rotation_limit(settings.fragment_side_px)

    @property
    def settings(self) -> CorrelationSettings:
        """The frozen settings of this estimator."""
        return self._settings

    def start(self) -> CorrelationState:
        """The state before the first sample."""
        s = self._settings
        return CorrelationState(
            pose=s.start_pose,
            covariance=np.zeros((3, 3)),
            height_m=math.nan if s.height_m is None else s.height_m,
        )

    def step(self, state: CorrelationState, sample: Sample, /) -> tuple[CorrelationState, CorrelationStep | None]:
        """Take one sample; an image, or the `Problem` of one, yields a Step.

        Raises:
            EstimatorError: the image is too small for the fragments, or no height came before it.
        """
        if isinstance(sample, ImageSample):
            try:
                return self._image(state, sample, eight_bit(sample.grey()))
            except ImageError:
                return self._skip(state, sample, Verdict.UNDECODABLE, None)
        if isinstance(sample, Problem):
            if sample.kind is not StreamKind.IMAGE:
                return state, None
            return self._skip(state, sample, Verdict.UNDECODABLE, None)
        if sample.stream == self._settings.height_stream:
            return replace(state, height_m=_height_of(sample) + self._settings.height_offset_m), None
        return state, None

    # ---------------------------------------------------------------- going on from the middle

    def packed(self, state: CorrelationState) -> CorrelationState:
        """The state with the images of its frames by number, see `Resumable`; patches are cut again from them."""
        return replace(state, template=_without_image(state.template), previous=_without_image(state.previous))

    def unpacked(self, packed: Any, images: Images) -> CorrelationState:
        """The state that was packed, see `Resumable`.

        Raises:
            EstimatorError: it is no state of this estimator.
        """
        if not isinstance(packed, CorrelationState):
            raise EstimatorError(f"{type(packed).__name__} is no state of the estimator {self.name!r}; replay again")
        return replace(
            packed, template=_with_image(packed.template, images), previous=_with_image(packed.previous, images)
        )

    def adopted(self, state: CorrelationState) -> CorrelationState:
        """The state under these settings, see `Resumable`.

        Of the running medians the latest values stay; shifts of fragments stay if there are as many fragments; a
        height that the settings give takes the place of the one before.
        """
        s = self._settings
        height_m = state.height_m if s.height_m is None or s.height_stream else s.height_m
        shift = state.last_shift
        history = self._resized(state)
        return replace(
            state,
            template=None if state.template is None else replace(state.template, fragments=None, tiles=None),
            previous=None if state.previous is None else replace(state.previous, fragments=None, tiles=None),
            last_shift=shift if shift is not None and len(shift) == s.columns * s.rows else None,
            height_m=height_m,
            history=history,
            usual=state.usual if history is state.history else Usual(*kernels.running_medians(history)),
        )

    def _resized(self, state: CorrelationState) -> Floats | None:
        """The values behind the running medians, [3, K] for these settings: as many of the latest as there is room."""
        if state.history is None or state.history.shape[1] == self._settings.median_frames:
            return state.history
        before, now = state.history.shape[1], self._settings.median_frames
        latest = state.frames - 1 - np.arange(min(before, now))
        history = np.full((3, now), np.nan)
        history[:, latest % now] = state.history[:, latest % before]
        return history

    # ------------------------------------------------------------------------------ one frame

    def _image(
        self, state: CorrelationState, sample: ImageSample, grey: Grey
    ) -> tuple[CorrelationState, CorrelationStep]:
        previous = state.previous
        if previous is None:
            return self._restart(state, sample, grey, Verdict.FIRST_FRAME)
        if sample.t_ns <= state.previous_ns:
            return self._skip(state, sample, Verdict.OUT_OF_ORDER, grey)
        if grey.shape != previous.grey.shape:
            return self._restart(state, sample, grey, Verdict.SIZE_CHANGED)
        mean_grey, gradient = kernels.frame_statistics(grey)
        if (mean_grey, gradient) == (state.mean_grey, state.gradient) and np.array_equal(grey, previous.grey):
            return self._skip(state, sample, Verdict.DUPLICATE_FRAME, grey)

        s = self._settings
        frame = _frame_of(state, sample)
        dt_s = (sample.t_ns - state.previous_ns) * 1e-9
        metres_per_px = self._metres_per_px(state.height_m, frame)

        candidate, alarms = self._find(state, previous, grey, dt_s)
        alarms |= candidate.alarms
        motion, relative, covariance_px = self._motion_between_frames(state, candidate, dt_s)
        pose, increment, path_m = integrated(s, state.pose, motion, metres_per_px)
        # a measured motion starts from its template frame, a held one from the frame before
        base = candidate.template if candidate.acceptable else previous
        camera_heading = pose[2] + s.mounting_yaw_rad
        covariance = kernels.propagated(base.covariance, base.pose, pose, covariance_px, metres_per_px, camera_heading)
        segment = corrected(s, state.segment, state.pose, pose, path_m, dt_s)
        total = (
            state.correction_total[0] + segment.applied_m[0],
            state.correction_total[1] + segment.applied_m[1],
        )
        if segment.applied_m != (0.0, 0.0):
            alarms |= Verdict.CORRECTION_APPLIED

        residual = median(candidate.matches.residual_rms)
        # over the squared mean, a longer exposure does not pass for a sharper image
        sharpness = gradient / max(mean_grey, 1.0) ** 2
        gain = median(candidate.matches.gain)
        alarms |= alarms_over_time(s, residual, gain, sharpness, dt_s, mean_grey - state.mean_grey, state.usual)
        accepted = candidate.acceptable
        if not accepted:
            alarms |= Verdict.LOST
        history = self._history(state, *((residual, sharpness) if accepted else (math.nan, math.nan)), dt_s)
        new_state = CorrelationState(
            frames=state.frames + 1,
            template=candidate.template if accepted else self._bridge(state),
            previous=Template(frame, grey, pose, covariance),
            previous_ns=sample.t_ns,
            relative=relative,
            velocity=motion if accepted else state.velocity,
            velocity_s=_motion_time(state, dt_s) if accepted else state.velocity_s,
            last_shift=candidate.matches.peak_px if accepted else None,
            inliers=candidate.inliers if accepted else state.inliers,
            lost_frames=0 if accepted else state.lost_frames + 1,
            pose=pose,
            covariance=covariance,
            segment=segment,
            correction_total=total,
            height_m=state.height_m,
            mean_grey=mean_grey,
            gradient=gradient,
            history=history,
            usual=Usual(*kernels.running_medians(history)),
        )
        advance = Advance(frame, dt_s, metres_per_px, motion, covariance_px, path_m, increment)
        return new_state, self._record(new_state, sample, grey, candidate, advance, alarms)

    def _history(self, state: CorrelationState, *latest: float) -> Floats:
        """The values behind the running medians [3, K] with those of this frame, NaN where there is none."""
        history = np.full((3, self._settings.median_frames), np.nan) if state.history is None else state.history.copy()
        history[:, state.frames % self._settings.median_frames] = latest
        return history

    def _find(self, state: CorrelationState, previous: Template, grey: Grey, dt_s: float) -> tuple[Candidate, int]:
        """The best candidate for the motion to this frame: by prediction, where that fails by a global search."""
        s = self._settings
        step = self._held(state, dt_s) if s.prediction == "constant-velocity" else STILL
        template, predicted = state.template, state.relative.then(step)
        if template is None or not self._serves(state, template, predicted):
            template, predicted = previous, step
        usual = state.usual.residual
        first = self._matcher.match(template, grey, predicted, last_shift=state.last_shift, usual_residual=usual)
        if not s.recovery:
            return first, 0
        starting = state.velocity is None
        if convincing(first) and not (starting and first.alarms & Verdict.PEAK_AT_BORDER):
            return first, 0
        bases = [(template, predicted)]
        if template.frame != previous.frame:
            bases.append((previous, step))
        for base, prediction in bases:
            if base is not template:
                candidate = self._matcher.match(base, grey, prediction, usual_residual=usual)
                if convincing(candidate):
                    return candidate, 0
            for motion in self._matcher.search_globally(base.grey, grey, prediction):
                candidate = self._matcher.match(base, grey, motion, usual_residual=usual)
                if convincing(candidate):
                    return candidate, 0 if starting else int(Verdict.REACQUIRED)
        return first, 0

    def _serves(self, state: CorrelationState, template: Template, predicted: Motion) -> bool:
        """Whether the template frame may still be searched, or the frame before must take its place."""
        s = self._settings
        if state.previous is not None and template.frame == state.previous.frame:
            return True
        if state.lost_frames > 0:
            return state.lost_frames <= s.bridge_frames and self._matcher.reaches(template, predicted)
        return (
            s.key_frames
            and state.inliers >= s.key_min_inliers
            and math.hypot(predicted.u, predicted.v) <= s.key_max_shift_px
            and abs(predicted.rotation_rad) <= s.key_max_rotation_rad
            and self._matcher.reaches(template, predicted)
        )

    def _bridge(self, state: CorrelationState) -> Template | None:
        """The template while lost: the last frame whose position was measured, which overlaps the most."""
        return state.previous if state.lost_frames == 0 else state.template

    def _held(self, state: CorrelationState, dt_s: float) -> Motion:
        """The motion since the last frame at the last measured velocity; still where there is none."""
        return STILL if state.velocity is None else state.velocity.times(_motion_time(state, dt_s) / state.velocity_s)

    def _motion_between_frames(
        self, state: CorrelationState, candidate: Candidate, dt_s: float
    ) -> tuple[Motion, Motion, Floats]:
        """Motion since the frame before, motion since the (new) template, covariance in px and rad."""
        if not candidate.acceptable:
            held = self._held(state, dt_s) if self._settings.recovery else STILL
            # nothing was measured: the held motion may be wrong by its whole size
            sigma = max(math.hypot(held.u, held.v), 1.0), max(abs(held.rotation_rad), 0.01)
            relative = held if state.lost_frames == 0 else state.relative.then(held)
            return held, relative, np.diag([sigma[0] ** 2, sigma[0] ** 2, sigma[1] ** 2])
        measured = candidate.motion
        assert state.previous is not None
        if candidate.template.frame == state.previous.frame:
            return measured, measured, candidate.covariance
        return state.relative.inverse().then(measured), measured, candidate.covariance

    # ---------------------------------------------------------------------------------- scale

    def _metres_per_px(self, height_m: float, frame: int) -> float:
        """W: as given, or height over focal length."""
        s = self._settings
        if s.metres_per_px is not None:
            return s.metres_per_px
        assert s.focal_px is not None
        if math.isnan(height_m):
            raise EstimatorError(
                f"no camera height came before frame {frame}: set height_m, or check that the stream "
                f"{s.height_stream!r} holds values from the start on"
            )
        return height_m / s.focal_px

    # ---------------------------------------------------------------- frames without a motion

    def _restart(
        self, state: CorrelationState, sample: ImageSample, grey: Grey, verdict: Verdict
    ) -> tuple[CorrelationState, CorrelationStep]:
        """Begin, or begin again after the image size changed: there is nothing to compare this frame with."""
        try:
            self._matcher.layout(grey.shape[1], grey.shape[0])
        except EstimatorError:
            if verdict is Verdict.FIRST_FRAME:
                raise
            return self._skip(state, sample, verdict, None)  # a small picture among larger ones
        assert state.covariance is not None
        frame = _frame_of(state, sample)
        this = Template(frame, grey, state.pose, state.covariance)
        mean_grey, gradient = kernels.frame_statistics(grey)
        new = replace(
            state,
            frames=state.frames + 1,
            template=this,
            previous=this,
            previous_ns=sample.t_ns,
            relative=STILL,
            velocity=None,
            velocity_s=math.nan,
            last_shift=None,
            mean_grey=mean_grey,
            gradient=gradient,
        )
        return new, self._blank(new, sample, grey, verdict)

    def _skip(
        self, state: CorrelationState, sample: ImageSample | Problem, verdict: Verdict, grey: Grey | None
    ) -> tuple[CorrelationState, CorrelationStep]:
        """Pass over a frame that cannot be compared; the next one is compared with the frame before it."""
        new = replace(state, frames=state.frames + 1)
        return new, self._blank(new, sample, grey, verdict)

    # -------------------------------------------------------------------------------- records

    def _blank(
        self, state: CorrelationState, sample: ImageSample | Problem, grey: Grey | None, verdict: Verdict
    ) -> CorrelationStep:
        """The Step of a frame without a match: the pose as it was, all measurements NaN."""
        s = self._settings
        if grey is None:
            grey = np.empty((0, 0), np.uint8) if state.previous is None else state.previous.grey
        count, tiles = s.columns * s.rows, s.tile_columns * s.tile_rows
        matches = kernels.no_matches(count, s.search_radius_px)
        nothing = np.full((count, 2), np.nan)
        matches.weight[:] = 0.0
        candidate = Candidate(
            template=Template(-1, grey, state.pose, NO_COVARIANCE),
            motion=Motion(math.nan, math.nan, math.nan, math.nan),
            predicted_shift=nothing,
            search=nothing,
            matches=matches,
            inliers=0,
            tile_shift=np.full((tiles, 2), np.nan),
            tile_weight=np.zeros(tiles),
            covariance=NO_COVARIANCE,
            alarms=verdict,
            acceptable=False,
        )
        beginning = verdict in (Verdict.FIRST_FRAME, Verdict.SIZE_CHANGED) or state.previous is None
        dt_s = math.nan if beginning else (sample.t_ns - state.previous_ns) * 1e-9
        metres_per_px = s.metres_per_px if s.metres_per_px is not None else state.height_m / (s.focal_px or math.nan)
        frame = state.frames - 1 if sample.frame < 0 else sample.frame
        advance = Advance(frame, dt_s, metres_per_px, STILL, NO_COVARIANCE, 0.0, (0.0, 0.0))
        unchanged = replace(state, segment=state.segment._replace(applied_m=(0.0, 0.0)))
        return self._record(unchanged, sample, grey, candidate, advance, verdict)

    def _record(
        self,
        state: CorrelationState,
        sample: ImageSample | Problem,
        grey: Grey,
        candidate: Candidate,
        advance: Advance,
        alarms: int,
    ) -> CorrelationStep:
        """Everything that was computed for this frame; `state` is the one after it."""
        s = self._settings
        m, motion, flags = candidate.matches, candidate.motion, Verdict(int(alarms))
        if grey.size:
            layout = self._matcher.layout(grey.shape[1], grey.shape[0])
            fragments, points, tiles, size = layout.centres_px, layout.points, layout.tile_centres_px, layout.size_px
        else:
            fragments = points = np.full(m.shift_px.shape, np.nan)
            tiles, size = np.full(candidate.tile_shift.shape, np.nan), np.full(2, np.nan)
        x, y, heading = state.pose
        total_x, total_y = state.correction_total
        covariance = state.covariance
        assert covariance is not None
        return CorrelationStep(
            frame=advance.frame,
            t_ns=sample.t_ns,
            received_ns=sample.received_ns,
            verdict=gravest(flags),
            alarms=flags,
            accepted=candidate.acceptable,
            template_frame=candidate.template.frame,
            dt_s=advance.dt_s,
            image_size_px=size,
            mean_grey=state.mean_grey,
            gradient_energy=state.gradient,
            fragment_side_px=s.fragment_side_px,
            search_radius_px=s.search_radius_px,
            fragment_px=fragments,
            predicted_shift_px=candidate.predicted_shift,
            search_centre_px=candidate.search.astype(np.float64),
            surface=m.surface,
            peak_px=m.peak_px,
            peak_correlation=m.peak_correlation,
            second_peak_px=m.second_peak_px,
            second_peak_correlation=m.second_peak_correlation,
            peak_ratio=m.peak_ratio,
            peak_curvature=m.peak_curvature,
            peak_anisotropy=m.peak_anisotropy,
            delta_px=m.delta_px,
            hessian=m.hessian,
            condition=m.condition,
            smallest_eigenvalue=m.smallest_eigenvalue,
            iterations=m.iterations,
            gain=m.gain,
            offset=m.offset,
            match_grey=m.mean_grey,
            gradient=m.gradient,
            residual_rms=m.residual_rms,
            sigma_px=m.sigma_px,
            shift_px=m.shift_px,
            weight=m.weight,
            fit_residual_px=m.fit_residual_px,
            inliers=candidate.inliers,
            rigidity_px=kernels.worst_rigidity(points, m.shift_px),
            scale=motion.scale,
            centre_shift_px=np.array([motion.u, motion.v]),
            template_rotation_rad=motion.rotation_rad,
            tile_px=tiles,
            tile_shift_px=candidate.tile_shift,
            tile_weight=candidate.tile_weight,
            motion_covariance=advance.covariance_px,
            rotation_limit_rad=self._limit_rad,
            frame_shift_px=np.array([advance.motion.u, advance.motion.v]),
            delta_heading_rad=advance.motion.rotation_rad,
            heading_rad=heading,
            metres_per_px=advance.metres_per_px,
            height_m=state.height_m,
            path_step_m=advance.path_m,
            increment_m=np.array(advance.increment_m),
            segment_frames=state.segment.frames,
            segment_sum_m=state.segment.sum_m,
            segment_reference_m=state.segment.reference_m,
            relative_deviation=state.segment.relative_deviation,
            deviation_m=state.segment.deviation_m,
            correction_m=np.array(state.segment.applied_m),
            correction_total_m=np.array(state.correction_total),
            pose_raw=np.array(state.pose),
            pose=np.array([x + total_x, y + total_y, heading]),
            pose_covariance=covariance,
        )


def _without_image(template: Template | None) -> Any:
    if template is None:
        return None
    image: Any = FrameImage(template.frame)
    return replace(template, grey=image, fragments=None, tiles=None)


def _with_image(template: Template | None, images: Images) -> Template | None:
    return None if template is None else replace(template, grey=eight_bit(images(template.frame)))


def eight_bit(grey: NDArray[np.uint8] | NDArray[np.uint16]) -> Grey:
    """Grey levels as a read-only contiguous uint8 array; of 16-bit images the upper eight bits."""
    eight = grey if grey.dtype == np.uint8 else grey >> 8
    fixed = np.ascontiguousarray(eight, np.uint8).view()
    fixed.setflags(write=False)  # compiled code is built for one kind of array
    return fixed


def _motion_time(state: CorrelationState, dt_s: float) -> float:
    """The time that counts for a velocity, s: stamps much closer than the usual are jitter."""
    usual_s = state.usual.interval_s
    return max(dt_s, JITTER * usual_s) if usual_s == usual_s else dt_s


def convincing(candidate: Candidate) -> bool:
    """Whether at least half of the fragments agree; fewer can agree by chance, wherever one looks."""
    return candidate.acceptable and 2 * candidate.inliers >= len(candidate.search)


def _frame_of(state: CorrelationState, sample: ImageSample) -> int:
    return state.frames if sample.frame < 0 else sample.frame


def _height_of(sample: Sample) -> float:
    """Camera height in metres: a range, a number, or the z of a pose."""
    if isinstance(sample, RangeSample):
        return sample.range_m
    if isinstance(sample, ScalarSample):
        return sample.value
    if isinstance(sample, PoseSample):
        return float(sample.position_m[2])
    raise EstimatorError(f"stream {sample.stream!r} holds no heights: name a stream of ranges, numbers or poses")
