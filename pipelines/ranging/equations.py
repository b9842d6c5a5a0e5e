"""Paper B's equations (9), (13), (17), (21)-(30), each once, exact or by the field's usual approximation.

Paper B: M. Mansour, P. Davidson, O. Stepanov, J.-P. Raunio, M. Aref, R. Piché, "Depth estimation with ego-motion
assisted monocular camera", Giroskopiya i Navigatsiya 27(2), 2019, 28-51.

Axes. The camera's are optical: x right, y down, z out of the lens along the travel. V (m/s) is its speed along z,
ω (rad/s) its rate about y, positive to the right. The image point is (u, v) = (x - c_x, y - c_y) in px, ξ = 1/Z
in 1/m. The inputs' errors are Δω, ΔV with ω = ω̃ - Δω, V = Ṽ - ΔV (14), so q = (Δω, ΔV) acts with a minus.

A point is (u, v, ξ). Of the matrices only the elements that are not always 0 are kept: see `Transition`,
`NoiseGain`, `Covariance`. All functions with `_jit` serve Python and compiled code alike.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_jit: Any = njit(cache=True, nogil=True, error_model="numpy")

SMALL_RAD = 1e-2
"""Below this turn the sines are taken from their series, whose first neglected term is below 1e-15."""
LOG_2PI = math.log(2.0 * math.pi)


class Point(NamedTuple):
    """State of a landmark: image point from the principal point (px, px), inverse depth (1/m)."""

    u: float
    v: float
    xi: float


class Held(NamedTuple):
    """Speeds held over an interval, and the integrals over it that the exact solution of (13) needs.

    `dt` s, `omega` rad/s, `speed` m/s; `sin`, `cos` of θ = ω dt; `s` = sin θ / ω and `c` = (1 - cos θ) / ω, both
    in s; `s_omega`, `c_omega` their derivatives with respect to ω, s².
    """

    dt: float
    omega: float
    speed: float
    sin: float
    cos: float
    s: float
    c: float
    s_omega: float
    c_omega: float


class Transition(NamedTuple):
    """A = ∂X_k/∂X_{k-1} (28): the elements that are not always 0, row by row; [0,1] and [2,1] are 0."""

    xx: float
    xk: float
    yx: float
    yy: float
    yk: float
    kx: float
    kk: float


class NoiseGain(NamedTuple):
    """G = ∂X_k/∂(Δω, ΔV) (29): rows x, y, ξ (`k`), columns ω (`w`) and V (`v`)."""

    xw: float
    xv: float
    yw: float
    yv: float
    kw: float
    kv: float


class Covariance(NamedTuple):
    """Upper triangle of P, row by row: px², px², px/m, px², px/m, 1/m²."""

    xx: float
    xy: float
    xk: float
    yy: float
    yk: float
    kk: float


class Correction(NamedTuple):
    """The update (25)-(27): K row by row, S (xx, xy, yy; px²), NIS, log-likelihood, state and P after it."""

    gain: tuple[float, float, float, float, float, float]
    spread: tuple[float, float, float]
    nis: float
    log_likelihood: float
    shift: tuple[float, float, float]
    covariance: Covariance


# ------------------------------------------------------------------------------- kinematics


@_jit
def rates(p: Point, omega: float, speed: float, focal: float) -> tuple[float, float, float]:
    """(u̇, v̇, ξ̇) of a fixed point (13a)-(13c), px/s, px/s, 1/(m s)."""
    return (
        -(focal + p.u * p.u / focal) * omega + speed * p.xi * p.u,
        speed * p.xi * p.v - omega * p.u * p.v / focal,
        speed * p.xi * p.xi - omega * p.xi * p.u / focal,
    )


@_jit
def held(omega: float, speed: float, dt: float) -> Held:
    """The integrals of an interval in which both speeds are constant; continuous at ω = 0."""
    turn = omega * dt
    if abs(turn) < SMALL_RAD:
        q = turn * turn
        s = dt * (1.0 - q / 6.0 * (1.0 - q / 20.0))
        c = 0.5 * dt * turn * (1.0 - q / 12.0 * (1.0 - q / 30.0))
        s_omega = -dt * dt * turn * (1.0 / 3.0 - q / 30.0 * (1.0 - q / 28.0))
        c_omega = dt * dt * (0.5 - q / 8.0 * (1.0 - q / 18.0))
        return Held(dt, omega, speed, omega * s, 1.0 - omega * c, s, c, s_omega, c_omega)
    sin, cos, half = math.sin(turn), math.cos(turn), math.sin(0.5 * turn)
    s, c = sin / omega, 2.0 * half * half / omega
    return Held(dt, omega, speed, sin, cos, s, c, (dt * cos - s) / omega, (dt * sin - c) / omega)


@_jit
def exact_flow(p: Point, h: Held, focal: float) -> Point:
    """(22) without approximation: (13) solved over an interval of constant V and ω. A homography, one division.

    x' = f N/D, y' = f b/D, ξ' = ξ/D with a = u/f, b = v/f, N = a cos θ - sin θ + ξ V C and
    D = a sin θ + cos θ - ξ V S. D is the new depth over the old one: negative behind the camera.
    """
    a = p.u / focal
    over = 1.0 / (a * h.sin + h.cos - p.xi * h.speed * h.s)
    return Point(focal * (a * h.cos - h.sin + p.xi * h.speed * h.c) * over, p.v * over, p.xi * over)


@_jit
def euler_flow(p: Point, h: Held, focal: float) -> Point:
    """(21) as printed: the integrand frozen at the start of the interval."""
    u, v, k = rates(p, h.omega, h.speed, focal)
    return Point(p.u + u * h.dt, p.v + v * h.dt, p.xi + k * h.dt)


@_jit
def rk4_flow(p: Point, h: Held, focal: float) -> Point:
    """(21) by one Runge-Kutta step of fourth order, as the paper's text says."""
    half = 0.5 * h.dt
    u1, v1, k1 = rates(p, h.omega, h.speed, focal)
    u2, v2, k2 = rates(Point(p.u + half * u1, p.v + half * v1, p.xi + half * k1), h.omega, h.speed, focal)
    u3, v3, k3 = rates(Point(p.u + half * u2, p.v + half * v2, p.xi + half * k2), h.omega, h.speed, focal)
    u4, v4, k4 = rates(Point(p.u + h.dt * u3, p.v + h.dt * v3, p.xi + h.dt * k3), h.omega, h.speed, focal)
    sixth = h.dt / 6.0
    return Point(
        p.u + sixth * (u1 + 2.0 * (u2 + u3) + u4),
        p.v + sixth * (v1 + 2.0 * (v2 + v3) + v4),
        p.xi + sixth * (k1 + 2.0 * (k2 + k3) + k4),
    )


