"""Refinement: derivatives by differences, exact without noise, against scipy's least squares, consistent with noise."""

import numpy as np
import pytest
from scipy import stats
from scipy.optimize import least_squares
from semidirect_scenes import looking_down, moved

from pipelines import lens
from pipelines.geometry import se3_exp, se3_log
from pipelines.semidirect.optics import optics_of
from pipelines.semidirect.refinement import (
    Bundle,
    BundleOptions,
    Observations,
    PoseOptions,
    adjust,
    huber_cost,
    normal_equations,
    observe,
    oldest_fixed,
    pose_errors,
    refine_points,
    refine_pose,
    tukey_cost,
    tukey_weight,
)

CAMERA = lens.pinhole(752, 480, 420.0, distortion=(-0.1, 0.02, 1e-3, -1e-3))
OPTICS = optics_of(CAMERA)
TRUTH = se3_exp(np.array([0.1, -0.05, 0.05, 0.05, -0.04, 0.3])) @ looking_down()
OFF = se3_exp(np.array([0.02, -0.03, 0.02, 0.01, -0.02, 0.015]))


def scene(count: int, seed: int, relief: float = 0.2) -> np.ndarray:
    return np.random.default_rng(seed).uniform((-0.9, -0.5, -relief), (0.9, 0.5, relief), (count, 3))


def levels(count: int) -> np.ndarray:
    return np.arange(count) % 3


def noisy(pixels: np.ndarray, level: np.ndarray, sigma: float, rng: np.random.Generator) -> np.ndarray:
    return pixels + sigma * 2.0 ** level[:, None] * rng.normal(size=pixels.shape)


# -------------------------------------------------------------------------------------- equations


def test_derivatives_of_an_observation() -> None:
    point, pixel, level, h = np.array([0.3, -0.2, 0.1]), np.array([300.0, 200.0]), 1, 1e-6

    def error(transform: np.ndarray, place: np.ndarray) -> np.ndarray:
        return (lens.project(CAMERA, moved(place[None], transform))[0] - pixel) / 2**level

    found, by_pose, by_point = np.empty(2), np.empty((2, 6)), np.empty((2, 3))
    assert observe(OPTICS, TRUTH, point, pixel, level, found, by_pose, by_point)
    assert np.allclose(found, error(TRUTH, point), atol=1e-9)
    twists = [se3_exp(s * h * row) @ TRUTH for row in np.eye(6) for s in (1, -1)]
    slopes = np.array(
        [(error(a, point) - error(b, point)) / (2 * h) for a, b in zip(twists[::2], twists[1::2], strict=True)]
    )
    assert np.allclose(by_pose, slopes.T, rtol=0, atol=1e-6 * np.abs(slopes).max())
    slopes = np.array([(error(TRUTH, point + h * e) - error(TRUTH, point - h * e)) / (2 * h) for e in np.eye(3)])
    assert np.allclose(by_point, slopes.T, rtol=0, atol=1e-6 * np.abs(slopes).max())
    assert not observe(OPTICS, TRUTH, np.array([0, 0, 9.0]), pixel, level, found, by_pose, by_point)


@pytest.mark.parametrize("e", [0.3, 2.0, 4.5, 7.0])
def test_weights_are_the_slopes_of_the_costs(e: float) -> None:
    h = 1e-6
    assert tukey_weight(e, 1.2) * e == pytest.approx(
        (tukey_cost(e + h, 1.2) - tukey_cost(e - h, 1.2)) / (2 * h), abs=1e-6
    )
    assert min(e, 1.5) == pytest.approx((huber_cost(e + h, 1.5) - huber_cost(e - h, 1.5)) / (2 * h), abs=1e-6)


def test_the_gradient_is_that_of_the_cost() -> None:
    points, level, h = scene(40, 1), levels(40), 1e-6
    pixels = noisy(lens.project(CAMERA, moved(points, TRUTH)), level, 2.0, np.random.default_rng(2))
    found = pose_errors(OPTICS, points, pixels, level, TRUTH, 1.0)
    for a in range(6):
        there, back = (
            pose_errors(OPTICS, points, pixels, level, se3_exp(s * h * np.eye(6)[a]) @ TRUTH, 1.0).cost for s in (1, -1)
        )
        assert found.gradient[a] == pytest.approx((there - back) / (2 * h), rel=1e-5, abs=1e-3)


# -------------------------------------------------------------------------------------- one pose


