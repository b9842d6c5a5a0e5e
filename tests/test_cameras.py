"""Cameras of simulated missions: lenses, and what they see of a scene."""

import functools
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pytest
import scipy.ndimage

from pipelines.lens import pinhole, project, rays
from pipelines.simulation.mission import nadir_camera
from pipelines.simulation.motion import FORWARD, NADIR, Hold, Mount, Waypoints, looking, rotations
from pipelines.simulation.pyramid import coarser, levels_of
from pipelines.simulation.render import Patch, behind_dirt, dirt, expose, radiance, view, world_h_pixel
from pipelines.simulation.scene import Plane, Relief, Scene, chessboard, chessboard_corners, poster, upright
from pipelines.simulation.surfaces import PSF_SIGMA_PX, Surface, gravel, surface_from_periodic
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
        np.testing.assert_array_equal(getattr(ours, field), getattr(paper, field), err_msg=field)


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


# ------------------------------------------------------------------- a scene in closed form

W = 0.2002 / 256  # metres per px of the picture, and of an image of f = 256 px from 0.2002 m
HEIGHT = 0.2002
PERIOD = 256
WAVES = ((40, 3, 5, 0.3), (25, -7, 2, 1.1), (15, 11, 9, 2.0))  # amplitude, cycles in x and y, phase


def wave_ground(x_m: np.ndarray, y_m: np.ndarray, psf_sigma_px: float = PSF_SIGMA_PX) -> np.ndarray:
    """Grey levels at places of the world."""
    grey = np.full(np.broadcast(x_m, y_m).shape, 120.0)
    for amplitude, fx, fy, phase in WAVES:
        wx, wy = 2 * np.pi * fx / PERIOD, 2 * np.pi * fy / PERIOD
        attenuation = np.exp(-0.5 * psf_sigma_px**2 * (wx**2 + wy**2))
        grey += amplitude * attenuation * np.cos(wx * x_m / W - wy * y_m / W + phase)
    return grey


@functools.cache
def waves() -> Surface:
    rows, columns = np.mgrid[:PERIOD, :PERIOD]
    return surface_from_periodic(wave_ground(columns * W, -rows * W, psf_sigma_px=0))


@functools.cache
def stones() -> Surface:
    return gravel(256, np.random.default_rng(4))


def still(x: float = 0.0, y: float = 0.0, heading: float = 0.0, **tilt: float) -> Waypoints:
    return Waypoints(np.zeros(1), np.array([[x, y, heading]]), **tilt)


def above(height: float = HEIGHT, **held: Any) -> Mount:
    return Mount(np.array([0, 0, height]), **held)


def ahead(height: float = 0.7) -> Mount:
    return Mount(np.array([0, 0, height]), FORWARD)


def pixels_of(camera: Camera) -> np.ndarray:
    v, u = np.mgrid[: camera.height_px, : camera.width_px].astype(float)
    return np.column_stack([u.ravel(), v.ravel()])


def opencv_rays(camera: Camera, pixels: np.ndarray) -> np.ndarray:
    exact = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-14)
    flat = cv2.undistortPoints(pixels[:, None], camera.matrix, camera.distortion, criteria=exact)
    return np.column_stack([flat[:, 0], np.ones(len(pixels))])


def ground_points(camera: Camera, world_r_camera: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Where the pixels' rays meet z = 0, [height, width, 2]; world_r_camera [3, 3] or [n, 3, 3]."""
    d = np.einsum("...ij,...j->...i", world_r_camera, opencv_rays(camera, pixels_of(camera)))
    hit = position[..., :2] - d[:, :2] * (position[..., 2:] / d[:, 2:])
    return hit.reshape(camera.height_px, camera.width_px, 2)


def seen_waves(camera: Camera, world_r_camera: np.ndarray, position: np.ndarray) -> np.ndarray:
    return wave_ground(*np.moveaxis(ground_points(camera, world_r_camera, position), -1, 0))


EXACTLY = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-7)
BARREL = pinhole(256, 256, 256.0, distortion=(-0.1, 0.02, 0.001, -0.002))
PLAIN = pinhole(256, 256, 256.0)


# --------------------------------------------------------------------------------- no bias


