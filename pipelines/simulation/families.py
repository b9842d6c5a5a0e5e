"""Named families of ground: pictures made by rule that look like the thing and are as hard to match.

`ground` makes a surface of a family. What makes ground hard to match are three numbers that all families share:

- `contrast`: the gradient along an axis, root mean square over both axes, in grey levels per px, as rendered;
- `repetition`: the share of the texture's variance that is the same in every period (the family's `period_px`),
  0 for none, 1 for strictly periodic;
- `spectrum`: β of the amplitude spectrum ~ f^-β between 1/64 and 1/4 cycles per px; the smaller, the finer.

A family is a texture, which never repeats, and a pattern, which always does. The two are added in the proportion
that `repetition` says, filtered to the `spectrum` and scaled to the `contrast`. The defaults are those of paper A's
frames of the same ground (docs/simulation-surfaces.md).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numba as nb
import numpy as np
import scipy.fft
import scipy.spatial
from numpy.typing import NDArray

from pipelines.simulation.channels import rng_of
from pipelines.simulation.surfaces import (
    BAND_PX,
    CELL_PX,
    LIGHT,
    OFFSETS,
    PAPER_METRES_PER_PX,
    PSF_SIGMA_PX,
    CellAxis,
    Scatter,
    Surface,
    surface_from_periodic,
)

Floats = NDArray[np.float64]
Rng = np.random.Generator

SIZE_STEP_PX = 256  # every period divides it
FINEST, COARSEST = 1 / 4, 1 / 64  # cycles per px between which the spectrum's slope is taken
FADING = 0.1  # cycles per px: above `FINEST` the amplitude falls as a Gaussian of this width, as in real frames
JOINT_PX = 8  # joints begin on the first line of a paver or board, and hide the band between two cells
BOARD_PX = 128
PAVER_PX = (128, 256)
TREAD_PX = 128


@dataclass(frozen=True, slots=True)
class Bond:
    """How cells lie along one axis, in px: in any place (`step_px` None), or only whole steps from one another.

    `hidden`: the bands lie in joints, which are the same in all cells.
    """

    side_px: int = CELL_PX
    band_px: int = BAND_PX
    step_px: int | None = None
    hidden: bool = False


@dataclass(frozen=True, slots=True)
class Family:
    """One kind of ground.

    Attributes:
        texture: makes the part that does not repeat, periodic with its side: (side in px, rng) → [side, side].
        pattern: makes one period of the part that does: (shape in px, rng) → [rows, columns].
        contrast: gradient rms in grey levels per px.
        spectrum: β of the amplitude spectrum.
        mean_grey: its shade.
        repetition: share of the pattern.
        period_px: of the pattern along (y, x).
        x: how cells lie along x.
        y: how cells lie along y.
        stagger: as in `Scatter`.
    """

    texture: Callable[[int, Rng], Floats]
    contrast: float
    spectrum: float
    mean_grey: float
    repetition: float = 0.0
    pattern: Callable[[tuple[int, int], Rng], Floats] | None = None
    period_px: tuple[int, int] = (128, 128)
    x: Bond = Bond()
    y: Bond = Bond()
    stagger: float = 0.0


def ground(
    name: str,
    *,
    seed: int = 0,
    size_px: int = 1024,
    contrast: float | None = None,
    repetition: float | None = None,
    spectrum: float | None = None,
    metres_per_px: float = PAPER_METRES_PER_PX,
    scatter: bool = True,
) -> Surface:
    """Make the ground of a family; what is None is the family's own.

    Args:
        name: one of `FAMILIES`.
        seed: of everything random; the same seed gives the same bytes.
        size_px: side of the picture that the ground is made of, a multiple of 256.
        contrast: gradient rms in grey levels per px.
        repetition: share of the variance that repeats itself, 0 to 1.
        spectrum: β of the amplitude spectrum ~ f^-β.
        metres_per_px: what a px measures on the ground.
        scatter: endless ground that does not repeat (but for `repetition`); otherwise strictly periodic
            with `size_px`.

    Raises:
        ValueError: no such family, or a number out of its range.
    """
    family = FAMILIES.get(name)
    if family is None:
        raise ValueError(f"no ground {name!r}: there are {', '.join(FAMILIES)}")
    contrast = family.contrast if contrast is None else contrast
    share = family.repetition if repetition is None else repetition
    slope = family.spectrum if spectrum is None else spectrum
    if size_px < SIZE_STEP_PX or size_px % SIZE_STEP_PX:
        raise ValueError(f"size_px {size_px}: it must be a multiple of {SIZE_STEP_PX}")
    if not (contrast > 0 and 0 <= share <= 1 and 0 <= slope <= 3):
        raise ValueError(
            f"contrast {contrast}, repetition {share}, spectrum {slope}: contrast > 0, repetition 0 to 1 and "
            "spectrum 0 to 3 are needed"
        )
    texture = family.texture(size_px, rng_of(seed, name, "texture"))
    pattern = _pattern(family, rng_of(seed, name, "pattern"))
    pattern = np.tile(pattern, (size_px // pattern.shape[0], size_px // pattern.shape[1]))
    grey = family.mean_grey + _tempered(texture, pattern, contrast, share, slope)
    if share == 1:
        grey = grey[: family.period_px[0], : family.period_px[1]]
    surface = surface_from_periodic(grey, metres_per_px=metres_per_px)
    if share == 1 or not scatter:
        return surface
    cells = _scatter(family, seed, size_px, share, metres_per_px)
    return Surface(surface.coefficients, surface.texels_per_px, metres_per_px, cells)


def gradient_rms(grey: Floats) -> float:
    """Root mean square of the central differences [grey levels per px] of a picture, over both axes."""
    along_y, along_x = np.gradient(grey)
    return float(np.sqrt(np.mean(along_x**2 + along_y**2) / 2))


def spectral_slope(grey: Floats) -> float:
    """β of the amplitude spectrum ~ f^-β of a square periodic picture, between 1/64 and 1/4 cycles per px."""
    return _slope(_frequency(len(grey)), np.abs(scipy.fft.rfft2(grey)) ** 2)


def _pattern(family: Family, rng: Rng) -> Floats:
    """One period: the family's own pattern, or a piece of its texture."""
    if family.pattern is not None:
        return family.pattern(family.period_px, rng)
    return family.texture(family.period_px[0], rng)


