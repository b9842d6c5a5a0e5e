"""The filter's step against the plain form, gate, reset, floor, standstill, bank; starts and their P₀."""

import numpy as np
import pytest
from plain_range_filter import derivative, flow, step
from pydantic import ValidationError
from scipy.optimize import least_squares

from pipelines.ranging import equations as eq
from pipelines.ranging import filter as rf
from pipelines.ranging import start
from pipelines.ranging.bank import Bank
from pipelines.ranging.filter import Inputs, Landmarks, Outcome, Status
from pipelines.ranging.montecarlo import Scenario, run, simulate
from pipelines.ranging.settings import FilterSettings, Flow, GainForm, TransitionForm

F, CENTRE = 800.0, (320.0, 240.0)
SETTINGS = FilterSettings(gate="off", reset_after=0)
Q = np.diag([1e-6, 1e-4])


def landmarks(n: int, seed: int = 0) -> tuple[Landmarks, np.ndarray]:
    """Starts about true points that the camera sees, and those points' states."""
    rng = np.random.default_rng(seed)
    true = eq.project(rng.uniform([-2, -1.5, 4], [2, 1.5, 12], (n, 3)), F, CENTRE)
    starts = []
    for x in true:
        root = rng.normal(size=(3, 3)) * [[2.0], [2.0], [0.02]]
        starts.append(start.Start(x + rng.normal(size=3) * [0.5, 0.5, 0.01], root @ root.T + np.diag([1, 1, 1e-4])))
    return Landmarks.of(starts), true


def drive(n: int, steps: int, seed: int = 0):
    """Noisy inputs and image points of a weaving drive."""
    rng = np.random.default_rng(seed)
    found, true = landmarks(n, seed)
    rows = []
    for k in range(steps):
        omega, speed, dt = 0.2 * np.sin(0.4 * k), 0.5, 0.1
        true = np.array([flow(x, omega, speed, dt, F, CENTRE) for x in true])
        pixel = true[:, :2] + rng.normal(0, 0.5, (n, 2))
        pixel[rng.random(n) < 0.1] = np.nan
        rows.append((Inputs(omega + rng.normal(0, 3e-3), speed + rng.normal(0, 0.03), dt), pixel))
    return found, rows


def test_step_is_the_plain_form() -> None:
    model = SETTINGS.model(F, CENTRE)
    now, rows = drive(7, 12)
    for inputs, pixel in rows:
        after, update = rf.step(model, now, inputs, pixel, 0.25)
        for i in range(len(now)):
            x, P = now.mean[i], now.covariance[i]
            a, g = update.transition[i], update.noise_gain[i]
            ahead, prior, nu, S, K, nis, x1, P1 = step(
                x, P, inputs.omega, inputs.speed, inputs.dt, pixel[i], 0.25 * np.eye(2), Q, F, CENTRE, a, g
            )
            np.testing.assert_allclose(update.prior[i], ahead, rtol=1e-12)
            np.testing.assert_allclose(update.prior_covariance[i], prior, rtol=1e-11, atol=1e-15)
            if np.isnan(pixel[i, 0]):
                assert update.outcome[i] == Outcome.PREDICTED
                assert np.isnan(update.nis[i])
                np.testing.assert_array_equal(update.mean[i], update.prior[i])
                continue
            assert update.outcome[i] == Outcome.UPDATED
            np.testing.assert_allclose(update.innovation[i], nu, atol=1e-10)
            np.testing.assert_allclose(update.innovation_covariance[i], S, rtol=1e-12)
            np.testing.assert_allclose(update.gain[i], K, rtol=1e-9, atol=1e-12)
            assert update.nis[i] == pytest.approx(nis, rel=1e-8)
            np.testing.assert_allclose(update.mean[i], x1, rtol=1e-11)
            np.testing.assert_allclose(update.covariance[i], P1, rtol=1e-8, atol=1e-12)
        np.testing.assert_array_equal(after.mean, update.mean)
        np.testing.assert_array_equal(after.covariance, update.covariance)
        now = after


