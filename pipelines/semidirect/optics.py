"""The camera for compiled code: a point to its pixel with the derivative, a pixel to its ray.

The formulas are those of `pipelines.lens`, point by point instead of array by array. Camera axes: x right, y
down, z out of the lens; pixel (0, 0) is the centre of the first pixel.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipelines import lens
from pipelines.compiled import compiled
from readers.streams import Camera

Floats = NDArray[np.float64]

NEWTON_STEPS = 20


class Optics(NamedTuple):
    """Focal lengths, skew and principal point in px; distortion as in `lens.Radial`."""

    focal_u: float
    focal_v: float
    skew: float
    centre_u: float
    centre_v: float
    fisheye: bool
    p1: float
    p2: float
    a1: float
    a2: float
    a3: float
    a4: float
    b1: float
    b2: float
    b3: float
    reach: float


class Projected(NamedTuple):
    """A pixel and its derivatives by the point; NaN for a point that has no pixel."""

    u: float
    v: float
    u_x: float
    u_y: float
    u_z: float
    v_x: float
    v_y: float
    v_z: float


class Distorted(NamedTuple):
    """A distorted point at unit depth and its derivative, a symmetric matrix xx, xy, yy."""

    x: float
    y: float
    xx: float
    xy: float
    yy: float


def optics_of(camera: Camera) -> Optics:
    """A calibrated camera in the form that kernels take.

    Raises:
        ValueError: no calibration, an unknown distortion model, or a matrix whose second row depends on x.
    """
    model = lens.radial(camera)
    (focal_u, skew, centre_u), (below, focal_v, centre_v) = camera.matrix[:2].tolist()
    if below != 0 or not focal_v > 0:
        raise ValueError(f"camera matrix {camera.matrix.tolist()}: give it as [[fx, s, cx], [0, fy, cy], [0, 0, 1]]")
    return Optics(
        focal_u, focal_v, skew, centre_u, centre_v, model.fisheye, *model.tangential, *model.above, *model.below,
        model.reach,
    )  # fmt: skip


@compiled
def distort(optics: Optics, x: float, y: float) -> Distorted:
    """The distorted point of one at unit depth, with its derivative; see `pipelines.lens` for the models."""
    r2 = x * x + y * y
    if optics.fisheye:
        r2 = max(r2, 1e-16)  # g is flat there
        angle = math.atan(math.sqrt(r2))
        t = angle * angle
        stretch = 1 + t * (optics.a1 + t * (optics.a2 + t * (optics.a3 + t * optics.a4)))
        steep = optics.a1 + t * (2 * optics.a2 + t * (3 * optics.a3 + t * 4 * optics.a4))
        gain = angle * stretch / math.sqrt(r2)
        slope = ((stretch + 2 * t * steep) / (1 + r2) - gain) / (2 * r2)
    else:
        above = 1 + r2 * (optics.a1 + r2 * (optics.a2 + r2 * optics.a3))
        below = 1 + r2 * (optics.b1 + r2 * (optics.b2 + r2 * optics.b3))
        gain = above / below
        above_slope = optics.a1 + r2 * (2 * optics.a2 + r2 * 3 * optics.a3)
        below_slope = optics.b1 + r2 * (2 * optics.b2 + r2 * 3 * optics.b3)
        slope = (above_slope - gain * below_slope) / below
    p1, p2 = optics.p1, optics.p2
    return Distorted(
        x * gain + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * gain + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        gain + 2 * slope * x * x + 2 * p1 * y + 6 * p2 * x,
        2 * slope * x * y + 2 * p1 * x + 2 * p2 * y,
        gain + 2 * slope * y * y + 6 * p1 * y + 2 * p2 * x,
    )


@compiled
def project(optics: Optics, x: float, y: float, z: float) -> Projected:
    """The pixel of a point in camera axes, and ∂(u, v)/∂(x, y, z) = K_2x2 · ∂distorted · [I | -(a, b)]/z.

    NaN for a point that is not before the camera or farther aside than the model holds.
    """
    a, b = x / z, y / z
    if not (z > 0 and a * a + b * b <= optics.reach * optics.reach):
        nan = math.nan
        return Projected(nan, nan, nan, nan, nan, nan, nan, nan)
    d = distort(optics, a, b)
    u_a = optics.focal_u * d.xx + optics.skew * d.xy
    u_b = optics.focal_u * d.xy + optics.skew * d.yy
    v_a, v_b = optics.focal_v * d.xy, optics.focal_v * d.yy
    return Projected(
        optics.focal_u * d.x + optics.skew * d.y + optics.centre_u,
        optics.focal_v * d.y + optics.centre_v,
        u_a / z,
        u_b / z,
        -(u_a * a + u_b * b) / z,
        v_a / z,
        v_b / z,
        -(v_a * a + v_b * b) / z,
    )


@compiled
def ray(optics: Optics, u: float, v: float) -> tuple[float, float]:
    """The ray (a, b, 1) of a pixel, the inverse of `project` by Newton's method; NaN where the model has none."""
    goal_y = (v - optics.centre_v) / optics.focal_v
    goal_x = (u - optics.centre_u - optics.skew * goal_y) / optics.focal_u
    a, b = goal_x, goal_y
    if optics.fisheye:  # the inverse of the undistorted equidistant model is nearer than the pixel itself
        angle = math.hypot(goal_x, goal_y)
        stretch = math.tan(min(angle, 1.5)) / angle if angle > 1e-8 else 1.0
        a, b = stretch * goal_x, stretch * goal_y
    for _ in range(NEWTON_STEPS):
        d = distort(optics, a, b)
        missing_x, missing_y = goal_x - d.x, goal_y - d.y
        if max(abs(missing_x), abs(missing_y)) <= lens.TOLERANCE * (1 + abs(goal_x) + abs(goal_y)):
            if a * a + b * b <= optics.reach * optics.reach:
                return a, b
            break
        determinant = d.xx * d.yy - d.xy * d.xy
        a += (d.yy * missing_x - d.xy * missing_y) / determinant
        b += (d.xx * missing_y - d.xy * missing_x) / determinant
    return math.nan, math.nan


@compiled
def rays(optics: Optics, pixels: Floats) -> Floats:
    """Rays (a, b, 1) [n, 3] of pixels [n, 2]; NaN where there is none."""
    found = np.ones((len(pixels), 3))
    for i in range(len(pixels)):
        found[i, 0], found[i, 1] = ray(optics, pixels[i, 0], pixels[i, 1])
    return found
