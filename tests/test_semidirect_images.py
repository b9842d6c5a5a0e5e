"""Camera, pyramid and small solvers of the semi-direct odometry against the lens module, plain numpy and OpenCV."""

import numpy as np
import pytest

from pipelines import lens
from pipelines.semidirect import linear
from pipelines.semidirect.optics import optics_of, project, ray
from pipelines.semidirect.pyramid import (
    LEVELS,
    level_image,
    on_finest,
    on_level,
    pyramid_of,
    sample,
)

CAMERAS = {
    "none": lens.pinhole(752, 480, 420.0, model="none"),
    "plumb_bob": lens.pinhole(752, 480, 420.0, distortion=(-0.28, 0.07, 2e-4, -3e-4, 0.01)),
    "rational": lens.pinhole(
        752, 480, 420.0, model="rational_polynomial", distortion=(0.2, -0.1, 1e-4, 2e-4, 0.02, 0.1, 0.03, 0.01)
    ),
    "equidistant": lens.pinhole(752, 480, 300.0, model="equidistant", distortion=(-0.01, 0.02, -0.005, 0.001)),
}


@pytest.mark.parametrize("name", CAMERAS)
def test_points_and_rays_are_those_of_the_lens(name: str) -> None:
    camera = CAMERAS[name]
    optics = optics_of(camera)
    pixels = np.random.default_rng(2).uniform((0, 0), (751, 479), (60, 2))
    expected = lens.rays(camera, pixels)
    for pixel, truth in zip(pixels, expected, strict=True):
        assert np.allclose(ray(optics, *pixel), truth[:2], atol=1e-10)
        found = project(optics, *(2.5 * truth))
        assert np.allclose(found[:2], pixel, atol=1e-8)


@pytest.mark.parametrize("name", CAMERAS)
def test_derivatives_of_the_projection(name: str) -> None:
    camera, h = CAMERAS[name], 1e-5
    optics = optics_of(camera)
    for point in np.random.default_rng(4).uniform((-0.8, -0.5, 0.9), (0.8, 0.5, 1.6), (20, 3)):
        steps = np.vstack([point + h * np.eye(3), point - h * np.eye(3)])
        moved = lens.project(camera, steps)
        differences = (moved[:3] - moved[3:]).T / (2 * h)
        found = np.array(project(optics, *point)[2:]).reshape(2, 3)
        assert np.max(np.abs(found - differences)) < 1e-6 * np.max(np.abs(differences))


def test_what_has_no_pixel_is_nan() -> None:
    optics = optics_of(lens.pinhole(752, 480, 420.0, distortion=(-0.28,)))
    assert np.isnan(project(optics, 0.1, 0.1, -1.0)).all()
    assert np.isnan(project(optics, 5.0, 0.0, 1.0)).all()  # beyond where the distortion folds
    assert np.isnan(ray(optics, 9000.0, 240.0)).all()
    camera = lens.pinhole(64, 48, 50.0)
    camera.matrix[1, 0] = 1.0
    with pytest.raises(ValueError, match="give it as"):
        optics_of(camera)


@pytest.mark.parametrize("shape", [(480, 752), (131, 77)])
def test_levels_are_means_of_four(shape: tuple[int, int]) -> None:
    image = np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)
    image.setflags(write=False)
    pyramid = pyramid_of(image)
    assert np.array_equal(level_image(pyramid, 0), image)
    for level in range(1, LEVELS):
        finer, coarser = level_image(pyramid, level - 1).astype(int), level_image(pyramid, level)
        rows, columns = (n // 2 for n in finer.shape)
        four = finer[: 2 * rows, : 2 * columns].reshape(rows, 2, columns, 2).sum((1, 3))
        assert coarser.shape == (rows, columns)
        assert np.max(np.abs(coarser - four / 4)) <= 0.5


def test_places_on_levels_are_the_pixels_they_are_means_of() -> None:
    assert on_level(0.5, 1) == 0.0
    assert on_level(1.5, 2) == 0.0
    for level in range(LEVELS):
        assert on_finest(on_level(17.3, level), level) == pytest.approx(17.3, abs=1e-12)


def test_samples_of_a_bilinear_image_are_exact() -> None:
    v, u = np.mgrid[:10, :12]
    image = (2 * u * v + u + 3 * v).astype(np.uint8)
    assert sample(image, 3.25, 4.5) == 2 * 3.25 * 4.5 + 3.25 + 13.5


@pytest.mark.parametrize("wrong", [np.zeros((8, 8), np.uint8), np.zeros((64, 64)), np.zeros((64, 64, 3), np.uint8)])
def test_images_that_have_no_pyramid(wrong: np.ndarray) -> None:
    with pytest.raises(ValueError, match="give"):
        pyramid_of(wrong)


def test_cholesky_is_that_of_numpy() -> None:
    a = np.random.default_rng(7).normal(size=(9, 6))
    h, b = a.T @ a, np.arange(6.0)
    assert np.allclose(linear.inverse(h, 6), np.linalg.inv(h), rtol=1e-10)
    x = b.copy()
    factored = h.copy()
    assert linear.factor(factored, 6)
    linear.substitute(factored, x, 6)
    assert np.allclose(x, np.linalg.solve(h, b), rtol=1e-10)
    assert not linear.factor(np.outer(b, b), 6)
    assert np.isnan(linear.inverse(np.zeros((3, 3)), 3)).all()
