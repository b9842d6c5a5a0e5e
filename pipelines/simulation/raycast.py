"""The compiled renderer: where the rays of a camera meet a plane, how much of it they see, and what is there.

A camera's pose to a plane is [3, 4]: its rotation and its position in the plane's axes, x and y of them in
texels of the plane's surface, y down as the surface's rows run, z in m out of the painted front. With the ray
r = (x, y, 1), the direction is d = R r, the depth of the plane along it t = (z - c_z)/d_z, where z is 0 or the
height of a relief; the point is c + t d, and its derivatives by the pixel are t (∂d - d ∂d_z/d_z) with
∂d = R (∂x, ∂y, 0).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numba as nb
import numpy as np
from numpy.typing import NDArray

from pipelines.simulation.pyramid import LEVELS, Level, Levels
from pipelines.simulation.sampling import grey_at
from pipelines.simulation.surfaces import TEXELS_PER_PX

Floats = NDArray[np.float64]
Bounds = tuple[float, float, float, float]
Window = tuple[int, int, int, int]

OWN_TEXELS = float(TEXELS_PER_PX)  # of one pixel of the picture that a surface was made from
ALONE, GONE = 1.1, 1.5  # pixel against a surface's own: up to the one it is seen alone, from the other not at all
MOST_SAMPLES = 32  # along a narrow footprint
_LEVEL = 1e-9  # z of a direction that is taken for horizontal


class Bumps(NamedTuple):
    """A relief for compiled code: coefficients, samples per texel of the ground (0 if it is flat), tolerance in m."""

    height: Level
    per_texel: float
    tolerance_m: float


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _at(level: Level, x: float, y: float) -> Any:
    return grey_at(level.coefficients, level.cells, x, y)


@nb.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _fall(q: Floats, s: NDArray[np.float32]) -> tuple[float, float]:
    """∂d_z/∂u, ∂d_z/∂v."""
    return q[2, 0] * s[0] + q[2, 1] * s[2], q[2, 0] * s[1] + q[2, 1] * s[3]


@nb.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _footprint(
    q: Floats, t: float, d: tuple[float, float, float], s: NDArray[np.float32]
) -> tuple[float, float, float, float]:
    """∂x/∂u, ∂x/∂v, ∂y/∂u, ∂y/∂v of the point seen, in texels."""
    zu, zv = _fall(q, s)
    along_x, along_y = d[0] / d[2], d[1] / d[2]
    return (
        t * (q[0, 0] * s[0] + q[0, 1] * s[2] - along_x * zu),
        t * (q[0, 0] * s[1] + q[0, 1] * s[3] - along_x * zv),
        t * (q[1, 0] * s[0] + q[1, 1] * s[2] - along_y * zu),
        t * (q[1, 0] * s[1] + q[1, 1] * s[3] - along_y * zv),
    )


@nb.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _axes(xu: float, xv: float, yu: float, yv: float) -> tuple[float, float]:
    """Long and short half axis of the ellipse that a pixel's unit circle becomes: the singular values."""
    mean = 0.5 * (xu * xu + xv * xv + yu * yu + yv * yv)
    det = xu * yv - xv * yu
    spread = math.sqrt(max(mean * mean - det * det, 0.0))
    return math.sqrt(mean + spread), math.sqrt(max(mean - spread, 0.0))


@nb.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _along(xu: float, xv: float, yu: float, yv: float, long: float) -> tuple[float, float]:
    """The unit vector along the long half axis: J Jᵀ - long² is zero along it, so that it is normal to either row."""
    xx, xy, yy = xu * xu + xv * xv - long * long, xu * yu + xv * yv, yu * yu + yv * yv - long * long
    x, y = (-xy, xx) if xx < yy else (yy, -xy)
    length = math.sqrt(x * x + y * y)
    return x / length, y / length


@nb.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _direction(q: Floats, x: float, y: float) -> tuple[float, float, float]:
    return (
        q[0, 0] * x + q[0, 1] * y + q[0, 2],
        q[1, 0] * x + q[1, 1] * y + q[1, 2],
        q[2, 0] * x + q[2, 1] * y + q[2, 2],
    )


@nb.njit(cache=True, nogil=True, error_model="numpy")
def coarsest(q: Floats, rays: Floats, slopes: NDArray[np.float32], texel_m: float) -> tuple[float, float]:
    """Over a grid of pixels that has the image's corners: the largest footprint, and the flattest ray.

    Returns:
        The longest axis of a footprint in texels, and the largest horizontal per vertical part of a ray;
        infinite where a ray does not come down to the plane.
    """
    rows, columns = rays.shape[0], rays.shape[1]
    longest, flattest = 0.0, 0.0
    for i in range(17):
        v = i * (rows - 1) // 16
        for j in range(17):
            u = j * (columns - 1) // 16
            d = _direction(q, rays[v, u, 0], rays[v, u, 1])
            if d[2] >= -_LEVEL or q[2, 3] <= 0.0:
                return math.inf, math.inf
            xu, xv, yu, yv = _footprint(q, -q[2, 3] / d[2], d, slopes[v, u])
            longest = max(longest, _axes(xu, xv, yu, yv)[0])
            flattest = max(flattest, -math.hypot(d[0], d[1]) * texel_m / d[2])
    return longest, flattest


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _averaged(
    fine: Level, coarse: Level, blend: float, x: float, y: float, step_x: float, step_y: float, count: int
) -> Any:
    """The mean of a surface from -step to step about (x, y), texels of `fine`, in `count` samples.

    Their weights are Tukey's biweight (1 - s²)²: over two pixels, it lets no moiré through. A share `blend` is taken
    of the coarse level.
    """
    total, weights = np.float32(0), np.float32(0)
    for k in range(count):
        s = (2 * k + 1) / count - 1.0
        at_x, at_y = x + s * step_x, y + s * step_y
        grey = _at(fine, at_x, at_y)
        if blend > 0.0:
            grey += np.float32(blend) * (_at(coarse, 0.5 * at_x, 0.5 * at_y) - grey)
        weight = np.float32((1.0 - s * s) ** 2)
        total += weight * grey
        weights += weight
    return total / weights


