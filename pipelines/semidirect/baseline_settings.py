"""Settings of the PTAM-style baseline."""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import Field, model_validator

from pipelines.semidirect.pyramid import LEVELS
from pipelines.semidirect.settings import CameraSettings, Count, Fraction, NotNegative, Positive

Level = Annotated[int, Field(ge=0, lt=LEVELS)]


class BaselineSettings(CameraSettings):
    """Every default of the baseline by name; unknown keys are an error.

    Lengths in px are those of the image as it is read, unless they are px of a level. The defaults are those of PTAM
    as it was modified for small UAVs, which does not look at level 0.
    """

    # corners
    finest_level: Level = Field(1, description="first level of the pyramid with corners, 0 in the original")
    coarsest_level: Level = Field(3, description="last one")
    corner_threshold: Count = Field(10, description="FAST's threshold, grey levels")
    corner_min_score: NotNegative = Field(4.0, description="least smaller eigenvalue of a new point, grey levels²")
    corner_cell_px: Annotated[int, Field(ge=8)] = Field(
        12, description="at most one new point in a cell, px of its level"
    )

    # start
    start_min_matches: Count = Field(50, description="fewer start again with a new first view")
    start_motion_px: Positive = Field(50.0, description="median way of the corners that allows a start")
    start_parallax_px: Positive = Field(10.0, description="median way beyond all rotation that allows a start")
    start_min_inliers: Count = Field(40, description="fewer points are no first map")

    # tracking
    velocity_decay: Fraction = Field(0.9, description="share of the velocity that is kept with each frame that is lost")
    coarse_points: Count = Field(60, description="points of the coarse step")
    coarse_level: Level = Field(2, description="first level of its points")
    coarse_px: Positive = Field(30.0, description="its search radius")
    coarse_min: Count = Field(20, description="fewer points found there do not move the pose")
    fine_points: Count = Field(1000, description="most points of the fine step")
    fine_px: Positive = Field(5.0, description="its search radius, twice that without a coarse step")
    max_score: Positive = Field(1500.0, description="worst mean squared difference of a match, grey levels²")
    max_score_share: Positive = Field(0.5, description="the same as a share of the patch's variance")
    align_level: Level = Field(
        3, description="matches of the fine step on this level and coarser are aligned to a part of a pixel"
    )
    align_iterations: Count = Field(10, description="most iterations of an alignment")
    pose_iterations: Count = Field(10, description="most iterations of the pose")
    inlier_px: Positive = Field(2.0, description="a larger reprojection error is an outlier, px of the level")

    # keyframes and map
    keyframe_distance: Positive = Field(0.12, description="a keyframe is farther from all others, in scene depths")
    max_keyframes: Annotated[int, Field(ge=3)] = Field(50, description="keyframes in the map; the farthest goes")
    depth_sigmas: Positive = Field(2.0, description="half of the search's range of inverse depths, in σ of those seen")
    min_depth_range: Fraction = Field(0.05, description="that half is at least this share of the inverse depth")
    point_outliers: Count = Field(20, description="a point goes that was an outlier more often, and oftener than not")

    # bundle adjustment
    local_keyframes: Count = Field(5, description="keyframes of the local bundle that move")
    local_iterations: Count = Field(10, description="its most iterations")
    global_every: Annotated[int, Field(ge=0)] = Field(10, description="keyframes from one global bundle to the next")
    global_iterations: Count = Field(10, description="its most iterations")
    bundle_huber_px: Positive = Field(1.0, description="width of the Huber cost of both")

    # lost and found
    min_tracked: Count = Field(30, description="fewer points are LOST")
    lost_share: Fraction = Field(0.13, description="a smaller share of the points looked for is LOST")
    good_share: Fraction = Field(0.3, description="a smaller share makes no keyframe and ends no loss")
    relocalise_correlation: Fraction = Field(0.5, description="least correlation of the small images")
    restart_s: NotNegative = Field(2.0, description="a new map is begun when lost for so long, 0: never")

    # verdicts, how it runs
    gap_factor: Positive = Field(1.6, description="FRAME_GAP above this multiple of the running median of dt")
    stage_times: bool = Field(False, description="log the time of each stage (not reproducible)")

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if not self.finest_level <= self.coarse_level <= self.coarsest_level:
            raise ValueError("coarse_level must lie between finest_level and coarsest_level")
        if self.min_tracked > self.fine_points:
            raise ValueError("min_tracked exceeds fine_points: every frame would be lost")
        if self.coarse_min > self.coarse_points:
            raise ValueError("coarse_min exceeds coarse_points: the coarse step would never count")
        return self
