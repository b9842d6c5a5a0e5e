"""RVL, the lossless coding of depth images (A. D. Wilson, "Fast lossless depth image compression", ISS 2017).

Runs of zeros and runs of values alternate. A number is a chain of nibbles, the least significant three bits first, the
fourth bit of each saying that another one follows; nibbles stand in words of 32 bits, the highest first. A value is
the difference to the value before it, its sign folded into the lowest bit.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray


@numba.njit(cache=True)  # type: ignore[untyped-decorator, unused-ignore]
def _number(words: NDArray[np.uint32], at: int) -> tuple[int, int]:
    """The number that begins at nibble `at`, and where the next one begins; -1 where the words end before it."""
    value, shift = 0, 0
    while at < 8 * len(words) and shift < 33:
        nibble = (int(words[at >> 3]) >> (28 - 4 * (at & 7))) & 15
        value |= (nibble & 7) << shift
        shift += 3
        at += 1
        if nibble < 8:
            return value, at
    return -1, at


@numba.njit(cache=True)  # type: ignore[untyped-decorator, unused-ignore]
def _unpack(words: NDArray[np.uint32], pixels: NDArray[np.uint16]) -> bool:
    """Fill `pixels` [n]; False where the words end too early or state more pixels than there are."""
    at, done, value = 0, 0, 0
    while done < len(pixels):
        zeros, at = _number(words, at)
        if zeros < 0 or zeros > len(pixels) - done:
            return False
        done += zeros
        if done == len(pixels):
            return True
        values, at = _number(words, at)
        if values < 0 or values > len(pixels) - done or (zeros == 0 and values == 0):
            return False
        for _ in range(values):
            folded, at = _number(words, at)
            if folded < 0:
                return False
            value += (folded >> 1) ^ -(folded & 1)
            pixels[done] = value & 0xFFFF
            done += 1
    return True


def unpack(data: bytes | memoryview, count: int) -> NDArray[np.uint16]:
    """The `count` values that are packed in `data`.

    Raises:
        ValueError: the data end too early or state more values.
    """
    words = np.frombuffer(data, "<u4", len(data) // 4)
    pixels = np.zeros(count, np.uint16)
    if not _unpack(words, pixels):
        raise ValueError(f"its {len(data)} bytes do not hold {count} px")
    return pixels