@_jit
def exact_transition(p: Point, h: Held, focal: float) -> Transition:
    """(28) of the exact flow."""
    a, b = p.u / focal, p.v / focal
    d = a * h.sin + h.cos - p.xi * h.speed * h.s
    over = 1.0 / d
    q = over * over
    return Transition(
        (1.0 - p.xi * h.speed * h.s) * q,
        focal * h.speed * (a * h.s - h.c) * q,
        -b * h.sin * q,
        over,
        focal * b * h.speed * h.s * q,
        -p.xi * h.sin / focal * q,
        (a * h.sin + h.cos) * q,
    )


@_jit
def first_order_transition(p: Point, h: Held, focal: float) -> Transition:
    """(28) as I + F dt, the paper's appendix with its misprint in A[0,0] put right."""
    turn, way = h.omega * h.dt, h.speed * h.dt
    across = turn * p.u / focal
    return Transition(
        1.0 - 2.0 * across + way * p.xi,
        way * p.u,
        -turn * p.v / focal,
        1.0 + way * p.xi - across,
        way * p.v,
        -turn * p.xi / focal,
        1.0 + 2.0 * way * p.xi - across,
    )


@_jit
def transition_as_printed(p: Point, h: Held, focal: float) -> Transition:
    """(28) as the appendix prints it: V ξ dt / f in A[0,0] for V ξ dt."""
    a = first_order_transition(p, h, focal)
    way = h.speed * h.dt * p.xi
    return Transition(a.xx - way + way / focal, a.xk, a.yx, a.yy, a.yk, a.kx, a.kk)


@_jit
def exact_noise_gain(p: Point, h: Held, focal: float) -> NoiseGain:
    """(29) of the exact flow, for errors held over the interval."""
    a, b = p.u / focal, p.v / focal
    d = a * h.sin + h.cos - p.xi * h.speed * h.s
    n = a * h.cos - h.sin + p.xi * h.speed * h.c
    over = 1.0 / d
    q = over * over
    d_omega = h.dt * (a * h.cos - h.sin) - p.xi * h.speed * h.s_omega
    n_omega = -h.dt * (a * h.sin + h.cos) + p.xi * h.speed * h.c_omega
    return NoiseGain(
        -focal * (n_omega * d - n * d_omega) * q,
        -focal * p.xi * (a * h.s - h.c) * q,
        focal * b * d_omega * q,
        -focal * b * p.xi * h.s * q,
        p.xi * d_omega * q,
        -p.xi * p.xi * h.s * q,
    )


