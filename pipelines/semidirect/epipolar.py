"""The search for a corner of a keyframe in another frame, along the line on which its depth moves it.

With x_cur = R x_ref + t, a corner of unit bearing f and inverse depth ξ (along the bearing) is seen by the other frame
in the direction R f + ξ t: a line segment at unit depth for ξ within μ ± σ, up to and with ξ = 0. The 8 x 8 patch
around the corner, warped to the other view, is compared by its zero-mean sum of squared differences (ZMSSD) at whole
pixels of the level that fits best, aligned to a part of a pixel from the best of them, and the two rays intersected.

C. Forster, M. Pizzoli, D. Scaramuzza, "SVO: Fast semi-direct monocular visual odometry", ICRA 2014, section VI; the
alignment is S. Baker, I. Matthews, "Lucas-Kanade 20 years on", IJCV 56(3), 2004 (inverse compositional), with the
patches' mean difference as a third unknown.

Images are pyramids, tuples of levels [rows, cols] uint8. Functions with `_jit` serve Python and compiled code alike.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipelines.compiled import compiled
from pipelines.semidirect.depth_filter import depth_error, inverse_depth_error, pixel_angle
from pipelines.semidirect.optics import Optics, project, ray
from pipelines.semidirect.pyramid import Grey as Image
from pipelines.semidirect.pyramid import Pyramid, level_image, on_finest, on_level, sample

Floats = NDArray[np.float64]
Longs = NDArray[np.int64]

HALF = 4
PATCH = 2 * HALF
"""Side of the patch, which reaches from -4 to 3 px from its corner."""
BORDERED = PATCH + 2
"""Side with a border of one pixel, for the gradients."""
INSIDE_PX = HALF + 1
"""A patch and the neighbours that bilinear interpolation needs lie in the image this far from its edge."""
APART_PX = 2.0
"""The second best match is farther than this from the best, on the level of the search."""
LARGEST_AREA = 3.0
"""Area of a pixel of the reference patch in the other image, in px², above which the next level is taken."""
PARALLEL = 1e-6
"""Rays whose sin² of the angle between them is less than this do not give a depth."""

MATCHED, ALIGNED, UNSEEN, NO_REFERENCE, TOO_LONG, UNLIKE, NOT_ALIGNED, NO_PARALLAX, BEHIND = range(9)


class Match(IntEnum):
    """How a search ended; the first two gave a depth."""

    MATCHED = MATCHED
    ALIGNED = ALIGNED
    """The segment was so short that the patch was aligned without a search."""
    UNSEEN = UNSEEN
    """The corner at μ is behind the camera, beyond the reach of its lens, or not inside its image."""
    NO_REFERENCE = NO_REFERENCE
    """The warped patch reaches out of the keyframe's image, or the warp is not invertible."""
    TOO_LONG = TOO_LONG
    """The segment takes more steps than allowed, or leaves the lens's reach."""
    UNLIKE = UNLIKE
    """The best score is too bad, or the segment's pixels are all outside the image."""
    NOT_ALIGNED = NOT_ALIGNED
    """The alignment did not settle, or left the image."""
    NO_PARALLAX = NO_PARALLAX
    """The rays are parallel: the camera has not moved enough."""
    BEHIND = BEHIND
    """The rays meet behind a camera."""


class Limits(NamedTuple):
    """Settings of a search.

    Steps along the segment of so many px of the level, at most so many; the worst ZMSSD per pixel that is a match; the
    length below which a segment is short, px of the level; the coarsest level; the alignment's iterations and the shift
    below which it has settled, px.
    """

    step_px: float = 0.7
    most_steps: int = 1000
    worst_score: float = 2000.0
    short_px: float = 2.0
    top_level: int = 2
    iterations: int = 10
    settled_px: float = 0.03


