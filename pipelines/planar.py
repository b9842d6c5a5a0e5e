"""Angles and vectors in the plane; loads no compiler, so that commands which only read a run start at once."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def wrap_angle(angle_rad: float) -> float:
    """The same angle within [-π, π)."""
    return (angle_rad + math.pi) % (2 * math.pi) - math.pi


def wrap_angles(angles_rad: Floats) -> Floats:
    """The same angles within [-π, π), of any shape; NaN stays NaN."""
    return (angles_rad + np.pi) % (2 * np.pi) - np.pi


def rotated(vectors: Floats, angle_rad: Floats) -> Floats:
    """Plane vectors [n, 2], each turned counter-clockwise by its angle [n]."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    x, y = vectors.T
    return np.column_stack([c * x - s * y, s * x + c * y])


def heading_of_quat(quat_xyzw: Floats) -> float:
    """Heading (rotation about z, counter-clockwise) of a unit quaternion [4]; NaN stays NaN."""
    x, y, z, w = (float(q) for q in quat_xyzw)
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def quat_of_heading(heading_rad: float) -> Floats:
    """The unit quaternion x, y, z, w [4] of a rotation about z."""
    return np.array([0.0, 0.0, math.sin(heading_rad / 2), math.cos(heading_rad / 2)])
