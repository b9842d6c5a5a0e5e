"""Where a patrol's plane lies on Earth: the tangent plane of WGS 84 at an origin, x east and y north."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry import from_local_enu, local_enu

Floats = NDArray[np.float64]

DIGITS = 9
"""Decimals of degrees: 0.1 mm on the ground."""


@dataclass(frozen=True, slots=True)
class Origin:
    """The place of (0, 0, 0): latitude and longitude in rad, height above the ellipsoid in m.

    Raises:
        ValueError: it is no place on Earth.
    """

    latitude_rad: float
    longitude_rad: float
    altitude_m: float = 0.0

    def __post_init__(self) -> None:
        if not (abs(self.latitude_rad) <= math.pi / 2 and abs(self.longitude_rad) <= 2 * math.pi):
            latitude, longitude = math.degrees(self.latitude_rad), math.degrees(self.longitude_rad)
            raise ValueError(f"latitude {latitude:g}°, longitude {longitude:g}°: no place on Earth; are they swapped?")

    @classmethod
    def of_degrees(cls, latitude_deg: float, longitude_deg: float, altitude_m: float = 0.0) -> Origin:
        """The same in degrees."""
        return cls(math.radians(latitude_deg), math.radians(longitude_deg), altitude_m)

    @property
    def degrees(self) -> tuple[float, float, float]:
        """Latitude and longitude in degrees, altitude in m."""
        return math.degrees(self.latitude_rad), math.degrees(self.longitude_rad), self.altitude_m

    def enu(self, latitude_rad: Floats, longitude_rad: Floats, altitude_m: Floats | None = None) -> Floats:
        """East, north and up [n, 3] of places, each [n]; without altitude they are at the origin's height."""
        height = np.full(len(latitude_rad), self.altitude_m) if altitude_m is None else altitude_m
        found = local_enu(
            np.concatenate([[self.latitude_rad], latitude_rad]),
            np.concatenate([[self.longitude_rad], longitude_rad]),
            np.concatenate([[self.altitude_m], height]),
        )
        return found[1:]

    def geodetic(self, points_m: Floats, height_m: float = 0.0) -> Floats:
        """Latitude (°), longitude (°) and altitude (m) [n, 3] of points [n, 2] at a height over the plane."""
        enu = np.column_stack([points_m, np.full(len(points_m), height_m)])
        latitude, longitude, altitude = from_local_enu(enu, self.latitude_rad, self.longitude_rad, self.altitude_m)
        return np.column_stack([np.degrees(latitude).round(DIGITS), np.degrees(longitude).round(DIGITS), altitude])
