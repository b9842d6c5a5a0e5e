"""Landmarks that are printed: the corners of a chessboard, of ArUco markers and of AprilTags; and the board's pose.

Board axes: x along the rows and y along the columns, z into the board, as a camera sees it that looks at its front;
the origin is corner 0. Numbers run row by row.

Range by perspective-n-point: of a plane two poses explain the corners nearly equally well (Schweighofer, Pinz, 2006);
both are found in closed form (Collins, Bartoli, "Infinitesimal plane-based pose estimation", 2014), refined, and the
one that explains them better is taken.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from pipelines.ranging.landmarks.frames import NOTHING, Grey, grey_of, ideal_px, is_frame, seen_px, sighting
from pipelines.ranging.landmarks.settings import BoardSettings, MarkerSettings
from pipelines.ranging.sightings import Sighting
from readers.streams import Camera, Sample

Floats = NDArray[np.float64]

REFINEMENT = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-3)
SIDE_PASSES = 3
"""Times that the sides of a marker are looked for, each about where the last time found them."""
SAME_POSE = 5e-3
"""Refined poses whose elements (rotations, metres) differ by less are one."""


# ------------------------------------------------------------------------------- chessboard


@dataclass(frozen=True, slots=True)
class BoardState:
    """How a chessboard was numbered when it was last seen.

    Attributes:
        light: 1: the corner square at corner 0 is light, -1: dark; 0: the board was not seen yet.
        row: direction of its rows in the image, (u, v).
    """

    light: int = 0
    row: tuple[float, float] = (1.0, 0.0)


@dataclass(frozen=True, slots=True)
class Chessboard:
    """The corners of a chessboard, in the numbering in which it was first seen.

    Which end of the board is which is told by the colours of its squares; where they do not tell it (as many
    columns as rows, or both even or both odd), by the direction that the rows had in the image when it was last seen.
    A frame that cannot be decoded, has another size than the camera or shows no whole board has no landmarks.

    Raises:
        ValueError: the camera has no calibration.
    """

    camera: Camera
    settings: BoardSettings = BoardSettings()

    def __post_init__(self) -> None:
        ideal_px(self.camera, np.zeros((0, 2)))

    def start(self) -> BoardState:
        """The state before the first frame."""
        return BoardState()

    def sight(self, state: BoardState, sample: Sample, /) -> tuple[BoardState, Sighting | None]:
        """The corners of one frame that are landmarks by the settings."""
        if not is_frame(sample):
            return state, None
        grey = grey_of(sample, self.camera)
        grid = None if grey is None else chessboard_grid(grey, self.settings)
        found = None if grey is None or grid is None else _numbered(grid, grey, state, self.settings)
        if found is None:
            return state, NOTHING
        grid, after = found
        numbers = np.array(self.settings.numbers, dtype=np.int64)
        points = ideal_px(self.camera, grid.reshape(-1, 2)[numbers])
        return after, sighting(numbers, points, np.full(len(numbers), self.settings.sigma_px))


def chessboard_grid(grey: Grey, settings: BoardSettings) -> Floats | None:
    """Inner corners [rows, columns, 2] of a chessboard in an image, from whichever end; None if it is not found.

    `findChessboardCorners` takes some 5 ms and found every real board we have; `findChessboardCornersSB` takes ten
    times as long and finds boards whose squares are only 5 px wide. The places of either are refined to the saddle
    points of the image by `cornerSubPix`, which is the more exact in both.
    """
    shape = (settings.columns, settings.rows)
    good, corners = False, None
    if settings.detector != "sectors":
        good, corners = cv2.findChessboardCorners(grey, shape, flags=0)
    if not good and settings.detector != "lines":
        good, corners = cv2.findChessboardCornersSB(grey, shape)
    if not good:
        return None
    grid = np.asarray(corners, dtype=np.float32).reshape(settings.rows, settings.columns, 2)
    nearest = min(float(np.linalg.norm(np.diff(grid, axis=axis), axis=2).min()) for axis in (0, 1))
    half = int(np.clip(0.4 * nearest, 2, 6))  # the window must hold no other corner, nor the board's edge
    refined = cv2.cornerSubPix(grey, grid.reshape(-1, 1, 2).copy(), (half, half), (-1, -1), REFINEMENT)
    return np.asarray(refined, dtype=np.float64).reshape(grid.shape)


def _numbered(grid: Floats, grey: Grey, state: BoardState, settings: BoardSettings) -> tuple[Floats, BoardState] | None:
    """The corners [rows, columns, 2] in the board's own numbering, and the state with it; None for another board."""
    wanted = {"light": 1, "dark": -1}.get(settings.first, state.light)
    choices = [turned for turned in _turned(grid) if wanted in (0, _light(turned, grey))]

    def upright(turned: Floats) -> float:
        row, column = _directions(turned)
        first_time = state.light == 0
        return float(row @ np.array(state.row) + first_time * column[1])

    if not choices:  # no end has the colour that it had
        return None
    chosen = max(choices, key=upright)
    row, _ = _directions(chosen)
    return chosen, BoardState(_light(chosen, grey), (float(row[0]), float(row[1])))


