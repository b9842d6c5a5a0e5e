"""Surfaces: endless, seamless, without repetition, as hard to match as they are said to be."""

import functools
import zlib
from dataclasses import replace

import cv2
import numpy as np
import pytest
import scipy.ndimage
from recordings_dir import RECORDINGS
from test_simulation import FRACTIONS, quintic_shift_error, s_curve

from benchmarks.surfaces import false_peaks
from pipelines.simulation.families import FAMILIES, PAVER_PX, gradient_rms, ground, spectral_slope
from pipelines.simulation.mission import PAPER_HEIGHT_M, nadir_camera
from pipelines.simulation.render import radiance, world_h_pixel
from pipelines.simulation.sampling import _blend
from pipelines.simulation.surfaces import (
    OFFSETS,
    PAPER_METRES_PER_PX,
    WRAP,
    CellAxis,
    Scatter,
    Surface,
    gravel,
    scattered,
    surface_from_image,
    surface_from_periodic,
    tiles,
)

W = PAPER_METRES_PER_PX
CELL, BAND = 128, 32


def window(surface: Surface, shape: tuple[int, int], x_px: float, y_px: float, step_px: float = 1.0) -> np.ndarray:
    """The ground itself from picture coordinates (x, y) on, one sample every `step_px`."""
    m = surface.metres_per_px
    h = np.array([[step_px * m, 0, x_px * m], [0, -step_px * m, -y_px * m], [0, 0, 1.0]])
    return radiance(surface, h, shape).astype(float)


def see(surface: Surface, pose: tuple[float, float, float], side: int = 512) -> np.ndarray:
    return radiance(
        surface, world_h_pixel(np.array(pose), nadir_camera(side, side).matrix, PAPER_HEIGHT_M), (side, side)
    )


@functools.cache
def noise(side: int = 256, sigma_px: float = 1.5) -> Surface:
    """Periodic Gaussian noise of standard deviation 30 about 120."""
    grey = scipy.ndimage.gaussian_filter(np.random.default_rng(0).standard_normal((side, side)), sigma_px, mode="wrap")
    return surface_from_periodic(120 + 30 * grey / grey.std())


@functools.cache
def cells_of_noise() -> Surface:
    return scattered(noise(), 1, cell_px=CELL, band_px=BAND)


@functools.cache
def paper_picture(name: str = "b_01") -> np.ndarray:
    picture = cv2.imread(str(RECORDINGS / "paper_a_surface_frames" / f"{name}.png"), cv2.IMREAD_UNCHANGED)
    assert picture is not None, "the shared recordings are missing"
    return np.asarray(picture[..., :3].astype(float) @ [0.114, 0.587, 0.299])


@functools.cache
def ground_of(name: str, **settings: float) -> Surface:
    return ground(name, size_px=512, seed=3, **settings)


# -------------------------------------------------------------------------------- periodic ones


def test_strictly_periodic_surfaces_keep_their_bytes() -> None:
    rows, columns = np.mgrid[:40, :50]
    period = ((rows * 7919 + columns * 104729) % 251).astype(np.float32)
    surface = Surface(np.pad(period, (1, WRAP - 1), mode="wrap"), 1, 1.0)
    h = np.array([[0.875, 0.25, -300.125], [0.1875, -0.8125, 200.5], [2.0**-12, 2.0**-11, 1.0]])
    assert zlib.crc32(radiance(surface, h, (64, 96)).tobytes()) == 4002454641  # before there were cells


def test_surfaces_refuse_what_is_no_picture() -> None:
    with pytest.raises(ValueError, match="finite grey levels"):
        surface_from_image(np.zeros((4, 4, 3)))
    with pytest.raises(ValueError, match="must be even"):
        surface_from_periodic(np.zeros((5, 4)))


def test_surface_of_an_image_is_seamless_and_mirrored() -> None:
    surface = surface_from_image(paper_picture())
    assert surface.period_m == pytest.approx((1024 * W, 1024 * W))
    at_edge = window(surface, (64, 64), 512 - 32, 224)  # the picture's right border lies in the middle
    np.testing.assert_allclose(at_edge, at_edge[:, ::-1], atol=0.05)
    assert np.ptp(at_edge) > 50


