"""A textured plane seen by a camera: analytic, smooth, sampled exactly where each pixel's ray meets it."""

import numpy as np
from scipy import ndimage

from pipelines import lens
from readers.streams import Camera

WAVES = np.random.default_rng(11)
DIRECTIONS = WAVES.normal(0, 1, (12, 2))
PHASES = WAVES.uniform(0, 2 * np.pi, 12)


def plane_grey(x: np.ndarray, y: np.ndarray, wave: float) -> np.ndarray:
    """Grey levels of a plane at (x, y) in m: 12 waves of about `wave` rad/m, any shape."""
    waves = np.sin(wave * (x[..., None] * DIRECTIONS[:, 0] + y[..., None] * DIRECTIONS[:, 1]) + PHASES)
    return 128 + 20 * waves.sum(-1)


def seen(camera: Camera, cam_T_world: np.ndarray, wave: float = 12.0) -> np.ndarray:
    """The image, uint8, of the plane z = 0 of the world."""
    v, u = np.mgrid[: camera.height_px, : camera.width_px].astype(float)
    points = on_plane(camera, cam_T_world, np.column_stack([u.ravel(), v.ravel()]))
    grey = plane_grey(points[:, 0], points[:, 1], wave).reshape(u.shape)
    return np.clip(np.round(grey), 0, 255).astype(np.uint8)


def on_plane(camera: Camera, cam_T_world: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Points [n, 3] of the plane z = 0 of the world that the pixels [n, 2] see."""
    world_T_cam = np.linalg.inv(cam_T_world)
    directions = lens.rays(camera, pixels) @ world_T_cam[:3, :3].T
    centre = world_T_cam[:3, 3]
    return centre + directions * (-centre[2] / directions[:, 2])[:, None]


def looking_down(height: float = 1.5) -> np.ndarray:
    """cam_T_world of a camera over the origin, its u along world x, its v along world -y."""
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[2, 3] = height
    return pose


def moved(points: np.ndarray, transform: np.ndarray) -> np.ndarray:
    """Points [n, 3] through a transform [4, 4]."""
    return points @ transform[:3, :3].T + transform[:3, 3]


def noise_texture(shape: tuple[int, int], sigma: float, seed: int) -> np.ndarray:
    """A random grey image of that smoothness, uint8."""
    smooth = ndimage.gaussian_filter(np.random.default_rng(seed).normal(size=shape), sigma, mode="wrap")
    return np.clip(np.round(128 + 40 * smooth / smooth.std()), 0, 255).astype(np.uint8)