def _turned(grid: Floats) -> Iterator[Floats]:
    """The numberings of a grid that a printed board can be seen in: turned about, not mirrored, of the same shape."""
    for quarter in range(4):
        for turned in (np.rot90(grid, quarter), np.rot90(grid, quarter)[:, ::-1]):
            (row_u, row_v), (column_u, column_v) = _directions(turned)
            if turned.shape == grid.shape and row_u * column_v - row_v * column_u > 0:
                yield turned


def _directions(grid: Floats) -> tuple[Floats, Floats]:
    """Unit vectors (u, v) along the rows and the columns of a grid [rows, columns, 2]."""
    row = (grid[:, -1] - grid[:, 0]).sum(axis=0)
    column = (grid[-1] - grid[0]).sum(axis=0)
    return row / np.linalg.norm(row), column / np.linalg.norm(column)


def _light(grid: Floats, grey: Grey) -> int:
    """1 if the corner square outside corner 0 is light, else -1; that inside it has the same colour."""
    middles = (grid[1:, 1:] + grid[1:, :-1] + grid[:-1, 1:] + grid[:-1, :-1]) / 4
    u, v = np.rint(middles).astype(np.int64).reshape(-1, 2).T
    height, width = grey.shape
    levels = grey[v.clip(0, height - 1), u.clip(0, width - 1)].reshape(middles.shape[:2]).astype(np.float64)
    even = np.add.outer(np.arange(len(levels)), np.arange(levels.shape[1])) % 2 == 0
    return 1 if levels[even].mean() > levels[~even].mean() else -1


def chessboard_points(settings: BoardSettings) -> Floats:
    """Inner corners [rows · columns, 3] in board axes, m.

    Raises:
        ValueError: the side of a square is unknown.
    """
    if settings.square_m is None:
        raise ValueError("the chessboard's square_m is unknown: give the side of a square in m")
    rows, columns = np.mgrid[: settings.rows, : settings.columns]
    flat = np.column_stack([columns.ravel(), rows.ravel(), np.zeros(rows.size)])
    return np.asarray(flat * settings.square_m)


# ---------------------------------------------------------------------------------- markers


@dataclass(frozen=True, slots=True)
class Markers:
    """The corners of ArUco markers or AprilTags: corner k of tag t, clockwise from its upper left, is 4 t + k.

    Raises:
        ValueError: the camera has no calibration, or the dictionary does not hold the tags of the settings.
    """

    camera: Camera
    settings: MarkerSettings = MarkerSettings()

    def __post_init__(self) -> None:
        ideal_px(self.camera, np.zeros((0, 2)))
        tags = board_tags(self.settings) + (self.settings.tags if isinstance(self.settings.tags, tuple) else ())
        size = len(_dictionary(self.settings.dictionary).bytesList)
        if max(tags) >= size:
            raise ValueError(f"{self.settings.dictionary} holds the tags 0 to {size - 1}, not {max(tags)}")

    def start(self) -> None:
        """There is nothing to remember."""

    def sight(self, state: None, sample: Sample, /) -> tuple[None, Sighting | None]:
        """The corners of all markers in one frame; a tag that is seen twice is left out, for which one is not known."""
        if not is_frame(sample):
            return None, None
        grey = grey_of(sample, self.camera)
        if grey is None:
            return None, NOTHING
        quads, tags, _ = _detector(self.settings.dictionary).detectMarkers(grey)
        if tags is None or not len(tags):
            return None, NOTHING
        found, index, count = np.unique(np.asarray(tags).reshape(-1), return_index=True, return_counts=True)
        good = count == 1
        if isinstance(self.settings.tags, tuple):
            good &= np.isin(found, self.settings.tags)
        cells = _dictionary(self.settings.dictionary).markerSize + 2
        corners = [np.asarray(quads[k], dtype=np.float64).reshape(4, 2) for k in index[good]]
        points = np.concatenate([np.zeros((0, 2)), *(_by_sides(grey, quad, cells, self.camera) for quad in corners)])
        ids = np.add.outer(4 * found[good].astype(np.int64), np.arange(4)).ravel()
        return None, sighting(ids, points, np.full(len(ids), self.settings.sigma_px))


