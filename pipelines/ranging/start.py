"""Where a landmark's filter starts: X₀ and the full P₀, by four ways (paper B, section 4, "reliability").

A start is exact to first order: P₀ is propagated from the errors of what it was made of, so that ξ correlates with
the image point where both came from the same pixel. Axes are those of `equations.py`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipelines.ranging.equations import Held
from pipelines.ranging.settings import Model

Floats = NDArray[np.float64]

COMPLEX_STEP = 1e-30


class Start(NamedTuple):
    """X₀ = [x, y, ξ] [3] (px, px, 1/m) and P₀ [3, 3]."""

    state: Floats
    covariance: Floats


@dataclass(frozen=True, slots=True)
class CameraMotion:
    """Motion of the camera between two frames: a fixed point moves by P' = R(turn) P + shift in camera axes.

    Attributes:
        turn_rad: to the right, about y.
        shift_m: (x, z) [2].
        covariance: of (turn, x, z) [3, 3].
    """

    turn_rad: float
    shift_m: Floats
    covariance: Floats

    @classmethod
    def none(cls) -> CameraMotion:
        """No motion, known exactly."""
        return cls(0.0, np.zeros(2), np.zeros((3, 3)))

    def then(self, h: Held, q_omega: float, q_speed: float) -> CameraMotion:
        """This motion, followed by an interval whose speeds have the variances of Q_c / dt."""
        rotation = np.array([[h.cos, -h.sin], [h.sin, h.cos]])
        slope = np.array([[-h.sin, -h.cos], [h.cos, -h.sin]])
        keep = np.eye(3)
        keep[1:, 1:] = rotation
        by_omega = slope @ self.shift_m * h.dt + h.speed * np.array([h.c_omega, -h.s_omega])
        gain = np.array([[h.dt, 0.0], [by_omega[0], h.c], [by_omega[1], -h.s]])
        return CameraMotion(
            self.turn_rad + h.omega * h.dt,
            rotation @ self.shift_m + h.speed * np.array([h.c, -h.s]),
            keep @ self.covariance @ keep.T + gain @ np.diag([q_omega, q_speed]) @ gain.T,
        )


def from_broad_prior(pixel: Floats, pixel_variance: float, nearest_m: float) -> Start:
    """Nothing is known but that no landmark is nearer than Z_min: ξ₀ = 1/(2 Z_min), σ_ξ = ξ₀/2.

    Raises:
        ValueError: `nearest_m` is not positive.
    """
    if not nearest_m > 0.0:
        raise ValueError(f"nearest_m must be positive, not {nearest_m}")
    xi = 0.5 / nearest_m
    return Start(np.array([*pixel, xi]), np.diag([pixel_variance, pixel_variance, (0.5 * xi) ** 2]))


def from_range(pixel: Floats, pixel_variance: float, range_m: float, sigma_m: float) -> Start:
    """The depth is roughly known: σ_ξ = σ_Z / Z².

    Raises:
        ValueError: the depth or its σ is not positive.
    """
    if not (range_m > 0.0 and sigma_m > 0.0):
        raise ValueError(f"range_m and sigma_m must be positive, not {range_m} and {sigma_m}")
    sigma = sigma_m / range_m**2
    return Start(np.array([*pixel, 1.0 / range_m]), np.diag([pixel_variance, pixel_variance, sigma**2]))


def from_plane(
    model: Model, pixel: Floats, pixel_variance: float, normal_in_cam: Floats, distance_m: float, sigma_m: float
) -> Start:
    """Known geometry of the room: the landmark lies on the plane n · P = distance (a wall, the floor).

    ξ = n · (a, b, 1) / distance, so an oblique wall correlates ξ with the image point.

    Args:
        model: settings and camera.
        pixel: image point [2].
        pixel_variance: of its coordinates, px².
        normal_in_cam: n [3], of length 1, away from the camera.
        distance_m: of the plane from the camera.
        sigma_m: of that distance.

    Raises:
        ValueError: the line of sight does not meet the plane in front of the camera.
    """

    def inverse_depth(p: Any) -> Any:
        return normal_in_cam @ _ray(model, p[:2]) / p[2]

    return _propagated(
        model, inverse_depth, pixel, [distance_m], np.diag([pixel_variance, pixel_variance, sigma_m**2]), "the plane"
    )


def from_second_landmark(
    model: Model,
    pixel: Floats,
    second_px: Floats,
    pixel_variance: float,
    offset_in_cam_m: Floats,
    offset_covariance: Floats,
) -> Start:
    """A second landmark seen in the same image, at a known offset: two points and the camera are a triangle.

    Args:
        model: settings and camera.
        pixel: image point of the landmark [2].
        second_px: image point of the second one [2].
        pixel_variance: of the coordinates, px².
        offset_in_cam_m: from the second landmark to this one, camera axes [3].
        offset_covariance: of it [3, 3], m².

    Raises:
        ValueError: the triangle does not place the landmark in front of the camera.
    """

    def inverse_depth(p: Any) -> Any:
        return _triangulated(_ray(model, p[:2]), _ray(model, p[2:4]), p[4:7])

    covariance = np.zeros((7, 7))
    covariance[:4, :4] = pixel_variance * np.eye(4)
    covariance[4:, 4:] = offset_covariance
    return _propagated(model, inverse_depth, pixel, [*second_px, *offset_in_cam_m], covariance, "the second landmark")


def from_two_views(model: Model, pixel: Floats, first_px: Floats, pixel_variance: float, motion: CameraMotion) -> Start:
    """Two images of the landmark and the camera's motion between them, as a stereo pair.

    Args:
        model: settings and camera.
        pixel: image point in the later frame [2]; the start is that of this frame.
        first_px: image point in the earlier frame [2].
        pixel_variance: of the coordinates, px².
        motion: of the camera from the earlier to the later frame.

    Raises:
        ValueError: the lines of sight do not meet in front of the camera: there is too little parallax yet.
    """

    def inverse_depth(p: Any) -> Any:
        first, sin, cos = _ray(model, p[2:4]), np.sin(p[4]), np.cos(p[4])
        turned = np.array([cos * first[0] - sin * first[2], first[1], sin * first[0] + cos * first[2]])
        return _triangulated(_ray(model, p[:2]), turned, np.array([p[5], 0.0 * p[5], p[6]]))

    covariance = np.zeros((7, 7))
    covariance[:4, :4] = pixel_variance * np.eye(4)
    covariance[4:, 4:] = motion.covariance
    known = [*first_px, motion.turn_rad, *motion.shift_m]
    return _propagated(model, inverse_depth, pixel, known, covariance, "the other view")


def _ray(model: Model, pixel: Any) -> Any:
    """The line of sight (a, b, 1) of an image point."""
    one = 0.0 * pixel[0] + 1.0
    return np.array(
        [(pixel[0] - model.centre_x_px) / model.focal_px, (pixel[1] - model.centre_y_px) / model.focal_px, one]
    )


def _triangulated(ray: Any, other: Any, shift: Any) -> Any:
    """ξ of Z ray = Z₂ other + shift: (ray × other) · (shift × other) / |shift × other|², linear in the ray."""
    base = np.cross(shift, other)
    return np.cross(ray, other) @ base / (base @ base)


def _propagated(
    model: Model,
    inverse_depth: Callable[[Any], Any],
    pixel: Floats,
    known: list[float],
    covariance: Floats,
    source: str,
) -> Start:
    """The start with ξ = inverse_depth(pixel, known) and the covariance that follows from that of (pixel, known)."""
    values = np.array([*pixel, *known], dtype=np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        xi = float(inverse_depth(values))
    if not (xi > 0.0 and np.isfinite(xi)):
        raise ValueError(f"{source} does not place the landmark in front of the camera: inverse depth {xi:.3g} 1/m")
    # derivatives by the complex step: exact, there is no difference of near numbers
    steps = values + 1j * COMPLEX_STEP * np.eye(len(values))
    jacobian = np.eye(3, len(values))
    jacobian[2] = [inverse_depth(row).imag / COMPLEX_STEP for row in steps]
    return Start(np.array([*pixel, xi]), jacobian @ covariance @ jacobian.T)
