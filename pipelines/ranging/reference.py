"""What the ranges of landmarks really are, to be laid beside the estimates; nothing of it enters the filter.

The filter's range is Z, the depth along the camera's optical axis; with it stands the distance from the camera. There
are four ways to know them: surveyed places and a reference pose, a range that the vehicle measured, the pose of a
board of known size, and the truth of a simulation.
"""

from __future__ import annotations

import bisect
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from pipelines.ranging.landmarks.boards import (
    Chessboard,
    Markers,
    board_pose,
    chessboard_points,
    marker_points,
)
from pipelines.ranging.landmarks.settings import BoardSettings, MarkerSettings
from pipelines.ranging.sightings import Sighting
from pipelines.simulation.motion import Motion, Mount
from readers.streams import Camera, Landmark, LandmarkSample, OdometrySample, PoseSample, Sample

Floats = NDArray[np.float64]
Longs = NDArray[np.int64]


class Ranges(NamedTuple):
    """Reference ranges of n landmarks; NaN where unknown.

    Attributes:
        depth_m: Z along the optical axis [n].
        distance_m: from the camera's centre [n].
    """

    depth_m: Floats
    distance_m: Floats


# --------------------------------------------------------------------------- one way, one function


def in_camera(points_in_cam: Floats) -> Ranges:
    """Ranges of points [n, 3] in camera axes."""
    return Ranges(points_in_cam[:, 2].copy(), np.asarray(np.linalg.norm(points_in_cam, axis=1)))


def surveyed(landmarks_m: Floats, world_t_body: Floats, body_t_camera: Floats) -> Ranges:
    """Ranges of surveyed landmarks [n, 3] from a reference pose.

    A landmark of unknown height (z NaN) is taken to be as high as the camera.

    Args:
        landmarks_m: places in the world.
        world_t_body: the reference pose [4, 4]; NaN where unknown.
        body_t_camera: where the camera sits [4, 4].
    """
    world_t_camera = world_t_body @ body_t_camera
    points = np.array(landmarks_m, dtype=np.float64)
    points[:, 2] = np.where(np.isnan(points[:, 2]), world_t_camera[2, 3], points[:, 2])
    return in_camera((points - world_t_camera[:3, 3]) @ world_t_camera[:3, :3])


def measured(range_m: Floats, bearing_rad: Floats) -> Ranges:
    """Ranges [n] measured in the plane with their bearings [n], for a camera that looks along x: Z = r cos β."""
    return Ranges(range_m * np.cos(bearing_rad), np.array(range_m, dtype=np.float64))


def of_chessboard(sighting: Sighting, settings: BoardSettings, camera: Camera) -> Ranges:
    """Ranges of the corners of a chessboard, by the board's pose; NaN for all where fewer than 4 are seen.

    Raises:
        ValueError: the side of a square is unknown.
    """
    places = chessboard_points(settings)[sighting.ids]
    return _of_plane(sighting.points_px, places, camera)


def of_markers(sighting: Sighting, settings: MarkerSettings, camera: Camera) -> Ranges:
    """Ranges of the corners of markers: those of the board by its pose, the others each by its own.

    Raises:
        ValueError: the side of a marker is unknown.
    """
    places = marker_points(settings)
    alone = places[settings.first_tag]
    depth, distance = np.full(len(sighting.ids), np.nan), np.full(len(sighting.ids), np.nan)
    tags = sighting.ids // 4
    on_board = np.isin(tags, list(places))
    groups = [on_board, *(tags == tag for tag in np.unique(tags[~on_board]))]
    for group in groups:
        tag, corner = tags[group], sighting.ids[group] % 4
        points = np.array([places.get(int(t), alone)[c] for t, c in zip(tag, corner, strict=True)]).reshape(-1, 3)
        depth[group], distance[group] = _of_plane(sighting.points_px[group], points, camera)
    return Ranges(depth, distance)


def of_truth(motion: Motion, mount: Mount, landmarks_m: Floats, t_s: float) -> Ranges:
    """Ranges of landmarks [n, 3] in a simulated world, at a time since its start."""
    turn, position = mount.world_t_camera(motion.at(np.array([t_s])))
    return in_camera((landmarks_m - position[0]) @ turn[0])


def _of_plane(points_px: Floats, points_in_board: Floats, camera: Camera) -> Ranges:
    pose = board_pose(points_px, points_in_board, camera) if len(points_px) >= 4 else None
    if pose is None:
        return _unknown(len(points_px))
    return in_camera(pose.in_camera(points_in_board))


def _unknown(n: int) -> Ranges:
    return Ranges(np.full(n, np.nan), np.full(n, np.nan))


# ----------------------------------------------------------------------------- as samples pass


