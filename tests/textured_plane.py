"""Pictures of a plane with a smooth analytic texture: every pixel's grey value is exact at its centre."""

import numpy as np

from pipelines import lens


def texture(x, y, seed=3):
    """Grey value 0-255 at places of the plane, m; waves of 4 to 60 cm in all directions."""
    rng = np.random.default_rng(seed)
    total = np.zeros_like(x)
    for length in np.geomspace(0.04, 0.6, 28):
        angle, phase = rng.uniform(0, 2 * np.pi, 2)
        total += length**0.35 * np.cos(2 * np.pi / length * (x * np.cos(angle) + y * np.sin(angle)) + phase)
    return np.clip(128 + 38 * total, 0, 255)


def picture(camera, world_r_cam, centre, normal=(0.0, 0.0, 1.0), distance=1.5):
    """The plane n·x = d seen from a place: grey values uint8 [rows, cols]."""
    v, u = np.mgrid[: camera.height_px, : camera.width_px]
    rays = lens.rays(camera, np.column_stack([u.ravel(), v.ravel()]).astype(float)) @ world_r_cam.T
    n = np.asarray(normal)
    points = centre + rays * ((distance - n @ centre) / (rays @ n))[:, None]
    return np.rint(texture(points[:, 0], points[:, 1])).astype(np.uint8).reshape(u.shape)
