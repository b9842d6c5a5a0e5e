"""Sparse image alignment: derivatives by differences, kernel against plain numpy, exact, and consistent."""

import numpy as np
import pytest
from scipy import stats
from semidirect_scenes import looking_down, moved, noise_texture, on_plane, seen

from pipelines import lens
from pipelines.geometry import se3_exp, se3_log
from pipelines.semidirect.alignment import (
    Options,
    Stop,
    align,
    hessian,
    reference_patches,
    residuals,
)
from pipelines.semidirect.optics import optics_of, project, rays
from pipelines.semidirect.pyramid import level_image, on_level, pyramid_of

CAMERA = lens.pinhole(376, 240, 210.0, distortion=(-0.1, 0.02, 1e-3, -1e-3))
PLAIN = lens.pinhole(384, 256, 256.0, model="none")
OPTIONS = Options(iterations=30)


def grid(step: int, margin: int, camera=PLAIN) -> np.ndarray:
    u, v = np.meshgrid(
        np.arange(margin, camera.width_px - margin, step), np.arange(margin, camera.height_px - margin, step)
    )
    return np.column_stack([u.ravel(), v.ravel()]).astype(float)


def at_depth(camera, pixels: np.ndarray, depth: float | np.ndarray) -> np.ndarray:
    return rays(optics_of(camera), pixels) * np.reshape(depth, (-1, 1))


@pytest.mark.parametrize("level", [2, 4])
def test_derivatives_by_the_twist(level: int) -> None:
    optics, pixels, h = optics_of(CAMERA), grid(60, 70, CAMERA), 1e-6
    points = at_depth(CAMERA, pixels, np.linspace(1, 2, len(pixels)))
    patches = reference_patches(pyramid_of(noise_texture((240, 376), 3, 1)), level, optics, pixels, points)
    for i in np.flatnonzero(patches.usable):
        for a in range(6):
            there, back = (
                [
                    on_level(x, level)
                    for x in project(optics, *moved(points[i : i + 1], se3_exp(s * np.eye(6)[a]))[0])[:2]
                ]
                for s in (h, -h)
            )
            slope = (np.array(there) - back) / (2 * h)
            assert np.allclose(patches.jacobian[i, :, a], slope, atol=1e-6 * np.abs(patches.jacobian[i]).max())


