"""From two images to the motion between them: steps 1-4 of the chain, and the global search."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from pipelines.correlation import equations as eq
from pipelines.correlation import kernels
from pipelines.correlation.equations import Motion
from pipelines.correlation.judging import alarms_of_fit, alarms_of_match, median
from pipelines.correlation.layout import Layout, layout_of, shifts_of
from pipelines.correlation.settings import CorrelationSettings
from pipelines.verdict import Verdict

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Grey = NDArray[np.uint8]

GLOBAL_REDUCTION = 4
"""The global search works on images reduced by this factor."""
GLOBAL_PATCH = 0.35
"""Side of its patch, as a share of the shorter side of the image."""
MAX_SCALE_CHANGE = 0.1
"""Two fragments whose matches change their distance by more than this share propose no motion."""

_NO_PATCHES = np.empty((0, 0, 0), np.float32)
NO_COVARIANCE = np.full((3, 3), np.nan)


@dataclass(frozen=True, slots=True)
class Template:
    """A frame whose fragments are searched in others.

    `grey` uint8 [height, width], `pose` (x m, y m, heading rad) and its `covariance` [3, 3] at that frame;
    `fragments`, `tiles` float32 [n, S, S] are spline patches, empty until they are needed.
    """

    frame: int
    grey: Grey
    pose: tuple[float, float, float]
    covariance: Floats
    fragments: NDArray[np.float32] = _NO_PATCHES
    tiles: NDArray[np.float32] = _NO_PATCHES


class Candidate(NamedTuple):
    """One attempt to find the motion from a template frame to this frame.

    `motion` is what was found (the prediction where nothing was), `predicted_shift` [F, 2] and `search` [F, 2]
    where it was looked for, `shift` [F, 2] integer plus subpixel, `covariance` [3, 3] of shift (px) and rotation.
    """

    template: Template
    motion: Motion
    predicted_shift: Floats
    search: Integers
    matches: kernels.Matches
    texture: kernels.Texture
    shift: Floats
    weight: Floats
    residual: Floats
    inliers: int
    tile_shift: Floats
    tile_weight: Floats
    covariance: Floats
    alarms: Verdict
    acceptable: bool


class Matcher:
    """Finds the motion between a template frame and this frame under fixed settings."""

    def __init__(self, settings: CorrelationSettings) -> None:
        self._s = settings
        self._limit_rad = eq.rotation_limit(settings.fragment_side_px)

    def prepare(self, template: Template) -> Template:
        """The template with its spline patches, where the refinement needs them."""
        s = self._s
        if s.refiner == "one-step" or len(template.fragments):
            return template
        layout = layout_of(s, template.grey.shape[1], template.grey.shape[0])
        fragments = kernels.spline_patches(template.grey, layout.centres, s.fragment_side_px)
        tiles = kernels.spline_patches(template.grey, layout.tile_centres, s.tile_side_px)
        return Template(template.frame, template.grey, template.pose, template.covariance, fragments, tiles)

    def reaches(self, template: Template, motion: Motion) -> bool:
        """Whether every fragment of the template, after that motion, still lies inside the image."""
        height, width = template.grey.shape
        margin = (self._s.fragment_side_px - 1) / 2
        layout = layout_of(self._s, width, height)
        low_u, low_v = margin - (width - 1) / 2, margin - (height - 1) / 2
        for u, v in layout.points.tolist():
            du, dv = motion.shift_of(u, v)
            if not (low_u <= u + du <= -low_u and low_v <= v + dv <= -low_v):
                return False
        return True

    def match(
        self,
        template: Template,
        grey: Grey,
        predicted: Motion,
        *,
        last_shift: Floats | None = None,
        usual_residual: float = math.nan,
    ) -> Candidate:
        """Search the template's fragments around the predicted motion and fit the motion of the frame.

        Args:
            template: the frame with the fragments.
            grey: this frame, uint8 [height, width].
            predicted: expected motion from the template frame.
            last_shift: last shift [F, 2] of each fragment (px), the centre of the search for ``last-shift``.
            usual_residual: running median of the residual (grey), NaN if there is none yet.
        """
        s = self._s
        height, width = grey.shape
        layout = layout_of(s, width, height)
        alarms = Verdict.OK
        if s.prediction == "constant-velocity":
            expected = shifts_of(predicted, layout.points)
        elif s.prediction == "last-shift" and last_shift is not None:
            expected = last_shift
        else:
            expected = np.zeros_like(layout.points)
        search = layout.centres + np.floor(expected + 0.5).astype(np.int64)
        outside = _outside(search.tolist(), s.fragment_side_px, s.search_radius_px, width, height)
        if outside:
            alarms |= Verdict.SEARCH_OUTSIDE_IMAGE
            if s.prediction == "last-shift":
                search[outside] = layout.centres[outside]
        if s.refiner == "one-step":
            m = kernels.match_one_step(
                template.grey, grey, layout.centres, search, s.fragment_side_px, s.search_radius_px
            )
            turned = 0.0
        else:
            template = self.prepare(template)
            turn = s.rotate_template and abs(predicted.rotation_rad) > s.rotate_above_rad
            turned = predicted.rotation_rad if turn else 0.0
            m = kernels.match_iterated(
                template.fragments, grey, layout.centres, search, turned, s.fragment_side_px,
                s.search_radius_px, s.gain_and_offset, s.max_iterations, s.tolerance_px,
            )  # fmt: skip
        if s.motion == "paper":
            return self._paper_motion(template, expected, search, m, layout, alarms)
        return self._robust_motion(
            template, grey, predicted, turned, expected, search, m, layout, alarms, usual_residual
        )

    def _paper_motion(
        self,
        template: Template,
        expected: Floats,
        search: Integers,
        m: kernels.Matches,
        layout: Layout,
        alarms: Verdict,
    ) -> Candidate:
        """Motion from two fragments as the paper has it: (10)-(13), (15)."""
        s = self._s
        texture = kernels.texture_of(m, s.fragment_side_px)
        shifts = []
        for (peak_u, peak_v), (du, dv) in zip(m.peak_px.tolist(), m.delta_px.tolist(), strict=True):
            # a Δ beyond its limit is rejected, not clipped: the integer shift stands
            valid = math.hypot(du, dv) <= s.step_limit_px
            shifts.append((peak_u + du, peak_v + dv) if valid else (peak_u, peak_v))
        rear, front = shifts
        (rear_u, _), (front_u, _) = layout.points.tolist()
        distance = front_u - rear_u
        centre = eq.centre_shift(front, rear)
        rotation = 0.0 if s.mount == "gimballed" else eq.rotation_between_frames(front[1], rear[1], distance)
        matched = math.hypot(distance + front[0] - rear[0], front[1] - rear[1])
        found = math.isfinite(centre[0]) and math.isfinite(rotation)
        motion = Motion(*centre, rotation) if found else Motion(0.0, 0.0, 0.0)
        shift = np.array(shifts)
        residual = shift - shifts_of(motion, layout.points)
        covariance = _two_fragment_covariance(texture.sigma_px.tolist(), distance)
        fit = kernels.Fit(
            *centre, rotation, matched / distance, np.full(2, float(found)), residual, 2 * found, covariance
        )
        alarms |= alarms_of_match(s, m, texture, (layout.centres + m.peak_px - search).astype(np.int64))
        if abs(matched - distance) > s.max_rigidity_px:
            alarms |= Verdict.NOT_RIGID
        if not alarms & (Verdict.NOT_RIGID | Verdict.LOW_CORRELATION):
            alarms |= alarms_of_fit(s, m, fit, rotation, self._limit_rad)
        return Candidate(
            template, motion._replace(scale=fit.scale), expected, search, m, texture, shift, fit.weight, residual,
            fit.inliers, *no_tiles(layout), covariance, alarms, found,
        )  # fmt: skip

    def _robust_motion(
        self,
        template: Template,
        grey: Grey,
        predicted: Motion,
        turned: float,
        expected: Floats,
        search: Integers,
        m: kernels.Matches,
        layout: Layout,
        alarms: Verdict,
        usual_residual: float,
    ) -> Candidate:
        """Motion that most fragments agree on, then the photometric step over tiles of the whole frame."""
        s = self._s
        texture = kernels.texture_of(m, s.fragment_side_px)
        found = self._agree(m, texture, layout)
        if found[4] >= 2 and s.rotate_template and abs(found[2] - turned) > s.rotate_above_rad:
            turned = found[2]
            kernels.refine_again(
                m, template.fragments, grey, layout.centres, turned, s.fragment_side_px, s.gain_and_offset,
                s.max_iterations, s.tolerance_px,
            )  # fmt: skip
            texture = kernels.texture_of(m, s.fragment_side_px)
            found = self._agree(m, texture, layout)
        shift = m.peak_px + m.delta_px
        peak_offset = np.nan_to_num(layout.centres + m.peak_px - search).astype(np.int64)
        alarms |= alarms_of_match(s, m, texture, peak_offset)
        candidate = Candidate(
            template, predicted, expected, search, m, texture, shift, np.zeros(len(shift)),
            np.full(shift.shape, np.nan), 0, *no_tiles(layout), NO_COVARIANCE,
            alarms | Verdict.TOO_FEW_INLIERS, False,
        )  # fmt: skip
        if found[4] < 2:
            return candidate
        usable = np.where(texture.delta_length_px <= s.step_limit_px, m.residual_rms, np.nan)
        fit = kernels.photometric_fit(
            layout.points, shift, m.hessian, usable, *found[:4], s.inlier_px, s.robust_scale_px
        )
        alarms |= alarms_of_fit(s, m, fit, fit.rotation_rad - turned, self._limit_rad)
        used = fit.weight > 0.0
        gain, residual = median(m.gain[used].tolist()), median(m.residual_rms[used].tolist())
        few = fit.inliers < s.min_inliers
        acceptable = (
            not few
            and s.accepted_gain[0] <= gain <= s.accepted_gain[1]
            and not residual > s.max_residual_ratio * max(usual_residual, 1.0)
        )
        final, tile_shift, tile_weight = fit, *no_tiles(layout)
        if acceptable and len(layout.tile_centres):
            final, tile_shift, tile_weight = self._whole_frame(template, grey, layout, fit)
        rotation = 0.0 if s.mount == "gimballed" else final.rotation_rad
        return candidate._replace(
            motion=Motion(final.shift_u, final.shift_v, rotation, final.scale),
            weight=fit.weight,
            residual=fit.residual,
            inliers=fit.inliers,
            tile_shift=tile_shift,
            tile_weight=tile_weight,
            covariance=final.covariance,
            alarms=alarms | (Verdict.TOO_FEW_INLIERS if few else Verdict.OK),
            acceptable=acceptable,
        )

    def _agree(
        self, m: kernels.Matches, texture: kernels.Texture, layout: Layout
    ) -> tuple[float, float, float, float, int]:
        usable = texture.delta_length_px <= self._s.step_limit_px
        found: tuple[float, float, float, float, int] = kernels.consensus(
            layout.points, m.peak_px + m.delta_px, usable, self._s.inlier_px, MAX_SCALE_CHANGE
        )
        return found

    def _whole_frame(
        self, template: Template, grey: Grey, layout: Layout, fit: kernels.Fit
    ) -> tuple[kernels.Fit, Floats, Floats]:
        """The photometric step: many tiles refined from the fragments' motion, and one joint fit."""
        s = self._s
        motion = (fit.shift_u, fit.shift_v, fit.rotation_rad, fit.scale)
        shift, hessian, rms = kernels.refine_tiles(
            template.tiles, grey, layout.tile_centres, layout.tile_points, *motion, s.tile_side_px,
            s.gain_and_offset, s.tile_iterations, s.tolerance_px,
        )  # fmt: skip
        whole = kernels.photometric_fit(
            layout.tile_points, shift, hessian, rms, *motion, s.inlier_px, s.robust_scale_px
        )
        better = whole.inliers >= 2 * fit.inliers
        return (whole if better else fit), shift, (whole.weight if better else np.zeros(len(shift)))

    def search_globally(self, template: Grey, grey: Grey) -> list[Motion]:
        """Motions that a patch of the template's centre proposes over the whole frame, the best first.

        Works on images reduced by `GLOBAL_REDUCTION`, at each of `recovery_rotations_rad`.
        """
        s = self._s
        height, width = (n // GLOBAL_REDUCTION for n in grey.shape)
        small_template, small = (cv2.resize(g, (width, height), interpolation=cv2.INTER_AREA) for g in (template, grey))
        half = max(int(GLOBAL_PATCH * min(height, width)) // 2, 4)
        if 2 * half + 1 > min(height, width):
            return []
        centre = ((width - 1) / 2, (height - 1) / 2)
        top, left = height // 2 - half, width // 2 - half
        found = []
        for rotation in s.recovery_rotations_rad:
            turned = small_template
            if rotation:
                turn = cv2.getRotationMatrix2D(centre, -math.degrees(rotation), 1.0)
                turned = cv2.warpAffine(small_template, turn, (width, height), flags=cv2.INTER_LINEAR)
            patch = turned[top : top + 2 * half + 1, left : left + 2 * half + 1]
            if float(patch.std()) < 1.0:
                continue
            surface = cv2.matchTemplate(small, patch, cv2.TM_CCOEFF_NORMED)
            _, value, _, (i, j) = cv2.minMaxLoc(surface)
            if value >= s.global_min_correlation:
                motion = Motion((i - left) * GLOBAL_REDUCTION, (j - top) * GLOBAL_REDUCTION, rotation)
                found.append((-value, motion))
        return [motion for _, motion in sorted(found)]


def no_tiles(layout: Layout) -> tuple[Floats, Floats]:
    """Shifts [T, 2] and weights [T] of tiles that were not refined."""
    return np.full(layout.tile_points.shape, np.nan), np.zeros(len(layout.tile_points))


def _outside(search: list[list[int]], side: int, radius: int, width: int, height: int) -> list[int]:
    """The fragments whose search area holds no position inside the image."""
    reach = radius - (side - 1) // 2
    return [
        i
        for i, (u, v) in enumerate(search)
        if u + reach < 0 or v + reach < 0 or u - reach > width - 1 or v - reach > height - 1
    ]


def _two_fragment_covariance(sigma_px: list[list[float]], distance_px: float) -> Floats:
    """Covariance [3, 3] of (m_x0, n_y0, Δα) from the σ of two fragments: (12), (13), (15) linearised."""
    (rear_u, rear_v), (front_u, front_v) = sigma_px
    across = (front_v**2 - rear_v**2) / (2.0 * distance_px)
    return np.array(
        [
            [(front_u**2 + rear_u**2) / 4.0, 0.0, 0.0],
            [0.0, (front_v**2 + rear_v**2) / 4.0, across],
            [0.0, across, (front_v**2 + rear_v**2) / distance_px**2],
        ]
    )
