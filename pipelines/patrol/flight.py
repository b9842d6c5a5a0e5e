"""A planned flight as a simulated one: from waypoint to waypoint, stopping and turning at each."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pipelines.patrol.plan import Flight
from pipelines.patrol.vehicle import STRAIGHT_RAD
from pipelines.simulation.curves import line
from pipelines.simulation.driving import Chain, Drive, Placed, Turn
from pipelines.simulation.motion import Motion
from pipelines.simulation.speeds import trapezoid

Floats = NDArray[np.float64]


def stretches(points: Floats) -> list[tuple[float, float]]:
    """A polyline [n, 2] from heading 0 on: the turn in rad before each of its stretches, and its length in m."""
    ways = np.diff(points, axis=0)
    headings = np.arctan2(ways[:, 1], ways[:, 0])
    turned = (np.diff(headings, prepend=0.0) + np.pi) % (2 * np.pi) - np.pi
    return list(zip(turned.tolist(), np.hypot(*ways.T).tolist(), strict=True))


def motion(flight: Flight, *, speed_mps: float, acceleration_mps2: float = 1.0, turn_rate_radps: float = 1.0) -> Motion:
    """The flight's motion in the plan's coordinates, at the height of the camera's mounting.

    Args:
        flight: what is flown.
        speed_mps: greatest speed over ground.
        acceleration_mps2: up to it, and down again before each corner.
        turn_rate_radps: mean rate of turn in the corners.

    Raises:
        ValueError: a speed, acceleration or rate that is not positive.
    """
    if not (speed_mps > 0 and acceleration_mps2 > 0 and turn_rate_radps > 0):
        raise ValueError("speed, acceleration and rate of turn of a simulated flight must be positive")
    chain: list[Motion] = []
    points = flight.points
    for turn, length in stretches(points):
        if abs(turn) > 1e-9:
            chain.append(Turn(turn, max(abs(turn), STRAIGHT_RAD) / turn_rate_radps))
        chain.append(Drive(line(), trapezoid(length, speed_mps, acceleration_mps2)))
    return Placed(Chain(chain), x_m=float(points[0, 0]), y_m=float(points[0, 1]))


def trigger_times(motion: Motion, distance_m: float, rate_hz: float = 100.0) -> Floats:
    """Times in s [n] at which a motion has gone on by a distance since the last picture, the first at 0."""
    t_s = np.arange(0.0, motion.duration_s, 1 / rate_hz)
    gone = np.floor(_path_lengths(motion.at(t_s).position_m) / distance_m + 1e-9)
    return np.asarray(t_s[np.concatenate([[True], np.diff(gone) > 0])])


def _path_lengths(position_m: Floats) -> Floats:
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(position_m[:, :2], axis=0).T))])


def picture_spacing(along_m: float, overlap: float) -> float:
    """Distance between pictures that overlap ahead by a share of the footprint's length.

    Raises:
        ValueError: no length, or no share below 1.
    """
    if not (0 < along_m < math.inf and 0 <= overlap < 1):
        raise ValueError(f"pictures of {along_m:g} m that overlap by {overlap:g}: give a length and a share below 1")
    return along_m * (1 - overlap)