@pytest.mark.parametrize("relinearisations", [0, 3])
def test_bank_and_runs_are_the_step(relinearisations) -> None:
    model = FilterSettings(relinearisations=relinearisations).model(F, CENTRE)
    now, rows = drive(50, 20, seed=3)
    rows[8][1][:5] += 60.0
    for k in (10, 11, 12):
        rows[k][1][7:12] += 80.0
    bank, variance = Bank(model, now), np.full(50, 0.25)
    seen = set()
    for inputs, pixel in rows:
        now, update = rf.step(model, now, inputs, pixel, variance)
        bank.advance(inputs, np.ascontiguousarray(pixel.T), variance)
        np.testing.assert_allclose(bank.state, now.state, rtol=1e-12)
        np.testing.assert_allclose(bank.nis, update.nis, rtol=1e-12)
        np.testing.assert_array_equal(bank.outcome, update.outcome)
        seen |= set(update.outcome.tolist())
    assert seen == {Outcome.PREDICTED, Outcome.UPDATED, Outcome.REJECTED, Outcome.RESET}
    np.testing.assert_allclose(bank.range_m, update.range_m)
    np.testing.assert_allclose(bank.relative_sigma, update.relative_sigma)


def test_runs_of_the_monte_carlo_are_the_step() -> None:
    scenario = Scenario(runs=3, omega=0.1, centre_px=CENTRE)
    found, data = run(scenario), simulate(scenario)
    model = found.settings.model(scenario.focal_px, CENTRE)
    for i in range(3):
        now = Landmarks.of([start.Start(found.mean[i, 0], found.covariance[i, 0])])
        for k in range(scenario.steps):
            inputs = Inputs(data.omega[i, k], data.speed[i, k], scenario.dt)
            now, update = rf.step(model, now, inputs, data.pixel[i, k + 1 : k + 2], 0.25)
            np.testing.assert_allclose(found.mean[i, k + 1], update.mean[0], rtol=1e-12)
            np.testing.assert_allclose(found.covariance[i, k + 1], update.covariance[0], rtol=1e-11)
            assert found.nis[i, k + 1] == pytest.approx(update.nis[0], rel=1e-11)


def test_a_step_is_pure_and_takes_no_nonsense() -> None:
    model = SETTINGS.model(F, CENTRE)
    now, rows = drive(3, 1)
    before = now.state.copy()
    first = rf.step(model, now, *rows[0], 0.25)[1]
    again = rf.step(model, now, *rows[0], 0.25)[1]
    np.testing.assert_array_equal(now.state, before)
    for a, b in zip(first, again, strict=True):
        np.testing.assert_array_equal(a, b)
    with pytest.raises(ValueError, match="sort the samples"):
        rf.step(model, now, Inputs(0, 0.5, -0.1), rows[0][1], 0.25)
    with pytest.raises(ValueError, match="image points of shape"):
        rf.step(model, now, rows[0][0], rows[0][1][:2], 0.25)
    with pytest.raises(ValueError, match="focal_px"):
        SETTINGS.model(0.0)
    with pytest.raises(ValidationError):
        FilterSettings.model_validate({"gait": 3})