@_jit
def continuous_noise_gain(p: Point, focal: float, u_squared: float) -> NoiseGain:
    """G_c, the derivative of (15) with respect to (Δω, ΔV); `u_squared` stands in G[0,0] only.

    The appendix prints (x + c_x)² there, where u² = (x - c_x)² is right.
    """
    return NoiseGain(
        focal + u_squared / focal, -p.xi * p.u, p.u * p.v / focal, -p.xi * p.v, p.xi * p.u / focal, -p.xi * p.xi
    )


@_jit
def times(g: NoiseGain, factor: float) -> NoiseGain:
    """G · factor: G_c dt goes with Q_c / dt (24); the appendix prints G_c alone."""
    return NoiseGain(g.xw * factor, g.xv * factor, g.yw * factor, g.yv * factor, g.kw * factor, g.kv * factor)


# ----------------------------------------------------------------------------------- filter


@_jit
def covariance_ahead(p: Covariance, a: Transition, g: NoiseGain, q_omega: float, q_speed: float) -> Covariance:
    """P⁻ = A P Aᵀ + G (Q_c / dt) Gᵀ (24); `q_omega`, `q_speed` are the diagonal of Q_c / dt."""
    xx, xy, xk = a.xx * p.xx + a.xk * p.xk, a.xx * p.xy + a.xk * p.yk, a.xx * p.xk + a.xk * p.kk
    yx = a.yx * p.xx + a.yy * p.xy + a.yk * p.xk
    yy = a.yx * p.xy + a.yy * p.yy + a.yk * p.yk
    yk = a.yx * p.xk + a.yy * p.yk + a.yk * p.kk
    kx, kk = a.kx * p.xx + a.kk * p.xk, a.kx * p.xk + a.kk * p.kk
    return Covariance(
        xx * a.xx + xk * a.xk + g.xw * g.xw * q_omega + g.xv * g.xv * q_speed,
        xx * a.yx + xy * a.yy + xk * a.yk + g.xw * g.yw * q_omega + g.xv * g.yv * q_speed,
        xx * a.kx + xk * a.kk + g.xw * g.kw * q_omega + g.xv * g.kv * q_speed,
        yx * a.yx + yy * a.yy + yk * a.yk + g.yw * g.yw * q_omega + g.yv * g.yv * q_speed,
        yx * a.kx + yk * a.kk + g.yw * g.kw * q_omega + g.yv * g.kv * q_speed,
        kx * a.kx + kk * a.kk + g.kw * g.kw * q_omega + g.kv * g.kv * q_speed,
    )


@_jit
def correct(p: Covariance, du: float, dv: float, variance: float) -> Correction:
    """The update (25)-(27) for R = variance · I (px²) and the innovation (du, dv), px.

    K = P Hᵀ S⁻¹ with S = H P Hᵀ + R (25); the paper prints P H. P⁺ is written as its own consequences
    P⁺Hᵀ = K R and P⁺_ξξ = P_ξξ - K_ξ Pᵀ_ξ: symmetric by construction, nothing large is subtracted in the image's
    block. The log-likelihood is -½ (NIS + ln |2π S|).
    """
    sxx, syy = p.xx + variance, p.yy + variance
    det = sxx * syy - p.xy * p.xy
    over = 1.0 / det
    ixx, ixy, iyy = syy * over, -p.xy * over, sxx * over
    k00, k01 = p.xx * ixx + p.xy * ixy, p.xx * ixy + p.xy * iyy
    k10, k11 = p.xy * ixx + p.yy * ixy, p.xy * ixy + p.yy * iyy
    k20, k21 = p.xk * ixx + p.yk * ixy, p.xk * ixy + p.yk * iyy
    nis = du * (ixx * du + ixy * dv) + dv * (ixy * du + iyy * dv)
    after = Covariance(
        k00 * variance,
        0.5 * (k01 + k10) * variance,
        k20 * variance,
        k11 * variance,
        k21 * variance,
        p.kk - k20 * p.xk - k21 * p.yk,
    )
    return Correction(
        (k00, k01, k10, k11, k20, k21),
        (sxx, p.xy, syy),
        nis,
        -0.5 * (nis + math.log(det)) - LOG_2PI,
        (k00 * du + k01 * dv, k10 * du + k11 * dv, k20 * du + k21 * dv),
        after,
    )


@_jit
def nis_of(p: Covariance, du: float, dv: float, variance: float) -> float:
    """νᵀ S⁻¹ ν of the innovation (du, dv), px: χ² with two degrees of freedom where the filter is right."""
    sxx, syy = p.xx + variance, p.yy + variance
    return (syy * du * du - 2.0 * p.xy * du * dv + sxx * dv * dv) / (sxx * syy - p.xy * p.xy)


# --------------------------------------------------------------------------------- geometry


