"""The camera of `pipelines.lens` and the image pyramid for compiled code, one point at a time.

Formulas and limits are those of `pipelines.lens`. A point (a, b) lies on the plane at unit depth; pixel (0, 0) is the
centre of the first pixel of level 0, and of level l, whose pixels are means of 2^l x 2^l of them:

    u_l = (u + ½)/2^l - ½
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pipelines import lens
from readers.streams import Camera

_jit: Any = njit(cache=True, nogil=True, error_model="numpy")

Image = NDArray[np.uint8]
Pyramid = tuple[Image, ...]

NEWTON_STEPS = 20
NEWTON_TOLERANCE = 1e-13
LEVELS = 5


class Optics(NamedTuple):
    """Focal lengths, skew and principal point in px; whether the model is equidistant; its coefficients; its reach."""

    focal_u: float
    focal_v: float
    skew: float
    centre_u: float
    centre_v: float
    fisheye: bool
    p1: float
    p2: float
    k1: float
    k2: float
    k3: float
    k4: float
    k5: float
    k6: float
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
    """The camera for compiled code.

    Raises:
        ValueError: a camera without a calibration, or with an unknown model.
    """
    model = lens._lens_of(camera)
    k = [*model.above, *model.below, 0.0, 0.0][:6]
    m = camera.matrix
    p1, p2 = (float(p) for p in model.tangential)
    fu, fv, skew, cu, cv = (float(x) for x in (m[0, 0], m[1, 1], m[0, 1], m[0, 2], m[1, 2]))
    k1, k2, k3, k4, k5, k6 = (float(x) for x in k)
    return Optics(fu, fv, skew, cu, cv, model.fisheye, p1, p2, k1, k2, k3, k4, k5, k6, float(lens._reach(model)))


@_jit
def distort(c: Optics, a: float, b: float) -> Distorted:
    """The distorted point of one at unit depth, with its derivative."""
    r2 = a * a + b * b
    if c.fisheye:
        r2 = max(r2, 1e-16)
        angle = math.atan(math.sqrt(r2))
        q = angle * angle
        stretch = 1.0 + q * (c.k1 + q * (c.k2 + q * (c.k3 + q * c.k4)))
        steep = c.k1 + q * (2.0 * c.k2 + q * (3.0 * c.k3 + q * 4.0 * c.k4))
        gain = angle * stretch / math.sqrt(r2)
        slope = ((stretch + 2.0 * q * steep) / (1.0 + r2) - gain) / (2.0 * r2)
    else:
        above = 1.0 + r2 * (c.k1 + r2 * (c.k2 + r2 * c.k3))
        below = 1.0 + r2 * (c.k4 + r2 * (c.k5 + r2 * c.k6))
        gain = above / below
        slope_below = c.k4 + r2 * (2.0 * c.k5 + r2 * 3.0 * c.k6)
        slope = (c.k1 + r2 * (2.0 * c.k2 + r2 * 3.0 * c.k3) - gain * slope_below) / below
    return Distorted(
        a * gain + 2.0 * c.p1 * a * b + c.p2 * (r2 + 2.0 * a * a),
        b * gain + c.p1 * (r2 + 2.0 * b * b) + 2.0 * c.p2 * a * b,
        gain + 2.0 * slope * a * a + 2.0 * c.p1 * b + 6.0 * c.p2 * a,
        2.0 * slope * a * b + 2.0 * c.p1 * a + 2.0 * c.p2 * b,
        gain + 2.0 * slope * b * b + 6.0 * c.p1 * b + 2.0 * c.p2 * a,
    )


@_jit
def project(c: Optics, x: float, y: float, z: float) -> Projected:
    """The pixel of a point in camera axes; NaN behind the camera and beyond the reach of the distortion model."""
    a, b = x / z, y / z
    if not (z > 0.0 and a * a + b * b <= c.reach * c.reach):
        nan = math.nan
        return Projected(nan, nan, nan, nan, nan, nan, nan, nan)
    d = distort(c, a, b)
    u_a, u_b = c.focal_u * d.xx + c.skew * d.xy, c.focal_u * d.xy + c.skew * d.yy
    v_a, v_b = c.focal_v * d.xy, c.focal_v * d.yy
    return Projected(
        c.focal_u * d.x + c.skew * d.y + c.centre_u,
        c.focal_v * d.y + c.centre_v,
        u_a / z,
        u_b / z,
        -(u_a * a + u_b * b) / z,
        v_a / z,
        v_b / z,
        -(v_a * a + v_b * b) / z,
    )


@_jit
def ray(c: Optics, u: float, v: float) -> tuple[float, float]:
    """The point (a, b) at unit depth of a pixel, by Newton's method; NaN if none is found."""
    y = (v - c.centre_v) / c.focal_v
    x = (u - c.centre_u - c.skew * y) / c.focal_u
    a, b = x, y
    if c.fisheye:
        angle = math.sqrt(x * x + y * y)
        stretch = math.tan(min(angle, 1.5)) / angle if angle > 1e-8 else 1.0
        a, b = stretch * x, stretch * y
    for _ in range(NEWTON_STEPS):
        d = distort(c, a, b)
        dx, dy = x - d.x, y - d.y
        if max(abs(dx), abs(dy)) <= NEWTON_TOLERANCE * (1.0 + abs(x) + abs(y)):
            if a * a + b * b <= c.reach * c.reach:
                return a, b
            break
        det = d.xx * d.yy - d.xy * d.xy
        a, b = a + (d.yy * dx - d.xy * dy) / det, b + (d.xx * dy - d.xy * dx) / det
    return math.nan, math.nan


def pyramid_of(image: Image) -> Pyramid:
    """The levels of a grey image [rows, cols] uint8, each the rounded 2 x 2 means of the one before."""
    levels = [np.ascontiguousarray(image)]
    for _ in range(LEVELS - 1):
        rows, cols = (n // 2 for n in levels[-1].shape)
        fine = levels[-1][: 2 * rows, : 2 * cols].astype(np.uint16)
        sums = fine[::2, ::2] + fine[1::2, ::2] + fine[::2, 1::2] + fine[1::2, 1::2]
        levels.append(((sums + 2) // 4).astype(np.uint8))
    return tuple(levels)


@_jit
def level_image(pyramid: Pyramid, level: int) -> Image:
    """One level [rows, cols]."""
    return pyramid[level]


@_jit
def on_level(u: float, level: int) -> float:
    """The coordinate on a level of a coordinate on level 0."""
    return (u + 0.5) / (1 << level) - 0.5


@_jit
def on_finest(u: float, level: int) -> float:
    """The coordinate on level 0 of a coordinate on a level."""
    return (u + 0.5) * (1 << level) - 0.5


@_jit
def sample(image: Image, u: float, v: float) -> Any:
    """Grey value between pixels, bilinear; (u, v) lies in [0, cols - 1) x [0, rows - 1)."""
    i, j = int(v), int(u)
    s, t = u - j, v - i
    top = (1.0 - s) * image[i, j] + s * image[i, j + 1]
    return (1.0 - t) * top + t * ((1.0 - s) * image[i + 1, j] + s * image[i + 1, j + 1])
