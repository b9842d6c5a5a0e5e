"""What a camera sees of flat ground: swath, footprint, ground sample distance, and the height that gives them.

World and body: z up, body x forward, y to the left. A camera that looks straight down has tilt 0; a positive
tilt raises its axis ahead. Angles of view are full angles, `across` and `along` the way of flight.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.lens import rays
from readers.streams import Camera

Floats = NDArray[np.float64]

BORDER_PIXELS = 9
"""Points on each side of the image whose rays outline the footprint of a lens that bends straight lines."""


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """What a camera on a body sees.

    Attributes:
        rays: directions [m, 3] of the image's border in body axes, in their order around it.
        axis: the optical axis [3] in body axes, of unit length.
        focal_px: focal length, NaN where the pixels are not known.
    """

    rays: Floats
    axis: Floats
    focal_px: float = math.nan

    @classmethod
    def of_angles(
        cls, across_rad: float, along_rad: float, *, tilt_rad: float = 0.0, across_px: float = math.nan
    ) -> View:
        """A pinhole camera that looks down, by its angles of view.

        Args:
            across_rad: angle of view across the way of flight.
            along_rad: angle of view along it.
            tilt_rad: angle of the axis from straight down, positive ahead.
            across_px: pixels of the image across the way.

        Raises:
            ValueError: an angle of view that no flat image has.
        """
        across, along = half_tangent(across_rad), half_tangent(along_rad)
        axis = np.array([math.sin(tilt_rad), 0.0, -math.cos(tilt_rad)])
        up, left = np.array([math.cos(tilt_rad), 0.0, math.sin(tilt_rad)]), np.array([0.0, 1.0, 0.0])
        signs = ((1, 1), (-1, 1), (-1, -1), (1, -1))
        border = np.array([axis + a * along * up + c * across * left for a, c in signs])
        return cls(border, axis, across_px / (2 * across))

    @classmethod
    def of_camera(cls, camera: Camera, body_r_camera: Floats) -> View:
        """A calibrated camera, its lens's distortion included, mounted with the rotation `body_r_camera` [3, 3].

        Raises:
            ValueError: a camera without calibration or size, or whose distortion does not reach its border.
        """
        if not (camera.width_px > 0 and camera.height_px > 0):
            raise ValueError("the camera's image has no size: give its angles of view")
        focal = math.sqrt(float(camera.matrix[0, 0] * camera.matrix[1, 1])) if camera.calibrated else math.nan
        border = rays(camera, _border(camera.width_px, camera.height_px))
        return cls(border @ body_r_camera.T, body_r_camera[:, 2], focal)

    def footprint(self, position_m: Floats, world_r_body: Floats, ground_m: float = 0.0) -> Floats:
        """Where the image's border lies [m, 2] on the level ground z = `ground_m`.

        A ray r from the camera's place p meets it at p + r (ground - p_z)/r_z.

        Args:
            position_m: place of the camera [3].
            world_r_body: attitude of its body [3, 3].
            ground_m: height of the ground.

        Raises:
            ValueError: the camera is not above the ground, or sees the horizon.
        """
        height = float(position_m[2]) - ground_m
        if not height > 0:
            raise ValueError(f"a camera {height:g} m above the ground sees nothing of it: check the ground's height")
        border = self.rays @ world_r_body.T
        if not (border[:, 2] < -1e-6).all():
            raise ValueError("the image reaches the horizon, so that its footprint has no end: tilt it less")
        return np.asarray(position_m[:2] - border[:, :2] * (height / border[:, 2:]))

    def sample_distance(
        self, points_m: Floats, position_m: Floats, world_r_body: Floats, ground_m: float = 0.0
    ) -> Floats:
        """Ground sample distance in m [n] at points [n, 2] on the ground: side of the square that a pixel covers.

        At depth d before a camera at height h a pixel covers the area d³/(f² h); straight below, d = h
        everywhere and the side is h/f. NaN where the pixels are not known.
        """
        height = float(position_m[2]) - ground_m
        toward = np.column_stack([points_m - position_m[:2], np.full(len(points_m), -height)])
        depth = toward @ (world_r_body @ self.axis)
        return np.asarray(np.sqrt(depth**3 / height) / self.focal_px)


def _border(width_px: int, height_px: int) -> Floats:
    """Points [m, 2] (u, v) around the image, on the outer edges of its pixels."""
    t = np.linspace(0.0, 1.0, BORDER_PIXELS)[:-1]
    zeros = np.zeros(len(t))
    sides = [(t, zeros), (zeros + 1, t), (1 - t, zeros + 1), (zeros, 1 - t)]
    return np.concatenate([np.column_stack([u * width_px, v * height_px]) for u, v in sides]) - 0.5


# ------------------------------------------------------------------- camera straight down


def half_tangent(angle_rad: float) -> float:
    """Tangent of half an angle of view.

    Raises:
        ValueError: an angle that no flat image has.
    """
    if not 0 < angle_rad < math.pi:
        raise ValueError(f"an angle of view of {math.degrees(angle_rad):g}°: it must be above 0° and below 180°")
    return math.tan(angle_rad / 2)


def angle_of_view(side_px: float, focal_px: float) -> float:
    """Angle of view of an image side, 2 atan(n/(2 f))."""
    return 2 * math.atan(side_px / (2 * focal_px))


def swath(height_m: float, angle_rad: float) -> float:
    """Width of what is seen from a height, a = 2 h tan(α/2) (paper C, patrol methods)."""
    return 2 * height_m * half_tangent(angle_rad)


def height_for_swath(swath_m: float, angle_rad: float) -> float:
    """The height from which a swath is seen, h = a/(2 tan(α/2))."""
    return swath_m / (2 * half_tangent(angle_rad))


def height_for_sample_distance(metres_per_px: float, angle_rad: float, side_px: int) -> float:
    """The height at which a pixel covers that much ground: the swath is then all pixels of the side."""
    return height_for_swath(metres_per_px * side_px, angle_rad)


def height_for_range(range_m: float, across_rad: float, along_rad: float = 0.0, tilt_rad: float = 0.0) -> float:
    """The greatest height from which everything in the image is nearer than a detector's range.

    The farthest point is at a corner ahead (behind, if tilted back), whose ray of unit depth is
    √(1 + c² + a²) long and falls by cos τ - a sin τ, with the half tangents c across and a along.

    Raises:
        ValueError: the image reaches the horizon.
    """
    across = half_tangent(across_rad)
    along = half_tangent(along_rad) if along_rad else 0.0
    fall = math.cos(tilt_rad) - along * abs(math.sin(tilt_rad))
    if fall <= 0:
        raise ValueError("the image reaches the horizon, beyond the range from every height: tilt it less")
    return range_m * fall / math.sqrt(1 + across**2 + along**2)
