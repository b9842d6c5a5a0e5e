"""The exact flow for any motion of the camera: six velocities held over an interval.

A fixed point moves in the camera's axes by Ṗ = -ω × P - v. With constant ω and v over dt, θ = -ω dt,

    P' = E P - b,    E = exp [θ]×,    b = B v,    B = dt (I + k [θ]× + m [θ]×²),

k = (1 - cos |θ|)/|θ|², m = (|θ| - sin |θ|)/|θ|³. With the ray r = (u/f, v/f, 1) and P = r/ξ the image point and
the inverse depth follow from h = E r - ξ b: x' = c + f h_x/h_z, ξ' = ξ/h_z, a homography. For ω = (0, ω, 0) and
v = (0, 0, V) this is `equations.exact_flow`, with its A and G.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pipelines.ranging import joint
from pipelines.ranging.settings import Model

Floats = NDArray[np.float64]

_jit: Any = njit(cache=True, nogil=True, error_model="numpy")

TERMS = 40
"""Of the series of the sines' quotients: exact to rounding up to turns of about 10 rad within one interval."""


BESIDE = 0.01
"""Cosine of the angle from the optical axis (89.4°) beyond which a landmark counts as behind: its image runs away."""


class Arc(NamedTuple):
    """The camera's motion over an interval of constant velocities.

    Attributes:
        turn: E [3, 3].
        shift_m: b [3].
        reach_s: B [3, 3], the derivative of b with respect to v, s.
        turn_by: derivatives of E with respect to ω_x, ω_y, ω_z [3, 3, 3], s.
        shift_by: derivatives of b with respect to ω, by columns [3, 3], m s.
    """

    turn: Floats
    shift_m: Floats
    reach_s: Floats
    turn_by: Floats
    shift_by: Floats


@_jit
def _cross(a):  # type: ignore[no-untyped-def]
    """[a]× [3, 3]."""
    return np.array([[0.0, -a[2], a[1]], [a[2], 0.0, -a[0]], [-a[1], a[0], 0.0]])


@_jit
def _series(q, first):  # type: ignore[no-untyped-def]
    """Σ (-q)ⁿ/(2n + first)! and its derivative by q: sin √q/√q for first = 1, k for 2, m for 3."""
    term = 1.0
    for i in range(2, first + 1):
        term /= i
    total, slope = term, 0.0
    for n in range(1, TERMS):
        over = 1.0 / ((2 * n + first - 1) * (2 * n + first))
        slope -= n * term * over
        term *= -q * over
        total += term
    return total, slope


@_jit
def arc_of(omega, velocity, dt):  # type: ignore[no-untyped-def]
    """The fields of `Arc`."""
    theta = -omega * dt
    t = _cross(theta)
    tt = t @ t
    q = theta @ theta
    s, s_q = _series(q, 1)
    k, k_q = _series(q, 2)
    m, m_q = _series(q, 3)
    one = np.eye(3)
    turn = one + s * t + k * tt
    reach = dt * (one + k * t + m * tt)
    turn_by, shift_by = np.empty((3, 3, 3)), np.empty((3, 3))
    for i in range(3):
        e = _cross(one[i])
        both = e @ t + t @ e
        along = 2.0 * theta[i]
        turn_by[i] = -dt * (along * (s_q * t + k_q * tt) + s * e + k * both)
        shift_by[:, i] = (-dt * dt * (along * (k_q * t + m_q * tt) + k * e + m * both)) @ velocity
    return turn, reach @ velocity, reach, turn_by, shift_by


def arc(omega_radps: Floats, velocity_mps: Floats, dt_s: float) -> Arc:
    """The motion over an interval in which ω [3] and v [3], in camera axes, are constant."""
    return Arc(*arc_of(np.ascontiguousarray(omega_radps), np.ascontiguousarray(velocity_mps), float(dt_s)))


@_jit
def linearise_all(model, mean, turn, shift, reach, turn_by, shift_by, a, g):  # type: ignore[no-untyped-def]
    """Predict `mean` [n, 3] in place; fill A = ∂X'/∂X [n, 3, 3] and G = ∂X'/∂(Δω, Δv) [n, 3, 6], camera axes.

    The true velocities are the measured ones minus their errors, so G is minus the derivative by the velocities.
    What comes behind the camera, or quite beside it, is NaN. A ξ below 0, a landmark "beyond infinity", stays one.
    """
    f, cx, cy = model.focal_px, model.centre_x_px, model.centre_y_px
    ray, slope, d = np.ones(3), np.empty((3, 9)), np.empty(3)
    for i in range(len(mean)):
        xi = mean[i, 2]
        ray[0], ray[1] = (mean[i, 0] - cx) / f, (mean[i, 1] - cy) / f
        h = turn @ ray - xi * shift
        if not h[2] > BESIDE * np.sqrt(h @ h):
            mean[i], a[i], g[i] = np.nan, np.nan, np.nan
            continue
        slope[:, 0], slope[:, 1], slope[:, 2] = turn[:, 0] / f, turn[:, 1] / f, -shift
        for j in range(3):
            slope[:, 3 + j] = xi * shift_by[:, j] - turn_by[j] @ ray
            slope[:, 6 + j] = xi * reach[:, j]
        over = 1.0 / h[2]
        u, v, ahead = h[0] * over, h[1] * over, xi * over
        mean[i, 0], mean[i, 1], mean[i, 2] = cx + f * u, cy + f * v, ahead
        for j in range(9):
            d[0] = f * over * (slope[0, j] - u * slope[2, j])
            d[1] = f * over * (slope[1, j] - v * slope[2, j])
            d[2] = -ahead * over * slope[2, j]
            if j == 2:
                d[2] += over
            if j < 3:
                a[i, :, j] = d
            else:
                g[i, :, j - 3] = d


