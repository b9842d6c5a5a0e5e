"""A joint range filter: N landmarks with one error q = (Δω, ΔV) of the inputs in every interval.

All landmarks see the same wrong speeds, so their predictions err together. A filter that knows this learns the
speeds' errors from all of them. The state is that of all landmarks, x, y, ξ each, and P [3N, 3N] is full; it costs
O(N²) in the prediction and O(N³) in the update, for some tens of landmarks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pipelines.ranging import equations as eq
from pipelines.ranging.equations import Point
from pipelines.ranging.filter import Inputs
from pipelines.ranging.kernels import LOST, PREDICTED, REJECTED, RESET, UPDATED, linearised, widened
from pipelines.ranging.settings import Model
from pipelines.ranging.start import Start

Floats = NDArray[np.float64]
Longs = NDArray[np.int64]

_jit: Any = njit(cache=True, nogil=True, error_model="numpy")


@dataclass(frozen=True, slots=True)
class Joint:
    """The state: mean [N, 3], covariance [3N, 3N], rejections in a row [N]."""

    mean: Floats
    covariance: Floats
    rejections: Longs

    @classmethod
    def of(cls, starts: Sequence[Start]) -> Joint:
        """Landmarks at the start, independent of each other."""
        n = len(starts)
        covariance = np.zeros((3 * n, 3 * n))
        for i, start in enumerate(starts):
            covariance[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = start.covariance
        return cls(np.array([s.state for s in starts]).reshape(n, 3), covariance, np.zeros(n, np.int64))

    def __len__(self) -> int:
        return len(self.mean)

    @property
    def blocks(self) -> Floats:
        """Covariance of each landmark by itself [N, 3, 3]."""
        n = len(self)
        at = np.arange(n)
        return np.asarray(self.covariance.reshape(n, 3, n, 3)[at, :, at, :])

    def and_also(self, start: Start) -> Joint:
        """These landmarks and a new one, independent of them."""
        n = 3 * len(self)
        covariance = np.zeros((n + 3, n + 3))
        covariance[:n, :n], covariance[n:, n:] = self.covariance, start.covariance
        return Joint(np.vstack([self.mean, start.state]), covariance, np.append(self.rejections, 0))

    def only(self, chosen: Longs) -> Joint:
        """Some of these landmarks, by number."""
        rows = (3 * chosen[:, None] + np.arange(3)).ravel()
        return Joint(self.mean[chosen], self.covariance[np.ix_(rows, rows)], self.rejections[chosen])


class JointUpdate(NamedTuple):
    """Everything that one step computed.

    Attributes:
        prior: X⁻ [N, 3].
        prior_covariance: P⁻ [3N, 3N].
        transition: A of each landmark [N, 3, 3].
        noise_gain: G of each landmark [N, 3, 2].
        innovation: z - H X⁻ [N, 2], px.
        nis: of each landmark by itself, before any update: what the gate looks at [N].
        joint_nis: of all accepted image points together.
        joint_degrees: degrees of freedom of `joint_nis`.
        outcome: `filter.Outcome` [N].
        input_error: what the image points say of (Δω, ΔV) in this interval [2], rad/s, m/s.
        input_covariance: of it [2, 2].
    """

    prior: Floats
    prior_covariance: Floats
    transition: Floats
    noise_gain: Floats
    innovation: Floats
    nis: Floats
    joint_nis: float
    joint_degrees: int
    outcome: Longs
    input_error: Floats
    input_covariance: Floats


def step(model: Model, joint: Joint, inputs: Inputs, pixel: Floats, variance: Floats) -> tuple[Joint, JointUpdate]:
    """Carry all landmarks over an interval and update them with the image points at its end.

    A landmark that comes behind the camera is LOST: its rows are NaN from then on, the others go on; `Joint.only`
    takes it out.

    Args:
        model: settings and camera; relinearisation is not for the joint filter.
        joint: at the start of the interval.
        inputs: speeds over the interval.
        pixel: measured image points [N, 2] float64, NaN where there is none.
        variance: of an image point's coordinate [N] float64, px².

    Raises:
        ValueError: the interval is negative.
    """
    n = len(joint)
    if not inputs.dt >= 0.0:
        raise ValueError(f"an interval must not be negative: dt = {inputs.dt} s; sort the samples by time")
    mean, rejections = joint.mean.copy(), joint.rejections.copy()
    covariance = np.zeros((3 * n + 2, 3 * n + 2))
    covariance[: 3 * n, : 3 * n] = joint.covariance
    a, g = np.empty((n, 3, 3)), np.empty((n, 3, 2))
    speed = 0.0 if inputs.still else inputs.speed
    q = np.zeros(2)
    if inputs.dt > 0.0:
        q[:] = model.q_omega / inputs.dt, 0.0 if inputs.still else model.q_speed / inputs.dt
    linearise_all(model, mean, inputs.omega, speed, inputs.dt, a, g)
    blocks_ahead(covariance, a, g, q)
    _append_inputs(covariance, g, q)
    prior, prior_covariance = mean.copy(), covariance[: 3 * n, : 3 * n].copy()
    innovation = pixel - prior[:, :2]
    nis, outcome, error = np.full(n, np.nan), np.zeros(n, np.int64), np.zeros(2)
    total, degrees = _update_all(model, mean, covariance, rejections, pixel, variance, nis, outcome, error)
    update = JointUpdate(
        prior, prior_covariance, a, g, innovation, nis, total, degrees, outcome, error, covariance[3 * n :, 3 * n :]
    )
    return Joint(mean, covariance[: 3 * n, : 3 * n].copy(), rejections), update


@_jit
def linearise_all(model: Model, mean: Floats, omega: float, speed: float, dt: float, a: Floats, g: Floats) -> bool:
    """Predict `mean` [N, 3] in place, and fill A [N, 3, 3] and G [N, 3, 2].

    Returns False if a landmark comes behind the camera; what belongs to it is NaN.
    """
    h, ahead = eq.held(omega, speed, dt), True
    for i in range(len(mean)):
        p = Point(mean[i, 0] - model.centre_x_px, mean[i, 1] - model.centre_y_px, mean[i, 2])
        out = linearised(model, p, h)
        if not (p.xi * out.point.xi > 0.0 and np.isfinite(out.point.xi)):
            mean[i], a[i], g[i], ahead = np.nan, np.nan, np.nan, False
            continue
        mean[i, 0], mean[i, 1] = out.point.u + model.centre_x_px, out.point.v + model.centre_y_px
        mean[i, 2] = out.point.xi
        t, w = out.a, out.g
        a[i, 0, 0], a[i, 0, 1], a[i, 0, 2] = t.xx, 0.0, t.xk
        a[i, 1, 0], a[i, 1, 1], a[i, 1, 2] = t.yx, t.yy, t.yk
        a[i, 2, 0], a[i, 2, 1], a[i, 2, 2] = t.kx, 0.0, t.kk
        g[i, 0, 0], g[i, 0, 1], g[i, 1, 0], g[i, 1, 1], g[i, 2, 0], g[i, 2, 1] = w.xw, w.xv, w.yw, w.yv, w.kw, w.kv
    return ahead


@_jit
def blocks_ahead(covariance: Floats, a: Floats, g: Floats, q: Floats) -> None:
    """P_ij ← A_i P_ij A_jᵀ + G_i (Q_c / dt) G_jᵀ for all landmarks, in place; q is the diagonal of Q_c / dt [c]."""
    half = np.empty((3, 3))
    for i in range(len(a)):
        for j in range(i + 1):
            for r in range(3):
                for c in range(3):
                    half[r, c] = 0.0
                    for k in range(3):
                        half[r, c] += a[i, r, k] * covariance[3 * i + k, 3 * j + c]
            for r in range(3):
                for c in range(3):
                    value = 0.0
                    for k in range(len(q)):
                        value += g[i, r, k] * q[k] * g[j, c, k]
                    for k in range(3):
                        value += half[r, k] * a[j, c, k]
                    covariance[3 * i + r, 3 * j + c] = value
                    covariance[3 * j + c, 3 * i + r] = value


@_jit
def _append_inputs(covariance: Floats, g: Floats, q: Floats) -> None:
    """Fill the last two rows and columns: covariance of the landmarks with q, G (Q_c / dt), and of q."""
    n = 3 * len(g)
    for k in range(2):
        covariance[n + k, n + k] = q[k]
        for i in range(n):
            covariance[i, n + k] = covariance[n + k, i] = g[i // 3, i % 3, k] * q[k]


@_jit
def rank_two_update(
    mean: Floats, covariance: Floats, at: int, du: float, dv: float, variance: float, gain: Floats, inverse: Floats
) -> float:
    """Update with an image point of which elements `at`, `at` + 1 are the prediction; returns the NIS.

    Args:
        mean: [d]; updated.
        covariance: [d, d]; updated.
        at: row of the image point's x.
        du: innovation in x, px.
        dv: innovation in y, px.
        variance: of the coordinates, px².
        gain: room for K [d, 2].
        inverse: room for S⁻¹ [2, 2].
    """
    d = len(mean)
    sxx, sxy, syy = covariance[at, at] + variance, covariance[at, at + 1], covariance[at + 1, at + 1] + variance
    over = 1.0 / (sxx * syy - sxy * sxy)
    inverse[0, 0], inverse[1, 1] = syy * over, sxx * over
    inverse[0, 1] = inverse[1, 0] = -sxy * over
    for i in range(d):
        gain[i, 0] = covariance[i, at] * inverse[0, 0] + covariance[i, at + 1] * inverse[1, 0]
        gain[i, 1] = covariance[i, at] * inverse[0, 1] + covariance[i, at + 1] * inverse[1, 1]
        mean[i] += gain[i, 0] * du + gain[i, 1] * dv
    row, next_row = covariance[at].copy(), covariance[at + 1].copy()
    for i in range(d):
        for j in range(i + 1):
            value = covariance[i, j] - gain[i, 0] * row[j] - gain[i, 1] * next_row[j]
            covariance[i, j] = value
            covariance[j, i] = value
    return float(du * (inverse[0, 0] * du + inverse[0, 1] * dv) + dv * (inverse[1, 0] * du + inverse[1, 1] * dv))


@_jit
def _update_all(
    model: Model,
    mean: Floats,
    covariance: Floats,
    rejections: Longs,
    pixel: Floats,
    variance: Floats,
    nis: Floats,
    outcome: Longs,
    input_error: Floats,
) -> tuple[float, int]:
    """Gate every image point by itself, then update with those that pass, one after the other."""
    n, d = len(mean), covariance.shape[0]
    joint, gain, inverse = np.zeros(d), np.empty((d, 2)), np.empty((2, 2))
    for i in range(n):
        at = 3 * i
        du, dv = pixel[i, 0] - mean[i, 0], pixel[i, 1] - mean[i, 1]
        if not (np.isfinite(du) and np.isfinite(dv)):
            outcome[i] = PREDICTED if np.isfinite(mean[i, 2]) else LOST
            continue
        p = eq.Covariance(
            covariance[at, at], covariance[at, at + 1], 0.0, covariance[at + 1, at + 1], 0.0, covariance[at + 2, at + 2]
        )
        nis[i] = eq.nis_of(p, du, dv, variance[i])
        if nis[i] <= model.gate:
            outcome[i], rejections[i] = UPDATED, 0
        else:
            outcome[i] = REJECTED
            rejections[i] += 1
    total, degrees = 0.0, 0
    for i in range(n):
        if outcome[i] == UPDATED:
            at = 3 * i
            # `joint` is how far the state moved so far from the prediction
            du = pixel[i, 0] - mean[i, 0] - joint[at]
            dv = pixel[i, 1] - mean[i, 1] - joint[at + 1]
            total += rank_two_update(joint, covariance, at, du, dv, variance[i], gain, inverse)
            degrees += 2
    for i in range(n):
        at = 3 * i
        for k in range(3):
            mean[i, k] += joint[at + k]
        if outcome[i] == REJECTED and rejections[i] == model.reset_after:
            outcome[i], rejections[i] = RESET, 0
            mean[i, 0], mean[i, 1] = pixel[i, 0], pixel[i, 1]
            kept = widened(model, covariance[at + 2, at + 2])
            covariance[at : at + 3, :] = 0.0
            covariance[:, at : at + 3] = 0.0
            covariance[at, at] = covariance[at + 1, at + 1] = variance[i]
            covariance[at + 2, at + 2] = kept
        if outcome[i] != LOST:
            mean[i, 2] = min(max(mean[i, 2], model.xi_floor), model.xi_ceiling)
    input_error[0], input_error[1] = joint[3 * n], joint[3 * n + 1]
    return total, degrees