class Segment(NamedTuple):
    """Where a corner may be in the other frame: at unit depth and in px of level 0, NaN where it has no pixel.

    `middle` is at μ, `far` at max(μ - σ, 0), `near` at μ + σ.
    """

    middle_a: float
    middle_b: float
    far_a: float
    far_b: float
    near_a: float
    near_b: float
    middle_u: float
    middle_v: float
    far_u: float
    far_v: float
    near_u: float
    near_v: float
    length_px: float


class Warp(NamedTuple):
    """Affine map of offsets in the keyframe to those in the other frame, px of level 0 each, by rows."""

    xx: float
    xy: float
    yx: float
    yy: float


class Search(NamedTuple):
    """Everything that a search computed; NaN from where it ended.

    `level` it was made on, `steps` pixels compared; `best`, `second` ZMSSD per pixel, the second at least `APART_PX`
    away; `best_u`, `best_v` the best whole pixel and `u`, `v` the aligned one, px of level 0; `iterations` of the
    alignment; `depth` along the bearing, `tau` its error for one pixel, `inverse_tau` that of the inverse depth.
    """

    outcome: int
    segment: Segment
    warp: Warp
    level: int
    steps: int
    best: float
    second: float
    best_u: float
    best_v: float
    iterations: int
    u: float
    v: float
    depth: float
    tau: float
    inverse_tau: float


RECORD = ("outcome", *Segment._fields, *Warp._fields, *Search._fields[3:])
"""Columns of a bank's record."""


# ---------------------------------------------------------------------------------- geometry


@compiled
def centre_in_ref(rotation: Floats, translation: Floats) -> Floats:
    """The other camera's centre -Rᵀ t in the keyframe's axes [3]."""
    r, t, out = rotation, translation, np.empty(3)
    for i in range(3):
        out[i] = -(r[0, i] * t[0] + r[1, i] * t[1] + r[2, i] * t[2])
    return out


@compiled
def direction(bearing: Floats, inverse_depth: float, rotation: Floats, translation: Floats) -> Any:
    """R f + ξ t: the point as the other camera sees it, but for its length."""
    r, t, f, k = rotation, translation, bearing, inverse_depth
    return (
        r[0, 0] * f[0] + r[0, 1] * f[1] + r[0, 2] * f[2] + k * t[0],
        r[1, 0] * f[0] + r[1, 1] * f[1] + r[1, 2] * f[2] + k * t[1],
        r[2, 0] * f[0] + r[2, 1] * f[1] + r[2, 2] * f[2] + k * t[2],
    )


@compiled
def seen_at(optics: Optics, bearing: Floats, inverse_depth: float, rotation: Floats, translation: Floats) -> Any:
    """(a, b) at unit depth and (u, v) px of a corner at an inverse depth; NaN behind the camera."""
    x, y, z = direction(bearing, inverse_depth, rotation, translation)
    if not z > 0.0:
        return math.nan, math.nan, math.nan, math.nan
    p = project(optics, x, y, z)
    return x / z, y / z, p.u, p.v


@compiled
def segment_of(
    optics: Optics, bearing: Floats, mu: float, sigma: float, rotation: Floats, translation: Floats
) -> Segment:
    """The epipolar segment of the inverse depths μ ± σ, cut at infinity."""
    ma, mb, mu_px, mv_px = seen_at(optics, bearing, mu, rotation, translation)
    fa, fb, fu, fv = seen_at(optics, bearing, max(mu - sigma, 0.0), rotation, translation)
    na, nb, nu, nv = seen_at(optics, bearing, mu + sigma, rotation, translation)
    return Segment(ma, mb, fa, fb, na, nb, mu_px, mv_px, fu, fv, nu, nv, math.hypot(nu - fu, nv - fv))


