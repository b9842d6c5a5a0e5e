"""Smoothing a whole mission: against scipy's least squares, against the smoother of one landmark, and in groups."""

import numpy as np
import pytest
from plain_range_filter import derivative
from scipy.optimize import least_squares
from test_range_filter import CAMERA, CENTRE, FOCAL, OBLIQUE, WALL, ahead, drive, turning

from pipelines.ranging import mission_smoother, smoother
from pipelines.ranging.ego_motion import arc
from pipelines.ranging.joint import Joint
from pipelines.ranging.mission_smoother import MissionLog, Watched, group_size, smoothed
from pipelines.ranging.range_filter import RangeFilter
from pipelines.ranging.range_settings import RangeSettings
from pipelines.ranging.smoother import Drive, Lives
from pipelines.ranging.start import Start
from readers.streams import TrackSample

MODEL = RangeSettings(**CAMERA).kernel_model
NOISE = {"sigma_omega": 1e-3, "sigma_speed": 0.02}


def carried(state, omega, velocity, dt):
    """A state after an interval, by the point itself in the camera's axes."""
    point = np.array([(state[0] - CENTRE[0]) / FOCAL, (state[1] - CENTRE[1]) / FOCAL, 1.0]) / state[2]
    way = arc(omega, velocity, dt)
    x, y, z = way.turn @ point - way.shift_m
    return np.array([CENTRE[0] + FOCAL * x / z, CENTRE[1] + FOCAL * y / z, 1 / z])


def test_lives_that_come_and_go_are_scipys_minimum() -> None:
    """Two intervals to a frame, a camera that moves any way, three lives in two slots."""
    rng, frames, c = np.random.default_rng(1), 7, 3
    m = 2 * (frames - 1)
    way = Drive(
        dt=rng.uniform(0.05, 0.15, m),
        omega=0.05 * rng.standard_normal((m, 3)),
        velocity=np.array([0.1, 0.05, 0.6]) + 0.05 * rng.standard_normal((m, 3)),
        columns=rng.standard_normal((6, c)),
        q=np.tile([1e-4, 2e-4, 0.0], (m, 1)),
        upto=2 * np.arange(frames),
        aligned=False,
    )
    slot, born, last = np.array([0, 1, 0]), np.array([0, 1, 4]), np.array([3, 6, 6])
    starts = np.array([[400.0, 300.0, 0.12], [250.0, 200.0, 0.2], [300.0, 340.0, 0.15]])
    sigma = np.array([1.0, 1.0, 0.03])
    pixel, variance = np.full((frames, 2, 2), np.nan), np.full((frames, 2), 0.25)
    q_of = np.sqrt(way.q[:, :2])

    def paths(v):
        error = np.column_stack([q_of * v[9:].reshape(m, 2), np.zeros(m)])
        found = []
        for b in range(3):
            states = [starts[b] + sigma * v[3 * b : 3 * b + 3]]
            for f in range(born[b] + 1, last[b] + 1):
                state = states[-1]
                for k in (2 * f - 2, 2 * f - 1):
                    off = way.columns @ error[k]
                    state = carried(state, way.omega[k] - off[:3], way.velocity[k] - off[3:], way.dt[k])
                states.append(state)
            found.append(np.array(states))
        return found

    truth = paths(rng.standard_normal(9 + 2 * m))
    for b in range(3):
        for f in range(born[b] + 1, last[b] + 1):
            if (b, f) != (1, 3):
                pixel[f, slot[b]] = truth[b][f - born[b], :2] + 0.5 * rng.standard_normal(2)

    def residual(v):
        told = [(path[1:, :2] - pixel[born[b] + 1 : last[b] + 1, slot[b]]) / 0.5 for b, path in enumerate(paths(v))]
        off = np.concatenate([one.ravel() for one in told])
        return np.concatenate([v, off[np.isfinite(off)]])

    best = least_squares(residual, np.zeros(9 + 2 * m), xtol=1e-15, ftol=1e-15, gtol=1e-12, jac="3-point")
    lives = Lives(
        slot=slot,
        born=born,
        last=last,
        mean=starts,
        covariance=np.tile(np.diag(sigma**2), (3, 1, 1)),
        pixel=pixel,
        variance=variance,
    )
    found = smoother.most_probable(MODEL, way, lives, starts, tolerance=1e-12)
    assert found.converged
    assert found.cost == pytest.approx(2 * best.cost, rel=1e-8)
    assert np.isnan(found.mean[0, 1]).all()  # not born yet
    np.testing.assert_array_equal(found.input_error[:, 2], 0)
    unknown = np.linalg.inv(best.jac.T @ best.jac)
    for b, path in enumerate(paths(best.x)):
        np.testing.assert_allclose(found.mean[born[b] : last[b] + 1, slot[b]], path, rtol=2e-5)
        for f in (born[b], last[b]):
            along = derivative(lambda v, b=b, f=f: paths(v)[b][f - born[b]], best.x, [1e-5] * len(best.x))
            np.testing.assert_allclose(found.covariance[f, slot[b]], along @ unknown @ along.T, rtol=1e-3, atol=1e-7)
    first, error = smoother.start_about(MODEL, way, lives, found.mean)
    again = smoother.most_probable(MODEL, way, lives, first, error, tolerance=1e-12)
    assert again.cost == pytest.approx(found.cost, rel=1e-9)
    assert again.iterations <= found.iterations