def _tempered(texture: Floats, pattern: Floats, contrast: float, share: float, slope: float) -> Floats:
    """√(1 - share) of the texture and √share of the pattern, of that spectral slope and contrast.

    Both are filtered by one factor f^-e, which fades out above `FINEST`, and each is brought to unit variance
    after it; e is corrected by what the slope of the sum still lacks.
    """
    size = len(texture)
    frequency = _frequency(size)
    log_f = np.log(np.maximum(frequency, COARSEST))
    fading = 0.5 * (np.maximum(frequency - FINEST, 0) / FADING) ** 2
    parts = [scipy.fft.rfft2(part) for part in (texture, pattern)]
    exponent = 0.0
    for _ in range(4):
        gain = np.exp(-exponent * log_f - fading)
        gain[0, 0] = 0
        mixed = np.zeros_like(parts[0])
        for part, weight in zip(parts, (1 - share, share), strict=True):
            variance = _sum((np.abs(part) * gain) ** 2)
            mixed += (weight / variance if variance > 0 else 0) ** 0.5 * gain * part
        power = np.abs(mixed) ** 2
        exponent += slope - _slope(frequency, power)
    seen = power * np.exp(-((2 * np.pi * PSF_SIGMA_PX * frequency) ** 2))
    sine_y, sine_x = (np.sin(2 * np.pi * f(size)) ** 2 for f in (np.fft.fftfreq, np.fft.rfftfreq))
    present = (_sum(seen * (sine_y[:, None] + sine_x)) / 2) ** 0.5 / size**2
    return np.asarray(scipy.fft.irfft2(mixed * contrast / present, s=texture.shape))


def _sum(power: Floats) -> float:
    """Sum over the whole plane of frequencies of what is given for the half plane [n, n / 2 + 1]."""
    return float(2 * power.sum() - power[:, 0].sum() - power[:, -1].sum())


