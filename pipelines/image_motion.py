"""Motion of a whole image from one frame to the next, quickly: enough to compare clocks, not to navigate by.

Corners of the first image are followed into the second one (pyramidal Lucas-Kanade) and a homography is fitted to
them without the outliers: so a plane moves, however it is seen, and everything in a turn of the camera. Its turn at the
image centre is that about the optical axis, a downward camera's heading; its shift there is, over the focal length, the
turn of a forward camera, and the way of a downward one.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Grey = NDArray[np.uint8] | NDArray[np.uint16]

WIDEST_PX = 320
CORNERS = 200
LEAST_CORNERS = 12
LEAST_SHARE = 0.4
_TERM = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.01)


class ImageMotion(NamedTuple):
    """Turn, rad, clockwise as the image is seen, and shift at the image centre (u, v), px; NaN where unknown."""

    turn_rad: float
    shift_px: tuple[float, float]


UNKNOWN = ImageMotion(math.nan, (math.nan, math.nan))


def small(grey: Grey) -> NDArray[np.uint8]:
    """An image as it is compared: 8 bits, at most `WIDEST_PX` wide."""
    image = grey if grey.dtype == np.uint8 else cv2.normalize(grey, None, 0, 255, cv2.NORM_MINMAX, cv2.CV_8U)
    factor = WIDEST_PX / image.shape[1]
    if factor < 1.0:
        image = cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    return np.ascontiguousarray(image, dtype=np.uint8)


def image_motion(before: NDArray[np.uint8], after: NDArray[np.uint8], pixel: float = 1.0) -> ImageMotion:
    """How the picture of one image lies in the next.

    Args:
        before: the first image, as `small` makes it [h, w].
        after: the second one, of the same size [h, w].
        pixel: pixels of the camera to one of these.
    """
    if before.shape != after.shape:
        return UNKNOWN
    corners = cv2.goodFeaturesToTrack(before, CORNERS, 0.01, 7)
    if corners is None or len(corners) < LEAST_CORNERS:
        return UNKNOWN
    moved, status, _ = cv2.calcOpticalFlowPyrLK(
        before, after, corners, None, winSize=(15, 15), maxLevel=4, criteria=_TERM
    )  # fmt: skip
    good = status.ravel() == 1
    if good.sum() < LEAST_CORNERS:
        return UNKNOWN
    first, second = corners[good, 0].astype(np.float64), moved[good, 0].astype(np.float64)
    mapping = _mapping(first, second)
    if mapping is None:
        return UNKNOWN
    centre = 0.5 * np.array([before.shape[1] - 1, before.shape[0] - 1])
    return _at(mapping, centre, pixel)


def _mapping(first: Floats, second: Floats) -> Floats | None:
    """The homography [3, 3] that takes enough points [n, 2] to the others, None if there is none."""
    mapping, inliers = cv2.findHomography(first, second, method=cv2.RANSAC, ransacReprojThreshold=1.0)
    if mapping is None or inliers.sum() < max(LEAST_CORNERS, LEAST_SHARE * len(first)):
        return None
    return np.asarray(mapping)


def _at(mapping: Floats, point: Floats, pixel: float) -> ImageMotion:
    """Turn and shift of a homography p' = (A p + t) / w [3, 3] at a point [2]: J = dp'/dp = (A - p' hᵀ) / w there."""
    *mapped, w = mapping @ np.append(point, 1.0)
    moved = np.array(mapped) / w
    slopes = (mapping[:2, :2] - np.outer(moved, mapping[2, :2])) / w
    turn = math.atan2(slopes[1, 0] - slopes[0, 1], slopes[0, 0] + slopes[1, 1])
    shift = (moved - point) * pixel
    return ImageMotion(turn, (float(shift[0]), float(shift[1])))


class Motions:
    """The motions of a stream of images, frame by frame; 40 bytes a frame."""

    def __init__(self) -> None:
        self._before: NDArray[np.uint8] | None = None
        self._rows: list[tuple[int, float, float, float]] = []

    def add(self, t_ns: int, grey: Grey) -> None:
        """Take the next image; one whose time does not rise is left out."""
        if self._rows and t_ns <= self._rows[-1][0]:
            return
        image = small(grey)
        motion = ImageMotion(0.0, (0.0, 0.0))
        if self._before is not None:
            motion = image_motion(self._before, image, grey.shape[1] / image.shape[1])
        self._before = image
        self._rows.append((t_ns, motion.turn_rad, *motion.shift_px))

    @property
    def t_ns(self) -> NDArray[np.int64]:
        """Times of the frames [n]."""
        return np.array([row[0] for row in self._rows], np.int64)

    @property
    def known_share(self) -> float:
        """The share of the motions that could be told."""
        values = self.values
        return float(np.isfinite(values[1:]).all(axis=1).mean()) if len(values) > 1 else 0.0

    @property
    def values(self) -> Floats:
        """Turn, rad, and shift u and v, px, since the frame before [n, 3]; zero of the first, NaN where unknown."""
        return np.array([row[1:] for row in self._rows], np.float64).reshape(-1, 3)