@compiled
def triangulated(bearing: Floats, other: Floats, rotation: Floats, centre: Floats) -> float:
    """Depth along the keyframe's bearing of the point nearest to both rays (least squares).

    Args:
        bearing: unit bearing f in the keyframe [3].
        other: unit bearing g in the other frame [3].
        rotation: R [3, 3], keyframe to other frame.
        centre: of the other camera in the keyframe's axes [3].

    Returns:
        z of min |z f - (c + z' Rᵀg)|; inf for parallel rays, NaN where they meet behind a camera.
    """
    g0 = rotation[0, 0] * other[0] + rotation[1, 0] * other[1] + rotation[2, 0] * other[2]
    g1 = rotation[0, 1] * other[0] + rotation[1, 1] * other[1] + rotation[2, 1] * other[2]
    g2 = rotation[0, 2] * other[0] + rotation[1, 2] * other[1] + rotation[2, 2] * other[2]
    fg = bearing[0] * g0 + bearing[1] * g1 + bearing[2] * g2
    ft = bearing[0] * centre[0] + bearing[1] * centre[1] + bearing[2] * centre[2]
    gt = g0 * centre[0] + g1 * centre[1] + g2 * centre[2]
    det = 1.0 - fg * fg
    if not det >= PARALLEL:
        return math.inf
    z, behind = (ft - fg * gt) / det, (fg * ft - gt) / det
    return z if z > 0.0 and behind > 0.0 else math.nan


@compiled
def warp_of(optics: Optics, bearing: Floats, inverse_depth: float, rotation: Floats, translation: Floats) -> Warp:
    """How offsets around the corner move, for a surface that faces the keyframe: derivative of the image to image map.

    With (a, b) at unit depth in the keyframe, the surface's points are (a, b, 1) f_z/ξ.
    """
    a, b = bearing[0] / bearing[2], bearing[1] / bearing[2]
    here = project(optics, a, b, 1.0)
    x, y, z = direction(bearing, inverse_depth, rotation, translation)
    there = project(optics, x / bearing[2], y / bearing[2], z / bearing[2])
    r = rotation
    ua = there.u_x * r[0, 0] + there.u_y * r[1, 0] + there.u_z * r[2, 0]
    ub = there.u_x * r[0, 1] + there.u_y * r[1, 1] + there.u_z * r[2, 1]
    va = there.v_x * r[0, 0] + there.v_y * r[1, 0] + there.v_z * r[2, 0]
    vb = there.v_x * r[0, 1] + there.v_y * r[1, 1] + there.v_z * r[2, 1]
    det = 1.0 / (here.u_x * here.v_y - here.u_y * here.v_x)
    return Warp(
        (ua * here.v_y - ub * here.v_x) * det,
        (ub * here.u_x - ua * here.u_y) * det,
        (va * here.v_y - vb * here.v_x) * det,
        (vb * here.u_x - va * here.u_y) * det,
    )


@compiled
def level_for(warp: Warp, level_in_ref: int, top_level: int) -> int:
    """The level on which a pixel of the corner's own level covers at most `LARGEST_AREA` pixels."""
    area = abs(warp.xx * warp.yy - warp.xy * warp.yx) * (1 << (2 * level_in_ref))
    level = 0
    while area > LARGEST_AREA and level < top_level:
        level += 1
        area *= 0.25
    return level


# ----------------------------------------------------------------------------------- patches


@compiled
def warped_patch(reference: Image, u: float, v: float, level_in_ref: int, warp: Warp, level: int, out: Floats) -> bool:
    """The corner's surroundings as the other frame should see them on a level.

    Args:
        reference: the keyframe's level `level_in_ref` [rows, cols].
        u: corner, px of level 0.
        v: likewise.
        level_in_ref: level that the corner was found on.
        warp: from the keyframe to the other frame.
        level: of the search.
        out: room for the patch with its border [10, 10].

    Returns:
        Whether the patch lies inside the keyframe's image.
    """
    det = warp.xx * warp.yy - warp.xy * warp.yx
    if not abs(det) > 1e-9:
        return False
    scale = (1 << level) / (det * (1 << level_in_ref))
    centre_u, centre_v = on_level(u, level_in_ref), on_level(v, level_in_ref)
    rows, cols = reference.shape
    for i in range(BORDERED):
        for j in range(BORDERED):
            du, dv = j - INSIDE_PX, i - INSIDE_PX
            x = centre_u + scale * (warp.yy * du - warp.xy * dv)
            y = centre_v + scale * (warp.xx * dv - warp.yx * du)
            if not (0.0 <= x < cols - 1 and 0.0 <= y < rows - 1):
                return False
            out[i, j] = sample(reference, x, y)
    return True