def _slope(frequency: Floats, power: Floats) -> float:
    """β of the amplitude spectrum ~ f^-β: a line through the rms of half-octave rings."""
    edges = np.geomspace(COARSEST, FINEST, 9)
    ring = np.digitize(frequency.ravel(), edges)
    rings = np.bincount(ring, power.ravel(), 10) / np.maximum(np.bincount(ring, minlength=10), 1)
    middle = np.log(np.sqrt(edges[1:] * edges[:-1]))
    return float(-np.polyfit(middle, 0.5 * np.log(rings[1:9]), 1)[0])


def _scatter(family: Family, seed: int, size_px: int, share: float, metres_per_px: float) -> Scatter:
    """The cells of a family; where part of its texture repeats, they keep it in step."""

    def axis(bond: Bond, period_px: int) -> CellAxis:
        step_px = bond.step_px or (period_px if share > 0 and not bond.hidden else None)
        count = OFFSETS if step_px is None else size_px // step_px
        return CellAxis(
            min(bond.side_px, size_px // (1 if bond.hidden else 2)) * metres_per_px,
            bond.band_px * metres_per_px,
            size_px / count * metres_per_px,
            count,
            1.0 if bond.hidden else share,
        )

    return Scatter(
        seed, axis(family.x, family.period_px[1]), axis(family.y, family.period_px[0]), family.mean_grey, family.stagger
    )


# ----------------------------------------------------------------------------------- building blocks


def _frequency(size_px: int) -> Floats:
    """Cycles per px [size, size / 2 + 1] of a real Fourier transform."""
    return np.asarray(np.hypot(np.fft.fftfreq(size_px)[:, None], np.fft.rfftfreq(size_px)))


def _filtered(grey: Floats, gain: Floats) -> Floats:
    return np.asarray(scipy.fft.irfft2(scipy.fft.rfft2(grey) * gain, s=grey.shape))


def _unit(grey: Floats) -> Floats:
    """The same with mean 0 and variance 1; all zero if it is constant."""
    centred = grey - grey.mean()
    deviation = centred.std()
    return np.asarray(centred / deviation if deviation > 0 else centred)


def _noise(size_px: int, rng: Rng, *, along_x_px: float, along_y_px: float | None = None) -> Floats:
    """Periodic Gaussian noise [size, size] of unit variance, correlated over these lengths."""
    sigma_y = along_x_px if along_y_px is None else along_y_px
    y, x = np.fft.fftfreq(size_px)[:, None], np.fft.rfftfreq(size_px)
    gain = np.exp(-2 * np.pi**2 * ((along_x_px * x) ** 2 + (sigma_y * y) ** 2))
    return _unit(_filtered(rng.standard_normal((size_px, size_px)), gain))


def _fractal(size_px: int, rng: Rng, beta: float) -> Floats:
    """Periodic noise [size, size] of unit variance and amplitude spectrum f^-β, level below `COARSEST`."""
    frequency = np.maximum(_frequency(size_px), COARSEST)
    return _unit(_filtered(rng.standard_normal((size_px, size_px)), frequency**-beta))


def _lit(height: Floats) -> Floats:
    """How much light a relief gets more (or less) than flat ground does, to first order in its slopes."""
    down, right = (np.roll(height, -1, axis) - np.roll(height, 1, axis) for axis in (0, 1))
    return np.asarray(-(right * LIGHT[0] + down * LIGHT[1]) / 2)


def _power_law(smallest: float, largest: float, area_px: float, rng: Rng) -> Floats:
    """Radii of discs that cover `area_px` together, density ~ radius^-2.5 between the two."""
    mean_area = math.pi * 3 * smallest**1.5 * (largest**0.5 - smallest**0.5)
    u = rng.random(int(2 * area_px / mean_area) + 16)
    radii = (smallest**-1.5 + u * (largest**-1.5 - smallest**-1.5)) ** (-2 / 3)
    return np.asarray(radii[: int(np.searchsorted(np.cumsum(math.pi * radii**2), area_px))])


def _heaped(
    grey: Floats, radius: Floats, slim: tuple[float, float], bed: tuple[float, float], shade: Floats, rng: Rng
) -> Floats:
    """Lay ellipsoidal bodies on a ground [size, size], one on another, lit from the side.

    Body k has half-axes radius[k] and radius[k] · slim, any pose, a shade of its own, and rests `bed` thicknesses
    above or in the ground.
    """
    n = len(radius)
    columns = (
        len(grey) * rng.random(n),
        len(grey) * rng.random(n),
        radius,
        radius * rng.uniform(*slim, n),
        rng.uniform(0, math.pi, n),
        rng.uniform(*bed, n),
        shade,
    )
    _lay(grey, np.full(grey.shape, -math.inf), np.stack(columns, axis=1), LIGHT)
    return grey


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _lay(grey: Floats, height: Floats, bodies: Floats, light: Floats) -> None:
    """Draw bodies [n, 7] (x, y, half length, half width, turn, bed, shade) where they stand out of what lies there.

    The body over its own axes p, q is the dome h = 0.6 width √(1 - ρ^1.5), ρ = p² + q²; it is lit by the cosine
    between its normal and the light.
    """
    size = len(grey)
    for k in range(len(bodies)):
        x, y, length, width, turn, bed, shade = bodies[k]
        cos, sin, rise = math.cos(turn), math.sin(turn), 0.6 * width
        for v in range(math.ceil(y - length), math.floor(y + length) + 1):
            for u in range(math.ceil(x - length), math.floor(x + length) + 1):
                p = (cos * (u - x) + sin * (v - y)) / length
                q = (cos * (v - y) - sin * (u - x)) / width
                rho = p * p + q * q
                if rho >= 0.999:
                    continue
                dome = math.sqrt(1.0 - rho**1.5)
                top = bed * width + rise * dome
                i, j = v % size, u % size
                if top <= height[i, j]:
                    continue
                steep = -1.5 * math.sqrt(rho) / dome * rise
                along, across = steep * p / length, steep * q / width
                slope_x, slope_y = cos * along - sin * across, sin * along + cos * across
                glow = light[2] - slope_x * light[0] - slope_y * light[1]
                height[i, j] = top
                grey[i, j] = shade * (0.25 + 0.95 * max(glow, 0.0) / math.sqrt(1.0 + slope_x**2 + slope_y**2))


# ------------------------------------------------------------------------------------- the textures


def _gravel(size_px: int, rng: Rng) -> Floats:
    """Pebbles of all sizes, one on another."""
    radius = _power_law(2.5, 16.0, 4.0 * size_px**2, rng)
    shade = np.clip(rng.normal(118, 32, len(radius)), 45, 225)
    grey = _heaped(38 + 9 * _noise(size_px, rng, along_x_px=2), radius, (0.6, 1.0), (-0.5, 0.6), shade, rng)
    return grey + 14 * _noise(size_px, rng, along_x_px=0.8) + 8 * _noise(size_px, rng, along_x_px=40)


def _grass(size_px: int, rng: Rng) -> Floats:
    """Blades in all directions over shadow."""
    length = rng.uniform(10, 36, int(0.03 * size_px**2))
    shade = np.clip(rng.normal(125, 45, len(length)), 30, 250)
    grey = _heaped(30 + 10 * _noise(size_px, rng, along_x_px=1.5), length, (0.045, 0.09), (-4, 4), shade, rng)
    return grey + 14 * _noise(size_px, rng, along_x_px=24) + 8 * _noise(size_px, rng, along_x_px=0.8)


def _soil(size_px: int, rng: Rng) -> Floats:
    """Crumbs and clods of nearly one shade."""
    radius = _power_law(1.2, 11.0, 2.5 * size_px**2, rng)
    shade = np.clip(rng.normal(95, 14, len(radius)), 40, 150)
    bed = 55 + 12 * _noise(size_px, rng, along_x_px=1)
    grey = _heaped(bed, radius, (0.5, 1.0), (-0.9, 0.3), shade, rng)
    relief = _fractal(size_px, rng, 1.5)
    return grey + 40 * _lit(relief) + 14 * _noise(size_px, rng, along_x_px=0.7) + 14 * _fractal(size_px, rng, 1.0)


def _sand(size_px: int, rng: Rng) -> Floats:
    """Grains too fine to be seen, some coarser ones, and a gently uneven bed."""
    radius = _power_law(1.2, 5.0, 0.05 * size_px**2, rng)
    rough = np.exp(0.45 * _noise(size_px, rng, along_x_px=18))
    grey = 120 + 13 * rough * _noise(size_px, rng, along_x_px=0.8) + 10 * _fractal(size_px, rng, 1.3)
    return _heaped(grey, radius, (0.6, 1.0), (-0.2, 0.6), rng.normal(120, 40, len(radius)), rng)


def _mud(size_px: int, rng: Rng) -> Floats:
    """Dried mud: smooth plates with curled rims and cracks between."""
    centres = size_px * rng.random((max((size_px // 96) ** 2, 4), 2))
    y, x = np.mgrid[:size_px, :size_px].astype(np.float64)
    y, x = (p + 12 * _noise(size_px, rng, along_x_px=20) + 2 * _noise(size_px, rng, along_x_px=4) for p in (y, x))
    tree: Any = scipy.spatial.cKDTree(centres, boxsize=np.full(2, float(size_px)))
    places = np.stack([y % size_px, x % size_px], axis=-1) % size_px
    distance, plate = tree.query(places, k=2)
    rim = distance[..., 1] - distance[..., 0]
    crack = np.exp(-((rim / (4 + 2 * _noise(size_px, rng, along_x_px=30))) ** 2))
    curl = np.exp(-rim / 14)
    tone = rng.standard_normal(len(centres))[plate[..., 0]]
    relief = 30 * curl + 10 * _fractal(size_px, rng, 2.2)
    return np.asarray(4 * tone + 7 * _lit(relief) - 60 * crack + 4 * _fractal(size_px, rng, 1.9))


def _concrete(size_px: int, rng: Rng) -> Floats:
    """A trowelled face: fine relief, stains, pores."""
    grey = 200 + 9 * _lit(_noise(size_px, rng, along_x_px=1.6)) / 0.2 + 5 * _fractal(size_px, rng, 0.9)
    pores = _power_law(1.0, 4.0, 0.006 * size_px**2, rng)
    return _heaped(grey, pores, (0.7, 1.0), (-0.6, -0.5), rng.normal(165, 12, len(pores)), rng)


def _wood(size_px: int, rng: Rng) -> Floats:
    """Boards along x: growth rings cut lengthwise, fine fibres, every board of another tree."""
    y = np.arange(size_px)[:, None]
    bend = 1.3 * _noise(size_px, rng, along_x_px=110, along_y_px=34) + 0.1 * _noise(size_px, rng, along_x_px=20)
    year = (y / 16 + bend) % 1.0
    rings = year**2 * np.clip((1 - year) / 0.15, 0, 1)
    fibres = _noise(size_px, rng, along_x_px=5, along_y_px=0.8)
    pores = np.minimum(_noise(size_px, rng, along_x_px=2, along_y_px=0.7) + 1.5, 0)
    grain = _unit(rings) + 0.7 * fibres + 2.4 * pores + 0.6 * _noise(size_px, rng, along_x_px=70, along_y_px=6)
    for board in range(0, size_px, BOARD_PX):
        plank = grain[board : board + BOARD_PX]
        plank[:] = np.roll(plank, rng.integers(size_px), axis=1) + 0.7 * rng.standard_normal()
    return np.roll(grain, JOINT_PX // 2, axis=0)


def _board_joints(shape: tuple[int, int], rng: Rng) -> Floats:
    """A dark line between boards."""
    return np.repeat(_joint(shape[0])[:, None], shape[1], axis=1)


def _metal(size_px: int, rng: Rng) -> Floats:
    """Wear of sheet metal: smudges and a few hair-fine scratches."""
    smudges = _noise(size_px, rng, along_x_px=40) + 0.15 * _fractal(size_px, rng, 2.2)
    for long, wide in ((24, 0.7), (0.7, 24), (9, 0.7), (0.7, 9)):
        smudges += 0.25 * (_noise(size_px, rng, along_x_px=long, along_y_px=wide) > 2.6)
    return smudges + 0.06 * _noise(size_px, rng, along_x_px=0.7)


def _tread(shape: tuple[int, int], rng: Rng) -> Floats:
    """Tread plate: raised lozenges, turned by ±45° in alternation, each with its light and its dark flank."""
    rows, columns = shape
    v, u = np.mgrid[: 3 * rows, : 3 * columns].astype(np.float64)
    height = np.zeros((3 * rows, 3 * columns))
    for row in range(-1, 4):
        for column in range(-1, 4):
            for turn, shift in ((1, 0.25), (-1, 0.75)):
                y, x = v - (row + shift) * rows, u - (column + shift) * columns
                p, q = (x + turn * y) / 2**0.5, (y - turn * x) / 2**0.5
                np.fmax(height, 1 - (p / 50) ** 2 - np.abs(q) / 9, out=height)
    soft = _smoothed(height, 1.0)
    lit = np.tanh(3.5 * _lit(7 * soft) + 0.3 * soft)
    return np.asarray(lit[rows : 2 * rows, columns : 2 * columns])


def _street(size_px: int, rng: Rng) -> Floats:
    """The faces of pavers: fine grain, wear, every one of its own shade from the middle of a joint on."""
    tone = rng.standard_normal((size_px // PAVER_PX[0], size_px // PAVER_PX[1]))
    tone = np.roll(np.kron(tone, np.ones(PAVER_PX)), JOINT_PX // 2, axis=(0, 1))
    grain = _noise(size_px, rng, along_x_px=0.9)
    return np.asarray(0.7 * tone + 0.03 * grain + 0.5 * _fractal(size_px, rng, 2.2))


def _paver_joints(shape: tuple[int, int], rng: Rng) -> Floats:
    """Dark joints around a paver with a bevelled edge, lit from the side."""
    along_y, along_x = _joint(shape[0]), _joint(shape[1])
    depth = np.minimum(along_y[:, None], along_x)
    return np.asarray(depth + 0.5 * _lit(depth))


def _joint(n: int) -> Floats:
    """Grey across a joint [n]: 1 but for a dip to 0 over the first `JOINT_PX`, its edges 3 px soft."""
    outside = np.abs(np.arange(n) - (JOINT_PX - 1) / 2)
    outside = np.minimum(outside, n - outside) - JOINT_PX / 2
    return np.asarray(np.clip(outside / 3, 0, 1))


def _smoothed(grey: Floats, sigma_px: float) -> Floats:
    frequency = np.hypot(np.fft.fftfreq(grey.shape[0])[:, None], np.fft.rfftfreq(grey.shape[1]))
    return _filtered(grey, np.exp(-2 * (np.pi * sigma_px * frequency) ** 2))


_HIDDEN_PX = JOINT_PX - 2

FAMILIES: dict[str, Family] = {
    "gravel": Family(_gravel, contrast=8.3, spectrum=1.14, mean_grey=110),
    "wood": Family(
        _wood,
        contrast=1.5,
        spectrum=1.24,
        mean_grey=100,
        repetition=0.1,
        pattern=_board_joints,
        period_px=(BOARD_PX, BOARD_PX),
        x=Bond(step_px=1),
        y=Bond(BOARD_PX, _HIDDEN_PX, BOARD_PX, hidden=True),
        stagger=(5**0.5 - 1) / 2,
    ),
    "grass": Family(_grass, contrast=13.4, spectrum=0.87, mean_grey=108),
    "soil": Family(_soil, contrast=5.5, spectrum=1.10, mean_grey=95),
    "sand": Family(_sand, contrast=4.2, spectrum=1.04, mean_grey=125),
    "mud": Family(_mud, contrast=3.65, spectrum=1.28, mean_grey=150),
    "concrete": Family(_concrete, contrast=2.9, spectrum=0.43, mean_grey=200),
    "metal": Family(
        _metal,
        contrast=10.5,
        spectrum=1.30,
        mean_grey=150,
        repetition=0.87,
        pattern=_tread,
        period_px=(TREAD_PX, TREAD_PX),
        x=Bond(band_px=160),
        y=Bond(band_px=160),
    ),
    "street": Family(
        _street,
        contrast=4.4,
        spectrum=1.46,
        mean_grey=134,
        repetition=0.5,
        pattern=_paver_joints,
        period_px=PAVER_PX,
        x=Bond(PAVER_PX[1], _HIDDEN_PX, PAVER_PX[1], hidden=True),
        y=Bond(PAVER_PX[0], _HIDDEN_PX, PAVER_PX[0], hidden=True),
        stagger=0.5,
    ),
    "fractal": Family(partial(_fractal, beta=1.0), contrast=8.0, spectrum=1.0, mean_grey=125),
}

PAPER_GROUNDS = tuple(name for name in FAMILIES if name != "fractal")
"""The kinds of ground of paper A."""