def test_a_pose_is_found_exactly_in_spite_of_outliers() -> None:
    points, level = scene(80, 3), levels(80)
    pixels = lens.project(CAMERA, moved(points, TRUTH))
    pixels[::8] += (25, -40)
    found = refine_pose(OPTICS, points, pixels, level, OFF @ TRUTH, PoseOptions())
    assert np.max(np.abs(se3_log(found.cam_t_world @ np.linalg.inv(TRUTH)))) < 1e-6
    assert np.array_equal(found.inlier, np.arange(80) % 8 != 0)
    assert found.solved
    taken = found.cost[: found.iterations + 1]
    assert np.isfinite(taken).all()
    assert np.isnan(found.cost[found.iterations + 1 :]).all()
    assert found.error_before_px.max() > 5 > found.error_px[found.inlier].max()


def test_a_pose_agrees_with_scipy() -> None:
    """The least Tukey cost at the late scale, found by another optimiser."""
    points, level = scene(60, 4), levels(60)
    pixels = noisy(lens.project(CAMERA, moved(points, TRUTH)), level, 0.7, np.random.default_rng(5))
    options = PoseOptions(iterations=60)
    found = refine_pose(OPTICS, points, pixels, level, OFF @ TRUTH, options)

    def roots(xi: np.ndarray) -> np.ndarray:
        error = (lens.project(CAMERA, moved(points, se3_exp(xi) @ TRUTH)) - pixels) / 2.0 ** level[:, None]
        return np.sqrt(2 * np.array([tukey_cost(e, options.late_scale_px) for e in np.hypot(*error.T)]))

    peer = least_squares(roots, np.zeros(6), xtol=1e-14, ftol=1e-14, gtol=1e-14, x_scale="jac")
    assert found.cost[found.iterations] == pytest.approx(peer.cost, rel=1e-9)
    assert np.allclose(se3_log(found.cam_t_world @ np.linalg.inv(TRUTH)), peer.x, atol=2e-6)


def test_the_covariance_of_a_pose_is_consistent() -> None:
    rng, points, level = np.random.default_rng(6), scene(100, 6), levels(100)
    exact, nees = lens.project(CAMERA, moved(points, TRUTH)), []
    for _ in range(150):
        pixels = noisy(exact, level, 0.4, rng)
        found = refine_pose(OPTICS, points, pixels, level, TRUTH, PoseOptions())
        xi = se3_log(TRUTH @ np.linalg.inv(found.cam_t_world))
        nees.append(xi @ np.linalg.solve(found.covariance, xi))
    assert 0.85 < np.mean(nees) / 6 < 1.15  # the scale is estimated, too
    assert stats.kstest(np.array(nees), stats.chi2(6).cdf).pvalue > 1e-3


def test_points_that_carry_no_pose() -> None:
    points = np.tile([[0.1, 0.1, 0.0]], (20, 1))
    pixels = lens.project(CAMERA, moved(points, TRUTH)) + 3
    found = refine_pose(OPTICS, points, pixels, np.zeros(20, np.int64), TRUTH, PoseOptions())
    assert not found.solved
    assert np.isnan(found.covariance).all()
    assert np.array_equal(found.cam_t_world, TRUTH)
    behind = refine_pose(OPTICS, points + np.array([0, 0, 9]), pixels, np.zeros(20, np.int64), TRUTH, PoseOptions())
    assert not behind.inlier.any()
    assert not behind.solved


# ------------------------------------------------------------------------- points and bundles


def keyframes(count: int) -> np.ndarray:
    twists = [np.array([0.15 * k, 0.04 * k, 0.03 * (k % 2), 0.02 * k, -0.01 * k, 0.05 * k]) for k in range(count)]
    return np.stack([se3_exp(xi) @ looking_down() for xi in twists])


def seen_by_all(cams: np.ndarray, points: np.ndarray, skip: int = 5) -> Observations:
    """Every keyframe sees every point, but for every `skip`-th pair; ordered by point."""
    frame, first, pixels = [], [0], []
    for i, point in enumerate(points):
        seers = [k for k in range(len(cams)) if (i + k) % skip]
        frame += seers
        pixels += [lens.project(CAMERA, moved(point[None], cams[k]))[0] for k in seers]
        first.append(len(frame))
    level = (np.arange(len(frame)) % 2).astype(np.int64)
    return Observations(np.array(first), np.array(frame), np.array(pixels), level)


