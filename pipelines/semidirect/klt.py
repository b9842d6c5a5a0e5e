"""The cheapest odometry over flat ground, as a peer: OpenCV's corners, optical flow and homographies.

Corners of a keyframe (Shi, Tomasi, CVPR 1994) are followed from frame to frame (Bouguet's pyramidal Lucas-Kanade). A
homography between the keyframe and the frame, H = R + t nᵀ/d, is found by RANSAC and decomposed; the ground's normal n
and the keyframe's distance d from it choose among its four solutions and give t its length. The first keyframe is
taken to be level only as long as it stands; its last homography tells how the ground lies. From then on corners lie
where their rays met the ground, and the pose is refined on their reprojection errors. It keeps no map: what it knows
of the ground is that it is flat, which is why bumps lead it astray.

World: z up but for the tilt of the first frame.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.spatial.transform import Rotation

from pipelines.correlation.odometry import eight_bit
from pipelines.estimator import EstimatorError
from pipelines.geometry import heading_of_quat, wrap_angle
from pipelines.semidirect.optics import Optics, optics_of, rays
from pipelines.semidirect.settings import CameraSettings, Count, Fraction, Positive
from pipelines.semidirect.step import Stage, VisualStep
from pipelines.verdict import Verdict
from readers.streams import ImageSample, Problem, Sample, StreamKind

Floats = NDArray[np.float64]
Grey = NDArray[np.uint8]

RANSAC_SEED = 1
RANSAC_CONFIDENCE, RANSAC_ITERATIONS = 0.999, 2000
REFINEMENT = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 10, 1e-9)


class KltSettings(CameraSettings):
    """Every default of the peer by name; `height_m` must be given."""

    corners: Count = Field(300, description="most corners of a keyframe")
    corner_quality: Positive = Field(0.01, description="least Shi-Tomasi score, as a share of the best corner's")
    corner_distance_px: Positive = Field(15.0, description="least distance of two corners")
    window_px: Annotated[int, Field(ge=5)] = Field(21, description="side of the window that is followed")
    levels: Annotated[int, Field(ge=0)] = Field(3, description="coarser levels of the pyramid")
    inlier_px: Positive = Field(1.0, description="a corner farther off its homography is dropped")
    keyframe_share: Fraction = Field(0.6, description="a new keyframe when fewer of its corners are left")
    min_tracked: Annotated[int, Field(ge=4)] = Field(30, description="fewer are LOST")


class Pose(NamedTuple):
    """`world_T_cam`: rotation [3, 3] from camera axes to the world, and the camera's centre [3], m."""

    turn: Floats
    place: Floats


class Plane(NamedTuple):
    """The ground: normal [3] in the world, away from the camera; `known` by a homography, not only taken for level."""

    normal: Floats
    known: bool


LEVEL = Plane(np.array([0.0, 0.0, -1.0]), known=False)


@dataclass(frozen=True, slots=True)
class Keyframe:
    """The last keyframe: its frame number, pose, distance from the ground (m), and how many corners it had."""

    frame: int
    pose: Pose
    distance_m: float
    corners: int


@dataclass(frozen=True, slots=True)
class State:
    """Between two frames: the image, and the corners that are followed.

    `first_unit` [n, 2] are the corners' rays in the keyframe, `ground_m` [n, 3] their places, `px` float32 [n, 2]
    where they are in `image`.
    """

    frame: int
    t_ns: int
    image: Grey = field(repr=False)
    pose: Pose
    keyframe: Keyframe
    plane: Plane
    first_unit: Floats
    ground_m: Floats
    px: NDArray[np.float32]
    starts: int


