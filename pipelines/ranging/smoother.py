"""Batch estimate of a whole mission: the most probable path of N landmarks and of the inputs' errors.

Unknowns are the landmarks' states where they start and the inputs' errors q_k in every interval; the states between
follow from them by the exact flow. Gauss-Newton with a line search minimises

    J = Σ ‖X_start - X̂_start‖²_{P_start} + Σ_k ‖q_k‖²_{Q_c/dt} + Σ ‖z - H X(X_start, q)‖²_R.

The normal equations are banded; each step solves them exactly in time linear in the number of frames, as a linear
smoother about the current path: a Kalman filter forwards, the modified Bryson-Frazier recursion backwards
(G. J. Bierman, 1973), which needs no inverse of a predicted covariance. All image points are used at all frames, so
this is the most accurate answer after a mission, and the measure for every filter.

Landmarks come and go: each has a life in one of N slots, from the frame where it starts to its last image point. The
lives in a slot follow one another; what starts is independent of what was there before.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pipelines.ranging import ego_motion, joint
from pipelines.ranging.joint import Joint, blocks_ahead, rank_two_update
from pipelines.ranging.settings import Model

Floats = NDArray[np.float64]
Longs = NDArray[np.int64]

_jit: Any = njit(cache=True, nogil=True, error_model="numpy")

SHORTEST_STEP = 1e-4

BEHIND = "the start lies behind the camera on the way: give a farther range at the start"


@dataclass(frozen=True, slots=True, kw_only=True)
class Drive:
    """The camera's measured motion over F frames and the m intervals between them; camera axes.

    Attributes:
        dt: lengths [m], s.
        omega: angular velocities [m, 3], rad/s.
        velocity: velocities [m, 3], m/s.
        columns: how the c inputs err, (Δω, Δv) [6, c].
        q: their variances, the diagonal of Q_c / dt [m, c]; 0: no error.
        upto: number of intervals up to each frame [F], from 0, not falling.
        aligned: ω_y and v_z only, in the forms of the equations that the model names; `columns` are these two.
    """

    dt: Floats
    omega: Floats
    velocity: Floats
    columns: Floats
    q: Floats
    upto: Longs
    aligned: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class Lives:
    """What is known of b lives of landmarks in N slots, in the order of their starts.

    Attributes:
        slot: where each is [b].
        born: frame of its start [b], not falling.
        last: its last frame [b]; lives in one slot do not overlap.
        mean: X̂ at the start [b, 3].
        covariance: P there [b, 3, 3].
        pixel: image points at each frame [F, N, 2], NaN where there is none, or where a gate rejected it.
        variance: of their coordinates [F, N], px².
    """

    slot: Longs
    born: Longs
    last: Longs
    mean: Floats
    covariance: Floats
    pixel: Floats
    variance: Floats


@dataclass(frozen=True, slots=True)
class Smoothed:
    """The most probable path.

    Attributes:
        mean: states at each frame [F, N, 3], NaN in an empty slot; F = m + 1 where every interval ends at a frame.
        covariance: of each landmark at each frame [F, N, 3, 3].
        input_error: of the inputs in each interval [m, c], (Δω, Δv) times their columns, rad/s, m/s.
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
    """Smooth a mission of landmarks that are there from its first frame to its last, by ω_y and V_z.

    Args:
        model: settings and camera.
        start: prior at the first frame, N landmarks, independent of each other.
        omega: ω̃ of each interval [m], rad/s.
        speed: Ṽ of each interval [m], m/s.
        dt: lengths of the intervals [m], s.
        pixel: image points after each interval [m, N, 2], NaN where there is none, or where a gate rejected it.
        variance: of an image point's coordinate [N], px².
        still: intervals in which the camera stands [m]; default: none.
        max_iterations: of Gauss-Newton.
        tolerance: it ends where J falls by less.

    Raises:
        ValueError: shapes that do not fit, intervals that are not positive, or landmarks that are not independent.
    """
    m, n = len(omega), len(start)
    if pixel.shape != (m, n, 2) or speed.shape != (m,) or dt.shape != (m,) or variance.shape != (n,):
        raise ValueError(f"{m} intervals and {n} landmarks need speed ({m},), dt ({m},), pixel ({m}, {n}, 2)")
    if not (dt > 0.0).all():
        raise ValueError("every interval must be positive: join intervals of no length with their neighbours")
    blocks = start.blocks
    if np.count_nonzero(start.covariance) > np.count_nonzero(blocks):
        raise ValueError("the landmarks must be independent at the start: smooth from where they start")
    stands = np.zeros(m, np.bool_) if still is None else still
    columns = np.zeros((6, 2))
    columns[1, 0] = columns[5, 1] = 1.0
    drive = Drive(
        dt=dt,
        omega=omega[:, None] * columns[:3, 0],
        velocity=np.where(stands, 0.0, speed)[:, None] * columns[3:, 1],
        columns=columns,
        q=np.stack([model.q_omega / dt, np.where(stands, 0.0, model.q_speed / dt)], axis=1),
        upto=np.arange(m + 1),
        aligned=True,
    )
    lives = Lives(
        slot=np.arange(n),
        born=np.zeros(n, np.int64),
        last=np.full(n, m),
        mean=start.mean,
        covariance=blocks,
        pixel=np.concatenate([np.full((1, n, 2), np.nan), pixel]),
        variance=np.broadcast_to(variance, (m + 1, n)),
    )
    if not (start.mean[:, 2] > 0.0).all():
        raise ValueError(BEHIND)
    return most_probable(model, drive, lives, start.mean, max_iterations=max_iterations, tolerance=tolerance)