@_jit
def linearise_inputs(model, mean, arc, columns, a, g, all_six):  # type: ignore[no-untyped-def]
    """`linearise_all` with G by the inputs' errors [n, 3, c], whose `columns` are [6, c]; room for `all_six`."""
    linearise_all(model, mean, arc[0], arc[1], arc[2], arc[3], arc[4], a, all_six)
    for i in range(len(mean)):
        for r in range(3):
            for c in range(columns.shape[1]):
                g[i, r, c] = 0.0
                for j in range(6):
                    g[i, r, c] += all_six[i, r, j] * columns[j, c]


def predicted(model: Model, mean: Floats, motion: Arc) -> tuple[Floats, Floats, Floats]:
    """State ahead [n, 3], A [n, 3, 3] and G [n, 3, 6] of landmarks [n, 3]; NaN for those that came behind."""
    ahead, a, g = mean.copy(), np.empty((len(mean), 3, 3)), np.empty((len(mean), 3, 6))
    linearise_all(model, ahead, *motion, a, g)
    return ahead, a, g


@_jit
def _carry(model, aligned, mean, pairs, dt, omega, velocity, columns, q, turn, shift, a, g):  # type: ignore[no-untyped-def]
    n, others, inputs = pairs.shape[0], pairs.shape[1], columns.shape[1]
    half, all_six = np.empty((3, 3)), np.empty((n, 3, 6))
    for k in range(len(dt)):
        arc = arc_of(omega[k], velocity[k], dt[k])
        turn[:], shift[:] = arc[0] @ turn, arc[0] @ shift - arc[1]
        if aligned:
            joint.linearise_all(model, mean, omega[k, 1], velocity[k, 2], dt[k], a, g)
        else:
            linearise_inputs(model, mean, arc, columns, a, g, all_six)
        for i in range(n):
            for at in range(1 if others == 1 else i + 1):
                j = i if others == 1 else at
                block = pairs[i, at]
                for r in range(3):
                    for c in range(3):
                        half[r, c] = a[i, r, 0] * block[0, c] + a[i, r, 1] * block[1, c] + a[i, r, 2] * block[2, c]
                for r in range(3):
                    for c in range(3):
                        value = half[r, 0] * a[j, c, 0] + half[r, 1] * a[j, c, 1] + half[r, 2] * a[j, c, 2]
                        for m in range(inputs):
                            value += g[i, r, m] * q[k, m] * g[j, c, m]
                        block[r, c] = value
                if j == i:
                    for r in range(3):
                        for c in range(r):
                            block[r, c] = block[c, r]
                else:
                    pairs[j, i] = block.T


class Carried(NamedTuple):
    """Landmarks and the camera after some intervals.

    Attributes:
        mean: X⁻ [n, 3]; NaN for what came behind the camera.
        pairs: P⁻ of each landmark with each other [n, n, 3, 3], or with itself alone [n, 1, 3, 3].
        turn: where the camera looks: a fixed point P of the first frame's axes is at `turn` P + `shift_m` [3, 3].
        shift_m: [3].
        transition: A of the last interval [n, 3, 3]; NaN without one.
        noise_gain: G of it [n, 3, c].
    """

    mean: Floats
    pairs: Floats
    turn: Floats
    shift_m: Floats
    transition: Floats
    noise_gain: Floats


def carried(
    model: Model,
    mean: Floats,
    pairs: Floats,
    turn: Floats,
    shift_m: Floats,
    *,
    dt: Floats,
    omega: Floats,
    velocity: Floats,
    columns: Floats,
    q: Floats,
    aligned: bool,
) -> Carried:
    """The prediction (23), (24) over m intervals: P⁻ = A P Aᵀ + G (Q_c / dt) Gᵀ in each.

    Args:
        model: settings and camera.
        mean: X [n, 3].
        pairs: P, see `Carried`.
        turn: see `Carried`.
        shift_m: see `Carried`.
        dt: lengths of the intervals [m], s.
        omega: angular velocity of the camera in its axes [m, 3].
        velocity: velocity of the camera in its axes [m, 3].
        columns: how the inputs err, (Δω, Δv) in camera axes [6, c].
        q: their variances, the diagonal of Q_c / dt [m, c].
        aligned: take ω_y and v_z only, in the forms of the equations that the model names; `columns` are these two.
    """
    n = len(mean)
    out = Carried(
        mean.copy(),
        pairs.copy(),
        turn.copy(),
        shift_m.copy(),
        np.full((n, 3, 3), np.nan),
        np.full((n, 3, columns.shape[1]), np.nan),
    )
    _carry(model, aligned, out.mean, out.pairs, dt, omega, velocity, columns, q, *out[2:])
    return out
