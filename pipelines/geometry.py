"""Plane and space geometry that the pipelines share.

Angles in radians, counter-clockwise positive about z; transforms are named `world_T_body`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def wrap_angle(angle_rad: float) -> float:
    """The same angle within [-π, π)."""
    return (angle_rad + math.pi) % (2 * math.pi) - math.pi


def heading_of_quat(quat_xyzw: Floats) -> float:
    """Heading (rotation about z, counter-clockwise) of a unit quaternion [4]; NaN stays NaN."""
    x, y, z, w = (float(q) for q in quat_xyzw)
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def quat_of_heading(heading_rad: float) -> Floats:
    """The unit quaternion x, y, z, w [4] of a rotation about z."""
    return np.array([0.0, 0.0, math.sin(heading_rad / 2), math.cos(heading_rad / 2)])
