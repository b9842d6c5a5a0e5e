"""How fast a vehicle gets along a way, and what that costs: wind, turns on the spot or in arcs, energy."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

STRAIGHT_RAD = math.radians(1.0)
"""A bend up to here is no turn that takes time."""


@dataclass(frozen=True, slots=True)
class Vehicle:
    """A vehicle that flies at a constant speed through the air.

    Attributes:
        speed_mps: speed through the air.
        turn_s: time lost at each corner.
        turn_radius_m: least radius of a turn; 0 turns on the spot.
        wind_mps: velocity of the air, along x and y.
        power_w: power drawn in flight, NaN where not known.

    Raises:
        ValueError: no speed, a negative time, radius or power, or a wind that is not slower than the vehicle.
    """

    speed_mps: float = 3.0
    turn_s: float = 0.0
    turn_radius_m: float = 0.0
    wind_mps: tuple[float, float] = (0.0, 0.0)
    power_w: float = math.nan

    def __post_init__(self) -> None:
        if not 0 < self.speed_mps < math.inf:
            raise ValueError(f"a speed of {self.speed_mps:g} m/s: it must be positive")
        for name in ("turn_s", "turn_radius_m"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name} is {getattr(self, name):g}: it must be 0 or more")
        if not (math.isnan(self.power_w) or 0 < self.power_w < math.inf):
            raise ValueError(f"a power of {self.power_w:g} W: it must be positive")
        if not math.hypot(*self.wind_mps) < self.speed_mps:
            raise ValueError(
                f"a wind of {math.hypot(*self.wind_mps):g} m/s against a speed of {self.speed_mps:g} m/s: "
                "nothing can be flown upwind; fly faster or wait"
            )

    def ground_speed(self, ways: Floats) -> Floats:
        """Speed over ground in m/s [...] along ways [..., 2], the vehicle heading into the wind by its drift angle.

        v = W·d + √(v_a² - (W × d)²) for wind W, airspeed v_a and unit direction d: the wind triangle.
        """
        length = np.hypot(ways[..., 0], ways[..., 1])
        d = ways / np.where(length > 0, length, 1.0)[..., None]
        wx, wy = self.wind_mps
        along, across = wx * d[..., 0] + wy * d[..., 1], wx * d[..., 1] - wy * d[..., 0]
        return np.asarray(along + np.sqrt(self.speed_mps**2 - across**2))

    def travel_s(self, ways: Floats) -> Floats:
        """Time in s [...] of straight ways [..., 2]."""
        return np.asarray(np.hypot(ways[..., 0], ways[..., 1]) / self.ground_speed(ways))

    def duration_s(self, points: Floats) -> float:
        """Time of a polyline [n, 2], with what its corners cost; in arcs, that is nothing but their length."""
        ways = np.diff(points, axis=0)
        corners = 0 if self.turn_radius_m > 0 else corner_count(points)
        return float(self.travel_s(ways).sum()) + self.turn_s * corners


def corner_count(points: Floats) -> int:
    """How many bends of a polyline [n, 2] are turns."""
    ways = np.diff(points, axis=0)
    ways = ways[np.hypot(*ways.T) > 1e-6]
    headings = np.arctan2(ways[:, 1], ways[:, 0])
    turns = (np.diff(headings) + np.pi) % (2 * np.pi) - np.pi
    return int((np.abs(turns) > STRAIGHT_RAD).sum())