def test_every_form_is_what_it_says() -> None:
    now, rows = drive(1, 1)
    inputs = Inputs(0.3, 0.5, 0.1)
    p, h = eq.Point(*(now.mean[0] - [*CENTRE, 0])), eq.held(*inputs[:3])

    def updated(**forms):
        model = FilterSettings(**forms).model(F, CENTRE)
        return rf.step(model, now, inputs, rows[0][1], 0.25)[1]

    for form, function in ((Flow.EXACT, eq.exact_flow), (Flow.RK4, eq.rk4_flow), (Flow.EULER, eq.euler_flow)):
        np.testing.assert_allclose(updated(flow=form).prior[0] - [*CENTRE, 0], function(p, h, F))
    for form, function in (
        (TransitionForm.EXACT, eq.exact_transition),
        (TransitionForm.FIRST_ORDER, eq.first_order_transition),
        (TransitionForm.AS_PRINTED, eq.transition_as_printed),
    ):
        a = function(p, h, F)
        expected = [[a.xx, 0, a.xk], [a.yx, a.yy, a.yk], [a.kx, 0, a.kk]]
        np.testing.assert_allclose(updated(transition=form).transition[0], expected)
    right, wrong = eq.continuous_noise_gain(p, F, p.u**2), eq.continuous_noise_gain(p, F, (p.u + 2 * CENTRE[0]) ** 2)
    for form, g in (
        (GainForm.EXACT, eq.exact_noise_gain(p, h, F)),
        (GainForm.FIRST_ORDER, eq.times(right, 0.1)),
        (GainForm.WITHOUT_DT, right),
        (GainForm.PLUS_CENTRE, eq.times(wrong, 0.1)),
        (GainForm.AS_PRINTED, wrong),
    ):
        np.testing.assert_allclose(updated(noise_gain=form).noise_gain[0], np.reshape(g, (3, 2)))


def test_relinearised_prediction_is_the_most_probable_interval() -> None:
    """Passes of lag-1 converge to the minimum of ‖s - x̂‖²_P + ‖q‖²_{Q/dt} + ‖z - H Ψ(s, q)‖²_R, found by scipy."""
    model = FilterSettings(gate="off", sigma_speed=0.1, relinearisations=10).model(F, CENTRE)
    dt, omega, speed, r = 0.1, 0.2, 0.8, 0.02
    sigma_q = np.array([1e-3, 0.1]) / np.sqrt(dt)
    root = np.array([[0.5, 0, 0], [0.2, 0.4, 0], [0.01, 0.02, 0.04]])
    x = np.array([520.0, 90.0, 0.3])
    z = np.array([[513.9, 84.1]])

    def ahead(v):
        return flow(x + root @ v[:3], omega - sigma_q[0] * v[3], speed - sigma_q[1] * v[4], dt, F, CENTRE)

    best = least_squares(
        lambda v: np.concatenate([v, (z[0] - ahead(v)[:2]) / r]), np.zeros(5), xtol=1e-14, ftol=1e-14, jac="3-point"
    )
    expected = ahead(best.x)
    now = Landmarks.of([start.Start(x, root @ root.T)])
    found = rf.step(model, now, Inputs(omega, speed, dt), z, r**2)[1].mean[0]
    plain = rf.step(
        FilterSettings(gate="off", sigma_speed=0.1).model(F, CENTRE), now, Inputs(omega, speed, dt), z, r**2
    )
    np.testing.assert_allclose(found, expected, rtol=1e-7)
    assert abs(plain[1].mean[0, 2] / expected[2] - 1) > 1e-4


def one(state=(340.0, 280.0, 0.1), sigma=(0.5, 0.5, 0.01)) -> Landmarks:
    return Landmarks.of([start.Start(np.array(state), np.diag(np.square(sigma)))])


def test_gate_rejects_and_the_third_rejection_resets() -> None:
    model = FilterSettings().model(F, CENTRE)
    now, turning = one(), Inputs(0.001, 0.0, 0.1)
    sigma = now.covariance[0, 2, 2]
    wild = np.array([[400.0, 200.0]])
    for k in range(3):
        now, update = rf.step(model, now, turning, wild, 0.25)
        assert update.nis[0] > 13.8
        assert update.outcome[0] == (Outcome.REJECTED if k < 2 else Outcome.RESET)
        if k < 2:
            assert now.rejections[0] == k + 1
            assert now.turn_rad[0] == pytest.approx(1e-4 * (k + 1))
            np.testing.assert_array_equal(update.mean, update.prior)
            assert rf.statuses(update)[0] == Status.REJECTED
    assert rf.statuses(update)[0] == Status.RESET
    np.testing.assert_allclose(now.mean[0], [400.0, 200.0, 0.1], rtol=1e-3)
    expected = np.diag([0.25, 0.25, update.prior_covariance[0, 2, 2] * 100])
    np.testing.assert_array_equal(now.covariance[0], expected)
    assert now.covariance[0, 2, 2] >= 100 * sigma
    assert now.rejections[0] == 0
    np.testing.assert_array_equal(now.first_px[0], wild[0])
    assert now.turn_rad[0] == 0


