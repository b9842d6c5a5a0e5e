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


def wrap_angles(angles_rad: Floats) -> Floats:
    """The same angles within [-π, π), of any shape; NaN stays NaN."""
    return (angles_rad + np.pi) % (2 * np.pi) - np.pi


def heading_of_quat(quat_xyzw: Floats) -> float:
    """Heading (rotation about z, counter-clockwise) of a unit quaternion [4]; NaN stays NaN."""
    x, y, z, w = (float(q) for q in quat_xyzw)
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def quat_of_heading(heading_rad: float) -> Floats:
    """The unit quaternion x, y, z, w [4] of a rotation about z."""
    return np.array([0.0, 0.0, math.sin(heading_rad / 2), math.cos(heading_rad / 2)])


WGS84_MAJOR_M = 6_378_137.0
WGS84_ECCENTRICITY_SQUARED = 6.694379990141317e-3


def earth_centred(latitude_rad: Floats, longitude_rad: Floats, altitude_m: Floats) -> Floats:
    """Earth-centred, earth-fixed positions [n, 3] in metres of WGS 84 coordinates, each [n].

    The prime vertical's radius is N = a / sqrt(1 - e² sin² φ); x = (N + h) cos φ cos λ,
    y = (N + h) cos φ sin λ, z = (N (1 - e²) + h) sin φ (NIMA TR8350.2).
    """
    sin, cos = np.sin(latitude_rad), np.cos(latitude_rad)
    n = WGS84_MAJOR_M / np.sqrt(1 - WGS84_ECCENTRICITY_SQUARED * sin**2)
    return np.column_stack(
        [
            (n + altitude_m) * cos * np.cos(longitude_rad),
            (n + altitude_m) * cos * np.sin(longitude_rad),
            (n * (1 - WGS84_ECCENTRICITY_SQUARED) + altitude_m) * sin,
        ]
    )


def local_enu(latitude_rad: Floats, longitude_rad: Floats, altitude_m: Floats) -> Floats:
    """East, north, up [n, 3] in metres from the first of WGS 84 coordinates, each [n].

    The frame is the tangent plane at the first position; an unknown altitude (NaN) counts as that of the
    first position, and as 0 if that is unknown too.
    """
    origin_height = float(altitude_m[0]) if np.isfinite(altitude_m[0]) else 0.0
    height = np.where(np.isfinite(altitude_m), altitude_m, origin_height)
    earth = earth_centred(latitude_rad, longitude_rad, height)
    lat, lon = float(latitude_rad[0]), float(longitude_rad[0])
    earth_to_enu = np.array(
        [
            [-math.sin(lon), math.cos(lon), 0.0],
            [-math.sin(lat) * math.cos(lon), -math.sin(lat) * math.sin(lon), math.cos(lat)],
            [math.cos(lat) * math.cos(lon), math.cos(lat) * math.sin(lon), math.sin(lat)],
        ]
    )
    enu: Floats = (earth - earth[0]) @ earth_to_enu.T
    return enu
