"""Compiled kernels of the correlation odometry: correlation surface, peaks, subpixel refinement, rigid fit.

Image axes: u along columns, v along rows; arrays are indexed [v, u]. A shift d is the motion of the image
content from the template frame to the current frame. No kernel uses fast-math, so the same input gives the
same bits on every machine. Equation numbers are those of paper A.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pipelines.correlation.equations import centre_shift, rotation_between_frames

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]
Grey = NDArray[np.uint8]

TAPS = 12
"""Taps of the cardinal quintic spline, renormalised to 1; with more of them the S-curve is no smaller."""
POLE = 3.0**0.5 - 2.0
"""Pole of the cubic B-spline's prefilter."""
PREFILTER_MARGIN = 6
"""Pixels around a patch after which the prefilter has forgotten the border (POLE^6 = 4e-4)."""
ZERO, ONE, TWO, THREE = np.uint64(0), np.uint64(1), np.uint64(2), np.uint64(3)
FOUR, FIVE, SIX = np.uint64(4), np.uint64(5), np.uint64(6)
"""Indices of inner loops are unsigned: signed ones cost a test for a negative index, and keep loops from vectors."""
MEDIAN_FROM = 5
"""A running median counts from this many values on."""
QUANTISATION = 0.3
"""Least noise of a match in grey levels: rounding to whole levels, 1/sqrt(12)."""
HILL_PX = 2
"""Positions this close to the first peak belong to its hill and are no second peak."""

_BASIS_5 = np.array([66.0, 26.0, 1.0] + [0.0] * 251 + [1.0, 26.0]) / 120.0
_CARDINAL = np.roll(np.fft.ifft(1.0 / np.fft.fft(_BASIS_5)).real, TAPS)[: 2 * TAPS + 1]
"""Impulse response of the quintic B-spline's prefilter, from -TAPS to TAPS."""


class Matches(NamedTuple):
    """What the matching of F fragments yields; the fields of `CorrelationStep` by the same names.

    All but `surface` [F, M, M] and `hessian` [F, 2, 2] are views of one block [F, VALUES], because handing an
    array between Python and compiled code costs a microsecond.
    """

    surface: Floats32
    hessian: Floats
    peak_px: Floats
    peak_correlation: Floats
    second_peak_px: Floats
    second_peak_correlation: Floats
    peak_ratio: Floats
    peak_curvature: Floats
    peak_anisotropy: Floats
    delta_px: Floats
    delta_length_px: Floats
    condition: Floats
    smallest_eigenvalue: Floats
    sigma_px: Floats
    iterations: Floats
    gain: Floats
    offset: Floats
    residual_rms: Floats
    gradient: Floats
    mean_grey: Floats
    shift_px: Floats
    weight: Floats
    fit_residual_px: Floats
    block: Floats


VALUES = 27
"""Columns of the block behind `Matches`."""


class Fit(NamedTuple):
    """A similarity (rotation, scale, shift) through the shifts of fragments.

    `shift_u`, `shift_v` is m₀ (px) at the image centre; `weight` [F] the robust weights, 0 for outliers;
    `residual` [F, 2] (px); `covariance` [3, 3] of (m₀_u, m₀_v, rotation) in px and rad.
    """

    shift_u: float
    shift_v: float
    rotation_rad: float
    scale: float
    weight: Floats
    residual: Floats
    inliers: int
    covariance: Floats


_jit: Any = njit(cache=True, nogil=True, error_model="numpy")


def matches_of(surface: Floats32, hessian: Floats, block: Floats) -> Matches:
    """The named views of a block; the same for Python and for compiled code."""
    return Matches(
        surface,
        hessian,
        block[:, 0:2],
        block[:, 2],
        block[:, 3:5],
        block[:, 5],
        block[:, 6],
        block[:, 7],
        block[:, 8],
        block[:, 9:11],
        block[:, 11],
        block[:, 12],
        block[:, 13],
        block[:, 14:16],
        block[:, 16],
        block[:, 17],
        block[:, 18],
        block[:, 19],
        block[:, 20],
        block[:, 21],
        block[:, 22:24],
        block[:, 24],
        block[:, 25:27],
        block,
    )


_matches_of = _jit(matches_of)


def new_matches(count: int, radius: int) -> Matches:
    """Room for the matches of `count` fragments, for a kernel to fill."""
    surface = np.empty((count, 2 * radius + 1, 2 * radius + 1), np.float32)
    return matches_of(surface, np.empty((count, 2, 2)), np.empty((count, VALUES)))


def no_matches(count: int, radius: int) -> Matches:
    """Matches of `count` fragments in which nothing was found: all NaN."""
    matches = new_matches(count, radius)
    for array in (matches.surface, matches.hessian, matches.block):
        array[:] = np.nan
    return matches


# ------------------------------------------------------------------------- patches and splines


@_jit
def _copy_window(image, top, left, out):  # type: ignore[no-untyped-def]
    """Copy the pixels from (top, left) on into `out`; beyond the border the border pixel repeats."""
    height, width = image.shape
    rows, columns = out.shape
    inside = top >= 0 and left >= 0 and top + rows <= height and left + columns <= width
    for y in range(rows):
        if inside:
            source = image[top + y, left : left + columns]
            target = out[y]
            for x in range(columns):
                target[x] = source[x]
        else:
            v = min(max(top + y, 0), height - 1)
            for x in range(columns):
                out[y, x] = image[v, min(max(left + x, 0), width - 1)]


@_jit
def _spline_columns(a):  # type: ignore[no-untyped-def]
    """Prefilter each column in place: samples → cubic B-spline coefficients (constant beyond the ends)."""
    rows, columns = a.shape
    pole = np.float32(POLE)
    first = np.float32(1.0 / (1.0 - POLE))
    last = np.float32(-POLE / (1.0 - POLE))
    six = np.float32(6.0)
    for x in range(columns):
        a[0, x] *= first
    for y in range(1, rows):
        before, row = a[y - 1], a[y]
        for x in range(columns):
            row[x] += pole * before[x]
    for x in range(columns):
        a[rows - 1, x] *= last
    for y in range(rows - 2, -1, -1):
        after, row = a[y + 1], a[y]
        for x in range(columns):
            row[x] = pole * (after[x] - row[x])
    for y in range(rows):
        row = a[y]
        for x in range(columns):
            row[x] *= six


@_jit
def spline_half(side):  # type: ignore[no-untyped-def]
    """Half-size of the coefficient patch that serves a fragment of that side at any rotation."""
    return int(np.ceil((side - 1) / 2 * 1.4143)) + 2 + PREFILTER_MARGIN