class KltOdometry:
    """OpenCV's KLT and homography as an estimator; see the module."""

    name: ClassVar[str] = "klt"
    kinds: ClassVar[tuple[StreamKind, ...]] = (StreamKind.IMAGE,)
    step_type = VisualStep

    def __init__(self, settings: KltSettings) -> None:
        if settings.height_m is None:
            raise EstimatorError("klt: set height_m, the camera's height over the ground at the start")
        self.settings = settings
        self._height_m = settings.height_m
        self._optics: dict[tuple[int, int], Optics] = {}

    def start(self) -> State | None:
        """Nothing is known before the first frame."""
        return None

    def step(self, state: State | None, sample: Sample, /) -> tuple[State | None, VisualStep | None]:
        """Follow the corners into the next image; what cannot be decoded before the first one gives no Step.

        Raises:
            ValueError: the settings do not tell the camera.
        """
        if not isinstance(sample, ImageSample):
            if state is None or not isinstance(sample, Problem):
                return state, None
            return state, _skipped(state, sample, Verdict.UNDECODABLE)
        if state is not None and sample.t_ns <= state.t_ns:
            return state, _skipped(state, sample, Verdict.OUT_OF_ORDER)
        image = eight_bit(sample.grey())
        if state is None:
            begun = self._keyframe(image, sample, self._start_pose(), LEVEL, self._height_m, 0)
            return begun, _step(begun, None, sample, Stage.STARTED, Verdict.FIRST_FRAME)
        if image.shape != state.image.shape:
            return state, _skipped(state, sample, Verdict.SIZE_CHANGED)
        return self._followed(state, image, sample)

    # ------------------------------------------------------------------------------ frames

    def _followed(self, state: State, image: Grey, sample: ImageSample) -> tuple[State, VisualStep]:
        px, found = self._flow(state, image)
        unit = self._unit(image, px[found])
        first, ground = state.first_unit[found], state.ground_m[found]
        found_pose = self._pose(state, first, unit, ground)
        if found_pose is None:
            begun = self._keyframe(
                image,
                sample,
                state.pose,
                state.plane,
                _distance(state.keyframe, state.plane, state.pose),
                state.starts + 1,
            )
            return begun, _step(begun, state, sample, Stage.LOST, Verdict.LOST)
        pose, plane, inliers = found_pose
        after = State(
            sample.frame, sample.t_ns, image, pose, state.keyframe, state.plane, first[inliers], ground[inliers],
            px[found][inliers], state.starts,
        )  # fmt: skip
        if len(after.px) < self.settings.keyframe_share * state.keyframe.corners:
            distance = _distance(state.keyframe, plane, pose)
            after = self._keyframe(image, sample, pose, plane, distance, state.starts)
        return after, _step(after, state, sample, Stage.TRACKED, Verdict.OK, int(np.count_nonzero(inliers)))

    def _flow(self, state: State, image: Grey) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Where the corners are now [n, 2], and which were found [n]."""
        if not len(state.px):
            return state.px, np.zeros(0, np.bool_)
        side = (self.settings.window_px, self.settings.window_px)
        flow: Any = cv2.calcOpticalFlowPyrLK
        px, status, _ = flow(state.image, image, state.px[:, None], None, winSize=side, maxLevel=self.settings.levels)
        px = px.reshape(-1, 2)
        height, width = image.shape
        inside = (px >= 0).all(axis=1) & (px[:, 0] <= width - 1) & (px[:, 1] <= height - 1)
        return px, (status.ravel() == 1) & inside

    def _pose(
        self, state: State, first: Floats, unit: Floats, ground: Floats
    ) -> tuple[Pose, Plane, NDArray[np.bool_]] | None:
        """The pose from corners at unit depth in the keyframe and now [n, 2], the ground, and which agree with it."""
        if len(unit) < self.settings.min_tracked:
            return None
        assert self.settings.focal_px is not None
        cv2.setRNGSeed(RANSAC_SEED)
        bound = self.settings.inlier_px / self.settings.focal_px
        homography, mask = cv2.findHomography(
            first, unit, cv2.RANSAC, bound, maxIters=RANSAC_ITERATIONS, confidence=RANSAC_CONFIDENCE
        )
        if homography is None or np.count_nonzero(mask) < self.settings.min_tracked:
            return None
        inliers = mask.ravel() > 0
        pose, normal = decomposed(homography, state.keyframe, state.plane.normal)
        if not state.plane.known:
            return pose, Plane(normal, known=True), inliers
        return _refined(pose, ground[inliers], unit[inliers]), state.plane, inliers

    def _keyframe(
        self, image: Grey, sample: ImageSample, pose: Pose, plane: Plane, distance_m: float, starts: int
    ) -> State:
        s = self.settings
        corners: Any = cv2.goodFeaturesToTrack(image, s.corners, s.corner_quality, s.corner_distance_px)
        px = np.empty((0, 2), np.float32) if corners is None else corners.reshape(-1, 2)
        unit = self._unit(image, px)
        ways = np.column_stack([unit, np.ones(len(unit))]) @ pose.turn.T
        nears = ways @ plane.normal
        down = nears > 0
        ground = pose.place + distance_m / nears[down, None] * ways[down]
        key = Keyframe(sample.frame, pose, distance_m, int(np.count_nonzero(down)))
        return State(sample.frame, sample.t_ns, image, pose, key, plane, unit[down], ground, px[down], starts)

    # ------------------------------------------------------------------------------ camera

    def _unit(self, image: Grey, px: NDArray[np.float32]) -> Floats:
        """The rays (a, b) [n, 2] of pixels, NaN-free: corners lie in the image."""
        shape = (image.shape[1], image.shape[0])
        if shape not in self._optics:
            self._optics[shape] = optics_of(self.settings.camera(*shape))
        return rays(self._optics[shape], px.astype(np.float64))[:, :2]

    def _start_pose(self) -> Pose:
        x, y, heading = self.settings.start_pose
        about_z = Rotation.from_euler("z", heading + self.settings.mounting_yaw_rad).as_matrix()
        return Pose(about_z @ np.diag([1.0, -1.0, -1.0]), np.array([x, y, self._height_m]))


# ------------------------------------------------------------------------------- geometry


def decomposed(homography: Floats, key: Keyframe, normal: Floats) -> tuple[Pose, Floats]:
    """The camera's pose and the ground's normal [3] in the world from a homography of the ground.

    H = R + t nᵀ/d maps the keyframe's rays; of OpenCV's solutions that whose normal is nearest to the one given.
    """
    _, turns, shifts, normals = cv2.decomposeHomographyMat(homography, np.eye(3))
    in_world = [key.pose.turn @ n.ravel() for n in normals]
    best = int(np.argmax([float(n @ normal) for n in in_world]))
    turn = key.pose.turn @ turns[best].T
    return Pose(turn, key.pose.place - turn @ shifts[best].ravel() * key.distance_m), in_world[best]


def _distance(key: Keyframe, plane: Plane, pose: Pose) -> float:
    """Distance of a camera from the ground, which the keyframe's is known from."""
    return key.distance_m - float(plane.normal @ (pose.place - key.pose.place))


