"""The grey level of a surface at a point: the compiled heart of the renderer."""

from __future__ import annotations

import math
from typing import Any

import numba as nb
import numpy as np
from numpy.typing import NDArray

from pipelines.simulation.surfaces import WRAP, Cells

_SIXTH = np.float32(1 / 6)
_ONE, _THREE, _FOUR, _SIX = (np.float32(x) for x in (1, 3, 4, 6))
_GOLDEN, _SILVER = np.uint64(0x9E3779B97F4A7C15), np.uint64(0xD1B54A32D192ED03)
_MIX = np.uint64(0xBF58476D1CE4E5B9)
_S16, _S29, _S32, _S48 = (np.uint64(x) for x in (16, 29, 32, 48))
_LOW16 = np.uint64(0xFFFF)


@nb.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def wrap(i: int, n: int, inverse: float) -> int:
    """The index i modulo n, without an integer division."""
    i -= n * math.floor(i * inverse)
    if i < 0:
        i += n
    elif i >= n:
        i -= n
    return i


@nb.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _spline_at(coef: NDArray[np.float32], x: float, y: float) -> Any:
    """The cubic B-spline with periodic coefficients `coef` (as `Surface` has them) at texel (x, y); a float32."""
    rows, columns = coef.shape[0] - WRAP, coef.shape[1] - WRAP
    whole_x, whole_y = math.floor(x), math.floor(y)
    i, j = wrap(whole_y, rows, 1.0 / rows), wrap(whole_x, columns, 1.0 / columns)
    f, g = np.float32(x - whole_x), np.float32(y - whole_y)
    e, k = _ONE - f, _ONE - g
    a0, a1, a2, a3 = e * e * e, _FOUR - (_SIX - _THREE * f) * f * f, _FOUR - (_SIX - _THREE * e) * e * e, f * f * f
    b0, b1, b2, b3 = k * k * k, _FOUR - (_SIX - _THREE * g) * g * g, _FOUR - (_SIX - _THREE * k) * k * k, g * g * g
    c0 = b0 * coef[i, j] + b1 * coef[i + 1, j] + b2 * coef[i + 2, j] + b3 * coef[i + 3, j]
    c1 = b0 * coef[i, j + 1] + b1 * coef[i + 1, j + 1] + b2 * coef[i + 2, j + 1] + b3 * coef[i + 3, j + 1]
    c2 = b0 * coef[i, j + 2] + b1 * coef[i + 1, j + 2] + b2 * coef[i + 2, j + 2] + b3 * coef[i + 3, j + 2]
    c3 = b0 * coef[i, j + 3] + b1 * coef[i + 1, j + 3] + b2 * coef[i + 2, j + 3] + b3 * coef[i + 3, j + 3]
    return (a0 * c0 + a1 * c1 + a2 * c2 + a3 * c3) * _SIXTH * _SIXTH


@nb.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _hashed(key: int, i: int, j: int) -> Any:
    """64 random bits of cell (i, j): a counter of two odd strides, mixed by one round of splitmix64's kind."""
    z = np.uint64(key) + np.uint64(i) * _GOLDEN + np.uint64(j) * _SILVER
    z = (z ^ (z >> _S32)) * _MIX
    return z ^ (z >> _S29)


@nb.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _blend(before: float, own: float, t: float, mean: float, coherence: float) -> float:
    """From `before` at t = 0 to `own` at t = 1, twice continuously differentiable, at equal variance about `mean`.

    The weights w, 1 - w leave w² + (1 - w)² of the variance of what is independent in the two, and all of what
    they share; the root of what is left is divided out.
    """
    w = t * t * t * (10.0 - t * (15.0 - 6.0 * t))
    left = coherence + (1.0 - coherence) * (w * w + (1.0 - w) * (1.0 - w))
    return mean + (w * (own - mean) + (1.0 - w) * (before - mean)) / math.sqrt(left)


@nb.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _offset(cells: Cells, i: float, j: float) -> tuple[float, float]:
    """Where in the picture cell (i, j) begins, in texels."""
    bits = _hashed(cells.key, np.int64(i), np.int64(j))
    step_x = np.int64(((bits & _LOW16) * np.uint64(cells.count_x)) >> _S16)
    step_y = np.int64(((bits >> _S48) * np.uint64(cells.count_y)) >> _S16)
    return step_x * cells.step_x, step_y * cells.step_y


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _blended_at(coef: NDArray[np.float32], cells: Cells, x: float, y: float) -> Any:
    """`grey_at` where several cells meet."""
    own_j = math.floor(y * cells.inverse_y)
    place_y = y - own_j * cells.side_y
    grey = 0.0
    for row in range(2 if place_y < cells.band_y else 1):
        j = own_j - row
        along = x * cells.inverse_x - j * cells.stagger
        i = math.floor(along)
        place_x = (along - i) * cells.side_x
        off_x, off_y = _offset(cells, i, j)
        off_y += place_y + row * cells.side_y
        here = np.float64(_spline_at(coef, place_x + off_x, off_y))
        if place_x < cells.band_x:
            off_x, off_y = _offset(cells, i - 1, j)
            off_y += place_y + row * cells.side_y
            before = np.float64(_spline_at(coef, place_x + cells.side_x + off_x, off_y))
            here = _blend(before, here, place_x / cells.band_x, cells.mean, cells.coherence_x)
        grey = here if row == 0 else _blend(here, grey, place_y / cells.band_y, cells.mean, cells.coherence_y)
    return np.float32(grey)


@nb.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def grey_at(coef: NDArray[np.float32], cells: Cells, x: float, y: float) -> Any:
    """Grey level float32 of a surface, given as its `coefficients` and `cells`, at texel (x, y).

    Cell (i, j) begins at ((i + j stagger) side_x, j side_y) and shows the periodic spline at an offset that is
    hashed of (key, i, j). Over the first `band` texels of a cell the one before fades out, along x and along y:
    inside one cell counts, in a band two, where bands cross four. Without cells it is the spline itself.
    """
    if cells.side_x > 0.0:
        j = np.floor(y * cells.inverse_y)
        place_y = y - j * cells.side_y
        along = x * cells.inverse_x - j * cells.stagger
        i = np.floor(along)
        place_x = (along - i) * cells.side_x
        if place_x < cells.band_x or place_y < cells.band_y:
            return _blended_at(coef, cells, x, y)
        offset = _offset(cells, i, j)
        x = place_x + offset[0]
        y = place_y + offset[1]
    return _spline_at(coef, x, y)
