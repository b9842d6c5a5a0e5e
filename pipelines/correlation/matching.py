"""From two images to the motion between them: steps 1-4 of the chain, and the global search."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from pipelines.correlation import kernels
from pipelines.correlation.equations import Motion
from pipelines.correlation.judging import alarms_of_fit, alarms_of_match, limits_of, median
from pipelines.correlation.layout import Layout, layout_of
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

NO_COVARIANCE = np.full((3, 3), np.nan)


@dataclass(frozen=True, slots=True)
class Template:
    """A frame whose fragments are searched in others.

    `grey` uint8 [height, width], `pose` (x m, y m, heading rad) and its `covariance` [3, 3] at that frame;
    `fragments`, `tiles` float32 [n, S, S] are spline patches, None until they are needed.
    """

    frame: int
    grey: Grey
    pose: tuple[float, float, float]
    covariance: Floats
    fragments: NDArray[np.float32] | None = None
    tiles: NDArray[np.float32] | None = None


class Candidate(NamedTuple):
    """One attempt to find the motion from a template frame to this frame.

    `motion` is what was found (the prediction where nothing was), `predicted_shift` [F, 2] and `search` [F, 2]
    where it was looked for, `covariance` [3, 3] of shift (px) and rotation.
    """

    template: Template
    motion: Motion
    predicted_shift: Floats
    search: Integers
    matches: kernels.Matches
    inliers: int
    tile_shift: Floats
    tile_weight: Floats
    covariance: Floats
    alarms: int
    acceptable: bool


class Matcher:
    """Finds the motion between a template frame and this frame under fixed settings."""

    def __init__(self, settings: CorrelationSettings) -> None:
        self._s = settings
        self._limits = limits_of(settings)
        self._layouts: dict[tuple[int, int], Layout] = {}

    def layout(self, width: int, height: int) -> Layout:
        """The layout for an image of that size.

        Raises:
            EstimatorError: the fragments do not fit into the image.
        """
        size = (width, height)
        if size not in self._layouts:
            self._layouts[size] = layout_of(self._s, width, height)
        return self._layouts[size]

    def prepare(self, template: Template) -> Template:
        """The template with its spline patches, where the refinement needs them."""
        s = self._s
        if s.refiner == "one-step" or template.fragments is not None:
            return template
        layout = self.layout(template.grey.shape[1], template.grey.shape[0])
        fragments = kernels.spline_patches(template.grey, layout.centres, s.fragment_side_px)
        tiles = kernels.spline_patches(template.grey, layout.tile_centres, s.tile_side_px)
        return Template(template.frame, template.grey, template.pose, template.covariance, fragments, tiles)

    def reaches(self, template: Template, motion: Motion) -> bool:
        """Whether every fragment of the template, after that motion, still lies inside the image."""
        height, width = template.grey.shape
        margin = (self._s.fragment_side_px - 1) / 2
        points = self.layout(width, height).points
        moved = np.abs(points + kernels.shifts_of(points, *motion)).max(axis=0)
        return bool(moved[0] <= (width - 1) / 2 - margin and moved[1] <= (height - 1) / 2 - margin)

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
        layout = self.layout(width, height)
        alarms = 0
        if s.prediction == "constant-velocity":
            expected = kernels.shifts_of(layout.points, *predicted)
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
        m = kernels.new_matches(len(layout.centres), s.search_radius_px)
        block = (m.surface, m.hessian, m.block)
        if s.refiner == "one-step":
            turned = 0.0
            kernels.match_one_step(
                template.grey, grey, layout.centres, search, s.fragment_side_px, s.search_radius_px, *block
            )
        else:
            template = self.prepare(template)
            turn = s.rotate_template and abs(predicted.rotation_rad) > s.rotate_above_rad
            turned = predicted.rotation_rad if turn else 0.0
            kernels.match_iterated(
                template.fragments, grey, layout.centres, search, turned, s.fragment_side_px,
                s.search_radius_px, s.ambiguity, s.gain_and_offset, s.max_iterations, s.tolerance_px, *block,
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
        alarms: int,
    ) -> Candidate:
        """Motion from two fragments as the paper has it: (10)-(13), (15)."""
        s = self._s
        arrays = (m.surface, m.hessian, m.block)
        covariance = np.empty((3, 3))
        motion = Motion(*kernels.paper_fit(*arrays, layout.points, s.step_limit_px, s.mount == "gimballed", covariance))
        found = math.isfinite(motion.u) and math.isfinite(motion.rotation_rad)
        alarms |= alarms_of_match(*arrays, layout.centres, search, self._limits)
        distance = layout.points[1, 0] - layout.points[0, 0]
        alarms |= alarms_of_fit(self._limits, motion.rotation_rad, motion.scale, distance)
        return Candidate(
            template,
            motion,
            expected,
            search,
            m,
            2 * found,
            layout.no_tile_shift,
            layout.no_tile_weight,
            covariance,
            alarms,
            found,
        )

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
        alarms: int,
        usual_residual: float,
    ) -> Candidate:
        """Motion that most fragments agree on, then the photometric step over tiles of the whole frame."""
        s = self._s
        found = self._agree(m, layout)
        if found[4] >= 2 and s.rotate_template and abs(found[2] - turned) > s.rotate_above_rad:
            turned = found[2]
            kernels.refine_again(
                template.fragments, grey, layout.centres, turned, s.fragment_side_px, s.gain_and_offset,
                s.max_iterations, s.tolerance_px, m.surface, m.hessian, m.block,
            )  # fmt: skip
            found = self._agree(m, layout)
        alarms |= alarms_of_match(m.surface, m.hessian, m.block, layout.centres, search, self._limits)
        m.weight[:] = 0.0
        candidate = Candidate(
            template, predicted, expected, search, m, 0, layout.no_tile_shift, layout.no_tile_weight, NO_COVARIANCE,
            alarms | int(Verdict.TOO_FEW_INLIERS), False,
        )  # fmt: skip
        if found[4] < 2:
            return candidate
        usable = np.where(m.delta_length_px <= s.step_limit_px, m.residual_rms, np.nan)
        fit = kernels.photometric_fit(
            layout.points, m.shift_px, m.hessian, usable, *found[:4], s.inlier_px, s.robust_scale_px
        )
        m.weight[:], m.fit_residual_px[:] = fit.weight, fit.residual
        alarms |= alarms_of_fit(self._limits, fit.rotation_rad - turned, fit.scale, math.nan)
        used = fit.weight > 0.0
        gain, residual = median(m.gain[used]), median(m.residual_rms[used])
        few = fit.inliers < s.min_inliers
        acceptable = (
            not few
            and bool(np.isfinite(fit.covariance).all())
            and s.accepted_gain[0] <= gain <= s.accepted_gain[1]
            and not residual > s.max_residual_ratio * max(usual_residual, 1.0)
        )
        final, tile_shift, tile_weight = fit, layout.no_tile_shift, layout.no_tile_weight
        if not few and 2 * fit.inliers < len(layout.centres):
            alarms |= Verdict.NOT_RIGID
        if acceptable and len(layout.tile_centres):
            final, tile_shift, tile_weight = self._whole_frame(template, grey, layout, fit)
        rotation = 0.0 if s.mount == "gimballed" else final.rotation_rad
        motion = Motion(final.shift_u, final.shift_v, rotation, final.scale)
        return candidate._replace(
            motion=motion,
            inliers=fit.inliers,
            tile_shift=tile_shift,
            tile_weight=tile_weight,
            covariance=final.covariance,
            alarms=alarms | (int(Verdict.TOO_FEW_INLIERS) if few else 0),
            acceptable=acceptable,
        )

    def _agree(self, m: kernels.Matches, layout: Layout) -> tuple[float, float, float, float, int]:
        usable = m.delta_length_px <= self._s.step_limit_px
        found: tuple[float, float, float, float, int] = kernels.consensus(
            layout.points, m.shift_px, usable, self._s.inlier_px, MAX_SCALE_CHANGE
        )
        return found

    def _whole_frame(
        self, template: Template, grey: Grey, layout: Layout, fit: kernels.Fit
    ) -> tuple[kernels.Fit, Floats, Floats]:
        """The photometric step: one joint fit to many tiles, repeated from its own result until it rests."""
        s = self._s
        motion = (fit.shift_u, fit.shift_v, fit.rotation_rad, fit.scale)
        for _ in range(s.tile_rounds):
            shift, hessian, rms = kernels.refine_tiles(
                template.tiles, grey, layout.tile_centres, layout.tile_points, *motion, s.tile_side_px,
                s.gain_and_offset,
            )  # fmt: skip
            whole = kernels.photometric_fit(
                layout.tile_points, shift, hessian, rms, *motion, s.inlier_px, s.robust_scale_px
            )
            if whole.inliers < 2 * fit.inliers:
                return fit, layout.no_tile_shift, layout.no_tile_weight
            before, motion = motion, (whole.shift_u, whole.shift_v, whole.rotation_rad, whole.scale)
            reach = max(grey.shape) / 2
            moved = abs(motion[0] - before[0]) + abs(motion[1] - before[1]) + reach * abs(motion[2] - before[2])
            if moved < s.tile_tolerance_px:
                break
        return whole, shift, whole.weight

    def search_globally(self, template: Grey, grey: Grey, predicted: Motion) -> list[Motion]:
        """Motions that a patch of the template's centre proposes over the whole frame, the best first.

        Works on images reduced by `GLOBAL_REDUCTION`, at each of `recovery_rotations_rad`; of peaks that differ by
        less than `ambiguity` the one nearest to the predicted motion counts.
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
            value = float(surface.max())
            rivals = (surface >= value - s.ambiguity) & (surface >= cv2.dilate(surface, np.ones((3, 3), np.uint8)))
            places = np.argwhere(rivals)
            expected = np.array([predicted.v / GLOBAL_REDUCTION + top, predicted.u / GLOBAL_REDUCTION + left])
            j, i = places[np.argmin(((places - expected) ** 2).sum(axis=1))].tolist()
            if value >= s.global_min_correlation:
                motion = Motion((i - left) * GLOBAL_REDUCTION, (j - top) * GLOBAL_REDUCTION, rotation)
                found.append((-value, motion))
        return [motion for _, motion in sorted(found)]


def _outside(search: list[list[int]], side: int, radius: int, width: int, height: int) -> list[int]:
    """The fragments whose search area holds no position inside the image."""
    reach = radius - (side - 1) // 2
    return [
        i
        for i, (u, v) in enumerate(search)
        if u + reach < 0 or v + reach < 0 or u - reach > width - 1 or v - reach > height - 1
    ]
