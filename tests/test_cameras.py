"""Cameras of simulated missions: lenses, and what they see of a scene."""

import cv2
import numpy as np
import pytest

from pipelines.simulation.lens import pinhole, project, rays
from pipelines.simulation.mission import nadir_camera
from readers.streams import Camera

# ---------------------------------------------------------------------------------- lenses

LENSES = {
    "none": ("none", ()),
    "plumb_bob": ("plumb_bob", (-0.28, 0.07, 0.0004, -0.0003, 0.01)),
    "pincushion": ("plumb_bob", (0.12, 0.02)),
    "rational_polynomial": ("rational_polynomial", (0.5, -0.2, 0.001, -0.002, 0.05, 0.8, -0.1, 0.03)),
    "equidistant": ("equidistant", (-0.012, 0.03, -0.02, 0.004)),
}


def lens(name: str, width: int = 640, height: int = 480, focal: float = 420.0) -> Camera:
    model, distortion = LENSES[name]
    return pinhole(width, height, focal, model=model, distortion=distortion, centre_px=(310.5, 247.25))


def points_before(n: int = 300) -> np.ndarray:
    rng = np.random.default_rng(0)
    return np.column_stack([rng.uniform(-0.7, 0.7, n), rng.uniform(-0.6, 0.6, n), np.ones(n)]) * rng.uniform(
        0.3, 9, (n, 1)
    )


@pytest.mark.parametrize("name", LENSES)
def test_points_fall_where_opencv_puts_them(name: str) -> None:
    camera, points = lens(name), points_before()
    k, d, zero = camera.matrix, camera.distortion, np.zeros(3)
    if name == "equidistant":
        expected, _ = cv2.fisheye.projectPoints(points[:, None], zero, zero, k, d)
    else:
        expected, _ = cv2.projectPoints(points, zero, zero, k, d if d.size else None)
    np.testing.assert_allclose(project(camera, points), expected[:, 0], atol=1e-9)


@pytest.mark.parametrize("name", LENSES)
def test_rays_invert_the_projection(name: str) -> None:
    camera = lens(name)
    v, u = np.mgrid[0:480:7, 0:640:7]
    pixels = np.column_stack([u.ravel(), v.ravel()]).astype(float)
    found = rays(camera, pixels)
    assert np.all(found[:, 2] == 1)
    np.testing.assert_allclose(project(camera, found * 3.7), pixels, atol=1e-9)


def test_the_principal_point_looks_straight_ahead() -> None:
    for name in LENSES:
        np.testing.assert_allclose(rays(lens(name), np.array([[310.5, 247.25]])), [[0, 0, 1]], atol=1e-12)


def test_no_pixel_behind_the_camera_or_beyond_the_model() -> None:
    points = np.array([[0.1, 0, 1], [0.1, 0, -1], [0.1, 0, 0], [1.5, 0, 1]])
    folding = pinhole(64, 48, 50.0, distortion=(-0.3,))  # r (1 - 0.3 r²) turns back at r = 1.054
    seen = project(folding, points)
    assert np.isfinite(seen[:, 0]).tolist() == [True, False, False, False]
    assert np.isfinite(project(lens("none"), points)[:, 0]).tolist() == [True, False, False, True]


def test_a_pixel_that_the_model_does_not_reach_is_refused() -> None:
    folding = pinhole(600, 10, 400.0, distortion=(-0.3,))  # its widest ray leads to r = 0.703
    rays(folding, np.array([[299.5 + 0.70 * 400, 4.5]]))
    with pytest.raises(ValueError, match="does not reach"):
        rays(folding, np.array([[299.5, 4.5], [299.5 + 0.71 * 400, 4.5]]))


def test_a_pinhole_is_the_nadir_camera() -> None:
    ours, paper = pinhole(512, 512, 256.0), nadir_camera()
    for field in Camera.__dataclass_fields__:
        assert np.array_equal(getattr(ours, field), getattr(paper, field)), field


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"model": "thin_prism"}, "one of none"),
        ({"distortion": (0.1,) * 6}, "the plumb_bob model has 5"),
        ({"focal_px": 0.0}, "must be positive"),
    ],
)
def test_cameras_that_cannot_be_are_refused(change: dict, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        pinhole(**({"width_px": 64, "height_px": 48, "focal_px": 50.0} | change))