@dataclass
class PoseTrack:
    """Reference poses in the order of time, and the pose between any two of them.

    Positions are interpolated linearly, attitudes along the shortest turn (Shoemake's slerp, 1985). Poses of which
    something is not finite, or whose time is not after the last one's, are left out.

    Args:
        max_gap_s: between two poses farther apart than this nothing is known.
    """

    max_gap_s: float = 1.0
    _t_ns: list[int] = field(default_factory=list)
    _poses: list[Floats] = field(default_factory=list)

    def add(self, t_ns: int, position_m: Floats, quat_xyzw: Floats) -> None:
        """The pose `world_t_body` at a time: position [3] and unit quaternion [4]."""
        pose = np.concatenate([position_m, quat_xyzw])
        if np.all(np.isfinite(pose)) and np.any(quat_xyzw) and not (self._t_ns and t_ns <= self._t_ns[-1]):
            self._t_ns.append(t_ns)
            self._poses.append(pose)

    def at(self, t_ns: int) -> Floats:
        """`world_t_body` [4, 4] at a time; NaN before the first, after the last and within a gap."""
        right = bisect.bisect_left(self._t_ns, t_ns)
        world_t_body = np.full((4, 4), np.nan)
        if right == len(self._t_ns) or (right == 0 and self._t_ns[0] != t_ns):
            return world_t_body
        left = right if self._t_ns[right] == t_ns else right - 1
        gap_ns = self._t_ns[right] - self._t_ns[left]
        if gap_ns * 1e-9 > self.max_gap_s:
            return world_t_body
        share = (t_ns - self._t_ns[left]) / gap_ns if gap_ns else 0.0
        first, last = self._poses[left], self._poses[right]
        world_t_body[3] = [0, 0, 0, 1]
        world_t_body[:3, 3] = (1 - share) * first[:3] + share * last[:3]
        turns = Rotation.from_quat(np.array([first[3:], last[3:]]))
        world_t_body[:3, :3] = Slerp([0.0, 1.0], turns)(share).as_matrix()
        return world_t_body


class ReferenceRanges:
    """Reference ranges of a replay: it takes the samples as they pass and answers for a frame's time.

    A pose between two others is known once the later one has passed, so that the answers are complete only after the
    samples are through. Where several ways know a landmark's range, the order is: survey, measurement, board.

    Args:
        camera: with `body_t_camera`, unless it is a bearings' camera.
        landmarks: surveyed places by the landmarks' numbers, as `Recording.landmarks`.
        pose_stream: the stream of reference poses; samples of poses or of odometry with poses.
        board: chessboard or markers of known size that the images show; None: images are not looked at.
        max_gap_s: between two poses farther apart than this nothing is known.

    Raises:
        ValueError: the board's size is unknown, or the camera has no calibration that a board needs.
    """

    def __init__(
        self,
        camera: Camera | None,
        *,
        landmarks: Mapping[int, Landmark] | None = None,
        pose_stream: str = "",
        board: BoardSettings | MarkerSettings | None = None,
        max_gap_s: float = 1.0,
    ) -> None:
        self._camera = camera
        self._places = {number: landmark.position_m for number, landmark in (landmarks or {}).items()}
        self._pose_stream = pose_stream
        self._poses = PoseTrack(max_gap_s)
        self._board = None if board is None else _BoardRanges(board, camera)
        self._measured: dict[int, dict[int, tuple[float, float]]] = {}

    def take(self, sample: Sample) -> None:
        """Take one sample, whatever it is; in the order of time."""
        if isinstance(sample, PoseSample | OdometrySample) and sample.stream == self._pose_stream:
            self._poses.add(sample.t_ns, sample.position_m, sample.quat_xyzw)
        elif isinstance(sample, LandmarkSample):
            self._keep(sample.t_ns, sample.ids, measured(sample.range_m, sample.bearing_rad))
        elif self._board is not None:
            ids, ranges = self._board.take(sample)
            self._keep(sample.t_ns, ids, ranges)

    def at(self, t_ns: int, ids: Longs) -> Ranges:
        """Ranges of landmarks [n] at the time of a frame, as far as the samples so far tell."""
        ranges = self._surveyed(t_ns, ids)
        known = self._measured.get(t_ns, {})
        other = np.array([known.get(int(number), (np.nan, np.nan)) for number in ids]).reshape(-1, 2)
        missing = np.isnan(ranges.depth_m)
        return Ranges(np.where(missing, other[:, 0], ranges.depth_m), np.where(missing, other[:, 1], ranges.distance_m))

    def _surveyed(self, t_ns: int, ids: Longs) -> Ranges:
        if self._camera is None or not self._places:
            return _unknown(len(ids))
        unknown = np.full(3, np.nan)
        places = np.array([self._places.get(int(number), unknown) for number in ids]).reshape(-1, 3)
        return surveyed(places, self._poses.at(t_ns), self._camera.body_t_camera)

    def _keep(self, t_ns: int, ids: Longs, ranges: Ranges) -> None:
        rows = zip(ids.tolist(), ranges.depth_m.tolist(), ranges.distance_m.tolist(), strict=True)
        for number, depth, distance in rows:
            if np.isfinite(depth):
                self._measured.setdefault(t_ns, {}).setdefault(number, (depth, distance))


class _BoardRanges:
    """Ranges of all corners of a board in the images that pass, numbered as the source of landmarks numbers them."""

    def __init__(self, settings: BoardSettings | MarkerSettings, camera: Camera | None) -> None:
        if camera is None:
            raise ValueError("reference ranges by a board need a calibrated camera; give its matrix")
        self._camera, self._settings = camera, settings
        self._source: Any
        if isinstance(settings, BoardSettings):
            chessboard_points(settings)
            self._source = Chessboard(camera, settings.model_copy(update={"landmarks": "all"}))
        else:
            marker_points(settings)
            self._source = Markers(camera, settings)
        self._state = self._source.start()

    def take(self, sample: Sample) -> tuple[Longs, Ranges]:
        """The corners of one frame; none where the sample is no frame."""
        self._state, seen = self._source.sight(self._state, sample)
        if seen is None:
            return np.zeros(0, dtype=np.int64), _unknown(0)
        settings = self._settings
        if isinstance(settings, BoardSettings):
            return seen.ids, of_chessboard(seen, settings, self._camera)
        return seen.ids, of_markers(seen, settings, self._camera)
