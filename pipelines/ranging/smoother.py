"""Batch estimate of a whole mission: the most probable path of N landmarks and of the inputs' errors.

Unknowns are the landmarks' states at the first frame and the inputs' errors q_k in every interval; the states
between follow from them by the exact flow. Gauss-Newton with a line search minimises

    J = ‖X_0 - X̂_0‖²_{P_0} + Σ_k ‖q_k‖²_{Q_c/dt} + Σ ‖z - H X_k(X_0, q)‖²_R.

The normal equations are banded; each step solves them exactly in time linear in the number of frames, as a linear
smoother about the current path: a Kalman filter forwards, the modified Bryson-Frazier recursion backwards
(G. J. Bierman, 1973), which needs no inverse of a predicted covariance. All image points are used at all frames, so
this is the most accurate answer after a mission, and the measure for every filter.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pipelines.ranging.joint import Joint, blocks_ahead, linearise_all, rank_two_update
from pipelines.ranging.settings import Model

Floats = NDArray[np.float64]

_jit: Any = njit(cache=True, nogil=True, error_model="numpy")

SHORTEST_STEP = 1e-4


@dataclass(frozen=True, slots=True)
class Smoothed:
    """The most probable path.

    Attributes:
        mean: states at each frame [m + 1, N, 3].
        covariance: of each landmark at each frame [m + 1, N, 3, 3].
        input_error: (Δω, ΔV) in each interval [m, 2], rad/s, m/s.
        cost: J, twice the negative logarithm of the probability but for a constant.
        iterations: Gauss-Newton steps taken.
        converged: the last step no longer lowered J by the tolerance.
    """

    mean: Floats
    covariance: Floats
    input_error: Floats
    cost: float
    iterations: int
    converged: bool


def smooth(
    model: Model,
    start: Joint,
    omega: Floats,
    speed: Floats,
    dt: Floats,
    pixel: Floats,
    variance: Floats,
    *,
    still: NDArray[np.bool_] | None = None,
    max_iterations: int = 30,
    tolerance: float = 1e-6,
) -> Smoothed:
    """Smooth a mission.

    Memory is 8 (3N)² (m + 1) bytes for the covariances and about as much for the gains.

    Args:
        model: settings and camera.
        start: prior at the first frame, N landmarks.
        omega: ω̃ of each interval [m], rad/s.
        speed: Ṽ of each interval [m], m/s.
        dt: lengths of the intervals [m], s.
        pixel: image points after each interval [m, N, 2], NaN where there is none, or where a gate rejected it.
        variance: of an image point's coordinate [N], px².
        still: intervals in which the camera stands [m]; default: none.
        max_iterations: of Gauss-Newton.
        tolerance: it ends where J falls by less.

    Raises:
        ValueError: shapes that do not fit, or intervals that are not positive.
    """
    m, n = len(omega), len(start)
    if pixel.shape != (m, n, 2) or speed.shape != (m,) or dt.shape != (m,) or variance.shape != (n,):
        raise ValueError(f"{m} intervals and {n} landmarks need speed ({m},), dt ({m},), pixel ({m}, {n}, 2)")
    if not (dt > 0.0).all():
        raise ValueError("every interval must be positive: join intervals of no length with their neighbours")
    stands = np.zeros(m, np.bool_) if still is None else still
    speed = np.where(stands, 0.0, speed)
    q = np.stack([model.q_omega / dt, np.where(stands, 0.0, model.q_speed / dt)], axis=1)
    prior, weight = start.mean, np.linalg.inv(start.covariance)
    pixels = np.ascontiguousarray(pixel, dtype=np.float64)

    def cost_of(first: Floats, error: Floats) -> tuple[float, Floats, Floats, Floats]:
        path, a, g = np.empty((m + 1, n, 3)), np.empty((m, n, 3, 3)), np.empty((m, n, 3, 2))
        path[0] = first
        if not (first[:, 2] > 0.0).all() or not _roll_out(model, path, omega, speed, dt, error, a, g):
            return np.inf, path, a, g
        off = (first - prior).ravel()
        misfit = np.nansum((pixels - path[1:, :, :2]) ** 2 / variance[:, None])
        drift = np.where(q > 0.0, error**2 / np.where(q > 0.0, q, 1.0), 0.0).sum()
        return float(off @ weight @ off + misfit + drift), path, a, g

    first, error = prior.copy(), np.zeros((m, 2))
    cost, path, a, g = cost_of(first, error)
    if not np.isfinite(cost):
        raise ValueError("the start lies behind the camera on the way: give a farther range at the start")
    iterations, converged = 0, False
    nothing = np.empty((0, 0, 0))
    while iterations < max_iterations and not converged:
        iterations += 1
        shift, change = np.empty(3 * n), np.empty((m, 2))
        _linear_smoother(
            path, a, g, q, start.covariance, prior, error, pixels, variance, shift, change, nothing, nothing
        )
        length, trial = 1.0, cost_of(first + shift.reshape(n, 3), error + change)
        while not trial[0] <= cost and length > SHORTEST_STEP:
            length *= 0.5
            trial = cost_of(first + length * shift.reshape(n, 3), error + length * change)
        if not trial[0] <= cost:
            converged = True
            break
        converged = cost - trial[0] < tolerance
        first, error = first + length * shift.reshape(n, 3), error + length * change
        cost, path, a, g = trial
    covariance, predicted = np.empty((m + 1, n, 9)), np.empty((m + 1, 3 * n, 3 * n))
    _linear_smoother(
        path, a, g, q, start.covariance, prior, error, pixels, variance,
        np.empty(3 * n), np.empty((m, 2)), predicted, covariance,
    )  # fmt: skip
    return Smoothed(path, covariance.reshape(m + 1, n, 3, 3), error, cost, iterations, converged)


@_jit
def _roll_out(
    model: Model, path: Floats, omega: Floats, speed: Floats, dt: Floats, error: Floats, a: Floats, g: Floats
) -> bool:
    """Fill `path` [m + 1, N, 3] from its first frame on, A and G; False where a landmark comes behind the camera."""
    for k in range(len(omega)):
        _copy(path[k], path[k + 1])
        if not linearise_all(model, path[k + 1], omega[k] - error[k, 0], speed[k] - error[k, 1], dt[k], a[k], g[k]):
            return False
    return True


@_jit
def _linear_smoother(
    path: Floats,
    a: Floats,
    g: Floats,
    q: Floats,
    start_covariance: Floats,
    prior: Floats,
    error: Floats,
    pixel: Floats,
    variance: Floats,
    shift: Floats,
    change: Floats,
    predicted: Floats,
    covariance: Floats,
) -> None:
    """The Gauss-Newton step about `path`: fills `shift` [3N] of the first states and `change` [m, 2] of q.

    Where `predicted` [m + 1, 3N, 3N] has room, `covariance` [m + 1, N, 9] is filled as well.
    """
    m, n = a.shape[0], a.shape[1]
    d = 3 * n
    gain, inverse = np.zeros((m, n, d, 2)), np.empty((m, n, 2, 2))
    innovation = np.empty((m, n, 2))
    p, mean, moved = start_covariance.copy(), np.empty(d), np.empty(3)
    wanted = predicted.shape[0] > 0
    for i in range(n):
        for r in range(3):
            mean[3 * i + r] = prior[i, r] - path[0, i, r]
    start_mean = mean.copy()
    for k in range(m):
        if wanted:
            _copy(p, predicted[k])
        for i in range(n):
            for r in range(3):
                moved[r] = -g[k, i, r, 0] * error[k, 0] - g[k, i, r, 1] * error[k, 1]
                for c in range(3):
                    moved[r] += a[k, i, r, c] * mean[3 * i + c]
            for r in range(3):
                mean[3 * i + r] = moved[r]
        blocks_ahead(p, a[k], g[k], q[k])
        for i in range(n):
            at = 3 * i
            du = pixel[k, i, 0] - path[k + 1, i, 0] - mean[at]
            dv = pixel[k, i, 1] - path[k + 1, i, 1] - mean[at + 1]
            innovation[k, i, 0], innovation[k, i, 1] = du, dv
            if np.isfinite(du) and np.isfinite(dv):
                rank_two_update(mean, p, at, du, dv, variance[i], gain[k, i], inverse[k, i])
    back, inside = np.zeros(d), np.zeros((d, d))
    if wanted:
        _copy(p, predicted[m])
        _put_blocks(predicted[m], inside, covariance[m])
    old, turned, no_gain, no_error = np.empty(3), np.empty((n, 3, 3)), np.zeros((n, 3, 2)), np.zeros(2)
    for k in range(m - 1, -1, -1):
        for i in range(n - 1, -1, -1):
            du, dv = innovation[k, i, 0], innovation[k, i, 1]
            if np.isfinite(du) and np.isfinite(dv):
                s = inverse[k, i]
                for r in range(2):
                    down = 0.0
                    for c in range(d):
                        down += gain[k, i, c, r] * back[c]
                    old[r] = -s[r, 0] * du - s[r, 1] * dv - down
                back[3 * i] += old[0]
                back[3 * i + 1] += old[1]
                if wanted:
                    _information_through_update(inside, gain[k, i], s, 3 * i)
        for c in range(2):
            change[k, c] = -error[k, c]
            for i in range(n):
                for r in range(3):
                    change[k, c] -= q[k, c] * g[k, i, r, c] * back[3 * i + r]
        for i in range(n):
            for c in range(3):
                old[c] = 0.0
                for r in range(3):
                    old[c] += a[k, i, r, c] * back[3 * i + r]
            for c in range(3):
                back[3 * i + c] = old[c]
        if wanted:
            blocks_ahead(inside, _transposed(a[k], turned), no_gain, no_error)
            _put_blocks(predicted[k], inside, covariance[k])
    for r in range(d):
        shift[r] = start_mean[r]
        for c in range(d):
            shift[r] -= start_covariance[r, c] * back[c]


@_jit
def _information_through_update(inside: Floats, gain: Floats, inverse: Floats, at: int) -> None:
    """Λ ← (I - K H)ᵀ Λ (I - K H) + Hᵀ S⁻¹ H, in place, for the image point at rows `at`, `at` + 1."""
    d = len(inside)
    through, core = np.zeros((d, 2)), inverse.copy()
    for r in range(d):
        for k in range(d):
            through[r, 0] += inside[r, k] * gain[k, 0]
            through[r, 1] += inside[r, k] * gain[k, 1]
    for r in range(2):
        for c in range(2):
            for k in range(d):
                core[r, c] += gain[k, r] * through[k, c]
    for c in range(2):
        for r in range(d):
            inside[r, at + c] -= through[r, c]
            inside[at + c, r] -= through[r, c]
    for r in range(2):
        for c in range(2):
            inside[at + r, at + c] += core[r, c]


@_jit
def _put_blocks(p: Floats, inside: Floats, out: Floats) -> None:
    """The diagonal blocks of P - P Λ P, into `out` [N, 9]."""
    d = len(p)
    half = np.empty((d, 3))
    for i in range(len(out)):
        for r in range(d):
            for c in range(3):
                half[r, c] = 0.0
                for k in range(d):
                    half[r, c] += inside[r, k] * p[k, 3 * i + c]
        for r in range(3):
            for c in range(3):
                value = p[3 * i + r, 3 * i + c]
                for k in range(d):
                    value -= p[3 * i + r, k] * half[k, c]
                out[i, 3 * r + c] = value


@_jit
def _transposed(a: Floats, out: Floats) -> Floats:
    """Aᵀ of each landmark, into `out` [N, 3, 3]."""
    for i in range(len(a)):
        for r in range(3):
            for c in range(3):
                out[i, c, r] = a[i, r, c]
    return out


@_jit
def _copy(source: Floats, target: Floats) -> None:
    """Element by element: quicker to compile than an assignment of slices."""
    for i in range(source.shape[0]):
        for j in range(source.shape[1]):
            target[i, j] = source[i, j]
