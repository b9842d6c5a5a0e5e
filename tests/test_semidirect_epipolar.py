"""Epipolar geometry against closed forms and OpenCV; the search finds the depth planted in pictures of a plane."""

import math

import cv2
import numpy as np
import pytest
from scipy.optimize import approx_fprime
from scipy.spatial.transform import Rotation
from textured_plane import picture

from pipelines import lens
from pipelines.semidirect import epipolar as ep
from pipelines.semidirect import optics as op
from pipelines.semidirect import pyramid as py
from pipelines.semidirect.depth_filter import DepthFilters, Outcome, depth_error, pixel_angle

CAMERAS = {
    "pinhole": lens.pinhole(376, 240, 210.0, model="none"),
    "radtan": lens.pinhole(376, 240, 210.0, distortion=[-0.28, 0.07, 0.0002, 0.00002]),
    "equidistant": lens.pinhole(376, 240, 190.0, model="equidistant", distortion=[-0.01, 0.02, -0.01, 0.002]),
}
TURN = Rotation.from_euler("xyz", [0.03, -0.05, 0.2]).as_matrix()
STEP = np.array([0.12, -0.05, 0.04])


def unit(v):
    return np.asarray(v, float) / np.linalg.norm(v)


@pytest.mark.parametrize("name", CAMERAS)
def test_compiled_camera_is_that_of_lens(name) -> None:
    camera, optics = CAMERAS[name], op.optics_of(CAMERAS[name])
    points = np.random.default_rng(1).uniform([-0.7, -0.5, 0.8], [0.7, 0.5, 1.5], (200, 3))
    expected = lens.project(camera, points)
    found = [op.project(optics, *p) for p in points]
    np.testing.assert_allclose([p[:2] for p in found], expected, rtol=0, atol=1e-9)
    for point, pixel in zip(points[:20], expected, strict=False):
        for row, name_of in enumerate(("u", "v")):
            slope = approx_fprime(point, lambda x, r=row: float(lens.project(camera, x[None])[0, r]), 1e-7)
            found_slope = [getattr(op.project(optics, *point), f"{name_of}_{axis}") for axis in "xyz"]
            np.testing.assert_allclose(found_slope, slope, rtol=1e-4, atol=1e-3)
        np.testing.assert_allclose(op.ray(optics, *pixel), point[:2] / point[2], rtol=0, atol=1e-11)
    assert math.isnan(op.project(optics, 0.1, 0.1, -1.0).u)


def test_segment_of_a_sideways_step_is_the_disparity() -> None:
    """Camera moved by B along x: the corner is at u - f B ξ_z, its row unchanged."""
    camera, b, mu, sigma = CAMERAS["pinhole"], 0.2, 0.7, 0.15
    optics = op.optics_of(camera)
    ray = lens.rays(camera, np.array([[250.0, 90.0]]))[0]
    f = unit(ray)
    s = ep.segment_of(optics, f, mu, sigma, np.eye(3), np.array([-b, 0.0, 0.0]))
    over_z = np.linalg.norm(ray)  # ξ along the bearing times this is 1/z
    for u, v, xi in [
        (s.middle_u, s.middle_v, mu), (s.far_u, s.far_v, mu - sigma), (s.near_u, s.near_v, mu + sigma)
    ]:  # fmt: skip
        assert (u, v) == pytest.approx((250.0 - 210.0 * b * xi * over_z, 90.0), abs=1e-9)
    assert s.length_px == pytest.approx(210.0 * b * 2 * sigma * over_z, abs=1e-9)


def test_segment_ends_at_infinity_and_behind_the_camera() -> None:
    optics, f = op.optics_of(CAMERAS["pinhole"]), unit([0.1, 0.05, 1.0])
    s = ep.segment_of(optics, f, 0.1, 0.4, TURN, STEP)
    infinite = TURN @ f
    assert (s.far_a, s.far_b) == pytest.approx(infinite[:2] / infinite[2], abs=1e-12)
    assert math.isnan(ep.segment_of(optics, f, 1.0, 0.1, np.eye(3), np.array([0.0, 0.0, -2.0])).middle_u)