@pytest.mark.parametrize("make", [lambda rng: gravel(256, rng), lambda rng: tiles(32, rng)], ids=["gravel", "tiles"])
def test_procedural_surfaces_are_seeded_and_periodic(make) -> None:
    surface, again, other = (make(np.random.default_rng(seed)) for seed in (1, 1, 2))
    assert np.array_equal(surface.coefficients, again.coefficients)
    assert not np.array_equal(surface.coefficients, other.coefficients)
    here = see(surface, (0.0, 0.0, 0.0), 128)
    np.testing.assert_allclose(see(surface, (surface.period_m[0], 0.0, 0.0), 128), here, atol=1e-2)
    np.testing.assert_allclose(see(surface, (0.0, surface.period_m[1], 0.0), 128), here, atol=1e-2)


def test_gravel_has_the_contrast_of_gravel() -> None:
    ours, real = (
        see(s, (0.0, 0.0, 0.0)) for s in (gravel(256, np.random.default_rng(0)), surface_from_image(paper_picture()))
    )
    assert gradient_rms(real) == pytest.approx(7.5, abs=0.7)
    assert gradient_rms(ours) == pytest.approx(gradient_rms(real), rel=0.2)
    assert np.mean((ours < 1) | (ours > 254)) < 0.01


# ------------------------------------------------------------------------------------- scatter


