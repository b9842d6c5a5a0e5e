"""Corners against OpenCV and plain numpy; feature alignment against analytic shifts and rendered planes."""

import cv2
import numpy as np
import pytest
from semidirect_scenes import looking_down, moved, noise_texture, on_plane, seen

from pipelines import lens
from pipelines.geometry import se3_exp
from pipelines.semidirect.features import (
    CornerOptions,
    FeatureOptions,
    References,
    affine_of_plane,
    align_features,
    align_patch,
    cells_of,
    corner_score,
    corners,
    nearest_views,
    occupied_cells,
    search_level,
    warped_patch,
)
from pipelines.semidirect.optics import optics_of
from pipelines.semidirect.pyramid import level_image, on_finest, pyramid_of, sample
from pipelines.semidirect.step import Feature

CAMERA = lens.pinhole(376, 240, 210.0, distortion=(-0.1, 0.02, 1e-3, -1e-3))
FACING = np.array([0.0, 0.0, 1.0])


# --------------------------------------------------------------------------------------- corners


def test_score_is_the_smaller_eigenvalue() -> None:
    image = noise_texture((40, 40), 1.5, 1)
    u, v, g = 20, 17, image.astype(float)
    dx = (g[v - 4 : v + 4, u - 3 : u + 5] - g[v - 4 : v + 4, u - 5 : u + 3]).ravel()
    dy = (g[v - 3 : v + 5, u - 4 : u + 4] - g[v - 5 : v + 3, u - 4 : u + 4]).ravel()
    d = np.stack([dx, dy])
    assert corner_score(image, u, v) == pytest.approx(np.linalg.eigvalsh(d @ d.T / 128)[0], rel=1e-12)