def test_resets_one_after_the_other_do_not_ruin_the_covariance() -> None:
    model = FilterSettings().model(F, CENTRE)
    now, ahead, rng = one(), Inputs(0.01, 0.5, 0.1), np.random.default_rng(0)
    outcomes = []
    for _ in range(60):
        now, update = rf.step(model, now, ahead, rng.uniform(100, 500, (1, 2)), 0.09)
        outcomes.append(update.outcome[0])
        assert np.linalg.eigvalsh(update.innovation_covariance[0]).min() > 0
        assert now.covariance[0, 2, 2] > 0
    assert outcomes.count(Outcome.RESET) > 3


def test_an_accepted_point_or_none_between_breaks_or_keeps_the_row() -> None:
    model = FilterSettings().model(F, CENTRE)
    now, still = one(), Inputs(0.0, 0.0, 0.1)
    wild, none, good = np.array([[400.0, 200.0]]), np.full((1, 2), np.nan), np.array([[340.0, 280.0]])
    for pixel, row in ((wild, 1), (none, 1), (wild, 2), (good, 0), (wild, 1)):
        now, _ = rf.step(model, now, still, pixel, 0.25)
        assert now.rejections[0] == row


def test_inverse_depth_keeps_its_bounds_and_its_variance() -> None:
    model = SETTINGS.model(F, CENTRE)
    pulled = one((340.0, 280.0, 0.01), (3.0, 3.0, 0.05))
    update = rf.step(model, pulled, Inputs(0.0, 0.5, 0.5), np.array([[320.0, 240.0]]), 0.01)[1]
    assert update.prior[0, 2] + (update.gain[0] @ update.innovation[0])[2] < 0  # without the floor
    assert update.mean[0, 2] == SETTINGS.xi_floor
    P, K = update.prior_covariance[0], update.gain[0]
    assert update.covariance[0, 2, 2] == pytest.approx((P - K @ P[:2])[2, 2])
    near = one((340.0, 280.0, 9.9), (3.0, 3.0, 3.0))
    update = rf.step(model, near, Inputs(0.0, 0.5, 0.05), np.array([[360.0, 320.0]]), 0.01)[1]
    assert update.mean[0, 2] == 10.0


def test_a_landmark_behind_the_camera_is_lost_for_good() -> None:
    model = SETTINGS.model(F, CENTRE)
    now, update = rf.step(model, one((340.0, 280.0, 5.0)), Inputs(0.0, 1.0, 0.3), np.array([[340.0, 280.0]]), 0.25)
    assert update.outcome[0] == Outcome.LOST
    assert rf.statuses(update)[0] == Status.LOST
    assert np.isnan(now.mean[0]).all()
    assert rf.step(model, now, Inputs(0.0, 1.0, 0.3), np.array([[340.0, 280.0]]), 0.25)[1].outcome[0] == Outcome.LOST


def test_update_without_an_interval_is_an_update_alone() -> None:
    model = SETTINGS.model(F, CENTRE)
    now = one()
    after, update = rf.step(model, now, Inputs(0.3, 0.5, 0.0), np.array([[341.0, 279.0]]), 0.25)
    np.testing.assert_array_equal(update.prior, now.mean)
    np.testing.assert_array_equal(update.prior_covariance, now.covariance)
    assert after.covariance[0, 0, 0] == pytest.approx(0.125)


