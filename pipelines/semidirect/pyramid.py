"""Half-sampled copies of an image: each level is the 2 x 2 mean of the one before, in one buffer.

Pixel (0, 0) is the centre of the first pixel on every level, so a place u of level 0 is (u + ½)/2^l - ½ on level
l. An odd last row or column has no partner and is left out on the next level.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from pipelines.compiled import compiled

Grey = NDArray[np.uint8]

LEVELS = 5


class Pyramid(NamedTuple):
    """The levels of an image of `height` x `width` px, one after the other in `buffer` [size]."""

    buffer: Grey
    height: int
    width: int


def pyramid_of(image: Grey) -> Pyramid:
    """The five levels of a grey image [height, width].

    Raises:
        ValueError: an array that is not grey 8-bit, or too small to be halved four times.
    """
    if image.ndim != 2 or image.dtype != np.uint8:
        raise ValueError(f"a pyramid of {image.dtype} {list(image.shape)}: give it a grey 8-bit image [height, width]")
    height, width = image.shape
    if min(height, width) < 2 ** (LEVELS - 1):
        raise ValueError(f"an image of {width} x {height} px cannot be halved {LEVELS - 1} times; give a larger one")
    pyramid = Pyramid(np.empty(level_start(height, width, LEVELS), np.uint8), height, width)
    finer = level_image(pyramid, 0)
    finer[:] = image
    for level in range(1, LEVELS):
        coarser = level_image(pyramid, level)
        rows, columns = coarser.shape
        even = finer[: 2 * rows, : 2 * columns]
        cv2.resize(even, (columns, rows), dst=coarser, interpolation=cv2.INTER_AREA)
        finer = coarser
    return pyramid


@compiled
def level_start(height: int, width: int, level: int) -> int:
    """Where a level begins in the buffer; that of `LEVELS` is the buffer's size."""
    start = 0
    for k in range(level):
        start += (height >> k) * (width >> k)
    return start


@compiled
def level_image(pyramid: Pyramid, level: int) -> Grey:
    """One level [height >> level, width >> level], a view of the buffer."""
    rows, columns = pyramid.height >> level, pyramid.width >> level
    start = level_start(pyramid.height, pyramid.width, level)
    return pyramid.buffer[start : start + rows * columns].reshape((rows, columns))


@compiled
def on_level(u: float, level: int) -> float:
    """The coordinate on a level of a coordinate on level 0: (u + ½)/2^l - ½."""
    return (u + 0.5) / (1 << level) - 0.5


@compiled
def on_finest(u: float, level: int) -> float:
    """The coordinate on level 0 of a coordinate on a level: the inverse of `on_level`."""
    return (u + 0.5) * (1 << level) - 0.5


@compiled
def sample(image: Grey, u: float, v: float) -> float:
    """Grey level at a real place, bilinear; the place must lie within the image: 0 <= u < columns - 1, v alike."""
    column, row = int(u), int(v)
    f, g = u - column, v - row
    above = (1 - f) * image[row, column] + f * image[row, column + 1]
    below = (1 - f) * image[row + 1, column] + f * image[row + 1, column + 1]
    return float((1 - g) * above + g * below)