def test_all_of_the_segment_is_on_opencvs_epipolar_line() -> None:
    camera = CAMERAS["pinhole"]
    optics, pixel = op.optics_of(camera), np.array([[140.0, 77.0]])
    f = unit(lens.rays(camera, pixel)[0])
    cross = np.cross(np.eye(3), STEP) * -1
    inverse = np.linalg.inv(camera.matrix)
    line = cv2.computeCorrespondEpilines(pixel[None], 1, inverse.T @ (cross @ TURN) @ inverse)[0, 0]
    s = ep.segment_of(optics, f, 0.6, 0.3, TURN, STEP)
    for u, v in [(s.middle_u, s.middle_v), (s.far_u, s.far_v), (s.near_u, s.near_v)]:
        assert abs(line @ [u, v, 1.0]) < 1e-4  # OpenCV's lines are of single precision
    assert s.length_px > 10


def test_triangulation_is_exact_and_least_squares() -> None:
    f, depth = unit([0.2, -0.1, 1.0]), 1.7
    centre = ep.centre_in_ref(TURN, STEP)
    np.testing.assert_allclose(TURN @ centre + STEP, 0, atol=1e-15)
    g = unit(TURN @ (depth * f) + STEP)
    assert ep.triangulated(f, g, TURN, centre) == pytest.approx(depth, abs=1e-12)
    g = unit(g + np.array([0.01, 0.02, -0.01]))
    solved = np.linalg.lstsq(np.column_stack([f, -TURN.T @ g]), centre, rcond=None)[0][0]
    assert ep.triangulated(f, g, TURN, centre) == pytest.approx(solved, abs=1e-9)
    assert ep.triangulated(f, TURN @ f, TURN, centre) == math.inf
    assert math.isnan(ep.triangulated(f, unit(TURN @ (-0.5 * f) + STEP), TURN, centre))


def test_tau_is_what_a_turn_by_one_pixel_does_to_the_triangulation() -> None:
    """Brute force: turn the other ray within the epipolar plane and intersect again."""
    f, depth, angle = unit([0.2, -0.1, 1.0]), 1.7, pixel_angle(420.0)
    for step in (STEP, -STEP, 0.1 * STEP, np.array([0.0, 0.0, -0.3])):
        centre = ep.centre_in_ref(TURN, step)
        a = depth * f - centre
        axis = unit(np.cross(centre, a))
        turned = [Rotation.from_rotvec(sign * angle * axis).apply(a) for sign in (1, -1)]
        farther = [ep.triangulated(f, TURN @ unit(t), TURN, centre) for t in turned]
        assert depth_error(f, centre, depth, angle) == pytest.approx(max(farther) - depth, rel=1e-8)
    assert depth_error(f, 1e-5 * f + 1e-4 * unit([1, 0, 0]), depth, angle) == math.inf


@pytest.mark.parametrize("name", CAMERAS)
def test_warp_is_the_derivative_of_the_images_of_a_facing_plane(name) -> None:
    camera, pixel = CAMERAS[name], np.array([150.0, 80.0])
    optics, ray = op.optics_of(camera), lens.rays(camera, pixel[None])[0]
    depth = 1.3

    def moved(u):
        point = lens.rays(camera, u[None])[0] * depth
        return lens.project(camera, (TURN @ point + STEP)[None])[0]

    h = 1e-3
    slopes = [(moved(pixel + d) - moved(pixel - d)) / (2 * h) for d in (np.array([h, 0]), np.array([0, h]))]
    w = ep.warp_of(optics, unit(ray), 1.0 / (depth * np.linalg.norm(ray)), TURN, STEP)
    np.testing.assert_allclose([[w.xx, w.xy], [w.yx, w.yy]], np.transpose(slopes), rtol=0, atol=1e-6)


def test_level_keeps_the_patch_at_its_size() -> None:
    def scale(s):
        return ep.Warp(s, 0.0, 0.0, s)

    assert [ep.level_for(scale(s), 0, 2) for s in (1.0, 1.7, 1.8, 3.4, 3.5, 9.0)] == [0, 0, 1, 1, 2, 2]
    assert [ep.level_for(scale(1.0), k, 4) for k in (0, 1, 2, 3)] == [0, 1, 2, 3]