def test_points_are_found_exactly_and_never_made_worse() -> None:
    cams, points = keyframes(4), scene(30, 7)
    observations = seen_by_all(cams, points)
    start = points + np.random.default_rng(8).normal(0, 0.03, points.shape)
    found = refine_points(OPTICS, cams, observations, start, 10)
    assert np.max(np.abs(found.points - points)) < 1e-9
    rng = np.random.default_rng(9)
    shaken = observations._replace(pixels=noisy(observations.pixels, observations.level, 3.0, rng))
    found = refine_points(OPTICS, cams, shaken, start, 5)
    assert np.all(found.after <= found.before)


def test_the_covariance_of_points_is_consistent() -> None:
    cams, points, rng, nees = keyframes(4), scene(40, 10), np.random.default_rng(11), []
    observations = seen_by_all(cams, points)
    for _ in range(20):
        shaken = observations._replace(pixels=noisy(observations.pixels, observations.level, 0.2, rng))
        found = refine_points(OPTICS, cams, shaken, points, 5)
        error = found.points - points
        nees.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(0.04 * found.covariance), error))
    count = 3 * np.size(nees)
    low, high = stats.chi2(count).ppf([1e-4, 1 - 1e-4]) / count
    assert low < np.mean(nees) / 3 < high


def test_one_view_tells_no_depth() -> None:
    cams, points = keyframes(1), scene(3, 12)
    pixels = lens.project(CAMERA, moved(points, cams[0])) + 2
    once = Observations(np.arange(4), np.zeros(3, np.int64), pixels, np.zeros(3, np.int64))
    found = refine_points(OPTICS, cams, once, points, 5)
    assert np.array_equal(found.points, points)
    assert np.isnan(found.covariance).all()


