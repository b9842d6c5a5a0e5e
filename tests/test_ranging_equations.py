"""Paper B's equations against scipy's solver, differences and closed forms."""

import math

import numpy as np
import pytest
from plain_range_filter import derivative
from scipy.integrate import solve_ivp

from pipelines.ranging import equations as eq

F = 800.0
POINTS = [eq.Point(40.0, 40.0, 0.125), eq.Point(-310.0, 170.0, 0.4), eq.Point(0.0, -250.0, 0.02)]
SPEEDS = [(0.0, 0.5), (0.1, 0.5), (-0.7, 0.3), (0.5, -0.4), (0.3, 0.0), (1e-5, 0.5)]


def scaled(values):
    """Elements in the units of a pixel and of ξ = 0.1, so that differences compare like with like."""
    return np.array(values) / [1.0, 1.0, 0.1]


@pytest.mark.parametrize("p", POINTS)
@pytest.mark.parametrize(("omega", "speed"), SPEEDS)
@pytest.mark.parametrize("dt", [0.02, 0.1, 0.5])
def test_exact_flow_solves_13(p, omega, speed, dt) -> None:
    solved = solve_ivp(
        lambda _, x: eq.rates(eq.Point(*x), omega, speed, F), (0, dt), p, method="DOP853", rtol=1e-12, atol=1e-14
    ).y[:, -1]
    ahead = eq.exact_flow(p, eq.held(omega, speed, dt), F)
    np.testing.assert_allclose(ahead[:2], solved[:2], rtol=0, atol=1e-9)
    assert ahead.xi == pytest.approx(solved[2], rel=1e-11)


@pytest.mark.parametrize("p", POINTS)
@pytest.mark.parametrize(("omega", "speed"), SPEEDS)
def test_flow_is_the_motion_of_a_fixed_point(p, omega, speed) -> None:
    h = eq.held(omega, speed, 0.1)
    there = eq.unproject(np.array(p), F, (0.0, 0.0))
    np.testing.assert_allclose(
        eq.project(eq.carried(there, h), F, (0.0, 0.0)), eq.exact_flow(p, h, F), rtol=1e-13, atol=1e-10
    )


def test_rates_are_those_of_8_projected() -> None:
    """(13) follows from (8) by the chain rule, with the signs of the paper's axes."""
    focal, omega, speed = 700.0, 0.2, 0.6
    point = np.array([0.7, -0.4, 5.0])
    velocity = np.array([-omega * point[2], 0.0, -speed + omega * point[0]])
    jacobian = derivative(lambda x: eq.project(x, focal, (0.0, 0.0)), point, [1e-6] * 3)
    state = eq.Point(*eq.project(point, focal, (0.0, 0.0)))
    np.testing.assert_allclose(eq.rates(state, omega, speed, focal), jacobian @ velocity, rtol=1e-8)


@pytest.mark.parametrize("p", POINTS)
@pytest.mark.parametrize(("omega", "speed"), SPEEDS)
@pytest.mark.parametrize("dt", [0.02, 0.1, 0.5])
def test_a_and_g_are_the_derivatives(p, omega, speed, dt) -> None:
    h = eq.held(omega, speed, dt)
    a, g = eq.exact_transition(p, h, F), eq.exact_noise_gain(p, h, F)
    full_a = np.array([[a.xx, 0, a.xk], [a.yx, a.yy, a.yk], [a.kx, 0, a.kk]])
    full_g = np.array([[g.xw, g.xv], [g.yw, g.yv], [g.kw, g.kv]])
    by_state = derivative(lambda x: np.array(eq.exact_flow(eq.Point(*x), h, F)), p, [1e-2, 1e-2, 1e-5])
    by_error = derivative(
        lambda q: np.array(eq.exact_flow(p, eq.held(omega - q[0], speed - q[1], dt), F)), [0, 0], [1e-4, 1e-4]
    )
    for mine, measured in ((full_a, by_state), (full_g, by_error)):
        largest = np.abs(measured).max(axis=1, keepdims=True)
        assert (np.abs(mine - measured) / largest).max() < 1e-6