def watched(settings: RangeSettings, samples) -> tuple[MissionLog, list]:
    log = MissionLog()
    estimator = Watched(RangeFilter(settings), log)
    state, steps = estimator.start(), []
    for sample in samples:
        state, step = estimator.step(state, sample)
        steps += [] if step is None else [step]
    return log, steps


def only(group_of) -> mission_smoother.Group:
    (group,) = group_of
    return group


@pytest.mark.parametrize("motion", ["aligned", "planar"])
def test_a_landmark_at_low_speed_is_the_bars(motion: str) -> None:
    """V 0.1 m/s, 0.02 px, 25 s: `test_bar_low_speed` holds `smooth` to its bar of 2.1 %; this is the same."""
    settings = RangeSettings(
        **CAMERA, sigma_omega=1e-3, sigma_speed=0.01, tracks={"sigma_px": 0.02}, motion=motion, max_landmarks=1,
        start="range", start_range_m=11.0, start_sigma_m=5.67, zero_velocity_update=False,
    )  # fmt: skip
    made = drive(settings, WALL[:1], turning(250), ahead(250, 0.1), every=1, noise_px=0.02, sigma_omega=1e-3,
                 sigma_speed=0.01, seed=4)  # fmt: skip
    log, steps = watched(settings, made.samples)
    ended = only(smoothed(settings, log))
    (one,) = ended.lives
    way = log.drive(settings)
    pixel = np.array([s.points_px for s in made.samples if isinstance(s, TrackSample)])
    start = Start(steps[0].mean[0], steps[0].covariance[0])
    expected = smoother.smooth(
        settings.kernel_model,
        Joint.of([start]),
        way.omega[:, 1],
        way.velocity[:, 2],
        way.dt,
        pixel[1:],
        np.array([4e-4]),
    )
    assert ended.converged
    np.testing.assert_allclose(one.mean, expected.mean[:, 0], rtol=1e-5)
    np.testing.assert_allclose(one.covariance, expected.covariance[:, 0], rtol=1e-4, atol=1e-9)
    assert abs(1 / one.mean[-1, 2] / (1 / made.truth[-1][0, 2]) - 1) < 3 * 0.0202


@pytest.mark.parametrize("mode", ["independent", "joint"])
def test_an_oblique_camera_is_consistent_and_better_than_the_filter(mode: str) -> None:
    """Weaving with a camera that is turned, pitched and away from the turning point; NEES over all frames and runs."""
    settings = RangeSettings(
        **CAMERA, **OBLIQUE, **NOISE, mode=mode, max_landmarks=8, start="range", start_range_m=8.0, start_sigma_m=1.5
    )
    rng, nees, mine, filters = np.random.default_rng(2), [], [], []
    for seed in range(8):
        depth = 1.0 / (1 / 8 + 1.5 / 64 * np.clip(rng.standard_normal(6), -2, 2))
        points = np.column_stack([rng.uniform(-0.25, 0.25, (6, 2)), np.ones(6)]) * depth[:, None]
        made = drive(settings, points, turning(50, 0.1 * np.sin(0.3 * np.arange(50))), ahead(50), noise_px=0.5,
                     **NOISE, seed=seed)  # fmt: skip
        log, _ = watched(settings, made.samples)
        group = only(smoothed(settings, log))
        assert group.converged
        assert not group.left_out
        for one in group.lives:
            truth = np.array([state[one.life.number] for state in made.truth])[one.life.born :][: len(one.mean)]
            error = one.mean - truth
            nees += np.einsum("ni,nij,nj->n", error, np.linalg.inv(one.covariance), error).tolist()
            filtered = np.array(one.life.path).reshape(-1, 3)[: len(truth)]
            mine += (truth[:, 2] / one.mean[:, 2] - 1).tolist()
            filters += (truth[:, 2] / filtered[:, 2] - 1).tolist()
    assert np.mean(nees) == pytest.approx(3.0, abs=1.8)  # 3 σ: the speeds' errors are shared by all of a run
    assert np.median(np.abs(mine)) < 0.85 * np.median(np.abs(filters))