def bias_px(before: np.ndarray, after: np.ndarray, there: np.ndarray) -> np.ndarray:
    """Least-squares shift (u, v) on a quintic spline that is left of `after` at the true places.

    `there` [256, 256, 2] is where each pixel of `before` is in `after`; a window of 212 x 212 px counts.
    """
    window = np.s_[22:234, 22:234]
    spline = scipy.ndimage.spline_filter(after.astype(float), order=5, mode="mirror")
    u, v = np.moveaxis(there[window], -1, 0)
    template, d = before[window].astype(float), np.zeros(2)

    def sample(du: float, dv: float) -> np.ndarray:
        places = [v + d[1] + dv, u + d[0] + du]
        return scipy.ndimage.map_coordinates(spline, places, order=5, prefilter=False, mode="mirror")

    slopes = [sample(1, 0) - sample(-1, 0), sample(0, 1) - sample(0, -1)]
    jacobian = np.stack(slopes, axis=-1).reshape(-1, 2) / 2
    for _ in range(2):
        d += np.linalg.lstsq(jacobian, (template - sample(0, 0)).ravel(), rcond=None)[0]
    return d


def moved(camera: Camera, ground: np.ndarray, x: float, y: float, turn: float) -> np.ndarray:
    """Where points of the ground [256, 256, 2] are seen by a nadir camera at (x, y) that turned, by OpenCV's lens."""
    ground = ground.reshape(-1, 2)
    c, s = np.cos(turn), np.sin(turn)
    dx, dy = (ground - [x, y]).T
    points = np.column_stack([c * dx + s * dy, s * dx - c * dy, np.full(len(ground), HEIGHT)])
    found, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.matrix, camera.distortion)
    return found.reshape(camera.height_px, camera.width_px, 2)


MOVES = [(k / 6, 0.0) for k in range(1, 7)] + [(0.4, 0.5), (0.0, 1.5), (0.3, 3.0)]  # px, degrees


@pytest.mark.parametrize(
    ("camera", "readout_s"), [(PLAIN, 0.0), (PLAIN, 0.01), (BARREL, 0.0)], ids=["fast", "general", "distorted"]
)
def test_bar_1_no_view_is_biased(camera: Camera, readout_s: float) -> None:
    at = functools.partial(view, Scene(stones()), camera, above(), t_s=0.0, readout_s=readout_s)
    ground = ground_points(camera, NADIR, np.array([0, 0, HEIGHT]))
    before, worst, curve = at(motion=still()), 0.0, []
    for shift, degrees in MOVES:
        x, turn = -shift * W, np.radians(degrees)
        off = bias_px(before, at(motion=still(x, 0.0, turn)), moved(camera, ground, x, 0.0, turn))
        worst = max(worst, float(np.abs(off).max()))
        curve.append(off[0] * np.sin(2 * np.pi * shift) if degrees == 0 else 0.0)
    print(f"largest bias {1e3 * worst:.2f} mpx, S-curve {1e3 * 2 * np.sum(curve) / 6:.2f} mpx")
    assert worst <= 0.8e-3


@pytest.mark.parametrize(("shift", "degrees"), [(0.25, 0.0), (0.3, 0.5)])
def test_bar_1_would_find_a_bilinear_renderer(shift: float, degrees: float) -> None:
    before = view(Scene(stones()), PLAIN, above(), still(), 0.0)
    x, turn = -shift * W, np.radians(degrees)
    ground = ground_points(PLAIN, NADIR, np.array([0, 0, HEIGHT]))
    there = moved(PLAIN, ground, x, 0.0, turn)
    back = moved(PLAIN, ground, -x * np.cos(turn), x * np.sin(turn), -turn)
    after = scipy.ndimage.map_coordinates(before.astype(float), [back[..., 1], back[..., 0]], order=1, mode="mirror")
    assert np.abs(bias_px(before, after, there)).max() > (8e-3 if degrees == 0 else 0.8e-3)


# ------------------------------------------------------------------ any camera, on any mount


@pytest.mark.parametrize("camera", [PLAIN, BARREL], ids=["plain", "distorted"])
def test_a_nadir_view_is_the_scene_in_closed_form(camera: Camera) -> None:
    seen = view(Scene(waves()), camera, above(), still(0.3, -0.1, 0.8), 0.0)
    r = rotations(*np.array([[0.8], [0.0], [0.0]]))[0] @ NADIR
    expected = seen_waves(camera, r, np.array([0.3, -0.1, HEIGHT]))
    middle = np.s_[40:-40, 40:-40]  # barrel distortion lets the corners see more than a pixel of the picture
    np.testing.assert_allclose(seen[middle], expected[middle], atol=5e-3)