def test_status_needs_both_certainty_and_parallax() -> None:
    model = SETTINGS.model(F, CENTRE)
    now = Landmarks.of(
        [start.Start(np.array([340.0, 280.0, 0.1]), np.diag([1, 1, s**2])) for s in (0.05, 0.005, 0.05, 0.005)]
    )
    pixel = np.array([[340.0, 280.0]] * 4)
    pixel[2:] += 30.0
    now = Landmarks(now.state, now.rejections, pixel, now.turn_rad)
    update = rf.step(model, now, Inputs(0.0, 0.0, 0.1, True), np.full((4, 2), np.nan), 0.25)[1]
    expected = [Status.UNKNOWN, Status.CONVERGING, Status.CONVERGING, Status.CONVERGED]
    assert rf.statuses(update).tolist() == expected
    turned = rf.step(model, one(), Inputs(0.5, 0.0, 0.1), np.full((1, 2), np.nan), 0.25)[1]
    assert turned.parallax_px[0] > 39
    assert turned.derotated_parallax_px[0] < 1e-9
    assert turned.focus_distance_px[0] == pytest.approx(np.hypot(*(turned.mean[0, :2] - CENTRE)))


def test_zero_velocity_update_stops_the_drift() -> None:
    """5 s of driving, 10 s of standing: without the update the odometer's noise goes on carrying the landmark."""
    speed = (0.5,) * 50 + (0.0,) * 100
    scenario = Scenario(speed=speed, steps=150, pixel_sigma=0.02, runs=1000, seed=1)
    still = np.broadcast_to(np.array(speed) == 0.0, (scenario.runs, 150))
    free, held = run(scenario), run(scenario, still=still)
    print(
        f"bias after 10 s: {100 * free.relative_error[:, -1].mean():.2f} % without, "
        f"{100 * held.relative_error[:, -1].mean():.2f} % with; "
        f"NEES {free.nees[:, -1].mean():.2f}, {held.nees[:, -1].mean():.2f}"
    )
    assert abs(held.relative_error[:, -1].mean()) < 0.35 * abs(free.relative_error[:, -1].mean())
    assert held.nees[:, -1].mean() < free.nees[:, -1].mean()


# --------------------------------------------------------------------------------- starts


def check_start(make, values, covariance, true, *, runs=20_000):
    """The start is right without noise, and its P₀ is that of many starts from noisy values."""
    rng = np.random.default_rng(0)
    exact = make(values)
    np.testing.assert_allclose(exact.state, true, rtol=1e-9)
    noise = rng.multivariate_normal(np.zeros(len(values)), covariance, runs)
    made = np.array([make(values + e).state for e in noise])
    scale = np.sqrt(np.diag(exact.covariance))
    np.testing.assert_allclose(
        np.cov(made.T) / np.outer(scale, scale), exact.covariance / np.outer(scale, scale), atol=0.05
    )
    return exact


def test_broad_prior_and_known_range() -> None:
    found = start.from_broad_prior(np.array([330.0, 250.0]), 0.25, 2.0)
    np.testing.assert_allclose(found.state, [330, 250, 0.25])
    np.testing.assert_allclose(found.covariance, np.diag([0.25, 0.25, 0.125**2]))
    found = start.from_range(np.array([330.0, 250.0]), 0.25, 8.0, 3.0)
    np.testing.assert_allclose(found.covariance[2, 2] ** 0.5, 3 / 64)
    for wrong in (
        lambda: start.from_broad_prior(np.zeros(2), 0.25, 0.0),
        lambda: start.from_range(np.zeros(2), 1, 8, 0),
    ):
        with pytest.raises(ValueError, match="must be positive"):
            wrong()


def test_start_from_the_room() -> None:
    model = SETTINGS.model(F, CENTRE)
    normal = np.array([0.5, 0.0, np.sqrt(0.75)])
    point = np.array([1.0, -0.7, 6.0])
    x = eq.project(point, F, CENTRE)
    distance = float(normal @ point)

    def make(values):
        return start.from_plane(model, values[:2], 4.0, normal, values[2], 0.05)

    found = check_start(make, np.array([x[0], x[1], distance]), np.diag([4.0, 4.0, 0.05**2]), x, runs=4000)
    assert found.covariance[0, 2] == pytest.approx(4.0 * 0.5 / (F * distance))
    with pytest.raises(ValueError, match="the plane does not place"):
        start.from_plane(model, x[:2], 4.0, -normal, distance, 0.05)