def test_each_free_cell_has_its_best_corner() -> None:
    options = CornerOptions()
    pyramid = pyramid_of(noise_texture((245, 370), 1.2, 2))
    occupied = np.random.default_rng(3).random(cells_of(pyramid, options)) < 0.4
    found = corners(pyramid, occupied, options)
    best: dict[tuple[int, int], float] = {}
    for level in range(3):
        image = level_image(pyramid, level)
        for key in cv2.FastFeatureDetector.create(7).detect(image):
            u, v = (round(x) for x in key.pt)
            if min(u, v) < 8 or u >= image.shape[1] - 8 or v >= image.shape[0] - 8:
                continue
            cell = (int((on_finest(v, level) + 0.5) // 30), int((on_finest(u, level) + 0.5) // 30))
            best[cell] = max(best.get(cell, 0), corner_score(image, u, v))
    expected = {cell: score for cell, score in best.items() if not occupied[cell] and score > 4}
    cells = [(int((v + 0.5) // 30), int((u + 0.5) // 30)) for u, v in found.pixels]
    assert dict(zip(cells, found.score, strict=True)) == pytest.approx(expected)
    assert len(set(cells)) == len(cells) > 30
    assert set(found.level) > {0}
    filled = occupied_cells(pyramid, found.pixels, options)
    assert np.array_equal(np.argwhere(filled), np.array(sorted(cells)))
    assert len(corners(pyramid, occupied | filled, options).score) == 0


def test_an_image_without_corners_and_a_wrong_grid() -> None:
    pyramid = pyramid_of(np.full((64, 64), 7, np.uint8))
    assert corners(pyramid, np.zeros((3, 3), np.bool_), CornerOptions()).pixels.shape == (0, 2)
    with pytest.raises(ValueError, match="cells"):
        corners(pyramid, np.zeros((2, 3), np.bool_), CornerOptions())


# ------------------------------------------------------------------------------- point and keyframe


def test_the_nearest_view_has_the_smallest_angle() -> None:
    points = np.array([[0, 0, 0], [1, 0, 0], [5, 5, 0.0]])
    centres = np.array([[-1, 0, 1], [0.1, 0, 1], [3, 0, 1.0]])
    views = nearest_views(points, np.array([0, 0, 1.0]), np.array([0, 3, 5, 5]), np.array([0, 1, 2, 2, 0]), centres)
    assert views.observation.tolist() == [1, 4, -1]
    for i, frame in ((0, 1), (1, 0)):
        a, b = np.array([0, 0, 1.0]) - points[i], centres[frame] - points[i]
        assert views.cosine[i] == pytest.approx(a @ b / np.linalg.norm(a) / np.linalg.norm(b))


@pytest.mark.parametrize("normal", [FACING, np.array([0.3, -0.2, 0.9])])
def test_the_affine_map_by_differences(normal: np.ndarray) -> None:
    transform = se3_exp(np.array([0.2, -0.1, 0.1, 0.05, -0.08, 0.4]))
    pixel, depth, h = np.array([250.0, 60.0]), 1.7, 1e-3
    pixels = pixel + h * np.array([[1, 0], [0, 1], [-1, 0], [0, -1.0]])
    middle = lens.rays(CAMERA, pixel[None])[0] * depth
    directions = lens.rays(CAMERA, pixels)
    on_the_plane = directions * ((normal @ middle) / (directions @ normal))[:, None]
    arrived = lens.project(CAMERA, moved(on_the_plane, transform))
    expected = ((arrived[:2] - arrived[2:]) / (2 * h)).T
    found = affine_of_plane(optics_of(CAMERA), pixel, depth, normal, transform)
    assert np.allclose(found, expected, rtol=0, atol=1e-6 * np.abs(expected).max())


@pytest.mark.parametrize(("stretch", "ref_level", "level"), [(1, 0, 0), (2, 0, 1), (1, 2, 2), (0.4, 2, 0), (20, 0, 2)])
def test_the_search_level_has_pixels_of_the_patch_size(stretch: float, ref_level: int, level: int) -> None:
    assert search_level(stretch * np.eye(2), ref_level) == level


def test_a_warped_patch_takes_the_inverse_map() -> None:
    image = noise_texture((60, 60), 2, 5)
    cur_by_ref = np.array([[1.2, 0.3], [-0.2, 0.9]])
    patch = np.empty((10, 10))
    assert warped_patch(image, 30.3, 28.6, cur_by_ref, patch)
    for y, x in [(0, 0), (3, 7), (9, 2)]:
        du, dv = np.linalg.solve(cur_by_ref, [x - 4.5, y - 4.5])
        assert patch[y, x] == pytest.approx(sample(image, 30.3 + du, 28.6 + dv), abs=1e-10)
    assert not warped_patch(image, 4.0, 30.0, np.eye(2), patch)
    assert not warped_patch(image, 30.0, 30.0, np.zeros((2, 2)), patch)


# ------------------------------------------------------------------------------ feature alignment


def product(shift_u: float, shift_v: float, mean: float = 128.0) -> np.ndarray:
    """3 (u - 16 - shift_u)(v - 16 - shift_v) + mean, whole numbers but for a constant; bilinear samples are exact."""
    v, u = np.mgrid[:32, :32].astype(float)
    values = 3 * (u - 16) * (v - 16) - 3 * shift_v * (u - 16) - 3 * shift_u * (v - 16) + mean
    assert np.allclose(values, np.round(values))
    return np.clip(np.round(values), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("tolerance", [1e-9, 0.03])
@pytest.mark.parametrize(("shift_u", "shift_v"), [(0, 0), (1 / 3, 2 / 3), (-1 / 3, 1 / 3), (1, -2 / 3)])
def test_analytic_shifts_are_found(shift_u: float, shift_v: float, tolerance: float) -> None:
    patch = np.empty((10, 10))
    assert warped_patch(product(0, 0), 15.5, 15.5, np.eye(2), patch)
    found = align_patch(product(shift_u, shift_v), patch, 15.5, 15.5, FeatureOptions(40, tolerance))
    assert found.outcome == Feature.MATCHED
    assert np.hypot(found.u - 15.5 - shift_u, found.v - 15.5 - shift_v) < (1e-6 if tolerance < 1e-6 else 0.02)
    if tolerance < 1e-6:  # the shifted product lacks its constant 3 shift_u shift_v
        assert found.mean_difference == pytest.approx(-3 * shift_u * shift_v, abs=1e-5)
        assert found.residual_rms < 1e-5


def test_the_fixed_point_has_no_gradient_in_noise() -> None:
    """Where it stops, Σ Jᵀ r of plain numpy vanishes, and the residual is that of plain numpy."""
    image, other = noise_texture((40, 40), 2, 6), noise_texture((40, 40), 2, 6)
    other = np.clip(other + np.random.default_rng(1).normal(0, 6, other.shape), 0, 255).astype(np.uint8)
    patch = np.empty((10, 10))
    warped_patch(image, 20.4, 19.3, np.eye(2), patch)
    found = align_patch(other, patch, 20.0, 20.0, FeatureOptions(100, 1e-10))
    inner = patch[1:-1, 1:-1]
    j = np.stack([(patch[1:-1, 2:] - patch[1:-1, :-2]) / 2, (patch[2:, 1:-1] - patch[:-2, 1:-1]) / 2, np.ones((8, 8))])
    place = [[sample(other, found.u - 3.5 + x, found.v - 3.5 + y) for x in range(8)] for y in range(8)]
    r = np.array(place) - inner - found.mean_difference
    assert np.max(np.abs((j * r).sum((1, 2)))) < 1e-5
    assert found.residual_rms == pytest.approx(np.sqrt(np.mean(r**2)), rel=1e-9)
    assert found.correlation == pytest.approx(np.corrcoef(np.ravel(place), inner.ravel())[0, 1], rel=1e-6)


def test_failures_of_a_patch_have_their_causes() -> None:
    image, patch = noise_texture((40, 40), 2, 6), np.empty((10, 10))
    warped_patch(np.full((40, 40), 9, np.uint8), 20.0, 20.0, np.eye(2), patch)
    assert align_patch(image, patch, 20.0, 20.0, FeatureOptions()).outcome == Feature.FLAT
    u = np.mgrid[:40, :40][1]
    warped_patch((3 * u).astype(np.uint8), 20.0, 20.0, np.eye(2), patch)  # an edge tells nothing along itself
    assert align_patch(image, patch, 20.0, 20.0, FeatureOptions()).outcome == Feature.FLAT
    warped_patch(image, 20.0, 20.0, np.eye(2), patch)
    assert align_patch(image, patch, 20.6, 20.5, FeatureOptions(1)).outcome == Feature.NOT_CONVERGED
    assert align_patch(image, patch, 2.0, 20.0, FeatureOptions()).outcome == Feature.LEFT_IMAGE


def references(pixels: np.ndarray, depth: np.ndarray, level: np.ndarray, normal: np.ndarray) -> References:
    n = len(pixels)
    return References(
        np.zeros(n, np.int64), pixels, level, depth, np.broadcast_to(normal, (n, 3)).copy(), np.ones(n)
    )  # fmt: skip


def test_points_of_a_rendered_plane_are_found() -> None:
    """Turned by 30°, nearer by a third, tilted: the affine patch still fits; the prediction is 1 px wrong."""
    rng, first = np.random.default_rng(8), looking_down()
    second = se3_exp(np.array([0.1, 0.05, -0.3, 0.05, -0.06, 0.5])) @ first
    key, current = (pyramid_of(seen(CAMERA, pose, 25)) for pose in (first, second))
    pixels = rng.uniform((40, 30), (335, 209), (60, 2))
    world = on_plane(CAMERA, first, pixels)
    depth = moved(world, first)[:, 2].copy()
    wrong = se3_exp(np.array([0.006, -0.004, 0, 0, 0, 0]))
    refs = references(pixels, depth, rng.integers(0, 2, 60), FACING)
    found = align_features(
        key.buffer[None],
        current,
        optics_of(CAMERA),
        (wrong @ second @ np.linalg.inv(first))[None],
        refs,
        FeatureOptions(),
    )
    truth = lens.project(CAMERA, moved(world, second))
    inside = np.all((truth > 30) & (truth < (345, 209)), axis=1)
    good = found.outcome == Feature.MATCHED
    assert inside.sum() > 30
    assert good[inside].mean() > 0.9
    error = np.hypot(*(found.pixels - truth)[good].T)
    start = np.hypot(*(found.predicted - truth)[good].T)
    assert np.median(start) > 0.7
    assert np.median(error) < 0.05
    outside = np.any((found.predicted < 0) | (found.predicted > (375, 239)), axis=1)
    assert outside.any()
    assert np.array_equal(outside, found.outcome == Feature.OUT_OF_VIEW)
    assert set(found.level[good]) >= {0, 1}


def test_what_is_not_searched_says_why() -> None:
    image = pyramid_of(noise_texture((240, 376), 2, 9))
    pixels = np.array([[100, 100], [100, 100], [3, 100], [180, 120.0]])
    refs = references(pixels, np.full(4, 1.5), np.zeros(4, np.int64), FACING)
    refs.cosine[1] = 0.4
    poses = np.stack([np.eye(4), se3_exp(np.array([9.0, 0, 0, 0, 0, 0]))])
    refs.frame[0] = 1
    found = align_features(
        np.stack([image.buffer, image.buffer]), image, optics_of(CAMERA), poses, refs, FeatureOptions()
    )
    assert found.outcome.tolist() == [
        Feature.OUT_OF_VIEW, Feature.OBLIQUE, Feature.REFERENCE_OUT_OF_VIEW, Feature.MATCHED
    ]  # fmt: skip
    assert np.allclose(found.pixels[3], pixels[3], atol=1e-9)
    assert np.isnan(found.pixels[:3]).all()
    small = pyramid_of(noise_texture((64, 64), 2, 9))
    with pytest.raises(ValueError, match="differ in size"):
        align_features(small.buffer[None], image, optics_of(CAMERA), poses, refs, FeatureOptions())