def test_a_tilted_view_is_the_scene_in_closed_form() -> None:
    camera = pinhole(200, 160, 900.0)
    mount = above(0.25, body_r_camera=looking(NADIR, pitch_rad=-np.pi / 4))
    seen = view(Scene(waves()), camera, mount, still(0.1, 0.2, 0.3), 0.0)
    r = rotations(*np.array([[0.3], [0.0], [0.0]]))[0] @ looking(NADIR, pitch_rad=-np.pi / 4)
    hit = ground_points(camera, r, np.array([0.1, 0.2, 0.25]))
    assert hit[80, 100, 0] > 0.1 + 0.2  # it looks ahead
    expected = wave_ground(hit[..., 0], hit[..., 1])
    np.testing.assert_allclose(seen, expected, atol=5e-3)


def test_a_lens_turned_about_its_axis_sees_the_same_picture_turned() -> None:
    mount = Mount(np.array([0, 0, 0.7]), FORWARD @ np.diag([-1.0, -1.0, 1.0]))
    camera = pinhole(120, 90, 100.0)
    scene = Scene(stones(), planes=(poster(np.array([2.0, 0.2, 0.9])),))
    upside_down = view(scene, camera, mount, still(), 0.0)
    np.testing.assert_allclose(upside_down[::-1, ::-1], view(scene, camera, ahead(), still(), 0.0), atol=0.05)


def test_what_the_mounts_hold() -> None:
    def at(hold: Hold, heading: float = 0.0, roll: float = 0.0) -> np.ndarray:
        return view(Scene(waves()), PLAIN, above(hold=hold), still(0, 0, heading, roll_rad=roll), 0.0)

    flat = at(Hold.RIGID)
    turned = np.rot90(flat, k=-1)  # a quarter turn to the left turns the picture clockwise
    for hold, expected in ((Hold.RIGID, turned), (Hold.LEVELLED, turned), (Hold.GIMBALLED, flat)):
        np.testing.assert_allclose(at(hold, heading=np.pi / 2), expected, atol=0.01)
    aside = HEIGHT * np.sin(0.1), HEIGHT * np.cos(0.1)  # the camera hangs above the axis of the roll
    for hold in (Hold.LEVELLED, Hold.GIMBALLED):
        expected = seen_waves(PLAIN, NADIR, np.array([0, -aside[0], aside[1]]))
        np.testing.assert_allclose(at(hold, roll=0.1), expected, atol=5e-3)
    assert np.abs(at(Hold.RIGID, roll=0.1) - flat).max() > 20


# ------------------------------------------------------------------------ shutter and motion

MOVING = Waypoints(np.array([0.0, 1.0]), np.array([[0.0, 0, 0], [0.6, 0.2, 0.4]]))


def test_every_row_of_a_rolling_shutter_has_its_own_time() -> None:
    seen = view(Scene(waves()), PLAIN, above(), MOVING, 0.5, readout_s=0.02)
    t = 0.5 + np.repeat(np.arange(256) / 255 - 0.5, 256) * 0.02
    r = rotations(0.4 * t, np.zeros(1), np.zeros(1)) @ NADIR
    position = np.column_stack([0.6 * t, 0.2 * t, np.full(len(t), HEIGHT)])
    np.testing.assert_allclose(seen, seen_waves(PLAIN, r, position), atol=5e-3)
    backwards = view(Scene(waves()), PLAIN, above(), MOVING, 0.5, readout_s=-0.02)
    np.testing.assert_allclose(backwards[128], view(Scene(waves()), PLAIN, above(), MOVING, 0.5)[128], atol=0.5)
    assert np.abs(backwards[0] - seen[0]).max() > 5


def test_a_rolling_shutter_at_rest_is_the_fast_path() -> None:
    patches = (Patch(waves(), 0.02, 0.06, -0.03, 0.03),)
    at = functools.partial(view, Scene(stones(), patches), PLAIN, above(), still(0.05, 0.0, 0.5), 0.0)
    np.testing.assert_allclose(at(readout_s=0.02), at(), atol=2e-3)