def most_probable(
    model: Model,
    drive: Drive,
    lives: Lives,
    first: Floats,
    error: Floats | None = None,
    *,
    max_iterations: int = 30,
    tolerance: float = 1e-6,
    on_pass: Callable[[], None] | None = None,
) -> Smoothed:
    """The most probable path of a mission; it takes `memory_bytes`.

    Args:
        model: settings and camera.
        drive: how the camera moved.
        lives: the landmarks.
        first: states at the starts from which the search goes out [b, 3].
        error: the inputs' errors from which it goes out [m, c]; default: none.
        max_iterations: of Gauss-Newton.
        tolerance: it ends where J falls by less.
        on_pass: called before each pass over the mission; what it raises ends the search.

    Raises:
        ValueError: a landmark comes behind the camera on the way from `first`.
    """
    first, error = first.copy(), np.zeros(drive.q.shape) if error is None else error.copy()
    way = _way(model, drive, lives, first, error)
    cost = _cost(drive, lives, first, error, way)
    if not np.isfinite(cost):
        raise ValueError(BEHIND)
    iterations, converged = 0, False
    while iterations < max_iterations and not converged:
        iterations += 1
        if on_pass is not None:
            on_pass()
        shift, change = _step(drive, lives, error, way, _NOTHING)
        length, reached = 2.0, np.inf
        while not reached <= cost and length > SHORTEST_STEP:
            length *= 0.5
            trial = first + length * shift, error + length * change
            ahead = _way(model, drive, lives, *trial)
            reached = _cost(drive, lives, *trial, ahead)
        if not reached <= cost:
            converged = bool(np.isfinite(reached))
            break
        converged = cost - reached < tolerance
        (first, error), way, cost = trial, ahead, reached
    covariance = np.zeros((*lives.pixel.shape[:2], 9))
    if on_pass is not None:
        on_pass()
    _step(drive, lives, error, way, covariance)
    covariance[np.isnan(way.path[..., 2])] = np.nan
    return Smoothed(way.path, covariance.reshape(*way.path.shape, 3), error, cost, iterations, converged)


def start_about(model: Model, drive: Drive, lives: Lives, about: Floats) -> tuple[Floats, Floats]:
    """Where to search from: states at the starts [b, 3] and errors of the inputs [m, c], by one step from a path.

    Args:
        model: settings and camera.
        drive: how the camera moved.
        lives: the landmarks.
        about: a path [F, N, 3] that the speeds need not lead along, such as a filter's; any value in empty slots.

    Raises:
        ValueError: a landmark comes behind the camera between two frames of that path.
    """
    first, error = about[lives.born, lives.slot], np.zeros(drive.q.shape)
    way = _way(model, drive, lives, first, error, about)
    if way.behind >= 0:
        raise ValueError(BEHIND)
    shift, change = _step(drive, lives, error, way, _NOTHING)
    return first + shift, error + change


def behind(model: Model, drive: Drive, lives: Lives, first: Floats, error: Floats) -> int:
    """Which life comes first behind the camera on the way from `first` [b, 3] with errors [m, c]; -1: none."""
    return _way(model, drive, lives, first, error).behind


def memory_bytes(frames: int, intervals: int, slots: int, inputs: int) -> int:
    """The most that `most_probable` takes: P and the gains (3N)² F 8 (1 + 2/3), A and G of two paths, what it gives."""
    return 8 * (15 * slots**2 * frames + 2 * (9 + 3 * inputs) * slots * intervals + 35 * slots * frames)