@_jit
def spline_patches(image, centres, side):  # type: ignore[no-untyped-def]
    """Cubic B-spline coefficients around each centre, float32 [S, S, lanes], S = 2 · spline_half + 1.

    `centres` int64 [F, 2] (u, v). The spline through the pixels is then known at every real position. The
    fragments are the last axis, padded to whole vectors: all are sampled at the same places, one per lane.
    """
    half = spline_half(side)
    size = 2 * half + 1
    count = centres.shape[0]
    patches = np.zeros((size, size, (count + 7) // 8 * 8), np.float32)
    turned = np.empty((size, size), np.float32)
    patch = np.empty((size, size), np.float32)
    for i in range(count):
        _copy_window(image, centres[i, 1] - half, centres[i, 0] - half, turned)
        _spline_columns(turned)
        for y in range(size):
            for x in range(size):
                patch[x, y] = turned[y, x]
        _spline_columns(patch)
        for y in range(size):
            for x in range(size):
                patches[y, x, i] = patch[x, y]
    return patches


@_jit
def _basis(f):  # type: ignore[no-untyped-def]
    """Cubic B-spline weights of the four taps around a position, and their derivatives."""
    g = np.float32(1.0) - f
    sixth, half = np.float32(1.0 / 6.0), np.float32(0.5)
    three, four, six = np.float32(3.0), np.float32(4.0), np.float32(6.0)
    w0, w1, w3 = g * g * g * sixth, (three * f * f * f - six * f * f + four) * sixth, f * f * f * sixth
    d0, d1, d3 = -half * g * g, (three * f * f - four * f) * half, half * f * f
    return w0, w1, np.float32(1.0) - w0 - w1 - w3, w3, d0, d1, -d0 - d1 - d3, d3


@_jit
def templates(coefficients, side, rotation_rad):  # type: ignore[no-untyped-def]
    """Sample every fragment, turned by `rotation_rad`, with its gradient in the turned axes.

    T(q) = I(p + R(-ψ) q): the content of the template frame as it looks after a rotation by ψ. Returns float32
    [3, N, N, lanes]: grey levels, slope along u, slope along v.
    """
    half = (side - 1) // 2
    middle = np.float32((coefficients.shape[0] - 1) // 2)
    lanes = coefficients.shape[2]
    cos, sin = np.float32(np.cos(rotation_rad)), np.float32(np.sin(rotation_rad))
    sampled = np.zeros((3, side, side, lanes), np.float32)
    width = np.uint64(lanes)
    for y in range(side):
        qv, row = np.float32(y - half), np.uint64(y)
        for x in range(side):
            qu, column = np.float32(x - half), np.uint64(x)
            u, v = middle + cos * qu + sin * qv, middle - sin * qu + cos * qv
            iu, iv = int(u), int(v)
            u0, u1, u2, u3, e0, e1, e2, e3 = _basis(u - np.float32(iu))
            v0, v1, v2, v3, f0, f1, f2, f3 = _basis(v - np.float32(iv))
            left = np.uint64(iu - 1)
            for k in range(4):
                wv = v0 if k == 0 else (v1 if k == 1 else (v2 if k == 2 else v3))
                dv = f0 if k == 0 else (f1 if k == 1 else (f2 if k == 2 else f3))
                line = np.uint64(iv - 1 + k)
                for lane in range(width):
                    c0, c1 = coefficients[line, left, lane], coefficients[line, left + ONE, lane]
                    c2, c3 = coefficients[line, left + TWO, lane], coefficients[line, left + THREE, lane]
                    along = (u0 * c0 + u1 * c1) + (u2 * c2 + u3 * c3)
                    slope = (e0 * c0 + e1 * c1) + (e2 * c2 + e3 * c3)
                    sampled[ZERO, row, column, lane] += wv * along
                    sampled[ONE, row, column, lane] += wv * slope
                    sampled[TWO, row, column, lane] += dv * along
            for lane in range(width):
                gu, gv = sampled[ONE, row, column, lane], sampled[TWO, row, column, lane]
                sampled[ONE, row, column, lane] = cos * gu - sin * gv
                sampled[TWO, row, column, lane] = sin * gu + cos * gv
    return sampled


@_jit
def _basis_5(t):  # type: ignore[no-untyped-def]
    """The quintic B-spline."""
    t = abs(t)
    if t < 1.0:
        return 11.0 / 20.0 - t**2 / 2.0 + t**4 / 4.0 - t**5 / 12.0
    if t < 2.0:
        return 17.0 / 40.0 + 5.0 * t / 8.0 - 7.0 * t**2 / 4.0 + 5.0 * t**3 / 4.0 - 3.0 * t**4 / 8.0 + t**5 / 24.0
    return (3.0 - t) ** 5 / 120.0 if t < 3.0 else 0.0


@_jit
def _cardinal_weights(fraction, weights):  # type: ignore[no-untyped-def]
    """Weights of the TAPS pixels around a position, `fraction` after the (TAPS/2)th of them (quintic spline)."""
    basis = (
        _basis_5(fraction + 2.0),
        _basis_5(fraction + 1.0),
        _basis_5(fraction),
        _basis_5(fraction - 1.0),
        _basis_5(fraction - 2.0),
        _basis_5(fraction - 3.0),
    )
    total = 0.0
    first = 1 - TAPS // 2
    for k in range(TAPS):
        w = 0.0
        for m in range(6):
            w += basis[m] * _CARDINAL[TAPS + k + first - (m - 2)]
        weights[k] = w
        total += w
    for k in range(TAPS):
        weights[k] /= total


@_jit
def _shifted(image, u, v, work, out, lane):  # type: ignore[no-untyped-def]
    """Sample the N x N pixels around the real position (u, v) by the cubic spline through the image.

    Fills one lane of `out` [N, N, lanes].

    All pixels share one subpixel fraction, so the spline is a separable filter of TAPS taps.
    """
    side = out.shape[0]
    half = (side - 1) // 2
    window, row, target = work.window, work.row, work.line
    weights_u, weights_v = work.weights_u, work.weights_v
    iu, iv = int(np.floor(u)), int(np.floor(v))
    _cardinal_weights(u - iu, weights_u)
    _cardinal_weights(v - iv, weights_v)
    before = TAPS // 2 - 1
    _copy_window(image, iv - half - before, iu - half - before, window)
    # whole vectors: what lies beyond the fragment is computed and left
    width, padded, size = np.uint64(window.shape[1]), np.uint64(len(target)), np.uint64(side)
    for y in range(size):
        for x in range(width):
            row[x] = 0.0
        for k in range(ZERO, np.uint64(TAPS), SIX):
            w0, w1, w2 = np.float32(weights_v[k]), np.float32(weights_v[k + ONE]), np.float32(weights_v[k + TWO])
            w3, w4 = np.float32(weights_v[k + THREE]), np.float32(weights_v[k + FOUR])
            w5 = np.float32(weights_v[k + FIVE])
            for x in range(width):
                near = w2 * window[y + k + TWO, x] + w3 * window[y + k + THREE, x]
                far = w0 * window[y + k, x] + w5 * window[y + k + FIVE, x]
                row[x] += near + far + (w1 * window[y + k + ONE, x] + w4 * window[y + k + FOUR, x])
        for x in range(padded):
            target[x] = 0.0
        for k in range(ZERO, np.uint64(TAPS), SIX):
            w0, w1, w2 = np.float32(weights_u[k]), np.float32(weights_u[k + ONE]), np.float32(weights_u[k + TWO])
            w3, w4 = np.float32(weights_u[k + THREE]), np.float32(weights_u[k + FOUR])
            w5 = np.float32(weights_u[k + FIVE])
            for x in range(padded):
                near = w2 * row[x + k + TWO] + w3 * row[x + k + THREE]
                far = w0 * row[x + k] + w5 * row[x + k + FIVE]
                target[x] += near + far + (w1 * row[x + k + ONE] + w4 * row[x + k + FOUR])
        for x in range(size):
            out[y, x, lane] = target[x]


# ---------------------------------------------------------------- 1. integer shift (2), (3)


@_jit
def correlation_surface(template, image, u, v, radius, surface):  # type: ignore[no-untyped-def]
    """Normalised correlation coefficient of `template` [N, N] at every shift up to `radius` around (u, v).

    surface[j, i] = Σ (T - T̄)(W - W̄) / sqrt(Σ (T - T̄)² Σ (W - W̄)²) with W the window of the image whose
    centre is (u + i - radius, v + j - radius); NaN where it leaves the image, 0 where either is flat.
    """
    side = template.shape[0]
    half = (side - 1) // 2
    positions = 2 * radius + 1
    padded = (positions + 7) // 8 * 8
    size = side + 2 * radius
    height, width = image.shape

    pixels = np.empty((size, size), np.int32)
    _copy_window(image, v - half - radius, u - half - radius, pixels)
    grey = np.zeros((size, side + padded + 8), np.float32)
    middle = pixels[size // 2, size // 2]
    for y in range(size):
        for x in range(size):
            grey[y, x] = pixels[y, x] - middle

    n = side * side
    mean = 0.0
    for y in range(side):
        for x in range(side):
            mean += template[y, x]
    mean /= n
    centred = np.empty((side, side), np.float32)
    energy = 0.0
    for y in range(side):
        for x in range(side):
            c = template[y, x] - mean
            centred[y, x] = c
            energy += c * c

    column = np.zeros(size, np.int64)
    column_sq = np.zeros(size, np.int64)
    for y in range(side):
        for x in range(size):
            p = np.int64(pixels[y, x])
            column[x] += p
            column_sq[x] += p * p
    total = np.empty(padded, np.float32)
    spread = np.empty(padded, np.float32)
    lanes, taps = np.uint64(padded), np.uint64(side)
    for j in range(positions):
        for x in range(lanes):
            total[x] = 0.0
        for y in range(taps):
            line = np.uint64(j) + y
            k = ZERO
            while k + THREE <= taps:
                t0, t1, t2 = centred[y, k], centred[y, k + ONE], centred[y, k + TWO]
                for x in range(lanes):
                    total[x] += t0 * grey[line, x + k] + t1 * grey[line, x + k + ONE] + t2 * grey[line, x + k + TWO]
                k += THREE
            while k < taps:
                t0 = centred[y, k]
                for x in range(lanes):
                    total[x] += t0 * grey[line, x + k]
                k += ONE
        box, box_sq = np.int64(0), np.int64(0)
        for x in range(side - 1):
            box += column[x]
            box_sq += column_sq[x]
        for i in range(positions):
            box += column[i + side - 1]
            box_sq += column_sq[i + side - 1]
            spread[i] = energy * ((box_sq * n - box * box) / n)
            box -= column[i]
            box_sq -= column_sq[i]
        row = surface[j]
        for i in range(positions):
            # a flat window or template has no correlation
            row[i] = total[i] / np.sqrt(spread[i]) if spread[i] > np.float32(1e-3) else np.float32(0.0)
        top = v + j - radius - half
        if top < 0 or top + side > height:
            row[:] = np.nan
        for i in range(min(max(half + radius - u, 0), positions)):
            row[i] = np.nan
        for i in range(max(width - side + half + radius - u + 1, 0), positions):
            row[i] = np.nan
        if j + 1 < positions:
            for x in range(size):
                new, old = np.int64(pixels[j + side, x]), np.int64(pixels[j, x])
                column[x] += new - old
                column_sq[x] += new * new - old * old


@_jit
def _is_hilltop(surface, j, i):  # type: ignore[no-untyped-def]
    """Whether no neighbour of a position is higher."""
    size = surface.shape[0]
    for y in range(max(j - 1, 0), min(j + 2, size)):
        for x in range(max(i - 1, 0), min(i + 2, size)):
            if surface[y, x] > surface[j, i]:
                return False
    return True


@_jit
def find_peaks(surface, ambiguity):  # type: ignore[no-untyped-def]
    """The peak of a surface, and the highest local maximum outside its hill.

    The peak is the highest position; of local maxima that are lower by at most `ambiguity` it is the one nearest
    to the middle, that is, to the prediction. Returns (row, column, value, second row, second column, second
    value); rows of -1 where there is none.
    """
    size = surface.shape[0]
    best_j, best_i, best = -1, -1, -2.0
    for j in range(size):
        for i in range(size):
            if surface[j, i] > best:
                best_j, best_i, best = j, i, surface[j, i]
    if ambiguity > 0.0 and best_j >= 0:
        middle, least = size // 2, best - ambiguity
        nearest = (best_j - middle) ** 2 + (best_i - middle) ** 2
        for j in range(size):
            for i in range(size):
                distance = (j - middle) ** 2 + (i - middle) ** 2
                if surface[j, i] >= least and distance < nearest and _is_hilltop(surface, j, i):
                    best_j, best_i, best, nearest = j, i, surface[j, i], distance
    second_j, second_i, second = -1, -1, -2.0
    for j in range(size):
        for i in range(size):
            beside = abs(j - best_j) <= HILL_PX and abs(i - best_i) <= HILL_PX
            if surface[j, i] > second and not beside and _is_hilltop(surface, j, i):
                second_j, second_i, second = j, i, surface[j, i]
    return best_j, best_i, best, second_j, second_i, second


@_jit
def peak_shape(surface, j, i):  # type: ignore[no-untyped-def]
    """Quadric through the 3 x 3 positions around a peak.

    Returns (δu, δv, smaller curvature, anisotropy): the vertex of the quadric within ±1 px, the smaller
    principal curvature (1/px²) and the ratio of the principal curvatures; NaN at the border of the surface
    or where the quadric has no maximum.
    """
    size = surface.shape[0]
    nan = np.nan
    if j < 1 or i < 1 or j >= size - 1 or i >= size - 1:
        return nan, nan, nan, nan
    s = surface[j - 1 : j + 2, i - 1 : i + 2].astype(np.float64)
    gu = (s[0, 2] + s[1, 2] + s[2, 2] - s[0, 0] - s[1, 0] - s[2, 0]) / 6.0
    gv = (s[2, 0] + s[2, 1] + s[2, 2] - s[0, 0] - s[0, 1] - s[0, 2]) / 6.0
    columns = s[0] + s[1] + s[2]
    huu = (columns[0] - 2.0 * columns[1] + columns[2]) / 3.0
    hvv = (s[0, 0] + s[0, 1] + s[0, 2] - 2.0 * (s[1, 0] + s[1, 1] + s[1, 2]) + s[2, 0] + s[2, 1] + s[2, 2]) / 3.0
    huv = (s[0, 0] + s[2, 2] - s[0, 2] - s[2, 0]) / 4.0
    mean, spread = (huu + hvv) / 2.0, np.sqrt((huu - hvv) ** 2 / 4.0 + huv * huv)
    flat, steep = -(mean + spread), -(mean - spread)
    det = huu * hvv - huv * huv
    if not (flat > 0.0 and det > 0.0):
        return nan, nan, flat, nan
    du = -(hvv * gu - huv * gv) / det
    dv = -(huu * gv - huv * gu) / det
    if abs(du) > 1.0 or abs(dv) > 1.0:
        return nan, nan, flat, steep / flat
    return du, dv, flat, steep / flat


# ------------------------------------------------- 2. subpixel refinement (4)-(9) and beyond


@_jit
def one_step(previous, image, u, v, peak_u, peak_v, side, hessian):  # type: ignore[no-untyped-def]
    """One least-squares step of optical flow (6)-(9) after aligning the fragments by the integer shift.

    I_xy Δ = I_t with I_xy the central differences of the template frame and I_t = I_k(p) - I_{k+1}(p + (m, n)),
    so that Δ is the remaining shift of the content from frame k to frame k+1 (the sign that (6), (7) leave
    open). All sums are integers, hence exact. `hessian` [2, 2] receives I_xyᵀ I_xy in grey²/px².

    Returns (Δu, Δv, rms of I_t - I_xy Δ in grey); Δ is NaN where the system is singular.
    """
    half = (side - 1) // 2
    uu, uv, vv, ut, vt, tt = np.int64(0), np.int64(0), np.int64(0), np.int64(0), np.int64(0), np.int64(0)
    for y in range(v - half, v + half + 1):
        above, row, below = previous[y - 1], previous[y], previous[y + 1]
        other = image[y + peak_v]
        for x in range(u - half, u + half + 1):
            gu = np.int64(row[x + 1]) - np.int64(row[x - 1])
            gv = np.int64(below[x]) - np.int64(above[x])
            it = np.int64(row[x]) - np.int64(other[x + peak_u])
            uu += gu * gu
            uv += gu * gv
            vv += gv * gv
            ut += gu * it
            vt += gv * it
            tt += it * it
    hessian[0, 0], hessian[1, 1] = uu / 4.0, vv / 4.0
    hessian[0, 1] = hessian[1, 0] = uv / 4.0
    det = float(uu) * float(vv) - float(uv) * float(uv)
    if det <= 0.0:
        return np.nan, np.nan, np.sqrt(tt / (side * side))
    du = 2.0 * (float(vv) * float(ut) - float(uv) * float(vt)) / det
    dv = 2.0 * (float(uu) * float(vt) - float(uv) * float(ut)) / det
    remaining = float(tt) - (du * float(ut) + dv * float(vt)) / 2.0
    return du, dv, np.sqrt(max(remaining, 0.0) / (side * side))


class _Scratch(NamedTuple):
    """Work space of the sampling, so that no iteration allocates."""

    window: Floats32
    row: Floats32
    line: Floats32
    weights_u: Floats
    weights_v: Floats


@_jit
def _scratch(side):  # type: ignore[no-untyped-def]
    whole, width = (side + 7) // 8 * 8, (side + TAPS - 1 + 7) // 8 * 8
    return _Scratch(
        np.empty((side + TAPS - 1, width), np.float32),
        np.zeros(max(width, whole + TAPS), np.float32),
        np.empty(whole, np.float32),
        np.empty(TAPS),
        np.empty(TAPS),
    )


MIDDLE_GREY = 128.0
"""Subtracted from grey levels before they are summed, to keep the sums small."""


@_jit
def _template_sums(t):  # type: ignore[no-untyped-def]
    """Sums over a fragment's pixels, per lane: T, U, V, TT, UT, VT, UU, UV, VV (U, V the slopes), float64 [9, lanes].

    Lines are summed in float32, lanes side by side, and joined in float64: always in the same order.
    """
    _, side, _, lanes = t.shape
    sums = np.zeros((9, lanes))
    line = np.empty((9, lanes), np.float32)
    s0, s1, s2, s3, s4 = line[0], line[1], line[2], line[3], line[4]
    s5, s6, s7, s8 = line[5], line[6], line[7], line[8]
    width = np.uint64(lanes)
    middle = np.float32(MIDDLE_GREY)
    for y in range(side):
        line[:] = 0.0
        for x in range(side):
            row, column = np.uint64(y), np.uint64(x)
            for lane in range(width):
                g = t[ZERO, row, column, lane] - middle
                u, v = t[ONE, row, column, lane], t[TWO, row, column, lane]
                s0[lane] += g
                s1[lane] += u
                s2[lane] += v
                s3[lane] += g * g
                s4[lane] += u * g
                s5[lane] += v * g
                s6[lane] += u * u
                s7[lane] += u * v
                s8[lane] += v * v
        for k in range(9):
            for lane in range(lanes):
                sums[k, lane] += line[k, lane]
    return sums


@_jit
def _match_sums(t, sampled, sums):  # type: ignore[no-untyped-def]
    """Sums over a fragment's pixels, per lane: I, II, IT, IU, IV, into float64 [5, lanes]; see `_template_sums`."""
    _, side, _, lanes = t.shape
    sums[:] = 0.0
    line = np.empty((5, lanes), np.float32)
    width = np.uint64(lanes)
    s0, s1, s2, s3, s4 = line[0], line[1], line[2], line[3], line[4]
    middle = np.float32(MIDDLE_GREY)
    for y in range(side):
        line[:] = 0.0
        for x in range(side):
            row, column = np.uint64(y), np.uint64(x)
            for lane in range(width):
                i, g = sampled[row, column, lane] - middle, t[ZERO, row, column, lane] - middle
                s0[lane] += i
                s1[lane] += i * i
                s2[lane] += i * g
                s3[lane] += i * t[ONE, row, column, lane]
                s4[lane] += i * t[TWO, row, column, lane]
        for k in range(5):
            for lane in range(lanes):
                sums[k, lane] += line[k, lane]


@_jit
def refine(t, image, base, delta, gain_and_offset, limit, tolerance, hessian, outcome):  # type: ignore[no-untyped-def]
    """Iterated inverse-compositional refinement of all fragments on a cubic spline.

    Minimises Σ (I(p + d + q) - g T(q) - b)² over the shift d, and over gain g and offset b where asked, for
    each fragment. The gradient is that of the template, so its sums serve all iterations; gain and offset are
    eliminated in closed form. All fragments step together until each step is below `tolerance` (px).

    Args:
        t: float32 [3, N, N, lanes] from `templates`.
        image: uint8 [height, width].
        base: float64 [F, 2], whole-pixel position (u, v) of each fragment in the image; NaN to leave it out.
        delta: float64 [F, 2], the start relative to `base` (px); receives the result, NaN without texture.
        gain_and_offset: whether to estimate gain and offset, else 1 and 0.
        limit: most iterations.
        tolerance: end of the iteration (px).
        hessian: float64 [F, 2, 2], receives I_xyᵀ I_xy of the template (grey²/px²).
        outcome: float64 [F, 5], receives iterations, gain, offset, rms of the residual, mean grey of the match.
    """
    count, side = len(base), t.shape[1]
    n = side * side
    sums = _template_sums(t)
    work = _scratch(side)
    sampled = np.zeros(t.shape[1:], np.float32)
    found = np.empty((5, t.shape[3]))
    active = np.zeros(count, np.bool_)
    inverse = np.empty((count, 3))
    start = delta.copy()
    for i in range(count):
        outcome[i, 0] = 0.0
        if not np.isfinite(base[i, 0] + delta[i, 0]):
            continue
        hessian[i, 0, 0], hessian[i, 1, 1] = sums[6, i], sums[8, i]
        hessian[i, 0, 1] = hessian[i, 1, 0] = sums[7, i]
        uu, uv, vv = sums[6, i], sums[7, i], sums[8, i]
        if gain_and_offset:
            g, u, v = sums[0, i], sums[1, i], sums[2, i]
            gg, ug, vg = sums[3, i] - g * g / n, sums[4, i] - u * g / n, sums[5, i] - v * g / n
            if gg <= 0.0:
                delta[i] = np.nan
                continue
            uu -= u * u / n + ug * ug / gg
            uv -= u * v / n + ug * vg / gg
            vv -= v * v / n + vg * vg / gg
        det = uu * vv - uv * uv
        if not det > 1e-6 * (uu + vv) ** 2 or uu + vv < 1e-3 * n:
            delta[i] = np.nan
            continue
        inverse[i, 0], inverse[i, 1], inverse[i, 2] = vv / det, -uv / det, uu / det
        active[i] = True
    for _ in range(limit):
        if not active.any():
            break
        for i in range(count):
            if active[i]:
                _shifted(image, base[i, 0] + delta[i, 0], base[i, 1] + delta[i, 1], work, sampled, i)
        _match_sums(t, sampled, found)
        for i in range(count):
            if not active[i]:
                continue
            outcome[i, 0] += 1.0
            image_sum, image_sq = found[0, i], found[1, i]
            along, bu, bv = found[2, i], found[3, i], found[4, i]
            g, gg = sums[0, i], sums[3, i]
            gain, offset = 1.0, 0.0
            if gain_and_offset:
                gg -= g * g / n
                along -= image_sum * g / n
                gain = along / gg
                offset = (image_sum - gain * g) / n + MIDDLE_GREY * (1.0 - gain)
                rest = image_sq - image_sum * image_sum / n - gain * gain * gg
                bu -= image_sum * sums[1, i] / n + gain * (sums[4, i] - sums[1, i] * g / n)
                bv -= image_sum * sums[2, i] / n + gain * (sums[5, i] - sums[2, i] * g / n)
            else:
                rest = image_sq - 2.0 * along + gg
                bu -= sums[4, i]
                bv -= sums[5, i]
            outcome[i, 1], outcome[i, 2] = gain, offset
            outcome[i, 3], outcome[i, 4] = np.sqrt(max(rest, 0.0) / n), image_sum / n + MIDDLE_GREY
            if not abs(gain) > 1e-3:
                delta[i] = np.nan
                active[i] = False
                continue
            step_u = (inverse[i, 0] * bu + inverse[i, 1] * bv) / gain
            step_v = (inverse[i, 1] * bu + inverse[i, 2] * bv) / gain
            delta[i, 0] -= step_u
            delta[i, 1] -= step_v
            strayed = max(abs(delta[i, 0] - start[i, 0]), abs(delta[i, 1] - start[i, 1])) > 3.0
            active[i] = not (step_u * step_u + step_v * step_v < tolerance * tolerance or strayed)


@_jit
def _note_peaks(matches, i, centre, search, radius, ambiguity):  # type: ignore[no-untyped-def]
    """Find the peaks of fragment i's surface and note them; False where it is flat or holds no position."""
    surface = matches.surface[i]
    j, k, value, second_j, second_k, second = find_peaks(surface, ambiguity)
    if j < 0 or value <= 0.0:
        return False
    matches.peak_px[i, 0] = search[i, 0] + k - radius - centre[i, 0]
    matches.peak_px[i, 1] = search[i, 1] + j - radius - centre[i, 1]
    matches.peak_correlation[i] = value
    if second_j >= 0:
        matches.second_peak_px[i, 0] = search[i, 0] + second_k - radius - centre[i, 0]
        matches.second_peak_px[i, 1] = search[i, 1] + second_j - radius - centre[i, 1]
        matches.second_peak_correlation[i] = second
        if value > 0.0:
            matches.peak_ratio[i] = second / value
    du, dv, curvature, anisotropy = peak_shape(surface, j, k)
    matches.peak_curvature[i], matches.peak_anisotropy[i] = curvature, anisotropy
    matches.delta_px[i, 0] = 0.0 if np.isnan(du) else du
    matches.delta_px[i, 1] = 0.0 if np.isnan(dv) else dv
    return True


@_jit
def match_one_step(previous, image, centres, search, side, radius, surface, hessian, block):  # type: ignore[no-untyped-def]
    """The paper's steps 1 and 2 for every fragment: correlation peak (2), (3), one flow step (4)-(9).

    `previous`, `image` uint8 [height, width]; `centres`, `search` int64 [F, 2] (u, v): fragment centres in
    the previous frame and centres of the search areas in this one. Fills the arrays of `new_matches`.
    """
    hessian[:] = np.nan
    block[:] = np.nan
    m = _matches_of(surface, hessian, block)
    half = (side - 1) // 2
    n = side * side
    template = np.empty((side, side), np.float32)
    for i in range(centres.shape[0]):
        u, v = centres[i]
        _copy_window(previous, v - half, u - half, template)
        correlation_surface(template, image, search[i, 0], search[i, 1], radius, m.surface[i])
        if not _note_peaks(m, i, centres, search, radius, 0.0):
            continue
        pu, pv = int(m.peak_px[i, 0]), int(m.peak_px[i, 1])
        m.delta_px[i, 0], m.delta_px[i, 1], m.residual_rms[i] = one_step(
            previous, image, u, v, pu, pv, side, m.hessian[i]
        )
        m.iterations[i] = 1
        st, sw, stt, stw = np.int64(0), np.int64(0), np.int64(0), np.int64(0)
        for y in range(v - half, v + half + 1):
            for x in range(u - half, u + half + 1):
                t, w = np.int64(previous[y, x]), np.int64(image[y + pv, x + pu])
                st += t
                sw += w
                stt += t * t
                stw += t * w
        spread = float(n * stt - st * st)
        m.mean_grey[i] = sw / n
        if spread > 0.0:
            m.gain[i] = float(n * stw - st * sw) / spread
            m.offset[i] = (sw - m.gain[i] * st) / n
        _note_texture(m, i, n)


@_jit
def match_iterated(  # type: ignore[no-untyped-def]
    coefficients, image, centres, search, rotation_rad, side, radius, ambiguity, gain_and_offset, limit, tolerance,
    surface, hessian, block,
):  # fmt: skip
    """Correlation peak with the turned templates, then the iterated refinement, for every fragment.

    `coefficients` float32 [S, S, lanes] from `spline_patches`, `ambiguity` as in `find_peaks`; the rest as in
    `match_one_step`.
    """
    hessian[:] = np.nan
    block[:] = np.nan
    m = _matches_of(surface, hessian, block)
    t = templates(coefficients, side, rotation_rad)
    template = np.empty((side, side), np.float32)
    for i in range(len(centres)):
        for y in range(side):
            for x in range(side):
                template[y, x] = t[0, y, x, i]
        correlation_surface(template, image, search[i, 0], search[i, 1], radius, m.surface[i])
        m.iterations[i] = 0
        _note_peaks(m, i, centres, search, radius, ambiguity)
    _refine_matches(m, t, image, centres, gain_and_offset, limit, tolerance)


@_jit
def refine_again(  # type: ignore[no-untyped-def]
    coefficients, image, centres, rotation_rad, side, gain_and_offset, limit, tolerance, surface, hessian, block
):
    """Refine matches once more, from where they are, with templates turned by a better rotation."""
    m = _matches_of(surface, hessian, block)
    t = templates(coefficients, side, rotation_rad)
    _refine_matches(m, t, image, centres, gain_and_offset, limit, tolerance)


@_jit
def _refine_matches(m, t, image, centres, gain_and_offset, limit, tolerance):  # type: ignore[no-untyped-def]
    count, side = len(centres), t.shape[1]
    outcome = np.full((count, 5), np.nan)
    delta = m.delta_px.copy()
    refine(t, image, centres + m.peak_px, delta, gain_and_offset, limit, tolerance, m.hessian, outcome)
    for i in range(count):
        m.delta_px[i] = delta[i]
        m.iterations[i] += outcome[i, 0]
        m.gain[i], m.offset[i], m.residual_rms[i], m.mean_grey[i] = (
            outcome[i, 1], outcome[i, 2], outcome[i, 3], outcome[i, 4]
        )  # fmt: skip
        _note_texture(m, i, side * side)


@_jit
def _note_texture(m, i, pixels):  # type: ignore[no-untyped-def]
    """Note what the Hessian of fragment i says: eigenvalues, σ = sqrt(rms² diag(H⁻¹)), and what follows."""
    h00, h01, h11 = m.hessian[i, 0, 0], m.hessian[i, 0, 1], m.hessian[i, 1, 1]
    mean, spread = (h00 + h11) / 2.0, np.sqrt((h00 - h11) ** 2 / 4.0 + h01 * h01)
    m.gradient[i] = 2.0 * mean / pixels
    m.smallest_eigenvalue[i] = (mean - spread) / pixels
    m.condition[i] = (mean + spread) / (mean - spread) if mean - spread > 0.0 else np.inf
    det = h00 * h11 - h01 * h01
    if det > 0.0:
        rms = max(m.residual_rms[i], QUANTISATION)
        m.sigma_px[i, 0], m.sigma_px[i, 1] = rms * np.sqrt(h11 / det), rms * np.sqrt(h00 / det)
    m.delta_length_px[i] = np.sqrt(m.delta_px[i, 0] ** 2 + m.delta_px[i, 1] ** 2)
    m.shift_px[i, 0], m.shift_px[i, 1] = m.peak_px[i, 0] + m.delta_px[i, 0], m.peak_px[i, 1] + m.delta_px[i, 1]


@_jit
def refine_tiles(  # type: ignore[no-untyped-def]
    coefficients, image, centres, points, shift_u, shift_v, rotation_rad, scale, side, gain_and_offset
):
    """One refinement step of many tiles from a known motion: the photometric step after the fragments.

    `centres` int64 [T, 2] (u, v), `points` [T, 2] the same from the image centre. Returns (shift [T, 2],
    hessian [T, 2, 2], rms [T]); NaN where a tile leaves the image or has no texture.
    """
    count = centres.shape[0]
    height, width = image.shape
    half = (side - 1) // 2
    hessians = np.full((count, 2, 2), np.nan)
    outcome = np.full((count, 5), np.nan)
    base, delta = np.full((count, 2), np.nan), np.full((count, 2), np.nan)
    cos, sin = scale * np.cos(rotation_rad), scale * np.sin(rotation_rad)
    for i in range(count):
        pu, pv = points[i]
        u = cos * pu - sin * pv + shift_u + centres[i, 0] - pu
        v = sin * pu + cos * pv + shift_v + centres[i, 1] - pv
        if u >= half and v >= half and u <= width - 1 - half and v <= height - 1 - half:
            base[i, 0], base[i, 1] = np.floor(u + 0.5), np.floor(v + 0.5)
            delta[i, 0], delta[i, 1] = u - base[i, 0], v - base[i, 1]
    t = templates(coefficients, side, rotation_rad)
    refine(t, image, base, delta, gain_and_offset, 1, 0.0, hessians, outcome)
    return base + delta - centres, hessians, outcome[:, 3].copy()


# --------------------------------------------------------- 3. rigid motion (12), (13), (15)


@_jit
def paper_fit(surface, hessian, block, points, step_limit, gimballed, covariance):  # type: ignore[no-untyped-def]
    """The paper's motion from two fragments, the rear one first: (10)-(13), (15).

    A Δ longer than `step_limit` is rejected, not clipped: the integer shift stands. Notes shift, weight and
    residual in the block; `covariance` [3, 3] of (m_x0, n_y0, Δα) receives that of the fragments' σ, the search
    radius where a fragment has no σ.

    Returns (m_x0, n_y0, Δα, scale); NaN where a fragment has no peak.
    """
    m = _matches_of(surface, hessian, block)
    for i in range(2):
        if not m.delta_length_px[i] <= step_limit:
            m.shift_px[i, 0], m.shift_px[i, 1] = m.peak_px[i, 0], m.peak_px[i, 1]
    distance = points[1, 0] - points[0, 0]
    rear, front = (m.shift_px[0, 0], m.shift_px[0, 1]), (m.shift_px[1, 0], m.shift_px[1, 1])
    u, v = centre_shift(front, rear)
    rotation = 0.0 if gimballed else rotation_between_frames(front[1], rear[1], distance)
    scale = np.sqrt((distance + front[0] - rear[0]) ** 2 + (front[1] - rear[1]) ** 2) / distance
    cos, sin = scale * np.cos(rotation), scale * np.sin(rotation)
    for i in range(2):
        m.weight[i] = 1.0 if np.isfinite(rotation + u) else 0.0
        m.fit_residual_px[i, 0] = points[i, 0] + m.shift_px[i, 0] - (cos * points[i, 0] - sin * points[i, 1] + u)
        m.fit_residual_px[i, 1] = points[i, 1] + m.shift_px[i, 1] - (sin * points[i, 0] + cos * points[i, 1] + v)
    radius = m.surface.shape[1] // 2
    variance = np.empty((2, 2))
    for i in range(2):
        for axis in range(2):
            sigma = m.sigma_px[i, axis]
            variance[i, axis] = sigma * sigma if np.isfinite(sigma) else float(radius * radius)
    rear_u, rear_v, front_u, front_v = variance[0, 0], variance[0, 1], variance[1, 0], variance[1, 1]
    covariance[:] = 0.0
    covariance[0, 0], covariance[1, 1] = (front_u + rear_u) / 4.0, (front_v + rear_v) / 4.0
    covariance[2, 2] = (front_v + rear_v) / (distance * distance)
    covariance[1, 2] = covariance[2, 1] = (front_v - rear_v) / (2.0 * distance)
    return u, v, rotation, scale


@_jit
def _similarity(points, shifts, weight):  # type: ignore[no-untyped-def]
    """Weighted least-squares similarity q = s R(ψ) p + m₀ through q = p + d; (m₀_u, m₀_v, ψ, s)."""
    total, pu, pv, qu, qv = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(points.shape[0]):
        w = weight[i]
        if w > 0.0:
            total += w
            pu += w * points[i, 0]
            pv += w * points[i, 1]
            qu += w * (points[i, 0] + shifts[i, 0])
            qv += w * (points[i, 1] + shifts[i, 1])
    pu, pv, qu, qv = pu / total, pv / total, qu / total, qv / total
    same, cross, spread = 0.0, 0.0, 0.0
    for i in range(points.shape[0]):
        w = weight[i]
        if w > 0.0:
            au, av = points[i, 0] - pu, points[i, 1] - pv
            bu, bv = points[i, 0] + shifts[i, 0] - qu, points[i, 1] + shifts[i, 1] - qv
            same += w * (au * bu + av * bv)
            cross += w * (au * bv - av * bu)
            spread += w * (au * au + av * av)
    rotation = np.arctan2(cross, same)
    scale = np.sqrt(same * same + cross * cross) / spread
    cos, sin = scale * np.cos(rotation), scale * np.sin(rotation)
    return qu - (cos * pu - sin * pv), qv - (sin * pu + cos * pv), rotation, scale


@_jit
def consensus(points, shifts, usable, threshold, max_scale):  # type: ignore[no-untyped-def]
    """The similarity that most fragments agree on.

    `points` [F, 2] fragment centres from the image centre (px), `shifts` [F, 2] (px), `usable` bool [F]. Every
    pair of usable fragments proposes a motion, taken if its scale is within `max_scale` of 1; the one with
    most shifts within `threshold` px wins, then the one with the smallest residual.

    Returns (m₀_u, m₀_v, rotation, scale, inliers); inliers of 0 where no pair proposed one.
    """
    count = points.shape[0]
    best_inliers, best_sum = 0, np.inf
    best = (np.nan, np.nan, np.nan, np.nan)
    pair = np.zeros(count)
    for a in range(count):
        for b in range(a + 1, count):
            if not (usable[a] and usable[b]):
                continue
            pair[:] = 0.0
            pair[a] = pair[b] = 1.0
            mu, mv, rotation, scale = _similarity(points, shifts, pair)
            if not abs(scale - 1.0) <= max_scale:
                continue
            cos, sin = scale * np.cos(rotation), scale * np.sin(rotation)
            inliers, total = 0, 0.0
            for i in range(count):
                ru = points[i, 0] + shifts[i, 0] - (cos * points[i, 0] - sin * points[i, 1] + mu)
                rv = points[i, 1] + shifts[i, 1] - (sin * points[i, 0] + cos * points[i, 1] + mv)
                r2 = ru * ru + rv * rv
                if usable[i] and r2 <= threshold * threshold:
                    inliers += 1
                    total += r2
            if inliers > best_inliers or (inliers == best_inliers and total < best_sum):
                best_inliers, best_sum = inliers, total
                best = (mu, mv, rotation, scale)
    return best[0], best[1], best[2], best[3], best_inliers


@_jit
def photometric_fit(  # type: ignore[no-untyped-def]
    points, shifts, hessians, noise, mu, mv, rotation_rad, scale, threshold, robust_scale
):
    """Similarity through shifts that are each known to noise² · hessian⁻¹: the joint photometric optimum.

    Starts from (mu, mv, rotation_rad, scale); Gauss-Newton with the weight matrices hessian / noise² times
    the robust weight 1 / (1 + (r / robust_scale)²)², none beyond `threshold` px. `noise` [F] is the rms of
    each match (grey), taken as at least the 0.3 of the quantisation. Returns `Fit`.
    """
    count = points.shape[0]
    weight = np.zeros(count)
    residual = np.full((count, 2), np.nan)
    covariance = np.full((4, 4), np.nan)
    inliers, rests = 0, False
    for _ in range(6):
        a = np.zeros((4, 4))
        b = np.zeros(4)
        cos, sin = scale * np.cos(rotation_rad), scale * np.sin(rotation_rad)
        inliers = 0
        for i in range(count):
            weight[i] = 0.0
            if not (np.isfinite(shifts[i, 0]) and np.isfinite(noise[i])):
                continue
            tu, tv = cos * points[i, 0] - sin * points[i, 1], sin * points[i, 0] + cos * points[i, 1]
            ru, rv = points[i, 0] + shifts[i, 0] - tu - mu, points[i, 1] + shifts[i, 1] - tv - mv
            residual[i, 0], residual[i, 1] = ru, rv
            r2 = ru * ru + rv * rv
            if r2 > threshold * threshold:
                continue
            inliers += 1
            weight[i] = 1.0 / (1.0 + r2 / (robust_scale * robust_scale)) ** 2
            w = weight[i] / max(noise[i], QUANTISATION) ** 2
            h00, h01, h11 = w * hessians[i, 0, 0], w * hessians[i, 0, 1], w * hessians[i, 1, 1]
            ju = (1.0, 0.0, -tv, tu)
            jv = (0.0, 1.0, tu, tv)
            for p in range(4):
                b[p] += ju[p] * (h00 * ru + h01 * rv) + jv[p] * (h01 * ru + h11 * rv)
                for q in range(4):
                    a[p, q] += ju[p] * (h00 * ju[q] + h01 * jv[q]) + jv[p] * (h01 * ju[q] + h11 * jv[q])
        if inliers < 2 or rests or not np.linalg.det(a) > 0.0:
            break
        covariance = np.linalg.inv(a)
        step = covariance @ b
        mu += step[0]
        mv += step[1]
        rotation_rad += step[2]
        scale *= 1.0 + step[3]
        rests = abs(step[0]) + abs(step[1]) < 1e-6 and abs(step[2]) + abs(step[3]) < 1e-9
    return Fit(mu, mv, rotation_rad, scale, weight, residual, inliers, covariance[:3, :3].copy())


@_jit
def worst_rigidity(points, shifts):  # type: ignore[no-untyped-def]
    """Distance of two matches minus that of their fragments, px, of the pair where it is largest in size."""
    worst = 0.0
    for a in range(points.shape[0]):
        for b in range(a + 1, points.shape[0]):
            pu, pv = points[a, 0] - points[b, 0], points[a, 1] - points[b, 1]
            qu, qv = pu + shifts[a, 0] - shifts[b, 0], pv + shifts[a, 1] - shifts[b, 1]
            change = np.sqrt(qu * qu + qv * qv) - np.sqrt(pu * pu + pv * pv)
            if abs(change) > abs(worst):
                worst = change
    return worst


@_jit
def propagated(covariance, base, pose, motion_covariance, metres_per_px, heading_rad):  # type: ignore[no-untyped-def]
    """Covariance [3, 3] of `pose` from that at the pose `base` and that of the motion in px and rad.

    P' = F P Fᵀ + G Q Gᵀ, linearised about the motion: F carries the heading's error over the distance driven,
    G turns the shift in px (u, v) and the rotation into the world.
    """
    along_x, along_y = pose[0] - base[0], pose[1] - base[1]
    c, s = metres_per_px * np.cos(heading_rad), metres_per_px * np.sin(heading_rad)
    F = ((1.0, 0.0, -along_y), (0.0, 1.0, along_x), (0.0, 0.0, 1.0))
    G = ((-c, -s, -along_y), (-s, c, along_x), (0.0, 0.0, 1.0))
    result = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            total = 0.0
            for k in range(3):
                for n in range(3):
                    total += F[i][k] * covariance[k, n] * F[j][n] + G[i][k] * motion_covariance[k, n] * G[j][n]
            result[i, j] = total
    return result


@_jit
def running_medians(history):  # type: ignore[no-untyped-def]
    """Median of the finite values of each row [n, K], NaN below `MEDIAN_FROM` of them: (median of row 0, 1, 2)."""
    medians = (np.nan, np.nan, np.nan)
    for row in range(3):
        kept = np.empty(history.shape[1])
        count = 0
        for value in history[row]:
            if np.isfinite(value):
                kept[count] = value
                count += 1
        if count >= MEDIAN_FROM:
            middle = np.sort(kept[:count])[count // 2]
            if row == 0:
                medians = (middle, medians[1], medians[2])
            elif row == 1:
                medians = (medians[0], middle, medians[2])
            else:
                medians = (medians[0], medians[1], middle)
    return medians


@_jit
def frame_statistics(image):  # type: ignore[no-untyped-def]
    """Mean grey level, and mean squared gradient (grey²/px²), over every 32nd row of an image."""
    height, width = image.shape
    total, energy, count = np.int64(0), np.int64(0), 0
    for y in range(16, height - 1, 32):
        row, below = image[y], image[y + 1]
        line, square = np.int32(0), np.int32(0)
        for x in range(width - 1):
            here = np.int32(row[x])
            du, dv = np.int32(row[x + 1]) - here, np.int32(below[x]) - here
            line += here
            square += du * du + dv * dv
        total += line
        energy += square
        count += width - 1
    return total / max(count, 1), energy / max(count, 1)


@_jit
def shifts_of(points, u, v, rotation_rad, scale):  # type: ignore[no-untyped-def]
    """Shift [n, 2] (px) of the content at each of `points` [n, 2] (px from the centre) under a `Motion`."""
    c, s = scale * np.cos(rotation_rad), scale * np.sin(rotation_rad)
    shifts = np.empty(points.shape)
    for i in range(len(points)):
        pu, pv = points[i]
        shifts[i, 0], shifts[i, 1] = c * pu - s * pv + u - pu, s * pu + c * pv + v - pv
    return shifts