@compiled
def zmssd(patch: Floats, image: Image, u: int, v: int) -> float:
    """Zero-mean sum of squared differences, per pixel, of the patch [10, 10] and the image around (u, v)."""
    total, squares = 0.0, 0.0
    for i in range(PATCH):
        for j in range(PATCH):
            d = image[v - HALF + i, u - HALF + j] - patch[i + 1, j + 1]
            total += d
            squares += d * d
    count = PATCH * PATCH
    return (squares - total * total / count) / count


@compiled
def within(image: Image, u: float, v: float) -> bool:
    """Whether a patch around (u, v) can be read from the image."""
    rows, cols = image.shape
    return bool(INSIDE_PX <= u < cols - INSIDE_PX and INSIDE_PX <= v < rows - INSIDE_PX)


@compiled
def aligned(patch: Floats, image: Image, u: float, v: float, iterations: int, settled_px: float) -> Any:
    """The patch moved over the image until Σ (I(x + (u, v)) - P(x) + m)² is least.

    Inverse compositional: J = (∂P/∂x, ∂P/∂y, 1) and H = Σ JJᵀ are those of the patch and stay.

    Args:
        patch: with its border [10, 10].
        image: level of the other frame [rows, cols].
        u: start, px of that level.
        v: likewise.
        iterations: at most.
        settled_px: a shift below this ends it.

    Returns:
        (u, v, iterations made); NaN for u, v if it did not settle, left the image, or the patch has no texture.
    """
    h = np.zeros((3, 3))
    for i in range(1, PATCH + 1):
        for j in range(1, PATCH + 1):
            gx, gy = 0.5 * (patch[i, j + 1] - patch[i, j - 1]), 0.5 * (patch[i + 1, j] - patch[i - 1, j])
            h[0, 0] += gx * gx
            h[0, 1] += gx * gy
            h[0, 2] += gx
            h[1, 1] += gy * gy
            h[1, 2] += gy
    h[1, 0], h[2, 0], h[2, 1], h[2, 2] = h[0, 1], h[0, 2], h[1, 2], float(PATCH * PATCH)
    if not np.linalg.det(h) > 1e-6:
        return math.nan, math.nan, 0
    inverse = np.linalg.inv(h)
    mean = 0.0
    for k in range(iterations):
        if not within(image, u, v):
            return math.nan, math.nan, k
        jx, jy, j1 = 0.0, 0.0, 0.0
        for i in range(PATCH):
            for j in range(PATCH):
                r = sample(image, u - HALF + j, v - HALF + i) - patch[i + 1, j + 1] + mean
                jx += 0.5 * (patch[i + 1, j + 2] - patch[i + 1, j]) * r
                jy += 0.5 * (patch[i + 2, j + 1] - patch[i, j + 1]) * r
                j1 += r
        du = inverse[0, 0] * jx + inverse[0, 1] * jy + inverse[0, 2] * j1
        dv = inverse[1, 0] * jx + inverse[1, 1] * jy + inverse[1, 2] * j1
        u, v = u - du, v - dv
        mean -= inverse[2, 0] * jx + inverse[2, 1] * jy + inverse[2, 2] * j1
        if du * du + dv * dv < settled_px * settled_px:
            if within(image, u, v):
                return u, v, k + 1
            return math.nan, math.nan, k + 1
    return math.nan, math.nan, iterations


