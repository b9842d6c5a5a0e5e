"""Ground surfaces as continuous functions: periodic cubic B-splines of grey level.

A surface lies in the ground plane with its first sample at the world's origin; its columns run along
world x, its rows along minus world y, so that a camera with heading 0 sees it as the picture it was
made from. It repeats itself in both directions without a seam.

Because the scene is one continuous function, the truth of a rendered frame is exact by definition:
there is no interpolation error that an estimator could take for motion.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import scipy.fft
import scipy.ndimage
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

PAPER_METRES_PER_PX = 0.2002 / 256  # a camera of f = 256 px, 20.02 cm above the ground
PSF_SIGMA_PX = 0.3
TEXELS_PER_PX = 2
WRAP = 3  # extra rows and columns of coefficients, so that 4 x 4 taps need no index arithmetic


@dataclass(frozen=True, slots=True)
class Surface:
    """A periodic ground texture.

    `coefficients` float32 [rows + 3, columns + 3] are those of the cubic B-spline; the first row and
    column repeat the last, the last two the first two. `texels_per_px` coefficients stand for one
    pixel of the picture, which measures `metres_per_px` on the ground.
    """

    coefficients: NDArray[np.float32] = field(repr=False)
    texels_per_px: int = TEXELS_PER_PX
    metres_per_px: float = PAPER_METRES_PER_PX

    @property
    def metres_per_texel(self) -> float:
        """Distance between neighbouring coefficients on the ground."""
        return self.metres_per_px / self.texels_per_px

    @property
    def period_m(self) -> tuple[float, float]:
        """Length after which the surface repeats along x and y."""
        rows, columns = self.coefficients.shape
        return (columns - WRAP) * self.metres_per_texel, (rows - WRAP) * self.metres_per_texel


def surface_from_image(
    grey: ArrayLike, *, metres_per_px: float = PAPER_METRES_PER_PX, psf_sigma_px: float = PSF_SIGMA_PX
) -> Surface:
    """Make a surface of a picture [height, width] of grey levels, mirrored so that it has no seams.

    The picture is low-pass filtered by a Gaussian point-spread function, as a camera would.
    """
    picture = _checked(grey)
    mirrored = np.block([[picture, picture[:, ::-1]], [picture[::-1], picture[::-1, ::-1]]])
    return surface_from_periodic(mirrored, metres_per_px=metres_per_px, psf_sigma_px=psf_sigma_px)


def surface_from_periodic(
    grey: ArrayLike, *, metres_per_px: float = PAPER_METRES_PER_PX, psf_sigma_px: float = PSF_SIGMA_PX
) -> Surface:
    """Make a surface of one period [height, width], both even, of a texture that repeats by itself.

    In the frequency domain: the Gaussian of `psf_sigma_px`, the Nyquist lines set to zero, zeros added up
    to twice the resolution, the response (2 + cos ω)/3 of the cubic B-spline divided out.
    """
    period = _checked(grey)
    rows, columns = period.shape
    if rows % 2 or columns % 2:
        raise ValueError(f"a period of {rows} x {columns} samples: both must be even")
    spectrum = np.fft.fftshift(scipy.fft.fft2(period))
    spectrum *= np.outer(_gaussian_response(rows, psf_sigma_px), _gaussian_response(columns, psf_sigma_px))
    spectrum[0], spectrum[:, 0] = 0, 0
    fine_rows, fine_columns = TEXELS_PER_PX * rows, TEXELS_PER_PX * columns
    fine = np.zeros((fine_rows, fine_columns), dtype=np.complex128)
    top, left = (fine_rows - rows) // 2, (fine_columns - columns) // 2
    fine[top : top + rows, left : left + columns] = spectrum * TEXELS_PER_PX**2
    fine /= np.outer(_spline_response(fine_rows), _spline_response(fine_columns))
    coefficients = scipy.fft.ifft2(np.fft.ifftshift(fine)).real
    wrapped = np.pad(coefficients, (1, WRAP - 1), mode="wrap").astype(np.float32)
    wrapped.setflags(write=False)
    return Surface(wrapped, TEXELS_PER_PX, metres_per_px)


def _checked(grey: ArrayLike) -> Floats:
    picture = np.asarray(grey, dtype=np.float64)
    if picture.ndim != 2 or picture.size == 0 or not np.all(np.isfinite(picture)):
        raise ValueError(
            f"a picture of shape {picture.shape}: one array of finite grey levels [height, width] is needed"
        )
    return picture


def _frequencies(n: int) -> Floats:
    """Angular frequencies in rad per sample, the zero in the middle."""
    return 2 * np.pi * np.fft.fftshift(np.fft.fftfreq(n))


def _gaussian_response(n: int, sigma: float) -> Floats:
    return np.asarray(np.exp(-0.5 * (sigma * _frequencies(n)) ** 2))


def _spline_response(n: int) -> Floats:
    return np.asarray((2 + np.cos(_frequencies(n))) / 3)


def gravel(
    size_px: int,
    rng: np.random.Generator,
    *,
    radius_px: tuple[float, float] = (2.5, 14.0),
    gradient_rms: float = 7.0,
    metres_per_px: float = PAPER_METRES_PER_PX,
) -> Surface:
    """Gravel: grained ellipsoidal pebbles of random size, shade and pose, one on another, lit from the side.

    The texture is periodic with `size_px`. Radii follow a power law between the two `radius_px`; the
    contrast is set so that the gradient along an axis has `gradient_rms` grey levels per px, 7 being
    that of the paper's gravel.
    """
    smallest, largest = radius_px
    height = np.full((size_px, size_px), -np.inf)
    grey = 38 + 9 * _smooth_noise(size_px, 2.0, rng)
    for radius in _pebble_radii(size_px, smallest, largest, rng):
        _lay_pebble(grey, height, radius, rng)
    grey += 16 * _smooth_noise(size_px, 0.8, rng) + 10 * _smooth_noise(size_px, 40.0, rng)
    grey = scipy.ndimage.gaussian_filter(grey, 0.7, mode="wrap")
    gradient = (np.roll(grey, -1, axis=1) - np.roll(grey, 1, axis=1)) / 2
    scaled = 110 + (grey - grey.mean()) * gradient_rms / np.sqrt(np.mean(gradient**2))
    return surface_from_periodic(np.clip(scaled, 0, 255), metres_per_px=metres_per_px)


def _pebble_radii(size_px: int, smallest: float, largest: float, rng: np.random.Generator) -> Floats:
    """Radii that together cover the ground about four times, density ~ radius^-2.5, largest first."""
    u = rng.random(4 * size_px * size_px)
    exponent = -1.5
    radii = (smallest**exponent + u * (largest**exponent - smallest**exponent)) ** (1 / exponent)
    enough = int(np.searchsorted(np.cumsum(np.pi * radii**2), 4.0 * size_px * size_px))
    return np.asarray(radii[:enough])


LIGHT = np.array([-0.55, -0.45, 0.70]) / np.linalg.norm([-0.55, -0.45, 0.70])


def _lay_pebble(grey: Floats, height: Floats, radius: float, rng: np.random.Generator) -> None:
    """Lay one pebble at a random place where it stands out of what lies there already."""
    size = len(grey)
    centre = rng.random(2) * size
    slim, turn, bed = rng.uniform(0.6, 1.0), rng.uniform(0, np.pi), rng.uniform(-0.5, 0.6)
    shade = np.clip(rng.normal(118, 34), 45, 225)
    reach = int(np.ceil(radius)) + 1
    around = np.arange(-reach, reach + 1)
    rows, columns = (int(centre[0]) + around) % size, (int(centre[1]) + around) % size
    y, x = np.meshgrid(around - centre[0] % 1, around - centre[1] % 1, indexing="ij")
    p = (np.cos(turn) * x + np.sin(turn) * y) / radius
    q = (np.cos(turn) * y - np.sin(turn) * x) / (radius * slim)
    dome = np.sqrt(np.clip(1 - (p * p + q * q) ** 1.5, 0, None))
    top = bed * radius + 0.6 * radius * dome
    patch = np.ix_(rows, columns)
    covers = (dome > 0) & (top > height[patch])
    slope_y, slope_x = np.gradient(0.6 * radius * dome)
    normal_z = 1 / np.sqrt(1 + slope_x**2 + slope_y**2)
    light = np.clip((LIGHT[2] - slope_x * LIGHT[0] - slope_y * LIGHT[1]) * normal_z, 0, 1)
    grey[patch] = np.where(covers, shade * (0.25 + 0.95 * light), grey[patch])
    height[patch] = np.where(covers, top, height[patch])


def _smooth_noise(size_px: int, sigma_px: float, rng: np.random.Generator) -> Floats:
    """Periodic Gaussian noise [size, size] of unit variance and the given correlation length."""
    noise = scipy.ndimage.gaussian_filter(rng.standard_normal((size_px, size_px)), sigma_px, mode="wrap")
    return np.asarray(noise / noise.std())


def tiles(
    period_px: int,
    rng: np.random.Generator,
    *,
    joint_px: int = 4,
    joint_grey: float = 70.0,
    metres_per_px: float = PAPER_METRES_PER_PX,
) -> Surface:
    """Paving of strictly equal tiles with dark joints: every tile looks like every other.

    `period_px` is the side of a tile with its joint. A shift by a whole tile cannot be seen.
    """
    tile = 150 + 14 * _smooth_noise(period_px, 1.2, rng)
    tile[:joint_px], tile[:, :joint_px] = joint_grey, joint_grey
    return surface_from_periodic(tile, metres_per_px=metres_per_px)
