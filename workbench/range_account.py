"""The account of a run of ranges: each landmark followed, held against the reference, and what it all is worth.

The reference is computed here, beside the estimator, which never sees it.
"""

from __future__ import annotations

import dataclasses
import math
from array import array
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import NDArray

from pipelines.consistency import band
from pipelines.lens import undistorted
from pipelines.ranging.filter import Outcome, Status
from pipelines.ranging.landmarks.frames import seen_px
from pipelines.ranging.landmarks.settings import BoardSettings, LandmarkKind, MarkerSettings
from pipelines.ranging.reference import PoseTrack, ReferenceRanges
from pipelines.ranging.step import RangeStep
from readers.streams import Camera, Landmark, StreamKind
from workbench.inputs import Reference
from workbench.range_calibration import SensorCalibration
from workbench.range_smoothing import COVERED_SIGMAS, Smoothing, error_values
from workbench.range_traces import GATE, Beside, RangeScene
from workbench.settings import Resolved
from workbench.summary import Tally, range_suitability

if TYPE_CHECKING:
    from pipelines.estimator import Step
    from pipelines.replay import Frame
    from workbench.range_inputs import Streams
    from workbench.session import RunLog

Floats = NDArray[np.float64]

BAND = 0.95
"""Share of right filters whose mean NIS lies within the band."""
MAX_GAP_S = 1.0
"""Between reference poses farther apart than this nothing is known."""


@dataclass(slots=True)
class Life:
    """All that is kept of one landmark, over all of its starts.

    `errors` are relative errors of its range in the frames in which the range counted and the reference knew it, 8
    bytes each; `nees` sums (ξ - 1/Z)²/P_ξξ over them. `nis` sums the NIS, of which one above the gate counts as the
    gate: single blunders are told by their number.
    """

    frames: int = 0
    starts: int = 0
    updates: int = 0
    nis: float = 0.0
    converged: int = 0
    rejected: int = 0
    resets: int = 0
    losses: int = 0
    began_ns: int = -1
    told: bool = False
    waits_s: array[float] = field(default_factory=lambda: array("d"))
    errors: array[float] = field(default_factory=lambda: array("d"))
    nees: float = 0.0
    covered: int = 0