def test_worst_relative_error_of_a_and_g_is_reported() -> None:
    rng, worst = np.random.default_rng(0), 0.0
    for _ in range(200):
        p = eq.Point(*rng.uniform([-400, -400, 0.02], [400, 400, 0.5]))
        omega, speed, dt = rng.uniform([-0.6, -1, 0.02], [0.6, 1, 0.3])
        h = eq.held(omega, speed, dt)
        a, g = eq.exact_transition(p, h, F), eq.exact_noise_gain(p, h, F)
        measured = derivative(lambda x, h=h: np.array(eq.exact_flow(eq.Point(*x), h, F)), p, [1e-2, 1e-2, 1e-5])
        mine = np.array([[a.xx, 0, a.xk], [a.yx, a.yy, a.yk], [a.kx, 0, a.kk]])
        worst = max(worst, np.abs((mine - measured) / np.abs(measured).max(axis=1, keepdims=True)).max())
        measured = derivative(
            lambda q, p=p, o=omega, s=speed, d=dt: np.array(eq.exact_flow(p, eq.held(o - q[0], s - q[1], d), F)),
            [0, 0],
            [1e-4, 1e-4],
        )
        mine = np.array(g).reshape(3, 2)
        worst = max(worst, np.abs((mine - measured) / np.abs(measured).max(axis=1, keepdims=True)).max())
    print(f"A, G against central differences: worst {worst:.1e}")
    assert worst < 1e-6


def test_continuous_at_no_turn_and_over_the_seam_of_the_series() -> None:
    p = POINTS[1]

    def everything(omega):
        h = eq.held(omega, 0.5, 0.1)
        values = [*h, *eq.exact_flow(p, h, F), *eq.exact_transition(p, h, F), *eq.exact_noise_gain(p, h, F)]
        return np.array(values)

    still = everything(0.0)
    assert np.isfinite(still).all()
    for omega in (1e-12, 1e-9, 1e-7):
        np.testing.assert_allclose(everything(omega), still, rtol=1e-4, atol=1e-7)
    seam = eq.SMALL_RAD / 0.1
    below, above = everything(seam * (1 - 1e-13)), everything(seam * (1 + 1e-13))
    np.testing.assert_allclose(below, above, rtol=1e-11, atol=1e-14)


@pytest.mark.parametrize("turn", [1e-9, 3e-4, 9.9e-3, 1.01e-2, 0.3, -0.2])
def test_held_integrals_at_high_precision(turn) -> None:
    """Against Taylor sums with exact rational coefficients, to twelve terms."""
    dt, omega = 0.1, turn / 0.1
    sine = sum((-1) ** k * turn ** (2 * k) / math.factorial(2 * k + 1) for k in range(12))
    versed = sum((-1) ** k * turn ** (2 * k + 1) / math.factorial(2 * k + 2) for k in range(12))
    d_sine = sum((-1) ** k * 2 * k * turn ** (2 * k - 1) / math.factorial(2 * k + 1) for k in range(1, 12))
    d_versed = sum((-1) ** k * (2 * k + 1) * turn ** (2 * k) / math.factorial(2 * k + 2) for k in range(12))
    h = eq.held(omega, 0.5, dt)
    expected = [math.sin(turn), math.cos(turn), dt * sine, dt * versed, dt**2 * d_sine, dt**2 * d_versed]
    np.testing.assert_allclose(h[3:], expected, rtol=2e-12)


def test_rk4_and_euler_err_as_measured() -> None:
    p = eq.Point(40.0, 40.0, 0.125)
    off = {}
    for omega in (0.0, 0.5):
        h = eq.held(omega, 0.5, 0.1)
        exact = np.array(eq.exact_flow(p, h, F))[:2]
        for name, flow in (("rk4", eq.rk4_flow), ("euler", eq.euler_flow)):
            off[name, omega] = np.abs(np.array(flow(p, h, F))[:2] - exact).max()
    print({k: f"{v:.1e} px" for k, v in off.items()})
    assert off["rk4", 0.0] < 1e-9
    assert 1e-7 < off["rk4", 0.5] < 5e-6
    assert off["euler", 0.0] == pytest.approx(1.6e-3, rel=0.1)
    assert 0.02 < off["euler", 0.5] < 0.2