def test_the_fast_path_is_the_one_of_old() -> None:
    pose, roll, pitch = np.array([0.3, 0.1, -0.7]), 0.01, -0.02
    h = world_h_pixel(np.array([0.3, 0.1, -0.7]), PLAIN.matrix, HEIGHT, roll_rad=roll, pitch_rad=pitch)
    tilted = Waypoints(np.zeros(1), pose[None], HEIGHT, roll, pitch)
    assert np.array_equal(view(Scene(stones()), PLAIN, Mount(), tilted, 0.0), radiance(stones(), h, (256, 256)))


@pytest.mark.parametrize("readout_s", [0.0, 1e-9])
def test_motion_blur_weakens_a_wave_as_the_sinc_of_its_way(readout_s: float) -> None:
    motion = Waypoints(np.array([0.0, 1.0]), np.array([[0.0, 0, 0], [600 * W, 0, 0]]))
    seen = view(Scene(waves()), PLAIN, above(), motion, 0.5, exposure_s=0.01, readout_s=readout_s)  # 6 px
    v, u = np.mgrid[:256, :256] - 127.5
    expected = np.full((256, 256), 120.0)
    for amplitude, fx, fy, phase in WAVES:
        wx, wy = 2 * np.pi * fx / PERIOD, 2 * np.pi * fy / PERIOD
        attenuation = np.exp(-0.5 * PSF_SIGMA_PX**2 * (wx**2 + wy**2)) * np.sinc(wx * 6 / (2 * np.pi))
        expected += amplitude * attenuation * np.cos(wx * (u + 300) + wy * v + phase)
    np.testing.assert_allclose(seen, expected, atol=0.1)


def test_an_exposure_that_cannot_be_is_refused() -> None:
    for wrong in ({"exposure_s": -0.1}, {"exposure_s": 0.1, "exposure_samples": 0}):
        with pytest.raises(ValueError, match="1 sample at least"):
            view(Scene(waves()), PLAIN, above(), still(), 0.0, **wrong)


def test_a_camera_below_the_ground_is_refused() -> None:
    with pytest.raises(ValueError, match="above the ground"):
        view(Scene(waves()), PLAIN, above(-0.1), still(), 0.0)


# ---------------------------------------------------------------------------------- relief


def test_a_relief_has_the_height_and_the_correlation_that_were_asked_for() -> None:
    relief = Relief(0.002, 0.05, seed=3)
    rows, columns = np.mgrid[1:257, 1:257]
    height = scipy.ndimage.map_coordinates(relief.coefficients.astype(float), [rows, columns], order=3, prefilter=False)
    assert height.std() == pytest.approx(0.002, rel=1e-3)
    assert abs(height.mean()) < 1e-8
    shifted = np.roll(height, 4, axis=1)  # by one correlation length
    assert np.mean(height * shifted) / height.var() == pytest.approx(np.exp(-1), abs=0.05)
    slopes = np.gradient(height, relief.metres_per_sample)
    assert np.sqrt(np.mean(slopes[0] ** 2)) == pytest.approx(np.sqrt(2) * 0.002 / 0.05, rel=0.1)
    assert np.hypot(*slopes).max() <= relief.steepest <= 2 * np.hypot(*slopes).max()
    assert np.abs(height).max() <= relief.highest_m
    assert np.array_equal(relief.coefficients, Relief(0.002, 0.05, seed=3).coefficients)
    assert not np.array_equal(relief.coefficients, Relief(0.002, 0.05, seed=4).coefficients)


