"""What a camera sees of a scene, and the frame that its sensor makes of it.

A picture is made of point samples of the surfaces' splines where the pixels' rays meet them, so that there is
no interpolation error that an estimator could take for motion. Where a pixel sees more of a surface than the
surface's own pixel, coarser copies take its place (`pyramid`); where it sees a long, narrow piece, several
samples along it are averaged. Noise is a function of a key and the pixel's number alone, so that every frame
can be rendered by itself, in any order, with the same bytes.

A downward camera's image has u to the right along body x (forward) and v down along minus body y (to the
right of the vehicle); pixel (0, 0) is the centre of the first pixel. Roll and pitch turn the body about its x
and y axes by the right-hand rule: a positive roll lifts the left side, a positive pitch lowers the nose.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Sequence

import numba as nb
import numpy as np
import scipy.ndimage
from numpy.typing import NDArray
from scipy.special import ndtri

from pipelines.lens import pinhole, project, ray_table, undistorted
from pipelines.simulation.motion import Motion, Mount
from pipelines.simulation.pyramid import level, sharp_only
from pipelines.simulation.raycast import ALONE, OWN_TEXELS, Bumps, Window, coarsest, draw
from pipelines.simulation.sampling import grey_at
from pipelines.simulation.scene import EVERYWHERE, Plane, Relief, Scene
from pipelines.simulation.scene import Patch as Patch
from pipelines.simulation.surfaces import NO_CELLS, Cells, Surface
from readers.streams import Camera

Floats = NDArray[np.float64]

_quantiles = ndtri((np.arange(1 << 16) + 0.5) / (1 << 16))
NORMAL = (_quantiles / _quantiles.std()).astype(np.float32)  # standard normal by its 16-bit quantile
STEEPEST = 0.95  # slope of a relief times flatness of a ray: below 1, they meet once
_ZERO, _HALF, _WHITE = (np.float32(x) for x in (0, 0.5, 255))
_GOLDEN, _MIX1, _MIX2 = np.uint64(0x9E3779B97F4A7C15), np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
_S16, _S27, _S30, _S31 = np.uint64(16), np.uint64(27), np.uint64(30), np.uint64(31)
_LOW16 = np.uint64(0xFFFF)


def view(
    scene: Scene,
    camera: Camera,
    mount: Mount,
    motion: Motion,
    t_s: float,
    *,
    exposure_s: float = 0.0,
    exposure_samples: int = 15,
    readout_s: float = 0.0,
) -> NDArray[np.float32]:
    """Noise-free grey levels [height, width] of what a moving camera sees.

    Args:
        scene: what there is to be seen.
        camera: intrinsics with distortion.
        mount: where the camera sits on the vehicle.
        motion: how the vehicle moves.
        t_s: the middle of the exposure of the image's middle row.
        exposure_s: how long the shutter is open; the image is the mean of `exposure_samples` moments of it.
        exposure_samples: how many.
        readout_s: time from the first to the last row of a rolling shutter: row v is seen (v/(rows - 1) - 1/2) of
            it after t_s; 0 is a global shutter, a negative time reads from the last row to the first.

    Raises:
        ValueError: the exposure is negative or has no sample; the camera is not above the ground; pixels that the
            distortion does not reach; a relief that the camera is in, or sees too flatly.
    """
    if exposure_s < 0 or exposure_samples < 1:
        raise ValueError(f"an exposure of {exposure_s} s in {exposure_samples} samples: 0 s and 1 sample at least")
    n = exposure_samples if exposure_s > 0 else 1
    moments = t_s + exposure_s * ((np.arange(n) + 0.5) / n - 0.5)
    rows = _row_shares(camera.height_px) * readout_s if readout_s else np.zeros(1)
    turns, positions = mount.world_t_camera(motion.at(np.add.outer(moments, rows).ravel()))
    lowest = float(positions[:, 2].min())
    if scene.ground is not None and not lowest > 0:
        raise ValueError(f"camera height {lowest:g} m at {t_s:g} s: it must be above the ground; lift the mount")
    image = np.zeros((camera.height_px, camera.width_px), dtype=np.float32)
    for turn, position in zip(np.split(turns, n), np.split(positions, n), strict=True):
        image += _instant(scene, camera, turn, position)
    return image / np.float32(n)


def _row_shares(rows: int) -> Floats:
    """Where in the readout the rows lie, -1/2 … 1/2."""
    return np.arange(rows) / max(rows - 1, 1) - 0.5


def _instant(scene: Scene, camera: Camera, turns: Floats, positions: Floats) -> NDArray[np.float32]:
    """What a camera sees with one pose, or one for every row: rotations [m, 3, 3], positions [m, 3]."""
    rays, slopes = _table(camera)
    shape = (camera.height_px, camera.width_px)
    few = [0, len(turns) // 2, -1]  # the readout is so short that the poses between lie between
    reaches = [
        [coarsest(pose, rays, slopes, plane.surface.metres_per_texel) for pose in _poses(plane, turns, positions)[few]]
        for plane in scene.on_the_ground
    ]
    sharp = [max(longest for longest, _ in reach) <= ALONE * OWN_TEXELS for reach in reaches]
    plain = undistorted(camera) and len(turns) == 1 and not (scene.planes or scene.relief)
    if plain and sharp and all(sharp):
        homography = _ground_h_pixel(turns[0], positions[0], camera.matrix)
        return radiance(scene.on_the_ground[0].surface, homography, shape, scene.patches)
    if scene.relief is not None:
        _check_relief(scene.relief, float(positions[:, 2].min()), max(flattest for _, flattest in reaches[0]))
    image = np.full(shape, scene.background_grey, dtype=np.float32)
    depth = np.full(shape, np.inf)

    def paint(plane: Plane, window: Window, is_sharp: bool, relief: Relief | None, behind: Floats) -> None:
        surface = plane.surface
        levels = sharp_only(surface) if is_sharp else scene.levels(surface)
        texel_m = surface.metres_per_texel
        x_min, x_max, y_min, y_max = plane.bounds_m
        bounds = (x_min / texel_m, x_max / texel_m, -y_max / texel_m, -y_min / texel_m)
        poses, bumps = _poses(plane, turns, positions), _bumps(relief, texel_m)
        draw(levels, poses, rays, slopes, bounds, window, is_sharp, bumps, behind, image)

    for plane, is_sharp in zip(scene.on_the_ground, sharp, strict=True):
        paint(plane, (0, shape[0], 0, shape[1]), is_sharp, scene.relief, np.empty((0, 0)))
    for plane in _from_behind(scene.planes, positions[few[1]]):
        window = _window(plane, camera, turns[few], positions[few])
        paint(plane, window, False, None, depth)
    return image


def _table(camera: Camera) -> tuple[Floats, NDArray[np.float32]]:
    """`lens.ray_table`, kept for the cameras used last."""
    size = (camera.width_px, camera.height_px)
    k, distortion = (np.asarray(a, dtype=np.float64).tobytes() for a in (camera.matrix, camera.distortion))
    return _table_of(*size, k, camera.distortion_model, distortion)


@functools.lru_cache(maxsize=8)
def _table_of(
    width_px: int, height_px: int, matrix: bytes, model: str, distortion: bytes
) -> tuple[Floats, NDArray[np.float32]]:
    k = np.frombuffer(matrix).reshape(3, 3)
    camera = pinhole(width_px, height_px, 1.0, model=model, distortion=np.frombuffer(distortion).tolist())
    return ray_table(dataclasses.replace(camera, matrix=k))


def _poses(plane: Plane, turns: Floats, positions: Floats) -> Floats:
    """Poses of the camera to a plane [m, 3, 4], as `raycast` has them."""
    scale = 1 / plane.surface.metres_per_texel
    plane_r_world = np.array([[scale], [-scale], [1]]) * plane.world_t_plane[:3, :3].T
    offsets = positions - plane.world_t_plane[:3, 3]
    return np.concatenate([plane_r_world @ turns, (offsets @ plane_r_world.T)[:, :, None]], axis=2)


def _bumps(relief: Relief | None, texel_m: float) -> Bumps:
    if relief is None:
        return Bumps(level(np.zeros((4, 4), dtype=np.float32), NO_CELLS), 0.0, 0.0)
    return Bumps(level(relief.coefficients, NO_CELLS), texel_m / relief.metres_per_sample, 2e-6 * relief.highest_m)


def _check_relief(relief: Relief, height_m: float, flattest: float) -> None:
    """Refuse a view in which a ray could meet the relief twice, or touch it."""
    if height_m <= relief.highest_m:
        raise ValueError(f"the camera at {height_m:g} m is among the bumps, up to {relief.highest_m:g} m: lift it")
    if not relief.steepest * flattest < STEEPEST:
        raise ValueError(
            f"a relief of slope {relief.steepest:.3g} seen by rays of up to {flattest:.3g} m per m of height: their "
            f"product must stay below {STEEPEST:g}; take lower or longer bumps, or a camera that looks more steeply"
        )


def _from_behind(planes: Sequence[Plane], eye: Floats) -> list[Plane]:
    """The planes in an order in which the nearer come after those that they hide; coplanar ones as they are.

    One is in front of another if all of it lies on the eye's side of the other, or all of the other on the far
    side of it; where that holds both ways, neither hides the other.
    """
    outlines = [plane.outline_m for plane in planes]

    def beside(points: Floats, plane: Plane) -> Floats:
        return np.asarray((points - plane.world_t_plane[:3, 3]) @ plane.world_t_plane[:3, 2])

    def in_front(i: int, j: int) -> bool:
        return bool(np.all(beside(outlines[i], planes[j]) >= -1e-9) or np.all(beside(outlines[j], planes[i]) <= 1e-9))

    facing = [i for i, plane in enumerate(planes) if beside(eye, plane) > 0]
    hides = {i: sum(in_front(i, j) and not in_front(j, i) for j in facing if j != i) for i in facing}
    return [planes[i] for i in sorted(facing, key=lambda i: hides[i])]


def _window(plane: Plane, camera: Camera, turns: Floats, positions: Floats) -> Window:
    """The part of the image in which a plane may be seen, as `raycast.draw` takes it."""
    outline = plane.outline_m
    in_cam = np.concatenate([(outline - at) @ turn for turn, at in zip(turns, positions, strict=True)])
    if np.all(in_cam[:, 2] <= 0):
        return (0, 0, 0, 0)
    pixels = project(camera, in_cam)
    size = np.array([camera.width_px, camera.height_px])
    if np.any(np.isnan(pixels)):
        return (0, camera.height_px, 0, camera.width_px)
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    margin = 3 + 0.02 * (high - low)  # distortion bends the edges between the points
    (u0, v0), (u1, v1) = (np.clip(x, 0, size).astype(int) for x in (low - margin, high + margin + 1))
    return (int(v0), int(v1), int(u0), int(u1))


def world_h_pixel(
    pose: Floats, matrix: Floats, height_m: float, *, roll_rad: float = 0.0, pitch_rad: float = 0.0
) -> Floats:
    """Homography [3, 3] from pixels (u, v, 1) to the ground (x, y, 1) in m.

    Args:
        pose: x (m), y (m), heading (rad) of the camera [3].
        matrix: the camera's K [3, 3] in px.
        height_m: height of the camera above the ground.
        roll_rad: turn about body x.
        pitch_rad: turn about body y.

    Raises:
        ValueError: the camera is not above the ground.
    """
    if not height_m > 0:
        raise ValueError(f"camera height {height_m} m: it must be above the ground")
    x, y, heading = pose
    cos, sin = math.cos(heading), math.sin(heading)
    turn = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
    cos, sin = math.cos(pitch_rad), math.sin(pitch_rad)
    pitch = np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])
    cos, sin = math.cos(roll_rad), math.sin(roll_rad)
    roll = np.array([[1, 0, 0], [0, cos, -sin], [0, sin, cos]])
    body_r_camera = np.diag([1.0, -1.0, -1.0])
    return _ground_h_pixel(turn @ pitch @ roll @ body_r_camera, np.array([x, y, height_m]), matrix)


def _ground_h_pixel(world_r_camera: Floats, position_m: Floats, matrix: Floats) -> Floats:
    """Homography [3, 3] from pixels to the ground of a camera [3, 3] at a position [3]."""
    x, y, height = position_m
    ground = np.array([[height, 0, -x], [0, height, -y], [0, 0, -1]])
    return np.asarray(ground @ (world_r_camera @ np.linalg.inv(matrix)))


def radiance(
    surface: Surface, world_h_pixel: Floats, shape: tuple[int, int], patches: Sequence[Patch] = ()
) -> NDArray[np.float32]:
    """Noise-free grey levels [height, width] of the ground that the camera sees."""
    image = np.empty(shape, dtype=np.float32)
    _paint(surface.coefficients, surface.cells, _texel_h_pixel(surface, world_h_pixel), EVERYWHERE, image)
    for p in patches:
        scale = 1 / p.surface.metres_per_texel
        bounds = (p.x_min_m * scale, p.x_max_m * scale, -p.y_max_m * scale, -p.y_min_m * scale)
        _paint(p.surface.coefficients, p.surface.cells, _texel_h_pixel(p.surface, world_h_pixel), bounds, image)
    return image


def expose(
    image: NDArray[np.float32],
    *,
    noise_key: int,
    noise_grey: float = 0.0,
    gain: float = 1.0,
    offset_grey: float = 0.0,
    vignetting: float = 0.0,
) -> NDArray[np.uint8]:
    """The frame uint8 [height, width] that a sensor makes of grey levels float32 [height, width].

    gain · image · (1 - vignetting · r²) + offset + Gaussian noise, rounded and clipped; r is the distance
    from the image centre, 1 in the corners. Equal keys give equal noise (`noise_key_of`).
    """
    frame = np.empty(image.shape, dtype=np.uint8)
    _expose(
        image,
        np.uint64(noise_key),
        np.float32(noise_grey),
        np.float32(gain),
        np.float32(offset_grey),
        vignetting,
        frame,
    )
    return frame


@functools.lru_cache(maxsize=4)
def dirt(shape: tuple[int, int], seed: int) -> NDArray[np.float32]:
    """Dirt on a lens, grey levels float32 [height, width]: grain and larger spots, of mean 110 and deviation 40."""
    rng = np.random.default_rng(seed)
    grain, spots = (scipy.ndimage.gaussian_filter(rng.standard_normal(shape), sigma) for sigma in (1.5, 8.0))
    pattern = grain / grain.std() + spots / spots.std()
    pattern = (110 + 40 * (pattern - pattern.mean()) / pattern.std()).astype(np.float32)
    pattern.setflags(write=False)
    return np.asarray(pattern)


def behind_dirt(image: NDArray[np.float32], share: float, seed: int) -> NDArray[np.float32]:
    """The image [height, width] with `dirt` over it, of the weight `share`, 0…1."""
    return np.asarray(image + np.float32(share) * (dirt(image.shape, seed) - image), dtype=np.float32)


def noise_key_of(seed: int, frame: int) -> int:
    """The key of one frame's noise: unrelated for any two pairs of seed and frame."""
    return int(np.random.SeedSequence((seed, frame)).generate_state(1, np.uint64)[0])


