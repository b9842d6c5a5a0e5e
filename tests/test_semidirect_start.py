"""The start from two views: exact without noise, within stated bounds with it, refused where there is no depth."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipelines.semidirect import start as st

F = 420.0


def unit(v):
    return np.asarray(v, float) / np.linalg.norm(v)


def flat(points):
    return points[:, :2] / points[:, 2:]


def scene(seed, *, relief=0.0, n=150, tilt=0.12, step=None, turn=None):
    """Points of a plane 1.5 m ahead (with relief in m), seen from two places; truth R, t, n, d, points."""
    rng = np.random.default_rng(seed)
    normal, distance = unit([tilt * rng.standard_normal(), tilt * rng.standard_normal(), 1.0]), 1.5
    rays = np.column_stack([rng.uniform(-0.8, 0.8, n), rng.uniform(-0.5, 0.5, n), np.ones(n)])
    points = rays * ((distance + relief * rng.standard_normal(n)) / (rays @ normal))[:, None]
    rotation = Rotation.from_rotvec(0.06 * rng.standard_normal(3) if turn is None else turn).as_matrix()
    translation = np.asarray(rng.uniform(-1, 1, 3) * [0.1, 0.2, 0.1] + [0.35, 0, 0] if step is None else step, float)
    return rotation, translation, normal, distance, points, flat(points), flat(points @ rotation.T + translation)


LOW = st.StartLimits(least_motion_px=20.0)


@pytest.mark.parametrize("seed", range(8))
def test_plane_is_exact_without_noise(seed) -> None:
    r, t, n, d, points, x1, x2 = scene(seed)
    found = st.start(x1, x2, F, limits=LOW, model=st.Model.PLANE)
    assert found.outcome == st.StartOutcome.STARTED
    unit_m = np.median(points[:, 2])
    np.testing.assert_allclose(found.rotation, r, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.translation * unit_m, t, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.normal, n, rtol=0, atol=1e-9)
    assert found.distance * unit_m == pytest.approx(d, abs=1e-9)
    np.testing.assert_allclose(found.points * unit_m, points, rtol=0, atol=1e-8)
    assert found.inlier.all()
    assert np.median(found.points[:, 2]) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_space_is_exact_without_noise(seed) -> None:
    r, t, _, _, points, x1, x2 = scene(seed, relief=0.3)
    found = st.start(x1, x2, F, limits=LOW, model=st.Model.SPACE)
    assert found.outcome == st.StartOutcome.STARTED
    unit_m = np.median(points[:, 2])
    np.testing.assert_allclose(found.rotation, r, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.translation * unit_m, t, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.points * unit_m, points, rtol=0, atol=1e-7)


@pytest.mark.parametrize(("relief", "model"), [(0.0, st.Model.PLANE), (0.25, st.Model.SPACE)])
def test_noise_and_outliers(relief, model) -> None:
    """Half a pixel of noise, 20 % wrong matches: turn within 0.6°, direction 2.5°, plane 1°, depths 1.5 %."""
    turns, ways, normals, depths = [], [], [], []
    for seed in range(10):
        r, t, n, _, points, x1, x2 = scene(seed, relief=relief)
        rng = np.random.default_rng(100 + seed)
        wrong = rng.random(len(x1)) < 0.2
        x1, x2 = (x + 0.5 / F * rng.standard_normal(x.shape) for x in (x1, x2))
        x2[wrong] = rng.uniform(-0.6, 0.6, (wrong.sum(), 2))
        found = st.start(x1, x2, F, limits=LOW)
        assert (found.outcome, found.model) == (st.StartOutcome.STARTED, model)
        turns.append(np.degrees(Rotation.from_matrix(found.rotation @ r.T).magnitude()))
        ways.append(np.degrees(np.arccos(min(unit(found.translation) @ unit(t), 1.0))))
        normals.append(np.degrees(np.arccos(min(found.normal @ n, 1.0))))
        unit_m = np.median(points[found.inlier, 2])
        right = found.inlier & ~wrong
        depths.append(np.median(np.abs(found.points[right, 2] * unit_m / points[right, 2] - 1)))
        # wrong matches on their epipolar line by chance stay
        assert found.inlier[wrong].mean() < 0.15
        assert found.inlier[~wrong].mean() > 0.9
    print(f"turn {max(turns):.2f}°, direction {max(ways):.2f}°, normal {np.max(normals):.2f}°, depth {max(depths):.4f}")
    assert max(turns) < 0.6
    assert max(ways) < 2.5
    assert max(depths) < 0.015
    if model == st.Model.PLANE:
        assert max(normals) < 1.0


def test_all_solutions_make_the_homography_and_the_right_one_is_first() -> None:
    r, t, n, d, _, x1, x2 = scene(3)
    h = st.homography(x1, x2)
    truth = r + np.outer(t, n) / d
    np.testing.assert_allclose(h / h[2, 2], truth / truth[2, 2], rtol=0, atol=1e-11)
    candidates = st.decomposed(h, x1, np.array([0, 0, 1.0]))
    assert len(candidates) == 4
    for c in candidates:
        made = c.rotation + np.outer(c.translation, c.normal)
        np.testing.assert_allclose(made / made[2, 2], truth / truth[2, 2], rtol=0, atol=1e-7)
    assert max(c.in_front for c in candidates[2:]) < 0.5
    assert candidates[0].normal @ n > 1 - 1e-9


def test_expected_normal_decides_between_two_solutions() -> None:
    """A camera that climbs aside sees one homography for two planes: the caller's knowledge decides."""
    _, _, n, _, _, x1, x2 = scene(5, step=[0.3, 0.1, 0.6])
    both = [c for c in st.start(x1, x2, F, limits=LOW).candidates if c.in_front == 1.0]
    assert len(both) == 2
    other = min(both, key=lambda c: c.normal @ n).normal
    assert other @ n < 0.99
    for hint in (n, other):
        found = st.start(x1, x2, F, limits=LOW, model=st.Model.PLANE, expected_normal=tuple(hint))
        assert found.normal @ hint > 1 - 1e-9


