"""Ground surfaces as continuous functions: cubic B-splines of grey level, endless in both directions.

A surface lies in the ground plane with its first sample at the world's origin; its columns run along
world x, its rows along minus world y, so that a camera with heading 0 sees it as the picture it was
made from. It repeats itself without a seam, or, with a `Scatter`, is laid of cells each of which shows
the picture at an offset of its own, so that it never repeats.

Because the scene is one continuous function, the truth of a rendered frame is exact by definition:
there is no interpolation error that an estimator could take for motion.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple

import numpy as np
import scipy.fft
import scipy.ndimage
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

PAPER_METRES_PER_PX = 0.2002 / 256  # a camera of f = 256 px, 20.02 cm above the ground
PSF_SIGMA_PX = 0.3
TEXELS_PER_PX = 2
WRAP = 3  # extra rows and columns of coefficients, so that 4 x 4 taps need no index arithmetic
CELL_PX, BAND_PX = 512, 32  # of a scatter
OFFSETS = 1 << 16  # how many offsets a cell draws from where nothing ties it down
SMALLEST_PX = {"mirror": 8, "scatter": 64}
LARGEST_MIRRORED_PX = 2048 * 2048  # beyond it, the mirrored spline needs gigabytes

Arrangement = Literal["mirror", "scatter"]


class CellAxis(NamedTuple):
    """How cells follow one another along one axis of the ground.

    Attributes:
        side_m: from one cell to the next.
        band_m: length over which a cell is blended with the one before; it begins at the cell's first line.
        step_m: cells show the picture at offsets of 0, 1, … times this length.
        count: how many such offsets there are, up to 65536.
        coherence: share of the picture's variance that all cells have in common where they meet. A blend
            weakens only the rest, so only the rest is strengthened to keep the contrast.
    """

    side_m: float
    band_m: float
    step_m: float
    count: int = OFFSETS
    coherence: float = 0.0


@dataclass(frozen=True, slots=True)
class Scatter:
    """Cells that make a periodic picture into endless ground that does not repeat.

    Lengths are those of the ground, so that the same scatter serves a surface at any resolution.

    Attributes:
        seed: of the cells' offsets.
        x: cells along world x (the picture's columns).
        y: cells along minus world y (the picture's rows).
        mean_grey: the grey level about which the contrast is kept in the bands.
        stagger: share of a cell by which each row of cells starts later than the one before; 0.5 is the
            running bond of a brick wall.
    """

    seed: int
    x: CellAxis
    y: CellAxis
    mean_grey: float
    stagger: float = 0.0

    def __post_init__(self) -> None:
        for name, axis in (("x", self.x), ("y", self.y)):
            if not (0 < axis.band_m < axis.side_m and 1 <= axis.count <= OFFSETS and 0 <= axis.coherence <= 1):
                raise ValueError(
                    f"cells along {name}: {axis}: 0 < band_m < side_m, 1 <= count <= {OFFSETS} and "
                    "0 <= coherence <= 1 are needed"
                )


class Cells(NamedTuple):
    """A `Scatter` as compiled code takes it: lengths in texels, all scalars; `side_x` 0 means no cells.

    `sampling.grey_at` says what each is for.
    """

    side_x: float
    side_y: float
    inverse_x: float
    inverse_y: float
    band_x: float
    band_y: float
    step_x: float
    step_y: float
    count_x: int
    count_y: int
    coherence_x: float
    coherence_y: float
    stagger: float
    mean: float
    key: int


NO_CELLS = Cells(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1, 1, 0.0, 0.0, 0.0, 0.0, 0)


@dataclass(frozen=True, slots=True)
class Surface:
    """A ground texture.

    `coefficients` float32 [rows + 3, columns + 3] are those of the cubic B-spline; the first row and
    column repeat the last, the last two the first two. `texels_per_px` coefficients stand for one
    pixel of the picture, which measures `metres_per_px` on the ground. Without a `scatter` the texture
    is strictly periodic.
    """

    coefficients: NDArray[np.float32] = field(repr=False)
    texels_per_px: int = TEXELS_PER_PX
    metres_per_px: float = PAPER_METRES_PER_PX
    scatter: Scatter | None = None

    @property
    def metres_per_texel(self) -> float:
        """Distance between neighbouring coefficients on the ground."""
        return self.metres_per_px / self.texels_per_px

    @property
    def period_m(self) -> tuple[float, float]:
        """Length after which the surface repeats along x and y; infinite with a scatter."""
        if self.scatter is not None:
            return math.inf, math.inf
        rows, columns = self.coefficients.shape
        return (columns - WRAP) * self.metres_per_texel, (rows - WRAP) * self.metres_per_texel

    @property
    def cells(self) -> Cells:
        """The scatter in texels, for `sampling.grey_at`."""
        if self.scatter is None:
            return NO_CELLS
        s, scale = self.scatter, 1 / self.metres_per_texel
        return Cells(
            s.x.side_m * scale,
            s.y.side_m * scale,
            1 / (s.x.side_m * scale),
            1 / (s.y.side_m * scale),
            s.x.band_m * scale,
            s.y.band_m * scale,
            s.x.step_m * scale,
            s.y.step_m * scale,
            s.x.count,
            s.y.count,
            s.x.coherence,
            s.y.coherence,
            s.stagger,
            s.mean_grey,
            int(np.random.SeedSequence(s.seed).generate_state(1, np.uint64)[0] >> 1),
        )


def surface_from_image(
    grey: ArrayLike,
    *,
    metres_per_px: float = PAPER_METRES_PER_PX,
    psf_sigma_px: float = PSF_SIGMA_PX,
    arrange: Arrangement = "mirror",
    seed: int = 0,
    flatten_px: float | None = None,
) -> Surface:
    """Make endless ground of a picture.

    The picture is low-pass filtered by a Gaussian point-spread function, as a camera would.

    Args:
        grey: grey levels [height, width].
        metres_per_px: what a pixel of the picture measures on the ground.
        psf_sigma_px: standard deviation of the point-spread function.
        arrange: "mirror" lays the picture and its mirror images side by side: no seams, but strictly periodic.
            "scatter" lays cells cut out of the picture at random, each blended into the next: no seams, no
            mirror images, no repetition.
        seed: of the scatter.
        flatten_px: subtract the picture blurred by a Gaussian of this standard deviation (but for its mean), so
            that light that belongs to the camera and not to the ground does not repeat with the picture.

    Raises:
        ValueError: this is no picture, or it is too small, or too large to be mirrored.
    """
    picture = _checked(grey)
    if arrange not in SMALLEST_PX:
        raise ValueError(f"no arrangement {arrange!r}: there are {', '.join(SMALLEST_PX)}")
    if min(picture.shape) < SMALLEST_PX[arrange]:
        raise ValueError(
            f"a picture of {picture.shape[1]} x {picture.shape[0]} px is too small to {arrange}: at least "
            f"{SMALLEST_PX[arrange]} px a side are needed; take a larger picture, or families.ground"
        )
    if flatten_px is not None:
        picture = _flattened(picture, flatten_px)
    if arrange == "scatter":
        return _cut_to_cells(picture, metres_per_px, psf_sigma_px, seed)
    if picture.size > LARGEST_MIRRORED_PX:
        raise ValueError(
            f"a picture of {picture.shape[1]} x {picture.shape[0]} px is too large to mirror: "
            'take arrange="scatter", or reduce it'
        )
    mirrored = np.block([[picture, picture[:, ::-1]], [picture[::-1], picture[::-1, ::-1]]])
    return surface_from_periodic(mirrored, metres_per_px=metres_per_px, psf_sigma_px=psf_sigma_px)


def scattered(surface: Surface, seed: int, *, cell_px: float = CELL_PX, band_px: float = BAND_PX) -> Surface:
    """The same texture as endless ground: every cell of `cell_px` shows it at an offset of its own."""
    columns_m, rows_m = replace(surface, scatter=None).period_m
    side_m, band_m = cell_px * surface.metres_per_px, band_px * surface.metres_per_px
    x, y = (CellAxis(side_m, band_m, period_m / OFFSETS) for period_m in (columns_m, rows_m))
    mean = float(surface.coefficients[1 : 1 - WRAP, 1 : 1 - WRAP].mean(dtype=np.float64))
    return replace(surface, scatter=Scatter(seed, x, y, mean))


def _flattened(picture: Floats, sigma_px: float) -> Floats:
    if not sigma_px > 0:
        raise ValueError(f"flatten_px {sigma_px}: it must be above 0, or None")
    rows, columns = (np.exp(-0.5 * (sigma_px * np.pi * np.arange(n) / n) ** 2) for n in picture.shape)
    light = scipy.fft.idctn(scipy.fft.dctn(picture) * np.outer(rows, columns))
    return np.asarray(picture - light + picture.mean())


def _cut_to_cells(picture: Floats, metres_per_px: float, psf_sigma_px: float, seed: int) -> Surface:
    """Cells of half the picture's side at most, their offsets such that no cell reaches the picture's border."""
    side_px = min(CELL_PX, min(picture.shape) // 2)
    band_px = min(BAND_PX, side_px // 8)
    rows_m, columns_m = (metres_per_px * (n - side_px - band_px) for n in picture.shape)
    x, y = (
        CellAxis(side_px * metres_per_px, band_px * metres_per_px, range_m / OFFSETS) for range_m in (columns_m, rows_m)
    )
    scatter = Scatter(seed, x, y, float(picture.mean()))
    return Surface(_wrapped(_spline_of_picture(picture, psf_sigma_px)), TEXELS_PER_PX, metres_per_px, scatter)


def _spline_of_picture(picture: Floats, psf_sigma_px: float) -> NDArray[np.float32]:
    """As `surface_from_periodic`, by the cosine transform: mirrored at its borders, at a quarter of the memory.

    Its first coefficient lies a quarter of a pixel before the centre of the first pixel.
    """
    rows, columns = picture.shape
    spectrum = scipy.fft.dctn(picture.astype(np.float32), norm="ortho", overwrite_x=True)
    fine = np.zeros((TEXELS_PER_PX * rows, TEXELS_PER_PX * columns), dtype=np.float32)
    fine[:rows, :columns] = spectrum
    for axis, n in enumerate(picture.shape):
        w = np.pi * np.arange(n) / n
        response = TEXELS_PER_PX**0.5 * np.exp(-0.5 * (psf_sigma_px * w) ** 2) * 3 / (2 + np.cos(w / TEXELS_PER_PX))
        kept = fine[:rows, :columns]
        kept *= np.expand_dims(response.astype(np.float32), 1 - axis)
    return np.asarray(scipy.fft.idctn(fine, norm="ortho", overwrite_x=True), dtype=np.float32)


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
    return Surface(_wrapped(coefficients), TEXELS_PER_PX, metres_per_px)


def _wrapped(coefficients: NDArray[Any]) -> NDArray[np.float32]:
    """Coefficients with the rows and columns that spare the sampling its index arithmetic; read-only."""
    wrapped = np.pad(coefficients, (1, WRAP - 1), mode="wrap").astype(np.float32, copy=False)
    wrapped.setflags(write=False)
    return wrapped


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