def test_first_order_forms_are_the_limit_and_the_misprints_are_not() -> None:
    p, centre = POINTS[1], 320.0
    h = eq.held(0.2, 0.5, 1e-6)
    exact, first = eq.exact_transition(p, h, F), eq.first_order_transition(p, h, F)
    np.testing.assert_allclose(
        np.array(first) - [1, 0, 0, 1, 0, 0, 1], np.array(exact) - [1, 0, 0, 1, 0, 0, 1], rtol=1e-5
    )
    printed = eq.transition_as_printed(p, h, F)
    assert printed.xx - first.xx == pytest.approx(h.speed * p.xi * h.dt * (1 / F - 1))
    assert printed[1:] == first[1:]
    gain = eq.times(eq.continuous_noise_gain(p, F, p.u**2), h.dt)
    np.testing.assert_allclose(gain, eq.exact_noise_gain(p, h, F), rtol=1e-5)
    misprinted = eq.continuous_noise_gain(p, F, (p.u + 2 * centre) ** 2)
    assert misprinted.xw == pytest.approx(F + (p.u + 2 * centre) ** 2 / F)
    assert misprinted[1:] == eq.continuous_noise_gain(p, F, p.u**2)[1:]


def test_update_is_joseph_and_the_likelihood_that_of_a_gaussian() -> None:
    from scipy.stats import multivariate_normal

    root = np.array([[3.0, 0, 0], [-0.8, 2.5, 0], [0.01, -0.02, 0.04]])
    P, r, nu = root @ root.T, 0.25, np.array([0.7, -1.3])
    H = np.eye(3)[:2]
    S = H @ P @ H.T + r * np.eye(2)
    K = P @ H.T @ np.linalg.inv(S)
    left = np.eye(3) - K @ H
    upper = np.triu_indices(3)
    c = eq.correct(eq.Covariance(*P[upper]), *nu, r)
    np.testing.assert_allclose(np.reshape(c.gain, (3, 2)), K, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(c.covariance, (left @ P @ left.T + r * K @ K.T)[upper], rtol=1e-11)
    np.testing.assert_allclose(c.shift, K @ nu, rtol=1e-12)
    assert c.nis == pytest.approx(nu @ np.linalg.solve(S, nu))
    assert c.nis == pytest.approx(eq.nis_of(eq.Covariance(*P[upper]), *nu, r))
    assert c.log_likelihood == pytest.approx(multivariate_normal(cov=S).logpdf(nu))
    assert c.spread == pytest.approx(tuple(S[np.triu_indices(2)]))


def test_derotated_parallax_is_blind_to_rotation() -> None:
    centre, there = (320.0, 240.0), np.array([[1.0, 0.5, 6.0], [-2.0, 0.1, 9.0]])
    first = eq.project(there, F, centre)[:, :2]
    turned = eq.project(eq.carried(there, eq.held(0.1, 0.0, 3.0)), F, centre)[:, :2]
    assert (np.linalg.norm(turned - first, axis=1) > 200).all()
    np.testing.assert_allclose(eq.derotated_parallax(first, turned, 0.3, F, centre), 0, atol=1e-9)
    ahead = eq.project(eq.carried(there, eq.held(0.0, 0.5, 3.0)), F, centre)[:, :2]
    np.testing.assert_allclose(
        eq.derotated_parallax(first, ahead, 0.0, F, centre), np.linalg.norm(ahead - first, axis=1), rtol=1e-12
    )


def test_focus_of_expansion_does_not_move() -> None:
    velocity, centre = np.array([0.02, -0.1, 0.8]), (320.0, 240.0)
    focus = eq.focus_of_expansion(velocity, F, centre)
    on_it = 5.0 * velocity / velocity[2]
    np.testing.assert_allclose(eq.project(on_it, F, centre)[:2], focus)
    np.testing.assert_allclose(eq.project(on_it - 0.3 * velocity, F, centre)[:2], focus)
    np.testing.assert_allclose(eq.focus_of_expansion(np.array([0, 0, 1.0]), F, centre), centre)
    assert np.isnan(eq.focus_of_expansion(np.array([1.0, 0, 0]), F, centre)).all()


def test_range_interval() -> None:
    near, far = eq.range_interval(np.array([0.1, 0.1, 0.1]), np.array([0.0, 0.02, 0.05]))
    np.testing.assert_allclose(near, [10, 1 / 0.14, 1 / 0.2])
    np.testing.assert_allclose(far, [10, 1 / 0.06, np.inf])


def test_rule_of_thumb_foretells_the_floor() -> None:
    assert eq.relative_error_expected(1e9, 0.5, 0.01, 0.5, 4.0) == pytest.approx(0.01)
    assert eq.relative_error_expected(10.0, 0.5, 0.0, 0.5, 4.0, k=1.0) == pytest.approx(0.05)
