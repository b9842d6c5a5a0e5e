"""Driven paths, frame by frame: poses [n, 3] of x in m, y in m and heading in rad, one per frame.

World: z up, headings counter-clockwise from +x. A path is a curve in closed form, driven by a speed for
every frame interval; the pose lies on the curve and its heading is the tangent, both to the last digits,
because each frame's curve parameter is solved for the exact arc length. The same drive as a continuous
motion, with velocities and rates, is `driving.Drive`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipelines.simulation.curves import CURVES, Curve, circle, curve, figure_eight, line, serpentine, spiral
from pipelines.simulation.speeds import RATE_HZ, SPEEDS, jittery_speed, ramp, speed, wavy_speed

__all__ = [
    "CURVES",
    "RATE_HZ",
    "SPEEDS",
    "Curve",
    "ahead",
    "circle",
    "curve",
    "drive",
    "figure_eight",
    "follow",
    "image_motion",
    "jittery_speed",
    "line",
    "ramp",
    "serpentine",
    "speed",
    "spiral",
    "standstill",
    "wavy_speed",
]

Floats = NDArray[np.float64]


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
    arc_m = np.concatenate([[0.0], np.cumsum(lengths_m)])
    at = curve.measured(float(arc_m.min()), float(arc_m.max()))(arc_m)
    return np.column_stack([*at.point_m, at.heading_rad])


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
