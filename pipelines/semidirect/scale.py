"""How many metres a unit of the map is, with σ and where it was taken from.

Every source comes down to lengths known twice, ℓ_i in metres and m_i in units of the map, ℓ = s m, with independent
errors on both sides. s is the most likely scale of that model: the least of Σ (ℓ - s m)²/(σ_ℓ² + s² σ_m²) (D. York,
"Least-squares fitting of a straight line", Canadian Journal of Physics 44, 1966, for a line through the origin). A
plain regression would be drawn towards 0 by the errors of m. What all lengths of a source have in common (a barometer's
offset, a wheel's radius) is not in σ: many readings do not average it away.

Points and planes are in camera axes and units of the map, unless they end in `_m`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

Floats = NDArray[np.float64]

TUKEY = 4.6851
"""Width of Tukey's weights in σ, for 95 % efficiency."""
MAD_TO_SIGMA = 1.4826
PLANE_ITERATIONS = 20


class ScaleSource(StrEnum):
    """What a scale was taken from."""

    HEIGHT = "height"
    RANGE = "range"
    SPEED = "speed"
    REFERENCE = "reference"


@dataclass(frozen=True, slots=True)
class Scale:
    """Metres per unit of the map.

    Attributes:
        metres: s.
        sigma: its standard deviation, m per unit; where the lengths agree worse than their σ, by that much larger.
        source: what it was taken from.
        count: lengths used.
        chi2: Σ (ℓ - s m)²/(σ_ℓ² + s² σ_m²), about count - 1 if the σ of the lengths are right.
    """

    metres: float
    sigma: float
    source: ScaleSource
    count: int
    chi2: float


class Plane(NamedTuple):
    """A plane n·x = d fitted to points, d > 0; `sigma` of d where the origin's normal meets it, `rms` of the used."""

    normal: Floats
    distance: float
    sigma: float
    rms: float
    used: int


def plane_of(points: Floats) -> Plane:
    """The plane through most of the points [n, 3], seen from the origin.

    Least squares across the plane with Tukey's weights, whose width follows from the median of the deviations.

    Raises:
        ValueError: fewer than 4 points, or points on a line.
    """
    p = np.asarray(points, np.float64)
    p = p[np.all(np.isfinite(p), axis=1)]
    if len(p) < 4:
        raise ValueError(f"a plane and its σ need at least 4 points, not {len(p)}")
    weight, normal, mean = np.ones(len(p)), np.zeros(3), np.zeros(3)
    for _ in range(PLANE_ITERATIONS):
        mean = weight @ p / weight.sum()
        values, axes = (np.asarray(x) for x in np.linalg.eigh((p - mean).T @ ((p - mean) * weight[:, None])))
        if not values[1] > 1e-12 * values[2]:
            raise ValueError("the points lie on a line, which has no plane; take points from all over the image")
        turned = abs(float(axes[:, 0] @ normal))
        normal = axes[:, 0]
        off = np.asarray((p - mean) @ normal)
        deviation = MAD_TO_SIGMA * float(np.median(np.abs(off)))
        width = TUKEY * (deviation + 1e-12 * math.sqrt(float(values[2])))  # points without noise keep their weight
        weight = np.where(np.abs(off) < width, (1.0 - (off / width) ** 2) ** 2, 0.0)
        if turned > 1.0 - 1e-14:
            break
    distance = float(normal @ mean)
    normal, distance = (normal, distance) if distance > 0 else (-normal, -distance)
    used = weight > 0
    rms = math.sqrt(float(np.sum(off[used] ** 2)) / max(int(np.count_nonzero(used)) - 3, 1))
    return Plane(normal, distance, rms * _leverage(p[used], normal), rms, int(np.count_nonzero(used)))


def _leverage(p: Floats, normal: Floats) -> float:
    """σ of the fitted distance under the origin for points of unit σ: far from their centre it grows."""
    across = np.linalg.svd(normal[None, :])[2][1:]
    design = np.column_stack([np.ones(len(p)), p @ across.T])
    return math.sqrt(float(np.linalg.inv(design.T @ design)[0, 0]))


def ratio(source: ScaleSource, metric: Floats, sigma_metric: Floats, mapped: Floats, sigma_mapped: Floats) -> Scale:
    """The scale of lengths known twice.

    Args:
        source: what the metric lengths were taken from.
        metric: ℓ [n], m.
        sigma_metric: their σ [n], m.
        mapped: m [n], units of the map.
        sigma_mapped: their σ [n], units of the map.

    Raises:
        ValueError: no length, one that is not finite, a σ that is negative or 0 on both sides, or lengths of which no
            positive scale follows.
    """
    length, sl, m, sm = (np.atleast_1d(np.asarray(x, np.float64)) for x in (metric, sigma_metric, mapped, sigma_mapped))
    if not (len(length) > 0 and length.shape == sl.shape == m.shape == sm.shape):
        raise ValueError(f"scale from {source}: lengths and σ need one shape [n > 0], not {length.shape}, {m.shape}")
    if not np.all(np.isfinite([length, sl, m, sm])) or np.any((sl < 0) | (sm < 0) | (sl + sm == 0)):
        raise ValueError(f"scale from {source}: lengths must be finite and have a positive σ in metres or in the map")
    guess = float(length @ m) / max(float(m @ m), 1e-300)
    if not guess > 0:
        raise ValueError(f"scale from {source}: the lengths in metres and in the map do not agree in sign")

    def cost(log_s: float) -> float:
        s = math.exp(log_s)
        return float(np.sum((length - s * m) ** 2 / (sl**2 + (s * sm) ** 2)))

    middle = math.log(guess)
    found = minimize_scalar(cost, bounds=(middle - 3.0, middle + 3.0), method="bounded", options={"xatol": 1e-12})
    s, chi2 = math.exp(float(found.x)), float(found.fun)
    variance = sl**2 + (s * sm) ** 2
    true = (m * sl**2 + s * length * sm**2) / variance  # m as both sides together know it
    information = float(np.sum(true**2 / variance))
    excess = max(1.0, chi2 / (len(m) - 1)) if len(m) > 1 else 1.0
    return Scale(s, math.sqrt(excess / information), source, len(m), chi2)


