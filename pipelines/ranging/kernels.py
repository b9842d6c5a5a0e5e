"""The compiled range filter: one predict and update of one landmark, of a bank of them, and of whole runs.

`advance` is the filter; the kernels differ in what they keep of it. A bank's state is an array [9, n]: rows x, y
(px), ξ (1/m) and the upper triangle of P row by row. A NaN image point means that none was measured.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pipelines.ranging import equations as eq
from pipelines.ranging.equations import Correction, Covariance, Held, NoiseGain, Point, Transition
from pipelines.ranging.settings import (
    EXACT,
    FIRST_ORDER,
    GAIN_FIRST_ORDER,
    GAIN_PLUS_CENTRE,
    RK4,
    Model,
)

Floats = NDArray[np.float64]
Longs = NDArray[np.int64]

PREDICTED, UPDATED, REJECTED, RESET, LOST = range(5)
"""What became of a landmark in a step; LOST: it passed behind the camera, or its state is not finite."""

STATE = 9
HISTORY = 11
"""Columns of a history: the state, NIS, outcome."""
RECORD = 60
"""Columns of a record; see `filter.Update`."""

_jit: Any = njit(cache=True, nogil=True, error_model="numpy")
_inlined: Any = njit(cache=True, nogil=True, error_model="numpy", inline="always")

NO_POINT = Point(math.nan, math.nan, math.nan)
NO_CORRECTION = Correction(
    (math.nan, math.nan, math.nan, math.nan, math.nan, math.nan),
    (math.nan, math.nan, math.nan),
    math.nan,
    math.nan,
    (math.nan, math.nan, math.nan),
    Covariance(math.nan, math.nan, math.nan, math.nan, math.nan, math.nan),
)


class Linearised(NamedTuple):
    """A predicted state and the derivatives of the prediction."""

    point: Point
    a: Transition
    g: NoiseGain


class Advance(NamedTuple):
    """One predict and update of one landmark: everything that was computed."""

    prior: Point
    prior_covariance: Covariance
    a: Transition
    g: NoiseGain
    du: float
    dv: float
    nis: float
    correction: Correction
    outcome: int
    rejections: int
    point: Point
    covariance: Covariance


@_jit
def linearised(model: Model, p: Point, h: Held) -> Linearised:
    """The prediction and its derivatives in the forms that the model names."""
    f = model.focal_px
    if model.flow == EXACT:
        ahead = eq.exact_flow(p, h, f)
    elif model.flow == RK4:
        ahead = eq.rk4_flow(p, h, f)
    else:
        ahead = eq.euler_flow(p, h, f)
    if model.transition == EXACT:
        a = eq.exact_transition(p, h, f)
    elif model.transition == FIRST_ORDER:
        a = eq.first_order_transition(p, h, f)
    else:
        a = eq.transition_as_printed(p, h, f)
    if model.noise_gain == EXACT:
        g = eq.exact_noise_gain(p, h, f)
    else:
        u = p.u + 2.0 * model.centre_x_px if model.noise_gain >= GAIN_PLUS_CENTRE else p.u
        g = eq.continuous_noise_gain(p, f, u * u)
        if model.noise_gain == GAIN_FIRST_ORDER or model.noise_gain == GAIN_PLUS_CENTRE:
            g = eq.times(g, h.dt)
    return Linearised(ahead, a, g)


@_jit
def relinearised(
    model: Model,
    p: Point,
    covariance: Covariance,
    h: Held,
    q_omega: float,
    q_speed: float,
    u: float,
    v: float,
    variance: float,
) -> Linearised:
    """The prediction, linearised where the measurement (u, v) says that state and inputs were.

    Each pass smooths the last state s and the input errors q with the measurement, ŝ = x̂ + P Aᵀ Hᵀ S⁻¹ ν and
    q̂ = (Q_c / dt) Gᵀ Hᵀ S⁻¹ ν, and linearises there: Ψ(ŝ, q̂) + A (x̂ - ŝ) - G q̂. Gauss-Newton over one interval.
    """
    out: Linearised = linearised(model, p, h)
    for _ in range(model.relinearisations):
        ahead = eq.covariance_ahead(covariance, out.a, out.g, q_omega, q_speed)
        du, dv = u - out.point.u, v - out.point.v
        sxx, syy = ahead.xx + variance, ahead.yy + variance
        over = 1.0 / (sxx * syy - ahead.xy * ahead.xy)
        wu, wv = (syy * du - ahead.xy * dv) * over, (sxx * dv - ahead.xy * du) * over
        a, g = out.a, out.g
        lu, lv, lk = a.xx * wu + a.yx * wv, a.yy * wv, a.xk * wu + a.yk * wv
        su = covariance.xx * lu + covariance.xy * lv + covariance.xk * lk
        sv = covariance.xy * lu + covariance.yy * lv + covariance.yk * lk
        sk = covariance.xk * lu + covariance.yk * lv + covariance.kk * lk
        dw, ds = q_omega * (g.xw * wu + g.yw * wv), q_speed * (g.xv * wu + g.yv * wv)
        smoothed = linearised(model, Point(p.u + su, p.v + sv, p.xi + sk), eq.held(h.omega - dw, h.speed - ds, h.dt))
        a, g, s = smoothed.a, smoothed.g, smoothed.point
        out = Linearised(
            Point(
                s.u - a.xx * su - a.xk * sk - g.xw * dw - g.xv * ds,
                s.v - a.yx * su - a.yy * sv - a.yk * sk - g.yw * dw - g.yv * ds,
                s.xi - a.kx * su - a.kk * sk - g.kw * dw - g.kv * ds,
            ),
            a,
            g,
        )
    return out


@_inlined
def advance(
    model: Model,
    p: Point,
    covariance: Covariance,
    rejections: int,
    h: Held,
    q_omega: float,
    q_speed: float,
    u: float,
    v: float,
    variance: float,
) -> Advance:
    """Predict (23), (24), gate, and update (25)-(27) one landmark with the image point (u, v), NaN for none."""
    step = linearised(model, p, h)
    ahead = eq.covariance_ahead(covariance, step.a, step.g, q_omega, q_speed)
    du, dv = u - step.point.u, v - step.point.v
    if not (step.point.xi > 0.0 and step.point.xi < math.inf and p.xi > 0.0):
        none = NO_CORRECTION
        return Advance(
            step.point, ahead, step.a, step.g, du, dv, math.nan, none, LOST, rejections, NO_POINT, none.covariance
        )
    if not (math.isfinite(du) and math.isfinite(dv)):
        none = NO_CORRECTION
        floored = Point(step.point.u, step.point.v, min(max(step.point.xi, model.xi_floor), model.xi_ceiling))
        return Advance(step.point, ahead, step.a, step.g, du, dv, math.nan, none, PREDICTED, rejections, floored, ahead)
    nis = eq.nis_of(ahead, du, dv, variance)
    if nis <= model.gate and model.relinearisations > 0:
        step = relinearised(model, p, covariance, h, q_omega, q_speed, u, v, variance)
        ahead = eq.covariance_ahead(covariance, step.a, step.g, q_omega, q_speed)
        du, dv = u - step.point.u, v - step.point.v
    c = eq.correct(ahead, du, dv, variance)
    after, outcome, point = c.covariance, UPDATED, step.point
    if nis <= model.gate:
        rejections = 0
        point = Point(point.u + c.shift[0], point.v + c.shift[1], point.xi + c.shift[2])
    else:
        rejections += 1
        outcome, after = REJECTED, ahead
        if rejections == model.reset_after:
            rejections, outcome = 0, RESET
            point = Point(u, v, point.xi)
            after = Covariance(variance, 0.0, 0.0, variance, 0.0, widened(model, ahead.kk))
    point = Point(point.u, point.v, min(max(point.xi, model.xi_floor), model.xi_ceiling))
    return Advance(step.point, ahead, step.a, step.g, du, dv, nis, c, outcome, rejections, point, after)


@_jit
def widened(model: Model, variance: float) -> float:
    """P_ξξ after a reset: at most the square of the largest ξ, beyond which P says nothing and loses its digits."""
    return min(variance * model.reset_factor, model.xi_ceiling**2)


@_jit
def advance_bank(
    model: Model,
    state: Floats,
    rejections: Longs,
    omega: float,
    speed: float,
    dt: float,
    still: bool,
    pixel: Floats,
    variance: Floats,
    nis: Floats,
    outcome: Longs,
) -> None:
    """Predict and update all landmarks in place.

    Args:
        model: settings and camera.
        state: of the landmarks [9, n].
        rejections: in a row so far [n].
        omega: ω̃ over the interval, rad/s.
        speed: Ṽ over the interval, m/s.
        dt: length of the interval, s; 0 for an update without a prediction.
        still: the camera stands, so V = 0 without error.
        pixel: image points [2, n].
        variance: of an image point's coordinate [n], px².
        nis: room for the NIS [n].
        outcome: room for what became of each [n].
    """
    h = eq.held(omega, 0.0 if still else speed, dt)
    q_omega, q_speed = _variances(model, dt, still)
    cx, cy = model.centre_x_px, model.centre_y_px
    for i in range(state.shape[1]):
        p = Point(state[0, i] - cx, state[1, i] - cy, state[2, i])
        covariance = Covariance(state[3, i], state[4, i], state[5, i], state[6, i], state[7, i], state[8, i])
        done = advance(
            model,
            p,
            covariance,
            rejections[i],
            h,
            q_omega,
            q_speed,
            pixel[0, i] - cx,
            pixel[1, i] - cy,
            variance[i],
        )
        state[0, i], state[1, i], state[2, i] = done.point.u + cx, done.point.v + cy, done.point.xi
        after = done.covariance
        state[3, i], state[4, i], state[5, i] = after.xx, after.xy, after.xk
        state[6, i], state[7, i], state[8, i] = after.yy, after.yk, after.kk
        rejections[i], nis[i], outcome[i] = done.rejections, done.nis, done.outcome


@_jit
def advance_runs(
    model: Model,
    start: Floats,
    omega: Floats,
    speed: Floats,
    dt: Floats,
    still: NDArray[np.bool_],
    pixel: Floats,
    variance: float,
    history: Floats,
) -> None:
    """One landmark through m intervals in each of n runs.

    Args:
        model: settings and camera.
        start: state before the first interval [n, 9].
        omega: ω̃ of each interval [n, m], rad/s.
        speed: Ṽ of each interval [n, m], m/s.
        dt: lengths of the intervals [m], s.
        still: intervals in which the camera stands [n, m].
        pixel: image point after each interval [n, m, 2], NaN for none.
        variance: of an image point's coordinate, px².
        history: room for state, NIS and outcome after each interval [n, m, 11].
    """
    cx, cy = model.centre_x_px, model.centre_y_px
    for i in range(omega.shape[0]):
        p = Point(start[i, 0] - cx, start[i, 1] - cy, start[i, 2])
        covariance = Covariance(start[i, 3], start[i, 4], start[i, 5], start[i, 6], start[i, 7], start[i, 8])
        rejections = 0
        for k in range(omega.shape[1]):
            h = eq.held(omega[i, k], 0.0 if still[i, k] else speed[i, k], dt[k])
            q_omega, q_speed = _variances(model, dt[k], still[i, k])
            u, v = pixel[i, k, 0] - cx, pixel[i, k, 1] - cy
            done = advance(model, p, covariance, rejections, h, q_omega, q_speed, u, v, variance)
            p, covariance, rejections = done.point, done.covariance, done.rejections
            row = history[i, k]
            row[0], row[1], row[2] = p.u + cx, p.v + cy, p.xi
            row[3], row[4], row[5] = covariance.xx, covariance.xy, covariance.xk
            row[6], row[7], row[8] = covariance.yy, covariance.yk, covariance.kk
            row[9], row[10] = done.nis, done.outcome


@_jit
def _variances(model: Model, dt: float, still: bool) -> tuple[float, float]:
    """The diagonal of Q_c / dt (24), rad²/s² and m²/s²; 0 for an empty interval, and for V of a camera that stands."""
    if dt <= 0.0:
        return 0.0, 0.0
    return model.q_omega / dt, 0.0 if still else model.q_speed / dt


@_jit
def _put_symmetric(row: Floats, at: int, p: Covariance) -> None:
    row[at], row[at + 1], row[at + 2] = p.xx, p.xy, p.xk
    row[at + 3], row[at + 4], row[at + 5] = p.xy, p.yy, p.yk
    row[at + 6], row[at + 7], row[at + 8] = p.xk, p.yk, p.kk


@_jit
def advance_recorded(
    model: Model,
    state: Floats,
    rejections: Longs,
    omega: float,
    speed: float,
    dt: float,
    still: bool,
    pixel: Floats,
    variance: Floats,
    record: Floats,
) -> None:
    """`advance_bank`, keeping everything: `record` [n, RECORD] is filled, `state` [9, n] and `rejections` go on."""
    h = eq.held(omega, 0.0 if still else speed, dt)
    q_omega, q_speed = _variances(model, dt, still)
    cx, cy = model.centre_x_px, model.centre_y_px
    for i in range(state.shape[1]):
        p = Point(state[0, i] - cx, state[1, i] - cy, state[2, i])
        covariance = Covariance(state[3, i], state[4, i], state[5, i], state[6, i], state[7, i], state[8, i])
        u, v = pixel[0, i] - cx, pixel[1, i] - cy
        done = advance(model, p, covariance, rejections[i], h, q_omega, q_speed, u, v, variance[i])
        row, a, g, c = record[i], done.a, done.g, done.correction
        row[0], row[1], row[2] = done.prior.u + cx, done.prior.v + cy, done.prior.xi
        _put_symmetric(row, 3, done.prior_covariance)
        row[12], row[13], row[14] = a.xx, 0.0, a.xk
        row[15], row[16], row[17] = a.yx, a.yy, a.yk
        row[18], row[19], row[20] = a.kx, 0.0, a.kk
        row[21], row[22], row[23], row[24], row[25], row[26] = g.xw, g.xv, g.yw, g.yv, g.kw, g.kv
        row[27], row[28] = done.du, done.dv
        row[29], row[30], row[31], row[32] = c.spread[0], c.spread[1], c.spread[1], c.spread[2]
        for j in range(6):
            row[33 + j] = c.gain[j]
        row[39], row[40], row[41] = done.nis, c.log_likelihood, done.outcome
        row[42], row[43], row[44] = done.point.u + cx, done.point.v + cy, done.point.xi
        after = done.covariance
        _put_symmetric(row, 45, after)
        row[54], row[55], row[56], row[57], row[58] = h.omega, h.speed, dt, q_omega, q_speed
        row[59] = done.rejections
        state[0, i], state[1, i], state[2, i] = row[42], row[43], row[44]
        state[3, i], state[4, i], state[5, i] = after.xx, after.xy, after.xk
        state[6, i], state[7, i], state[8, i] = after.yy, after.yk, after.kk
        rejections[i] = done.rejections