def test_refusals() -> None:
    _, _, _, _, _, x1, x2 = scene(1)
    assert st.start(x1[:30], x2[:30], F).outcome == st.StartOutcome.FEW_MATCHES
    assert st.start(x1, x1 + 0.01, F).outcome == st.StartOutcome.LITTLE_MOTION
    rng = np.random.default_rng(2)
    scattered = st.start(x1, rng.uniform(-0.6, 0.6, x2.shape), F)
    assert scattered.outcome in {st.StartOutcome.NO_MODEL, st.StartOutcome.FEW_INLIERS}
    assert not scattered.inlier.any()
    for seed in range(6):
        _, _, _, _, _, x1, x2 = scene(seed, relief=0.2, step=[0, 0, 0], turn=[0.02, 0.18, 0.05])
        for sigma in (0.0, 0.3):
            noisy = [x + sigma / F * np.random.default_rng(seed).standard_normal(x.shape) for x in (x1, x2)]
            found = st.start(*noisy, F)
            assert found.outcome != st.StartOutcome.STARTED
            assert np.isnan(found.points).all() == (not found.inlier.any())
    with pytest.raises(ValueError, match="one shape"):
        st.start(x1, x2[:-1], F)
    with pytest.raises(ValueError, match="finite"):
        st.start(x1, x2 * np.nan, F)


def test_same_points_same_start() -> None:
    _, _, _, _, _, x1, x2 = scene(4)
    noisy = x2 + 1e-3 * np.random.default_rng(1).standard_normal(x2.shape)
    one, two = (st.start(x1, noisy, F, limits=LOW) for _ in range(2))
    assert one.points.tobytes() == two.points.tobytes()


def test_triangulation_keeps_only_points_before_both_cameras() -> None:
    r, t, _, _, points, x1, x2 = scene(6, relief=0.2)
    np.testing.assert_allclose(st.triangulated(x1, x2, r, t), points, rtol=0, atol=1e-11)
    assert np.isnan(st.triangulated(x1, x2, r, -t)).all()