def plain_sample(image: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    c, r = np.floor(u).astype(int), np.floor(v).astype(int)
    f, g, image = u - c, v - r, image.astype(float)
    return (1 - g) * ((1 - f) * image[r, c] + f * image[r, c + 1]) + g * (
        (1 - f) * image[r + 1, c] + f * image[r + 1, c + 1]
    )


def test_kernel_against_plain_numpy() -> None:
    level, gain, offset = 2, 1.1, -4.0
    optics, pixels = optics_of(CAMERA), grid(31, 3, CAMERA)
    points = at_depth(CAMERA, pixels, 1.5)
    first, second = pyramid_of(noise_texture((240, 376), 6, 1)), pyramid_of(noise_texture((240, 376), 6, 2))
    transform = se3_exp(np.array([0.03, -0.02, 0.05, 0.01, 0.02, -0.03]))
    patches = reference_patches(first, level, optics, pixels, points)
    found = residuals(second, level, optics, patches, points, transform, gain, offset)
    rows, squares, seen_patches = [], [], 0
    dy, dx = (d.ravel() - 1.5 for d in np.mgrid[:4, :4])
    images = level_image(first, level), level_image(second, level)
    arrived = lens.project(CAMERA, moved(points, transform))
    for i, (pixel, place) in enumerate(zip(on_level(pixels, level), on_level(arrived, level), strict=True)):
        border = np.array(images[0].shape)[::-1] - 1
        usable = np.all(pixel >= 2.5) and np.all(pixel < border - 2.5)
        assert patches.usable[i] == usable
        if not (usable and np.all(place >= 1.5) and np.all(place < border - 1.5)):
            assert not found.visible[i]
            continue
        seen_patches += 1
        u, v = pixel[0] + dx, pixel[1] + dy
        grey = plain_sample(images[0], u, v)
        slope_u = (plain_sample(images[0], u + 1, v) - plain_sample(images[0], u - 1, v)) / 2
        slope_v = (plain_sample(images[0], u, v + 1) - plain_sample(images[0], u, v - 1)) / 2
        r = plain_sample(images[1], place[0] + dx, place[1] + dy) - gain * grey - offset
        j = np.column_stack([np.column_stack([slope_u, slope_v]) @ patches.jacobian[i], grey, np.ones(16)])
        rows.append((j, r))
        squares.append(np.mean(r**2))
    j, r = (np.concatenate(x) for x in zip(*rows, strict=True))
    assert 20 < seen_patches < len(pixels)
    assert np.allclose(found.gradient, j.T @ r, rtol=1e-9)
    assert np.allclose(np.tril(hessian(patches, found.visible)), np.tril(j.T @ j), rtol=1e-9)
    assert found.cost == pytest.approx(np.mean(r**2), rel=1e-12)
    assert np.allclose(found.mean_square[found.visible], squares, rtol=1e-12)


@pytest.mark.parametrize("illumination", [False, True])
def test_a_shift_by_whole_pixels_is_found_exactly(illumination: bool) -> None:
    """16 px are whole pixels on every level: both pyramids hold the same numbers and the truth has no residual."""
    wide = noise_texture((256, 416), 9, 3)
    reference, current = pyramid_of(wide[:, :384].copy()), pyramid_of(wide[:, 16:400].copy())
    pixels = grid(23, 40)
    depth = 1.6
    points = at_depth(PLAIN, pixels, depth)
    truth = se3_exp(np.array([-16 * depth / 256, 0, 0, 0, 0, 0]))
    start = truth @ se3_exp(np.array([0.02, -0.02, 0.02, 0.01, -0.01, 0.02]))
    found = align(
        reference, current, optics_of(PLAIN), pixels, points, start,
        Options(tolerance=1e-9, illumination=illumination),
    )  # fmt: skip
    assert np.max(np.abs(se3_log(np.linalg.inv(truth) @ found.cur_t_ref))) < 1e-6
    assert found.final_cost < 1e-8
    assert found.stop[-1] in (Stop.CONVERGED, Stop.ROSE)
    assert found.cost[0, 0] > 100 * found.cost[-1, 0]
    assert np.array_equal(found.iterations, np.sum(np.isfinite(found.cost), axis=1) - 1)


def test_no_motion_is_found_exactly_with_distortion_and_relief() -> None:
    pixels = np.random.default_rng(3).uniform((30, 30), (345, 209), (120, 2))
    frame = pyramid_of(noise_texture((240, 376), 9, 4))
    points = at_depth(CAMERA, pixels, 1.6 + 0.2 * np.sin(pixels[:, 0]))
    start = se3_exp(np.array([0.01, -0.02, 0.02, 0.01, -0.01, 0.02]))
    found = align(frame, frame, optics_of(CAMERA), pixels, points, start, Options(tolerance=1e-9))
    assert np.max(np.abs(se3_log(found.cur_t_ref))) < 1e-6
    assert found.inlier.sum() == found.visible.sum() > 100


@pytest.mark.parametrize("scale", [0.3, 1.0])
def test_small_motions_over_a_rendered_plane(scale: float) -> None:
    """What remains is the bilinear samples' error and rounding to whole grey levels."""
    pose, pixels = looking_down(), np.random.default_rng(5).uniform((30, 30), (345, 209), (120, 2))
    points = moved(on_plane(CAMERA, pose, pixels), pose)
    truth = se3_exp(scale * np.array([0.02, -0.015, 0.01, 0.006, -0.005, 0.01]))
    first, second = (pyramid_of(seen(CAMERA, cam @ pose)) for cam in (np.eye(4), truth))
    found = align(first, second, optics_of(CAMERA), pixels, points, np.eye(4), OPTIONS)
    error = lens.project(CAMERA, moved(points, found.cur_t_ref)) - lens.project(CAMERA, moved(points, truth))
    assert np.sqrt(np.mean(error**2)) < 0.02  # px of level 0
    assert found.inlier.sum() > 110


def test_gain_and_offset_are_found() -> None:
    camera, pose = PLAIN, looking_down()
    first = seen(camera, pose)
    second = np.round(0.8 * seen(camera, se3_exp(np.array([0.01, 0.005, 0, 0, 0, 0.01])) @ pose) + 15).astype(np.uint8)
    pixels = grid(29, 30)
    points = moved(on_plane(camera, pose, pixels), pose)
    a, b = pyramid_of(first), pyramid_of(second)
    found = align(a, b, optics_of(camera), pixels, points, np.eye(4), Options(illumination=True))
    assert found.gain == pytest.approx(0.8, abs=0.01)
    assert found.offset == pytest.approx(15, abs=1.5)
    assert np.allclose(se3_log(found.cur_t_ref), [0.01, 0.005, 0, 0, 0, 0.01], atol=1e-3)
    blind = align(a, b, optics_of(camera), pixels, points, np.eye(4), OPTIONS)
    assert blind.final_cost > 10 * found.final_cost


def test_what_does_not_carry_a_pose_is_said() -> None:
    flat = pyramid_of(np.full((256, 384), 90, np.uint8))
    pixels = grid(40, 40)
    points = at_depth(PLAIN, pixels, 1.5)
    found = align(flat, flat, optics_of(PLAIN), pixels, points, np.eye(4), OPTIONS)
    assert set(found.stop) == {Stop.SINGULAR}
    assert np.isnan(found.covariance).all()
    textured = pyramid_of(noise_texture((256, 384), 6, 1))
    away = se3_exp(np.array([9.0, 0, 0, 0, 0, 0]))
    found = align(textured, textured, optics_of(PLAIN), pixels, points, away, OPTIONS)
    assert set(found.stop) == {Stop.TOO_FEW_PATCHES}
    assert np.array_equal(found.cur_t_ref, away)
    assert not found.inlier.any()


def test_frames_that_cannot_be_aligned() -> None:
    small, large = (pyramid_of(noise_texture(shape, 3, 1)) for shape in ((64, 64), (64, 96)))
    points = np.ones((8, 3))
    with pytest.raises(ValueError, match="one size"):
        align(small, large, optics_of(PLAIN), points[:, :2], points, np.eye(4), OPTIONS)
    with pytest.raises(ValueError, match="levels 7 to 2"):
        align(small, small, optics_of(PLAIN), points[:, :2], points, np.eye(4), Options(coarsest=7))
    with pytest.raises(ValueError, match="8 pixels and 7 points"):
        align(small, small, optics_of(PLAIN), points[:, :2], points[1:], np.eye(4), OPTIONS)


def test_an_occluded_patch_is_no_inlier() -> None:
    image = noise_texture((256, 384), 6, 8)
    other = image.copy()
    other[100:130, 150:180] = 255 - other[100:130, 150:180]
    pixels = grid(40, 40)
    found = align(
        pyramid_of(image), pyramid_of(other), optics_of(PLAIN), pixels, at_depth(PLAIN, pixels, 1.5), np.eye(4), OPTIONS
    )
    hidden = np.all((pixels > (149, 99)) & (pixels < (180, 130)), axis=1)
    assert hidden.any()
    assert not found.inlier[hidden].any()
    assert found.inlier[~hidden].mean() > 0.9


@pytest.mark.parametrize("between", [False, True])
def test_the_covariance_is_consistent_with_noise(between: bool) -> None:
    """Noise in the current frame: NEES of six degrees of freedom on whole pixels, 1.7 times that between them."""
    rng = np.random.default_rng(6)
    image = noise_texture((256, 384), 9, 7)
    pixels = grid(28, 38)
    pixels = 4 * np.round((pixels - 5.5) / 4) + 5.5 + 2  # half-pixels of level 2: patches lie on whole pixels
    if between:
        pixels += rng.uniform(-2, 2, pixels.shape)
    points = at_depth(PLAIN, pixels, 1.5 + 0.3 * np.sin(pixels[:, 0]))
    reference, options = pyramid_of(image), Options(coarsest=2, finest=2)
    nees = []
    for _ in range(60):
        noisy = np.clip(np.round(image + rng.normal(0, 12, image.shape)), 0, 255).astype(np.uint8)
        found = align(reference, pyramid_of(noisy), optics_of(PLAIN), pixels, points, np.eye(4), options)
        xi = se3_log(found.cur_t_ref)
        nees.append(xi @ np.linalg.solve(found.covariance, xi))
    low, high = stats.chi2(6 * len(nees)).ppf([1e-4, 1 - 1e-4]) / len(nees)
    assert low < np.mean(nees) / (1.7 if between else 1.0) < high
