"""The motion between any two frames of a mission, by the odometry's own matcher: for revisits of a place."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from pipelines.correlation import equations as eq
from pipelines.correlation.equations import Motion
from pipelines.correlation.matching import NO_COVARIANCE, Candidate, Matcher, Template
from pipelines.correlation.odometry import convincing, eight_bit
from pipelines.correlation.settings import CorrelationSettings
from pipelines.planar import wrap_angle

Floats = NDArray[np.float64]
Grey = NDArray[np.uint8]

SPREAD_RAD = 0.14
"""The global search tries rotations this far to both sides of the expected one."""


class ImageMotions:
    """Measures the motion of the body from one frame to another from their images.

    The expected motion is tried first; where it finds nothing that half of the fragments agree on, the global search
    proposes others, at rotations around the expected one. Axes are those of `step.py`: the result is x forward, y
    left, heading counter-clockwise, of the camera's centre, in the body's axes at the first frame.

    Args:
        settings: those of the odometry. Its search may look elsewhere than at the last shift, so that the prediction
            is always ``constant-velocity`` here.
        grey_of: the image of a pose by its number, uint8 or uint16 [height, width].
        metres_per_px: the price of a pixel at a pose by its number.

    Attributes:
        settings: the settings that are used.
    """

    def __init__(
        self,
        settings: CorrelationSettings,
        *,
        grey_of: Callable[[int], NDArray[np.uint8] | NDArray[np.uint16]],
        metres_per_px: Callable[[int], float],
    ) -> None:
        self.settings = settings.model_copy(update={"prediction": "constant-velocity"})
        self._grey_of, self._metres_per_px = grey_of, metres_per_px

    def __call__(self, first: int, second: int, expected: Floats) -> Floats | None:
        """The motion [3] (m, m, rad) from one frame to another, None where the images do not tell it.

        Args:
            first: number of the pose that the motion starts from.
            second: number of the pose that it leads to.
            expected: the motion as the chain of poses has it.
        """
        price = self._metres_per_px(second)
        start, end = (eight_bit(self._grey_of(number)) for number in (first, second))
        if start.shape != end.shape:
            return None
        candidate = self._found(start, end, self.motion_of(expected, price))
        if candidate is None:
            return None
        return self.pose_of(candidate.motion, price)

    def motion_of(self, pose: Floats, metres_per_px: float) -> Motion:
        """The image's motion in px that goes with a motion [3] of the body; inverse of `pose_of`."""
        c, s = (f(float(pose[2]) + self.settings.mounting_yaw_rad) for f in (math.cos, math.sin))
        x, y = float(pose[0]) / metres_per_px, float(pose[1]) / metres_per_px
        return Motion(-(c * x + s * y), c * y - s * x, float(pose[2]))

    def pose_of(self, motion: Motion, metres_per_px: float) -> Floats:
        """The motion [3] of the body (m, m, rad) that goes with a motion of the image."""
        heading = motion.rotation_rad + self.settings.mounting_yaw_rad
        x, y = eq.increment_of_vector((motion.u, motion.v), metres_per_px, heading)
        return np.array([x, y, wrap_angle(motion.rotation_rad)])

    def _found(self, start: Grey, end: Grey, expected: Motion) -> Candidate | None:
        turn = expected.rotation_rad
        matcher = Matcher(
            self.settings.model_copy(update={"recovery_rotations_rad": (turn, turn + SPREAD_RAD, turn - SPREAD_RAD)})
        )
        template = Template(0, start, (0.0, 0.0, 0.0), NO_COVARIANCE)
        height, width = start.shape
        if math.hypot(expected.u, expected.v) < math.hypot(width, height) and matcher.reaches(template, expected):
            candidate = matcher.match(template, end, expected)
            if convincing(candidate):
                return candidate
        for motion in matcher.search_globally(start, end, expected):
            candidate = matcher.match(template, end, motion)
            if convincing(candidate):
                return candidate
        return None
