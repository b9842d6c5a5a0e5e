"""Smooth functions of time with exact derivatives: what height, roll, pitch and sideslip do."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import scipy.special
from numpy.typing import NDArray

from pipelines.simulation.channels import rng_of

Floats = NDArray[np.float64]

BAND = 3.0  # a fluctuation's spectrum ends at so many standard deviations of its frequencies


class Signal(Protocol):
    """A function of time that is differentiable twice."""

    def at(self, t_s: Floats) -> tuple[Floats, Floats, Floats]:
        """Value, first and second derivative [n] at times [n] in seconds."""
        ...


def smooth_step(x: Floats) -> tuple[Floats, Floats, Floats]:
    """10x³ - 15x⁴ + 6x⁵, 0 below 0 and 1 above 1, with its first and second derivative."""
    x = np.clip(x, 0.0, 1.0)
    return (
        x**3 * (10 + x * (6 * x - 15)),
        30 * x**2 * (1 - x) ** 2,
        60 * x * (1 - x) * (1 - 2 * x),
    )


@dataclass(frozen=True, slots=True)
class Constant:
    """Always `value`."""

    value: float

    def at(self, t_s: Floats) -> tuple[Floats, Floats, Floats]:
        """The value, and zeros."""
        return np.full(np.shape(t_s), self.value), np.zeros(np.shape(t_s)), np.zeros(np.shape(t_s))


def as_signal(signal: Signal | float) -> Signal:
    """A number as the signal that is always that number; signals as they are."""
    return Constant(float(signal)) if isinstance(signal, int | float) else signal


@dataclass(frozen=True, slots=True, eq=False)
class Schedule:
    """Values at given times, joined by quintic smooth steps, constant before the first and after the last.

    Args:
        t_s: times [n], rising.
        values: values [n]; at these times both derivatives are 0.

    Raises:
        ValueError: the times do not rise, or the two differ in length.
    """

    t_s: Floats
    values: Floats

    def __post_init__(self) -> None:
        t_s, values = rising_knots(self.t_s, self.values)
        object.__setattr__(self, "t_s", t_s)
        object.__setattr__(self, "values", values)

    def at(self, t_s: Floats) -> tuple[Floats, Floats, Floats]:
        """Value, first and second derivative [n]."""
        if len(self.t_s) == 1:
            return Constant(float(self.values[0])).at(t_s)
        k = np.clip(np.searchsorted(self.t_s, t_s, side="right") - 1, 0, len(self.t_s) - 2)
        span, rise = self.t_s[k + 1] - self.t_s[k], self.values[k + 1] - self.values[k]
        step, slope, bend = smooth_step((t_s - self.t_s[k]) / span)
        return self.values[k] + rise * step, rise / span * slope, rise / span**2 * bend


@dataclass(frozen=True, slots=True, eq=False)
class Fluctuation:
    """A sum of K cosines of one amplitude about a mean: a stationary process, smooth without end.

    `fluctuation` draws one of a given rms and correlation time.

    Attributes:
        mean: mean over time.
        amplitude: amplitude of every cosine.
        frequency_radps: angular frequencies [K].
        phase_rad: phases [K].
    """

    mean: float
    amplitude: float
    frequency_radps: Floats
    phase_rad: Floats

    def at(self, t_s: Floats) -> tuple[Floats, Floats, Floats]:
        """Value, first and second derivative [n]."""
        w = self.frequency_radps
        phase = np.multiply.outer(t_s, w) + self.phase_rad
        cos, sin = np.cos(phase), np.sin(phase)
        a = self.amplitude
        # the sums run along the contiguous axis, so that their order does not depend on the number of times
        return self.mean + a * cos.sum(-1), -a * (sin * w).sum(-1), -a * (cos * w**2).sum(-1)


def fluctuation(rms: float, tau_s: float, *, seed: int, name: str, mean: float = 0.0, n_waves: int = 32) -> Fluctuation:
    """A random process of standard deviation `rms` about `mean` whose correlation is exp(-(lag/tau_s)²).

    That correlation belongs to angular frequencies that are normally distributed with standard deviation
    √2/τ (Wiener-Khinchin). One frequency is drawn from each of K equally likely bands up to `BAND`
    standard deviations, with a random phase; amplitudes are rms √(2/K), so that the rms over time is exact.

    Args:
        rms: standard deviation.
        tau_s: time after which the correlation has fallen to 1/e.
        seed: seed of the mission.
        name: what fluctuates; other names give unrelated processes.
        mean: constant offset.
        n_waves: number of cosines K.

    Raises:
        ValueError: a negative rms, a correlation time or a number of waves that is not positive.
    """
    if rms < 0 or tau_s <= 0 or n_waves < 1:
        raise ValueError(
            f"a fluctuation of rms {rms}, correlation time {tau_s} s, {n_waves} waves: rms ≥ 0, others > 0"
        )
    rng = rng_of(seed, "fluctuation", name)
    share = (np.arange(n_waves) + rng.uniform(size=n_waves)) / n_waves * math.erf(BAND / math.sqrt(2))
    return Fluctuation(
        mean=mean,
        amplitude=rms * math.sqrt(2 / n_waves),
        frequency_radps=math.sqrt(2) / tau_s * scipy.special.ndtri((1 + share) / 2),
        phase_rad=rng.uniform(0, 2 * math.pi, n_waves),
    )


def rising_knots(t_s: Floats, values: Floats) -> tuple[Floats, Floats]:
    """Times and values as arrays [n].

    Raises:
        ValueError: there is none, the two differ in length, a number is not finite, or the times do not rise.
    """
    times, heights = np.asarray(t_s, dtype=np.float64), np.asarray(values, dtype=np.float64)
    if times.ndim != 1 or times.shape != heights.shape or not len(times):
        raise ValueError(f"{times.shape} times and {heights.shape} values: give one value for each time")
    if not (np.all(np.isfinite(times)) and np.all(np.isfinite(heights))):
        raise ValueError("times and values must be finite numbers")
    if np.any(np.diff(times) <= 0):
        raise ValueError("times must rise from each to the next")
    return times, heights
