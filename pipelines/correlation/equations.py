"""Paper A's equations (1) and (12)-(21), each once, in the corrected form.

Signs. The paper measures the motion of the ground's image between two frames and leaves most signs open. Here
a shift d is that of the image content (camera the other way), u is Ox and v is Oy (right of the vehicle), and
headings are counter-clockwise from above. `docs/odometry.md` lists the misprints.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from numba import njit

_jit: Any = njit(cache=True, error_model="numpy")


class Motion(NamedTuple):
    """Motion of the image content between two frames: p' = scale · R(rotation) p + (u, v).

    Positions are in px from the image centre. The content's rotation from u towards v equals the camera's
    rotation counter-clockwise seen from above.
    """

    u: float
    v: float
    rotation_rad: float
    scale: float = 1.0

    def then(self, following: Motion) -> Motion:
        """This motion, followed by another."""
        c, s = following.scale * math.cos(following.rotation_rad), following.scale * math.sin(following.rotation_rad)
        return Motion(
            c * self.u - s * self.v + following.u,
            s * self.u + c * self.v + following.v,
            self.rotation_rad + following.rotation_rad,
            self.scale * following.scale,
        )

    def inverse(self) -> Motion:
        """The motion that undoes this one."""
        c, s = math.cos(self.rotation_rad) / self.scale, math.sin(self.rotation_rad) / self.scale
        return Motion(-(c * self.u + s * self.v), s * self.u - c * self.v, -self.rotation_rad, 1.0 / self.scale)

    def times(self, factor: float) -> Motion:
        """The motion over `factor` times the time at the same velocities of shift and rotation, at one scale."""
        return Motion(self.u * factor, self.v * factor, self.rotation_rad * factor)


STILL = Motion(0.0, 0.0, 0.0)


def rotation_limit(side_px: int, pixel_px: float = 1.0) -> float:
    """Largest rotation between frames (rad) for a fragment of side N: its corner moves by half a pixel.

    α_max = atan(Δ_pix / (2 √2 h)) with the half-size h = (N - 1)/2. Paper A (1) prints N in the place of h;
    its table (5 x 5 … 9 x 9) obeys this form, its row 11 x 11 is that of 13 x 13.
    """
    return math.atan(pixel_px / (2.0 * math.sqrt(2.0) * ((side_px - 1) / 2)))


@_jit
def centre_shift(front: tuple[float, float], rear: tuple[float, float]) -> tuple[float, float]:
    """Shift (m_x0, n_y0) of the image centre from those of two fragments, px. Paper A (12), (13)."""
    return (front[0] + rear[0]) / 2.0, (front[1] + rear[1]) / 2.0


@_jit
def rotation_between_frames(front_v: float, rear_v: float, distance_px: float) -> float:
    """Δα (rad, counter-clockwise), the camera's rotation, from the fragments' shifts across the travel.

    Δα = arcsin((n_y1 - n_y2) / L), fragment 1 in front. Paper A (15) prints arcsin(n_y1 - n_y2) / L. NaN where
    the shifts differ by more than L.
    """
    ratio = (front_v - rear_v) / distance_px
    return math.asin(ratio) if abs(ratio) <= 1.0 else math.nan


def path_step(shift_px: tuple[float, float], metres_per_px: float) -> float:
    """S = W sqrt(m_x0² + n_y0²), metres, never negative. Paper A (14)."""
    return metres_per_px * math.hypot(*shift_px)


def increment_along(path_m: float, heading_rad: float) -> tuple[float, float]:
    """(Δx, Δy) = S (cos α, sin α), metres. Paper A (16), (17): reverse motion and sideslip are lost."""
    return path_m * math.cos(heading_rad), path_m * math.sin(heading_rad)


def increment_of_vector(
    shift_px: tuple[float, float], metres_per_px: float, camera_heading_rad: float
) -> tuple[float, float]:
    """(Δx, Δy) of the camera in the world, metres, from the whole shift vector: exact on SE(2).

    (Δx, Δy) = -W R(α) (m_x0, -n_y0) with the camera's heading α *after* the step, because the shift of the
    centre is expressed in the axes of the new frame; v points to the right, hence the minus. Takes the place of
    paper A (14), (16), (17), and keeps reverse motion and sideslip.
    """
    c, s = math.cos(camera_heading_rad), math.sin(camera_heading_rad)
    m, n = shift_px
    return -metres_per_px * (c * m + s * n), -metres_per_px * (s * m - c * n)


def deviation_of_segment(segment_m: float, reference_m: float) -> tuple[float, float]:
    """ΔS_relate = (S_Σ - S_etal) / S_Σ (19) and ΔS_Σ = S_Σ - S_etal in metres (20); ΔS_relate is NaN for S_Σ = 0."""
    deviation = segment_m - reference_m
    return (deviation / segment_m if segment_m > 0.0 else math.nan), deviation


def correction_fires(relative: float, deviation_m: float, max_relative: float, min_deviation_m: float) -> bool:
    """|ΔS_relate| < thr_relate and |ΔS_Σ| > thr_sum (20).

    The paper prints ΔS_relate without the absolute value, so that a stop (ratio → -∞) would pass.
    """
    return abs(relative) < max_relative and abs(deviation_m) > min_deviation_m


def correction_as_printed(relative: float, deviation_m: float, par_m: float) -> float:
    """Δx_cor = par · ΔS_relate · sign(ΔS_Σ), metres along Ox (21), par read as a length.

    ΔS_relate and ΔS_Σ have one sign, so the product never changes sign: it cannot correct both ways.
    """
    return par_m * relative * math.copysign(1.0, deviation_m)


def correction_speed_prior(deviation_m: float, gain: float) -> float:
    """Δx_cor = -gain · ΔS_Σ, metres along Ox, 0 ≤ gain ≤ 1: the form of (21) that can correct both ways.

    It pulls the path of the segment to the reference, that is, the speed to its nominal value.
    """
    return -gain * deviation_m
