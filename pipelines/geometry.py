"""Plane and space geometry that the pipelines share.

Angles in radians, counter-clockwise positive about z; transforms are named `world_T_body`.
"""

from __future__ import annotations

import math

import numpy as np

from pipelines.compiled import compiled
from pipelines.planar import Floats, heading_of_quat, quat_of_heading, rotated, wrap_angle, wrap_angles

__all__ = [
    "Floats", "earth_centred", "from_local_enu", "geodetic", "hat", "heading_of_quat", "local_enu", "quat_of_heading",
    "rotated", "se3_exp", "se3_inverse", "se3_log", "se3_product", "so3_exp", "so3_log", "wrap_angle", "wrap_angles",
]  # fmt: skip


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


# ------------------------------------------------------------------------------ SO(3) and SE(3)


@compiled
def hat(w: Floats) -> Floats:
    """The matrix [3, 3] of the cross product with w: its product with p is w x p."""
    return np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])


@compiled
def quat_of_rotation(r: Floats) -> Floats:
    """The unit quaternion x, y, z, w [4] of a rotation [3, 3], its largest component positive (Shepperd 1978)."""
    trace = r[0, 0] + r[1, 1] + r[2, 2]
    largest, k = trace, 3
    for i in range(3):
        if r[i, i] > largest:
            largest, k = r[i, i], i
    quat = np.empty(4)
    if k == 3:
        quat[0], quat[1], quat[2] = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
        quat[3] = 1 + trace
    else:
        i, j = (k + 1) % 3, (k + 2) % 3
        quat[k] = 1 - trace + 2 * r[k, k]
        quat[i], quat[j] = r[i, k] + r[k, i], r[j, k] + r[k, j]
        quat[3] = r[j, i] - r[i, j]
    return quat / math.sqrt(quat[0] ** 2 + quat[1] ** 2 + quat[2] ** 2 + quat[3] ** 2)


@compiled
def so3_exp(w: Floats) -> Floats:
    """Rotation [3, 3] of a rotation vector [3], rad: I + sin θ/θ W + (1 - cos θ)/θ² W² (Rodrigues)."""
    first, second, _ = _exponential_factors(_length(w))
    one, two = hat(w), _hat_squared(w)
    for i in range(3):
        for j in range(3):
            two[i, j] = (i == j) + first * one[i, j] + second * two[i, j]
    return two


@compiled
def so3_log(r: Floats) -> Floats:
    """Rotation vector [3] of a rotation [3, 3], of length within [0, π]; the inverse of `so3_exp`.

    θ = atan2(|v|, (tr R - 1)/2) with the axial vector v = sin θ · axis; near π, where v vanishes, the axis comes
    from the largest column of (R + Rᵀ)/2 - cos θ I = (1 - cos θ) axis axisᵀ.
    """
    axis = np.array([(r[2, 1] - r[1, 2]) / 2, (r[0, 2] - r[2, 0]) / 2, (r[1, 0] - r[0, 1]) / 2])
    sine, cosine = _length(axis), (r[0, 0] + r[1, 1] + r[2, 2] - 1) / 2
    factor = math.atan2(sine, cosine) / sine if sine > 1e-8 else 1.0
    if cosine <= -0.9:
        k = 0
        for j in range(1, 3):
            if r[j, j] > r[k, k]:
                k = j
        along = axis[k]
        for j in range(3):
            axis[j] = (r[j, k] + r[k, j]) / 2 - (cosine if j == k else 0.0)
        factor = math.copysign(math.atan2(sine, cosine), along) / _length(axis)
    for j in range(3):
        axis[j] *= factor
    return axis


@compiled
def se3_exp(xi: Floats) -> Floats:
    """Transform [4, 4] of a twist ξ = (ρ, ω) [6], m and rad: R = exp ω, t = V ρ.

    V = I + (1 - cos θ)/θ² W + (θ - sin θ)/θ³ W² (Murray, Li, Sastry 1994, 2.36).
    """
    w = xi[3:]
    first, second, third = _exponential_factors(_length(w))
    one, two = hat(w), _hat_squared(w)
    transform = np.zeros((4, 4))
    transform[3, 3] = 1.0
    for i in range(3):
        for j in range(3):
            transform[i, j] = (i == j) + first * one[i, j] + second * two[i, j]
            transform[i, 3] += ((i == j) + second * one[i, j] + third * two[i, j]) * xi[j]
    return transform


@compiled
def se3_log(transform: Floats) -> Floats:
    """Twist ξ = (ρ, ω) [6] of a transform [4, 4]: the inverse of `se3_exp` for rotations up to π.

    ρ = V⁻¹ t, V⁻¹ = I - W/2 + (1 - θ/(2 tan(θ/2)))/θ² W².
    """
    w = so3_log(transform[:3, :3])
    angle = _length(w)
    near = angle < 1e-3
    factor = 1 / 12 + angle**2 / 720 if near else (1 - angle / (2 * math.tan(angle / 2))) / angle**2
    one, two = hat(w), _hat_squared(w)
    xi = np.zeros(6)
    for i in range(3):
        xi[3 + i] = w[i]
        for j in range(3):
            xi[i] += ((i == j) - one[i, j] / 2 + factor * two[i, j]) * transform[j, 3]
    return xi


@compiled
def se3_inverse(transform: Floats) -> Floats:
    """The inverse [4, 4] of a transform: rotation Rᵀ, translation -Rᵀ t."""
    inverse = np.zeros((4, 4))
    inverse[3, 3] = 1.0
    for i in range(3):
        for j in range(3):
            inverse[i, j] = transform[j, i]
            inverse[i, 3] -= transform[j, i] * transform[j, 3]
    return inverse


@compiled
def se3_product(a: Floats, b: Floats) -> Floats:
    """The transform [4, 4] that applies `b` first: a b."""
    product = np.zeros((4, 4))
    product[3, 3] = 1.0
    for i in range(3):
        for j in range(4):
            total = a[i, 3] if j == 3 else 0.0
            for k in range(3):
                total += a[i, k] * b[k, j]
            product[i, j] = total
    return product


@compiled
def _length(w: Floats) -> float:
    return math.sqrt(w[0] * w[0] + w[1] * w[1] + w[2] * w[2])


@compiled
def _hat_squared(w: Floats) -> Floats:
    """W² = w wᵀ - |w|² I, [3, 3]."""
    x, y, z = w
    return np.array(
        [[-(y * y + z * z), x * y, x * z], [x * y, -(x * x + z * z), y * z], [x * z, y * z, -(x * x + y * y)]]
    )


@compiled
def _exponential_factors(angle: float) -> tuple[float, float, float]:
    """Factors sin θ/θ, (1 - cos θ)/θ², (θ - sin θ)/θ³; by their series near 0."""
    square = angle * angle
    if angle < 1e-2:
        return (
            1 - square / 6 * (1 - square / 20 * (1 - square / 42)),
            0.5 - square / 24 * (1 - square / 30 * (1 - square / 56)),
            1 / 6 - square / 120 * (1 - square / 42 * (1 - square / 72)),
        )
    half = math.sin(angle / 2) / angle
    return math.sin(angle) / angle, 2 * half * half, (angle - math.sin(angle)) / (square * angle)
