"""Errors of measured quantities: white noise by spectral density, bias, random walk, scale, whole ticks.

The spectral density σ of white noise on a quantity in `unit` is in unit/√Hz, as in rad/s/√Hz for a gyro:
one sample taken every dt = 1/rate has the standard deviation σ/√dt = σ·√rate, so that the integral of the
samples over T has σ·√T whatever the rate is. A random walk of the bias has its density in unit/s/√Hz: its
variance after T is σ²·T.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import scipy.signal
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Dice = Callable[[str], np.random.Generator]


def white(rng: np.random.Generator, shape: tuple[int, ...], density: float, rate_hz: float) -> Floats:
    """White noise of a spectral density in unit/√Hz, samples along the first axis, in the unit."""
    return np.asarray(density * np.sqrt(rate_hz) * rng.standard_normal(shape))


def random_walk(rng: np.random.Generator, shape: tuple[int, ...], density: float, rate_hz: float) -> Floats:
    """A random walk from 0 of a density in unit/s/√Hz, samples along the first axis, in the unit."""
    steps = rng.standard_normal(shape)
    steps[:1] = 0.0
    return np.asarray(density / np.sqrt(rate_hz) * np.cumsum(steps, axis=0))


def measured(
    true: Floats,
    dice: Dice,
    rate_hz: float,
    *,
    density: float = 0.0,
    bias: float | Sequence[float] = 0.0,
    walk: float = 0.0,
    scale: float = 0.0,
) -> Floats:
    """(1 + scale) · true + bias + random walk + white noise, samples along the first axis.

    Args:
        true: the quantity without errors [n] or [n, axes].
        dice: random numbers by name.
        rate_hz: samples per second.
        density: of the white noise, unit/√Hz.
        bias: a constant, unit, one or one for each axis.
        walk: density of the bias's random walk, unit/s/√Hz.
        scale: scale error, 0.01 for a hundredth too much.
    """
    noise = white(dice("white"), true.shape, density, rate_hz)
    drift = random_walk(dice("walk"), true.shape, walk, rate_hz)
    return np.asarray((1 + scale) * true + np.asarray(bias) + drift + noise)


def in_ticks(rng: np.random.Generator, speeds: Floats, tick: float, rate_hz: float) -> Floats:
    """Speeds [n, wheels] as encoders tell them that count whole ticks of way between two samples.

    The counts keep the remainder, so that the sum of the reported way is never off by more than a tick.
    """
    way = rng.random(speeds.shape[1:]) + np.cumsum(speeds, axis=0) / (rate_hz * tick)
    return np.asarray(np.diff(np.floor(way), axis=0, prepend=0.0) * tick * rate_hz)


def correlated(n: int, tau: float, rng: np.random.Generator) -> Floats:
    """Gaussian noise [n] of unit variance whose correlation falls to 1/e in `tau` samples: AR(1).

    x_k = a x_{k-1} + sqrt(1 - a²) w_k with a = exp(-1/τ), x_0 = w_0.
    """
    memory = math.exp(-1 / tau)
    shocks = rng.standard_normal(n)
    shocks[1:] *= math.sqrt(1 - memory**2)
    return np.asarray(scipy.signal.lfilter([1.0], [1.0, -memory], shocks))