def test_zmssd_against_numpy_and_blind_to_brightness() -> None:
    rng = np.random.default_rng(2)
    image, patch = rng.integers(0, 200, (40, 50)).astype(np.uint8), rng.uniform(0, 255, (10, 10))
    window = image[12 - 4 : 12 + 4, 20 - 4 : 20 + 4].astype(float)
    d = window - patch[1:9, 1:9]
    assert ep.zmssd(patch, image, 20, 12) == pytest.approx(np.mean((d - d.mean()) ** 2), rel=1e-12)
    assert ep.zmssd(patch, (image + 55).astype(np.uint8), 20, 12) == pytest.approx(ep.zmssd(patch, image, 20, 12))


def corners(camera, n, seed):
    rng = np.random.default_rng(seed)
    return rng.uniform([60, 60], [camera.width_px - 60, camera.height_px - 60], (n, 2))


@pytest.fixture(scope="module", params=CAMERAS)
def flight(request):
    """Two pictures of a tilted plane at 1.5 m, 9 cm apart, and depths along the bearings of 60 corners."""
    camera = CAMERAS[request.param]
    normal, distance = unit([0.1, -0.06, 1.0]), 1.5
    turn, step = Rotation.from_euler("xyz", [0.01, -0.02, 0.06]).as_matrix(), np.array([0.08, 0.03, 0.03])
    first = picture(camera, np.eye(3), np.zeros(3), normal, distance)
    second = picture(camera, turn.T, -turn.T @ step, normal, distance)
    pixels = corners(camera, 60, 4)
    bearings = lens.rays(camera, pixels)
    bearings /= np.linalg.norm(bearings, axis=1)[:, None]
    return camera, py.pyramid_of(first), py.pyramid_of(second), turn, step, pixels, bearings, distance / (
        bearings @ normal
    )  # fmt: skip


def searched(flight, mu, sigma, levels=None, limits=None, image=None):
    camera, reference, second, turn, step, pixels, bearings, _ = flight
    record = np.full((len(pixels), len(ep.RECORD)), np.nan)
    levels = np.zeros(len(pixels), np.int64) if levels is None else levels
    ep.search_bank(
        op.optics_of(camera), reference, image or second, pixels, bearings, levels, mu, sigma, turn, step,
        limits or ep.Limits(), record,
    )  # fmt: skip
    return {name: record[:, i] for i, name in enumerate(ep.RECORD)}


@pytest.mark.parametrize("level", [0, 1])
def test_search_finds_the_planted_depth(flight, level) -> None:
    depth = flight[-1]
    rng = np.random.default_rng(5)
    mu, sigma = (1 / depth) + 0.1 * rng.uniform(-1, 1, 60), np.full(60, 0.2)
    found = searched(flight, mu, sigma, np.full(60, level))
    good = found["outcome"] == ep.Match.MATCHED
    assert good.mean() > 0.9
    assert (found["level"] == level).all()
    off = np.abs(1 / found["depth"][good] - 1 / depth[good]) / found["inverse_tau"][good]
    assert np.median(off) < 0.1 * 2**level  # of a pixel
    assert np.quantile(off, 0.9) < 0.4 * 2**level
    assert (found["best"] < found["second"])[good].all()
    assert np.median((found["second"] / found["best"])[good]) > 5


def test_short_segment_is_aligned_from_the_mean(flight) -> None:
    depth = flight[-1]
    found = searched(flight, 1 / depth + 0.01, np.full(60, 0.02))
    good = found["outcome"] == ep.Match.ALIGNED
    assert (found["length_px"] < 2).all()
    assert good.mean() > 0.9
    assert np.median(np.abs(1 / found["depth"] - 1 / depth)[good] / found["inverse_tau"][good]) < 0.1
    assert (found["steps"] == 0).all()


