"""The joint filter against dense matrices, the smoother against scipy's least squares, and both against the bars."""

import numpy as np
import pytest
from plain_range_filter import derivative, flow
from scipy.optimize import least_squares

from pipelines.ranging import equations as eq
from pipelines.ranging import joint as jf
from pipelines.ranging import montecarlo as mc
from pipelines.ranging.filter import Inputs, Outcome
from pipelines.ranging.joint import Joint
from pipelines.ranging.settings import FilterSettings
from pipelines.ranging.smoother import smooth
from pipelines.ranging.start import Start

F, CENTRE, DT = 800.0, (320.0, 240.0), 0.1
SETTINGS = FilterSettings(gate="off", reset_after=0, sigma_speed=0.02)
MODEL = SETTINGS.model(F, CENTRE)
FIVE = ((0.8, 0.0, 8.0), (0.4, 0.4, 8.0), (-0.8, 0.8, 10.0), (-1.2, -0.6, 7.0), (0.3, -0.9, 12.0))


def mission(steps: int, points=FIVE[:3], seed: int = 0, r: float = 0.3):
    """A joint start, noisy speeds and image points of a weaving drive, and the true states."""
    rng = np.random.default_rng(seed)
    true = [eq.project(np.array(points), F, CENTRE)]
    omega, speed = 0.1 * np.sin(0.5 * np.arange(steps)), np.full(steps, 0.5)
    for w, v in zip(omega, speed, strict=True):
        true.append(np.array([flow(x, w, v, DT, F, CENTRE) for x in true[-1]]))
    path = np.array(true)
    starts = [Start(x + rng.normal(size=3) * [r, r, 0.01], np.diag([r**2, r**2, 0.02**2])) for x in path[0]]
    pixel = path[1:, :, :2] + rng.normal(0, r, (steps, len(points), 2))
    pixel[rng.random((steps, len(points))) < 0.1] = np.nan
    noisy = omega + rng.normal(0, 1e-3 / DT**0.5, steps), speed + rng.normal(0, 0.02 / DT**0.5, steps)
    return Joint.of(starts), *noisy, pixel, path


