"""Coarser copies of a surface, so that a pixel that sees much of it sees its mean and no moiré."""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from pipelines.simulation.surfaces import NO_CELLS, PSF_SIGMA_PX, WRAP, Cells, Surface

Floats = NDArray[np.float64]

LEVELS = 9  # the surface, seven coarser copies each of half the texels per metre, and its mean


class Level(NamedTuple):
    """One copy of a surface as the compiled renderer takes it: its coefficients float32 [rows + 3, columns + 3]."""

    coefficients: NDArray[np.float32]
    cells: Cells


Levels = tuple[Level, ...]


def level(coefficients: NDArray[np.float32], cells: Cells) -> Level:
    """A level of coefficients that nobody can write to, so that the compiled code meets one type only."""
    locked = coefficients.view()
    locked.setflags(write=False)
    return Level(locked, cells)


def sharp_only(surface: Surface) -> Levels:
    """The surface in place of all its `LEVELS`, for a view that needs no coarser one."""
    return (level(surface.coefficients, surface.cells),) * LEVELS


def levels_of(surface: Surface) -> Levels:
    """The surface, coarser and coarser copies, and its mean in the end: `LEVELS` in all."""
    copies = [surface]
    while len(copies) < LEVELS - 1:
        copies.append(coarser(copies[-1]))
    mean = np.full((1 + WRAP, 1 + WRAP), copies[-1].coefficients[1:-2, 1:-2].mean(), dtype=np.float32)
    return (*(level(copy.coefficients, copy.cells) for copy in copies), level(mean, NO_CELLS))


def coarser(surface: Surface) -> Surface:
    """The same ground as a camera of half the resolution would have taken it: half the texels per metre.

    In the frequency domain: the point-spread function widens from `PSF_SIGMA_PX` to twice that, what the
    coarser pixels cannot hold fades out (over the upper half of what they can, so that edges do not ring), and
    coefficients of the wider spline take the place of the old ones.
    An odd number of rows or columns is repeated once, since half of it is no whole number.
    """
    period = surface.coefficients[1 : 1 - WRAP, 1 : 1 - WRAP].astype(np.float64)
    period = np.tile(period, [1 + n % 2 for n in period.shape])
    rows, columns = period.shape
    spectrum = scipy.fft.rfft2(period)
    half = np.zeros((rows // 2, columns // 4 + 1), dtype=np.complex128)
    highest = [math.ceil(n / (4 * surface.texels_per_px)) - 1 for n in (rows, columns)]
    down, across = np.arange(-highest[0], highest[0] + 1), np.arange(highest[1] + 1)
    kept = np.ix_(down, across)
    sigma = math.sqrt(3) * PSF_SIGMA_PX * surface.texels_per_px
    half[kept] = spectrum[kept] * np.outer(_gain(down, rows, sigma), _gain(across, columns, sigma)) / 4
    coefficients = np.pad(scipy.fft.irfft2(half, (rows // 2, columns // 2)), (1, WRAP - 1), mode="wrap")
    coefficients = coefficients.astype(np.float32)
    coefficients.setflags(write=False)
    return dataclasses.replace(surface, coefficients=coefficients, metres_per_px=2 * surface.metres_per_px)


def _gain(cycles: NDArray[np.int64], n: int, sigma: float) -> Floats:
    """From spline coefficients to wider ones: Gaussian, fading, old response (2 + cos ω)/3 by the new one at 2 ω."""
    w = 2 * np.pi * cycles / n
    fading = np.cos(np.pi * np.clip(np.abs(cycles) / (cycles.max() + 1) - 0.5, 0, 0.5)) ** 2
    return np.asarray(fading * np.exp(-0.5 * (sigma * w) ** 2) * (2 + np.cos(w)) / (2 + np.cos(2 * w)))