# ------------------------------------------------------------------------------------ search


@compiled
def scanned(optics: Optics, patch: Floats, image: Image, s: Segment, level: int, steps: int) -> Any:
    """The whole pixels of the segment compared with the patch, each once, from far to near.

    Returns:
        (best score, second best, u and v of the best on the level, pixels compared); the scores are inf where there
        was no pixel.
    """
    scores, us, vs = np.empty(steps + 1), np.empty(steps + 1, np.int64), np.empty(steps + 1, np.int64)
    n, last_u, last_v = 0, -1, -1
    for k in range(steps + 1):
        share = k / max(steps, 1)
        p = project(optics, s.far_a + share * (s.near_a - s.far_a), s.far_b + share * (s.near_b - s.far_b), 1.0)
        u, v = on_level(p.u, level), on_level(p.v, level)
        if not (math.isfinite(u) and math.isfinite(v)):
            continue
        whole_u, whole_v = math.floor(u + 0.5), math.floor(v + 0.5)
        if (whole_u == last_u and whole_v == last_v) or not within(image, whole_u, whole_v):
            continue
        last_u, last_v = whole_u, whole_v
        scores[n], us[n], vs[n] = zmssd(patch, image, whole_u, whole_v), whole_u, whole_v
        n += 1
    if n == 0:
        return math.inf, math.inf, 0, 0, 0
    i = int(np.argmin(scores[:n]))
    second = math.inf
    for k in range(n):
        if scores[k] < second and math.hypot(us[k] - us[i], vs[k] - vs[i]) > APART_PX:
            second = scores[k]
    return scores[i], second, us[i], vs[i], n


@compiled
def search(
    optics: Optics,
    reference: Pyramid,
    image: Pyramid,
    u: float,
    v: float,
    bearing: Floats,
    level_in_ref: int,
    mu: float,
    sigma: float,
    rotation: Floats,
    translation: Floats,
    limits: Limits,
) -> Search:
    """Look for a corner of a keyframe in another frame.

    Args:
        optics: camera of both.
        reference: the keyframe's pyramid.
        image: the other frame's pyramid.
        u: corner in the keyframe, px of level 0.
        v: likewise.
        bearing: its unit bearing [3].
        level_in_ref: the level it was found on.
        mu: inverse depth along the bearing.
        sigma: its standard deviation.
        rotation: R of x_cur = R x_ref + t [3, 3].
        translation: t [3].
        limits: settings.

    Returns:
        The measurement and everything that led to it.
    """
    nan = math.nan
    s = segment_of(optics, bearing, mu, sigma, rotation, translation)
    none = Warp(nan, nan, nan, nan)
    if not within(level_image(image, 0), s.middle_u, s.middle_v):
        return Search(UNSEEN, s, none, 0, 0, nan, nan, nan, nan, 0, nan, nan, nan, nan, nan)
    w = warp_of(optics, bearing, mu, rotation, translation)
    level = level_for(w, level_in_ref, limits.top_level)
    patch = np.empty((BORDERED, BORDERED))
    if not warped_patch(level_image(reference, level_in_ref), u, v, level_in_ref, w, level, patch):
        return Search(NO_REFERENCE, s, w, level, 0, nan, nan, nan, nan, 0, nan, nan, nan, nan, nan)
    length = s.length_px / (1 << level)
    if not length <= limits.most_steps * limits.step_px:
        return Search(TOO_LONG, s, w, level, 0, nan, nan, nan, nan, 0, nan, nan, nan, nan, nan)
    there = level_image(image, level)
    outcome, steps, best, second = ALIGNED, 0, nan, nan
    start_u, start_v = on_level(s.middle_u, level), on_level(s.middle_v, level)
    if length >= limits.short_px:
        count = math.ceil(length / limits.step_px)
        best, second, whole_u, whole_v, steps = scanned(optics, patch, there, s, level, count)
        if not best < limits.worst_score:
            return Search(UNLIKE, s, w, level, steps, best, second, nan, nan, 0, nan, nan, nan, nan, nan)
        outcome, start_u, start_v = MATCHED, float(whole_u), float(whole_v)
    best_u, best_v = on_finest(start_u, level), on_finest(start_v, level)
    fine_u, fine_v, turns = aligned(patch, there, start_u, start_v, limits.iterations, limits.settled_px)
    if not math.isfinite(fine_u):
        return Search(NOT_ALIGNED, s, w, level, steps, best, second, best_u, best_v, turns, nan, nan, nan, nan, nan)
    fine_u, fine_v = on_finest(fine_u, level), on_finest(fine_v, level)
    a, b = ray(optics, fine_u, fine_v)
    over = 1.0 / math.sqrt(a * a + b * b + 1.0)
    centre = centre_in_ref(rotation, translation)
    z = triangulated(bearing, np.array([a * over, b * over, over]), rotation, centre)
    if not math.isfinite(z):
        end = NO_PARALLAX if z == math.inf else BEHIND
        return Search(end, s, w, level, steps, best, second, best_u, best_v, turns, fine_u, fine_v, nan, nan, nan)
    tau = depth_error(bearing, centre, z, pixel_angle(optics.focal_u))
    inverse = inverse_depth_error(z, tau)
    return Search(outcome, s, w, level, steps, best, second, best_u, best_v, turns, fine_u, fine_v, z, tau, inverse)


