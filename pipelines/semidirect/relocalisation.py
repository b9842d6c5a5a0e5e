"""A lost camera found again by a keyframe: small blurred images laid over one another, then tracking from there.

The small images are the coarsest level of the pyramids. Their rigid motion (G. D. Evangelidis, E. Z. Psarakis, IEEE
PAMI 30(10), 2008, OpenCV's ECC) carries the keyframe's points to where they should be in the frame; the pose that
fits these best is the start of sparse and feature alignment, which have the last word.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from pipelines.geometry import se3_inverse, se3_product
from pipelines.semidirect import refinement
from pipelines.semidirect.alignment import MIN_PATCHES
from pipelines.semidirect.local_map import LocalMap, centre_of, centres_of, owners, pyramid_in
from pipelines.semidirect.pyramid import LEVELS, Grey, Pyramid, level_image
from pipelines.semidirect.tracking import Known, Tracked, Tracker

Floats = NDArray[np.float64]

SMALL = LEVELS - 1
BLUR_PX = 1.5
ITERATIONS = 50
PRECISION = 1e-4
TRIED = 3
"""Keyframes that are tried for a frame, the nearest first."""


class Relocalised(NamedTuple):
    """What came of a try.

    The `keyframe`'s frame number, -1 where none was alike; the `correlation` of the small images, NaN without; and
    the frame as it was `tracked` from there, None where it did not come so far.
    """

    keyframe: int
    correlation: float
    tracked: Tracked | None


def relocalised(
    tracker: Tracker, world: LocalMap, frame: Pyramid, last_cam_t_world: Floats, least_correlation: float
) -> Relocalised:
    """Find a frame by the keyframes nearest to where the camera was last; the try with most points counts."""
    away = np.sum((centres_of(world.keyframes.cam_t_world) - centre_of(last_cam_t_world)) ** 2, axis=1)
    best = Relocalised(-1, np.nan, None)
    for row in np.argsort(away, kind="stable")[:TRIED]:
        found = _by_keyframe(tracker, world, int(row), frame, least_correlation)
        if _worth(found) > _worth(best):
            best = found
    return best


def _worth(found: Relocalised) -> tuple[int, float]:
    count = -1 if found.tracked is None else found.tracked.points
    return count, found.correlation if found.correlation == found.correlation else -2.0


def _by_keyframe(tracker: Tracker, world: LocalMap, row: int, frame: Pyramid, least_correlation: float) -> Relocalised:
    number = int(world.keyframes.number[row])
    pyramid = pyramid_in(world, row, frame)
    motion, correlation = small_motion(level_image(pyramid, SMALL), level_image(frame, SMALL))
    if not correlation >= least_correlation:
        return Relocalised(number, correlation, None)
    owner, at = owners(world.seen), world.seen.frame == row
    rows, pixels = owner[at], world.seen.pixels[at]
    if len(rows) < MIN_PATCHES:
        return Relocalised(number, correlation, None)
    places = world.points.place[rows]
    expected = moved_pixels(motion, pixels)
    key_t_world = world.keyframes.cam_t_world[row]
    level = np.full(len(rows), SMALL)
    posed = refinement.refine_pose(
        tracker.optics, places, expected, level, key_t_world, refinement.PoseOptions(inlier_px=np.inf)
    )
    key = Known(number, 0, pyramid, key_t_world, world.points.number[rows], pixels)
    prior = se3_product(posed.cam_t_world, se3_inverse(key_t_world))
    return Relocalised(number, correlation, tracker.track(world, key, frame, prior))


def small_motion(reference: Grey, current: Grey) -> tuple[Floats, float]:
    """The rigid motion [2, 3] of pixels of one small image to the other, and the correlation then; NaN for none."""
    one, two = (cv2.GaussianBlur(image.astype(np.float32), (0, 0), BLUR_PX) for image in (reference, current))
    shift, _ = cv2.phaseCorrelate(one, two, cv2.createHanningWindow(one.shape[::-1], cv2.CV_32F))
    motion = np.array([[1, 0, shift[0]], [0, 1, shift[1]]], np.float32)
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, ITERATIONS, PRECISION)
    try:
        correlation, motion = cv2.findTransformECC(one, two, motion, cv2.MOTION_EUCLIDEAN, stop)
    except cv2.error:  # how OpenCV says that the iteration did not converge
        return np.full((2, 3), np.nan), np.nan
    return np.asarray(motion, np.float64), float(correlation)


def moved_pixels(motion: Floats, pixels: Floats) -> Floats:
    """Pixels [n, 2] of level 0 through a motion [2, 3] of the small images."""
    size = float(1 << SMALL)
    small = (pixels + 0.5) / size - 0.5
    return np.asarray((small @ motion[:, :2].T + motion[:, 2] + 0.5) * size - 0.5)
