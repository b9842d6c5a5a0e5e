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
    earth_r_enu = _earth_r_enu(float(latitude_rad[0]), float(longitude_rad[0]))
    enu: Floats = (earth - earth[0]) @ earth_r_enu
    return enu


def from_local_enu(
    enu_m: Floats, latitude_rad: float, longitude_rad: float, altitude_m: float
) -> tuple[Floats, Floats, Floats]:
    """WGS 84 latitude (rad), longitude (rad) and altitude (m), each [n], of east, north, up [n, 3] at an origin.

    The inverse of `local_enu`, whose frame is the tangent plane at the origin.
    """
    origin = earth_centred(*(np.array([x]) for x in (latitude_rad, longitude_rad, altitude_m)))
    return geodetic(origin + enu_m @ _earth_r_enu(latitude_rad, longitude_rad).T)


def geodetic(earth_m: Floats) -> tuple[Floats, Floats, Floats]:
    """WGS 84 latitude (rad), longitude (rad) and altitude (m), each [n], of earth-centred positions [n, 3].

    The inverse of `earth_centred`, within some thousand km of the ellipsoid: with p = sqrt(x² + y²) the
    latitude solves tan φ = (z + e² N sin φ)/p, a contraction by e² a turn, and h = p cos φ + z sin φ - a²/N.
    """
    x, y, z = earth_m.T
    p = np.hypot(x, y)
    latitude = np.arctan2(z, p * (1 - WGS84_ECCENTRICITY_SQUARED))
    for _ in range(8):
        sin = np.sin(latitude)
        n = WGS84_MAJOR_M / np.sqrt(1 - WGS84_ECCENTRICITY_SQUARED * sin**2)
        latitude = np.arctan2(z + WGS84_ECCENTRICITY_SQUARED * n * sin, p)
    sin, cos = np.sin(latitude), np.cos(latitude)
    altitude = p * cos + z * sin - WGS84_MAJOR_M * np.sqrt(1 - WGS84_ECCENTRICITY_SQUARED * sin**2)
    return latitude, np.arctan2(y, x), altitude


def _earth_r_enu(latitude_rad: float, longitude_rad: float) -> Floats:
    """Rotation [3, 3] whose columns are east, north and up in earth-centred axes."""
    sin_lat, cos_lat, sin_lon, cos_lon = (f(x) for x in (latitude_rad, longitude_rad) for f in (math.sin, math.cos))
    east = [-sin_lon, cos_lon, 0.0]
    north = [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat]
    up = [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat]
    return np.array([east, north, up]).T
