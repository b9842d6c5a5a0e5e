"""From the motion between frames to the trajectory, blocks 5-10 of paper A's Fig. 4: integrate, then correct.

Poses are x (m), y (m), heading (rad); axes and signs are those of `step.py`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from pipelines.correlation import equations as eq
from pipelines.correlation.equations import Motion
from pipelines.correlation.settings import Correction, CorrelationSettings
from pipelines.planar import wrap_angle

Pose = tuple[float, float, float]


class Segment(NamedTuple):
    """A correction segment: frames and sums so far, deviations at its end, what is applied and what is due."""

    frames: int = 0
    sum_m: float = 0.0
    reference_m: float = 0.0
    relative_deviation: float = math.nan
    deviation_m: float = math.nan
    applied_m: tuple[float, float] = (0.0, 0.0)
    due_m: tuple[float, float] = (0.0, 0.0)
    start: tuple[float, float] = (0.0, 0.0)


def integrated(
    s: CorrelationSettings, pose: Pose, motion: Motion, metres_per_px: float
) -> tuple[Pose, tuple[float, float], float]:
    """The new pose, the increment (m) and the length of the step (m): (14), (16), (17), or exactly on SE(2)."""
    x, y, heading = pose
    turned = heading + motion.rotation_rad
    path_m = eq.path_step((motion.u, motion.v), metres_per_px)
    if s.integration == "exact" or s.mount == "gimballed":
        increment = eq.increment_of_vector((motion.u, motion.v), metres_per_px, turned + s.mounting_yaw_rad)
    elif s.integration == "mid-heading":
        increment = eq.increment_along(path_m, heading + motion.rotation_rad / 2.0)
    else:
        increment = eq.increment_along(path_m, turned)
    return (x + increment[0], y + increment[1], wrap_angle(turned)), increment, path_m


def corrected(s: CorrelationSettings, old: Segment, before: Pose, pose: Pose, path_m: float, dt_s: float) -> Segment:
    """(18)-(21): sums over the segment; at its end the correction that the next frame applies.

    Args:
        s: the settings.
        old: the segment up to the frame before.
        before: uncorrected pose at the frame before.
        pose: uncorrected pose at this frame.
        path_m: length of the step between them.
        dt_s: time between them.
    """
    if s.correction is Correction.OFF:
        return old
    assert s.correction_speed_mps is not None
    fresh = old.frames in (0, s.correction_frames)
    frames = 1 if fresh else old.frames + 1
    sum_m = path_m if fresh else old.sum_m + path_m
    nominal_m = s.correction_speed_mps * dt_s
    reference_m = nominal_m if fresh else old.reference_m + nominal_m
    start = before[:2] if fresh else old.start
    if frames < s.correction_frames:
        return Segment(frames, sum_m, reference_m, applied_m=old.due_m, start=start)
    relative, deviation = eq.deviation_of_segment(sum_m, reference_m)
    length = 0.0
    if eq.correction_fires(relative, deviation, s.correction_max_relative, s.correction_min_m):
        if s.correction is Correction.SPEED_PRIOR:
            length = eq.correction_speed_prior(deviation, s.correction_gain)
        else:
            length = eq.correction_as_printed(relative, deviation, s.correction_par_m)
    # along Ox, the heading; a gimballed camera has none, so A0 corrects both coordinates: along the segment
    heading = pose[2] if s.mount == "rigid" else math.atan2(pose[1] - start[1], pose[0] - start[0])
    due = eq.increment_along(length, heading)
    return Segment(frames, sum_m, reference_m, relative, deviation, old.due_m, due, start)
