"""The pinhole camera with distortion, both ways: points in space to pixels, pixels to rays.

Camera axes are optical: x right, y down, z out of the lens; pixel (0, 0) is the centre of the first pixel.
A ray is a point at unit depth (x, y, 1). The models are OpenCV's and ROS's, by their ROS names: with
r² = x² + y², θ = atan r,

    plumb_bob             g = 1 + k1 r² + k2 r⁴ + k3 r⁶                            (k1 k2 p1 p2 k3)
    rational_polynomial   g = (1 + k1 r² + k2 r⁴ + k3 r⁶)/(1 + k4 r² + k5 r⁴ + k6 r⁶)   (… k3 k4 k5 k6)
    equidistant           g = θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸)/r              (k1 k2 k3 k4)

    x' = x g + 2 p1 x y + p2 (r² + 2 x²),   y' = y g + p1 (r² + 2 y²) + 2 p2 x y   (no p in equidistant)

and the pixel is K (x', y', 1). A model holds from the centre out to where x' stops growing with x; beyond
that it would show a point twice.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from readers.streams import Camera

Floats = NDArray[np.float64]

COEFFICIENTS = {"none": 0, "plumb_bob": 5, "rational_polynomial": 8, "equidistant": 4}
TOLERANCE = 1e-12
_RADII = np.tan(np.linspace(0, np.radians(89.9), 4096))


class _Lens(NamedTuple):
    """Coefficients in one form for all models: p [2], and those of θ or of numerator and denominator [3 or 4]."""

    fisheye: bool
    tangential: Floats
    above: Floats
    below: Floats


def pinhole(
    width_px: int,
    height_px: int,
    focal_px: float,
    *,
    model: str = "plumb_bob",
    distortion: Sequence[float] = (),
    centre_px: tuple[float, float] | None = None,
) -> Camera:
    """A camera with square pixels.

    Args:
        width_px: columns of the image.
        height_px: rows of the image.
        focal_px: focal length.
        model: ``none``, ``plumb_bob``, ``rational_polynomial`` or ``equidistant``.
        distortion: the model's coefficients; those left out are 0.
        centre_px: principal point (u, v); the middle of the image if None.

    Raises:
        ValueError: an unknown model, too many coefficients, a size or focal length that is not positive.
    """
    if not (width_px > 0 and height_px > 0 and focal_px > 0):
        raise ValueError(f"a camera of {width_px} x {height_px} px, focal length {focal_px} px: all must be positive")
    u0, v0 = centre_px or ((width_px - 1) / 2, (height_px - 1) / 2)
    matrix = np.array([[focal_px, 0, u0], [0, focal_px, v0], [0, 0, 1.0]])
    return Camera(
        width_px=width_px,
        height_px=height_px,
        matrix=matrix,
        distortion_model=model,
        distortion=_padded(model, np.asarray(distortion, dtype=np.float64)),
        rectification=np.eye(3),
        projection=np.column_stack([matrix, np.zeros(3)]),
        frame="camera",
    )


def project(camera: Camera, points_in_cam: Floats) -> Floats:
    """Pixels (u, v) [n, 2] of points [n, 3] in camera axes, in m.

    A point that is not before the camera, or is farther aside than the distortion model holds, has no
    pixel: NaN. Pixels outside the image are returned as they are.

    Raises:
        ValueError: a camera without a calibration, or with an unknown model.
    """
    lens = _lens_of(camera)
    depth = np.where(points_in_cam[:, 2] > 0, points_in_cam[:, 2], np.nan)
    flat = points_in_cam[:, :2] / depth[:, None]
    flat[np.hypot(flat[:, 0], flat[:, 1]) > _reach(lens)] = np.nan
    distorted, _ = _distort(lens, flat)
    return np.asarray(distorted @ camera.matrix[:2, :2].T + camera.matrix[:2, 2])


def rays(camera: Camera, pixels: Floats) -> Floats:
    """Rays (x, y, 1) [n, 3] in camera axes of pixels (u, v) [n, 2]: the inverse of `project`.

    Newton's method, from the inverse of the radial part, until the distorted ray agrees to 1e-12.

    Raises:
        ValueError: a pixel that the distortion model does not reach; a camera without a calibration, or
            with an unknown model.
    """
    found, good = _rays(camera, pixels)
    if not np.all(good):
        u, v = pixels[np.flatnonzero(~good)[0]]
        raise ValueError(
            f"no ray of the {camera.distortion_model} model leads to pixel ({u:g}, {v:g}), which its distortion "
            f"{camera.distortion.tolist()} does not reach; take a weaker distortion or a smaller image"
        )
    return found


def rays_where_known(camera: Camera, pixels: Floats) -> Floats:
    """As `rays`, but NaN for a pixel that the distortion model does not reach, or that is not finite.

    Raises:
        ValueError: a camera without a calibration, or with an unknown model.
    """
    finite = np.all(np.isfinite(pixels), axis=1)
    found, good = _rays(camera, np.where(finite[:, None], pixels, camera.matrix[:2, 2]))
    found[~(good & finite)] = np.nan
    return found


def ray_table(camera: Camera) -> tuple[Floats, NDArray[np.float32]]:
    """The rays of all pixels: x, y at unit depth [height, width, 2], and ∂x/∂u, ∂x/∂v, ∂y/∂u, ∂y/∂v [height, width, 4].

    Raises:
        ValueError: as for `rays`.
    """
    shape = (camera.height_px, camera.width_px)
    v, u = np.mgrid[: shape[0], : shape[1]].astype(np.float64)
    flat = rays(camera, np.column_stack([u.ravel(), v.ravel()]))[:, :2]
    distorted_by_flat = _distort(_lens_of(camera), flat)[1]
    slopes = np.linalg.inv(camera.matrix[:2, :2] @ distorted_by_flat)
    return flat.reshape(*shape, 2), slopes.reshape(*shape, 4).astype(np.float32)


def undistorted(camera: Camera) -> bool:
    """Whether pixels are straight images of rays: a plain pinhole, whatever its model is called."""
    return camera.distortion_model != "equidistant" and not np.any(camera.distortion)


class Radial(NamedTuple):
    """A model's numbers in one form: g is θ (1 + Σ above θ²ⁱ)/r (fisheye) or (1 + Σ above r²ⁱ)/(1 + Σ below r²ⁱ).

    `tangential` p1, p2; `above` 4 and `below` 3 coefficients, 0 where the model has none; `reach` the largest
    distance from the centre, at unit depth, for which the model holds.
    """

    fisheye: bool
    tangential: tuple[float, float]
    above: tuple[float, float, float, float]
    below: tuple[float, float, float]
    reach: float


def radial(camera: Camera) -> Radial:
    """The distortion's numbers, for code that cannot take a `Camera`.

    Raises:
        ValueError: a camera without a calibration, or with an unknown model.
    """
    lens = _lens_of(camera)
    p1, p2 = lens.tangential.tolist()
    a1, a2, a3, a4 = np.pad(lens.above, (0, 4 - len(lens.above))).tolist()
    b1, b2, b3 = np.pad(lens.below, (0, 3 - len(lens.below))).tolist()
    return Radial(lens.fisheye, (p1, p2), (a1, a2, a3, a4), (b1, b2, b3), _reach(lens))


def _rays(camera: Camera, pixels: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Rays (x, y, 1) [n, 3] of pixels [n, 2], and which of them lead to their pixels [n]."""
    lens = _lens_of(camera)
    goal = np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(camera.matrix).T[:, :2]
    flat = _radially_undistorted(lens, goal)
    for _ in range(20):
        distorted, jacobian = _distort(lens, flat)
        missing = goal - distorted
        if np.all(np.abs(missing) <= TOLERANCE * (1 + np.abs(goal))):
            break
        with np.errstate(all="ignore"):
            flat = flat + _solved(jacobian, missing)
    good = np.all(np.abs(missing) <= TOLERANCE * (1 + np.abs(goal)), axis=1)
    good &= np.hypot(flat[:, 0], flat[:, 1]) <= _reach(lens)
    return np.column_stack([flat, np.ones(len(flat))]), good