def second_peak(strip: np.ndarray) -> float:
    """Largest autocorrelation along the rows at lags above 100 samples, 1 for what repeats itself."""
    n = strip.shape[1]
    power = np.abs(np.fft.rfft(strip - strip.mean(), 2 * n, axis=1)) ** 2
    r = np.fft.irfft(power.sum(axis=0))[: n // 2] / (n - np.arange(n // 2))
    return float(np.max(r[100:] / r[0]))


@pytest.mark.parametrize("along", ["x", "y"])
def test_scattered_ground_does_not_repeat_itself_over_sixteen_metres(along: str) -> None:
    shape, turn = ((16, 20480), np.asarray) if along == "x" else ((20480, 16), np.transpose)
    assert second_peak(turn(window(noise(), shape, -700, 900))) > 0.98
    assert second_peak(turn(window(cells_of_noise(), shape, -700, 900))) < 0.12
    assert cells_of_noise().period_m == (np.inf, np.inf)


def test_offsets_of_cells_are_even_and_unrelated() -> None:
    """Read off a ramp: inside a cell, grey minus place is the cell's offset."""
    ramp = np.pad(np.arange(4200, dtype=np.float32), (1, WRAP - 1), mode="wrap")
    axis = CellAxis(8.0, 0.5, 4096 / OFFSETS)
    for transposed in (False, True):
        picture = np.tile(ramp, (8 + WRAP, 1))
        surface = Surface(picture.T.copy() if transposed else picture, 1, 1.0, Scatter(5, axis, axis, 0.0))
        seen = window(surface, (200, 200), -800 + 3, -800 + 3, 8.0)
        offset = (seen - 3) / 4096
        assert 0 <= offset.min() < 0.001
        assert 0.999 < offset.max() < 1.0
        counts = np.histogram(offset, 16, (0, 1))[0]
        assert np.sum((counts - 2500) ** 2 / 2500) < 38  # chi², 15 degrees of freedom, 0.1 %
        for other in (np.roll(offset, 1, 0), np.roll(offset, 1, 1), np.roll(offset, (1, 1), (0, 1))):
            apart = np.histogram((offset - other) % 1, 16, (0, 1))[0]
            assert np.abs(np.corrcoef(offset.ravel(), other.ravel())[0, 1]) < 5 / 200
            assert np.max(np.abs(apart / 2500 - 1)) < 0.1


def test_value_and_slope_are_continuous_across_the_borders_of_cells() -> None:
    step = 1 / 32
    for x_px, y_px, turned in ((-40.0, -50.3, False), (-400.0, 0.0, False), (-50.3, -40.0, True), (0.0, -400.0, True)):
        shape = (int(600 / step), 1) if turned else (1, int(600 / step))
        line = window(cells_of_noise(), shape, x_px, y_px, step).ravel()
        place = ((y_px if turned else x_px) + step * np.arange(len(line))) % CELL
        slope, bend = np.abs(np.diff(line)) / step, np.abs(np.diff(line, 2)) / step**2
        near = (place < BAND + 1) | (place > CELL - 1)
        assert slope[near[:-1]].max() < 1.5 * slope[~near[:-1]].max()
        assert bend[near[1:-1]].max() < 1.5 * bend[~near[1:-1]].max()  # a jump of slope by 1 would be 32


def test_a_blend_is_twice_continuously_differentiable() -> None:
    blend, h = functools.partial(_blend.py_func, 100.0, 180.0, mean=120.0, coherence=0.0), 1e-3
    assert (blend(0.0), blend(1.0)) == (100.0, 180.0)
    for end, inward in ((0.0, h), (1.0, -h)):
        values = np.array([blend(end + k * inward) for k in range(3)])
        assert abs(values[1] - values[0]) / h < 1e-2
        assert abs(values[2] - 2 * values[1] + values[0]) / h**2 < 10  # of a bend of 5.8 · 80 inside


@pytest.mark.parametrize(("coherence", "deviation"), [(0.0, 1.0), (1.0, 0.885)])
def test_the_contrast_of_bands_is_that_of_cells(coherence: float, deviation: float) -> None:
    """Blended without regard for it (coherence 1), a band has √∫w² + (1 - w)² = √(362/462) of it."""
    surface = scattered(noise(1024), 4, cell_px=CELL, band_px=BAND)
    scatter = surface.scatter
    assert scatter is not None
    surface = replace(
        surface,
        scatter=replace(scatter, x=scatter.x._replace(coherence=coherence), y=scatter.y._replace(coherence=coherence)),
    )
    side = 16 * CELL
    seen = window(surface, (side, side), 0, 0)
    x = np.arange(side) % CELL
    inside, crossing = x >= BAND, x < BAND
    cell = seen[np.ix_(inside, inside)]
    for rows, columns, power in ((inside, crossing, 1), (crossing, inside, 1), (crossing, crossing, 2)):
        band = seen[np.ix_(rows, columns)]
        assert band.std() / cell.std() == pytest.approx(deviation**power, abs=0.04)
        assert band.mean() == pytest.approx(cell.mean(), abs=2)
    along = np.diff(seen, axis=0)
    ratio = along[np.ix_(inside[:-1], crossing)].std() / along[np.ix_(inside[:-1], inside)].std()
    assert ratio == pytest.approx(deviation, abs=0.04)


@pytest.mark.parametrize("heading", [0.0, 0.7])
def test_a4_no_render_bias_where_four_cells_meet(heading: float) -> None:
    surface = surface_from_image(paper_picture(), arrange="scatter", seed=5)
    way = -W * np.array([np.cos(heading), np.sin(heading), 0])
    at = np.array([3 * 256 * W, 256 * W, heading])
    frames = [see(surface, tuple(at + shift * way), 256).astype(float) for shift in FRACTIONS]
    errors = [quintic_shift_error(frames[0], frame, d) for frame, d in zip(frames, FRACTIONS, strict=True)]
    assert abs(s_curve(errors)) <= 0.8e-3
    assert np.max(np.abs(errors)) <= 0.8e-3


def test_the_same_seed_gives_the_same_ground_and_another_one_other_cells() -> None:
    a, b, c = (window(scattered(noise(), seed, cell_px=CELL), (300, 300), -5, -5) for seed in (1, 1, 2))
    assert np.array_equal(a, b)
    assert np.mean(np.abs(a - c) > 5) > 0.5


def test_a_coarser_copy_shows_the_same_ground() -> None:
    """Half as many texels a metre, the same scatter: the same cells at the same places."""
    y, x = np.mgrid[:256, :256] * 2 * np.pi / 256
    scene = 120 + 40 * np.cos(9 * x - 4 * y) + 20 * np.cos(7 * y + 1) + 30 * np.cos(2 * x + 11 * y)
    fine = scattered(surface_from_periodic(scene, psf_sigma_px=0), 3, cell_px=CELL, band_px=BAND)
    coarse_spline = scipy.ndimage.spline_filter(scene, order=3, mode="grid-wrap")
    wrapped = np.pad(coarse_spline, (1, WRAP - 1), mode="wrap").astype(np.float32)
    by_texels = replace(fine, coefficients=wrapped, texels_per_px=1)
    by_pixels = replace(fine, coefficients=wrapped, metres_per_px=2 * fine.metres_per_px)
    ours = see(fine, (10.3, -7.1, 0.4))
    np.testing.assert_allclose(see(by_texels, (10.3, -7.1, 0.4)), ours, atol=0.02)
    np.testing.assert_allclose(see(by_pixels, (10.3, -7.1, 0.4)), ours, atol=0.02)


def test_scatters_refuse_cells_that_cannot_be_laid() -> None:
    good = CellAxis(1.0, 0.1, 0.01)
    for bad in (
        good._replace(band_m=1.0),
        good._replace(band_m=0.0),
        good._replace(choices=OFFSETS + 1),
        good._replace(choices=0),
        good._replace(coherence=1.5),
    ):
        with pytest.raises(ValueError, match="cells along y"):
            Scatter(0, good, bad, 100.0)


# ------------------------------------------------------------------------------- from pictures


def test_cells_cut_out_of_a_picture_never_show_its_border() -> None:
    """Of a ramp, so steep that a border inside a cell would be a jump by 255."""
    ramp = np.tile(np.linspace(0, 255, 256), (256, 1))
    for picture in (ramp, ramp.T):
        surface = surface_from_image(picture, arrange="scatter")
        seen = window(surface, (1500, 1500), -700, -700)
        assert seen.max() - seen.min() > 200
        assert max(np.abs(np.diff(seen, axis=axis)).max() for axis in (0, 1)) < 80


def test_the_spline_of_a_scattered_picture_is_that_of_the_mirrored_one() -> None:
    picture = paper_picture()
    mirrored, cut = surface_from_image(picture), surface_from_image(picture, arrange="scatter")
    off = window(replace(cut, scatter=None), (500, 500), 6.25, 6.25) - window(mirrored, (500, 500), 6, 6)
    assert np.sqrt(np.mean(off**2)) < 0.03  # a cubic spline's error between its knots
    assert np.abs(off).max() < 0.5


def test_flattening_subtracts_a_gaussian() -> None:
    picture = paper_picture("h_01")
    expected = picture - scipy.ndimage.gaussian_filter(picture, 48, mode="reflect", truncate=6) + picture.mean()
    flat, wanted = surface_from_image(picture, flatten_px=48), surface_from_image(expected)
    np.testing.assert_allclose(window(flat, (400, 400), 0, 0), window(wanted, (400, 400), 0, 0), atol=0.01)
    with pytest.raises(ValueError, match="flatten_px 0"):
        surface_from_image(picture, flatten_px=0)


@pytest.mark.parametrize("path", ["ground_textures/grass.png", "drone_nadir_caliterra_a/full_size"])
def test_any_picture_becomes_endless_ground(path: str) -> None:
    found = RECORDINGS / path
    picture = cv2.imread(str(found if found.is_file() else min(found.iterdir())), cv2.IMREAD_GRAYSCALE)
    surface = surface_from_image(picture, arrange="scatter", flatten_px=64, metres_per_px=0.01)
    seen = window(surface, (700, 3000), -9000, 4000)
    contrast = gradient_rms(picture.astype(float))
    assert gradient_rms(seen) == pytest.approx(contrast, rel=0.25)  # the point-spread function takes some


def test_pictures_too_small_or_too_large_are_refused_with_a_cure() -> None:
    with pytest.raises(ValueError, match=r"too small to scatter.*at least 64 px"):
        surface_from_image(np.ones((300, 63)), arrange="scatter")
    with pytest.raises(ValueError, match="too small to mirror"):
        surface_from_image(np.ones((4, 4)))
    with pytest.raises(ValueError, match='take arrange="scatter"'):
        surface_from_image(np.ones((3000, 4000), dtype=np.uint8))
    with pytest.raises(ValueError, match="no arrangement 'tile'"):
        surface_from_image(np.ones((99, 99)), arrange="tile")


# ------------------------------------------------------------------------------------ families


@pytest.mark.parametrize("name", FAMILIES)
def test_families_are_seeded_and_have_the_difficulty_that_was_asked_for(name: str) -> None:
    family, plain = FAMILIES[name], functools.partial(ground, name, size_px=256, scatter=False)
    surface = plain(seed=1)
    assert np.array_equal(surface.coefficients, plain(seed=1).coefficients)
    assert not np.array_equal(surface.coefficients, plain(seed=2).coefficients)
    seen = window(surface, (256, 256), 0, 0)
    assert gradient_rms(seen) == pytest.approx(family.contrast, rel=0.05)
    assert spectral_slope(seen) == pytest.approx(family.spectrum, abs=0.08)
    assert seen.mean() == pytest.approx(family.mean_grey, abs=1)
    assert np.mean((seen < 0) | (seen > 255)) < 0.05
    other = window(plain(seed=1, contrast=6.0, spectrum=0.9), (256, 256), 0, 0)
    assert gradient_rms(other) == pytest.approx(6.0, rel=0.05)
    assert spectral_slope(other) == pytest.approx(0.9, abs=0.08)


def test_a_measured_slope_is_that_of_a_known_spectrum() -> None:
    frequency = np.hypot(np.fft.fftfreq(512)[:, None], np.fft.rfftfreq(512))
    frequency[0, 0] = np.inf
    white = np.fft.rfft2(np.random.default_rng(0).standard_normal((512, 512)))
    for beta in (0.0, 0.8, 1.7):
        assert spectral_slope(np.fft.irfft2(white * frequency**-beta)) == pytest.approx(beta, abs=0.05)
    x = np.tile(np.arange(64.0), (64, 1))
    assert gradient_rms(5 * x) == pytest.approx(5 / 2**0.5)


@pytest.mark.parametrize("name", FAMILIES)
@pytest.mark.parametrize("share", [0.0, 0.4, 0.8])
def test_repetition_is_the_share_that_correlates_a_whole_period_away(name: str, share: float) -> None:
    """Far away, so that other cells are seen; between the bands, whose normalisation is another matter."""
    surface, (rows, columns) = ground_of(name, repetition=share), FAMILIES[name].period_px
    here = window(surface, (512, 512), 0, 0)
    r = []
    for k in (31, 47, 64, 81, 100, 126):  # whole periods, also of rows laid in a running bond
        there = window(surface, (512, 512), 0 if name == "wood" else 2 * k * columns, 2 * k * rows)
        r.append(np.corrcoef(here.ravel(), there.ravel())[0, 1])
    assert np.mean(r) == pytest.approx(share, abs=0.12)


def test_what_repeats_altogether_is_strictly_periodic() -> None:
    surface = ground("gravel", size_px=256, repetition=1.0)
    assert surface.scatter is None
    assert surface.period_m == pytest.approx((128 * W, 128 * W))
    assert gradient_rms(window(surface, (256, 256), 0, 0)) == pytest.approx(8.3, rel=0.03)


@pytest.mark.parametrize("name", ["gravel", "soil", "wood"])
def test_families_do_not_repeat_themselves(name: str) -> None:
    strip = window(ground_of(name), (16, 12288), 100, 40)
    fine = strip - scipy.ndimage.uniform_filter1d(strip, 65, axis=1)
    assert second_peak(fine) < 0.25


def test_joints_of_pavers_stay_in_line_and_pavers_differ() -> None:
    surface, (rows, columns) = ground_of("street"), PAVER_PX
    street = window(surface, (64 * rows, 2 * columns), 40 * columns, -32 * rows).reshape(64, rows, 2 * columns)
    lines = street.mean(axis=2)
    assert np.all(lines[:, 1:7].max(axis=1) < lines[:, 16:120].min(axis=1))
    faces = [street[k, 20:110, 20 + k % 2 * columns // 2 :][:, :200] for k in range(64)]
    joints = [street[k, 30:100, (k % 2 * columns // 2) + 1 :][:, :6].mean() for k in range(64)]
    assert max(joints) < min(face.mean() for face in faces)  # every other row starts half a paver later
    r = [np.corrcoef(faces[0].ravel(), face.ravel())[0, 1] for face in faces[1:]]
    assert np.sort(np.abs(r))[: len(r) // 2].max() < 0.3


def test_families_are_as_hard_to_match_as_the_papers_frames() -> None:
    rate = {name: false_peaks(ground_of(name), (9, 31), pairs=5).tolist() for name in FAMILIES}
    for easy in ("gravel", "grass", "soil"):
        assert rate[easy] == [0, 0]
    for middle in ("concrete", "sand"):
        assert rate[middle][0] < 0.05
    for hard in ("mud", "street"):
        assert 0.03 < rate[hard][0] < 0.45
        assert rate[hard][1] < 0.05
    for hardest in ("wood", "metal"):
        assert rate[hardest][0] > 0.45
    assert rate["wood"][1] < 0.1
    assert rate["metal"][1] > 0.05


def test_grounds_refuse_what_they_cannot_make() -> None:
    with pytest.raises(ValueError, match="no ground 'lava': there are gravel, wood, grass"):
        ground("lava")
    with pytest.raises(ValueError, match="multiple of 256"):
        ground("sand", size_px=300)
    for setting in ({"contrast": 0.0}, {"repetition": 1.1}, {"spectrum": -1.0}):
        with pytest.raises(ValueError, match="are needed"):
            ground("sand", **setting)
