"""The kernels against plain numpy, OpenCV and scipy, and the study's accuracy bars A5-A10."""

import cv2
import numpy as np
import pytest
from recordings_dir import RECORDINGS
from scipy import ndimage

from pipelines.correlation import kernels
from pipelines.simulation.render import expose, radiance, world_h_pixel
from pipelines.simulation.surfaces import Surface, surface_from_image

W = 0.2002 / 256
K = np.array([[256, 0, 255.5], [0, 256, 255.5], [0, 0, 1.0]])
DEGREE = np.pi / 180


def surface_of(name: str) -> Surface:
    path = next(p for p in (RECORDINGS / "paper_a_surface_frames").iterdir() if p.name.startswith(name))
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED).astype(np.float64)
    return surface_from_image(0.114 * image[..., 0] + 0.587 * image[..., 1] + 0.299 * image[..., 2])


@pytest.fixture(scope="module")
def gravel() -> Surface:
    return surface_of("b_01")


def frame(surface: Surface, pose: tuple[float, float, float], key: int, noise: float = 2.0, gain: float = 1.0):
    h = world_h_pixel(np.array(pose), K, 0.2002)
    return expose(radiance(surface, h, (512, 512), ()), noise_key=key, noise_grey=noise, gain=gain)


def textured(seed: int, size: int = 96) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(0, 1, (size, size))
    smooth = ndimage.gaussian_filter(noise, 1.3)
    return np.clip(128 + 40 * smooth / smooth.std(), 0, 255).astype(np.uint8)


# --------------------------------------------------------------------- correctness of kernels


@pytest.mark.parametrize(("side", "radius"), [(5, 4), (9, 16), (21, 8), (31, 3)])
def test_surface_is_that_of_matchtemplate(side: int, radius: int) -> None:
    image, half = textured(0), side // 2
    template = textured(1)[40 - half : 41 + half, 50 - half : 51 + half]
    surface = np.empty((2 * radius + 1, 2 * radius + 1), np.float32)
    kernels.correlation_surface(template.astype(np.float32), image, 45, 47, radius, surface)
    reach = half + radius
    window = image[47 - reach : 48 + reach, 45 - reach : 46 + reach]
    np.testing.assert_allclose(surface, cv2.matchTemplate(window, template, cv2.TM_CCOEFF_NORMED), atol=2e-5)


def test_surface_is_nan_outside_the_image_and_zero_where_it_is_flat() -> None:
    image = textured(0)
    image[60:, 60:] = 77
    template = image[10:19, 10:19].astype(np.float32)
    surface = np.empty((33, 33), np.float32)
    kernels.correlation_surface(template, image, 90, 90, 16, surface)
    assert surface[0, 0] == 0.0
    assert np.isnan(surface[:, 18:]).all()
    assert np.isfinite(surface[:18, :18]).all()
    kernels.correlation_surface(np.full((9, 9), 5, np.float32), image, 40, 40, 16, surface)
    assert (surface == 0).all()


def test_peaks_are_the_highest_and_the_next_hill() -> None:
    v, u = np.mgrid[0:33, 0:33]
    surface = np.exp(-((u - 20) ** 2 + (v - 9) ** 2) / 8) + 0.6 * np.exp(-((u - 5) ** 2 + (v - 28) ** 2) / 8)
    j, i, value, second_j, second_i, second = kernels.find_peaks(surface.astype(np.float32), 0.0)
    assert (j, i, second_j, second_i) == (9, 20, 28, 5)
    assert (value, second) == pytest.approx((1.0, 0.6), abs=1e-6)
    rivals = surface + 0.97 * np.exp(-((u - 15) ** 2 + (v - 17) ** 2) / 8)
    assert kernels.find_peaks(rivals.astype(np.float32), 0.0)[:2] == (9, 20)
    j, i, value, second_j, second_i, second = kernels.find_peaks(rivals.astype(np.float32), 0.05)
    assert (j, i, second_j, second_i) == (17, 15, 9, 20)  # nearest to the middle
    assert second > value
    surface[:] = np.nan
    assert kernels.find_peaks(surface.astype(np.float32), 0.0)[0] == -1


