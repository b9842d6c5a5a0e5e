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
"""Taps of the cardinal cubic spline; what is cut off weighs less than 4e-4."""
POLE = 3.0**0.5 - 2.0
"""Pole of the cubic B-spline's prefilter."""
PREFILTER_MARGIN = 8
"""Pixels around a patch after which the prefilter has forgotten the border (POLE^8 = 3e-5)."""
MEDIAN_FROM = 5
"""A running median counts from this many values on."""
QUANTISATION = 0.3
"""Least noise of a match in grey levels: rounding to whole levels, 1/sqrt(12)."""
HILL_PX = 2
"""Positions this close to the first peak belong to its hill and are no second peak."""

_CARDINAL = (-6.0 * POLE / (1.0 - POLE * POLE)) * POLE ** np.abs(np.arange(-TAPS, TAPS + 1))


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


def matches_of(surface, hessian, block):  # type: ignore[no-untyped-def]
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


def no_matches(count: int, radius: int) -> Matches:
    """Matches of `count` fragments in which nothing was found yet: all NaN."""
    surface = np.full((count, 2 * radius + 1, 2 * radius + 1), np.nan, np.float32)
    matches: Matches = matches_of(surface, np.full((count, 2, 2), np.nan), np.full((count, VALUES), np.nan))
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
def templates(coefficients, count, side, rotation_rad):  # type: ignore[no-untyped-def]
    """Sample every fragment, turned by `rotation_rad`, with its gradient in the turned axes.

    T(q) = I(p + R(-ψ) q): the content of the template frame as it looks after a rotation by ψ. Returns float32
    [3, F, N, N]: grey levels, slope along u, slope along v.
    """
    half = (side - 1) // 2
    middle = np.float32((coefficients.shape[0] - 1) // 2)
    lanes = coefficients.shape[2]
    cos, sin = np.float32(np.cos(rotation_rad)), np.float32(np.sin(rotation_rad))
    sampled = np.empty((3, count, side, side), np.float32)
    row = np.empty((3, side, lanes), np.float32)
    for y in range(side):
        qv = np.float32(y - half)
        for x in range(side):
            qu = np.float32(x - half)
            u, v = middle + cos * qu + sin * qv, middle - sin * qu + cos * qv
            iu, iv = int(u), int(v)
            u0, u1, u2, u3, e0, e1, e2, e3 = _basis(u - np.float32(iu))
            v0, v1, v2, v3, f0, f1, f2, f3 = _basis(v - np.float32(iv))
            grey, slope_u, slope_v = row[0, x], row[1, x], row[2, x]
            for k in range(4):
                wv = v0 if k == 0 else (v1 if k == 1 else (v2 if k == 2 else v3))
                dv = f0 if k == 0 else (f1 if k == 1 else (f2 if k == 2 else f3))
                c0, c1 = coefficients[iv + k - 1, iu - 1], coefficients[iv + k - 1, iu]
                c2, c3 = coefficients[iv + k - 1, iu + 1], coefficients[iv + k - 1, iu + 2]
                if k == 0:
                    for lane in range(lanes):
                        along = (u0 * c0[lane] + u1 * c1[lane]) + (u2 * c2[lane] + u3 * c3[lane])
                        slope = (e0 * c0[lane] + e1 * c1[lane]) + (e2 * c2[lane] + e3 * c3[lane])
                        grey[lane] = wv * along
                        slope_u[lane] = wv * slope
                        slope_v[lane] = dv * along
                else:
                    for lane in range(lanes):
                        along = (u0 * c0[lane] + u1 * c1[lane]) + (u2 * c2[lane] + u3 * c3[lane])
                        slope = (e0 * c0[lane] + e1 * c1[lane]) + (e2 * c2[lane] + e3 * c3[lane])
                        grey[lane] += wv * along
                        slope_u[lane] += wv * slope
                        slope_v[lane] += dv * along
            for lane in range(lanes):
                gu, gv = slope_u[lane], slope_v[lane]
                slope_u[lane] = cos * gu - sin * gv
                slope_v[lane] = sin * gu + cos * gv
        for part in range(3):
            for i in range(count):
                target = sampled[part, i, y]
                for x in range(side):
                    target[x] = row[part, x, i]
    return sampled


@_jit
def _cardinal_weights(fraction, weights):  # type: ignore[no-untyped-def]
    """Weights of the TAPS pixels around a position `fraction` after the sixth of them (cubic spline)."""
    f = fraction
    b = (
        (1.0 - f) ** 3 / 6.0,
        (3.0 * f**3 - 6.0 * f**2 + 4.0) / 6.0,
        (-3.0 * f**3 + 3.0 * f**2 + 3.0 * f + 1.0) / 6.0,
        f**3 / 6.0,
    )
    total = 0.0
    first = 1 - TAPS // 2
    for k in range(TAPS):
        w = 0.0
        for m in range(4):
            w += b[m] * _CARDINAL[TAPS + (k + first) - (m - 1)]
        weights[k] = w
        total += w
    for k in range(TAPS):
        weights[k] /= total


@_jit
def _shifted(image, u, v, side, window, rows, out, weights_u, weights_v):  # type: ignore[no-untyped-def]
    """Sample the N x N pixels around the real position (u, v) by the cubic spline through the image.

    All pixels share one subpixel fraction, so the spline is a separable filter of TAPS taps.
    """
    half = (side - 1) // 2
    iu, iv = int(np.floor(u)), int(np.floor(v))
    _cardinal_weights(u - iu, weights_u)
    _cardinal_weights(v - iv, weights_v)
    before = TAPS // 2 - 1
    _copy_window(image, iv - half - before, iu - half - before, window)
    width = window.shape[1]
    for y in range(side):
        row = rows[y]
        for x in range(width):
            row[x] = 0.0
        for k in range(0, TAPS, 4):
            w0, w1 = np.float32(weights_v[k]), np.float32(weights_v[k + 1])
            w2, w3 = np.float32(weights_v[k + 2]), np.float32(weights_v[k + 3])
            s0, s1, s2, s3 = window[y + k], window[y + k + 1], window[y + k + 2], window[y + k + 3]
            for x in range(width):
                row[x] += (w0 * s0[x] + w1 * s1[x]) + (w2 * s2[x] + w3 * s3[x])
        target = out[y]
        for x in range(side):
            target[x] = 0.0
        for k in range(0, TAPS, 4):
            w0, w1 = np.float32(weights_u[k]), np.float32(weights_u[k + 1])
            w2, w3 = np.float32(weights_u[k + 2]), np.float32(weights_u[k + 3])
            s0, s1, s2, s3 = (
                row[k : k + side],
                row[k + 1 : k + 1 + side],
                row[k + 2 : k + 2 + side],
                row[k + 3 : k + 3 + side],
            )
            for x in range(side):
                target[x] += (w0 * s0[x] + w1 * s1[x]) + (w2 * s2[x] + w3 * s3[x])


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
    for j in range(positions):
        for x in range(padded):
            total[x] = 0.0
        for y in range(side):
            row, taps = grey[j + y], centred[y]
            k = 0
            while k + 3 <= side:
                t0, t1, t2 = taps[k], taps[k + 1], taps[k + 2]
                r0, r1, r2 = row[k : k + padded], row[k + 1 : k + 1 + padded], row[k + 2 : k + 2 + padded]
                for x in range(padded):
                    total[x] += t0 * r0[x] + t1 * r1[x] + t2 * r2[x]
                k += 3
            while k < side:
                t0 = taps[k]
                r0 = row[k : k + padded]
                for x in range(padded):
                    total[x] += t0 * r0[x]
                k += 1
        box, box_sq = np.int64(0), np.int64(0)
        for x in range(side):
            box += column[x]
            box_sq += column_sq[x]
        top = v + j - radius - half
        for i in range(positions):
            left = u + i - radius - half
            variance = box_sq * n - box * box
            if top < 0 or left < 0 or top + side > height or left + side > width:
                surface[j, i] = np.nan
            elif variance == 0 or energy < 1e-3 * n:
                surface[j, i] = 0.0
            else:
                surface[j, i] = total[i] / np.sqrt(energy * (variance / n))
            if i + 1 < positions:
                box += column[i + side] - column[i]
                box_sq += column_sq[i + side] - column_sq[i]
        if j + 1 < positions:
            for x in range(size):
                new, old = np.int64(pixels[j + side, x]), np.int64(pixels[j, x])
                column[x] += new - old
                column_sq[x] += new * new - old * old


@_jit
def find_peaks(surface):  # type: ignore[no-untyped-def]
    """Highest position of a surface, and the highest local maximum outside its hill.

    Returns (row, column, value, second row, second column, second value); rows of -1 where there is none.
    """
    size = surface.shape[0]
    best_j, best_i, best = -1, -1, -2.0
    for j in range(size):
        for i in range(size):
            if surface[j, i] > best:
                best_j, best_i, best = j, i, surface[j, i]
    second_j, second_i, second = -1, -1, -2.0
    for j in range(size):
        for i in range(size):
            value = surface[j, i]
            if not value > second or (abs(j - best_j) <= HILL_PX and abs(i - best_i) <= HILL_PX):
                continue
            highest = True
            for y in range(max(j - 1, 0), min(j + 2, size)):
                for x in range(max(i - 1, 0), min(i + 2, size)):
                    if surface[y, x] > value:
                        highest = False
            if highest:
                second_j, second_i, second = j, i, value
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
    """Work space of the iterated refinement, so that no iteration allocates."""

    window: Floats32
    rows: Floats32
    sampled: Floats32
    weights_u: Floats
    weights_v: Floats


@_jit
def _scratch(side):  # type: ignore[no-untyped-def]
    width = side + TAPS - 1
    return _Scratch(
        np.empty((width, width), np.float32),
        np.empty((side, width), np.float32),
        np.empty((side, side), np.float32),
        np.empty(TAPS),
        np.empty(TAPS),
    )


@_jit
def _lines(a, b):  # type: ignore[no-untyped-def]
    """Σ a b over two float32 arrays [N, N]: eight running sums a line, joined in float64.

    The order of the sums is fixed by the code, so that the result does not depend on the machine.
    """
    total = 0.0
    lanes = np.empty(8, np.float32)
    rows, columns = a.shape
    whole = columns // 8 * 8
    for y in range(rows):
        ra, rb = a[y], b[y]
        for k in range(8):
            lanes[k] = 0.0
        for x in range(0, whole, 8):
            sa, sb = ra[x : x + 8], rb[x : x + 8]
            for k in range(8):
                lanes[k] += sa[k] * sb[k]
        rest = np.float32(0.0)
        for x in range(whole, columns):
            rest += ra[x] * rb[x]
        total += float(
            ((lanes[0] + lanes[1]) + (lanes[2] + lanes[3])) + ((lanes[4] + lanes[5]) + (lanes[6] + lanes[7])) + rest
        )
    return total


@_jit
def _mean(a):  # type: ignore[no-untyped-def]
    """Mean of a float32 array [N, N]: sums of lines joined in float64."""
    total = 0.0
    rows, columns = a.shape
    for y in range(rows):
        row = a[y]
        line = np.float32(0.0)
        for x in range(columns):
            line += row[x]
        total += line
    return total / (rows * columns)


@_jit
def _centre(a):  # type: ignore[no-untyped-def]
    """Subtract the mean of a float32 array [N, N] in place; return the mean."""
    mean = _mean(a)
    m = np.float32(mean)
    for y in range(a.shape[0]):
        row = a[y]
        for x in range(a.shape[1]):
            row[x] -= m
    return mean


@_jit
def refine(  # type: ignore[no-untyped-def]
    grey, slope_u, slope_v, image, u, v, du, dv, gain_and_offset, limit, tolerance, work, hessian
):
    """Iterated inverse-compositional refinement on a cubic spline.

    Minimises Σ (I(p + d + q) - g T(q) - b)² over the shift d, and over gain g and offset b where asked; T and its
    slopes [N, N] come from `templates` and are used up. The gradient is that of the template, so one Hessian serves all
    iterations; gain and offset are projected out, so that they cost nothing in an iteration. (du, dv) is the
    start, relative to the integer position (u, v) in the image.

    Returns (δu, δv, iterations, g, b, rms of the residual in grey, mean grey of the match); `hessian` [2, 2]
    receives I_xyᵀ I_xy of the template in grey²/px².
    """
    side = grey.shape[0]
    n = side * side
    hessian[0, 0], hessian[1, 1] = _lines(slope_u, slope_u), _lines(slope_v, slope_v)
    hessian[0, 1] = hessian[1, 0] = _lines(slope_u, slope_v)
    mean = 0.0
    energy = 0.0
    if gain_and_offset:
        mean = _centre(grey)
        energy = _lines(grey, grey)
        _centre(slope_u)
        _centre(slope_v)
        if energy > 0.0:
            along_u, along_v = np.float32(_lines(slope_u, grey) / energy), np.float32(_lines(slope_v, grey) / energy)
            for y in range(side):
                for x in range(side):
                    slope_u[y, x] -= along_u * grey[y, x]
                    slope_v[y, x] -= along_v * grey[y, x]
    uu, uv, vv = _lines(slope_u, slope_u), _lines(slope_u, slope_v), _lines(slope_v, slope_v)
    det = uu * vv - uv * uv
    gain, offset, rms, level = 1.0, 0.0, np.nan, np.nan
    if not det > 1e-6 * (uu + vv) ** 2 or uu + vv < 1e-3 * n:
        return np.nan, np.nan, 0, np.nan, np.nan, np.nan, np.nan
    iteration = 0
    sampled = work.sampled
    start_u, start_v = du, dv
    while iteration < limit:
        iteration += 1
        _shifted(image, u + du, v + dv, side, work.window, work.rows, sampled, work.weights_u, work.weights_v)
        if gain_and_offset:
            level = _centre(sampled)
            gain = _lines(sampled, grey) / energy
            offset = level - gain * mean
            total = _lines(sampled, sampled)
            rms = np.sqrt(max(total - gain * gain * energy, 0.0) / n)
            if not abs(gain) > 1e-3:
                break
        else:
            level = _mean(sampled)
            for y in range(side):
                for x in range(side):
                    sampled[y, x] -= grey[y, x]
            rms = np.sqrt(_lines(sampled, sampled) / n)
        bu, bv = _lines(slope_u, sampled) / gain, _lines(slope_v, sampled) / gain
        step_u, step_v = (vv * bu - uv * bv) / det, (uu * bv - uv * bu) / det
        du -= step_u
        dv -= step_v
        step = np.sqrt(step_u * step_u + step_v * step_v)
        if step < tolerance or abs(du - start_u) > 3.0 or abs(dv - start_v) > 3.0:
            break
    return du, dv, iteration, gain, offset, rms, level


@_jit
def _note_peaks(matches, i, centre, search, radius):  # type: ignore[no-untyped-def]
    """Find the peaks of fragment i's surface and note them; False where the surface holds no position."""
    surface = matches.surface[i]
    j, k, value, second_j, second_k, second = find_peaks(surface)
    if j < 0:
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
    the previous frame and centres of the search areas in this one. Fills the arrays of `no_matches`.
    """
    m = _matches_of(surface, hessian, block)
    half = (side - 1) // 2
    n = side * side
    template = np.empty((side, side), np.float32)
    for i in range(centres.shape[0]):
        u, v = centres[i]
        _copy_window(previous, v - half, u - half, template)
        correlation_surface(template, image, search[i, 0], search[i, 1], radius, m.surface[i])
        if not _note_peaks(m, i, centres, search, radius):
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
    coefficients, image, centres, search, rotation_rad, side, radius, gain_and_offset, limit, tolerance,
    surface, hessian, block,
):  # fmt: skip
    """Correlation peak with the turned templates, then the iterated refinement, for every fragment.

    `coefficients` float32 [S, S, lanes] from `spline_patches`; the rest as in `match_one_step`.
    """
    m = _matches_of(surface, hessian, block)
    work = _scratch(side)
    t = templates(coefficients, centres.shape[0], side, rotation_rad)
    for i in range(centres.shape[0]):
        correlation_surface(t[0, i], image, search[i, 0], search[i, 1], radius, m.surface[i])
        m.iterations[i] = 0
        if _note_peaks(m, i, centres, search, radius):
            _refine_match(m, i, t, image, centres, gain_and_offset, limit, tolerance, work)


@_jit
def refine_again(  # type: ignore[no-untyped-def]
    coefficients, image, centres, rotation_rad, side, gain_and_offset, limit, tolerance, surface, hessian, block
):
    """Refine matches once more, from where they are, with templates turned by a better rotation."""
    m = _matches_of(surface, hessian, block)
    work = _scratch(side)
    t = templates(coefficients, centres.shape[0], side, rotation_rad)
    for i in range(centres.shape[0]):
        if np.isfinite(m.delta_px[i, 0]):
            _refine_match(m, i, t, image, centres, gain_and_offset, limit, tolerance, work)


@_jit
def _refine_match(m, i, t, image, centres, gain_and_offset, limit, tolerance, work):  # type: ignore[no-untyped-def]
    u, v = centres[i, 0] + m.peak_px[i, 0], centres[i, 1] + m.peak_px[i, 1]
    du, dv, iterations, gain, offset, rms, level = refine(
        t[0, i], t[1, i], t[2, i], image, u, v, m.delta_px[i, 0], m.delta_px[i, 1], gain_and_offset, limit,
        tolerance, work, m.hessian[i],
    )  # fmt: skip
    m.delta_px[i, 0], m.delta_px[i, 1] = du, dv
    m.iterations[i] += iterations
    m.gain[i], m.offset[i], m.residual_rms[i], m.mean_grey[i] = gain, offset, rms, level
    _note_texture(m, i, t.shape[2] * t.shape[3])


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
    coefficients, image, centres, points, shift_u, shift_v, rotation_rad, scale, side, gain_and_offset, limit, tolerance
):
    """Refine many tiles of the frame from a known rigid motion: the photometric step after the fragments.

    `centres` int64 [T, 2] (u, v), `points` [T, 2] the same from the image centre. Returns (shift [T, 2],
    hessian [T, 2, 2], rms [T]); NaN where a tile leaves the image or has no texture.
    """
    count = centres.shape[0]
    height, width = image.shape
    half = (side - 1) // 2
    shifts = np.full((count, 2), np.nan)
    hessians = np.full((count, 2, 2), np.nan)
    rms = np.full(count, np.nan)
    cos, sin = scale * np.cos(rotation_rad), scale * np.sin(rotation_rad)
    work = _scratch(side)
    t = templates(coefficients, count, side, rotation_rad)
    for i in range(count):
        pu, pv = points[i]
        u = cos * pu - sin * pv + shift_u + centres[i, 0] - pu
        v = sin * pu + cos * pv + shift_v + centres[i, 1] - pv
        if u < half or v < half or u > width - 1 - half or v > height - 1 - half:
            continue
        iu, iv = np.floor(u + 0.5), np.floor(v + 0.5)
        du, dv, _, _, _, residual, _ = refine(
            t[0, i],
            t[1, i],
            t[2, i],
            image,
            iu,
            iv,
            u - iu,
            v - iv,
            gain_and_offset,
            limit,
            tolerance,
            work,
            hessians[i],
        )
        shifts[i, 0], shifts[i, 1] = iu + du - centres[i, 0], iv + dv - centres[i, 1]
        rms[i] = residual
    return shifts, hessians, rms


# --------------------------------------------------------- 3. rigid motion (12), (13), (15)


@_jit
def paper_fit(surface, hessian, block, points, step_limit, gimballed, covariance):  # type: ignore[no-untyped-def]
    """The paper's motion from two fragments, the rear one first: (10)-(13), (15).

    A Δ longer than `step_limit` is rejected, not clipped: the integer shift stands. Notes shift, weight and
    residual in the block; `covariance` [3, 3] of (m_x0, n_y0, Δα) receives that of the fragments' σ.

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
    rear_u, rear_v = m.sigma_px[0, 0] ** 2, m.sigma_px[0, 1] ** 2
    front_u, front_v = m.sigma_px[1, 0] ** 2, m.sigma_px[1, 1] ** 2
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
    inliers = 0
    for repeat in range(5):
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
        if inliers < 2 or repeat == 4:
            break
        covariance = np.linalg.inv(a)
        step = covariance @ b
        mu += step[0]
        mv += step[1]
        rotation_rad += step[2]
        scale *= 1.0 + step[3]
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
    """Mean grey level, and mean squared gradient (grey²/px²), over every 16th row of an image."""
    height, width = image.shape
    total, energy, count = np.int64(0), np.int64(0), 0
    for y in range(8, height - 1, 16):
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
