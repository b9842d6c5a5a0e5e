"""Planar driven paths: poses [n, 3] of x in m, y in m and heading in rad, one per frame.

World: z up, headings counter-clockwise from +x. A path is a curve given in closed form, driven by a
speed for every frame interval; the pose lies on the curve and its heading is the tangent, both to the
last digits, because each frame's curve parameter is solved for the exact arc length.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

RATE_HZ = 60.0
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(8)


@dataclass(frozen=True, slots=True)
class Curve:
    """A plane curve: `point` and its derivative `tangent` map parameters [...] to metres [..., 2]."""

    point: Callable[[Floats], Floats]
    tangent: Callable[[Floats], Floats]


def line(heading_rad: float = 0.0) -> Curve:
    """A straight line from the origin."""
    way = np.array([math.cos(heading_rad), math.sin(heading_rad)])
    return Curve(lambda t: np.multiply.outer(t, way), lambda t: np.broadcast_to(way, (*np.shape(t), 2)))


def circle(radius_m: float = 1.2) -> Curve:
    """A circle from the origin, starting along +x, to the left for a positive radius."""
    return Curve(
        lambda t: radius_m * np.stack([np.sin(t), 1 - np.cos(t)], axis=-1),
        lambda t: radius_m * np.stack([np.cos(t), np.sin(t)], axis=-1),
    )


def figure_eight(length_m: float = 3.45, width_m: float = 1.37) -> Curve:
    """The figure eight (length sin t, width sin 2t) of the paper's test, 18 m a round."""
    return Curve(
        lambda t: np.stack([length_m * np.sin(t), width_m * np.sin(2 * t)], axis=-1),
        lambda t: np.stack([length_m * np.cos(t), 2 * width_m * np.cos(2 * t)], axis=-1),
    )


def spiral(start_m: float = 0.5, pitch_m: float = 0.6) -> Curve:
    """An Archimedean spiral that opens by `pitch_m` a turn and never meets itself."""
    rate = pitch_m / (2 * math.pi)

    def point(t: Floats) -> Floats:
        return np.asarray((start_m + rate * t)[..., None] * np.stack([np.cos(t), np.sin(t)], axis=-1))

    def tangent(t: Floats) -> Floats:
        along = np.stack([np.cos(t), np.sin(t)], axis=-1)
        across = np.stack([-np.sin(t), np.cos(t)], axis=-1)
        return np.asarray(rate * along + (start_m + rate * t)[..., None] * across)

    return Curve(point, tangent)


def serpentine(amplitude_m: float = 0.4, wavelength_m: float = 2.4) -> Curve:
    """A sine along +x."""
    k = 2 * math.pi / wavelength_m
    return Curve(
        lambda t: np.stack([t, amplitude_m * np.sin(k * t)], axis=-1),
        lambda t: np.stack([np.ones_like(t), amplitude_m * k * np.cos(k * t)], axis=-1),
    )


def jittery_speed(
    n_frames: int, speed_mps: float, rng: np.random.Generator, *, share: float = 0.10, tau_frames: float = 14.0
) -> Floats:
    """Speed [n_frames] with AR(1) jitter of standard deviation `share`: slow driving (2 km/h)."""
    memory = math.exp(-1 / tau_frames)
    shocks = rng.standard_normal(n_frames)
    jitter = np.empty(n_frames)
    jitter[0] = shocks[0]
    for k in range(1, n_frames):
        jitter[k] = memory * jitter[k - 1] + math.sqrt(1 - memory**2) * shocks[k]
    return speed_mps * (1 + share * jitter)


def wavy_speed(
    n_frames: int, speed_mps: float, rng: np.random.Generator, *, share: float = 0.035, period_frames: float = 240.0
) -> Floats:
    """Speed [n_frames] with slow waves of amplitude `share`: fast driving (8 and 15 km/h)."""
    phase = rng.uniform(0, 2 * math.pi)
    return np.asarray(speed_mps * (1 + share * np.sin(2 * math.pi * np.arange(n_frames) / period_frames + phase)))


def ramp(n_frames: int, ramp_frames: int = 40) -> Floats:
    """Smooth rise [n_frames] from 0 to 1 over `ramp_frames` frames: 3x² - 2x³."""
    x = np.clip(np.arange(n_frames) / max(ramp_frames, 1), 0, 1) if ramp_frames else np.ones(n_frames)
    return np.asarray(x * x * (3 - 2 * x))


def drive(
    curve: Curve,
    n_frames: int,
    *,
    speed_mps: float,
    rng: np.random.Generator,
    rate_hz: float = RATE_HZ,
    ramp_frames: int = 40,
    lever_m: float = 0.0,
) -> Floats:
    """Drive a curve as the paper's vehicle does: poses [n_frames, 3] of the camera.

    From a standstill up to `speed_mps` within `ramp_frames`, then jittery below 5 km/h and wavy above.
    The paper's "2 km/h" are 0.51 m/s in the mean. The camera sits `lever_m` ahead of the turning point.
    """
    profile = jittery_speed if speed_mps < 5 / 3.6 else wavy_speed
    speeds = profile(n_frames, speed_mps, rng) * ramp(n_frames, ramp_frames)
    return ahead(follow(curve, speeds[:-1] / rate_hz), lever_m)


def follow(curve: Curve, lengths_m: Floats) -> Floats:
    """Poses [n + 1, 3] on a curve after the given arc lengths [n]; negative lengths drive in reverse."""
    t = np.zeros(len(lengths_m) + 1)
    for k, length in enumerate(lengths_m):
        t[k + 1] = _advance(curve, t[k], float(length))
    tangent = curve.tangent(t)
    heading = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
    return np.column_stack([curve.point(t), heading])


def standstill(n_frames: int, pose: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Floats:
    """The same pose [n_frames, 3] for every frame."""
    return np.tile(np.array(pose, dtype=np.float64), (n_frames, 1))


def ahead(poses: Floats, lever_m: float) -> Floats:
    """Poses [n, 3] of a camera that sits `lever_m` ahead of the body's turning point."""
    heading = poses[:, 2]
    lever = lever_m * np.column_stack([np.cos(heading), np.sin(heading), np.zeros(len(poses))])
    return np.asarray(poses + lever)


def image_motion(poses: Floats, metres_per_px: float) -> tuple[Floats, Floats]:
    """What an exact odometer would read between consecutive poses [n, 3] of the camera.

    Returns:
        Shift (u, v) in px [n - 1, 2] of the image content at the image centre, in the axes of the later
        frame (forward motion is a negative u), and turn in rad [n - 1], counter-clockwise positive.
    """
    back = poses[:-1, :2] - poses[1:, :2]
    cos, sin = np.cos(poses[1:, 2]), np.sin(poses[1:, 2])
    forward, left = cos * back[:, 0] + sin * back[:, 1], cos * back[:, 1] - sin * back[:, 0]
    return np.column_stack([forward, -left]) / metres_per_px, np.diff(poses[:, 2])


def _advance(curve: Curve, start: float, length_m: float) -> float:
    """The parameter at the signed arc length `length_m` after `start`, by Newton's method."""
    t = start
    for _ in range(20):
        half = (t - start) / 2
        speeds = np.linalg.norm(curve.tangent(start + half * (1 + _NODES)), axis=-1)
        missing = length_m - half * float(_WEIGHTS @ speeds)
        step = missing / float(np.linalg.norm(curve.tangent(np.array(t))))
        t += step
        if abs(step) <= 1e-15 * max(1.0, abs(t)):
            break
    return t