def test_lives_end_with_resets_losses_and_rejections_are_not_used() -> None:
    settings = RangeSettings(
        **CAMERA, max_landmarks=3, keep_unseen_s=0.5, start="range", start_range_m=8.0, start_sigma_m=2.0,
        zero_velocity_update=False,
    )  # fmt: skip
    made = drive(settings, WALL[:3], turning(80), ahead(80), noise_px=0.1, seed=3)
    samples, frame = [], 0
    for sample in made.samples:
        if isinstance(sample, TrackSample):
            points, ids = sample.points_px.copy(), sample.ids
            points[0] += 200.0 * (frame == 5)  # one blunder
            points[1] += [60.0, 0.0] if frame >= 15 else 0.0  # the track slips to another point
            kept = np.array([True, True, not 10 <= frame < 20])  # lost, and found again
            frame += 1
            sample = TrackSample(stream="tracks", t_ns=sample.t_ns, received_ns=sample.t_ns, ids=ids[kept],
                                 points_px=points[kept])  # fmt: skip
        samples.append(sample)
    log, _ = watched(settings, samples)
    lives = sorted((life.number, life.born, life.at[-1]) for life in log.lives if life.at)
    assert {(0, 0, 40), (1, 0, 14), (2, 0, 9), (2, 20, 40)} <= set(lives)
    assert (1, 17) in {life[:2] for life in lives}
    assert not any(slot == 0 and born == 5 for slot, born, _ in lives)
    assert 5 not in next(life for life in log.lives if life.number == 0).at
    group = only(smoothed(settings, log))
    for one in group.lives:
        if one.life.number != 1 or one.life.born == 0:
            truth = made.truth[one.life.at[-1]][one.life.number, 2]
            assert one.mean[-1, 2] == pytest.approx(truth, abs=4 * one.covariance[-1, 2, 2] ** 0.5)


def test_groups_keep_to_the_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    settings = RangeSettings(**CAMERA, max_landmarks=5, start="range", start_range_m=8.0, start_sigma_m=1.0)
    made = drive(settings, WALL, turning(20), ahead(20), noise_px=0.1, **NOISE)
    log, _ = watched(settings, made.samples)
    together = only(smoothed(settings, log))
    assert len(together.lives) == 5
    need = smoother.memory_bytes(len(log.frame), len(log.drive(settings).dt), 2, 2)
    monkeypatch.setattr(mission_smoother, "MEMORY_BYTES", need)
    assert group_size(len(log.frame), len(log.drive(settings).dt), 2) == 2
    groups = list(smoothed(settings, log))
    assert [len(group.lives) for group in groups] == [2, 2, 1]
    for group in groups:  # apart they know the speeds less well
        for one in group.lives:
            other = next(life for life in together.lives if life.life is one.life)
            assert other.covariance[-1, 2, 2] <= one.covariance[-1, 2, 2] * (1 + 1e-9)


def test_nothing_to_smooth_and_landmarks_that_are_not_independent() -> None:
    assert list(smoothed(RangeSettings(**CAMERA), MissionLog())) == []
    start = Joint.of([Start(np.array([400.0, 300.0, 0.1]), np.eye(3))] * 2)
    start.covariance[0, 3] = start.covariance[3, 0] = 0.1
    with pytest.raises(ValueError, match="must be independent"):
        smoother.smooth(MODEL, start, *np.ones((3, 2)), np.full((2, 2, 2), np.nan), np.ones(2))
