"""What stands in the world of a simulated mission: the ground with its relief, and textured planes on it.

World: z up, the ground at z = 0. A plane has axes of its own: x to the right and y up as its painted
front is looked at, z out of the front towards the viewer; its surface lies on it as a picture hangs on a
wall, the first sample at the plane's origin.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, field

import numpy as np
import scipy.fft
import scipy.ndimage
from numpy.typing import NDArray

from pipelines.simulation.pyramid import Levels, levels_of
from pipelines.simulation.surfaces import WRAP, Surface, surface_from_periodic

Floats = NDArray[np.float64]
Bounds = tuple[float, float, float, float]

EVERYWHERE: Bounds = (-math.inf, math.inf, -math.inf, math.inf)
SQUARE_PX = 32  # resolution of a printed pattern
PRINT_SIGMA_PX = 0.7  # softness of a printed edge; it keeps the finest detail out of the spline's reach


@dataclass(frozen=True, slots=True)
class Patch:
    """A rectangle of the ground, in world metres, that is covered by another surface."""

    surface: Surface
    x_min_m: float
    x_max_m: float
    y_min_m: float
    y_max_m: float


@dataclass(frozen=True, slots=True)
class Plane:
    """A textured rectangle in space, opaque, painted on its front.

    `world_t_plane` [4, 4] is a rigid motion; `bounds_m` are x_min, x_max, y_min, y_max in the plane.

    Raises:
        ValueError: the pose is no rigid motion, or the bounds enclose nothing.
    """

    surface: Surface
    world_t_plane: Floats = field(repr=False)
    bounds_m: Bounds

    def __post_init__(self) -> None:
        pose = np.asarray(self.world_t_plane, dtype=np.float64)
        rigid = pose.shape == (4, 4) and np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-9)
        if not rigid or np.linalg.det(pose[:3, :3]) < 0 or not np.array_equal(pose[3], [0, 0, 0, 1]):
            raise ValueError("world_t_plane: a rigid motion [4, 4] is needed (`upright` makes one)")
        x_min, x_max, y_min, y_max = self.bounds_m
        if not (x_min < x_max and y_min < y_max):
            raise ValueError(f"bounds {self.bounds_m} m enclose nothing: x_min, x_max, y_min, y_max, each pair rising")

    @property
    def outline_m(self) -> Floats:
        """Points all around its edge in the world [32, 3], the corners among them."""
        x_min, x_max, y_min, y_max = self.bounds_m
        s, n = np.arange(8) / 8, 8
        x = x_min + (x_max - x_min) * np.concatenate([s, np.ones(n), 1 - s, np.zeros(n)])
        y = y_min + (y_max - y_min) * np.concatenate([np.zeros(n), s, np.ones(n), 1 - s])
        points = np.column_stack([x, y, np.zeros(4 * n)])
        return np.asarray(points @ self.world_t_plane[:3, :3].T + self.world_t_plane[:3, 3])


@dataclass(frozen=True)
class Relief:
    """Bumps of the ground: a periodic, smooth, random height over z = 0, of mean 0.

    Gaussian with the correlation exp(-(r/correlation_m)²), so that the slope along an axis is
    √2 rms_height_m/correlation_m rms. The height is a cubic B-spline, hence continuous, as the ground is.

    Args:
        rms_height_m: standard deviation of the height.
        correlation_m: its correlation length.
        seed: seed of the bumps.
        samples: coefficients along either axis, four to a correlation length; then the relief repeats.

    Raises:
        ValueError: a length that is not positive.
    """

    rms_height_m: float
    correlation_m: float
    seed: int = 0
    samples: int = 256
    coefficients: NDArray[np.float32] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if not (self.rms_height_m > 0 and self.correlation_m > 0 and self.samples >= 8):
            raise ValueError(
                f"a relief of {self.rms_height_m} m rms, {self.correlation_m} m correlation length and "
                f"{self.samples} samples: the lengths must be positive, the samples at least 8"
            )
        noise = np.random.default_rng(self.seed).standard_normal((self.samples, self.samples))
        w = 2 * np.pi * np.fft.fftfreq(self.samples)  # rad per sample of correlation/4
        shape, response = np.exp(-((4 * w) ** 2) / 8), (2 + np.cos(w)) / 3
        spectrum = scipy.fft.fft2(noise) * np.outer(shape, shape)
        spectrum[0, 0] = 0
        rms = scipy.fft.ifft2(spectrum).real.std()
        spline = scipy.fft.ifft2(spectrum / np.outer(response, response)).real * (self.rms_height_m / rms)
        wrapped = np.pad(spline, (1, WRAP - 1), mode="wrap").astype(np.float32)
        wrapped.setflags(write=False)
        object.__setattr__(self, "coefficients", wrapped)

    @property
    def metres_per_sample(self) -> float:
        """Distance between neighbouring coefficients."""
        return self.correlation_m / 4

    @property
    def highest_m(self) -> float:
        """A bound of the height, above and below 0 (a spline stays within its coefficients)."""
        return float(np.abs(self.coefficients).max())

    @property
    def steepest(self) -> float:
        """A bound of the slope: a spline's derivatives stay within the differences of the coefficients about."""
        c = self.coefficients[1 : 1 - WRAP, 1 : 1 - WRAP]
        along = (np.abs(c - np.roll(c, 1, axis)) for axis in (0, 1))
        x, y = (scipy.ndimage.maximum_filter(differences, 4, mode="wrap") for differences in along)
        return float(np.hypot(x, y).max()) / self.metres_per_sample