def disturbed(count: int, points: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng, cams = np.random.default_rng(seed), keyframes(count)
    start = np.stack([c if k < 2 else se3_exp(rng.normal(0, 0.01, 6)) @ c for k, c in enumerate(cams)])
    return start, points + rng.normal(0, 0.02, points.shape)


def test_a_bundle_is_found_exactly() -> None:
    cams, points = keyframes(5), scene(40, 13)
    start, places = disturbed(5, points, 14)
    options = BundleOptions(iterations=30, tolerance=0.0)
    found = adjust(OPTICS, start, oldest_fixed(5), seen_by_all(cams, points), places, options)
    assert np.array_equal(found.cams_t_world[:2], cams[:2])
    for k in range(5):
        assert np.max(np.abs(se3_log(found.cams_t_world[k] @ np.linalg.inv(cams[k])))) < 1e-6
    assert np.max(np.abs(found.points - points)) < 1e-6
    assert found.inlier.all()
    assert np.all(np.diff(found.cost[: found.iterations + 1]) <= 0)


def peer_of_bundle(start: np.ndarray, observations: Observations, places: np.ndarray, huber: float):
    """scipy on the same cost, with twists of the keyframes 2 … and all points as unknowns."""
    counts = np.diff(observations.first)
    which, free = np.repeat(np.arange(len(places)), counts), len(start) - 2

    def unpacked(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        twists = x[: 6 * free].reshape(-1, 6)
        cams = np.stack([*start[:2], *(se3_exp(xi) @ c for xi, c in zip(twists, start[2:], strict=True))])
        return cams, x[6 * free :].reshape(-1, 3)

    def roots(x: np.ndarray) -> np.ndarray:
        cams, points = unpacked(x)
        t = cams[observations.frame]
        local = np.einsum("mij,mj->mi", t[:, :3, :3], points[which]) + t[:, :3, 3]
        error = (lens.project(CAMERA, local) - observations.pixels) / 2.0 ** observations.level[:, None]
        length = np.hypot(*error.T)
        cost = np.where(length <= huber, 0.5 * length**2, huber * (length - huber / 2))
        return (error * (np.sqrt(2 * cost) / length)[:, None]).ravel()

    x0 = np.concatenate([np.zeros(6 * free), places.ravel()])
    result = least_squares(roots, x0, xtol=1e-14, ftol=1e-14, gtol=1e-14, x_scale="jac")
    return result, *unpacked(result.x)


def test_a_bundle_agrees_with_scipy() -> None:
    cams, points = keyframes(4), scene(9, 15)
    observations = seen_by_all(cams, points)
    pixels = noisy(observations.pixels, observations.level, 0.6, np.random.default_rng(16))
    pixels[::17] += 12  # Huber has something to do
    observations = observations._replace(pixels=pixels)
    start, places = disturbed(4, points, 17)
    found = adjust(OPTICS, start, oldest_fixed(4), observations, places, BundleOptions(iterations=300, tolerance=1e-14))
    result, peer_cams, peer_points = peer_of_bundle(start, observations, places, 1.0)
    assert found.cost[found.iterations] == pytest.approx(result.cost, rel=1e-8)
    assert np.max(np.abs(found.cams_t_world - peer_cams)) < 2e-5
    assert np.max(np.abs(found.points - peer_points)) < 2e-5
    assert not found.inlier.all()
    assert np.array_equal(found.inlier, found.error_px <= 2)


def test_normal_equations_against_plain_numpy() -> None:
    cams, points = keyframes(4), scene(12, 18)
    observations = seen_by_all(cams, points)
    observations = observations._replace(pixels=observations.pixels + 1.1)
    slot = np.array([-1, -1, 0, 1])
    found = normal_equations(OPTICS, cams, slot, observations, points, 1.0)
    rows, errors = [], []
    which = np.repeat(np.arange(12), np.diff(observations.first))
    for j, (k, i) in enumerate(zip(observations.frame, which, strict=True)):
        e, by_pose, by_point = np.empty(2), np.empty((2, 6)), np.empty((2, 3))
        observe(OPTICS, cams[k], points[i], observations.pixels[j], observations.level[j], e, by_pose, by_point)
        row = np.zeros((2, 12 + 36))
        if slot[k] >= 0:
            row[:, 6 * slot[k] : 6 * slot[k] + 6] = by_pose
        row[:, 12 + 3 * i : 15 + 3 * i] = by_point
        root = np.sqrt(min(1, 1 / np.linalg.norm(e)))
        rows.append(root * row)
        errors.append(root * e)
        assert np.allclose(found.cross[j], root**2 * by_pose.T @ by_point if slot[k] >= 0 else 0, rtol=1e-10)
    j, e = np.concatenate(rows), np.concatenate(errors)
    h = j.T @ j
    assert np.allclose(found.poses, h[:12, :12], rtol=1e-10)
    assert np.allclose(np.concatenate([found.pose_side, found.point_side.ravel()]), j.T @ e, rtol=1e-8)
    for i in range(12):
        assert np.allclose(found.points[i], h[12 + 3 * i : 15 + 3 * i, 12 + 3 * i : 15 + 3 * i], rtol=1e-10)


def test_the_covariance_of_a_bundle_is_consistent() -> None:
    cams, points, rng, nees = keyframes(4), scene(40, 19), np.random.default_rng(20), []
    observations = seen_by_all(cams, points)
    for _ in range(60):
        shaken = observations._replace(pixels=noisy(observations.pixels, observations.level, 0.2, rng))
        found: Bundle = adjust(OPTICS, cams, oldest_fixed(4), shaken, points, BundleOptions())
        for k in (2, 3):
            xi = se3_log(cams[k] @ np.linalg.inv(found.cams_t_world[k]))
            nees.append(xi @ np.linalg.solve(0.04 * found.covariance[k], xi))
    assert not found.covariance[:2].any()
    assert 0.85 < np.mean(nees) / 6 < 1.15


def test_a_bundle_of_held_keyframes_is_that_of_its_points() -> None:
    """Without free poses, and without Huber, each point is refined on its own."""
    cams, points = keyframes(4), scene(20, 22)
    observations = seen_by_all(cams, points)
    shaken = noisy(observations.pixels, observations.level, 0.5, np.random.default_rng(23))
    observations = observations._replace(pixels=shaken)
    options = BundleOptions(iterations=50, huber_px=1e9, tolerance=0.0)
    found = adjust(OPTICS, cams, np.ones(4, np.bool_), observations, points, options)
    alone = refine_points(OPTICS, cams, observations, points, 20)
    assert np.array_equal(found.cams_t_world, cams)
    assert np.max(np.abs(found.points - alone.points)) < 1e-6


def test_what_cannot_be_refined_is_refused() -> None:
    cams, points = keyframes(3), scene(5, 21)
    observations = seen_by_all(cams, points)
    with pytest.raises(ValueError, match="do not belong to 4 points and 3 keyframes"):
        adjust(OPTICS, cams, oldest_fixed(3), observations, points[1:], BundleOptions())
    with pytest.raises(ValueError, match="do not belong to 5 points and 2 keyframes"):
        adjust(OPTICS, cams[:2], oldest_fixed(2), observations, points, BundleOptions())
    with pytest.raises(ValueError, match="one of each"):
        refine_pose(OPTICS, points, np.zeros((4, 2)), levels(5), TRUTH, PoseOptions())
    with pytest.raises(ValueError, match="1 keyframes are fixed"):
        adjust(OPTICS, cams, np.arange(3) < 1, seen_by_all(cams, points), points, BundleOptions())