class RangeAccount:
    """Follows the landmarks of a run.

    Args:
        scene: what the drawing of the run needs to know.
        ranges: the reference ranges, which take the frames as they pass; None where nothing tells any.
        poses: the reference poses.
        body_t_camera: where the camera sits [4, 4].
        sentence: what the reference is.
        offset_ns: added to the frames' times to find the reference.
        degrees: of freedom of an image point.
        sensors: collects what tells of the sensors; None where nobody asked.
        smoothing: smooths the run at its end; None where nobody asked.
    """

    trajectory = False

    def __init__(
        self,
        scene: RangeScene,
        ranges: ReferenceRanges,
        poses: PoseTrack,
        body_t_camera: Floats,
        sentence: str,
        offset_ns: int = 0,
        degrees: int = 2,
        sensors: SensorCalibration | None = None,
        smoothing: Smoothing | None = None,
    ) -> None:
        self.scene = scene
        self._ranges, self._poses, self._body_t_camera = ranges, poses, body_t_camera
        self._sentence, self._offset_ns, self._degrees = sentence, offset_ns, degrees
        self._sensors, self.smoothing = sensors, smoothing
        self._lives: dict[int, Life] = {}
        self._carried = self._measured = self._converged = 0

    @classmethod
    def of(
        cls,
        resolved: Resolved,
        landmarks: Mapping[int, Landmark],
        reference: Reference,
        streams: Streams,
        offset_ns: int,
        *,
        calibrate: bool = False,
        smooth: bool = False,
    ) -> RangeAccount:
        """The account of a replay with these settings and this reference."""
        settings: Any = resolved.settings
        bearings = streams.kind is StreamKind.LANDMARKS
        found_in_images = streams.kind is StreamKind.IMAGE
        known = {} if found_in_images else landmarks  # what is found in images has numbers of its own
        body_t_camera = np.eye(4)
        body_t_camera[:3, :3] = settings.body_r_camera
        body_t_camera[:3, 3] = settings.camera_position_m or (0.0, 0.0, 0.0)
        poses = PoseTrack(MAX_GAP_S)
        own = None if bearings else settings.camera
        board = _board_of(resolved)
        ranges = ReferenceRanges(
            _placed(own, body_t_camera),
            landmarks=known,
            pose_stream=reference.stream or "none",
            board=board,
            max_gap_s=MAX_GAP_S,
        )
        for pose in reference.poses:
            poses.add(pose.t_ns, pose.position_m, pose.quat_xyzw)
            ranges.take(pose)
        centre = settings.pinhole_centre_px
        scene = RangeScene(
            focal_px=settings.pinhole_focal_px,
            centre_px=centre,
            image_px=_canvas(settings.image_size_px, centre, bearings),
            surveyed={number: one.position_m for number, one in landmarks.items()} if reference.poses else {},
            referenced=bool(reference.poses),
        )
        if own is not None and not undistorted(own):
            scene = dataclasses.replace(scene, on_image=lambda points: _seen(own, points))
        sentence = _sentence(reference, known, bearings, board is not None, found_in_images)
        sensors = SensorCalibration(settings, bool(streams.imu)) if calibrate else None
        smoothing = Smoothing(settings) if smooth else None
        return cls(scene, ranges, poses, body_t_camera, sentence, offset_ns, 1 if bearings else 2, sensors, smoothing)

    # ---- step by step

    def take(self, step: Step, sample: Frame) -> Beside:
        """Follow the landmarks of one step; what the reference says of its frame."""
        assert isinstance(step, RangeStep)
        self._ranges.take(dataclasses.replace(sample, t_ns=step.t_ns))  # as the estimator dates it
        if self._sensors is not None:
            self._sensors.take(step)
        ids = np.nan_to_num(step.landmark_id, nan=-1).astype(np.int64)
        depth = self._ranges.at(step.t_ns + self._offset_ns, ids).depth_m
        depth = np.where(depth > 0, depth, np.nan)
        if self.smoothing is not None:
            self.smoothing.take(depth)
        self._carried += step.landmarks
        self._measured += step.measured
        self._converged += step.converged
        for slot in np.flatnonzero(ids >= 0).tolist():
            self._follow(self._lives.setdefault(int(ids[slot]), Life()), step, slot, float(depth[slot]))
        return Beside(self._poses.at(step.t_ns + self._offset_ns) @ self._body_t_camera, depth)

    def _follow(self, life: Life, step: RangeStep, slot: int, depth_m: float) -> None:
        life.frames += 1
        if step.age_frames[slot] == 0 or life.began_ns < 0:
            life.starts, life.began_ns, life.told = life.starts + 1, step.t_ns, False
        outcome, nis = step.outcome[slot], step.nis[slot]
        life.rejected += bool(outcome == Outcome.REJECTED)
        life.resets += bool(outcome == Outcome.RESET)
        life.losses += bool(outcome == Outcome.LOST)
        if math.isfinite(nis):
            life.updates += 1
            life.nis += min(float(nis), GATE)
        if step.status[slot] != Status.CONVERGED:
            return
        life.converged += 1
        if not life.told:
            life.told = True
            life.waits_s.append((step.t_ns - life.began_ns) / 1e9)
        if math.isfinite(depth_m):
            self._compare(life, step.mean[slot, 2], step.covariance[slot, 2, 2], depth_m)

    def _compare(self, life: Life, xi: float, variance: float, depth_m: float) -> None:
        life.errors.append(1 / (xi * depth_m) - 1)
        squared = float((xi - 1 / depth_m) ** 2 / variance)
        life.nees += squared
        life.covered += squared <= COVERED_SIGMAS**2

    # ---- the end

    def conclude(self, run: RunLog, tally: Tally, median_dt_s: float) -> tuple[dict[str, Any], None]:
        """What became of the landmarks, and how far it can be trusted."""
        lives = self._lives.values()
        waits = [wait for life in lives for wait in life.waits_s]
        starts = sum(life.starts for life in lives)
        ranging: dict[str, Any] = {
            "landmarks": len(lives),
            "starts": starts,
            "converged_landmarks": sum(life.converged > 0 for life in lives),
            "converged_share": self._converged / self._carried if self._carried else 0.0,
            "time_to_converge_s": float(np.median(waits)) if waits else math.nan,
            "updates": sum(life.updates for life in lives),
            "rejected": sum(life.rejected for life in lives),
            "resets": sum(life.resets for life in lives),
            "lost": sum(life.losses for life in lives),
            "nis": self._nis(list(lives)),
            "error": _errors(list(lives)),
            "per_landmark": [self._one(number, life) for number, life in sorted(self._lives.items())],
        }
        return {
            "reference": self._sentence if ranging["error"] else self._without(),
            "ranging": ranging,
            "evaluation": None,
            "smoothed": None if self.smoothing is None else self.smoothing.told(),
            "calibration": None if self._sensors is None else self._sensors.told(),
            "suitability": range_suitability(tally, ranging),
        }, None

    def _without(self) -> str:
        return f"{self._sentence}; nothing to compare: no range counted where the reference knows it"

    def _nis(self, lives: list[Life]) -> dict[str, float]:
        """Mean NIS, what is expected of a right filter, and the band in which it would lie."""
        count = sum(life.updates for life in lives)
        mean = sum(life.nis for life in lives) / count if count else math.nan
        low, high = band(self._degrees, count, BAND)
        return {"mean": mean, "expected": float(self._degrees), "low": low, "high": high, "count": count}

    def _one(self, number: int, life: Life) -> dict[str, Any]:
        return {
            "landmark": number,
            "frames": life.frames,
            "starts": life.starts,
            "converged_share": life.converged / life.frames,
            "time_to_converge_s": float(np.median(life.waits_s)) if life.waits_s else math.nan,
            "updates": life.updates,
            "nis": life.nis / life.updates if life.updates else math.nan,
            "rejected": life.rejected,
            "resets": life.resets,
            "error": _errors([life]),
        }