def test_quadric_gives_vertex_curvature_and_anisotropy() -> None:
    v, u = np.mgrid[0:9, 0:9]
    surface = (0.9 - 0.05 * (u - 4.3) ** 2 - 0.2 * (v - 3.8) ** 2).astype(np.float32)
    du, dv, curvature, anisotropy = kernels.peak_shape(surface, 4, 4)
    assert (du, dv, curvature, anisotropy) == pytest.approx((0.3, -0.2, 0.1, 4.0), abs=1e-4)
    assert np.isnan(kernels.peak_shape(surface, 0, 4)).all()


def test_one_step_has_the_sign_of_the_contents_shift() -> None:
    v, u = np.mgrid[0:64, 0:64].astype(np.float64)

    def scene(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return 120 + 50 * np.sin(0.23 * x + 0.4) + 40 * np.cos(0.19 * y - 0.12 * x)

    first, second = scene(u, v), scene(u - 0.3, v + 0.2)  # the content moves by (+0.3, -0.2)
    hessian = np.empty((2, 2))
    du, dv, _ = kernels.one_step(
        np.round(first).astype(np.uint8), np.round(second).astype(np.uint8), 32, 32, 0, 0, 15, hessian
    )
    assert (du, dv) == pytest.approx((0.3, -0.2), abs=0.03)
    # I_xyᵀ I_xy and the solution in plain numpy
    a, b = np.round(first), np.round(second)
    box = (slice(25, 40), slice(25, 40))
    gu, gv = (a[25:40, 26:41] - a[25:40, 24:39]) / 2, (a[26:41, 25:40] - a[24:39, 25:40]) / 2
    g = np.stack([gu.ravel(), gv.ravel()], 1)
    np.testing.assert_allclose(hessian, g.T @ g, rtol=1e-12)
    np.testing.assert_allclose([du, dv], np.linalg.lstsq(g, (a[box] - b[box]).ravel(), rcond=None)[0], atol=1e-9)


def test_one_step_flags_a_flat_fragment() -> None:
    flat = np.full((40, 40), 90, np.uint8)
    assert np.isnan(kernels.one_step(flat, flat, 20, 20, 0, 0, 9, np.empty((2, 2)))[0])


def test_templates_are_the_cubic_spline_of_scipy() -> None:
    image = textured(4)
    centres = np.array([[40, 50], [55, 44], [47, 47]])
    coefficients = kernels.spline_patches(image, centres, 11)
    psi = 0.21
    sampled = kernels.templates(coefficients, 11, psi)
    filtered = ndimage.spline_filter(image.astype(np.float64), order=3, mode="nearest")
    qv, qu = np.mgrid[-5:6, -5:6].astype(np.float64)
    step = 1e-4
    for i, (u, v) in enumerate(centres):

        def at(du: float, dv: float, u: int = u, v: int = v) -> np.ndarray:
            a, b = qu + du, qv + dv
            x, y = u + np.cos(psi) * a + np.sin(psi) * b, v - np.sin(psi) * a + np.cos(psi) * b
            return ndimage.map_coordinates(filtered, [y, x], order=3, prefilter=False)

        np.testing.assert_allclose(sampled[0, :, :, i], at(0, 0), atol=0.02)
        np.testing.assert_allclose(sampled[1, :, :, i], (at(step, 0) - at(-step, 0)) / (2 * step), atol=0.03)
        np.testing.assert_allclose(sampled[2, :, :, i], (at(0, step) - at(0, -step)) / (2 * step), atol=0.03)


def test_refinement_is_exact_on_a_spline_without_noise() -> None:
    # the second image is the first one's cubic spline, sampled 0.37, -0.21 px further on
    image = textured(5, 128).astype(np.float64)
    filtered = ndimage.spline_filter(image, order=3, mode="nearest")
    v, u = np.mgrid[0:128, 0:128].astype(np.float64)
    moved = ndimage.map_coordinates(filtered, [v + 0.21, u - 0.37], order=3, prefilter=False)
    centres = np.array([[64, 64], [50, 70]])
    m = kernels.new_matches(2, 4)
    coefficients = kernels.spline_patches(image.astype(np.uint8), centres, 21)
    kernels.match_iterated(
        coefficients, np.round(moved).clip(0, 255).astype(np.uint8), centres, centres, 0.0, 21, 4, 0.0, True, 20, 1e-6,
        m.surface, m.hessian, m.block,
    )  # fmt: skip
    np.testing.assert_allclose(m.shift_px, [[0.37, -0.21]] * 2, atol=0.004)  # rounding to grey levels remains
    np.testing.assert_allclose(m.gain, 1.0, atol=0.01)


def test_refinement_estimates_gain_and_offset() -> None:
    image = textured(6, 128)
    other = np.round(0.8 * image + 13).astype(np.uint8)
    centres = np.array([[64, 64]])
    m = kernels.new_matches(1, 4)
    coefficients = kernels.spline_patches(image, centres, 21)
    kernels.match_iterated(
        coefficients, other, centres, centres, 0.0, 21, 4, 0.0, True, 10, 1e-4, m.surface, m.hessian, m.block
    )
    assert m.gain[0] == pytest.approx(0.8, abs=0.01)
    assert m.offset[0] == pytest.approx(13, abs=1)
    assert m.mean_grey[0] == pytest.approx(other[54:75, 54:75].mean(), abs=0.2)
    np.testing.assert_allclose(m.shift_px, 0, atol=0.01)


def similarity(points: np.ndarray, shift: tuple[float, float], psi: float, scale: float) -> np.ndarray:
    c, s = scale * np.cos(psi), scale * np.sin(psi)
    return points @ np.array([[c, s], [-s, c]]) + np.array(shift) - points


def test_consensus_and_fit_recover_a_similarity_among_outliers() -> None:
    rng = np.random.default_rng(1)
    points = np.array([(u, v) for v in (-150, 0, 150) for u in (-110, 0, 110)], np.float64)
    shifts = similarity(points, (-11.3, 2.2), 0.03, 1.01)
    shifts[[1, 5, 6]] += rng.uniform(3, 20, (3, 2))
    usable = np.ones(9, bool)
    usable[8] = False
    found = kernels.consensus(points, shifts, usable, 1.0, 0.1)
    assert found[4] == 5
    assert found[:4] == pytest.approx((-11.3, 2.2, 0.03, 1.01), abs=1e-9)
    hessian = np.tile(np.diag([9000.0, 4000.0]), (9, 1, 1))
    noise = np.where(usable, 2.0, np.nan)
    fit = kernels.photometric_fit(points, shifts, hessian, noise, *found[:4], 1.0, 0.3)
    assert (fit.shift_u, fit.shift_v, fit.rotation_rad, fit.scale) == pytest.approx((-11.3, 2.2, 0.03, 1.01), abs=1e-7)
    assert (fit.weight > 0.99).sum() == 5
    assert fit.weight[1] == fit.weight[8] == 0


def test_covariance_of_the_fit_is_that_of_its_noise() -> None:
    rng = np.random.default_rng(2)
    points = np.array([(u, v) for v in (-150, 0, 150) for u in (-110, 0, 110)], np.float64)
    truth = similarity(points, (-11.0, 2.0), 0.004, 1.0)
    hessian = np.tile(np.array([[40000.0, 6000.0], [6000.0, 20000.0]]), (9, 1, 1))
    root = np.linalg.cholesky(np.linalg.inv(hessian[0]) * 2.8**2)
    noise = np.full(9, 2.8)
    errors = []
    for _ in range(2000):
        shifts = truth + rng.normal(0, 1, (9, 2)) @ root.T
        fit = kernels.photometric_fit(points, shifts, hessian, noise, -11.0, 2.0, 0.004, 1.0, 1.0, 3.0)
        errors.append((fit.shift_u + 11.0, fit.shift_v - 2.0, fit.rotation_rad - 0.004))
    e = np.array(errors)
    nees = np.einsum("ni,ij,nj->n", e, np.linalg.inv(fit.covariance), e).mean()
    assert nees == pytest.approx(3.0, abs=0.25)


def test_propagated_covariance_is_that_of_differences() -> None:
    from pipelines.correlation.equations import Motion, increment_of_vector

    def pose_after(base: np.ndarray, m: np.ndarray) -> np.ndarray:
        heading = base[2] + m[2]
        return np.array([*(base[:2] + increment_of_vector((m[0], m[1]), 0.01, heading)), heading])

    base, motion = np.array([1.0, 2.0, 0.7]), np.array(Motion(-12.0, 3.0, 0.05)[:3])
    p, q = np.diag([0.01, 0.02, 0.003]), np.array([[0.04, 0.01, 0.0], [0.01, 0.09, 2e-4], [0.0, 2e-4, 1e-4]])
    step = 1e-6
    f = np.stack(
        [(pose_after(base + d, motion) - pose_after(base - d, motion)) / (2 * step) for d in step * np.eye(3)], 1
    )
    g = np.stack(
        [(pose_after(base, motion + d) - pose_after(base, motion - d)) / (2 * step) for d in step * np.eye(3)], 1
    )
    pose = pose_after(base, motion)
    ours = kernels.propagated(p, tuple(base), tuple(pose), q, 0.01, pose[2])
    np.testing.assert_allclose(ours, f @ p @ f.T + g @ q @ g.T, atol=1e-9)


def test_frame_statistics_and_medians() -> None:
    image = textured(8)
    mean, energy = kernels.frame_statistics(image)
    rows = np.arange(16, 95, 32)
    a = image.astype(float)
    assert mean == pytest.approx(a[rows, :-1].mean())
    du, dv = a[rows, 1:] - a[rows, :-1], a[rows + 1, :-1] - a[rows, :-1]
    assert energy == pytest.approx((du**2 + dv**2).mean())
    history = np.full((3, 9), np.nan)
    history[0, :4] = 1.0
    history[1, :5] = [5, 1, 3, 2, 4]
    assert np.array_equal(kernels.running_medians(history), (np.nan, 3.0, np.nan), equal_nan=True)


# ------------------------------------------------------------------------- the study's bars


class Errors:
    """Errors of single fragments over pairs of rendered frames with known motion."""

    def __init__(
        self, surface: Surface, side: int, turn_deg: float, *, pairs: int, noise: float = 2.0, gain: float = 1.0
    ):
        rng = np.random.default_rng(side)
        grid = range(76, 440, 72)
        self.centres = np.array([(u, v) for u in grid for v in grid])
        self.side, self.turn, self.gain = side, turn_deg * DEGREE, gain
        self.frames = []
        for k in range(pairs):
            x, y, heading = *rng.uniform(0, 3, 2), rng.uniform(-3, 3)
            u, v = rng.uniform(-6, 6, 2)
            c, s = np.cos(heading + self.turn), np.sin(heading + self.turn)
            moved = (x - W * (c * u + s * v), y - W * (s * u - c * v), heading + self.turn)
            points = self.centres - 255.5
            truth = similarity(points, (u, v), self.turn, 1.0)
            self.frames.append(
                (frame(surface, (x, y, heading), 2 * k, noise), frame(surface, moved, 2 * k + 1, noise, gain), truth)
            )

    def one_step(self, radius: int = 16):
        for a, b, truth in self.frames:
            m = kernels.new_matches(len(self.centres), radius)
            search = self.centres + np.floor(truth + np.array([3.5, -1.5])).astype(np.int64)
            kernels.match_one_step(a, b, self.centres, search, self.side, radius, m.surface, m.hessian, m.block)
            yield m, truth

    def iterated(self, turned: float, gain_and_offset: bool = True, radius: int = 16):
        for a, b, truth in self.frames:
            m = kernels.new_matches(len(self.centres), radius)
            search = self.centres + np.floor(truth + np.array([3.5, -1.5])).astype(np.int64)
            kernels.match_iterated(
                kernels.spline_patches(a, self.centres, self.side), b, self.centres, search, turned, self.side,
                radius, 0.0, gain_and_offset, 10, 1e-3, m.surface, m.hessian, m.block,
            )  # fmt: skip
            yield m, truth


def rms_of(results) -> float:
    """RMS per axis (px) where the integer peak is right."""
    errors = []
    for m, truth in results:
        right = np.abs(m.peak_px - truth).max(axis=1) < 1.5
        errors.append((m.shift_px - truth)[right])
    return float(np.sqrt(np.mean(np.concatenate(errors) ** 2)))


def s_curve_of(results) -> float:
    """Amplitude (px) of the error's part that goes with the sine of the subpixel fraction."""
    e, f = [], []
    for m, truth in results:
        right = np.abs(m.peak_px - truth).max(axis=1) < 1.5
        e.append((m.shift_px - truth)[right].ravel())
        f.append(truth[right].ravel())
    return float(2 * np.mean(np.concatenate(e) * np.sin(2 * np.pi * np.concatenate(f))))


def false_peaks_of(results) -> float:
    wrong = [np.hypot(*(m.peak_px - truth).T) > 1.5 for m, truth in results]
    return float(np.concatenate(wrong).mean())


@pytest.mark.parametrize(
    ("side", "gain_and_offset", "compensated", "plain"),
    [(9, False, 0.047, 0.048), (21, True, 0.019, 0.023), (31, True, 0.0135, 0.020)],
)
def test_a5_a6_accuracy_of_the_refinement(
    gravel: Surface, side: int, gain_and_offset: bool, compensated: float, plain: float
) -> None:
    errors = Errors(gravel, side, 0.44, pairs=60 if side == 9 else 20)
    rms = [rms_of(errors.iterated(turn, gain_and_offset)) for turn in (0.44 * DEGREE, 0.0)]
    print(f"A5, A6 side {side}: rms px compensated, plain", *rms)
    assert rms[0] <= compensated
    assert rms[1] <= plain


def test_a7_s_curves(gravel: Surface) -> None:
    errors = Errors(gravel, 21, 0.44, pairs=24)
    curves = s_curve_of(errors.iterated(0.44 * DEGREE)), s_curve_of(errors.one_step())
    print("A7 S-curves px: best, paper-a", *curves)
    assert abs(curves[0]) <= 0.006
    assert curves[1] == pytest.approx(0.028, abs=0.007)


def test_a8_large_rotation(gravel: Surface) -> None:
    errors = Errors(gravel, 21, 2.5, pairs=10)
    rms = rms_of(errors.iterated(2.5 * DEGREE))
    print("A8 rms px", rms)
    assert rms <= 0.020
    assert rms_of(errors.iterated(0.0)) > 0.05  # what compensation is for


@pytest.mark.parametrize(("side", "bar"), [(9, 0.065), (21, 0.032)])
def test_a9_exposure(gravel: Surface, side: int, bar: float) -> None:
    errors = Errors(gravel, side, 0.44, pairs=10, gain=1.15)
    rms = rms_of(errors.iterated(0.44 * DEGREE))
    print(f"A9 side {side}: rms px", rms)
    assert rms <= bar
    assert rms_of(errors.iterated(0.44 * DEGREE, gain_and_offset=False)) > bar


@pytest.mark.parametrize(
    ("name", "side", "low", "high"),
    [("b_01", 9, 0.0, 0.005), ("f_01", 9, 0.17, 0.29), ("f_01", 21, 0.0, 0.01), ("a_01", 31, 0.0, 0.015)],
)
def test_a10_false_peaks(name: str, side: int, low: float, high: float) -> None:
    errors = Errors(surface_of(name), side, 0.44, pairs=20)
    false = false_peaks_of(errors.one_step())
    print(f"A10 {name} side {side}: false peaks", false)
    assert low <= false <= high