@compiled
def search_bank(
    optics: Optics,
    reference: Pyramid,
    image: Pyramid,
    pixels: Floats,
    bearings: Floats,
    levels: Longs,
    mu: Floats,
    sigma: Floats,
    rotation: Floats,
    translation: Floats,
    limits: Limits,
    record: Floats,
) -> None:
    """`search` for n corners of one keyframe.

    Args:
        optics: camera of both.
        reference: the keyframe's pyramid.
        image: the other frame's pyramid.
        pixels: corners in the keyframe, px of level 0 [n, 2].
        bearings: their unit bearings [n, 3].
        levels: that they were found on [n].
        mu: inverse depths [n].
        sigma: their standard deviations [n].
        rotation: R of x_cur = R x_ref + t [3, 3].
        translation: t [3].
        limits: settings.
        record: room for what each search gave [n, len(RECORD)], in the order of `RECORD`.
    """
    for i in range(len(mu)):
        d = search(
            optics,
            reference,
            image,
            pixels[i, 0],
            pixels[i, 1],
            bearings[i],
            levels[i],
            mu[i],
            sigma[i],
            rotation,
            translation,
            limits,
        )
        row, s, w = record[i], d.segment, d.warp
        row[0] = d.outcome
        row[1], row[2], row[3], row[4], row[5], row[6] = s.middle_a, s.middle_b, s.far_a, s.far_b, s.near_a, s.near_b
        row[7], row[8], row[9], row[10] = s.middle_u, s.middle_v, s.far_u, s.far_v
        row[11], row[12], row[13] = s.near_u, s.near_v, s.length_px
        row[14], row[15], row[16], row[17] = w.xx, w.xy, w.yx, w.yy
        row[18], row[19], row[20], row[21], row[22], row[23] = d.level, d.steps, d.best, d.second, d.best_u, d.best_v
        row[24], row[25], row[26], row[27], row[28], row[29] = d.iterations, d.u, d.v, d.depth, d.tau, d.inverse_tau


def measurements(record: Floats) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """What `DepthFilters.update` takes of a bank's record: inverse depths, τ (NaN without a match), seen, each [n].

    A camera that has not moved has seen nothing: that is no fault of the corner.
    """
    outcome = record[:, 0]
    depth, tau = record[:, RECORD.index("depth")], record[:, RECORD.index("inverse_tau")]
    return 1.0 / depth, tau.copy(), (outcome != UNSEEN) & (outcome != NO_PARALLAX)