def from_height(height_m: Floats, sigma_m: Floats, distance: Floats, sigma_distance: Floats) -> Scale:
    """From heights over the plane.

    Args:
        height_m: perpendicular distance of the camera from the plane [n], m.
        sigma_m: its σ [n].
        distance: of the plane in the map at the same moments, `Plane.distance` [n].
        sigma_distance: its σ [n].

    Raises:
        ValueError: see `ratio`.
    """
    return ratio(ScaleSource.HEIGHT, height_m, sigma_m, distance, sigma_distance)


def from_range(
    range_m: Floats,
    sigma_m: Floats,
    beam: Floats,
    sensor_in_cam_m: Floats,
    normal: Floats,
    distance: Floats,
    sigma_distance: Floats,
) -> Scale:
    """From a range sensor fixed to the camera whose beam meets the plane.

    The beam's end o + r b lies on the plane s d: n·o + r n·b = s d, so tilt and lever arm are accounted for.

    Args:
        range_m: r [n], m.
        sigma_m: its σ [n].
        beam: unit direction b of the beam in camera axes [3].
        sensor_in_cam_m: place o of the sensor in camera axes [3], m.
        normal: n of the plane in camera axes at each moment [n, 3].
        distance: d of the plane [n].
        sigma_distance: its σ [n].

    Raises:
        ValueError: a beam along the plane or away from it; see `ratio`.
    """
    towards = np.asarray(normal @ beam)
    if not np.all(towards > 0):
        raise ValueError("scale from range: the beam does not meet the plane; check the sensor's direction in the rig")
    height = normal @ sensor_in_cam_m + range_m * towards
    return ratio(ScaleSource.RANGE, height, sigma_m * towards, distance, sigma_distance)


def from_speed(
    speed_mps: Floats, sigma_mps: Floats, dt_s: Floats, displacement: Floats, sigma_displacement: Floats
) -> Scale:
    """From the speed over intervals in which the camera moved about straight.

    Args:
        speed_mps: mean speed over each interval [n], m/s.
        sigma_mps: its σ [n].
        dt_s: lengths of the intervals [n], s.
        displacement: of the camera in the map [n, 3].
        sigma_displacement: σ of each of its coordinates [n]. Errors across the way make a displacement longer, by 2σ²
            in its square, which is taken off.

    Raises:
        ValueError: an interval that is not positive; see `ratio`.
    """
    if not np.all(np.asarray(dt_s) > 0):
        raise ValueError("scale from speed: intervals must be positive; sort the samples by time")
    squared = np.sum(np.asarray(displacement) ** 2, axis=-1) - 2.0 * np.asarray(sigma_displacement) ** 2
    way = np.sqrt(np.maximum(squared, 0.0))
    return ratio(ScaleSource.SPEED, speed_mps * dt_s, sigma_mps * dt_s, way, sigma_displacement)


def from_reference(reference_m: Floats, sigma_m: float, positions: Floats, sigma_position: float) -> Scale:
    """From positions of a reference at the same moments, in axes of its own.

    The rotation is that of the least squares (W. Kabsch, Acta Crystallographica A32, 1976), both means taken off; what
    is left is `ratio` of the 3n coordinates.

    Args:
        reference_m: positions [n, 3], m.
        sigma_m: σ of a coordinate, m.
        positions: of the camera in the map [n, 3].
        sigma_position: σ of a coordinate, units of the map.

    Raises:
        ValueError: fewer than 3 positions, or shapes that differ; see `ratio`.
    """
    a, b = np.asarray(positions, np.float64), np.asarray(reference_m, np.float64)
    if a.shape != b.shape or a.ndim != 2 or a.shape[1] != 3 or len(a) < 3:
        raise ValueError(f"scale from reference: needs two arrays [n >= 3, 3], not {a.shape} and {b.shape}")
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    if not (np.any(a) and np.any(b)):
        raise ValueError("scale from reference: the camera has not moved; take a longer part of the run")
    u, _, vt = np.linalg.svd(b.T @ a)
    turned = a @ (u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt).T
    ones = np.ones(a.size)
    return ratio(ScaleSource.REFERENCE, b.ravel(), sigma_m * ones, turned.ravel(), sigma_position * ones)
