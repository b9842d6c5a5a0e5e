"""Scale estimators: exact without noise, unbiased with it, and their σ is that of their errors."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from pipelines.semidirect import scale as sc

TRUE = 1.37
RUNS = 300


def consistent(estimates) -> None:
    """Mean error below 0.2 σ, and mean squared error over σ² within its 99.9 % bounds."""
    z = np.array([(e.metres - TRUE) / e.sigma for e in estimates])
    assert abs(z.mean()) < 0.2, z.mean()
    low, high = chi2.ppf([0.0005, 0.9995], RUNS) / RUNS
    # σ is enlarged by a bad χ², never made smaller: on average a little too large
    assert 0.75 * low < np.mean(z**2) < high, np.mean(z**2)


def test_ratio_is_the_least_of_its_cost_and_exact_without_noise() -> None:
    m, one = np.array([1.0, 2.0, 0.5]), np.ones(3)
    found = sc.ratio(sc.ScaleSource.HEIGHT, TRUE * m, 0.01 * one, m, 0.02 * one)
    assert (found.metres, found.chi2) == pytest.approx((TRUE, 0.0), abs=1e-6)
    assert found.source == "height"
    one_length = sc.ratio(sc.ScaleSource.HEIGHT, 3.0, 0.3, 2.0, 0.0)
    assert (one_length.metres, one_length.sigma) == pytest.approx((1.5, 0.15), rel=1e-6)
    # errors on the metric side only: the plain regression
    length, sl = np.array([1.3, 2.9, 0.7]), np.array([0.1, 0.2, 0.05])
    found = sc.ratio(sc.ScaleSource.HEIGHT, length, sl, m, 0 * one)
    w = m / sl**2
    assert found.metres == pytest.approx((w @ length) / (w @ m), rel=1e-6)
    # on the map's side only: the inverse of the regression the other way round
    found = sc.ratio(sc.ScaleSource.HEIGHT, length, 0 * one, m, sl)
    w = length / sl**2
    assert found.metres == pytest.approx((w @ length) / (w @ m), rel=1e-6)


def test_ratio_is_not_drawn_towards_zero() -> None:
    rng = np.random.default_rng(1)
    found, plain = [], []
    for _ in range(RUNS):
        true = rng.uniform(0.3, 1.5, 40)
        m, length = true + 0.15 * rng.standard_normal(40), TRUE * true + 0.1 * rng.standard_normal(40)
        found.append(sc.ratio(sc.ScaleSource.SPEED, length, np.full(40, 0.1), m, np.full(40, 0.15)))
        plain.append((length @ m) / (m @ m))
    consistent(found)
    assert np.mean(plain) < 0.98 * TRUE  # what a plain regression would say


def test_sigma_grows_where_the_lengths_disagree() -> None:
    rng = np.random.default_rng(2)
    m = rng.uniform(0.5, 1.5, 60)
    length = TRUE * m + 0.1 * rng.standard_normal(60)
    honest, bold = (sc.ratio(sc.ScaleSource.HEIGHT, length, np.full(60, s), m, np.zeros(60)) for s in (0.1, 0.01))
    assert bold.sigma == pytest.approx(honest.sigma, rel=0.25)
    assert bold.chi2 > 30 * 60
    assert 30 < honest.chi2 < 100


def test_plane_and_its_sigma() -> None:
    rng = np.random.default_rng(3)
    normal = np.array([0.1, -0.2, 1.0]) / np.linalg.norm([0.1, -0.2, 1.0])
    z, tilts = [], []
    for run in range(RUNS):
        rays = np.column_stack([rng.uniform(0.1, 0.9, 60), rng.uniform(-0.5, 0.5, 60), np.ones(60)])
        points = rays * (1.5 / (rays @ normal))[:, None]
        exact = points.copy()
        points = points + 0.01 * rng.standard_normal(60)[:, None] * normal
        points[:6] *= rng.uniform(0.3, 0.8, 6)[:, None]  # things that stand on the floor
        fit = sc.plane_of(points)
        z.append((fit.distance - 1.5) / fit.sigma)
        tilts.append(np.arccos(min(fit.normal @ normal, 1.0)))
        if run == 0:
            clean = sc.plane_of(exact)
            assert clean.distance == pytest.approx(1.5, abs=1e-12)
            np.testing.assert_allclose(clean.normal, normal, atol=1e-12)
    assert abs(np.mean(z)) < 0.2
    assert 0.8 < np.std(z) < 1.35
    assert np.max(tilts) < 0.03


def test_height_and_range() -> None:
    rng = np.random.default_rng(4)
    beam = np.array([0.1, 0.05, 1.0]) / np.linalg.norm([0.1, 0.05, 1.0])
    sensor = np.array([0.08, -0.03, 0.05])
    heights, ranges = [], []
    for _ in range(RUNS):
        d_m = rng.uniform(1.2, 2.0, 20)
        normal = np.array([0, 0, 1.0]) + 0.1 * rng.standard_normal((20, 3))
        normal /= np.linalg.norm(normal, axis=1)[:, None]
        range_m = (d_m - normal @ sensor) / (normal @ beam)
        distance = d_m / TRUE + 0.01 * rng.standard_normal(20)
        noise, sd = 0.03 * rng.standard_normal(20), np.full(20, 0.01)
        heights.append(sc.from_height(d_m + noise, np.full(20, 0.03), distance, sd))
        ranges.append(sc.from_range(range_m + noise, np.full(20, 0.03), beam, sensor, normal, distance, sd))
    consistent(heights)
    consistent(ranges)
    exact = sc.from_range(range_m, np.full(20, 0.01), beam, sensor, normal, d_m / TRUE, sd)
    assert exact.metres == pytest.approx(TRUE, abs=1e-6)
    assert exact.source == "range"
    with pytest.raises(ValueError, match="beam does not meet"):
        sc.from_range(range_m, noise, -beam, sensor, normal, distance, sd)


def test_speed() -> None:
    rng = np.random.default_rng(5)
    found = []
    for _ in range(RUNS):
        speed, dt = rng.uniform(0.5, 2.0, 50), np.full(50, 0.2)
        way = rng.standard_normal((50, 3))
        way *= (speed * dt / TRUE / np.linalg.norm(way, axis=1))[:, None]
        shown = way + 0.02 * rng.standard_normal((50, 3))
        measured = speed + 0.05 * rng.standard_normal(50)
        found.append(sc.from_speed(measured, np.full(50, 0.05), dt, shown, np.full(50, 0.02)))
    consistent(found)
    with pytest.raises(ValueError, match="sort the samples"):
        sc.from_speed(speed, measured, -dt, shown, speed)


def test_reference_in_other_axes() -> None:
    rng = np.random.default_rng(6)
    found = []
    for run in range(RUNS):
        true = np.cumsum(rng.standard_normal((40, 3)) * [1, 1, 0.1], axis=0)
        turn = Rotation.from_quat(rng.standard_normal(4)).as_matrix()
        shown = true / TRUE @ turn.T + [3.0, -1.0, 2.0]
        if run == 0:
            assert sc.from_reference(true, 0.01, shown, 0.01).metres == pytest.approx(TRUE, abs=1e-6)
        shown = shown + 0.03 * rng.standard_normal((40, 3))
        measured = true + 0.05 * rng.standard_normal((40, 3))
        found.append(sc.from_reference(measured, 0.05, shown, 0.03))
    consistent(found)
    with pytest.raises(ValueError, match="has not moved"):
        sc.from_reference(true, 0.1, np.ones((40, 3)), 0.1)


def test_bad_calls_are_named() -> None:
    one = np.ones(3)
    for metric, sigma, match in [(one, 0 * one, "positive σ"), (one * np.nan, one, "finite"), (-one, one, "sign")]:
        with pytest.raises(ValueError, match=match):
            sc.ratio(sc.ScaleSource.SPEED, metric, sigma, one, 0 * one)
    with pytest.raises(ValueError, match="one shape"):
        sc.ratio(sc.ScaleSource.SPEED, one, one, one[:2], one)
    with pytest.raises(ValueError, match="at least 4"):
        sc.plane_of(np.ones((3, 3)))
    with pytest.raises(ValueError, match="on a line"):
        sc.plane_of(np.arange(10.0)[:, None] * np.ones(3))