def _refined(pose: Pose, ground: Floats, unit: Floats) -> Pose:
    """The pose of least reprojection error of points [n, 3] seen along rays (a, b) [n, 2]."""
    turn, _ = cv2.Rodrigues(pose.turn.T)
    refine: Any = cv2.solvePnPRefineLM
    turn, shift = refine(ground, unit, np.eye(3), None, turn, -pose.turn.T @ pose.place[:, None], REFINEMENT)
    world_r_cam = cv2.Rodrigues(turn)[0].T
    return Pose(world_r_cam, -world_r_cam @ shift.ravel())


# ---------------------------------------------------------------------------------- steps


def _skipped(state: State, sample: Sample, alarm: Verdict) -> VisualStep:
    held = dataclasses.replace(state, frame=int(getattr(sample, "frame", -1)))
    return _step(held, state, sample, Stage.SKIPPED, alarm)


def _step(
    now: State, before: State | None, sample: Sample, stage: Stage, alarm: Verdict, tracked: int | None = None
) -> VisualStep:
    """One frame: `tracked` corners agree with its pose, all of the keyframe's where it is not given."""
    quat = Rotation.from_matrix(now.pose.turn).as_quat()
    last = now if before is None else before
    moved = now.pose.place - last.pose.place
    heading = heading_of_quat(quat)
    accepted = stage in (Stage.STARTED, Stage.TRACKED)
    height, width = now.image.shape
    nan, none = math.nan, np.empty(0, np.int64)
    return VisualStep(
        frame=now.frame,
        t_ns=sample.t_ns,
        received_ns=sample.received_ns,
        verdict=alarm,
        alarms=alarm,
        accepted=accepted,
        stage=int(stage),
        dt_s=nan if before is None else 1e-9 * (sample.t_ns - before.t_ns),
        image_size_px=np.array([width, height], np.float64),
        position_m=now.pose.place,
        quat_xyzw=quat,
        pose=np.array([*now.pose.place[:2], heading]),
        increment_m=moved[:2],
        path_step_m=float(np.linalg.norm(moved)),
        delta_heading_rad=wrap_angle(heading - heading_of_quat(Rotation.from_matrix(last.pose.turn).as_quat())),
        pose_sigma=np.full(6, nan),
        map_number=now.starts,
        relocalised_frames=-1,
        tracked=(len(now.px) if tracked is None else tracked) if accepted else 0,
        keyframe=int(now.keyframe.frame == now.frame),
        keyframes=1,
        map_points=0,
        scene_depth_m=float(now.pose.place[2]),
        scale_known=1,
        metres_per_unit=1.0,
        metres_per_unit_sigma=nan,
        point_id=none,
        predicted_px=np.empty((0, 2)),
        found_px=np.empty((0, 2)),
        level=none,
        outcome=none,
        error_px=np.empty(0),
        keyframe_number=none,
        keyframe_position_m=np.empty((0, 3)),
        keyframe_quat_xyzw=np.empty((0, 4)),
        map_id=none,
        map_point_m=np.empty((0, 3)),
        map_point_sigma_m=np.empty(0),
        map_point_views=none,
    )