def _errors(lives: list[Life]) -> dict[str, float] | None:
    """Relative errors of the ranges that counted, in percent, and their consistency; None where none is known."""
    errors = np.concatenate([np.zeros(0), *(np.frombuffer(life.errors) for life in lives)])
    return error_values(errors, sum(life.nees for life in lives), sum(life.covered for life in lives))


def _placed(camera: Camera | None, body_t_camera: Floats) -> Camera:
    """The camera of the frames, where the estimator takes it to be."""
    if camera is not None:
        return dataclasses.replace(camera, body_t_camera=body_t_camera)
    return Camera(
        width_px=0,
        height_px=0,
        matrix=np.eye(3),
        distortion_model="none",
        distortion=np.zeros(0),
        rectification=np.eye(3),
        projection=np.zeros((3, 4)),
        body_t_camera=body_t_camera,
    )


def _canvas(size: tuple[int, int] | None, centre_px: tuple[float, float], bearings: bool) -> tuple[float, float] | None:
    """Width and height of the images; where unknown, twice the principal point."""
    if size is not None:
        return float(size[0]), float(size[1])
    if bearings or min(centre_px) <= 0:
        return None
    return 2 * centre_px[0], 2 * centre_px[1]


def _seen(camera: Camera, points_px: Floats) -> Floats:
    """Where the image shows points [n, 2] of the ideal camera; NaN stays NaN."""
    seen = np.full_like(points_px, np.nan)
    known = np.isfinite(points_px).all(axis=1)
    seen[known] = seen_px(camera, points_px[known])
    return seen


def _board_of(resolved: Resolved) -> BoardSettings | MarkerSettings | None:
    """The board whose pose tells ranges: where its size was given."""
    settings: Any = resolved.settings
    if settings.landmarks is LandmarkKind.CHESSBOARD and settings.board.square_m is not None:
        return cast(BoardSettings, settings.board)
    if settings.landmarks is LandmarkKind.ARUCO and "markers" in resolved.given:
        return cast(MarkerSettings, settings.markers)
    return None


def _sentence(
    reference: Reference, landmarks: Mapping[int, Landmark], bearings: bool, board: bool, found_in_images: bool
) -> str:
    """What the reference ranges come from."""
    parts = []
    if landmarks and reference.poses:
        parts.append(f"{len(landmarks)} surveyed landmarks and the poses of {reference.stream}")
    if bearings:
        parts.append("the ranges that were measured with the bearings")
    if board:
        parts.append("the pose of the board, whose size was given")
    if parts:
        return ", else ".join(parts)
    if found_in_images:
        return "none: the landmarks are found in the images, and nothing tells where they are (a board's size would)"
    if landmarks:
        return f"none: {len(landmarks)} surveyed landmarks, but {reference.sentence}"
    return f"none: no surveyed landmarks; reference poses: {reference.sentence}"
