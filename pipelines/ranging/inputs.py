"""From speeds measured at their own times to intervals of constant speeds between which the images lie.

Gyro, odometer and camera each have their own clock ticks. Every tick of any of them ends an interval; what the
speeds are within it is a choice, of which the paper's own loses most of the way.
"""

from __future__ import annotations

from enum import StrEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Longs = NDArray[np.int64]


class Synchronisation(StrEnum):
    """What the speeds are between two ticks."""

    HOLD_BOTH = "hold-both"
    """The last values of both, up to the next ones; needs no sample from the future."""
    MIDPOINT = "midpoint"
    """Both interpolated at the middle of the interval, held after the last sample; needs a buffer."""
    AS_PRINTED = "as-printed"
    """The interval since the last message of any type, with the new message's speed; the other speed is 0."""


class Intervals(NamedTuple):
    """Intervals from the first image on.

    Attributes:
        dt: lengths [m], s.
        omega: rates of turn [..., m], rad/s.
        speed: speeds [..., m], m/s.
        frame: number of the image at the end of each interval, -1 for none [m].
        age_s: age of the ω and V samples at the middle of each interval [m, 2], s; negative: from the future.
    """

    dt: Floats
    omega: Floats
    speed: Floats
    frame: Longs
    age_s: Floats


def intervals(
    omega_s: Floats,
    omega: Floats,
    speed_s: Floats,
    speed: Floats,
    frame_s: Floats,
    how: Synchronisation = Synchronisation.HOLD_BOTH,
) -> Intervals:
    """Intervals of constant speeds from the first to the last image.

    Before the first sample of a speed its first value counts.

    Args:
        omega_s: times of the rates of turn [i], s, rising.
        omega: rates of turn [..., i], rad/s.
        speed_s: times of the speeds [j], s, rising.
        speed: speeds [..., j], m/s.
        frame_s: times of the images [k], s, rising.
        how: what the speeds are between two ticks.

    Raises:
        ValueError: times that do not rise, or nothing of a kind.
    """
    for name, times in (("omega_s", omega_s), ("speed_s", speed_s), ("frame_s", frame_s)):
        if not len(times):
            raise ValueError(f"{name} is empty: ranging needs rates of turn, speeds and images")
        if (np.diff(times) <= 0).any():
            raise ValueError(f"{name} does not rise: sort the samples by time and leave out repetitions")
    ticks = np.unique(np.concatenate([omega_s, speed_s, frame_s]))
    edges = ticks[(ticks >= frame_s[0]) & (ticks <= frame_s[-1])]
    begin, end = edges[:-1], edges[1:]
    middle = 0.5 * (begin + end)
    frame = np.where(np.isin(end, frame_s), np.searchsorted(frame_s, end), -1)
    ages, values = [], []
    for times, samples in ((omega_s, omega), (speed_s, speed)):
        last = (np.searchsorted(times, begin, side="right") - 1).clip(0)
        ages.append(middle - times[last])
        if how is Synchronisation.MIDPOINT:
            after = (last + 1).clip(max=len(times) - 1)
            gap = times[after] - times[last]
            share = np.where(gap > 0, (middle - times[last]) / np.where(gap > 0, gap, 1.0), 0.0).clip(0.0)
            values.append(samples[..., last] * (1.0 - share) + samples[..., after] * share)
        elif how is Synchronisation.HOLD_BOTH:
            values.append(samples[..., last])
        else:
            at = np.searchsorted(times, end).clip(max=len(times) - 1)
            values.append(np.where(times[at] == end, samples[..., at], 0.0))
    if how is Synchronisation.AS_PRINTED:
        # of two messages with one stamp the first takes the whole interval
        values[0] = np.where(np.isin(end, speed_s), 0.0, values[0])
    return Intervals(end - begin, values[0], values[1], frame.astype(np.int64), np.stack(ages, axis=1))