def test_rays_meet_the_relief_where_marching_finds_it() -> None:
    relief, camera = Relief(0.004, 0.06, seed=1), pinhole(320, 320, 160.0, distortion=(0.05,))
    seen = view(Scene(waves(), relief=relief), camera, above(0.09), still(0.2, 0.1, 0.6), 0.0)
    assert np.isfinite(seen).all()

    def height(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        n, step = relief.samples, relief.metres_per_sample
        places = [np.mod(-y / step, n) + 1, np.mod(x / step, n) + 1]
        return scipy.ndimage.map_coordinates(relief.coefficients.astype(float), places, order=3, prefilter=False)

    pixels = pixels_of(camera)[::137]
    r = rotations(*np.array([[0.6], [0.0], [0.0]]))[0] @ NADIR
    d = opencv_rays(camera, pixels) @ r.T
    reach = np.linspace(0.09 - relief.highest_m, 0.09 + relief.highest_m, 2000)[:, None]
    x, y = 0.2 + reach * d[:, 0], 0.1 + reach * d[:, 1]
    over = 0.09 - reach - height(x, y)
    first = np.argmax(over < 0, axis=0)
    k, at = np.arange(len(pixels)), (first - 1, first)
    share = over[at[0], k] / (over[at[0], k] - over[at[1], k])
    x, y = (a[at[0], k] + share * (a[at[1], k] - a[at[0], k]) for a in (x, y))
    flat = wave_ground(0.2 + 0.09 * d[:, 0], 0.1 + 0.09 * d[:, 1])
    mine = seen.reshape(-1)[::137]
    np.testing.assert_allclose(mine, wave_ground(x, y), atol=0.02)
    assert np.abs(mine - flat).max() > 10


def test_views_of_a_relief_that_could_be_met_twice_are_refused() -> None:
    rough = Scene(waves(), relief=Relief(0.02, 0.05))
    with pytest.raises(ValueError, match="lower or longer bumps"):
        view(rough, PLAIN, above(1.0), still(), 0.0)
    with pytest.raises(ValueError, match="lower or longer bumps"):
        view(Scene(waves(), relief=Relief(0.001, 0.05)), PLAIN, ahead(), still(), 0.0)
    with pytest.raises(ValueError, match="among the bumps"):
        view(rough, PLAIN, above(0.02), still(), 0.0)


# --------------------------------------------------------------------------- anti-aliasing


def one_wave(cycles_x: int, cycles_y: int) -> Surface:
    rows, columns = np.mgrid[:PERIOD, :PERIOD]
    return surface_from_periodic(
        120 + 100 * np.cos(2 * np.pi * (cycles_x * columns + cycles_y * rows) / PERIOD), psf_sigma_px=0
    )


@pytest.mark.parametrize("size", [1.5, 2.0, 3.1, 7.0, 40.0])
def test_what_a_pixel_cannot_hold_becomes_its_mean(size: float) -> None:
    for cycles in ((110, 0), (0, 110), (78, 78)):  # 0.43 cycles per px of the picture: 0.64 and more per pixel
        seen = view(Scene(one_wave(*cycles)), PLAIN, above(size * HEIGHT), still(0.01, 0.02, 0.3), 0.0)
        assert np.abs(seen - 120).max() < 0.1
        h = world_h_pixel(np.array([0.01, 0.02, 0.3]), PLAIN.matrix, size * HEIGHT)
        assert np.abs(radiance(one_wave(*cycles), h, (256, 256)) - 120).max() > 90  # a point sampler shows moiré


def test_what_a_pixel_can_hold_stays() -> None:
    for size in (1.05, 1.3, 1.6, 2.4, 3.0, 5.0):
        wave = one_wave(round(0.1 * PERIOD / size), 0)  # 0.1 cycles per pixel
        seen = view(Scene(wave), PLAIN, above(size * HEIGHT), still(), 0.0)
        assert 80 < np.sqrt(2) * (seen - 120).std() < 101


def test_a_grazing_view_has_no_moire() -> None:
    surface, camera = one_wave(110, 0), pinhole(160, 200, 256.0)
    mount = above(1.5, body_r_camera=looking(FORWARD, pitch_rad=0.32))
    seen = view(Scene(surface), camera, mount, still(), 0.0)
    r = looking(FORWARD, pitch_rad=0.32)
    hit = ground_points(camera, r, np.array([0, 0, 1.5]))
    per_pixel = np.abs(np.gradient(hit[..., 0])[0]) / W * 110 / PERIOD  # cycles along the long axis
    below = (r @ opencv_rays(camera, pixels_of(camera)).T)[2].reshape(200, 160) < -0.05
    assert np.abs(seen - 120)[below & (per_pixel > 1.0)].max() < 6
    h = (
        np.diag([1 / W, -1 / W, 1])
        @ np.array([[1.5, 0, 0], [0, 1.5, 0], [0, 0, -1]])
        @ r
        @ np.linalg.inv(camera.matrix)
    )
    p = h @ np.column_stack([pixels_of(camera), np.ones(200 * 160)]).T
    naive = np.cos(2 * np.pi * 110 / PERIOD * p[0] / p[2]).reshape(200, 160)
    assert 100 * np.abs(naive)[below & (per_pixel > 1.0)].max() > 90


def test_a_grazing_view_keeps_what_its_pixels_can_hold() -> None:
    """Stripes along the view stay sharp where stripes across it are long gone."""
    surface, camera = one_wave(0, 10), pinhole(160, 120, 256.0)
    mount = above(0.4, body_r_camera=looking(FORWARD, pitch_rad=0.27))
    seen = view(Scene(surface), camera, mount, still(), 0.0)
    hit = ground_points(camera, looking(FORWARD, pitch_rad=0.27), np.array([0, 0, 0.4]))
    row = 60
    across = np.abs(np.gradient(hit[..., 1])[1][row]).mean() / W * 10 / PERIOD
    assert 0.2 < across < 0.35  # cycles per pixel
    expected = np.cos(2 * np.pi * 10 / PERIOD * -hit[row, :, 1] / W)
    left = np.dot(seen[row] - 120, expected) / np.dot(expected, expected) / 100
    assert 0.4 < left < 1
    np.testing.assert_allclose(np.corrcoef(seen[row], expected)[0, 1], 1, atol=0.01)


def test_coarser_surfaces_show_the_same_ground() -> None:
    half = coarser(waves())
    assert half.metres_per_texel == 2 * waves().metres_per_texel
    assert half.period_m == waves().period_m
    texels = half.coefficients[1:-2, 1:-2].shape
    rows, columns = np.mgrid[: texels[0], : texels[1]]
    values = scipy.ndimage.map_coordinates(
        half.coefficients.astype(float), [rows + 1, columns + 1], order=3, prefilter=False
    )
    step = half.metres_per_texel
    expected = wave_ground(columns * step, -rows * step, psf_sigma_px=2 * PSF_SIGMA_PX)
    np.testing.assert_allclose(values, expected, atol=2e-3)


@pytest.mark.parametrize("shape", [(6, 10), (2, 2), (64, 48)])
def test_surfaces_of_any_size_get_coarser_to_their_mean(shape: tuple[int, int]) -> None:
    picture = np.random.default_rng(0).uniform(50, 200, shape)
    for coefficients, _ in levels_of(surface_from_periodic(picture)):
        assert coefficients[1:-2, 1:-2].mean() == pytest.approx(picture.mean(), abs=1e-3)
        assert np.array_equal(coefficients[0], coefficients[-3])
        assert np.array_equal(coefficients[:, 1:3], coefficients[:, -2:]) or coefficients.shape[1] == 4
    assert np.ptp(coefficients) == 0


# ---------------------------------------------------------------------- planes and horizon


def test_the_horizon_of_a_forward_camera() -> None:
    camera = pinhole(200, 151, 150.0)
    seen = view(Scene(stones(), background_grey=33.0), camera, ahead(), still(), 0.0)
    assert np.isfinite(seen).all()
    assert np.all(seen[:75] == 33)
    mean = stones().coefficients[1:-2, 1:-2].mean()
    np.testing.assert_allclose(seen[75], (mean + 33) / 2, atol=0.01)  # its pixels are half ground
    np.testing.assert_allclose(seen[76], mean, atol=1.0)
    assert seen[-1].std() > 1


def plate(grey: float, at: tuple[float, float, float], facing: float = np.pi, size: float = 0.5) -> Plane:
    surface = surface_from_periodic(np.full((4, 4), grey))
    return Plane(surface, upright(np.array(at), facing), (-size, size, -size, size))


def test_only_what_is_before_the_camera_and_faces_it_is_seen() -> None:
    camera = pinhole(101, 81, 100.0)

    def middle(*planes: Plane) -> float:
        return float(view(Scene(None, planes=planes, background_grey=5.0), camera, ahead(), still(), 0.0)[40, 50])

    assert middle() == 5
    assert middle(plate(200, (2, 0, 0.7))) == pytest.approx(200, abs=1e-3)
    assert middle(plate(200, (2, 0, 0.7), facing=0.0)) == 5  # its back
    assert middle(plate(200, (-2, 0, 0.7))) == 5
    assert middle(plate(200, (-2, 0, 0.7), facing=0.0)) == 5
    near, far = plate(200, (2, 0, 0.7)), plate(90, (3, 0, 0.7))
    assert middle(near, far) == middle(far, near) == pytest.approx(200, abs=1e-3)
    assert middle(far, plate(120, (3, 0, 0.7), size=0.1)) == pytest.approx(120, abs=1e-3)  # the later one


def test_a_plane_passes_beside_the_camera() -> None:
    wall = Plane(stones(), upright(np.array([0.0, 1.0, 0.0]), -np.pi / 2), (-50.0, 50.0, 0.0, 2.0))
    seen = view(Scene(None, planes=(wall,), background_grey=0.0), pinhole(200, 150, 150.0), ahead(), still(), 0.0)
    assert np.isfinite(seen).all()
    assert seen[75, 0] > 0
    assert seen[75, 150] == 0


def test_crossing_planes_hide_each_other_by_depth() -> None:
    left = Plane(plate(200, (0, 0, 0)).surface, upright(np.array([3.0, 0, 0.7]), np.pi - 0.6), (-1, 1, -0.5, 0.5))
    right = Plane(plate(60, (0, 0, 0)).surface, upright(np.array([3.0, 0, 0.7]), np.pi + 0.6), (-1, 1, -0.5, 0.5))
    for planes in ((left, right), (right, left)):
        seen = view(Scene(None, planes=planes), pinhole(101, 81, 100.0), ahead(), still(), 0.0)
        assert (seen[40, 35], seen[40, 65]) == (pytest.approx(60, abs=1e-3), pytest.approx(200, abs=1e-3))


def test_a_poster_on_a_wall_has_no_fringe() -> None:
    """Nearer things are painted last, however near the middle of what is behind them is."""
    wall = Plane(plate(100, (0, 0, 0)).surface, upright(np.array([3.0, 0, 0.0]), np.pi), (-4.0, 4.0, 0.0, 3.0))
    paper = plate(100, (2.999, -1.3, 0.8), size=0.2)
    for planes in ((wall, paper), (paper, wall)):
        seen = view(Scene(None, planes=planes, background_grey=0), pinhole(201, 101, 100.0), ahead(), still(), 0.0)
        np.testing.assert_allclose(seen[40:60], 100, atol=1e-3)


def test_edges_of_planes_cover_their_share_of_a_pixel() -> None:
    camera = pinhole(101, 81, 100.0)
    for right_m in (0.31, 0.317, 0.33):  # half the width at 2 m: 15.5, 15.85, 16.5 px
        white = Plane(
            plate(100, (0, 0, 0)).surface, upright(np.array([2.0, 0, 0.7]), np.pi), (-0.2, right_m, -0.2, 0.2)
        )
        seen = view(Scene(None, planes=(white,), background_grey=0), camera, ahead(), still(), 0.0)
        assert seen[40, 50:].sum() / 100 == pytest.approx(50 * right_m + 0.5, abs=0.02)


def saddles(image: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Saddle points [n, 2] of a picture, softened by 1.5 px, by Newton's method on a quintic spline."""
    soft = scipy.ndimage.gaussian_filter(image.astype(float), 1.5)
    spline = scipy.ndimage.spline_filter(soft, order=5, mode="mirror")
    h, found = 0.25, near.copy()

    def f(du: float, dv: float) -> np.ndarray:
        places = [found[:, 1] + dv, found[:, 0] + du]
        return scipy.ndimage.map_coordinates(spline, places, order=5, prefilter=False, mode="mirror")

    for _ in range(5):
        slope = np.stack([f(h, 0) - f(-h, 0), f(0, h) - f(0, -h)], axis=-1) / (2 * h)
        uu, vv = (f(h, 0) + f(-h, 0) - 2 * f(0, 0)) / h**2, (f(0, h) + f(0, -h) - 2 * f(0, 0)) / h**2
        uv = (f(h, h) + f(-h, -h) - f(h, -h) - f(-h, h)) / (4 * h**2)
        hessian = np.stack([np.stack([uu, uv], -1), np.stack([uv, vv], -1)], -2)
        found = found - np.linalg.solve(hessian, slope[..., None])[..., 0]
    return found


@pytest.mark.parametrize("name", ["none", "plumb_bob"])
@pytest.mark.parametrize("distance", [4.0, 8.0])
def test_a_chessboard_is_where_it_says(name: str, distance: float) -> None:
    camera, mount = lens(name, 640, 480, 520.0), ahead()
    world_t_board = upright(np.array([distance, 0.3, 0.9]), np.pi - 0.35)
    radiant = view(Scene(stones(), planes=(chessboard(7, 6, 0.1, world_t_board),)), camera, mount, still(), 0.0)
    (r,), (position,) = mount.world_t_camera(still().at(np.zeros(1)))
    truth = project(camera, (chessboard_corners(7, 6, 0.1, world_t_board) - position) @ r)
    assert np.abs(saddles(radiant, truth) - truth).max() < 5e-3

    # OpenCV's own detectors see the same corners in the same order; what they are off is theirs
    seen = expose(radiant, noise_key=0)
    found, corners = cv2.findChessboardCornersSB(seen, (7, 6), flags=cv2.CALIB_CB_ACCURACY)
    assert found
    start = np.ascontiguousarray(truth[:, None], dtype=np.float32)
    refined = cv2.cornerSubPix(seen, start, (3, 3), (-1, -1), EXACTLY)[:, 0]
    for measured in (corners.reshape(-1, 2), refined):
        off = np.linalg.norm(measured - truth, axis=1)
        print(f"{distance:g} m, {name}: corners off by {off.mean():.4f} px, at most {off.max():.4f}")
        assert off.mean() < 0.06
        assert np.linalg.norm((measured - truth).mean(axis=0)) < 0.04

    board = chessboard_corners(7, 6, 0.1, np.eye(4))
    for measured, tolerance_m in ((saddles(radiant, truth), 2e-3), (refined, 0.03)):
        _, rvec, tvec = cv2.solvePnP(board, measured.astype(float), camera.matrix, camera.distortion)
        eye = world_t_board[:3, :3] @ (-cv2.Rodrigues(rvec)[0].T @ tvec[:, 0]) + world_t_board[:3, 3]
        print(f"camera off by {1e3 * np.linalg.norm(eye - position):.2f} mm")
        assert np.linalg.norm(eye - position) < tolerance_m * distance / 4


def test_a_poster_is_centred_on_its_landmark() -> None:
    landmark, camera = np.array([5.0, 0.7, 1.1]), pinhole(640, 480, 600.0)
    for rng in (None, np.random.default_rng(1)):
        scene = Scene(stones(), planes=(poster(landmark, rng=rng),))
        seen = expose(view(scene, camera, ahead(), still(), 0.0), noise_key=0)
        truth = project(camera, (landmark - [0, 0, 0.7])[None] @ FORWARD)
        start = truth.astype(np.float32)[:, None] + np.float32(0.8)
        found = cv2.cornerSubPix(seen, start, (4, 4), (-1, -1), EXACTLY)
        assert np.abs(found[0] - truth).max() < 0.03


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Scene(None, relief=Relief(0.001, 0.05)), "give the scene one"),
        (lambda: Scene(waves(), planes=(plate(9, (1, 0, 0.2)),)), "below the ground"),
        (lambda: Plane(waves(), np.eye(3), (0, 1, 0, 1)), "rigid motion"),
        (lambda: Plane(waves(), np.diag([1.0, 1, -1, 1]), (0, 1, 0, 1)), "rigid motion"),
        (lambda: Plane(waves(), np.eye(4), (1, 0, 0, 1)), "enclose nothing"),
        (lambda: chessboard(0, 3, 0.1, np.eye(4)), "at least 1 x 1"),
        (lambda: poster(np.zeros(3), size_m=0.0), "must be positive"),
        (lambda: Relief(-1.0, 0.05), "must be positive"),
    ],
)
def test_scenes_that_cannot_be_are_refused(make: Callable[[], object], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        make()


# ------------------------------------------------------------------------------------ dirt


def test_dirt_is_a_fixed_pattern() -> None:
    image = np.full((60, 80), 200, dtype=np.float32)
    pattern = dirt((60, 80), 7)
    assert pattern.mean() == pytest.approx(110, abs=0.01)
    assert pattern.std() == pytest.approx(40, abs=0.01)
    np.testing.assert_allclose(behind_dirt(image, 0.25, 7), 0.75 * 200 + 0.25 * pattern, atol=1e-3)
    assert np.array_equal(behind_dirt(image, 0.0, 7), image)
    assert not np.array_equal(pattern, dirt((60, 80), 8))