@dataclass(frozen=True)
class Scene:
    """All that a camera can see.

    Planes hide the ground and one another; of two in the same plane the later one is seen. The ground does
    not hide planes, so they must stand on it or above it.

    Args:
        ground: the surface at z = 0; none for cameras that look past it.
        patches: rectangles of the ground with other surfaces, the later over the earlier.
        relief: bumps of the ground.
        planes: boards, posters, walls.
        background_grey: grey level where there is nothing.

    Raises:
        ValueError: patches or relief without ground, or a plane that reaches below it.
    """

    ground: Surface | None
    patches: tuple[Patch, ...] = ()
    relief: Relief | None = None
    planes: tuple[Plane, ...] = ()
    background_grey: float = 170.0
    _levels: dict[int, Levels] = field(default_factory=dict, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if self.ground is None and (self.patches or self.relief):
            raise ValueError("patches and relief lie on the ground: give the scene one")
        for number, plane in enumerate(self.planes):
            lowest = float(plane.outline_m[:, 2].min())
            if self.ground is not None and lowest < -1e-9:
                raise ValueError(f"plane {number} reaches {-lowest:g} m below the ground: lift it or cut its bounds")

    @functools.cached_property
    def on_the_ground(self) -> tuple[Plane, ...]:
        """The ground and its patches as planes, in the order in which they lie on one another."""
        if self.ground is None:
            return ()
        patches = (Plane(p.surface, np.eye(4), (p.x_min_m, p.x_max_m, p.y_min_m, p.y_max_m)) for p in self.patches)
        return (Plane(self.ground, np.eye(4), EVERYWHERE), *patches)

    def levels(self, surface: Surface) -> Levels:
        """The coarser copies of one of the scene's surfaces, made when they are first needed."""
        key = id(surface.coefficients)
        if key not in self._levels:
            self._levels[key] = levels_of(surface)
        return self._levels[key]


# --------------------------------------------------------------------------- what can be put there


def upright(position_m: Floats, facing_rad: float) -> Floats:
    """`world_t_plane` [4, 4] of a plane that stands upright at a position [3] and faces a heading.

    A plane that faces π is looked at by a camera that looks along world x.
    """
    cos, sin = math.cos(facing_rad), math.sin(facing_rad)
    pose = np.eye(4)
    pose[:3, :3] = np.array([[-sin, 0, cos], [cos, 0, sin], [0, 1, 0]])
    pose[:3, 3] = position_m
    return pose


def chessboard(
    columns: int,
    rows: int,
    square_m: float,
    world_t_board: Floats,
    *,
    margin_squares: float = 1.0,
    dark_grey: float = 25.0,
    light_grey: float = 225.0,
) -> Plane:
    """A chessboard of `columns` x `rows` inner corners (as OpenCV counts them) with a light margin.

    The board's origin is its centre. Its upper left square is light, so that `cv2.findChessboardCornersSB` numbers
    the corners of a board with one odd and one even number of them as `chessboard_corners` does. Around every inner
    corner the print is exactly antisymmetric, and it is smoothed symmetrically, so that its saddle point is the
    corner.

    Raises:
        ValueError: no corner, no size, or a margin under half a square.
    """
    if columns < 1 or rows < 1 or not square_m > 0 or not margin_squares >= 0.5:
        raise ValueError(
            f"a chessboard of {columns} x {rows} inner corners, squares of {square_m} m and a margin of "
            f"{margin_squares} squares: at least 1 x 1, a positive size and a margin of 0.5 are needed"
        )
    margin = 2 * round(margin_squares * SQUARE_PX / 2)
    dark = np.add.outer(np.arange(rows + 1), np.arange(columns + 1)) % 2 == 1
    picture = np.where(np.kron(dark, np.ones((SQUARE_PX, SQUARE_PX))) > 0, dark_grey, light_grey)
    return _printed(np.pad(picture, margin, constant_values=light_grey), square_m / SQUARE_PX, world_t_board)


def chessboard_corners(columns: int, rows: int, square_m: float, world_t_board: Floats) -> Floats:
    """Inner corners [rows · columns, 3] of a `chessboard` in the world, row by row from the upper left."""
    x = (np.arange(columns) - (columns - 1) / 2) * square_m
    y = ((rows - 1) / 2 - np.arange(rows)) * square_m
    points = np.column_stack([np.tile(x, rows), np.repeat(y, columns), np.zeros(rows * columns)])
    return np.asarray(points @ world_t_board[:3, :3].T + world_t_board[:3, 3])


def poster(
    position_m: Floats,
    *,
    facing_rad: float = math.pi,
    size_m: float = 0.3,
    rng: np.random.Generator | None = None,
    contrast_grey: float = 35.0,
) -> Plane:
    """A square upright plate whose centre, an X-corner, is a landmark at a position [3] in the world.

    With `rng`, a random texture lies over all but its middle, so that no plate looks like another.

    Raises:
        ValueError: a size that is not positive.
    """
    if not size_m > 0:
        raise ValueError(f"a poster of {size_m} m: its size must be positive")
    side = 2 * SQUARE_PX
    sign = np.where(np.arange(side) < SQUARE_PX, 1.0, -1.0)
    cross = np.outer(sign, sign)
    picture = 125 - 75 * cross
    if rng is not None:
        noise = scipy.ndimage.gaussian_filter(rng.standard_normal((side, side)), 2.0, mode="wrap")
        away = np.clip(np.abs(np.linspace(-1, 1, side)) / 0.3 - 1.5, 0, 1)  # from 0.45 to 0.75 of the way out
        picture += contrast_grey * noise / noise.std() * np.maximum.outer(away, away)
    return _printed(np.clip(picture, 0, 255), size_m / side, upright(position_m, facing_rad))


def _printed(picture: Floats, metres_per_px: float, world_t_centre: Floats) -> Plane:
    """A plane that shows a picture [height, width], both even, with its centre at a pose."""
    soft = scipy.ndimage.gaussian_filter(picture, PRINT_SIGMA_PX, mode="wrap")
    height, width = picture.shape
    shift = np.eye(4)
    shift[:2, 3] = -(width - 1) / 2 * metres_per_px, (height - 1) / 2 * metres_per_px
    bounds = tuple(metres_per_px * x for x in (-0.5, width - 0.5, 0.5 - height, 0.5))
    surface = surface_from_periodic(soft, metres_per_px=metres_per_px)
    return Plane(surface, world_t_centre @ shift, (bounds[0], bounds[1], bounds[2], bounds[3]))