def _texel_h_pixel(surface: Surface, world_h_pixel: Floats) -> Floats:
    scale = 1 / surface.metres_per_texel
    return np.asarray(np.diag([scale, -scale, 1.0]) @ world_h_pixel)


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _paint(
    coef: NDArray[np.float32],
    cells: Cells,
    h: Floats,
    bounds: tuple[float, float, float, float],
    image: NDArray[np.float32],
) -> None:
    """Paint a surface into an image, inside `bounds` (texels x0, x1, y0, y1) with an edge two texels soft."""
    x0, x1, y0, y1 = bounds
    for v in range(image.shape[0]):
        for u in range(image.shape[1]):
            depth = 1.0 / (h[2, 0] * u + h[2, 1] * v + h[2, 2])
            x = (h[0, 0] * u + h[0, 1] * v + h[0, 2]) * depth
            y = (h[1, 0] * u + h[1, 1] * v + h[1, 2]) * depth
            inside = min(min(x - x0, x1 - x), min(y - y0, y1 - y)) * 0.5 + 0.5
            if inside <= 0.0:
                continue
            grey = grey_at(coef, cells, x, y)
            if inside >= 1.0:
                image[v, u] = grey
            else:
                image[v, u] += np.float32(inside) * (grey - image[v, u])


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _expose(
    image: NDArray[np.float32],
    key: np.uint64,
    noise_grey: np.float32,
    gain: np.float32,
    offset_grey: np.float32,
    vignetting: float,
    frame: NDArray[np.uint8],
) -> None:
    """Make the frame of `expose`; splitmix64 of key and pixel number gives the noise of four pixels."""
    rows, columns = image.shape
    mid_v, mid_u = 0.5 * (rows - 1), 0.5 * (columns - 1)
    fall = vignetting / max(mid_u * mid_u + mid_v * mid_v, 1.0)
    state, bits = key, np.uint64(0)
    number = 0
    for v in range(rows):
        for u in range(columns):
            if number % 4 == 0:
                state += _GOLDEN
                bits = (state ^ (state >> _S30)) * _MIX1
                bits = (bits ^ (bits >> _S27)) * _MIX2
                bits = bits ^ (bits >> _S31)
            noise = NORMAL[bits & _LOW16]
            bits = bits >> _S16
            number += 1
            shade = np.float32(1.0 - fall * ((u - mid_u) ** 2 + (v - mid_v) ** 2))
            grey = gain * shade * image[v, u] + offset_grey + noise_grey * noise
            frame[v, u] = np.uint8(min(max(grey + _HALF, _ZERO), _WHITE))
