"""The range estimator: landmarks in, with speed and rate of turn; their ranges and everything on the way out.

`RangeFilter` reads as the paper's chain: take the messages of gyro and odometer as they come (`robot_motion.py`); at
a frame carry every landmark over the intervals since the last one (23), (24), update it with its image point
(25)-(27), take out what is lost, start what is new (`start.py`), judge (`range_judging.py`). Axes and signs are those
of `equations.py`; the record of a frame is `step.RangeStep`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipelines.estimator import EstimatorError, Images
from pipelines.ranging import ego_motion, start
from pipelines.ranging import equations as eq
from pipelines.ranging.beliefs import Separate, Together
from pipelines.ranging.ego_motion import Arc
from pipelines.ranging.filter import Inputs, Outcome, Update, statuses
from pipelines.ranging.landmarks.settings import LandmarkKind
from pipelines.ranging.landmarks.sources import AutomaticSource, source_of
from pipelines.ranging.range_judging import History, Trends, alarms_of_frame
from pipelines.ranging.range_settings import MotionModel, RangeSettings, StartKind
from pipelines.ranging.robot_motion import (
    NS,
    Ride,
    Velocities,
    bias_of,
    complete,
    noise_of,
    ridden,
    turn_signal,
    with_imu,
    with_odometry,
)
from pipelines.ranging.sightings import LandmarkSource, Sighting
from pipelines.ranging.start import CameraMotion, Start
from pipelines.ranging.step import RangeStep
from pipelines.verdict import Verdict, gravest
from readers.streams import ImuSample, LandmarkSample, OdometrySample, Problem, Sample, StreamKind

Floats = NDArray[np.float64]
Longs = NDArray[np.int64]

FRAMES = (StreamKind.IMAGE, StreamKind.TRACK, StreamKind.LANDMARKS)
DUPLICATE_POINTS = 3
"""So many image points that are all exactly those of the frame before make a frame its repetition."""
NOTHING = Sighting(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros(0))


class Pose(NamedTuple):
    """Dead reckoning: a fixed point P of the first frame's camera axes is at `turn` P + `shift_m` in this one's."""

    turn: Floats
    shift_m: Floats

    def after(self, arc: Arc) -> Pose:
        """The pose after an interval."""
        return Pose(arc.turn @ self.turn, arc.turn @ self.shift_m - arc.shift_m)


@dataclass(frozen=True, slots=True)
class Roster:
    """Who the n landmarks are.

    Attributes:
        ids: their numbers [n].
        slots: their places in the record [n].
        born: number of the frame in which each started [n], counted by the estimator.
        seen_ns: time of the last image point [n].
        first_px: image point at the start or the last reset [n, 2].
        first_turn: `Pose.turn` then [n, 3, 3].
        most_px: largest derotated parallax since then [n]: a way back does not take from what it told.
    """

    ids: Longs
    slots: Longs
    born: Longs
    seen_ns: Longs
    first_px: Floats
    first_turn: Floats
    most_px: Floats

    @classmethod
    def none(cls) -> Roster:
        """No landmark."""
        whole = np.zeros(0, np.int64)
        return cls(whole, whole, whole, whole, np.zeros((0, 2)), np.zeros((0, 3, 3)), np.zeros(0))

    def only(self, kept: Longs) -> Roster:
        """Some of the landmarks, by number."""
        return Roster(
            self.ids[kept],
            self.slots[kept],
            self.born[kept],
            self.seen_ns[kept],
            self.first_px[kept],
            self.first_turn[kept],
            self.most_px[kept],
        )

    def and_also(self, other: Roster) -> Roster:
        """These landmarks, followed by others."""
        return Roster(
            np.concatenate([self.ids, other.ids]),
            np.concatenate([self.slots, other.slots]),
            np.concatenate([self.born, other.born]),
            np.concatenate([self.seen_ns, other.seen_ns]),
            np.concatenate([self.first_px, other.first_px]),
            np.concatenate([self.first_turn, other.first_turn]),
            np.concatenate([self.most_px, other.most_px]),
        )


class Candidate(NamedTuple):
    """A landmark that waits for a second view: first image point [2] and its variance, motion since, last seen."""

    number: int
    first_px: Floats
    variance: float
    motion: CameraMotion
    first_turn: Floats
    seen_ns: int


@dataclass(frozen=True, slots=True)
class RangeState:
    """All that the estimator carries from sample to sample; `ride` is the way to the last frame, for who looks on."""

    source: Any
    velocities: Velocities
    belief: Separate | Together
    roster: Roster
    trends: Trends
    history: History
    pose: Pose
    sighting: Sighting = NOTHING
    ride: Ride | None = None
    candidates: tuple[Candidate, ...] = ()
    frames: int = 0
    last_ns: int = -1
    stream: str = ""


class Driven(NamedTuple):
    """What the way since the last frame made of the landmarks.

    `transition`, `noise_gain` are those of the last interval, `inputs` those that are still to be used by an update
    that linearises again (None: none).
    """

    belief: Separate | Together
    pose: Pose
    candidates: tuple[Candidate, ...]
    transition: Floats
    noise_gain: Floats
    inputs: Inputs | None


class RangeFilter:
    """Estimates the ranges of landmarks from a moving camera (paper B), each with its uncertainty.

    Samples: frames of one stream (images, pixel tracks or bearings, whichever the landmarks come from), odometry, and
    the IMU's angular velocity where there is one. A frame is judged with the messages that came before it. Its step is
    of the time at which it was taken: its stamp less `camera_delay_s`.

    Args:
        settings: every setting; see `RangeSettings`.
        source: where the landmarks come from; None: what the settings name.

    Raises:
        EstimatorError: the camera's focal length is unknown, or its lens model.
    """

    name: ClassVar[str] = "range"
    step_type: ClassVar[type[RangeStep]] = RangeStep
    kinds: ClassVar[tuple[StreamKind, ...]] = (*FRAMES, StreamKind.ODOMETRY, StreamKind.IMU)

    def __init__(self, settings: RangeSettings, source: LandmarkSource[Any] | None = None) -> None:
        if settings.pinhole_focal_px is None:
            raise EstimatorError("the focal length is unknown: set focal_px, or landmarks = 'bearings'")
        self._settings = settings
        self._source = source or _source_of(settings)
        self._model = settings.kernel_model
        self._centre = settings.pinhole_centre_px
        self._noise = noise_of(settings)
        self._body_r_camera = settings.body_r_camera
        self._delay_ns = round(settings.camera_delay_s / NS)

    @property
    def settings(self) -> RangeSettings:
        """The frozen settings of this estimator."""
        return self._settings

    def start(self) -> RangeState:
        """The state before the first sample."""
        return RangeState(
            source=self._source.start(),
            velocities=Velocities.none(),
            belief=Together.none() if self._settings.mode == "joint" else Separate.none(),
            roster=Roster.none(),
            trends=Trends.fresh(0),
            history=History(),
            pose=Pose(np.eye(3), np.zeros(3)),
        )

    def step(self, state: RangeState, sample: Sample, /) -> tuple[RangeState, RangeStep | None]:
        """Take one sample; a frame, or the `Problem` of one, yields a Step."""
        s = self._settings
        if isinstance(sample, OdometrySample):
            return replace(state, velocities=with_odometry(s, state.velocities, sample, state.last_ns)), None
        if isinstance(sample, ImuSample):
            return replace(state, velocities=with_imu(s, state.velocities, sample, state.last_ns)), None
        if isinstance(sample, Problem) and sample.kind not in FRAMES:
            unusable = sample.kind in (StreamKind.ODOMETRY, StreamKind.IMU)
            velocities = replace(state.velocities, unusable=state.velocities.unusable or unusable)
            return replace(state, velocities=velocities), None
        sample = replace(sample, t_ns=sample.t_ns - self._delay_ns)
        if state.frames and sample.stream == state.stream and sample.t_ns <= state.last_ns:
            return self._skip(state, sample)
        source, sighting = self._sighted(state, sample)
        if sighting is None and not (isinstance(sample, Problem) and sample.stream == state.stream):
            return replace(state, source=source), None
        damaged = Verdict.UNDECODABLE if isinstance(sample, Problem) else Verdict.OK
        return self._frame(replace(state, source=source), sample, sighting or NOTHING, damaged)

    def _sighted(self, state: RangeState, sample: Sample) -> tuple[Any, Sighting | None]:
        """What the source makes of a sample.

        Raises:
            EstimatorError: the samples are not such as the settings are for.
        """
        s = self._settings
        if isinstance(sample, LandmarkSample) and s.landmarks is LandmarkKind.AUTO and s.focal_px is not None:
            raise EstimatorError("focal_px is for images and tracks: set landmarks = 'bearings', or leave focal_px out")
        try:
            return self._source.sight(state.source, sample)
        except ValueError as error:
            raise EstimatorError(str(error)) from error

    # ---------------------------------------------------------------- going on from the middle

    def packed(self, state: RangeState) -> RangeState:
        """The state without settings, see `Resumable`; the last image of tracked corners stays in it."""
        if isinstance(self._source, AutomaticSource):
            return replace(state, source=self._source.packed(state.source))
        return state

    def unpacked(self, packed: Any, images: Images) -> RangeState:
        """The state that was packed, see `Resumable`.

        Raises:
            EstimatorError: it is no state of this estimator, or of one with other kinds of landmarks.
        """
        if not isinstance(packed, RangeState):
            raise EstimatorError(f"{type(packed).__name__} is no state of the estimator {self.name!r}; replay again")
        if isinstance(self._source, AutomaticSource):
            try:
                return replace(packed, source=self._source.unpacked(packed.source))
            except ValueError as error:
                raise EstimatorError(str(error)) from error
        return packed

    def adopted(self, state: RangeState) -> RangeState:
        """The state under these settings, see `Resumable`.

        The landmarks go on with their means and covariances; settings of the start tell on those that start later.

        Raises:
            EstimatorError: other kinds of landmarks or of filter, or more landmarks than there may be now.
        """
        s, fresh = self._settings, self.start()
        if type(fresh.source) is not type(state.source):
            raise EstimatorError("landmarks: the landmarks of another source cannot be taken over; replay as a whole")
        if type(fresh.belief) is not type(state.belief):
            raise EstimatorError("mode: separate and joint filters cannot take over from each other; replay as a whole")
        needed = int(state.roster.slots.max(initial=-1)) + 1
        if needed > s.max_landmarks:
            raise EstimatorError(
                f"max_landmarks = {s.max_landmarks}: the landmarks followed by then take {needed} places; "
                f"set max_landmarks={needed} or more"
            )
        if not isinstance(self._source, AutomaticSource):
            return state
        return self.unpacked(replace(state, source=self._source.packed(state.source)), _no_images)

    # ------------------------------------------------------------------------------ one frame

    def _frame(
        self, state: RangeState, sample: Sample, sighting: Sighting, alarms: Verdict
    ) -> tuple[RangeState, RangeStep]:
        s = self._settings
        first = state.frames == 0
        moving = complete(s, state.velocities)
        dt_s = math.nan if first else (sample.t_ns - state.last_ns) * NS
        alarms |= self._alarms_of_inputs(state, sample, moving, first, dt_s)
        if _repeats(sighting, state.sighting):
            alarms |= Verdict.DUPLICATE_FRAME
            used = NOTHING
        else:
            used = sighting
        # without inputs nothing can be carried on, and nothing has been started
        ride = None
        velocities = state.velocities
        if moving and not first:
            velocities, ride = ridden(s, velocities, state.last_ns, sample.t_ns)
        driven = self._driven(state, ride)
        pixel, variance = _matched(state.roster, used)
        belief, update = self._updated(driven, pixel, variance)
        # … of what was lost only the record of this frame remains
        roster, trends, update = self._judged_update(state, driven, ride, update, pixel, sample.t_ns)
        started, starts = self._starts(state, driven, used, sample.t_ns) if moving else (NOTHING, [])
        new = self._enrolled(state, roster, started, sample.t_ns, driven.pose)
        everyone = roster.and_also(new)
        update = _with_started(update, starts, started)
        trends = trends.and_fresh(len(starts))
        measured = np.concatenate([np.isfinite(pixel[:, 0]), np.ones(len(starts), bool)])
        omega = math.nan if ride is None else _mean(ride.dt, ride.omega[:, 1])
        history = state.history
        if ride is not None:
            history = history.taking(s, update, omega, dt_s)
        told = update._replace(derotated_parallax_px=everyone.most_px)
        status = statuses(told, max_relative_sigma=s.max_relative_sigma, min_parallax_px=s.min_parallax_px)
        age = state.frames - everyone.born
        degrees = 1 if isinstance(sample, LandmarkSample) else 2
        alarms |= alarms_of_frame(s, told, status, measured, age, trends, history, degrees)
        if ride is not None and ride.still.any():
            alarms |= Verdict.STANDSTILL
        step = self._record(state, sample, everyone, update, status, measured, driven, ride, alarms, pixel, started)
        alive = np.flatnonzero(update.outcome != Outcome.LOST)
        kept = np.flatnonzero(update.outcome[: len(roster.ids)] != Outcome.LOST)
        after = replace(
            state,
            velocities=replace(velocities, disorder=False, unusable=False),
            belief=belief.only(kept).and_also(starts),
            roster=everyone.only(alive),
            trends=trends.only(alive),
            history=history,
            pose=driven.pose,
            sighting=sighting,
            ride=ride,
            candidates=self._waiting(state, driven, used, started, everyone, sample.t_ns) if moving else (),
            frames=state.frames + 1,
            last_ns=sample.t_ns,
            stream=sample.stream,
        )
        return after, step

    def _alarms_of_inputs(self, state: RangeState, sample: Sample, moving: bool, first: bool, dt_s: float) -> Verdict:
        s, known = self._settings, state.velocities
        alarms = Verdict.FIRST_FRAME if first else Verdict.OK
        if not moving:
            alarms |= Verdict.INPUT_MISSING
        elif max(known.speed.age_s(sample.t_ns), turn_signal(s, known).age_s(sample.t_ns)) > s.input_stale_s:
            alarms |= Verdict.INPUT_STALE
        if known.disorder:
            alarms |= Verdict.INPUT_OUT_OF_ORDER
        if known.unusable:
            alarms |= Verdict.INPUT_UNREADABLE
        usual = float(np.median(state.history.dt_s)) if state.history.dt_s else math.nan
        if dt_s > s.gap_factor * usual:
            alarms |= Verdict.FRAME_GAP
        return alarms

    # ------------------------------------------------------------- prediction and update

    def _driven(self, state: RangeState, ride: Ride | None) -> Driven:
        """Carry landmarks, pose and candidates over every interval since the last frame (23), (24)."""
        n = len(state.roster.ids)
        if ride is None:
            none = np.full((n, 3, 3), np.nan)
            return Driven(state.belief, state.pose, state.candidates, none, none[..., :2], None)
        variance = self._noise.density / ride.dt[:, None]
        variance[np.ix_(ride.still, self._noise.speeds)] = 0.0  # a robot that stands has no error of speed
        again = self._model.relinearisations > 0
        stop = len(ride.dt) - again
        out = ego_motion.carried(
            self._model,
            state.belief.mean,
            state.belief.pairs,
            *state.pose,
            dt=ride.dt[:stop],
            omega=ride.omega[:stop],
            velocity=ride.velocity[:stop],
            columns=self._noise.columns,
            q=variance[:stop],
            aligned=self._settings.motion is MotionModel.ALIGNED,
        )
        pose, inputs = Pose(out.turn, out.shift_m), None
        if again:
            pose = pose.after(ego_motion.arc(ride.omega[-1], ride.velocity[-1], ride.dt[-1]))
            inputs = Inputs(ride.omega[-1, 1], ride.velocity[-1, 2], ride.dt[-1], bool(ride.still[-1]))
        candidates = tuple(c._replace(motion=_continued(c.motion, ride, variance)) for c in state.candidates)
        belief = state.belief.carried(out.mean, out.pairs)
        return Driven(belief, pose, candidates, out.transition, out.noise_gain[..., :2], inputs)

    def _updated(self, driven: Driven, pixel: Floats, variance: Floats) -> tuple[Separate | Together, Update]:
        """Gate and update (25)-(27); A and G are those of the last interval."""
        if driven.inputs is not None and isinstance(driven.belief, Separate):
            return driven.belief.updated(self._model, pixel, variance, driven.inputs)
        belief: Separate | Together
        belief, update = driven.belief.updated(self._model, pixel, variance)
        return belief, update._replace(transition=driven.transition, noise_gain=driven.noise_gain)

    def _judged_update(
        self, state: RangeState, driven: Driven, ride: Ride | None, update: Update, pixel: Floats, t_ns: int
    ) -> tuple[Roster, Trends, Update]:
        """Put in parallaxes and distances from the focus; give up what was unseen for long; note what was seen."""
        s, roster = self._settings, state.roster
        seen = np.isfinite(pixel[:, 0])
        seen_ns = np.where(seen, t_ns, roster.seen_ns)
        unseen = (t_ns - seen_ns) * NS > s.keep_unseen_s
        outcome = np.where(unseen, int(Outcome.LOST), update.outcome)
        place = update.mean[:, :2]
        without_way = self._seen_from(roster.first_px, driven.pose.turn @ roster.first_turn.swapaxes(1, 2))
        with np.errstate(over="ignore"):  # the image point of what comes beside the camera runs to infinity
            update = update._replace(
                outcome=outcome,
                parallax_px=np.linalg.norm(place - roster.first_px, axis=1),
                derotated_parallax_px=np.linalg.norm(place - without_way, axis=1),
                focus_distance_px=np.linalg.norm(place - self._focus(ride), axis=1),
            )
        again = outcome == Outcome.RESET
        roster = replace(
            roster,
            seen_ns=seen_ns,
            first_px=np.where(again[:, None], pixel, roster.first_px),
            first_turn=np.where(again[:, None, None], driven.pose.turn, roster.first_turn),
            most_px=np.where(again, 0.0, np.fmax(roster.most_px, np.where(seen, update.derotated_parallax_px, 0.0))),
        )
        return roster, state.trends.taking(update), update

    def _seen_from(self, first_px: Floats, turn: Floats) -> Floats:
        """Where image points [n, 2] would be seen after turns [n, 3, 3] of the camera alone [n, 2]; NaN behind it."""
        focal = self._model.focal_px
        ray = np.column_stack([(first_px - self._centre) / focal, np.ones(len(first_px))])
        x, y, z = np.moveaxis((turn @ ray[:, :, None])[:, :, 0], -1, 0)
        z = np.where(z > 0.0, z, np.nan)
        return np.asarray(focal * np.stack([x / z, y / z], axis=1) + self._centre)

    def _focus(self, ride: Ride | None) -> Floats:
        """Focus of expansion [2], px, for the mean velocity since the last frame; NaN for none."""
        if ride is None:
            return np.full(2, np.nan)
        return eq.focus_of_expansion(ride.dt @ ride.velocity / ride.dt.sum(), self._model.focal_px, self._centre)

    # -------------------------------------------------------------------------- new landmarks

    def _starts(self, state: RangeState, driven: Driven, seen: Sighting, t_ns: int) -> tuple[Sighting, list[Start]]:
        """Those of the sighted landmarks that start in this frame, as many as there are slots, and their starts."""
        free = self._settings.max_landmarks - len(state.roster.ids)
        rows: list[int] = []
        starts: list[Start] = []
        known = set(state.roster.ids.tolist())
        for row, number in enumerate(seen.ids.tolist()):
            if len(starts) == free or number in known:
                continue
            begun = self._start_of(driven, seen, row)
            if begun is not None:
                known.add(number)
                rows.append(row)
                starts.append(begun)
        return Sighting(seen.ids[rows], seen.points_px[rows], seen.sigma_px[rows]), starts

    def _start_of(self, driven: Driven, seen: Sighting, row: int) -> Start | None:
        """The start of one landmark, None while it waits."""
        s = self._settings
        pixel, noise = seen.points_px[row], float(seen.sigma_px[row] ** 2)
        variance = noise if s.start_pixel_variance is None else s.start_pixel_variance
        try:
            if s.start is StartKind.RANGE:
                return start.from_range(pixel, variance, s.start_range_m, s.start_sigma_m)
            if s.start is StartKind.PLANE:
                normal, distance = self._plane(driven.pose)
                return start.from_plane(self._model, pixel, variance, normal, distance, s.start_plane_sigma_m)
            if s.start is StartKind.TWO_VIEWS:
                return self._from_two_views(driven, seen, row, noise)
            if s.start is StartKind.SECOND_LANDMARK and int(seen.ids[row]) in s.start_pair:
                return self._from_second_landmark(seen, row, noise)
        except ValueError:
            return None  # the geometry does not place it before the camera in this frame
        return start.from_broad_prior(pixel, variance, s.start_nearest_m)

    def _plane(self, pose: Pose) -> tuple[Floats, float]:
        """Normal [3] of the known plane in this frame's camera axes, and its distance, m."""
        s = self._settings
        normal = pose.turn @ self._body_r_camera.T @ np.array(s.start_plane_normal)
        normal = normal / np.linalg.norm(normal)
        return normal, s.start_plane_m + float(normal @ pose.shift_m)

    def _from_two_views(self, driven: Driven, seen: Sighting, row: int, noise: float) -> Start | None:
        for waiting in driven.candidates:
            if waiting.number == seen.ids[row]:
                turn = driven.pose.turn @ waiting.first_turn.T
                still = self._seen_from(waiting.first_px[None], turn[None])[0]
                if not np.linalg.norm(seen.points_px[row] - still) >= self._settings.start_parallax_px:
                    return None
                return start.from_two_views(self._model, seen.points_px[row], waiting.first_px, noise, waiting.motion)
        return None

    def _from_second_landmark(self, seen: Sighting, row: int, noise: float) -> Start | None:
        s = self._settings
        first, second = s.start_pair
        number = int(seen.ids[row])
        other = np.flatnonzero(seen.ids == (first if number == second else second))
        if not len(other):
            return None
        offset = self._body_r_camera.T @ np.array(s.start_offset_m) * (1.0 if number == second else -1.0)
        return start.from_second_landmark(
            self._model,
            seen.points_px[row],
            seen.points_px[other[0]],
            noise,
            offset,
            s.start_offset_sigma_m**2 * np.eye(3),
        )

    def _waiting(
        self, state: RangeState, driven: Driven, seen: Sighting, started: Sighting, roster: Roster, t_ns: int
    ) -> tuple[Candidate, ...]:
        """The landmarks that wait for a second view: those before that are still seen now and then, and new ones."""
        s = self._settings
        if s.start is not StartKind.TWO_VIEWS:
            return ()
        row_of = {int(number): row for row, number in enumerate(seen.ids)}
        begun = set(roster.ids.tolist())
        kept = [
            c._replace(seen_ns=t_ns) if c.number in row_of else c for c in driven.candidates if c.number not in begun
        ]
        kept = [c for c in kept if (t_ns - c.seen_ns) * NS <= s.keep_unseen_s]
        taken = begun | {c.number for c in kept}
        for number, row in row_of.items():
            if number not in taken and len(kept) < s.max_landmarks:
                noise = float(seen.sigma_px[row] ** 2)
                kept.append(Candidate(number, seen.points_px[row], noise, CameraMotion.none(), driven.pose.turn, t_ns))
        return tuple(kept)

    def _enrolled(self, state: RangeState, roster: Roster, started: Sighting, t_ns: int, pose: Pose) -> Roster:
        """The roster of new landmarks; each takes the lowest free slot."""
        n = len(started.ids)
        free = np.setdiff1d(np.arange(self._settings.max_landmarks), roster.slots)[:n]
        return Roster(
            started.ids.astype(np.int64),
            free.astype(np.int64),
            np.full(n, state.frames, np.int64),
            np.full(n, t_ns, np.int64),
            started.points_px.astype(np.float64).reshape(n, 2),
            np.broadcast_to(pose.turn, (n, 3, 3)).copy(),
            np.zeros(n),
        )

    # ------------------------------------------------------------------------------- records

    def _record(
        self,
        state: RangeState,
        sample: Sample,
        roster: Roster,
        update: Update,
        status: Longs,
        measured: NDArray[np.bool_],
        driven: Driven,
        ride: Ride | None,
        alarms: Verdict,
        pixel: Floats,
        started: Sighting,
    ) -> RangeStep:
        s, known = self._settings, state.velocities
        velocities = (
            np.full((1, 2), np.nan) if ride is None else np.column_stack([ride.omega[:, 1], ride.velocity[:, 2]])
        )
        dt = np.ones(1) if ride is None else ride.dt
        bias = bias_of(s, known) if ride is None else ride.bias_radps

        def slots(values: NDArray[Any]) -> Floats:
            out = np.full((s.max_landmarks, *values.shape[1:]), np.nan)
            out[roster.slots] = values
            return out

        return RangeStep(
            frame=_frame_number(state, sample),
            t_ns=sample.t_ns,
            received_ns=sample.received_ns,
            verdict=gravest(alarms),
            alarms=alarms,
            omega_radps=_mean(dt, velocities[:, 0]),
            speed_mps=_mean(dt, velocities[:, 1]),
            dt_s=math.nan if state.frames == 0 else (sample.t_ns - state.last_ns) * NS,
            intervals=0 if ride is None else len(ride.dt),
            still=int(ride is not None and bool(ride.still.any())),
            gyro_age_s=turn_signal(s, known).age_s(sample.t_ns),
            odometer_age_s=known.speed.age_s(sample.t_ns),
            gyro_bias_radps=float((bias @ self._body_r_camera)[1]),
            focus_px=self._focus(ride),
            landmarks=len(roster.ids),
            measured=int(measured.sum()),
            converged=int((status == 2).sum()),
            landmark_id=slots(roster.ids),
            outcome=slots(update.outcome),
            status=slots(status),
            age_frames=slots(state.frames - roster.born),
            prior=slots(update.prior),
            prior_covariance=slots(update.prior_covariance),
            transition=slots(update.transition),
            noise_gain=slots(update.noise_gain),
            measured_px=slots(np.concatenate([pixel, started.points_px])),
            innovation_px=slots(update.innovation),
            innovation_covariance=slots(update.innovation_covariance),
            gain=slots(update.gain),
            nis=slots(update.nis),
            log_likelihood=slots(update.log_likelihood),
            rejections=slots(update.rejections),
            mean=slots(update.mean),
            covariance=slots(update.covariance),
            range_m=slots(update.range_m),
            range_interval_m=slots(update.range_interval_m),
            relative_sigma=slots(update.relative_sigma),
            parallax_px=slots(update.parallax_px),
            derotated_parallax_px=slots(update.derotated_parallax_px),
            focus_distance_px=slots(update.focus_distance_px),
        )

    def _skip(self, state: RangeState, sample: Sample) -> tuple[RangeState, RangeStep]:
        """Pass over a frame whose stamp does not lie after the one before it; nothing is carried on."""
        s, n = self._settings, self._settings.max_landmarks
        alarms = Verdict.OUT_OF_ORDER | (Verdict.UNDECODABLE if isinstance(sample, Problem) else Verdict.OK)
        known = state.velocities

        def none(*shape: int) -> Floats:
            return np.full((n, *shape), np.nan)

        step = RangeStep(
            frame=_frame_number(state, sample),
            t_ns=sample.t_ns,
            received_ns=sample.received_ns,
            verdict=gravest(alarms),
            alarms=alarms,
            omega_radps=math.nan,
            speed_mps=math.nan,
            dt_s=(sample.t_ns - state.last_ns) * NS,
            intervals=0,
            still=0,
            gyro_age_s=turn_signal(s, known).age_s(sample.t_ns),
            odometer_age_s=known.speed.age_s(sample.t_ns),
            gyro_bias_radps=float((bias_of(s, known) @ self._body_r_camera)[1]),
            focus_px=np.full(2, np.nan),
            landmarks=len(state.roster.ids),
            measured=0,
            converged=0,
            landmark_id=none(),
            outcome=none(),
            status=none(),
            age_frames=none(),
            prior=none(3),
            prior_covariance=none(3, 3),
            transition=none(3, 3),
            noise_gain=none(3, 2),
            measured_px=none(2),
            innovation_px=none(2),
            innovation_covariance=none(2, 2),
            gain=none(3, 2),
            nis=none(),
            log_likelihood=none(),
            rejections=none(),
            mean=none(3),
            covariance=none(3, 3),
            range_m=none(),
            range_interval_m=none(2),
            relative_sigma=none(),
            parallax_px=none(),
            derotated_parallax_px=none(),
            focus_distance_px=none(),
        )
        return replace(state, frames=state.frames + 1), step