def test_joint_step_is_the_dense_form() -> None:
    state, omega, speed, pixel, _ = mission(10)
    n, variance = 3, np.full(3, 0.09)
    Q = np.diag([1e-6, 4e-4]) / DT
    for k in range(10):
        after, update = jf.step(MODEL, state, Inputs(omega[k], speed[k], DT), pixel[k], variance)
        A, G = np.zeros((9, 9)), np.vstack(list(update.noise_gain))
        for i in range(n):
            A[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = update.transition[i]
        prior = A @ state.covariance @ A.T + G @ Q @ G.T
        np.testing.assert_allclose(update.prior_covariance, prior, rtol=1e-9, atol=1e-14)
        seen = np.flatnonzero(np.isfinite(pixel[k, :, 0]))
        rows = (3 * seen[:, None] + np.arange(2)).ravel()
        H = np.eye(9)[rows]
        S = H @ prior @ H.T + 0.09 * np.eye(len(rows))
        nu = (pixel[k, seen] - update.prior[seen, :2]).ravel()
        gain = prior @ H.T @ np.linalg.inv(S)
        np.testing.assert_allclose(after.mean.ravel(), update.prior.ravel() + gain @ nu, rtol=1e-10)
        np.testing.assert_allclose(after.covariance, prior - gain @ H @ prior, rtol=1e-6, atol=1e-11)
        assert update.joint_nis == pytest.approx(nu @ np.linalg.solve(S, nu))
        assert update.joint_degrees == len(rows)
        np.testing.assert_allclose(update.input_error, Q @ G.T @ H.T @ np.linalg.solve(S, nu), rtol=1e-6, atol=1e-12)
        expected = Q - Q @ G.T @ H.T @ np.linalg.solve(S, H @ G @ Q)
        np.testing.assert_allclose(update.input_covariance, expected, rtol=1e-6, atol=1e-12)
        state = after


def test_joint_of_one_is_the_single_filter() -> None:
    scenario = mc.Scenario(runs=20, landmark_m=(0.8, 0.0, 8.0))
    together = mc.run_joint(scenario, [(0.8, 0.0, 8.0)])
    np.testing.assert_allclose(together.mean[:, :, 0], mc.run(scenario).mean, rtol=1e-10, atol=1e-10)


def test_joint_gate_and_reset_leave_the_others_alone() -> None:
    model = FilterSettings(sigma_speed=0.02).model(F, CENTRE)
    state, omega, speed, _, path = mission(8)
    variance, outcomes = np.full(3, 0.09), []
    for k in range(8):
        pixel = path[k + 1, :, :2].copy()
        if k >= 3:
            pixel[1] += 90.0
        state, update = jf.step(model, state, Inputs(omega[k], speed[k], DT), pixel, variance)
        outcomes.append(update.outcome[1])
        assert (update.outcome[[0, 2]] == Outcome.UPDATED).all()
    assert outcomes[3:6] == [Outcome.REJECTED, Outcome.REJECTED, Outcome.RESET]
    assert outcomes[6:] == [Outcome.UPDATED, Outcome.UPDATED]
    np.testing.assert_allclose(state.covariance, state.covariance.T)
    assert np.linalg.eigvalsh(state.covariance).min() > 0


def test_joint_landmarks_come_and_go() -> None:
    state = mission(1)[0]
    more = state.and_also(Start(np.array([1.0, 2.0, 0.3]), 7 * np.eye(3)))
    np.testing.assert_array_equal(more.blocks[3], 7 * np.eye(3))
    less = more.only(np.array([3, 0]))
    np.testing.assert_array_equal(less.mean, more.mean[[3, 0]])
    np.testing.assert_array_equal(less.covariance[3:, 3:], state.covariance[:3, :3])


def test_joint_loses_one_landmark_and_keeps_the_others() -> None:
    state, omega, speed, _, path = mission(4)
    near = state.and_also(Start(np.array([330.0, 250.0, 20.0]), np.diag([1.0, 1.0, 1.0])))
    inputs, variance = Inputs(omega[0], speed[0], DT), np.full(4, 0.09)
    seen = np.vstack([path[1, :, :2], [[340.0, 260.0]]])
    after, update = jf.step(MODEL, near, inputs, seen, variance)
    alone, _ = jf.step(MODEL, state, inputs, seen[:3], variance[:3])
    assert update.outcome.tolist() == [Outcome.UPDATED] * 3 + [Outcome.LOST]
    assert np.isnan(after.mean[3]).all()
    kept = after.only(np.arange(3))
    np.testing.assert_allclose(kept.mean, alone.mean, rtol=1e-12)
    np.testing.assert_allclose(kept.covariance, alone.covariance, rtol=1e-10, atol=1e-14)
    again, update = jf.step(MODEL, after, inputs, np.vstack([path[2, :, :2], [[340.0, 260.0]]]), variance)
    assert update.outcome[3] == Outcome.LOST
    assert np.isfinite(again.mean[:3]).all()
    with pytest.raises(ValueError, match="sort the samples"):
        jf.step(MODEL, state, Inputs(0.0, 0.5, -0.1), seen[:3], variance[:3])


def test_smoother_finds_scipys_minimum_and_its_covariance() -> None:
    steps = 12
    start, omega, speed, pixel, _ = mission(steps, FIVE[:2])
    variance, sigma_q = np.full(2, 0.09), np.array([1e-3, 0.02]) / DT**0.5
    root = np.linalg.cholesky(start.covariance)
    seen = np.isfinite(pixel)

    def path(v):
        states = [start.mean + (root @ v[:6]).reshape(2, 3)]
        for k in range(steps):
            q = sigma_q * v[6 + 2 * k : 8 + 2 * k]
            states.append(np.array([flow(x, omega[k] - q[0], speed[k] - q[1], DT, F, CENTRE) for x in states[-1]]))
        return np.array(states)

    def residual(v):
        return np.concatenate([v, ((path(v)[1:, :, :2] - pixel) / 0.3)[seen]])

    size = 6 + 2 * steps
    best = least_squares(residual, np.zeros(size), xtol=1e-15, ftol=1e-15, gtol=1e-13, jac="3-point")
    found = smooth(MODEL, start, omega, speed, np.full(steps, DT), pixel, variance, tolerance=1e-12)
    assert found.converged
    assert found.cost == pytest.approx(2 * best.cost, rel=1e-9)
    np.testing.assert_allclose(found.mean, path(best.x), rtol=1e-6)
    np.testing.assert_allclose(found.input_error.ravel(), np.tile(sigma_q, steps) * best.x[6:], rtol=1e-3, atol=1e-7)
    jacobian = derivative(residual, best.x, [1e-5] * size)
    unknown = np.linalg.inv(jacobian.T @ jacobian)
    for k in (0, 5, steps):
        for i in range(2):
            along = derivative(lambda v, k=k, i=i: path(v)[k, i], best.x, [1e-5] * size)
            np.testing.assert_allclose(found.covariance[k, i], along @ unknown @ along.T, rtol=2e-4, atol=1e-9)


def test_smoother_at_standstill_and_its_bounds() -> None:
    start, omega, speed, pixel, _ = mission(6)
    still = np.ones(6, np.bool_)
    found = smooth(MODEL, start, omega, speed, np.full(6, DT), pixel, np.full(3, 0.09), still=still)
    np.testing.assert_array_equal(found.input_error[:, 1], 0)
    np.testing.assert_allclose(found.mean[-1, :, 2], found.mean[0, :, 2], rtol=0.02)
    with pytest.raises(ValueError, match="must be positive"):
        smooth(MODEL, start, omega, speed, np.zeros(6), pixel, np.full(3, 0.09))
    with pytest.raises(ValueError, match="landmarks need"):
        smooth(MODEL, start, omega, speed, np.full(6, DT), pixel[:, :2], np.full(3, 0.09))
    with pytest.raises(ValueError, match="farther range"):
        smooth(MODEL, start, omega, np.full(6, 50.0), np.full(6, DT), pixel, np.full(3, 0.09))


# ------------------------------------------------------------------------------------ bars


def test_bar_joint_filter_of_five() -> None:
    for r, bound in ((0.1, 1.45), (0.5, 2.8)):
        scenario = mc.Scenario(pixel_sigma=r, runs=1000)
        found = mc.run_joint(scenario, FIVE)
        rms = 100 * found.rms_relative[-1]
        alone = 100 * mc.run(mc.joint_scenarios(scenario, FIVE)[0]).rms_relative[-1]
        nees = found.nees[:, 20:].mean()
        print(f"r {r}: [.8 0 8] alone {alone:.2f} %, joint of 5 {rms[0]:.2f} % (bar {bound}); NEES/dof {nees:.3f}")
        assert rms[0] <= bound
        assert alone > 8.0
        assert nees == pytest.approx(1.0, abs=0.05)


def test_bar_low_speed() -> None:
    scenario = mc.Scenario(speed=0.1, pixel_sigma=0.02, steps=250, runs=1000)
    plain, lag = mc.run(scenario), mc.run(scenario, scenario.settings(relinearisations=3))
    best, bound = mc.run_smoother(scenario), 100 * mc.cramer_rao(scenario)[-1]
    for name, found in (("EKF", plain), ("lag-1", lag), ("MAP", best)):
        print(
            f"{name}: RMS {100 * found.rms_relative[-1]:.2f} % (CRB {bound:.2f}), "
            f"bias {100 * found.relative_error[:, -1].mean():.2f} %, NEES {found.nees[:, -1].mean():.2f}"
        )
    assert 100 * plain.relative_error[:, -1].mean() == pytest.approx(4.6, abs=0.4)
    assert plain.nees[:, -1].mean() > 8
    assert 100 * lag.rms_relative[-1] <= 2.3
    assert lag.nees[:, -1].mean() <= 3.6
    assert 100 * best.rms_relative[-1] <= 2.1
    assert best.nees[:, -1].mean() == pytest.approx(3.0, abs=0.25)
    assert bound == pytest.approx(2.0, abs=0.02)