def _padded(model: str, coefficients: Floats) -> Floats:
    if model not in COEFFICIENTS:
        raise ValueError(f"distortion model {model!r}: one of {', '.join(COEFFICIENTS)} is needed")
    padded = np.zeros(COEFFICIENTS[model])
    if len(coefficients) > len(padded):
        raise ValueError(f"{len(coefficients)} distortion coefficients: the {model} model has {len(padded)}")
    padded[: len(coefficients)] = coefficients
    return padded


def _lens_of(camera: Camera) -> _Lens:
    if not camera.calibrated:
        raise ValueError("the camera has no calibration: give it a matrix with a positive focal length")
    k = _padded(camera.distortion_model, camera.distortion)
    if camera.distortion_model == "equidistant":
        return _Lens(True, np.zeros(2), k, np.zeros(0))
    k = np.concatenate([k, np.zeros(8 - len(k))])
    return _Lens(False, k[2:4], k[[0, 1, 4]], k[5:])


def _series(coefficients: Floats, x: Floats) -> tuple[Floats, Floats]:
    """1 + c1 x + c2 x² + … of any shape, and its derivative."""
    powers = np.polynomial.Polynomial([1.0, *coefficients])
    return powers(x), powers.deriv()(x)


def _gain(lens: _Lens, r2: Floats) -> tuple[Floats, Floats]:
    """The factor g of the formulas above, and its derivative by r²."""
    above, slope_above = _series(lens.above, r2)
    if not lens.fisheye:
        below, slope_below = _series(lens.below, r2)
        return above / below, (slope_above - above / below * slope_below) / below
    r = np.sqrt(np.maximum(r2, 1e-16))  # g is flat there: 1 + (k1 - 1/3) r²
    angle = np.arctan(r)
    stretch, slope = _series(lens.above, angle**2)
    gain = angle * stretch / r
    return gain, ((stretch + 2 * angle**2 * slope) / (1 + r**2) - gain) / (2 * r**2)