def test_search_refuses_what_is_not_there(flight) -> None:
    _, _, second, _, _, pixels, bearings, depth = flight
    noise = np.random.default_rng(6).integers(0, 255, level_shape(second)).astype(np.uint8)
    mu, sigma = 1 / depth, np.full(60, 0.2)
    found = searched(flight, mu, sigma, image=py.pyramid_of(noise))
    assert (found["outcome"] == ep.Match.UNLIKE).mean() > 0.95
    assert np.isnan(found["depth"][found["outcome"] > ep.Match.ALIGNED]).all()
    blank = searched(flight, mu, np.full(60, 1e-3), image=py.pyramid_of(np.full_like(noise, 90)))
    assert (blank["outcome"] >= ep.Match.NOT_ALIGNED).all()
    short = searched(flight, mu, sigma, limits=ep.Limits(most_steps=3))
    assert (short["outcome"] == ep.Match.TOO_LONG).all()
    camera, reference, image, turn, *_ = flight
    optics = op.optics_of(camera)
    sideways = np.array([5.0, 0.0, 0.0])
    args = (pixels[0, 0], pixels[0, 1], bearings[0], 0, mu[0], 0.1)
    assert ep.search(optics, reference, image, *args, turn, sideways, ep.Limits()).outcome == ep.Match.UNSEEN
    edge, inwards = lens.rays(camera, np.array([[3.0, 120.0]]))[0], np.array([0.1, 0.0, 0.0])
    args = (3.0, 120.0, unit(edge), 0, mu[0], 0.1)
    assert ep.search(optics, reference, image, *args, np.eye(3), inwards, ep.Limits()).outcome == ep.Match.NO_REFERENCE


def level_shape(pyramid):
    return py.level_image(pyramid, 0).shape


def test_alignment_recovers_a_shift() -> None:
    camera = CAMERAS["pinhole"]
    a = picture(camera, np.eye(3), np.zeros(3))
    b = picture(camera, np.eye(3), np.array([0.005, -0.003, 0.0]))
    shift = np.array([-0.005, 0.003]) / 1.5 * 210.0
    errors = []
    for u, v in np.random.default_rng(7).integers([40, 40], [330, 200], (40, 2)):
        patch = a[v - 5 : v + 5, u - 5 : u + 5].astype(float)
        # a brighter picture: the mean difference takes it up
        fu, fv, turns = ep.aligned(patch, np.minimum(b, 240) + np.uint8(15), u, v, 10, 0.03)
        if math.isfinite(fu):
            errors.append(math.hypot(fu - u - shift[0], fv - v - shift[1]))
            assert turns <= 10
    assert len(errors) > 35
    assert np.median(errors) < 0.05


def test_filters_converge_on_the_plane_and_wait_while_the_camera_stands() -> None:
    """Search and filter together: 14 frames of a flight, 30 mm apart, then the bank holds the plane's depths."""
    camera, n = CAMERAS["pinhole"], 40
    optics, pixels = op.optics_of(camera), corners(camera, n, 8)
    bearings = lens.rays(camera, pixels)
    bearings /= np.linalg.norm(bearings, axis=1)[:, None]
    truth, normal = 1.5 / bearings[:, 2], np.array([0.0, 0.0, 1.0])
    reference = py.pyramid_of(picture(camera, np.eye(3), np.zeros(3), normal))
    bank = DepthFilters(np.full(n, 1.8), np.full(n, 0.9), converged_share=1 / 100)
    record, levels = np.empty((n, len(ep.RECORD))), np.zeros(n, np.int64)

    def look(centre, image):
        ep.search_bank(
            optics, reference, image, pixels, bearings, levels, bank.state[0], bank.sigma, np.eye(3), -centre,
            ep.Limits(), record,
        )  # fmt: skip
        bank.update(*ep.measurements(record))

    still = bank.state.copy()
    bank.state[0] = 1 / truth
    still[0] = 1 / truth
    look(np.zeros(3), reference)
    assert set(record[:, 0]) == {ep.Match.NO_PARALLAX}
    assert (bank.outcome == Outcome.UNSEEN).all()
    np.testing.assert_array_equal(bank.state, still)
    bank.state[0] = 1 / 1.8
    converged = np.zeros(n, bool)
    for k in range(1, 15):
        centre = np.array([0.03 * k, 0.005 * k, 0.0])
        look(centre, py.pyramid_of(picture(camera, np.eye(3), centre, normal)))
        converged |= bank.outcome == Outcome.CONVERGED
    assert converged.mean() > 0.95
    off = np.abs(bank.depth / truth - 1)[converged]
    assert np.median(off) < 0.0005
    assert np.quantile(off, 0.9) < 0.002
    assert np.median(bank.ratio[converged]) > 0.6
