"""Corners of the scene: found by Shi and Tomasi's measure, tracked by pyramidal Lucas-Kanade.

A corner is where the smaller eigenvalue of the gradients' second moments has a maximum (Shi, Tomasi, "Good features
to track", CVPR 1994). A track goes on while Lucas-Kanade finds it again, forth and, to within a threshold, back to
where it was; a corner that another object comes before, or that leaves the image, fails that. Tracks are from frame to
frame, so that their errors add up slowly: σ grows with the age of a track, not with the size of the motion.

OpenCV's corners and tracks were the same, bit for bit, for any number of its threads; nothing is set.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pipelines.ranging.landmarks.frames import NOTHING, Grey, grey_of, ideal_px, is_frame, sighting
from pipelines.ranging.landmarks.settings import CornerSettings
from pipelines.ranging.sightings import Sighting
from readers.streams import Camera, Sample

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Longs = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class CornerState:
    """The tracks after a frame, n of them: all that the next frame needs.

    Attributes:
        grey: the frame [height, width]; None if it was no image.
        ids: number of each track; numbers are never used again [n].
        points_px: places in the image as it is, with its distortion [n, 2].
        age: frames since each track began [n].
        error_px: forward-backward distance in this frame [n].
        next_id: the next track's number.
    """

    grey: Grey | None = field(default=None, repr=False)
    ids: Longs = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    points_px: Singles = field(default_factory=lambda: np.zeros((0, 2), dtype=np.float32))
    age: Longs = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    error_px: Floats = field(default_factory=lambda: np.zeros(0))
    next_id: int = 0


@dataclass(frozen=True, slots=True)
class TrackedCorners:
    """Tracked corners of the images of one camera.

    A frame that cannot be decoded, or whose size is not the camera's, ends all tracks.

    Raises:
        ValueError: the camera has no calibration.
    """

    camera: Camera
    settings: CornerSettings = CornerSettings()

    def __post_init__(self) -> None:
        ideal_px(self.camera, np.zeros((0, 2)))

    def start(self) -> CornerState:
        """The state before the first frame."""
        return CornerState()

    def sight(self, state: CornerState, sample: Sample, /) -> tuple[CornerState, Sighting | None]:
        """The tracks that go on in this frame, and those that begin in it."""
        if not is_frame(sample):
            return state, None
        grey = grey_of(sample, self.camera)
        if grey is None:
            return CornerState(next_id=state.next_id), NOTHING
        after = self._replenished(self._followed(state, grey))
        s = self.settings
        sigma = np.full(len(after.ids), s.sigma_px)
        if s.sigma_from == "residual":
            sigma = np.hypot(sigma, after.error_px)
        return after, sighting(after.ids, ideal_px(self.camera, after.points_px.astype(np.float64)), sigma)

    def _followed(self, state: CornerState, grey: Grey) -> CornerState:
        """The tracks of the frame before that are found again in this one."""
        before = state.grey
        if before is None or before.shape != grey.shape or not len(state.ids):
            return CornerState(grey, next_id=state.next_id)
        s = self.settings
        size = (s.window_px, s.window_px)
        first, second = (
            cv2.buildOpticalFlowPyramid(image, size, s.levels, withDerivatives=True)[1]
            for image in (evened(before, grey, s.exposure_jump), grey)
        )
        points, found, residual = self._lucas_kanade(first, second, state.points_px)
        back, found_back, _ = self._lucas_kanade(second, first, points)
        error = np.linalg.norm(back.astype(np.float64) - state.points_px, axis=1)
        good = found & found_back & (error <= s.forward_backward_px) & (residual <= s.max_residual_grey)
        good &= inside(points, grey.shape, s.border_px)
        good[good] = _apart(points[good], 0.5 * s.min_distance_px)
        return CornerState(grey, state.ids[good], points[good], state.age[good] + 1, error[good], state.next_id)

    def _lucas_kanade(
        self, first: Sequence[Any], second: Sequence[Any], points: Singles
    ) -> tuple[Singles, NDArray[np.bool_], Floats]:
        """Where points [n, 2] of one pyramid are in another, whether they were found, and mean grey differences [n]."""
        s = self.settings
        ends = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, s.max_iterations, s.tolerance_px)
        moved, status, residual = cv2.calcOpticalFlowPyrLK(
            first,
            second,
            points.reshape(-1, 1, 2),
            None,
            winSize=(s.window_px, s.window_px),
            maxLevel=s.levels,
            criteria=ends,
            minEigThreshold=s.min_eigenvalue,
        )
        found = status.reshape(-1).astype(bool)
        moved = np.where(found[:, None], moved.reshape(-1, 2), np.float32(-1))
        return moved, found, np.where(found, residual.reshape(-1).astype(np.float64), np.inf)

    def _replenished(self, state: CornerState) -> CornerState:
        """With new corners, where there are too few tracks."""
        s = self.settings
        if state.grey is None or len(state.ids) >= s.replenish_below * s.max_corners:
            return state
        new = self._corners(state.grey, state.points_px)
        n = len(new)
        return CornerState(
            state.grey,
            np.concatenate([state.ids, state.next_id + np.arange(n)]),
            np.concatenate([state.points_px, new]),
            np.concatenate([state.age, np.zeros(n, dtype=np.int64)]),
            np.concatenate([state.error_px, np.zeros(n)]),
            state.next_id + n,
        )

    def _corners(self, grey: Grey, taken: Singles) -> Singles:
        """New corners [n, 2], the best of every cell of the grid, away from the border and from points [m, 2]."""
        s = self.settings
        free = np.zeros(grey.shape, dtype=np.uint8)
        edge = int(np.ceil(s.border_px))
        free[edge : grey.shape[0] - edge, edge : grey.shape[1] - edge] = 255
        for u, v in taken:
            cv2.circle(free, (round(float(u)), round(float(v))), round(s.min_distance_px), 0, -1)
        textured = cv2.cornerMinEigenVal(grey, s.block_px) >= least_eigenvalue(s.min_texture)
        free[~textured] = 0
        best = cv2.goodFeaturesToTrack(grey, 0, s.quality, s.min_distance_px, mask=free, blockSize=s.block_px)
        if best is None:
            return np.zeros((0, 2), dtype=np.float32)
        return _spread(best.reshape(-1, 2), taken, grey.shape, s)


def least_eigenvalue(texture: float) -> float:
    """What OpenCV's `cornerMinEigenVal` gives of 8-bit images for an rms gradient in grey levels per px.

    λ = (2 g / 255)²: the mean square of central differences over two px, of grey levels from 0 to 1.
    """
    return (2.0 * texture / 255.0) ** 2


def evened(before: Grey, now: Grey, jump: float) -> Grey:
    """The frame before with the mean and contrast of this one, if either differs by more than a share `jump`."""
    (mean, deviation), (wanted, contrast) = ((float(x.mean()), float(x.std())) for x in (before, now))
    if deviation == 0 or contrast == 0:
        return before
    if max(abs(wanted / max(mean, 1.0) - 1), abs(contrast / deviation - 1)) <= jump:
        return before
    levels = (np.arange(256) - mean) * (contrast / deviation) + wanted
    return np.asarray(cv2.LUT(before, np.clip(np.rint(levels), 0, 255).astype(np.uint8)))


def inside(points: Singles, shape: tuple[int, ...], border_px: float) -> NDArray[np.bool_]:
    """Which points [n, 2] lie at least `border_px` from the edge of an image."""
    limits = np.array([shape[1] - 1, shape[0] - 1]) - border_px
    return np.asarray(np.all((points >= border_px) & (points <= limits), axis=1))


def _apart(points: Singles, distance_px: float) -> NDArray[np.bool_]:
    """Which points [n, 2] stay when of two that are too close to each other the later one goes."""
    close = np.linalg.norm(points[:, None].astype(np.float64) - points[None], axis=2) < distance_px
    stay = np.ones(len(points), dtype=bool)
    for number in range(1, len(points)):
        stay[number] = not np.any(close[number, :number] & stay[:number])
    return stay


def _spread(best: Singles, taken: Singles, shape: tuple[int, ...], s: CornerSettings) -> Singles:
    """As many of the corners [n, 2], best first, as there is room for, in the emptiest cells of the grid first.

    Round by round every cell that has fewest tracks takes its next best corner, so that texture in one place does
    not take all tracks.
    """
    size = np.array([shape[1] / s.grid_columns, shape[0] / s.grid_rows])

    def cells(points: Singles) -> Longs:
        columns, rows = (points // size).astype(np.int64).T
        return np.asarray(rows * s.grid_columns + columns)

    occupancy = np.bincount(cells(taken), minlength=s.grid_rows * s.grid_columns)
    cell = cells(best)
    rank = np.zeros(len(best), dtype=np.int64)  # how full its cell is when a corner's turn comes
    for number, where in enumerate(cell):
        rank[number] = occupancy[where]
        occupancy[where] += 1
    order = np.lexsort((np.arange(len(best)), rank))
    return best[order[: max(s.max_corners - len(taken), 0)]]
