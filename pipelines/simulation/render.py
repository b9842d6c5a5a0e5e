"""Frames of a ground surface as a camera above it sees them.

Image: u to the right along body x (forward), v down along minus body y (to the right of the vehicle);
pixel (0, 0) is the centre of the first pixel. Roll and pitch turn the body about its x and y axes by the
right-hand rule: a positive roll lifts the left side, a positive pitch lowers the nose.

A frame is made of point samples of the surface's spline at the pixels' ground points, without
anti-aliasing: a pixel must not see more than about one pixel of the picture that the surface was made
from. Noise is a function of a key and the pixel's number alone, so that every frame can be rendered by
itself, in any order, with the same bytes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numba as nb
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from pipelines.simulation.sampling import grey_at
from pipelines.simulation.surfaces import Cells, Surface

Floats = NDArray[np.float64]

_quantiles = ndtri((np.arange(1 << 16) + 0.5) / (1 << 16))
NORMAL = (_quantiles / _quantiles.std()).astype(np.float32)  # standard normal by its 16-bit quantile
EVERYWHERE = (-math.inf, math.inf, -math.inf, math.inf)
_ZERO, _HALF, _WHITE = (np.float32(x) for x in (0, 0.5, 255))
_GOLDEN, _MIX1, _MIX2 = np.uint64(0x9E3779B97F4A7C15), np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
_S16, _S27, _S30, _S31 = np.uint64(16), np.uint64(27), np.uint64(30), np.uint64(31)
_LOW16 = np.uint64(0xFFFF)


@dataclass(frozen=True, slots=True)
class Patch:
    """A rectangle of the ground, in world metres, that is covered by another surface."""

    surface: Surface
    x_min_m: float
    x_max_m: float
    y_min_m: float
    y_max_m: float


def world_h_pixel(
    pose: Floats, matrix: Floats, height_m: float, *, roll_rad: float = 0.0, pitch_rad: float = 0.0
) -> Floats:
    """Homography [3, 3] from pixels (u, v, 1) to the ground (x, y, 1) in m.

    Args:
        pose: x (m), y (m), heading (rad) of the camera [3].
        matrix: the camera's K [3, 3] in px.
        height_m: height of the camera above the ground.
        roll_rad: turn about body x.
        pitch_rad: turn about body y.

    Raises:
        ValueError: the camera is not above the ground.
    """
    if not height_m > 0:
        raise ValueError(f"camera height {height_m} m: it must be above the ground")
    x, y, heading = pose
    cos, sin = math.cos(heading), math.sin(heading)
    turn = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
    cos, sin = math.cos(pitch_rad), math.sin(pitch_rad)
    pitch = np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])
    cos, sin = math.cos(roll_rad), math.sin(roll_rad)
    roll = np.array([[1, 0, 0], [0, cos, -sin], [0, sin, cos]])
    body_r_camera = np.diag([1.0, -1.0, -1.0])
    rays = turn @ pitch @ roll @ body_r_camera @ np.linalg.inv(matrix)
    ground = np.array([[height_m, 0, -x], [0, height_m, -y], [0, 0, -1]])
    return np.asarray(ground @ rays)


def radiance(
    surface: Surface, world_h_pixel: Floats, shape: tuple[int, int], patches: Sequence[Patch] = ()
) -> NDArray[np.float32]:
    """Noise-free grey levels [height, width] of the ground that the camera sees."""
    image = np.empty(shape, dtype=np.float32)
    _paint(surface.coefficients, surface.cells, _texel_h_pixel(surface, world_h_pixel), EVERYWHERE, image)
    for p in patches:
        scale = 1 / p.surface.metres_per_texel
        bounds = (p.x_min_m * scale, p.x_max_m * scale, -p.y_max_m * scale, -p.y_min_m * scale)
        _paint(p.surface.coefficients, p.surface.cells, _texel_h_pixel(p.surface, world_h_pixel), bounds, image)
    return image


def expose(
    image: NDArray[np.float32],
    *,
    noise_key: int,
    noise_grey: float = 0.0,
    gain: float = 1.0,
    offset_grey: float = 0.0,
    vignetting: float = 0.0,
) -> NDArray[np.uint8]:
    """The frame uint8 [height, width] that a sensor makes of grey levels float32 [height, width].

    gain · image · (1 - vignetting · r²) + offset + Gaussian noise, rounded and clipped; r is the distance
    from the image centre, 1 in the corners. Equal keys give equal noise (`noise_key_of`).
    """
    frame = np.empty(image.shape, dtype=np.uint8)
    _expose(
        image,
        np.uint64(noise_key),
        np.float32(noise_grey),
        np.float32(gain),
        np.float32(offset_grey),
        vignetting,
        frame,
    )
    return frame


def noise_key_of(seed: int, frame: int) -> int:
    """The key of one frame's noise: unrelated for any two pairs of seed and frame."""
    return int(np.random.SeedSequence((seed, frame)).generate_state(1, np.uint64)[0])


def _texel_h_pixel(surface: Surface, world_h_pixel: Floats) -> Floats:
    scale = 1 / surface.metres_per_texel
    return np.asarray(np.diag([scale, -scale, 1.0]) @ world_h_pixel)


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _paint(
    coef: NDArray[np.float32],
    cells: Cells,
    h: Floats,
    bounds: tuple[float, float, float, float],
    image: NDArray[np.float32],
) -> None:
    """Paint a surface into an image, inside `bounds` (texels x0, x1, y0, y1) with an edge two texels soft."""
    x0, x1, y0, y1 = bounds
    for v in range(image.shape[0]):
        for u in range(image.shape[1]):
            depth = 1.0 / (h[2, 0] * u + h[2, 1] * v + h[2, 2])
            x = (h[0, 0] * u + h[0, 1] * v + h[0, 2]) * depth
            y = (h[1, 0] * u + h[1, 1] * v + h[1, 2]) * depth
            inside = min(min(x - x0, x1 - x), min(y - y0, y1 - y)) * 0.5 + 0.5
            if inside <= 0.0:
                continue
            grey = grey_at(coef, cells, x, y)
            if inside >= 1.0:
                image[v, u] = grey
            else:
                image[v, u] += np.float32(inside) * (grey - image[v, u])


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _expose(
    image: NDArray[np.float32],
    key: np.uint64,
    noise_grey: np.float32,
    gain: np.float32,
    offset_grey: np.float32,
    vignetting: float,
    frame: NDArray[np.uint8],
) -> None:
    """Make the frame of `expose`; splitmix64 of key and pixel number gives the noise of four pixels."""
    rows, columns = image.shape
    mid_v, mid_u = 0.5 * (rows - 1), 0.5 * (columns - 1)
    fall = vignetting / max(mid_u * mid_u + mid_v * mid_v, 1.0)
    state, bits = key, np.uint64(0)
    number = 0
    for v in range(rows):
        for u in range(columns):
            if number % 4 == 0:
                state += _GOLDEN
                bits = (state ^ (state >> _S30)) * _MIX1
                bits = (bits ^ (bits >> _S27)) * _MIX2
                bits = bits ^ (bits >> _S31)
            noise = NORMAL[bits & _LOW16]
            bits = bits >> _S16
            number += 1
            shade = np.float32(1.0 - fall * ((u - mid_u) ** 2 + (v - mid_v) ** 2))
            grey = gain * shade * image[v, u] + offset_grey + noise_grey * noise
            frame[v, u] = np.uint8(min(max(grey + _HALF, _ZERO), _WHITE))