def project(point_in_cam: Floats, focal_px: float, centre_px: tuple[float, float]) -> Floats:
    """State (x, y, ξ) [..., 3] of points [..., 3] (m, camera axes) (9)."""
    z = point_in_cam[..., 2]
    x = focal_px * point_in_cam[..., 0] / z + centre_px[0]
    y = focal_px * point_in_cam[..., 1] / z + centre_px[1]
    return np.stack([x, y, 1.0 / z], axis=-1)


def unproject(state: Floats, focal_px: float, centre_px: tuple[float, float]) -> Floats:
    """Points [..., 3] (m, camera axes) of states (x, y, ξ) [..., 3] (10)."""
    z = 1.0 / state[..., 2]
    x = (state[..., 0] - centre_px[0]) / focal_px * z
    y = (state[..., 1] - centre_px[1]) / focal_px * z
    return np.stack([x, y, z], axis=-1)


def carried(point_in_cam: Floats, h: Held) -> Floats:
    """Fixed points [..., 3] in the camera's axes after the camera's arc: the exact solution of (8), metres."""
    x, z = point_in_cam[..., 0], point_in_cam[..., 2]
    moved = np.array(point_in_cam, dtype=np.float64)
    moved[..., 0] = h.cos * x - h.sin * z + h.speed * h.c
    moved[..., 2] = h.sin * x + h.cos * z - h.speed * h.s
    return moved


def carried_as_printed(point_in_cam: Floats, omega: Floats | float, speed: Floats | float, dt: float) -> Floats:
    """Fixed points [..., 3] after an interval by Euler's step (30); the paper puts the noisy speeds in it."""
    x, z = point_in_cam[..., 0], point_in_cam[..., 2]
    moved = np.array(point_in_cam, dtype=np.float64)
    moved[..., 0] = x - omega * z * dt
    moved[..., 2] = z - speed * dt + omega * x * dt
    return moved


def turned(pixel: Floats, turn_rad: Floats | float, focal_px: float, centre_px: tuple[float, float]) -> Floats:
    """Where image points [..., 2] (px) would be seen after a pure rotation of the camera: the flow at ξ = 0."""
    a = (pixel[..., 0] - centre_px[0]) / focal_px
    b = (pixel[..., 1] - centre_px[1]) / focal_px
    sin, cos = np.sin(turn_rad), np.cos(turn_rad)
    over = focal_px / (a * sin + cos)
    return np.stack([(a * cos - sin) * over + centre_px[0], b * over + centre_px[1]], axis=-1)


def derotated_parallax(
    first_px: Floats, pixel: Floats, turn_rad: Floats | float, focal_px: float, centre_px: tuple[float, float]
) -> Floats:
    """Cumulative parallax without the rotation's share [...], px: what the range is told from.

    It is the distance of the image point [..., 2] from where the first one [..., 2] would be seen, had the camera
    only turned by `turn_rad` since. The raw parallax contains the rotation, which tells nothing.
    """
    return np.asarray(np.linalg.norm(pixel - turned(first_px, turn_rad, focal_px, centre_px), axis=-1))


def focus_of_expansion(velocity_in_cam: Floats, focal_px: float, centre_px: tuple[float, float]) -> Floats:
    """Image point [2] (px) that translation does not move: where the velocity [3] (camera axes) pierces the image.

    It is the principal point only for a camera that looks along the travel; NaN for a velocity across it.
    """
    vx, vy, vz = (float(x) for x in velocity_in_cam)
    if vz == 0.0:
        return np.full(2, np.nan)
    return np.array([centre_px[0] + focal_px * vx / vz, centre_px[1] + focal_px * vy / vz])


def range_interval(xi: Floats | float, sigma_xi: Floats | float, sigmas: float = 2.0) -> tuple[Floats, Floats]:
    """Depths (m) between which the landmark lies: 1 / (ξ ± n σ_ξ); the far end is inf where ξ ≤ n σ_ξ."""
    xi, sigma_xi = np.asarray(xi, dtype=np.float64), np.asarray(sigma_xi, dtype=np.float64)
    least = xi - sigmas * sigma_xi
    with np.errstate(divide="ignore"):
        return 1.0 / (xi + sigmas * sigma_xi), np.where(least > 0, 1.0 / np.where(least > 0, least, 1.0), np.inf)


def relative_error_expected(
    parallax_px: Floats | float, pixel_sigma: float, sigma_speed: float, speed: float, time_s: float, k: float = 1.2
) -> Floats:
    """σ_Z/Z ≈ sqrt((k r/d)² + (σ_V/(V √T))²), the rule of thumb; d is the derotated parallax, k ≈ 0.9-1.4."""
    image = k * pixel_sigma / np.asarray(parallax_px, dtype=np.float64)
    return np.asarray(np.hypot(image, sigma_speed / (abs(speed) * math.sqrt(time_s))))