def _source_of(settings: RangeSettings) -> LandmarkSource[Any]:
    try:
        return source_of(settings, settings.camera, surveyed=settings.only_landmarks or None)
    except ValueError as error:
        raise EstimatorError(str(error)) from error


def _no_images(frame: int) -> NDArray[np.uint8]:
    raise EstimatorError(f"the state asks for the image of frame {frame}; replay again")


def _continued(motion: CameraMotion, ride: Ride, variance: Floats) -> CameraMotion:
    """A motion, followed by the intervals of a frame."""
    for k in range(len(ride.dt)):
        held = eq.held(ride.omega[k, 1], ride.velocity[k, 2], ride.dt[k])
        motion = motion.then(held, variance[k, 0], variance[k, 1])
    return motion


def _mean(dt: Floats, values: Floats) -> float:
    """Mean over time of values that are held over intervals."""
    return float(dt @ values / dt.sum())


def _frame_number(state: RangeState, sample: Sample) -> int:
    number = int(getattr(sample, "frame", -1))
    return state.frames if number < 0 else number


def _repeats(now: Sighting, before: Sighting) -> bool:
    """Whether a sighting is the one before it, digit by digit."""
    return (
        len(now.ids) >= DUPLICATE_POINTS
        and np.array_equal(now.ids, before.ids)
        and np.array_equal(now.points_px, before.points_px)
    )