class _Way(NamedTuple):
    """A path, with A and G, and the life that comes behind the camera (-1: none); `defect` where it jumps."""

    path: Floats
    a: Floats
    g: Floats
    defect: Floats
    behind: int


_NOTHING = np.empty((0, 0, 0))


def _way(model: Model, drive: Drive, lives: Lives, first: Floats, error: Floats, about: Floats = _NOTHING) -> _Way:
    """The path from `first` with errors of the inputs, or that about a path."""
    (frames, n), (m, c) = lives.pixel.shape[:2], drive.q.shape
    path, a, g = np.full((frames, n, 3), np.nan), np.zeros((m, n, 3, 3)), np.zeros((m, n, 3, c))
    defect = np.zeros(about.shape)
    lost = _roll_out(
        model, drive.aligned, drive.dt, drive.omega, drive.velocity, drive.columns, drive.upto,
        lives.slot, lives.born, lives.last, first, error, about, path, a, g, defect,
    )  # fmt: skip
    return _Way(path, a, g, defect, int(lost))


def _cost(drive: Drive, lives: Lives, first: Floats, error: Floats, way: _Way) -> float:
    """J; infinite where a landmark comes behind the camera."""
    if way.behind >= 0:
        return np.inf
    off = first - lives.mean
    misfit = np.nansum((lives.pixel - way.path[..., :2]) ** 2 / lives.variance[..., None])
    drift = np.where(drive.q > 0.0, error**2 / np.where(drive.q > 0.0, drive.q, 1.0), 0.0).sum()
    return float(np.einsum("bi,bij,bj", off, np.linalg.inv(lives.covariance), off) + misfit + drift)


def _step(drive: Drive, lives: Lives, error: Floats, way: _Way, covariance: Floats) -> tuple[Floats, Floats]:
    """The Gauss-Newton step of the states at the starts [b, 3] and of the inputs' errors [m, c]."""
    shift, change = np.empty_like(lives.mean), np.empty(drive.q.shape)
    _linear_smoother(
        way.path, way.a, way.g, drive.q, error, lives.pixel, lives.variance, drive.upto, lives.slot, lives.born,
        lives.mean, lives.covariance, way.defect, shift, change, covariance,
    )  # fmt: skip
    return shift, change


@_jit
def _roll_out(
    model: Model,
    aligned: bool,
    dt: Floats,
    omega: Floats,
    velocity: Floats,
    columns: Floats,
    upto: Longs,
    slot: Longs,
    born: Longs,
    last: Longs,
    first: Floats,
    error: Floats,
    about: Floats,
    path: Floats,
    a: Floats,
    g: Floats,
    defect: Floats,
) -> int:
    """Fill `path` [F, N, 3], A and G, 0 in empty slots; gives which life comes behind the camera, -1 for none.

    Where `about` [F, N, 3] has room, the path is that one, and `defect` [F, N, 3] is how far the flow from the frame
    before ends from it.
    """
    n = path.shape[1]
    state, life, begun = np.full((n, 3), np.nan), np.full(n, -1), 0
    turn, shift, six = np.empty(3), np.empty(3), np.empty((n, 3, 6))
    for f in range(len(path)):
        for i in range(n):
            if life[i] >= 0 and last[life[i]] < f:
                life[i] = -1
                for r in range(3):
                    state[i, r] = np.nan
        for k in range(upto[f - 1] if f else 0, upto[f]):
            for r in range(3):
                turn[r], shift[r] = omega[k, r], velocity[k, r]
                for c in range(columns.shape[1]):
                    turn[r] -= columns[r, c] * error[k, c]
                    shift[r] -= columns[3 + r, c] * error[k, c]
            if aligned:
                joint.linearise_all(model, state, turn[1], shift[2], dt[k], a[k], g[k])
            else:
                ego_motion.linearise_inputs(
                    model, state, ego_motion.arc_of(turn, shift, dt[k]), columns, a[k], g[k], six
                )
            for i in range(n):
                if life[i] < 0:
                    a[k, i] = 0.0
                    g[k, i] = 0.0
                elif not np.isfinite(state[i, 2]):
                    return int(life[i])
        for i in range(n if len(about) else 0):
            for r in range(3):
                defect[f, i, r] = state[i, r] - about[f, i, r] if life[i] >= 0 else 0.0
                state[i, r] = about[f, i, r] if life[i] >= 0 else np.nan
        while begun < len(born) and born[begun] == f:
            life[slot[begun]] = begun
            for r in range(3):
                state[slot[begun], r] = first[begun, r]
            begun += 1
        _copy(state, path[f])
    return -1