def test_start_from_a_second_landmark() -> None:
    model = SETTINGS.model(F, CENTRE)
    point, offset = np.array([0.6, -0.7, 6.0]), np.array([1.2, 0.4, 0.3])
    x, second = eq.project(point, F, CENTRE), eq.project(point - offset, F, CENTRE)[:2]
    covariance = np.diag([0.25] * 4 + [1e-6] * 3)

    def make(v):
        return start.from_second_landmark(model, v[:2], v[2:4], 0.25, v[4:7], 1e-6 * np.eye(3))

    found = check_start(make, np.concatenate([x[:2], second, offset]), covariance, x, runs=4000)
    assert abs(found.covariance[0, 2]) > 0.3 * np.sqrt(found.covariance[0, 0] * found.covariance[2, 2])


def test_start_from_two_views() -> None:
    """P₀ against many noisy pairs: noise of both pixels and of the speeds, about one true motion with turns."""
    settings = FilterSettings(gate="off")
    model = settings.model(F, CENTRE)
    point, steps, dt = np.array([0.9, -0.7, 6.0]), 20, 0.1
    omegas, speeds = 0.1 * np.sin(0.3 * np.arange(steps)), np.full(steps, 0.5)
    q = 1e-6 / dt, 1e-4 / dt

    def motion(omega, speed):
        found = start.CameraMotion.none()
        for w, v in zip(omega, speed, strict=True):
            found = found.then(eq.held(w, v, dt), *q)
        return found

    there = point
    for w, v in zip(omegas, speeds, strict=True):
        there = eq.carried(there, eq.held(w, v, dt))
    first, x = eq.project(point, F, CENTRE)[:2], eq.project(there, F, CENTRE)
    exact = start.from_two_views(model, x[:2], first, 0.04, motion(omegas, speeds))
    np.testing.assert_allclose(exact.state, x, rtol=1e-9)
    rng, made = np.random.default_rng(0), []
    for _ in range(2000):
        noisy = motion(omegas + rng.normal(0, q[0] ** 0.5, steps), speeds + rng.normal(0, q[1] ** 0.5, steps))
        pixels = rng.normal(0, 0.2, (2, 2))
        made.append(start.from_two_views(model, x[:2] + pixels[0], first + pixels[1], 0.04, noisy).state)
    scale = np.sqrt(np.diag(exact.covariance))
    np.testing.assert_allclose(
        np.cov(np.array(made).T) / np.outer(scale, scale), exact.covariance / np.outer(scale, scale), atol=0.1
    )
    with pytest.raises(ValueError, match="the other view does not place"):
        start.from_two_views(model, first - (x[:2] - first), first, 0.04, motion(np.zeros(steps), speeds))


def test_covariance_of_the_cameras_motion_is_that_of_the_speeds() -> None:
    """Two intervals; the covariance against differences of (turn, x, z) with respect to each speed."""
    q = np.array([0.3, 0.2])
    given = np.array([0.4, 0.5, -0.2, 0.7])

    def motion(v):
        first = start.CameraMotion.none().then(eq.held(v[0], v[1], 0.5), *q)
        return first.then(eq.held(v[2], v[3], 0.8), *q)

    slope = derivative(lambda v: np.array([motion(v).turn_rad, *motion(v).shift_m]), given, [1e-5] * 4)
    np.testing.assert_allclose(motion(given).covariance, slope @ np.diag([*q, *q]) @ slope.T, rtol=1e-7)


def test_landmarks_join_and_part() -> None:
    a, _ = landmarks(3, seed=1)
    b, _ = landmarks(2, seed=2)
    both = a.and_also(b)
    assert len(both) == 5
    np.testing.assert_array_equal(both.only(np.array([3, 4])).mean, b.mean)
    np.testing.assert_array_equal(both.only(np.arange(5) < 3).covariance, a.covariance)