def _matched(roster: Roster, seen: Sighting) -> tuple[Floats, Floats]:
    """Image points [n, 2] of the landmarks, NaN for none, and their variances [n]; of two for one the first."""
    pixel, variance = np.full((len(roster.ids), 2), np.nan), np.ones(len(roster.ids))
    place = {number: row for row, number in enumerate(roster.ids.tolist())}
    for row in range(len(seen.ids) - 1, -1, -1):
        at = place.get(int(seen.ids[row]))
        if at is not None:
            pixel[at], variance[at] = seen.points_px[row], seen.sigma_px[row] ** 2
    return pixel, variance


def _with_started(update: Update, starts: Sequence[Start], started: Sighting) -> Update:
    """The update, followed by the landmarks that started: they have a mean and a covariance, and no prediction."""
    n = len(starts)
    if not n:
        return update
    mean = np.array([s.state for s in starts])
    covariance = np.array([s.covariance for s in starts])
    sigma = np.sqrt(covariance[:, 2, 2])
    near, far = eq.range_interval(mean[:, 2], sigma)
    known: dict[str, NDArray[Any]] = {
        "outcome": np.full(n, int(Outcome.STARTED)),
        "mean": mean,
        "covariance": covariance,
        "rejections": np.zeros(n, np.int64),
        "range_m": 1.0 / mean[:, 2],
        "range_interval_m": np.stack([near, far], axis=-1),
        "relative_sigma": sigma / mean[:, 2],
        "parallax_px": np.zeros(n),
        "derotated_parallax_px": np.zeros(n),
    }
    grown: dict[str, NDArray[Any]] = {}
    for name, values in update._asdict().items():
        if name in ("inputs", "input_variance"):
            continue
        grown[name] = np.concatenate([values, known.get(name, np.full((n, *values.shape[1:]), np.nan))])
    return update._replace(**grown)