@_jit
def _linear_smoother(
    path: Floats,
    a: Floats,
    g: Floats,
    q: Floats,
    error: Floats,
    pixel: Floats,
    variance: Floats,
    upto: Longs,
    slot: Longs,
    born: Longs,
    prior: Floats,
    prior_covariance: Floats,
    defect: Floats,
    shift: Floats,
    change: Floats,
    covariance: Floats,
) -> None:
    """The Gauss-Newton step about `path`: fills `shift` [b, 3] of the first states and `change` [m, c] of q.

    Where `covariance` [F, N, 9] has room it is filled as well; a path with jumps has a `defect` [F, N, 3].
    """
    frames, n, inputs = path.shape[0], path.shape[1], q.shape[1]
    d = 3 * n
    gain, inverse, innovation = np.zeros((frames, n, d, 2)), np.empty((frames, n, 2, 2)), np.empty((frames, n, 2))
    wanted = covariance.shape[0] > 0
    known = np.empty((frames if wanted else 0, d, d))
    p, mean, moved = np.zeros((d, d)), np.zeros(d), np.empty(3)
    off, begun = np.empty((len(born), 3)), 0
    for f in range(frames):
        for k in range(upto[f - 1] if f else 0, upto[f]):
            for i in range(n):
                for r in range(3):
                    moved[r] = 0.0
                    for c in range(inputs):
                        moved[r] -= g[k, i, r, c] * error[k, c]
                    for c in range(3):
                        moved[r] += a[k, i, r, c] * mean[3 * i + c]
                for r in range(3):
                    mean[3 * i + r] = moved[r]
            blocks_ahead(p, a[k], g[k], q[k])
        for i in range(n if len(defect) else 0):
            for r in range(3):
                mean[3 * i + r] += defect[f, i, r]
        while begun < len(born) and born[begun] == f:
            at = 3 * slot[begun]
            _empty(p, at)
            for r in range(3):
                off[begun, r] = mean[at + r] = prior[begun, r] - path[f, slot[begun], r]
                for c in range(3):
                    p[at + r, at + c] = prior_covariance[begun, r, c]
            begun += 1
        for i in range(n):
            at = 3 * i
            du = pixel[f, i, 0] - path[f, i, 0] - mean[at]
            dv = pixel[f, i, 1] - path[f, i, 1] - mean[at + 1]
            innovation[f, i, 0], innovation[f, i, 1] = du, dv
            if np.isfinite(du) and np.isfinite(dv):
                rank_two_update(mean, p, at, du, dv, variance[f, i], gain[f, i], inverse[f, i])
        if wanted:
            _copy(p, known[f])
    back, inside = np.zeros(d), np.zeros((d, d))
    old, turned, no_gain, no_error = np.empty(3), np.empty((n, 3, 3)), np.zeros((n, 3, inputs)), np.zeros(inputs)
    for f in range(frames - 1, -1, -1):
        if wanted:
            _put_blocks(known[f], inside, covariance[f])
        for i in range(n - 1, -1, -1):
            du, dv = innovation[f, i, 0], innovation[f, i, 1]
            if np.isfinite(du) and np.isfinite(dv):
                s = inverse[f, i]
                for r in range(2):
                    down = 0.0
                    for c in range(d):
                        down += gain[f, i, c, r] * back[c]
                    old[r] = -s[r, 0] * du - s[r, 1] * dv - down
                back[3 * i] += old[0]
                back[3 * i + 1] += old[1]
                if wanted:
                    _information_through_update(inside, gain[f, i], s, 3 * i)
        while begun > 0 and born[begun - 1] == f:
            begun -= 1
            at = 3 * slot[begun]
            for r in range(3):
                shift[begun, r] = off[begun, r]
                for c in range(3):
                    shift[begun, r] -= prior_covariance[begun, r, c] * back[at + c]
            for r in range(3):
                back[at + r] = 0.0
            if wanted:
                _empty(inside, at)
        for k in range(upto[f] - 1, (upto[f - 1] if f else 0) - 1, -1):
            for c in range(inputs):
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


@_jit
def _empty(p: Floats, at: int) -> None:
    """Rows and columns `at` to `at` + 2 become 0."""
    for r in range(at, at + 3):
        for c in range(len(p)):
            p[r, c] = p[c, r] = 0.0


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