@nb.njit(cache=True, nogil=True, error_model="numpy", inline="always")  # a call would copy the headers of all levels
def _seen(levels: Levels, x: float, y: float, xu: float, xv: float, yu: float, yv: float) -> Any:
    """What a pixel sees of a surface: the mean along its footprint's long axis, at the level of the short one."""
    long, short = _axes(xu, xv, yu, yv)
    if long <= ALONE * OWN_TEXELS:
        return _at(levels[0], x, y)
    width = max(short, OWN_TEXELS, 2.0 * long / MOST_SAMPLES)
    step_x, step_y, count = 0.0, 0.0, 1
    if long > ALONE * width:
        reach = min((long / width - ALONE) / (GONE - ALONE), 1.0) * long
        away_x, away_y = _along(xu, xv, yu, yv, long)
        step_x, step_y, count = reach * away_x, reach * away_y, math.ceil(2.0 * reach / width)
    number, scale, share = 0, 1.0, width / OWN_TEXELS
    while share >= GONE and number < LEVELS - 2:
        number, scale, share = number + 1, scale * 0.5, share * 0.5
    blend = min(max((share - ALONE) / (GONE - ALONE), 0.0), 1.0)
    return _averaged(
        levels[number], levels[number + 1], blend, x * scale, y * scale, step_x * scale, step_y * scale, count
    )


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _height(bumps: Bumps, q: Floats, d: tuple[float, float, float], guess: float) -> float:
    """The height z at which a ray meets a relief: the fixed point of z → relief(c + d (z - c_z)/d_z), by secants."""
    before, wrong_before, z = 0.0, 0.0, guess
    for k in range(30):
        t = (z - q[2, 3]) / d[2]
        x, y = (q[0, 3] + t * d[0]) * bumps.per_texel, (q[1, 3] + t * d[1]) * bumps.per_texel
        wrong = np.float64(_at(bumps.height, x, y)) - z
        if abs(wrong) <= bumps.tolerance_m:
            return z + wrong
        step = wrong if k == 0 or wrong == wrong_before else -wrong * (z - before) / (wrong - wrong_before)
        before, wrong_before, z = z, wrong, z + step
    return z


@nb.njit(cache=True, nogil=True, error_model="numpy")
def draw(
    levels: Levels,
    poses: Floats,
    rays: Floats,
    slopes: NDArray[np.float32],
    bounds: Bounds,
    window: Window,
    sharp: bool,
    bumps: Bumps,
    depth: Floats,
    image: NDArray[np.float32],
) -> None:
    """Draw a plane, inside a window of the image (rows v0 to v1, columns u0 to u1), over what is there.

    Args:
        levels: its surface.
        poses: the camera's poses to the plane, one [1, 3, 4] or one per row of the image [height, 3, 4].
        rays: of the camera (`lens.ray_table`).
        slopes: of the camera.
        bounds: x0, x1, y0, y1 of the plane in texels; its edge is two texels or one pixel soft.
        window: v0, v1, u0, u1.
        sharp: whether no pixel sees more than one of the surface's own.
        bumps: relief.
        depth: of what is there [height, width] in m along the optical axis, brought up to date; empty if all that is
            there is to be drawn over.
        image: [height, width].
    """
    x0, x1, y0, y1 = bounds
    endless = x0 == -math.inf
    v0, v1, u0, u1 = window
    xu = xv = yu = yv = 0.0
    for v in range(v0, v1):
        q = poses[v] if len(poses) > 1 else poses[0]
        if q[2, 3] <= 0.0:
            continue
        z = 0.0
        for u in range(u0, u1):
            d = _direction(q, rays[v, u, 0], rays[v, u, 1])
            cover = 1.0
            if endless and not sharp:  # the horizon, one pixel soft
                zu, zv = _fall(q, slopes[v, u])
                cover = 0.5 - d[2] / (abs(zu) + abs(zv))
            if d[2] > -_LEVEL:  # so far away that it is one grey
                if endless and cover > 0.0:
                    image[v, u] += np.float32(cover) * (_at(levels[LEVELS - 1], 0.0, 0.0) - image[v, u])
                continue
            if bumps.per_texel > 0.0:
                z = _height(bumps, q, d, z)
            t = (z - q[2, 3]) / d[2]
            if depth.size > 0 and t > depth[v, u] * (1.0 + 1e-9):
                continue
            x, y = q[0, 3] + t * d[0], q[1, 3] + t * d[1]
            soft_x = soft_y = OWN_TEXELS
            if not sharp:
                xu, xv, yu, yv = _footprint(q, t, d, slopes[v, u])
                soft_x, soft_y = max(soft_x, abs(xu) + abs(xv)), max(soft_y, abs(yu) + abs(yv))
            if not endless:
                cover = min(min(x - x0, x1 - x) / soft_x, min(y - y0, y1 - y) / soft_y) + 0.5
            if cover <= 0.0:
                continue
            grey = _at(levels[0], x, y) if sharp else _seen(levels, x, y, xu, xv, yu, yv)
            if cover >= 1.0:
                image[v, u] = grey
            else:
                image[v, u] += np.float32(cover) * (grey - image[v, u])
            if depth.size > 0 and cover >= 0.5:
                depth[v, u] = t