def board_tags(settings: MarkerSettings) -> tuple[int, ...]:
    """The tags of the board, row by row."""
    return tuple(range(settings.first_tag, settings.first_tag + settings.columns * settings.rows))


def marker_points(settings: MarkerSettings) -> dict[int, Floats]:
    """Corners [4, 3] in board axes of every tag of the board, m, clockwise from the upper left.

    Raises:
        ValueError: the side of a marker is unknown.
    """
    if settings.marker_m is None:
        raise ValueError("the markers' marker_m is unknown: give the side of their black square in m")
    side, pitch = settings.marker_m, settings.marker_m + settings.gap_m
    square = np.array([[0, 0, 0], [side, 0, 0], [side, side, 0], [0, side, 0]])
    return {
        tag: square + pitch * np.array([number % settings.columns, number // settings.columns, 0])
        for number, tag in enumerate(board_tags(settings))
    }


def _dictionary(name: str) -> Any:
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{name.upper()}"))


@functools.lru_cache(maxsize=4)
def _detector(dictionary: str) -> Any:
    return cv2.aruco.ArucoDetector(_dictionary(dictionary), cv2.aruco.DetectorParameters())


def _by_sides(grey: Grey, corners: Floats, cells: int, camera: Camera) -> Floats:
    """Corners [4, 2] of a marker, freed of distortion, as the crossings of its four sides; NaN if it is too small.

    OpenCV's own refinements are off by 0.2 to 1 px, because blur rounds a corner; the sides it leaves in place. Each
    is a straight line, once freed of distortion, through the steepest places of the grey levels across it.

    Args:
        grey: the image.
        corners: about where they are, clockwise [4, 2].
        cells: of the marker along a side, its dark border included, which is one cell wide.
        camera: whose image it is.
    """
    for _ in range(SIDE_PASSES):
        lines = np.array([_side(grey, corners[k], corners[(k + 1) % 4], cells, camera) for k in range(4)])
        crossings = np.cross(np.roll(lines, 1, axis=0), lines)
        points = crossings[:, :2] / crossings[:, 2:]
        corners = seen_px(camera, points)
    return np.asarray(points)


def _side(grey: Grey, start: Floats, stop: Floats, cells: int, camera: Camera) -> Floats:
    """The line (a, b, c), a u + b v + c = 0, along a marker's side, freed of distortion; NaN where there is none."""
    length = float(np.linalg.norm(stop - start))
    reach = min(0.7 * length / cells, 5.0)
    if not (reach >= 1.0 and np.isfinite(length)):
        return np.full(3, np.nan)
    along = (stop - start) / length
    outward = np.array([along[1], -along[0]])
    places = start + np.linspace(0.1, 0.9, int(np.clip(length, 12, 60)))[:, None] * (stop - start)
    offsets = np.linspace(-reach, reach, 2 * int(np.ceil(2 * reach)) + 1)
    samples = places[:, None] + offsets[:, None] * outward
    levels = map_coordinates(grey.astype(np.float32), samples[..., ::-1].transpose(2, 0, 1), order=1, mode="nearest")
    slopes = np.diff(levels, axis=1).clip(min=0) ** 2  # light outside; the steepest counts most
    weight = slopes.sum(axis=1)
    if not np.count_nonzero(weight) >= len(places) / 2:
        return np.full(3, np.nan)
    shift = slopes @ (0.5 * (offsets[1:] + offsets[:-1])) / np.maximum(weight, 1e-9)
    points = ideal_px(camera, (places + shift[:, None] * outward)[weight > 0])
    points = points[np.isfinite(points[:, 0])]
    return _line(points) if len(points) >= 4 else np.full(3, np.nan)


def _line(points: Floats) -> Floats:
    """The line (a, b, c) through points [n, 2], by least squares of their distances, those far from it left out."""
    for _ in range(2):
        middle = points.mean(axis=0)
        normal = np.linalg.svd(points - middle)[2][1]
        distance = np.abs((points - middle) @ normal)
        points = points[distance <= max(3 * float(np.median(distance)), 1e-6)]
    return np.array([*normal, -normal @ middle])


# ------------------------------------------------------------------------------------- pose


@dataclass(frozen=True, slots=True)
class BoardPose:
    """Where a board is.

    Attributes:
        camera_t_board: maps points of the board into the camera [4, 4].
        rms_px: root mean square distance of the corners from where this pose shows them.
        other_rms_px: the same for the other pose that a plane allows; near `rms_px` the choice is uncertain;
            NaN if the corners allow but one.
    """

    camera_t_board: Floats
    rms_px: float
    other_rms_px: float

    def in_camera(self, points_in_board: Floats) -> Floats:
        """Points [n, 3] of the board in camera axes; the last column is the depth, m."""
        return np.asarray(points_in_board @ self.camera_t_board[:3, :3].T + self.camera_t_board[:3, 3])


def board_pose(points_px: Floats, points_in_board: Floats, camera: Camera) -> BoardPose | None:
    """The pose of a plane board by its image points; None where no pose explains them.

    Args:
        points_px: image points [n, 2] as `Sighting` has them, n at least 4.
        points_in_board: the same points in board axes [n, 3], m, all with z = 0.
        camera: whose image it is.

    Raises:
        ValueError: too few points, or points that are not in one plane.
    """
    if len(points_px) != len(points_in_board) or len(points_px) < 4 or np.any(points_in_board[:, 2]):
        raise ValueError(
            f"{len(points_px)} image points of {len(points_in_board)} points of a board: the pose needs at least 4, "
            "as many of either, with z = 0 on the board"
        )
    matrix = np.array(camera.matrix)
    matrix[0, 1], matrix[1, 1] = 0.0, matrix[0, 0]  # that of `ideal_px`
    centre = points_in_board.mean(axis=0)  # IPPE wants the plane's origin among its points
    plane = np.ascontiguousarray(points_in_board - centre)
    pixels = np.ascontiguousarray(points_px, dtype=np.float64)
    try:
        _, turns, shifts, _ = cv2.solvePnPGeneric(plane, pixels, matrix, None, flags=cv2.SOLVEPNP_IPPE)
    except cv2.error:  # points on one line
        return None
    found = sorted(
        (_refined(plane, pixels, matrix, turn, shift) for turn, shift in zip(turns, shifts, strict=True)),
        key=lambda pose: pose[0],
    )
    found = [pose for pose in found if np.isfinite(pose[0]) and pose[1][2, 3] > 0]
    if not found:
        return None
    rms, camera_t_plane = found[0]
    others = [other for other, pose in found[1:] if not np.allclose(pose, camera_t_plane, rtol=0, atol=SAME_POSE)]
    camera_t_board = camera_t_plane.copy()
    camera_t_board[:3, 3] -= camera_t_plane[:3, :3] @ centre
    return BoardPose(camera_t_board, rms, others[0] if others else np.nan)


def _refined(plane: Floats, pixels: Floats, matrix: Floats, turn: Floats, shift: Floats) -> tuple[float, Floats]:
    """One of the poses after Levenberg-Marquardt: rms in px, camera_t_plane [4, 4]."""
    turn, shift = cv2.solvePnPRefineLM(plane, pixels, matrix, None, turn.copy(), shift.copy())
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(turn)[0], shift.ravel()
    in_cam = plane @ pose[:3, :3].T + pose[:3, 3]
    shown = in_cam @ matrix.T
    missed = pixels - shown[:, :2] / shown[:, 2:]
    return float(np.sqrt((missed**2).sum(axis=1).mean())), pose
