"""The grey level of a surface at a point: the compiled heart of the renderer."""

from __future__ import annotations

import math
from typing import Any

import numba as nb
import numpy as np
from numpy.typing import NDArray

from pipelines.simulation.surfaces import WRAP

_SIXTH = np.float32(1 / 6)
_ONE, _THREE, _FOUR, _SIX = (np.float32(x) for x in (1, 3, 4, 6))


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
def grey_at(coef: NDArray[np.float32], x: float, y: float) -> Any:
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