def _distort(lens: _Lens, flat: Floats) -> tuple[Floats, Floats]:
    """Distorted points [n, 2] of points at unit depth [n, 2], and the Jacobians [n, 2, 2]."""
    x, y = flat.T
    p1, p2 = lens.tangential
    r2 = x * x + y * y
    gain, slope = _gain(lens, r2)
    distorted = np.column_stack(
        [x * gain + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * gain + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y]
    )
    cross = 2 * slope * x * y + 2 * p1 * x + 2 * p2 * y
    xx = gain + 2 * slope * x * x + 2 * p1 * y + 6 * p2 * x
    yy = gain + 2 * slope * y * y + 6 * p1 * y + 2 * p2 * x
    return distorted, np.stack([np.stack([xx, cross], -1), np.stack([cross, yy], -1)], -2)


def _solved(matrices: Floats, vectors: Floats) -> Floats:
    """Solutions [n, 2] of n systems of two equations; not finite where a matrix is singular."""
    (a, b), (c, d) = np.moveaxis(matrices, 0, -1)
    u, v = vectors.T
    return np.asarray(np.column_stack([d * u - b * v, a * v - c * u]) / (a * d - b * c)[:, None])


def _monotone(lens: _Lens) -> int:
    """How many of `_RADII` come before the first at which the distorted radius r g does not grow."""
    gain, slope = _gain(lens, _RADII**2)
    folded = np.flatnonzero(~(gain + 2 * _RADII**2 * slope > 0))
    return int(folded[0]) if len(folded) else len(_RADII)


def _reach(lens: _Lens) -> float:
    """The largest distance from the centre, at unit depth, for which the model holds."""
    n = _monotone(lens)
    return float(_RADII[n - 1]) if n < len(_RADII) else np.inf


def _radially_undistorted(lens: _Lens, distorted: Floats) -> Floats:
    """Points [n, 2] whose radial distortion alone is about the given one."""
    radii = _RADII[: _monotone(lens)]
    images = radii * _gain(lens, radii**2)[0]
    wanted = np.hypot(distorted[:, 0], distorted[:, 1])
    found = np.interp(wanted, images, radii)
    return np.asarray(distorted * (found / np.maximum(wanted, 1e-300))[:, None])
