"""Corners of the scene: found by Shi and Tomasi's measure, tracked by pyramidal Lucas-Kanade.

A corner is where the smaller eigenvalue of the gradients' second moments has a maximum (Shi, Tomasi, "Good features
to track", CVPR 1994). A track goes on while Lucas-Kanade finds it again, forth and, to within a threshold, back to
where it was; a corner that another object comes before, or that leaves the image, fails that. Tracks are from frame to
frame, so that their errors add up with age; a corner begins where a window that grows does not drift (`centred`),
which makes them several times smaller on the way towards a wall.

OpenCV's corners and tracks were the same, bit for bit, for any number of its threads; nothing is set.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pipelines.ranging.landmarks.frames import NOTHING, Grey, grey_of, ideal_px, is_frame, sighting
from pipelines.ranging.landmarks.settings import CornerSettings
from pipelines.ranging.sightings import Sighting
from readers.streams import Camera, Sample

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Longs = NDArray[np.int64]

CENTRINGS = 5
"""Steps to a corner's centre; the last ones change nothing."""
SPARE = 4
"""Corners that are centred for each one that is needed: some lie on edges or come together."""


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
        evened_before = evened(before, grey, s.exposure_jump)
        points, found, residual = self._lucas_kanade(evened_before, grey, state.points_px)
        back, found_back, _ = self._lucas_kanade(grey, evened_before, points)
        error = np.linalg.norm(back.astype(np.float64) - state.points_px, axis=1)
        good = found & found_back & (error <= s.forward_backward_px) & (residual <= s.max_residual_grey)
        good &= inside(points, grey.shape, s.border_px)
        good[good] = _apart(points[good], 0.5 * s.min_distance_px)
        return CornerState(grey, state.ids[good], points[good], state.age[good] + 1, error[good], state.next_id)

    def _lucas_kanade(self, first: Grey, second: Grey, points: Singles) -> tuple[Singles, NDArray[np.bool_], Floats]:
        """Where points [n, 2] of one image are in another, whether they were found, and mean grey differences [n]."""
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
        if state.grey is None or len(state.ids) >= max(1.0, s.replenish_below * s.max_corners):
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
        best = cv2.goodFeaturesToTrack(grey, 0, s.quality, s.min_distance_px, mask=free, blockSize=s.window_px)
        if best is None:
            return np.zeros((0, 2), dtype=np.float32)
        room = max(s.max_corners - len(taken), 0)
        chosen = _spread(best.reshape(-1, 2), taken, grey.shape, s)[: SPARE * room]
        points, texture = centred(grey, chosen, s.window_px)
        near = np.linalg.norm(points - chosen, axis=1) <= 0.5 * s.window_px
        points = points[near & (texture >= s.min_texture) & inside(points, grey.shape, s.border_px)]
        kept: Singles = points[_apart(points, 0.5 * s.min_distance_px)][:room]
        return kept


def centred(grey: Grey, points: Singles, window_px: int) -> tuple[Singles, Floats]:
    """Points [n, 2] moved to where a window about them can grow without drifting, and the texture there [n].

    Lucas-Kanade shifts a window until Σ g gᵀ (motion - shift) = 0, g the gradients in it. As the scene comes nearer by
    a share s, a place q moves by s (q - c) from the point c, so that the shift is 0 where Σ g gᵀ (q - c) = 0: then c
    stays the same point of the scene. It is the point to which `cornerSubPix` (Förstner, Gülch, 1987) leads, with the
    equal weights of the tracker's window.

    The texture is the rms gradient along the direction in which it is weakest, grey levels per px.
    """
    gradients = [cv2.Scharr(grey, cv2.CV_32F, dx, dy, scale=1 / 32) for dx, dy in ((1, 0), (0, 1))]
    half = window_px // 2
    v, u = np.mgrid[-half : half + 1, -half : half + 1]
    last = np.array([grey.shape[1] - 1, grey.shape[0] - 1]) - half
    moved = points.astype(np.float64)
    for _ in range(CENTRINGS):
        at = np.rint(moved).astype(np.int64).clip(half, last)
        window = (at[:, 1, None, None] + v, at[:, 0, None, None] + u)
        gu, gv = (gradient[window].astype(np.float64) for gradient in gradients)
        uu, uv, vv, along, down = (
            product.sum(axis=(1, 2))
            for product in (gu * gu, gu * gv, gv * gv, gu * (gu * u + gv * v), gv * (gu * u + gv * v))
        )
        det = np.maximum(uu * vv - uv * uv, 1e-12)
        moved = at + np.column_stack([vv * along - uv * down, uu * down - uv * along]) / det[:, None]
    weakest = 0.5 * (uu + vv) - np.hypot(0.5 * (uu - vv), uv)
    return moved.astype(np.float32), np.sqrt(weakest.clip(min=0) / window_px**2)


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
    stay = np.ones(len(points), dtype=bool)
    pairs = cKDTree(points).query_pairs(distance_px) if len(points) else ()
    for first, second in sorted(pairs):
        stay[second] &= not stay[first]
    return stay


def _spread(best: Singles, taken: Singles, shape: tuple[int, ...], s: CornerSettings) -> Singles:
    """The corners [n, 2], which come best first, in the order of their turn: in the emptiest cells of the grid first.

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
    return best[np.argsort(rank, kind="stable")]
